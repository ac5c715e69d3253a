"""Sets as a config writes them: one key per kind of set; several keys mean the intersection.

The kinds are those of the registry: every plugin of the kind ``set`` is a key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass, replace
from typing import Annotated, Any, ClassVar, cast, final

import numpy as np
from pydantic import (
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    model_serializer,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint, Window
from sparserob_core.control.sets.sets import Box, ConvexSet, Equality, NormBall, Polytope, SetFactory, intersection
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.packed import RowsOfNumbers
from sparserob_core.experiment.config.option_kinds import (
    FreeNumbers,
    OneOrMore,
    OneOrMoreFree,
    Sparse,
    broadcast,
    count,
)
from sparserob_core.experiment.plugins.components import Registry
from sparserob_core.experiment.plugins.hookspecs import SetPlugin
from sparserob_core.experiment.plugins.messages import COMPLAINT, Complaint, nearest, shown
from sparserob_core.experiment.plugins.records import Plugin
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array

KIND = SetPlugin.kind


class SetOptions(Sparse, extra="allow", json_schema_extra={"kinds": KIND}):
    """A set: each key is a kind of set, its value the options of that kind; several keys mean the intersection."""

    _factories: dict[str, SetFactory] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _check_kinds(self, info: ValidationInfo) -> SetOptions:
        """Check every key that is no field as a kind of set, with the registry of the context or the installed one."""
        extra = self.__pydantic_extra__ or {}
        registry: Registry = (info.context or {}).get("registry") or load_registry()
        wrong: list[Complaint] = []
        for key, value in list(extra.items()):
            if value is None:
                del extra[key]
                continue
            typed, faults = _check_kind(registry, key, value, self._list_fields())
            wrong += [fault.under((key,)) for fault in faults]
            if typed is not None:
                extra[key] = typed
                self._factories[key] = registry.get(KIND, key).create(typed)  # type: ignore[assignment]
        if wrong:
            raise ValidationError.from_exception_data(type(self).__name__, [_make_detail(fault) for fault in wrong])
        if not self._list_given_keys():
            raise InputError(expected=f"a set: {', '.join(registry.names(KIND))}", got="none of them")
        return self

    @model_serializer(mode="wrap")
    def _serialise(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the set as a config writes it: without keys that were not given, in the short form where there
        is one."""
        plain = {key: value for key, value in handler(self).items() if value is not None}
        for key, value in (self.__pydantic_extra__ or {}).items():
            short = getattr(type(value), "shorthand", None)
            if key in plain and isinstance(plain[key], Mapping) and set(plain[key]) == {short}:
                plain[key] = plain[key][short]
        return plain

    def _list_fields(self) -> set[str]:
        return {field.alias or name for name, field in type(self).model_fields.items()}

    def _list_given_keys(self) -> list[str]:
        return list(self.__pydantic_extra__ or {})

    def members(self, where: str, dimension: int) -> list[ConvexSet]:
        """Return one set per key, in the order in which they are written.

        Parameters
        ----------
        where : str
            The key of the set in the config, for errors.
        dimension : int
            The number of coordinates.

        Returns
        -------
        list of ConvexSet
            The sets.

        Raises
        ------
        InputError
            If a set cannot be built, or has another dimension; the error begins with the key.
        """
        members = []
        for kind, factory in self._factories.items():
            try:
                member = factory.build(dimension)
            except InputError as error:
                raise error.under(where, *(() if error.path[:1] == (kind,) else (kind,))) from None
            if member.dimension != dimension:
                raise InputError(path=f"{where}.{kind}", expected=f"{count(dimension)}", got=f"{member.dimension}")
            members.append(member)
        return members

    def build(self, where: str, dimension: int) -> ConvexSet:
        """Return the intersection of all keys as one set.

        Parameters
        ----------
        where : str
            The key of the set in the config, for errors.
        dimension : int
            The number of coordinates.

        Returns
        -------
        ConvexSet
            The set.

        Raises
        ------
        InputError
            If there are several keys and one of their sets is curved, or a set cannot be built; the error begins with
            the key.
        """
        members = self.members(where, dimension)
        try:
            joined = intersection(members)
        except InputError as error:
            raise error.under(where) from None
        if isinstance(joined, tuple):
            raise InputError(
                f"a curved set cannot be intersected except in path and terminal, got"
                f" {' and '.join(self._list_given_keys())}",
                path=where,
            )
        return joined


def _check_kind(registry: Registry, kind: str, value: object, keys: set[str]) -> tuple[Options | None, list[Complaint]]:
    """Return the typed options of one kind of set, or the faults in them; ``keys`` are the fields, which are no
    kinds."""
    kinds = registry.names(KIND)
    if kind not in kinds:
        return None, [Complaint((), f"unknown key{nearest(kind, {*kinds, *keys})}{registry.notes()}")]
    short = shorthand(registry.get(KIND, kind))
    if not isinstance(value, Mapping) and short is None:
        return None, [Complaint((), f"must be a mapping (got {shown(value)})")]
    if isinstance(value, Mapping):
        return registry.check(KIND, kind, value)
    typed, faults = registry.check(KIND, kind, {str(short): value})
    return typed, [replace(fault, path=fault.path[1:]) if fault.path[:1] == (short,) else fault for fault in faults]


def _make_detail(fault: Complaint) -> InitErrorDetails:
    error = PydanticCustomError(COMPLAINT, "{said}", {"said": fault.message, "below": fault.path})
    return InitErrorDetails(type=error, input=None)


def shorthand(record: Plugin) -> str | None:
    """Return the option that a bare number or list stands for; ``None`` where a kind of set has no short form."""
    return getattr(record.options_type(), "shorthand", None)


@final
class MixedOptions(Options):
    """``H x(t) + G u(t) <= h``, row by row."""

    H: RowsOfNumbers
    """One column per state."""

    G: RowsOfNumbers
    """As many rows as ``H``, one column per control."""

    h: OneOrMore
    """One number per row; a number holds for every row."""


@final
class PathOptions(SetOptions, populate_by_name=True):
    """A set in which the state stays during a window of time, or a bound of state and control together."""

    start: float = Field(default=0.0, alias="from", ge=0.0)
    """Beginning of the window."""

    stop: float | None = Field(default=None, alias="to", ge=0.0)
    """End of the window; the horizon unless given."""

    relative_to: list[list[float]] | None = None
    """Motion of the set: rows of a time and a point, with straight lines between them; at rest unless given."""

    mixed: MixedOptions | None = None
    """Bounds of state and control together, with the control of every piece that meets the window."""

    name: Annotated[str, Field(min_length=1)] | None = None
    """Name in messages, tables and figures; path, or path[0] and so on, unless given."""

    def _list_given_keys(self) -> list[str]:
        return super()._list_given_keys() + ["mixed"] * (self.mixed is not None)

    def entries(self, where: str, states: int, horizon: float) -> list[PathConstraint | MixedConstraint]:
        """Return one constraint per key.

        Parameters
        ----------
        where : str
            The key of the entry in the config, for errors.
        states : int
            The number of states.
        horizon : float
            The final time.

        Returns
        -------
        list of PathConstraint or MixedConstraint
            The constraints.

        Raises
        ------
        InputError
            If a key is at fault; the error begins with the key.
        """
        stop = horizon if self.stop is None else self.stop
        if not self.start <= stop <= horizon:
            raise InputError(
                path=where,
                expected=f"from <= to <= {horizon:g} (the horizon)",
                got=f"from {self.start:g} to {stop:g}",
            )
        members = self.members(where, states)
        if self.name is not None and len(members) + (self.mixed is not None) > 1:
            raise InputError(
                path=f"{where}.name",
                expected="one set in an entry with a name",
                got=f"{' and '.join(self._list_given_keys())}",
            )
        constraints: list[PathConstraint | MixedConstraint] = [
            PathConstraint(member, self.start, self.stop, self.name, self.relative_to) for member in members
        ]
        if self.mixed is None:
            return constraints
        if self.relative_to is not None:
            raise InputError(
                "moves the set of states that stands in the same entry, and a mixed constraint is about the state"
                " itself: write that as an entry of its own",
                path=f"{where}.relative_to",
            )
        return [
            *constraints,
            MixedConstraint(self.mixed.H, self.mixed.G, self.mixed.h, self.start, self.stop, self.name),
        ]


class TermOptions(Options, populate_by_name=True):
    """A constraint that a config writes field by field, as an entry of a list of the problem."""

    term: ClassVar[type[Window]]

    def build(self) -> Any:
        """Return the constraint."""
        return self.term(**{name: getattr(self, name) for name in type(self).model_fields})


@final
class IntegralOptions(TermOptions):
    """``lower <= int (H x(t) + G u(t)) dt <= upper`` over a window of time, row by row."""

    term = IntegralConstraint

    H: RowsOfNumbers | None = None
    """One column per state; 0 unless given."""

    G: RowsOfNumbers | None = None
    """One column per control; 0 unless given. As many rows as ``H``."""

    start: float = Field(default=0.0, alias="from", ge=0.0)
    """Beginning of the window."""

    stop: float | None = Field(default=None, alias="to", ge=0.0)
    """End of the window; the horizon unless given."""

    upper: OneOrMoreFree | None = None
    """Upper bounds, one number per row, null where there is none; a number holds for every row."""

    lower: OneOrMoreFree | None = None
    """Lower bounds, one number per row, null where there is none; a number holds for every row."""

    name: Annotated[str, Field(min_length=1)] | None = None
    """Name in messages, tables and figures; integral, or integral[0] and so on, unless given."""


@final
class InitialStateOptions(SetOptions):
    """All initial states of a set: a centre, and the set of deviations from it; without a centre, the set itself."""

    centre: OneOrMore | None = None
    """Centre of the initial states, one number per state; a number holds for every state. Without a centre the set is
    that of the states themselves, and its middle is the centre."""

    def around(self, where: str, dimension: int) -> tuple[Array, ConvexSet]:
        """Return the centre of the initial states, and the set of deviations from it.

        Parameters
        ----------
        where : str
            The key of the set in the config, for errors.
        dimension : int
            The number of states.

        Returns
        -------
        centre : array (d,)
            The centre.
        deviations : ConvexSet
            The set of deviations.

        Raises
        ------
        InputError
            If the set is not bounded, has two centres, or does not contain the deviation 0; the error begins with the
            key.
        """
        convex = self.build(where, dimension)
        if not convex.is_bounded:
            raise InputError("the set must be bounded", path=where)
        if self.centre is None:
            centre = convex.middle()
            return centre, _translate_set(convex, centre, where)
        inside = [kind for kind, typed in (self.__pydantic_extra__ or {}).items() if _has_centre(typed)]
        if inside:
            raise InputError(
                path=f"{where}.{inside[0]}.centre",
                expected=f"one centre, beside the set or inside it, not both ({where}.centre is given)",
                got="a second one",
            )
        try:
            centre = broadcast("centre", self.centre, dimension)
        except InputError as error:
            raise error.under(where) from None
        if not convex.contains(np.zeros(dimension)):
            raise InputError(
                path=where, expected="deviations among which 0 is: the set holds 0, which is the centre", got="none"
            )
        return centre, convex


def _has_centre(typed: object) -> bool:
    """Return whether a set was given a centre of its own, other than the default that a complete config writes."""
    if not isinstance(typed, Options) or "centre" not in typed.model_fields_set:
        return False
    return bool(getattr(typed, "centre", None) != type(typed).model_fields["centre"].default)


def _translate_set(convex: ConvexSet, centre: Array, where: str) -> ConvexSet:
    """Return the set of all ``x - centre``."""
    if isinstance(convex, Box):
        return Box(convex.lower - centre, convex.upper - centre)
    if isinstance(convex, Polytope):
        return Polytope(convex.H, convex.h - convex.H @ centre)
    if isinstance(convex, NormBall):
        return NormBall(convex.p, convex.radius, convex.centre - centre)
    if not centre.any():
        return convex
    untyped, record = cast("Any", convex), is_dataclass(convex)
    if record and hasattr(untyped, "centre"):
        return cast("ConvexSet", replace(untyped, centre=np.asarray(untyped.centre) - centre))
    raise InputError(path=where, expected=f"the key centre beside {convex.kind}, and 0 within it", got="none")


@final
class TerminalOptions(SetOptions):
    """A set in which the state ends, or fixed final values."""

    equals: Annotated[FreeNumbers, Field(min_length=1)] | None = None
    """Final values, one per state, null where free."""

    def _list_given_keys(self) -> list[str]:
        return super()._list_given_keys() + ["equals"] * (self.equals is not None)

    def ends(self, where: str, dimension: int) -> list[ConvexSet | Equality]:
        """Return one set or equality per key; raises `InputError` that begins with the key below ``where``."""
        ends: list[ConvexSet | Equality] = [*self.members(where, dimension)]
        if self.equals is not None:
            if len(self.equals) != dimension:
                raise InputError(
                    path=f"{where}.equals", expected=f"{count(dimension)}, null where free", got=f"{len(self.equals)}"
                )
            ends.append(Equality(np.array([np.nan if value is None else value for value in self.equals])))
        return ends
