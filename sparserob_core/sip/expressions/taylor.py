"""Taylor models: polynomials with a rigorous remainder, the arithmetic in which functions of the parameters are
enclosed.

After Makino and Berz (2003), "Taylor models and other validated functional inclusion methods". Every operation adds
a bound of its rounding to the remainder, where a coefficient of a parameter is not 0. Numbers that do not depend on the
parameters, such as the reciprocal of a divisor, are what floating point gives.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, NoReturn, final

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.shapes import Array, Float, shaped
from sparserob_core.sip.expressions.elementary import (
    Series,
    cos_series,
    exp_series,
    kepler_series,
    log_series,
    power_series,
    sin_series,
    tanh_series,
    undefined,
)
from sparserob_core.sip.expressions.rounding import EPSILON, rounding

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_NUMBERS = (float, int, np.floating, np.integer)
_MAX_POWER = 64
UNIT_ROUNDOFF = EPSILON / 2  # unit roundoff: bound of the error of an operation, as a share of its result
OUTWARD_FACTOR = 1.0 + 1e-10  # for bounds that are sums of at most some hundred thousand numbers that are not negative


@final
@dataclass(frozen=True, eq=False)
class Face:
    """A face of the box, on which some variables are at an end: there every monomial is ``sign (M,)``, 1 or -1, times
    the monomial of index ``target (M,)``, in the other variables only."""

    target: np.ndarray
    sign: Array

    def onto(self, monomials: np.ndarray) -> tuple[np.ndarray, Array]:
        """Return the monomials ``(j,)`` of the face to which some ``monomials (k,)`` reduce, and the matrix ``(j, k)``
        that takes coefficients of the latter to coefficients of the former.

        The constant monomial is among the given ones.
        """
        reduced, positions = np.unique(self.target[monomials], return_inverse=True)
        matrix = np.zeros((reduced.size, monomials.size))
        matrix[positions.reshape(-1), np.arange(monomials.size)] = self.sign[monomials]
        return reduced, matrix

    @cached_property
    def matrix(self) -> csr_array:
        """The matrix ``(M, M)`` that takes the coefficients of all monomials to those of a polynomial on the face."""
        from scipy.sparse import csr_array

        size = self.target.size
        return csr_array((self.sign, (self.target, np.arange(size))), shape=(size, size))


@cache
def taylor_space(nu: int, degree: int) -> TaylorSpace:
    """Return the one space of polynomials in ``nu`` variables up to a ``degree``."""
    return TaylorSpace(nu, degree)


@final
class TaylorSpace:
    """Polynomials in ``delta in [-1, 1]^nu`` of total degree at most ``degree``, over one fixed list of ``M``
    monomials.

    ``exponents (M, nu)`` are in graded order, the constant first; ``degrees (M,)`` are their sums; ``even (M,)`` is the
    mask of monomials of even exponents only. ``index`` leads from an exponent tuple to its index. ``products`` are
    three arrays of indices ``(left, right, target)``, every pair of monomials whose product is in the space.
    ``rounded`` holds for each such pair a bound of the rounding error of the coefficient of its product, as a share of
    the sum of the moduli of its summands. ``faces`` are those that `face_of` remembers.
    """

    def __init__(self, nu: int, degree: int) -> None:
        if nu < 0 or degree < 0:
            raise InputError(f"Taylor space: expected nu >= 0 and degree >= 0, got {nu} and {degree}")
        self.nu, self.degree = nu, degree
        monomials = [
            tuple(choice.count(i) for i in range(nu))
            for order in range(degree + 1)
            for choice in combinations_with_replacement(range(nu), order)
        ]
        self.index: dict[tuple[int, ...], int] = {monomial: position for position, monomial in enumerate(monomials)}
        self.exponents: npt.NDArray[np.int64] = np.array(monomials, dtype=np.int64).reshape(len(monomials), nu)
        self.degrees: npt.NDArray[np.int64] = self.exponents.sum(axis=1)
        self.even: npt.NDArray[np.bool_] = (self.exponents % 2 == 0).all(axis=1)
        left, right = np.nonzero(self.degrees[:, None] + self.degrees <= degree)
        self._bases = (degree + 1) ** np.arange(nu, dtype=np.int64)
        codes = self.exponents @ self._bases
        self._order = np.argsort(codes)
        self._codes = codes[self._order]
        target = self._order[np.searchsorted(self._codes, codes[left] + codes[right])]
        self.products = (left, right, target)
        shares = UNIT_ROUNDOFF * np.bincount(target)[target]
        self.rounded: Array = shares / (1.0 - shares)  # n u / (1 - n u) for the n summands of a coefficient
        self.faces: dict[bytes, Face] = {}

    def places(self, exponents: npt.NDArray[np.int64]) -> npt.NDArray[np.intp]:
        """Return the indices ``(k,)`` of monomials of the space with these ``exponents (k, nu)``."""
        return np.asarray(self._order[np.searchsorted(self._codes, exponents @ self._bases)])

    @property
    def size(self) -> int:
        """Number ``M`` of monomials."""
        return len(self.exponents)

    def overflow(self, first: Array, second: Array) -> float:
        """Return a bound of the terms above ``degree`` in the product of two polynomials ``(M,)``: the sum of the
        moduli of all products that leave the space."""
        size = self.degree + 1
        a = np.bincount(self.degrees, weights=np.abs(first), minlength=size)
        b = np.bincount(self.degrees, weights=np.abs(second), minlength=size)
        tails = np.append(np.cumsum(b[::-1])[::-1], 0.0)
        return float(a @ tails[size - np.arange(size)])

    def constant(self, value: float) -> TaylorModel:
        """The model of a number."""
        coefficients = np.zeros(self.size)
        coefficients[0] = value
        return TaylorModel(self, coefficients, 0.0)

    @shaped
    def variables(self, centre: Float[Array, " nu"], radius: Float[Array, " nu"]) -> list[TaylorModel]:
        """Models of ``p_i = centre_i + radius_i delta_i``, for ``centre, radius (nu,)``."""
        models = []
        for i in range(self.nu):
            model = self.constant(float(centre[i]))
            if self.degree:
                model.coefficients[self.index[tuple(int(i == j) for j in range(self.nu))]] = radius[i]
            else:
                model.remainder = abs(float(radius[i]))
            models.append(model)
        return models

    @shaped
    def monomials(self, delta: Float[Array, "k nu"]) -> Float[Array, "k M"]:
        """Values ``(k, M)`` of every monomial at ``delta (k, nu)``."""
        powers = np.asarray(delta)[:, :, None] ** np.arange(self.degree + 1)
        values: Array = np.ones((len(powers), self.size))
        for i in range(self.nu):
            values *= powers[:, i, self.exponents[:, i]]
        return values


@final
class TaylorModel:
    """``p(delta) + [-remainder, remainder]`` with the ``coefficients (M,)`` of ``p`` in ``space``.

    Knows ``+ - * /``, powers, and sin, cos, tan, exp, log, sqrt, tanh, also when held in an object array of numpy.
    Anything else that would need its value (comparison, conversion to float) raises `NotEnclosable` or `TypeError`.
    """

    __slots__ = ("coefficients", "remainder", "space")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, space: TaylorSpace, coefficients: Array, remainder: float) -> None:
        self.space, self.coefficients, self.remainder = space, coefficients, remainder

    def __repr__(self) -> str:
        low, high = self.bounds()
        return f"TaylorModel({low:.6g} .. {high:.6g})"

    @shaped
    def evaluate(self, delta: Float[Array, "k nu"]) -> Float[Array, " k"]:
        """Values ``(k,)`` of the polynomial at ``delta (k, nu)``; the truth is within ``remainder`` of them."""
        return self.space.monomials(delta) @ self.coefficients

    def bounds(self) -> tuple[float, float]:
        """Return an interval that holds every value, but for the rounding of its ends.

        Even monomials are in ``[0, 1]``, the others in ``[-1, 1]``.
        """
        nonconstant, even = self.coefficients[1:], self.space.even[1:]
        radius = float(np.abs(nonconstant[~even]).sum()) + self.remainder
        low = float(self.coefficients[0] + np.minimum(nonconstant[even], 0.0).sum()) - radius
        high = float(self.coefficients[0] + np.maximum(nonconstant[even], 0.0).sum()) + radius
        return low, high

    def _sum_magnitudes(self) -> float:
        return float(np.abs(self.coefficients).sum())

    def _shift(self, number: float) -> TaylorModel:
        coefficients = self.coefficients.copy()
        coefficients[0] += number
        return _add_rounding(self.space, coefficients, self.remainder)

    def __neg__(self) -> TaylorModel:
        return TaylorModel(self.space, -self.coefficients, self.remainder)

    def __pos__(self) -> TaylorModel:
        return self

    def __add__(self, other: object) -> TaylorModel:
        if isinstance(other, TaylorModel):
            return _add_rounding(self.space, self.coefficients + other.coefficients, self.remainder + other.remainder)
        return self._shift(float(other)) if isinstance(other, _NUMBERS) else NotImplemented

    __radd__ = __add__

    def __sub__(self, other: object) -> TaylorModel:
        return self + (-other) if isinstance(other, (TaylorModel, *_NUMBERS)) else NotImplemented

    def __rsub__(self, other: object) -> TaylorModel:
        return (-self).__add__(other)

    def __mul__(self, other: object) -> TaylorModel:
        if isinstance(other, TaylorModel):
            return self._multiply(other)
        if not isinstance(other, _NUMBERS):
            return NotImplemented
        return _add_rounding(self.space, float(other) * self.coefficients, abs(float(other)) * self.remainder)

    __rmul__ = __mul__

    def __truediv__(self, other: object) -> TaylorModel:
        if isinstance(other, TaylorModel):
            return self * other.reciprocal()
        if not isinstance(other, _NUMBERS):
            return NotImplemented
        if not other:
            undefined("a division by zero")
        return _add_rounding(self.space, self.coefficients / float(other), self.remainder / abs(float(other)))

    def __rtruediv__(self, other: object) -> TaylorModel:
        return self.reciprocal().__mul__(other)

    def __pow__(self, exponent: object) -> TaylorModel:
        if isinstance(exponent, TaylorModel):
            return (self.log() * exponent).exp()
        if not isinstance(exponent, _NUMBERS):
            return NotImplemented
        power = float(exponent)
        if not power.is_integer() or abs(power) > _MAX_POWER:
            return self._compose(power_series(power, *self._describe_domain()))
        return self._raise_to_power(int(power)) if power >= 0 else self.reciprocal()._raise_to_power(int(-power))

    def __rpow__(self, base: object) -> TaylorModel:
        if not isinstance(base, _NUMBERS):
            return NotImplemented
        return (self * math.log(base)).exp() if base > 0 else undefined(f"a power of {base}")

    def _multiply(self, other: TaylorModel) -> TaylorModel:
        left, right, target = self.space.products
        a, b = self.coefficients, other.coefficients
        products = a[left] * b[right]
        coefficients = np.bincount(target, weights=products, minlength=self.space.size).astype(float)
        cross = self._sum_magnitudes() * other.remainder + self.remainder * (other._sum_magnitudes() + other.remainder)
        if a[1:].any() or b[1:].any():
            cross += float(self.space.rounded @ np.abs(products))
        return TaylorModel(self.space, coefficients, (self.space.overflow(a, b) + cross) * OUTWARD_FACTOR)

    def _raise_to_power(self, count: int) -> TaylorModel:
        result, base = self.space.constant(1.0), self
        while count:
            result = result * base if count & 1 else result
            base, count = base * base if count > 1 else base, count >> 1
        return result

    def __abs__(self) -> TaylorModel:
        low, high = self.bounds()
        return (
            self if low >= 0 else -self if high <= 0 else undefined(f"the modulus of values in [{low:.6g}, {high:.6g}]")
        )

    def _compose(self, series: Series) -> TaylorModel:
        """Return ``f(centre + y)`` by Horner's rule, with ``y`` the model without its constant.

        The bound of the series times the largest ``|y|^(n+1)`` is added to the remainder.
        """
        coefficients, bound = series
        if not math.isfinite(bound):
            raise NotEnclosable("values this large have no enclosure")
        y = self._shift(-float(self.coefficients[0]))
        result = self.space.constant(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            result = result * y + coefficient
        low, high = y.bounds()
        reach = max(-low, high)
        remainder = bound * reach ** len(coefficients)
        if reach > 0.0:  # the coefficients of the series are rounded too, by a few units each
            remainder += sum(
                rounding(4 * k) * abs(coefficient) * reach**k for k, coefficient in enumerate(coefficients)
            )
        return TaylorModel(self.space, result.coefficients, (result.remainder + remainder) * OUTWARD_FACTOR)

    def _describe_domain(self) -> tuple[int, float, float, float]:
        return self.space.degree, float(self.coefficients[0]), *self.bounds()

    def exp(self) -> TaylorModel:
        """Exponential."""
        return self._compose(exp_series(*self._describe_domain()))

    def sin(self) -> TaylorModel:
        """Sine."""
        return self._compose(sin_series(*self._describe_domain()))

    def cos(self) -> TaylorModel:
        """Cosine."""
        return self._compose(cos_series(*self._describe_domain()))

    def tan(self) -> TaylorModel:
        """Tangent; the values must stay between two of its poles."""
        return self.sin() / self.cos()

    def tanh(self) -> TaylorModel:
        """Hyperbolic tangent."""
        return self._compose(tanh_series(*self._describe_domain()))

    def log(self) -> TaylorModel:
        """Natural logarithm of positive values."""
        return self._compose(log_series(*self._describe_domain()))

    def sqrt(self) -> TaylorModel:
        """Square root of positive values."""
        return self._compose(power_series(0.5, *self._describe_domain()))

    def kepler(self, eccentricity: float) -> TaylorModel:
        """The ``E`` with ``E - e sin E`` equal to these values, for a number ``0 <= e < 1``."""
        model = self._compose(kepler_series(eccentricity, *self._describe_domain()))
        centre = abs(float(self.coefficients[0]))  # Newton's method ends where the equation holds to its rounding
        model.remainder += rounding(4) * (centre + 1.0) / (1.0 - eccentricity * math.cos(float(model.coefficients[0])))
        return model

    def reciprocal(self) -> TaylorModel:
        """``1 / self``, for values of one sign."""
        if self.bounds()[1] < 0:
            return -(-self).reciprocal()
        return self._compose(power_series(-1.0, *self._describe_domain()))

    def square(self) -> TaylorModel:
        """``self ** 2``."""
        return self * self

    def _refuse_comparison(self, other: object) -> NoReturn:
        raise NotEnclosable("a function of the parameters may not branch on their values (a comparison was met)")

    __lt__ = __le__ = __gt__ = __ge__ = _refuse_comparison
    __eq__ = __ne__ = _refuse_comparison

    def __bool__(self) -> bool:
        raise NotEnclosable("a function of the parameters may not branch on their values (a truth value was asked for)")


def _add_rounding(space: TaylorSpace, coefficients: Array, remainder: float) -> TaylorModel:
    """Return a model with the rounding of its coefficients in the remainder, where each has been rounded once."""
    if coefficients[1:].any():
        remainder += UNIT_ROUNDOFF * float(np.abs(coefficients).sum())
    return TaylorModel(space, coefficients, remainder * OUTWARD_FACTOR)


@dataclass(frozen=True, eq=False)
class Combination:
    """A functional whose direction varies over a cell independently of the parameters, ``c = c_0 + sum_j eta_j c_j``
    with ``|eta_j| <= 1``.

    Polynomials in ``delta`` for each of ``c_0, ..., c_J`` become one polynomial in ``(delta, eta)`` of ``space``.
    ``targets (J+1, M)``: the index in ``space`` of monomial ``a`` of functional ``j``, times ``eta_j`` for ``j > 0``.
    """

    space: TaylorSpace
    targets: np.ndarray

    def apply(self, coefficients: Array) -> Array:
        """Return the combined coefficients ``(k, 1, M', ...)`` from those of each functional, ``(k, J+1, M, ...)``."""
        combined = np.zeros((coefficients.shape[0], 1, self.space.size, *coefficients.shape[3:]))
        for j, target in enumerate(self.targets):
            combined[:, 0, target] += coefficients[:, j]
        return combined


def combination(space: TaylorSpace, directions: int) -> Combination:
    """The combination of ``directions + 1`` functionals over a space of Taylor models."""
    larger = TaylorSpace(space.nu + directions, max(2, space.degree + 1))
    targets = [
        [
            larger.index[tuple(int(e) for e in [*exponents, *(int(j == i + 1) for i in range(directions))])]
            for exponents in space.exponents
        ]
        for j in range(directions + 1)
    ]
    return Combination(larger, np.array(targets))
