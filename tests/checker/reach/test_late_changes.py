"""Guards checker.reach.sources where changes of the control come late: their middle, their size, what they add in
balls; and checker.cost.duality, which puts linear functions in their place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flint import ctx
from scipy.integrate import quad
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.cost.duality import ConstraintRow

A, B = np.array([[0.0, 1.0], [-4.0, -0.3]]), np.array([[0.2, 0.0], [1.0, -0.7]])
CONTROL = np.array([[0.0, 0.8, -0.8, 0.0], [0.5, 0.5, 0.0, -0.2]])
JITTER, ENDS, C = 0.3, np.linspace(0.0, 3.0, 5), np.array([1.0, -0.4])
PLANTS: dict[str, Any] = {
    "constant": sr.LinearSystem(A, B),
    "in t": sr.LinearSystem(A, B).in_time(3.0),
    "pieces": sr.SwitchedSystem([(0.85, sr.LinearSystem(A, B)), (3.0, sr.LinearSystem(A, B))]),
}


def case_of(name: str) -> Case:
    problem = sr.OptimalControlProblem(
        system=PLANTS[name],
        horizon=3.0,
        initial_state=[-1.0, 0.3],
        control=sr.Box([-1.0, -1.0], [1.0, 1.0]),
        jitter=JITTER,
    )
    dictionary = sr.Dictionary.indicators(ENDS)
    return Case(problem, dictionary, dictionary, {"decision": CONTROL.tolist()})


def effect(time: float, channel: int, begin: float, end: float, size: bool) -> float:
    """``int c'Phi(t, s) B_j ds`` up to a time, or that of the absolute value."""

    def kernel(s: float) -> float:
        value = float(C @ expm(A * (time - s)) @ B[:, channel])
        return abs(value) if size else value

    return float(quad(kernel, begin, min(end, time), limit=400, epsabs=1e-11)[0]) if begin < time else 0.0


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("time", [0.9, 3.0])
def test_late_changes_add_half_of_themselves_while_they_are_late(name: str, time: float) -> None:
    with ctx.workprec(128):
        changes = case_of(name).sources.changes
        assert changes is not None
        low, high = changes.at([]).added(C, time)
        halves = np.abs(np.diff(CONTROL, axis=1)) / 2.0
        wanted = sum(
            halves[i, k] * effect(time, i, ENDS[k + 1], ENDS[k + 1] + JITTER, True) for i, k in np.ndindex(2, 3)
        )
    assert low - 1e-10 <= wanted <= high + 1e-10 and high - low <= 1e-9


@pytest.mark.parametrize("name", PLANTS)
def test_a_row_has_the_mean_of_what_may_be_delivered(name: str) -> None:
    with ctx.workprec(128):
        case, time = case_of(name), 2.9
        row = case.duality.row(C, time, [], ball(0.0))
        slope = np.array([[float(a) for a in entry] for entry in row.slope])
        value = float(row.constant) + float((slope * CONTROL.T).sum())
        inputs = np.array([[float(x) for x in u.entries()] for u in case.sources.find_means(case.pieces)]).T
    wanted = float(C @ expm(A * time) @ [-1.0, 0.3])
    for i, k in np.ndindex(2, 4):
        start, end = float(ENDS[k]), float(ENDS[k + 1])
        begin = start + (JITTER if k else 0.0)
        wanted += float(CONTROL[i, k]) * effect(time, i, begin, end, False)
        if k:
            wanted += float(CONTROL[i, k - 1] + CONTROL[i, k]) / 2.0 * effect(time, i, start, begin, False)
    assert value == pytest.approx(wanted, abs=1e-9)
    assert inputs[:, ::2] == pytest.approx(CONTROL)
    assert inputs[:, 1::2] == pytest.approx((CONTROL[:, 1:] + CONTROL[:, :-1]) / 2.0)


@pytest.mark.parametrize("factor", [0.0, 1.0, -1.0, 1e6])
def test_what_stands_in_place_of_changes_is_never_more_than_they_add(factor: float) -> None:
    rng = np.random.default_rng(3)
    with ctx.workprec(128):
        late = [rng.uniform(0.0, 1.0, (3, 2)) for _ in range(2)]
        rows = [(y, ConstraintRow(ball(0.0), [], late=sizes)) for y, sizes in zip((0.5, 2.0), late, strict=True)]
        sizes = 0.5 * late[0] + 2.0 * late[1]
        offered = factor * sizes.T
        row = case_of("constant").duality.bound_changes(rows, offered)
        slope = np.array([[float(a) for a in entry] for entry in row.slope])
    for _ in range(50):
        u = rng.uniform(-1.0, 1.0, (4, 2))
        added = float((sizes * np.abs(np.diff(u, axis=0))).sum() / 2.0)
        assert float((slope * u).sum()) <= added + 1e-12
    rising = np.arange(4.0)[:, None] * np.ones(2)
    assert float((slope * rising).sum()) == pytest.approx(min(factor, 1.0) * sizes.sum() / 2.0)
