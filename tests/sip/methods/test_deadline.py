"""Guards sip/method (deadline) and sip/working/ledger: a method that runs out of time or is interrupted returns what it
knows, and claims no more than that; bounds that cross are an alarm."""

from __future__ import annotations

import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.evidence import Cut, Dual
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.program import Enclosure
from sparserob_core.sip.proof.branch_and_bound import prove_family
from sparserob_core.sip.result import relative_gap
from sparserob_core.sip.working.ledger import alarm

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
KNOWN = ("verified", "refuted", "undecided")


def slow_family(pause=0.02, width=1.0, **more):
    """``x >= t`` for t in [0, 1], whose enclosure takes its time and is never tight."""

    def enclosure(x, lower, upper):
        time.sleep(pause * len(lower))
        return Enclosure(upper[:, 0] - x[0] + width, np.zeros(len(lower), dtype=int))

    return sr.ConstraintFamily(
        name="slow",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (-np.ones((len(t), 1, 1)), -t),
        enclosure=enclosure,
        **more,
    )


def test_a_proof_ends_at_the_deadline_and_says_what_is_left():
    started = time.monotonic()
    proof = prove_family(slow_family(), np.array([1.0]), deadline=Deadline(0.5))
    assert time.monotonic() - started < 3.0
    assert proof.verdict == "undecided"
    assert proof.cells > 10
    assert "cells were left" in proof.reason


def test_a_proof_whose_time_is_over_looks_at_every_family_once():
    over = Deadline(1e-9)
    time.sleep(0.01)
    assert over.passed
    easy = replace(slow_family(), enclosure=lambda x, lower, upper: Enclosure(upper[:, 0] - x[0], np.zeros(1, int)))
    assert prove_family(easy, np.array([1.0]), deadline=over).verdict == "proven"
    assert prove_family(easy, np.array([0.4]), deadline=over).verdict == "refuted"
    assert prove_family(slow_family(0.001), np.array([1.0]), deadline=over).verdict == "undecided"


def blunt_program(asked=lambda x: None, excess=1e-4):
    """The least ``x >= t`` for t in [0, 1], by an enclosure that is ``excess`` above what it encloses."""

    def enclosure(x, lower, upper):
        asked(x)
        return Enclosure(upper[:, 0] - x[0] + excess, np.zeros(len(lower), dtype=int))

    family = replace(slow_family(), enclosure=enclosure)
    return sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=9.0, families=[family])


def test_a_decision_away_from_the_constraints_is_proven_where_the_optimum_cannot_be():
    result = sr.solve(blunt_program(), method="exchange", solver="piqp")
    assert result.status == "verified"
    assert result.lower_bound <= 1.0 + 1e-9 and abs(result.lower_bound - 1.0) < 1e-6
    assert 1.0 + 1e-4 <= result.upper_bound <= 1.01
    assert result.cost == result.upper_bound == result.decision[0]


def hidden_program(upper):
    """The least ``x >= 1 + 4e-4 t`` for t in [0, 1], at most ``upper``; only t = 0 is seen as long as that is
    violated."""

    def worst(x):
        at = np.array([[0.0 if x[0] < 0.9999 else 1.0]])
        violation = 1.0 + 4e-4 * at[:, 0] - x[0]
        return sr.Separation(at, np.zeros(1, dtype=int), violation)

    family = sr.ConstraintFamily(
        name="hidden",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (-np.ones((len(t), 1, 1)), -1.0 - 4e-4 * t),
        worst=worst,
        enclosure=lambda x, lower, upper: Enclosure(1.0 + 4e-4 * upper[:, 0] - x[0], np.zeros(len(lower), dtype=int)),
    )
    return sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=upper, families=[family])


@pytest.mark.parametrize(
    ("upper", "least", "seconds"), [(9.0, 1.0022, 600.0), (1.0018, 1.0014, 600.0), (9.0, 1.0022, None)]
)
def test_what_little_would_pay_for_is_proven_at_once(upper, least, seconds):
    """A thousandth away, and twice what was missed where there is room for that; with a limit and without one."""
    result = sr.solve(hidden_program(upper), method="exchange", solver="piqp", seconds=seconds)
    assert result.status == "certified"
    assert result.cost == pytest.approx(1.0004, abs=1e-6)
    assert [event.proven for event in result.history][:2] == [np.inf, np.inf]
    assert result.history[2].proven == pytest.approx(least, abs=2e-5)


def test_without_a_limit_a_decision_that_is_proven_next_is_not_proven_before_as_well():
    looked = []
    result = sr.solve(blunt_program(lambda x: looked.append(float(x[0])), 0.0), method="exchange", solver="piqp")
    assert result.status == "certified"
    assert len(looked) == 1


def test_where_cells_are_dear_and_no_farther_one_will_do_a_tenth_of_the_cost_is_paid():
    """Between a decision that takes ten times the cells of a second look, and one that is out of reach."""
    looked = []

    def enclosure(x, lower, upper):
        looked.append(float(x[0]))
        if x[0] < 1.0005 and max(looked) > 1.05:
            raise KeyboardInterrupt
        return Enclosure(upper[:, 0] - x[0] + 400.0 * (upper - lower)[:, 0], np.zeros(len(lower), dtype=int))

    family = replace(slow_family(), enclosure=enclosure)
    program = sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=1.15, families=[family])
    result = sr.solve(program, method="exchange", solver="piqp")
    assert result.status == "verified"
    assert 1.09 <= result.upper_bound <= 1.11


def test_what_is_refuted_when_the_time_is_over_says_what_would_help():
    def endless(seconds):
        looked = []

        def worst(x):  # a later index each time, so that the rounds go on
            looked.append(min(1.0, 0.02 * (len(looked) + 1.0)))
            time.sleep(0.01)
            if seconds is None and len(looked) > 3:
                raise KeyboardInterrupt
            at = np.array([[looked[-1]]])
            return sr.Separation(at, np.zeros(1, dtype=int), at[:, 0] - x[0])

        family = replace(slow_family(), enclosure=None, worst=worst)
        program = sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=9.0, families=[family])
        return sr.solve(program, method="exchange", solver="piqp", seconds=seconds)

    limited, pressed = endless(0.3), endless(None)
    assert (limited.status, pressed.status) == ("refuted", "refuted")
    assert limited.message.endswith("the limit of 0.3 s is reached; more seconds (limits.seconds) would help")
    assert pressed.message.endswith("interrupted from the keyboard")


def test_an_interrupt_returns_the_decision_that_was_proven_before():
    looked = []

    def asked(x):
        looked.append(float(x[0]))
        if x[0] < 1.0 + 5e-5 and max(looked) > 1.0 + 1e-4:  # the optimum, when the other has been proven
            raise KeyboardInterrupt

    result = sr.solve(blunt_program(asked), method="exchange", solver="piqp")
    assert (result.status, result.stopped) == ("verified", "interrupted from the keyboard")
    assert 1.0 + 1e-4 <= result.upper_bound <= 1.01


def test_an_interrupt_of_a_proof_leaves_it_undecided_and_is_remembered():
    def pressed(x, lower, upper):
        raise KeyboardInterrupt

    time_left = Deadline()
    proof = prove_family(replace(slow_family(), enclosure=pressed), np.array([1.0]), deadline=time_left)
    assert (proof.verdict, time_left.reason) == ("undecided", "interrupted from the keyboard")
    with pytest.raises(OutOfTime, match="interrupted from the keyboard"):
        time_left.check()


def test_the_progress_of_a_proof_that_does_not_advance_says_what_hinders_it(monkeypatch):
    monkeypatch.setattr("sparserob_core.sip.proof.branch_and_bound.STALLED", 0.05)
    heard = []
    prove_family(
        slow_family(0.003, hindrance=lambda lower, upper: f"the cell is {upper[0] - lower[0]:g} wide"),
        np.array([1.0]),
        heard.append,
        cells=100,
    )
    assert np.isnan(heard[0].bound_before)
    assert not heard[0].hindrance
    stuck = [event for event in heard if event.hindrance]
    assert stuck
    assert all(event.bound >= 0.99 * event.bound_before for event in stuck)
    assert "wide" in stuck[-1].hindrance
    assert "slow" in stuck[-1].hindrance


@pytest.mark.parametrize("method", ["exchange", pytest.param("nominal", marks=pytest.mark.slow)])
def test_a_limit_returns_the_decision_with_what_was_proven_of_it(method):
    family = slow_family(0.02)
    program = sr.SemiInfiniteProgram(n=1, q=[1.0], lower=-5.0, upper=5.0, families=[replace(family, nominal=family)])
    started = time.monotonic()
    result = sr.solve(program, method=method, seconds=4.0)
    assert time.monotonic() - started < 20.0
    assert result.status == "undecided"
    assert result.stopped == "the limit of 4 s is reached"
    assert result.message.endswith(result.stopped)
    assert result.decision == pytest.approx([1.0], abs=1e-6)
    assert result.lower_bound == pytest.approx(1.0, abs=1e-6)
    assert (result.upper_bound, result.gap) == (np.inf, np.inf)


def test_a_limit_that_is_over_before_anything_was_solved_returns_without_a_decision():
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=1.0), seconds=1e-9)
    assert (result.status, result.decision) == ("undecided", None)
    assert "before there was a decision" in result.message
    assert result.lower_bound == -np.inf


@pytest.mark.parametrize("when", ["before the first program", "before the first round"])
def test_a_limit_under_feedback_leaves_what_is_known(when, monkeypatch):
    from sparserob_core.sip.methods import exchange
    from sparserob_core.sip.working.robust import RobustRows

    system = sr.LinearSystem(A=[[-1.0]], B=[[1.0]])
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=2.0,
        initial_state=[1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.1], [0.1]),
        terminal=[sr.Box([-0.1], [0.1])],
    )
    policy = sr.AffinePolicy(causal_signals=0)

    def solve():
        return sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4}, policy=policy)

    certified = solve()
    assert certified.status == "certified" and certified.lower_bound > 0.0

    def over(*_, **__):
        raise OutOfTime("the time is over")

    first = when == "before the first program"
    monkeypatch.setattr(*((RobustRows, "relax") if first else (exchange, "separate")), over)
    result = solve()
    assert result.stopped == "the time is over"
    if first:
        assert (result.status, result.decision, result.upper_bound) == ("undecided", None, np.inf)
        assert result.lower_bound == 0.0  # of an L1 norm that much is known
    else:  # the only relaxed program, looked at once
        assert result.decision is not None
        assert result.lower_bound == pytest.approx(certified.cost, rel=1e-3)


def test_a_limit_before_a_control_is_in_its_set_is_no_failure(monkeypatch):
    """The first relaxed program knows the round set of controls by few tangents, and peaks beyond it are no decision
    that is missed by its own bounds."""
    from sparserob_core.sip.methods import exchange

    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A=[[0.0, 1.0], [-1.0, -0.2]], B=[[0.4, 0.0], [0.0, 1.0]]),
        horizon=5.0,
        initial_state=[-1.0, 1.0],
        control=sr.NormBall(2, 0.5, [0.0, 0.0]),
        disturbance=sr.NormBall(2, 0.1, [0.0, 0.0]),
        terminal=[sr.Box([-0.2, -0.2], [0.2, 0.2])],
    )
    rounds, separated = [], exchange.separate

    def over(*arguments):
        if len(rounds) == 2:
            raise OutOfTime("the time is over")
        rounds.append(arguments)
        return separated(*arguments)

    monkeypatch.setattr(exchange, "separate", over)
    policy = sr.AffinePolicy(cost="peak", causal_signals=0)
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 6}, policy=policy)
    assert result.stopped == "the time is over"
    assert result.status in ("refuted", "undecided"), result.message
    assert np.isfinite(result.cost) and result.upper_bound == np.inf


@pytest.mark.slow
def test_a_single_step_that_takes_long_is_ended_too():
    def worst(x):
        time.sleep(30.0)
        raise AssertionError("it was not ended")

    family = replace(slow_family(0.0), worst=worst, enclosure=None)
    started = time.monotonic()
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], lower=-5.0, upper=5.0, families=[family]), seconds=2.0)
    assert time.monotonic() - started < 15.0
    assert (result.status, result.stopped) == ("undecided", "the limit of 2 s is reached")
    assert result.decision == pytest.approx([-5.0]), "of the relaxed program without rows"
    assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL


@pytest.mark.parametrize("seconds", [0, -1.0, np.inf, np.nan, "60", True])
def test_a_limit_that_is_no_positive_number_is_refused(seconds):
    with pytest.raises(sr.InputError, match="seconds: expected a positive number"):
        sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=1.0), seconds=seconds)


@pytest.mark.parametrize("rounds", [1, 2])
def test_an_interrupt_in_a_round_returns_the_decision_of_the_round_before(rounds):
    class Pressed(Exception):
        pass

    calls = []

    def rows(t):
        return -np.ones((len(t), 1, 1)), -t

    def worst(x):
        calls.append(x)
        if len(calls) > rounds:
            raise KeyboardInterrupt
        index = np.array([[min(1.0, 0.5 * len(calls))]])
        return sr.Separation(index, np.array([0]), index[:, 0] - x)

    family = sr.ConstraintFamily(name="above", index_set=sr.Box([0.0], [1.0]), rows=rows, worst=worst)
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], lower=-5.0, upper=5.0, families=[family]))
    assert result.status == "refuted", "the search had found a violated index"
    assert result.stopped == "interrupted from the keyboard"
    assert result.decision is not None
    assert result.counts["rounds"] == rounds


@pytest.mark.slow
def test_the_search_over_tuples_keeps_its_best_tuple_at_the_limit(tmp_path):
    overrides = {
        "observers": [],
        "dictionaries.control.pieces": 40,
        "dictionaries.disturbance.pieces": 40,
        "method": {"name": "sparserob", "indices": 4},
        "maximiser": {"name": "random_search", "budget": 100_000},
        "limits.seconds": 2.0,
    }
    started = time.monotonic()
    outcome = sr.run(CONFIGS / "experiment1_repaired.yaml", overrides, out=tmp_path / "run", figures=False)
    assert time.monotonic() - started < 20.0
    result = outcome.result
    assert result.status in KNOWN
    assert "the limit of 2 s is reached" in result.message  # of what is refuted it is told that more would help
    assert result.decision is not None
    assert np.isfinite(result.lower_bound)
    assert result.trace is not None
    assert result.counts["evaluations"] == result.trace.value.size > 0
    assert outcome.summary["stopped"] == result.stopped


def test_refuted_where_the_rounds_ran_out_says_so(tmp_path):
    overrides = {"observers": [], "dictionaries.control.pieces": 40, "method": {"name": "exchange", "rounds": 1}}
    result = sr.run(CONFIGS / "experiment1_repaired.yaml", overrides, out=tmp_path / "run", figures=False).result
    assert result.status == "refuted"
    assert result.message.endswith("the 1 rounds of the method (method.rounds) are used up")


def box_program():
    """Minimise ``|x|`` with ``x >= t`` on [0, 1] in [-5, 5]: 1 at 1."""
    return sr.SemiInfiniteProgram(n=1, weights=1.0, lower=-5.0, upper=5.0, families=[slow_family()])


def test_a_lower_bound_above_the_cost_of_a_proven_decision_is_an_alarm():
    program, x = box_program(), np.array([1.0])
    cut = Cut("slow", np.array([1.0]), 0, multiplier=1.0)
    assert not alarm(program, Dual(1.0 - 1e-12, (cut,), np.zeros(0)), x)
    assert not alarm(program, Dual(1.0 + 5e-10, (cut,), np.zeros(0)), x), "the tolerance of the row pays for it"
    said = alarm(program, Dual(1.0 + 5e-9, (cut,), np.zeros(0)), x)
    assert "one of the two is wrong" in said
    assert alarm(program, Dual(1.0 + 5e-10, (), np.zeros(0)), x), "no row pays for it"


def test_a_bound_of_the_image_pays_with_its_own_tolerance_only():
    """``u1 + u2 <= 0.5`` as a row of a hundred-thousandth: missed by 1e-9 in numbers, by 1e-4 in its own unit."""
    program = sr.SemiInfiniteProgram(
        n=2, weights=[1.0, 1.0, 0.0], S=[[1, 0], [0, 1], [1e-5, 1e-5]], lower=-1.0, upper=[1.0, 1.0, 0.5e-5]
    )
    x, z = np.array([0.5, 0.0001]), np.array([0.0, 0.0, 2e5])
    missed = program.finite.image(x)[2] - 0.5e-5
    assert 0.9e-9 < missed < 1.1e-9
    assert alarm(program, Dual(program.cost(x) + z[2] * missed, (), np.zeros(0), z), x)
    assert not alarm(program, Dual(program.cost(x) + z[2] * 0.9 * 1e-9 * 0.5e-5, (), np.zeros(0), z), x)


@pytest.mark.slow
def test_a_decision_that_misses_a_bound_by_more_than_its_own_tolerance_is_no_answer():
    """Whatever the factor of the row ``u1 + u2 <= 0.4``: a terminal state of 0.5 is out of reach."""
    for factor in (1.0, 1e-5, 1e-9):
        polytope = sr.Polytope([[factor, factor], [-1, 0], [0, -1], [1, 0], [0, 1]], [0.4 * factor, 1, 1, 1, 1])
        problem = sr.OptimalControlProblem(
            system=sr.LinearSystem([[0.0]], [[1.0, 1.0]]),
            horizon=1.0,
            initial_state=[0.0],
            control=polytope,
            terminal=[sr.Box([0.5], [1.0])],
        )
        result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4})
        assert result.status in ("infeasible", "failed"), f"{factor}: {result.message}"


def test_what_a_polytope_of_controls_can_give_is_told_exactly():
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0, 1.0]]),
        horizon=1.0,
        initial_state=[0.0],
        control=sr.Polytope([[1, 1], [-1, 0], [0, -1], [1, 0], [0, 1]], [0.5, 1, 1, 1, 1]),
        terminal=[sr.Box([0.6], [2.0])],
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4})
    assert result.status == "infeasible"
    assert "the control can raise x1(1) by at most 0.5, and 0.6 is needed" in result.message


def test_the_gap_is_relative_to_the_larger_bound_and_to_a_millionth_of_what_is_added_up():
    assert relative_gap(0.0, 0.0) == 0.0
    assert relative_gap(1.0, 2.0) == 0.5
    assert relative_gap(-2.0, 1.0) == pytest.approx(1.5)
    assert relative_gap(0.0, 1e-300) == pytest.approx(1.0)  # no cost is so small that bounds apart have met
    assert relative_gap(2.0, 1.0) == 0.0
    assert relative_gap(1e-9, 2e-9, 1e-3) == pytest.approx(0.5)
    assert relative_gap(0.0, 1e-9, 1.0) == pytest.approx(1e-3)
    assert relative_gap(-np.inf, 1.0, 5.0) == np.inf
    assert relative_gap(1.0, np.inf, 5.0) == np.inf


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_what_is_added_up_to_a_cost_are_its_terms_and_the_largest_cost_is_that_of_the_bounds(unit):
    program = sr.SemiInfiniteProgram(n=2, weights=[unit, 0.0], q=[0.0, 2 * unit], lower=[-3.0, -1.0], upper=[1.0, 4.0])
    assert program.largest_cost == pytest.approx(11.0 * unit)
    assert program.added(np.array([-2.0, -1.0])) == pytest.approx(4.0 * unit)
    quadratic = sr.SemiInfiniteProgram(n=1, P=[[2.0 * unit]], q=[-2.0 * unit], constant=unit, lower=-3.0, upper=1.0)
    assert (quadratic.cost(np.ones(1)), quadratic.added(np.ones(1))) == pytest.approx((0.0, 4.0 * unit))
