"""Guards checker: whatever is changed in a finished run, `check` finds it or names the place as not compared."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.errors import SparseRobError
from sparserob_core.experiment.check.check import check
from tests.support.everywhere import CONFIG, EVERYWHERE, named
from tests.support.tampering import copied, forged

PARTS = 4  # of the tamperings, the first of which is the first stage's


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("honest") / "run"
    outcome = sr.run(copy.deepcopy(CONFIG), out=directory, quiet=True, figures=False)
    assert outcome.result.status == "certified"
    return directory


def contents(directory: Path) -> list[Any]:
    files = copied(directory)
    raw = {path.name: path.read_bytes() for path in directory.iterdir() if path.suffix not in (".json", ".yaml")}
    return [files.config, files.certificate, files.result, raw]


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.slow) for part in range(1, PARTS))])
def test_no_change_of_a_finished_run_is_passed_over_in_silence(part: int, run: Path, tmp_path: Path) -> None:
    assert check(run).status == "verified"
    before, silent, idle, found = contents(run), [], [], 0
    tamperings = [*EVERYWHERE.items()][part::PARTS]
    for number, (kind, (file, place, change)) in enumerate(tamperings):
        directory = forged(run, tmp_path / str(number), change, consistent=False)
        if repr(contents(directory)) == repr(before):
            idle.append(kind)
        try:
            judged = check(directory)
        except SparseRobError:
            found += 1
            continue
        if judged.status == "refuted":
            found += 1
        elif not named(file, place, judged.not_compared):
            silent.append(f"{kind} ({judged.status})")
    assert (silent, idle) == ([], [])
    assert found > len(tamperings) / 2


def test_there_are_many_tamperings() -> None:
    assert len(EVERYWHERE) >= 150
