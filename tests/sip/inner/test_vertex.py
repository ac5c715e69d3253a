"""Guards sip/inner/vertex: the simplex method on few of many entries, against the simplex method on all of them."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner import vertex as module
from sparserob_core.sip.inner.duality import dual_bound
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.inner.vertex import simplex, solve_by_sifting
from sparserob_core.sip.solver import named


def program(rng: np.random.Generator, number: int) -> FiniteProgram:
    """A random one: every third with entries that are free or away from 0, every fourth infeasible."""
    n, r, e = int(rng.integers(200, 1500)), int(rng.integers(1, 12)), int(rng.integers(0, 3))
    G, A = rng.normal(size=(r, n)), rng.normal(size=(e, n))
    lower, upper = -np.ones(n), np.ones(n)
    if number % 3 == 0:
        lower[:5], lower[5:20] = -np.inf, 0.1
    x = np.clip(rng.normal(size=n) * (rng.random(n) < 0.1), lower, upper)
    h = G @ x + (rng.random(r) if number % 4 else -1e4)
    weights = np.abs(rng.normal(size=n)) + 0.2
    return FiniteProgram(
        q=0.1 * rng.normal(size=n) * (number % 2), weights=weights, lower=lower, upper=upper, G=G, h=h, A=A, b=A @ x
    )


@pytest.mark.first(12)
@pytest.mark.parametrize("number", range(24))
def test_few_entries_give_the_same_optimum_as_all_of_them(number: int) -> None:
    rng = np.random.default_rng(number)
    made = program(rng, number)
    guess = None if number % 2 else np.abs(rng.normal(size=made.h.size))
    with patch.multiple(module, NEAREST=int(rng.integers(5, 100)), NEAREST_SHARE=0.0):
        found = solve_by_sifting(made, guess)
    truth = simplex(made)
    assert found.status == truth.status
    if truth.status != "optimal":
        return
    value = made.objective(truth.x)
    assert made.residual(found.x) <= 1e-8
    assert made.objective(found.x) == pytest.approx(value, rel=1e-8, abs=1e-8)
    assert dual_bound(made, found.y, found.mu) == pytest.approx(value, rel=1e-7, abs=1e-7)
    assert np.count_nonzero((found.x != 0.0) & (found.x > made.lower) & (found.x < made.upper)) <= (
        made.h.size + made.b.size
    )


def resting(pieces: int, instants: int, largest: float) -> FiniteProgram:
    """Keep an oscillator, pushed by ``1.5 cos t + t/3``, as near to 0 as a control of at most ``largest`` can: rows of
    instants next to each other are nearly parallel."""
    ends, t = np.linspace(0.0, 2.0 * np.pi, pieces + 1), np.linspace(1.0, 2.0 * np.pi, instants)
    G = np.diff(np.cos(t[:, np.newaxis] - np.minimum(ends, t[:, np.newaxis])), axis=1)
    push, one = 1.5 * np.cos(t) + t / 3.0, np.ones((instants, 1))
    return FiniteProgram(
        q=np.eye(pieces + 1)[pieces],
        weights=np.zeros(pieces + 1),
        lower=np.append(np.full(pieces, -largest), -1e4),
        upper=np.append(np.full(pieces, largest), 1e4),
        G=np.block([[G, -one], [-G, -one]]),
        h=np.concatenate([-push, push]),
        A=np.zeros((0, pieces + 1)),
        b=np.zeros(0),
    )


def test_a_linear_program_for_which_digits_lack_is_answered_at_a_vertex() -> None:
    asked = sr.load_registry().build("solver", "piqp")
    given = resting(40, 60, 10.0)
    found = solve_finite(given, asked)
    assert (found.status, found.by) == ("optimal", "highs")
    assert found.residual <= 1e-14  # seen: 5e-16, and 1e-10 from what has more digits
    assert any("PIQP" in said for said in found.attempts)  # who was asked first


def test_no_vertex_is_sought_where_a_solver_was_named() -> None:
    registry = sr.load_registry()
    piqp = registry.build("solver", "piqp")
    found = solve_finite(resting(40, 60, 10.0), named(piqp, "piqp", registry.build("solver", "auto")))
    assert (found.status, found.by) == ("optimal", "piqp")


def test_rows_that_ask_for_nothing_have_no_multiplier() -> None:
    given = resting(8, 12, 2.0)
    h, r = np.append(given.h, np.inf), given.h.size
    found = simplex(replace(given, G=np.vstack([given.G, np.ones(given.n)]), h=h))
    assert found.status == "optimal" and found.y.size == r + 1 and found.y[r] == 0.0
    assert given.objective(found.x) == pytest.approx(given.objective(simplex(given).x), abs=1e-12)


def test_the_simplex_method_gives_up_after_so_many_turns() -> None:
    assert simplex(resting(40, 60, 10.0), 3).status == "failed"
