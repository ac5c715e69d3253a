"""Guards sets that move (`relative_to`) and bounds of state and control together (`mixed`): known values, independent
linear programs on fine grids, other units, every form of the answer, and forged certificates."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.support.problems import spring
from tests.support.tampering import Change, Forgery, forged

BOX = {"box": [0.7, None], "from": 0.3}
MIXED = {"mixed": {"H": [[0, 1], [0, -1]], "G": [[0.5], [-0.5]], "h": 1.2}, "from": 0.6}
MOVING = {**BOX, "relative_to": [[0, 0, 0], [1.03, 0.1, 0], [1.83, -0.15, 0], [5, 0.2, 0]]}
SPRING = spring(0.05, since=None)
UNSURE = {"A": [[0, 1], ["-2 + p", -0.5]], "B": [[0], [1]], "parameters": {"p": [-0.05, 0.05]}}


def run(
    out: Path, *path: dict[str, Any], pieces: int = 50, dictionary: str = "piecewise_constant", **changes: Any
) -> sr.Outcome:
    problem = {**SPRING, "path": list(path), **{k: v for k, v in changes.items() if k != "method"}}
    config = {
        "problem": problem,
        "dictionaries": {"control": {"name": dictionary, "pieces": pieces}},
        "observers": [],
        **({"method": changes["method"]} if "method" in changes else {}),
    }
    return sr.run(config, out=out, quiet=True, figures=False)


def cheapest(rows: Callable[[float], list[tuple[np.ndarray, float, float]]], N: int = 50, parts: int = 20) -> float:
    """The spring under ``|w_i| <= 0.05`` as a linear program over many times: ``rows(t)`` lists ``c (2,)``, ``g`` and
    ``b`` of ``c'x(t) + g u(t) <= b``, with the control on both sides of a jump."""
    A, B, step = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0], [1.0]]), 5.0 / N / parts
    big = expm(np.block([[A, B, np.eye(2)], [np.zeros((3, 5))]]) * step)
    Phi, gamma, delta = big[:2, :2], big[:2, 2], big[:2, 3:]
    x, R, D = np.array([-1.0, 1.0]), np.zeros((2, N)), np.zeros((2, 2 * N))
    left, right = [], []
    for j in range(N * parts + 1):
        t = j * step
        for k in sorted({min(j // parts, N - 1), max(0, (j - 1) // parts)}):
            for c, g, b in rows(t):
                row = c @ R
                row[k] += g
                left.append(row)
                right.append(b - c @ x - 0.05 * np.abs(c @ D).sum())
        k = min(j // parts, N - 1)
        x, R, D = Phi @ x, Phi @ R, Phi @ D
        R[:, k] += gamma
        D[:, 2 * k : 2 * k + 2] += delta
    both = np.hstack([np.array(left), -np.array(left)])
    found = linprog(np.full(2 * N, 5.0 / N), A_ub=both, b_ub=right, bounds=(0, 1))
    assert found.status == 0, found.message
    return float(found.fun)


def ends(t: float) -> list[tuple[np.ndarray, float, float]]:
    axes = np.vstack([np.eye(2), -np.eye(2)])
    return [(c, 0.0, 0.3) for c in axes] if t > 5.0 - 1e-9 else []


def kept(t: float, centre: float = 0.0) -> list[tuple[np.ndarray, float, float]]:
    c = np.array([1.0, 0.0])
    return [(c, 0.0, 0.7 + centre), (-c, 0.0, 0.7 - centre)] if t > 0.3 - 1e-9 else []


def test_the_known_cost_of_a_mixed_constraint_is_reached(tmp_path):
    outcome = run(tmp_path / "run", BOX, MIXED)
    assert outcome.result.status == "certified", outcome.result.message
    assert outcome.result.cost == pytest.approx(0.541961, rel=2e-6)
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


def test_a_moving_set_costs_what_a_program_on_a_fine_grid_says(tmp_path):
    outcome = run(tmp_path / "run", MOVING)
    truth = cheapest(lambda t: ends(t) + kept(t, float(np.interp(t, [0, 1.03, 1.83, 5], [0, 0.1, -0.15, 0.2]))))
    assert outcome.result.status == "certified", outcome.result.message
    assert outcome.result.cost == pytest.approx(truth, rel=1e-4)
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


def test_bounds_of_the_control_alone_in_a_window_are_kept(tmp_path):
    """``u >= -0.3``, which no set of states says; the window ends within pieces that count whole."""
    alone = {"mixed": {"H": [[0, 0]], "G": [[-1]], "h": 0.3}, "from": 0.73, "to": 1.87}
    outcome = run(tmp_path / "run", BOX, alone)
    control = outcome.control[0]
    assert outcome.result.status == "certified", outcome.result.message
    assert control[7:19].min() == pytest.approx(-0.3, abs=1e-6)
    assert control[:7].min() < -0.3 or control[19:].min() < -0.3
    truth = cheapest(lambda t: ends(t) + kept(t) + ([(np.zeros(2), -1.0, 0.3)] if 0.71 < t < 1.89 else []), parts=12)
    assert outcome.result.cost == pytest.approx(truth, rel=2e-4)
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


@pytest.mark.slow
@pytest.mark.parametrize("entry", [MIXED, MOVING], ids=["mixed", "moving"])
@pytest.mark.parametrize(
    "changes",
    [
        {"dictionary": "haar", "pieces": 32},
        {"pieces": 7},
        {"pieces": 25, "system": UNSURE, "disturbance": {"box": [0.03, 0.03]}},
        {"pieces": 25, "system": {**SPRING["system"], "delay": 0.17}, "disturbance": {"box": [0.03, 0.03]}},
    ],
    ids=["haar", "seven pieces", "parameter", "delay"],
)
def test_other_dictionaries_systems_and_delays_are_certified_and_checked(entry, changes, tmp_path):
    path = [{**BOX, "from": 0.5}, entry] if entry is MIXED else [{**entry, "from": 0.5}]
    outcome = run(tmp_path / "run", *path, **changes)
    assert outcome.result.status == "certified", outcome.result.message
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims


@pytest.mark.slow
@pytest.mark.parametrize(
    "curved",
    [
        pytest.param({"ellipsoid": {"shape": [[0.49, 0], [0, 4]]}}, marks=pytest.mark.slow),
        {"norm": {"p": 2, "radius": 1.4}},
    ],
)
def test_a_round_set_that_moves_is_proven_and_never_left(curved, tmp_path):
    moved = [[0.5, 0.1, 0.2], [1.7, 0.2, -0.3], [5, -0.1, 0]]
    outcome = run(tmp_path / "run", {**curved, "from": 0.6, "relative_to": moved}, pieces=25)
    assert outcome.result.status == "certified", outcome.result.message
    assert check(outcome.directory).status == "verified", check(outcome.directory).claims
    told = sr.simulate(outcome, 200)
    assert not any(one.violated for one in told.constraints)
    worst = sr.simulate(outcome, law="adversary")
    assert all(one.largest == pytest.approx(one.worst, abs=1e-8) for one in worst.constraints)


def test_simulated_trajectories_reach_the_worst_case_and_no_more(tmp_path):
    outcome = run(tmp_path / "run", MOVING, MIXED)
    told = sr.simulate(outcome, 200, law="neighbours")
    assert not any(one.violated for one in told.constraints)
    assert any(one.largest > -0.02 for one in told.constraints if one.name != "terminal")
    worst = sr.simulate(outcome, law="adversary")
    assert all(one.largest == pytest.approx(one.worst, abs=1e-8) for one in worst.constraints)


def test_a_set_that_stands_still_elsewhere_is_that_set(tmp_path):
    shifted = {"box": {"lower": [-0.8, None], "upper": [0.6, None]}, "from": 0.5}
    beside = {"box": [0.7, None], "from": 0.5, "relative_to": [[0, -0.1, 0], [5, -0.1, 0]]}
    one, two = run(tmp_path / "one", shifted), run(tmp_path / "two", beside)
    assert one.result.cost == pytest.approx(two.result.cost, rel=1e-8)


def test_factors_of_two_in_every_unit_change_nothing(tmp_path):
    plain = run(tmp_path / "one", MOVING, MIXED, pieces=30).control
    t, x, u = 2.0**7, np.array([2.0**-11, 2.0**5]), 2.0**9
    rate = np.outer(x, 1 / x) / t
    rows = np.array(MOVING["relative_to"]) * [t, *x]
    other = run(
        tmp_path / "two",
        {"box": [0.7 * x[0], None], "from": 0.3 * t, "relative_to": rows.tolist()},
        {
            "mixed": {"H": [[0, 1 / x[1]], [0, -1 / x[1]]], "G": [[0.5 / u], [-0.5 / u]], "h": 1.2},
            "from": 0.6 * t,
        },
        pieces=30,
        system={
            "A": (np.array([[0, 1], [-2, -0.5]]) * rate).tolist(),
            "B": [[0], [x[1] / u / t]],
            "E": np.diag(x / t).tolist(),
        },
        horizon=5.0 * t,
        initial_state=[-x[0], x[1]],
        control={"box": u},
        terminal=[{"box": (0.3 * x).tolist()}],
    ).control
    np.testing.assert_array_equal(other, plain * u)


def test_what_is_impossible_says_so(tmp_path):
    away = {**BOX, "relative_to": [[0, 0, 0], [1, 3, 0], [5, 3, 0]]}
    for name, path in {"moving": [away], "mixed": [{"mixed": {**MIXED["mixed"], "h": 0.05}}]}.items():
        outcome = run(tmp_path / name, *path)
        assert outcome.result.status == "infeasible" and "path" in outcome.result.message
        assert check(outcome.directory).status == "verified", check(outcome.directory).claims


@pytest.mark.first(1)
@pytest.mark.parametrize("method", ["nominal", "scenario"])
def test_baselines_are_refuted_by_a_witness_that_is_checked(method, tmp_path):
    options = {"name": method, **({"scenarios": 100} if method == "scenario" else {})}
    outcome = run(tmp_path / "run", MOVING, {"mixed": {**MIXED["mixed"], "h": 0.9}, "from": 0.6}, method=options)
    assert outcome.result.status == "refuted"
    assert not any(claim.verdict == "fails" for claim in check(outcome.directory).claims)


@pytest.mark.first(6)
@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({**BOX, "relative_to": [[0, 0], [5, 0]]}, "path.0.relative_to: expected rows of 3 finite numbers"),
        ({**BOX, "relative_to": [[0, 0, 0], [0, 1, 0], [5, 0, 0]]}, "relative_to: expected rows whose times increase"),
        ({**BOX, "relative_to": [[0, 0, 0], [4, 1, 0]]}, "expected rows whose times cover the window, 0.3 to 5"),
        ({**BOX, "relative_to": []}, "path.0.relative_to: expected rows"),
        ({**MIXED, "relative_to": [[0, 0, 0], [5, 0, 0]]}, "path.0.relative_to: moves the set of states"),
        ({"mixed": {"H": [[0]], "G": [[1]], "h": 1}}, "path.0.mixed.H: expected rows of 2 finite numbers"),
        ({"mixed": {"H": [[0, 1]], "G": [[1, 2]], "h": 1}}, "path.0.mixed.G: expected rows of 1 finite numbers"),
        ({"mixed": {"H": [[0, 1]], "G": [[1], [2]], "h": 1}}, "path.0.mixed.G: expected 1 rows, as H has, got 2"),
        ({"mixed": {"H": [[0, 1]], "G": [[1]], "h": [1, 2]}}, "path.0.mixed.h: expected 1 numbers"),
        ({"mixed": {"H": [[0, 0]], "G": [[0]], "h": -1}}, "path.0.mixed: empty"),
        ({"mixed": {"H": [[0, 1]], "h": 1}}, "path.0.mixed.G: missing"),
        ({**MIXED, "from": 5}, "path.0: expected a window of positive length"),
        ({"from": 1}, "path.0: expected a set"),
    ],
)
def test_wrong_keys_are_refused_with_their_place(entry, said, tmp_path):
    with pytest.raises(sr.ConfigError, match=said):
        run(tmp_path / "run", entry)


def test_records_say_the_same_as_keys(tmp_path):
    system, indicators = (
        sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]]),
        sr.Dictionary(np.linspace(0, 5, 51), np.eye(50)),
    )
    problem = sr.OptimalControlProblem(
        system=system,
        horizon=5.0,
        initial_state=[-1, 1],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.05, -0.05], [0.05, 0.05]),
        path=[
            sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), 0.3),
            sr.MixedConstraint([[0, 1], [0, -1]], [[0.5], [-0.5]], 1.2, 0.6),
        ],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )
    program = sr.transcribe(problem, indicators)
    assert sr.solve(program, tolerance=1e-8).cost == pytest.approx(0.541961, rel=2e-6)


FIRST = {**MOVING, "from": 0.5}


def shortest(of: str, tmp_path: Path, **changes: Any) -> sr.Margin:
    problem = {**SPRING, "path": [FIRST, MIXED], "control_step": {"box": 0.4}, **changes}
    dictionary = {"control": {"name": "piecewise_constant", "pieces": 20}}
    return sr.margin({"problem": problem, "dictionaries": dictionary, "observers": []}, of=of, out=tmp_path / "margin")


@pytest.mark.slow
@pytest.mark.parametrize("of", ["path.1", "control_step", "path.0.from"])
def test_margins_of_what_is_new_are_proven_from_both_sides(of, tmp_path):
    found = shortest(of, tmp_path)
    assert found.status == "certified", found.message
    assert found.upper - found.lower <= 1e-5 * max(1.0, found.upper)
    for factor, status in ((found.upper + 1e-3, "certified"), (found.lower - 1e-3, "infeasible")):
        first = {**FIRST, "from": factor} if of == "path.0.from" else FIRST
        mixed = {**MIXED, "mixed": {**MIXED["mixed"], "h": 1.2 * factor}} if of == "path.1" else MIXED
        step = 0.4 * factor if of == "control_step" else 0.4
        outcome = run(tmp_path / status, first, mixed, pieces=20, control_step={"box": step})
        assert outcome.result.status == status, (factor, outcome.result.message)


def test_the_start_of_a_moving_window_is_varied_only_where_it_is_known(tmp_path):
    late = {**BOX, "from": 0.5, "relative_to": [[0.4, 0, 0], [5, 0, 0]]}
    with pytest.raises(sr.InputError, match=r"relative_to begins at 0\.4"):
        shortest("path.0.from", tmp_path, path=[late])


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("honest")
    known = {"moving": run(folder / "moving", MOVING).directory, "mixed": run(folder / "mixed", BOX, MIXED).directory}
    assert all(check(directory).status == "verified" for directory in known.values())
    return known


def mixed(**changes: Any) -> Change:
    return lambda files: files.problem["path"][1]["mixed"].update(changes)


def reference(row: int, column: int, value: float) -> Change:
    def change(files: Forgery) -> None:
        files.problem["path"][0]["relative_to"][row][column] = value

    return change


def priced(**changes: Any) -> Change:
    def change(files: Forgery) -> None:
        entries = [entry for entry in files.constraints if entry["constraint"] == "path[1]"]
        max(entries, key=lambda entry: entry["multiplier"]).update(changes)

    return change


def elsewhere(files: Forgery) -> None:
    for entry in files.constraints:
        if entry["constraint"] == "path[1]":
            entry["piece"] += 1


def drop(files: Forgery) -> None:
    for name in ("lower", "upper"):
        files.proof("path[1]")[name] = files.proof("path[1]")[name][1:]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run_of", "claim", "change"),
    [
        ("moving", "path", reference(2, 1, -0.2)),
        ("moving", "path", reference(1, 1, -0.3)),
        ("moving", "lower bound", reference(2, 1, -0.1)),
        ("moving", "lower bound", lambda files: files.problem["path"][0].pop("relative_to")),
        ("mixed", "path[1]", mixed(h=1.199)),
        ("mixed", "path[1]", mixed(G=[[1.5], [-1.5]])),
        ("mixed", "path[1]", lambda files: files.problem["path"][1].update({"from": 0.5})),
        ("mixed", "path[1]", drop),
        ("mixed", "lower bound", mixed(h=1.3)),
        ("mixed", "lower bound", priced(direction=[0.0, 1.0, 0.4])),
        ("mixed", "lower bound", priced(direction=[0.0, 1.0])),
        ("mixed", "lower bound", priced(piece=None)),
        pytest.param("mixed", "lower bound", priced(piece=49), marks=pytest.mark.slow),
        pytest.param("mixed", "lower bound", priced(piece=-1), marks=pytest.mark.slow),
        ("mixed", "lower bound", elsewhere),
    ],
)
def test_a_forged_window_is_found(run_of, claim, change, honest, tmp_path):
    found = check(forged(honest[run_of], tmp_path / "forged", change, consistent=True))
    assert any(one.name == claim and one.verdict == "fails" for one in found.claims), found.claims
