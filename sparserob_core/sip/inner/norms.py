"""Directions that stand for the norms of blocks: ``|s|`` is the largest of ``d's`` over the unit vectors ``d``."""

from __future__ import annotations

from itertools import product

import numpy as np

from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Blocks, Directions, FiniteProgram
from sparserob_core.sip.inner.image import onto_stationary

FAN = 16  # directions of a block of two entries, to begin with
CORNERS = 4  # entries of a block up to which the corners of a cube are looked at too
NOTHING = 1e-14  # of the largest norm: a block that has no direction


def around(blocks: Blocks) -> Directions:
    """Directions all round for every block, to begin with."""
    width = blocks.table.shape[1]
    sizes = (blocks.table >= 0).sum(axis=1)
    found = [Directions(np.zeros(0, dtype=int), np.zeros((0, width)))]
    for size in np.unique(sizes).tolist():
        vectors = np.hstack([_around(size), np.zeros((len(_around(size)), width - size))])
        which = np.flatnonzero(sizes == size)
        found.append(Directions(np.repeat(which, len(vectors)), np.tile(vectors, (which.size, 1))))
    return Directions(np.concatenate([one.block for one in found]), np.vstack([one.vectors for one in found]))


def _around(size: int) -> Array:
    if size == 2:
        angles = 2.0 * np.pi * np.arange(FAN) / FAN
        return np.column_stack([np.cos(angles), np.sin(angles)])
    axes = np.eye(size)
    if size > CORNERS or size == 1:
        return np.vstack([axes, -axes])
    corners = np.array(list(product((-1.0, 1.0), repeat=size))) / np.sqrt(size)
    return np.vstack([axes, -axes, corners])


@shaped
def towards(
    program: FiniteProgram,
    blocks: Blocks,
    x: Float[Array, " n"],
    y: Float[Array, " r"],
    mu: Float[Array, " e"],
    z: Float[Array, " k"] | None,
) -> Directions:
    """The directions of the blocks of ``S x``, and those that the multipliers of the rows ask for."""
    slope = program.q + y @ program.G + mu @ program.A
    slope = slope if program.P is None else slope + program.P @ x
    asked = -slope
    if program.S is not None:
        asked = onto_stationary(program, np.zeros(program.weights.size) if z is None else z, slope)
    found = [_unit(blocks, vector) for vector in (program.image(x), asked) if np.isfinite(vector).all()]
    return Directions(np.concatenate([one.block for one in found]), np.vstack([one.vectors for one in found]))


def _unit(blocks: Blocks, image: Array) -> Directions:
    norms = blocks.norms(image)
    kept = np.flatnonzero(norms > NOTHING * norms.max(initial=0.0))
    table = blocks.table[kept]
    vectors = np.where(table >= 0, blocks.directions(image)[table], 0.0)
    return Directions(kept, vectors)
