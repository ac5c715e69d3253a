"""Rows that must hold for every deviation in a set: linear in the decision for each deviation, and the worst one known.

A row is ``g x + w'(C x + d) <= h`` for all ``w`` in a product of convex sets, the `Spread`. Its worst deviation is in
closed form, ``max_w w'a = sum of support functions`` (Ben-Tal, El Ghaoui and Nemirovski 2009, section 1.3), so that the
left side is a convex function of the decision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@final
@dataclass(frozen=True, eq=False)
class Spread:
    """The set of deviations ``w (Q,)`` from the middle ``(Q,)``: a product of ``sets``, each so many times, in order.

    A deviation is what a point of its set has beyond the set's ``middle``; 0 is one.
    """

    sets: tuple[tuple[int, ConvexSet], ...]

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
    def radii(self) -> Array:
        """How far each entry comes from 0, ``(Q,)``."""
        found = [np.zeros(0)]
        for _, count, convex, middle in self.parts:
            axes = np.eye(convex.dimension)
            far = np.maximum(convex.support(axes) - middle, convex.support(-axes) + middle)
            found.append(np.tile(np.maximum(far, 0.0), count))
        return np.concatenate(found)

    @cached_property
    def chords(self) -> Array:
        """How long the set is along each axis through the middle, ``(Q,)``: for all ``a``, the width of the set along
        ``a`` is at least that times ``|a_i|``."""
        found = [np.zeros(0)]
        for _, count, convex, middle in self.parts:
            lengths = np.zeros(convex.dimension)
            for i, axis in enumerate(np.eye(convex.dimension)):
                if convex.is_box:
                    box = convex.bounding_box()
                    lengths[i] = box.upper[i] - box.lower[i]
                    continue
                low, high = convex.chord(middle, axis)
                lengths[i] = max(0.0, float(high - low))
            found.append(np.tile(lengths, count))
        return np.concatenate(found)

    @property
    def is_box(self) -> bool:
        """Whether every set is a box: the deviations are then those of at most `radii`, entry by entry."""
        return all(convex.is_box for _, convex in self.sets)

    def support(self, a: Array) -> Array:
        """``max_w w'a (...,)`` of ``a (..., Q)``."""
        if self.is_box:
            return np.asarray(np.abs(a) @ self.radii)
        total = np.zeros(a.shape[:-1])
        for part, count, convex, middle in self.parts:
            blocks = a[..., part].reshape(*a.shape[:-1], count, convex.dimension)
            total = total + (convex.support(blocks) - blocks @ middle).sum(axis=-1)
        return total

    def worst(self, a: Array) -> Array:
        """A deviation ``(..., Q)`` that attains `support`."""
        if self.is_box:
            return np.asarray(np.sign(a) * self.radii)
        found = np.empty(a.shape)
        for part, count, convex, middle in self.parts:
            blocks = a[..., part].reshape(*a.shape[:-1], count, convex.dimension)
            found[..., part] = (convex.support_point(blocks) - middle).reshape(*a.shape[:-1], -1)
        return found


@final
@dataclass(frozen=True, eq=False)
class UncertainRows:
    """Rows ``g_r x + factor_r w'(C_p x + d_p) <= h_r`` for every deviation, with ``p = part_r``.

    ``g (r, n)`` and every ``C (Q, n)`` sparse, ``h (r,)``, ``d (p, Q)``. Rows that look opposite ways share a part, with
    factors of opposite signs.
    """

    g: csr_array
    h: Array
    part: np.ndarray
    factor: Array
    C: tuple[csr_array, ...]
    d: Array

    def coefficients(self, x: Array) -> Array:
        """``C_p x + d_p``, ``(p, Q)``."""
        moved = [np.asarray(C @ x) for C in self.C]
        return self.d + (np.stack(moved) if moved else 0.0)

    def excess(self, x: Array, spread: Spread) -> Array:
        """By how much the rows are violated at the worst deviation, ``(r,)``; negative: a margin."""
        a = self.coefficients(x)
        return np.asarray(self.g @ x - self.h + spread.support(self.factor[:, None] * a[self.part]))
