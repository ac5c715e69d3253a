"""The sparsity of a control in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.result import Result

NEGLIGIBLE_CONTROL_SHARE = 1e-6  # of the largest control, or of 1: a smaller control counts as off
PROVEN, SAME = "L1 is sparsest here: proven", 1e-6


@dataclass(frozen=True)
class Sparsity:
    """The sparsity of a control.

    Parameters
    ----------
    active_fraction : float
        The share of the horizon during which any channel acts.
    switches : int
        The number of times that a channel changes its value.

    Notes
    -----
    Values and changes up to ``1e-6`` of the control's largest value (of 1, if that is larger) count as none.
    """

    active_fraction: float
    switches: int


def sparsity(control: Array, breakpoints: Array) -> Sparsity:
    """Return the `Sparsity` of a control ``(m, K)`` on the pieces between ``breakpoints (K + 1,)``."""
    threshold = NEGLIGIBLE_CONTROL_SHARE * max(1.0, float(np.abs(control).max(initial=0.0)))
    active = (np.abs(control) > threshold).any(axis=0)
    lengths = np.diff(breakpoints)
    return Sparsity(
        active_fraction=float(lengths[active].sum() / lengths.sum()),
        switches=int((np.abs(np.diff(control, axis=1)) > threshold).sum()),
    )


def verdict(result: Result) -> str | None:
    """Return in words whether an optimum of the L1 norm is sparsest, as far as a result shows it; ``None`` where it
    does not.

    It is proven where no admissible control acts less than an optimum of the usual cost. Where a control acts less, the
    difference is given in the units of time.
    """
    sparsest, activity = result.sparsest, result.activity
    if result.status != "certified" or activity is None or activity.upper is None or not activity.norm:
        return None
    if sparsest is not None:
        if sparsest.plain_count is None or sparsest.plain is None:
            return None
        saving = sparsest.plain_count - result.cost
        if saving <= SAME * sparsest.plain_count:
            return PROVEN
        is_same_cost = sparsest.norm - sparsest.plain <= SAME * max(abs(sparsest.plain), abs(sparsest.norm))
        note = ", at the same cost, for the optimum is not unique" if is_same_cost else ""
        return f"the sparsest control acts {saving:.6g} less than the optimum: here it is{note}"
    if activity.decision is not None:
        return "not decided: another admissible control acts less; method sparsest finds the one that acts least"
    if activity.upper - activity.lower <= SAME * activity.upper:
        return PROVEN
    return "not decided: method sparsest finds the control that acts least"
