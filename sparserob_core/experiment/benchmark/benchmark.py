"""``sparserob benchmark``: maximisers side by side, with data profiles, expected running times and their own time."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sparserob_core.arguments import share, whole
from sparserob_core.errors import InputError
from sparserob_core.experiment.benchmark.files import write
from sparserob_core.experiment.benchmark.landscapes import SUITES, BenchmarkFunction, landscapes
from sparserob_core.experiment.benchmark.searches import Benchmark, Search
from sparserob_core.experiment.comparison.profiles import Instance, Profiles
from sparserob_core.experiment.config.examples import shipped
from sparserob_core.experiment.directory.artefacts import create_directory
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.solve import Choice, component
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.maximiser import Maximiser, Report
from sparserob_core.sip.search.search import Rules, maximise

CONFIGS = ("coupled_masses", "experiment1_repaired", "experiment2_repaired")
KNOWN_MAXIMUM_ACCURACY = 1e-6  # of the maximum: to so many digits the maxima of the standard functions are known


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

    ``suites``: ``standard`` (six functions), ``classic`` (twelve more), ``bbob`` (24 functions in dimensions 2 and 5,
    by ioh), ``g`` (the relaxed value over tuples of 8 indices of ``configs``, whose maximum the exchange certifies;
    three shipped ones unless given). Every search has ``budget`` evaluations and one of the seeds ``0, 1, ...``; the
    same numbers give the same result. A landscape is solved at ``maximum - accuracy (maximum - begin)`` (Moré and Wild
    2009, (2.2)), ``begin`` the median of the function at uniform points. ``out``: a new or empty directory for
    ``profiles.png``, ``benchmark.json`` and ``ioh/``, files that IOHanalyzer reads. Raises `InputError` when an
    argument is at fault.
    """
    if not maximisers:
        raise InputError("maximisers: expected at least one, got none")
    calls, repeats = whole("budget", budget, 1), whole("seeds", seeds, 1)
    if not 0.0 < accuracy < 1.0:
        raise InputError(f"accuracy: expected a number above 0 and below 1, got {accuracy!r}")
    registry, rules = load_registry(), Rules(polish=share("polish", polish))
    names = _label_maximisers(maximisers)
    chosen = [component(registry, "maximiser", choice, Maximiser) for choice in maximisers]

    def find() -> Benchmark:
        suite_landscapes = list(landscapes(suites, _resolve_configs(configs) if "g" in suites else ()))
        searches: list[Search] = []
        total, start = len(suite_landscapes) * len(names) * repeats, time.monotonic()
        for landscape in suite_landscapes:
            for name, maximiser in zip(names, chosen, strict=True):
                for seed in range(repeats):
                    searches.append(_run_search(landscape, name, maximiser, calls, seed, rules))
                    elapsed = time.monotonic() - start
                    remaining = elapsed / len(searches) * (total - len(searches))
                    text = f"{landscape.name}: {len(searches)} of {total} searches, {remaining:.0f} s left"
                    notify(StudyProgress(text=text, done=len(searches), total=total))
        return _build_benchmark(suite_landscapes, names, searches, calls, repeats, accuracy, suites)

    if out is None:
        return find()
    with create_directory(out, "benchmark", "") as directory:
        return write(find(), directory)


def _build_benchmark(
    every: Sequence[BenchmarkFunction],
    names: Sequence[str],
    searches: Sequence[Search],
    budget: int,
    seeds: int,
    accuracy: float,
    suites: Sequence[str],
) -> Benchmark:
    targets = []
    for landscape in every:
        median = landscape.begin(0)
        slack = max(accuracy * (landscape.maximum - median), KNOWN_MAXIMUM_ACCURACY * abs(landscape.maximum))
        targets.append(landscape.maximum - slack)
    problems = [
        Instance(landscape.name, landscape.maximum, True, landscape.target.domain.dimension + 1.0)
        for landscape in every
    ]
    times = [
        [
            np.array(
                [
                    search.needed(target)
                    for search in searches
                    if search.landscape is landscape and search.contender == name
                ]
            )
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


def _run_search(
    landscape: BenchmarkFunction, name: str, maximiser: Maximiser, budget: int, seed: int, rules: Rules
) -> Search:
    fresh = (landscape if landscape.fresh is None else landscape.fresh()).target
    inside = 0.0

    def clocked(points: Array) -> Array:
        nonlocal inside
        start = time.process_time()
        values = np.asarray(fresh.function(points))
        inside += time.process_time() - start
        return values

    start = time.process_time()
    report: Report = maximise(replace(fresh, function=clocked), maximiser, budget, np.random.default_rng(seed), rules)
    own_seconds = max(0.0, time.process_time() - start - inside)
    if report.best_value > landscape.maximum + 10 * KNOWN_MAXIMUM_ACCURACY * max(1.0, abs(landscape.maximum)):
        raise InputError(
            f"{landscape.name}: the value {report.best_value:.12g} exceeds its maximum {landscape.maximum:.12g}"
        )
    return Search(landscape, name, seed, report.trace.best, own_seconds, report.best_point)


def _resolve_configs(configs: Sequence[str | Path] | None) -> list[Path]:
    if configs is not None:
        return [Path(config) for config in configs]
    return [shipped(name) for name in CONFIGS]


def _label_maximisers(maximisers: Sequence[Choice | Maximiser]) -> list[str]:
    names = []
    for choice in maximisers:
        if isinstance(choice, Mapping):
            options = ", ".join(f"{key} {value}" for key, value in choice.items() if key != "name")
            names.append(f"{choice.get('name')}, {options}" if options else str(choice.get("name")))
        else:
            names.append(choice if isinstance(choice, str) else type(choice).__name__)
    repeated = {name for name in names if names.count(name) > 1}
    if repeated:
        raise InputError(f"maximisers: expected each one once, got {', '.join(sorted(repeated))} more than once")
    return names
