"""Guards control/response and what constraints make of it: violations and their bounds on cells, of systems that stand
still, drift, turn, answer late and change with time, against a walk of our own back through their pieces."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from sparserob_core.control.transcription.transcribe import prepare
from tests.support.worst_cases import BEFORE, DIRECTIONS, KINDS, kind, walls

LIMITS = np.array([1.0, 2.0, 1.5, 0.75])


@cache
def made(name: str, which: str) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """The family of a constraint, the decision of the known control, and times with the rows' heights there."""
    plant = kind(name)
    wall, times, heights = walls(name, which, plant)
    late = {"initial_control": BEFORE} if plant.motion.delay else {}
    case = plant.case(path=[wall(LIMITS)], **late)
    model = prepare(case.problem, case.control, case.disturbance)
    family = next(one for one in model.program.families if one.name == "path")
    x = np.zeros(model.program.n)
    x[: plant.u.size] = plant.u.ravel()
    return model, family, x, np.column_stack([times, heights])


FIRST = {("alone", "fixed"), ("known", "moving"), ("turning", "mixed"), ("late", "moving")}
EVERY = [
    pytest.param(name, which, marks=() if (name, which) in FIRST else pytest.mark.slow)
    for name in KINDS
    for which in ("fixed", "moving", "mixed")
]


def rows_of(family: Any) -> np.ndarray:
    """Where the rows of `DIRECTIONS` stand among those of the constraint, up to their scale."""
    flat = family.source
    scaled = flat.H / np.linalg.norm(flat.H, axis=1, keepdims=True)
    unit = DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
    return np.array([int(np.abs(scaled - row).sum(axis=1).argmin()) for row in unit])


@pytest.mark.parametrize(("name", "which"), EVERY)
def test_a_violation_is_that_of_the_worst_case(name: str, which: str) -> None:
    _, family, x, table = made(name, which)
    found = family.violations(x, table[:, :1])
    flat = family.source
    sizes = np.linalg.norm(flat.H[rows_of(family)], axis=1) / np.linalg.norm(DIRECTIONS, axis=1)
    truth = (table[:, 1:] - LIMITS) * sizes
    assert found.max(axis=1) == pytest.approx(truth.max(axis=1), abs=1e-9)
    if which != "mixed":
        assert found[:, rows_of(family)] == pytest.approx(truth, abs=1e-9)
    # the worst of all, and where
    highest = family.worst(x)
    assert highest.violations[0] >= truth.max() - 1e-9
    assert highest.violations[0] <= truth.max() + 0.02
    assert highest.bound >= highest.violations[0] - 1e-12


@pytest.mark.first(2)
@pytest.mark.parametrize(("name", "which"), EVERY)
def test_a_cell_is_bounded_by_no_less_than_the_worst_case_in_it(name: str, which: str) -> None:
    _, family, x, table = made(name, which)
    sizes = np.linalg.norm(family.source.H[rows_of(family)], axis=1) / np.linalg.norm(DIRECTIONS, axis=1)
    truth = ((table[:, 1:] - LIMITS) * sizes).max(axis=1)
    times = table[:, 0]
    for start, stop in list(zip(*(ends[:, 0] for ends in family.cells), strict=True))[:: 1 + (name == "varying")]:
        inside = (times > start) & (times < stop) | (which != "mixed") & (times >= start) & (times <= stop)
        low, high = np.array([[start]]), np.array([[stop]])
        bound = float(family.enclosure(x, low, high).bounds[0])
        if inside.any():
            assert bound >= truth[inside].max() - 1e-9
        for share in (0.25, 1e-4):
            middle = (start + stop) / 2
            cell = np.array([[middle - share * (stop - start) / 2]]), np.array([[middle + share * (stop - start) / 2]])
            ends = family.violations(x, np.vstack([*cell, [[middle]]])).max()
            bound = float(family.enclosure(x, *cell).bounds[0])
            assert ends - 1e-12 <= bound <= ends + 20.0 * (cell[1] - cell[0]).item() ** 2 + 3.0 * share**2 + 1e-9
