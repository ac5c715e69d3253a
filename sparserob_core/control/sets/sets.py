"""The sets of controls, disturbances, parameters, states and final states, and what can be made of several sets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, overload

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
    "Product",
    "SetFactory",
    "Zonotope",
    "cylinder",
    "intersection",
    "oblique",
    "product",
]


class SetFactory(ABC):
    """A set that a config can name; its options are the fields of the class.

    Attributes
    ----------
    shorthand : str or None
        The option that a bare number or list stands for, as in ``box: 0.5``; ``None`` where a mapping is expected.
    """

    shorthand: ClassVar[str | None] = None

    @abstractmethod
    def build(self, dimension: int) -> ConvexSet:
        """Return the set in ``dimension`` coordinates; raise `InputError` where the options do not describe one."""

    @staticmethod
    def options_of(convex: ConvexSet) -> Mapping[str, Any] | None:
        """Return the options that build a set, as a config writes them.

        Parameters
        ----------
        convex : ConvexSet
            The set.

        Returns
        -------
        mapping or None
            The options; ``None`` for a set of another kind, and here, where a kind does not override this method. A
            problem with such a set can be solved from Python and cannot be saved.
        """
        return None


@dataclass(frozen=True, eq=False)
class Equality:
    """The condition ``x_i = values_i`` on every coordinate for which a value is given.

    Parameters
    ----------
    values : array (d,)
        The values, in the units of the coordinates; NaN leaves a coordinate free.

    Raises
    ------
    InputError
        If the values are no list of finite numbers and NaN.

    Notes
    -----
    An equality is no `ConvexSet`. A set without an interior would destroy every Slater point, and therefore equalities
    remain equalities of the finite programs.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.Equality([0.0, float("nan")]).fixed.tolist()
    [0]
    """

    values: Array

    if TYPE_CHECKING:  # users may give a list; the field is an array

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
        """The dimension ``d`` of the space."""
        return int(self.values.size)

    @property
    def fixed(self) -> npt.NDArray[np.intp]:
        """The indices of the coordinates that are fixed."""
        return np.flatnonzero(~np.isnan(self.values))

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return the largest absolute deviation from the fixed values.

        Parameters
        ----------
        points : array (..., d)
            The points.

        Returns
        -------
        array (...,)
            The largest deviation of each point; 0 where nothing is fixed.
        """
        deviation: Array = np.abs(np.asarray(points)[..., self.fixed] - self.values[self.fixed]).max(
            axis=-1, initial=0.0
        )
        return deviation

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Equality:
        """Return the equality for points that are divided by ``units (d,)``."""
        return Equality(self.values / units)

    @property
    def box(self) -> Box:
        """The box of all points that satisfy the equality, with infinite sides along free coordinates."""
        free = np.isnan(self.values)
        return Box(np.where(free, -np.inf, self.values), np.where(free, np.inf, self.values))

    @property
    def bounds(self) -> ConvexSet:
        """The set that a factor enlarges: an equality has none, and `InputError` is raised."""
        raise InputError("fixes final values, which no factor enlarges; expected a set")

    @shaped
    def contains(self, points: Float[Array, "*k d"], tolerance: float = 1e-9) -> Bool[np.ndarray, " *k"]:
        """Return the points that satisfy the equality up to a tolerance, as a mask.

        Parameters
        ----------
        points : array (..., d)
            The points.
        tolerance : float, default 1e-9
            The absolute deviation that is allowed in every fixed coordinate.

        Returns
        -------
        array (...,) of bool
            True for points that deviate by no more.
        """
        inside: npt.NDArray[np.bool_] = np.asarray(self.violation(points) <= tolerance)
        return inside


def intersection(sets: Sequence[ConvexSet]) -> ConvexSet | tuple[ConvexSet, ...]:
    """Return the intersection of sets as one set, where it is a box or a polytope.

    Parameters
    ----------
    sets : sequence of ConvexSet
        The sets, all of the same dimension; at least one.

    Returns
    -------
    ConvexSet or tuple of ConvexSet
        The box or the polytope. Where a set is curved, the sets as they are.

    Raises
    ------
    InputError
        If there is no set, if dimensions differ, or if a box or a polytope is empty.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.intersection([sr.Box([-1, -1], [1, 1]), sr.Box([0, -2], [2, 2])]).lower.tolist()
    [0.0, -1.0]
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


# The relative part of a direction that may lie outside of the span of an oblique cylinder. With a hundredth of it, the
# rounding of matrix products would make the support function infinite; a hundred times as much would be no rounding.
OUTSIDE_SPAN_SHARE = 1e-12


@dataclass(frozen=True, eq=False)
class Cylinder(ConvexSet):
    """The set ``{x in R^size : x[:b] + slopes x[b:] in base}`` for a curved ``base`` in ``R^b``.

    It is made by `cylinder` and `oblique`.

    Parameters
    ----------
    base : ConvexSet
        The set in ``b`` coordinates.
    size : int
        The number of coordinates of the cylinder.
    slopes : array (b, size - b), optional
        The factors of the additional coordinates; these are free where no slopes are given.
    """

    base: ConvexSet
    size: int
    slopes: Array | None = None

    @property
    def dimension(self) -> int:
        return self.size

    @property
    def kind(self) -> str:
        return type(self).__name__.lower() if self.slopes is None else self.base.kind

    @property
    def normals(self) -> Array:
        return self._lift_directions(np.eye(self.base.dimension))

    @property
    def frame(self) -> Array:
        return self._lift_directions(self.base.frame)

    @shaped
    def along(self, z: Float[Array, "*k b"]) -> Float[Array, "*k d"]:
        return self._lift_directions(self.base.along(z))

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Cylinder:
        base, free = units[: self.base.dimension], units[self.base.dimension :]
        slopes = None if self.slopes is None else self.slopes * free / base[:, None]
        return Cylinder(self.base.in_units(base), self.size, slopes)

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions = np.asarray(directions, dtype=float)
        base, free = (directions[..., : self.base.dimension], directions[..., self.base.dimension :])
        room: Array | float = 0.0
        if self.slopes is not None:
            free, room = (free - base @ self.slopes, OUTSIDE_SPAN_SHARE * (np.abs(base) @ np.abs(self.slopes)))
        height: Array = np.where((np.abs(free) <= room).all(axis=-1), self.base.support(base), np.inf)
        return height

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        directions = np.asarray(directions, dtype=float)
        inner = self.base.support_point(directions[..., : self.base.dimension])
        return np.concatenate([inner, np.zeros((*inner.shape[:-1], self.size - self.base.dimension))], axis=-1)

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.base.violation(self._project_points(points))

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.base.gauge(self._project_points(points))

    def scaled(self, factor: float) -> Cylinder:
        return Cylinder(self.base.scaled(factor), self.size, self.slopes)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return np.concatenate([self.base.interior_point(), np.zeros(self.size - self.base.dimension)])

    def _lift_directions(self, directions: Array) -> Array:
        """Return directions ``(k, b)`` of the base as directions ``(k, size)`` of the cylinder."""
        zeros = np.zeros((*directions.shape[:-1], self.size - self.base.dimension))
        free = zeros if self.slopes is None else directions @ self.slopes
        return np.concatenate([directions, free], axis=-1)

    def _project_points(self, points: Array) -> Array:
        """Return points ``(..., size)`` projected into the space of the base: ``x[:b] + slopes x[b:]``."""
        coordinates = np.asarray(points, dtype=float)
        base, free = coordinates[..., : self.base.dimension], coordinates[..., self.base.dimension :]
        return base if self.slopes is None else base + free @ self.slopes.T


def oblique(base: ConvexSet, slopes: Array) -> Cylinder:
    """Return the cylinder ``{x : x[:d] + slopes x[d:] in base}``.

    Parameters
    ----------
    base : ConvexSet
        A curved set in ``d`` coordinates.
    slopes : array (d, more)
        The factors of the additional coordinates.
    """
    size = base.dimension + slopes.shape[1]
    if isinstance(base, Cylinder):
        free, kept = base.size - base.base.dimension, base.base.dimension
        assert base.slopes is None
        return Cylinder(base.base, size, np.hstack([np.zeros((kept, free)), slopes[:kept]]))
    return Cylinder(base, size, slopes)


@overload
def cylinder(base: ConvexSet, size: int) -> ConvexSet: ...
@overload
def cylinder(base: Equality, size: int) -> Equality: ...
def cylinder(base: ConvexSet | Equality, size: int) -> ConvexSet | Equality:
    """Return the cylinder ``{x in R^size : x[:b] in base}``, in which the additional coordinates are free.

    Parameters
    ----------
    base : ConvexSet or Equality
        The set in ``b`` coordinates.
    size : int
        The number of coordinates of the cylinder.

    Returns
    -------
    ConvexSet or Equality
        A box, a polytope or an equality where the base is one; otherwise a `Cylinder`.

    Raises
    ------
    InputError
        If ``size`` is below ``b``.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> sr.cylinder(sr.Box([-1], [1]), 2).upper.tolist()
    [1.0, inf]
    """
    free = size - base.dimension
    if free < 0:
        raise InputError(
            f"size must be at least {base.dimension}, the dimension of its base, got {size}", path="cylinder"
        )
    if isinstance(base, Equality):
        return Equality(np.append(base.values, np.full(free, np.nan)))
    if base.is_box:
        box = base.bounding_box()
        return Box(np.append(box.lower, np.full(free, -np.inf)), np.append(box.upper, np.full(free, np.inf)))
    flat = base.halfspaces()
    if flat is None and isinstance(base, Cylinder) and base.slopes is not None:
        return Cylinder(base.base, size, np.pad(base.slopes, ((0, 0), (0, free))))
    if flat is None:
        return Cylinder(base, size)
    return Polytope(np.hstack([flat[0], np.zeros((len(flat[0]), free))]), flat[1])


@dataclass(frozen=True, eq=False)
class Product(ConvexSet):
    """The set ``{(x_1, ..., x_q) : x_i in parts_i}``, with the coordinates of one part after those of another.

    Its support function is the sum of those of the parts (Rockafellar 1970, section 13). It is made by `product`.

    Parameters
    ----------
    parts : tuple of ConvexSet
        The sets.
    """

    parts: tuple[ConvexSet, ...]

    @property
    def factors(self) -> tuple[ConvexSet, ...]:
        return self.parts

    @property
    def dimension(self) -> int:
        return sum(part.dimension for part in self.parts)

    @property
    def kind(self) -> str:
        return "product of " + " and ".join(part.kind for part in self.parts)

    @property
    def span(self) -> Array:
        from scipy.linalg import block_diag

        return np.asarray(block_diag(*(part.span for part in self.parts)))

    @property
    def is_symmetric(self) -> bool:
        return all(part.is_symmetric for part in self.parts)

    @property
    def is_bounded(self) -> bool:
        return all(part.is_bounded for part in self.parts)

    def split(self, points: npt.ArrayLike) -> list[tuple[ConvexSet, Array]]:
        """Return each part of the product with its coordinates of points or directions ``(..., d)``."""
        ends = np.cumsum([part.dimension for part in self.parts])[:-1]
        return list(zip(self.parts, np.split(np.asarray(points, dtype=float), ends, axis=-1), strict=True))

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return np.asarray(sum(part.support(own) for part, own in self.split(directions)))

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        pairs = zip(self.split(centre), self.split(spread), strict=True)
        bounds = [part.continued(own, radii) for (part, own), (_, radii) in pairs]
        known_bounds = [bound for bound in bounds if bound is not None]
        return np.sum(known_bounds, axis=0) if len(known_bounds) == len(bounds) else None

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        return np.concatenate([part.support_point(own) for part, own in self.split(directions)], axis=-1)

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return how far points are outside (positive) or inside (negative) of the product.

        Outside, the value is the Euclidean norm of the positive violations of the parts. Inside, it is the violation of
        the part whose boundary is nearest.

        Parameters
        ----------
        points : array (..., d)
            The points.

        Returns
        -------
        array (...,)
            The violation of each point.
        """
        violations = np.stack([part.violation(own) for part, own in self.split(points)])
        outside = np.linalg.norm(np.maximum(violations, 0.0), axis=0)
        return np.asarray(np.where(outside > 0.0, outside, violations.max(axis=0)))

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return np.asarray(np.stack([part.gauge(own) for part, own in self.split(points)]).max(axis=0))

    @shaped
    def normal(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        """Return an outward normal ``(..., d)``: that of the part with the largest gauge, and 0 along the others."""
        pairs = self.split(points)
        first = np.stack([part.gauge(own) for part, own in pairs]).argmax(axis=0)[..., None]
        return np.concatenate([np.where(first == i, part.normal(own), 0.0) for i, (part, own) in enumerate(pairs)], -1)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return np.concatenate([part.interior_point() for part in self.parts])

    @shaped
    def middle(self) -> Float[Array, " d"]:
        return np.concatenate([part.middle() for part in self.parts])

    def scaled(self, factor: float) -> Product:
        return Product(tuple(part.scaled(factor) for part in self.parts))

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Product:
        return Product(tuple(part.in_units(own) for part, own in self.split(units)))

    @shaped
    def sample(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        return np.concatenate([part.sample(count, rng) for part in self.parts], axis=-1)

    @shaped
    def sample_extreme(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        return np.concatenate([part.sample_extreme(count, rng) for part in self.parts], axis=-1)

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        pairs = zip(self.split(centre), self.split(spread), strict=True)
        return np.asarray(sum(part.linearisation_excess(own, deviations) for (part, own), (_, deviations) in pairs))

    @shaped
    def support_majorant(
        self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]
    ) -> tuple[Float[Array, "*k d"], Float[Array, " *k"]]:
        pairs = zip(self.split(centre), self.split(spread), strict=True)
        bounds = [part.support_majorant(own, deviations) for (part, own), (_, deviations) in pairs]
        return np.concatenate([point for point, _ in bounds], axis=-1), np.sum([excess for _, excess in bounds], axis=0)

    @shaped
    def support_minorant(
        self, centre: Float[Array, " d"], spread: Float[Array, "J d"]
    ) -> tuple[float, Float[Array, " J"], Float[Array, "J J"]]:
        pairs = zip(self.split(centre), self.split(spread), strict=True)
        bounds = [part.support_minorant(own, deviations) for (part, own), (_, deviations) in pairs]
        values, gradients, hessians = zip(*bounds, strict=True)
        return float(np.sum(values)), np.sum(gradients, axis=0), np.sum(hessians, axis=0)


def product(parts: Sequence[ConvexSet]) -> ConvexSet:
    """Return the product ``{(x_1, ..., x_q) : x_i in parts_i}`` of bounded sets.

    Parameters
    ----------
    parts : sequence of ConvexSet
        The sets; at least one.

    Returns
    -------
    ConvexSet
        The part itself where there is one; a box or a polytope where all parts are one; otherwise a `Product`.
    """
    if len(parts) == 1:
        return parts[0]
    if all(part.is_box for part in parts):
        boxes = [part.bounding_box() for part in parts]
        return Box(np.concatenate([box.lower for box in boxes]), np.concatenate([box.upper for box in boxes]))
    flats = [flat for part in parts if (flat := part.halfspaces()) is not None]
    if len(flats) < len(parts):
        return Product(tuple(parts))
    from scipy.linalg import block_diag

    return Polytope(block_diag(*(H for H, _ in flats)), np.concatenate([h for _, h in flats]))
