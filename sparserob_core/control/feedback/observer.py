"""Innovations of outputs by a one-step observer, and an observer gain that is stable.

From the centre of the initial states on, ``x^_{j+1} = Phi_j x^_j + (what the control, the drift and the middle of the
disturbance add) + L_j (y_j - C x^_j - v_m)`` with the middle ``v_m`` of the noise. The error ``x - x^`` does not depend
on the control. So the innovations ``e_j = y_j - C x^_j - v_m`` are linear in the deviations of the disturbance, of the
noise and of the initial state, whatever the gains are. Where every innovation is answered, any ``L`` gives the same
policies.

An inner loop acts on the estimate at breakpoint ``k`` that the control knows then. With a latency that is ``x^_k`` less
what the innovations add to it that are known only later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    known : ndarray of int, shape (K,)
        Number of earlier measurements that every piece of the control knows.
    """

    C: Array
    L: Array
    flows: Array
    middle: Array
    noisy: bool
    known: np.ndarray

    @staticmethod
    def of(measured: Measurements, input_effects: Array, flows: Array, radii: Array, breakpoints: Array) -> Observer:
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
        breakpoints : ndarray, shape (K + 1,)
            Breakpoints of the control.
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
        known_count = np.tril(measured.known(breakpoints), -1).sum(axis=1)
        return Observer(C, L, flows, middle, measured.noise is not None, known_count)

    def outputs(self, states: Array, noise: Array | None = None) -> Array:
        """Return the outputs ``(p, n)`` of ``states (d, n)``, with the given ``noise`` or else the middle of the
        noise."""
        return np.asarray(self.C @ states + (self.middle[:, None] if noise is None else noise))

    def estimate(self, k: int, predicted: Array, innovations: Sequence[Array] | Array) -> Array:
        """Return the states ``(d, n)`` at breakpoint ``k`` as the control estimates them that begins there.

        Parameters
        ----------
        k : int
            The breakpoint.
        predicted : ndarray, shape (d, n)
            States that all earlier ``innovations`` predict.
        innovations : sequence of ndarray, shape (p, n)
            Innovations at the breakpoints so far.

        Returns
        -------
        ndarray
            The prediction, less what is added by innovations that are known only later.
        """
        added = np.zeros_like(predicted)
        for j in range(int(self.known[k]), k):
            added = self.flows[j] @ added + self.L[j] @ innovations[j]
        return np.asarray(predicted - added)

    def compute_innovations(self, D: Array, initial_count: int) -> tuple[Array, Array]:
        """Return the matrices ``(K, p, Q + K p)`` from all deviations to the innovations, or ``(K, p, Q)`` without a
        noise, and those to the errors of the states that the control estimates, ``(K, d, ...)``.

        Disturbance and initial state enter the state as ``D (K, d, Q)`` from breakpoint to breakpoint. The entries of
        the noise stand before the last ``initial_count`` entries, which belong to the initial state.
        """
        (K, d, Q), p = D.shape, self.C.shape[0]
        count = K * p if self.noisy else 0
        inputs = np.concatenate(
            [D[:, :, : Q - initial_count], np.zeros((K, d, count)), D[:, :, Q - initial_count :]], axis=2
        )
        innovations, error = np.zeros((K, p, Q + count)), np.zeros((d, Q + count))
        errors = np.zeros((K, d, Q + count))
        for j in range(K):
            error = error + inputs[j]
            innovations[j], errors[j] = self.C @ error, -self.estimate(j, -error, innovations)
            if self.noisy:
                first = Q - initial_count + j * p
                innovations[j, :, first : first + p] += np.eye(p)
            if j + 1 < K:
                error = self.flows[j] @ error - self.L[j] @ innovations[j]
        return innovations, errors

    def in_units(self, states: Array, outputs: Array) -> Observer:
        """Return the same observer in other units: one unit of a state before is ``states (d,)`` units after, and one
        unit of an output is ``outputs (p,)``."""
        C, L = self.C * outputs[:, None] / states, self.L * states[:, None] / outputs
        flows = self.flows * states[:, None] / states
        return replace(self, C=C, L=L, flows=flows, middle=self.middle * outputs)


def innovations_of(entering: Array, initial_count: int, observer: Observer | None, anew: bool) -> tuple[Array, Array]:
    """Return the matrices ``(K, p, Q)`` from all deviations to the innovations, and those ``(K, d, Q)`` to the errors
    of the states that the control knows: 0 where states are measured.

    Disturbance and initial state enter the state as ``entering (K, d, Q')``. The entries of the noise stand before the
    last ``initial_count`` entries, which belong to the initial state. With ``anew``, as many entries of the next
    period's initial state stand between them; no measurement of this period depends on them.
    """
    tables = (
        (entering, np.zeros_like(entering))
        if observer is None
        else observer.compute_innovations(entering, initial_count)
    )
    if not anew:
        return tables
    at = np.full(initial_count, tables[0].shape[2] - initial_count)
    innovations, errors = (np.insert(table, at, 0.0, axis=2) for table in tables)
    return innovations, errors
