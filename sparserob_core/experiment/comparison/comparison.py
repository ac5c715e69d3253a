"""Runs side by side, as a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.experiment.comparison.curve import Curve


@final
@dataclass(frozen=True, eq=False)
class Comparison:
    """Runs of one problem, each with its label. ``exact`` is the mean of the two bounds of the run ``certified`` (its
    number), the one with the least gap; nan and ``None`` when no run is certified."""

    curves: Sequence[Curve]
    labels: Sequence[str]
    exact: float = np.nan
    certified: int | None = None
    undrawn: str = ""

    __repr__ = brief
    """Why there is no figure, where one was asked for."""

    @property
    def title(self) -> str:
        """The title that the runs have in common; else empty."""
        titles = {curve.title for curve in self.curves}
        return titles.pop() if len(titles) == 1 else ""

    @property
    def cost_unit(self) -> str:
        """The unit of the costs, where it is known and the same of all."""
        units = {curve.cost_unit for curve in self.curves}
        return units.pop() if len(units) == 1 else ""

    def share(self, bound: float) -> float:
        """The share of the exact value that a lower bound reaches: 1 less what it falls short, relative to the exact
        value's size."""
        return 1.0 - (self.exact - bound) / abs(self.exact) if self.exact else np.nan

    def within(self, curve: Curve, share: float) -> float:
        """The evaluations after which the curve came within that share of the exact value; nan when it never did."""
        needed = curve.reached(self.exact - share * abs(self.exact))
        return needed if np.isfinite(needed) else np.nan
