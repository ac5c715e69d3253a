"""The landscape of ``g`` over two coordinates of the two indices that decide most, the others held where the best
tuple has them: which indices these are in a tuple, which coordinates move g most, and the values of the map.

It is filled from coarse to fine by evaluations of its own, of another program with another solver, on lines that only
the options and the tuple decide; some of these lines go through the tuple itself.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.run.inspection import RelaxedValue
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import DECIDING

STRIDES = (8, 4, 2, 1)
COARSEST = 16
"""The stride before them where one value is a robust program of its own: sixteen values, which come within a second.
With twice as large a one there is hardly more than the corners; with half of it 36 are not there when a run of two
seconds ends on a busy machine."""
FLAT = 1e-9  # of g: smaller differences are the solver's
CLOSE = 0.01  # of the distance of two lines of the grid

PROBES = 5
"""Values of a coordinate at which g is asked how far it moves along it. With two of them a ridge between the ends is
not seen; with fifty the choice of the axes takes as long as a map."""

Place: TypeAlias = tuple[int, int]
"""Of a coordinate of a tuple: ``(slot, coordinate)``."""
Axis: TypeAlias = tuple[int, int]
"""Of an axis of a map: ``(rank, coordinate)`` of the index that decides most (rank 0) or of the other (1)."""
Reach: TypeAlias = tuple[float, float]
"""How far g moves along an axis: on which share of it g is infinite, and the range of its finite values."""
NEAR = 0.05
"""Indices that are nearer to one another, in widths of the box, stand for one constraint and move together. A tenth of
it, and two that a search has put beside one another hide that g depends on them; ten times, and all of them are one."""


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

    g: RelaxedValue
    anchor: Array
    first: Place
    second: Place
    grid: int
    epsilon: float = 0.0
    seen: LandscapeAxes | None = None
    values: Array = field(init=False)
    axes: tuple[Array, Array] = field(init=False)
    at: tuple[int, int] = field(init=False)
    level: int = 0
    spent: int = 0

    def __post_init__(self) -> None:
        self._open = np.array([kind == "disturbance" for kind in self.g.kinds])
        heads = (self.first[0], self.second[0])
        plain = [k for k in range(self.g.slot.dimension) if not self._open[k] and k != self.first[1]]
        alike = bool((self.anchor[heads[0], plain] == self.anchor[heads[1], plain]).all())
        # one coordinate of two indices of which each may be the other: a value belongs to both of their orders
        self._mirrored = self.first[1] == self.second[1] and alike and self.g.interchangeable
        one, other = self._axis(self.first), self._axis(self.second)
        self.axes, self._bases, self._always = (one[0], other[0]), (one[1], other[1]), (one[2], other[2])
        self.at = (
            int(np.searchsorted(one[0], self.anchor[self.first])),
            int(np.searchsorted(other[0], self.anchor[self.second])),
        )
        self._moving = [[k for k in range(len(self.anchor)) if self._beside(k, heads) == head] for head in heads]
        self._found: dict[tuple[float, float], float] = {}
        self.values = np.full((self.axes[0].size, self.axes[1].size), np.nan)

    def _beside(self, slot: int, heads: tuple[int, int]) -> int:
        """The head that an index is `NEAR` to, and moves with; -1 where there is none."""
        widths = np.where(self.g.slot.upper > self.g.slot.lower, self.g.slot.upper - self.g.slot.lower, np.inf)
        away = {head: (np.abs(self.anchor[slot] - self.anchor[head]) / widths)[~self._open].max() for head in heads}
        if not self.g.interchangeable:
            return slot if slot in heads else -1
        nearest = slot if slot in heads else min(heads, key=lambda head: away[head])
        return nearest if away[nearest] < NEAR else -1

    def _axis(self, place: Place) -> tuple[Array, np.ndarray, np.ndarray]:
        """Return the values along an axis, which of them are those of the even grid, and which are the anchor's: of a
        symmetric map those of both indices, since a ridge through either is on both axes. Where one of the even grid is
        close to the anchor, it moves there."""
        even = np.linspace(self.g.slot.lower[place[1]], self.g.slot.upper[place[1]], self.grid)
        through = np.unique([self.anchor[at] for at in ((self.first, self.second) if self._mirrored else (place,))])
        for value in through:
            nearest = int(np.abs(even - value).argmin())
            if abs(even[nearest] - value) < CLOSE * (even[-1] - even[0]) / self.grid:
                even[nearest] = value
        values = np.union1d(even, through)
        return values, np.searchsorted(values, even), np.searchsorted(values, through)

    @property
    def strides(self) -> tuple[int, ...]:
        """From coarse to fine: those of a policy begin with `COARSEST`."""
        return STRIDES if self.g.interchangeable else (COARSEST, *STRIDES)

    def lines(self, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Which values of either axis belong to the grid of a stride: its ends and the anchor's always do."""
        one, other = (
            np.union1d(base[np.union1d(np.arange(0, self.grid, stride), [self.grid - 1])], always)
            for base, always in zip(self._bases, self._always, strict=True)
        )
        return one, other

    def evaluate(self) -> Iterator[bool]:
        """Evaluate one point at each step, the anchor first; ``True`` where a level has become complete."""
        self._fill(*self.at)
        yield False
        for stride in self.strides:
            across, up = self.lines(stride)
            for turn, i in enumerate(across):
                # neighbours follow one another: the last optimum is a good start
                for j in up if turn % 2 == 0 else up[::-1]:
                    if np.isnan(self.values[i, j]):
                        self._fill(int(i), int(j))
                        yield False
            self.level = stride
            yield True

    def cross(self) -> Iterator[None]:
        """Evaluate the line of ``first`` through the anchor, one point at each step."""
        for i in range(self.axes[0].size):
            self._fill(i, self.at[1])
            yield

    @property
    def reach(self) -> Reach:
        """How far g moves along ``first``, of what `cross` has evaluated."""
        values = self.values[:, self.at[1]]
        known = values[np.isfinite(values)]
        return float(np.mean(values == np.inf)), float(np.ptp(known)) if known.size else 0.0

    def _fill(self, i: int, j: int) -> None:
        to = self._order(float(self.axes[0][i]), float(self.axes[1][j]))
        if to not in self._found:
            self._found[to] = self.g.at(self._tuple(to))
            self.spent += 1
        value = self._found[to]
        self.values[i, j] = value if not np.isnan(value) else -np.inf

    def _order(self, one: float, other: float) -> tuple[float, float]:
        """Return where the first and the second index are at a point: where g knows no order of the two, in that of the
        anchor."""
        ordered = (one <= other) == bool(self.anchor[self.first] <= self.anchor[self.second])
        return (other, one) if self._mirrored and not ordered else (one, other)

    def _tuple(self, to: tuple[float, float]) -> Array:
        """Return the tuple ``(D, width)`` whose two indices are where they are to be."""
        slots = self.anchor.copy()
        for place, moving, end in zip((self.first, self.second), self._moving, to, strict=True):
            # they keep their distance: at the anchor the tuple is the anchor's own, whose value none may lie below
            c, shift = place[1], end - self.anchor[place]
            slots[moving, c] = np.clip(self.anchor[moving, c] + shift, self.g.slot.lower[c], self.g.slot.upper[c])
            slots[place] = end
            slots[np.ix_(np.array(moving), self._open)] = np.nan
        return slots

    @property
    def value(self) -> float:
        """``g`` at the anchor; NaN before the first evaluation."""
        return float(self.values[self.at])

    @property
    def shown(self) -> tuple[Array, Array, Array]:
        """The finest grid that is complete: its values along both axes, and those of ``g (a, b)`` there."""
        across, up = self.lines(self.level or self.strides[0])
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

    def picture(self, size: int) -> Array:
        """The values ``(size, size)`` in the middles of even cells, between those that are known in straight lines;
        beside an infinite value as the nearest of them."""
        across, up, values = self.shown
        shares = []
        for axis in (across, up):
            even = axis[0] + (axis[-1] - axis[0]) * (np.arange(size) + 0.5) / size
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

    def names(self, unit: str = "") -> tuple[str, str]:
        """The two coordinates in words: ``t of the earlier``; just ``t`` where a tuple has a single index. Behind a
        time its ``unit``, where one is given: ``t of the earlier, in s``."""
        (one, c), (other, k) = self.first, self.second
        in_unit = [f", in {unit}" if unit and self.g.kinds[place] == "time" else "" for place in (c, k)]
        if len(self.anchor) == 1:
            return self.g.names[c] + in_unit[0], self.g.names[k] + in_unit[1]
        if c == k:
            which = ("the earlier", "the later") if self.g.kinds[c] == "time" else ("the lower", "the upper")
        else:
            which = ("the one", "the one" if one == other else "the other")
        return f"{self.g.names[c]} of {which[0]}{in_unit[0]}", f"{self.g.names[k]} of {which[1]}{in_unit[1]}"


@final
@dataclass(frozen=True)
class LandscapeAxes:
    """The two axes of a map: each is a coordinate of an index, of that which decides most (``ranks`` 0) or of the other
    (1). ``orders``: both are the same coordinate of two indices, of which the lesser is across."""

    ranks: tuple[int, int]
    coordinates: tuple[int, int]

    @property
    def orders(self) -> bool:
        """Whether the axes are the same coordinate of two indices."""
        return self.coordinates[0] == self.coordinates[1]

    @classmethod
    def over(
        cls,
        g: RelaxedValue,
        count: int,
        named: tuple[str, str] | None = None,
        reach: Mapping[Axis, Reach] | None = None,
    ) -> LandscapeAxes | None:
        """The axes of the map of tuples of ``count`` indices: those ``named``, or else the two along which g moves most
        as the ``reach`` says (`measure`). Of equals, and where nothing is known, the first coordinate of an index,
        such as its time, of two of them, or two coordinates of the only one; ``None`` where fewer than two can move.
        Raises `InputError` for a name that there is not."""
        if named is not None:
            one, other = (coordinate(name, g) for name in named)
            if one == other:
                raise InputError(f"landscape: coordinates: expected two, got {named[0]!r} twice")
            return cls((one[0], other[0]), (one[1], other[1]))
        known = reach or {}
        axes = sorted(axes_of(g, count), key=lambda axis: known.get(axis, (0.0, 0.0)), reverse=True)
        if len(axes) < 2:
            return None
        (rank, c), (next_rank, k) = sorted(axes[:2], key=lambda axis: axis[::-1])
        return cls((rank, next_rank), (c, k))

    @staticmethod
    def measure(g: RelaxedValue, anchor: Array, pair: tuple[int, int], reach: dict[Axis, Reach]) -> Iterator[None]:
        """Evaluate g of the tuple ``anchor (D, width)``, of which the indices ``pair`` decide most, along every
        possible axis, one point at each step, and note the ``reach`` of each; where there is no choice, nothing is
        evaluated."""
        axes = axes_of(g, 1 if pair[0] == pair[1] else 2)
        for rank, c in axes if len(axes) > 2 else ():
            other = next((r, k) for r, k in axes if (r, k) != (rank, c))
            line = Landscape(g, anchor, (pair[rank], c), (pair[other[0]], other[1]), PROBES)
            yield from line.cross()
            reach[rank, c] = line.reach

    def places(self, pair: tuple[int, int], anchor: Array) -> tuple[Place, Place]:
        """The places of the axes in a tuple ``(D, width)`` of which the indices ``pair`` decide most."""
        one, other = ((pair[rank], c) for rank, c in zip(self.ranks, self.coordinates, strict=True))
        return (other, one) if self.orders and anchor[other] < anchor[one] else (one, other)

    def of(self, told: tuple[int, ...], places: Array) -> Array | None:
        """The points ``(n, 2)`` of places ``(n, 2, c)`` whose coordinates are those ``told (c,)``; ``None`` where these
        have not come along."""
        if not set(self.coordinates) <= set(told):
            return None
        points = np.stack(
            [places[:, r, told.index(c)] for r, c in zip(self.ranks, self.coordinates, strict=True)], axis=-1
        )
        return np.sort(points, axis=1) if self.orders else points


def axes_of(g: RelaxedValue, count: int) -> list[Axis]:
    """What a map of tuples of ``count`` indices may be over: every coordinate that can move, of one index or of two."""
    return [(rank, c) for c in moving_of(g) for rank in range(min(2, count))]


def moving_of(g: RelaxedValue) -> list[int]:
    """The coordinates of an index that a map may be over: those that can move, disturbances left out, and directions
    last, which say least to a reader."""
    return sorted(g.coordinates, key=lambda k: g.kinds[k] == "direction")


def coordinate(name: str, g: RelaxedValue) -> tuple[int, int]:
    """The rank and the coordinate of a name such as ``t``, ``p1`` or ``t[2]``, that of the index that decides second;
    raises `InputError`."""
    letter, bracket, rest = name.partition("[")
    number = rest.removesuffix("]") if bracket else "1"
    if letter not in g.names or number not in ("1", "2"):
        raise InputError(
            f"landscape: coordinates: there is no {name!r}; expected one of {', '.join(g.names[:6])}"
            f"{', ...' if len(g.names) > 6 else ''}, of the index that decides most, or such a name with [2], of the "
            "one that decides second"
        )
    return int(number) - 1, g.names.index(letter)


def deciding_pair(g: RelaxedValue, anchor: Array) -> tuple[int, int]:
    """The two indices that decide most at the tuple ``(D, width)`` at which g was evaluated last."""
    plain = list(g.coordinates)
    widths = g.slot.upper[plain] - g.slot.lower[plain]
    return two_of(g.deciding(), anchor[:, plain], widths, (0, min(1, len(anchor) - 1)))


def two_of(ranked: Sequence[int] | np.ndarray, slots: Array, widths: Array, others: Sequence[int]) -> tuple[int, int]:
    """The two indices of a tuple ``(D, c)`` that decide most and do not stand for the same constraint: of those
    ``ranked`` by their multipliers, -1 for none, then of the ``others``, then any; one twice where there is one."""
    first, *rest = [int(k) for k in ranked if k >= 0] or [int(others[0])]
    apart = [k for k in rest if np.abs((slots[k] - slots[first]) / widths).max() > NEAR]
    second = next((k for k in (*apart, *others, *rest, *range(len(slots))) if k != first), first)
    return first, int(second)


def deciding_slots(deciding: np.ndarray, tuples: Array, widths: Array, pair: tuple[int, int]) -> np.ndarray:
    """The two indices ``(n, 2)`` that decide most in each of the tuples ``(n, D, c)``, of which ``deciding (n, 4)``
    ranks some, -1 for none; those of the tuple before, at first ``pair``, where fewer decide."""
    rows, first = np.arange(len(tuples)), deciding[:, 0]
    heads = tuples[rows, first]  # of a row in which nothing decides it is any index, and not used
    apart = np.abs((tuples[rows[:, np.newaxis], deciding] - heads[:, np.newaxis]) / widths).max(axis=2) > NEAR
    apart &= deciding >= 0
    second = np.where(apart.any(axis=1), deciding[rows, apart.argmax(axis=1)], -1)
    found = list[tuple[int, int]]()
    for row, (most, next_most) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        if most >= 0 and next_most < 0:  # one decides alone, beside those that stand for the same constraint
            next_most = next((k for k in pair if k != most), -1)
        if most >= 0 and next_most < 0:
            most, next_most = two_of(deciding[row], tuples[row], widths, pair)
        pair = (most, next_most) if most >= 0 else pair
        found.append(pair)
    return np.array(found, dtype=int).reshape(-1, 2)


def deciding_again(g: RelaxedValue, points: Array, notes: Mapping[str, Array], seconds: float) -> np.ndarray:
    """The indices ``(n, 4)`` that decide most in each tuple ``(n, D width)`` of a search, which no directory keeps: by
    evaluating those once more that the walk went to, the last ones first, for some ``seconds``; -1 of the others."""
    found = np.full((len(points), DECIDING), -1)
    accepted = notes.get("accepted", np.ones(len(points))) > 0.0
    end = time.monotonic() + seconds
    for row in np.flatnonzero(accepted)[::-1]:
        if time.monotonic() > end:
            break
        g.at(points[row].reshape(-1, g.slot.dimension))
        found[row] = g.deciding()
    return found
