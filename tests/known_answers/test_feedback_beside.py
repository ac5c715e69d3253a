"""Guards what stands beside the state under policy affine: bounds of state and control together, sets that move, steps
of the control; against linear programs that share nothing with the package, and against forged certificates."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_feedback_rows import (
    PIECES,
    SPRING,
    bracketed,
    config,
    forged,
    program,
    proven,
    run,
    spring_rows,
)
from tests.support.policy_programs import PolicyProgram
from tests.support.problems import spring

MIXED = {"mixed": {"H": [[0, 1], [0, -1]], "G": [[0.5], [-0.5]], "h": 1.1}, "from": 0.6}
MOVING = {"box": [0.75, None], "from": 0.5, "relative_to": [[0, 0, 0], [1.3, 0.1, 0.1], [5, -0.1, 0]]}
STEPS = {"control_step": {"box": 0.5}, "initial_control": [0.0]}


def mixed_rows(independent: PolicyProgram, within: int) -> None:
    """``|x2 + 0.5 u| <= 1.1`` from 0.6 on, with the control of every piece at both of its ends."""
    h = 5.0 / PIECES
    for k in range(1, PIECES):
        for t in np.linspace(max(k * h, 0.6), (k + 1) * h, within + 1):
            both = independent.state(float(t))[1] + 0.5 * independent.control(k)[0]
            for sign in (1.0, -1.0):
                independent.below(sign * both, 1.1)


@pytest.mark.slow
@pytest.mark.parametrize("cost", [pytest.param("nominal", marks=pytest.mark.slow), "peak"])
def test_bounds_of_state_and_control_together_cost_what_a_linear_program_says(cost: str, tmp_path: Path) -> None:
    outcome = run({**SPRING, "path": [*SPRING["path"], MIXED]}, tmp_path / "run", cost)
    proven(outcome)

    def programs(within: int) -> float:
        independent = program(SPRING, PIECES, [0.15, 0.15], [0.0, 0.0])
        spring_rows(independent, within)
        mixed_rows(independent, within)
        return independent.solve(1.0, cost)

    bracketed(outcome.result.cost, programs)


@pytest.mark.slow
@pytest.mark.parametrize("cost", [pytest.param("nominal", marks=pytest.mark.slow), "peak"])
def test_a_path_that_moves_costs_what_a_linear_program_says(cost: str, tmp_path: Path) -> None:
    outcome = run({**SPRING, "path": [MOVING]}, tmp_path / "run", cost)
    proven(outcome)
    moved: Any = np.array(MOVING["relative_to"])

    def programs(within: int) -> float:
        independent = program(SPRING, PIECES, [0.15, 0.15], [0.0, 0.0])
        times = np.linspace(0.0, 5.0, PIECES * within + 1)
        for t in np.unique([*times[times > 0.5], 0.5, 1.3]):
            x, about = independent.state(float(t))[0], float(np.interp(t, moved[:, 0], moved[:, 1]))
            for sign in (1.0, -1.0):
                independent.below(sign * x, 0.75 + sign * about)
        for state in independent.state(5.0):
            for sign in (1.0, -1.0):
                independent.below(sign * state, 0.3)
        return independent.solve(1.0, cost)

    bracketed(outcome.result.cost, programs)


def step_rows(independent: PolicyProgram, least: float, most: float, first: float | None) -> None:
    """Every change of the control is between two numbers, the first one from ``first`` on where that is told."""
    controls = [independent.control(k)[0] for k in range(PIECES)]
    changes = [after - before for before, after in pairwise(controls)]
    for change in changes:
        independent.below(change, most)
        independent.below(-change, -least)
    if first is not None:
        independent.below(controls[0], most + first)
        independent.below(-controls[0], -least - first)


@pytest.mark.slow
@pytest.mark.parametrize("cost", [pytest.param("nominal", marks=pytest.mark.slow), "peak"])
@pytest.mark.parametrize(
    ("changed", "rows"),
    [
        (STEPS, lambda independent: step_rows(independent, -0.5, 0.5, 0.0)),
        pytest.param(
            {"control_step": {"box": {"lower": -0.4, "upper": 0.6}}},
            lambda independent: step_rows(independent, -0.4, 0.6, None),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["from the control before", "uneven"],
)
def test_steps_of_the_control_cost_what_a_linear_program_says(
    changed: dict[str, Any], rows: Callable[[PolicyProgram], None], cost: str, tmp_path: Path
) -> None:
    outcome = run({**SPRING, **changed}, tmp_path / "run", cost)
    proven(outcome)

    def programs(within: int) -> float:
        independent = program(SPRING, PIECES, [0.15, 0.15], [0.0, 0.0])
        spring_rows(independent, within)
        rows(independent)
        return independent.solve(1.0, cost)

    bracketed(outcome.result.cost, programs)


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["nominal", "peak", "worst"])
def test_everything_together_keeps_every_guarantee(cost: str, tmp_path: Path) -> None:
    together = {
        **SPRING,
        **STEPS,
        "initial_state": {"centre": [-1, 1], "box": [0.05, 0.05]},
        "path": [MOVING, MIXED],
        "terminal": [{"box": [0.35, 0.35]}],
    }
    proven(run(together, tmp_path / "run", cost, pieces=8))


def test_small_steps_are_judged_in_their_own_unit(tmp_path: Path) -> None:
    """A double integrator that needs little: steps of a thousandth of what the control could be."""
    problem = {
        **SPRING,
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "E": [[0], [1]]},
        "initial_state": [0.02, 0],
        "disturbance": {"box": 1e-4},
        "path": [],
        "terminal": [{"box": [0.005, 0.005]}],
        "control_step": {"box": 0.002},
        "initial_control": [0.0],
    }
    proven(run(problem, tmp_path / "run", "peak"))


def test_steps_that_are_too_small_are_infeasible_with_their_reason(tmp_path: Path) -> None:
    outcome = run({**SPRING, "control_step": {"box": 0.05}, "initial_control": [0.0]}, tmp_path / "run")
    assert outcome.status == "infeasible"
    assert "control_step: the change of" in outcome.result.message


TWO = {"system": {"A": [[0, 1], [-2, -0.5]], "B": [[0.4, 0.3], [0, 1]]}, "control": {"box": [1, 1]}}
RADIUS, SIDES, FEW = 0.5, 16, 5
ROUND = {
    **spring(0.1, since=1.0),
    **TWO,
    "control_step": {"norm": {"p": 2, "radius": RADIUS}},
    "initial_control": [0.0, 0.0],
}


@pytest.mark.slow
def test_a_ball_of_steps_costs_what_polygons_around_it_and_in_it_say(tmp_path: Path) -> None:
    outcome = run(ROUND, tmp_path / "run", "peak", pieces=FEW)
    proven(outcome)

    def polygon(radius: float) -> float:
        independent = program(ROUND, FEW, [0.1, 0.1], [0.0, 0.0])
        spring_rows(independent, 3, start=1.0)
        controls = [independent.control(k) for k in range(FEW)]
        for after, before in pairwise([np.zeros_like(controls[0]), *controls][::-1]):
            for angle in 2 * np.pi * np.arange(SIDES) / SIDES:
                independent.below(np.tensordot([np.cos(angle), np.sin(angle)], after - before, 1), radius)
        return independent.solve(1.0, "peak")

    around, within = polygon(RADIUS), polygon(RADIUS * np.cos(np.pi / SIDES))
    assert around * (1 - 1e-9) <= outcome.result.cost <= within * (1 + 5e-3)
    assert within < around * 1.04
    assert polygon(4 * RADIUS) < 0.98 * around, "the steps matter"


@pytest.mark.slow
@pytest.mark.parametrize(
    "forgery",
    [
        lambda data: data["decision"][0].__setitem__(2, data["decision"][0][2] + 1e-3),
        lambda data: data["gains"][1][1][0].__setitem__(0, data["gains"][1][1][0][0] + 0.1),
        lambda data: data["multipliers"]["constraints"][0].__setitem__("multiplier", 5.0),
    ],
    ids=["a longer step", "a larger answer", "a larger multiplier"],
)
def test_a_forged_step_of_a_ball_is_refuted(
    forgery: Callable[[dict[str, Any]], object], tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    directory = tmp_path_factory.getbasetemp() / "round"
    if not directory.exists():
        run(ROUND, directory, "peak", pieces=FEW)
    assert forged(directory, tmp_path / "copy", forgery) == "refuted"


def test_a_ball_of_steps_across_the_seam_holds_for_every_period(tmp_path: Path) -> None:
    """``x' = u + w`` for ever from ``|x| <= 0.3``, ``|w| <= 0.1``: every period answers what it begins with."""
    problem = {
        "name": "linear",
        "system": {"A": [[0, 0], [0, 0]], "B": [[1, 0], [0, 1]]},
        "horizon": 1.0,
        "initial_state": {"centre": [0, 0], "box": [0.3, 0.3]},
        "control": {"box": [1, 1]},
        "disturbance": {"box": [0.1, 0.1]},
        "control_step": {"norm": {"p": 2, "radius": 1.0}},
        "repeat": True,
    }
    outcome = run(problem, tmp_path / "run", "peak", pieces=2)
    assert outcome.status == "certified", outcome.result.message
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]
    narrow = {**problem, "control_step": {"norm": {"p": 2, "radius": 0.2}}}
    assert run(narrow, tmp_path / "narrow", "peak", pieces=2).status == "infeasible"


REFUTED: dict[str, dict[str, Any]] = {
    "mixed": {"path": [{"mixed": {"H": [[1, 0.3], [-1, -0.3]], "G": [[0.5], [-0.5]], "h": 0.8}, "from": 0.5}]},
    "a path that moves": {"path": [MOVING]},
}


@pytest.mark.first(1)
@pytest.mark.parametrize("name", REFUTED)
def test_a_witness_drives_the_loop_out_of_what_stands_beside_the_state(name: str, tmp_path: Path) -> None:
    """What one round leaves violated is named with a disturbance that the checker drives the loop by."""
    given = {**config({**SPRING, **REFUTED[name]}), "method": {"name": "exchange", "rounds": 1}}
    outcome = sr.run(given, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == "refuted"
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


FORGERIES: dict[str, tuple[dict[str, Any], Any]] = {
    "a piece of the control": (
        {"path": [*SPRING["path"], MIXED]},
        lambda data: _of(data, "path[1]").__setitem__("piece", _of(data, "path[1]")["piece"] + 2),
    ),
    "the control in a mixed direction": (
        {"path": [*SPRING["path"], MIXED]},
        lambda data: _of(data, "path[1]")["direction"].__setitem__(2, 0.4),
    ),
    "a nominal control of large steps": (
        STEPS,
        lambda data: data["decision"][0].__setitem__(0, data["decision"][0][0] + 0.6),
    ),
    "a time without a step": (STEPS, lambda data: _of(data, "control_step").__setitem__("time", 0.7)),
    "a multiplier of a moving path": (
        {"path": [MOVING]},
        lambda data: _of(data, "path").__setitem__("multiplier", 1.01 * _of(data, "path")["multiplier"]),
    ),
}


def _of(data: dict[str, Any], name: str) -> dict[str, Any]:
    every: list[dict[str, Any]] = data["multipliers"]["constraints"]
    return next(one for one in every if one["constraint"] == name)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> Callable[[dict[str, Any]], Path]:
    """The directory of the run with something changed; each is run once."""
    made: dict[str, Path] = {}

    def directory(changed: dict[str, Any]) -> Path:
        if str(changed) not in made:
            outcome = run({**SPRING, **changed}, tmp_path_factory.mktemp("honest") / "run")
            assert outcome.status == "certified"
            made[str(changed)] = outcome.directory
        return made[str(changed)]

    return directory


@pytest.mark.slow
@pytest.mark.parametrize("name", FORGERIES)
def test_what_is_forged_beside_the_state_is_found(
    name: str, honest: Callable[[dict[str, Any]], Path], tmp_path: Path
) -> None:
    changed, forgery = FORGERIES[name]
    assert forged(honest(changed), tmp_path / "copy", forgery) == "refuted"


@pytest.mark.slow
def test_a_bound_of_state_and_control_has_a_margin(tmp_path: Path) -> None:
    problem = {**SPRING, "path": [MIXED]}
    found = sr.margin(config(problem, pieces=PIECES), of="disturbance", tolerance=1e-2, out=tmp_path / "margin")
    assert found.status == "certified", found.message

    def cost(width: float) -> float:
        independent = program(SPRING, PIECES, [width, width], [0.0, 0.0])
        mixed_rows(independent, 2)
        for state in independent.state(5.0):
            for sign in (1.0, -1.0):
                independent.below(sign * state, 0.3)
        return independent.solve(1.0, "nominal")

    assert np.isfinite(cost(found.amounts[0]))
    assert np.isinf(cost(1.02 * found.amounts[1]))
