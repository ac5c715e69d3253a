"""Events of a running method or search; a receiver cannot disturb the run.

Arrays in events cannot be written to. Data that take time to compute are computed when a receiver first reads them
(`Batch`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

import numpy as np

from sparserob_core.quantities import RECORDS, quantity
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.maximiser import Trace

if TYPE_CHECKING:
    from sparserob_core.sip.program import Separation


@dataclass(frozen=True, kw_only=True, eq=False)
class Event:
    """An event in a run."""


SKETCHED = 400
"""Largest number of points, boxes or ellipsoids in one sketch."""

UNCHANGED = 1e-10
"""Relative change of a value that counts as rounding. Of 1 700 moves over literal tuples, 250 changed g by less than
1e-12, for they moved a coordinate that does not enter the row. All others changed g by more than 1e-7. A thousandth of
the limit, or a hundred times it, would separate the two as well; more would hide the last steps of a search."""

Phase: TypeAlias = Literal["search", "polish"]
"""The evaluating method: the maximiser, or the local method that spends the last share of its budget."""

DECIDING = 4
"""Largest number of indices reported for each tuple: two determine the picture, and each may have a neighbour."""

Notify: TypeAlias = Callable[[Event], None]
T = TypeVar("T", bound=Event)


def ignore(event: Event) -> None:
    """Ignore an event."""


def forward_events(notify: Notify, kind: type[T], complete: Callable[[T], Event]) -> Notify:
    """Return a listener that passes every event on to ``notify``, and completes the events of one kind.

    Parameters
    ----------
    notify : callable
        Receives the events.
    kind : type
        Kind of the events to be completed.
    complete : callable
        Returns the event that is passed on instead of one of that kind.

    Returns
    -------
    callable
        The listener; `ignore` where ``notify`` is `ignore`.
    """
    if notify is ignore:
        return ignore
    return lambda event: notify(complete(event) if isinstance(event, kind) else event)


def forward_progress(notify: Notify, stage: str) -> Notify:
    """Return a listener for an auxiliary program, which passes on the progress of its rounds and proofs only.

    Parameters
    ----------
    notify : callable
        Receives the events.
    stage : str
        Name of the auxiliary program in the text of `StageProgress`.

    Returns
    -------
    callable
        The listener; `ignore` where ``notify`` is `ignore`.
    """
    if notify is ignore:
        return ignore

    def heard(event: Event) -> None:
        if isinstance(event, RoundFinished):
            notify(StageProgress(text=f"{stage}: round {event.round}, {event.active_indices} cuts"))
        elif isinstance(event, ProofProgress):
            notify(event)

    return heard


def frozen(array: Array) -> Array:
    """Return a view of an array that cannot be written to."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, eq=False)
class Batch:
    """Evaluations of a search since the last event; ``trace`` and ``moves`` are computed when they are first read.

    Parameters
    ----------
    points : sequence of ndarray, shape (k_i, d)
        Points, in the pieces in which they were evaluated.
    values : sequence of ndarray, shape (k_i,)
        Their values.
    moments : sequence of (int, float)
        Size of each piece, and seconds since the search began.
    notes : mapping of str to sequence of (float, float)
        For each noted name, the pairs (evaluations of the search so far, value).
    first : int, default 0
        Number of evaluations before this batch.
    best : float, default -inf
        Largest value of these.
    origin : ndarray, shape (d,), optional
        Current point of the search before this batch; ``None`` at the start.
    stood : float, default nan
        Value at that point.
    """

    points: Sequence[Array] = field(default=(), metadata=quantity("index"))
    values: Sequence[Array] = field(default=(), metadata=quantity("value"))
    moments: Sequence[tuple[int, float]] = ()
    notes: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    first: int = 0
    best: float = field(default=-np.inf, metadata=quantity("value"))
    origin: Array | None = field(default=None, metadata=quantity("index"))
    stood: float = field(default=np.nan, metadata=quantity("value"))

    @cached_property
    def trace(self) -> Trace:
        """Evaluations as a `Trace`; ``best`` and ``notes`` count from the start of the search."""
        if not self.values:
            return Trace(np.empty((0, 0)), np.empty(0), np.empty(0), np.empty(0))
        values = np.concatenate(self.values)
        seconds = np.repeat([moment for _, moment in self.moments], [count for count, _ in self.moments])
        notes = {name: np.array(rows, dtype=float).reshape(-1, 2) for name, rows in self.notes.items()}
        return Trace(
            np.concatenate(self.points), values, np.maximum(np.maximum.accumulate(values), self.best), seconds, notes
        )

    @cached_property
    def moves(self) -> np.ndarray:
        """Coordinates in which each point moved: rows ``(evaluation in the batch, coordinate)``, as ``(k, 2)``.

        A point has moved in a coordinate where it differs from the current point.
        The current point is the last accepted point where the maximiser notes ``accepted``, and the previous point
        where it does not. The first point of a search has no current point, and has no rows.
        """
        points = self.trace.points
        if not len(points):
            return np.zeros((0, 2), dtype=int)
        before = standing_before(self.accepted)
        origin = np.full(points.shape[1], np.nan) if self.origin is None else self.origin
        stood = np.where(before[:, np.newaxis] < 0, origin, points[before])
        return np.argwhere((points != stood) & ~np.isnan(stood))

    @cached_property
    def gains(self) -> Array:
        """Rise ``(k,)`` of each value above the value at the current point; 0 for a move that changed nothing.

        The first value of a search has NaN.
        """
        return gains(self.trace.values, self.accepted, self.stood)

    @property
    def changes(self) -> np.ndarray:
        """Truth values ``(k,)``: true for each value that differs from the value at the current point.

        A proposal that leaves the value unchanged says nothing of the search.
        """
        return np.asarray(np.nan_to_num(self.gains) != 0.0)

    @property
    def acceptance(self) -> float:
        """Share of accepted moves among those that changed the value; NaN where there was none, or no rule of
        acceptance."""
        judged = self.trace.notes.get("accepted", np.empty((0, 2)))[:, 0].astype(int) - 1 - self.first
        judged = judged[(judged >= 0) & (judged < self.gains.size)]
        changing = judged[self.changes[judged]]
        return float(self.accepted[changing].mean()) if changing.size else np.nan

    @cached_property
    def accepted(self) -> np.ndarray:
        """Truth values ``(k,)``: true for each accepted point; all true where the maximiser has no rule of
        acceptance."""
        accepted = np.ones(len(self.trace.points), dtype=bool)
        rows = self.trace.notes.get("accepted", np.empty((0, 2)))
        indices = rows[:, 0].astype(int) - 1 - self.first
        is_own = (indices >= 0) & (indices < accepted.size)
        accepted[indices[is_own]] = rows[is_own, 1] > 0.0
        return accepted


def standing_before(accepted: np.ndarray) -> np.ndarray:
    """Return the number ``(k,)`` of the evaluation that was the current point before each evaluation.

    Parameters
    ----------
    accepted : ndarray of bool, shape (k,)
        True for the evaluations that were accepted.

    Returns
    -------
    ndarray of int, shape (k,)
        Numbers of evaluations; -1 where the current point is older than the first evaluation.
    """
    standing = np.maximum.accumulate(np.where(accepted, np.arange(accepted.size), -1))
    return np.concatenate([[-1], standing[:-1]])[: accepted.size]


def gains(values: Array, accepted: np.ndarray, stood: float = np.nan) -> Array:
    """Return the rise of each value above the value at the current point.

    Parameters
    ----------
    values : ndarray, shape (k,)
        Values of the evaluations.
    accepted : ndarray of bool, shape (k,)
        True for the evaluations that were accepted.
    stood : float, default nan
        Value at the current point before the first evaluation.

    Returns
    -------
    ndarray, shape (k,)
        The rise; exactly 0 from ``-inf`` to ``-inf``, and where two values differ by rounding only (`UNCHANGED`).
    """
    before = standing_before(accepted)
    reference = np.where(before < 0, stood, values[before])
    rises = np.subtract(values, reference, out=np.zeros(values.size), where=values != reference)
    rises[np.abs(rises) <= UNCHANGED * np.where(np.isfinite(reference), np.abs(reference), 0.0)] = 0.0
    return rises


@dataclass(frozen=True, eq=False)
class Sketch:
    """Points, boxes, or ellipsoids within boxes that a maximiser considers or has ruled out; at most `SKETCHED` of
    them.

    Parameters
    ----------
    lower, upper : ndarray, shape (k, d)
        Corners of the boxes; the same array for points.
    rounded : bool, default False
        Whether the regions are the ellipsoids within the boxes.
    """

    lower: Array = field(metadata=quantity("index"))
    upper: Array = field(metadata=quantity("index"))
    rounded: bool = False

    @property
    def points(self) -> bool:
        """True where the sketch shows points."""
        return self.lower is self.upper


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundFinished(Event):
    """End of one round of the exchange, or of one outer iteration of the method ``sparserob``.

    Parameters
    ----------
    round : int
        Number of the round.
    epsilon : float
        Weight of the regulariser.
    lower_bound : float
        Proven lower bound of the value of the unregularised program; ``-inf`` while unknown.
    upper_bound : float
        Upper bound of that value, if the decision is feasible: its cost, where the search of this round has found no
        violation. The decision need not be proven (``proven``). ``inf`` while unknown.
    violation : float
        Largest constraint violation of this round's decision over the continuum.
    worst_family : str
        Family of that constraint.
    active_indices : int
        Number of rows that are kept.
    cuts_added, cuts_dropped : int
        Changes since the round before.
    relaxed_programs : int
        Number of relaxed programs solved so far.
    seconds : float
        Time since the start, in seconds.
    cost : float, default nan
        Cost of the decision, as the method minimises it.
    decision : ndarray, shape (n,), optional
        Decision of this round.
    separations : mapping of str to Separation
        Most violated constraints of each family at the decision, worst first.
    imposed : sequence of Cut
        Constraints of this round's relaxed program. The multiplier within each `Cut` is not filled.
    multipliers : ndarray, shape (r,)
        Multipliers of the imposed constraints.
    added, dropped : sequence of Cut
        Differences of ``imposed`` from the round before.
    simplified : bool, default False
        Whether the round solved a program with a part of the uncertainty only (methods ``nominal``, ``scenario``). Its
        ``upper_bound`` and ``violation`` then do not apply to the program itself; its lower bound holds for both.
    gap : float, default inf
        Relative gap of these two bounds (`sip.result.relative_gap`).
    proven : float, default inf
        Cost of the cheapest decision that was proven so far to meet every constraint.
    measured : str
        Name of the unit of ``violation``, where it is known.
    """

    round: int
    epsilon: float
    lower_bound: float = field(metadata=quantity("cost"))
    upper_bound: float = field(metadata=quantity("cost"))
    violation: float = field(metadata=quantity("row"))
    worst_family: str = ""
    active_indices: int = 0
    cuts_added: int = 0
    cuts_dropped: int = 0
    relaxed_programs: int = 0
    seconds: float = 0.0
    cost: float = field(default=np.nan, metadata=quantity("cost"))
    decision: Array | None = field(default=None, repr=False, metadata=quantity("decision"))
    separations: Mapping[str, Separation] = field(default_factory=dict, repr=False, metadata=quantity("separations"))
    imposed: Sequence[Cut] = field(default=(), repr=False, metadata=RECORDS)
    multipliers: Array = field(default_factory=lambda: np.zeros(0), repr=False, metadata=quantity("prices"))
    added: Sequence[Cut] = field(default=(), repr=False, metadata=RECORDS)
    dropped: Sequence[Cut] = field(default=(), repr=False, metadata=RECORDS)
    simplified: bool = False
    gap: float = np.inf
    proven: float = field(default=np.inf, metadata=quantity("cost"))
    measured: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProofProgress(Event):
    """Progress of a proof over the continuum.

    Parameters
    ----------
    family : str
        Name of the family.
    cells : int
        Number of open cells.
    bound : float
        Violation that is not yet excluded.
    seconds : float
        Time since the start of the proof, in seconds.
    examined : int
        Number of cells that were bounded so far.
    budget : int
        Number of cells after which the proof is given up; 0: unknown.
    bound_before : float, default nan
        The ``bound`` of half a minute ago; NaN while the proof is younger.
    hindrance : str
        Reason for slow progress and a remedy, where the bound has hardly fallen since ``bound_before``; empty
        otherwise.
    measured : str
        Name of the unit of ``bound``, where it is known.
    """

    family: str
    cells: int
    bound: float = field(metadata=quantity("bound"))
    seconds: float = 0.0
    examined: int = 0
    budget: int = 0
    bound_before: float = field(default=np.nan, metadata=quantity("bound"))
    hindrance: str = ""
    measured: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class StageProgress(Event):
    """Progress of an auxiliary program of a method.

    Parameters
    ----------
    text : str
        Name of the program, a colon, and its progress.
    """

    text: str


@dataclass(frozen=True, kw_only=True, eq=False)
class EvaluationsFinished(Event):
    """Further evaluations of a maximiser.

    A search is over the tuples of the method ``sparserob`` in the outer iteration ``round``. Or, where ``family`` is
    given, it is over the indices of that family, for the most violated one. A new search begins where ``total ==
    count``.

    Parameters
    ----------
    count : int
        Number of evaluations since the last event.
    total : int
        Number of evaluations so far in this search.
    best_value : float
        Largest value so far.
    seconds : float
        Time since the search began, in seconds.
    notes : mapping of str to float
        Scalars of the maximiser (temperature, ...), the last of each.
    budget : int, default 0
        Evaluations that the search may spend; 0: unknown.
    best_point : ndarray, shape (d,)
        Point of the best value.
    domain : Box, optional
        Box that is searched.
    block : int, default 1
        Number of consecutive coordinates of the domain that are one index.
    phase : {"search", "polish"}
        Phase of the search to which all these evaluations belong.
    family : str
        Family whose most violated index is sought; empty for a search over tuples.
    round : int
        Number of the outer iteration, from 1.
    epsilon : float, default nan
        Weight of the regulariser.
    lower_bound : float, default -inf
        Lower bound proven so far.
    batch : Batch
        All of these evaluations.
    sketches : mapping of str to Sketch
        Sketches by their roles, shown since the last event.
    coordinates : tuple of int, length c
        Coordinates of an index that can move and that are not kept linear (`LinearBlocks`).
    deciding : ndarray of int, shape (count, 4)
        For each tuple, the indices whose constraints have the largest multipliers, largest first
        (`TupleValue.deciding`). The entry is -1 where fewer have a multiplier. The shape is ``(0, 4)`` where this is
        not known.
    """

    count: int
    total: int
    best_value: float = field(metadata=quantity("value"))
    seconds: float = 0.0
    notes: Mapping[str, float] = field(default_factory=dict)
    budget: int = 0
    best_point: Array = field(default_factory=lambda: np.zeros(0), repr=False, metadata=quantity("index"))
    domain: Box | None = field(default=None, repr=False, metadata=quantity("box"))
    block: int = 1
    phase: Phase = "search"
    family: str = ""
    round: int = 0
    epsilon: float = np.nan
    lower_bound: float = field(default=-np.inf, metadata=quantity("cost"))
    batch: Batch = field(default_factory=Batch, repr=False, metadata=RECORDS)
    sketches: Mapping[str, Sketch] = field(default_factory=dict, repr=False, metadata=RECORDS)
    coordinates: tuple[int, ...] = ()
    deciding: np.ndarray = field(default_factory=lambda: np.zeros((0, DECIDING), dtype=int), repr=False)
