"""Guards checker/program/rows: the largest violation of several rows that are bounded together, above dense samples and
close, and the refusal of one row that is violated by little somewhere."""

from __future__ import annotations

import numpy as np
import pytest
from flint import ctx

from sparserob_core.checker.outcome import Broken, Clock
from sparserob_core.checker.program.rows import bound_violation
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import Decisions

LIMIT = 1e-9
WAVE = "sum(a[k]*cos((3*k + 1)*t + {}) for k in range(3))"


def bound(x: list[float], *rows: str, **index: tuple[float, float]) -> float:
    with ctx.workprec(96):
        family = ExpressionRows.parse(index or {"t": (0.0, 2.0)}, rows, Decisions({"a": len(x)}), {})
        return bound_violation(family, np.array(x), LIMIT, Clock(60.0))


def highest(x: list[float], *shifts: float) -> float:
    """The largest value of waves at dense samples."""
    t, k = np.linspace(0.0, 2.0, 200_001)[:, None], np.arange(3)
    return max(float((np.cos((3 * k + 1) * t + shift) @ np.array(x)).max()) for shift in shifts)


@pytest.mark.parametrize("order", [(0.0, 1.0, 2.0), (2.0, 1.0, 0.0), (1.0, 0.0, 2.0)])
@pytest.mark.parametrize("excess", [-1e-3, 0.0, 3e-10])
def test_the_bound_is_that_of_the_worst_row_wherever_it_stands(order: tuple[float, ...], excess: float) -> None:
    x = [0.7, -0.4, 0.2]
    top = highest(x, *order) - excess
    found = bound(x, *(f"{WAVE.format(shift)} <= {top!r}" for shift in order))
    assert excess - 1e-10 <= found <= max(excess + 1e-10, LIMIT / 50)


@pytest.mark.parametrize("order", [(0.0, 1.0, 2.0), (2.0, 1.0, 0.0), (1.0, 0.0, 2.0)])
def test_one_row_that_is_violated_by_little_is_found(order: tuple[float, ...]) -> None:
    x = [0.7, -0.4, 0.2]
    for shift in order:
        tops = [highest(x, other) - (2e-9 if other == shift else 0.0) for other in order]
        with pytest.raises(Broken, match="is violated by"):
            bound(x, *(f"{WAVE.format(other)} <= {top!r}" for other, top in zip(order, tops, strict=True)))


def test_rows_that_need_cells_of_their_own_are_bounded_on_all_of_them() -> None:
    """Two sharp peaks at different ends: both rows stay open on the first halves, and each on one of the second."""
    rows = [f"a[0]/(1 + 400*(t - {place})^2) <= {{}}" for place in (0.3, 1.7)]
    assert bound([1.0], *(row.format(1.0) for row in rows)) <= 1e-11
    for tops in ((1.0, 1.0 - 2e-9), (1.0 - 2e-9, 1.0)):
        with pytest.raises(Broken):
            bound([1.0], *(row.format(repr(top)) for row, top in zip(rows, tops, strict=True)))


def test_two_coordinates_are_bounded_together_too() -> None:
    index = {"s": (0.0, 1.0), "t": (0.0, 1.0)}
    rows = ["a[0]*sin(3*s + t) <= 1.01", "a[0]*cos(s - 0.4)*cos(t - 0.7) <= 1", "a[0]*s*t <= 1"]
    assert 0.0 <= bound([1.0], *rows, **index) <= 1e-11
    with pytest.raises(Broken, match=r"cos\(s - 0.4\)"):
        bound([1.0 + 3e-9], *rows[:2], **index)
