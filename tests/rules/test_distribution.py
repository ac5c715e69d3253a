"""Guards the distribution: the sdist is complete, the wheel that is built from it works without the checkout, and the
command has a module of either name."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.support.places import ROOT


def run(command: list[str | Path], place: Path, **variables: str) -> str:
    """The output of a command that must succeed, told nothing of the checkout."""
    kept = {key: value for key, value in os.environ.items() if key in ("PATH", "SYSTEMROOT", "TMPDIR", "LANG")}
    done = subprocess.run(
        [str(part) for part in command],
        cwd=place,
        check=False,
        env=kept | {"HOME": str(place), "NO_COLOR": "1"} | variables,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.first(1)
@pytest.mark.parametrize("module", ["sparserob", "sparserob_core"])
def test_the_command_is_a_module_of_either_name(module: str, tmp_path: Path) -> None:
    assert run([sys.executable, "-m", module, "--version"], tmp_path) == f"sparserob {version('sparserob')}\n"


def test_whoever_cites_it_cites_the_version_that_the_package_states_and_the_changelog_tells() -> None:
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
    assert YAML(typ="safe").load(ROOT / "CITATION.cff")["version"] == stated
    assert f"\n## {stated}" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_the_name_of_the_command_says_what_to_import() -> None:
    import sparserob

    with pytest.raises(AttributeError, match="import sparserob_core as sr"):
        sparserob.solve  # noqa: B018


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of the sdist; of the folder DIST, where `make dist` has written both."""
    place = tmp_path_factory.mktemp("dist")
    given = os.environ.get("DIST")
    if given:
        (found,) = Path(given).absolute().glob("*.whl")
        return found
    build: list[str | Path] = [sys.executable, "-m", "hatchling", "build", "-d", place]
    run([*build, "-t", "sdist"], ROOT)
    with tarfile.open(next(place.glob("*.tar.gz"))) as archive:
        archive.extractall(place, filter="data")
    run([*build, "-t", "wheel"], next(path for path in place.iterdir() if path.is_dir()))
    return next(place.glob("*.whl"))


@pytest.fixture(scope="module")
def prefix(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment with the wheel and nothing else of this project: its dependencies are those that are installed
    here, of which no ``.pth`` file is followed, so that the checkout is not on its path."""
    place = tmp_path_factory.mktemp("environment")
    venv.create(place, with_pip=False, symlinks=os.name != "nt")
    run(
        [sys.executable, "-m", "pip", "--python", python(place), "install", "-q", "--no-deps", "--no-index", wheel],
        place,
    )
    site = Path(run([python(place), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], place).strip())
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return place


def python(prefix: Path) -> Path:
    return prefix / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


@pytest.mark.slow
def test_the_wheel_holds_what_is_run_and_nothing_of_the_tests(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
    kinds = {path.suffix for path in map(Path, inside) if "dist-info" not in path.parts[0]}
    assert {"sparserob.py", "sparserob_core/py.typed", "sparserob_core/configs/experiment1_repaired.yaml"} <= inside
    own = {path.relative_to(ROOT).as_posix() for path in (ROOT / "sparserob_core").rglob("*.py")}
    own |= {path.relative_to(ROOT / "plugins").as_posix() for path in (ROOT / "plugins").rglob("*.py")}
    assert not own - inside
    assert not [name for name in inside if name.startswith(("tests", "docs"))]
    assert ".pyc" not in kinds


@pytest.mark.slow
def test_the_wheel_is_imported_from_its_own_environment(prefix: Path) -> None:
    told = run([python(prefix), "-c", "import sparserob_core as sr; print(sr.__file__)"], prefix)
    assert Path(told.strip()).resolve().is_relative_to(prefix.resolve())
    path = run([python(prefix), "-c", "import sys; print(*sys.path, sep='\\n')"], prefix).splitlines()
    assert str(ROOT) not in path and str(ROOT / "plugins") not in path


@pytest.mark.slow
def test_an_installed_wheel_lists_its_components_solves_the_demo_and_checks_it(prefix: Path) -> None:
    command = python(prefix).parent / "sparserob"
    listed = run([command, "plugins"], prefix)
    here = run([sys.executable, "-m", "sparserob", "plugins"], prefix)
    assert listed == here
    assert "experiment1_repaired" in run([command, "examples"], prefix)
    run([command, "examples", "experiment1_repaired"], prefix)
    config = "experiment1_repaired.yaml"
    solved = run([python(prefix), "-m", "sparserob", "run", config, "--no-figures", "--out", "first"], prefix)
    assert "certified" in solved
    assert "verified" in run([command, "check", "first"], prefix)
