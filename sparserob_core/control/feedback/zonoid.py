"""Effects of measurable disturbances of one piece on the state at its end: a set of vectors, the integral of a set.

``Z = {int_0^l K(r) (w(r) - m) dr : w(r) in W}`` is convex (Lyapunov 1940, Aumann 1965) and closed; its support function
is ``int_0^l max_v (v - m)'K(r)'a dr`` over the corners ``v`` of ``W``. The best corner changes at finitely many times,
the roots of exponential polynomials. They are searched for where samples do not prove that one corner is the best; the
integral in between is that of a polynomial.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.enclosures.matrix_exponential import exponential
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from collections.abc import Sequence

DEGREE = 18  # at most, of the polynomials that stand for the kernel on a part of a piece
REST = 2.0**-56  # of the kernel: what a polynomial may leave out
PARTS, MOST_PARTS = 4, 4096  # of a piece at least, and at most
FAST = 1.0  # what a part may be of the time in which the system changes by e
HALVINGS = 24  # of a part on which it is not certain which corner is best
NEWTON = 5  # steps to a root; with 3 of them ten times as many cells beside one are cut again
FLAT = 2.0**-44  # of the largest height: a difference of heights that is rounding
HELD = 2_000_000  # numbers that are held at once
NEGLIGIBLE = 1e-13  # of the largest extent, one that is rounding
PIVOTS = 500  # points asked for at most on the way to one point's parts; of four coordinates 490 were seen
RELATIVE = 2e-14  # by which a gauge may be too large
SPIKE, TILT = 1e-12, 1e-14  # as in `ConvexSet`
EDGE = 1e-9  # of a cell, a root that is so near to an end is no progress


def has_corners(bound: ConvexSet) -> bool:
    """Return whether the `corners` of a set are known."""
    return bound.is_box or getattr(bound, "vertices", None) is not None


def corners(bound: ConvexSet) -> list[Array]:
    """Return corners ``(v, mw)`` of sets that add up to a set less its middle: of a box one set for every channel."""
    if bound.is_box:
        box = bound.bounding_box()
        radii = (box.upper - box.lower) / 2
        return [np.outer([1.0, -1.0], row) for row in np.diag(radii)[radii > 0.0]]
    vertices = getattr(bound, "vertices", None)
    assert vertices is not None
    return [np.asarray(vertices) - bound.middle()]


@final
@dataclass(frozen=True, eq=False)
class Arc:
    """A signal on a piece: ``values (n, mw)``, deviations from the middle, that follow one another, each until its
    share ``ends (n,)`` of the piece."""

    ends: Array
    values: Array


@final
@dataclass(frozen=True, eq=False)
class KernelPolynomial:
    """Kernel ``K (d, mw)`` from a disturbance at any time of a piece to the state at its end, as polynomials.

    Parameters
    ----------
    terms : ndarray, shape (S, p + 1, d, mw)
        Coefficients of polynomials of ``u`` from -1 to 1 across each part of the piece.
    ends : ndarray, shape (S + 1,)
        Ends of the parts, as times that are left until the end of the piece, from 0 on.
    """

    terms: Array
    ends: Array

    @staticmethod
    def of(A: Array, E: Array, length: float) -> KernelPolynomial:
        """Return the kernel ``e^{A r} E`` for ``r`` from 0 to ``length``, on equal parts."""
        count = _choose_part_count(A, length)
        half, term = length / count / 2.0, E
        flows = exponential(A * ((np.arange(count) + 0.5) * (2.0 * half))[:, None, None])
        terms = []
        for order in range(_choose_degree(float(np.linalg.norm(A, 2)) * half) + 1):
            terms.append(flows @ term)
            term = A @ term * (half / (order + 1))
        return KernelPolynomial(np.stack(terms, axis=1), np.linspace(0.0, length, count + 1))

    @staticmethod
    def joined(kernels: Sequence[Array], ends: Array, counts: Sequence[int]) -> KernelPolynomial:
        """Join the kernels of consecutive intervals, without terms of negligible size at the highest orders.

        Parameters
        ----------
        kernels : sequence of ndarray, shape (q + 1, d, mw)
            Polynomials of the share, from 0 to 1, of each interval: the kernel times the length of the interval.
        ends : ndarray, shape (n + 1,)
            Ends of the intervals, as times that are left until the end of the piece.
        counts : sequence of int
            Number of equal parts of each interval.
        """
        terms, cuts = [], [ends[:1]]
        for kernel, low, high, count in zip(kernels, ends[:-1], ends[1:], counts, strict=True):
            part_terms = np.einsum("skj,jdw->skdw", _build_expansion_matrices(len(kernel), count), kernel) / (
                high - low
            )
            terms.append(part_terms)
            cuts.append(low + (high - low) * np.arange(1, count + 1) / count)
        size = max(len(kernel) for kernel in kernels)
        coefficients = np.concatenate(
            [np.pad(part_terms, ((0, 0), (0, size - part_terms.shape[1]), (0, 0), (0, 0))) for part_terms in terms]
        )
        sizes = np.abs(coefficients).max(axis=(0, 2, 3))
        significant = np.flatnonzero(sizes > REST * sizes.max(initial=0.0))
        return KernelPolynomial(coefficients[:, : 1 + int(significant.max(initial=0))], np.concatenate(cuts))

    @cached_property
    def halves(self) -> Array:
        """Half the length of every part, ``(S,)``."""
        return np.diff(self.ends) / 2.0


@final
@dataclass(frozen=True, eq=False)
class Zonoid(ConvexSet):
    """``Z`` of a piece in coordinates ``into (r, d)`` of the state, from what a disturbance makes of that (``kernel``),
    with the `corners` of ``W`` in ``parts``. ``outward (d, r)`` brings the coordinates back; the set is about round in
    them.

    Times count backwards, from the end of the piece.
    """

    kernel: KernelPolynomial
    parts: tuple[Array, ...]
    into: Array
    outward: Array

    @staticmethod
    def of(kernel: KernelPolynomial, bound: ConvexSet) -> Zonoid:
        """Return the set of one piece, in the coordinates in which the ellipsoid of its second moments is a ball."""
        corner_sets, (d, mw) = tuple(corners(bound)), kernel.terms.shape[2:]
        nodes, weights = np.polynomial.legendre.leggauss(32)
        share = weights * kernel.halves[:, None]
        reach = (
            np.zeros(mw)
            if not corner_sets
            else np.max([np.abs(corner_set).max(axis=0) for corner_set in corner_sets], axis=0)
        )
        powers = nodes[:, None] ** np.arange(kernel.terms.shape[1])
        kernel_values = np.einsum("np,spdw->sndw", powers, kernel.terms) * reach
        moments = (
            (kernel_values * np.sqrt(share)[:, :, None, None]).reshape(-1, d, mw).transpose(1, 0, 2).reshape(d, -1)
        )
        U, sizes, _ = np.linalg.svd(moments, full_matrices=False)
        kept = sizes > NEGLIGIBLE * sizes.max(initial=0.0)
        U, sizes = U[:, kept], sizes[kept]
        return Zonoid(kernel, corner_sets, (U / sizes).T, U * sizes)

    @property
    def dimension(self) -> int:
        return int(self.into.shape[0])

    def middle(self) -> Array:
        """Return the middle of ``W`` throughout: 0."""
        return np.zeros(self.dimension)

    def interior_point(self) -> Array:
        return np.zeros(self.dimension)

    def chord(self, points: Array, directions: Array) -> tuple[Array, Array]:
        if not points.any() and np.array_equal(directions, np.eye(self.dimension)):
            return self._chords
        return super().chord(points, directions)

    @cached_property
    def _chords(self) -> tuple[Array, Array]:
        """The chords through 0 along the axes, of which every program asks."""
        axes = np.eye(self.dimension)
        if not self.is_symmetric:
            return super().chord(np.zeros_like(axes), axes)
        high = 1.0 / self._compute_gauge(np.zeros_like(axes), axes)[0]
        return -high, high

    @property
    def is_symmetric(self) -> bool:
        return all(corner_set.shape[0] == 2 and not corner_set.sum(axis=0).any() for corner_set in self.parts)

    @property
    def kind(self) -> str:
        return "set of what a measurable disturbance does on a piece"

    @property
    def count(self) -> int:
        """Number ``S`` of parts of the piece."""
        return int(self.kernel.ends.size - 1)

    @property
    def channels(self) -> int:
        """Number ``mw`` of entries of a disturbance."""
        return int(self.kernel.terms.shape[3])

    @cached_property
    def coefficients(self) -> Array:
        """``K`` on every part as a polynomial of ``u`` from -1 to 1 across it, ``(S, p + 1, r, mw)``."""
        return np.asarray(self.into @ self.kernel.terms)

    @cached_property
    def integrals(self) -> Array:
        """The integral of the `coefficients` over time from the middle of a part, ``(S, p + 2, r, mw)``."""
        orders, halves = np.arange(1, self.coefficients.shape[1] + 1), self.kernel.halves
        terms = halves[:, None, None, None] * self.coefficients / orders[:, None, None]
        return np.concatenate([np.zeros_like(self.coefficients[:, :1]), terms], axis=1)

    @cached_property
    def across(self) -> Array:
        """The integral over every part, ``(S, r, mw)``."""
        signs = (-1.0) ** np.arange(self.integrals.shape[1])
        return np.asarray((self.integrals * (1.0 - signs)[:, None, None]).sum(axis=1))

    @cached_property
    def nodes(self) -> Array:
        """``K`` at the ends of the parts, ``(S + 1, r, mw)``."""
        signs = (-1.0) ** np.arange(self.coefficients.shape[1])
        first = (self.coefficients[0] * signs[:, None, None]).sum(axis=0)
        return np.concatenate([first[None], self.coefficients.sum(axis=1)])

    @cached_property
    def curvature_bounds(self) -> Array:
        """Bounds of the second derivatives of ``K`` by ``u`` on every part, ``(S, r, mw)``."""
        orders = np.arange(self.coefficients.shape[1])
        return np.asarray((np.abs(self.coefficients) * (orders * (orders - 1))[:, None, None]).sum(axis=1))

    def support(self, directions: Array) -> Array:
        flat = np.asarray(directions, dtype=float).reshape(-1, self.dimension)
        values = np.zeros(flat.shape[0])
        for corner_set in self.parts:
            for chunk in self._split_into_chunks(flat.shape[0], corner_set):
                values[chunk] += self._sweep_corners(corner_set, flat[chunk]).values()
        return values.reshape(np.shape(directions)[:-1])

    def support_point(self, directions: Array) -> Array:
        flat = np.asarray(directions, dtype=float).reshape(-1, self.dimension)
        points = np.zeros(flat.shape)
        for corner_set in self.parts:
            for chunk in self._split_into_chunks(flat.shape[0], corner_set):
                points[chunk] += self._sweep_corners(corner_set, flat[chunk]).points()
        points[~flat.any(axis=1)] = 0.0
        return points.reshape(np.shape(directions))

    def signals(self, points: Array) -> list[Arc]:
        """Return a signal that leads nearly to each of the points ``(k, r)`` of the set (`evaluate_signal` says where):
        a mean of at most ``r`` that attain support functions and of the middle (Caratheodory)."""
        all_directions, shares = self._decompose_points(points)
        return [
            _combine_arcs([self.best(a) for a in directions[share > 0.0]], share[share > 0.0], self.channels)
            for directions, share in zip(all_directions, shares, strict=True)
        ]

    def best(self, direction: Array) -> Arc:
        """Return the signal that attains the support function of a direction ``(r,)``."""
        arcs = [self._sweep_corners(corner_set, direction[None]).arc() for corner_set in self.parts]
        return _combine_arcs(arcs, np.ones(len(arcs)), self.channels)

    def evaluate_signal(self, signal: Arc) -> Array:
        """Return the point ``(r,)`` that a signal leads to."""
        ends, halves = self.kernel.ends, self.kernel.halves
        remaining_times = ends[-1] * (1.0 - np.concatenate([[0.0], signal.ends]))
        part_numbers = np.clip(np.searchsorted(ends, remaining_times, side="right") - 1, 0, self.count - 1)
        along = (remaining_times - ends[part_numbers]) / halves[part_numbers] - 1.0
        orders = np.arange(self.integrals.shape[1])
        powers = along[:, None] ** orders - (-1.0) ** orders
        cumulative = np.concatenate([np.zeros((1, *self.across.shape[1:])), np.cumsum(self.across, axis=0)])
        integrals = cumulative[part_numbers] + np.einsum("np,nprw->nrw", powers, self.integrals[part_numbers])
        return np.asarray(np.einsum("nrw,nw->r", integrals[:-1] - integrals[1:], signal.values))

    def _split_into_chunks(self, size: int, part: Array) -> Iterator[slice]:
        step = max(1, HELD // ((self.count + 1) * max(self.channels, part.shape[0])))
        return (slice(first, first + step) for first in range(0, size, step))

    def _sweep_corners(self, part: Array, directions: Array) -> _Sweep:
        return _Sweep(self, part, directions)

    def _decompose_points(self, points: Array) -> tuple[Array, Array]:
        """Return directions ``(k, r, r)`` and shares ``(k, r)``, at most 1 together, such that the support points of
        the directions in these shares add up nearly to ``points (k, r)`` of the set. The gauge of a point is a linear
        program whose columns are generated, as in `ConvexSet`. By how much they miss it, `evaluate_signal` says."""
        k, r = points.shape
        signs = np.where(points < 0.0, -1.0, 1.0)
        lengths = np.linalg.norm(points, axis=1)
        tilted = points / np.where(lengths > 0.0, lengths, 1.0)[:, None] + TILT * signs * (1.0 + np.arange(r) / 7.0)
        columns = SPIKE * signs[:, :, None] * np.eye(r)
        chosen, is_replaced = np.zeros((k, r, r)), np.zeros((k, r), dtype=bool)
        open_ = np.flatnonzero(lengths > 0.0)
        for _ in range(PIVOTS):
            directions = np.linalg.solve(columns[open_], np.ones((open_.size, r, 1)))[..., 0]
            entering = self.support_point(np.asarray(directions, dtype=float))
            better = (directions * entering).sum(axis=1) > 1.0 + RELATIVE
            open_, directions, entering = open_[better], directions[better], entering[better]
            if not open_.size:
                break
            sides = np.stack([tilted[open_], entering], axis=2)
            share, slope = np.moveaxis(np.linalg.solve(np.swapaxes(columns[open_], 1, 2), sides), 2, 0)
            with np.errstate(divide="ignore", invalid="ignore"):
                leaving = np.where(slope > 0.0, np.maximum(share, 0.0) / slope, np.inf).argmin(axis=1)
            columns[open_, leaving], chosen[open_, leaving] = entering, directions
            is_replaced[open_, leaving] = True
        shares = np.linalg.solve(np.swapaxes(columns, 1, 2), points[..., None])[..., 0]
        for point in np.flatnonzero(((shares < 0.0) | ~is_replaced).any(axis=1)):
            shares[point] = _solve_shares(np.where(is_replaced[point][:, None], columns[point], 0.0), points[point])
        return chosen, shares / np.maximum(1.0, shares.sum(axis=1, keepdims=True))


@final
class _Sweep:
    """Best corners of ``part (v, mw)`` along a piece, for ``directions (N, r)``.

    On parts of the piece that are `clean` one corner is best throughout. The other parts are cut into cells
    ``[low, high]``, each with the corner that is best at its ends. After `HALVINGS` a cell keeps this corner without a
    proof that it is best inside, so that `values` may be too small there.
    """

    def __init__(self, zonoid: Zonoid, part: Array, directions: Array) -> None:
        self.zonoid, self.part, self.directions = zonoid, part, directions
        heights = np.tensordot(directions, zonoid.nodes, axes=(1, 1)) @ part.T  # (N, S + 1, v)
        self.best = heights[:, :-1].argmax(axis=2)
        curvature = np.tensordot(np.abs(directions), zonoid.curvature_bounds, axes=(1, 1))  # (N, S, mw)
        curvature = curvature @ np.abs(part[:, None] - part).transpose(2, 0, 1).reshape(part.shape[1], -1)
        curvature = np.take_along_axis(
            curvature.reshape(*self.best.shape, part.shape[0], -1), self.best[:, :, None, None], axis=2
        )[:, :, 0]
        highest = self.best[..., None]
        first, last = (np.take_along_axis(end, highest, axis=2) - end for end in (heights[:, :-1], heights[:, 1:]))
        self.clean: np.ndarray = np.all(_is_nonnegative(first, last, 2.0 * curvature, 0.0), axis=2)
        self._cut_into_cells()

    def _cut_into_cells(self) -> None:
        zonoid, part = self.zonoid, self.part
        n, s = np.nonzero(~self.clean)
        P = np.einsum("nr,nprw,vw->npv", self.directions[n], zonoid.coefficients[s], part, optimize=True)
        scale = np.abs(P).sum(axis=1).max(axis=1, initial=0.0)
        low, high = -np.ones(n.size), np.ones(n.size)
        orders = np.arange(P.shape[1])
        owner = np.arange(n.size)  # the polynomial of every open cell
        cells: list[tuple[np.ndarray, Array, Array, np.ndarray]] = []
        for halving in range(HALVINGS + 1):
            first, last = _evaluate_polynomials(P[owner], low), _evaluate_polynomials(P[owner], high)
            best = (first + last).argmax(axis=1)
            gaps = P[owner] - np.take_along_axis(P[owner], best[:, None, None], axis=2)
            curvature = (np.abs(gaps) * (orders * (orders - 1))[:, None]).sum(axis=1)
            g, h = (np.take_along_axis(end, best[:, None], axis=1) - end for end in (first, last))
            half_square = ((high - low) ** 2 / 2.0)[:, None]
            ready = np.all(_is_nonnegative(g, h, half_square * curvature, FLAT * scale[owner][:, None]), axis=1) | (
                halving == HALVINGS
            )
            cells.append((owner[ready], low[ready], high[ready], best[ready]))
            owner, low, high, first, last = owner[~ready], low[~ready], high[~ready], first[~ready], last[~ready]
            if not owner.size:
                break
            a, b = first.argmax(axis=1), last.argmax(axis=1)
            rows = np.arange(owner.size)
            cut = _find_roots(P[owner][rows, :, a] - P[owner][rows, :, b], low, high)
            owner, low, high = np.tile(owner, 2), np.concatenate([low, cut]), np.concatenate([cut, high])
        owners, low, high, best = (np.concatenate(arrays) for arrays in zip(*cells, strict=True))
        self.cells = (n[owners], s[owners], low, high, best)

    def values(self) -> Array:
        """Return the integrals of the largest heights over the corners, ``(N,)``."""
        return np.asarray((self.directions * self.points()).sum(axis=1))

    def points(self) -> Array:
        """Return the points ``(N, r)`` of the set that the best corners give."""
        zonoid, (n, s, low, high, best) = self.zonoid, self.cells
        points = np.tensordot(self.part[self.best] * self.clean[..., None], zonoid.across, axes=([1, 2], [0, 2]))
        if n.size:
            orders = np.arange(zonoid.integrals.shape[1])
            powers = high[:, None] ** orders - low[:, None] ** orders
            contributions = np.einsum("np,nprw,nw->nr", powers, zonoid.integrals[s], self.part[best], optimize=True)
            np.add.at(points, n, contributions)
        return np.asarray(points)

    def arc(self) -> Arc:
        """Return the signal of the first direction."""
        _, s, low, high, best = self.cells
        ends = self.zonoid.kernel.ends
        clean_parts, halves, begins = np.flatnonzero(self.clean[0]), np.diff(ends) / 2.0, ends[:-1]
        stop = np.concatenate([ends[clean_parts + 1], begins[s] + halves[s] * (high + 1.0)])  # backwards in time
        start = np.concatenate([begins[clean_parts], begins[s] + halves[s] * (low + 1.0)])
        corner_numbers = np.concatenate([self.best[0, clean_parts], best])
        order = np.argsort(-stop)
        return Arc(1.0 - start[order] / ends[-1], self.part[corner_numbers[order]])


def _choose_part_count(A: Array, length: float) -> int:
    speed = min(float(np.linalg.norm(A, 2)), MOST_PARTS / max(length, 1e-300))
    return int(np.clip(np.ceil(speed * length / FAST), PARTS, MOST_PARTS))


def _choose_degree(reach: float) -> int:
    """Return the degree of polynomials that approximate an exponential whose exponent goes from ``-reach`` to
    ``reach``, at most `DEGREE`."""
    term = 1.0
    for order in range(1, DEGREE):
        term *= reach / order
        if term <= REST:
            return order
    return DEGREE


def _build_expansion_matrices(size: int, count: int) -> Array:
    """Return the matrices ``(count, size, size)`` that expand a polynomial again on each of ``count`` equal parts.

    They map the coefficients of powers of the share, from 0 to 1, of an interval to those of powers of ``u`` from -1 to
    1 across each part.
    """
    matrices, orders = np.zeros((count, size, size)), np.arange(size)
    for j in range(size):
        binomials = np.array([comb(j, k) for k in range(j + 1)], dtype=float)
        middles = (np.arange(count)[:, None] + 0.5) / count
        matrices[:, : j + 1, j] = binomials * middles ** (j - orders[: j + 1]) * (0.5 / count) ** orders[: j + 1]
    return matrices


def _is_nonnegative(left: Array, right: Array, curvature: Array, spare: Array | float) -> np.ndarray:
    """Return whether a function is certainly not negative on a cell, given its values at the ends.

    The second derivative times half the square of the cell's length is at most ``curvature``. The function is then at
    least its chord less a parabola, which Cauchy's inequality bounds. Violations by ``spare`` count as rounding.
    """
    near = np.sqrt(np.maximum(left, 0.0)) + np.sqrt(np.maximum(right, 0.0))
    return (left >= -spare) & (right >= -spare) & (near**2 >= curvature - spare)


def _evaluate_polynomials(P: Array, u: Array) -> Array:
    """Return polynomials ``(M, p + 1, ...)`` at ``u (M,)``."""
    u = u.reshape(-1, *([1] * (P.ndim - 2)))
    value = P[:, -1]
    for order in range(P.shape[1] - 2, -1, -1):
        value = value * u + P[:, order]
    return value


def _find_roots(P: Array, low: Array, high: Array) -> Array:
    """Return a root of polynomials ``(M, p + 1)`` between ``low`` and ``high (M,)`` where the signs there differ, their
    middle elsewhere."""
    first, last = _evaluate_polynomials(P, low), _evaluate_polynomials(P, high)
    middle = (low + high) / 2.0
    is_crossing = first * last < 0.0
    slope = P[:, 1:] * np.arange(1, P.shape[1])
    a, b = low.copy(), high.copy()
    u = np.where(is_crossing, low - first * (high - low) / np.where(is_crossing, last - first, 1.0), middle)
    for _ in range(NEWTON):
        value = _evaluate_polynomials(P, u)
        same = value * first > 0.0
        a, b = np.where(same, u, a), np.where(same, b, u)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = u - value / _evaluate_polynomials(slope, u)
        u = np.where((step >= a) & (step <= b), step, (a + b) / 2.0)  # at an end, a root that was found
    least = EDGE * (high - low)
    is_inside = is_crossing & (u > low + least) & (u < high - least)
    return np.asarray(np.where(is_inside, u, middle))


def _solve_shares(columns: Array, point: Array) -> Array:
    """Return shares ``(r,) >= 0`` with which ``columns (r, r)``, one in each row, add up to a ``point``, as nearly as
    least squares can.

    Where columns are equal but for rounding, the share of one of them may be negative. That column is left out, and the
    others take over its share.
    """
    kept = np.flatnonzero(columns.any(axis=1))
    while True:
        shares = np.linalg.lstsq(columns[kept].T, point, rcond=None)[0]
        if not (shares < 0.0).any():
            break
        kept = np.delete(kept, shares.argmin())
    all_shares = np.zeros(point.size)
    all_shares[kept] = shares
    return all_shares


def _combine_arcs(signals: Sequence[Arc], shares: Array, channels: int) -> Arc:
    """Return the sum of signals in these shares, constants that are equal joined."""
    ends = np.unique(np.concatenate([[1.0], *(signal.ends for signal in signals)]))
    total = np.zeros((ends.size, channels))
    for signal, share in zip(signals, shares, strict=True):
        total += share * signal.values[np.minimum(np.searchsorted(signal.ends, ends), signal.ends.size - 1)]
    kept = np.append((np.diff(total, axis=0) != 0.0).any(axis=1), True)
    return Arc(ends[kept], total[kept])
