"""Bounds of the least count of entries over all feasible decisions, by one convex program at most."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import ignore
from sparserob_core.sip.evidence import Cut, Proof
from sparserob_core.sip.method import Method, Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.branch_and_bound import MAX_PROOF_CELLS, prove
from sparserob_core.sip.result import Result
from sparserob_core.sip.working.counting import DUST, count, counted_below, prices_of
from sparserob_core.sip.working.ledger import Violated

TOLERANCE, ROUNDS = 1e-6, 40  # of the bound, which is told in whole pieces or with six digits
PROPORTIONAL = 1e-12  # relative difference of shares that are equal up to rounding


def multiple(program: SemiInfiniteProgram) -> float | None:
    """The count is at least this times the cost: where the convex cost below the count is a multiple of the program's
    own, up to rounding; ``None`` where it is not."""
    below = counted_below(program)
    own, convex = program.finite, below.program.finite
    if own.P is not None or own.blocks is not None or own.q.any() or convex.q.any() or below.certain:
        return None
    if not np.array_equal(own.weights > 0.0, convex.weights > 0.0) or not convex.weights.any():
        return None
    shares = convex.weights[convex.weights > 0.0] / own.weights[own.weights > 0.0]
    return float(shares.min()) if np.ptp(shares) <= PROPORTIONAL * shares.max() else None


@final
@dataclass(frozen=True, eq=False)
class LeastCount(Method):
    """The lower bound of the count of every feasible decision, in the unit of the cost, and a decision that is a vertex
    of that program; proven only where it counts less than ``beaten``. ``start``: constraints to begin with, in the
    user's units. ``rounds`` are taken, and ``cells`` of every family examined, at most: what is known then is the
    answer."""

    start: Sequence[Cut] = ()
    beaten: float = 0.0
    rounds: int = ROUNDS
    cells: Mapping[str, int] = field(default_factory=dict)

    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        def prover(x: Array, cells: int = MAX_PROOF_CELLS) -> Sequence[Proof]:
            fewer = count(program, x) < self.beaten * (1.0 - TOLERANCE)
            share = {name: min(cells, limit) for name, limit in self.cells.items()}
            return prove(program, x, ignore, share, tools.deadline) if fewer else ()

        below = counted_below(program)
        plain = replace(tools, notify=ignore, regulariser=None)
        method = Exchange(tolerance=TOLERANCE, rounds=self.rounds)
        result = method.close(below.program, plain, prover, imposed(program, self.start))
        bound = max(result.dual.bound, 0.0) + below.certain / program.cost_unit
        z = result.dual.z  # of what the constraints ask of the image, so without the cost's linear part
        dual = replace(result.dual, bound=bound, z=None if z is None else z + below.tilt)
        return replace(result, lower_bound=bound, dual=dual)


def is_vertex(program: SemiInfiniteProgram, result: Result) -> bool:
    """Return whether at most as many counted entries are strictly between 0 and their bounds as rows are active.

    Then no vertex with these active rows has fewer such entries, if the decision is a vertex.
    """
    base, image = program.finite, program.finite.image(np.asarray(result.decision))
    low, high = (np.abs(image - side) <= DUST * np.abs(side) for side in (base.lower, base.upper))
    between = (prices_of(program) > 0.0) & (image != 0.0) & ~low & ~high
    return int(between.sum()) <= len(result.indices) + base.b.size


def imposed(program: SemiInfiniteProgram, cuts: Sequence[Cut]) -> Violated:
    """Constraints that are told in the user's units, as constraints of a program in its own: those whose family states
    its indices as the program does."""
    constraints: list[tuple[Array, np.ndarray, str]] = []
    for family in program.families:
        family_cuts = {
            (cut.index.tobytes(), cut.row): cut
            for cut in cuts
            if cut.family == family.name
            and cut.formulation == family.formulation
            and cut.index.size == family.index_set.dimension
        }
        if family_cuts:
            units = 1.0 if family.index_units is None else family.index_units
            indices = np.array([cut.index for cut in family_cuts.values()]) / units
            constraints.append((indices, np.array([cut.row for cut in family_cuts.values()], dtype=int), family.name))
    return constraints
