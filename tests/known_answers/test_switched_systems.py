"""Guards known answers: systems that take turns at known times, against closed forms, a linear program on a fine grid
and the same system told in pieces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import SPRING, pieces, verified
from tests.support import tampering

FIRST: dict[str, Any] = {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]}
SECOND: dict[str, Any] = {"A": [[0, 1], [-3, -0.2]], "B": [[0], [1.5]]}
SWITCHED = {**SPRING, "system": {"pieces": [{"until": 2.0, **FIRST}, {"until": 5.0, **SECOND}]}}


def on_a_fine_grid(w: float, start: float, end: float, count: int = 50, steps: int = 8) -> float:
    """The least cost where the constraints hold at the times of a fine grid: a lower bound."""
    h, R, W, free = 5.0 / count / steps, np.zeros((2, count)), np.zeros((2, 2, count)), np.array([-1.0, 1.0])
    rows, limits = [], []
    for j in range(count * steps):
        piece = FIRST if (j + 0.5) * h < 2.0 else SECOND
        block = np.vstack([np.hstack([piece["A"], piece["B"], np.eye(2)]), np.zeros((3, 5))])
        step = expm(h * block)
        Phi, now = step[:2, :2], j // steps
        free, R, W = Phi @ free, Phi @ R, np.einsum("ij,jkl->ikl", Phi, W)
        R[:, now] += step[:2, 2]
        W[:, :, now] += step[:2, 3:]
        sides = np.array([0.7 if (j + 1) * h >= start - 1e-9 else np.inf, np.inf])
        sides = np.minimum(sides, end) if j == count * steps - 1 else sides
        for i in np.flatnonzero(np.isfinite(sides)):
            room = sides[i] - w * np.abs(W[i]).sum()
            rows += [R[i], -R[i]]
            limits += [room - free[i], room + free[i]]
    G = np.array(rows)
    found = linprog(
        np.full(2 * count, 5.0 / count), A_ub=np.hstack([G, -G]), b_ub=limits, bounds=[(0, 1)] * (2 * count)
    )
    assert found.status == 0
    return float(found.fun)


def test_a_switched_system_costs_what_a_fine_grid_says(tmp_path: Path) -> None:
    problem = {
        **SWITCHED,
        "disturbance": {"box": 0.03},
        "path": [{"box": [0.7, None], "from": 0.5}],
        "terminal": [{"box": 0.4}],
    }
    found, below = verified(tmp_path / "run", problem, pieces(50)), on_a_fine_grid(0.03, 0.5, 0.4)
    assert found["cost"] == pytest.approx(below, rel=2e-5)
    assert found["cost"] >= below * (1 - 1e-9)


def test_the_listed_switched_system_is_infeasible_with_a_proof(tmp_path: Path) -> None:
    found = verified(tmp_path / "run", {**SWITCHED, "disturbance": {"box": 0.05}}, pieces(50), status="infeasible")
    assert "the disturbance alone moves x2(5)" in found["message"]


def test_the_cheaper_of_two_thrusters_is_used_first(tmp_path: Path) -> None:
    # x' = u until 1, then x' = 2 u until 2, |u| <= 0.4, from 1 to 0: 0.8 in the second half, 0.2 in the first
    halves = [{"until": 1.0, "A": [[0]], "B": [[1]]}, {"until": 2.0, "A": [[0]], "B": [[2]]}]
    problem = {
        "name": "linear",
        "system": {"pieces": halves},
        "horizon": 2.0,
        "initial_state": [1],
        "control": {"box": 0.4},
        "terminal": [{"equals": [0]}],
    }
    assert verified(tmp_path / "run", problem, pieces(8))["cost"] == pytest.approx(0.6, rel=1e-7)


@pytest.mark.slow
def test_a_system_told_in_pieces_is_the_same_system(tmp_path: Path) -> None:
    # uncertain, from a set of initial states, with a switch inside a piece of the disturbance
    plain = {"A": [[0, 1], ["-2 + p", -0.5]], "B": [[0], [1]], "c": [0, "0.1 + p"]}
    common = {
        **SPRING,
        "initial_state": {"centre": [-1, 1], "box": [0.02, 0.01]},
        "disturbance": {"box": 0.02},
        "path": [{"box": [0.8, None], "from": 0.6}],
        "terminal": [{"box": 0.35}],
    }
    shared = {"parameters": {"p": [-0.05, 0.05]}, "delay": 0.2}
    told = {"pieces": [{"until": t, **plain} for t in (1.13, 3.0, 5.0)]}
    found = [
        verified(tmp_path / name, {**common, "system": {**system, **shared}}, pieces(10), pieces(4))
        for name, system in (("plain", plain), ("pieces", told))
    ]
    assert found[0]["cost"] > 0.05
    assert found[0]["cost"] == pytest.approx(found[1]["cost"], rel=3e-7)


def _random(seed: int, uncertain: bool) -> tuple[sr.OptimalControlProblem, sr.Dictionary, sr.Dictionary]:
    rng = np.random.default_rng(seed)
    d, m, ends = 3, 2, [0.0, *np.sort(rng.uniform(0.2, 1.8, 2)), 2.0]
    parameters = sr.Box([-0.3, -0.2], [0.1, 0.3]) if uncertain else None
    made = []
    for until in ends[1:]:
        A, S, B = rng.normal(size=(d, d)), 0.5 * rng.normal(size=(2, d, d)), rng.normal(size=(d, m))
        E, c = rng.normal(size=(d, 2)), rng.normal(size=d)
        if uncertain:
            made.append(
                (
                    until,
                    sr.LinearSystem(
                        lambda p, A=A, S=S: A + p[0] * S[0] + p[1] * p[0] * S[1],
                        lambda p, B=B: B * (1 + 0.3 * p[1]),
                        E,
                        parameters,
                        c=c,
                    ),
                )
            )
        else:
            made.append((until, sr.LinearSystem(A, B, E, c=c)))
    problem = sr.OptimalControlProblem(
        system=sr.SwitchedSystem(made, delay=0.15),
        horizon=2.0,
        initial_state=rng.normal(size=d),
        initial_set=sr.Ellipsoid(np.zeros(d), 0.01 * np.eye(d)),
        initial_control=rng.normal(size=m),
        control=sr.Box(-np.ones(m), np.ones(m)),
        disturbance=sr.Ellipsoid(np.zeros(2), 0.01 * np.eye(2)),
        path=[sr.PathConstraint(sr.Box(-np.ones(d), np.ones(d)), 0.0, 2.0)],
    )
    return (
        problem,
        sr.Dictionary(np.linspace(0, 2, 8), np.eye(7)),
        sr.Dictionary(np.array([0, 0.5, 1.2, 2.0]), np.eye(3)),
    )


@pytest.mark.first(1)
@pytest.mark.parametrize("uncertain", [False, True])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_bounds_of_cells_are_above_every_violation_and_close(seed: int, uncertain: bool) -> None:
    problem, control, disturbance = _random(seed, uncertain)
    constraint, rng = prepare(problem, control, disturbance).constraints[0], np.random.default_rng(seed)
    x, nu, box = rng.normal(size=14), 2 * uncertain, constraint.index_set
    width = np.concatenate([[0.02], 0.05 * np.ones(nu)])
    breaks = constraint.functionals.response.grid.breakpoints
    for _ in range(12):
        k = rng.integers(breaks.size - 1)
        low = rng.uniform(box.lower, np.maximum(box.lower, box.upper - width))
        low[0] = breaks[k] + rng.uniform(0, 0.5) * (breaks[k + 1] - breaks[k])
        high = np.minimum(low + width, box.upper)
        high[0] = min(low[0] + width[0], breaks[k + 1])
        bound = constraint.enclosure(x, low[None], high[None]).bounds[0]
        points = rng.uniform(low, high, size=(60, 1 + nu))
        seen = max(constraint.violations(x, points, np.full(60, row)).max() for row in range(6))
        assert seen <= bound
        assert bound <= seen + 0.3 * (1.0 + abs(seen))


@pytest.mark.parametrize("uncertain", [False, True])
def test_the_gradient_of_a_violation_is_its_slope(uncertain: bool) -> None:
    problem, control, disturbance = _random(5, uncertain)
    model = prepare(problem, control, disturbance)
    constraint, family, rng = model.constraints[0], model.program.families[0], np.random.default_rng(5)
    x = rng.normal(size=14)
    indices = np.array([[0.33, -0.1, 0.1], [1.07, -0.2, 0.2], [1.61, 0.05, -0.1], [1.93, 0.0, 0.0]])[
        :, : 1 + 2 * uncertain
    ]
    rows = np.array([0, 4, 2, 1])
    assert family.gradient is not None
    slopes, step = family.gradient(x, indices, rows), 1e-6
    for axis in range(indices.shape[1]):
        ends = [
            constraint.violations(x, indices + sign * step * np.eye(indices.shape[1])[axis], rows) for sign in (1, -1)
        ]
        assert slopes[:, axis] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=2e-5, abs=2e-5)


def test_functionals_of_switched_systems_are_what_trajectories_do() -> None:
    problem, control, disturbance = _random(7, True)
    model, rng = prepare(problem, control, disturbance), np.random.default_rng(7)
    x, p, direction = rng.normal(size=14), np.array([0.05, -0.1]), rng.normal(size=3)
    u, before = x.reshape(2, 7), np.asarray(problem.initial_control)
    for time in (0.4, 1.3, 2.0):
        parts = model.functionals.parts(time, direction, p)
        worst = parts.disturbance
        grid = model.response.grid
        assert worst is not None
        assert parts.deviation is not None
        state = np.asarray(problem.initial_state, dtype=float) + parts.deviation
        for start, stop, w in zip(grid.breakpoints[:-1], grid.breakpoints[1:], worst.T, strict=True):
            length, middle = min(stop, time) - start, (start + stop) / 2
            if length <= 0:
                break
            mode = next(one for one in problem.system.phases if middle < one.until)
            A, B, E = (part[0] for part in mode.matrices(p[None]))
            acting = before if middle < 0.15 else u[:, int((middle - 0.15) / (2 / 7))]
            force = B @ acting + E @ w + np.asarray(mode.c)[:, 0]
            block = np.vstack([np.column_stack([A, force]), np.zeros(4)])
            state = (expm(length * block) @ np.append(state, 1.0))[:3]
        found = model.functionals.values(x, np.array([time]), direction[None], p[None])[0]
        assert found == pytest.approx(float(direction @ state), rel=1e-11)


@pytest.mark.first(1)
@pytest.mark.parametrize("factors", [(2.0, 0.5, 4.0), (0.25, 8.0, 2.0)])
def test_other_units_by_powers_of_two_give_the_same_bits(factors: tuple[float, float, float]) -> None:
    time, first, control = factors
    found = []
    for s, t, u in ((np.ones(2), 1.0, 1.0), (np.array([first, 2.0]), time, control)):
        made = [
            (
                until * t,
                sr.LinearSystem(
                    np.array(piece["A"]) * s[:, None] / s / t,
                    np.array(piece["B"]) * s[:, None] / u / t,
                    np.eye(2) * s[:, None] / t,
                ),
            )
            for until, piece in ((2.0, FIRST), (5.0, SECOND))
        ]
        problem = sr.OptimalControlProblem(
            system=sr.SwitchedSystem(made),
            horizon=5.0 * t,
            initial_state=np.array([-1.0, 1.0]) * s,
            control=sr.Box([-u], [u]),
            weights=[1.0 / (t * u)],
            disturbance=sr.Box([-0.02] * 2, [0.02] * 2),
            path=[sr.PathConstraint(sr.Box(np.array([-0.7, -np.inf]) * s, np.array([0.7, np.inf]) * s), 0.5 * t)],
            terminal=[sr.Box(-0.3 * s, 0.3 * s)],
        )
        result = sr.solve(sr.transcribe(problem, control=sr.Dictionary(np.linspace(0.0, 5.0 * t, 21), np.eye(20))))
        assert result.status == "certified"
        assert result.decision is not None
        found.append((result.decision / u, result.cost, result.lower_bound))
    assert np.array_equal(found[0][0], found[1][0])
    assert found[0][1:] == found[1][1:]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("switched") / "run"
    verified(directory, {**SWITCHED, "disturbance": {"box": 0.02}}, pieces(20))
    return directory


def _piece(number: int, **changes: Any) -> tampering.Change:
    return lambda files: files.system["pieces"][number].update(changes)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "change",
    [
        lambda files: [files.system["pieces"][0].update(until=2.05)],
        lambda files: [files.system["pieces"][0].update(until=1.95)],
        _piece(1, A=[[0, 1], [-3, -0.19]]),
        _piece(1, B=[[0], [1.49]]),
        _piece(0, c=[0, 0.01]),
        _piece(1, E=[[1, 0], [0, 1.05]]),
    ],
    ids=["later", "earlier", "A", "B", "c", "E"],
)
def test_a_piece_that_is_changed_afterwards_is_found_by_what_it_does(
    change: tampering.Change, finished: Path, tmp_path: Path
) -> None:
    assert check(tampering.forged(finished, tmp_path / "copy", change, consistent=True)).status == "refuted"


@pytest.mark.first(6)
@pytest.mark.parametrize(
    ("system", "said"),
    [
        ({**FIRST, "pieces": [{"until": 5, **FIRST}]}, r"system\.A: expected none beside pieces"),
        ({}, r"A: expected a matrix, or pieces of the system, got none"),
        ({"A": [[0]]}, r"B: expected a matrix, or pieces"),
        (
            {"pieces": [{"until": 2, **FIRST}, {"until": 4, **SECOND}]},
            r"system\.pieces\.1\.until: expected 5, the horizon",
        ),
        (
            {"pieces": [{"until": 2, **FIRST}, {"until": 1, **SECOND}]},
            r"system\.pieces\.1\.until: expected a time after 2",
        ),
        (
            {"pieces": [{"until": 2, **FIRST}, {"until": 5, "A": [[0]], "B": [[1]]}]},
            r"system\.pieces\.1: expected 2 states",
        ),
        (
            {"pieces": [{"until": 5, "A": [[0, 1]], "B": [[1]]}]},
            r"system\.pieces\.0\.A: expected a square matrix|pieces\.0",
        ),
        ({"pieces": [{"until": 5, **FIRST, "c": [1]}]}, r"system\.pieces\.0\.c: expected 2 entries"),
        ({"pieces": [{"until": 5, **FIRST, "c": [1, "q"]}]}, r"system\.pieces\.0\.c\.1: .*unknown name"),
        ({"pieces": [{"until": 5, **FIRST, "delay": 1}]}, r"system\.pieces\.0\.delay: unknown key"),
        ({"pieces": []}, r"system\.pieces: "),
        (
            {"pieces": [{"until": 2, **FIRST}, {"until": 2 + 1e-13, **SECOND}, {"until": 5, **FIRST}]},
            r"system\.pieces\.1\.until: expected a time that is after 2 by more than rounding",
        ),
    ],
)
def test_wrong_pieces_are_named_with_their_key(system: dict[str, Any], said: str) -> None:
    config = {"problem": {**SPRING, "system": system}, "dictionaries": {"control": pieces(5)}}
    with pytest.raises(sr.InputError, match=said):
        sr.run({**config, "observers": []}, figures=False)


def test_a_known_piece_may_follow_an_uncertain_one() -> None:
    uncertain = sr.LinearSystem(lambda p: np.array([[p[0]]]), [[1.0]], parameters=sr.Box([-1.0], [1.0]))
    system = sr.SwitchedSystem([(1.0, sr.LinearSystem([[0.0]], [[1.0]], c=[0.5])), (2.0, uncertain)])
    assert [mode.count for mode in system.modes] == [1, 1]
    assert [mode.c is not None for mode in system.modes] == [True, True]
    with pytest.raises(sr.InputError, match=r"system\.pieces\.1: expected the parameters of the other pieces"):
        other = sr.LinearSystem(lambda p: np.array([[p[0]]]), [[1.0]], parameters=sr.Box([-2.0], [1.0]))
        sr.SwitchedSystem([(1.0, uncertain), (2.0, other)])
    with pytest.raises(sr.InputError, match="without delay, got a delay of its own"):
        sr.SwitchedSystem([(1.0, sr.LinearSystem([[0.0]], [[1.0]], delay=0.1))])


SETS = [
    {"polytope": {"H": [[1, 1], [-1, 0], [0, -1]], "h": [0.1, 0.05, 0.05]}},
    {"norm": {"p": 1, "radius": 0.1}},
    pytest.param({"ellipsoid": {"shape": [[0.01, 0.004], [0.004, 0.01]]}}, marks=pytest.mark.slow),
    pytest.param({"norm": {"p": 3, "radius": 0.1}}, marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize("parameters", SETS)
def test_pieces_share_a_set_of_parameters_of_any_kind(parameters: dict[str, Any], tmp_path: Path) -> None:
    plain = {"A": [["-0.5 + p1"]], "B": [["1 + p2"]]}
    shared = {"parameters": {"names": ["p1", "p2"], **parameters}}
    told = {"pieces": [{"until": t, **plain} for t in (0.7, 2.0)]}
    problem = {"name": "linear", "horizon": 2.0, "initial_state": [1.0], "control": {"box": 1.0}}
    costs = []
    for name, system in (("plain", plain), ("pieces", told)):
        whole = {**problem, "system": {**system, **shared}, "terminal": [{"box": 0.1}]}
        config = {"problem": whole, "dictionaries": {"control": pieces(4)}, "observers": []}
        outcome = sr.run(config, out=tmp_path / name, quiet=True, figures=False)
        assert outcome.status == "certified"
        costs.append(outcome.result.cost)
    assert costs[0] > 0.2
    assert costs[0] == pytest.approx(costs[1], rel=3e-7)
    assert sr.check(tmp_path / "pieces").status == sr.check(tmp_path / "plain").status != "refuted"


@pytest.mark.parametrize(
    "parameters", [sr.Box([-0.1], [0.2]), sr.Ellipsoid([0.1], [[0.2]]), sr.NormBall(3, 0.3, centre=[0.1])]
)
def test_parameters_of_pieces_are_the_same_where_their_numbers_are(parameters: sr.ConvexSet) -> None:
    def piece(shared: sr.ConvexSet) -> sr.LinearSystem:
        return sr.LinearSystem(lambda p: np.array([[p[0]]]), [[1.0]], parameters=shared)

    units = np.array([0.3])
    again = [parameters.in_units(units) for _ in range(2)]
    assert sr.SwitchedSystem([(1.0, piece(again[0])), (2.0, piece(again[1]))]).parameter_count == 1
    with pytest.raises(sr.InputError, match="parameters of the other pieces"):
        sr.SwitchedSystem([(1.0, piece(again[0])), (2.0, piece(parameters.in_units(1.001 * units)))])


@pytest.mark.slow
def test_the_other_methods_and_studies_know_switched_systems(tmp_path: Path) -> None:
    problem = {**SWITCHED, "disturbance": {"box": 0.02}}
    config = {"problem": problem, "dictionaries": {"control": pieces(10)}, "observers": []}
    J = sr.run(config, out=tmp_path / "exchange", figures=False).result.cost
    for method in ({"name": "nominal"}, {"name": "scenario", "scenarios": 20}):
        other = sr.run({**config, "method": method}, out=tmp_path / method["name"], figures=False).result
        assert 0.0 < other.cost <= J * (1 + 1e-9)
    attained = sr.simulate(tmp_path / "exchange", law="adversary")
    assert all(abs(one.largest - one.worst) < 1e-9 for one in attained.constraints)
    sampled = sr.simulate(tmp_path / "exchange", trajectories=50)
    assert all(one.violated == 0 for one in sampled.constraints)


def test_minimum_attention_takes_drift_and_pieces_and_refuses_a_delay(tmp_path: Path) -> None:
    # x' = u + c with u(0) = u(T) = 0; -c = 0 on average is the same as a start that is lower by the drift
    base = {
        "name": "minimum_attention",
        "horizon": 4,
        "initial_state": 1,
        "rate": {"box": 1},
        "terminal": [{"equals": [0]}],
    }
    told = {
        "still": {**base, "system": {"A": [[0]], "B": [[1]]}},
        "drifting": {**base, "system": {"A": [[0]], "B": [[1]], "c": [-0.1]}, "initial_state": 1.4},
        "pieces": {**base, "system": {"pieces": [{"until": t, "A": [[0]], "B": [[1]]} for t in (1.0, 4.0)]}},
    }
    costs = [verified(tmp_path / name, problem, pieces(16))["cost"] for name, problem in told.items()]
    assert costs[1:] == pytest.approx([costs[0]] * 2, rel=3e-7)
    late = {**base, "system": {"A": [[0]], "B": [[1]], "delay": 0.1}}
    with pytest.raises(sr.InputError, match=r"system\.delay: expected none: minimum_attention"):
        sr.run({"problem": late, "dictionaries": {"control": pieces(4)}, "observers": []}, figures=False)


@pytest.mark.slow
def test_a_quadratic_cost_follows_every_piece(tmp_path: Path) -> None:
    # the same system told in pieces costs the same; with other pieces, what a fine sum says
    cost = {"l1": 0.5, "state": {"Q": [[0.2, 0], [0, 0.1]], "reference": [0.1, 0]}, "final": {"Q": [[1, 0], [0, 1]]}}
    common = {**SPRING, "cost": cost, "disturbance": {"box": 0.02}, "path": []}
    told = {
        "plain": {**FIRST, "c": [0, 0.1], "delay": 0.2},
        "pieces": {"pieces": [{"until": t, **FIRST, "c": [0, 0.1]} for t in (1.13, 5.0)], "delay": 0.2},
    }
    costs = [verified(tmp_path / k, {**common, "system": system}, pieces(10))["cost"] for k, system in told.items()]
    assert costs[0] == pytest.approx(costs[1], rel=2e-7)
    switched = verified(tmp_path / "switched", {**common, "system": SWITCHED["system"]}, pieces(10))["cost"]
    with np.load(tmp_path / "switched" / "solution.npz") as solution:
        u = solution["control"][0]
    state, h, integral = np.array([-1.0, 1.0]), 5.0 / 4000, 0.0
    for j in range(4000):
        piece = FIRST if (j + 0.5) * h < 2.0 else SECOND
        force = np.array(piece["B"])[:, 0] * u[j // 400]
        middle = (expm(h / 2 * np.vstack([np.column_stack([piece["A"], force]), np.zeros(3)])) @ np.append(state, 1))[
            :2
        ]
        integral += h * (middle - [0.1, 0]) @ np.diag([0.2, 0.1]) @ (middle - [0.1, 0])
        state = (expm(h * np.vstack([np.column_stack([piece["A"], force]), np.zeros(3)])) @ np.append(state, 1))[:2]
    assert switched == pytest.approx(0.5 * np.abs(u).sum() * 0.5 + integral + state @ state, rel=1e-6)
