"""Finite programs, left when finitely many indices are imposed, with checked solutions; rows that hold for every
deviation.

A row with deviations is ``g x + w'(C x + d) <= h`` for all ``w`` in a product of convex sets, the `Spread`. Its worst
deviation is known in closed form: ``max_w w'a`` is a sum of support functions (Ben-Tal, El Ghaoui and Nemirovski 2009,
section 1.3). So the left side is a convex function of the decision.
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
# Ratio of the terms of a square to its value. Above it, double precision leaves fewer than ten digits of it. With
# a thousand times as much, the last digits of a gap are rounding; with a thousandth, ordinary costs are summed twice.
CANCELS = 1e6
SIGNS = "finite program: expected weights >= 0 and right-hand sides above -inf"


@dataclass(frozen=True, eq=False)
class Blocks:
    """Entries of an image that enter the cost by their Euclidean norm, in blocks.

    Parameters
    ----------
    number : ndarray of int, shape (k,)
        Block of each entry, from 0; -1 for an entry that counts alone. Entries of one block have one weight.
    """

    number: np.ndarray

    @cached_property
    def entries(self) -> np.ndarray:
        """Numbers ``(e,)`` of the entries that are in a block."""
        return np.flatnonzero(self.number >= 0)

    @cached_property
    def of(self) -> np.ndarray:
        """Block ``(e,)`` of each entry in `entries`."""
        return np.asarray(self.number[self.entries])

    @cached_property
    def first(self) -> np.ndarray:
        """First entry ``(b,)`` of every block."""
        return np.asarray(self.entries[np.unique(self.of, return_index=True)[1]])

    @cached_property
    def table(self) -> np.ndarray:
        """Entries ``(b, g)`` of every block, filled with -1 where a block has fewer than the largest."""
        order = np.argsort(self.of, kind="stable")
        sizes = np.bincount(self.of, minlength=self.first.size)
        table = np.full((sizes.size, int(sizes.max(initial=0))), -1)
        table[np.arange(table.shape[1]) < sizes[:, None]] = self.entries[order]
        return table

    @shaped
    def norms(self, image: Float[Array, " k"]) -> Float[Array, " b"]:
        """Return the norm ``(b,)`` of every block of an image ``(k,)``."""
        squares = np.bincount(self.of, image[self.entries] ** 2, self.first.size)
        return np.asarray(np.sqrt(squares), dtype=float)

    @shaped
    def directions(self, image: Float[Array, " k"]) -> Float[Array, " k"]:
        """Return an image ``(k,)`` with every block divided by its norm; 0 where the norm is 0, and outside of
        blocks."""
        answer = np.zeros(image.size)
        norms = self.norms(image)
        answer[self.entries] = image[self.entries] / np.where(norms > 0.0, norms, np.inf)[self.of]
        return answer

    @shaped
    def lengths(self, image: Float[Array, " k"]) -> Float[Array, " k"]:
        """Return the length ``(k,)`` with which each entry enters the cost.

        Outside of blocks it is the absolute value. The first entry of a block has the norm of the block, the others 0.
        """
        answer = np.abs(image)
        answer[self.entries] = 0.0
        answer[self.first] = self.norms(image)
        return answer


@dataclass(frozen=True, eq=False)
class FiniteProgram:
    """Convex program with finitely many constraints.

    Minimise ``sum_k weights_k |(S x)_k| + 1/2 x'P x + q'x + constant`` subject to ``lower <= S x <= upper``, ``G x <=
    h``, ``A x = b``. Each of the ``blocks`` of images costs its weight times its Euclidean norm instead.

    Parameters
    ----------
    q : ndarray, shape (n,)
        Linear cost.
    weights : ndarray, shape (k,)
        Weights of the absolute values, at least 0.
    lower, upper : ndarray, shape (k,)
        Bounds of the image; entries may be ``-inf`` and ``inf``.
    G : ndarray, shape (r, n)
        Rows of the inequalities.
    h : ndarray, shape (r,)
        Right-hand sides of the inequalities; entries may be ``inf``.
    A : ndarray, shape (e, n)
        Rows of the equalities.
    b : ndarray, shape (e,)
        Right-hand sides of the equalities.
    P : csc_array, shape (n, n), optional
        Symmetric positive semidefinite matrix; ``None`` for 0.
    S : csc_array, shape (k, n), optional
        Matrix of the image; ``None`` for the identity.
    constant : float, default 0
        Constant term of the cost.
    blocks : Blocks, optional
        Blocks of images.

    Notes
    -----
    Arrays must not be written to after the program is built. Quantities that depend on ``S``, ``weights`` and the
    bounds alone are shared between programs.
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
        """Diagonal ``(n,)`` of ``P``, zeros where there is no ``P``; ``None`` where ``P`` has entries off the
        diagonal."""
        return diagonal(self.P, self.n)

    @cached_property
    def steepest(self) -> float:
        """Largest coefficient of the linear cost and of the absolute values."""
        return float(max(self.weights.max(initial=0.0), np.abs(self.q).max(initial=0.0)))

    @cached_property
    def separable(self) -> bool:
        """True where every variable has a cost and bounds of its own: ``S`` the identity, ``P`` diagonal, and no
        blocks."""
        return self.S is None and self.blocks is None and self.curvature is not None

    def under(self, G: Array, h: Array) -> FiniteProgram:
        """Return the program with further rows, which follow its own.

        Parameters
        ----------
        G : ndarray, shape (s, n)
            Further rows.
        h : ndarray, shape (s,)
            Their right-hand sides, ``G x <= h``.

        Returns
        -------
        FiniteProgram
            The program with ``r + s`` rows.
        """
        own = self.h.size
        G, h = (np.vstack([self.G, G]), np.concatenate([self.h, h])) if own else (G, h)
        program = FiniteProgram(
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
        # quantities that do not depend on the rows
        program.__dict__.update(
            curvature=self.curvature, steepest=self.steepest, bounded=self.bounded, _is_valid=self._is_valid
        )
        return program

    def curved(self, P: csc_array, q: Array) -> FiniteProgram:
        """Return the program with another quadratic and linear cost.

        Parameters
        ----------
        P : csc_array, shape (n, n)
            Quadratic cost, symmetric positive semidefinite.
        q : ndarray, shape (n,)
            Linear cost.

        Returns
        -------
        FiniteProgram
            The program with this cost.
        """
        program = replace(self, P=P, q=q)
        if q is self.q:
            program.__dict__.update(steepest=self.steepest, bounded=self.bounded, _is_valid=self._is_valid)
        return program

    @cached_property
    def bounded(self) -> bool:
        """True where all bounds are finite."""
        return bool(np.isfinite(self.lower).all() and np.isfinite(self.upper).all())

    @shaped
    def image(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        """Return ``S x``, ``(k,)``."""
        return x if self.S is None else np.asarray(self.S @ x, dtype=float)

    @shaped
    def objective(self, x: Float[Array, " n"]) -> float:
        """Return the cost at ``x``.

        Rounding may make a square negative where its terms cancel; it is then counted as 0.
        """
        quadratic = 0.0 if self.P is None else max(0.0, self._evaluate_quadratic(x)[0])
        return float(self.weights @ self._measure_lengths(x) + self.q @ x) + quadratic + self.constant

    def _evaluate_quadratic(self, x: Array) -> tuple[float, float]:
        """Return ``1/2 x'P x``, and the size to which its rounding error is relative.

        The sum is computed with more digits where most of it cancels.
        """
        square = 0.5 * float(x @ self._differentiate_quadratic(x))
        if self.P is None or self.curvature is not None:
            return square, abs(square)
        size = np.abs(x)
        magnitude = 0.5 * float(size @ (abs(self.P) @ size))
        if magnitude <= CANCELS * abs(square):
            return square, magnitude
        wide = x.astype(np.longdouble)
        square = 0.5 * float(wide @ (self.P.astype(np.longdouble) @ wide))
        return square, abs(square) + magnitude * float(np.finfo(np.longdouble).eps / np.finfo(float).eps)

    @shaped
    def _measure_lengths(self, x: Float[Array, " n"]) -> Float[Array, " k"]:
        """Return the length ``(k,)`` with which each entry of the image enters the cost."""
        image = self.image(x)
        return np.abs(image) if self.blocks is None else self.blocks.lengths(image)

    def _differentiate_quadratic(self, x: Array) -> Array:
        """Return ``P x``."""
        if self.curvature is not None:
            return self.curvature * x
        assert self.P is not None
        return np.asarray(self.P @ x, dtype=float)

    @shaped
    def tangent(self, at: Float[Array, " n"]) -> FiniteProgram:
        """Return the program with ``1/2 x'P x`` replaced by its tangent at ``at``, which lies below it."""
        if self.P is None:
            return self
        gradient = self._differentiate_quadratic(at)
        return replace(self, P=None, q=self.q + gradient, constant=self.constant - 0.5 * float(at @ gradient))

    @shaped
    def magnitude(self, x: Float[Array, " n"]) -> float:
        """Return the sum of the absolute values of all terms of the cost at ``x``, to which its rounding error is
        relative."""
        size = np.abs(x)
        quadratic = 0.0 if self.P is None else self._evaluate_quadratic(x)[1]
        return float(self.weights @ self._measure_lengths(x) + np.abs(self.q) @ size) + quadratic + abs(self.constant)

    @shaped
    def added(self, x: Float[Array, " n"]) -> float:
        """Return the sum of the absolute values of the four parts of the cost at ``x``."""
        quadratic = 0.0 if self.P is None else self._evaluate_quadratic(x)[0]
        return (
            float(self.weights @ self._measure_lengths(x))
            + abs(float(self.q @ x))
            + abs(quadratic)
            + abs(self.constant)
        )

    @shaped
    def residual(self, x: Float[Array, " n"]) -> float:
        """Return the largest violation of bounds, rows and equalities at ``x``, each divided by its scale
        (`scaled_violation`)."""
        size = np.abs(x)
        worst = 0.0
        if self.G.shape[0]:
            worst = scaled_violation(self.G @ x - self.h, self.G, self.h, size)
        worst = max(worst, self.equality_residual(x))
        image = self.image(x)
        outside = np.maximum(self.lower - image, image - self.upper)
        if outside.max(initial=0.0) == 0.0:
            return worst
        return max(worst, float((outside / np.maximum(1.0, np.abs(image))).max()))

    @shaped
    def equality_residual(self, x: Float[Array, " n"]) -> float:
        """Return the largest residual ``|A x - b|``, each divided by its scale (`scaled_violation`); 0 without
        equalities."""
        return scaled_violation(np.abs(self.excess(x)), self.A, self.b, np.abs(x)) if self.b.size else 0.0

    @shaped
    def excess(self, x: Float[Array, " n"]) -> Float[Array, " e"]:
        """Return the residuals ``A x - b``, summed in extended precision."""
        wide = np.longdouble
        return np.asarray(self.A.astype(wide) @ x.astype(wide) - self.b.astype(wide), dtype=float)

    def validate(self) -> None:
        """Raise `InputError` where shapes disagree, or a number is NaN or has a wrong sign."""
        self._check_arrays({"G": (self.h.size, self.n)}, ("G",))
        if not self.h.min(initial=np.inf) > -np.inf:
            raise InputError(NAN if np.isnan(self.h).any() else SIGNS)
        assert self._is_valid

    @cached_property
    def _is_valid(self) -> bool:
        """True where everything except the rows is valid; otherwise `InputError` is raised."""
        k = self.n if self.S is None else int(self.S.shape[0])
        shapes = {"weights": (k,), "lower": (k,), "upper": (k,), "A": (self.b.size, self.n)}
        self._check_arrays(shapes, ("q", "weights", "A", "b"))
        if np.isnan(self.lower).any() or np.isnan(self.upper).any():
            raise InputError(NAN)
        if (self.weights < 0).any():
            raise InputError(SIGNS)
        if not np.isfinite(self.constant):
            raise InputError(f"finite program: constant is {self.constant}, expected a finite number")
        return True

    def _check_arrays(self, shapes: Mapping[str, tuple[int, ...]], finite: Sequence[str]) -> None:
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"finite program: {name} has shape {getattr(self, name).shape}, expected {shape}")
        for name in finite:
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"finite program: {name} has an entry that is not a finite number")


def diagonal(P: csc_array | None, n: int) -> Array | None:
    """Return the diagonal ``(n,)`` of a diagonal ``P``, zeros for ``None``; ``None`` where ``P`` has other entries."""
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
    """Return ``max_i violations_i / max(min(1, |rows_i|), |rhs_i| + |rows_i| size)``, at least 0.

    A row of norm 1 or more is judged by its absolute violation, a short row by the distance to its half-space. A row is
    judged less strictly only where the numbers that cancel in it are themselves large.

    Parameters
    ----------
    violations : ndarray, shape (r,)
        Violations of the rows.
    rows : ndarray, shape (r, n)
        Rows.
    rhs : ndarray, shape (r,)
        Right-hand sides.
    size : ndarray, shape (n,)
        Absolute values of the decision.

    Returns
    -------
    float
        The largest scaled violation.
    """
    magnitude = np.where(np.isfinite(rhs), np.abs(rhs), 0.0) + np.abs(rows) @ size
    length = np.minimum(1.0, np.sqrt(np.einsum("ij,ij->i", rows, rows)))
    scale = np.maximum(np.maximum(length, magnitude), np.finfo(float).tiny)
    return max(0.0, float((violations / scale).max(initial=0.0)))


@dataclass(frozen=True, eq=False)
class Directions:
    """Unit vectors of blocks, whose linear functions bound the norms of the blocks from below.

    For a unit vector ``d`` of a block with entries ``s``, ``d's`` is at most the norm of ``s``.

    Parameters
    ----------
    block : ndarray of int, shape (r,)
        Block of each vector.
    vectors : ndarray, shape (r, g)
        Unit vectors, in the order of the block's entries.
    """

    block: np.ndarray
    vectors: Array

    def joined(self, other: Directions) -> Directions:
        """Return these directions and those of ``other`` that are not among them."""
        block, vectors = np.concatenate([self.block, other.block]), np.vstack([self.vectors, other.vectors])
        _, first = np.unique(np.column_stack([block, np.round(vectors, 12) + 0.0]), axis=0, return_index=True)
        kept = np.sort(first)
        return Directions(block[kept], vectors[kept])


CLOSED_FORM, DUAL_NEWTON, HIGHS, SOLVER, NOBODY = "closed_form", "dual_newton", "highs", "solver", "nobody"


@dataclass(frozen=True, eq=False)
class FiniteSolution:
    """Checked solution of a finite program: no number is taken from a solver without a check.

    Parameters
    ----------
    status : {"optimal", "infeasible", "failed"}
        ``optimal``: ``residual`` and ``gap`` are below the tolerance. ``infeasible``: ``infeasibility`` is proven.
    x : ndarray, shape (n,)
        The decision.
    value : float
        Cost at the decision.
    lower_bound : float
        Lower bound of the optimal value, proven by weak duality from the multipliers.
    y : ndarray, shape (r,)
        Multipliers of ``G x <= h``, at least 0. At an optimum, ``P x + q + G'y + A'mu + S'z = 0``.
    mu : ndarray, shape (e,)
        Multipliers of ``A x = b``.
    z : ndarray, shape (k,)
        Multipliers of ``s = S x``.
    residual : float
        Largest scaled violation (`FiniteProgram.residual`).
    gap : float
        ``value - lower_bound``.
    message : str
        Text for a reader.
    attempts : tuple of str
        Methods that were tried, and the reasons why their answers were rejected.
    infeasibility : float
        Proven lower bound of the smallest ``t`` for which ``G_i x <= h_i + t |G_i|`` and ``|A_i x - b_i| <= t |A_i|``
        can be met within the bounds.
    directions : Directions, optional
        Last directions that replaced the norms of blocks.
    by : str
        Origin of the answer: `CLOSED_FORM`, `DUAL_NEWTON`, `HIGHS`, `NOBODY` or the name of the solver that was called
        (`SOLVER`, where it has none).
    unanswered : str
        Reason why the named solver did not answer.
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

    @property
    def error(self) -> float:
        """Residual plus gap, by which two answers are compared; a negative gap counts as 0."""
        return self.residual + max(self.gap, 0.0)


@final
@dataclass(frozen=True, eq=False)
class Spread:
    """Set of deviations ``w (Q,)`` from its middle ``(Q,)``: a product of convex sets.

    A deviation is a point of the product minus the middles of the sets; 0 is a deviation.

    Parameters
    ----------
    sets : tuple of (int, ConvexSet)
        Numbers of copies and sets, in the order of the entries of ``w``.
    still : ndarray of bool, shape (Q,), optional
        Entries that no control answers, since they deviate by no more than the resolution of doubles. Such entries
        count like all others, but no proof names them.
    """

    sets: tuple[tuple[int, ConvexSet], ...]
    still: np.ndarray | None = None

    @cached_property
    def parts(self) -> tuple[tuple[slice, int, ConvexSet, Array], ...]:
        """Entries, number of copies, set and middle ``(q,)`` of every set, in order."""
        blocks, start = [], 0
        for count, convex in self.sets:
            stop = start + count * convex.dimension
            blocks.append((slice(start, stop), count, convex, convex.middle()))
            start = stop
        return tuple(blocks)

    @property
    def size(self) -> int:
        """Number ``Q`` of entries of a deviation."""
        return sum(count * convex.dimension for count, convex in self.sets)

    @cached_property
    def middle(self) -> Array:
        """Point ``(Q,)`` from which deviations are counted."""
        middles = [np.tile(middle, count) for _, count, _, middle in self.parts]
        return np.concatenate([np.zeros(0), *middles])

    @cached_property
    def inner(self) -> Array:
        """A deviation ``(Q,)`` well inside the set."""
        points = [np.tile(convex.interior_point() - middle, count) for _, count, convex, middle in self.parts]
        return np.concatenate([np.zeros(0), *points])

    @cached_property
    def radii(self) -> Array:
        """Largest absolute value ``(Q,)`` of each entry of a deviation."""
        radii = [np.zeros(0)]
        for _, count, convex, middle in self.parts:
            axes = np.eye(convex.dimension)
            extents = np.maximum(convex.support(axes) - middle, convex.support(-axes) + middle)
            radii.append(np.tile(np.maximum(extents, 0.0), count))
        return np.concatenate(radii)

    @cached_property
    def lost(self) -> float:
        """Relative error with which points of the sets represent deviations: the rounding of points that are far from 0
        compared with their deviations."""
        moving = self.radii > 0.0 if self.still is None else (self.radii > 0.0) & ~self.still
        ratio = (np.abs(self.middle) / np.where(moving, self.radii, np.inf)).max(initial=0.0)
        return float(np.finfo(float).eps * (1.0 + ratio))

    @cached_property
    def chords(self) -> Array:
        """Length ``(Q,)`` of the set along each axis through the middle, as a multiple of the axis.

        For all ``a`` in the span of the set, the width of the set along ``a`` is at least that length times ``|a_i|``.
        For a set without an interior, the axes are their projections onto its span.
        """
        lengths = [np.zeros(0)]
        for (_, count, convex, middle), matrix in zip(self.parts, self._projectors, strict=True):
            if convex.is_box:
                box = convex.bounding_box()
                low, high = box.lower, box.upper
            else:
                low, high = convex.chord(np.broadcast_to(middle, matrix.shape), matrix)
                low, high = (np.where(matrix.any(axis=1), side, 0.0) for side in (low, high))
            lengths.append(np.tile(np.maximum(high - low, 0.0), count))
        return np.concatenate(lengths)

    @cached_property
    def _projectors(self) -> list[Array]:
        """Orthogonal projector ``(q, q)`` onto the span of every set."""
        return [projector(convex.span) for _, _, convex, _ in self.parts]

    @property
    def leans(self) -> bool:
        """True where a set has no interior, and its span is not spanned by axes."""
        return any(not _is_diagonal(matrix) for matrix in self._projectors)

    def within(self, a: Array) -> Array:
        """Return ``a (..., Q)`` projected onto the span of the set; 0 for entries that do not deviate, or are
        `still`."""
        return self._project_onto_span(a) * (self.chords > 0.0) * (1.0 if self.still is None else ~self.still)

    def named(self, w: Array) -> Array:
        """Return the deviations that a proof may name instead of deviations ``w (..., Q)``.

        The deviations ``w`` are projected onto the span of the set, and set to 0 for entries that are `still`. Sets
        with an interior leave ``w`` unchanged.
        """
        return self._project_onto_span(w) * (1.0 if self.still is None else ~self.still)

    def _project_onto_span(self, a: Array) -> Array:
        """Return ``a (..., Q)`` projected onto the span of the set."""
        projection = np.array(a)
        for (entries, count, convex, _), matrix in zip(self.parts, self._projectors, strict=True):
            if not _is_diagonal(matrix):
                blocks = a[..., entries].reshape(*a.shape[:-1], count, convex.dimension)
                projection[..., entries] = (blocks @ matrix).reshape(*a.shape[:-1], -1)
        return projection

    @property
    def is_box(self) -> bool:
        """True where every set is a box; the deviations are then bounded by `radii`, entry by entry."""
        return all(convex.is_box for _, convex in self.sets)

    @cached_property
    def is_symmetric(self) -> bool:
        """True where the opposite of every deviation is a deviation."""
        return all(convex.is_symmetric for _, convex in self.sets)

    def support(self, a: Array) -> Array:
        """Return ``max_w w'a``, ``(...,)``, for ``a (..., Q)``."""
        if self.is_box:
            return np.asarray(np.abs(a) @ self.radii)
        total = np.zeros(a.shape[:-1])
        for entries, count, convex, middle in self.parts:
            blocks = a[..., entries].reshape(*a.shape[:-1], count, convex.dimension)
            total = total + (convex.support(blocks) - blocks @ middle).sum(axis=-1)
        return total

    def holds(self, w: Array) -> bool:
        """Return whether ``w (Q,)`` is a deviation."""
        return all(
            bool((convex.violation(w[entries].reshape(count, -1) + middle) <= 0.0).all())
            for entries, count, convex, middle in self.parts
        )

    def worst(self, a: Array) -> Array:
        """Return deviations ``(..., Q)`` that attain `support`."""
        if self.is_box:
            return np.asarray(np.sign(a) * self.radii)
        deviations = np.empty(a.shape)
        for entries, count, convex, middle in self.parts:
            blocks = a[..., entries].reshape(*a.shape[:-1], count, convex.dimension)
            deviations[..., entries] = (convex.support_point(blocks) - middle).reshape(
                *a.shape[:-1], entries.stop - entries.start
            )
        return deviations


def _is_diagonal(matrix: Array) -> bool:
    """Return whether a matrix is diagonal."""
    return np.array_equal(matrix, np.diag(np.diag(matrix)))


def gathered(
    row: np.ndarray, column: np.ndarray, value: Array, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return the arrays of a sparse table in compressed rows; entries at the same place are added up.

    Parameters
    ----------
    row, column : ndarray of int, shape (k,)
        Place of each entry, in any order.
    value : ndarray, shape (k,)
        Value of each entry.
    shape : tuple of int
        Shape of the table.

    Returns
    -------
    starts : ndarray of int
        Start of every row.
    columns : ndarray of int
        Column of each value.
    values : ndarray
        Values, row by row.
    """
    positions = row * np.int64(shape[1]) + column
    order = positions.argsort(kind="stable")
    positions, value = positions[order], value[order]
    first = np.flatnonzero(np.diff(positions, prepend=-1))
    if first.size < positions.size:
        positions, value = positions[first], np.add.reduceat(value, first)
    starts = positions.searchsorted(np.arange(shape[0] + 1) * np.int64(shape[1]))
    return starts.astype(np.int32), (positions % max(1, shape[1])).astype(np.int32), value


def table_of(row: np.ndarray, column: np.ndarray, value: Array, shape: tuple[int, int]) -> csr_array:
    """Return a sparse table of entries, as ``csr_array`` would make it.

    For small tables ``csr_array`` takes three times as long, because of its checks.
    """
    from scipy.sparse import csr_array

    starts, columns, values = gathered(row, column, value, shape)
    table = csr_array((values, columns, starts), shape=shape)
    table.has_canonical_format = True
    return table


def entries_of(table: csr_array) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return the rows, columns and values of a sparse table, row by row."""
    return np.repeat(np.arange(table.shape[0]), np.diff(table.indptr)), table.indices, table.data


@final
@dataclass(frozen=True, eq=False)
class UncertainRows:
    """Rows ``g_r x + factor_r w'(C_p x + d_p) <= h_r`` for every deviation ``w``, with ``p = part_r``.

    Rows with opposite normals share a part, with factors of opposite signs.

    Parameters
    ----------
    g : csr_array, shape (r, n)
        Nominal rows.
    h : ndarray, shape (r,)
        Right-hand sides.
    part : ndarray of int, shape (r,)
        Part of each row.
    factor : ndarray, shape (r,)
        Factor of each row.
    C : tuple of csr_array, shape (Q, n) each
        Dependence of the coefficients of the deviation on the decision, for each part.
    d : ndarray, shape (p, Q)
        Constant coefficients of the deviation, for each part.
    exact : bool, default False
        Whether the second half of the rows are the opposites of the first half. The rows then hold with equality, at
        every deviation.
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
        """Equations ``N x = b`` of exact rows.

        Every row of the first half gives its nominal row, then its response to the deviations, which is 0.
        """
        from scipy.sparse import csr_array, vstack

        tables, rhs = [], [np.zeros(0)]
        for row in range(self.h.size // 2):
            p, factor = int(self.part[row]), float(self.factor[row])
            tables += [self.g[[row]], factor * self.C[p]]
            rhs += [self.h[[row]], -factor * self.d[p]]
        return csr_array(vstack(tables)), np.concatenate(rhs)

    @cached_property
    def stacked(self) -> csr_array:
        """All ``C_p``, one below the other, ``(p Q, n)``."""
        from scipy.sparse import csr_array, vstack

        if len(self.C) == 1:  # the most frequent case, without a copy
            return self.C[0]
        return csr_array(vstack(self.C)) if self.C else csr_array((0, self.g.shape[1]))

    def coefficients(self, x: Array) -> Array:
        """Return ``C_p x + d_p`` for all parts, ``(p, Q)``."""
        return np.asarray(self.d + (self.stacked @ x).reshape(self.d.shape))

    def excess(self, x: Array, spread: Spread) -> Array:
        """Return the violation of each row at its worst deviation.

        Parameters
        ----------
        x : ndarray, shape (n,)
            The decision.
        spread : Spread
            Set of deviations.

        Returns
        -------
        ndarray, shape (r,)
            Violations; a negative number is a margin.
        """
        a = self.coefficients(x)
        return np.asarray(self.g @ x - self.h + spread.support(self.factor[:, None] * a[self.part]))
