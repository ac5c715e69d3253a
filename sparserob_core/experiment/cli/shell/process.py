"""The command as a process: its signals, its standard streams."""

from __future__ import annotations

import atexit
import codecs
import errno
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.util import LazyLoader, find_spec, module_from_spec
from types import FrameType
from typing import Any, final

from sparserob_core.errors import SparseRobError

INTERRUPTED = 130
"""The exit status of a command that was interrupted, whatever it knew by then."""

_caught_signals: list[int] = []
_masks = threading.local()


def listen() -> None:
    """Let Ctrl-C and SIGTERM raise `KeyboardInterrupt` from now on; its message names the signal, unless it is from the
    keyboard.

    A signal that is ignored, as Ctrl-C is in the background of a shell, stays ignored. SIGTERM ends a process that is
    forked from this one, as a pool of workers expects.
    """
    with suppress(ValueError):  # not in the main thread
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _handle_signal)
        if signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
            signal.signal(signal.SIGTERM, _handle_signal)
            if hasattr(os, "register_at_fork"):
                _fork_safely()


@cache
def _fork_safely() -> None:
    """A SIGTERM for a child waits until it has the default action again: Python forgets in a forked child the signals
    that came before its first instruction, and a pool whose worker has died waits for the others to end."""
    os.register_at_fork(before=_block_sigterm, after_in_parent=_restore_mask, after_in_child=_restore_mask_in_child)


def _block_sigterm() -> None:
    _masks.before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})


def _restore_mask() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _masks.before)


def _restore_mask_in_child() -> None:
    if signal.getsignal(signal.SIGTERM) is _handle_signal:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _restore_mask()


def spare_imports() -> None:
    """Make a start of what the command itself uses.

    Some modules of numpy are loaded only when something of them is used: scipy looks at every name that numpy has, and
    so imports, at every start, what builds Fortran extensions and what tests arrays. pydantic does not look through all
    distributions for plugins of its own, unless ``PYDANTIC_DISABLE_PLUGINS`` says which it is to leave out.
    """
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    import numpy as np

    for name in ("char", "f2py", "polynomial", "testing"):
        module_name = f"{np.__name__}.{name}"
        spec = None if module_name in sys.modules else find_spec(module_name)
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
            module = sys.modules[module_name] = module_from_spec(spec)
            spec.loader.exec_module(module)
            setattr(np, name, module)


def status_unless_interrupted(status: int) -> int:
    """The exit status of a command that has a result: its own, unless a signal has cut it short."""
    return INTERRUPTED if _caught_signals else status


class OutputError(SparseRobError):
    """The standard output takes nothing more: it is closed, or its disk is full."""


@final
class Output(io.TextIOWrapper):
    """The standard output; where it cannot be written to, it says so as an `OutputError`. A reader that has stopped
    reading is a `BrokenPipeError` as ever."""

    def write(self, text: str) -> int:
        with _convert_output_errors():
            return super().write(text)

    def flush(self) -> None:
        with _convert_output_errors():
            super().flush()


@contextmanager
def _convert_output_errors() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        why = "it is closed" if error.errno == errno.EBADF else str(error.strerror)
        raise OutputError(f"the standard output cannot be written: {why}") from error


def open_streams() -> None:
    """Give standard streams that are closed a descriptor, so that no file of a run gets theirs. What is written to a
    closed output is an error; messages to a closed error stream are lost.

    The command's output gets a descriptor of its own. That of the standard output is from now on the one of the error
    stream: there goes what compiled libraries print, and workers, who inherit it.
    """
    for descriptor, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, mode)
    if sys.stderr is None:
        sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    if sys.stdout is None:
        sys.stdout = Output(open(_redirect_to_error_stream(), "wb"))  # noqa: SIM115
    elif type(sys.stdout) is io.TextIOWrapper:
        sys.stdout = _rewrap_stream(sys.stdout, Output)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            _set_encoding(stream)


def _set_encoding(stream: io.TextIOWrapper) -> None:
    """Let a stream take every title and path. ASCII says nothing of the other bytes: there they are UTF-8, as they are
    in configs and nearly always in names of files, so that a path that was printed can be pasted. What another encoding
    has no letters for is written out: the bytes of UTF-8 may be control characters there."""
    narrow = codecs.lookup(stream.encoding).name == "ascii"
    stream.reconfigure(encoding="utf-8" if narrow else None, errors="backslashreplace")


def _redirect_to_error_stream() -> int:
    """Return a new descriptor of the present standard output, and redirect the standard output to the error stream."""
    descriptor = os.dup(1)
    os.dup2(2, 1)
    return descriptor


def hand_back_output() -> None:
    """Give the interpreter back a standard output of its own kind: it flushes that once more when the names of this
    module are gone (Python 3.13), so that an `Output` could no longer do so. What is printed at the end of the process
    goes to the error stream, for the command has said everything."""
    if not isinstance(sys.stdout, Output):
        return
    try:
        sys.stdout.flush()
    except (BrokenPipeError, OutputError):  # said before, or nobody reads
        drop_output()
    if _get_descriptor(sys.stdout) is None:
        sys.stdout = _rewrap_stream(sys.stdout, io.TextIOWrapper)
        return
    encoding = sys.stdout.encoding
    os.dup2(sys.stdout.fileno(), 1)
    sys.stdout.close()
    atexit.register(_close_output)  # called before whatever components have registered
    sys.stdout = open(1, "w", encoding=encoding, errors="backslashreplace", closefd=False)  # noqa: SIM115


def _close_output() -> None:
    with suppress(OSError, ValueError):  # nobody reads it any more, or it is closed
        sys.stdout.flush()
    os.dup2(2, 1)


def _rewrap_stream(stream: io.TextIOWrapper, kind: type[io.TextIOWrapper]) -> io.TextIOWrapper:
    """Return a text stream of the given kind that takes over the buffer of a stream.

    An `Output` over the standard output gets a descriptor of its own.
    """
    encoding, errors = stream.encoding, stream.errors
    line_buffering, write_through = stream.line_buffering, stream.write_through
    buffer = stream.detach()
    if stream is sys.__stdout__:  # a component that keeps to the first stream would meet one without a buffer
        sys.__stdout__ = sys.stderr  # type: ignore[misc, assignment]
    if kind is Output and _get_descriptor(buffer) == 1:
        buffer.flush()
        buffer = open(_redirect_to_error_stream(), "wb")  # noqa: SIM115
    return kind(buffer, encoding=encoding, errors=errors, line_buffering=line_buffering, write_through=write_through)


def drop_output() -> None:
    """Let what is still to be written to the standard output go nowhere."""
    descriptor = _get_descriptor(sys.stdout)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1 if descriptor is None else descriptor)


def _get_descriptor(stream: Any) -> int | None:
    try:
        return int(stream.fileno())
    except (OSError, ValueError):  # it has none
        return None


def _handle_signal(number: int, frame: FrameType | None) -> None:
    _caught_signals.append(number)
    raise KeyboardInterrupt(*([] if number == signal.SIGINT else [f"interrupted by {signal.Signals(number).name}"]))
