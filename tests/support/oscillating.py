"""Semi-infinite programs whose violation has many local maxima of about one height, given by their rows alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import chebyshev

import sparserob_core as sr

FINEST = {1: 200_001, 2: 2_000}
"""Points along each coordinate at which a solution is looked at: of an interval, of a square."""


def family(name, lower, upper, rows):
    return sr.ConstraintFamily(name=name, index_set=sr.Box(lower, upper), rows=rows)


def chebyshev_basis(degree, lower, upper):
    """Chebyshev polynomials up to a degree in one coordinate, products of them in two."""
    lower, upper = np.atleast_1d(lower).astype(float), np.atleast_1d(upper).astype(float)

    def basis(t):
        unit = (2 * t - lower - upper) / (upper - lower)
        values = chebyshev.chebvander(unit[:, 0], degree)
        for other in unit.T[1:]:
            more = chebyshev.chebvander(other, degree)
            values = (values[:, :, np.newaxis] * more[:, np.newaxis]).reshape(len(t), -1)
        return values

    return basis


def uniform(f, basis, lower, upper, bound=np.inf):
    """The best uniform approximation of ``f``: the decision is the coefficients and the largest error."""
    n = basis(np.atleast_2d(np.asarray(lower, dtype=float))).shape[1] + 1

    def side(sign):
        return lambda t: (np.hstack([sign * basis(t), -np.ones((len(t), 1))])[:, np.newaxis], sign * f(t)[:, None])

    families = [family(name, lower, upper, side(sign)) for name, sign in (("over", 1.0), ("under", -1.0))]
    return sr.SemiInfiniteProgram(n=n, q=np.eye(n)[-1], lower=-bound, upper=bound, families=families)


def one_sided(f, basis, lower, upper, bound=100.0):
    """The approximation of ``f`` from above whose mean is least."""
    grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 201 if len(lower) > 1 else 20_001).T), -1)
    q = basis(grid.reshape(-1, len(lower))).mean(axis=0)
    above = family("above", lower, upper, lambda t: (-basis(t)[:, np.newaxis], -f(t)[:, None]))
    return sr.SemiInfiniteProgram(n=q.size, q=q, lower=-bound, upper=bound, families=[above])


def _on(f, degree, lower, upper, bound=np.inf, made=uniform):
    lower, upper = np.atleast_1d(lower).astype(float), np.atleast_1d(upper).astype(float)
    return lambda: made(f, chebyshev_basis(degree, lower, upper), lower, upper, bound)


def _line(f):
    return lambda t: f(t[:, 0])


def _plane(f):
    return lambda t: f(t[:, 0], t[:, 1])


def sum_of_cosines(t):
    return sum(0.5**k * np.cos(3**k * t) for k in range(5))


def filtered(taps, bands, desired):
    """An equiripple filter: the amplitude of ``taps`` symmetric coefficients beside its wanted value on bands."""
    k = np.arange((taps + 1) // 2) if taps % 2 else np.arange(taps // 2) + 0.5
    n = k.size + 1

    def side(sign, wanted):
        return lambda f: (
            np.hstack([sign * np.cos(2 * np.pi * f * k), -np.ones((len(f), 1))])[:, np.newaxis],
            np.full((len(f), 1), sign * wanted),
        )

    families = [
        family(f"band {i} {sign:+d}", [low], [high], side(sign, wanted))
        for i, ((low, high), wanted) in enumerate(zip(bands, desired, strict=True))
        for sign in (1, -1)
    ]
    return sr.SemiInfiniteProgram(n=n, q=np.eye(n)[-1], families=families)


def two_waves(t):
    return np.sin(t) ** 2 + np.sin(t**2)


def of_degree(degree):
    return lambda a, b: np.sin(degree * a) * np.cos((degree + 1) * b)


PROGRAMS: dict[str, Callable[[], sr.SemiInfiniteProgram]] = {
    "two waves, degree 8": _on(_line(two_waves), 8, 0, 15),
    "two waves, degree 20": _on(_line(two_waves), 20, 0, 15),
    "two waves, degree 30": _on(_line(two_waves), 30, 0, 15),
    "two waves, degree 40": _on(_line(two_waves), 40, 0, 15),
    "two waves, bounded, degree 20": _on(_line(two_waves), 20, 0, 15, 100.0),
    "two waves, bounded, degree 40": _on(_line(two_waves), 40, 0, 15, 100.0),
    "kink, degree 24": _on(_line(lambda t: np.abs(t - 0.3)), 24, -1, 1, 100.0),
    "root, degree 16": _on(_line(np.sqrt), 16, 0, 1, 100.0),
    "Runge, degree 20": _on(_line(lambda t: 1 / (1 + 25 * t**2)), 20, -1, 1, 100.0),
    "Runge, degree 40": _on(_line(lambda t: 1 / (1 + 25 * t**2)), 40, -1, 1, 100.0),
    "sine of 50 t, degree 40": _on(_line(lambda t: np.sin(50 * t)), 40, -1, 1, 100.0),
    "sine of 200 t, degree 12": _on(_line(lambda t: np.sin(200 * t) * (1 + t / 9)), 12, -1, 1, 100.0),
    "chirp, degree 30": _on(_line(lambda t: np.sin(30 * t**2)), 30, 0, 1.5, 100.0),
    "fast chirp, degree 16": _on(_line(lambda t: np.sin(90 * t**3)), 16, 0, 1.5, 100.0),
    "step, degree 32": _on(_line(lambda t: np.tanh(50 * (t - 0.2))), 32, -1, 1, 100.0),
    "needle, degree 20": _on(_line(lambda t: np.exp(-(((t - 0.37) / 0.003) ** 2))), 20, -1, 1, 100.0),
    "two needles, degree 12": _on(
        _line(lambda t: np.exp(-(((t - 0.37) / 0.001) ** 2)) - 1 / (1 + ((t + 0.61) / 0.0005) ** 2)), 12, -1, 1, 100.0
    ),
    "arches, degree 36": _on(_line(lambda t: np.abs(np.sin(7 * t))), 36, -1, 1, 100.0),
    "sum of cosines, degree 24": _on(_line(sum_of_cosines), 24, 0, 2, 100.0),
    "three sines, degree 16": _on(_line(lambda t: np.sin(13 * t) * np.sin(17 * t) * np.sin(29 * t)), 16, 0, 3, 100.0),
    "three sines, degree 8": _on(_line(lambda t: np.sin(13 * t) * np.sin(17 * t) * np.sin(29 * t)), 8, 0, 9, 100.0),
    "from above, sine, degree 20": _on(_line(lambda t: np.sin(40 * t)), 20, -1, 1, 100.0, one_sided),
    "from above, chirp, degree 12": _on(_line(lambda t: np.sin(30 * t**2)), 12, 0, 1.5, 100.0, one_sided),
    "from above, Runge, degree 30": _on(_line(lambda t: 1 / (1 + 25 * t**2)), 30, -1, 1, 100.0, one_sided),
    "filter, narrow": lambda: filtered(16, [(0, 0.005), (0.05, 0.5)], [1, 0]),
    "filter, half": lambda: filtered(41, [(0, 0.25 - 1 / 32), (0.25 + 1 / 32, 0.5)], [2, 0]),
    "filter, band": lambda: filtered(80, [(0, 0.25), (0.301, 0.36), (0.42, 0.5)], [0, 1, 0]),
    "square, waves 8, degree 3": _on(_plane(of_degree(8)), 3, [-1, -1], [1, 1], 100.0),
    "square, waves 12, degree 2": _on(_plane(of_degree(12)), 2, [-1, -1], [1, 1], 100.0),
    "square, waves 20, degree 2": _on(_plane(of_degree(20)), 2, [-1, -1], [1, 1], 100.0),
    "square, waves 5, degree 5": _on(_plane(of_degree(5)), 5, [-1, -1], [1, 1], 100.0),
    "square, Watson 8": _on(_plane(lambda a, b: np.exp(a**2 + b**2)), 2, [0, 0], [1, 1], 100.0, one_sided),
    "square, Watson 9": _on(
        _plane(lambda a, b: np.exp(np.sin(9 * a) + np.cos(11 * b))), 3, [0, 0], [1, 1], 1e4, one_sided
    ),
    "square, kinks": _on(_plane(lambda a, b: np.abs(a - b) + np.abs(a + b - 0.3)), 3, [-1, -1], [1, 1], 100.0),
    "square, needle": _on(
        _plane(lambda a, b: np.exp(-((a - 0.3) ** 2 + (b + 0.2) ** 2) / 0.02**2)), 3, [-1, -1], [1, 1], 100.0
    ),
    "square, rings": _on(_plane(lambda a, b: np.cos(25 * (a * a + b * b))), 3, [-1, -1], [1, 1], 100.0),
}


def largest_violation(program, x):
    """The largest violation at ``x (n,)`` on the grid of `FINEST` points, over all families and rows."""
    worst = -np.inf
    for one in program.families:
        box = one.index_set
        side = FINEST[box.dimension]
        lines = [np.linspace(a, b, side) for a, b in zip(box.lower, box.upper, strict=True)]
        blocks = np.array_split(lines[0], 40 if box.dimension == 1 else 200)
        for block in blocks:
            points = np.stack(np.meshgrid(block, *lines[1:], indexing="ij"), axis=-1).reshape(-1, box.dimension)
            worst = max(worst, float(one.violations(x, points).max()))
    return worst
