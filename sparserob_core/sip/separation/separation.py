"""The generic separation: the most violated indices of a family that offers nothing but its rows."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import EvaluationsFinished, Notify, forwarded, ignore
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.method import Deadline, Tools
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram, Separation

if TYPE_CHECKING:
    from sparserob_core.sip.separation.refinement import Candidates

GRID_SIDE = {1: 257, 2: 33, 3: 13, 4: 7}
RANDOM_POINTS = 2048
KEPT_PER_ROW = 8
REFINED_PER_ROW = 32
SAME = 1e-6
"""Maxima of one row that are closer than this share of the box are one maximum."""
LARGEST_ARRAY = 2_000_000


def separate(
    program: SemiInfiniteProgram, x: Array, tools: Tools, threshold: float = 1e-9, number: int = 0
) -> list[tuple[ConstraintFamily, Separation]]:
    """The most violated indices of every family at ``x (n,)``: in the family's own way, or as the maximiser finds them
    (in round ``number``). Raises `OutOfTime` when the deadline of the tools has passed."""

    def searched(family: ConstraintFamily) -> Separation:
        notify = forwarded(
            tools.notify, EvaluationsFinished, lambda event: replace(event, family=family.name, round=number)
        )
        return search_worst(
            family, x, tools.maximiser, tools.budget, tools.rng, threshold, tools.polish, notify, tools.deadline
        )

    separations = []
    for family in program.families:
        tools.deadline.check()
        found = searched(family) if family.worst is None else family.separated(x)
        separations.append((family, replace(found, formulation=family.formulation)))
    return separations


def search_worst(
    family: ConstraintFamily,
    x: Array,
    maximiser: Maximiser | None,
    budget: int,
    rng: np.random.Generator,
    threshold: float = 1e-9,
    polish: float | None = None,
    notify: Notify = ignore,
    deadline: Deadline | None = None,
) -> Separation:
    """The largest local maxima of the violation of every row of ``family`` at the decision ``x (n,)``, at most 8 per
    row, worst first.

    A grid of the index box (257 points for one coordinate that moves, 33 x 33, 13^3, 7^4; 2048 random points beyond)
    brackets the local maxima; all of them are refined at once, to about 1e-13 in the violation. Only when nothing above
    ``threshold`` was found is ``maximiser`` asked, for ``budget`` further indices, and its best one refined as well:
    the rounds of an exchange that find cuts stay cheap, and the last one is searched hard.

    A search proves nothing: ``bound`` is ``inf`` unless the maximiser proved one, or the index set is a single point.
    Raises `InputError` when a row is not a number or the index set is unbounded, and `OutOfTime` past the deadline.
    """
    from sparserob_core.sip.separation.refinement import refine

    field = _Violation(family, x, deadline or Deadline())
    found = refine(field, _grid_maxima(field, rng))
    bound = np.inf
    if field.dimension == 0:
        bound = float(found.values.max())
    elif maximiser is not None and budget > 0 and found.values.max() <= threshold:
        asked, bound = _ask(field, maximiser, budget, rng, polish, notify)
        found = found.join(refine(field, asked))
    kept = _distinct(found)
    return Separation(field.indices(kept.points), kept.rows, kept.values, bound)


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
        self.width = LARGEST_ARRAY

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
        parts, start = [], 0
        while start < len(indices):
            stop = start + (self.width if start or self.width < LARGEST_ARRAY else min(64, len(indices)))
            parts.append(self._portion(indices[start:stop]))
            self.width, start = max(16, LARGEST_ARRAY // max(1, parts[-1].shape[1] * self.x.size)), stop
        return np.concatenate(parts) if len(parts) != 1 else parts[0]

    def _portion(self, indices: Array) -> Array:
        self.deadline.check()
        values = self.family.violations(self.x, indices)
        if np.isnan(values).any():
            where = indices[np.isnan(values).any(axis=1)][0].tolist()
            raise InputError(f"family {self.family.name!r}: its rows are not numbers at the index {where}")
        return values


def _grid_maxima(field: _Violation, rng: np.random.Generator) -> Candidates:
    """For every row the most promising points of the grid that no neighbour exceeds."""
    dimension = field.dimension
    if dimension > max(GRID_SIDE):
        unit = rng.random((RANDOM_POINTS, dimension))
        values = field(unit)
        return _promising(unit, values, values, 0.5 * RANDOM_POINTS ** (-1 / dimension))
    side = GRID_SIDE.get(dimension, 1)
    unit = (
        np.stack(np.meshgrid(*[np.linspace(0, 1, side)] * dimension, indexing="ij"), axis=-1).reshape(-1, dimension)
        if dimension
        else np.zeros((1, 0))
    )
    values = field(unit)
    shaped = values.reshape(*[side] * dimension, -1)
    highest, promise = shaped.copy(), shaped.copy()
    for axis in range(dimension):
        promise += _peak_above(shaped, axis)
        highest = _window_maximum(highest, axis)
    return _promising(
        unit, values, np.where(shaped >= highest, promise, -np.inf).reshape(values.shape), 1 / max(1, side - 1)
    )


def _window_maximum(values: Array, axis: int) -> Array:
    """The maximum of every entry and its two neighbours along an axis."""
    moved = np.moveaxis(values.copy(), axis, 0)
    original = moved.copy()
    np.maximum(moved[1:], original[:-1], out=moved[1:])
    np.maximum(moved[:-1], original[1:], out=moved[:-1])
    return np.moveaxis(moved, 0, axis)


def _peak_above(values: Array, axis: int) -> Array:
    """How far the parabola through three neighbours rises above the middle one, at most as far as its neighbours lie
    below."""
    moved = np.moveaxis(values, axis, 0)
    rise = np.zeros_like(moved)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        bend = 2 * moved[1:-1] - moved[:-2] - moved[2:]
        peak = (moved[2:] - moved[:-2]) ** 2 / (8 * bend)
        rise[1:-1] = np.where((bend > 0) & np.isfinite(peak), np.minimum(peak, bend), 0.0)
    return np.moveaxis(rise, 0, axis)


def _promising(unit: Array, values: Array, promise: Array, radius: float) -> Candidates:
    """The best points by ``promise (k, r)`` for every row."""
    from sparserob_core.sip.separation.refinement import Candidates

    rows = values.shape[1]
    share = min(len(unit), max(2, min(REFINED_PER_ROW, 16 * REFINED_PER_ROW // rows)))
    order = np.argsort(-promise, axis=0, kind="stable")[:share]
    which, row = order.ravel(), np.tile(np.arange(rows), share)
    worth = (promise[which, row] > -np.inf) | (np.repeat(np.arange(share), rows) == 0)
    which, row = which[worth], row[worth]
    return Candidates(unit[which], row, values[which, row], np.full(which.size, radius))


def _ask(
    field: _Violation, maximiser: Maximiser, budget: int, rng: np.random.Generator, polish: float | None, notify: Notify
) -> tuple[Candidates, float]:
    """The best index that a maximiser finds, as a candidate of every row."""
    from sparserob_core.sip.search.search import Rules, Target, maximise
    from sparserob_core.sip.separation.refinement import Candidates

    target = Target(lambda indices: field.at(indices).max(axis=1), field.box)
    report = maximise(target, maximiser, budget, rng, Rules(polish=polish), notify)
    if report.interrupted:
        raise KeyboardInterrupt(report.stopped)
    values = field.at(report.best_point[np.newaxis])[0]
    unit = np.repeat(field.unit(report.best_point[np.newaxis]), values.size, axis=0)
    return Candidates(unit, np.arange(values.size), values, np.full(values.size, 0.01)), report.upper_bound


def _distinct(found: Candidates) -> Candidates:
    """Worst first; of every row at most `KEPT_PER_ROW` maxima, each once."""
    found = found.take(np.argsort(-found.values, kind="stable"))
    near = np.abs(found.points[:, np.newaxis] - found.points).max(axis=2, initial=0.0) <= SAME
    again = (np.tril(near, -1) & (found.rows[:, np.newaxis] == found.rows)).any(axis=1)
    found = found.take(~again)
    earlier = np.tril(found.rows[:, np.newaxis] == found.rows, -1).sum(axis=1)
    return found.take(earlier < KEPT_PER_ROW)
