"""The outer maximisation: what a maximiser is, the objective that keeps the accounts for it, and the report."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeAlias

import numpy as np

from sparserob_core.errors import InputError, PluginError, SparseRobError
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import EvaluationsFinished, Notify, silence

Function: TypeAlias = Callable[[Array], object]

SECONDS_BETWEEN_EVENTS = 0.05


class SearchEnded(Exception):
    """Raised through a maximiser to end its search; a maximiser lets it pass. Its text is `Report.stopped`."""


class Objective(Protocol):
    """What a maximiser is handed: a box, a batched function that counts, and a place for notes.

    ``best_value`` is ``-inf`` and ``best_point`` is NaN before the first evaluation. A maximiser reads, and never writes, the attributes.
    """

    domain: Box
    budget: int
    best_point: Array
    best_value: float

    @property
    def remaining(self) -> int:
        """Evaluations that are left."""

    def evaluate(self, points: Array) -> Array:
        """Values ``(k,)`` at points ``(k, d)``; NaN comes back as ``-inf``.

        A point outside the domain raises `InputError`. With fewer than ``k`` evaluations left, the first ``remaining`` points are
        evaluated, recorded, and the search is ended; so it is by a value of ``+inf``: both raise `SearchEnded`, which is not to be caught.
        """

    def note(self, **scalars: float) -> None:
        """Pass scalars (temperature, acceptance, ...) to the trace and to observers."""


class Maximiser(ABC):
    """A global maximiser over a box."""

    @abstractmethod
    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """Evaluate until the budget is spent or nothing is left to gain; return a proven upper bound of the maximum, or ``inf``."""


class EvaluationError(SparseRobError):
    """The function that is maximised raised, or did not return one number per point; ``report`` holds what was found before."""

    def __init__(self, message: str, report: Report) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True, eq=False)
class Trace:
    """Every evaluation in order: ``points (n, d)``, ``values (n,)``, the running ``best (n,)``, and for each name that was noted the
    rows ``(evaluations so far, value)`` as ``notes[name] (j, 2)``."""

    points: Array
    values: Array
    best: Array
    notes: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Report:
    """The outcome of a search: the best evaluated value and where, and a proven ``upper_bound`` of the maximum (``inf``: none).

    ``stopped`` says why the search ended; ``best_point`` is NaN ``(d,)`` when nothing was evaluated.
    """

    best_value: float
    best_point: Array
    evaluations: int
    upper_bound: float
    trace: Trace
    stopped: str
    interrupted: bool = False


class CountedObjective:
    """An `Objective` that keeps the accounts itself, so that a maximiser cannot misreport.

    ``function`` maps points ``(k, d)`` to ``k`` numbers. Raises `InputError` for an unbounded domain or a budget below 1.
    """

    def __init__(self, function: Function, domain: Box, budget: int, notify: Notify = silence) -> None:
        if not (np.isfinite(domain.lower).all() and np.isfinite(domain.upper).all()):
            raise InputError(f"domain: expected a bounded box, got lower {domain.lower.tolist()}, upper {domain.upper.tolist()}")
        if budget != int(budget) or budget < 1:
            raise InputError(f"budget: expected a whole number of at least 1, got {budget!r}")
        self.function, self.domain, self.budget = function, domain, int(budget)
        self.best_value, self.best_point = -np.inf, np.full(domain.dimension, np.nan)
        self.evaluations = 0
        self._points: list[Array] = []
        self._values: list[Array] = []
        self._notes: dict[str, list[tuple[float, float]]] = {}
        self.ended: SearchEnded | EvaluationError | None = None
        self._notify, self._told = notify, 0
        self._started = self._told_at = time.monotonic()

    @property
    def remaining(self) -> int:
        """Evaluations that are left."""
        return self.budget - self.evaluations

    def evaluate(self, points: Array) -> Array:
        """See `Objective.evaluate`."""
        if self.ended is not None:
            raise self.ended
        asked = self._checked(points)
        allowed = asked[: self.remaining]
        values = np.empty(0)
        if len(allowed):
            values = self._values_at(allowed)
            self._record(allowed, values)
        if np.isposinf(self.best_value):
            raise self._end(SearchEnded("a value of +inf was found, which nothing can exceed"))
        if len(allowed) < len(asked):
            raise self._end(SearchEnded("the budget is spent"))
        return values

    def note(self, **scalars: float) -> None:
        """See `Objective.note`."""
        for name, value in scalars.items():
            self._notes.setdefault(name, []).append((self.evaluations, float(value)))

    def report(self, stopped: str, upper_bound: float = np.inf) -> Report:
        """What has been found so far."""
        points = np.concatenate(self._points) if self._points else np.empty((0, self.domain.dimension))
        values = np.concatenate(self._values) if self._values else np.empty(0)
        notes = {name: np.array(rows) for name, rows in self._notes.items()}
        trace = Trace(points, values, np.maximum.accumulate(values), notes)
        return Report(self.best_value, self.best_point, self.evaluations, upper_bound, trace, stopped)

    def tell(self) -> None:
        """Tell the observers of what was evaluated since they were told last."""
        if self.evaluations > self._told and self._notify is not silence:
            now = time.monotonic()
            count, self._told, self._told_at = self.evaluations - self._told, self.evaluations, now
            self._notify(EvaluationsFinished(count=count, total=self.evaluations, best_value=self.best_value,
                                             seconds=now - self._started, notes={name: rows[-1][1] for name, rows in self._notes.items()}))

    def _checked(self, points: Array) -> Array:
        asked = np.array(points, dtype=float)
        if asked.ndim != 2 or asked.shape[1] != self.domain.dimension:
            raise InputError(f"points: expected shape (k, {self.domain.dimension}), got {asked.shape}")
        outside = ~((asked >= self.domain.lower) & (asked <= self.domain.upper)).all(axis=1)
        if outside.any():
            raise InputError(f"points: {asked[outside][0].tolist()} lies outside the domain, "
                             f"lower {self.domain.lower.tolist()}, upper {self.domain.upper.tolist()}")
        return asked

    def _end(self, reason: SearchEnded | EvaluationError) -> SearchEnded | EvaluationError:
        self.ended = reason
        return reason

    def _values_at(self, points: Array) -> Array:
        try:
            values = np.array(self.function(points.copy()), dtype=float)
            if values.shape != (len(points),):
                raise ValueError(f"expected {len(points)} numbers for {len(points)} points, got an array of shape {values.shape}")
        except Exception as error:
            best = f"the best of them {self.best_value:.9g} at {self.best_point.tolist()}" if self.evaluations else "none before"
            reason = f"the function failed after {self.evaluations} evaluations ({best}): {type(error).__name__}: {error}"
            raise self._end(EvaluationError(reason, self.report("the function failed"))) from error
        values[np.isnan(values)] = -np.inf
        return values

    def _record(self, points: Array, values: Array) -> None:
        self._points.append(points)
        self._values.append(values.copy())
        top = int(np.argmax(values))
        if values[top] > self.best_value or self.evaluations == 0:
            self.best_value, self.best_point = float(values[top]), points[top].copy()
        self.evaluations += len(values)
        if time.monotonic() - self._told_at > SECONDS_BETWEEN_EVENTS:
            self.tell()


def maximise(function: Function, domain: Box, maximiser: Maximiser, budget: int, rng: np.random.Generator,
             notify: Notify = silence) -> Report:
    """Search for the maximum of ``function`` (points ``(k, d)`` to values ``(k,)``) over a bounded box with ``budget`` evaluations at most.

    An interrupt from the keyboard ends the search; the report says so. Raises `EvaluationError` when the function raises or does not return
    numbers, `InputError` for an unbounded domain or a wrong budget, `PluginError` for an upper bound that an evaluated value refutes.
    """
    objective = CountedObjective(function, domain, budget, notify)
    bound, stopped, interrupted = np.inf, "the maximiser found nothing left to gain", False
    try:
        bound = float(maximiser.search(objective, rng))
    except SearchEnded as end:
        stopped = str(end)
    except KeyboardInterrupt:
        stopped, interrupted = "interrupted from the keyboard", True
    objective.tell()
    if not bound >= objective.best_value:
        name = type(maximiser).__name__
        raise PluginError(f"maximiser {name}: claims the upper bound {bound!r}, but the value {objective.best_value!r} was evaluated")
    if isinstance(objective.ended, EvaluationError):
        raise objective.ended
    return replace(objective.report(stopped, bound), interrupted=interrupted)
