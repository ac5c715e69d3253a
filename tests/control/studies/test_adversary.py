"""Guards control/studies/adversary: adversaries: admissible signals that attain what the separation predicts, for every
class of disturbances, and can be replayed."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.studies.adversary import find_adversaries, find_adversary, worst_signal
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.experiment.assemble import PlainExperiment
from sparserob_core.experiment.directory.adversary import FILE, adversaries, attained
from sparserob_core.experiment.directory.artefacts import RunDirectory
from sparserob_core.experiment.figures.adversary_figure import draw_adversary
from sparserob_core.experiment.figures.drawing import figure_data
from tests.support.plants import indicators, uniform, walsh

BOX = sr.Box([-0.1, -0.2], [0.1, 0.2])
ROUND = sr.Ellipsoid([0.0, 0.0], [[0.02, 0.01], [0.01, 0.03]])
CASES = {
    "a box": (BOX, "piecewise_constant", uniform(6, 2.0)),
    "an ellipsoid": (ROUND, "piecewise_constant", uniform(6, 2.0)),
    "an incomplete dictionary": (BOX, "piecewise_constant", walsh(4, 2.0, 3)),
    "an l1 ball": (BOX, "l1_ball", walsh(8, 2.0)),
    "measurable, box": (BOX, "measurable", indicators([0.0, 2.0])),
    "measurable, 1-norm": (sr.NormBall(1.0, 0.2, dimension=2), "measurable", uniform(3, 2.0)),
    "none": (None, "piecewise_constant", uniform(6, 2.0)),
}
PARAMETERS = {"known": None, "box": sr.Box([-0.3], [0.4]), "ellipsoid": sr.Ellipsoid([0.1], [[0.04]])}


def transcribed(convex, kind, dictionary, parameters=None):
    A = (
        np.array([[0.0, 1.0], [-4.0, -0.3]])
        if parameters is None
        else lambda p: np.array([[0.0, 1.0], [-4.0 + p[0], -0.3 + p[0]]])
    )
    round_window = sr.PathConstraint(sr.Ellipsoid([0, 0], np.eye(2)), 0.5, 1.7)
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, np.array([[0.0], [1.0]]), parameters=parameters),
        horizon=2.0,
        initial_state=[1.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=convex,
        disturbance_class=kind,
        path=[
            sr.PathConstraint(sr.Box([-1.1, -np.inf], [1.1, np.inf]), 0.3),
            *([round_window] if parameters is None and kind != "measurable" else []),
        ],
        terminal=[sr.Box([-0.3, -0.4], [0.3, 0.4])],
    )
    return prepare(problem, uniform(8, 2.0), dictionary)


def reached(model, one, u):
    """The state at the adversary's time, one augmented exponential per piece of its own signal."""
    A, B, E = (matrix[0] for matrix in model.stated.system.phases[0].matrices(one.parameter[None]))
    cuts = np.unique(np.concatenate([one.breakpoints, model.control.breakpoints, [one.time]]))
    state = np.array(model.problem.initial_state, dtype=float)
    for left, right in pairwise(cuts[cuts <= one.time]):
        middle = (left + right) / 2
        force = B @ u[:, np.searchsorted(model.control.breakpoints, middle) - 1]
        if one.disturbance is not None:
            force = force + E @ one.disturbance[:, np.searchsorted(one.breakpoints, middle) - 1]
        block = np.zeros((3, 3))
        block[:2, :2], block[:2, 2] = A, force
        state = (expm(block * (right - left)) @ np.append(state, 1.0))[:2]
    return state


HEAVY = [
    (name, parameters)
    for name in CASES
    for parameters in PARAMETERS
    if name.startswith("measurable") and parameters != "known" and (name, parameters) != ("measurable, box", "box")
]


@pytest.mark.first(4)
@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        pytest.param(name, parameters, marks=pytest.mark.slow if (name, parameters) in HEAVY else ())
        for name in CASES
        for parameters in PARAMETERS
    ],
)
def test_the_adversary_attains_the_worst_of_its_family(name, parameters):
    model = transcribed(*CASES[name], PARAMETERS[parameters])
    program, u = model.program, np.random.default_rng(1).uniform(-1, 1, size=8)
    constraints = model.constraints
    assert [constraint.name for constraint in constraints] == [family.name for family in program.families]
    for constraint in constraints:
        one = find_adversary(constraint, u)
        assert one.violation == program.family(one.name).worst(u).violations[0]
        assert one.direction @ reached(model, one, u[None]) - one.bound == pytest.approx(one.violation, abs=1e-9)
        sought = find_adversary(constraint, u, own=program.own_units)
        assert sought.violation == pytest.approx(one.violation, abs=1e-9) and sought.row == one.row
        if one.disturbance is not None:
            assert CASES[name][0].contains(one.disturbance.T, 1e-12).all()
        if parameters != "known":
            assert PARAMETERS[parameters].contains(one.parameter, 1e-9)


def test_the_worst_case_is_sought_in_own_units_and_is_that_of_the_users():
    system = sr.LinearSystem(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1e-3]]), np.array([[0.0], [1e-6]]))
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=1000.0,
        initial_state=[0.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-1.0], [1.0]),
        path=[sr.PathConstraint(sr.Box([-400.0, -1.0], [400.0, 0.5]), name="metres and metres a second")],
    )
    model = prepare(problem, uniform(8, 1000.0), uniform(8, 1000.0))
    u = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    (constraint,), own = model.constraints, model.program.own_units
    units = own.program.families[0].row_units
    assert units.max() > 100 * units.min()  # the row that is worst in the user's units is not the worst in its own
    assert own.program.families[0].worst(u / own.decision).rows[0] == 1
    one = find_adversary(constraint, u, own=own)
    assert "margins" not in constraint.samples.__dict__  # what was looked at before is not looked at again
    again = find_adversary(constraint, u)
    assert (
        one.row == again.row == 0
        and one.time == again.time
        and one.violation == pytest.approx(again.violation, rel=1e-12)
    )
    assert find_adversaries(model, u)[0].violation == one.violation


def test_the_worst_measurable_disturbance_switches_where_the_adjoint_changes_its_sign():
    model = transcribed(sr.Box([-0.1, 0.0], [0.1, 0.0]), "measurable", indicators([0.0, 2.0]))
    breakpoints, signal = worst_signal(model.functionals, 1.9, np.array([1.0, 0.0]), np.zeros(0))
    A = model.response.system.phases[0].matrices(np.zeros((1, 0)))[0][0]
    switches = breakpoints[1:-1][np.diff(signal[0]) != 0]
    switches = switches[switches < 1.9 - 1e-9]
    assert switches.size > 0
    assert all(abs((expm(A * (1.9 - time)))[0, 0]) < 1e-6 for time in switches)


def test_a_set_without_corners_is_attained_as_far_as_constants_go():
    model = transcribed(ROUND, "measurable", uniform(6, 2.0))
    time, direction = 1.9, np.array([1.0, 0.5])
    best = model.functionals.offsets(np.array([time]), direction[None], np.zeros((1, 0)))[0]
    breakpoints, signal = worst_signal(model.functionals, time, direction, np.zeros(0))
    A, _, E = (matrix[0] for matrix in model.response.system.phases[0].matrices(np.zeros((1, 0))))
    state = np.zeros(2)
    for left, right, w in zip(breakpoints[:-1], breakpoints[1:], signal.T, strict=True):
        if right <= time + 1e-12:
            block = np.zeros((3, 3))
            block[:2, :2], block[:2, 2] = A, E @ w
            state = (expm(block * (right - left)) @ np.append(state, 1.0))[:2]
    assert ROUND.contains(signal.T, 1e-12).all()
    assert 0.0 <= best - direction @ state < 1e-6 * best


CONFIG = {
    "title": "A double integrator under a disturbance",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], ["a", 0]], "B": [[0], [1]], "parameters": {"a": [-0.1, 0.1]}},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 1.5},
        "disturbance": {"box": [0.01, 0.03]},
        "path": [{"box": [1.1, None]}],
        "terminal": [{"box": [0.6, 0.7]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
}


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    return sr.run(CONFIG, ["method=nominal"], out=tmp_path_factory.mktemp("runs") / "run", quiet=True, figures=False)


def test_the_arrays_say_everything_about_every_family(outcome):
    arrays = adversaries(outcome.experiment, outcome.result.decision)
    assert arrays["names"].tolist() == ["path", "terminal"]
    f, d, pieces, instants = 2, 2, arrays["breakpoints"].size - 1, arrays["state_times"].size
    assert arrays["disturbances"].shape == (f, 2, pieces)
    assert arrays["states"].shape == (f, d, instants)
    assert arrays["parameters"].shape == (f, 1)
    assert np.abs(attained(arrays, arrays["state_times"], arrays["states"]) - arrays["violations"]).max() <= 1e-9
    # the witness of a refuted run need not be the worst
    assert arrays["violations"].max() >= outcome.result.worst.violation - 1e-9
    assert arrays["violations"].max() > 0.01
    again = adversaries(outcome.experiment, np.asarray(outcome.result.decision).reshape(1, -1))
    assert all(np.array_equal(arrays[name], again[name]) for name in arrays)


def test_a_program_that_is_no_control_problem_has_no_adversary(outcome):
    bare = PlainExperiment(outcome.experiment.loaded, outcome.program)
    assert adversaries(bare, np.zeros(3)) == {}


def test_a_replay_attains_what_is_stored_and_shows_what_was_changed(outcome, command):
    arrays = adversaries(outcome.experiment, outcome.result.decision)
    directory = RunDirectory(outcome.directory)
    directory.write_arrays(FILE, arrays)
    found = sr.simulate(outcome, law="adversary")
    assert all(abs(one.largest - one.worst) <= 1e-9 for one in found.constraints)
    assert "predicted violation" in command("simulate", outcome.directory, "--law", "adversary").stdout
    directory.write_arrays(FILE, {**arrays, "disturbances": 0.5 * arrays["disturbances"]})
    weaker = sr.simulate(outcome, law="adversary")
    assert {one.name: one for one in weaker.constraints}["terminal"].largest < found.constraints[1].largest - 1e-3
    for wrong in (
        {"names": np.array(["path", "roof"])},
        {"times": np.array([0.5])},
        {"breakpoints": arrays["breakpoints"][::-1]},
        {"disturbances": np.full_like(arrays["disturbances"], np.nan)},
    ):
        directory.write_arrays(FILE, {**arrays, **wrong})
        done = command("simulate", outcome.directory, "--law", "adversary")
        assert done.returncode == 2, done.stdout
        assert FILE in done.stderr
    (outcome.directory / FILE).unlink()


def test_the_figure_shows_every_state_and_every_disturbance(outcome):
    arrays = adversaries(outcome.experiment, outcome.result.decision)
    theta = np.asarray(outcome.result.decision).reshape(1, -1)
    figure = draw_adversary(arrays, figure_data(outcome.experiment, theta, None, (), None))
    assert len(figure.axes) == 4
    labels = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert {"worst case of path", "worst case of terminal"} <= labels


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ({}, "nothing is uncertain"),
        ({"jitter": 0.05}, "delivery of the control"),
        ({"execution": 0.03}, "delivery of the control"),
        ({"disturbance": {"box": [0.01, 0.01]}}, "disturbance"),
    ],
)
def test_the_figure_names_what_makes_the_worst_cases(more, named):
    problem = {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1.0, 0.0],
        "control": {"box": 2.0},
        "terminal": [{"box": [0.3, 0.3]}],
        **more,
    }
    dictionary = {"control": {"name": "piecewise_constant", "pieces": 10}}
    outcome = sr.run({"problem": problem, "dictionaries": dictionary, "observers": []}, quiet=True, figures=False)
    arrays = adversaries(outcome.experiment, outcome.result.decision)
    theta = np.asarray(outcome.result.decision).reshape(1, -1)
    figure = draw_adversary(arrays, figure_data(outcome.experiment, theta, None, (), None))
    assert f"the worst case of every constraint: {named}" in {
        text.get_text() for text in figure.findobj(lambda part: hasattr(part, "get_text"))
    }
