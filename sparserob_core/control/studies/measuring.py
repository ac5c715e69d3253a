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
    """Of many systems at once, what acts on each piece of the grid, from the states at the control's breakpoints.

    ``nominal (m, K)``, ``gains (K, K, m, p)``; ``noises (K, p, n)``: those of what is measured, their middle unless
    given. Pieces are asked for in order; piece 0 begins anew.
    """

    model: Transcription
    nominal: Array
    gains: Array
    noises: Array | None = None
    _predicted: Array | None = None
    _commands: dict[int, Array] = field(default_factory=dict)  # of the pieces of the control so far, ``(m, n)`` each
    _innovations: list[Array] = field(default_factory=list)

    @staticmethod
    def of(model: Transcription, decision: Array, noises: Array | None = None) -> Measuring:
        """The control of a decision."""
        return Measuring(model, model.pieces(decision), model.answering.loop.gains(decision), noises)

    def seen(self, measured: Array) -> list[Array]:
        """The innovations ``(p,)`` so far, when ``measured (p,)`` is what is seen as the next piece begins; nothing is
        changed."""
        return [*(one[:, 0] for one in self._innovations), self._new(measured[:, None], self._observed())[:, 0]]

    def _loop(self) -> ClosedLoop:
        return self.model.answering.loop

    def outputs(self, k: int, state: Array) -> Array:
        """What is measured of states ``(d, n)`` as piece ``k`` of the control begins, ``(p, n)``."""
        observer = self._loop().observer
        return state if observer is None else observer.outputs(state, None if self.noises is None else self.noises[k])

    def _new(self, measured: Array, predicted: Array) -> Array:
        """What is new in what is measured ``(p, n)`` as the next piece begins, where ``(d, n)`` is ``predicted``."""
        loop = self._loop()
        if loop.observer is not None:
            return measured - loop.observer.outputs(predicted)
        if self._predicted is None and not loop.begins.any():  # from one initial state nothing is new in it
            return np.zeros_like(measured)
        return measured - predicted

    def _observed(self) -> Array:
        """What the state ``(d, n)`` is predicted to be as the next piece begins."""
        observer = self._loop().observer
        if self._predicted is None:
            return self._loop().start[:, None]
        if observer is None or not self._innovations:
            return self._predicted
        return np.asarray(self._predicted + observer.L[len(self._innovations) - 1] @ self._innovations[-1])

    def predicted(self) -> Array:
        """What is measured, ``(p, n)``, as the next piece begins where nothing is new in it."""
        observer, state = self._loop().observer, self._observed()
        return state if observer is None else observer.outputs(state)

    def command(self, k: int) -> Array:
        """The control ``(m, n)`` on its piece ``k``, which has begun."""
        return self._commands[k]

    def __call__(self, piece: int, state: Array) -> Array:
        """What acts through the columns of ``B`` on a piece of the grid that begins in ``state (d, n)``: ``(mc,
        n)``."""
        return self.after(piece, lambda k: self.outputs(k, state))

    def after(self, piece: int, measured: Callable[[int], Array]) -> Array:
        """The same of what is ``measured (p, n)`` as a piece of the control begins."""
        response, loop = self.model.response, self._loop()
        grid, steps = response.grid, response.steps(KNOWN)
        commanded, acting = self.commanded, int(grid.control_piece[piece])
        k = int(commanded[piece])
        if piece == 0 or k != commanded[piece - 1]:
            if piece == 0:
                self._predicted, self._innovations = None, []
            now, predicted = measured(k), self._observed()
            self._innovations.append(self._new(now, predicted))
            u = np.repeat(self.nominal[:, k, None], now.shape[1], axis=1)
            for j, innovation in enumerate(self._innovations):
                if self.gains[k, j].any():
                    u = u + self.gains[k, j] @ innovation
            self._commands = {**(self._commands if piece else {}), k: u}
            self._predicted = (
                now if loop.observer is None else np.broadcast_to(predicted, (len(predicted), now.shape[1]))
            )
        assert self._predicted is not None
        length, mode = int(response.which[piece]), int(grid.modes[piece])
        before, count = np.zeros(0) if grid.before is None else grid.before, self._predicted.shape[1]
        u = self._commands[acting] if acting >= 0 else np.repeat(before[:, None], count, axis=1)
        inputs = np.vstack([u, np.ones((grid.constants, count))])
        B, E = (grid.of_modes(matrices)[mode] for matrices in (steps.B[0], steps.E[0]))
        drive = B @ inputs + (E @ loop.middles[piece])[:, None]
        self._predicted = steps.Phi[0, length] @ self._predicted + steps.Gamma[0, length] @ drive
        return np.asarray(inputs)

    @cached_property
    def commanded(self) -> np.ndarray:
        """Which piece of the control is commanded on every piece of the grid, ``(L,)``."""
        return self.model.response.grid.commanded(self.model.control.breakpoints)
