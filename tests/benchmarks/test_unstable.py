"""Guards what is gained on plants that amplify beside multiple shooting: who lands, who keeps the walls between nodes,
at what cost, in how many seconds of the processor, in one run."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.response.orbit import Orbit
from sparserob_core.control.response.time_grid import merge_grids
from tests.support.nodes import CONFIGS, at_nodes


def followed(outcome: sr.Outcome, control: np.ndarray) -> tuple[float, float]:
    """By how much a control in open loop misses the fixed end, and its walls, in units of these; the true states are
    followed in balls, and looked at sixteen times in every piece."""
    problem = outcome.problem
    times = np.linspace(0.0, problem.horizon, control.shape[1] + 1)
    fine = np.linspace(0.0, problem.horizon, 16 * control.shape[1] + 1)
    fine[::16] = times
    orbit = Orbit.of(problem.system, merge_grids(times, fine))
    assert orbit is not None
    states, _ = orbit.from_state(np.asarray(problem.initial_state, dtype=float)).states(control)
    (end,), (window,) = problem.terminal_equalities, problem.windows
    H, h = window.set.halfspaces()
    return float(np.abs(states[-1] - end.values).max()), float((states @ H.T / h).max() - 1.0)


@pytest.mark.benchmark
@pytest.mark.parametrize("config", ["pendulum_transfer", "libration_point"])
def test_walls_and_ends_beside_multiple_shooting(config: str, tmp_path: Path) -> None:
    start = time.process_time()
    outcome = sr.run(CONFIGS / f"{config}.yaml", out=tmp_path / "run", quiet=True, figures=False)
    ours, start = time.process_time() - start, time.process_time()
    shot = at_nodes(config, parts=1)
    theirs = time.process_time() - start
    assert outcome.control is not None and outcome.status == "certified"
    landed, kept = followed(outcome, outcome.control)
    missed, beyond = followed(outcome, shot.control)
    table = {
        "cost": {"ours": outcome.summary["cost"], "at nodes": shot.cost},
        "end missed": {"ours": landed, "at nodes": missed},
        "walls exceeded": {"ours": max(kept, 0.0), "at nodes": max(beyond, 0.0)},
        "seconds": {"ours": round(ours, 2), "at nodes": round(theirs, 2)},
    }
    print(f"\n{config}: {json.dumps(table)}")
    assert landed < 1e-9 and kept < 2e-9
    assert shot.cost <= outcome.summary["cost"] * (1.0 + 1e-7)  # it keeps less
