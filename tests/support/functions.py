"""Functions whose global maxima are known, to be maximised by tests and benchmarks: named records, vectorised over
points ``(k, d)``.

The optimum of the shifted ones lies off the centre of the box and off its thirds, where a centre-first or splitting
method would meet it by luck.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import sparserob_core as sr
from sparserob_core.experiment.benchmark.functions import (
    GARLAND,
    GARLAND_MAXIMUM,
    HOLDER,
    HOLDER_MAXIMUM,
    ackley,
    garland,
    himmelblau,
    holder,
    rastrigin,
    rosenbrock,
)

GARLAND_FLOOR = 2e-8  # what rounding of the argument leaves of the square root at the top of `garland1`
TOP_OF_RASTRIGIN = np.array([0.7123, -1.3391, 1.0417])
TOP_OF_ACKLEY = np.array([7.31, -11.87])


@dataclass(frozen=True, eq=False)
class Landscape:
    """A function to be maximised over a box, its maximum, and one point where it is attained."""

    name: str
    function: Callable[[np.ndarray], np.ndarray]
    box: sr.Box
    maximum: float
    maximiser: np.ndarray

    def regret(self, value: float) -> float:
        """How far a value falls short of the maximum."""
        return self.maximum - value


def distance_to_inverse_e(x):
    return -np.abs(x[:, 0] - math.exp(-1))


def double_sine(x, centre=1 / math.e, rho=(0.3, 0.8)):
    """Two envelopes ``u^e`` and a sine in ``log u`` between them (Grill, Valko and Munos 2015), ``u`` twice the
    distance to the centre."""
    narrow, wide = (-math.log2(r) for r in rho)
    u = 2 * np.abs(x[:, 0] - centre)
    safe = np.where(u > 0, u, 1.0)
    wave = (np.sin(math.pi * np.log2(safe)) + 1) / 2
    return np.where(u > 0, wave * (safe**wide - safe**narrow) - safe**wide, 0.0)


def complex_holder(x):
    """dlib's discontinuous relative of `holder`: bands of the first coordinate are shifted to and fro, and a fast wave
    is added."""
    moved, other, sign = x[:, 0].copy(), x[:, 1], 1.0
    for step in range(26):
        start = -4 + 0.5 * step
        moved = np.where((start < moved) & (moved < start + 0.5), moved + 0.25 * sign, moved)
        sign = -sign
    return holder(np.column_stack([moved, other])) - (moved + other) / 10 - np.sin(10 * moved) * np.cos(10 * other)


def sphere(x):
    return -np.linalg.norm(x - math.pi / 16, axis=1)


def deb(x):
    return (np.sin(5 * math.pi * x) ** 6).mean(axis=1)


def linear_slope(x):
    return 10 ** (np.arange(x.shape[1]) / x.shape[1]) @ (x - 5).T


def square(x):
    return -(x**2).sum(axis=1)


def _cube(lower, upper, dimension):
    return sr.Box(np.full(dimension, float(lower)), np.full(dimension, float(upper)))


def _listed(*landscapes):
    return {landscape.name: landscape for landscape in landscapes}


LANDSCAPES = _listed(
    Landscape("garland1", garland, _cube(0, 1, 1), GARLAND_MAXIMUM, np.array([GARLAND])),
    Landscape("inverse_e", distance_to_inverse_e, _cube(0, 1, 1), 0.0, np.array([math.exp(-1)])),
    Landscape("double_sine", double_sine, _cube(0, 1, 1), 0.0, np.array([math.exp(-1)])),
    Landscape("holder2", holder, _cube(-10, 10, 2), HOLDER_MAXIMUM, np.array(HOLDER)),
    Landscape(
        "complex_holder",
        complex_holder,
        _cube(-10, 10, 2),
        21.92103966354689,
        np.array([-8.019008764680642, -9.727163884685025]),
    ),
    Landscape("himmelblau2", himmelblau, _cube(-5, 5, 2), 0.0, np.array([3.0, 2.0])),
    Landscape("ackley2s", lambda x: ackley(x, TOP_OF_ACKLEY), _cube(-32.768, 32.768, 2), 0.0, TOP_OF_ACKLEY),
    Landscape("rastrigin3", lambda x: rastrigin(x, np.zeros(3)), _cube(-5.12, 5.12, 3), 0.0, np.zeros(3)),
    Landscape("rastrigin3s", lambda x: rastrigin(x, TOP_OF_RASTRIGIN), _cube(-5.12, 5.12, 3), 0.0, TOP_OF_RASTRIGIN),
    Landscape("rosenbrock2", rosenbrock, _cube(-2.048, 2.048, 2), 0.0, np.ones(2)),
    Landscape("rosenbrock3", rosenbrock, _cube(-2.048, 2.048, 3), 0.0, np.ones(3)),
    Landscape("sphere4", sphere, _cube(0, 1, 4), 0.0, np.full(4, math.pi / 16)),
    Landscape("deb5", deb, _cube(-5, 5, 5), 1.0, np.full(5, 0.1)),
    Landscape("linear_slope4", linear_slope, _cube(-5, 5, 4), 0.0, np.full(4, 5.0)),
    Landscape("square2", square, _cube(-10, 10, 2), 0.0, np.zeros(2)),
)
