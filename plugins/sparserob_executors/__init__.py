"""Executors: calls are made one after the other in this process, or in processes of this machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from pydantic import Field

import sparserob_core as sr

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


class Serial(sr.ExecutorFactory, sr.Options):
    """Executor that makes every call when it is submitted, in order; what a call raises is raised by ``Future.result``.
    An interrupt from the keyboard goes through at once. Linear algebra has one thread until the executor is closed, as
    it has in the workers of other executors: sums are then added up in the same order everywhere."""

    @property
    def parallel(self) -> bool:
        """Always false: no two calls run at the same time."""
        return False

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """Return a context that yields the executor; see `sparserob_core.ExecutorFactory`."""
        with sr.one_thread(), _Now() as executor:
            yield executor


class Processes(sr.ExecutorFactory, sr.Options):
    """Processes of this machine, each with one thread of linear algebra, as this one has meanwhile.

    A worker is a fresh Python (``spawn``): what is submitted is sent there, so it must be possible to pickle it, and
    the script that is run here does not run there again; functions belong into a module, or into a file that the config
    names under ``plugins``. Workers leave Ctrl-C to this process; they end with it, however it ends. A worker that dies
    ends its fellows: everything unfinished is then a ``BrokenExecutor``. Leaving the context by an exception, as at an
    interrupt, abandons what is running.
    """

    workers: int | None = Field(default=None, ge=1)
    """How many processes; none: one for each processor that this process may use."""

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """Return a context that yields the pool; see `sparserob_core.ExecutorFactory`."""
        from sparserob_executors.processes import Pool

        with sr.one_thread(), Pool(self.workers or sr.processors()) as executor:
            yield executor


class _Now(Executor):
    """An executor that does not wait."""

    _closed = False

    def submit(
        self, fn: Callable[Arguments, Answer], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Answer]:
        if self._closed:
            raise RuntimeError("cannot schedule new futures after shutdown")
        future: Future[Answer] = Future()
        future.set_running_or_notify_cancel()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  it is raised again where the result is asked for
            future.set_exception(error)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._closed = True


@sr.hookimpl
def sparserob_executors() -> Iterator[sr.ExecutorPlugin]:
    """Offer ``serial`` and ``processes``."""
    yield sr.ExecutorPlugin(name="serial", factory=Serial, summary="one after the other, in this process")
    yield sr.ExecutorPlugin(name="processes", factory=Processes, summary="processes of this machine, side by side")
