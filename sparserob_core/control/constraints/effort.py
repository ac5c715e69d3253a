"""The effort of a control that answers the disturbance, as a family that bounds one variable: the cost `worst`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.control.constraints.explanation import ConstraintSource, TimedExplanation
from sparserob_core.control.constraints.feedback import describe_deviations, not_linear
from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.feedback.effort import Effort, largest_effort
from sparserob_core.control.feedback.loop_rows import LoopRows
from sparserob_core.control.problem.units import Units
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.finite import UncertainRows
from sparserob_core.sip.program import ConstraintFamily, Enclosure, Explanation, Separation


@final
@dataclass(frozen=True, eq=False)
class FeedbackEffort(ConstraintSource):
    """``sum_k prices_k |u_k| <= c`` for every deviation, ``c`` the variable number ``bound``; ``prices (m K,)`` of the
    nominal control's entries.

    An index is a sign of every entry, ``s (m K,)``, or with the deviations ``(s, w)``: the constraint is that of
    ``s``, and where deviations are a box that of ``-s`` too, for all signs.
    """

    name: str
    loop: ClosedLoop
    prices: Array
    bound: int
    _efforts: dict[bytes, Effort] = field(default_factory=dict, repr=False)

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return one normal ``(1,)`` for each of at most two rows, and the unit of the cost: the rows are costs,
        whatever the deviations."""
        return np.ones((2, 1)), np.array([units.cost])

    def index_units(self, units: Units) -> Array:
        """Return an empty array, since the signs of an index have no unit."""
        return np.zeros(0)

    def family(self) -> ConstraintFamily:
        """Return the constraint as a family."""
        ones, radii = np.ones(self.prices.size), self.loop.spread.radii
        family = ConstraintFamily(
            name=self.name,
            index_set=Box(-ones, ones),
            rows=not_linear,
            excess=self.excess,
            uncertain=self.uncertain,
            start=ones[None] if self.loop.spread.is_box else np.stack([ones, -ones]),
            worst=self.worst,
            enclosure=self.enclosure,
            cells=(-ones[None], ones[None]),
            explain=self.explain,
            source=self,
            defines=True,
        )
        box = Box(np.concatenate([-ones, -radii]), np.concatenate([ones, radii]))
        literal = replace(family, index_set=box, formulation="literal", reduced=family, worst=None, excess=None)
        return replace(family, literal=literal)

    @property
    def _row_signs(self) -> Array:
        return np.array([1.0, -1.0] if self.loop.spread.is_box else [1.0])

    def _price_control(self, x: Array) -> tuple[Array, Array]:
        """Return the entries of the control without deviations, and the coefficients of the deviations in them, both
        times the prices: ``(m K,)`` and ``(m K, Q)``."""
        effects = self.loop.effects(x)
        return self.prices * self.loop.nominal(x).ravel(), self.prices[:, None] * effects.swapaxes(0, 1).reshape(
            self.prices.size, -1
        )

    def excess(self, x: Array, indices: Array) -> Array:
        """Return violations ``(k, r)`` for signs ``(k, m K)`` under the worst disturbances."""
        a, A = self._price_control(x)
        signs = indices[:, None] * self._row_signs[:, None]
        return np.asarray(signs @ a + self.loop.spread.support(signs @ A) - x[self.bound])

    def uncertain(self, index: Array) -> UncertainRows:
        """Return the rows of one sign of every entry."""
        loop, weight, count = self.loop, self.prices * index, self._row_signs.size
        position, variable, value = loop.answers.effect
        _, m, Q, _ = loop.answers.shape
        piece, channel = np.divmod(position // Q, m)
        data = weight.reshape(m, -1)[channel, piece] * value
        C = csr_array((data, (position % Q, loop.nominal_size + variable)), shape=(Q, loop.variables))
        g = np.zeros((count, loop.variables))
        g[:, : weight.size] = self._row_signs[:, None] * weight
        g[:, self.bound] = -1.0
        rows = UncertainRows(
            csr_array(g), np.zeros(count), np.zeros(count, dtype=int), self._row_signs, (C,), np.zeros((1, Q))
        )
        controls = self._row_signs[:, None, None] * weight.reshape(m, -1).T
        return LoopRows(loop).with_controls(rows, controls)

    def effort(self, x: Array) -> Effort:
        """Return bounds of the largest effort at the decision ``x (n,)``."""
        key = x[: self.bound].tobytes()
        if key not in self._efforts:
            self._efforts.clear()
            self._efforts[key] = largest_effort(*self._price_control(x), self.loop.spread)
        return self._efforts[key]

    def settled(self, x: Array) -> Array:
        """Return the same decision with the variable ``bound`` at a proven upper bound of the effort."""
        answer, (a, A) = x.copy(), self._price_control(x)
        size = float(np.abs(a).sum() + (np.abs(A) @ self.loop.spread.radii).sum())
        answer[self.bound] = self.effort(x).upper + ROUND_OFF * size
        return answer

    def worst(self, x: Array) -> Separation:
        """Return the signs of the largest efforts that were found, worst first."""
        effort = self.effort(x)
        rows = np.zeros(effort.values.size, dtype=int)
        return Separation(effort.signs, rows, effort.values - x[self.bound], effort.upper - float(x[self.bound]))

    def enclosure(self, x: Array, lower: Array, upper: Array) -> Enclosure:
        """Return a proven bound of the violation, for all signs."""
        violation = self.settled(x)[self.bound] - x[self.bound]
        return Enclosure(np.full(len(lower), violation), np.zeros(len(lower), dtype=int))

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader."""
        signs = index[: self.prices.size]
        text = f"{self.name}: the control against {signs.size} signs <= the cost"
        description = TimedExplanation(text, self.name, text, 0.0, self._row_signs[row] * signs)
        return describe_deviations(description, self.loop, index[self.prices.size :])
