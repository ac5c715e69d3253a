"""How sparse a control is in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparserob_core.sip.convex_set import Array

ZERO = 1e-6


@dataclass(frozen=True)
class Sparsity:
    """``active_fraction``: the share of the horizon during which any channel acts; ``switches``: how often a channel
    changes its value.

    Values and changes up to ``1e-6`` of the control's largest value (of 1, if that is larger) count as none.
    """

    active_fraction: float
    switches: int


def sparsity(control: Array, breakpoints: Array) -> Sparsity:
    """The `Sparsity` of a control ``(m, K)`` on the pieces between ``breakpoints (K + 1,)``."""
    threshold = ZERO * max(1.0, float(np.abs(control).max(initial=0.0)))
    active = (np.abs(control) > threshold).any(axis=0)
    lengths = np.diff(breakpoints)
    return Sparsity(
        active_fraction=float(lengths[active].sum() / lengths.sum()),
        switches=int((np.abs(np.diff(control, axis=1)) > threshold).sum()),
    )
