"""Guards the version of the public interface in records, and that packages which `new-plugin` wrote for an interface
run unchanged."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import sparserob_core as sr
from sparserob_core.experiment.plugins import records
from sparserob_core.experiment.scaffold.new_plugin import HEADING, RULES, kinds
from tests.experiment.scaffold.test_new_plugin import run
from tests.support.places import ROOT

PACKAGES = ROOT / "tests" / "support" / "packages_1"
"""What `new-plugin KIND kept_KIND` wrote for interface 1, before records said so; never to be changed."""

RECORD = """
import sparserob_core as sr

class Half(sr.Schedule, sr.Options):
    \"\"\"Half of it.\"\"\"

    def __call__(self, epsilon, j):
        return epsilon / 2

@sr.hookimpl
def sparserob_rules():
    yield sr.RulePlugin(name="half", factory=Half, {line})
"""


def plugin(tmp_path: Path, line: str) -> Path:
    """A file whose record has this line more."""
    file = tmp_path / "half.py"
    file.write_text(RECORD.format(line=line))
    return file


def unpacked(kind: str, folder: Path) -> Path:
    """The kept package of a kind, as files."""
    parts = HEADING.split((PACKAGES / f"{kind}.txt").read_text(encoding="utf-8"))[1:]
    for path, text in zip(parts[::2], parts[1::2], strict=True):
        place = folder / path
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(text, encoding="utf-8")
    return folder


def test_a_record_says_its_interface_or_is_of_the_first(tmp_path: Path) -> None:
    for line, version in (("", 1), ("interface=1", 1), (f"interface={sr.INTERFACE}", sr.INTERFACE)):
        record = sr.load_registry([plugin(tmp_path, line)]).get("rule", "half")
        assert record.interface == version


def test_a_newer_interface_is_refused_with_the_line_to_change(tmp_path: Path) -> None:
    file = plugin(tmp_path, f"interface={sr.INTERFACE + 1}")
    with pytest.raises(sr.PluginError) as caught:
        sr.load_registry([file])
    said = str(caught.value)
    assert str(file) in said
    assert f"rule 'half': written for interface {sr.INTERFACE + 1}, and this SparseRob has {sr.INTERFACE}" in said
    assert f"change `interface={sr.INTERFACE + 1}` to `interface={sr.INTERFACE}` in RulePlugin(name='half'" in said
    assert "\n" not in said


def test_an_interface_that_is_no_longer_there_is_refused_with_the_line_to_change(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "INTERFACE", 4)
    monkeypatch.setattr(records, "OLDEST", 3)
    for line in ("", "interface=1", "interface=2"):
        with pytest.raises(sr.PluginError, match=r"this SparseRob has 3 to 4: .* write `interface=4` in RulePlugin"):
            sr.load_registry([plugin(tmp_path, line)], entry_points=False)


@pytest.mark.parametrize("value", ["0", "-1", "True", "1.0", "'1'", "None"])
def test_an_interface_that_is_no_version_is_refused(tmp_path: Path, value: str) -> None:
    with pytest.raises(sr.PluginError, match="interface must be a whole number of at least 1, got"):
        sr.load_registry([plugin(tmp_path, f"interface={value}")])


def test_a_new_package_states_the_interface_of_today(tmp_path: Path) -> None:
    for kind in kinds():
        folder = sr_new_plugin(kind, tmp_path)
        text = (folder / f"sparserob_trial_{kind}" / "__init__.py").read_text(encoding="utf-8")
        assert re.findall(r"^ +interface=(\d+),$", text, re.MULTILINE) == [str(sr.INTERFACE)], kind


def sr_new_plugin(kind: str, folder: Path) -> Path:
    from sparserob_core.experiment.scaffold.new_plugin import new_plugin

    return new_plugin(kind, f"trial_{kind}", folder)


def test_a_package_of_every_kind_is_kept() -> None:
    assert {file.stem for file in PACKAGES.glob("*.txt")} == set(kinds())
    assert not [file.name for file in PACKAGES.glob("*.txt") if "interface=" in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("kind", kinds())
def test_a_package_of_interface_1_is_found_and_built_unchanged(kind: str, tmp_path: Path) -> None:
    name = f"kept_{kind}"
    module = unpacked(kind, tmp_path) / f"sparserob_{name}" / "__init__.py"
    kind = "rule" if kind in RULES else kind  # which had four hooks then
    record = sr.load_registry([module]).get(kind, name)
    assert record.interface == 1
    options = record.options_type()
    required = [key for key, field in options.model_fields.items() if field.is_required()]
    if not required:
        assert sr.load_registry([module]).build(kind, name) is not None


@pytest.mark.slow  # contracts of every kind, and a process
def test_packages_of_interface_1_pass_their_own_tests_unchanged(tmp_path: Path) -> None:
    folders = [unpacked(kind, tmp_path / kind) for kind in kinds()]
    tests = [str(file) for folder in folders for file in sorted((folder / "tests").glob("test_*.py"))]
    said = run(["-m", "pytest", "-q", "-p", "no:cacheprovider", *tests], tmp_path, *folders)
    assert " passed" in said and "failed" not in said
