"""Results of a benchmark: every search, and the figures of merit over all of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.experiment.benchmark.landscapes import BenchmarkFunction
from sparserob_core.experiment.comparison.curve import spent_until
from sparserob_core.experiment.comparison.profiles import Profiles
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class Search:
    """Search of one contender on one landscape: the best value after every evaluation, the maximiser's own CPU time,
    and the best point."""

    landscape: BenchmarkFunction
    contender: str
    seed: int
    best: Array
    own_seconds: float
    """CPU time that the maximiser itself took: that of the search without the function's."""
    point: Array = field(repr=False)

    __repr__ = brief

    def needed(self, target: float) -> float:
        """Evaluations until a value; infinite where it was not reached."""
        return spent_until(target, self.best, np.arange(1.0, self.best.size + 1.0))


@final
@dataclass(frozen=True, eq=False)
class Benchmark:
    """Searches of some maximisers on some landscapes, ``profiles`` of the evaluations that they needed, and the
    targets ``(P,)`` at which a landscape counts as solved."""

    profiles: Profiles
    searches: Sequence[Search]
    targets: Sequence[float]
    budget: int

    __repr__ = brief

    def expected_running_time(self, landscape: int, contender: str) -> float:
        """All evaluations of a contender on a landscape, up to the target or the end, divided by the searches that
        reached the target: the ERT of Hansen and others (2009); infinite where none did."""
        label = self.profiles.problems[landscape].label
        searches = [
            search for search in self.searches if search.contender == contender and search.landscape.name == label
        ]
        needed = np.array([search.needed(self.targets[landscape]) for search in searches])
        spent = np.where(np.isfinite(needed), needed, [float(search.best.size) for search in searches])
        return float(spent.sum() / np.isfinite(needed).sum()) if np.isfinite(needed).any() else float("inf")

    def own_microseconds(self, contender: str) -> float:
        """CPU time of the maximiser itself for one evaluation, in microseconds, over all of its searches."""
        searches = [search for search in self.searches if search.contender == contender]
        return (
            1e6 * sum(search.own_seconds for search in searches) / max(1, sum(search.best.size for search in searches))
        )

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per contender."""
        columns, rows = self.profiles.table()
        indices = [columns.index(name) for name in ("contender", "runs solved", "fastest", "within 2x", "within 10x")]
        entries = [
            [*(row[index] for index in indices), f"{self.own_microseconds(name):.1f}"]
            for row, name in zip(rows, self.profiles.contenders, strict=True)
        ]
        return [*(columns[index] for index in indices), "own us / evaluation"], entries

    def times_table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per landscape: the expected running time of every contender, in evaluations."""
        names = self.profiles.contenders
        rows = [
            [problem.label, *(_format_count(self.expected_running_time(index, name)) for name in names)]
            for index, problem in enumerate(self.profiles.problems)
        ]
        return ["expected evaluations", *names], rows

    def remarks(self) -> Iterator[str]:
        """Yield the notes to be printed with the tables."""
        count = "1 landscape" if len(self.targets) == 1 else f"{len(self.targets)} landscapes"
        yield (
            f"solved: within {self.profiles.accuracy:.3g} of the way from the median of uniform points to the maximum; "
            f"{count}, {self.budget} evaluations each, {len(self.profiles.seeds[0])} seed(s); expected evaluations: all"
            " that were spent for each success"
        )
        if self.profiles.undrawn:
            yield self.profiles.undrawn

    def summary(self) -> Mapping[str, Any]:
        """Return the profiles, the notes and the figures of merit of the benchmark as plain data."""
        names = self.profiles.contenders
        return {
            **self.profiles.summary(),
            "remarks": list(self.remarks()),
            "budget": self.budget,
            "targets": list(self.targets),
            "own_microseconds": {name: self.own_microseconds(name) for name in names},
            "expected_running_time": {
                problem.label: {name: self.expected_running_time(index, name) for name in names}
                for index, problem in enumerate(self.profiles.problems)
            },
        }


def _format_count(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "never"
