"""Taylor models over many cells at once: polynomials with a rigorous remainder, as arrays.

A `TaylorModel` is one number on one cell. Rows of a program have hundreds of coefficients on thousands of cells, with
the same arithmetic for all; here it is done once. Every operation adds a bound of its rounding to the remainder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache
from math import comb, factorial
from typing import Any, ClassVar, TypeAlias, final

import numpy as np

from sparserob_core.shapes import Array
from sparserob_core.sip.expressions.forms import Numbers, Operand, take_columns
from sparserob_core.sip.expressions.rounding import EPSILON, rounding
from sparserob_core.sip.expressions.taylor import OUTWARD_FACTOR, TaylorSpace

Series: TypeAlias = "tuple[list[Array], Array]"
"""Coefficients ``f_0, ..., f_n`` at the constants of models, and bounds of ``|f_{n+1}|`` on their values."""
MAX_POWER = 64  # the largest exponent for which a power is multiplied out; ten times more take as many products
MAX_EXPONENT = 700.0  # of the exponential: beyond it doubles overflow
# Of values near 1: what rounding may leave below 0; ten times less loses differences of such values
ROUNDING_BELOW_ZERO = 1e-12
TANGENT_RADII = np.pi / 4 * (1.0 + 0.05 * np.arange(19))  # circles for Cauchy's bound, below the pole at pi/2
# Of a Bernstein form: rounding of sums of some hundred products and of halvings, which it exceeds
BERNSTEIN_ROUNDING = 1e-13
CELL_HALVINGS = 24  # of a cell for its polynomial: with half of them a peak is cut into cells that are expanded anew
MAX_POLYNOMIAL_BOXES = 20_000  # of all polynomials: ten times as many take as long as to expand cells anew


@final
class CellModels(Operand):
    """Functions of ``delta in [-1, 1]^nu`` on ``k`` cells, ``K`` on each: polynomials with remainders.

    ``coefficients (k, K, M)`` belong to the monomials of ``space``; ``remainder (k, K)`` bounds the distance from the
    function. Where a function has no enclosure on a cell, the remainder is infinite.
    """

    __slots__ = ("coefficients", "remainder", "space")
    operations: ClassVar[dict[np.ufunc, Callable[..., Any]]]

    def __init__(self, space: TaylorSpace, coefficients: Array, remainder: Array) -> None:
        self.space, self.coefficients, self.remainder = space, coefficients, remainder

    @staticmethod
    def constant(space: TaylorSpace, value: Array) -> CellModels:
        """Return numbers ``(k, K)`` as models."""
        coefficients = np.zeros((*value.shape, space.size))
        coefficients[..., 0] = value
        return CellModels(space, coefficients, np.zeros(value.shape))

    @staticmethod
    def of_fraction(space: TaylorSpace, value: Fraction) -> CellModels:
        """Return one exact number as a model, whose remainder is the distance from its double."""
        model = CellModels.constant(space, np.full((1, 1), float(value)))
        model.remainder += float(abs(Fraction(float(value)) - value)) * OUTWARD_FACTOR
        return model

    @staticmethod
    def variables(space: TaylorSpace, lower: Array, upper: Array) -> list[CellModels]:
        """Return the coordinates of cells ``[lower, upper]``, ``(k, nu)`` each, as models of one column."""
        middle = lower + (upper - lower) / 2
        radius = np.maximum(upper - middle, middle - lower) * (1.0 + EPSILON)
        models = []
        for i in range(space.nu):
            coefficients = np.zeros((len(lower), 1, space.size))
            coefficients[:, 0, 0] = middle[:, i]
            coefficients[:, 0, space.index[tuple(int(i == j) for j in range(space.nu))]] = radius[:, i]
            models.append(CellModels(space, coefficients, np.zeros((len(lower), 1))))
        return models

    @property
    def is_number(self) -> bool:
        """True where all functions are constants without a remainder."""
        return not (self.remainder.any() or self.coefficients[..., 1:].any())

    @property
    def shape(self) -> tuple[int, int]:
        """Number of cells, and number of functions on each."""
        rows, columns = self.remainder.shape
        return rows, columns

    def __getitem__(self, key: tuple[slice, Numbers]) -> CellModels:
        """Return some of the functions, by ``[:, columns]``."""
        return CellModels(self.space, self.coefficients[key], self.remainder[key])

    def join(self, values: Sequence[Any]) -> CellModels:
        """Return models and numbers side by side."""
        models = [value if isinstance(value, CellModels) else self._constant(value) for value in values]
        rows = max(model.shape[0] for model in models)
        return CellModels(
            self.space,
            np.concatenate([_repeat_rows(model.coefficients, rows) for model in models], axis=1),
            np.concatenate([_repeat_rows(model.remainder, rows) for model in models], axis=1),
        )

    def add_columns(self, groups: Numbers, count: int) -> CellModels:
        """Return the sums of the functions of every group."""
        select = np.zeros((count, groups.size))
        select[groups, np.arange(groups.size)] = 1.0
        error = self.remainder + rounding(groups.size) * np.abs(self.coefficients).sum(axis=2)
        return CellModels(self.space, select @ self.coefficients, error @ select.T * OUTWARD_FACTOR)

    def bounds(self) -> tuple[Array, Array]:
        """Return lower and upper bounds ``(k, K)`` of the values: even monomials are in ``[0, 1]``, others in
        ``[-1, 1]``."""
        nonconstant, even = self.coefficients[..., 1:], self.space.even[1:]
        radius = (np.abs(nonconstant[..., ~even]).sum(axis=2) + self.remainder) * OUTWARD_FACTOR
        middle, slack = self.coefficients[..., 0], EPSILON * np.abs(self.coefficients).sum(axis=2) * self.space.size
        low = middle + np.minimum(nonconstant[..., even], 0.0).sum(axis=2) - radius - slack
        high = middle + np.maximum(nonconstant[..., even], 0.0).sum(axis=2) + radius + slack
        return low, high

    def _constant(self, value: Array) -> CellModels:
        return CellModels.constant(self.space, np.atleast_2d(np.asarray(value, dtype=float)))

    def compose(self, expand: Callable[[int, Array, Array, Array], Series]) -> CellModels:
        """Return a function of the models, given its series at their constants, by Horner's rule."""
        low, high = self.bounds()
        centre = self.coefficients[..., 0]
        terms, bound = expand(self.space.degree, centre, low, high)
        deviation = CellModels(self.space, self.coefficients.copy(), self.remainder)
        deviation.coefficients[..., 0] = 0.0
        reach = np.maximum(high - centre, centre - low) * (1.0 + 2.0 * EPSILON)
        result = deviation._sum_powers(terms, reach)
        error = bound * reach ** len(terms)
        for k, term in enumerate(terms):  # the coefficients of the series are rounded too, by a few units each
            error = error + rounding(4 * k + 4) * np.abs(term) * reach**k
        remainder = (result.remainder + error) * OUTWARD_FACTOR
        return CellModels(self.space, result.coefficients, np.where(np.isfinite(remainder), remainder, np.inf))

    def _sum_powers(self, terms: Sequence[Array], reach: Array) -> CellModels:
        """Return ``sum_k terms_k y^k`` of models ``y`` of modulus at most ``reach``: by Horner's rule, or at once where
        one variable alone occurs, and linearly."""
        monomials = np.flatnonzero(self.coefficients.any(axis=(0, 1)))
        if monomials.size != 1 or self.space.degrees[monomials[0]] != 1:
            result = self._constant(terms[-1])
            for term in reversed(terms[:-1]):
                result = _add(_multiply(result, self), term)
            return result
        slope, power = self.coefficients[..., monomials[0]], self.space.exponents[monomials[0]]
        coefficients, error = np.zeros(self.coefficients.shape), np.zeros(self.shape)
        for k, term in enumerate(terms):
            coefficients[..., self.space.index[tuple((k * power).tolist())]] = term * slope**k
            error += np.abs(term) * (k * reach ** max(k - 1, 0) * self.remainder + rounding(k + 4) * reach**k)
        return CellModels(self.space, coefficients, error * OUTWARD_FACTOR)


def _repeat_rows(array: Array, rows: int) -> Array:
    return np.broadcast_to(array, (rows, *array.shape[1:]))


@lru_cache(maxsize=16)
def _sorted_products(space: TaylorSpace) -> tuple[Numbers, Numbers, Numbers, Array]:
    """Return the pairs of monomials whose product is in a space, in the order of the product, the place where each
    product begins, and bounds of the rounding."""
    left, right, target = space.products
    order = np.argsort(target, kind="stable")
    begins = np.searchsorted(target[order], np.arange(space.size))
    return left[order], right[order], begins, space.rounded[order]


def _add(left: Any, right: Any) -> CellModels:
    model, operand = (left, right) if isinstance(left, CellModels) else (right, left)
    if isinstance(operand, CellModels):
        coefficients = model.coefficients + operand.coefficients
        error = model.remainder + operand.remainder
    else:
        number = np.atleast_2d(np.asarray(operand, dtype=float))
        coefficients = model.coefficients + model._constant(number).coefficients
        error = model.remainder + np.zeros(number.shape)
    return CellModels(model.space, coefficients, (error + EPSILON * np.abs(coefficients).sum(axis=2)) * OUTWARD_FACTOR)


def _multiply(left: Any, right: Any) -> CellModels:
    model, operand = (left, right) if isinstance(left, CellModels) else (right, left)
    if isinstance(operand, CellModels) and model.is_number:
        model, operand = operand, model
    if not isinstance(operand, CellModels) or operand.is_number:
        plain = operand.coefficients[..., 0] if isinstance(operand, CellModels) else operand
        number = np.atleast_2d(np.asarray(plain, dtype=float))
        coefficients = model.coefficients * number[..., None]
        with np.errstate(invalid="ignore"):
            error = np.where(number == 0.0, 0.0, model.remainder * np.abs(number))
        return CellModels(
            model.space, coefficients, (error + EPSILON * np.abs(coefficients).sum(axis=2)) * OUTWARD_FACTOR
        )
    space = model.space
    first, second, begins, rounded = _sorted_products(space)
    a, b = model.coefficients, operand.coefficients
    products = a[..., first] * b[..., second]
    coefficients = np.add.reduceat(products, begins, axis=-1)
    sizes, others = np.abs(a), np.abs(b)
    error = _bound_overflow(space, sizes, others) + np.abs(products) @ (rounded + EPSILON)
    total, operand_total = sizes.sum(axis=2), others.sum(axis=2)
    with np.errstate(invalid="ignore"):
        error = error + total * operand.remainder + model.remainder * (operand_total + operand.remainder)
    error = np.where(np.isnan(error), np.inf, error)
    return CellModels(space, coefficients, error * OUTWARD_FACTOR)


def _bound_overflow(space: TaylorSpace, a: Array, b: Array) -> Array:
    """Return bounds ``(k, K)`` of the terms of products of polynomials of these moduli that leave the space."""
    degrees = np.zeros((space.size, space.degree + 1))
    degrees[np.arange(space.size), space.degrees] = 1.0
    by_degree, operand = a @ degrees, b @ degrees
    tails = np.cumsum(operand[..., ::-1], axis=-1)  # tails[j]: of degree at least n - j
    return np.asarray((by_degree[..., 1:] * tails[..., : space.degree]).sum(axis=-1))


def _reciprocal(degree: int, centre: Array, low: Array, high: Array) -> Series:
    nearest = np.where((low > 0.0) | (high < 0.0), np.minimum(np.abs(low), np.abs(high)), 0.0)
    terms = [(-1.0) ** k / centre ** (k + 1) for k in range(degree + 1)]
    return terms, nearest ** -float(degree + 2)


def _divide(left: Any, right: Any) -> CellModels:
    if not isinstance(right, CellModels):
        number = np.atleast_2d(np.asarray(right, dtype=float))
        coefficients, error = left.coefficients / number[..., None], left.remainder / np.abs(number)
        return CellModels(
            left.space, coefficients, (error + EPSILON * np.abs(coefficients).sum(axis=2)) * OUTWARD_FACTOR
        )
    return _multiply(right.compose(_reciprocal), left)


def _raise_to_power(left: Any, right: Any) -> CellModels:
    if isinstance(right, CellModels):
        base = left if isinstance(left, CellModels) else right._constant(left)
        return _multiply(right, base.compose(_log)).compose(_exp)
    powers = np.unique(np.asarray(right, dtype=float))
    columns = [_raise_to_number(left, float(power)) for power in powers]
    if powers.size == 1:
        return columns[0] if np.size(right) == 1 else take_columns(columns[0], np.arange(np.size(right)))
    places = np.searchsorted(powers, np.asarray(right, dtype=float))[0]
    picked: list[CellModels] = [take_columns(columns[place], np.array([j])) for j, place in enumerate(places.tolist())]
    return picked[0].join(picked)


def _raise_to_number(model: CellModels, power: float) -> CellModels:
    if not power.is_integer():
        return _raise_to_fraction(model, power)
    if abs(power) > MAX_POWER:
        return model.compose(lambda *domain: _power(power, *domain))
    base, count = (model, int(power)) if power >= 0 else (model.compose(_reciprocal), int(-power))
    result = model._constant(np.ones((1, 1)))
    while count:
        result = _multiply(result, base) if count & 1 else result
        base, count = _multiply(base, base) if count > 1 else base, count >> 1
    return result


def _exp(degree: int, centre: Array, low: Array, high: Array) -> Series:
    size = np.exp(np.minimum(centre, MAX_EXPONENT))
    top = np.where(high <= MAX_EXPONENT, np.exp(np.minimum(high, MAX_EXPONENT)), np.inf)
    return [size / factorial(k) for k in range(degree + 1)], top * (1.0 + 1e-12) / factorial(degree + 1)


def _wave(order: int) -> Callable[[int, Array, Array, Array], Series]:
    def expand(degree: int, centre: Array, low: Array, high: Array) -> Series:
        sine, cosine = np.sin(centre), np.cos(centre)
        derivatives = (sine, cosine, -sine, -cosine)
        terms = [derivatives[(k + order) % 4] / factorial(k) for k in range(degree + 1)]
        return terms, np.full(centre.shape, 1.0 / factorial(degree + 1))

    return expand


def _log(degree: int, centre: Array, low: Array, high: Array) -> Series:
    nearest = np.maximum(low, 0.0)
    terms = [np.log(centre), *(-((-1.0 / centre) ** k) / k for k in range(1, degree + 1))]
    return terms, nearest ** -float(degree + 1) / (degree + 1) * (1.0 + 1e-12)


def _power(power: float, degree: int, centre: Array, low: Array, high: Array) -> Series:
    binomials = [1.0]
    for k in range(degree + 1):
        binomials.append(binomials[-1] * (power - k) / (k + 1))
    nearest = np.maximum(low, 0.0)
    steepest = np.maximum(nearest ** (power - degree - 1), high ** (power - degree - 1)) * (1.0 + 1e-12)
    steepest = np.where(low > 0.0, steepest, np.inf)
    return [binomials[k] * centre ** (power - k) for k in range(degree + 1)], abs(binomials[-1]) * steepest


def _raise_to_fraction(model: CellModels, power: float) -> CellModels:
    """Return a power that is no whole number. Where values reach down to 0, a positive power lies between 0 and its
    chord to the largest value, or beyond it: it differs from the chord by at most its largest distance, to one side.

    Values below 0 by rounding, `ROUNDING_BELOW_ZERO`, count as 0.
    """
    result = model.compose(lambda *domain: _power(power, *domain))
    is_zero = ~model.coefficients.any(axis=2) & (model.remainder == 0.0)
    if power > 0.0 and is_zero.any():  # at a point, such as an index where a root begins
        coefficients = np.where(is_zero[..., None], 0.0, result.coefficients)
        result = CellModels(model.space, coefficients, np.where(is_zero, 0.0, result.remainder))
    high = model.bounds()[1]
    touches = np.isinf(result.remainder) & (high > 0.0) & np.isfinite(high) & np.isfinite(model.remainder)
    if power <= 0.0 or not touches.any():
        return result
    coefficients, remainder, top = model.coefficients[touches], model.remainder[touches], high[touches]
    below = np.maximum(bound_polynomials(model.space, -coefficients, remainder, 0.0)[0], 0.0)
    slope, share = top ** (power - 1.0), power ** (1.0 / (1.0 - power))  # where the power is furthest from its chord
    half = abs(share**power - share) / 2 * top**power * OUTWARD_FACTOR
    chord = slope[:, None] * coefficients
    chord[:, 0] += half if power < 1.0 else -half
    error = slope * (remainder + below) + half + rounding(16) * (np.abs(chord).sum(axis=1) + top**power)
    is_known = below <= np.maximum(ROUNDING_BELOW_ZERO, ROUNDING_BELOW_ZERO * top)
    result.coefficients[touches] = np.where(is_known[:, None], chord, 0.0)
    result.remainder[touches] = np.where(is_known & np.isfinite(error), error * OUTWARD_FACTOR, np.inf)
    return result


def _tanh(degree: int, centre: Array, low: Array, high: Array) -> Series:
    terms = [np.tanh(centre)]
    for k in range(degree):
        square = sum((terms[i] * terms[k - i] for i in range(k + 1)), np.zeros(centre.shape))
        terms.append(((1.0 if k == 0 else 0.0) - square) / (k + 1))
    bound = (np.maximum(1.0, np.tan(TANGENT_RADII)) / TANGENT_RADII ** (degree + 1)).min()
    return terms, np.full(centre.shape, bound)


def _absolute(model: CellModels) -> CellModels:
    """Return absolute values. Models of which few values have the other sign, up to ``w``, differ from them by ``2 w``
    at most; of others it is only known that they are from 0 to the largest one."""
    low, high = model.bounds()
    sign = np.where(low + high < 0.0, -1.0, 1.0)
    excess, half = np.maximum(np.where(sign < 0.0, high, -low), 0.0), np.maximum(-low, high) / 2
    crosses = 2.0 * excess > half
    coefficients = sign[..., None] * model.coefficients
    coefficients[crosses] = 0.0
    coefficients[..., 0][crosses] = half[crosses]
    return CellModels(
        model.space, coefficients, np.where(crosses, half, model.remainder + 2.0 * excess) * OUTWARD_FACTOR
    )


CellModels.operations = {
    np.add: _add,
    np.subtract: lambda left, right: _add(left, np.negative(right)),
    np.negative: lambda model: CellModels(model.space, -model.coefficients, model.remainder),
    np.multiply: _multiply,
    np.true_divide: _divide,
    np.power: _raise_to_power,
    np.absolute: _absolute,
    np.exp: lambda model: model.compose(_exp),
    np.sin: lambda model: model.compose(_wave(0)),
    np.cos: lambda model: model.compose(_wave(1)),
    np.tan: lambda model: _divide(model.compose(_wave(0)), model.compose(_wave(1))),
    np.log: lambda model: model.compose(_log),
    np.sqrt: lambda model: _raise_to_fraction(model, 0.5),
    np.tanh: lambda model: model.compose(_tanh),
}


def bound_polynomials(space: TaylorSpace, coefficients: Array, errors: Array, limit: float) -> tuple[Array, Numbers]:
    """Return upper bounds of polynomials on ``[-1, 1]^nu``, by Bernstein's form (Farouki 2012).

    Parameters
    ----------
    space : TaylorSpace
        The monomials.
    coefficients : array (k, M)
        The coefficients.
    errors : array (k,)
        What is added to each polynomial.
    limit : float
        Value below which no sharper bound is asked for. Boxes are halved until a bound is below it, or cannot be.

    Returns
    -------
    array (k,)
        The bounds, in which rounding is counted; infinite where numbers overflow.
    array of int (k,)
        The coordinate in which each polynomial varies most.
    """
    count, nu = coefficients.shape[0], space.nu
    with np.errstate(over="ignore", invalid="ignore"):
        steepness = np.abs(coefficients) @ space.exponents
    table = np.zeros((count, *([space.degree + 1] * nu)))
    table[(slice(None), *space.exponents.T)] = coefficients
    matrix = _conversion(space.degree)
    with np.errstate(over="ignore", invalid="ignore"):
        forms, sizes = table, np.abs(table)
        for axis in range(1, nu + 1):
            forms = np.moveaxis(np.tensordot(forms, matrix, axes=(axis, 1)), -1, axis)
            sizes = np.moveaxis(np.tensordot(sizes, np.abs(matrix), axes=(axis, 1)), -1, axis)
        slack = errors + BERNSTEIN_ROUNDING * sizes.reshape(count, -1).max(axis=1)
        is_finite = np.isfinite(forms).reshape(count, -1).all(axis=1) & np.isfinite(slack)
    bounds, owner, forms = np.where(is_finite, -np.inf, np.inf), np.flatnonzero(is_finite), forms[is_finite]
    for step in range(CELL_HALVINGS + 1 if owner.size else 0):
        upper = forms.reshape(owner.size, -1).max(axis=1) + slack[owner]
        corners = forms
        for axis in range(1, nu + 1):
            corners = np.take(corners, [0, -1], axis=axis)
        is_attained = corners.reshape(owner.size, -1).max(axis=1) + slack[owner] > limit
        is_last = step == CELL_HALVINGS or owner.size > MAX_POLYNOMIAL_BOXES
        given_up = np.unique(owner[is_attained | (upper > limit) & is_last])
        is_closed = (upper <= limit) | np.isin(owner, given_up)
        np.maximum.at(bounds, owner[is_closed], upper[is_closed])
        forms, owner = forms[~is_closed], owner[~is_closed]
        if not owner.size:
            break
        forms, owner = _halve(forms), np.tile(owner, 2)
    return bounds, steepness.argmax(axis=1)


@lru_cache(maxsize=16)
def _conversion(degree: int) -> Array:
    """Return the matrix from powers on ``[-1, 1]`` to coefficients of Bernstein's form, each entry rounded once."""
    orders = range(degree + 1)

    def entry(i: int, j: int) -> float:
        terms = (Fraction(comb(i, k) * comb(j, k) * 2**k * (-1) ** (j + k), comb(degree, k)) for k in orders)
        return float(sum(terms, Fraction(0)))

    return np.array([[entry(i, j) for j in orders] for i in orders])


def _halve(forms: Array) -> Array:
    """Return both halves of every box, along the axis on which its coefficients vary most (de Casteljau)."""
    variation = np.stack(
        [
            np.abs(np.diff(forms, axis=axis)).reshape(forms.shape[0], -1).max(axis=1, initial=0.0)
            for axis in range(1, forms.ndim)
        ],
        axis=1,
    )
    axes, halves = variation.argmax(axis=1) + 1, np.empty((2, *forms.shape))
    for axis in range(1, forms.ndim):
        chosen = axes == axis
        if chosen.any():
            lines = np.moveaxis(forms[chosen], axis, -1)
            for half, matrix in zip(halves, _halving(forms.shape[axis] - 1), strict=True):
                half[chosen] = np.moveaxis(lines @ matrix.T, -1, axis)
    return halves.reshape(-1, *forms.shape[1:])


@lru_cache(maxsize=16)
def _halving(degree: int) -> tuple[Array, Array]:
    """Return the matrices from coefficients of Bernstein's form to those of both halves, whose entries are exact."""
    rows = [[comb(i, j) / 2**i for j in range(degree + 1)] for i in range(degree + 1)]
    low = np.array(rows)
    return low, low[::-1, ::-1].copy()
