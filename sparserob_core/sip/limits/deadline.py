"""The time that a computation may take: asked for between steps, and enforced within those that take long."""

from __future__ import annotations

import ctypes
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import copy
from types import FrameType
from typing import TypeVar, final

import numpy as np

from sparserob_core.errors import InputError, SparseRobError

LIMIT_GRACE_SECONDS = 0.25
"""Seconds after a limit in which a method may end by itself. Ten times as many, and a limit is missed by more than two
seconds; a tenth, and steps that would end within them are lost."""
LAST_STEP_SECONDS = 0.4
"""Seconds that each step after the limit has, of those that say what is known: the proof of the last decision, its
bound, the worst cases. Ten times as many, and a limit is missed by more than two seconds; a tenth, and nothing is
proven of a decision that a single look would prove."""

Value = TypeVar("Value")


class OutOfTime(KeyboardInterrupt):
    """The limit is reached. It travels like the interrupt from the keyboard that it stands for: whatever lets the one
    pass (a foreign maximiser, a solver) lets the other."""


class Deadline:
    """The end of the time that a computation may take, ``seconds`` from now; without a number it has no end.

    Whoever works in rounds asks `check` between them. An interrupt that was caught where something could be saved is
    noted by `interrupt`: from then on the time is over for everyone who asks.
    """

    def __init__(self, seconds: float | None = None) -> None:
        self.seconds = seconds
        self._end_time = np.inf if seconds is None else time.monotonic() + seconds
        self._interruption = ""
        self.pressed = False
        """Whether somebody has interrupted the computation, by a key or a signal, before the end of the time."""

    @property
    def bounded(self) -> bool:
        """True where there is a limit of time."""
        return self.seconds is not None

    @property
    def reason(self) -> str:
        """Reason why the time is over, in words; empty while it is not over."""
        if self._interruption:
            return self._interruption
        return f"the limit of {self.seconds:g} s is reached" if time.monotonic() >= self._end_time else ""

    @property
    def left(self) -> float | None:
        """The seconds that are left, a millisecond at least; none without a limit."""
        return None if self.seconds is None else max(1e-3, self._end_time - time.monotonic())

    def at_most(self, seconds: float) -> float:
        """Return ``seconds``, or the seconds that are left where these are fewer."""
        return seconds if self.left is None else min(seconds, self.left)

    @property
    def used(self) -> float:
        """The share of the time that is over, 1 at most; 0 where there is no limit."""
        remaining = self._end_time - time.monotonic()
        return 0.0 if self.seconds is None else 1.0 - max(0.0, remaining) / self.seconds if self.seconds > 0.0 else 1.0

    @property
    def passed(self) -> bool:
        """True where the time is over, by the limit or by an interrupt."""
        return bool(self._interruption) or time.monotonic() >= self._end_time

    def sooner(self, seconds: float) -> Deadline:
        """Return a copy of the deadline that ends ``seconds`` earlier, for a step that leaves time for others before
        the limit."""
        earlier = copy(self)
        earlier._end_time -= seconds
        return earlier

    def check(self) -> None:
        """Raise `OutOfTime` when the time is over."""
        if self.passed:
            raise OutOfTime(self.reason)

    @contextmanager
    def enforced(self) -> Iterator[None]:
        """Raise `OutOfTime` where nobody asks, as a single step may take long: `LIMIT_GRACE_SECONDS` after the end of
        the time, or, where the time is over, `LAST_STEP_SECONDS` from now; and every `LAST_STEP_SECONDS` seconds again,
        where somebody went on.

        Within one another the innermost counts. What runs in compiled code is interrupted when it comes back: solvers
        have limits of their own for that.
        """
        if not self.bounded:
            yield
            return
        due = max(self._end_time + LIMIT_GRACE_SECONDS, time.monotonic() + LAST_STEP_SECONDS)
        bell = _bells.get(threading.get_ident())
        if bell is None:
            with _hang_bell(due, self) as bell:
                yield
            return
        before = bell.due, bell.deadline
        bell.ring_at(due, self)
        try:
            yield
        finally:
            bell.ring_at(max(before[0], time.monotonic() + LAST_STEP_SECONDS), before[1])

    def attempt(self, step: Callable[[], Value], otherwise: Callable[[], Value]) -> Value:
        """Return the result of ``step``, or that of ``otherwise`` where the time is over before ``step`` ends."""
        try:
            with self.enforced():
                return step()
        except OutOfTime:
            return otherwise()

    def interrupt(self, error: KeyboardInterrupt) -> str:
        """Take note of an interrupt, and return why the time is over: in the words of the error where it has some."""
        self.pressed |= not isinstance(error, OutOfTime)
        self._interruption = self.reason or str(error) or "interrupted from the keyboard"
        return self._interruption


class _Bell(ABC):
    """Raises `OutOfTime` in one thread when it is ``due``, and every `LAST_STEP_SECONDS` seconds again."""

    due: float
    deadline: Deadline
    rung = False

    def ring_at(self, due: float, deadline: Deadline) -> None:
        """Ring at this moment of the machine's clock, for this deadline."""
        self.due, self.deadline = due, deadline
        self._set_timer()

    def error(self) -> OutOfTime:
        """Return the exception to raise, with the reason of the deadline."""
        return OutOfTime(self.deadline.reason or "the time is over")

    @abstractmethod
    def _set_timer(self) -> None: ...

    @abstractmethod
    def take_down(self) -> None:
        """Ring no more, nor raise what has not been raised yet."""


@final
class _AlarmBell(_Bell):
    """Bell that uses the alarm signal of the operating system, which also interrupts calls that wait."""

    def __init__(self) -> None:
        signal.signal(signal.SIGALRM, self._ring)

    def _ring(self, number: int, frame: FrameType | None) -> None:
        self.rung = True
        raise self.error()

    def _set_timer(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, max(1e-3, self.due - time.monotonic()), LAST_STEP_SECONDS)

    def take_down(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)


@final
class _ThreadBell(_Bell):
    """Bell that another thread rings through the interpreter, for threads and systems without an alarm."""

    def __init__(self) -> None:
        self._thread, self._condition, self._has_ended = threading.get_ident(), threading.Condition(), False
        self.due = np.inf
        threading.Thread(target=self._watch, name="deadline", daemon=True).start()

    def _watch(self) -> None:
        with self._condition:
            while not self._has_ended:
                remaining = self.due - time.monotonic()
                if remaining <= 0.0:
                    self.rung, self.due = True, time.monotonic() + LAST_STEP_SECONDS
                    self._raise(OutOfTime)
                self._condition.wait(min(max(remaining, 0.0), threading.TIMEOUT_MAX))

    def _raise(self, error: type[OutOfTime]) -> None:
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(self._thread), ctypes.py_object(error))

    def _set_timer(self) -> None:
        with self._condition:
            self._condition.notify()

    def take_down(self) -> None:
        with self._condition:
            self._has_ended = True
            self._condition.notify()
        if self.rung:
            self._wait_for_last_ring()

    def _wait_for_last_ring(self) -> None:
        """Let what was set and is not raised yet be raised here, or another in its place. It could be withdrawn, but
        the interpreter (3.11) would look for it ever after, at every call, and be slow."""
        with suppress(OutOfTime):
            self._raise(OutOfTime)
            while True:
                time.sleep(0)


_bells: dict[int, _Bell] = {}
"""The bell of every thread in which a deadline is enforced."""


@contextmanager
def _hang_bell(due: float, deadline: Deadline) -> Iterator[_Bell]:
    """A bell for this thread: the alarm where it has one that nobody else uses."""
    alarm = getattr(signal, "SIGALRM", None)
    main = threading.current_thread() is threading.main_thread()
    bell = _AlarmBell() if alarm is not None and main and signal.getsignal(alarm) is signal.SIG_DFL else _ThreadBell()
    _bells[threading.get_ident()] = bell
    try:
        bell.ring_at(due, deadline)
        yield bell
    except SparseRobError:
        raise
    except (Exception, OutOfTime) as fault:
        # A library in which the bell rang may tell of an error of its own instead: numpy, which asks Python code how
        # two records compare, says that they cannot be compared. The interpreter raises it without its words.
        if bell.rung:
            raise bell.error() from fault
        raise
    finally:
        while threading.get_ident() in _bells:
            with suppress(OutOfTime):  # it may ring for the last time just now
                bell.take_down()
                del _bells[threading.get_ident()]


def as_seconds(seconds: object) -> float | None:
    """A limit as a user gives it: a positive number of seconds, or ``None`` for no limit; raises `InputError`."""
    if seconds is None:
        return None
    if (
        isinstance(seconds, bool)
        or not isinstance(seconds, int | float | np.integer | np.floating)
        or not 0.0 < seconds < np.inf
    ):
        raise InputError(f"seconds: expected a positive number of seconds, or None for no limit, got {seconds!r}")
    return float(seconds)
