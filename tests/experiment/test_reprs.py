"""Guards `sparserob_core.brief`: every public result is said in ten lines, however large it is."""

from __future__ import annotations

import ast
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.brief import LINES, WIDTH, brief

OF_THEIR_OWN = {"Outcome", "Result", "ControlResult", "SolvedProblem", "Signal"}  # guarded beside them


def results() -> list[str]:
    """The dataclasses among the public names that come back from a call, and what is told to observers of searches."""
    text = Path(sr.__file__).with_suffix(".pyi").read_text("utf-8")
    section = text.split("# To solve it, to judge the answer, and what comes back.")[1].split("\n#")[0]
    names = [alias.name for node in ast.parse(section).body if isinstance(node, ast.ImportFrom) for alias in node.names]
    return [name for name in [*names, "Report", "Trace"] if is_dataclass(getattr(sr, name))]


def test_the_public_results_are_found() -> None:
    assert OF_THEIR_OWN | {"Report", "Trace", "Margin", "InitialStates", "Study", "Tube", "Cut"} <= set(results())


@pytest.mark.parametrize("name", sorted(set(results()) - OF_THEIR_OWN))
@pytest.mark.parametrize(
    "large", [np.ones((30, 500)), ["a word of a list"] * 9000, "a sentence\n" * 500, {k: k for k in range(900)}]
)
def test_every_public_result_is_said_in_ten_lines_whatever_it_holds(name: str, large: object) -> None:
    kind = getattr(sr, name)
    record = object.__new__(kind)
    for one in fields(kind):
        object.__setattr__(record, one.name, large)
    lines = repr(record).splitlines()
    assert lines[0] == name
    assert 2 <= len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH + len("  : ") + max(len(one.name) for one in fields(kind))


def test_the_report_of_a_search_says_the_maximum_and_not_its_evaluations() -> None:
    report = sr.maximise(lambda x: -np.square(x - 0.25).sum(axis=1), sr.Box([0.0], [1.0]), budget=200)
    said = repr(report).splitlines()
    assert f"  best_value: {report.best_value:.9g}" in said
    assert "  best_point: [0.25]" in said
    assert "  evaluations: 200" in said
    assert "  points: array (200, 1)" in repr(report.trace)


def test_fields_without_a_line_are_named_and_hidden_ones_are_not() -> None:
    @dataclass
    class Many:
        a: int = 1
        b: int = 2
        c: int = 3
        d: int = 4
        e: int = 5
        f: int = 6
        g: int = 7
        h: int = 8
        i: int = 9
        j: int = 10
        hidden: int = field(default=11, repr=False)

        __repr__ = brief

    assert repr(Many()).splitlines()[1] == "  a: 1"
    assert repr(Many()).splitlines()[-1] == "  and i, j"
    assert len(repr(Many()).splitlines()) == LINES
