"""House rules: short functions and files, no catch-all modules, the same packages in every list, and no words from outside."""

from __future__ import annotations

import ast
import re
import tokenize
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted([*(ROOT / "sparserob_core").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")])
WRITTEN = ("*.md", "docs/**/*.md", "configs/*", "tests/**/*.py", "Makefile", "pyproject.toml")
PAGES = sorted({path for pattern in WRITTEN for path in ROOT.glob(pattern)} - {Path(__file__).resolve()})
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PLUGINS = {path.name for path in (ROOT / "plugins").glob("sparserob_*") if path.is_dir()}


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


def code_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its signature, docstring and blank lines."""
    body = node.body[1:] if ast.get_docstring(node) else node.body
    return len({line for statement in body for line in range(statement.lineno, (statement.end_lineno or 0) + 1)})


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_functions_are_short(path: Path) -> None:
    functions = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    assert not {node.name: code_lines(node) for node in functions if code_lines(node) > 30}


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_files_are_read_in_one_go(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 260


def test_no_module_is_a_drawer_for_everything() -> None:
    assert not [relative(path) for path in SOURCES if path.stem in {"utils", "util", "common", "base", "manager", "helpers", "misc"}]


def test_every_plugin_is_in_every_list() -> None:
    shipped = {Path(name).name for name in PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]}
    entries = set(PROJECT["project"]["entry-points"]["sparserob"].values())
    linted = set(PROJECT["tool"]["importlinter"]["root_packages"])
    assert shipped == linted == PLUGINS | {"sparserob_core"}
    assert {entry.split(".")[0] for entry in entries} == PLUGINS | {"sparserob_core"}
    for contract in PROJECT["tool"]["importlinter"]["contracts"]:
        if "plugin" in contract["name"].lower():
            assert set(contract.get("modules", contract.get("forbidden_modules"))) == PLUGINS


@pytest.mark.parametrize("path", SOURCES + PAGES, ids=relative)
def test_the_text_names_no_place_of_this_machine(path: Path) -> None:
    outside = re.compile(r"/home/|/root/|/work/|/tmp/|pypi\.org|localhost:")
    assert not outside.search(path.read_text())


def prose(path: Path) -> str:
    """Comments and texts of a source file; names of other libraries stand outside of them."""
    with tokenize.open(path) as stream:
        tokens = tokenize.generate_tokens(stream.readline)
        return " ".join(token.string for token in tokens if token.type in {tokenize.COMMENT, tokenize.STRING})


@pytest.mark.parametrize("path", SOURCES, ids=relative)
def test_the_spelling_is_british(path: Path) -> None:
    american = re.compile(r"\b(?:regulariz|maximiz|minimiz|optimiz|discretiz|normaliz|initializ|behavior|neighbor)\w*", re.IGNORECASE)
    assert not american.findall(prose(path))
