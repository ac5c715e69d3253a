"""Guards sip/relaxed/batches: values of g are the same to the last bit wherever they are computed, and a worker that
fails costs nothing but its help."""

from __future__ import annotations

import pickle
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import Anew, assemble, tools_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.relaxed import batches
from sparserob_core.sip.relaxed.batches import CHUNK_TUPLES, MIN_CHUNKED_TUPLES, Batches, Oracle

CONFIG = {
    "problem": {
        "name": "linear", "horizon": 2.0,
        "system": {"A": [[0, 1], [0, "p1"]], "B": [[0], [1]], "parameters": {"p1": [-0.1, 0.1]}},
        "initial_state": [1, 0], "control": {"box": 1.0}, "disturbance": {"box": [0.01, 0.01]},
        "path": [{"box": [2.0, None]}], "terminal": [{"box": [0.5, 0.5]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 8}},
    "method": {"name": "sparserob", "indices": 4, "sc1": {"name": "iterations", "count": 2}},
    "maximiser": {"name": "random_search", "budget": 50},
    "continuation": {"start": 1e-2, "factor": 0.1, "stop": 1e-3},
    "observers": [],
}  # fmt: skip


class Elsewhere(Executor):
    """Makes each call from its pickled bytes, in another order; ``broken`` after so many of them."""

    def __init__(self, broken=None):
        self.calls, self.broken = 0, broken

    def submit(self, fn, /, *args, **kwargs):
        future, call = Future(), pickle.dumps((fn, args, kwargs))
        self.calls += 1
        if self.broken is not None and self.calls > self.broken:
            future.set_exception(BrokenExecutor("a worker has died"))
        else:
            batches._worker_state.g = None  # as on a worker that is new
            fn, args, kwargs = pickle.loads(call)
            future.set_result(pickle.loads(pickle.dumps(fn(*args, **kwargs))))
        return future


@pytest.fixture
def worth(monkeypatch):
    """Workers are asked however little there is to do."""
    monkeypatch.setattr(batches, "MIN_SECONDS_FOR_WORKERS", 0.0)
    monkeypatch.setattr(batches, "START", 0.0)


def searched(maximiser, executor=None, **changes):
    """A search with the workers of ``executor``: what it found, without the seconds."""
    loaded = load_config({**CONFIG, "maximiser": {"budget": 50, **maximiser}}, changes)
    tools = tools_of(loaded)
    heard = []
    program = assemble(loaded).program
    method = loaded.registry.build("method", "sparserob", loaded.config.method.options)
    tools = replace(tools, executor=executor, rebuild=Anew.of(loaded), notify=heard.append)
    result = solve_in_own_units(method, program, tools)
    trace = result.trace
    return {
        "value": trace.value.tobytes(), "bound": trace.bound.tobytes(), "points": trace.points.tobytes(),
        "decision": result.decision.tobytes(), "status": result.status, "lower": result.lower_bound,
        "counts": dict(result.counts), "cuts": [cut.multiplier for cut in result.dual.cuts],
        "rounds": [(one.lower_bound, one.violation) for one in result.history],
    }  # fmt: skip


REGISTRY = sr.load_registry()
LONG_BATCHES = ("random_search", "sobol")  # who asks for some in this small space


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == LONG_BATCHES[0] else pytest.mark.slow)
        for name in REGISTRY.names("maximiser")
        if name != "nevergrad"
    ],
)
def test_every_maximiser_finds_the_same_to_the_last_bit_with_workers_and_without(name, worth):
    workers = Elsewhere()
    assert searched({"name": name}) == searched({"name": name}, workers)
    if name in LONG_BATCHES:
        assert workers.calls > 2, "nothing was sent to the workers"


@pytest.mark.slow
def test_a_worker_that_dies_costs_nothing(worth):
    workers = Elsewhere(broken=1)
    assert searched({"name": "random_search"}) == searched({"name": "random_search"}, workers)
    assert workers.calls >= 2


@pytest.mark.slow
def test_the_literal_formulation_is_sent_as_what_it_is(worth):
    change = {"method.formulation": "literal"}
    workers = Elsewhere()
    assert searched({"name": "random_search"}, **change) == searched({"name": "random_search"}, workers, **change)
    assert workers.calls


def test_a_search_with_little_to_do_starts_no_workers():
    workers = Elsewhere()
    searched({"name": "random_search"}, workers)
    assert not workers.calls


@pytest.fixture(scope="module")
def oracle():
    loaded = load_config(CONFIG)
    return Oracle(Anew.of(loaded), "reduced", 4)


def valued(oracle, points, executor=None):
    g = oracle.build()
    g.epsilon = 1e-2
    told = []
    found = Batches(g, oracle, executor, 0).values(points, lambda value, dual: told.append((value, dual is not None)))
    return g, found, told


def test_values_do_not_depend_on_how_often_the_batch_was_asked_for(oracle):
    g = oracle.build()
    points = np.random.default_rng(1).uniform(
        g.domain.lower, g.domain.upper, (MIN_CHUNKED_TUPLES + 5, g.domain.dimension)
    )
    g.epsilon = 1e-2
    batch = Batches(g, oracle, None, 0)
    first, second = (batch.values(points, lambda value, dual: None) for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_chunks_agree_with_one_after_the_other_to_the_accuracy_of_the_solver(oracle):
    _, found, told = valued(oracle, points_of(oracle, MIN_CHUNKED_TUPLES + 3))
    singly = oracle.build()
    singly.epsilon = 1e-2
    np.testing.assert_allclose(found, singly(points_of(oracle, MIN_CHUNKED_TUPLES + 3)), atol=1e-8)
    assert [value for value, _ in told] == found.tolist()
    best = np.maximum.accumulate(found)
    assert [bounded for _, bounded in told] == [k == 0 or found[k] > best[k - 1] for k in range(len(found))]


def test_who_asks_about_the_last_tuple_is_answered_about_it(oracle):
    points = points_of(oracle, MIN_CHUNKED_TUPLES)
    g, _, _ = valued(oracle, points)
    alone = oracle.build()
    alone.epsilon = 1e-2
    alone.at(points[-1])
    assert np.array_equal(g.acting(), alone.acting())
    np.testing.assert_array_equal(g.gradient(points[-1]), alone.gradient(points[-1]))


def points_of(oracle, count):
    domain = oracle.build().domain
    return np.random.default_rng(0).uniform(domain.lower, domain.upper, (count, domain.dimension))


def test_a_deadline_on_a_worker_is_one_here(oracle, worth):
    g = oracle.build()
    g.epsilon = 1e-2
    points = points_of(oracle, 2 * MIN_CHUNKED_TUPLES)

    class Late(Elsewhere):
        def submit(self, fn, oracle, points, epsilon, best, seconds):
            assert 0.0 < seconds <= 3600.0
            return super().submit(fn, oracle, points, epsilon, best, 1e-9)

    g.relaxed.deadline = Deadline(3600.0)
    with pytest.raises(OutOfTime):
        Batches(g, oracle, Late(), 10**6).values(points, lambda value, dual: None)


def test_threads_of_a_worker_do_not_share_what_changes(oracle, worth):
    points = points_of(oracle, 4 * MIN_CHUNKED_TUPLES)
    _, expected, _ = valued(oracle, points)
    with ThreadPoolExecutor(3) as executor:
        _, found, _ = valued(oracle, points, executor)
    assert found.tobytes() == expected.tobytes()


def test_chunks_are_shorter_than_long_batches():
    assert CHUNK_TUPLES < MIN_CHUNKED_TUPLES


@pytest.mark.slow
def test_a_run_with_processes_leaves_the_files_of_a_serial_one(tmp_path, worth, monkeypatch):
    """The workers' own rule does not matter: only this process decides what is sent."""
    honest, helped = Batches._evaluate_on_workers, []

    def watched(self, chunks, best):
        found = honest(self, chunks, best)
        helped.append(self.executor is not None)
        return found

    monkeypatch.setattr(Batches, "_evaluate_on_workers", watched)
    runs = {
        name: sr.run({**CONFIG, "executor": executor}, out=tmp_path / name, figures=False)
        for name, executor in {"serial": "serial", "processes": {"name": "processes", "workers": 2}}.items()
    }
    stored = [np.load(tmp_path / name / "evaluations.npz") for name in runs]
    for column in ("value", "bound", "points", "epsilon", "outer"):
        assert stored[0][column].tobytes() == stored[1][column].tobytes(), column
    assert runs["serial"].result.counts == runs["processes"].result.counts
    assert helped and all(helped), "the workers did not help"
