"""What is said in a problem's own units, told in the user's (decision 0016)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from sparserob_core.control.constraints.explanation import Source
from sparserob_core.control.problem.units import Units, ratios
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import ConstraintFamily


@final
@dataclass(frozen=True, eq=False)
class Telling:
    """How families in own ``units`` are told in the user's, of a control that answers or of one that does not.

    ``blocks``: what one of every coefficient of the disturbance's blocks is in the user's units, which come after the
    time of a literal index; ``deviations (Q,)``: the same of what answers are to, which end one.
    """

    units: Units
    blocks: Array = field(default_factory=lambda: np.zeros(0))
    deviations: Array = field(default_factory=lambda: np.zeros(0))

    def family(self, own: ConstraintFamily, theirs: ConstraintFamily) -> ConstraintFamily:
        """A family in own units, in all its forms, that is explained as the user's is."""
        source, other = own.source, theirs.source
        assert isinstance(source, Source) and isinstance(other, Source)
        (normals, _), (mine, coordinates) = other.normals_in(self.units), source.normals_in(self.units)
        rows, known = ratios(normals, mine, coordinates), source.index_units(self.units)

        def told(one: ConstraintFamily, as_theirs: ConstraintFamily) -> ConstraintFamily:
            return self._explained(one, as_theirs, rows, known)

        def sample(count: int, rng: np.random.Generator) -> ConstraintFamily:
            assert draw is not None
            found = draw(count, rng)
            return told(found, found if found.formulation == "sampled" else theirs)

        def form(one: ConstraintFamily | None, as_theirs: ConstraintFamily | None) -> ConstraintFamily | None:
            return None if one is None or as_theirs is None else told(one, as_theirs)

        draw, whole = own.sample, told(own, theirs)
        literal = form(own.literal, theirs.literal)
        if literal is not None and literal.reduced is not None:
            literal = replace(literal, reduced=whole)
        return replace(
            whole,
            nominal=form(own.nominal, theirs.nominal),
            literal=literal,
            reduced=form(own.reduced, theirs.reduced),
            sample=None if draw is None else sample,
        )

    def _explained(
        self, own: ConstraintFamily, theirs: ConstraintFamily, rows: Array, known: Array
    ) -> ConstraintFamily:
        """One form of a family whose rows have the units ``rows (r,)``, whose reduced indices begin with ``known``."""
        scale, said, hindered = self._index(own, known), theirs.explain, theirs.hindrance
        return replace(
            own,
            explain=None if said is None else (lambda index, row: said(index * scale, row)),
            hindrance=None if hindered is None else (lambda low, high: hindered(low * scale, high * scale)),
            row_units=rows,
            index_units=scale,
            measured=theirs.measured,
            along=theirs.along,
        )

    def _index(self, own: ConstraintFamily, known: Array) -> Array:
        """What one of each coordinate of an index is in the user's units; directions, signs and the numbers of samples
        have none."""
        begun, ended = {
            "reduced": (known, np.zeros(0)),
            "nominal": (known[:1], np.zeros(0)),
            "literal": (np.concatenate([known[:1], self.blocks, known[1:]]), self.deviations),
            "sampled": (known[:1], np.zeros(0)),
        }[own.formulation]
        between = np.ones(own.index_set.dimension - begun.size - ended.size)
        return np.concatenate([begun, between, ended])
