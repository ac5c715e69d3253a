"""Guards checker/reach/measurable: how far what the piece under way has done may be above its chord."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from flint import arb_mat, ctx

from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.reach import measurable
from sparserob_core.checker.reach.measurable import MeasurableLoop
from sparserob_core.control.problem.system import VaryingSystem
from sparserob_core.control.sets.sets import Box
from tests.support.closed_loops import FAST, FORCE, GUST, Changing

H = np.array([[1.0, 0.0], [0.6, 0.8]])


def test_what_began_before_a_cell_bends_within_it() -> None:
    """Of what oscillates, and is pushed early only: later nothing enters that would bend it."""
    case = Changing(
        FAST, FORCE, GUST, np.array([0.0, 2.0]), np.array([0.0, 2.0]), np.zeros(2),
        Box([-0.1, -0.1], [0.1, 0.1]), measurable=True, rate="1 + 0*t", grown="t", factor="exp(-8*t)",
    )  # fmt: skip
    law, most = VerifiedFlow(Plant.of(case.system, 2.0), 2.0), 0.0
    with ctx.workprec(192):
        still, none, ends = [arb_mat(1, 1)], np.zeros((1, 1, 1, 2)), [0.0, 2.0]
        loop = MeasurableLoop(case.system, [0.0, 0.0], still, none, ends, ends, [], case.bound, law=law)
        for low, high in pairwise(law.marks([0.5, 1.25])):
            share = np.linspace(0.0, 1.0, 4)
            times = (low + share * (high - low)).tolist()
            values = np.array([[float(h.mid()) for h in loop.highest(0, t, H)] for t in times])
            over = (values - ((1.0 - share)[:, None] * values[0] + share[:, None] * values[-1])).max(axis=0)
            bent = loop.bound_chord_error(0, low, high, H)
            assert (over <= bent + 1e-12).all()
            assert (bent <= 0.2).all()
            most = max(most, float(over.max()))
    assert most > 1e-4, "nothing was bent"


def test_what_enters_less_and_less_is_above_its_chord_by_how_fast_that_falls() -> None:
    """``x' = (1 - t) w``: an eighth of the square of the cell times the slope of what enters, and no more."""
    system = VaryingSystem.of([["0*t"]], [[1.0]], 1.0, [["1 - t"]])
    with ctx.workprec(192):
        still, none, ends = [arb_mat(1, 1)], np.zeros((1, 1, 1, 1)), [0.0, 1.0]
        law = VerifiedFlow(Plant.of(system, 1.0), 1.0)
        loop = MeasurableLoop(system, [0.0], still, none, ends, ends, [], Box([-0.1], [0.1]), law=law)
        (bent,) = loop.bound_chord_error(0, 0.25, 0.375, np.array([[1.0]]))
        heights = [float(loop.highest(0, t, np.array([[1.0]]))[0].mid()) for t in (0.25, 0.3125, 0.375)]
    owed = 0.125**2 / 8.0 * 0.1
    assert heights[1] - (heights[0] + heights[2]) / 2.0 == pytest.approx(owed, rel=1e-9)
    assert owed <= bent <= owed * (1.0 + 1e-9)


def test_a_kernel_that_is_forgotten_leaves_no_radius_to_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """``x' = (t + 1/1000) w``: of every piece another, whether kernels of three pieces are kept or of all."""
    system, grid, found = VaryingSystem.of([["0*t"]], [[1.0]], 1.0, [["t + 0.001"]]), np.linspace(0, 1, 13), []
    with ctx.workprec(192):
        law = VerifiedFlow(Plant.of(system, 1.0), 1.0)
        still, none = [arb_mat(1, 1)], np.zeros((1, 1, 1, 1))
        for kept in (4096, 3):
            monkeypatch.setattr(measurable, "KEPT", kept)
            loop = MeasurableLoop(
                system, [0.0], still, none, grid.tolist(), [0.0, 1.0], [], Box([-0.1], [0.1]), law=law
            )
            found.append(loop.deviations.radii)
    exact = 0.1 * (np.diff(grid**2) / 2.0 + 0.001 * np.diff(grid))
    for radii in found:
        assert radii == pytest.approx(exact, rel=1e-9)
