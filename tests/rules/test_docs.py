"""Guards README.md and docs/: documentation is executed: every command and every snippet of README.md and docs/, in the
order in which a reader meets them.

A fence may carry ``title=name`` (it is saved under that name), ``status=n`` (the command must exit with that status)
and nothing else. The first stage calls the commands of three pages in the tests' own process, without figures; the
second one runs every page as a reader does, in a shell.
"""

from __future__ import annotations

import inspect
import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.support.places import ROOT
from tests.support.stub import Command

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "decisions").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)([^\n]*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\[[^\]]*\]\(([^)#\s]+)(?:#[^)]*)?\)")


@dataclass(frozen=True)
class Fence:
    """One block of a page: its language, its attributes, its text."""

    language: str
    attributes: dict[str, str]
    text: str


def fences(page: Path) -> Iterator[Fence]:
    for language, attributes, text in FENCE.findall(page.read_text()):
        if not attributes.startswith("{"):  # a directive of the site
            yield Fence(language, dict(item.split("=", 1) for item in attributes.split()), text)


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def environment(place: Path) -> dict[str, str]:
    """The tests' own interpreter first on the path, and a ``sparserob`` even where the scripts are not installed."""
    script = place / ".bin" / "sparserob"
    script.parent.mkdir()
    script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sparserob_core "$@"\n')
    script.chmod(0o755)
    return {
        **os.environ,
        "PATH": os.pathsep.join([str(script.parent), str(Path(sys.executable).parent), os.environ["PATH"]]),
    }


def execute(fence: Fence, place: Path, variables: dict[str, str]) -> None:
    if "title" in fence.attributes:
        (place / fence.attributes["title"]).write_text(fence.text)
        return
    command = {"bash": ["bash", "-e", "-c"], "python": [sys.executable, "-W", "error", "-c"]}.get(fence.language)
    if command is None:
        return
    done = subprocess.run(
        [*command, fence.text], cwd=place, env=variables, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == int(fence.attributes.get("status", "0")), f"{fence.text}\n{done.stdout}\n{done.stderr}"


def call(fence: Fence, place: Path, command: Command) -> None:
    """The same in the tests' own process, without figures."""
    if "title" in fence.attributes:
        (place / fence.attributes["title"]).write_text(fence.text)
    elif fence.language == "python":
        exec(compile(fence.text, "a snippet", "exec"), {"__name__": "__main__"})
    elif fence.language == "bash":
        for line in fence.text.splitlines():
            plain, _, status = line.partition(" || test $? = ")
            words, expected = shlex.split(plain, comments=True), int(status or fence.attributes.get("status", "0"))
            if words[:1] == ["sparserob"]:
                done = command(*words[1:], *([] if words[1] != "run" else ["--no-figures"]))
                assert done.returncode == expected, f"{line}\n{done.stdout}\n{done.stderr}"
            elif words:
                subprocess.run(["bash", "-e", "-c", line], cwd=place, check=True, capture_output=True)


EXECUTED = [page for page in PAGES if any(block.language in {"bash", "python"} for block in fences(page))]
LIGHT = {"README.md"}


@pytest.mark.slow
@pytest.mark.parametrize("page", sorted(LIGHT))
def test_what_most_readers_try_first_works(page: str, tmp_path: Path, command: Command, monkeypatch) -> None:
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    monkeypatch.chdir(tmp_path)
    for block in fences(ROOT / page):
        call(block, tmp_path, command)


@pytest.mark.slow
@pytest.mark.parametrize("page", [pytest.param(page, id=relative(page)) for page in EXECUTED])
def test_every_command_and_snippet_of_a_page_runs(page: Path, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    variables = environment(tmp_path)
    for block in fences(page):
        execute(block, tmp_path, variables)


def test_links_between_pages_lead_somewhere() -> None:
    links = [(page, link) for page in PAGES for link in LINK.findall(page.read_text())]
    inside = [(page, link) for page, link in links if not link.startswith(("http://", "https://"))]
    assert not [f"{relative(page)}: {link}" for page, link in inside if not (page.parent / link).exists()]


LONGEST = 40  # words of a sentence; 25 are many
CODE = re.compile(r"\$\$.+?\$\$|``.+?``|`[^`]+`|\$[^$\n]+\$", re.DOTALL)
BREAKS = re.compile(r"\n\s*\n|^\s*(?:-{3,}|[-*#>|]|\d+\.) *| \| |(?<=\.)\n", re.MULTILINE)


def long_sentences(text: str) -> list[str]:
    """Return the sentences of a text with too many words. A formula is one word; a cell or an item stands alone."""
    plain = CODE.sub("code", FENCE.sub("", text))
    parts = (part for block in BREAKS.split(plain) for part in re.split(r"(?<=[.!?:;])\s+", " ".join(block.split())))
    return [sentence for sentence in parts if len(sentence.split()) > LONGEST]


DOCSTRING = re.compile(r'^ *"""(?=[\w`])(.*?)"""', re.DOTALL | re.MULTILINE)


def docstrings(path: Path) -> Iterator[str]:
    """Yield the docstrings with enough words for a long sentence, without literal blocks and examples."""
    for text in DOCSTRING.findall(path.read_text()):
        if len(text.split()) > LONGEST:
            yield re.sub(r"::\n\n(?: {4}.*\n|\n)+", "\n\n", inspect.cleandoc(text)).split("\n>>>")[0]


def test_no_sentence_of_a_page_or_a_docstring_is_longer_than_a_reader_can_follow() -> None:
    modules = [
        path for folder in ("sparserob_core", "plugins", "tests") for path in sorted((ROOT / folder).rglob("*.py"))
    ]
    texts = [(page, page.read_text()) for page in (*PAGES, ROOT / "CHANGELOG.md", ROOT / "tests/mutants/README.md")]
    texts += [(path, text) for path in modules for text in docstrings(path)]
    assert not [f"{relative(path)}: {sentence}" for path, text in texts for sentence in long_sentences(text)]


def cells(line: str) -> int:
    return len(re.split(r"(?<!\\)\|", line.strip().strip("|")))


def test_rows_of_a_table_have_as_many_cells_as_its_head() -> None:
    """A rule of another length makes text with bars of it all, and further cells are lost without a word."""
    tables, wrong = 0, list[str]()
    for page in PAGES:
        lines = FENCE.sub("", page.read_text()).splitlines()
        for number, line in enumerate(lines):
            if re.fullmatch(r"\|[ :|-]*-[ :|-]*\|", line.strip()) and lines[number - 1].startswith("|"):
                rows = itertools.takewhile(lambda row: row.startswith("|"), lines[number:])
                tables, head = tables + 1, cells(lines[number - 1])
                wrong += [f"{relative(page)}: {row}" for row in rows if cells(row) != head]
    assert tables > 50
    assert not wrong


def test_make_targets_that_a_page_names_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = re.compile(r"\bmake ([a-z-]+)(?=`|\s{2,}#)")
    assert not {
        relative(page): unknown for page in PAGES if (unknown := set(named.findall(page.read_text())) - targets)
    }


def test_fences_carry_known_attributes_only() -> None:
    assert not [
        relative(page) for page in PAGES for block in fences(page) if set(block.attributes) - {"title", "status"}
    ]


@pytest.mark.slow
def test_the_python_of_the_readme_and_its_plugin_are_typed_as_the_package_is(tmp_path: Path) -> None:
    snippets = [fence.text for fence in fences(ROOT / "README.md") if fence.language == "python"]
    extending = fences(ROOT / "docs" / "extending.md")
    snippets += [fence.text for fence in extending if fence.attributes.get("title") == "gentle.py"]
    assert len(snippets) >= 2
    for number, text in enumerate(snippets):
        (tmp_path / f"snippet{number}.py").write_text(text)
    check = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--follow-imports=silent",
        "--cache-dir",
        str(tmp_path / "cache"),
    ]
    done = subprocess.run(
        [*check, *map(str, sorted(tmp_path.glob("*.py")))], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
