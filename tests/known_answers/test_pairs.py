"""Guards the table of pairs in docs/scope.md: features of problems, two at a time, are proven and checked, or refused
by the sentence that is declared; what is proven lies between the values of linear programs on samples."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.control import combinations
from sparserob_core.control.combinations import refused_pairs
from sparserob_core.experiment.check.check import check
from tests.support.oracle import bounds_of, outside
from tests.support.places import ROOT

Config = dict[str, Any]

BASE: Config = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [-1, -0.4]], "B": [[0.2, 0], [0, 1]]},
        "horizon": 3.0,
        "initial_state": [-0.5, 0.5],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.03, 0.03]},
        "path": [{"box": [0.6, None], "from": 0.2}],
        "terminal": [{"box": [0.25, 0.25]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
    "observers": [],
}


def in_problem(**more: Any) -> Callable[[Config], object]:
    return lambda config: config["problem"].update(copy.deepcopy(more))


def also_on_the_path(**entry: Any) -> Callable[[Config], object]:
    return lambda config: config["problem"]["path"].append(copy.deepcopy(entry))


def costing(**more: Any) -> Callable[[Config], object]:
    return lambda config: config["problem"].setdefault("cost", {}).update(more)


def in_turns(config: Config) -> None:
    system = config["problem"]["system"]
    one = {name: system.pop(name) for name in ("A", "B")}
    system["pieces"] = [{"until": 1.25, **one}, {"until": 3.0, **copy.deepcopy(one), "B": [[0.3, 0], [0, 0.8]]}]


def systems(config: Config) -> list[Config]:
    system = config["problem"]["system"]
    return list(system.get("pieces", [system]))


def with_parameters(config: Config) -> None:
    for one in systems(config):
        one["A"] = [[0, 1], ["-1 + p", -0.4]]
    config["problem"]["system"]["parameters"] = {"p": [-0.05, 0.05]}


def with_drift(config: Config) -> None:
    for one in systems(config):
        one["c"] = [0, 0.05]


def at_rest_at_the_end(config: Config) -> None:
    config["problem"]["terminal"] = [{"equals": [None, 0.1]}]
    del config["problem"]["disturbance"]  # it would reach the state that is fixed


def in_a_list(config: Config) -> None:
    problem = config["problem"]
    if "disturbance" in problem:
        sizes, kind = problem["disturbance"]["box"], problem.pop("disturbance_class", "piecewise_constant")
        problem["disturbance"] = [
            {"set": {"box": size}, "E": [[float(i == k)] for i in range(2)], "class": kind}
            for k, size in enumerate(sizes)
        ]


def of_two_classes(config: Config) -> None:
    """One component any function of time, the other constant on pieces."""
    config["problem"]["disturbance"] = [
        {"set": {"box": 0.015}, "E": [[1], [0]], "class": "measurable"},
        {"set": {"box": 0.03}, "E": [[0], [1]]},
    ]


def on_own_pieces(config: Config) -> None:
    """Two components on grids of which neither is the dictionary's, nor a part of the other."""
    if isinstance(config["problem"].get("disturbance"), dict):
        in_a_list(config)
    own: list[Config] = [{"breakpoints": [0, 0.4, 1.7, 3]}, {"pieces": 4}]
    for one, pieces in zip(config["problem"].get("disturbance", []), own, strict=False):
        one.update(pieces)


def changing_with_time(config: Config) -> None:
    for one in systems(config):
        one["A"][1][1] = "-0.4 - 0.1*sin(t)"


FEATURES: dict[str, Callable[[Config], object]] = {
    "pieces of the system": in_turns,
    "parameters": with_parameters,
    "drift": with_drift,
    "delay": lambda config: config["problem"]["system"].update(delay=0.2),
    "initial set": in_problem(initial_state={"centre": [-0.5, 0.5], "box": [0.02, 0.02]}),
    "moving set": also_on_the_path(**{"box": [0.8, None], "from": 0.3, "relative_to": [[0, -0.2, 0], [3, 0.1, 0]]}),
    "mixed": also_on_the_path(**{"mixed": {"H": [[0, 1]], "G": [[0.2, 0.5]], "h": [1.0]}, "from": 0.5}),
    "curved path": also_on_the_path(**{"ellipsoid": {"centre": [0, 0], "shape": [[0.5, 0], [0, 0.6]]}, "from": 0.5}),
    "fixed final state": at_rest_at_the_end,
    "measurable": in_problem(disturbance_class="measurable", disturbance={"box": [0.015, 0.015]}),
    "control_step": in_problem(control_step={"box": 0.9}),
    "curved control_step": in_problem(control_step={"norm": {"p": 2, "radius": 1.0}}),
    "group": costing(group="all"),
    "quadratic cost": costing(l1=1.0, control={"R": [[0.1, 0], [0, 0.1]]}),
    "prices by piece": in_problem(weights=[[0, 1, 1], [1.5, 2, 2]]),
    "haar": lambda config: config["dictionaries"].update(control={"name": "haar", "pieces": 8}),
    "sparsest": lambda config: config.update(method={"name": "sparsest", "nodes": 300}),
    "affine": lambda config: config.update(policy={"name": "affine"}),
    "list of disturbances": in_a_list,
    "integral": in_problem(
        integral=[{"H": [[1, 0]], "G": [[0, 0.1]], "from": 0, "to": 2.5, "lower": [-0.05], "upper": [0.3]}]
    ),
    "entries in t": changing_with_time,
    "execution": in_problem(execution=0.03),
    "two classes": of_two_classes,
    "pieces of their own": on_own_pieces,
    "jitter": in_problem(jitter=0.05),
}
NAMES = list(FEATURES)
REFUSED = {frozenset((feature, companion)) for feature, companion, _ in refused_pairs()}


def combined(names: set[str]) -> Config:
    """The problem with these features."""
    config = copy.deepcopy(BASE)
    for name, put in FEATURES.items():
        if name in names:
            put(config)
    return config


def table() -> list[list[str]]:
    """The signs in docs/scope.md, row by row."""
    text = (ROOT / "docs" / "scope.md").read_text(encoding="utf-8").split("## Every pair")[1].split("\n## ")[0]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert lines[0] == ["", *map(str, range(1, len(NAMES) + 1))]
    assert [line[0] for line in lines[2:]] == [f"{number}. {name}" for number, name in enumerate(NAMES, 1)]
    return [line[1:] for line in lines[2:]]


def test_the_table_has_the_features_that_are_run_here_and_refuses_what_they_declare() -> None:
    assert tuple(NAMES) == combinations.FEATURES
    signs = ["".join("–" if {row, column} in REFUSED else "●" for column in NAMES) for row in NAMES]
    assert ["".join(row) for row in table()] == signs


@pytest.mark.parametrize(("feature", "companion", "sentence"), list(refused_pairs()))
def test_a_pair_that_is_refused_says_why_and_what_to_do_instead(
    feature: str, companion: str, sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(sr.InputError) as raised:
        sr.run(combined({feature, companion}), out=tmp_path, quiet=True, figures=False)
    declared = next(case for case in combinations.REFUSALS[feature].values() if case.sentence == sentence)
    assert re.search(".+".join(map(re.escape, re.split("{.*?}", sentence))), str(raised.value))
    assert declared.path in str(raised.value)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_every_other_pair_is_proven_and_checked_within_the_values_of_programs_on_samples(
    name: str, tmp_path: Path
) -> None:
    for number, companion in enumerate(NAMES[: NAMES.index(name) + 1]):
        names = {name, companion}
        if names in REFUSED:
            continue
        config = combined(names)
        outcome = sr.run(config, out=tmp_path / str(number), quiet=True, figures=False)
        assert outcome.result is not None
        assert outcome.status in ("certified", "verified"), names
        if "affine" not in names:  # of these ten take minutes each; `test_oracle` has those that do not
            assert outside(outcome.result, bounds_of(config)) == [], names
        assert check(tmp_path / str(number)).status == "verified", names
