"""Guards sparserob_core.testing and every registered executor: all keep the contract, and executors that are bad on
purpose fail it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

import pytest

import sparserob_core as sr
from sparserob_core.testing import ExecutorContract
from tests.support.faults import fails
from tests.support.places import ROOT

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("executor")
HERE = {"serial"}
LATER = {"dask", "processes"}  # they start processes in every test


def test_there_are_executors_to_be_tested():
    assert {"serial", "processes"} <= set(NAMES)


OWN_WORKERS = re.compile("dies|interrupt|error_of_the_caller|opened_again|one_thread")  # the others may share a cluster


@pytest.fixture(scope="module")
def cluster():
    """The address of a dask cluster that was there before."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as running:
        yield running.scheduler_address


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in LATER)) for name in NAMES])
class TestRegisteredExecutor(ExecutorContract):
    @pytest.fixture(autouse=True)
    def named(self, name, request):
        self.name, self.isolated = name, name not in HERE
        self.options = {"workers": 2} if self.isolated else {}
        if name == "dask" and not OWN_WORKERS.search(request.node.name):
            self.options = {"address": request.getfixturevalue("cluster")}
        elif name == "dask":
            pytest.importorskip("distributed")

    def create(self):
        return REGISTRY.build("executor", self.name, self.options)


class Bad(sr.ExecutorFactory):
    """An executor of one thread, for its flawed relatives to inherit from; it keeps the contract but for the threads
    of linear algebra, which nobody checks in it."""

    def __init__(self):
        self.pool = None

    @contextmanager
    def open(self):
        with self.workers() as self.pool:
            yield self.pool

    def workers(self):
        return ThreadPoolExecutor(1)


def flawed(submit):
    """A factory whose ``submit`` is replaced: by a function of the executor, its honest ``submit``, and a call."""

    class Flawed(Bad):
        def workers(self):
            class Pool(ThreadPoolExecutor):
                def submit(self, fn, /, *args, **kwargs):
                    return submit(self, super().submit, fn, args, kwargs)

            return Pool(1)

    Flawed.__name__, Flawed.__doc__ = submit.__name__, submit.__doc__
    return Flawed


def counted(pool):
    pool.count = getattr(pool, "count", 0) + 1
    return pool.count


@flawed
def losing(pool, honest, fn, args, kwargs):
    """Every third call is lost."""
    return Future() if counted(pool) % 3 == 0 else honest(fn, *args, **kwargs)


@flawed
def swallowing(pool, honest, fn, args, kwargs):
    """Errors become None."""

    def call():
        try:
            return fn(*args, **kwargs)
        except Exception:  # noqa: BLE001
            return None

    return honest(call)


@flawed
def twice(pool, honest, fn, args, kwargs):
    """Every call is made twice."""
    honest(fn, *args, **kwargs)
    return honest(fn, *args, **kwargs)


@flawed
def retrying(pool, honest, fn, args, kwargs):
    """What fails is tried once more."""

    def call():
        try:
            return fn(*args, **kwargs)
        except ArithmeticError:
            return fn(*args, **kwargs)

    return honest(call)


@flawed
def remembering(pool, honest, fn, args, kwargs):
    """Equal calls are made once."""
    known, key = pool.__dict__.setdefault("known", {}), (fn, repr(args), repr(kwargs))
    if key not in known:
        known[key] = honest(fn, *args, **kwargs)
    return known[key]


@flawed
def renaming(pool, honest, fn, args, kwargs):
    """Every error becomes one of its own."""

    def call():
        try:
            return fn(*args, **kwargs)
        except Exception as error:
            raise RuntimeError(str(error)) from error

    return honest(call)


@flawed
def traceless(pool, honest, fn, args, kwargs):
    """The traceback is cut off."""
    future, done = Future(), honest(fn, *args, **kwargs)
    future.set_running_or_notify_cancel()
    error = done.exception()
    if error is None:
        future.set_result(done.result())
    else:
        future.set_exception(error.with_traceback(None))
    return future


@flawed
def rounding(pool, honest, fn, args, kwargs):
    """Numbers travel as text of a few digits."""

    def call():
        answer = fn(*args, **kwargs)
        return answer.round(12) if hasattr(answer, "round") else answer

    return honest(call)


@flawed
def forgetting_keywords(pool, honest, fn, args, kwargs):
    """Keywords are dropped."""
    return honest(fn, *args)


class Obstinate(Future):
    """Says that it is cancelled, and is called all the same."""

    def cancel(self):
        self.called = True
        super().cancel()
        return True


@flawed
def calling_what_is_cancelled(pool, honest, fn, args, kwargs):
    future, done = Obstinate(), honest(fn, *args, **kwargs)

    def pass_on(done):
        if future.set_running_or_notify_cancel():
            future.set_exception(done.exception()) if done.exception() else future.set_result(done.result())

    done.add_done_callback(pass_on)
    return future


class Reordering(Bad):
    """`map` gives what is ready first."""

    def workers(self):
        class Pool(ThreadPoolExecutor):
            def map(self, fn, *iterables, timeout=None, chunksize=1):
                return reversed(list(super().map(fn, *iterables, timeout=timeout)))

        return Pool(2)


class Hasty(Bad):
    """The context ends before its calls."""

    @contextmanager
    def open(self):
        pool = ThreadPoolExecutor(1)
        yield pool
        pool.shutdown(wait=False)


class Dropping(Bad):
    """The context drops what has not begun."""

    @contextmanager
    def open(self):
        pool = ThreadPoolExecutor(1)
        yield pool
        pool.shutdown(wait=True, cancel_futures=True)


class Endless(Bad):
    """Calls are accepted after the end."""

    @contextmanager
    def open(self):
        yield Unending()


class Unending(Executor):
    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001
            future.set_exception(error)
        return future


KEPT = []


class Leaking(Bad):
    """Its threads live on."""

    kept = KEPT

    @contextmanager
    def open(self):
        pool = ThreadPoolExecutor(1)
        self.kept.append(pool)
        yield pool
        pool.submit(int).result()


class Unforgiving(Bad):
    """Errors of the caller end in it."""

    @contextmanager
    def open(self):
        with ThreadPoolExecutor(1) as pool:
            try:
                yield pool
            except KeyboardInterrupt:
                return


class ManyThreads(Bad):
    """Linear algebra takes as many threads as it likes."""

    @contextmanager
    def open(self):
        from threadpoolctl import threadpool_limits

        with threadpool_limits(2), super().open() as pool:
            yield pool


class Once(Bad):
    """Can be opened once."""

    def __init__(self):
        self.pool = ThreadPoolExecutor(1)

    @contextmanager
    def open(self):
        with self.pool as pool:
            yield pool


class Telling(Future):
    def _invoke_callbacks(self):
        super()._invoke_callbacks()
        super()._invoke_callbacks()


@flawed
def telling_twice(pool, honest, fn, args, kwargs):
    """Who waits is told twice."""
    future = Telling()
    done = honest(fn, *args, **kwargs)

    def pass_on(done):
        if future.set_running_or_notify_cancel():
            future.set_exception(done.exception()) if done.exception() else future.set_result(done.result())

    done.add_done_callback(pass_on)
    return future


class TestAnHonestExecutor(ExecutorContract):
    component, isolated = Bad, False

    def test_linear_algebra_has_one_thread(self):
        """Its relatives below do not limit it."""


ORDER = "test_answers_come_in_the_order_of_the_arguments_whatever_is_ready_first"
ONCE = "test_every_call_is_made_exactly_once"
ERRORS = "test_an_error_arrives_with_its_type_its_words_and_where_it_was_raised"
AS_THEY_ARE = "test_arguments_and_answers_arrive_as_they_are"
CANCELLED = "test_what_is_cancelled_is_not_called_and_what_is_not_has_its_answer"
WAITS = "test_the_end_waits_for_what_was_submitted"
DIES = "test_a_worker_that_dies_breaks_the_executor_and_hangs_nobody"


FAULTS = [
    (losing, ONCE),
    (losing, ORDER),
    (swallowing, ERRORS),
    (twice, ONCE),
    (retrying, "test_what_fails_is_not_tried_again"),
    (remembering, ONCE),
    (renaming, ERRORS),
    (traceless, ERRORS),
    (rounding, AS_THEY_ARE),
    (forgetting_keywords, AS_THEY_ARE),
    (calling_what_is_cancelled, CANCELLED),
    (telling_twice, "test_who_waits_is_told_once"),
    (Reordering, ORDER),
    (Hasty, WAITS),
    (Dropping, WAITS),
    (Endless, "test_nothing_can_be_submitted_after_the_end"),
    (Leaking, "test_it_can_be_opened_again_and_leaves_no_thread"),
    (Unforgiving, "test_an_error_of_the_caller_passes_and_abandons_what_is_running"),
    (Once, "test_it_can_be_opened_again_and_leaves_no_thread"),
    (ManyThreads, "test_linear_algebra_has_one_thread"),
]


@pytest.mark.parametrize(
    ("factory", "test"),
    FAULTS,
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_an_executor_that_is_bad_on_purpose_fails(factory, test):
    assert fails(ExecutorContract, factory, test, isolated=False, patience=0.5)


class Forked(Bad):
    """Python's own pool of processes: it names what cannot be sent, but a worker cannot be interrupted in peace, and
    an error that cannot be sent back ends all of them."""

    def workers(self):
        return ProcessPoolExecutor(1, mp_context=get_context("spawn"))


class Waiting(Bad):
    """Says nothing when a worker has died."""

    def workers(self):
        class Pool(ProcessPoolExecutor):
            def submit(self, fn, /, *args, **kwargs):
                future, done = Future(), super().submit(fn, *args, **kwargs)

                def pass_on(done):
                    if not isinstance(done.exception(), BrokenExecutor):
                        future.set_exception(done.exception()) if done.exception() else future.set_result(done.result())

                done.add_done_callback(pass_on)
                return future

        return Pool(1, mp_context=get_context("spawn"))


@pytest.mark.slow
def test_pools_of_processes_that_are_bad_on_purpose_fail():
    assert "Ctrl-C" in str(fails(ExecutorContract, Forked, "test_workers_leave_an_interrupt_to_the_caller"))
    odd = "test_an_error_that_cannot_be_sent_arrives_in_its_words"
    assert "arrived as" in str(fails(ExecutorContract, Forked, odd))
    assert "not done" in str(fails(ExecutorContract, Waiting, DIES, patience=5.0))
    abandoned = "test_an_error_of_the_caller_passes_and_abandons_what_is_running"
    assert "nobody waits for" in str(fails(ExecutorContract, Forked, abandoned, long=1.0))


SWEEP = """
import sys, time
import sparserob_core as sr
from sparserob_core.testing.executors import late, mark
with sr.load_registry().build("executor", "processes", {"workers": 2}).open() as executor:
    executor.submit(mark, sys.argv[1], "begun").result()
    futures = [executor.submit(late, k, 60.0) for k in range(4)]
    print("running", flush=True)
    [future.result() for future in futures]
"""  # a script without a guard around what it does


def started(script, folder):
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        cwd=ROOT, start_new_session=True,
    )  # fmt: skip
    assert process.stdout.readline() == "running\n", process.stderr.read()
    return process


def of_session(session):
    """Processes of a session that are still running."""
    listed = subprocess.run(
        ["ps", "-o", "pid=,stat=", "-s", str(session)], capture_output=True, text=True, check=False
    ).stdout
    return [line for line in listed.splitlines() if not line.split()[1].startswith("Z")]


@pytest.mark.skipif(sys.platform != "linux", reason="lists the processes of a session by ps")
@pytest.mark.parametrize("killed", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_workers_end_with_the_process_that_started_them_however_it_ends(tmp_path, killed):
    process = started(SWEEP, tmp_path)
    if killed == signal.SIGINT:
        os.killpg(process.pid, killed)  # as Ctrl-C in a terminal: to everybody
    else:
        process.send_signal(killed)
    _, said = process.communicate(timeout=20)
    ends = time.monotonic() + 20
    while (left := of_session(process.pid)) and time.monotonic() < ends:
        time.sleep(0.05)
    assert not left
    assert process.returncode != 0
    assert said.count("KeyboardInterrupt") <= 1, f"workers have answered the interrupt too: {said}"


@pytest.mark.slow
def test_a_script_without_a_guard_starts_its_work_once(tmp_path):
    (tmp_path / "study.py").write_text(
        "import sparserob_core as sr\nfrom sparserob_core.testing.executors import echo\n"
        "def mine():\n    return 1\n"
        "with sr.load_registry().build('executor', 'processes', {'workers': 2}).open() as executor:\n"
        "    print(list(executor.map(echo, range(3))))\n"
        "    print(executor.submit(mine).exception())\n"
    )
    done = subprocess.run(
        [sys.executable, str(tmp_path / "study.py")], capture_output=True, text=True, timeout=60, cwd=ROOT, check=True
    )
    lines = done.stdout.splitlines()
    assert lines[0] == "[0, 1, 2]"
    assert "mine" in lines[1]
    assert "belongs into a module" in lines[1]
    assert len(lines) == 2
