"""Innovations that a control measures at its breakpoints, in ball arithmetic, as maps of the deviations.

The innovation ``e_j`` is the difference between the state at the breakpoint ``tau_j`` and its prediction from the state
at ``tau_{j-1}``, the control in between and the middle of the disturbance. With ``w = m + z`` for the middle ``m``, it
is ``e_j = sum_l D_jl z_l`` over the blocks ``l`` on which the disturbance is constant. Where the initial states are a
set, ``e_0`` is the initial deviation from the middle of that set: the last block.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np
from flint import arb_mat

from sparserob_core.checker.arithmetic.series import exactly, identity
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.reach.deviations import Deviations
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.policies.measurements import Measurements


@final
@dataclass(frozen=True, eq=False)
class VerifiedInnovations:
    """The innovations of a known plant with the verified ``flow``, as maps of the ``deviations``.

    Attributes
    ----------
    flow, deviations
        The flow of the plant, and what may deviate.
    grid, breakpoints, changes
        All breakpoints; those of the control; the times at which the disturbance may jump.
    measured, observer
        What is measured of the state at every breakpoint, and the gains of the observer ``(K, d, p)`` that makes
        innovations of it; ``None`` where the whole state is measured.
    """

    flow: VerifiedFlow
    deviations: Deviations
    grid: list[float]
    breakpoints: list[float]
    changes: list[float]
    measured: Measurements | None
    observer: Array | None

    @property
    def outputs(self) -> int:
        """The number of entries of an innovation."""
        return self.flow.states if self.measured is None else self.measured.outputs

    def _compute_piece_flow(self, piece: int) -> tuple[arb_mat, arb_mat]:
        """Return the transition ``(d, d)`` of a piece of the grid, and the effect ``(d, mw)`` of a disturbance that is
        constant on it."""
        Phi, _, Delta = self.flow.over(self.grid[piece], self.grid[piece + 1])
        return Phi.matrix, Delta.matrix

    def _find_commanded(self, piece: int) -> int:
        """Return the index of the piece of the control that is commanded on a piece of the grid."""
        return find_piece(self.breakpoints, self.grid, piece)

    @property
    def matrices(self) -> list[dict[int, arb_mat]]:
        """The matrices ``D_jl (p, mw)`` of every innovation ``j``, by block ``l``; blocks without effect are absent."""
        return self._effects[0]

    @property
    def errors(self) -> list[dict[int, arb_mat]]:
        """The matrices ``(d, mw)`` from every block to the error of the state that the control knows at a breakpoint;
        none where the state is measured."""
        return self._effects[1]

    @cached_property
    def _effects(self) -> tuple[list[dict[int, arb_mat]], list[dict[int, arb_mat]]]:
        """The `matrices` and the `errors`."""
        if self.measured is None:
            return self.entering_effects, [{} for _ in self.entering_effects]
        return self._compute_observer_effects(self.measured)

    def _compute_observer_effects(
        self, measured: Measurements
    ) -> tuple[list[dict[int, arb_mat]], list[dict[int, arb_mat]]]:
        """Return ``D_jl`` of the innovations of the observer, and the errors of its estimates. Its error is propagated
        from breakpoint to breakpoint, less its correction."""
        assert self.observer is not None
        C = exactly(np.asarray(measured.C))
        unit, noise = identity(self.outputs), self.deviations.initial_block > self.deviations.blocks
        is_known = measured.known(np.array(self.breakpoints))
        innovations: list[dict[int, arb_mat]] = []
        errors: list[dict[int, arb_mat]] = []
        error: dict[int, arb_mat] = {}
        for j, entering in enumerate(self.entering_effects):
            error = _add_blocks(error, entering)
            late = self._add_late_innovations(innovations, np.flatnonzero(~is_known[j, :j]).tolist())
            errors.append(_add_blocks(error, late))
            innovation = {block: C * effect for block, effect in error.items()}
            if noise:
                innovation[self.deviations.blocks + j] = unit
            innovations.append(innovation)
            if j + 1 == len(self.breakpoints) - 1:
                break
            # one transition of the error, since signs that are lost in balls are not found again
            L = exactly(self.observer[j])
            transition = self._breakpoint_transitions[j] - L * C
            error = {block: transition * effect for block, effect in error.items()}
            if noise:
                error[self.deviations.blocks + j] = -L
        return innovations, errors

    def _add_late_innovations(self, innovations: list[dict[int, arb_mat]], late: list[int]) -> dict[int, arb_mat]:
        """Return what the innovations at the breakpoints ``late``, the last ones so far, add to the prediction of the
        state, ``(d, mw)`` by block."""
        assert self.observer is not None
        added: dict[int, arb_mat] = {}
        for j in late:
            L, flow = exactly(self.observer[j]), self._breakpoint_transitions[j]
            added = {block: flow * effect for block, effect in added.items()}
            added = _add_blocks(added, {block: L * effect for block, effect in innovations[j].items()})
        return added

    @cached_property
    def _breakpoint_transitions(self) -> list[arb_mat]:
        """The transitions from each breakpoint of the control to the next, ``(d, d)`` each."""
        transitions = [identity(self.flow.states) for _ in self.breakpoints[:-1]]
        for piece in range(len(self.grid) - 1):
            transitions[self._find_commanded(piece)] = (
                self._compute_piece_flow(piece)[0] * transitions[self._find_commanded(piece)]
            )
        return transitions

    @cached_property
    def entering_effects(self) -> list[dict[int, arb_mat]]:
        """The effect ``(d, mw)`` of every block on the state at a breakpoint of the control, as far as it entered since
        the breakpoint before; at the first breakpoint, the initial deviation."""
        K = len(self.breakpoints) - 1
        effects: list[dict[int, arb_mat]] = [{} for _ in range(K)]
        if self.deviations.initial is not None:
            effects[0][self.deviations.initial_block] = identity(self.flow.states)
        for piece in range(len(self.grid) - 1 if self.deviations.blocks else 0):
            k, block = self._find_commanded(piece), find_piece(self.changes, self.grid, piece)
            if k + 1 >= K:
                break
            Phi, effect = self._compute_piece_flow(piece)
            by_block = {earlier: Phi * before for earlier, before in effects[k + 1].items()}
            if any(not x.is_zero() for x in effect.entries()):
                by_block[block] = by_block[block] + effect if block in by_block else effect
            effects[k + 1] = by_block
        return effects


def find_piece(times: list[float], grid: list[float], piece: int) -> int:
    """Return the index of the last of ``times`` before the middle of a piece of the grid; -1 where there is none."""
    return bisect_right(times, (grid[piece] + grid[piece + 1]) / 2) - 1


def _add_blocks(effects: dict[int, arb_mat], added: dict[int, arb_mat]) -> dict[int, arb_mat]:
    """Return the sums of two effects, block by block."""
    return {
        **effects,
        **{block: effects[block] + effect if block in effects else effect for block, effect in added.items()},
    }
