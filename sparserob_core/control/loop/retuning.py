"""Nominal control that is chosen anew when a state is measured, with unchanged gains.

After innovations up to ``tau_p``, the remaining control is ``v_k + sum_{p < j} M_kj e_j``. Here ``v_k`` is the nominal
control plus the response of the gains to the past. With the same ``M`` this is a problem in ``v`` alone: the effect of
future disturbances on a row does not depend on ``v``. So the problem is solved and proven as quickly as one without
feedback.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import final

import numpy as np

from sparserob_core.control.loop.remaining import remaining_problem
from sparserob_core.control.loop.tracking import Tracked, Tracking, is_trackable
from sparserob_core.control.transcription.own_units import row_units
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import SparseRobError
from sparserob_core.sip.convex_set import Array


@final
class Kept:
    """Effect of future disturbances under the gains of a ``decision (n,)``, from piece ``piece`` on, on rows ``H (R,
    d)``: the `FutureEffects` of a `Tracking`."""

    def __init__(self, model: Transcription, decision: Array, piece: int, H: Array) -> None:
        loop = model.answering.loop
        nodes, drives = loop.path(decision)
        later = np.abs(loop.entries[piece:]).sum(axis=(0, 1)) > 0.0  # (Q,): deviations that act from now on
        self.H, self.spread, self.A = H, loop.spread, loop.steps.A[0, 0]
        self.nodes = nodes[piece:, :, 1:] * later
        self.drives = np.concatenate([drives[piece:, :, 1:] * later, np.zeros((1, *drives[0, :, 1:].shape))])
        self.effects = loop.effects(decision)[piece:] * later

    def room(self) -> tuple[Array, Array]:
        """Return how far the control may lie below and above the nominal control on every piece, ``(m, K)`` each."""
        return self.spread.support(-self.effects).T, self.spread.support(self.effects).T

    def added(self, flow: Array, driven: Array, piece: int) -> Array:
        """Return the support value ``(q, R)`` of the future deviations in every row at instants of a piece."""
        return self.spread.support(self.H @ (flow @ self.nodes[piece] + driven @ self.drives[piece]))

    def bending(self, curvature: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Return bounds ``(K, R)`` of the second derivative of the support value over every piece, and the sums of
        absolute numbers ``(K + 1, R)`` from which the support value is computed."""
        rates = (self.A @ self.nodes + self.drives)[:-1].swapaxes(1, 2)  # (K, Q, d)
        bounds = np.einsum("kqr,q->kr", curvature(rates), self.spread.radii)
        return bounds, np.einsum("kdq,rd,q->kr", np.abs(self.nodes), np.abs(self.H), self.spread.radii)


@final
class Retuning:
    """Solver for the nominal control of one plan at its pieces; gains and everything that depends on them are kept from
    one loop to the next."""

    def __init__(self, model: Transcription, decision: Array) -> None:
        self.model, self.decision = model, decision
        self._trackers: dict[int, Tracking | None] = {}

    def prepare(self, state: Array) -> None:
        """Compute the solver of every piece, as long as `Tracking` accepts the problem; the value of ``state (d,)``
        does not matter."""
        for piece in range(self.model.control.pieces):
            if self._trackers.setdefault(piece, self._prepare_tracker(piece, state)) is None:
                return

    def solve(self, piece: int, state: Array, seconds: float = np.inf) -> Tracked | None:
        """Return the nominal control ``(m K',)`` that remains from ``piece`` on, with the response of the gains to the
        past, from a measured ``state (d,)``. ``None`` where no answer is proven within ``seconds``, or where `Tracking`
        does not accept the problem."""
        if piece not in self._trackers:
            self._trackers[piece] = self._prepare_tracker(piece, state)
        tracking = self._trackers[piece]
        return None if tracking is None else tracking.solve(state, seconds)

    def _prepare_tracker(self, piece: int, state: Array) -> Tracking | None:
        model, grid = self.model, self.model.response.grid
        loop, signal = model.answering.loop, model.functionals.disturbance
        if model.answering.charge.cost not in ("nominal", "peak") or not loop.spread.is_box or loop.middles.any():
            return None
        if loop.inner.acts:  # whose decided part is no control, and the remainder in open loop would amplify
            return None
        if signal is None or signal.starts is None or signal.starts.size != grid.pieces or not _is_plain_problem(model):
            return None
        try:
            remainder = remaining_problem(model, piece, state, None, alone=True)
        except SparseRobError:
            return None
        control = remainder.problem.control
        remainder = replace(
            remainder,
            constraints=tuple(
                constraint.divided(row_units(constraint, control)) for constraint in remainder.constraints
            ),
        )
        if not is_trackable(remainder):
            return None
        tracking = Tracking(remainder, lambda H: Kept(model, self.decision, piece, H))
        return tracking if tracking.limited else None


def _is_plain_problem(model: Transcription) -> bool:
    """Return whether the nominal control alone determines the problem without feedback: no parameters, no steps of the
    control, no equalities, on equal pieces."""
    problem, grid = model.problem, model.response.grid
    is_plain = problem.system.parameters is None and problem.control_step is None and model.program.A is None
    return is_plain and model.response.uniform and grid.pieces == model.control.pieces


def replace_control(model: Transcription, decision: Array, piece: int, remaining_control: Array, found: Array) -> Array:
    """Return the decision with another control from ``piece`` on: ``found (m K',)`` instead of ``remaining_control (m,
    K')``. The nominal control moves by the difference."""
    changed = decision.copy()
    nominal = changed[: model.control.pieces * remaining_control.shape[0]].reshape(remaining_control.shape[0], -1)
    nominal[:, piece:] += found.reshape(remaining_control.shape) - remaining_control
    return changed
