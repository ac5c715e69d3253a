"""Innovations of outputs by a one-step observer, and an observer gain that is stable.

From the centre of the initial states on, ``x^_{j+1} = Phi_j x^_j + (what the control, the drift and the middle of the
disturbance add) + L_j (y_j - C x^_j - v_m)`` with the middle ``v_m`` of the noise. The error ``x - x^`` does not depend
on the control. So the innovations ``e_j = y_j - C x^_j - v_m`` are linear in the deviations of the disturbance, of the
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
    """Return the transitions of the state ``(K - 1, d, d)`` from each breakpoint of the control to the next, without
    what drives it."""
    K, d = control.pieces, response.initial_state.size
    flows = np.tile(np.eye(d), (max(0, K - 1), 1, 1))
    steps, commanded = response.steps(KNOWN), response.grid.commanded(control.breakpoints)
    for piece in range(int(np.searchsorted(commanded, K - 1))):
        flows[commanded[piece]] = steps.Phi[0, response.which[piece]] @ flows[commanded[piece]]
    return flows


@final
@dataclass(frozen=True, eq=False)
class Observer:
    """One-step observer of the state from outputs.

    Parameters
    ----------
    C : ndarray, shape (p, d)
        Matrix of the outputs.
    L : ndarray, shape (K, d, p)
        Gain at every breakpoint; nothing follows the last one.
    flows : ndarray, shape (K - 1, d, d)
        Transitions of the state from each breakpoint to the next.
    middle : ndarray, shape (p,)
        Middle of the noise.
    noisy : bool
        Whether there is a noise.
    """

    C: Array
    L: Array
    flows: Array
    middle: Array
    noisy: bool

    @staticmethod
    def of(measured: Measurements, input_effects: Array, flows: Array, radii: Array) -> Observer:
        """Return the one-step predictor of Kalman (1960) for deviations of given sizes, a stable observer.

        Where the outputs determine the whole state and there is no noise, it predicts from the last measurement alone.

        Parameters
        ----------
        measured : Measurements
            Outputs and their noise.
        input_effects : ndarray, shape (K, d, Q)
            Contribution of the deviations to the state from breakpoint to breakpoint.
        flows : ndarray, shape (K - 1, d, d)
            Transitions of the state from each breakpoint to the next.
        radii : ndarray, shape (Q,)
            Largest deviations.
        """
        C, K = np.asarray(measured.C), input_effects.shape[0]
        p, d = C.shape
        L = np.zeros((K, d, p))
        box, middle = measured.noises.bounding_box(), measured.noises.middle()
        noise = (box.upper - box.lower) / 2.0  # from its middle, which is no deviation
        is_state_known = measured.noise is None and p == d and np.linalg.matrix_rank(C) == d
        input_factors = input_effects * radii
        P = input_factors[0] @ input_factors[0].T
        for j in range(K - 1):
            if is_state_known:
                L[j] = flows[j] @ np.linalg.inv(C)
                continue
            S = C @ P @ C.T + np.diag(noise**2)
            L[j] = flows[j] @ P @ C.T @ np.linalg.pinv(S, rcond=TELLING, hermitian=True)
            error_transition = flows[j] - L[j] @ C
            P = (
                error_transition @ P @ error_transition.T
                + (L[j] * noise**2) @ L[j].T
                + input_factors[j + 1] @ input_factors[j + 1].T
            )
        return Observer(C, L, flows, middle, measured.noise is not None)

    def outputs(self, states: Array, noise: Array | None = None) -> Array:
        """Return the outputs ``(p, n)`` of ``states (d, n)``, with the given ``noise`` or else the middle of the
        noise."""
        return np.asarray(self.C @ states + (self.middle[:, None] if noise is None else noise))

    def compute_innovations(self, D: Array, initial_count: int) -> Array:
        """Return the matrices ``(K, p, Q + K p)`` from all deviations to the innovations, or ``(K, p, Q)`` without a
        noise.

        Disturbance and initial state enter the state as ``D (K, d, Q)`` from breakpoint to breakpoint. The entries of
        the noise stand before the last ``initial_count`` entries, which belong to the initial state.
        """
        (K, d, Q), p = D.shape, self.C.shape[0]
        count = K * p if self.noisy else 0
        inputs = np.concatenate(
            [D[:, :, : Q - initial_count], np.zeros((K, d, count)), D[:, :, Q - initial_count :]], axis=2
        )
        innovations, error = np.zeros((K, p, Q + count)), np.zeros((d, Q + count))
        for j in range(K):
            error = error + inputs[j]
            innovations[j] = self.C @ error
            if self.noisy:
                first = Q - initial_count + j * p
                innovations[j, :, first : first + p] += np.eye(p)
            if j + 1 < K:
                error = self.flows[j] @ error - self.L[j] @ innovations[j]
        return innovations

    def in_units(self, states: Array, outputs: Array) -> Observer:
        """Return the same observer in other units: one unit of a state before is ``states (d,)`` units after, and one
        unit of an output is ``outputs (p,)``."""
        C, L = self.C * outputs[:, None] / states, self.L * states[:, None] / outputs
        return Observer(C, L, self.flows * states[:, None] / states, self.middle * outputs, self.noisy)


def innovations_of(entering: Array, initial_count: int, observer: Observer | None, anew: bool) -> Array:
    """Return the matrices ``(K, p, Q)`` from all deviations to the innovations.

    Disturbance and initial state enter the state as ``entering (K, d, Q')``. The entries of the noise stand before the
    last ``initial_count`` entries, which belong to the initial state. With ``anew``, as many entries of the next
    period's initial state stand between them; no measurement of this period depends on them.
    """
    innovations = entering if observer is None else observer.compute_innovations(entering, initial_count)
    return (
        np.insert(innovations, np.full(initial_count, innovations.shape[2] - initial_count), 0.0, axis=2)
        if anew
        else innovations
    )
