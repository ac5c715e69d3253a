"""Guards checker/arithmetic/jets: series in several parameters, against the functions themselves."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from flint import arb, ctx

from sparserob_core.checker.arithmetic.jets import Jet, Monomials, expanded
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.expression import parse_matrix
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box


@pytest.mark.parametrize(("count", "degree"), [(0, 3), (1, 5), (2, 4), (3, 3)])
def test_monomials_are_all_of_their_degree_and_products_all_that_are_kept(count, degree):
    known = Monomials(count, degree)
    assert known.size == math.comb(count + degree, degree)
    assert known.exponents[0] == (0,) * count
    degrees = [sum(e) for e in known.exponents]
    assert degrees == sorted(degrees) and degrees[-1] <= degree
    kept = {(i, j) for i, j in product(range(known.size), repeat=2) if degrees[i] + degrees[j] <= degree}
    assert {(i, j) for i, j, _ in known.products} == kept
    assert len(known.products) == len(kept)
    for i, j, k in known.products:
        assert known.exponents[k] == tuple(a + b for a, b in zip(known.exponents[i], known.exponents[j], strict=True))
        assert known.number[known.exponents[k]] == k


def test_arithmetic_of_series_in_two_parameters_is_that_of_their_functions():
    rows = [["exp(p1) * sin(p2) - 2 / (1 + p1 * p2)", "3 - p1 / p2"], ["(p1 + p2)**3 - p1**-1", "tanh(p1 - 2 * p2)"]]
    A, c = parse_matrix("A", rows, ("p1", "p2")), parse_matrix("c", [["p1 * p2"], ["1 - p2"]], ("p1", "p2"))
    system = LinearSystem(
        A, np.array([[1.0], [0.5]]), c=c, parameters=Box(np.array([0.6, 0.3]), np.array([0.8, 0.5])), names=("p1", "p2")
    )
    known, centre, radius = Monomials(2, 7), np.array([0.7, 0.4]), np.array([0.005, 0.008])
    with ctx.workprec(96):
        parts = expanded(system, known, [arb(v) for v in centre], radius.tolist())
        tables = {
            name: np.array([[[float(x.mid()) for x in row] for row in part.tolist()] for part in parts[name]])
            for name in ("A", "B")
        }
    delta = np.random.default_rng(0).uniform(-1, 1, size=(40, 2))
    powers = np.prod(delta[:, None, :] ** np.array(known.exponents)[None], axis=2)
    at = centre + radius * delta
    assert np.abs(np.einsum("km,mij->kij", powers, tables["A"]) - A.evaluate(at)).max() < 1e-12
    drift = np.einsum("km,mij->kij", powers, tables["B"])  # one more column, whose input is always 1
    assert drift.shape[1:] == (2, 2)
    assert np.abs(drift[:, :, 0] - [1.0, 0.5]).max() < 1e-15
    assert np.abs(drift[:, :, 1:] - c.evaluate(at)).max() < 1e-14


def test_a_series_at_wide_balls_holds_those_at_every_parameter_in_them():
    known = Monomials(1, 4)
    for function in (Jet.exp, Jet.sin, Jet.cos, Jet.log, Jet.sqrt, lambda p: 1.0 / p, lambda p: p**2.5, Jet.tanh):
        with ctx.workprec(96):
            wide = function(Jet(known, [arb(0.7, 0.1), arb(1), *[arb(0)] * 3]))
            for p in (0.6, 0.65, 0.7, 0.75, 0.8):
                narrow = function(Jet(known, [arb(p), arb(1), *[arb(0)] * 3]))
                assert all(
                    w.contains(n) or w.overlaps(n) for w, n in zip(wide.coefficients, narrow.coefficients, strict=True)
                )
                assert all(
                    float(w.upper()) >= float(n.mid()) >= float(w.lower())
                    for w, n in zip(wide.coefficients, narrow.coefficients, strict=True)
                )


@pytest.mark.parametrize("power", [0, 1, 2, 64, 65, -1, 0.5])
def test_powers_are_products_or_exponentials_of_logarithms(power):
    known = Monomials(1, 3)
    with ctx.workprec(96):
        found = [float(a.mid()) for a in (Jet(known, [arb(1.1), arb(1), arb(0), arb(0)]) ** power).coefficients]
    truth = [math.prod(power - i for i in range(k)) / math.factorial(k) * 1.1 ** (power - k) for k in range(4)]
    assert found == pytest.approx(truth, rel=1e-13, abs=1e-15)


def test_a_small_power_of_what_is_not_positive_is_a_product_and_text_is_no_number():
    known = Monomials(1, 2)
    with ctx.workprec(96):
        p = Jet(known, [arb(-2), arb(1), arb(0)])
        assert [float(a.mid()) for a in (p**3).coefficients] == [-8.0, 12.0, -6.0]
        with pytest.raises(Unchecked):
            p**1.5
        with pytest.raises(Unchecked):
            p + "1"


def test_a_function_that_is_no_arithmetic_is_left_unchecked():
    def rounded(p):
        return np.array([[float(p[0])]])

    system = LinearSystem(
        lambda p: np.array([[p[0] * 1.0]]), np.array([[1.0]]), parameters=Box(np.array([0.6]), np.array([0.8]))
    )
    object.__setattr__(system, "A", rounded)
    with ctx.workprec(96), pytest.raises(Unchecked):
        expanded(system, Monomials(1, 2), [arb(0.7)], [0.1])
