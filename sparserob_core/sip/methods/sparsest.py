"""The decision of which the fewest entries count, exactly: the convex bound first, then integers where it leaves a gap.

The count is not convex, so two bounds are closed upon one another that are each proven. From below: the convex program
below the count (`counting`), and where that is not enough branch and bound over which entries count, every leaf with
multipliers of its own (`branching`). From above: decisions that act on a few entries only, each proven over the
continuum by the exchange. A mixed-integer solver (HiGHS) proposes which entries; no claim rests on what it says.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from pydantic import Field, field_validator
from scipy.sparse import csc_array, eye_array

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import RoundFinished, StageProgress, forward_events, forward_progress, ignore
from sparserob_core.sip.evidence import Cut, Leaf, Sparsest
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.methods.branching import Branching, propose_decision
from sparserob_core.sip.methods.driver import drive
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.methods.reweighted import imposed_cuts, solve_on_support
from sparserob_core.sip.program import TOLERANCE, SemiInfiniteProgram
from sparserob_core.sip.proof.branch_and_bound import prove
from sparserob_core.sip.proof.verdict import verdict, witness, worst_of
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows, rows_at
from sparserob_core.sip.result import Result, relative_gap
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.counting import (
    DUST,
    complete_decision,
    count,
    count_of,
    counted_below,
    counting,
    prices_of,
)
from sparserob_core.sip.working.ledger import prove_nothing
from sparserob_core.sip.working.tightening import PAID

PROVEN = ("certified", "verified")
PROPOSALS = 40  # of the mixed-integer solver
# Relative gap of a proposal while none is proven. With a tenth of it a limit of seconds is over before the first one;
# with ten times as much it is no different: any decision is closer to the least.
ANY = 1.0
SAME_COUNT_DIFFERENCE = 1e-6  # relative difference of two counts that is none


class SparsestMethod(Method, Options):
    """Fewest active pieces: the control that acts for the shortest time, weighted over its channels.

    ``cost`` is that time; ``norm`` beside it is the usual cost. With ``alphabet`` the control takes only these values.
    """

    counts: ClassVar[bool] = True

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds of each exchange at most."""

    alphabet: list[float] | None = Field(default=None, min_length=1, max_length=64)
    """The only values that the control may take, in every channel; null: any in its set."""

    nodes: int = Field(default=2000, ge=1)
    """Parts at most into which branch and bound divides the controls, where the convex bound leaves a gap."""

    @field_validator("alphabet")
    @classmethod
    def _check_alphabet(cls, value: list[float] | None) -> list[float] | None:
        if value is None:
            return None
        if not np.isfinite(value).all() or len(set(value)) < len(value):
            raise InputError(expected="finite numbers that differ", got=f"{value}")
        return sorted(value)

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        if program.finite.blocks is not None and self.alphabet is not None:
            raise InputError("method: sparsest.alphabet spells channels one by one; expected a cost without groups")
        if program.activity is None or counting(program) != program.activity.size:
            raise InputError(
                "method: sparsest counts pieces, for which a control needs a function per piece; expected a dictionary"
                " such as piecewise_constant"
            )
        bounded, letters = self._narrow_bounds(program)
        plain = self._solve_plain(program, tools)
        if plain is not None and plain.status == "infeasible":
            return _report_infeasible(program, plain, ())
        if plain is not None and plain.decision is None:
            return plain
        state = _SparsestSearch(self, program, bounded, tools, letters, plain)
        root = state.root()
        return drive(tools.deadline, state.step, state.stopped) if root is None else root

    def _narrow_bounds(self, program: SemiInfiniteProgram) -> tuple[SemiInfiniteProgram, Array | None]:
        """The program with bounds as narrow as the alphabet is, and its letters in the program's units."""
        if self.alphabet is None:
            return program, None
        base, size = program.finite, counting(program)
        if base.S is not None and (abs(base.S[:size] - _build_identity(size, program.n))).max() > 0.0:
            raise InputError(
                "method: sparsest.alphabet needs a dictionary whose coefficients are the control's values; expected"
                " piecewise_constant"
            )
        units = np.ones(size) if program.image_units is None else program.image_units[:size]
        letters = np.array(self.alphabet)[None] / units[:, None]
        slack = TOLERANCE * np.maximum(np.abs(base.lower), np.abs(base.upper))[:size]
        outside = (letters < (base.lower[:size] - slack)[:, None]) | (letters > (base.upper[:size] + slack)[:, None])
        if outside.any():
            worst = self.alphabet[int(np.argmax(outside.any(axis=0)))]
            raise InputError(path="method.alphabet", expected="values within the control's range", got=f"{worst:g}")
        lower, upper = base.lower.copy(), base.upper.copy()
        lower[:size], upper[:size] = letters[:, 0], letters[:, -1]
        return replace(program, lower=lower, upper=upper, twin=None), letters

    def _solve_plain(self, program: SemiInfiniteProgram, tools: Tools) -> Result | None:
        """An optimum of the program's own cost, to compare with; none with an alphabet."""
        if self.alphabet is not None:
            return None
        tools = replace(tools, notify=forward_progress(tools.notify, "least cost, to compare with"))
        return Exchange(tolerance=self.tolerance, rounds=self.rounds).solve(program, tools)


@dataclass(eq=False)
class _SparsestSearch:
    """State of the search while its two bounds close: the rows found so far, the best decision with its result, and the
    tree."""

    method: SparsestMethod
    program: SemiInfiniteProgram
    bounded: SemiInfiniteProgram
    tools: Tools
    letters: Array | None
    plain: Result | None
    best: Result | None = None
    least: float = np.inf
    ending: str = ""
    reported: RoundFinished | None = None
    rounds: list[RoundFinished] = field(default_factory=list)
    tree: Branching | None = None
    tried: set[bytes] = field(default_factory=set)
    spent: list[Result] = field(default_factory=list)
    """What was solved on the way: the convex program, and one for every set of entries that was tried."""
    violation: float = 0.0
    """By how much the last decision of letters missed constraints that were not yet imposed, in their norms."""
    margin: float = 0.0
    """By which the rows of the next proposal are tightened, in their norms."""
    roomy: bool = True
    """Whether something may be that far from the constraints."""
    proposing: bool = True
    started: float = field(default_factory=time.perf_counter)
    shown: float = field(default_factory=time.monotonic)

    def __post_init__(self) -> None:
        self.relaxed = RelaxedProgram(self.bounded, self.tools.solver, None, deadline=self.tools.deadline)
        self.rows = Rows.none(self.program.n)
        self.spent += [] if self.plain is None else [self.plain]
        if self.plain is not None and self.plain.status in PROVEN and self.plain.decision is not None:
            self.best, self.least = self.plain, count(self.program, self.plain.decision)
            self._impose_cuts(self.plain.indices)

    @property
    def lower(self) -> float:
        """The proven lower bound of the count, in the user's units."""
        return 0.0 if self.tree is None else self.tree.lower

    @property
    def closed(self) -> bool:
        return self.lower >= self.least * (1.0 - SAME_COUNT_DIFFERENCE)

    def root(self) -> Result | None:
        """The convex program below the count; its result where nothing is feasible."""
        below = counted_below(self.bounded)

        def heard(event: RoundFinished) -> RoundFinished:
            self.reported = replace(event, upper_bound=np.inf, gap=np.inf)
            return self.reported

        tools = replace(self.tools, notify=forward_events(self.tools.notify, RoundFinished, heard), regulariser=None)
        method = Exchange(tolerance=self.method.tolerance, rounds=self.method.rounds)
        result = method.close(below.program, tools, prove_nothing, imposed_cuts(self.rows.cuts))
        self.spent.append(result)
        if result.status == "infeasible":
            letters = tuple(self.method.alphabet or ())
            message = f"no control with values in {list(letters)}: {result.message}" if letters else result.message
            return _report_infeasible(self.program, replace(result, message=message), letters)
        self._impose_cuts([*result.indices, *result.dual.cuts])
        self.rounds = list(result.history)
        self.tree = Branching(self.bounded, self.relaxed, self.rows, self.letters, tuple(self.method.alphabet or ()))
        if result.decision is not None and self.letters is None:
            self.look(result.decision)
        return None

    def _impose_cuts(self, cuts: Sequence[Cut]) -> bool:
        """Impose constraints; ``False`` where all are known."""
        imposed_keys = {(cut.family, cut.row, cut.index.tobytes()) for cut in self.rows.cuts}
        fresh = [cut for cut in cuts if (cut.family, cut.row, cut.index.tobytes()) not in imposed_keys]
        for cut in {(cut.family, cut.row, cut.index.tobytes()): cut for cut in fresh}.values():
            self.rows = self.rows.joined(rows_at(self.program, cut.family, cut.index[None], np.array([cut.row])))
        if self.tree is not None:
            self.tree.rows = self.rows
        return bool(fresh)

    def look(self, x: Array) -> bool:
        """Try to prove a decision that acts on no more entries than ``x (n,)``, where that is less than before; whether
        something is known now that was not."""
        base, prices = self.program.finite, prices_of(self.program)
        image = base.image(x)
        radii = np.maximum(np.abs(base.lower), np.abs(base.upper))
        is_acting = np.abs(image) > DUST * np.where(np.isfinite(radii), radii, 1.0)
        if self.letters is not None:
            return self._prove_letters(self._round_to_letters(image))
        key = np.packbits(is_acting[prices > 0.0]).tobytes()
        if count_of(self.program, is_acting) >= self.least * (1.0 - SAME_COUNT_DIFFERENCE) or key in self.tried:
            return False
        self.tried.add(key)
        method = Exchange(tolerance=self.method.tolerance, rounds=self.method.rounds)
        result = solve_on_support(self.program, x, self.tools, method, self.rows.cuts)
        self.spent.append(result)
        is_new = self._impose_cuts([*result.indices, *result.dual.cuts])
        if result.status in PROVEN and result.decision is not None:
            new_count = count(self.program, result.decision)
            if new_count < self.least * (1.0 - SAME_COUNT_DIFFERENCE):
                self.best, self.least = result, new_count
                self.tell()
                return True
        return is_new

    def _round_to_letters(self, image: Array) -> Array:
        assert self.letters is not None
        nearest = np.abs(image[: len(self.letters), None] - self.letters).argmin(axis=1)
        return complete_decision(self.program, self.letters[np.arange(nearest.size), nearest])

    def _prove_letters(self, x: Array) -> bool:
        """Prove a decision of letters, or impose what it violates."""
        if x.tobytes() in self.tried:
            return False
        self.tried.add(x.tobytes())
        program, tools = self.program, self.tools
        if count(program, x) >= self.least * (1.0 - SAME_COUNT_DIFFERENCE):
            return False
        separations = separate(program, x, replace(tools, notify=ignore), TOLERANCE)
        fresh: list[Cut] = []
        for family, separation in separations:
            above = separation.violations > TOLERANCE
            pairs = zip(separation.indices[above], separation.rows[above], strict=True)
            fresh += [Cut(family.name, index, int(row), formulation=family.formulation) for index, row in pairs]
        if fresh:
            row_count = self.rows.h.size
            is_new = self._impose_cuts(fresh)
            G, h = self.rows.G[row_count:], self.rows.h[row_count:]
            norms = np.maximum(np.linalg.norm(G, axis=1), np.finfo(float).tiny)
            self.violation = float(((G @ x - h) / norms).max(initial=0.0))
            return is_new
        if program.finite.residual(x) > TOLERANCE or program.finite.equality_residual(x) > TOLERANCE:
            return False
        proofs = prove(program, x, tools.notify, deadline=tools.deadline)
        if any(proof.verdict != "proven" for proof in proofs):
            cuts = [
                Cut(proof.family, proof.index, proof.row, formulation=proof.formulation)
                for proof in proofs
                if proof.verdict == "refuted" and proof.index is not None
            ]
            return self._impose_cuts(cuts)
        self.least = count(program, x)
        worst = witness(program, worst_of(separations), proofs)
        self.best = Result(
            status="verified",
            message="",
            decision=x,
            cost=program.cost(x),
            proofs=tuple(proofs),
            worst=worst,
            indices=self.rows.cuts,
        )
        self.tell()
        return True

    def tell(self) -> None:
        """Tell of better bounds, as a round like the last."""
        if self.reported is None:
            return
        unit = self.program.cost_unit
        decision = None if self.best is None else self.best.decision
        self.reported = replace(
            self.reported,
            round=self.reported.round + 1,
            lower_bound=self.lower / unit,
            upper_bound=self.least / unit,
            cost=self.least / unit,
            decision=self.reported.decision if decision is None else decision,
            gap=relative_gap(self.lower, self.least),
            proven=self.least / unit,
            relaxed_programs=self.relaxed.solves + sum(result.counts["relaxed_programs"] for result in self.spent),
        )
        self.rounds.append(self.reported)
        self.tools.notify(self.reported)

    def step(self, number: int) -> Result | None:
        """Make one proposal, or, where no more are made, one division of a part of the tree.

        Returns the result where the bounds have met or nothing is left to try, and ``None`` otherwise.
        """
        assert self.tree is not None

        # Propose: a decision that counts less than the best, as the mixed-integer solver sees it.
        if self.proposing and number <= PROPOSALS and not self.closed:
            self.proposing = self.propose()
            return None

        # Terminate: no part of the tree may hold a decision that counts less, or there are too many parts.
        if not self.tree.open(self.least):
            return self.result()
        if len(self.tree.nodes) >= self.method.nodes:
            self.ending = f"the {self.method.nodes} nodes of the method are used up"
            return self.result()

        # Branch: divide the part with the least bound, or prove the decision that is its optimum.
        if time.monotonic() - self.shown > 1.0:
            self.shown = time.monotonic()
            self.tell()
        return None if self.tree.grow(lambda: self.least, self.look) else self.result()

    def stopped(self, error: KeyboardInterrupt) -> Result:
        """Note the interrupt, and return the result from what is known so far."""
        self.tools.deadline.interrupt(error)
        return self.result()

    def propose(self) -> bool:
        """Ask the mixed-integer solver for a decision that counts less than the best; whether it is to be asked again.
        While none is proven, any will do that keeps away from the constraints by more than the last one missed them."""
        crude = self.letters is not None and self.best is None
        norms = np.linalg.norm(self.rows.G, axis=1)
        rows = replace(self.rows, h=self.rows.h - self.margin * norms) if crude else self.rows
        self.tools.notify(StageProgress(text="proposal: which entries may be fewer, by the mixed-integer solver"))
        x = propose_decision(self.bounded, self.relaxed, rows, self.letters, ANY if crude else 0.0)
        if x is None and crude and self.margin > 0.0:
            self.margin, self.roomy = 0.0, False
            return True
        if x is None or not self.look(x):
            return False
        self.margin = PAID * self.violation if self.roomy else 0.0
        return True

    def _explain_failure(self) -> str:
        """Return the reason why there is no control although none is excluded, and the remedy, in words."""
        if self.plain is not None:
            return f"no control was proven: {self.plain.message}"
        remedy = "more seconds (limits.seconds)" if self.tools.deadline.passed else "more nodes (method.nodes)"
        return (
            f"no control of letters was found, and none is excluded; {remedy} or letters nearer to one another "
            "would help"
        )

    def result(self) -> Result:
        """Return the result of the search so far, whose cost is the count."""
        assert self.tree is not None
        program, unit = self.program, self.program.cost_unit
        ending = self.ending or self.tools.deadline.reason
        if self.best is None and self.plain is not None and ending == self.plain.stopped:
            ending = ""  # the plain program's message says so
        counts = {"relaxed_programs": self.relaxed.solves, "rounds": len(self.rounds), "nodes": len(self.tree.nodes)}
        letters = None if self.method.alphabet is None else tuple(self.method.alphabet)
        tree, history, seconds = tuple(self.tree.nodes), tuple(self.rounds), time.perf_counter() - self.started
        if self.best is None:
            is_infeasible = self.tree.lower == np.inf
            exclusion = f"no control with values in {list(letters or ())} meets the constraints, by branch and bound"
            return Result(
                status="infeasible" if is_infeasible else "undecided",
                message=exclusion
                if is_infeasible
                else "; ".join(text for text in (self._explain_failure(), ending) if text),
                stopped="" if is_infeasible else self.tools.deadline.reason,
                lower_bound=np.inf if is_infeasible else self.lower / unit,
                counts=counts,
                solved_by=dict(self.relaxed.solved_by),
                sparsest=Sparsest(np.nan, None, None, tree, letters),
                history=history,
                seconds=seconds,
            ).charged(self.spent)
        lower = min(self.tree.lower, self.least)
        status, message = verdict(self.best.proofs, relative_gap(lower, self.least), self.method.tolerance)
        plain = self.plain if self.plain is not None and self.plain.status in PROVEN else None
        sparsest = Sparsest(
            norm=self.best.cost,
            plain=None if plain is None else plain.cost,
            plain_count=None if plain is None or plain.decision is None else count(program, plain.decision),
            tree=tree,
            letters=letters,
        )
        first = self.tree.nodes[0]
        return replace(
            self.best,
            status=status,
            message=f"{message}; {ending}" if ending and status != "certified" else message,
            cost=self.least / unit,
            value=self.least / unit,
            epsilon=0.0,
            lower_bound=lower / unit,
            upper_bound=self.least / unit if status in PROVEN else np.inf,
            dual=first.dual if isinstance(first, Leaf) else self.best.dual,
            stopped=self.tools.deadline.reason,
            counts={**counts, "active_indices": len(self.best.indices)},
            solved_by=dict(self.relaxed.solved_by),
            sparsest=sparsest,
            history=history,
            seconds=seconds,
            cost_scale=self.least / unit,
        ).charged(self.spent)


def _report_infeasible(program: SemiInfiniteProgram, result: Result, letters: Sequence[float]) -> Result:
    """The result where nothing is feasible, by one set of multipliers: a tree of one leaf."""
    tree = Sparsest(np.nan, None, None, (Leaf(result.dual, feasible=False),), letters or None)
    return replace(result, sparsest=tree, cost_scale=0.0)


def _build_identity(size: int, columns: int) -> object:
    return csc_array(eye_array(size, columns))
