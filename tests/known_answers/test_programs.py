"""Guards known answers: the shipped programs that are stated as text, with values that closed forms or linear programs
of scipy give, which share no line with the rows of the config."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import chebyshev
from scipy.optimize import linprog, minimize, minimize_scalar, nnls
from scipy.signal import remez

import sparserob_core as sr
from tests.support.places import CONFIGS

Points = np.ndarray
Basis = Callable[[Points], np.ndarray]


def solve_linear(cost: np.ndarray, G: np.ndarray, h: np.ndarray) -> np.ndarray:
    """Return the solution of ``min cost x`` with ``G x <= h``, by HiGHS."""
    options = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    solution = linprog(cost, G, h, bounds=(None, None), method="highs-ds", options=options)
    assert solution.status == 0
    return np.asarray(solution.x)


def peaks(sizes: np.ndarray, bands: list[Points]) -> Points:
    """Return the points at which a function has a maximum, by a parabola through three points."""
    found, start = [], 0
    for band in bands:
        part, start = sizes[start : start + band.size], start + band.size
        found += [band[:1], band[-1:]]
        k = 1 + np.flatnonzero((part[1:-1] >= part[:-2]) & (part[1:-1] >= part[2:]))
        curvature = part[k - 1] - 2.0 * part[k] + part[k + 1]
        shift = 0.5 * (part[k - 1] - part[k + 1]) / np.where(curvature == 0.0, 1.0, curvature)
        found.append(band[k] + np.clip(shift, -1.0, 1.0) * (band[1] - band[0]))
    return np.concatenate(found)


def least_error(
    basis: Basis, target: Basis, bands: list[tuple[float, float]], phases: np.ndarray, spacing: int = 250
) -> float:
    """Return the least of the largest modulus of ``basis a - target`` for real ``a``, by cutting planes from the peaks
    of the error on a fine grid; the first rows are so many of its points apart."""
    grids = [np.linspace(low, high, 20_001) for low, high in bands]
    fine = np.concatenate(grids)
    B, f = basis(fine), target(fine)
    coarse = np.concatenate([grid[::spacing] for grid in grids])
    points, turns = np.repeat(coarse, phases.size), np.tile(phases, coarse.size)
    for _ in range(40):
        G = np.hstack([(turns[:, None] * basis(points)).real, -np.ones((points.size, 1))])
        x = solve_linear(np.eye(B.shape[1] + 1)[-1], G, (turns * target(points)).real)
        new = peaks(np.abs(B @ x[:-1] - f), grids)
        error = basis(new) @ x[:-1] - target(new)
        if np.abs(error).max() <= x[-1] * (1.0 + 1e-8):
            return float(x[-1])
        points = np.concatenate([points, new])
        turns = np.concatenate([turns, np.conj(error) / np.maximum(np.abs(error), 1e-300)])
    raise AssertionError("the cutting planes did not converge")


def cosines(count: int) -> Basis:
    return lambda w: np.cos(2 * np.pi * np.outer(w, np.arange(count)))


def low_pass() -> float:
    bands = [(0.0, 0.21875), (0.28125, 0.5)]
    return least_error(cosines(21), lambda w: 2.0 * (w < 0.25), bands, np.array([1.0, -1.0]))


def band_pass() -> float:
    def weight(w: Points) -> Points:
        return np.where((w > 0.12) & (w < 0.32), 1.0, 10.0)

    bands = [(0.0, 0.1), (0.15, 0.3), (0.35, 0.5)]
    return least_error(
        lambda w: weight(w)[:, None] * cosines(26)(w), lambda w: 1.0 * (weight(w) == 1.0), bands, np.array([1.0, -1.0])
    )


def half_cosines(count: int) -> Basis:
    return lambda w: np.cos(np.pi * np.outer(w, 2 * np.arange(count) + 1))


def long_filter() -> float:
    bands = [(0.0, 0.29), (0.301, 0.36), (0.402, 0.5)]
    return least_error(half_cosines(100), lambda w: 1.0 * ((w > 0.3) & (w < 0.4)), bands, np.array([1.0, -1.0]))


def narrow_filter() -> float:
    bands = [(0.0, 0.005), (0.05, 0.5)]
    return least_error(half_cosines(8), lambda w: 1.0 * (w < 0.01), bands, np.array([1.0, -1.0]))


def wiggly() -> float:
    def basis(x: Points) -> np.ndarray:
        return np.asarray(chebyshev.chebvander(2 * x / 15 - 1, 110))

    return least_error(basis, lambda x: np.sin(x) ** 2 + np.sin(x**2), [(0.0, 15.0)], np.array([1.0, -1.0]), 40)


def complex_filter() -> float:
    return least_error(
        lambda w: np.exp(2j * np.pi * np.outer(w, np.arange(9))),
        lambda w: np.where(w < 0.2, np.exp(5j * np.pi * w), 0.0),
        [(0.0, 0.125), (0.25, 0.5)],
        np.exp(0.25j * np.pi * np.arange(8)),
    )


def absolute_value() -> float:
    """The error for ``sqrt(t)``, with ``t = x^2``."""
    return least_error(
        lambda x: chebyshev.chebvander(2 * x**2 - 1, 10), lambda x: x, [(0.0, 0.1), (0.1, 1.0)], np.array([1.0, -1.0])
    )


def monomials(p: Points) -> np.ndarray:
    y, z = p.T
    return np.stack([np.ones_like(y), y, z, y * y, y * z, z * z], axis=1)


def watson8() -> float:
    """Grids about the points that bind, ever finer."""
    cost, width = np.array([1, 1 / 2, 1 / 2, 1 / 3, 1 / 4, 1 / 3]), 1.0 / 60
    points = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 61)]), axis=-1).reshape(-1, 2)
    offsets = np.stack(np.meshgrid(*2 * [np.linspace(-1, 1, 9)]), axis=-1).reshape(-1, 2)
    for _ in range(9):
        bound = np.exp((points**2).sum(axis=1))
        x = solve_linear(cost, -monomials(points), -bound)
        binding = points[monomials(points) @ x - bound < 1e-3 * width**2 + 1e-9]
        near = np.clip((binding[:, None] + width * offsets).reshape(-1, 2), 0.0, 1.0)
        points, width = np.unique(np.concatenate([points, near]), axis=0), width / 4
        points = points[monomials(points) @ x - np.exp((points**2).sum(axis=1)) < 64 * width**2]
    return float(cost @ x)


def triangle() -> float:
    """Cutting planes from the peaks of the error on a grid of weights of the three vertices, each of them zoomed in."""
    corners = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    weights = np.array([(i, j, 120 - i - j) for i in range(121) for j in range(121 - i)]) / 120
    offsets = np.array([(i, j, -i - j) for i in range(-4, 5) for j in range(-4, 5)]) / 4
    imposed = weights[::37]

    def target(w: np.ndarray) -> np.ndarray:
        return np.exp((w @ corners).prod(axis=1)) * np.sin(w @ corners @ [1.0, 2.0])

    for _ in range(40):
        basis, values = monomials(imposed @ corners), target(imposed)
        G = np.vstack([np.insert(sign * basis, 6, -1.0, axis=1) for sign in (1.0, -1.0)])
        x = solve_linear(np.eye(7)[-1], G, np.concatenate([values, -values]))

        def error(w: np.ndarray, a: np.ndarray = x[:-1]) -> np.ndarray:
            return np.abs(monomials(w @ corners) @ a - target(w))

        best, peak = list[np.ndarray](), 0.0
        sizes = error(weights)
        for _ in range(12):
            place, width = weights[sizes.argmax()], 1.0 / 120
            sizes[np.abs(weights - place).max(axis=1) < 0.1] = 0.0
            for _ in range(14):
                near = np.maximum(place + width * offsets, 0.0)
                near /= near.sum(axis=1, keepdims=True)
                place, width = near[error(near).argmax()], width / 3
            best.append(place)
            peak = max(peak, float(error(place[None])[0]))
        if peak <= x[-1] * (1.0 + 1e-8):
            return float(x[-1])
        imposed = np.vstack([imposed, best])
    raise AssertionError("the cutting planes did not converge")


def clique() -> float:
    """Motzkin and Straus (1965), with all sets of vertices looked at."""
    edges = {frozenset(edge) for edge in ((1, 2), (1, 3), (2, 3), (3, 4), (4, 5), (1, 5))}
    sizes = [
        size
        for size in range(1, 6)
        for group in combinations(range(1, 6), size)
        if all(frozenset(pair) in edges for pair in combinations(group, 2))
    ]
    return 1.0 - 1.0 / max(sizes)


def tangent() -> float:
    """Lobatto's rule with four nodes."""
    nodes = (1 + np.array([-1, -math.sqrt(0.2), math.sqrt(0.2), 1])) / 2
    return float(np.array([1, 5, 5, 1]) / 12 @ np.tan(nodes))


def option() -> float:
    mean, deviation, strike = 100.0, 20.0, 105.0
    return (mean - strike + math.hypot(deviation, mean - strike)) / 2


def option_three_stocks() -> float:
    """The multiplier of the payoff is the only unknown: the quadratic that is cheapest for it is known, for the problem
    is the same in all stocks."""
    mean, variance, covariance, strike = 44.21, 184.04, 164.88, 40.0
    spread, apart = math.sqrt((variance + 2 * covariance) / 3), (variance - covariance) / 3

    def lagrangian(share: float) -> float:
        price = share * (mean - strike) + spread * math.sqrt(share * (1 - share)) + 2 * math.sqrt(apart * share)
        return -price

    return -float(minimize_scalar(lagrangian, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-9}).fun)


def watson5() -> float:
    """Newton's method on the three powers, with the row imposed at the maxima of its violation only: at 0 and 1, and at
    ``t``, which is chosen best."""

    def least(t: float) -> float:
        nodes = np.array([0.0, t, 1.0])
        target = 1 / (1 + nodes**2)
        rows = {"type": "ineq", "fun": lambda x: np.vander(nodes, 3, increasing=True) @ x - target}
        start = np.linalg.solve(np.vander(nodes, 3, increasing=True), target)
        return float(minimize(lambda x: np.exp(x).sum(), start, constraints=rows, tol=1e-14).fun)

    found = minimize_scalar(lambda t: -least(t), bounds=(0.05, 0.95), method="bounded", options={"xatol": 1e-8})
    return -float(found.fun)


def monotone_fit() -> float:
    """Linear programs with rows near the points that bind, ever finer."""
    t, k, points = np.linspace(0, 1, 11), np.arange(6), np.linspace(0, 1, 2001)
    y = np.array([0.02, 0.25, 0.21, 0.18, 0.24, 0.21, 0.46, 0.83, 0.79, 0.75, 0.93])
    V, eye = np.vander(t, 6, increasing=True), np.eye(11)
    for width in (1e-3, 1e-5, 1e-7):
        slopes = k * points[:, None] ** np.maximum(k - 1, 0)
        G = np.block([[V, -eye], [-V, -eye], [-slopes, np.zeros((points.size, 11))]])
        cost = np.concatenate([np.zeros(6), np.ones(11)])
        x = solve_linear(cost, G, np.concatenate([y, -y, np.zeros(points.size)]))
        binding = points[slopes @ x[:6] < 1e-7]
        points = np.unique(np.clip(np.concatenate([binding, (binding[:, None] + width * t).ravel()]), 0, 1))
        points = np.unique(np.clip(np.concatenate([points, (binding[:, None] - width * t).ravel()]), 0, 1))
        points = np.concatenate([points, np.linspace(0, 1, 2001)])
    return float(cost @ x)


def convex_fit() -> float:
    """Least squares under rows at many points, by their multipliers (Lawson and Hanson 1974)."""
    t = np.linspace(0, 1, 11)
    y = np.array([1.02, 0.71, 0.52, 0.21, 0.22, 0.14, 0.18, 0.06, 0.22, 0.35, 0.97])
    k, matrix, points = np.arange(7), np.vander(t, 7, increasing=True), np.linspace(0, 1, 1001)
    Q, R = np.linalg.qr(matrix)
    for width in (1e-3, 1e-5, 1e-7):
        C = k * (k - 1) * points[:, None] ** np.maximum(k - 2, 0)
        multipliers, _ = nnls(np.linalg.solve(R.T, C.T), -(Q.T @ y))
        a = np.linalg.solve(R, Q.T @ y + np.linalg.solve(R.T, C.T @ multipliers))
        near = points[multipliers > 0, None] + width * np.linspace(-1, 1, 201)
        points = np.clip(np.concatenate([points[multipliers > 0], near.ravel()]), 0, 1)
    return float(((matrix @ a - y) ** 2).sum())


def portfolio() -> float:
    """Minus the least of the largest return over a disc: it lies where one is least, or two meet on the circle, or
    three meet."""
    mean = np.array([0.05, 0.07, 0.09, 0.12])
    F = np.array([[0.01, 0.02], [0.03, -0.04], [-0.02, 0.07], [0.09, 0.05]])
    candidates = list(-F / np.linalg.norm(F, axis=1, keepdims=True))
    for i, j in combinations(range(4), 2):
        normal, offset = F[i] - F[j], mean[j] - mean[i]
        size = float(normal @ normal)
        if offset**2 <= size:
            along = np.array([-normal[1], normal[0]]) * math.sqrt(1 / size - (offset / size) ** 2)
            candidates += [normal * offset / size + along, normal * offset / size - along]
    for i, j, k in combinations(range(4), 3):
        meeting = np.linalg.solve([F[i] - F[j], F[i] - F[k]], [mean[j] - mean[i], mean[k] - mean[i]])
        candidates += [meeting] if meeting @ meeting <= 1.0 else []
    return -min(float((mean + F @ u).max()) for u in candidates)


def camel() -> float:
    def function(p: Points) -> float:
        x, y = p
        return float((4 - 2.1 * x**2 + x**4 / 3) * x**2 + x * y + 4 * (y**2 - 1) * y**2)

    starts = [(x, y) for x in np.linspace(-2, 2, 5) for y in np.linspace(-1, 1, 5)]
    return -min(float(minimize(function, start, tol=1e-12).fun) for start in starts)


VALUES: dict[str, Callable[[], float]] = {
    "absolute_value": absolute_value,
    "band_pass": band_pass,
    "beam_pattern": lambda: 1 / math.cosh(15 * math.acosh(1 / math.cos(math.pi * math.sin(0.15) / 2))),
    "camel": camel,
    "clique_number": clique,
    "complex_filter": complex_filter,
    "convex_fit": convex_fit,
    "equiripple": low_pass,
    "kissing_number": lambda: 240.0,
    "long_filter": long_filter,
    "monotone_fit": monotone_fit,
    "narrow_filter": narrow_filter,
    "one_sided_tangent": tangent,
    "option_moments": option,
    "option_three_stocks": option_three_stocks,
    "reciprocal": lambda: 1 / math.cosh(11 * math.acosh(11 / 9)),
    "robust_portfolio": portfolio,
    "triangle": triangle,
    "watson5": watson5,
    "watson7": lambda: 1.0,  # the row at 0 says x_0 <= -1, and (-1, 0, 0) keeps all rows
    "watson8": watson8,
    "watson9": lambda: -12.0,  # four times the row at the points with s^2 = t^2 = 1/6; 3 keeps all rows
    "wiggly": wiggly,
}
"""Values of the configs, by other means."""
PUBLISHED = {
    "camel": (1.031628453, 1e-6),
    "one_sided_tangent": (0.616085, 1e-6),
    "option_three_stocks": (13.20, 5e-4),
    "watson8": (2.4356434882, 1e-6),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PUBLISHED)
def test_the_value_is_the_published_one(name: str) -> None:
    value, digits = PUBLISHED[name]
    assert VALUES[name]() == pytest.approx(value, rel=digits)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "taps", "bands", "gains", "error"),
    [
        ("long_filter", 200, [0, 0.29, 0.301, 0.36, 0.402, 0.5], [0, 1, 0], 0.006998901),
        ("narrow_filter", 16, [0, 0.005, 0.05, 0.5], [1, 0], 0.15907151),
    ],
)
def test_the_exchange_of_remez_in_scipy_loses_what_the_table_says(
    name: str, taps: int, bands: list[float], gains: list[float], error: float
) -> None:
    amplitude = half_cosines(taps // 2)
    filtered = 2.0 * remez(taps, bands, gains)[taps // 2 :]
    grids = [np.linspace(low, high, 50_001) for low, high in zip(bands[::2], bands[1::2], strict=True)]
    errors = [np.abs(amplitude(grid) @ filtered - gain).max() for grid, gain in zip(grids, gains, strict=True)]
    assert max(errors) == pytest.approx(error, rel=1e-3)
    assert max(errors) > VALUES[name]() * (1.0 + 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", VALUES)
def test_a_stated_program_has_its_known_value_with_a_proof_that_is_checked(name: str, tmp_path: Path) -> None:
    result = sr.run(CONFIGS / f"{name}.yaml", {"observers": []}, out=tmp_path / "run", figures=False).result
    assert result.status == "certified", result.message
    assert result.cost == pytest.approx(VALUES[name](), rel=1e-6)
    assert result.lower_bound <= result.cost
    assert [claim for claim in sr.check(tmp_path / "run").claims if claim.verdict != "holds"] == []
