"""Guards experiment/run: every figure of a run is drawn when it is over and drawn again from its directory, and the
slice of g that is shown is one that varies, where any does."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.directory.finished import stored_run
from sparserob_core.experiment.run import drawing, inspection
from sparserob_core.experiment.run.drawing import draw_run, drawings, drawn, landscape_of

pytest.importorskip("matplotlib")

CONFIG = {
    "title": "Two states",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, "p1"]], "B": [[0], [1]], "parameters": {"p1": [-0.2, 0.2]}},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 2.0},
        "disturbance": {"box": [0.02, 0.02]},
        "path": [{"box": [0.8, None], "from": 1.0}],
        "terminal": [{"box": [None, 1.2]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
    "method": {"name": "sparserob", "indices": 3},
    "continuation": {"start": 0.1, "stop": 0.01},
    "maximiser": {"name": "simulated_annealing", "budget": 30},
}
FIGURES = {f"{name}.{kind}" for name in ("climb", "landscape") for kind in ("pdf", "png")}


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    return sr.run(CONFIG, out=tmp_path_factory.mktemp("runs") / "searched", quiet=True, figures=False)


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """No time but for the coarsest landscape."""
    monkeypatch.setattr(drawing, "LANDSCAPE_VALUE_SECONDS", 0.0)


@pytest.mark.slow
def test_the_figures_of_a_search_are_drawn_from_its_directory(
    searched: sr.Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drawing, "_prepare_decision_figures", lambda *_: {})
    said: list[sr.Event] = []
    files = draw_run(searched.directory, notify=said.append)
    assert {file.name for file in files} == FIGURES and all(file.is_file() for file in files)
    assert all(isinstance(event, sr.StudyProgress) for event in said) and said


@pytest.mark.slow
def test_the_figures_that_a_run_leaves_are_those_that_are_drawn_again(tmp_path: Path) -> None:
    outcome = sr.run(CONFIG, out=tmp_path / "run", quiet=True)
    assert outcome.remarks == ()
    left = {file.name: file.read_bytes() for file in (outcome.directory / "figures").iterdir()}
    assert set(left) > FIGURES
    shutil.rmtree(outcome.directory / "figures")
    assert {file.name: file.read_bytes() for file in draw_run(outcome.directory)} == left


@pytest.mark.slow
def test_a_figure_that_cannot_be_drawn_is_a_remark_and_costs_no_other(
    searched: sr.Outcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("no ink")

    monkeypatch.setattr(drawing, "_prepare_decision_figures", broken)
    monkeypatch.setattr("sparserob_core.experiment.figures.climb_figure.draw_climb", broken)
    remarks = drawn(searched.experiment, searched.result, tmp_path, {})
    assert remarks == ("the figures could not be drawn: RuntimeError: no ink",)
    assert {file.stem for file in (tmp_path / "figures").iterdir()} == {"landscape"}


def test_the_slice_varies_and_has_the_value_of_the_best_tuple_where_that_is(searched: sr.Outcome) -> None:
    trace = searched.result.trace
    assert trace is not None
    inspection = sr.Inspection.read(searched.directory)
    data = landscape_of(inspection, trace, "Slice")
    assert data is not None and not data.flat
    assert data.best_value == pytest.approx(trace.value[trace.epsilon == trace.epsilon[-1]].max(), rel=1e-7)
    here = tuple(int(np.flatnonzero(axis == one)[0]) for axis, one in zip(data.axes, data.best, strict=True))
    assert data.values[here] == pytest.approx(data.best_value, abs=1e-9)
    assert len(data.visited) == len(data.visited_values) == len(data.accepted)
    g = inspection.relaxed_value(3, data.epsilon)
    again = g.at(trace.points[np.flatnonzero(trace.value == data.visited_values[0])[0]].reshape(3, -1))
    assert again == pytest.approx(data.visited_values[0], rel=1e-7)


def test_indices_that_stand_for_the_same_constraint_move_together_at_their_distance(searched: sr.Outcome) -> None:
    trace = searched.result.trace
    assert trace is not None
    g = sr.Inspection.read(searched.directory).relaxed_value(3, 0.01)
    best = trace.points[np.argmax(np.where(trace.epsilon == trace.epsilon[-1], trace.value, -np.inf))].reshape(3, -1)
    g.at(best)
    top, far = int(np.argmax(g.weights())), int(np.argmin(g.weights()))
    beside = np.clip(best[top] - 0.01 * (g.slot.upper - g.slot.lower), g.slot.lower, g.slot.upper)
    twins = np.stack([best[top], best[far], beside])
    twins[1, 0] = g.slot.upper[0] if best[top, 0] < g.slot.upper[0] / 2 else g.slot.lower[0]
    seen: list[np.ndarray] = []
    kept = replace(g, at=lambda slots: seen.append(slots.copy()) or g.at(slots))
    axes = sr.LandscapeAxes.over(g, 3)
    assert axes is not None
    landscape = sr.Landscape(kept, twins, *axes.places((0, 1), twins), 9, 0.01, axes)
    list(landscape.evaluate())
    assert landscape.value == pytest.approx(g.at(twins), abs=1e-9)
    inside = [one for one in seen if g.slot.lower[0] + 0.1 < one[0, 0] < g.slot.upper[0] - 0.1]
    assert len(inside) > 20
    for one in seen:
        assert ((one >= g.slot.lower) & (one <= g.slot.upper)).all()
    for one in inside:
        assert one[2, 0] - one[0, 0] == pytest.approx(twins[2, 0] - twins[0, 0], abs=1e-12)
    assert (np.stack(seen)[:, :, 1:] == twins[:, 1:]).all()


def test_tuples_of_another_size_are_refused_by_name(searched: sr.Outcome, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(searched.directory, tmp_path / "run"))
    arrays = dict(np.load(copy / "evaluations.npz"))
    for points in (arrays["points"][:, :-1], np.full_like(arrays["points"], np.nan)):
        np.savez(copy / "evaluations.npz", **{**arrays, "points": points})
        trace = stored_run(copy).evaluations
        assert trace is not None
        with pytest.raises(sr.InputError, match="points: expected finite tuples of indices"):
            landscape_of(sr.Inspection.read(copy), trace, "Slice")


def test_why_an_infeasible_run_is_one_is_drawn_again(tmp_path: Path) -> None:
    outcome = sr.run(
        CONFIG,
        {"problem.path": [{"box": [0.05, None], "from": 0.1}], "method": "exchange"},
        out=tmp_path / "run",
        figures=False,
    )
    assert outcome.status == "infeasible"
    assert {file.name for file in draw_run(outcome.directory)} == {"clash.pdf", "clash.png"}


def test_a_search_that_met_no_finite_value_has_no_climb(searched: sr.Outcome, tmp_path: Path) -> None:
    trace = searched.result.trace
    assert trace is not None
    lost = replace(trace, value=np.full_like(trace.value, np.inf))
    result = replace(searched.result, trace=lost, decision=None, status="undecided")
    assert list(drawings(searched.experiment, result, tmp_path, {})) == []


def test_the_rows_of_an_index_are_built_once_while_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[float] = []

    def rows(indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        built.extend(indices[:, 0].tolist())
        return np.stack([indices, 2.0 * indices, 3.0 * indices], axis=2), indices**2

    family = sr.ConstraintFamily(name="f", index_set=sr.Box([0.0], [1.0]), rows=rows)
    kept = inspection._remember_rows(family)
    for indices in ([[0.5], [0.25]], [[0.25], [0.75], [0.75]], [[0.5], [0.75], [0.25]]):
        for got, wanted in zip(kept.rows(np.array(indices)), rows(np.array(indices)), strict=True):
            assert np.array_equal(got, wanted)
        del built[-len(indices) :]
    assert set(built) == {0.5, 0.25, 0.75} and built.count(0.5) == built.count(0.25) == 1
    monkeypatch.setattr(inspection, "MAX_ROW_NUMBERS_KEPT", 6)  # two rows of three numbers
    kept = inspection._remember_rows(family)
    built.clear()
    for index in (0.1, 0.2, 0.3, 0.1):
        kept.rows(np.array([[index]]))
    assert built == [0.1, 0.2, 0.3, 0.1]
