"""Strictly convex terms that make the optimiser of a semi-infinite program unique."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from scipy.sparse import csc_array


@dataclass(frozen=True, eq=False)
class ControlImage:
    """How a decision ``x (n,)`` becomes the values ``S x (k,)`` that the cost is about.

    ``S (k, n)`` sparse; its rows are channel-major: ``channels`` blocks of ``k / channels`` consecutive pieces each.
    ``lengths (k,)``: how much each entry counts (the length of its piece, in time), positive.
    """

    S: csc_array
    channels: int
    lengths: Array

    def __post_init__(self) -> None:
        rows = self.S.shape[0]
        lengths = np.asarray(self.lengths, dtype=float)
        if lengths.shape != (rows,) or not (lengths > 0).all() or not np.isfinite(lengths).all():
            raise InputError(f"control image: lengths must be {rows} positive numbers, one for each row of S")
        if self.channels < 1 or rows % self.channels:
            raise InputError(f"control image: {rows} rows of S do not divide into {self.channels} channels")
        object.__setattr__(self, "lengths", lengths)

    @property
    def pieces(self) -> int:
        """Number of entries of ``S x`` per channel."""
        return int(self.S.shape[0]) // self.channels


class Regulariser(ABC):
    """A strictly convex quadratic ``rho(x) = 1/2 x'P x + q'x`` that is added to the cost with a factor that goes to
    zero."""

    @abstractmethod
    def quadratic(self, image: ControlImage) -> tuple[csc_array, Array]:
        """``P (n, n)`` symmetric positive definite, sparse, and ``q (n,)``."""
