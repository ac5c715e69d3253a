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


def _shift_rows(rows: npt.ArrayLike, begin: float, horizon: float) -> Array:
    """Return rows ``(q, 1 + d)`` of a time and a point from the time ``begin`` on, with times counted from there."""
    array = np.asarray(rows, dtype=float)
    shifted = array - np.eye(1, array.shape[1])[0] * begin
    later: Array = shifted[shifted[:, 0] > 0.0]
    if shifted[0, 0] > 0.0:
        return later
    now = [np.interp(0.0, shifted[:, 0], column) for column in shifted[:, 1:].T]
    return np.vstack([[0.0, *now], later])


@final
@dataclass(frozen=True)
class Setting:
    """The properties of a problem that a constraint must fit.

    Parameters
    ----------
    states, controls : int
        The numbers ``d`` of states and ``m`` of controls.
    delay : float
        The time by which the control acts later than it is commanded.
    horizon : float
        The horizon.
    """

    states: int
    controls: int
    delay: float
    horizon: float


class Window(Term, ABC):
    """A constraint that holds from a time ``start`` to a time ``stop``.

    Attributes
    ----------
    start : float
        The time at which the window begins.
    stop : float or None
        The time at which the window ends; the horizon where it is ``None``.
    name : str or None
        The name in messages, tables and figures, where the user gave one.
    relative_to : array (q, 1 + d) or None
        The rows of a time and a point, relative to which the constraint holds.
    lasting : bool
        True for a kind of constraint that needs a window of positive length.
    stated : bool
        True for a kind of constraint that users give. Other kinds are made from these.
    """

    start: float
    stop: float | None
    name: str | None
    relative_to: npt.ArrayLike | None = None
    lasting: ClassVar[bool] = False
    stated: ClassVar[bool] = True
    among: ClassVar[str] = ""
    """The list of a problem that holds the rows of the constraint; empty for a kind whose `rows` are of other kinds."""

    @classmethod
    def of(cls, where: str, entry: object) -> Window:
        """Return the constraint for an entry of a list of such constraints.

        Parameters
        ----------
        where : str
            The key of a config at which the entry stands, for messages.
        entry : object
            The entry.

        Raises
        ------
        InputError
            If the entry is no such constraint.
        """
        if not isinstance(entry, cls):
            raise InputError(path=where, expected=f"{cls.__name__}(...)", got=type(entry).__name__)
        return entry

    @abstractmethod
    def checked(self, where: str, setting: Setting) -> Self:
        """Return the constraint with arrays of the right shapes and with its ``stop``.

        Parameters
        ----------
        where : str
            The key of a config at which the constraint stands, with which errors begin.
        setting : Setting
            The properties of the problem.

        Raises
        ------
        InputError
            If the constraint does not fit the problem.
        """

    @property
    @abstractmethod
    def bounds(self) -> ConvexSet:
        """The set that a factor enlarges; raises `InputError` where there is none."""

    @abstractmethod
    def scaled(self, factor: float) -> Self:
        """Return the constraint whose `bounds` are enlarged by a factor about their middle."""

    @property
    def restricts(self) -> bool:
        """True where the constraint excludes any point."""
        return True

    def rows(self, called: str) -> Sequence[Window]:
        """Return the equivalent constraints of the kinds that a problem consists of.

        These kinds are `PathConstraint` and `MixedConstraint`, which bound state and control at times, and
        `IntegralConstraint`. The name ``called`` is used in messages, tables and figures.
        """
        return [replace(cast("Any", self), name=called)]

    def remaining(self, begin: float, horizon: float, **given: Any) -> Self | None:
        """Return the constraint that remains from one time on, with times counted from there.

        Parameters
        ----------
        begin : float
            The time from which the constraint remains.
        horizon : float
            The duration of the problem that remains.
        given
            Values of fields that replace those of the constraint.

        Returns
        -------
        Window or None
            The constraint, or ``None`` where nothing of it remains.
        """
        end = begin + horizon
        late = over(end, self.start) if self.lasting else not over(self.start, end)
        if late or (self.stop is not None and over(self.stop, begin, horizon)):
            return None
        return super().remaining(begin, horizon, **given)


@dataclass(frozen=True, eq=False)
class PathConstraint(Window):
    """A constraint that keeps the state in a set at all times of a window.

    Parameters
    ----------
    set : ConvexSet
        The set of the state ``x(t)``, or of ``x(t) - r(t)`` where ``relative_to`` is given; ``d`` coordinates.
    start : float, default 0.0
        The time at which the window begins, in the time unit of the system.
    stop : float, optional
        The time at which the window ends; the horizon unless given.
    name : str, optional
        The name in messages, tables and figures.
    relative_to : array (q, 1 + d), optional
        Rows of a time and a point, with increasing times that cover the window. The reference ``r(t)`` is linear
        between the points. The set does not move unless rows are given.

    Raises
    ------
    InputError
        When a problem is made with a constraint that does not fit it.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> corridor = sr.PathConstraint(sr.Box([-0.7, -10.0], [0.7, 10.0]), start=0.6, name="corridor")
    >>> corridor.restricts
    True
    """

    set: ConvexSet = field(metadata=STATES)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    relative_to: npt.ArrayLike | None = field(default=None, metadata=timed(lambda of: of.states, _shift_rows))

    among = "path"

    __repr__ = noun

    @classmethod
    def of(cls, where: str, entry: object) -> Window:
        """Return the constraint for an entry of a path, in which a bare set holds at all times.

        Parameters
        ----------
        where : str
            The key of a config at which the entry stands.
        entry : object
            A constraint, or a set. Any other entry fails when the constraint is checked.
        """
        if isinstance(entry, PathConstraint | MixedConstraint):
            return entry
        return PathConstraint(cast("ConvexSet", entry))  # an entry that is no set fails when it is checked

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
        """The arrays ``H``, ``None`` and ``h`` of ``H (x(t) - r(t)) <= h``; ``None`` where the set is curved."""
        sides = self.set.halfspaces()
        return None if sides is None else (sides[0], None, sides[1])

    def widened(self, size: int) -> Self:
        """Return the constraint for a state of ``size`` coordinates, in which the additional coordinates are free."""
        reference = None if self.relative_to is None else columns(self.relative_to, 1 + size)
        return replace(self, set=cylinder(self.set, size), relative_to=reference)

    def everywhere(self, corners: Sequence[Array], called: str) -> list[Self]:
        """Return the constraint on a larger state ``z`` that holds for all states ``x = corner z``.

        Parameters
        ----------
        corners : sequence of arrays (d, size)
            The matrices that give the states of the user at each corner of the parameters.
        called : str
            The name of the constraint.

        Returns
        -------
        list of PathConstraint
            A single constraint where the set is flat; for a curved set, one constraint for each different corner.
        """
        reference = None if self.relative_to is None else columns(self.relative_to, 1 + corners[0].shape[1])
        sets = everywhere(self.set, corners)
        names = [called] if len(sets) == 1 else [f"{called} at corner {i}" for i in range(1, len(sets) + 1)]
        return [
            replace(self, name=name, set=bound, relative_to=reference) for name, bound in zip(names, sets, strict=True)
        ]

    def scaled(self, factor: float) -> Self:
        return replace(self, set=self.set.scaled(factor))


@dataclass(frozen=True, eq=False)
class MixedConstraint(Window):
    """A constraint ``H x(t) + G u(t) <= h`` on state and control together at all times of a window.

    Parameters
    ----------
    H : array (r, d)
        The coefficients of the state.
    G : array (r, m)
        The coefficients of the control.
    h : float or array (r,)
        The upper bounds; a number holds for all rows.
    start : float, default 0.0
        The time at which the window begins, in the time unit of the system.
    stop : float, optional
        The time at which the window ends; the horizon unless given.
    name : str, optional
        The name in messages, tables and figures.

    Raises
    ------
    InputError
        When a problem is made with a constraint that does not fit it.

    Notes
    -----
    The constraint holds on every interval of the control that meets the window in positive length, both ends included,
    with the control of that interval. Where the control jumps, it holds with both values. ``u(t)`` is the commanded
    control, even where the system has a delay.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.MixedConstraint(H=[[0, 1], [0, -1]], G=[[0.5], [-0.5]], h=0.9).set.dimension
    3
    """

    H: npt.ArrayLike = field(metadata=measured(lambda of: 1.0 / of.states))
    G: npt.ArrayLike = field(metadata=measured(lambda of: 1.0 / of.controls))
    h: npt.ArrayLike = field(metadata=UNITLESS)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    lasting = True  # a control is constant on intervals of positive length
    among = "path"

    __repr__ = noun

    @cached_property
    def set(self) -> Polytope:
        """The set of all ``(x, u)`` that are allowed, in ``d + m`` coordinates."""
        return Polytope(np.hstack([np.asarray(self.H), np.asarray(self.G)]), np.asarray(self.h))

    def checked(self, where: str, setting: Setting) -> Self:
        d, m = setting.states, setting.controls
        H, G = coefficients(f"{where}.mixed", H=(self.H, d, "state"), G=(self.G, m, "control"))
        if len(G) != len(H):
            raise InputError(path=f"{where}.mixed.G", expected=f"{len(H)} rows, as H has", got=f"{len(G)}")
        h = as_bound(f"{where}.mixed.h", self.h, len(H))
        if np.isneginf(h).any():
            raise InputError(path=f"{where}.mixed.h", expected="numbers above -inf", got=f"{h.tolist()}")
        constraint = replace(self, H=H, G=G, h=h)
        try:
            _ = constraint.set
        except InputError as error:
            raise InputError(error.sentence, path=f"{where}.mixed") from None
        return placed(constraint, where, setting)

    @property
    def restricts(self) -> bool:
        return not restricts_nothing(self.set)

    @property
    def flat(self) -> Flat:
        """The arrays ``H``, ``G`` and ``h`` of ``H x(t) + G u(t) <= h``."""
        (rows, h), d = self.set.halfspaces(), np.asarray(self.H).shape[1]
        return rows[:, :d], rows[:, d:], h

    def widened(self, size: int) -> Self:
        """Return the constraint for a state of ``size`` coordinates, in which the additional coordinates are free."""
        return replace(self, H=columns(self.H, size))

    def everywhere(self, corners: Sequence[Array], called: str) -> list[Self]:
        """Return the constraint on a larger state ``z`` that holds for all states ``x = corner z``.

        Parameters
        ----------
        corners : sequence of arrays (d, size)
            The matrices that give the states of the user at each corner of the parameters.
        called : str
            The name of the constraint.

        Returns
        -------
        list of MixedConstraint
            A single constraint.
        """
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
    """Return a constraint with its ``stop`` and its reference as arrays.

    Parameters
    ----------
    term : Window
        The constraint.
    where : str
        The key of a config at which the constraint stands, with which errors begin.
    setting : Setting
        The properties of the problem.

    Raises
    ------
    InputError
        If the window is not within the horizon, is too short, or is not covered by the times of the reference.
    """
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
    changes: dict[str, Any] = {"start": start, "stop": stop}
    if term.relative_to is not None:
        changes["relative_to"] = reference = _check_reference(f"{where}.relative_to", term.relative_to, setting.states)
        slack = SAME_TIME * horizon
        if reference[0, 0] > start + slack or reference[-1, 0] < stop - slack:
            expected = f"rows whose times cover the window, {start:g} to {stop:g}"
            got = f"{reference[0, 0]:g} to {reference[-1, 0]:g}"
            raise InputError(path=f"{where}.relative_to", expected=expected, got=got)
    placed: W = replace(cast("Any", term), **changes)
    return placed


class UntilHorizon(float):
    """The horizon as the end of a window for which none was given; for another horizon the end is that horizon."""

    __slots__ = ()


def end_of(stop: float | None, horizon: float) -> float:
    """Return the end of a window as a number.

    Parameters
    ----------
    stop : float or None
        The end that the user gave, or an `UntilHorizon`, or ``None`` where there is none.
    horizon : float
        The horizon.

    Returns
    -------
    float
        The given end, else the horizon as an `UntilHorizon`.
    """
    return UntilHorizon(horizon) if stop is None or isinstance(stop, UntilHorizon) else float(stop)


def columns(rows: Any, count: int) -> Array:
    """Return rows of numbers with additional columns of zeros.

    Parameters
    ----------
    rows : array (q, n)
        The rows.
    count : int
        The number of columns that is required, at least ``n``.

    Returns
    -------
    array (q, count)
        The rows, followed by zeros.
    """
    array = np.asarray(rows)
    return np.pad(array, ((0, 0), (0, count - array.shape[1])))


def at_corners(corners: Sequence[Array], H: npt.ArrayLike, *added_columns: npt.ArrayLike) -> list[Array]:
    """Return rows on the states of the user as rows on a larger state ``z``, for all states ``x = corner z``.

    Parameters
    ----------
    corners : sequence of arrays (d, size)
        The matrices that give the states of the user at each corner of the parameters.
    H : array (r, d)
        The coefficients of the states of the user.
    added_columns : arrays (r,) or (r, q)
        Further columns of the rows, which are repeated for each corner.

    Returns
    -------
    list of arrays
        The coefficients ``(k, size)`` of ``z``, and the further columns ``(k, 1)`` or ``(k, q)``. A row that repeats an
        earlier one is left out.
    """
    extra_columns = [np.asarray(column) for column in added_columns]
    rows = np.vstack([np.column_stack([np.asarray(H) @ corner, *extra_columns]) for corner in corners])
    _, first = np.unique(rows, axis=0, return_index=True)
    widths = [corners[0].shape[1], *(1 if column.ndim == 1 else column.shape[1] for column in extra_columns)]
    return np.split(rows[np.sort(first)], np.cumsum(widths)[:-1], axis=1)


def everywhere(bound: ConvexSet, corners: Sequence[Array]) -> list[ConvexSet]:
    """Return the sets of all points ``z`` for which ``corner z`` is in a set, for every corner.

    Parameters
    ----------
    bound : ConvexSet
        The set in ``d`` coordinates.
    corners : sequence of arrays (d, size)
        The matrices, whose first ``d`` columns are the identity.

    Returns
    -------
    list of ConvexSet
        A single polytope where the set is flat; for a curved set, one set for each different corner.
    """
    flat, d = bound.halfspaces(), bound.dimension
    if flat is None:
        cylinders = [oblique(bound, corner[:, d:]) for corner in corners]
        return [*{np.asarray(cylinder.slopes).tobytes(): cylinder for cylinder in cylinders}.values()]
    H, h = at_corners(corners, *flat)
    return [Polytope(H, h[:, 0])]


def checked_set(name: str, value: object, dimension: int, of: str, bounded: bool = False) -> ConvexSet:
    """Return the value where it is a set in so many coordinates.

    Parameters
    ----------
    name : str
        The key of a config at which the set stands, for messages.
    value : object
        The value.
    dimension : int
        The number of coordinates that is required.
    of : str
        A word for the coordinates, such as ``states``.
    bounded : bool, default False
        True where the set must be bounded.

    Raises
    ------
    InputError
        If the value is no such set, or is a set of a plugin that contradicts itself.
    """
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
    if not value.is_pointwise and name != "disturbance":
        raise InputError(path=name, expected="a set without a budget, which is of a disturbance", got=value.kind)
    require_consistent(name, value)
    return value


def restricts_nothing(value: ConvexSet) -> bool:
    """Return True where a set is the whole space."""
    flat = value.halfspaces()
    return flat is not None and flat[1].size == 0


def coefficients(where: str, **given: tuple[object, int, str]) -> list[Array]:
    """Return several matrices of coefficients as arrays of finite numbers.

    Parameters
    ----------
    where : str
        The key of a config at which the matrices stand, for messages.
    given : tuples (rows, columns, word)
        For the name of each matrix its rows, the number of columns that is required, and a word for a column.

    Raises
    ------
    InputError
        If a matrix is not of this form.
    """
    return [
        _check_matrix(f"{where}.{name}", rows, f"rows of {width} finite numbers, one per {of}", width)
        for name, (rows, width, of) in given.items()
    ]


def _check_matrix(where: str, rows: object, expected: str, columns: int) -> Array:
    """Return a matrix of finite numbers with so many columns; raise `InputError`."""
    try:
        matrix = np.array(dense(rows), dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.ndim != 2 or matrix.shape[1] != columns or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(path=where, expected=expected, got=f"{rows!r}")
    return matrix


def _check_reference(where: str, rows: object, states: int) -> Array:
    """Return rows ``(q, 1 + d)`` of a time and a point; raise `InputError` where the times do not increase."""
    reference = _check_matrix(where, rows, f"rows of {1 + states} finite numbers, a time and a point each", 1 + states)
    if (np.diff(reference[:, 0]) <= 0.0).any():
        raise InputError(path=where, expected="rows whose times increase", got=f"times {reference[:, 0].tolist()}")
    return reference
