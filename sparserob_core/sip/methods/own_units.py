"""A program in its own units: methods see numbers of ordinary size, whoever listens sees the user's.

What a problem means must not depend on metres or millimetres; what a solver makes of it does. So a program may carry a
twin in units of its own (`OwnUnits`), every factor a power of two, and therefore exact. `solve_in_own_units` hands the
twin to a method and brings everything that comes back, result and events, into the user's units: nothing else does.
(Decision 0016.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, TypeVar, final

import numpy as np

from sparserob_core.quantities import RECORD, Seal, Unit, in_units
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import (
    EvaluationsFinished,
    Event,
    Notify,
    ProofProgress,
    RoundFinished,
    frozen,
    ignore,
)
from sparserob_core.sip.evidence import Cut, Leaf, Proof
from sparserob_core.sip.method import Method, Tools
from sparserob_core.sip.program import (
    ConstraintFamily,
    Formulation,
    OwnUnits,
    SemiInfiniteProgram,
    Separation,
    WorstConstraint,
)
from sparserob_core.sip.result import Result, SearchTrace, Status

R = TypeVar("R")
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
        result = self._convert(own)
        proofs = [
            replace(proof, share=before.bound, unit=1.0, units=self._find_row_units(proof.family))
            for before, proof in zip(own.proofs, result.proofs, strict=True)
        ]
        return replace(result, proofs=tuple(proofs))

    def event(self, own: Event) -> Event:
        """An event of a method that works on the program in its own units, in the user's."""
        return self._convert(own)

    def cuts(self, own: Sequence[Cut]) -> tuple[Cut, ...]:
        """Constraints of the program in its own units, with their multipliers, in the user's."""
        return tuple(self._convert(cut) for cut in own)

    def _convert(self, own: R, above: Mapping[str, Unit] = MappingProxyType({}), seal: Seal = np.asarray) -> R:
        """Convert a record and those in its fields; ``above`` has the units of the record that it is a field of."""
        seal = frozen if isinstance(own, Event) else seal
        units = {**(above or self._list_program_units()), **self._list_units(own)}

        def convert_nested(nested: Any) -> Any:
            if isinstance(nested, Mapping):
                return {name: self._convert(record, units, seal) for name, record in nested.items()}
            return self._convert(nested, units, seal)

        units[RECORD] = convert_nested
        return in_units(own, units, seal)

    def _list_program_units(self) -> dict[str, Unit]:
        """Return the units that all records have in common."""
        return {
            "cost": self.cost,
            "value": self.cost,
            "decision": self.decision,
            "equalities": self.equalities,
            "mu": lambda mu: mu * self.cost / self.equalities if mu.size == self.equalities.size else mu,
            "z": self.cost / self.image,
        }

    def _list_units(self, own: object) -> dict[str, Unit]:
        """Return the units of the fields of one record, as far as they are its own."""
        match own:
            case Result():
                return {"value": 1.0 if own.status == "infeasible" else self.cost}
            case Leaf():
                return {"value": self.cost if own.feasible else 1.0}
            case Cut():
                index = self._find_index_units(own.family, own.formulation, own.index.size)
                return {"index": index, "price": self._compute_price(own)}
            case WorstConstraint():
                index = self._find_index_units(own.constraint, own.formulation, own.index.size)
                return {"index": index, "row": self._find_row_unit(own.constraint, own.row)}
            case Proof():
                size = next((np.shape(index)[-1] for index in (own.index, *(own.leaves or ())) if index is not None), 0)
                index = self._find_index_units(own.family, own.formulation, size)
                return {"index": index, "row": own.unit, "bound": partial(self._convert_bound, own.family)}
            case ProofProgress():
                return {"bound": partial(self._convert_bound, own.family)}
            case SearchTrace():
                width = own.points.shape[1]
                block = max((family.index_set.dimension for family in self._list_searched_families(width)), default=1)
                return {"index": self.tuple_units(width, block)}
            case RoundFinished():
                return self._list_round_units(own)
            case EvaluationsFinished():
                return self._list_evaluation_units(own)
        return {}

    def _list_round_units(self, own: RoundFinished) -> dict[str, Unit]:
        worst = own.separations.get(own.worst_family)
        row = int(worst.rows[0]) if worst is not None and worst.rows.size else 0
        return {
            "row": self._find_row_unit(own.worst_family, row),
            "separations": lambda separations: {
                name: in_units(separation, self._list_separation_units(name, separation))
                for name, separation in separations.items()
            },
            "prices": np.array([self._compute_price(cut) for cut in own.imposed])[: own.multipliers.size],
        }

    def _list_separation_units(self, name: str, own: Separation) -> dict[str, Unit]:
        rows = self._find_row_units(name)
        return {
            "index": self._find_index_units(name, own.formulation, own.indices.shape[1]),
            "rows": 1.0 if rows is None else rows[own.rows],
            "bound": 1.0 if rows is None else float(rows.max()),
        }

    def _list_evaluation_units(self, own: EvaluationsFinished) -> dict[str, Unit]:
        size = own.best_point.size if own.domain is None else own.domain.dimension
        units = self._find_index_units(own.family, "reduced", size) if own.family else self.tuple_units(size, own.block)
        return {
            "index": lambda points: points * units if points.shape[-1] == size else points,
            "box": lambda box: Box(frozen(box.lower * units), frozen(box.upper * units)),
            "value": 1.0 if own.family else self.cost,
        }

    def _convert_bound(self, name: str, bound: float) -> float:
        """The least bound in the user's units that holds for every row of a family that is bounded in their own."""
        units = self._find_row_units(name)
        return bound if units is None else bound * float(units.max() if bound > 0.0 else units.min())

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

    def _compute_price(self, cut: Cut) -> float:
        """Return the multiplier, in the user's units of cost and row, of a row whose multiplier is 1 in the program's
        own units."""
        return self.cost / self._find_row_unit(cut.family, cut.row)

    def _find_row_units(self, name: str) -> Array | None:
        family = self._find_family(name)
        return None if family is None else family.row_units

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
