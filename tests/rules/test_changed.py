"""Guards the choice of tests after a change: nothing that it can affect is left out, and not all is run."""

from __future__ import annotations

import pytest

from tests.changed import affected, importers

FOLDERS = ["control/sets", "experiment", "experiment/figures", "known_answers", "rules", "sip/inner", "sip/proof"]


@pytest.fixture(scope="module")
def real():
    return importers()


@pytest.mark.parametrize(
    ("changed", "run"),
    [
        ("sparserob_core/sip/proof/verdict.py", ["experiment", "known_answers", "rules", "sip/proof"]),
        ("sparserob_core/experiment/figures/style.py", ["experiment", "experiment/figures", "known_answers", "rules"]),
        ("sparserob_core/sip/inner/__init__.py", ["known_answers", "rules", "sip/inner"]),
        ("docs/tour.md", ["known_answers", "rules"]),
        ("pyproject.toml", FOLDERS),
        ("tests/support/stub.py", FOLDERS),
    ],
)
def test_what_imports_what_was_changed_is_run(changed, run, real):
    found = affected([changed], real, FOLDERS)
    missing = {f"tests/{folder}" for folder in run} - set(found)
    assert not missing
    if changed.startswith("sparserob_core/experiment"):
        assert "tests/sip/proof" not in found and "tests/control/sets" not in found


def test_a_module_that_is_gone_still_runs_the_tests_of_its_place(real):
    assert affected(["sparserob_core/control/sets/gone.py"], real, FOLDERS) == [
        "tests/control/sets",
        "tests/known_answers",
        "tests/rules",
    ]


def test_tests_that_were_changed_are_run_once(real):
    changed = ["tests/sip/inner/test_finite.py", "tests/known_answers/test_edges.py", "docs/tour.md"]
    assert affected(changed, real, FOLDERS) == [
        "tests/known_answers",
        "tests/rules",
        "tests/sip/inner/test_finite.py",
    ]


def test_nothing_is_run_where_nothing_was_changed(real):
    assert affected([], real, FOLDERS) == []
