"""Convex sets, each described by its support function and a maximiser of it.

All other properties have defaults. A set overrides a default where it knows a better answer.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.errors import InputError
from sparserob_core.shapes import Array as Array  # noqa: PLC0414  where the rest of the core takes it from
from sparserob_core.shapes import Bool, Float, sealed, shaped

# After which an interval of doubles is as short as rounding; with half of them a root has nine digits.
BISECTION_HALVINGS = 60
RELATIVE = 1e-12  # accuracy of a gauge that is computed from the support function alone
PIVOTS = 500  # largest number of support points computed for one boundary point
# Opposite sides count as one where their distance is at most this share of the set's extent along the normal. With a
# thousandth of it, gains of 1e12 are sought for deviations of 1e-12; with ten times as much, their effect is visible.
CLOSED_WIDTH_SHARE = 1e-9
SPIKE = 1e-12  # of the set's extent: half the thickness below which a set counts as one without interior
TILT = 1e-14  # angle by which a ray is turned in the choice of pivots, so that no choice is a tie
PLAIN = 3  # dimension up to which a set is sampled by rejection
MIXING = 8  # steps of hit and run per dimension
# Shares of a set's extent: EDGE is a distance from the boundary that counts as rounding, INWARDS the distance by which
# such a point is moved inside. With a tenth, rounding decides again; ten times as much would change the nominal
# trajectory in reported digits.
EDGE, INWARDS = 1e-13, 1e-12
# Number of sides of a box up to which they are added one after the other, in the order of NumPy's own sum of so few
# numbers. With ten times as many, sums are rounded in another order. With 1, sums of two or three numbers take thirty
# times as long, and a proof in several dimensions takes millions of them.
MAX_SIDES_ONE_BY_ONE = 7
DRAWS_PER_POINT = 10_000  # points drawn per wanted point before rejection sampling gives up


@shaped
def bisect(
    beyond: Callable[[Array], npt.NDArray[np.bool_]],
    low: Float[Array, " *k"],
    high: Float[Array, " *k"],
    halvings: int = BISECTION_HALVINGS,
) -> tuple[Float[Array, " *k"], Float[Array, " *k"]]:
    """Return brackets of the points at which ``beyond`` changes from false to true, one for each entry.

    Parameters
    ----------
    beyond : callable
        Maps points ``(k,)`` to truth values ``(k,)``.
    low, high : ndarray, shape (k,)
        First brackets: ``beyond`` should be false at ``low`` and true at ``high``.
    halvings : int, default HALVINGS
        Number of halvings.

    Returns
    -------
    low, high : ndarray, shape (k,)
        The last brackets. If the first brackets were right, ``beyond`` is false at ``low`` and true at ``high``.
    """
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        out = beyond(middle)
        low, high = np.where(out, low, middle), np.where(out, middle, high)
    return low, high


class ConvexSet(ABC):
    """A closed convex set, described by its support function ``h(c) = max {c'x : x in the set}``.

    Directions and points are arrays ``(..., d)``. Leading axes are kept: ``(k, d)`` gives ``(k,)``. A new kind of set
    is one class with the three abstract members `dimension`, `support` and `support_point`. The other members have
    defaults that are right for every set with an interior. A set overrides those that it can answer faster or more
    exactly.

    References
    ----------
    Rockafellar (1970), Convex Analysis, section 13.
    """

    @property
    @abstractmethod
    def dimension(self) -> int:
        """Dimension ``d`` of the space that contains the set."""

    @abstractmethod
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return the support function of directions ``(k, d)``, as ``(k,)``; ``inf`` where the set is unbounded."""

    @abstractmethod
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        """Return a maximiser ``(k, d)`` of ``c'x`` for each direction ``(k, d)``; finite wherever the support function
        is."""

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        """Return upper bounds of the absolute value of the support function at complex directions near a real one.

        The support function is continued to an analytic function of all complex directions within the given distance.

        Parameters
        ----------
        centre : ndarray, shape (k, d)
            Real directions.
        spread : ndarray, shape (k, d)
            Largest distance of each complex entry from that of the centre.

        Returns
        -------
        ndarray, shape (k,), or None
            The bounds; ``inf`` where there may be no such continuation. ``None``: nothing is known of the set.
        """
        return None

    # Shape

    @property
    def kind(self) -> str:
        """Name of this kind of set in messages."""
        return type(self).__name__.lower()

    @property
    def is_box(self) -> bool:
        """True where the set is its own `bounding_box`."""
        return False

    @property
    def is_symmetric(self) -> bool:
        """True where the set is known to be symmetric about its `middle`."""
        return self.is_box

    @shaped
    def halfspaces(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]] | None:
        """Return ``(H (r, d), h (r,))`` with the set ``= {x : H x <= h}``; ``None`` for a curved set."""
        return None

    @shaped
    def unit_ball_image(self) -> tuple[Float[Array, " d"], Float[Array, "d d"]] | None:
        """Return ``(m (d,), L (d, d))`` with the set ``= {m + L z : |z| <= 1}`` and ``L`` regular; ``None`` for another
        shape."""
        return None

    @property
    def normals(self) -> Array:
        """Orthonormal rows ``(b, d)`` that span every direction in which the support function is finite; by default all
        directions."""
        return np.eye(self.dimension)

    @property
    def span(self) -> Array:
        """Rows ``(r, d)`` that span the directions along which points of a bounded set differ.

        By default they span the whole space, except normals of opposite sides whose distance is only rounding.
        """
        flat, axes = self.halfspaces(), np.eye(self.dimension)
        if flat is None or not self.is_bounded:
            return axes
        H, radii = flat[0], self.width(axes) / 2.0
        closed = self.width(H) <= CLOSED_WIDTH_SHARE * (np.abs(H) @ radii)
        return null_space(H[closed]) if closed.any() else axes

    @property
    def frame(self) -> Array:
        """Rows ``N (b, d)`` that span the same space as `normals`, scaled so that the set is nearly round in their
        coordinates.

        With directions ``c = z N``, the set has about the same extent along every ``z`` of the same length. In other
        units of the set, ``z`` stays the same.
        """
        axes = self.normals
        width = self.width(axes)
        return few_digits(axes / np.where((width > 0.0) & np.isfinite(width), width / 2.0, 1.0)[:, None])

    @shaped
    def along(self, z: Float[Array, "*k b"]) -> Float[Array, "*k d"]:
        """Return the directions ``(k, d)`` with coordinates ``z (k, b)`` in the `frame`."""
        return np.asarray(z @ self.frame)

    @property
    def factors(self) -> tuple[ConvexSet, ...]:
        """Sets whose Cartesian product is this set; the set itself alone where it is no product."""
        return (self,)

    @property
    def is_bounded(self) -> bool:
        """True where the support function is finite in every direction."""
        axes = np.eye(self.dimension)
        return bool(np.isfinite(self.support(np.vstack([axes, -axes]))).all())

    # Values of a signal

    @property
    def is_pointwise(self) -> bool:
        """True where a signal is admissible as soon as all its values are in the set."""
        return True

    @shaped
    def of_signals(self, lengths: Float[Array, " n"]) -> ConvexSet:
        """Return the set of signals ``(d n,)`` that are constant on intervals, one coordinate after another.

        Parameters
        ----------
        lengths : ndarray, shape (n,)
            Lengths of the intervals.

        Returns
        -------
        ConvexSet
            The signals.

        Raises
        ------
        NotImplementedError
            Where the set is pointwise: then the signals are a product, of one set for each interval.
        """
        raise NotImplementedError(f"the values of a {self.kind} are not coupled")

    def in_units_of_time(self, unit: float) -> ConvexSet:
        """Return the set where times are counted in this unit; only a set that couples values depends on it."""
        return self

    @shaped
    def inside(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        """Return points of the set nearest to rounded ``points (..., d)`` of it; by default the points themselves."""
        return points

    # Size

    def bounding_box(self) -> Box:
        """Return the smallest box around the set; a side is infinite where the set is unbounded."""
        axes = np.eye(self.dimension)
        upper = self.support(axes)
        return Box(np.minimum(-self.support(-axes), upper), upper)

    @shaped
    def reach(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return ``max {|c'x| : x in the set}`` for directions ``(..., d)``, as ``(...,)``."""
        farthest: Array = np.maximum(self.support(directions), self.support(-directions))
        return farthest

    @shaped
    def width(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return ``max c'x - min c'x`` over the set for directions ``(..., d)``, as ``(...,)``."""
        between: Array = self.support(directions) + self.support(-directions)
        return between

    @property
    def radius_bound(self) -> float:
        """Upper bound of the 2-norm of any point: the largest 2-norm in the bounding box."""
        return float(np.linalg.norm(self.reach(np.eye(self.dimension))))

    def is_same(self, other: object) -> bool:
        """Return whether ``other`` is this set, or is of the same kind and holds the same numbers, bit by bit."""
        fields = getattr(self, "__dataclass_fields__", None)
        if other is self or fields is None or type(other) is not type(self):
            return other is self
        return all(_is_same(getattr(self, name), getattr(other, name)) for name in fields)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        """Return a point ``(d,)`` of the set, away from its boundary where possible; by default the mean of support
        points."""
        axes = np.eye(self.dimension)
        centre: Array = self.support_point(np.vstack([axes, -axes])).mean(axis=0)
        return centre

    @shaped
    def amid(self) -> Float[Array, " d"]:
        """Return a point ``(d,)`` well inside a bounded set, independent of the units where that is possible."""
        return self.interior_point()

    @shaped
    def middle(self) -> Float[Array, " d"]:
        """Return the centre ``(d,)`` about which the set is scaled.

        The centre is the middle of the bounding box, with 0 along sides that are free. Where the middle is outside of
        the set, the centre is the point `amid` the set.

        Raises
        ------
        InputError
            Where a side is free and 0 is not inside.
        """
        box = self.bounding_box()
        bounded = np.isfinite(box.lower) & np.isfinite(box.upper)
        middle: Array = np.where(
            bounded, (np.where(bounded, box.lower, 0.0) + np.where(bounded, box.upper, 0.0)) / 2, 0.0
        )
        size = float((box.upper - box.lower)[bounded].max(initial=0.0))
        out = float(self.violation(middle))
        if (
            abs(out) <= EDGE * size and bounded.all()
        ):  # in a triangle it may be the middle of a side, inside or outside by rounding
            within = self.amid()
            inwards: Array = middle + INWARDS * (within - middle)
            return middle if float(self.violation(within)) >= -EDGE * size else inwards
        if out <= 0.0:
            return middle
        if bounded.all():
            return self.amid()
        raise InputError(
            "it has no centre to be enlarged about: it is free on a side, and 0 is outside of it; give it bounds on"
            " both sides",
            path=self.kind,
        )

    def scaled(self, factor: float) -> ConvexSet:
        """Return the set of ``m + factor (x - m)`` for all ``x`` in the set, with ``m`` its `middle` and ``factor >=
        0``."""
        return ScaledSet(self, self.middle(), factor)

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> ConvexSet:
        """Return the set of all ``x / units`` for ``x`` in this set.

        Parameters
        ----------
        units : ndarray, shape (d,)
            Units of the coordinates, positive. Powers of two make the result exact.

        Returns
        -------
        ConvexSet
            The set in these units.
        """
        return SetInUnits(self, np.asarray(units, dtype=float))

    # Boundary

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return the Minkowski functional of points about the interior point ``m``.

        The functional is the least ``g`` for which ``m + (x - m) / g`` is in the set.

        Parameters
        ----------
        points : ndarray, shape (..., d)
            Points.

        Returns
        -------
        ndarray, shape (...,)
            At most 1 inside, above 1 outside, ``inf`` where the set has no extent towards the point.
        """
        points = np.asarray(points, dtype=float)
        middle = self.interior_point()
        rays = points.reshape(-1, self.dimension) - middle
        flat = self.halfspaces()
        if flat is None:
            sizes = self._compute_gauge(np.broadcast_to(middle, rays.shape), rays)[0]
        else:
            # rounding may put an interior point outside
            sizes = ratios(rays @ flat[0].T, np.maximum(flat[1] - flat[0] @ middle, 0.0)).max(axis=1, initial=0.0)
        return sizes.reshape(points.shape[:-1])

    @shaped
    def normal(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        """Return outward normals ``(..., d)``, of any length, at boundary points ``(..., d)``; at a corner one of its
        normals."""
        points = np.asarray(points, dtype=float)
        flat = self.halfspaces()
        if flat is not None:
            H, h = flat
            steepest: Array = H[((points @ H.T - h) / np.linalg.norm(H, axis=1)).argmax(axis=-1)]
            return steepest
        middle = self.interior_point()
        rays = points.reshape(-1, self.dimension) - middle
        return self._compute_gauge(np.broadcast_to(middle, rays.shape), rays)[1].reshape(points.shape)

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        """Return the signed distance by which points are outside of the set (positive) or inside (negative).

        The distance is 0 on the boundary, and never below ``max {c'x - h(c) : |c| = 1}``. For a flat set, the distance
        is the maximum of ``c'x - h(c)`` over the unit normals of its half-spaces. By default for a curved set, the
        value outside is the distance to the boundary along the ray from the interior point. The value inside is
        ``(gauge - 1)`` times the radius of a ball that is in the set.

        Parameters
        ----------
        points : ndarray, shape (..., d)
            Points.

        Returns
        -------
        ndarray, shape (...,)
            Violations; ``-inf`` for a flat set without half-spaces.
        """
        points = np.asarray(points, dtype=float)
        flat = self.halfspaces()
        if flat is None:
            gauge = self.gauge(points)
            length = np.linalg.norm((points - self.interior_point()) @ self.normals.T, axis=-1)
            inside = (np.minimum(gauge, 1.0) - 1.0) * (self._inner_radius if (gauge < 1.0).any() else 0.0)
            return np.asarray(np.where(gauge > 1.0, length * (1.0 - 1.0 / np.maximum(gauge, 1.0)), inside))
        H, h = flat
        if h.size == 0:
            return np.full(np.shape(points)[:-1], -np.inf)
        norms = np.linalg.norm(H, axis=1)
        excess: Array = (points @ (H / norms[:, None]).T - h / norms).max(axis=-1)
        return excess

    @shaped
    def contains(self, points: Float[Array, "*k d"], tolerance: float = 1e-9) -> Bool[np.ndarray, " *k"]:
        """Return whether each point violates nothing by more than an absolute tolerance.

        Parameters
        ----------
        points : ndarray, shape (..., d)
            Points.
        tolerance : float, default 1e-9
            Violation that is allowed.

        Returns
        -------
        ndarray of bool, shape (...,)
            True for points of the set.
        """
        points = np.asarray(points, dtype=float)
        if tolerance < 0.0 or self.halfspaces() is not None:
            return np.asarray(self.violation(points) <= tolerance)
        inside: npt.NDArray[np.bool_] = np.array(self.gauge(points) <= 1.0)  # the depth inside is not needed
        if not inside.all():
            inside[~inside] = self.violation(points[~inside]) <= tolerance
        return inside

    @shaped
    def chord(
        self, points: Float[Array, "k d"], directions: Float[Array, "k d"]
    ) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Return the chords of the set through points of it.

        Parameters
        ----------
        points : ndarray, shape (k, d)
            Points of the set.
        directions : ndarray, shape (k, d)
            Directions of the chords.

        Returns
        -------
        low, high : ndarray, shape (k,)
            Numbers with ``low <= 0 <= high``, such that ``point + s direction`` is in the set for ``low <= s <= high``.
        """
        flat = self.halfspaces()
        if flat is None:
            with np.errstate(divide="ignore"):
                high, low = (1.0 / self._compute_gauge(points, sign * directions)[0] for sign in (1.0, -1.0))
            return -low, high
        slopes, distances = directions @ flat[0].T, np.maximum(flat[1] - points @ flat[0].T, 0.0)
        slopes = np.where(np.abs(slopes) > CLOSED_WIDTH_SHARE * (np.abs(directions) @ np.abs(flat[0]).T), slopes, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            lengths = distances / slopes
        return (
            np.where(slopes < 0, lengths, -np.inf).max(axis=1, initial=-np.inf),
            np.where(slopes > 0, lengths, np.inf).min(axis=1, initial=np.inf),
        )

    @shaped
    def _compute_gauge(
        self, origins: Float[Array, "k d"], rays: Float[Array, "k d"]
    ) -> tuple[Float[Array, " k"], Float[Array, "k d"]]:
        """Return the gauge of rays about points of the set, and normals where the rays leave the set.

        The gauge is ``min {sum lambda : r = sum lambda_i v_i, lambda >= 0}`` over points ``v_i`` of the set, relative
        to the origin of the ray. This linear program has a column for each point. The dual solution of the chosen
        columns is a direction, and its support point is the column to enter (column generation; Dantzig and Wolfe
        1960).

        Parameters
        ----------
        origins : ndarray, shape (k, d)
            Points of the set.
        rays : ndarray, shape (k, d)
            Directions from these points.

        Returns
        -------
        sizes : ndarray, shape (k,)
            The gauge or slightly more, so that the ray over its gauge is in the set. The excess is less than `RELATIVE`
            of the gauge where `PIVOTS` steps suffice. ``inf`` where the set has no extent along the ray.
        normals : ndarray, shape (k, d)
            A normal where each ray leaves the set.
        """
        N = self.normals
        widths = self.width(N) / 2
        widths = np.where(widths > 0, widths, 1.0)[:, None]
        to_cube, back = N.T / widths.T, N / widths  # to coordinates in which the bounding box is a cube; of directions
        origins, rays = origins @ to_cube, rays @ to_cube
        k, b = rays.shape
        lengths = np.linalg.norm(rays, axis=1)
        signs = np.where(rays < 0, -1.0, 1.0)
        tilted = rays / np.where(lengths > 0, lengths, 1.0)[:, None] + TILT * signs * (1.0 + np.arange(b) / 7.0)
        # The first columns represent the least thickness of a set; none of them may remain in the end.
        columns = SPIKE * signs[:, :, None] * np.eye(b)
        is_artificial = np.ones((k, b), dtype=bool)
        open_ = np.flatnonzero(lengths > 0)
        for _ in range(PIVOTS):
            chosen = columns[open_]
            directions = np.linalg.solve(chosen, np.ones((open_.size, b, 1)))[..., 0]
            entering = self.support_point(directions @ back) @ to_cube - origins[open_]
            better = (directions * entering).sum(axis=1) > 1.0 + RELATIVE
            open_, chosen, entering = open_[better], chosen[better], entering[better]
            if not open_.size:
                break
            sides = np.stack([tilted[open_], entering], axis=2)
            share, slope = np.moveaxis(np.linalg.solve(np.swapaxes(chosen, 1, 2), sides), 2, 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                leaving = np.where(slope > 0, np.maximum(share, 0.0) / slope, np.inf).argmin(axis=1)
            columns[open_, leaving] = entering
            is_artificial[open_, leaving] = False
        shares = np.linalg.solve(np.swapaxes(columns, 1, 2), rays[..., None])[..., 0]
        sizes = np.where((is_artificial & (np.abs(shares) > 0)).any(axis=1), np.inf, np.abs(shares).sum(axis=1))
        return np.where(lengths > 0, sizes, 0.0), np.linalg.solve(columns, np.ones((k, b, 1)))[..., 0] @ back

    @cached_property
    def _inner_radius(self) -> float:
        """Radius of a ball about the interior point that is in the set.

        The ball lies in the polytope whose corners are the points where the axes leave the set.
        """
        axes = self.normals
        rays = np.vstack([axes, -axes])
        sizes = (
            self._compute_gauge(np.broadcast_to(self.interior_point(), rays.shape), rays)[0].reshape(2, -1).max(axis=0)
        )
        return float(1.0 / np.linalg.norm(sizes))

    # Random points

    @shaped
    def sample(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return independent random points of a bounded set.

        In up to three dimensions the points are uniform, unless the set is too thin for rejection. Otherwise hit and
        run (Smith 1984) makes them uniform in the limit only.

        Parameters
        ----------
        count : int
            Number of points.
        rng : numpy.random.Generator
            Random numbers.

        Returns
        -------
        ndarray, shape (count, d)
            Points of the set.
        """
        points = self._sample_by_rejection(count, rng) if self.dimension <= PLAIN else None
        return self._sample_by_hit_and_run(count, rng) if points is None else points

    @shaped
    def sample_extreme(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return random extreme points of a bounded set.

        By default they are the support points of directions that are uniform on the sphere.

        Parameters
        ----------
        count : int
            Number of points.
        rng : numpy.random.Generator
            Random numbers.

        Returns
        -------
        ndarray, shape (count, d)
            Extreme points.
        """
        return self.support_point(rng.normal(size=(count, self.dimension)))

    def _sample_by_rejection(self, count: int, rng: np.random.Generator) -> Array | None:
        """Return random points of the bounding box that lie in the set; ``None`` where too few of them do."""
        box = self.bounding_box()
        accepted_points, drawn_count = np.empty((0, self.dimension)), 0
        while accepted_points.shape[0] < count:
            points = rng.uniform(box.lower, box.upper, size=(max(64, count), self.dimension))
            accepted_points = np.vstack([accepted_points, points[self.contains(points, 0.0)]])
            drawn_count += points.shape[0]
            if drawn_count > DRAWS_PER_POINT * (accepted_points.shape[0] + 1):
                return None
        return accepted_points[:count]

    def _sample_by_hit_and_run(self, count: int, rng: np.random.Generator) -> Array:
        """Return the ends of ``count`` chains of hit and run, all from the interior point.

        A chain that cannot move along a line stays where it is.
        """
        points: Array = np.tile(self.interior_point(), (count, 1))
        for _ in range(MIXING * self.dimension):
            directions = rng.normal(size=points.shape)
            points = points + rng.uniform(*self.chord(points, directions))[:, None] * directions
        return points

    # Curvature of the support function

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        """Return upper bounds of the excess of the support function over its linearisation at a centre.

        The bounds hold for ``y = centre + sum_j s_j spread_j`` with ``|s_j| <= 1``.

        Parameters
        ----------
        centre : ndarray, shape (..., d)
            Directions at which the support function is linearised.
        spread : ndarray, shape (..., J, d)
            Generators of the set of directions about each centre.

        Returns
        -------
        ndarray, shape (...,)
            Proven upper bounds of ``h(y) - w'y``, with ``w`` the support point of the centre; 0 where the same point
            stays the maximiser.

        Notes
        -----
        This default follows from sublinearity of ``h``. With shares ``sum_j a_j <= 1`` of the centre, ``y`` is the sum
        of the ``a_j centre + s_j spread_j``, each convex in ``s_j``. For a smooth set the bound is of second order.
        Sets override it with a tighter one.
        """
        point = self.support_point(centre)[..., None, :]
        projections = (point * spread).sum(axis=-1)
        first = np.maximum(
            self.support(spread) - projections, self.support(-spread) + projections
        )  # with no share of the centre
        total = first.sum(axis=-1, keepdims=True)
        if not (total > 0.0).any() or not np.isfinite(total).all():
            return np.asarray(total[..., 0])
        shares = first / np.where(total > 0.0, total, 1.0)
        centre_shares = shares[..., None] * np.asarray(centre)[..., None, :]
        ahead, back = (
            self.support(centre_shares + spread) - projections,
            self.support(centre_shares - spread) + projections,
        )
        gains = np.maximum(ahead, back) - (point * centre_shares).sum(axis=-1)
        excess: Array = np.minimum(np.maximum(gains, 0.0), first).sum(axis=-1)
        return excess

    @shaped
    def support_majorant(
        self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]
    ) -> tuple[Float[Array, "*k d"], Float[Array, " *k"]]:
        """Return linear functions of ``y`` that are above the support function near a centre.

        The functions hold for ``y = centre + sum_j s_j spread_j`` with ``|s_j| <= 1``. The default is the linearisation
        plus its excess. For a box, the chord is lower.

        Parameters
        ----------
        centre : ndarray, shape (..., d)
            Directions.
        spread : ndarray, shape (..., J, d)
            Generators of the set of directions about each centre.

        Returns
        -------
        point : ndarray, shape (..., d)
            Slope of the linear function.
        offset : ndarray, shape (...,)
            Constant of the linear function: ``h(y) <= point'y + offset``.
        """
        return self.support_point(centre), self.linearisation_excess(centre, spread)

    @shaped
    def support_minorant(
        self, centre: Float[Array, " d"], spread: Float[Array, "J d"]
    ) -> tuple[float, Float[Array, " J"], Float[Array, "J J"]]:
        """Return a quadratic function of ``s`` below ``h(centre + sum_j s_j spread_j)`` for ``|s_j| <= 1``.

        The support function is convex, so its linearisation is such a function, and is the default. Curved sets may add
        a lower bound of the curvature.

        Parameters
        ----------
        centre : ndarray, shape (d,)
            Direction.
        spread : ndarray, shape (J, d)
            Generators of the set of directions about the centre.

        Returns
        -------
        value : float
            Value at ``s = 0``.
        gradient : ndarray, shape (J,)
            Gradient at ``s = 0``.
        hessian : ndarray, shape (J, J)
            Hessian.
        """
        point = self.support_point(centre[None])[0]
        return float(self.support(centre[None])[0]), spread @ point, np.zeros((spread.shape[0], spread.shape[0]))


def chords(centre: Array, reach: Array) -> tuple[Array, Array]:
    """Return ``share`` and ``excess`` of the chords ``|y| <= share y + excess`` over ``|y - centre| <= reach``.

    Where ``y`` keeps its sign, ``share`` is that sign and ``excess`` is 0.
    """
    size = np.abs(centre)
    turns = reach > size
    share = np.where(turns, centre / np.where(turns, reach, 1.0), np.sign(centre))
    return share, np.where(turns, (reach - size) * (1.0 + np.abs(share)), 0.0)


def ratios(sizes: Array, room: Array | float) -> Array:
    """Return ``size / room`` where the size is positive, ``inf`` where the room is then 0; 0 elsewhere."""
    with np.errstate(divide="ignore", invalid="ignore"):
        shares: Array = np.where(sizes > 0, sizes / room, 0.0)
    return shares


def as_bound(name: str, value: object, size: int | None = None) -> Array:
    """Return a vector of bounds from a number or a sequence.

    Parameters
    ----------
    name : str
        Name of the bound in messages.
    value : array_like
        A number, which is repeated, or ``size`` numbers. Infinities are kept.
    size : int, optional
        Number of entries; by default that of the value.

    Returns
    -------
    ndarray, shape (size,)
        The vector.

    Raises
    ------
    InputError
        For NaN, texts, truth values, or a wrong number of entries.
    """
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


def finite(name: str, value: object, size: int | None) -> Array:
    """Return a list of finite numbers as an array, of a given size where one is given; raise `InputError`."""
    numbers = as_bound(name, value, size)
    if not np.isfinite(numbers).all():
        raise InputError(path=name, expected="finite numbers", got=f"{numbers.tolist()}")
    return numbers


@dataclass(frozen=True, eq=False)
class Box(ConvexSet):
    """Box ``{x : lower <= x <= upper}``; an infinite bound leaves that side free.

    Parameters
    ----------
    lower, upper : array_like, shape (d,)
        Bounds of the coordinates.

    Raises
    ------
    InputError
        Where a bound is NaN, the lengths differ, or the box is empty.
    """

    lower: Array
    upper: Array

    if TYPE_CHECKING:  # an argument may be a list; the field is an array

        def __init__(self, lower: npt.ArrayLike, upper: npt.ArrayLike) -> None: ...

    __repr__ = noun

    def __post_init__(self) -> None:
        lower, upper = as_bound("lower", self.lower), as_bound("upper", self.upper)
        if lower.size != upper.size:
            raise InputError(f"lower has {lower.size} numbers, upper has {upper.size}", path="box")
        if (lower > upper).any() or np.isposinf(lower).any() or np.isneginf(upper).any():
            raise InputError(f"empty, lower {lower.tolist()} is above upper {upper.tolist()}", path="box")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)
        sealed(self)

    @property
    def dimension(self) -> int:
        return int(self.lower.size)

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions = np.asarray(directions, dtype=float)
        if self.is_bounded and self.dimension <= MAX_SIDES_ONE_BY_ONE:  # side by side, in the order of NumPy's sum
            sides = [(directions[..., i], self.lower[i], self.upper[i]) for i in range(self.dimension)]
            if self._is_centred:
                return np.asarray(sum(np.abs(side) * high for side, _, high in sides))
            return np.asarray(sum(np.maximum(side * high, side * low) for side, low, high in sides))
        if self.is_bounded:
            bounded: Array = np.maximum(directions * self.upper, directions * self.lower).sum(axis=-1)
            return bounded
        with np.errstate(invalid="ignore"):
            terms = np.where(directions > 0, directions * self.upper, directions * self.lower)
        height: Array = np.where(directions == 0, 0.0, terms).sum(axis=-1)
        return height

    @shaped
    def reach(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.support(directions) if self._is_centred else super().reach(directions)

    @cached_property
    def _is_centred(self) -> bool:
        """True where the box is its own mirror image about 0."""
        return bool((self.lower == -self.upper).all())

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        directions = np.asarray(directions, dtype=float)
        middle = np.clip(0.0, self.lower, self.upper)
        return np.where(directions > 0, self.upper, np.where(directions < 0, self.lower, middle))

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        flipped = np.abs(spread).sum(axis=-2) - np.abs(centre)
        width = np.where(self.upper == self.lower, 0.0, self.upper - self.lower)
        excess: Array = (width * np.maximum(flipped, 0.0)).sum(axis=-1)
        return excess

    @shaped
    def support_majorant(
        self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]
    ) -> tuple[Float[Array, "*k d"], Float[Array, " *k"]]:
        fixed = self.upper == self.lower
        half = np.where(fixed, 0.0, self.upper - self.lower) / 2
        share, excess = chords(np.asarray(centre), np.abs(spread).sum(axis=-2))
        return np.where(fixed, self.lower, self.upper - half) + half * share, (half * excess).sum(axis=-1)

    @shaped
    def halfspaces(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]]:
        identity = np.eye(self.dimension)
        rows, bounds = np.vstack([identity, -identity]), np.concatenate([self.upper, -self.lower])
        finite = np.isfinite(bounds)
        return rows[finite], bounds[finite]

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        return continued_by_signs(self.middle(), (self.upper - self.lower) / 2.0, centre, spread)

    @shaped
    def violation(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        excess: Array = np.maximum(np.asarray(points) - self.upper, self.lower - np.asarray(points)).max(axis=-1)
        return excess

    @property
    def is_box(self) -> bool:
        return True

    def bounding_box(self) -> Box:
        return self

    def scaled(self, factor: float) -> Box:
        middle = self.middle()
        lower, upper = (
            np.where(np.isfinite(side), middle + factor * (np.where(np.isfinite(side), side, 0.0) - middle), side)
            for side in (self.lower, self.upper)
        )
        return Box(lower, upper)

    @shaped
    def sample(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        return rng.uniform(self.lower, self.upper, size=(count, self.dimension))

    @shaped
    def sample_extreme(self, count: int, rng: np.random.Generator) -> Float[Array, "{count} d"]:
        """Return ``count`` random corners ``(count, d)``, all equally likely."""
        return np.where(rng.integers(0, 2, size=(count, self.dimension), dtype=np.int8) > 0, self.upper, self.lower)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        lower = np.where(np.isfinite(self.lower), self.lower, np.minimum(self.upper, 1.0) - 1.0)
        upper = np.where(np.isfinite(self.upper), self.upper, np.maximum(self.lower, -1.0) + 1.0)
        return 0.5 * (lower + upper)

    @cached_property
    def is_bounded(self) -> bool:
        return bool(np.isfinite(self.lower).all() and np.isfinite(self.upper).all())

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> Box:
        return Box(self.lower / units, self.upper / units)


def continued_by_signs(middle: Array, half: Array, centre: Array, spread: Array) -> Array:
    """Return the bounds of `ConvexSet.continued` for the support function ``sum_i middle_i z_i + half_i |z_i|``.

    Every ``|z_i|`` is replaced by ``z_i`` or ``-z_i`` where the sign of ``z_i`` cannot change. Elsewhere the bound is
    infinite.

    Parameters
    ----------
    middle, half : ndarray, shape (d,)
        Middle and half width of a box.
    centre, spread : ndarray, shape (k, d)
        Real directions, and distances of the complex ones from them.

    Returns
    -------
    ndarray, shape (k,)
        Upper bounds.
    """
    size = np.abs(centre)
    fixed = (size > spread) | (spread == 0.0) | (half == 0.0)
    return np.where(fixed.all(axis=1), (size + spread) @ (np.abs(middle) + half), np.inf)


def continued_by_corners(corners: Array, centre: Array, spread: Array) -> Array:
    """Return the bounds of `ConvexSet.continued` for the support function ``max_v v'z`` of a polytope.

    The bound is finite where one corner attains the maximum at all directions, alone or with equal copies of it.

    Parameters
    ----------
    corners : ndarray, shape (v, d)
        Corners of the polytope.
    centre, spread : ndarray, shape (k, d)
        Real directions, and distances of the complex ones from them.

    Returns
    -------
    ndarray, shape (k,)
        Upper bounds.
    """
    heights = centre @ corners.T
    best = corners[heights.argmax(axis=1)]
    changes = np.einsum("kvd,kd->kv", np.abs(best[:, None] - corners), spread)
    gaps = heights.max(axis=1, keepdims=True) - heights
    is_settled = (gaps > changes) | ~(best[:, None] != corners).any(axis=2)
    return np.where(is_settled.all(axis=1), (np.abs(best) * (np.abs(centre) + spread)).sum(axis=1), np.inf)


@dataclass(frozen=True, eq=False)
class SetInUnits(ConvexSet):
    """The set ``{x / units : x in base}``: any set in other units, made by `ConvexSet.in_units`.

    Parameters
    ----------
    base : ConvexSet
        The set.
    units : ndarray, shape (d,)
        Units of the coordinates, positive.
    """

    base: ConvexSet
    units: Array

    @property
    def dimension(self) -> int:
        return self.base.dimension

    @property
    def kind(self) -> str:
        return self.base.kind

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        return self.base.continued(centre / self.units, spread / self.units)

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.base.support(np.asarray(directions, dtype=float) / self.units)

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        return self.base.support_point(np.asarray(directions, dtype=float) / self.units) / self.units

    @shaped
    def halfspaces(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]] | None:
        flat = self.base.halfspaces()
        return None if flat is None else (flat[0] * self.units, flat[1])

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        return self.base.linearisation_excess(np.asarray(centre) / self.units, np.asarray(spread) / self.units)

    @shaped
    def support_majorant(
        self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]
    ) -> tuple[Float[Array, "*k d"], Float[Array, " *k"]]:
        point, excess = self.base.support_majorant(np.asarray(centre) / self.units, np.asarray(spread) / self.units)
        return point / self.units, excess

    @shaped
    def support_minorant(
        self, centre: Float[Array, " d"], spread: Float[Array, "J d"]
    ) -> tuple[float, Float[Array, " J"], Float[Array, "J J"]]:
        return self.base.support_minorant(np.asarray(centre) / self.units, np.asarray(spread) / self.units)

    @shaped
    def gauge(self, points: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        return self.base.gauge(np.asarray(points) * self.units)

    @shaped
    def normal(self, points: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        return self.base.normal(np.asarray(points) * self.units) * self.units

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return self.base.interior_point() / self.units

    @property
    def span(self) -> Array:
        return self.base.span / self.units

    @property
    def frame(self) -> Array:
        return self.base.frame * self.units

    @property
    def is_bounded(self) -> bool:
        return self.base.is_bounded

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> ConvexSet:
        return SetInUnits(self.base, self.units * units)


def projector(span: Array) -> Array:
    """Return the orthogonal projector ``(d, d)`` onto the span of rows ``(r, d)``; exact where the rows are axes."""
    d = span.shape[1]
    across = null_space(span) if span.any() else np.eye(d)
    if len(across) in (0, d):
        return np.eye(d) * float(not len(across))
    return np.eye(d) - across.T @ across


def null_space(rows: Array) -> Array:
    """Return orthonormal rows ``(r, d)`` that span the orthogonal complement of rows ``(k, d)``.

    Axes that belong to the complement are among them, exactly.
    """
    axes = ~rows.any(axis=0)
    unit_rows, columns = np.eye(rows.shape[1])[axes], rows[:, ~axes]
    if not columns.size:
        return unit_rows
    _, singular_values, basis = np.linalg.svd(columns / np.linalg.norm(columns, axis=1, keepdims=True))
    complement = np.zeros((basis.shape[0] - int((singular_values > SPIKE * singular_values[0]).sum()), rows.shape[1]))
    complement[:, ~axes] = basis[basis.shape[0] - len(complement) :]
    return np.vstack([unit_rows, complement])


@shaped
def few_digits(matrix: Float[Array, "b d"]) -> Float[Array, "b d"]:
    """Return a matrix ``(b, d)`` with each column rounded to 24 binary digits of its largest entry.

    Its products with ``z`` of as few digits are exact, and units that are powers of two commute with the rounding.
    """
    _, exponents = np.frexp(np.abs(matrix).max(axis=0))
    grid = np.ldexp(1.0, exponents - 24)
    return np.asarray(np.rint(matrix / grid) * grid)


@dataclass(frozen=True, eq=False)
class ScaledSet(ConvexSet):
    """The set ``{about + factor (x - about) : x in base}``: the default of `ConvexSet.scaled`.

    Parameters
    ----------
    base : ConvexSet
        The set.
    about : ndarray, shape (d,)
        Centre of the scaling, in the base.
    factor : float
        Factor, at least 0.
    """

    base: ConvexSet
    about: Array
    factor: float

    @property
    def dimension(self) -> int:
        return self.base.dimension

    @property
    def kind(self) -> str:
        return self.base.kind

    @property
    def normals(self) -> Array:
        return self.base.normals

    @property
    def span(self) -> Array:
        return self.base.span if self.factor > 0.0 else np.zeros((0, self.dimension))

    @shaped
    def support(self, directions: Float[Array, "*k d"]) -> Float[Array, " *k"]:
        directions, height = np.asarray(directions, dtype=float), self.base.support(directions)
        finite = np.isfinite(height)
        scaled_height = self.factor * np.where(finite, height, 0.0) + (1.0 - self.factor) * (directions @ self.about)
        return np.asarray(np.where(finite, scaled_height, height))

    @shaped
    def continued(self, centre: Float[Array, "k d"], spread: Float[Array, "k d"]) -> Float[Array, " k"] | None:
        bounds, shift = self.base.continued(centre, spread), np.abs((1.0 - self.factor) * self.about)
        return None if bounds is None else self.factor * bounds + (np.abs(centre) + spread) @ shift

    @shaped
    def support_point(self, directions: Float[Array, "*k d"]) -> Float[Array, "*k d"]:
        return self._scale_points(self.base.support_point(directions))

    @shaped
    def halfspaces(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]] | None:
        flat = self.base.halfspaces()
        if flat is None:
            return None
        offset = flat[0] @ self.about
        return flat[0], offset + self.factor * (flat[1] - offset)

    @shaped
    def interior_point(self) -> Float[Array, " d"]:
        return self._scale_points(self.base.interior_point())

    @shaped
    def middle(self) -> Float[Array, " d"]:
        return self._scale_points(self.base.middle())

    @shaped
    def in_units(self, units: Float[Array, " d"]) -> ConvexSet:
        return ScaledSet(self.base.in_units(units), self.about / units, self.factor)

    @shaped
    def linearisation_excess(self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]) -> Float[Array, " *k"]:
        return self.factor * self.base.linearisation_excess(centre, spread)

    @shaped
    def support_majorant(
        self, centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"]
    ) -> tuple[Float[Array, "*k d"], Float[Array, " *k"]]:
        point, excess = self.base.support_majorant(centre, spread)
        return self._scale_points(point), self.factor * excess

    @shaped
    def support_minorant(
        self, centre: Float[Array, " d"], spread: Float[Array, "J d"]
    ) -> tuple[float, Float[Array, " J"], Float[Array, "J J"]]:
        value, gradient, hessian = self.base.support_minorant(centre, spread)
        f, shift = self.factor, (1.0 - self.factor) * self.about
        return f * value + float(centre @ shift), f * gradient + spread @ shift, f * hessian

    def _scale_points(self, points: Array) -> Array:
        return self.about + self.factor * (points - self.about)


@shaped
def vertex_excess(
    vertices: Float[Array, "v d"], centre: Float[Array, "*k d"], spread: Float[Array, "*k J d"], blocks: int = 4096
) -> Float[Array, " *k"]:
    """Return the bounds of `ConvexSet.linearisation_excess` for a polytope with given vertices.

    The excess is the largest gain of any other vertex over the best vertex of the centre.

    Parameters
    ----------
    vertices : ndarray, shape (v, d)
        Vertices of the polytope.
    centre : ndarray, shape (..., d)
        Directions at which the support function is linearised.
    spread : ndarray, shape (..., J, d)
        Generators of the set of directions about each centre.
    blocks : int, default 4096
        Number of directions that are treated at once.

    Returns
    -------
    ndarray, shape (...,)
        Proven upper bounds.
    """
    flat_centre, flat_spread = centre.reshape(-1, centre.shape[-1]), spread.reshape(-1, *spread.shape[-2:])
    excess = np.empty(flat_centre.shape[0])
    for start in range(0, excess.size, blocks):
        block = slice(start, start + blocks)
        heights = flat_centre[block] @ vertices.T
        best = heights.argmax(axis=1)
        steepness = flat_spread[block] @ vertices.T
        steepness = np.abs(steepness - np.take_along_axis(steepness, best[:, None, None], axis=2)).sum(axis=1)
        gain = heights - np.take_along_axis(heights, best[:, None], axis=1) + steepness
        excess[block] = np.maximum(gain.max(axis=1), 0.0)
    return excess.reshape(centre.shape[:-1])


def _is_same(mine: object, other: object) -> bool:
    """Return whether two fields of sets hold the same numbers."""
    if isinstance(mine, ConvexSet):
        return mine.is_same(other)
    if isinstance(mine, np.ndarray) or isinstance(other, np.ndarray):
        return np.array_equal(np.asarray(mine), np.asarray(other))
    return bool(mine == other)
