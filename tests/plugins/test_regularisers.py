"""Guards plugins/sparserob_regularisers: the shipped regularisers are what their formulas say, and strictly convex."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csc_array, eye_array, kron

import sparserob_core as sr
from sparserob_dictionaries import Haar, PiecewiseConstant
from sparserob_regularisers import Ridge, Smoothness, WeightedRidge


def image(dictionary: sr.Dictionary, channels: int) -> sr.ControlImage:
    S = csc_array(kron(eye_array(channels), dictionary.values.T))
    return sr.ControlImage(S, channels, np.tile(dictionary.lengths, channels))


IMAGES = [
    image(PiecewiseConstant(breakpoints=[0, 0.2, 1, 1.5]).build(1.5), 2),
    image(Haar(pieces=8, functions=5).build(2.0), 2),
    image(PiecewiseConstant(pieces=1).build(1.0), 1),
]


@pytest.mark.parametrize("regulariser", [Ridge(), WeightedRidge(), WeightedRidge(weights=2.0), Smoothness()])
@pytest.mark.parametrize("shape", IMAGES)
def test_a_regulariser_is_strictly_convex(regulariser, shape) -> None:
    P, q = regulariser.quadratic(shape)
    dense = P.toarray()
    assert dense.shape == (q.size, q.size) == (shape.S.shape[1],) * 2
    np.testing.assert_array_equal(dense, dense.T)
    assert np.linalg.eigvalsh(dense)[0] > 0


def test_ridge_is_half_the_squared_norm_of_the_coefficients() -> None:
    x = np.arange(5.0)
    P, q = Ridge().quadratic(sr.ControlImage(csc_array(np.eye(5)), 1, np.ones(5)))
    assert 0.5 * x @ P @ x + q @ x == pytest.approx(0.5 * x @ x)


def test_weighted_ridge_is_the_energy_of_the_control() -> None:
    shape = IMAGES[1]
    x = np.random.default_rng(0).normal(size=10)
    P, _ = WeightedRidge(weights=[1.0, 3.0]).quadratic(shape)
    u = (shape.S @ x).reshape(2, 8)
    assert 0.5 * x @ P @ x == pytest.approx(0.5 * (u**2 @ np.full(8, 0.25)) @ [1.0, 3.0])


def test_smoothness_counts_the_jumps_within_each_channel_only() -> None:
    shape = IMAGES[0]
    x = np.array([1.0, 1.0, 1.0, 4.0, 4.0, 6.0])
    P, _ = Smoothness(ridge=1e-2).quadratic(shape)
    assert 0.5 * x @ P @ x == pytest.approx(0.5 * 2.0**2 + 0.5e-2 * x @ x)


def test_weights_must_fit_the_channels() -> None:
    with pytest.raises(sr.InputError, match="weights: expected 2 numbers, one per control, got 3"):
        WeightedRidge(weights=[1.0, 2.0, 3.0]).quadratic(IMAGES[0])
    with pytest.raises(ValueError, match="weights"):
        WeightedRidge(weights=0.0)


def test_an_image_whose_lengths_do_not_fit_is_refused() -> None:
    with pytest.raises(sr.InputError, match="lengths must be 3 positive numbers"):
        sr.ControlImage(csc_array(np.eye(3)), 1, np.ones(2))
    with pytest.raises(sr.InputError, match="do not divide into 2 channels"):
        sr.ControlImage(csc_array(np.eye(3)), 2, np.ones(3))
