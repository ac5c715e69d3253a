"""Guards control/feedback/closed_loop, observer, tree: what is seen, what gains make of it, and rows of signals
that are sampled, against a loop that is stepped."""

from __future__ import annotations

import dataclasses
from functools import cache
from itertools import product

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.feedback.observer import Observer
from sparserob_core.control.feedback.tree import Sampled
from sparserob_core.control.sets.sets import Box
from sparserob_core.control.transcription.transcribe import prepare
from tests.support.closed_loops import LOOPS

H = np.array([[1.0, 0.0], [0.0, -1.0], [0.6, 0.8], [-1.0, 0.3]])
STEPPED = ["box", "ball and begun", "fast", "outputs", "begun"]


@cache
def made(name):
    case = LOOPS[name]
    loop = prepare(case.problem, *case.grids, policy=sr.AffinePolicy()).feedback.loop
    return dataclasses.replace(case, observer=None if loop.observer is None else loop.observer.L), loop


@pytest.mark.parametrize("name", STEPPED)
def test_what_is_seen_is_what_a_stepped_loop_sees(name):
    """One entry of the gains at a time: the control that answers is the innovation itself."""
    case, loop = made(name)
    K, p, _ = loop.innovations.shape
    times, v = np.array([0.0, 2.0]), np.zeros((case.B.shape[1], K))
    for j, channel in product(range(K), range(p)):
        M = np.zeros((K, K, len(v), p))
        M[K - 1, j, 0, channel] = 1.0
        controls = case.states(v, M, times)[2]
        assert controls[K - 1, 0, 1:] == pytest.approx(loop.innovations[j, channel], abs=1e-12)
    low, high = loop.expected
    assert high.shape == (K, p)
    height = case.height(np.concatenate([np.zeros((K, p, 1)), loop.innovations], axis=2))
    assert high == pytest.approx(height, abs=1e-12)
    assert -low == pytest.approx(
        case.height(np.concatenate([np.zeros((K, p, 1)), -loop.innovations], axis=2)), abs=1e-12
    )
    assert loop.written(None).keys() == ({"observer"} if case.C is not None else set())


@pytest.mark.parametrize("name", STEPPED)
def test_the_effects_of_gains_are_gains_of_what_was_seen(name):
    _, loop = made(name)
    x = np.random.default_rng(3).normal(size=loop.variables)
    M = loop.gains(x)
    assert loop.effects(x) == pytest.approx(np.einsum("kjmp,jpq->kmq", M, loop.innovations), abs=1e-10)
    K = len(M)
    assert not M[np.triu_indices(K, 1)].any()
    assert set(loop.written(x)) >= {"gains"} and (loop.written(x)["gains"] == M).all()
    at, _, value = loop.answers.effect
    assert loop.answers.single == (len(set(at.tolist())) == at.size and set(value.tolist()) <= {1.0})


@pytest.mark.parametrize("name", ["box", "fast", "ball and begun"])
def test_rows_of_a_tree_are_those_of_states_under_any_control_and_signal(name):
    """Controls of their own for the signal: the loop does not answer. Initial states are the middle of their set."""
    case, loop = made(name)
    rng, times = np.random.default_rng(4), np.array([0.0, 0.3, 1.1, 2.0])
    constraints = [(H, rng.normal(size=4), times[1:]), (H[:0], np.zeros(0), times), (H[:1], np.ones(1), times[:2])]
    found = Sampled.of(loop, constraints)
    assert found.constraint.tolist() == [0] * 12 + [2] * 2 and found.side.tolist() == [0, 1, 2, 3] * 3 + [0, 0]
    assert found.time.tolist() == [0.3] * 4 + [1.1] * 4 + [2.0] * 4 + [0.0, 0.3]
    K = case.breakpoints.size - 1
    d, m = case.B.shape
    v, Q = rng.normal(size=(m, K)), loop.noise.start
    states = case.states(v, np.zeros((K, K, m, d)), times)[0]
    z = rng.normal(size=Q)
    reached = states[:, :, 0] + states[:, :, 1 : 1 + Q] @ z
    by_hand = []
    for number, side, time in zip(found.constraint, found.side, found.time, strict=True):
        c, h = constraints[number][0][side], constraints[number][1][side]
        by_hand.append(c @ reached[times == time][0] - h)
    told = np.einsum("rmk,mk->r", found.T, v) + found.N @ z - found.b
    assert told == pytest.approx(np.array(by_hand), abs=1e-10)
    nothing = Sampled.of(loop, [(H[:0], np.zeros(0), times)])
    assert nothing.T.shape == (0, m, K) and nothing.N.shape == (0, z.size) and nothing.time.size == 0


def test_an_observer_predicts_with_the_least_error():
    """Of every breakpoint: no other gain leaves a smaller sum of squares of what is mispredicted there."""
    rng = np.random.default_rng(5)
    K, d, p, Q = 4, 3, 2, 5
    C, seen, flows = rng.normal(size=(p, d)), rng.normal(size=(K, d, Q)), rng.normal(size=(K - 1, d, d))
    radii, noise = rng.uniform(0.5, 2.0, Q), Box([-0.2, -0.3], [0.2, 0.3])
    found = Observer.of(sr.Measurements(C, noise), seen, flows, radii, np.arange(K + 1.0))
    far = np.array([0.2, 0.3])
    assert not found.middle.any() and found.noisy and not found.L[-1].any()

    def mispredicted(L):
        """The sum of squares at every breakpoint, each deviation and noise by its radius."""
        error = np.hstack([seen[0] * radii, np.zeros((d, (K - 1) * p))])
        sizes = []
        for j in range(K - 1):
            measured = C @ error
            measured[:, Q + j * p : Q + (j + 1) * p] += np.diag(far)
            # every breakpoint has deviations of its own: squares add up
            onward = flows[j] @ error - L[j] @ measured
            fresh = seen[j + 1] * radii
            sizes.append((onward**2).sum() + (fresh**2).sum())
            error = np.hstack([onward, fresh])
            error = np.linalg.cholesky(error @ error.T + 1e-300 * np.eye(d))
            error = np.hstack([error, np.zeros((d, Q + (K - 1) * p - d))])
        return np.array(sizes)

    least = mispredicted(found.L)
    for _ in range(20):
        other = found.L + 1e-2 * rng.normal(size=found.L.shape)
        for j in range(K - 1):
            moved = found.L.copy()
            moved[j] = other[j]
            assert mispredicted(moved)[j] > least[j]
    whole = Observer.of(sr.Measurements(np.diag([2.0, 1.0, -1.0])), seen, flows, radii, np.arange(K + 1.0))
    assert whole.L[0] @ np.diag([2.0, 1.0, -1.0]) == pytest.approx(flows[0]) and not whole.noisy
    states = rng.normal(size=(d, 6))
    apart = Observer.of(sr.Measurements(C, Box([-0.3, -0.1], [0.1, 0.5])), seen, flows, radii, np.arange(K + 1.0))
    assert apart.outputs(states) == pytest.approx(C @ states + np.array([[-0.1], [0.2]]))
    assert found.outputs(states, np.ones((p, 6))) == pytest.approx(C @ states + 1.0)
