"""Guards control.transcription.rounding: a bound that is written down is one that its multipliers prove."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.transcription import rounding
from sparserob_core.control.transcription.transcribe import prepare
from sparserob_core.experiment.check.check import check
from sparserob_core.sip.evidence import Cut


def on(pieces: int | list[float], problem: dict[str, Any]) -> dict[str, Any]:
    grid = {"pieces": pieces} if isinstance(pieces, int) else {"breakpoints": pieces}
    return {
        "problem": {"name": "linear", **problem},
        "dictionaries": {"control": {"name": "piecewise_constant", **grid}},
        "observers": [],
    }


SHORT_AND_STRONG = on(
    [0.0, 1e-6, 0.5, 0.5000010000000801, 1.0],
    {
        "system": {"A": [[0.0]], "B": [[1.0]]},
        "horizon": 1.0,
        "initial_state": [0.0],
        "control": {"box": {"lower": [0.0], "upper": [1e6]}},
        "path": [{"box": {"lower": [0.900000072], "upper": [None]}, "from": 0.6}],
        "terminal": [{"box": {"lower": [1.5], "upper": [1.50000001]}}],
    },
)
CHEAP = on(
    6,
    {
        "system": {
            "A": [["-0.3 + 0.1*p1", 1.0], [0.0, "-0.5+0.2*p1"]],
            "B": [[0.0], [1.0]],
            "parameters": {"p1": [-0.7, 0.7]},
        },
        "horizon": 2.0,
        "initial_state": [1.0, 0.0],
        "control": {"box": 2.0},
        "terminal": [{"box": {"lower": [None, -0.5], "upper": [0.62, None]}}],
    },
)
LARGE = on(
    20,
    {
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [-1e3, 1e3],
        "control": {"box": 1e3},
        "disturbance": {"box": [50.0, 50.0]},
        "terminal": [{"box": [300.0, 300.0]}],
    },
)
ERRING = {
    **LARGE,
    "problem": {**LARGE["problem"], "execution": 0.02, "system": {"A": [[0, "1 + 0*t"], [-2, -0.5]], "B": [[0], [1]]}},
}


@pytest.mark.parametrize(
    "config", [SHORT_AND_STRONG, CHEAP, LARGE, ERRING], ids=["short and strong", "cheap", "large", "erring"]
)
def test_the_bound_that_is_written_is_never_above_the_one_that_its_multipliers_prove(
    config: dict[str, Any], tmp_path: Path
) -> None:
    outcome = sr.run(config, out=tmp_path / "run", figures=False)
    assert outcome.result.status == "certified"
    assert 0.0 < outcome.result.lower_bound < outcome.result.upper_bound
    assert outcome.result.dual.bound == outcome.result.lower_bound
    found = {claim.name: claim.verdict for claim in check(tmp_path / "run").claims}
    assert found["lower bound"] == found["status"] == "holds"


def test_what_errors_of_execution_bring_to_a_row_is_added_up_too() -> None:
    dictionary = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0]]),
        horizon=2.0,
        initial_state=[-1.0],
        control=sr.Box([-3.0], [3.0]),
        terminal=[sr.Box([-0.1], [0.1])],
        execution=[0.05],
    )
    model = prepare(problem, dictionary, dictionary)
    result = SimpleNamespace(dual=SimpleNamespace(cuts=[Cut("terminal", np.array([2.0]), 1, 1.0)], mu=np.zeros(0)))
    # the beginning, 1, and what a command of 3 and 5 % of it, as often as integrals count, bring in 2 units of time
    total = 1.0 + 6.0 + 0.3 * rounding.INTEGRATED
    assert rounding._sum_row_magnitudes(model, result, rounding.ROW_ROUNDING, None) == pytest.approx(total)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("multiplier", "lower", "counted"),
    [
        (1.0, -3.0, 6.0),
        (1.0 - 1e-15, -3.0, 6.0),
        (1.0 - 1e-13, -3.0, 0.0),
        (0.5, -3.0, 0.0),
        (0.5, 1.0, 6.0),
    ],
    ids=["as large as its price", "but for rounding", "clear of it", "far below", "never off"],
)
def test_a_piece_whose_push_is_clear_of_its_price_adds_nothing(multiplier: float, lower: float, counted: float) -> None:
    dictionary = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0]]),
        horizon=2.0,
        initial_state=[-1.0],
        control=sr.Box([lower], [3.0]),
        terminal=[sr.Box([-0.1], [0.1])],
    )
    model = prepare(problem, dictionary, dictionary)
    result = SimpleNamespace(
        dual=SimpleNamespace(cuts=[Cut("terminal", np.array([2.0]), 1, multiplier)], mu=np.zeros(0), z=None)
    )
    # the beginning, 1, and what a command of 3 brings in 2 units of time, at a price of 1
    prices = model.program.finite.weights
    found = rounding._sum_row_magnitudes(model, result, rounding.ROW_ROUNDING, prices)  # type: ignore[arg-type]
    assert found == pytest.approx(multiplier * (1.0 + counted), rel=1e-12)


def test_what_cancels_in_the_slope_of_a_quadratic_cost_is_added_up_too() -> None:
    dictionary = sr.Dictionary.indicators([0.0, 1.0])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0]], [[1.0, 1.0]]),
        horizon=1.0,
        initial_state=[-1.0],
        control=sr.Box([-3.0, -2.0], [3.0, 2.0]),
        terminal=[sr.Box([-0.1], [0.1])],
        cost=sr.Cost(l1=0.0, control={"R": [[1.0, 1.0], [1.0, 1.0]]}),
    )
    model = prepare(problem, dictionary, dictionary)
    result = SimpleNamespace(dual=SimpleNamespace(at=np.array([1.0, -1.0])))
    # u'Ru has the slope 2 R u, which is (2 - 2, 2 - 2): four numbers of 2, at controls of 3 and 2, and of 1 in u'Ru
    assert rounding._sum_tangent_magnitudes(model, result) == pytest.approx(4.0 * 3.0 + 4.0 * 2.0 + 4.0)  # type: ignore[arg-type]
