"""The landscape of ``g`` over where the two indices are that decide most, the others held where the best tuple has
them.

It is filled from coarse to fine by evaluations of its own, of another program with another solver, on lines that only
the options and the tuple decide; two of these lines go through the tuple itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeAlias, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats
from sparserob_rerun.search.projection import NEAR, Axes, two_of

STRIDES = (8, 4, 2, 1)
FLAT = 1e-9  # of g: smaller differences are the solver's
CLOSE = 0.01  # of the distance of two lines of the grid

Place: TypeAlias = tuple[int, int]
"""Of a coordinate of a tuple: ``(slot, coordinate)``."""


@final
@dataclass(eq=False)
class Landscape:
    """One slice through an ``anchor (D, width)``: ``values (a, b)`` over ``first`` and ``second``, coordinates
    ``(slot, coordinate)``. Indices that are `NEAR` to one of these two stand for the same constraint and move with it;
    of all that move the disturbance is at its worst.

    ``values[i, j]`` belongs to ``axes[0][i]`` and ``axes[1][j]``; NaN where nothing was evaluated, ``inf`` where the
    relaxed program is infeasible. ``axes[k][at[k]]`` is the anchor's coordinate. ``level`` is the stride of the finest
    grid that is complete, 0 before the first.
    """

    g: sr.RelaxedValue
    anchor: Floats
    first: Place
    second: Place
    grid: int
    epsilon: float = 0.0
    seen: Axes | None = None
    values: Floats = field(init=False)
    axes: tuple[Floats, Floats] = field(init=False)
    at: tuple[int, int] = field(init=False)
    level: int = 0
    spent: int = 0

    def __post_init__(self) -> None:
        one, other = (self._axis(place) for place in (self.first, self.second))
        self.axes, self.at = (one[0], other[0]), (one[1], other[1])
        self._bases = (one[2], other[2])
        self._open = np.array([kind == "disturbance" for kind in self.g.kinds])
        heads = (self.first[0], self.second[0])
        plain = [k for k in range(self.g.slot.dimension) if not self._open[k] and k != self.first[1]]
        alike = bool((self.anchor[heads[0], plain] == self.anchor[heads[1], plain]).all())
        self._mirrored = self.first[1] == self.second[1] and alike  # g is the same where two indices change places
        self._found: dict[tuple[float, ...], float] = {}
        self._moving = [[k for k in range(len(self.anchor)) if self._beside(k, heads) == head] for head in heads]
        self.values = np.full((self.axes[0].size, self.axes[1].size), np.nan)

    def _beside(self, slot: int, heads: tuple[int, int]) -> int:
        """The head that an index is `NEAR` to, and moves with; -1 where there is none."""
        widths = np.where(self.g.slot.upper > self.g.slot.lower, self.g.slot.upper - self.g.slot.lower, np.inf)
        away = {head: (np.abs(self.anchor[slot] - self.anchor[head]) / widths)[~self._open].max() for head in heads}
        if not self.g.interchangeable:
            return slot if slot in heads else -1
        nearest = slot if slot in heads else min(heads, key=lambda head: away[head])
        return nearest if away[nearest] < NEAR else -1

    def _axis(self, place: Place) -> tuple[Floats, int, np.ndarray]:
        """The values along an axis, which of them is the anchor's, and which are those of the even grid; where one of
        these is close to the anchor, it moves there."""
        even = np.linspace(self.g.slot.lower[place[1]], self.g.slot.upper[place[1]], self.grid)
        nearest = int(np.abs(even - self.anchor[place]).argmin())
        if abs(even[nearest] - self.anchor[place]) < CLOSE * (even[-1] - even[0]) / self.grid:
            even[nearest] = self.anchor[place]
        values = np.union1d(even, [self.anchor[place]])
        return values, int(np.searchsorted(values, self.anchor[place])), np.searchsorted(values, even)

    def lines(self, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Which values of either axis belong to the grid of a stride: its ends and the anchor's always do."""
        one, other = (
            np.union1d(base[np.union1d(np.arange(0, self.grid, stride), [self.grid - 1])], [at])
            for base, at in zip(self._bases, self.at, strict=True)
        )
        return one, other

    def evaluate(self) -> Iterator[bool]:
        """Evaluate one point at each step, the anchor first; ``True`` where a level has become complete."""
        self._fill(*self.at)
        yield False
        for stride in STRIDES:
            across, up = self.lines(stride)
            for turn, i in enumerate(across):
                # neighbours follow one another: the last optimum is a good start
                for j in up if turn % 2 == 0 else up[::-1]:
                    if np.isnan(self.values[i, j]):
                        self._fill(int(i), int(j))
                        yield False
            self.level = stride
            yield True

    def _fill(self, i: int, j: int) -> None:
        slots = self.anchor.copy()
        for place, moving, to in zip(
            (self.first, self.second), self._moving, (self.axes[0][i], self.axes[1][j]), strict=True
        ):
            slots[moving, place[1]] = to
            slots[np.ix_(np.array(moving), self._open)] = np.nan
        at = (float(self.axes[0][i]), float(self.axes[1][j]))
        key = tuple(sorted(at)) if self._mirrored else at
        if key not in self._found:
            self._found[key] = self.g.at(slots)
            self.spent += 1
        value = self._found[key]
        self.values[i, j] = value if not np.isnan(value) else -np.inf

    @property
    def value(self) -> float:
        """``g`` at the anchor; NaN before the first evaluation."""
        return float(self.values[self.at])

    @property
    def shown(self) -> tuple[Floats, Floats, Floats]:
        """The finest grid that is complete: its values along both axes, and those of ``g (a, b)`` there."""
        across, up = self.lines(self.level or STRIDES[0])
        return self.axes[0][across], self.axes[1][up], self.values[np.ix_(across, up)]

    @property
    def limits(self) -> tuple[float, float]:
        """The least and the largest finite value that is shown; both NaN where there is none."""
        values = self.shown[2]
        known = values[np.isfinite(values)]
        return (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)

    @property
    def flat(self) -> bool:
        """Whether ``g`` is the same everywhere on the grid."""
        low, high = self.limits
        return bool(np.isfinite(self.shown[2]).all() and high - low <= FLAT * max(1.0, abs(high)))

    def picture(self, size: int) -> Floats:
        """The values ``(size, size)`` on an even grid, between those that are known in straight lines; beside an
        infinite value as the nearest of them."""
        across, up, values = self.shown
        shares = []
        for axis in (across, up):
            even = np.linspace(axis[0], axis[-1], size)
            left = np.clip(np.searchsorted(axis, even, side="right") - 1, 0, axis.size - 2)
            shares.append((left, (even - axis[left]) / (axis[left + 1] - axis[left])))
        (i, s), (j, t) = shares
        s, t = s[:, np.newaxis], t[np.newaxis, :]
        corners = [values[np.ix_(i + di, j + dj)] for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1))]
        with np.errstate(invalid="ignore"):
            mixed = (corners[0] * (1 - s) + corners[1] * s) * (1 - t) + (corners[2] * (1 - s) + corners[3] * s) * t
        nearest = values[np.ix_(i + (s[:, 0] > 0.5), j + (t[0] > 0.5))]
        finite = np.isfinite(corners[0]) & np.isfinite(corners[1]) & np.isfinite(corners[2]) & np.isfinite(corners[3])
        return np.asarray(np.where(finite, mixed, nearest))

    def names(self) -> tuple[str, str]:
        """The two coordinates in words: ``t of the first deciding index``; just ``t`` where a tuple has a single
        index."""
        (one, c), (other, k) = self.first, self.second
        if len(self.anchor) == 1:
            return self.g.names[c], self.g.names[k]
        if c == k:
            which = ("the earlier", "the later") if self.g.kinds[c] == "time" else ("the lower", "the upper")
        else:
            which = ("the one", "the one" if one == other else "the other")
        return f"{self.g.names[c]} of {which[0]}", f"{self.g.names[k]} of {which[1]}"


def coordinate(name: str, g: sr.RelaxedValue) -> tuple[int, int]:
    """The rank and the coordinate of a name such as ``t``, ``p1`` or ``t[2]``, that of the index that decides second;
    raises `InputError`."""
    letter, bracket, rest = name.partition("[")
    number = rest.removesuffix("]") if bracket else "1"
    if letter not in g.names or number not in ("1", "2"):
        raise sr.InputError(
            f"landscape: coordinates: there is no {name!r}; expected one of {', '.join(g.names[:6])}"
            f"{', ...' if len(g.names) > 6 else ''}, of the index that decides most, or such a name with [2], of the "
            "one that decides second"
        )
    return int(number) - 1, g.names.index(letter)


def axes_of(g: sr.RelaxedValue, count: int, named: tuple[str, str] | None) -> Axes | None:
    """The axes of the map of tuples of ``count`` indices: those ``named``, or else the first coordinate of an index,
    such as its time, of two of them, or two coordinates of the only one; ``None`` where fewer than two can move."""
    if named is not None:
        one, other = (coordinate(name, g) for name in named)
        if one == other:
            raise sr.InputError(f"landscape: coordinates: expected two, got {named[0]!r} twice")
        return Axes((one[0], other[0]), (one[1], other[1]))
    wide = g.slot.upper > g.slot.lower
    moving = [k for k, kind in enumerate(g.kinds) if wide[k] and kind not in ("disturbance", "direction")]
    moving = moving or [k for k, kind in enumerate(g.kinds) if wide[k] and kind == "direction"]
    if not moving or len(moving) * count < 2:
        return None
    return Axes((0, 1), (moving[0], moving[0])) if count > 1 else Axes((0, 0), (moving[0], moving[1]))


def places_of(axes: Axes, pair: tuple[int, int], anchor: Floats) -> tuple[Place, Place]:
    """The places of the axes in a tuple ``(D, width)`` of which the indices ``pair`` decide most."""
    one, other = ((pair[rank], c) for rank, c in zip(axes.ranks, axes.coordinates, strict=True))
    return (other, one) if axes.orders and anchor[other] < anchor[one] else (one, other)


def deciding_pair(g: sr.RelaxedValue, anchor: Floats) -> tuple[int, int]:
    """The two indices that decide most at the tuple ``(D, width)`` at which g was evaluated last."""
    plain = list(g.coordinates)
    widths = g.slot.upper[plain] - g.slot.lower[plain]
    return two_of(g.deciding(), anchor[:, plain], widths, (0, min(1, len(anchor) - 1)))
