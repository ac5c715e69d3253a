"""Taylor series of elementary functions on an interval, with a bound of what a truncated series leaves out.

Every function takes ``degree n``, ``centre`` and the interval ``[low, high]`` around it, and returns the coefficients
of ``1, y, ..., y^n`` with ``y = x - centre`` and a bound of ``|f^(n+1)| / (n+1)!`` on the interval (Lagrange's form of
the remainder).
"""

from __future__ import annotations

import math
from typing import NoReturn, TypeAlias

from sparserob_core.errors import NotEnclosable

Series: TypeAlias = tuple[list[float], float]


def exp_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The exponential."""
    if high > 700.0:
        undefined(f"the exponential of values up to {high:.6g}")
    size = math.exp(centre)
    return [size / math.factorial(k) for k in range(degree + 1)], math.exp(high) / math.factorial(degree + 1)


def sin_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The sine, of which every derivative is at most 1."""
    terms = [math.sin(centre + 0.5 * math.pi * k) / math.factorial(k) for k in range(degree + 1)]
    return terms, 1.0 / math.factorial(degree + 1)


def log_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The natural logarithm; raises `NotEnclosable` unless ``low > 0``."""
    if low <= 0:
        undefined(f"the logarithm of values in [{low:.6g}, {high:.6g}]")
    terms = [math.log(centre)] + [-((-1.0 / centre) ** k) / k for k in range(1, degree + 1)]
    return terms, low ** -(degree + 1) / (degree + 1)


def tanh_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The hyperbolic tangent, from ``t' = 1 - t^2``; Cauchy's bound, as ``|tanh| <= max(1, tan r)`` for
    ``|Im| <= r < pi/2``."""
    terms = [math.tanh(centre)]
    for k in range(degree):
        square = sum(terms[i] * terms[k - i] for i in range(k + 1))
        terms.append(((1.0 if k == 0 else 0.0) - square) / (k + 1))
    radii = [0.25 * math.pi * (1.0 + 0.05 * step) for step in range(19)]
    return terms, min(max(1.0, math.tan(radius)) / radius ** (degree + 1) for radius in radii)


def power_series(power: float, degree: int, centre: float, low: float, high: float) -> Series:
    """A real power; raises `NotEnclosable` unless ``low > 0``."""
    if low <= 0:
        undefined(f"the power {power:g} of values in [{low:.6g}, {high:.6g}]")
    binomials = [1.0]
    for k in range(degree + 1):
        binomials.append(binomials[-1] * (power - k) / (k + 1))
    steepest = max(low ** (power - degree - 1), high ** (power - degree - 1))
    return [binomials[k] * centre ** (power - k) for k in range(degree + 1)], abs(binomials[-1]) * steepest


def undefined(what: str) -> NoReturn:
    """Raises `NotEnclosable`."""
    raise NotEnclosable(f"{what} has no enclosure on this cell of parameters; a smaller cell may have one")
