"""Conversion of an L1-quadratic program to the plain quadratic program that a solver accepts, and of its answer
back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Blocks, Directions, FiniteProgram
from sparserob_core.sip.inner.image import Memory
from sparserob_core.sip.solver import Claim, QuadraticProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

Form: TypeAlias = Literal["split", "epigraph", "cones"]
Recovered: TypeAlias = tuple[Array, Array, Array, Array | None]


@dataclass(frozen=True, eq=False)
class ImageModel:
    """The image as ``s = T v + offset`` of variables ``lower <= v <= upper`` with cost ``cost'v`` and rows
    ``R v <= right``; in each of ``cones`` the first variable is at least the norm of the others.

    Column ``j`` of ``T`` has the single entry ``sign[j]`` (0 for an epigraph variable) in row ``entry[j]``.
    """

    entry: npt.NDArray[np.intp]
    sign: Array
    offset: Array
    cost: Array
    lower: Array
    upper: Array
    R: csc_array | None
    right: Array
    cones: tuple[np.ndarray, ...] = ()


_models = Memory(16)


def standard_form(
    program: FiniteProgram, form: Form = "split", directions: Directions | None = None
) -> tuple[QuadraticProgram, Callable[[Claim], Recovered]]:
    """Return the program as a `QuadraticProgram`, and the way back from a claim to ``(x, y, mu, z)`` of the program
    (``z`` or ``None``).

    ``split``: weighted images are differences ``a - b`` of non-negative parts. ``epigraph``: they get ``t >= |s|``.
    With ``S`` the identity ``x`` is substituted (a diagonal ``P`` is put on both parts, which are complementary at an
    optimum, so that the split program stays strictly convex); otherwise ``S x = s`` are equality rows. The cost is
    divided by its largest linear coefficient, rows by their norm; rows that hold nothing (zero, or with an infinite
    right-hand side) are left out. Norms of blocks get ``t >= d's`` for the ``directions`` given, in the epigraph form,
    and ``t >= |s|`` itself in the form ``cones``.
    """
    if program.blocks is not None and form == "cones":
        model = _add_cones(_build_epigraph_model(program, program.blocks.number < 0), program, program.blocks)
        return _substitute(program, model) if program.S is None else _lift(program, model)
    if program.blocks is not None and directions is not None:
        model = _add_norms(
            _build_epigraph_model(program, program.blocks.number < 0), program, program.blocks, directions
        )
        return _substitute(program, model) if program.S is None else _lift(program, model)
    sources = (program.weights, program.lower, program.upper)
    model = _models.recall(sources, (form, program.S is None), lambda: _build_model(program, form))
    return _substitute(program, model) if program.S is None else _lift(program, model)


def _build_model(program: FiniteProgram, form: Form) -> ImageModel:
    lower, upper, weights = program.lower, program.upper, program.weights
    if form == "epigraph":
        return _build_epigraph_model(program, np.full(weights.size, True))
    fixed = lower == upper
    offset = np.where(fixed, lower, 0.0)
    is_weighted = ~fixed & (weights > 0)
    above, below = np.flatnonzero(is_weighted & (upper > 0)), np.flatnonzero(is_weighted & (lower < 0))
    plain = np.flatnonzero(~fixed & (weights == 0))
    entry = np.concatenate([above, below, plain])
    sign = np.concatenate([np.ones(above.size), -np.ones(below.size), np.ones(plain.size)])
    floor = np.concatenate([np.maximum(lower[above], 0.0), np.maximum(-upper[below], 0.0), lower[plain]])
    ceiling = np.concatenate([upper[above], -lower[below], upper[plain]])
    return ImageModel(entry, sign, offset, weights[entry], floor, ceiling, None, np.zeros(0))


def _build_epigraph_model(program: FiniteProgram, alone: npt.NDArray[np.bool_]) -> ImageModel:
    """Return the model with ``t >= |s|``; ``alone (k,)``: the entries that count with their absolute values."""
    from scipy.sparse import csc_array

    lower, upper, weights = program.lower, program.upper, np.where(alone, program.weights, 0.0)
    fixed = lower == upper
    offset = np.where(fixed, lower, 0.0)
    has_kink = ~fixed & (weights > 0) & (lower < 0) & (upper > 0)
    plain, kinks = np.flatnonzero(~fixed), np.flatnonzero(has_kink)
    entry = np.concatenate([plain, kinks])
    sign = np.concatenate([np.ones(plain.size), np.zeros(kinks.size)])
    one_signed = np.where(has_kink, 0.0, np.where(program.lower >= 0, weights, -weights))
    cost = np.concatenate([one_signed[plain], weights[kinks]])
    floor = np.concatenate([program.lower[plain], np.zeros(kinks.size)])
    ceiling = np.concatenate([program.upper[plain], np.full(kinks.size, np.inf)])
    if not kinks.size:
        return ImageModel(entry, sign, offset, cost, floor, ceiling, None, np.zeros(0))
    rows, inside, tops = np.arange(kinks.size), np.searchsorted(plain, kinks), plain.size + np.arange(kinks.size)
    data = np.repeat([1.0, -1.0, -1.0, -1.0], kinks.size) / np.sqrt(2.0)
    places = (
        np.concatenate([rows, rows, rows + kinks.size, rows + kinks.size]),
        np.concatenate([inside, tops, inside, tops]),
    )
    R = csc_array((data, places), shape=(2 * kinks.size, entry.size))
    return ImageModel(entry, sign, offset, cost, floor, ceiling, R, np.zeros(2 * kinks.size))


def _add_norms(model: ImageModel, program: FiniteProgram, blocks: Blocks, directions: Directions) -> ImageModel:
    """Return the model with one variable ``t`` for every block, which costs the block's weight, and rows
    ``d's <= t``."""
    from scipy.sparse import csc_array, vstack

    model = _add_block_bounds(model, program, blocks)
    size, tops, of = directions.block.size, model.entry.size - blocks.first.size, _number_variables(model, program)
    entries = blocks.table[directions.block]
    inside = (entries >= 0) & (directions.vectors != 0.0)
    moving = inside & (of[entries] >= 0)
    row = np.broadcast_to(np.arange(size)[:, None], entries.shape)
    places = (
        np.concatenate([row[moving], np.arange(size)]),
        np.concatenate([of[entries[moving]], tops + directions.block]),
    )
    data = np.concatenate([directions.vectors[moving], -np.ones(size)]) / np.sqrt(2.0)
    rows = csc_array((data, places), shape=(size, model.entry.size))
    fixed = np.where(inside, directions.vectors * model.offset[entries], 0.0).sum(axis=1)
    if model.R is not None:
        rows = vstack([model.R, rows], format="csc")
    return replace(model, R=rows, right=np.concatenate([model.right, -fixed / np.sqrt(2.0)]))


def _add_cones(model: ImageModel, program: FiniteProgram, blocks: Blocks) -> ImageModel:
    """Return the model with one variable for every block, which costs the block's weight and is at least its norm. An
    entry that is fixed is fixed at 0 (`has_cones`), and is in no cone."""
    model, tops = _add_block_bounds(model, program, blocks), model.entry.size
    places = _number_variables(model, program)[blocks.table]
    return replace(
        model,
        cones=tuple(np.concatenate([[tops + b], variables[variables >= 0]]) for b, variables in enumerate(places)),
    )


def _add_block_bounds(model: ImageModel, program: FiniteProgram, blocks: Blocks) -> ImageModel:
    """Return the model with one variable more for every block, at least 0, which costs the block's weight."""
    from scipy.sparse import csc_array, hstack

    count = blocks.first.size
    return replace(
        model,
        entry=np.concatenate([model.entry, blocks.first]),
        sign=np.concatenate([model.sign, np.zeros(count)]),
        cost=np.concatenate([model.cost, program.weights[blocks.first]]),
        lower=np.concatenate([model.lower, np.zeros(count)]),
        upper=np.concatenate([model.upper, np.full(count, np.inf)]),
        R=None if model.R is None else csc_array(hstack([model.R, csc_array((model.R.shape[0], count))])),
    )


def _number_variables(model: ImageModel, program: FiniteProgram) -> np.ndarray:
    """Return the number of the variable of every entry of the image, ``(k + 1,)``; -1 for an entry that is fixed.

    The array has one more value at its end, which is -1: the index -1, which stands for no entry, finds it.
    """
    places = np.full(program.weights.size + 1, -1)
    places[model.entry[model.sign > 0]] = np.flatnonzero(model.sign > 0)
    return places


def has_cones(program: FiniteProgram, blocks: Blocks) -> bool:
    """Return whether the program has a `standard_form` with ``cones``: no entry of a block is fixed at a value other
    than 0."""
    lower, upper = program.lower[blocks.entries], program.upper[blocks.entries]
    return not ((lower == upper) & (lower != 0.0)).any()


def _substitute(program: FiniteProgram, model: ImageModel) -> tuple[QuadraticProgram, Callable[[Claim], Recovered]]:
    """Return the program in the variables ``v`` alone, with ``x = T v + offset``."""
    from scipy.sparse import csc_array

    curvature = program.curvature
    q = program.q
    if program.P is not None and curvature is None:
        q = q + program.P @ model.offset
    cost = model.cost + model.sign * q[model.entry]
    kappa = _find_largest(cost) or _find_largest(curvature) or 1.0
    if curvature is not None:
        P = _build_diagonal(np.abs(model.sign) * curvature[model.entry] / kappa)
    else:
        T = csc_array((model.sign, (model.entry, np.arange(model.entry.size))), shape=(program.n, model.entry.size))
        P = csc_array(T.T @ program.P @ T) / kappa
    rows, h, keep, norms = _normalise_rows(program.G, program.h, model)
    equal, b, keep_equal, norms_equal = _normalise_rows(program.A, program.b, model)
    G = _stack_rows(rows, model.R)
    right = np.concatenate([h, model.right])
    qp = QuadraticProgram(P, cost / kappa, G, right, _stack_rows(equal, None), b, model.lower, model.upper, model.cones)

    def recover(claim: Claim) -> Recovered:
        x = model.offset + np.bincount(model.entry, model.sign * claim.x, program.n)
        y, mu = np.zeros(program.h.size), np.zeros(program.b.size)
        y[keep] = claim.z[: h.size] * (kappa / norms)
        mu[keep_equal] = claim.y * (kappa / norms_equal)
        return x, y, mu, None

    return qp, recover


def _lift(program: FiniteProgram, model: ImageModel) -> tuple[QuadraticProgram, Callable[[Claim], Recovered]]:
    """Return the program in the variables ``(x, v)``, with equality rows ``S x - T v = offset`` for every image that
    has a weight or a bound."""
    from scipy.sparse import block_diag, csc_array, hstack, vstack

    n, size, k = program.n, model.entry.size, program.weights.size
    images = np.flatnonzero((program.weights > 0) | np.isfinite(program.lower) | np.isfinite(program.upper))
    T = csc_array((model.sign, (model.entry, np.arange(size))), shape=(k, size))
    link = hstack([program.S, -T], format="csr")[images]
    free = np.full(n, np.inf)
    identity = ImageModel(np.arange(n), np.ones(n), np.zeros(n), program.q, -free, free, None, np.zeros(0))
    rows, h, keep, norms = _normalise_rows(program.G, program.h, identity)
    equal, b, keep_equal, norms_equal = _normalise_rows(program.A, program.b, identity)
    cost = np.concatenate([program.q, model.cost])
    kappa = _find_largest(cost) or _find_largest(None if program.P is None else program.P.data) or 1.0
    P = csc_array((n, n)) if program.P is None else program.P / kappa
    P = block_diag([P, csc_array((size, size))], format="csc")
    pad = csc_array((rows.shape[0], size))
    G = hstack([csc_array(rows), pad], format="csc")
    if model.R is not None:
        G = vstack([G, hstack([csc_array((model.R.shape[0], n)), model.R])], format="csc")
    A = vstack([hstack([csc_array(equal), csc_array((equal.shape[0], size))]), link], format="csc")
    right = np.concatenate([h, model.right])
    qp = QuadraticProgram(
        P,
        cost / kappa,
        G,
        right,
        A,
        np.concatenate([b, model.offset[images]]),
        np.concatenate([-free, model.lower]),
        np.concatenate([free, model.upper]),
        tuple(n + cone for cone in model.cones),
    )

    def recover(claim: Claim) -> Recovered:
        y, mu, z = np.zeros(program.h.size), np.zeros(program.b.size), np.zeros(k)
        y[keep] = claim.z[: h.size] * (kappa / norms)
        mu[keep_equal] = claim.y[: b.size] * (kappa / norms_equal)
        z[images] = claim.y[b.size :] * kappa
        return claim.x[:n], y, mu, z

    return qp, recover


@shaped
def _normalise_rows(
    rows: Float[Array, "r n"], rhs: Float[Array, " r"], model: ImageModel
) -> tuple[Float[Array, "p v"], Float[Array, " p"], Int[np.ndarray, " p"], Float[Array, " p"]]:
    """Return rows over ``v`` and right-hand sides, divided by the norm of the row; which rows were kept, and their
    norms."""
    limits = rhs - rows @ model.offset
    block = rows[:, model.entry] * model.sign
    norms = np.sqrt(np.einsum("ij,ij->i", block, block))
    keep = np.flatnonzero((norms > 0) & np.isfinite(limits))
    norms = norms[keep]
    return block[keep] / norms[:, None], limits[keep] / norms, keep, norms


def _stack_rows(rows: Array, below: csc_array | None) -> csc_array:
    from scipy.sparse import csc_array, vstack

    across = rows.T
    filled = across != 0
    pointers = np.concatenate([[0], np.cumsum(filled.sum(axis=1))])
    top = csc_array((across[filled], np.nonzero(filled)[1], pointers), shape=rows.shape)
    return top if below is None else vstack([top, below], format="csc")


def _build_diagonal(values: Array) -> csc_array:
    from scipy.sparse import csc_array

    places = np.flatnonzero(values)
    pointers = np.concatenate([[0], np.cumsum(values != 0)])
    return csc_array((values[places], places, pointers), shape=(values.size, values.size))


def _find_largest(values: Array | None) -> float:
    return 0.0 if values is None else float(np.abs(values).max(initial=0.0))
