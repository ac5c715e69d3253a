"""Guards the time that feedback takes beside the linear program that imposes the path at the breakpoints alone, as
HiGHS solves it by its interior point method, and as cvxpy states it for Clarabel: what proof over all times costs."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.experiment.assemble import ControlExperiment, assemble, tools_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.inner.simplex.counterpart import Counterpart
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.methods.own_units import solve_in_own_units
from tests.support.problems import spring

pytestmark = pytest.mark.benchmark

SPRING = spring(0.3, since=0.5)
TIMES_AS_LONG = 3.0  # at most: the goal is 1
BESIDE_CVXPY = {
    20: 6.0,
    40: 3.0,
    100: 1.0,
}  # times as long, at most: the goal is 1. Twice the ratios of docs/performance.md, for
# the two programs are slowed differently by what else a machine does
BESIDE_STATES = {20: 10.0, 40: 5.0, 100: 1.0}  # the same where the states are variables, which is sparser


def nodal(program: sr.SemiInfiniteProgram, pieces: int) -> tuple[float, float]:
    """Seconds of processor time for the program at the breakpoints, and its optimum in its own units."""
    assert program.spread is not None
    relaxed = Counterpart(program.finite, program.spread)
    for family in program.families:
        assert family.uncertain is not None and family.start is not None
        first, last = family.index_set.lower[0], family.index_set.upper[0]
        nodes = np.linspace(0.0, last, pieces + 1)[:, None]
        indices = family.start if family.name == "control" or first == last else nodes[nodes[:, 0] >= first]
        for index in indices:
            relaxed.add(family.uncertain(index))
    for name, value in {"solver": "ipm", "run_crossover": "off"}.items():
        relaxed._linear.highs.setOptionValue(name, value)
    started = time.process_time()
    found = relaxed.solve()
    assert found.solved, found.said
    return time.process_time() - started, program.cost(found.x)


def stated_in_cvxpy(pieces: int, with_states: bool) -> tuple[float, float]:
    """Seconds of processor time that cvxpy and Clarabel take for the spring in discrete time, and their optimum: the
    same policies, every constraint at the breakpoints alone, and nothing proven between them. Rows are products of all
    gains with the response, or of the states and responses, which are variables then, and recursions join them."""
    cp = pytest.importorskip("cvxpy", exc_type=ImportError)
    A, B, reach = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0], [1.0]]), 0.3
    h = 5.0 / pieces
    flow = expm(h * np.block([[A, B, np.eye(2)], [np.zeros((3, 5))]]))
    Phi, Gamma, driven = flow[:2, :2], flow[:2, 2:3], flow[:2, 3:]
    free, on_control, on_noise = [np.array([-1.0, 1.0])], [np.zeros((2, pieces))], [np.zeros((2, 2 * pieces))]
    pushes = [np.kron(one, driven) for one in np.eye(pieces)[:, None, :]]
    for k in range(pieces):
        free.append(Phi @ free[-1])
        on_control.append(Phi @ on_control[-1])
        on_noise.append(Phi @ on_noise[-1] + pushes[k])
        on_control[-1][:, [k]] += Gamma
    started = time.process_time()
    v, F = cp.Variable(pieces), cp.Variable((pieces, 2 * pieces))
    unseen = np.kron(np.triu(np.ones((pieces, pieces))), np.ones((1, 2)))
    stated = [cp.multiply(unseen, F) == 0, cp.abs(v) + reach * cp.sum(cp.abs(F), axis=1) <= 1.0]
    if with_states:
        x, y = cp.Variable(2 * pieces + 2), cp.Variable((2 * pieces + 2, 2 * pieces))
        stated += [x[:2] == free[0], y[:2] == 0]
        for k in range(pieces):
            now, then = slice(2 * k, 2 * k + 2), slice(2 * k + 2, 2 * k + 4)
            stated += [x[then] == Phi @ x[now] + Gamma[:, 0] * v[k]]
            stated += [y[then] == Phi @ y[now] + Gamma @ F[k : k + 1] + pushes[k]]

    def within(rows: list[tuple[int, int]], limit: float) -> None:
        if with_states:
            at = [2 * k + i for k, i in rows]
            nominal, answered = x[at], y[at]
        else:
            x0, a, b = (np.array([table[k][i] for k, i in rows]) for table in (free, on_control, on_noise))
            nominal, answered = x0 + a @ v, a @ F + b
        stated.append(cp.abs(nominal) + reach * cp.sum(cp.abs(answered), axis=1) <= limit)

    within([(k, 0) for k in range(pieces + 1) if k * h >= 0.5 - 1e-9], 0.7)
    within([(pieces, 0), (pieces, 1)], 0.3)
    posed = cp.Problem(cp.Minimize(h * cp.norm1(v)), stated)
    least = float(posed.solve(solver="CLARABEL"))
    return time.process_time() - started, least


@pytest.mark.parametrize("pieces", sorted(BESIDE_CVXPY))
def test_a_certified_policy_takes_no_longer_than_cvxpy_and_clarabel_at_the_breakpoints(pieces: int) -> None:
    config = {
        "problem": SPRING,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "policy": {"name": "affine"},
    }
    turns = range(2 if pieces < 100 else 1)
    theirs, least = min(stated_in_cvxpy(pieces, False) for _ in turns)
    sparser, again = min(stated_in_cvxpy(pieces, True) for _ in turns)
    seconds = []
    for _ in range(2):  # the first one imports, as the first of theirs does
        started = time.process_time()
        loaded = load_config(config)
        experiment = assemble(loaded)
        assert isinstance(experiment, ControlExperiment)
        result = solve_in_own_units(Exchange(), experiment.transcription.program, tools_of(loaded))
        seconds.append(time.process_time() - started)
    ours = min(seconds)
    print(
        f"{pieces} pieces: certified in {ours:.2f} s, cvxpy and Clarabel {theirs:.2f} s: {ours / theirs:.2f};"
        f" with states {sparser:.2f} s: {ours / sparser:.2f}"
    )
    assert result.status == "certified"
    assert again == pytest.approx(least, rel=1e-6)
    assert result.cost >= least * (1.0 - 1e-6)
    assert ours <= BESIDE_CVXPY[pieces] * theirs
    assert ours <= BESIDE_STATES[pieces] * sparser


@pytest.mark.parametrize("pieces", [40, 100])
def test_a_certified_policy_takes_about_as_long_as_the_program_at_the_breakpoints(pieces: int) -> None:
    loaded = load_config(
        {
            "problem": SPRING,
            "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
            "policy": {"name": "affine"},
        }
    )
    experiment = assemble(loaded)
    assert isinstance(experiment, ControlExperiment)
    program = experiment.transcription.program
    assert program.own_units is not None
    seconds, least = nodal(program.own_units.program, pieces)
    started = time.process_time()
    result = solve_in_own_units(Exchange(), program, tools_of(loaded))
    ours = time.process_time() - started
    print(f"{pieces} pieces: certified in {ours:.2f} s, at the breakpoints {seconds:.2f} s: {ours / seconds:.2f}")
    assert result.status == "certified"
    assert result.cost >= least * program.own_units.program.cost_unit * (1.0 - 1e-6)
    assert ours <= TIMES_AS_LONG * seconds
