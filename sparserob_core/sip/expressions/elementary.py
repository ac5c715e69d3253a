"""Taylor series of elementary functions on an interval, with a bound of their truncation error.

Every function takes ``degree n``, ``centre`` and the interval ``[low, high]`` around it, and returns the coefficients
of ``1, y, ..., y^n`` with ``y = x - centre`` and a bound of the truncation error divided by ``|y|^(n+1)``. The bound is
one of ``|f^(n+1)| / (n+1)!`` on the interval (Lagrange's form of the remainder) or Cauchy's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NoReturn, TypeAlias

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import NotEnclosable

Series: TypeAlias = tuple[list[float], float]
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "exp": np.exp,
    "sqrt": np.sqrt,
    "log": np.log,
    "tanh": np.tanh,
}
KEPLER_STEPS = 60  # most are Newton's, and the others halve; a tenth of them leaves 1e-2 where e is near 1
KEPLER_CIRCLES = 50  # down to 4 * 0.85^49 = 1.4e-3; with a tenth of them steps are shorter where e is above 0.9


def exp_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The exponential."""
    if high > 700.0:
        undefined(f"the exponential of values up to {high:.6g}")
    size = math.exp(centre)
    return [size / math.factorial(k) for k in range(degree + 1)], math.exp(high) / math.factorial(degree + 1)


def sin_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The sine, of which every derivative is at most 1."""
    return _build_wave_series(degree, centre, 0)


def cos_series(degree: int, centre: float, low: float, high: float) -> Series:
    """The cosine, of which every derivative is at most 1."""
    return _build_wave_series(degree, centre, 1)


def _build_wave_series(degree: int, centre: float, order: int) -> Series:
    """Return the series of a derivative of the sine, of this ``order``. None is larger than 1."""
    sine, cosine = math.sin(centre), math.cos(centre)
    derivatives = (sine, cosine, -sine, -cosine)
    terms = [derivatives[(k + order) % 4] / math.factorial(k) for k in range(degree + 1)]
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


def kepler_series(eccentricity: float, degree: int, centre: float, low: float, high: float) -> Series:
    """The eccentric anomaly ``E`` with ``E - e sin E = M``, from ``E' (1 - e cos E) = 1``.

    The bound is Cauchy's: on a circle ``|E - E_0| = R`` the anomaly ``M`` differs from its tangent by at most ``q = e
    (|sin E_0| cosh R + |cos E_0| sinh R) R^2 / 2``, so that every ``M`` nearer than ``r = R (1 - e cos E_0) - q`` has
    exactly one ``E`` within it (Rouche), and coefficient ``k > 0`` is at most ``R / r^k``. The radius depends on
    ``E_0``: it is small only near the pericentre of a long ellipse. Raises `NotEnclosable` where the interval is wider
    than the largest ``r``.
    """
    e, E = eccentricity, float(eccentric_anomaly(centre, eccentricity))
    sine, cosine = math.sin(E), math.cos(E)
    slope = 1.0 - e * cosine
    terms, s, c = [E], [sine], [cosine]
    for n in range(degree):
        convolution = sum((k + 1) * terms[k + 1] * e * c[n - k] for k in range(n))
        terms.append(((1.0 if n == 0 else 0.0) + convolution) / (slope * (n + 1)))
        s.append(sum((k + 1) * terms[k + 1] * c[n - k] for k in range(n + 1)) / (n + 1))
        c.append(-sum((k + 1) * terms[k + 1] * s[n - k] for k in range(n + 1)) / (n + 1))
    half, best = max(centre - low, high - centre), math.inf
    for step in range(KEPLER_CIRCLES):
        R = 4.0 * 0.85**step
        q = 0.5 * e * (abs(sine) * math.cosh(R) + abs(cosine) * math.sinh(R)) * R * R
        r = (R * slope - q) * (1.0 - 1e-9)  # what is rounded here is far less
        if r > half:
            best = min(best, R / r ** (degree + 1) / (1.0 - half / r))
    if best == math.inf:
        undefined(f"Kepler's equation for anomalies in [{low:.6g}, {high:.6g}]")
    return terms, best


def eccentric_anomaly(anomaly: npt.ArrayLike, eccentricity: float) -> Any:
    """Return the ``E`` with ``E - e sin E = M``, for numbers ``M (...)`` and ``0 <= e < 1``.

    Newton's method starts in ``[M - e, M + e]``, and halves the interval known to hold the root where a step leaves it.
    """
    M = np.asarray(anomaly, dtype=float)
    low, high = M - eccentricity, M + eccentricity
    E = M + eccentricity * np.sin(M)
    for _ in range(KEPLER_STEPS):
        residual = E - eccentricity * np.sin(E) - M
        low, high = np.where(residual < 0.0, E, low), np.where(residual > 0.0, E, high)
        iterate, before = E - residual / (1.0 - eccentricity * np.cos(E)), E
        E = np.where((iterate >= low) & (iterate <= high), iterate, (low + high) / 2)
        if np.array_equal(E, before):  # no further step changes anything
            break
    return E if M.ndim else np.float64(E)


def undefined(what: str) -> NoReturn:
    """Raise `NotEnclosable`: an operation has no enclosure on this cell of parameters."""
    raise NotEnclosable(f"{what} has no enclosure on this cell of parameters; a smaller cell may have one")
