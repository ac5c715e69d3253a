"""A search whose function is evaluated by somebody else: points are asked for, values are told.

The maximiser runs in a thread, and never at the same time as whoever asks: `AskTell.ask` waits until it wants values or
has ended, and it waits until they are told. So every maximiser can be asked, as it is.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self, TypeAlias, final

import numpy as np

from sparserob_core.arguments import is_whole
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import EvaluationError, Report, Trace

Search: TypeAlias = Callable[[Callable[[Array], Array]], Report]

FORMAT = 1
WORDS = {np.inf: "inf", -np.inf: "-inf"}
GRACE = 5.0  # seconds that a maximiser may take to end


class Closed(Exception):
    """Raised through a maximiser whose search nobody will ask again."""


@final
class _Other:
    """The side of the maximiser: what it wants, and what it is answered. It knows nothing of `AskTell`, so that one
    that is forgotten ends its thread."""

    def __init__(self, search: Search, told: Sequence[tuple[Array, float]]) -> None:
        self._search, self._told = search, list(told)
        self.wanted: SimpleQueue[tuple[Array, Array] | Report | BaseException] = SimpleQueue()
        self.answers: SimpleQueue[Array | None] = SimpleQueue()
        self.thread = threading.Thread(target=self._run, name="sparserob maximiser", daemon=True)

    def close(self) -> None:
        """End the thread, whatever it waits for."""
        self.answers.put(None)
        if self.thread.is_alive() and self.thread is not threading.current_thread():
            self.thread.join(GRACE)

    def _run(self) -> None:
        try:
            report = self._search(self._values)
            if self._told:
                raise InputError(f"state: the search has ended {len(self._told)} values before those that were told")
            self.wanted.put(report)
        except BaseException as error:  # noqa: BLE001  it is raised where somebody asks
            ours = isinstance(error, EvaluationError) and isinstance(error.__cause__, InputError)
            self.wanted.put(error.__cause__ or error if ours else error)

    def _values(self, points: Array) -> Array:
        known = self._told[: len(points)]
        del self._told[: len(points)]
        for asked, (told, _) in zip(points, known, strict=False):
            if asked.tolist() != told.tolist():
                raise InputError(
                    f"state: the search asks for {asked.tolist()} where {told.tolist()} was told; it is another "
                    "maximiser, another version, or one that is not repeatable"
                )
        values = np.array([value for _, value in known], dtype=float)
        if len(values) == len(points):
            return values
        self.wanted.put((points.copy(), values))
        answer = self.answers.get()
        if answer is None:
            raise Closed("the search was closed")
        return answer


@final
class AskTell:
    """A search by hand: ``points = search.ask()``, ``search.tell(points, values)``, until ``search.done``.

    ``ask`` gives the same points until they are told, in another process too: `state` is plain data, from which
    `sparserob_core.ask_tell` goes on. A search that is no longer wanted is closed with `close`, by leaving a ``with``
    block, or by being forgotten. Not to be shared between threads.
    """

    def __init__(self, domain: Box, search: Search, about: Mapping[str, Any], state: Mapping[str, Any] | None) -> None:
        self.domain, self._about = domain, dict(about)
        self._points: list[Array] = []
        self._values: list[float] = []
        self._seconds: list[float] = []
        self._started = time.monotonic()
        for point, value in [] if state is None else _told(state, self._about, domain):
            self._take(point, value)
        self._batch: Array | None = None
        self._answered: list[float] = []
        self._asked = 0
        self._end: Report | BaseException | None = None
        self._other = _Other(search, list(zip(self._points, self._values, strict=True)))
        self._other.thread.start()
        self._finalizer = weakref.finalize(self, self._other.close)

    @property
    def done(self) -> bool:
        """Whether the search has ended: nothing is left to ask for. Raises what the maximiser has raised."""
        return self._waiting() is None

    @property
    def evaluations(self) -> int:
        """Values told so far."""
        return len(self._values)

    @property
    def best_value(self) -> float:
        """The best value so far; ``-inf`` before the first one. NaN counts as ``-inf``."""
        return float(self._usable().max(initial=-np.inf))

    @property
    def best_point(self) -> Array:
        """The best point so far ``(d,)``; NaN before the first value."""
        return self._points[int(self._usable().argmax())].copy() if self._values else self.domain.lower * np.nan

    def ask(self, k: int | None = None) -> Array:
        """The points ``(j, d)`` whose values come next, ``k`` at most; ``(0, d)`` when the search has ended.

        There are fewer than ``k`` where the maximiser must know values before it goes on; most want one point at a
        time. Raises `InputError` for a ``k`` below 1, and what the maximiser has raised.
        """
        if k is not None and not is_whole(k, 1):
            raise InputError(f"ask: expected a number of points of at least 1, got {k!r}")
        waiting = self._waiting()
        if waiting is None:
            return np.empty((0, self.domain.dimension))
        self._asked = len(waiting) if k is None else min(int(k), len(waiting))
        return waiting[: self._asked].copy()

    def tell(self, points: Array, values: Array) -> None:
        """The values ``(j,)`` at the points ``(j, d)`` of the last `ask`, all of them and in their order; NaN and
        ``-inf`` where there is none.

        Raises `InputError` for other points, or when nothing was asked; nothing is taken then.
        """
        if not self._asked or self._batch is None:
            raise InputError("tell: nothing was asked since the last tell")
        try:
            given, told = np.array(points, dtype=float), np.array(values, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"tell: expected points and numbers, got {_short(points)} and {_short(values)}") from None
        wanted = self._batch[len(self._answered) :][: self._asked]
        if given.shape != wanted.shape or told.shape != (len(wanted),):
            raise InputError(
                f"tell: expected the {len(wanted)} points of the last ask, shape {wanted.shape}, and as many values, "
                f"got shapes {given.shape} and {told.shape}"
            )
        if not np.array_equal(given, wanted):
            row = int(np.argmax((given != wanted).any(axis=1)))
            raise InputError(
                f"tell: expected the points of the last ask in their order, got {given[row].tolist()} "
                f"where {wanted[row].tolist()} was asked"
            )
        for point, value in zip(wanted, told.tolist(), strict=True):
            self._take(point, value)
        self._answered += told.tolist()
        self._asked = 0
        if len(self._answered) == len(self._batch):
            answer, self._batch = np.array(self._answered), None
            self._other.answers.put(answer)

    def report(self) -> Report:
        """The report of the search; before its end, what is known by now. Raises what the maximiser has raised."""
        return self._end if self.done and isinstance(self._end, Report) else self._so_far("the search has not ended")

    def state(self) -> dict[str, Any]:
        """Everything told so far, as plain data that JSON can hold; what was asked and not told is asked again."""
        numbers = [WORDS.get(value, None if np.isnan(value) else value) for value in self._values]
        return {"format": FORMAT, **self._about, "points": [one.tolist() for one in self._points], "values": numbers}

    def close(self) -> None:
        """End the search, if it has not; what was told can still be read."""
        self._finalizer()
        if self._end is None:
            self._end = self._so_far("the search was closed")
        self._batch = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _waiting(self) -> Array | None:
        """The points of the batch that have no value yet; ``None`` when the search has ended."""
        if self._end is None and self._batch is None:
            said = self._other.wanted.get()
            if isinstance(said, tuple):
                self._batch, self._answered = said[0], said[1].tolist()
            else:
                self._end = said
        if isinstance(self._end, BaseException):
            raise self._end
        return None if self._batch is None else self._batch[len(self._answered) :]

    def _take(self, point: Array, value: float) -> None:
        self._points.append(np.array(point))
        self._values.append(value)
        self._seconds.append(time.monotonic() - self._started)

    def _so_far(self, stopped: str) -> Report:
        points = np.array(self._points).reshape(-1, self.domain.dimension)
        values = self._usable()
        trace = Trace(points, values, np.maximum.accumulate(values), np.array(self._seconds))
        return Report(self.best_value, self.best_point, self.evaluations, np.inf, trace, stopped)

    def _usable(self) -> Array:
        values = np.array(self._values, dtype=float)
        return np.where(np.isnan(values), -np.inf, values)


def _told(state: object, about: Mapping[str, Any], domain: Box) -> list[tuple[Array, float]]:
    """The points and values of a state; raises `InputError` where it is malformed, or of another search."""
    if not isinstance(state, Mapping) or state.get("format") != FORMAT:
        raise InputError(path="state", expected=f"what `state()` gave, format {FORMAT}", got=_short(state))
    for key, ours in about.items():
        if key not in state or state[key] != ours:
            raise InputError(path=f"state.{key}", expected=f"{_short(ours)}, as given", got=_short(state.get(key)))
    points, values = state.get("points"), state.get("values")
    if not isinstance(points, list) or not isinstance(values, list) or len(points) != len(values):
        raise InputError(path="state.points", expected="a list of points, and a value for each", got=_short(points))
    found = []
    for row, (point, value) in enumerate(zip(points, values, strict=True)):
        try:
            place = np.array(point, dtype=float)
            number = float("nan" if value is None else value)
        except (TypeError, ValueError):
            raise InputError(path=f"state.values.{row}", expected="a point and a number", got=_short(value)) from None
        if place.shape != domain.lower.shape or not ((place >= domain.lower) & (place <= domain.upper)).all():
            raise InputError(path=f"state.points.{row}", expected="a point of the domain", got=_short(point))
        found.append((place, number))
    return found


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
