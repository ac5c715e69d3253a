"""The sets that controls, disturbances, parameters, states and terminal states live in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from sparserob_core.control.sets.curved import Ellipsoid, NormBall
from sparserob_core.control.sets.polytope import Polytope
from sparserob_core.control.sets.zonotope import Zonotope
from sparserob_core.errors import InputError
from sparserob_core.shapes import Bool, Float, sealed, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

__all__ = [
    "Box",
    "ConvexSet",
    "Cylinder",
    "Ellipsoid",
    "Equality",
    "NormBall",
    "Polytope",
    "SetFactory",
    "Zonotope",
    "cylinder",
    "intersection",
]


class SetFactory(ABC):
    """A set that a config can name: its options are its fields.

    ``shorthand``: the option that a bare number or list stands for, as in ``box: 0.5``; ``None`` where a mapping is
    expected.
    """

    shorthand: ClassVar[str | None] = None

    @abstractmethod
    def build(self, dimension: int) -> ConvexSet:
        """The set in ``dimension`` coordinates; raises `InputError` when the options do not describe one."""

    @staticmethod
    def options_of(convex: ConvexSet) -> Mapping[str, Any] | None:
        """The options that build this set, as a config writes them; ``None`` for a set of another kind, and unless a
        kind says otherwise: then a problem with such a set is solved from Python, and cannot be saved."""
        return None


@dataclass(frozen=True, eq=False)
class Equality:
    """``x_i = values_i`` wherever ``values (d,)`` is a number; NaN leaves that coordinate free.

    Not a `ConvexSet`: a set without interior would destroy every Slater point, so equalities stay equalities of the
    finite programs.
    """

    values: Array

    if TYPE_CHECKING:  # what is given may be a list; what is kept is an array

        def __init__(self, values: npt.ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        try:
            values = np.atleast_1d(np.array(self.values, dtype=float))
        except (TypeError, ValueError) as error:
            raise InputError(
                path="equality", expected="a list of numbers, null where free", got=f"{self.values!r}"
            ) from error
        if values.ndim != 1 or values.size == 0 or np.isinf(values).any():
            raise InputError(
                path="equality", expected="a list of finite numbers, null where free", got=f"{values.tolist()}"
            )
        object.__setattr__(self, "values", values)
        sealed(self)

    @property
    def dimension(self) -> int:
        """Dimension of the space."""
        return int(self.values.size)

    @property
    def fixed(self) -> npt.NDArray[np.intp]:
        """Indices of the coordinates that are fixed."""
        return np.flatnonzero(~np.isnan(self.values))

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Largest absolute deviation ``(...,)`` of points ``(..., d)`` from the fixed values; 0 when nothing is
        fixed."""
        deviation: Array = np.abs(np.asarray(points)[..., self.fixed] - self.values[self.fixed]).max(
            axis=-1, initial=0.0
        )
        return deviation

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Equality:
        """The same values as ``values / units``, ``(d,)`` each."""
        return Equality(self.values / units)

    @shaped
    def contains(self, points: Float[Array, "*k d"], tolerance: float = 1e-9) -> Bool[np.ndarray, " *k"]:
        """Whether points ``(..., d)`` deviate by at most the absolute ``tolerance``."""
        inside: npt.NDArray[np.bool_] = np.asarray(self.violation(points) <= tolerance)
        return inside


def intersection(sets: Sequence[ConvexSet]) -> ConvexSet | tuple[ConvexSet, ...]:
    """The intersection as one set where that is a box or a polytope, else the members as they are.

    Raises `InputError` when there is no member, dimensions differ, or a flat intersection is empty.
    """
    if not sets:
        raise InputError("expected at least one set", path="intersection")
    if len({member.dimension for member in sets}) > 1:
        raise InputError(f"dimensions differ, {[member.dimension for member in sets]}", path="intersection")
    if len(sets) == 1:
        return sets[0]
    if all(member.is_box for member in sets):
        boxes = [member.bounding_box() for member in sets]
        return Box(np.max([box.lower for box in boxes], axis=0), np.min([box.upper for box in boxes], axis=0))
    flats = [flat for member in sets if (flat := member.halfspaces()) is not None]
    if len(flats) < len(sets):
        return tuple(sets)
    return Polytope(np.vstack([H for H, _ in flats]), np.concatenate([h for _, h in flats]))


@dataclass(frozen=True, eq=False)
class Cylinder(ConvexSet):
    """``{x in R^size : x[:b] in base}`` for a curved ``base`` in ``R^b``: the other coordinates are free. Made by
    `cylinder`."""

    base: ConvexSet
    size: int

    @property
    def dimension(self) -> int:
        return self.size

    @property
    def normals(self) -> Array:
        return np.eye(self.base.dimension, self.size)

    @property
    def frame(self) -> Array:
        own = self.base.frame
        return np.hstack([own, np.zeros((own.shape[0], self.size - own.shape[1]))])

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Cylinder:
        return Cylinder(self.base.in_units(units[: self.base.dimension]), self.size)

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions = np.asarray(directions, dtype=float)
        bounded = (directions[..., self.base.dimension :] == 0.0).all(axis=-1)
        height: Array = np.where(bounded, self.base.support(directions[..., : self.base.dimension]), np.inf)
        return height

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        directions = np.asarray(directions, dtype=float)
        inner = self.base.support_point(directions[..., : self.base.dimension])
        return np.concatenate([inner, np.zeros((*inner.shape[:-1], self.size - self.base.dimension))], axis=-1)

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.base.violation(np.asarray(points)[..., : self.base.dimension])

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.base.gauge(np.asarray(points)[..., : self.base.dimension])

    def scaled(self, factor: float) -> Cylinder:
        return Cylinder(self.base.scaled(factor), self.size)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return np.concatenate([self.base.interior_point(), np.zeros(self.size - self.base.dimension)])


def cylinder(base: ConvexSet, size: int) -> ConvexSet:
    """``{x in R^size : x[:b] in base}``, as a box or a polytope where it is one. Raises `InputError` when ``size`` is
    below ``b``."""
    free = size - base.dimension
    if free < 0:
        raise InputError(
            f"size must be at least {base.dimension}, the dimension of its base, got {size}", path="cylinder"
        )
    if base.is_box:
        box = base.bounding_box()
        return Box(np.append(box.lower, np.full(free, -np.inf)), np.append(box.upper, np.full(free, np.inf)))
    flat = base.halfspaces()
    if flat is None:
        return Cylinder(base, size)
    return Polytope(np.hstack([flat[0], np.zeros((len(flat[0]), free))]), flat[1])
