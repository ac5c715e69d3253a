"""Several disturbances of one problem, and the one that they are together.

Disturbances ``E_i w_i`` of one class, with ``w_i`` in ``W_i``, push the state as ``[E_1 E_2 ...] w`` does, with ``w``
in the product of the ``W_i``: every signal of the one is a signal of the other. So a problem that lists them is a
problem with one, and whatever is proven of one disturbance is proven of a list. Of two classes they are one in a
`Product`, each part of it of a class of its own; what each class does is that of the set that is 0 along the columns of
the other, and both add up (`apart`). One that acts in a window of time alone
enters a system that takes turns, whose ``E`` is 0 outside of the window. Those that are constant on pieces of their own
are one on the pieces of all, of which some parts stay what they are from one to the next.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal, TypeAlias, final, get_args

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.problem.expression import Entries, beside
from sparserob_core.control.problem.phase import Matrix, Phase
from sparserob_core.control.problem.system import System
from sparserob_core.control.sets.sets import Product, product
from sparserob_core.control.term import SAME_TIME
from sparserob_core.errors import InputError
from sparserob_core.shapes import sealed
from sparserob_core.sip.convex_set import Array, Box, ConvexSet, as_bound

DisturbanceClass: TypeAlias = Literal["piecewise_constant", "measurable", "l1_ball"]
Classes: TypeAlias = DisturbanceClass | tuple[DisturbanceClass, ...]
Breakpoints: TypeAlias = tuple[Array | None, ...]


@final
@dataclass(frozen=True, eq=False)
class Disturbance:
    """One of several disturbances: its bounded ``set``, how it enters, ``E (d, mw)`` as in `LinearSystem` (that of the
    system unless given), its ``kind``, the class of functions that it may be, the window ``[start, stop]`` in which it
    acts, ``stop`` is the horizon when ``None``, and the ``breakpoints (K + 1,)`` between which it is constant,
    increasing from 0 to the horizon; those of the disturbance's dictionary when ``None``."""

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
        """A phase under this disturbance alone; raises `InputError` where it does not fit."""
        if self.E is None:
            return phase
        try:
            return replace(phase, E=self.E)
        except InputError as error:
            raise InputError(error.sentence, path=f"{where}.E") from None


def joined(
    system: System, every: Sequence[Disturbance], horizon: float
) -> tuple[System, ConvexSet, Classes, Breakpoints | None]:
    """The system under all of these disturbances side by side until the ``horizon``, the set of them together, their
    class, or that of every part of the set, and the breakpoints of every part where one has its own; raises
    `InputError` that begins with ``disturbance`` and the number of the one at fault."""
    kind, first = every[0].kind, system.phases[0]
    for i, one in enumerate(every):
        if one.kind not in get_args(DisturbanceClass):
            wanted = f"one of {', '.join(get_args(DisturbanceClass))}"
            raise InputError(path=f"disturbance.{i}.class", expected=wanted, got=f"{one.kind!r}")
        if one.kind != kind and "l1_ball" in (one.kind, kind):
            raise InputError(
                path=f"disturbance.{i}.class",
                expected=f"{kind}, the class of the first: l1_ball is of all of a list, or of none",
                got=one.kind,
            )
    windows = [_window(f"disturbance.{i}", one, horizon) for i, one in enumerate(every)]
    own = tuple(_own(f"disturbance.{i}", one, every, horizon) for i, one in enumerate(every))
    grids = own if any(times is not None for times in own) else None
    sets = [
        _checked(f"disturbance.{i}.set", one.set, one.entering(f"disturbance.{i}", first))
        for i, one in enumerate(every)
    ]
    phases: list[Phase] = []
    for phase in legs(system, {time for window in windows for time in window}, horizon):
        columns = []
        for i, (one, (start, stop)) in enumerate(zip(every, windows, strict=True)):
            E = _columns(one.entering(f"disturbance.{i}", phase))
            acts = start < phase.until - SAME_TIME * horizon and phase.begin + SAME_TIME * horizon < stop
            columns.append(E if acts else np.zeros((phase.states, sets[i].dimension)))
        phases.append(replace(phase, E=reduce(beside, columns)))
    kinds = tuple(one.kind for one in every)
    together: tuple[ConvexSet, Classes] = (product(sets), kind)
    if len(set(kinds)) > 1 or grids is not None:
        together = Product(tuple(sets)), kinds if len(set(kinds)) > 1 else kind
    return system.in_phases(phases), *together, grids


def apart(bound: ConvexSet | None, classes: Classes, kind: DisturbanceClass) -> ConvexSet | None:
    """The set of the disturbances in ``bound`` that are of one class, which is 0 along the columns of others; ``None``
    where there are none."""
    if bound is None or isinstance(classes, str):
        return bound if classes == kind else None
    every = zip(bound.factors, classes, strict=True)
    return product([part if one == kind else _nothing(part.dimension) for part, one in every])


def columns_of(bound: ConvexSet, classes: Classes, kind: DisturbanceClass) -> np.ndarray:
    """Which columns of ``E`` are of disturbances of one class, ``(mw,)``."""
    if isinstance(classes, str):
        return np.full(bound.dimension, classes == kind)
    return np.repeat([one == kind for one in classes], [part.dimension for part in bound.factors])


def _own(where: str, one: Disturbance, every: Sequence[Disturbance], horizon: float) -> Array | None:
    """The breakpoints of one of several disturbances, ``None`` where it has none of its own."""
    if one.breakpoints is None:
        return None
    if {other.kind for other in every} != {"piecewise_constant"}:
        raise InputError(
            path=f"{where}.breakpoints",
            expected="none where a disturbance of the list is not of the class piecewise_constant",
            got="some",
        )
    times = as_bound("breakpoints", one.breakpoints)
    fit = times.ndim == 1 and times.size > 1 and times[0] == 0.0 and abs(times[-1] - horizon) <= SAME_TIME * horizon
    if not fit or not (np.diff(times) > SAME_TIME * horizon).all():
        raise InputError(
            path=f"{where}.breakpoints",
            expected=f"times that increase from 0 to {horizon:g} (the horizon), apart by more than rounding",
            got=np.array2string(times, threshold=8, precision=6),
        )
    return np.append(times[:-1], horizon)


def _nothing(dimension: int) -> ConvexSet:
    return Box(np.zeros(dimension), np.zeros(dimension))


def _window(where: str, one: Disturbance, horizon: float) -> tuple[float, float]:
    start, stop = float(one.start), horizon if one.stop is None else float(one.stop)
    if not (0.0 <= start <= stop - SAME_TIME * horizon and stop <= horizon):
        raise InputError(
            path=where,
            expected=f"0 <= from < to <= {horizon:g} (the horizon), apart by more than rounding",
            got=f"from {start:g} to {stop:g}",
        )
    return start, stop


def legs(system: System, cuts: Collection[float], horizon: float) -> Iterator[Phase]:
    """The phases of a system, cut at more times than its own, but not at rounding."""
    for phase in system.until(horizon):
        begin, until = phase.begin, phase.until
        for time in sorted(cuts):
            if min(abs(time - begin), abs(until - time)) > SAME_TIME * horizon and begin < time < until:
                yield phase.between(begin, time)
                begin = time
        yield phase.between(begin, until)


def _columns(phase: Phase) -> Entries:
    """``E`` as an array, expressions or a function."""
    entry: Entries = phase.E  # type: ignore[assignment]  # a phase has made it one of these
    return entry


def _checked(where: str, bound: object, phase: Phase) -> ConvexSet:
    if not isinstance(bound, ConvexSet):
        raise InputError(path=where, expected="a convex set, such as Box", got=f"{type(bound).__name__}")
    if bound.dimension != phase.disturbances:
        expected = f"a set of dimension {phase.disturbances}, the number of columns of E"
        raise InputError(path=where, expected=expected, got=f"dimension {bound.dimension}")
    if not bound.is_bounded:
        raise InputError("the set must be bounded", path=where)
    return bound
