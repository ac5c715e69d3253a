"""Guards control/response/reference: what moves along straight lines, and what a control adds by itself, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.response.reference import Direct, MovingReference, Reference
from tests.support.plants import indicators

ROWS = [[0.5, 0.0, 1.0], [1.0, 2.0, 1.0], [2.0, 0.0, -3.0]]


def test_a_reference_is_linear_between_its_points_and_stands_still_beyond() -> None:
    made = Reference.of(ROWS)
    assert made.moves and not Reference.of(None).moves
    times = np.array([0.0, 0.5, 0.75, 1.0, 1.25, 2.0, 3.0])
    assert made.at(times) == pytest.approx(np.array([[0, 1], [0, 1], [1, 1], [2, 1], [1.5, 0], [0, -3], [0, -3]]))
    # from the left at a kink, from the right at the start of a window
    still, rising, falling = [0.0, 0.0], [4.0, 0.0], [-2.0, -4.0]
    assert made.slope(times, -1.0).tolist() == [still, still, rising, rising, falling, falling, still]
    assert made.slope(times, 0.5).tolist() == [still, rising, rising, rising, falling, falling, still]
    assert made.slope(np.array([1.0]), 1.0).tolist() == [falling] and made.slope(np.array([2.0]), 2.0).tolist() == [
        still
    ]
    assert made.kinks(0.5, 2.0).tolist() == [1.0] and made.kinks(0.4, 2.1).tolist() == [0.5, 1.0, 2.0]
    assert made.size.tolist() == [2.0, 3.0]
    alone = Reference(np.array([1.0]), np.array([[4.0, -5.0]]))
    assert alone.slope(times, 0.0).tolist() == [still] * 7 and alone.at(times).tolist() == [[4.0, -5.0]] * 7


def test_what_moves_is_taken_off_a_row() -> None:
    H = np.array([[1.0, -1.0], [0.0, 2.0], [-3.0, 0.5]])
    made = MovingReference(
        Reference(*(part for part in (np.array([0.0, 2.0]), np.array([[1.0, 2.0], [3.0, -2.0]])))), H
    )
    assert made.at(np.array([0.0, 1.0])) == pytest.approx(-np.array([[-1.0, 4.0, -2.0], [2.0, 0.0, -6.0]]))
    assert made.size.tolist() == [3.0 + 2.0, 4.0, 9.0 + 1.0]


def test_what_a_control_adds_by_itself_is_that_of_the_piece_of_a_cell() -> None:
    G, control = np.array([[1.0, 0.5], [-2.0, 0.0]]), np.array([[1.0, -3.0, 2.0], [4.0, 0.0, -1.0]])
    made = Direct(G, indicators([0.0, 0.5, 1.5, 2.0]), control)
    found = made.on(np.array([0.0, 0.5, 1.0, 1.5, 0.5]), np.array([0.5, 0.75, 1.5, 2.0, 0.5]))
    every = (G @ control).T
    assert found == pytest.approx(every[[0, 1, 1, 2, 0]])
    assert made.size.tolist() == [3.0, 6.0]
