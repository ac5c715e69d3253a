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


@pytest.mark.parametrize("uncertain", [False, True])
def test_a_wall_that_is_ridden_all_day_takes_few_rounds_however_long_the_day(uncertain: bool) -> None:
    for pieces in (16, 64):
        result = sr.run(house(pieces, uncertain), quiet=True, figures=False).result
        assert result.status == "certified"
        assert abs(result.cost - least_heat(pieces)) <= 1e-6 * result.cost
        assert result.counts["rounds"] <= 12
