"""Guards problems whose worst case rides on its wall all the time: a heated house, against a linear program."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

import sparserob_core as sr

LOSS, GUST, WALL, START = (0.3, 0.5), 0.1, 1.0, 2.0


def house(pieces: int, uncertain: bool) -> dict[str, Any]:
    """One room: ``x' = -a x + u + w`` with ``|w| <= GUST``, never below ``WALL``, from ``START``."""
    loss = {"A": [["-a"]], "B": [[1]], "parameters": {"a": list(LOSS)}}
    known = {"A": [[-LOSS[1]]], "B": [[1]]}
    return {
        "problem": {
            "name": "linear",
            "system": loss if uncertain else known,
            "horizon": pieces / 4,
            "initial_state": [START],
            "control": {"box": {"lower": [0.0], "upper": [2.0]}},
            "disturbance": {"box": [GUST]},
            "path": [{"polytope": {"H": [[-1.0]], "h": [-WALL]}}],
        },
        "dictionaries": {name: {"name": "piecewise_constant", "pieces": pieces} for name in ("control", "disturbance")},
    }


def least_heat(pieces: int) -> float:
    """The value. The lowest state obeys ``y' = -a y + u - GUST`` with the largest loss, since y is positive; it is
    monotone on every piece, so that the nodes are all that counts."""
    step, loss = 0.25, LOSS[1]
    stays, gains = np.exp(-loss * step), (1 - np.exp(-loss * step)) / loss
    ages = np.subtract.outer(np.arange(1, pieces + 1), np.arange(1, pieces + 1))
    heated = np.where(ages >= 0, gains * stays ** np.maximum(ages, 0), 0.0)
    free = START * stays ** np.arange(1, pieces + 1) - heated @ np.full(pieces, GUST)
    found = linprog(np.full(pieces, step), A_ub=-heated, b_ub=free - WALL, bounds=(0.0, 2.0))
    assert found.status == 0
    return float(found.fun)


@pytest.mark.parametrize(
    ("pieces", "uncertain"),
    [
        (16, False),
        (16, True),
        pytest.param(64, False, marks=pytest.mark.slow),
        pytest.param(64, True, marks=pytest.mark.slow),
    ],
)
def test_a_wall_that_is_ridden_all_day_takes_few_rounds_however_long_the_day(pieces: int, uncertain: bool) -> None:
    result = sr.run(house(pieces, uncertain), quiet=True, figures=False).result
    assert result.status == "certified"
    assert abs(result.cost - least_heat(pieces)) <= 1e-6 * result.cost
    assert result.counts["rounds"] <= 12


def heating() -> dict[str, Any]:
    """Two rooms and their walls for a day in winter, comfort bands that move, an uncertain conductance, in kW and h."""
    A = [
        ["-(ua + 0.5) / 0.6", 0, "0.5 / 0.6"],
        [0, "-0.46 / 0.4", 1],
        ["0.5 / 6", "0.4 / 6", "-0.95 / 6"],
    ]
    B, E = [["1 / 0.6", 0], [0, "1 / 0.4"], [0, 0]], [["0.1 / 0.6", "1 / 0.6"], ["0.06 / 0.4", 0], ["0.05 / 6", 0]]
    drifts = {
        6.0: ["-2 * ua / 0.6", "-0.12 / 0.4", "-0.1 / 6"],
        18.0: ["4 * ua / 0.6", "0.24 / 0.4", "0.2 / 6"],
        24.0: [0, 0, 0],
    }
    comfort = [[0, 19, 18, 18], [6, 19, 18, 18], [8, 21, 19, 18], [22, 21, 19, 18], [24, 19, 18, 18]]
    return {
        "problem": {
            "name": "linear",
            "system": {
                "parameters": {"ua": [0.09, 0.11]},
                "pieces": [{"until": until, "A": A, "B": B, "E": E, "c": c} for until, c in drifts.items()],
            },
            "horizon": 24.0,
            "initial_state": {"centre": [19, 18, 18], "box": [0.3, 0.3, 0.3]},
            "control": {"box": {"lower": 0, "upper": [4, 3]}},
            "control_step": {"box": 1.5},
            "disturbance": {"box": [1.0, 0.05]},
            "path": [{"box": [2.0, 2.5, None], "relative_to": comfort, "from": 1.0}],
        },
        "dictionaries": {
            "control": {"name": "piecewise_constant", "step": 0.5},
            "disturbance": {"name": "piecewise_constant", "step": 1.0},
        },
    }


@pytest.mark.slow
def test_a_day_of_heating_is_certified_and_a_limit_leaves_a_proven_control() -> None:
    whole = sr.run(heating(), quiet=True, figures=False).result
    assert whole.status == "certified"
    limited = sr.run(heating(), {"limits.seconds": 10}, quiet=True, figures=False).result
    assert limited.status in ("certified", "verified")
    assert whole.lower_bound <= limited.upper_bound <= 1.05 * whole.lower_bound
