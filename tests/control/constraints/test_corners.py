"""Guards how rows beside parameters in time are told: as those of the stated states, at the parameters that they are
about."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.names import Corners
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.proof.reasons import reasons

CONFIG: dict[str, Any] = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [["0*t", 0], [0, 0]],
            "B": [[1], ["1 + q"]],
            "c": ["p", 0],
            "parameters": {"p": [-1, 1], "q": [-0.5, 0.5]},
        },
        "horizon": 1.0,
        "initial_state": {"centre": [0, 0], "box": [0.1, 0.1]},
        "control": {"box": 1},
        "integral": [{"name": "fuel", "H": [[1, 0]], "upper": [5.0]}],
        "terminal": [{"box": [2, 9]}],
        "names": {
            "states": ["height", "speed"],
            "units": {"states": ["m", "m/s"], "controls": ["m/s"], "time": "s"},
        },
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 2}},
    "observers": [],
}


def run(directory: Path, method: str = "exchange", **problem: Any) -> sr.Outcome:
    config = {**CONFIG, "method": {"name": method}, "problem": {**CONFIG["problem"], **problem}}
    outcome = sr.run(config, out=directory, quiet=True, figures=False)
    summary = json.loads((directory / "result.json").read_text())
    assert " per " not in summary["message"]
    assert summary["units"]["states"] == ["m", "m/s"]
    assert len(summary["worst"]["initial_state"]) == 2
    return outcome


def impossible(**problem: Any) -> list[str]:
    """The reasons why nothing is feasible."""
    config = {**CONFIG, "problem": {**CONFIG["problem"], **problem}}
    return [one.text for one in reasons(assemble(load_config(config)).program)]


def test_a_row_that_no_control_moves_is_told_at_two_corners() -> None:
    """Between the corners of ``p`` the heights differ by 2 whatever the control."""
    (said,) = impossible(terminal=[{"box": [0.5, 9]}])
    assert said == (
        "the control cannot move height(1) at p = 1 less height(1) at p = -1, which is 2 m, but terminal: height(1)"
        " >= -0.5 m, at p = -1, and terminal: height(1) <= 0.5 m, at p = 1, ask for at most 1 m less 0.2 m for the"
        " worst initial states"
    )


def test_rows_that_ask_for_the_same_at_several_corners_are_one_reason() -> None:
    """The initial state moves the speed by 0.1 at either corner of ``q``, where 0.05 is allowed."""
    assert impossible(terminal=[{"box": [9, 0.05]}]) == [
        "the initial state alone moves speed(1) by 0.1 m/s, the terminal set allows 0.05 m/s, at q = -0.5"
    ]


@pytest.mark.slow
def test_an_integral_is_called_by_its_corner(tmp_path: Path) -> None:
    said = run(tmp_path / "out", integral=[{"name": "fuel", "H": [[1, 0]], "upper": [0.1]}]).result.message
    assert "fuel: fuel at p = 1(1) <= 0.1 m s" in said
    assert "height(1) >= -2 m (the initial state alone moves it by 0.1 m, at p = -1)" in said


@pytest.mark.slow
def test_a_refuted_run_says_only_what_was_stated(tmp_path: Path) -> None:
    outcome = run(
        tmp_path / "out",
        "nominal",
        terminal=[{"box": [2, 0.5]}],
        initial_state={"centre": [0, 0.9], "box": [0.1, 0.1]},
    )
    assert outcome.result.status == "refuted"
    assert sr.check(tmp_path / "out").status == "verified"


def test_a_direction_about_no_corner_alone_has_none() -> None:
    corners = Corners([np.array([[1.0, -1.0]]), np.array([[1.0, 1.0]])], np.array([[0.0], [2.0]]), ["p"])
    assert corners.at(np.array([1.0, 1.0])) == "p = 2"
    assert corners.at(np.array([0.0, 0.0, 1.0])) == ""
    assert corners.at(np.array([1.0, 0.5])) is None
    assert corners.without(np.array([1.0, 1.0, 3.0])) == pytest.approx([1.0, 0.0, 3.0])
