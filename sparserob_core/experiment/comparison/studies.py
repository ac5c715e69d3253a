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
from sparserob_core.experiment.config.plain import BESIDE, value_text
from sparserob_core.experiment.sweep.plan import FILE
from sparserob_core.experiment.sweep.study import RUNS, read_study

ACCURACY = 0.01
SLACK = 1e-7
"""By how much a proven bound may exceed another run's before one of them is called wrong, relative to the larger of 1
and its size."""
PROBLEM = ("problem", "dictionaries", "policy")
"""Sections of a config that say which problem is solved; the others, but for the seed, say who solves it."""
NEITHER = frozenset({*PROBLEM, *BESIDE, "seed", "plugins"})
DIFFERENCES = 3  # parts of a problem that its label names at most


def is_study(directory: Path) -> bool:
    """Whether a directory holds a study."""
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
        places = [directory / RUNS / str(row["run"]) for row in study.table]
        there = [place for place in places if (place / "config.yaml").is_file()]
        missing += len(places) - len(there)
        curves += [read_curve(place) for place in there]
    notes = [f"{missing} points failed before they had a run; they count as not solved where their fellows have one"]
    return _profiles(curves, accuracy, measure, _common(titles), notes if missing else [])


def _profiles(
    curves: Sequence[Curve], accuracy: float, measure: Measure | None, title: str, notes: list[str]
) -> Profiles:
    contending, posed = [_key(_contender(one.config)) for one in curves], [_key(_posed(one.config)) for one in curves]
    contenders, problems = list(dict.fromkeys(contending)), list(dict.fromkeys(posed))
    if len(contenders) < 2:
        raise InputError(
            "studies: expected at least two contenders, such as an axis maximiser.name, solver.name or method, got "
            f"{len(contenders)} in {len(curves)} runs"
        )
    first = [curves[contending.index(key)] for key in contenders]
    names = labels([{**one.config, "seed": None} for one in first], [one.searched for one in first])
    by: Measure = measure or ("evaluations" if all(one.searched for one in curves) else "seconds")
    if by == "evaluations" and not all(one.searched for one in curves):
        notes.append("an evaluation of a method that does not search is a relaxed program")
    shown = problem_labels([curves[posed.index(key)].config for key in problems])
    kept: list[Instance] = []
    seeds: list[list[Any]] = []
    times: list[list[np.ndarray]] = []
    for label, key in zip(shown, problems, strict=True):
        mine = [(name, one) for name, one, problem in zip(contending, curves, posed, strict=True) if problem == key]
        absent = [names[k] for k, name in enumerate(contenders) if name not in {other for other, _ in mine}]
        exact = _exact([one for _, one in mine])
        if absent or exact is None:
            why = f"not every contender has run it ({', '.join(absent)} has not)" if absent else "no run has a bound"
            notes.append(f"left out: {label or 'the problem'}: {why}")
            continue
        repeated = dict.fromkeys(one.config.get("seed") for _, one in mine)
        notes += _contradictions(label, [one for _, one in mine])
        target = exact[0] - accuracy * abs(exact[0])
        kept.append(Instance(label, *exact, max(one.dimension for _, one in mine) + 1.0))
        seeds.append(list(repeated))
        times.append([_times([one for name, one in mine if name == who], repeated, target, by) for who in contenders])
    if not kept:
        raise InputError(f"studies: expected a problem that every contender has run, got none: {'; '.join(notes)}")
    failed = [
        sum(one.status == "failed" for name, one in zip(contending, curves, strict=True) if name == who)
        for who in contenders
    ]
    return Profiles(title, by, accuracy, names, kept, seeds, times, failed, notes)


def _times(curves: Sequence[Curve], seeds: Mapping[Any, None], target: float, measure: Measure) -> np.ndarray:
    """What the runs of one contender on one problem needed, seed by seed; infinite where it never came there, or did
    not run."""
    found = dict.fromkeys(seeds, np.inf)
    for one in curves:
        needed = one.reached(target) if measure == "evaluations" else one.reached_after(target)
        found[one.config.get("seed")] = float(np.fmin(found[one.config.get("seed")], needed))  # nan: it is not known
    return np.array(list(found.values()))


def _exact(curves: Sequence[Curve]) -> tuple[float, bool] | None:
    """The exact value, and whether it is certified."""
    certified = min((one for one in curves if one.status == "certified"), key=lambda one: one.gap, default=None)
    if certified is not None:
        return (certified.lower_bound + certified.upper_bound) / 2, True
    bounds = [float(one.bound[-1]) for one in curves if one.bound.size]
    return (max(bounds), False) if bounds else None


def _contradictions(label: str, curves: Sequence[Curve]) -> Iterator[str]:
    above = min((one.upper_bound for one in curves if one.status == "certified"), default=np.inf)
    wrong = [one for one in curves if one.bound.size and one.bound[-1] > above + SLACK * max(1.0, abs(above))]
    for one in wrong:
        yield f"{label}: the lower bound of {one.directory} exceeds the certified upper bound {above:.9g}: one is wrong"


def _contender(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in config.items() if key not in NEITHER}


def _posed(config: Mapping[str, Any]) -> dict[str, Any]:
    return {key: config.get(key) for key in PROBLEM}


def _key(data: Mapping[str, Any]) -> str:
    return json.dumps(data, sort_keys=True, default=str)


def problem_labels(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """One label per config: its title, where they differ, and what differs in the problem."""
    flat = [dict(_leaves(_posed(config))) for config in configs]
    keys = list(dict.fromkeys(key for one in flat for key in one))
    differing = [key for key in keys if len({_key({"": one.get(key)}) for one in flat}) > 1]
    titles = [str(config.get("title") or "") for config in configs]
    found = []
    for one, title in zip(flat, titles, strict=True):
        parts = [title] if len(set(titles)) > 1 and title else []
        parts += [f"{key.removeprefix('problem.')} {value_text(one.get(key))}" for key in differing[:DIFFERENCES]]
        found.append(", ".join(parts))
    return [f"{label} ({k + 1})" if found.count(label) > 1 else label for k, label in enumerate(found)]


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _leaves(one, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and any(isinstance(one, Mapping) for one in value):
        for number, one in enumerate(value):
            yield from _leaves(one, f"{path}.{number}")
    else:
        yield path, value


def _common(titles: Sequence[str]) -> str:
    return titles[0] if len(set(titles)) == 1 else ""
