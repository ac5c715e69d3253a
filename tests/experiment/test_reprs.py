"""Guards `sparserob_core.brief`: every public result is said in ten lines, however large it is."""

from __future__ import annotations

import ast
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.brief import MAX_BRIEF_LINES, MAX_VALUE_LETTERS, brief
from sparserob_core.checker.outcome import Finding

OF_THEIR_OWN = {"Check", "Outcome", "Result", "ControlResult", "SolvedProblem", "Signal"}  # guarded beside them


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
    assert 2 <= len(lines) <= MAX_BRIEF_LINES
    assert max(map(len, lines)) <= MAX_VALUE_LETTERS + len("  : ") + max(len(one.name) for one in fields(kind))


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
    assert len(repr(Many()).splitlines()) == MAX_BRIEF_LINES


def many_states() -> sr.OptimalControlProblem:
    d = 60
    return sr.OptimalControlProblem(
        system=sr.LinearSystem(-np.eye(d), np.ones((d, 2)), names=()),
        horizon=1.0,
        initial_state=np.ones(d),
        control=sr.Box(-np.ones(2), np.ones(2)),
        disturbance=sr.Ellipsoid(np.zeros(d), np.eye(d)),
        path=[sr.PathConstraint(sr.Box(-np.full(d, 2.0), np.full(d, 2.0)), name=f"wall {k}") for k in range(40)],
        terminal=[sr.Polytope(np.eye(d), np.ones(d))],
        names=sr.Names(states=[f"state {k}" for k in range(d)]),
    )


def test_what_a_problem_is_made_of_is_said_in_ten_lines_too() -> None:
    problem = many_states()
    nouns = [
        problem,
        problem.system,
        problem.disturbance,
        *problem.path,
        *problem.terminal,
        problem.names,
        problem.cost,
    ]
    nouns += [sr.Dictionary.indicators(np.linspace(0, 1, 301)), sr.IntegralConstraint(G=np.ones((1, 2)), upper=1.0)]
    for one in nouns:
        lines = repr(one).splitlines()
        assert lines[0].startswith(type(one).__name__)
        assert len(lines) <= MAX_BRIEF_LINES
        assert max(map(len, lines)) <= MAX_VALUE_LETTERS + len("  disturbance_class: ")
    assert "A=array (60, 60)" in repr(problem.system)


def test_a_small_set_is_said_with_its_numbers_and_what_is_absent_is_not_said() -> None:
    assert repr(sr.Box([-1.0], [1.0])) == "Box(lower=[-1.], upper=[1.])"
    assert "parameters" not in repr(sr.LinearSystem([[0.0]], [[1.0]]))


def test_a_check_says_its_verdict_first_and_which_claims_fail() -> None:
    held = tuple(Finding(f"claim {k}", "holds", "as it is") for k in range(40))
    assert repr(sr.Check("a title", held, 1.0)).splitlines()[0] == "Check: verified"
    refuted = sr.Check("a title", (*held, Finding("cost", "fails", "J = 3, not 2")), 1.0)
    assert repr(refuted).splitlines() == [
        "Check: refuted",
        "  title: a title",
        "  40 claims hold",
        "  cost fails: J = 3, not 2",
        "  seconds: 1",
    ]
    many = sr.Check("t" * 500, tuple(Finding(f"claim {k}", "fails", "long " * 90) for k in range(40)), 1.0)
    assert len(repr(many).splitlines()) == MAX_BRIEF_LINES
    assert max(map(len, repr(many).splitlines())) <= MAX_VALUE_LETTERS + 2


def test_a_result_with_units_says_that_of_its_cost_and_a_controller_says_where_it_is() -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0]]),
        horizon=2.0,
        initial_state=[1.0],
        control=sr.Box([-1.0], [1.0]),
        terminal=[sr.Box([-0.5], [0.5])],
        names=sr.Names(control_units=["N"], time="s"),
    )
    result = sr.solve(problem, control={"name": "piecewise_constant", "pieces": 2})
    assert "  cost: 0.5 N s" in repr(result).splitlines()
    controller = sr.controller(result)
    controller.step(0.0, [1.0])
    assert repr(controller) == "Controller of 2 pieces, 1 steps made: applies its plan; covered"


def test_a_dictionary_that_is_none_is_refused_before_anything_is_written_down() -> None:
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0]]), horizon=2.0, initial_state=[1.0], control=sr.Box([-1.0], [1.0])
    )
    with pytest.raises(sr.InputError, match=r"control: expected a Dictionary.*got dict"):
        sr.transcribe(problem, control={"name": "piecewise_constant", "pieces": 2})  # type: ignore[arg-type]
