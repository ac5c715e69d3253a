"""The landscape of ``g`` over two coordinates of the two indices that decide most.

The other coordinates are those of the best tuple. The module finds these two indices of a tuple and the coordinates
along which g changes most, and it computes the values of the map.

A program and a solver of its own evaluate the map from coarse to fine. Its grid lines depend only on the options and on
the tuple; some of them go through the tuple itself.
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
"""The stride before those of `STRIDES` where each value is a robust program of its own. It gives sixteen values, which
take a second. With twice as large a stride there is hardly more than the corners. With half of it 36 values are not
complete when a run of two seconds ends on a busy machine."""
FLAT_GAIN_SHARE = 1e-9  # relative to g: smaller differences are errors of the solver
SAME_LINE_SHARE = 0.01  # of the distance of two lines of the grid

VALUES_PER_COORDINATE = 5
"""Values of a coordinate at which the change of g along it is measured. With two of them a ridge between the ends stays
hidden; with fifty the choice of the axes takes as long as a map."""

Place: TypeAlias = tuple[int, int]
"""The place of a coordinate in a tuple: ``(slot, coordinate)``."""
Axis: TypeAlias = tuple[int, int]
"""The axis of a map: ``(rank, coordinate)`` of the index that decides most (rank 0) or of the other one (rank 1)."""
Reach: TypeAlias = tuple[float, float]
"""The change of g along an axis: the share of the axis on which g is infinite, and the range of its finite values."""
SAME_CONSTRAINT_DISTANCE = 0.05
"""Indices that are nearer to one another, in widths of the box, stand for one constraint and move together. With a
tenth of it, two close indices of a search hide that g depends on them. With ten times it, all indices are one."""


@final
@dataclass(eq=False)
class Landscape:
    """A map of g on a plane through a tuple, over two of its coordinates.

    An index nearer than `SAME_CONSTRAINT_DISTANCE` to one of the two that move stands for the same constraint and moves
    with it. The disturbance of every index that moves is the worst one.

    Parameters
    ----------
    g : RelaxedValue
        The function.
    anchor : array (D, width)
        The tuple.
    first, second : tuple of int
        The coordinates ``(slot, coordinate)`` of the axes.
    grid : int
        The number of even values along an axis.
    epsilon : float, default 0.0
        The weight of the regulariser.
    seen : LandscapeAxes, optional
        The axes by the ranks of their indices.

    Attributes
    ----------
    values : array (a, b)
        The values; ``values[i, j]`` belongs to ``axes[0][i]`` and ``axes[1][j]``. NaN where nothing was evaluated,
        ``inf`` where the relaxed program is infeasible.
    axes : tuple of two arrays
        The coordinates along the axes; ``axes[k][at[k]]`` is that of the anchor.
    level : int
        The stride of the finest grid that is complete; 0 before the first.
    spent : int
        The number of evaluations.
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
        self._disturbance_mask = np.array([kind == "disturbance" for kind in self.g.kinds])
        heads = (self.first[0], self.second[0])
        coordinates = [k for k in range(self.g.slot.dimension) if not self._disturbance_mask[k] and k != self.first[1]]
        is_equal = bool((self.anchor[heads[0], coordinates] == self.anchor[heads[1], coordinates]).all())
        # the axes are one coordinate of two indices that can be exchanged: each value holds for both orders
        self._is_mirrored = self.first[1] == self.second[1] and is_equal and self.g.interchangeable
        across, up = self._make_axis(self.first), self._make_axis(self.second)
        self.axes, self._grid_positions, self._anchor_positions = (
            (across[0], up[0]),
            (across[1], up[1]),
            (across[2], up[2]),
        )
        self.at = (
            int(np.searchsorted(across[0], self.anchor[self.first])),
            int(np.searchsorted(up[0], self.anchor[self.second])),
        )
        self._moving_indices = [
            [k for k in range(len(self.anchor)) if self._find_head(k, heads) == head] for head in heads
        ]
        self._known_values: dict[tuple[float, float], float] = {}
        self.values = np.full((self.axes[0].size, self.axes[1].size), np.nan)

    def _find_head(self, slot: int, heads: tuple[int, int]) -> int:
        """Return the head within `SAME_CONSTRAINT_DISTANCE` of an index, with which it moves; -1 where there is
        none."""
        widths = np.where(self.g.slot.upper > self.g.slot.lower, self.g.slot.upper - self.g.slot.lower, np.inf)
        distances = {
            head: (np.abs(self.anchor[slot] - self.anchor[head]) / widths)[~self._disturbance_mask].max()
            for head in heads
        }
        if not self.g.interchangeable:
            return slot if slot in heads else -1
        nearest = slot if slot in heads else min(heads, key=lambda head: distances[head])
        return nearest if distances[nearest] < SAME_CONSTRAINT_DISTANCE else -1

    def _make_axis(self, place: Place) -> tuple[Array, np.ndarray, np.ndarray]:
        """Return the values along an axis, those of them in the even grid, and those of the anchor.

        On a symmetric map the axis has the values of both indices, since a ridge through either is on both axes. A
        value of the even grid that is close to the anchor is moved onto it.
        """
        even = np.linspace(self.g.slot.lower[place[1]], self.g.slot.upper[place[1]], self.grid)
        anchor_values = np.unique(
            [self.anchor[at] for at in ((self.first, self.second) if self._is_mirrored else (place,))]
        )
        for value in anchor_values:
            nearest = int(np.abs(even - value).argmin())
            if abs(even[nearest] - value) < SAME_LINE_SHARE * (even[-1] - even[0]) / self.grid:
                even[nearest] = value
        values = np.union1d(even, anchor_values)
        return values, np.searchsorted(values, even), np.searchsorted(values, anchor_values)

    @property
    def strides(self) -> tuple[int, ...]:
        """The strides from coarse to fine; those of a policy begin with `COARSEST`."""
        return STRIDES if self.g.interchangeable else (COARSEST, *STRIDES)

    def lines(self, stride: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions on either axis of the grid with a stride; the ends and the anchor always belong
        to it."""
        across, up = (
            np.union1d(even[np.union1d(np.arange(0, self.grid, stride), [self.grid - 1])], anchor)
            for even, anchor in zip(self._grid_positions, self._anchor_positions, strict=True)
        )
        return across, up

    def evaluate(self) -> Iterator[bool]:
        """Evaluate one point at each step, the anchor first; yields ``True`` where a level has become complete."""
        self._fill_value(*self.at)
        yield False
        for stride in self.strides:
            across, up = self.lines(stride)
            for number, i in enumerate(across):
                # the next point is a neighbour of the last one, whose optimum is a good start
                for j in up if number % 2 == 0 else up[::-1]:
                    if np.isnan(self.values[i, j]):
                        self._fill_value(int(i), int(j))
                        yield False
            self.level = stride
            yield True

    def cross(self) -> Iterator[None]:
        """Evaluate the line of ``first`` through the anchor, one point at each step."""
        for i in range(self.axes[0].size):
            self._fill_value(i, self.at[1])
            yield

    @property
    def reach(self) -> Reach:
        """The change of g along ``first``, from the values that `cross` has evaluated."""
        values = self.values[:, self.at[1]]
        finite = values[np.isfinite(values)]
        return float(np.mean(values == np.inf)), float(np.ptp(finite)) if finite.size else 0.0

    def _fill_value(self, i: int, j: int) -> None:
        point = self._order_coordinates(float(self.axes[0][i]), float(self.axes[1][j]))
        if point not in self._known_values:
            self._known_values[point] = self.g.at(self._make_tuple(point))
            self.spent += 1
        value = self._known_values[point]
        self.values[i, j] = value if not np.isnan(value) else -np.inf

    def _order_coordinates(self, one: float, other: float) -> tuple[float, float]:
        """Return the coordinates of the first and the second index at a point.

        Where g does not depend on their order, they are in the order of the anchor.
        """
        ordered = (one <= other) == bool(self.anchor[self.first] <= self.anchor[self.second])
        return (other, one) if self._is_mirrored and not ordered else (one, other)

    def _make_tuple(self, to: tuple[float, float]) -> Array:
        """Return the tuple ``(D, width)`` whose two indices have the coordinates ``to``."""
        slots = self.anchor.copy()
        for place, moving, end in zip((self.first, self.second), self._moving_indices, to, strict=True):
            # indices that move together keep their distance: at the anchor the tuple must be the anchor itself
            c, shift = place[1], end - self.anchor[place]
            slots[moving, c] = np.clip(self.anchor[moving, c] + shift, self.g.slot.lower[c], self.g.slot.upper[c])
            slots[place] = end
            slots[np.ix_(np.array(moving), self._disturbance_mask)] = np.nan
        return slots

    @property
    def value(self) -> float:
        """The value of ``g`` at the anchor; NaN before the first evaluation."""
        return float(self.values[self.at])

    @property
    def shown(self) -> tuple[Array, Array, Array]:
        """The finest grid that is complete: its values along both axes, and those of ``g (a, b)`` on it."""
        across, up = self.lines(self.level or self.strides[0])
        return self.axes[0][across], self.axes[1][up], self.values[np.ix_(across, up)]

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and the largest finite value of the complete grid; both NaN where there is none."""
        values = self.shown[2]
        finite = values[np.isfinite(values)]
        return (float(finite.min()), float(finite.max())) if finite.size else (np.nan, np.nan)

    @property
    def flat(self) -> bool:
        """True where ``g`` is the same everywhere on the complete grid."""
        low, high = self.limits
        return bool(np.isfinite(self.shown[2]).all() and high - low <= FLAT_GAIN_SHARE * max(1.0, abs(high)))

    def picture(self, size: int) -> Array:
        """Return the values ``(size, size)`` at the centres of even cells, by linear interpolation of those that are
        known.

        Where a neighbour is infinite it is the value of the nearest neighbour.
        """
        across, up, values = self.shown
        shares = []
        for axis in (across, up):
            even = axis[0] + (axis[-1] - axis[0]) * (np.arange(size) + 0.5) / size
            cells = np.clip(np.searchsorted(axis, even, side="right") - 1, 0, axis.size - 2)
            shares.append((cells, (even - axis[cells]) / (axis[cells + 1] - axis[cells])))
        (i, s), (j, t) = shares
        s, t = s[:, np.newaxis], t[np.newaxis, :]
        corners = [values[np.ix_(i + di, j + dj)] for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1))]
        with np.errstate(invalid="ignore"):
            mixed = (corners[0] * (1 - s) + corners[1] * s) * (1 - t) + (corners[2] * (1 - s) + corners[3] * s) * t
        nearest = values[np.ix_(i + (s[:, 0] > 0.5), j + (t[0] > 0.5))]
        finite = np.isfinite(corners[0]) & np.isfinite(corners[1]) & np.isfinite(corners[2]) & np.isfinite(corners[3])
        return np.asarray(np.where(finite, mixed, nearest))

    def names(self, unit: str = "") -> tuple[str, str]:
        """Return the two coordinates in words, such as ``t of the earlier index``.

        It is only ``t`` where a tuple has a single index. A time is followed by its ``unit``, where one is given: ``t
        of the earlier index, in s``.
        """
        (slot, c), (other_slot, k) = self.first, self.second
        in_unit = [f", in {unit}" if unit and self.g.kinds[axis] == "time" else "" for axis in (c, k)]
        if len(self.anchor) == 1:
            return self.g.names[c] + in_unit[0], self.g.names[k] + in_unit[1]
        if c == k:
            labels = ("the earlier", "the later") if self.g.kinds[c] == "time" else ("the lower", "the upper")
        else:
            labels = ("the deciding",) * 2 if slot == other_slot else ("one", "the other")
        return (
            f"{self.g.names[c]} of {labels[0]} index{in_unit[0]}",
            f"{self.g.names[k]} of {labels[1]} index{in_unit[1]}",
        )


@final
@dataclass(frozen=True)
class LandscapeAxes:
    """The two axes of a map: each is a coordinate of one of the two indices that decide most.

    ``ranks`` says which index it is: 0 for the one that decides most, 1 for the other.
    """

    ranks: tuple[int, int]
    coordinates: tuple[int, int]

    @property
    def orders(self) -> bool:
        """True where the axes are the same coordinate of two indices; the smaller one is then across."""
        return self.coordinates[0] == self.coordinates[1]

    @classmethod
    def over(
        cls,
        g: RelaxedValue,
        count: int,
        named: tuple[str, str] | None = None,
        reach: Mapping[Axis, Reach] | None = None,
    ) -> LandscapeAxes | None:
        """Return the axes of the map of tuples of ``count`` indices.

        Parameters
        ----------
        g : RelaxedValue
            The function.
        count : int
            The number of indices of a tuple.
        named : tuple of two str, optional
            The names of the axes.
        reach : mapping, optional
            The changes of g along the axes (`measure`). Unless names are given, the axes are the two of the largest
            change. Equal ones, and those of which nothing is known, come in the order of `axes_of`: first a coordinate
            such as the time, of one or of two indices.

        Returns
        -------
        LandscapeAxes or None
            The axes; ``None`` where fewer than two coordinates can move.

        Raises
        ------
        InputError
            If there is no coordinate of that name, or one is named twice.
        """
        if named is not None:
            first, second = (coordinate(name, g) for name in named)
            if first == second:
                raise InputError(f"landscape: coordinates: expected two, got {named[0]!r} twice")
            return cls((first[0], second[0]), (first[1], second[1]))
        changes = reach or {}
        axes = sorted(axes_of(g, count), key=lambda axis: changes.get(axis, (0.0, 0.0)), reverse=True)
        if len(axes) < 2:
            return None
        (rank, c), (next_rank, k) = sorted(axes[:2], key=lambda axis: axis[::-1])
        return cls((rank, next_rank), (c, k))

    @staticmethod
    def measure(g: RelaxedValue, anchor: Array, pair: tuple[int, int], reach: dict[Axis, Reach]) -> Iterator[None]:
        """Evaluate g along every possible axis, one point at each step, and write the changes into ``reach``.

        Nothing is evaluated where there is no choice of axes.

        Parameters
        ----------
        g : RelaxedValue
            The function.
        anchor : array (D, width)
            The tuple through which the axes go.
        pair : tuple of int
            The two indices that decide most.
        reach : dict
            The changes of g along the axes, which are added here.
        """
        axes = axes_of(g, 1 if pair[0] == pair[1] else 2)
        for rank, c in axes if len(axes) > 2 else ():
            other_axis = next((r, k) for r, k in axes if (r, k) != (rank, c))
            line = Landscape(g, anchor, (pair[rank], c), (pair[other_axis[0]], other_axis[1]), VALUES_PER_COORDINATE)
            yield from line.cross()
            reach[rank, c] = line.reach

    def places(self, pair: tuple[int, int], anchor: Array) -> tuple[Place, Place]:
        """Return the places of the axes in a tuple.

        Parameters
        ----------
        pair : tuple of int
            The two indices that decide most.
        anchor : array (D, width)
            The tuple.

        Returns
        -------
        tuple of two places
            The places of the axis to the right and of the axis upwards. Where both are the same coordinate, the index
            with the smaller value is to the right.
        """
        first, second = ((pair[rank], c) for rank, c in zip(self.ranks, self.coordinates, strict=True))
        return (second, first) if self.orders and anchor[second] < anchor[first] else (first, second)

    def of(self, given_coordinates: tuple[int, ...], places: Array) -> Array | None:
        """Return the points of the map at the places of two indices.

        Parameters
        ----------
        given_coordinates : tuple of int
            The coordinates ``(c,)`` that the places contain.
        places : array (n, 2, c)
            The places of the two indices.

        Returns
        -------
        array (n, 2) or None
            The points; ``None`` where the coordinates of the axes are not among those that the places contain.
        """
        if not set(self.coordinates) <= set(given_coordinates):
            return None
        points = np.stack(
            [places[:, r, given_coordinates.index(c)] for r, c in zip(self.ranks, self.coordinates, strict=True)],
            axis=-1,
        )
        return np.sort(points, axis=1) if self.orders else points


def axes_of(g: RelaxedValue, count: int) -> list[Axis]:
    """Return every possible axis of a map of tuples of ``count`` indices: each coordinate that can move, of one or two
    indices."""
    return [(rank, c) for c in moving_of(g) for rank in range(min(2, count))]


def moving_of(g: RelaxedValue) -> list[int]:
    """Return the coordinates of an index that a map may be over.

    They are those that can move and belong to no disturbance. Directions come last, as they mean least to a reader.
    """
    return sorted(g.coordinates, key=lambda k: g.kinds[k] == "direction")


def coordinate(name: str, g: RelaxedValue) -> tuple[int, int]:
    """Return the rank and the coordinate of a name such as ``t``, ``p1`` or ``t[2]``.

    A name with ``[2]`` is that of the index that decides second. Raises `InputError` where there is no such name.
    """
    letter, bracket, suffix = name.partition("[")
    number = suffix.removesuffix("]") if bracket else "1"
    if letter not in g.names or number not in ("1", "2"):
        raise InputError(
            f"landscape: coordinates: there is no {name!r}; expected one of {', '.join(g.names[:6])}"
            f"{', ...' if len(g.names) > 6 else ''}, of the index that decides most, or such a name with [2], of the "
            "one that decides second"
        )
    return int(number) - 1, g.names.index(letter)


def deciding_pair(g: RelaxedValue, anchor: Array) -> tuple[int, int]:
    """Return the two indices that decide most at the tuple at which g was evaluated last.

    Parameters
    ----------
    g : RelaxedValue
        The function.
    anchor : array (D, width)
        The tuple.

    Returns
    -------
    tuple of int
        The two indices; the same one twice where there is only one.
    """
    plain = list(g.coordinates)
    widths = g.slot.upper[plain] - g.slot.lower[plain]
    return two_of(g.deciding(), anchor[:, plain], widths, (0, min(1, len(anchor) - 1)))


def two_of(ranked: Sequence[int] | np.ndarray, slots: Array, widths: Array, others: Sequence[int]) -> tuple[int, int]:
    """Return the two indices of a tuple that decide most and do not stand for the same constraint.

    Parameters
    ----------
    ranked : sequence of int
        Indices by their multipliers, the largest first; -1 for none.
    slots : array (D, c)
        The tuple.
    widths : array (c,)
        The widths of the box.
    others : sequence of int
        The indices that are taken after those that are ranked; any other index comes last.

    Returns
    -------
    tuple of int
        The two indices; the same one twice where there is only one.
    """
    first, *lower_ranked = [int(k) for k in ranked if k >= 0] or [int(others[0])]
    distinct = [k for k in lower_ranked if np.abs((slots[k] - slots[first]) / widths).max() > SAME_CONSTRAINT_DISTANCE]
    second = next((k for k in (*distinct, *others, *lower_ranked, *range(len(slots))) if k != first), first)
    return first, int(second)


def deciding_slots(deciding: np.ndarray, tuples: Array, widths: Array, pair: tuple[int, int]) -> np.ndarray:
    """Return the two indices that decide most in each of the tuples of a search.

    Parameters
    ----------
    deciding : array of int (n, 4)
        The indices of every tuple by their multipliers, the largest first; -1 for none.
    tuples : array (n, D, c)
        The tuples.
    widths : array (c,)
        The widths of the box.
    pair : tuple of int
        The two indices before the first tuple.

    Returns
    -------
    array of int (n, 2)
        The two indices of every tuple. Where fewer than two decide, the others are those of the tuple before.
    """
    rows, first = np.arange(len(tuples)), deciding[:, 0]
    heads = tuples[rows, first]  # of a row in which nothing decides it is any index, and not used
    is_distinct = (
        np.abs((tuples[rows[:, np.newaxis], deciding] - heads[:, np.newaxis]) / widths).max(axis=2)
        > SAME_CONSTRAINT_DISTANCE
    )
    is_distinct &= deciding >= 0
    second = np.where(is_distinct.any(axis=1), deciding[rows, is_distinct.argmax(axis=1)], -1)
    pairs = list[tuple[int, int]]()
    for row, (first_slot, second_slot) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        if first_slot >= 0 and second_slot < 0:  # one decides alone, or all that decide stand for the same constraint
            second_slot = next((k for k in pair if k != first_slot), -1)
        if first_slot >= 0 and second_slot < 0:
            first_slot, second_slot = two_of(deciding[row], tuples[row], widths, pair)
        pair = (first_slot, second_slot) if first_slot >= 0 else pair
        pairs.append(pair)
    return np.array(pairs, dtype=int).reshape(-1, 2)


def deciding_again(g: RelaxedValue, points: Array, notes: Mapping[str, Array], seconds: float) -> np.ndarray:
    """Return the indices ``(n, 4)`` that decide most in each tuple ``(n, D width)`` of a search; -1 where it is not
    known.

    No run directory keeps them. The tuples that the search accepted are evaluated once more for some ``seconds``, the
    last ones first.
    """
    deciding = np.full((len(points), DECIDING), -1)
    accepted = notes.get("accepted", np.ones(len(points))) > 0.0
    end = time.monotonic() + seconds
    for row in np.flatnonzero(accepted)[::-1]:
        if time.monotonic() > end:
            break
        g.at(points[row].reshape(-1, g.slot.dimension))
        deciding[row] = g.deciding()
    return deciding
