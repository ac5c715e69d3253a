"""The proof of one constraint for one control, cell by cell.

Every cell of the certificate's subdivision is bounded, and halved further where its bound is not small enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias, final

import numpy as np

from sparserob_core.checker.arithmetic.bernstein import highest
from sparserob_core.checker.claims.window import AddedTerms
from sparserob_core.checker.outcome import TOLERANCE, Broken, Clock, Unchecked
from sparserob_core.checker.reach.tube import LoopTube, Polynomial, TimelessTube, VerifiedTube
from sparserob_core.checker.sets.parameters import Corners, Parameters
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, ROUNDING
from sparserob_core.checker.sets.sides import Bounded, Sides
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from collections.abc import Iterator

MAX_CELLS = 40_000  # cells of time examined per constraint; `TIMES` as many as it starts with, where that is more
TIMES = 4
MAX_BOXES = 8_000  # pairs of a box of parameters and a cell of directions
BLAME = 0.2  # share of the error, or of the slack, from which one of its causes is treated before the others

AnyTube: TypeAlias = VerifiedTube | LoopTube | TimelessTube
Interval: TypeAlias = tuple[int, float, float]
"""The number of a piece of the grid, and the start and the end of a part of it, which may be the same time."""


@final
@dataclass(frozen=True, eq=False)
class Proven:
    """The result of a proof: no row exceeds its limit by more than ``bound``, nor by more than ``share`` of its unit.

    The proof took ``cells`` cells of time and ``boxes`` pairs of a box of parameters and a cell of directions."""

    bound: float
    share: float
    cells: int
    boxes: int


Work: TypeAlias = tuple[Corners, Sides, list[Interval]]
"""A box of parameters, the rows to bound on it, and the intervals of time."""


def prove(
    tubes: Callable[[Corners], AnyTube],
    parameters: Parameters,
    work: Sequence[Work],
    clock: Clock,
    added_terms: AddedTerms | None = None,
) -> Proven:
    """Show that no row exceeds its limit by more than its slack on any cell of the ``work``; return upper bounds of the
    excess. ``tubes`` returns the reachable states over a box of parameters, ``added_terms`` are those that are added to
    the state. A box that provably holds none of the ``parameters`` needs no proof.

    Raise `Broken` where a row certainly exceeds its limit, `Unchecked` where neither is shown with the cells and the
    time allowed."""
    work_by_box = dict[Corners, list[tuple[Sides, list[Interval]]]]()
    for box, sides, intervals in reversed(work):
        work_by_box.setdefault(box, []).append((sides, intervals))
    excess, cells, boxes = _LargestExcess(), 0, 0
    cell_limit = max(MAX_CELLS, TIMES * sum(len(intervals) for _, _, intervals in work))
    while work_by_box:
        # all directions of one box come before any of its halves, because the tube of a box is expensive
        box, stack = work_by_box.popitem()
        if not parameters.meets(box):
            continue
        halved = list[Work]()
        while stack:
            sides, intervals = stack.pop()
            boxes += 1
            open_cells = _OpenCells(np.zeros(len(box[0])))
            while intervals:
                cells += len(intervals)
                if cells > cell_limit or boxes > MAX_BOXES:
                    raise Unchecked(
                        f"neither shown nor refuted: after {cells} cells a violation of more than {TOLERANCE:.0e} of"
                        " its unit is not excluded"
                    )
                _examine(
                    BoxOfStates(tubes(box), parameters, box, clock, added_terms), sides, intervals, open_cells, excess
                )
                intervals, open_cells.halves = open_cells.halves, []
            if open_cells.turned:
                stack += [(half, open_cells.turned) for half in reversed(sides.halves(open_cells.slopes))]
            if open_cells.wide:
                halved += [(half, sides, open_cells.wide) for half in _halve_box(box, open_cells.influence)]
        for half, sides, intervals in reversed(halved):
            work_by_box.setdefault(half, []).append((sides, intervals))
    return Proven(excess.bound, excess.share, cells, boxes)


@final
@dataclass(frozen=True, eq=False)
class BoxOfStates:
    """A box of parameters with the reachable states over it."""

    tube: AnyTube
    parameters: Parameters
    box: Corners
    clock: Clock
    added_terms: AddedTerms | None = None

    def cells(self, interval: Interval, z: Array) -> list[Polynomial]:
        """Return the polynomials of the rows ``z (k, b)`` on an interval, with the added terms of `added_terms`."""
        polynomials = self.tube.cells(*interval, z)
        if self.added_terms is None:
            return polynomials
        return self.added_terms.added(polynomials, *interval[1:], z, within=(self.box, self.tube.flow))


@final
@dataclass(eq=False)
class _LargestExcess:
    """The largest excess over limits that could not be excluded so far, as a number, and as a share of its row's
    unit."""

    bound: float = -np.inf
    share: float = -np.inf

    def add(self, top: float, row: Bounded) -> None:
        """Record the excess of a row over its limit. Its bound ``top``, not positive, is relative to the limit with the
        slack."""
        over = top + row.slack
        self.bound = max(self.bound, over)
        self.share = max(self.share, over / row.unit)


@final
@dataclass(eq=False)
class _OpenCells:
    """The cells of time that one box of parameters and one cell of directions leave open, sorted by what to halve next.

    ``halves`` holds shorter intervals, for the same box and directions. The intervals in ``turned`` wait for smaller
    cells of directions, with the ``slopes (b,)`` of the bounds along each coordinate of the directions. The intervals
    in ``wide`` wait for smaller boxes of parameters, with the ``influence (nu,)`` of each parameter."""

    influence: Array
    slopes: Array = field(default_factory=lambda: np.zeros(1))
    halves: list[Interval] = field(default_factory=list)
    turned: list[Interval] = field(default_factory=list)
    wide: list[Interval] = field(default_factory=list)


def _examine(
    place: BoxOfStates, sides: Sides, todo: Sequence[Interval], left: _OpenCells, shown: _LargestExcess
) -> None:
    """Bound the rows on every cell of time, and sort the cells whose bounds are too large into ``left``. The bounds
    that suffice are recorded in ``shown``."""
    for interval, polynomials, tops in _bound_rows(place, sides.rows, todo):
        for i, row in enumerate(sides.rows):
            if not tops[i] <= 0.0:
                tops[i] = min(tops[i], _bound_by_halfspaces(place, row, polynomials[i]))
        for top, row in zip(tops, sides.rows, strict=True):
            if top <= 0.0:
                shown.add(top, row)
        over = [
            (row, poly, top) for row, poly, top in zip(sides.rows, polynomials, tops, strict=True) if not top <= 0.0
        ]
        failed = [(row, poly) for row, poly, _ in over]
        if not failed:
            continue
        if _has_too_wide_directions(place, sides, interval, failed, max(tops)):
            left.turned.append(interval)
            left.slopes = left.slopes + sides.slopes(tops)
        elif place.box[0] and any(_is_smaller_box_better(poly, top, interval) for _, poly, top in over):
            left.wide.append(interval)
            left.influence += sum(_measure_influence(place.tube, poly) for _, poly in failed)
        else:
            left.halves += _halve_interval(interval)


def _has_too_wide_directions(
    place: BoxOfStates, sides: Sides, interval: Interval, failed: Sequence[tuple[Bounded, Polynomial]], worst: float
) -> bool:
    """Return whether a cell fails, by at most ``worst``, because its directions differ too much. The one in the middle
    does not fail, and the others exceed it by more than smaller cells of time and parameters could gain: twice the
    error."""
    middle = sides.centre
    if middle is None:
        _refute(place, interval, failed)
        return False
    ((_, (poly,), (top,)),) = _bound_rows(place, [middle], [interval])
    if not top <= 0.0:
        top = min(top, _bound_by_halfspaces(place, middle, poly))
    _refute(place, interval, [(middle, poly)])
    return sides.is_wide and top <= 0.0 and worst - top > 2.0 * (poly.expansion + poly.kinks)


def _refute(place: BoxOfStates, interval: Interval, rows: Sequence[tuple[Bounded, Polynomial]]) -> None:
    """Raise `Broken` where a row certainly exceeds its limit by more than its slack, at the start of the interval and
    at the centre of the box, if that is proven to be a parameter."""
    for row, poly in rows:
        least = float(poly.coefficients[0, 0]) - row.limit - poly.error - poly.kinks
        if least > row.slack and place.parameters.holds(np.array(place.tube.flow.centre)):
            raise Broken(f"it is exceeded by {least:.3g} at t = {interval[1]:.6g}, {least / row.unit:.1e} of its unit")


def _bound_rows(
    place: BoxOfStates, rows: Sequence[Bounded], todo: Sequence[Interval]
) -> Iterator[tuple[Interval, list[Polynomial], list[float]]]:
    """Yield every interval with its polynomials, one per row, and with proven upper bounds of their excess. Each bound
    holds for the polynomial with its error, less the limit and the slack of its row."""
    z, polynomials_by_interval = np.array([row.z for row in rows]), []
    for interval in todo:
        place.clock.check()
        polynomials_by_interval.append(place.cells(interval, z))
    tops = _bound_polynomials(
        place.tube,
        [
            (poly, row.allowed)
            for polynomials in polynomials_by_interval
            for poly, row in zip(polynomials, rows, strict=True)
        ],
    )
    for number, (interval, polynomials) in enumerate(zip(todo, polynomials_by_interval, strict=True)):
        yield interval, polynomials, tops[number * len(rows) : (number + 1) * len(rows)].tolist()


def _bound_polynomials(tube: AnyTube, flat: Sequence[tuple[Polynomial, float]]) -> Array:
    """Return upper bounds ``(k,)`` of polynomials with their errors, each less the value that it is allowed to reach. A
    bound is at most 0 where halving boxes shows that. No bound need be sharp, whatever its sign."""
    tops, monomials = np.empty(len(flat)), tube.flow.monomials
    for orders in {poly.coefficients.shape[0] for poly, _ in flat}:
        indices = [i for i, (poly, _) in enumerate(flat) if poly.coefficients.shape[0] == orders]
        dense = np.zeros((len(indices), orders, *(monomials.degree + 1,) * monomials.count))
        flattened = dense.reshape(len(indices), orders, -1)
        powers = np.array(monomials.exponents, dtype=int).reshape(monomials.size, -1).T
        positions = np.ravel_multi_index(tuple(powers), dense.shape[2:]) if monomials.count else [0]
        flattened[:, :, positions] = np.array([flat[i][0].coefficients for i in indices])
        flattened[:, 0, 0] -= np.array([flat[i][1] for i in indices])
        errors = np.array([flat[i][0].error + HALF_ULP * abs(flat[i][1]) for i in indices]) * OUTWARD
        if not (np.isfinite(dense).all() and np.isfinite(errors).all()):
            raise Unchecked("the response grows beyond what numbers can hold")
        tops[indices] = highest(dense, [False] + [True] * monomials.count, errors, 0.0)
    return tops


def _bound_by_halfspaces(place: BoxOfStates, row: Bounded, poly: Polynomial) -> float:
    """Return the upper bound that the half-spaces of the set of parameters give; infinite for a box. Where ``a'p <= s``
    on the set, ``v <= v + weight (s - a'p)`` holds there for every ``weight >= 0``."""
    tube, top = place.tube, np.inf
    centre, radius = np.array(tube.flow.centre), np.array(tube.flow.radius)
    if place.parameters.is_box:
        return top
    linear = [tube.flow.monomials.number[tuple(int(i == j) for j in range(centre.size))] for i in range(centre.size)]
    slope = poly.coefficients[:, linear].sum(axis=0) / np.where(radius > 0, radius, 1.0)
    for normals, limits, weights in place.parameters.bounds(place.box, slope):
        coefficients = poly.coefficients.copy()
        coefficients[0, linear] -= (weights @ normals) * radius
        coefficients[0, 0] += float(weights @ (limits - normals @ centre))
        size = float(weights @ (np.abs(limits) + np.abs(normals) @ (np.abs(centre) + radius)))
        changed = replace(poly, coefficients=coefficients, error=poly.error + ROUNDING * size)
        top = min(top, float(_bound_polynomials(tube, [(changed, row.allowed)])[0]))
    return top


def _is_smaller_box_better(poly: Polynomial, top: float, interval: Interval) -> bool:
    """Return whether a smaller box of parameters helps more than a shorter time. It does at a single time, where the
    box causes the error, or where the polynomial changes more over the box and errors do not explain the excess."""
    if interval[1] == interval[2] or poly.expansion + poly.turning > BLAME * poly.error:
        return True
    if top <= 2.0 * poly.error + poly.kinks:
        return False
    return bool(np.abs(poly.coefficients[0, 1:]).sum() > np.abs(poly.coefficients[1:]).sum())


def _measure_influence(tube: AnyTube, poly: Polynomial) -> Array:
    """Return how much each parameter contributes to what is left open, ``(nu,)``: by the coefficients of the system
    where the expansion causes the error, by bounded inputs where these do, else by the polynomial."""
    expansion = poly.expansion > BLAME * poly.error
    sizes = tube.flow.sizes if expansion else np.abs(poly.coefficients).sum(axis=0)
    influence: Array = np.array(tube.flow.monomials.exponents, dtype=float).T @ sizes
    if poly.parameter_errors is not None and poly.turning > BLAME * poly.error:
        return poly.parameter_errors
    return influence


def _halve_interval(interval: Interval) -> list[Interval]:
    """Return both halves of an interval; raise `Unchecked` where no double lies between its ends."""
    piece, start, stop = interval
    middle = (start + stop) / 2
    if not start < middle < stop:
        raise Unchecked(f"the times around {start!r} cannot be halved any more")
    return [(piece, start, middle), (piece, middle, stop)]


def _halve_box(box: Corners, influence: Array) -> list[Corners]:
    """Return both halves of a box, cut across the parameter of most influence whose interval still has a middle."""
    lower, upper = list(box[0]), list(box[1])
    middles = (np.array(lower) + np.array(upper)) / 2
    thick = (np.array(lower) < middles) & (middles < np.array(upper))
    if not thick.any():
        raise Unchecked("a box of parameters cannot be halved any more")
    axis = int(np.where(thick, influence, -np.inf).argmax())
    middle = float(middles[axis])
    first_upper, second_lower = upper.copy(), lower.copy()
    first_upper[axis] = second_lower[axis] = middle
    return [(tuple(lower), tuple(first_upper)), (tuple(second_lower), tuple(upper))]
