"""Replacements for the norms of blocks: directions, since ``|s|`` is the largest of ``d's`` over the unit vectors
``d``, and second-order expansions where a block is not 0."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np

from sparserob_core.shapes import Bool, Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Blocks, Directions, FiniteProgram
from sparserob_core.sip.inner.image import project_onto_stationary

FAN = 8  # directions of a block of two entries, to begin with
MAX_CUBE_ENTRIES = 4  # entries of a block up to which the corners of a cube are looked at too
BLOCK_DIRECTIONS_KEPT = 6  # directions of a block, those nearest to what an answer asks for, that are worth keeping
NEGLIGIBLE_NORM = 1e-14  # of the largest norm: a block that has no direction


def spread_directions(blocks: Blocks) -> Directions:
    """Return directions all round for every block, to begin with."""
    width = blocks.table.shape[1]
    sizes = (blocks.table >= 0).sum(axis=1)
    groups = [Directions(np.zeros(0, dtype=int), np.zeros((0, width)))]
    for size in np.unique(sizes).tolist():
        vectors = np.hstack([_list_unit_vectors(size), np.zeros((len(_list_unit_vectors(size)), width - size))])
        numbers = np.flatnonzero(sizes == size)
        groups.append(Directions(np.repeat(numbers, len(vectors)), np.tile(vectors, (numbers.size, 1))))
    return Directions(np.concatenate([group.block for group in groups]), np.vstack([group.vectors for group in groups]))


def _list_unit_vectors(size: int) -> Array:
    if size == 2:
        angles = 2.0 * np.pi * np.arange(FAN) / FAN
        return np.column_stack([np.cos(angles), np.sin(angles)])
    axes = np.eye(size)
    if size > MAX_CUBE_ENTRIES or size == 1:
        return np.vstack([axes, -axes])
    corners = np.array(list(product((-1.0, 1.0), repeat=size))) / np.sqrt(size)
    return np.vstack([axes, -axes, corners])


@shaped
def find_block_directions(
    program: FiniteProgram,
    blocks: Blocks,
    x: Float[Array, " n"],
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None,
) -> Directions:
    """Return the directions of the blocks of ``S x``, and those that the multipliers of the rows ask for."""
    slope = program.q + y @ program.G + mu @ program.A
    slope = slope if program.P is None else slope + program.P @ x
    wanted = -slope
    if program.S is not None:
        wanted = project_onto_stationary(program, np.zeros(program.weights.size) if z is None else z, slope)
    groups = [_find_directions(blocks, vector) for vector in (program.image(x), wanted) if np.isfinite(vector).all()]
    return Directions(np.concatenate([group.block for group in groups]), np.vstack([group.vectors for group in groups]))


def select_nearest_directions(directions: Directions, wanted: Directions) -> Directions:
    """Return, for every block, the at most `BLOCK_DIRECTIONS_KEPT` directions that are nearest to one of its ``wanted``
    directions."""
    kept = []
    for block in np.unique(wanted.block):
        candidates = np.flatnonzero(directions.block == block)
        targets = wanted.vectors[wanted.block == block]
        cosines = (directions.vectors[candidates] @ targets.T).max(axis=1, initial=-1.0)
        kept.append(candidates[np.argsort(-cosines, kind="stable")[:BLOCK_DIRECTIONS_KEPT]])
    chosen = np.concatenate([np.zeros(0, dtype=int), *kept])
    return Directions(directions.block[chosen], directions.vectors[chosen])


@shaped
def expand_norms(
    program: FiniteProgram, blocks: Blocks, x: Float[Array, " n"], moving: Bool[np.ndarray, " b"]
) -> FiniteProgram:
    """Return the program with the norm of every ``moving (b,)`` block replaced by its second-order expansion at
    ``x (n,)``: ``weight d's + weight/(2 |s_0|) |s - (d's) d|^2`` with ``d = s_0 / |s_0|``. ``S`` must be the
    identity."""
    from scipy.sparse import csc_array

    of = blocks.of
    entries = blocks.entries[moving[of]]
    d, norms = blocks.directions(x), np.where(moving, blocks.norms(x), 1.0)
    weights, number = program.weights.copy(), blocks.number.copy()
    weights[entries], number[entries] = 0.0, -1
    q = program.q.copy()
    q[entries] += program.weights[entries] * d[entries]
    table = blocks.table[moving]
    curved = (program.weights[blocks.first] / norms)[moving]
    row = np.repeat(table[:, :, None], table.shape[1], axis=2)
    column = row.swapaxes(1, 2)
    across = np.where(row == column, 1.0, 0.0) - d[row] * d[column]
    inside = (row >= 0) & (column >= 0)
    data = (curved[:, None, None] * across)[inside]
    H = csc_array((data, (row[inside], column[inside])), shape=(program.n, program.n))
    P = csc_array(H if program.P is None else program.P + H)
    still = None if moving.all() else Blocks(_renumber(number))
    return replace(program, P=P, q=q, weights=weights, blocks=still)


def _renumber(number: np.ndarray) -> np.ndarray:
    """Return the numbers of the blocks without gaps, counted from 0; entries of no block keep -1."""
    _, numbers = np.unique(number, return_inverse=True)
    answer: np.ndarray = numbers.reshape(-1) - int((number < 0).any())
    return answer


def of_the_rest(directions: Directions, moving: Bool[np.ndarray, " b"], width: int) -> Directions:
    """Return the directions of the blocks that are not ``moving (b,)``, by their numbers among those, of which the
    largest has ``width`` entries."""
    kept = ~moving[directions.block]
    numbers = np.cumsum(~moving) - 1
    return Directions(numbers[directions.block[kept]], directions.vectors[kept, :width])


def _find_directions(blocks: Blocks, image: Array) -> Directions:
    norms = blocks.norms(image)
    kept = np.flatnonzero(norms > NEGLIGIBLE_NORM * norms.max(initial=0.0))
    table = blocks.table[kept]
    vectors = np.where(table >= 0, blocks.directions(image)[table], 0.0)
    return Directions(kept, vectors)
