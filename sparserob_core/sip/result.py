"""Result of a method: a decision, a lower and an upper bound of the optimal value, and the proofs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.quantities import RECORDS, Quantity, quantity
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


# Where terms of the cost cancel, the gap is relative to at least this share of their sizes. With a tenth of it,
# rounding (1e-16 of the terms, some hundred times) opens a gap of 1e-7. With ten times as much, fewer than seven digits
# are demanded of a cost that is a hundred-thousandth of its terms.
SMALL_COST = 1e-6
COLUMNS = ("outer", "epsilon", "value", "bound", "seconds")
NOTE = "note_"
MAX_COORDINATES_KEPT = 500_000  # largest number of coordinates of tuples that a run keeps


@dataclass(frozen=True, eq=False)
class SearchTrace:
    """Every evaluation of ``g`` in a run, in order.

    Parameters
    ----------
    outer : ndarray, shape (n,)
        Outer iteration of each evaluation.
    epsilon : ndarray, shape (n,)
        Weight of the regulariser.
    value : ndarray, shape (n,)
        Value of ``g``.
    bound : ndarray, shape (n,)
        Best lower bound of the unregularised semi-infinite program that was proven until then.
    seconds : ndarray, shape (n,)
        Time since the start, in seconds.
    points : ndarray, shape (n, d)
        Tuples of indices; ``(n, 0)`` where all of them would be more than `MAX_COORDINATES_KEPT` numbers.
    notes : mapping of str to ndarray, shape (n,)
        Scalars that the maximiser noted, one column for each name; NaN where it noted nothing.
    polished : ndarray of bool, shape (n,)
        True where the local method at the end of the search evaluated; all false by default.
    """

    outer: Array
    epsilon: Array
    value: Array = field(metadata=quantity("cost"))
    bound: Array = field(metadata=quantity("cost"))
    seconds: Array
    points: Array = field(default_factory=lambda: np.zeros((0, 0)), repr=False, metadata=quantity("index"))
    notes: Mapping[str, Array] = field(default_factory=dict, repr=False)
    polished: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=bool), repr=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        if not self.polished.size:
            object.__setattr__(self, "polished", np.zeros(self.value.size, dtype=bool))

    @staticmethod
    def of(outer: int, epsilon: float, trace: Trace, bounds: Array, began: float) -> SearchTrace:
        """Return the trace of one outer iteration.

        Parameters
        ----------
        outer : int
            Number of the outer iteration.
        epsilon : float
            Weight of the regulariser.
        trace : Trace
            Evaluations of the search.
        bounds : ndarray, shape (n,)
            Best lower bound proven until each evaluation.
        began : float
            Seconds from the start of the run to the start of the search.

        Returns
        -------
        SearchTrace
            The trace of this iteration.
        """
        count = trace.values.size
        notes = {}
        for name, rows in trace.notes.items():
            last = rows[rows[:, 0] >= 1]
            notes[name] = np.full(count, np.nan)
            notes[name][last[:, 0].astype(int) - 1] = last[:, 1]
        points = trace.points if 0 < trace.points.size <= MAX_COORDINATES_KEPT else np.zeros((count, 0))
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
        """Rise ``(n,)`` of each value above that of the point at which its search stood (`sip.events.gains`)."""
        judged = self.notes.get("accepted", np.zeros(self.value.size))
        rises = np.full(self.value.size, np.nan)
        for outer in np.unique(self.outer):
            is_outer = self.outer == outer
            rises[is_outer] = gains(self.value[is_outer], judged[is_outer] != 0.0)
        return rises

    @staticmethod
    def joined(parts: Sequence[SearchTrace]) -> SearchTrace:
        """Return one trace of all outer iterations, from the traces of each; points are left out where they are too
        many."""
        outer, epsilon, value, bound, seconds = (
            np.concatenate([getattr(trace, name) for trace in parts]) for name in COLUMNS
        )
        kept = (
            len({trace.points.shape[1] for trace in parts}) == 1
            and sum(trace.points.size for trace in parts) <= MAX_COORDINATES_KEPT
        )
        points = np.concatenate([trace.points for trace in parts]) if kept else np.zeros((value.size, 0))
        names = dict.fromkeys(name for trace in parts for name in trace.notes)
        notes = {
            name: np.concatenate([trace.notes.get(name, np.full(trace.value.size, np.nan)) for trace in parts])
            for name in names
        }
        polished = np.concatenate([trace.polished for trace in parts])
        return SearchTrace(outer, epsilon, value, bound, seconds, points, notes, polished)

    def arrays(self) -> dict[str, Array]:
        """Return the arrays of ``evaluations.npz``: the columns, ``points``, ``polished``, and ``note_...`` for each
        noted name."""
        notes = {f"{NOTE}{name}": column for name, column in self.notes.items()}
        return {
            **{name: getattr(self, name) for name in COLUMNS},
            **({"points": self.points} if self.points.size else {}),
            **({"polished": self.polished.astype(np.int8)} if self.polished.any() else {}),
            **notes,
        }

    @staticmethod
    def stored(arrays: Mapping[str, Array]) -> SearchTrace:
        """Return the trace that `arrays` stored; raise `KeyError` for a missing column."""
        notes = {name.removeprefix(NOTE): column for name, column in arrays.items() if name.startswith(NOTE)}
        outer, epsilon, value, bound, seconds = (arrays[name] for name in COLUMNS)
        points = arrays.get("points", np.zeros((value.size, 0)))
        polished = arrays.get("polished", np.zeros(value.size, dtype=bool))
        return SearchTrace(outer, epsilon, value, bound, seconds, points, notes, polished.astype(bool))


@dataclass(frozen=True, eq=False, kw_only=True)
class Result:
    """Outcome of a method.

    Parameters
    ----------
    status : Status
        Claim of the method: one of the keys of `MEANING`.
    message : str
        The reason for the status, for a reader.
    decision : ndarray, shape (n,), optional
        The decision that is returned; ``None`` where there is none.
    cost : float, default nan
        ``J`` at the decision, without the regulariser.
    value : float, default nan
        ``J + epsilon rho`` at the decision.
    epsilon : float, default 0
        Last weight of the regulariser.
    lower_bound : float, default -inf
        Lower bound of the value of the *unregularised* semi-infinite program, always proven.
    upper_bound : float, default inf
        Upper bound of that value. The bound is the cost where the status is certified or verified, and infinite where
        nothing is proven of the decision.
    worst : WorstConstraint, optional
        The most violated constraint at the decision.
    indices : sequence of Cut
        Imposed constraints of the last relaxed program, with their multipliers.
    counts : mapping of str to int
        Numbers of programs, rounds and the like.
    solved_by : mapping of str to int
        Solvers whose answers to relaxed programs were accepted, with the number of programs
        (`RelaxedProgram.solved_by`).
    unanswered : sequence of Unanswered
        Programs that the named solver did not answer, and the reasons.
    history : sequence of RoundFinished
        One record for each round.
    trace : SearchTrace, optional
        Every value of ``g``, for a method that searches.
    dual : Dual
        Multipliers that prove ``lower_bound``, or that nothing is feasible.
    proofs : sequence of Proof
        Proof of each constraint family at the decision.
    scenario_bound : ScenarioBound, optional
        Guarantee of the scenario theory, for the scenario approach.
    infeasible : InfeasibleSubsystem, optional
        Reasons for infeasibility.
    seconds : float
        Duration, in seconds.
    cost_scale : float
        Sum of the sizes of the terms of the cost (`SemiInfiniteProgram.added`).
    stopped : str
        The limit or the interrupt that ended the method early, in words; empty otherwise.
    ray : ndarray, shape (n,), optional
        Direction along which the cost falls without bound, where one was found.
    missed : float, optional
        Largest residual of an equality at the decision, relative to the numbers that are added up in it. The residual
        is computed and not proven; it is at most `EQUALITY` where something is claimed. ``None`` without equalities.
    errors : EqualityErrors, optional
        Proven bounds of these residuals, where the program offers them and something is claimed.
    activity : Activity, optional
        Bounds of the least count of the program, where it has a count.
    sparsest : Sparsest, optional
        Record of a method whose cost is that count, not ``J``.
    """

    status: Status = field(metadata=quantity("", "what was proven; see method.md", certified="status"))
    message: str = field(metadata=quantity("", "the result in a sentence, or why there is none"))
    decision: Array | None = field(default=None, metadata=quantity("decision"))
    cost: float = field(
        default=np.nan,
        metadata=quantity("cost", "J of the returned control, without the regulariser", "cost", certified="cost"),
    )
    value: float = field(default=np.nan, metadata=quantity("cost", "J and the weighted regulariser"))
    epsilon: float = field(default=0.0, metadata=quantity("1", "weight of the regulariser that was solved"))
    lower_bound: float = field(
        default=-np.inf,
        metadata=quantity("cost", "proven lower bound of the least cost", "lower bound", certified="lower_bound"),
    )
    upper_bound: float = field(
        default=np.inf,
        metadata=quantity(
            "cost", "proven upper bound; empty unless the status is certified or verified", "upper bound", proven=True
        ),
    )
    cost_scale: float = field(default=0.0, metadata=quantity("cost", "what is added up to the cost", recent=True))
    stopped: str = field(default="", metadata=quantity("", "the limit that ended the run early", recent=True))
    worst: WorstConstraint | None = field(default=None, metadata=RECORDS)
    indices: Sequence[Cut] = field(default=(), metadata=RECORDS)
    counts: Mapping[str, int] = field(default_factory=dict)
    solved_by: Mapping[str, int] = field(default_factory=dict)
    unanswered: Sequence[Unanswered] = ()
    history: Sequence[RoundFinished] = field(default=(), metadata=RECORDS)
    trace: SearchTrace | None = field(default=None, metadata=RECORDS)
    dual: Dual = field(default=NO_BOUND, metadata=RECORDS)
    proofs: Sequence[Proof] = field(default=(), metadata=RECORDS)
    scenario_bound: ScenarioBound | None = None
    infeasible: InfeasibleSubsystem | None = None
    seconds: float = field(default=0.0, metadata=quantity("s", "what the method took"))
    ray: Array | None = field(default=None, metadata=quantity("decision"))
    missed: float | None = None
    errors: EqualityErrors | None = field(default=None, metadata=RECORDS)
    activity: Activity | None = None
    sparsest: Sparsest | None = field(default=None, metadata=RECORDS)

    DERIVED: ClassVar[Mapping[str, Quantity]] = {
        "gap": Quantity(
            "1", "relative distance of the bounds", "relative gap", form=".2e", proven=True, after="upper_bound"
        )
    }

    def accounted(self, solver: Solver) -> Result:
        """Return this result with the account of a `Named` solver: its failures, and the number of all its calls.

        The calls include those for programs other than the relaxed ones. The result of any other solver is returned
        unchanged.
        """
        if not isinstance(solver, Named):
            return self
        counts = {**self.counts, "solver_calls": solver.failures.calls}
        return replace(self, unanswered=tuple(solver.failures), counts=counts)

    def charged(self, others: Iterable[Result]) -> Result:
        """Return this result with the relaxed programs of ``others``, solved on the way, added to its counts."""
        solved_by, programs = Counter(self.solved_by), self.counts.get("relaxed_programs", 0)
        for result in others:
            solved_by.update(result.solved_by)
            programs += result.counts.get("relaxed_programs", 0)
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
        """Unit of the cost after a blank, where it is known."""
        return ""

    @property
    def gap(self) -> float:
        """Relative gap of the two bounds."""
        return relative_gap(self.lower_bound, self.upper_bound, self.cost_scale)


def relative_gap(lower: float, upper: float, added: float = 0.0) -> float:
    """Return the gap ``(upper - lower) / max(|upper|, |lower|, SMALL_COST * added)`` of two bounds.

    Parameters
    ----------
    lower, upper : float
        Bounds of the optimal value.
    added : float, default 0
        Sum of the absolute numbers that were added up to the cost. The gap is relative to at least `SMALL_COST` of it.

    Returns
    -------
    float
        The gap; 0 where the bounds are equal or cross, which they do by no more than the proofs allow; infinite where a
        bound is infinite.
    """
    if not (np.isfinite(lower) and np.isfinite(upper)):
        return float("inf")
    return 0.0 if upper <= lower else float((upper - lower) / max(abs(lower), abs(upper), SMALL_COST * added))
