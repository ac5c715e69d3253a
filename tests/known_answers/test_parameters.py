"""Guards known answers: uncertain parameters: known values, proven over the whole box and refuted a little below."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.proof.branch_and_bound import prove


def oscillator():
    """``x'' + omega^2 x = u`` from (1, 0) over one period, ``|x1(T)| <= 0.8``, ``omega`` in [0.9, 1.1]."""

    def A(p):
        return np.array([[0, 1], [-(p[0] ** 2), 0]], dtype=object)

    return sr.OptimalControlProblem(
        system=sr.LinearSystem(A, [[0.0], [1.0]], parameters=sr.Box([0.9], [1.1])),
        horizon=2 * np.pi,
        initial_state=[1.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        terminal=[sr.Box([-0.8, -np.inf], [0.8, np.inf])],
    )


def dictionary(pieces):
    return sr.Dictionary(np.linspace(0.0, 2 * np.pi, pieces + 1), np.eye(pieces))


@pytest.mark.slow
def test_the_oscillator_with_a_worst_parameter_inside_its_interval_is_proven():
    program = sr.transcribe(oscillator(), control=dictionary(100))
    result = sr.solve(program, method="exchange", solver="piqp", tolerance=1e-7)
    assert result.status == "certified", result.message
    assert abs(result.cost - 0.200625) <= 2e-6
    (proof,) = prove(program, result.decision)
    lower, upper = proof.leaves
    assert np.isclose((upper - lower)[:, 1].sum(), 0.2, rtol=1e-12)


@pytest.mark.first(1)
@pytest.mark.parametrize("share", [0.99, 0.9, 0.0])
def test_less_control_than_the_worst_parameter_needs_is_refuted_inside_the_interval(share):
    program = sr.transcribe(oscillator(), control=dictionary(100))
    x = sr.solve(program, method="exchange", solver="piqp", tolerance=1e-7).decision
    (proof,) = prove(program, share * x)
    assert proof.verdict == "refuted"
    assert 0.9 < proof.index[1] < 1.1
