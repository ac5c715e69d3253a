"""Guards control/constraints/sensitivity: derivatives in the index of every kind of family that problems make, moving
and mixed walls, integrals, systems in time and errors of execution included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.transcription.transcribe import prepare
from tests.control.constraints.test_sensitivity import assert_it_is_the_derivative, indices_in
from tests.support.families import HORIZON, problem, program
from tests.support.plants import uniform


def held(family, rng):
    """Indices away from breakpoints, and rows: of a mixed wall those that see the control that acts."""
    indices = indices_in(rng, family, 8)
    grid = np.round(indices[:, 0] / 0.5) * 0.5
    indices[:, 0] = np.where(np.abs(indices[:, 0] - grid) < 0.02, grid + 0.03, indices[:, 0])
    indices[:, 0] = np.clip(indices[:, 0], family.index_set.lower[0], family.index_set.upper[0])
    rows = rng.integers(0, family.rows(indices[:1])[1].shape[1], len(indices))
    return indices, rows


@pytest.mark.parametrize("kind", ["known", "parametric", "taking turns", "varying", "execution", "integrals"])
def test_slopes_of_every_kind_of_family_are_those_of_the_violation(kind):
    rng, made = np.random.default_rng(3), program(kind)
    looked = 0
    for family in made.families:
        if family.gradient is None or not isinstance(family.source, StateConstraint):
            continue
        if family.index_set.lower[0] == family.index_set.upper[0]:
            continue  # at one time
        x = rng.normal(size=made.n)
        assert_it_is_the_derivative(family, x, *held(family, rng))
        looked += 1
    assert looked >= (1 if kind == "execution" else 2)


@pytest.mark.parametrize("kind", ["varying"])
def test_measurable_disturbances_of_a_system_in_time_have_slopes_too(kind):
    plain, _ = problem(kind)
    path = [one for one in plain.path if one.name != "curved"]
    measurable = replace(plain, disturbance_class="measurable", path=path, initial_set=None)
    made = prepare(measurable, uniform(4, HORIZON), uniform(4, HORIZON)).program
    rng = np.random.default_rng(4)
    for family in made.families[:2]:
        x = rng.normal(size=made.n)
        assert_it_is_the_derivative(family, x, *held(family, rng))
