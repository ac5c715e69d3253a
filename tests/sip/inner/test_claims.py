"""Guards sip/solver.py: what its page says of shapes and signs is what the shipped solvers claim, and a claim is
judged by its residuals."""

from __future__ import annotations

import doctest
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array

import sparserob_core as sr
import sparserob_core.sip.solver


def test_the_example_of_a_claim_is_true():
    assert doctest.testmod(sparserob_core.sip.solver).attempted == 5
    assert doctest.testmod(sparserob_core.sip.solver).failed == 0


@pytest.mark.parametrize("name", ["piqp", "proxqp", "clarabel"])
def test_the_signs_of_the_example_are_those_of_a_solver(name):
    solver = sr.load_registry().build("solver", name)
    answers = {
        (0, 1): {"x": [2, 1], "y": [2], "z": [], "z_box": [1, 0]},
        (1, 0): {"x": [1, 0], "y": [], "z": [4], "z_box": [0, -5]},
        (0, 0): {"x": [2, 0], "y": [], "z": [], "z_box": [3, -1]},
    }
    for (rows, equalities), answer in answers.items():
        program = sr.QuadraticProgram(
            P=csc_array(np.eye(2)),
            q=np.array([-5.0, 1.0]),
            G=csc_array(np.array([[1.0, 1.0]])[:rows]),
            h=np.ones(rows),
            A=csc_array(np.array([[1.0, -1.0]])[:equalities]),
            b=np.ones(equalities),
            lower=np.zeros(2),
            upper=np.full(2, 2.0),
        )
        claim = solver.solve(program, 1e-10)
        assert claim.status == "solved"
        for part, expected in answer.items():
            np.testing.assert_allclose(getattr(claim, part), expected, atol=1e-7, err_msg=part)


def large(seed: int) -> sr.QuadraticProgram:
    """Numbers of ten million, whose rounding is above an absolute accuracy of 1e-10."""
    rng, n = np.random.default_rng(seed), 30
    G, inside = rng.normal(size=(12, n)), rng.uniform(-1e4, 1e4, n)
    return sr.QuadraticProgram(
        csc_array(np.diag(rng.uniform(500.0, 2000.0, n))),
        1e7 * rng.normal(size=n),
        csc_array(G),
        G @ inside,
        csc_array(rng.normal(size=(2, n))),
        rng.normal(size=2),
        np.full(n, -3e4),
        np.full(n, 3e4),
    )


@pytest.mark.parametrize("name", ["piqp", "proxqp"])
def test_an_answer_that_holds_is_one_whatever_the_solver_ended_with(name):
    program = large(0)
    claim = sr.load_registry().build("solver", name).solve(program, 1e-10)
    assert "MAX_ITER" in claim.message
    assert claim.status == "solved"
    right = sr.load_registry().build("solver", "clarabel").solve(program, 1e-10)
    assert np.abs(claim.x - right.x).max() <= 1e-9 * np.abs(right.x).max()


# minimise |x|^2/2 - 5 x1 + x2 + 2 x3 subject to x1 + x2 <= 1, x1 - x2 = 1, 0 <= x1, x2 <= 2, -1 <= x3: x = (1, 0, -1)
EXACT = sr.Claim("failed", np.array([1.0, 0, -1]), np.array([1.5]), np.array([2.5]), np.array([0.0, 0, -1]), "stopped")
PROGRAM = sr.QuadraticProgram(
    csc_array(np.eye(3)),
    np.array([-5.0, 1, 2]),
    csc_array(np.array([[1.0, 1, 0]])),
    np.array([1.0]),
    csc_array(np.array([[1.0, -1, 0]])),
    np.array([1.0]),
    np.array([0.0, 0, -1]),
    np.array([2.0, 2, np.inf]),
)


def test_a_claim_is_judged_by_its_residuals_and_by_nothing_else():
    assert EXACT.judged(PROGRAM, 1e-10).status == "solved"
    assert replace(EXACT, status="infeasible").judged(PROGRAM, 1e-10).status == "infeasible"
    off = 1e-6
    wrong = {
        "row": replace(EXACT, x=EXACT.x + np.array([off, 0, 0])),
        "equality": replace(EXACT, x=EXACT.x - np.array([off, 0, 0])),
        "bound": replace(EXACT, x=EXACT.x - np.array([0, 0, off])),
        "slope": replace(EXACT, y=EXACT.y + off, z=EXACT.z - off),
        "size": replace(EXACT, z=np.zeros(0)),
        "nan": replace(EXACT, x=np.full(3, np.nan)),
    }
    assert all(claim.judged(PROGRAM, 1e-8) is claim for claim in wrong.values())
    assert all(replace(EXACT, x=EXACT.x + shift).met(PROGRAM, 1e-4) for shift in ([off, 0, 0], [0, 0, -off]))


def plain(slope=0.0, lower=-np.inf, upper=np.inf, row=np.inf, equal=None) -> sr.QuadraticProgram:
    """One variable: minimise ``slope x`` within bounds, under ``x <= row`` and ``x = equal``."""
    one, rows, equals = csc_array(np.ones((1, 1))), int(row < np.inf), int(equal is not None)
    h, b = np.array([row])[:rows], np.array([equal])[:equals].astype(float)
    return sr.QuadraticProgram(
        0.0 * one, np.array([slope]), one[:rows], h, one[:equals], b, np.array([lower]), np.array([upper])
    )


@pytest.mark.parametrize(
    ("program", "z", "box"),
    [
        (plain(lower=1e-6), [], 0.0),
        (plain(upper=-1e-6), [], 0.0),
        (plain(row=-1e-6), [0.0], 0.0),
        (plain(equal=1e-6), [], 0.0),
        (plain(equal=-1e-6), [], 0.0),
        (plain(slope=1e-6, lower=0.0), [], 0.0),
        (plain(slope=1.0, row=0.0), [-1.0], 0.0),
        (plain(slope=1.0, upper=0.0), [], -1.0),
        (plain(slope=-1.0, lower=0.0), [], 1.0),
    ],
)
def test_each_condition_alone_is_asked_for(program, z, box):
    """At ``x = 0`` everything but one condition of optimality holds."""
    claim = sr.Claim("failed", np.zeros(1), np.array(z), np.zeros(program.b.size), np.array([box]))
    assert not claim.met(program, 1e-7)
    loose = 1e-5 if abs(box) + sum(np.abs(z)) == 0.0 else 2.0
    assert claim.met(program, loose)


def test_a_row_that_is_priced_but_not_active_leaves_a_gap():
    free = replace(PROGRAM, h=np.array([1.0 + 1e-6]))  # the same slopes, and a gap of 1.5e-6
    assert not EXACT.met(free, 1e-6)
    assert EXACT.met(free, 2e-6)


def test_rounding_of_large_numbers_is_forgiven_and_no_more():
    program = replace(PROGRAM, P=csc_array(1e8 * np.eye(3)), q=PROGRAM.q + (1 - 1e8) * EXACT.x)
    assert EXACT.met(program, 1e-10)
    for missed, holds in ((1e-7, True), (1e-4, False)):
        assert replace(EXACT, z_box=EXACT.z_box - [0, missed, 0]).met(program, 1e-10) == holds
