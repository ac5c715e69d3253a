"""Guards `sparserob_core.not_installed`: what is printed of a missing package is a command that works everywhere."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest

import sparserob_core as sr
from tests.support.places import ROOT
from tests.support.stub import Command

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]


@pytest.mark.parametrize(
    ("extra", "project"),
    [
        ("rerun", "rerun-sdk"),
        ("figures", "matplotlib"),
        ("dask", "distributed"),
        ("cma", "cma"),
        ("nevergrad", "nevergrad"),
    ],
)
def test_a_missing_package_is_named_with_the_bound_that_the_distribution_states(extra: str, project: str) -> None:
    (stated,) = EXTRAS[extra]
    assert stated.startswith(f"{project}>=")
    assert sr.not_installed(project) == f"{project} is not installed; `pip install '{stated}'` brings it"


@pytest.mark.parametrize(
    ("module", "project", "arguments", "status"),
    [
        ("matplotlib", "matplotlib", ["run", "small.yaml", "--out", "out"], 0),
        ("distributed", "distributed", ["sweep", "small.yaml", "seed=1,2", "executor=dask", "--out", "out"], 2),
        ("cma", "cma", ["run", "small.yaml", "maximiser=cma", "--out", "out"], 2),
        ("nevergrad", "nevergrad", ["run", "small.yaml", "maximiser=nevergrad", "--out", "out"], 2),
        ("rerun_bindings", "rerun-sdk", ["watch", "small.yaml", "--save", "new.rrd", "--out", "out"], 2),
        ("rerun_bindings", "rerun-sdk", ["sweep", "small.yaml", "seed=1,2", "--save", "new.rrd", "--out", "out"], 2),
        ("osqp", "osqp", ["run", "small.yaml", "solver=osqp", "--out", "out"], 2),
        ("qpsolvers", "qpsolvers", ["run", "small.yaml", "solver={name: qpsolvers, solver: osqp}", "--out", "out"], 2),
        ("ioh", "ioh", ["benchmark", "random_search", "--suite", "bbob", "--budget", "10", "--out", "out"], 2),
    ],
    ids=lambda given: given[0] if isinstance(given, list) else str(given),
)
def test_whatever_needs_a_package_that_is_missing_names_what_brings_it(
    config: Path,
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    project: str,
    arguments: list[str],
    status: int,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    done = command(*arguments)
    assert done.returncode == status, done.stdout + done.stderr
    said = done.stdout + done.stderr
    assert sr.not_installed(project) in said
    assert said.count("not installed") == 1


def test_what_the_distribution_does_not_state_has_no_bound_and_what_pip_cannot_bring_no_command() -> None:
    assert sr.not_installed("gurobipy") == "gurobipy is not installed; `pip install 'gurobipy'` brings it"
    assert sr.not_installed("rerun", "rerun-sdk").startswith("rerun is not installed; `pip install 'rerun-sdk>=")
    assert sr.not_installed("mine", "") == "mine is not installed"


def test_no_message_asks_an_index_for_an_extra_of_this_package() -> None:
    sources = [one for folder in ("sparserob_core", "plugins", "docs") for one in (ROOT / folder).rglob("*.py")]
    assert len(sources) > 100
    assert [
        str(one) for one in sources if re.search(r"install '?sparserob\[\w+\]'?[`\"')]", one.read_text("utf-8"))
    ] == []
