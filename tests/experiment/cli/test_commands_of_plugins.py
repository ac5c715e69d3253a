"""Guards the commands of plugins: found by their entry points, listed, called, and each error of theirs with a name."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.stub import Command

PLUGIN = '''
import click
import sparserob_core as sr


@click.command()
@click.argument("word")
@click.option("--status", type=int, help="How it ends.")
def say_it(word, status):
    """Say the WORD."""
    if word == "secret":
        raise sr.InputError(path="word", expected="a word for all", got=word)
    if word == "broken":
        raise RuntimeError("it fell over")
    click.echo(f"I say {word}")
    return word if status is None else status


@sr.hookimpl
def sparserob_commands():
    yield sr.CommandPlugin(name="say_it", factory=say_it, summary="Say a word.")
'''


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A distribution with one command, first on the path."""
    folder = tmp_path / "site"
    information = folder / "talker-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: talker\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[sparserob]\ntalker = talker_plugin\n")
    (folder / "talker_plugin.py").write_text(PLUGIN)
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=":")
    return folder


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "sparserob_core", *arguments], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.slow  # five processes
def test_a_command_of_a_plugin_is_listed_called_and_its_errors_bear_its_name(installed: Path) -> None:
    assert "say-it          Say a word." in call("--help").stdout
    assert "Usage: sparserob say-it [OPTIONS] WORD" in call("say-it", "--help").stdout
    done = call("say-it", "hello", "--status", "4")
    assert (done.returncode, done.stdout, done.stderr) == (4, "I say hello\n", "")
    done = call("say-it", "secret")
    assert (done.returncode, done.stderr) == (2, "error: word: expected a word for all, got secret\n")
    done = call("say-it", "broken")
    origin = "command 'say_it' (plugin 'talker', talker 1.0, talker_plugin, hook sparserob_commands)"
    assert done.stderr == f"error: {origin}: running it raised RuntimeError: it fell over\n"
    done = call("say-it", "hello")
    assert done.stderr == (
        f"error: {origin}: running it returned 'hello', expected an exit status, 0 to 255, or nothing\n"
    )
    (installed / "talker_plugin.py").write_text("import nowhere")
    done = call("say-it", "hello")
    assert done.returncode == 2
    assert "no such command 'say-it'" in done.stderr and "No module named 'nowhere'" in done.stderr


def test_the_table_of_commands_is_what_the_core_registers(command: Command) -> None:
    from sparserob_core.experiment.plugins.builtin import sparserob_commands
    from sparserob_core.experiment.plugins.commands import COMMANDS

    records = list(sparserob_commands())
    assert [record.name.replace("_", "-") for record in records] == list(COMMANDS)
    assert all(record.summary.endswith(".") for record in records)
    said = command("--help").stdout
    assert not [name for name in COMMANDS if f"  {name} " not in said]
