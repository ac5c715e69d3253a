"""Guards claims of random plants with several unstable modes, whose problems are known to have a policy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.feasible import exceeded, feasible


@pytest.mark.slow
@pytest.mark.parametrize("number", range(12))
def test_a_plant_that_a_regulator_holds_is_steered_and_no_claim_is_wrong(number: int, tmp_path: Path) -> None:
    problem = feasible(number)
    outcome = sr.run(problem.options, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status in ("certified", "verified")
    assert outcome.result.lower_bound <= problem.known * (1.0 + 1e-9)
    assert exceeded(problem, outcome) <= 1.0
    assert "fails" not in {claim.verdict for claim in sr.check(outcome).claims}


@pytest.mark.slow
@pytest.mark.parametrize("array", ["theta", "gains", "prestabilise"])
def test_another_policy_exceeds_what_is_claimed(array: str, tmp_path: Path) -> None:
    problem = feasible(3)
    outcome = sr.run(problem.options, out=tmp_path / "run", quiet=True, figures=False)
    with np.load(outcome.directory / "solution.npz") as stored:
        arrays = dict(stored)
    np.savez(outcome.directory / "solution.npz", **{**arrays, array: 1.1 * arrays[array]})
    assert exceeded(problem, outcome) > 1.0
