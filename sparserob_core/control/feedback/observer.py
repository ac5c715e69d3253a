"""What outputs tell of the deviations: innovations of a one-step observer, and an observer gain that is stable.

From the centre of the initial states on, ``x^_{j+1} = Phi_j x^_j + (what the control, the drift and the middle of the
disturbance add) + L_j (y_j - C x^_j - v_m)`` with the middle ``v_m`` of the noise. The error ``x - x^`` does not depend
on the control; so the innovations ``e_j = y_j - C x^_j - v_m`` are linear in the deviations of the disturbance, of the
noise and of the initial state, whatever the gains are. Where every innovation is answered, any ``L`` gives the same
policies.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.control.feedback.innovations import KNOWN
from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array

# Of the largest singular value, below which an output tells nothing new beside the others. Ten times less and gains of
# rounding are chosen, ten times more and an output that is noisier by so much is passed over by L (not by the policy).
TELLING = 1e-10


def between(response: Response, control: Dictionary) -> Array:
    """The transitions of the state ``(K - 1, d, d)`` from each breakpoint of the control to the next, without what
    drives it."""
    K, d = control.pieces, response.initial_state.size
    flows = np.tile(np.eye(d), (max(0, K - 1), 1, 1))
    steps, commanded = response.steps(KNOWN), response.grid.commanded(control.breakpoints)
    for piece in range(int(np.searchsorted(commanded, K - 1))):
        flows[commanded[piece]] = steps.Phi[0, response.which[piece]] @ flows[commanded[piece]]
    return flows


@final
@dataclass(frozen=True, eq=False)
class Observer:
    """``C (p, d)``, the gains ``L (K, d, p)`` of every breakpoint, the last of which nothing follows, the transitions
    ``flows (K - 1, d, d)`` of the state from each to the next, and the middle of the noise ``(p,)``; ``noisy``: whether
    there is any."""

    C: Array
    L: Array
    flows: Array
    middle: Array
    noisy: bool

    @staticmethod
    def of(measured: Measurements, seen: Array, flows: Array, radii: Array) -> Observer:
        """A stable one for a state of which ``seen (K, d, Q)`` enters from breakpoint to breakpoint, where deviations
        go as far as ``radii (Q,)``: the one-step predictor of Kalman (1960) for deviations of these sizes. Where the
        outputs say the whole state and there is no noise it predicts from what was measured alone."""
        C, K = np.asarray(measured.C), seen.shape[0]
        p, d = C.shape
        L = np.zeros((K, d, p))
        box, middle = measured.noises.bounding_box(), measured.noises.middle()
        noise = (box.upper - box.lower) / 2.0  # from its middle, which is no deviation
        whole = measured.noise is None and p == d and np.linalg.matrix_rank(C) == d
        entered = seen * radii
        P = entered[0] @ entered[0].T
        for j in range(K - 1):
            if whole:
                L[j] = flows[j] @ np.linalg.inv(C)
                continue
            S = C @ P @ C.T + np.diag(noise**2)
            L[j] = flows[j] @ P @ C.T @ np.linalg.pinv(S, rcond=TELLING, hermitian=True)
            left = flows[j] - L[j] @ C
            P = left @ P @ left.T + (L[j] * noise**2) @ L[j].T + entered[j + 1] @ entered[j + 1].T
        return Observer(C, L, flows, middle, measured.noise is not None)

    def outputs(self, states: Array, noise: Array | None = None) -> Array:
        """What is measured of ``states (d, n)``, ``(p, n)``; with the middle of the noise unless it is given."""
        return np.asarray(self.C @ states + (self.middle[:, None] if noise is None else noise))

    def seen(self, D: Array, begun: int) -> Array:
        """The innovations ``(K, p, Q + K p)`` of the deviations that enter the state as ``D (K, d, Q)`` from breakpoint
        to breakpoint, and of those of the noise, which stand before the last ``begun``, of the initial state."""
        (K, d, Q), p = D.shape, self.C.shape[0]
        count = K * p if self.noisy else 0
        entered = np.concatenate([D[:, :, : Q - begun], np.zeros((K, d, count)), D[:, :, Q - begun :]], axis=2)
        found, error = np.zeros((K, p, Q + count)), np.zeros((d, Q + count))
        for j in range(K):
            error = error + entered[j]
            found[j] = self.C @ error
            if self.noisy:
                place = Q - begun + j * p
                found[j, :, place : place + p] += np.eye(p)
            if j + 1 < K:
                error = self.flows[j] @ error - self.L[j] @ found[j]
        return found

    def in_units(self, states: Array, outputs: Array) -> Observer:
        """The same where one of a state was ``states (d,)``, and one of an output ``outputs (p,)``."""
        C, L = self.C * outputs[:, None] / states, self.L * states[:, None] / outputs
        return Observer(C, L, self.flows * states[:, None] / states, self.middle * outputs, self.noisy)


def innovations_of(entering: Array, begun: int, observer: Observer | None, anew: bool) -> Array:
    """The innovations ``(K, p, Q)`` of all deviations, where those of disturbance and initial state enter the state as
    ``entering (K, d, Q')``: those of the noise stand before the last ``begun``, of the initial state, and with ``anew``
    so many of the next period's initial state between them, which nobody sees in this one."""
    seen = entering if observer is None else observer.seen(entering, begun)
    return np.insert(seen, np.full(begun, seen.shape[2] - begun), 0.0, axis=2) if anew else seen
