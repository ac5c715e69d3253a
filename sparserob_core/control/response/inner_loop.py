"""State feedback that acts before the decision: ``u_k = K_k x(tau_k) + v_k``, so that an unstable plant is steered as a
stable one.

The states are measured at the breakpoints of the control, and the control is constant between them. So the plant with
this feedback is again linear from breakpoint to breakpoint, with ``Phi_k + Gamma_k B K_k`` in place of ``Phi_k``. All
numbers are computed from this sum directly. Products of the powers of ``Phi_k``, which grow like ``e^{At}``, never
appear.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, final

import numpy as np

from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.sip.convex_set import Array


class Weights(NamedTuple):
    """Functionals ``c'x(t)`` of ``k`` indices as weights: ``free (k, d)`` on the initial state, ``control (k, L, m)``
    on the inputs through the columns of ``B`` on every piece, and ``disturbance (k, L, mw)`` on those through the
    columns of ``E``."""

    free: Array
    control: Array
    disturbance: Array


class Stepped(Protocol):
    """Transitions of a system on a grid: a `Propagator`."""

    @property
    def grid(self) -> TimeGrid:
        """Grid of the pieces."""

    @property
    def which(self) -> np.ndarray:
        """Index ``(L,)`` of every piece among the distinct modes and lengths."""

    def steps(self, parameters: Array) -> Any:
        """Return the `PieceTransitions`."""

    def weights(self, times: Array, directions: Array, parameters: Array) -> Weights:
        """Return functionals without a feedback, as weights."""

    def weigh_part(self, pieces: np.ndarray, directions: Array, within: Array) -> tuple[Array, Array]:
        """Return the weights of functionals within their pieces."""


@final
@dataclass(frozen=True, eq=False)
class InnerLoop:
    """Feedback ``K_k x(tau_k)`` of the measured state, which is added to every decided control.

    Parameters
    ----------
    gains : ndarray, shape (K, m, d)
        Gain at every breakpoint of the control; the array is empty where there is no such feedback.
    reach : ndarray, shape (m,)
        Bound of ``|K_k x(tau_k)|`` under every policy that keeps the constraints.
    """

    gains: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))
    reach: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def acts(self) -> bool:
        """True where there is such a feedback."""
        return bool(self.gains.size)

    @property
    def noun(self) -> str:
        """Name of the part of the control that acts before anything is answered."""
        return "the inner loop" if self.acts else "the nominal control"

    def in_units(self, units: Any) -> InnerLoop:
        """Return the same feedback in other `Units`."""
        if not self.acts:
            return self
        gains = self.gains * units.states / units.controls[:, None]
        return replace(self, gains=gains, reach=self.reach / units.controls)

    def weights(self, propagator: Stepped, times: Array, directions: Array, parameters: Array) -> Weights:
        """Return the functional ``c'x(t)`` of each index as weights on the initial state, on the decided part ``v`` of
        the control and on all other inputs (`Propagator.weights`)."""
        if not self.acts:
            return propagator.weights(times, directions, parameters)
        grid = propagator.grid
        pieces = grid.locate(times)
        within = np.clip(times - grid.breakpoints[pieces], 0.0, None)
        rows, last = propagator.weigh_part(pieces, directions, within)
        inputs = np.zeros((times.size, grid.pieces, last.shape[1]))
        inputs[np.arange(times.size), pieces] = last
        controls = np.zeros((times.size, grid.pieces, self.gains.shape[1]))
        return self._propagate(propagator, rows, inputs, pieces, controls)

    def weigh_controls(self, propagator: Stepped, controls: Array) -> Weights:
        """Return the functional ``sum_k W_k K_k x(tau_k)`` of each row, for weights ``controls (r, K, m)`` on the
        pieces of the control, as weights on the initial state and on inputs."""
        grid = propagator.grid
        on_grid = np.zeros((len(controls), grid.pieces, self.gains.shape[1]))
        on_grid[:, self._firsts(grid)] = controls
        steps = propagator.steps(np.zeros((1, 0)))
        rows = np.zeros((len(controls), self.gains.shape[2]))
        inputs = np.zeros((len(controls), grid.pieces, steps.inputs.shape[-1]))
        last = np.full(len(controls), grid.pieces)
        return self._propagate(propagator, rows, inputs, last, on_grid)

    def _propagate(
        self, propagator: Stepped, rows: Array, inputs: Array, pieces: np.ndarray, controls: Array
    ) -> Weights:
        """Propagate ``rows (k, d)`` back to time 0, each from the beginning of one of the ``pieces (k,)``.

        The weights ``inputs (k, L, w)`` of the pieces where rows begin are given; those of earlier pieces are written
        to it. ``controls (k, L, m)`` are further weights on ``K_k x(tau_k)``, at the pieces where controls begin.
        """
        grid, steps, m = propagator.grid, propagator.steps(np.zeros((1, 0))), self.gains.shape[1]
        over, is_first, width = steps.input_transitions[0], self._begins(grid), inputs.shape[2]
        feedback, channels = np.zeros((len(rows), m)), width - self._count_disturbances(propagator)
        for piece in range(grid.pieces - 1, -1, -1):
            is_earlier = pieces > piece
            products = rows[is_earlier] @ over[propagator.which[piece]]
            inputs[is_earlier, piece], rows[is_earlier] = products[:, :width], products[:, width:]
            feedback += inputs[:, piece, :m]
            if is_first[piece]:
                rows += (feedback + controls[:, piece]) @ self.gains[grid.control_piece[piece]]
                feedback[:] = 0.0
        return Weights(rows, inputs[:, :, :channels], inputs[:, :, channels:])

    def states(self, propagator: Stepped, initial: Array, forces: Array) -> Array:
        """Return the states ``(v, L + 1, d)`` at the breakpoints of the grid, from ``initial (v, d)`` and what drives
        the states on every piece without this feedback, ``forces (v, L, d)``."""
        grid, steps = propagator.grid, propagator.steps(np.zeros((1, 0)))
        path, is_first = np.empty((len(forces), grid.pieces + 1, initial.shape[1])), self._begins(grid)
        path[:, 0], feedback = initial, np.zeros((len(forces), self.gains.shape[1]))
        for piece, step in enumerate(propagator.which.tolist()):
            if is_first[piece]:
                feedback = path[:, piece] @ self.gains[grid.control_piece[piece]].T
            force = forces[:, piece] + feedback @ self.matrix(propagator, piece).T
            path[:, piece + 1] = path[:, piece] @ steps.Phi[0, step].T + force @ steps.Gamma[0, step].T
        return path

    def matrix(self, propagator: Stepped, piece: int) -> Array:
        """Return the columns ``(d, m)`` of ``B`` through which the control acts on a piece of the grid."""
        steps, grid = propagator.steps(np.zeros((1, 0))), propagator.grid
        return np.asarray(steps.inputs[0, grid.modes[piece]][:, : self.gains.shape[1]])

    @staticmethod
    def _begins(grid: TimeGrid) -> np.ndarray:
        """Return the truth values ``(L,)`` of whether a piece of the control begins with a piece of the grid."""
        is_first: np.ndarray = np.diff(grid.control_piece, prepend=-1) > 0
        return is_first

    @classmethod
    def _firsts(cls, grid: TimeGrid) -> np.ndarray:
        """Return the piece of the grid with which each piece of the control begins, ``(K,)``."""
        return np.flatnonzero(cls._begins(grid))

    @staticmethod
    def _count_disturbances(propagator: Stepped) -> int:
        steps = propagator.steps(np.zeros((1, 0)))
        return int(steps.E.shape[2] // steps.A.shape[1])


NO_INNER_LOOP = InnerLoop()
