"""Proof of one constraint at one decision: every cell of the certificate's subdivision is bounded, and halved further where that is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, final

import numpy as np

from sparserob_core.checker.bernstein import highest
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.polynomials import OUTWARD
from sparserob_core.checker.sides import Bounded, Sides
from sparserob_core.checker.tube import Polynomial, Tube
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from collections.abc import Iterator

MOST_CELLS = 40_000     # cells of time examined per constraint
MOST_BOXES = 4_000      # boxes of parameters
BLAME = 0.2             # share of the error from which the box of parameters is to blame for it

Interval: TypeAlias = tuple[int, float, float]
"""A piece of the grid, and a part of it from one time to another (which may be the same)."""


@final
@dataclass(frozen=True, eq=False)
class Proven:
    """A constraint is exceeded by at most ``bound``; shown on ``cells`` cells of time in ``boxes`` boxes of parameters."""

    bound: float
    cells: int
    boxes: int


Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]
"""Lower and upper corners of a box of parameters."""


Work: TypeAlias = tuple[Box, Sides, list[Interval]]
"""A box of parameters, what is to be bounded, and when."""


def prove(tubes: Callable[[Box], Tube], work: Sequence[Work], tolerance: float) -> Proven:
    """Show that no row is exceeded by more than ``tolerance`` on the cells ``work``; raises `Broken` where one is, or nothing can be shown."""
    stack = list(reversed(work))
    bound, cells, items = -np.inf, 0, 0
    while stack:
        box, sides, todo = stack.pop()
        items += 1
        tube, wide, turned, axes = tubes(box), list[Interval](), list[Interval](), np.zeros(len(box[0]))
        while todo:
            cells += len(todo)
            if cells > MOST_CELLS or items > MOST_BOXES:
                raise Broken(f"a violation of more than {tolerance:.1e} is not excluded after {cells} cells of time")
            again: list[Interval] = []
            for interval, found, tops in _batch(tube, sides.rows, todo, tolerance):
                bound = max(bound, *(top for top in tops if top <= tolerance), -np.inf)
                failed = [(row, poly) for row, poly, top in zip(sides.rows, found, tops, strict=True) if top > tolerance]
                if not failed:
                    continue
                if _turn(tube, sides, interval, tolerance):
                    turned.append(interval)
                elif box[0] and any(_to_blame(poly, interval) for _, poly in failed):
                    wide.append(interval)
                    axes += sum(_influence(tube, poly) for _, poly in failed)
                else:
                    again += _halves(interval)
            todo = again
        if turned:
            stack += [(box, half, turned) for half in reversed(sides.halves())]
        if wide:
            stack += [(half, sides, wide) for half in reversed(_split(box, int(axes.argmax())))]
    return Proven(bound, cells, items)


def _turn(tube: Tube, sides: Sides, interval: Interval, tolerance: float) -> bool:
    """Whether a cell fails because its directions differ too much. Stops at a violation that is certain: at the cell's start."""
    middle = sides.centre
    rows = sides.rows if middle is None else [middle]
    (_, found, tops), = _batch(tube, rows, [interval], tolerance)
    for row, poly in zip(rows, found, strict=True):
        least = float(poly.coefficients[0, 0]) - row.limit - poly.error - poly.kinks
        if least > tolerance and (middle is not None or sides.shape is None):
            raise Broken(f"it is exceeded by {least:.3g} at t = {interval[1]:.6g}")
    return middle is not None and tops[0] <= tolerance


def _batch(tube: Tube, rows: Sequence[Bounded], todo: Sequence[Interval],
           tolerance: float) -> Iterator[tuple[Interval, list[Polynomial], list[float]]]:
    """Every interval with its polynomials, one per row, and their proven upper bounds."""
    directions = [row.direction for row in rows]
    every = [tube.cells(*interval, directions) for interval in todo]
    flat = [(poly, row.limit) for found in every for poly, row in zip(found, rows, strict=True)]
    tops = np.empty(len(flat))
    monomials = tube.flow.monomials
    for orders in {poly.coefficients.shape[0] for poly, _ in flat}:
        which = [i for i, (poly, _) in enumerate(flat) if poly.coefficients.shape[0] == orders]
        dense = np.zeros((len(which), orders, *(monomials.degree + 1,) * monomials.count))
        together = dense.reshape(len(which), orders, -1)
        powers = np.array(monomials.exponents, dtype=int).reshape(monomials.size, -1).T
        places = np.ravel_multi_index(tuple(powers), dense.shape[2:]) if monomials.count else [0]
        together[:, :, places] = np.array([flat[i][0].coefficients for i in which])
        together[:, 0, 0] -= np.array([flat[i][1] for i in which])
        errors = np.array([flat[i][0].error + 1e-15 * abs(flat[i][1]) for i in which]) * OUTWARD
        tops[which] = highest(dense, [False] + [True] * monomials.count, errors, tolerance)
    for number, (interval, found) in enumerate(zip(todo, every, strict=True)):
        yield interval, found, tops[number * len(rows):(number + 1) * len(rows)].tolist()


def _to_blame(poly: Polynomial, interval: Interval) -> bool:
    if interval[1] == interval[2] or poly.expansion > BLAME * poly.error:
        return True
    return bool(np.abs(poly.coefficients[0, 1:]).sum() > np.abs(poly.coefficients[1:]).sum())


def _influence(tube: Tube, poly: Polynomial) -> Array:
    sizes = np.abs(poly.coefficients).sum(axis=0)
    answer: Array = np.array(tube.flow.monomials.exponents, dtype=float).T @ sizes
    return answer


def _halves(interval: Interval) -> list[Interval]:
    piece, start, stop = interval
    middle = (start + stop) / 2
    if not start < middle < stop:
        raise Unchecked(f"the times around {start!r} cannot be halved any more")
    return [(piece, start, middle), (piece, middle, stop)]


def _split(box: Box, axis: int) -> list[Box]:
    lower, upper = list(box[0]), list(box[1])
    middle = (lower[axis] + upper[axis]) / 2
    if not lower[axis] < middle < upper[axis]:
        raise Unchecked("a box of parameters cannot be halved any more")
    left, right = upper.copy(), lower.copy()
    left[axis] = right[axis] = middle
    return [(tuple(lower), tuple(left)), (tuple(right), tuple(upper))]
