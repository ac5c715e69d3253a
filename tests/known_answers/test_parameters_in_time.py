"""Guards parameters beside the time: costs by closed forms, by systems that do not change with time, and by linear
programs at the corners of the box, each checked."""

from __future__ import annotations

import copy
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.studies.laws import ParametersInTime
from sparserob_core.control.studies.simulate import simulate_states
from sparserob_core.control.transcription.provable import unprovable
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.figures.drawing import figure_data
from sparserob_core.experiment.terminal.table import result_rows
from tests.support import tampering

Config = dict[str, Any]

BASE: Config = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [[0, 1], ["-1 - 0.3*sin(t)", -0.2]],
            "B": [[0], ["(1 + p) * (1 + 0.1*cos(t))"]],
            "E": [[0], ["1 + q"]],
            "c": [0, "0.1 * q * cos(2*t)"],
            "parameters": {"p": [-0.05, 0.05], "q": [-0.2, 0.3]},
        },
        "horizon": 5.0,
        "initial_state": [-0.5, 0.5],
        "control": {"box": 1.5},
        "disturbance": {"box": [0.02]},
        "path": [{"box": [0.7, None], "from": 0.2}],
        "terminal": [{"box": [0.25, 0.25]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
    "observers": [],
}


def solved(config: Config, directory: Path) -> sr.Outcome:
    outcome = sr.run(config, out=directory, quiet=True, figures=False)
    assert check(directory).status == "verified"
    return outcome


def beside(**system: Any) -> Config:
    config = copy.deepcopy(BASE)
    config["problem"]["system"].update(system)
    return config


@pytest.mark.slow
def test_the_gain_of_an_integrator_is_paid_for_at_its_weakest(tmp_path: Path) -> None:
    """``x' = (1 + p) (2 - t) u``: the strongest pieces are the first ones; at ``|p| <= 0.1`` the end is within 0.2 of 1
    where 0.9 of what is given reaches 0.8, and 1.1 of it stays below 1.2."""
    config: Config = {
        "problem": {
            "name": "linear",
            "system": {"A": [[0]], "B": [["(1 + p) * (2 - t)"]], "parameters": {"p": [-0.1, 0.1]}},
            "horizon": 2.0,
            "initial_state": [-1.0],
            "control": {"box": 1.0},
            "terminal": [{"box": [0.2]}],
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 8}},
        "observers": [],
    }
    gains = np.array([2 - (k + 0.5) / 4 for k in range(8)]) / 4
    needed, cost = 0.8 / 0.9, 0.0
    for gain in gains:
        share = min(1.0, needed / gain)
        needed, cost = needed - share * gain, cost + share / 4
        if needed <= 0.0:
            break
    outcome = solved(config, tmp_path / "run")
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(cost, rel=1e-8)
    worst = json.loads((tmp_path / "run" / "result.json").read_text(encoding="utf-8"))["worst"]
    assert worst["corner"] == "p = -0.1"
    assert dict(result_rows({**outcome.summary, "worst": worst}))["worst violation"].endswith("at t = 2, p = -0.1")


def test_tubes_and_figures_are_of_the_states_at_all_parameters() -> None:
    """``x' = (1 + p) (2 - t) + 1/2``, with integrals after it: what the gain adds is in the tube, not below it."""
    made = beside(A=[[0]], B=[["(1 + p) * (2 - t)"]], E=[[1]], c=["0.5"], parameters={"p": [-0.1, 0.2]})
    made["problem"].update(
        horizon=2.0, initial_state=[-1.0], disturbance=None, terminal=[{"box": [2.5]}], path=[],
        integral=[{"H": [[1]], "G": [[0]], "from": 0, "to": 2, "upper": [5.0]}],
    )  # fmt: skip
    experiment = assemble(load_config(made))
    data = figure_data(experiment, np.ones((1, 10)), None, (), None)
    given = 2.0 * data.times - data.times**2 / 2
    assert data.drawn_states == (0, 2, 3) and data.of_states == ""  # its integral at either corner
    np.testing.assert_allclose(data.tube_lower[0], -1.0 + 0.9 * given + data.times / 2, atol=1e-9)
    np.testing.assert_allclose(data.tube_upper[0], -1.0 + 1.2 * given + data.times / 2, atol=1e-9)
    np.testing.assert_allclose(data.state[0], -1.0 + 1.05 * given + data.times / 2, atol=1e-9)


@pytest.mark.slow
def test_a_drawn_trajectory_has_a_parameter_of_its_own() -> None:
    """``x' = (1 + p) (2 - t) + q`` under a control of 1, whose integral stays that of the corners."""
    made = beside(A=[[0]], B=[["(1 + p) * (2 - t)"]], E=[[1]], c=["q"], parameters={"p": [-0.1, 0.2], "q": [0, 1]})
    made["problem"].update(
        horizon=2.0, initial_state=[-1.0], disturbance=None, terminal=[{"box": [9]}], path=[],
        integral=[{"H": [[1]], "G": [[0]], "from": 0, "to": 2, "upper": [9.0]}],
    )  # fmt: skip
    model = assemble(load_config(made)).transcription
    drawn = ParametersInTime.of(model.stated)
    assert drawn is not None
    state = list(simulate_states(model.response, model.functionals.on_grid(np.ones(10)), np.zeros((400, 0)), None))[-1]
    uniform = drawn.at(state, drawn.draw("iid", 400, None, np.random.default_rng(0)))[0]
    assert uniform.std() == pytest.approx(np.hypot(0.6, 2.0) / np.sqrt(12), rel=0.1)
    corners = drawn.at(state, drawn.draw("vertices", 400, None, np.random.default_rng(0)))
    assert {round(x, 9) for x in corners[0].tolist()} == {0.8, 1.4, 2.8, 3.4}  # -1 + 2 (1 + p) + 2 q
    np.testing.assert_array_equal(corners[1:3], 0.0)
    np.testing.assert_array_equal(corners[3:], state[3:])
    upper = drawn.find_corner(np.array([1.0, *(drawn.every[-1][0, 1:])]))
    near = drawn.at(state, drawn.draw("neighbours", 400, np.tile(upper, (400, 1)), np.random.default_rng(0)))[0]
    assert near.min() >= 3.14 - 1e-9 and near.max() <= 3.4 + 1e-9  # a tenth of the way to a random one, at most
    at_corner = drawn.at(state, upper[None])[0]
    np.testing.assert_allclose(at_corner, 3.4, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["vertices", "neighbours", "adversary"])
def test_draws_come_to_the_worst_parameters_and_never_beyond(law: str, tmp_path: Path) -> None:
    outcome = solved(BASE, tmp_path / "run")
    found = sr.simulate(outcome, None if law == "adversary" else 400, law)
    worst = {one.name: one.worst for one in found.constraints}
    for one in found.constraints:
        assert one.violated == 0 and one.largest <= one.worst + 1e-9
    assert max(one.largest for one in found.constraints) >= max(worst.values()) - 0.05
    assert np.ptp(found.fan[:, 0, -1]) > 0.01
    np.testing.assert_array_equal(found.fan[:, 2:], 0.0)  # nothing is left for a parameter to add


def at_the_corners(share: float = 0.0, end: tuple[float, int] | None = None) -> float:
    """The least cost of `BASE` for disturbances on the control's pieces and parameters at the corners of their box, the
    rows of the path at the ends of fine parts of the pieces: a bound from below that misses little. Of what is
    commanded a ``share`` may be missing or too much, any function of time. With an ``end``, a radius and how many
    directions, that is a disc, and there is no path."""
    N, T, parts = 10, 5.0, 12
    fine = np.linspace(0.0, T, 200 * N + 1)
    middles, width = (fine[:-1] + fine[1:]) / 2, T / (200 * N)
    homogeneous = solve_ivp(
        lambda t, y: (np.array([[0, 1], [-1 - 0.3 * np.sin(t), -0.2]]) @ y.reshape(2, 2)).ravel(),
        (0.0, T), np.eye(2).ravel(), method="DOP853", rtol=1e-12, atol=1e-13, dense_output=True,
    ).sol  # fmt: skip
    driven = np.array([
        np.linalg.solve(homogeneous(t).reshape(2, 2), [0.0, 1 + 0.1 * np.cos(t)]) for t in middles.tolist()
    ])  # fmt: skip

    def missing(t: float, normal: np.ndarray, gain: float) -> np.ndarray:
        if share == 0.0:
            return np.zeros(N)
        heights = np.abs(driven @ (normal @ homogeneous(t).reshape(2, 2))) * gain * width * (middles < t)
        return share * heights.reshape(N, -1).sum(axis=1)

    axes = np.vstack([np.eye(2), -np.eye(2)])
    if end is None:
        walls, ends, far = axes[::2], axes, 0.25
    else:
        angles = np.linspace(0.0, 2.0 * np.pi, end[1], endpoint=False)
        walls, ends, far = axes[:0], np.stack([np.cos(angles), np.sin(angles)], axis=1), end[0]
    marks = np.linspace(0.0, T, N * parts + 1)
    rows, limits, dearer = [], [], []
    for p in (-0.05, 0.05):
        for q in (-0.2, 0.3):

            def rate(t: float, y: np.ndarray, p: float = p, q: float = q) -> np.ndarray:
                X = y.reshape(2, 2 + 2 * N)
                A = np.array([[0, 1], [-1 - 0.3 * np.sin(t), -0.2]])
                drive, piece = np.zeros((2, 2 + 2 * N)), min(int(t / T * N), N - 1)
                drive[1, 0] = 0.1 * q * np.cos(2 * t)
                drive[1, 2 + piece] = (1 + p) * (1 + 0.1 * np.cos(t))
                drive[1, 2 + N + piece] = 1 + q
                return (A @ X + drive).ravel()

            state = np.zeros((2, 2 + 2 * N))
            state[:, 0] = [-0.5, 0.5]
            for i, (start, stop) in enumerate(pairwise(marks.tolist())):
                inside = (start + 1e-9 * T, stop - 1e-9 * T)  # a piece is looked up by the time
                state = solve_ivp(rate, inside, state.ravel(), method="DOP853", rtol=1e-11, atol=1e-13).y[:, -1]
                state = state.reshape(2, -1)
                meant = [(normal, 0.7) for normal in walls if stop >= 0.2]
                for normal, limit in meant + [(normal, far) for normal in ends if i == marks.size - 2]:
                    one = normal @ state
                    rows.append(one[2 : 2 + N])
                    dearer.append(missing(stop, normal, 1 + p))
                    limits.append(limit - one[0] - 0.02 * np.abs(one[2 + N :]).sum())
    G, more = np.array(rows), np.array(dearer)
    found = linprog(np.ones(2 * N) * T / N, np.hstack([G + more, more - G]), limits, bounds=(0, 1.5))
    assert found.success
    return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize(("share", "off"), [(0.0, 1e-6), (0.05, 2e-5)])  # by the rule of midpoints where signs change
def test_a_plant_with_an_uncertain_gain_and_drift_costs_what_a_program_at_the_corners_does(
    share: float, off: float, tmp_path: Path
) -> None:
    config = copy.deepcopy(BASE)
    config["problem"]["execution"] = [share]
    outcome = solved(config, tmp_path / "run")
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(at_the_corners(share), rel=off)


RETURNING: Config = {
    "name": "linear",
    "system": {
        "A": [["-0.5 - 0.2*sin(2*pi*t)"]],
        "B": [["(1 + p) * (1 + 0.3*cos(2*pi*t))"]],
        "E": [["1 + q"]],
        "c": ["0.6 + q * sin(2*pi*t)"],
        "parameters": {"p": [-0.1, 0.05], "q": [-0.2, 0.1]},
    },
    "horizon": 1.0,
    "initial_state": {"centre": [0.5], "box": [0.2]},
    "control": {"box": 1.0},
    "disturbance": {"box": [0.03]},
    "path": [{"box": [0.75]}],
    "repeat": True,
}


class Scalar:
    """The plant of `RETURNING` by quadrature: what each of ``N`` pieces makes of the state at its times."""

    N, fine = 5, 400

    def __init__(self) -> None:
        self.times = np.linspace(0.0, 1.0, self.N * self.fine + 1)
        self.middles = (self.times[:-1] + self.times[1:]) / 2

    def decay(self, t: np.ndarray) -> np.ndarray:
        """The integral of ``A`` until a time."""
        return -0.5 * t - 0.2 * (1 - np.cos(2 * np.pi * t)) / (2 * np.pi)

    def made(self, t: float, rate: np.ndarray) -> np.ndarray:
        """By each piece, of an input that enters by ``rate`` in the middles of all fine parts; midpoints are exact to
        1e-7."""
        heights = np.exp(self.decay(np.array(t)) - self.decay(self.middles)) * rate * (self.middles < t)
        return (heights / (self.N * self.fine)).reshape(self.N, -1).sum(axis=1)

    def least(self, share: float) -> float:
        """The least cost of a plan that returns, by a linear program at the corners."""
        rows, limits = [], []
        ends = self.times[::10].tolist()
        for p in (-0.1, 0.05):
            for q in (-0.2, 0.1):
                for t in ends:
                    gains = self.made(t, (1 + p) * (1 + 0.3 * np.cos(2 * np.pi * self.middles)))
                    noise = 0.03 * np.abs(self.made(t, np.full(self.middles.size, 1 + q))).sum()
                    drift = self.made(t, 0.6 + q * np.sin(2 * np.pi * self.middles)).sum()
                    begun = float(np.exp(self.decay(np.array(t))))
                    walls = [(0.75, 0.0)] + [(0.2, 0.5)] * (t == 1.0)
                    for wall, centre in walls:
                        for sign in (1.0, -1.0):
                            rows.append(np.append(sign * gains + share * gains, -sign * gains + share * gains))
                            limits.append(wall - noise - begun * 0.2 - sign * (begun * 0.5 + drift - centre))
        found = linprog(np.full(2 * self.N, 1 / self.N), np.array(rows), limits, bounds=(0, 1.0))
        assert found.success
        return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.04])
def test_a_plan_that_repeats_under_parameters_costs_what_a_program_at_the_corners_does(
    share: float, tmp_path: Path
) -> None:
    problem = {**copy.deepcopy(RETURNING), "execution": [share]}
    pieces = {"control": {"name": "piecewise_constant", "pieces": Scalar.N}}
    outcome = solved({"problem": problem, "dictionaries": pieces, "observers": []}, tmp_path / "run")
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(Scalar().least(share), rel=1e-5)
    control, rng, highest = outcome.result.control.values.ravel(), np.random.default_rng(30), 0.0
    plant = Scalar()
    for _ in range(20):
        p, q = rng.choice([-0.1, 0.05]), rng.uniform(-0.2, 0.1)
        state = 0.5 + 0.2 * rng.choice([-1.0, 1.0])
        for _ in range(5):
            errors = share * rng.choice([-1.0, 1.0], plant.middles.size)
            given = (
                np.repeat(control, plant.fine) * (1 + errors) * (1 + p) * (1 + 0.3 * np.cos(2 * np.pi * plant.middles))
            )
            noise = np.repeat(rng.choice([-0.03, 0.03], plant.N), plant.fine) * (1 + q)
            rate = given + noise + 0.6 + q * np.sin(2 * np.pi * plant.middles)
            grown = np.cumsum(np.exp(-plant.decay(plant.middles)) * rate) / plant.middles.size
            path = np.exp(plant.decay(plant.times[1:])) * (state + grown)
            highest, state = max(highest, float(path.max())), float(path[-1])
            assert abs(state - 0.5) <= 0.2 + 1e-6
    assert highest <= 0.75 + 1e-6


@pytest.mark.slow
def test_a_round_end_costs_what_a_program_at_the_corners_and_many_directions_does(tmp_path: Path) -> None:
    """Half-spaces around a disc that are 1/400 of a turn apart reach 3e-5 of its radius beyond it."""
    config = copy.deepcopy(BASE)
    config["problem"].update(path=[], terminal=[{"ellipsoid": {"shape": [[0.04, 0], [0, 0.04]]}}])
    outcome = solved(config, tmp_path / "run")
    assert outcome.result.status == "certified"
    least = [at_the_corners(end=(0.2, count)) for count in (200, 400)]
    assert least[1] <= outcome.result.cost * (1 + 1e-9)
    assert outcome.result.cost == pytest.approx(least[1], rel=2e-4)
    assert outcome.result.cost - least[1] < 0.5 * (outcome.result.cost - least[0]) + 1e-9
    certificate = tmp_path / "run" / "certificate.json"
    honest = json.loads(certificate.read_text())
    assert {"terminal[0]", "terminal[3]"} <= honest["proof"].keys()  # one for every corner
    forged = copy.deepcopy(honest)
    forged["proof"]["terminal[1]"]["normals"][0][2] *= 1.0 + 2.0**-40
    certificate.write_text(json.dumps(forged))
    assert {one.name: one.verdict for one in check(tmp_path / "run").claims}["terminal[1]"] == "fails"
    forged = copy.deepcopy(honest)
    forged["proof"]["terminal[1]"] = forged["proof"]["terminal[2]"]
    certificate.write_text(json.dumps(forged))
    assert {one.name: one.verdict for one in check(tmp_path / "run").claims}["terminal[1]"] == "fails"


@pytest.mark.slow
@pytest.mark.parametrize(
    "added",
    [
        {"path": [{"norm": {"p": 3, "radius": 0.72}, "from": 0.2, "relative_to": [[0, 0.02, 0], [5, -0.02, 0.01]]}]},
        {"terminal": [], "path": [], "repeat": True},
    ],
    ids=["a moving wall", "a plan that returns"],
)
def test_round_sets_hold_at_parameters_of_an_integrator(added: Config, tmp_path: Path) -> None:
    config = copy.deepcopy(BASE)
    problem = config["problem"]
    entries = json.dumps(problem["system"]).replace("sin(t)", "sin(0.4*pi*t)").replace("cos(t)", "cos(0.4*pi*t)")
    problem["system"] = json.loads(entries.replace("cos(2*t)", "cos(0.4*pi*t)").replace("-0.2]", "-0.6]"))
    problem.update(copy.deepcopy(added))
    if "repeat" in added:
        problem["initial_state"] = {"centre": [0.0, 0.0], "ellipsoid": {"shape": [[0.04, 0], [0, 0.05]]}}
        problem["system"]["c"][1] = "0.1 + " + problem["system"]["c"][1]
    outcome = solved(config, tmp_path / "run")
    assert outcome.result.status == "certified"
    control, rng, times = outcome.result.control, np.random.default_rng(31), np.linspace(0.0, 5.0, 401)
    for _ in range(12):
        p, q = rng.choice([-0.05, 0.05]), rng.choice([-0.2, 0.3])
        noise, turned = rng.choice([-0.02, 0.02], 10), rng.uniform(0.0, 2 * np.pi)
        start = np.array([-0.5, 0.5])
        if "repeat" in added:
            start = np.array([0.2 * np.cos(turned), np.sqrt(0.05) * np.sin(turned)])
        drift = 0.1 if "repeat" in added else 0.0

        def rate(t: float, x: np.ndarray, p: float = p, q: float = q, noise=noise, drift: float = drift) -> list[float]:
            turn, piece = 0.4 * np.pi * t, min(int(2 * t), 9)
            given = (1 + p) * (1 + 0.1 * np.cos(turn)) * control.values[0, piece] + (1 + q) * noise[piece]
            return [x[1], (-1 - 0.3 * np.sin(turn)) * x[0] - 0.6 * x[1] + given + drift + 0.1 * q * np.cos(turn)]

        path = solve_ivp(rate, (0.0, 5.0), start, t_eval=times, rtol=1e-9, atol=1e-11, max_step=0.05).y
        if "repeat" in added:
            assert path[0, -1] ** 2 / 0.04 + path[1, -1] ** 2 / 0.05 <= 1.0 + 1e-6
            continue
        moved = path - np.array([0.02 - 0.008 * times, 0.002 * times])
        assert (np.abs(moved[:, times >= 0.2]) ** 3).sum(axis=0).max() ** (1 / 3) <= 0.72 + 1e-6


@pytest.mark.slow
def test_a_final_value_that_no_parameter_reaches_may_be_fixed(tmp_path: Path) -> None:
    """A state beside those of `BASE`, ``x3' = u2 - t x3 / 5`` from 3: what a channel gives counts most at the end."""
    config = beside(
        A=[[0, 1, 0], ["-1 - 0.3*sin(t)", -0.2, 0], [0, 0, "-t / 5"]],
        B=[[0, 0], ["(1 + p) * (1 + 0.1*cos(t))", 0], [0, 1]],
        E=[[0], ["1 + q"], [0]],
        c=[0, "0.1 * q * cos(2*t)", 0],
    )
    known = config["problem"]
    known.update(initial_state=[-0.5, 0.5, 3.0], control={"box": 0.4}, path=[{"box": [0.7, None, None], "from": 0.2}])
    known["terminal"] = [{"box": [0.25, 0.25, None]}, {"equals": [None, None, 0.0]}]
    outcome = solved(config, tmp_path / "run")
    plain = copy.deepcopy(BASE)
    plain["problem"]["control"] = {"box": 0.4}
    needed, cost = 3.0 * np.exp(-2.5), 0.0
    for k in range(10, 0, -1):
        fine = np.linspace(k / 2 - 0.5, k / 2, 2001)
        gain = float(np.trapezoid(np.exp(-(25 - fine**2) / 10), fine))
        share = min(0.4, needed / gain)
        needed, cost = needed - share * gain, cost + share / 2
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(solved(plain, tmp_path / "plain").result.cost + cost, rel=1e-6)


PLAIN: Config = {
    "A": [[0, 1], [-1, -0.4]],
    "B": [["0.2 + p", 0], [0, "1 - 0.5*p"]],
    "E": [[1, 0], [0, "1 + q"]],
    "c": [0, "0.05 + q"],
    "parameters": {"p": [-0.03, 0.05], "q": [-0.02, 0.03]},
}
ADDED: dict[str, Config] = {
    "nothing": {},
    "moving set": {
        "path": [{"box": [0.8, None], "from": 0.3, "relative_to": [[0, -0.2, 0], [3, 0.1, 0]]}],
    },
    "mixed": {"path": [{"mixed": {"H": [[0, 1]], "G": [[0.2, 0.5]], "h": [0.9]}, "from": 0.5}]},
    "initial set": {"initial_state": {"centre": [-0.5, 0.5], "box": [0.02, 0.02]}},
    "integral": {
        "integral": [{"H": [[1, 0]], "G": [[0, 0.1]], "from": 0, "to": 2.5, "lower": [-0.05], "upper": [0.3]}]
    },
    "quadratic cost": {"cost": {"l1": 1.0, "control": {"R": [[0.1, 0], [0, 0.1]]}, "state": {"Q": [[0.1, 0], [0, 0]]}}},
    "list of disturbances": {
        "disturbance": [{"set": {"box": 0.03}, "E": [[1], [0]]}, {"set": {"box": 0.02}, "E": [[0], [1]], "pieces": 3}]
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("added", ADDED)
def test_entries_that_do_not_change_cost_what_the_system_without_the_time_does(added: str, tmp_path: Path) -> None:
    config = copy.deepcopy(BASE)
    problem = config["problem"]
    problem.update(horizon=3.0, control={"box": 1.0}, disturbance={"box": [0.03, 0.03]}, system=copy.deepcopy(PLAIN))
    problem.update(path=[{"box": [0.6, None], "from": 0.2}])
    problem.update(copy.deepcopy(ADDED[added]))
    config["dictionaries"] = {"control": {"name": "piecewise_constant", "pieces": 6}}
    plain = sr.run(config, out=tmp_path / "plain", quiet=True, figures=False)
    dressed = copy.deepcopy(config)
    dressed["problem"]["system"]["A"][1][1] = "-0.4 + 0*t"
    ours = solved(dressed, tmp_path / "dressed")
    assert ours.result.status == plain.result.status == "certified"
    assert ours.result.cost == pytest.approx(plain.result.cost, rel=1e-6)


@pytest.mark.slow
def test_parameters_of_which_one_value_is_possible_are_that_value(tmp_path: Path) -> None:
    known = beside(B=[[0], ["exp(p) * (1 + 0.1*cos(t))"]], parameters={"p": [0.1, 0.1], "q": [0.05, 0.05]})
    known["problem"]["initial_state"] = {"centre": [-0.5, 0.5], "box": [0.02, 0.02]}
    plain = copy.deepcopy(known)
    system = plain["problem"]["system"]
    system.update(B=[[0], ["exp(0.1) * (1 + 0.1*cos(t))"]], E=[[0], [1.05]], c=[0, "0.005 * cos(2*t)"])
    del system["parameters"]
    costs = [solved(one, tmp_path / name).result.cost for name, one in (("known", known), ("plain", plain))]
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)


@pytest.mark.slow
def test_a_parameter_of_a_that_multiplies_what_depends_on_none_is_proven(tmp_path: Path) -> None:
    """``x2`` is a known motion of its own; ``x1' = (1 + p) x2 + u``."""
    config = beside(
        A=[["-0.1*t", "1 + p"], [0, "-0.2*cos(t)"]], B=[[1], [0]], E=[[1], [0]], c=None, parameters={"p": [-0.2, 0.2]}
    )
    config["problem"].update(initial_state=[-0.5, 0.3], path=[], terminal=[{"box": [0.2, None]}])
    assert solved(config, tmp_path / "run").result.status == "certified"


@pytest.mark.slow
def test_a_certificate_whose_decision_serves_the_middle_alone_is_refuted(tmp_path: Path) -> None:
    known = beside(parameters={"p": [0.0, 0.0], "q": [0.05, 0.05]})
    sr.run(BASE, out=tmp_path / "run", quiet=True, figures=False)
    sr.run(known, out=tmp_path / "known", quiet=True, figures=False)
    theirs = json.loads((tmp_path / "known" / "certificate.json").read_text())
    mine = tmp_path / "run" / "certificate.json"
    mine.write_text(json.dumps({**json.loads(mine.read_text()), "decision": theirs["decision"]}))
    assert {one.name: one.verdict for one in check(tmp_path / "run").claims}["terminal"] == "fails"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("finished") / "run"
    solved(BASE, out)
    return out


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.system(parameters={"p": [-0.0501, 0.05], "q": [-0.2, 0.3]}),
        tampering.system(parameters={"p": [-0.05, 0.05], "q": [-0.2, 0.3001]}),
        tampering.system(B=[[0], ["(1 + 1.001*p) * (1 + 0.1*cos(t))"]]),
        tampering.system(c=[0, "0.1001 * q * cos(2*t)"]),
    ],
    ids=["a longer interval", "another longer interval", "a slope", "a drift"],
)
def test_parameters_that_are_changed_afterwards_are_found(
    change: tampering.Change, finished: Path, tmp_path: Path
) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


def test_nothing_is_said_against_a_proof_beside_measurable_disturbances() -> None:
    problem = assemble(load_config(beside(), {"problem.disturbance_class": "measurable"})).problem
    assert isinstance(problem, sr.OptimalControlProblem)
    assert unprovable(problem) is None


@pytest.mark.parametrize(
    ("system", "key"),
    [
        ({"A": [[0, 1], ["-1 + log(p*t)", -0.2]]}, "A is not finite at t = .*, p = 0, q = "),
        ({"B": [[0], ["1 + (p*q)^0.5*t"]]}, r"system: .*0\.5\*t, which .*near t = .*, p = .*, q = "),
        ({"c": ["1 / (t + 60*q - 2*p + 0.3)", 0]}, r"system: .*0\.3\), which .*near t = .*, p = .*, q = "),
        ({"parameters": {"names": ["p", "q"], "norm": {"p": 2, "radius": 0.1}}}, r"system\.parameters"),
    ],
)
def test_entries_with_a_pole_among_the_parameters_and_other_sets_of_them_are_refused(system: Config, key: str) -> None:
    with pytest.raises(sr.InputError, match=key):
        assemble(load_config(beside(**system)))


@pytest.mark.parametrize(
    ("problem", "said"),
    [
        ({"terminal": [{"equals": [None, 0.1]}]}, r"terminal\.0: .*no parameter reaches.*got x2, which p reaches"),
        ({"repeat": True, "horizon": 2 * np.pi}, r"repeat: .*no parameter reaches.*got x1, which p reaches"),
    ],
)
def test_a_final_value_that_a_parameter_reaches_is_not_fixed(problem: Config, said: str) -> None:
    config = beside()
    config["problem"].update(problem)
    with pytest.raises(sr.InputError, match=said):
        assemble(load_config(config))


@pytest.mark.slow
@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_a_plant_whose_parameters_and_integrals_nothing_couples_is_certified_in_any_unit(
    size: float, tmp_path: Path
) -> None:
    """The integral of the control and what a parameter adds stand beside states that are a million times smaller."""
    costs = []
    for s in (1.0, size):
        system = {
            "A": [[0, 1], ["-1 - 0.3 * sin(t)", -0.2]],
            "B": [[0], [f"{s!r} * exp(-t / 20) * (1 + gain)"]],
            "c": [0, f"{s!r} * drift * cos(t)"],
            "parameters": {"gain": [-0.05, 0.05], "drift": [-0.02, 0.02]},
        }
        stated = {
            "problem": {
                "name": "linear",
                "system": system,
                "horizon": 8.0,
                "initial_state": [s, 0],
                "control": {"box": 1.0},
                "path": [{"box": [1.3 * s, 3.0 * s]}],
                "integral": [{"G": [[1]], "from": 0, "to": 4, "upper": 1.0, "lower": -3.0}],
                "terminal": [{"box": [0.2 * s, 0.25 * s]}],
            },
            "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 12}},
            "observers": [],
        }
        result = sr.run(stated, out=tmp_path / f"{s:g}", quiet=True, figures=False).result
        assert result.status == "certified"
        costs.append(result.upper_bound)
    assert costs[1] == pytest.approx(costs[0], rel=1e-6)
