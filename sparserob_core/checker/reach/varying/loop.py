"""What a system that changes with time does whose control answers what it measures, in balls: what `ClosedLoop` is to
the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import around, stacked
from sparserob_core.checker.flow.flow import Flow
from sparserob_core.checker.reach.closed_loop import ClosedLoop, exactly
from sparserob_core.checker.reach.preimages import Pushed
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

ORDER = 8  # of the states in the time on a cell; what comes after counts twice, half of it takes shorter cells


@dataclass(frozen=True, eq=False)
class VaryingLoop(ClosedLoop):
    """The same of a system of which ``law`` is the flow."""

    law: Flow | None = None

    @cached_property
    def _flow(self) -> Flow:
        assert self.law is not None
        return self.law

    @cached_property
    def drives(self) -> list[arb_mat]:
        """What acts on each piece of the grid, nominally and as answers: control, drift and disturbance, ``(m + mw, 1 +
        Q)``."""
        found, none = [], [0.0] * self.starts[-1]
        for piece in range(len(self.grid) - 1):
            k, block = self._places(piece)
            given = [balls([1.0, *none])] if self.system.c is not None else []
            entering = [balls([middle, *none]) for middle in self.middle.tolist()]
            if self.blocks:
                self._entered(entering, block, exactly(np.eye(self.width)))
            found.append(stacked([*self.inputs(k).tolist(), *given, *entering]))
        return found

    def _moved(self, piece: int, start: float, stop: float) -> tuple[arb_mat, arb_mat]:
        Phi, Gamma, Delta = self._flow.over(start, stop)
        return Phi.matrix, Gamma.beside(Delta).matrix * self.drives[piece]

    def _passed(self, piece: int) -> tuple[arb_mat, arb_mat]:
        Phi, _, Delta = self._flow.over(self.grid[piece], self.grid[piece + 1])
        return Phi.matrix, Delta.matrix

    def pushed(self, vectors: Sequence[Sequence[Fraction]]) -> Pushed:
        """As that of `ClosedLoop`, from which numbers are other than 0 at any time alone."""
        d, m = self._flow.states, self._flow.driven
        there = self._flow.law.there
        A, E = there[:, :d], there[:, d + m :]
        pattern = E.astype(int) @ np.array([[bool(v) for v in vector] for vector in vectors]).T > 0
        for _ in range(len(A) - 1):
            pattern = pattern | (A.astype(int) @ pattern.astype(int) > 0)
        return Pushed(pattern, int(pattern.any(axis=1).sum()), int(pattern.any(axis=0).sum()))

    def bent(self, piece: int, start: float, stop: float, rows: Array | arb_mat) -> Array:
        """As that of `ClosedLoop`, within one segment of the system: the states are a power series of the share ``s``
        of the cell, whose term ``a s^n`` is at most ``(n - 1) n^(-n / (n - 1)) |a|`` from its chord."""
        terms, off = self._flow.within(start, stop, start, stop, ORDER + 1)
        both = stacked([*self.state(piece, start).tolist(), *self.drives[piece].tolist()])
        line, sizes = exactly(rows), np.concatenate([[1.0], self.radii])
        total = np.zeros((line.nrows(), sizes.size))
        for n, term in enumerate(terms[2:], 2):
            found = Enclosed.of(line * (term.matrix * both))
            total += (np.abs(found.mid) + found.rad) * ((n - 1) * n ** (-n / (n - 1)) * OUTWARD)
        # at both ends too, of which the chord takes the larger share
        found = Enclosed.of(line * (around(off) * both))
        total += 2.0 * (np.abs(found.mid) + found.rad)
        return np.asarray(total @ sizes * (1.0 + rounding(sizes.size)) * OUTWARD)
