"""Ascent of a function whose blocks of coordinates are linear in some coordinates.

The linear coordinates go to vertices; idle blocks search in the other coordinates.
"""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import LinearBlocks, Objective

GAIN = 1e-9  # relative improvement from which a step counts as a gain
MIN_IDLE_STEPS = 12  # least number of steps without a gain before the ascent ends
OCTAVES = 40.0  # halvings of a side from the farthest to the nearest neighbour of a block that acts
GOLDEN_SECTION = (5.0**0.5 - 1.0) / 2.0


def block_ascent(objective: Objective, start: Array | None = None) -> bool:
    """Climb until no point near the acting blocks improves the objective; the objective must be linear in blocks.

    One step is one evaluation. The linear coordinates of every block go to the vertex at which the block has the
    largest effect (Frank and Wolfe 1956). A convex function has its maximum at a vertex (Mangasarian 1996). Blocks that
    do not act may be moved without loss. Half of them are placed near the acting blocks, at distances from half a side
    down to its ``2^-40``. So one step is a line search in all other coordinates at once. The other half is distributed
    over the box by Kronecker's additive recurrence, and explores the rest. So no step decreases the value. The number
    of acting blocks is noted as ``acting``.

    Parameters
    ----------
    objective : Objective
        The function; nothing is done where its ``linear`` is ``None``.
    start : ndarray, shape (d,), optional
        Starting point; by default the best point. Nothing is done where the value there is not finite.

    Returns
    -------
    bool
        True where the ascent has ended with neighbours tried and no improvement found. False where nothing was done, or
        where no neighbour could be tried, as all blocks act.

    Raises
    ------
    SearchEnded
        Where the budget is spent.
    """
    linear = objective.linear
    if linear is None or (start is None and not np.isfinite(objective.best_value)):
        return False
    idle = IdleBlocks(objective.domain, objective.block, linear)
    best, stalls, tried = objective.best_point if start is None else start, 0, 0.0
    value = float(objective.evaluate(best[np.newaxis])[0])
    if not np.isfinite(value):
        return False
    while stalls < MIN_IDLE_STEPS or tried < 2.0 * OCTAVES:
        acts = linear.acting()
        objective.note(acting=float(acts.sum()))
        trial = linear.steepest(idle.placed(best, acts))
        trial_value = float(objective.evaluate(trial[np.newaxis])[0])
        is_better = trial_value > value + GAIN * abs(value)
        stalls, tried = (0, 0.0) if is_better else (stalls + 1, tried + idle.neighbours(acts))
        if trial_value >= value:
            best, value = trial, trial_value
        else:  # lower by rounding only: restore the inner solution of the last point
            objective.evaluate(best[np.newaxis])
    return bool(np.isfinite(tried))


class IdleBlocks:
    """Positions for the blocks that do not act: near the acting blocks, and distributed over the box.

    Parameters
    ----------
    domain : Box
        Box ``(d,)`` of the function.
    block : int
        Number of coordinates of a block.
    linear : LinearBlocks, optional
        Its linear coordinates are not placed; without it, all coordinates are placed.
    """

    def __init__(self, domain: Box, block: int, linear: LinearBlocks | None = None) -> None:
        shape = (-1, block)
        self.lower, self.upper = domain.lower.reshape(shape), domain.upper.reshape(shape)
        moves = (self.upper > self.lower)[0]
        self.others = np.flatnonzero(moves if linear is None else moves & ~linear.coordinates.reshape(shape)[0])
        self.faces = linear is None  # half of the distributed blocks go there: no uniform point is near a vertex
        self.near_count, self.spread_count = 0, 0  # blocks placed so far near acting blocks, and over the box
        self.shares = _compute_shares(self.others.size)

    def neighbours(self, acts: np.ndarray) -> float:
        """Return the number of neighbours that one step tries for each acting block in each coordinate; ``inf`` where
        none can be."""
        directions = acts.sum() * self.others.size
        near_count = (acts.size - acts.sum() + 1) // 2
        return float(near_count / directions) if near_count and directions else np.inf

    def placed(self, point: Array, acts: np.ndarray) -> Array:
        """Return a point with its idle blocks moved, near the acting blocks and over the box.

        Parameters
        ----------
        point : ndarray, shape (d,)
            The point.
        acts : ndarray of bool, shape (D,)
            True for the blocks that act.

        Returns
        -------
        ndarray, shape (d,)
            The point with the acting blocks unchanged.
        """
        blocks, lower, upper = point.reshape(self.lower.shape).copy(), self.lower, self.upper
        idle, acting = np.flatnonzero(~acts), np.flatnonzero(acts)
        if not self.others.size:
            return point
        near_blocks = idle[: (idle.size + 1) // 2] if acting.size else idle[:0]
        spread_blocks = idle[near_blocks.size :]
        if near_blocks.size:
            number = self.near_count + np.arange(near_blocks.size)
            turn, owner = np.divmod(number, acting.size)
            pair, axis = np.divmod(turn, self.others.size)
            octave = 1.0 + (OCTAVES - 1.0) * np.mod(pair * GOLDEN_SECTION, 1.0)
            blocks[near_blocks], axes = blocks[acting[owner]], self.others[axis]
            blocks[near_blocks, axes] += (
                np.where(pair % 2, 1.0, -1.0) * (upper - lower)[near_blocks, axes] * 2.0**-octave
            )
        number = self.spread_count + np.arange(spread_blocks.size)
        grid = np.ix_(spread_blocks, self.others)
        shares = np.mod(0.5 + np.outer(number, self.shares), 1.0)
        if self.faces:
            shares[::2] = np.clip(2.0 * shares[::2] - 0.5, 0.0, 1.0)
        blocks[grid] = lower[grid] + shares * (upper - lower)[grid]
        self.near_count, self.spread_count = self.near_count + near_blocks.size, self.spread_count + spread_blocks.size
        return np.clip(blocks, lower, upper).ravel()


def _compute_shares(dimension: int) -> Array:
    """Return shares ``(dimension,)`` whose multiples modulo 1 fill the unit box evenly.

    The shares are powers of the root of ``x^(d+1) = x + 1`` (Roberts 2018).
    """
    root = 2.0
    for _ in range(64):
        root = (1.0 + root) ** (1.0 / (dimension + 1))
    return np.asarray(root ** -np.arange(1.0, dimension + 1))
