"""Reference of a moving set: points that follow one another along straight lines."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False)
class Reference:
    """Reference ``r(t)``, linear between ``points (q, d)`` at increasing ``times (q,)`` and constant outside these
    times. Without points it is 0 at all times, and ``d`` is then 1 and stands for every state."""

    times: Array = field(default_factory=lambda: np.zeros(0))
    points: Array = field(default_factory=lambda: np.zeros((0, 1)))

    @staticmethod
    def of(rows: object) -> Reference:
        """Return the reference of rows of a time and a point, ``(q, 1 + d)``; `STILL` for ``None``."""
        table = None if rows is None else np.asarray(rows, dtype=float)
        return STILL if table is None else Reference(table[:, 0], table[:, 1:])

    @property
    def moves(self) -> bool:
        """True where the reference has points."""
        return self.times.size > 0

    @shaped
    def at(self, times: Float[Array, " k"]) -> Float[Array, "k d"]:
        """Return ``r (k, d)`` at times ``(k,)``."""
        if not self.moves:
            return np.zeros((times.size, 1))
        return np.stack([np.interp(times, self.times, column) for column in self.points.T], axis=1)

    @shaped
    def along(self, times: Float[Array, " k"], H: Float[Array, "r d"]) -> Float[Array, "k r"]:
        """Return ``H r(t)``, ``(k, r)``."""
        return self.at(times) @ H.T if self.moves else np.zeros((times.size, len(H)))

    @shaped
    def slope(self, times: Float[Array, " k"], start: float) -> Float[Array, "k d"]:
        """Return ``r' (k, d)``, from the left at a kink, but from the right at and before ``start``."""
        if self.times.size < 2:
            return np.zeros((times.size, self.points.shape[1]))
        slopes = np.diff(self.points, axis=0) / np.diff(self.times)[:, None]
        from_left, from_right = (np.searchsorted(self.times, times, side=side) - 1 for side in ("left", "right"))
        piece = np.where(times <= start, from_right, from_left)
        inside = (piece >= 0) & (piece < len(slopes))
        return np.where(inside[:, None], slopes[np.clip(piece, 0, len(slopes) - 1)], 0.0)

    def kinks(self, start: float, stop: float) -> Array:
        """Return the times inside a window at which the slope of the reference may change."""
        return self.times[(self.times > start) & (self.times < stop)]

    @property
    def size(self) -> Array:
        """The largest ``|r_i|``, ``(d,)``."""
        return np.asarray(np.abs(self.points).max(axis=0, initial=0.0))

    def reach(self, H: Array) -> Array:
        """Return the largest sum of absolute numbers in ``H r(t)``, ``(r,)``."""
        return np.asarray(np.abs(H) @ self.size if self.moves else np.zeros(H.shape[:-1]))


STILL = Reference()  # of a set that stays where it is


@final
@dataclass(frozen=True, eq=False)
class MovingReference:
    """Change ``-H r(t)`` of functionals ``H x(t)``, ``H (r, d)``, by the reference of a moving set, on cells of time
    between its kinks."""

    reference: Reference
    H: Array

    def at(self, times: Array) -> Array:
        """Return ``-H r(t)``, ``(k, r)``."""
        return 0.0 - self.reference.along(times, self.H)  # no negative zeros

    @property
    def size(self) -> Array:
        """Largest sum of absolute numbers in ``H r(t)``, ``(r,)``."""
        return self.reference.reach(self.H)


@final
@dataclass(frozen=True, eq=False)
class Direct:
    """Direct effect ``G u``, ``G (r, m)``, of the commanded ``control (m, K)`` on functionals, on cells of time within
    its pieces."""

    G: Array
    dictionary: Dictionary
    control: Array

    def on(self, start: Array, stop: Array) -> Array:
        """Return ``G u`` on cells ``[start, stop]`` (``(k,)``), ``(k, r)``."""
        piece = np.searchsorted(self.dictionary.breakpoints, (start + stop) / 2) - 1
        return (self.G @ self.control[:, np.clip(piece, 0, self.dictionary.pieces - 1)]).T

    @property
    def size(self) -> Array:
        """Largest sum of absolute numbers in ``G u``, ``(r,)``."""
        return np.asarray((np.abs(self.G) @ np.abs(self.control)).max(axis=1))
