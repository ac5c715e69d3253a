"""Flat sets in ball arithmetic: boxes, polytopes, balls of the 1-norm and the maximum norm, sums of segments."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from fractions import Fraction
from functools import cached_property, lru_cache
from itertools import combinations, product
from math import comb
from typing import final

import numpy as np
from flint import arb, fmpq, fmpq_mat

from sparserob_core.checker.arithmetic.balls import (
    above,
    ball,
    balls,
    below,
    largest,
    rational,
    rationals,
    smallest,
    spanning,
)
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.sets.along import NormSummand
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, Enclosed, rounding
from sparserob_core.checker.sets.shape import NEAR, Facet, Shape, along, dot, facet, total
from sparserob_core.checker.sets.summands import Summand
from sparserob_core.control.sets.sets import Box, NormBall, Polytope, Zonotope
from sparserob_core.sip.convex_set import Array

MAX_CORNERS = 20_000  # intersections of facets that may be computed to list the corners of a polytope


class Flat(Shape):
    """A set that is given by its facets."""

    @property
    def listed(self) -> list[Facet]:
        """The facets, for a set whose facets are listed."""
        assert self.facets is not None
        return self.facets

    def holds(self, point: Sequence[arb]) -> bool:
        return all(bool(along(c, point) <= b) for c, b in self.listed)

    @property
    def holding(self) -> list[Facet]:
        """The half-spaces that contain the set."""
        return self.listed

    def least(self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb]) -> arb:
        """Return what `Shape.least` says. The coordinate planes cut the set, or one that is larger by rounding, into
        parts on which the function is linear. Its minimum is attained at a corner of a part."""
        rows = tuple((*map(float, c), float(b) if b == float(b) else above(b)) for c, b in self.holding)
        return _find_least(
            [
                total(map(_evaluate_cost, ups, downs, slope, map(rational, point)))
                for point in _find_intersections(rows, tuple(range(self.dimension)))
            ]
        )

    def shares(self, direction: Array) -> Array:
        from scipy.optimize import nnls

        multipliers: Array = nnls(np.array([c for c, _ in self.listed]).T, direction)[0]
        return multipliers


@final
class Boxed(Flat):
    """A box, or a set that is one: a ball of the maximum norm, or of any norm in one dimension."""

    def __init__(self, source: Box | NormBall) -> None:
        super().__init__(source)
        self.is_box = isinstance(source, Box)
        if isinstance(source, Box):
            self._lower_corner, self._upper_corner = ([ball(v) for v in ends] for ends in (source.lower, source.upper))
        else:
            middles, radius = [ball(v) for v in source.centre], ball(source.radius)
            self._lower_corner, self._upper_corner = [m - radius for m in middles], [m + radius for m in middles]

    @cached_property
    def facets(self) -> list[Facet]:
        axes = np.eye(self.dimension)
        return [(axis, b) for axis, b in zip(axes, self._upper_corner, strict=True) if b.is_finite()] + [
            (-axis, -b) for axis, b in zip(axes, self._lower_corner, strict=True) if b.is_finite()
        ]

    def support(self, direction: Sequence[arb]) -> arb:
        height = ball(0)
        for c, low, high in zip(direction, self._lower_corner, self._upper_corner, strict=True):
            if c.is_zero():
                continue
            if low.is_finite() and high.is_finite():
                height = height + (high + low) / 2 * c + (high - low) / 2 * abs(c)
            elif c > 0 and high.is_finite():
                height = height + c * high
            elif c < 0 and low.is_finite():
                height = height + c * low
            else:
                raise Broken("a direction points where its set is unbounded")
        return height

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        low, high = np.array([below(b) for b in self._lower_corner]), np.array([above(b) for b in self._upper_corner])
        w = np.where(value >= 0, high, low)
        return w, (np.maximum(spread - np.abs(value), 0.0) * (high - low)).sum(axis=1) * OUTWARD

    def least(self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb]) -> arb:
        return total(self.least_by(ups, downs, slope, [range(self.dimension)]))

    def least_by(
        self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb], blocks: Sequence[Sequence[int]]
    ) -> list[arb]:
        ends = zip(self._lower_corner, self._upper_corner, strict=True)
        points = [[low, high] + ([0 * low] if low <= 0 and high >= 0 else []) for low, high in ends]
        shares = [
            _find_least([_evaluate_cost(up, down, s, v) for v in values])
            for up, down, s, values in zip(ups, downs, slope, points, strict=True)
        ]
        return [total(shares[c] for c in block) for block in blocks]

    def shares(self, direction: Array) -> Array:
        return np.maximum(0.0, np.array([c for c, _ in self.listed]) @ direction)

    def summands(self, about: Array) -> list[Summand | NormSummand]:
        ends = enumerate(zip(self._upper_corner, self._lower_corner, balls(about), strict=True))
        axes = [[ball(i == j) for j in range(self.dimension)] for i in range(self.dimension)]
        return _round_corners([[[x * (end - m) for x in axes[i]] for end in (up, low)] for i, (up, low, m) in ends])


class Cornered(Flat):
    """A flat set with known corners."""

    @property
    @abstractmethod
    def corners(self) -> list[tuple[Fraction, ...]]:
        """All corners of a bounded set, exactly."""

    def support(self, direction: Sequence[arb]) -> arb:
        corners = ([rational(x) for x in corner] for corner in self.corners)
        return largest(total(x * c for x, c in zip(corner, direction, strict=True)) for corner in corners)

    def summands(self, about: Array) -> list[Summand | NormSummand]:
        middle = balls(about)
        return _round_corners(
            [[[rational(x) - m for x, m in zip(corner, middle, strict=True)] for corner in self.corners]]
        )

    @cached_property
    def segments(self) -> list[tuple[list[Fraction], Fraction]] | None:
        """The vectors from the first corner to others, each with the number 1; ``None`` for a set that is not thin. The
        lines between corners lie in the set."""
        chosen = _select_distant_rows(self._offsets)
        if len(chosen) == self.dimension or (len(chosen) > 1 and rationals(self._offsets).rank() > len(chosen)):
            return None
        return [(vector, Fraction(1)) for vector in chosen]

    @cached_property
    def _offsets(self) -> list[list[Fraction]]:
        """The vectors from the first corner to the others, the longest first."""
        first, *remaining = self.corners
        return _sort_by_length([[a - b for a, b in zip(x, first, strict=True)] for x in remaining])

    def nearest(self, point: Array) -> list[arb]:
        """Return a weighted mean of corners close to a point."""
        from scipy.optimize import nnls

        is_segment = self.segments is not None and len(self.segments) == 1
        chosen = self._offsets[:1] if is_segment else self._offsets
        first, offsets = self.corners[0], [[Fraction(0)] * self.dimension, *chosen]
        table = np.array([[float(x) for x in offset] for offset in offsets])
        size = float(np.abs(table).max(initial=0.0)) or 1.0
        target = (point - np.array([float(x) for x in first])) / size
        weights = [
            Fraction(float(w))
            for w in nnls(np.vstack([table.T / size, np.ones(len(table))]), np.append(target, 1.0))[0]
        ]
        weight_sum = sum(weights)
        shares = [w / weight_sum for w in weights]
        columns = zip(first, zip(*offsets, strict=True), strict=True)
        return [rational(x + sum(w * v for w, v in zip(shares, column, strict=True))) for x, column in columns]

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Return the corner that is best at ``value``, and an excess that is only rounding error where it remains the
        best."""
        points = np.array([[float(x) for x in corner] for corner in self.corners])
        heights = value @ points.T
        best = heights.argmax(axis=1)
        w, reach = points[best], np.abs(value) + spread
        change = np.einsum("kvw,kw->kv", np.abs(points[None] - w[:, None]), spread)
        ahead = heights - heights.max(axis=1, keepdims=True) + change
        ahead += 3.0 * rounding(self.dimension) * (reach @ np.abs(points).max(axis=0))[:, None]
        ahead[np.arange(best.size), best] = 0.0
        # error of corners that are rounded to floats
        corner_error = 2.0 * HALF_ULP * (reach @ np.abs(points).T).max(axis=1)
        return w, (np.maximum(ahead.max(axis=1), 0.0) + corner_error) * OUTWARD


@final
class Polyhedral(Cornered):
    """A polytope."""

    source: Polytope
    has_limits_as_sizes = True

    @cached_property
    def facets(self) -> list[Facet]:
        return [(c, ball(b)) for c, b in zip(self.source.H, self.source.h, strict=True)]

    @cached_property
    def corners(self) -> list[tuple[Fraction, ...]]:
        H, h = self.source.H, self.source.h
        return list(_find_intersections(tuple((*map(float, row), float(b)) for row, b in zip(H, h, strict=True)), ()))

    def limit(self, direction: Array) -> arb:
        """Return the right-hand side of the facet whose normal the direction is, times the factor between the two."""
        number, factor = facet(self.listed, direction)
        return self.listed[number][1] * rational(factor)

    def shares(self, direction: Array) -> Array:
        number, factor = facet(self.listed, direction)
        multipliers: Array = float(factor) * np.eye(len(self.listed))[number]
        return multipliers


@final
class Octahedral(Cornered):
    """A ball of the 1-norm."""

    source: NormBall

    @cached_property
    def facets(self) -> list[Facet]:
        normals = np.array(list(product((-1.0, 1.0), repeat=self.dimension)))
        return [(c, dot(c, self.source.centre) + ball(self.source.radius)) for c in normals]

    @cached_property
    def corners(self) -> list[tuple[Fraction, ...]]:
        middle, radius = [Fraction(float(v)) for v in self.source.centre], Fraction(self.source.radius)
        return [
            tuple(m + sign * radius * (i == axis) for i, m in enumerate(middle))
            for axis in range(self.dimension)
            for sign in (1, -1)
        ]


@final
class Segments(Flat):
    """A zonotope: ``h(c) = c'm + sum_j |c'g_j|``.

    Where its segments do not span the space, it has opposite facets across every direction in which its width is 0.
    """

    source: Zonotope

    @cached_property
    def facets(self) -> list[Facet] | None:
        """The facets, ``None`` where there are too many. Each is spanned by one segment fewer than the dimension of the
        span. Its normal is rounded to floats, and its limit drawn inwards, such that no point within it, up to twice as
        large as the set, is outside the exact facet."""
        if self.source.halfspaces() is None:  # too many facets: a run treats the set as curved
            return None
        reach, facets = 2 * total(balls(self.radius)), []
        for exact in self._normals:
            size = np.linalg.norm(np.array([float(v) for v in exact]))
            for length in (Fraction(float(size)), -Fraction(float(size))):
                c = np.array([float(v / length) for v in exact])
                normal_error = total(
                    rational(abs(Fraction(a) - v / length)) for a, v in zip(c.tolist(), exact, strict=True)
                )
                facets.append((c, self.support(balls(c)) - 2 * normal_error * reach))
        return facets

    @property
    def holding(self) -> list[Facet]:
        return [(c, self.support(balls(c))) for c, _ in self.listed]

    @property
    def _normals(self) -> list[tuple[Fraction, ...]]:
        """The exact normals, one for each pair of facets: the normals within the span of the segments, and some that
        span its orthogonal complement."""
        d, normals = self.dimension, dict[tuple[str, ...], list[fmpq]]()
        rows = [row for row in rationals(self.source.generators.tolist()).tolist() if any(row)]
        complement = _compute_null_space(rows, d)
        rank = d - len(complement)
        spanning_sets = [[*vectors, *complement] for vectors in combinations(rows, rank - 1)] if rank else []
        spanning_sets += [[*complement[:i], *complement[i + 1 :], *spanning(rows)] for i in range(len(complement))]
        for vectors in spanning_sets:
            minors = [
                (-1) ** i * (fmpq_mat([[*r[:i], *r[i + 1 :]] for r in vectors]).det() if d > 1 else fmpq(1))
                for i in range(d)
            ]
            lead = next((v for v in minors if v != 0), None)
            if lead is not None:
                size = max(abs(v) for v in minors)
                normals.setdefault(tuple(str(v / lead) for v in minors), [v / size for v in minors])
        return [tuple(Fraction(int(v.p), int(v.q)) for v in normal) for normal in normals.values()]

    def contains(self, point: Sequence[float] | Array) -> bool:
        """Return True where an exact point is proven to be in the set; the middle needs no proof."""
        return np.array_equal(point, self.source.centre) or super().contains(point)

    @cached_property
    def segments(self) -> list[tuple[list[Fraction], Fraction]] | None:
        """The longest of the segments whose sum the set is, as many as have distinct directions."""
        chosen = _select_distant_rows(self._merged_segments)
        if len(chosen) == self.dimension or rationals(self._merged_segments).rank() > len(chosen):
            return None
        return [(vector, Fraction(2)) for vector in chosen]

    @cached_property
    def _merged_segments(self) -> list[list[Fraction]]:
        """The long segments, the longest first. Parallel segments are added into one, so that the zonotope of the
        results lies in the set."""
        sums = list[list[Fraction]]()
        rows = _sort_by_length([[Fraction(v) for v in g] for g in self.source.generators.tolist() if any(g)])
        widths = _compute_widths(rows)
        for row in rows:
            if _compute_relative_length(row, widths) <= NEAR:
                continue
            for index, segment in enumerate(sums):
                sign = 1 if sum(a * b for a, b in zip(row, segment, strict=True)) > 0 else -1
                if len(_select_distant_rows([segment, row], widths)) == 1:
                    sums[index] = [b + sign * a for a, b in zip(row, segment, strict=True)]
                    break
            else:
                sums.append(row)
        return _sort_by_length(sums)

    @property
    def generators(self) -> list[list[Fraction]]:
        """The segments ``(q, d)`` whose sum the set is, exactly."""
        return [[Fraction(float(v)) for v in row] for row in self.source.generators if row.any()]

    def summands(self, about: Array) -> list[Summand | NormSummand]:
        ends = [[rational(x) for x in segment] for segment in self.generators]
        centre = [c - m for c, m in zip(balls(self.source.centre), balls(about), strict=True)]
        return _round_corners([[centre], *([end, [-x for x in end]] for end in ends)])

    def nearest(self, point: Array) -> list[arb]:
        """Return a point close to another one: the middle plus each segment times a number in ``[-1, 1]``."""
        from scipy.optimize import lsq_linear

        offset, middle = point - self.source.centre, self.source.centre
        sums = self.generators if self.segments is None else self._merged_segments
        if not sums:
            return balls(middle)
        table = np.array([[float(v) for v in row] for row in sums])
        size = np.abs(table).max()
        weights = np.clip(lsq_linear(table.T / size, offset / size, (-1.0, 1.0), method="bvls").x, -1.0, 1.0).tolist()
        columns = zip(middle.tolist(), zip(*sums, strict=True), strict=True)
        return [
            rational(Fraction(m) + sum(Fraction(s) * v for s, v in zip(weights, column, strict=True)))
            for m, column in columns
        ]

    def holds(self, point: Sequence[arb]) -> bool:
        if self.facets is None:
            raise Unchecked("the checker cannot tell who is in a zonotope with very many facets")
        return super().holds(point)

    def support(self, direction: Sequence[arb]) -> arb:
        heights = total(abs(along(g, direction)) for g in self.source.generators)
        return along(self.source.centre, direction) + heights

    def bound(self, value: Array, spread: Array) -> tuple[Array, Array]:
        """Return linear upper bounds of the support function, by ``|a + b| <= sign(a) (a + b) + 2 max(|b| - |a|, 0)``
        for every segment."""
        G = self.source.generators
        heights, change = value @ G.T, spread @ np.abs(G).T
        change = change + rounding(self.dimension) * (np.abs(value) @ np.abs(G).T)  # rounding of the heights
        signs = np.where(heights >= 0, 1.0, -1.0)
        w = self.source.centre + signs @ G
        size = np.abs(self.source.centre) + np.abs(G).sum(axis=0)
        rounding_error = rounding(len(G) + 1) * (np.abs(value) + spread) @ size  # w is rounded
        excess: Array = (2.0 * np.maximum(change - np.abs(heights), 0.0).sum(axis=1) + rounding_error) * OUTWARD
        return w, excess

    def least(self, ups: Sequence[arb], downs: Sequence[arb], slope: Sequence[arb]) -> arb:
        has_facets = self.facets is not None
        return super().least(ups, downs, slope) if has_facets else Shape.least(self, ups, downs, slope)


def _round_corners(summands: Sequence[Sequence[Sequence[arb]]]) -> list[Summand | NormSummand]:
    """Return sets from their corners in balls."""
    return [Summand(corners.mid, corners.rad) for corners in (Enclosed.of(stacked(rows)) for rows in summands)]


def _compute_length(row: Sequence[Fraction]) -> float:
    return float(np.linalg.norm([float(v) for v in row]))


def _compute_widths(rows: Sequence[list[Fraction]]) -> list[Fraction]:
    """Return the largest absolute value of every column, 1 where all are 0: coordinates may be in different units."""
    return [max(map(abs, column)) or Fraction(1) for column in zip(*rows, strict=True)]


def _compute_relative_length(row: Sequence[Fraction], widths: Sequence[Fraction]) -> float:
    """Return the length of a row in units of the ``widths``."""
    return _compute_length([v / width for v, width in zip(row, widths, strict=True)])


def _sort_by_length(rows: Sequence[list[Fraction]]) -> list[list[Fraction]]:
    """Return the rows sorted by their length in units of `_compute_widths`, the longest first."""
    widths = _compute_widths(rows)
    return sorted(rows, key=lambda row: _compute_relative_length(row, widths), reverse=True)


def _select_distant_rows(
    rows: Sequence[list[Fraction]], widths: Sequence[Fraction] | None = None
) -> list[list[Fraction]]:
    """Return the rows whose distance from the span of the rows chosen before is more than `NEAR`, in units of the
    ``widths``."""
    chosen, basis = list[list[Fraction]](), list[Array]()
    units = _compute_widths(rows) if widths is None else widths
    for row in rows:
        size = _compute_relative_length(row, units)
        residual = np.array([float(v / unit) for v, unit in zip(row, units, strict=True)]) / (size or 1.0)
        for _ in range(2):
            for direction in basis:
                residual = residual - (residual @ direction) * direction
        distance = float(np.linalg.norm(residual))
        if size * distance > NEAR:
            chosen.append(row)
            basis.append(residual / distance)
    return chosen


def _compute_null_space(rows: Sequence[Sequence[fmpq]], d: int) -> list[list[fmpq]]:
    """Return vectors ``(d,)`` that span the orthogonal complement of the rows."""
    basis = spanning(rows)
    leads = [next(i for i, v in enumerate(row) if v != 0) for row in basis]
    vectors = []
    for free in (i for i in range(d) if i not in leads):
        vector = [fmpq(int(i == free)) for i in range(d)]
        for row, lead in zip(basis, leads, strict=True):
            vector[lead] = -row[free]
        vectors.append(vector)
    return vectors


def _evaluate_cost(up: arb, down: arb, slope: arb, value: arb) -> arb:
    return up * value.nonnegative_part() + down * (-value).nonnegative_part() + slope * value


def _find_least(values: Sequence[arb]) -> arb:
    if not values:
        raise Unchecked("the set of controls has no corners")
    return smallest(values)


@lru_cache(maxsize=64)
def _find_intersections(
    rows: tuple[tuple[float, ...], ...], planes: tuple[int, ...]
) -> tuple[tuple[Fraction, ...], ...]:
    """Return the points of ``{x : H x <= h}``, rows ``(*H_i, h_i)``, where ``d`` of its facets and of the coordinate
    ``planes`` meet, in rational arithmetic; `Unchecked` where they are too many, or none."""
    d = len(rows[0]) - 1
    if comb(len(rows) + len(planes), d) > MAX_CORNERS:
        raise Unchecked(f"a polytope with {len(rows)} facets in {d} dimensions has too many corners to be listed")
    exact = rationals(rows).tolist()
    walls = exact + [[fmpq(int(i == plane)) for i in range(d)] + [fmpq(0)] for plane in planes]
    points: set[tuple[Fraction, ...]] = set()
    for chosen in combinations(walls, d):
        matrix = fmpq_mat([row[:d] for row in chosen])
        if matrix.det() == 0:
            continue
        point = matrix.solve(fmpq_mat([[row[d]] for row in chosen]))
        x = [point[i, 0] for i in range(d)]
        if all(sum((a * b for a, b in zip(row[:d], x, strict=True)), fmpq(0)) <= row[d] for row in exact):
            points.add(tuple(Fraction(int(v.p), int(v.q)) for v in x))
    if not points:
        raise Unchecked("a polytope has no corners")
    return tuple(sorted(points))
