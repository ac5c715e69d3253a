"""Guards experiment/directory/finished: run directories are read as data: nothing in them is executed, and what does
not fit is named."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.directory import finished
from sparserob_core.experiment.directory.finished import StoredRun, read_arrays, read_finished, read_json
from sparserob_core.experiment.figures.active import stored_active
from sparserob_core.experiment.run.drawing import draw_run
from sparserob_core.experiment.run.inspection import Inspection
from sparserob_core.experiment.run.replay import events, replay, stored_result
from tests.support.stub import Command

CONFIG = {
    "title": "A double integrator",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 1.5},
        "disturbance": {"box": [0.02, 0.05]},
        "terminal": [{"box": [0.5, 0.6]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}},
}
MARKER = """\
from pathlib import Path

import sparserob_core as sr

Path({marker!r}).write_text("executed")


class Halves(sr.DictionaryFactory, sr.Options):
    \"\"\"Two pieces.\"\"\"

    def build(self, horizon):
        import numpy as np

        return sr.Dictionary(np.array([0.0, horizon / 2, horizon]), np.eye(2))


@sr.hookimpl
def sparserob_dictionaries():
    yield sr.DictionaryPlugin(name="halves", factory=Halves, summary="Two pieces.")
"""


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sr.run(CONFIG, out=tmp_path_factory.mktemp("runs") / "solved", quiet=True, figures=False).directory


@pytest.fixture
def copy(solved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(solved, tmp_path / "copy"))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A run on a dictionary of a plugin file: its directory, the file, and what the file writes when it is executed."""
    folder = tmp_path_factory.mktemp("foreign")
    marker, file = folder / "executed", folder / "halves.py"
    file.write_text(MARKER.format(marker=str(marker)))
    config = {**CONFIG, "dictionaries": {"control": {"name": "halves"}}, "plugins": [str(file)]}
    directory = sr.run(config, out=folder / "run", quiet=True, figures=False).directory
    return directory, file, marker


COMMANDS = (
    ("check", "RUN"),
    ("simulate", "RUN", "--trajectories", "3"),
    ("figures", "RUN"),
    ("replay", "RUN", "--save", "run.rrd"),
    ("compare", "RUN"),
)


@pytest.mark.first(2)
@pytest.mark.parametrize("arguments", COMMANDS, ids=[arguments[0] for arguments in COMMANDS])
def test_no_command_that_reads_a_directory_executes_what_its_config_names(
    foreign: tuple[Path, Path, Path], command: Command, arguments: tuple[str, ...]
) -> None:
    directory, _, marker = foreign
    if arguments[0] == "replay":
        pytest.importorskip("rerun")
    marker.unlink(missing_ok=True)
    done = command(*(directory if argument == "RUN" else argument for argument in arguments))
    assert not marker.exists()
    assert "Traceback" not in done.stderr
    if arguments[0] != "compare":  # which reads numbers only
        assert done.returncode == 2, done.stderr
        assert "no dictionary is named 'halves'" in done.stderr
        assert "--plugins FILE" in done.stderr


@pytest.mark.slow
def test_a_plugin_that_the_user_names_himself_is_loaded(foreign: tuple[Path, Path, Path], command: Command) -> None:
    directory, file, marker = foreign
    marker.unlink(missing_ok=True)
    done = command("check", directory, "--plugins", file)
    assert done.returncode == 0, done.stdout + done.stderr
    assert marker.exists()
    assert sr.check(directory, [file]).status == "verified"
    assert len(draw_run(directory, [file])) > 0
    assert sr.simulate(directory, 3, plugins=[file]).trajectories == 3


def test_in_python_a_run_that_is_at_hand_needs_no_plugins_to_be_named(foreign: tuple[Path, Path, Path]) -> None:
    _, file, _ = foreign
    config = {**CONFIG, "dictionaries": {"control": {"name": "halves"}}, "plugins": [str(file)]}
    outcome = sr.run(config, out=file.parent / "again", quiet=True, figures=False)
    assert sr.simulate(outcome, 3).trajectories == 3


def test_who_watched_or_searched_is_of_no_concern_to_who_checks(copy: Path) -> None:
    text = (copy / "config.yaml").read_text()
    text = text.replace("name: progress", "name: strangers").replace("name: direct", "name: x")
    assert "strangers" in text and "name: x" in text
    (copy / "config.yaml").write_text(text)
    claims = {claim.name: claim.verdict for claim in sr.check(copy).claims}
    assert claims.pop("config") == "fails"  # it is not the config of the certificate any more
    assert set(claims.values()) == {"holds"}


@pytest.mark.parametrize(
    "read", [sr.check, draw_run, sr.simulate, replay, Inspection.read, lambda run: sr.compare([run])]
)
@pytest.mark.parametrize("kind", ["nothing", "a file", "one without config.yaml"])
def test_what_is_no_run_directory_is_said_to_be_none(tmp_path: Path, read: Callable[[Path], object], kind: str) -> None:
    place = tmp_path / "place"
    if kind == "a file":
        place.write_text("")
    elif kind != "nothing":
        place.mkdir()
    with pytest.raises(sr.InputError, match=f"place: expected the directory of a run, got {kind}"):
        read(place)


@pytest.mark.slow
def test_a_column_that_a_later_version_added_is_passed_over_by_every_reader(copy: Path) -> None:
    trace = read_arrays(copy / "trace.npz")
    np.savez(copy / "trace.npz", later=np.arange(len(trace["round"])), matrix=np.eye(3), **trace)
    assert len(draw_run(copy)) > 0
    assert len(StoredRun(copy).history) == len(trace["round"])


def test_the_rounds_come_back_with_their_controls(copy: Path) -> None:
    result = stored_result(StoredRun(copy))
    assert result.history
    for entry in result.history:
        assert entry.decision is not None
        assert entry.decision.shape == (6,)
        assert len(entry.multipliers) == len(entry.imposed)
    assert result.decision is not None and result.history[-1].decision is not None
    assert np.allclose(result.history[-1].decision, result.decision)


@pytest.mark.parametrize("name", ["trace.npz", "rounds.npz"])
def test_rounds_that_do_not_fit_are_named(copy: Path, name: str) -> None:
    arrays = read_arrays(copy / name)
    key = "violation" if name == "trace.npz" else "decisions"
    np.savez(copy / name, **{**arrays, key: np.zeros((7, 9))})
    with pytest.raises(sr.InputError, match=r"trace\.npz"):
        _ = StoredRun(copy).history


@pytest.mark.parametrize("policy", ["open_loop", "affine"])
def test_a_directory_keeps_the_rows_that_prove_the_bound(tmp_path: Path, policy: str) -> None:
    config = {**CONFIG, "policy": policy}
    result = sr.run(config, {}, tmp_path / "run", quiet=True, figures=False).result
    cuts = stored_result(StoredRun(tmp_path / "run")).dual.cuts
    assert len(cuts) == len(result.dual.cuts) > 0
    for stored, cut in zip(cuts, result.dual.cuts, strict=True):
        np.testing.assert_array_equal(stored.index, cut.index)
        told = (stored.family, stored.row, stored.multiplier, stored.formulation)
        assert told == (cut.family, cut.row, cut.multiplier, cut.formulation)
    file = tmp_path / "run" / "solution.npz"
    np.savez(file, **{**read_arrays(file), "bound_rows": np.zeros(1 + len(cuts), dtype=int)})
    with pytest.raises(sr.InputError, match=r"solution\.npz: bound_"):
        _ = StoredRun(tmp_path / "run").proving


def test_garbage_is_told_in_words_of_ours(copy: Path) -> None:
    good = (copy / "solution.npz").read_bytes()
    for content in (b"", b"garbage", good[: len(good) // 2], b"\x80\x04\x95", np.lib.format.magic(1, 0)):
        (copy / "solution.npz").write_bytes(content)
        with pytest.raises(sr.InputError, match=r"solution\.npz: cannot be read: expected arrays") as caught:
            read_finished(copy)
        assert "pickle" not in str(caught.value)
    np.savez(copy / "solution.npz", theta=np.array([{"a": 1}], dtype=object))
    with pytest.raises(sr.InputError, match="expected arrays of numbers and text") as caught:
        read_finished(copy)
    assert "unsafe" not in str(caught.value)
    with zipfile.ZipFile(copy / "solution.npz", "w") as archive:
        archive.writestr("theta.npy", b"not an array")
    with pytest.raises(sr.InputError, match=r"solution\.npz"):
        read_finished(copy)


def test_a_small_file_that_pretends_to_hold_a_huge_array_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "x.npz"
    header = str({"descr": "<f8", "fortran_order": False, "shape": (10**13,)}).encode() + b"\n"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", np.lib.format.magic(1, 0) + len(header).to_bytes(2, "little") + header)
    with pytest.raises(sr.InputError, match=r"x\.npz: cannot be read: expected arrays"):
        read_arrays(file)
    monkeypatch.setattr("sparserob_core.experiment.config.matrices.arrays.MAX_ARRAY_BYTES", 1000)
    np.savez_compressed(file, x=np.zeros(1000))
    assert file.stat().st_size < 1000
    with pytest.raises(sr.InputError, match="expected arrays of at most"):
        read_arrays(file)


@pytest.mark.parametrize("written", ["NaN", "-Infinity", "1e999", "-2.5E+308", "9" * 400, "9" * 400 + ".5"])
def test_a_number_that_is_not_finite_is_refused_by_its_key(written: str, tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    file.write_text(f'{{"a": {{"b": [1.5, 1e-300, 1.7e308, {"8" * 300}]}}, "c": "NaN"}}')
    assert read_json(file)["c"] == "NaN"
    file.write_text(f'{{"a": {{"b": [1.5, {{"c d": [[2, {written}]]}}]}}}}')
    with pytest.raises(
        sr.InputError, match=r"x\.json: a\.b\[1\]\.c d\[0\]\[1\]: expected a finite number or null, got"
    ):
        read_json(file)


def test_a_file_that_is_too_large_is_refused_before_it_is_read(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    file.write_text("{}")
    os.truncate(file, 2**33)
    with pytest.raises(sr.InputError, match="expected at most 134217728 bytes, got 8589934592"):
        read_json(file)


@pytest.mark.parametrize(
    ("entry", "most", "said"),
    [("[]", 9, "9 lists and objects"), ("{}", 9, "9 lists and objects"), ("1", 21, "20 entr")],
)
def test_text_with_too_many_parts_is_refused_before_lists_are_made_of_it(
    entry: str, most: int, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(finished, "MAX_LISTS", 9)
    monkeypatch.setattr(finished, "MAX_ENTRIES", 20)
    file, around = tmp_path / "x.json", 2 if most == 9 else 0  # an object and a list hold them
    file.write_text(f'{{"a": [{", ".join([entry] * (most - around))}]}}')
    assert len(read_json(file)["a"]) == most - around
    file.write_text(f'{{"a": [{", ".join([entry] * (most - around + 1))}]}}')
    with pytest.raises(sr.InputError, match=f"expected at most {said}.*, got {most + 1 - (around == 0)}"):
        read_json(file)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"status": "splendid"}, "expected the result of a run, with a status"),
        ({"status": ["certified"]}, "expected the result of a run, with a status"),
        ({"cost": "cheap"}, "cost: expected a number or null, got 'cheap'"),
        ({"gap": True}, "gap: expected a number or null, got True"),
        ({"title": 3}, "title: expected text, got 3"),
        ({"worst": 3}, "worst: expected an object, got 3"),
    ],
)
def test_a_result_that_is_none_is_refused_by_the_key_at_fault(copy: Path, change: dict[str, object], said: str) -> None:
    file = copy / "result.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    for read in (draw_run, lambda run: sr.compare([run])):
        with pytest.raises(sr.InputError, match=r"result\.json") as caught:
            read(copy)
        assert said in str(caught.value)


WRONG = {
    "shorter": lambda array: array[:-1] if array.ndim else array,
    "twice": lambda array: np.concatenate([array.ravel(), array.ravel()]),
    "text": lambda array: np.full(array.shape, "x"),
    "nan": lambda array: np.full(array.shape, np.nan),
    "a number": lambda array: np.float64(3.0),
    "empty": lambda array: np.zeros((0,) * max(array.ndim, 1)),
    "negative": lambda array: np.full(array.shape, -7),
    "true": lambda array: np.full(array.shape, True),
    "gone": None,
}


@pytest.fixture(scope="module")
def searched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that leaves every kind of file."""
    changes = ["method={name: sparserob, indices: 2}", "maximiser={name: random_search, budget: 20}"]
    out = tmp_path_factory.mktemp("runs") / "searched"
    return sr.run(CONFIG, changes, out=out, quiet=True, figures=False).directory


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.slow if kind != "shorter" else ()) for kind in WRONG],
)
def test_whatever_is_wrong_with_an_array_is_an_error_of_the_input_or_none(
    searched: Path, tmp_path: Path, kind: str
) -> None:
    directory, change = Path(shutil.copytree(searched, tmp_path / "run")), WRONG[kind]
    inspection = Inspection.read(directory)
    model = inspection._experiment.transcription

    def replayed() -> object:
        return list(events(inspection, "", directory, stored_result(StoredRun(directory))))

    def compared() -> object:
        return sr.compare([directory])

    readers: dict[str, tuple[Callable[[], object], ...]] = {
        "solution.npz": (
            replayed,
            lambda: stored_active(model, StoredRun(directory).solution),
        ),
        "trace.npz": (replayed, compared),
        "rounds.npz": (replayed,),
        "evaluations.npz": (replayed, compared),
        "adversary.npz": (lambda: sr.simulate(directory, law="adversary"),),
    }
    for read in (read for reads in readers.values() for read in reads):
        read()
    for name, reads in readers.items():
        content, arrays = (directory / name).read_bytes(), read_arrays(directory / name)
        for key, array in arrays.items():
            others = {one: other for one, other in arrays.items() if one != key}
            np.savez(directory / name, **(others if change is None else {**others, key: change(array)}))
            for read in reads:
                with suppress(sr.InputError):
                    read()
        (directory / name).write_bytes(content)


@pytest.mark.slow
def test_a_run_that_was_interrupted_before_its_first_round_was_over_can_be_drawn(copy: Path) -> None:
    empty = {name: np.array([]) for name in read_arrays(copy / "trace.npz")}
    np.savez(copy / "trace.npz", **empty)
    (copy / "rounds.npz").unlink()
    assert StoredRun(copy).history == ()
    assert len(draw_run(copy)) > 0
