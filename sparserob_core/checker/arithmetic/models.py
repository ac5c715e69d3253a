"""Numbers that depend on the time and on parameters: polynomials with balls as coefficients (Taylor models, Makino and
Berz 2003)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, final

import numpy as np
from flint import arb, arb_poly, arb_series, ctx

from sparserob_core.checker.arithmetic.balls import above, ball
from sparserob_core.checker.arithmetic.bernstein import highest
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.sip.convex_set import Array

MAX_POWER = 64  # the largest integer exponent for which a power is multiplied out
NEGATIVE = 1e-12  # of values near 1: what a remainder may leave below 0 of a value that is not negative
ENOUGH = 2.0**-110  # the relative remainder of a function's series: a smaller one takes terms without a visible effect
NEWTON = 80  # steps of Newton's method, or halvings of an interval; with a tenth of them long ellipses get wide balls

Part: TypeAlias = "arb_poly | None"


@final
@dataclass(frozen=True)
class Frame:
    """The variables of models, and the degrees that models keep.

    The time runs from -1 to 1 across an interval, up to an ``order``. The ``monomials`` are those of parameters, which
    run from -1 to 1 across a box.
    """

    monomials: Monomials
    order: int

    def number(self, value: arb) -> Model:
        """Return the model of a constant."""
        return self._build_model([value])

    def time(self, middle: arb, half: arb) -> Model:
        """Return the model of ``middle + half r``, with the time ``r`` in ``[-1, 1]``."""
        return self._build_model([middle, half])

    def parameter(self, place: int, middle: arb, half: arb) -> Model:
        """Return the model of ``middle + half s_place``, with the parameter ``s_place`` in ``[-1, 1]``."""
        model = self.number(middle)
        if not half.is_zero():
            model.parts[self.monomials.linear(place)] = arb_poly([half])
        return model

    def _build_model(self, coefficients: list[arb]) -> Model:
        return Model(self, [arb_poly(coefficients), *[None] * (self.monomials.size - 1)])


@final
class Model:
    """A number ``sum_k parts_k(r) s^k`` that depends on the time ``r`` and the parameters ``s``.

    At every ``(r, s)`` the true number lies in the ball that the coefficients give. Terms of a product beyond the
    degrees of the frame are bounded, since ``|r|, |s| <= 1``, and added to the radius of the lowest coefficient.
    """

    __slots__ = ("frame", "parts")

    def __init__(self, frame: Frame, parts: Sequence[Part]) -> None:
        self.frame, self.parts = frame, list(parts)

    @property
    def constant(self) -> arb:
        """The term that depends on neither the time nor a parameter."""
        coefficient = self.parts[0]
        return ball(0) if coefficient is None else coefficient[0]

    @property
    def size(self) -> arb:
        """The ball whose upper end bounds the absolute value at every time and parameter."""
        return sum((_bound_polynomial(coefficient) for coefficient in self.parts if coefficient is not None), ball(0))

    def _convert_to_model(self, value: object) -> Model:
        if isinstance(value, Model):
            return value
        if isinstance(value, int | float | np.integer | np.floating):
            return self.frame.number(ball(float(value)))
        raise Unchecked(f"an entry of the system holds a {type(value).__name__}, expected a number")

    def __add__(self, other: object) -> Model:
        pairs = zip(self.parts, self._convert_to_model(other).parts, strict=True)
        return Model(self.frame, [a if b is None else b if a is None else a + b for a, b in pairs])

    def __neg__(self) -> Model:
        return Model(self.frame, [None if coefficient is None else -coefficient for coefficient in self.parts])

    def __pos__(self) -> Model:
        return self

    def __abs__(self) -> Model:
        """Return the absolute value. A model of which few values have the other sign than its middle, up to ``w``,
        differs from it by ``2 w`` at most; of another it is a ball from 0 to the largest one."""
        middle = arb(self.constant.mid())
        excess = (self - self.frame.number(middle)).size.upper() - abs(middle)
        half = self.size.upper() / 2
        if 2 * excess > half:
            return self.frame.number(arb(half, half))
        return (-self if middle < 0 else self)._truncate(arb(0) if excess <= 0 else 2 * abs(excess))

    def __sub__(self, other: object) -> Model:
        return self + -self._convert_to_model(other)

    def __rsub__(self, other: object) -> Model:
        return self._convert_to_model(other) - self

    def __mul__(self, other: object) -> Model:
        right, monomials = self._convert_to_model(other).parts, self.frame.monomials
        coefficients: list[Part] = [None] * monomials.size
        for a, pairs in zip(self.parts, monomials.products_with, strict=True):
            if a is None:
                continue
            for j, k in pairs:
                b, total = right[j], coefficients[k]
                if b is not None:
                    coefficients[k] = a * b if total is None else total + a * b
        return Model(self.frame, coefficients)._truncate(_bound_truncated_terms(monomials, self.parts, right))

    def _truncate(self, beyond: arb) -> Model:
        """Return the model up to its order in the time, with a remainder of at most ``beyond`` added."""
        coefficients = list(self.parts)
        for k, coefficient in enumerate(coefficients):
            if coefficient is not None and coefficient.length() > self.frame.order + 1:
                remainder = sum(map(abs, coefficient.coeffs()[self.frame.order + 1 :]), arb(0))
                coefficients[k] = coefficient.truncate(self.frame.order + 1) + arb_poly([arb(0, remainder.upper())])
        if not beyond.is_zero():
            remainder_ball, constant = arb_poly([arb(0, beyond.upper())]), coefficients[0]
            coefficients[0] = remainder_ball if constant is None else constant + remainder_ball
        return Model(self.frame, coefficients)

    def __truediv__(self, other: object) -> Model:
        return self * self._convert_to_model(other)._apply_function(lambda series: 1 / series)

    def __rtruediv__(self, other: object) -> Model:
        return self._convert_to_model(other) / self

    def __pow__(self, other: object) -> Model:
        if isinstance(other, int | float | np.integer | np.floating) and float(other).is_integer():
            count = int(other)
            if abs(count) <= MAX_POWER:
                power, base = self._convert_to_model(1.0), self
                for _ in range(abs(count)):
                    power = power * base
                return power if count >= 0 else 1.0 / power
        if isinstance(other, int | float | np.integer | np.floating) and not float(other).is_integer() and other > 0:
            return _raise_to_fraction(self, float(other))
        return (self._convert_to_model(other) * self.log()).exp()

    def __rpow__(self, other: object) -> Model:
        return self._convert_to_model(other) ** self

    __radd__, __rmul__ = __add__, __mul__

    def _apply_function(self, function: Callable[[arb_series], Any]) -> Model:
        """Return a function of the model: its Taylor polynomial at an exact number in the middle, with Lagrange's
        remainder."""
        c = arb(self.constant.mid())
        deviation = self - self.frame.number(c)
        radius, count = deviation.size.upper(), self.frame.order + self.frame.monomials.degree + 1
        old_cap, ctx.cap = ctx.cap, count + 1
        try:
            expansion, enclosure = (function(arb_series([at, 1], count + 1)) for at in (c, arb(c, radius)))
        except (ValueError, ZeroDivisionError) as error:
            raise Unchecked(f"an entry of the system is not finite ({error})") from error
        finally:
            ctx.cap = old_cap
        power, remainders, tolerance = arb(1), list[arb](), arb(ENOUGH) * abs(expansion[0])
        while len(remainders) < count and not (remainders and remainders[-1] <= tolerance):
            power = power * radius
            remainders.append((abs(enclosure[len(remainders) + 1]) * power).upper())
        order = len(remainders) - 1
        if not remainders[order] <= tolerance:
            order = min(range(count), key=lambda k: float(remainders[k]))
        coefficients = [expansion[k] for k in range(order + 1)]
        if not all(number.is_finite() for number in (*coefficients, remainders[order])):
            raise Unchecked("an entry of the system is not finite")
        return _sum_powers(coefficients, deviation)._truncate(remainders[order])

    def exp(self) -> Model:
        return self._apply_function(lambda s: s.exp())

    def sin(self) -> Model:
        return self._apply_function(lambda s: s.sin())

    def cos(self) -> Model:
        return self._apply_function(lambda s: s.cos())

    def tan(self) -> Model:
        return self._apply_function(lambda s: _expand_tangent(s, s[0].tan(), 1 / s[0].cos() ** 2, 1))

    def log(self) -> Model:
        return self._apply_function(lambda s: s.log())

    def sqrt(self) -> Model:
        try:
            return self._apply_function(lambda s: s.sqrt())
        except Unchecked:
            return _raise_to_fraction(self, 0.5)

    def tanh(self) -> Model:
        return self._apply_function(lambda s: _expand_tangent(s, s[0].tanh(), s[0].sech() ** 2, -1))

    def kepler(self, eccentricity: float) -> Model:
        """Return the ``E`` that solves Kepler's equation ``E - e sin E = M``, where the model is ``M``."""
        return self._apply_function(lambda s: kepler_series(s, eccentricity, s.prec))


def _sum_powers(coefficients: Sequence[arb], model: Model) -> Model:
    """Return ``sum_k coefficients_k model^k``: as one polynomial in another where the model depends on the time alone,
    and by Horner's rule otherwise."""
    frame, (in_time, *others) = model.frame, model.parts
    if in_time is not None and all(part is None for part in others):
        return Model(frame, [arb_poly(coefficients)(in_time), *others])
    total = frame.number(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = total * model + frame.number(coefficient)
    return total


def _raise_to_fraction(model: Model, power: float) -> Model:
    """Return a positive power that is no whole number. Where values reach down to 0, it is the chord from 0 to the
    largest value, with the largest distance between the two on one side. Values down to `NEGATIVE` count as 0."""
    try:
        return (model.frame.number(ball(power)) * model.log()).exp()
    except Unchecked:
        below, top = max(find_highest(-model), 0.0), model.size.upper()
        if not (top > 0 and top.is_finite() and below <= NEGATIVE):
            raise
    exponent = ball(power)
    slope, share = top ** (exponent - 1), exponent ** (1 / (1 - exponent))
    half = abs(share**exponent - share) * top**exponent / 2
    chord = model * model.frame.number(slope) + model.frame.number(half if power < 1.0 else -half)
    return chord._truncate(half + slope * ball(below))


def find_highest(model: Model) -> float:
    """Return an upper bound of a model at every time and parameter, by Bernstein's form; infinite where there is
    none."""
    coefficients, remainder = separate_errors(model)
    if not np.isfinite(coefficients).all() or not np.isfinite(remainder):
        return np.inf
    return float(highest(coefficients[None], [True] * coefficients.ndim, np.array([remainder]), 0.0)[0])


def separate_errors(model: Model) -> tuple[Array, float]:
    """Return the middles of the coefficients of a model, an axis for the time and each parameter, and a bound of what
    they leave out."""
    variables, degree = model.frame.monomials.count, model.frame.monomials.degree
    coefficients, error = np.zeros((model.frame.order + 1, *([degree + 1] * variables))), arb(0)
    for exponents, part in zip(model.frame.monomials.exponents, model.parts, strict=True):
        for power, coefficient in enumerate([] if part is None else part.coeffs()):
            middle = float(coefficient.mid())
            coefficients[(power, *exponents)] = middle
            error = error + abs(coefficient - middle)
    return coefficients, above(error)


def measure_steepness(model: Model) -> Array:
    """Return how much a model changes, at most and without its remainder, along the time and each parameter."""
    changes = np.zeros(model.frame.monomials.count + 1)
    for exponents, part in zip(model.frame.monomials.exponents, model.parts, strict=True):
        sizes = [abs(float(coefficient.mid())) for coefficient in ([] if part is None else part.coeffs())]
        changes[0] += sum(power * size for power, size in enumerate(sizes))
        changes[1:] += sum(sizes) * np.array(exponents, dtype=float)
    return changes


def _bound_polynomial(part: arb_poly) -> arb:
    return sum(map(abs, part.coeffs()), ball(0))


def _bound_truncated_terms(monomials: Monomials, left: Sequence[Part], right: Sequence[Part]) -> arb:
    """Return an upper bound of the terms of a product whose degree in the parameters is above the kept degree."""
    if not monomials.degree:
        return ball(0)
    sizes = [[ball(0)] * (monomials.degree + 1) for _ in range(2)]
    for side, coefficients in zip(sizes, (left, right), strict=True):
        for degree, coefficient in zip(monomials.degrees, coefficients, strict=True):
            if coefficient is not None:
                side[degree] = side[degree] + _bound_polynomial(coefficient)
    total = ball(0)
    for i, size in enumerate(sizes[0]):
        if i and not size.is_zero():
            total = total + size * sum(sizes[1][monomials.degree + 1 - i :], ball(0))
    return total


def _expand_tangent(argument: arb_series, value: arb, slope: arb, sign: int) -> arb_series:
    """Return the tangent of ``c + s``, or with the ``sign`` -1 the hyperbolic one, from value and slope at ``c``. With
    ``g' = h`` and ``h = 1 + sign g g`` it is ``h' = 2 sign g h``: for wide balls that is sharper than quotients."""
    g, h = [value], [slope]
    for n in range(argument.prec - 1):
        h.append(2 * sign * sum((g[k] * h[n - k] for k in range(n + 1)), value * 0) / (n + 1))
        g.append(h[n] / (n + 1))
    return arb_series(g, argument.prec)


def kepler_series(anomaly: arb_series, eccentricity: float, length: int) -> arb_series:
    """Return the first ``length`` terms of the ``E`` with ``E - e sin E`` equal to a series ``M``, by ``E' = M' + e E'
    cos E``."""
    e, M = arb(eccentricity), anomaly[0]
    E = [kepler_root(arb(M.lower()), e).union(kepler_root(arb(M.upper()), e))]  # E increases with M
    s, c = [E[0].sin()], [E[0].cos()]
    slope = 1 - e * c[0]
    for n in range(length - 1):
        derivative = [(k + 1) * coefficient for k, coefficient in enumerate(E[1:])]
        convolution = sum((derivative[k] * c[n - k] for k in range(n)), arb(0))
        E.append(((n + 1) * anomaly[n + 1] + e * convolution) / (slope * (n + 1)))
        derivative.append((n + 1) * E[-1])
        s.append(sum((derivative[k] * c[n - k] for k in range(n + 1)), arb(0)) / (n + 1))
        c.append(-sum((derivative[k] * s[n - k] for k in range(n + 1)), arb(0)) / (n + 1))
    return arb_series(E, length)


def matrix_at(entry: Any, p: np.ndarray) -> np.ndarray:
    """Return a matrix of a system, an array or a function, at its arguments ``p (n,)``, numbers of any kind; raise
    `Unchecked` where these cannot be used in the function."""
    if not callable(entry):
        return np.asarray(entry)
    try:
        with np.errstate(all="ignore"):
            return np.asarray(entry(p), dtype=object)
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise Unchecked(f"an entry of the system cannot be expanded: {error}") from error


def kepler_root(anomaly: arb, e: arb) -> arb:
    """Return a ball that contains the ``E`` with ``E - e sin E = M`` for a number ``M``: at its ends the residual
    changes its sign. Newton's method finds the middle."""
    E = anomaly
    low, high = anomaly - e, anomaly + e
    for _ in range(NEWTON):
        residual = arb((E - e * E.sin() - anomaly).mid())
        if residual > 0:
            high = E
        else:
            low = E
        E = arb((E - residual / (1 - e * E.cos())).mid())
        if not (low <= E <= high):
            E = arb(((low + high) / 2).mid())
    width = arb(2) ** (8 - ctx.prec) * (1 + abs(anomaly))
    for _ in range(ctx.prec):
        below, above = E - width, E + width
        if below - e * below.sin() < anomaly and above - e * above.sin() > anomaly:
            return below.union(above)
        width = 4 * width
    raise Unchecked("Kepler's equation is not solved")
