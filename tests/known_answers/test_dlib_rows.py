"""Guards known answers: dlib's own table of MaxLIPO+TR (King 2017): mean evaluations until the best value is within
epsilon of the maximum.

The table gives mean and deviation and not the number of runs; two standard errors of the mean of ours are allowed
beyond the published mean.
"""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.functions import LANDSCAPES

EPSILONS = (0.1, 0.01, 1e-3, 1e-9)
SEEDS, FEW = 24, 5
ROWS = {
    "holder2": (300, (51, 54, 57, 66), (27, 27, 28, 27)),
    "complex_holder": (500, (150, 156, 165, 169), (89, 89, 87, 89)),
    "rosenbrock3": (450, (149, 189, 219, 238), (84, 88, 89, 88)),
    "sphere4": (500, (23, 57, 92, 400), (5, 9, 15, 49)),
    "deb5": (900, (138, 175, 199, 236), (160, 161, 171, 162)),
}


def evaluations_to(landscape, budget, seed):
    """The number of evaluations until each epsilon is reached; the budget must suffice."""
    best = sr.maximise(landscape.function, landscape.box, "maxlipo", budget=budget, seed=seed, polish=0.0).trace.best
    regret = landscape.maximum - best
    assert regret[-1] <= EPSILONS[-1], (
        f"{landscape.name}, seed {seed}: {regret[-1]:.2g} is left after {budget} evaluations"
    )
    return [int(np.argmax(regret <= epsilon)) + 1 for epsilon in EPSILONS]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seeds"), [("holder2", FEW), *(pytest.param(name, SEEDS, marks=pytest.mark.slow) for name in ROWS)]
)
def test_no_more_evaluations_are_needed_than_dlib_needs(name, seeds):
    budget, means, deviations = ROWS[name]
    counts = np.array([evaluations_to(LANDSCAPES[name], budget, seed) for seed in range(seeds)])
    allowed = np.array(means) + 2 * np.array(deviations) / np.sqrt(seeds)
    assert (counts.mean(axis=0) <= allowed).all(), f"{name}: {counts.mean(axis=0)} against {means}"
