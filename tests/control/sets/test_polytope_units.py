"""Guards control/sets/polytope.py: a polytope means the same whatever factors its rows and coordinates carry."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.sets.sets import Polytope

H = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0]])
h = np.array([1.0, 1.0, 1.0, 1.0, 0.5])


@pytest.mark.first(4)
@pytest.mark.parametrize("seed", range(8))
def test_rows_and_coordinates_of_any_size_make_the_same_set(seed):
    rng = np.random.default_rng(seed)
    rows, units = (10.0 ** rng.uniform(-12, 12, size=n) for n in (5, 2))
    plain, odd = Polytope(H, h), Polytope(rows[:, None] * H / units, rows * h)
    assert odd.is_bounded
    directions = rng.normal(size=(20, 2))
    np.testing.assert_allclose(odd.support(directions / units), plain.support(directions), rtol=1e-9)
    np.testing.assert_allclose(odd.interior_point() / units @ H.T <= h + 1e-9, True)


def test_a_row_that_is_tiny_does_not_make_a_set_unbounded_nor_an_empty_one_possible():
    assert Polytope(np.array([[1e-15], [-1e-15]]), np.array([1e-15, 1e-15])).is_bounded
    with pytest.raises(Exception, match="empty"):
        Polytope(np.array([[1e-12], [-1.0]]), np.array([1e-12, -1.1]))
    assert not Polytope(np.array([[1e-12, 0.0]]), np.array([1e-12])).is_bounded
