"""Admissible disturbances, and the largest effect of any of them on the state.

Every class but the measurable one is a product of copies of one convex set ``D``, one copy per *block*. The state is
linear in the blocks, so the worst disturbance at a given index is found block by block: ``sigma = sum_b h_D(y_b)`` with
``h_D`` the support function of ``D`` (Rockafellar 1970, Corollary 16.4.1). It does not depend on the control: the
disturbance is eliminated exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from sparserob_core.control.combinations import refusal
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.disturbances import Breakpoints, Classes, select_class
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.control.sets.sets import NormBall, Polytope, product
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet


@dataclass(frozen=True, eq=False)
class DisturbanceModel:
    """Blocks of the disturbance, from the weights ``y (..., L, mw)`` of a functional on the disturbance on every grid
    piece.

    Each block ranges over ``set``, in ``q`` dimensions. With ``starts (nb,)``, a block is the value of the disturbance
    on several grid pieces, of which ``starts`` are the first. Otherwise a block holds coefficients of the ``functions
    (N, L)`` on the grid pieces: one block of ``mw N`` coefficients, channel-major, or one block of ``N`` coefficients
    for each channel, times its ``scale (mw,)``.

    ``held_components``: components whose value is held over several blocks, and for each of their own pieces the number
    of its first block, ``(g,)``. The weights on all of these blocks are added to the first, which has their value.
    ``classes``: the classes of the parts of ``bound``, for a disturbance of ``several`` classes. The blocks are then
    those of disturbances that are all constant on pieces, which are admissible.
    """

    kind: Literal["piecewise_constant", "measurable", "l1_ball", "several"]
    set: ConvexSet
    bound: ConvexSet
    grid: TimeGrid
    starts: np.ndarray | None = None
    functions: Array | None = None
    scale: Array | None = None
    classes: Classes = ()
    held_components: tuple[tuple[slice, np.ndarray], ...] = ()

    @cached_property
    def on_blocks(self) -> DisturbanceModel | None:
        """Model of the disturbances that consist of blocks, ``None`` where all are measurable."""
        if self.kind == "measurable":
            return None
        if self.kind != "several":
            return self
        held_set = select_class(self.bound, self.classes, "piecewise_constant")
        assert held_set is not None
        return replace(self, kind="piecewise_constant", set=held_set, bound=held_set, classes=())

    @cached_property
    def measurable(self) -> ConvexSet | None:
        """Set of the measurable disturbances, ``None`` where there are none."""
        return select_class(self.bound, self.classes if self.kind == "several" else self.kind, "measurable")

    @property
    def channels(self) -> int:
        """Number ``mw`` of disturbances."""
        return self.bound.dimension

    @property
    def radius(self) -> float:
        """An upper bound of the 2-norm of any admissible disturbance at any time."""
        if self.scale is not None and self.functions is not None:
            return float(np.linalg.norm(self.scale) * np.abs(self.functions).max())
        return self.bound.radius_bound

    @shaped
    def held(self, point: Float[Array, " mw"]) -> DisturbanceModel | None:
        """Return the model with a single disturbance, which stays at a ``point (mw,)``; ``None`` for the point 0."""
        if not point.any():
            return None
        single = Box(point, point)
        return DisturbanceModel("piecewise_constant", single, single, self.grid, starts=np.arange(self.grid.pieces))

    @property
    def by_piece(self) -> bool:
        """True where each block is one piece of the grid, and no component is held over several of them."""
        return self.starts is not None and self.starts.size == self.grid.pieces and not self.held_components

    @shaped
    def blocks(self, weights: Float[Array, "*k L mw"]) -> Float[Array, "*k nb q"]:
        """Return the weights of a functional on every block, ``(..., nb, q)``, from weights ``(..., L, mw)``. The map
        is linear, so it also serves Taylor coefficients."""
        if self.by_piece:
            return weights
        if self.starts is not None:
            return self._gather_weights(np.add.reduceat(weights, self.starts, axis=-2))
        assert self.functions is not None
        coefficients = np.einsum("...li,jl->...ij", weights, self.functions)
        if self.scale is None:
            return np.asarray(coefficients.reshape(*coefficients.shape[:-2], 1, -1))
        return np.asarray(coefficients * self.scale[:, None])

    def _gather_weights(self, blocks: Array) -> Array:
        """Return the weights on every block, ``(..., nb, mw)``. Weights on components that are held over several blocks
        are added to the first of these."""
        if not self.held_components:
            return blocks
        gathered = blocks.copy()
        for columns, first in self.held_components:
            gathered[..., columns] = 0.0
            gathered[..., first, columns] = np.add.reduceat(blocks[..., columns], first, axis=-2)
        return gathered

    @shaped
    def support(self, weights: Float[Array, "*k L mw"]) -> Float[Array, " *k"]:
        """Return the support value ``sigma (...,)``: the largest value of the functional over the admissible
        disturbances."""
        return self.support_from_blocks(self.blocks(weights))

    @shaped
    def support_from_blocks(self, blocks: Float[Array, "*k nb q"]) -> Float[Array, " *k"]:
        """Return the support value of a functional with weights on every block, ``(..., nb, q)``."""
        if self._radii is None:
            answer: Array = self.set.support(blocks).sum(axis=-1)
            return answer
        return np.asarray(np.abs(blocks).reshape(*blocks.shape[:-2], -1) @ np.tile(self._radii, blocks.shape[-2]))

    @cached_property
    def _radii(self) -> Array | None:
        """Half the widths ``(q,)`` of a set that is a box about 0, otherwise ``None``; with them one product sums up
        all blocks."""
        about = isinstance(self.set, Box) and self.set.is_bounded and np.array_equal(self.set.lower, -self.set.upper)
        return self.set.upper if isinstance(self.set, Box) and about else None

    @shaped
    def worst(self, weights: Float[Array, "*k L mw"]) -> Float[Array, "*k mw L"]:
        """Return a disturbance ``(..., mw, L)`` on the grid's pieces that attains `support`, of those that are constant
        on the blocks."""
        return self.signals(self.set.support_point(self.blocks(weights)))

    @property
    def block_count(self) -> int:
        """Number of blocks."""
        if self.starts is not None:
            return int(self.starts.size)
        return self.channels if self.scale is not None else 1

    @shaped
    def signals(self, points: Float[Array, "*k nb q"]) -> Float[Array, "*k mw L"]:
        """Return disturbances ``(..., mw, L)`` on the grid's pieces from one point of the set per block, ``(..., nb,
        q)``."""
        if self.by_piece:
            return np.swapaxes(points, -1, -2)
        if self.starts is not None:
            block_of_piece = np.searchsorted(self.starts, np.arange(self.grid.pieces), side="right") - 1
            values = points[..., block_of_piece, :]
            for columns, first in self.held_components:
                first_blocks = first[np.searchsorted(first, block_of_piece, side="right") - 1]
                values[..., columns] = points[..., first_blocks, columns]
            return np.swapaxes(values, -1, -2)
        assert self.functions is not None
        points = self.set.inside(points)
        coefficients = points if self.scale is not None else points.reshape(*points.shape[:-2], self.channels, -1)
        signal = np.einsum("...ij,jl->...il", coefficients, self.functions)
        answer: Array = signal if self.scale is None else signal * self.scale[:, None]
        return answer


def disturbance_model(
    kind: Classes, bound: ConvexSet, dictionary: Dictionary, grid: TimeGrid, breakpoints: Breakpoints | None = None
) -> DisturbanceModel:
    """Return the model of a disturbance class.

    ``piecewise_constant``: every combination of the dictionary's functions whose values stay in ``bound`` on every
    piece; ``measurable``: every measurable function with values in ``bound``; ``l1_ball``: coefficients with
    ``||beta_i||_1 <= bound_i`` per channel (the paper's sufficient condition read as an uncertainty set, far smaller).
    ``breakpoints``: the breakpoints of every part of a product; they are among those of the dictionary.
    """
    if not bound.is_pointwise:
        return _join_pieces(bound, dictionary, grid)
    if kind == "measurable":
        return DisturbanceModel("measurable", bound, bound, grid, starts=np.arange(grid.pieces))
    if not isinstance(kind, str):
        if not dictionary.is_complete:
            raise refusal("two classes", "few functions")
        alone = disturbance_model("piecewise_constant", bound, dictionary, grid)
        return replace(alone, kind="several", classes=kind)
    if kind == "l1_ball":
        return _bound_coefficients(bound, dictionary, grid)
    merged = dictionary.merged()
    if dictionary.is_complete:
        piece_indices = np.clip(
            np.searchsorted(merged.breakpoints, _compute_middles(grid), side="right") - 1,
            0,
            merged.breakpoints.size - 2,
        )
        starts = np.flatnonzero(np.diff(piece_indices, prepend=-1))
        plain = DisturbanceModel("piecewise_constant", bound, bound, grid, starts=starts)
        if breakpoints is None:
            return plain
        held_components = _find_held_components(bound, breakpoints, _compute_middles(grid)[starts])
        return replace(plain, set=product(bound.factors), held_components=held_components)
    flat = bound.halfspaces()
    if flat is None:
        raise InputError(
            "fewer functions than pieces needs a disturbance set with flat sides (box, polytope, 1-norm or inf-norm),"
            f" got {bound.kind}",
            path="dictionaries.disturbance",
        )
    H, h = flat
    rows = np.einsum("ri,jk->krij", H, merged.values).reshape(-1, H.shape[1] * merged.values.shape[0])
    coupled = Polytope(rows, np.tile(h, merged.pieces))
    return DisturbanceModel("piecewise_constant", coupled, bound, grid, functions=dictionary.at(grid.disturbance_piece))


def _bound_coefficients(bound: ConvexSet, dictionary: Dictionary, grid: TimeGrid) -> DisturbanceModel:
    """Return the model of coefficients whose absolute sum is bounded, channel by channel."""
    box = bound.bounding_box()
    if not bound.is_box or not np.array_equal(box.lower, -box.upper):
        raise InputError("l1_ball needs a disturbance box that is symmetric about 0", path="disturbance_class")
    ball = NormBall(p=1.0, radius=1.0, dimension=dictionary.functions)
    return DisturbanceModel(
        "l1_ball", ball, bound, grid, functions=dictionary.at(grid.disturbance_piece), scale=box.upper
    )


def _join_pieces(bound: ConvexSet, dictionary: Dictionary, grid: TimeGrid) -> DisturbanceModel:
    """Return the model of a set that couples the values at different times: one block of the values on all pieces."""
    if not dictionary.is_indicators:
        raise InputError("a budget needs a dictionary of one function for each piece", path="dictionaries.disturbance")
    values = dictionary.at(grid.disturbance_piece)
    signals = bound.of_signals(values @ np.diff(grid.breakpoints))
    return DisturbanceModel("piecewise_constant", signals, bound, grid, functions=values)


def _find_held_components(
    bound: ConvexSet, breakpoints: Breakpoints, middles: Array
) -> tuple[tuple[slice, np.ndarray], ...]:
    """Return the field ``held_components`` of a `DisturbanceModel` for blocks that contain these ``middles``, one time
    each."""
    held_components, column = list[tuple[slice, np.ndarray]](), 0
    for factor, times in zip(bound.factors, breakpoints, strict=True):
        columns = slice(column, column + factor.dimension)
        column = columns.stop
        assert times is not None
        first = np.flatnonzero(np.diff(np.searchsorted(times, middles), prepend=-1))
        if first.size < middles.size:
            held_components.append((columns, first))
    return tuple(held_components)


def _compute_middles(grid: TimeGrid) -> Array:
    return (grid.breakpoints[:-1] + grid.breakpoints[1:]) / 2
