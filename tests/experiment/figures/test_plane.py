"""Guards experiment/figures/plane_figure: the places of the worst case contain every trajectory and are no larger than
they must be, walls and gates are where the problem has them, and a plane that is none is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.studies.answer import supports
from sparserob_core.experiment.figures.active import Active
from sparserob_core.experiment.figures.drawing import POLYGON_CORNERS, figure_data
from sparserob_core.experiment.figures.plane import Limit, Plane, clipped
from sparserob_core.experiment.figures.style import ORANGE
from sparserob_core.experiment.run.drawing import switching

A = [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0] * 4, [0.0] * 4]
B = [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]
GATE = sr.Polytope(np.array([[0.0, 1.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 1.0, 0.0]]), [0.5, 0.5, 9.0])


def puck(**changes: Any) -> sr.OptimalControlProblem:
    """A puck on a table, with a wall below, a gate that moves upwards, and a goal."""
    plain: dict[str, Any] = {
        "system": sr.LinearSystem(A, B, [[0.0], [0.0], [1.0], [0.5]]),
        "horizon": 2.0,
        "initial_state": [0.0, 0.0, 0.0, 0.0],
        "control": sr.Box([-2.0, -2.0], [2.0, 2.0]),
        "disturbance": sr.Box([-0.05], [0.05]),
        "path": [
            sr.PathConstraint(sr.Box([-np.inf, -0.1, -np.inf, -np.inf], [np.inf] * 4), name="floor"),
            sr.PathConstraint(GATE, 0.5, 1.0, relative_to=[[0.5, 0, 0, 0, 0], [1.0, 0, 0.2, 0, 0]], name="gate"),
        ],
        "terminal": [sr.Box([0.8, 0.3, -1.0, -1.0], [1.4, 0.9, 1.0, 1.0])],
        "names": sr.Names(states=["x", "y", "vx", "vy"], state_units=["m", "m", "m/s", "m/s"], plane=["x", "y"]),
    }
    return sr.OptimalControlProblem(**{**plain, **changes})


@pytest.fixture(scope="module", params=["open_loop", "affine"])
def solved(request: pytest.FixtureRequest) -> sr.SolvedProblem:
    result = sr.solve(puck(), control={"name": "piecewise_constant", "pieces": 4}, policy=request.param)
    assert result.status in ("certified", "verified")
    return result


def drawn(result: sr.SolvedProblem) -> Any:
    decision = np.asarray(result.decision)
    return figure_data(
        result.experiment,
        decision,
        Active(np.array([1.0]), np.zeros((1, result.experiment.problem.system.states), dtype=bool)),
        (),
        result.cost,
        status=result.status,
    )


def test_places_touch_the_worst_case_in_every_direction_and_nothing_reaches_beyond(solved: sr.SolvedProblem) -> None:
    data = drawn(solved)
    places, angles = data.plane.places, np.linspace(0.0, 2.0 * np.pi, 97)
    assert places.shape == (data.times.size, POLYGON_CORNERS, 2)
    directions = np.zeros((97, 4))
    directions[:, :2] = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    reached = supports(solved.model, np.ravel(solved.decision), data.times, directions)
    around = np.einsum("tqi,ci->ctq", places, directions[:, :2]).max(axis=2)
    assert (around >= reached - 1e-9).all()
    size = np.ptp(places, axis=1).max(axis=1)
    assert (around - reached <= 0.034 * size + 1e-9).all()  # tan(pi / 48) / 2 beside a segment, as these places are
    assert np.allclose(around[::2], reached[::2], atol=1e-9)  # exact where the sides are
    for axis in (0, 1):
        assert np.allclose(places[:, :, axis].max(axis=1), data.tube_upper[axis], atol=1e-9)
        assert np.allclose(places[:, :, axis].min(axis=1), data.tube_lower[axis], atol=1e-9)


def test_walls_gates_and_goal_are_those_of_the_problem(solved: sr.SolvedProblem) -> None:
    floor, gate, goal = drawn(solved).plane.limits
    assert floor.is_wall and not floor.moves and floor.normals.tolist() == [[0.0, -1.0]]
    assert np.all(floor.bounds == 0.1)
    assert not gate.is_wall and gate.moves
    assert gate.normals.tolist() == [[0.0, 1.0], [0.0, -1.0]]  # the side about a speed too is not one of the place
    assert (gate.times[0], gate.times[-1]) == (0.5, 1.0)
    assert gate.bounds[0].tolist() == [0.5, 0.5] and gate.bounds[-1] == pytest.approx([0.7, 0.3])
    assert goal.is_final and sorted(goal.bounds[0].tolist()) == pytest.approx(sorted([1.4, 0.9, -0.8, -0.3]))


def test_a_run_has_the_figure_where_a_plane_is_named(solved: sr.SolvedProblem, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    figure = solved.plot("plane")
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"forbidden", "terminal set", "nominal"} < set(labels)
    assert "gate, $t$ from 0.5 to 1" in labels
    assert figure.axes[0].get_xlabel() == "x [m]"
    again = sr.solve(puck(names=sr.Names()), control={"name": "piecewise_constant", "pieces": 4})
    with pytest.raises(sr.InputError, match="expected a figure that there is"):
        again.plot("plane")
    file = solved.save(tmp_path / "run", figures=False).directory / "config.yaml"
    assert "plane: [x, y]" in file.read_text("utf-8") or "- x\n" in file.read_text("utf-8").split("plane:")[1]


def test_what_is_beyond_a_line_is_cut_off() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    left = clipped(square, np.array([[1.0, 1.0]]), np.array([0.5]))
    assert sorted(map(tuple, left.tolist())) == [(0.0, 0.0), (0.0, 0.5), (0.5, 0.0)]
    assert clipped(square, np.array([[1.0, 0.0]]), np.array([-0.1])).shape == (0, 2)
    assert clipped(square, np.array([[1.0, 0.0]]), np.array([2.0])).tolist() == square.tolist()
    still = Limit(name="a", normals=np.eye(2), times=np.array([0.0, 1.0]), bounds=np.ones((2, 2)))
    assert not still.moves


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"plane": ["x1"]}, "names.plane: expected two of the states, such as x1 and x2"),
        ({"plane": ["x1", "x1"]}, "names.plane: expected two of the states"),
        ({"plane": ["x", "y"]}, "names.plane: expected two of the states"),
        ({"states": ["a", "b"], "plane": ["a", "c"]}, "expected two of the states, a, b, got .*'c'"),
        ({"states": ["a", "b"], "state_units": ["m", "rad"], "plane": ["a", "b"]}, "of the same unit, got m and rad"),
    ],
)
def test_a_plane_that_is_none_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(sr.InputError, match=words):
        sr.Names(**given)


def test_a_plane_of_a_state_that_is_not_there_is_refused_and_unnamed_states_have_one() -> None:
    assert sr.Names(plane=["x2", "x1"]).in_plane == (1, 0)
    assert sr.Names().in_plane is None
    with pytest.raises(sr.InputError, match=r"names.plane: expected two of 4 states"):
        puck(names=sr.Names(plane=["x1", "x5"]))


def test_the_parts_of_the_path_on_which_the_control_acts_are_drawn_and_a_goal_that_is_a_point_is_a_mark() -> None:
    problem = puck(disturbance=None, path=[], terminal=[sr.Equality([1.0, 0.5, 0.0, 0.0])])
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 10})
    axes = result.plot("plane").axes[0]
    arcs = [line for line in axes.lines if line.get_color() == ORANGE]
    acts = (np.abs(result.control.values) > 1e-6).any(axis=0)
    turns = int((np.diff(np.concatenate([[0], acts.astype(int)])) > 0).sum())
    assert 0 < turns == len(arcs) and not acts.all()
    assert len(axes.patches) == 0 and "terminal set" in [line.get_label() for line in axes.lines]


def test_a_figure_shows_why_the_control_acts_where_it_acts() -> None:
    problem = puck(disturbance=None, path=[], terminal=[sr.Equality([1.0, 0.5, 0.0, 0.0])])
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 10})
    push = switching(result.experiment, result)
    assert push is not None
    acts = np.abs(result.control.values) > 1e-6
    assert (np.abs(push[acts]) > 1.0 - 1e-6).all() and (np.abs(push[~acts]) < 1.0 + 1e-6).all()
    drawn = result.plot("switching").axes
    assert len(drawn) == 2 and drawn[0].get_ylabel() == "switching of u1"


@pytest.mark.parametrize(("side", "seen"), [(0.1, True), (0.6, False), (0.0, False)])
def test_a_goal_that_is_a_small_part_of_the_plane_is_shown_larger(side: float, seen: bool) -> None:
    path = np.stack([np.linspace(0.0, 4.0, 9), np.zeros(9)], axis=1)
    bounds = np.array([[4.0 + side / 2, -4.0 + side / 2, side / 4, side / 4]])
    normals = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    goal = Limit(name="goal", normals=normals, times=np.array([2.0]), bounds=bounds, is_final=True)
    plane = Plane(states=(0, 1), places=path[:, None], limits=(goal,))
    found = plane.goal(path)
    assert (found is not None) == seen
    if found is not None:
        np.testing.assert_allclose(found, [[4.0 - 0.15, -0.075], [4.0 + 0.15, 0.075]], atol=1e-12)
    free = Limit(name="goal", normals=normals[2:], times=np.array([2.0]), bounds=bounds[:, 2:], is_final=True)
    assert Plane(states=(0, 1), places=path[:, None], limits=(free,)).goal(path) is None
    assert Plane(states=(0, 1), places=path[:, None]).goal(path) is None


def test_what_is_around_a_small_goal_is_drawn_below_with_its_own_times() -> None:
    pytest.importorskip("matplotlib")
    small = sr.Box([0.98, 0.49, -0.05, -0.05], [1.02, 0.51, 0.05, 0.05])
    result = sr.solve(
        puck(disturbance=None, path=[], terminal=[small]), control={"name": "piecewise_constant", "pieces": 10}
    )
    whole, close = result.plot("plane").axes
    assert close.get_xlim() == pytest.approx((0.94, 1.06)) and close.get_ylim() == pytest.approx((0.47, 0.53))
    assert whole.get_xlim()[0] < 0.0 and len(close.patches) == 1
    first = [float(ax.texts[-1].get_text()) for ax in (whole, close)]
    assert first[0] == 0.0 and first[1] > 1.0 and [ax.texts[0].get_text() for ax in (whole, close)] == ["2", "2"]
