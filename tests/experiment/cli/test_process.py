"""Guards experiment/cli/shell and directory/lock: signals end a command with what it knows, two runs never share a
directory, and standard streams that take nothing are told of in one line."""

from __future__ import annotations

import io
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.cli.shell.process import hand_back_output, open_streams
from sparserob_core.experiment.directory.artefacts import create_directory
from sparserob_core.experiment.directory.lock import NAME, Lock, is_free
from sparserob_core.experiment.terminal.printing import printable, say
from tests.support.stub import Command

TELLING = '''
import time

import numpy as np
import sparserob_core as sr


class Telling(sr.Method, sr.Options):
    """Tells of rounds with their decisions for ever."""

    def solve(self, program, tools):
        number = 0
        while True:
            number += 1
            tools.notify(sr.RoundFinished(round=number, epsilon=0.5, lower_bound=0.25, upper_bound=7.0, violation=0.1,
                                          relaxed_programs=3 * number, cost=1.5, decision=np.full(program.n, 0.1)))
            time.sleep(0.05)


@sr.hookimpl
def sparserob_methods():
    yield sr.MethodPlugin(name="telling", factory=Telling, summary="Tells.")
'''
MARGIN = """\
problem:
  name: linear
  system: {A: [[0, 1], [0, 0]], B: [[0], [1]]}
  horizon: 2.0
  initial_state: [1, 0]
  control: {box: 1.5}
  disturbance: {box: [0.02, 0.05]}
  path: [{box: [1.1, 2.0]}]
  terminal: [{box: [0.5, 0.6]}]
dictionaries: {control: {name: piecewise_constant, pieces: 20}}
"""


@contextmanager
def started(*arguments: object, cwd: Path) -> Iterator[subprocess.Popen[str]]:
    """The command in a process of its own, which hears Ctrl-C also where the tests were started in the background, and
    which is gone afterwards whatever happens."""
    process = subprocess.Popen(
        [sys.executable, "-m", "sparserob_core", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=cwd,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


WORDS = {signal.SIGINT: "interrupted from the keyboard", signal.SIGTERM: "interrupted by SIGTERM"}


@pytest.mark.parametrize("number", [pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM])
def test_an_interrupted_run_without_a_decision_leaves_its_rounds(config: Path, tmp_path: Path, number: int) -> None:
    out = tmp_path / "out"
    with started("run", config, "method.wait=0.2", "method.rounds=500", "--out", out, cwd=tmp_path) as process:
        wait_for((out / "result.json").exists)
        assert json.loads((out / "result.json").read_text())["message"] == "the run has not finished"
        time.sleep(0.5)
        os.kill(process.pid, number)
        _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said.strip().startswith(f"error: {WORDS[signal.Signals(number)]}")
    assert f"what was done until then is in {out}" in said
    result = json.loads((out / "result.json").read_text())
    assert (result["status"], result["message"]) == ("failed", WORDS[signal.Signals(number)])
    assert sorted(path.name for path in out.iterdir()) == ["config.yaml", "result.json", "trace.npz"]


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupted_run_keeps_its_last_control_and_claims_nothing_of_it(
    config: Path, tmp_path: Path, number: int
) -> None:
    (tmp_path / "telling.py").write_text(TELLING)
    out = tmp_path / "out"
    arguments = ("run", config, "method=telling", "plugins=[telling.py]", "--out", out)
    with started(*arguments, cwd=tmp_path) as process:
        wait_for((out / "result.json").exists)
        time.sleep(1.0)
        os.kill(process.pid, number)
        table, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert f"undecided: {WORDS[signal.Signals(number)]} after round" in table
    result = json.loads((out / "result.json").read_text())
    assert result["status"] == "undecided"
    assert result["cost"] > 0.0
    assert result["lower_bound"] == 0.0  # the method tells another one, which nothing proves
    assert (result["upper_bound"], result["gap"]) == (None, None)
    assert result["counts"]["relaxed_programs"] == 3 * result["counts"]["rounds"] > 0
    with np.load(out / "solution.npz") as solution:
        assert (solution["control"] == 0.1).all()
    files = sorted(path.name for path in out.iterdir())
    assert [name for name in files if not name.startswith("adversary")] == [
        "certificate.json",
        "config.yaml",
        "result.json",
        "rounds.npz",
        "solution.npz",
        "trace.npz",
    ]


def test_what_stopped_a_search_is_told_in_the_words_of_the_signal() -> None:
    def value(points: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt("interrupted by SIGTERM")

    report = sr.maximise(value, sr.Box([0.0], [1.0]), "random_search", budget=10)
    assert report.stopped == "interrupted by SIGTERM"


def test_a_signal_that_is_ignored_stays_ignored(config: Path, tmp_path: Path) -> None:
    program = (
        "import signal, sys\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "from sparserob_core.experiment.cli.shell.process import listen\nlisten()\n"
        "assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing is forked here")
def test_a_child_that_is_forked_ends_at_a_sigterm_however_early_it_comes() -> None:
    program = """
import os, signal, time
from sparserob_core.experiment.cli.shell.process import listen
listen()
listen()
for _ in range(5):
    child = os.fork()
    if not child:
        time.sleep(60)
        os._exit(7)
    os.kill(child, signal.SIGTERM)
    deadline = time.monotonic() + 20
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.001)
    assert ended[1] == signal.SIGTERM, ended
assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])
"""
    subprocess.run([sys.executable, "-c", program], check=True)


class Press:
    """Presses Ctrl-C at the study's progress of that number."""

    def __init__(self, number: int) -> None:
        self.number, self.heard = number, 0

    def __call__(self, event: sr.Event) -> None:
        self.heard += isinstance(event, sr.StudyProgress)
        if self.heard == self.number:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_an_interrupted_margin_leaves_what_it_has_proven(tmp_path: Path) -> None:
    file = tmp_path / "margin.yaml"
    file.write_text(MARGIN)
    whole, count = sr.margin(file, curve=0), Press(-1)
    sr.margin(file, curve=0, notify=count)
    for number in range(1, count.heard + 1):
        found = sr.margin(file, curve=0, out=tmp_path / f"out{number}", notify=Press(number))
        written = json.loads((tmp_path / f"out{number}" / "margin.json").read_text())
        assert (written["status"], written["message"]) == (found.status, found.message)
        assert found.status == "undecided"
        assert "interrupted from the keyboard" in found.message
        assert not found.lower > whole.upper  # what it claims is true: nan where it claims nothing
        assert not found.upper < whole.lower


SLOW = """\
import time
from pathlib import Path

import sparserob_core as sr
from sparserob_piqp import Piqp


class Slow(Piqp):
    def solve(self, program, accuracy):
        claim = super().solve(program, accuracy)
        with Path("solved").open("a") as file:
            file.write("x")
        time.sleep(0.3 if len(Path("solved").read_text()) >= 4 else 0.0)
        return claim


@sr.hookimpl
def sparserob_solvers():
    yield sr.SolverPlugin(name="slow", factory=Slow, summary="Takes its time after the fourth program.")
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", WORDS)
@pytest.mark.parametrize(
    ("command", "file", "words"),
    [
        (("margin", "--curve", "0"), "margin.json", "undecided: {} after"),
        (("initial-states", "--directions", "32"), "initial_states.json", "{}"),
    ],
)
def test_a_study_that_is_ended_by_a_signal_writes_what_is_known(
    command: tuple[str, ...], file: str, words: str, number: int, tmp_path: Path
) -> None:
    (tmp_path / "config.yaml").write_text(MARGIN + "solver: {name: slow}\nplugins: [slow.py]\nobservers: []\n")
    (tmp_path / "slow.py").write_text(SLOW)
    name, *options = command
    with started(name, "config.yaml", *options, "--out", "out", cwd=tmp_path) as process:
        wait_for(lambda: (tmp_path / "solved").exists() and len((tmp_path / "solved").read_text()) >= 5)
        os.kill(process.pid, number)
        table, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert words.format(WORDS[signal.Signals(number)]) in table + said
    assert "Traceback" not in said
    assert WORDS[signal.Signals(number)] in json.loads((tmp_path / "out" / file).read_text())["message"]


LARGE = """\
problem:
  name: linear
  system:
    A: [[0, 1, 0, 0], ["-1 - p1", -0.1, "p2", 0], [0, 0, 0, 1], ["p1 * p2", 0, "-2 - p2", -0.1]]
    B: [[0], [1], [0], ["1 + p1"]]
    E: [[0], [1], [0], [1]]
    parameters: {p1: [-0.1, 0.1], p2: [-0.1, 0.1]}
  horizon: 20.0
  initial_state: [1, 0, 0.5, 0]
  control: {box: 2.0}
  disturbance: {box: 0.01}
  path: [{box: 5.0}]
dictionaries: {control: {pieces: 50000}}
limits: {seconds: 0.02}
observers: []
"""


@pytest.mark.slow
def test_a_limit_ends_a_transcription_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sparserob_core.sip.limits.deadline.LIMIT_GRACE_SECONDS", 0.0)
    (tmp_path / "large.yaml").write_text(LARGE)
    outcome = sr.run(tmp_path / "large.yaml", out=tmp_path / "run")
    assert (outcome.status, outcome.result.lower_bound, outcome.control) == ("undecided", 0.0, None)
    assert sr.check(tmp_path / "run").status == "verified"
    for study in (sr.margin, sr.initial_states):
        with pytest.raises(
            sr.TimeLimitError, match=r"the limit of 0.02 s is reached while the problem was transcribed"
        ):
            study(tmp_path / "large.yaml", out=tmp_path / "out")
        assert not (tmp_path / "out").exists()
    assert sr.TimeLimitError.exit_status == 4


@pytest.mark.slow
def test_interrupted_initial_states_leave_true_polygons(tmp_path: Path) -> None:
    file = tmp_path / "states.yaml"
    file.write_text(MARGIN)
    whole = sr.initial_states(file, directions=8, values=2)
    for number in (2, 4, 7):
        out = tmp_path / f"out{number}"
        found = sr.initial_states(file, directions=8, values=2, out=out, notify=Press(number))
        assert "interrupted from the keyboard" in found.message
        assert (out / "initial_states.json").is_file()
        assert found.inner_area <= whole.outer_area
        assert found.outer_area >= whole.inner_area
        for vertex in found.inner:
            assert whole.where(vertex) != "outside"
        for vertex in 0.99 * whole.inner + 0.01 * whole.inner.mean(axis=0):
            assert found.where(vertex) != "outside"


@pytest.mark.slow
def test_of_two_runs_into_one_directory_the_second_ends_at_once(config: Path, tmp_path: Path, command: Command) -> None:
    out = tmp_path / "out"
    with started("run", config, "method.wait=0.2", "method.rounds=500", "--out", out, cwd=tmp_path) as process:
        wait_for((out / "result.json").exists)
        began = time.monotonic()
        done = command("run", config, "--out", out)
        assert time.monotonic() - began < 30
        assert done.returncode == 2
        assert f"another run is writing into it (process {process.pid} on {platform.node()})" in done.stderr
        assert len(done.stderr.splitlines()) == 1
        assert json.loads((out / "result.json").read_text())["message"] == "the run has not finished"


@pytest.mark.slow
def test_of_many_that_start_at_once_one_gets_the_directory(config: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    call = [sys.executable, "-m", "sparserob_core", "run", str(config), "--out", str(out), "--no-figures", "--quiet"]
    processes = [subprocess.Popen(call, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    said = [process.communicate(timeout=120)[1] for process in processes]
    assert sorted(process.returncode for process in processes) == [0, 2, 2], said
    assert not (out / NAME).exists()


def test_the_lock_is_gone_when_a_run_is_over_whatever_its_end(config: Path, tmp_path: Path) -> None:
    sr.run(config, out=tmp_path / "well", quiet=True, figures=False)
    with pytest.raises(sr.PluginError):
        sr.run(config, {"method.fail": True}, out=tmp_path / "ill", quiet=True)
    assert not [*tmp_path.glob("*/.*")]


def test_the_lock_of_a_process_that_was_killed_is_free_whatever_stands_in_its_file(tmp_path: Path) -> None:
    hold = (
        "import sys, time; from pathlib import Path; from sparserob_core.experiment.directory.lock import Lock\n"
        "lock = Lock(Path(sys.argv[1])); lock.acquire(); print('held', flush=True); time.sleep(60.0)"
    )
    with subprocess.Popen([sys.executable, "-c", hold, str(tmp_path)], stdout=subprocess.PIPE) as owner:
        assert owner.stdout is not None and owner.stdout.readline() == b"held\n"
        with pytest.raises(sr.InputError, match=f"another run is writing into it .process {owner.pid} on "):
            create_directory(tmp_path, "demo", "0123abcd")
        assert not is_free(tmp_path)
        (tmp_path / NAME).write_text("")
        with pytest.raises(sr.InputError, match="whose number is not written yet"):
            create_directory(tmp_path, "demo", "0123abcd")
        owner.kill()
    for left in ("", json.dumps({"process": os.getppid(), "host": "elsewhere"})):
        (tmp_path / NAME).write_text(left)
        with create_directory(tmp_path, "demo", "0123abcd"):
            assert json.loads((tmp_path / NAME).read_text())["process"] == os.getpid()
        assert not [*tmp_path.iterdir()]


def test_a_lock_is_released_by_its_owner_alone_and_by_any_of_its_threads(tmp_path: Path) -> None:
    held, stranger = Lock(tmp_path), Lock(tmp_path)
    held.acquire()
    stranger.release()
    assert not is_free(tmp_path)
    thread = threading.Thread(target=held.release)
    thread.start()
    thread.join()
    assert is_free(tmp_path) and not (tmp_path / NAME).exists()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_a_child_that_outlives_its_parent_keeps_no_lock(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys, time; from pathlib import Path\n"
        "from sparserob_core.experiment.directory.lock import Lock\n"
        "lock = Lock(Path(sys.argv[1])); lock.acquire(); child = os.fork()\n"
        "if not child: time.sleep(60.0)\n"
        "print(child, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.wait(10.0)
        try:
            assert is_free(tmp_path)
        finally:
            os.kill(child, signal.SIGKILL)


def test_what_a_dead_run_has_left_is_not_written_over(tmp_path: Path) -> None:
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, check=True)
    (tmp_path / NAME).write_text(json.dumps({"process": int(dead.stdout), "host": platform.node()}))
    (tmp_path / "result.json").write_text("{}")
    with pytest.raises(sr.InputError, match="expected a new or an empty directory, got one that holds files"):
        create_directory(tmp_path, "demo", "0123abcd")
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("redirection", "status", "said"),
    [
        (">&-", 5, "error: the standard output cannot be written: it is closed\n"),
        (">/dev/full", 5, "error: the standard output cannot be written: No space left on device\n"),
        ("2>&- >/dev/null", 0, ""),
    ],
)
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_an_output_that_takes_nothing_is_told_in_one_line(
    redirection: str, status: int, said: str, unbuffered: str
) -> None:
    if "full" in redirection and not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    done = subprocess.run(
        f"exec {sys.executable} -m sparserob_core plugins {redirection}",
        shell=True,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
    )
    assert (done.returncode, done.stderr) == (status, said)


@pytest.mark.slow
def test_a_quiet_run_needs_no_output(config: Path, tmp_path: Path) -> None:
    done = subprocess.run(
        f"exec {sys.executable} -m sparserob_core run {config} --out out --quiet --no-figures >&-",
        shell=True,
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("error", ["MemoryError", "MemoryError('x')", "RuntimeError"])
def test_no_message_ends_in_a_colon_without_words(config: Path, command: Command, tmp_path: Path, error: str) -> None:
    stub = tmp_path / "stub.py"
    stub.write_text(stub.read_text().replace('RuntimeError("the stub fell over")', error))
    done = command("run", config, "method.fail=true", "--out", "out")
    assert done.returncode == 5
    assert ": ;" not in done.stderr
    assert (": \n" not in done.stderr) and ("Traceback" not in done.stderr)


def test_control_characters_of_a_title_do_not_reach_the_terminal(config: Path, command: Command) -> None:
    done = command("run", config, "title='\"red \\e[31m and \\a\"'".replace("'", ""), "--out", "out", "--no-figures")
    assert done.returncode == 0, done.stderr
    assert "\x1b" not in done.stdout and "\a" not in done.stdout
    assert "red \\x1b[31m and \\x07" in done.stdout
    assert "\x1b" not in command("compare", "out").stdout


@pytest.mark.parametrize(
    "command_line", [["simulate", "out", "--trajectories", "3", "--out", "x.png"], ["compare", "out"]]
)
def test_a_missing_matplotlib_is_a_note_beside_the_result(
    config: Path, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command_line: list[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    file = tmp_path / "margin.yaml"
    file.write_text(MARGIN)
    note = "no figure: matplotlib is not installed; `pip install 'matplotlib>=3.9'` brings it"
    done = command("run", file, "--out", "out")
    assert (done.returncode, note in done.stdout) == (0, True), done.stdout + done.stderr
    done = command(*command_line)
    assert (done.returncode, note in done.stdout) == (0, True), done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "study", [("margin", "--curve", "2"), ("initial-states", "--directions", "4", "--values", "0")], ids=lambda a: a[0]
)
def test_a_study_without_matplotlib_has_a_note_and_its_own_status(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, study: tuple[str, ...]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    file = tmp_path / "margin.yaml"
    file.write_text(MARGIN)
    done = command(study[0], file, *study[1:], "--out", "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "no figure: matplotlib is not installed; `pip install 'matplotlib>=3.9'` brings it" in done.stdout


def test_modules_that_scipy_looks_at_are_imported_only_when_something_of_them_is_used() -> None:
    code = (
        "import sys; from sparserob_core.experiment.cli.shell.process import spare_imports; spare_imports();"
        " import scipy.sparse; before = {'numpy.f2py.crackfortran', 'numpy.polynomial.chebyshev'} & set(sys.modules);"
        " import numpy.f2py; print(before, callable(numpy.f2py.get_include), callable(numpy.testing.assert_allclose),"
        " numpy.polynomial.Polynomial([1.0, 2.0])(3.0) == 7.0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["set()", *["True"] * 3]


NARROW = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.slow
def test_titles_overrides_and_paths_outlive_a_locale_that_has_no_letters_for_them(config: Path, tmp_path: Path) -> None:
    there = config.rename(tmp_path / "überall.yaml")
    (tmp_path / "stub.py").rename(tmp_path / "stüb.py")
    there.write_text(there.read_text("utf-8").replace("stub.py", "stüb.py"), "utf-8")
    given = ["title=Wärme in °C", "observers=[{name: progress, patience: 600}]", "--no-figures", "--out", "rü"]
    command = [sys.executable, "-m", "sparserob_core", "run", there, *given]
    done = subprocess.run(command, cwd=tmp_path, env=NARROW, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    first, *_, last = done.stdout.decode().splitlines()
    assert (first, last) == ("Wärme in °C", "written to rü")
    assert "title: Wärme in °C" in (tmp_path / "rü" / "config.yaml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_an_argument_that_is_no_text_in_any_encoding_is_an_error_of_the_override(config: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sparserob_core", "run", config, b"title=\xff", "--out", "r"]
    done = subprocess.run(command, cwd=tmp_path, env=NARROW, capture_output=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(b"error: override value") and done.stderr.count(b"\n") == 1


def test_the_interpreter_gets_its_own_kind_of_output_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """At its end Python 3.13 flushes the standard output after the names of every module are gone."""
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    open_streams()
    print("é", end="")  # ASCII says nothing of the bytes of letters that it has not
    assert type(sys.stdout) is not io.TextIOWrapper
    hand_back_output()
    assert type(sys.stdout) is io.TextIOWrapper
    sys.stdout.flush()
    assert written.getvalue().decode() == "é"


@pytest.mark.parametrize(
    ("encoding", "expected"),
    [
        ("ascii", "läufe ホ \\xe4".encode()),
        ("utf-8", "läufe ホ \\xe4".encode()),
        ("latin-1", b"l\xe4ufe \\u30db \\xe4"),
    ],
)
def test_a_path_that_is_printed_can_be_pasted_unless_its_bytes_may_steer_the_terminal(
    monkeypatch: pytest.MonkeyPatch, encoding: str, expected: bytes
) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding=encoding))
    open_streams()
    say(printable(("läufe ホ ".encode() + b"\xe4").decode("ascii", "surrogateescape")))
    hand_back_output()
    sys.stdout.flush()
    assert written.getvalue() == expected + b"\n"
