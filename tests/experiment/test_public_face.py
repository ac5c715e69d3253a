"""Guards sparserob_core/__init__: the public face: every name is there, and none costs anything before it is used."""

from __future__ import annotations

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


def test_an_unknown_name_brings_the_nearest_ones() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'Bax'; did you mean 'Box'"):
        sr.Bax  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'xyzzy'$"):
        sr.xyzzy  # noqa: B018


def test_the_module_shows_its_public_names_and_nothing_that_leaks() -> None:
    assert {name for name in dir(sr) if not name.startswith("__")} == set(sr.__all__)


@pytest.mark.slow
def test_a_type_checker_sees_the_types_of_the_public_names(tmp_path: Path) -> None:
    file = tmp_path / "user.py"
    file.write_text(
        "import sparserob_core as sr\nreveal_type(sr.Box([0.0], [1.0]).dimension)\nsr.Bax\n"
        "class Mine(sr.Options):\n    depth: int = 3\n"
        "reveal_type(Mine(depth=4).depth)\n"
    )
    options = ["--strict", "--config-file", "pyproject.toml"]
    command = [sys.executable, "-m", "mypy", str(file), *options]
    said = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    assert 'Revealed type is "int"' in said.replace("builtins.", "")
    assert 'Module has no attribute "Bax"' in said


def test_importing_the_package_imports_nothing_heavy() -> None:
    assert not imported_by("import sparserob_core") & HEAVY


def test_a_set_costs_no_more_than_numpy() -> None:
    assert not imported_by("import sparserob_core as sr; sr.Box([0.0], [1.0])") & HEAVY
