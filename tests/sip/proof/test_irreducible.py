"""Guards sip/proof/irreducible: why nothing is feasible: nothing in the answer can be spared, every separate reason is
told, in words and numbers that are true."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.figures.clash import clash_figure, clash_strips
from sparserob_core.experiment.figures.style import save_figure
from sparserob_core.sip.evidence import InfeasibleSubsystem
from sparserob_core.sip.proof.irreducible import find_irreducible_rows
from sparserob_core.sip.proof.verdict import infeasible_subsystem
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows, rows_at
from tests.support.places import CONFIGS

DOUBLE_INTEGRATOR = {"A": [[0, 1], [0, 0]], "B": [[0], [1]]}


def solved(tmp_path: Path, **problem: object) -> sr.Outcome:
    config = {
        "problem": {
            "name": "linear",
            "system": DOUBLE_INTEGRATOR,
            "horizon": 2.0,
            "initial_state": [0, 0],
            "control": {"box": 1.0},
            **problem,
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 20}},
        "observers": [],
    }
    return sr.run(config, out=tmp_path / "run", figures=False)


def feasible(rows: Rows, bound: float) -> bool:
    answer = linprog(np.zeros(rows.G.shape[1]), rows.G, rows.h, bounds=(-bound, bound), method="highs")
    return bool(answer.status == 0)


def half_spaces(seed: int) -> tuple[sr.SemiInfiniteProgram, Rows]:
    """Random half-spaces ``c'x <= h`` in four dimensions, and some of them turned round beyond one another: nothing is
    left."""
    rng = np.random.default_rng(seed)
    G, h = rng.standard_normal((60, 4)), rng.uniform(-0.8, 0.6, 60)
    family = sr.ConstraintFamily(
        name="half-spaces",
        index_set=sr.Box([0.0], [59.0]),
        rows=lambda i: (G[i[:, 0].astype(int)][:, None], h[i[:, 0].astype(int)][:, None]),
    )
    program = sr.SemiInfiniteProgram(n=4, weights=1.0, lower=-3.0, upper=3.0, families=[family])
    return program, rows_at(program, "half-spaces", np.arange(60.0)[:, None])


@pytest.mark.parametrize("seed", range(6))
def test_without_any_one_row_of_a_clash_something_is_feasible(seed):
    program, rows = half_spaces(seed)
    assert not feasible(rows, 3.0)
    relaxed = RelaxedProgram(program, sr.load_registry().build("solver", "piqp", {}))
    kept, solution, shown = find_irreducible_rows(relaxed, rows, relaxed.solve(rows, 0.0))
    assert shown
    count = kept.h.size
    assert 1 <= count <= 5
    assert not feasible(kept, 3.0)
    assert all(feasible(kept.take(np.arange(count) != i), 3.0) for i in range(count)) or count == 1
    y = solution.y
    assert (y > 0).all()
    assert -np.abs(y @ kept.G).sum() * 3.0 - y @ kept.h > 0


def test_a_proof_by_many_rows_is_made_one_of_few_before_any_is_left_out() -> None:
    turns = 2.0 * np.pi * np.arange(120) / 120
    G, h = np.stack([np.cos(turns), np.sin(turns)], axis=1), np.full(120, -0.1)  # all away from the middle
    family = sr.ConstraintFamily(
        name="half-planes",
        index_set=sr.Box([0.0], [119.0]),
        rows=lambda i: (G[i[:, 0].astype(int)][:, None], h[i[:, 0].astype(int)][:, None]),
    )
    program = sr.SemiInfiniteProgram(n=2, weights=1.0, lower=-3.0, upper=3.0, families=[family])
    rows, asked = rows_at(program, "half-planes", np.arange(120.0)[:, None]), list[int]()

    class Counted(RelaxedProgram):
        def solve(self, rows, epsilon, *more):
            asked.append(rows.h.size)
            return super().solve(rows, epsilon, *more)

    relaxed = Counted(program, sr.load_registry().build("solver", "piqp", {}))
    every = replace(relaxed.solve(rows, 0.0), y=np.full(120, 1.0 / 120))  # as an interior point proves it
    asked.clear()
    kept, solution, _ = find_irreducible_rows(relaxed, rows, every)
    assert 2 <= kept.h.size <= 3
    assert len(asked) <= 6  # of 120 rows one by one
    y = solution.y
    amount = (-np.abs(y @ kept.G).sum() * 3.0 - y @ kept.h) / y.sum()
    assert amount > 0.0
    assert solution.infeasibility == pytest.approx(amount, rel=1e-6)


@pytest.mark.parametrize("lost", [False, True])
def test_that_all_but_any_one_can_hold_is_said_only_where_a_decision_was_found_for_each(lost: bool) -> None:
    """Without one row the solver fails: nothing is known of the others, and nothing is said of them."""
    program, rows = half_spaces(0)

    class Lost(RelaxedProgram):
        def solve(self, rows, epsilon, *more):
            solution = super().solve(rows, epsilon, *more)
            return replace(solution, status="failed") if lost and solution.status == "optimal" else solution

    relaxed = Lost(program, sr.load_registry().build("solver", "piqp", {}))
    kept, solution, shown = find_irreducible_rows(relaxed, rows, relaxed.solve(rows, 0.0))
    assert kept.h.size > 1 and not feasible(kept, 3.0)
    subsystem, _ = infeasible_subsystem(program, kept, solution.y, solution.infeasibility, shown)
    assert subsystem.irreducible is not lost
    assert ("though all but any one of them can" in subsystem.sentence()) is not lost


def test_experiment_1_as_printed_has_its_separate_reasons_one_sentence_each(tmp_path):
    result = sr.run(CONFIGS / "experiment1_printed.yaml", {"observers": []}, out=tmp_path / "run", figures=False).result
    assert "x1(0) = -1 is outside |x1| <= 0.7" in result.message
    assert "the disturbance alone moves x1(5) by 1.28, the terminal set allows 0.3" in result.message
    assert "the disturbance alone moves x2(5) by 1.754, the terminal set allows 0.3" in result.message
    assert result.message.startswith("3 separate reasons: ")
    assert len(result.message.split("; ")) == 3
    assert result.worst.time == 0.0


def test_a_disturbance_that_is_wider_than_the_set_is_said_to_be_that(tmp_path):
    """x2(2) moves by 2 * 0.3, whatever the control."""
    outcome = solved(tmp_path, disturbance={"box": [0.0, 0.3]}, terminal=[{"box": [None, 0.5]}])
    assert outcome.result.message == "the disturbance alone moves x2(2) by 0.6, the terminal set allows 0.5"
    assert {(cut.family, cut.row) for cut in outcome.result.indices} == {("terminal", 0), ("terminal", 1)}


def test_what_a_polytope_of_controls_can_give_is_told_like_that_of_a_box(tmp_path):
    """Two seconds of ``u1 + u2 <= 0.5``, a row that is stated at a small factor."""
    slanted = {"polytope": {"H": [[1, 0], [0, 1], [-1, 0], [0, -1], [1e-6, 1e-6]], "h": [1, 1, 1, 1, 0.5e-6]}}
    outcome = solved(
        tmp_path,
        system={"A": [[0]], "B": [[1, 1]]},
        initial_state=[0],
        control=slanted,
        terminal=[{"box": {"lower": [1.00002], "upper": [None]}}],
    )
    assert outcome.result.message.startswith("the control can raise x1(2) by at most 1, and 1.00002 is needed")


def test_a_control_that_is_too_weak_is_told_by_how_much(tmp_path):
    """From x = 5 at rest, |u| <= 1 moves x1(2) by 2 at most; to come to 0.5 it would take 4.5, and 4.54 against a
    disturbance of 0.01."""
    message = solved(tmp_path, initial_state=[5, 0], terminal=[{"box": [0.5, None]}]).result.message
    assert (
        message == "the control can lower x1(2) by at most 2, and 4.5 is needed: without control it is 5, "
        "the terminal set asks for |x1| <= 0.5"
    )
    message = solved(
        tmp_path / "noise", initial_state=[5, 0], disturbance={"box": [0.0, 0.02]}, terminal=[{"box": [0.5, None]}]
    ).result.message
    assert "4.54 is needed, 0.04 of it for the worst disturbance" in message


def test_constraints_that_clash_together_are_all_named_with_what_they_ask_for(tmp_path):
    """x1(1) >= 0.4 and x1(2) <= 0.1 with |x2(2)| <= 0.1 can each be met, but not all of them."""
    outcome = solved(
        tmp_path, path=[{"box": {"lower": [0.45, None]}, "from": 1.0, "to": 1.0}], terminal=[{"box": [0.1, 0.05]}]
    )
    assert outcome.result.status == "infeasible"
    message = outcome.result.message
    assert "these cannot hold together, though all but any one of them can" in message
    assert "path: x1(1) >= 0.45" in message
    assert "terminal: x1(2) <= 0.1" in message
    rows = [
        rows_at(outcome.program, cut.family, cut.index[None], np.array([cut.row])) for cut in outcome.result.indices
    ]
    joined = rows[0]
    for one in rows[1:]:
        joined = joined.joined(one)
    assert joined.h.size >= 2
    assert not feasible(joined, 1.0)
    assert all(feasible(joined.take(np.arange(joined.h.size) != i), 1.0) for i in range(joined.h.size))


def test_sets_are_named_as_they_were_written(tmp_path):
    lower = solved(tmp_path, path=[{"box": {"lower": [0.5, None]}}]).result.message
    assert lower.startswith("x1(0) = 0 is outside x1 >= 0.5 (path)")
    both = solved(tmp_path / "both", path=[{"box": {"lower": [0.5, None], "upper": [2.0, None]}}]).result.message
    assert both.startswith("x1(0) = 0 is outside 0.5 <= x1 <= 2 (path)")


def test_the_strips_of_the_figure_are_the_closed_forms(tmp_path):
    outcome = solved(tmp_path, disturbance={"box": [0.0, 0.3]}, terminal=[{"box": [None, 0.5]}])
    (strip,) = clash_strips(outcome.program, outcome.result)
    assert strip.label.startswith("x2(2)")
    numbers = (strip.low, strip.high, strip.reach_low, strip.reach_high, strip.sigma_low, strip.sigma_high, strip.best)
    assert np.allclose(numbers, (-0.5, 0.5, -2.0, 2.0, 0.6, 0.6, 0.0), atol=1e-12)


def test_the_figure_of_a_clash_is_drawn_and_only_for_an_infeasible_run(tmp_path):
    outcome = solved(tmp_path, disturbance={"box": [0.0, 0.3]}, terminal=[{"box": [None, 0.5]}])
    files = save_figure(tmp_path / "clash", clash_figure, outcome.experiment, outcome.result)
    assert [file.name for file in files] == ["clash.pdf", "clash.png"]
    fine = solved(tmp_path / "fine", terminal=[{"box": [1.0, 1.0]}])
    with pytest.raises(sr.InputError, match="infeasible"):
        clash_figure(fine.experiment, fine.result)


def test_two_states_that_the_control_moves_alike_are_named_as_the_combination_that_it_cannot_move(tmp_path):
    """x1 - x2 stays 2 without disturbance, 1.8 is the most that |x1|, |x2| <= 0.9 leave, and the disturbances take 0.1
    and 0.3 of it; no disturbance alone is too wide for either state."""
    outcome = solved(
        tmp_path,
        system={"A": [[0, 0], [0, 0]], "B": [[1], [1]], "E": [[1, 0], [0, 3]]},
        horizon=1.0,
        initial_state=[1, -1],
        control={"box": 5.0},
        disturbance={"box": [0.1, 0.1]},
        terminal=[{"box": [0.9, 0.9]}],
    )
    assert outcome.result.status == "infeasible"
    assert outcome.result.message == (
        "the control cannot move x1(1) - x2(1), which is 2, but terminal: x1(1) <= 0.9 and terminal: x2(1) >= -0.9 "
        "ask for at most 1.8 less 0.4 for the worst disturbances"
    )


def test_sides_of_unequal_length_are_compared_in_the_units_of_the_first(tmp_path):
    """2 x2 <= 1 and -x2 <= 0.5 are the slab |x2| <= 0.5, which a disturbance of 0.6 leaves."""
    slab = {"polytope": {"H": [[0, 2], [0, -1]], "h": [1.0, 0.5]}}
    message = solved(tmp_path, disturbance={"box": [0.0, 0.3]}, terminal=[slab]).result.message
    assert "the disturbance alone moves 2 x2(2) by 1.2, the terminal set allows 1" in message


@pytest.mark.parametrize("amount", [0.5, np.inf])
@pytest.mark.parametrize("equalities", [True, False])
@pytest.mark.parametrize("members", [(), ("one",), ("one", "two")])
def test_no_sentence_speaks_of_equalities_where_there_are_none_or_of_an_infinite_amount(members, equalities, amount):
    told = InfeasibleSubsystem(members=members, amount=amount, equalities=equalities).sentence()
    assert ("equalities" in told) == (equalities and len(members) < 2)
    assert "inf" not in told.replace("infeasible", "")
    assert ("0.5 times its norm" in told) == (amount == 0.5)
    assert "times its norm" not in InfeasibleSubsystem(members=members, amount=amount).sentence(amounts=False)
