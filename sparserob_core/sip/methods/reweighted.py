"""Sparser by another penalty: reweighted L1 and the capped L1 norm, each a few exchanges with other weights.

Both penalties are concave in ``|s|``, so the tangent at the last decision is above them, and minimising it lowers them
(Hunter and Lange 2004): a weighted L1 program each time. Nothing says that what they find is sparsest; the interval
that every run reports says how far from it that can be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import forward_progress
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.method import GAP_TOLERANCE, Method, Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import verdict
from sparserob_core.sip.result import Result, relative_gap
from sparserob_core.sip.working.counting import DUST, count, prices_of
from sparserob_core.sip.working.ledger import prove_nothing, prover_of

FEWER = 1e-9  # relative: a count that is less by no more than this is the same
PROVEN = ("certified", "verified")


class Reweighted(Method, Options):
    """Reweighted L1, or another concave penalty, from an optimum of L1 on; what is returned costs least among the
    decisions that act on the entries that were found."""

    penalty: Literal["logarithm", "capped"] = "logarithm"
    """``logarithm``: log(1 + |u| / scale), reweighted L1 (Candes, Wakin and Boyd 2008); ``capped``: min(|u|, scale)
    (Zhang 2010). Values of a channel are shares of its largest."""

    scale: float = Field(default=0.1, gt=0.0, le=1.0)
    """Where the penalty bends, as a share of the largest value."""

    passes: int = Field(default=10, ge=1, le=1000)
    """Weighted programs at most."""

    tolerance: float = Field(default=GAP_TOLERANCE, gt=0.0, le=1.0)
    """Relative gap at which the bounds of each exchange have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds of each exchange at most."""

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        if program.activity is None or program.finite.blocks is not None:
            raise InputError("method: reweighted needs a control whose channels count one by one; expected exchange")
        first = Exchange(tolerance=self.tolerance, rounds=self.rounds).solve(program, tools)
        if first.decision is None or first.status not in PROVEN or first.stopped:
            return first
        best, spent = first.decision, list[Result]()
        x = best
        cuts = [*first.indices, *first.dual.cuts]
        plain_tools = replace(tools, regulariser=None)
        exchange = Exchange(tolerance=self.tolerance, rounds=self.rounds)
        for number in range(1, self.passes + 1):
            if tools.deadline.passed:
                break
            labelled_tools = replace(
                plain_tools,
                notify=forward_progress(tools.notify, f"weighted program {number} of at most {self.passes}"),
            )
            heavier_program = replace(
                program, weights=program.finite.weights * self._compute_weights(program, x), twin=None
            )
            weighted_result = exchange.close(heavier_program, labelled_tools, prove_nothing, imposed_cuts(cuts))
            spent.append(weighted_result)
            if weighted_result.decision is None or weighted_result.status not in PROVEN:
                break
            cuts = [*first.indices, *first.dual.cuts, *weighted_result.indices]
            has_converged, x = (
                bool(np.allclose(weighted_result.decision, x, rtol=0.0, atol=FEWER)),
                weighted_result.decision,
            )
            best = x if count(program, x) < count(program, best) * (1.0 - FEWER) else best
            if has_converged:
                break
        if best is first.decision:
            return first.charged(spent)
        result = solve_on_support(program, best, tools, exchange, cuts)
        spent.append(result)
        if (
            result.decision is None
            or result.status not in PROVEN
            or count(program, result.decision) >= count(program, first.decision)
        ):
            return first.charged(spent)
        gap = relative_gap(first.lower_bound, result.cost, result.cost_scale)
        status, message = verdict(result.proofs, gap, self.tolerance)
        return replace(
            result,
            status=status,
            message=message,
            lower_bound=min(first.lower_bound, result.cost),
            dual=first.dual,
            history=first.history,
            counts=first.counts,
            solved_by=first.solved_by,
            seconds=first.seconds + result.seconds,
        ).charged(spent)

    def _compute_weights(self, program: SemiInfiniteProgram, x: Array) -> Array:
        """The slope of the penalty at ``x (n,)``, ``(k,)``, 1 at 0; 1 where nothing counts."""
        base, is_counted = program.finite, prices_of(program) > 0.0
        radii = np.maximum(np.abs(base.lower), np.abs(base.upper))
        is_usable = is_counted & np.isfinite(radii) & (radii > 0.0)
        share = np.where(is_usable, np.abs(base.image(x)) / np.where(is_usable, radii, 1.0), 0.0)
        if self.penalty == "capped":
            return np.where(share < self.scale, 1.0, 0.0)
        return np.asarray(self.scale / (share + self.scale))


def solve_on_support(
    program: SemiInfiniteProgram, x: Array, tools: Tools, exchange: Exchange, known: Sequence[Cut]
) -> Result:
    """The decision of least cost, proven, that acts on no other entries than ``x (n,)`` does; ``known`` constraints are
    imposed from the beginning."""
    base, prices = program.finite, prices_of(program)
    radii = np.maximum(np.abs(base.lower), np.abs(base.upper))
    is_acting = np.abs(base.image(x)) > DUST * np.where(np.isfinite(radii), radii, 1.0)
    is_off = ~is_acting & (prices > 0.0)
    lower, upper = np.where(is_off, 0.0, base.lower), np.where(is_off, 0.0, base.upper)
    narrow = replace(program, lower=lower, upper=upper, twin=None)
    quiet_tools = replace(tools, notify=forward_progress(tools.notify, "least cost on the entries that were found"))
    return exchange.close(narrow, quiet_tools, prover_of(program, quiet_tools), imposed_cuts(known))


def imposed_cuts(cuts: Sequence[Cut]) -> list[tuple[Array, np.ndarray, str]]:
    """Constraints in the program's own units, one by one, each once."""
    unique_cuts = {(cut.family, cut.row, cut.index.tobytes()): cut for cut in cuts}
    return [(cut.index[None], np.array([cut.row]), cut.family) for cut in unique_cuts.values()]
