"""The generic separation: the most violated indices of a family that offers nothing but its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import EvaluationsFinished, forward_events
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram, Separation

if TYPE_CHECKING:
    from sparserob_core.sip.separation.refinement import Candidates
    from sparserob_core.sip.separation.survey import Survey

# Maxima of a row that are returned at least: the decision has as many that can be active as it has variables. With a
# quarter of them programs of few variables take more rounds; with ten times as many, rows that stay slack are solved.
KEPT_PER_ROW = 8
# Peaks of a row that are refined at least, and of all rows, as long as something violated is found among them. With a
# quarter of them a round passes over half of what it could impose; ten times as many cost more than the rounds saved.
REFINED_PER_ROW, REFINED = 32, 512
# Points of the grid for each index that the maximiser may ask for: they are evaluated at once, its own one by one. With
# a quarter of them the grid is not finer than that of every round; ten times as many cost as much as the maximiser.
POINTS_PER_ASKED = 4
# Of the maxima that are returned, how many are compared, for some are found more than once. With a quarter of them,
# what the maximiser finds again takes the place of others; ten times as many are more pairs than one wants to compare.
MAXIMA_PER_KEPT = 4
SAME_MAXIMUM_DISTANCE = 1e-6
"""Maxima of one row that are closer than this share of the box are one maximum."""
MAX_ARRAY = 2_000_000


def separate(
    program: SemiInfiniteProgram, x: Array, tools: Tools, threshold: float = 1e-9, number: int = 0
) -> list[tuple[ConstraintFamily, Separation]]:
    """Return the most violated indices of every family at ``x (n,)``, worst first.

    A family that knows its own way is asked. Of others the largest local maxima of the violation of every row are
    searched for: as many as the decision has variables, and at least 8. A grid of the index box brackets them (257
    points for one coordinate that moves, 33 x 33, 13^3, 7^4; 2048 random points beyond), and the most promising are
    refined to about 1e-13 in the violation.

    As long as nothing of any family is violated by more than ``threshold``, the search goes on: all others are refined
    that may exceed it, then those of a grid of four times the budget, then the local maxima around the indices for
    which the maximiser asks. So rounds that find cuts are cheap, and the last one is searched hard.

    A search proves nothing: ``bound`` is ``inf`` unless the maximiser proved one, or the index set is a single point.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    x : ndarray, shape (n,)
        The decision.
    tools : Tools
        The maximiser, the budget, the deadline and who is told.
    threshold : float
        The violation above which a search ends.
    number : int
        The round, for events.

    Raises
    ------
    InputError
        If a row is not a number, or an index set is unbounded.
    OutOfTime
        If the deadline of the tools has passed.
    """

    def search(family: ConstraintFamily) -> _ViolationSearch:
        notify = forward_events(
            tools.notify, EvaluationsFinished, lambda event: replace(event, family=family.name, round=number)
        )
        return _ViolationSearch(family, x, replace(tools, notify=notify), threshold)

    answers: dict[str, Separation | _ViolationSearch] = {}
    for family in program.families:
        tools.deadline.check()
        answers[family.name] = search(family) if family.worst is None else family.separated(x)
    searched = [
        answer
        for answer in answers.values()
        if isinstance(answer, _ViolationSearch) and answer.field.family.enclosure is None  # else a proof finds the rest
    ]
    highest = max((float(answer.violations.max(initial=-np.inf)) for answer in answers.values()), default=-np.inf)
    _search_harder(searched, highest)
    separations = ((family, answers[family.name]) for family in program.families)
    return [
        (
            family,
            replace(
                answer.result() if isinstance(answer, _ViolationSearch) else answer, formulation=family.formulation
            ),
        )
        for family, answer in separations
    ]


def _search_harder(searches: Sequence[_ViolationSearch], highest: float) -> None:
    """Search on, by finer grids and then by the maximiser, until one of the searches has found a violation, which is
    ``highest`` so far."""
    for step in (_ViolationSearch.look_closer, _ViolationSearch.ask):
        for search in searches:
            if highest <= search.threshold:
                step(search)
                highest = max(highest, search.highest)


class _ViolationSearch:
    """The search for the largest violations of a family: what is ``found``, by the grid of every round to begin with,
    and the last ``survey``."""

    def __init__(self, family: ConstraintFamily, x: Array, tools: Tools, threshold: float) -> None:
        self.field = _Violation(family, x, tools.deadline)
        self.tools, self.threshold, self.kept, self.bound = tools, threshold, max(KEPT_PER_ROW, x.size), np.inf
        self.survey = self._survey_index_set()
        self.found = self._refine_peaks(self.survey)
        if self.field.dimension == 0:
            self.bound = self.highest

    @property
    def highest(self) -> float:
        """The largest violation so far."""
        return float(self.found.values.max())

    @property
    def violations(self) -> Array:
        """All violations so far."""
        return self.found.values

    def result(self) -> Separation:
        """Return the worst distinct maxima found so far, with the bound.

        As many rows as the decision has variables may be active. Where fewer maxima are violated, several active rows
        are near one of them, so that points around every maximum are returned too.
        """
        from sparserob_core.sip.separation.refinement import surround

        worst = _select_distinct(self.found, self.kept)
        violated = (worst.values > self.threshold) & (worst.values < np.inf)
        if self.field.dimension and 0 < violated.sum() < self.field.x.size:
            worst = _sort_worst_first(worst.join(surround(self.field, worst.take(violated))))
        return Separation(self.field.indices(worst.points), worst.rows, worst.values, self.bound)

    def look_closer(self) -> None:
        """A finer grid, as far as the budget allows."""
        from sparserob_core.sip.separation.survey import survey_grid

        dimension = self.field.dimension
        side = _choose_grid_side(dimension, POINTS_PER_ASKED * self.tools.budget) if dimension else 0
        if side:
            self.survey = survey_grid(self.field, dimension, side, self.threshold)
            self.found = self.found.join(self._refine_peaks(self.survey))

    def ask(self) -> None:
        """The local maxima of all indices that the maximiser asks for, beside those of the last survey."""
        from sparserob_core.sip.search.search import Rules, Target, maximise
        from sparserob_core.sip.separation.survey import survey_scattered

        field, tools, unit_points, violations = self.field, self.tools, list[Array](), list[Array]()
        if not field.dimension or tools.maximiser is None or tools.budget <= 0:
            return

        def worst(indices: Array) -> Array:
            values = field.at(indices)
            unit_points.append(field.unit(indices))
            violations.append(values)
            return np.asarray(values.max(axis=1), dtype=float)

        target = Target(worst, field.box)
        report = maximise(target, tools.maximiser, tools.budget, tools.rng, Rules(polish=tools.polish), tools.notify)
        if report.interrupted:
            raise KeyboardInterrupt(report.stopped)
        self.bound = report.upper_bound
        scattered = survey_scattered(np.concatenate(unit_points), np.concatenate(violations), self.survey)
        self.found = self.found.join(self._refine_peaks(scattered))

    def _survey_index_set(self) -> Survey:
        """The points of every round: a grid, or random points where a grid would have too many."""
        from sparserob_core.sip.separation.survey import GRID_SIDE, RANDOM_POINTS, survey_grid, survey_scattered

        field = self.field
        if field.dimension > max(GRID_SIDE):
            unit = self.tools.rng.random((RANDOM_POINTS, field.dimension))
            return survey_scattered(unit, field(unit))
        return survey_grid(field, field.dimension, GRID_SIDE.get(field.dimension, 1), self.threshold)

    def _refine_peaks(self, survey: Survey) -> Candidates:
        """The peaks of a survey, the most promising of every row refined; all that may exceed the threshold where those
        do not."""
        from sparserob_core.sip.separation.refinement import refine

        share = max(2, min(max(REFINED_PER_ROW, self.kept), REFINED // survey.values.shape[1]))
        first = survey.best(share)
        candidates = refine(self.field, survey.peaks.take(first))
        if candidates.values.max(initial=-np.inf) <= self.threshold:
            remaining = ~first & (survey.reach > self.threshold)
            candidates = candidates.join(refine(self.field, survey.peaks.take(remaining), self.threshold))
        return candidates


class _Violation:
    """The violation of all rows, as a function on the unit box of the coordinates that move."""

    def __init__(self, family: ConstraintFamily, x: Array, deadline: Deadline) -> None:
        box = family.index_set
        if not (np.isfinite(box.lower).all() and np.isfinite(box.upper).all()):
            raise InputError(
                f"family {family.name!r}: expected a bounded index set, got {box.lower.tolist()} to"
                f" {box.upper.tolist()}"
            )
        self.family, self.x, self.box, self.deadline = family, x, box, deadline
        self.moves = np.flatnonzero(box.upper > box.lower)
        self.dimension = int(self.moves.size)
        self.width = MAX_ARRAY

    def indices(self, unit: Array) -> Array:
        """Indices ``(k, d)`` of unit points ``(k, free)``; the faces of the unit box go to the faces of the index set
        exactly."""
        lower, upper = self.box.lower[self.moves], self.box.upper[self.moves]
        indices = np.repeat(self.box.lower[np.newaxis], len(unit), axis=0)
        indices[:, self.moves] = np.where(unit >= 1.0, upper, np.clip(lower + unit * (upper - lower), lower, upper))
        return indices

    def unit(self, indices: Array) -> Array:
        """Unit points ``(k, free)`` of indices ``(k, d)``."""
        lower, upper = self.box.lower[self.moves], self.box.upper[self.moves]
        return np.asarray((indices[:, self.moves] - lower) / (upper - lower), dtype=float)

    def __call__(self, unit: Array) -> Array:
        return self.at(self.indices(unit))

    def at(self, indices: Array) -> Array:
        """Violations ``(k, r)`` at indices ``(k, d)``, in portions that fit into memory."""
        portions, start = [], 0
        while start < len(indices):
            stop = start + (self.width if start or self.width < MAX_ARRAY else min(64, len(indices)))
            portions.append(self._evaluate_portion(indices[start:stop]))
            self.width, start = max(16, MAX_ARRAY // max(1, portions[-1].shape[1] * self.x.size)), stop
        return np.concatenate(portions) if len(portions) != 1 else portions[0]

    def _evaluate_portion(self, indices: Array) -> Array:
        self.deadline.check()
        values = self.family.violations(self.x, indices)
        if np.isnan(values).any():
            where = indices[np.isnan(values).any(axis=1)][0].tolist()
            raise InputError(f"family {self.family.name!r}: its rows are not numbers at the index {where}")
        return values


def _choose_grid_side(dimension: int, most: int) -> int:
    """Points along every coordinate of the finest grid with at most so many points that halves the spacing of that of
    every round, or halves it again; 0 where there is none."""
    from sparserob_core.sip.separation.survey import GRID_SIDE

    side = coarse = GRID_SIDE.get(dimension, most + 1)
    while (2 * side - 1) ** dimension <= most:
        side = 2 * side - 1
    return side if side > coarse else 0


def _select_distinct(found: Candidates, kept: int) -> Candidates:
    """Worst first; of every row at most so many maxima, each once."""
    found = _sort_worst_first(found)
    chosen = np.zeros(found.rows.size, dtype=bool)
    for row in np.unique(found.rows):
        positions = np.flatnonzero(found.rows == row)[: MAXIMA_PER_KEPT * kept]
        points = found.points[positions]
        near = np.abs(points[:, np.newaxis] - points).max(axis=2, initial=0.0) <= SAME_MAXIMUM_DISTANCE
        chosen[positions[~np.tril(near, -1).any(axis=1)][:kept]] = True
    return found.take(chosen)


def _sort_worst_first(found: Candidates) -> Candidates:
    return found.take(np.argsort(-found.values, kind="stable"))
