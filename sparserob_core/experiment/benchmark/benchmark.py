"""``sparserob benchmark``: maximisers side by side, with data profiles, expected running times and their own time."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.benchmark.landscapes import SUITES, Landscape, landscapes
from sparserob_core.experiment.comparison.profiles import Instance, Profiles
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.solve import Choice, component
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.maximiser import Maximiser, Report
from sparserob_core.sip.search.search import Rules, Target, maximise

CONFIGS = ("coupled_masses", "experiment1_repaired", "experiment2_repaired")
DIGITS = 1e-6  # of the maximum: to so many digits the maxima of the standard functions are known


@final
@dataclass(frozen=True, eq=False)
class Search:
    """One search of one contender on one landscape: the running best value, and what it thought beside."""

    landscape: Landscape
    contender: str
    seed: int
    best: Array
    own_seconds: float
    """CPU time that the maximiser itself took: that of the search without the function's."""
    point: Array = field(repr=False)

    def needed(self, target: float) -> float:
        """Evaluations until a value; infinite where it was not reached."""
        reached = np.flatnonzero(self.best >= target)
        return float(reached[0] + 1) if reached.size else float("inf")


@final
@dataclass(frozen=True, eq=False)
class Benchmark:
    """Searches of some maximisers on some landscapes, ``profiles`` of the evaluations that they needed, and the
    targets ``(P,)`` at which a landscape counts as solved."""

    profiles: Profiles
    searches: Sequence[Search]
    targets: Sequence[float]
    budget: int

    def expected_running_time(self, landscape: int, contender: str) -> float:
        """All evaluations of a contender on a landscape, up to the target or the end, divided by the searches that
        reached the target: the ERT of Hansen and others (2009); infinite where none did."""
        label = self.profiles.problems[landscape].label
        mine = [one for one in self.searches if one.contender == contender and one.landscape.name == label]
        needed = np.array([one.needed(self.targets[landscape]) for one in mine])
        spent = np.where(np.isfinite(needed), needed, [float(one.best.size) for one in mine])
        return float(spent.sum() / np.isfinite(needed).sum()) if np.isfinite(needed).any() else float("inf")

    def own_microseconds(self, contender: str) -> float:
        """CPU time of the maximiser itself for one evaluation, in microseconds, over all of its searches."""
        mine = [one for one in self.searches if one.contender == contender]
        return 1e6 * sum(one.own_seconds for one in mine) / max(1, sum(one.best.size for one in mine))

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per contender."""
        columns, rows = self.profiles.table()
        keep = [columns.index(name) for name in ("contender", "runs solved", "fastest", "within 2x", "within 10x")]
        told = [
            [*(row[at] for at in keep), f"{self.own_microseconds(name):.1f}"]
            for row, name in zip(rows, self.profiles.contenders, strict=True)
        ]
        return [*(columns[at] for at in keep), "own us / evaluation"], told

    def times_table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per landscape: the expected running time of every contender, in evaluations."""
        names = self.profiles.contenders
        rows = [
            [problem.label, *(_count(self.expected_running_time(at, name)) for name in names)]
            for at, problem in enumerate(self.profiles.problems)
        ]
        return ["expected evaluations", *names], rows

    def remarks(self) -> Iterator[str]:
        """What is to be said beside the tables."""
        count = "1 landscape" if len(self.targets) == 1 else f"{len(self.targets)} landscapes"
        yield (
            f"solved: within {self.profiles.accuracy:.3g} of the way from the median of uniform points to the maximum; "
            f"{count}, {self.budget} evaluations each, {len(self.profiles.seeds[0])} seed(s); expected evaluations: all"
            " that were spent for each success"
        )
        if self.profiles.undrawn:
            yield self.profiles.undrawn

    def summary(self) -> Mapping[str, Any]:
        """All of it as plain data."""
        names = self.profiles.contenders
        return {
            **self.profiles.summary(),
            "remarks": list(self.remarks()),
            "budget": self.budget,
            "targets": list(self.targets),
            "own_microseconds": {name: self.own_microseconds(name) for name in names},
            "expected_running_time": {
                problem.label: {name: self.expected_running_time(at, name) for name in names}
                for at, problem in enumerate(self.profiles.problems)
            },
        }


def benchmark(
    maximisers: Sequence[Choice | Maximiser],
    suites: Sequence[str] = ("standard",),
    *,
    budget: int = 1000,
    seeds: int = 5,
    accuracy: float = 1e-3,
    polish: float = 0.0,
    configs: Sequence[str | Path] | None = None,
    out: str | Path | None = None,
    notify: Notify = ignore,
) -> Benchmark:
    """Maximisers side by side: what ``sparserob benchmark NAME ...`` does.

    ``suites``: ``standard`` (six functions), ``bbob`` (24 functions in dimensions 2 and 5, by ioh), ``g`` (the relaxed
    value over tuples of 8 indices of ``configs``, whose maximum the exchange certifies; three shipped ones unless
    given). Every search has ``budget`` evaluations and one of the seeds ``0, 1, ...``; the same numbers give the same
    result. A landscape is solved at ``maximum - accuracy (maximum - begin)`` (Moré and Wild 2009, (2.2)), ``begin`` the
    median of the function at uniform points. ``out``: a new or empty directory for ``profiles.png``,
    ``benchmark.json`` and ``ioh/``, files that IOHanalyzer reads. Raises `InputError` when an argument is at fault.
    """
    from sparserob_core.experiment.benchmark.files import prepared, write

    if not maximisers:
        raise InputError("maximisers: expected at least one, got none")
    calls, repeats = _whole("budget", budget), _whole("seeds", seeds)
    if not 0.0 < accuracy < 1.0:
        raise InputError(f"accuracy: expected a number above 0 and below 1, got {accuracy!r}")
    place = None if out is None else prepared(Path(out))
    registry, rules = load_registry(), Rules(polish=polish)
    names = _labels(maximisers)
    chosen = [component(registry, "maximiser", choice, Maximiser) for choice in maximisers]
    every = list(landscapes(suites, _configs(configs) if "g" in suites else ()))
    searches: list[Search] = []
    total, began = len(every) * len(names) * repeats, time.monotonic()
    for landscape in every:
        for name, maximiser in zip(names, chosen, strict=True):
            for seed in range(repeats):
                searches.append(_search(landscape, name, maximiser, calls, seed, rules))
                gone = time.monotonic() - began
                left = gone / len(searches) * (total - len(searches))
                text = f"{landscape.name}: {len(searches)} of {total} searches, {left:.0f} s left"
                notify(StudyProgress(text=text, done=len(searches), total=total))
    found = _told(every, names, searches, calls, repeats, accuracy, suites)
    return found if place is None else write(found, place)


def _told(
    every: Sequence[Landscape],
    names: Sequence[str],
    searches: Sequence[Search],
    budget: int,
    seeds: int,
    accuracy: float,
    suites: Sequence[str],
) -> Benchmark:
    targets = []
    for landscape in every:
        begin = landscape.begin(0)
        slack = max(accuracy * (landscape.maximum - begin), DIGITS * abs(landscape.maximum))
        targets.append(landscape.maximum - slack)
    problems = [Instance(one.name, one.maximum, True, one.box.dimension + 1.0) for one in every]
    times = [
        [
            np.array([one.needed(target) for one in searches if one.landscape is landscape and one.contender == name])
            for name in names
        ]
        for landscape, target in zip(every, targets, strict=True)
    ]
    kinds = ", ".join(suite for suite in SUITES if suite in suites)
    profiles = Profiles(
        f"maximisers on {kinds}", "evaluations", accuracy, names, problems, [list(range(seeds))] * len(every), times,
        [0] * len(names),
    )  # fmt: skip
    return Benchmark(profiles, searches, targets, budget)


def _search(landscape: Landscape, name: str, maximiser: Maximiser, budget: int, seed: int, rules: Rules) -> Search:
    fresh = landscape if landscape.fresh is None else landscape.fresh()
    inside = 0.0

    def clocked(points: Array) -> Array:
        nonlocal inside
        began = time.process_time()
        values = fresh.function(points)
        inside += time.process_time() - began
        return values

    target = Target(clocked, fresh.box, fresh.gradient, fresh.block, fresh.linear)
    began = time.process_time()
    report: Report = maximise(target, maximiser, budget, np.random.default_rng(seed), rules)
    own = max(0.0, time.process_time() - began - inside)
    if report.best_value > landscape.maximum + 10 * DIGITS * max(1.0, abs(landscape.maximum)):
        raise InputError(
            f"{landscape.name}: the value {report.best_value:.12g} exceeds its maximum {landscape.maximum:.12g}"
        )
    return Search(landscape, name, seed, report.trace.best, own, report.best_point)


def _whole(name: str, value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise InputError(f"{name}: expected a whole number of at least 1, got {value!r}")
    return int(value)


def _configs(configs: Sequence[str | Path] | None) -> list[Path]:
    if configs is not None:
        return [Path(config) for config in configs]
    from sparserob_core.experiment.benchmark.files import shipped

    return [shipped(name) for name in CONFIGS]


def _labels(maximisers: Sequence[Choice | Maximiser]) -> list[str]:
    names = []
    for one in maximisers:
        if isinstance(one, Mapping):
            options = ", ".join(f"{key} {value}" for key, value in one.items() if key != "name")
            names.append(f"{one.get('name')}, {options}" if options else str(one.get("name")))
        else:
            names.append(one if isinstance(one, str) else type(one).__name__)
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"maximisers: expected each one once, got {', '.join(sorted(twice))} more than once")
    return names


def _count(value: float) -> str:
    return f"{value:.0f}" if np.isfinite(value) else "never"
