"""Guards sip/relaxed/warm: the dual simplex method for few rows, against HiGHS: degenerate programs, entries that
cannot move, rows that come and go, and programs without a solution."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.sip.inner.vertex import simplex
from sparserob_core.sip.relaxed.warm import WarmProgram

HOME = "sparserob_core.sip.relaxed.warm"


def optimum(program, h):
    """The optimal cost by HiGHS, or none."""
    from scipy.optimize import linprog

    w, G, bounds = program.weights, program.G, [(0.0, u) for u in (*program.upper, *-program.lower)]
    found = linprog(np.concatenate([w, w]), np.hstack([G, -G]), h, bounds=bounds)
    return found.fun if found.status == 0 else None


def drawn(rng, rounded, alike):
    n = int(rng.integers(1, 60))
    weights, low, high = rng.uniform(0, 2, n), -rng.uniform(0, 1, n), rng.uniform(0, 1, n)
    if alike:
        weights, low, high = np.ones(n), -np.ones(n), np.ones(n)
    for part in (weights, low, high):
        part[rng.random(n) < 0.1] = 0.0
    program, G = WarmProgram(weights, low, high), rng.standard_normal((int(rng.integers(1, 12)), n))
    return program, np.round(G) if rounded else G


def bent(rng):
    """A program of four rows, with right-hand sides that 0 violates."""
    program = WarmProgram(np.ones(20), -np.ones(20), np.ones(20))
    program.add(rng.standard_normal((4, 20)))
    return program, -rng.uniform(0.5, 1.0, 4)


@given(st.integers(0, 10**6), st.booleans(), st.booleans())
@settings(max_examples=60, deadline=None)
def test_it_finds_the_optimum_that_highs_finds_for_one_right_hand_side_after_another(seed, rounded, alike):
    rng = np.random.default_rng(seed)
    program, G = drawn(rng, rounded, alike)
    asked = []
    with patch(f"{HOME}.simplex", side_effect=lambda one: asked.append(one) or simplex(one)):
        for number in range(6):
            if number < 3:
                program.add(G[number::3])
            elif number == 4:
                program.keep(rng.random(program.G.shape[0]) > 0.5)
            inside = rng.uniform(program.lower, program.upper)
            h = program.G @ inside * rng.uniform(0, 1.3) + rng.uniform(-0.1, 0.4, program.G.shape[0])
            asked.clear()
            found, expected = program.solve(h), optimum(program, h)
            assert (found is None) == (expected is None)
            if found is None or expected is None:
                continue
            x, y = found
            assert (program.G @ x - h).max(initial=0.0) <= 1e-9
            assert ((program.lower <= x) & (x <= program.upper)).all()
            assert program.weights @ np.abs(x) == pytest.approx(expected, abs=1e-9)
            assert program.bound(h, y) == pytest.approx(expected, abs=1e-9)
            assert not asked


def test_a_basis_that_is_wrong_costs_time_and_nothing_else():
    rng = np.random.default_rng(1)
    program, h = bent(rng)
    expected = optimum(program, h)
    for rows, free, side in (([0, 1], [3, 3], [1, 1]), ([2], [5], [-1]), ([0, 1, 2, 3], [0, 1, 2, 3], [1, -1, 1, -1])):
        program._rows, program._free, program._sides = rows, free, side
        program._positions = rng.integers(-1, 2, 20).astype(float)
        x, y = program.solve(h)
        assert (program.G @ x - h).max() <= 1e-9
        assert program.weights @ np.abs(x) == pytest.approx(expected, abs=1e-9)
        assert program.bound(h, y) == pytest.approx(expected, abs=1e-9)


def test_an_interrupt_leaves_no_basis_that_is_half_changed():
    program, h = bent(np.random.default_rng(3))
    expected = optimum(program, h)
    first, calls = WarmProgram._find_step_end, []

    def pressed(self, *arguments):
        calls.append(first(self, *arguments))
        if len(calls) == 2:
            raise KeyboardInterrupt
        return calls[-1]

    with patch.object(WarmProgram, "_find_step_end", pressed), pytest.raises(KeyboardInterrupt):
        program.solve(h)
    with patch(f"{HOME}.simplex", side_effect=AssertionError):
        x, _ = program.solve(h)
    assert program.weights @ np.abs(x) == pytest.approx(expected, abs=1e-9)


def test_where_no_basis_is_found_in_time_highs_is_asked():
    program, h = bent(np.random.default_rng(2))
    with patch(f"{HOME}.PIVOTS", 1), patch(f"{HOME}.MORE", 0):
        x, y = program.solve(h)
    again, multipliers = program.solve(h)
    assert x == pytest.approx(again, abs=1e-9)
    assert y == pytest.approx(multipliers, abs=1e-9)
