"""Tests in processes of their own: what they cost and which functions each file of them calls; and whether they notice
a mutant."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.mutants.sites import Mutant

PATIENCE, AT_LEAST = 3.0, 30  # times the processor time of the unchanged tests, and seconds: only loops that never end
FIRST_STAGE = 3000  # seconds of the processor: four times what all of the first stage takes
IDLE = 10.0  # times the seconds of the processor that a process may take of the clock: a busy machine, not a dead one
STAMPS = iter(range(1_000_000_000, 2_000_000_000, 2))  # of changed files, so that no compiled one is taken for it


@dataclass(frozen=True)
class Verdict:
    """Whether a test failed, which, and the seconds of the clock that it took."""

    killed: bool
    by: str
    seconds: float


@dataclass(frozen=True)
class Baseline:
    """Seconds of the processor for unchanged tests, and which files of tests call a function: by path and line."""

    seconds: float
    callers: dict[str, list[str]]


def baseline(copy: Path, targets: list[str]) -> Baseline:
    """Run tests on the unchanged tree, and raise `RuntimeError` where one fails."""
    report = copy / "baseline.json"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = _in_a_process(copy, lambda: _pytest(targets, [_Callers(copy, report)]), 10 * FIRST_STAGE)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if code not in (0, 5):
        raise RuntimeError(f"the tests of {targets} fail without any mutant:\n{_tail(copy)}")
    callers = json.loads(report.read_text()) if report.exists() else {}
    return Baseline(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, callers)


def tested(copy: Path, mutant: Mutant, targets: list[str], cost: Baseline | None) -> Verdict:
    """Whether tests notice a mutant in a copy of the tree. Where it is known who calls its function, nobody else is
    asked."""
    if cost is not None:
        # what is not in a function is called by who calls any function of the file
        names = [name for name in cost.callers if name.startswith(f"{mutant.path}:")]
        if mutant.function:
            names = [name for name in names if name == f"{mutant.path}:{mutant.function}"]
        targets = sorted({file for name in names for file in cost.callers[name]}, key=lambda file: _fit(file, mutant))
        if not targets:
            return Verdict(False, "no test calls it", 0.0)
    limit = FIRST_STAGE if cost is None else max(AT_LEAST, int(PATIENCE * cost.seconds))
    file, started = copy / mutant.path, time.perf_counter()
    source = file.read_bytes()
    try:
        _written(file, mutant.applied(source))
        code = _in_a_process(copy, lambda: _pytest(["-x", *targets], []), limit)
    finally:
        _written(file, source)
    seconds = time.perf_counter() - started
    if code in (0, 5):
        return Verdict(False, "", seconds)
    return Verdict(True, "no end" if code < 0 else _failed(copy), seconds)


def _fit(file: str, mutant: Mutant) -> tuple[bool, str]:
    """First the test of the same name."""
    return Path(mutant.path).stem not in Path(file).stem, file


def _written(file: Path, data: bytes) -> None:
    file.write_bytes(data)
    stamp = next(STAMPS)
    os.utime(file, (stamp, stamp))


def _pytest(arguments: list[str], plugins: list[Any]) -> int:
    import pytest

    return int(pytest.main(["-q", "-p", "no:cacheprovider", "--tb=line", *arguments], plugins=plugins))


def _in_a_process(copy: Path, work: Callable[[], int], limit: int) -> int:
    """The exit code of what is done in a copy of the tree, negative where a signal ended it. The heavy libraries are
    imported once, here; of the tree nothing is."""
    for name in ("numpy", "pytest", "scipy.linalg", "scipy.optimize", "flint"):
        importlib.import_module(name)
    child = os.fork()
    if child == 0:
        code = 70
        try:
            _moved(copy, limit)
            code = work()
        except BaseException:  # noqa: BLE001 - this process ends here, whatever it is
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(code)
    deadline = time.perf_counter() + IDLE * limit
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(status)
        if time.perf_counter() > deadline:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return -signal.SIGKILL
        time.sleep(0.02)


def _moved(copy: Path, limit: int) -> None:
    """Let this process see nothing but a copy of the tree, and end when its time is up."""
    os.setsid()
    output = os.open(copy / "output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
    here = [str(copy), str(copy / "plugins")]
    sys.path[:] = [*here, *(path for path in sys.path if path not in ("", str(Path.cwd())))]
    os.environ["PYTHONPATH"] = os.pathsep.join(here)
    os.chdir(copy)
    for name in [name for name in sys.modules if name.split(".")[0] == "tests"]:
        del sys.modules[name]


def _tail(copy: Path) -> str:
    return "\n".join((copy / "output.txt").read_text(errors="replace").splitlines()[-30:])


def _failed(copy: Path) -> str:
    lines = (copy / "output.txt").read_text(errors="replace").splitlines()
    names = [line.split()[1] for line in lines if line.startswith(("FAILED ", "ERROR "))]
    return names[0] if names else "no test could be run"


class _Callers:
    """A plugin of pytest that notes which functions of the tree each file of tests calls."""

    def __init__(self, copy: Path, report: Path) -> None:
        self.root, self.report, self.callers = f"{copy}/", report, dict[str, set[str]]()
        self.file = ""

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.file = nodeid.split("::", maxsplit=1)[0]
        sys.settrace(self._called)

    def pytest_runtest_logfinish(self) -> None:
        sys.settrace(None)

    def pytest_sessionfinish(self) -> None:
        self.report.write_text(json.dumps({name: sorted(files) for name, files in self.callers.items()}))

    def _called(self, frame: Any, event: str, argument: object) -> None:
        code = frame.f_code
        if code.co_filename.startswith(self.root):
            name = f"{code.co_filename[len(self.root) :]}:{code.co_firstlineno}"
            self.callers.setdefault(name, set()).add(self.file)
