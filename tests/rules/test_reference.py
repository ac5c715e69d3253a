"""Guards docs/reference.md: everything that can be named is documented, and the generated pages say what the program
says."""

from __future__ import annotations

import inspect
import runpy

import click

import sparserob_core as sr
from sparserob_core.experiment.cli.main import commands
from sparserob_core.experiment.config.option_rows import option_rows
from sparserob_core.experiment.plugins.commands import COMMANDS
from sparserob_core.experiment.plugins.hookspecs import HOOKS
from sparserob_core.options import meanings
from sparserob_core.sip.result import MEANING
from tests.support.places import ROOT


def test_the_generated_pages_are_up_to_date() -> None:
    for path, text in runpy.run_path(str(ROOT / "docs" / "build_reference.py"))["pages"]():
        assert path.read_text() == text, f"{path.relative_to(ROOT)} is out of date: make docs"


def test_every_maximiser_is_in_the_tables_that_compare_them_and_these_have_their_places() -> None:
    written = runpy.run_path(str(ROOT / "docs" / "build_maximisers.py"))
    assert {*written["NAMES"], "lipo"} == set(sr.load_registry().names("maximiser"))  # lipo wants a constant
    page = (ROOT / "docs" / "maximisers.md").read_text()
    for name in written["TABLES"]:
        assert page.count(f"<!-- {name}: by docs/build_maximisers.py -->") == 1
        assert page.count(f"<!-- end of {name} -->") == 1


def test_every_component_has_a_summary_and_every_option_a_meaning() -> None:
    records = list(sr.load_registry().records())
    silent = [str(record) for record in records if not record.summary]
    assert not silent + [
        f"{record}: {row.name}" for record in records for row in option_rows(record, ask=False) if not row.meaning
    ]


def test_every_hook_is_explained_to_authors() -> None:
    page = (ROOT / "docs" / "extending.md").read_text()
    assert not [hook for hook in HOOKS if f"`{hook}`" not in page]


def test_every_command_and_its_options_are_documented() -> None:
    page = (ROOT / "docs" / "reference.md").read_text()
    own = {name: commands.get_command(click.Context(commands), name) for name in COMMANDS}
    assert not [name for name in own if f"### `sparserob {name}`" not in page]
    assert not [name for name, command in own.items() if not command.help]
    options = [(name, option) for name, command in own.items() for option in command.params]
    assert not [f"{name} {one.name}" for name, one in options if isinstance(one, click.Option) and not one.help]


def test_every_public_name_has_a_docstring_of_its_own() -> None:
    things = {name: getattr(sr, name) for name in sr.__all__ if name != "Array"}
    silent = [name for name, thing in things.items() if not (thing.__doc__ or "").strip()]
    options = [(name, it) for name, it in things.items() if inspect.isclass(it) and issubclass(it, sr.Options)]
    silent += [f"{name}.{key}" for name, it in options for key, meaning in meanings(it).items() if not meaning]
    assert not silent


def test_every_status_is_explained() -> None:
    pages = {page: (ROOT / page).read_text() for page in ("README.md", "docs/method.md")}
    assert not [(page, status) for page, text in pages.items() for status in MEANING if f"| `{status}` |" not in text]
