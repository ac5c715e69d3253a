"""Guards sparserob_core/quantities.py: a statistic is one field, and every unit of every record is known."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.check import files
from sparserob_core.experiment.directory.artefacts import finite
from sparserob_core.experiment.directory.certificate import _write_claims
from sparserob_core.experiment.directory.record import summary_of
from sparserob_core.experiment.initial_states.feasible_set import InitialStates
from sparserob_core.experiment.run.replay import _read_statistics
from sparserob_core.experiment.sweep.table import columns_of, columns_text, row_of
from sparserob_core.experiment.terminal.table import result_rows
from sparserob_core.quantities import UNITLESS, in_units, quantities, quantity, statistics
from sparserob_core.sip.events import Batch, EvaluationsFinished, ProofProgress, RoundFinished, Sketch
from sparserob_core.sip.evidence import Cut, Dual, Leaf, Proof, Sparsest
from sparserob_core.sip.methods.own_units import UsersUnits
from sparserob_core.sip.program import EqualityErrors, Separation, WorstConstraint
from sparserob_core.sip.result import Result, SearchTrace

RECORDS = (
    Batch, Cut, Dual, EqualityErrors, EvaluationsFinished, InitialStates, Leaf, Proof, ProofProgress, Result,
    RoundFinished, SearchTrace, Separation, Sketch, Sparsest, WorstConstraint,
)  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Widened(Result):
    """A result with a statistic of its own, which no other line of the framework knows."""

    ransom: float = field(
        default=np.nan,
        metadata=quantity("cost", "what a ransom would cost", label="ransom", form=".3g", certified="ransom"),
    )


RESULT = Widened(status="verified", message="a message", cost=2.0, upper_bound=2.0, ransom=0.75)


def written(result: Result) -> dict[str, Any]:
    summary: dict[str, Any] = json.loads(json.dumps(finite(summary_of(result, None, None))))
    return summary


def test_a_statistic_that_is_one_field_is_written_printed_and_read() -> None:
    summary = written(RESULT)
    assert summary["ransom"] == 0.75
    assert dict(result_rows({**summary, "units": {"cost": "kg"}}, Widened))["ransom"] == "0.75 kg"
    assert "ransom" not in dict(result_rows(summary))
    rows = [row_of({}, {**summary, "units": {"cost": "kg"}}, "run", "hash")]
    assert columns_of([], rows, Widened).index("ransom") < columns_of([], rows, Widened).index("worst.violation")
    assert "ransom,kg,what a ransom would cost\n" in columns_text([], rows, Widened)
    assert Widened(**_read_statistics(summary, Widened)).ransom == 0.75


def test_a_statistic_that_is_one_field_is_in_the_users_units() -> None:
    space = sr.Dictionary.indicators(np.linspace(0.0, 1.0, 3))
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1e3]]),
        horizon=1.0,
        initial_state=[5e4],
        control=sr.Box([-90.0], [90.0]),
        weights=[1e3],
    )
    own = sr.transcribe(problem, space).own_units
    assert own is not None and own.cost != 1.0
    assert UsersUnits(own).result(RESULT).ransom == 0.75 * own.cost  # type: ignore[attr-defined]


@pytest.mark.parametrize(("certified", "said"), [(0.75, ""), (0.5, "ransom is 0.75, not 0.5")])
def test_a_statistic_that_is_one_field_is_compared_with_the_certificate(
    certified: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert _write_claims(RESULT)["ransom"] == 0.75
    monkeypatch.setattr(files, "COMPARED", {})
    summary = {**written(RESULT), "title": "", "seed": 0, "config": "c"}
    certificate = {**finite(_write_claims(RESULT)), "config": "c", "ransom": certified}
    loaded: Any = SimpleNamespace(config=SimpleNamespace(seed=0, title=""))
    case: Any = SimpleNamespace(
        certificate=certificate, answering=False, problem=SimpleNamespace(system=SimpleNamespace(controls=1))
    )
    different, _, uncompared = files._compare_result(loaded, case, summary, Widened)
    assert different == [said] * bool(said) and "ransom" not in uncompared
    assert "ransom" in files._compare_result(loaded, case, summary)[2]


def test_every_statistic_of_a_result_comes_back_from_its_file() -> None:
    numbers = {name: 1.0 + k for k, (name, entry) in enumerate(statistics(Result).items()) if entry.unit}
    numbers.pop("gap")
    result = Result(status="certified", message="m", stopped="s", **numbers)  # type: ignore[arg-type]
    again = Result(**_read_statistics(written(result)))
    assert {name: getattr(again, name) for name in statistics(Result)} == {
        name: getattr(result, name) for name in statistics(Result)
    }


@pytest.mark.parametrize("kind", RECORDS)
def test_every_field_with_a_unit_and_no_other_is_converted_and_comes_back(kind: type) -> None:
    entries = quantities(kind)
    record = kind(**{entry.name: np.array([3.0]) for entry in fields(kind) if entry.init})
    units: dict[str, Any] = {entry.unit: 4.0 for entry in entries.values() if entry.unit not in UNITLESS}
    converted = in_units(record, units)
    changed = {entry.name for entry in fields(kind) if (getattr(converted, entry.name) != 3.0).any()}
    assert changed == {name for name, entry in entries.items() if entry.unit in units and not entry.after}
    again = in_units(converted, dict.fromkeys(units, 0.25))
    assert all((getattr(again, entry.name) == 3.0).all() for entry in fields(kind))


def test_a_unit_that_nobody_knows_is_an_error() -> None:
    with pytest.raises(KeyError, match="decision"):
        in_units(RESULT, {})


def test_fields_that_share_an_array_share_one_afterwards() -> None:
    lower = np.ones((1, 2))
    assert in_units(Sketch(lower, lower), {"index": 2.0}).points


def test_fields_of_two_units_that_share_a_number_are_converted_each_by_its_own() -> None:
    @dataclass(frozen=True)
    class Shared:
        cost: float = field(metadata=quantity("cost"))
        height: float = field(metadata=quantity("row"))

    number = 0.1 + 0.2
    found = in_units(Shared(number, number), {"cost": 10.0, "row": 100.0})
    assert (found.cost, found.height) == (10.0 * number, 100.0 * number)
