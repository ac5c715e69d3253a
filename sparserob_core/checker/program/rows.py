"""Rows of a stated program in ball arithmetic: their largest violation over a box, and their coefficients at a point.

Numbers in a text, entries of tables, and arithmetic on these alone are what double precision makes of them. Everything
that depends on an index or on the decision is enclosed.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, rational
from sparserob_core.checker.arithmetic.models import Frame, Model, find_highest, measure_steepness
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.expression import Value
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import StatedRow

DEGREES = {1: (14, 0), 2: (7, 7), 3: (4, 4)}
"""Orders in the first coordinate and in the others, for so many of them; 2 for more. Half of them need ten times as
many cells, twice as many take four times as long for each."""
SHARP = 0.01  # of a limit: bounds above it are sharpened, since what is excused is priced; with a tenth it is rounding
SHARPENED = 5  # halvings for that: ten times as many follow what really violates to the last digit, two are too few
MAX_CELLS = 20_000  # of one row: ten times as many take hours, a tenth refuses filters of a thousand taps


def bound_violation(rows: ExpressionRows, row: StatedRow, x: Array, limit: float, clock: Clock) -> float:
    """Return a proven upper bound of the violation of a row at a decision, over all indices.

    Raises `Broken` where an index violates it by more than the ``limit``, and `Unchecked` where too many cells are
    needed.
    """
    work, worst = [(rows.lower, rows.upper, 0)], -np.inf
    frame = _make_frame(rows.dimension)
    decision = np.array([frame.number(ball(value)) for value in x], dtype=object)
    for number in count():
        if not work:
            return worst
        if number > MAX_CELLS:
            raise Unchecked(f"more than {MAX_CELLS} cells of {row.text!r} are needed")
        clock.check()
        lower, upper, sharpened = work.pop()
        bound, steepness = _bound_cell(rows, row, frame, decision, lower, upper)
        if bound <= (SHARP * limit if sharpened < SHARPENED else limit):
            worst = max(worst, bound)
            continue
        sharpened += bound <= limit
        middle = lower + (upper - lower) / 2
        _require_kept(rows, row, x, middle, limit)
        axis = int(steepness.argmax())
        if not lower[axis] < middle[axis] < upper[axis]:
            raise Unchecked(f"no cell around the index {middle.tolist()} is short enough for {row.text!r}")
        low, high = lower.copy(), upper.copy()
        high[axis] = low[axis] = middle[axis]
        work += [(lower, high, sharpened), (low, upper, sharpened)]
    return worst


def _make_frame(dimension: int) -> Frame:
    order, degree = DEGREES.get(dimension, (2, 2))
    return Frame(Monomials(dimension - 1, degree), order)


def _bound_cell(
    rows: ExpressionRows, row: StatedRow, frame: Frame, decision: np.ndarray, lower: Array, upper: Array
) -> tuple[float, Array]:
    """Return an upper bound of the violation over one cell, infinite where the row has no enclosure there, and by how
    much it changes across the cell along each coordinate: by its part of the side of the box, where that is unknown."""
    coordinates: list[Value] = []
    for i, (start, stop) in enumerate(zip(lower.tolist(), upper.tolist(), strict=True)):
        low, high = ball(start), ball(stop)
        middle, half = (low + high) / 2, (high - low) / 2
        model = frame.time(middle, half) if i == 0 else frame.parameter(i - 1, middle, half)
        coordinates.append(np.array([[model]], dtype=object))
    shares = (upper - lower) / np.maximum(rows.upper - rows.lower, np.finfo(float).tiny)
    try:
        values = rows.piece.place(coordinates, lambda number: frame.number(rational(number)))
        violation = row.value(values, decision[None])[0, 0]
    except (Unchecked, ValueError, ZeroDivisionError):
        return np.inf, shares
    model = violation if isinstance(violation, Model) else frame.number(arb(violation))
    bound, steepness = find_highest(model), measure_steepness(model)
    is_known = np.isfinite(bound) and (steepness[shares > 0.0] > 0.0).any()
    return bound, np.where(shares > 0.0, steepness, -1.0) if is_known else shares


def _require_kept(rows: ExpressionRows, row: StatedRow, x: Array, index: Array, limit: float) -> None:
    """Raise `Broken` where a row is violated by more than the ``limit`` at one index."""
    violation = evaluate_row(rows, row, x, index)
    if violation > limit:
        raise Broken(f"{row.text!r} is violated by {float(violation):.3g} at {rows.piece.describe(index)}")


def evaluate_row(rows: ExpressionRows, row: StatedRow, x: Array, index: Array) -> arb:
    """Return a ball with the violation of a row at a decision and an index."""
    decision = np.array([ball(value) for value in x], dtype=object)
    return arb(row.value(_list_values(rows, index), decision[None])[0, 0])


def coefficients_at(rows: ExpressionRows, row: StatedRow, index: Array, n: int) -> tuple[list[arb], arb]:
    """Return balls with the coefficients ``(n,)`` of a row at an index, and its constant."""
    form = row.form(_list_values(rows, index), ball(1.0))
    coefficients = [ball(0.0)] * n
    for position, value in zip(form.position.tolist(), form.coefficient[0] if form.position.size else (), strict=True):
        coefficients[position] = coefficients[position] + arb(value)
    return coefficients, arb(form.constant[0, 0])


def _list_values(rows: ExpressionRows, index: Array) -> Mapping[str, Value]:
    placed = rows.piece.place_exactly(index)
    return {name: np.array([[rational(value)]], dtype=object) for name, value in placed.items()}
