"""Guards experiment/run/fewest: what is sought beside a run costs no more than the run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.experiment.run.conclusion import fewest
from sparserob_core.sip.methods.fewest import LeastCount

POINTS = [0.0, 0.3265913656188229, 1.1495849815782953, 1.94871063947864, 2.3776706047703655, 3.1290281125662176]
UNEVEN = {"control": {"name": "piecewise_constant", "breakpoints": [*POINTS, 3.3018005869561664, 3.561]}}
TURNING: dict[str, Any] = {  # a vertex acts less than the optimum, and hardly keeps the constraint on the path
    "name": "linear",
    "system": {
        "A": [[-0.187, 0.418, -0.695], [0.476, 0.234, -1.292], [1.629, 1.119, -1.599]],
        "B": [[0.383, -0.584], [-0.09, -1.317], [-2.642, 1.79]],
        "E": [[0.367], ["0.21 + 1.586 * p1"], [-0.146]],
        "parameters": {"p1": [-0.056, 0.075]},
    },
    "horizon": 3.561,
    "initial_state": [0.375, -1.923, -0.74],
    "control": {"ellipsoid": {"shape": [[4.882, 1.997], [1.997, 1.3]]}},
    "path": [
        {
            "box": {"lower": [None, -1.41976658242741, -0.7006182961886663], "upper": [None, 0.3626824334809281, None]},
            "from": 0.244,
            "to": 2.569,
        }
    ],
    "terminal": [
        {
            "box": {
                "lower": [0.061062639214491954, None, 0.9446552085488855],
                "upper": [0.06123385430541983, -0.2629351367610724, 0.9473039513727757],
            }
        }
    ],
}


def interval(where: Path, monkeypatch: pytest.MonkeyPatch, **changed: Any) -> tuple[Mapping[str, Any], dict[str, Any]]:
    """What is told of the time of action, and what the other program was handed."""
    handed: dict[str, Any] = {}

    def watched(start: Any, beaten: float, rounds: int, cells: Mapping[str, int]) -> LeastCount:
        handed.update(rounds=rounds, cells=dict(cells))
        return LeastCount(start, beaten, changed.get("rounds", rounds), changed.get("cells", cells))

    monkeypatch.setattr(fewest, "LeastCount", watched)
    config = {"problem": TURNING, "dictionaries": UNEVEN, "observers": []}
    outcome = sr.run(config, out=where, quiet=True, figures=False)
    handed["proofs"] = {proof.family: proof.cells for proof in outcome.result.proofs}
    activity = outcome.result.activity
    assert activity is not None
    handed["examined"] = {proof.family: proof.cells for proof in activity.proofs}
    return outcome.summary["sparsity"], handed


@pytest.mark.slow
def test_another_control_is_sought_no_longer_than_the_run_took(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said, handed = interval(tmp_path / "run", monkeypatch)
    assert handed["rounds"] >= 1
    assert handed["examined"]
    for family, cells in handed["proofs"].items():
        assert handed["cells"][family] == max(fewest.CELLS, cells)
        assert handed["examined"][family] <= handed["cells"][family]
    assert 0.0 < said["fewest_active"]["lower"] <= said["fewest_active"]["upper"] < 0.33


@pytest.mark.slow
def test_an_interval_whose_search_ended_early_holds_as_far_as_it_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = interval(tmp_path / "whole", monkeypatch)[0]["fewest_active"]
    early, handed = interval(tmp_path / "early", monkeypatch, cells={}, rounds=1)
    assert not handed["examined"]
    assert 0.0 <= early["fewest_active"]["lower"] <= whole["lower"] + 1e-12  # the last digits of two sums
    assert early["fewest_active"]["upper"] >= whole["upper"]
    assert sr.check(tmp_path / "early").status == "verified"
