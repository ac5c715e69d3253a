"""Guards checker/problem/integrals.py by a plant whose integrals are known by hand, and beside the states that a
transcription makes of the same records.

``x' = u + w``, ``x(0) = 1``, two pieces of length 1, ``u = (0.5, -0.5)``, ``|w| <= 0.25``: ``int x = 2.5 +- 0.5``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flint import ctx

import sparserob_core as sr
from sparserob_core.checker.claims import constraints
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.outcome import Broken
from sparserob_core.checker.problem.integrals import integrating
from sparserob_core.control.transcription.terms.accumulated import integrals_as_states

TOO_MUCH, NOTHING = 5e-9, 3e-10
ONE = np.ones((1, 1))


def case_of(integral: sr.IntegralConstraint, delay: float = 0.0) -> Case:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.zeros((1, 1)), ONE, E=ONE, delay=delay),
        horizon=2.0,
        initial_state=[1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.25], [0.25]),
        integral=[integral],
    )
    grid = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    stop = integral.stop or 2.0
    end = min(2.0, stop + delay) if integral.G is not None else stop
    proof = {"tolerance": 1e-9, "lower": [[end]], "upper": [[end]]}
    said = {"decision": [[0.5, -0.5]], "status": "verified", "proof": {"integral": proof}}
    return Case(problem, grid, grid, said)


KNOWN = {
    "state": (sr.IntegralConstraint(H=ONE), 3.0, 0.0),
    "state later": (sr.IntegralConstraint(H=ONE, start=1.0), 1.625, 0.0),
    "state for a while": (sr.IntegralConstraint(H=ONE, start=0.5, stop=1.0), 1.375 / 2 + 0.25 * 0.375, 0.0),
    "control": (sr.IntegralConstraint(G=2 * ONE, stop=1.5), 0.5, 0.0),
    "both": (sr.IntegralConstraint(H=ONE, G=2 * ONE, stop=1.0), 2.375, 0.0),
    "commanded": (sr.IntegralConstraint(G=2 * ONE, stop=1.5), 0.5, 0.5),
    "both, late": (sr.IntegralConstraint(H=ONE, G=2 * ONE, stop=1.0), 1.0 + 0.0625 + 0.125 + 1.0, 0.5),
}


@pytest.mark.parametrize("name", KNOWN)
def test_an_integral_holds_up_to_where_the_worst_disturbance_takes_it(name: str) -> None:
    integral, worst, delay = KNOWN[name]
    with ctx.workprec(96):
        for size in (1.01 * worst, worst / (1 + NOTHING)):
            case = case_of(replace(integral, upper=size), delay)
            constraints.bounded(case, case.windows[0])
        for size in (worst / (1 + TOO_MUCH), 0.99 * worst):
            case = case_of(replace(integral, upper=size), delay)
            with pytest.raises(Broken):
                constraints.bounded(case, case.windows[0])


def problem_of(**more: object) -> sr.OptimalControlProblem:
    given: dict[str, object] = {
        "system": sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]], c=[0.0, 0.1]),
        "horizon": 5.0,
        "initial_state": [-1.0, 1.0],
        "control": sr.Box([-1.0], [1.0]),
        "path": [sr.Box([-0.7, -np.inf], [0.7, np.inf]), sr.PathConstraint(sr.Ellipsoid([0, 0], np.eye(2)), 1.0)],
        "terminal": [sr.Equality([np.nan, 0.0])],
        "cost": sr.Cost(state={"Q": np.eye(2)}),
        "names": sr.Names(states=["p", "v"], state_units=["m", "m/s"], control_units=["N"], time="s"),
        "integral": [
            sr.IntegralConstraint(H=[[1, 0], [0, 1]], lower=[-1, None], upper=[None, 2], start=0.5, stop=2.0),
            sr.IntegralConstraint(H=[[0, 1]], G=[[1]], upper=3, stop=4.0, name="effort"),
        ],
        **more,
    }
    return sr.OptimalControlProblem(**given)  # type: ignore[arg-type]


SYSTEMS: dict[str, dict[str, object]] = {
    "known": {},
    "late": {"system": sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]], delay=0.25)},
    "uncertain": {
        "system": sr.LinearSystem(lambda p: [[0, 1], [p[0], -0.5]], [[0], [1]], parameters=sr.Box([-2.0], [-1.0])),
        "initial_set": sr.Ellipsoid([0, 0], 0.01 * np.eye(2)),
    },
    "pieces": {
        "system": sr.SwitchedSystem(
            [(2.0, sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]])), (5.0, sr.LinearSystem(-np.eye(2), [[0], [2]]))]
        ),
        "initial_set": sr.Box([-0.1, 0.0], [0.1, 0.0]),
    },
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_it_makes_the_same_states_of_the_same_records_as_a_transcription(name: str) -> None:
    problem = problem_of(**SYSTEMS[name])
    mine, theirs = integrating(problem), integrals_as_states(problem)
    assert mine.system.switches == theirs.system.switches and mine.system.delay == theirs.system.delay
    for one, other in zip(mine.system.forced.modes, theirs.system.forced.modes, strict=True):
        at = one.probes
        assert all(np.array_equal(a, b) for a, b in zip(one.matrices(at), other.matrices(at), strict=True))
    assert np.array_equal(mine.initial_state, theirs.initial_state)
    d, axes = mine.system.states, np.vstack([np.eye(mine.system.states), np.ones(mine.system.states)])
    for one, other in zip(mine.path, theirs.path, strict=True):
        assert (one.name, one.start, one.stop) == (other.name, other.start, other.stop)
        assert np.array_equal(one.set.support(axes[:d]), other.set.support(axes[:d]))
    if mine.initial_set is not None:
        assert np.allclose(mine.initial_set.support(axes), theirs.initial_set.support(axes), rtol=1e-15)
    assert np.array_equal(mine.terminal[0].values, theirs.terminal[0].values, equal_nan=True)
    assert np.array_equal(mine.cost.terms[0].Q, theirs.cost.terms[0].Q)
    assert np.array_equal(mine.measurements.C, theirs.measurements.C)
    assert mine.names == theirs.names
