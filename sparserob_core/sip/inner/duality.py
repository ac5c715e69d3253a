"""Lower bounds of a finite program that hold for *any* multipliers, however inaccurate the solver that offered them.

`dual_bound` and `farkas_bound` are weak duality, less an allowance for the rounding of their own evaluation; `measure`
is everything that can be checked about a claim. Better multipliers make better bounds: `repair_multipliers` gives
unbounded variables the exact slopes that they ask for, and `vertex_multipliers` are those of the plain program at the
optimiser of a regularised one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate
from math import isfinite
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sparserob_core.shapes import Bool, Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.equalities import project_onto_equalities
from sparserob_core.sip.inner.extended import extended_bound
from sparserob_core.sip.inner.image import move_within_bounds, project_onto_stationary

if TYPE_CHECKING:
    from scipy.sparse import csc_array

# Least allowance for the error of a sum, relative to the sum of the absolute values (see `bound_rounding`). With a
# tenth of it, slopes of 0 are refused for what a projection leaves; ten times as much costs digits of bounds.
ROUND_OFF = 1e-14
EPSILON = float(np.finfo(float).eps)
SPARE_ROUNDINGS = 16  # roundings beside those of long sums: of products with a weight, of what is added last

MORE_DIGITS_ERROR = 1e-11  # of a bound: where its evaluation may be off by more, it is evaluated with more digits
SLOPE_LIMIT_DISTANCE = 1e-6  # a slope this close to its limit, or beyond it, is moved onto the limit
INFINITE_BOUND = 1e300  # an infinite bound of one block is compared as minus this number
MAX_REPAIRS = 4  # corrections of multipliers of the wrong sign; what is not right by then is no better bound
FREE = 1e-7  # an entry further than this from 0 and from both bounds, relative to their distance, is free
ACTIVE_ROW_SLACK = 1e-9  # a row with a slack below this may carry a multiplier
ACTIVE = 1e-9  # a row with a multiplier above this, relative to the largest, is active

Multipliers: TypeAlias = tuple[Array, Array, Array | None, Array | None]


@dataclass(frozen=True)
class Terms:
    """``bound = constant + sum_k min weights_k |s| + 1/2 curvature_k s^2 + slope_k s`` over the bounds; ``noise (k,)``
    of the slope: the sum of the absolute values of its terms. ``magnitude``: that sum for the ``constant``.
    ``at (k,)``: an image where norms of blocks may be replaced by their tangents. ``round_off``: what the rounding of
    all these sums may be, relative to those absolute values."""

    constant: float
    slope: Array
    noise: Array
    weights: Array
    curvature: Array | None
    magnitude: float
    at: Array | None = None
    round_off: float = ROUND_OFF


@shaped
def dual_bound(
    program: FiniteProgram,
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None = None,
    at: Float[Array, " n"] | None = None,
) -> float:
    """Return a lower bound of the program's value, by weak duality; ``-inf`` when these multipliers prove nothing.

    ``y (r,)`` (negative entries count as 0) and ``mu (e,)`` multiply ``G x <= h`` and ``A x = b``. A diagonal ``P``
    with ``S`` the identity is minimised entry by entry; any other ``P`` is replaced by its tangent at ``at (n,)``,
    which lies below it. ``z (k,)`` is the multiplier of ``s = S x``; it is first moved onto
    ``S'z + G'y + A'mu + q + P at = 0``, so any guess will do. An allowance for the round-off of this very evaluation is
    subtracted. Where an unbounded variable asks for a slope of exactly 0, a slope within its own round-off counts as 0.
    """
    return bound_with_multipliers(program, y, mu, z, at)[0]


@shaped
def bound_with_multipliers(
    program: FiniteProgram,
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None = None,
    at: Float[Array, " n"] | None = None,
) -> tuple[float, Float[Array, " r"], Float[Array, " e"], Float[Array, " k"] | None]:
    """Return `dual_bound` with the ``y``, ``mu`` and ``z`` that prove it: those given, or where these prove nothing the
    ones that they were moved to. Whoever writes the bound down must write these."""
    y = _clip_multipliers(program, y)
    return _prove_bound(program, _compute_terms(program, y, mu, z, at), y, mu, z, at)


def _prove_bound(
    program: FiniteProgram, terms: Terms, y: Array, mu: Array, z: Array | None, at: Array | None
) -> tuple[float, Array, Array, Array | None]:
    bound = _evaluate_bound(terms, program)
    if bound > -np.inf:
        large = terms.round_off * terms.magnitude > MORE_DIGITS_ERROR * abs(bound)
        bound = max(bound, extended_bound(program, y, mu)) if large else bound
        is_beyond = _find_overshoot(terms, program, bound)
        if is_beyond is not None:
            shrunk = _shrink_multipliers(program, y, mu, z, at, is_beyond)
            if shrunk[0] > bound:
                return shrunk
        return bound, y, mu, z
    better = repair_multipliers(program, y, mu, z, at)
    if better is not None:
        bound = _evaluate_bound(_compute_terms(program, *better), program)
    if bound == -np.inf and not program.q.any() and program.blocks is None:
        slope = _compute_terms(program, y, mu, z, at).slope
        is_beyond = np.isinf(program.lower) & (slope > program.weights) | np.isinf(program.upper) & (
            slope < -program.weights
        )
        return _shrink_multipliers(program, y, mu, z, at, is_beyond)
    return (bound, y, mu, z) if better is None else (bound, *better[:3])


@shaped
def farkas_bound(
    program: FiniteProgram, y: Float[Array, " r"], mu: Float[Array, " e"], z: Float[Array, " k"] | None = None
) -> float:
    """Return a lower bound of the infeasibility of the rows, after normalising
    ``sum_i y_i |G_i| + sum_i |mu_i| |A_i| = 1``.

    Positive proves that no ``x`` within the bounds meets the rows (Farkas); the number bounds from below how far, in
    the unit-norm scaling of `FiniteSolution.infeasibility`, they must be relaxed. An allowance for rounding is
    subtracted; the caller compares the bound with what `FiniteProgram.residual` forgives (`farkas_margin`).
    """
    return farkas_margin(program, y, mu, z)[0]


@shaped
def farkas_margin(
    program: FiniteProgram, y: Float[Array, " r"], mu: Float[Array, " e"], z: Float[Array, " k"] | None = None
) -> tuple[float, float]:
    """Return the `farkas_bound`, and the magnitude of the terms that cancelled in its constant."""
    y = _clip_multipliers(program, y)
    total = float(y @ np.linalg.norm(program.G, axis=1) + np.abs(mu) @ np.linalg.norm(program.A, axis=1))
    if not (np.isfinite(total) and total > 0):
        return -np.inf, 0.0
    y, mu, z = y / total, mu / total, None if z is None else z / total
    flat = remove_cost(program)
    terms = _compute_terms(flat, y, mu, z, None)
    bound = _evaluate_bound(terms, flat)
    if bound == -np.inf and (better := repair_multipliers(flat, y, mu, z, None)) is not None:
        terms = _compute_terms(flat, *better)
        bound = _evaluate_bound(terms, flat)
    return bound, terms.magnitude


def farkas_proof(program: FiniteProgram, y: Array, mu: Array, z: Array | None, tolerance: float) -> float | None:
    """Return the `farkas_bound` of multipliers where it is positive by more than a ``tolerance`` of the terms that
    cancelled in it, and of 1: then they prove that nothing is feasible; ``None`` where they do not."""
    bound, magnitude = farkas_margin(program, y, mu, z)
    return bound if bound > tolerance * max(1.0, magnitude) else None


def remove_cost(program: FiniteProgram) -> FiniteProgram:
    """Return the program with the same constraints and no cost."""
    q, weights = np.zeros_like(program.q), np.zeros_like(program.weights)
    return FiniteProgram(
        q, weights, program.lower, program.upper, program.G, program.h, program.A, program.b, S=program.S
    )


@shaped
def measure(
    program: FiniteProgram,
    x: Float[Array, " n"],
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None = None,
    message: str = "",
) -> FiniteSolution:
    """Return a claim with its value, residual, lower bound and gap, computed here, as a `FiniteSolution`.

    The decision is first moved into its bounds and onto the equalities. Multipliers that are negative, or of rows
    without a finite right-hand side, become 0. The lower bound may be that of multipliers that were moved further,
    which are not returned: see `bound_with_multipliers`. The status is ``failed``, since the solution is not judged
    yet.

    Parameters
    ----------
    program : FiniteProgram
        The program that the claim is about.
    x : array, (n,)
        Decision.
    y : array, (r,)
        Multipliers of the rows.
    mu : array, (e,)
        Multipliers of the equalities.
    z : array, (k,), optional
        Multipliers of the image; derived from the other multipliers where they are not given.
    message : str
        Words of the solver.
    """
    x = move_within_bounds(program, x)
    x = project_onto_equalities(program, x) if program.b.size else x
    y = _clip_multipliers(program, y)
    value, residual = program.objective(x), program.residual(x)
    terms = _compute_terms(program, y, mu, z, x)
    lower = _prove_bound(program, terms, y, mu, z, x)[0]
    if z is None:
        z = -terms.slope if terms.curvature is None else -(terms.slope + terms.curvature * x)
    return FiniteSolution("failed", x, value, lower, y, mu, z, residual, value - lower, message)


@shaped
def minimisers(
    weights: Float[Array, " k"],
    curvature: Float[Array, " k"] | None,
    slope: Float[Array, " k"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
) -> Float[Array, " k"]:
    """Return the minimiser of ``weights |s| + 1/2 curvature s^2 + slope s`` over ``[lower, upper]``, entry by entry;
    may be infinite."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return bent_minimisers(weights, 0.0 if curvature is None else curvature, slope, lower, upper)


def bent_minimisers(weights: Array, curvature: Array | float, slope: Array, lower: Array, upper: Array) -> Array:
    """Return `minimisers`, which may warn of a division by a curvature of 0."""
    pull = -slope - np.minimum(np.maximum(-slope, -weights), weights)
    free = np.where(pull == 0, 0.0, pull / curvature)
    return np.asarray(np.minimum(np.maximum(free, lower), upper))


@shaped
def _clip_multipliers(program: FiniteProgram, y: Float[Array, " r"]) -> Float[Array, " r"]:
    return np.where(np.isfinite(program.h) & np.isfinite(y), np.maximum(y, 0.0), 0.0)


@shaped
def _compute_terms(
    program: FiniteProgram,
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None,
    at: Float[Array, " n"] | None,
) -> Terms:
    finite = np.where(y > 0, program.h, 0.0)
    constant = program.constant - float(_weigh_rows(y, finite, mu, program.b))
    magnitude = float(_weigh_rows(y, np.abs(finite), np.abs(mu), np.abs(program.b))) + abs(program.constant)
    image = None if at is None or program.blocks is None else program.image(at)
    noise = np.abs(program.q) + _weigh_rows(y, np.abs(program.G), np.abs(mu), np.abs(program.A))
    curvature = program.curvature if program.S is None else None
    slope = program.q + _weigh_rows(y, program.G, mu, program.A)
    if curvature is None and program.P is not None:
        at = np.zeros(program.n) if at is None else at
        gradient, sizes, square, square_size = tangent_terms(program.P, at)
        constant, magnitude = constant - square, magnitude + square_size
        slope, noise = slope + gradient, noise + sizes
    if program.P is None:
        curvature = None
    round_off = bound_rounding(_count_terms(program, y))
    if program.S is None:
        return Terms(constant, slope, noise, program.weights, curvature, magnitude, image, round_off)
    start = np.zeros(program.weights.size) if z is None else z
    z = project_onto_stationary(program, start, slope)
    noise = np.abs(z) + noise.max(initial=0.0)
    return Terms(constant, -z, noise, program.weights, None, magnitude, image, round_off)


def tangent_terms(P: csc_array, at: Array) -> tuple[Array, Array, float, float]:
    """Return what the tangent of ``1/2 x'P x`` at a point ``at (n,)`` adds: ``P at`` to the slope, and
    ``1/2 at'P at``, which is subtracted from the constant. After each comes what may cancel in it, and rounds."""
    gradient, sizes = np.asarray(P @ at), np.asarray(abs(P) @ np.abs(at))
    return gradient, sizes, 0.5 * add_pairwise(at * gradient), 0.5 * float(np.abs(at) @ sizes)


def bound_rounding(count: int) -> float:
    """Return the allowance for the rounding of a sum of ``count`` terms, relative to the sum of their absolute values.

    A chain of ``n`` roundings errs by at most ``n u / (1 - n u)`` (Higham 2002, section 3.1). Twice ``n u`` is allowed,
    which pays for the rounding of the absolute values too.
    """
    return max(ROUND_OFF, (count + SPARE_ROUNDINGS) * EPSILON)


def _count_terms(program: FiniteProgram, y: Array) -> int:
    """Return the largest number of terms that are added up one after the other in a bound by multipliers ``y (r,)``.

    A slope has a term for each positive multiplier and each equality, and what ``P``, or the image, adds to it. The
    number of entries counts by its logarithm only (`add_pairwise`).
    """
    longest = sum(int(np.diff(term.indptr).max(initial=0)) for term in (program.P, program.S) if term is not None)
    pairs = max(program.n, program.weights.size).bit_length()
    return int(np.count_nonzero(y)) + program.b.size + longest + pairs


def add_pairwise(values: Array) -> float:
    """Return the sum of ``values (k,)``, to which each value adds the rounding of at most ``log2 k + 1`` additions."""
    while values.size > 1:
        half = values.size // 2
        values = np.append(values[:half] + values[half : 2 * half], values[2 * half :])
    return float(values.sum())


def _weigh_rows(y: Array, rows: Array, mu: Array, equalities: Array) -> Array:
    """Return ``y'rows + mu'equalities``."""
    return np.asarray(y @ rows + mu @ equalities if mu.size else y @ rows)


def replace_norms(terms: Terms, program: FiniteProgram) -> Terms:
    """Replace every block's ``weight |s|`` by ``d's`` for the ``|d| <= weight`` that bounds more: that nearest to what
    the slope asks for, or that of the tangent at an image."""
    blocks = program.blocks
    if blocks is None or not np.isfinite(terms.slope).all():
        return terms
    entries, of = blocks.entries, blocks.of
    weights = terms.weights[blocks.first] * (1.0 - bound_rounding(blocks.table.shape[1]))
    number, norms = np.maximum(blocks.number, 0), blocks.norms(terms.slope)
    offers = [-terms.slope * np.minimum(1.0, weights / np.where(norms > 0.0, norms, 1.0))[number]]
    if terms.at is not None:
        offers.append(blocks.directions(terms.at) * weights[number])
    bounds, slopes = [], []
    low, high = program.lower[entries], program.upper[entries]
    for offer in offers:
        slope = (terms.slope + offer)[entries]
        with np.errstate(invalid="ignore"):
            least = np.where(slope > 0.0, slope * low, np.where(slope < 0.0, slope * high, 0.0))
        bounds.append(np.bincount(of, np.maximum(least, -INFINITE_BOUND), blocks.first.size))
        slopes.append(slope)
    best = np.argmax(bounds, axis=0)[of]
    slope, weights, noise = terms.slope.copy(), terms.weights.copy(), terms.noise.copy()
    slope[entries] = np.choose(best, slopes)
    weights[entries] = 0.0
    noise[entries] += terms.weights[entries]
    return replace(terms, slope=slope, weights=weights, noise=noise)


def _evaluate_bound(terms: Terms, program: FiniteProgram) -> float:
    terms = replace_norms(terms, program)
    slope = terms.slope
    if not (isfinite(terms.constant) and np.isfinite(slope).all()):
        return -np.inf
    s = minimisers(terms.weights, terms.curvature, slope, program.lower, program.upper)
    away = None if program.bounded else ~np.isfinite(s)
    if away is not None and away.any():
        if (np.abs(slope[away]) - terms.weights[away] > 10 * ROUND_OFF * terms.noise[away]).any():
            return -np.inf
        s = np.where(away, np.clip(0.0, program.lower, program.upper), s)
    values = terms.weights * np.abs(s) + slope * s
    size = terms.magnitude + float(np.abs(s) @ (terms.noise + terms.weights))
    if terms.curvature is not None:
        squares = 0.5 * terms.curvature * s * s
        values, size = values + squares, size + float(squares.sum())
    return terms.constant + add_pairwise(values) - terms.round_off * size


def _find_overshoot(terms: Terms, program: FiniteProgram, bound: float) -> Bool[np.ndarray, " k"] | None:
    """Return a mask of the entries whose slope is beyond their weight by a little, `SLOPE_LIMIT_DISTANCE` of it, where
    that costs a notable share of the bound because their bounds are far away. ``None`` where there is none, or where
    shrinking the multipliers is no way out (`_shrink_multipliers`)."""
    if program.q.any() or program.P is not None or program.blocks is not None or not isfinite(bound):
        return None
    excess = np.abs(terms.slope) - terms.weights
    if not excess.max(initial=0.0) > 0.0:
        return None
    near = (excess > 0.0) & (excess <= SLOPE_LIMIT_DISTANCE * terms.weights)
    reach = np.where(terms.slope > 0.0, -program.lower, program.upper)[near]
    loss = float(excess[near] @ np.maximum(reach, 0.0)) if near.any() else 0.0
    return near if loss > MORE_DIGITS_ERROR * abs(bound) else None


@shaped
def _shrink_multipliers(
    program: FiniteProgram,
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None,
    at: Float[Array, " n"] | None,
    beyond: Bool[np.ndarray, " k"],
) -> tuple[float, Float[Array, " r"], Float[Array, " e"], Float[Array, " k"] | None]:
    """Return the result of `bound_with_multipliers` with multipliers scaled towards 0, for a program without a linear
    cost. They are scaled until the slope of every entry ``beyond`` its weight is within it. Such entries have no bound,
    or one so far away that rounding of the slope costs more than the scaling."""
    slope = _compute_terms(program, y, mu, z, at).slope
    with np.errstate(invalid="ignore"):
        factor = float((program.weights[beyond] / np.abs(slope[beyond])).min(initial=1.0)) * (1 - ROUND_OFF)
    factor = factor if np.isfinite(factor) and np.isfinite(slope).all() else 0.0
    y, mu = factor * y, factor * mu
    z, at = (None if v is None else factor * v for v in (z, at))
    return _evaluate_bound(_compute_terms(program, y, mu, z, at), program), y, mu, z


@shaped
def repair_multipliers(
    program: FiniteProgram,
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None,
    at: Float[Array, " n"] | None,
) -> Multipliers | None:
    """Return ``(y, mu, z, at)`` after the least-norm correction that gives every unbounded entry the slope that it
    needs, or ``None``.

    Only positive ``y``, ``mu``, the point ``at`` of the tangent to ``P``, and the ``z`` of bounded images are moved.
    """
    better: Multipliers | None = (y, mu, z, at)
    for _ in range(MAX_REPAIRS):
        if better is None or not all(np.isfinite(v).all() for v in better if v is not None):
            return None
        better = _correct_multipliers(program, *better)
        if better is not None and (better[0] >= 0).all():
            return better
        better = None if better is None else (np.maximum(better[0], 0.0), *better[1:])
    return better


@shaped
def _correct_multipliers(
    program: FiniteProgram,
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None,
    at: Float[Array, " n"] | None,
) -> Multipliers | None:
    tangent = None
    if program.P is not None and (program.S is not None or program.curvature is None):
        tangent = program.P.toarray()
        at = np.zeros(program.n) if at is None else at
    slope = program.q + y @ program.G + mu @ program.A + (0.0 if tangent is None else tangent @ at)
    used = y > 0
    blocks = [program.G[used].T, program.A.T, np.zeros((program.n, 0)) if tangent is None else tangent]
    if program.S is None:
        tight = _is_at_limit(program, -slope) & (tangent is not None or program.curvature == 0)
        target = np.sign(slope[tight]) * program.weights[tight] - slope[tight]
        corrections = _solve_least_norm([block[tight] for block in blocks], target)
    else:
        z = np.zeros(program.weights.size) if z is None else z.copy()
        tight = _is_at_limit(program, z)
        z[tight] = np.sign(z[tight]) * program.weights[tight]
        corrections = _solve_least_norm(
            [*blocks, program.S[np.flatnonzero(~tight)].toarray().T], -(program.S.T @ z + slope)
        )
        z[~tight] += 0.0 if corrections is None else corrections[3]
    if corrections is None:
        return None
    better = y.copy()
    better[used] += corrections[0]
    return better, mu + corrections[1], z, at if tangent is None or at is None else at + corrections[2]


@shaped
def _is_at_limit(program: FiniteProgram, z: Float[Array, " k"]) -> Bool[np.ndarray, " k"]:
    """Return unbounded images whose multiplier is at its limit, the weight, or beyond."""
    near = np.abs(z) > program.weights - SLOPE_LIMIT_DISTANCE * (1.0 + program.weights)
    return near & (np.isposinf(program.upper) & (z >= 0) | np.isneginf(program.lower) & (z <= 0))


def _solve_least_norm(blocks: list[Array], target: Array) -> list[Array] | None:
    columns = np.hstack(blocks)
    if not columns.size:
        return None
    change = np.asarray(np.linalg.lstsq(columns, target, rcond=1e-12)[0], dtype=float)
    change += np.linalg.lstsq(columns, target - columns @ change, rcond=1e-12)[0]
    ends = list(accumulate(block.shape[1] for block in blocks))
    return [change[stop - block.shape[1] : stop] for block, stop in zip(blocks, ends, strict=True)]


def balance_rows(rows: Array, equalities: Array, cost: Array) -> tuple[Array, Array, float] | None:
    """Return positive multipliers ``(r,)`` of rows, any of equalities ``(e,)``, and a factor of the cost that is not
    negative, with which the sum of all is 0.

    They exist where the rows bound the entries of cheap decisions (Stiemke 1915). The multipliers are about 1. ``None``
    stands for rows without such a sum.

    Parameters
    ----------
    rows : array (r, n)
        The rows.
    equalities : array (e, n)
        The equalities.
    cost : array (n,)
        Slopes of the cost; zeros where it does not count.
    """
    from scipy.optimize import linprog

    (count, n), free = rows.shape, len(equalities)
    solution = linprog(
        np.concatenate([np.zeros(count + free + 1), [-1.0]]),
        A_ub=np.vstack(
            [
                np.hstack([-np.eye(count), np.zeros((count, free + 1)), np.ones((count, 1))]),
                np.concatenate([np.ones(count), np.zeros(free + 2)])[None],
            ]
        ),
        b_ub=np.concatenate([np.zeros(count), [float(count)]]),
        A_eq=np.hstack([rows.T, equalities.T, cost[:, None], np.zeros((n, 1))]),
        b_eq=np.zeros(n),
        bounds=[(0.0, None)] * count + [(None, None)] * free + [(0.0, None), (0.0, 1.0)],
        method="highs",
    )
    if solution.status != 0 or not solution.x[-1] > 0.0:
        return None
    return solution.x[:count], solution.x[count:-2], float(solution.x[-2])


@shaped
def vertex_multipliers(
    program: FiniteProgram, x: Float[Array, " n"], y: Float[Array, " r"], mu: Float[Array, " e"]
) -> tuple[Float[Array, " r"], Float[Array, " e"]]:
    """Return ``(y, mu)`` that make the linearised cost stationary in the free entries of ``x (n,)``, in the
    least-squares sense, with ``y >= 0``.

    The multipliers ``y (r,)``, ``mu (e,)`` of a regularised program differ from those of the plain one by the slope of
    the regulariser; at an exactly regularised optimiser these are the plain ones (Friedlander and Tseng 2007, section
    2). Any answer is safe: weak duality decides what it is worth. ``S`` must be the identity and ``P`` absent,
    otherwise the multipliers come back unchanged.
    """
    tight = program.h - program.G @ x <= ACTIVE_ROW_SLACK * np.maximum(1.0, np.abs(program.h))
    active = np.flatnonzero((y > ACTIVE * y.max(initial=0.0)) | tight)
    if program.S is not None or program.P is not None or not active.size + mu.size:
        return y, mu
    width = np.where(np.isfinite(program.upper - program.lower), program.upper - program.lower, 1.0)
    size, sign = np.abs(x), np.sign(x)
    if program.blocks is not None:
        entries = program.blocks.entries
        size[entries] = program.blocks.norms(x)[program.blocks.of]
        sign[entries] = program.blocks.directions(x)[entries]
    kink = np.where(program.weights > 0.0, size, np.inf)
    away = np.minimum(kink, np.minimum(x - program.lower, program.upper - x))
    free = away > FREE * width
    rows, equalities = program.G[active][:, free].T, program.A[:, free].T
    slope = -program.q[free] - program.weights[free] * sign[free]
    multipliers = _solve_least_norm([rows, equalities], slope)
    if multipliers is None or multipliers[0].min(initial=0.0) < -ACTIVE * multipliers[0].max(initial=0.0):
        from scipy.optimize import nnls  # only here: its import takes as long as a small run

        try:
            positive, _ = nnls(np.hstack([rows, equalities, -equalities]), slope)
        except RuntimeError:  # its iteration limit: these multipliers were an offer only
            return y, mu
        first, second, third = np.split(positive, [active.size, active.size + mu.size])
        multipliers = [first, second - third]
    plain = np.zeros_like(y)
    plain[active] = np.maximum(multipliers[0], 0.0)
    return plain, multipliers[1]
