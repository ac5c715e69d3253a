"""Guards control/feedback/innovations: the variables are effects of gains, numbered piece by piece; what is forgotten
or not measured yet is not answered."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.feedback.innovations import answers, find_negligible_entries
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box
from sparserob_core.control.transcription.transcribe import prepare


def innovations(rng: np.random.Generator, K: int, d: int, Q: int) -> np.ndarray:
    """Entries of the deviations that are seen at one breakpoint, or at two."""
    D = np.zeros((K, d, Q))
    for q in range(Q):
        first = int(rng.integers(0, K))
        D[first, :, q] = rng.normal(size=d)
        if rng.random() < 0.3 and first + 1 < K:
            D[first + 1, :, q] = rng.normal(size=d)
    return D


@pytest.mark.parametrize("memory", [None, 0.25])
@pytest.mark.parametrize("seed", range(12))
def test_gains_have_the_effects_that_the_variables_say(seed: int, memory: float | None) -> None:
    rng = np.random.default_rng(seed)
    K, d, channels = int(rng.integers(1, 9)), int(rng.integers(1, 4)), int(rng.integers(1, 4))
    Q = int(rng.integers(1, 3 * K))
    D, breakpoints = innovations(rng, K, d, Q), np.concatenate([[0.0], np.sort(rng.random(K - 1)), [1.0]])
    known = answers(D, AffinePolicy(memory=memory).answers(breakpoints), channels)
    numbers = rng.normal(size=known.variables)
    F, M = known.effects(numbers), known.gains(numbers)
    np.testing.assert_allclose(np.einsum("kjid,jdq->kiq", M, D), F, atol=1e-8 * max(1.0, np.abs(M).max(initial=0.0)))
    np.testing.assert_array_equal(F[known.piece, known.channel, known.entry], numbers)
    for k, j in np.argwhere(M.any(axis=(2, 3))):
        assert j <= k and (memory is None or breakpoints[k] - breakpoints[j] <= memory + 1e-12)
    assert (np.diff(known.piece) >= 0).all() and (np.diff(known.effect[0] // (channels * Q)) >= 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_there_are_as_many_variables_as_what_is_seen_is_independent(seed: int) -> None:
    """Of every piece of the control: the rank of all that was seen by then, for each channel."""
    rng = np.random.default_rng(seed)
    K, d, Q = 5, 2, 12
    D = innovations(rng, K, d, Q)
    known = answers(D, np.tril(np.ones((K, K), dtype=bool)), 2)
    for k in range(K):
        rank = np.linalg.matrix_rank(D[: k + 1].reshape(-1, Q))
        assert np.count_nonzero(known.piece == k) == 2 * rank


def test_nothing_that_is_seen_is_nothing_that_is_answered() -> None:
    known = answers(np.zeros((3, 2, 4)), np.tril(np.ones((3, 3), dtype=bool)), 2)
    assert known.variables == 0
    assert not known.effects(np.zeros(0)).any() and not known.gains(np.zeros(0)).any()


def test_what_is_as_old_as_the_memory_is_answered_however_the_times_are_rounded() -> None:
    """In floats ``0.8 - 0.5 > 0.3``."""
    mask = AffinePolicy(memory=0.3).answers(np.linspace(0.0, 1.0, 11))
    assert (mask == (np.tril(np.ones((10, 10))) - np.tril(np.ones((10, 10)), -4)).astype(bool)).all()


@pytest.mark.parametrize("seed", range(6))
def test_of_any_choice_of_measurements_the_effects_are_all_that_gains_of_them_can_have(seed: int) -> None:
    """Of every piece: the rank of what it answers, and gains that answer nothing else."""
    rng = np.random.default_rng(seed)
    K, d, Q = 5, 2, 12
    D, mask = innovations(rng, K, d, Q), np.tril(rng.random((K, K)) < 0.5)
    known = answers(D, mask, 1)
    numbers = rng.normal(size=known.variables)
    F, M = known.effects(numbers), known.gains(numbers)
    np.testing.assert_allclose(np.einsum("kjid,jdq->kiq", M, D), F, atol=1e-8 * max(1.0, np.abs(M).max(initial=0.0)))
    assert not M[~mask].any()
    for k in range(K):
        rank = 0 if not mask[k].any() else np.linalg.matrix_rank(D[mask[k]].reshape(-1, Q))
        assert np.count_nonzero(known.piece == k) == rank


def test_gains_have_effects_on_all_that_is_seen_though_they_answer_less() -> None:
    """What is answered chooses the gains; what they do to the rest of what is seen is theirs too."""
    rng, K, d, Q = np.random.default_rng(3), 4, 2, 8
    D = innovations(rng, K, d, Q)
    less = D * (np.arange(Q) % 3 != 0)
    known = answers(less, np.tril(np.ones((K, K), dtype=bool)), 2, D)
    numbers = rng.normal(size=known.variables)
    F, M = known.effects(numbers), known.gains(numbers)
    assert known.variables and np.isin(known.entry % 3, [1, 2]).all() and F[..., ::3].any()
    np.testing.assert_allclose(np.einsum("kjid,jdq->kiq", M, D), F, atol=1e-12 * np.abs(M).max())
    np.testing.assert_allclose(F[known.piece, known.channel, known.entry], numbers)
    same = answers(D, np.tril(np.ones((K, K), dtype=bool)), 2, D)
    assert same.variables == answers(D, np.tril(np.ones((K, K), dtype=bool)), 2).variables


def test_what_a_deviation_does_to_no_row_by_any_breakpoint_is_unfelt() -> None:
    """``x' = 3 x + w``: what acts early grows; a second entry acts on a state that forgets."""
    problem = sr.OptimalControlProblem(
        system=LinearSystem(np.diag([3.0, -3.0]), np.ones((2, 1))),
        horizon=2.0,
        initial_state=[0.0, 0.0],
        control=Box([-1.0], [1.0]),
        disturbance=Box([-1.0, -1.0], [1.0, 1.0]),
    )
    grid = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 5))
    functionals = prepare(problem, grid, grid).functionals
    pushed = (np.exp(1.5) - 1.0) / 3.0 * np.exp(1.5 * np.arange(3, -1, -1))
    forgot = (1.0 - np.exp(-1.5)) / 3.0
    response, model, rows = functionals.response, functionals.disturbance, np.array([[0.5, 0.0], [0.0, -2.0]])
    for least in (*(pushed * 1.001), *(pushed * 0.999), forgot * 1.001, forgot * 0.999):
        found = find_negligible_entries(response, model, np.ones(2), np.zeros(0), np.eye(2), least).reshape(4, 2)
        assert found.tolist() == [[one <= least, forgot <= least] for one in pushed.tolist()]
        found = find_negligible_entries(response, model, np.ones(2), np.array([0.1, 0.2]), rows, least)
        effects = [[0.5 * one, 2.0 * forgot] for one in pushed.tolist()]
        assert found[:8].reshape(4, 2).tolist() == [[one <= least for one in pair] for pair in effects]
        assert found[8:].tolist() == [least >= 0.05 * np.exp(6.0), least >= 0.4]
        assert (
            find_negligible_entries(response, None, np.zeros(0), np.array([0.1, 0.2]), rows, least).tolist()
            == found[8:].tolist()
        )
    found = find_negligible_entries(response, model, np.array([0.0, 1.0]), np.zeros(0), np.eye(2), 1e-12)
    assert found.tolist() == [True, False] * 4
    assert find_negligible_entries(response, model, np.ones(2), np.ones(2), np.zeros((0, 2)), 0.0).all()


def test_variables_on_less_of_an_entry_are_as_many_times_smaller() -> None:
    rng = np.random.default_rng(2)
    D = rng.normal(size=(3, 2, 4))
    known, sizes = answers(D, np.tril(np.ones((3, 3), dtype=bool)), 1), np.array([1.0, 2.0**-20, 1.0, 2.0**-3])
    fine, numbers = known.on(sizes), rng.normal(size=known.variables)
    assert fine.effects(numbers * sizes[known.entry]).tolist() == known.effects(numbers).tolist()
    assert fine.gains(numbers * sizes[known.entry]).tolist() == known.gains(numbers).tolist()
    assert fine.share.tolist() == sizes[known.entry].tolist() and known.share.tolist() == [1.0] * known.variables
    assert known.on(np.ones(4)) is known and fine.variables == known.variables
