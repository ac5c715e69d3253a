"""A call that nothing interrupts, or that may end the process, made in a process of its own: a solver in compiled code
that keeps the interpreter for itself hears of no signal, and one that aborts takes everything with it."""

from __future__ import annotations

import faulthandler
import os
import pickle
import select
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn, TypeVar

from sparserob_core.errors import SolverError, named
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime

Value = TypeVar("Value")

# Bytes that are read at a time; of a tenth a large answer takes many calls, ten times more are no matter
PIPE_CHUNK_BYTES = 2**16
POSSIBLE = hasattr(os, "fork") and sys.platform != "darwin"  # libraries of Apple do not survive a fork


def call_apart(call: Callable[[], Value], deadline: Deadline) -> Value:
    """Return the result of ``call``, made in a forked copy of this process.

    The result must be picklable, and what the copy prints is lost.

    Parameters
    ----------
    call : callable
        Function without arguments.
    deadline : Deadline
        Time at which the copy is ended.

    Raises
    ------
    SolverError
        Where the copy has died.
    OutOfTime
        At the deadline, or another `KeyboardInterrupt` when that arrives: the copy is then ended.
    Exception
        Any exception that ``call`` raised.
    """
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, none of which the copy has or waits for
        process = os.fork()
    if not process:
        os.close(read)
        _write_answer(call, write)
    os.close(write)
    try:
        answer = _read_answer(read, deadline)
    finally:
        os.close(read)
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
        _, status = os.waitpid(process, 0)
    if not answer:
        ended = f" by {signal.Signals(os.WTERMSIG(status)).name}" if os.WIFSIGNALED(status) else ""
        raise SolverError(f"its process was ended{ended}")
    value, error = pickle.loads(answer)  # noqa: S301  of this process itself
    if error is not None:
        raise error
    return value  # type: ignore[no-any-return]


def _write_answer(call: Callable[[], object], write: int) -> NoReturn:
    """Make the call in the copy, write the answer, and end."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever pressed a key is heard by the process itself
        faulthandler.disable()
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        try:
            answer = pickle.dumps((call(), None))
        except BaseException as error:  # noqa: BLE001  it is raised there
            try:
                answer = pickle.dumps((None, error))
                pickle.loads(answer)  # noqa: S301  of this process itself
            except Exception:  # noqa: BLE001  as it may be for any class of errors
                answer = pickle.dumps((None, SolverError(named(error))))
        while answer:
            answer = answer[os.write(write, answer) :]
    finally:
        os._exit(0)


def _read_answer(read: int, deadline: Deadline) -> bytes:
    """All that comes out of a pipe; raises `OutOfTime` at the deadline."""
    answer = b""
    while True:
        if not select.select([read], [], [], deadline.left)[0]:
            raise OutOfTime(deadline.reason)
        chunk = os.read(read, PIPE_CHUNK_BYTES)
        if not chunk:
            return answer
        answer += chunk
