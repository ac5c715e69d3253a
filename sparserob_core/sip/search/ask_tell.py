"""A search whose function is evaluated by the caller: ``ask`` returns points, and ``tell`` receives their values.

The maximiser runs in a thread, and never at the same time as the caller. `AskTell.ask` waits until the maximiser needs
values or has ended; the maximiser waits until it receives them. So every maximiser can be used without a change. A
thread cannot be stored in a file. But a search is repeatable, so only the received values are stored: another thread
that receives the same values comes to the same point.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from queue import SimpleQueue
from types import TracebackType
from typing import Any, Self, TypeAlias, final

import numpy as np

from sparserob_core.arguments import is_whole
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import EvaluationError, Report, Trace
from sparserob_core.sip.search.ranges import Ranges

Search: TypeAlias = Callable[[Callable[[Array], Array]], Report]
Key: TypeAlias = tuple[float, ...]

FORMAT = 1  # the version of `state`, by which older ones are read
WORDS = {np.inf: "inf", -np.inf: "-inf"}
# Seconds that a maximiser may take to end; in many coordinates one of its steps may take a tenth or more
SEARCH_GRACE_SECONDS = 5.0
LATER = {  # keys that older states lack, with their defaults
    "minimise": False,
    "integer": [],
    "logarithmic": [],
    "target": None,
    "patience": None,
    "known": None,
}


class Closed(Exception):
    """Exception that ends a maximiser whose search was closed."""


@final
class _SearchThread:
    """The maximiser's side of a search: a thread, the points that it needs, and the answers.

    The object holds no reference to `AskTell`, so that the thread ends when an `AskTell` is garbage collected.
    """

    def __init__(self, search: Search) -> None:
        self._search = search
        self.wanted: SimpleQueue[Array | Report | BaseException] = SimpleQueue()
        self.answers: SimpleQueue[Array | None] = SimpleQueue()
        self.thread = threading.Thread(target=self._run, name="sparserob maximiser", daemon=True)
        self.thread.start()

    def close(self) -> None:
        """End the thread, whatever it waits for."""
        self.answers.put(None)
        if self.thread.is_alive() and self.thread is not threading.current_thread():
            self.thread.join(SEARCH_GRACE_SECONDS)

    def _run(self) -> None:
        try:
            self.wanted.put(self._search(self._values))
        except BaseException as error:  # noqa: BLE001  `ask` raises it in the caller's thread
            ours = isinstance(error, EvaluationError) and isinstance(error.__cause__, InputError)
            self.wanted.put(error.__cause__ or error if ours else error)

    def _values(self, points: Array) -> Array:
        self.wanted.put(points.copy())
        answer = self.answers.get()
        if answer is None:
            raise Closed("the search was closed")
        return answer


@final
class _UnusedValues:
    """Values that were received and not yet used, by their points.

    Values are used once, in the order of their arrival, so that a point that the search needs twice is evaluated twice.
    With ``repeats``, a value answers as often as its point is needed.
    """

    def __init__(self, repeats: bool) -> None:
        self._repeats = repeats
        self._numbers: dict[Key, deque[int]] = {}
        self._last: dict[Key, int] = {}
        self.unused: dict[int, None] = {}  # numbers of values, in the order of their arrival

    def add(self, key: Key, number: int) -> None:
        """Add a value by its number."""
        self._numbers.setdefault(key, deque()).append(number)
        self.unused[number] = None

    def use(self, key: Key) -> int | None:
        """Return the number of a value at a point, and mark it as used; ``None`` where there is none."""
        waiting = self._numbers.get(key)
        if waiting:
            self._last[key] = waiting.popleft()
            self.unused.pop(self._last[key], None)
            return self._last[key]
        return self._last.get(key) if self._repeats else None


@final
class AskTell:
    """A search by hand: ``points = search.ask()``, ``search.tell(points, values)``, until ``search.done``.

    ``ask`` returns the same points until their values are received. A search continues in another process too: `state`
    is plain data from which `sparserob_core.ask_tell` continues, also with a larger budget. A pickled search continues
    likewise. For several workers, ``ask(1, fresh=True)`` returns a point that nobody else has received. Values are
    accepted in any order, and in part. `close`, the end of a ``with`` block, or garbage collection ends a search. The
    methods may be called from several threads.
    """

    def __init__(
        self,
        ranges: Ranges,
        search: Search,
        about: Mapping[str, Any],
        state: Mapping[str, Any] | None,
        again: Callable[..., AskTell],
    ) -> None:
        self.domain, self._ranges, self._about, self._factory = ranges.domain, ranges, dict(about), again
        self._sign = -1.0 if self._about["minimise"] else 1.0
        self._search, self._lock = search, threading.RLock()
        self._points: list[Array] = []
        self._values: list[float] = []
        self._seconds: list[float] = []
        self._started = time.monotonic()
        self._unused_values = _UnusedValues(repeats=bool(ranges.integer))
        evaluations, self._owed_numbers = ([], []) if state is None else _parse_state(state, self._about, self.domain)
        for point, value in evaluations:
            self._record(point, value)
        self._batch: list[Key] | None = None  # points for which the search waits
        self._answers: list[float | None] = []  # their values, as far as they are known
        self._predictions: list[Key] = []  # points given to idle workers before the search needs them
        self._open_points: Counter[Key] = Counter()  # points given out, without a value yet
        if state is not None:
            out, ahead = _parse_open_points(state, self.domain)
            self._open_points.update(out)
            self._predictions += ahead
        self._end: Report | BaseException | None = None
        self._thread = _SearchThread(search)
        self._finalizer = weakref.finalize(self, self._thread.close)

    def __repr__(self) -> str:
        """Return the progress of the search, without a call of the maximiser."""
        best = f"{'least' if self._about['minimise'] else 'best'} value {self.best_value:.9g}"
        return f"AskTell: {self.evaluations} of {self._about['budget']} evaluations, {best}"

    @property
    def done(self) -> bool:
        """True where the search has ended, and no point is left to ask for; an error of the maximiser is raised
        here."""
        with self._lock:
            return self._list_waiting() is None

    @property
    def evaluations(self) -> int:
        """Number of values received so far."""
        return len(self._values)

    @property
    def best_value(self) -> float:
        """Best value so far, with ``minimise`` the least; ``-inf`` (``inf``) before the first value. NaN is never the
        best."""
        return self._sign * float(self._convert_values().max(initial=-np.inf))

    @property
    def best_point(self) -> Array:
        """Best point so far ``(d,)``; NaN before the first value."""
        return self._points[int(self._convert_values().argmax())].copy() if self._values else self.domain.lower * np.nan

    def ask(self, k: int | None = None, fresh: bool = False) -> Array:
        """Return the points whose values the search needs next.

        There are fewer than ``k`` points where the maximiser needs values before it continues. Most maximisers need one
        at a time.

        Parameters
        ----------
        k : int, optional
            Largest number of points; by default all, and 1 with ``fresh``.
        fresh : bool, default False
            Return only points that nobody has received, for several workers. Where the search has none left, points are
            predicted. Predicted points are those that the search would need next if all open points had the worst value
            so far (the constant liar of Ginsbourger, Le Riche and Carraro 2010). Their values are not counted in the
            budget where the search does not ask for them.

        Returns
        -------
        ndarray, shape (j, d)
            The points; ``(0, d)`` when the search has ended.

        Raises
        ------
        InputError
            For a ``k`` below 1. An error of the maximiser is raised here too.
        """
        if k is not None and not is_whole(k, 1):
            raise InputError(f"ask: expected a number of points of at least 1, got {k!r}")
        with self._lock:
            waiting = self._list_waiting()
            if waiting is None:
                return np.empty((0, self.domain.dimension))
            if fresh:
                keys = self._choose_points(waiting, 1 if k is None else int(k))
            else:
                keys = waiting if k is None else waiting[: int(k)]
                self._open_points |= Counter(keys)
            return np.array(keys, dtype=float).reshape(-1, self.domain.dimension)

    def tell(self, points: Array, values: Array) -> None:
        """Receive values at points that were asked for, in any order, all of them or some.

        Parameters
        ----------
        points : array_like, shape (j, d) or (d,)
            Points that `ask` returned.
        values : array_like, shape (j,), or a number for a single point
            Their values; NaN or ``-inf`` where there is none.

        Raises
        ------
        InputError
            For points that were not asked for, or that have a value already; then no value is accepted.
        """
        try:
            point_array, value_array = (
                np.atleast_2d(np.array(points, dtype=float)),
                np.atleast_1d(np.array(values, dtype=float)),
            )
        except (TypeError, ValueError):
            raise InputError(
                f"tell: expected points and numbers, got {_shorten(points)} and {_shorten(values)}"
            ) from None
        if (
            point_array.ndim != 2
            or point_array.shape[1] != self.domain.dimension
            or value_array.shape != (len(point_array),)
        ):
            raise InputError(
                f"tell: expected points of shape (j, {self.domain.dimension}), and as many values, "
                f"got shapes {point_array.shape} and {value_array.shape}"
            )
        keys = _make_keys(point_array)
        with self._lock:
            if self._owed_numbers:  # values of a state, for which the search first asks again
                self._list_waiting()
            for key, count in Counter(keys).items():
                if count > self._open_points[key]:
                    raise InputError(
                        f"tell: expected points that were asked for and have no value yet, got {list(key)}"
                    )
            for key, value in zip(keys, value_array.tolist(), strict=True):
                self._open_points -= Counter((key,))
                if key in self._predictions:
                    self._predictions.remove(key)
                self._record(np.array(key), value)
            self._send_answers()

    def report(self) -> Report:
        """Return the report of the search, or before its end the results so far.

        With ``minimise``, values are those that were received, and the best is the least. An error of the maximiser is
        raised here.
        """
        return self._end if self.done and isinstance(self._end, Report) else self._report("the search has not ended")

    def state(self) -> dict[str, Any]:
        """Return everything that the search needs to continue, as plain data that JSON can hold.

        Returns
        -------
        dict
            Points, values and the arguments of the search, and where there are any: ``aside``, the numbers of the
            values that the search itself has not asked for; ``out``, the points that were given out and have no value
            yet; ``ahead``, the numbers of those of them that the search does not wait for.

        Notes
        -----
        Another process may deliver the values of ``out``. There, `ask` returns those points again for which the search
        waits; ``ask(fresh=True)`` returns none of them. Where their values will never arrive, empty lists release them.
        """
        with self._lock:
            numbers = [WORDS.get(value, None if np.isnan(value) else value) for value in self._values]
            rows = {"points": [point.tolist() for point in self._points], "values": numbers}
            owed = set(self._owed_numbers)
            aside = [number for number in self._unused_values.unused if number not in owed]
            out, waited = list(self._open_points.elements()), Counter(self._predictions)
            ahead = []
            for number, key in enumerate(out):
                if waited[key]:
                    waited[key] -= 1
                    ahead.append(number)
            extras = {"aside": aside, "out": [list(key) for key in out], "ahead": ahead}
            return {"format": FORMAT, **self._about, **rows, **{name: row for name, row in extras.items() if row}}

    def close(self) -> None:
        """End the search, if it has not ended; its values can still be read."""
        self._finalizer()
        with self._lock:
            if self._end is None:
                self._end = self._report("the search was closed")
            self._batch = None

    def __reduce__(self) -> tuple[Callable[..., AskTell], tuple[object, ...]]:
        closed = not self._finalizer.alive and isinstance(self._end, Report)
        return _unpickle, (self._factory, self.state(), closed)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _list_waiting(self) -> list[Key] | None:
        """Return the points of the batch that have no value yet; ``None`` when the search has ended."""
        while self._end is None and self._batch is None:
            wanted = self._thread.wanted.get()
            if isinstance(wanted, np.ndarray):
                self._batch = _make_keys(self._ranges.shown(wanted))
                self._answers = [None] * len(self._batch)
            else:
                self._end = self._convert_report(wanted) if isinstance(wanted, Report) else wanted
            self._send_answers()
        if isinstance(self._end, BaseException):
            raise self._end
        if self._batch is None:
            return None
        waiting = [key for key, value in zip(self._batch, self._answers, strict=True) if value is None]
        return list(dict.fromkeys(waiting)) if self._ranges.integer else waiting

    def _send_answers(self) -> None:
        """Send the search the values for which it waits, where all of them are known."""
        for row, key in enumerate(self._batch or ()):
            if self._answers[row] is None and (number := self._unused_values.use(key)) is not None:
                self._answers[row] = self._sign * self._values[number]
        missing = [key for key, value in zip(self._batch or (), self._answers, strict=False) if value is None]
        if missing or self._batch is None:
            self._check_owed(missing)
        if self._batch is not None and not missing:
            values, self._batch = np.array(self._answers, dtype=float), None
            self._thread.answers.put(values)

    def _check_owed(self, missing: list[Key]) -> None:
        """Refuse a state whose values belong to points that the search does not ask for now."""
        owed = [number for number in self._owed_numbers if number in self._unused_values.unused]
        self._owed_numbers = []
        if not owed or isinstance(self._end, BaseException):
            return
        if missing:
            reason = f"the search asks for {list(missing[0])} where {self._points[owed[0]].tolist()} was told; "
        else:
            reason = f"the search has ended {len(owed)} values before those that were told; "
        self._end = InputError(
            f"state: {reason}it is another maximiser, another version, or one that is not repeatable"
        )

    def _choose_points(self, waiting: list[Key], k: int) -> list[Key]:
        """Return at most ``k`` points that nobody has received: first those the search waits for, then predicted
        ones."""
        out = Counter(self._open_points)
        keys: list[Key] = []
        for key in waiting:
            if out[key]:
                out[key] -= 1
            elif len(keys) < k:
                keys.append(key)
        self._open_points += Counter(keys)
        while len(keys) < k and (predictions := self._predict_points(waiting)[: k - len(keys)]):
            keys += predictions
            self._predictions += predictions
            self._open_points += Counter(predictions)
        return keys

    def _predict_points(self, waiting: list[Key]) -> list[Key]:
        """Return the points that another search needs next, which receives all values and the worst value for every
        open point."""
        usable = self._convert_values()
        worst = float(usable[np.isfinite(usable)].min(initial=np.inf))
        lie = worst if np.isfinite(worst) else -np.inf
        known_values, out = _UnusedValues(repeats=bool(self._ranges.integer)), {*waiting, *self._predictions}
        for number, point in enumerate(self._points):
            known_values.add(_make_keys(point[np.newaxis])[0], number)
        with _open_search(self._search) as other_search:
            while isinstance(wanted := other_search.wanted.get(), np.ndarray):
                keys = _make_keys(self._ranges.shown(wanted))
                numbers = [known_values.use(key) for key in keys]
                missing_keys = [
                    key for key, number in zip(keys, numbers, strict=True) if number is None and key not in out
                ]
                if missing_keys:
                    return list(dict.fromkeys(missing_keys))
                other_search.answers.put(
                    np.array([lie if number is None else self._sign * self._values[number] for number in numbers])
                )
        return []

    def _record(self, point: Array, value: float) -> None:
        self._unused_values.add(_make_keys(point[np.newaxis])[0], len(self._values))
        self._points.append(np.array(point))
        self._values.append(value)
        self._seconds.append(time.monotonic() - self._started)

    def _report(self, stopped: str) -> Report:
        points = np.array(self._points).reshape(-1, self.domain.dimension)
        values = self._convert_values()
        trace = Trace(points, self._sign * values, self._sign * np.maximum.accumulate(values), np.array(self._seconds))
        return Report(self.best_value, self.best_point, self.evaluations, np.inf, trace, stopped)

    def _convert_report(self, report: Report) -> Report:
        """Return the maximiser's report in the caller's coordinates and with the caller's sign."""
        trace = replace(
            report.trace,
            points=self._ranges.shown(report.trace.points),
            values=self._sign * report.trace.values,
            best=self._sign * report.trace.best,
        )
        best = self._ranges.shown(report.best_point[np.newaxis])[0]
        upper, lower = (np.inf, -report.upper_bound) if self._about["minimise"] else (report.upper_bound, -np.inf)
        return replace(
            report,
            best_value=self._sign * report.best_value,
            best_point=best,
            upper_bound=upper,
            lower_bound=lower,
            trace=trace,
        )

    def _convert_values(self) -> Array:
        """Return the values ``(n,)`` with the sign of a maximisation; NaN is ``-inf``."""
        values = self._sign * np.array(self._values, dtype=float)
        return np.where(np.isnan(values), -np.inf, values)


def _unpickle(again: Callable[..., AskTell], state: Mapping[str, Any], closed: bool) -> AskTell:
    """Return a search that was pickled."""
    search = again(state=state)
    if closed:
        search.close()
    return search


@contextmanager
def _open_search(search: Search) -> Iterator[_SearchThread]:
    other_search = _SearchThread(search)
    try:
        yield other_search
    finally:
        other_search.close()


def _make_keys(points: Array) -> list[Key]:
    """Return points as keys of a dictionary."""
    return [tuple(point) for point in points.tolist()]


def _parse_state(
    state: object, about: Mapping[str, Any], domain: Box
) -> tuple[list[tuple[Array, float]], Iterable[int]]:
    """Return the points and values of a state, and the numbers of those that the search must ask for again.

    Raises `InputError` where the state is malformed, or belongs to another search.
    """
    if not isinstance(state, Mapping) or state.get("format") != FORMAT:
        raise InputError(path="state", expected=f"what `state()` gave, format {FORMAT}", got=_shorten(state))
    for key, ours in about.items():
        theirs = state.get(key, LATER.get(key))
        if key == "budget" and is_whole(theirs, 1) and theirs <= ours:
            continue
        if theirs != ours:
            least = "at most " if key == "budget" else ""
            raise InputError(path=f"state.{key}", expected=f"{least}{_shorten(ours)}, as given", got=_shorten(theirs))
    points, values, aside = state.get("points"), state.get("values"), state.get("aside", [])
    if not isinstance(points, list) or not isinstance(values, list) or len(points) != len(values):
        raise InputError(path="state.points", expected="a list of points, and a value for each", got=_shorten(points))
    if not isinstance(aside, list) or not all(is_whole(number, 0) and number < len(points) for number in aside):
        raise InputError(path="state.aside", expected="numbers of points", got=_shorten(aside))
    evaluations = []
    for row, (point, value) in enumerate(zip(points, values, strict=True)):
        try:
            position = np.array(point, dtype=float)
            number = float("nan" if value is None else value)
        except (TypeError, ValueError):
            raise InputError(path=f"state.values.{row}", expected="a point and a number", got=_shorten(value)) from None
        if position.shape != domain.lower.shape or not ((position >= domain.lower) & (position <= domain.upper)).all():
            raise InputError(path=f"state.points.{row}", expected="a point of the domain", got=_shorten(point))
        evaluations.append((position, number))
    same = state.get("budget") == about["budget"]
    return evaluations, [number for number in range(len(evaluations)) if number not in set(aside)] if same else []


def _parse_open_points(state: Mapping[str, Any], domain: Box) -> tuple[list[Key], list[Key]]:
    """Return the open points of a state, and those of them for which the search does not wait.

    Raises `InputError` where they are malformed.
    """
    out, ahead = state.get("out", []), state.get("ahead", [])
    try:
        points = np.array(out, dtype=float).reshape(len(out), domain.dimension)
        usable = bool((points >= domain.lower).all() and (points <= domain.upper).all())
    except (TypeError, ValueError):
        usable = False
    if not isinstance(out, list) or not usable:
        raise InputError(path="state.out", expected="a list of points of the domain", got=_shorten(out))
    if not isinstance(ahead, list) or not all(is_whole(number, 0) and number < len(out) for number in ahead):
        raise InputError(path="state.ahead", expected="numbers of points that are out", got=_shorten(ahead))
    keys = _make_keys(points)
    return keys, [keys[number] for number in ahead]


def _shorten(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
