"""Gains of an inner loop that stabilises a plant, and a bound of what it adds to the control.

The gains are those of the linear quadratic regulator of the sampled plant over the horizon (Anderson and Moore 1990,
section 2.4), with weights by Bryson's rule: every state constraint and every control counts in units of its own bound.
Any gains are valid. They are coordinates of a policy, and no claim rests on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.linalg import schur, solve_sylvester

from sparserob_core.control.feedback.innovations import KNOWN
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array

SPANS = (1, 2, 4, 8)  # pieces of the control, over which constraints on the states are read together
OUTWARD = 1.0 + 1e-9  # factor for rounding: a bound that is wider by so much loses nothing
LEAST = 1e-12  # of the largest width, the least: a row of a single point would outweigh all others in double precision
TINY = float(np.finfo(float).tiny)


@final
@dataclass(frozen=True, eq=False)
class StateRows:
    """Bounds of ``C x`` at the breakpoints of the control at which a constraint holds.

    Parameters
    ----------
    rows : ndarray, shape (r, d)
        Rows ``C``.
    lower, upper : ndarray, shape (r,)
        Least and largest values.
    holds : ndarray of bool, shape (K + 1,)
        True at the breakpoints at which the constraint holds.
    """

    rows: Array
    lower: Array
    upper: Array
    holds: np.ndarray


@final
@dataclass(frozen=True, eq=False)
class SampledPlant:
    """Plant from breakpoint to breakpoint of the control: ``x_{k+1} = Phi_k x_k + Gamma_k u_k + e_k``.

    Parameters
    ----------
    Phi : ndarray, shape (K, d, d)
        Transitions.
    Gamma : ndarray, shape (K, d, m)
        Responses to a control that is constant on its piece.
    lower, upper : ndarray, shape (K, d)
        Bounds of ``e_k``, what drift and disturbance add.
    """

    Phi: Array
    Gamma: Array
    lower: Array
    upper: Array

    @staticmethod
    def of(response: Response, control: Dictionary, low: Array, high: Array) -> SampledPlant:
        """Return the sampled plant of a known system, for disturbances between ``low (mw,)`` and ``high (mw,)``."""
        grid, steps, (K, d) = response.grid, response.steps(KNOWN), (control.pieces, response.initial_state.size)
        inputs, m = steps.inputs[0], response.system.controls - grid.constants
        Phi, Gamma = np.tile(np.eye(d), (K, 1, 1)), np.zeros((K, d, m))
        middle, radius = np.zeros((K, d)), np.zeros((K, d))
        for piece, (k, step) in enumerate(zip(grid.control_piece.tolist(), response.which.tolist(), strict=True)):
            forced = steps.Gamma[0, step] @ inputs[grid.modes[piece]]
            B, drift, E = np.split(forced, [m, m + grid.constants], axis=1)
            flow = steps.Phi[0, step]
            Phi[k], Gamma[k] = flow @ Phi[k], flow @ Gamma[k] + B
            middle[k] = flow @ middle[k] + drift.sum(axis=1) + E @ ((low + high) / 2)
            radius[k] = np.abs(flow) @ radius[k] + np.abs(E) @ ((high - low) / 2)
        return SampledPlant(Phi, Gamma, middle - radius, middle + radius)

    def regulator(self, rows: Array, controls: Array, lengths: Array) -> Array:
        """Return the gains ``(K, m, d)`` of the regulator.

        Parameters
        ----------
        rows : ndarray, shape (r, d)
            Rows on the state, each divided by its bound.
        controls : ndarray, shape (m,)
            Largest controls.
        lengths : ndarray, shape (K,)
            Lengths of the pieces, as shares of the horizon.

        Returns
        -------
        ndarray
            Gains.
        """
        K, d, m = self.Gamma.shape
        Q, R = rows.T @ rows, np.diag(1.0 / np.where(controls > 0.0, controls, 1.0) ** 2)
        gains, P = np.zeros((K, m, d)), np.eye(d)
        for k in range(K - 1, -1, -1):
            weighted = self.Gamma[k].T @ P
            gains[k] = -np.linalg.solve(lengths[k] * R + weighted @ self.Gamma[k], weighted @ self.Phi[k])
            closed = self.Phi[k] + self.Gamma[k] @ gains[k]
            P = lengths[k] * (Q + gains[k].T @ R @ gains[k]) + closed.T @ P @ closed
            P = (P + P.T) / 2
        return gains

    def bound(
        self,
        gains: Array,
        initial: tuple[Array, Array],
        controls: tuple[Array, Array],
        constraints: Sequence[StateRows],
    ) -> Array:
        """Return a bound ``(m,)`` of ``|K_k x_k|`` under every control that keeps the constraints.

        Every state is bounded in coordinates that part what decays from what grows: from the states of the breakpoint
        before, from those of the breakpoint after, and by the constraints at the next few breakpoints.

        Parameters
        ----------
        gains : ndarray, shape (K, m, d)
            Gains ``K_k``.
        initial, controls : pairs of ndarrays
            Least and largest initial states ``(d,)`` and controls ``(m,)``.
        constraints : sequence of StateRows
            Constraints on the state.

        Returns
        -------
        ndarray
            Bound of every channel.
        """
        W = part_modes(self.Phi[0])
        inverse = np.linalg.inv(W)
        entering = [_image(W, low, high) for low, high in zip(self.lower, self.upper, strict=True)]
        lower, upper = (np.array(ends) for ends in zip(*entering, strict=True))
        modal = SampledPlant(W @ self.Phi @ inverse, W @ self.Gamma, lower, upper)
        rows = [replace(each, rows=each.rows @ inverse) for each in constraints]
        return OUTWARD * modal._bound_modes(gains @ inverse, _image(W, *initial), controls, rows)

    def _bound_modes(
        self,
        gains: Array,
        initial: tuple[Array, Array],
        controls: tuple[Array, Array],
        constraints: Sequence[StateRows],
    ) -> Array:
        K = len(self.Phi)
        boxes = [initial]
        for k in range(K + 1):
            for span in SPANS:
                boxes[k] = _narrow(boxes[k], *self._read_constraints(k, span, controls, constraints))
            if k < K:
                boxes.append(_add(self._step(k, controls), *_image(self.Phi[k], *boxes[k])))
        for k in range(K - 1, -1, -1):
            low, high = self._step(k, controls)
            boxes[k] = _narrow(boxes[k], self.Phi[k], boxes[k + 1][0] - high, boxes[k + 1][1] - low)
        reach = np.zeros(gains.shape[1])
        for gain, (low, high) in zip(gains, boxes, strict=False):
            reach = np.maximum(reach, np.abs(_image(gain, low, high)).max(axis=0))
        return reach

    def _step(self, k: int, controls: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return the least and the largest of what is added to the state on piece ``k``."""
        return _add(_image(self.Gamma[k], *controls), self.lower[k], self.upper[k])

    def _read_constraints(
        self, k: int, span: int, controls: tuple[Array, Array], constraints: Sequence[StateRows]
    ) -> tuple[Array, Array, Array]:
        """Return rows on the state at breakpoint ``k`` with their least and largest values, from the constraints at
        this and the next ``span`` breakpoints."""
        d, last = self.Phi.shape[1], min(k + span, len(self.Phi))
        rows, lower, upper, flow = [np.zeros((0, d))], [np.zeros(0)], [np.zeros(0)], np.eye(d)
        terms: list[tuple[Array, Array, Array]] = []  # responses, and the least and largest of what drives them
        for j in range(k, last + 1):
            for constraint in constraints:
                if not constraint.holds[j]:
                    continue
                added = np.zeros(len(constraint.rows)), np.zeros(len(constraint.rows))
                for response, low, high in terms:
                    added = _add(added, *_image(constraint.rows @ response, low, high))
                rows.append(constraint.rows @ flow)
                lower.append(constraint.lower - added[1])
                upper.append(constraint.upper - added[0])
            if j < last:
                terms = [(self.Phi[j] @ response, low, high) for response, low, high in terms]
                terms += [(self.Gamma[j], *controls), (np.eye(d), self.lower[j], self.upper[j])]
                flow = self.Phi[j] @ flow
        return np.vstack(rows), np.concatenate(lower), np.concatenate(upper)


def part_modes(Phi: Array) -> Array:
    """Return coordinates ``W (d, d)`` of the states, ``z = W x``, in which a transition ``(d, d)`` parts what decays
    from what grows (Golub and Van Loan 2013, section 7.6.3)."""
    T, Q, decaying = schur(Phi, output="real", sort="iuc")
    coupling = solve_sylvester(T[:decaying, :decaying], -T[decaying:, decaying:], -T[:decaying, decaying:])
    basis = np.eye(len(T))
    basis[:decaying, decaying:] = coupling
    return np.asarray(np.linalg.inv(Q @ basis))


def _narrow(box: tuple[Array, Array], rows: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return bounds of a state ``x`` in a ``box`` with ``rows x`` between ``lower`` and ``upper``.

    With all rows ``R``, those of the box among them, ``x = M R x + (1 - M R) x`` for any ``M``. Here ``M`` is that of
    least squares, in which every row is weighted by the inverse of its width.
    """
    d = box[0].size
    table, low, high = np.vstack([np.eye(d), rows]), np.append(box[0], lower), np.append(box[1], upper)
    widths = high - low
    weights = 1.0 / np.maximum(widths, LEAST * widths.max() + TINY)
    M = np.linalg.pinv(weights[:, None] * table) * weights
    ends = _add(_image(M, low, high), *_image(np.eye(d) - M @ table, *box))
    low, high = np.maximum(box[0], ends[0]), np.minimum(box[1], ends[1])
    return np.minimum(low, high), np.maximum(low, high)  # which cross only where nothing is feasible, or by rounding


def _image(matrix: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the least and the largest values of ``matrix x`` for ``x`` between ``low`` and ``high``."""
    middle, radius = matrix @ ((low + high) / 2), np.abs(matrix) @ ((high - low) / 2)
    return middle - radius, middle + radius


def _add(interval: tuple[Array, Array], low: Array, high: Array) -> tuple[Array, Array]:
    """Return the sum of an interval and of ``[low, high]``."""
    return interval[0] + low, interval[1] + high
