"""Guards what a search does on the map: where the two indices are that decide most, in every formulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.places import CONFIGS

pytest.importorskip("rerun", reason="a recording needs the extra rerun")


class Heard(sr.Observer):
    def __init__(self) -> None:
        self.events = list[sr.EvaluationsFinished]()

    def receive(self, event: sr.Event) -> None:
        if isinstance(event, sr.EvaluationsFinished):
            self.events.append(event)


SMALL = {
    "dictionaries.control.pieces": 20,
    "dictionaries.disturbance.pieces": 20,
    "method.indices": 5,
    "method.sc2": None,
    "maximiser": {"name": "simulated_annealing", "budget": 80},
    "continuation": {"start": 0.1, "stop": 0.1},
    "observers": [],
}


@pytest.mark.first(1)
@pytest.mark.parametrize("config", ["experiment1_literal.yaml", "experiment1_reduced.yaml"])
def test_every_evaluated_tuple_says_which_indices_have_the_largest_multipliers(config: str) -> None:
    from sparserob_rerun.recording.outlet import joined
    from sparserob_rerun.search.projection import Projector, thin

    heard = Heard()
    sr.run(CONFIGS / config, SMALL, None, quiet=True, figures=False, observers=[heard])
    g = _g(config)
    tuples, values = [], []
    for event in heard.events:
        assert event.coordinates == (0,) and event.deciding.shape == (event.count, 4)
        points = np.concatenate(list(event.batch.points)).reshape(event.count, 5, -1)
        for row, slots in enumerate(points):
            values.append(g.at(slots))
            assert event.deciding[row].tolist() == g.deciding().tolist()
            tuples.append(slots)
        assert np.abs(event.batch.trace.values - values[-event.count :]).max() < 1e-7
    small = thin(joined(heard.events))
    whole = Projector().of(small)
    assert small.batch.trace.points.shape == (80, 5) and small.batch.trace.values.size == small.count == 80
    assert whole.places.shape == (80, 2, 1) and whole.coordinates == (0,)
    rows = np.arange(80)
    assert (whole.places[:, 0, 0] == np.array(tuples)[rows, whole.slots[:, 0], 0]).all()
    assert (whole.places[:, 1, 0] == np.array(tuples)[rows, whole.slots[:, 1], 0]).all()
    assert (whole.slots[:, 0] != whole.slots[:, 1]).all()
    assert whole.moves[:, 0].max() < 80 and set(whole.moves[:, 1]) == {0.0}


def _g(config: str) -> sr.RelaxedValue:
    from sparserob_core.experiment.config.load import load_config

    loaded = load_config(CONFIGS / config, {**SMALL})
    return sr.Inspection(loaded).relaxed_value(5, 0.1)


def batch_of(points: np.ndarray, deciding: list[list[int]], **more: object) -> sr.EvaluationsFinished:
    """An event of tuples of three indices ``(t, w)`` in the unit box, of which ``w`` stays linear."""
    count, box = len(points), sr.Box(np.zeros(6), np.ones(6))
    batch = sr.Batch([points], [np.zeros(count)], [(count, 0.0)])
    event = sr.EvaluationsFinished(count=count, total=count, best_value=0.0, domain=box, block=2, batch=batch)
    return replace(event, coordinates=(0,), deciding=np.array(deciding), **more)  # type: ignore[arg-type]


def test_cells_are_drawn_over_the_indices_that_decide_in_their_middle_and_walks_keep_the_earlier_one_across() -> None:
    from sparserob_rerun.search.projection import Projector, outlines_on, thin

    points = np.array([[0.1, 0, 0.5, 0, 0.9, 0], [0.3, 1, 0.5, 1, 0.2, 1], [0.4, 0, 0.8, 1, 0.2, 0]])
    deciding = [[2, 0, -1, -1], [1, -1, -1, -1], [0, 2, 1, -1]]
    half = np.array([0.1 / 3, 1, 0.02, 1, 0.05, 1])
    cells = sr.Sketch(points[[0, 2]] - half, points[[0, 2]] + half)
    stranger = sr.Sketch(*(np.full((1, 6), 0.77),) * 2)
    event = batch_of(points, deciding, sketches={"cells": cells, "stranger": stranger})
    projection = Projector().of(thin(event))
    # the second tuple has one that decides; the other one is of the pair before
    assert projection.slots.tolist() == [[2, 0], [1, 2], [0, 2]]
    assert projection.places[:, :, 0].tolist() == [[0.9, 0.1], [0.5, 0.2], [0.4, 0.2]]
    axes = sr.LandscapeAxes((0, 1), (0, 0))
    points_on_map = axes.of((0,), projection.places)
    assert points_on_map is not None and points_on_map.tolist() == [[0.1, 0.9], [0.2, 0.5], [0.2, 0.4]]
    corners = outlines_on(axes, (0,), projection.sketches["cells"])
    assert corners is not None
    np.testing.assert_allclose(corners[0], [[0.1 - 0.1 / 3, 0.85], [0.15, 0.4 - 0.1 / 3]])
    np.testing.assert_allclose(corners[1], [[0.1 + 0.1 / 3, 0.95], [0.25, 0.4 + 0.1 / 3]])
    assert projection.sketches["stranger"].count == 1 and projection.sketches["stranger"].points
    assert axes.of((1,), projection.places) is None


def test_the_first_move_of_a_batch_is_from_where_the_walk_stood_before_it() -> None:
    from sparserob_rerun.search.projection import Projector, thin

    points = np.array([[0.1, 0, 0.5, 1, 0.9, 0], [0.1, 0, 0.5, 1, 0.8, 1]])
    event = batch_of(points, [[2, 0, -1, -1]] * 2)
    before = np.array([0.1, 1, 0.4, 0, 0.9, 0])
    later = replace(event, total=9, batch=replace(event.batch, first=7, origin=before))
    projector = Projector()
    assert projector.of(thin(event)).moves.tolist() == [[1.0, 0.0, 0.8]]  # a search begins with no move
    assert projector.of(thin(later)).moves.tolist() == [[0.0, 0.0, 0.5], [1.0, 0.0, 0.8]]


class Columns:
    """A stream that keeps the values of every column, and nothing of how it is drawn."""

    def __init__(self) -> None:
        self.values = dict[str, list[float]]()

    def log(self, *_: Any, **__: Any) -> None:
        pass

    def set_time(self, *_: Any, **__: Any) -> None:
        pass

    def send_columns(self, path: str, _: Any, columns: Any) -> None:
        (scalars,) = columns
        self.values.setdefault(path, []).extend(np.ravel(scalars.as_arrow_array().to_pylist()))


def test_of_the_moves_of_a_walk_those_are_told_that_changed_g() -> None:
    import rerun as rr

    from sparserob_rerun.drawing.timelines import Timelines
    from sparserob_rerun.search.projection import Projector, thin
    from sparserob_rerun.search.search import SearchView
    from sparserob_rerun.search.way import Stage

    times, values = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6], np.array([1.0, 1.5, 1.5, 1.2, 1.6, 1.4])
    points = np.array([[t, 0, 0.5, 0, 0.9, 0] for t in times])
    told = {"accepted": [1, 1, 1, 0, 1, 0], "move": [0, 1, 1, 1, 3, 3], "stands": [1, 2, 3, 3, 5, 5]}
    told["local"] = [0, 1, 1, 0, 0, 1]  # of another maximiser
    notes = {name: [(k + 1.0, float(value)) for k, value in enumerate(row)] for name, row in told.items()}
    event = thin(batch_of(points, [[0, 1, -1, -1]] * 6))
    event = replace(event, best_value=1.6, batch=replace(event.batch, values=[values], notes=notes))
    # the third is accepted and leaves g as it is, the fourth and the sixth are refused
    assert event.batch.changes.tolist() == [False, True, False, True, True, True]
    stream, stage, projection = Columns(), Stage(1, 0.1, 0), Projector().of(event)
    stage.add(event, projection)
    SearchView(rr, stream, Timelines(rr, stream)).show(event, stage, 0.0, {0: "t"}, projection)
    assert stream.values["search/moves/t"] == [0.2, 0.5]
    np.testing.assert_allclose(stream.values["search/notes/accepted"], [1.0, 0.5, 2 / 3, 0.5])
    np.testing.assert_allclose(stream.values["search/notes/local"], [0.0, 1 / 2, 2 / 3, 1 / 2, 2 / 5, 1 / 2])
    shares = {path[-1]: found for path, found in stream.values.items() if path.startswith("search/notes/move/")}
    assert shares == {"1": [1.0, 0.5], "3": [1.0, 0.5]}


def test_beside_a_literal_tuple_it_is_said_how_far_below_the_map_it_is_and_what_the_map_shows_instead() -> None:
    from sparserob_rerun.search.explorer import Aim
    from sparserob_rerun.search.terrain import _own

    landscape: Any = SimpleNamespace(value=0.632, level=1)
    aim = Aim(np.zeros((2, 1)), 0.1, 0.482, "")
    assert "g = 0.482, 0.15 below the map, which has the worst disturbances" in _own(landscape, aim)
    assert _own(landscape, replace(aim, value=0.632)) == "orange dot: the best tuple, g = 0.632"


class Kept:
    """A stream that keeps the last of what was logged for every entity, by the kind of it."""

    def __init__(self) -> None:
        self.last = dict[str, dict[str, Any]]()

    def log(self, path: str, *parts: Any, **_: Any) -> None:
        self.last[path] = {type(part).__name__: part for part in parts}

    def image(self, path: str) -> np.ndarray:
        image = self.last[path]["DepthImage"]
        fmt = image.format.as_arrow_array().to_pylist()[0]
        data = np.array(image.buffer.as_arrow_array().to_pylist()[0], dtype=np.uint8).view(np.float32)
        return data.reshape(fmt["height"], fmt["width"])


def test_the_map_is_numbers_with_g_under_the_cursor_and_a_colour_bar_of_its_values() -> None:
    import rerun as rr

    from sparserob_rerun.drawing.canvas import LIFT
    from sparserob_rerun.search.explorer import Aim
    from sparserob_rerun.search.terrain import CELLS, HEIGHT, WIDTH, Terrain

    g = plain(lambda s: np.inf if s.max() > 0.8 else s[0, 0] + s[1, 0], ("time",))
    found, _ = drawn_of(g, [[0.2], [0.7]])
    stream, aim = Kept(), Aim(found[-1][0].anchor, 0.1, found[-1][0].value, "through it")
    terrain = Terrain(rr, stream, "s", "m/s")
    terrain.surface(found[-1][0], aim)
    image, middles = stream.image("landscape/map/g"), (np.arange(CELLS) + 0.5) / CELLS
    assert image.shape == (CELLS, CELLS) == (33, 33)
    across, up = np.meshgrid(middles, middles[::-1])  # the highest time is at the top
    known = (across < 0.7) & (up < 0.7)
    np.testing.assert_allclose(image[known], (across + up)[known], rtol=1e-6)
    assert np.isnan(image[(across > 0.9) | (up > 0.9)]).all()
    brown = stream.last["landscape/map/infeasible"]
    assert set(brown) == {"Transform3D", "Image"}
    scale = stream.last["landscape/map/g"]["Transform3D"].scale.as_arrow_array().to_pylist()[0]
    np.testing.assert_allclose(scale, [WIDTH / CELLS, HEIGHT / CELLS, 1.0], rtol=1e-6)
    bar = stream.image("landscape/map/bar")[:, 0]
    low, high = terrain.scale
    assert (np.diff(bar) < 0).all() and low < bar[-1] < bar[0] < high
    assert bar[0] - bar[-1] == pytest.approx((high - low) * (1.0 - 1.0 / bar.size), rel=1e-5)
    for path in ("landscape/map/g", "landscape/map/bar"):  # the same colours for the same numbers
        limits = stream.last[path]["DepthImage"].depth_range.as_arrow_array().to_pylist()[0]
        assert limits == pytest.approx([low, high])
    axes = stream.last["landscape/map/axes/labels"]["Points2D"]
    labels = list(
        zip(axes.labels.as_arrow_array().to_pylist(), axes.positions.as_arrow_array().to_pylist(), strict=True)
    )
    beside = [(float(words), at[1] + LIFT) for words, at in labels if at[0] > WIDTH and words[0].isdigit()]
    assert "g in m/s" in [words for words, _ in labels] and len(beside) >= 2
    for value, y in beside:
        assert y == pytest.approx(HEIGHT * (high - value) / (high - low))


def test_what_the_map_shows_is_said_beside_it_and_only_when_it_changes() -> None:
    import rerun as rr

    from sparserob_rerun.search.explorer import Aim
    from sparserob_rerun.search.terrain import Terrain

    written: list[str] = []

    class Told(Kept):
        def log(self, path: str, *parts: Any, **_: Any) -> None:
            if path == "landscape/words":
                written.append(parts[0].text.as_arrow_array().to_pylist()[0])

    found, _ = drawn_of(plain(lambda s: s[0, 0] + s[1, 0], ("time",)), [[0.2], [0.7]])
    terrain = Terrain(rr, Told())
    assert len(written) == 1 and "least cost of a control" in written[0]
    aim = Aim(found[-1][0].anchor, 0.1, found[-1][0].value, "through it")
    terrain.surface(found[-1][0], aim)
    terrain.surface(found[-1][0], aim)
    assert len(written) == 2 and "g from 0 (dark) to 2 (bright)" in written[1] and "through it" in written[1]
    terrain.mark("proven")
    assert len(written) == 3 and written[2].endswith("pink: proven")


@pytest.mark.parametrize(
    ("value", "last", "marked"), [(0.5 - 1e-7, False, True), (0.4, False, False), (0.4, True, True)]
)
def test_the_optimum_is_marked_on_a_map_through_it_or_through_a_tuple_whose_value_is_the_same_to_the_eye(
    value: float, last: bool, marked: bool
) -> None:
    from sparserob_rerun.recording.recorder import Recorder

    landscape, told = SimpleNamespace(value=value, epsilon=0.0), list[str]()
    recorder: Any = SimpleNamespace(
        terrain=SimpleNamespace(known=landscape, mark=None),
        explorer=SimpleNamespace(landscape=landscape if last else None),
        exact=0.5,
        draw=lambda panel, task, words: told.append(words),
    )
    Recorder.mark(recorder)
    assert told == ["proven to be the highest: 0.5"] * marked


@pytest.mark.parametrize("value", [0.0, 0.4, 1.0])
def test_the_value_of_the_best_point_is_above_the_whole_surface_and_no_line_crosses_it(value: float) -> None:
    import rerun as rr

    from sparserob_rerun.search.terrain import WORDS, Terrain

    kept: dict[str, Any] = {}
    stream = SimpleNamespace(log=lambda path, *parts, **_: kept.update({path: parts[0]}))
    line = np.array([0.0, 1.0])
    landscape: Any = SimpleNamespace(
        axes=(line, line), at=(1, 0), shown=(line, line, np.eye(2)), flat=False, value=value, names=lambda _: ("t", "t")
    )
    Terrain(rr, stream)._mesh(landscape, (0.0, 1.0))
    labels = kept["landscape/surface/labels"]
    words = labels.labels.as_arrow_array().to_pylist()
    (place,) = [
        at for at, said in zip(labels.positions.as_arrow_array().to_pylist(), words, strict=True) if "best" in said
    ]
    ((foot, end),) = kept["landscape/surface/pole"].strips.as_arrow_array().to_pylist()
    assert place[:2] == foot[:2] == end[:2] == [1.0, 0.0] and place[2] > 1.3
    assert foot[2] == pytest.approx(value, abs=0.02) and end[2] == pytest.approx(place[2] - WORDS)


def test_an_index_beside_the_first_is_not_the_second() -> None:
    from sparserob_core.experiment.run.landscape import two_of

    slots, widths = np.array([[0.5], [0.52], [0.9], [0.1]]), np.ones(1)
    assert two_of([0, 1, 2, 3], slots, widths, (3, 2)) == (0, 2)
    assert two_of([0, 1, -1, -1], slots, widths, (0, 3)) == (0, 3)
    assert two_of([-1, -1, -1, -1], slots, widths, (3, 2)) == (3, 2)
    assert two_of([0], slots[:1], widths, (0, 0)) == (0, 0)


def test_the_pairs_of_many_tuples_are_those_of_one_after_the_other() -> None:
    from sparserob_core.experiment.run.landscape import two_of

    rng, widths = np.random.default_rng(0), np.array([1.0, 2.0])
    tuples = np.round(rng.random((300, 5, 2)) * widths, 1)
    deciding = np.argsort(rng.random((300, 5)), axis=1)[:, :4]
    deciding[np.arange(4) >= rng.integers(5, size=(300, 1))] = -1
    pair, alone = (1, 3), []
    for ranked, slots in zip(deciding, tuples, strict=True):
        alone.append(pair := two_of(ranked, slots, widths, pair))
    assert sr.deciding_slots(deciding, tuples, widths, (1, 3)).tolist() == [list(pair) for pair in alone]
    one, none = np.zeros((2, 1, 2)), np.array([[0, -1, -1, -1], [-1, -1, -1, -1]])
    assert sr.deciding_slots(none, one, widths, (0, 0)).tolist() == [[0, 0], [0, 0]]


def test_words_are_bright_and_lines_of_plots_legible_on_a_dark_and_on_a_light_ground() -> None:
    from sparserob_rerun.drawing import palette as ink

    def contrast(one: tuple[int, ...], other: tuple[int, ...]) -> float:
        linear = [
            sum(share * (part / 255.0) ** 2.2 for share, part in zip((0.2126, 0.7152, 0.0722), colour[:3], strict=True))
            for colour in (one, other)
        ]
        return (max(linear) + 0.05) / (min(linear) + 0.05)

    veil = (128, 128, 128)  # what the viewer writes on above a dark ground in its light theme
    for colour in (ink.INK, ink.GREY, ink.ORANGE, ink.GREEN, ink.PURPLE, ink.VERMILLION, ink.SKY):
        assert contrast(ink.worded(colour), veil) > 3.0
        assert contrast(ink.legible(colour), (255, 255, 255)) > 3.0 < contrast(ink.legible(colour), (20, 20, 20))


@pytest.mark.slow
def test_the_map_of_a_policy_goes_through_its_proven_bound_and_nowhere_above_its_cost() -> None:
    from sparserob_core.experiment.config.load import load_config
    from sparserob_rerun.recording.recorder import slots_of

    config = CONFIGS / "experiment1_feedback.yaml"
    result = sr.run(config, {}, None, quiet=True, figures=False).result
    view = sr.Inspection(load_config(config))
    slots = slots_of(list(result.dual.cuts), "literal", len(result.dual.cuts))
    g = view.relaxed_value(len(slots), 0.0)
    assert g.at(slots) == pytest.approx(result.lower_bound, rel=1e-7)
    pair = sr.deciding_pair(g, slots)
    path = [cut.index[0] for cut in result.dual.cuts if cut.family == "path"]
    assert slots[pair[0], 0] in path
    axes = sr.LandscapeAxes.over(g, len(slots))
    assert axes is not None
    landscape = sr.Landscape(g, slots, *axes.places(pair, slots), 8)
    for at, least, most in (
        ((slots[landscape.first], slots[landscape.second]), result.lower_bound, result.cost),
        ((0.7, 4.0), 0.0, result.lower_bound - 0.1),
    ):
        moved = slots.copy()
        for place, moving, to in zip((landscape.first, landscape.second), landscape._moving_indices, at, strict=True):
            moved[moving, place[1]] = to
            moved[moving, 1:] = np.nan
        assert least - 1e-6 <= g.at(moved) <= most + 1e-6


@pytest.mark.slow
def test_a_value_of_a_policy_is_computed_in_the_programs_own_units_and_given_up_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from sparserob_core.experiment.config.load import load_config
    from sparserob_core.sip.relaxed.policy_value import PolicyValue
    from sparserob_rerun.recording.recorder import slots_of

    config = CONFIGS / "atv_feedback.yaml"  # metres and 1e-5 m/s^2, of which a solver makes nothing
    result = sr.run(config, {}, None, quiet=True, figures=False).result
    view, programs = sr.Inspection(load_config(config)), []
    began = PolicyValue.__init__
    monkeypatch.setattr(
        PolicyValue, "__init__", lambda value, program: (programs.append(program), began(value, program))[1]
    )
    slots = slots_of(list(result.dual.cuts), "literal", len(result.dual.cuts))
    g = view.relaxed_value(len(slots), 0.0)
    own = view.program.own_units
    assert own is not None and programs == [own.program]
    assert g.at(slots) == pytest.approx(result.lower_bound, rel=1e-7)
    assert slots[g.deciding()[0], 0] == pytest.approx(6600.0)
    moved = slots.copy()
    moved[0, 0], moved[[0, 2], 1:] = 7050.0, np.nan
    # begun where the rows at a deviation are at their optimum, or from nothing
    assert g.at(moved) == pytest.approx(view.relaxed_value(len(slots), 0.0).at(moved), rel=1e-7)
    monkeypatch.setattr("sparserob_core.sip.relaxed.policy_value.LASTING", 0.0)
    everywhere = slots.copy()
    everywhere[:, 1:] = np.nan  # at all deviations, for which a solver needs some hundred steps
    assert np.isnan(g.at(everywhere))


def drawn_of(g: Any, *tuples: list[list[float]]) -> tuple[list[tuple[sr.Landscape, Any]], Any]:
    """What an explorer draws of tuples that it is asked for one after the other, each to its end."""
    from sparserob_rerun.options import LandscapeOptions
    from sparserob_rerun.search.explorer import Aim, Explorer

    found: list[tuple[sr.Landscape, Any]] = []
    view: Any = SimpleNamespace(relaxed_value=lambda count, epsilon: g)
    explorer = Explorer(lambda shown, aim: found.append((shown, aim)), view, LandscapeOptions(grid=8))
    for number, slots in enumerate(tuples):
        explorer.aim(Aim(np.array(slots), 0.1, float(number), ""))
        explorer.finish(60.0)
    return found, explorer


def plain(value: Callable[[np.ndarray], float], kinds: tuple[str, ...], moves: tuple[int, ...] | None = None) -> Any:
    """A function of tuples in the place of ``g``."""
    width = len(kinds)
    g: Any = SimpleNamespace(at=value, slot=sr.Box(np.zeros(width), np.ones(width)), kinds=kinds, interchangeable=True)
    g.names = tuple(f"{kind[0]}{k}" for k, kind in enumerate(kinds))
    g.coordinates = tuple(range(width)) if moves is None else moves
    g.deciding = lambda: np.array([0, 1, -1, -1])
    return g


KINDS = ("time", "parameter", "parameter")


@pytest.mark.parametrize(
    ("value", "axes"),
    [
        (lambda s: s[0, 0] + 9 * s[0, 1] + 5 * s[1, 2], ((0, 1), (1, 2))),
        (lambda s: 3 * s[0, 0] + 2 * s[1, 0] + s[0, 1], ((0, 0), (1, 0))),
        (lambda s: np.inf if s[0, 2] > 0.9 else 4 * s[1, 0], ((1, 0), (0, 2))),
        (lambda s: -abs(s[0, 1] - 0.5) - abs(s[0, 2] - 0.4) + 0.1 * s[0, 0], ((0, 1), (0, 2))),
        (lambda s: 1.0, ((0, 0), (1, 0))),
    ],
)
def test_axes_are_the_coordinates_along_which_g_moves_most(value: Any, axes: tuple[tuple[int, int], ...]) -> None:
    found, _ = drawn_of(plain(value, KINDS), [[0.2, 0.5, 0.5], [0.7, 0.5, 0.5]])
    landscape = found[-1][0]
    assert (landscape.first, landscape.second) == axes and landscape.level == 1
    low, high = landscape.limits
    assert landscape.flat or high - low > 0.5


def test_a_map_over_one_coordinate_of_two_like_indices_is_symmetric_and_half_of_it_is_evaluated() -> None:
    """Also where a third index moves with one of the two; both of their places are lines of either axis."""
    asked: list[np.ndarray] = []

    def value(slots: np.ndarray) -> float:
        asked.append(slots.copy())
        return float(np.exp(-50.0 * (slots[:, 0] - 0.33) ** 2).sum())

    found, _ = drawn_of(plain(value, ("time",)), [[0.33], [0.71], [0.72]])
    for shown, _ in found:
        across, up, values = shown.shown
        assert (across == up).all() and {0.33, 0.71} <= {*across.tolist()}
        assert (values == values.T).all()
        assert shown.value == pytest.approx(1.0 + np.exp(-50 * 0.38**2) + np.exp(-50 * 0.39**2))
    finest = found[-1][0]
    size = finest.shown[0].size
    assert len(asked) - 1 == finest.spent == size * (size + 1) // 2  # one more says which indices decide
    for slots in asked:
        assert slots[0, 0] <= slots[1, 0] and slots[2, 0] == pytest.approx(min(1.0, slots[1, 0] + 0.01))


def test_what_is_not_visibly_better_is_not_drawn_anew() -> None:
    from sparserob_rerun.search.explorer import Aim

    found, explorer = drawn_of(plain(lambda s: s[0, 0] + s[1, 0], ("time",)), [[0.2], [0.7]])
    for gain, waits in ((1e-8, False), (np.nan, True), (1e-4, True)):
        explorer.aim(Aim(np.array([[0.3], [0.7]]), 0.1, found[-1][1].value + gain, ""))
        assert (explorer.waiting is not None) == waits
        explorer.waiting = None
    explorer.aim(Aim(np.array([[0.3], [0.7]]), 0.01, found[-1][1].value, ""))  # of another weight it is another map
    assert explorer.waiting is not None


def test_a_tuple_without_a_map_is_not_the_end_of_the_map_and_one_index_has_one_more_beside_it() -> None:
    found, explorer = drawn_of(plain(lambda s: 1.0, ("time",), ()), [[0.2]])
    assert not found and "no coordinate of the indices can move" in explorer.wrong and explorer.left > 0

    def value(slots: np.ndarray) -> float:
        if (slots[:, 0] > 2.0).any():
            raise sr.InputError("the first tuple has no value")
        return float(np.max(slots[:, 0]))

    g = plain(value, ("time",))
    g.slot = sr.Box(np.zeros(1), np.full(1, 3.0))
    found, explorer = drawn_of(g, [[2.5]])
    assert not found and "the first tuple has no value" in explorer.wrong
    found, explorer = drawn_of(plain(lambda s: float(np.max(s)), ("time",)), [[0.4]], [[0.2]])
    assert explorer.wrong == "" and {float(shown.value) for shown, _ in found} == {0.4, 0.2}
    shown = found[-1][0]
    assert shown.level == 1 and shown.anchor.shape == (2, 1) and shown.limits == (0.0, 1.0)


def test_what_is_drawn_last_is_never_coarser_than_what_was_drawn_before_where_it_is_hardly_higher() -> None:
    from sparserob_rerun.search.explorer import LARGE, Aim

    found, explorer = drawn_of(plain(lambda s: s[0, 0] + s[1, 0], ("time",)), [[0.2], [0.7]])
    height = 2.0
    assert [shown.level for shown, _ in found][-1] == 1
    for gain, more in ((0.5 * LARGE * height, 0), (2.0 * LARGE * height, 1)):
        count = len(found)
        explorer.aim(Aim(np.array([[0.3], [0.7 + gain]]), 0.1, gain, ""))
        explorer.left = 1000  # of the next one there is the coarsest only
        explorer.finish(0.2)
        assert len(found) == count + more


def test_where_nothing_is_seen_on_a_coarse_grid_a_finer_one_comes_before_that_of_a_better_tuple(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from sparserob_rerun.options import LandscapeOptions
    from sparserob_rerun.search import explorer as search
    from sparserob_rerun.search.explorer import Aim, Explorer

    spent: list[int] = []

    def levels(value: Callable[[np.ndarray], float], interchangeable: bool = True) -> list[tuple[int, float]]:
        box = sr.Box(np.zeros(1), np.ones(1))
        g: Any = SimpleNamespace(at=value, slot=box, names=("t",), kinds=("time",), coordinates=(0,))
        g.deciding, g.interchangeable = (lambda: np.array([0, 1, -1, -1])), interchangeable
        view: Any = SimpleNamespace(relaxed_value=lambda count, epsilon: g)
        drawn: list[tuple[int, float]] = []

        def draw(shown: sr.Landscape, aim: Aim) -> None:
            drawn.append((shown.level, aim.value))
            spent.append(shown.spent)

        explorer = Explorer(draw, view, LandscapeOptions())
        explorer.aim(Aim(np.array([[0.2], [0.7]]), 0.1, 1.0, ""))
        while len(drawn) < 4:
            explorer.step(hurry=True)
            if len(drawn) == 1:
                explorer.aim(Aim(np.array([[0.3], [0.8]]), 0.1, 2.0, ""))
        return drawn

    assert levels(lambda slots: 3.0) == [(8, 1.0), (4, 1.0), (2, 1.0), (8, 2.0)]
    with monkeypatch.context() as patch:  # unless what is seen is old by then
        patch.setattr(search, "STALE", 0.0)
        assert levels(lambda slots: 3.0)[:2] == [(8, 1.0), (8, 2.0)]
    assert levels(lambda slots: 3.0 + slots[0, 0])[1] == (8, 2.0)
    spent.clear()  # of a policy, each value of which is a robust program, a few come first
    assert levels(lambda slots: 3.0 + slots[0, 0], interchangeable=False)[0] == (16, 1.0) and spent[0] <= 16


def test_the_first_map_of_a_weight_is_beside_the_share() -> None:
    from sparserob_rerun.options import LandscapeOptions
    from sparserob_rerun.search.explorer import Aim, Explorer

    g = plain(lambda slots: 3.0 + slots[0, 0], ("time",))
    view: Any = SimpleNamespace(relaxed_value=lambda count, epsilon: g)
    drawn: list[float] = []
    explorer = Explorer(lambda shown, aim: drawn.append(aim.epsilon), view, LandscapeOptions())
    explorer.aim(Aim(np.array([[0.2], [0.7]]), 0.1, 1.0, ""))
    explorer.used = 100.0
    while not drawn:
        explorer.step()
    assert explorer.used < 1.0
    explorer.used = 100.0
    assert explorer.rest > 100.0  # finer ones are not
    explorer.aim(Aim(np.array([[0.3], [0.8]]), 0.01, 1.0, ""))
    while drawn[-1] != 0.01:
        explorer.step()
    assert explorer.used < 1.0
