"""Guards tests/conftest.py: the second stage runs what the first leaves out, and nothing twice."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import pytest

from tests import stages
from tests.support.places import ROOT


class Item:
    """A test as pytest has collected it."""

    def __init__(self, name: str, *marks: pytest.MarkDecorator) -> None:
        self.nodeid, self.marks = f"tests/test_some.py::{name}", {mark.name: mark.mark for mark in marks}

    def get_closest_marker(self, name: str) -> Any:
        return self.marks.get(name)

    def add_marker(self, mark: pytest.MarkDecorator) -> None:
        self.marks[mark.name] = mark.mark


@pytest.fixture
def conftest(pytestconfig: pytest.Config) -> Any:
    file = str(Path(__file__).parents[1] / "conftest.py")
    return next(one for one in pytestconfig.pluginmanager.get_plugins() if getattr(one, "__file__", "") == file)


def test_the_first_sets_of_parameters_are_of_the_first_stage_and_the_others_of_the_second(conftest: Any) -> None:
    two = pytest.mark.first(2)
    family = [Item("test[0]", two), Item("test[1]", two, pytest.mark.slow), *(Item(f"test[{k}]", two) for k in (2, 3))]
    others = [Item("test_other[3]", two), Item("test_alone"), Item("test_all[4]")]
    conftest.pytest_collection_modifyitems([*family[:3], *others, *family[3:]])
    assert ["slow" in one.marks for one in family] == [False, True, False, True]
    assert not any("slow" in one.marks for one in others)


def test_the_second_stage_begins_with_what_takes_long_and_ends_with_the_longest(
    conftest: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"long": {"tests/test_some.py::test_long"}, "longest": {"tests/test_some.py::test_large"}}
    monkeypatch.setattr(conftest, "read_names", names.__getitem__)
    larger = Item("test_long[3]", pytest.mark.slow)
    items = [
        Item("test_quick"),
        Item("test_large[7]", pytest.mark.slow),
        Item("test_large[9]", pytest.mark.slow),
        larger,
        Item("test_long[1]"),
        Item("test_long[2]"),
    ]
    conftest.pytest_collection_modifyitems(items)
    assert [item.nodeid.split("::")[1] for item in items] == [
        "test_long[1]", "test_long[2]", "test_quick", "test_long[3]", "test_large[7]", "test_large[9]",
    ]  # fmt: skip
    assert ["slow" in item.marks for item in items] == [True, True, False, True, True, True]
    assert ["long" in item.marks for item in items] == [True, True, False, False, False, False]


def test_a_test_takes_long_where_its_sets_of_parameters_do_in_the_mean() -> None:
    seconds = {"call     tests/test_a.py::test_one[x]": 1.5, "call     tests/test_a.py::test_one[y]": 0.6,
               "setup    tests/test_a.py::test_two": 9.0, "call     tests/test_a.py::test_two": 0.9}  # fmt: skip
    for kind, limit in stages.LIMITS.items():
        table = [f"{factor * limit:.3f}s {name}" for name, factor in seconds.items()]
        assert stages.choose(kind, [*table, "3 passed in 2.00s"]) == ["tests/test_a.py::test_one"]


@pytest.mark.parametrize("kind", stages.LIMITS)
def test_every_test_that_takes_long_is_there(kind: str) -> None:
    """A test of another name would be one of the first stage again. Of a class the name of the class is looked for."""
    names = stages.read_names(kind)
    defined = {
        f"{file.relative_to(ROOT).as_posix()}::{node.name}"
        for file in {ROOT / name.partition("::")[0] for name in names}
        if file.is_file()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
    }
    assert [name for name in names if "::".join(name.split("::")[:2]) not in defined] == []
