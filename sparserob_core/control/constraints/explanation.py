"""One constraint of a control problem for people: what is bounded, when, and what the uncertainty does to it; and how a
constraint in own units is told in the user's."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import ClassVar, final

import numpy as np

from sparserob_core.brief import ENTRIES, brief
from sparserob_core.control.problem.names import UNNAMED, Names, measured_in, unit_of_row
from sparserob_core.control.problem.units import Units
from sparserob_core.control.reach.functional import WorstCase
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import (
    Explanation,
    Formulation,
    SemiInfiniteProgram,
    Unexplained,
    WorstConstraint,
    told_apart,
)

SAME = 1e-12  # of the largest coefficient of a combination, one that is rounding


class Source(ABC):
    """A constraint on states or controls, of a control that answers or of one that does not, as the source of a family:
    the same constraint in other units has the same rows but for their factors."""

    @abstractmethod
    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """The normals of its rows, ``(r, q)``, and what one of each of their coordinates ``(q,)`` is in the user's
        units, where its own are ``units``."""

    def scale(self, x: Array) -> float:
        """Return the size of the smallest row at the decision ``x (n,)``, 1 where no row is smaller."""
        return 1.0

    @property
    def of_state(self) -> Source | None:
        """The same constraint on the state where the control answers nothing; ``None`` for one on controls."""
        return None

    def index_units(self, units: Units) -> Array:
        """What one of the first coordinates of a reduced index is in the user's units; further ones have none."""
        return np.array([units.time])


def of_gauge() -> tuple[Array, Array]:
    """The one row of a curved set of controls, which is in multiples of its gauge in any units."""
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
    """One constraint at a ``time`` and a parameter ``(nu,)``, with the worst disturbance ``(mw, pieces)`` there, the
    worst initial state ``begun (d,)`` where there is more than one, and the normal ``direction`` (of the state, or of
    the control).

    ``statement`` is what it asks for, ``text`` the same with remarks. A constraint on the state compares a ``quantity``
    such as ``x1(5)`` with a ``limit``: ``bound`` is what the quantity may be (``|x1| <= 0.3``), ``free`` its value
    without control and uncertainty, ``sign`` -1 for a lower limit, ``sigma`` how far what is uncertain of disturbance
    and initial state (the ``cause``) moves it towards the limit, ``where`` the parameter in words. ``constraint``: the
    name of the constraint. Words say all of these, and the ``direction``, divided by ``scale``; ``names``: what the
    states are called. ``deviation (d,)`` is that of ``begun`` from the centre of the initial states. ``gain (m,)``: the
    part of the normal on the control, of a mixed constraint, and ``piece`` the piece of the control that it looks at.
    ``changes``: when each of the disturbance's pieces begins, where that depends on the constraint. ``noise (K, p)``:
    the worst noise of what is measured at every breakpoint of the control, where there is any. ``following (d,)``: the
    deviation of the next period's initial state, of a step across the seam of a plan that repeats.
    """

    decides: ClassVar[str] = "control"

    constraint: str
    statement: str
    time: float
    direction: Array
    parameter: Array | None = None
    disturbance: Array | None = None
    begun: Array | None = None
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
    changes: Array | None = None
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
            self.begun,
            self.where if self.names.corners else "",
        )

    def parameter_or(self, middle: Array) -> Array:
        """Its parameter; the ``middle`` of a constraint without uncertainty."""
        return middle if self.parameter is None or self.parameter.size == 0 else self.parameter

    def short(self) -> str:
        return f"{self.statement}{self._at}"

    @property
    def alike(self) -> str:
        return self.statement if self.names.corners else ""

    def of_sample(self, number: int) -> Explanation:
        return Unexplained(f"{self.statement} (sample {number})")

    def from_any_state(self) -> TimedExplanation:
        """The same where the initial state is free: at time 0 without what the given one says."""
        return replace(self, text=self.statement) if self.time == 0.0 else self

    def beyond(self, amount: float) -> str:
        if not self.quantity:
            return super().beyond(amount)
        reached, pushed = (self.free + self.sign * self.sigma) / self.scale, self.sigma / self.scale
        also = "" if " and " in self.cause else "s"
        moved = (
            f" under the worst {self.cause}, which move{also} it by {pushed:.4g}{self._in}," if self.sigma > 0 else ""
        )
        return (
            f"{self.quantity} = {reached:.6g}{self._in}{moved} is outside {self.bound} ({self.constraint}), "
            f"whatever the decision{self._at}"
        )

    def apart(self, other: Explanation, share: float, amount: float) -> str:
        known = isinstance(other, TimedExplanation) and self.quantity and other.quantity
        if not isinstance(other, TimedExplanation) or not known:
            return super().apart(other, share, amount)
        if self.gain is not None or other.gain is not None:
            left, right = (np.zeros(1) if one.gain is None else one.gain for one in (self, other))
            off = np.abs(left + share * right) > SAME * max(np.abs(left).max(), np.abs(right).max())
            turned = np.abs(self.direction + share * other.direction) > SAME * np.abs(self.direction).max(initial=0.0)
            if off.any() or turned.any():
                return super().apart(other, share, amount)
        rest = self.direction + share * other.direction
        rest = np.where(np.abs(rest) <= SAME * np.abs(self.direction).max(), 0.0, rest)
        allowed = self.sign * self.limit + share * other.sign * other.limit
        moved = self.sigma + share * other.sigma
        if rest.any():
            return self._uncontrollable(other, rest, share, allowed, moved)
        if moved > 0:
            more, less = told_apart(moved / 2 / self.scale, allowed / 2 / self.scale)
            verb = "move" if " and " in self.cause else "moves"
            return (
                f"the {self.cause} alone {verb} {self.quantity} by {more}{self._in}, {self._set} allows"
                f" {less}{self._in}{self._at}"
            )
        return f"{self.text} and {other.text} leave nothing between them{self._at}"

    def _uncontrollable(self, other: TimedExplanation, rest: Array, share: float, allowed: float, moved: float) -> str:
        """The control moves both quantities alike, so that it cannot change ``rest'x``, a combination of them."""
        side = -1.0 if rest[np.flatnonzero(rest)[0]] < 0 else 1.0
        free = (self.sign * self.free + share * other.sign * other.free) / self.scale
        rest, allowed, moved = rest / self.scale, allowed / self.scale, moved / self.scale
        most = "at least" if side < 0 else "at most"
        unit = measured_in(rest, self.names)
        taken = f" less {moved:.4g}{unit} for the worst {self.cause}s" if moved > 0 and side > 0 else ""
        taken = f" and {moved:.4g}{unit} more for the worst {self.cause}s" if moved > 0 and side < 0 else taken
        stated, corner = _stated(rest, self.names)
        quantity, at = combination(side * stated, self.names, f"({self.time:.6g})"), self._at
        asking = f"{self.statement} and {other.statement} ask"
        if self.names.corners and corner is None:  # the two are about different corners
            first, second = sorted([self._share(side), other._share(side * share)], key=lambda one: one[0] == "-")
            single = second[0] == "-" and not any(joint in second for joint in (" + ", " - "))
            quantity, at = f"{first} less {second[1:]}" if single else f"{first} plus {second}", ""
            asking = f"{self.short()}, and {other.short()}, ask"
        return (
            f"the control cannot move {quantity}, which is {side * free:.6g}{unit}, "
            f"but {asking} for {most} {side * allowed:.6g}{unit}{taken}{at}"
        )

    def _share(self, share: float) -> str:
        """So much of the quantity that is bounded, in words, with the parameters that it is about."""
        told = share / self.scale * _stated(self.direction, self.names)[0]
        return combination(told, self.names, f"({self.time:.6g})") + (f" at {self.where}" if self.where else "")

    def out_of_reach(self, amount: float, needed: float) -> str:
        if not self.quantity:
            return super().out_of_reach(amount, needed)
        amount, needed = amount / self.scale, needed / self.scale
        if needed - amount < 0:
            return f"{self.text} is violated by at least {amount:.4g}{self._in}, whatever the control{self._at}"
        verb = "raise" if self.sign < 0 else "lower"
        pushed = f", {self.sigma / self.scale:.4g}{self._in} of it for the worst {self.cause}" if self.sigma > 0 else ""
        can, must = told_apart(needed - amount, needed)
        return (
            f"the control can {verb} {self.quantity} by at most {can}{self._in}, and {must}{self._in} is needed"
            f"{pushed}: without control it is {self.free / self.scale:.4g}{self._in}, {self._set} asks for"
            f" {self.bound}{self._at}"
        )

    @property
    def unit(self) -> str:
        """What the quantity is measured in; empty where that is not known."""
        return self._in.strip()

    @property
    def _in(self) -> str:
        normal = self.direction if self.gain is None else np.concatenate([self.direction, self.gain])
        return measured_in(normal, self.names, self.direction.size)

    @property
    def _at(self) -> str:
        return f", at {self.where}" if self.where and self.time else ""

    @property
    def _set(self) -> str:
        return {"terminal": "the terminal set", "path": "the path set"}.get(self.constraint, self.constraint)


def in_numbers(
    program: SemiInfiniteProgram, name: str, formulation: Formulation, index: Array, row: int
) -> TimedExplanation | None:
    """One constraint of a program in numbers; ``None`` for one whose index does not say them, such as the number of a
    sample."""
    family = program.formulated(name, formulation)
    said = None if family is None else family.explanation(index, row)
    return said if isinstance(said, TimedExplanation) else None


def explanation(
    name: str,
    functionals: WorstCase,
    H: Array,
    h: Array,
    row: int,
    time: float,
    parameter: Array,
    scale: float = 1.0,
    mixed: tuple[Array, int] | None = None,
) -> TimedExplanation:
    """Row ``row`` of ``H x(t) <= h`` at a time and a parameter ``(nu,)``: what is bounded, when, and what the
    uncertainty does to it; in words divided by ``scale``. ``mixed``: ``G (r, m)`` of ``H x + G u <= h``, and the piece
    of the control."""
    direction, system = H[row], functionals.response.system
    gain = None if mixed is None else mixed[0][row]
    normal = direction if gain is None else np.concatenate([direction, gain])
    stated, corner = _stated(normal, functionals.names)
    sign = -1.0 if np.count_nonzero(stated) == 1 and stated.sum() < 0 else 1.0
    parts = functionals.parts(time, direction, parameter)
    sigma = parts.sigma
    free, limit = sign * parts.free + 0.0, sign * float(h[row]) + 0.0  # no negative zeros
    names = [
        name
        for name, moved in (("disturbance", sigma - parts.begun), ("initial state", parts.begun))
        if moved > SAME * sigma
    ]
    cause = " and ".join(names) or "disturbance"
    quantity, where = (
        combination(sign * stated / scale, functionals.names, f"({time:.6g})", direction.size),
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
    opposite = _opposite(H if mixed is None else np.hstack([H, mixed[0]]), h, row)
    return TimedExplanation(
        f"{statement} ({', '.join(remarks)})" if remarks else statement,
        name,
        statement,
        time,
        direction,
        parameter,
        parts.disturbance,
        None if parts.deviation is None else functionals.response.initial_state + parts.deviation,
        parts.deviation,
        cause,
        quantity=quantity,
        bound=_bound(
            combination(sign * stated / scale, functionals.names, states=direction.size),
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


def _stated(normal: Array, names: Names) -> tuple[Array, str | None]:
    """A normal on the states that were stated, and the corner of the parameters beside the time that it is about;
    itself, and ``None``, where it is about several at once."""
    corner = names.corners.at(normal)
    return (normal, None) if corner is None else (names.corners.without(normal), corner)


def combination(direction: Array, names: Names, suffix: str = "", states: int | None = None) -> str:
    """``c'x`` in words, such as ``x1(5)`` or ``x1(5) - 0.5 x2(5)``; the suffix stands behind every state's name. What
    is beyond the number of ``states`` is the control's, such as ``u1(5)``. Of more than `ENTRIES` terms the largest,
    and how many more there are."""
    last = direction.size if states is None else states
    parts: list[str] = []
    terms = np.flatnonzero(direction)
    largest = np.argsort(-np.abs(direction[terms]), kind="stable")[:ENTRIES]
    for state in terms[np.sort(largest)]:
        size = abs(direction[state])
        sign = "-" if direction[state] < 0 else "+" if parts else ""
        name = names.state(int(state)) if state < last else names.control(int(state) - last)
        parts.append(f"{sign}{' ' if parts else ''}{'' if size == 1 else f'{size:.4g} '}{name}{suffix}")
    left = terms.size - largest.size
    if left:
        parts.append(f"+ ... ({left} smaller term{'s' if left > 1 else ''})")
    return " ".join(parts) or "0"


def _opposite(H: Array, h: Array, row: int) -> float | None:
    """The least right-hand side of the rows that look the other way; ``None`` without one."""
    found = h[(-H[row] == H).all(axis=1)]
    return float(found.min()) if found.size else None


def _bound(words: str, limit: float, opposite: float | None, sign: float) -> str:
    """``|x1| <= 0.7``, ``-0.2 <= x1 <= 0.3`` or ``x1 >= -0.7``, of a quantity in words."""
    if opposite is None:
        return f"{words} {'>=' if sign < 0 else '<='} {limit:.6g}"
    low, high = sorted([limit, -sign * opposite + 0.0])
    return f"|{words}| <= {high:.6g}" if low == -high else f"{low:.6g} <= {words} <= {high:.6g}"
