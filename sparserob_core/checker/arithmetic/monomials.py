"""The monomials of polynomials in parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import final

import numpy as np


@final
@dataclass(frozen=True)
class Monomials:
    """The monomials of at most ``degree`` in ``count`` variables, in increasing degree; number 0 is the constant."""

    count: int
    degree: int

    @cached_property
    def exponents(self) -> list[tuple[int, ...]]:
        """The exponent vectors, in increasing degree."""
        exponents = [e for e in product(range(self.degree + 1), repeat=self.count) if sum(e) <= self.degree]
        return sorted(exponents, key=lambda e: (sum(e), e))

    @cached_property
    def number(self) -> dict[tuple[int, ...], int]:
        """The number of the monomial with an exponent vector."""
        return {e: i for i, e in enumerate(self.exponents)}

    @cached_property
    def products_with(self) -> list[list[tuple[int, int]]]:
        """For every monomial ``i``, all ``(j, k)`` where monomial ``i`` times monomial ``j`` is monomial ``k``."""
        sums = [[tuple(a + b for a, b in zip(e, f, strict=True)) for f in self.exponents] for e in self.exponents]
        return [[(j, self.number[e]) for j, e in enumerate(row) if e in self.number] for row in sums]

    @cached_property
    def quotients(self) -> np.ndarray:
        """The table ``(size, size)`` of quotients: entry ``(i, k)`` is the ``j`` where monomial ``i`` times monomial
        ``j`` is monomial ``k``, and -1 where none is."""
        quotients = np.full((self.size, self.size), -1)
        for i, pairs in enumerate(self.products_with):
            for j, k in pairs:
                quotients[i, k] = j
        quotients.flags.writeable = False
        return quotients

    @property
    def size(self) -> int:
        """The number of monomials."""
        return len(self.exponents)

    @cached_property
    def degrees(self) -> list[int]:
        """The degree of every monomial."""
        return [sum(e) for e in self.exponents]

    @cached_property
    def firsts(self) -> list[int]:
        """The number of the first monomial of every degree."""
        return [self.degrees.index(n) for n in range(self.degree + 1)]

    def linear(self, variable: int) -> int:
        """Return the number of the monomial that is one variable alone."""
        return self.number[tuple(int(i == variable) for i in range(self.count))]


monomials_of = lru_cache(maxsize=64)(Monomials)  # each with its tables
NONE = monomials_of(0, 0)
