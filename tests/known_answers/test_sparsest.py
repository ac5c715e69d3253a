"""Guards the method sparsest: the fewest active pieces exactly, alphabets, the verdict on L1, and certificates."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.known_answers.test_fewest_active import SPRING, integrator, solved
from tests.support.places import CONFIGS

SPARSEST = {"method": {"name": "sparsest"}}
LETTERS = {"method": {"name": "sparsest", "alphabet": [-1, 0, 1]}}
UNEVEN = {"control": {"name": "piecewise_constant", "breakpoints": [0.0, 0.3, 1.0, 1.25, 2.0]}}


def result_of(where: Path) -> dict[str, Any]:
    return dict(json.loads((where / "result.json").read_text()))


@pytest.mark.first(1)
@pytest.mark.parametrize(("pieces", "fewest"), [(50, 7), (100, 13)])
def test_the_mixed_integer_answers_of_the_spring_are_reached_and_proven(
    pieces: int, fewest: int, tmp_path: Path
) -> None:
    outcome, interval = solved(SPRING, pieces, tmp_path / "run", **SPARSEST)
    assert outcome.status == "certified"
    assert outcome.result.cost == pytest.approx(fewest * 5 / pieces, rel=1e-9)
    assert interval == {"lower": pytest.approx(fewest / pieces), "upper": pytest.approx(fewest / pieces)}
    assert outcome.control is not None
    assert np.count_nonzero(outcome.control) == fewest
    said = result_of(tmp_path / "run")
    assert said["J"] == pytest.approx(float(np.abs(outcome.control).sum()) * 5 / pieces, rel=1e-9)
    assert said["sparsity"]["verdict"] == f"the sparsest control acts {5 / pieces:g} less than the optimum: here it is"


def test_letters_are_taken_exactly(tmp_path: Path) -> None:
    outcome, _ = solved(SPRING, 50, tmp_path / "run", **LETTERS)
    assert outcome.control is not None
    assert set(np.unique(outcome.control)) <= {-1.0, 0.0, 1.0}
    assert outcome.result.cost == pytest.approx(0.7, rel=1e-9)
    assert outcome.status == "certified"


@pytest.mark.first(2)
@pytest.mark.parametrize("start", [0.35, 0.62, 1.0, 1.4])
def test_branch_and_bound_agrees_with_every_choice_of_pieces(start: float, tmp_path: Path) -> None:
    """Pieces of unequal length, where the convex bound is not attained: all 16 choices."""
    lengths = np.diff(UNEVEN["control"]["breakpoints"])
    sums = [sum(choice) for r in range(5) for choice in itertools.combinations(lengths, r)]
    least = min(total for total in sums if total >= start - 0.1 - 1e-12)
    outcome, interval = solved(integrator([start], {"box": 1.0}), 4, tmp_path / "run", dictionaries=UNEVEN, **SPARSEST)
    assert outcome.status == "certified"
    assert outcome.result.cost == pytest.approx(least, rel=1e-7)
    assert interval["lower"] == pytest.approx(least / 2.0, rel=1e-7)


def test_letters_agree_with_every_word(tmp_path: Path) -> None:
    """Two channels that share a state, words of three letters on three unequal pieces each."""
    lengths = np.array([0.5, 0.6, 0.9])
    problem = {
        "name": "linear",
        "system": {"A": [[0.0]], "B": [[1.0, -0.7]]},
        "horizon": 2.0,
        "initial_state": [1.63],
        "control": {"box": [1.0, 1.0]},
        "weights": [1.0, 2.0],
        "terminal": [{"box": [0.06]}],
    }
    control = {"control": {"name": "piecewise_constant", "breakpoints": [0.0, 0.5, 1.1, 2.0]}}
    words = np.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=6))).reshape(-1, 2, 3)
    ends = 1.63 + (words * lengths).sum(axis=2) @ np.array([1.0, -0.7])
    counts = ((words != 0.0) * lengths).sum(axis=2) @ np.array([1.0, 2.0])
    least = counts[np.abs(ends) <= 0.06].min()
    outcome, _ = solved(problem, 3, tmp_path / "run", dictionaries=control, **LETTERS)
    assert outcome.result.cost == pytest.approx(least, rel=1e-7)
    assert outcome.status == "certified"


def test_where_no_word_arrives_every_part_is_excluded(tmp_path: Path) -> None:
    """Convex combinations of the letters arrive, words do not."""
    problem = integrator([0.75], {"box": 1.0}, terminal=[{"box": [0.01]}])
    outcome, interval = solved(problem, 4, tmp_path / "run", **LETTERS)
    assert (outcome.status, interval) == ("infeasible", None)
    assert "branch and bound" in outcome.result.message


def test_a_singular_problem_gets_the_second_verdict(tmp_path: Path) -> None:
    """An integrator (Chatterjee, Nagahara, Quevedo, Rao 2016): the regulariser spreads the control over all times."""
    outcome, _ = solved(integrator([1.0], {"box": 1.0}, terminal=[{"equals": [0]}]), 20, tmp_path / "run", **SPARSEST)
    assert outcome.result.cost == pytest.approx(1.0, rel=1e-9)
    assert result_of(tmp_path / "run")["sparsity"]["verdict"] == (
        "the sparsest control acts 1 less than the optimum: here it is, at the same cost, for the optimum is not unique"
    )


def test_a_normal_problem_on_its_grid_gets_the_first_verdict(tmp_path: Path) -> None:
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [4, 0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.02, 0.02]},
        "terminal": [{"box": [0.5, 0.3]}],
    }
    for method in ("exchange", "sparsest"):
        outcome, _ = solved(problem, 50, tmp_path / method, method={"name": method})
        assert outcome.result.cost == pytest.approx(1.6, rel=1e-7)
        assert result_of(tmp_path / method)["sparsity"]["verdict"] == "L1 is sparsest here: proven"


@pytest.mark.parametrize(
    ("method", "said"),
    [
        (
            {"name": "sparsest", "alphabet": [0, 2]},
            "method.alphabet: expected values within the control's range, got 2",
        ),
        ({"name": "sparsest", "alphabet": [0, 0]}, "numbers that differ"),
        ({"name": "sparsest", "alphabet": []}, "alphabet"),
        ({"name": "sparsest", "nodes": 0}, "nodes"),
    ],
)
def test_a_wrong_alphabet_is_refused(method: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match=said.replace(".", r"\.")):
        solved(SPRING, 10, tmp_path / "run", method=method)


def test_a_dictionary_with_fewer_functions_than_pieces_is_refused(tmp_path: Path) -> None:
    dictionaries = {"control": {"name": "walsh", "pieces": 16, "functions": 4}}
    with pytest.raises(sr.InputError, match="sparsest counts pieces"):
        solved(SPRING, 16, tmp_path / "run", dictionaries=dictionaries, **SPARSEST)


def part_is_left_out(certificate: dict[str, Any]) -> None:
    branch = next(node for node in certificate["tree"]["nodes"] if "first" in node)
    branch["first"] = branch["second"]


def leaf_is_called_infeasible(certificate: dict[str, Any]) -> None:
    leaf = next(node for node in certificate["tree"]["nodes"] if "multipliers" in node)
    leaf["feasible"] = False


def piece_is_outside(certificate: dict[str, Any]) -> None:
    branch = next(node for node in certificate["tree"]["nodes"] if "first" in node)
    branch["piece"] = 99


def bound_is_higher(certificate: dict[str, Any]) -> None:
    certificate["lower_bound"] = certificate["cost"] = 0.96


def norm_is_lower(certificate: dict[str, Any]) -> None:
    certificate["J"] *= 0.9


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "change",
    [part_is_left_out, leaf_is_called_infeasible, piece_is_outside, bound_is_higher, norm_is_lower],
)
def test_a_tree_that_was_changed_is_found(change: Any, tmp_path: Path) -> None:
    problem = integrator([1.0], {"box": 1.0})
    outcome, _ = solved(problem, 4, tmp_path / "run", dictionaries=UNEVEN, **SPARSEST)
    assert outcome.result.counts["nodes"] > 1
    file = tmp_path / "run" / "certificate.json"
    certificate = json.loads(file.read_text())
    change(certificate)
    file.write_text(json.dumps(certificate))
    assert sr.check(tmp_path / "run").status == "refuted"


def test_another_letter_in_the_decision_is_found(tmp_path: Path) -> None:
    solved(integrator([1.0], {"box": 1.0}), 20, tmp_path / "run", **LETTERS)
    file = tmp_path / "run" / "certificate.json"
    certificate = json.loads(file.read_text())
    certificate["decision"][0] = [0.999 if value == -1.0 else value for value in certificate["decision"][0]]
    file.write_text(json.dumps(certificate))
    assert sr.check(tmp_path / "run").status == "refuted"


def test_units_change_nothing(tmp_path: Path) -> None:
    one, _ = solved(integrator([1.0], {"box": 1.0}), 4, tmp_path / "one", dictionaries=UNEVEN, **SPARSEST)
    scaled = integrator([1024.0], {"box": 1024.0}, terminal=[{"box": [102.4]}])
    other, _ = solved(scaled, 4, tmp_path / "other", dictionaries=UNEVEN, **SPARSEST)
    assert (one.result.cost, one.result.lower_bound) == (other.result.cost, other.result.lower_bound)
    assert other.summary["J"] == 1024.0 * one.summary["J"]


@pytest.mark.first(1)
@pytest.mark.parametrize("penalty", ["logarithm", "capped"])
def test_another_penalty_never_acts_more_than_l1_and_claims_what_it_proves(penalty: str, tmp_path: Path) -> None:
    plain, before = solved(SPRING, 40, tmp_path / "exchange")
    found, after = solved(SPRING, 40, tmp_path / "other", method={"name": "reweighted", "penalty": penalty})
    assert found.control is not None
    assert plain.control is not None
    assert np.count_nonzero(plain.control) == 7
    assert np.count_nonzero(found.control) == 6  # which is the least: 0.6356 / 0.125 = 5.08
    assert (before["lower"], after["upper"]) == (pytest.approx(6 / 40), pytest.approx(6 / 40))
    assert found.result.cost > plain.result.cost
    assert found.result.lower_bound == pytest.approx(plain.result.lower_bound, rel=1e-10)
    assert found.status == "verified"


@pytest.mark.slow
def test_who_reaches_the_fewest_pieces_is_as_the_page_says(tmp_path: Path) -> None:
    study = sr.sweep(CONFIGS / "studies" / "sparser.yaml", out=tmp_path / "study")
    counts: dict[str, int] = {}
    for row in study.table:
        key = "problem.disturbance.box", "dictionaries.control.pieces"
        exact = next(
            other
            for other in study.table
            if other["method"] == "sparsest" and all(other[name] == row[name] for name in key)
        )
        least = exact["sparsity.fewest_active.upper"]
        assert exact["sparsity.fewest_active.lower"] == pytest.approx(least)
        upper, pieces = row["sparsity.fewest_active.upper"], row["dictionaries.control.pieces"]
        assert row["sparsity.fewest_active.lower"] <= least + 1e-9 <= upper + 2e-9
        assert (upper - least) * pieces <= 1 + 1e-6
        name = str(row["method"])
        counts[name] = counts.get(name, 0) + (upper - least < 1e-9)
    assert sorted(counts.values()) == [5, 6, 6, 10]


def test_a_time_of_action_is_not_compared_with_a_cost(tmp_path: Path) -> None:
    problem = integrator([1.0], {"box": 1.0})
    for name in ("exchange", "sparsest"):
        solved(problem, 20, tmp_path / name, method={"name": name})
    with pytest.raises(sr.InputError, match="runs whose costs mean the same"):
        sr.compare([tmp_path / "sparsest", tmp_path / "exchange"])
    assert sr.compare([tmp_path / "sparsest"]).exact == pytest.approx(0.9)


def test_what_no_control_can_do_is_proven_and_checked(tmp_path: Path) -> None:
    impossible = {**SPRING, "disturbance": {"box": [0.3, 0.3]}}
    for method in (SPARSEST, LETTERS):
        where = tmp_path / str(len(str(method)))
        outcome, interval = solved(impossible, 20, where, **method)
        assert (outcome.status, interval) == ("infeasible", None)
        assert result_of(where)["cost_scale"] == 0.0
