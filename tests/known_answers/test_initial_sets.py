"""Guards initial states in a set: known answers, what a config may say, reasons, worst cases, margins, forgeries."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.check.check import check
from tests.known_answers.test_checks import SPRING, pieces, verified
from tests.support.tampering import Forgery, copied, forged

DOUBLE: dict[str, Any] = {
    "name": "linear",
    "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
    "horizon": 5.0,
    "initial_state": [4, 0],
    "control": {"box": 1.0},
    "disturbance": {"box": [0.02, 0.02]},
    "terminal": [{"box": [0.5, 0.3]}],
}
BOX = {"centre": [-1, 1], "box": [0.03, 0.05]}


def solved(problem: dict[str, Any], count: int = 50, **keys: Any) -> sr.Outcome:
    loaded = {"problem": problem, "dictionaries": {"control": pieces(count)}, "observers": [], **keys}
    return sr.run(loaded, quiet=True, figures=False)


def test_a_box_of_initial_states_costs_what_an_independent_program_says(tmp_path: Path) -> None:
    summary = verified(tmp_path / "run", {**SPRING, "initial_state": BOX}, pieces(50))
    assert summary["cost"] == pytest.approx(0.502958, abs=1e-6)
    worst = np.abs(np.array(summary["worst"]["initial_state"]) - [-1, 1])
    np.testing.assert_allclose(worst, [0.03, 0.05], rtol=1e-12)


def test_a_set_of_initial_states_shrinks_the_terminal_set_of_an_integrator(tmp_path: Path) -> None:
    """x1(5) is moved by 0.02 + 5 * 0.01 and x2(5) by 0.01: the same as a smaller terminal set from the centre."""
    begun = verified(tmp_path / "run", {**DOUBLE, "initial_state": {"centre": [4, 0], "box": [0.02, 0.01]}}, pieces(50))
    smaller = solved({**DOUBLE, "terminal": [{"box": [0.5 - 0.07, 0.3 - 0.01]}]}).result
    assert begun["cost"] == pytest.approx(smaller.cost, rel=1e-9)
    assert begun["cost"] > 1.6 + 1e-3


def test_the_farthest_initial_state_decides_at_an_uncertain_rate(tmp_path: Path) -> None:
    """Scalar, x' = -a x + u from 2 - 0.1 to 2 + 0.1: what 2.1 costs, in closed form."""
    problem = {
        "name": "linear",
        "system": {"A": [["-a"]], "B": [[1]], "parameters": {"a": [0.5, 1.0]}},
        "horizon": 1.0,
        "initial_state": {"centre": 2, "box": 0.1},
        "control": {"box": 1.0},
        "terminal": [{"box": [0.5]}],
    }
    known = max(-math.log(1 - a * (2.1 * math.exp(-a) - 0.5)) / a for a in np.linspace(0.5, 1.0, 1001))
    summary = verified(tmp_path / "run", problem, pieces(60))
    assert known - 1e-9 <= summary["cost"] <= known + 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("deviations", "end"),
    [
        ({"polytope": {"H": [[1, 1], [-1, 0.2], [0, -1]], "h": [0.03, 0.02, 0.01]}}, {"box": 0.35}),
        pytest.param(
            {"ellipsoid": {"shape": [[0.0009, 0.0003], [0.0003, 0.0025]]}}, {"box": 0.35}, marks=pytest.mark.slow
        ),
        pytest.param({"norm": {"p": 1, "radius": 0.05}}, {"norm": {"p": 2, "radius": 0.4}}, marks=pytest.mark.slow),
    ],
    ids=("polytope", "ellipsoid", "norm"),
)
def test_sets_of_every_kind_are_certified_and_verified_under_uncertainty(
    deviations: dict[str, Any], end: dict[str, Any], tmp_path: Path
) -> None:
    system = {"A": [[0, 1], ["-2 + p", -0.5]], "B": [[0, 0.5], [1, 0]], "parameters": {"p": [-0.05, 0.05]}}
    start = {"initial_state": {"centre": [-1, 1], **deviations}}
    problem = {**SPRING, **start, "system": system, "terminal": [end]}
    single = solved({**problem, "initial_state": [-1, 1]}, 16).result
    dictionary = {"name": "haar", "pieces": 16}
    assert verified(tmp_path / "run", problem, dictionary, pieces(16))["cost"] > single.cost + 1e-4


@pytest.mark.slow
def test_a_set_without_a_centre_beside_it_is_where_it_says() -> None:
    one = solved({**SPRING, "initial_state": BOX}).result
    for other in (
        {"box": {"lower": [-1.03, 0.95], "upper": [-0.97, 1.05]}},
        {"polytope": {"H": [[1, 0], [-1, 0], [0, 1], [0, -1]], "h": [-0.97, 1.03, 1.05, -0.95]}},
    ):
        assert solved({**SPRING, "initial_state": other}).result.cost == pytest.approx(one.cost, rel=1e-7)
    ball = {"ellipsoid": {"centre": [-1, 1], "shape": 0.0009}}
    beside = {"centre": [-1, 1], "norm": {"p": 2, "radius": 0.03}}
    costs = [solved({**SPRING, "initial_state": start}).result.cost for start in (ball, beside)]
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)


def test_a_set_of_one_point_is_that_point_and_a_complete_config_says_the_same(tmp_path: Path) -> None:
    start = {"centre": [-1, 1], "norm": {"p": 2, "radius": 0}}
    outcome = sr.run(
        {"problem": {**SPRING, "initial_state": start}, "observers": []}, out=tmp_path / "a", figures=False
    )
    plain = sr.run({"problem": SPRING, "observers": []}, out=tmp_path / "b", figures=False)
    assert outcome.result.cost == plain.result.cost
    again = sr.run(tmp_path / "a" / "config.yaml", out=tmp_path / "c", quiet=True, figures=False)
    assert again.result.cost == plain.result.cost


@pytest.mark.parametrize(
    ("start", "place", "said"),
    [
        ({"centre": [-1, 1]}, "initial_state", "expected a set"),
        ({"centre": [-1, 1, 0], "box": 0.1}, "initial_state.centre", "expected 2 numbers"),
        ({"centre": [-1, 1], "box": [0.1, 0.1, 0.1]}, "initial_state.box", "expected 2 numbers"),
        ({"centre": [-1, 1], "box": [0.1, None]}, "initial_state", "bounded"),
        ({"centre": [-1, 1], "box": {"lower": 0.1, "upper": 0.2}}, "initial_state", "holds 0"),
        ({"centre": [-1, 1], "ellipsoid": {"centre": [-1, 1], "shape": 1}}, "initial_state.ellipsoid.centre", "one c"),
        ({"centre": [-1, 1], "norm": {"p": 1, "radius": 1, "centre": 0.0}}, "initial_state.norm.centre", "one centre"),
        ({"center": [-1, 1], "box": 0.1}, "initial_state.center", "unknown key"),
        ({"centre": [-1, 1], "box": 0.1, "ellipsoid": {"shape": 1}}, "initial_state", "cannot be intersected"),
        ("origin", "initial_state", "expected a number, a list of numbers, or {centre"),
        (True, "initial_state", "expected a number, a list of numbers, or {centre"),
    ],
)
def test_a_wrong_set_of_initial_states_is_told_with_its_place(start: Any, place: str, said: str) -> None:
    with pytest.raises(sr.InputError) as caught:
        solved({**SPRING, "initial_state": start})
    assert f"problem.{place}" in str(caught.value) and said in str(caught.value), str(caught.value)


def test_a_record_with_a_wrong_set_is_refused() -> None:
    system = sr.LinearSystem(np.zeros((2, 2)), np.eye(2))
    for bound in (sr.Box([-1], [1]), sr.Box([-1, -1], [1, np.inf]), sr.Box([0.1, 0.1], [0.2, 0.2]), 0.1):
        with pytest.raises(sr.InputError, match="initial_set"):
            sr.OptimalControlProblem(
                system=system, horizon=1.0, initial_state=[0, 0], control=sr.Box([-1, -1], [1, 1]), initial_set=bound
            )


def test_what_the_set_alone_moves_too_far_is_infeasible_with_that_reason(tmp_path: Path) -> None:
    wide = {**DOUBLE, "disturbance": None, "initial_state": {"centre": [4, 0], "box": [0.1, 0.2]}}
    result = solved(wide).result
    assert result.status == "infeasible"
    assert "the initial state alone moves x1(5) by 1.1, the terminal set allows 0.5" in result.message
    both = solved({**DOUBLE, "initial_state": {"centre": [4, 0], "box": [0.1, 0.2]}}).result
    assert "the disturbance and initial state alone move x1(5)" in both.message
    verified(tmp_path / "run", wide, pieces(50), status="infeasible")
    outside = {**DOUBLE, "path": [{"box": [4.05, None]}], "initial_state": {"centre": [4, 0], "box": [0.1, 0]}}
    said = solved(outside).result
    assert said.status == "infeasible" and "x1(0) = 4.1" in said.message, said.message


def test_a_terminal_equality_is_refused_where_the_set_reaches_the_state_and_kept_where_it_does_not(
    tmp_path: Path,
) -> None:
    """x1' = u1, x2' = -x2 + u2: a deviation of x2 never reaches x1."""
    plain = {
        "name": "linear",
        "system": {"A": [[0, 0], [0, -1]], "B": [[1, 0], [0, 1]]},
        "horizon": 2.0,
        "control": {"box": 1.0},
        "initial_state": {"centre": [1, 0.5], "box": [0, 0.1]},
    }
    kept = verified(tmp_path / "run", {**plain, "terminal": [{"equals": [0, None]}]}, pieces(20))
    assert kept["cost"] == pytest.approx(1.0, rel=1e-9)
    with pytest.raises(
        sr.InputError, match="state 2 depends on the uncertainty, so no control can fix its final value"
    ):
        solved({**plain, "terminal": [{"equals": [None, 0]}]})


@pytest.mark.first(1)
@pytest.mark.parametrize("method", ["nominal", "scenario"])
def test_a_baseline_is_refuted_by_an_initial_state_that_it_did_not_look_at(method: str, tmp_path: Path) -> None:
    entry = {"name": method, **({"scenarios": 20} if method == "scenario" else {})}
    loaded = {
        "problem": {**SPRING, "initial_state": BOX},
        "dictionaries": {"control": pieces(50)},
        "method": entry,
        "observers": [],
    }
    result = sr.run(loaded, out=tmp_path / "run", quiet=True, figures=False).result
    assert result.status == "refuted"
    np.testing.assert_allclose(np.abs(result.worst.initial_state - [-1, 1]), [0.03, 0.05], rtol=1e-12)
    found = check(tmp_path / "run")
    assert {claim.name: claim.verdict for claim in found.claims}["violation"] == "holds", found.claims


@pytest.mark.parametrize("formulation", [pytest.param("literal", marks=pytest.mark.slow), "reduced"])
def test_the_papers_loop_agrees_with_the_exchange(formulation: str) -> None:
    method = {"name": "sparserob", "formulation": formulation, "indices": 6}
    problem = {**SPRING, "initial_state": BOX, "path": [], "disturbance": {"box": [0.02, 0.02]}}
    exact = solved(problem, 10).result
    found = solved(problem, 10, method=method, maximiser={"name": "gradient_ascent", "budget": 200}).result
    assert found.status in ("verified", "certified", "refuted", "undecided")
    assert found.lower_bound <= exact.cost * (1 + 1e-7)
    assert found.lower_bound >= 0.9 * exact.cost


def test_the_worst_cases_begin_in_the_set_and_simulations_draw_from_it(tmp_path: Path) -> None:
    run = {"problem": {**SPRING, "initial_state": BOX}, "dictionaries": {"control": pieces(50)}, "observers": []}
    sr.run(run, out=tmp_path / "run", quiet=True, figures=False)
    stored = np.load(tmp_path / "run" / "adversary.npz")
    np.testing.assert_allclose(np.abs(stored["initial_states"] - [-1, 1]), [[0.03, 0.05]] * 2, rtol=1e-12)
    np.testing.assert_array_equal(stored["states"][:, :, 0], stored["initial_states"])
    worst = {one.name: one.worst for one in sr.simulate(tmp_path / "run", law="adversary").constraints}
    for law in ("iid", "vertices", "slow", "neighbours"):
        found = sr.simulate(tmp_path / "run", 300, law)
        assert not found.contradicts
        assert all(one.largest <= worst[one.name] + 1e-9 for one in found.constraints)
        assert np.abs(found.fan[:, :, 0] - [-1, 1]).max(axis=0) == pytest.approx([0.03, 0.05], rel=0.2)
    replayed = sr.simulate(tmp_path / "run", law="adversary")
    assert all(abs(one.largest - one.worst) <= 1e-9 for one in replayed.constraints)


def test_the_margin_of_the_initial_state_scales_the_set_about_its_centre() -> None:
    """x1(5) may be moved by 0.5 - 0.02 * (5 + 25 / 2) = 0.15 beside the disturbance: the factor is 0.15 / 0.07."""
    start = {"centre": [4, 0], "box": [0.02, 0.01]}
    loaded = {
        "problem": {**DOUBLE, "initial_state": start},
        "dictionaries": {"control": pieces(50)},
        "observers": [],
    }
    found = sr.margin(loaded, "initial_state")
    assert found.status == "certified" and found.quantity == "largest deviation of x_i(0)"
    assert found.lower <= 0.15 / 0.07 <= found.upper + 1e-9
    assert found.upper - found.lower <= 1e-5


def test_minimum_attention_takes_a_box_of_initial_states(tmp_path: Path) -> None:
    """x' = u from 0.95 to 1.05 into |x| <= 0.1: J = rT - sqrt(r^2 T^2 - 4 r xi) with xi = 1.05 - 0.1."""
    problem = {
        "name": "minimum_attention",
        "system": {"A": [[0]], "B": [[1]]},
        "horizon": 4.0,
        "initial_state": {"centre": 1, "box": 0.05},
        "rate": {"box": 1.0},
        "terminal": [{"box": [0.1]}],
    }
    summary = verified(tmp_path / "run", problem, pieces(80))
    known = 4.0 - math.sqrt(16.0 - 4.0 * (1.05 - 0.1))
    assert known - 1e-9 <= summary["cost"] <= known + 2e-3
    with pytest.raises(sr.InputError, match="takes a box of initial states"):
        solved({**problem, "initial_state": {"centre": 1, "ellipsoid": {"shape": 0.01}}})


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("begun")
    for name, method in (("certified", "exchange"), ("refuted", "nominal")):
        loaded = {
            "problem": {**SPRING, "initial_state": BOX},
            "dictionaries": {"control": pieces(20)},
            "method": {"name": method},
            "observers": [],
        }
        sr.run(loaded, out=root / name, quiet=True, figures=False)
    return {name: root / name for name in ("certified", "refuted")}


def _start(**keys: Any) -> Callable[[Forgery], None]:
    return lambda files: files.problem["initial_state"].update(**keys)


def _deviation(value: Any) -> Callable[[Forgery], None]:
    return lambda files: files.certificate["witness"].update(deviation=value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "change"),
    [
        ("certified", _start(box=[0.031, 0.05])),
        ("certified", _start(centre=[-1.001, 1])),
        ("certified", lambda files: files.result["worst"].update(initial_state=[-0.97, 1.05])),
        ("certified", lambda files: files.result["worst"].update(initial_state=[-1.04, 1.05])),
        ("refuted", _deviation([0.0, 0.0])),
        ("refuted", _deviation([0.04, 0.05])),
        ("refuted", _deviation([0.03])),
        ("refuted", _deviation(None)),
        ("refuted", lambda files: files.result["worst"].update(initial_state=[-1.0, 1.0])),
    ],
)
def test_a_forged_set_or_initial_state_is_found(
    run: str, change: Callable[[Forgery], None], honest: dict[str, Path], tmp_path: Path
) -> None:
    assert "fails" not in {claim.verdict for claim in check(honest[run]).claims}
    found = check(forged(honest[run], tmp_path / "forged", change, consistent=True))
    assert "fails" in {claim.verdict for claim in found.claims}, found.claims
    assert copied(honest[run]).certificate["status"] == run


def test_a_certificate_of_a_single_initial_state_does_not_serve_a_set(tmp_path: Path) -> None:
    sr.run(
        {"problem": SPRING, "dictionaries": {"control": pieces(20)}, "observers": []},
        out=tmp_path / "one",
        figures=False,
    )

    def change(files: Forgery) -> None:
        files.problem["initial_state"] = {"centre": [-1, 1], "box": [1e-4, 0]}
        files.result["worst"]["initial_state"] = [-1, 1]

    found = check(forged(tmp_path / "one", tmp_path / "forged", change, consistent=True))
    assert "fails" in {claim.verdict for claim in found.claims}
    assert json.loads((tmp_path / "one" / "result.json").read_text())["status"] == "certified"
