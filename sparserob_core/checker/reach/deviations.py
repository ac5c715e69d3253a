"""Deviations from the middles of their sets, block by block, that a control under feedback may have to answer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import final

import numpy as np
from flint import arb

from sparserob_core.checker.arithmetic.balls import ball, balls
from sparserob_core.checker.sets.known import known, middle
from sparserob_core.checker.sets.polynomials import OUTWARD
from sparserob_core.sip.convex_set import Array, ConvexSet


@final
@dataclass(frozen=True, eq=False)
class Deviations:
    """The deviations that a control may answer, block by block. A set is ``None`` where there is no such deviation.

    They are those of a disturbance with ``width`` entries in the set ``shape``, constant on each of ``held`` blocks; of
    the ``noise`` of ``noises`` measurements; and of the initial state in the set ``initial``, as the last block.
    """

    shape: ConvexSet | None
    width: int
    initial: ConvexSet | None
    held: int
    noise: ConvexSet | None = None
    noises: int = 0

    @property
    def blocks(self) -> int:
        """The number of blocks of the disturbance."""
        return 0 if self.shape is None else self.held

    @property
    def initial_block(self) -> int:
        """The index of the block of the initial deviation, where there is one: the last block."""
        return self.blocks + self.noises

    @cached_property
    def sets(self) -> list[tuple[ConvexSet, Array]]:
        """The set and its middle of every block that has a set of its own, that of the initial state last."""
        sets = [] if self.shape is None else [(self.shape, self.middle)] * self.blocks
        sets += [] if self.noise is None else [(self.noise, middle(self.noise))] * self.noises
        return sets if self.initial is None else [*sets, (self.initial, middle(self.initial))]

    @cached_property
    def starts(self) -> list[int]:
        """The index of the first entry of every block, and at the end the number of all entries, ``Q``."""
        return [0, *accumulate(shape.dimension for shape, _ in self.sets)]

    @cached_property
    def radii(self) -> Array:
        """The upper bound of the absolute value of each entry of a deviation from the middle, ``(Q,)``, rounded up."""
        radii = [np.array(known(shape).radius) + np.abs(about) for shape, about in self.sets]
        return np.asarray(np.nextafter(np.concatenate([np.zeros(0), *radii]) * OUTWARD, np.inf))

    def support(self, a: list[arb]) -> arb:
        """Return the support value ``max z'a`` over all deviations ``z``, for one ``a (Q,)`` in balls."""
        blocks = (a[first : first + shape.dimension] for first, (shape, _) in zip(self.starts, self.sets, strict=False))
        return sum((_evaluate_block(*pair, block) for pair, block in zip(self.sets, blocks, strict=True)), ball(0))

    @cached_property
    def middle(self) -> Array:
        """The point ``(mw,)`` from which deviations of the disturbance are counted; 0 without a disturbance."""
        return np.zeros(self.width) if self.shape is None else middle(self.shape)

    @cached_property
    def rests(self) -> list[list[arb]]:
        """The difference between a point that is proven to be in the set and the middle, for every one of `sets`: 0 but
        for thin sets, of which rounding may have moved the middle out."""
        differences: dict[int, list[arb]] = {}
        for shape, about in self.sets:
            if id(shape) not in differences:
                point = known(shape).member(about)
                assert point is not None
                differences[id(shape)] = [x - m for x, m in zip(point, balls(about), strict=True)]
        return [differences[id(shape)] for shape, _ in self.sets]


def _evaluate_block(shape: ConvexSet, about: Array, a: list[arb]) -> arb:
    """Return the support value at ``a`` of a set minus the point ``about``; exactly 0 at ``a = 0``."""
    total = a[0] * 0
    if any(not x.is_zero() for x in a):
        total = total + known(shape).support(a)
        for x, m in zip(a, balls(about), strict=True):
            total = total if m.is_zero() else total - x * m
    return total
