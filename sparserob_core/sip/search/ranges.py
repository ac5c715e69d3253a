"""Ranges of a search with ``ask`` and ``tell``: whole and logarithmic coordinates, shown to the maximiser as a plain
box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.arguments import is_whole
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box

HALF_STEP = 0.5  # an interval of length 1 rounds to each whole number of a range, at its ends too


@final
@dataclass(frozen=True, eq=False)
class Ranges:
    """A box with integer and logarithmic coordinates.

    Parameters
    ----------
    domain : Box
        The box.
    integer : sequence of int, default ()
        Coordinates that take whole numbers only.
    logarithmic : sequence of int, default ()
        Coordinates that are searched by their logarithms.

    Raises
    ------
    InputError
        For a coordinate that does not exist, an integer coordinate without whole bounds, or a logarithmic coordinate
        that is not positive.
    """

    domain: Box
    integer: Sequence[int] = ()
    logarithmic: Sequence[int] = ()

    def __post_init__(self) -> None:
        for name in ("integer", "logarithmic"):
            object.__setattr__(self, name, self._check_coordinates(name, getattr(self, name)))
        lower, upper = self.domain.lower, self.domain.upper
        for i in self.integer:
            if not (float(lower[i]).is_integer() and float(upper[i]).is_integer()):
                raise InputError(
                    path=f"integer.{i}", expected="whole bounds", got=f"[{float(lower[i])!r}, {float(upper[i])!r}]"
                )
        for i in self.logarithmic:
            if lower[i] <= 0.0:
                raise InputError(path=f"logarithmic.{i}", expected="a positive lower bound", got=f"{float(lower[i])!r}")

    def _check_coordinates(self, name: str, chosen: object) -> list[int]:
        size = self.domain.dimension
        if (
            isinstance(chosen, str)
            or not isinstance(chosen, Sequence)
            or not all(is_whole(i, 0) and i < size for i in chosen)
        ):
            raise InputError(path=name, expected=f"coordinates, whole numbers from 0 to {size - 1}", got=repr(chosen))
        return sorted({int(i) for i in chosen})

    @property
    def plain(self) -> bool:
        """True where every coordinate is searched as it is."""
        return not (self.integer or self.logarithmic)

    @property
    def searched(self) -> Box:
        """Box that the maximiser searches."""
        lower, upper = self.domain.lower.copy(), self.domain.upper.copy()
        moving = [i for i in self.integer if lower[i] < upper[i]]
        lower[moving] -= HALF_STEP
        upper[moving] += HALF_STEP
        lower[self.logarithmic], upper[self.logarithmic] = (
            np.log(lower[self.logarithmic]),
            np.log(upper[self.logarithmic]),
        )
        return Box(lower, upper)

    @shaped
    def shown(self, points: Float[Array, "k d"]) -> Float[Array, "k d"]:
        """Return the points of ``domain`` that belong to points of the box that is searched."""
        if self.plain:
            return np.array(points, dtype=float)
        shown = np.array(points, dtype=float)
        shown[:, self.logarithmic] = np.exp(shown[:, self.logarithmic])
        shown[:, self.integer] = np.round(shown[:, self.integer])
        np.clip(shown, self.domain.lower, self.domain.upper, out=shown)
        return shown

    @shaped
    def hidden(self, points: Float[Array, "k d"]) -> Float[Array, "k d"]:
        """Return points of the box that is searched to which points of ``domain`` belong."""
        hidden = np.array(points, dtype=float)
        hidden[:, self.integer] = np.round(hidden[:, self.integer])
        hidden[:, self.logarithmic] = np.log(hidden[:, self.logarithmic])
        return hidden
