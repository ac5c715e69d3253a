"""Guards plugins/sparserob_dask: what it says and what it needs; the contract is tested with the others."""

from __future__ import annotations

import asyncio
import gc
import subprocess
import sys
import threading
import time

import pytest
from threadpoolctl import threadpool_limits

import sparserob_core as sr
from sparserob_core.testing.executors import echo, threads
from tests.support.places import ROOT

REGISTRY = sr.load_registry()


def opened(**options):
    return REGISTRY.build("executor", "dask", options).open()


@pytest.mark.parametrize("options", [{"workers": 2}, {"host": "0.0.0.0"}])
def test_a_running_cluster_has_its_own_workers(options):
    with pytest.raises(sr.InputError, match=rf"{next(iter(options))}: expected nothing beside address"):
        REGISTRY.build("executor", "dask", {"address": "tcp://127.0.0.1:8786", **options})


@pytest.mark.parametrize("options", [{"workers": 0}, {"timeout": 0.0}, {"adress": "here"}])
def test_options_out_of_range_are_named(options):
    with pytest.raises(sr.InputError, match=next(iter(options))):
        REGISTRY.build("executor", "dask", options)


@pytest.mark.slow
@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "nowhere"])
def test_a_scheduler_that_does_not_answer_is_an_error_of_the_input(address):
    pytest.importorskip("distributed")
    with (
        pytest.raises(sr.InputError, match=f"address: expected the address of a dask scheduler.* got {address}"),
        opened(address=address, timeout=1.0),
    ):
        pass
    from distributed import Client

    left = [one.status for one in gc.get_objects() if issubclass(type(one), Client)]
    assert set(left) <= {"closed"}, "the garbage collector would close it, and wait for locks of whatever it interrupts"


@pytest.mark.slow
def test_what_is_waited_for_is_told_once_it_lasts(monkeypatch, capfd):
    pytest.importorskip("distributed")
    from sparserob_dask import cluster

    class Client:
        """Answers at once; its workers never come."""

        def __init__(self, address, **options):
            pass

        def wait_for_workers(self, count, timeout):
            time.sleep(timeout)
            raise TimeoutError

        def close(self, timeout):
            pass

    monkeypatch.setattr(cluster, "SILENT", 0.05)
    monkeypatch.setattr(cluster, "_Client", Client)
    with pytest.raises(sr.InputError, match="no worker at tcp://here:1"), opened(address="tcp://here:1", timeout=0.5):
        pass
    (line,) = capfd.readouterr().err.splitlines()
    assert line == "dask: waiting up to 0.5 s for a worker at tcp://here:1: dask worker tcp://here:1"
    time.sleep(0.1)
    assert not capfd.readouterr().err


@pytest.mark.slow
def test_a_scheduler_that_does_not_answer_is_named_after_two_seconds(capfd):
    pytest.importorskip("distributed")
    address = "tcp://127.0.0.1:1"
    with pytest.raises(sr.InputError, match="a dask scheduler that answers"), opened(address=address, timeout=3.0):
        pass
    assert f"dask: waiting up to 3 s for the scheduler at {address} to answer" in capfd.readouterr().err.splitlines()


@pytest.mark.slow
def test_the_dashboard_is_told_and_nothing_listens_beyond_this_machine(capfd):
    pytest.importorskip("distributed")
    with threadpool_limits(2), opened(workers=1) as executor:
        assert executor.submit(echo, 3).result(60) == 3
        assert set(threads()) == {1}, "this process adds up in another order than the workers"
        listening = executor._client.scheduler_info()["address"]
    said = capfd.readouterr()
    assert said.out == ""
    assert said.err.startswith("dask dashboard: http://127.0.0.1:")
    assert listening.startswith("tcp://127.0.0.1:")


@pytest.mark.slow
def test_a_script_without_a_guard_starts_its_work_once(tmp_path):
    pytest.importorskip("distributed")
    (tmp_path / "study.py").write_text(
        "import sparserob_core as sr\n"
        "print('begins')\n"
        "def mine(value):\n    return 2 * value\n"
        "with sr.load_registry().build('executor', 'dask', {'workers': 2}).open() as executor:\n"
        "    print(list(executor.map(mine, range(3))))\n"
    )
    done = subprocess.run(
        [sys.executable, str(tmp_path / "study.py")], capture_output=True, text=True, timeout=120, cwd=ROOT, check=True
    )
    assert done.stdout.splitlines() == ["begins", "[0, 2, 4]"]


@pytest.mark.slow
@pytest.mark.parametrize("late", [0.2, 2.0])
def test_dask_is_given_the_time_that_was_asked_for_to_begin(late, monkeypatch):
    pytest.importorskip("distributed")
    begin = asyncio.Runner.run

    def begins_late(self, *args, **kwargs):
        time.sleep(late)
        return begin(self, *args, **kwargs)

    monkeypatch.setattr(asyncio.Runner, "run", begins_late)
    reason = "a dask scheduler that answers" if late < 1.0 else "its event loop has not begun within 1 s"
    started = time.monotonic()
    with pytest.raises(sr.InputError, match=reason), opened(address="tcp://127.0.0.1:1", timeout=1.0):
        pass
    assert time.monotonic() - started < 10.0
    for thread in threading.enumerate():
        if thread.name == "dask":
            thread.join(10.0)
            assert not thread.is_alive(), "a loop that begins too late goes on"
