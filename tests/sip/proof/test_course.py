"""Guards sip/proof/branch_and_bound: what a proof that does not come says of itself, and how cells are cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, Enclosure, Separation
from sparserob_core.sip.proof import branch_and_bound
from sparserob_core.sip.proof.branch_and_bound import (
    Course,
    _divide_towards_peaks,
    _halve_cells,
    _is_stalled,
    prove_family,
    supremum,
)


def family(bounds, violation=-1.0, **more):
    """On [0, 8], with enclosures by ``bounds(lower, upper)`` and the same violation at every index."""

    def enclosure(x, lower, upper):
        return Enclosure(bounds(lower[:, 0], upper[:, 0]), np.zeros(len(lower), dtype=int))

    return ConstraintFamily(
        name="wall",
        index_set=sr.Box([0.0], [8.0]),
        enclosure=enclosure,
        rows=lambda t: (np.zeros((len(t), 1, 1)), np.full((len(t), 1), -violation)),
        **more,
    )


def cells(*ends):
    return np.array(ends[:-1], dtype=float)[:, None], np.array(ends[1:], dtype=float)[:, None]


def test_what_is_left_open_is_told_by_the_worst_cell():
    told = []
    made = family(lambda a, b: np.where(a < 4.0, 0.5, np.where(a < 6.0, 3.0, -1.0)), cells=cells(0, 4, 6, 8))
    found = prove_family(made, np.zeros(1), told.append, cells=4)
    assert (found.verdict, found.bound, found.cells) == ("undecided", 3.0, 3)
    assert "2 of 3 cells" in found.reason and "from [4.] to [6.]" in found.reason and "3.0e+00" in found.reason
    assert [(one.cells, one.bound, one.examined, one.budget) for one in told] == [(2, 3.0, 3, 4)]
    assert np.isnan(told[0].bound_before)


@pytest.mark.parametrize(
    ("open_", "said"),
    [
        ([(1, 2), (2, 4), (3, 3.5), (6, 7)], "open along 4 of 8, from 1 to 7"),
        ([(0, 8)], "open along 8 of 8, from 0 to 8"),
        ([(5, 5)], "open along 0 of 8, from 5 to 5"),
    ],
)
def test_what_is_left_open_is_told_by_how_long_the_wall_is_ridden(open_, said):
    course = Course(family(lambda a, b: a), lambda event: None, 10, Deadline())
    lower, upper = (np.array(ends, dtype=float)[:, None] for ends in zip(*open_[::-1], strict=True))
    course.opened(lower, upper)
    assert course.along == said


def test_how_long_a_wall_is_ridden_is_said_in_the_unit_of_the_user():
    made = family(lambda a, b: np.where(a < 4.0, 3.0, -1.0), cells=cells(0, 4, 8), index_units=np.array([2.0]))
    assert "open along 8 of 16, from 0 to 8" in prove_family(made, np.zeros(1), cells=1).reason


def test_a_proof_is_as_good_as_its_worst_closed_cell():
    made = family(lambda a, b: np.where(a < 4.0, -0.5, np.where(a < 6.0, TOLERANCE, -2.0)), cells=cells(0, 4, 6, 8))
    found = prove_family(made, np.zeros(1))
    assert (found.verdict, found.bound, found.violation) == ("proven", TOLERANCE, -1.0)
    lower, upper = found.leaves
    assert lower.ravel().tolist() == [0.0, 4.0, 6.0]
    assert upper.ravel().tolist() == [4.0, 6.0, 8.0]


@pytest.mark.parametrize(
    ("violation", "bound", "verdict"),
    [
        (5e-9, np.inf, "refuted"),
        (1.01 * TOLERANCE, np.inf, "refuted"),
        (0.99 * TOLERANCE, TOLERANCE, "proven"),
        (0.0, 5e-9, "undecided"),
        (-1.0, 0.0, "proven"),
        (-1.0, np.nan, "undecided"),
    ],
)
def test_a_separation_is_believed_where_it_bounds_and_no_further(violation, bound, verdict):
    separation = Separation(np.array([[2.0]]), np.array([0]), np.array([violation]), bound)
    made = replace(family(lambda a, b: a), enclosure=None, worst=lambda x: separation)
    found = prove_family(made, np.zeros(1))
    assert (found.verdict, found.violation, found.row) == (verdict, violation, 0)
    assert found.index.tolist() == [2.0]
    assert found.bound == np.inf if verdict == "refuted" else found.bound is bound
    nothing = Separation(np.zeros((0, 1)), np.zeros(0, dtype=int), np.zeros(0), -1.0)
    assert prove_family(replace(made, worst=lambda x: nothing), np.zeros(1)).verdict == "proven"


def test_a_violation_of_a_cells_middle_is_a_refutation_with_its_place():
    def rows(t):
        return np.zeros((len(t), 2, 1)), np.stack([np.ones(len(t)), np.abs(t[:, 0] - 5.0) - 1e-8], axis=1)

    made = replace(family(lambda a, b: np.full(a.size, 1.0), cells=cells(0, 4, 6, 8)), rows=rows)
    found = prove_family(made, np.zeros(1))
    assert (found.verdict, found.row, found.index.tolist()) == ("refuted", 1, [5.0])
    assert found.violation == pytest.approx(1e-8)


def test_progress_knows_what_the_bound_was_half_a_minute_ago(monkeypatch):
    clock, told = [100.0], []
    monkeypatch.setattr(branch_and_bound.time, "perf_counter", lambda: clock[0])
    made = family(lambda a, b: a, row_units=np.array([2.0, 10.0]))
    course = Course(made, told.append, 1000, branch_and_bound.Deadline(), started=100.0, told=100.0)
    for seconds, bound in ((0.0, 5.0), (20.0, 4.0), (29.0, 3.0), (31.0, 2.99), (55.0, 2.98), (62.0, 2.97)):
        clock[0] = 100.0 + seconds
        course.tell(7, bound, np.array([1.0]), np.array([2.0]), pending=3)
    assert [one.bound_before for one in told] == pytest.approx([np.nan] * 3 + [5.0, 4.0, 2.99], nan_ok=True)
    assert [bool(one.hindrance) for one in told] == [False] * 5 + [True]
    assert "3.0e+01" in told[-1].hindrance  # in the unit of the row that has the largest
    assert told[-1].seconds == pytest.approx(62.0)
    assert told[-1].examined == 3


def test_rounding_is_at_rest_and_what_still_falls_is_not():
    falling = [1e-6 * 0.9**k for k in range(20)]
    assert not _is_stalled(falling)
    assert _is_stalled([1e-6] * 20)
    assert not _is_stalled([1e-6] * 16)
    assert _is_stalled([1e-6] * 17)
    assert not _is_stalled([1e-4] * 20)
    assert not _is_stalled([1.0] * 11 + [1e-6] * 8)


def test_a_proof_ends_where_what_is_left_at_the_ends_of_a_cell_is_rounding() -> None:
    """A peak of 0 at 0.5, of which 2e-9 are not known however short a cell is."""

    def enclosure(x, lower, upper):
        near = np.minimum(np.abs(lower[:, 0] - 0.5), np.abs(upper[:, 0] - 0.5))
        bend = (upper - lower)[:, 0] ** 2
        return Enclosure(bend - near**2 / 4.0 + rounded, np.zeros(near.size, dtype=int), bend)

    for rounded, verdict, most in ((2e-9, "undecided", 200), (1e-10, "proven", 4000), (-1e-12, "proven", 4000)):
        made = replace(family(lambda a, b: a), enclosure=enclosure, worst=None, index_set=sr.Box([0.0], [1.0]))
        made = replace(made, rows=lambda t: (np.zeros((len(t), 1, 1)), (t - 0.5) ** 2 / 4.0))
        found = prove_family(made, np.zeros(1))
        assert found.verdict == verdict and found.cells <= most, (rounded, found)


def test_halves_cover_their_cell_and_cells_without_a_middle_have_none():
    lower, upper = np.array([[0.0, 0.0], [1.0, 5.0]]), np.array([[2.0, 1.0], [3.0, 9.0]])
    low, high = _halve_cells(lower, upper, np.array([0, 1]))
    assert low.tolist() == [[0.0, 0.0], [1.0, 5.0], [1.0, 0.0], [1.0, 7.0]]
    assert high.tolist() == [[1.0, 1.0], [3.0, 7.0], [2.0, 1.0], [3.0, 9.0]]
    thin = np.array([[1.0]])
    assert _halve_cells(thin, np.nextafter(thin, 2.0), np.array([0])) is None
    assert _halve_cells(thin, thin, np.array([0])) is None


def test_cells_that_are_cut_towards_a_peak_fill_what_they_were_and_are_short_where_it_is():
    lower, upper = cells(0, 2, 4, 8)
    peaks = Separation(np.array([[3.1]]), np.array([0]), np.array([-1e-10]), np.inf)
    bend = np.array([0.5, 0.5, 2.0])
    low, high = (ends.ravel() for ends in _divide_towards_peaks(peaks, lower, upper, bend - 0.1, bend))
    assert low[0] == 0.0 and high[-1] == 8.0
    assert (np.sort(low)[1:] == np.sort(high)[:-1]).all()
    assert (low < high).all()
    # a part beside the peak adds no more than what may be added there: its bend falls with the square of its length
    at = int(np.flatnonzero((low <= 3.1) & (high >= 3.1))[0])
    assert 0.5 * ((high[at] - low[at]) / 2.0) ** 2 <= 1.2 * TOLERANCE
    assert np.diff(np.sort(low)).max() <= 4.0
    assert _divide_towards_peaks(branch_and_bound._NOWHERE, lower, upper, bend, bend) is None
    # far from every peak, or without any bend, halves are enough: those are for others to make
    far = Separation(np.array([[3.1]]), np.array([0]), np.array([-1.0]), np.inf)
    assert _divide_towards_peaks(far, lower[:1], upper[:1], bend[:1], 1e-30 * bend[:1]) is None


@pytest.mark.parametrize("ratio", [4.0, 9.0, 64.0])
def test_every_part_towards_a_smooth_peak_is_closed_by_its_bound_and_there_are_few(ratio):
    """The violation is ``top - c (s - a)^2 / 2``; a cell is bounded by the larger of its ends and its length squared
    times an eighth of ``ratio c``, as chords and bounds of second derivatives do."""
    rng, most = np.random.default_rng(int(ratio)), 0
    for _ in range(60):
        low, width, c = rng.uniform(-2.0, 2.0), 2.0 ** rng.uniform(-3.0, 3.0), 10.0 ** rng.uniform(-2.0, 2.0)
        high = low + width
        place = rng.uniform(0.2, 0.8) if ratio > 10.0 else rng.choice([rng.uniform(), 0.01, 0.99])
        at, top = low + width * place, float(rng.choice([TOLERANCE, 0.0, -1e-7]))

        def bounds(a, b, at=at, top=top, c=c):
            ends = np.maximum(*(top - c * (s - at) ** 2 / 2.0 for s in (a, b)))
            return ends + ratio * c * (b - a) ** 2 / 8.0

        bend = np.array([ratio * c * width**2 / 8.0])
        peaks = Separation(np.array([[at]]), np.array([0]), np.array([top]), np.inf)
        parts = _divide_towards_peaks(
            peaks, np.array([[low]]), np.array([[high]]), bounds(np.array([low]), np.array([high])), bend
        )
        assert parts is not None
        a, b = (ends.ravel() for ends in parts)
        allowed = max(
            TOLERANCE, top + TOLERANCE / 16.0
        )  # a peak as high as is allowed is cut down to a sixteenth of it
        assert (bounds(a, b) <= allowed * (1.0 + 1e-9)).all()
        grow = 0.5 if min(at - low, high - at) <= width / 8 else 2.0 * 0.8 / np.sqrt(ratio)
        short = 0.8 / 2.0 * width * np.sqrt(max(TOLERANCE - top, TOLERANCE / 16.0) / bend[0])
        sides = [np.log(max(side / short, 1.0)) / np.log1p(grow) for side in (at - low, high - at)]
        most = max(most, a.size - sum(sides))
    assert most <= 4.0


def test_a_family_without_an_enclosure_has_no_supremum():
    made = replace(family(lambda a, b: a), enclosure=None)
    with pytest.raises(NotEnclosable, match="wall offers no enclosure"):
        supremum(made, np.zeros(1), 0.1)


def test_batches_that_take_long_are_told_of_every_second(monkeypatch):
    """A bound takes 0.7 s: the first batch is told of with the second one, and so on."""
    clock, told = [0.0], []
    monkeypatch.setattr(branch_and_bound.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(branch_and_bound, "BATCH", 2)

    def slow(a, b):
        clock[0] += 0.7
        return -a

    course = Course(family(slow), told.append, 1000, Deadline(), started=0.0, told=0.0)
    lower, upper = cells(*np.linspace(0.0, 8.0, 11))
    bounds, _, bend = branch_and_bound._bound_cells(course, np.zeros(1), lower, upper)
    assert bounds.tolist() == (-lower.ravel()).tolist() and bend is None
    assert [(one.examined, one.bound, one.cells) for one in told] == [(4, 0.0, 10), (8, 0.0, 10)]
