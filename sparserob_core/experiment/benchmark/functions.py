"""Standard functions to be maximised, vectorised: points ``(k, d)`` to values ``(k,)``."""

from __future__ import annotations

import math

import numpy as np

from sparserob_core.sip.convex_set import Array

GARLAND = math.pi / 6  # where `garland` of one coordinate is largest
GARLAND_MAXIMUM = 4 * GARLAND * (1 - GARLAND)
HOLDER = (8.055023486477124, 9.664590040782658)  # one of the four points where `holder` is largest in [-10, 10]^2
HOLDER_MAXIMUM = 19.208502567886747


def garland(x: Array) -> Array:
    """Needles on a parabola; the largest is at ``pi / 6`` in every coordinate."""
    return np.asarray((x * (1 - x) * (4 - np.sqrt(np.abs(np.sin(60 * x))))).sum(axis=1))


def holder(x: Array) -> Array:
    """Hölder's table, of two coordinates."""
    wave = np.sin(x[:, 0]) * np.cos(x[:, 1])
    return np.asarray(np.abs(wave * np.exp(np.abs(1 - np.hypot(x[:, 0], x[:, 1]) / math.pi))))


def himmelblau(x: Array) -> Array:
    """Himmelblau's function of two coordinates, negated: four points with the value 0."""
    return np.asarray(-((x[:, 0] ** 2 + x[:, 1] - 11) ** 2) - (x[:, 0] + x[:, 1] ** 2 - 7) ** 2)


def ackley(x: Array, top: Array) -> Array:
    """Ackley's function, negated: 0 at ``top (d,)``."""
    z = x - top
    near = 20 * np.exp(-0.2 * np.sqrt((z**2).mean(axis=1)))
    return np.asarray(near + np.exp(np.cos(2 * math.pi * z).mean(axis=1)) - 20 - math.e)


def rastrigin(x: Array, top: Array) -> Array:
    """Rastrigin's function, negated: 0 at ``top (d,)``."""
    z = x - top
    return np.asarray(-(z**2 - 10 * np.cos(2 * math.pi * z) + 10).sum(axis=1))


def rosenbrock(x: Array) -> Array:
    """Rosenbrock's function, negated: 0 where every coordinate is 1."""
    return np.asarray(-(100 * (x[:, 1:] - x[:, :-1] ** 2) ** 2 + (1 - x[:, :-1]) ** 2).sum(axis=1))


def branin(x: Array) -> Array:
    """Branin's function of two coordinates, negated."""
    bend = x[:, 1] - 5.1 / (4 * math.pi**2) * x[:, 0] ** 2 + 5 / math.pi * x[:, 0] - 6
    return np.asarray(-(bend**2) - 10 * (1 - 1 / (8 * math.pi)) * np.cos(x[:, 0]) - 10)


def camel(x: Array) -> Array:
    """The camel with six humps, of two coordinates, negated."""
    a, b = x[:, 0] ** 2, x[:, 1] ** 2
    return np.asarray(-(4 - 2.1 * a + a**2 / 3) * a - x[:, 0] * x[:, 1] + 4 * (1 - b) * b)


def goldstein(x: Array) -> Array:
    """Goldstein's and Price's function of two coordinates, negated: -3 at (0, -1)."""
    a, b = x[:, 0], x[:, 1]
    first_factor = 1 + (a + b + 1) ** 2 * (19 - 14 * a + 3 * a**2 - 14 * b + 6 * a * b + 3 * b**2)
    second_factor = 30 + (2 * a - 3 * b) ** 2 * (18 - 32 * a + 12 * a**2 + 48 * b - 36 * a * b + 27 * b**2)
    return np.asarray(-first_factor * second_factor)


def shekel(x: Array) -> Array:
    """Shekel's ten foxholes, of four coordinates."""
    return np.asarray((1 / (((x[:, None] - FOXHOLES) ** 2).sum(axis=2) + DEPTHS)).sum(axis=1))


def hartmann(x: Array) -> Array:
    """Hartmann's function of three or six coordinates."""
    slopes, centres = HARTMANN[x.shape[1]]
    return np.asarray(np.exp(-(slopes * (x[:, None] - centres) ** 2).sum(axis=2)) @ np.array([1.0, 1.2, 3.0, 3.2]))


def schwefel(x: Array) -> Array:
    """Schwefel's function, whose second best hill is far from the best one."""
    return np.asarray((x * np.sin(np.sqrt(np.abs(x)))).sum(axis=1))


def ellipsoid(x: Array, top: Array) -> Array:
    """An ellipsoid of condition 10^6, negated: 0 at ``top (d,)``."""
    return np.asarray(-((x - top) ** 2) @ np.geomspace(1.0, 1e6, top.size))


def griewank(x: Array, top: Array) -> Array:
    """Griewank's function, negated: 0 at ``top (d,)``."""
    z = x - top
    return np.asarray(np.cos(z / np.sqrt(1 + np.arange(top.size))).prod(axis=1) - 1 - (z**2).sum(axis=1) / 4000)


def levy(x: Array) -> Array:
    """Levy's function, negated: 0 where every coordinate is 1."""
    w = 1 + (x - 1) / 4
    steps = (w[:, :-1] - 1) ** 2 * (1 + 10 * np.sin(math.pi * w[:, :-1] + 1) ** 2)
    last = (w[:, -1] - 1) ** 2 * (1 + np.sin(2 * math.pi * w[:, -1]) ** 2)
    return np.asarray(-(np.sin(math.pi * w[:, 0]) ** 2) - steps.sum(axis=1) - last)


def michalewicz(x: Array) -> Array:
    """Michalewicz' function: steep valleys."""
    number = 1 + np.arange(x.shape[1])
    return np.asarray((np.sin(x) * np.sin(number * x**2 / math.pi) ** 20).sum(axis=1))


def needle(x: Array) -> Array:
    """A narrow peak of height 1 at ``NEEDLE``, beside a broad one of half the height."""
    broad = 0.5 * np.exp(-((x - 0.7) ** 2).sum(axis=1) / (2 * 0.3**2))
    return np.asarray(broad + np.exp(-((x - NEEDLE) ** 2).sum(axis=1) / (2 * 0.03**2)))


NEEDLE = 0.17
FOXHOLES = np.array(
    [
        [4, 4, 4, 4], [1, 1, 1, 1], [8, 8, 8, 8], [6, 6, 6, 6], [3, 7, 3, 7],
        [2, 9, 2, 9], [5, 5, 3, 3], [8, 1, 8, 1], [6, 2, 6, 2], [7, 3.6, 7, 3.6],
    ]
)  # fmt: skip
DEPTHS = np.array([0.1, 0.2, 0.2, 0.4, 0.4, 0.6, 0.3, 0.7, 0.5, 0.5])
HARTMANN = {
    3: (
        np.array([[3, 10, 30], [0.1, 10, 35], [3, 10, 30], [0.1, 10, 35]]),
        1e-4 * np.array([[3689, 1170, 2673], [4699, 4387, 7470], [1091, 8732, 5547], [381, 5743, 8828]]),
    ),
    6: (
        np.array(
            [[10, 3, 17, 3.5, 1.7, 8], [0.05, 10, 17, 0.1, 8, 14], [3, 3.5, 1.7, 10, 17, 8], [17, 8, 0.05, 10, 0.1, 14]]
        ),
        1e-4
        * np.array(
            [
                [1312, 1696, 5569, 124, 8283, 5886],
                [2329, 4135, 8307, 3736, 1004, 9991],
                [2348, 1451, 3522, 2883, 3047, 6650],
                [4047, 8828, 8732, 5743, 1091, 381],
            ]
        ),
    ),
}  # slopes and centres, by the number of coordinates
