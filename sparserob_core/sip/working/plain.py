"""Imposed rows that are linear in the decision: dropped when they have been idle, solved with a regulariser that is as
light as it must be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TypeAlias, final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Dual
from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.inner.vertex import MANY, vertex
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import worst_of
from sparserob_core.sip.relaxed.relaxed import Rows, rows_at
from sparserob_core.sip.result import Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.counting import count, met, tidied
from sparserob_core.sip.working.ledger import ALLOWED, Answer, Found, Ledger, Prover, Violated, above
from sparserob_core.sip.working.working import Missed, Working, fits

# Rounds that a row may stay without a multiplier before it is dropped. With one, rows come and go; with ten times as
# many, solving takes longer the more rounds there were.
IDLE_ROUNDS = 3
# Rounds after which rows are only added, so that nothing can cycle. With a tenth of them walls with bends solve more
# rows than they need; ten times as many are more rounds than there are.
DROPPING_ROUNDS = 40
# Of a weight, what the steps of the continuation that are taken at once may leave. With ten times as much steps are
# made one by one, three times as many programs; with half of it programs of badly scaled numbers are left verified.
FASTEST = 1 / 8
CRUDE = 1e-4  # residual and relative gap of a relaxed solution that a round can do with
SPARSIFYING = 60  # rounds after which no vertex is looked for any more

Close: TypeAlias = Callable[[SemiInfiniteProgram, Tools, Prover], Result]  # an exchange that closes the gap


@final
@dataclass(eq=False)
class PlainRows(Working):
    """The imposed ``rows``, since how many rounds each is ``idle (r,)``, the weight ``epsilon`` of the regulariser, and
    a solution with these rows as the next ``guess``. ``exact``: the regulariser is only as heavy as the unregularised
    problem allows, else as the last weight of the continuation. ``close``: the exchange of another program. ``sheds``:
    whether idle rows are dropped."""

    rows: Rows = field(default_factory=lambda: Rows.none(0))
    epsilon: float = 0.0
    exact: bool = True
    close: Close | None = None
    idle: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    guess: FiniteSolution | None = None
    sheds: bool = True

    @staticmethod
    def start(program: SemiInfiniteProgram, tools: Tools, exact: bool, close: Close) -> PlainRows:
        """No rows, and the first weight of the continuation."""
        epsilon = 0.0 if tools.regulariser is None else tools.continuation.start
        return PlainRows(program, rows=Rows.none(program.n), epsilon=epsilon, exact=exact, close=close)

    @property
    def size(self) -> int:
        return int(self.rows.h.size)

    def relax(self, ledger: Ledger, prover: Prover, last: bool) -> Answer | Result:
        """Where the cost falls for ever, as it may without enough rows: those that stop it, where there are any."""
        answer = self._regularised(ledger)
        while answer.solution.status == "failed" and not usable(answer.solution) and not last:
            from sparserob_core.sip.working.unbounded import bounding_rows, falls_for_ever, first_rows

            self.sheds = self.sheds and not self.size  # what was dropped may be what bounds it
            if self.impose(first_rows(self.program)):
                answer = self._regularised(ledger)
                continue
            assert self.close is not None
            ray, fresh = bounding_rows(self.program, ledger.tools, self.close)
            if ray is not None:
                return falls_for_ever(ledger, self.close, prover, ray)
            if not self.impose(fresh):
                break
            answer = self._regularised(ledger)
        return answer if usable(answer.solution) else ledger.without(answer)

    def _regularised(self, ledger: Ledger) -> Answer:
        """The relaxed program, with lighter and lighter regularisers while the cost still changes and the gap is open,
        several steps of the continuation at once; for the regularised problem, step by step down to the last
        weight."""
        solution, regu = self._solve(ledger, self.epsilon), ledger.tools.continuation
        steps = max(1, int(np.log(FASTEST) / np.log(regu.factor))) if self.exact else 1
        while usable(solution) and self.epsilon > regu.stop and (not self.exact or ledger.open(solution.x)):
            ledger.tools.deadline.check()
            lighter = self.epsilon
            for _ in range(steps):
                lighter = regu.lighter(lighter) if lighter > regu.stop else lighter
            candidate = self._solve(ledger, lighter)
            if not usable(candidate):
                break
            before, after = ledger.program.cost(solution.x), ledger.program.cost(candidate.x)
            self.epsilon, solution = lighter, candidate
            settled = abs(after - before) <= regu.tolerance * max(1.0, abs(ledger.lower))
            if settled and self.exact and ledger.open(solution.x):
                self._plain(ledger)
        return Answer(solution, self.rows, self.epsilon, solution.value)

    def _solve(self, ledger: Ledger, epsilon: float) -> FiniteSolution:
        """The relaxed program with this weight; its multipliers improve the lower bound."""
        solution = ledger.relaxed.solve(self.rows, epsilon, self.margin, self.guess)
        while solution.status == "infeasible" and self.thin():
            solution = ledger.relaxed.solve(self.rows, epsilon, self.margin, None)
        if usable(solution):
            self.guess = solution
            ledger.improve(ledger.relaxed.lower_bound(self.rows, solution))
            self.pay(ledger, Answer(solution, self.rows, epsilon, solution.value))
        return solution

    def _plain(self, ledger: Ledger) -> FiniteSolution:
        """The unregularised relaxed program: only its multipliers are wanted, for the lower bound."""
        guess = self.guess if self.program.n >= MANY else None  # of the multipliers, where the simplex method begins
        plain = ledger.relaxed.solve(self.rows, 0.0, self.margin, guess)
        if usable(plain):
            ledger.improve(ledger.relaxed.lower_bound(self.rows, plain))
        return plain

    def sharpen(self, ledger: Ledger, answer: Answer) -> bool:
        """The lower bound of the plain program, then to go on without the regulariser, which is not exact at its
        lightest."""
        if self.epsilon == 0.0 or not self.exact:
            return False
        plain = self._plain(ledger)
        crude = answer.solution.status != "optimal"
        if not (crude or ledger.open(answer.solution.x)) or not usable(plain):
            return False
        self.epsilon, self.guess = 0.0, plain if self.program.n >= MANY else None
        return True

    def exchange(self, answer: Answer, violated: Violated, number: int) -> int:
        """Rows that have been slack for a while are dropped when others are added."""
        fresh = self._unknown(violated)
        if not fresh.h.size:
            return 0
        known, added = answer.multipliers, np.zeros(fresh.h.size)
        y = np.concatenate([known, np.zeros(self.rows.h.size - known.size)])  # none of what was imposed since
        idle = np.where(y > 0.0, 0, self.idle + 1)
        keep = (idle < IDLE_ROUNDS) | (number > DROPPING_ROUNDS) | (not self.sheds)
        self.rows = self.rows.take(keep).joined(fresh)
        self.idle = np.concatenate([idle[keep], added.astype(int)])
        fixed = answer.solution.y[: answer.solution.y.size - known.size]
        self.guess = replace(answer.solution, y=np.concatenate([fixed, y[keep], added]))
        return added.size

    def impose(self, violated: Violated) -> int:
        fresh = self._unknown(violated)
        self.rows = self.rows.joined(fresh)
        self.guess = None if self.guess is None else _with_more(self.guess, fresh.h.size)
        self.idle = np.concatenate([self.idle, np.zeros(fresh.h.size, dtype=int)])
        return int(fresh.h.size)

    def knows(self, missed: Missed) -> bool:
        return not self._unknown([(missed.at, missed.row, missed.family)]).h.size

    def _unknown(self, violated: Violated) -> Rows:
        known, fresh = {(cut.family, cut.row, cut.index.tobytes()) for cut in self.rows.cuts}, Rows.none(self.program.n)
        for indices, rows, family in violated:
            new = np.array(
                [(family, int(r), i.tobytes()) not in known for i, r in zip(indices, rows, strict=True)], dtype=bool
            )
            if new.any():
                fresh = fresh.joined(rows_at(self.program, family, indices[new], rows[new]))
        return fresh

    def priced(self, answer: Answer) -> float:
        return float(answer.multipliers @ answer.rows.norms)

    @property
    def longest(self) -> float:
        return float(self.rows.norms.max(initial=0.0))

    @property
    def unit(self) -> float:
        """That of the decision: a row is moved by a margin of 1 as far as by a decision of that size."""
        reach = np.maximum(np.abs(self.program.finite.lower), np.abs(self.program.finite.upper))
        return min(1.0, float(np.where(np.isfinite(reach), reach, 1.0).max()))

    def distance(self, missed: Missed) -> float:
        row = rows_at(self.program, missed.family, missed.at, missed.row)
        return missed.violation / max(float(np.linalg.norm(row.G)), np.finfo(float).tiny)

    def tightened(self, ledger: Ledger, answer: Answer, margin: float) -> Answer | None:
        guess = _with_more(answer.solution, self.rows.h.size - answer.rows.h.size)
        solution = ledger.relaxed.solve(self.rows, self.epsilon, margin, guess)
        if not usable(solution):
            return None
        ledger.improve(ledger.relaxed.lower_bound(self.rows, solution))
        return Answer(solution, self.rows, self.epsilon, solution.value)

    def candidate(self, answer: Answer) -> Answer | None:
        return None

    def proven(self, ledger: Ledger, answer: Answer, x: Array) -> Dual:
        return ledger.relaxed.lower_bound(answer.rows, replace(answer.solution, x=x))

    def choose(
        self, ledger: Ledger, answer: Answer, found: Found, number: int, prover: Prover
    ) -> tuple[Answer, Found, Violated]:
        """One of which fewer entries count, where solvers leave dust or any optimum will do: the answer without its
        dust, or a vertex of the relaxed program where no regulariser chooses another optimum."""
        answer, found, violated = self._sparser(ledger, answer, found, number)
        if not self.exact:
            self._plain(ledger)
        return answer, found, violated

    def _sparser(self, ledger: Ledger, answer: Answer, found: Found, number: int) -> tuple[Answer, Found, Violated]:
        program, x = self.program, answer.solution.x
        if program.activity is None or (number > SPARSIFYING and answer.epsilon == 0.0):
            return answer, found, ()
        held, closed = answer.rows.G[answer.multipliers > 0.0], not ledger.open(x)
        candidates = [met(program, tidied(program, x), held, held @ x)]  # dust may be all that is between the bounds
        if closed and answer.epsilon == 0.0 and program.finite.P is None and program.blocks is None:
            rows = answer.rows
            plain = ledger.relaxed.finite(rows.G, rows.h - self.margin * rows.norms, 0.0)
            corner = vertex(plain, answer.solution.y, answer.solution.mu)
            candidates += [] if corner is None else [met(program, tidied(program, corner), held, held @ corner)]
        kept, violated, least = (answer, found), list[tuple[Array, np.ndarray, str]](), count(program, x)
        for other in candidates:
            if other is x or count(program, other) >= least or not fits(ledger, other):
                continue
            looked = separate(program, other, ledger.tools, ALLOWED, number)
            beyond = [one for family, separation in looked if (one := above(family, separation))[1].size]
            room = 0.5 * min(0.0, worst_of(found).violation)
            if self.allowed and worst_of(looked).violation > room:
                continue  # a proof has asked for room, which the answer leaves and this one does not
            if not beyond:
                value = program.cost(other) if answer.epsilon == 0.0 else answer.value
                kept = replace(answer, solution=replace(answer.solution, x=other), value=value), looked
                violated, least = [], count(program, other)
            elif answer.epsilon == 0.0:
                violated = beyond
        return *kept, violated


def _with_more(solution: FiniteSolution, rows: int) -> FiniteSolution:
    """A solution as a guess where so many rows stand behind those that it knows."""
    return replace(solution, y=np.concatenate([solution.y, np.zeros(rows)]))


def usable(solution: FiniteSolution) -> bool:
    """Whether a relaxed solution is good for a round: a crude optimiser costs rounds, but no claim rests on its
    accuracy."""
    scale = max(1.0, abs(solution.value))
    return solution.status == "optimal" or (
        solution.status == "failed" and solution.residual <= CRUDE and solution.gap <= CRUDE * scale
    )
