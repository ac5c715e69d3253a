"""Guards sip/inner/equalities: equalities are met to rounding, and nothing else moves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import hadamard
from scipy.sparse import csc_array

import sparserob_core as sr
from sparserob_core.checker import outcome
from sparserob_core.sip import program as sip
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.equalities import project_onto_equalities


def near(rng: np.random.Generator, image: bool) -> tuple[FiniteProgram, np.ndarray]:
    """A program and a point that misses its equalities by 1e-10, with entries (of its image) at 0 and at a bound."""
    n = 16
    S = csc_array(hadamard(n) / 1.0) if image else None
    s = rng.uniform(-0.9, 0.9, n)
    s[:4], s[4:8] = 0.0, 1.0
    x = s if S is None else np.linalg.solve(S.toarray(), s)
    A = rng.normal(size=(2, n))
    b = A @ x + 1e-10 * rng.normal(size=2)
    none = (np.zeros((0, n)), np.zeros(0))
    return FiniteProgram(np.zeros(n), np.ones(n), -np.ones(n), np.ones(n), *none, A, b, S=S), x


@pytest.mark.parametrize("image", [False, True])
@pytest.mark.parametrize("seed", range(5))
def test_a_point_that_is_near_meets_its_equalities_and_keeps_its_zeros_and_its_bounds(image, seed):
    program, x = near(np.random.default_rng(seed), image)
    moved = project_onto_equalities(program, x)
    assert program.equality_residual(x) > 1e-12 > 2.0**-50 >= program.equality_residual(moved)
    assert np.abs(moved - x).max() < 1e-8
    before, after = program.image(x), program.image(moved)
    rest = 0.0 if not image else 1e-14
    np.testing.assert_allclose(after[:8], before[:8], atol=rest, rtol=0.0)


def test_a_point_that_is_far_off_or_cannot_move_stays():
    program, x = near(np.random.default_rng(0), image=False)
    far = FiniteProgram(**{**vars(program), "b": program.b + 1.0})
    assert project_onto_equalities(far, x) is x
    ends = np.sign(x) + (x == 0.0)
    held = FiniteProgram(**{**vars(program), "b": program.A @ ends + 1e-10})
    np.testing.assert_array_equal(project_onto_equalities(held, ends), ends)


@pytest.mark.parametrize("name", ["piecewise_constant", "walsh"])
def test_final_values_are_met_to_rounding_and_the_result_says_so(name):
    rng = np.random.default_rng(8)
    for _ in range(3):
        problem = sr.OptimalControlProblem(
            system=sr.LinearSystem(rng.normal(size=(3, 3)), rng.normal(size=(3, 2))),
            horizon=2.0,
            initial_state=0.2 * rng.normal(size=3),
            control=sr.Box([-3.0, -3.0], [3.0, 3.0]),
            weights=[1.0, 1.0],
            terminal=[sr.Equality(np.zeros(3))],
        )
        result = sr.solve(problem, control={"name": name, "pieces": 16})
        if result.status == "infeasible":
            continue
        assert result.status == "certified", result.message
        assert result.missed is not None and result.missed <= 1e-14


def test_an_equality_that_is_missed_by_more_than_rounding_is_no_claim():
    """Bounds leave one point, which misses the equality by 1e-10: nothing may be certified."""
    program = sr.SemiInfiniteProgram(
        n=2, weights=1.0, lower=[1.0, 1.0], upper=[1.0, 1.0], A=[[1.0, 1.0]], b=[2.0 + 1e-10]
    )
    result = sr.solve(program)
    assert result.status not in ("certified", "verified")


def test_the_checker_accepts_of_an_equality_what_a_run_may_leave():
    assert outcome.EQUALITY == sip.EQUALITY and outcome.TOLERANCE == sip.TOLERANCE
