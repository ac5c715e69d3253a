"""The exchange method: solve with few constraints, add those that the optimiser violates most, until the bounds meet.

Blankenship and Falk (1976) with three additions: the rows are tightened by a tiny margin, so that the optimiser is
feasible for the whole continuum and its cost is an upper bound; the lower bound comes from multipliers and untightened
rows by weak duality; and the weight of the regulariser decreases only until the cost stops changing (exact
regularisation: Friedlander and Tseng 2007).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.inner.vertex import MANY, vertex
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.methods.counting import count, met, tidied
from sparserob_core.sip.methods.ledger import (
    ALLOWED,
    THINNER,
    Answer,
    Found,
    Ledger,
    Missed,
    Prover,
    Violated,
    above,
    or_proven,
    proofs_of,
    prover_of,
    secure_in_time,
    witnesses,
)
from sparserob_core.sip.program import EQUALITY, SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows, rows_at
from sparserob_core.sip.result import SMALL_COST, Result
from sparserob_core.sip.separation.separation import separate

IDLE_ROUNDS = 3  # rounds that a row may stay without a multiplier before it is dropped
DROPPING_ROUNDS = 40  # rounds after which rows are only added, so that nothing can cycle
ALLOWANCES = 4  # times that a proof is helped over rounding
SMALLEST_MARGIN, LARGEST_MARGIN = 1e-15, 1e-6  # in units of the decision's bounds, where those are below 1
FASTEST = 0.125  # of a weight, what steps of the continuation that are taken at once may leave
CRUDE = 1e-4  # residual and relative gap of a relaxed solution that a round can do with
SPARSIFYING = 60  # rounds after which no vertex is looked for any more
# Active rows at which a margin may cost a quarter of the tolerated gap. With ten times as many, a day on a wall takes
# twice as many cells; with a tenth of them, costs of ordinary problems are 2e-8 of themselves above the least.
MANY_ACTIVE = 32


class Exchange(Method, Options):
    """Exchange of indices until the relative gap is at most ``tolerance``, in at most ``rounds`` rounds."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds at most."""

    robust: ClassVar[bool] = True

    exact: bool = True
    """Solve the unregularised problem, with the regulariser only as heavy as that allows; false: solve the regularised
    problem with the last weight of ``continuation``, for studies of that weight."""

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """`certified` when the gap is closed and every family is proven; infeasible, refuted or undecided otherwise,
        with the reason."""
        return self.close(program, tools, prover_of(program, tools))

    def close(self, program: SemiInfiniteProgram, tools: Tools, prover: Prover, start: Violated = ()) -> Result:
        """Close the gap of ``program``; what is claimed of the decision is what ``prover`` proves of it. ``start``:
        constraints to impose from the beginning."""
        if not self.exact and tools.regulariser is None:
            raise InputError(path="exact", expected="true, for there is no regulariser", got="false")
        if program.spread is not None:
            from sparserob_core.sip.methods.robust import robust_exchange

            return robust_exchange(program, tools, prover, self.tolerance, self.rounds)
        relaxed = RelaxedProgram(program, tools.solver, tools.regulariser, deadline=tools.deadline)
        ledger = Ledger(program, relaxed, tools, self.tolerance)
        try:
            with tools.deadline.enforced():
                return self._exchange(ledger, prover, start)
        except KeyboardInterrupt as error:
            return ledger.stopped(error, prover)

    def _exchange(self, ledger: Ledger, prover: Prover, start: Violated) -> Result:
        program, tools = ledger.program, ledger.tools
        working = Working.start(program, tools)
        working.add(start)
        kept: tuple[Answer, Found] | None = None
        for number in range(1, self.rounds + 1):
            tools.deadline.check()
            last = number == self.rounds

            # Relax: the optimum under the imposed rows, with the regulariser as light as it must be.
            answer = _relaxed(self, working, ledger)
            if answer.solution.status == "failed" and not _usable(answer.solution) and not last:
                # Without enough rows the cost may fall for ever: impose those that stop it, where there are any.
                from sparserob_core.sip.methods.unbounded import bounding_rows, falls_for_ever

                close = self.model_copy(update={"exact": True}).close
                ray, fresh = bounding_rows(program, tools, close)
                if ray is not None:
                    return falls_for_ever(ledger, close, prover, ray)
                if working.add(fresh):
                    continue
            if not _usable(answer.solution):
                return ledger.salvaged(ledger.without(answer))

            # Separate: the constraints of the continuum that this decision violates most.
            x = answer.solution.x
            ledger.best = ledger.best or answer
            found: Found = separate(program, x, tools, ALLOWED, number)
            violated: Violated = [above(family, separation) for family, separation in found]
            suggested = _suggested(program, x, violated)
            ledger.tell(number, answer, found, suggested, kept=working.rows.h.size)

            kept = (answer, found) if np.isfinite(suggested) else kept

            # Secure: where time runs out, prove a decision that keeps away from the constraints while there is some.
            imposed = secure_in_time(working, ledger, prover, answer, found, number)

            # Exchange: impose them, drop what has been idle; tighten the rows that are violated though imposed.
            # Sharpen: nothing is violated but the bounds have not met, so do without the regulariser.
            exchanged = not last and (
                working.exchange(answer, violated, number) or imposed or working.tighten(violated)
            )
            if exchanged or (not last and self.exact and ledger.open(x) and working.sharpen(ledger, x)):
                continue

            # Sparsify: where solvers leave dust, or any optimum will do, one with zeros; it may ask for more rows.
            answer, found, asked = _sparser(working, ledger, answer, found, number)
            x = answer.solution.x
            if not last and working.exchange(answer, asked, number):
                continue

            # Prove: over the whole continuum; a witness that the proof meets is one more index to impose.
            if not self.exact:
                working.plain_bound(ledger)
            proofs, imposed = proofs_of(working, ledger, prover, answer, found)
            # What rounding may do, where it alone keeps a proof open, is allowed for like the solver's accuracy.
            again = imposed or working.exchange(answer, witnesses(program, proofs), number) or working.allow_for(proofs)
            if last or tools.deadline.passed or not again:
                result = ledger.judged(answer, worst_of(found), proofs, self._ending(ledger, answer, last))
                return _or_earlier(ledger, result, answer, kept, prover)
        raise AssertionError("the last round returns")

    def _ending(self, ledger: Ledger, answer: Answer, last: bool) -> str:
        if ledger.tools.deadline.passed:
            return ledger.tools.deadline.reason
        if last:
            return f"the {self.rounds} rounds of the method are used up"
        return (
            "" if self.exact else f"the decision is optimal for the regularised problem, epsilon = {answer.epsilon:g}"
        )


@dataclass(eq=False)
class Working:
    """The working set of the exchange: the imposed ``rows``, since how many rounds each is ``idle (r,)``, the weight
    ``epsilon``, the ``margin`` by which rows are tightened with the ``floor`` that it must not fall below and the
    ``most`` that it may be, whether there is a ``slater`` point for it, how often rounding was ``allowed`` for, a
    solution with these rows as the next ``guess``, and how often time has asked that a decision be ``secured``."""

    program: SemiInfiniteProgram
    rows: Rows
    epsilon: float
    idle: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    margin: float = 0.0
    floor: float = 0.0
    most: float = LARGEST_MARGIN
    slater: bool = True
    allowed: int = 0
    guess: FiniteSolution | None = None
    secured: int = 0

    @staticmethod
    def start(program: SemiInfiniteProgram, tools: Tools) -> Working:
        """No rows, and the first weight of the continuation."""
        epsilon = 0.0 if tools.regulariser is None else tools.continuation.start
        return Working(program, Rows.none(program.n), epsilon)

    def solve(self, ledger: Ledger, epsilon: float) -> FiniteSolution:
        """The relaxed program with this weight; its multipliers improve the lower bound."""
        solution = ledger.relaxed.solve(self.rows, epsilon, self.margin, self.guess)
        # the margin, not the program, may be at fault: a thin set, or no Slater point
        while solution.status == "infeasible" and self.margin > 0.0:
            self.most = THINNER * self.margin if THINNER * self.margin >= SMALLEST_MARGIN else 0.0
            self.margin, self.slater = self.most, self.most > 0.0
            solution = ledger.relaxed.solve(self.rows, epsilon, self.margin, None)
        if _usable(solution):
            self.guess = solution
            ledger.improve(ledger.relaxed.lower_bound(self.rows, solution))
            self._set_margin(ledger, solution)
        return solution

    def plain_bound(self, ledger: Ledger) -> FiniteSolution:
        """The unregularised relaxed program: only its multipliers are wanted, for the lower bound."""
        guess = self.guess if self.program.n >= MANY else None  # of the multipliers, where the simplex method begins
        plain = ledger.relaxed.solve(self.rows, 0.0, self.margin, guess)
        if _usable(plain):
            ledger.improve(ledger.relaxed.lower_bound(self.rows, plain))
        return plain

    def sharpen(self, ledger: Ledger, x: Array) -> bool:
        """Try what else can close the gap of the feasible ``x (n,)``: the lower bound of the plain program, then to go
        on without the regulariser, which is not exact at its lightest; ``False`` when nothing is left to try."""
        if self.epsilon == 0.0:
            return False
        plain = self.plain_bound(ledger)
        if not ledger.open(x) or not _usable(plain):
            return False
        self.epsilon, self.guess = 0.0, plain if self.program.n >= MANY else None
        return True

    def exchange(self, answer: Answer, violated: Violated, number: int) -> int:
        """Drop the rows that have been slack for a while, add the violated ones; returns how many were new."""
        fresh = self._unknown(violated)
        if not fresh.h.size:
            return 0
        known, added = answer.multipliers, np.zeros(fresh.h.size)
        y = np.concatenate([known, np.zeros(self.rows.h.size - known.size)])  # none of what was imposed since
        idle = np.where(y > 0.0, 0, self.idle + 1)
        keep = (idle < IDLE_ROUNDS) | (number > DROPPING_ROUNDS)
        self.rows = self.rows.take(keep).joined(fresh)
        self.idle = np.concatenate([idle[keep], added.astype(int)])
        fixed = answer.solution.y[: answer.solution.y.size - known.size]
        self.guess = replace(answer.solution, y=np.concatenate([fixed, y[keep], added]))
        return added.size

    def impose(self, violated: Violated) -> int:
        """See `Tightening`."""
        before = self.rows.h.size
        return self.rows.h.size - before if self.add(violated) else 0

    def add(self, rows: Violated) -> bool:
        """Impose rows that no solution speaks of yet; ``False`` when none is new."""
        fresh = self._unknown(rows)
        self.rows, self.guess = self.rows.joined(fresh), None if fresh.h.size else self.guess
        self.idle = np.concatenate([self.idle, np.zeros(fresh.h.size, dtype=int)])
        return bool(fresh.h.size)

    def tighten(self, violated: Violated) -> bool:
        """Imposed rows that are violated nonetheless, by the solver's accuracy: tighten by twice as much; ``False``
        when that does not help."""
        known = {(cut.family, cut.row, cut.index.tobytes()): i for i, cut in enumerate(self.rows.cuts)}
        places = [
            known[key]
            for indices, rows, family in violated
            for i, r in zip(indices, rows, strict=True)
            if (key := (family, int(r), i.tobytes())) in known
        ]
        if not places or not self.slater or self.guess is None or self.floor >= self.most:
            return False
        norms = np.maximum(np.linalg.norm(self.rows.G[places], axis=1), np.finfo(float).tiny)
        missed = float(((self.rows.G[places] @ self.guess.x - self.rows.h[places]) / norms).max())
        self.floor = float(np.clip(2.0 * max(missed, self.margin), SMALLEST_MARGIN, self.most))
        self.margin = max(self.margin, self.floor)
        return True

    def allow_for(self, proofs: Sequence[Proof]) -> bool:
        """Nothing is violated, but a proof must allow for rounding and cannot show it: tighten by as much; ``False``
        where that is more than rounding, or was tried."""
        open_ = {proof.family: proof.bound for proof in proofs if proof.verdict == "undecided"}
        if any(proof.verdict == "refuted" for proof in proofs) or not self.slater:
            return False
        missed = [
            open_[cut.family] / size
            for cut, size in zip(self.rows.cuts, np.linalg.norm(self.rows.G, axis=1).tolist(), strict=True)
            if cut.family in open_ and size > 0.0
        ]
        floor = self.margin + 1.25 * max(missed, default=np.inf)
        if floor > self.most or self.allowed >= ALLOWANCES:
            return False
        self.floor = self.margin = floor
        self.allowed += 1
        return True

    def priced(self, answer: Answer) -> float:
        """See `Tightening`."""
        return float(answer.multipliers @ np.linalg.norm(answer.rows.G, axis=1))

    @property
    def longest(self) -> float:
        """See `Tightening`."""
        return float(np.linalg.norm(self.rows.G, axis=1).max(initial=0.0))

    def distance(self, missed: Missed) -> float:
        """See `Tightening`."""
        row = rows_at(self.program, missed.family, missed.at, missed.row)
        return missed.violation / max(float(np.linalg.norm(row.G)), np.finfo(float).tiny)

    def tightened(self, ledger: Ledger, answer: Answer, margin: float) -> Answer | None:
        """See `Tightening`."""
        solution = ledger.relaxed.solve(self.rows, self.epsilon, margin)
        if not _usable(solution):
            return None
        ledger.improve(ledger.relaxed.lower_bound(self.rows, solution))
        return Answer(solution, self.rows, self.epsilon, solution.value)

    def _unknown(self, violated: Violated) -> Rows:
        known, fresh = {(cut.family, cut.row, cut.index.tobytes()) for cut in self.rows.cuts}, Rows.none(self.program.n)
        for indices, rows, family in violated:
            new = np.array(
                [(family, int(r), i.tobytes()) not in known for i, r in zip(indices, rows, strict=True)], dtype=bool
            )
            if new.any():
                fresh = fresh.joined(rows_at(self.program, family, indices[new], rows[new]))
        return fresh

    def _set_margin(self, ledger: Ledger, solution: FiniteSolution) -> None:
        """Tighten the rows as much as a tenth of the tolerated gap pays for, and up to four tenths where many are
        active at once: a wall that is ridden takes cells all along it, the fewer the farther the control keeps away."""
        if not self.slater or not self.rows.h.size:
            return
        multipliers = solution.y[solution.y.size - self.rows.h.size :]
        price = float(multipliers @ np.linalg.norm(self.rows.G, axis=1))
        size = max(SMALL_COST * self.program.added(solution.x), abs(self.program.cost(solution.x)))
        active = int((multipliers > 0.0).sum())
        budget = (0.1 + 0.3 * active / (active + MANY_ACTIVE)) * ledger.tolerance * size
        reach = np.maximum(np.abs(self.program.finite.lower), np.abs(self.program.finite.upper))
        unit = min(1.0, float(np.where(np.isfinite(reach), reach, 1.0).max()))
        margin = float(
            np.clip(budget / max(price, np.finfo(float).tiny), SMALLEST_MARGIN * unit, LARGEST_MARGIN * unit)
        )
        if self.margin == 0.0 or margin < 0.5 * self.margin:
            self.margin = min(max(margin, self.floor), self.most)


def _or_earlier(
    ledger: Ledger, result: Result, answer: Answer, kept: tuple[Answer, Found] | None, prover: Prover
) -> Result:
    """The result, or that of a decision that is proven, or of the last one that seemed feasible, with an open gap,
    where only that is proven."""
    result = or_proven(ledger, result)
    if result.status not in ("refuted", "undecided") or kept is None or kept[0] is answer:
        return result
    earlier = ledger.judged(kept[0], worst_of(kept[1]), prover(kept[0].solution.x))
    return earlier if earlier.status in ("certified", "verified") else result


def _relaxed(method: Exchange, working: Working, ledger: Ledger) -> Answer:
    """The relaxed program, with lighter and lighter regularisers while the cost still changes and the gap is open, one
    step of the continuation and then more of them at once; for the regularised problem, step by step down to the last
    weight."""
    solution, regu = working.solve(ledger, working.epsilon), ledger.tools.continuation
    steps, most = 1, max(1, int(np.log(FASTEST) / np.log(regu.factor))) if method.exact else 1
    while _usable(solution) and working.epsilon > regu.stop and (not method.exact or ledger.open(solution.x)):
        ledger.tools.deadline.check()
        lighter = working.epsilon
        for _ in range(steps):
            lighter = regu.lighter(lighter) if lighter > regu.stop else lighter
        steps = min(steps + 1, most)
        candidate = working.solve(ledger, lighter)
        if not _usable(candidate):
            break
        before, after = ledger.program.cost(solution.x), ledger.program.cost(candidate.x)
        working.epsilon, solution = lighter, candidate
        settled = abs(after - before) <= regu.tolerance * max(1.0, abs(ledger.lower))
        if settled and method.exact and ledger.open(solution.x):
            working.plain_bound(ledger)
    return Answer(solution, working.rows, working.epsilon, solution.value)


def _sparser(
    working: Working, ledger: Ledger, answer: Answer, found: Found, number: int
) -> tuple[Answer, Found, Violated]:
    """The answer with a decision of which fewer entries count, where there is one that violates nothing either; or the
    same answer and what a vertex of the relaxed program, where no regulariser chooses another optimum, violates."""
    program, x = ledger.program, answer.solution.x
    if program.activity is None or (number > SPARSIFYING and answer.epsilon == 0.0):
        return answer, found, ()
    held, closed = answer.rows.G[answer.multipliers > 0.0], not ledger.open(x)
    candidates = [met(program, tidied(program, x), held, held @ x)]  # dust may be all that is between the bounds
    if closed and answer.epsilon == 0.0 and program.finite.P is None and program.blocks is None:
        rows = answer.rows
        norms = np.linalg.norm(rows.G, axis=1)
        plain = ledger.relaxed.finite(rows.G, rows.h - working.margin * norms, 0.0)
        corner = vertex(plain, answer.solution.y, answer.solution.mu)
        candidates += [] if corner is None else [met(program, tidied(program, corner), held, held @ corner)]
    kept, violated, least = (answer, found), list[tuple[Array, np.ndarray, str]](), count(program, x)
    for other in candidates:
        if other is x or count(program, other) >= least or not _fits(ledger, other):
            continue
        looked = separate(program, other, ledger.tools, ALLOWED, number)
        beyond = [one for family, separation in looked if (one := above(family, separation))[1].size]
        if not beyond:
            value = program.cost(other) if answer.epsilon == 0.0 else answer.value
            kept = replace(answer, solution=replace(answer.solution, x=other), value=value), looked
            violated, least = [], count(program, other)
        elif answer.epsilon == 0.0:
            violated = beyond
    return *kept, violated


def _fits(ledger: Ledger, x: Array) -> bool:
    """Whether a decision closes the gap and keeps everything that is no family."""
    base = ledger.program.finite
    return not ledger.open(x) and base.missed(x) <= EQUALITY and base.residual(x) <= ALLOWED


def _suggested(program: SemiInfiniteProgram, x: Array, violated: Violated) -> float:
    """The upper bound that a decision suggests."""
    return np.inf if any(rows.size for _, rows, _ in violated) else program.cost(x)


def _usable(solution: FiniteSolution) -> bool:
    """Whether a relaxed solution is good for a round: a crude optimiser costs rounds, but no claim rests on its
    accuracy."""
    scale = max(1.0, abs(solution.value))
    return solution.status == "optimal" or (
        solution.status == "failed" and solution.residual <= CRUDE and solution.gap <= CRUDE * scale
    )
