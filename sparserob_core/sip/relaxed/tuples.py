"""``g`` as a function of one long point: a tuple of indices, of which few change between two evaluations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.maximiser import LinearBlocks
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram
from sparserob_core.sip.relaxed.index_gradient import index_gradient
from sparserob_core.sip.relaxed.relaxed import LAZY, Imposed, RelaxedProgram, Rows, value_of

TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class TupleLayout:
    """Layout of ``count`` indices in one point: index after index, each with the coordinates of the longest index of
    all families.

    Every index of the tuple imposes *all* families. Each family is imposed at the point of its own index set that is
    nearest to the first of these coordinates: a path constraint at ``(t, Beta, p)``, a terminal one at
    ``(T, Beta, p)``, as in the paper. Every index of every family is met, so the supremum of ``g`` over tuples is the
    same as with an index set for each family.
    """

    families: Sequence[ConstraintFamily]
    count: int

    @cached_property
    def slot(self) -> Box:
        """The box ``(width,)`` of one index: the smallest around the index sets of all families."""
        width = max((family.index_set.dimension for family in self.families), default=1)
        lower, upper = np.full(width, np.inf), np.full(width, -np.inf)
        for family in self.families:
            size = family.index_set.dimension
            lower[:size] = np.minimum(lower[:size], family.index_set.lower)
            upper[:size] = np.maximum(upper[:size], family.index_set.upper)
        return Box(np.where(np.isfinite(lower), lower, 0.0), np.where(np.isfinite(upper), upper, 0.0))

    @cached_property
    def domain(self) -> Box:
        """The box of all tuples, ``(count width,)``."""
        return Box(np.tile(self.slot.lower, self.count), np.tile(self.slot.upper, self.count))

    def indices(self, family: ConstraintFamily, slots: Array) -> Array:
        """The indices ``(k, d)`` at which a family is imposed by the indices ``(k, width)`` of a tuple."""
        box = family.index_set
        return np.asarray(np.minimum(np.maximum(slots[:, : box.dimension], box.lower), box.upper))


def imposed_program(program: SemiInfiniteProgram, formulation: Literal["reduced", "literal"]) -> SemiInfiniteProgram:
    """The program whose families are indexed as the formulation says; raises `InputError` for a family that has no
    literal one."""
    return (
        program
        if formulation == "reduced"
        else replace(program, families=[_require_literal(family) for family in program.families])
    )


def _require_literal(family: ConstraintFamily) -> ConstraintFamily:
    if family.literal is None:
        raise InputError(
            f"formulation: literal needs families with a disturbance in their index, which {family.name} is not;"
            " expected reduced"
        )
    return family.literal


class TupleValue:
    """``g(epsilon; xi^1, ..., xi^D)`` for points ``(k, D width)``; only the rows of indices that changed since the last
    point are built.

    Of the point before the last one the rows are kept too, so that a refused move costs nothing to take back, and where
    the last optimum keeps the new rows, nothing is solved. ``epsilon`` may be changed
    between evaluations. A value of ``+inf`` comes with a proof in `solution`.
    """

    def __init__(self, program: SemiInfiniteProgram, relaxed: RelaxedProgram, count: int) -> None:
        self.layout, self.relaxed, self.program, self.epsilon = (
            TupleLayout(program.families, count),
            relaxed,
            program,
            0.0,
        )
        self.domain, self.block = self.layout.domain, self.layout.slot.dimension
        self.slots = np.full((count, self.block), np.nan)
        self.imposed, self.solution = Imposed(np.zeros(0, dtype=int), np.zeros(0)), _make_empty_solution(program.n)
        self._solved_epsilon = np.nan
        self._owed_point: Array | None = None
        lowest = self.layout.slot.lower[np.newaxis]
        first = [family.rows_at(self.layout.indices(family, lowest), program.n) for family in program.families]
        ends = np.cumsum([h.shape[1] for _, h in first], dtype=int)
        self._columns = list(zip(program.families, ends - [h.shape[1] for _, h in first], ends, strict=True))
        self._kinds = np.tile(np.arange(ends[-1] if first else 0), count)
        self._G, self._h = (
            np.zeros((count, self._kinds.size // count, program.n)),
            np.zeros((count, self._kinds.size // count)),
        )
        self._norms = np.ones(self._h.shape)
        self._previous = _PreviousRows(
            np.zeros(0, dtype=int), self.slots[:0], self._G[:0], self._h[:0], self._norms[:0]
        )

    def __call__(self, points: Array) -> Array:
        return np.array([self.at(point) for point in points])

    def forget(self, point: Array | None = None) -> None:
        """Let the next evaluation start from nothing. Whoever asks about the last tuple is answered about ``point``,
        which is then evaluated for it."""
        self.slots = np.full_like(self.slots, np.nan)
        self.imposed, self.solution = Imposed(np.zeros(0, dtype=int), np.zeros(0)), _make_empty_solution(self.program.n)
        self._previous = _PreviousRows(
            np.zeros(0, dtype=int), self.slots[:0], self._G[:0], self._h[:0], self._norms[:0]
        )
        self._owed_point = None if point is None else point.copy()

    def _evaluate_owed(self) -> None:
        if self._owed_point is not None:
            self.at(self._owed_point)

    def at(self, point: Array) -> float:
        """``g`` at one point ``(D width,)``."""
        self._owed_point = None
        changed = self._update_rows(point.reshape(self.slots.shape))
        if self._is_still_optimal(changed):
            return value_of(self.solution)
        rows, self._solved_epsilon = self._kinds.size, np.nan
        self.imposed, self.solution = self.relaxed.lazily(
            self._G.reshape(rows, -1),
            self._h.reshape(rows),
            self._kinds,
            self.epsilon,
            self.imposed,
            self._norms.reshape(rows),
        )
        self._solved_epsilon = self.epsilon
        return value_of(self.solution)

    def gradient(self, point: Array) -> Array:
        """The gradient ``(D width,)`` of ``g`` where it has one: multiplier times derivative of the row in its index,
        by the envelope theorem.

        For a strictly convex program with unique multipliers (Bonnans and Shapiro 2000, theorem 4.24); at a kink it is
        one of several.
        """
        if not np.array_equal(point.reshape(self.slots.shape), self.slots):
            self.at(point)
        slope = np.zeros(self.slots.shape)
        slots, kinds = np.divmod(self.imposed.positions, self._h.shape[1])
        for family, first, last in self._columns:
            mask = (kinds >= first) & (kinds < last) & (self.imposed.multipliers > 0.0)
            where, box = slots[mask], family.index_set
            if not where.size:
                continue
            wanted = self.slots[where][:, : box.dimension]
            indices = self.layout.indices(family, self.slots[where])
            steps = (
                index_gradient(family, self.solution.x, indices, kinds[mask] - first)
                * self.imposed.multipliers[mask][:, np.newaxis]
            )
            np.add.at(slope[:, : box.dimension], where, np.where(wanted == indices, steps, 0.0))
        return slope.ravel()

    @cached_property
    def linear(self) -> LinearBlocks | None:
        """Coordinates of the tuple in which the indices are linear; ``None`` unless every family has such
        coordinates."""
        coordinates = np.ones(self.block, dtype=bool)
        for family in self.program.families:
            if family.linear is None or family.steepest is None:
                return None
            size = family.index_set.dimension
            coordinates[:size] &= family.linear
            coordinates[size:] = False
        return LinearBlocks(np.tile(coordinates, self.layout.count), self.acting, self._find_steepest)

    @cached_property
    def coordinates(self) -> tuple[int, ...]:
        """The coordinates of an index that can move and are not `linear`: where it is, without what is then at its
        worst in closed form."""
        slot = self.layout.slot
        moves = slot.upper > slot.lower
        if self.linear is not None:
            moves &= ~self.linear.coordinates[: self.block]
        return tuple(int(c) for c in np.flatnonzero(moves))

    def deciding(self, imposed: Sequence[Imposed], most: int) -> np.ndarray:
        """The indices ``(k, most)`` of each of ``k`` tuples whose constraints have the largest multipliers, by the rows
        that were ``imposed`` there; the largest first, -1 where fewer have one.

        A constraint that stays as it is wherever the `coordinates` move, such as one at the end of the horizon of a
        system without parameters, does not count.
        """
        count, rows = len(self.slots), self._h.shape[1]
        tuples = np.repeat(np.arange(len(imposed)), [entry.positions.size for entry in imposed])
        positions = np.concatenate([np.zeros(0, dtype=int), *(entry.positions for entry in imposed)])
        multipliers = np.concatenate([np.zeros(0), *(entry.multipliers for entry in imposed)])
        slots, kinds = np.divmod(positions, rows)
        weights = np.bincount(tuples * count + slots, multipliers * self._moving_rows[kinds], len(imposed) * count)
        weights = weights.reshape(len(imposed), count)
        order = np.argsort(-weights, axis=1, kind="stable")[:, :most]
        indices = np.full((len(imposed), most), -1)
        indices[:, : order.shape[1]] = np.where(np.take_along_axis(weights, order, axis=1) > 0.0, order, -1)
        return indices

    @cached_property
    def _moving_rows(self) -> np.ndarray:
        """Mask ``(r,)`` of the rows of an index that move with any of its `coordinates`, such as its time."""
        moving = np.zeros(self._h.shape[1], dtype=bool)
        for family, first, last in self._columns:
            box = family.index_set
            axes = [c for c in self.coordinates if c < box.dimension]
            moving[first:last] = bool((box.upper[axes] > box.lower[axes]).any())
        return moving

    def acting(self) -> np.ndarray:
        """Return a mask ``(D,)`` of the indices of the last tuple that have a multiplier."""
        self._evaluate_owed()
        acts = np.zeros(self.layout.count, dtype=bool)
        acts[self.imposed.positions[self.imposed.multipliers > 0.0] // self._h.shape[1]] = True
        return acts

    def _find_steepest(self, point: Array) -> Array:
        """The tuple with the linear coordinates of every index where the row is violated most by the last optimum: the
        row that the index acts by, or else the one of any family that is then violated most."""
        self._evaluate_owed()
        slots, x = point.reshape(self.slots.shape).copy(), self.solution.x
        kinds = np.full(len(slots), -1)
        for position in self.imposed.positions[np.argsort(self.imposed.multipliers, kind="stable")]:
            slot, kind = divmod(int(position), self._h.shape[1])
            kinds[slot] = kind
        largest = np.full(len(slots), -np.inf)
        for family, first, last in self._columns:
            candidates = np.flatnonzero((kinds < 0) | ((kinds >= first) & (kinds < last)))
            rows = np.where(kinds[candidates] < 0, -1, kinds[candidates] - first)
            assert family.linear is not None and family.steepest is not None
            steepest = family.steepest(x, self.layout.indices(family, slots[candidates]), rows)
            better = steepest.violations > largest[candidates]
            improved, linear = candidates[better], np.flatnonzero(family.linear)
            largest[improved] = steepest.violations[better]
            slots[np.ix_(improved, linear)] = steepest.indices[better][:, linear]
        return slots.ravel()

    def rows(self) -> Rows:
        """The rows that were imposed in the last evaluation, in the order of its multipliers."""
        self._evaluate_owed()
        slots, kinds = np.divmod(self.imposed.positions, self._h.shape[1])
        cuts = []
        for slot, kind, multiplier in zip(slots, kinds, self.imposed.multipliers, strict=True):
            family, first, _ = next(column for column in self._columns if column[1] <= kind < column[2])
            index = self.layout.indices(family, self.slots[slot][np.newaxis])[0]
            cuts.append(Cut(family.name, index, int(kind - first), float(multiplier), family.formulation))
        return Rows(self._G[slots, kinds], self._h[slots, kinds], tuple(cuts))

    def _is_still_optimal(self, changed: np.ndarray) -> bool:
        """Return whether the last optimum is still an optimum: none of its imposed rows has changed, and it satisfies
        the rows of the indices that have."""
        if self.solution.status != "optimal" or self._solved_epsilon != self.epsilon:
            return False
        if ((self.imposed.positions // self._h.shape[1])[:, None] == changed).any():
            return False
        return bool((self._G[changed] @ self.solution.x - self._h[changed] <= LAZY * self._norms[changed]).all())

    def _update_rows(self, slots: Array) -> np.ndarray:
        """Bring the rows up to date with the indices ``(count, width)``; returns which of them changed."""
        changed = np.flatnonzero(_find_moved(self.slots, slots))
        if not changed.size:
            return changed
        before, fresh, old_slots = self._previous, changed, self.slots[changed]
        self._previous = _PreviousRows(changed, old_slots, self._G[changed], self._h[changed], self._norms[changed])
        self.slots[changed] = np.nan  # whatever is interrupted here, nobody takes their rows for those of an index
        if before.changed.size:
            back, positions = before.find(changed, slots[changed])
            restored, fresh, old_slots = changed[back], changed[~back], old_slots[~back]
            self._G[restored], self._h[restored], self._norms[restored] = (
                before.G[positions],
                before.h[positions],
                before.norms[positions],
            )
        if fresh.size:
            self._build_rows(fresh, old_slots, slots[fresh])
        self.slots[changed] = slots[changed]
        return changed

    def _build_rows(self, fresh: np.ndarray, old: Array, wanted: Array) -> None:
        """The rows of some indices ``fresh (k,)`` that go from ``old`` to ``wanted (k, width)``."""
        is_new = np.isnan(old).all(axis=1)
        for family, first, last in self._columns:
            # an index may move where the point at which it imposes a family does not, as at the end of the horizon
            indices = self.layout.indices(family, wanted)
            is_changed = is_new | _find_moved(self.layout.indices(family, old), indices)
            if is_changed.any():
                rebuilt = fresh[is_changed]
                G, self._h[rebuilt, first:last] = family.rows_at(indices[is_changed], self.program.n)
                self._G[rebuilt, first:last] = G
                self._norms[rebuilt, first:last] = np.maximum(np.sqrt((G * G).sum(axis=2)), TINY)


@dataclass(frozen=True, eq=False)
class _PreviousRows:
    """State before the last change: the indices ``changed (k,)`` of the tuple, sorted, with their old coordinates, rows
    and norms of rows."""

    changed: np.ndarray
    slots: Array
    G: Array
    h: Array
    norms: Array

    def find(self, changed: np.ndarray, slots: Array) -> tuple[np.ndarray, np.ndarray]:
        """Return a mask ``(k,)`` of the indices ``changed`` that return to their old coordinates, and the places where
        their old rows are kept."""
        positions = np.minimum(self.changed.searchsorted(changed), self.changed.size - 1)
        back = (self.changed[positions] == changed) & ~_find_moved(self.slots[positions], slots)
        return back, positions[back]


def _find_moved(old: Array, new: Array) -> np.ndarray:
    """Return a mask ``(k,)`` of the indices whose coordinates differ; a coordinate that is NaN (open) before and after
    does not differ."""
    differs: np.ndarray = ((old != new) & ~(np.isnan(old) & np.isnan(new))).any(axis=1)
    return differs


def _make_empty_solution(n: int) -> FiniteSolution:
    zero = np.zeros(n)
    return FiniteSolution(
        "failed", zero, np.nan, -np.inf, np.zeros(0), np.zeros(0), zero, np.inf, np.inf, "nothing was evaluated"
    )
