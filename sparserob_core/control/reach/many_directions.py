"""Worst-case functionals along many directions at the same times: what is linear in a direction is computed once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.control.reach.disturbance_support import DisturbanceSupport
from sparserob_core.control.reach.functional import CHUNK, WorstFunctionals
from sparserob_core.control.response.inner_loop import Weights
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array

# Numbers of a product over many directions that are made at once (2 MB), so that they stay near the processor. With
# sixteen times as many a curved wall is sampled in up to twice the time; with a fourth part of them in no less.
NEAR = 250_000


@final
@dataclass(frozen=True, eq=False)
class ManyDirections:
    """Samples of `WorstFunctionals` along many directions; nothing is proven with them."""

    functionals: WorstFunctionals

    def turning(self, theta: Array, times: Array, parameters: Array) -> Callable[[Array, np.ndarray], Array]:
        """Return ``max_w c'x(t)`` at a decision as a function of the direction alone, at ``times (k,)`` and
        ``parameters (k, nu)``.

        The function takes directions ``(j, d)`` and the indices ``(j,)`` of their times, in groups of equal size, and
        returns values ``(j,)``. Weights are linear in the direction, so those of the axes are computed once. The
        contributions of measurable disturbances and of errors of execution are approximations: of the errors only those
        that are constant on pieces count.
        """
        functionals = self.functionals
        weights, control = self._weigh_axes(times, parameters), functionals.on_grid(theta)
        states = weights.free @ functionals.response.initial_state + np.einsum("kdlm,ml->kd", weights.control, control)
        model, measurable = functionals.disturbance, functionals.measurable
        by_block = None if model is None else model.on_blocks
        blocks = np.zeros((*states.shape, 0, 0)) if by_block is None else by_block.blocks(weights.disturbance)
        error_sizes = functionals.bound_execution_errors(theta)
        error_pieces = np.flatnonzero(error_sizes.any(axis=0))
        error_weights = (
            weights.control[:, :, error_pieces, : functionals.channels] * error_sizes[:, error_pieces].T
        ).reshape(*states.shape, -1)

        def along(directions: Array, which: np.ndarray) -> Array:
            places = which[np.flatnonzero(np.diff(which, prepend=-1))]
            c = directions.reshape(places.size, -1, directions.shape[1])
            values: Array = (c * states[places, None]).sum(axis=2)
            for chunk in _divide_range(places.size, max(1, NEAR // max(1, c[:1, :, 0].size * blocks[:1, 0].size))):
                indices, chunk_directions = places[chunk], c[chunk]
                free = chunk_directions @ weights.free[indices]
                values[chunk] += functionals.initial_support(free.reshape(-1, free.shape[2])).reshape(free.shape[:2])
                if by_block is not None:
                    on_blocks = chunk_directions @ blocks[indices].reshape(*blocks[indices].shape[:2], -1)
                    values[chunk] += by_block.support_from_blocks(on_blocks.reshape(*free.shape[:2], *blocks.shape[2:]))
                if error_weights.shape[2]:
                    values[chunk] += np.abs(chunk_directions @ error_weights[indices]).sum(axis=2)
            if measurable is not None:
                values += measurable.roughly(times[which], directions, parameters[which]).reshape(values.shape)
            return values.reshape(-1)

        return along

    @shaped
    def profile(
        self, times: Float[Array, " k"], directions: Float[Array, "r d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "k r"]:
        """Return ``sigma (k, r)`` at one parameter, for all ``times (k,)`` and ``directions (r, d)``; by the age of the
        pieces where the grid allows."""
        functionals = self.functionals
        model, (k, r) = functionals.disturbance, (times.size, directions.shape[0])
        changes = functionals.response.grid.mode is not None
        by_block, measurable = None if model is None else model.on_blocks, functionals.measurable
        aged = by_block is None or (functionals.response.uniform and by_block.by_piece)
        if (changes or not aged) and r > directions.shape[1] and measurable is None:
            return self._profile_by_axes(times, directions, parameter)
        if changes or not aged:
            repeated = np.broadcast_to(parameter, (k * r, parameter.size))
            return functionals.offsets(np.repeat(times, r), np.tile(directions, (k, 1)), repeated).reshape(k, r)
        sigma, chunk_size = np.zeros((k, r)), max(1, CHUNK // (r * directions.shape[1]))
        if by_block is not None:
            lifted = functionals.over_cells.at(parameter)
            sigma = DisturbanceSupport(lifted, by_block, directions).at(times, np.zeros((k, r, 0)))[0][:, :, 0]
        if measurable is not None:
            for chunk in _divide_range(k, chunk_size):
                pairs = np.repeat(times[chunk], r), np.tile(directions, (times[chunk].size, 1))
                sigma[chunk] += measurable(*pairs, np.broadcast_to(parameter, (pairs[0].size, parameter.size))).reshape(
                    -1, r
                )
        if functionals.initial is not None:
            for chunk in _divide_range(k, chunk_size):
                rows = functionals.response.propagator.backwards(times[chunk], directions, parameter)
                sigma[chunk] += functionals.initial.support(rows)
        return sigma

    def _profile_by_axes(self, times: Array, directions: Array, parameter: Array) -> Array:
        """Return the `profile` of more directions than there are axes: what the axes give to the blocks of the
        disturbance does for all directions, in which it is linear."""
        functionals = self.functionals
        (r, d), model = directions.shape, functionals.disturbance
        sigma = np.zeros((times.size, r))
        chunk_size = max(1, CHUNK // (d * functionals.response.numbers(parameter.size)))
        for chunk in _divide_range(times.size if functionals.disturbed else 0, chunk_size):
            weights = self._weigh_axes(times[chunk], np.broadcast_to(parameter, (times[chunk].size, parameter.size)))
            k = weights.free.shape[0]
            sigma[chunk] = functionals.initial_support((directions @ weights.free).reshape(k * r, d)).reshape(k, r)
            if model is None:
                continue
            blocks = model.blocks(weights.disturbance)
            for inner_chunk in _divide_range(k, max(1, NEAR // (r * blocks[0, 0].size))):
                active_blocks = blocks[inner_chunk][:, :, blocks[inner_chunk].any(axis=(0, 1, 3))]
                projected = directions @ active_blocks.reshape(active_blocks.shape[0], d, active_blocks[0, 0].size)
                sigma[chunk][inner_chunk] += model.support_from_blocks(
                    projected.reshape(active_blocks.shape[0], r, *active_blocks.shape[2:])
                )
        return sigma

    def _weigh_axes(self, times: Array, parameters: Array) -> Weights:
        """Return the weights of the functionals along the axes at times ``(k,)``, with one dimension more, ``(k, d,
        ...)``."""
        functionals = self.functionals
        d = functionals.response.initial_state.size
        axes = np.tile(np.eye(d), (times.size, 1))
        repeated = [np.repeat(values, d, axis=0) for values in (times, parameters)]
        chunks = [
            functionals.response.weights(repeated[0][chunk], axes[chunk], repeated[1][chunk])
            for chunk in functionals.chunks(repeated[1])
        ]
        arrays = [
            np.concatenate([getattr(weights, name) for weights in chunks])
            for name in ("free", "control", "disturbance")
        ]
        return Weights(*(array.reshape(times.size, d, *array.shape[1:]) for array in arrays))


def _divide_range(count: int, several: int) -> list[slice]:
    """Return slices that divide ``count`` numbers into parts of at most ``several``."""
    return [slice(first, first + several) for first in range(0, count, several)]
