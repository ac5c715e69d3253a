"""Guards what is gained on plants that amplify beside multiple shooting and other tools: who lands, who keeps the walls
between nodes, at what cost, in how many seconds of the processor, in one run."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import sparserob_core as sr
from sparserob_core.control.response.orbit import Orbit
from sparserob_core.control.response.time_grid import merge_grids
from tests.support.nodes import CONFIGS, Shot, at_nodes
from tests.support.shooters import by_do_mpc, by_openscvx


def followed(problem: sr.OptimalControlProblem, options: dict[str, Any], control: np.ndarray) -> tuple[float, float]:
    """By how much a control in open loop misses the fixed end, in units of the states, and exceeds its walls, in units
    of these; the true states are followed in balls, and looked at sixteen times in every piece."""
    times = np.linspace(0.0, problem.horizon, control.shape[1] + 1)
    fine = np.linspace(0.0, problem.horizon, 16 * control.shape[1] + 1)
    fine[::16] = times
    orbit = Orbit.of(problem.system, merge_grids(times, fine))
    assert orbit is not None
    states, _ = orbit.from_state(np.asarray(problem.initial_state, dtype=float)).states(control)
    ends, walls = (
        np.array(options["problem"][name][0][kind], dtype=float)
        for name, kind in (("terminal", "equals"), ("path", "box"))
    )
    return float(np.nanmax(np.abs(states[-1] - ends))), float(np.nanmax(np.abs(states) / walls) - 1.0)


OTHERS: dict[str, tuple[str, Callable[[dict[str, Any]], Shot]]] = {
    "do-mpc": ("do_mpc", by_do_mpc),
    "OpenSCvx": ("openscvx", by_openscvx),
}
STEPLESS = {"OpenSCvx"}  # has no constraint between the controls of two pieces in the words of its pages


@pytest.mark.benchmark
@pytest.mark.filterwarnings("ignore")  # other tools warn where packages of theirs are missing
@pytest.mark.parametrize("config", ["pendulum_transfer", "magnetic_levitation", "libration_point", "aircraft_pitch"])
def test_walls_and_ends_beside_others(config: str, tmp_path: Path) -> None:
    """The table of docs/unstable.md; other tools take part where they are installed."""
    options = yaml.safe_load((CONFIGS / f"{config}.yaml").read_text())
    start = time.process_time()
    outcome = sr.run(CONFIGS / f"{config}.yaml", out=tmp_path / "run", quiet=True, figures=False)
    spent = {"ours": time.process_time() - start}
    assert outcome.control is not None and outcome.problem is not None and outcome.status == "certified"
    shots = {"ours": Shot(outcome.summary["cost"], outcome.control)}
    makers: dict[str, Callable[[dict[str, Any]], Shot]] = {"at nodes": lambda _: at_nodes(config, parts=1)}
    makers |= {
        name: make
        for name, (module, make) in OTHERS.items()
        if find_spec(module) and not (name in STEPLESS and "control_step" in options["problem"])
    }
    for name, make in makers.items():
        start = time.process_time()
        shots[name] = make(options)
        spent[name] = time.process_time() - start
    table = {name: (shot.cost, *followed(outcome.problem, options, shot.control)) for name, shot in shots.items()}
    for name, (cost, missed, beyond) in table.items():
        print(f"{config:20} {name:9} cost {cost:.7f}  misses {missed:.1e}  walls {beyond:+.1e}  {spent[name]:.2f} s")
    assert table["ours"][1] < 1e-9 and table["ours"][2] < 2e-9
    assert table["at nodes"][0] <= table["ours"][0] * (1.0 + 1e-7)  # it keeps less
