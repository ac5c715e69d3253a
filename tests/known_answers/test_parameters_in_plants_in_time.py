"""Guards parameters beside the time that the state does not depend on affinely: costs by closed forms and by systems
that do not change with time, trajectories of an integrator, each checked."""

from __future__ import annotations

import copy
from collections.abc import Callable
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.flow import flows
from sparserob_core.control.reach.over_cells import FunctionalsOverCells
from sparserob_core.control.studies.initial_states import InitialPlane
from sparserob_core.control.transcription.rounding import reduce_bound
from sparserob_core.experiment.assemble import assemble
from sparserob_core.experiment.check.check import check
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.expressions.expression import kepler
from tests.support import tampering

Config = dict[str, Any]

DECAY: Config = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [["-0.5 - p*sin(2*t)"]],
            "B": [["1 + p^2"]],
            "E": [[1]],
            "parameters": {"p": [-0.3, 0.6]},
        },
        "horizon": 3.0,
        "initial_state": [1.0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.02]},
        "path": [{"box": [0.45], "from": 1.2}],
        "terminal": [{"box": [0.1]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
    "observers": [],
}


def solved(config: Config, directory: Path) -> sr.Outcome:
    outcome = sr.run(config, out=directory, quiet=True, figures=False)
    assert check(directory).status == "verified"
    return outcome


def in_units(config: Config, time: float, length: float, unit: float) -> Config:
    """The same problem of one state with its time, its state and its parameter in other units."""
    made = copy.deepcopy(config)
    problem = made["problem"]
    t, p = f"(t / {time!r})", f"(p / {unit!r})"
    system = problem["system"]
    system["A"] = [[f"(-0.5 - {p}*sin(2*{t})) / {time!r}"]]
    system["B"], system["E"] = [[f"(1 + {p}^2) * {length / time!r}"]], [[f"{length / time!r}"]]
    system["parameters"] = {"p": [-0.3 * unit, 0.6 * unit]}
    problem.update(horizon=3.0 * time, initial_state=[length])
    problem["path"], problem["terminal"] = [{"box": [0.45 * length], "from": 1.2 * time}], [{"box": [0.1 * length]}]
    return made


INSIDE: Config = copy.deepcopy(DECAY)  # whose worst parameter lies inside the box
INSIDE["problem"] = {
    "name": "linear",
    "system": {
        "A": [["0.3 - 2*p^2 + 0.2*sin(t)"]],
        "B": [["1 + p"]],
        "E": [[1]],
        "parameters": {"p": [-0.3, 0.4]},
    },
    "horizon": 2.0,
    "initial_state": [0.5],
    "control": {"box": 1.5},
    "disturbance": {"box": [0.01]},
    "path": [{"box": [1.0]}],
    "terminal": [{"box": [0.35]}],
}
INSIDE["dictionaries"]["control"]["pieces"] = 5
TWO: Config = copy.deepcopy(DECAY)  # parameters in A
TWO["problem"]["system"] = {
    "A": [["-0.5 - p*sin(2*t) - q*t + p*q"]],
    "B": [["1 + p^2"]],
    "E": [[1]],
    "parameters": {"p": [-0.05, 0.08], "q": [-0.02, 0.02]},
}
TWO["problem"]["path"], TWO["problem"]["terminal"] = [{"box": [0.45], "from": 1.2}], [{"box": [0.15]}]
THREE: Config = copy.deepcopy(TWO)  # far beyond what one expansion of the state holds
THREE["problem"]["system"] = {
    "A": [["-0.5 - p*sin(2*t) - q*t + r"]],
    "B": [["1 + p*r"]],
    "E": [[1]],
    "parameters": {"p": [-0.2, 0.3], "q": [-0.1, 0.1], "r": [-0.15, 0.15]},
}
THREE["problem"].update(path=[{"box": [1.3]}], terminal=[{"box": [0.3]}])
FRACTIONS: Config = copy.deepcopy(THREE)  # a pole at some six times the half of an interval
FRACTIONS["problem"]["system"] = {
    "A": [["-0.5/(1 + p) - q*t + r"]],
    "B": [["1"]],
    "E": [[1]],
    "parameters": {"p": [-0.15, 0.15], "q": [-0.1, 0.1], "r": [-0.1, 0.1]},
}
"""A state at one parameter is ``x(t) = int exp(a(t) - a(s)) (...) ds``: what of that each of the two has."""
CLOSED: dict[str, tuple[Callable[..., np.ndarray], Callable[..., float]]] = {
    "decay": (lambda t, p: -t / 2 - p * (1 - np.cos(2 * t)) / 2, lambda p: 1 + p * p),
    "inside": (lambda t, p: 0.3 * t - 2 * p * p * t + 0.2 * (1 - np.cos(t)), lambda p: 1 + p),
    "two": (
        lambda t, p, q: -t / 2 - p * (1 - np.cos(2 * t)) / 2 - q * t**2 / 2 + p * q * t,
        lambda p, q: 1 + p * p,
    ),
    "three": (
        lambda t, p, q, r: -t / 2 - p * (1 - np.cos(2 * t)) / 2 - q * t**2 / 2 + r * t,
        lambda p, q, r: 1 + p * r,
    ),
    "fractions": (lambda t, p, q, r: -t / 2 / (1 + p) - q * t**2 / 2 + r * t, lambda p, q, r: 1.0),
}


def least(config: Config, closed: str, places: int = 61) -> float:
    """The least cost of a plant of one state, at many times and ``places`` of the parameter: a bound from below that
    misses little."""
    problem, (rate, gain) = config["problem"], CLOSED[closed]
    horizon, N, fine = problem["horizon"], config["dictionaries"]["control"]["pieces"], 400
    (most,), (held,), noise = problem["path"], problem["terminal"], problem["disturbance"]["box"][0]
    marks = np.linspace(0.0, horizon, N * fine + 1)
    middles, width = (marks[:-1] + marks[1:]) / 2, horizon / (N * fine)
    rows, limits = [], []
    intervals = problem["system"]["parameters"].values()
    for at in product(*(np.linspace(*ends, places).tolist() for ends in intervals)):
        a, inside = (rate(one, *at) for one in (marks, middles))
        for k, t in enumerate(marks.tolist()):
            if t < most.get("from", 0.0) - 1e-9 or (k % 10 and k < marks.size - 1):
                continue
            gains = (np.exp(a[k] - inside) * (middles < t) * width).reshape(N, -1).sum(axis=1)
            limit = (held if k == marks.size - 1 else most)["box"][0]
            begun = problem["initial_state"][0] * float(np.exp(a[k]))
            for sign in (1.0, -1.0):
                rows.append(sign * gain(*at) * gains)
                limits.append(limit - noise * gains.sum() - sign * begun)
    G = np.array(rows)
    bound = problem["control"]["box"]
    found = linprog(np.full(2 * N, horizon / N), np.hstack([G, -G]), limits, bounds=(0, bound))
    assert found.success
    return float(found.fun)


@pytest.mark.slow
@pytest.mark.parametrize("units", [None, (3600.0, 1e-3, 50.0)])
def test_a_decay_at_an_uncertain_rate_costs_what_its_closed_form_says(
    units: tuple[float, float, float] | None, tmp_path: Path
) -> None:
    config, time = (DECAY, 1.0) if units is None else (in_units(DECAY, *units), units[0])
    outcome = solved(config, tmp_path / "run")
    assert outcome.result.status == "certified"
    found = least(DECAY, "decay")  # by the rule of midpoints, and between rows
    assert outcome.result.cost / time == pytest.approx(found, rel=2e-5)


@pytest.mark.slow
def test_a_parameter_that_is_worst_inside_its_interval_is_found(tmp_path: Path) -> None:
    outcome = solved(INSIDE, tmp_path / "run")
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(least(INSIDE, "inside"), rel=1e-4)
    assert least(INSIDE, "inside", 2) < 0.999 * outcome.result.cost  # than at the ends of its interval


@pytest.mark.slow
def test_two_parameters_in_the_plant_cost_what_their_closed_form_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(flows, "CLOSE", 0.0)  # and for the checker no box serves those in it
    outcome = solved(TWO, tmp_path / "run")
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(least(TWO, "two", 5), rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["three", "fractions"])
def test_three_parameters_that_move_the_state_far_cost_what_their_closed_form_says(name: str, tmp_path: Path) -> None:
    config = THREE if name == "three" else FRACTIONS
    outcome = solved(config, tmp_path / "run")
    assert outcome.result.status == "certified"
    assert outcome.result.cost == pytest.approx(least(config, name, 5), rel=1e-3)


SPRING: Config = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [[0, 1], ["-1 + p", -0.4]],
            "B": [[0.2, 0], [0, "1 + p"]],
            "E": [[1, 0], [0, "1 + p/2"]],
            "c": [0, "0.05 + p - p^2"],
            "parameters": {"p": [-0.05, 0.08]},
        },
        "horizon": 3.0,
        "initial_state": [-0.5, 0.5],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.03, 0.03]},
        "path": [{"box": [0.6, None], "from": 0.2}],
        "terminal": [{"box": [0.25, 0.25]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
    "observers": [],
}
ADDED: dict[str, Config] = {
    "initial set and integral": {
        "initial_state": {"centre": [-0.5, 0.5], "box": [0.02, 0.02]},
        "integral": [{"H": [[1, 0]], "G": [[0, 0.1]], "from": 0, "to": 2.5, "lower": [-0.3], "upper": [0.5]}],
    },
    "curved, moving and mixed": {
        "path": [
            {"ellipsoid": {"centre": [0, 0], "shape": [[0.5, 0], [0, 0.6]]}, "from": 0.5},
            {"box": [0.8, None], "from": 0.3, "relative_to": [[0, -0.2, 0], [3, 0.1, 0]]},
            {"mixed": {"H": [[0, 1]], "G": [[0.2, 0.5]], "h": [0.9]}, "from": 0.5},
        ]
    },
    "quadratic cost and a list": {
        "cost": {"l1": 1.0, "control": {"R": [[0.1, 0], [0, 0.1]]}, "state": {"Q": [[0.1, 0], [0, 0]]}},
        "disturbance": [{"set": {"box": 0.03}, "E": [[1], [0]]}, {"set": {"box": 0.02}, "E": [[0], [1]], "pieces": 3}],
    },
}


@pytest.mark.slow
def test_a_plan_is_solved_anew_as_that_of_a_system_that_does_not_change() -> None:
    used = []
    for entry in ("-0.5 + p", "-0.5 + p + 0*t"):
        config = copy.deepcopy(DECAY)
        config["problem"]["system"].update(A=[[entry]], parameters={"p": [-0.1, 0.2]})
        controller = sr.controller(config, resolve=True)
        state, spent, p = 1.0, 0.0, 0.15  # which the controller is not told
        for begin, end in pairwise(controller.breakpoints):
            (u,), length = controller.step(begin, [state]), end - begin
            a, pushed = -0.5 + p, (1 + p * p) * u + 0.02 * np.sin(7 * begin)
            state = float(np.exp(a * length) * state + np.expm1(a * length) / a * pushed)
            spent += abs(float(u)) * length
            assert begin + length < 1.2 or abs(state) <= 0.45
        assert abs(state) <= 0.1 and controller.covered and any(one.resolved for one in controller.steps)
        used.append(spent)
    assert used[1] == pytest.approx(used[0], rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("added", ADDED)
def test_entries_that_do_not_change_cost_what_the_system_without_the_time_does(added: str, tmp_path: Path) -> None:
    config = copy.deepcopy(SPRING)
    config["problem"].update(copy.deepcopy(ADDED[added]))
    plain = sr.run(config, out=tmp_path / "plain", quiet=True, figures=False)
    dressed = copy.deepcopy(config)
    dressed["problem"]["system"]["A"][1][1] = "-0.4 + 0*t"
    ours = solved(dressed, tmp_path / "dressed")
    assert ours.result.status == plain.result.status == "certified"
    assert ours.result.cost == pytest.approx(plain.result.cost, rel=1e-6)


MATHIEU: Config = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [[0, 1], ["-(1 + p) - (0.4 + p^2)*cos(2*t)", "-0.1 - 0.2*p"]],
            "B": [[0], ["1 / (1 - t/20)"]],
            "E": [[0], [1]],
            "parameters": {"p": [-0.1, 0.15]},
            "delay": 0.3,
        },
        "horizon": 5.0,
        "initial_state": {"centre": [-0.4, 0.5], "box": [0.02, 0.02]},
        "control": {"box": 1.5},
        "disturbance": {"box": [0.02]},
        "path": [{"box": [0.7, None], "from": 0.2}],
        "terminal": [{"box": [0.25, 0.3]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
    "observers": [],
}


@pytest.fixture(scope="module")
def mathieu(tmp_path_factory: pytest.TempPathFactory) -> tuple[sr.Outcome, Path]:
    out = tmp_path_factory.mktemp("mathieu") / "run"
    outcome = solved(MATHIEU, out)
    assert outcome.result.status == "certified"
    return outcome, out


@pytest.mark.slow
def test_mathieus_equation_with_an_uncertain_stiffness_stays_inside(mathieu: tuple[sr.Outcome, Path]) -> None:
    values, rng, closest = mathieu[0].result.control.values[0], np.random.default_rng(30), np.inf
    for _ in range(12):
        p, noise = rng.choice([-0.1, 0.15, rng.uniform(-0.1, 0.15)]), rng.choice([-0.02, 0.02], 10)
        state = np.array([-0.4, 0.5]) + 0.02 * rng.choice([-1.0, 1.0], 2)
        marks = sorted({*np.linspace(0.0, 5.0, 11).tolist(), *(np.linspace(0.0, 4.5, 10) + 0.3).tolist()})
        for begin, until in pairwise(marks):
            middle = (begin + until) / 2
            given = 0.0 if middle < 0.3 else values[int((middle - 0.3) * 2)]

            def rate(t: float, x: np.ndarray, p=p, u=given, w=noise[int(2 * middle)]) -> list[float]:
                spring = -(1 + p) - (0.4 + p**2) * np.cos(2 * t)
                return [x[1], spring * x[0] - (0.1 + 0.2 * p) * x[1] + u / (1 - t / 20) + w]

            times = np.linspace(begin, until, 9)
            path = solve_ivp(rate, (begin, until), state, t_eval=times, rtol=1e-10, atol=1e-12).y
            state = path[:, -1]
            inside = np.abs(path[0, times >= 0.2])
            assert inside.max(initial=0.0) <= 0.7 + 1e-8
        assert abs(state[0]) <= 0.25 + 1e-8
        assert abs(state[1]) <= 0.3 + 1e-8
        closest = min(closest, 0.25 - abs(state[0]), 0.3 - abs(state[1]))
    assert closest < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.system(parameters={"p": [-0.101, 0.15]}),
        tampering.system(parameters={"p": [-0.1, 0.151]}),
        tampering.system(A=[[0, 1], ["-(1 + p) - (0.4 + 2*p^2)*cos(2*t)", "-0.1 - 0.2*p"]]),
    ],
    ids=["a lower end", "an upper end", "a square"],
)
def test_parameters_that_are_changed_afterwards_are_found(
    change: tampering.Change, mathieu: tuple[sr.Outcome, Path], tmp_path: Path
) -> None:
    assert check(tampering.forged(mathieu[1], tmp_path / "copy", change, consistent=True)).status == "refuted"


RELAXING: Config = {
    "problem": {
        "name": "linear",
        "system": {
            "A": [["-exp(-p*t)"]],
            "B": [["sqrt(1 + p*cos(t))"]],
            "E": [["1/(1 + p)"]],
            "c": ["0.1*kepler(t/2 + p, 0.1)/(1 + t)"],
            "parameters": {"p": [0.2, 0.3]},
        },
        "horizon": 2.0,
        "initial_state": [1.0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.02]},
        "path": [{"box": [0.4], "from": 1.0}],
        "terminal": [{"box": [0.1]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
    "observers": [],
}


def relaxing_in_units(time: float, length: float, unit: float) -> Config:
    """`RELAXING` with its time, its state and its parameter in other units."""
    made = copy.deepcopy(RELAXING)
    problem, (t, p) = made["problem"], (f"(t / {time!r})", f"(p / {unit!r})")
    rate = length / time
    problem["system"] = {
        "A": [[f"-exp(-{p}*{t}) / {time!r}"]],
        "B": [[f"sqrt(1 + {p}*cos({t})) * {rate!r}"]],
        "E": [[f"{rate!r}/(1 + {p})"]],
        "c": [f"{0.1 * rate!r}*kepler({t}/2 + {p}, 0.1)/(1 + {t})"],
        "parameters": {"p": [0.2 * unit, 0.3 * unit]},
    }
    problem.update(horizon=2.0 * time, initial_state=[length])
    problem["path"], problem["terminal"] = [{"box": [0.4 * length], "from": time}], [{"box": [0.1 * length]}]
    return made


@pytest.mark.slow
def test_entries_that_are_any_function_of_the_parameters_are_kept_inside(tmp_path: Path) -> None:
    """In units of a 60th of the time, a thousandth of the state and a 40th of the parameter."""
    outcome = solved(relaxing_in_units(60.0, 1e-3, 40.0), tmp_path / "run")
    assert outcome.result.status == "certified"
    values, rng, closest = outcome.result.control.values[0], np.random.default_rng(31), np.inf
    for p in (0.2, 0.3, *rng.uniform(0.2, 0.3, 8)):
        state, noise = np.array([1.0]), rng.choice([-0.02, 0.02]) * np.ones(4)
        for k in range(4):

            def rate(t: float, x: np.ndarray, p=p, u=values[k], w=noise[k]) -> np.ndarray:
                drift = 0.1 * kepler(t / 2 + p, 0.1) / (1.0 + t)
                return -np.exp(-p * t) * x + np.sqrt(1.0 + p * np.cos(t)) * u + w / (1.0 + p) + drift

            times = np.linspace(k / 2, (k + 1) / 2, 9)
            path = solve_ivp(rate, (k / 2, (k + 1) / 2), state, t_eval=times, rtol=1e-10, atol=1e-12).y
            state = path[:, -1]  # of a control that has no units
            assert np.abs(path[0, times >= 1.0]).max(initial=0.0) <= 0.4 + 1e-8
        assert abs(state[0]) <= 0.1 + 1e-8
        closest = min(closest, 0.1 - abs(state[0]))
    assert closest < 0.02


def changed(**problem: Any) -> Config:
    made = copy.deepcopy(DECAY)
    made["problem"].update(problem)
    return made


def test_what_is_not_built_beside_them_is_refused_by_name() -> None:
    with pytest.raises(sr.InputError, match=r"system\.parameters: .*fixed final values"):
        assemble(load_config(changed(terminal=[{"equals": [0.0]}])))


def test_a_box_over_which_no_expansion_reaches_is_refused() -> None:
    system = {"A": [["-0.5 - p*sin(2*t) + q"]], "B": [[1]], "parameters": {"p": [-3000, 6000], "q": [-1, 1]}}
    with pytest.raises(sr.InputError, match=r"system\.parameters: .*expansion"):
        assemble(load_config(changed(system=system, disturbance=None)))


def farthest() -> float:
    """How far from 0 the rate of `DECAY` may begin, to end within 0.1 after 2: a linear program at many parameters."""
    N, fine = 4, 400
    marks = np.linspace(0.0, 2.0, N * fine + 1)
    middles, rows, limits = (marks[:-1] + marks[1:]) / 2, [], []
    for p in np.linspace(-0.3, 0.6, 2001).tolist():
        a, inside = (-one / 2 - p * (1 - np.cos(2 * one)) / 2 for one in (marks, middles))
        gains = (np.exp(a[-1] - inside) * 2.0 / (N * fine)).reshape(N, -1).sum(axis=1)
        for sign in (1.0, -1.0):
            rows.append([*(sign * (1 + p * p) * gains), sign * np.exp(a[-1])])
            limits.append(0.1 - 0.02 * gains.sum())
    found = linprog([0.0] * N + [-1.0], np.array(rows), limits, bounds=[(-1.0, 1.0)] * N + [(None, None)])
    assert found.success
    return float(found.x[-1])


def of_two() -> Config:
    """`DECAY` until 2 beside a second state that decays at a known rate."""
    config = copy.deepcopy(DECAY)
    config["problem"]["system"].update(A=[[DECAY["problem"]["system"]["A"][0][0], 0], [0, -1]], B=[["1 + p^2"], [0]])
    config["problem"]["system"]["E"] = [[1], [0]]
    config["problem"].update(horizon=2.0, initial_state=[0, 0], path=[], terminal=[{"box": [0.1, 0.3]}])
    config["dictionaries"]["control"]["pieces"] = 4
    return config


@pytest.mark.slow
def test_the_states_that_are_feasible_at_every_rate_are_as_many_as_a_closed_form_says() -> None:
    found = sr.initial_states(of_two(), directions=4, values=0, within=5)
    ends = [farthest(), 0.3 * np.exp(2.0)]
    np.testing.assert_allclose(np.abs(found.outer).max(axis=0), ends, rtol=3e-7)
    np.testing.assert_allclose(np.abs(found.inner).max(axis=0), ends, rtol=3e-6)


@pytest.mark.slow
def test_what_a_law_leaves_out_widens_the_rows_from_which_states_are_feasible() -> None:
    config = of_two()
    config["problem"]["system"]["A"][0][0] = "-0.5/(1 + p) + 0*t"  # no polynomial of p
    model = assemble(load_config(config)).transcription
    plane = InitialPlane(model, (0, 1), np.array([0.5, -0.2]), np.array([1.0, 2.0]))
    for z in ([1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [0.3, 0.2]):
        begun = model.functionals.from_state(plane.point(np.array(z)))
        assert (plane.beyond * (1 + 1e-12) >= begun.over_cells.truncation(np.array([1.0]))).all()
    assert (plane.beyond > 0.0).all()
    (family,) = plane._families
    index = np.array([[2.0, 0.4]])
    with_it = family.rows(index)[1]
    vars(plane)["beyond"] = 0.0 * plane.beyond
    constraint = model.constraint(model.program.families[0])
    directions = constraint.functionals_at(index)[1]
    wider = with_it.ravel() - family.rows(index)[1].ravel()
    vars(plane)["beyond"] = np.ones(2)
    assert (wider <= 1e-9).all()  # the degree is high
    np.testing.assert_allclose((family.rows(index)[1] - with_it).ravel(), np.abs(directions).sum(axis=1), rtol=1e-6)


@pytest.mark.slow
def test_what_a_law_leaves_out_lowers_the_bound_by_as_much_as_its_rows_weigh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = sr.run(INSIDE, out=tmp_path / "run", quiet=True, figures=False)
    model = assemble(load_config(INSIDE)).transcription
    plain = reduce_bound(model, outcome.result, None).lower_bound
    monkeypatch.setattr(FunctionalsOverCells, "truncation", lambda *_: np.full(1, 1e-3))
    weighed = sum(
        abs(cut.multiplier) * float(np.abs(said.direction).sum())
        for cut, said in zip(outcome.result.dual.cuts, model.explained(outcome.result.dual.cuts), strict=True)
    )
    assert weighed > 0.0
    assert plain - reduce_bound(model, outcome.result, None).lower_bound == pytest.approx(1e-3 * weighed)
