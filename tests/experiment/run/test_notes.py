"""Guards the notes of experiment/run/journal.py: what a config names and what had nothing to do is said, with its
place; what nobody has named is not."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

import sparserob_core as sr
from sparserob_core.experiment.config.load import load_config

CONFIG = """\
problem:
  name: linear
  system: {A: [[0, 1], [0, 0]], B: [[0], [1]]}
  horizon: 5.0
  initial_state: [4, 0]
  control: {box: 1}
  disturbance: {box: [0.02, 0.02]}
  terminal: [{box: [0.5, 0.3]}]
dictionaries: {control: {name: piecewise_constant, pieces: 6}}
observers: []
"""
NAMED = "maximiser: sequool\nregulariser: {name: ridge}\n"


def run(tmp_path: Path, text: str = "", **overrides: object) -> sr.Outcome:
    (tmp_path / "small.yaml").write_text(CONFIG + text)
    return sr.run(tmp_path / "small.yaml", overrides, tmp_path / f"run{len(list(tmp_path.iterdir()))}", figures=False)


def notes(outcome: sr.Outcome) -> list[tuple[str, str]]:
    return [(note["key"], note["place"].rpartition("/")[2]) for note in outcome.summary["notes"]]


def test_a_maximiser_that_is_never_asked_is_a_note_with_its_place(tmp_path: Path) -> None:
    outcome = run(tmp_path, NAMED)
    assert notes(outcome) == [("maximiser.name", "small.yaml:11:1")]
    assert json.loads((outcome.directory / "result.json").read_text())["notes"] == outcome.summary["notes"]
    assert notes(run(tmp_path, maximiser="sequool")) == [("maximiser.name", "override maximiser=sequool")]
    searching = {"method": {"name": "sparserob", "indices": 1}, "maximiser.budget": 5}
    assert notes(run(tmp_path, NAMED, **searching)) == []


def test_a_regulariser_that_weighs_nothing_is_one_too(tmp_path: Path) -> None:
    assert ("regulariser.name", "small.yaml:12:1") in notes(run(tmp_path, NAMED, policy={"name": "affine"}))


def test_what_nobody_has_named_is_no_note_and_a_resolved_config_names_what_differs(tmp_path: Path) -> None:
    plain = run(tmp_path)
    assert notes(plain) == []
    again = sr.run(plain.directory / "config.yaml", out=tmp_path / "again", figures=False)
    assert notes(again) == []
    named = run(tmp_path, NAMED)
    again = sr.run(named.directory / "config.yaml", out=tmp_path / "third", figures=False)
    assert [key for key, _ in notes(again)] == ["maximiser.name"]


def test_a_run_says_who_answered_and_what_the_named_solver_did_not(tmp_path: Path) -> None:
    for name in ("piqp", "clarabel", "dual_newton"):
        counts = run(tmp_path, solver=name).summary["counts"]
        assert counts["solved_by"] == {name: counts["relaxed_programs"]}
        assert counts["solver_calls"] > 0
    counts = run(tmp_path).summary["counts"]
    assert set(counts["solved_by"]) == {"closed_form", "dual_newton"}
    outcome = run(tmp_path, solver={"name": "piqp", "max_iterations": 1})
    said = [note["note"] for note in outcome.summary["notes"]]
    assert outcome.status == "certified"
    assert said
    assert all(text.startswith("piqp did not answer ") for text in said)
    assert any("MAX_ITER" in text or "misses its rows by" in text for text in said)


def test_notes_count_as_many_programs_as_the_table_whatever_the_reasons(tmp_path: Path) -> None:
    from sparserob_core.experiment.run.journal import _list_solver_notes
    from sparserob_core.sip.solver import Unanswered

    outcome = run(tmp_path, solver={"name": "piqp", "max_iterations": 1})
    others = {name: count for name, count in outcome.summary["counts"]["solved_by"].items() if name != "piqp"}
    assert others and counted(note["note"] for note in outcome.summary["notes"]) == others
    loaded = load_config(tmp_path / "small.yaml", {"solver": {"name": "piqp"}})
    missed = [Unanswered("relaxed", 7, "no digits", "highs"), Unanswered("relaxed", 2, "slow", "dual_newton")]
    missed.append(Unanswered("relaxed", 1, "no rows", "highs"))
    told = [note["note"] for note in _list_solver_notes(loaded, replace(outcome.result, unanswered=tuple(missed)))]
    assert counted(told) == {"highs": 8, "dual_newton": 2}
    assert told[0].endswith("highs did: 7 of them: no digits; 1 of them: no rows") and told[1].endswith("did: slow")


def counted(notes: Iterable[str]) -> dict[str, int]:
    """How many programs each solver answered for another one, as notes say."""
    found = [re.match(r"\w+ did not answer (\d+) of the relaxed programs, (\w+) did: ", note) for note in notes]
    return {match[2]: int(match[1]) for match in found if match is not None}


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("solver: {name: qpsolvers, solver: nosuch}\n", "small.yaml:11:27: solver.solver: qpsolvers"),
        ("solver:\n  name: osqp\n  eps_abs: -1\n", "small.yaml:13:3: solver.eps_abs: must be greater"),
        ("solver: {name: osqp, max_iter: -3}\n", "small.yaml:11:22: solver.max_iter: must be greater"),
        ("solver: {name: nosuch}\n", "small.yaml:11:10: solver.name: no solver is named 'nosuch'"),
        ("solver: {name: nppro}\n", "small.yaml:11:10: solver.name: solver 'nppro': nppro is not installed"),
        ("solver: {name: auto, general: auto}\n", "small.yaml:11:1: solver: general: expected a solver"),
    ],
)
def test_a_solver_that_is_absent_or_an_option_that_cannot_be_is_an_error_of_the_config(
    text: str, place: str, tmp_path: Path
) -> None:
    with pytest.raises(sr.ConfigError) as refusal:
        run(tmp_path, text)
    assert place in str(refusal.value)
    assert [path.name for path in tmp_path.iterdir()] == ["small.yaml"]
