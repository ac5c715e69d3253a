"""The finite program that is left when finitely many indices are imposed, and a checked answer to it; rows that must
hold for every deviation.

A row with deviations is ``g x + w'(C x + d) <= h`` for all ``w`` in a product of convex sets, the `Spread`. Its worst
deviation is in closed form, ``max_w w'a`` a sum of support functions (Ben-Tal, El Ghaoui and Nemirovski 2009, section
1.3), so that the left side is a convex function of the decision.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet, projector

if TYPE_CHECKING:
    from scipy.sparse import csc_array, csr_array


NAN = "finite program: a bound or right-hand side is NaN"
# Times its value: where more is added up to a square, double precision leaves fewer than ten digits of it. With a
# thousand times as much the last digits of a gap are rounding; with a thousandth ordinary costs are summed twice.
CANCELS = 1e6
SIGNS = "finite program: expected weights >= 0 and right-hand sides above -inf"


@dataclass(frozen=True, eq=False)
class Blocks:
    """Entries of an image that count with their Euclidean norm: ``number (k,)`` is the block of each, -1 for one that
    counts alone. Entries of one block have one weight."""

    number: np.ndarray

    @cached_property
    def entries(self) -> np.ndarray:
        """The entries ``(e,)`` that are in a block."""
        return np.flatnonzero(self.number >= 0)

    @cached_property
    def of(self) -> np.ndarray:
        """The block ``(e,)`` of each of those."""
        return np.asarray(self.number[self.entries])

    @cached_property
    def first(self) -> np.ndarray:
        """The first entry ``(b,)`` of every block."""
        return np.asarray(self.entries[np.unique(self.of, return_index=True)[1]])

    @cached_property
    def table(self) -> np.ndarray:
        """The entries ``(b, g)`` of every block, -1 where it has fewer than the largest."""
        order = np.argsort(self.of, kind="stable")
        sizes = np.bincount(self.of, minlength=self.first.size)
        table = np.full((sizes.size, int(sizes.max(initial=0))), -1)
        table[np.arange(table.shape[1]) < sizes[:, None]] = self.entries[order]
        return table

    @shaped
    def norms(self, image: Float[Array, " k"]) -> Float[Array, " b"]:
        """The norm of every block."""
        squares = np.bincount(self.of, image[self.entries] ** 2, self.first.size)
        return np.asarray(np.sqrt(squares), dtype=float)

    @shaped
    def directions(self, image: Float[Array, " k"]) -> Float[Array, " k"]:
        """Every block divided by its norm; 0 where that is 0, and outside of blocks."""
        answer = np.zeros(image.size)
        norms = self.norms(image)
        answer[self.entries] = image[self.entries] / np.where(norms > 0.0, norms, np.inf)[self.of]
        return answer

    @shaped
    def lengths(self, image: Float[Array, " k"]) -> Float[Array, " k"]:
        """What every entry counts with: the norm of its block in the first entry of it and 0 in the others, its
        absolute value outside of blocks."""
        answer = np.abs(image)
        answer[self.entries] = 0.0
        answer[self.first] = self.norms(image)
        return answer


@dataclass(frozen=True, eq=False)
class FiniteProgram:
    """minimise ``sum_k weights_k |(S x)_k| + 1/2 x'P x + q'x + constant``
    subject to ``lower <= S x <= upper``, ``G x <= h``, ``A x = b``; where there are ``blocks`` of images, each counts
    with its weight times its Euclidean norm instead.

    Shapes: ``q (n,)``, ``P (n, n)`` symmetric positive semidefinite or ``None``, ``S (k, n)`` or ``None`` for the
    identity, ``weights, lower, upper (k,)`` with ``weights >= 0``, ``G (r, n)``, ``h (r,)``, ``A (e, n)``, ``b (e,)``.
    Entries of ``lower`` may be ``-inf``, entries of ``upper`` and ``h`` may be ``inf``. Arrays must not be written to
    after the program is built: what depends on ``S``, ``weights`` and the bounds alone is remembered between programs.
    """

    q: Array
    weights: Array
    lower: Array
    upper: Array
    G: Array
    h: Array
    A: Array
    b: Array
    P: csc_array | None = None
    S: csc_array | None = None
    constant: float = 0.0
    blocks: Blocks | None = None

    @property
    def n(self) -> int:
        """Number of decision variables."""
        return int(self.q.size)

    @cached_property
    def curvature(self) -> Array | None:
        """The diagonal ``(n,)`` of ``P``, zeros where there is none; ``None`` where it has other entries."""
        return diagonal(self.P, self.n)

    @cached_property
    def steepest(self) -> float:
        """The largest coefficient of the linear cost and of the absolute values."""
        return float(max(self.weights.max(initial=0.0), np.abs(self.q).max(initial=0.0)))

    @cached_property
    def separable(self) -> bool:
        """Whether every entry has a cost and bounds for itself: ``S`` the identity, ``P`` diagonal, and no blocks."""
        return self.S is None and self.blocks is None and self.curvature is not None

    def under(self, G: Array, h: Array) -> FiniteProgram:
        """The same program under more rows ``G x <= h``, which come after its own."""
        own = self.h.size
        G, h = (np.vstack([self.G, G]), np.concatenate([self.h, h])) if own else (G, h)
        more = FiniteProgram(
            self.q,
            self.weights,
            self.lower,
            self.upper,
            G,
            h,
            self.A,
            self.b,
            self.P,
            self.S,
            self.constant,
            self.blocks,
        )
        # what does not depend on the rows
        more.__dict__.update(curvature=self.curvature, steepest=self.steepest, bounded=self.bounded, _sound=self._sound)
        return more

    def curved(self, P: csc_array, q: Array) -> FiniteProgram:
        """The same program with another quadratic and linear cost."""
        other = replace(self, P=P, q=q)
        if q is self.q:
            other.__dict__.update(steepest=self.steepest, bounded=self.bounded, _sound=self._sound)
        return other

    @cached_property
    def bounded(self) -> bool:
        """Whether all bounds are finite."""
        return bool(np.isfinite(self.lower).all() and np.isfinite(self.upper).all())

    @shaped
    def image(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        """``S x`` ``(k,)``."""
        return x if self.S is None else np.asarray(self.S @ x, dtype=float)

    @shaped
    def objective(self, x: Float[Array, " n"]) -> float:
        """The cost at ``x``; of squares that cancel rounding may leave less than 0, and they are never less."""
        quadratic = 0.0 if self.P is None else max(0.0, self._square(x)[0])
        return float(self.weights @ self._lengths(x) + self.q @ x) + quadratic + self.constant

    def _square(self, x: Array) -> tuple[float, float]:
        """``1/2 x'P x``, and what its rounding is relative to: summed with more digits where most of it cancels."""
        square = 0.5 * float(x @ self._bent(x))
        if self.P is None or self.curvature is not None:
            return square, abs(square)
        size = np.abs(x)
        added = 0.5 * float(size @ (abs(self.P) @ size))
        if added <= CANCELS * abs(square):
            return square, added
        wide = x.astype(np.longdouble)
        square = 0.5 * float(wide @ (self.P.astype(np.longdouble) @ wide))
        return square, abs(square) + added * float(np.finfo(np.longdouble).eps / np.finfo(float).eps)

    @shaped
    def _lengths(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        image = self.image(x)
        return np.abs(image) if self.blocks is None else self.blocks.lengths(image)

    def _bent(self, x: Array) -> Array:
        """``P x``."""
        if self.curvature is not None:
            return self.curvature * x
        assert self.P is not None
        return np.asarray(self.P @ x, dtype=float)

    @shaped
    def tangent(self, at: Float[Array, " n"]) -> FiniteProgram:
        """The same program with ``1/2 x'P x`` replaced by its tangent at ``at``, which lies below it."""
        if self.P is None:
            return self
        bent = self._bent(at)
        return replace(self, P=None, q=self.q + bent, constant=self.constant - 0.5 * float(at @ bent))

    @shaped
    def magnitude(self, x: Float[Array, " n"]) -> float:
        """The sum of the absolute values of the terms of the cost at ``x``: what its rounding is relative to."""
        size = np.abs(x)
        quadratic = 0.0 if self.P is None else self._square(x)[1]
        return float(self.weights @ self._lengths(x) + np.abs(self.q) @ size) + quadratic + abs(self.constant)

    @shaped
    def added(self, x: Float[Array, " n"]) -> float:
        """The absolute values of the four terms of the cost at ``x``, added up."""
        quadratic = 0.0 if self.P is None else self._square(x)[0]
        return float(self.weights @ self._lengths(x)) + abs(float(self.q @ x)) + abs(quadratic) + abs(self.constant)

    @shaped
    def residual(self, x: Float[Array, " n"]) -> float:
        """The largest violation of bounds, rows and equalities at ``x``, each divided by its own scale (see
        `scaled_violation`)."""
        size = np.abs(x)
        worst = 0.0
        if self.G.shape[0]:
            worst = scaled_violation(self.G @ x - self.h, self.G, self.h, size)
        worst = max(worst, self.missed(x))
        image = self.image(x)
        outside = np.maximum(self.lower - image, image - self.upper)
        if outside.max(initial=0.0) == 0.0:
            return worst
        return max(worst, float((outside / np.maximum(1.0, np.abs(image))).max()))

    @shaped
    def missed(self, x: Float[Array, " n"]) -> float:
        """The largest ``|A x - b|``, each divided by its own scale (see `scaled_violation`); 0 without equalities."""
        return scaled_violation(np.abs(self.excess(x)), self.A, self.b, np.abs(x)) if self.b.size else 0.0

    @shaped
    def excess(self, x: Float[Array, " n"]) -> Float[Array, " e"]:
        """``A x - b``, summed with more digits than it is told with."""
        wide = np.longdouble
        return np.asarray(self.A.astype(wide) @ x.astype(wide) - self.b.astype(wide), dtype=float)

    def validate(self) -> None:
        """Raise `InputError` when shapes disagree or a number is not one."""
        self._demand({"G": (self.h.size, self.n)}, ("G",))
        if not self.h.min(initial=np.inf) > -np.inf:
            raise InputError(NAN if np.isnan(self.h).any() else SIGNS)
        assert self._sound

    @cached_property
    def _sound(self) -> bool:
        """`validate`, but for the rows."""
        k = self.n if self.S is None else int(self.S.shape[0])
        shapes = {"weights": (k,), "lower": (k,), "upper": (k,), "A": (self.b.size, self.n)}
        self._demand(shapes, ("q", "weights", "A", "b"))
        if np.isnan(self.lower).any() or np.isnan(self.upper).any():
            raise InputError(NAN)
        if (self.weights < 0).any():
            raise InputError(SIGNS)
        if not np.isfinite(self.constant):
            raise InputError(f"finite program: constant is {self.constant}, expected a finite number")
        return True

    def _demand(self, shapes: Mapping[str, tuple[int, ...]], finite: Sequence[str]) -> None:
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"finite program: {name} has shape {getattr(self, name).shape}, expected {shape}")
        for name in finite:
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"finite program: {name} has an entry that is not a finite number")


def diagonal(P: csc_array | None, n: int) -> Array | None:
    """The diagonal ``(n,)`` of a diagonal ``P`` (zeros for ``None``), or ``None`` when ``P`` has other entries."""
    if P is None:
        return np.zeros(n)
    columns = np.repeat(np.arange(n), np.diff(P.indptr))
    if not np.array_equal(columns, P.indices):
        return None
    return np.bincount(columns, P.data, n).astype(float)


@shaped
def scaled_violation(
    violations: Float[Array, " r"], rows: Float[Array, "r n"], rhs: Float[Array, " r"], size: Float[Array, " n"]
) -> float:
    """``max_i violations_i / max(min(1, |rows_i|), |rhs_i| + |rows_i| size)``.

    A row of ordinary size is judged by its absolute violation, a short row by the distance to its half-space, and any
    row leniently only where the numbers that cancel in it are themselves large.
    """
    magnitude = np.where(np.isfinite(rhs), np.abs(rhs), 0.0) + np.abs(rows) @ size
    length = np.minimum(1.0, np.sqrt(np.einsum("ij,ij->i", rows, rows)))
    scale = np.maximum(np.maximum(length, magnitude), np.finfo(float).tiny)
    return max(0.0, float((violations / scale).max(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Directions:
    """Unit vectors ``vectors (r, g)``, each for the block ``block (r,)`` in the order of its entries: the largest of
    ``d's`` over those of a block is at most its norm."""

    block: np.ndarray
    vectors: Array

    def joined(self, other: Directions) -> Directions:
        """These and those of the others that are not among them."""
        block, vectors = np.concatenate([self.block, other.block]), np.vstack([self.vectors, other.vectors])
        _, first = np.unique(np.column_stack([block, np.round(vectors, 12) + 0.0]), axis=0, return_index=True)
        kept = np.sort(first)
        return Directions(block[kept], vectors[kept])


CLOSED_FORM, DUAL_NEWTON, HIGHS, SOLVER, NOBODY = "closed_form", "dual_newton", "highs", "solver", "nobody"
INTERIOR = "interior_point"


@dataclass(frozen=True, eq=False)
class FiniteSolution:
    """What was *checked* about a finite program; no number here was taken from a solver unread.

    ``status``: ``optimal`` (``residual`` and ``gap`` are below the tolerance), ``infeasible`` (``infeasibility`` is
    proven) or ``failed``. ``value`` is the cost at ``x (n,)``; ``lower_bound`` is proven by weak duality from
    ``y (r,) >= 0`` (of ``G x <= h``), ``mu (e,)`` (of ``A x = b``) and ``z (k,)`` (of ``s = S x``), with
    ``P x + q + G'y + A'mu + S'z = 0`` at an optimum. ``residual``: see `FiniteProgram.residual`;
    ``gap = value - lower_bound``. ``directions``: those that norms of blocks were replaced by, the last time.
    ``infeasibility``: a proven lower bound of the smallest ``t`` for which
    ``G_i x <= h_i + t |G_i|`` and ``|A_i x - b_i| <= t |A_i|`` can be met within the bounds. ``attempts``: what was
    tried and why it was not believed. ``by``: whose answer it is, `CLOSED_FORM`, `DUAL_NEWTON`, `HIGHS`, `NOBODY` or
    the name of the solver that was asked (`SOLVER`, where it has none). ``unanswered``: why it is not the answer of the
    solver that was named.
    """

    status: Literal["optimal", "infeasible", "failed"]
    x: Array
    value: float
    lower_bound: float
    y: Array
    mu: Array
    z: Array
    residual: float
    gap: float
    message: str = ""
    attempts: tuple[str, ...] = ()
    infeasibility: float = 0.0
    directions: Directions | None = None
    by: str = ""
    unanswered: str = ""


@final
@dataclass(frozen=True, eq=False)
class Spread:
    """The set of deviations ``w (Q,)`` from the middle ``(Q,)``: a product of ``sets``, each so many times, in order.

    A deviation is what a point of its set has beyond the set's ``middle``; 0 is one. ``missed``: of its size, by how
    much what is written down of a deviation may miss it. ``still (Q,)``: entries that nothing answers, since they
    deviate by no more than doubles resolve; they count like all others, but nobody names them in a proof.
    """

    sets: tuple[tuple[int, ConvexSet], ...]
    missed: float = 0.0
    still: np.ndarray | None = None

    @cached_property
    def parts(self) -> tuple[tuple[slice, int, ConvexSet, Array], ...]:
        """Of every set its entries, its copies, itself and its middle ``(q,)``."""
        found, start = [], 0
        for count, convex in self.sets:
            stop = start + count * convex.dimension
            found.append((slice(start, stop), count, convex, convex.middle()))
            start = stop
        return tuple(found)

    @property
    def size(self) -> int:
        """``Q``."""
        return sum(count * convex.dimension for count, convex in self.sets)

    @cached_property
    def middle(self) -> Array:
        """What deviations are counted from, ``(Q,)``."""
        middles = [np.tile(middle, count) for _, count, _, middle in self.parts]
        return np.concatenate([np.zeros(0), *middles])

    @cached_property
    def inner(self) -> Array:
        """A deviation that is well inside, ``(Q,)``."""
        points = [np.tile(convex.interior_point() - middle, count) for _, count, convex, middle in self.parts]
        return np.concatenate([np.zeros(0), *points])

    @cached_property
    def radii(self) -> Array:
        """How far each entry comes from 0, ``(Q,)``."""
        found = [np.zeros(0)]
        for _, count, convex, middle in self.parts:
            axes = np.eye(convex.dimension)
            far = np.maximum(convex.support(axes) - middle, convex.support(-axes) + middle)
            found.append(np.tile(np.maximum(far, 0.0), count))
        return np.concatenate(found)

    @cached_property
    def lost(self) -> float:
        """Of their size, by how much points of the sets that are written down miss the deviations that they stand for:
        what is `missed`, and rounding of points that are far from 0 beside how far they deviate."""
        moving = self.radii > 0.0 if self.still is None else (self.radii > 0.0) & ~self.still
        far = (np.abs(self.middle) / np.where(moving, self.radii, np.inf)).max(initial=0.0)
        return float(self.missed + np.finfo(float).eps * (1.0 + far))

    @cached_property
    def chords(self) -> Array:
        """How long the set is along each axis through the middle, ``(Q,)``, in parts of the axis: for all ``a`` in its
        span, the width of the set along ``a`` is at least that times ``|a_i|``. Of a set without an interior the axes
        are those within its span."""
        found = [np.zeros(0)]
        for (_, count, convex, middle), within in zip(self.parts, self._projectors, strict=True):
            if convex.is_box:
                box = convex.bounding_box()
                low, high = box.lower, box.upper
            else:
                low, high = convex.chord(np.broadcast_to(middle, within.shape), within)
                low, high = (np.where(within.any(axis=1), side, 0.0) for side in (low, high))
            found.append(np.tile(np.maximum(high - low, 0.0), count))
        return np.concatenate(found)

    @cached_property
    def _projectors(self) -> list[Array]:
        """Of every set the orthogonal projector ``(q, q)`` onto its span."""
        return [projector(convex.span) for _, _, convex, _ in self.parts]

    @property
    def leans(self) -> bool:
        """Whether a set has no interior, nor is one of fewer coordinates."""
        return any(not _is_diagonal(within) for within in self._projectors)

    def within(self, a: Array) -> Array:
        """What ``a (..., Q)`` is within the span of the set, along which all deviations are; 0 on entries that do not
        deviate, or are `still`."""
        return self._projected(a) * (self.chords > 0.0) * (1.0 if self.still is None else ~self.still)

    def named(self, w: Array) -> Array:
        """Deviations ``w (..., Q)`` that a proof may name instead of others: those within the span of the set, and none
        of what is `still`. Of sets with an interior these are they themselves."""
        return self._projected(w) * (1.0 if self.still is None else ~self.still)

    def _projected(self, a: Array) -> Array:
        found = np.array(a)
        for (part, count, convex, _), within in zip(self.parts, self._projectors, strict=True):
            if not _is_diagonal(within):
                blocks = a[..., part].reshape(*a.shape[:-1], count, convex.dimension)
                found[..., part] = (blocks @ within).reshape(*a.shape[:-1], -1)
        return found

    @property
    def is_box(self) -> bool:
        """Whether every set is a box: the deviations are then those of at most `radii`, entry by entry."""
        return all(convex.is_box for _, convex in self.sets)

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether with every deviation its opposite is one."""
        return all(convex.is_symmetric for _, convex in self.sets)

    def support(self, a: Array) -> Array:
        """``max_w w'a (...,)`` of ``a (..., Q)``."""
        if self.is_box:
            return np.asarray(np.abs(a) @ self.radii)
        total = np.zeros(a.shape[:-1])
        for part, count, convex, middle in self.parts:
            blocks = a[..., part].reshape(*a.shape[:-1], count, convex.dimension)
            total = total + (convex.support(blocks) - blocks @ middle).sum(axis=-1)
        return total

    def holds(self, w: Array) -> bool:
        """Whether ``w (Q,)`` is a deviation."""
        return all(
            bool((convex.violation(w[part].reshape(count, -1) + middle) <= 0.0).all())
            for part, count, convex, middle in self.parts
        )

    def worst(self, a: Array) -> Array:
        """A deviation ``(..., Q)`` that attains `support`."""
        if self.is_box:
            return np.asarray(np.sign(a) * self.radii)
        found = np.empty(a.shape)
        for part, count, convex, middle in self.parts:
            blocks = a[..., part].reshape(*a.shape[:-1], count, convex.dimension)
            found[..., part] = (convex.support_point(blocks) - middle).reshape(*a.shape[:-1], part.stop - part.start)
        return found


def _is_diagonal(matrix: Array) -> bool:
    return np.array_equal(matrix, np.diag(np.diag(matrix)))


def gathered(
    row: np.ndarray, column: np.ndarray, value: Array, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Where every row of a sparse table begins, and its columns and values, from entries in any order; those at one
    place are added up."""
    place = row * np.int64(shape[1]) + column
    order = place.argsort(kind="stable")
    place, value = place[order], value[order]
    first = np.flatnonzero(np.diff(place, prepend=-1))
    if first.size < place.size:
        place, value = place[first], np.add.reduceat(value, first)
    starts = place.searchsorted(np.arange(shape[0] + 1) * np.int64(shape[1]))
    return starts.astype(np.int32), (place % max(1, shape[1])).astype(np.int32), value


def table_of(row: np.ndarray, column: np.ndarray, value: Array, shape: tuple[int, int]) -> csr_array:
    """A sparse table of entries: what ``csr_array`` makes of them too, which for small tables takes three times as long
    with its checks."""
    from scipy.sparse import csr_array

    starts, columns, values = gathered(row, column, value, shape)
    table = csr_array((values, columns, starts), shape=shape)
    table.has_canonical_format = True
    return table


def entries_of(table: csr_array) -> tuple[np.ndarray, np.ndarray, Array]:
    """Rows, columns and values of a sparse table, row by row."""
    return np.repeat(np.arange(table.shape[0]), np.diff(table.indptr)), table.indices, table.data


@final
@dataclass(frozen=True, eq=False)
class UncertainRows:
    """Rows ``g_r x + factor_r w'(C_p x + d_p) <= h_r`` for every deviation, with ``p = part_r``.

    ``g (r, n)`` and every ``C (Q, n)`` sparse, ``h (r,)``, ``d (p, Q)``. Rows that look opposite ways share a part,
    with factors of opposite signs. ``exact``: the second half of the rows are the opposites of the first, so that both
    hold with equality, at every deviation.
    """

    g: csr_array
    h: Array
    part: np.ndarray
    factor: Array
    C: tuple[csr_array, ...]
    d: Array
    exact: bool = False

    @cached_property
    def equations(self) -> tuple[csr_array, Array]:
        """Of exact rows ``N x = b``: every row of the first half, then its answers to the deviations, which are 0."""
        from scipy.sparse import csr_array, vstack

        tables, rhs = [], [np.zeros(0)]
        for row in range(self.h.size // 2):
            p, factor = int(self.part[row]), float(self.factor[row])
            tables += [self.g[[row]], factor * self.C[p]]
            rhs += [self.h[[row]], -factor * self.d[p]]
        return csr_array(vstack(tables)), np.concatenate(rhs)

    @cached_property
    def stacked(self) -> csr_array:
        """The ``C_p``, one below the other, ``(p Q, n)``."""
        from scipy.sparse import csr_array, vstack

        if len(self.C) == 1:  # the commonest, which would be there twice
            return self.C[0]
        return csr_array(vstack(self.C)) if self.C else csr_array((0, self.g.shape[1]))

    def coefficients(self, x: Array) -> Array:
        """``C_p x + d_p``, ``(p, Q)``."""
        return np.asarray(self.d + (self.stacked @ x).reshape(self.d.shape))

    def excess(self, x: Array, spread: Spread) -> Array:
        """By how much the rows are violated at the worst deviation, ``(r,)``; negative: a margin."""
        a = self.coefficients(x)
        return np.asarray(self.g @ x - self.h + spread.support(self.factor[:, None] * a[self.part]))
