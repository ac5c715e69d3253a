"""Functionals whose direction varies over a cell: ``c = c_0 + sum_j eta_j c_j`` with ``|eta_j| <= 1``, beside the
parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.sip.convex_set import Array


@dataclass(frozen=True, eq=False)
class Combination:
    """How polynomials in ``delta`` for each of ``c_0, ..., c_J`` become one polynomial in ``(delta, eta)`` of
    ``space``.

    ``targets (J+1, M)``: where monomial ``a`` of functional ``j`` goes.
    """

    space: TaylorSpace
    targets: np.ndarray

    def apply(self, coefficients: Array) -> Array:
        """``(k, J+1, M, ...)`` to ``(k, 1, M', ...)``."""
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
