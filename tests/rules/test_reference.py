"""Everything that can be named is documented, and the generated pages say what the program says."""

from __future__ import annotations

import inspect
import runpy
from pathlib import Path

import click
import pytest

import sparserob_core as sr
from sparserob_core.experiment.cli import commands
from sparserob_core.experiment.option_rows import option_rows
from sparserob_core.experiment.registry import HOOKS

ROOT = Path(__file__).resolve().parents[2]
RECORDS = list(sr.load_registry().records())


def test_the_generated_pages_are_up_to_date() -> None:
    for path, text in runpy.run_path(str(ROOT / "docs" / "build_reference.py"))["pages"]():
        assert path.read_text() == text, f"{path.relative_to(ROOT)} is out of date: make docs"


@pytest.mark.parametrize("record", RECORDS, ids=str)
def test_every_component_has_a_summary_and_every_option_a_meaning(record: sr.SolverPlugin) -> None:
    assert record.summary
    assert not [row.name for row in option_rows(record) if not row.meaning]


@pytest.mark.parametrize("hook", sorted(HOOKS))
def test_every_hook_is_explained_to_authors(hook: str) -> None:
    assert f"`{hook}`" in (ROOT / "docs" / "extending.md").read_text()


@pytest.mark.parametrize("command", sorted(commands.commands))
def test_every_command_and_its_options_are_documented(command: str) -> None:
    assert f"### `sparserob {command}`" in (ROOT / "docs" / "reference.md").read_text()
    assert commands.commands[command].help
    options = [parameter for parameter in commands.commands[command].params if isinstance(parameter, click.Option)]
    assert not [option.name for option in options if not option.help]


@pytest.mark.parametrize("name", [name for name in sr.__all__ if name != "Array"])
def test_every_public_name_has_a_docstring_of_its_own(name: str) -> None:
    thing = getattr(sr, name)
    assert thing.__doc__ and thing.__doc__.strip()
    if inspect.isclass(thing) and issubclass(thing, sr.Options):
        assert not [field for field, info in thing.model_fields.items() if not info.description]


@pytest.mark.parametrize("status", ["certified", "verified", "infeasible", "refuted", "undecided", "failed"])
def test_every_status_is_explained(status: str) -> None:
    for page in ("README.md", "docs/method.md"):
        assert f"| `{status}` |" in (ROOT / page).read_text()
