"""Reports in the user's units of families in a problem's own units (decision 0016)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from sparserob_core.control.constraints.explanation import ConstraintSource
from sparserob_core.control.problem.units import Units, ratios
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import ConstraintFamily, Explanation


@final
@dataclass(frozen=True, eq=False)
class Telling:
    """Conversion of families in own ``units`` to the user's units, of a control with feedback or in open loop.

    ``blocks``: one unit of every coefficient of the disturbance's blocks, in the user's units; these coefficients
    follow the time in a literal index. ``deviations (Q,)``: one unit of each deviation that the control answers, in the
    user's units; the deviations are the last entries of a literal index.
    """

    units: Units
    blocks: Array = field(default_factory=lambda: np.zeros(0))
    deviations: Array = field(default_factory=lambda: np.zeros(0))

    def family(self, own: ConstraintFamily, theirs: ConstraintFamily) -> ConstraintFamily:
        """Return a family in own units, in all its forms, with the explanations of the user's family."""
        source, user = own.source, theirs.source
        assert isinstance(source, ConstraintSource) and isinstance(user, ConstraintSource)
        (normals, _), (own_normals, coordinates) = user.normals_in(self.units), source.normals_in(self.units)
        rows, begins = ratios(normals, own_normals, coordinates), source.index_units(self.units)

        def convert(one: ConstraintFamily, as_theirs: ConstraintFamily) -> ConstraintFamily:
            return self._attach_units(one, as_theirs, rows, begins)

        def sample(count: int, rng: np.random.Generator) -> ConstraintFamily:
            assert draw is not None
            drawn = draw(count, rng)
            if drawn.formulation != "sampled":
                return convert(drawn, theirs)
            middle, explanation = (theirs.index_set.lower + theirs.index_set.upper) / 2.0, theirs.explanation

            def explain(index: Array, row: int) -> Explanation:
                return explanation(np.append(index[0] * begins[0], middle[1:]), row).of_sample(round(float(index[1])))

            return replace(convert(drawn, drawn), explain=explain)

        def form(one: ConstraintFamily | None, as_theirs: ConstraintFamily | None) -> ConstraintFamily | None:
            return None if one is None or as_theirs is None else convert(one, as_theirs)

        draw, converted = own.sample, convert(own, theirs)
        literal = form(own.literal, theirs.literal)
        if literal is not None and literal.reduced is not None:
            literal = replace(literal, reduced=converted)
        return replace(
            converted,
            nominal=form(own.nominal, theirs.nominal),
            literal=literal,
            reduced=form(own.reduced, theirs.reduced),
            sample=None if draw is None else sample,
        )

    def _attach_units(
        self, own: ConstraintFamily, theirs: ConstraintFamily, rows: Array, begins: Array
    ) -> ConstraintFamily:
        """Return one form of a family, with units of its rows, ``rows (r,)``, and units of the first coordinates of its
        reduced indices, ``begins``."""
        scale, explain, hindered = self._collect_index_units(own, begins), theirs.explain, theirs.hindrance
        return replace(
            own,
            explain=None if explain is None else (lambda index, row: explain(index * scale, row)),
            hindrance=None if hindered is None else (lambda low, high: hindered(low * scale, high * scale)),
            row_units=rows,
            index_units=scale,
            measured=theirs.measured,
            along=theirs.along,
        )

    def _collect_index_units(self, own: ConstraintFamily, begins: Array) -> Array:
        """Return one unit of each coordinate of an index, in the user's units. Directions, signs and the numbers of
        samples have no unit: their factor is 1."""
        leading, trailing = {
            "reduced": (begins, np.zeros(0)),
            "nominal": (begins[:1], np.zeros(0)),
            "literal": (np.concatenate([begins[:1], self.blocks, begins[1:]]), self.deviations),
            "sampled": (begins[:1], np.zeros(0)),
        }[own.formulation]
        between = np.ones(own.index_set.dimension - leading.size - trailing.size)
        return np.concatenate([leading, between, trailing])
