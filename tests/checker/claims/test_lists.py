"""Guards checker/claims under disturbances of a list: on breakpoints of their own, of two classes, measurable beside a
system that changes with time; against a walk of our own in which whatever may jump is cut finely."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.claims import constraints, replay
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import Broken
from sparserob_core.control.problem.disturbances import join_disturbances
from sparserob_core.control.sets.sets import Box
from tests.support.worst_cases import (
    BEGUN,
    BOUND,
    CONTROL,
    DIRECTIONS,
    ENDS,
    HORIZON,
    START,
    A,
    B,
    C,
    E,
    Motion,
    Varying,
    kind,
)

FINE = np.arange(0.0, HORIZON, 1.0 / 64.0)
OWN = [np.array([0.0, 1.0, HORIZON]), np.array([0.0, 0.5, 1.5, HORIZON])]
U = kind("known").u
SETS = [Box(BOUND.lower[i : i + 1], BOUND.upper[i : i + 1]) for i in (0, 1)]
# how every channel may change: on these pieces, or at any time
LISTS: dict[str, list[np.ndarray | None]] = {
    "on own pieces": list(OWN),
    "of two classes": [ENDS, None],
    "of two classes, the other way round": [None, ENDS],
    "in time, measurable": [None, None],
}


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


def case_of(name: str, certificate: dict[str, Any] | None = None, **more: Any) -> Case:
    system = kind("varying" if name.startswith("in time") else "known").system
    if system.delay:
        system = system.with_delay(0.0)
    bound: Any = BOUND
    said: dict[str, Any] = {"disturbance_class": "measurable"}
    if not name.startswith("in time"):
        every = [
            sr.Disturbance(
                one, E[:, i : i + 1], "measurable" if pieces is None else "piecewise_constant",
                breakpoints=pieces if name == "on own pieces" else None,
            )
            for i, (one, pieces) in enumerate(zip(SETS, LISTS[name], strict=True))
        ]  # fmt: skip
        system, bound, kinds, own = join_disturbances(system, every, HORIZON)
        said = {"disturbance_class": kinds, "disturbance_breakpoints": own}
    given = {"control": CONTROL, "initial_set": BEGUN, "disturbance": bound, **said, **more}
    problem = sr.OptimalControlProblem(system=system, horizon=HORIZON, initial_state=START, **given)
    grid = sr.Dictionary.indicators(ENDS)
    return Case(problem, grid, grid, {"decision": U.tolist(), "status": "verified", **(certificate or {})})


def truth(name: str, rows: np.ndarray, time: float, u: np.ndarray = U) -> np.ndarray:
    """The worst case of every row: what is given to all cuts of a piece of its own is given to that piece."""
    moves = Varying if name.startswith("in time") else Motion
    motion = moves([(A, B, E, C)], [], START, ENDS, FINE)
    w = motion.weights(rows, time)
    total = w.free @ START + (w.control * u.T).sum(axis=(1, 2)) + w.drift + BEGUN.support(w.free)
    for channel, pieces in enumerate(LISTS[name]):
        blocks = w.blocks[:, :, channel]
        if pieces is not None:
            begins = np.searchsorted(FINE, pieces[:-1])
            blocks = np.add.reduceat(blocks, begins, axis=1)
        total = total + SETS[channel].support(blocks[..., None]).sum(axis=1)
    return total


@pytest.mark.parametrize("name", LISTS)
def test_a_row_at_one_time_is_exceeded_by_what_the_worst_case_does_then(name: str) -> None:
    limits = np.array([1.0, 2.0, 3.0, 4.0])
    case = case_of(name, path=[sr.PathConstraint(sr.Polytope(DIRECTIONS, limits), 0.25, 1.875)])
    order = [int(np.abs(DIRECTIONS - c[:2]).sum(axis=1).argmin()) for c, _ in case.windows[0].enclosed_set.facets]
    for time in (0.25, 0.8125, 1.875):
        said = {"constraint": "path", "time": time, "parameter": [], "violation": 0.0}
        found = np.array(replay.exceeded(case, said)[0])
        assert found == pytest.approx((truth(name, DIRECTIONS, time) - limits)[order], abs=1e-4)
        assert (found >= (truth(name, DIRECTIONS, time) - limits)[order] - 1e-10).all()  # cuts are fewer signals


@pytest.mark.parametrize("name", ["on own pieces", "of two classes", "in time, measurable"])
def test_a_wall_may_be_where_the_worst_case_is_and_no_nearer(name: str) -> None:
    start, stop = (0.25, 0.375) if name.startswith("in time") else (0.25, 1.875)
    when = np.arange(start, stop + 1e-9, 1.0 / 32.0)
    highest = np.array([truth(name, DIRECTIONS, float(t)) for t in when]).max(axis=0)
    proof = {"proof": {"path": {"tolerance": 1e-9, "lower": [[start]], "upper": [[stop]]}}}

    def bounded(limits: np.ndarray) -> str:
        case = case_of(name, proof, path=[sr.PathConstraint(sr.Polytope(DIRECTIONS, limits), start, stop)])
        return constraints.bounded(case, case.windows[0])

    assert "margin" in bounded(highest + 1e-2)
    for side in (0, 3) if name == "on own pieces" else (1,):
        with pytest.raises(Broken, match="exceeded"):
            bounded(highest + np.where(np.arange(4) == side, -1e-3, 1e-2))


@pytest.mark.parametrize("name", ["on own pieces", "in time, measurable"])
def test_a_witness_reaches_as_far_as_it_says(name: str) -> None:
    """Of a row that is missed by the worst case its own certificate tells the time and the direction."""
    highest = truth(name, DIRECTIONS, 1.25)
    wall = sr.PathConstraint(sr.Polytope(DIRECTIONS, highest - 0.125), 0.25, 1.875)
    told = {"constraint": "path", "time": 1.25, "direction": DIRECTIONS[2].tolist(), "parameter": []}
    if name == "on own pieces":
        motion = Motion([(A, B, E, C)], [], START, ENDS, np.array([0.0, 0.5, 1.0, 1.5]))
        w = motion.weights(DIRECTIONS[2:3], 1.25)
        signal = np.zeros((2, 5))
        joint = np.array([0.0, 0.5, 1.0, 1.25, 1.5])
        for channel, pieces in enumerate(OWN):
            begins = np.searchsorted([0.0, 0.5, 1.0, 1.5], pieces[:-1])
            given = np.add.reduceat(w.blocks[0, :, channel], begins)
            values = np.where(given > 0, BOUND.upper[channel], BOUND.lower[channel])
            signal[channel] = values[np.searchsorted(pieces, joint, side="right") - 1]
        told |= {"disturbance": signal.tolist(), "deviation": BEGUN.support_point(w.free)[0].tolist()}
    case = case_of(name, {"witness": told}, path=[wall])
    value, slack = replay.witnessed(case, told)
    assert float(value.mid()) == pytest.approx(0.125, abs=1e-4)
    assert 0.0 < slack < 1e-7
    if name == "on own pieces":
        assert float(value.mid()) == pytest.approx(0.125, abs=1e-12)
        forged = np.array(told["disturbance"])
        forged[0, 1] = BOUND.lower[0] + BOUND.upper[0] - forged[0, 1]  # one that may not jump there
        with pytest.raises(Broken):
            replay.witnessed(case, {**told, "disturbance": forged.tolist()})


def test_rows_of_the_bound_are_those_of_worst_cases_without_a_control() -> None:
    case = case_of("on own pieces")
    for time in (0.5, 1.25, 2.0):
        row = case.duality.row(DIRECTIONS[2], time, [], arb(0.375))
        idle = truth("on own pieces", DIRECTIONS[2:3], time, np.zeros((2, 3)))[0]
        assert float(row.constant.mid()) == pytest.approx(idle - 0.375, abs=1e-12)
