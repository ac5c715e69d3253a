"""What every test may ask for."""

from __future__ import annotations

import gc
import os
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

# before anything else of the package: shapes in annotations are checked here, but not where time is measured
os.environ["SPARSEROB_SHAPES"] = "" if "benchmark" in sys.argv else "1"
import sparserob_core.shapes

# processes that a test starts run as a user's do; where nobody compiles for the next one, each takes half a second more
del os.environ["SPARSEROB_SHAPES"]
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from hypothesis import HealthCheck, settings

from tests.stages import read_names
from tests.support.drafts import drafts
from tests.support.places import ROOT
from tests.support.stub import command, config, process

MEASURES = "benchmark" in sys.argv  # of `-m benchmark`: what is timed is a process as a user has it
assert sparserob_core.shapes.CHECKED is not MEASURES

__all__ = ["command", "config", "drafts", "process"]

# the same examples in every run, however slow the machine is; HYPOTHESIS_PROFILE=default searches for new ones
settings.register_profile("repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))

if not MEASURES:
    gc.set_threshold(50_000, 20, 20)


def pytest_collection_finish() -> None:
    """What modules and thousands of collected tests hold need not be searched for cycles again and again."""
    if not MEASURES:
        gc.freeze()


@pytest.hookimpl(tryfirst=True)  # before the tests of the other stage are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Make every set of parameters after the first ``n`` of a test that is marked ``first(n)`` one of the second
    stage; of the others those that take long, too, with which it begins. It ends with the longest."""
    met, long, longest = Counter[str](), read_names("long"), read_names("longest")
    for item in items:
        name, first = item.nodeid.partition("[")[0], item.get_closest_marker("first")
        if item.get_closest_marker("slow") is not None:
            continue
        met[name] += 1
        if first is not None and met[name] > first.args[0]:
            item.add_marker(pytest.mark.slow)
        elif name in long:
            item.add_marker(pytest.mark.long)
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: (item.get_closest_marker("long") is None, item.nodeid.partition("[")[0] in longest))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out slow tests that have not begun at ``SPARSEROB_UNTIL``, in seconds since 1970: a run with a limit
    ends by itself, and says how many tests are left. Those that only take long are always run; without a limit all
    are."""
    until, marked = os.environ.get("SPARSEROB_UNTIL"), {mark.name for mark in item.iter_markers()}
    if until is not None and "slow" in marked and "long" not in marked and time.time() > float(until):
        pytest.skip("the time of this run is over; make test-slow runs it")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the source tree."""
    return ROOT
