"""Guards `UsersUnits` in sip/methods/own_units.py: every number that comes back is in the user's units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.methods.own_units import UsersUnits

# What has no unit, by record and field: counts, seconds of a clock, choices; the weight of the regulariser, which is in
# own units for people too; and what a witness says in words, which is in the user's from the start.
UNITLESS = {
    "Batch.first", "Batch.moments", "Cut.row", "EvaluationsFinished.block", "EvaluationsFinished.budget",
    "EvaluationsFinished.count", "EvaluationsFinished.deciding", "EvaluationsFinished.epsilon",
    "EvaluationsFinished.round", "EvaluationsFinished.seconds", "EvaluationsFinished.total", "Leaf.feasible",
    "Proof.allowed", "Proof.cells", "Proof.row", "ProofProgress.budget", "ProofProgress.cells",
    "ProofProgress.examined", "ProofProgress.seconds",
    "Result.counts", "Result.epsilon", "Result.missed", "Result.seconds", "Result.solved_by",
    "RoundFinished.active_indices", "RoundFinished.cuts_added", "RoundFinished.cuts_dropped", "RoundFinished.epsilon",
    "RoundFinished.gap", "RoundFinished.relaxed_programs", "RoundFinished.round", "RoundFinished.seconds",
    "RoundFinished.simplified", "SearchTrace.epsilon", "SearchTrace.outer", "SearchTrace.polished",
    "SearchTrace.seconds", "Separation.rows",
    "Sparsest.plain_count", "Witness.disturbance", "Witness.parameter", "Witness.row", "Witness.time",
}  # fmt: skip
ADDED = {"Proof.share", "Proof.units"}  # on the way back


def numbers(record: Any, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every number of a record, by the record that it is a field of."""
    if isinstance(record, Box):
        yield path, np.stack([record.lower, record.upper])
    elif is_dataclass(record):
        for path in (f"{type(record).__name__}.{one.name}" for one in fields(record)):
            yield from numbers(getattr(record, path.split(".")[1]), path) if path not in ADDED else ()
    elif isinstance(record, Mapping):
        for value in record.values():
            yield from numbers(value, path)
    elif isinstance(record, list | tuple):
        for value in record:
            yield from numbers(value, path)
    elif record is not None and not isinstance(record, str) and np.asarray(record).dtype.kind in "bfiu":
        yield path, np.asarray(record, dtype=float)


def problem(**more: Any) -> sr.OptimalControlProblem:
    """One whose own units of everything are others than the user's."""
    return sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0, 1e-3], [0.0, 0.0]], [[0.0], [3e2]], E=[[0.0], [1.0]]),
        horizon=5e4,
        initial_state=[7e5, 0.0],
        control=sr.Box([-40.0], [40.0]),
        weights=[1e3],
        path=[sr.Box([-1e5, -9e7], [9e5, 9e7])],
        **more,
    )


DISTURBED = {"disturbance": sr.Box([-0.03], [0.03]), "terminal": [sr.Box([-3e5, -8e5], [3e5, 8e5])]}
RUNS: list[Any] = [
    ({"terminal": [sr.Equality([3e5, np.nan])]}, {}, "Dual.mu"),
    pytest.param(DISTURBED, {}, "RoundFinished.violation", marks=pytest.mark.slow),
    pytest.param(DISTURBED, {"method": "sparsest"}, "Sparsest.norm", marks=pytest.mark.slow),
    pytest.param(
        DISTURBED,
        {"method": {"name": "sparserob", "indices": 3}, "budget": 60, "continuation": {"start": 1e-2, "stop": 1e-3}},
        "EvaluationsFinished.best_point",
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize(("more", "how", "reached"), RUNS)
def test_every_number_that_comes_back_is_in_the_users_units_or_has_none(
    more: dict[str, Any], how: dict[str, Any], reached: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pairs = list[tuple[Any, Any]]()
    for name in ("result", "event"):
        convert = getattr(UsersUnits, name)

        def heard(units: UsersUnits, own: Any, convert: Any = convert) -> Any:
            pairs.append((own, convert(units, own)))
            return pairs[-1][1]

        monkeypatch.setattr(UsersUnits, name, heard)
    program = sr.transcribe(problem(**more), sr.Dictionary.indicators(np.linspace(0.0, 5e4, 9)))
    sr.solve(program, notify=lambda event: None, **how)
    changed, told = set[str](), set[str]()
    for own, theirs in pairs:
        for (path, value), (_, converted) in zip(numbers(own), numbers(theirs), strict=True):
            if (np.isfinite(value) & (value != 0.0)).any():
                (told if np.array_equal(value, converted, equal_nan=True) else changed).add(path)
    assert reached in changed
    assert not (told - changed) - UNITLESS
    assert not changed & UNITLESS
