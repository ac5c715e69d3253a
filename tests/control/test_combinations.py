"""Guards the table of refusals: the first case that is present is raised, with its place, and every case is checked
somewhere in the core."""

from __future__ import annotations

import ast

import pytest

from sparserob_core.control.combinations import FEATURES, REFUSALS, refusal, refuse_cases
from sparserob_core.errors import InputError
from tests.support.places import ROOT


def test_the_first_case_that_is_present_is_raised_in_the_order_of_the_table() -> None:
    cases = {"curved path": "ellipsoid", "pieces of their own": True, "parameters": False}
    with pytest.raises(InputError) as raised:
        refuse_cases("affine", cases)
    assert raised.value.sentence == REFUSALS["affine"]["pieces of their own"].sentence
    with pytest.raises(InputError, match=r"^policy\.name: .* flat sides, which the ellipsoid has not"):
        refuse_cases("affine", {**cases, "pieces of their own": False})
    refuse_cases("affine", {"curved path": "", "parameters": False})


def test_a_case_that_nothing_declares_is_no_case() -> None:
    with pytest.raises(KeyError, match="weather"):
        refuse_cases("affine", {"weather": False})


def test_an_error_has_the_place_that_is_declared_unless_another_is_given() -> None:
    declared = refusal("execution", "affine", got="[0.1]")
    assert (declared.path, declared.got) == (("execution",), "[0.1]")
    assert declared.expected == REFUSALS["execution"]["affine"].sentence
    assert refusal("pieces of their own", "measurable", path="disturbance.1.breakpoints").path[1] == 1


def test_every_case_is_checked_in_the_core_and_every_pair_has_two_rows_of_the_table() -> None:
    unnamed = {(name, pair) for name, cases in REFUSALS.items() for case in cases.values() for pair in case.pairs
               if not {name, pair} <= set(FEATURES)}  # fmt: skip
    calls = [
        {node.value for node in ast.walk(call) if isinstance(node, ast.Constant)}
        for path in (ROOT / "sparserob_core" / "control").rglob("*.py")
        if "combinations import" in (text := path.read_text(encoding="utf-8"))
        for call in ast.walk(ast.parse(text))
        if isinstance(call, ast.FunctionDef)
    ]
    unchecked = {(name, case) for name, cases in REFUSALS.items() for case in cases
                 if not any({name, case} <= strings for strings in calls)}  # fmt: skip
    assert unnamed == set()
    assert unchecked == {("affine", "sparsest")}  # raised by the methods, which know no control
