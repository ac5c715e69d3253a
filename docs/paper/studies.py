"""Every run that the page about the paper is made of: its experiments as printed, by sampling, and repaired."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sparserob_core as sr

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
WEIGHTS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6)  # the epsilons of the figure
BISECTIONS = 13

# The optimiser of the regularised program is wanted, not of the plain one.
SWEEP = {"method": {"name": "exchange", "exact": False}}
PRINTED3 = {"problem.disturbance.box": [0.4, 0.4]}


def scenarios(count: int) -> dict[str, Any]:
    """The scenario approach with so many scenarios."""
    return {"method": {"name": "scenario", "scenarios": count}}


@dataclass(frozen=True)
class Study:
    """One run: a config, what is changed in it, and what to call it."""

    name: str
    config: str
    title: str
    overrides: Mapping[str, Any] = field(default_factory=dict)


STUDIES = (
    Study("printed1", "experiment1_printed", "Experiment 1 as printed"),
    Study(
        "window1",
        "experiment1_paper",
        "Experiment 1, printed disturbance, path constraint from 0.3 on",
        {"method": "exchange"},
    ),
    Study("nominal1", "experiment1_paper", "non-robust", {"method": "nominal"}),
    Study("scenario1_1000", "experiment1_paper", "1000 scenarios", scenarios(1000)),
    Study("scenario1_5000", "experiment1_paper", "5000 scenarios", scenarios(5000)),
    Study("search1", "experiment1_paper", "the paper's search"),
    Study("repaired1_nominal", "experiment1_repaired", "non-robust", {"method": "nominal"}),
    Study("repaired1_scenario_1000", "experiment1_repaired", "1000 scenarios", scenarios(1000)),
    Study("repaired1_scenario_5000", "experiment1_repaired", "5000 scenarios", scenarios(5000)),
    Study("repaired1", "experiment1_repaired", "robust, proven"),
    *(
        Study(
            f"epsilon_{weight:g}",
            "experiment1_repaired",
            f"epsilon = {weight:g}",
            {**SWEEP, "continuation": {"start": weight, "stop": weight}},
        )
        for weight in WEIGHTS
    ),
    Study("printed2", "experiment2_printed", "Experiment 2 as printed"),
    Study("repaired2_nominal", "experiment2_repaired", "non-robust", {"method": "nominal"}),
    Study("repaired2_scenario_1000", "experiment2_repaired", "1000 scenarios", scenarios(1000)),
    Study("repaired2_scenario_5000", "experiment2_repaired", "5000 scenarios", scenarios(5000)),
    Study("repaired2", "experiment2_repaired", "robust, proven"),
    Study("printed3", "experiment3_printed", "Experiment 3 as printed"),
    Study("scenario3_1000", "experiment3_repaired", "1000 scenarios", {**scenarios(1000), **PRINTED3}),
    Study("repaired3_nominal", "experiment3_repaired", "non-robust", {"method": "nominal"}),
    Study("repaired3", "experiment3_repaired", "robust, proven"),
)


def run_all(directory: Path) -> dict[str, sr.Outcome]:
    """Run every study into ``directory``, one line each; the search at the paper's size takes most of the time."""
    outcomes = {}
    for number, study in enumerate(STUDIES, 1):
        tell(f"{number:2d}/{len(STUDIES)}  {study.config}  {study.title}")
        started = time.perf_counter()
        outcome = sr.run(
            CONFIGS / f"{study.config}.yaml",
            {"observers": [], **study.overrides},
            out=directory / study.name,
            figures=False,
        )
        tell(f"        {outcome.status}, {time.perf_counter() - started:.1f} s")
        outcomes[study.name] = outcome
    return outcomes


def largest_disturbance(directory: Path, low: float = 0.06, high: float = 0.08) -> tuple[float, float]:
    """The largest bound on ``|w_i|`` that experiment 1 withstands, by bisection: proven feasible up to the first,
    infeasible from the second."""
    for number in range(BISECTIONS):
        middle = (low + high) / 2
        overrides = {"observers": [], "problem.disturbance.box": [middle, middle]}
        status = sr.run(
            CONFIGS / "experiment1_repaired.yaml", overrides, out=directory / f"bisection{number}", figures=False
        ).status
        if status not in ("certified", "infeasible"):
            break
        low, high = (middle, high) if status == "certified" else (low, middle)
    return low, high


def tell(line: str) -> None:
    """One line of progress."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
