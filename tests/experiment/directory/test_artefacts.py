"""Guards experiment/directory/artefacts: run directories: whole files or none, and nobody else's files are touched."""

from __future__ import annotations

import errno
import json
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.directory.artefacts import RunDirectory, create_directory, finite, trace_columns
from sparserob_core.experiment.directory.sparsity import sparsity


def test_a_directory_is_named_after_the_config_the_time_and_the_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = (create_directory(None, "demo", "0123abcd").path for _ in range(2))
    assert first != second
    assert first.parent == second.parent == Path("runs/demo")
    assert first.name.split("-")[1] == "0123abcd"


def test_a_directory_that_holds_files_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(sr.InputError, match="expected a new or an empty directory"):
        create_directory(tmp_path, "demo", "0123abcd")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_place_of_the_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    for path in (tmp_path / "out", tmp_path / "out" / "below"):
        with pytest.raises(sr.InputError, match="expected a directory, got a file"):
            create_directory(path, "demo", "0123abcd")


@pytest.mark.parametrize("step", ["pathlib.Path.mkdir", "filelock.FileLock.acquire", "pathlib.Path.write_text"])
def test_a_directory_that_cannot_be_written_to_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def refuse(*given: object, **options: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    (tmp_path / "held").mkdir()
    monkeypatch.setattr(step, refuse)
    place = tmp_path / ("out" if step.endswith("mkdir") else "held")
    with pytest.raises(sr.InputError, match=f"{place.name}: cannot be written to: Permission denied"):
        create_directory(place, "demo", "0123abcd")
    assert not [*(tmp_path / "held").iterdir()]


def test_a_full_disk_leaves_the_old_file_and_no_half_of_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = RunDirectory(tmp_path)
    directory.write_json("result.json", {"status": "old"})

    def full(path: Path, content: bytes) -> int:
        with path.open("wb") as stream:
            stream.write(content[:3])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    refused = r"json: cannot be written: No space left on device; "
    with pytest.raises(sr.SparseRobError, match=f"{refused}the one that is there is what was written before"):
        directory.write_json("result.json", {"status": "new"})
    with pytest.raises(sr.SparseRobError, match=f"{refused}nothing of it was kept"):
        directory.write_json("certificate.json", {})
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
    assert json.loads((tmp_path / "result.json").read_text()) == {"status": "old"}


def test_a_lock_that_cannot_be_signed_keeps_nobody_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, *_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", full)
        with pytest.raises(sr.InputError, match=r"cannot be written to: No space left on device"):
            create_directory(tmp_path / "out", "demo", "0123abcd")
    with create_directory(tmp_path / "out", "demo", "0123abcd") as directory:  # there is room again
        directory.write_text("config.yaml", "")


def test_json_says_null_where_a_number_is_not_finite() -> None:
    said = finite({"a": np.inf, "b": [np.nan, np.float64(1.5)], "c": np.array([1, 2]), "d": np.bool_(True), "e": None})
    assert said == {"a": None, "b": [None, 1.5], "c": [1, 2], "d": True, "e": None}


def test_the_trace_has_one_column_per_field_and_one_row_per_round() -> None:
    rounds = [
        sr.RoundFinished(
            round=k, epsilon=1.0, lower_bound=k / 2, upper_bound=np.inf, violation=0.1, worst_family="path"
        )
        for k in range(3)
    ]
    columns = trace_columns(rounds)
    assert columns["lower_bound"].tolist() == [0.0, 0.5, 1.0]
    assert columns["worst_family"].tolist() == ["path"] * 3
    assert all(len(column) == 0 for column in trace_columns([]).values())


def test_sparsity_measures_time_not_pieces() -> None:
    found = sparsity(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1e-9]]), np.array([0.0, 1.0, 1.5, 4.0]))
    assert found.active_fraction == pytest.approx(0.125)
    assert found.switches == 2


def test_a_control_that_is_off_never_acts() -> None:
    found = sparsity(np.zeros((2, 5)), np.linspace(0, 1, 6))
    assert (found.active_fraction, found.switches) == (0.0, 0)
