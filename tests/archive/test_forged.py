"""Guards the checker: an archived run in which one number is changed is not found to be what it claims."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sparserob_core.experiment.check.check import check
from tests.archive.store import VERDICTS, unpack
from tests.support.tampering import Forgery, copied, forged

Forging = Callable[[Forgery], None]
A_LITTLE = 1e-4
"""Of the largest cost, by how much a bound is shifted: gaps are a thousand times smaller."""
QUICK = 2.0  # seconds that the check of a run took, to be forged: longer ones are of the same kinds


def scale(files: Forgery) -> float:
    """The size of the costs."""
    return max(float(files.result.get("cost_scale") or 1.0), 1e-3)


def bound_raised(files: Forgery) -> None:
    files.certificate["lower_bound"] += A_LITTLE * scale(files)


def cost_lowered(files: Forgery) -> None:
    files.certificate["cost"] -= A_LITTLE * scale(files)


def control_changed(files: Forgery) -> None:
    """The largest value is a hundredth smaller: what it reaches is missed, or the cost is not what is said."""
    channel = max(files.decision, key=lambda row: max(map(abs, row)))
    place = max(range(len(channel)), key=lambda k: abs(channel[k]))
    channel[place] *= 0.99


def nothing_done(files: Forgery) -> None:
    """Nothing is done, at no cost."""
    files.certificate["decision"] = [[0.0] * len(row) for row in files.decision]
    files.certificate["cost"] = 0.0


def box_lost(files: Forgery) -> None:
    """One of the boxes of times and parameters on which a constraint was shown is not there."""
    proof = files.proof(max(files.certificate["proof"], key=lambda name: len(files.proof(name)["lower"])))
    for side in ("lower", "upper"):
        proof[side].pop(len(proof[side]) // 2)


def box_shifted(files: Forgery) -> None:
    """A box ends earlier than the next one begins, or than the window does."""
    proof = files.proof(max(files.certificate["proof"], key=lambda name: len(files.proof(name)["lower"])))
    proof["upper"][len(proof["upper"]) // 2][0] -= 1e-6


def multiplier_changed(files: Forgery) -> None:
    files.heaviest["multiplier"] *= 1.01


def sign_changed(files: Forgery) -> None:
    files.heaviest["direction"] = [-entry for entry in files.heaviest["direction"]]


def gain_changed(files: Forgery) -> None:
    """The largest answer to what is measured is a tenth larger."""
    gains = files.certificate["gains"]
    rows = [row for later in gains for answers in later for row in answers]
    row = max(rows, key=lambda entries: max(map(abs, entries)))
    place = max(range(len(row)), key=lambda k: abs(row[k]))
    row[place] *= 1.1


def violation_enlarged(files: Forgery) -> None:
    files.certificate["witness"]["violation"] *= 1.01


def time_of_action_raised(files: Forgery) -> None:
    fewest = files.certificate["fewest_active"]
    fewest["lower"] = fewest["upper"] + 0.05
    files.result["sparsity"]["fewest_active"]["lower"] = fewest["lower"]


def costs(files: Forgery) -> bool:
    return bool(files.certificate["cost"]) and bool(files.certificate["lower_bound"])


def is_closed(files: Forgery) -> bool:
    """Whether the bounds meet, so that a higher one is false; that of a control that is refuted may be too low."""
    return costs(files) and files.certificate["status"] == "certified"


def is_proven(files: Forgery) -> bool:
    return files.certificate["status"] in ("certified", "verified") and bool(files.certificate["proof"])


def answers(files: Forgery) -> bool:
    return is_proven(files) and bool(np.any(files.certificate.get("gains") or 0.0))


def is_weighed(files: Forgery) -> bool:
    """Whether the bound is a sum over multipliers, which no other ones reach, and no tree."""
    return is_closed(files) and bool(files.certificate["multipliers"]) and is_pressed(files)


def is_pressed(files: Forgery) -> bool:
    """Whether a bound rests on a multiplier."""
    closed = files.certificate["status"] == "infeasible" or is_closed(files)
    imposed = (files.certificate["multipliers"] or {}).get("constraints") or []
    return closed and any(entry["multiplier"] > 0.0 for entry in imposed)


FORGED: dict[str, tuple[Forging, Callable[[Forgery], bool], str]] = {
    "bound raised": (bound_raised, is_closed, "plain-drift"),
    "cost lowered": (cost_lowered, costs, "in_time-delay"),
    "control changed": (control_changed, costs, "plain-polytope_measurable"),
    "nothing done": (nothing_done, lambda files: is_proven(files) and costs(files), "pair-parameters"),
    "box lost": (box_lost, is_proven, "plain-window"),
    "box shifted": (box_shifted, is_proven, "in_time-window"),
    "multiplier changed": (multiplier_changed, is_weighed, "in_time-execution"),
    "sign changed": (sign_changed, is_pressed, "infeasible-box"),
    "gain changed": (gain_changed, answers, "plain-affine"),
    "violation enlarged": (
        violation_enlarged, lambda files: files.certificate["status"] == "refuted", "nominal_in_time-box",
    ),
    "time of action raised": (
        time_of_action_raised, lambda files: is_proven(files) and "fewest_active" in files.certificate, "plain-haar",
    ),
}  # fmt: skip
"""By what is forged: how, of which runs it can be, and the run of which it is in the first stage."""
MANY = [name for name, told in VERDICTS.items() if told["seconds"] < QUICK and not name.startswith("bound-")]


def holds(name: str, kind: str, place: Path) -> bool:
    """Whether a run is found to be what it claims after it was forged, with files that agree."""
    return check(forged(place / name, place / kind / name, FORGED[kind][0], consistent=True)).status == "verified"


@pytest.mark.parametrize("kind", FORGED)
def test_a_number_that_is_changed_is_noticed(kind: str, tmp_path: Path) -> None:
    name = FORGED[kind][2]
    unpack(name, tmp_path)
    assert FORGED[kind][1](copied(tmp_path / name))
    assert not holds(name, kind, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", MANY)
def test_no_archived_run_is_verified_with_a_number_changed(name: str, tmp_path: Path) -> None:
    """Two kinds of those that it can be forged by, others from run to run."""
    files = copied(unpack(name, tmp_path))
    kinds = [kind for kind, (_, suits, _) in FORGED.items() if suits(files)]
    first = MANY.index(name)
    chosen = {kinds[(first + step) % len(kinds)] for step in (0, len(kinds) // 2)} if kinds else set()
    assert [kind for kind in sorted(chosen) if holds(name, kind, tmp_path)] == []


@pytest.mark.parametrize("side", ["upper", "lower"])
def test_a_worst_case_that_is_told_smaller_or_larger_is_noticed(side: str, tmp_path: Path) -> None:
    directory = unpack("bound-double_integrator", tmp_path)
    data = json.loads((directory / "bound.json").read_text())
    row = data["rows"][0]
    row[side] += (1 if side == "lower" else -1) * A_LITTLE * abs(row[side])
    row["margin"] = row["wall"] - row["upper"]
    (directory / "bound.json").write_text(json.dumps(data))
    assert check(directory).status != "verified"
