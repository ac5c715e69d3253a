"""Guards experiment/figures: the figures of a run: complete, reproducible, and honest at the edges."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import ControlExperiment, assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.figures import drawing
from sparserob_core.experiment.figures.active import Active, active_of, stored_active
from sparserob_core.experiment.figures.figure_data import MAX_STATES, FigureData, Wall
from sparserob_core.experiment.figures.run_figures import draw_control, draw_convergence, draw_states, run_pictures
from sparserob_core.experiment.figures.style import (
    _report_missing_letters,
    draw_legend,
    held,
    panels,
    save_figure,
    style,
)
from sparserob_core.sip.events import RoundFinished
from tests.support.drafts import whole
from tests.support.problems import double_integrator


@pytest.fixture(scope="module")
def data() -> FigureData:
    times = np.linspace(0.0, 2.0, 21)
    state = np.stack([np.cos(times), -np.sin(times)])
    bounds = [(-np.inf, np.inf, 0.3), (0.5, np.inf, 0.1), (0.99, 1.01, 1e-3), (1.0, 1.0, -1e-9)]
    history = [
        RoundFinished(round=k, epsilon=0.5**k, lower_bound=low, upper_bound=high, violation=worst)
        for k, (low, high, worst) in enumerate(bounds)
    ]
    return FigureData(
        title="Rotation",
        breakpoints=np.linspace(0.0, 2.0, 5),
        control=np.array([[0.0, 1.0, 0.0, -0.5], [0.0, 0.0, 0.2, 0.0]]),
        control_lower=np.array([-1.0, -np.inf]),
        control_upper=np.array([1.0, np.inf]),
        times=times,
        state=state,
        tube_lower=state - 0.1,
        tube_upper=state + 0.1,
        history=history,
        active=Active(np.array([0.5, 2.0])),
        tolerance=1e-6,
        walls=[Wall(state=0, upper=1.2, start=0.0, end=2.0), Wall(state=1, lower=-1.5, upper=0.5, start=2.0, end=2.0)],
    )


def write_figures(directory: Path, data: FigureData) -> list[Path]:
    return [file for name, draw in run_pictures(data).items() for file in save_figure(directory / name, draw)]


@pytest.fixture(scope="module")
def files(data: FigureData, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    with whole():
        return write_figures(tmp_path_factory.mktemp("figures"), data)


@pytest.mark.slow
def test_every_figure_is_written_as_a_vector_and_as_a_picture(files: list[Path]) -> None:
    expected = {f"{name}.{kind}" for name in ("control", "states", "convergence") for kind in ("pdf", "png")}
    assert {file.name for file in files} == expected
    assert all(file.read_bytes()[:4] in (b"%PDF", b"\x89PNG") for file in files)


@pytest.mark.slow
def test_the_same_data_gives_the_same_bytes(files: list[Path], data: FigureData, tmp_path: Path) -> None:
    with whole():
        again = write_figures(tmp_path, data)
    assert [file.read_bytes() for file in files] == [file.read_bytes() for file in again]


def test_an_active_constraint_is_marked_under_the_states_that_it_bounds(data: FigureData) -> None:
    some = replace(data, active=replace(data.active, states=np.array([[True, False], [False, False]])))
    for drawn, counts in ((data, (2, 2)), (some, (1, 0))):
        for axes, count in zip(draw_states(drawn).axes, counts, strict=True):
            marks = [line for line in axes.lines if line.get_label() == "active constraint"]
            assert sum(len(np.ravel(line.get_xdata())) for line in marks) == count
    figure = draw_control(some)
    assert all("active constraint" in [line.get_label() for line in axes.lines] for axes in figure.axes)


@pytest.mark.parametrize(
    ("bounds", "about"),
    [
        ({"box": [None, 0.5]}, {1}),
        ({"polytope": {"H": [[1, 1], [-1, -1]], "h": [2, 2]}}, {0, 1}),
        ({"ellipsoid": {"centre": [0, 0], "shape": [[9, 0], [0, 9]]}}, {0, 1}),
    ],
)
def test_a_constraint_says_which_states_it_bounds(bounds: dict[str, Any], about: set[int]) -> None:
    control = {"name": "piecewise_constant", "pieces": 4}
    problem = {**double_integrator(0.05), "path": [bounds]}
    experiment = assemble(load_config({"problem": problem, "dictionaries": {"control": control}}))
    assert isinstance(experiment, ControlExperiment)
    cuts = [sr.Cut("path", np.array([0.5, 0.0]), row, 1.0) for row in (0, 9)]
    cuts.append(sr.Cut("terminal", np.array([2.0]), 1, 0.0))
    found = active_of(experiment.transcription, cuts)
    assert found.times.tolist() == [0.5] and set(np.flatnonzero(found.states[0])) == about
    kept = {"families": np.array(["path", "terminal"]), "times": np.array([0.5, 2.0]), "rows": np.array([0, 1])}
    stored = stored_active(experiment.transcription, {**kept, "multipliers": np.array([1.0, 1e-12])})
    assert (stored.times.tolist(), stored.states.tolist()) == ([0.5], found.states.tolist())


def test_the_drawn_steps_are_the_control(data: FigureData) -> None:
    for channel, axes in enumerate(draw_control(data).axes):
        drawn = [patch for patch in axes.patches if patch.get_label() == "control"]
        assert len(drawn) == 1
        values, edges, _ = drawn[0].get_data()  # type: ignore[attr-defined]
        middles = (data.breakpoints[:-1] + data.breakpoints[1:]) / 2
        assert np.array_equal(values[np.searchsorted(edges, middles) - 1], data.control[channel])
        assert np.isin(edges, data.breakpoints).all()
        assert np.array_equal(edges[[0, -1]], data.breakpoints[[0, -1]])


def test_walls_appear_only_in_the_panel_of_their_state(data: FigureData) -> None:
    first, second = draw_states(data).axes
    labels = [set(axes.get_legend_handles_labels()[1]) for axes in (first, second)]
    assert "forbidden" in labels[0] and "forbidden" not in labels[1]
    assert "terminal set" in labels[1] and "terminal set" not in labels[0]


def test_the_legend_speaks_of_a_worst_case_only_where_something_is_uncertain(data: FigureData) -> None:
    known = replace(data, tube_lower=data.state, tube_upper=data.state)
    labels = [set(draw_states(one).axes[0].get_legend_handles_labels()[1]) for one in (data, known)]
    assert labels[0] >= {"worst case", "nominal"} and not labels[1] & {"worst case", "nominal"}
    assert "state" in labels[1]


def test_what_a_user_calls_things_is_no_formula() -> None:
    from matplotlib.text import Text

    wild = r"a $\frac{ b_ $ c"
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(-np.eye(1), np.ones((1, 1))),
        horizon=1.0,
        initial_state=[1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.1], [0.1]),
        terminal=[sr.Box([-0.2], [0.2])],
        title=wild,
        names=sr.Names(states=[wild + "x"], controls=[wild + "u"], state_units=[wild], control_units=[wild], time=wild),
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 4})
    for name in ("switching", "adversary"):
        figure = result.plot(name)
        texts = [text.get_text() for text in figure.findobj(Text)]
        assert sum(wild.replace("$", r"\$") in text for text in texts) >= 2
        assert not [text for text in texts if r"$\frac" in text.replace(r"\$", "")]
    assert "parameter" not in figure.axes[0].texts[0].get_text()
    assert "disturbance" in figure.axes[0].texts[0].get_text()


@pytest.mark.parametrize(("radius", "proven"), [(0.01, True), (5.0, False)])
def test_the_title_says_where_nothing_is_proven(radius: float, proven: bool, tmp_path: Path) -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0]]),
        horizon=1.0,
        initial_state=[0.5],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-radius], [radius]),
        terminal=[sr.Box([-0.3], [0.3])],
    )
    control = sr.load_registry().build("dictionary", "piecewise_constant", {"pieces": 2}).build(1.0)
    result = sr.solve(problem, control=control, method="exchange" if proven else "nominal")
    title = result.plot("states").axes[0].get_title(loc="left")
    assert title.endswith("refuted, not proven") is not proven


def test_of_many_states_those_with_constraints_are_drawn_and_those_that_move_the_farthest(data: FigureData) -> None:
    state = np.outer(np.arange(40.0), data.state[0])
    walls = [Wall(state=5, upper=9.0, start=0.0, end=2.0), Wall(state=2, upper=3.0, start=2.0, end=2.0)]
    many = replace(data, state=state, tube_lower=state - 0.1, tube_upper=state + 0.1, walls=walls)
    assert many.drawn_states == (2, 5, *range(30, 40))
    panels = draw_states(many).axes
    assert panels[0].get_title() == "Rotation, 12 of 40 states"
    assert [axes.get_ylabel() for axes in panels] == [many.state_label(one) for one in many.drawn_states]
    assert (data.drawn_states, data.of_states) == ((0, 1), "")


@pytest.mark.parametrize("policy", ["open_loop", "affine"])
def test_of_very_many_states_no_more_is_computed_than_is_drawn(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fourteen tanks of which the first is walled and those behind it move ever less."""
    n = MAX_STATES + 2
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.diag(np.full(n, -1.0)) + np.eye(n, k=-1), np.eye(n)[:, :1], 0.1 * np.eye(n)[:, :1]),
        horizon=1.0,
        initial_state=np.zeros(n),
        control=sr.Box([-9.0], [9.0]),
        disturbance=sr.Box([-1.0], [1.0]),
        terminal=[sr.Box([0.5, *[-9.0] * (n - 1)], [1.5, *[9.0] * (n - 1)])],
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 2}, policy=policy)
    asked: list[int] = []
    whole = drawing.tube

    def counted(model: Any, theta: Any, times: Any, states: Any = None) -> Any:
        asked.append(np.size(times) * (n if states is None else len(states)))
        return whole(model, theta, times, states)

    monkeypatch.setattr(drawing, "tube", counted)
    experiment, decision = result.experiment, np.asarray(result.decision)
    shown = drawing.choose_states(experiment, decision)
    assert shown is not None and set(shown) == {*range(MAX_STATES)}
    data = drawing.figure_data(experiment, decision, None, (), None, states=shown)
    assert data.drawn_states == tuple(shown) and data.of_states == f", {MAX_STATES} of {n} states"
    assert np.isnan(data.tube_lower[MAX_STATES:]).all()
    assert asked[0] == drawing.SAMPLED_TIMES * n and max(asked[1:]) == MAX_STATES * data.times.size
    known = result.tube(data.times)
    np.testing.assert_allclose(data.tube_upper[list(shown)], known.upper[list(shown)], rtol=1e-12)
    np.testing.assert_allclose(data.state[list(shown)], known.nominal[list(shown)], rtol=1e-12)


def test_the_view_contains_the_whole_tube_and_every_wall(data: FigureData) -> None:
    for component, axes in enumerate(draw_states(data).axes):
        low, high = axes.get_ylim()
        edges = [
            edge
            for wall in data.walls
            if wall.state == component
            for edge in (wall.lower, wall.upper)
            if np.isfinite(edge)
        ]
        assert low < min([*edges, data.tube_lower[component].min()])
        assert high > max([*edges, data.tube_upper[component].max()])


def test_bounds_that_are_not_known_yet_are_not_drawn(data: FigureData) -> None:
    bounds, _ = draw_convergence(data).axes
    drawn = {line.get_label(): len(line.get_xdata()) for line in bounds.get_lines()}  # type: ignore[arg-type]
    assert drawn["lower bound"] == 3
    assert drawn["upper bound"] == 2


@pytest.mark.slow
def test_a_run_that_ended_in_its_first_round_can_be_drawn(data: FigureData, tmp_path: Path) -> None:
    only = replace(data, history=data.history[:1], tolerance=None, active=Active(), walls=())
    assert len(write_figures(tmp_path, only)) == 6


@pytest.mark.slow
def test_a_closed_gap_in_the_only_round_can_be_drawn(data: FigureData, tmp_path: Path) -> None:
    assert len(write_figures(tmp_path, replace(data, history=data.history[-1:]))) == 6


def test_a_run_without_rounds_has_no_convergence_figure(data: FigureData, tmp_path: Path) -> None:
    assert {file.stem for file in write_figures(tmp_path, replace(data, history=()))} == {"control", "states"}


def test_a_control_that_does_not_fit_its_pieces_is_refused(data: FigureData) -> None:
    with pytest.raises(InputError, match=r"control: expected \(m, 4\)"):
        replace(data, control=np.zeros((1, 3)))


def test_a_missing_matplotlib_is_named_with_the_line_that_brings_it(
    data: FigureData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"pip install .matplotlib"):
        write_figures(tmp_path, data)


def test_equal_steps_are_drawn_as_one() -> None:
    values, ends = held(np.array([1.0, 1.0, 0.0, 2.0, 2.0, 2.0]), np.arange(7.0))
    np.testing.assert_array_equal(values, [1.0, 0.0, 2.0])
    np.testing.assert_array_equal(ends, [0.0, 2.0, 3.0, 6.0])


@pytest.mark.slow
def test_letters_that_no_font_has_are_told_once_and_other_warnings_are_kept(tmp_path, caplog, data):
    pytest.importorskip("matplotlib")
    odd = replace(data, title="Zug \uf8ff Ω")  # a letter of nobody's
    with caplog.at_level("WARNING", "sparserob"):
        write_figures(tmp_path, odd)
        write_figures(tmp_path, odd)
    assert [record.getMessage() for record in caplog.records] == ["figures: no font here has \uf8ff: boxes stand there"]
    with pytest.warns(UserWarning, match="something else"), _report_missing_letters():
        warnings.warn("something else", UserWarning, stacklevel=1)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "entries",
    [
        ("adversary", "iid", "vertices", "slow", "neighbours", "forbidden", "terminal set", "nominal"),
        ("worst case, with feedback", "nominal", "readings, with noise"),
        ("worst case, with feedback", "terminal set", "nominal", "forbidden", "initial states"),
    ],
)
def test_no_entry_of_a_legend_is_cut_off(entries: tuple[str, ...]) -> None:
    with style():
        figure, axes = panels(1, 1.0)
        for entry in entries:
            axes[0].plot([0.0, 1.0], label=entry)
        draw_legend(figure, axes)
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        FigureCanvasAgg(figure).draw()
    (legend,) = figure.legends
    drawn, page = legend.get_window_extent(), figure.bbox
    assert page.x0 <= drawn.x0 and drawn.x1 <= page.x1
