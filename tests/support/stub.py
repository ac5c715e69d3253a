"""A method that solves nothing, as a one-file plugin: what is tested around it is the wing that runs experiments."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

STUB = '''
import time
import numpy as np
import sparserob_core as sr

class Stub(sr.Method, sr.Options):
    """Returns half a unit of control on the first pieces."""
    rounds: int = 2
    """How many rounds it pretends to need."""
    wait: float = 0.0
    """Seconds that each of them takes."""
    status: str = "certified"
    """What it claims."""
    tolerance: float = 1e-7
    """Not used."""
    fail: bool = False
    """Whether to raise after the first round."""

    def solve(self, program, tools):
        history = []
        for k in range(self.rounds):
            history.append(sr.RoundFinished(round=k + 1, epsilon=1.0, lower_bound=float(k),
                                            upper_bound=float("inf"), violation=0.1))
            tools.notify(history[-1])
            time.sleep(self.wait)
            if self.fail:
                raise RuntimeError("the stub fell over")
        if self.status == "infeasible":
            return sr.Result(status="infeasible", message="the stub says so", history=history)
        x = np.zeros(program.n)
        x[:3] = tools.rng.random(3)
        witness = sr.Witness(violation=-0.1, constraint="terminal", index=np.array([2.0]), time=2.0)
        cuts = [sr.Cut("path", np.array([1.0]), 0, 2.0), sr.Cut("terminal", np.array([2.0, 0.3]), 1, 0.0)]
        return sr.Result(status=self.status, message="the stub says so", decision=x, cost=1.0, value=1.5,
                         epsilon=1.0, lower_bound=1.0, upper_bound=1.0, worst=witness, indices=cuts, history=history,
                         counts={"relaxed_programs": 4}, seconds=0.25)

@sr.hookimpl
def sparserob_methods():
    yield sr.MethodPlugin(name="stub", factory=Stub, summary="Solves nothing.")
'''

CONFIG = """\
title: A double integrator
problem:
  name: linear
  system:
    A: [[0, 1], [0, 0]]
    B: [[0], [1]]
  horizon: 2.0
  initial_state: [1, 0]
  control: {box: 1.0}
  terminal: [{box: [0.5, 0.5]}]
dictionaries:
  control: {name: piecewise_constant, pieces: 10}
method: {name: stub}
plugins: [./stub.py]
"""


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A small config whose method is the stub."""
    (tmp_path / "stub.py").write_text(STUB)
    file = tmp_path / "small.yaml"
    file.write_text(CONFIG)
    return file


Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Command:
    """The command ``sparserob`` in the temporary directory, called in this process, which keeps its own signals: the
    status, and what is written."""
    from sparserob_core.experiment.cli.main import main

    def call(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
        given, out, err = [str(argument) for argument in arguments], io.StringIO(), io.StringIO()
        with monkeypatch.context() as here, redirect_stdout(out), redirect_stderr(err):
            here.chdir(tmp_path)
            here.setattr("sparserob_core.experiment.cli.main.listen", lambda: None)
            for name, value in {"COLUMNS": "200", **environment}.items():
                here.setenv(name, value)
            with pytest.raises(SystemExit) as end:
                main(given)
        return subprocess.CompletedProcess(given, int(end.value.code or 0), out.getvalue(), err.getvalue())

    return call


@pytest.fixture
def process(tmp_path: Path) -> Command:
    """The command ``sparserob`` in a process of its own, in the temporary directory: where the process is what is
    tested."""

    def call(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "sparserob_core", *map(str, arguments)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
            env={**os.environ, "COLUMNS": "200", **environment},
        )

    return call
