"""The paper in one command: runs every experiment, draws every figure, writes docs/paper.md (``make paper``, a few
minutes)."""

from __future__ import annotations

import json
import math
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from cloud import Cloud, cloud_of
from figures_controls import draw_attention, draw_controls
from figures_states import draw_ends, draw_states
from numbers_of import numbers_of
from page import page
from studies import WEIGHTS, answered_disturbance, largest_disturbance, run_all, tell

import sparserob_core as sr

DOCS = Path(__file__).resolve().parents[1]
NUMBERS = Path(__file__).resolve().parent / "numbers.json"

DESIGNS = {
    "nominal1": "non-robust",
    "scenario1_1000": "1000 scenarios",
    "scenario1_5000": "5000 scenarios",
    "search1": "the paper's search",
}
REPAIRED = {
    "repaired1_nominal": "non-robust",
    "repaired1_scenario_1000": "1000 scenarios",
    "repaired1_scenario_5000": "5000 scenarios",
    "repaired1": "robust",
}
PARAMETERS = {"repaired2_nominal": "non-robust", "repaired2_scenario_1000": "1000 scenarios", "repaired2": "robust"}
ATTENTION = {"scenario3_1000": "printed $|w_i|$ ≤ 0.4, 1000 scenarios", "repaired3": "repaired $|w_i|$ ≤ 0.05, robust"}
SWEPT = {f"epsilon_{weight:g}": f"$\\varepsilon = 10^{{{round(math.log10(weight))}}}$" for weight in WEIGHTS}


def build(docs: Path = DOCS, numbers: Path = NUMBERS) -> None:
    """Write the figures and the page into ``docs`` and the numbers that the page is made of into ``numbers``."""
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as directory:
        outcomes = run_all(Path(directory))
        tell("        the largest disturbance that experiment 1 withstands, by bisection")
        bracket = largest_disturbance(Path(directory))
        tell("        the same with feedback, and what no causal control withstands")
        answered = answered_disturbance()
        tell("        10 000 trajectories of every control")
        clouds = {
            name: cloud_of(outcome)
            for name, outcome in outcomes.items()
            if outcome.control is not None and "epsilon" not in name
        }
        found = numbers_of(outcomes, clouds, bracket, answered)
    tell("        figures")
    draw(docs / "figures" / "paper", outcomes, clouds)
    numbers.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    (docs / "paper.md").write_text(page(found), encoding="utf-8")
    tell(f"docs/paper.md and its figures are written, {time.perf_counter() - started:.0f} s")


def draw(figures: Path, outcomes: Mapping[str, sr.Outcome], clouds: Mapping[str, Cloud]) -> None:
    """Every figure of the experiments section, for the printed data as far as they go and for the repaired ones."""
    draw_states(figures, "experiment1_printed_states", DESIGNS, outcomes, clouds)
    draw_states(figures, "experiment1_states", REPAIRED, outcomes, clouds)
    draw_states(
        figures,
        "experiment1_robust_states",
        {"search1": "printed, the paper's search", "repaired1": "repaired, robust"},
        outcomes,
        clouds,
    )
    draw_ends(
        figures,
        "experiment1_ends",
        {"search1": "printed, the paper's search", "repaired1": "repaired, robust"},
        outcomes,
        clouds,
    )
    draw_controls(figures, "experiment1_printed_controls", DESIGNS, outcomes)
    draw_controls(figures, "experiment1_controls", REPAIRED, outcomes)
    draw_controls(figures, "experiment1_epsilon", SWEPT, outcomes)
    draw_states(figures, "experiment2_states", PARAMETERS, outcomes, clouds, known=False)
    draw_controls(figures, "experiment2_controls", PARAMETERS, outcomes)
    draw_attention(figures, "experiment3", ATTENTION, outcomes, clouds)


if __name__ == "__main__":
    build()
