"""Guards experiment/sweep: what a study leaves, and that nothing finished is lost or run again: by a kill, a dead
worker, a point that fails, a second sweep, Ctrl-C, a broken file."""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.experiment.directory.lock import NAME, Lock
from sparserob_core.experiment.sweep.study import read_study
from sparserob_core.experiment.sweep.table import columns_of, columns_text, read_table, row_of
from tests.experiment.cli.test_process import started, wait_for
from tests.support.places import ROOT
from tests.support.stub import CONFIG, Command

LEFT = {"sweep.yaml", "runs", "table.csv", "columns.csv", "sweep.pdf", "sweep.png"}
COUNTING = '''
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import sparserob_core as sr

HERE = Path(__file__).parent


class Counting(sr.Method, sr.Options):
    """Notes every call in a file; kills its own process, fails or waits where it is told to."""
    number: int = 0
    """Which point it is."""
    wait: float = 0.0
    """Seconds that it takes."""

    def solve(self, program, tools):
        with (HERE / "calls.txt").open("a") as calls:
            calls.write(f"{self.number}\\n")
        if (HERE / f"kill{self.number}").exists():
            if (HERE / f"kill{self.number}").read_text() == "once":
                (HERE / f"kill{self.number}").unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        if (HERE / f"fail{self.number}").exists():
            raise RuntimeError(f"number {self.number}\\nis at fault")
        ends = time.monotonic() + self.wait
        while time.monotonic() < ends:
            tools.deadline.check()
            time.sleep(0.02)
        x = np.zeros(program.n)
        x[0] = 0.1 * self.number
        witness = sr.Witness(violation=-0.1, constraint="terminal", index=np.array([2.0]), time=2.0)
        return sr.Result(status="certified", message="it counts", decision=x, cost=float(self.number) / 3.0,
                         value=1.5, lower_bound=float(self.number) / 3.0, upper_bound=float(self.number) / 3.0,
                         worst=witness, counts={"relaxed_programs": self.number}, seconds=0.01)


@sr.hookimpl
def sparserob_methods():
    yield sr.MethodPlugin(name="counting", factory=Counting, summary="Counts.")
'''


@pytest.fixture
def counting(tmp_path: Path) -> Path:
    """A config whose method notes every call."""
    (tmp_path / "counting.py").write_text(COUNTING)
    file = tmp_path / "counting.yaml"
    file.write_text(CONFIG.replace("{name: stub}", "{name: counting}").replace("stub.py", "counting.py"))
    return file


@pytest.fixture(autouse=True)
def undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take longer than all the rest; test_figure.py is about them."""
    if request.function is not test_a_study_leaves_what_is_documented:
        monkeypatch.setattr("sparserob_core.experiment.sweep.figure.draw_study", lambda study: None)


def calls(config: Path) -> Counter[int]:
    file = config.parent / "calls.txt"
    return Counter(int(line) for line in file.read_text().split()) if file.is_file() else Counter()


def cost_of(number: int) -> float:
    """What the method claims, in the unit of the config; the problem's own is a quarter of it."""
    return number / 3.0 / 4.0


def costs(study: sr.Study) -> dict[int, float]:
    return {row["method.number"]: row["cost"] for row in study.table}


def timeless(directory: Path) -> str:
    """The table without its last column, the seconds."""
    lines = list(csv.reader(io.StringIO((directory / "table.csv").read_text(), newline="")))
    assert lines[0][-1] == "seconds"
    return "\n".join(",".join(line[:-1]) for line in lines)


@contextmanager
def two_processes(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A pool of two processes in place of the executor that a config names."""
    context = multiprocessing.get_context("fork")

    class Pool(sr.ExecutorFactory):
        @contextmanager
        def open(self) -> Any:
            with ProcessPoolExecutor(2, mp_context=context) as pool:
                yield pool

    with monkeypatch.context() as patch:
        patch.setattr("sparserob_core.experiment.sweep.sweep._build_executors", lambda point, chosen: Pool())
        yield


def test_a_study_leaves_what_is_documented(counting: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    study = sr.sweep(counting, {"method.number": "1:4:4"}, out=tmp_path / "out")
    assert {path.name for path in study.directory.iterdir()} == LEFT
    assert costs(study) == {number: cost_of(number) for number in (1, 2, 3, 4)}
    assert (study.points, study.failed, study.stopped, dict(study.counts)) == (4, 0, "", {"certified": 4})
    rows, described = (
        list(csv.DictReader(io.StringIO((study.directory / name).read_text(), newline="")))
        for name in ("table.csv", "columns.csv")
    )
    assert [float(row["cost"]) for row in rows] == [cost_of(number) for number in (1, 2, 3, 4)]  # to the last bit
    assert next(iter(rows[0])) == "method.number" and list(rows[0])[-1] == "seconds"
    assert [one["column"] for one in described] == list(rows[0])
    assert all(one["meaning"] for one in described)
    for row in study.table:
        run = study.directory / "runs" / row["run"]
        summary = json.loads((run / "result.json").read_text())
        assert (summary["cost"], summary["provenance"]["hash"]) == (row["cost"], row["hash"])
        assert (run / "config.yaml").is_file() and not (run / NAME).exists()


def test_an_axis_of_lists_has_its_numbers_in_columns(counting: Path, tmp_path: Path) -> None:
    boxes = [[1.0], [0.5], 2.0]
    study = sr.sweep(counting, {"problem.control.box": boxes}, {"method.number": 3}, out=tmp_path / "out")
    assert list(study.table[0])[:3] == ["problem.control.box", "problem.control.box.0", "status"]
    assert [row["problem.control.box.0"] for row in study.table] == [1.0, 0.5, None]
    assert [row["problem.control.box"] for row in read_table(study.directory)] == boxes
    assert [row["problem.control.box.0"] for row in read_table(study.directory)] == [1.0, 0.5, None]
    text = (study.directory / "columns.csv").read_text()
    about = {one["column"]: one["meaning"] for one in csv.DictReader(io.StringIO(text))}
    assert "place 0 of problem.control.box" in about["problem.control.box.0"]


def test_numbers_of_an_axis_do_not_displace_another_axis() -> None:
    row = row_of({"box": [1.0, 2.0], "box.1": 7}, {"status": "certified"}, "run", "hash")
    assert (row["box"], row["box.0"], row["box.1"]) == ([1.0, 2.0], 1.0, 7)
    assert columns_of(["box", "box.1"], [row])[:3] == ["box", "box.0", "box.1"]
    assert "box.0" not in row_of({"box": [[0, 1], [2, 3]]}, None, "run", "hash")
    assert "box.0" not in row_of({"box": [True]}, None, "run", "hash")


def test_columns_say_the_units_that_all_rows_share() -> None:
    found = {"status": "certified", "cost": 1.0, "worst": {"violation": 0.0, "time": 1.0}}
    rows = [
        row_of({"seed": seed}, {**found, "units": {"cost": "N s", "worst": worst, "time": ""}}, "run", "hash")
        for seed, worst in enumerate(["m", "m/s"])
    ]
    stated = {line["column"]: line["unit"] for line in csv.DictReader(io.StringIO(columns_text(["seed"], rows)))}
    assert (stated["cost"], stated["lower_bound"]) == ("N s", "N s")
    assert (stated["worst.violation"], stated["worst.time"]) == ("constraint", "time")
    assert [row["units.worst"] for row in rows] == ["m", "m/s"] and "units.time" not in rows[0]


def test_a_study_is_read_again_as_it_was(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"method.number": [1, 2], "problem.control.box": [1.0, 2.0]}, out=tmp_path / "out")
    again = read_study(tmp_path / "out")
    known = [{name: value for name, value in row.items() if value not in (None, "")} for row in again.table]
    assert known == [{name: value for name, value in row.items() if value not in (None, "")} for row in study.table]
    assert [axis.key for axis in again.axes] == ["method.number", "problem.control.box"]


def test_the_outcomes_are_those_of_the_rows(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"method.number": [1, 2, 3]}, out=tmp_path / "out")
    assert len(study.outcomes) == 3
    outcome = study.outcomes[1]
    assert (outcome.status, outcome.result.cost) == ("certified", study.table[1]["cost"])
    assert outcome.control is not None and outcome.control[0, 0] == pytest.approx(0.2)
    assert isinstance(outcome.problem, sr.OptimalControlProblem)
    assert [one.result.cost for one in study.outcomes[1:]] == [row["cost"] for row in study.table[1:]]


def test_every_row_has_every_column(counting: Path, tmp_path: Path) -> None:
    (tmp_path / "fail2").touch()
    study = sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    assert list(study.table[0]) == list(study.table[1])
    assert study.table[1]["cost"] is None


def test_what_is_finished_is_not_run_again(counting: Path, tmp_path: Path) -> None:
    sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    study = sr.sweep(tmp_path / "out")
    assert calls(counting) == {1: 1, 2: 1}
    assert costs(study) == {1: cost_of(1), 2: cost_of(2)}


@pytest.mark.slow
def test_a_further_value_runs_only_what_is_new(counting: Path, tmp_path: Path) -> None:
    sr.sweep(counting, {"method.number": [1, 3]}, out=tmp_path / "out")
    study = sr.sweep(counting, {"method.number": [1, 2, 3], "seed": [0]}, out=tmp_path / "out")
    assert calls(counting) == {1: 1, 2: 1, 3: 1}
    assert list(costs(study)) == [1, 2, 3]
    wider = sr.sweep(tmp_path / "out", {"seed": [0, 1]})
    assert calls(counting) == {1: 2, 2: 2, 3: 2}
    assert wider.points == 6


def test_a_change_that_decides_no_result_runs_nothing(counting: Path, tmp_path: Path) -> None:
    sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    other = {"title": "Another title", "limits.seconds": 50.0, "observers": []}
    sr.sweep(counting, {"method.number": [1, 2]}, other, out=tmp_path / "out")
    assert calls(counting) == {1: 1, 2: 1}


@pytest.mark.slow
def test_the_first_run_of_a_process_has_imported_everything_when_its_clock_starts(tmp_path: Path) -> None:
    script = tmp_path / "study.py"
    script.write_text(
        "import sys\n"
        "import sparserob_core as sr\n"
        "from sparserob_core.experiment.run import run\n"
        "solve = run.solve_in_own_units\n"
        "def clocked(*given):\n"
        "    before = set(sys.modules)\n"
        "    found = solve(*given)\n"
        "    late = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "    print(sorted(late & {'scipy', 'piqp', 'clarabel'}))\n"
        "    return found\n"
        "run.solve_in_own_units = clocked\n"
        f"config = {str(ROOT / 'configs' / 'double_integrator.yaml')!r}\n"
        f"sr.sweep(config, {{'solver': ['piqp', 'clarabel']}}, out={str(tmp_path / 'study')!r}, figures=False)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=120, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["[]", "[]"]


def test_one_point_is_a_study(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"method.number": [3]}, out=tmp_path / "out")
    assert (study.points, list(study.axes), [row["cost"] for row in study.table]) == (1, [], [cost_of(3)])
    assert study.table[0]["run"].startswith("point-")
    assert [row["cost"] for row in read_study(tmp_path / "out").table] == [cost_of(3)]
    wider = sr.sweep(tmp_path / "out", {"method.number": [3, 4]})
    assert costs(wider) == {3: cost_of(3), 4: cost_of(4)}
    assert calls(counting) == {3: 1, 4: 1}


def test_a_config_without_changes_is_a_study_of_one_point_too(counting: Path, command: Command, tmp_path: Path) -> None:
    (tmp_path / "fail0").touch()
    done = command("sweep", counting, "--out", "out")
    assert done.returncode == 5
    assert "1 of 1 points: 1 failed" in done.stdout
    (failed,) = read_table(tmp_path / "out")
    assert failed["status"] == "failed" and f"\nfailed: {failed['message']}\n" in done.stdout


def test_what_would_be_run_is_told_and_nothing_is_written(counting: Path, command: Command, tmp_path: Path) -> None:
    arguments = ("sweep", counting, "method.number=1:3:3", "seed=0,1", "--dry-run")
    before = sorted(tmp_path.rglob("*"))
    done = command(*arguments, "--out", "out", "--json")
    assert done.returncode == 0, done.stderr
    assert [path for path in sorted(tmp_path.rglob("*")) if "__pycache__" not in str(path)] == before
    data = json.loads(done.stdout)
    study = sr.sweep(counting, {"method.number": "1:3:3", "seed": "0,1"}, out=tmp_path / "out")
    keys = ["method.number", "seed"]
    assert data["axes"] == keys
    assert [(row["point"], row["values"], row["finished"], row["run"], row["hash"]) for row in data["points"]] == [
        (place, {key: row[key] for key in keys}, False, row["run"], row["hash"])
        for place, row in enumerate(study.table)
    ]
    shutil.rmtree(tmp_path / "out" / "runs" / study.table[4]["run"])
    left = sorted(tmp_path.rglob("*"))
    lines = command("sweep", "--resume", "out", "--dry-run").stdout.splitlines()
    assert [line.split()[3] for line in lines[2:8]] == ["finished"] * 4 + ["to", "finished"]
    assert lines[-1].startswith("6 points, 5 finished")
    assert sorted(tmp_path.rglob("*")) == left


def one_point(counting: Path, out: Path, number: int) -> int:
    """Run one point in this process; returns how many rows it has."""
    return len(sr.sweep(counting, {"method.number": "1:4:4", "method.wait": 0.05}, point=number, out=out).table)


@pytest.mark.slow
def test_processes_that_run_a_point_each_fill_one_study(counting: Path, tmp_path: Path) -> None:
    out, whole = tmp_path / "out", {"method.number": "1:4:4", "method.wait": 0.05}
    alone = timeless(sr.sweep(counting, whole, out=tmp_path / "other").directory)  # the forks have all imports by then
    with ProcessPoolExecutor(4, mp_context=multiprocessing.get_context("fork")) as pool:
        assert list(pool.map(one_point, [counting] * 4, [out] * 4, range(4))) == [1] * 4
    assert {path.name for path in out.iterdir()} == {"sweep.yaml", "runs"}
    study = sr.sweep(out)
    assert calls(counting) == dict.fromkeys(range(1, 5), 2)
    assert {path.name for path in (out / "runs").iterdir()} == {row["run"] for row in study.table}
    assert timeless(out) == alone


def test_a_point_that_is_finished_is_not_run_again_and_one_that_failed_is(counting: Path, tmp_path: Path) -> None:
    axes, out = {"method.number": [1, 2]}, tmp_path / "out"
    (tmp_path / "fail2").touch()
    assert [sr.sweep(counting, axes, point=place, out=out).failed for place in (0, 1, 0)] == [0, 1, 0]
    (tmp_path / "fail2").unlink()
    assert costs(sr.sweep(out, point=1)) == {2: cost_of(2)}
    assert costs(sr.sweep(out)) == {1: cost_of(1), 2: cost_of(2)}
    assert calls(counting) == {1: 1, 2: 2}


def test_of_equal_configs_any_number_names_one_run(counting: Path, tmp_path: Path) -> None:
    axes, out = {"method.number": [1], "solver": ["piqp", {"name": "piqp", "max_iterations": 250}]}, tmp_path / "out"
    names = {sr.sweep(counting, axes, point=place, out=out).table[0]["run"] for place in (1, 0)}
    same = sr.sweep(counting, axes, out=tmp_path / "whole")
    assert names == {row["run"] for row in same.table}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "other", [{"method.number": [1, 2, 3]}, {"method.number": [2, 1]}, {"method.number": [1, 2], "seed": [4]}]
)
def test_a_point_of_another_study_is_refused_and_changes_nothing(
    counting: Path, tmp_path: Path, other: dict[str, Any]
) -> None:
    out = tmp_path / "out"
    sr.sweep(counting, {"method.number": [1, 2]}, point=0, out=out)
    before, ran = (out / "sweep.yaml").read_bytes(), calls(counting)
    with pytest.raises(sr.InputError, match="expected the same study"):
        sr.sweep(counting, other, point=0, out=out)
    assert ((out / "sweep.yaml").read_bytes(), calls(counting)) == (before, ran)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(sr.InputError, match="expected a new or an empty directory"):
        sr.sweep(counting, other, point=0, out=tmp_path / "full")
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["letter.txt"]


def test_runs_that_others_have_under_way_are_left_to_them(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    run, here = study.table[0]["run"], platform.node()
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        dead.wait()
    living = {f".{run}.{here}.{os.getppid()}.partial", f".{run}.{here}-elsewhere.{os.getpid()}.partial"}
    for name in {*living, f".{run}.{here}.{dead.pid}.partial", f".{run}.{here}.{os.getpid()}.partial+"}:
        (tmp_path / "out" / "runs" / name).mkdir()  # as it is before the first file and after the last one
    sr.sweep(tmp_path / "out")
    assert {path.name for path in (tmp_path / "out" / "runs").glob(".*")} == living


def test_points_with_one_config_are_run_once(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"method.number": [1], "solver": ["piqp", {"name": "piqp"}]}, out=tmp_path / "out")
    assert calls(counting) == {1: 1}
    assert study.table[0]["run"] == study.table[1]["run"]


def test_a_point_that_fails_is_a_row_with_the_reason_and_stops_nothing(counting: Path, tmp_path: Path) -> None:
    (tmp_path / "fail2").touch()
    study = sr.sweep(counting, {"method.number": [1, 2, 3]}, out=tmp_path / "out")
    assert [row["status"] for row in study.table] == ["certified", "failed", "certified"]
    assert "number 2" in study.table[1]["message"] and "is at fault" in study.table[1]["message"]
    assert read_table(tmp_path / "out")[1]["message"] == study.table[1]["message"]  # a line feed in a cell too
    (tmp_path / "fail2").unlink()
    again = sr.sweep(counting, {"method.number": [1, 2, 3]}, out=tmp_path / "out")
    assert calls(counting) == {1: 1, 2: 2, 3: 1}
    assert [row["status"] for row in again.table] == ["certified"] * 3


def test_a_point_that_cannot_be_built_fails_alone(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"problem.initial_state": [[1, 0], [1, 0, 0]], "method.number": [1]}, out=tmp_path / "o")
    assert [row["status"] for row in study.table] == ["certified", "failed"]
    assert "initial_state" in study.table[1]["message"]
    with pytest.raises(sr.InputError, match=r"there is no outcome: .*initial_state"):
        study.outcomes[1]


@pytest.mark.slow
def test_a_point_at_a_time_limit_is_run_again_and_a_finished_one_is_not(counting: Path, tmp_path: Path) -> None:
    axes = {"method.number": [1, 2], "method.wait": [0.4]}
    first = sr.sweep(counting, axes, {"limits.seconds": 0.1}, out=tmp_path / "out")
    assert [row["status"] for row in first.table] == ["undecided"] * 2  # all that is known: no cost is negative
    assert "the limit of 0.1 s is reached" in first.table[0]["message"]
    again = sr.sweep(counting, axes, out=tmp_path / "out")
    assert [row["status"] for row in again.table] == ["certified"] * 2
    sr.sweep(counting, axes, {"limits.seconds": 0.1}, out=tmp_path / "out")
    assert calls(counting) == {1: 2, 2: 2}


@pytest.mark.slow
def test_an_answer_at_a_time_limit_is_a_row_and_is_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "sparserob_core.sip.limits.deadline.LIMIT_GRACE_SECONDS", 60.0
    )  # the transcription is let finish
    file = tmp_path / "real.yaml"
    file.write_text(CONFIG.replace("method: {name: stub}\nplugins: [./stub.py]\n", ""))
    first = sr.sweep(file, {"dictionaries.control.pieces": [10, 12]}, {"limits.seconds": 1e-6}, out=tmp_path / "out")
    assert all("the limit of 1e-06 s is reached" in row["stopped"] for row in first.table)
    again = sr.sweep(file, {"dictionaries.control.pieces": [10, 12]}, out=tmp_path / "out")
    assert [row["status"] for row in again.table] == ["certified"] * 2
    assert [row["run"] for row in again.table] == [row["run"] for row in first.table]


@pytest.mark.slow
def test_tables_do_not_depend_on_the_executor(counting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fail3").touch()
    axes = {"method.number": "1:4:4", "seed": [0, 1]}
    serial = sr.sweep(counting, axes, out=tmp_path / "serial")
    with two_processes(monkeypatch):
        parallel = sr.sweep(counting, axes, out=tmp_path / "parallel")
    assert timeless(serial.directory) == timeless(parallel.directory)
    assert (serial.directory / "columns.csv").read_bytes() == (parallel.directory / "columns.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("executor", [{"name": "processes", "workers": 2}, {"name": "dask", "workers": 2}])
def test_neither_do_they_on_the_executors_that_are_offered_nor_when_a_worker_dies(
    counting: Path, tmp_path: Path, executor: dict[str, Any]
) -> None:
    if executor["name"] == "dask":
        pytest.importorskip("distributed")
    axes = {"method.number": "1:6:6", "seed": [0, 1]}
    serial = sr.sweep(counting, axes, out=tmp_path / "serial")
    (tmp_path / "kill3").write_text("once")
    parallel = sr.sweep(counting, axes, executor=executor, out=tmp_path / "parallel")
    assert parallel.failed == 0
    assert timeless(serial.directory) == timeless(parallel.directory)


@pytest.mark.slow
def test_a_worker_that_dies_costs_nobody_else_anything(
    counting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "kill2").write_text("once")
    (tmp_path / "kill5").write_text("always")
    with two_processes(monkeypatch):
        study = sr.sweep(counting, {"method.number": "1:6:6", "method.wait": 0.05}, out=tmp_path / "out")
    assert [row["status"] for row in study.table] == ["certified"] * 4 + ["failed", "certified"]
    assert study.table[4]["message"] == "the process that ran it died, twice"
    assert costs(study)[2] == cost_of(2)
    assert max(calls(counting).values()) <= 3
    assert not [*(tmp_path / "out" / "runs").glob(".*")]


def test_workers_that_never_begin_end_the_study_with_one_sentence(
    counting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stillborn(Executor):
        def submit(self, *_: Any, **__: Any) -> Any:
            from concurrent.futures import Future
            from concurrent.futures.process import BrokenProcessPool

            future: Future[Any] = Future()
            future.set_exception(BrokenProcessPool("gone"))
            return future

    class Factory(sr.ExecutorFactory):
        @contextmanager
        def open(self) -> Any:
            yield Stillborn()

    monkeypatch.setattr("sparserob_core.experiment.sweep.sweep._build_executors", lambda point, chosen: Factory())
    with pytest.raises(sr.SparseRobError, match="workers die before they begin a point"):
        sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")


def sweeping(counting: Path, out: Path, *more: object) -> Any:
    axes = ("method.number=1:8:8", "method.wait=0.15")
    return started("sweep", counting, *axes, "--out", out, *more, cwd=counting.parent)


def finished(out: Path) -> list[Path]:
    return [path for path in (out / "runs").glob("[!.]*") if (path / "result.json").is_file()]


@pytest.mark.slow
def test_a_sweep_that_is_killed_loses_at_most_what_was_running(counting: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with sweeping(counting, out) as process:
        wait_for(lambda: len(finished(out)) >= 3)
        process.send_signal(signal.SIGKILL)
        process.wait()
    kept = {path.name for path in finished(out)}
    before = calls(counting)
    assert len(kept) >= 3
    study = sr.sweep(out)
    assert list(costs(study)) == list(range(1, 9))
    again = {number: count for number, count in calls(counting).items() if count > 1}
    assert len(again) <= 1  # the one in flight
    assert sum(before.values()) - len(kept) <= 1
    assert kept <= {path.name for path in finished(out)}
    assert not [*(out / "runs").glob(".*")] and not (out / NAME).exists()
    assert {path.name for path in (out / "runs").iterdir()} == {row["run"] for row in study.table}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_sweep_says_how_to_go_on_and_can(counting: Path, tmp_path: Path, number: int) -> None:
    out = tmp_path / "out"
    with sweeping(counting, out) as process:
        wait_for(lambda: len(finished(out)) >= 2)
        process.send_signal(number)
        printed, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert f"sparserob sweep --resume {out}" in printed
    assert "Traceback" not in said
    rows = read_table(out)
    assert 2 <= len(rows) < 8
    assert not (out / NAME).exists() and not [*(out / "runs").glob(".*")]
    kept = {row["method.number"] for row in rows}
    study = sr.sweep(out)
    assert list(costs(study)) == list(range(1, 9))
    assert all(calls(counting)[one] == 1 for one in kept)


@pytest.mark.slow
def test_of_two_sweeps_into_one_directory_the_second_ends_at_once(
    counting: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "out"
    with sweeping(counting, out) as process:
        wait_for(lambda: len(finished(out)) >= 1)
        done = command("sweep", counting, "method.number=1:9:9", "--out", out)
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
        assert f"another run is writing into it (process {process.pid}" in done.stderr
        process.communicate(timeout=60)
        assert process.returncode == 0
    assert calls(counting) == dict.fromkeys(range(1, 9), 1)


def test_a_study_of_another_base_is_not_written_over(counting: Path, tmp_path: Path) -> None:
    sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    before = (tmp_path / "out" / "table.csv").read_bytes()
    counting.write_text(counting.read_text().replace("horizon: 2.0", "horizon: 3.0"))
    with pytest.raises(sr.InputError, match=r"another base config \(problem.horizon is 2 there and 3 here\)"):
        sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    assert (tmp_path / "out" / "table.csv").read_bytes() == before


def test_a_directory_that_holds_something_else_is_left_alone(counting: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("mine")
    with pytest.raises(sr.InputError, match="expected a new or an empty directory"):
        sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "full")
    assert [path.name for path in (tmp_path / "full").iterdir()] == ["letter.txt"]
    with pytest.raises(sr.InputError, match=r"expected the directory of a study, got one without sweep.yaml"):
        sr.sweep(tmp_path / "full")


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the file is empty"),
        ("base: [1, 2", "not valid YAML"),
        ("base: {problem: {name: linear}}\naxes: {method.number: 0:1}\n", "expected start:stop:count"),
        ("base: 3\n", "base: must be a config"),
    ],
)
def test_a_broken_study_file_is_one_clear_error(
    counting: Path, tmp_path: Path, command: Command, text: str, said: str
) -> None:
    sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    (tmp_path / "out" / "sweep.yaml").write_text(text)
    done = command("sweep", "--resume", "out")
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert said in done.stderr and "sweep.yaml" in done.stderr
    assert len(finished(tmp_path / "out")) == 2


@pytest.mark.first(3)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected the table of a study"),
        ("a,b\n1,2\n", "expected the table of a study, with columns such as status, run and seconds"),
        ("method.number,status,run,seconds\n1,certified\n", "table.csv:2: expected 4 cells"),
        ("status,run,seconds\n", ""),
        ("status,run,seconds\ncertified,x,1\n", "expected a column for the axis method.number, got none"),
        ('"method.number,status\n', "cannot be read"),
    ],
)
def test_a_broken_table_is_one_clear_error_and_is_written_anew_by_a_sweep(
    counting: Path, tmp_path: Path, text: str, said: str
) -> None:
    sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    whole = (tmp_path / "out" / "table.csv").read_bytes()
    (tmp_path / "out" / "table.csv").write_text(text)
    if said:
        with pytest.raises(sr.InputError) as caught:
            read_study(tmp_path / "out")
        assert said in str(caught.value)
    sr.sweep(tmp_path / "out")
    assert (tmp_path / "out" / "table.csv").read_bytes() == whole
    assert calls(counting) == {1: 1, 2: 1}


def test_a_run_that_is_broken_or_of_another_config_is_made_anew(counting: Path, tmp_path: Path) -> None:
    study = sr.sweep(counting, {"method.number": [1, 2, 3]}, out=tmp_path / "out")
    runs = [tmp_path / "out" / "runs" / row["run"] for row in study.table]
    (runs[0] / "result.json").write_text("{")
    shutil.rmtree(runs[1])
    summary = json.loads((runs[2] / "result.json").read_text())
    summary["provenance"]["hash"] = "0" * 64
    (runs[2] / "result.json").write_text(json.dumps(summary))
    assert costs(sr.sweep(tmp_path / "out")) == costs(study)
    assert calls(counting) == {1: 2, 2: 2, 3: 2}


def test_progress_counts_every_point(counting: Path, tmp_path: Path) -> None:
    heard: list[sr.SweepProgress] = []
    (tmp_path / "fail2").touch()

    def note(event: sr.Event) -> None:
        assert isinstance(event, sr.SweepProgress)
        heard.append(event)

    sr.sweep(counting, {"method.number": [1, 2, 3]}, out=tmp_path / "out", notify=note)
    assert [(one.done, one.total, one.failed) for one in heard] == [(0, 3, 0), (1, 3, 0), (2, 3, 1), (3, 3, 1)]
    assert [None if one.row is None else one.row["method.number"] for one in heard] == [None, 1, 2, 3]
    assert heard[1].left is not None and heard[1].text.startswith("1 of 3 points done, about ")


def test_an_interrupt_in_python_returns_what_is_known(counting: Path, tmp_path: Path) -> None:
    def press(event: sr.Event) -> None:
        if isinstance(event, sr.SweepProgress) and event.done == 2:
            raise KeyboardInterrupt

    study = sr.sweep(counting, {"method.number": [1, 2, 3]}, out=tmp_path / "out", notify=press)
    assert (len(study.table), study.points, study.stopped) == (2, 3, "interrupted from the keyboard")
    assert list(costs(sr.sweep(tmp_path / "out"))) == [1, 2, 3]
    assert calls(counting) == {1: 1, 2: 1, 3: 1}


def test_an_interrupt_while_the_figure_is_drawn_costs_the_figure_only(
    counting: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press(study: sr.Study) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sparserob_core.experiment.sweep.figure.draw_study", press)
    study = sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    assert (len(study.table), study.remarks) == (2, ("no figure: it was interrupted",))


def test_the_directory_of_a_run_has_a_name_for_readers(counting: Path, tmp_path: Path) -> None:
    axes = {"problem.terminal.0.box": [[0.5, 0.5]], "solver": [{"name": "piqp"}, "clarabel"], "method.number": [1]}
    study = sr.sweep(counting, {**axes, "title": "a/../b", "method.wait": [0.0, 1e-3]}, out=tmp_path / "out")
    names = [row["run"].rpartition("-")[0] for row in study.table]
    solvers, waits = ("piqp", "clarabel"), ("0", "0.001")
    assert names == [f"solver={solver}_wait={wait}" for solver in solvers for wait in waits]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sweep"], "expected either CONFIG or --resume DIR, got neither"),
        (["sweep", "counting.yaml", "seed=0,1", "--point", "0"], "point: expected the directory of the study beside"),
        (["sweep", "counting.yaml", "seed=0,1", "--out", "x", "--point", "2"], "expected a whole number from 0 to 1"),
        (["sweep", "counting.yaml", "seed=0,1", "--out", "x", "--point", "-1"], "expected a whole number from 0 to 1"),
        (["sweep", "counting.yaml", "--out", "x", "--point", "0", "--executor", "serial"], "executor: expected none"),
        (["sweep", "counting.yaml", "--dry-run", "--point", "0"], "--dry-run: expected neither --point nor a viewer"),
        (["sweep", "counting.yaml", "--dry-run", "--executor", "nosuch"], "no executor is named 'nosuch'"),
        (["sweep", "counting.yaml", "--resume", "x"], "expected either CONFIG or --resume DIR, got both"),
        (["sweep", "--resume", "nowhere"], "nowhere"),
        (["sweep", "--resume", "x", "--out", "y"], "--out: a study that is resumed stays in its directory"),
        (["sweep", "counting.yaml", "seed=0,1", "--zip", "--random", "3"], "one of --zip, --random and --sobol"),
        (["sweep", "counting.yaml", "seed=0:5", "--random", "0"], "number: expected how many points to draw"),
        (["sweep", "counting.yaml", "seed=0,1", "--executor", "nosuch"], "no executor is named 'nosuch'"),
        (["sweep", "nothing.yaml", "seed=0,1"], "nothing.yaml: there is no such file"),
        (["sweep", "counting.yaml", "horizon=1,2"], "horizon: unknown key; did you mean 'problem.horizon'?"),
        (["sweep", "counting.yaml", "sed=0,1"], "sed: unknown key; did you mean 'seed'?"),
    ],
)
def test_a_command_at_fault_is_status_2_and_one_message(
    counting: Path, command: Command, tmp_path: Path, arguments: list[str], said: str
) -> None:
    before = sorted(tmp_path.iterdir())
    done = command(*arguments)
    assert (done.returncode, done.stdout) == (2, ""), done.stderr
    assert said in done.stderr and "Traceback" not in done.stderr
    assert [path for path in sorted(tmp_path.iterdir()) if path.name != "__pycache__"] == before


def test_the_command_prints_a_table_and_where_everything_is(counting: Path, command: Command, tmp_path: Path) -> None:
    (tmp_path / "fail2").touch()
    done = command("sweep", counting, "method.number=1:3:3", "--out", "out")
    assert done.returncode == 5
    lines = done.stdout.splitlines()
    assert lines[1].split() == ["method.number", "status", "cost", "relative", "gap", "active", "seconds"]
    assert [line.split()[1] for line in lines[2:5]] == ["certified", "failed", "certified"]
    assert "3 of 3 points: 2 certified, 1 failed" in lines
    assert any(line.startswith("failed: method.number=2: ") for line in lines)
    assert lines[-1] == "written to out"


def test_on_a_terminal_the_last_rows_are_shown_and_disappear(monkeypatch: pytest.MonkeyPatch) -> None:
    from sparserob_core.experiment.cli.shell import live_table

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    written = Terminal()
    monkeypatch.setattr(sys, "stderr", written)
    monkeypatch.setattr(live_table, "SECONDS_PER_LOOK", 0.0)
    monkeypatch.setenv("TERM", "xterm")
    with live_table.LiveTable() as live:
        for number in range(30):
            row = {"seed": number, "status": "certified", "cost": 0.5 + number}
            text = f"{number + 1} of 30 points done \x1b[31m"
            live.receive(sr.SweepProgress(text=text, done=number + 1, total=30, row=row, axes=["seed"]))
        shown = written.getvalue().rpartition("relative gap")[2]
    assert [line.split()[:3] for line in shown.splitlines() if "certified" in line] == [
        [str(number), "certified", str(0.5 + number)] for number in range(18, 30)
    ]
    assert "30 of 30 points done \\x1b[31m" in shown
    assert written.getvalue().endswith("\x1b[2K")  # the last of the lines is erased


def test_a_quiet_sweep_prints_nothing(counting: Path, command: Command) -> None:
    done = command("sweep", counting, "method.number=1,2", "--out", "out", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_json_is_the_study_and_nothing_else(counting: Path, command: Command) -> None:
    done = command("sweep", counting, "method.number=1:3:3", "--out", "out", "--json")
    data = json.loads(done.stdout)
    assert (done.returncode, data["points"], data["counts"], data["axes"]) == (
        0,
        3,
        {"certified": 3},
        ["method.number"],
    )
    assert [row["cost"] for row in data["table"]] == [cost_of(number) for number in (1, 2, 3)]


def test_a_run_says_where_it_comes_from(counting: Path, tmp_path: Path) -> None:
    from hashlib import sha256

    study = sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out")
    origin = study.outcomes[0].summary["provenance"]
    assert origin["plugins"] == {
        str(tmp_path / "counting.py"): sha256((tmp_path / "counting.py").read_bytes()).hexdigest()
    }
    assert origin["host"]["cores"] >= 1
    assert time.strptime(origin["started"], "%Y-%m-%dT%H:%M:%SZ")
    assert origin["git"] is None  # no repository there


def test_the_revision_of_a_repository_is_told_and_whether_it_was_changed(counting: Path, tmp_path: Path) -> None:
    import subprocess

    from sparserob_core.experiment.directory.provenance import git_revision

    def git(*arguments: str) -> None:
        author = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *author, *arguments], cwd=tmp_path, check=True, capture_output=True)

    if shutil.which("git") is None:
        pytest.skip("there is no git")
    git("init")
    git("add", "counting.yaml")
    git("commit", "-m", "one")
    first = git_revision(tmp_path)
    assert first is not None and len(first["revision"]) == 40 and not first["changed"]
    counting.write_text(counting.read_text() + "# changed\n")
    assert git_revision(tmp_path) == {**first, "changed": True}


def test_a_lock_of_the_study_is_let_go_whatever_its_end(counting: Path, tmp_path: Path) -> None:
    with pytest.raises(sr.PluginError):
        sr.sweep(counting, {"method.number": [1, 2]}, out=tmp_path / "out", executor={"name": "serial"}, notify=_odd)
    assert not (tmp_path / "out" / NAME).exists()
    Lock(tmp_path / "out").acquire()


def _odd(event: sr.Event) -> None:
    raise sr.PluginError("an observer of the study is at fault")
