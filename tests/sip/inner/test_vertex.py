"""Guards sip/inner/vertex: the simplex method on few of many entries, against the simplex method on all of them."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner import vertex as module
from sparserob_core.sip.inner.duality import dual_bound
from sparserob_core.sip.inner.vertex import sifted, simplex


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


@pytest.mark.parametrize("number", range(24))
def test_few_entries_give_the_same_optimum_as_all_of_them(number: int) -> None:
    rng = np.random.default_rng(number)
    made = program(rng, number)
    guess = None if number % 2 else np.abs(rng.normal(size=made.h.size))
    with patch.multiple(module, NEAREST=int(rng.integers(5, 100)), SHARE=0.0):
        found = sifted(made, guess)
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
