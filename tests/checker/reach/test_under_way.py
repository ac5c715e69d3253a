"""Guards checker/reach/kernels: how far what inputs that enter at any time have done may be above its chord."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from flint import arb_mat, ctx

from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.reach.bounded_inputs import BoundedInputAt, SizedInput
from sparserob_core.checker.sets.known import summands_of
from sparserob_core.control.problem.system import System, VaryingSystem
from sparserob_core.control.sets.sets import Box
from tests.support.closed_loops import FAST, FORCE, GUST, Changing

H = np.array([[1.0, 0.0], [0.6, 0.8]])


def entering(system: System, law: VerifiedFlow, bound: Box) -> BoundedInputAt:
    """A measurable disturbance of a known system, in a set about 0."""
    summands = summands_of(bound)
    shares, ends = np.ones(len(summands)), np.array([0.0, law.until])
    return BoundedInputAt(law, SizedInput(shares, ends, [arb_mat(len(summands), 1, shares.tolist())], summands, 1))


def test_what_began_before_a_cell_bends_within_it() -> None:
    """Of what oscillates, and is pushed early only: later nothing enters that would bend it."""
    case = Changing(
        FAST, FORCE, GUST, np.array([0.0, 2.0]), np.array([0.0, 2.0]), np.zeros(2),
        Box([-0.1, -0.1], [0.1, 0.1]), rate="1 + 0*t", grown="t", factor="exp(-8*t)",
    )  # fmt: skip
    law, most = VerifiedFlow(Plant.of(case.system, 2.0), 2.0), 0.0
    with ctx.workprec(192):
        pushed = entering(case.system, law, Box([-0.1, -0.1], [0.1, 0.1]))
        for low, high in pairwise(law.marks([0.5, 1.25])):
            share = np.linspace(0.0, 1.0, 4)
            for c in H:
                values = np.array([np.mean(pushed.added(c, low + s * (high - low))) for s in share.tolist()])
                over = float((values - ((1.0 - share) * values[0] + share * values[-1])).max())
                assert over <= pushed.bound_chord_error(c, low, high) + 1e-12
                assert pushed.bound_chord_error(c, low, high) <= 0.2
                most = max(most, over)
    assert most > 1e-4, "nothing was bent"


def test_what_enters_less_and_less_is_above_its_chord_by_how_fast_that_falls() -> None:
    """``x' = (1 - t) w``: an eighth of the square of the cell times the slope of what enters, and no more."""
    system = VaryingSystem.of([["0*t"]], [[1.0]], 1.0, [["1 - t"]])
    with ctx.workprec(192):
        pushed = entering(system, VerifiedFlow(Plant.of(system, 1.0), 1.0), Box([-0.1], [0.1]))
        bent = pushed.bound_chord_error(np.ones(1), 0.25, 0.375)
        heights = [np.mean(pushed.added(np.ones(1), t)) for t in (0.25, 0.3125, 0.375)]
    owed = 0.125**2 / 8.0 * 0.1
    assert heights[1] - (heights[0] + heights[2]) / 2.0 == pytest.approx(owed, rel=1e-9)
    assert owed <= bent <= owed * (1.0 + 1e-9)
