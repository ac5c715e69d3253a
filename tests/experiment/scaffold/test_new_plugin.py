"""Guards experiment/scaffold: what `sparserob new-plugin` writes is clean, passes its tests and is found, as it is
written; and nothing of anybody's is overwritten."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from click.testing import CliRunner

import sparserob_core as sr
from sparserob_core.experiment.cli.main import _run_command_line, commands
from sparserob_core.experiment.scaffold import new_plugin as module
from sparserob_core.experiment.scaffold.new_plugin import MAX_NAME_LETTERS, RULES, kinds, new_plugin
from tests.support.places import ROOT

KINDS = kinds()


def run(arguments, place, *paths):
    """A command of this interpreter, with these folders first on its path; its output, where it ends well."""
    path = os.pathsep.join([*map(str, paths), str(ROOT), str(ROOT / "plugins")])
    variables = {**os.environ, "PYTHONPATH": path, "MYPYPATH": path}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=place, env=variables, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, f"{arguments}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_there_is_a_template_for_every_kind():
    templates = {path.stem for path in (Path(module.__file__).parent / "templates").glob("*.txt")}
    assert templates == {*KINDS, "package"}


def test_the_help_names_every_kind():
    said = CliRunner().invoke(commands, ["new-plugin", "--help"]).output
    assert not [kind for kind in KINDS if kind.replace("_", "-") not in said]


@pytest.mark.parametrize("kind", KINDS)
def test_a_package_has_what_an_author_needs(kind, tmp_path):
    folder = new_plugin(kind, "trial", tmp_path)
    written = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert folder == tmp_path / "sparserob-trial"
    assert written == {
        "pyproject.toml", "README.md", ".gitignore", ".github/workflows/test.yml", "example.yaml",
        "sparserob_trial/__init__.py", "sparserob_trial/py.typed", "tests/test_trial.py",
    }  # fmt: skip
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["sparserob"] == {"trial": "sparserob_trial"}
    assert "license" not in project and "TODO: choose a licence" in (folder / "pyproject.toml").read_text()
    assert not [path for path in written if "$" in (folder / path).read_text().replace("${{ matrix.python }}", "")]


def test_packages_are_as_clean_as_this_one_whatever_the_length_of_their_names(tmp_path):
    for kind in KINDS:
        for name in ("z", "trial", "q" * MAX_NAME_LETTERS, kind):
            if kind in RULES or name not in sr.load_registry().names(kind):
                new_plugin(kind, name if name != kind else f"my_{kind}", tmp_path / f"{kind}_{name}")
    run(["-m", "ruff", "check", "--no-cache", "."], tmp_path)
    run(["-m", "ruff", "format", "--check", "--no-cache", "."], tmp_path)


@pytest.mark.slow
def test_a_package_passes_its_tests_as_it_is_written(tmp_path):
    folder = new_plugin("selection", "trial", tmp_path)
    said = run(["-m", "pytest", "-q", "-p", "no:cacheprovider"], folder, folder)
    assert " passed" in said and "failed" not in said


@pytest.mark.parametrize(
    ("kind", "name", "words"),
    [
        ("optimiser", "mine", r"kind: expected one of problem, set, .*, outer-stop, inner-stop, .*, got 'optimiser'"),
        ("solver", "Mine", r"name: expected lower-case letters, digits and single underscores.*got 'Mine'"),
        ("solver", "2mine", "name: expected lower-case letters"),
        ("solver", "my-solver", "name: expected lower-case letters"),
        ("solver", "", "name: expected lower-case letters"),
        ("solver", "a__b", "name: expected lower-case letters"),
        ("solver", "../mine", "name: expected lower-case letters"),
        ("solver", "q" * (MAX_NAME_LETTERS + 1), f"at most {MAX_NAME_LETTERS} of them"),
        ("solver", "piqp", r"name: expected a name that no solver has, got 'piqp', which is solver 'piqp' \(plugin"),
        ("method", "exchange", "name: expected a name that no method has"),
        ("observer", "piqp", "name: expected a name that no plugin has, got 'piqp'"),
        ("observer", "core", "name: expected a name that no plugin has, got 'core', which is that of the core"),
    ],
)
def test_a_kind_or_a_name_that_will_not_do_is_one_clear_error(kind, name, words, tmp_path):
    with pytest.raises(sr.InputError, match=words):
        new_plugin(kind, name, tmp_path)
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(tmp_path):
    folder = new_plugin("set", "trial", tmp_path)
    (folder / "README.md").write_text("mine")
    with pytest.raises(sr.InputError, match="out: expected a folder in which the package is not yet"):
        new_plugin("set", "trial", tmp_path)
    assert (folder / "README.md").read_text() == "mine"


def test_a_folder_that_cannot_be_written_to_is_an_error_of_the_input(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(sr.InputError, match="out: expected a folder that can be written to"):
        new_plugin("set", "trial", tmp_path / "file")


def test_a_disk_that_is_full_leaves_no_half_of_a_package(tmp_path, monkeypatch):
    written = []

    def full(path, text, **options):
        written.append(path)
        if len(written) == 3:
            path.touch()
            raise OSError(errno.ENOSPC, "No space left on device")
        return len(text)

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(sr.InputError, match=r"can be written to, got .*: No space left on device$"):
        new_plugin("set", "mine", tmp_path)
    assert len(written) == 3
    assert not list(tmp_path.iterdir())


def test_the_command_says_where_the_package_is_and_how_to_go_on(tmp_path, capsys):
    assert _run_command_line(["new-plugin", "outer-stop", "trial", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert f"written to {tmp_path / 'sparserob-trial'}; next: cd " in said
    assert _run_command_line(["new-plugin", "outer-stop", "trial", "--out", str(tmp_path)]) == 2
    assert _run_command_line(["new-plugin", "thing", "trial", "--out", str(tmp_path)]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_package_is_installed_found_typed_and_passes_its_tests(kind, tmp_path):
    name = f"trial_{kind}"
    folder, prefix = new_plugin(kind, name, tmp_path), tmp_path / "prefix"
    kind = "rule" if kind in RULES else kind
    install = ["-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-build-isolation", "--prefix", str(prefix)]
    run([*install, str(folder)], tmp_path)
    site = next(prefix.rglob("site-packages"))
    listed = run(["-m", "sparserob_core", "plugins"], tmp_path, site)
    assert [line.split()[:3] for line in listed.splitlines() if name in line] == [[kind, name, name]]
    options = run(["-m", "sparserob_core", "plugins", f"{kind}.{name}"], tmp_path, site)
    assert "default" in options and "it has no options" not in options
    run(["-m", "mypy", "--cache-dir", str(tmp_path / "mypy")], folder, folder)
    assert " passed" in run(["-m", "pytest", "-q", "-p", "no:cacheprovider"], folder, site)
    said = run(["-m", "sparserob_core", "run", "example.yaml", "--no-figures", "--out", "run"], folder, site)
    assert "status                certified" in said or "status                verified" in said


@pytest.mark.slow
def test_the_templates_are_in_the_wheel(tmp_path):
    import zipfile

    run(["-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(ROOT)], tmp_path)
    with zipfile.ZipFile(next(tmp_path.glob("sparserob-*.whl"))) as wheel:
        inside = set(wheel.namelist())
    place = "sparserob_core/experiment/scaffold/templates"
    assert not {f"{place}/{kind}.txt" for kind in [*KINDS, "package"]} - inside


ROUNDED = """
problem:
  name: linear
  system: {A: [[0, 1], [0, 0]], B: [[0], [1]]}
  horizon: 3.0
  initial_state: [0.5, 0]
  control: {rounded: 0.9}
  disturbance: {rounded: {half: 0.005, radius: 0.005}}
  path: [{rounded: {half: 1.5, radius: 0.5}}]
  terminal: [{rounded: 0.2}]
dictionaries:
  control: {name: piecewise_constant, pieces: 10}
"""


@pytest.mark.slow
def test_a_set_of_three_members_serves_everywhere_and_the_checker_says_that_it_does_not_know_it(tmp_path):
    plugin = new_plugin("set", "rounded", tmp_path) / "sparserob_rounded" / "__init__.py"
    (tmp_path / "rounded.yaml").write_text(f"plugins: [{plugin}]\n{ROUNDED}")
    outcome = sr.run(tmp_path / "rounded.yaml", out=tmp_path / "run", figures=False)
    assert outcome.result.status == "certified"
    said = sr.check(tmp_path / "run", plugins=[plugin])
    verdicts = {claim.name: (claim.verdict, claim.text) for claim in said.claims}
    for name in ("control", "path", "terminal", "lower bound"):
        assert verdicts[name][0] == "not checked"
        assert "the checker does not know sets of the kind roundedbox" in verdicts[name][1]
    assert verdicts["status"][0] == "not checked"
