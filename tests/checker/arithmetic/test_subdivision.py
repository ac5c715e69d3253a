"""Guards checker/arithmetic/subdivision: cells that fill a box are accepted, and nothing else is."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from sparserob_core.checker.arithmetic import subdivision
from sparserob_core.checker.arithmetic.subdivision import fill
from sparserob_core.checker.outcome import Broken, Unchecked


def test_times_in_any_order_fill_an_interval_unless_one_is_left_out():
    ends = np.cumsum(np.random.default_rng(8).uniform(0.1, 1.0, size=7))
    rows = [([a], [b]) for a, b in itertools.pairwise(ends)]
    low, high = ends[:1], ends[-1:]
    fill(*cells([*rows[::-1], ([ends[2]], [ends[2]])]), low, high)
    for place in range(len(rows)):
        with pytest.raises(Broken, match="leave a share"):
            fill(*cells([*rows[:place], *rows[place + 1 :]]), low, high)
    for wrong in ([ends[1]], [np.nextafter(ends[2], 9.0)]), ([np.nextafter(ends[1], 0.0)], [ends[2]]):
        with pytest.raises(Broken):
            fill(*cells([rows[0], wrong, *rows[2:]]), low, high)


def cells(rows):
    return tuple(np.array(corner, dtype=float) for corner in zip(*rows, strict=True))


def test_cells_that_fill_a_box_are_accepted():
    low, high = np.zeros(2), np.array([1.0, 3.0])
    fill(*cells([([0, 0], [1, 3])]), low, high)
    fill(*cells([([0, 0], [0.3, 3]), ([0.3, 0], [1, 1]), ([0.3, 1], [1, 3])]), low, high)
    fill(*cells([([0.5], [0.5])]), np.array([0.5]), np.array([0.5]))
    fill(*cells([([-0.0, 0.5], [1, 0.5])]), np.array([0.0, 0.5]), np.array([1.0, 0.5]))


@pytest.mark.parametrize(
    "rows",
    [
        [([0, 0], [1, 1.5])],
        [([0, 0], [0.5, 3]), ([np.nextafter(0.5, 1), 0], [1, 3])],
        [([0, 0], [np.nextafter(0.5, 1), 3]), ([0.5, 0], [1, 3])],
        [([0, 0], [1, 3]), ([0, 0], [1, 3])],
        [([0, 0], [1, 3]), ([0.2, 0], [0.2, 3])],
        [([0, 0], [1, 4])],
        [([0, 0], [1, np.nan])],
        [([0, 0], [np.inf, 3])],
        [([1, 3], [0, 0])],
        [([0, 0], [0, 3]), ([1, 0], [1, 3])],
        [([0], [1])],
    ],
    ids=[
        "half",
        "a hole",
        "an overlap",
        "twice",
        "flat inside",
        "outside",
        "nan",
        "infinite",
        "turned",
        "flat only",
        "narrow",
    ],
)
def test_holes_and_overlaps_are_refused(rows):
    with pytest.raises(Broken):
        fill(*cells(rows), np.zeros(2), np.array([1.0, 3.0]))


def test_a_point_is_one_cell_and_so_many_cells_are_not_told_apart(monkeypatch):
    point = np.array([0.5, 2.0])
    with pytest.raises(Broken):
        fill(*cells([([0.5, 2.0], [0.5, 2.0])] * 2), point, point)
    with pytest.raises(Broken):
        fill(np.zeros((0, 2)), np.zeros((0, 2)), point, point)
    line = cells([([0.5, k], [0.5, k + 1]) for k in range(6)])
    plane = cells([([0, k], [1, k + 1]) for k in range(6)])
    monkeypatch.setattr(subdivision, "MAX_CELLS", 5)
    fill(*line, np.array([0.5, 0.0]), np.array([0.5, 6.0]))  # in order, a line of cells is as long as it likes
    with pytest.raises(Unchecked):
        fill(*plane, np.array([0.0, 0.0]), np.array([1.0, 6.0]))
    monkeypatch.setattr(subdivision, "MAX_CELLS", 6)
    fill(*plane, np.array([0.0, 0.0]), np.array([1.0, 6.0]))


def test_a_cell_that_hides_in_a_longer_one_is_an_overlap_where_its_neighbour_ends_elsewhere():
    for rows in ([([0], [2]), ([0], [1])], [([0], [1]), ([1], [2]), ([0], [2])], [([0], [1]), ([0.5], [1.5])]):
        with pytest.raises(Broken, match="overlap"):
            fill(*cells(rows), np.zeros(1), np.array([2.0]))
    with pytest.raises(Broken, match="a share"):
        fill(*cells([([0], [1])]), np.zeros(1), np.array([2.0]))
