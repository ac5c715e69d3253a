"""Guards checker/reach/closed_loop beside an inner loop that acts on estimates of the state: its controls are those
of a loop that is computed elsewhere, and no deviation exceeds the bound of what the estimates miss."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from sparserob_core.checker.arithmetic.balls import ball
from sparserob_core.checker.claims.answers import VerifiedFeedback, _collect_inputs
from sparserob_core.checker.claims.case import Case
from sparserob_core.control.feedback.closed_loop import ClosedLoop
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.sip.convex_set import Box


@cache
def made(noise: bool) -> tuple[ClosedLoop, np.ndarray, VerifiedFeedback]:
    """A loop of five pieces whose outputs are known two pieces later, a random decision, and what a checker makes of
    its certificate."""
    problem = OptimalControlProblem(
        system=LinearSystem([[0.0, 1.0], [9.0, 0.0]], [[0.0], [1.0]], [[0.0], [1.0]], c=[0.0, 0.2]),
        horizon=2.0,
        initial_state=np.array([0.1, 0.0]),
        initial_set=Box([-0.02, -0.03], [0.04, 0.03]),
        control=Box([-8.0], [8.0]),
        disturbance=Box([-0.3], [0.2]),
        path=[Box([-0.5, -np.inf], [0.5, np.inf])],
        measurements=Measurements([[1.0, 0.2]], Box([-0.02], [0.03]) if noise else None, latency=0.5),
    )
    grid, policy = Dictionary.indicators(np.linspace(0.0, 2.0, 6)), AffinePolicy(cost="peak", prestabilise="auto")
    model = prepare(problem, grid, grid, policy=policy)
    loop = model.answering.loop
    x = np.random.default_rng(3).normal(size=model.program.n)
    certificate = {"decision": x[None, :5].tolist(), **{key: value.tolist() for key, value in loop.written(x).items()}}
    return loop, x, VerifiedFeedback(Case(problem, grid, grid, certificate, policy=policy))


@pytest.mark.parametrize("noise", [True, False])
def test_controls_and_states_are_those_of_the_loop(noise: bool) -> None:
    loop, x, feedback = made(noise)
    assert loop.missing.any()
    for k, control in enumerate(loop.controls(x)):
        found = np.array([[float(v) for v in row] for row in feedback.loop.inputs(k).tolist()])
        assert found == pytest.approx(control, rel=1e-9, abs=1e-11)
    nodes = np.array([[[float(v) for v in row] for row in node.tolist()] for node in feedback.loop.nodes])
    assert nodes == pytest.approx(loop.path(x)[0], rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("noise", [True, False])
def test_what_is_missing_is_bounded_by_what_a_deviation_attains(noise: bool) -> None:
    loop, _, feedback = made(noise)
    found = feedback.loop_at_rest.bound_missing(feedback.case.inner.gains)
    worst = max(float(np.abs(row) @ loop.spread.radii) for row in loop.missing[:, 0])
    assert found[0] >= worst * (1.0 - 1e-12) and found[0] == pytest.approx(worst, rel=1e-9)


def test_the_range_of_the_decided_part_is_wider_by_what_is_missing() -> None:
    loop, _, feedback = made(True)
    inputs = _collect_inputs(feedback.case, np.zeros(1))
    narrow = feedback.case.inner.widen(feedback.case.problem.control, lambda: inputs).support(np.ones((1, 1)))[0]
    found = float(feedback.range.support(np.ones((1, 1)))[0])
    assert found - narrow == pytest.approx(loop.widest[0], rel=1e-6) and found - narrow >= loop.widest[0]


@pytest.mark.parametrize("noise", [True, False])
def test_a_row_under_named_deviations_is_the_control_under_them(noise: bool) -> None:
    """``sum_k s_k u_k`` as a constant, slopes of ``v`` and of answers to innovations."""
    loop, x, feedback = made(noise)
    rng, blocks = np.random.default_rng(5), loop.spread
    z = rng.uniform(-0.5, 0.5, blocks.size) * blocks.radii
    slope = rng.normal(size=5)
    middle = blocks.middle + z
    entry = {"disturbance": middle[:5][None].tolist(), "deviation": middle[-2:].tolist()}
    entry |= {"noise": middle[5:10, None].tolist()} if noise else {}
    named = feedback.named(entry, "control")
    constant, slopes = feedback.case.inner.on_decided(
        [[ball(s)] for s in slope], lambda: (named.entering, named.errors)
    )
    innovations = np.zeros((5, named.loop.innovations.outputs))
    for k, responses in enumerate(named.loop.innovations.matrices):
        for block, response in responses.items():
            parts = [
                float(response[s, b] * x)
                for s in range(len(innovations[k]))
                for b, x in enumerate(named.answered[block])
            ]
            innovations[k] += np.reshape(parts, (len(innovations[k]), -1)).sum(axis=1)
    answered = np.einsum("kjmp,jp->km", loop.gains(x), innovations)[:, 0] + x[:5]
    found = float(constant) + sum(float(s) * u for (s,), u in zip(slopes, answered, strict=True))
    assert found == pytest.approx(float(slope @ (loop.controls(x) @ np.append(1.0, z))[:, 0]), rel=1e-9)
