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
