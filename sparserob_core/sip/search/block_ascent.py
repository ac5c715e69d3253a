"""Ascent of a function whose blocks of coordinates are linear in some of them: vertices there, a search with idle
blocks in the others."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import LinearBlocks, Objective

GAIN = 1e-9  # relative: what a step must gain to count as one
PATIENCE = 12  # steps without a gain at least, before the ascent ends
OCTAVES = 40.0  # halvings of a side from the farthest to the nearest neighbour of a block that acts
GOLDEN = (5.0**0.5 - 1.0) / 2.0


def block_ascent(objective: Objective, start: Array | None = None) -> bool:
    """Climb from ``start (d,)``, or from the best point, of an objective that is linear in blocks (`Objective.linear`)
    until nothing near the blocks that act is a gain; where it is not, or the value there is not finite, do nothing.

    One step is one evaluation. The linear coordinates of every block go to the vertex at which the block weighs most
    (Frank and Wolfe 1956; for the maximum of a convex function, which is at a vertex: Mangasarian 1996). Blocks that do
    not act may be moved without loss: one half of them is placed beside those that act, at distances from half a side
    down to its ``2^-40``, which is a line search in all other coordinates at once; the other half is spread over the
    box, by the additive recurrence of Kronecker, and finds what is not yet known. So no step makes the value less.
    Notes ``acting``, how many blocks act. Returns whether it has climbed to where neighbours were tried and
    none is a gain, which they are not where every block acts; ends by `SearchEnded` when the budget is spent.
    """
    linear = objective.linear
    if linear is None or (start is None and not np.isfinite(objective.best_value)):
        return False
    idle = IdleBlocks(objective.domain, objective.block, linear)
    best, still, tried = objective.best_point if start is None else start, 0, 0.0
    value = float(objective.evaluate(best[np.newaxis])[0])
    if not np.isfinite(value):
        return False
    while still < PATIENCE or tried < 2.0 * OCTAVES:
        acts = linear.acting()
        objective.note(acting=float(acts.sum()))
        trial = linear.steepest(idle.placed(best, acts))
        reached = float(objective.evaluate(trial[np.newaxis])[0])
        gained = reached > value + GAIN * abs(value)
        still, tried = (0, 0.0) if gained else (still + 1, tried + idle.neighbours(acts))
        if reached >= value:
            best, value = trial, reached
        else:  # by rounding only: see the last point's inner solution again
            objective.evaluate(best[np.newaxis])
    return bool(np.isfinite(tried))


class IdleBlocks:
    """Where the blocks of a function are placed that do not act: beside those that do, and spread over the box.

    Parameters
    ----------
    domain : Box
        The box ``(d,)`` of the function.
    block : int
        Coordinates of a block.
    linear : LinearBlocks, optional
        The coordinates that are not placed, since they are linear; none of them without it.
    """

    def __init__(self, domain: Box, block: int, linear: LinearBlocks | None = None) -> None:
        shape = (-1, block)
        self.lower, self.upper = domain.lower.reshape(shape), domain.upper.reshape(shape)
        moves = (self.upper > self.lower)[0]
        self.others = np.flatnonzero(moves if linear is None else moves & ~linear.coordinates.reshape(shape)[0])
        self.faces = linear is None  # half of those that are spread go there: no uniform point is near a vertex
        self.beside, self.spread = 0, 0  # how many of each have been placed
        self.shares = _kronecker(self.others.size)

    def neighbours(self, acts: np.ndarray) -> float:
        """How many neighbours of each block that acts one step tries in each coordinate; ``inf`` where none can be."""
        directions = acts.sum() * self.others.size
        beside = (acts.size - acts.sum() + 1) // 2
        return float(beside / directions) if beside and directions else np.inf

    def placed(self, point: Array, acts: np.ndarray) -> Array:
        """The point with its idle blocks beside those that act, and spread over the box."""
        blocks, lower, upper = point.reshape(self.lower.shape).copy(), self.lower, self.upper
        idle, acting = np.flatnonzero(~acts), np.flatnonzero(acts)
        if not self.others.size:
            return point
        beside = idle[: (idle.size + 1) // 2] if acting.size else idle[:0]
        spread = idle[beside.size :]
        if beside.size:
            number = self.beside + np.arange(beside.size)
            turn, owner = np.divmod(number, acting.size)
            pair, axis = np.divmod(turn, self.others.size)
            octave = 1.0 + (OCTAVES - 1.0) * np.mod(pair * GOLDEN, 1.0)
            blocks[beside], axes = blocks[acting[owner]], self.others[axis]
            blocks[beside, axes] += np.where(pair % 2, 1.0, -1.0) * (upper - lower)[beside, axes] * 2.0**-octave
        number = self.spread + np.arange(spread.size)
        where = np.ix_(spread, self.others)
        shares = np.mod(0.5 + np.outer(number, self.shares), 1.0)
        if self.faces:
            shares[::2] = np.clip(2.0 * shares[::2] - 0.5, 0.0, 1.0)
        blocks[where] = lower[where] + shares * (upper - lower)[where]
        self.beside, self.spread = self.beside + beside.size, self.spread + spread.size
        return np.clip(blocks, lower, upper).ravel()


def _kronecker(dimension: int) -> Array:
    """Shares ``(dimension,)`` whose multiples modulo 1 fill the unit box evenly: powers of the root of
    ``x^(d+1) = x + 1`` (Roberts 2018)."""
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (dimension + 1))
    return np.asarray(root ** -np.arange(1.0, dimension + 1))
