"""Guards checker/program/claims where a claim is missing, excused or named like another one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import InputError
from tests.support.stated import GAP, certify, judge, state

NEAR = (None, -9.0, 9.0)


def verdicts(program: Any, data: dict[str, Any]) -> dict[str, str]:
    return {name: finding.verdict for name, finding in judge(program, data).items()}


@pytest.mark.parametrize("status", ["certified", "verified", "refuted"])
def test_a_status_without_a_decision_does_not_hold(status: str) -> None:
    program = state({"x": NEAR}, "x", "x >= t - t**2")
    data = {**certify(program), "status": status, "decision": None, "lower_bound": None, "cost": -7.0}
    assert "fails" in verdicts(program, data).values()


def test_what_rows_without_an_index_excuse_has_a_price() -> None:
    program = state({"a": None, "b": (None, -1e6, 1e6)}, "a - b", "a <= 2e6 + t", finite=["a >= b"])
    data = certify(program)
    assert set(verdicts(program, data).values()) == {"holds"}
    low = {**data, "status": "certified", "decision": [1e6 - 1e-4, 1e6], "cost": float((1e6 - 1e-4) - 1e6)}
    found = verdicts(program, {**low, "lower_bound": 0.0})
    assert found["status"] == "fails"


def test_the_bound_and_the_proof_are_about_one_row() -> None:
    """0.1 * 3 is not 0.3 in doubles, and a large factor shows it: no certificate holds for both readings."""
    program = state({"a": (None, -9.0, 9.0)}, "-a", "1e16*(a*0.1*3 - a*0.3) + 0*t <= 1")
    data = certify(program)
    low = verdicts(program, {**data, "status": "verified", "decision": [3.5], "cost": -3.5})
    assert low["f"] != "holds" or low["lower bound"] != "holds" or data["lower_bound"] <= -3.5


def test_no_family_is_named_like_a_claim() -> None:
    for name in ("lower bound", "status", "objective"):
        with pytest.raises(InputError, match=r"families\.0\.name"):
            sr.run(
                {
                    "problem": {
                        "name": "program",
                        "decision": {"x": {}},
                        "minimise": "x",
                        "families": [{"name": name, "index": {"t": [0, 1]}, "rows": ["x >= t"]}],
                    }
                }
            )


def test_a_square_without_a_weight_changes_no_bound() -> None:
    program = state({"x": NEAR}, "x + 0*x**2", "x >= t - t**2")
    assert set(verdicts(program, certify(program)).values()) == {"holds"}


def test_a_decision_of_another_length_is_a_verdict(tmp_path: Path) -> None:
    config = {
        "problem": {
            "name": "program",
            "decision": {"x": {}},
            "minimise": "x",
            "families": [{"name": "f", "index": {"t": [0, 1]}, "rows": ["x >= t - t^2"]}],
        },
        "regulariser": None,
    }
    sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    assert sr.check(tmp_path / "run").status == "verified"
    path = tmp_path / "run/certificate.json"
    data = json.loads(path.read_text())
    for decision in ([0.25, 0.25], [], [None], "x", None):
        path.write_text(json.dumps({**data, "decision": decision}))
        assert sr.check(tmp_path / "run").status == "refuted"


def test_an_excuse_beside_a_small_cost_keeps_the_gap_open() -> None:
    program = state({"d": (None, 0.0, 1.0)}, "d", "d >= 1e-9*t")
    data = certify(program)
    if data["status"] == "certified":
        assert data["cost"] >= 1e-9 * (1.0 - 1e-6)
    low = {**data, "status": "certified", "decision": [5e-10], "cost": 5e-10, "lower_bound": 5e-10}
    assert verdicts(program, low)["status"] != "holds"
    assert GAP < 1.0 and np.isfinite(data["cost"])


@pytest.mark.parametrize(("excess", "verdict"), [(0.5e-9, "holds"), (3e-9, "fails")])
def test_a_row_without_an_index_is_violated_by_a_billionth_of_its_terms_and_no_more(
    excess: float, verdict: str
) -> None:
    program = state({"x": (None, -9.0, 9.0)}, "x", "x >= t - 2", finite=["x >= 1"])
    data = certify(program)
    moved = {**data, "decision": [1.0 - 2.0 * excess], "cost": 1.0 - 2.0 * excess}
    assert judge(program, moved)["bounds and rows"].verdict == verdict


@pytest.mark.parametrize(("share", "verdict"), [(0.5, "holds"), (3.0, "fails")])
def test_a_gap_of_a_few_times_the_tolerance_is_not_closed(share: float, verdict: str) -> None:
    program = state({"x": (None, -9.0, 9.0)}, "x", "x >= 1 + t")
    data = certify(program)
    wide = {**data, "lower_bound": data["cost"] - share * GAP * data["cost"]}
    assert judge(program, wide)["status"].verdict == verdict
