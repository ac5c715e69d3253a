"""Several disturbances of one problem, and the one that they are together.

Disturbances ``E_i w_i`` of one class, with ``w_i`` in ``W_i``, push the state as ``[E_1 E_2 ...] w`` does, with ``w``
in the product of the ``W_i``: every signal of the one is a signal of the other. So a problem that lists them is a
problem with one, and whatever is proven of one disturbance is proven of a list.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal, TypeAlias, final, get_args

from sparserob_core.control.problem.expression import Entries, beside
from sparserob_core.control.problem.system import LinearSystem, Matrix, SwitchedSystem, System
from sparserob_core.control.sets.sets import product
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import ConvexSet

DisturbanceClass: TypeAlias = Literal["piecewise_constant", "measurable", "l1_ball"]


@final
@dataclass(frozen=True, eq=False)
class Disturbance:
    """One of several disturbances: its bounded ``set``, how it enters, ``E (d, mw)`` as in `LinearSystem` (that of the
    system unless given), and its ``kind``, the class of functions that it may be."""

    set: ConvexSet
    E: Matrix | None = None
    kind: DisturbanceClass = "piecewise_constant"

    def entering(self, where: str, mode: LinearSystem) -> LinearSystem:
        """One of the systems that take turns, under this disturbance alone; raises `InputError` where it does not
        fit."""
        if self.E is None:
            return mode
        try:
            return replace(mode, E=self.E)
        except InputError as error:
            raise InputError(error.sentence, path=f"{where}.E") from None


def joined(system: System, every: Sequence[Disturbance]) -> tuple[System, ConvexSet, DisturbanceClass]:
    """The system under all of these disturbances side by side, the set of them together, and their class; raises
    `InputError` that begins with ``disturbance`` and the number of the one at fault."""
    kind = every[0].kind
    for i, one in enumerate(every):
        if one.kind not in get_args(DisturbanceClass):
            wanted = f"one of {', '.join(get_args(DisturbanceClass))}"
            raise InputError(path=f"disturbance.{i}.class", expected=wanted, got=f"{one.kind!r}")
        if one.kind != kind:
            raise InputError(
                path=f"disturbance.{i}.class",
                expected=f"{kind}, the class of the first: two classes at once are not built; a measurable disturbance"
                " may do all that a piecewise constant one does",
                got=one.kind,
            )
    modes, sets = [], []
    for mode in system.modes:
        alone = [one.entering(f"disturbance.{i}", mode) for i, one in enumerate(every)]
        modes.append(replace(mode, E=reduce(beside, [_columns(one) for one in alone])))
        sets = [
            _checked(f"disturbance.{i}.set", one.set, of) for i, (one, of) in enumerate(zip(every, alone, strict=True))
        ]
    if isinstance(system, SwitchedSystem):
        ends = [until for until, _ in system.pieces]
        return SwitchedSystem(list(zip(ends, modes, strict=True)), system.delay), product(sets), kind
    return modes[0], product(sets), kind


def _columns(system: LinearSystem) -> Entries:
    """``E`` as an array, expressions or a function."""
    entry: Entries = system.E  # type: ignore[assignment]  # a system has made it one of these
    return entry


def _checked(where: str, bound: object, system: LinearSystem) -> ConvexSet:
    if not isinstance(bound, ConvexSet):
        raise InputError(path=where, expected="a convex set, such as Box", got=f"{type(bound).__name__}")
    if bound.dimension != system.disturbances:
        expected = f"a set of dimension {system.disturbances}, the number of columns of E"
        raise InputError(path=where, expected=expected, got=f"dimension {bound.dimension}")
    if not bound.is_bounded:
        raise InputError("the set must be bounded", path=where)
    return bound
