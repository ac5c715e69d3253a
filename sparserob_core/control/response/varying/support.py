"""How far the worst disturbance and the worst initial state push functionals of a system that changes with time,
enclosed over cells of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.combination import Combination
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.taylor import TaylorSpace
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.disturbance_support import over_faces, summed
from sparserob_core.control.response.varying.motion import KNOWN, OUTWARD, VaryingMotion
from sparserob_core.sip.convex_set import Array, ConvexSet

AT_ONCE = 4_000_000  # numbers of weights that are made at once


@dataclass(frozen=True, eq=False)
class VaryingSupport:
    """The support function of a part of the uncertainty on functionals ``rows (r, d)`` of a system that changes with
    time: as `DisturbanceSupport`, for one that is known.

    ``effect (K + 1, d, P, w)``: what its ``P`` parts made of the state until every mark; ``blocks``: from weights
    ``(..., P, w)`` on these to those on its blocks ``(..., nb, q)``, each of which is in ``set``; ``far (w,)``: how
    far a part goes. ``lasts``: it acts all the time, on the piece of the grid as it is its turn, through ``E``.
    """

    motion: VaryingMotion
    set: ConvexSet
    effect: Array
    blocks: Callable[[Array], Array]
    far: Array
    lasts: bool
    rows: Array
    combination: Combination | None = None

    @staticmethod
    def of_disturbance(
        motion: VaryingMotion, model: DisturbanceModel, rows: Array, combination: Combination | None
    ) -> VaryingSupport:
        """That of the worst disturbance."""
        far = model.bound.reach(np.eye(model.channels))
        return VaryingSupport(motion, model.set, motion.of_disturbance, model.blocks, far, True, rows, combination)

    @staticmethod
    def of_initial(
        motion: VaryingMotion, bound: ConvexSet, rows: Array, combination: Combination | None
    ) -> VaryingSupport:
        """That of the worst deviation of the initial state, one block that acts at time 0."""
        far = bound.reach(np.eye(bound.dimension))
        return VaryingSupport(motion, bound, motion.of_initial, lambda one: one, far, False, rows, combination)

    def steepness(self, times: Array) -> Array:
        """`Support.steepness`."""
        sizes = self.set.reach(self._seen(times)).sum(axis=3)
        return np.asarray(sizes @ self._space.exponents)

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """`Support.at`."""
        return over_faces(
            self._space, ends, lambda here, face: summed(self.set, self._seen(times[here]), face).sum(axis=2)
        )

    def deviation(self, start: Array, widths: Array) -> Array:
        """`Support.deviation`: as `VaryingMotion.deviation`, for every block."""
        motion, d = self.motion, self.motion.states
        pieces = np.minimum(self._place(start), motion.origin.size - 1)
        at = motion.bends(start, pieces)
        bent = self._weights(start, self.rows @ at[:, :, :d])
        third = motion.third[pieces]
        turned = np.einsum("kij,kj->ki", third[:, :, :d], self.reached[pieces])
        if self.lasts:
            pushes = slice(at.shape[2] - self.far.size, None)
            bent[np.arange(start.size), :, motion.origin[pieces]] += self.rows @ at[:, :, pushes]
            turned = turned + third[:, :, pushes] @ self.far
        exact = self.set.reach(self.blocks(bent)).sum(axis=2)
        turned = widths[:, None] * turned
        turned = turned + rounding(motion.terms + bent[0, 0].size) * np.einsum(
            "kij,kj->ki", motion.second[pieces][:, :, :d], self.reached[pieces]
        )
        along = exact + turned @ np.abs(self.rows).T
        return np.asarray((widths**2 / 8)[:, None] * along * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, and rounded in the sums over the blocks, on every piece: ``(r, K)``."""
        motion, sums = self.motion, self._sizes
        pushed = motion.flow.sizes[:, -self.far.size :] * self.far if self.lasts else np.zeros((sums.shape[0] - 1, 1))
        total = motion.left_out(sums[:-1], pushed) + rounding(self.effect[0, 0].size) * self.reached
        return product(np.abs(self.rows), total.T)

    @cached_property
    def reached(self) -> Array:
        """What any of it can have made of every state on every piece, ``(K, d)``."""
        motion, begun = self.motion, self._sizes[:-1]
        lengths = motion.grid.lengths
        if self.lasts:
            begun = begun + lengths[:, None] * (motion.most[:, :, -self.far.size :] @ self.far)
        return motion.grown(motion.every, lengths, begun)

    @cached_property
    def _sizes(self) -> Array:
        """The same at the marks, ``(K + 1, d)``."""
        return np.asarray(np.einsum("kdpw,w->kd", np.abs(self.effect), self.far) * OUTWARD)

    @property
    def _space(self) -> TaylorSpace:
        return KNOWN if self.combination is None else self.combination.space

    def _seen(self, times: Array) -> Array:
        """Taylor coefficients ``(k, r, M, nb, q)`` of what the functionals give to every block."""
        rows = np.broadcast_to(self.rows, (times.size, *self.rows.shape))
        found = self.blocks(self._weights(times, rows))[:, :, None]
        return found if self.combination is None else self.combination.apply(found)

    def _place(self, times: Array) -> np.ndarray:
        """The mark at or before each time."""
        marks = self.motion.grid.breakpoints
        return np.maximum(np.searchsorted(marks, times, side="right") - 1, 0)

    def _weights(self, times: Array, rows: Array) -> Array:
        """What rows ``(k, r, d)`` at times ``(k,)`` give to every part, ``(k, r, P, w)``."""
        motion, place = self.motion, self._place(times)
        parts = self.effect.shape[2:]
        flow = motion.expansion.flow(motion.grid.breakpoints[place], times)
        carried = rows @ flow.state
        found = np.empty((*rows.shape[:2], *parts))
        size = max(1, AT_ONCE // max(1, motion.states * parts[0] * parts[1]))
        for begin in range(0, times.size, size):
            part = slice(begin, begin + size)
            table = self.effect[place[part]].reshape(-1, motion.states, parts[0] * parts[1])
            found[part] = (carried[part] @ table).reshape(-1, rows.shape[1], *parts)
        if self.lasts:
            pieces = motion.origin[np.minimum(place, motion.origin.size - 1)]
            found[np.arange(times.size), :, pieces] += rows @ flow.disturbance
        return found
