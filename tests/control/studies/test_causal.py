"""Guards the bound against every causal policy: trees against dynamic programming and against all signals at once."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.control.studies.causal import CausalBound, CausalLimits, CausalSearch
from sparserob_core.experiment.run.conclusion.causal import active, proven
from sparserob_core.sip.convex_set import Array

T, RATE = 3.0, 0.4
FREELY = CausalLimits(60, np.inf, np.inf, lambda: False)


def scalar(w: float, radius: float, x0: float, rate: float = RATE) -> sr.OptimalControlProblem:
    """``x' = rate x + u + w`` from ``x0``, ``|u| <= 1``, ``|x(3)| <= radius``."""
    return sr.OptimalControlProblem(
        system=sr.LinearSystem([[rate]], [[1.0]]),
        horizon=T,
        initial_state=[x0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-w], [w]),
        terminal=[sr.Box([-radius], [radius])],
    )


def tree(problem: sr.OptimalControlProblem, K: int, L: int, **policy: Any) -> tuple[ControlResult, CausalBound | None]:
    """The affine policy on ``K`` pieces of the control and ``L`` of the disturbance, and the bound, in balls."""
    dictionaries = [{"name": "piecewise_constant", "pieces": pieces} for pieces in (K, L)]
    chosen = sr.AffinePolicy(**policy)
    result = sr.solve(problem, control=dictionaries[0], disturbance=dictionaries[1], policy=chosen)
    assert isinstance(result, ControlResult)
    search = CausalSearch(result.model, result.decision, active(result.model, result))
    cost = result.cost if result.status == "certified" else np.inf
    found = search.least_cost(cost, FREELY)
    if found is None:
        return result, None
    stated = search.bound(found[0], found[1], np.inf if found[2] else found[1].value, problem.disturbance)
    derived = proven(result.model, problem, stated)
    assert derived is not None
    return result, replace(stated, lower=np.inf if found[2] else derived)


def by_programming(w: float, radius: float, x0: float, K: int) -> float:
    """The least cost of any causal policy, by the sets of states from which one exists (scalar: intervals)."""
    h = T / K
    Phi, G = np.exp(RATE * h), (np.exp(RATE * h) - 1.0) / RATE
    sets = [(-radius, radius)]
    for _ in range(K):
        low, high = sets[0][0] + G * w, sets[0][1] - G * w
        if low > high:
            return np.inf
        sets.insert(0, ((low - G) / Phi, (high + G) / Phi))
    reach = np.array([[G * Phi ** (k - j) if j <= k else 0.0 for j in range(K)] for k in range(K)])
    free = x0 * Phi ** np.arange(1, K + 1)
    low, high = (np.array([one[i] for one in sets[1:]]) for i in (0, 1))
    both = np.hstack([reach, -reach])
    found = linprog(
        np.full(2 * K, h),
        A_ub=np.vstack([both, -both]),
        b_ub=np.concatenate([high - G * w - free, free - low - G * w]),
        bounds=(0.0, 1.0),
    )
    return float(found.fun) if found.status == 0 else np.inf


def gives(times: Array) -> Array:
    """What 1 between neighbouring times gives to ``x(T)``."""
    past: Array = np.exp(RATE * (T - times)) / RATE
    return -np.diff(past)


def by_all_signals(w: float, radius: float, x0: float, K: int, L: int, cost: str) -> float:
    """The program of all signals that are nominal up to a block and extreme from there on, each with controls of its
    own, equal where it cannot be told from another."""
    signals = [(0.0,) * L]
    signals += [(0.0,) * b + rest for b in range(L) for rest in product((-w, w), repeat=L - b)]
    ends, blocks = np.linspace(0.0, T, K + 1), np.linspace(0.0, T, L + 1)
    names: dict[tuple[int, tuple[float, ...]], int] = {}
    column = [
        [names.setdefault((k, s[: int((blocks[:-1] < ends[k] - 1e-12).sum())]), len(names)) for k in range(K)]
        for s in signals
    ]
    n, rows, limits = len(names), [], []
    sizes = [{name: name + n for name in mine} for mine in column]  # of every control that some signal causes
    sizes = [{name: n + k for k, name in enumerate(mine)} for mine in column] if cost != "worst" else sizes
    width = n + K if cost != "worst" else 2 * n + 1
    for s, mine in zip(signals, column, strict=True):
        row = np.zeros(width)
        row[mine] = gives(ends)
        rest = np.exp(RATE * T) * x0 + np.dot(s, gives(blocks))
        rows += [row, -row]
        limits += [radius - rest, radius + rest]
        own = sizes[signals.index(s)]
        for k in range(K) if cost != "nominal" or s is signals[0] else ():
            for sign in (1.0, -1.0):
                size = np.zeros(width)
                size[mine[k]], size[own[mine[k]]] = sign, -1.0
                rows.append(size)
                limits.append(0.0)
        if cost == "worst":
            effort = np.zeros(width)
            effort[[own[name] for name in mine]], effort[-1] = np.diff(ends), -1.0
            rows.append(effort)
            limits.append(0.0)
    prices = np.concatenate([np.zeros(n), np.diff(ends)]) if cost != "worst" else np.eye(width)[-1]
    bounds = [(-1.0, 1.0)] * n + [(0.0, None)] * (width - n)
    found = linprog(prices, A_ub=np.array(rows), b_ub=limits, bounds=bounds)
    return float(found.fun) if found.status == 0 else np.inf


@pytest.mark.first(1)
@pytest.mark.parametrize(("w", "radius", "x0", "K"), [(0.2, 0.4, 0.5, 3), (0.1, 0.3, -0.4, 2), (0.3, 0.5, 0.3, 3)])
def test_the_tree_of_a_scalar_problem_proves_what_dynamic_programming_finds(
    w: float, radius: float, x0: float, K: int
) -> None:
    truth = by_programming(w, radius, x0, K)
    result, bound = tree(scalar(w, radius, x0), K, K)
    assert np.isfinite(truth) and truth > 0.01
    assert by_all_signals(w, radius, x0, K, K, "nominal") == pytest.approx(truth, abs=1e-9)
    assert bound is not None
    assert bound.lower == pytest.approx(truth, abs=1e-8)
    assert bound.lower <= truth + 1e-9
    assert bound.lower <= result.cost + 1e-9


@pytest.mark.first(6)
@pytest.mark.parametrize(("K", "L"), [(3, 1), (2, 4), (4, 2), (3, 2)])
@pytest.mark.parametrize("cost", ["nominal", "peak", "worst"])
def test_the_tree_proves_no_more_than_all_signals_do_on_any_two_grids(K: int, L: int, cost: str) -> None:
    w, radius, x0 = 0.15, 0.45, 0.5
    truth = by_all_signals(w, radius, x0, K, L, cost)
    _, bound = tree(scalar(w, radius, x0), K, L, cost=cost)
    assert np.isfinite(truth) and truth > 0.01
    assert bound is not None
    assert bound.lower <= truth + 1e-9
    assert bound.lower >= truth - {"nominal": 1e-8, "peak": 0.02, "worst": 1e-8}[cost]


def test_a_difference_within_a_piece_comes_too_late_for_it() -> None:
    """With one piece the control is fixed beforehand, however finely the disturbance changes."""
    w, radius, x0 = 0.05, 0.5, 0.5
    push, free = (np.exp(RATE * T) - 1.0) / RATE, np.exp(RATE * T) * x0
    _, bound = tree(scalar(w, radius, x0), 1, 6)
    assert bound is not None
    assert bound.lower == pytest.approx(T * (free + push * w - radius) / push, abs=1e-8)


def test_what_dynamic_programming_finds_impossible_no_causal_policy_can_do() -> None:
    radius, x0, K = 0.3, 0.2, 3
    last = (np.exp(RATE) - 1.0) / RATE  # what the last piece gives is seen when all is over
    for w, exists in ((radius / last * 0.999, True), (radius / last * 1.001, False)):
        assert np.isfinite(by_programming(w, radius, x0, K)) is np.bool_(exists)
        _, bound = tree(scalar(w, radius, x0), K, K)
        assert bound is not None
        assert (bound.lower == np.inf) is not exists


@pytest.mark.first(1)
@pytest.mark.parametrize(("radius", "x0"), [(0.3, 0.2), (2.5, 1.7)])
def test_the_largest_factor_of_a_tree_is_the_largest_that_dynamic_programming_allows(radius: float, x0: float) -> None:
    K, w = 3, 0.1
    result, _ = tree(scalar(w, radius, x0), K, K)
    search = CausalSearch(result.model, result.decision, active(result.model, result))
    found = search.largest_factor(1e3, FREELY)
    assert found is not None
    good, bad = 0.0, 10.0
    for _ in range(60):
        half = (good + bad) / 2
        good, bad = (half, bad) if np.isfinite(by_programming(w * half, radius, x0, K)) else (good, half)
    assert found[1].value == pytest.approx(good, rel=1e-7)


def test_multipliers_that_are_given_to_another_signal_prove_something_else() -> None:
    """The derivation uses the signals: with those of the tree reversed in sign it does not prove the same."""
    problem = scalar(0.2, 0.4, 0.5)
    result, bound = tree(problem, 3, 3)
    assert bound is not None
    other = replace(bound, signals=tuple(-signal for signal in bound.signals))
    derived = proven(result.model, problem, other)
    assert derived is not None
    assert derived < bound.lower - 0.1


def test_a_signal_outside_of_its_set_proves_nothing() -> None:
    problem = scalar(0.2, 0.4, 0.5)
    result, bound = tree(problem, 3, 3)
    assert bound is not None
    wide: list[Array] = [signal * (1.0 + 1e-9) for signal in bound.signals]
    assert proven(result.model, problem, replace(bound, signals=tuple(wide))) is None


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak", "worst"])
def test_the_units_of_the_control_change_nothing(cost: str) -> None:
    plain, unit = scalar(0.2, 0.7, 0.9), 1e12
    far = replace(
        plain,
        system=sr.LinearSystem([[RATE]], [[unit]], [[1.0]]),
        control=sr.Polytope([[1e3 * unit], [-1e-3 * unit]], [1e3, 1e-3]),  # |unit u| <= 1
        weights=[unit],
    )
    (_, one), (_, other) = (tree(problem, 3, 3, cost=cost) for problem in (plain, far))
    assert one is not None and other is not None and one.lower > 0.1
    assert other.lower == pytest.approx(one.lower, rel=1e-6)
