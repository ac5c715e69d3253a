"""Files of a benchmark: the profiles as a picture, all numbers, and files that IOHanalyzer reads."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.experiment.comparison.profiles_figure import draw_profiles
from sparserob_core.experiment.directory.artefacts import RunDirectory, finite
from sparserob_core.experiment.figures.style import missing_matplotlib, save_figure

if TYPE_CHECKING:
    from sparserob_core.experiment.benchmark.searches import Benchmark, Search

IOH = "0.3.22"  # the version of IOHexperimenter whose files these look like


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Record of one function in the format of IOHprofiler, with the names of its fields."""

    version: str
    suite: str
    function_id: int
    function_name: str
    maximization: bool = True
    algorithm: dict[str, str]
    attributes: tuple[str, ...] = ("evaluations", "raw_y")
    scenarios: list[dict[str, Any]]


def write(found: Benchmark, directory: RunDirectory) -> Benchmark:
    """Write everything; where matplotlib is missing the remarks say so."""
    directory.write_json("benchmark.json", found.summary())
    for name, text in ioh_files(found):
        directory.write_text(name, text)
    if missing := missing_matplotlib():
        return replace(found, profiles=replace(found.profiles, undrawn=missing))
    save_figure(directory.path / "profiles.png", draw_profiles, found.profiles)
    return found


def ioh_files(found: Benchmark) -> Iterator[tuple[str, str]]:
    """Names and texts in the format of IOHprofiler (de Nobel and others 2024): for every contender and function one
    file of facts, and one table for every dimension, in which a line is an improvement."""
    for name in found.profiles.contenders:
        folder = f"ioh/{_sanitise_name(name)}"
        contender_searches = sorted(
            (search for search in found.searches if search.contender == name), key=_identify_function
        )
        for (number, title), group in groupby(contender_searches, key=_identify_function):
            searches, scenarios = list(group), []
            for size, runs in groupby(sorted(searches, key=_get_dimension), _get_dimension):
                table = f"data_f{number}_{title}/IOHprofiler_f{number}_DIM{size}.dat"
                searches_of_size = list(runs)
                yield f"{folder}/{table}", "".join(_format_table(search) for search in searches_of_size)
                scenarios.append(
                    {
                        "dimension": size,
                        "path": table,
                        "runs": [_describe_search(search) for search in searches_of_size],
                    }
                )
            facts = Facts(
                version=IOH,
                suite=searches[0].landscape.suite,
                function_id=number,
                function_name=title,
                algorithm={"name": name, "info": "SparseRob"},
                scenarios=scenarios,
            )
            yield f"{folder}/IOHprofiler_f{number}_{title}.json", json.dumps(finite(asdict(facts)), indent="\t") + "\n"


def _identify_function(one: Search) -> tuple[int, str]:
    return one.landscape.number, _sanitise_name(re.sub(r" \d+D$", "", one.landscape.name))


def _get_dimension(one: Search) -> int:
    return one.landscape.target.domain.dimension


def _sanitise_name(name: str) -> str:
    return re.sub(r"\W+", "_", name).strip("_")


def _format_table(one: Search) -> str:
    improvements = np.flatnonzero(np.diff(one.best, prepend=-np.inf) > 0.0)
    rows = [f"{index + 1} {one.best[index]:.12g}" for index in improvements]
    if improvements.size and improvements[-1] + 1 < one.best.size:
        rows.append(f"{one.best.size} {one.best[-1]:.12g}")
    return "\n".join(["evaluations raw_y", *rows]) + "\n"


def _describe_search(one: Search) -> dict[str, Any]:
    first = int(np.argmax(one.best)) + 1 if one.best.size else 0
    best = {"evals": first, "y": float(one.best[-1]) if one.best.size else None, "x": one.point.tolist()}
    return {"instance": one.landscape.instance, "evals": int(one.best.size), "best": best}
