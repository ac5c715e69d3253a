"""Guards the figures of a run with feedback: what is drawn of gains, effort and answers is what the loop does."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.studies.adversary import Adversary
from sparserob_core.experiment.assemble import ControlExperiment
from sparserob_core.experiment.figures import drawing, run_figures
from sparserob_core.experiment.figures.figure_data import FigureData
from tests.support.places import CONFIGS
from tests.support.problems import double_integrator


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    small = {"dictionaries.control.pieces": 10, "problem.disturbance.box": [0.15, 0.15]}
    out = tmp_path_factory.mktemp("feedback") / "run"
    return sr.run(CONFIGS / "experiment1_feedback.yaml", small, out=out, quiet=True)


@pytest.fixture(scope="module")
def data(outcome: sr.Outcome) -> FigureData:
    assert isinstance(outcome.experiment, ControlExperiment)
    decision = outcome.result.decision
    assert decision is not None
    return drawing.figure_data(outcome.experiment, decision, None, (), None, draws=500)


@pytest.mark.slow
def test_a_run_with_feedback_draws_gains_effort_and_answers(outcome: sr.Outcome) -> None:
    assert outcome.directory is not None
    drawn = {file.name for file in (outcome.directory / "figures").iterdir()}
    assert {f"{name}.{kind}" for name in ("gains", "effort", "answers") for kind in ("png", "pdf")} <= drawn


@pytest.mark.slow
def test_the_tube_of_few_pieces_is_drawn_between_their_ends_too(data: FigureData) -> None:
    assert set(np.round(data.breakpoints, 9)) < set(np.round(data.times, 9))
    assert data.times.size >= 100
    assert data.alone_upper is not None and (data.alone_upper >= data.tube_upper - 1e-9).mean() > 0.5


@pytest.mark.slow
def test_no_draw_is_larger_than_the_most_that_any_disturbance_causes(data: FigureData) -> None:
    assert data.effort is not None and data.control_least is not None and data.control_most is not None
    most = np.maximum(np.abs(data.control_least), np.abs(data.control_most))
    assert (np.diff(data.effort, axis=0) >= 0.0).all()
    assert (data.effort[-1] <= most + 1e-12).all()
    assert (data.effort[-1] > 0.5 * most)[most > 0.1].mean() > 0.5  # and they come near to it


@pytest.mark.slow
def test_the_ground_is_white_exactly_where_the_control_is_off_whatever_happens(data: FigureData) -> None:
    assert data.control_least is not None and data.control_most is not None
    figure = run_figures.draw_effort(data)
    ground = next(patch for patch in figure.axes[0].patches if patch.get_label() == "may act")
    shaded = ground.get_data().values > 0.0  # type: ignore[attr-defined]
    most = np.maximum(np.abs(data.control_least), np.abs(data.control_most))[0]
    np.testing.assert_array_equal(shaded, most > 1e-7)
    assert 0 < shaded.sum() < shaded.size


def test_the_answers_add_up_to_the_control_that_the_worst_disturbance_causes(
    outcome: sr.Outcome, data: FigureData
) -> None:
    assert isinstance(outcome.experiment, ControlExperiment) and data.answers is not None
    worst = max((outcome.result.adversary(one) for one in ("path", "terminal")), key=lambda one: one.violation)
    acted = driven(outcome, worst)
    np.testing.assert_allclose(data.control.T + data.answers.sum(axis=1), acted, atol=1e-9)
    assert np.abs(data.answers[np.triu_indices(10, 1)]).max() == 0.0  # nothing is answered before it is seen
    assert worst.name in data.worst_case


def driven(outcome: sr.Outcome, worst: Adversary) -> np.ndarray:
    """The controls ``(K, m)`` of a loop around a known system without drift, under the disturbance of a worst case."""
    assert isinstance(outcome.experiment, ControlExperiment) and worst.disturbance is not None
    system, acting = outcome.experiment.problem.system, sr.controller(outcome)
    A, B, E = (
        np.asarray(matrix, dtype=float) for matrix in (system.phases[0].A, system.phases[0].B, system.phases[0].E)
    )
    x, acted, starts = worst.initial_state, list[np.ndarray](), acting.breakpoints[:-1]
    for begin, end in pairwise(np.unique(np.concatenate([starts, worst.breakpoints]))):
        if begin in starts:
            acted.append(acting.step(float(begin), x))
        w = worst.disturbance[:, np.searchsorted(worst.breakpoints, begin, side="right") - 1]
        block = np.zeros((len(x) + 1, len(x) + 1))
        block[:-1, :-1], block[:-1, -1] = A, B @ acted[-1] + E @ w
        x = (expm((end - begin) * block) @ np.append(x, 1.0))[:-1]
    return np.array(acted)


def test_of_many_gains_the_largest_are_drawn_and_the_title_says_so(data: FigureData) -> None:
    assert data.gains is not None
    tiled = {name: np.tile(getattr(data, name), (12, 1)) for name in ("state", "tube_lower", "tube_upper")}
    many = replace(data, gains=np.tile(data.gains, (1, 1, 1, 12)), **tiled)
    figure = run_figures.draw_gains(many)
    pictures = [ax for ax in figure.axes if ax.get_visible() and ax.collections and "answers" in ax.get_ylabel()]
    assert len(pictures) == run_figures.MAX_GAINS
    assert "the largest 16 of 24" in pictures[0].get_title()


def test_gains_have_units_where_both_are_known(data: FigureData) -> None:
    named = replace(
        data, names=sr.Names(states=("q", "v"), controls=("F",), state_units=("m", "m/s"), control_units=("N",))
    )
    assert named.gain_label(0, 1) == "gain on v [N per m/s]"
    assert "[" not in data.gain_label(0, 1)


def test_the_pictures_of_a_round_draw_nothing_at_random(outcome: sr.Outcome) -> None:
    assert outcome.experiment is not None and outcome.result.decision is not None
    plain = drawing.figure_data(outcome.experiment, outcome.result.decision, None, (), None)
    assert plain.effort is None and plain.answers is None and plain.gains is not None


@pytest.mark.slow
def test_a_policy_with_two_channels_can_be_drawn(tmp_path: Path) -> None:
    given = {"dictionaries.control.pieces": 6, "method.rounds": 1}
    out = sr.run(CONFIGS / "coupled_masses_feedback.yaml", given, out=tmp_path / "run", quiet=True)
    assert out.directory is not None and (out.directory / "figures" / "effort.png").exists()


def test_readings_are_outputs_in_the_worst_case_and_their_noise(tmp_path: Path) -> None:
    problem = {
        **double_integrator(0.05),
        "horizon": 2.0,
        "initial_state": [0.3, 0.0],
        "path": [{"box": [1.0, 1.0]}],
        "terminal": [{"box": [0.2, 0.2]}],
        "measurements": {
            "C": [[1, 0], [1, 2]],
            "noise": {"box": {"lower": [-0.01, -0.03], "upper": [0.03, 0.03]}},
            "latency": 0.5,
        },
    }
    pieces = {"control": {"name": "piecewise_constant", "pieces": 4}}
    config = {"problem": problem, "dictionaries": pieces, "policy": {"name": "affine", "causal_signals": 0}}
    result = sr.run(config, quiet=True, figures=False, out=tmp_path / "run")
    assert isinstance(result.experiment, ControlExperiment) and result.result.decision is not None
    drawn = drawing.figure_data(result.experiment, result.result.decision, None, (), None)
    outputs = drawn.outputs
    assert outputs is not None and outputs.latency == 0.5
    assert outputs.instants.tolist() == [0.0, 0.5, 1.0]
    at = np.searchsorted(drawn.times, outputs.instants)
    assert np.allclose(outputs.nominal[0], drawn.state[0])
    assert np.allclose(outputs.lower[0], drawn.tube_lower[0]) and np.allclose(outputs.upper[0], drawn.tube_upper[0])
    assert np.allclose(outputs.read_upper - outputs.upper[:, at], [[0.03], [0.03]])
    assert np.allclose(outputs.lower[:, at] - outputs.read_lower, [[0.01], [0.03]])
    figure = result.plot("outputs")
    assert [ax.get_ylabel() for ax in figure.axes] == ["$x_{1}(t)$", "$y_{2}(t)$"]
    names = sr.Names(states=("q", "v"), controls=("F",), state_units=("m", "m/s"), control_units=("N",))
    labels = [replace(drawn, names=names).gain_label(0, output) for output in (0, 1)]
    assert labels == ["gain on q [N per m]", "gain on $y_{2}$"]  # what is a state as it is has its name and its unit
