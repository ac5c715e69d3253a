"""Guards experiment/margin/margin: margins: closed forms, both sides proven, monotone curves, every kind, and bad
input."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.directory.artefacts import RunDirectory
from sparserob_core.experiment.margin.margin import margin_rows
from sparserob_core.experiment.margin.scaling import scaling

DOUBLE_INTEGRATOR = {"A": [[0, 1], [0, 0]], "B": [[0], [1]]}


def config(**problem: object) -> dict:
    return {
        "problem": {
            "name": "linear",
            "system": DOUBLE_INTEGRATOR,
            "horizon": 2.0,
            "initial_state": [1, 0],
            "control": {"box": 1.0},
            **problem,
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 20}},
        "observers": [],
    }


def assert_encloses(found: sr.Margin, exact: float, width: float = 4e-6) -> None:
    assert found.status == "certified", found.message
    assert found.lower - 1e-9 <= exact <= found.upper + 1e-9
    assert found.upper - found.lower <= width * max(1.0, exact)
    good, bad = (found.lower, found.upper) if found.sense == "largest" else (found.upper, found.lower)
    assert (found.feasible.factor, found.infeasible.factor) == (good, bad)
    assert found.feasible.status in ("certified", "verified")
    assert found.infeasible.status == "infeasible"


def test_a_disturbance_may_grow_until_it_fills_the_terminal_set():
    """|w2| <= 0.1 moves x2(2) by 0.2, of 0.5 allowed; x1 is free: the factor is 2.5, |w| is 0.25."""
    found = sr.margin(config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}]), of="disturbance")
    assert_encloses(found, 2.5)
    assert np.allclose(found.amounts, 0.25, atol=1e-6)


def test_the_solver_that_a_config_names_answers_the_programs_of_a_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    clarabel = pytest.importorskip("sparserob_clarabel").Clarabel
    asked, solve = [], clarabel.solve
    monkeypatch.setattr(clarabel, "solve", lambda *one: (asked.append(one), solve(*one))[1])
    stated = config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}])
    assert_encloses(sr.margin(stated, of="disturbance"), 2.5)
    assert not asked
    assert_encloses(sr.margin(stated, "disturbance", {"solver.name": "clarabel"}), 2.5)
    assert asked


def test_a_disturbance_that_is_not_centred_grows_about_its_centre():
    """w2 in [0, 0.2]: the middle 0.1 is met by the control, the rest 0.1 f moves x2(2) by 0.2 f."""
    found = sr.margin(
        config(disturbance={"box": {"lower": [0, 0], "upper": [0, 0.2]}}, terminal=[{"box": [None, 0.5]}]),
        of="disturbance",
    )
    assert_encloses(found, 2.5)
    assert np.allclose(found.amounts, 0.1 + 0.25, atol=1e-6)


def test_the_smallest_terminal_set_is_as_wide_as_the_disturbance():
    found = sr.margin(config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}]), of="terminal.0")
    assert_encloses(found, 0.4)
    assert np.allclose(found.amounts, 0.2, atol=1e-6)


@pytest.mark.slow
def test_the_smallest_control_is_the_time_optimal_one():
    """From (1, 0) to the origin in time 2 takes |u| <= 1 exactly: twice the bound, half the factor."""
    assert_encloses(sr.margin(config(control={"box": 2.0}, terminal=[{"box": [1e-9, 1e-9]}]), of="control"), 0.5)


def test_the_largest_initial_state_is_what_the_control_can_bring_back():
    """x1(2) <= 0.5 from (f, 0): f - 2 <= 0.5."""
    assert_encloses(sr.margin(config(terminal=[{"box": [0.5, None]}]), of="initial_state"), 2.5)


@pytest.mark.parametrize("far", [1e3, 3e4])
def test_where_double_precision_does_not_tell_two_ends_apart_no_run_is_made_between_them(far: float) -> None:
    """Beside a way of 1e3 or 3e4 a set of 0.1 is small: the box of 0.05 + 10 * 0.005 fills it at the factor 1."""
    stated = config(
        horizon=10.0,
        initial_state={"centre": [-far, 0.0], "box": [0.05, 0.005]},
        control={"box": far / 10},
        terminal=[{"box": [0.1, 1.0]}],
    )
    stated["dictionaries"]["control"]["pieces"] = 10
    points: list[str] = []
    found = sr.margin(stated, of="initial_state", notify=lambda event: points.append(getattr(event, "text", "")))
    assert found.status == "certified" and found.lower <= 1.0 <= found.upper <= 1.0 + 4e-8 * far + 1e-4
    assert not [text for text in points if "refuted" in text]


def test_a_path_set_must_hold_the_initial_state():
    assert_encloses(sr.margin(config(path=[{"box": [4.0, None]}]), of="path.0"), 0.25)


def test_the_earliest_start_of_a_window_is_when_the_state_can_be_there():
    """x1(t) = 1 - t^2 / 2 at best: |x1| <= 0.5 from t = 1 on."""
    found = sr.margin(config(path=[{"box": [0.5, None], "from": 1.5}]), of="path.0.from")
    assert_encloses(found, 1.0)
    assert found.quantity == "start of the window"


def test_uncertain_parameters_may_grow_until_a_coordinate_cannot_be_held():
    """x' = p u from 1, |u| <= 1, |x(1)| <= 0.1, p in [1 - r, 1 + r]: with v in [0, 1] the integral of -u, 1 - (1 - r) v
    <= 0.1 and (1 + r) v - 1 <= 0.1; v = 1 is the best, and leaves r <= 0.1."""
    problem = {
        "name": "linear",
        "system": {"A": [[0]], "B": [["p"]], "parameters": {"p": [0.8, 1.2]}},
        "horizon": 1.0,
        "initial_state": 1.0,
        "control": {"box": 1.0},
        "terminal": [{"box": 0.1}],
    }
    dictionaries = {"control": {"name": "piecewise_constant", "pieces": 5}}
    found = sr.margin({"problem": problem, "dictionaries": dictionaries, "observers": []}, of="parameters")
    assert_encloses(found, 0.5)


def test_the_cost_grows_with_the_uncertainty_and_is_bounded_from_both_sides_at_every_point():
    found = sr.margin(
        config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [0.5, 0.5]}]), of="disturbance", curve=5
    )
    assert [point.factor for point in found.curve] == pytest.approx(np.linspace(0, found.lower, 5))
    assert all(point.status == "certified" for point in found.curve)
    assert all(point.upper_bound - point.lower_bound <= 2e-7 for point in found.curve)
    costs = [point.upper_bound for point in found.curve]
    assert costs == sorted(costs)
    assert costs[-1] > costs[0] + 0.01
    assert (np.diff(costs, 2) >= -1e-6).all()  # convex in the factor


@pytest.mark.slow
def test_wider_terminal_sets_bear_larger_disturbances():
    found = [
        sr.margin(config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [0.3, width]}]))
        for width in (0.2, 0.3, 0.4)
    ]
    assert all(narrow.lower <= wide.upper for narrow, wide in pairwise(found))  # proven sides; each knows 1e-6
    assert all(narrow.lower <= wide.lower + 1e-6 * wide.upper for narrow, wide in pairwise(found))
    assert found[0].upper < found[1].lower


def test_what_is_infeasible_at_every_factor_is_said_with_the_reason():
    found = sr.margin(config(disturbance={"box": 0.1}, path=[{"box": [0.7, None]}]))
    assert found.status == "infeasible"
    assert "even at 0 nothing is feasible" in found.message
    assert "x1(0) = 1 is outside |x1| <= 0.7" in found.message
    assert found.feasible is None
    enlarged = sr.margin(config(path=[{"box": [0.7, None]}], terminal=[{"box": 0.3}]), of="terminal.0")
    assert enlarged.status == "infeasible"


def test_what_no_factor_makes_infeasible_is_unbounded():
    found = sr.margin(config(disturbance={"box": [0.1, 0.0]}, terminal=[{"box": [None, 0.5]}]))
    assert found.status == "unbounded"
    assert found.lower == 1e6
    assert found.upper == np.inf
    assert found.feasible.status == "certified"


@pytest.mark.parametrize(
    ("of", "words"),
    [
        ("disturbence", "did you mean 'disturbance'"),
        ("path.1", "did you mean 'path.0'"),
        ("", "known: control"),
        ("parameters", "no parameters"),
        ("terminal.0", "no terminal"),
    ],
)
def test_what_cannot_be_varied_names_the_nearest_or_what_is_missing(of, words):
    with pytest.raises(sr.InputError, match=words):
        sr.margin(config(disturbance={"box": 0.1}, path=[{"box": [4.0, None]}]), of=of)


def test_a_config_without_a_disturbance_says_so():
    with pytest.raises(sr.InputError, match="no disturbance"):
        sr.margin(config(terminal=[{"box": 0.5}]))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": float("nan")}, "tolerance"),
        ({"curve": -1}, "curve"),
        ({"curve": 1}, "curve"),
    ],
)
def test_numbers_out_of_range_are_refused(options, words):
    with pytest.raises(sr.InputError, match=words):
        sr.margin(config(disturbance={"box": 0.1}), **options)


def test_points_and_equalities_cannot_be_enlarged():
    with pytest.raises(sr.InputError, match="single point"):
        sr.margin(config(disturbance={"box": 0.0}))
    with pytest.raises(sr.InputError, match="fixes final values"):
        sr.margin(config(terminal=[{"equals": [0, 0]}]), of="terminal.0")


def test_an_equality_stays_imposed_while_the_rest_is_varied():
    """To the origin exactly, in time 2, from (f, 0): f <= 1."""
    assert_encloses(sr.margin(config(terminal=[{"equals": [0, 0]}]), of="initial_state"), 1.0)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "kind",
    [
        {"norm": {"p": 2, "radius": 0.1}},
        {"ellipsoid": {"shape": 0.01}},
        {"norm": {"p": 1, "radius": 0.1}},
        {"polytope": {"H": [[1, 0], [-1, 0], [0, 1], [0, -1]], "h": 0.1}},
    ],
)
def test_sets_of_every_kind_are_scaled(kind):
    found = sr.margin(config(disturbance=kind, terminal=[{"box": [None, 0.5]}]))
    assert_encloses(found, 2.5)


def test_the_directory_holds_the_numbers_and_the_picture(tmp_path):
    found = sr.margin(
        config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}]), curve=3, out=tmp_path / "out"
    )
    assert sorted(file.name for file in found.directory.iterdir()) == ["config.yaml", "margin.json", "margin.png"]
    written = json.loads((tmp_path / "out" / "margin.json").read_text())
    assert (written["status"], written["lower"], written["upper"]) == ("certified", found.lower, found.upper)
    assert len(written["curve"]) == 3
    assert ("status", f"certified: {found.message}") in margin_rows(found)
    with pytest.raises(sr.InputError, match="new or an empty"):
        sr.margin(config(disturbance={"box": 0.1}), out=tmp_path / "out")


def test_a_margin_that_cannot_be_written_lets_go_of_its_directory(tmp_path, monkeypatch):
    def full(directory, name, text):
        raise sr.SparseRobError(f"{name}: cannot be written: No space left on device")

    monkeypatch.setattr(RunDirectory, "write_text", full)
    with pytest.raises(sr.SparseRobError, match=r"config\.yaml: cannot be written"):
        sr.margin(config(disturbance={"box": 0.1}), out=tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_the_command_ends_with_the_status_of_what_it_found(command, tmp_path):
    file = tmp_path / "small.json"
    file.write_text(json.dumps(config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}])))
    done = command("margin", file, "--curve", 0, "--json", "--out", "found")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["lower"] == pytest.approx(2.5, abs=1e-5)
    done = command("margin", file, "problem.path=[{box: [0.5, null]}]", "--curve", 0)
    assert done.returncode == 3, done.stderr
    assert "even at 0 nothing is feasible" in done.stdout
    done = command("margin", file, "--of", "disturbanse")
    assert (done.returncode, done.stdout) == (2, "")
    assert "did you mean 'disturbance'" in done.stderr


def test_a_limit_ends_a_margin_with_what_is_proven_by_then(monkeypatch):
    monkeypatch.setattr(
        "sparserob_core.sip.limits.deadline.LIMIT_GRACE_SECONDS", 60.0
    )  # the transcription is let finish
    config = Path(__file__).resolve().parents[3] / "configs" / "experiment1_repaired.yaml"
    found = sr.margin(config, "disturbance", {"observers": [], "limits.seconds": 0.01})
    assert found.status == "undecided"
    assert found.message.startswith("the limit of 0.01 s is reached after 1 runs, of which none proves anything")


def test_a_margin_that_is_ended_in_its_first_program_knows_whether_anything_is_feasible(monkeypatch):
    def pressed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("sparserob_core.experiment.margin.search.critical_factor", pressed)
    found = sr.margin(config(disturbance={"box": 0.1}, path=[{"box": 4.0}]), "disturbance")
    assert (found.status, found.lower, found.feasible.status) == ("undecided", 0.0, "certified")
    assert np.isnan(found.upper)
    never = sr.margin(config(disturbance={"box": 0.1}, path=[{"box": [0.5, None]}]), "disturbance")
    assert (never.status, never.infeasible.factor) == ("infeasible", 0.0)


@pytest.mark.parametrize(
    ("of", "label", "relative"),
    [
        ("disturbance", "factor on the disturbance set", True),
        ("control", "factor on the control set", True),
        ("path.0", "factor on the set path.0", True),
        ("path.0.from", "start of the window of path.0 [unit of time]", False),
    ],
)
def test_a_scaling_says_what_its_factor_is(of: str, label: str, relative: bool) -> None:
    problem = assemble(load_config(config(disturbance={"box": 0.1}, path=[{"box": 4.0}]))).problem
    varied = scaling(problem, of, [[0]], [])
    assert (varied.of, varied.label, varied.relative) == (of, label, relative)


class Heard(sr.Observer):
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.events: list[sr.Event] = []

    def receive(self, event: sr.Event) -> None:
        self.events.append(event)


@pytest.mark.first(1)
@pytest.mark.parametrize("of", ["disturbance", "terminal.0", "horizon"])
def test_an_observer_hears_every_run_of_a_margin_as_a_point_of_a_study(of: str, tmp_path: Path) -> None:
    heard = Heard()
    stated = config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}])
    found = sr.margin(stated, of, tolerance=1e-2, curve=2, out=tmp_path / "out", observers=[heard])
    first, *between, last = heard.events
    assert isinstance(first, sr.SweepStarted) and isinstance(last, sr.SweepFinished)
    assert first.arrangement == "search" and first.directory == tmp_path / "out" and not first.points
    assert first.sense == {"horizon": "", "disturbance": "largest", "terminal.0": "smallest"}[of]
    progress = [event for event in between if isinstance(event, sr.SweepProgress)]
    points = [value for event in progress for (value,) in event.found]
    rows = {place: event.row for event in progress if event.row is not None for place in event.places}
    assert rows == last.rows and set(rows) == set(range(len(points)))
    for point in (*found.curve, found.feasible, found.infeasible):
        assert point is None or rows[points.index(point.factor)]["status"] == point.status
    moved = [event for event in between if isinstance(event, sr.PointProgress)]
    assert {event.point for event in moved} <= set(rows)
    assert max(event.lower_bound for event in moved) == pytest.approx(
        max(row["lower_bound"] for row in rows.values() if row["status"] == "certified"), rel=1e-6
    )
    assert found.status in last.answer and not last.stopped


def test_an_observer_of_a_margin_that_is_stopped_hears_the_end() -> None:
    heard = Heard()
    stated = {**config(disturbance={"box": [0.0, 0.1]}, terminal=[{"box": [None, 0.5]}]), "limits": {"seconds": 1e-9}}
    assert sr.margin(stated, observers=[heard]).status == "undecided"
    last = heard.events[-1]
    assert isinstance(last, sr.SweepFinished) and "limit" in last.stopped
