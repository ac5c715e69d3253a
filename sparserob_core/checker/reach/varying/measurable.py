"""A closed loop of a system that changes with time under measurable disturbances, in balls: what `MeasurableLoop` is to
the others. Every piece of the grid has kernels of its own, ``Phi(end, s) E(s)``, one for each segment of the system."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.checker.reach.measurable import Kernel, MeasurableLoop, as_enclosed
from sparserob_core.checker.reach.varying.execution import above_chord, pushes
from sparserob_core.checker.reach.varying.loop import VaryingLoop
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, product
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

KEPT = 4096  # ways from the beginning of a piece to a time in it, of which kernels are remembered


@final
@dataclass(frozen=True, eq=False)
class VaryingMeasurableLoop(VaryingLoop, MeasurableLoop):
    """`MeasurableLoop` of a system of which ``law`` is the flow."""

    _ways: dict[tuple[float, float], Kernel] = field(default_factory=dict, repr=False)

    def kernel(self, piece: int) -> Kernel:
        return self._way(self.grid[piece], self.grid[piece + 1])

    def under_way(self, piece: int, time: float, rows: Array | arb_mat) -> Enclosed:
        return self._way(self.grid[piece], time).most(as_enclosed(rows), self.sides)

    def _way(self, start: float, stop: float) -> Kernel:
        """The kernel of an interval, whose parts are those between ends of segments, in shares of each."""
        if (start, stop) not in self._ways:
            if len(self._ways) >= KEPT:
                self._ways.clear()
            ends = self._flow.marks([start, stop])
            every, onward = list[Enclosed](), self._identity
            for first, last in reversed(list(pairwise(ends))):
                terms = pushes(self._flow, first, last, self._entries)
                every.append(product(Enclosed.of(onward), Enclosed(terms.mid[:, 0], terms.rad[:, 0])))
                onward = onward * self._flow.over(first, last)[0].matrix
            most = max(len(one.mid) for one in every)
            mid, rad = (
                np.array([np.pad(part, ((0, most - len(part)), (0, 0), (0, 0))) for part in parts])
                for parts in zip(*((one.mid, one.rad) for one in every), strict=True)
            )
            self._ways[start, stop] = Kernel(mid, rad.sum(axis=1) * OUTWARD, 0.5)
        return self._ways[start, stop]

    @property
    def _entries(self) -> slice:
        """The columns of the disturbance in ``[B E]``."""
        return slice(self._flow.driven, self._flow.driven + self.width)

    def bent(self, piece: int, start: float, stop: float, rows: Array | arb_mat) -> Array:
        """As of `VaryingLoop`; what the piece itself adds is a sum of integrals of absolute values, or less."""
        assert isinstance(rows, np.ndarray)
        axes = np.vstack([np.eye(self.system.states), -np.eye(self.system.states)])
        begun, size = np.zeros(len(axes)), sum((side.far for side in self.sides), np.zeros(self.width))
        if start > self.grid[piece]:
            ends = self.under_way(piece, start, axes)
            begun = np.maximum(ends.mid + ends.rad, 0.0) * OUTWARD
        states = begun.reshape(2, -1).max(axis=0)
        more = above_chord(self._flow, rows, start, stop, states, size * OUTWARD, self._flow.driven)
        return np.asarray((super().bent(piece, start, stop, rows) + more) * OUTWARD)
