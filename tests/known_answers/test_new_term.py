"""Guards what docs/architecture.md says of a new term: one that no problem of the package knows goes all the way, from
its key to the figures, by what it says of itself. ``tests/support/store.py`` is all that was written for it.

``x' = u1 + u2 + w``, ``x(0) = 0``, ``|w| <= 0.05``, at least 0.95 after one unit of time: ``int (u1 + u2) = 1``. The
second control costs twice as much, and of the first a store gives ``level - least = 0.6``: ``J = 0.6 + 2 * 0.4 = 1.4``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.units import Units

pytestmark = pytest.mark.slow
TERM = Path(__file__).parents[1] / "support" / "store.py"
REGISTERED = "DERIVED[Store] = derived\n"
CONFIG: dict[str, Any] = {
    "plugins": [str(TERM)],
    "problem": {
        "name": "stored",
        "system": {"A": [[0.0]], "B": [[1.0, 1.0]], "E": [[1.0]]},
        "horizon": 1.0,
        "initial_state": 0.0,
        "control": {"box": [2.0, 0.7]},
        "disturbance": {"box": 0.05},
        "weights": [1.0, 2.0],
        "terminal": [{"polytope": {"H": [[-1.0]], "h": [-0.95]}}],
        "store": [{"G": [[1.0, 0.0]], "level": 1.0, "least": 0.4, "name": "tank"}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    return sr.run(CONFIG, out=tmp_path_factory.mktemp("store") / "run", quiet=True)


def test_its_rows_are_in_the_optimum_and_in_the_proof_and_the_checker_derives_them(run: sr.Outcome) -> None:
    assert run.status == "certified" and abs(run.result.cost - 1.4) < 1e-6
    assert run.directory is not None
    assert "tank" in (run.directory / "certificate.json").read_text()
    assert sr.check(run.directory, plugins=[TERM]).status == "verified"


def test_a_checker_that_does_not_know_it_says_so_and_leaves_it_out_of_nothing(run: sr.Outcome, tmp_path: Path) -> None:
    text, unknown = TERM.read_text(), tmp_path / "store.py"
    assert text.count(REGISTERED) == 1
    unknown.write_text(text.replace(REGISTERED, ""))
    with pytest.raises(sr.InputError, match="the checker derives too, got Store"):
        sr.check(run.directory, plugins=[unknown])


def test_what_it_says_beside_others_is_explained_under_its_name(tmp_path: Path) -> None:
    less = sr.run(CONFIG, {"problem.control.box": [2.0, 0.3]}, out=tmp_path / "run", quiet=True, figures=False)
    assert less.status == "infeasible" and "tank: tank(1) <= 0.6" in less.result.message


def test_it_is_drawn_and_bounded_as_a_state(run: sr.Outcome) -> None:
    axes = run.plot("states").axes
    assert any("tank" in axis.get_ylabel() for axis in axes)
    assert {row.constraint: round(row.upper, 6) for row in sr.bound(run).rows}["tank"] == 0.6


def test_a_margin_varies_it() -> None:
    margin = sr.margin(CONFIG, of="store.0")  # the other control gives at most 0.7
    assert margin.lower == pytest.approx(0.5, abs=1e-5) and margin.upper == pytest.approx(0.5, abs=1e-5)


def test_it_is_itself_in_other_units_and_stands_beside_errors_of_execution(run: sr.Outcome, tmp_path: Path) -> None:
    units = Units(2.0, np.array([8.0]), np.array([32.0, 4.0]), np.array([1.0]), np.zeros(0), 1.0)
    (entry,) = run.experiment.transcription.stated.in_units(units).store
    assert entry.G.tolist() == [[64.0, 0.0]] and entry.stop == 0.5
    erring = sr.run(CONFIG, {"problem.execution": 0.01}, out=tmp_path / "run", quiet=True, figures=False)
    assert erring.result.cost == pytest.approx(0.6 + 2.0 * (1.0 / 0.99 - 0.6), abs=1e-6)
    assert sr.check(tmp_path / "run", plugins=[TERM]).status == "verified"
