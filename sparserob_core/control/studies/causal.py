"""The search of a bound against every causal policy: which signals the tree should hold."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, final

import numpy as np

from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.feedback.knowledge import Knowledge, extreme
from sparserob_core.control.feedback.tree import Grown, Sampled, Tree
from sparserob_core.control.policies.policy import Charge
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.result import Result

Ended: TypeAlias = Literal["settled", "signals", "work", "seconds"]

MAX_SHARE_SUM = 1.0 - 2.0**-40  # what shares add up to at most: with rounding no more than 1
INWARD_FACTOR = 1.0 - 1e-13  # points that must be in a curved set are drawn inwards by rounding
SIGNALS_PER_ROUND = 8  # signals that a round adds
TOWARDS = 0.9  # of the way from the bound to the policy's cost: the budget at which the tree is asked for room
NEGLIGIBLE_RELAXATION = 1e-9  # a relaxation below is rounding
# Rounds without a better bound, after which more of them are a bonus: where a limit ends these, the search has settled.
IDLE_ROUNDS = 4
# Shares of the policy's answers, with which the worst signals are sought after so many rounds without a better bound;
# the search ends with the last. Policies that cost as little answer differently: with the first share alone one of them
# led to 0.433 where others led to 0.448, and with another share after every round, or after three, one led to 0.424.
ANSWERED = (1.0, 1.0, 1.0, 1.0, 0.5, 0.0)
WORK, EACH, PER = 1e7, 2e6, 3e3  # that a search may do anyway; for each of a run's programs, and for its columns
MAX_TREE_NUMBERS = 2e7  # numbers of one kind about all signals of a tree: 160 MB
TIMES_PER_PIECE = 1  # times sampled within every piece, beside its ends and the times that the policy's bound rests on
FACTOR_ALLOWANCE = 1e-6  # of a factor, by which the first one that is excluded lies above the largest one that is not


@final
@dataclass(frozen=True, eq=False)
class Weighed:
    """A constraint ``direction'x(time)`` under the signal of that number, with its multiplier."""

    signal: int
    constraint: str
    time: float
    direction: Array
    multiplier: float


@final
@dataclass(frozen=True, eq=False)
class CausalBound:
    """Lower bound of the cost of every causal policy, with the signals and constraints that prove it.

    Parameters
    ----------
    lower : float
        Proven lower bound of the cost. It is infinite where no causal policy exists, and ``-inf`` where nothing was
        proven.
    signals : tuple of ndarray, shape (mw, blocks)
        Values of the disturbance.
    rows : tuple of Weighed
        Constraints under the signals, whose multipliers prove the bound.
    ended : str
        Reason why the search ended.
    shares : tuple of float
        Weight of the effort under every signal, with the cost ``worst``; at most 1 together.
    """

    lower: float
    signals: tuple[Array, ...] = ()
    rows: tuple[Weighed, ...] = ()
    ended: Ended = "settled"
    shares: tuple[float, ...] = ()


@final
class CausalLimits:
    """Limits at which a search ends.

    Parameters
    ----------
    signals : int
        Largest number of signals, in addition to those at hand.
    work : float
        Largest work, a count that is the same on every machine.
    seconds : float
        Longest time, as a brake.
    passed : callable
        Function that says whether the time of the run is over.
    """

    def __init__(self, signals: int, work: float, seconds: float, passed: Callable[[], bool]) -> None:
        self.work, self._signal_limit, self._is_run_over = work, signals, passed
        self._initial_count = 0
        self._deadline = time.perf_counter() + seconds
        self.ended: Ended = "settled"

    @staticmethod
    def of(charge: Charge, results: Sequence[Result], columns: int, passed: Callable[[], bool]) -> CausalLimits:
        """Return limits that are proportional to the work for the policy's own ``results``, with ``columns`` of their
        programs."""
        programs = sum(result.counts.get("relaxed_programs", 0) for result in results)
        return CausalLimits(
            charge.causal_signals, WORK + programs * (EACH + PER * columns), charge.causal_seconds, passed
        )

    @property
    def seconds(self) -> float:
        """Number of seconds that are left."""
        return max(0.0, self._deadline - time.perf_counter())

    def passed(self) -> bool:
        """Return whether the time of the search, or that of the run, is over."""
        return not self.seconds or self._is_run_over()

    def over(self, tree: Tree, idle: int = 0) -> bool:
        """Return whether the search for a tree ends after so many ``idle`` rounds, and record the reason in
        ``ended``."""
        s = tree.sampled
        signal_limit = MAX_TREE_NUMBERS / max(1, s.T.shape[0] * max(s.N.shape[1], s.T.shape[1] * s.T.shape[2]))
        if self.passed():
            self.ended = "seconds"
        elif tree.work > self.work or len(tree.signals) > signal_limit:
            self.ended = "work"
        elif not self.room(tree):
            self.ended = "signals"
        over = self.ended != "settled"
        if idle >= IDLE_ROUNDS and self.ended != "seconds":
            self.ended = "settled"
        return over

    def begin(self, tree: Tree) -> None:
        """Exclude the signals that the tree already holds from the count."""
        self._initial_count = len(tree.signals)

    def room(self, tree: Tree) -> int:
        """Return the number of signals that may still be added to the tree; before the search begins always 1, so that
        there is no limit."""
        return self._signal_limit + self._initial_count - len(tree.signals) if self._initial_count else 1


@final
class CausalSearch:
    """The search for one problem under a policy, ``model``, at its ``decision``, where there is one; ``active``: names,
    times and deviations of the constraints that the policy's own bound rests on."""

    def __init__(
        self, model: Transcription, decision: Array | None, active: Sequence[tuple[str, float, Array | None]]
    ) -> None:
        self.model, self.loop, self.decision = model, model.answering.loop, decision
        flat = [constraint for constraint in model.constraints if isinstance(constraint, FlatConstraint)]
        # a bound of fewer constraints is one still
        self.constraints = [
            constraint for constraint in flat if constraint.gains is None and not constraint.reference.moves
        ]
        grid, disturbance = model.response.grid, model.functionals.disturbance
        places = np.zeros(0, dtype=int) if disturbance is None or disturbance.starts is None else disturbance.starts
        self.starts = grid.breakpoints[places]
        self.spread = Spread(() if disturbance is None else self.loop.spread.sets[:1])
        requests = [
            (constraint.H, constraint.h, self._sample_times(constraint, active)) for constraint in self.constraints
        ]
        self.sampled = Sampled.of(self.loop, requests)
        self._active = active

    def _sample_times(self, one: FlatConstraint, active: Sequence[tuple[str, float, Array | None]]) -> Array:
        points = self.model.response.grid.breakpoints
        shares = np.arange(1, TIMES_PER_PIECE + 1) / (TIMES_PER_PIECE + 1)
        inner = (points[:-1, None] + np.diff(points)[:, None] * shares).ravel()
        inside = np.concatenate([points, inner])
        own = [at for name, at, _ in active if name == one.name and one.start <= at <= one.stop]
        return np.unique([one.start, one.stop, *own, *inside[(inside > one.start) & (inside < one.stop)]])

    def tree(self, limits: CausalLimits, highest: float | None = None) -> Tree:
        """A tree of the nominal signal and those that the policy's bound rests on, of which a control knows all that
        the disturbance does until the last measurement that is known: outputs tell no more."""
        points, measured, s = self.model.control.breakpoints, self.model.problem.measurements, self.sampled
        known_counts = np.searchsorted(self.starts, points[:-1] if measured is None else measured.latest(points))
        width, block_counts = self.spread.size // max(1, self.starts.size), np.searchsorted(self.starts, s.time)
        signals = [extreme(self.spread, z) for _, _, z in self._active if z is not None and z.any()]
        problem, prices = self.model.problem, self.model.problem.prices(points)
        knowledge = Knowledge(s.N, self.spread, width, known_counts, block_counts)
        tree = Tree(s, knowledge, problem.control, prices, self.model.answering.charge.cost, highest)
        tree.seconds = lambda: limits.seconds
        tree.add(knowledge.nominal)
        for z in signals:
            if not limits.over(tree):
                tree.add(z)
        limits.begin(tree)
        return tree

    def least_cost(self, cost: float, limits: CausalLimits) -> tuple[Tree, Grown, bool] | None:
        """The tree that was found, its multipliers, and whether they prove that no causal policy exists; ``cost``: of
        the policy, an upper bound of what the tree can prove, infinite where none is known."""
        tree = self.tree(limits)
        best, idle = tree.least(), 0
        while best is not None and idle < len(ANSWERED) and not limits.over(tree, idle):
            aim = cost if np.isfinite(cost) else np.inf
            centre = tree.relaxed(best.value + TOWARDS * max(aim - best.value, 0.0), central=True)
            if centre is None or not self._grow(tree, centre, limits.room(tree), idle):
                break
            better = tree.least()
            if better is None:  # nothing is feasible, or the solver did not finish
                refused = self._prove_infeasibility(tree)
                return (tree, best, False) if refused is None else (tree, refused, True)
            idle = 0 if better.value > best.value + NEGLIGIBLE_RELAXATION * abs(better.value) else idle + 1
            best = better
        if best is not None:
            return tree, best, False
        refused = self._prove_infeasibility(tree)
        return None if refused is None else (tree, refused, True)

    @staticmethod
    def _prove_infeasibility(tree: Tree) -> Grown | None:
        multipliers = tree.relaxed()
        return multipliers if multipliers is not None and multipliers.value > NEGLIGIBLE_RELAXATION else None

    def largest_factor(self, highest: float, limits: CausalLimits) -> tuple[Tree, Grown] | None:
        """The largest factor of all deviations for which the tree is feasible, with its multipliers."""
        tree = self.tree(limits, highest)
        best, idle = tree.least(), 0
        while best is not None and idle < len(ANSWERED) and not limits.over(tree, idle):
            if not self._grow(tree, best, limits.room(tree), idle):
                break
            better = tree.least()
            if better is None:
                break
            idle = 0 if better.value < best.value * (1.0 - FACTOR_ALLOWANCE) else idle + 1
            best = better
        return None if best is None else (tree, best)

    def _grow(self, tree: Tree, centre: Grown, limit: int, idle: int) -> bool:
        """Add signals that are the worst if the control answers a share of what the policy answers, and return whether
        there are new ones.

        The share is that of so many ``idle`` rounds; the other shares follow where it gives nothing new.
        """
        shares = ANSWERED if self.decision is not None else (0.0,)
        at = min(idle, len(shares) - 1)
        return any(
            self._add_departures(tree, centre, limit, share) for share in dict.fromkeys((*shares[at:], *shares[:at]))
        )

    def _add_departures(self, tree: Tree, centre: Grown, limit: int, share: float) -> bool:
        """Add signals that depart from a signal of the tree at a report and are the worst for a row from there on, and
        return whether there are new ones.

        The control is assumed to answer them by this ``share`` of what the policy answers. The signals with the largest
        excess are added, at most one for each signal of the tree and report.
        """
        effects = None if self.decision is None else share * self.loop.effects(self.decision)
        own = np.einsum("rmk,smk->sr", self.sampled.T, centre.u) - self.sampled.b
        scale = 1.0 if tree.priced else max(centre.x[0], NEGLIGIBLE_RELAXATION)
        answered = None if effects is None else np.einsum("rmk,kmq->rq", self.sampled.T, effects)
        departures, z = set[tuple[int, int]](), np.array(tree.signals)
        tree.work += z.shape[0] * (self.sampled.N.size + self.sampled.T.size)
        for signal, report, child in tree.knowledge.leaving(z, own, answered, scale, tree.units):
            if len(departures) >= min(SIGNALS_PER_ROUND, limit):
                break
            if (signal, report) not in departures and tree.add(child):
                departures.add((signal, report))
        return bool(departures)

    def bound(
        self,
        tree: Tree,
        found: Grown,
        lower: float,
        disturbance: ConvexSet | None,
        ended: Ended = "settled",
        scale: float = 1.0,
    ) -> CausalBound:
        """The signals in the set of the ``disturbance``, with deviations times ``scale``, and the constraints that have
        a multiplier."""
        numbers, deviations, rows = dict[bytes, int](), list[Array](), list[Weighed]()

        def number(z: Array) -> int:
            position = numbers.setdefault(z.tobytes(), len(numbers))
            deviations.extend([z * scale] * (position == len(deviations)))
            return position

        for signal, row, report, y in zip(found.signals, found.rows, found.reports, found.multipliers, strict=True):
            index = number(tree.changed(int(signal), int(row), int(report)))
            constraint, s = self.constraints[self.sampled.constraint[row]], self.sampled
            rows.append(Weighed(index, constraint.name, float(s.time[row]), constraint.H[s.side[row]], float(y)))
        weights = dict[int, float]()
        for signal in np.flatnonzero(found.shares).tolist() if np.isfinite(lower) else ():
            index = number(tree.signals[signal])
            weights[index] = weights.get(index, 0.0) + float(found.shares[signal])
        total = max(1.0, sum(weights.values())) / MAX_SHARE_SUM
        shares = tuple(weights.get(index, 0.0) / total for index in range(len(deviations)) if weights)
        signals = tuple(_place_in_set(z, disturbance, self.starts.size) for z in deviations)
        return CausalBound(lower, signals, tuple(rows), ended, shares)


def _place_in_set(z: Array, disturbance: ConvexSet | None, blocks: int) -> Array:
    """The disturbance ``(mw, blocks)`` of deviations, certainly in its set; 0 is exactly the middle."""
    if disturbance is None:
        return np.zeros((0, 0))
    middle, deviations = disturbance.middle(), z.reshape(blocks, -1)
    if disturbance.is_box:
        box = disturbance.bounding_box()
        values = np.clip(middle + deviations, box.lower, box.upper)
    else:
        values = middle + INWARD_FACTOR * deviations
    return np.asarray(np.where(deviations == 0.0, middle, values).T)
