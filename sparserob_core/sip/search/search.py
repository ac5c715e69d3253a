"""Search for a maximum: the objective that counts evaluations for a maximiser, and the search itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np

from sparserob_core.errors import InputError, PluginError, SparseRobError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import Notify, Phase, ignore
from sparserob_core.sip.maximiser import EvaluationError, LinearBlocks, Maximiser, Objective, Report, SearchEnded, Trace
from sparserob_core.sip.rules import Metropolis, Progress
from sparserob_core.sip.search.block_ascent import block_ascent
from sparserob_core.sip.search.handed import Apart, MovingObjective, ScaledObjective
from sparserob_core.sip.search.notifier import Notifier, Standing

Function: TypeAlias = Callable[[Array], object]

KEPT_NUMBERS = 20_000_000  # largest number of coordinates in a trace; larger searches keep their values only


@dataclass(frozen=True, eq=False)
class Target:
    """Function to be maximised over a bounded box.

    Parameters
    ----------
    function : callable
        Maps points ``(k, d)`` of the domain to ``k`` numbers.
    domain : Box
        Bounded box.
    gradient : callable, optional
        Maps the point ``(d,)`` that was evaluated last to the gradient ``(d,)`` there; ``None`` if there is none.
    block : int, default 1
        Number of consecutive coordinates that belong together, a divisor of ``d``.
    linear : LinearBlocks, optional
        Linear coordinates of the blocks (`Objective.linear`).
    acting : callable, optional
        Returns the blocks on which the last value depends (`Objective.acting`).

    Raises
    ------
    InputError
        For an unbounded domain, or blocks that do not fill it.
    """

    function: Function
    domain: Box
    gradient: Callable[[Array], Array] | None = None
    block: int = 1
    linear: LinearBlocks | None = None
    acting: Callable[[], np.ndarray] | None = None

    def __post_init__(self) -> None:
        domain = self.domain
        if not (np.isfinite(domain.lower).all() and np.isfinite(domain.upper).all()):
            raise InputError(
                f"domain: expected a bounded box, got lower {domain.lower.tolist()}, upper {domain.upper.tolist()}"
            )
        with np.errstate(over="ignore"):
            too_long = ~np.isfinite(domain.upper - domain.lower)
        if too_long.any():
            raise InputError(
                f"domain: expected sides whose length is a finite number, got {float(domain.lower[too_long][0])!r} to "
                f"{float(domain.upper[too_long][0])!r}"
            )
        if self.block < 1 or domain.dimension % self.block:
            raise InputError(f"block: expected a divisor of the dimension {domain.dimension}, got {self.block!r}")


@dataclass(frozen=True, eq=False)
class Rules:
    """Rules of a search, in addition to its budget.

    Parameters
    ----------
    stop : callable, optional
        Rule ``SC2``: ``stop(progress)`` is true where the search has to stop.
    selection : callable, default Metropolis
        Rule ``SlCr``: whether a search moves to a candidate.
    polish : float, optional
        Share of the budget for a local method at the end, at least 0 and below 1. ``None``: the maximiser's own share
        (`Maximiser.polished`) where the target has a gradient or linear blocks, and 0 elsewhere. With a gradient or
        linear blocks, a local method finds in ten evaluations what no search finds that only compares values.
    seconds : float, default inf
        Time after which no evaluation begins.
    target : float, default inf
        Value at which the search ends.
    patience : int, optional
        Number of successive evaluations without a gain after which the search ends.
    halt : callable, optional
        Called after every batch; the search ends where it returns true. The polish ends with the search, as it does at
        ``target`` and after ``patience``.

    Raises
    ------
    InputError
        For a ``polish`` that is no such share.
    """

    stop: Callable[[Progress], bool] | None = None
    selection: Callable[[float, float, float, np.random.Generator], bool] = field(default_factory=Metropolis)
    polish: float | None = None
    seconds: float = np.inf
    target: float = np.inf
    patience: int | None = None
    halt: Callable[[], bool] | None = None

    def __post_init__(self) -> None:
        if self.polish is not None and not 0.0 <= self.polish < 1.0:
            raise InputError(f"polish: expected a share of the budget, at least 0 and below 1, got {self.polish!r}")

    def share(self, maximiser: Maximiser, target: Target) -> float:
        """Return the share of the budget that is reserved for a polish.

        Parameters
        ----------
        maximiser : Maximiser
            The maximiser, whose own share counts where ``polish`` is ``None``.
        target : Target
            Function to be maximised.

        Returns
        -------
        float
            The share, at least 0 and below 1.
        """
        if self.polish is None:
            return maximiser.polished if target.linear is not None or target.gradient is not None else 0.0
        return self.polish


class CountedObjective:
    """An `Objective` that counts its evaluations itself, so that a maximiser cannot misreport them.

    Parameters
    ----------
    target : Target
        Function to be maximised.
    budget : int
        Evaluations that the search may spend, at least 1.
    rules : Rules, optional
        Rules of the search.
    notify : callable
        Receives events.
    asker : str
        Name of the maximiser in messages.

    Raises
    ------
    InputError
        For a budget below 1.
    """

    def __init__(
        self,
        target: Target,
        budget: int,
        rules: Rules | None = None,
        notify: Notify = ignore,
        asker: str = "the maximiser",
    ) -> None:
        if budget != int(budget) or budget < 1:
            raise InputError(f"budget: expected a whole number of at least 1, got {budget!r}")
        self.target, self.domain, self.block, self.budget = target, target.domain, target.block, int(budget)
        self.asker = asker
        self.rules: Rules | None = rules or Rules()
        self.best_value, self.best_point = -np.inf, np.full(self.domain.dimension, np.nan)
        self.evaluations = 0
        self.missing = 0  # evaluations that gave NaN
        self.learnt = 0  # points that were known before, which are no evaluations of this search
        self._last_gain = 0  # number of evaluations at the last gain
        self._known_evaluations = np.empty((0, self.domain.dimension)), np.empty(0)
        self._stored_values: dict[tuple[float, ...], float] = {}  # the known values by their points
        self._recall_count = 0
        own = rules or Rules()
        self._target, self._patience, self._halt = own.target, own.patience, own.halt
        self.searched: int | None = None
        self.whole_end = False  # whether the search ends without a polish
        self.ended: SearchEnded | EvaluationError | None = None
        self._keeps = self.domain.dimension * self.budget <= KEPT_NUMBERS
        self._points: list[Array] = []
        self._values: list[Array] = []
        self._seconds: list[tuple[int, float]] = []
        self._improvements: list[tuple[int, float]] = []
        self._notes: dict[str, list[tuple[float, float]]] = {}
        self._notifier = None if notify is ignore else Notifier(notify, target.domain)
        self._started = time.monotonic()
        self._end_time = self._started + (rules or Rules()).seconds

    @property
    def late(self) -> bool:
        """True where the time of the search is over."""
        return time.monotonic() >= self._end_time

    @property
    def remaining(self) -> int:
        """Evaluations that are left; 0 once the search has ended, so that a maximiser that catches `SearchEnded` ends
        too."""
        return 0 if self.ended is not None else self.budget - self.evaluations

    @property
    def differentiable(self) -> bool:
        """True where the target has a gradient."""
        return self.target.gradient is not None

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """Function that returns the acting blocks of the target (`Objective.acting`)."""
        return self.target.acting

    @property
    def linear(self) -> LinearBlocks | None:
        """Linear coordinates of the target's blocks (`Objective.linear`)."""
        return self.target.linear

    def evaluate(self, points: Float[Array, "k d"]) -> Float[Array, " k"]:
        """Return the values ``(k,)`` at points ``(k, d)``, record them, and end the search where it is due
        (`Objective.evaluate`)."""
        if self.ended is not None:
            raise self.ended
        if self._notifier is not None and self._notifier.due(self.evaluations, self.budget):
            self.notify_observers()
        point_array = self._check_points(points)
        values = self._recall_values(point_array)
        unknown = np.flatnonzero(np.isnan(values))
        allowed = unknown[: self.remaining]
        while len(allowed):  # in one batch, unless the search may end within it for lack of a gain
            batch = allowed[: self._remaining_patience]
            values[batch] = self._evaluate_function(point_array[batch])
            self._record(point_array[batch], values[batch])
            allowed = allowed[len(batch) :]
            self._check_ends()
        if not len(unknown):
            self._check_ends()
        if np.isnan(values).any():
            raise self._record_end(SearchEnded("the budget is spent"))
        return values

    def _recall_values(self, points: Array) -> Array:
        """Return the values ``(k,)`` that are known from before; NaN elsewhere.

        At most as many values as the budget are recalled, so that a maximiser that asks for nothing else ends too.
        """
        values = np.full(len(points), np.nan)
        if self._stored_values and self._recall_count < self.budget:
            values[:] = [self._stored_values.get(tuple(point), np.nan) for point in points.tolist()]
            self._recall_count += int((~np.isnan(values)).sum())
        return values

    @property
    def _remaining_patience(self) -> int:
        """Number of further evaluations that may bring no gain."""
        return self.budget if self._patience is None else max(1, self._patience - self.evaluations + self._last_gain)

    def _check_ends(self) -> None:
        """End the search where there is a reason."""
        if self.best_value == np.inf:
            raise self._record_end(SearchEnded("a value of +inf was found, which nothing can exceed"))
        if self.best_value >= self._target:
            self.whole_end = True
            raise self._record_end(SearchEnded(f"the target {self._target:.9g} is reached"))
        if self._patience is not None and self.evaluations - self._last_gain >= self._patience:
            self.whole_end = True
            raise self._record_end(SearchEnded(f"the last {self._patience} evaluations gained nothing"))
        if self._halt is not None and self._halt():
            self.whole_end = True
            raise self._record_end(SearchEnded("the callback says so"))
        if self._is_stopped():
            raise self._record_end(SearchEnded("the stopping rule of the search says so"))
        if self.late:
            raise self._record_end(SearchEnded("the time limit of the search is reached"))

    def learn(self, points: Float[Array, "k d"], values: Float[Array, " k"]) -> None:
        """Accept points whose values are known from before; to be called before the first evaluation.

        Known points are no evaluations of this search, but count for its best point.

        Parameters
        ----------
        points : ndarray, shape (k, d)
            Points of the domain.
        values : ndarray, shape (k,)
            Their values; NaN counts as ``-inf``.
        """
        clean_values, self.learnt = np.where(np.isnan(values), -np.inf, values), len(values)
        self._known_evaluations = self._check_points(points), clean_values
        self._stored_values = dict(
            zip(map(tuple, self._known_evaluations[0].tolist()), clean_values.tolist(), strict=True)
        )
        self.budget, self.evaluations, self._last_gain = self.budget + self.learnt, self.learnt, self.learnt
        top = int(clean_values.argmax())
        self.best_value, self.best_point = float(clean_values[top]), self._known_evaluations[0][top].copy()
        if self._notifier is not None:
            self._notifier.notified = self.learnt
        self._check_ends()

    def begin(self, start: Float[Array, "k d"]) -> None:
        """Evaluate the points ``(k, d)`` at which the search starts."""
        self.evaluate(start)
        self._known_evaluations = self.seen()

    def known(self) -> tuple[Float[Array, "k d"], Float[Array, " k"]]:
        """Return the points ``(k, d)`` that were known before the maximiser was called, and their values ``(k,)``."""
        return self._known_evaluations

    @shaped
    def value_and_gradient(self, point: Float[Array, " d"]) -> tuple[float, Float[Array, " d"]]:
        """Return the value and the gradient ``(d,)`` at one point (`Objective.value_and_gradient`)."""
        if self.target.gradient is None:
            raise InputError("gradient: this objective offers none")
        value = float(self.evaluate(np.asarray(point)[np.newaxis])[0])
        slope = np.zeros(self.domain.dimension)
        if np.isfinite(value):
            slope = np.asarray(
                self._call_function(self.target.gradient, np.array(point, dtype=float), slope.shape), dtype=float
            )
        return value, slope

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Return the answer of the rule ``SlCr`` (`Objective.accepts`)."""
        selection = (self.rules or Rules()).selection
        return bool(_ask_rule("slcr", lambda: selection(current, candidate, temperature, rng)))

    def note(self, **scalars: float) -> None:
        """Record scalars in the trace, and pass them to observers."""
        for name, value in scalars.items():
            self._notes.setdefault(name, []).append((self.evaluations - self.learnt, float(value)))
        if self._notifier is not None:
            self._notifier.note(scalars)

    @property
    def observed(self) -> bool:
        """True where observers receive events."""
        return self._notifier is not None

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """Show observers the points or regions that the search considers (`Objective.sketch`)."""
        if self._notifier is not None:
            self._notifier.sketch(role, lower, upper, rounded)

    def polish(self, reserved: int) -> None:
        """Open the search again for its last part, with ``reserved`` further evaluations and without a stopping
        rule."""
        self.notify_observers()
        self.searched = self.evaluations
        self.ended, self.budget, self.rules = None, self.evaluations + reserved, None

    @shaped
    def seen(self) -> tuple[Float[Array, "n d"], Float[Array, " n"]]:
        """Return every evaluated point ``(n, d)`` and its value ``(n,)``; only the best one where all of them would be
        too many."""
        if not self._keeps:
            return self.best_point[np.newaxis], np.array([self.best_value])
        own = slice(0, self.learnt)
        points, values = self._known_evaluations[0][own], self._known_evaluations[1][own]
        return np.concatenate([points, *self._points]), np.concatenate([values, *self._values])

    def report(self, stopped: str, upper_bound: float = np.inf) -> Report:
        """Return the report of the evaluations so far.

        Parameters
        ----------
        stopped : str
            Reason for the end of the search.
        upper_bound : float, default inf
            Proven upper bound of the maximum.

        Returns
        -------
        Report
            The report.
        """
        points = self.seen()[0][self.learnt :] if self._keeps else np.empty((0, self.domain.dimension))
        values = np.concatenate([np.empty(0), *self._values])
        seconds = np.repeat([moment for _, moment in self._seconds], [count for count, _ in self._seconds])
        notes = {name: np.array(rows) for name, rows in self._notes.items()}
        searched = None if self.searched is None else self.searched - self.learnt
        trace = Trace(points, values, np.maximum.accumulate(values), seconds, notes, searched)
        own = self.evaluations - self.learnt
        return Report(self.best_value, self.best_point, own, upper_bound, trace, stopped, missing=self.missing)

    def notify_observers(self) -> None:
        """Send an event for the evaluations since the last event."""
        if self._notifier is not None and self.evaluations > self._notifier.notified:
            phase: Phase = "search" if self.searched is None else "polish"
            standing = Standing(self.evaluations, self.budget, self.best_value, self.best_point, self.block, phase)
            self._notifier.publish(standing, self._notes)

    def _collect_last_notes(self) -> dict[str, float]:
        return {name: rows[-1][1] for name, rows in self._notes.items()}

    def _is_stopped(self) -> bool:
        stop = None if self.rules is None else self.rules.stop
        if stop is None:
            return False
        progress = Progress(self.evaluations, self.best_value, self._collect_last_notes(), self._improvements)
        return bool(_ask_rule("sc2", lambda: stop(progress)))

    def _check_points(self, points: Array) -> Array:
        point_array = np.array(points, dtype=float)
        if point_array.ndim != 2 or point_array.shape[1] != self.domain.dimension:
            raise PluginError(
                f"{self.asker}: points: expected shape (k, {self.domain.dimension}), got {point_array.shape}"
            )
        if not ((point_array >= self.domain.lower).all() and (point_array <= self.domain.upper).all()):
            outside = ~((point_array >= self.domain.lower) & (point_array <= self.domain.upper)).all(axis=1)
            raise PluginError(
                f"{self.asker}: points: {_format_point(point_array[outside][0])} lies outside the domain, "
                f"lower {_format_point(self.domain.lower)}, upper {_format_point(self.domain.upper)}"
            )
        return point_array

    def _record_end(self, reason: SearchEnded | EvaluationError) -> SearchEnded | EvaluationError:
        self.ended = reason
        return reason

    @shaped
    def _evaluate_function(self, points: Float[Array, "k d"]) -> Float[Array, " k"]:
        values = np.array(
            self._call_function(self.target.function, points.copy() if self._keeps else points, (len(points),))
        )
        missing = np.isnan(values)
        if missing.any():
            values[missing] = -np.inf
            self.missing += int(missing.sum())
        return values

    def _call_function(self, function: Function, argument: Array, shape: tuple[int, ...]) -> Array:
        """Return the values of the user's function, checked for shape; an error of the function ends the search."""
        try:
            returned = np.asarray(function(argument))
            if np.iscomplexobj(returned):
                raise ValueError(f"expected real numbers, got complex ones, such as {returned.flat[:1].tolist()}")
            values = np.asarray(returned, dtype=float)
            if values.shape != shape:
                raise ValueError(f"expected {shape[0]} numbers, got an array of shape {values.shape}")
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            best = (
                f"the best of them {self.best_value:.9g} at {_format_point(self.best_point)}"
                if self.evaluations
                else "none before"
            )
            reason = (
                f"the function failed after {self.evaluations} evaluations ({best}): {type(error).__name__}: {error}"
            )
            raise self._record_end(EvaluationError(reason, self.report("the function failed"))) from error
        return values

    @shaped
    def _record(self, points: Float[Array, "k d"], values: Float[Array, " k"]) -> None:
        if self._keeps:
            self._points.append(points)
        self._values.append(values.copy())
        moment = time.monotonic() - self._started
        self._seconds.append((values.size, moment))
        if self._notifier is not None:
            self._notifier.add(points, self._values[-1], moment)
        top = int(values.argmax())
        first = self.evaluations == 0
        self.evaluations += len(values)
        if values[top] > self.best_value or first:
            self.best_value, self.best_point = float(values[top]), points[top].copy()
            self._improvements.append((self.evaluations, self.best_value))
            self._last_gain = self.evaluations - len(values) + top + 1


def _ask_rule(name: str, ask: Callable[[], object]) -> object:
    """Return the answer of a rule; raise `PluginError` in the rule's name where it fails."""
    try:
        return ask()
    except (SparseRobError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise PluginError(f"{name}: the rule raised {type(error).__name__}: {error}") from error


def _format_point(point: Array) -> str:
    return str(point.tolist()) if point.size <= 12 else f"a point with {point.size} coordinates"


def maximise(
    target: Target,
    maximiser: Maximiser,
    budget: int,
    rng: np.random.Generator,
    rules: Rules | None = None,
    notify: Notify = ignore,
    start: Array | None = None,
    known: tuple[Array, Array] | None = None,
) -> Report:
    """Search for the maximum of a target; the last share of the budget polishes the result.

    The maximiser receives only the coordinates that can move. Where none can, the maximiser is not called, for the
    value at the only point is the maximum. A maximiser that requires units of about 1 receives them (`Maximiser`,
    ``scaled``). An interrupt from the keyboard ends the search, and is recorded in the report.

    Parameters
    ----------
    target : Target
        Function to be maximised.
    maximiser : Maximiser
        The maximiser.
    budget : int
        Largest number of evaluations.
    rng : numpy.random.Generator
        Random numbers.
    rules : Rules, optional
        Rules of the search.
    notify : callable
        Receives events; by default events are ignored.
    start : ndarray, shape (d,) or (k, d), optional
        Points that are evaluated first.
    known : tuple of ndarray, optional
        Points ``(k, d)`` and values ``(k,)`` from before, which are no evaluations.

    Returns
    -------
    Report
        Outcome of the search.

    Raises
    ------
    EvaluationError
        Where the function raises an error or does not return numbers.
    InputError
        For a wrong budget.
    PluginError
        For a maximiser that raises an error, leaves the domain, or claims an upper bound that is no number or that an
        evaluated value refutes.
    """
    rules = rules or Rules()
    name = name_of(maximiser)
    moves = np.flatnonzero(target.domain.lower < target.domain.upper)
    reserved = int(rules.share(maximiser, target) * budget) if budget == int(budget) else 0
    objective = CountedObjective(target, budget - reserved, rules, notify, name)
    shown = objective if moves.size in (0, target.domain.dimension) else MovingObjective(objective, moves, name)
    bound, stopped, interrupted = np.inf, "the maximiser found nothing left to gain", False
    try:
        try:
            if known is not None:
                objective.learn(*known)
            if start is not None:
                objective.begin(np.atleast_2d(start))
            bound = ask(maximiser, shown, rng) if moves.size else _evaluate_only_point(objective)
            stopped = stopped if objective.remaining else "the budget is spent"
        except SearchEnded as end:
            stopped = str(end)
        if (
            reserved
            and moves.size
            and not isinstance(objective.ended, EvaluationError)
            and np.isfinite(objective.best_value)
            and not objective.late
            and not objective.whole_end
        ):
            objective.polish(reserved)
            stopped = f"{stopped}; then polished"
            from sparserob_core.sip.search.local_search import polish

            if not block_ascent(shown):  # no local method that knows less of the blocks improves its result
                points, values = objective.seen()
                scaled = ScaledObjective(shown, values)
                polish(scaled, *scaled.seen(points[:, moves], values))
    except SearchEnded:
        pass
    except KeyboardInterrupt as pressed:
        stopped, interrupted = str(pressed) or "interrupted from the keyboard", True
    objective.notify_observers()
    if not bound >= objective.best_value:
        raise PluginError(
            f"{name}: claims the upper bound {bound!r}, but the value {objective.best_value!r} was evaluated"
        )
    if isinstance(objective.ended, EvaluationError):
        fault = objective.ended.__cause__
        raise fault if isinstance(fault, PluginError) else objective.ended
    return replace(objective.report(stopped, bound), interrupted=interrupted)


def ask(maximiser: Maximiser, objective: Objective, rng: np.random.Generator) -> float:
    """Let a maximiser search, in the units and coordinates that it requires, and return the upper bound that it claims.

    An error that it raises is reported as its fault (`PluginError`), unless it is an error of this project.

    Parameters
    ----------
    maximiser : Maximiser
        The maximiser.
    objective : Objective
        The objective, in the user's units.
    rng : numpy.random.Generator
        Random numbers.

    Returns
    -------
    float
        Claimed upper bound of the maximum, or ``inf``.

    Raises
    ------
    SearchEnded
        Where the search has ended.
    PluginError
        Where the maximiser raises another error, or returns no number.
    """
    name = name_of(maximiser)
    if maximiser.apart and objective.acting is not None:  # a tuple of indices
        objective = Apart(objective)
    scaled = ScaledObjective(objective, objective.known()[1]) if maximiser.scaled else None
    try:
        claimed: object = maximiser.search(objective if scaled is None else scaled, rng)
    except (SearchEnded, SparseRobError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise PluginError(f"{name}: search raised {type(error).__name__}: {error}") from error
    if isinstance(claimed, bool) or not isinstance(claimed, int | float | np.integer | np.floating):
        raise PluginError(f"{name}: search returned {claimed!r}, expected an upper bound, a number or inf")
    return float(claimed) * (1.0 if scaled is None else scaled.value or 1.0)


def name_of(maximiser: Maximiser) -> str:
    """Return the name of a maximiser for messages."""
    return str(getattr(maximiser, "origin", f"maximiser {type(maximiser).__name__}"))


def _evaluate_only_point(objective: CountedObjective) -> float:
    """Return the value at the only point of a domain in which no coordinate can move."""
    if objective.evaluations:
        return objective.best_value
    return float(objective.evaluate(objective.domain.lower[np.newaxis])[0])
