"""What a method returns: a decision, two bounds that are meant to meet, and what was proven of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished, gains
from sparserob_core.sip.evidence import NO_BOUND, Activity, Cut, Dual, InfeasibleSubsystem, Proof, Sparsest
from sparserob_core.sip.program import EqualityErrors, WorstConstraint
from sparserob_core.sip.solver import Named, Solver, Unanswered

if TYPE_CHECKING:
    from sparserob_core.sip.maximiser import Trace
    from sparserob_core.sip.scenario_bound import ScenarioBound

Status: TypeAlias = Literal["certified", "verified", "infeasible", "refuted", "undecided", "failed"]

MEANING: Mapping[Status, str] = {
    "certified": "the constraints are proven for the whole continuum and the gap is closed",
    "verified": "the constraints are proven for the whole continuum, but the gap is not closed",
    "infeasible": "no decision satisfies the constraints; the multipliers prove it",
    "refuted": "a witness violates the constraints",
    "undecided": "no violation was found, but none was excluded",
    "failed": "no checked answer was reached",
}


# A cost that is left of numbers that cancel is judged as if it were at least this share of them. With a tenth of it,
# rounding (1e-16 of them, some hundred times) opens a gap of 1e-7; with ten times as much, seven digits of a cost that
# is a hundred-thousandth of them are not asked for.
SMALL_COST = 1e-6
COLUMNS = ("outer", "epsilon", "value", "bound", "seconds")
NOTE = "note_"
POINTS = 500_000  # coordinates of tuples that a run keeps


@dataclass(frozen=True, eq=False)
class SearchTrace:
    """Every evaluation of ``g``, in order: the outer iteration ``outer (n,)`` and its ``epsilon (n,)``, the
    ``value (n,)`` of ``g``, the best lower bound ``bound (n,)`` proven until then of the unregularised semi-infinite
    program, and ``seconds (n,)`` since the start.

    ``points (n, d)``: the tuples, ``(n, 0)`` where all of them would be more than `POINTS` numbers. ``notes``: what the
    maximiser noted, one column ``(n,)`` for each name, NaN where it noted nothing. ``polished (n,)``: whether it was
    the local method at the end of the search that evaluated.
    """

    outer: Array
    epsilon: Array
    value: Array
    bound: Array
    seconds: Array
    points: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False)
    notes: Mapping[str, Array] = field(default_factory=dict, repr=False)
    polished: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool), repr=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        if not self.polished.size:
            object.__setattr__(self, "polished", np.zeros(self.value.size, dtype=bool))

    @staticmethod
    def of(outer: int, epsilon: float, trace: Trace, bounds: Array, began: float) -> SearchTrace:
        """One outer iteration, whose search began ``began`` seconds after the start."""
        count = trace.values.size
        notes = {}
        for name, rows in trace.notes.items():
            last = rows[rows[:, 0] >= 1]
            notes[name] = np.full(count, np.nan)
            notes[name][last[:, 0].astype(int) - 1] = last[:, 1]
        points = trace.points if 0 < trace.points.size <= POINTS else np.zeros((count, 0))
        polished = np.arange(count) >= (count if trace.searched is None else trace.searched)
        return SearchTrace(
            np.full(count, outer),
            np.full(count, epsilon),
            trace.values,
            bounds,
            began + trace.seconds,
            points,
            notes,
            polished,
        )

    @property
    def gains(self) -> Array:
        """By how much each value ``(n,)`` is above that where the walk of its search stood (`sip.events.gains`)."""
        judged = self.notes.get("accepted", np.zeros(self.value.size))
        found = np.full(self.value.size, np.nan)
        for outer in np.unique(self.outer):
            mine = self.outer == outer
            found[mine] = gains(self.value[mine], judged[mine] != 0.0)
        return found

    @staticmethod
    def joined(parts: Sequence[SearchTrace]) -> SearchTrace:
        """All outer iterations."""
        outer, epsilon, value, bound, seconds = (
            np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS
        )
        kept = len({part.points.shape[1] for part in parts}) == 1 and sum(part.points.size for part in parts) <= POINTS
        points = np.concatenate([part.points for part in parts]) if kept else np.zeros((value.size, 0))
        names = dict.fromkeys(name for part in parts for name in part.notes)
        notes = {
            name: np.concatenate([part.notes.get(name, np.full(part.value.size, np.nan)) for part in parts])
            for name in names
        }
        polished = np.concatenate([part.polished for part in parts])
        return SearchTrace(outer, epsilon, value, bound, seconds, points, notes, polished)

    def arrays(self) -> dict[str, Array]:
        """``evaluations.npz``: the columns, ``points``, ``polished``, and ``note_...`` for each name that was noted."""
        notes = {f"{NOTE}{name}": column for name, column in self.notes.items()}
        return {
            **{name: getattr(self, name) for name in COLUMNS},
            **({"points": self.points} if self.points.size else {}),
            **({"polished": self.polished.astype(np.int8)} if self.polished.any() else {}),
            **notes,
        }

    @staticmethod
    def stored(arrays: Mapping[str, Array]) -> SearchTrace:
        """The same from `arrays`; raises `KeyError` for a column that is missing."""
        notes = {name.removeprefix(NOTE): column for name, column in arrays.items() if name.startswith(NOTE)}
        outer, epsilon, value, bound, seconds = (arrays[name] for name in COLUMNS)
        points = arrays.get("points", np.zeros((value.size, 0)))
        polished = arrays.get("polished", np.zeros(value.size, dtype=bool))
        return SearchTrace(outer, epsilon, value, bound, seconds, points, notes, polished.astype(bool))


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """The outcome of a method.

    ``cost`` is ``J`` of ``decision`` (no regulariser), ``value`` is ``J + epsilon rho``; ``lower_bound`` and
    ``upper_bound`` enclose the value of the *unregularised* semi-infinite program. ``lower_bound`` is proven in any
    case; ``upper_bound`` is the cost where ``status`` is certified or verified, and infinite where nothing is proven of
    the decision. ``gap``: see `relative_gap`; ``cost_scale`` is what is added up to the cost
    (`SemiInfiniteProgram.added`). ``dual``: the multipliers behind ``lower_bound``, or behind infeasibility;
    ``proofs``: what was shown of every constraint family at the decision. ``trace``: for a method that searches, every
    value of ``g``; ``scenario_bound``: for the scenario approach, what its theory promises. ``stopped``: the limit or
    the interrupt that ended the method early, in words. ``ray (n,)``: a direction along which the cost falls for ever,
    where one was found. ``missed``: the most by which the decision misses an equality, relative to the numbers that are
    added up in it, where there are any; computed, not proven, and at most `EQUALITY` where something is claimed.
    ``errors``: what is proven of that, where the program offers it and something is claimed.
    ``activity``: between what the least count of the
    program lies, where it has one. ``sparsest``: there where the cost is that count, not J.
    ``solved_by``: whose answers to relaxed programs were believed, and how many (`RelaxedProgram.solved_by`).
    ``unanswered``: which programs the solver that was named did not answer, and why.
    """

    status: Status
    message: str
    decision: Array | None = None
    cost: float = np.nan
    value: float = np.nan
    epsilon: float = 0.0
    lower_bound: float = -np.inf
    upper_bound: float = np.inf
    worst: WorstConstraint | None = None
    indices: Sequence[Cut] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    solved_by: Mapping[str, int] = field(default_factory=dict)
    unanswered: Sequence[Unanswered] = ()
    history: Sequence[RoundFinished] = ()
    trace: SearchTrace | None = None
    dual: Dual = NO_BOUND
    proofs: Sequence[Proof] = ()
    scenario_bound: ScenarioBound | None = None
    infeasible: InfeasibleSubsystem | None = None
    seconds: float = 0.0
    cost_scale: float = 0.0
    stopped: str = ""
    ray: Array | None = None
    missed: float | None = None
    errors: EqualityErrors | None = None
    activity: Activity | None = None
    sparsest: Sparsest | None = None

    def accounted(self, solver: Solver) -> Result:
        """The same with the account of a solver that was `Named`: what it did not answer, and its calls, those of
        programs beside the relaxed ones included."""
        if not isinstance(solver, Named):
            return self
        counts = {**self.counts, "solver_calls": solver.failures.calls}
        return replace(self, unanswered=tuple(solver.failures), counts=counts)

    def charged(self, others: Iterable[Result]) -> Result:
        """The same with the programs of ``others``, which were solved on the way, on its account: how many they were,
        and whose answers."""
        solved_by, programs = Counter(self.solved_by), self.counts.get("relaxed_programs", 0)
        for other in others:
            solved_by.update(other.solved_by)
            programs += other.counts.get("relaxed_programs", 0)
        return replace(self, solved_by=dict(solved_by), counts={**self.counts, "relaxed_programs": programs})

    def __repr__(self) -> str:
        lines = [
            f"{type(self).__name__}: {self.status}: {self.message}",
            f"  cost: {self.cost:.9g}{self._unit}",
            f"  bounds: {self.lower_bound:.9g} to {self.upper_bound:.9g}{self._unit}",
            f"  gap: {self.gap:.2e}",
            f"  seconds: {self.seconds:.3f}",
        ]
        return "\n".join(lines)

    @property
    def _unit(self) -> str:
        """The unit of the cost after a blank, where it is known."""
        return ""

    @property
    def gap(self) -> float:
        """The relative gap of the two bounds."""
        return relative_gap(self.lower_bound, self.upper_bound, self.cost_scale)


def relative_gap(lower: float, upper: float, added: float = 0.0) -> float:
    """``(upper - lower) / max(|upper|, |lower|)``: 0 when both are equal, infinite when either bound is. Bounds that
    cross by no more than the proofs allow leave no gap. ``added``: the sum of the absolute numbers that were added up
    to the cost, `SMALL_COST` of which the gap is relative to at least."""
    if not (np.isfinite(lower) and np.isfinite(upper)):
        return float("inf")
    return 0.0 if upper <= lower else float((upper - lower) / max(abs(lower), abs(upper), SMALL_COST * added))
