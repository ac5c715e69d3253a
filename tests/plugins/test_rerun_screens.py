"""Guards plugins/sparserob_rerun: the screens of physics, bounds and infeasible runs say everything once, and nothing
that contradicts another line."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr

pytest.importorskip("rerun")

import rerun as rr
import rerun.blueprint as rrb

from sparserob_core.experiment.figures.drawing import figure_data
from sparserob_core.experiment.run.replay import stored_result, stored_run
from sparserob_rerun.drawing.canvas import Axes, Drawing
from sparserob_rerun.exchange import rounds
from sparserob_rerun.exchange.bounds import FEWEST, ONE, Bounds
from sparserob_rerun.exchange.clash import draw_clash, extent
from sparserob_rerun.exchange.rounds import Rounds, Worst, told_by_result
from sparserob_rerun.physics import phase, physics
from sparserob_rerun.physics.pages import heading, pages
from sparserob_rerun.physics.phase import moved
from sparserob_rerun.physics.physics import Physics
from sparserob_rerun.recording import words
from sparserob_rerun.recording.layout import Shown, layout
from tests.support.places import CONFIGS

SIX: dict[str, Any] = {
    "title": "Three carts",
    "problem": {
        "name": "linear",
        "system": {
            "A": np.diag([1.0, 0.0, 1.0, 0.0, 1.0], 1).tolist(),
            "B": np.eye(6)[:, 1::2].tolist(),
            "parameters": {},
        },
        "horizon": 2.0,
        "initial_state": [1, 0, -0.5, 0, 0.8, 0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0, 0.02, 0, 0.02, 0, 0.02]},
        "path": [{"box": [None, None, None, None, 0.9, 5.0], "from": 0.5}],
        "terminal": [{"box": [0.9, 2, 2, 2, 2, 2]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
    "method": {"name": "exchange"},
}
SMALL: dict[str, Any] = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.0, 0.05]},
        "terminal": [{"box": [0.5, 0.5]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
    "method": {"name": "exchange"},
}


class Paper:
    """A stream that keeps what is logged, the last of every entity."""

    def __init__(self) -> None:
        self.kept: dict[str, list[Any]] = {}

    def log(self, path: str, *parts: Any, **_: Any) -> None:
        self.kept[path] = list(parts)

    def send_columns(self, path: str, *_: Any, **__: Any) -> None:
        self.kept.setdefault(path, [])

    def labels(self, path: str) -> list[str]:
        return [str(label) for label in self.kept[path][0].labels.as_arrow_array().to_pylist()]

    def strips(self, path: str) -> list[np.ndarray]:
        return [np.array(strip) for strip in self.kept[path][0].strips.as_arrow_array().to_pylist()]


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    return sr.run(SIX, out=tmp_path_factory.mktemp("runs") / "six", quiet=True, figures=False)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    return sr.run(SMALL, out=tmp_path_factory.mktemp("runs") / "small", quiet=True, figures=False)


@pytest.fixture(scope="module")
def infeasible(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    changes = {"problem.terminal": [{"box": [0.01, 0.01]}]}
    return sr.run(SMALL, changes, out=tmp_path_factory.mktemp("runs") / "none", quiet=True, figures=False)


def test_every_control_and_state_is_on_one_page_and_those_with_walls_on_the_first(six: sr.Outcome) -> None:
    assert six.problem is not None
    found = pages(six.problem)
    plots = [plot for page in found for plot in page.plots]
    assert sorted(plots) == sorted(
        [(kind, k) for kind in ("control", "switching") for k in range(3)] + [("state", k) for k in range(6)]
    )
    assert {("state", 4), ("state", 5)} <= set(found[0].plots)
    for page in found[1:]:
        assert page.name(six.problem.names) in heading(six.problem)
    assert all(len(page.plots) <= 8 for page in found)


def test_what_is_on_a_further_page_is_drawn_there(six: sr.Outcome) -> None:
    paper = Paper()
    assert six.problem is not None
    Physics(rr, paper, sr.Inspection.read(six.directory)).draw(
        np.asarray(six.result.decision), six.result.indices, six.result.dual.mu
    )
    for page in pages(six.problem):
        titles = " ".join(paper.labels(f"{page.path}/labels"))
        for kind, k in page.plots:
            assert f"{'state x' if kind == 'state' else 'u'}{k + 1}" in titles
        assert "t" in paper.labels(f"{page.path}/labels")


def test_a_constraint_is_marked_where_it_pushes_and_under_the_states_that_it_bounds(six: sr.Outcome) -> None:
    paper, view = Paper(), sr.Inspection.read(six.directory)
    active = [cut for cut in six.result.indices if cut.multiplier > 0.0]
    assert active and six.problem is not None
    Physics(rr, paper, view).draw(np.asarray(six.result.decision), six.result.indices, six.result.dual.mu)
    for page in pages(six.problem):
        dots = paper.kept[f"{page.path}/dots"][0].positions.as_arrow_array().to_pylist()
        for place, (kind, k) in enumerate(page.plots):
            each = physics.HEIGHT if page.path != "physics/plots" else physics.height(len(page.plots), False)
            top = place * (each + physics.GAP)
            mine = [dot for dot in dots if top <= dot[1] <= top + each + 1e-3]
            told = [cut for cut in active if kind != "state" or f"x{k + 1}(" in words.cut_words(cut, view)]
            assert len(mine) == len({float(cut.index[0]) for cut in told}), (kind, k)


def test_every_signal_has_a_name_and_a_colour_of_its_own(six: sr.Outcome) -> None:
    paper = Paper()
    Physics(rr, paper, sr.Inspection.read(six.directory)).signals(np.asarray(six.result.decision))
    lines = [parts[0] for path, parts in paper.kept.items() if path.startswith("signals/states")]
    names = [name for line in lines for name in line.names.as_arrow_array().to_pylist()]
    colours = [line.colors.as_arrow_array().to_pylist()[0] for line in lines]
    assert len(lines) == 6 and len(set(names)) == 18 and len(set(colours)) == 6


def entry(number: int, lower: float, upper: float) -> sr.RoundFinished:
    return sr.RoundFinished(round=number, epsilon=1.0, lower_bound=lower, upper_bound=upper, violation=0.5**number)


def test_the_bounds_are_drawn_where_they_are_with_the_gap_between_them() -> None:
    paper = Paper()
    picture = Bounds(rr, paper)
    for one in (entry(1, -np.inf, np.inf), entry(2, 0.5, np.inf), entry(3, 0.9, 1.2), entry(4, 0.95, 1.0)):
        picture.add(one)
    lower, upper = paper.strips("rounds/picture/bounds/curve")
    assert len(lower) == 3 and len(upper) == 2
    assert (np.diff(lower[:, 1]) < 0).all()  # pixels count downwards
    assert upper[-1, 1] < lower[-1, 1]
    gap = paper.strips("rounds/picture/bounds/tube")
    tops = {round(float(strip[:, 1].min()), 3) for strip in gap}
    assert tops == {round(float(upper[-1, 1]), 3)}  # up to the best upper bound
    assert "0.95 ≤ J* ≤ 1" in " ".join(paper.labels("rounds/picture/bounds/labels"))
    picture.end(0.99, 1.0, 0.01)
    assert "0.99 ≤ J* ≤ 1" in " ".join(paper.labels("rounds/picture/bounds/labels"))
    assert picture.rows[-1][3] == 0.01  # the gap beside it, too


@pytest.mark.parametrize("gap", [1e-9, 1e-6, 1e-3, 0.5])
def test_numbers_beside_the_bounds_differ_and_have_room(gap: float) -> None:
    paper = Paper()
    picture = Bounds(rr, paper)
    picture.add(entry(1, 12.254221, 12.254221 * (1.0 + gap)))
    beside = paper.labels("rounds/picture/bounds/labels")
    numbers = [words for words in beside if words.replace(".", "").isdigit() and float(words) > FEWEST + 0.5]
    assert len(numbers) >= 2 and len(set(numbers)) == len(numbers) and max(map(len, numbers)) <= 7


@pytest.mark.parametrize("lower", [0.0, 0.217, 0.63204925, -3.5])
def test_no_word_of_the_bounds_lies_on_another(lower: float) -> None:
    for upper in (np.inf, lower + 1e-8, lower + 0.3):
        paper = Paper()
        picture = Bounds(rr, paper)
        for number in (1, 2):
            picture.add(entry(number, lower if number == 2 else 0.0, upper))
        kept = paper.kept["rounds/picture/bounds/labels"][0]
        places = [np.array(at) for at in kept.positions.as_arrow_array().to_pylist()]
        words = paper.labels("rounds/picture/bounds/labels")
        assert over([(at, one, None) for at, one in zip(places, words, strict=True)], 0.63) == []
        assert min(at[0] - len(one) * WIDE / 1.26 for at, one in zip(places, words, strict=True)) > ONE[0]


def test_the_plots_fill_their_panel_and_of_a_search_a_wide_one(six: sr.Outcome) -> None:
    for searches, aspect in physics.ASPECT.items():
        for count in (2, 3, 4):
            left, right, top, bottom = physics.extent(count, physics.height(count, searches))
            assert (right - left) / (bottom - top) == pytest.approx(aspect)
    paper, view = Paper(), sr.Inspection.read(six.directory)
    assert six.problem is not None
    Physics(rr, paper, view, True).draw(np.asarray(six.result.decision), six.result.indices, None)
    first = pages(six.problem)[0]
    limits = physics.extent(len(first.plots), physics.height(len(first.plots), True))
    for strip in paper.strips(f"{first.path}/frame"):
        assert (strip >= (limits[0], limits[2])).all() and (strip <= (limits[1], limits[3])).all()


def test_what_is_as_it_was_is_not_sent_again() -> None:
    sent: list[str] = []

    class Counting(Paper):
        def log(self, path: str, *parts: Any, **_: Any) -> None:
            sent.append(path)

    paper = Counting()
    for height, label, expected in (
        (1.0, "one", ["here/curve", "here/labels", "here/dots"]),
        (1.0, "one", []),
        (2.0, "one", ["here/curve"]),
        (2.0, "two", ["here/labels"]),
    ):
        drawing = Drawing()
        drawing.line("curve", np.array([[0.0, 0.0], [1.0, height]]), (0, 0, 0, 255))
        drawing.text(0.0, 0.0, label)
        drawing.dot(np.zeros((1, 2)), (0, 0, 0, 255))
        sent.clear()
        drawing.log(rr, paper, "here")
        assert sent == expected


def test_a_line_of_a_search_has_its_corners_and_no_more() -> None:
    from sparserob_rerun.search.search import _corners

    assert _corners(np.array([3.0])).tolist() == [0]
    assert _corners(np.full(50, 0.6)).tolist() == [0, 49]
    assert _corners(0.1 * np.arange(50.0)).tolist() == [0, 49]
    assert _corners(np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])).tolist() == [0, 2, 3, 5]
    assert _corners(np.full(50, np.nan)).tolist() == [0]
    values = np.random.default_rng(0).normal(size=40).cumsum()
    values[[10, 11, 30]] = np.nan
    kept = _corners(values)
    assert {9, 10, 12, 29, 30, 31} <= set(kept.tolist()) and 11 not in kept  # of two in a row that are not finite one
    known = np.isfinite(values[kept])
    inside = np.isfinite(values)
    line = np.interp(np.flatnonzero(inside), kept[known], values[kept][known])
    np.testing.assert_allclose(line, values[inside], atol=1e-6)


def test_what_a_run_is_at_is_said_at_any_moment() -> None:
    searched = sr.EvaluationsFinished(count=1, total=1, best_value=0.0)
    finished = sr.RunFinished(status="certified", message="", seconds=1.0)
    proof, one = sr.ProofProgress(family="path", cells=1, bound=0.1), entry(1, 0.0, 1.0)
    told, state = list[str](), ""
    for event in (
        searched,
        replace(searched, phase="polish"),
        one,
        proof,
        one,
        replace(searched, family="path"),
        finished,
    ):
        told.append(state := words.state_of(event, state))
    assert told == ["search", "polish", "polish", "proof", "rounds", "violations", "certified"]
    assert set(told) <= set(words.STATES)
    assert words.state_of(sr.StudyProgress(text="figures"), "proof") == "proof"


def test_what_a_drawing_has_no_more_is_taken_away() -> None:
    paper, before = Paper(), Drawing()
    before.line("bound", np.zeros((2, 2)), (0, 0, 0, 255))
    before.line("frame", np.zeros((2, 2)), (0, 0, 0, 255))
    before.dot(np.zeros((1, 2)), (0, 0, 0, 255))
    before.log(rr, paper, "here")
    after = Drawing()
    after.line("frame", np.ones((2, 2)), (0, 0, 0, 255))
    after.log(rr, paper, "here")
    gone = {path for path, parts in paper.kept.items() if isinstance(parts[0], rr.Clear)}
    assert gone == {"here/bound", "here/dots"}


@pytest.mark.parametrize(("horizon", "left"), [(5.0, -54.0), (7200.0, -90.0), (0.5, -72.0)])
def test_the_map_has_room_for_the_numbers_of_its_times(horizon: float, left: float) -> None:
    from sparserob_rerun.search.views import landscape

    limits = landscape(False, False, horizon).properties["VisualBounds2D"].range.as_arrow_array().to_pylist()
    assert limits[0]["x_range"][0] == left


def test_an_upper_bound_of_a_simpler_program_is_none() -> None:
    paper = Paper()
    Bounds(rr, paper).add(replace(entry(1, 0.5, 0.7), simplified=True))
    assert "0.5 ≤ J* ≤ unknown" in " ".join(paper.labels("rounds/picture/bounds/labels"))


def test_what_was_proven_on_the_way_is_an_upper_bound_of_a_search() -> None:
    event = replace(entry(1, 0.5, np.inf), proven=0.75, violation=-1.0)
    paper = Paper()
    Bounds(rr, paper).add(event)
    assert "0.5 ≤ J* ≤ 0.75" in " ".join(paper.labels("rounds/picture/bounds/labels"))
    (said,) = words.round_lines(event, None)
    assert "lower bound 0.5, proven: a control of cost 0.75;" in said
    (same,) = words.round_lines(replace(event, upper_bound=0.75), None)
    assert "upper bound 0.75" in same and "proven" not in same


def test_a_run_that_was_stopped_in_its_first_round_has_its_bounds_drawn() -> None:
    paper = Paper()
    Bounds(rr, paper).end(0.25, np.inf, np.inf)
    assert "0.25 ≤ J* ≤ unknown" in " ".join(paper.labels("rounds/picture/bounds/labels"))


def test_a_share_has_the_whole_of_its_range_upwards() -> None:
    from sparserob_rerun.search.views import notes

    shares = {one.name: one.properties.get("ScalarAxis") for one in notes(rrb, {"temperature", "accepted"})}
    (share,) = [axis for axis in shares.values() if axis is not None]
    ((low, high),) = share.range.as_arrow_array().to_pylist()
    assert low < 0.0 and high > 1.0 and len(shares) == 2


def test_the_headings_of_narrow_climbs_are_short() -> None:
    from sparserob_rerun.search.views import climb

    plots = climb(rrb, [(0, 0.1, 0.0), (1500, 1e-3, 2.0), (3000, 2.5e-4, 4.0), (4500, 1e-6, 7.0)], 1500).contents
    assert [one.name for one in plots] == ["ε 0.1", "ε 1e-3", "ε 2.5e-4", "ε 1e-6"]


def test_the_climb_of_every_weight_is_that_of_its_own_evaluations_and_of_its_own_seconds() -> None:
    from sparserob_rerun.search.views import climb

    plots = climb(rrb, [(0, 0.1, 0.0), (1500, 1e-3, 2.5)], 1500).contents
    for plot, (evaluation, seconds) in zip(plots, ((1, 0.0), (1501, 2.5)), strict=True):
        ranges = plot.properties["VisibleTimeRanges"].ranges.as_arrow_array().to_pylist()
        starts = {one["timeline"]: one["range"]["start"] for one in ranges}
        assert starts["evaluation"] == evaluation and starts["time"] == pytest.approx(seconds * 1e9)


WIDE, HIGH = 5.8, 25.0  # pixels of a letter, and of a line of words, on a screen of 1600 by 1000
PADDING = 12.0


def over(labels: list[tuple[np.ndarray, str, Any]], scale: float) -> list[tuple[str, str]]:
    """Words that lie on one another, in a panel in which a unit of the drawing is ``scale`` pixels."""
    found = []
    for (here, one, _), (there, other, _) in combinations(labels, 2):
        room = ((len(one) + len(other)) * WIDE / 2 + PADDING, HIGH)
        found += [(one, other)] * bool((np.array(room) - scale * np.abs(here - there) > 1.0).all())
    return found


@pytest.mark.parametrize("low", [-1.0, -1.02, -0.5, -1.04e-9, 0.0])
@pytest.mark.parametrize("below", [False, True])
def test_no_number_of_an_axis_lies_on_another(low: float, below: bool) -> None:
    """In the panels as they are on the first screen: violation, control and states, the map."""
    edges = rounds.extent(2, True)[0], physics.extent(4)[0], -np.inf  # the map has as much room as its times need
    panels = [(112.0, 1.15, 0.66, "t"), (118.0, 1.0, 0.67, "t"), (384.0, 1.4, 0.46, "")]
    for (height, room, scale, name), edge in zip(panels, edges, strict=True):
        drawing = Drawing()
        axes = Axes(60.0, 0.0, 640.0, height, (0.0, 5.0), (low, 1.2 * max(-low, 1e-9) if low else 5.0))
        drawing.frame(axes, "", name, ticks_below=below, room=room)
        assert over(drawing.labels, scale) == []
        assert min(at[0] - (len(one) * WIDE + PADDING) / 2 / scale for at, one, _ in drawing.labels) > edge


def test_the_strip_of_a_clash_is_as_far_from_its_wall_as_it_misses(infeasible: sr.Outcome) -> None:
    assert infeasible.status == "infeasible"
    strips = sr.Inspection.read(infeasible.directory).clash(infeasible.result)
    assert strips and strips[0].short > 0.0
    paper = Paper()
    draw_clash(rr, paper, strips)
    said = " ".join(paper.labels("clash/labels"))
    assert f"misses by {strips[0].short:.4g}" in said
    assert strips[0].sigma_low == pytest.approx(strips[0].sigma_high)
    assert f"the disturbance alone moves it by {strips[0].sigma_high:.4g};" in said
    assert extent(strips)[3] >= len(strips) * 100


def test_the_numbers_of_two_walls_that_are_near_one_another_stand_beside_one_another(infeasible: sr.Outcome) -> None:
    from sparserob_rerun.exchange.clash import CHARACTER, MARGIN, _beside

    one = sr.Inspection.read(infeasible.directory).clash(infeasible.result)[0]
    paper = Paper()
    draw_clash(rr, paper, [replace(one, low=-0.5, high=0.5)])
    assert {"-0.5", "0.5"} <= set(paper.labels("clash/labels"))
    left, right = _beside([300.0, 306.0], ["-0.5", "0.5"], 1.0)
    assert right - left == pytest.approx(3.5 * CHARACTER + MARGIN) and left + right == 606.0
    assert _beside([100.0, 400.0], ["-0.5", "0.5"], 1.0) == [100.0, 400.0]
    assert _beside([100.0], ["7"], 1.0) == [100.0]


@pytest.mark.slow
def test_maps_of_the_violation_are_within_their_panel_which_says_before_what_it_waits_for() -> None:
    from sparserob_core.experiment.config.load import load_config
    from sparserob_rerun.recording.recorder import shown_of
    from sparserob_rerun.recording.waiting import CLASH, VIOLATIONS, Waiting

    view, paper = sr.Inspection(load_config(CONFIGS / "experiment2_repaired.yaml")), Paper()
    shown = shown_of(view, None)
    waiting = Waiting(rr, paper, shown)
    assert {"violation/names/waiting/labels", "clash/waiting/labels"} <= set(paper.kept)
    Rounds(rr, paper, view).violations(np.zeros(view.program.n), (), (), {})
    maps = [parts for path, parts in paper.kept.items() if path.startswith("violation/maps/")]
    left, right, top, bottom = rounds.extent_of_maps(shown.maps)
    assert shown.maps == len(maps) == 1 and top < -20.0
    for place, image in maps:
        ((x, y, _),) = place.translation.as_arrow_array().to_pylist()
        ((across, down, _),) = place.scale.as_arrow_array().to_pylist()
        size = image.format.as_arrow_array().to_pylist()[0]
        assert left <= x and x + across * size["width"] <= right
        assert top <= y and y + down * size["height"] <= bottom
    for panel in (VIOLATIONS, CLASH):
        waiting.arrived(panel)
    assert all(isinstance(paper.kept[f"{at}/waiting"][0], rr.Clear) for at in ("violation/names", "clash"))


def test_an_infeasible_run_has_no_empty_panel_and_no_bound(infeasible: sr.Outcome) -> None:
    shown = Shown(infeasible.problem, 1, False, False, clash=(0.0, 1.0, 0.0, 1.0), drawn=False)
    tabs = layout(shown).root_container.contents
    assert [tab.name for tab in tabs] == ["Overview", "Log"]
    event = sr.RunFinished(status="infeasible", message="why", seconds=1.0, result=infeasible.result)
    page = words.page("T", "infeasible", 0.3, np.inf, words.verdict_lines(event))
    assert "no bound yet" not in page and "≤" not in page
    assert "violated" not in page and "holds" not in page


def test_a_single_strip_has_the_width_of_the_screen_and_several_have_a_column() -> None:
    for strips, kind in ((1, rrb.Vertical), (4, rrb.Horizontal)):
        shown = Shown(None, 1, False, False, clash=extent([_Strip] * strips), drawn=False)  # type: ignore[list-item]
        first = layout(shown).root_container.contents[0]
        assert isinstance(first, kind)
    infeasible, certified = (words.page("T", status, 0.0, 1.0, []) for status in ("infeasible", "certified"))
    assert "switching function" not in infeasible and "switching function" in certified


class _Strip:
    """One strip of a clash, of which only their number counts."""


def test_the_lane_is_named_after_the_verdict_which_has_no_width_on_it() -> None:
    def names(part: Any) -> list[str]:
        below = [name for one in getattr(part, "contents", ()) if not isinstance(one, str) for name in names(one)]
        return [str(part.name), *below]

    for searches in (True, False):
        live, over = (layout(Shown(None, 1, searches, True, verdict=one)).root_container for one in ("", "certified"))
        assert "State" in names(live) and "State: certified" in names(over)
    assert "Decisions, the newest first" in names(live.contents[1])  # on the tab of the exchange too


@pytest.mark.parametrize("unit", ["", "s", "min"])
def test_the_name_of_the_time_axis_is_within_the_panel_of_the_violation(unit: str) -> None:
    drawing = Drawing()
    axes = Axes(rounds.LEFT, 0.0, rounds.WIDTH, rounds.HEIGHT, (0.0, 1.0), (-1.0, 1.0))
    name = f"t in {unit}" if unit else "t"
    drawing.frame(axes, "", name, room=rounds.ROOM)
    place = next(at for at, said, _ in drawing.labels if said == name)
    assert place[0] + 7.0 * len(name) < rounds.extent(2, True, unit)[1]


@pytest.mark.parametrize(("units", "told"), [(["m", "m/s"], "v in m/s over x in m"), ([], "v over x")])
def test_a_plane_is_in_units_where_they_are_known(units: list[str], told: str, small: sr.Outcome) -> None:
    names = sr.Names(states=["x", "v"], state_units=units)
    shown = Shown(replace(small.problem, names=names), 1, False, False, drawn=False)
    panels = [layout(shown).root_container]
    said = []
    while panels:
        one = panels.pop()
        said.append(getattr(one, "name", None))
        panels += getattr(one, "contents", [])
    assert f"Phase plane: {told}" in said


def test_what_is_proven_is_never_called_violated(small: sr.Outcome) -> None:
    event = sr.RunFinished(status=small.status, message="", seconds=1.0, result=small.result)
    assert small.result.worst is not None
    for violation in (1e-11, -1e-11, 0.0):
        result = replace(small.result, worst=replace(small.result.worst, violation=violation))
        said = " ".join(words.verdict_lines(replace(event, result=result)))
        assert "violated" not in said and "holds" in said
    one = replace(event, result=replace(small.result, indices=small.result.indices[:1]))
    assert "; 1 constraint decides, found in" in " ".join(words.verdict_lines(one))
    inspection = sr.Inspection.read(small.directory)
    for value, proven, word in ((1e-11, True, "proven"), (1e-11, False, "holds"), (1e-3, False, "violated")):
        rounds = Rounds(rr, Paper(), inspection)
        said = rounds._words(inspection.program.families[0], Worst(value, 2.0, proven), fake_field())
        assert word in said and ("violated" in said) == (word == "violated")


def fake_field() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.array([2.0]), np.array([0.0]), np.array([[-1.0]])


def test_a_constraint_that_only_the_grid_knows_says_so(small: sr.Outcome) -> None:
    inspection = sr.Inspection.read(small.directory)
    said = Rounds(rr, Paper(), inspection)._words(inspection.program.families[0], None, fake_field())
    assert said.endswith("on this grid")


def test_a_terminal_constraint_stands_at_the_end_of_the_time_axis(small: sr.Outcome) -> None:
    paper = Paper()
    rounds = Rounds(rr, paper, sr.Inspection.read(small.directory))
    told = told_by_result(small.result)
    rounds.violations(np.asarray(small.result.decision), small.result.indices, (), told)
    labels = paper.labels("violation/plots/labels")
    assert {"0", "2", "t"} <= set(labels) and "3" not in labels
    assert any("proven to hold" in label for label in labels)


def test_a_cut_is_told_as_its_constraint(small: sr.Outcome) -> None:
    inspection = sr.Inspection.read(small.directory)
    (first, *_) = [words.cut_words(cut, inspection) for cut in small.result.indices]
    assert first.startswith("terminal: x1(2) <= 0.5") and "side" not in first
    assert "row 1" in words.cut_words(small.result.indices[0], None)


def test_a_round_with_some_of_the_uncertainty_says_so_and_claims_no_upper_bound() -> None:
    (said,) = words.round_lines(replace(entry(1, 0.5, 0.7), simplified=True, violation=-1.0), None)
    assert "some of the uncertainty only" in said and "upper bound" not in said
    (plain,) = words.round_lines(replace(entry(1, 0.5, 0.7), violation=-1.0), None)
    assert "some of the uncertainty" not in plain and "upper bound 0.7" in plain
    cut = sr.Cut("path", np.array([1.5, 17.0]), 0, 1.0, "sampled")
    assert words.cut_words(cut, None) == "path at t = 1.5 in scenario 17, row 1"


def test_the_worst_case_and_the_proofs_of_a_run_are_known_when_it_is_shown_again(small: sr.Outcome) -> None:
    again = stored_result(stored_run(small.directory))
    assert again.worst is not None and small.result.worst is not None
    assert again.worst.violation == small.result.worst.violation
    assert again.worst.constraint == small.result.worst.constraint
    assert {proof.family for proof in again.proofs} == {"terminal"}
    assert words.verdict_lines(sr.RunFinished(status="certified", message="", seconds=1.0, result=again)) == (
        words.verdict_lines(sr.RunFinished(status="certified", message="", seconds=1.0, result=small.result))
    )


def test_a_low_plot_has_two_ticks_at_least() -> None:
    from sparserob_rerun.drawing.canvas import Drawing

    for high in (0.9, 1.1, 3.0, 0.08):
        drawing = Drawing()
        drawing.frame(Axes(0.0, 0.0, 100.0, 100.0, (0.0, 1.0), (-high, high)), "", ticks_below=False)
        assert sum(text != "" for _, text, _ in drawing.labels) >= 2


def test_of_three_numbers_for_which_there_is_no_room_the_one_between_is_left_out() -> None:
    from sparserob_rerun.drawing.canvas import _apart

    low, high = (
        _apart(Axes(0.0, 0.0, 100.0, height, (0.0, 1.0), (-2.7, 2.7)), 34.0, False) for height in (60.0, 110.0)
    )
    assert low.tolist() == [-2.0, 2.0] and high.tolist() == [-2.0, 0.0, 2.0]


def test_decades_are_whole() -> None:
    from sparserob_rerun.drawing.canvas import _apart

    for low, high in ((-1.0, 0.0), (-2.0, 0.0), (-9.0, 1.0)):
        found = _apart(Axes(0.0, 0.0, 100.0, 136.0, (0.0, 1.0), (low, high)), 34.0, True)
        assert found.size > 1 and (found == np.rint(found)).all()


def test_a_system_in_a_plane_is_drawn_there_with_the_arcs_on_which_its_control_acts() -> None:
    """One unit is as long upwards as across, what is drawn is in the panel, and everything has one name beside it."""
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(np.eye(4, k=2), np.eye(4)[:, 2:]),
        horizon=4.0,
        initial_state=[0.0, 0.0, 0.0, 0.0],
        control=sr.Box([-1, -1], [1, 1]),
        disturbance=None,
        path=[sr.PathConstraint(sr.Box([-np.inf] * 4, [5.5, np.inf, np.inf, np.inf]))],
        terminal=[sr.Equality([2.0, 0.5, 0.0, 0.0])],
        names=sr.Names(states=["x", "y", "vx", "vy"], state_units=["m", "m", "m/s", "m/s"], plane=["x", "y"]),
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 8})
    data = figure_data(result.experiment, result.decision, None, (), None)
    drawing = moved(data, {})
    (curve, _, _), *_ = drawing.strips["curve"]
    assert np.ptp(curve[:, 0]) / np.ptp(curve[:, 1]) == pytest.approx(np.ptp(data.path[:, 0]) / np.ptp(data.path[:, 1]))
    acts = (np.abs(result.control.values) > 1e-6).any(axis=0)
    assert len(drawing.strips["arcs"]) == int((np.diff([0, *acts.astype(int)]) > 0).sum()) > 0
    left, right, top, bottom = phase.extent(problem, True)
    for places in [*(points for layer in drawing.strips.values() for points, _, _ in layer)]:
        assert (places >= (left, top)).all() and (places <= (right, bottom)).all()
    said = [words for _, words, _ in drawing.labels]
    assert {"terminal set", "thick: the control acts", "dot: x(0)"} <= {*said} and "worst case" not in said


@pytest.mark.parametrize("searches", [True, False])
def test_a_phase_plane_with_its_words_is_as_wide_as_the_panel_that_it_has(small: sr.Outcome, searches: bool) -> None:
    paper = Paper()
    assert small.problem is not None
    view = sr.Inspection.read(small.directory)
    Physics(rr, paper, view, searches).draw(np.asarray(small.result.decision), small.result.indices, None)
    left, right, top, bottom = phase.extent(small.problem, searches)
    frame = np.concatenate(paper.strips("physics/phase/frame"))
    assert np.ptp(frame[:, 0]) > (0.5 if searches else 0.4) * (right - left)
    assert ((frame > (left, top)) & (frame < (right, bottom))).all()


def test_the_tab_of_the_signals_has_no_panel_that_waits_for_another_timeline(small: sr.Outcome) -> None:
    tabs = {tab.name: tab for tab in layout(Shown(small.problem, 2, False, False)).root_container.contents}
    assert all(isinstance(panel, rrb.BarChartView) for panel in tabs["Signals"].contents)
    assert isinstance(tabs["Timeline t"].contents[0], rrb.TextDocumentView)
