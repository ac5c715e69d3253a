"""The monomials of polynomials in parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import final

import numpy as np


@final
@dataclass(frozen=True)
class Monomials:
    """The monomials of at most ``degree`` in ``count`` variables, in increasing degree; number 0 is the constant."""

    count: int
    degree: int

    @property
    def exponents(self) -> list[tuple[int, ...]]:
        """The exponent vectors, in increasing degree."""
        return _list_exponents(self.count, self.degree)

    @property
    def number(self) -> dict[tuple[int, ...], int]:
        """The number of the monomial with an exponent vector."""
        return _number_monomials(self.count, self.degree)

    @property
    def products(self) -> list[tuple[int, int, int]]:
        """All ``(i, j, k)`` where monomial ``i`` times monomial ``j`` is monomial ``k``."""
        return _list_products(self.count, self.degree)

    @property
    def products_with(self) -> list[list[tuple[int, int]]]:
        """For every monomial ``i``, all ``(j, k)`` where monomial ``i`` times monomial ``j`` is monomial ``k``."""
        return _group_products(self.count, self.degree)

    @property
    def quotients(self) -> np.ndarray:
        """The table ``(size, size)`` of quotients: entry ``(i, k)`` is the ``j`` where monomial ``i`` times monomial
        ``j`` is monomial ``k``, and -1 where none is."""
        return _tabulate_quotients(self.count, self.degree)

    @property
    def size(self) -> int:
        """The number of monomials."""
        return len(self.exponents)

    @property
    def degrees(self) -> list[int]:
        """The degree of every monomial."""
        return _list_degrees(self.count, self.degree)

    @property
    def firsts(self) -> list[int]:
        """The number of the first monomial of every degree."""
        return _find_firsts(self.count, self.degree)

    def linear(self, variable: int) -> int:
        """Return the number of the monomial that is one variable alone."""
        return self.number[tuple(int(i == variable) for i in range(self.count))]


NONE = Monomials(0, 0)


@lru_cache(maxsize=64)
def _list_exponents(count: int, degree: int) -> list[tuple[int, ...]]:
    exponents = [e for e in product(range(degree + 1), repeat=count) if sum(e) <= degree]
    return sorted(exponents, key=lambda e: (sum(e), e))


@lru_cache(maxsize=64)
def _list_degrees(count: int, degree: int) -> list[int]:
    return [sum(e) for e in _list_exponents(count, degree)]


@lru_cache(maxsize=64)
def _find_firsts(count: int, degree: int) -> list[int]:
    return [_list_degrees(count, degree).index(n) for n in range(degree + 1)]


@lru_cache(maxsize=64)
def _number_monomials(count: int, degree: int) -> dict[tuple[int, ...], int]:
    return {e: i for i, e in enumerate(_list_exponents(count, degree))}


@lru_cache(maxsize=64)
def _group_products(count: int, degree: int) -> list[list[tuple[int, int]]]:
    pairs: list[list[tuple[int, int]]] = [[] for _ in _list_exponents(count, degree)]
    for i, j, k in _list_products(count, degree):
        pairs[i].append((j, k))
    return pairs


@lru_cache(maxsize=64)
def _list_products(count: int, degree: int) -> list[tuple[int, int, int]]:
    places, exponents = _number_monomials(count, degree), _list_exponents(count, degree)
    return [
        (i, j, places[g])
        for i, e in enumerate(exponents)
        for j, f in enumerate(exponents)
        if sum(e) + sum(f) <= degree
        for g in [tuple(a + b for a, b in zip(e, f, strict=True))]
    ]


@lru_cache(maxsize=64)
def _tabulate_quotients(count: int, degree: int) -> np.ndarray:
    size = len(_list_exponents(count, degree))
    quotients = np.full((size, size), -1)
    for i, j, k in _list_products(count, degree):
        quotients[i, k] = j
    quotients.flags.writeable = False
    return quotients
