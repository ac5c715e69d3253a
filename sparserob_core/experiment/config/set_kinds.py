"""The kinds of sets that the core computes with, as a config writes them; the plugin ``sparserob_sets``
registers them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, final

import numpy as np
from pydantic import Field, Tag, model_validator

from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, NormBall, Polytope, SetFactory
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.packed import OrPacked, RowsOfNumbers
from sparserob_core.experiment.config.option_kinds import (
    LIST,
    NUMBER,
    FreeNumbers,
    Number,
    OneOrMore,
    OneOrMoreFree,
    Sparse,
    broadcast,
    free_bound,
    one_of,
)
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array

HalfWidths: TypeAlias = Annotated[
    Number | FreeNumbers,
    one_of(
        "a half-width, a list of half-widths (null where free), or {lower: ..., upper: ...}", number=NUMBER, list=LIST
    ),
]


@final
class BoxFactory(SetFactory, Sparse):
    """``lower <= x <= upper``, or ``|x_i| <= half_widths_i``."""

    shorthand: ClassVar[str | None] = "half_widths"

    half_widths: HalfWidths | None = None
    """Half-widths about 0: a number for all coordinates, or a list with null where one is free. ``box: 0.5`` is the
    short form."""

    lower: OneOrMoreFree | None = None
    """Lower bounds; a number holds for every coordinate, and null or a missing side is free."""

    upper: OneOrMoreFree | None = None
    """Upper bounds; a number holds for every coordinate, and null or a missing side is free."""

    @model_validator(mode="after")
    def _require_one_form(self) -> BoxFactory:
        if self.half_widths is not None and not (self.lower is None and self.upper is None):
            raise InputError(expected="half_widths, or lower and upper", got="both")
        return self

    def build(self, dimension: int) -> Box:
        """Return the box."""
        if self.half_widths is None:
            return Box(
                free_bound("lower", self.lower, dimension, -np.inf), free_bound("upper", self.upper, dimension, np.inf)
            )
        half = free_bound("", self.half_widths, dimension, np.inf)
        if (half < 0).any():
            raise InputError(
                f"half-widths must be at least 0, got {half.tolist()}; write {{lower: ..., upper: ...}} for other boxes"
            )
        return Box(-half, half)

    @staticmethod
    def options_of(convex: ConvexSet) -> Mapping[str, Any] | None:
        if not isinstance(convex, Box):
            return None
        if np.array_equal(convex.lower, -convex.upper):
            return {"half_widths": _write_bounds(convex.upper)}
        return {"lower": _write_bounds(convex.lower), "upper": _write_bounds(convex.upper)}


@final
class PolytopeFactory(SetFactory, Options):
    """``H x <= h``."""

    H: RowsOfNumbers
    """Normals, one row per half-space."""

    h: OneOrMore
    """Right-hand sides, one per row; a number holds for every row."""

    def build(self, dimension: int) -> Polytope:
        """Return the polytope."""
        if {len(row) for row in self.H} != {dimension}:
            raise InputError(
                f"every row of H must have {dimension} numbers, got rows of {[len(row) for row in self.H]}"
            )
        return Polytope(np.array(self.H), np.array(self.h))

    @staticmethod
    def options_of(convex: ConvexSet) -> Mapping[str, Any] | None:
        return {"H": convex.H.tolist(), "h": convex.h.tolist()} if isinstance(convex, Polytope) else None


@final
class EllipsoidFactory(SetFactory, Sparse):
    """``(x - centre)' shape^-1 (x - centre) <= 1``."""

    centre: OneOrMore | None = None
    """Centre; the origin unless given."""

    shape: Annotated[
        Number | Annotated[list[list[float]], OrPacked(), Tag("matrix")],
        one_of(
            "a symmetric positive definite matrix, row by row, or a number for a multiple of the identity",
            number=NUMBER,
            matrix=(*LIST, Mapping),
        ),
    ]
    """Symmetric positive definite matrix; a number means that multiple of the identity, the square of a ball's
    radius."""

    def build(self, dimension: int) -> Ellipsoid:
        """Return the ellipsoid."""
        if not isinstance(self.shape, list):
            return Ellipsoid(broadcast("centre", self.centre or 0.0, dimension), self.shape * np.eye(dimension))
        if len(self.shape) != dimension or {len(row) for row in self.shape} != {dimension}:
            raise InputError(
                f"shape must have {dimension} rows of {dimension} numbers, got rows of"
                f" {[len(row) for row in self.shape]}"
            )
        return Ellipsoid(broadcast("centre", self.centre or 0.0, dimension), np.array(self.shape))

    @staticmethod
    def options_of(convex: ConvexSet) -> Mapping[str, Any] | None:
        return (
            {**_write_centre(convex.centre), "shape": convex.shape.tolist()} if isinstance(convex, Ellipsoid) else None
        )


@final
class NormFactory(SetFactory, Sparse):
    """``|x - centre|_p <= radius``."""

    p: Annotated[float, Field(ge=1.0)] | Literal["inf"]
    """Exponent of the norm, at least 1, or ``inf`` for the largest absolute value."""

    radius: float = Field(ge=0.0)
    """Radius."""

    centre: OneOrMore | None = None
    """Centre; the origin unless given."""

    def build(self, dimension: int) -> NormBall:
        """Return the ball."""
        return NormBall(float(self.p), self.radius, broadcast("centre", self.centre or 0.0, dimension))

    @staticmethod
    def options_of(convex: ConvexSet) -> Mapping[str, Any] | None:
        if not isinstance(convex, NormBall):
            return None
        exponent = "inf" if np.isinf(convex.p) else convex.p
        return {"p": exponent, "radius": convex.radius, **_write_centre(convex.centre)}


def _write_bounds(bounds: Array) -> list[float | None]:
    """Return bounds as a config writes them, with null where there is none."""
    return [float(value) if np.isfinite(value) else None for value in bounds]


def _write_centre(centre: Array) -> dict[str, Any]:
    """Return the key of a centre.

    There is none for the origin, so that a config can have the centre of the initial states as well as such a set.
    """
    return {"centre": centre.tolist()} if centre.any() else {}
