"""Guards the gain of workers in a search for the maximum of g: what they bring, and what they cost."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import Anew
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.relaxed import batches
from sparserob_core.sip.relaxed.batches import Batches, Oracle

pytestmark = pytest.mark.benchmark
PIECES = 250
CONFIG = Path(__file__).parents[2] / "configs/experiment1_repaired.yaml"


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two processors")
@pytest.mark.parametrize(("indices", "count"), [(4, 256), (50, 256)])
def test_two_workers_gain_once_they_stand(indices, count, capsys):
    """In processor time, as other programs may be busy here: the busiest worker does about half of the work."""
    pytest.importorskip("psutil")
    command = [sys.executable, __file__, str(indices), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    with capsys.disabled():
        print(f"\n{indices} indices, {count} values of g: {done.stdout.strip()}")
    assert told["same"]
    assert told["alone, processor"] / told["busiest worker, processor"] > 1.4


def measured(indices, count):
    """Print what a batch takes here and on two workers, in a process that checks no shapes."""
    import psutil

    batches.MIN_SECONDS_FOR_WORKERS = batches.START = 0.0
    pieces = {"dictionaries.control.pieces": PIECES, "dictionaries.disturbance.pieces": PIECES}
    oracle = Oracle(Anew.of(load_config(CONFIG, pieces)), "reduced", indices)
    domain = oracle.build().domain
    points = np.random.default_rng(0).uniform(domain.lower, domain.upper, (count, domain.dimension))

    def fresh(executor):
        g = oracle.build()
        g.epsilon = 1e-2
        return Batches(g, oracle, executor, 0)

    def timed(batch):
        began = time.perf_counter(), time.process_time()
        values = batch.values(points, lambda value, bound: None)
        return values, time.perf_counter() - began[0], time.process_time() - began[1]

    alone = fresh(None)
    alone.values(points[:64], lambda value, bound: None)
    expected, serial, work = timed(alone)
    with sr.load_registry().build("executor", "processes", {"workers": 2}).open() as executor:
        helped = fresh(executor)
        _, first, _ = timed(helped)
        workers = [psutil.Process(pid) for pid in executor._processes]
        before = [sum(one.cpu_times()[:2]) for one in workers]
        values, second, own = timed(helped)
        spent = [sum(one.cpu_times()[:2]) - spent for one, spent in zip(workers, before, strict=True)]
    told = {
        "same": values.tobytes() == expected.tobytes() and helped.executor is not None,
        "alone": serial,
        "with their start": first,
        "on two workers": second,
        "alone, processor": work,
        "busiest worker, processor": max(spent),
        "here meanwhile, processor": own,
    }
    print(json.dumps({name: value if value is True else round(value, 3) for name, value in told.items()}))


if __name__ == "__main__":
    measured(*map(int, sys.argv[1:]))
