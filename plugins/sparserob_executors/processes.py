"""A pool of processes that end with their parent, name what cannot be sent, and leave Ctrl-C to it."""

from __future__ import annotations

import os
import pickle
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import connection, parent_process
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.reduction import ForkingPickler
from types import TracebackType
from typing import Any, ParamSpec, TypeVar, cast, final

import sparserob_core as sr

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

_starting = threading.Lock()


@final
class Pool(ProcessPoolExecutor):
    """Pool of worker processes; leaving the context by an exception abandons the calls that are running."""

    def __init__(self, workers: int) -> None:
        self._context = _Context()
        super().__init__(workers, mp_context=self._context, initializer=_begin)

    def submit(
        self, fn: Callable[Arguments, Answer], /, *args: Arguments.args, **kwargs: Arguments.kwargs
    ) -> Future[Answer]:
        """Send a call to a worker; a call that cannot be sent becomes a `pickle.PicklingError` of the future, with its
        name."""
        try:
            call = bytes(ForkingPickler.dumps((fn, args, kwargs)))
        except Exception as error:  # noqa: BLE001  it is raised again where the result is asked for
            future: Future[Answer] = Future()
            future.set_exception(_unsent(f"the call of {_name(fn)}", error))
            return future
        return cast("Future[Answer]", super().submit(_called, call))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            for worker in self._context.workers:
                worker.kill()
        self.shutdown(wait=True, cancel_futures=kind is not None)


def _called(call: bytes) -> object:
    """Make a call in a worker; a result or an error that cannot be sent back becomes an error that can."""
    try:
        fn, args, kwargs = pickle.loads(call)  # noqa: S301  the parent's own call
    except Exception as error:  # noqa: BLE001  whatever the class of an argument does
        raise _unsent("a call", error) from None
    try:
        answer = fn(*args, **kwargs)
    except Exception as error:
        if not _returns(error):
            raise RuntimeError("".join(traceback.format_exception(error)).rstrip()) from None
        raise
    try:
        ForkingPickler.dumps(answer)
    except Exception as error:  # noqa: BLE001  whatever the class of the answer does
        raise _unsent(f"the answer of {_name(fn)}", error) from None
    return answer


def _returns(error: Exception) -> bool:
    try:
        return isinstance(pickle.loads(ForkingPickler.dumps(error)), type(error))  # noqa: S301  our own
    except Exception:  # noqa: BLE001  whatever the error's class does
        return False


def _unsent(what: str, error: Exception) -> pickle.PicklingError:
    hint = ""
    if "__main__" in str(error):
        hint = "; workers do not run again the script that is run here: what they call belongs into a module"
    return pickle.PicklingError(f"{what} cannot be sent between processes: {error}{hint}")


def _name(fn: Callable[..., object]) -> str:
    return getattr(fn, "__qualname__", None) or repr(fn)


def _begin() -> None:
    """Leave Ctrl-C to the parent, and end when the parent has ended; called in a worker before its first call."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = parent_process()
    assert parent is not None

    def end_with_it() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)  # a parent that is gone reads no result, and nobody would ever stop this process

    threading.Thread(target=end_with_it, daemon=True).start()


@final
class _Worker(SpawnProcess):
    """A process that starts with one thread of linear algebra, without Ctrl-C, and without the parent's script."""

    def start(self) -> None:
        with _starting, sr.one_thread(), sr.without_script(), _without_interrupt():
            super().start()

    def __reduce__(self) -> Any:
        return _plain, (), self.__dict__


def _plain() -> SpawnProcess:
    return SpawnProcess.__new__(SpawnProcess)


@final
class _Context(SpawnContext):
    """Context that keeps the workers that it has started."""

    def __init__(self) -> None:
        self.workers: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]
        worker = _Worker(*args, **kwargs)
        self.workers.append(worker)
        return worker


@contextmanager
def _without_interrupt() -> Iterator[None]:
    """Block Ctrl-C in a process that is started meanwhile; one that arrives here meanwhile is taken afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
