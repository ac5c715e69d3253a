"""Guards sip/proof/branch_and_bound: the largest value of functions whose maximum is known by hand is found between its
two sides, as close as was asked for; and how a search ends before that."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, Enclosure, Separation
from sparserob_core.sip.proof.branch_and_bound import (
    ADVICE,
    MORE,
    NoViolation,
    Within,
    _climb,
    _probe,
    more,
    prove_family,
    supremum,
)

Q = np.array([[4.0, 1.0], [1.0, 2.0]])
PEAK = np.array([0.37, -0.61])


def bowl(height: float, peak: Array = PEAK, second: float = -9.0, **more: Any) -> ConstraintFamily:
    """``height - (z - p)' Q (z - p)`` on ``[-1, 1]^2``, and a second row that is ``second`` everywhere. The bound of a
    cell is that of the tangent at its centre, as the function is concave."""

    def values(z: Array) -> Array:
        return height - np.einsum("ki,ij,kj->k", z - peak, Q, z - peak)

    def enclosure(x: Array, lower: Array, upper: Array) -> Enclosure:
        centre, radius = (lower + upper) / 2, (upper - lower) / 2
        slope = np.abs(2.0 * (centre - peak) @ Q)
        bound = values(centre) + (slope * radius).sum(axis=1)
        return Enclosure(np.maximum(bound, second), radius.argmax(axis=1))

    def rows(z: Array) -> tuple[Array, Array]:
        both = np.stack([values(z), np.full(len(z), second)], axis=1)
        return np.zeros((len(z), 2, 1)), -both

    return ConstraintFamily(
        name="bowl", index_set=Box([-1.0, -1.0], [1.0, 1.0]), rows=rows, enclosure=enclosure, **more
    )


X = np.zeros(1)


@pytest.mark.parametrize("height", [2.0, -0.5, 0.0])
@pytest.mark.parametrize("tolerance", [1e-1, 1e-4])
def test_a_supremum_is_between_its_sides_and_as_close_as_was_asked(height: float, tolerance: float) -> None:
    found = supremum(bowl(height), X, tolerance, least=0.3)
    allowed = tolerance * max(abs(height), 0.3)
    assert found.lower <= height + 1e-15 and height <= found.upper
    assert found.upper - found.lower <= allowed * 1.01
    assert found.reason == "" and found.row == 0
    value = -bowl(height).rows(found.index[None])[1][0, 0]
    assert value == pytest.approx(found.lower, abs=1e-15)
    lower, upper, bounds = found.leaves
    assert found.upper == max(bounds.max(), found.lower)
    assert (upper - lower).prod(axis=1).sum() == pytest.approx(4.0)  # they fill the square
    centres = (lower + upper) / 2
    assert (-bowl(height).rows(centres)[1].max(axis=1) <= bounds).all()
    keys = [tuple(one) for one in np.hstack([lower, upper])]
    assert keys == sorted(keys)
    assert found.cells >= len(lower)


def test_a_supremum_in_a_corner_or_on_another_row_is_found_there() -> None:
    corner = supremum(bowl(1.0, np.array([1.5, 0.0])), X, 1e-3)
    truth = max(
        1.0 - (np.array([1.0, y]) - [1.5, 0.0]) @ Q @ (np.array([1.0, y]) - [1.5, 0.0])
        for y in np.linspace(-1, 1, 4001)
    )
    assert corner.lower <= truth + 1e-9 and truth <= corner.upper + 1e-9 and corner.upper - corner.lower <= 1e-3
    flat = supremum(bowl(1.0, second=1.4), X, 1e-3)
    assert (flat.lower, flat.row) == (1.4, 1) and flat.upper == pytest.approx(1.4)


def test_a_supremum_that_is_given_up_holds_between_wider_sides_and_says_why() -> None:
    few = supremum(bowl(2.0), X, 1e-6, cells=40)
    assert few.lower <= 2.0 <= few.upper and few.upper - few.lower > 2e-6
    assert "cells were left" in few.reason and few.reason.endswith(ADVICE) and few.cells <= 40
    assert (few.leaves[1] - few.leaves[0]).prod(axis=1).sum() == pytest.approx(4.0)
    late = supremum(bowl(2.0), X, 1e-6, deadline=Deadline(0.0))
    assert late.lower <= 2.0 <= late.upper and f"there was no time to halve it; {MORE}" in late.reason
    with_advice = bowl(2.0, hindrance=lambda lower, upper: "a finer grid would help")
    assert supremum(with_advice, X, 1e-6, cells=40).reason.endswith("; a finer grid would help")


def test_what_is_asked_decides_when_a_cell_is_closed_and_when_a_search_ends() -> None:
    assert (Within(0.1, 2.0).closes(-5.0), Within(0.1, 2.0).closes(1.0)) == (-4.5, 1.2)
    assert not Within(0.1, 2.0).ends(np.inf)
    assert NoViolation().closes(7.0) == TOLERANCE
    assert [NoViolation().ends(best) for best in (-1.0, TOLERANCE, 2 * TOLERANCE)] == [False, False, True]


@pytest.mark.parametrize("seed", range(4))
def test_a_climb_ends_on_the_peak_of_a_cell_and_within_the_set(seed: int) -> None:
    rng = np.random.default_rng(seed)
    peak = rng.uniform(-0.9, 0.9, 2)
    made = bowl(0.5, peak)
    lower, upper = peak - rng.uniform(0.05, 0.3, 2), peak + rng.uniform(0.05, 0.3, 2)
    value, index, row = _climb(made, X, lower, upper)
    assert row == 0 and value == pytest.approx(0.5, abs=1e-3) and index == pytest.approx(peak, abs=2e-2)
    # towards a corner of the set, far from the cell
    value, index, row = _climb(bowl(0.5, np.array([2.0, 2.0]), -99.0), X, np.array([-0.2, -0.2]), np.array([0.2, 0.2]))
    assert index.tolist() == [1.0, 1.0] and value == pytest.approx(0.5 - np.ones(2) @ Q @ np.ones(2))
    value, _, row = _climb(bowl(0.5, second=3.0), X, lower, upper)
    assert (value, row) == (3.0, 1)


def test_a_probe_is_the_largest_value_at_centres_of_the_worst_cells() -> None:
    made = bowl(0.5)
    ends = np.linspace(-1.0, 1.0, 9)
    lower = np.array(list(product(ends[:-1], ends[:-1])))
    centres = lower + 0.125
    values = -made.rows(centres)[1][:, 0]
    found = _probe(made, X, lower, lower + 0.25, values)
    assert found == (values.max(), pytest.approx(centres[values.argmax()]), 0)
    best = np.argsort(-values)
    found = _probe(made, X, lower, lower + 0.25, -values)  # the worst bounds are elsewhere
    assert found[0] == values[best[-16:]].max()


def test_what_a_climb_finds_refutes_what_centres_do_not_see() -> None:
    """A narrow peak that is violated by little, off every centre."""
    found = prove_family(bowl(3e-9, np.array([0.3141, 0.2718])), X)
    assert found.verdict == "refuted" and TOLERANCE < found.violation <= 3e-9
    assert found.index == pytest.approx([0.3141, 0.2718], abs=1e-4)
    assert np.isinf(found.bound) and found.leaves is None
    safe = prove_family(bowl(-1e-3), X)
    assert safe.verdict == "proven" and safe.bound <= TOLERANCE
    lower, upper = safe.leaves
    assert (upper - lower).prod(axis=1).sum() == pytest.approx(4.0)


def test_a_search_that_is_interrupted_has_begun_only_and_says_so() -> None:
    def interrupted(x: Array, lower: Array, upper: Array) -> Enclosure:
        raise KeyboardInterrupt

    deadline = Deadline()
    found = prove_family(replace(bowl(1.0), enclosure=interrupted), X, deadline=deadline)
    assert found.verdict == "undecided" and found.reason == "bowl: its proof had begun only; more time would help"
    assert deadline.passed
    limited = Deadline(1000.0)
    assert more(limited) == MORE
    assert more(Deadline()) == "more time would help"


def test_peaks_of_a_separation_are_where_a_witness_is_taken_from() -> None:
    """A family with one coordinate, whose enclosure knows how it falls with the width."""
    height = 2e-9

    def enclosure(x: Array, lower: Array, upper: Array) -> Enclosure:
        centre, radius = ((lower + upper) / 2)[:, 0], ((upper - lower) / 2)[:, 0]
        bend = 8.0 * radius**2 / 2
        top = height - 4.0 * (np.clip(0.3, lower[:, 0], upper[:, 0]) - 0.3) ** 2
        return Enclosure(top + bend, np.zeros(centre.size, dtype=int), bend)

    def separation(x: Array) -> Separation:
        return Separation(np.array([[0.3]]), np.array([0]), np.array([height]))

    def rows(t: Array) -> tuple[Array, Array]:
        return np.zeros((len(t), 1, 1)), (4.0 * (t - 0.3) ** 2 - height)

    made = ConstraintFamily(name="peak", index_set=Box([0.0], [1.0]), rows=rows, enclosure=enclosure, worst=separation)
    found = prove_family(made, X)
    assert (found.verdict, found.violation, found.index.tolist(), found.row) == ("refuted", height, [0.3], 0)
    height = -1e-6
    found = prove_family(made, X)
    assert found.verdict == "proven" and found.violation == height and found.index.tolist() == [0.3]
