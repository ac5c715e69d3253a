"""The paper's own index: the disturbance stays in it, beside the time and the parameter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.constraints.sensitivity import Sensitivity
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.program import ConstraintFamily, Explanation, Separation


@dataclass(frozen=True, eq=False)
class LiteralConstraint:
    """A state constraint whose index is ``(t, Beta, p)``, and a direction where the set is curved.

    ``Beta`` are the coefficients of the disturbance's blocks, block by block, in the bounding box of their set;
    coefficients outside the set are drawn to it along the ray from an interior point. Maximised over ``Beta`` it is the
    reduced constraint, exactly.
    """

    base: StateConstraint
    disturbance: DisturbanceModel

    def family(self, reduced: ConstraintFamily) -> ConstraintFamily:
        """Return the constraint as a family; proofs go through ``reduced``."""
        lower, upper = self.base.index_set.lower, self.base.index_set.upper
        block, count = self._blocks.box, self.disturbance.block_count
        index_set = Box(
            np.concatenate([lower[:1], np.tile(block.lower, count), lower[1:]]),
            np.concatenate([upper[:1], np.tile(block.upper, count), upper[1:]]),
        )
        return ConstraintFamily(
            name=self.base.name,
            index_set=index_set,
            rows=self.rows,
            worst=self.worst,
            gradient=self.gradient,
            linear=np.concatenate([[False], np.tile(self._is_movable, count), np.zeros(lower.size - 1, dtype=bool)]),
            steepest=self.steepest,
            reduced=reduced,
            explain=self.explain,
            formulation="literal",
            measured=self.base.measured,
            along=self.base.functionals.names.time,
            source=self.base,
        )

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the reduced constraint at the time and the parameter of the index."""
        return self.base.explain(self._split_indices(index[None])[0][0], row)

    def rows(self, indices: Array) -> tuple[Array, Array]:
        """Return ``G (k, r, n)``, ``rhs (k, r)`` at indices ``(k, 1 + beta + ...)``."""
        reduced, beta = self._split_indices(indices)
        times, directions, parameters, rhs = self.base.functionals_at(reduced)
        per_index = times.size // indices.shape[0]
        signals = np.repeat(self._compute_signals(beta), per_index, axis=0)
        G, offset = self.base.functionals.rows_under(times, directions, parameters, signals)
        direct = self.base.direct(reduced[:, 0])
        G = G if direct is None else G + direct
        shape = (indices.shape[0], per_index)
        return G.reshape(*shape, -1), (rhs - offset).reshape(shape)

    def worst(self, x: Array) -> Separation:
        """Return the separation of the reduced constraint, with the worst disturbance of each index written out."""
        separation = self.base.worst(x)
        times, directions, parameters, _ = self.base.functionals_at(separation.indices)
        per_index = times.size // separation.rows.size
        pick = np.arange(separation.rows.size) * per_index + separation.rows
        blocks = self.base.functionals.worst_blocks(times[pick], directions[pick], parameters[pick]).reshape(
            separation.rows.size, -1
        )
        indices = np.hstack([separation.indices[:, :1], blocks, separation.indices[:, 1:]])
        return Separation(indices, separation.rows, separation.violations, separation.bound)

    def gradient(self, x: Array, indices: Array, rows: Array) -> Array:
        """Return the derivative ``(k, d)`` of ``row x - rhs`` in the index (`Sensitivity`); in ``Beta``: the functional
        on every block."""
        reduced, beta = self._split_indices(np.asarray(indices, dtype=float))
        slopes, weights = self._sensitivity.slopes(x, reduced, rows, self._compute_signals(beta))
        size, moves = self.disturbance.set.dimension, np.tile(self._is_movable, self.disturbance.block_count)
        in_beta = self._blocks.pulled_back(
            beta.reshape(-1, size), self.disturbance.blocks(weights).reshape(-1, size)
        ).reshape(beta.shape)
        return np.hstack([slopes[:, :1], in_beta * moves, slopes[:, 1:]])

    def steepest(self, x: Array, indices: Array, rows: np.ndarray) -> Separation:
        """Return the worst disturbance of every index for one row, ``rows (k,)``; for -1 of the row that is violated
        most."""
        reduced, beta = self._split_indices(np.asarray(indices, dtype=float))
        times, directions, parameters, _ = self.base.functionals_at(reduced)
        r = times.size // len(reduced)
        values = self.base.violations(x, np.repeat(reduced, r, axis=0), np.tile(np.arange(r), len(reduced)))
        values = values.reshape(len(reduced), r)
        chosen = np.where(rows >= 0, rows, values.argmax(axis=1))
        pick = np.arange(chosen.size) * values.shape[1] + chosen
        blocks = self.base.functionals.worst_blocks(times[pick], directions[pick], parameters[pick])
        worst = np.hstack([indices[:, :1], blocks.reshape(beta.shape), indices[:, 1 + beta.shape[1] :]])
        return Separation(worst, chosen, values.ravel()[pick], formulation="literal")

    @cached_property
    def _sensitivity(self) -> Sensitivity:
        return Sensitivity(self.base)

    @cached_property
    def _is_movable(self) -> np.ndarray:
        """True for each coefficient of a block that has more than one value."""
        box = self._blocks.box
        return np.asarray(box.upper > box.lower)

    @cached_property
    def _blocks(self) -> ParameterIndex:
        return ParameterIndex(self.disturbance.set)

    def _split_indices(self, indices: Array) -> tuple[Array, Array]:
        """Return the reduced index, and the coefficients of the disturbance."""
        beta = self.disturbance.block_count * self.disturbance.set.dimension
        if indices.shape[1] == 1 + beta:
            return indices[:, :1], indices[:, 1:]
        return np.hstack([indices[:, :1], indices[:, 1 + beta :]]), indices[:, 1 : 1 + beta]

    def _compute_signals(self, beta: Array) -> Array:
        blocks = self._blocks.clamp(beta.reshape(-1, self.disturbance.set.dimension))
        return self.disturbance.signals(
            blocks.reshape(beta.shape[0], self.disturbance.block_count, self.disturbance.set.dimension)
        )
