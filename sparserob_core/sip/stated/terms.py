"""Affine functions of a decision in numbers, and objectives that are made of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
