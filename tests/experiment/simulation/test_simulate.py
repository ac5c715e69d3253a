"""Guards experiment/simulation/simulate: simulation: exact trajectories, admissible signals, honest intervals, and
nothing worse than the proven worst case."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import binomtest

import sparserob_core as sr
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.control.sets.sets import NormBall, Polytope
from sparserob_core.control.studies.laws import Uncertainty
from sparserob_core.control.studies.simulate import fine_times, refine_grid, simulate_states, times_inside
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.experiment.simulation.simulation import clopper_pearson
from tests.support.plants import held, indicators, random_system, simulated, uniform, walsh

LAWS = ("iid", "vertices", "slow", "neighbours")
BOX = sr.Box([-0.1, -0.2], [0.1, 0.2])
CONFIG = {
    "title": "A double integrator under a disturbance",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 1.5},
        "disturbance": {"box": [0.02, 0.05]},
        "path": [{"box": [1.1, None]}],
        "terminal": [{"box": [0.5, 0.6]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
}


@pytest.fixture(scope="module")
def robust(tmp_path_factory):
    outcome = sr.run(CONFIG, out=tmp_path_factory.mktemp("runs") / "robust", quiet=True, figures=False)
    assert outcome.status == "certified"
    return outcome


@pytest.fixture(scope="module")
def nominal(tmp_path_factory):
    outcome = sr.run(
        CONFIG, ["method=nominal"], out=tmp_path_factory.mktemp("runs") / "nominal", quiet=True, figures=False
    )
    assert outcome.status == "refuted"
    return outcome


def model_of(disturbance_set, dictionary, kind="piecewise_constant", parameters=None):
    """A small uncertain plant, transcribed."""
    A = (
        np.array([[0.0, 1.0], [-2.0, -0.5]])
        if parameters is None
        else lambda p: np.array([[0.0, 1.0], [-2.0 + p[0], -0.5 + p[-1]]])
    )
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, np.array([[0.0], [1.0]]), parameters=parameters),
        horizon=2.0,
        initial_state=[1.0, 0.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=disturbance_set,
        disturbance_class=kind,
        path=[sr.PathConstraint(sr.Box([-2.0, -np.inf], [2.0, np.inf]), 0.3)],
        terminal=[sr.Ellipsoid([0.0, 0.0], np.eye(2))],
    )
    return prepare(problem, uniform(8, 2.0), dictionary)


def uncertainty_of(model):
    nu = model.parameters.count
    middle = np.zeros((1, 0)) if model.parameters.set is None else model.parameters.set.interior_point()[None]
    assert middle.shape == (1, nu)
    return Uncertainty(
        model.functionals, model.parameters, model.constraints, (np.array([2.0]), np.eye(2)[[0]], middle)
    )


CLASSES = {
    "a box by piece": (BOX, uniform(6, 2.0), "piecewise_constant"),
    "an ellipsoid by piece": (
        sr.Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.09]]),
        uniform(6, 2.0),
        "piecewise_constant",
    ),
    "a polytope by piece": (
        Polytope([[1, 1], [-1, 0], [0, -1]], [0.3, 0.1, 0.1]),
        indicators([0.0, 0.3, 1.1, 2.0]),
        "piecewise_constant",
    ),
    "measurable": (BOX, uniform(6, 2.0), "measurable"),
    "an l1 ball": (sr.Box([-0.1, -0.2], [0.1, 0.2]), uniform(40, 2.0), "l1_ball"),
    "an l1 ball in walsh functions": (sr.Box([-0.1, -0.2], [0.1, 0.2]), walsh(8, 2.0, 5), "l1_ball"),
    "an incomplete dictionary": (BOX, walsh(8, 2.0, 5), "piecewise_constant"),
    "a long incomplete dictionary": (
        BOX,
        Dictionary(np.linspace(0, 2, 13), np.cos(np.outer(np.arange(9), np.arange(12)))),
        "piecewise_constant",
    ),
}


def admissibility(model: DisturbanceModel, signals: np.ndarray) -> np.ndarray:
    """Return the residual ``(n,)`` by which disturbances ``(n, mw, L)`` on the merged grid fail to be admissible; at
    most rounding where they are admissible."""
    if model.starts is not None:
        values = signals.swapaxes(1, 2)
        uneven = np.abs(signals - model.signals(values[:, model.starts])).max(axis=(1, 2))
        return np.asarray(np.maximum(model.bound.violation(values).max(axis=1), uneven))
    functions = np.asarray(model.functions)
    coefficients = signals @ np.linalg.pinv(functions)
    outside = np.abs(coefficients @ functions - signals).max(axis=(1, 2))
    if model.scale is not None:
        used = np.abs(coefficients).sum(axis=2) - model.scale
        return np.asarray(np.maximum(used.max(axis=1), outside))
    return np.asarray(np.maximum(model.set.violation(coefficients.reshape(signals.shape[0], -1)), outside))


@pytest.mark.first(16)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", CLASSES)
def test_every_law_draws_admissible_signals_that_differ(name, law):
    model = model_of(*CLASSES[name])
    disturbances, _, _ = uncertainty_of(model).draw(law, 60, np.random.default_rng(1))
    assert disturbances.shape == (60, 2, model.response.grid.pieces)
    assert np.ptp(disturbances, axis=0).max() > 1e-3
    assert admissibility(model.functionals.disturbance, disturbances).max() <= 1e-12
    convex, dictionary, kind = CLASSES[name]
    on_pieces = disturbances[
        :, :, [int(np.flatnonzero(model.response.grid.disturbance_piece == k)[0]) for k in range(dictionary.pieces)]
    ]
    fit = np.linalg.lstsq(dictionary.values.T, on_pieces.reshape(-1, dictionary.pieces).T, rcond=None)[0].T.reshape(
        60, 2, -1
    )
    if kind == "l1_ball":
        assert (np.abs(fit).sum(axis=2) <= convex.upper + 1e-12).all()
    else:
        assert convex.contains(disturbances.swapaxes(1, 2), 1e-12).all()
    if kind != "measurable":
        assert np.abs(fit @ dictionary.values - on_pieces).max() <= 1e-12


def test_a_signal_that_is_not_admissible_is_told_from_one_that_is():
    for parts in CLASSES.values():
        model = model_of(*parts)
        drawn, _, _ = uncertainty_of(model).draw("vertices", 20, np.random.default_rng(2))
        assert admissibility(model.functionals.disturbance, 1.3 * drawn).max() > 1e-3


@pytest.mark.first(8)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "parameters",
    [
        sr.Box([-0.2], [0.3]),
        sr.Ellipsoid([0.0, 0.0], [[0.04, 0.01], [0.01, 0.02]]),
        NormBall(3.0, 0.2, dimension=2),
        Polytope([[1, 1, 0, 0, 0], *(-np.eye(5)), *np.eye(5)], [0.1, *([0.2] * 10)]),
    ],
    ids=lambda one: f"{type(one).__name__}{one.dimension}",
)
def test_parameters_of_any_set_are_drawn_from_it(parameters, law):
    model = model_of(BOX, uniform(6, 2.0), parameters=parameters)
    _, drawn, _ = uncertainty_of(model).draw(law, 80, np.random.default_rng(3))
    assert drawn.shape == (80, parameters.dimension)
    assert np.ptp(drawn, axis=0).min() > 1e-3
    assert parameters.contains(drawn, 1e-12).all()


@pytest.mark.parametrize(
    "convex",
    [NormBall(1.0, 2.0, dimension=4), NormBall(3.0, 1.0, dimension=3), sr.Ellipsoid([1, 0], [[4, 1], [1, 1]])],
    ids=["l1", "l3", "ellipsoid"],
)
def test_uniform_points_fill_a_ball_by_volume(convex):
    points = convex.sample(8_000, np.random.default_rng(4))
    centre, d = convex.interior_point(), convex.dimension
    inside = convex.contains(centre + 2 ** (1 / d) * (points - centre), 0.0)  # a copy of half the volume
    assert convex.contains(points, 1e-12).all()
    assert abs(inside.mean() - 0.5) < 4 * 0.5 / np.sqrt(8_000)


def test_hit_and_run_finds_the_mean_and_the_spread_of_a_box():
    box = Polytope(np.vstack([np.eye(6), -np.eye(6)]), np.ones(12))
    points = box.sample(20_000, np.random.default_rng(5))
    assert np.abs(points.mean(axis=0)).max() < 0.03
    assert np.abs(points.var(axis=0) - 1 / 3).max() < 0.02


def test_extreme_points_of_a_box_are_its_corners():
    points = BOX.sample_extreme(200, np.random.default_rng(6))
    assert len({tuple(point) for point in points}) == 4
    assert (np.abs(points) == BOX.upper).all()


@pytest.mark.parametrize("numbers", [2_000_000, 0])
def test_trajectories_agree_with_an_integrator_and_with_augmented_exponentials(numbers, monkeypatch):
    """With as many numbers as are held of transitions, and, where none are, by modes."""
    monkeypatch.setattr("sparserob_core.control.studies.simulate.MAX_NUMBERS_AT_ONCE", numbers)
    rng = np.random.default_rng(7)
    for states, pieces in ((2, 5), (3, 4)):
        system = random_system(rng, states, 2, 2)
        control, disturbance = uniform(pieces, 1.5), indicators([0.0, 0.4, 1.5])
        problem = sr.OptimalControlProblem(
            system=system,
            horizon=1.5,
            initial_state=rng.normal(size=states),
            control=sr.Box([-1, -1], [1, 1]),
            disturbance=BOX,
        )
        model = prepare(problem, control, disturbance)
        u, w = rng.normal(size=(2, pieces)), rng.normal(size=(3, 2, 2))
        times = fine_times(model.response, ParameterIndex(None), np.array([0.123]))
        fine = Response(system, refine_grid(model.response.grid, times), model.response.initial_state)
        grid = model.response.grid
        paths = np.stack(
            list(simulate_states(fine, u[:, grid.control_piece], np.zeros((3, 0)), w[:, :, grid.disturbance_piece]))
        )
        assert {0.0, 0.123, 1.5} <= set(times.tolist())
        ends = itertools.pairwise(model.response.grid.breakpoints.tolist())
        assert times_inside(times, model.response.grid.breakpoints) == min(
            sum(a < time < b for time in times.tolist()) for a, b in ends
        )
        for position in (0, 3, times.size // 2, times.size - 1):
            exact = simulated(
                system.phases[0].A,
                [(system.phases[0].B, control.breakpoints, u), (system.phases[0].E, disturbance.breakpoints, w[1])],
                problem.initial_state,
                times[position],
                np.zeros(1),
            )
            assert np.abs(paths[position, :, 1] - exact).max() <= 1e-12 * max(1.0, np.abs(exact).max())
        state = problem.initial_state
        for left, right in zip(grid.breakpoints[:-1], grid.breakpoints[1:], strict=True):
            force = system.phases[0].B @ held(control.breakpoints, u, (left + right) / 2) + system.phases[0].E @ held(
                disturbance.breakpoints, w[2], (left + right) / 2
            )
            state = solve_ivp(
                lambda t, x, force=force, A=system.phases[0].A: A @ x + force,
                (left, right),
                state,
                rtol=1e-11,
                atol=1e-12,
            ).y[:, -1]
        assert np.abs(paths[-1, :, 2] - state).max() <= 1e-8 * max(1.0, np.abs(state).max())


def test_every_trajectory_has_its_own_parameter():
    model = model_of(BOX, uniform(6, 2.0), parameters=sr.Box([-0.5, -0.3], [0.5, 0.3]))
    rng = np.random.default_rng(8)
    disturbances, parameters, _ = uncertainty_of(model).draw("iid", 4, rng)
    u = rng.normal(size=(1, 8))
    grid = model.response.grid
    paths = np.stack(
        list(
            simulate_states(
                Response(model.response.system, refine_grid(grid, grid.breakpoints), model.response.initial_state),
                u[:, grid.control_piece],
                parameters,
                disturbances,
            )
        )
    )
    for number in range(4):
        A, B, E = (matrix[0] for matrix in model.response.system.phases[0].matrices(parameters[[number]]))
        exact = simulated(
            A, [(B, np.linspace(0, 2, 9), u), (E, grid.breakpoints, disturbances[number])], [1.0, 0.0], 2.0, np.zeros(1)
        )
        assert np.abs(paths[-1, :, number] - exact).max() <= 1e-12
    assert np.ptp(paths[-1], axis=1).min() > 1e-3


def test_the_interval_is_that_of_clopper_and_pearson():
    for successes, trials in ((0, 10), (10, 10), (3, 10), (1, 10_000), (9990, 10_000)):
        known = binomtest(successes, trials).proportion_ci(0.95, "exact")
        assert clopper_pearson(successes, trials) == pytest.approx((known.low, known.high), abs=1e-12)
    assert clopper_pearson(0, 10_000)[1] == pytest.approx(1 - 0.025 ** (1 / 10_000), rel=1e-9)
    assert clopper_pearson(0, 10)[0] == 0.0


@pytest.mark.parametrize("law", LAWS)
def test_no_sampled_trajectory_is_worse_than_the_worst_case(robust, nominal, law):
    for outcome in (robust, nominal):
        found = sr.simulate(outcome, 700, law)
        assert [one.name for one in found.constraints] == [family.name for family in outcome.program.families]
        assert not found.contradicts
        for one in found.constraints:
            assert one.largest <= one.worst + 1e-12
            assert one.lower <= one.share <= one.upper
        assert max(one.worst for one in found.constraints) == pytest.approx(outcome.result.worst.violation, abs=1e-8)


def test_neighbours_come_closer_to_the_worst_case_than_independent_draws(robust):
    iid, near = (sr.simulate(robust, 700, law).any_violated for law in ("iid", "neighbours"))
    assert near.worst - near.largest < 0.1 * (iid.worst - iid.largest)


def test_a_control_that_ignores_the_disturbance_is_seen_to_fail_and_a_robust_one_is_not(robust, nominal):
    assert sr.simulate(nominal, 700, "neighbours").any_violated.lower > 0.1
    assert sr.simulate(robust, 700, "neighbours").any_violated.violated == 0


def test_a_violation_between_two_breakpoints_is_seen(tmp_path):
    config = {
        "problem": {
            **CONFIG["problem"],
            "system": {"A": [[0, 1], [-36, 0]], "B": [[0], [1]]},
            "horizon": 1.0,
            "path": [{"box": {"lower": [None, None], "upper": [1.12, None]}}],
            "initial_state": [0.0, 6.9],
            "disturbance": None,
            "terminal": [],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "breakpoints": [0, 0.05, 1]}},
    }
    outcome = sr.run(config, ["method=nominal"], out=tmp_path / "run", quiet=True, figures=False)
    one = sr.simulate(outcome, 5).constraints[0]
    grid = np.array([0.05, 1.0])
    assert np.abs(one.time - grid).min() > 0.05
    assert one.largest == pytest.approx(one.worst, abs=1e-9)


def test_a_claim_that_a_trajectory_refutes_is_called_a_contradiction(nominal, command):
    file = nominal.directory / "result.json"
    text = file.read_text()
    try:
        file.write_text(json.dumps({**json.loads(text), "status": "certified"}))
        assert sr.simulate(nominal, 700, "neighbours").contradicts
        assert command("simulate", nominal.directory, "--law", "neighbours", "--trajectories", 300).returncode == 4
    finally:
        file.write_text(text)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers_in_a_fresh_process(robust):
    here = sr.simulate(robust, 900, "iid", seed=5).summary()
    code = (
        f"import json, sparserob_core as sr; print(json.dumps(sr.simulate({str(robust.directory)!r}, 900, 'iid',"
        " seed=5).summary()))"
    )
    there = json.loads(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    other = sr.simulate(robust, 900, "iid", seed=6).summary()
    assert {**there, "seconds": 0} == {**json.loads(json.dumps(here)), "seconds": 0}
    assert other["constraints"] != here["constraints"]


def test_the_result_is_in_the_run_directory(robust, command):
    done = command("simulate", robust.directory, "--trajectories", 200, "--law", "vertices", "--json")
    assert done.returncode == 0, done.stderr
    written = json.loads((robust.directory / "simulation-vertices.json").read_text())
    assert json.loads(done.stdout) == written
    assert written["trajectories"] == 200
    assert any("no proof" in line for line in written["remarks"])
    table = command("simulate", robust.directory, "--trajectories", 200).stdout
    assert "this is no proof" in table
    assert "any of them" in table


@pytest.mark.slow
def test_the_figure_is_drawn_where_it_is_wanted(robust, tmp_path):
    for law in ("iid", "adversary"):
        for kind, start in ((".png", b"\x89PNG"), (".pdf", b"%PDF")):
            file = tmp_path / "new" / f"{law}{kind}"
            sr.simulate(robust, None if law == "adversary" else 50, law, out=file)
            assert file.read_bytes().startswith(start)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"law": "idd"}, "did you mean 'iid'"),
        ({"trajectories": 0}, "at least 1"),
        ({"trajectories": True}, "whole number"),
        ({"trajectories": 1.5}, "whole number"),
        ({"seed": -1}, "seed"),
        ({"trajectories": 5, "law": "adversary"}, "no number"),
        ({"out": "figure.bmp"}, "ends in"),
        ({"out": f"{__file__}/figure.png"}, "cannot be written"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_written(robust, arguments, said):
    before = {file.name: file.stat().st_mtime_ns for file in robust.directory.iterdir()}
    with pytest.raises(sr.InputError, match=said):
        sr.simulate(robust, **arguments)
    assert before == {file.name: file.stat().st_mtime_ns for file in robust.directory.iterdir()}


def test_what_is_no_finished_run_with_a_control_is_refused(robust, tmp_path, command):
    def copy(name):
        folder = tmp_path / name
        folder.mkdir()
        for file in ("config.yaml", "result.json", "solution.npz"):
            (folder / file).write_bytes((robust.directory / file).read_bytes())
        return folder

    unfinished, broken, other, unread, empty = (
        copy(name) for name in ("unfinished", "broken", "other", "unread", "empty")
    )
    (unfinished / "solution.npz").unlink()
    (broken / "solution.npz").write_bytes(b"PK\x03\x04 half")
    np.savez(other / "solution.npz", theta=np.full((1, 10), np.nan))
    (unread / "result.json").write_text("{")
    (empty / "config.yaml").unlink()
    np.savez(copy("short") / "solution.npz", theta=np.zeros((1, 3)))
    for place, said in (
        (unfinished, "no control"),
        (broken, "cannot be read"),
        (other, "finite"),
        (unread, "cannot be read"),
        (empty, "without config.yaml"),
        (tmp_path / "short", "shape"),
        (tmp_path / "absent", "nothing"),
        (empty / "result.json", "a file"),
    ):
        done = command("simulate", place, "--trajectories", 5)
        assert done.returncode == 2, done.stderr
        assert said in done.stderr
        assert "Traceback" not in done.stderr
        assert not list(Path(tmp_path).rglob("simulation-*"))
    with pytest.raises(sr.InputError, match="expected the directory of a run"):
        sr.simulate(7)


def test_a_directory_that_takes_no_result_is_refused_before_anything_is_computed(tmp_path, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode, **_: not mode & os.W_OK)  # who tests may be allowed everything
    from sparserob_core.experiment.directory.artefacts import require_room

    with pytest.raises(sr.InputError, match="cannot be written to; expected a directory that takes the result"):
        require_room(tmp_path)


def test_an_orbit_in_metres_and_seconds_is_walked_to_rounding() -> None:
    from flint import arb, arb_mat, ctx

    from sparserob_core.control.response.response import Response
    from sparserob_core.control.response.time_grid import TimeGrid

    n, horizon, begin = 1.13e-3, 6000.0, [-3e4, 500.0, 8.5, 0.0]
    A = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, 0, 0, 2 * n], [0, 3 * n * n, -2 * n, 0]])
    grid = TimeGrid(np.linspace(0.0, horizon, 25), np.arange(24), np.arange(24))
    response = Response(sr.LinearSystem(A, np.eye(4)[:, 2:]), grid, np.array(begin))
    *_, state = simulate_states(response, np.zeros((2, 24)), np.zeros((1, 0)), None)
    with ctx.workprec(200):
        power = arb_mat([[arb(v) * horizon for v in row] for row in A.tolist()]).exp()
        exact = [float(v) for v in (power * arb_mat([[arb(v)] for v in begin])).entries()]
    assert np.abs(state[:2, 0] - exact[:2]).max() < 1e-8  # of 30 km; in metres and seconds it is 2e-7
