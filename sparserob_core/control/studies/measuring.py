"""The control of a policy while the system runs: from the states that are measured, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.feedback.innovations import KNOWN
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.sip.convex_set import Array


@final
@dataclass(eq=False)
class Measuring:
    """Of many systems at once, what acts on each piece of the grid, from the states at the control's breakpoints.

    ``nominal (m, K)``, ``gains (K, K, m, d)``. Pieces are asked for in order; piece 0 begins anew.
    """

    model: Transcription
    nominal: Array
    gains: Array
    _predicted: Array | None = None
    _commands: dict[int, Array] = field(default_factory=dict)  # of the pieces of the control so far, ``(m, n)`` each
    _innovations: list[Array] = field(default_factory=list)

    @staticmethod
    def of(model: Transcription, decision: Array) -> Measuring:
        """The control of a decision."""
        assert model.feedback is not None
        return Measuring(model, model.pieces(decision), model.feedback.loop.gains(decision))

    def seen(self, state: Array) -> list[Array]:
        """The innovations ``(d,)`` so far, when ``state (d,)`` is what the piece that comes next begins in; nothing is
        changed."""
        assert self._predicted is not None
        return [*(one[:, 0] for one in self._innovations), state - self._predicted[:, 0]]

    def command(self, k: int) -> Array:
        """The control ``(m, n)`` on its piece ``k``, which has begun."""
        return self._commands[k]

    def __call__(self, piece: int, state: Array) -> Array:
        """What acts through the columns of ``B`` on a piece of the grid that begins in ``state (d, n)``: ``(mc,
        n)``."""
        response, loop = self.model.response, self.model.feedback
        assert loop is not None
        grid, steps = response.grid, response.steps(KNOWN)
        commanded, acting = self.commanded, int(grid.control_piece[piece])
        k = int(commanded[piece])
        if piece == 0 or k != commanded[piece - 1]:
            if piece == 0:
                begins = loop.loop.begins.any()  # from one initial state nothing is new in it
                self._innovations = [state - loop.loop.start[:, None] if begins else np.zeros_like(state)]
            else:
                assert self._predicted is not None
                self._innovations.append(state - self._predicted)
            u = np.repeat(self.nominal[:, k, None], state.shape[1], axis=1)
            for j, innovation in enumerate(self._innovations):
                if self.gains[k, j].any():
                    u = u + self.gains[k, j] @ innovation
            self._commands = {**(self._commands if piece else {}), k: u}
            self._predicted = state
        assert self._predicted is not None
        length, mode = int(response.which[piece]), int(grid.modes[piece])
        before = np.zeros(0) if grid.before is None else grid.before
        u = self._commands[acting] if acting >= 0 else np.repeat(before[:, None], state.shape[1], axis=1)
        inputs = np.vstack([u, np.ones((grid.constants, state.shape[1]))])
        B, E = (grid.of_modes(matrices)[mode] for matrices in (steps.B[0], steps.E[0]))
        drive = B @ inputs + (E @ loop.loop.middles[piece])[:, None]
        self._predicted = steps.Phi[0, length] @ self._predicted + steps.Gamma[0, length] @ drive
        return np.asarray(inputs)

    @cached_property
    def commanded(self) -> np.ndarray:
        """Which piece of the control is commanded on every piece of the grid, ``(L,)``."""
        return self.model.response.grid.commanded(self.model.control.breakpoints)
