"""Rows of a stated program in ball arithmetic: their largest violation over a box, and their coefficients at a point.

Numbers in a text, entries of tables, and arithmetic on these alone are what double precision makes of them. Everything
that depends on an index or on the decision is enclosed.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, rational
from sparserob_core.checker.arithmetic.bernstein import highest
from sparserob_core.checker.arithmetic.models import Frame, Model, measure_steepness, separate_errors
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.expression import Value
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import StatedRow

DEGREES = {1: (24, 0), 2: (7, 7), 3: (4, 4)}
"""Orders in the first coordinate and in the others, for so many of them; 2 for more. Half of them need ten times as
many cells, twice as many take four times as long for each."""
# Of a limit: bounds above it are sharpened, since what is excused is priced; with a tenth it is rounding
SHARPENED_SHARE = 0.01
# Halvings for that: ten times as many follow what really violates to the last digit, two are too few
SHARPENING_HALVINGS = 5
MAX_ROW_CELLS = 20_000  # of one row: ten times as many take hours, a tenth refuses filters of a thousand taps


def bound_violation(rows: ExpressionRows, x: Array, limit: float, clock: Clock) -> float:
    """Return a proven upper bound of the violation of all rows at a decision, over all indices.

    Rows are bounded together, since they often contain the same expressions. Raises `Broken` where an index violates a
    row by more than the ``limit``, and `Unchecked` where too many cells are needed.
    """
    work, worst = [(rows.lower, rows.upper, 0, list(rows.rows))], -np.inf
    frame = _make_frame(rows.dimension)
    decision = np.array([frame.number(ball(value)) for value in x], dtype=object)
    bounded = 0
    while work:
        clock.check()
        lower, upper, sharpened, open_rows = work.pop()
        bounded += len(open_rows)
        if bounded > MAX_ROW_CELLS * len(rows.rows):
            raise Unchecked(f"more than {MAX_ROW_CELLS} cells of each row such as {open_rows[0].text!r} are needed")
        bounds, models = _bound_cell(rows, open_rows, frame, decision, lower, upper)
        is_closed = bounds <= (SHARPENED_SHARE * limit if sharpened < SHARPENING_HALVINGS else limit)
        worst = max(worst, bounds[is_closed].max(initial=-np.inf))
        if is_closed.all():
            continue
        still_open = [row for row, closed in zip(open_rows, is_closed.tolist(), strict=True) if not closed]
        sharpened += bool((bounds <= limit).all())
        middle = lower + (upper - lower) / 2
        for row in still_open:
            _require_kept(rows, row, x, middle, limit)
        axis = _choose_axis(rows, bounds, models, lower, upper)
        if not lower[axis] < middle[axis] < upper[axis]:
            raise Unchecked(f"no cell around the index {middle.tolist()} is short enough for {still_open[0].text!r}")
        low, high = lower.copy(), upper.copy()
        high[axis] = low[axis] = middle[axis]
        work += [(lower, high, sharpened, still_open), (low, upper, sharpened, still_open)]
    return float(worst)


def _make_frame(dimension: int) -> Frame:
    order, degree = DEGREES.get(dimension, (2, 2))
    return Frame(Monomials(dimension - 1, degree), order)


def _bound_cell(
    rows: ExpressionRows, open_rows: list[StatedRow], frame: Frame, decision: np.ndarray, lower: Array, upper: Array
) -> tuple[Array, list[Model]]:
    """Return upper bounds of the violations of some rows over one cell, infinite for a row without an enclosure there,
    and the models of the violations."""
    coordinates: list[Value] = []
    for i, (start, stop) in enumerate(zip(lower.tolist(), upper.tolist(), strict=True)):
        low, high = ball(start), ball(stop)
        middle, half = (low + high) / 2, (high - low) / 2
        model = frame.time(middle, half) if i == 0 else frame.parameter(i - 1, middle, half)
        coordinates.append(np.array([[model]], dtype=object))
    values = rows.piece.place(coordinates, lambda number: frame.number(rational(number)))
    parts: dict[str, Value] = {}
    models = []
    for row in open_rows:
        try:
            violation = row.value(values, decision[None], parts)[0, 0]
        except (Unchecked, ValueError, ZeroDivisionError):
            violation = arb(np.inf)
        models.append(violation if isinstance(violation, Model) else frame.number(arb(violation)))
    tables, errors = zip(*map(separate_errors, models), strict=True)
    return highest(np.array(tables), [True] * lower.size, np.array(errors), 0.0), models


def _choose_axis(rows: ExpressionRows, bounds: Array, models: list[Model], lower: Array, upper: Array) -> int:
    """Return the coordinate along which the worst row changes most across a cell; along which the cell has the largest
    part of the side of the box, where that is unknown."""
    shares = (upper - lower) / np.maximum(rows.upper - rows.lower, np.finfo(float).tiny)
    worst = int(bounds.argmax())
    steepness = measure_steepness(models[worst]) if np.isfinite(bounds[worst]) else np.zeros(lower.size)
    is_known = bool((steepness[shares > 0.0] > 0.0).any())
    return int((np.where(shares > 0.0, steepness, -1.0) if is_known else shares).argmax())


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
