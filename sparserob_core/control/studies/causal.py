"""The search of a bound against every causal policy: which signals the tree should hold."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, final

import numpy as np

from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.feedback.knowledge import Knowledge, OfDisturbances, OfOutputs, extreme
from sparserob_core.control.feedback.tree import Grown, Sampled, Tree
from sparserob_core.control.policies.policy import Charge
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.result import Result

Ended: TypeAlias = Literal["settled", "signals", "work", "seconds"]

SHARED = 1.0 - 2.0**-40  # what shares add up to at most: with rounding no more than 1
INWARDS = 1.0 - 1e-13  # points that must be in a curved set are drawn inwards by rounding
AT_ONCE = 8  # signals that a round adds
TOWARDS = 0.9  # of the way from the bound to the policy's cost: the budget at which the tree is asked for room
NONE = 1e-9  # a relaxation below is rounding
# Rounds without a better bound, after which more of them are a bonus: where a limit ends these, the search has settled.
IDLE = 4
# Shares of the policy's answers, with which the worst signals are sought after so many rounds without a better bound;
# the search ends with the last. Policies that cost as little answer differently: with the first share alone one of them
# led to 0.433 where others led to 0.448, and with another share after every round, or after three, one led to 0.424.
ANSWERED = (1.0, 1.0, 1.0, 1.0, 0.5, 0.0)
WORK, EACH, PER = 1e7, 2e6, 3e3  # that a search may do anyway; for each of a run's programs, and for its columns
CELLS = 2e7  # numbers of one kind about all signals of a tree: 160 MB
INSIDE = 1  # times sampled within every piece, beside its ends and the times that the policy's bound rests on
AGAIN = 4  # times that a noise hides its share of a smaller factor, each of which gains less than the one before
NARROWER = 1e-4  # of a factor, by which it must have come down for that
NEARLY = 1e-6  # of a factor, by which the first one that is excluded lies above the largest one that is not


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
    """What no causal policy can do: cost less than ``lower``; infinite: exist at all; ``-inf`` where nothing was
    proven. ``signals``: values ``(mw, blocks)`` of the disturbance, ``rows``: constraints under them whose multipliers
    prove it. ``ended``: why no more was sought. ``shares``: with the cost ``worst`` what the effort under every signal
    counts, no more than 1 together. Of outputs that a noise hides, ``outputs (K, p)``: what is measured under every
    signal beside the nominal one, and ``begun (d,)``: where it begins."""

    lower: float
    signals: tuple[Array, ...] = ()
    rows: tuple[Weighed, ...] = ()
    ended: Ended = "settled"
    shares: tuple[float, ...] = ()
    outputs: tuple[Array, ...] = ()
    begun: tuple[Array, ...] = ()


@final
class Limits:
    """When a search ends: at so many ``signals`` beside those at hand, after so much ``work`` (a count, the same on
    every machine), and, as a brake, after ``seconds`` or when the time of the run has ``passed``."""

    def __init__(self, signals: int, work: float, seconds: float, passed: Callable[[], bool]) -> None:
        self.work, self._most, self._passed = work, signals, passed
        self._beside = 0
        self._until = time.perf_counter() + seconds
        self.ended: Ended = "settled"

    @staticmethod
    def of(charge: Charge, results: Sequence[Result], columns: int, passed: Callable[[], bool]) -> Limits:
        """In proportion to what the policy's own ``results`` took, with ``columns`` of their programs."""
        programs = sum(result.counts.get("relaxed_programs", 0) for result in results)
        return Limits(charge.causal_signals, WORK + programs * (EACH + PER * columns), charge.causal_seconds, passed)

    @property
    def seconds(self) -> float:
        """That are left."""
        return max(0.0, self._until - time.perf_counter())

    def passed(self) -> bool:
        """Whether its time, or that of the run, is over."""
        return not self.seconds or self._passed()

    def over(self, tree: Tree, idle: int = 0) -> bool:
        """Whether the search for a tree ends after so many ``idle`` rounds, and why."""
        s = tree.sampled
        most = CELLS / max(1, s.T.shape[0] * max(s.N.shape[1], s.T.shape[1] * s.T.shape[2]))
        if self.passed():
            self.ended = "seconds"
        elif tree.work + tree.knowledge.work > self.work or len(tree.signals) > most:
            self.ended = "work"
        elif not self.room(tree):
            self.ended = "signals"
        over = self.ended != "settled"
        if idle >= IDLE and self.ended != "seconds":
            self.ended = "settled"
        return over

    def begin(self, tree: Tree) -> None:
        """The signals that are at hand do not count."""
        self._beside = len(tree.signals)

    def again(self) -> None:
        """Another tree: signals and work count anew, time that is over is over."""
        self._beside = 0
        if self.ended != "seconds":
            self.ended = "settled"

    def room(self, tree: Tree) -> int:
        """How many signals may be added to the tree; before the search begins: as many as there are."""
        return self._most + self._beside - len(tree.signals) if self._beside else 1


@final
class CausalSearch:
    """The search for one problem under a policy, ``model``, at its ``decision``, where there is one; ``active``: names,
    times and deviations of the constraints that the policy's own bound rests on."""

    def __init__(
        self, model: Transcription, decision: Array | None, active: Sequence[tuple[str, float, Array | None]]
    ) -> None:
        self.model, self.loop, self.decision = model, model.answering.loop, decision
        flat = [one for one in model.constraints if isinstance(one, FlatConstraint)]
        # a bound of fewer constraints is one still
        self.constraints = [one for one in flat if one.gains is None and not one.reference.moves]
        grid, disturbance = model.response.grid, model.functionals.disturbance
        places = np.zeros(0, dtype=int) if disturbance is None or disturbance.starts is None else disturbance.starts
        self.starts = grid.breakpoints[places]
        self.spread = Spread(() if disturbance is None else self.loop.spread.sets[:1])
        asked = [(one.H, one.h, self._times(one, active)) for one in self.constraints]
        self.sampled = Sampled.of(self.loop, asked)
        self._active = active

    def _times(self, one: FlatConstraint, active: Sequence[tuple[str, float, Array | None]]) -> Array:
        points = self.model.response.grid.breakpoints
        shares = np.arange(1, INSIDE + 1) / (INSIDE + 1)
        inner = (points[:-1, None] + np.diff(points)[:, None] * shares).ravel()
        inside = np.concatenate([points, inner])
        own = [at for name, at, _ in active if name == one.name and one.start <= at <= one.stop]
        return np.unique([one.start, one.stop, *own, *inside[(inside > one.start) & (inside < one.stop)]])

    def tree(self, limits: Limits, highest: float | None = None) -> Tree:
        """A tree of the nominal signal and those that the policy's bound rests on, of which a control knows all that
        the disturbance does until the last measurement that is known: outputs tell no more."""
        points, measured, s = self.model.control.breakpoints, self.model.problem.measurements, self.sampled
        seen = np.searchsorted(self.starts, points[:-1] if measured is None else measured.latest(points))
        N = s.N[:, : self.spread.size]
        width, begun = self.spread.size // max(1, self.starts.size), np.searchsorted(self.starts, s.time)
        known = [extreme(self.spread, z) for _, _, z in self._active if z is not None and z.any()]
        return self._planted(OfDisturbances(N, self.spread, width, seen, begun), known, limits, highest)

    def hiding(self, limits: Limits, beside: tuple[Tree, Grown] | None, highest: float | None = None) -> Tree | None:
        """A tree of signals that a noise hides, with those that have a multiplier in one ``beside`` it; ``None`` where
        nothing is hidden. Noise and initial states stay what they are under all factors up to the ``highest``."""
        points, measured, s = self.model.control.breakpoints, self.model.problem.measurements, self.sampled
        if measured is None:
            return None
        seen, share = measured.known(points).sum(axis=1), 1.0 if highest is None else 1.0 / highest
        knowledge = OfOutputs.of(self.loop, s.N, s.time, points[:-1], seen, share)
        if knowledge is None:
            return None
        knowledge.limit, knowledge.passed = limits.work, limits.passed
        known = [beside[0].signals[one] for one in np.unique(beside[1].signals)] if beside is not None else []
        return self._planted(knowledge, known, limits, highest)

    def _planted(self, knowledge: Knowledge, known: list[Array], limits: Limits, highest: float | None) -> Tree:
        problem, feedback = self.model.problem, self.model.answering
        limits.again()
        prices = problem.prices(self.model.control.breakpoints)
        tree = Tree(self.sampled, knowledge, problem.control, prices, feedback.charge.cost, highest)
        tree.seconds = lambda: limits.seconds
        tree.add(knowledge.nominal)
        for z in known:
            if not limits.over(tree):
                tree.add(knowledge.known(z))
        limits.begin(tree)
        return tree

    def least_cost(self, cost: float, limits: Limits, hides: bool = True) -> tuple[Tree, Grown, bool] | None:
        """The tree that was found, its multipliers, and whether they prove that no causal policy exists; ``cost``: of
        the policy, an upper bound of what the tree can prove, infinite where none is known. First as if no noise hid
        anything, and then, where it ``hides``, with what that took to prove."""
        found = self._least_cost(self.tree(limits), cost, limits)
        if not hides or (found is not None and found[2]):
            return found
        tree = self.hiding(limits, None if found is None else found[:2])
        better = None if tree is None else self._least_cost(tree, cost, limits)
        if found is None or (better is not None and (better[2] or better[1].value > found[1].value)):
            return better
        return found

    def _least_cost(self, tree: Tree, cost: float, limits: Limits) -> tuple[Tree, Grown, bool] | None:
        best, idle = tree.least(), 0
        while best is not None and idle < len(ANSWERED) and not limits.over(tree, idle):
            aim = cost if np.isfinite(cost) else np.inf
            centre = tree.relaxed(best.value + TOWARDS * max(aim - best.value, 0.0), central=True)
            if centre is None or not self._grow(tree, centre, limits.room(tree), idle):
                break
            better = tree.least()
            if better is None:  # nothing is feasible, or the solver did not finish
                refused = self._refused(tree)
                return (tree, best, False) if refused is None else (tree, refused, True)
            idle = 0 if better.value > best.value + NONE * abs(better.value) else idle + 1
            best = better
        if best is not None:
            return tree, best, False
        refused = self._refused(tree)
        return None if refused is None else (tree, refused, True)

    @staticmethod
    def _refused(tree: Tree) -> Grown | None:
        found = tree.relaxed()
        return found if found is not None and found.value > NONE else None

    def largest_factor(self, highest: float, limits: Limits) -> tuple[Tree, Grown] | None:
        """The largest factor of all deviations for which the tree is feasible, with its multipliers. Of outputs with a
        noise first as if it hid nothing, and then below the factor that was found, for which it hides its share."""
        found = self._largest_factor(self.tree(limits, highest), limits)
        for _ in range(AGAIN if found is not None else 0):
            assert found is not None
            tree = self.hiding(limits, found, found[1].value * (1.0 + NARROWER))
            better = None if tree is None else self._largest_factor(tree, limits)
            if better is None or better[1].value >= found[1].value:
                break
            narrower, found = better[1].value < found[1].value * (1.0 - NARROWER), better
            if not narrower:
                break
        return found

    def _largest_factor(self, tree: Tree, limits: Limits) -> tuple[Tree, Grown] | None:
        best, idle = tree.least(), 0
        while best is not None and idle < len(ANSWERED) and not limits.over(tree, idle):
            if not self._grow(tree, best, limits.room(tree), idle):
                break
            better = tree.least()
            if better is None:
                break
            idle = 0 if better.value < best.value * (1.0 - NEARLY) else idle + 1
            best = better
        return None if best is None else (tree, best)

    def _grow(self, tree: Tree, centre: Grown, most: int, idle: int) -> bool:
        """Signals that are the worst if the control answers a share of what the policy does, that of so many ``idle``
        rounds; whether there are new ones."""
        shares = ANSWERED if self.decision is not None else (0.0,)
        at = min(idle, len(shares) - 1)
        return any(self._sought(tree, centre, most, share) for share in dict.fromkeys((*shares[at:], *shares[:at])))

    def _sought(self, tree: Tree, centre: Grown, most: int, share: float) -> bool:
        """Signals that leave one of the tree at a report and are the worst for a row from there on, if the control
        answers them by this ``share`` of what the policy does: those that exceed it most, no two of one signal and
        report; whether there are.
        """
        effects = None if self.decision is None else share * self.loop.effects(self.decision)
        own = np.einsum("rmk,smk->sr", self.sampled.T, centre.u) - self.sampled.b
        scale = 1.0 if tree.priced else max(centre.x[0], NONE)
        answered = None if effects is None else np.einsum("rmk,kmq->rq", self.sampled.T, effects)
        taken, z = set[tuple[int, int]](), np.array(tree.signals)
        tree.work += z.shape[0] * (self.sampled.N.size + self.sampled.T.size)
        for signal, report, child in tree.knowledge.leaving(z, own, answered, scale, tree.units):
            if len(taken) >= min(AT_ONCE, most):
                break
            if (signal, report) not in taken and tree.add(child):
                taken.add((signal, report))
        return bool(taken)

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
        numbers, every, rows = dict[bytes, int](), list[Array](), list[Weighed]()

        def number(z: Array) -> int:
            found = numbers.setdefault(z.tobytes(), len(numbers))
            every.extend([z * scale] * (found == len(every)))
            return found

        for signal, row, report, y in zip(found.signals, found.rows, found.reports, found.multipliers, strict=True):
            which = number(tree.changed(int(signal), int(row), int(report)))
            one, s = self.constraints[self.sampled.constraint[row]], self.sampled
            rows.append(Weighed(which, one.name, float(s.time[row]), one.H[s.side[row]], float(y)))
        held = dict[int, float]()
        for signal in np.flatnonzero(found.shares).tolist() if np.isfinite(lower) else ():
            which = number(tree.signals[signal])
            held[which] = held.get(which, 0.0) + float(found.shares[signal])
        whole = max(1.0, sum(held.values())) / SHARED
        shares = tuple(held.get(which, 0.0) / whole for which in range(len(every)) if held)
        signals = tuple(_values(z[: self.spread.size], disturbance, self.starts.size) for z in every)
        if not isinstance(tree.knowledge, OfOutputs):
            return CausalBound(lower, signals, tuple(rows), ended, shares)
        outputs = tuple(tree.knowledge.outputs(z) for z in every)
        begun = tuple(self._begun(z[self.spread.size : self.sampled.N.shape[1]]) for z in every)
        return CausalBound(lower, signals, tuple(rows), ended, shares, outputs, begun)

    def _begun(self, z: Array) -> Array:
        """The initial state of deviations, certainly in its set."""
        bound = self.model.problem.initial_set
        return self.loop.start if bound is None else _values(z, bound, 1)[:, 0]


def _values(z: Array, disturbance: ConvexSet | None, blocks: int) -> Array:
    """The disturbance ``(mw, blocks)`` of deviations, certainly in its set; 0 is exactly the middle."""
    if disturbance is None:
        return np.zeros((0, 0))
    middle, deviations = disturbance.middle(), z.reshape(blocks, -1)
    if disturbance.is_box:
        box = disturbance.bounding_box()
        values = np.clip(middle + deviations, box.lower, box.upper)
    else:
        values = middle + INWARDS * deviations
    return np.asarray(np.where(deviations == 0.0, middle, values).T)
