"""Exchange for rows that must hold for every deviation: times are exchanged, deviations are all in the relaxed program.

A round solves the robust counterpart at the imposed indices (`inner.counterpart`, or `inner.central` where that is
quicker), separates every family in closed form and imposes what is violated. The lower bound is that of cuts: every row
with a multiplier, at the deviation that its multipliers say (weak duality over the bounds of the program). It ends as
the other exchange does: by proof.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import ignore
from sparserob_core.sip.evidence import Cut, Dual, InfeasibleSubsystem, Proof
from sparserob_core.sip.finite import INTERIOR, FiniteSolution
from sparserob_core.sip.inner.central.interior import Interior
from sparserob_core.sip.inner.counterpart import Counterpart, RobustAnswer, robust_bound
from sparserob_core.sip.methods.ledger import (
    ALLOWED,
    GLANCE,
    SPARED,
    THINNER,
    Answer,
    Ledger,
    Missed,
    Prover,
    Violated,
    or_proven,
    proofs_of,
    secure_in_time,
)
from sparserob_core.sip.program import TOLERANCE, ConstraintFamily, SemiInfiniteProgram, WorstConstraint
from sparserob_core.sip.proof.verdict import NAMED, explained, worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows
from sparserob_core.sip.result import SMALL_COST, Result
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.solver import Asked

if TYPE_CHECKING:
    from sparserob_core.sip.method import Tools

ROUNDING = 2.0**-46  # of the numbers of which a bound is made
FIRST, LARGEST = 1e-8, 1e-6  # margins by which rows are tightened, in their own units
# The least of them but 0, where a gap asks for it: a tenth of that is below what the simplex method leaves (1e-13 of
# numbers of size 1), ten times as much is above what a gap of 1e-10 can pay for at a price of 10.
SMALLEST = 1e-12
SHARES = (0.1, 0.5, 1.0)  # of the way from the best decision known to the relaxed optimum, where rows are sought
ENDED = 0.05  # seconds after the end of the time, when it is over for certain
CUTS, GUIDED = 4, 30  # of them at each; rounds of a guide
MANY = 4000  # variables of a second objective. With ten times as many the simplex method takes minutes where the first
# objective takes seconds (100 pieces, two states: 10 000); with ten times fewer six states on twelve pieces go without.
ROOM = 1e3  # units of the rows that they may have to spare
SLACKENED = 200  # rounds of `least_slack` at most
COARSE, SHARPER = 10.0, 0.1  # share of the cost to which the first round is solved, and how much closer the next ones
FINEST = 0.1  # share of the tolerance to which the last rounds are solved
FARKAS = 1e-9  # a weighted sum of rows is violated by more than that: nothing is feasible


@dataclass(eq=False)
class Robust:
    """The imposed indices of every family, and the counterpart at them."""

    program: SemiInfiniteProgram
    counterpart: Counterpart | Interior
    cuts: list[Cut] = field(default_factory=list)
    known: set[tuple[str, bytes]] = field(default_factory=set)
    margin: float = FIRST
    floor: float = SMALLEST
    slater: bool = True
    raw: Array = field(default_factory=lambda: np.zeros(0))
    best: Array = field(default_factory=lambda: np.zeros(0))
    accuracy: float = COARSE
    price: float = 0.0
    calls: Counter[str] = field(default_factory=Counter)
    asked: Asked | None = None
    secured: int = 0

    @staticmethod
    def start(program: SemiInfiniteProgram, asked: Asked | None = None) -> Robust:
        """What every family begins with; ``asked``: who solves the counterparts, where a solver was named."""
        assert program.spread is not None
        central = Interior(program.finite, program.spread)
        working = Robust(program, central, asked=asked)
        for family in program.families:
            assert family.start is not None
            working.add(family, family.start)
        if asked is not None or program.guide is not None or not central.fits():
            working.by_simplex()
        return working

    def by_simplex(self) -> None:
        """From now on by the simplex method, which takes all there is, or by the solver that was named."""
        if isinstance(self.counterpart, Counterpart):
            return
        known = self.counterpart.blocks
        self.counterpart = Counterpart(self.program.finite, self.counterpart.spread, asked=self.asked)
        for block in known:
            self.counterpart.add(block)

    def solve(self, size: float, seconds: float = np.inf) -> RobustAnswer:
        """The optimum with the rows tightened, as accurate as this round asks for; ``size``: of the cost. Not solved
        where ``seconds`` do not suffice."""
        return self._solve(self.margin, self.accuracy * size, seconds)

    def _solve(self, margin: float, accuracy: float, seconds: float) -> RobustAnswer:
        if isinstance(self.counterpart, Interior):
            answer = self.counterpart.solve(margin, accuracy, seconds)
            self.calls[INTERIOR] += 1
        else:
            before = Counter(self.counterpart.answered)
            answer = self.counterpart.solve(margin, seconds)
            self.calls += self.counterpart.answered - before
        return answer

    def priced(self, answer: Answer) -> float:
        """See `Tightening`."""
        return float(answer.multipliers.sum())

    @property
    def longest(self) -> float:
        """See `Tightening`; margins are in the rows' own units."""
        return 1.0

    def distance(self, missed: Missed) -> float:
        """See `Tightening`."""
        return missed.violation

    def impose(self, violated: Violated) -> int:
        """See `Tightening`."""
        return sum(self.add(self.program.family(name), indices) for indices, _, name in violated)

    def tightened(self, ledger: Ledger, answer: Answer, margin: float) -> Answer | None:
        """See `Tightening`; no more accurate than its distance costs."""
        accuracy = min(self.accuracy, SHARPER * SPARED) * _size(self.program, answer.solution.x)
        found = self._solve(margin, accuracy, _left(ledger.tools))
        _count(self, ledger)
        if not found.solved:
            return None
        ledger.improve(self.dual(found, priced=True))
        solution = replace(answer.solution, y=found.y, mu=found.mu)
        return _at(self, replace(answer, solution=solution, rows=_rows(self)), _settled(self.program, found.x))

    def sharper(self, violation: float, size: float, added: bool, tolerance: float) -> bool:
        """Whether the next round is to be more accurate, because what was added changes little, and can be."""
        if not isinstance(self.counterpart, Interior) or self.accuracy <= FINEST * tolerance:
            return False
        if not added or self.price * violation < self.accuracy * size:
            self.accuracy = max(FINEST * tolerance, SHARPER * self.accuracy)
        return True

    def add(self, family: ConstraintFamily, indices: Array) -> int:
        """Impose all rows of a family at indices ``(k, d)``; how many indices were new."""
        assert family.uncertain is not None
        added = 0
        for index in indices:
            key = (family.name, index.tobytes())
            if key in self.known:
                continue
            rows = family.uncertain(index)
            self.known.add(key)
            self.counterpart.add(rows)
            self.cuts += [Cut(family.name, index, row) for row in range(rows.h.size)]
            added += 1
        return added

    def widen(self) -> None:
        """Tighten the rows by four times as much, and no less from now on."""
        self.margin = self.floor = min(LARGEST, 4.0 * self.margin)

    def dual(self, answer: RobustAnswer, priced: bool) -> Dual:
        """What the multipliers of an answer prove, with the cuts that prove it."""
        blocks = self.counterpart.blocks
        bound, size = robust_bound(self.program.finite, blocks, answer.y, answer.deviations, answer.mu, priced)
        cuts = tuple(
            replace(cut, index=np.concatenate([cut.index, w]), multiplier=float(y), formulation="literal")
            for cut, y, w in zip(self.cuts, answer.y, answer.deviations, strict=True)
            if y > 0.0
        )
        return Dual(bound - (ROUNDING + self.counterpart.spread.missed) * size, cuts, answer.mu)

    @property
    def at_rest(self) -> Dual:
        """What the bounds of the decision prove alone, without a multiplier."""
        rows, size = len(self.cuts), self.counterpart.spread.size
        none = RobustAnswer(
            True, "", np.zeros(0), np.zeros(rows), np.zeros((rows, size)), np.zeros(self.program.finite.b.size)
        )
        return self.dual(none, priced=True)

    def refuted(self, answer: RobustAnswer) -> Dual | None:
        """What the multipliers of an answer prove of all decisions alike: that there is none; or nothing."""
        total = float(answer.y.sum() + np.abs(answer.mu).sum())
        if not 0.0 < total < np.inf:
            return None
        dual = self.dual(replace(answer, y=answer.y / total, mu=answer.mu / total), priced=False)
        return dual if dual.bound > FARKAS else None


def robust_exchange(
    program: SemiInfiniteProgram, tools: Tools, prover: Prover, tolerance: float, rounds: int
) -> Result:
    """Close the gap of a program with uncertain rows; ends as `Exchange.close` does."""
    relaxed = RelaxedProgram(program, tools.solver, None, deadline=tools.deadline)
    ledger = Ledger(program, relaxed, tools, tolerance)
    asked = relaxed.counted
    working = Robust.start(program, None if asked.instead is None else asked)
    ledger.improve(working.at_rest)
    try:
        with tools.deadline.enforced():
            return _exchange(working, ledger, prover, rounds)
    except KeyboardInterrupt as error:
        return ledger.stopped(error, prover)


def _exchange(working: Robust, ledger: Ledger, prover: Prover, rounds: int) -> Result:
    program, tools = ledger.program, ledger.tools
    _guided(working, ledger)
    for number in range(1, rounds + 1):
        tools.deadline.check()
        last = number == rounds

        # Relax: the counterpart at the imposed indices; its cuts are a lower bound.
        answer = _solved(working, ledger)
        if isinstance(answer, Result):
            return ledger.salvaged(answer)
        x = answer.solution.x
        if working.best.size and ledger.open(x) and (last or not ledger.open(working.best)):
            answer = _at(working, answer, working.best)
            x = answer.solution.x

        # Separate: the times at which the continuum is violated most.
        found = separate(program, x, tools, ALLOWED, number)
        told = [(family, one) for family, one in found if not family.defines]
        violated = [(family, one.indices[one.violations > ALLOWED]) for family, one in told]
        feasible = not any(indices.size for _, indices in violated)
        if not feasible and x is working.best and not last:
            working.best = np.zeros(0)
            continue
        if program.guide is not None and (not feasible or ledger.open(x)):
            violated += _undefined(working, x, feasible)
            if number & (number - 1) == 0:  # 1, 2, 4, 8, ...
                _prove_best(working, ledger, prover, answer)
        ledger.tell(number, answer, told, program.cost(x) if feasible else np.inf, kept=len(working.cuts))

        # Secure: where time runs out, prove a decision that keeps away from the constraints while there is some.
        imposed = secure_in_time(working, ledger, prover, answer, told, number)

        # Exchange: impose them, or sharpen what stands for the imposed ones, or choose another margin.
        if not last and (imposed or _advanced(working, ledger, x, violated, feasible, worst_of(told).violation)):
            continue

        # Prove: over the whole continuum; a witness that the proof meets is one more index to impose.
        proofs, imposed = proofs_of(working, ledger, prover, answer, told)
        if not last and not tools.deadline.passed and (imposed or _learned(working, x, proofs)):
            working.best = np.zeros(0)
            continue

        # Choose: of the decisions that cost as little, the one that the program likes best, where that is proven.
        chosen = _chosen(working, ledger, answer, prover) if feasible and not ledger.open(x) else None
        if chosen is not None:
            return chosen
        ending = f"the {rounds} rounds of the method are used up" if last else ""
        ending = tools.deadline.reason if tools.deadline.passed else ending
        return or_proven(ledger, ledger.judged(answer, worst_of(told), proofs, ending))
    raise AssertionError("the last round returns")


def _chosen(working: Robust, ledger: Ledger, answer: Answer, prover: Prover) -> Result | None:
    """The result with the decision that is best by the second objective of the program, `SemiInfiniteProgram.among`,
    among those that cost at most the lower bound and half of the tolerance more: the same rows, and one more. ``None``
    where there is none, or none was proven."""
    program, tools = working.program, replace(ledger.tools, notify=ignore)
    if program.among is None or program.spread is None or program.among[0].n > MANY:
        return None
    second, shared = program.among
    weights = np.append(program.finite.weights[:shared], np.zeros(second.n - shared))
    most = max(ledger.lower, 0.0) * (1.0 + 0.5 * ledger.tolerance)
    counterpart = Counterpart(second.finite, program.spread, ceiling=(weights, most), asked=working.asked)
    easier = Robust(second, counterpart, margin=working.margin, asked=working.asked)
    for family in second.families:
        held = {cut.index.tobytes(): cut.index for cut in answer.active if cut.family == family.name}
        known = list(held.values())
        start = np.zeros((0, family.index_set.dimension)) if family.start is None else family.start
        easier.add(family, np.array(known) if known else start)
    for number in range(1, GUIDED + 1):
        if tools.deadline.passed:
            return None
        found = easier.solve(second.largest_cost, _left(tools))
        if not found.solved:
            return None
        x = np.clip(found.x, second.finite.lower, second.finite.upper)
        x = x if second.settle is None else second.settle(x)
        looked = separate(second, x, tools, ALLOWED, number)
        new = [(family, one.indices[one.violations > ALLOWED]) for family, one in looked]
        wrong = any(indices.size for _, indices in new)
        if not (sum(easier.add(family, indices) for family, indices in new) or easier.counterpart.sharpen(x)):
            break
    working.calls += easier.calls
    _count(working, ledger)
    decision = x[:shared] if program.settle is None else program.settle(x[:shared])
    if wrong or program.finite.residual(decision) > TOLERANCE or ledger.open(decision):
        return None
    proofs, met = prover(decision), separate(program, decision, tools, ALLOWED)
    if any(one.verdict != "proven" for one in proofs):
        return None
    return ledger.judged(_at(working, answer, decision), worst_of(met), proofs, "")


def _prove_best(working: Robust, ledger: Ledger, prover: Prover, answer: Answer) -> None:
    """Look at the best decision known, where nothing that costs as little is proven."""
    best, program = working.best, ledger.program
    if best.size and (ledger.proven is None or program.cost(best) < program.cost(ledger.proven[0].solution.x)):
        ledger.prove(_at(working, answer, best), separate(program, best, ledger.tools, ALLOWED), prover(best, GLANCE))


def _guided(working: Robust, ledger: Ledger) -> None:
    """Begin where the program's guide ends: with its times, and with what its optimum defines."""
    program, tools = working.program, ledger.tools
    if program.guide is None:
        return
    guide, shared = program.guide
    easier = Robust.start(guide, working.asked)
    easier.by_simplex()
    for number in range(1, GUIDED + 1):
        tools.deadline.check()
        answer = easier.solve(program.largest_cost, _left(tools))
        if not answer.solved:
            return
        x = np.clip(answer.x, guide.finite.lower, guide.finite.upper)
        x = x if guide.settle is None else guide.settle(x)
        working.raw = np.concatenate([x[:shared], np.zeros(program.n - shared)])
        working.best = working.raw if program.settle is None else program.settle(working.raw)
        found = separate(guide, x, tools, ALLOWED, number)
        new = [(family, one.indices[one.violations > ALLOWED]) for family, one in found]
        if not sum(easier.add(family, indices) for family, indices in new):
            break
    for family in program.families:
        held = [cut.index for cut in easier.cuts if cut.family == family.name and not cut.row]
        if not family.defines and held:
            working.add(family, np.array(held))
    for family, indices in _undefined(working, working.best, False):
        working.add(family, indices)
    working.calls += easier.calls


def _undefined(working: Robust, x: Array, feasible: bool) -> list[tuple[ConstraintFamily, Array]]:
    """Where the bounds that a family defines are exceeded at the relaxed optimum, before they are settled, and between
    it and the best decision known (Ben-Ameur and Neto 2007); where that is ``feasible``, a better one is kept."""
    program, raw = working.program, working.raw
    if feasible and not (working.best.size and program.cost(working.best) <= program.cost(x)):
        working.best = x
    best = working.best if working.best.size else x
    found: list[tuple[ConstraintFamily, Array]] = []
    for family in program.families:
        if not family.defines or family.worst is None:
            continue
        for share in SHARES:
            at = share * raw + (1.0 - share) * best
            indices = family.worst(at).indices
            over = family.violations(raw, indices).max(axis=1)
            found.append((family, indices[over > ALLOWED][:CUTS]))
            if feasible and program.settle is not None:
                at = program.settle(at)
                if program.cost(at) < program.cost(working.best):
                    working.best = at
    return found


def _advanced(
    working: Robust,
    ledger: Ledger,
    x: Array,
    violated: list[tuple[ConstraintFamily, Array]],
    feasible: bool,
    worst: float,
) -> bool:
    """Whether the next round has something new to solve."""
    added = sum(working.add(family, indices) for family, indices in violated)
    wanted = not feasible or added or ledger.open(x)
    if wanted and working.sharper(worst, _size(ledger.program, x), bool(added), ledger.tolerance):
        return True
    if wanted and (working.counterpart.sharpen(x) or added):
        return True
    if not feasible and working.slater and working.margin < LARGEST:
        working.widen()  # imposed and violated: by the solver's accuracy
        return True
    if feasible and ledger.open(x) and working.margin > working.floor:
        working.margin = max(working.floor, 0.2 * working.margin)
        return True
    return False


def _learned(working: Robust, x: Array, proofs: Sequence[Proof]) -> bool:
    """Whether a proof that failed has told something new to solve."""
    again = 0
    for proof in proofs:
        if proof.verdict == "refuted" and proof.index is not None:
            again += working.add(working.program.family(proof.family), proof.index[None])
            again += working.counterpart.sharpen(x)
    if again:
        return True
    if any(proof.verdict == "undecided" for proof in proofs) and working.slater and working.margin < LARGEST:
        working.widen()
        return True
    return False


def _solved(working: Robust, ledger: Ledger) -> Answer | Result:
    """The optimum of the counterpart with the rows tightened; where that leaves nothing, less and less so, and in the
    end the proof that nothing is feasible."""
    program, best = working.program, ledger.best
    size = program.largest_cost if best is None else _size(program, best.solution.x)
    while True:
        answer = working.solve(size, _left(ledger.tools))
        _count(working, ledger)
        if answer.solved:
            break
        if ledger.tools.deadline.passed:
            if answer.x.size:  # broken off: what it has come to is what is known
                _told(working, ledger, answer)
            ledger.tools.deadline.check()
        if isinstance(working.counterpart, Interior):
            refuted = working.refuted(answer)
            if refuted is not None:
                return _refuted(working, ledger, answer, refuted)
            working.by_simplex()
            continue
        if working.margin > 0.0:
            working.margin = THINNER * working.margin if THINNER * working.margin >= SMALLEST else 0.0
            working.slater = working.margin > 0.0
            if working.margin > 0.0:
                continue
        return _infeasible(working, ledger, answer.said)
    told = _told(working, ledger, answer)
    price = working.price = float(answer.y.sum())
    budget = 0.4 * ledger.tolerance * _size(program, told.solution.x)
    if working.slater and price * working.margin > budget:
        working.margin = max(working.floor, min(working.margin, budget / price))
    return told


def _told(working: Robust, ledger: Ledger, found: RobustAnswer) -> Answer:
    """The decision of an answer, with the bound that its multipliers prove; the first one is kept, should there be no
    time for another."""
    program, none = working.program, np.zeros(0)
    working.raw = np.clip(found.x, program.finite.lower, program.finite.upper)
    x = _settled(program, found.x)
    dual = working.dual(found, priced=True)
    ledger.improve(dual)
    solution = FiniteSolution("optimal", x, np.inf, dual.bound, found.y, found.mu, none, np.inf, np.inf)
    answer = _at(working, Answer(solution, _rows(working), 0.0, np.inf), x)
    if ledger.best is None:
        ledger.keep(answer)
    return answer


def _settled(program: SemiInfiniteProgram, x: Array) -> Array:
    """A decision within its bounds, and what families define at what they say."""
    x = np.clip(x, program.finite.lower, program.finite.upper)
    x = x if program.settle is None else program.settle(x)
    if program.finite.residual(x) > TOLERANCE:  # what is settled is beyond its bounds: then so is what it stands for
        x = np.clip(x, program.finite.lower, program.finite.upper)
    return x


def _left(tools: Tools) -> float:
    """The seconds that a solution may take."""
    return np.inf if tools.deadline.left is None else tools.deadline.left + ENDED


def _at(working: Robust, answer: Answer, x: Array) -> Answer:
    """An answer with another decision."""
    value, bound = working.program.cost(x), answer.solution.lower_bound
    residual = working.program.finite.residual(x)
    solution = replace(answer.solution, x=x, value=value, residual=residual, gap=value - bound)
    return replace(answer, solution=solution, value=value)


def _rows(working: Robust) -> Rows:
    """The imposed rows by name; what they are depends on the deviations."""
    return Rows(np.zeros((len(working.cuts), 0)), np.zeros(len(working.cuts)), tuple(working.cuts))


def _infeasible(working: Robust, ledger: Ledger, said: str) -> Result:
    """``infeasible`` where multipliers prove it, else ``failed``."""
    program, none = working.program, np.zeros(0)
    relaxing = Counterpart(program.finite, working.counterpart.spread, elastic=True, asked=working.asked)
    for block in working.counterpart.blocks:
        relaxing.add(block)
    elastic = relaxing.solve()
    while elastic.solved and relaxing.sharpen(elastic.x):
        elastic = relaxing.solve()
    working.calls += relaxing.answered
    _count(working, ledger)
    dual = working.refuted(elastic) if elastic.solved else None
    if dual is None:
        found = FiniteSolution("failed", np.zeros(program.n), np.nan, -np.inf, none, none, none, np.inf, np.inf, said)
        return ledger.result(
            "failed", f"the relaxed program was not solved: {said}", Answer(found, _rows(working), 0.0, np.nan)
        )
    return _refuted(working, ledger, elastic, dual)


def _refuted(working: Robust, ledger: Ledger, answer: RobustAnswer, dual: Dual) -> Result:
    """Nothing is feasible, as these multipliers prove."""
    program, none = working.program, np.zeros(0)
    solution = FiniteSolution(
        "infeasible", answer.x, np.inf, np.inf, answer.y, answer.mu, none, np.inf, 0.0, answer.said, (), dual.bound
    )
    ledger.dual = dual
    told, worst = _reason(program, dual)
    found = Answer(solution, _rows(working), 0.0, np.inf)
    return replace(ledger.result("infeasible", told.sentence(), found, worst), infeasible=told)


def _count(working: Robust, ledger: Ledger) -> None:
    ledger.relaxed.solves = working.calls.total()
    if working.asked is None:
        ledger.relaxed.counted.calls = ledger.relaxed.solves
    ledger.relaxed.solved_by.update(working.calls - ledger.relaxed.solved_by)


def _size(program: SemiInfiniteProgram, x: Array) -> float:
    return max(SMALL_COST * program.added(x), abs(program.cost(x)))


def _reason(program: SemiInfiniteProgram, dual: Dual) -> tuple[InfeasibleSubsystem, WorstConstraint | None]:
    """The constraints that cannot hold together, those with the largest multipliers first."""
    units = {family.name: family for family in program.families}
    order = sorted(dual.cuts, key=lambda cut: -cut.multiplier)
    told = [units[cut.family].explanation(cut.index[: units[cut.family].index_set.dimension], cut.row) for cut in order]
    first = order[0]
    bare = WorstConstraint(dual.bound, first.family, first.index[: units[first.family].index_set.dimension], first.row)
    members = tuple(one.text for one in told[:NAMED])
    found = InfeasibleSubsystem(
        members=members,
        others=max(0, len(told) - NAMED),
        equalities=bool(program.finite.b.size),
        decides="policy",
        irreducible=False,
    )
    return found, explained(program, bare)


def least_slack(program: SemiInfiniteProgram, tools: Tools, accuracy: float = 1e-9) -> float:
    """By how much all rows must be relaxed alike, in their own units, until some decision meets them; negative where
    they have that much to spare. Infinite where that was not found."""
    assert program.spread is not None
    relaxing = Counterpart(program.finite, program.spread, elastic=True, lowest=-ROOM)
    families = [family for family in program.families if not family.defines and family.uncertain is not None]
    new = [(family, index) for family in families if family.start is not None for index in family.start]
    known: set[tuple[str, bytes]] = set()
    for _ in range(SLACKENED):
        tools.deadline.check()
        fresh = [(family, index) for family, index in new if (family.name, index.tobytes()) not in known]
        for family, index in fresh:
            assert family.uncertain is not None
            known.add((family.name, index.tobytes()))
            relaxing.add(family.uncertain(index))
        answer = relaxing.solve()
        if not answer.solved:
            return np.inf
        beyond = answer.slack + accuracy
        found = [(family, family.worst(answer.x)) for family in families if family.worst is not None]
        new = [(family, index) for family, one in found for index in one.indices[one.violations > beyond]]
        unknown = any((family.name, index.tobytes()) not in known for family, index in new)
        if not new or not (relaxing.sharpen(answer.x) or unknown):
            return answer.slack
    return np.inf


def largest_factor(program: SemiInfiniteProgram, tools: Tools, highest: float, accuracy: float = 1e-9) -> float | None:
    """The largest factor up to ``highest`` by which all deviations can be multiplied so that some decision meets every
    row, to ``accuracy`` in their own units; ``None`` where the rows do not tell, or nothing was found.

    Where the deviations are ``f`` times as large, a row is ``g x + w'(C (f x) + f d) <= h``: linear in ``f``, in
    ``f x`` of the variables that answer deviations, and in the others.
    """
    families = [family for family in program.families if not family.defines]
    if program.spread is None or any(family.scaled is None or family.start is None for family in families):
        return None
    growing = Counterpart(program.finite, program.spread, scales=True, highest=highest)
    answers = np.zeros(program.n, dtype=bool)
    known: set[tuple[str, bytes]] = set()
    new = [(family, index) for family in families if family.start is not None for index in family.start]
    for _ in range(SLACKENED):
        tools.deadline.check()
        for family, index in new:
            key = (family.name, index.tobytes())
            if key in known or family.uncertain is None:
                continue
            rows = family.uncertain(index)
            known.add(key)
            answers[rows.stacked.indices] = True
            growing.add(rows)
        answer = growing.solve(seconds=_left(tools))
        factor = answer.slack
        if not answer.solved or not factor > 0.0:
            return None
        x = np.where(answers, answer.x / factor, answer.x)
        sharper = growing.sharpen(x)
        found = [(one, one.scaled(factor).worst) for one in families if one.scaled is not None]
        worst = [(one, separation(x)) for one, separation in found if separation is not None]
        new = [(one, index) for one, each in worst for index in each.indices[each.violations > accuracy]]
        if not sharper and all((one.name, index.tobytes()) in known for one, index in new):
            return factor
    return None
