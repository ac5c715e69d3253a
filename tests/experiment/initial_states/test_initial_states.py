"""Guards experiment/initial_states/initial_states: the initial state as a part of the decision, planar sets between two
polygons, and the command that draws them."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.studies.initial_states import InitialPlane
from sparserob_core.control.studies.polygon_approximation import (
    AXES,
    SupportBound,
    convex_hull,
    inner_polygon,
    outer_polygon,
    polygon_area,
    sandwich,
)
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.experiment.initial_states.figure import draw_initial_states, envelope
from sparserob_core.experiment.initial_states.search import InitialStatesSearch
from sparserob_core.experiment.initial_states.section import section
from tests.support.plants import uniform
from tests.support.stub import Command

CART: dict[str, Any] = {
    "title": "A cart",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [0.5, 0.0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.0, 0.05]},
        "path": [{"box": [2.0, None]}],
        "terminal": [{"box": [0.5, 0.4]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
    "observers": [],
}


def problems() -> list[sr.OptimalControlProblem]:
    spring = sr.LinearSystem(A=[[0, 1], [-2, -0.5]], B=[[0], [1]])
    uncertain = sr.LinearSystem(
        A=lambda p: np.stack(
            [np.stack([0 * p[..., 0], 1 + 0 * p[..., 0]], -1), np.stack([-2 + p[..., 0], -0.5 + 0 * p[..., 0]], -1)], -2
        ),
        B=[[0], [1]],
        parameters=sr.Box([-0.1], [0.1]),
    )
    round_ = sr.Ellipsoid(centre=[0, 0], shape=[[0.25, 0], [0, 0.25]])
    common = {
        "horizon": 2.0,
        "initial_state": [-1.0, 1.0],
        "control": sr.Box([-1], [1]),
        "disturbance": sr.Box([-0.05, -0.05], [0.05, 0.05]),
    }
    end = [sr.Box([-0.5, -0.5], [0.5, 0.5])]
    return [
        sr.OptimalControlProblem(
            system=spring, path=[sr.PathConstraint(sr.Box([-1, -9], [1, 9]), 0.0)], terminal=end, **common
        ),
        sr.OptimalControlProblem(system=spring, disturbance_class="measurable", terminal=end, **common),
        sr.OptimalControlProblem(system=spring, terminal=[round_], **common),
        sr.OptimalControlProblem(system=uncertain, terminal=end, **common),
    ]


@pytest.mark.first(2)
@pytest.mark.parametrize("number", range(4), ids=["flat", "measurable", "curved", "uncertain"])
def test_a_plane_shares_its_work_and_agrees_with_the_problem_transcribed_afresh(number: int) -> None:
    problem, control = problems()[number], uniform(8, 2.0)
    plane = InitialPlane(prepare(problem, control, control), (0, 1), np.array([0.2, -0.1]), np.array([2.0, 3.0]))
    rng = np.random.default_rng(number)
    joined, x = plane.support(np.array([1.0, 0.0])), rng.normal(size=8)
    for z in rng.uniform(-1, 1, (3, 2)):
        moved = sr.OptimalControlProblem(**{**vars(problem), "initial_state": plane.point(z)})
        fresh = sr.transcribe(moved, control=control)
        for family, other, known in zip(plane.at(z).families, joined.families, fresh.families, strict=True):
            assert family.worst is not None and other.worst is not None and known.worst is not None
            expected = known.worst(x)
            for found in (family.worst(x), other.worst(np.append(x, z))):
                np.testing.assert_allclose(found.violations[0], expected.violations[0], atol=1e-9)
            indices = expected.indices[:2]
            np.testing.assert_allclose(
                other.violations(np.append(x, z), indices), known.violations(x, indices), atol=1e-9
            )
            lower, upper = known.cells
            assert known.enclosure is not None and other.enclosure is not None
            if number != 3:
                proven = other.enclosure(np.append(x, z), lower, upper).bounds
                np.testing.assert_allclose(proven, known.enclosure(x, lower, upper).bounds, atol=1e-9)


def ellipse(direction: np.ndarray) -> SupportBound:
    """That of half-axes 3 and 1: its support function and the point that attains it."""
    shape = np.array([9.0, 1.0])
    bound = float(np.sqrt(shape @ direction**2))
    return SupportBound(direction, bound, shape * direction / bound, True)


def test_the_polygons_of_a_sandwich_enclose_and_converge_quadratically() -> None:
    gaps = []
    for count in (8, 16, 32, 64):
        supports = sandwich(ellipse, [ellipse(axis) for axis in AXES], count, 0.0)
        assert len(supports) == count
        inner, outer = polygon_area(inner_polygon(supports)), polygon_area(outer_polygon(supports))
        assert inner < 3 * np.pi < outer
        gaps.append(outer - inner)
    assert all(before / after > 3.0 for before, after in pairwise(gaps))


def test_a_sandwich_of_a_polygon_ends_when_it_is_exact() -> None:
    corners = np.array([[0.0, 0.0], [2.0, 0.5], [1.0, 2.0]])

    def triangle(direction: np.ndarray) -> SupportBound:
        best = corners[int((corners @ direction).argmax())]
        return SupportBound(direction, float(best @ direction), best, True)

    supports = sandwich(triangle, [triangle(axis) for axis in AXES], 100, 1e-9)
    assert len(supports) <= 9
    assert polygon_area(outer_polygon(supports)) == pytest.approx(polygon_area(inner_polygon(supports)), rel=1e-9)
    assert polygon_area(inner_polygon(supports)) == pytest.approx(polygon_area(corners))


def test_points_that_are_not_proven_are_not_in_the_inner_polygon() -> None:
    supports = [SupportBound(axis, 1.0, axis, number != 0) for number, axis in enumerate(AXES)]
    assert polygon_area(inner_polygon(supports)) == pytest.approx(1.0)
    assert polygon_area(outer_polygon(supports)) == pytest.approx(4.0)


def test_a_convex_hull_leaves_out_what_lies_within() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5], [0.5, 0.0]], dtype=float)
    assert {tuple(v) for v in convex_hull(square)} == {(0, 0), (1, 0), (1, 1), (0, 1)}


def test_the_section_of_a_box_has_its_corners_and_of_a_ball_its_circle() -> None:
    box = section(sr.Box([-1, -2, -3], [1, 2, 3]), np.zeros(3), (0, 2), np.array([0.3, 0.3]), 50.0)
    for corner in ([1, 3], [-1, 3], [-1, -3], [1, -3]):
        assert np.abs(box - corner).max(axis=1).min() < 1e-9
    ball = section(sr.NormBall(p=2, radius=1.0, centre=[0, 0, 0]), np.array([0, 0.6, 0]), (0, 2), np.zeros(2), 50.0)
    np.testing.assert_allclose(np.linalg.norm(ball, axis=1), 0.8, atol=1e-6)


def test_the_envelope_of_convex_costs_interpolates_them_and_of_others_lies_below() -> None:
    points = np.random.default_rng(2).uniform(-1, 1, (60, 2))
    costs = (points**2).sum(axis=1)
    assert set(envelope(points, costs).ravel()) == set(range(60))
    raised = costs.copy()
    raised[np.argmin(costs)] += 5.0
    assert int(np.argmin(costs)) not in envelope(points, raised)


def test_an_unbounded_set_names_what_is_unbounded_and_a_limit_says_that_it_cuts() -> None:
    free = {"problem.path": [], "problem.terminal": [{"box": [0.5, None]}]}
    with pytest.raises(sr.InputError, match=r"within: .*no bound on .*x1\(0\) above.*x1\(0\) below"):
        sr.initial_states(CART, free, directions=4, values=0)
    found = sr.initial_states(CART, free, directions=12, values=0, within=3.0)
    assert found.cut and found.limit == 3.0
    np.testing.assert_allclose(np.abs(found.outer).max(axis=0)[0], 3.0, atol=1e-9)


def test_an_empty_set_is_infeasible_and_says_which_constraints_clash() -> None:
    found = sr.initial_states(CART, {"problem.disturbance.box": [0.0, 0.9]}, directions=4, values=0)
    assert found.status == "infeasible"
    assert "x2(2)" in found.message and "1.8" in found.message and "0.4" in found.message
    assert found.outer.shape == (0, 2) and found.where([0.0, 0.0]) == "outside"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"states": (0,)}, "states: expected two different states"),
        ({"states": (0, 0)}, "got 0 and 0"),
        ({"states": (0, 2)}, "of the 2"),
        ({"states": 3}, "states: expected"),
        ({"states": (0, True)}, "states: expected"),
        ({"directions": 3}, "directions: expected a whole number of at least 4"),
        ({"directions": 4.5}, "directions:"),
        ({"values": -1}, "values: expected"),
        ({"about": [1.0]}, "about: expected 2 finite numbers"),
        ({"about": [1.0, np.nan]}, "about:"),
        ({"within": 0.0}, "within: expected a positive number"),
        ({"within": np.nan}, "within:"),
    ],
)
def test_an_argument_at_fault_is_named_with_what_was_expected(options: dict[str, Any], said: str) -> None:
    with pytest.raises(sr.InputError, match=said):
        sr.initial_states(CART, **options)


def test_an_equality_that_the_uncertainty_reaches_is_refused() -> None:
    with pytest.raises(sr.InputError, match="depends on the uncertainty"):
        sr.initial_states(CART, {"problem.terminal": [{"equals": [0.0, None]}]})


def test_points_are_checked_and_a_control_is_refused_outside_of_the_inner_polygon() -> None:
    found = sr.initial_states(CART, directions=4, values=0)
    with pytest.raises(sr.InputError, match="point: expected two finite numbers"):
        found.where([1.0])
    with pytest.raises(sr.InputError, match="point: expected one in the inner polygon"):
        found.control([9.0, 9.0])
    assert found.cost([0.0, 0.0]) == np.inf


def test_other_coordinates_are_those_about_which_the_plane_lies() -> None:
    config = {
        **CART,
        "problem": {
            "name": "linear",
            "system": {"A": [[0, 1, 0], [0, 0, 1], [0, 0, 0]], "B": [[0], [1], [0]]},
            "horizon": 2.0,
            "initial_state": [0.0, 0.0, 0.0],
            # of a symmetric set two directions are equally good, and rounding chooses
            "control": {"box": {"lower": -1.0, "upper": 0.8}},
            "terminal": [{"box": [0.5, 0.4, None]}],
        },
    }
    still = sr.initial_states(config, directions=12, values=0)
    pushed = sr.initial_states(config, directions=12, values=0, about=[7.0, 7.0, 0.5])
    assert pushed.origin[2] == 0.5
    # a constant force moves the set by e^{-AT} of what it adds
    assert pushed.inner_area == pytest.approx(still.inner_area, rel=1e-4)
    shift = np.array([-1.0 + 2.0 * 1.0, -1.0])
    np.testing.assert_allclose(pushed.outer.max(axis=0) - still.outer.max(axis=0), shift, atol=1e-5)


@pytest.mark.slow
def test_the_figure_names_its_axes_and_shows_every_boundary() -> None:
    found = sr.initial_states(CART, directions=8, values=4)
    ax, bar = draw_initial_states(replace(found, cost_unit="N s")).axes
    assert bar.get_ylabel() == "cost $J$ of a proven control [N s]"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x_{1}(0)$", "$x_{2}(0)$")
    labels = ax.get_legend_handles_labels()[1]
    assert labels == [
        "path set at time 0",
        "infeasible outside, proven",
        "feasible inside, proven",
        "the config's initial state",
    ]


@pytest.mark.slow
def test_the_command_writes_its_files_whole_and_prints_what_it_wrote(tmp_path: Path, command: Command) -> None:
    (tmp_path / "cart.yaml").write_text(json.dumps({key: value for key, value in CART.items() if key != "observers"}))
    done = command("initial-states", "cart.yaml", "--directions", "6", "--values", "2", "--json", "--out", "set")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "set").iterdir()} == {
        "config.yaml",
        "initial_states.json",
        "initial_states.npz",
        "initial_states.png",
    }
    summary = json.loads(done.stdout)
    assert summary == json.loads((tmp_path / "set" / "initial_states.json").read_text())
    assert summary["states"] == [1, 2] and summary["initial_state_is"] == "inside"
    with np.load(tmp_path / "set" / "initial_states.npz") as arrays:
        assert polygon_area(arrays["inner"]) == pytest.approx(summary["inner_area"])
        assert arrays["controls"].shape == (len(arrays["inner"]), 1, 10)


def test_the_command_ends_with_3_for_an_empty_set_and_2_for_a_fault(tmp_path: Path, command: Command) -> None:
    (tmp_path / "cart.yaml").write_text(json.dumps({key: value for key, value in CART.items() if key != "observers"}))
    empty = command("initial-states", "cart.yaml", "problem.disturbance.box=[0,0.9]")
    assert empty.returncode == 3 and "infeasible" in empty.stdout
    wrong = command("initial-states", "cart.yaml", "--states", "1,1")
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1 and "states" in wrong.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("programs", "known"), [(0, False), (3, False), (4, True), (6, True)])
def test_an_interrupt_before_the_box_fits_returns_what_is_known(programs, known, monkeypatch) -> None:
    """Four programs bound the set; the box is then fitted to it by others."""
    supported, asked = InitialStatesSearch._solve_direction, []

    def pressed(self: InitialStatesSearch, direction: np.ndarray) -> sr.Result:
        if len(asked) >= programs:
            raise KeyboardInterrupt("interrupted by SIGTERM")
        asked.append(direction)
        return supported(self, direction)

    whole = sr.initial_states(CART, directions=4, values=0)
    monkeypatch.setattr(InitialStatesSearch, "_solve_direction", pressed)
    found = sr.initial_states(CART, directions=12, values=3)
    assert "interrupted by SIGTERM" in found.message
    assert found.where(whole.inner.mean(axis=0)) != "outside"
    assert (found.outer.shape[0] > 0) == known
    if known:  # a point that is proven to be outside is outside
        assert (whole.inner @ found.directions.T <= found.bounds + 1e-9).all()
        assert found.where([50.0, 0.0]) == "outside"
    else:
        assert found.status == "undecided" and found.where([50.0, 0.0]) == "open"


def test_a_limit_of_time_ends_the_search_with_what_it_knows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "sparserob_core.sip.limits.deadline.LIMIT_GRACE_SECONDS", 60.0
    )  # the transcription is let finish
    found = sr.initial_states(CART, {"limits.seconds": 1e-3}, directions=4, values=0)
    assert found.status == "undecided" and "the limit of 0.001 s is reached" in found.message
