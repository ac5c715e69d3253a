"""Runs side by side, as a record."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.experiment.comparison.curve import Curve
from sparserob_core.experiment.config.plain import IRRELEVANT, value_text


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
    """Why there is no figure, where one was asked for."""

    __repr__ = brief

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
        needed = curve.find_evaluations(self.exact - share * abs(self.exact))
        return needed if np.isfinite(needed) else np.nan

    @property
    def differences(self) -> list[tuple[str, list[str]]]:
        """The keys in which the configs differ, each with its value in every run. Of components with different names
        the name stands for all of their options."""
        configs = [
            {key: section for key, section in curve.config.items() if key not in IRRELEVANT} for curve in self.curves
        ]
        return list(_list_differences("", configs))


def _list_differences(path: str, values: Sequence[Any]) -> Iterator[tuple[str, list[str]]]:
    """The keys below ``path`` at which the ``values`` differ; a missing one is none."""
    if all(value == values[0] for value in values):
        return
    if not all(isinstance(value, Mapping) for value in values):
        yield path, [value_text(value) for value in values]
    elif len({value.get("name") for value in values}) > 1:
        yield path, [str(value.get("name")) for value in values]
    else:
        for key in dict.fromkeys(key for value in values for key in value):
            yield from _list_differences(f"{path}.{key}" if path else key, [value.get(key) for value in values])
