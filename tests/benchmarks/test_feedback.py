"""Guards the time that feedback takes beside the linear program that imposes the path at the breakpoints alone, as
HiGHS solves it by its interior point method: what proof over all times costs."""

from __future__ import annotations

import time

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import ControlExperiment, assemble, tools_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.inner.counterpart import Counterpart
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.methods.own_units import solve_in_own_units
from tests.support.problems import spring

pytestmark = pytest.mark.benchmark

SPRING = spring(0.3, since=0.5)
TIMES_AS_LONG = 3.0  # at most: the goal is 1


def nodal(program: sr.SemiInfiniteProgram, pieces: int) -> tuple[float, float]:
    """Seconds of processor time for the program at the breakpoints, and its optimum in its own units."""
    assert program.spread is not None
    relaxed = Counterpart(program.finite, program.spread)
    for family in program.families:
        assert family.uncertain is not None and family.start is not None
        first, last = family.index_set.lower[0], family.index_set.upper[0]
        nodes = np.linspace(0.0, last, pieces + 1)[:, None]
        indices = family.start if family.name == "control" or first == last else nodes[nodes[:, 0] >= first]
        for index in indices:
            relaxed.add(family.uncertain(index))
    for name, value in {"solver": "ipm", "run_crossover": "off"}.items():
        relaxed._linear.highs.setOptionValue(name, value)
    started = time.process_time()
    found = relaxed.solve()
    assert found.solved, found.said
    return time.process_time() - started, program.cost(found.x)


@pytest.mark.parametrize("pieces", [40, 100])
def test_a_certified_policy_takes_about_as_long_as_the_program_at_the_breakpoints(pieces: int) -> None:
    loaded = load_config(
        {
            "problem": SPRING,
            "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
            "policy": {"name": "affine"},
        }
    )
    experiment = assemble(loaded)
    assert isinstance(experiment, ControlExperiment)
    program = experiment.transcription.program
    assert program.own_units is not None
    seconds, least = nodal(program.own_units.program, pieces)
    started = time.process_time()
    result = solve_in_own_units(Exchange(), program, tools_of(loaded))
    ours = time.process_time() - started
    print(f"{pieces} pieces: certified in {ours:.2f} s, at the breakpoints {seconds:.2f} s: {ours / seconds:.2f}")
    assert result.status == "certified"
    assert result.cost >= least * program.own_units.program.cost_unit * (1.0 - 1e-6)
    assert ours <= TIMES_AS_LONG * seconds
