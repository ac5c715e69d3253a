"""Guards who answers in sip/solver.py: a solver that is named answers every finite program, of every method;
where it does not, another one does, and whoever asks is told how often and why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.sip.inner.simplex.growing import GrowingProgram
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.solver import AccountedSolver, Auto, Failures, Named, Unanswered
from sparserob_core.testing.solvers import regularised, robust_terminal

REGISTRY = sr.load_registry()
PIQP = REGISTRY.build("solver", "piqp")
AUTO = REGISTRY.build("solver", "auto")
ROOT = Path(__file__).parents[2]


class Spied(sr.Solver):
    """PIQP, with the number of its ``calls``; every answer is ``changed``."""

    def __init__(self, changed=lambda claim: claim) -> None:
        self.calls, self.changed = 0, changed

    def solve(self, program, accuracy):
        self.calls += 1
        return self.changed(PIQP.solve(program, accuracy))


def refused(claim):
    raise ArithmeticError("not today")


def given_up(claim):
    return sr.Claim("failed", claim.x * np.nan, claim.z, claim.y, claim.z_box, "no memory")


def off(claim):
    return replace(claim, x=np.round(claim.x, 3), z=np.round(claim.z, 3), y=np.round(claim.y, 3))


def impossible(claim):
    return replace(given_up(claim), status="infeasible", message="PRIMAL_INFEASIBLE")


def problem(**more):
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(A=[[0, 1], [0, 0]], B=[[0], [1]]),
        horizon=5.0,
        initial_state=[4, 0],
        control=sr.Box([-1], [1]),
        disturbance=sr.Box([-0.02, -0.02], [0.02, 0.02]),
        terminal=[sr.Box([-0.5, -0.3], [0.5, 0.3])],
        **more,
    )


def solved(solver, **more):
    return sr.solve(problem(), control={"name": "piecewise_constant", "pieces": 10}, solver=solver, **more)


WAYS = {
    "exchange": {},
    "sparserob": {"method": {"name": "sparserob", "indices": 2}, "budget": 5},
    "sparsest": {"method": "sparsest"},
    "letters": {"method": {"name": "sparsest", "alphabet": [-1.0, 0.0, 1.0]}},
    "reweighted": {"method": "reweighted"},
    "scenario": {"method": {"name": "scenario", "scenarios": 20}},
    "nominal": {"method": "nominal"},
    "norms": {"regulariser": "smoothness"},
    "haar": {"control": {"name": "haar", "pieces": 16}},
    "feedback": {"policy": {"name": "affine"}},
}


@pytest.mark.first(5)
@pytest.mark.parametrize("way", WAYS)
def test_a_solver_that_is_named_answers_every_program(way):
    options = {"control": {"name": "piecewise_constant", "pieces": 10}, **WAYS[way]}
    spied = Spied()
    named, auto = sr.solve(problem(), solver=spied, **options), sr.solve(problem(), **options)
    assert dict(named.solved_by) == {"Spied": named.counts["relaxed_programs"]}
    assert spied.calls == named.counts["solver_calls"] >= max(1, named.counts["relaxed_programs"])
    assert not named.unanswered
    assert named.status == auto.status
    assert named.lower_bound == pytest.approx(auto.lower_bound, abs=1e-6)
    assert "Spied" not in auto.solved_by
    assert sum(auto.solved_by.values()) == auto.counts["relaxed_programs"]


@pytest.mark.first(3)
@pytest.mark.parametrize("policy", ["open_loop", "affine"])
@pytest.mark.parametrize(
    ("changed", "words"), [(refused, "ArithmeticError: not today"), (given_up, "no memory"), (impossible, "INFEASIBLE")]
)
def test_where_it_does_not_answer_another_one_does_and_the_reason_is_kept(changed, words, policy):
    result = solved(Spied(changed), policy=policy)
    assert result.status == "certified"
    assert result.cost == pytest.approx(solved("auto", policy=policy).cost, rel=1e-6)
    assert result.solved_by["Spied"] == 0
    assert sum(result.solved_by.values()) == sum(one.count for one in result.unanswered)
    assert {one.kind for one in result.unanswered} == {"relaxed" if policy == "open_loop" else "feedback"}
    assert all(words in one.reason for one in result.unanswered)


def test_an_answer_that_newton_s_method_had_to_mend_is_not_the_solver_s():
    result = solved(Spied(off))
    assert result.status == "certified"
    mended = sum(one.count for one in result.unanswered if one.by == "dual_newton")
    assert mended == result.solved_by["dual_newton"] > 0
    assert any("misses its rows by" in one.reason for one in result.unanswered)
    assert sum(result.solved_by.values()) == result.counts["relaxed_programs"]


def test_the_solver_of_auto_is_asked_for_what_is_left_and_counts_under_its_name():
    program = regularised(robust_terminal(), 1e-2)
    first = solve_finite(program, REGISTRY.build("solver", "auto", {"general": "clarabel"}))
    assert first.by == "clarabel"
    assert solve_finite(program, AUTO, guess=first).by == "dual_newton"
    assert solve_finite(program, Named(PIQP, "mine", AUTO), guess=first).by == "mine"
    assert AccountedSolver.of(AUTO).instead is None


@pytest.mark.parametrize("inner", ["auto", {"name": "auto"}])
def test_auto_does_not_ask_itself(inner):
    with pytest.raises(sr.InputError, match="general: expected a solver that answers by itself, got auto"):
        REGISTRY.build("solver", "auto", {"general": inner})
    with pytest.raises(sr.InputError, match="answers by itself"):
        Auto(general=AUTO)


def test_a_named_solver_that_goes_on_losing_is_asked_a_few_times_and_no_more():
    """A first-order method takes long for each answer that nobody believes; norms and more digits asked it hundreds."""
    lost = Spied(lambda claim: replace(off(claim), status="failed"))
    for norms in ({}, {"group": "all"}):
        spied = Spied(lost.changed)
        cost = sr.Cost(**norms) if norms else None
        plane = sr.OptimalControlProblem(
            system=sr.LinearSystem(A=np.zeros((2, 2)), B=np.eye(2)),
            horizon=2.0,
            initial_state=[1.0, 0.7],
            control=sr.Box([-1, -1], [1, 1]),
            disturbance=sr.Box([-0.02, -0.02], [0.02, 0.02]),
            terminal=[sr.Box([-0.2, -0.2], [0.2, 0.2])],
            **({} if cost is None else {"cost": cost}),
        )
        result = sr.solve(plane, control={"name": "haar", "pieces": 8}, solver=spied)
        assert result.status == "certified"
        assert sum(one.count for one in result.unanswered) > 0
        assert spied.calls <= 6 * result.counts["relaxed_programs"]


@pytest.mark.parametrize("policy", ["open_loop", "affine"])
def test_whoever_answers_in_its_place_is_logged_as_it_happens(policy, caplog):
    result = solved(Spied(given_up), policy=policy)
    told = [record.getMessage() for record in caplog.records if record.name == "sparserob"]
    assert len(told) == len({(one.kind, one.by) for one in result.unanswered}), "once for each kind"
    for one in result.unanswered:
        assert any(f"solver Spied did not answer a {one.kind} program, {one.by} did:" in text for text in told)


def test_an_account_that_is_resumed_or_a_worker_s_is_not_logged_again(caplog):
    known = Failures("mine")
    known.resume(3, [Unanswered("relaxed", 2, "no digits", "piqp")])
    known.add("relaxed", "no digits", "piqp")
    known.without_log().add("feedback", "no digits", "highs")
    assert not caplog.records
    assert sum(one.count for one in known) == 4


def test_reasons_that_differ_in_numbers_alone_are_one_and_what_is_new_can_be_told():
    failures = Failures()
    failures.add("relaxed", "stopped after 12 steps, residual 1.5e-3", "piqp")
    before = tuple(failures)
    failures.add("relaxed", "stopped after 7 steps, residual 2e-09", "piqp")
    failures.add("feedback", "stopped after 7 steps, residual 2e-09", "highs")
    assert next((one.count, one.reason) for one in failures) == (2, "stopped after 12 steps, residual 1.5e-3")
    assert [(one.kind, one.count) for one in failures.since(before)] == [("relaxed", 1), ("feedback", 1)]


def test_a_growing_program_forgets_the_limit_of_the_call_before():
    rng, growing, n = np.random.default_rng(0), GrowingProgram(), 40
    growing.variables(np.full(n, -2.0), np.full(n, 2.0), rng.normal(size=n))
    table = rng.normal(size=(60, n))
    row, column = np.nonzero(table)
    growing.rows([(row, column, table[row, column])], np.full(60, -1.0), np.full(60, 1.0))
    assert "Time limit" in growing.solve(seconds=0.0)[1]
    first = np.zeros(1, dtype=int)
    growing.rows([(first, first, np.ones(1))], np.array([-np.inf]), np.array([-0.01]))
    assert growing.solve()[0]


@pytest.mark.parametrize("seed", range(3))
def test_a_growing_program_has_the_same_answer_by_whoever_is_asked(seed):
    rng = np.random.default_rng(seed)
    n, r = 6, 5
    table, inside = rng.normal(size=(r, n)) * 10.0 ** rng.integers(-2, 3, (r, 1)), rng.uniform(-1, 1, n)
    cost, middle = 50.0 * rng.normal(size=n), table @ inside
    low, high = middle - [0, 1, np.inf, 0.5, 0.1], middle + np.array([0, 0.2, 0.3, np.inf, 0.1])
    asked = AccountedSolver.of(Named(PIQP, "mine", AUTO))
    answers = []
    for who in (None, asked):
        growing = GrowingProgram(who)
        growing.variables(np.full(n, -2.0), np.full(n, 2.0), cost)
        row, column = np.nonzero(table)
        growing.rows([(row, column, table[row, column])], low, high)
        done, _, x, multipliers = growing.solve()
        assert done
        answers.append((x, multipliers))
        assert growing.by == ("highs" if who is None else "mine")
    np.testing.assert_allclose(answers[1][0], answers[0][0], atol=1e-6)
    np.testing.assert_allclose(answers[1][1], answers[0][1], atol=1e-4 * np.abs(answers[0][1]).max())
    rows = np.vstack([table[np.isfinite(high)], -table[np.isfinite(low)]])
    sides = np.concatenate([high[np.isfinite(high)], -low[np.isfinite(low)]])
    assert cost @ answers[1][0] == pytest.approx(linprog(cost, rows, sides, bounds=(-2.0, 2.0)).fun, abs=1e-6)
