"""The import rules of the house that need more than module names: lazy imports, the public face, and what a start-up costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE = sorted((ROOT / "sparserob_core").rglob("*.py"))
PLUGINS = sorted((ROOT / "plugins").glob("sparserob_*/**/*.py"))
HEAVY = {"scipy", "matplotlib", "rich", "qpsolvers", "piqp", "proxsuite", "clarabel", "cvxpy", "rerun", "nevergrad", "dask", "flint"}
SOLVERS = HEAVY - {"rich"}
RANK = {"errors": 0, "options": 0, "sip": 1, "control": 2, "checker": 3, "experiment": 4}


def imports(tree: ast.AST) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every imported module with the names taken from it, wherever it stands, for types too."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, ()) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            yield node.module or "", tuple(alias.name for alias in node.names)


def imported_at_start(tree: ast.Module) -> Iterator[str]:
    """Top-level packages imported by importing the module: neither inside a function nor for types only."""
    pending: list[ast.stmt] = list(tree.body)
    while pending:
        node = pending.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "").split(".")[0]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
            pending += [*node.body, *node.orelse]
        elif isinstance(node, ast.ClassDef | ast.Try | ast.With):
            pending += node.body


def wing(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "sparserob_core" and len(parts) > 1 and parts[1] in RANK else None


def first_part(path: Path) -> str:
    return path.relative_to(ROOT / "sparserob_core").parts[0].removesuffix(".py")


def in_a_wing(path: Path) -> bool:
    """The public face and the shipped contracts look at every wing; all other modules stand in one."""
    return first_part(path) not in {"__init__", "__main__", "testing", "testing_observers", "testing_solvers"}


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", [path for path in CORE if in_a_wing(path)], ids=relative)
def test_imports_point_downwards_even_for_types(path: Path) -> None:
    here = first_part(path)
    upward = [module for module, _ in imports(ast.parse(path.read_text())) if RANK.get(wing(module) or "errors", 0) > RANK[here]]
    assert not upward


@pytest.mark.parametrize("path", CORE, ids=relative)
def test_the_core_imports_heavy_packages_only_where_they_are_used(path: Path) -> None:
    assert not HEAVY & set(imported_at_start(ast.parse(path.read_text())))


@pytest.mark.parametrize("path", CORE, ids=relative)
def test_the_core_imports_no_plugin(path: Path) -> None:
    ours = {module.split(".")[0] for module, _ in imports(ast.parse(path.read_text())) if module.startswith("sparserob_")}
    assert ours <= {"sparserob_core"}


@pytest.mark.parametrize(("package", "owner"), [
    ("pluggy", "experiment/registry.py"), ("ruamel", "experiment/config.py"),
])
def test_one_module_knows_the_library(package: str, owner: str) -> None:
    users = {str(path.relative_to(ROOT / "sparserob_core")) for path in CORE
             for module, _ in imports(ast.parse(path.read_text())) if module.split(".")[0] == package}
    assert users == {owner}


def test_only_the_command_line_knows_the_library_of_commands() -> None:
    users = {str(path.relative_to(ROOT / "sparserob_core")) for path in CORE
             for module, _ in imports(ast.parse(path.read_text())) if module.split(".")[0] == "click"}
    assert all(user == "experiment/cli.py" or user.startswith("experiment/commands/") for user in users)


@pytest.mark.parametrize("path", PLUGINS, ids=relative)
def test_a_plugin_imports_only_the_public_names_of_the_core(path: Path) -> None:
    own = path.relative_to(ROOT / "plugins").parts[0]
    for module, _ in imports(ast.parse(path.read_text())):
        if module.startswith("sparserob_") and not module.startswith(own):
            assert module == "sparserob_core"


def loaded_after(statement: str) -> set[str]:
    """The top-level packages in a fresh interpreter after a statement."""
    report = "print('LOADED', *{name.split('.')[0] for name in sys.modules})"
    program = f"import sys\ntry:\n    {statement}\nexcept SystemExit:\n    pass\n{report}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.split("LOADED")[-1].split())


def test_importing_the_package_costs_little_more_than_numpy() -> None:
    assert not (HEAVY | {"pluggy", "pydantic", "ruamel", "click"}) & loaded_after("import sparserob_core")


@pytest.mark.parametrize("arguments", [["--help"], ["plugins"], ["plugins", "piqp"]], ids=" ".join)
def test_asking_for_help_or_plugins_loads_no_solver(arguments: list[str]) -> None:
    statement = f"sys.argv = {['sparserob', *arguments]!r}; from sparserob_core.experiment.cli import main; main()"
    loaded = loaded_after(statement)
    assert "click" in loaded
    assert not (SOLVERS - ({"scipy"} if arguments == ["plugins", "piqp"] else set())) & loaded


def test_every_public_name_can_be_imported() -> None:
    import sparserob_core

    for name in sparserob_core.__all__:
        assert getattr(sparserob_core, name) is not None
    assert set(sparserob_core.__all__) == set(sparserob_core._HOME)
