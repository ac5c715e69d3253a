"""The two sides of every worst case, derived anew: one along its witness, the other over the continuum, on the
checker's own cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from flint import arb, ctx

from sparserob_core.checker.arithmetic.balls import above, ball, below
from sparserob_core.checker.claims.case import Case, listed, number, numbers, shaped
from sparserob_core.checker.claims.cells import Work
from sparserob_core.checker.claims.claims import judged, precision_of
from sparserob_core.checker.claims.constraints import covered, cut_times, prove_on_cells
from sparserob_core.checker.claims.followed import FollowedRow
from sparserob_core.checker.claims.multipliers import admissible
from sparserob_core.checker.claims.replay import compute_value, require_admissible
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.outcome import FIGURES, TOLERANCE, Broken, Finding, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD
from sparserob_core.checker.sets.shape import basis_of
from sparserob_core.checker.sets.sides import Bounded, Sides
from sparserob_core.control.sets.sets import Box, Polytope
from sparserob_core.sip.convex_set import Array

SHARE = 1e-3  # the unit of a row relative to its bound: the excused excess is a thousandth of the smallest gap
OUTPUT, STATE = "output", "state"  # names of rows that belong to no constraint


@final
@dataclass(frozen=True, eq=False)
class SupremumRow:
    """A row of the problem: ``direction'(x - r, u) <= wall`` in a window; the ``wall`` is ``None`` without a
    constraint."""

    window: ConstraintWindow
    direction: Array
    wall: arb | None


def check_suprema(case: Case) -> list[Finding]:
    """Return one verdict per worst case in the certificate, and one on whether these are the rows of the problem."""
    with ctx.workprec(precision_of(case)):
        if type(case.certificate.get("format")) is not int or case.certificate["format"] != 1:
            return [Finding("bound", "fails", f"its format is {case.certificate.get('format')!r}, expected 1")]
        findings, entries = list[Finding](), list[Any]()

        def every() -> str:
            entries.extend(_match_rows(case))
            return f"{len(entries)} rows, each of the problem's once"

        findings.append(judged("rows", every))
        for row, entry in entries:
            name = f"{row.window.name}: {_get_sense(row)} {entry.get('quantity')}"
            name += f" at {entry['corner']}" if entry.get("corner") else ""
            findings.append(judged(name, lambda row=row, entry=entry: _verify_row(case, row, entry)))  # type: ignore[misc]
        return findings


def _get_sense(asked: SupremumRow) -> str:
    return "inf" if asked.direction[np.flatnonzero(asked.direction)[0]] < 0.0 else "sup"


def _list_rows(case: Case) -> list[SupremumRow]:
    """Return the rows of the problem: those of its constraints, or else of its outputs or states."""
    rows = [
        SupremumRow(window, direction, b)
        for window in case.windows
        if window not in case.returned
        for direction, b in window.enclosed_set.facets or []
    ]
    if rows:
        return rows
    d, measurements = case.problem.system.states, case.problem.measurements
    name, directions = (STATE, np.eye(d)) if measurements is None else (OUTPUT, np.asarray(measurements.C, dtype=float))
    free = Box(np.full(d, -np.inf), np.full(d, np.inf))
    window = ConstraintWindow(name, free, 0.0, case.problem.horizon, d)
    return [SupremumRow(window, sign * direction, None) for direction in directions for sign in (1.0, -1.0)]


def _match_rows(case: Case) -> list[tuple[SupremumRow, Mapping[str, Any]]]:
    """Return the rows of the certificate, each with the row of the problem that it is about; raise `Broken` unless both
    agree."""
    remaining_rows, pairs = _list_rows(case), []
    for entry in listed(case.certificate, "rows"):
        if not isinstance(entry, Mapping):
            raise Broken("rows: expected a constraint, a direction and two bounds each")
        direction = numbers(entry.get("direction"), "direction")
        matches = [
            row
            for row in remaining_rows
            if row.window.name == entry.get("constraint") and np.array_equal(row.direction, direction)
        ]
        if not matches:
            raise Broken(f"{entry.get('constraint')}: {direction.tolist()} is no row of it, or is written twice")
        remaining_rows.remove(matches[0])
        pairs.append((matches[0], entry))
    if remaining_rows:
        raise Broken(
            f"{len(remaining_rows)} rows of the problem are not written, such as one of {remaining_rows[0].window.name}"
        )
    return pairs


def _verify_row(case: Case, asked: SupremumRow, entry: Mapping[str, Any]) -> str:
    """Return a sentence with both sides of one row; raise `Broken` or `Unchecked` where they are not shown."""
    sense = _get_sense(asked)
    if entry.get("sense") != sense:
        raise Broken(f"it is called {entry.get('sense')!r}, its direction is that of {sense}")
    lower, upper = (None if entry.get(side) is None else number(entry, side) for side in ("lower", "upper"))
    if lower is not None and upper is not None and lower > upper:
        raise Broken(f"from {lower!r} to {upper!r} is empty")
    attained_side, proven_side = (lower, upper) if sense == "sup" else (upper, lower)
    if attained_side is None:
        raise Unchecked("no value is written that is reached")
    sign = 1.0 if sense == "sup" else -1.0
    low, high = sign * attained_side, None if proven_side is None else sign * proven_side
    _verify_margin(asked, entry, sign, high)
    case.clock.check()
    row = FollowedRow(case, asked.window, asked.direction)
    value = _enclose_witness_value(case, asked, entry, row)
    if not value[1] >= low:
        raise Broken(f"{attained_side!r} is written, its witness reaches {sign * value[1]!r}")
    if not value[0] >= low:
        raise Unchecked(f"{attained_side!r} is written, and the witness is followed to {sign * value[0]!r} only")
    if high is None:
        raise Unchecked(f"{attained_side:.9g} is reached, and no bound is written on the other side")
    if value[0] > high:
        raise Broken(f"{proven_side!r} is written, its witness reaches {sign * value[0]!r}")
    count = row.prove(high)[0] if case.followed.are_possible else _prove_row_on_cells(case, asked, high)
    side = "above" if sense == "sup" else "below"
    return f"{attained_side:.9g} is reached, nothing is {side} {proven_side:.9g} ({count} cells)"


def _verify_margin(asked: SupremumRow, entry: Mapping[str, Any], sign: float, high: float | None) -> None:
    """Raise `Broken` unless the wall is the problem's, and the margin is the difference between the wall and the
    bound."""
    wall, margin = entry.get("wall"), entry.get("margin")
    if asked.wall is None:
        if wall is not None or margin is not None:
            raise Broken(f"a wall at {wall!r} is written, the problem has none")
        return
    written = sign * number(entry, "wall")
    size = max(1.0, abs(float(asked.wall.mid())))
    if not abs(ball(written) - asked.wall) <= FIGURES * size:
        raise Broken(f"a wall at {wall!r} is written, it is at {sign * float(asked.wall.mid())!r}")
    if high is None:
        if margin is not None:
            raise Broken("a margin is written without a bound")
    elif abs(number(entry, "margin") - (written - high)) > FIGURES * max(size, abs(high)):
        raise Broken(f"a margin of {margin!r} is written, {written - high!r} follows")


def _enclose_witness_value(
    case: Case, asked: SupremumRow, entry: Mapping[str, Any], row: FollowedRow
) -> tuple[float, float]:
    """Return a lower and an upper bound of the value of the row along its witness, which must be admissible."""
    problem, window, time = case.problem, asked.window, number(entry, "time")
    parameter = numbers(entry.get("parameter"), "parameter")
    deviation = shaped(entry, "deviation", (problem.system.states,))
    admissible(case, window, time, parameter)
    if problem.initial_set is None and deviation.any():
        raise Broken("a deviation is written, there is one initial state")
    if problem.initial_set is not None and not known(problem.initial_set).contains(deviation):
        raise Broken("the deviation of the initial state is not shown to be in its set")
    changes, signal = _read_signal(case, entry)
    low, high = row.enclose_added_terms(time, time)
    execution = case.sources.delivered_at(parameter.tolist())
    if execution is not None:  # an enclosure of the worst errors
        errors = execution.added(window.split(asked.direction)[0], time)
        slack = 2.0 * HALF_ULP * (abs(low) + abs(high) + abs(errors[1]))
        low, high = low + errors[0] - slack, high + errors[1] + slack
    c = window.split(asked.direction)[0]
    value = compute_value(case, c, time, parameter, deviation, signal, changes[:-1].tolist())
    return below(value + low), above(value + high)


def _read_signal(case: Case, entry: Mapping[str, Any]) -> tuple[Array, Array | None]:
    """Return the times at which the disturbance of a witness changes, and the disturbance, which must be admissible."""
    problem = case.problem
    changes = numbers(entry.get("changes"), "changes")
    if changes.ndim != 1 or changes.size < 2 or not (np.diff(changes) > 0.0).all():
        raise Broken("changes: expected increasing times")
    if changes[0] != 0.0 or changes[-1] < problem.horizon:
        raise Broken(f"changes: expected times from 0 to {problem.horizon:g}")
    if problem.disturbance is None:
        if entry.get("disturbance") is not None:
            raise Broken("a disturbance is written, there is none")
        return changes, None
    signal = shaped(entry, "disturbance", (problem.disturbance.dimension, changes.size - 1))
    require_admissible(case, signal, changes.tolist())
    return changes, signal


def _prove_row_on_cells(case: Case, asked: SupremumRow, limit: float) -> int:
    """Show that a row is at most the ``limit`` over the parameters and phases of the system; return the number of
    cells."""
    window = asked.window
    single_row = replace(window, shape=Polytope(asked.direction[None], np.array([limit])))
    facet_basis = basis_of(single_row.enclosed_set)
    assert facet_basis is not None
    (basis, gains), z = np.split(facet_basis[0], [window.states], axis=1), facet_basis[1]
    unit = SHARE * abs(limit) or 1.0  # the excused excess is subtracted from the limit, of which it is a rounding error
    bounded = Bounded(z[0], float(np.nextafter(limit - TOLERANCE * unit * OUTWARD, -np.inf)), unit)
    bound = case.problem.system.parameters
    box = None if bound is None else bound.bounding_box()
    ends = ([], []) if box is None else (box.lower.tolist(), box.upper.tolist())
    lower, upper = (np.array([[t, *p]]) for t, p in zip((window.start, window.stop), ends, strict=True))
    covered(case, single_row, lower, upper)
    times = cut_times(case, window, [(window.start, window.stop)])
    work: list[Work] = [((tuple(ends[0]), tuple(ends[1])), Sides([bounded]), times)]
    return prove_on_cells(case, single_row, (basis, gains), work, (lower, upper)).cells
