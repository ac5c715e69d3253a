"""Equalities to rounding: what a solver leaves of them is taken away, by moving entries that are free to move."""

from __future__ import annotations

import numpy as np

from sparserob_core.shapes import Bool, Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.image import move_within_bounds

CORRECTION_STEPS = 3  # of least squares, at most, each with the residual of the last one
SUM_ROUNDING = 2.0**-52  # of the numbers that are added up, what is left to rounding
# Of the numbers that are added up: what misses an equality by more is no answer that rounding spoilt
SPOILT_RESIDUAL = 1e-6
SAME_BOUND_SHARE = 1e-13  # of a bound, a distance from it that is none
RANK_TOLERANCE = 1e-12  # of the largest singular value: a row below depends on others


@shaped
def project_onto_equalities(program: FiniteProgram, x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return a point near ``x (n,)`` that misses ``A x = b`` by less, down to rounding where that is possible.

    ``x`` itself is returned where it is as good already, where it misses an equality by more than `SPOILT_RESIDUAL`,
    and where nothing is better. The correction is the least-norm correction among those that leave every image at 0 and
    at its bounds where it is: the cost has its kinks there, and an entry of 0 is to stay 0. What is missed is summed in
    extended precision.
    """
    share = program.equality_residual(x)
    if not SUM_ROUNDING < share <= SPOILT_RESIDUAL:
        return x
    is_still = _find_active_images(program, x)
    rows, free = (program.A[:, ~is_still], ~is_still) if program.S is None else (program.A, np.full(program.n, True))
    if program.S is not None:
        rows = np.vstack([rows, program.S[np.flatnonzero(is_still)].toarray()])
    for _ in range(CORRECTION_STEPS):
        residual = np.zeros(rows.shape[0])
        residual[: program.b.size] = -program.excess(x)
        size = np.sqrt(np.einsum("ij,ij->i", rows, rows))
        size = np.where(size > 0.0, size, 1.0)
        trial = x.copy()
        trial[free] += np.linalg.lstsq(rows / size[:, None], residual / size, rcond=RANK_TOLERANCE)[0]
        trial = move_within_bounds(program, trial)
        trial_share = program.equality_residual(trial)
        if not trial_share < share:
            break
        x, share = trial, trial_share
        if share <= SUM_ROUNDING:
            break
    return x


@shaped
def _find_active_images(program: FiniteProgram, x: Float[Array, " n"]) -> Bool[np.ndarray, " k"]:
    """Return images at a bound, and those of 0 that cost something: they are to stay where they are."""
    image, still = program.image(x), np.zeros(program.weights.size, dtype=bool)
    terms = np.abs(x) if program.S is None else np.asarray(abs(program.S) @ np.abs(x))
    for bound in (program.lower, program.upper, np.where(program.weights > 0.0, 0.0, np.inf)):
        finite = np.isfinite(bound)
        distance = np.abs(image - np.where(finite, bound, 0.0))
        still |= finite & (distance <= SAME_BOUND_SHARE * np.maximum(np.abs(np.where(finite, bound, 0.0)), terms))
    return still
