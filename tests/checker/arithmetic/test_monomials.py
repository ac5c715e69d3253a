"""Guards checker/arithmetic/monomials: all exponents of a degree, and all products that are kept."""

from __future__ import annotations

import math
from itertools import product

import pytest

from sparserob_core.checker.arithmetic.monomials import NONE, Monomials


@pytest.mark.parametrize(("count", "degree"), [(0, 3), (1, 5), (2, 4), (3, 3)])
def test_monomials_are_all_of_their_degree_and_products_all_that_are_kept(count, degree):
    known = Monomials(count, degree)
    assert known.size == math.comb(count + degree, degree)
    assert known.exponents[0] == (0,) * count
    degrees = [sum(e) for e in known.exponents]
    assert degrees == sorted(degrees) and degrees[-1] <= degree
    assert degrees == known.degrees
    kept = {(i, j) for i, j in product(range(known.size), repeat=2) if degrees[i] + degrees[j] <= degree}
    products = [(i, j, k) for i, pairs in enumerate(known.products_with) for j, k in pairs]
    assert {(i, j) for i, j, _ in products} == kept and len(products) == len(kept)
    for i, j, k in products:
        assert known.exponents[k] == tuple(a + b for a, b in zip(known.exponents[i], known.exponents[j], strict=True))
        assert known.number[known.exponents[k]] == k
    places = product(range(known.size), repeat=2)
    assert {(i, int(known.quotients[i, k]), k) for i, k in places if known.quotients[i, k] >= 0} == set(products)


def test_the_first_of_every_degree_and_variables_alone_are_in_their_places():
    known = Monomials(2, 3)
    assert known.firsts == [0, 1, 3, 6]
    assert [known.exponents[known.linear(j)] for j in range(2)] == [(1, 0), (0, 1)]
    assert (NONE.size, NONE.exponents, NONE.firsts) == (1, [()], [0])
