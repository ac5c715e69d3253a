"""Guards control/feedback/observer: the observer gain weighs a noise by how far it goes from its middle."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.feedback.observer import Observer

FLOWS = np.tile(np.array([[1.0, 0.25], [0.0, 1.0]]), (4, 1, 1))
SEEN = np.tile(np.array([[0.03], [0.25]]), (5, 1, 1))
RADII = np.array([0.05])


def observer(noise: sr.ConvexSet | None) -> Observer:
    return Observer.of(sr.Measurements(C=[[1.0, 0.0]], noise=noise), SEEN, FLOWS, RADII, np.arange(6.0))


@pytest.mark.parametrize("centre", [0.5, -3.0, 1024.0])
def test_a_noise_that_is_moved_leaves_the_observer_gain_as_it_is(centre: float) -> None:
    centred, moved = observer(sr.Box([-0.25], [0.25])), observer(sr.Box([centre - 0.25], [centre + 0.25]))
    np.testing.assert_array_equal(moved.L, centred.L)
    assert moved.middle == centre


def test_a_noise_that_goes_farther_is_trusted_less() -> None:
    near, far = observer(sr.Box([0.9], [1.1])), observer(sr.Box([0.0], [2.0]))
    assert (np.abs(near.L[1:-1, 0]) > np.abs(far.L[1:-1, 0])).all()
