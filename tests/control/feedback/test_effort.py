"""Guards control/feedback/effort: the largest effort is between its bounds, which meet where parts allow."""

from __future__ import annotations

import heapq
from itertools import product

import numpy as np
import pytest

from sparserob_core.control.feedback.effort import CLOSE, largest_effort
from sparserob_core.control.sets.sets import Box, NormBall
from sparserob_core.sip.finite import Spread


def vertices(box, count):
    middle = (box.lower + box.upper) / 2
    corners = np.array(list(product(*zip(box.lower - middle, box.upper - middle, strict=True))))
    return np.array([np.concatenate(some) for some in product(corners, repeat=count)])


@pytest.mark.parametrize("seed", range(6))
def test_the_largest_effort_over_a_box_is_that_of_its_vertices(seed):
    rng = np.random.default_rng(seed)
    box = Box(rng.uniform(-1.0, -0.2, size=2), rng.uniform(0.2, 1.5, size=2))
    n, points = int(rng.integers(1, 9)), vertices(box, 3)
    a, A = rng.normal(size=n), rng.normal(size=(n, 6))
    A[rng.integers(0, n)] *= 0.01  # an entry whose sign is known
    top = np.abs(a + points @ A.T).sum(axis=1).max()
    found = largest_effort(a, A, Spread(((3, box),)))
    assert found.lower == pytest.approx(top, rel=1e-12)
    assert top * (1 - 1e-13) <= found.upper <= top * (1 + 2 * CLOSE)
    assert found.values[0] == pytest.approx(found.lower, rel=1e-13)
    assert (np.diff(found.values) <= 0.0).all() and (np.abs(found.signs) == 1.0).all()
    for signs, value in zip(found.signs, found.values, strict=True):
        assert value == pytest.approx((signs @ a + points @ A.T @ signs).max())
    for parts in (1, 3, 20):  # with few parts the bounds are apart, and hold
        rough = largest_effort(a, A, Spread(((3, box),)), parts)
        assert rough.lower <= top * (1 + 1e-13) and rough.upper >= top * (1 - 1e-13)


def test_the_largest_effort_over_a_ball_is_that_of_its_points():
    rng = np.random.default_rng(7)
    ball = NormBall(p=2.0, radius=0.7, centre=np.array([0.4, -0.2]))
    angles = np.linspace(0.0, 2.0 * np.pi, 40001)
    points = 0.7 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for n in (1, 4, 7):
        a, A = 0.3 * rng.normal(size=n), rng.normal(size=(n, 2))
        top = np.abs(a + points @ A.T).sum(axis=1).max()
        found = largest_effort(a, A, Spread(((1, ball),)))
        assert found.upper >= top and found.lower <= found.upper
        assert found.lower == pytest.approx(top, rel=1e-7)
        assert found.upper <= top * (1 + 1e-7)


def test_every_part_has_a_number_of_its_own(monkeypatch):
    """Two with the same bound and number would be compared by their arrays, which is an error."""
    numbers, push, rng = [], heapq.heappush, np.random.default_rng(5)
    monkeypatch.setattr(heapq, "heappush", lambda heap, item: numbers.append(item[1]) or push(heap, item))
    largest_effort(0.1 * rng.normal(size=10), rng.normal(size=(10, 4)), Spread(((4, Box([-1.0], [1.0])),)))
    assert len(numbers) > 20 and len(set(numbers)) == len(numbers)


def test_an_effort_that_no_deviation_changes_is_what_it_is():
    found = largest_effort(np.array([1.0, -2.0]), np.zeros((2, 1)), Spread(((1, Box([-1.0], [1.0])),)))
    assert (found.lower, found.upper) == (3.0, pytest.approx(3.0, rel=2 * CLOSE))
    assert (found.signs[0] == [1.0, -1.0]).all()
