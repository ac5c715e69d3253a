"""Tests in processes of their own: what each costs and which functions it calls; and whether they notice a mutant."""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import importlib
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Generator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.mutants.sites import Mutant

STAGE = "(long or not slow) and not benchmark"  # what is run: the first stage, and what takes long
PATIENCE, AT_LEAST = 3.0, 30  # times the processor time of the unchanged tests, and seconds: only loops that never end
FIRST_STAGE = 3000  # seconds of the processor: four times what all of the first stage takes
MEMORY = 4 * 2**30  # bytes, which no test of a folder comes near: a mutant may make arrays without end
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
    """Unchanged tests: seconds of the processor for all of them, those of each, and by whom a function is called. Tests
    go by their name, functions by path and line."""

    seconds: float
    each: dict[str, float]
    callers: dict[str, list[str]]

    def asked(self, mutant: Mutant) -> list[str]:
        """The tests that call the function of a mutant, those first that can say no for the least time: the files in
        the order of what they take, and so within each. What is not in a function is called by who calls any of the
        file."""
        names = [name for name in self.callers if name.startswith(f"{mutant.path}:")]
        if mutant.function:
            names = [name for name in names if name == f"{mutant.path}:{mutant.function}"]
        tests = {test for name in names for test in self.callers[name]}
        files = dict.fromkeys((_file(test) for test in tests), 0.0)
        for test in tests:
            files[_file(test)] += self.each[test]
        return sorted(tests, key=lambda test: (files[_file(test)], _file(test), self.each[test], test))


def baseline(copy: Path, targets: list[str], kept: Path) -> Baseline:
    """Run tests on the unchanged tree, and raise `RuntimeError` where one fails. What they said is ``kept`` in a folder
    for as long as no source file of the tree changes."""
    digest = hashlib.sha256(repr(targets).encode())
    for file in sorted(copy.rglob("*.py")):
        digest.update(str(file.relative_to(copy)).encode() + file.read_bytes())
    report = kept / f"{digest.hexdigest()[:16]}.json"
    if report.exists():
        return Baseline(**json.loads(report.read_text()))
    code = _in_a_process(copy, lambda: _pytest(targets, [_Callers(copy, copy / "baseline.json")]), 10 * FIRST_STAGE)
    if code not in (0, 5):
        raise RuntimeError(f"the tests of {targets} fail without any mutant:\n{_tail(copy)}")
    answer = Baseline(**json.loads((copy / "baseline.json").read_text()))
    kept.mkdir(exist_ok=True)
    report.write_text(json.dumps(asdict(answer)))
    return answer


def tested(copy: Path, mutant: Mutant, targets: list[str], cost: Baseline | None) -> Verdict:
    """Whether tests notice a mutant in a copy of the tree. Where it is known who calls its function, nobody else is
    asked."""
    plugins = list[Any]()
    if cost is not None:
        order = cost.asked(mutant)
        targets, plugins = list(dict.fromkeys(map(_file, order))), [_Chosen(order)]
        if not targets:
            return Verdict(False, "no test calls it", 0.0)
    limit = FIRST_STAGE if cost is None else max(AT_LEAST, int(PATIENCE * cost.seconds))
    file, started = copy / mutant.path, time.perf_counter()
    source = file.read_bytes()
    try:
        _written(file, mutant.applied(source))
        code = _in_a_process(copy, lambda: _pytest(["-x", *targets], plugins), limit)
    finally:
        _written(file, source)
    seconds = time.perf_counter() - started
    if code in (0, 5):
        return Verdict(False, "", seconds)
    return Verdict(True, "no end" if code < 0 else _failed(copy), seconds)


def _file(test: str) -> str:
    return test.split("::", maxsplit=1)[0]


def _written(file: Path, data: bytes) -> None:
    file.write_bytes(data)
    stamp = next(STAMPS)
    os.utime(file, (stamp, stamp))


def _pytest(arguments: list[str], plugins: list[Any]) -> int:
    return int(pytest.main(["-q", "-m", STAGE, "-p", "no:cacheprovider", "--tb=line", *arguments], plugins=plugins))


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
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
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


class _Chosen:
    """A plugin of pytest that runs so many tests and no other, in this order."""

    def __init__(self, order: list[str]) -> None:
        self.place = {test: place for place, test in enumerate(order)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted(
            (item for item in items if item.nodeid in self.place), key=lambda item: self.place[item.nodeid]
        )


class _Callers:
    """A plugin of pytest that notes which functions of the tree each test calls, and how long it takes.

    Whatever is remembered by `functools` is forgotten before each test, or the second one that needs an answer would
    seem not to ask for it; fixtures that several tests share are called by all of their file.
    """

    def __init__(self, copy: Path, report: Path) -> None:
        self.root, self.report = f"{copy}/", report
        self.callers, self.each = dict[str, set[str]](), dict[str, float]()
        self.asking, self.started = "", 0.0

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        for thing in gc.get_objects():
            if isinstance(thing, functools._lru_cache_wrapper):
                thing.cache_clear()
        self.asking, self.started = nodeid, time.process_time()
        sys.settrace(self._called)

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        sys.settrace(None)
        self.each[nodeid] = time.process_time() - self.started

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Generator[None, object, object]:
        test = self.asking
        if fixturedef.scope != "function":
            self.asking = _file(test)
        try:
            return (yield)
        finally:
            self.asking = test

    def pytest_sessionfinish(self) -> None:
        beside = dict[str, list[str]]()
        for test in self.each:
            beside.setdefault(_file(test), []).append(test)
        callers = {
            name: sorted({test for caller in callers for test in beside.get(caller, [caller])})
            for name, callers in self.callers.items()
        }
        seconds = sum(self.each.values())
        self.report.write_text(json.dumps({"seconds": seconds, "each": self.each, "callers": callers}))

    def _called(self, frame: Any, event: str, argument: object) -> None:
        code = frame.f_code
        if code.co_filename.startswith(self.root):
            name = f"{code.co_filename[len(self.root) :]}:{code.co_firstlineno}"
            self.callers.setdefault(name, set()).add(self.asking)
