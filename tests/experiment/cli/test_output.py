"""Guards the standard output: it belongs to the command, whatever components and libraries print meanwhile, here and in
workers."""

from __future__ import annotations

import io
import json
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from sparserob_core.experiment.terminal.printing import own_output, say
from tests.support.places import ROOT
from tests.support.stub import Command

LOUD = '''
import atexit, ctypes, os, sys
import numpy as np
import sparserob_core as sr

print("loud: at import")


class Loud(sr.DictionaryFactory, sr.Options):
    """Two pieces, and every way to print."""

    def build(self, horizon):
        print("loud: printed")
        sys.stdout.write("loud: written\\n")
        sys.__stdout__.write("loud: to the first stream\\n")
        sys.stdout.buffer.write(b"loud: bytes\\n")
        os.write(1, b"loud: by descriptor\\n")
        os.system("echo loud: by a child")
        atexit.register(print, "loud: at exit")
        return sr.Dictionary([0.0, horizon / 2, horizon], np.eye(2))


@sr.hookimpl
def sparserob_dictionaries():
    yield sr.DictionaryPlugin(name="loud", factory=Loud, summary="Loud.")
'''
CONFIG = """
title: two pieces
problem:
  name: linear
  system: {A: [[0, 1], [0, 0]], B: [[0], [1]]}
  horizon: 2.0
  initial_state: [1, 0]
  control: {box: 2.0}
  terminal: [{box: [0.5, 0.5]}]
dictionaries: {control: loud}
plugins: [./loud.py]
"""
WAYS = {"at import", "printed", "written", "to the first stream", "bytes", "by descriptor", "by a child", "at exit"}


@pytest.fixture
def loud(tmp_path: Path) -> Path:
    """A config whose dictionary prints."""
    (tmp_path / "loud.py").write_text(LOUD)
    file = tmp_path / "loud.yaml"
    file.write_text(CONFIG)
    return file


def ways(text: str) -> set[str]:
    """In which ways something was printed."""
    return set(re.findall(r"^loud: (.*)$", text, re.MULTILINE))


def test_a_component_that_prints_does_not_break_json(loud: Path, process: Command) -> None:
    done = process("run", loud, "--json", "--no-figures", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["status"] == "certified"
    assert ways(done.stderr) == WAYS, "what is printed is not lost either"


@pytest.mark.slow  # workers start
@pytest.mark.parametrize("executor", ["serial", "{name: processes, workers: 2}", "{name: dask, workers: 2}"])
def test_a_component_that_prints_in_a_worker_does_not_break_json(loud: Path, process: Command, executor: str) -> None:
    if "dask" in executor:
        pytest.importorskip("distributed")
    study = ("problem.horizon=2.0,2.5", f"executor={executor}")
    done = process("sweep", loud, *study, "--json", "--no-figures", "--out", "out")
    assert done.returncode == 0, done.stderr
    assert "certified" in json.dumps(json.loads(done.stdout))
    assert "printed" in ways(done.stderr)


def test_what_the_command_says_is_told_apart_from_what_others_print() -> None:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        with own_output():
            say("the result")
            print("somebody else")
            assert sys.stdout.isatty() == err.isatty()
        print("afterwards")
    assert (out.getvalue(), err.getvalue()) == ("the result\nafterwards\n", "somebody else\n")


def test_help_and_version_are_on_the_standard_output(process: Command) -> None:
    for question in (["--version"], ["run", "--help"]):
        done = process(*question)
        assert (done.returncode, done.stderr) == (0, "")
        assert "sparserob" in done.stdout


def test_commands_say_what_they_say_through_one_door() -> None:
    files = [*ROOT.glob("sparserob_core/experiment/cli/c*/*.py"), *ROOT.glob("sparserob_core/experiment/terminal/*.py")]
    lines = [(file.name, line.strip()) for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    astray = [
        f"{name}: {line}"
        for name, line in lines
        if re.search(r"(?<![.\w])print\(|click\.echo|sys\.stdout\.write", line) and "err=True" not in line
    ]
    assert astray == ["printing.py: click.echo(as_utf8(text), file=output())"]
