"""The events of a running method or search; whoever receives them cannot disturb it.

Arrays in events cannot be written to. What takes time to put together is put together by whoever looks at it (`Batch`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Literal, TypeAlias, TypeVar

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.maximiser import Trace

if TYPE_CHECKING:
    from sparserob_core.sip.program import Separation


@dataclass(frozen=True, kw_only=True, eq=False)
class Event:
    """Something that happened in a run."""


SKETCHED = 400
"""Points, boxes or ellipsoids in one sketch, at most."""

UNCHANGED = 1e-10
"""Relative change of a value that is rounding. Of 1 700 moves over literal tuples 250 changed g by less than 1e-12, for
they moved a coordinate that does not enter the row, and all others by more than 1e-7; a thousandth of the limit, or a
hundred times it, would tell them apart as well, more would hide the last steps of a walk."""

Phase: TypeAlias = Literal["search", "polish"]
"""Who evaluates: the maximiser, or the local method that has the last share of its budget."""

DECIDING = 4
"""Indices that are told of each tuple, at most: two decide what is drawn, and may each have a neighbour."""

Notify: TypeAlias = Callable[[Event], None]
T = TypeVar("T", bound=Event)


def ignore(event: Event) -> None:
    """The listener that does nothing."""


def forwarded(notify: Notify, kind: type[T], complete: Callable[[T], Event]) -> Notify:
    """A listener that passes every event on to ``notify``, those of one ``kind`` as ``complete`` returns them; `ignore`
    stays `ignore`."""
    if notify is ignore:
        return ignore
    return lambda event: notify(complete(event) if isinstance(event, kind) else event)


def beside(notify: Notify, stage: str) -> Notify:
    """A listener to a program beside the one whose rounds are told: of its rounds it passes on that they go on, in this
    ``stage``, and how its proofs do."""
    if notify is ignore:
        return ignore

    def heard(event: Event) -> None:
        if isinstance(event, RoundFinished):
            notify(StageProgress(text=f"{stage}: round {event.round}, {event.active_indices} cuts"))
        elif isinstance(event, ProofProgress):
            notify(event)

    return heard


def frozen(array: Array) -> Array:
    """A view of an array that cannot be written to."""
    view = np.asarray(array).view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, eq=False)
class Batch:
    """The evaluations of a search since the last event: ``trace`` and ``moves`` are computed when they are first
    read.

    ``points`` and ``values`` are the pieces ``(k_i, d)`` and ``(k_i,)`` as they were evaluated, ``moments`` their sizes
    and seconds since the search began, ``notes`` per name the pairs (evaluations of the search so far, value).
    ``first`` evaluations came before, the best of which was ``best``; ``origin (d,)`` is where the walk stood then,
    ``None`` at the start, and ``stood`` the value there.
    """

    points: Sequence[Array] = ()
    values: Sequence[Array] = ()
    moments: Sequence[tuple[int, float]] = ()
    notes: Mapping[str, Sequence[tuple[float, float]]] = field(default_factory=dict)
    first: int = 0
    best: float = -np.inf
    origin: Array | None = None
    stood: float = np.nan

    @cached_property
    def trace(self) -> Trace:
        """The evaluations as a `Trace`; ``best`` and ``notes`` count from the beginning of the search."""
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
        """Rows ``(evaluation in the batch, coordinate)``, ``(k, 2)``: where each point differs from where the walk
        stood.

        That is the point accepted last where the maximiser notes ``accepted``, and the point before where it does not.
        The first point of a search has moved from nowhere, and is left out.
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
        """By how much each value is above that where the walk stood ``(k,)``, as `moves` has it; 0 for a move that
        changed nothing, NaN for the first value of a search."""
        return gains(self.trace.values, self.accepted, self.stood)

    @property
    def changes(self) -> np.ndarray:
        """Which of the values ``(k,)`` are others than that where the walk stood: a proposal that leaves the value as
        it is says nothing of a walk."""
        return np.asarray(np.nan_to_num(self.gains) != 0.0)

    @property
    def acceptance(self) -> float:
        """Of the moves that changed the value, the share that the walk accepted; NaN where there was none, or no
        walk."""
        judged = self.trace.notes.get("accepted", np.empty((0, 2)))[:, 0].astype(int) - 1 - self.first
        judged = judged[(judged >= 0) & (judged < self.gains.size)]
        changing = judged[self.changes[judged]]
        return float(self.accepted[changing].mean()) if changing.size else np.nan

    @cached_property
    def accepted(self) -> np.ndarray:
        """Whether the walk went on from each of the points ``(k,)``; always, where the maximiser does not walk."""
        accepted = np.ones(len(self.trace.points), dtype=bool)
        rows = self.trace.notes.get("accepted", np.empty((0, 2)))
        which = rows[:, 0].astype(int) - 1 - self.first
        mine = (which >= 0) & (which < accepted.size)
        accepted[which[mine]] = rows[mine, 1] > 0.0
        return accepted


def standing_before(accepted: np.ndarray) -> np.ndarray:
    """Which evaluation a walk stood at before each of them ``(k,)``, by which were ``accepted (k,)``; -1: one from
    before the first."""
    standing = np.maximum.accumulate(np.where(accepted, np.arange(accepted.size), -1))
    return np.concatenate([[-1], standing[:-1]])[: accepted.size]


def gains(values: Array, accepted: np.ndarray, stood: float = np.nan) -> Array:
    """By how much each of the ``values (k,)`` is above that where the walk stood, which was ``stood`` before the first;
    exactly 0 from ``-inf`` to ``-inf``, and where the two differ by rounding only (`UNCHANGED`)."""
    before = standing_before(accepted)
    at = np.where(before < 0, stood, values[before])
    gained = np.subtract(values, at, out=np.zeros(values.size), where=values != at)
    gained[np.abs(gained) <= UNCHANGED * np.where(np.isfinite(at), np.abs(at), 0.0)] = 0.0
    return gained


@dataclass(frozen=True, eq=False)
class Sketch:
    """What a maximiser looks at, or has ruled out: points, boxes, or the ellipsoids within boxes, from ``lower (k, d)``
    to ``upper (k, d)``, equal for points, at most `SKETCHED` of them."""

    lower: Array
    upper: Array
    rounded: bool = False

    @property
    def points(self) -> bool:
        """Whether it is points."""
        return self.lower is self.upper


@dataclass(frozen=True, kw_only=True, eq=False)
class RoundFinished(Event):
    """One round of a method is over: a round of the exchange, or an outer iteration of the method ``sparserob``.

    ``lower_bound`` and ``upper_bound`` enclose the value of the unregularised program (``-inf``, ``inf`` while
    unknown); ``violation`` is the worst constraint violation of this round's decision over the continuum, reached in
    ``worst_family``, in the unit ``measured`` where that is known; ``active_indices`` are the rows kept, ``cuts_added``
    and ``cuts_dropped`` the change since the round before; ``seconds`` since the start.

    ``decision (n,)`` has this ``cost``, of what the method minimises. ``separations``: per family what was found most
    violated at it, worst first.
    ``imposed``: the constraints of this round's relaxed program, with their ``multipliers (r,)`` (the multiplier within
    each `Cut` is not filled); ``added`` and ``dropped``: how they differ from those of the round before.
    ``gap``: the relative gap of the two bounds (`sip.result.relative_gap`).
    ``simplified``: it is a round on a program with some of the uncertainty only (methods ``nominal``, ``scenario``),
    whose ``upper_bound`` and ``violation`` say nothing of the program itself; its lower bound holds for both.
    ``proven``: the cost of the cheapest decision that was proven so far to meet every constraint.
    """

    round: int
    epsilon: float
    lower_bound: float
    upper_bound: float
    violation: float
    worst_family: str = ""
    active_indices: int = 0
    cuts_added: int = 0
    cuts_dropped: int = 0
    relaxed_programs: int = 0
    seconds: float = 0.0
    cost: float = np.nan
    decision: Array | None = field(default=None, repr=False)
    separations: Mapping[str, Separation] = field(default_factory=dict, repr=False)
    imposed: Sequence[Cut] = field(default=(), repr=False)
    multipliers: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    added: Sequence[Cut] = field(default=(), repr=False)
    dropped: Sequence[Cut] = field(default=(), repr=False)
    simplified: bool = False
    gap: float = np.inf
    proven: float = np.inf
    measured: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class ProofProgress(Event):
    """A proof over the continuum goes on: ``cells`` of ``family`` are still open, ``bound`` is the violation not yet
    excluded, in the unit ``measured`` where that is known.

    ``examined`` cells were bounded so far, of a ``budget`` after which the proof is given up (0: unknown).
    ``bound_before`` is the ``bound`` of half a minute ago, NaN while the proof is younger; where it has hardly fallen
    since, ``hindrance`` says what hinders the proof and what would help, and is empty otherwise.
    """

    family: str
    cells: int
    bound: float
    seconds: float = 0.0
    examined: int = 0
    budget: int = 0
    bound_before: float = np.nan
    hindrance: str = ""
    measured: str = ""


@dataclass(frozen=True, kw_only=True, eq=False)
class StageProgress(Event):
    """A method goes on with a program beside the one whose rounds are told; ``text`` says which up to a colon, and then
    how far it is."""

    text: str


@dataclass(frozen=True, kw_only=True, eq=False)
class EvaluationsFinished(Event):
    """A maximiser has evaluated ``count`` more points, ``total`` so far in this search, of ``budget`` (0: unknown).

    ``best_value`` was found at ``best_point (d,)``; ``seconds`` since the search began; ``notes`` are the maximiser's
    own scalars (temperature, ...), the last of each, and ``sketches`` by their roles what else it has shown of itself
    since the last event. A new search begins where ``total == count``. ``batch``: every one
    of these evaluations; they are of one ``phase`` of the search.

    What is searched: the tuples of the method ``sparserob`` in the outer iteration ``round`` (from 1) with the weight
    ``epsilon``, where ``lower_bound`` is proven so far; or, where ``family`` is named, its indices for the most
    violated one. ``block`` consecutive coordinates of the ``domain`` are one index, of which ``coordinates (c,)`` can
    move and are not those that stay linear (`LinearBlocks`). ``deciding (count, 4)``: of each of these tuples the
    indices whose constraints have the largest multipliers, the largest first, -1 where fewer have one
    (`TupleValue.deciding`); ``(0, 4)`` where that is not known.
    """

    count: int
    total: int
    best_value: float
    seconds: float = 0.0
    notes: Mapping[str, float] = field(default_factory=dict)
    budget: int = 0
    best_point: Array = field(default_factory=lambda: np.zeros(0), repr=False)
    domain: Box | None = field(default=None, repr=False)
    block: int = 1
    phase: Phase = "search"
    family: str = ""
    round: int = 0
    epsilon: float = np.nan
    lower_bound: float = -np.inf
    batch: Batch = field(default_factory=Batch, repr=False)
    sketches: Mapping[str, Sketch] = field(default_factory=dict, repr=False)
    coordinates: tuple[int, ...] = ()
    deciding: np.ndarray = field(default_factory=lambda: np.zeros((0, DECIDING), dtype=int), repr=False)
