"""Guards plugins/sparserob_rerun against what it has not been tried with: every config, every method and every
maximiser, watched and shown again, and the verdict read back from the recording."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.plugins.registry import load_own_registry
from sparserob_core.experiment.run.replay import replay
from sparserob_core.experiment.run.watch import watch
from tests.support.places import CONFIGS
from tests.support.recordings import read, texts

pytest.importorskip("rerun", reason="a recording needs the extra rerun")

BUDGET = 40
NAMES = sorted(file.name for file in CONFIGS.glob("*.yaml"))
MAXIMISERS = load_own_registry().names("maximiser")


def cheap(config: str) -> dict[str, object]:
    """Changes after which a run takes a second or two."""
    plain = load_config(CONFIGS / config).config.plain()
    changes: dict[str, object] = {"limits.seconds": 20.0} if "limits" in plain else {}
    for name, dictionary in plain["dictionaries"].items():
        if dictionary and dictionary.get("pieces"):
            most = 16 if dictionary["name"] in ("haar", "walsh") else 20
            changes[f"dictionaries.{name}.pieces"] = min(dictionary["pieces"], most)
    if plain["method"]["name"] == "sparserob":
        changes |= {"method.indices": 4, "maximiser.budget": BUDGET, "continuation": {"start": 0.1, "stop": 0.01}}
    if plain["method"]["name"] == "scenario":
        changes["method.scenarios"] = 30
    return changes


def told(file: Path, outcome: sr.Outcome) -> None:
    """The recording ends with the run's verdict, and no panel is missing for a reason that nobody gave."""
    found = read(file)
    assert f"**{outcome.status}**" in texts(found["/verdict"], "TextDocument:text")[-1]
    log = texts(found["/log"], "TextLog:text")
    assert any(line.startswith(f"{outcome.status}: ") for line in log)
    assert not [line for line in log if "could not be drawn" in line]
    assert len([line for line in log if line.startswith("no landscape: ")]) <= 1
    trace = outcome.result.trace
    if trace is not None and np.isfinite(trace.value).any():
        assert {"/search/g/best"} <= set(found)


@pytest.fixture(autouse=True)
def _landscapes_are_coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparserob_core.experiment.run.replay.LANDSCAPE_SECONDS", 1.0)


def both(config: str, changes: dict[str, object], directory: Path, caplog: pytest.LogCaptureFixture) -> None:
    live, again = directory / "live.rrd", directory / "again.rrd"
    outcome = watch(CONFIGS / config, changes, directory / "run", save=live, quiet=True, figures=False)
    told(live, outcome)
    replay(directory / "run", save=again)
    told(again, outcome)
    assert not [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.slow
@pytest.mark.parametrize("config", NAMES)
def test_every_config_is_watched_and_shown_again(config: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    both(config, cheap(config), tmp_path, caplog)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["exchange", "nominal", "scenario", "sparserob"])
@pytest.mark.parametrize("config", ["experiment2_reduced.yaml", "parameters_and_disturbance.yaml"])
def test_every_method_is_watched_and_shown_again(
    method: str, config: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    options = {"sparserob": {"indices": 4}, "scenario": {"scenarios": 20}}.get(method, {})
    changes = {
        "method": {"name": method, **options},
        "maximiser": {"name": "simulated_annealing", "budget": BUDGET},
        "regulariser": {"name": "ridge"},
        "continuation": {"start": 0.1, "stop": 0.01},
    }
    kept = {key: value for key, value in cheap(config).items() if key.startswith("dictionaries")}
    both(config, {**kept, **changes}, tmp_path, caplog)


@pytest.mark.slow
@pytest.mark.parametrize("maximiser", MAXIMISERS)
def test_every_maximiser_is_watched_and_shown_again(
    maximiser: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    needs = {"cma": "cma", "nevergrad": "nevergrad"}.get(maximiser)
    if needs:
        pytest.importorskip(needs)
    changes = {**cheap("experiment1_reduced.yaml"), "maximiser.name": maximiser, "method.indices": 2}
    both("experiment1_reduced.yaml", changes, tmp_path, caplog)
