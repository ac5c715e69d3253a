"""Constraints on the state, and on state and control together, during windows of time: terms of a problem."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Self, TypeAlias, TypeVar, cast, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.sets.sets import Equality, Polytope, cylinder, oblique
from sparserob_core.control.sets.strangers import require_consistent
from sparserob_core.control.term import SAME_TIME, STATES, TIME, UNITLESS, Term, measured, over, timed
from sparserob_core.errors import InputError
from sparserob_core.shapes import dense
from sparserob_core.sip.convex_set import Array, ConvexSet, as_bound

Flat: TypeAlias = tuple[Array, Array | None, Array]
W = TypeVar("W", bound="Window")


def _moved(rows: npt.ArrayLike, begin: float, horizon: float) -> Array:
    """Rows of a time and a point ``(q, 1 + d)``, from ``begin`` on."""
    given = np.asarray(rows, dtype=float)
    shifted = given - np.eye(1, given.shape[1])[0] * begin
    later: Array = shifted[shifted[:, 0] > 0.0]
    if shifted[0, 0] > 0.0:
        return later
    now = [np.interp(0.0, shifted[:, 0], column) for column in shifted[:, 1:].T]
    return np.vstack([[0.0, *now], later])


@final
@dataclass(frozen=True)
class Setting:
    """What a constraint must fit: how many ``states`` and ``controls`` there are, by how much later these act, and the
    horizon."""

    states: int
    controls: int
    delay: float
    horizon: float


class Window(Term, ABC):
    """A constraint that holds from a ``start`` to a ``stop``, wherever it moves: ``relative_to``, under its ``name``
    where it has one. One that is ``lasting`` needs a window of positive length; one that is not ``stated`` is made of
    what is."""

    start: float
    stop: float | None
    name: str | None
    relative_to: npt.ArrayLike | None = None
    lasting: ClassVar[bool] = False
    stated: ClassVar[bool] = True
    among: ClassVar[str] = ""
    """The list of a problem whose rows are its own; none of one that says its `rows` by others."""

    @classmethod
    def of(cls, where: str, entry: object) -> Window:
        """What an entry of a list of such constraints stands for; raises `InputError`."""
        if not isinstance(entry, cls):
            raise InputError(path=where, expected=f"{cls.__name__}(...)", got=type(entry).__name__)
        return entry

    @abstractmethod
    def checked(self, where: str, setting: Setting) -> Self:
        """Itself with arrays of the right shapes, and with its ``stop``; raises `InputError` that begins with
        ``where``."""

    @property
    @abstractmethod
    def bounds(self) -> ConvexSet:
        """The set that a factor enlarges; raises `InputError` where there is none."""

    @abstractmethod
    def scaled(self, factor: float) -> Self:
        """Itself with its `bounds` larger by that factor about their middle."""

    @property
    def restricts(self) -> bool:
        """Whether it excludes anything."""
        return True

    def rows(self, called: str) -> Sequence[Window]:
        """Which bounds of state and control at times (`PathConstraint`, `MixedConstraint`), and of integrals of them
        (`IntegralConstraint`), it is; messages, tables and figures say ``called``."""
        return [replace(cast("Any", self), name=called)]

    def remaining(self, begin: float, horizon: float, **given: Any) -> Self | None:
        end = begin + horizon
        late = over(end, self.start) if self.lasting else not over(self.start, end)
        if late or (self.stop is not None and over(self.stop, begin, horizon)):
            return None
        return super().remaining(begin, horizon, **given)


@dataclass(frozen=True, eq=False)
class PathConstraint(Window):
    """The state stays in ``set`` for all times in ``[start, stop]``; ``stop`` is the horizon when ``None``.

    ``relative_to (q, 1 + d)``: rows of a time and a point, times increasing: then ``x(t) - r(t)`` stays in the set,
    where ``r`` runs from point to point along straight lines. The times cover the window.
    """

    set: ConvexSet = field(metadata=STATES)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    relative_to: npt.ArrayLike | None = field(default=None, metadata=timed(lambda of: of.states, _moved))

    among = "path"

    __repr__ = noun

    @classmethod
    def of(cls, where: str, entry: object) -> Window:
        if isinstance(entry, PathConstraint | MixedConstraint):
            return entry
        return PathConstraint(cast("ConvexSet", entry))  # as which it is checked

    def checked(self, where: str, setting: Setting) -> Self:
        checked_set(where, self.set, setting.states, "states")
        return placed(self, where, setting)

    @property
    def bounds(self) -> ConvexSet:
        return self.set

    @property
    def restricts(self) -> bool:
        return not restricts_nothing(self.set)

    @property
    def flat(self) -> Flat | None:
        """``H``, ``None``, ``h`` of ``H (x(t) - r(t)) <= h``; ``None`` where its set is curved."""
        sides = self.set.halfspaces()
        return None if sides is None else (sides[0], None, sides[1])

    def widened(self, size: int) -> Self:
        """Itself of a state with ``size`` coordinates, of which those beyond its own are free."""
        moved = None if self.relative_to is None else columns(self.relative_to, 1 + size)
        return replace(self, set=cylinder(self.set, size), relative_to=moved)

    def everywhere(self, corners: Sequence[Array], called: str) -> list[Self]:
        """Itself of a larger state ``z``, of the states that are a matrix ``(d, size)`` times ``z``, at all of these
        ``corners``: one constraint, or where its set is curved one for each of them, under the name that it is
        ``called`` by."""
        moved = None if self.relative_to is None else columns(self.relative_to, 1 + corners[0].shape[1])
        found = everywhere(self.set, corners)
        names = [called] if len(found) == 1 else [f"{called} at corner {i}" for i in range(1, len(found) + 1)]
        return [replace(self, name=name, set=one, relative_to=moved) for name, one in zip(names, found, strict=True)]

    def scaled(self, factor: float) -> Self:
        return replace(self, set=self.set.scaled(factor))


@dataclass(frozen=True, eq=False)
class MixedConstraint(Window):
    """``H x(t) + G u(t) <= h`` for all times in ``[start, stop]``; ``H (r, d)``, ``G (r, m)``, ``h (r,)``, a number for
    all rows alike; ``stop`` is the horizon when ``None``.

    It holds on every piece of the control that meets the window in positive length, its ends included, with the control
    of that piece: where the control jumps, with both of its values. ``u(t)`` is the commanded control, delay or not.
    """

    H: npt.ArrayLike = field(metadata=measured(lambda of: 1.0 / of.states))
    G: npt.ArrayLike = field(metadata=measured(lambda of: 1.0 / of.controls))
    h: npt.ArrayLike = field(metadata=UNITLESS)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    lasting = True  # a control lasts
    among = "path"

    __repr__ = noun

    @cached_property
    def set(self) -> Polytope:
        """The set of all ``(x, u)`` that are allowed, ``d + m`` coordinates."""
        return Polytope(np.hstack([np.asarray(self.H), np.asarray(self.G)]), np.asarray(self.h))

    def checked(self, where: str, setting: Setting) -> Self:
        d, m = setting.states, setting.controls
        H, G = coefficients(f"{where}.mixed", H=(self.H, d, "state"), G=(self.G, m, "control"))
        if len(G) != len(H):
            raise InputError(path=f"{where}.mixed.G", expected=f"{len(H)} rows, as H has", got=f"{len(G)}")
        h = as_bound(f"{where}.mixed.h", self.h, len(H))
        if np.isneginf(h).any():
            raise InputError(path=f"{where}.mixed.h", expected="numbers above -inf", got=f"{h.tolist()}")
        found = replace(self, H=H, G=G, h=h)
        try:
            _ = found.set
        except InputError as error:
            raise InputError(error.sentence, path=f"{where}.mixed") from None
        return placed(found, where, setting)

    @property
    def restricts(self) -> bool:
        return not restricts_nothing(self.set)

    @property
    def flat(self) -> Flat:
        """``H``, ``G``, ``h`` of ``H x(t) + G u(t) <= h``."""
        (rows, h), d = self.set.halfspaces(), np.asarray(self.H).shape[1]
        return rows[:, :d], rows[:, d:], h

    def widened(self, size: int) -> Self:
        """Itself of a state with ``size`` coordinates, of which those beyond its own are free."""
        return replace(self, H=columns(self.H, size))

    def everywhere(self, corners: Sequence[Array], called: str) -> list[Self]:
        """Itself of a larger state ``z``, of the states that are a matrix ``(d, size)`` times ``z``, at all of these
        ``corners``, under the name that it is ``called`` by."""
        limits = np.broadcast_to(np.asarray(self.h), len(np.asarray(self.H)))
        H, G, h = at_corners(corners, self.H, self.G, limits)
        return [replace(self, name=called, H=H, G=G, h=h[:, 0])]

    @property
    def bounds(self) -> ConvexSet:
        if not (np.asarray(self.h) > 0.0).all():
            raise InputError("bounds state and control together, and h is not positive: 0 is no middle of it")
        return self.set

    def scaled(self, factor: float) -> Self:
        return replace(self, h=factor * np.asarray(self.h, dtype=float))


def placed(term: W, where: str, setting: Setting) -> W:
    """The constraint with its ``stop`` and its reference as numbers; raises `InputError` that begins with ``where``
    for a window that is none."""
    horizon = setting.horizon
    start, stop = float(term.start), end_of(term.stop, horizon)
    if not 0.0 <= start <= stop <= horizon:
        raise InputError(
            path=where,
            expected=f"0 <= from <= to <= {horizon:g} (the horizon)",
            got=f"from {start:g} to {stop:g}",
        )
    if term.lasting and stop - start <= SAME_TIME * horizon:
        expected = "a window of positive length, since a control lasts"
        raise InputError(path=where, expected=expected, got=f"from {start:g} to {stop:g}")
    told: dict[str, Any] = {"start": start, "stop": stop}
    if term.relative_to is not None:
        told["relative_to"] = moved = _reference(f"{where}.relative_to", term.relative_to, setting.states)
        slack = SAME_TIME * horizon
        if moved[0, 0] > start + slack or moved[-1, 0] < stop - slack:
            expected = f"rows whose times cover the window, {start:g} to {stop:g}"
            got = f"{moved[0, 0]:g} to {moved[-1, 0]:g}"
            raise InputError(path=f"{where}.relative_to", expected=expected, got=got)
    placed: W = replace(cast("Any", term), **told)
    return placed


class UntilHorizon(float):
    """The horizon as the end of a window that was given none: where the horizon is another one, so is the end."""

    __slots__ = ()


def end_of(stop: float | None, horizon: float) -> float:
    """The end of a window: its ``stop``, and the horizon unless that was given."""
    return UntilHorizon(horizon) if stop is None or isinstance(stop, UntilHorizon) else float(stop)


def columns(rows: Any, count: int) -> Array:
    """Rows of numbers with so many columns, zeros after their own."""
    given = np.asarray(rows)
    return np.pad(given, ((0, 0), (0, count - given.shape[1])))


def at_corners(corners: Sequence[Array], H: npt.ArrayLike, *beside: npt.ArrayLike) -> list[Array]:
    """Rows ``H (r, d)`` on the states that are each of these matrices ``(d, size)`` times a larger one, as rows on that
    one, with what stands ``beside`` them, ``(r,)`` or ``(r, q)``; without those that repeat an earlier one."""
    parts = [np.asarray(one) for one in beside]
    rows = np.vstack([np.column_stack([np.asarray(H) @ one, *parts]) for one in corners])
    _, first = np.unique(rows, axis=0, return_index=True)
    widths = [corners[0].shape[1], *(1 if one.ndim == 1 else one.shape[1] for one in parts)]
    return np.split(rows[np.sort(first)], np.cumsum(widths)[:-1], axis=1)


def everywhere(bound: ConvexSet, corners: Sequence[Array]) -> list[ConvexSet]:
    """The points ``z`` of which every matrix ``(d, size)`` of the ``corners``, the identity and what stands beside it,
    makes one of a set: one polytope, or where the set is curved as many as there are corners."""
    flat, d = bound.halfspaces(), bound.dimension
    if flat is None:
        found = [oblique(bound, one[:, d:]) for one in corners]
        return [*{np.asarray(one.slopes).tobytes(): one for one in found}.values()]
    H, h = at_corners(corners, *flat)
    return [Polytope(H, h[:, 0])]


def checked_set(name: str, value: object, dimension: int, of: str, bounded: bool = False) -> ConvexSet:
    """The value, where it is a set in so many coordinates; raises `InputError`."""
    if isinstance(value, Equality):
        raise InputError("an equality is allowed in terminal only", path=name)
    if not isinstance(value, ConvexSet):
        raise InputError(
            path=name, expected="a convex set, such as Box, Polytope or Ellipsoid", got=f"{type(value).__name__}"
        )
    if value.dimension != dimension:
        raise InputError(
            path=name,
            expected=f"a set of dimension {dimension}, the number of {of}",
            got=f"dimension {value.dimension}",
        )
    if bounded and not value.is_bounded:
        raise InputError("the set must be bounded", path=name)
    require_consistent(name, value)
    return value


def restricts_nothing(value: ConvexSet) -> bool:
    """Whether a set is the whole space."""
    flat = value.halfspaces()
    return flat is not None and flat[1].size == 0


def coefficients(where: str, **given: tuple[object, int, str]) -> list[Array]:
    """Each of some rows, of which it is told how many columns they have and one for each of what, as finite numbers;
    raises `InputError`."""
    return [
        _matrix(f"{where}.{name}", rows, f"rows of {width} finite numbers, one per {of}", width)
        for name, (rows, width, of) in given.items()
    ]


def _matrix(where: str, rows: object, expected: str, columns: int) -> Array:
    try:
        matrix = np.array(dense(rows), dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.ndim != 2 or matrix.shape[1] != columns or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(path=where, expected=expected, got=f"{rows!r}")
    return matrix


def _reference(where: str, rows: object, states: int) -> Array:
    """Rows of a time and a point, ``(q, 1 + d)``."""
    moved = _matrix(where, rows, f"rows of {1 + states} finite numbers, a time and a point each", 1 + states)
    if (np.diff(moved[:, 0]) <= 0.0).any():
        raise InputError(path=where, expected="rows whose times increase", got=f"times {moved[:, 0].tolist()}")
    return moved
