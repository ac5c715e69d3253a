"""The landscape of ``g`` over two coordinates of a tuple of indices, the others held where the best tuple has them.

It is filled from coarse to fine by evaluations of its own, of another program with another solver, on lines that only
the options and the tuple decide; two of these lines go through the tuple itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeAlias, final

import numpy as np

import sparserob_core as sr
from sparserob_rerun.drawing.palette import Floats

STRIDES = (8, 4, 2, 1)
FLAT = 1e-9  # of g: smaller differences are the solver's
CLOSE = 0.01  # of the distance of two lines of the grid
PROBES = (0.06, 0.5, 0.94)  # where in its range a coordinate is tried
MOST = 6  # coordinates that are tried

Place: TypeAlias = tuple[int, int]
"""Of a coordinate of a tuple: ``(slot, coordinate)``."""


@final
@dataclass(eq=False)
class Landscape:
    """One slice through an ``anchor (D, width)``: ``values (a, b)`` over ``first`` and ``second``, coordinates
    ``(slot, coordinate)``.

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
    values: Floats = field(init=False)
    axes: tuple[Floats, Floats] = field(init=False)
    at: tuple[int, int] = field(init=False)
    level: int = 0
    spent: int = 0

    def __post_init__(self) -> None:
        one, other = (self._axis(place) for place in (self.first, self.second))
        self.axes, self.at = (one[0], other[0]), (one[1], other[1])
        self._bases = (one[2], other[2])
        self.values = np.full((self.axes[0].size, self.axes[1].size), np.nan)

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
        slots[self.first], slots[self.second] = self.axes[0][i], self.axes[1][j]
        value = self.g.at(slots)
        self.values[i, j] = value if not np.isnan(value) else -np.inf
        self.spent += 1

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
        """The two coordinates in words: ``t of index 2``; just ``t`` where a tuple has a single index."""
        single = len(self.anchor) == 1
        one, other = (
            self.g.names[c] if single else f"{self.g.names[c]} of index {slot + 1}"
            for slot, c in (self.first, self.second)
        )
        return one, other


def coordinate(name: str, g: sr.RelaxedValue, count: int) -> Place:
    """The place of a name such as ``t``, ``p1`` or ``t[3]`` (that of the third index); raises `InputError`."""
    letter, bracket, rest = name.partition("[")
    number = rest.rstrip("]") if bracket else "1"
    if letter not in g.names or not number.isdigit() or not 1 <= int(number) <= count:
        raise sr.InputError(
            f"landscape: coordinates: there is no {name!r}; expected one of {', '.join(g.names[:6])}"
            f"{', ...' if len(g.names) > 6 else ''}, or such a name with the number of an index, t[1] to t[{count}]"
        )
    return int(number) - 1, g.names.index(letter)


@final
class Choice:
    """Finds the two coordinates of a tuple on which ``g`` depends most; ``pair`` is ``None`` until `look` is through,
    and where fewer than two coordinates can move.

    Only indices with a multiplier count: by complementarity the others can be left out of the relaxed program, and
    ``g`` is the same wherever they are. Slopes alone do not decide, as they vanish at a maximum: each coordinate is
    tried at a few values of its range. Where no single one matters, two that impose the same constraint may stand in
    for one another: then pairs are tried.
    """

    def __init__(self, g: sr.RelaxedValue, anchor: Floats) -> None:
        self.g, self.anchor = g, anchor
        self.width = g.slot.upper - g.slot.lower
        self.pair: tuple[Place, Place] | None = None

    def look(self) -> Iterator[bool]:
        """Choose; one evaluation at each step."""
        moving = [k for k in range(self.g.slot.dimension) if self.width[k] > 0.0]
        if len(moving) * len(self.anchor) < 2:
            return
        value = self.g.at(self.anchor)
        yield False
        tried, changes = self._candidates(moving), {}
        for place in tried:
            changes[place] = 0.0
            for share in PROBES:
                changes[place] = max(changes[place], _distance(self.g.at(self._moved(share, place)), value))
                yield False
        order = sorted(tried, key=lambda place: -changes[place])
        least = FLAT * max(1.0, abs(value)) if np.isfinite(value) else 0.0
        known = [place for place in order if changes[place] > least]
        self.pair = (known[0], known[1]) if len(known) > 1 else self._fallback(order, known, moving)
        if known:
            return
        best = least
        for one, other in combinations(order[:5], 2):
            for share in PROBES:
                change = _distance(self.g.at(self._moved(share, one, other)), value)
                yield False
                if change > best:
                    best, self.pair = change, (one, other)

    def _candidates(self, moving: list[int]) -> list[Place]:
        """Times and parameters of the indices with a multiplier, the largest first, and the other coordinates along
        which ``g`` is steepest."""
        weights, slopes = self.g.weights(), np.abs(self.g.gradient()) * self.width
        heads = [int(slot) for slot in np.argsort(-weights, kind="stable") if weights[slot] > 0.0]
        plain = [k for k in moving if self.g.kinds[k] not in ("disturbance", "direction")]
        found = [(slot, k) for slot in heads for k in plain][:MOST]
        rest = [
            (slot, k)
            for slot, k in zip(*np.unravel_index(np.argsort(-slopes, axis=None)[: 4 * MOST], slopes.shape), strict=True)
            if slopes[slot, k] > 0.0 and self.width[k] > 0.0 and k not in plain
        ]
        return [*found, *((int(slot), int(k)) for slot, k in rest[: MOST // 2])]

    def _fallback(self, order: list[Place], known: list[Place], moving: list[int]) -> tuple[Place, Place]:
        """A pair where fewer than two coordinates matter by themselves: beside the one that does another of its own
        index, or that of another index."""
        every = [*known, *order, *((slot, k) for slot in range(len(self.anchor)) for k in moving)]
        head = every[0]
        beside = [place for place in every if place[0] == head[0] and place != head]
        return head, (beside or [place for place in every if place != head])[0]

    def _moved(self, share: float, *places: Place) -> Floats:
        slots = self.anchor.copy()
        for place in places:
            slots[place] = self.g.slot.lower[place[1]] + share * self.width[place[1]]
        return slots


def _distance(one: float, other: float) -> float:
    return abs(one - other) if np.isfinite(one) and np.isfinite(other) else (0.0 if one == other else np.inf)
