"""Guards speed and memory on plants that others wrote: the whole command and its check, beside a naive program on
nodes. Skipped where the folder that SPARSEROB_PLANTS names is absent."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.linalg import expm
from scipy.optimize import linprog

from tests.support.places import matrices, needs_plants

PER_PIECE = 50  # nodes of the naive program
LARGEST: dict[str, tuple[float, float]] = {  # seconds of the processor and MB, of the command and of its check
    "building": (4.0, 300.0),
    "pde": (6.0, 300.0),
    "heat": (20.0, 600.0),
    "iss": (40.0, 1500.0),
    "beam": (40.0, 1500.0),
}
CHECKED: dict[str, tuple[float, float]] = {
    "building": (8.0, 400.0),
    "iss": (120.0, 1500.0),
    "beam": (120.0, 1500.0),
}
PUSHED = np.array([[0.8, 0.9], [1.0, 1.0]])  # ISSF01's inputs u2 and u3, any functions of time

pytestmark = [
    pytest.mark.benchmark,
    needs_plants,
]


def stated(plant: str) -> dict[str, Any]:
    """The output of a plant, between two walls from a time on, from a box of initial states; of the space station all
    three outputs, two inputs of which nobody knows how they go."""
    known = matrices(plant)
    if plant == "iss":
        A, B, C = (known[key] for key in "ABC")
        return {
            "system": {"A": A, "B": B[:, :1], "E": B[:, 1:]},
            "horizon": 20.0,
            "centre": np.zeros(len(A)),
            "radius": np.full(len(A), 1e-4),
            "rows": np.vstack([C, -C]),
            "walls": np.tile([2e-3, 2e-3, 4.9e-4], 2),
            "start": 0.0,
        }
    d, B = known["A"].shape[0], known["B"][:, 0]
    horizon, start, wall = {
        "building": (20.0, 1.0, 1.5e-3),
        "heat": (20.0, 2.0, 0.02488),
        "pde": (0.05, 0.01, 0.2),
        "beam": (20.0, 2.0, 26.07),
    }[plant]
    if plant == "building":  # BLDF01's initial states, and all others a little off
        centre, radius, output = np.zeros(d), np.full(d, 1e-5), np.eye(d)[24]
        centre[:10], radius[:10], radius[24] = 2.25e-4, 2.5e-5, 1e-4
    else:  # about where a constant input leads to
        share = 0.1 if plant == "beam" else 0.4
        centre, output = -share * np.linalg.solve(known["A"], B), known["C"][0]
        centre = np.round(centre, 3) + 0.005 if plant == "heat" else centre
        radius = np.full(d, 1e-3 * np.abs(centre).max()) if plant == "heat" else 1e-3 * np.abs(centre)
    return {
        "system": {"A": known["A"], "B": known["B"]},
        "horizon": horizon,
        "centre": centre,
        "radius": radius,
        "rows": np.vstack([output, -output]),
        "walls": np.full(2, wall),
        "start": start,
    }


def config(plant: str, folder: Path) -> Path:
    one = stated(plant)
    np.savez(folder / "plant.npz", H=one["rows"], **one["system"])
    problem = {
        "name": "linear",
        "system": {key: {"file": "plant.npz", "name": key} for key in one["system"]},
        "horizon": one["horizon"],
        "initial_state": {"centre": one["centre"].tolist(), "box": one["radius"].tolist()},
        "control": {"box": 1.0},
        "path": [
            {"polytope": {"H": {"file": "plant.npz", "name": "H"}, "h": one["walls"].tolist()}, "from": one["start"]}
        ],
    }
    if "E" in one["system"]:
        lower, upper = PUSHED.tolist()
        problem |= {"disturbance": {"box": {"lower": lower, "upper": upper}}, "disturbance_class": "measurable"}
    pieces = {"control": {"name": "piecewise_constant", "pieces": 100}}
    (folder / "plant.yaml").write_text(yaml.safe_dump({"problem": problem, "dictionaries": pieces}))
    return folder / "plant.yaml"


def naive(plant: str) -> tuple[float, float]:
    """The cost of a control that keeps the walls on nodes, and what it took."""
    began, one, pieces = time.process_time(), stated(plant), 100
    A, B = one["system"]["A"], np.hstack([one["system"][key] for key in one["system"] if key != "A"])
    h, d = one["horizon"] / (pieces * PER_PIECE), A.shape[0]
    flow = expm(np.block([[A, B], [np.zeros((B.shape[1], d + B.shape[1]))]]) * h)
    rows, gains, states, pushed = one["rows"], [], [], np.zeros(len(one["rows"]))
    for _ in range(pieces * PER_PIECE):
        gain = rows @ flow[:d, d:]
        gains.append(gain[:, 0])
        if gain.shape[1] > 1:  # between nodes they are constant here, so that they reach no farther than they may
            pushed = pushed + gain[:, 1:] @ PUSHED.mean(axis=0) + np.abs(gain[:, 1:]) @ np.diff(PUSHED, axis=0)[0] / 2.0
        rows = rows @ flow[:d, :d]
        states.append(rows @ one["centre"] + np.abs(rows) @ one["radius"] + pushed)
    sums = np.vstack([np.zeros((1, len(rows))), np.cumsum(gains, axis=0)])
    late = np.arange(1, sums.shape[0])[:, None] - PER_PIECE * np.arange(pieces + 1)
    G = np.diff(-sums[np.maximum(late, 0)], axis=1)
    after = np.arange(1, sums.shape[0]) * h >= one["start"] - 1e-9
    G, left = G[after].swapaxes(1, 2).reshape(-1, pieces), (one["walls"] - np.array(states))[after].ravel()
    size = np.abs(left).max()
    found = linprog(np.ones(2 * pieces), np.hstack([G, -G]) / size, left / size, bounds=(0.0, 1.0), method="highs")
    return float(found.fun) * one["horizon"] / pieces, time.process_time() - began


def measured(*arguments: str) -> tuple[float, float]:
    """Seconds of the processor and megabytes of a command."""
    code = (
        "import sys; from sparserob_core.experiment.cli.main import main\n"
        "try: main()\n"
        "finally: print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0], file=sys.stderr)"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], check=False, capture_output=True, text=True, timeout=600
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return spent, float(
        done.stderr.split()[-1]
    ) / 1024.0  # of the process alone: a child's usage begins with its parent's


@pytest.mark.parametrize("plant", LARGEST)
def test_a_plant_of_others(plant: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    least, alone = naive(plant)
    spent, memory = measured(
        "run", str(config(plant, tmp_path)), "--no-figures", "--quiet", "--out", str(tmp_path / "run")
    )
    checked, held = measured("check", str(tmp_path / "run"))
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    with capsys.disabled():
        print(
            f"\n{plant}: run {spent:.1f} s, {memory:.0f} MB; check {checked:.1f} s, {held:.0f} MB;"
            f" nodes {alone:.1f} s, J = {least:.6f}, proven {result['lower_bound']:.6f}"
        )
    assert result["status"] == "certified"
    assert result["lower_bound"] >= least * (1.0 - 1e-6)
    assert spent <= LARGEST[plant][0] and memory <= LARGEST[plant][1]
    if plant in CHECKED:
        assert checked <= CHECKED[plant][0] and held <= CHECKED[plant][1]
