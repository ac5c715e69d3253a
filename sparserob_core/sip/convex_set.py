"""Convex sets as the framework sees them: a support function, a maximiser of it, and half-spaces when flat."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError

Array: TypeAlias = npt.NDArray[np.float64]


class ConvexSet(ABC):
    """A closed convex set, described by its support function ``h(c) = max {c'x : x in the set}`` (Rockafellar 1970,
    section 13).

    Directions and points are arrays ``(..., d)``: any leading axes are kept, ``(k, d)`` gives ``(k,)``.
    """

    @property
    @abstractmethod
    def dimension(self) -> int:
        """Dimension of the space that the set lives in."""

    @abstractmethod
    def support(self, directions: Array) -> Array:
        """Support function of directions ``(k, d)``, as ``(k,)``; ``inf`` where the set is unbounded."""

    @abstractmethod
    def support_point(self, directions: Array) -> Array:
        """A maximiser ``(k, d)`` of ``c'x`` for each direction ``(k, d)``; finite wherever the support function is."""

    def halfspaces(self) -> tuple[Array, Array] | None:
        """``(H (r, d), h (r,))`` with the set ``= {x : H x <= h}``, or ``None`` for a curved set."""
        return None

    def reach(self, directions: Array) -> Array:
        """``max {|c'x| : x in the set}`` of directions ``(..., d)``, as ``(...,)``."""
        farthest: Array = np.maximum(self.support(directions), self.support(-directions))
        return farthest

    @property
    def radius_bound(self) -> float:
        """An upper bound of the 2-norm of any point: that of the corner of the bounding box."""
        return float(np.linalg.norm(self.reach(np.eye(self.dimension))))

    def linearisation_excess(self, centre: Array, spread: Array) -> Array:
        """How much the support function can exceed its linearisation at ``centre (..., d)``, over
        ``centre + sum_j s_j spread_j``, ``|s_j| <= 1``.

        ``spread (..., J, d)``; returns ``(...,)``, proven upper bounds of ``h(y) - w'y`` with ``w`` the support point
        of the centre (0 where the same point stays the maximiser). This default follows from sublinearity of ``h``;
        sets override it with a tighter one.
        """
        point = self.support_point(centre)[..., None, :]
        along = (point * spread).sum(axis=-1)
        excess: Array = np.maximum(self.support(spread) - along, self.support(-spread) + along).sum(axis=-1)
        return excess

    def support_minorant(self, centre: Array, spread: Array) -> tuple[float, Array, Array]:
        """A quadratic below ``h(centre + sum_j s_j spread_j)`` for ``|s_j| <= 1``: value, gradient ``(J,)`` and Hessian
        ``(J, J)`` in ``s``.

        ``centre (d,)``, ``spread (J, d)``. The support function is convex, so its linearisation will do; curved sets
        add what they are sure of.
        """
        point = self.support_point(centre[None])[0]
        return float(self.support(centre[None])[0]), spread @ point, np.zeros((spread.shape[0], spread.shape[0]))

    def violation(self, points: Array) -> Array:
        """``max {c'x - h(c) : |c| = 1}`` of points ``(..., d)``: how far outside (positive) or inside (negative) they
        are.

        For a flat set the maximum is over the normals of its half-spaces only; ``-inf`` when there are none.
        """
        flat = self.halfspaces()
        if flat is None:
            raise NotImplementedError(f"{type(self).__name__} has no half-spaces and must define its violation")
        H, h = flat
        if h.size == 0:
            return np.full(np.shape(points)[:-1], -np.inf)
        norms = np.linalg.norm(H, axis=1)
        excess: Array = (np.asarray(points) @ (H / norms[:, None]).T - h / norms).max(axis=-1)
        return excess

    def contains(self, points: Array, tolerance: float = 1e-9) -> npt.NDArray[np.bool_]:
        """Whether points ``(..., d)`` violate nothing by more than the absolute ``tolerance``."""
        inside: npt.NDArray[np.bool_] = np.asarray(self.violation(points) <= tolerance)
        return inside

    def interior_point(self) -> Array:
        """A point ``(d,)`` of the set, away from its boundary where the set allows; here the mean of support points."""
        axes = np.eye(self.dimension)
        centre: Array = self.support_point(np.vstack([axes, -axes])).mean(axis=0)
        return centre

    @property
    def normals(self) -> Array:
        """Orthonormal rows ``(b, d)`` that span every direction in which the support function is finite; here all of
        them."""
        return np.eye(self.dimension)

    @property
    def frame(self) -> Array:
        """Rows ``N (b, d)`` that span what `normals` span, in whose coordinates ``c = z N`` the set is about round: it
        reaches about as far along every ``z`` of the same length. In other units of the set ``z`` stays the same."""
        axes = self.normals
        width = self.support(axes) + self.support(-axes)
        return few_digits(axes / np.where((width > 0.0) & np.isfinite(width), width / 2.0, 1.0)[:, None])

    def in_units(self, units: Array) -> ConvexSet:
        """The set of all ``x / units`` for ``x`` in this one; ``units (d,)`` positive. Exact for powers of two."""
        return SetInUnits(self, np.asarray(units, dtype=float))

    @property
    def is_bounded(self) -> bool:
        """Whether the support function is finite in every direction."""
        axes = np.eye(self.dimension)
        return bool(np.isfinite(self.support(np.vstack([axes, -axes]))).all())


def as_bound(name: str, value: object, size: int | None = None) -> Array:
    """A bound vector from a number or a sequence; NaN, texts and truth values are refused, infinities are kept."""
    try:
        if np.asarray(value).dtype.kind in "bSU":
            raise TypeError("no numbers")
        array = np.atleast_1d(np.asarray(value, dtype=float))
    except (TypeError, ValueError) as error:
        raise InputError(path=name, expected="a number or a list of numbers", got=f"{value!r}") from error
    if array.ndim != 1 or array.size == 0:
        raise InputError(path=name, expected="a list of numbers", got=f"an array of shape {array.shape}")
    if size is not None and array.size == 1:
        array = np.full(size, array[0])
    if size is not None and array.size != size:
        raise InputError(path=name, expected=f"{size} numbers", got=f"{array.size}")
    if np.isnan(array).any():
        raise InputError(path=name, expected="numbers", got=f"NaN in {array.tolist()}")
    return array


@dataclass(frozen=True, eq=False)
class Box(ConvexSet):
    """``{x : lower <= x <= upper}``; an infinite bound leaves that side free.

    ``lower``, ``upper``: ``(d,)``. Raises `InputError` when a bound is NaN, the lengths differ, or the box is empty.
    """

    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        lower, upper = as_bound("lower", self.lower), as_bound("upper", self.upper)
        if lower.size != upper.size:
            raise InputError(f"lower has {lower.size} numbers, upper has {upper.size}", path="box")
        if (lower > upper).any() or np.isposinf(lower).any() or np.isneginf(upper).any():
            raise InputError(f"empty, lower {lower.tolist()} is above upper {upper.tolist()}", path="box")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    @property
    def dimension(self) -> int:
        return int(self.lower.size)

    def support(self, directions: Array) -> Array:
        directions = np.asarray(directions, dtype=float)
        if self.is_bounded:
            bounded: Array = np.maximum(directions * self.upper, directions * self.lower).sum(axis=-1)
            return bounded
        with np.errstate(invalid="ignore"):
            terms = np.where(directions > 0, directions * self.upper, directions * self.lower)
        height: Array = np.where(directions == 0, 0.0, terms).sum(axis=-1)
        return height

    def support_point(self, directions: Array) -> Array:
        directions = np.asarray(directions, dtype=float)
        middle = np.clip(0.0, self.lower, self.upper)
        return np.where(directions > 0, self.upper, np.where(directions < 0, self.lower, middle))

    def linearisation_excess(self, centre: Array, spread: Array) -> Array:
        flipped = np.abs(spread).sum(axis=-2) - np.abs(centre)
        width = np.where(self.upper == self.lower, 0.0, self.upper - self.lower)
        excess: Array = (width * np.maximum(flipped, 0.0)).sum(axis=-1)
        return excess

    def halfspaces(self) -> tuple[Array, Array]:
        identity = np.eye(self.dimension)
        rows, bounds = np.vstack([identity, -identity]), np.concatenate([self.upper, -self.lower])
        finite = np.isfinite(bounds)
        return rows[finite], bounds[finite]

    def violation(self, points: Array) -> Array:
        excess: Array = np.maximum(np.asarray(points) - self.upper, self.lower - np.asarray(points)).max(axis=-1)
        return excess

    def interior_point(self) -> Array:
        lower = np.where(np.isfinite(self.lower), self.lower, np.minimum(self.upper, 1.0) - 1.0)
        upper = np.where(np.isfinite(self.upper), self.upper, np.maximum(self.lower, -1.0) + 1.0)
        return 0.5 * (lower + upper)

    @property
    def is_bounded(self) -> bool:
        return bool(np.isfinite(self.lower).all() and np.isfinite(self.upper).all())

    def in_units(self, units: Array) -> Box:
        return Box(self.lower / units, self.upper / units)


@dataclass(frozen=True, eq=False)
class SetInUnits(ConvexSet):
    """``{x / units : x in base}``: any set in other units ``(d,)``. Made by `ConvexSet.in_units`."""

    base: ConvexSet
    units: Array

    @property
    def dimension(self) -> int:
        return self.base.dimension

    def support(self, directions: Array) -> Array:
        return self.base.support(np.asarray(directions, dtype=float) / self.units)

    def support_point(self, directions: Array) -> Array:
        return self.base.support_point(np.asarray(directions, dtype=float) / self.units) / self.units

    def halfspaces(self) -> tuple[Array, Array] | None:
        flat = self.base.halfspaces()
        return None if flat is None else (flat[0] * self.units, flat[1])

    def linearisation_excess(self, centre: Array, spread: Array) -> Array:
        return self.base.linearisation_excess(np.asarray(centre) / self.units, np.asarray(spread) / self.units)

    def support_minorant(self, centre: Array, spread: Array) -> tuple[float, Array, Array]:
        return self.base.support_minorant(np.asarray(centre) / self.units, np.asarray(spread) / self.units)

    def violation(self, points: Array) -> Array:
        """Of the right sign, and at most the distance: that of the base in its largest unit."""
        excess: Array = self.base.violation(np.asarray(points) * self.units) / self.units.max()
        return excess

    def interior_point(self) -> Array:
        return self.base.interior_point() / self.units

    @property
    def frame(self) -> Array:
        return self.base.frame * self.units

    @property
    def is_bounded(self) -> bool:
        return self.base.is_bounded

    def in_units(self, units: Array) -> ConvexSet:
        return SetInUnits(self.base, self.units * units)


def few_digits(matrix: Array) -> Array:
    """A matrix ``(b, d)`` with the entries of each column rounded to 24 binary digits of its largest: what ``z`` with
    as few digits makes of it is exact, and units that are powers of two pass through."""
    _, exponents = np.frexp(np.abs(matrix).max(axis=0))
    grid = np.ldexp(1.0, exponents - 24)
    return np.asarray(np.rint(matrix / grid) * grid)


def vertex_excess(vertices: Array, centre: Array, spread: Array, blocks: int = 4096) -> Array:
    """`ConvexSet.linearisation_excess` of a polytope with ``vertices (v, d)``: how much any other vertex can gain on
    the centre's best one."""
    flat_centre, flat_spread = centre.reshape(-1, centre.shape[-1]), spread.reshape(-1, *spread.shape[-2:])
    excess = np.empty(flat_centre.shape[0])
    for start in range(0, excess.size, blocks):
        part = slice(start, start + blocks)
        heights = flat_centre[part] @ vertices.T
        best = heights.argmax(axis=1)
        steepness = flat_spread[part] @ vertices.T
        steepness = np.abs(steepness - np.take_along_axis(steepness, best[:, None, None], axis=2)).sum(axis=1)
        gain = heights - np.take_along_axis(heights, best[:, None], axis=1) + steepness
        excess[part] = np.maximum(gain.max(axis=1), 0.0)
    return excess.reshape(centre.shape[:-1])
