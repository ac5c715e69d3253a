"""The lower bound that the multipliers of a certificate prove.

Each multiplier names a constraint of the problem, at a time and a parameter. Where the control answers deviations, it
also names the deviations; elsewhere the constraint is taken at the worst ones."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.claims.answers import PEAK, WORST, NamedDeviations, feedback_of
from sparserob_core.checker.claims.case import EQUALS, STEP, Case, listed, nominal_parameter, number, numbers, shaped
from sparserob_core.checker.claims.constraints import compute_middle_effect
from sparserob_core.checker.claims.window import ConstraintWindow
from sparserob_core.checker.cost.duality import EFFORT, ConstraintRow
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.sip.convex_set import Array

MAX_MULTIPLIERS = 100_000  # multipliers that are checked


def multiplied(case: Case, priced: bool) -> arb:
    """Return a ball whose lower end is the bound that the certificate's multipliers prove: of the cost where
    ``priced``, else of the weighted sum of constraints, where a positive one proves that no control is feasible."""
    data = case.certificate.get("multipliers")
    rows, pieces = weighted(case, data)
    price, touched = (case.price, touched_by(case, data)) if priced else (None, None)
    feedback, norms = feedback_of(case), norms_of(case, data) if priced else None
    duality = replace(case.duality, range=feedback.range)
    bound = duality.bound(rows, pieces, price, touched, not feedback.charges_bounds, norms)
    return bound + feedback.least(rows, priced)


def weighted(case: Case, data: object) -> tuple[list[tuple[float, ConstraintRow]], Any]:
    """Return the ``multipliers`` of a certificate, or a part of the same form, with their constraints; and those ``(m,
    K)`` of the control's pieces, ``None`` where every piece has a function of its own."""
    if data is None:
        raise Unchecked("the certificate holds no multipliers, which this method does not offer")
    if not isinstance(data, Mapping):
        raise Broken("multipliers: expected those of constraints, equalities and pieces")
    entries, m = listed(data, "constraints"), case.problem.system.controls
    if len(entries) > MAX_MULTIPLIERS:
        raise Broken(f"{len(entries)} multipliers are too many to be checked")
    rows = [weighted_row for entry in entries for weighted_row in rows_of(case, entry)]
    nu = numbers(listed(data, "equalities"), "equalities")
    if nu.shape != (0 if case.answering else len(case.equalities),):  # under feedback they are constraints
        raise Broken(f"{nu.size} multipliers of equalities, expected {len(case.equalities)}")
    for multiplier, (state, value) in zip(nu.tolist(), case.equalities, strict=False):
        direction = np.eye(case.problem.system.states)[state]
        row = case.duality.row(
            direction, case.problem.horizon, nominal_parameter(case.problem), ball(value), disturbed=False
        )
        # a disturbance of one point counts; where none may reach the state, any member of its set may stand for it
        rows.append((multiplier, replace(row, constant=row.constant + compute_middle_effect(case, state))))
    if case.problem.jitter and data.get("late") is not None:  # any are valid, 0 too
        rows.append((1.0, case.duality.bound_changes(rows, shaped(data, "late", (m, case.control.pieces - 1)))))
    if case.control.functions >= case.control.pieces:  # every piece has a function of its own
        return rows, None
    return rows, shaped(data, "pieces", (m, case.control.pieces))


def touched_by(case: Case, data: object) -> Sequence[arb_mat] | None:
    """Return the control ``(m, 1)`` on every piece at which the certificate replaces the cost by its tangent; ``None``
    where the cost has neither quadratic terms, which must be convex, nor norms of groups."""
    if not (case.price.is_quadratic or any(len(block) > 1 for block in case.price.blocks)):
        return None
    entries = data if isinstance(data, Mapping) else {}
    tangent = shaped(entries, "tangent", (case.problem.system.controls, case.control.functions))
    case.price.convex()
    return case.on_pieces(tangent)


def norms_of(case: Case, data: object) -> Array | None:
    """Return the vectors ``(m, K)`` that the certificate offers in the place of norms of the control, or ``None``."""
    if not isinstance(data, Mapping) or data.get("norms") is None:
        return None
    return shaped(data, "norms", (case.problem.system.controls, case.control.pieces))


def rows_of(case: Case, entry: object) -> list[tuple[float, ConstraintRow]]:
    """Return an entry's multiplier with its constraint, which must be one of the problem's. Under feedback a step
    across the seam gives two: on the last control of a period and on the first of the next, which answer different
    innovations."""
    case.clock.check()
    if not isinstance(entry, Mapping):
        raise Broken("multipliers: expected a constraint, a time, a parameter, a direction and a number each")
    name = str(entry.get("constraint"))
    direction, time = numbers(entry.get("direction"), f"{name}: direction"), number(entry, "time")
    y, parameter = number(entry, "multiplier"), numbers(entry.get("parameter", []), f"{name}: parameter")
    if not y > 0:
        raise Broken(f"a multiplier of {name} is {y!r}, expected a positive number")
    if parameter.size:  # constraints on the control alone have none
        sized(parameter, case.problem.system.parameter_count, name)
    named = feedback_of(case).named(entry, name) if case.answering else None
    if any(window.name == name for window in case.windows) or (case.answering and name == EQUALS and case.equalities):
        return [(y, _derive_state_row(case, entry, (name, direction, time, parameter), named))]
    if name == EFFORT and case.charge == WORST:
        return [(y, _derive_effort_row(case, direction, named))]
    sized(direction, case.problem.system.controls, name)
    if name in (case.of_control, PEAK) and (name != PEAK or _charges_peaks(case)):
        return [(y, _derive_control_row(case, name, direction, time, named))]
    if name != STEP:
        raise Broken(f"the problem has no constraint {name!r}")
    row = case.duality.step_row(direction, time)
    if named is None:
        return [(y, row)]
    answered_row = _answer(case, row, named)
    if time != float(case.control.breakpoints[-1]):
        return [(y, answered_row)]
    next_deviations, zero = feedback_of(case).following(named, entry, name), ball(0)
    zero_slopes = [[zero] * direction.size] * (case.control.pieces - 1)
    return [
        (y, replace(answered_row, slope=[*zero_slopes, balls(-direction)])),
        (y, ConstraintRow(zero, [balls(direction), *zero_slopes], None, next_deviations.answered)),
    ]


def _derive_state_row(
    case: Case, entry: Mapping[str, Any], said: tuple[str, Array, float, Array], named: NamedDeviations | None
) -> ConstraintRow:
    """Return the constraint on the state, and on the control of a piece where it is mixed, that an entry names."""
    name, direction, time, parameter = said
    window = None if name == EQUALS and case.equalities else case.window(name)
    sized(direction, case.problem.system.states if window is None else window.shape.dimension, name)
    if window is not None:
        admissible(case, window, time, parameter)
    row = _derive_base_row(case, window, entry, said)
    if named is None:
        return row
    contribution = named.given(direction[: case.problem.system.states], time)
    return _answer(case, replace(row, constant=row.constant + contribution), named)


def _answer(case: Case, row: ConstraintRow, named: NamedDeviations) -> ConstraintRow:
    """Return a row on the control under named deviations as one on the decided part of the control, which answers
    them."""
    return feedback_of(case).on_decided(replace(row, deviations=named.answered), named)


def _charges_peaks(case: Case) -> bool:
    """Return whether numbers bound the control from both sides: its peaks, or beside an inner loop the absolute values
    of the nominal control."""
    return feedback_of(case).charges_bounds and case.charge != WORST


def _name_row(_: Case, window: object, entry: Mapping[str, Any], said: tuple[str, Array, float, Array]) -> Hashable:
    name, direction, time, parameter = said
    return name, time, tuple(direction.tolist()), tuple(parameter.tolist()), repr(entry.get("piece"))


@remembered(key=_name_row)
def _derive_base_row(
    case: Case, window: ConstraintWindow | None, entry: Mapping[str, Any], said: tuple[str, Array, float, Array]
) -> ConstraintRow:
    """Return the constraint on the state for the worst deviations, or without any where the control answers them."""
    _, direction, time, parameter = said
    c, gain = np.split(direction, [case.problem.system.states])
    limit = fixed_limit(case, direction, time) if window is None else window.limit(direction, time)
    row = case.duality.row(c, time, parameter.tolist(), limit, disturbed=not case.answering)
    measurable_input = case.sources.measurable_input_at(parameter.tolist())
    if measurable_input is not None:
        row = replace(row, constant=row.constant + ball(measurable_input.added(c, time)[0]))
    sizes, early_bound = case.sources.erring(c, time, parameter.tolist())
    late = None if sizes is None or not case.problem.jitter else sizes[1::2]
    row = replace(row, constant=row.constant + early_bound, sizes=sizes if late is None else None, late=late)
    if window is not None and window.is_mixed:
        piece = piece_of(case, window, entry, time)
        row.slope[piece] = [a + b for a, b in zip(row.slope[piece], balls(gain), strict=True)]
    return row


def _derive_control_row(
    case: Case, name: str, direction: Array, time: float, named: NamedDeviations | None
) -> ConstraintRow:
    """Return the constraint on the control of one piece: it is in its set, or a channel is at most its peak."""
    row, piece = case.duality.control_row(direction, time), case.duality.control_piece(time)
    if named is not None:
        named = named.middles if name == PEAK and case.charge != PEAK else named  # then the nominal control is charged
        row = _answer(case, row, named)
    if name != PEAK:
        return row
    if sorted(np.abs(direction).tolist()) != [0.0] * (direction.size - 1) + [1.0]:
        raise Broken(f"{name}: the direction {direction.tolist()} is not that of a peak of this policy")
    limit = case.duality.control_row(direction, time).constant
    return replace(row, constant=row.constant - limit, charged=(piece, int(np.abs(direction).argmax())))


def _derive_effort_row(case: Case, shares: Array, named: NamedDeviations | None) -> ConstraintRow:
    """Return the constraint that the control, each entry times a share of ``[-1, 1]``, is at most the effort."""
    K, m = case.control.pieces, case.problem.system.controls
    if shares.shape != (m * K,) or not (np.abs(shares) <= 1.0).all():
        raise Broken(f"{EFFORT}: expected {m * K} numbers from -1 to 1")
    slope = [
        [price * ball(shares[i * K + k]) for i, price in enumerate(costs)] for k, costs in enumerate(case.price.costs)
    ]
    row = ConstraintRow(ball(0), slope, None, (), EFFORT)
    return row if named is None else _answer(case, row, named)


def fixed_limit(case: Case, direction: Array, time: float) -> arb:
    """Return the value of ``c'x(T)`` for a direction ``c (d,)`` of one fixed state or its opposite. Raise `Broken` for
    any other direction or time."""
    values = dict(case.equalities)
    states = np.flatnonzero(direction).tolist()
    if len(states) != 1 or states[0] not in values or time != case.problem.horizon:
        raise Broken(f"{EQUALS}: the direction {direction.tolist()} at t = {time!r} is not that of a fixed final state")
    return ball(direction[states[0]]) * ball(values[states[0]])


def piece_of(case: Case, window: ConstraintWindow, entry: Mapping[str, Any], time: float) -> int:
    """Return the number of the control's piece that an entry names for a mixed constraint. Raise `Broken` unless that
    piece holds the time and meets the window in positive length."""
    piece = entry.get("piece")
    if type(piece) is not int:
        raise Broken(f"{window.name}: piece is {piece!r}, expected the number of a piece of the control")
    window.meets(case.control.breakpoints.tolist(), piece, time)
    return piece


def admissible(case: Case, window: ConstraintWindow, time: float, parameter: Array) -> None:
    """Raise `Broken` unless the time is in the window of a constraint and the parameter is shown to be in its set."""
    asked(case, window, time, parameter)
    if case.problem.system.parameters is not None and not known(case.problem.system.parameters).contains(parameter):
        raise Broken(f"{window.name}: the parameter {parameter.tolist()} is not shown to be in its set")


def asked(case: Case, window: ConstraintWindow, time: float, parameter: Array) -> None:
    """Raise `Broken` unless the time is in the window of a constraint and the parameter has the right size."""
    sized(parameter, case.problem.system.parameter_count, f"{window.name}: parameter")
    if not window.start <= time <= window.stop:
        raise Broken(f"{window.name}: t = {time!r} is not within {window.start:g} to {window.stop:g}")


def sized(vector: Array, size: int, name: str) -> None:
    """Raise `Broken` unless a vector has the expected size."""
    if vector.shape != (size,):
        raise Broken(f"{name}: {vector.size} numbers where {size} are expected")
