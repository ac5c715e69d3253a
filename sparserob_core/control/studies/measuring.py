"""The control of a policy while the system runs: from the states that are measured, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.feedback.innovations import KNOWN
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.feedback.closed_loop import ClosedLoop


@final
@dataclass(eq=False)
class Measuring:
    """Inputs of many systems at once on each piece of the grid, computed from the states at the control's breakpoints.

    The pieces must be asked for in order; piece 0 begins anew.

    Parameters
    ----------
    model : Transcription
        The problem.
    nominal : ndarray, shape (m, K)
        Nominal control; with an inner loop its decided part.
    gains : ndarray, shape (K, K, m, p)
        Gains of the innovations.
    noises : ndarray, shape (K, p, n), optional
        Noises of the measurements; their middle by default.
    """

    model: Transcription
    nominal: Array
    gains: Array
    noises: Array | None = None
    _prediction: Array | None = None
    _commands: dict[int, Array] = field(default_factory=dict)  # of the pieces of the control so far, ``(m, n)`` each
    _innovations: list[Array] = field(default_factory=list)

    @staticmethod
    def of(model: Transcription, decision: Array, noises: Array | None = None) -> Measuring:
        """Return the control of a decision."""
        loop = model.answering.loop
        nominal = np.ascontiguousarray(loop.decided(decision)[:, :, 0].T)
        return Measuring(model, nominal, loop.gains(decision), noises)

    def list_innovations(self, measured: Array) -> list[Array]:
        """Return all innovations ``(p,)`` so far, if ``measured (p,)`` is the measurement as the next piece begins,
        without changing the state of this object."""
        return [
            *(innovation[:, 0] for innovation in self._innovations),
            self._compute_innovations(measured[:, None], self._predict_states())[:, 0],
        ]

    def _get_loop(self) -> ClosedLoop:
        return self.model.answering.loop

    def outputs(self, k: int, state: Array) -> Array:
        """Return the measurements ``(p, n)`` of states ``(d, n)`` as piece ``k`` of the control begins."""
        observer = self._get_loop().observer
        return state if observer is None else observer.outputs(state, None if self.noises is None else self.noises[k])

    def _compute_innovations(self, measured: Array, predicted: Array) -> Array:
        """Return the innovations ``(p, n)`` of the measurements ``(p, n)`` as the next piece begins, where the states
        ``(d, n)`` are ``predicted``."""
        loop = self._get_loop()
        if loop.observer is not None:
            return measured - loop.observer.outputs(predicted)
        if self._prediction is None and not loop.begins.any():  # from one initial state nothing is new in it
            return np.zeros_like(measured)
        return measured - predicted

    def _predict_states(self) -> Array:
        """Return the prediction of the states ``(d, n)`` as the next piece begins."""
        observer = self._get_loop().observer
        if self._prediction is None:
            return self._get_loop().start[:, None]
        if observer is None or not self._innovations:
            return self._prediction
        return np.asarray(self._prediction + observer.L[len(self._innovations) - 1] @ self._innovations[-1])

    def _estimate_states(self, k: int, measured: Array, predicted: Array) -> Array:
        """Return the states ``(d, n)`` that the inner loop acts on: those that are ``measured``, or of outputs an
        estimate."""
        observer = self._get_loop().observer
        return measured if observer is None else observer.estimate(k, predicted, self._innovations)

    def predicted(self) -> Array:
        """Return the prediction of the measurements ``(p, n)`` as the next piece begins, at which the innovation is
        0."""
        observer, state = self._get_loop().observer, self._predict_states()
        return state if observer is None else observer.outputs(state)

    def command(self, k: int) -> Array:
        """The control ``(m, n)`` on its piece ``k``, which has begun."""
        return self._commands[k]

    def __call__(self, piece: int, state: Array) -> Array:
        """Return the inputs ``(mc, n)`` through the columns of ``B`` on a piece of the grid that begins in
        ``state (d, n)``."""
        return self.after(piece, lambda k: self.outputs(k, state))

    def after(self, piece: int, measured: Callable[[int], Array]) -> Array:
        """Return the inputs ``(mc, n)`` on a piece of the grid, from the measurements ``(p, n)`` that ``measured``
        gives as a piece of the control begins."""
        response, loop = self.model.response, self._get_loop()
        grid, steps = response.grid, response.steps(KNOWN)
        commanded, acting = self.commanded, int(grid.control_piece[piece])
        k = int(commanded[piece])
        if piece == 0 or k != commanded[piece - 1]:
            if piece == 0:
                self._prediction, self._innovations = None, []
            now, predicted = measured(k), self._predict_states()
            self._innovations.append(self._compute_innovations(now, predicted))
            u = np.repeat(self.nominal[:, k, None], now.shape[1], axis=1)
            if loop.inner.acts:
                u = u + loop.inner.gains[k] @ self._estimate_states(k, now, predicted)
            for j, innovation in enumerate(self._innovations):
                if self.gains[k, j].any():
                    u = u + self.gains[k, j] @ innovation
            self._commands = {**(self._commands if piece else {}), k: u}
            self._prediction = (
                now if loop.observer is None else np.broadcast_to(predicted, (len(predicted), now.shape[1]))
            )
        assert self._prediction is not None
        length, mode = int(response.which[piece]), int(grid.modes[piece])
        before, count = np.zeros(0) if grid.before is None else grid.before, self._prediction.shape[1]
        u = self._commands[acting] if acting >= 0 else np.repeat(before[:, None], count, axis=1)
        inputs = np.vstack([u, np.ones((grid.constants, count))])
        B, E = (grid.of_modes(matrices)[mode] for matrices in (steps.B[0], steps.E[0]))
        drive = B @ inputs + (E @ loop.middles[piece])[:, None]
        self._prediction = steps.Phi[0, length] @ self._prediction + steps.Gamma[0, length] @ drive
        return np.asarray(inputs)

    @cached_property
    def commanded(self) -> np.ndarray:
        """Piece of the control that is commanded on every piece of the grid, ``(L,)``."""
        return self.model.response.grid.commanded(self.model.control.breakpoints)
