"""Guards the way back from own units: a decision of either program in own units is the same policy in the user's."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.transcription.transcribe import in_own_units, prepare, transcribe

SENSOR = sr.Measurements([[1.0, 0.0]], noise=sr.Box([-1e-5], [1e-5]))
GRID = sr.Dictionary.indicators(np.linspace(0.0, 2.0, 6))


def pushed(**more: Any) -> sr.OptimalControlProblem:
    """``x'' = 9 x + u + w`` with far more control than it needs, from a small box."""
    return sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0, 1.0], [9.0, 0.0]], [[0.0], [1.0]], [[0.0], [1.0]]),
        initial_state=[0.1, 0.0],
        initial_set=sr.Box([-1e-5, -3e-4], [1e-5, 3e-4]),
        horizon=2.0,
        control=sr.Box([-1e5], [1e5]),
        disturbance=sr.Box([-1e-4], [1e-4]),
        disturbance_class="piecewise_constant",
        path=[sr.Box([-0.5, -20.0], [0.5, 20.0])],
        terminal=[sr.Box([-0.2, -2.0], [0.2, 2.0])],
        **more,
    )


@pytest.mark.parametrize("prestabilise", ["auto", None])
@pytest.mark.parametrize("more", [{}, {"measurements": SENSOR}])
def test_a_decision_in_wider_units_is_the_same_policy(more: dict[str, Any], prestabilise: Any) -> None:
    """Its gains had other coordinates: a run was certified at a final state outside of its box."""
    program = transcribe(pushed(**more), GRID, policy=sr.AffinePolicy(prestabilise=prestabilise))
    own = program.own_units
    assert own is not None and own.wider is not None
    for units in (own, own.wider()):
        decision = np.random.default_rng(3).normal(size=units.decision.size)
        for theirs, ours in zip(program.families, units.program.families, strict=True):
            if theirs.name in ("path", "terminal"):
                found = theirs.violations(decision * units.decision, theirs.index_set.upper[None])
                expected = ours.violations(decision, ours.index_set.upper[None]) * np.asarray(ours.row_units)
                assert found == pytest.approx(expected, rel=1e-9) and np.abs(found).max() > 0.0


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("more", [{}, {"measurements": SENSOR}])
def test_gains_are_those_that_are_written(more: dict[str, Any], wide: bool) -> None:
    model = prepare(pushed(**more), GRID, GRID, policy=sr.AffinePolicy(prestabilise="auto"))
    own, units = in_own_units(model, wide=wide)
    assert own.feedback is not None and model.feedback is not None and model.program.own_units is not None
    ours, theirs, sensors = own.feedback.loop, model.feedback.loop, model.problem.measurements
    narrow = model.program.own_units
    assert narrow.wider is not None
    factors = narrow.wider().decision if wide else narrow.decision
    decision = np.random.default_rng(4).normal(size=factors.size)
    measured = units.states if sensors is None else sensors.units(units.states)
    gains = ours.gains(decision) * units.controls[:, None] / measured
    assert np.array_equal(gains, theirs.gains(factors * decision)) and np.abs(gains).max() > 0.0
