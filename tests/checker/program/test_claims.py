"""Guards checker/program/claims: certificates of small programs hold, and every number that is forged fails, with a
verdict and without a traceback."""

from __future__ import annotations

import copy
import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from sparserob_core.sip.stated.statement import StatedDecision, StatedFamily, StatedProgram
from tests.support.stated import GAP, certify, judge, state

Data = dict[str, Any]
NEAR = (None, -9.0, 9.0)  # a single entry with bounds, in programs that are not about entries without
# programs with their least costs, in closed form or from the named source
PROGRAMS: dict[str, tuple[Callable[[], StatedProgram], float]] = {
    "one entry": (lambda: state({"x": NEAR}, "x", "x >= t - t**2"), 0.25),
    "one-sided approximation": (  # right Radau's quadrature with two nodes
        lambda: state({"a": 3}, "a[0] + a[1]/2 + a[2]/3", "sum(a[k]*t**k for k in range(3)) >= 1/(2-t)"),
        0.7,
    ),
    "monic polynomial": (  # Chebyshev: 2^(1-n)
        lambda: state(
            {"a": 3, "d": None}, "d", "-d <= t**3 + sum(a[k]*t**k for k in range(3)) <= d", index={"t": (-1.0, 1.0)}
        ),
        0.25,
    ),
    "a diagonal square": (lambda: state({"x": None}, "(x-1)**2", "x <= 0.5 + (t-0.5)**2"), 0.25),
    "products": (lambda: state({"x": None, "y": None}, "x*x + x*y + y*y", "x + y >= 2*t"), 3.0),
    "absolute values": (lambda: state({"a": 2}, "abs(a[0]) + 3*abs(a[1])", "a[0] + a[1]*t >= 1 + t"), 2.0),
    "residuals": (lambda: state({"x": None}, "(x-3)**2 + abs(x-1)", "x <= 2 + t"), 2.0),
    "bounds": (lambda: state({"x": (None, -1.0, 4.0), "y": (None, 0.5, 2.0)}, "2*y - x", "x <= 3 + t"), -2.0),
    "an equality": (lambda: state({"x": None, "y": None}, "x", "y <= 4 + t", finite=["x + y == 1"]), -3.0),
    "two coordinates": (
        lambda: state({"x": NEAR}, "x", "x >= sin(p*q)", index={"p": (0.0, 1.0), "q": (0.0, 1.0)}),
        float(np.sin(1.0)),
    ),
    "a table": (
        lambda: state({"x": NEAR}, "x", "x >= sum(c[k]*t**k for k in range(3))", tables={"c": [1.0, 2.0, -1.0]}),
        2.0,
    ),
    "a modulus of the index": (
        lambda: state({"x": NEAR}, "x", "x >= 1 - abs(t - 0.25)"),
        1.0,
    ),
}


@functools.cache
def solved(name: str) -> tuple[StatedProgram, Data]:
    program = PROGRAMS[name][0]()
    return program, certify(program)


def forge(data: Data, **changes: Any) -> Data:
    return {**copy.deepcopy(data), **changes}


def verdicts(program: StatedProgram, data: Data, **options: Any) -> dict[str, str]:
    return {name: finding.verdict for name, finding in judge(program, data, **options).items()}


@pytest.mark.parametrize("name", PROGRAMS)
def test_true_certificates_hold_and_their_values_are_known(name: str) -> None:
    program, data = solved(name)
    assert data["status"] == "certified"
    assert data["cost"] == pytest.approx(PROGRAMS[name][1], abs=1e-7)
    assert data["lower_bound"] <= PROGRAMS[name][1] + 1e-9
    found = judge(program, data)
    assert {finding.verdict for finding in found.values()} == {"holds"}, found
    assert list(found) == ["objective", "lower bound", "bounds and rows", "f", "status"]


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_cost_and_a_lower_bound_that_are_moved_fail(name: str) -> None:
    program, data = solved(name)
    for change in (1e-6, -1e-6):
        found = verdicts(program, forge(data, cost=data["cost"] + change))
        assert found["objective"] == "fails" == found["status"]
    found = verdicts(program, forge(data, lower_bound=data["lower_bound"] + 1e-6))
    assert found["lower bound"] == "fails" == found["status"]
    found = verdicts(program, forge(data, lower_bound=data["lower_bound"] - 1e-3))
    assert found["lower bound"] == "holds" and found["status"] == "fails"  # true, but the gap is open


def test_a_violation_between_the_points_of_a_grid_is_found() -> None:
    """The row is active at ``1/2``, and nowhere else."""
    program, data = solved("one entry")
    for change, verdict in ((-1e-7, "fails"), (-3e-9, "fails"), (1e-9, "holds")):
        decision = [data["decision"][0] + change]
        found = judge(program, forge(data, decision=decision, cost=decision[0]))
        assert found["f"].verdict == verdict
        assert verdict == "holds" or "t = 0." in found["f"].text


@pytest.mark.parametrize("name", ["one-sided approximation", "monic polynomial", "two coordinates"])
def test_a_decision_that_is_moved_a_little_out_of_its_rows_fails(name: str) -> None:
    program, data = solved(name)
    decision = list(data["decision"])
    decision[-1 if name == "monic polynomial" else 0] -= 1e-7
    assert verdicts(program, forge(data, decision=decision))["f"] == "fails"


MULTIPLIERS: dict[str, Callable[[Data], Any]] = {
    "no multiplier but 0": lambda m: [entry.update(multiplier=0.0) for entry in m["constraints"]],
    "a negative one": lambda m: m["constraints"][0].update(multiplier=-1.0),
    "no number": lambda m: m["constraints"][0].update(multiplier=float("nan")),
    "text": lambda m: m["constraints"][0].update(multiplier="1"),
    "nothing": lambda m: m["constraints"][0].pop("multiplier"),
    "an index outside": lambda m: m["constraints"][0].update(index=[1.0 + 1e-9] * len(m["constraints"][0]["index"])),
    "an index of NaN": lambda m: m["constraints"][0].update(index=[float("nan")]),
    "an index of more numbers": lambda m: m["constraints"][0].update(index=[0.5] * 3),
    "an index that is no list": lambda m: m["constraints"][0].update(index=0.5),
    "a family": lambda m: m["constraints"][0].update(family="g"),
    "a family that is a list": lambda m: m["constraints"][0].update(family=["f"]),
    "a row": lambda m: m["constraints"][0].update(row=2),
    "a negative row": lambda m: m["constraints"][0].update(row=-1),
    "a row that is true": lambda m: m["constraints"][0].update(row=True),
    "half a row": lambda m: m["constraints"][0].update(row=0.5),
    "no constraints": lambda m: m.update(constraints=[]),
    "constraints that are a number": lambda m: m.update(constraints=3),
    "a constraint that is a number": lambda m: m.update(constraints=[3]),
    "more rows": lambda m: m.update(rows=[0.0]),
    "more equalities": lambda m: m.update(equalities=[0.0] * 9),
    "equalities of NaN": lambda m: m.update(equalities=[float("nan")]),
    "a tangent of another length": lambda m: m.update(tangent=[0.0] * 17),
    "a tangent that is text": lambda m: m.update(tangent="here"),
}


@pytest.mark.parametrize("kind", MULTIPLIERS)
@pytest.mark.parametrize("name", ["one-sided approximation", "a diagonal square", "products"])
def test_forged_multipliers_prove_no_bound(name: str, kind: str) -> None:
    program, data = solved(name)
    forged = forge(data)
    MULTIPLIERS[kind](forged["multipliers"])
    found = verdicts(program, forged)
    assert found["lower bound"] in ("fails", "not checked") and found["status"] != "holds"


@pytest.mark.parametrize("value", [None, 3, "x", [], [1.0], {}, float("nan"), [[1.0]], True])
@pytest.mark.parametrize(
    "key", ["decision", "cost", "lower_bound", "multipliers", "gap_tolerance", "status", "witness"]
)
def test_no_value_of_another_kind_is_believed_and_none_ends_in_a_traceback(key: str, value: object) -> None:
    program, data = solved("two coordinates")
    found = verdicts(program, forge(data, **{key: value}))
    assert found
    if key != "witness":
        assert found.get("status", "not checked") != "holds"
    missing = {name: entry for name, entry in copy.deepcopy(data).items() if name != key}
    assert key == "witness" or verdicts(program, missing).get("status", "not checked") != "holds"


def test_another_status_has_claims_of_its_own() -> None:
    program, data = solved("one entry")
    assert verdicts(program, forge(data, status="verified"))["status"] == "holds"
    assert verdicts(program, forge(data, status="verified", lower_bound=None))["status"] == "holds"
    assert verdicts(program, forge(data, status="infeasible"))["infeasibility"] != "holds"
    assert verdicts(program, forge(data, status="refuted"))["violation"] == "fails"
    assert verdicts(program, forge(data, status="optimal"))["status"] == "fails"
    assert "status" not in verdicts(program, forge(data, status="undecided"))


def test_a_gap_is_held_against_the_tolerance_of_the_config() -> None:
    program, data = solved("one entry")
    wide = forge(data, gap_tolerance=1e-2, lower_bound=data["lower_bound"] - 1e-3)
    assert verdicts(program, wide)["status"] == "fails"
    assert verdicts(program, wide, gap=1e-2)["status"] == "holds"
    assert verdicts(program, data, gap=None)["status"] == "fails"
    assert verdicts(program, data, gap=GAP / 2)["status"] == "fails"


def test_families_that_are_swapped_fail() -> None:
    entries = {"x": StatedDecision(None, 0.0, 9.0), "y": StatedDecision(None, 0.0, 9.0)}
    families = [
        StatedFamily("first", {"t": (0.0, 1.0)}, ["x >= t"]),
        StatedFamily("second", {"t": (0.0, 1.0)}, ["y >= 2*t"]),
    ]
    program = StatedProgram(entries, "3*x + y", families)
    data = certify(program)
    assert data["cost"] == pytest.approx(5.0, abs=1e-7)
    assert set(verdicts(program, data).values()) == {"holds"}
    forged = forge(data)
    for entry in forged["multipliers"]["constraints"]:
        entry["family"] = {"first": "second", "second": "first"}[entry["family"]]
    found = judge(program, forged)
    assert found["lower bound"].verdict != "holds" and found["status"].verdict != "holds"


def test_what_has_no_solution_is_shown_by_multipliers_and_by_no_others() -> None:
    program = state({"x": (None, 0.0, 1.0)}, "x", "x >= 0.5 + t")
    data = certify(program)
    assert data["status"] == "infeasible"
    assert verdicts(program, data) == {"infeasibility": "holds"}
    for change in ({"index": [0.4]}, {"multiplier": 0.0}):
        forged = forge(data)
        for entry in forged["multipliers"]["constraints"]:
            entry.update(change)
        assert verdicts(program, forged)["infeasibility"] != "holds"
    feasible = state({"x": (None, 0.0, 2.0)}, "x", "x >= 0.5 + t")
    assert verdicts(feasible, data)["infeasibility"] != "holds"


def test_entries_without_bounds_have_no_solution_together() -> None:
    program = state({"x": None, "y": None}, "x", "x >= y + t", "x <= y + 0.5")
    data = certify(program, seconds=10)
    assert data["status"] == "infeasible"
    assert verdicts(program, data) == {"infeasibility": "holds"}


def test_a_decision_is_refuted_by_a_witness_alone() -> None:
    program, data = solved("one entry")
    witness = {"family": "f", "index": [0.5], "row": 0, "violation": 0.05}
    low = forge(data, status="refuted", decision=[0.2], cost=0.2, witness=witness)
    assert set(verdicts(program, low).values()) == {"holds"}
    for change in (
        {"index": [0.1]},
        {"index": [1.5]},
        {"row": 1},
        {"family": "g"},
        {"index": [0.5, 0.5]},
        {"row": "0"},
    ):
        assert verdicts(program, {**low, "witness": {**witness, **change}})["violation"] == "fails"
    assert verdicts(program, {**low, "decision": [0.25], "cost": 0.25})["violation"] == "fails"


def test_the_bounds_and_rows_without_an_index_are_looked_at() -> None:
    program, data = solved("bounds")
    x, y = data["decision"]
    for decision in ([x, y - 1e-6], [4.5, y], [x, 2.1]):
        cost = 2 * decision[1] - decision[0]
        assert verdicts(program, forge(data, decision=decision, cost=cost))["bounds and rows"] == (
            "holds" if decision[0] <= 4.0 and 0.5 <= decision[1] <= 2.0 else "fails"
        )
    program, data = solved("an equality")
    x, y = data["decision"]
    assert verdicts(program, forge(data, decision=[x - 1e-9, y], cost=x - 1e-9))["bounds and rows"] == "fails"


def test_residuals_of_a_decision_are_not_believed() -> None:
    """The cost is that of the named entries, whatever the entries after them say."""
    program, data = solved("residuals")
    decision = [data["decision"][0], *(0.0 for _ in data["decision"][1:])]
    assert verdicts(program, forge(data, decision=decision))["objective"] == "holds"
    assert verdicts(program, forge(data, decision=decision, cost=0.0))["objective"] == "fails"


def test_an_objective_that_is_not_convex_has_no_lower_bound() -> None:
    _, data = solved("products")
    concave = state({"x": None, "y": None}, "x*x + 3*x*y + y*y", "x + y >= 2*t")
    found = verdicts(concave, data)
    assert found["lower bound"] in ("fails", "not checked") and found["status"] != "holds"


def test_a_check_without_time_is_not_made() -> None:
    program, data = solved("two coordinates")
    found = verdicts(program, data, seconds=0.0)
    assert found["f"] == "not checked" and found["status"] == "not checked"


@pytest.mark.parametrize(
    "row",
    [
        "sin(t)", "cos(3*t)", "tan(t)", "exp(-t)", "log(t + 1)", "sqrt(t + 1)", "tanh(4*t)", "abs(t - 0.3)", "t**3",
        "(t + 1)**-2", "(t + 1)**0.5", "(t + 1)**t", "2**t", "1/(t + 1)", "chebyshev(4, t)", "pi*t + e", "-t/3",
        "sum(t**k for k in range(4))", "sum(sum(t**j for j in range(k)) for k in range(4))",
        "sum(chebyshev(k, t/(k + 1)) for k in range(3))", "t**0", "((t + 1)/2)**65",
    ],
)  # fmt: skip
def test_every_function_of_the_language_is_checked(row: str) -> None:
    """A row holds where it is a little loose, and fails where a dense grid violates it."""
    grid = np.linspace(0.0, 1.0, 4001)
    scope = {name: getattr(np, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "abs", "pi", "e")}
    scope["chebyshev"] = lambda k, t: np.polynomial.chebyshev.chebval(t, [0.0] * k + [1.0])
    with np.errstate(all="ignore"):
        top = np.max(eval(row, {**scope, "t": grid, "sum": sum}) + 0.0 * grid)
    program = state({"x": None}, "x", f"{row} <= x")
    data = {"status": "verified", "lower_bound": None, "gap_tolerance": GAP}
    for margin, verdict in ((1e-5, "holds"), (-1e-6, "fails")):
        x = float(top) + margin * (1.0 + abs(float(top)))
        assert judge(program, {**data, "decision": [x], "cost": x})["f"].verdict == verdict


@pytest.mark.parametrize(
    "row", ["log(t)", "sqrt(t - 0.5)", "1/(t - 0.7)", "tan(4*t)", "(t - 0.25)**-1", "0*log(t - 0.4)"]
)
def test_a_row_that_has_no_value_somewhere_does_not_hold(row: str) -> None:
    program = state({"x": None}, "x", f"-1e9*({row}) <= x")
    data = {"status": "verified", "lower_bound": None, "gap_tolerance": GAP, "decision": [1e6], "cost": 1e6}
    found = verdicts(program, data)
    assert found["f"] != "holds" and found["status"] != "holds"


def test_every_number_of_a_certificate_that_is_moved_or_replaced_has_a_verdict() -> None:
    """Whatever the place; a certificate that still holds claims no better bounds than the true one."""
    program, data = solved("monic polynomial")
    places = list(_list_places(data, ()))
    rng = np.random.default_rng(2)
    for place, change in itertools.product(places, (0.3, -1.0, None, "a", [])):
        if rng.uniform() < 0.7:
            continue
        forged = copy.deepcopy(data)
        holder = functools.reduce(lambda part, key: part[key], place[:-1], forged)
        old = holder[place[-1]]
        holder[place[-1]] = old + change if isinstance(change, float) and type(old) is float else change
        found = verdicts(program, forged)
        if all(verdict == "holds" for verdict in found.values()) and forged["status"] == "certified":
            assert forged["cost"] == data["cost"] and forged["lower_bound"] <= 0.25 + 1e-9


def _list_places(data: Any, place: tuple[Any, ...]) -> Any:
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield (*place, key)
            yield from _list_places(value, (*place, key))
