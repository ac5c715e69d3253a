"""Guards answers on random problems: sets of every kind, parameters, equalities, unequal pieces, other costs, drift,
delay and two modes, in any units, against programs that share no code with the package (tests/support/instances.py);
and `check` of every fifth run.

The instances are those of fixed numbers, 300 in all, of which the second stage takes a share (tests/support/draws.py);
``SPARSEROB_FIRST_INSTANCE`` is the number of the first.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.draws import taken
from tests.support.instances import TOGETHER, config, instance, largest_violation, truth

QUICK = 2
COUNT = taken(300)
FIRST = int(os.environ.get("SPARSEROB_FIRST_INSTANCE", "300000"))
ALL_AT_ONCE = range(TOGETHER, TOGETHER + COUNT // 10)
# problems whose honest runs `check` once refused, or did not check: taken whatever the numbers are
FOUND = (300270, 301955, 420593, 420815, 610056, 610151, 630416, 640058, 3400074, 3400102, 3600060)


def numbers():
    return [
        *range(FIRST, FIRST + QUICK),
        *(
            pytest.param(seed, marks=pytest.mark.slow)
            for seed in sorted({*FOUND, *range(FIRST + QUICK, FIRST + COUNT), *ALL_AT_ONCE})
        ),
    ]


@pytest.mark.first(1)
@pytest.mark.parametrize("seed", numbers())
def test_what_is_said_of_a_random_problem_in_any_units_is_true(seed, tmp_path):
    problem, units = instance(seed)
    checked = seed % 5 == 0 or seed in FOUND
    lower, upper = truth(problem)
    outcome = sr.run(
        config(problem, units),
        {"solver.name": ("piqp", "clarabel")[seed % 2]},
        out=tmp_path / "run" if checked else None,
        quiet=True,
        figures=False,
    )
    result = outcome.result
    if np.isinf(lower):
        assert result.status == "infeasible", result.message
    elif np.isfinite(upper):
        assert result.status in ("certified", "verified"), result.message
    if result.status in ("certified", "verified"):
        largest = problem.largest
        close = 1e-6 * max(1e-3 * largest, result.cost / units.value)
        assert result.cost / units.value >= lower - close
        assert result.lower_bound / units.value <= upper + close
        if not problem.slopes:  # of an uncertain problem the upper value has room to spare
            assert result.cost / units.value <= upper + close + result.gap * upper
        if problem.dictionary == "piecewise_constant":
            pieces = result.decision.reshape(len(problem.weights), -1) / units.controls[:, None]
            assert largest_violation(problem, pieces.ravel()) <= 2e-9
    if checked:
        found = [claim for claim in sr.check(tmp_path / "run").claims if claim.verdict != "holds"]
        assert not found, found
