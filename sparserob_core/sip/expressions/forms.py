"""Affine forms of a decision whose coefficients are numbers of any kind, and convex costs of such forms.

A form has one value for each turn of the innermost sum that is being read: ``K`` of them, which are columns. Numbers
are arrays ``(k, K)`` of floats or of objects, or `CellModels`, where ``k`` counts indices or cells.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeAlias, final

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from sparserob_core.errors import InputError
from sparserob_core.shapes import Array

Value: TypeAlias = Any
"""An array ``(k, K)``, or anything that stands for one."""
Numbers: TypeAlias = "np.ndarray"
"""Array of integers."""


class Operand(NDArrayOperatorsMixin):
    """A value that says itself what numpy's functions make of it; of two kinds the one of the higher ``rank`` does."""

    operations: ClassVar[dict[np.ufunc, Callable[..., Any]]]
    rank: ClassVar[int] = 0

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        operation = type(self).operations.get(ufunc)
        is_outranked = any(isinstance(value, Operand) and value.rank > self.rank for value in inputs)
        if method != "__call__" or options or is_outranked:
            return NotImplemented
        if operation is None:
            raise InputError(f"the decision stands in {ufunc.__name__}, which is not known of decisions there")
        return operation(*inputs)


def widen(value: Value, count: int) -> Value:
    """Return a value of one column as one of ``count``; another value is returned as it is."""
    return value[:, np.zeros(count, dtype=int)] if _size(value) == 1 != count else value


def take_columns(value: Value, columns: Numbers) -> Value:
    """Return some columns of a value; a value of one column has this one everywhere."""
    return widen(value, columns.size) if _size(value) == 1 else value[:, columns]


def join_columns(values: Sequence[Value]) -> Value:
    """Return values side by side."""
    if any(isinstance(value, Operand) for value in values):
        first = next(value for value in values if isinstance(value, Operand))
        return first.join(values)  # type: ignore[attr-defined]
    rows = max(value.shape[0] for value in values)
    return np.concatenate([np.broadcast_to(value, (rows, value.shape[1])) for value in values], axis=1)


def add_columns(value: Value, groups: Numbers, count: int) -> Value:
    """Return sums ``(k, count)`` of the columns of every group."""
    if isinstance(value, Operand):
        return value.add_columns(groups, count)  # type: ignore[attr-defined]
    sums = np.zeros((value.shape[0], count), dtype=value.dtype)
    np.add.at(sums.T, groups, value.T)
    return sums


def _size(value: Value) -> int:
    return int(value.shape[1])


@final
@dataclass(frozen=True, eq=False)
class AffineForm(Operand):
    """Affine functions ``constant_j + sum_l [owner_l = j] coefficient_l x[position_l]`` of a decision ``x``.

    ``constant`` has one column for every ``j``; ``coefficient`` one for every term ``l``. ``owner`` and ``position``
    are integers ``(L,)``.
    """

    constant: Value
    owner: Numbers
    position: Numbers
    coefficient: Value
    rank: ClassVar[int] = 1

    @staticmethod
    def of(value: Value) -> AffineForm:
        """Return a form itself, and a number as a form without terms."""
        if isinstance(value, AffineForm):
            return value
        empty = np.zeros(0, dtype=int)
        return AffineForm(value, empty, empty, np.zeros((1, 0)))

    @staticmethod
    def variables(positions: Numbers, unit: Value = 1.0) -> AffineForm:
        """Return entries of the decision, at ``positions (K,)``, with coefficients that are a ``unit``."""
        coefficient = np.full((1, positions.size), unit)
        return AffineForm(np.zeros((1, positions.size)), np.arange(positions.size), positions, coefficient)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of indices or cells of the constant, and number of forms."""
        rows, columns = self.constant.shape[:2]
        return int(rows), int(columns)

    def __getitem__(self, key: tuple[slice, Numbers]) -> AffineForm:
        """Return some of the forms, by ``[:, columns]``."""
        columns = key[1]
        hits = [np.flatnonzero(self.owner == column) for column in columns.tolist()]
        terms = np.concatenate(hits) if hits else np.zeros(0, dtype=int)
        owner = np.repeat(np.arange(columns.size), [hit.size for hit in hits])
        return AffineForm(take_columns(self.constant, columns), owner, self.position[terms], self.coefficient[:, terms])

    def add_columns(self, groups: Numbers, count: int) -> AffineForm:
        """Return the sums of the forms of every group."""
        return replace(self, constant=add_columns(self.constant, groups, count), owner=groups[self.owner])

    def evaluate(self, x: Array) -> Value:
        """Return the values of the forms at a decision of floats ``(n,)``."""
        products = self.coefficient * x[self.position]
        return self.constant + add_columns(products, self.owner, _size(self.constant))

    def scale(self, factor: Value) -> AffineForm:
        """Return the forms times numbers."""
        form = widen(self, _size(factor))
        return AffineForm(
            form.constant * factor, form.owner, form.position, form.coefficient * take_columns(factor, form.owner)
        )


def _add_forms(left: Value, right: Value) -> AffineForm:
    a, b = AffineForm.of(left), AffineForm.of(right)
    count = max(_size(a), _size(b))
    a, b = widen(a, count), widen(b, count)
    return AffineForm(
        a.constant + b.constant,
        np.concatenate([a.owner, b.owner]),
        np.concatenate([a.position, b.position]),
        join_columns([a.coefficient, b.coefficient]) if a.owner.size and b.owner.size else _longer(a, b).coefficient,
    )


def _longer(a: AffineForm, b: AffineForm) -> AffineForm:
    return a if a.owner.size else b


def _multiply_forms(left: Value, right: Value) -> Value:
    if isinstance(left, AffineForm) and isinstance(right, AffineForm):
        return ConvexCost.of_product(left, right)
    form, factor = (left, right) if isinstance(left, AffineForm) else (right, left)
    return form.scale(factor)


def _divide(left: Value, right: Value) -> Value:
    """Return a form or a cost divided by numbers."""
    if isinstance(right, AffineForm | ConvexCost):
        raise InputError("a decision stands in a divisor")
    return left.scale(1.0 / right)


def _raise_form(left: Value, right: Value) -> Value:
    if not isinstance(left, AffineForm) or isinstance(right, Operand) or not (np.asarray(right) == 2).all():
        raise InputError("a power of a decision; only squares are known, and only in the objective")
    return ConvexCost.of_product(left, left)


@final
@dataclass(frozen=True, eq=False)
class Products:
    """Terms ``weight_j left_j(x) right_j(x)`` that belong to the values ``owner (J,)`` of a cost."""

    owner: Numbers
    weight: Array
    left: AffineForm
    right: AffineForm


@final
@dataclass(frozen=True, eq=False)
class Absolutes:
    """Terms ``weight_j |form_j(x)|`` that belong to the values ``owner (J,)`` of a cost."""

    owner: Numbers
    weight: Array
    form: AffineForm


@final
@dataclass(frozen=True, eq=False)
class ConvexCost(Operand):
    """Affine forms plus products and absolute values of affine forms."""

    affine: AffineForm
    products: tuple[Products, ...] = ()
    absolutes: tuple[Absolutes, ...] = ()
    rank: ClassVar[int] = 2

    @staticmethod
    def of(value: Value) -> ConvexCost:
        """Return a cost itself, and a number or a form as a cost."""
        return value if isinstance(value, ConvexCost) else ConvexCost(AffineForm.of(value))

    @staticmethod
    def of_product(left: AffineForm, right: AffineForm) -> ConvexCost:
        """Return the products of forms."""
        count = max(_size(left), _size(right))
        is_square, left = right is left, widen(left, count)
        right = left if is_square else widen(right, count)
        products = Products(np.arange(count), np.ones(count), left, right)
        return ConvexCost(AffineForm.of(np.zeros((1, count))), (products,))

    @staticmethod
    def of_absolute(form: AffineForm) -> ConvexCost:
        """Return the absolute values of forms."""
        count = _size(form)
        return ConvexCost(AffineForm.of(np.zeros((1, count))), (), (Absolutes(np.arange(count), np.ones(count), form),))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of indices, and number of costs."""
        return self.affine.shape

    def __getitem__(self, key: tuple[slice, Numbers]) -> ConvexCost:
        """Return copies of a single cost, by ``[:, zeros]``."""
        columns = key[1]
        products = [replace(block, owner=block.owner + j) for j in range(columns.size) for block in self.products]
        absolutes = [replace(block, owner=block.owner + j) for j in range(columns.size) for block in self.absolutes]
        return ConvexCost(self.affine[key], tuple(products), tuple(absolutes))

    def add_columns(self, groups: Numbers, count: int) -> ConvexCost:
        """Return the sums of the costs of every group."""
        return ConvexCost(
            self.affine.add_columns(groups, count),
            tuple(replace(block, owner=groups[block.owner]) for block in self.products),
            tuple(replace(block, owner=groups[block.owner]) for block in self.absolutes),
        )

    def scale(self, factor: Array) -> ConvexCost:
        """Return the costs times numbers."""
        cost = widen(self, _size(factor))
        weights = widen(factor, _size(cost))[0]
        return ConvexCost(
            cost.affine.scale(factor),
            tuple(replace(block, weight=block.weight * weights[block.owner]) for block in cost.products),
            tuple(replace(block, weight=block.weight * weights[block.owner]) for block in cost.absolutes),
        )


def _add_costs(left: Value, right: Value) -> ConvexCost:
    a, b = ConvexCost.of(left), ConvexCost.of(right)
    count = max(_size(a), _size(b))
    a, b = widen(a, count), widen(b, count)
    return ConvexCost(_add_forms(a.affine, b.affine), a.products + b.products, a.absolutes + b.absolutes)


def _multiply_cost(left: Value, right: Value) -> ConvexCost:
    cost, factor = (left, right) if isinstance(left, ConvexCost) else (right, left)
    if isinstance(factor, Operand):
        raise InputError("a product of more than two decisions, or of an absolute value with a decision")
    return cost.scale(factor)


ConvexCost.operations = {
    np.add: _add_costs,
    np.subtract: lambda left, right: _add_costs(left, np.negative(right)),
    np.negative: lambda cost: cost.scale(np.full((1, 1), -1.0)),
    np.multiply: _multiply_cost,
    np.true_divide: _divide,
}

AffineForm.operations = {
    np.add: _add_forms,
    np.subtract: lambda left, right: _add_forms(left, np.negative(right)),
    np.negative: lambda form: form.scale(np.full((1, 1), -1.0)),
    np.multiply: _multiply_forms,
    np.true_divide: _divide,
    np.power: _raise_form,
    np.absolute: ConvexCost.of_absolute,
}
