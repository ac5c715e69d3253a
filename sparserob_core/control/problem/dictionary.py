"""Dictionaries of piecewise constant functions, in which controls and disturbances are written."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array


@dataclass(frozen=True, eq=False)
class Dictionary:
    """``N`` linearly independent functions of time, constant on ``K >= N`` pieces.

    ``breakpoints (K + 1,)``: increasing times, the first is 0, the last the horizon. ``values (N, K)``:
    ``values[i, k]`` is function ``i`` on ``[breakpoints[k], breakpoints[k + 1])``. Raises `InputError` when any of that
    fails.
    """

    breakpoints: Array
    values: Array

    if TYPE_CHECKING:  # what is given may be a list; what is kept is an array

        def __init__(self, breakpoints: npt.ArrayLike, values: npt.ArrayLike) -> None: ...

    def __post_init__(self) -> None:
        breakpoints, values = _real("breakpoints", self.breakpoints), _real("values", self.values)
        if breakpoints.ndim != 1 or breakpoints.size < 2 or breakpoints[0] != 0.0 or (np.diff(breakpoints) <= 0).any():
            raise InputError(
                f"breakpoints must increase from 0, at least two of them, got {_short(breakpoints)}", path="dictionary"
            )
        if values.ndim != 2 or values.shape[0] == 0 or values.shape[1] != breakpoints.size - 1:
            raise InputError(
                f"values must have shape (functions, {breakpoints.size - 1}), got {values.shape}", path="dictionary"
            )
        if values.shape[0] > values.shape[1]:
            raise InputError(
                f"{values.shape[0]} functions on {values.shape[1]} pieces; there can be at most as many functions as"
                " pieces, or they are linearly dependent",
                path="dictionary",
            )
        if not _independent(values):
            raise InputError(
                f"the {values.shape[0]} functions must be linearly independent, their rank is"
                f" {np.linalg.matrix_rank(values)}",
                path="dictionary",
            )
        object.__setattr__(self, "breakpoints", breakpoints)
        object.__setattr__(self, "values", values)

    @property
    def horizon(self) -> float:
        """Time at which the last piece ends."""
        return float(self.breakpoints[-1])

    @property
    def pieces(self) -> int:
        """Number ``K`` of pieces."""
        return int(self.values.shape[1])

    @property
    def functions(self) -> int:
        """Number ``N`` of functions."""
        return int(self.values.shape[0])

    @property
    def lengths(self) -> Array:
        """Length of every piece ``(K,)``."""
        return np.diff(self.breakpoints)

    @cached_property
    def is_indicators(self) -> bool:
        """Whether function ``k`` is the indicator of piece ``k``."""
        return self.functions == self.pieces and np.array_equal(self.values, np.eye(self.pieces))

    @shaped
    def control(self, theta: Float[Array, "*n"]) -> Float[Array, "m K"]:
        """The control ``(m, K)`` on the pieces, from coefficients ``(m N,)``, raveled channel by channel."""
        coefficients = theta.reshape(-1, self.functions)
        return coefficients if self.is_indicators else coefficients @ self.values

    def merged(self) -> Dictionary:
        """The same functions on the fewest pieces: adjacent pieces on which all of them agree become one."""
        if self.is_indicators:
            return self
        changes = (np.diff(self.values, axis=1) != 0).any(axis=0)
        keep = np.concatenate([[True], changes])
        return Dictionary(self.breakpoints[np.concatenate([keep, [True]])], self.values[:, keep])

    @property
    def is_complete(self) -> bool:
        """Whether the functions span every piecewise constant function on the merged pieces."""
        return self.is_indicators or self.functions == 1 + int((np.diff(self.values, axis=1) != 0).any(axis=0).sum())


class DictionaryFactory(ABC):
    """Makes a dictionary once the horizon is known."""

    @abstractmethod
    def build(self, horizon: float) -> Dictionary:
        """The dictionary on ``[0, horizon]``; raises `InputError` when the options do not fit the horizon."""


def _real(name: str, value: object) -> Array:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of numbers", path="dictionary") from error
    if not np.isfinite(array).all():
        raise InputError(f"{name} must be finite numbers", path="dictionary")
    return array


def _independent(values: Array) -> bool:
    """Full row rank; disjoint supports and orthogonal rows are recognised without a singular value decomposition."""
    occupied = values != 0
    if not occupied.any(axis=1).all():
        return False
    if occupied.sum(axis=0).max() <= 1:
        return True
    gram = values @ values.T
    if np.count_nonzero(gram - np.diag(np.diag(gram))) == 0:
        return True
    return bool(np.linalg.matrix_rank(values) == values.shape[0])


def _short(array: Array) -> str:
    return np.array2string(array, threshold=8, precision=6)
