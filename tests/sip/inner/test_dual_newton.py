"""Guards sip.inner.dual_newton: separable programs are solved from nothing, exactly, others are given up in words, and
a run tells who solved what."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.run.conclusion import fewest
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.dual_newton import (
    DualNewton,
    _Dual,
    _solve_non_negative,
    newton_solve,
    not_separable,
    solve_from_nothing,
)
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.testing.solvers import (
    badly_scaled_instances,
    coupled_instances,
    infeasible_instances,
    linear_instances,
    regularised_instances,
)
from tests.support.places import ROOT

DEMO = ROOT / "configs/double_integrator.yaml"


class Untouched(sr.Solver):
    """Must not be asked."""

    def solve(self, program, accuracy):
        raise AssertionError("asked")


class Asking(sr.Solver):
    """Ends a test when it is asked."""

    def solve(self, program, accuracy):
        pytest.fail("asked")


def separable(seed: int, rows: int, entries: int, curvature: float) -> FiniteProgram:
    """A feasible program of that size, with equalities, fixed entries and bounds of very different widths."""
    from scipy.sparse import csc_array, eye_array

    rng = np.random.default_rng(seed)
    upper = 10.0 ** rng.uniform(-1, 1, entries)
    lower = np.where(rng.random(entries) < 0.2, 0.0, -upper)
    lower[:2] = upper[:2] = 0.3
    G, A = rng.standard_normal((rows, entries)), rng.standard_normal((2, entries))
    inside = lower + rng.random(entries) * (upper - lower)
    return FiniteProgram(
        0.3 * rng.standard_normal(entries),
        rng.uniform(0.5, 1.0, entries),
        lower,
        upper,
        G,
        G @ inside + 0.1 * rng.random(rows),
        A,
        A @ inside,
        P=csc_array(curvature * eye_array(entries)) if curvature else None,
    )


@pytest.mark.first(8)
@pytest.mark.parametrize("curvature", [0.0, 1e-6, 1e-2, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_from_nothing_it_finds_the_optimum_to_round_off(seed: int, curvature: float) -> None:
    program = separable(seed, 6, 80, curvature)
    found, _ = solve_from_nothing(program, 1e-10, 60)
    assert found.residual <= 1e-10
    assert abs(found.gap) <= 1e-10 * max(1.0, abs(found.value))
    other = solve_finite(program, sr.load_registry().build("solver", "clarabel"))
    assert other.status == "optimal"
    assert found.value == pytest.approx(other.value, rel=1e-7, abs=1e-7)


def test_a_large_program_is_solved_from_nothing_before_anybody_is_asked() -> None:
    program = separable(5, 100, 2000, 1e-2)
    program = replace(program, h=program.h + np.where(np.arange(100) < 5, 0.0, 100.0))
    found = solve_finite(program, Untouched())
    assert (found.status, found.by) == ("optimal", "dual_newton")
    assert found.residual <= 1e-9
    assert abs(found.gap) <= 1e-8 * max(1.0, abs(found.value))


@pytest.mark.parametrize(("rows", "entries", "curvature"), [(20, 2000, 1e-2), (100, 200, 1e-2), (100, 2000, 0.0)])
def test_one_that_is_not_large_or_not_bent_is_left_to_the_solver(rows: int, entries: int, curvature: float) -> None:
    with pytest.raises(pytest.fail.Exception, match="asked"):
        solve_finite(separable(5, rows, entries, curvature), Asking())


def test_under_a_lighter_curvature_the_free_entries_of_the_last_optimum_lead_to_the_next_one_in_fewer_steps() -> None:
    steps = dict.fromkeys((True, False), 0)
    for seed in range(12):
        program = separable(seed, 6, 40, 0.5)
        at = newton_solve(program, np.zeros(6))
        assert at is not None
        assert program.P is not None
        lighter, answers = replace(program, P=program.P / 8.0), []
        for known in (True, False):
            with patch.object(_Dual, "hessian", autospec=True, side_effect=_Dual.hessian) as asked:
                found = newton_solve(lighter, at.y, at.mu, x0=at.x if known else None)
            assert found is not None
            assert found.gap <= 1e-10 * (1.0 + abs(found.value))
            answers.append(found.x)
            steps[known] += asked.call_count
        assert answers[0] == pytest.approx(answers[1], abs=1e-9)
    assert steps[True] < steps[False]


@pytest.mark.slow
def test_every_separable_program_of_the_contract_is_answered_and_no_other() -> None:
    left = []
    for instances in (linear_instances, badly_scaled_instances, regularised_instances, infeasible_instances):
        for one in instances():
            if not_separable(one.program):
                left.append(one.name)
                continue
            solution = solve_finite(one.program, DualNewton())
            assert solution.status == ("optimal" if one.feasible else "infeasible"), (one.name, solution.message)
    assert left == ["bounded sums"]
    curved = [one.program for one in coupled_instances() if one.program.P is not None]
    assert len(curved) == 6
    assert all(not_separable(program) for program in curved)


def test_what_it_is_not_for_is_given_up_in_words() -> None:
    coupled = next(one.program for one in coupled_instances() if one.program.P is not None)
    solution = solve_finite(coupled, DualNewton())
    assert solution.status == "failed"
    assert any("couples variables" in said for said in solution.attempts)


def test_active_sets_that_go_round_are_given_up() -> None:
    """An indefinite matrix lets them; of rows that crowd, rounding does, and each step took 3 sets a row."""
    curved, linear, free = np.array([[1.3, 0.8], [0.3, -0.3]]), np.array([0.9, 0.4]), np.zeros(2, dtype=bool)
    with pytest.raises(np.linalg.LinAlgError, match="go round"):
        _solve_non_negative(curved, linear, ~free, free)
    definite = curved.T @ curved
    found = _solve_non_negative(definite, linear, ~free, free)
    assert (found >= 0.0).all() and (definite @ found - linear >= -1e-12).all()


def test_a_program_that_no_answer_meets_is_not_claimed_to_be_solved() -> None:
    program = separable(0, 6, 80, 0.0)
    apart = replace(program, b=program.b + 1e3)
    found, _ = solve_from_nothing(apart, 1e-10, 60)
    assert found.residual > 1e-3
    assert solve_finite(apart, DualNewton()).status == "infeasible"


def test_whose_answer_it_is_stands_in_the_solution() -> None:
    program = separable(1, 6, 80, 1.0)
    free = replace(program, h=program.h + 1e3, A=program.A[:0], b=program.b[:0])
    assert solve_finite(free, Untouched()).by == "closed_form"
    first = solve_finite(program, DualNewton())
    assert first.by == "solver"
    assert solve_finite(replace(program, h=program.h + 1e-4), Untouched(), guess=first).by == "dual_newton"
    assert solve_finite(replace(program, lower=program.upper + 1.0), Untouched()).by == "closed_form"
    coupled = next(one.program for one in coupled_instances() if one.program.P is not None)
    assert solve_finite(coupled, DualNewton()).by == "nobody"


def test_the_searching_method_counts_every_relaxed_program_too(monkeypatch: pytest.MonkeyPatch) -> None:
    # without the program of the fewest active pieces, which answers are counted of too
    monkeypatch.setattr(fewest, "_minimise_count", lambda *_: None)
    result = sr.run(
        ROOT / "configs/experiment1_reduced.yaml",
        {"maximiser.budget": 30, "method.sc1": {"name": "iterations", "count": 2}, "observers": []},
        figures=False,
    ).result
    assert sum(result.solved_by.values()) == result.counts["relaxed_programs"] > 0


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"dictionaries.control": {"name": "haar", "pieces": 16}}, "sums of entries"),
        ({"regulariser": {"name": "smoothness"}}, "couples entries"),
        ({"policy": {"name": "affine"}}, "HiGHS"),
    ],
)
def test_where_programs_are_not_separable_the_first_second_says_so(overrides, words: str, tmp_path) -> None:
    with pytest.raises(sr.InputError, match=words) as refusal:
        sr.run(DEMO, {"solver.name": "dual_newton", **overrides}, tmp_path / "run", figures=False)
    assert "solver.name: expected another solver, such as piqp" in str(refusal.value)
    assert not (tmp_path / "run").exists()
