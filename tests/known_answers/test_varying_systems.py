"""Guards known answers: known plants that change with time, against closed forms and independent linear programs, and
what is refused of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import ctx
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.control.response.varying.expansion import Expansion
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import pieces, verified
from tests.support import tampering

FADING: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [["-1/(1 + t)"]], "B": [[1]]},
    "horizon": 2.0,
    "initial_state": [2.5],
    "control": {"box": 1.0},
    "terminal": [{"equals": [0]}],
}


def rendezvous(n: float, e: float, M: float, horizon: float, begin: list[float], end: list[float], bound: float) -> Any:
    """Planar motion about a Kepler ellipse of mean motion ``n`` from the mean anomaly ``M`` on."""
    root = float(np.sqrt(1 - e * e))
    define = {
        "E": f"kepler({n!r} * t + {M!r}, {e!r})",
        "q": f"1 - {e!r} * cos(E)",
        "k": f"{n * n!r} / q^3",
        "w": f"{n * root!r} / q^2",
        "dw": f"{-2 * e * n * n * root!r} * sin(E) / q^4",
    }
    A = [[0, 0, 1, 0], [0, 0, 0, 1], ["w^2 - k", "dw", 0, "2*w"], ["-dw", "w^2 + 2*k", "-2*w", 0]]
    return {
        "name": "linear",
        "system": {"A": A, "B": [[0, 0], [0, 0], [1, 0], [0, 1]], "define": define},
        "horizon": horizon,
        "initial_state": begin,
        "control": {"box": bound},
        "terminal": [{"equals": end}],
    }


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the fading plant."""
    directory = tmp_path_factory.mktemp("fading") / "run"
    config = {"problem": FADING, "dictionaries": {"control": pieces(20)}, "observers": []}
    sr.run(config, out=directory, figures=False)
    return directory


def test_a_fading_plant_is_pushed_late(tmp_path: Path) -> None:
    # (1 + t) x' = ... : int (1 + t) u = -x(0), cheapest at the end: J = 1 + T - sqrt((1 + T)^2 - 2 x(0))
    assert verified(tmp_path / "run", FADING, pieces(20))["cost"] == pytest.approx(1.0, rel=1e-9)


def test_a_drift_in_time_is_an_input(tmp_path: Path) -> None:
    # x' = u + t, from 1 to 0 in 2 with u between -4 and 0: int u = -1 - 2
    config = {**FADING, "system": {"A": [[0]], "B": [[1]], "c": ["t"]}, "initial_state": [1], "control": {"box": 4.0}}
    assert verified(tmp_path / "run", config, pieces(8))["cost"] == pytest.approx(3.0, rel=1e-9)


def test_an_unreachable_end_is_proven_to_be_so(tmp_path: Path) -> None:
    # |int (1 + t) u| <= 4 over [0, 2]
    verified_infeasible = {**FADING, "initial_state": [4.1]}
    out = tmp_path / "run"
    sr.run({"problem": verified_infeasible, "dictionaries": {"control": pieces(8)}, "observers": []}, out=out)
    found = check(out)
    assert found.status == "verified"
    assert {claim.name for claim in found.claims} >= {"infeasibility"}


@pytest.mark.slow
def test_the_transfer_of_atv_costs_what_is_listed(tmp_path: Path) -> None:
    n = float(np.sqrt(3.986e14 / 6763e3**3))
    config = rendezvous(n, 0.0052, 0.0, 7200.0, [-30e3, 500.0, 8.514, 0.0], [-100.0, 0.0, 0.0, 0.0], 0.05)
    assert verified(tmp_path / "run", config, pieces(240))["cost"] == pytest.approx(10.920731, rel=1e-7)


@pytest.mark.slow
def test_the_transfer_of_simbol_x_costs_what_is_listed(tmp_path: Path) -> None:
    n, e, nu = float(np.sqrt(3.986e14 / 106246975.3**3)), 0.798788, np.radians(135)
    E = float(2 * np.arctan2(np.sqrt(1 - e) * np.sin(nu / 2), np.sqrt(1 + e) * np.cos(nu / 2)))
    begin, end = [18309.5, -23764.7, -0.0542, -0.0418], [335.12, -371.1, 0.00155, 0.0014]
    config = rendezvous(n, e, E - e * float(np.sin(E)), 49995.0, begin, end, 1e-3)
    assert verified(tmp_path / "run", config, pieces(250))["cost"] == pytest.approx(1.813578, rel=3e-7)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "change",
    [
        tampering.system(A=[["-1.00001/(1 + t)"]]),
        tampering.system(A=[["-1/(1 + 1.00001*t)"]]),
        tampering.system(B=[["1 + 1e-6*t"]]),
        tampering.problem(initial_state=[2.50001]),
    ],
    ids=["A", "A in t", "B", "start"],
)
def test_a_system_that_is_changed_afterwards_is_found(change: tampering.Change, finished: Path, tmp_path: Path) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"system": {"A": [["t + p"]], "B": [[1]], "parameters": {"p": [0, 1]}}},
            r"system\.parameters: expected none beside fixed final values",
        ),
        ({"system": {"A": [["a"]], "B": [[1]], "define": {"a": "b*t", "b": "a"}}}, r"system\.define\.a: .*circle"),
        ({"system": {"A": [["a"]], "B": [[1]], "define": {"a": "q*t"}}}, r"system\.define\.a: .*unknown name 'q'"),
        ({"system": {"A": [["1/(t - 1)"]], "B": [[1]]}}, "A is not finite at t = 1"),
    ],
)
def test_what_is_not_proven_yet_is_refused_by_name(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    config = {"problem": {**FADING, **changes}, "dictionaries": {"control": pieces(8)}, "observers": []}
    with pytest.raises(sr.InputError, match=said):
        sr.run(config, out=tmp_path / "run", figures=False)


def test_definitions_serve_uncertain_systems_too(tmp_path: Path) -> None:
    problem = {
        **FADING,
        "system": {"A": [["-rate"]], "B": [[1]], "define": {"rate": "0.5 + 0.1*p"}, "parameters": {"p": [0, 1]}},
        "terminal": [{"box": 0.5}],
        "control": {"box": 2.0},
    }
    plain = {**problem, "system": {"A": [["-(0.5 + 0.1*p)"]], "B": [[1]], "parameters": {"p": [0, 1]}}}
    costs = [verified(tmp_path / name, one, pieces(8))["cost"] for name, one in (("a", problem), ("b", plain))]
    assert costs[0] == pytest.approx(costs[1], rel=1e-12)


UNCERTAIN: dict[str, Any] = {
    **FADING,
    "disturbance": {"box": 0.1},
    "initial_state": {"centre": [2.5], "box": 0.2},
    "terminal": [{"box": 0.2}],
}


def test_a_fading_plant_ends_in_a_box_whatever_pushes_it(tmp_path: Path) -> None:
    # (1 + t) x is the integral of (1 + t) (u + w): of 2.5 + 0.2 and at most 0.4 by w, all but 3 * 0.2 has to go
    assert verified(tmp_path / "run", UNCERTAIN, pieces(20))["cost"] == pytest.approx(1.0, rel=1e-7)


def dense(window: tuple[float, float], height: float, count: int = 20, samples: int = 4001) -> float:
    """The least cost of the fading plant with ``x <= height`` at many times of a window, for every disturbance and
    initial state of ``UNCERTAIN``: a linear program in closed forms."""
    breaks, t = np.linspace(0.0, 2.0, count + 1), np.linspace(*window, samples)[:, None]
    ends = np.minimum(breaks[1:], np.maximum(t, breaks[:-1]))
    rows = ((1 + ends) ** 2 - (1 + breaks[:-1]) ** 2) / 2 / (1 + t)
    pushed = (2.7 + 0.1 * ((1 + t[:, 0]) ** 2 - 1) / 2) / (1 + t[:, 0])
    found = linprog(
        np.full(2 * count, 2.0 / count), np.hstack([rows, -rows]), height - pushed, bounds=[(0.0, 1.0)] * (2 * count)
    )
    return float(found.fun)


def test_a_fading_plant_stays_below_a_bound_between_the_breakpoints(tmp_path: Path) -> None:
    wall = {"polytope": {"H": [[1]], "h": [0.9]}, "from": 0.93, "to": 1.91}
    config = {**UNCERTAIN, "terminal": [], "path": [wall]}
    found = verified(tmp_path / "run", config, pieces(20))["cost"]
    assert found == pytest.approx(dense((0.93, 1.91), 0.9), rel=2e-6)


@pytest.mark.slow
def test_a_curved_set_of_two_fading_plants_is_the_radius_of_one(tmp_path: Path) -> None:
    # the second state is 0 and stays so
    config = {
        **UNCERTAIN,
        "system": {"A": [["-1/(1 + t)", 0], [0, "-t"]], "B": [[1], [0]], "E": [[1], [0]]},
        "initial_state": {"centre": [2.5, 0], "box": [0.2, 0]},
        "terminal": [{"ellipsoid": {"centre": [0, 0], "shape": [[0.04, 0], [0, 1]]}}],
    }
    assert verified(tmp_path / "run", config, pieces(20))["cost"] == pytest.approx(1.0, rel=1e-7)


def moving(middle: float) -> dict[str, Any]:
    """A wall that turns at ``middle``, where it is felt."""
    return {"polytope": {"H": [[1]], "h": [0.5]}, "from": 0.3, "relative_to": [[0, 2.2], [1.03, middle], [2, 0.4]]}


@pytest.fixture(scope="module")
def uncertain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the fading plant with all that may be uncertain, and a set that moves."""
    directory = tmp_path_factory.mktemp("uncertain") / "run"
    config = {"problem": {**UNCERTAIN, "path": [moving(0.8)]}, "dictionaries": {"control": pieces(20)}, "observers": []}
    sr.run(config, out=directory, figures=False)
    assert check(directory).status == "verified"
    return directory


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        tampering.problem(disturbance={"box": 0.10001}),
        tampering.system(E=[["1 + 1e-5*t"]]),
        tampering.problem(initial_state={"centre": [2.5], "box": 0.20001}),
        tampering.problem(terminal=[{"box": 0.19999}]),
        tampering.problem(path=[moving(0.79999)]),
    ],
    ids=["disturbance", "E", "initial set", "terminal", "path"],
)
def test_an_uncertainty_that_is_changed_afterwards_is_found(
    change: tampering.Change, uncertain: Path, tmp_path: Path
) -> None:
    assert check(tampering.forged(uncertain, tmp_path / "copy", change, consistent=True)).status == "refuted"


def test_a_terminal_box_that_a_disturbance_fills_is_proven_to_be_unreachable(tmp_path: Path) -> None:
    config = {**UNCERTAIN, "terminal": [{"box": 0.19}]}  # the width that 0.2 + 0.4 make of it at the end is 0.2
    sr.run({"problem": config, "dictionaries": {"control": pieces(8)}, "observers": []}, out=tmp_path / "run")
    found = check(tmp_path / "run")
    assert found.status == "verified" and {claim.name for claim in found.claims} >= {"infeasibility"}


def test_quadratic_costs_of_a_fading_plant_are_those_of_a_program_of_its_own(tmp_path: Path) -> None:
    # (1 + t) x = 2.5 + sum_k g_k(t) u_k, whose square is integrated on every piece by Gauss' rule
    count, breaks = 8, np.linspace(0.0, 2.0, 9)
    points, shares = np.polynomial.legendre.leggauss(20)
    t = (breaks[:-1, None] + (1.0 + points) / 8.0).ravel()
    times = np.append(t, 2.0)[:, None]
    rows = ((1 + np.clip(times, breaks[:-1], breaks[1:])) ** 2 - (1 + breaks[:-1]) ** 2) / 2 / (1 + times)
    weights = np.append(0.3 * np.tile(shares, count) / 8.0, 0.7)
    P, off = rows.T @ (weights[:, None] * rows) + np.eye(count) * 0.2 / 4, 2.5 / (1 + times[:, 0]) - 0.1
    u = -np.linalg.solve(P, rows.T @ (weights * off))
    assert np.abs(u).max() < 3.0
    least = float(u @ P @ u + 2 * u @ rows.T @ (weights * off) + weights @ off**2)
    cost = {
        "l1": 0,
        "control": {"R": [[0.2]]},
        "state": {"Q": [[0.3]], "reference": [0.1]},
        "final": {"Q": [[0.7]], "reference": [0.1]},
    }
    config = {**FADING, "terminal": [], "control": {"box": 3.0}, "cost": cost, "path": [{"box": 9.0}]}
    assert verified(tmp_path / "run", config, pieces(count))["cost"] == pytest.approx(least, rel=1e-7)


def area(ends: np.ndarray, until: float) -> np.ndarray:
    """An antiderivative of ``(1 + s) (log(1 + until) - log(1 + s))``: what a push at ``s`` adds to the integral of the
    fading plant."""
    y = 1.0 + ends
    return np.asarray(y**2 / 2 * (np.log1p(until) - np.log(y)) + y**2 / 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "policy", [None, pytest.param({"name": "affine"}, marks=pytest.mark.slow)], ids=["open loop", "affine"]
)
def test_the_integral_of_a_fading_plant_is_bounded_as_in_closed_form(
    policy: dict[str, str] | None, tmp_path: Path
) -> None:
    # until 1.5, with 0.2 of fuel in it: 2.5 log(2.5) and what u and w add; of w nothing can be answered in one piece
    count, until, limit = (10, 1.5, 1.9) if policy is None else (1, 1.5, 1.9)
    breaks = np.linspace(0.0, 2.0, count + 1)
    adds = np.diff(area(np.minimum(breaks, until), until))
    lengths = np.clip(until - breaks[:-1], 0.0, 2.0 / count)
    worst = 2.5 * np.log(2.5) + 0.1 * float(adds.sum())
    rows = np.append(adds + 0.2 * lengths, -adds - 0.2 * lengths)
    least = linprog(np.full(2 * count, 2.0 / count), rows[None], [limit - worst], bounds=[(0, 2)] * (2 * count)).fun
    problem = {**FADING, "terminal": [], "control": {"box": 2.0}, "disturbance": {"box": 0.1}}
    problem["integral"] = [{"H": [[1]], "G": [[0.2]], "to": until, "upper": limit}]
    config = {"problem": problem, "dictionaries": {"control": pieces(count)}, "observers": []}
    sr.run({**config, **({} if policy is None else {"policy": policy})}, out=tmp_path / "run", figures=False)
    assert check(tmp_path / "run").status == "verified"
    found = json.loads((tmp_path / "run" / "result.json").read_text())
    assert found["status"] == "certified" and found["cost"] == pytest.approx(least, rel=1e-6)
    for k, key in enumerate(("upper", "to", "H")):
        value = {"upper": limit - 1e-6, "to": until + 1e-5, "H": [[1.00001]]}[key]
        change = tampering.problem(integral=[{**problem["integral"][0], key: value}])
        forged = tampering.forged(tmp_path / "run", tmp_path / str(k), change, consistent=True)
        assert check(forged).status == "refuted"


LATE: dict[str, Any] = {
    **FADING,
    "system": {"A": [["-1/(1 + t)"]], "B": [[1]], "delay": 0.3},
    "initial_control": [-0.5],
    "control": {"box": 2.0},
    "disturbance": {"box": 0.1},
    "terminal": [{"box": 0.3}],
}


@pytest.mark.slow
def test_a_fading_plant_that_hears_late_costs_what_a_program_in_closed_form_says(tmp_path: Path) -> None:
    # (1 + t) x is the integral of (1 + t) (u(t - 0.3) + w), and u = -0.5 before 0
    breaks, late = np.linspace(0.0, 2.0, 11), 0.3
    acts = np.minimum(breaks + late, 2.0)
    rows = np.diff((1 + acts) ** 2) / 2
    begun = 2.5 - 0.5 * ((1 + late) ** 2 - 1) / 2
    limit = 0.3 * 3.0 - 0.1 * (3.0**2 - 1) / 2 - begun
    least = linprog(np.full(20, 0.2), np.append(rows, -rows)[None], [limit], bounds=[(0, 2)] * 20).fun
    assert verified(tmp_path / "run", LATE, pieces(10))["cost"] == pytest.approx(least, rel=1e-6)
    for k, change in enumerate(
        (tampering.problem(initial_control=[-0.499999]), tampering.system(delay=0.3001), tampering.system(delay=0.2999))
    ):
        assert check(tampering.forged(tmp_path / "run", tmp_path / str(k), change, True)).status == "refuted"
    found = sr.simulate(tmp_path / "run", 200, "vertices")
    assert not found.contradicts


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        {"cost": {"l1": 0.5, "control": {"R": [[0.2]]}, "state": {"Q": [[1, 0], [0, 0.1]], "reference": [0.1, 0]}}},
        {"integral": [{"H": [[1, 0]], "to": 2.5, "upper": 0.6}]},
        {"policy": {"name": "affine"}},
    ],
    ids=["quadratic", "integral", "affine"],
)
def test_a_constant_plant_that_hears_late_is_the_same_as_a_function_of_time(
    more: dict[str, Any], tmp_path: Path
) -> None:
    policy = {key: value for key, value in more.items() if key == "policy"}
    more, costs = {key: value for key, value in more.items() if key != "policy"}, []
    for name, t in (("still", ""), ("changing", " + 0*t")):
        problem = {
            "name": "linear",
            "system": {"A": [[f"0{t}", "1"], ["-1", f"-0.2{t}"]], "B": [[0], [1]], "E": [[0], [1]], "delay": 0.3},
            "horizon": 3.0,
            "initial_state": [1.0, 0.0],
            "initial_control": [0.4],
            "control": {"box": 1.5},
            "disturbance": {"box": 0.05},
            "path": [{"box": [1.3, 2.0]}],
            "terminal": [{"box": [0.4, 0.5]}],
            **more,
        }
        config = {"problem": problem, "dictionaries": {"control": pieces(6)}, "observers": [], **policy}
        outcome = sr.run(config, out=tmp_path / name, figures=False)
        assert outcome.status == "certified" and check(tmp_path / name).status == "verified"
        costs.append(outcome.result.cost)
    assert costs[0] == pytest.approx(costs[1], rel=2e-7)


def drawn(rng: np.random.Generator, tau: float, size: float) -> tuple[str, Callable[[Any], Any]]:
    """An entry of a random analytic function of ``t / tau`` as a config says it, and as numbers of any kind."""
    a, b, c = (float(one) for one in rng.normal(size=3).round(3))
    s, L, x = np.longdouble(size), np.longdouble, f"(t/{tau!r})"
    every: list[tuple[str, Callable[[Any], Any]]] = [
        (f"{a!r} + {b!r}*sin({3 * c!r}*{x})", lambda t: a + L(b) * np.sin(L(3 * c) * t)),
        (f"{a!r}*exp({-abs(c)!r}*{x}) + {b!r}", lambda t: a * np.exp(-L(abs(c)) * t) + b),
        (f"{a!r}/(1.25 + cos({c!r}*{x}))", lambda t: a / (L(1.25) + np.cos(L(c) * t))),
        (f"{a!r}*sqrt(1.0625 + sin({b!r}*{x}))", lambda t: a * np.sqrt(L(1.0625) + np.sin(L(b) * t))),
        (f"{a!r}*log(1.0625 + {x}^2)", lambda t: a * np.log(L(1.0625) + t**2)),
        (f"{a!r}*tan(0.25*{x})*cos({b!r}*{x})", lambda t: a * np.tan(L(0.25) * t) * np.cos(L(b) * t)),
    ]
    text, entry = every[rng.integers(len(every))]
    return f"({text})*{size!r}", lambda t: entry(t / L(tau)) * s


def integrated(rates: Callable[[Any], Any], horizon: float, size: int, steps: int) -> Any:
    """The solution of ``Y' = A Y + [0 B]`` from ``[1 0]``, in numbers of 64 bits: midpoints, extrapolated (Gragg)."""
    d = size
    Y = np.hstack([np.eye(d), np.zeros((d, 1))]).astype(np.longdouble)
    h = np.longdouble(horizon) / steps

    def slope(t: Any, state: Any) -> Any:
        F = rates(t)
        return F[:, :d] @ state + np.hstack([np.zeros((d, d)), F[:, d:]])

    for k in range(steps):
        rows: list[list[Any]] = []
        for q in range(1, 10):
            before, now, part = Y, Y + h / (2 * q) * slope(k * h, Y), h / (2 * q)
            for i in range(1, 2 * q):
                before, now = now, before + 2 * part * slope(k * h + i * part, now)
            row = [(before + now + part * slope((k + 1) * h, now)) / 2]
            for j in range(1, q):
                row.append(row[-1] + (row[-1] - rows[-1][j - 1]) / ((np.longdouble(q) / (q - j)) ** 2 - 1))
            rows.append(row)
        Y = rows[-1][-1]
    return Y


@pytest.mark.first(2)
@pytest.mark.parametrize("seed", [1, 6, 3, 8])
def test_random_analytic_coefficients_are_integrated_in_any_unit_of_time_and_length(seed: int) -> None:
    rng = np.random.default_rng(seed)
    d, tau = int(rng.integers(1, 4)), float(2.0 ** rng.integers(-12, 14))
    lengths, horizon = 2.0 ** rng.integers(-10, 12, d), tau * 2.5
    entries = [[drawn(rng, tau, float(a / b / tau)) for b in (*lengths, 1.0)] for a in lengths]
    texts = [[text for text, _ in row] for row in entries]
    system = sr.VaryingSystem.of([row[:d] for row in texts], [row[d:] for row in texts], horizon)
    table = [[entry for _, entry in row] for row in entries]
    found = integrated(lambda t: np.array([[entry(t) for entry in row] for row in table]), horizon, d, 7)
    again = integrated(lambda t: np.array([[entry(t) for entry in row] for row in table]), horizon, d, 9)
    expansion = Expansion.of(system)
    flow, u = expansion.flow(np.zeros(1), np.array([horizon])), expansion.units
    off = np.abs(np.hstack([flow.state[0], flow.control[0]]) - again) / u[:, None]
    off[:, :d] *= u
    missed = np.abs(found - again) / u[:, None]  # by the integrator
    missed[:, :d] *= u
    allowed = flow.error[0] * np.hstack([np.ones((d, d)), flow.sizes[0, :, :1]])
    assert missed.max() <= 1e-14 * max(1.0, float((np.abs(again) / u[:, None]).max()))
    assert (off <= allowed + 2 * missed).all()
    with ctx.workprec(192):
        Phi, Gamma, _ = VerifiedFlow(Plant.of(system, horizon), horizon).over(0.0, horizon)
    for i, row in enumerate(Phi.append_columns(Gamma).matrix.tolist()):
        for j, ball in enumerate(row):
            far = abs(np.longdouble(float(ball.mid())) - again[i, j])
            assert far <= float(ball.rad()) + 2 * abs(found[i, j] - again[i, j]) + 1e-15 * abs(again[i, j])
