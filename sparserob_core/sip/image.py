"""What depends on the image ``s = S x`` alone, remembered between programs that share it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import numpy.typing as npt

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

if TYPE_CHECKING:
    from scipy.sparse import csc_array

Made = TypeVar("Made")


class Memory:
    """The last few things made from arrays, found again by the identity of those arrays (which it keeps alive)."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._made: OrderedDict[Hashable, tuple[tuple[object, ...], object]] = OrderedDict()

    def recall(self, sources: tuple[object, ...], key: Hashable, make: Callable[[], Made]) -> Made:
        """What ``make`` returned for these very sources, or make it now."""
        identity = (key, *map(id, sources))
        if identity in self._made:
            self._made.move_to_end(identity)
            return self._made[identity][1]  # type: ignore[return-value]
        made = make()
        self._made[identity] = (sources, made)
        if len(self._made) > self.size:
            self._made.popitem(last=False)
        return made


_factors = Memory(8)


def onto_stationary(program: FiniteProgram, z: Array, slope: Array) -> Array:
    """The ``z (k,)`` nearest to the given one with ``S'z + slope = 0``, ``slope (n,)``; NaN where ``S`` has not full column rank.

    Images without weight and bounds cannot carry a multiplier and keep 0.
    """
    S = program.S
    if S is None:
        return -slope
    idle = (program.weights == 0) & np.isneginf(program.lower) & np.isposinf(program.upper)
    project = _factors.recall((S,), idle.tobytes() if idle.any() else None, lambda: _projection(S, ~idle))
    z = np.where(idle, 0.0, z)
    for _ in range(2):
        z = z - project(S.T @ z + slope)
    return z


def _projection(S: csc_array, used: npt.NDArray[np.bool_]) -> Callable[[Array], Array]:
    """``r -> S (S'S)^{-1} r`` on the used images."""
    from scipy.sparse.linalg import splu

    part = S[np.flatnonzero(used)].tocsc()
    gram = (part.T @ part).tocsc()
    try:
        factor = splu(gram)
    except RuntimeError:
        return lambda residual: np.full(used.size, np.nan)
    rows = np.flatnonzero(used)

    def apply(residual: Array) -> Array:
        step = np.zeros(used.size)
        step[rows] = part @ factor.solve(residual)
        return step

    return apply
