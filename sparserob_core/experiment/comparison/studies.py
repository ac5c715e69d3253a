"""Studies as a comparison: whose runs are repetitions, which configs contend, and what each needed on each problem."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.comparison.curve import Curve, read_curve
from sparserob_core.experiment.comparison.labels import labels
from sparserob_core.experiment.comparison.profiles import Instance, Measure, Profiles
from sparserob_core.experiment.config.plain import IRRELEVANT, value_text
from sparserob_core.experiment.sweep.plan import FILE
from sparserob_core.experiment.sweep.study import RUNS, read_study

PROFILE_ACCURACY = 0.01  # of the best value: a run is counted as solved from there on, unless stated otherwise
BOUND_CONTRADICTION = 1e-7
"""By how much a proven bound may exceed another run's before one of them is called wrong, relative to the larger of 1
and its size."""
PROBLEM = ("problem", "dictionaries", "policy")
"""Sections of a config that say which problem is solved; the others, but for the seed, say who solves it."""
NEITHER = frozenset({*PROBLEM, *IRRELEVANT, "seed", "plugins"})
DIFFERENCES = 3  # parts of a problem that its label names at most


def is_study(directory: Path) -> bool:
    """Return whether a directory holds a study."""
    return (directory / FILE).is_file()


def read_profiles(studies: Sequence[Path], accuracy: float, measure: Measure | None) -> Profiles:
    """The runs of studies as profiles; raises `InputError` where they do not let two contenders meet on a problem."""
    if not 0.0 < accuracy < 1.0:
        raise InputError(path="accuracy", expected="a relative distance between 0 and 1", got=repr(accuracy))
    if measure not in (None, "evaluations", "seconds"):
        raise InputError(path="measure", expected="evaluations or seconds", got=repr(measure))
    curves, titles, missing = list[Curve](), list[str](), 0
    for directory in studies:
        study = read_study(directory)
        if len(study.table) < study.points:
            raise InputError(
                f"{directory}: expected a finished study, got {len(study.table)} of {study.points} points; "
                f"sparserob sweep --resume {quote(str(directory))} goes on with it"
            )
        titles.append(study.title)
        run_directories = [directory / RUNS / str(row["run"]) for row in study.table]
        existing_runs = [
            run_directory for run_directory in run_directories if (run_directory / "config.yaml").is_file()
        ]
        missing += len(run_directories) - len(existing_runs)
        curves += [read_curve(run_directory) for run_directory in existing_runs]
    notes = [f"{missing} points failed before they had a run; they count as not solved where their fellows have one"]
    return _build_profiles(curves, accuracy, measure, _get_common_title(titles), notes if missing else [])


def _build_profiles(
    curves: Sequence[Curve], accuracy: float, measure: Measure | None, title: str, notes: list[str]
) -> Profiles:
    contending, posed = (
        [_make_key(_extract_contender(curve.config)) for curve in curves],
        [_make_key(_extract_problem(curve.config)) for curve in curves],
    )
    contenders, problems = list(dict.fromkeys(contending)), list(dict.fromkeys(posed))
    if len(contenders) < 2:
        raise InputError(
            "studies: expected at least two contenders, such as an axis maximiser.name, solver.name or method, got "
            f"{len(contenders)} in {len(curves)} runs"
        )
    first = [curves[contending.index(key)] for key in contenders]
    names = labels([{**curve.config, "seed": None} for curve in first], [curve.searched for curve in first])
    by: Measure = measure or ("evaluations" if all(curve.searched for curve in curves) else "seconds")
    if by == "evaluations" and not all(curve.searched for curve in curves):
        notes.append("an evaluation of a method that does not search is a relaxed program")
    shown = problem_labels([curves[posed.index(key)].config for key in problems])
    kept: list[Instance] = []
    seeds: list[list[Any]] = []
    times: list[list[np.ndarray]] = []
    for label, key in zip(shown, problems, strict=True):
        problem_curves = [
            (name, curve) for name, curve, problem in zip(contending, curves, posed, strict=True) if problem == key
        ]
        absent = [
            names[k] for k, name in enumerate(contenders) if name not in {contender for contender, _ in problem_curves}
        ]
        exact = _find_exact_value([curve for _, curve in problem_curves])
        if absent or exact is None:
            why = f"not every contender has run it ({', '.join(absent)} has not)" if absent else "no run has a bound"
            notes.append(f"left out: {label or 'the problem'}: {why}")
            continue
        repeated = dict.fromkeys(curve.config.get("seed") for _, curve in problem_curves)
        notes += _list_contradictions(label, [curve for _, curve in problem_curves])
        target = exact[0] - accuracy * abs(exact[0])
        kept.append(Instance(label, *exact, max(curve.dimension for _, curve in problem_curves) + 1.0))
        seeds.append(list(repeated))
        times.append(
            [
                _collect_times([curve for name, curve in problem_curves if name == contender], repeated, target, by)
                for contender in contenders
            ]
        )
    if not kept:
        raise InputError(f"studies: expected a problem that every contender has run, got none: {'; '.join(notes)}")
    failed = [
        sum(curve.status == "failed" for name, curve in zip(contending, curves, strict=True) if name == contender)
        for contender in contenders
    ]
    return Profiles(title, by, accuracy, names, kept, seeds, times, failed, notes)


def _collect_times(curves: Sequence[Curve], seeds: Mapping[Any, None], target: float, measure: Measure) -> np.ndarray:
    """Return the times of one contender on one problem, seed by seed; infinite where a run did not reach the target, or
    is missing."""
    times = dict.fromkeys(seeds, np.inf)
    for curve in curves:
        needed = curve.find_evaluations(target) if measure == "evaluations" else curve.find_seconds(target)
        # nan: it is not known
        times[curve.config.get("seed")] = float(np.fmin(times[curve.config.get("seed")], needed))
    return np.array(list(times.values()))


def _find_exact_value(curves: Sequence[Curve]) -> tuple[float, bool] | None:
    """The exact value, and whether it is certified."""
    certified = min(
        (curve for curve in curves if curve.status == "certified"), key=lambda curve: curve.gap, default=None
    )
    if certified is not None:
        return (certified.lower_bound + certified.upper_bound) / 2, True
    bounds = [float(curve.bound[-1]) for curve in curves if curve.bound.size]
    return (max(bounds), False) if bounds else None


def _list_contradictions(label: str, curves: Sequence[Curve]) -> Iterator[str]:
    above = min((curve.upper_bound for curve in curves if curve.status == "certified"), default=np.inf)
    wrong = [
        curve
        for curve in curves
        if curve.bound.size and curve.bound[-1] > above + BOUND_CONTRADICTION * max(1.0, abs(above))
    ]
    for curve in wrong:
        yield (
            f"{label}: the lower bound of {curve.directory} exceeds the certified upper bound {above:.9g}: one is wrong"
        )


def _extract_contender(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key not in NEITHER}


def _extract_problem(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: config.get(key) for key in PROBLEM}


def _make_key(data: Mapping[str, Any]) -> str:
    return json.dumps(data, sort_keys=True, default=str)


def problem_labels(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return one label per config: its title, where titles differ, and the options of the problem that differ."""
    flat = [dict(_list_leaves(_extract_problem(config))) for config in configs]
    keys = list(dict.fromkeys(key for leaves in flat for key in leaves))
    differing = [key for key in keys if len({_make_key({"": leaves.get(key)}) for leaves in flat}) > 1]
    titles = [str(config.get("title") or "") for config in configs]
    label_texts = []
    for leaves, title in zip(flat, titles, strict=True):
        phrases = [title] if len(set(titles)) > 1 and title else []
        phrases += [f"{key.removeprefix('problem.')} {value_text(leaves.get(key))}" for key in differing[:DIFFERENCES]]
        label_texts.append(", ".join(phrases))
    return [f"{label} ({k + 1})" if label_texts.count(label) > 1 else label for k, label in enumerate(label_texts)]


def _list_leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, child in value.items():
            yield from _list_leaves(child, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and any(isinstance(child, Mapping) for child in value):
        for number, child in enumerate(value):
            yield from _list_leaves(child, f"{path}.{number}")
    else:
        yield path, value


def _get_common_title(titles: Sequence[str]) -> str:
    return titles[0] if len(set(titles)) == 1 else ""
