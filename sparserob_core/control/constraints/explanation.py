"""Descriptions of single constraints of a control problem for a reader, and the source of a constraint family.

A description holds the bounded quantity, the time, and the effect of the uncertainty. The source of a family relates a
constraint in own units to the same constraint in the user's units.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, final

import numpy as np

from sparserob_core.brief import ENTRIES, brief
from sparserob_core.control.problem.names import UNNAMED, Names, measured_in, unit_of_row
from sparserob_core.control.problem.units import Units
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import (
    Explanation,
    Formulation,
    SemiInfiniteProgram,
    Unexplained,
    WorstConstraint,
    distinguish_numbers,
)

NEGLIGIBLE_TERM = 1e-12  # of the largest coefficient of a combination, one that is rounding


class ConstraintSource(ABC):
    """A constraint on states or controls, of a control that answers or of one that does not, as the source of a family:
    the same constraint in other units has the same rows but for their factors."""

    @abstractmethod
    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normals ``(r, q)`` of the rows, and the size of a unit of each of their coordinates, ``(q,)``, in
        the user's units, where the constraint itself is in ``units``."""

    def scale(self, x: Array) -> float:
        """Return the size of the smallest row at the decision ``x (n,)``, 1 where no row is smaller."""
        return 1.0

    @property
    def of_state(self) -> ConstraintSource | None:
        """Constraint on the state without feedback; ``None`` for a constraint on controls."""
        return None

    def index_units(self, units: Units) -> Array:
        """Return the units of the first coordinates of a reduced index, in the user's units; further coordinates have
        no unit."""
        return np.array([units.time])


def of_gauge() -> tuple[Array, Array]:
    """Return the normal and the unit of the one row of a curved set of controls, which is in multiples of its gauge in
    any units."""
    return np.ones((1, 1)), np.ones(1)


@final
@dataclass(frozen=True, eq=False)
class Witness(WorstConstraint):
    """The worst constraint of a control problem, with its ``time``, parameter ``(nu,)``, worst disturbance
    ``(mw, pieces)`` and worst ``initial_state (d,)`` where it has them; ``corner``: of parameters beside the time those
    that it is about, in words."""

    time: float | None = None
    parameter: Array | None = None
    disturbance: Array | None = field(default=None, repr=False)
    initial_state: Array | None = None
    corner: str = ""

    __repr__ = brief


@final
@dataclass(frozen=True, eq=False)
class TimedExplanation(Explanation):
    """Description of one constraint at a time and a parameter, with its worst uncertainty.

    A constraint on the state compares a ``quantity`` such as ``x1(5)`` with a ``limit``. Words show the numbers, and
    the ``direction``, divided by ``scale``.

    Parameters
    ----------
    text : str
        The statement, with notes.
    constraint : str
        Name of the constraint.
    statement : str
        Requirement of the constraint.
    time : float
        Time of the constraint.
    direction : ndarray
        Normal, on the state or on the control.
    parameter : ndarray, shape (nu,), optional
        Parameter of the constraint.
    disturbance : ndarray, shape (mw, pieces), optional
        Worst disturbance.
    initial_state : ndarray, shape (d,), optional
        Worst initial state, where there is more than one.
    deviation : ndarray, shape (d,), optional
        Deviation of ``initial_state`` from the centre of the initial states.
    cause : str
        Uncertain quantities that move the quantity.
    quantity : str
        Bounded quantity in words.
    bound : str
        Range of the quantity in words, such as ``|x1| <= 0.3``.
    limit : float
        Limit of the quantity.
    free : float
        Value of the quantity without control and uncertainty.
    sigma : float
        Distance by which the uncertain disturbance and initial state (the ``cause``) move the quantity towards the
        limit.
    sign : float
        -1 for a lower limit, else 1.
    where : str
        Parameter in words.
    scale : float
        Divisor of the numbers in words.
    names : Names
        Names of the states.
    gain : ndarray, shape (m,), optional
        Part of the normal on the control, for a mixed constraint.
    piece : int, optional
        Piece of the control in a mixed constraint.
    noise : ndarray, shape (K, p), optional
        Worst noise of the measurement at every breakpoint of the control, where there is a noise.
    following : ndarray, shape (d,), optional
        Deviation of the next period's initial state, for a step across the seam of a plan that repeats.
    """

    decides: ClassVar[str] = "control"

    constraint: str
    statement: str
    time: float
    direction: Array
    parameter: Array | None = None
    disturbance: Array | None = None
    initial_state: Array | None = None
    deviation: Array | None = None
    cause: str = "disturbance"
    quantity: str = ""
    bound: str = ""
    limit: float = np.nan
    free: float = np.nan
    sigma: float = 0.0
    sign: float = 1.0
    where: str = ""
    scale: float = 1.0
    names: Names = UNNAMED
    gain: Array | None = None
    piece: int | None = None
    noise: Array | None = None
    following: Array | None = None

    def witness(self, worst: WorstConstraint) -> WorstConstraint:
        return Witness(
            worst.violation,
            worst.constraint,
            worst.index,
            worst.row,
            worst.formulation,
            self.time,
            self.parameter,
            self.disturbance,
            self.initial_state,
            self.where if self.names.corners else "",
        )

    def parameter_or(self, middle: Array) -> Array:
        """Return the parameter of the constraint, or the ``middle`` where the constraint has none."""
        return middle if self.parameter is None or self.parameter.size == 0 else self.parameter

    def short(self) -> str:
        return f"{self.statement}{self._where_clause}"

    @property
    def alike(self) -> str:
        return self.statement if self.names.corners else ""

    def of_sample(self, number: int) -> Explanation:
        return Unexplained(f"{self.statement} (sample {number})")

    def from_any_state(self) -> TimedExplanation:
        """Return the description for a free initial state; at time 0 it has no notes, which would give the value from
        the given initial state."""
        return replace(self, text=self.statement) if self.time == 0.0 else self

    def beyond(self, amount: float) -> str:
        if not self.quantity:
            return super().beyond(amount)
        value, shift = (self.free + self.sign * self.sigma) / self.scale, self.sigma / self.scale
        also = "" if " and " in self.cause else "s"
        clause = (
            f" under the worst {self.cause}, which move{also} it by {shift:.4g}{self._unit_suffix},"
            if self.sigma > 0
            else ""
        )
        return (
            f"{self.quantity} = {value:.6g}{self._unit_suffix}{clause} is outside {self.bound} ({self.constraint}), "
            f"whatever the decision{self._where_clause}"
        )

    def apart(self, other: Explanation, share: float, amount: float) -> str:
        has_quantities = isinstance(other, TimedExplanation) and self.quantity and other.quantity
        if not isinstance(other, TimedExplanation) or not has_quantities:
            return super().apart(other, share, amount)
        if self.gain is not None or other.gain is not None:
            gain, other_gain = (np.zeros(1) if side.gain is None else side.gain for side in (self, other))
            gains_differ = np.abs(gain + share * other_gain) > NEGLIGIBLE_TERM * max(
                np.abs(gain).max(), np.abs(other_gain).max()
            )
            differs = np.abs(self.direction + share * other.direction) > NEGLIGIBLE_TERM * np.abs(self.direction).max(
                initial=0.0
            )
            if gains_differ.any() or differs.any():
                return super().apart(other, share, amount)
        residual = self.direction + share * other.direction
        residual = np.where(np.abs(residual) <= NEGLIGIBLE_TERM * np.abs(self.direction).max(), 0.0, residual)
        allowed = self.sign * self.limit + share * other.sign * other.limit
        shift = self.sigma + share * other.sigma
        if residual.any():
            return self._describe_uncontrollable(other, residual, share, allowed, shift)
        if shift > 0:
            shift_words, room_words = distinguish_numbers(shift / 2 / self.scale, allowed / 2 / self.scale)
            verb = "move" if " and " in self.cause else "moves"
            return (
                f"the {self.cause} alone {verb} {self.quantity} by {shift_words}{self._unit_suffix}, {self._set_name}"
                f" allows {room_words}{self._unit_suffix}{self._where_clause}"
            )
        return f"{self.text} and {other.text} leave nothing between them{self._where_clause}"

    def _describe_uncontrollable(
        self, other: TimedExplanation, rest: Array, share: float, allowed: float, shift: float
    ) -> str:
        """Return the sentence for two rows whose quantities the control moves alike, so that it cannot change their
        combination ``rest'x``."""
        side = -1.0 if rest[np.flatnonzero(rest)[0]] < 0 else 1.0
        free = (self.sign * self.free + share * other.sign * other.free) / self.scale
        rest, allowed, shift = rest / self.scale, allowed / self.scale, shift / self.scale
        relation = "at least" if side < 0 else "at most"
        unit = measured_in(rest, self.names)
        note = f" less {shift:.4g}{unit} for the worst {self.cause}s" if shift > 0 and side > 0 else ""
        note = f" and {shift:.4g}{unit} more for the worst {self.cause}s" if shift > 0 and side < 0 else note
        user_normal, corner = _separate_corner(rest, self.names)
        quantity, at = combination(side * user_normal, self.names, f"({self.time:.6g})"), self._where_clause
        asking = f"{self.statement} and {other.statement} ask"
        if self.names.corners and corner is None:  # the two are about different corners
            first, second = sorted(
                [self._describe_share(side), other._describe_share(side * share)], key=lambda term: term[0] == "-"
            )
            single = second[0] == "-" and not any(joint in second for joint in (" + ", " - "))
            quantity, at = f"{first} less {second[1:]}" if single else f"{first} plus {second}", ""
            asking = f"{self.short()}, and {other.short()}, ask"
        return (
            f"the control cannot move {quantity}, which is {side * free:.6g}{unit}, "
            f"but {asking} for {relation} {side * allowed:.6g}{unit}{note}{at}"
        )

    def _describe_share(self, share: float) -> str:
        """Return ``share`` times the bounded quantity in words, with the parameters that it belongs to."""
        normal = share / self.scale * _separate_corner(self.direction, self.names)[0]
        return combination(normal, self.names, f"({self.time:.6g})") + (f" at {self.where}" if self.where else "")

    def out_of_reach(self, amount: float, needed: float) -> str:
        if not self.quantity:
            return super().out_of_reach(amount, needed)
        amount, needed = amount / self.scale, needed / self.scale
        if needed - amount < 0:
            return (
                f"{self.text} is violated by at least {amount:.4g}{self._unit_suffix}, whatever the control"
                f"{self._where_clause}"
            )
        verb = "raise" if self.sign < 0 else "lower"
        note = (
            f", {self.sigma / self.scale:.4g}{self._unit_suffix} of it for the worst {self.cause}"
            if self.sigma > 0
            else ""
        )
        can, must = distinguish_numbers(needed - amount, needed)
        return (
            f"the control can {verb} {self.quantity} by at most {can}{self._unit_suffix}, and {must}{self._unit_suffix}"
            f" is needed{note}: without control it is {self.free / self.scale:.4g}{self._unit_suffix}, {self._set_name}"
            f" asks for {self.bound}{self._where_clause}"
        )

    @property
    def unit(self) -> str:
        """Unit of the quantity; empty where it is not known."""
        return self._unit_suffix.strip()

    @property
    def _unit_suffix(self) -> str:
        normal = self.direction if self.gain is None else np.concatenate([self.direction, self.gain])
        return measured_in(normal, self.names, self.direction.size)

    @property
    def _where_clause(self) -> str:
        return f", at {self.where}" if self.where and self.time else ""

    @property
    def _set_name(self) -> str:
        return {"terminal": "the terminal set", "path": "the path set"}.get(self.constraint, self.constraint)


def in_numbers(
    program: SemiInfiniteProgram, name: str, formulation: Formulation, index: Array, row: int
) -> TimedExplanation | None:
    """Return the description of one constraint of a program, with its numbers; ``None`` where the index does not hold
    them, as where it is the number of a sample."""
    family = program.formulated(name, formulation)
    description = None if family is None else family.explanation(index, row)
    return description if isinstance(description, TimedExplanation) else None


def explanation(
    name: str,
    functionals: WorstFunctionals,
    H: Array,
    h: Array,
    row: int,
    time: float,
    parameter: Array,
    scale: float = 1.0,
    mixed: tuple[Array, int] | None = None,
) -> TimedExplanation:
    """Return the description of row ``row`` of ``H x(t) <= h`` at a time and a parameter.

    Parameters
    ----------
    name : str
        Name of the constraint.
    functionals : WorstFunctionals
        Functionals of the system.
    H : ndarray, shape (r, d)
        Normals on the state.
    h : ndarray, shape (r,)
        Right-hand sides.
    row : int
        Number of the row.
    time : float
        Time of the constraint.
    parameter : ndarray, shape (nu,)
        Parameter of the constraint.
    scale : float, default 1
        Divisor of the numbers in words.
    mixed : tuple of (ndarray, int), optional
        ``G (r, m)`` of a mixed constraint ``H x + G u <= h``, and the piece of the control.

    Returns
    -------
    TimedExplanation
        Bounded quantity, time, and effect of the uncertainty.
    """
    direction, system = H[row], functionals.response.system
    gain = None if mixed is None else mixed[0][row]
    normal = direction if gain is None else np.concatenate([direction, gain])
    user_normal, corner = _separate_corner(normal, functionals.names)
    sign = -1.0 if np.count_nonzero(user_normal) == 1 and user_normal.sum() < 0 else 1.0
    contributions = functionals.parts(time, direction, parameter)
    sigma = contributions.sigma
    free, limit = sign * contributions.free + 0.0, sign * float(h[row]) + 0.0  # no negative zeros
    names = [
        name
        for name, distance in (
            ("disturbance", sigma - contributions.initial_support),
            ("initial state", contributions.initial_support),
        )
        if distance > NEGLIGIBLE_TERM * sigma
    ]
    cause = " and ".join(names) or "disturbance"
    quantity, where = (
        combination(sign * user_normal / scale, functionals.names, f"({time:.6g})", direction.size),
        system.describe(parameter) if parameter.size else corner or "",
    )
    unit = unit_of_row(normal / scale, functionals.names, direction.size)
    remarks = [f"the initial state gives {free / scale:.6g}{unit}"] if time <= 0 else []
    remarks += (
        [f"the {cause} alone {'move' if len(names) > 1 else 'moves'} it by {sigma / scale:.4g}{unit}"]
        if sigma > 0
        else []
    )
    remarks += [f"at {where}"] if where else []
    statement = f"{name}: {quantity} {'>=' if sign < 0 else '<='} {limit / scale:.6g}{unit}"
    opposite = _find_opposite_limit(H if mixed is None else np.hstack([H, mixed[0]]), h, row)
    return TimedExplanation(
        f"{statement} ({', '.join(remarks)})" if remarks else statement,
        name,
        statement,
        time,
        direction,
        parameter,
        contributions.disturbance,
        None if contributions.deviation is None else functionals.response.initial_state + contributions.deviation,
        contributions.deviation,
        cause,
        quantity=quantity,
        bound=_format_bound(
            combination(sign * user_normal / scale, functionals.names, states=direction.size),
            limit / scale,
            None if opposite is None else opposite / scale,
            sign,
        )
        + unit,
        limit=limit,
        free=free,
        sigma=sigma,
        sign=sign,
        where=where,
        scale=scale,
        names=functionals.names,
        gain=gain,
        piece=None if mixed is None else mixed[1],
    )


def _separate_corner(normal: Array, names: Names) -> tuple[Array, str | None]:
    """Return a normal on the states that were stated, and the corner of the parameters beside the time that it is
    about; itself, and ``None``, where it is about several at once."""
    corner = names.corners.at(normal)
    return (normal, None) if corner is None else (names.corners.without(normal), corner)


def combination(direction: Array, names: Names, suffix: str = "", states: int | None = None) -> str:
    """Return ``c'x`` in words, such as ``x1(5)`` or ``x1(5) - 0.5 x2(5)``; the suffix stands behind every state's name.
    What is beyond the number of ``states`` is the control's, such as ``u1(5)``. Of more than `ENTRIES` terms the
    largest, and how many more there are."""
    last = direction.size if states is None else states
    words: list[str] = []
    terms = np.flatnonzero(direction)
    largest = np.argsort(-np.abs(direction[terms]), kind="stable")[:ENTRIES]
    for state in terms[np.sort(largest)]:
        size = abs(direction[state])
        sign = "-" if direction[state] < 0 else "+" if words else ""
        name = names.state(int(state)) if state < last else names.control(int(state) - last)
        words.append(f"{sign}{' ' if words else ''}{'' if size == 1 else f'{size:.4g} '}{name}{suffix}")
    remaining = terms.size - largest.size
    if remaining:
        words.append(f"+ ... ({remaining} smaller term{'s' if remaining > 1 else ''})")
    return " ".join(words) or "0"


def _find_opposite_limit(H: Array, h: Array, row: int) -> float | None:
    """Return the least right-hand side of the rows that look the other way; ``None`` without one."""
    limits = h[(-H[row] == H).all(axis=1)]
    return float(limits.min()) if limits.size else None


def _format_bound(words: str, limit: float, opposite: float | None, sign: float) -> str:
    """Return ``|x1| <= 0.7``, ``-0.2 <= x1 <= 0.3`` or ``x1 >= -0.7``, of a quantity in words."""
    if opposite is None:
        return f"{words} {'>=' if sign < 0 else '<='} {limit:.6g}"
    low, high = sorted([limit, -sign * opposite + 0.0])
    return f"|{words}| <= {high:.6g}" if low == -high else f"{low:.6g} <= {words} <= {high:.6g}"
