"""Gains that stay as they are, and a nominal control that is chosen anew when a state is measured.

When innovations were seen until ``tau_p``, the control that is left is ``v_k + sum_{p < j} M_kj e_j``, with
``v_k`` the nominal one and what the gains make of the past. With the same ``M`` this is a problem in ``v`` alone: what
future disturbances add to a row does not depend on it. So it is as quickly solved and proven as one without feedback.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np

from sparserob_core.control.loop.remaining import remaining
from sparserob_core.control.loop.tracking import Tracked, Tracking, trackable
from sparserob_core.control.transcription.own_units import row_units
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import SparseRobError
from sparserob_core.sip.convex_set import Array


@final
class Kept:
    """What future disturbances add under the gains of a ``decision (n,)``, from piece ``piece`` on, to rows ``H (R,
    d)``: the `Answering` of a `Tracking`."""

    def __init__(self, model: Transcription, decision: Array, piece: int, H: Array) -> None:
        loop = model.answering.loop
        nodes, drives = loop.path(decision)
        later = np.abs(loop.entries[piece:]).sum(axis=(0, 1)) > 0.0  # (Q,): deviations that act from now on
        self.H, self.spread, self.A = H, loop.spread, loop.steps.A[0, 0]
        self.nodes = nodes[piece:, :, 1:] * later
        self.drives = np.concatenate([drives[piece:, :, 1:] * later, np.zeros((1, *drives[0, :, 1:].shape))])
        self.effects = loop.effects(decision)[piece:] * later

    def room(self) -> tuple[Array, Array]:
        """See `Answering`."""
        return self.spread.support(-self.effects).T, self.spread.support(self.effects).T

    def added(self, flow: Array, driven: Array, piece: int) -> Array:
        """See `Answering`."""
        return self.spread.support(self.H @ (flow @ self.nodes[piece] + driven @ self.drives[piece]))

    def bending(self, curvature: Callable[[Array], Array]) -> tuple[Array, Array]:
        """See `Answering`."""
        rates = (self.A @ self.nodes + self.drives)[:-1].swapaxes(1, 2)  # (K, Q, d)
        bent = np.einsum("kqr,q->kr", curvature(rates), self.spread.radii)
        return bent, np.einsum("kdq,rd,q->kr", np.abs(self.nodes), np.abs(self.H), self.spread.radii)


@final
class Retuning:
    """Chooses the nominal control of one plan anew at its pieces; gains and everything that belongs to them are kept
    from one loop to the next."""

    def __init__(self, model: Transcription, decision: Array) -> None:
        self.model, self.decision = model, decision
        self._tracking: dict[int, Tracking | None] = {}

    def prepare(self, state: Array) -> None:
        """Make what belongs to every piece, as long as the problem is of the kind; the state ``(d,)`` changes
        nothing."""
        for piece in range(self.model.control.pieces):
            if self._tracking.setdefault(piece, self._prepared(piece, state)) is None:
                return

    def solve(self, piece: int, state: Array) -> Tracked | None:
        """The nominal control ``(m K',)`` that is left from ``piece`` on, with what the gains make of the past, from a
        measured ``state (d,)``; ``None`` where no answer is proven, or where the problem is not of the kind."""
        if piece not in self._tracking:
            self._tracking[piece] = self._prepared(piece, state)
        tracking = self._tracking[piece]
        return None if tracking is None else tracking.solve(state)

    def _prepared(self, piece: int, state: Array) -> Tracking | None:
        model, grid = self.model, self.model.response.grid
        loop, signal = model.answering.loop, model.functionals.disturbance
        if model.answering.charge.cost not in ("nominal", "peak") or not loop.spread.is_box or loop.middles.any():
            return None
        if model.problem.disturbance_class != "piecewise_constant":
            return None
        if signal is None or signal.starts is None or signal.starts.size != grid.pieces or not _plain(model):
            return None
        try:
            left = remaining(model, piece, state, None, alone=True)
        except SparseRobError:
            return None
        control = left.problem.control
        left = replace(left, constraints=tuple(one.divided(row_units(one, control)) for one in left.constraints))
        if not trackable(left):
            return None
        tracking = Tracking(left, lambda H: Kept(model, self.decision, piece, H))
        return tracking if tracking.limited else None


def _plain(model: Transcription) -> bool:
    """Whether the problem, without feedback, has nothing that a nominal control alone does not tell: no parameters, no
    steps, no equalities, on equal pieces."""
    problem, grid = model.problem, model.response.grid
    plain = problem.system.parameters is None and problem.control_step is None and model.program.A is None
    return plain and model.response.uniform and grid.pieces == model.control.pieces


def retuned(model: Transcription, decision: Array, piece: int, left: Array, found: Array) -> Array:
    """The decision whose control from ``piece`` on is ``found (m K',)`` where it was ``left (m, K')``: the nominal
    control moves by the difference."""
    moved = decision.copy()
    nominal = moved[: model.control.pieces * left.shape[0]].reshape(left.shape[0], -1)
    nominal[:, piece:] += found.reshape(left.shape) - left
    return moved
