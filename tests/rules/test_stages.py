"""Guards tests/conftest.py: the second stage runs what the first leaves out, and nothing twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest


class Item:
    """A test as pytest has collected it."""

    def __init__(self, name: str, *marks: pytest.MarkDecorator) -> None:
        self.nodeid, self.marks = f"tests/test_some.py::{name}", {mark.name: mark.mark for mark in marks}

    def get_closest_marker(self, name: str) -> Any:
        return self.marks.get(name)

    def add_marker(self, mark: pytest.MarkDecorator) -> None:
        self.marks[mark.name] = mark.mark


def test_the_first_sets_of_parameters_are_of_the_first_stage_and_the_others_of_the_second(
    pytestconfig: pytest.Config,
) -> None:
    file = str(Path(__file__).parents[1] / "conftest.py")
    conftest: Any = next(
        one for one in pytestconfig.pluginmanager.get_plugins() if getattr(one, "__file__", "") == file
    )
    two = pytest.mark.first(2)
    family = [Item("test[0]", two), Item("test[1]", two, pytest.mark.slow), *(Item(f"test[{k}]", two) for k in (2, 3))]
    others = [Item("test_other[3]", two), Item("test_alone"), Item("test_all[4]")]
    conftest.pytest_collection_modifyitems([*family[:3], *others, *family[3:]])
    assert ["slow" in one.marks for one in family] == [False, True, False, True]
    assert not any("slow" in one.marks for one in others)
