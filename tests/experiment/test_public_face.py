"""Guards sparserob_core/__init__: the public face: every name is there, and none costs anything before it is used."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import sparserob_core as sr

HEAVY = {
    "scipy",
    "pydantic",
    "pluggy",
    "ruamel",
    "click",
    "rich",
    "matplotlib",
    "qpsolvers",
    "piqp",
    "clarabel",
    "proxsuite",
}


def imported_by(statement: str) -> set[str]:
    program = f"{statement}\nimport sys\nprint(*sorted({{name.split('.')[0] for name in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("name", sr.__all__)
def test_every_public_name_exists(name: str) -> None:
    assert getattr(sr, name) is not None


def test_a_type_checker_sees_the_same_names(repository: Path) -> None:
    tree = ast.parse((repository / "sparserob_core" / "__init__.py").read_text())
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name for node in guarded.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == set(sr.__all__) == set(sr._HOME)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Bocks'"):
        sr.Bocks  # noqa: B018
    assert "Box" in dir(sr)


def test_importing_the_package_imports_nothing_heavy() -> None:
    assert not imported_by("import sparserob_core") & HEAVY


def test_a_set_costs_no_more_than_numpy() -> None:
    assert not imported_by("import sparserob_core as sr; sr.Box([0.0], [1.0])") & HEAVY
