"""Guards checker/claims: rows, bounds on constraints, replayed states and units of systems that turn, change, answer
late and drift, against a walk of our own through their pieces."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.claims import claims, constraints, replay, units
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import Broken
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid
from sparserob_core.sip.convex_set import Array, ConvexSet
from tests.support.worst_cases import Motion

HORIZON = 2.0
A = np.array([[0.0, 1.0], [-3.0, -0.4]])
OTHER = np.array([[-0.5, 2.0], [-1.0, 0.1]])
B, E = np.array([[0.3, 0.0], [1.0, -0.7]]), np.array([[0.4, 1.0], [-0.2, 0.5]])
C = np.array([0.25, -0.5])
START, BEFORE = np.array([0.5, -0.25]), np.array([0.7, -0.3])
ENDS, CHANGES = np.array([0.0, 0.5, 1.25, 2.0]), np.array([0.0, 0.75, 1.5])
BOUND, BEGUN = Box([-0.1, -0.3], [0.2, 0.1]), Ellipsoid([0.02, 0.0], [[0.01, 0.004], [0.004, 0.02]])
CONTROL = Box([-1.0, -2.0], [1.5, 0.5])
MOVING = np.array([[0.25, 0.5, 0.0], [1.0, -0.5, 0.75], [1.875, 0.25, -0.5]])
DIRECTIONS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.5, -1.25], [-0.75, -0.5]])
TIMES = np.arange(0.0, HORIZON + 1e-9, 1.0 / 32.0)


@dataclass(frozen=True, eq=False)
class Kind:
    """A problem, its case and the same motion here."""

    motion: Motion
    system: Any
    begun: ConvexSet | None
    bound: ConvexSet | None
    u: Array

    def case(self, certificate: dict[str, Any] | None = None, **more: Any) -> Case:
        late = {"initial_control": BEFORE} if self.motion.delay else {}
        given = {"disturbance": self.bound, "initial_set": self.begun, "control": CONTROL, **late, **more}
        problem = sr.OptimalControlProblem(
            system=self.system, horizon=HORIZON, initial_state=START, **given
        )  # fmt: skip
        said = {"decision": self.u.tolist(), "status": "verified", **(certificate or {})}
        grids = [sr.Dictionary.indicators(ends) for ends in (ENDS, [*CHANGES, HORIZON])]
        return Case(problem, *grids, said)

    def heights(self, time: float, rows: Array = DIRECTIONS) -> Array:
        return self.motion.heights(rows, time, self.u, self.bound, self.begun, BEFORE)

    @cached_property
    def sampled(self) -> Array:
        """At `TIMES`, ``(T, r)``."""
        return np.array([self.heights(float(t)) for t in TIMES])


@cache
def kind(name: str) -> Kind:
    legs, ends, delay = [(A, B, E, C)], list[float](), 0.0
    system: Any = LinearSystem(A, B, E, c=C)
    if name == "turning":
        legs, ends = [(A, B, E, C), (OTHER, B[::-1], E, -C), (A.T, B, 2.0 * E, C)], [0.625, 1.25]
        pieces = [(end, LinearSystem(*leg[:3], c=leg[3])) for end, leg in zip([*ends, HORIZON], legs, strict=True)]
        system = SwitchedSystem(pieces)
    if name == "late":
        delay = 0.375
        system = replace(system, delay=delay)
    if name == "alone":
        legs, system = [(A, B, E, 0.0 * C)], LinearSystem(A, B, E)
    motion = Motion(legs, ends, START, ENDS, CHANGES if name != "alone" else np.zeros(0), delay)
    u = np.array([[0.5, -1.0, 1.5], [-2.0, 0.25, -0.5]])
    return Kind(motion, system, None if name == "alone" else BEGUN, None if name == "alone" else BOUND, u)


KINDS = ("alone", "known", "turning", "late")


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


@pytest.mark.parametrize("name", KINDS)
def test_a_row_is_the_worst_case_of_every_control(name: str) -> None:
    made = kind(name)
    duality = made.case().duality
    for time in (0.0, 0.25, 0.5, 0.625, 0.7, 1.25, 1.3, 1.6, 2.0):
        row, limit = DIRECTIONS[2], 0.375
        exact = made.motion.weights(row[None], time)
        for disturbed in (True, False):
            found = duality.row(row, time, [], arb(limit), disturbed)
            slope = np.array([[float(x.mid()) for x in piece] for piece in found.slope])
            assert slope == pytest.approx(exact.control[0], abs=1e-13), (name, time)
            idle = replace(made, u=np.zeros((2, 3)), **({} if disturbed else {"bound": None, "begun": None}))
            assert float(found.constant.mid()) == pytest.approx(idle.heights(time, row[None])[0] - limit, abs=1e-13)
        pushed = [[float(x.mid()) for x in block] for block in duality.pushed(row, time)] if made.bound else []
        assert np.array(pushed).reshape(-1, 2) == pytest.approx(exact.blocks[0], abs=1e-13)
        assert [float(x.mid()) for x in duality.carried(row, time)] == pytest.approx(exact.free[0], abs=1e-13)


def test_what_is_carried_over_many_pieces_is_that_of_few(monkeypatch: pytest.MonkeyPatch) -> None:
    case = kind("turning").case()
    rows = []
    for leaps in (1, 2, 64):
        monkeypatch.setattr("sparserob_core.checker.claims.duality.LEAPS", leaps)
        rows.append(case.duality.row(DIRECTIONS[2], 1.6, [], arb(0)))
    for other in rows[1:]:
        assert (other.constant - rows[0].constant).contains(0)
        assert float(other.constant.rad()) < 1e-20


@pytest.mark.parametrize("name", KINDS)
def test_a_replayed_state_is_that_of_its_disturbance(name: str) -> None:
    made = kind(name)
    case = made.case()
    signal = np.array([[0.2, -0.1, 0.05], [-0.3, 0.1, 0.0]])
    deviation = np.array([0.05, -0.1])
    at_blocks = np.searchsorted(CHANGES, case.grid[:-1], side="right") - 1
    for time in (0.0, 0.3, 1.0, 1.75, 2.0):
        said = None if made.bound is None else signal[:, at_blocks].tolist()
        found = replay.reached(case, time, np.zeros(0), said, None if made.begun is None else deviation.tolist())
        w = made.motion.weights(np.eye(2), time)
        exact = w.free @ START + (w.control * made.u.T).sum(axis=(1, 2)) + w.before @ BEFORE + w.drift
        if made.bound is not None:
            exact = exact + (w.blocks * signal.T).sum(axis=(1, 2)) + w.free @ deviation
        assert [float(x.mid()) for x in found] == pytest.approx(exact, abs=1e-13)


def walls(name: str, which: str, made: Kind) -> tuple[Any, Array, Array]:
    """What makes a constraint of limits; the times of its window, and the highest rows at these, ``(T, r)``: on both
    sides of a jump of the control."""
    start, stop = 0.25, 1.875
    seen = (start <= TIMES) & (stop >= TIMES)
    inside, heights = TIMES[seen], made.sampled[seen]
    if which == "fixed":
        return lambda h: sr.PathConstraint(sr.Polytope(DIRECTIONS, h), start, stop), inside, heights
    if which == "moving":
        shift = np.stack([np.interp(inside, MOVING[:, 0], MOVING[:, i]) for i in (1, 2)], axis=1)
        at = heights - shift @ DIRECTIONS.T
        return lambda h: sr.PathConstraint(sr.Polytope(DIRECTIONS, h), start, stop, relative_to=MOVING), inside, at
    gains = np.array([[0.5, 0.0], [-0.25, 1.0], [0.0, -0.5], [1.0, 1.0]])
    beside = [
        made.u.T[np.clip(np.searchsorted(ENDS, inside, side=side) - 1, 0, 2)] @ gains.T for side in ("left", "right")
    ]
    return lambda h: sr.MixedConstraint(DIRECTIONS, gains, h, start, stop), inside, heights + np.maximum(*beside)


@pytest.mark.parametrize("which", ["fixed", "moving", "mixed"])
@pytest.mark.parametrize("name", KINDS)
def test_a_wall_may_be_where_the_worst_case_is_and_no_nearer(name: str, which: str) -> None:
    made = kind(name)
    wall, times, heights = walls(name, which, made)
    highest, i = heights.max(axis=0), (KINDS.index(name) + len(which)) % len(DIRECTIONS)
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[times[0]]], "upper": [[times[-1]]]}}}
    case = made.case(proof, path=[wall(highest + 5e-3)])
    assert "margin" in constraints.bounded(case, case.windows[0])
    near = highest + 5e-3
    near[i] = highest[i] - 1e-3
    case = made.case(proof, path=[wall(near)])
    with pytest.raises(Broken, match="exceeded"):
        constraints.bounded(case, case.windows[0])
    # row by row at one time
    case = made.case(proof, path=[wall(highest)])
    for k in (0, len(times) // 2, len(times) - 1):
        said = {"constraint": "path", "time": float(times[k]), "parameter": [], "violation": 0.0}
        found = np.array(replay.exceeded(case, said)[0]).reshape(-1, len(DIRECTIONS))
        order = [int(np.abs(DIRECTIONS - c[:2]).sum(axis=1).argmin()) for c, _ in case.windows[0].seen.facets]
        assert found.max(axis=0) == pytest.approx((heights[k] - highest)[order], abs=1e-12)


@pytest.mark.parametrize("name", KINDS)
def test_a_unit_is_no_more_than_a_row_reaches_however_few_numbers_are_held(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reach: the largest absolute value at the breakpoints within the window, of controls that jump at each."""
    made = kind(name)
    case = made.case(path=[sr.PathConstraint(sr.Polytope(DIRECTIONS, np.full(4, 1e6)), 0.5, 1.75)])
    nodes = np.array(sorted({*(t for t in case.grid if t < 1.75), 0.5, 1.75}))
    fine, waits = replace(made.motion, breakpoints=nodes, delay=0.0), nodes[:-1] < made.motion.delay
    reach = np.zeros(4)
    for t in nodes[nodes >= 0.5]:
        w = fine.weights(DIRECTIONS, float(t))
        known = w.free @ START + (w.control[:, waits] @ BEFORE).sum(axis=1) + w.drift
        for s in (1.0, -1.0):
            most = s * known + CONTROL.support(s * w.control[:, ~waits]).sum(axis=1)
            if made.bound is not None and made.begun is not None:
                most = most + made.bound.support(s * w.blocks).sum(axis=1) + made.begun.support(s * w.free)
            reach = np.maximum(reach, np.abs(most))
    facets = case.windows[0].seen.facets
    order = [int(np.abs(DIRECTIONS - c).sum(axis=1).argmin()) for c, _ in facets]
    found = case.units(case.windows[0])
    assert found.rows == pytest.approx(reach[order], rel=1e-12)
    sums = found.sums
    monkeypatch.setattr(units, "MOST_HELD", 1)
    again = made.case(path=case.problem.path).units(case.windows[0])
    assert again.rows == pytest.approx(found.rows, rel=1e-12)
    assert again.sums == pytest.approx(sums, rel=1e-12)
    assert claims.precision_of(case) >= claims.PRECISION
