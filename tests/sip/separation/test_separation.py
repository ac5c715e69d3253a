"""Guards sip/separation/separation: the generic separation finds the maxima that its grid brackets, several of them,
exactly; and claims nothing that it has not proven."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sparserob_core as sr
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.method import Tools
from sparserob_core.sip.separation.separation import KEPT_PER_ROW, separate
from sparserob_core.sip.solver import Auto

DECISION = np.array([1.0])


def family(violation, lower, upper):
    """A family whose violation at the decision is the given function of the indices."""

    def rows(indices):
        values = np.asarray(violation(indices), dtype=float).reshape(len(indices), -1)
        return values[:, :, np.newaxis], np.zeros_like(values)

    return sr.ConstraintFamily(name="made up", index_set=sr.Box(lower, upper), rows=rows)


def tools(maximiser=None, budget=0):
    return Tools(solver=Auto(), maximiser=maximiser, budget=budget)


def search_worst(made_up, x, given):
    ((_, found),) = separate(sr.SemiInfiniteProgram(n=x.size, families=[made_up]), x, given)
    return found


def worst(violation, lower, upper, maximiser=None, budget=0):
    return search_worst(family(violation, lower, upper), DECISION, tools(maximiser, budget))


HOLDER = 19.208502567886747


def holder(t):
    return np.abs(np.sin(t[:, 0]) * np.cos(t[:, 1]) * np.exp(np.abs(1 - np.hypot(t[:, 0], t[:, 1]) / np.pi)))


@pytest.mark.parametrize(
    ("violation", "lower", "upper", "maximum"),
    [
        (lambda t: -((t[:, 0] - 0.3217) ** 2), [0.0], [1.0], 0.0),
        (lambda t: -((t[:, 0] - 0.3217) ** 4), [0.0], [1.0], 0.0),
        (lambda t: -np.abs(t[:, 0] - 0.3217), [0.0], [1.0], 0.0),
        (lambda t: -np.where(t[:, 0] < 0.3217, 30 * (0.3217 - t[:, 0]), 0.1 * (t[:, 0] - 0.3217)), [0.0], [1.0], 0.0),
        (lambda t: -np.sqrt(np.abs(t[:, 0] - 0.25)), [0.0], [1.0], 0.0),
        (lambda t: np.exp(t[:, 0]), [-0.1], [0.3], np.exp(0.3)),
        (lambda t: np.exp(-t[:, 0]), [-0.1], [0.3], np.exp(0.1)),
        (lambda t: -(100 * (t[:, 1] - t[:, 0] ** 2) ** 2 + (1 - t[:, 0]) ** 2), [-2.0, -2.0], [2.0, 2.0], 0.0),
        (lambda t: -np.abs(t[:, 0] - 0.3217) - np.abs(t[:, 1] + t[:, 0] - 0.777), [0.0, 0.0], [1.0, 1.0], 0.0),
        (holder, [-10.0, -10.0], [10.0, 10.0], HOLDER),
        (lambda t: t[:, 0] - (t[:, 1] - 0.123) ** 2 - (t[:, 0] - t[:, 2]) ** 2, [0.0] * 3, [0.7] * 3, 0.7),
        (lambda t: -((t - 0.123) ** 2 @ [1.0, 10.0, 100.0, 1000.0]), [-1.0] * 4, [1.0] * 4, 0.0),
        (lambda t: -((t - 0.123) ** 2).sum(axis=1), [-1.0] * 6, [1.0] * 6, 0.0),
        (lambda t: -((t[:, 0] - 0.3) ** 2) - (t[:, 1] - 0.2) ** 2, [0.0, 0.5], [1.0, 0.5], -0.09),
        (lambda t: np.full(len(t), -2.0), [0.0], [1.0], -2.0),
    ],
)
def test_the_maximum_is_found_to_twelve_digits(violation, lower, upper, maximum):
    found = worst(violation, lower, upper)
    assert abs(found.violations[0] - maximum) <= 1e-12 * max(1.0, abs(maximum))
    assert (found.indices >= lower).all()
    assert (found.indices <= upper).all()


@given(st.floats(0.02, 0.98), st.floats(0.005, 1.0), st.integers(1, 3))
def test_a_maximum_is_found_wherever_it_is_and_the_violation_is_that_of_the_index(centre, width, power):
    def violation(t):
        return np.exp(-(np.abs((t[:, 0] - centre) / width) ** power))

    found = worst(violation, [0.0], [1.0])
    assert abs(found.violations[0] - 1.0) <= 1e-10
    np.testing.assert_array_equal(found.violations, violation(found.indices))


def test_a_narrow_interior_maximum_is_not_missed():
    found = worst(
        lambda t: -np.abs(np.sin(7 * t[:, 0])) + 2 * np.maximum(0, 1 - np.abs(t[:, 0] - 0.51234) / 0.004), [0.0], [1.0]
    )
    assert abs(found.indices[0, 0] - 0.51234) <= 1e-12


def test_the_lower_of_two_grid_maxima_may_be_the_higher_peak():
    spacing = 1 / 256
    high, low = 64.5 * spacing, 128 * spacing
    found = worst(
        lambda t: np.maximum(1.1 - np.abs(t[:, 0] - high) / spacing, 0.9 - np.abs(t[:, 0] - low) / spacing),
        [0.0],
        [1.0],
    )
    assert abs(found.violations[0] - 1.1) <= 1e-12


def test_several_maxima_of_every_row_are_returned_worst_first_and_each_once():
    found = worst(
        lambda t: np.stack([np.sin(40 * t[:, 0]), np.cos(20 * t[:, 0]) - 0.5, t[:, 0] - 5], axis=1), [0.0], [1.0]
    )
    assert (np.diff(found.violations) <= 0).all()
    assert np.bincount(found.rows.astype(int)).tolist() == [7, 4, 1]
    for row in range(2):
        inside = found.indices[found.rows == row, 0]
        assert (np.diff(np.sort(inside)) > 0.05).all()


def test_no_more_than_the_promised_number_of_maxima_per_row_is_returned():
    found = worst(lambda t: np.sin(400 * t[:, 0]), [0.0], [1.0])
    assert len(found.rows) == KEPT_PER_ROW


def test_a_maximum_at_the_end_of_the_index_set_is_met_exactly():
    for lower, upper in ((0.1, 0.3), (-1 / 3, 1e-7), (1e6, 1e6 + 0.7)):
        assert worst(lambda t: t[:, 0], [lower], [upper]).indices[0, 0] == upper
        assert worst(lambda t: -t[:, 0], [lower], [upper]).indices[0, 0] == lower


def test_a_search_proves_nothing_except_on_a_single_index():
    assert worst(lambda t: t[:, 0], [0.0], [1.0]).bound == np.inf
    assert worst(lambda t: np.stack([t[:, 0], t[:, 0] - 1], axis=1), [0.5], [0.5]).bound == 0.5


class Recording(Maximiser):
    """Evaluates one index, and claims a bound."""

    def __init__(self, index, bound=np.inf):
        self.index, self.bound, self.calls = index, bound, 0

    def search(self, objective, rng):
        self.calls += 1
        objective.evaluate(np.array([self.index]))
        return self.bound


def test_the_maximiser_is_asked_only_when_the_grid_found_no_violation():
    idle, needed = Recording([0.5]), Recording([0.5])
    worst(lambda t: t[:, 0], [0.0], [1.0], idle, 10)
    worst(lambda t: t[:, 0] - 1, [0.0], [1.0], needed, 10)
    assert (idle.calls, needed.calls) == (0, 1)


def test_what_the_maximiser_finds_between_the_grid_points_is_refined_and_its_bound_kept():
    peak = 0.3956789

    def spike(t):
        return np.maximum(-1.0, 1.0 - np.abs(t[:, 0] - peak) / 1e-5)

    assert worst(spike, [0.0], [1.0]).violations[0] == -1.0
    found = worst(spike, [0.0], [1.0], Recording([peak + 7e-6], bound=3.0), 10)
    assert abs(found.indices[0, 0] - peak) <= 1e-13
    assert found.bound == 3.0


def test_an_interrupt_during_the_search_is_passed_on():
    class Interrupted(Maximiser):
        def search(self, objective, rng):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        worst(lambda t: t[:, 0] - 1, [0.0], [1.0], Interrupted(), 10)


def test_a_row_that_is_no_number_is_an_error_that_names_family_and_index():
    with pytest.raises(sr.InputError, match=r"family 'made up': its rows are not numbers at the index \[0\.0\]"):
        worst(lambda t: np.where(t[:, 0] > 0, t[:, 0], np.nan), [0.0], [1.0])


def test_an_unbounded_index_set_is_an_error():
    with pytest.raises(sr.InputError, match="bounded index set"):
        worst(lambda t: -t[:, 0], [0.0], [np.inf])


def test_a_polynomial_family_on_the_unit_interval_is_separated_in_a_few_milliseconds():
    powers = np.arange(5)
    sine = sr.ConstraintFamily(
        name="above", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (-(t**powers)[:, np.newaxis], -np.tan(t))
    )
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        search_worst(sine, np.array([0.0, 1.1, -0.3, 0.6, 0.1]), tools())
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < 0.02


def test_a_decision_gets_as_many_cuts_of_a_row_as_it_has_variables():
    rows = sr.ConstraintFamily(
        name="waves",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (np.sin(100 * t)[:, :, np.newaxis] * np.eye(20)[0], np.zeros((len(t), 1))),
    )
    found = search_worst(rows, np.eye(20)[0], tools())
    tops = (np.pi / 2 + 2 * np.pi * np.arange(16)) / 100
    np.testing.assert_allclose(np.sort(found.indices[found.violations > 0.99, 0]), tops, atol=1e-7)


def test_the_highest_of_forty_peaks_of_about_one_height_is_found_though_others_are_higher_on_the_grid():
    tops = (np.arange(40) + 0.5) / 40
    heights = np.full(40, 1.0)
    heights[np.abs(tops * 256 - np.round(tops * 256)).argmax()] += 1e-4

    def peaks(t):
        nearest = np.minimum((t[:, 0] * 40).astype(int), 39)
        return heights[nearest] - 1 - (40 * (t[:, 0] - tops[nearest])) ** 2

    found = worst(lambda t: np.where(t[:, 0] < 2, peaks(t), 0.0), [0.0], [1.0])
    assert abs(found.violations[0] - 1e-4) <= 1e-12


def test_peaks_closer_than_the_grid_are_resolved():
    """A Chebyshev polynomial of degree 80 has four maxima in the last 1.5 % of the interval, where the grid has four
    points."""

    def chebyshev(t):
        return np.cos(80 * np.arccos(np.clip(2 * t[:, 0] - 1, -1, 1))) - 1 + 1e-3 * (t[:, 0] > 0.985)

    found = worst(chebyshev, [0.0], [1.0])
    tops = (1 + np.cos(2 * np.pi * np.arange(4) / 80)) / 2
    assert sorted(found.indices[found.violations > 0, 0]) == pytest.approx(sorted(tops), abs=1e-6)


def test_peaks_of_two_coordinates_closer_than_the_grid_are_resolved():
    """At a corner, waves run together that a grid of 33 x 33 points resolves everywhere else."""

    def waves(t):
        return np.cos(34 * t[:, 0] ** 4) + np.cos(34 * t[:, 1] ** 4) - 2 + 1e-3 * (t.min(axis=1) > 0.96)

    found = worst(waves, [0.0, 0.0], [1.0, 1.0])
    top = (2 * np.pi * 5 / 34) ** (1 / 4)
    assert abs(found.violations[0] - 1e-3) <= 1e-12
    np.testing.assert_allclose(found.indices[0], [top, top], atol=1e-6)


class Listed(Maximiser):
    """Evaluates a list of indices, all at once, and then the best one of the list again."""

    def __init__(self, indices):
        self.indices = np.asarray(indices, dtype=float)

    def search(self, objective, rng):
        objective.evaluate(self.indices)
        return np.inf


@pytest.mark.parametrize("dimension", [1, 2])
def test_every_local_maximum_of_what_the_maximiser_evaluated_is_refined(dimension):
    """Two needles that no grid meets: the one that is lower where it is evaluated is the higher one."""
    left, right = np.full(dimension, 0.2012345), np.full(dimension, 0.8012345)

    def needles(t):
        sharp = [height - np.abs(t - at).max(axis=1) / 1e-5 for height, at in ((1.0, left), (2.0, right))]
        return np.maximum(-1.0, np.maximum(*sharp))

    asked = [left + 1e-6, right + 1.5e-5, np.full(dimension, 0.5)]
    assert needles(np.array(asked)).argmax() == 0
    found = worst(needles, np.zeros(dimension), np.ones(dimension), Listed(asked), 3)
    assert abs(found.violations[0] - 2.0) <= 1e-9
    assert abs(found.violations - 1.0).min() <= 1e-9


def test_what_one_family_violates_spares_the_search_of_the_others():
    asked = Recording([0.5])
    violated, kept = family(lambda t: t[:, 0], [0.0], [1.0]), family(lambda t: t[:, 0] - 2, [0.0], [1.0])
    both = [replace(violated, name="violated"), replace(kept, name="kept")]
    separate(sr.SemiInfiniteProgram(n=1, families=both), DECISION, tools(asked, 10))
    assert asked.calls == 0
    separate(sr.SemiInfiniteProgram(n=1, families=both[1:]), DECISION, tools(asked, 10))
    assert asked.calls == 1


def test_all_peaks_are_refined_in_few_batches():
    """A round evaluates in batches: as many calls as levels of the grid and steps of the refinement, however many peaks
    there are."""
    calls = []

    def waves(t):
        calls.append(len(t))
        return np.sin(300 * t[:, 0])

    worst(waves, [0.0], [1.0])
    assert len(calls) <= 40


def search_with(variables, violation, lower, upper):
    """Return what is found for a decision of so many variables, of which the first one alone has coefficients."""
    made_up = family(violation, lower, upper)

    def rows(indices):
        G, h = made_up.rows(indices)
        return np.concatenate([G, np.zeros((*G.shape[:2], variables - 1))], axis=2), h

    return search_worst(replace(made_up, rows=rows), np.eye(variables)[0], tools())


def test_points_around_a_maximum_are_returned_where_there_are_fewer_maxima_than_variables():
    """Along the axes of its curvature, where three quarters of the violation are left; none beyond the index set."""
    turned = np.array([[0.8, 0.6], [-0.6, 0.8]])
    curvature = turned @ np.diag([30.0, 400.0]) @ turned.T
    peak = np.array([1.3, -0.2])

    def violation(s):
        return 0.5 - 0.5 * np.einsum("ki,ij,kj->k", s - peak, curvature, s - peak)

    found = search_with(5, violation, [0.0, -1.0], [2.0, 1.0])
    assert found.violations == pytest.approx([0.5, *[0.375] * 4], rel=1e-3)
    assert np.allclose(found.indices[0], peak, atol=1e-6)
    steps = (found.indices[1:] - found.indices[0]) @ turned
    lengths = 0.5 * np.sqrt(2 * 0.5 / np.array([30.0, 400.0]))
    expected = np.concatenate([np.diag(lengths), -np.diag(lengths)])
    assert all(np.abs(steps - step).max(axis=1).min() <= 1e-3 for step in expected)
    shift = np.array([0.0, 0.8])
    beyond = search_with(5, lambda s: violation(s + shift), [0.0, -1.0], [2.0, 1.0])  # the peak is on a face
    assert (beyond.indices >= [0.0, -1.0]).all() and len(beyond.indices) == 5
    assert beyond.violations == pytest.approx(violation(beyond.indices + shift), abs=1e-12)


def test_maxima_alone_are_returned_where_they_are_as_many_as_variables_or_none_is_violated():
    waves = search_with(3, lambda s: np.cos(2 * np.pi * s[:, 0]), [0.0], [2.0])
    assert np.sort(waves.indices[:, 0]) == pytest.approx([0.0, 1.0, 2.0], abs=1e-9)
    kept = search_with(7, lambda s: np.cos(2 * np.pi * s[:, 0]) - 2.0, [0.0], [2.0])
    assert np.sort(kept.indices[:, 0]) == pytest.approx([0.0, 1.0, 2.0], abs=1e-9)


def test_a_row_that_is_nearly_straight_is_surrounded_within_a_quarter_of_its_box():
    flat = search_with(2, lambda s: 1.0 - 1e-9 * s[:, 0] ** 2, [-1.0], [1.0])
    assert np.sort(flat.indices[:, 0]) == pytest.approx([-0.5, 0.0, 0.5], abs=1e-4)
