"""The difference between the delivered control and the command: on which pieces, and by what part of which values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@final
@dataclass(frozen=True, eq=False)
class Delivery:
    """The delivered control: a mean, and a deviation of any form within shares of a linear map of the command.

    Attributes
    ----------
    shares
        The largest deviation ``(m,)`` of every channel, as a share of the value of `scaling`.
    jitter
        The time after every change of the command during which the delivered value is between the old and the new one.
        With 0 the mean is the command itself, and scales the deviation.
    """

    shares: Array
    jitter: float = 0.0

    def mean(self, control: Dictionary) -> Dictionary:
        """Return the mean of what is delivered for every function of a dictionary, on the pieces of `late_breakpoints`:
        half of the old and half of the new value, while a change may be late."""
        if not self.jitter:
            return control
        breakpoints, owner = late_breakpoints(control.breakpoints, self.jitter)
        after = np.flatnonzero(np.diff(owner, prepend=0))
        commanded = control.sparse.tocsc()
        values = commanded[:, owner].tolil()
        values[:, after] = (commanded[:, owner[after] - 1] + commanded[:, owner[after]]) / 2.0
        return Dictionary(breakpoints, values.tocsr())

    def scaling(self, mean: Dictionary) -> csr_array:
        """Return the map ``(K, K)`` from values of the `mean` to the values that scale the deviation: these values
        themselves, or half of every change while it may be late."""
        from scipy.sparse import csr_array, eye_array

        K = mean.pieces
        if not self.jitter:
            return csr_array(eye_array(K))
        late = np.arange(1, K, 2)
        halves, columns = np.full(late.size, 0.5), np.tile(late, 2)
        entries = np.concatenate([halves, -halves]), (np.concatenate([late + 1, late - 1]), columns)
        return csr_array(entries, shape=(K, K))


def late_breakpoints(breakpoints: Array, jitter: float) -> tuple[Array, np.ndarray]:
    """Return the breakpoints of a command with the times until which every change may be late, and the piece of the
    command on every interval between them."""
    changes = breakpoints[1:-1]
    times = np.concatenate([breakpoints[:1], np.column_stack([changes, changes + jitter]).ravel(), breakpoints[-1:]])
    return times, (np.arange(times.size - 1) + 1) // 2
