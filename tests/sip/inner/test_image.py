"""Guards sip/inner/image: decisions within the bounds of images of one entry; multipliers of images are stationary, and
none is beyond what an image without a bound allows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_array, eye_array, vstack

from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import dual_bound
from sparserob_core.sip.inner.image import CANCELLED_SHARE, move_within_bounds, project_onto_stationary


def program(lower: list[float], upper: list[float], S: list[list[float]]) -> FiniteProgram:
    n, k = len(S[0]), len(S)
    nothing = np.zeros((0, n))
    bounds = np.array(lower), np.array(upper)
    return FiniteProgram(np.zeros(n), np.ones(k), *bounds, nothing, np.zeros(0), nothing, np.zeros(0), S=csc_array(S))


def test_an_entry_that_may_only_be_0_is_0_and_sums_are_left_alone() -> None:
    S = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -2.0], [1.0, -1.0, 0.0]]
    finite = program([0.0, -1.0, -4.0, 0.0], [0.0, 1.0, 2.0, 0.0], S)
    moved = move_within_bounds(finite, np.array([1e-13, 0.5, -1.5]))
    assert moved.tolist() == [0.0, 0.5, -1.0]  # -2 x3 <= 2; the difference of two entries is not an entry


def test_several_images_of_one_entry_bound_it_together() -> None:
    finite = program([-1.0, -3.0], [1.0, 0.5], [[1.0], [-1.0]])
    assert move_within_bounds(finite, np.array([-0.9])).tolist() == [-0.5]
    assert move_within_bounds(finite, np.array([2.0])).tolist() == [1.0]


def slanted(seed: int, sides: int, q: np.ndarray | None = None) -> FiniteProgram:
    """Entries in boxes, and ``sides`` sums of them that are bounded from above only; of no weight."""
    rng = np.random.default_rng(seed)
    n = 12
    S = csc_array(vstack([eye_array(n), csc_array(rng.normal(size=(sides, n)))]))
    lower = np.concatenate([np.full(n, -1.0), np.full(sides, -np.inf)])
    weights = np.concatenate([np.full(n, 0.01), np.zeros(sides)])
    none = np.zeros((0, n))
    cost = rng.normal(size=n) if q is None else q
    return FiniteProgram(cost, weights, lower, np.ones(n + sides), none, np.zeros(0), none, np.zeros(0), S=S)


@pytest.mark.first(24)
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("dust", [0.0, 1e-16, 1e-14, 1e-9])
def test_a_multiplier_near_its_limit_is_held_there_and_the_others_make_up_for_it(seed, dust):
    program = slanted(seed, sides=15)
    rng = np.random.default_rng(seed + 100)
    z = np.concatenate([rng.normal(size=12), dust * np.abs(rng.normal(size=15))])
    moved = project_onto_stationary(program, z, program.q)
    assert np.abs(program.S.T @ moved + program.q).max() <= 1e-12
    limit = CANCELLED_SHARE * np.abs(moved).max()
    assert moved[12:].min() >= -limit  # below it a side without a lower bound proves nothing
    assert np.isfinite(dual_bound(program, np.zeros(0), np.zeros(0), z))


@pytest.mark.parametrize("seed", range(6))
def test_what_is_stationary_already_but_beyond_its_limit_is_moved_too(seed):
    program = slanted(seed, sides=5)
    z = np.concatenate([np.zeros(12), -np.full(5, 1e-6)])
    z[:12] = -(program.q + program.S[12:].T @ z[12:])
    moved = project_onto_stationary(program, z, program.q)
    assert np.abs(program.S.T @ moved + program.q).max() <= 1e-12
    assert moved[12:].min() >= -CANCELLED_SHARE * np.abs(moved).max()


@pytest.mark.parametrize("off", [1e-14, 1e-13, 5e-13])
def test_multipliers_that_are_off_by_little_are_moved_too(off: float) -> None:
    """What is left of them would be missing in a bound, which is held against the multipliers as they are written."""
    finite = program([-2.0] * 4, [2.0] * 4, [[1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [1.0, -1.0]])
    S, z = finite.S, np.array([0.5, 0.25, -0.4, 0.1])
    assert S is not None
    slope = -(S.T @ z) + off
    left = np.abs(S.T @ project_onto_stationary(finite, z, slope) + slope).max()
    assert left <= 1e-15
