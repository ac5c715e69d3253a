"""``g`` of a program with uncertain rows over tuples of indices, each with the deviation at which it is imposed, or
with all of them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, TypeAlias, final

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.inner.simplex.counterpart import Counterpart
from sparserob_core.sip.program import SemiInfiniteProgram

Linear: TypeAlias = tuple[Array, Array, np.ndarray]
"""Rows ``G (r, n)``, right-hand sides ``h (r,)``, and which of them ``(r,)`` move with their index."""

LASTING = 10.0
"""Seconds that one value may take, after which it is not known. Ten times as many, and a recording waits minutes for a
map that is worth seconds; a tenth, and policies of some hundred pieces have none."""


@final
class PolicyValue:
    """The least cost where the rows of all families hold at the indices ``slots (D, d + Q)`` of a tuple: at the
    deviation ``(Q,)`` that stands behind the index, or, where that is NaN, at every one.

    A row at one deviation is linear in the decision. Lower bounds are proven by rows at the deviations that their
    multipliers name (`robust_bound`): at such a tuple the value is that bound.
    """

    def __init__(self, program: SemiInfiniteProgram) -> None:
        assert program.spread is not None
        self.program, self.spread = program, program.spread
        self.size = max(family.index_set.dimension for family in program.families)
        # rows that stay where the index moves, and those that only say what the cost is, decide nothing
        self._is_moving = [
            bool(family.index_set.upper[0] > family.index_set.lower[0]) and not family.defines
            for family in program.families
        ]
        self._linear_rows: dict[bytes, Linear] = {}
        self._weights: Array = np.zeros(0)
        self._base: tuple[bytes, Any] = b"", None  # the rows at a deviation of the last tuple, and where they began

    def at(self, slots: Array) -> float:
        """The value; ``inf`` where nothing meets the rows, NaN where the solver failed or takes too long."""
        counterpart = Counterpart(self.program.finite, self.spread)
        plain = [self._fix_deviation(slot) for slot in slots if not np.isnan(slot).any()]
        order = [*np.flatnonzero(~np.isnan(slots).any(axis=1)), *np.flatnonzero(np.isnan(slots).any(axis=1))]
        until = time.monotonic() + LASTING
        moving: list[np.ndarray] = []
        if plain:
            G, h, _ = (np.concatenate(arrays) for arrays in zip(*plain, strict=True))
            counterpart.add(_make_certain_rows(G, h, self.spread.size))
            moving = [moves for _, _, moves in plain]
            self._begin_at_base(counterpart, slots[order[: len(plain)]].tobytes())
        for slot in order[len(plain) :]:
            blocks = self._build_rows(slots[slot])
            for rows in blocks:
                counterpart.add(rows)
            moving.append(self._flag_moving_rows(blocks))
        answer = counterpart.solve(seconds=until - time.monotonic())
        while answer.solved and counterpart.sharpen(answer.x):
            answer = counterpart.solve(seconds=until - time.monotonic())
        if not answer.solved:
            self._weights = np.zeros(len(slots))
            return np.inf if "infeasible" in answer.said.lower() else np.nan
        owner = np.repeat(order, [moves.size for moves in moving])
        weights = np.bincount(owner, answer.y * np.concatenate(moving), len(slots))
        self._weights = np.asarray(weights, dtype=float)
        return self.program.cost(np.clip(answer.x, self.program.finite.lower, self.program.finite.upper))

    def _begin_at_base(self, counterpart: Counterpart, which: bytes) -> None:
        """Begin where rows at a deviation alone are at their optimum: on a map all others are added to the same ones,
        and are few."""
        if which != self._base[0]:
            solved = counterpart.solve(seconds=LASTING).solved
            self._base = which, counterpart.basis if solved else None
        elif self._base[1] is not None:
            counterpart.begin(self._base[1])

    def weights(self) -> Array:
        """The multipliers ``(D,)`` of the rows at every index that move with it, in the last evaluation."""
        return self._weights

    def _flag_moving_rows(self, blocks: Sequence[UncertainRows]) -> np.ndarray:
        """Return a mask ``(r,)`` of the rows of all families that move with their index."""
        return np.concatenate(
            [np.full(rows.h.size, moves) for rows, moves in zip(blocks, self._is_moving, strict=True)]
        )

    def _build_rows(self, slot: Array) -> list[UncertainRows]:
        blocks = []
        for family in self.program.families:
            box = family.index_set
            assert family.uncertain is not None
            blocks.append(family.uncertain(np.clip(slot[: box.dimension], box.lower, box.upper)))
        return blocks

    def _fix_deviation(self, slot: Array) -> Linear:
        key = slot.tobytes()
        if key not in self._linear_rows:
            w, pairs, blocks = slot[self.size :], [], self._build_rows(slot)
            for rows in blocks:
                products = np.stack([w @ C for C in rows.C]) if rows.C else np.zeros((1, self.program.n))
                G = rows.g.toarray() + rows.factor[:, np.newaxis] * products[rows.part]
                pairs.append((G, rows.h - rows.factor * (rows.d @ w)[rows.part]))
            G, h = (np.concatenate(arrays) for arrays in zip(*pairs, strict=True))
            self._linear_rows[key] = G, h, self._flag_moving_rows(blocks)
        return self._linear_rows[key]


def _make_certain_rows(G: Array, h: Array, deviations: int) -> UncertainRows:
    """Rows that no deviation changes."""
    nothing, still = csr_array((deviations, G.shape[1])), np.zeros((1, deviations))
    return UncertainRows(csr_array(G), h, np.zeros(h.size, dtype=int), np.zeros(h.size), (nothing,), still)
