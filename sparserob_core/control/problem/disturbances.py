"""Several disturbances of one problem, and the single disturbance that replaces them.

Disturbances ``E_i w_i`` with ``w_i`` in ``W_i`` act as ``[E_1 E_2 ...] w`` does, with ``w`` in the product of the
``W_i``: each signal of the list is a signal of the product, and the reverse. A problem with a list is therefore a
problem with one disturbance, and every proof for one disturbance holds for the list.

* Two classes: the single disturbance is a `Product`, each part of which has its own class. The disturbances of one
  class are in the set that is 0 along the columns of the other class; the effects of both classes are added
  (`select_class`).
* A window of time: the disturbance enters a system with several phases, in which ``E`` is 0 outside of the window.
* Different grids: the single disturbance is constant on the intervals of the common refinement. A part that has a
  coarser grid is held over several of these intervals.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal, TypeAlias, final, get_args

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.combinations import refusal
from sparserob_core.control.problem.phase import Matrix, Phase
from sparserob_core.control.problem.system import System
from sparserob_core.control.sets.sets import Product, product
from sparserob_core.control.term import SAME_TIME
from sparserob_core.errors import InputError
from sparserob_core.shapes import sealed
from sparserob_core.sip.convex_set import Array, Box, ConvexSet, as_bound
from sparserob_core.sip.expressions.expression import Entries, join_columns

DisturbanceClass: TypeAlias = Literal["piecewise_constant", "measurable", "l1_ball"]
Classes: TypeAlias = DisturbanceClass | tuple[DisturbanceClass, ...]
Breakpoints: TypeAlias = tuple[Array | None, ...]


@final
@dataclass(frozen=True, eq=False)
class Disturbance:
    """A disturbance of a problem that has several of them, with its own set, matrix, class, window of time and grid.

    Parameters
    ----------
    set : ConvexSet
        The bounded set of the disturbance ``(mw,)``.
    E : array (d, mw) or function of the parameters, optional
        The matrix by which the disturbance enters, as in `LinearSystem`; the ``E`` of the system unless given.
    kind : {"piecewise_constant", "measurable", "l1_ball"}, default "piecewise_constant"
        The class of the functions of time; see `OptimalControlProblem`.
    start : float, default 0.0
        The time, in the time unit of the system, at which the disturbance begins to act.
    stop : float, optional
        The time at which the disturbance ceases to act; the horizon unless given.
    breakpoints : array (K + 1,), optional
        The times between which the disturbance is constant, increasing from 0 to the horizon. They are those of the
        disturbance's dictionary unless given.

    Notes
    -----
    The fields are checked when a problem is made of the disturbances.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> gust = sr.Disturbance(sr.Box([-0.01], [0.01]), [[0], [1]], start=1.0)
    >>> gust.kind
    'piecewise_constant'
    """

    set: ConvexSet
    E: Matrix | None = None
    kind: DisturbanceClass = "piecewise_constant"
    start: float = 0.0
    stop: float | None = None
    breakpoints: npt.ArrayLike | None = None

    __repr__ = noun

    def __post_init__(self) -> None:
        sealed(self)

    def entering(self, where: str, phase: Phase) -> Phase:
        """Return a phase under this disturbance alone.

        Parameters
        ----------
        where : str
            The key of a config at which the disturbance stands, for messages.
        phase : Phase
            The phase, with the ``E`` of the system.

        Returns
        -------
        Phase
            The phase with the ``E`` of this disturbance, where that is given.

        Raises
        ------
        InputError
            If ``E`` does not fit the phase.
        """
        if self.E is None:
            return phase
        try:
            return replace(phase, E=self.E)
        except InputError as error:
            raise InputError(error.sentence, path=f"{where}.E") from None


def join_disturbances(
    system: System, every: Sequence[Disturbance], horizon: float
) -> tuple[System, ConvexSet, Classes, Breakpoints | None]:
    """Return a system under all disturbances together, and the single disturbance that replaces them.

    Parameters
    ----------
    system : System
        The system.
    every : sequence of Disturbance
        The disturbances; at least one.
    horizon : float
        The time until which the system is considered.

    Returns
    -------
    system : System
        The system, whose ``E`` has the columns of all disturbances, one disturbance after another. They are 0 in phases
        outside of a window.
    set : ConvexSet
        The product of the sets.
    classes : str or tuple of str
        The class of the disturbances; one class for each part of the product where they differ.
    breakpoints : tuple or None
        The breakpoints of each part, or ``None`` for a part without its own; ``None`` where no part has its own.

    Raises
    ------
    InputError
        If a disturbance does not fit; the error begins with ``disturbance`` and its number.
    """
    kind, first_phase = every[0].kind, system.phases[0]
    for i, disturbance in enumerate(every):
        if disturbance.kind not in get_args(DisturbanceClass):
            wanted = f"one of {', '.join(get_args(DisturbanceClass))}"
            raise InputError(path=f"disturbance.{i}.class", expected=wanted, got=f"{disturbance.kind!r}")
        if disturbance.kind != kind and "l1_ball" in (disturbance.kind, kind):
            raise InputError(
                path=f"disturbance.{i}.class",
                expected=f"{kind}, the class of the first: l1_ball is of all of a list, or of none",
                got=disturbance.kind,
            )
    windows = [_check_window(f"disturbance.{i}", disturbance, horizon) for i, disturbance in enumerate(every)]
    breakpoints = tuple(
        _check_breakpoints(f"disturbance.{i}", disturbance, every, horizon) for i, disturbance in enumerate(every)
    )
    grids = breakpoints if any(times is not None for times in breakpoints) else None
    sets = [
        _check_set(f"disturbance.{i}.set", disturbance.set, disturbance.entering(f"disturbance.{i}", first_phase))
        for i, disturbance in enumerate(every)
    ]
    phases: list[Phase] = []
    for phase in legs(system, {time for window in windows for time in window}, horizon):
        columns = []
        for i, (disturbance, (start, stop)) in enumerate(zip(every, windows, strict=True)):
            E = _get_disturbance_matrix(disturbance.entering(f"disturbance.{i}", phase))
            acts = start < phase.until - SAME_TIME * horizon and phase.begin + SAME_TIME * horizon < stop
            columns.append(E if acts else np.zeros((phase.states, sets[i].dimension)))
        phases.append(replace(phase, E=reduce(join_columns, columns)))
    kinds = tuple(disturbance.kind for disturbance in every)
    set_and_classes: tuple[ConvexSet, Classes] = (product(sets), kind)
    if len(set(kinds)) > 1 or grids is not None:
        set_and_classes = Product(tuple(sets)), kinds if len(set(kinds)) > 1 else kind
    return system.in_phases(phases), *set_and_classes, grids


def select_class(bound: ConvexSet | None, classes: Classes, kind: DisturbanceClass) -> ConvexSet | None:
    """Return the set of the disturbances of one class, which is 0 along the columns of the other classes.

    Parameters
    ----------
    bound : ConvexSet or None
        The set of all disturbances ``(mw,)``.
    classes : str or tuple of str
        The class of all disturbances, or of each part of the set.
    kind : str
        The class that is selected.

    Returns
    -------
    ConvexSet or None
        The set in all ``mw`` coordinates; ``None`` where there are no disturbances. A single class that is another one
        also gives ``None``.
    """
    if bound is None or isinstance(classes, str):
        return bound if classes == kind else None
    pairs = zip(bound.factors, classes, strict=True)
    return product(
        [factor if factor_class == kind else _build_zero_set(factor.dimension) for factor, factor_class in pairs]
    )


def columns_of(bound: ConvexSet, classes: Classes, kind: DisturbanceClass) -> np.ndarray:
    """Return the columns of ``E`` whose disturbances are of one class, as a mask.

    Parameters
    ----------
    bound : ConvexSet
        The set of all disturbances ``(mw,)``.
    classes : str or tuple of str
        The class of all disturbances, or of each part of the set.
    kind : str
        The class that is selected.

    Returns
    -------
    array (mw,) of bool
        True for the columns of this class.
    """
    if isinstance(classes, str):
        return np.full(bound.dimension, classes == kind)
    return np.repeat([factor_class == kind for factor_class in classes], [factor.dimension for factor in bound.factors])


def _check_breakpoints(where: str, one: Disturbance, every: Sequence[Disturbance], horizon: float) -> Array | None:
    """Return the own breakpoints of one of several disturbances, or ``None`` where it has none; raise `InputError`."""
    if one.breakpoints is None:
        return None
    if {disturbance.kind for disturbance in every} != {"piecewise_constant"}:
        raise refusal("pieces of their own", "measurable", path=f"{where}.breakpoints", got="some")
    times = as_bound("breakpoints", one.breakpoints)
    fits = times.ndim == 1 and times.size > 1 and times[0] == 0.0 and abs(times[-1] - horizon) <= SAME_TIME * horizon
    if not fits or not (np.diff(times) > SAME_TIME * horizon).all():
        raise InputError(
            path=f"{where}.breakpoints",
            expected=f"times that increase from 0 to {horizon:g} (the horizon), apart by more than rounding",
            got=np.array2string(times, threshold=8, precision=6),
        )
    return np.append(times[:-1], horizon)


def _build_zero_set(dimension: int) -> ConvexSet:
    """Return the set of so many coordinates that holds 0 alone."""
    return Box(np.zeros(dimension), np.zeros(dimension))


def _check_window(where: str, one: Disturbance, horizon: float) -> tuple[float, float]:
    """Return the times between which a disturbance acts; raise `InputError` for a window outside of the horizon."""
    start, stop = float(one.start), horizon if one.stop is None else float(one.stop)
    if not (0.0 <= start <= stop - SAME_TIME * horizon and stop <= horizon):
        raise InputError(
            path=where,
            expected=f"0 <= from < to <= {horizon:g} (the horizon), apart by more than rounding",
            got=f"from {start:g} to {stop:g}",
        )
    return start, stop


def legs(system: System, cuts: Collection[float], horizon: float) -> Iterator[Phase]:
    """Yield the phases of a system until the horizon, divided at further times.

    Parameters
    ----------
    system : System
        The system.
    cuts : collection of float
        The times at which phases are divided, in any order. A time that differs from an end of a phase only by rounding
        is ignored.
    horizon : float
        The time at which the last phase ends.

    Yields
    ------
    Phase
        The phases in the order of time.
    """
    for phase in system.until(horizon):
        begin, until = phase.begin, phase.until
        for time in sorted(cuts):
            if min(abs(time - begin), abs(until - time)) > SAME_TIME * horizon and begin < time < until:
                yield phase.between(begin, time)
                begin = time
        yield phase.between(begin, until)


def _get_disturbance_matrix(phase: Phase) -> Entries:
    """Return ``E`` of a phase as an array, as expressions or as a function."""
    entry: Entries = phase.E  # type: ignore[assignment]  # a phase has made it one of these
    return entry


def _check_set(where: str, bound: object, phase: Phase) -> ConvexSet:
    """Return the set of a disturbance; raise `InputError` where it is unbounded or does not fit ``E``."""
    if not isinstance(bound, ConvexSet):
        raise InputError(path=where, expected="a convex set, such as Box", got=f"{type(bound).__name__}")
    if bound.dimension != phase.disturbances:
        expected = f"a set of dimension {phase.disturbances}, the number of columns of E"
        raise InputError(path=where, expected=expected, got=f"dimension {bound.dimension}")
    if not bound.is_bounded:
        raise InputError("the set must be bounded", path=where)
    if not bound.is_pointwise:
        expected = "a set without a budget: of a list none has one; write a single disturbance, of all columns of E"
        raise InputError(path=where, expected=expected, got=f"a {bound.kind} with a budget")
    return bound
