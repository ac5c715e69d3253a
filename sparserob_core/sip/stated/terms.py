"""Affine functions of a decision in numbers, and objectives that are made of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.forms import AffineForm, ConvexCost


@final
@dataclass(frozen=True, eq=False)
class AffineFunction:
    """Affine function ``constant + coefficients x[positions]`` of a decision, in numbers."""

    constant: float
    positions: np.ndarray
    coefficients: Array

    @property
    def key(self) -> tuple[float, tuple[int, ...], tuple[float, ...]]:
        """Numbers that two equal functions have in common."""
        return self.constant, tuple(self.positions.tolist()), tuple(self.coefficients.tolist())

    @property
    def multiples(self) -> list[tuple[int, float]]:
        """Entries of the decision with their coefficients."""
        return list(zip(self.positions.tolist(), self.coefficients.tolist(), strict=True))

    @staticmethod
    def list_terms(form: AffineForm) -> list[AffineFunction]:
        """Return every affine function of a form of numbers."""
        count = int(form.constant.shape[1])
        constants = np.asarray(form.constant, dtype=float)[0]
        order = np.argsort(form.owner, kind="stable")
        ends = np.searchsorted(form.owner[order], np.arange(count + 1))
        coefficients = np.asarray(form.coefficient, dtype=float)[0] if form.owner.size else np.zeros(0)
        terms = []
        for j in range(count):
            part = order[ends[j] : ends[j + 1]]
            positions, inverse = np.unique(form.position[part], return_inverse=True)
            sums = np.zeros(positions.size)
            np.add.at(sums, inverse.reshape(-1), coefficients[part])
            terms.append(AffineFunction(float(constants[j]), positions[sums != 0.0], sums[sums != 0.0]))
        return terms

    def plus(self, term: AffineFunction, factor: float) -> AffineFunction:
        """Return the sum of this function and a multiple of another one."""
        positions = np.union1d(self.positions, term.positions).astype(int)
        coefficients = np.zeros(positions.size)
        coefficients[np.searchsorted(positions, self.positions)] = self.coefficients
        coefficients[np.searchsorted(positions, term.positions)] += factor * term.coefficients
        return AffineFunction(self.constant + factor * term.constant, positions, coefficients)


@final
@dataclass(frozen=True, eq=False)
class ExpandedCost:
    """Exact polynomial ``constant + sum slopes_i x_i + sum products_ij x_i x_j`` of a decision, with ``i <= j``.

    Nothing that cancels is in it: no coefficient is 0.
    """

    constant: Fraction
    slopes: Mapping[int, Fraction]
    products: Mapping[tuple[int, int], Fraction]


@final
@dataclass(frozen=True, eq=False)
class StatedObjective:
    """Cost ``constant + linear + sum weight left right + sum weight |inner|``, term by term."""

    linear: AffineFunction
    products: tuple[tuple[float, AffineFunction, AffineFunction], ...]
    absolutes: tuple[tuple[float, AffineFunction], ...]

    @staticmethod
    def of(cost: ConvexCost) -> StatedObjective:
        """Return the terms of a parsed cost; products with numbers, and absolute values of numbers, are affine."""
        distinct: dict[object, AffineFunction] = {}

        def list_terms(form: AffineForm) -> list[AffineFunction]:
            """Return the functions of a form; equal ones are one, however they are written."""
            return [distinct.setdefault(term.key, term) for term in AffineFunction.list_terms(form)]

        linear = AffineFunction.list_terms(cost.affine)[0]
        products = list[tuple[float, AffineFunction, AffineFunction]]()
        for block in cost.products:
            left = list_terms(block.left)
            right = left if block.right is block.left else list_terms(block.right)
            for weight, a, b in zip(block.weight.tolist(), left, right, strict=True):
                if a.positions.size and b.positions.size:
                    products.append((weight, a, b))
                else:
                    number, affine = (b.constant, a) if a.positions.size else (a.constant, b)
                    linear = linear.plus(affine, weight * number)
        absolutes = list[tuple[float, AffineFunction]]()
        for absolute in cost.absolutes:
            for weight, inner in zip(absolute.weight.tolist(), list_terms(absolute.form), strict=True):
                if inner.positions.size:
                    absolutes.append((weight, inner))
                else:
                    linear = replace(linear, constant=linear.constant + weight * abs(inner.constant))
        return StatedObjective(linear, tuple(products), tuple(absolutes))

    @property
    def is_sum_of_squares(self) -> bool:
        """True where all products are squares with weights that are not negative."""
        return all(left is right and weight >= 0.0 for weight, left, right in self.products)

    def count_pairs(self) -> int:
        """Return the number of products of entries, where every product of functions is multiplied out."""
        return sum((left.positions.size + 1) * (right.positions.size + 1) for _, left, right in self.products)

    def expand(self, places: Mapping[int, int]) -> ExpandedCost:
        """Return the affine terms and the products as a polynomial.

        Parameters
        ----------
        places : mapping from int to int
            Entry of the decision that stands for a function, by the function's ``id``. Other functions are multiplied
            out.
        """
        constant = Fraction(self.linear.constant)
        slopes, products = defaultdict[int, Fraction](Fraction), defaultdict[tuple[int, int], Fraction](Fraction)
        for i, coefficient in self.linear.multiples:
            slopes[i] += Fraction(coefficient)
        for weight, left, right in self.products:
            (a, first), (b, second) = (_list_multiples(term, places) for term in (left, right))
            scale = Fraction(weight)
            constant += scale * a * b
            for i, factor in first:
                slopes[i] += scale * b * factor
            for j, factor in second:
                slopes[j] += scale * a * factor
            for i, factor in first:
                for j, second_factor in second:
                    products[min(i, j), max(i, j)] += scale * factor * second_factor
        return ExpandedCost(
            constant,
            {i: value for i, value in slopes.items() if value},
            {key: value for key, value in products.items() if value},
        )


def _list_multiples(term: AffineFunction, places: Mapping[int, int]) -> tuple[Fraction, list[tuple[int, Fraction]]]:
    """Return the constant of a function, and its entries with their coefficients; an entry may stand for all of it."""
    if id(term) in places:
        return Fraction(0), [(places[id(term)], Fraction(1))]
    return Fraction(term.constant), [(i, Fraction(coefficient)) for i, coefficient in term.multiples]
