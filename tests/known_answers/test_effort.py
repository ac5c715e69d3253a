"""Guards the cost `worst`: the largest effort against all vertices and a mixed-integer program, the program against all
signs at once, its place between `nominal` and `peak`, closed loops, forged certificates."""

from __future__ import annotations

import json
import shutil
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb
from scipy.optimize import LinearConstraint, linprog, milp

import sparserob_core as sr
from sparserob_core.checker.cost.effort import prove_effort_limit
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.control.feedback.effort import largest_effort
from sparserob_core.control.studies.answer import ControlResult
from sparserob_core.experiment.check.check import check
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.inner.simplex.growing import GrowingProgram
from tests.support.problems import double_integrator

RATE, T = 0.4, 3.0
DOUBLE = double_integrator(0.3)
PLANE: dict[str, Any] = {
    "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
    "initial_state": [-1, 1],
    "terminal": [{"box": [0.6, 0.6]}],
}
SCALAR: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[RATE]], "B": [[1.0]]},
    "horizon": T,
    "initial_state": [0.5],
    "control": {"box": 1.0},
    "disturbance": {"box": 0.15},
    "terminal": [{"box": 0.45}],
}


def run(problem: dict[str, Any], pieces: int, out: Path, cost: str = "worst", **more: Any) -> sr.Outcome:
    dictionaries = {"control": {"name": "piecewise_constant", "pieces": pieces}}
    policy = more.pop("policy", {"name": "affine", "cost": cost, "causal_signals": 0})
    config = {"problem": problem, "dictionaries": dictionaries, "policy": policy, "observers": [], **more}
    return sr.run(config, out=out, quiet=True, figures=False)


def effort_at(outcome: sr.Outcome, w: Array) -> Array:
    """``int sum |u|`` under deviations ``w (n, Q)``, from the written gains' effects."""
    result = outcome.result
    assert isinstance(result, ControlResult) and result.decision is not None and result.model.feedback is not None
    loop, lengths = result.model.feedback.loop, result.model.control.lengths
    prices = np.outer(lengths, np.asarray(result.problem.weights, dtype=float))
    u = loop.nominal(result.decision).T[..., None] + loop.effects(result.decision) @ w.T
    return np.asarray((prices[..., None] * np.abs(u)).sum(axis=(0, 1)))


def vertices(radii: Array) -> Array:
    """Every corner of a box."""
    return np.array(list(product(*((-r, r) for r in radii))))


@pytest.mark.parametrize("seed", range(12))
def test_the_largest_effort_is_that_of_the_worst_vertex(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, Q = int(rng.integers(2, 9)), int(rng.integers(1, 9))
    a, A = rng.normal(size=n) * rng.uniform(0.0, 2.0), rng.normal(size=(n, Q)) * (rng.random((n, Q)) < 0.7)
    radii = rng.uniform(0.1, 1.0, Q)
    truth = np.abs(a + vertices(radii) @ A.T).sum(axis=1).max()
    found = largest_effort(a, A, Spread(((1, sr.Box(-radii, radii)),)))
    assert found.lower == pytest.approx(truth, rel=1e-12)
    assert truth <= found.upper * (1.0 + 1e-14) and found.upper <= truth * (1.0 + 1e-8)
    assert found.values[0] == pytest.approx(found.lower, rel=1e-14)


@pytest.mark.slow
def test_the_largest_effort_is_that_of_a_mixed_integer_program() -> None:
    """``|u| <= t`` reversed by a binary variable for each entry, solved by HiGHS."""
    rng = np.random.default_rng(5)
    n, Q, far = 14, 16, 1e2
    a, A, radii = rng.normal(size=n), 0.4 * rng.normal(size=(n, Q)), rng.uniform(0.2, 1.0, Q)
    one, none = np.eye(n), np.zeros((n, Q))
    above = np.hstack([-A, one, far * one])  # t <= u + far (1 - z)
    below = np.hstack([A, one, -far * one])  # t <= -u + far z
    upper = np.concatenate([a + far, -a])
    bounds = (np.concatenate([-radii, np.zeros(2 * n)]), np.concatenate([radii, np.full(n, far), np.ones(n)]))
    truth = milp(
        np.concatenate([np.zeros(Q), -np.ones(n), np.zeros(n)]),
        constraints=LinearConstraint(np.vstack([above, below]), -np.inf, upper),
        integrality=np.concatenate([np.zeros(Q + n), np.ones(n)]),
        bounds=bounds,
        options={"mip_rel_gap": 1e-9},
    )
    assert none.size and truth.status == 0
    found = largest_effort(a, A, Spread(((1, sr.Box(-radii, radii)),)))
    assert -truth.fun == pytest.approx(found.lower, rel=1e-6)
    assert found.lower <= found.upper <= found.lower * (1.0 + 1e-8)


def test_a_search_that_ends_early_says_an_honest_bound() -> None:
    rng = np.random.default_rng(2)
    a, A, spread = rng.normal(size=9), rng.normal(size=(9, 8)), Spread(((1, sr.Box(-np.ones(8), np.ones(8))),))
    truth = np.abs(a + vertices(np.ones(8)) @ A.T).sum(axis=1).max()
    stopped = largest_effort(a, A, spread, parts=1)
    assert stopped.lower <= truth * (1.0 + 1e-14) and truth <= stopped.upper
    assert stopped.upper > largest_effort(a, A, spread).upper


@pytest.mark.parametrize("seed", range(4))
def test_the_checker_bounds_the_effort_and_refuses_less_than_the_worst_vertex(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, Q = 6, 5
    a, A = rng.normal(size=n), rng.normal(size=(n, Q))
    truth = float(np.abs(a + vertices(np.ones(Q)) @ A.T).sum(axis=1).max())
    balls = [arb(float(x)) for x in a], [[arb(float(x)) for x in row] for row in A]

    def support(b: list[arb]) -> arb:
        return sum((abs(x) for x in b), arb(0))

    def judged(limit: float) -> int:
        return prove_effort_limit(*balls, support, np.ones(Q), arb(limit), Clock(10.0))

    assert judged(truth * (1.0 + 1e-12)) >= 1
    with pytest.raises(Broken, match="effort"):
        judged(truth * (1.0 - 1e-9))
    with pytest.raises((Broken, Unchecked)):
        judged(truth * (1.0 - 1e-15))


def test_the_least_worst_effort_of_a_scalar_problem_is_that_of_all_signals_at_once(tmp_path: Path) -> None:
    """Three pieces: nominal control, gains and efforts of all eight signals in one linear program."""
    K, w = 3, 0.15
    h = T / K
    ends = np.linspace(0.0, T, K + 1)
    gives = -np.diff(np.exp(RATE * (T - ends)) / RATE)
    step = (np.exp(RATE * h) - 1.0) / RATE
    pairs = [(k, j) for k in range(K) for j in range(k)]  # the control on piece k answers the disturbance of piece j
    n = K + len(pairs) + 1
    rows, limits = [], []
    for signal in product((-w, w), repeat=K):
        u = np.zeros((K, n))
        for k in range(K):
            u[k, k] = 1.0
        for number, (k, j) in enumerate(pairs):
            u[k, K + number] = signal[j] * step
        for sign in (1.0, -1.0):
            for k in range(K):
                rows.append(sign * u[k])
                limits.append(1.0)
            rows.append(sign * gives @ u)
            limits.append(0.45 - sign * (np.exp(RATE * T) * 0.5 + gives @ signal))
        for signs in product((-h, h), repeat=K):
            effort = np.array(signs) @ u
            effort[-1] = -1.0
            rows.append(effort)
            limits.append(0.0)
    found = linprog(np.eye(n)[-1], A_ub=np.array(rows), b_ub=limits, bounds=(None, None))
    outcome = run(SCALAR, K, tmp_path / "run")
    assert found.status == 0 and outcome.status == "certified"
    assert outcome.result.cost == pytest.approx(found.fun, rel=1e-7)
    assert outcome.result.lower_bound <= found.fun + 1e-9
    assert outcome.result.cost >= found.fun - 1e-9
    assert check(outcome.directory).status == "verified"


@pytest.mark.slow
def test_worst_lies_between_nominal_and_peak_and_no_disturbance_costs_more(tmp_path: Path) -> None:
    costs = {}
    for cost in ("nominal", "worst", "peak"):
        outcome = run(DOUBLE, 8, tmp_path / cost, cost)
        assert outcome.status == "certified" and outcome.summary["gap"] <= 1e-6
        assert check(outcome.directory).status == "verified"
        costs[cost] = outcome.result.cost
        if cost == "worst":
            efforts = effort_at(outcome, vertices(np.full(8, 0.3)))
            assert efforts.max() <= outcome.result.cost
            assert efforts.max() == pytest.approx(outcome.result.cost, rel=1e-7)
    assert costs["nominal"] < costs["worst"] - 0.01
    assert costs["worst"] <= costs["peak"] * (1.0 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changed",
    [
        pytest.param(
            {**PLANE, "disturbance": {"ellipsoid": {"centre": [0, 0], "shape": [[0.02, 0.01], [0.01, 0.03]]}}},
            id="an ellipsoid",
        ),
        pytest.param({"initial_state": {"centre": [0.5], "box": 0.02}}, id="initial states"),
        pytest.param({"weights": [2.0]}, id="a weight"),
    ],
)
def test_sets_and_weights_keep_both_bounds(changed: dict[str, Any], tmp_path: Path) -> None:
    outcome = run({**SCALAR, **changed}, 3, tmp_path / "run")
    assert outcome.status == "certified", outcome.result.message
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]
    assert outcome.result.cost >= outcome.result.lower_bound > 0.1


def test_draws_and_the_adversary_never_cost_more_than_the_largest_effort(tmp_path: Path) -> None:
    outcome = run(DOUBLE, 8, tmp_path / "run")
    rng = np.random.default_rng(0)
    draws = rng.uniform(-0.3, 0.3, (2000, 8))
    assert effort_at(outcome, draws).max() <= outcome.result.cost


@pytest.mark.slow
@pytest.mark.parametrize("pressed", [False, True])
def test_a_search_that_is_ended_leaves_an_honest_gap(
    pressed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After three rounds, or by a key within the sixth program; the cost is then that of `peak`, where it begins."""
    calls, solve = [0], GrowingProgram.solve

    def interrupted(self: GrowingProgram, seconds: float = np.inf) -> Any:
        calls[0] += 1
        if pressed and calls[0] == 6:
            raise KeyboardInterrupt
        return solve(self, seconds)

    monkeypatch.setattr(GrowingProgram, "solve", interrupted)
    problem, method = {**DOUBLE, "disturbance": {"box": 0.1}}, {"name": "exchange", "rounds": 3}
    outcome = run(problem, 20, tmp_path / "run", **({} if pressed else {"method": method}))
    assert outcome.status == "verified", outcome.result.message
    assert outcome.result.cost == pytest.approx(1.73666667, rel=1e-6)
    assert 0.1 < outcome.result.lower_bound < outcome.result.cost
    found = check(outcome.directory)
    assert found.status == "verified", [claim for claim in found.claims if claim.verdict != "holds"]


def test_forged_costs_and_multipliers_of_an_effort_are_refused(tmp_path: Path) -> None:
    outcome = run(SCALAR, 3, tmp_path / "run")
    certificate = json.loads((outcome.directory / "certificate.json").read_text())
    entries = certificate["multipliers"]["constraints"]
    assert any(entry["constraint"] == "effort" for entry in entries)

    def verdicts(changed: dict[str, Any]) -> dict[str, str]:
        copy = tmp_path / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(outcome.directory, copy)
        (copy / "certificate.json").write_text(json.dumps({**certificate, **changed}))
        return {claim.name: claim.verdict for claim in check(copy).claims}

    def multipliers(change: Any) -> dict[str, Any]:
        told = [change(entry) if entry["constraint"] == "effort" else entry for entry in entries]
        return {"multipliers": {**certificate["multipliers"], "constraints": told}}

    assert set(verdicts({}).values()) == {"holds"}
    assert verdicts({"cost": certificate["cost"] * (1.0 - 1e-7)})["cost"] == "fails"
    assert (
        verdicts({"gains": [[[[1.1 * v for v in row] for row in k] for k in j] for j in certificate["gains"]]})["cost"]
        == "fails"
    )
    for change in (
        lambda e: {**e, "multiplier": 1.5 * e["multiplier"]},
        lambda e: {**e, "direction": [2.0 * v for v in e["direction"]]},
        lambda e: {**e, "direction": [-v for v in e["direction"]]},
        lambda e: {**e, "direction": e["direction"][:-1]},
        lambda e: {**e, "disturbance": [[1.5 * v for v in row] for row in e["disturbance"]]},
    ):
        assert verdicts(multipliers(change))["lower bound"] == "fails"


@pytest.mark.slow
def test_affine_answers_are_the_best_of_all_causal_ones_for_the_worst_effort_of_a_spring(tmp_path: Path) -> None:
    """The bound over trees of signals meets the bound over affine policies; forged shares are refused."""
    spring = {**SCALAR, **PLANE, "horizon": 5.0, "disturbance": {"box": [0.2, 0.2]}, "terminal": [{"box": [0.3, 0.3]}]}
    spring["path"] = [{"box": [0.7, None], "from": 0.5}]
    outcome = run(spring, 10, tmp_path / "run", policy={"name": "affine", "cost": "worst"})
    lower = outcome.summary["causal_lower_bound"]
    assert outcome.status == "certified" and outcome.result.cost == pytest.approx(1.95941876, rel=1e-7)
    assert outcome.result.lower_bound * (1.0 - 1e-6) <= lower <= outcome.result.cost
    assert check(outcome.directory).status == "verified"
    file = outcome.directory / "certificate.json"
    certificate = json.loads(file.read_text())
    shares = certificate["causal"]["shares"]
    for wrong in ([2.0 * v for v in shares], shares[:-1], [-v for v in shares], [0.0 for _ in shares], None, "1"):
        file.write_text(json.dumps({**certificate, "causal": {**certificate["causal"], "shares": wrong}}))
        assert {one.name: one.verdict for one in check(outcome.directory).claims}["causal"] == "fails"


def test_the_norm_of_all_channels_together_is_refused(tmp_path: Path) -> None:
    with pytest.raises(sr.InputError, match="group"):
        run({**SCALAR, "cost": {"group": True}}, 3, tmp_path / "run")
