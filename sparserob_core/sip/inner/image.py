"""Quantities that depend on the image ``s = S x`` alone, remembered between programs that share it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
import numpy.typing as npt

from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

Made = TypeVar("Made")


class Memory:
    """The last few things made from arrays, found again by the identity of those arrays (which it keeps alive)."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._results: OrderedDict[Hashable, tuple[tuple[object, ...], object]] = OrderedDict()

    def recall(self, sources: tuple[object, ...], key: Hashable, make: Callable[[], Made]) -> Made:
        """Return the object that ``make`` made for these very sources and this key; call ``make`` if none is
        remembered."""
        identity = (key, *map(id, sources))
        if identity in self._results:
            self._results.move_to_end(identity)
            return cast(Made, self._results[identity][1])
        result = make()
        self._results[identity] = (sources, result)
        if len(self._results) > self.size:
            self._results.popitem(last=False)
        return result


MAX_PROJECTIONS = 5  # of the multipliers of an image, at most
CANCELLED_SHARE = 1e-13  # of what is added up: what may be left where more cannot be had
# Of the same: what is left by rounding alone, and not worth a projection. With ten times as much a bound is above what
# its multipliers prove by more than what is taken off it; with a tenth of it every exact answer is projected.
STATIONARY_ROUNDING = 4 * 2.0**-52
_factors = Memory(12)


@shaped
def project_onto_stationary(
    program: FiniteProgram, z: Float[Array, " k"], slope: Float[Array, " n"]
) -> Float[Array, " k"]:
    """Return a ``z (k,)`` near the given one with ``S'z + slope = 0`` to round-off, ``slope (n,)``; NaN where there is
    none.

    Where an image is unbounded its multiplier may not exceed its weight: it is held there, and the others make up for
    it.
    """
    S = program.S
    if S is None:
        return -slope
    unbounded_above, unbounded_below = np.isposinf(program.upper), np.isneginf(program.lower)
    is_held = (program.weights == 0) & unbounded_below & unbounded_above
    projected = z
    for number in range(MAX_PROJECTIONS):
        if number or not _is_stationary(S, projected, slope, STATIONARY_ROUNDING):
            z = np.where(is_held, np.clip(z, -program.weights, program.weights), z)
            project = _factors.recall((S,), is_held.tobytes(), partial(_factor_projection, S, ~is_held))
            projected = z - project(S.T @ z + slope)
            projected = projected - project(S.T @ projected + slope)
        limit = program.weights + CANCELLED_SHARE * float(np.abs(projected).max(initial=0.0))
        is_beyond = ~is_held & (unbounded_above & (projected > limit) | unbounded_below & (projected < -limit))
        if not is_beyond.any():
            break
        z, is_held = projected, is_held | is_beyond
    return projected if _is_stationary(S, projected, slope) else np.full_like(projected, np.nan)


@shaped
def move_within_bounds(program: FiniteProgram, x: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the decision ``x (n,)`` with every entry that is an image by itself, or a multiple of one, moved into the
    bounds of that image. An entry that may only be 0 is then 0, without the dust that a solver left."""
    if program.S is None:
        return np.minimum(np.maximum(x, program.lower), program.upper)
    rows, entries, factors = _factors.recall((program.S,), "alone", partial(_find_single_entries, program.S))
    ends = program.lower[rows] / factors, program.upper[rows] / factors
    clipped = x.copy()  # several images may be of one entry
    np.maximum.at(clipped, entries, np.minimum(*ends))
    np.minimum.at(clipped, entries, np.maximum(*ends))
    return clipped


def _find_single_entries(S: csc_array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Array]:
    """Return the images that are one entry times a factor: their numbers, those of the entries, and the factors,
    ``(a,)``."""
    by_row = S.tocsr()
    by_row.eliminate_zeros()
    rows = np.flatnonzero(np.diff(by_row.indptr) == 1)
    places = by_row.indptr[rows]
    return rows, by_row.indices[places].astype(np.int64), np.asarray(by_row.data[places])


def _is_stationary(S: csc_array, z: Array, slope: Array, share: float = CANCELLED_SHARE) -> bool:
    residual, size = np.abs(S.T @ z + slope), np.abs(S).T @ np.abs(z) + np.abs(slope)
    return bool((residual <= share * size.max(initial=0.0)).all())


def _factor_projection(S: csc_array, used: npt.NDArray[np.bool_]) -> Callable[[Array], Array]:
    """Return the map ``r -> S (S'S)^{-1} r`` on the used images."""
    from scipy.sparse.linalg import splu

    selected = S[np.flatnonzero(used)].tocsc()
    gram = (selected.T @ selected).tocsc()
    try:
        factor = splu(gram)
    except RuntimeError:
        return lambda residual: np.full(used.size, np.nan)
    rows = np.flatnonzero(used)

    def apply(residual: Array) -> Array:
        step = np.zeros(used.size)
        step[rows] = selected @ factor.solve(residual)
        return step

    return apply
