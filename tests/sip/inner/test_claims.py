"""Guards sip/solver.py: what its page says of shapes and signs is what the shipped solvers claim."""

from __future__ import annotations

import doctest

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
