"""A dask cluster as an executor whose calls can be cancelled until they begin."""

from __future__ import annotations

import asyncio
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from contextlib import contextmanager
from importlib.util import find_spec
from pickle import PicklingError
from typing import Any, ParamSpec, TypeVar, final

import cloudpickle
import dask
from distributed import Client, KilledWorker, LocalCluster, Nanny, WorkerPlugin
from distributed.core import Status
from tornado.ioloop import IOLoop

import sparserob_core as sr

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

SILENT = 2.0  # seconds; ten times less, and every cluster that begins is told; ten times more, and it seems to hang
LOUD = 50  # logging.CRITICAL: what dask has to say about workers that are ended on purpose is not for users
SETTINGS = {
    "distributed.scheduler.allowed-failures": 0,  # whoever submits decides whether to try again
    "distributed.worker.multiprocessing-method": "spawn",
    "distributed.nanny.pre-spawn-environ": {},  # threads of linear algebra: `sparserob_core.one_thread`
}


@contextmanager
def started(workers: int | None, host: str, timeout: float) -> Iterator[Executor]:
    """Start a cluster on this machine, which ends with the context; yield its executor."""
    with _event_loop(timeout) as loop:
        count = workers or sr.processors()
        with (
            _telling(f"for its {count} workers on {host} to begin", timeout),
            dask.config.set(SETTINGS),
            sr.without_script(),
        ):
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                host=host,
                dashboard_address=f"{host}:0",
                worker_class=_Mortal,
                memory_limit=0,
                silence_logs=LOUD,
                loop=loop,
            )
        try:
            with _connected(cluster.scheduler_address, timeout, loop, breaks=True) as executor:
                yield executor
        finally:
            cluster.close(timeout=timeout)


@contextmanager
def connected(address: str, timeout: float) -> Iterator[Executor]:
    """Connect to the cluster whose scheduler listens at ``address``; yield its executor."""
    with _event_loop(timeout) as loop, _connected(address, timeout, loop, breaks=False) as executor:
        yield executor


@contextmanager
def _event_loop(timeout: float) -> Iterator[IOLoop]:
    """Run the event loop of dask in a thread of its own. The loop that dask would start by itself is given ten seconds,
    whatever is asked for, and then fails without a word."""
    ready: Future[tuple[IOLoop, asyncio.Event]] = Future()

    async def work() -> None:
        ended = asyncio.Event()
        if ready.set_running_or_notify_cancel():
            ready.set_result((IOLoop.current(), ended))
            await ended.wait()

    def run() -> None:
        try:
            asyncio.run(work())
        except BaseException as error:
            if ready.done():
                raise
            ready.set_exception(error)

    thread = threading.Thread(target=run, name="dask", daemon=True)
    thread.start()
    try:
        try:
            yield ready.result(timeout)[0]
        except TimeoutError:
            if ready.done():
                raise
            raise sr.InputError(
                f"executor dask: its event loop has not begun within {timeout:g} s; give it a longer timeout"
            ) from None
    finally:
        if not ready.cancel():
            loop, ended = ready.result()
            loop.add_callback(ended.set)
            thread.join(timeout)


@contextmanager
def _connected(address: str, timeout: float, loop: IOLoop, breaks: bool) -> Iterator[Executor]:
    """Connect to the scheduler at ``address`` through ``loop``; with ``breaks``, a worker that dies ends the
    executor."""
    try:
        with _telling(f"for the scheduler at {address} to answer", timeout):
            client = _Client(address, timeout=timeout, set_as_default=False, loop=loop)
    except (OSError, TimeoutError, ValueError) as error:
        raise sr.InputError(
            path="executor.address", expected="the address of a dask scheduler that answers", got=f"{address} ({error})"
        ) from error
    try:
        try:
            with _telling(f"for a worker at {address}: dask worker {address}", timeout):
                client.wait_for_workers(1, timeout=timeout)
        except TimeoutError:
            raise sr.InputError(
                f"executor dask: no worker at {address} within {timeout:g} s; start some with `dask worker {address}`"
            ) from None
        if breaks:
            client.register_plugin(_LeavesInterrupts())
        missing = "" if find_spec("bokeh") else " (it needs the package bokeh)"
        sys.stderr.write(f"dask dashboard: {client.dashboard_link}{missing}\n")
        executor = _Cluster(client, breaks)
        try:
            yield executor
        except BaseException:
            executor.abandon("the context was left by an exception")
            raise
        executor.shutdown()
    finally:
        client.close(timeout=timeout)


@contextmanager
def _telling(what: str, timeout: float) -> Iterator[None]:
    """Write to the standard error stream what is waited for, if waiting takes longer than `SILENT`."""
    timer = threading.Timer(SILENT, sys.stderr.write, [f"dask: waiting up to {timeout:g} s {what}\n"])
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@final
class _Cluster(Executor):
    """Executor that hands out one call for each thread of the workers; the other calls wait in this process."""

    def __init__(self, client: Client, breaks: bool) -> None:
        self._client, self._breaks = client, breaks
        self._waiting = deque[tuple[Future[Any], bytes]]()
        self._running: dict[Future[Any], Any] = {}
        self._changed = threading.Condition()
        self._broken, self._closed = "", False
        self._threads, self._asked = 1, -float("inf")
        self._count_threads()

    def submit(
        self, fn: Callable[Arguments, Answer], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Answer]:
        future: Future[Answer] = Future()
        with self._changed:
            if self._closed:
                raise RuntimeError("cannot schedule new futures after shutdown")
            if self._broken:
                raise BrokenExecutor(self._broken)
        try:
            call = cloudpickle.dumps((fn, args, kwargs))
        except Exception as error:  # noqa: BLE001  it is raised again where the result is asked for
            name = getattr(fn, "__qualname__", None) or repr(fn)
            future.set_exception(PicklingError(f"the call of {name} cannot be sent to a worker: {error}"))
            return future
        with self._changed:
            self._waiting.append((future, call))
        self._count_threads()
        self._send()
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        with self._changed:
            self._closed = True
            if cancel_futures:
                while self._waiting:
                    self._waiting.popleft()[0].cancel()
            while wait and (self._waiting or self._running):
                self._changed.wait(1.0)
                self._waiting = deque(entry for entry in self._waiting if not entry[0].cancelled())

    def abandon(self, why: str) -> None:
        """Cancel the calls that wait, and end those that have begun with a `BrokenExecutor`."""
        with self._changed:
            self._closed = True
            waiting, running = list(self._waiting), dict(self._running)
            self._waiting.clear()
            self._running.clear()
            self._changed.notify_all()
        for future, _ in waiting:
            future.cancel()
        for future, remote in running.items():
            remote.cancel()
            future.set_exception(BrokenExecutor(why))

    def _send(self) -> None:
        with self._changed:
            while self._waiting and len(self._running) < self._threads:
                future, call = self._waiting.popleft()
                if future.set_running_or_notify_cancel():
                    remote = self._client.submit(_called, call, pure=False)
                    self._running[future] = remote
                    self._client.loop.add_callback(self._follow, future, remote)
            self._changed.notify_all()

    async def _follow(self, future: Future[Any], there: Any) -> None:
        """Pass on an answer and send the next call, in the thread of dask's own loop."""
        answer: object = None
        failure: BaseException | None = None
        try:
            answer = cloudpickle.loads(await there)
        except KilledWorker:
            failure = BrokenExecutor("a worker has died")
        except BaseException as error:  # noqa: BLE001  it is raised again where the result is asked for
            failure = error
        with self._changed:
            is_running = self._running.pop(future, None) is not None
        if is_running and isinstance(failure, BrokenExecutor) and self._breaks:
            self._break(str(failure))
        if is_running and failure is None:
            future.set_result(answer)
        elif is_running:
            future.set_exception(failure)
        self._send()

    def _break(self, why: str) -> None:
        with self._changed:
            self._broken = why
            waiting = list(self._waiting)
            self._waiting.clear()
        for future, _ in waiting:
            if future.set_running_or_notify_cancel():
                future.set_exception(BrokenExecutor(why))

    def _count_threads(self) -> None:
        """Ask for the number of threads every ten seconds, as workers of a cluster come and go."""
        if time.monotonic() - self._asked > 10.0:
            self._asked = time.monotonic()
            self._threads = max(1, sum(self._client.nthreads().values()))


def _called(call: bytes) -> bytes:
    """Make a call on a worker and return the answer as bytes, so that an answer that cannot be sent is an error
    here."""
    fn, args, kwargs = cloudpickle.loads(call)
    answer = fn(*args, **kwargs)
    try:
        return bytes(cloudpickle.dumps(answer))
    except Exception as error:  # noqa: BLE001  whatever the class of the answer does
        name = getattr(fn, "__qualname__", None) or repr(fn)
        raise PicklingError(f"the answer of {name} cannot be sent between processes: {error}") from None


@final
class _Client(Client):  # type: ignore[misc]
    """Client that closes itself if it cannot begin.

    Dask leaves that to the collection of garbage, which comes in whatever thread it likes: in that of another loop that
    is just beginning, it waits for the lock that is held until this loop has begun.
    """

    def start(self, **options: Any) -> None:
        """Start as dask does; close the client where that fails."""
        try:
            super().start(**options)
        except BaseException:
            self.close()
            raise


@final
class _LeavesInterrupts(WorkerPlugin):  # type: ignore[misc]
    """Plugin by which workers leave Ctrl-C to the process that has started them."""

    name = "sparserob-leaves-interrupts"

    def setup(self, worker: Any) -> None:
        """Ignore Ctrl-C in the main thread of a worker."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@final
class _Mortal(Nanny):  # type: ignore[misc]
    """Supervisor that starts its worker once: another worker would begin with the script that is run here."""

    begun = False

    async def instantiate(self) -> Status:
        """Start the worker, unless there was one."""
        if self.begun:
            return Status.closed
        self.begun = True
        return await super().instantiate()
