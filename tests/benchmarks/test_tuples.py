"""Guards speed: what every maximiser proves of experiment 1 by the paper's method, in one run: the share of the exact
value that its lower bound reaches.

Eight indices and one weight of the regulariser. Reduced, a tuple is eight times; literal, each time comes with a
disturbance of 500 numbers.
"""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.places import CONFIGS

EVALUATIONS = (50, 200, 2000)
SEEDS = {"reduced": 3, "literal": 1}
MAXIMISERS = (
    {"name": "gradient_ascent"},
    {"name": "simulated_annealing"},
    {"name": "simulated_annealing", "polish": 0.2},
    {"name": "sequool"},
    {"name": "sequool", "polish": 0.2},
    {"name": "adalipo"},
    {"name": "maxlipo"},
    {"name": "dual_annealing"},
    {"name": "direct"},
    {"name": "nevergrad"},
    {"name": "sobol"},
    {"name": "random_search"},
)
PIECES = {"name": "piecewise_constant", "pieces": 250}


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """The proven bounds of the value, by the exchange."""
    result = sr.run(
        CONFIGS / "experiment1_repaired.yaml", out=tmp_path_factory.mktemp("exact") / "run", quiet=True, figures=False
    ).result
    assert result.status == "certified"
    return result.lower_bound, result.upper_bound


def proven(formulation, maximiser, seed, out):
    """The lower bound after so many evaluations each."""
    method = {"name": "sparserob", "formulation": formulation, "indices": 8, "sc2": {"name": "evaluations"}}
    overrides = {
        "maximiser": {**maximiser, "budget": EVALUATIONS[-1]},
        "method": method,
        "continuation": {"start": 1e-3, "stop": 1e-3},
        "dictionaries": {"control": PIECES, "disturbance": PIECES},
        "seed": seed,
    }
    result = sr.run(CONFIGS / f"experiment1_{formulation}.yaml", overrides, out=out, quiet=True, figures=False).result
    bounds = result.trace.bound
    return [float(bounds[min(count, bounds.size) - 1]) for count in EVALUATIONS[:-1]] + [result.lower_bound]


@pytest.mark.benchmark
@pytest.mark.parametrize("formulation", ["reduced", "literal"])
def test_no_maximiser_exceeds_the_exact_value_and_reduced_the_best_meets_it(formulation, exact, tmp_path, capsys):
    lower, upper = exact
    lines = [
        f"\n{formulation}, least share of {lower:.7f} over {SEEDS[formulation]} seed(s), proven after "
        + ", ".join(map(str, EVALUATIONS))
    ]
    reached = []
    for maximiser in MAXIMISERS:
        if maximiser["name"] == "nevergrad" and find_spec("nevergrad") is None:
            lines.append("  SKIPPED, because nevergrad is not installed: nevergrad")
            continue
        name = ", ".join(str(value) if key == "name" else f"{key} {value}" for key, value in maximiser.items())
        runs = np.array(
            [proven(formulation, maximiser, seed, tmp_path / f"{name} {seed}") for seed in range(SEEDS[formulation])]
        )
        assert (runs <= upper).all(), name
        reached.append(runs.min(axis=0)[-1] / lower)
        lines.append(f"  {name:32}" + "".join(f" {share:9.5f}" for share in runs.min(axis=0) / lower))
    with capsys.disabled():
        print("\n".join(lines))
    if formulation == "reduced":
        assert max(reached) >= 0.99
