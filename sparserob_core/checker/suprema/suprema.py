"""The two sides of every worst case, derived anew: one along its witness, the other over the continuum, on the
checker's own cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from sparserob_core.checker.arithmetic.balls import above, ball, balls, below
from sparserob_core.checker.claims.case import Case, listed, number, numbers, shaped
from sparserob_core.checker.claims.cells import Work
from sparserob_core.checker.claims.claims import judged, precision_of
from sparserob_core.checker.claims.constraints import covered, cut_times, prove_on_cells
from sparserob_core.checker.claims.followed import FollowedRow
from sparserob_core.checker.claims.multipliers import admissible
from sparserob_core.checker.claims.replay import reached
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.outcome import FIGURES, TOLERANCE, Broken, Finding, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD
from sparserob_core.checker.sets.sides import Bounded, Sides
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.disturbances import columns_of
from sparserob_core.control.sets.sets import Box, Polytope
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb

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
    from flint import ctx

    with ctx.workprec(precision_of(case)):
        if type(case.certificate.get("format")) is not int or case.certificate["format"] != 1:
            return [Finding("bound", "fails", f"its format is {case.certificate.get('format')!r}, expected 1")]
        found, entries = list[Finding](), list[Any]()

        def every() -> str:
            entries.extend(_matched(case))
            return f"{len(entries)} rows, each of the problem's once"

        found.append(judged("rows", every))
        for asked, entry in entries:
            name = f"{asked.window.name}: {_sense(asked)} {entry.get('quantity')}"
            name += f" at {entry['corner']}" if entry.get("corner") else ""
            found.append(judged(name, lambda asked=asked, entry=entry: _enclosed(case, asked, entry)))  # type: ignore[misc]
        return found


def _sense(asked: SupremumRow) -> str:
    return "inf" if asked.direction[np.flatnonzero(asked.direction)[0]] < 0.0 else "sup"


def _asked(case: Case) -> list[SupremumRow]:
    """Return the rows of the problem: those of its constraints, or else of its outputs or states."""
    found = [
        SupremumRow(window, direction, b)
        for window in case.windows
        if window not in case.returned
        for direction, b in window.seen.facets or []
    ]
    if found:
        return found
    d, measured = case.problem.system.states, case.problem.measurements
    name, every = (STATE, np.eye(d)) if measured is None else (OUTPUT, np.asarray(measured.C, dtype=float))
    free = Box(np.full(d, -np.inf), np.full(d, np.inf))
    window = ConstraintWindow(name, free, 0.0, case.problem.horizon, d)
    return [SupremumRow(window, sign * direction, None) for direction in every for sign in (1.0, -1.0)]


def _matched(case: Case) -> list[tuple[SupremumRow, Mapping[str, Any]]]:
    """Return the rows of the certificate, each with the row of the problem that it is about; raise `Broken` unless both
    agree."""
    left, found = _asked(case), []
    for entry in listed(case.certificate, "rows"):
        if not isinstance(entry, Mapping):
            raise Broken("rows: expected a constraint, a direction and two bounds each")
        direction = numbers(entry.get("direction"), "direction")
        same = [
            one
            for one in left
            if one.window.name == entry.get("constraint") and np.array_equal(one.direction, direction)
        ]
        if not same:
            raise Broken(f"{entry.get('constraint')}: {direction.tolist()} is no row of it, or is written twice")
        left.remove(same[0])
        found.append((same[0], entry))
    if left:
        raise Broken(f"{len(left)} rows of the problem are not written, such as one of {left[0].window.name}")
    return found


def _enclosed(case: Case, asked: SupremumRow, entry: Mapping[str, Any]) -> str:
    """Return a sentence with both sides of one row; raise `Broken` or `Unchecked` where they are not shown."""
    sense = _sense(asked)
    if entry.get("sense") != sense:
        raise Broken(f"it is called {entry.get('sense')!r}, its direction is that of {sense}")
    least, most = (None if entry.get(side) is None else number(entry, side) for side in ("lower", "upper"))
    if least is not None and most is not None and least > most:
        raise Broken(f"from {least!r} to {most!r} is empty")
    reached_side, proven_side = (least, most) if sense == "sup" else (most, least)
    if reached_side is None:
        raise Unchecked("no value is written that is reached")
    sign = 1.0 if sense == "sup" else -1.0
    low, high = sign * reached_side, None if proven_side is None else sign * proven_side
    _margin(asked, entry, sign, high)
    case.clock.check()
    row = FollowedRow(case, asked.window, asked.direction)
    value = _witnessed(case, asked, entry, row)
    if not value[1] >= low:
        raise Broken(f"{reached_side!r} is written, its witness reaches {sign * value[1]!r}")
    if not value[0] >= low:
        raise Unchecked(f"{reached_side!r} is written, and the witness is followed to {sign * value[0]!r} only")
    if high is None:
        raise Unchecked(f"{reached_side:.9g} is reached, and no bound is written on the other side")
    if value[0] > high:
        raise Broken(f"{proven_side!r} is written, its witness reaches {sign * value[0]!r}")
    count = row.prove(high)[0] if case.followed.are_possible else _proven_in_cells(case, asked, high)
    side = "above" if sense == "sup" else "below"
    return f"{reached_side:.9g} is reached, nothing is {side} {proven_side:.9g} ({count} cells)"


def _margin(asked: SupremumRow, entry: Mapping[str, Any], sign: float, high: float | None) -> None:
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


def _witnessed(case: Case, asked: SupremumRow, entry: Mapping[str, Any], row: FollowedRow) -> tuple[float, float]:
    """Return a lower and an upper bound of the value of the row along its witness, which must be admissible."""
    problem, window, time = case.problem, asked.window, number(entry, "time")
    parameter = numbers(entry.get("parameter"), "parameter")
    deviation = shaped(entry, "deviation", (problem.system.states,))
    admissible(case, window, time, parameter)
    if problem.initial_set is None and deviation.any():
        raise Broken("a deviation is written, there is one initial state")
    if problem.initial_set is not None and not known(problem.initial_set).contains(deviation):
        raise Broken("the deviation of the initial state is not shown to be in its set")
    changes, signal = _signal(case, entry)
    low, high = row.beside(time, time)
    delivered = case.sources.delivered_at(parameter.tolist())
    if delivered is not None:  # an enclosure of the worst errors
        errors = delivered.added(window.split(asked.direction)[0], time)
        slack = 2.0 * HALF_ULP * (abs(low) + abs(high) + abs(errors[1]))
        low, high = low + errors[0] - slack, high + errors[1] + slack
    if case.followed.are_possible:
        value = row.worst.along(time, deviation, changes, signal)
        return value[0] + low - 4.0 * HALF_ULP * (abs(value[0]) + abs(low)), value[1] + high
    fine, on_grid = _following(case, changes, signal)
    state = reached(fine, time, parameter, on_grid, entry.get("deviation"))
    direction = window.split(asked.direction)[0]
    total = sum((a * x for a, x in zip(balls(direction), state, strict=True)), ball(0.0))
    return below(total + low), above(total + high)


def _signal(case: Case, entry: Mapping[str, Any]) -> tuple[Array, Array | None]:
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
    held = ~columns_of(problem.disturbance, problem.disturbance_class, "measurable")
    jumps = (signal[:, 1:] != signal[:, :-1]) & held[:, None]
    for time, jumping in zip(changes[1:-1].tolist(), jumps.T, strict=True):
        if (jumping & ~case.disturbances.may_jump(time)).any():
            raise Broken("the disturbance jumps within a piece")
    shape, seen = known(problem.disturbance), set[tuple[float, ...]]()
    for value in case.clock.each(map(tuple, signal.T.tolist())):
        if value not in seen and not shape.contains(value):
            raise Broken(f"the disturbance {list(value)} is not shown to be in its set")
        seen.add(value)
    return changes, signal


def _following(case: Case, changes: Array, signal: Array | None) -> tuple[Case, object]:
    """Return the case whose grid has the ``changes`` of a signal, and the signal on the pieces of that grid.

    A measurable signal that is constant between the changes is one of a dictionary with these pieces.
    """
    if signal is None:
        return case, None
    if case.measurable:
        problem = replace(case.problem, disturbance_class="piecewise_constant")
        case = replace(case, problem=problem, disturbance=Dictionary.indicators(changes))
    starts = np.array(case.timing.grid[:-1])
    return case, signal[:, np.searchsorted(changes, starts, side="right") - 1].tolist()


def _proven_in_cells(case: Case, asked: SupremumRow, limit: float) -> int:
    """Show that a row is at most the ``limit`` over the parameters and phases of the system; return the number of
    cells."""
    window = asked.window
    alone = replace(window, shape=Polytope(asked.direction[None], np.array([limit])))
    found = alone.seen.basis
    assert found is not None
    (basis, gains), z = np.split(found[0], [window.states], axis=1), found[1]
    unit = SHARE * abs(limit) or 1.0  # the excused excess is subtracted from the limit, of which it is a rounding error
    bounded = Bounded(z[0], float(np.nextafter(limit - TOLERANCE * unit * OUTWARD, -np.inf)), unit)
    bound = case.problem.system.parameters
    box = None if bound is None else bound.bounding_box()
    ends = ([], []) if box is None else (box.lower.tolist(), box.upper.tolist())
    lower, upper = (np.array([[t, *p]]) for t, p in zip((window.start, window.stop), ends, strict=True))
    covered(case, alone, lower, upper)
    times = cut_times(case, window, [(window.start, window.stop)])
    work: list[Work] = [((tuple(ends[0]), tuple(ends[1])), Sides([bounded]), times)]
    return prove_on_cells(case, alone, (basis, gains), work, (lower, upper)).cells
