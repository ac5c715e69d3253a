"""Guards the whole tree: where things stand, who imports whom, what a start-up costs, and how the text is written.

Each test lists every offender at once. What import-linter can state (layers of folders, who knows which library) is in
pyproject.toml only.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tokenize
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.support.places import ROOT

CORE = sorted((ROOT / "sparserob_core").rglob("*.py"))
PLUGINS = sorted((ROOT / "plugins").glob("sparserob_*/**/*.py"))
WRITTEN = ("*.md", "docs/**/*.md", "configs/*.*", "configs/studies/*", "tests/**/*.py", "Makefile", "pyproject.toml")
PAGES = sorted({path for pattern in WRITTEN for path in ROOT.glob(pattern)} - {Path(__file__).resolve()})
HEAVY = {
    "scipy", "matplotlib", "rich", "qpsolvers", "piqp", "proxsuite", "clarabel", "cvxpy", "rerun", "nevergrad", "dask",
    "cma", "flint", "jaxtyping",
}  # fmt: skip
AT_HOME = {
    "flint": ("sparserob_core/checker/",),
    "scipy": ("sparserob_core/control/", "sparserob_core/sip/", "sparserob_core/testing/"),
}
"""Folders whose modules may import a heavy package at their top, where nothing that is to begin at once loads them:
fresh interpreters are asked below, and in tests/experiment/cli."""
A_DOZEN = 12
PLACES = (
    *("sparserob_core/experiment/cli/", "sparserob_core/experiment/terminal/"),
    *("sparserob_core/experiment/plugins/hookspecs.py", "sparserob_core/testing/commands.py"),  # commands of plugins
)


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


Imports = list[tuple[str, tuple[str, ...]]]


@cache
def read(path: Path) -> tuple[Imports, set[str]]:
    """Every module that a file imports with the names taken from it, wherever it stands, for types too; and the
    top-level packages that it imports when it is imported itself: neither inside a function nor for types only. Trees
    are large, and not kept."""
    tree = ast.parse(path.read_text())
    found = Imports()
    for node in statements(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, ()) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found.append(("." * node.level + (node.module or ""), tuple(alias.name for alias in node.names)))
    return found, imported_at_start(tree)


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """What may hold an import: statements, and what holds statements."""
    pending = [tree]
    while pending:
        node = pending.pop()
        yield node
        for part in ("body", "orelse", "finalbody", "handlers", "cases"):
            inside = getattr(node, part, ())
            pending += inside if isinstance(inside, list) else ()


def imports(path: Path) -> Imports:
    return read(path)[0]


def imported_at_start(tree: ast.Module) -> set[str]:
    found, pending = set(), list(tree.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add((node.module or "").split(".")[0])
        elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
            pending += [*node.body, *node.orelse]
        elif isinstance(node, ast.ClassDef | ast.Try | ast.With):
            pending += node.body
    return found


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def import_graph() -> Mapping[str, set[str]]:
    """Which modules of the core each of its modules imports, wherever and for whatever."""
    known = {module_name(path) for path in CORE}
    graph: dict[str, set[str]] = {}
    for path in CORE:
        targets = {
            f"{module}.{name}" if f"{module}.{name}" in known else module
            for module, names in imports(path)
            for name in names or ("",)
        }
        graph[module_name(path)] = (targets & known) - {module_name(path)}
    del graph["sparserob_core"]  # the public face points everywhere, and nobody in the core imports it
    return graph


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_module_is_a_drawer_for_everything() -> None:
    drawers = {"utils", "util", "common", "base", "manager", "helpers", "misc"}
    assert not [relative(path) for path in CORE + PLUGINS if path.stem in drawers]


def test_a_folder_holds_a_dozen_modules_at_most_and_says_what_it_is() -> None:
    folders = {path.parent for path in CORE}
    crowded = {relative(one): len(list(one.glob("*.py"))) - 1 for one in folders}
    assert not {name: count for name, count in crowded.items() if count > A_DOZEN}
    silent = [one for one in folders if not ast.get_docstring(ast.parse((one / "__init__.py").read_text()))]
    assert not [relative(one) for one in silent]


def drawn_in(picture: str) -> set[str]:
    """The paths in the core that a picture shows by indentation, two columns a level."""
    drawn, above = set(), list[str]()
    for indent, names in re.findall(r"^( +)(\w[\w./]*(?:, \w[\w.]*)*)", picture, re.MULTILINE):
        above = above[: len(indent) // 2]
        drawn |= {"/".join([*above, name.rstrip("/")]) for name in names.split(", ")}
        above.append(names.rstrip("/"))
    return drawn


def test_the_picture_of_the_house_shows_every_folder_and_every_path_on_its_page_exists() -> None:
    page, core = ROOT / "docs/architecture.md", ROOT / "sparserob_core"
    before, picture, after = page.read_text().split("```", maxsplit=2)
    drawn = drawn_in(picture.partition("\n sparserob_core ")[2].partition("\n")[2])
    folders = {str(path.parent.relative_to(core)) for path in CORE if path.name == "__init__.py"} - {"."}
    assert not folders - drawn, "these folders are missing in the picture"
    assert not [one for one in drawn if not (core / one).exists()], "these are in the picture only"
    named = set(re.findall(r"`([\w./]+/[\w./]*)`", before + after))
    assert len(named) > A_DOZEN
    assert not [one for one in named if not (ROOT / one).exists() and not (core / one).exists()]


def test_no_import_goes_round_in_a_circle_between_modules_or_folders() -> None:
    graph = import_graph()
    assert not circle(graph)
    packages = {module_name(path) for path in CORE if path.name == "__init__.py"}
    of = {name: name if name in packages else name.rpartition(".")[0] for name in graph}
    folders: dict[str, set[str]] = {}
    for name, targets in graph.items():
        folders.setdefault(of[name], set()).update({of[target] for target in targets} - {of[name], "sparserob_core"})
    assert not circle(folders)


def test_imports_are_absolute_and_heavy_packages_are_imported_where_they_are_used() -> None:
    offenders = [
        f"{relative(path)} imports {package}"
        for path in CORE
        for package in HEAVY & read(path)[1]
        if not relative(path).startswith(AT_HOME.get(package, ()))
    ]
    offenders += [relative(path) for path in CORE + PLUGINS if any(m[0] == "." for m, _ in imports(path))]
    assert not offenders


def test_the_core_imports_no_plugin_and_plugins_only_the_public_face() -> None:
    offenders = [
        f"{relative(path)} imports {module}"
        for path in CORE + PLUGINS
        for module, _ in imports(path)
        if module.startswith("sparserob_") and not allowed(path, module)
    ]
    assert not offenders


def allowed(path: Path, module: str) -> bool:
    own = path.relative_to(ROOT).parts[1] if path in PLUGINS else "sparserob_core"
    return module.split(".", maxsplit=1)[0] == own or (path in PLUGINS and module == "sparserob_core")


def test_only_the_command_line_knows_the_library_of_commands() -> None:
    users = [relative(path) for path in CORE if "click" in {module for module, _ in imports(path)}]
    assert users
    assert not [user for user in users if not user.startswith(PLACES)]


def test_a_plugin_of_this_repository_is_one_folder_and_one_line() -> None:
    project = (ROOT / "pyproject.toml").read_text()
    entries = set(tomllib.loads(project)["project"]["entry-points"]["sparserob"].values())
    folders = {path.name for path in (ROOT / "plugins").glob("sparserob_*") if path.is_dir()}
    assert {entry.split(".")[0] for entry in entries} == folders
    assert not {name: found for name in folders if (found := len(re.findall(rf"\b{name}\b", project))) != 1}


def test_the_text_names_no_place_of_this_machine() -> None:
    outside = re.compile(r"/home/|/root/|/work/|/tmp/|pypi\.org|localhost:")
    assert not [relative(path) for path in CORE + PLUGINS + PAGES if outside.search(path.read_text())]


NAMES = {'"optimize"'}  # of other people's commands, which stand in texts: `rerun rrd optimize`


def prose(path: Path) -> str:
    """Comments and texts of a source file; names of other libraries stand outside of them."""
    with tokenize.open(path) as stream:
        tokens = tokenize.generate_tokens(stream.readline)
        texts = [token.string for token in tokens if token.type in {tokenize.COMMENT, tokenize.STRING}]
        return " ".join(text for text in texts if text not in NAMES)


def test_the_spelling_is_british() -> None:
    american = re.compile(
        r"\b(?:regulariz|maximiz|minimiz|optimiz|discretiz|normaliz|initializ|behavior|neighbor)\w*", re.IGNORECASE
    )
    suspects = [path for path in CORE + PLUGINS if american.search(path.read_text())]
    assert not {relative(path): words for path in suspects if (words := american.findall(prose(path)))}


OPENERS = ("What ", "Whether ", "How ", "The same", "Of ", "With ", "One ", "Where ", "Those", "These ", "That ", "As ")
PRONOUNS = frozenset({
    *("asked", "begun", "bent", "beside", "beyond", "grown", "held", "here", "known", "made", "off", "one", "other"),
    *("pushed", "said", "seen", "taken", "these", "thing", "things", "those", "told"),
})  # fmt: skip


def test_docstrings_begin_with_a_verb_or_a_noun_and_local_variables_are_nouns() -> None:
    """A stranger reads what a value holds, not how it was come by."""
    documented, wrong = (ast.Module, ast.ClassDef, ast.FunctionDef), []
    for path in CORE + PLUGINS:
        nodes = list(ast.walk(ast.parse(path.read_text())))
        texts = [ast.get_docstring(node) or "" for node in nodes if isinstance(node, documented)]
        wrong += [f"{relative(path)}: {text.splitlines()[0]}" for text in texts if text.startswith(OPENERS)]
        within = [part for node in nodes if isinstance(node, ast.FunctionDef) for part in ast.walk(node)]
        names = {part.id for part in within if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)}
        wrong += [f"{relative(path)}: {name}" for name in sorted(names & PRONOUNS)]
    assert not wrong


def test_a_test_file_says_in_its_first_line_what_it_guards() -> None:
    tests = sorted((ROOT / "tests").rglob("test_*.py"))
    assert not [relative(path) for path in tests if not path.read_text().startswith('"""Guards ')]


def loaded_after(statement: str) -> set[str]:
    """The top-level packages in a fresh interpreter after a statement."""
    report = "print('LOADED', *{name.split('.')[0] for name in sys.modules})"
    program = f"import sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\n{report}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.split("LOADED")[-1].split())


def test_importing_the_package_costs_little_more_than_numpy() -> None:
    assert not (HEAVY | {"pluggy", "pydantic", "ruamel", "click"}) & loaded_after("import sparserob_core")


@pytest.mark.parametrize("arguments", [["run", "--help"], ["plugins"], ["plugins", "piqp"]], ids=" ".join)
def test_asking_for_help_or_plugins_loads_no_solver(arguments: list[str]) -> None:
    command = f"sys.argv = {['sparserob', *arguments]!r}; from sparserob_core.experiment.cli.main import main; main()"
    loaded = loaded_after(command)
    assert "click" in loaded
    assert not (HEAVY - {"rich"} - ({"scipy"} if arguments == ["plugins", "piqp"] else set())) & loaded


def test_every_public_name_can_be_imported() -> None:
    import sparserob_core

    assert not [name for name in sparserob_core.__all__ if getattr(sparserob_core, name) is None]


DECISIONS = sorted((ROOT / "docs" / "decisions").glob("0*.md"))


def test_every_decision_has_a_number_of_its_own() -> None:
    numbers = [page.name[:4] for page in DECISIONS]
    assert len(numbers) > 50 and len(set(numbers)) == len(numbers)
    for page in DECISIONS:
        assert page.read_text().startswith(f"# {int(page.name[:4])}. "), page.name


def test_a_decision_has_at_most_800_words_and_leaves_measurements_to_the_page_of_performance() -> None:
    lengths = {page.name: len(page.read_text().split()) for page in DECISIONS}
    assert not {name: length for name, length in lengths.items() if length > 800}


def test_the_changelog_has_one_line_for_each_entry_and_at_most_120_of_them_for_a_version() -> None:
    for version in (ROOT / "CHANGELOG.md").read_text().split("\n## ")[1:]:
        heading, *sections = version.split("\n### ")
        entries = [line for section in sections for line in section.split("\n")[1:] if line]
        assert sections and len(entries) <= 120, heading.split("\n")[0]
        assert {section.split("\n")[0] for section in sections} <= {"Breaking", "Added", "Changed", "Fixed", "Removed"}
        assert not [entry for entry in entries if not entry.startswith("- ") or len(entry) > 240]
