"""Guards sip/inner/image: decisions within the bounds of images of one entry."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array

from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.image import within_bounds


def program(lower: list[float], upper: list[float], S: list[list[float]]) -> FiniteProgram:
    n, k = len(S[0]), len(S)
    nothing = np.zeros((0, n))
    bounds = np.array(lower), np.array(upper)
    return FiniteProgram(np.zeros(n), np.ones(k), *bounds, nothing, np.zeros(0), nothing, np.zeros(0), S=csc_array(S))


def test_an_entry_that_may_only_be_0_is_0_and_sums_are_left_alone() -> None:
    S = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -2.0], [1.0, -1.0, 0.0]]
    finite = program([0.0, -1.0, -4.0, 0.0], [0.0, 1.0, 2.0, 0.0], S)
    moved = within_bounds(finite, np.array([1e-13, 0.5, -1.5]))
    assert moved.tolist() == [0.0, 0.5, -1.0]  # -2 x3 <= 2; the difference of two entries is not an entry


def test_several_images_of_one_entry_bound_it_together() -> None:
    finite = program([-1.0, -3.0], [1.0, 0.5], [[1.0], [-1.0]])
    assert within_bounds(finite, np.array([-0.9])).tolist() == [-0.5]
    assert within_bounds(finite, np.array([2.0])).tolist() == [1.0]
