"""A program in its own units: methods see numbers of ordinary size, whoever listens sees the user's.

What a problem means must not depend on metres or millimetres; what a solver makes of it does. So a program may carry a
twin in units of its own (`OwnUnits`), every factor a power of two, and therefore exact. `solve_in_own_units` hands the
twin to a method and brings everything that comes back, result and events, into the user's units: nothing else does.
(Decision 0016.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import (
    EvaluationsFinished,
    Event,
    Notify,
    ProofProgress,
    RoundFinished,
    Sketch,
    frozen,
    ignore,
)
from sparserob_core.sip.evidence import Cut, Dual, Leaf, Proof, Sparsest
from sparserob_core.sip.method import Method, Tools
from sparserob_core.sip.program import (
    ConstraintFamily,
    EqualityErrors,
    Formulation,
    OwnUnits,
    SemiInfiniteProgram,
    Separation,
    WorstConstraint,
)
from sparserob_core.sip.result import Result, SearchTrace, Status

# Which of two results says more, the first of these that either has.
ORDER: Sequence[Status] = ("certified", "infeasible", "verified", "refuted", "undecided", "failed")


def solve_in_own_units(method: Method, program: SemiInfiniteProgram, tools: Tools) -> Result:
    """Solve a program by a method in the program's own units; return the result in the user's units."""
    return answered_in_own_units(method.solve, program, tools)


def answered_in_own_units(
    solve: Callable[[SemiInfiniteProgram, Tools], Result], program: SemiInfiniteProgram, tools: Tools
) -> Result:
    """Call ``solve`` with the program in its own units; return the result, and report all events, in the user's units.

    Where the units suit small decisions only, and the result is not conclusive, the program is solved again in wider
    units; the result that says more is returned.

    Parameters
    ----------
    solve : callable
        Function of a program and tools that returns a `Result`.
    program : SemiInfiniteProgram
        Program in the user's units; solved as it is where it has no own units.
    tools : Tools
        Tools whose ``notify`` hears the events.

    Returns
    -------
    Result
        The result in the user's units.
    """
    own = program.own_units
    if own is None:
        return solve(program, tools)
    units, heard = UsersUnits(own), tools.notify
    notify: Notify = ignore if heard is ignore else lambda event: heard(units.event(event))
    result = units.result(solve(own.program, replace(tools, notify=notify)))
    if own.wider is None or result.status in ("certified", "infeasible") or result.stopped:
        return result
    # The units are for small decisions, and that was not the answer: those of all that the bounds allow may do better.
    units = UsersUnits(own.wider())
    second = units.result(solve(units.program, replace(tools, notify=notify)))
    return second if ORDER.index(second.status) < ORDER.index(result.status) else result


@final
class UsersUnits:
    """The way back from a program in its own units to the user's."""

    def __init__(self, own: OwnUnits) -> None:
        self.program, self.decision, self.image = own.program, own.decision, own.image
        self.equalities, self.cost = own.equalities, own.cost
        self._families = {family.name: family for family in own.program.families}

    def result(self, own: Result) -> Result:
        """A result of the program in its own units, in the user's."""
        return replace(
            own,
            decision=None if own.decision is None else own.decision * self.decision,
            cost=own.cost * self.cost,
            value=own.value * self.cost,
            lower_bound=own.lower_bound * self.cost,
            upper_bound=own.upper_bound * self.cost,
            cost_scale=own.cost_scale * self.cost,
            ray=None if own.ray is None else own.ray * self.decision,
            worst=None if own.worst is None else self._convert_witness(own.worst),
            indices=self.cuts(own.indices),
            history=tuple(self._convert_round(event) for event in own.history),
            trace=None if own.trace is None else self._convert_trace(own.trace),
            dual=self._convert_dual(own.dual, infeasible=own.status == "infeasible"),
            proofs=tuple(self._convert_proof(proof) for proof in own.proofs),
            sparsest=None if own.sparsest is None else self._convert_sparsest(own.sparsest),
            errors=None if own.errors is None else self._convert_errors(own.errors),
        )

    def _convert_errors(self, own: EqualityErrors) -> EqualityErrors:
        return replace(own, missed=own.missed * self.equalities, allowed=own.allowed * self.equalities)

    def _convert_sparsest(self, own: Sparsest) -> Sparsest:
        tree = [
            replace(node, dual=self._convert_dual(node.dual, infeasible=not node.feasible))
            if isinstance(node, Leaf)
            else node
            for node in own.tree
        ]
        plain = None if own.plain is None else own.plain * self.cost
        return replace(own, norm=own.norm * self.cost, plain=plain, tree=tree)

    def event(self, own: Event) -> Event:
        """An event of a method that works on the program in its own units, in the user's."""
        if isinstance(own, RoundFinished):
            return self._convert_round(own)
        if isinstance(own, EvaluationsFinished):
            return self._convert_evaluations(own)
        if isinstance(own, ProofProgress):
            before = self._convert_bound(own.family, own.bound_before)
            return replace(own, bound=self._convert_bound(own.family, own.bound), bound_before=before)
        return own

    def _convert_bound(self, name: str, bound: float) -> float:
        """The least bound in the user's units that holds for every row of a family that is bounded in their own."""
        family = self._find_family(name)
        if family is None or family.row_units is None:
            return bound
        return bound * float(family.row_units.max() if bound > 0.0 else family.row_units.min())

    def _convert_round(self, own: RoundFinished) -> RoundFinished:
        decision = None if own.decision is None else frozen(own.decision * self.decision)
        worst = own.separations.get(own.worst_family)
        row = int(worst.rows[0]) if worst is not None and worst.rows.size else 0
        multipliers = [m * self._compute_price(cut) for m, cut in zip(own.multipliers, own.imposed, strict=False)]
        return replace(
            own,
            decision=decision,
            cost=own.cost * self.cost,
            lower_bound=own.lower_bound * self.cost,
            upper_bound=own.upper_bound * self.cost,
            proven=own.proven * self.cost,
            violation=own.violation * self._find_row_unit(own.worst_family, row),
            separations={
                name: self._convert_separation(name, separation) for name, separation in own.separations.items()
            },
            imposed=self.cuts(own.imposed),
            multipliers=frozen(np.array(multipliers, dtype=float)),
            added=self.cuts(own.added),
            dropped=self.cuts(own.dropped),
        )

    def _convert_evaluations(self, own: EvaluationsFinished) -> EvaluationsFinished:
        size = own.best_point.size if own.domain is None else own.domain.dimension
        if own.family:
            units, value = self._find_index_units(own.family, "reduced", size), 1.0
        else:
            units, value = self.tuple_units(size, own.block), self.cost
        batch = own.batch
        return replace(
            own,
            best_value=own.best_value * value,
            best_point=frozen(own.best_point * units) if own.best_point.size == size else own.best_point,
            domain=None
            if own.domain is None
            else Box(frozen(own.domain.lower * units), frozen(own.domain.upper * units)),
            lower_bound=own.lower_bound * self.cost,
            sketches={role: _convert_sketch(sketch, units) for role, sketch in own.sketches.items()},
            batch=replace(
                batch,
                points=tuple(points * units for points in batch.points),
                values=tuple(values * value for values in batch.values),
                best=batch.best * value,
                origin=None if batch.origin is None else batch.origin * units,
                stood=batch.stood * value,
            ),
        )

    def _convert_trace(self, own: SearchTrace) -> SearchTrace:
        width = own.points.shape[1]
        block = max((family.index_set.dimension for family in self._list_searched_families(width)), default=1)
        return replace(
            own,
            value=own.value * self.cost,
            bound=own.bound * self.cost,
            points=own.points * self.tuple_units(width, block) if width else own.points,
        )

    def _list_searched_families(self, width: int) -> Sequence[ConstraintFamily]:
        """The families whose indices a tuple of ``width`` coordinates may be made of: literal ones where they fit."""
        reduced = self.program.families
        literal = [family.literal or family for family in reduced]
        sizes = [max((family.index_set.dimension for family in families), default=1) for families in (literal, reduced)]
        return literal if width and width % sizes[0] == 0 and sizes[0] != sizes[1] else reduced

    def tuple_units(self, size: int, block: int) -> Array:
        """The units ``(size,)`` of a tuple's coordinates: block after block those of the longest index."""
        forms = [form for family in self.program.families for form in (family.literal, family) if form is not None]
        longest = next(
            (form for form in forms if form.index_set.dimension == block and form.index_units is not None), None
        )
        unit = np.ones(block) if longest is None or longest.index_units is None else longest.index_units
        return np.tile(unit, size // max(block, 1)) if size % max(block, 1) == 0 else np.ones(size)

    def _convert_separation(self, name: str, own: Separation) -> Separation:
        family = self._find_family(name)
        rows = None if family is None else family.row_units
        units = np.ones(own.rows.size) if rows is None else rows[own.rows]
        return replace(
            own,
            indices=own.indices * self._find_index_units(name, own.formulation, own.indices.shape[1]),
            violations=own.violations * units,
            bound=own.bound * (1.0 if rows is None else float(rows.max())),
        )

    def _convert_dual(self, own: Dual, infeasible: bool) -> Dual:
        return replace(
            own,
            bound=own.bound if infeasible else own.bound * self.cost,
            cuts=self.cuts(own.cuts),
            mu=own.mu * self.cost / self.equalities if own.mu.size == self.equalities.size else own.mu,
            z=None if own.z is None else own.z * self.cost / self.image,
            fixed=own.fixed * self.cost,
            at=None if own.at is None else own.at * self.decision,
        )

    def cuts(self, own: Sequence[Cut]) -> tuple[Cut, ...]:
        """Constraints of the program in its own units, with their multipliers, in the user's."""
        return tuple(
            Cut(
                cut.family,
                cut.index * self._find_index_units(cut.family, cut.formulation, cut.index.size),
                cut.row,
                cut.multiplier * self._compute_price(cut),
                cut.formulation,
            )
            for cut in own
        )

    def _compute_price(self, cut: Cut) -> float:
        """Return the multiplier, in the user's units of cost and row, of a row whose multiplier is 1 in the program's
        own units."""
        return self.cost / self._find_row_unit(cut.family, cut.row)

    def _convert_witness(self, own: WorstConstraint) -> WorstConstraint:
        units = self._find_index_units(own.constraint, own.formulation, own.index.size)
        violation = own.violation * self._find_row_unit(own.constraint, own.row)
        return replace(own, index=own.index * units, violation=violation)

    def _convert_proof(self, own: Proof) -> Proof:
        def placed(index: Array) -> Array:
            return index * self._find_index_units(own.family, own.formulation, index.shape[-1])

        return replace(
            own,
            bound=self._convert_bound(own.family, own.bound),
            share=own.bound,
            violation=own.violation * own.unit,
            unit=1.0,
            units=None if (family := self._find_family(own.family)) is None else family.row_units,
            index=None if own.index is None else placed(own.index),
            leaves=None if own.leaves is None else (placed(own.leaves[0]), placed(own.leaves[1])),
        )

    def _find_row_unit(self, name: str, row: int) -> float:
        family = self._find_family(name)
        return 1.0 if family is None else family.row_unit(row)

    def _find_index_units(self, name: str, formulation: Formulation, size: int) -> Array:
        family = self._find_family(name)
        if family is None:
            return np.ones(size)
        if formulation == "sampled" and family.index_units is not None:
            return np.array([family.index_units[0], 1.0])  # a time and the number of a sample
        own = family.formulated(formulation)
        units = None if own is None else own.index_units
        return np.ones(size) if units is None or units.size != size else units

    def _find_family(self, name: str) -> ConstraintFamily | None:
        """The family of that name; ``None`` for one that only the method knows, which then has no units."""
        return self._families.get(name)


def _convert_sketch(sketch: Sketch, units: Array) -> Sketch:
    lower = frozen(sketch.lower * units)
    return Sketch(lower, lower if sketch.points else frozen(sketch.upper * units), sketch.rounded)
