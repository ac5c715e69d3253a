"""Upper bounds of what a closed loop reaches under any deviation, over cells of time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.control.feedback.closed_loop import ROUND_OFF, ClosedLoop
from sparserob_core.control.reach.varying_motion import VaryingMotion
from sparserob_core.sip.convex_set import Array

TERMS = 8  # of the Taylor expansion that bounds a curvature


@final
@dataclass(frozen=True, eq=False)
class LoopBounds:
    """The bounds of a ``loop``, for which rounding is counted."""

    loop: ClosedLoop

    def over_cells(
        self,
        x: Array,
        lower: Array,
        upper: Array,
        H: Array,
        added_terms: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:
        """Return upper bounds ``(k, r)`` of ``max_w H x(t)`` over cells of time ``[lower, upper] (k,)``, each within
        one piece of the grid, for ``H (r, d)``; and the part of each that is due to the length of the
        cell. ``added_terms``: terms that are added at both ends, ``(k, r, 1 + Q)`` or ``(k, r, 1)`` each, and linear
        between.

        On a cell every functional is within ``(b - a)^2 / 8`` times its largest second derivative of its chord, and a
        support function of a chord lies below the chord of the support functions.
        """
        pieces = self.loop.grid.locate((lower + upper) / 2)
        states, rounding_errors = self._enclose_states(x, np.concatenate([lower, upper]), np.tile(pieces, 2))
        ends, rounding_errors = np.split(states, 2), np.maximum(*np.split(rounding_errors, 2))
        along = [H @ end for end in ends]
        radii = np.concatenate([[1.0], self.loop.spread.radii])
        chord_distances = self._bound_chord_errors(x, H, lower, upper - lower, pieces, ends[0])
        sizes = np.abs(H) @ np.maximum(np.abs(ends[0]), np.abs(ends[1]))
        for end, addition in zip(along, added_terms or (), strict=False):
            end[..., : addition.shape[-1]] += addition
            sizes[..., : addition.shape[-1]] += np.abs(addition)
        heights, error_bounds = [self.loop.height(functional) for functional in along], ROUND_OFF * (sizes @ radii)
        error_bounds += (np.abs(H) @ rounding_errors[:, :, None])[:, :, 0]
        if self.loop.motion is not None:
            transition_errors = self._bound_transition_errors(x, self.loop.motion)[pieces]
            error_bounds += (np.abs(H) @ transition_errors[:, :, None])[:, :, 0]
        bounds = np.maximum(*heights) + chord_distances + error_bounds
        return np.where(np.isnan(bounds), np.inf, bounds), chord_distances

    def _enclose_states(self, x: Array, times: Array, pieces: np.ndarray) -> tuple[Array, Array]:
        """Return the states (`ClosedLoop.states`) at ``times (k,)`` on these pieces, and bounds ``(k, d)`` of their
        rounding errors under any deviation."""
        nodes, drives = self.loop.path(x)
        flow, input_flow = self.loop.compute_flows(
            pieces, np.clip(times - self.loop.grid.breakpoints[pieces], 0.0, None)
        )
        sizes, drive_sizes, errors, drive_errors = self.loop.bound_rounding_errors(x)
        magnitudes = np.abs(flow) @ sizes[pieces, :, None] + np.abs(input_flow) @ drive_sizes[pieces, :, None]
        rounding_errors = ROUND_OFF * magnitudes + np.abs(flow) @ errors[pieces, :, None]
        rounding_errors += np.abs(input_flow) @ drive_errors[pieces, :, None]
        return np.asarray(flow @ nodes[pieces] + input_flow @ drives[pieces]), rounding_errors[:, :, 0]

    def _bound_chord_errors(
        self, x: Array, H: Array, start: Array, width: Array, pieces: np.ndarray, states: Array
    ) -> Array:
        """Bound the distance of ``H x(t)`` from its chord on every cell ``[start, start + width]``, for any deviations:
        ``(k, r)``. Each cell lies within one of the ``pieces (k,)`` of the grid and begins in
        ``states (k, d, 1 + Q)``."""
        drives, radii = self.loop.path(x)[1][pieces], np.concatenate([[1.0], self.loop.spread.radii])
        if self.loop.motion is not None:
            return self.loop.motion.bound_chord_errors(H, start, width, pieces, states, drives, radii)
        modes = self.loop.grid.modes[pieces]
        A = self.loop.steps.A[0, modes]  # (1, d, d) of one system, (k, d, d) of several
        h, rates = width[:, None, None], A @ states + drives
        row, factor = H @ A, np.ones_like(h)
        second = np.zeros((start.size, H.shape[-2], radii.size))
        for order in range(TERMS):
            second += factor * np.abs(row @ rates)
            row, factor = row @ A, factor * h / (order + 1)
        growth = np.linalg.norm(self.loop.steps.A[0], 2, axis=(1, 2))[modes, None, None] * h
        with np.errstate(over="ignore", invalid="ignore"):
            tail = (
                factor
                * np.exp(growth)
                * np.linalg.norm(row, axis=-1)[..., None]
                * np.linalg.norm(rates, axis=1, keepdims=True)
            )
        return np.asarray((h[..., 0] ** 2 / 8.0) * ((second + tail) @ radii))

    def _bound_transition_errors(self, x: Array, motion: VaryingMotion) -> Array:
        """Bound the error that inexact transitions of a system that changes with time cause in the state on every
        piece, ``(L, d)``."""
        nodes, inputs = self.loop.path(x)
        radii = np.concatenate([[1.0], self.loop.spread.radii])
        state_sizes, input_sizes = np.abs(nodes[:-1]) @ radii, motion.flow.sizes * (np.abs(inputs) @ radii)[:, None]
        return motion.bound_state_errors(state_sizes, input_sizes)
