"""Strictly convex quadratics: ridge, weighted ridge, smoothness."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, final

import numpy as np
from pydantic import Field

import sparserob_core as sr

if TYPE_CHECKING:
    from scipy.sparse import csc_array

Positive = Annotated[float, Field(gt=0.0)]


@final
class Ridge(sr.Regulariser, sr.Options):
    """``1/2 |theta|^2``: the sum of the squared coefficients."""

    def quadratic(self, image: sr.ControlImage) -> tuple[csc_array, sr.Array]:
        """Return the identity and zero."""
        from scipy.sparse import eye_array

        n = image.S.shape[1]
        return eye_array(n, format="csc"), np.zeros(n)


@final
class WeightedRidge(sr.Regulariser, sr.Options):
    """``1/2 int sum_i weights_i u_i(t)^2 dt``: the energy of the control, whatever the dictionary."""

    weights: Positive | list[Positive] = 1.0
    """Weight of every control; a number serves every control."""

    def quadratic(self, image: sr.ControlImage) -> tuple[csc_array, sr.Array]:
        """Return ``S' diag(weights * lengths) S`` and zero; positive definite, since a dictionary's functions are
        independent."""
        from scipy.sparse import csc_array, diags_array

        energy = diags_array(image.lengths * np.repeat(_per_channel(self.weights, image.channels), image.pieces))
        return csc_array(image.S.T @ energy @ image.S), np.zeros(image.S.shape[1])


@final
class Smoothness(sr.Regulariser, sr.Options):
    """``1/2 sum of squared jumps of the control + ridge/2 |theta|^2``: prefers few and small steps."""

    ridge: float = Field(default=1e-3, gt=0.0)
    """Factor of the squared coefficients, which make it strictly convex."""

    def quadratic(self, image: sr.ControlImage) -> tuple[csc_array, sr.Array]:
        """Return ``(D S)' (D S) + ridge I`` with ``D`` the differences of neighbouring pieces of each control, and
        zero."""
        from scipy.sparse import csc_array, diags_array, eye_array, kron

        n, pieces = image.S.shape[1], image.pieces
        step = diags_array([-np.ones(pieces - 1), np.ones(pieces - 1)], offsets=[0, 1], shape=(pieces - 1, pieces))
        jumps = kron(eye_array(image.channels), step, format="csc") @ image.S
        return csc_array(jumps.T @ jumps + self.ridge * eye_array(n, format="csc")), np.zeros(n)


def _per_channel(weights: float | list[float], channels: int) -> sr.Array:
    values = weights if isinstance(weights, list) else [weights] * channels
    if len(values) != channels:
        raise sr.InputError(f"weights: expected {channels} numbers, one per control, got {len(values)}")
    return np.array(values)


@sr.hookimpl
def sparserob_regularisers() -> Iterator[sr.RegulariserPlugin]:
    """Offer the shipped regularisers."""
    yield sr.RegulariserPlugin(name="ridge", factory=Ridge, summary="Sum of the squared coefficients.")
    yield sr.RegulariserPlugin(
        name="weighted_ridge", factory=WeightedRidge, summary="Energy of the control, weighted by channel."
    )
    yield sr.RegulariserPlugin(
        name="smoothness", factory=Smoothness, summary="Squared jumps of the control, and a small ridge."
    )
