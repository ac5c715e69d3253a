"""Curved control sets: ``c'u(t) <= h(c)`` on every piece, with the normal direction as an index."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sparserob_core.control.constraints.explanation import TimedExplanation
from sparserob_core.control.constraints.local_maxima import climb
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.sets.directions import across, on_surface, sampled, unit
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import ConstraintFamily, Explanation, Separation

CLIMBED = 16  # pieces, those furthest outside, whose direction is refined per round


@dataclass(frozen=True, eq=False)
class ControlConstraint:
    """``u(t)`` in a curved set on every piece; the index is ``(t, z)`` with ``z`` in ``[-1, 1]^m`` a direction, not
    normalised."""

    set: ConvexSet
    dictionary: Dictionary

    def family(self) -> ConstraintFamily:
        """The constraint as a family; it does not depend on any uncertainty."""
        m = self.set.dimension
        index_set = Box(np.concatenate([[0.0], -np.ones(m)]), np.concatenate([[self.dictionary.horizon], np.ones(m)]))
        family = ConstraintFamily(
            name="control",
            index_set=index_set,
            rows=self.rows,
            worst=self.worst,
            gradient=self.gradient,
            explain=self.explain,
            source=self,
        )
        return replace(family, nominal=family, sample=lambda count, rng: family, literal=family)

    def rows(self, indices: Array) -> tuple[Array, Array]:
        """``G (k, 1, n)``, ``rhs (k, 1)`` at indices ``(k, 1 + m)``."""
        directions = unit(self.set, indices[:, 1:])
        values = self.dictionary.values[:, self._piece(indices[:, 0])].T
        G = np.einsum("kc,kn->kcn", directions, values).reshape(indices.shape[0], 1, -1)
        return G, self.set.support(directions)[:, None]

    def gradient(self, x: Array, indices: Array, rows: Array) -> Array:
        """The derivative ``(k, 1 + m)`` of ``row x - rhs`` in the index: 0 in time, since the control is constant on
        every piece."""
        z = np.asarray(indices, dtype=float)[:, 1:]
        control = self.dictionary.control(x)[:, self._piece(indices[:, 0])].T
        turned = across(self.set, z, (control - self.set.support_point(unit(self.set, z))) @ self.set.frame.T)
        return np.hstack([np.zeros((z.shape[0], 1)), turned])

    def worst(self, x: Array) -> Separation:
        """The pieces furthest outside, each with its worst direction; the bound is exact, since the pieces are finitely
        many."""
        control = self.dictionary.control(x).T
        outside = self.set.gauge(control) - 1.0
        pieces = np.argsort(-outside, kind="stable")[:CLIMBED]
        z = sampled(self.set.dimension)
        c = unit(self.set, z)
        start = z[(control[pieces] @ c.T - self.set.support(c)).argmax(axis=1)]

        def excess(points: Array, which: np.ndarray) -> Array:
            directions = unit(self.set, points)
            answer: Array = np.einsum("kc,kc->k", directions, control[pieces[which]]) - self.set.support(directions)
            return answer

        z, found = climb(
            excess, start, np.full(self.set.dimension, 0.1), lambda points: on_surface(np.clip(points, -1.0, 1.0))
        )
        order = np.argsort(-found, kind="stable")
        middles = (self.dictionary.breakpoints[:-1] + self.dictionary.breakpoints[1:]) / 2
        indices = np.hstack([middles[pieces[order], None], z[order]])
        return Separation(indices, np.zeros(order.size, dtype=int), found[order], float(outside.max()))

    def explain(self, index: Array, row: int) -> Explanation:
        """One constraint for people."""
        text = f"control: u({index[0]:.6g}) in the {self.set.kind}"
        return TimedExplanation(text, "control", text, float(index[0]), unit(self.set, index[None, 1:])[0])

    def _piece(self, times: Array) -> np.ndarray:
        return np.clip(
            np.searchsorted(self.dictionary.breakpoints, times, side="right") - 1, 0, self.dictionary.pieces - 1
        )
