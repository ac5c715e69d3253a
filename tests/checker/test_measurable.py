"""Guards checker: runs with measurable disturbances and without feedback are verified, forgeries of them are not."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.checker.claims import claims
from tests.checker.test_check import DECAY, SPRING, on
from tests.support.tampering import Forgery, forged

STIRRED = {**SPRING, "disturbance_class": "measurable", "disturbance": {"box": [0.03, 0.03]}}
WARM = {
    **DECAY,
    "system": {"A": [[-1.0]], "B": [[1]]},
    "disturbance": {"box": [0.1]},
    "disturbance_class": "measurable",
}
KINDS: dict[str, tuple[dict[str, Any], str]] = {
    "box": (on(10, STIRRED), "certified"),
    "1-norm": (on(10, {**STIRRED, "disturbance": {"norm": {"p": 1.0, "radius": 0.03}}}), "certified"),
    "ball": (on(6, {**STIRRED, "disturbance": {"norm": {"p": 2.0, "radius": 0.03}}}), "certified"),
    "initial states": (on(6, {**WARM, "initial_state": {"centre": [2], "box": [0.05]}}), "certified"),
    "mixed": (on(6, {**WARM, "path": [{"mixed": {"H": [[1.0]], "G": [[0.3]], "h": [1.9]}, "from": 0.2}]}), "certified"),
    "nominal": (on(6, WARM, method={"name": "nominal"}), "refuted"),
    "too much": (on(6, {**WARM, "disturbance": {"box": [1.0]}}), "infeasible"),
}


def run(kind: str, tmp_path: Path) -> Path:
    config, status = KINDS[kind]
    outcome = sr.run(copy.deepcopy(config), out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.result.status == status
    return tmp_path / "run"


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", KINDS)
def test_every_claim_about_measurable_disturbances_holds(kind: str, tmp_path: Path) -> None:
    found = sr.check(run(kind, tmp_path))
    assert [claim for claim in found.claims if claim.verdict != "holds"] == []


def test_measurable_disturbances_cost_more_than_those_on_pieces(tmp_path: Path) -> None:
    """So a proof for pieces is none for them."""
    on_pieces = {**STIRRED, "disturbance_class": "piecewise_constant"}
    sr.run(on(10, on_pieces), out=tmp_path / "run", quiet=True, figures=False)

    def change(files: Forgery) -> None:
        files.problem["disturbance_class"] = "measurable"

    found = sr.check(forged(tmp_path / "run", tmp_path / "forged", change, consistent=True))
    assert found.status == "refuted"
    assert "fails" in [claim.verdict for claim in found.claims if claim.name in ("path", "terminal")]


@pytest.mark.parametrize("step", [1e-6, -1e-6])
def test_a_control_that_was_changed_is_not_verified(step: float, tmp_path: Path) -> None:
    def change(files: Forgery) -> None:
        files.decision[0][-1] += step

    assert (
        sr.check(forged(run("initial states", tmp_path), tmp_path / "forged", change, consistent=True)).status
        != "verified"
    )


def test_a_higher_lower_bound_and_another_violation_are_refuted(tmp_path: Path) -> None:
    def higher(files: Forgery) -> None:
        files.certificate["lower_bound"] += 1e-6

    def farther(files: Forgery) -> None:
        files.certificate["witness"]["violation"] *= 1.001

    for kind, change in (("box", higher), ("nominal", farther)):
        place = tmp_path / kind
        place.mkdir()
        assert sr.check(forged(run(kind, place), place / "forged", change, consistent=True)).status == "refuted"


def test_a_lower_bound_above_the_cost_of_what_keeps_everything_is_a_contradiction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two proofs of one run cannot say that; where a derivation is wrong, the check says so."""
    place, derive = run("box", tmp_path), claims.multiplied
    monkeypatch.setattr(claims, "multiplied", lambda case, priced: derive(case, priced) * (1 + 1e-3 * priced))
    found = {claim.name: claim for claim in sr.check(place).claims}
    assert found["lower bound"].verdict == "holds" and found["status"].verdict == "fails"
    assert "yet one that keeps every constraint costs" in found["status"].text
