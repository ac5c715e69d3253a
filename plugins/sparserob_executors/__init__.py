"""Where independent programs are solved: one after the other, in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

import sparserob_core as sr

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")


class Serial(sr.ExecutorFactory, sr.Options):
    """Every call is made when it is submitted, in order; what it raises is raised by ``Future.result``. An interrupt
    from the keyboard goes through at once."""

    @contextmanager
    def open(self) -> Iterator[Executor]:
        """See `sparserob_core.ExecutorFactory`."""
        with _Now() as executor:
            yield executor


class _Now(Executor):
    """An executor that does not wait."""

    def submit(
        self, fn: Callable[Arguments, Answer], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Answer]:
        future: Future[Answer] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001  it is raised again where the result is asked for
            future.set_exception(error)
        return future


@sr.hookimpl
def sparserob_executors() -> Iterator[sr.ExecutorPlugin]:
    """Offer ``serial``."""
    yield sr.ExecutorPlugin(name="serial", factory=Serial, summary="one after the other, in this process")
