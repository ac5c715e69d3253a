"""Guards speed: what events cost the method ``sparserob``: 10 000 evaluations with an observer that does nothing beside
as many without one, in turns.

Two runs of the same work differ by a per cent or two on a shared machine, so the time that the core itself spends on
telling is also measured inside a run; the wrappers that measure it are part of what they measure.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble, tools_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.run.events import Broadcast, RunFinished, RunStarted
from sparserob_core.sip.methods.sparserob import SparseRob
from sparserob_core.sip.search.notifier import Notifier
from tests.support.places import CONFIGS

CONFIG = CONFIGS / "experiment1_reduced.yaml"
OVERRIDES = [
    "dictionaries.control.pieces=100",
    "dictionaries.disturbance.pieces=100",
    "maximiser={name: simulated_annealing, budget: 1000}",
    "continuation={start: 1.0e-2, stop: 1.0e-2}",
]
TURNS = 10


class Idle(sr.Observer):
    """Does nothing."""

    def receive(self, event):
        pass


def solved(loaded, program, told, seed):
    """One run of 1000 evaluations; its seconds, and the values of g."""
    tools = replace(tools_of(loaded), rng=np.random.default_rng(seed))
    if told:
        broadcast = Broadcast([("idle", Idle())])
        broadcast(RunStarted(title="", directory=None, problem=None, program=program))
        tools = replace(tools, notify=broadcast)
    start = time.process_time()
    result = SparseRob(indices=12).solve(program, tools)
    seconds = time.process_time() - start
    if told:
        broadcast(RunFinished(status=result.status, message="", seconds=seconds, result=result))
    return seconds, result.trace.value


@pytest.fixture
def work():
    loaded = load_config(CONFIG, OVERRIDES)
    program = assemble(loaded).program
    for told in (False, True):
        solved(loaded, program, told, 0)  # everything is imported
    return loaded, program


@pytest.mark.benchmark
def test_an_observer_that_does_nothing_costs_less_than_a_hundredth_of_a_run(work, capsys):
    ratios, count = [], 0
    for seed in range(TURNS):
        order = (False, True) if seed % 2 else (True, False)
        seconds = {told: solved(*work, told, seed) for told in order}
        assert seconds[True][1].tolist() == seconds[False][1].tolist()
        count += seconds[True][1].size
        ratios.append(seconds[True][0] / seconds[False][0])
    with capsys.disabled():
        print(
            f"\n{count} evaluations with and without an idle observer: ratio {np.median(ratios):.4f} (median of {TURNS}"
            f" pairs, {min(ratios):.4f} to {max(ratios):.4f})"
        )
    assert count == 1000 * TURNS
    assert np.median(ratios) < 1.03, "a hundredth, and what the machine may add"


@pytest.mark.benchmark
def test_telling_takes_less_than_a_hundredth_of_a_run(work, monkeypatch, capsys):
    spent, calls = [0.0], [0]

    def clocked(function):
        def timed(*arguments):
            start = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                calls[0] += 1
                spent[0] += time.perf_counter() - start

        return timed

    for name in ("add", "note", "tell"):
        monkeypatch.setattr(Notifier, name, clocked(getattr(Notifier, name)))
    monkeypatch.setattr(Notifier, "due", property(clocked(Notifier.due.fget)))
    start = time.perf_counter()
    count = sum(solved(*work, True, seed)[1].size for seed in range(TURNS))
    total = time.perf_counter() - start
    with capsys.disabled():
        print(
            f"\ntelling of {count} evaluations: {1e6 * spent[0] / count:.2f} us each, {spent[0] / total:.2%} of"
            f" {total:.1f} s"
        )
    assert count == 1000 * TURNS
    assert calls[0] >= 2 * count, "nothing was told"
    assert spent[0] < 0.01 * total
