"""Every run that the page about the paper is made of: its experiments as printed, by sampling, and repaired."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sparserob_core as sr

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
WEIGHTS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6)  # the epsilons of the figure
BISECTIONS = 13

PRINTED3 = {"problem.disturbance.box": [0.4, 0.4]}
SCENARIOS = {"method": {"name": "scenario", "scenarios": 1000}}


@dataclass(frozen=True)
class Run:
    """One run: a config, what is changed in it, and what to call it."""

    name: str
    config: str
    title: str
    overrides: Mapping[str, Any] = field(default_factory=dict)


RUNS = (
    Run("printed1", "experiment1_printed", "Experiment 1 as printed"),
    Run("search1", "experiment1_paper", "the paper's search"),
    Run("printed2", "experiment2_printed", "Experiment 2 as printed"),
    Run("printed3", "experiment3_printed", "Experiment 3 as printed"),
    Run("scenario3_1000", "experiment3_repaired", "1000 scenarios", {**SCENARIOS, **PRINTED3}),
    Run("repaired3_nominal", "experiment3_repaired", "non-robust", {"method": "nominal"}),
    Run("repaired3", "experiment3_repaired", "robust, proven"),
)
STUDIES: Mapping[str, Sequence[str]] = {
    "designs1_printed": ("nominal1", "scenario1_1000", "scenario1_5000", "window1"),
    "designs1": ("repaired1_nominal", "repaired1_scenario_1000", "repaired1_scenario_5000", "repaired1"),
    "designs2": ("repaired2_nominal", "repaired2_scenario_1000", "repaired2_scenario_5000", "repaired2"),
    "epsilon": tuple(f"epsilon_{weight:g}" for weight in WEIGHTS),
}
"""Files in configs/studies, and what the page calls their points."""


def run_all(directory: Path) -> dict[str, sr.Outcome]:
    """Everything that the page is made of, into ``directory``, one line for each run; the search at the paper's size
    takes most of the time."""
    outcomes = {}
    for run in RUNS:
        tell(f"{run.config}  {run.title}")
        started = time.perf_counter()
        outcome = sr.run(
            CONFIGS / f"{run.config}.yaml",
            {"observers": [], **run.overrides},
            out=directory / run.name,
            figures=False,
        )
        tell(f"        {outcome.status}, {time.perf_counter() - started:.1f} s")
        outcomes[run.name] = outcome
    for file, names in STUDIES.items():
        tell(f"studies/{file}")
        study = sr.sweep(
            CONFIGS / "studies" / f"{file}.yaml", overrides={"observers": []}, out=directory / file, notify=told
        )
        outcomes |= dict(zip(names, study.outcomes, strict=True))
    return outcomes


def told(event: sr.Event) -> None:
    """One line for every point of a study."""
    if isinstance(event, sr.SweepProgress) and event.row is not None:
        tell(f"        {event.row['status']}, {event.row.get('seconds') or 0.0:.1f} s; {event.text}")


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


def answered_disturbance() -> dict[str, float]:
    """What experiment 1, its path constraint from 0.3 on, withstands of ``|w_i|`` when the control answers what it
    measures at 50 breakpoints: proven from both sides, and what no causal control withstands."""
    box = 0.4  # as printed
    config = {
        "problem": {
            "name": "linear",
            "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
            "horizon": 5.0,
            "initial_state": [-1, 1],
            "control": {"box": 1.0},
            "disturbance": {"box": [box, box]},
            "path": [{"box": [0.7, None], "from": 0.3}],
            "terminal": [{"box": [0.3, 0.3]}],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 50}},
        "policy": {"name": "affine"},
        "observers": [],
    }
    found = sr.margin(config, tolerance=1e-4)
    assert found.causal_upper is not None
    return {"lower": box * found.lower, "upper": box * found.upper, "causal_upper": box * found.causal_upper}


def tell(line: str) -> None:
    """One line of progress."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
