"""Sets as a config writes them: one key per kind of set, several keys make their intersection, ``null`` leaves a side
free."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Literal, TypeAlias, final

import numpy as np
from pydantic import Field, Tag, model_validator

from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, Equality, NormBall, Polytope, intersection
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.option_kinds import (
    LIST,
    NUMBER,
    FreeNumbers,
    Number,
    OneOrMore,
    OneOrMoreFree,
    Sparse,
    broadcast,
    count,
    free_bound,
    one_of,
)
from sparserob_core.options import Options


@final
class Bounds(Sparse):
    """A box by its bounds; a number serves every coordinate, null and a missing side are free."""

    lower: OneOrMoreFree | None = None
    """Lower bounds."""

    upper: OneOrMoreFree | None = None
    """Upper bounds."""

    def build(self, dimension: int) -> Box:
        """The box."""
        return Box(
            free_bound("lower", self.lower, dimension, -np.inf), free_bound("upper", self.upper, dimension, np.inf)
        )


@final
class PolytopeOptions(Options):
    """``H x <= h``."""

    H: list[list[float]] = Field(min_length=1)
    """Normals, one row per half-space."""

    h: OneOrMore
    """Right-hand sides, one per row; a number serves every row."""


@final
class EllipsoidOptions(Options):
    """``(x - centre)' shape^-1 (x - centre) <= 1``."""

    centre: OneOrMore = 0.0
    """Centre."""

    shape: Annotated[
        Number | Annotated[list[list[float]], Tag("matrix")],
        one_of(
            "a symmetric positive definite matrix, row by row, or a number for a multiple of the identity",
            number=NUMBER,
            matrix=LIST,
        ),
    ]
    """Symmetric positive definite matrix; a number stands for that multiple of the identity, the square of a ball's
    radius."""


@final
class NormOptions(Options):
    """``|x - centre|_p <= radius``."""

    p: Annotated[float, Field(ge=1.0)] | Literal["inf"]
    """Exponent of the norm, at least 1, or ``inf`` for the largest absolute value."""

    radius: float = Field(ge=0.0)
    """Radius."""

    centre: OneOrMore = 0.0
    """Centre."""


BoxSpec: TypeAlias = Annotated[
    Number | FreeNumbers | Annotated[Bounds, Tag("bounds")],
    one_of(
        "a half-width, a list of half-widths (null where free), or {lower: ..., upper: ...}",
        number=NUMBER,
        list=LIST,
        bounds=(Mapping, Bounds),
    ),
]


class SetOptions(Sparse):
    """A set; several keys make the intersection of theirs."""

    box: BoxSpec | None = None
    """``|x_i| <= box_i``, one number for all or a list with null where free; or ``{lower: ..., upper: ...}``."""

    polytope: PolytopeOptions | None = None
    """``{H: ..., h: ...}``: ``H x <= h``."""

    ellipsoid: EllipsoidOptions | None = None
    """``{centre: ..., shape: ...}``: ``(x - centre)' shape^-1 (x - centre) <= 1``."""

    norm: NormOptions | None = None
    """``{p: ..., radius: ..., centre: ...}``: ``|x - centre|_p <= radius``."""

    @model_validator(mode="after")
    def _not_empty(self) -> SetOptions:
        if not self._given():
            raise InputError(expected=f"a set: {', '.join(self._kinds())}", got="none of them")
        return self

    def _kinds(self) -> tuple[str, ...]:
        return ("box", "polytope", "ellipsoid", "norm")

    def _given(self) -> list[str]:
        return [kind for kind in self._kinds() if getattr(self, kind) is not None]

    def members(self, where: str, dimension: int) -> list[ConvexSet]:
        """One set per key, in ``dimension`` coordinates; raises `InputError` that begins with the key below
        ``where``."""
        builders: dict[str, Callable[[int], ConvexSet]] = {
            "box": self._box,
            "polytope": self._polytope,
            "ellipsoid": self._ellipsoid,
            "norm": self._norm,
        }
        found = []
        for kind in self._given():
            if kind not in builders:
                continue
            try:
                member = builders[kind](dimension)
            except InputError as error:
                raise error.under(where, *(() if error.path[:1] == (kind,) else (kind,))) from None
            if member.dimension != dimension:
                raise InputError(path=f"{where}.{kind}", expected=f"{count(dimension)}", got=f"{member.dimension}")
            found.append(member)
        return found

    def build(self, where: str, dimension: int) -> ConvexSet:
        """The intersection of all keys as one set; raises `InputError` when it is curved and not a single key."""
        members = self.members(where, dimension)
        try:
            joined = intersection(members)
        except InputError as error:
            raise error.under(where) from None
        if isinstance(joined, tuple):
            raise InputError(
                f"a curved set cannot be intersected except in path and terminal, got {' and '.join(self._given())}",
                path=where,
            )
        return joined

    def _box(self, dimension: int) -> Box:
        if isinstance(self.box, Bounds):
            return self.box.build(dimension)
        half = free_bound("", self.box, dimension, np.inf)
        if (half < 0).any():
            raise InputError(
                f"half-widths must be at least 0, got {half.tolist()}; write {{lower: ..., upper: ...}} for other boxes"
            )
        return Box(-half, half)

    def _polytope(self, dimension: int) -> ConvexSet:
        assert self.polytope is not None
        if {len(row) for row in self.polytope.H} != {dimension}:
            raise InputError(
                f"every row of H must have {dimension} numbers, got rows of {[len(row) for row in self.polytope.H]}"
            )
        return Polytope(np.array(self.polytope.H), np.array(self.polytope.h))

    def _ellipsoid(self, dimension: int) -> ConvexSet:
        assert self.ellipsoid is not None
        shape = self.ellipsoid.shape
        if not isinstance(shape, list):
            return Ellipsoid(broadcast("centre", self.ellipsoid.centre, dimension), shape * np.eye(dimension))
        if len(shape) != dimension or {len(row) for row in shape} != {dimension}:
            raise InputError(
                f"shape must have {dimension} rows of {dimension} numbers, got rows of {[len(row) for row in shape]}"
            )
        return Ellipsoid(broadcast("centre", self.ellipsoid.centre, dimension), np.array(shape))

    def _norm(self, dimension: int) -> ConvexSet:
        assert self.norm is not None
        return NormBall(float(self.norm.p), self.norm.radius, broadcast("centre", self.norm.centre, dimension))


@final
class PathOptions(SetOptions, populate_by_name=True):
    """A set that the state stays in during a window of time."""

    start: float = Field(default=0.0, alias="from", ge=0.0)
    """Beginning of the window."""

    stop: float | None = Field(default=None, alias="to", ge=0.0)
    """End of the window; the horizon unless given."""


@final
class TerminalOptions(SetOptions):
    """A set, or fixed values, that the state ends in."""

    equals: Annotated[FreeNumbers, Field(min_length=1)] | None = None
    """Final values, one per state, null where free."""

    def _kinds(self) -> tuple[str, ...]:
        return (*super()._kinds(), "equals")

    def ends(self, where: str, dimension: int) -> list[ConvexSet | Equality]:
        """One set or equality per key; raises `InputError` that begins with the key below ``where``."""
        found: list[ConvexSet | Equality] = [*self.members(where, dimension)]
        if self.equals is not None:
            if len(self.equals) != dimension:
                raise InputError(
                    path=f"{where}.equals", expected=f"{count(dimension)}, null where free", got=f"{len(self.equals)}"
                )
            found.append(Equality(np.array([np.nan if value is None else value for value in self.equals])))
        return found
