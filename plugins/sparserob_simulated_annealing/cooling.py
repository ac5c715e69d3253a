"""Temperatures of an annealing walk: geometric, logarithmic, or driven by the gap between the walk and its record."""

from __future__ import annotations

from math import isfinite, log
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sparserob_simulated_annealing import SimulatedAnnealing


def first_temperature(options: SimulatedAnnealing, values: np.ndarray) -> float:
    """Return the given temperature, or ``temperature_share`` times the median distance of the finite values from their
    median. If these are all equal, return the size of the first of them, and 1 if that is 0."""
    if options.initial_temperature is not None:
        return options.initial_temperature
    finite = values[np.isfinite(values)]
    size = float(np.abs(finite[:1]).max(initial=0.0)) or 1.0
    if finite.size < 2:
        return size
    distances = np.abs(finite - np.median(finite))
    spread = float(np.median(distances)) or float(distances.max())
    return options.temperature_share * spread if spread > 0.0 and isfinite(spread) else size


class Cooling:
    """The temperatures of one cycle of ``length`` evaluations, which starts at ``start``.

    geometric: ``start * ratio^(k / length)``, ``ratio`` chosen so that every cycle ends at ``lowest``. logarithmic:
    ``start log(2) / log(k + 2)``. gap: ``gap_factor * max(gap, e_k)^gap_power``, where ``gap = record - current`` and
    ``e_k`` is the geometric schedule (Locatelli 2000).
    """

    def __init__(self, options: SimulatedAnnealing, start: float, lowest: float, length: int) -> None:
        self.options, self.start, self.length = options, start, length
        self.decay = log(min(1.0, max(lowest / start, 1e-300))) / max(1, length)

    def temperature(self, k: int, gap: float) -> float:
        """Return the temperature at evaluation ``k = 0, 1, ...`` of the cycle of a walk that is ``gap >= 0`` below its
        record."""
        if self.options.cooling == "logarithmic":
            return self.start * log(2.0) / log(k + 2.0)
        level = self.start * float(np.exp(self.decay * k))
        if self.options.cooling == "gap":
            return float(
                self.options.gap_factor * max(gap if isfinite(gap) else level, level) ** self.options.gap_power
            )
        return level
