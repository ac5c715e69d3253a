"""Index sets of rows: intervals and polytopes, as images of boxes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any, TypeAlias, final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.shapes import Array
from sparserob_core.sip.expressions.expression import Value
from sparserob_core.sip.expressions.triangulation import MAX_MEETINGS, Simplex, exact, find_vertices, triangulate

Index: TypeAlias = "Mapping[str, Any] | Sequence[Mapping[str, Any]]"
"""Intervals by name; or ``names`` and a ``polytope``; or a list of these."""
NAMES, POLYTOPE = "names", "polytope"
MAX_SIMPLICES = 200  # of a polytope: each is searched and proven by itself; ten times as many take many minutes


@final
@dataclass(frozen=True, eq=False)
class Piece:
    """Part of an index set, as the image of a box: a simplex, intervals, or the product of both.

    A simplex with vertices ``v_0, ..., v_k`` is the image of the unit box, ``v_0 + s_1 (v_1 - v_0 + s_2 (v_2 - v_1 +
    ...))`` (Duffy 1982). So whatever holds for boxes holds for polytopes too.

    Parameters
    ----------
    names : tuple of str
        Names of the coordinates of an index, in the user's order.
    simplex : tuple of tuples of Fraction
        Vertices, in the coordinates that no interval bounds; empty where intervals bound all of them.
    mapped : tuple of str
        Names of the coordinates of the vertices.
    lower, upper : array (d,)
        Corners of the box: ``k`` shares, and the intervals of the other coordinates.
    """

    names: tuple[str, ...]
    simplex: Simplex
    mapped: tuple[str, ...]
    lower: Array
    upper: Array

    @property
    def shares(self) -> int:
        """Number of coordinates of the box that are shares of a simplex."""
        return max(len(self.simplex) - 1, 0)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the coordinates of the box."""
        kept = [name for name in self.names if name not in self.mapped]
        return (*(f"share {i + 1}" for i in range(self.shares)), *kept)

    def place(self, coordinates: Sequence[Value], number: Callable[[Fraction], Value]) -> dict[str, Value]:
        """Return the coordinates of indices by name, from those of the box, in any kind of numbers.

        Parameters
        ----------
        coordinates : sequence of d values
            Coordinates of the box.
        number : function
            Makes a number of that kind from a fraction.
        """
        values = dict(zip(self.labels, coordinates, strict=True))
        placed = {name: values[name] for name in self.names if name not in self.mapped}
        for j, name in enumerate(self.mapped):
            corners = [vertex[j] for vertex in self.simplex]
            value: Value = number(Fraction(0))
            for i in range(self.shares, 0, -1):
                value = coordinates[i - 1] * (value + number(corners[i] - corners[i - 1]))
            placed[name] = value + number(corners[0])
        return placed

    def place_exactly(self, index: Array) -> dict[str, Fraction]:
        """Return one index by name, from the coordinates of the box, without rounding."""
        return self.place([Fraction(float(value)) for value in index], Fraction)

    def place_columns(self, indices: Array) -> dict[str, Array]:
        """Return indices ``(k, d)`` of the box by name, ``(k, 1)`` each; none is beyond all vertices by rounding."""
        columns = self.place([indices[:, [i]] for i in range(self.lower.size)], float)
        for j, name in enumerate(self.mapped):
            ends = [float(vertex[j]) for vertex in self.simplex]
            columns[name] = np.clip(columns[name], min(ends), max(ends))
        return columns

    def locate(self, index: Array) -> dict[str, float]:
        """Return one index by name, from the coordinates of the box."""
        return {name: float(value) for name, value in self.place_exactly(index).items()}

    def describe(self, index: Array) -> str:
        """Return one index as text, from the coordinates of the box."""
        return ", ".join(f"{name} = {value:g}" for name, value in self.locate(index).items())


@final
@dataclass(frozen=True, eq=False)
class Region:
    """Index set: a polytope ``H t <= h`` of some coordinates times intervals of the others.

    Parameters
    ----------
    names : tuple of str
        Names of all coordinates, in the user's order.
    coupled : tuple of str
        Names of the coordinates of the polytope; none for a box.
    H : array (r, c)
        Normals of the polytope.
    h : array (r,)
        Right-hand sides.
    lower, upper : array
        Intervals of the other coordinates.
    """

    names: tuple[str, ...]
    coupled: tuple[str, ...]
    H: Array
    h: Array
    lower: Array
    upper: Array

    @staticmethod
    def of_intervals(index: Mapping[str, Sequence[float]]) -> Region:
        """Return a box; raise `InputError` with the name of a coordinate without an interval."""
        lower, upper = read_intervals(index)
        return Region(tuple(index), (), np.zeros((0, 0)), np.zeros(0), lower, upper)

    @cached_property
    def pieces(self) -> tuple[Piece, ...]:
        """Pieces whose union is the set; raise `InputError` where the polytope is empty, unbounded or too large."""
        return tuple(
            Piece(
                self.names,
                simplex,
                self.coupled,
                np.concatenate([np.zeros(max(len(simplex) - 1, 0)), self.lower]),
                np.concatenate([np.ones(max(len(simplex) - 1, 0)), self.upper]),
            )
            for simplex in self._list_simplices()
        )

    def _list_simplices(self) -> list[Simplex]:
        if not self.coupled:
            return [()]
        _require_bounded(self.H, self.h)
        vertices = find_vertices(self.H, self.h)
        if vertices is None:
            raise _polytope_error(
                f"fewer rows, of which at most {MAX_MEETINGS} choices meet in a point",
                f"{len(self.H)} rows in {self.H.shape[1]} coordinates",
            )
        if not vertices:
            raise _polytope_error("a polytope with a point in it", "an empty one")
        if len(vertices) == 1:
            return [(vertices[0], vertices[0])]
        simplices = triangulate(self.H, self.h, vertices)
        if len(simplices) > MAX_SIMPLICES:
            raise _polytope_error(f"a polytope of at most {MAX_SIMPLICES} simplices", f"{len(simplices)}")
        return simplices


def number_parts(name: str, count: int) -> list[str]:
    """Return the names of so many parts of one thing; its own name where it has one part."""
    return [name] if count == 1 else [f"{name} {i + 1}" for i in range(count)]


def _polytope_error(expected: str, got: str) -> InputError:
    return InputError(path="index", expected=expected, got=got)


def _require_bounded(H: Array, h: Array) -> None:
    """Raise `InputError` where a polytope is empty, or not shown to be bounded.

    Multipliers ``y >= 0`` with ``y'H = axis + r`` bound a coordinate, ``t_j <= y'h - r't``. Where the sizes of all
    ``r`` add up to less than 1 they bound every coordinate. This is seen in fractions, whatever a solver says.
    """
    from scipy.optimize import linprog

    largest = np.abs(H).max(axis=0, initial=0.0)
    units = np.exp2(
        -np.round(np.log2(np.where(largest > 0.0, largest, 1.0)))
    )  # coordinates in which no entry is lost beside others
    scaled, missed = H * units, Fraction(0)
    scaled_rows = exact(scaled)
    for axis in np.vstack([np.eye(H.shape[1]), -np.eye(H.shape[1])]):
        found = linprog(-axis, A_ub=scaled, b_ub=h, bounds=(None, None))
        if found.status == 2:
            raise _polytope_error("a polytope with a point in it", "an empty one")
        if found.status != 0:
            raise _polytope_error("a bounded polytope", "an unbounded one")
        y = [Fraction(max(0.0, -float(marginal))) for marginal in found.ineqlin.marginals]
        columns = zip(*scaled_rows, strict=True)
        sums = [sum((a * b for a, b in zip(y, rows, strict=True)), Fraction(0)) for rows in columns]
        off_axis = [abs(total - Fraction(wanted)) for total, wanted in zip(sums, axis.tolist(), strict=True)]
        missed = max(missed, sum(off_axis, Fraction(0)))
    if missed >= 1:
        raise _polytope_error("a bounded polytope", "one that is not shown to be bounded")


def read_index(index: Index) -> list[Region]:
    """Return the index sets that a user states; raise `InputError` with the key that is wrong.

    Parameters
    ----------
    index : mapping, or sequence of mappings
        Intervals ``{"x": (0, 1)}``; or ``{"names": ["x", "y"], "polytope": {"H": H, "h": h}}``, in which any set with
        finitely many faces may be the polytope; or a list of these.
    """
    given: object = index
    if isinstance(given, Mapping):
        return [_read_region(given)]
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise InputError(path="index", expected="at least one coordinate with its interval", got=repr(index))
    regions = []
    for i, part in enumerate(given):
        try:
            if not isinstance(part, Mapping):
                raise InputError(path="index", expected="coordinates with their intervals", got=repr(part))
            regions.append(_read_region(part))
            if not regions[i].pieces or set(regions[i].names) != set(regions[0].names):
                expected = f"the coordinates {', '.join(regions[0].names)} of the first"
                raise InputError(path="index", expected=expected, got=", ".join(regions[i].names))
        except InputError as error:
            error.path = ("index", i, *error.path[1:])
            raise
    return regions


def _read_region(index: Mapping[str, Any]) -> Region:
    if NAMES in index:
        return _read_polytope(index)
    return Region.of_intervals(index)


def read_intervals(index: Mapping[str, Sequence[float]]) -> tuple[Array, Array]:
    """Return the ends of the intervals of an index; raise `InputError` with the name of one that is none."""
    given: object = index
    if not isinstance(given, Mapping) or not given:
        raise InputError(path="index", expected="at least one coordinate with its interval", got=repr(index))
    for name, interval in index.items():
        try:
            ends = np.asarray(interval, dtype=float)
        except (TypeError, ValueError):
            ends = np.zeros(0)
        if ends.shape != (2,) or not np.isfinite(ends).all() or ends[0] > ends[1]:
            raise InputError(path=f"index.{name}", expected="an interval [lower, upper]", got=repr(interval))
    table = np.array([[float(end) for end in interval] for interval in index.values()])
    return table[:, 0].copy(), table[:, 1].copy()


def _read_polytope(index: Mapping[str, Any]) -> Region:
    """Return the set of ``names`` and a ``polytope``. Rows of a single entry are intervals where no other row has their
    coordinate."""
    names, polytope = index[NAMES], index.get(POLYTOPE)
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise InputError(path=f"index.{NAMES}", expected="a list of names", got=repr(names))
    if set(index) != {NAMES, POLYTOPE}:
        raise InputError(path="index", expected="names and a polytope", got=", ".join(map(str, index)))
    H, h = _read_rows(polytope, len(names))
    is_single = (H != 0.0).sum(axis=1) == 1
    lower, upper, coupled = list[float](), list[float](), list[int]()
    for j in range(len(names)):
        touching = H[:, j] != 0.0
        ends = _find_interval(H[touching, j], h[touching]) if is_single[touching].all() else None
        if ends is None:
            coupled.append(j)
        else:
            lower.append(ends[0])
            upper.append(ends[1])
    is_kept = (H[:, coupled] != 0.0).any(axis=1)
    return Region(
        tuple(names),
        tuple(names[j] for j in coupled),
        H[is_kept][:, coupled],
        h[is_kept],
        np.array(lower),
        np.array(upper),
    )


def _read_rows(polytope: object, dimension: int) -> tuple[Array, Array]:
    """Return the rows ``H t <= h`` of a polytope, without those that always hold."""
    if hasattr(polytope, "halfspaces"):
        flat = polytope.halfspaces()
        if flat is None:
            raise _polytope_error("a set with finitely many faces", type(polytope).__name__)
        polytope = dict(zip("Hh", flat, strict=True))
    if not isinstance(polytope, Mapping) or set(polytope) != {"H", "h"}:
        raise _polytope_error("its normals H and its right-hand sides h", repr(polytope))
    try:
        H = np.asarray(polytope["H"], dtype=float)
        h = np.broadcast_to(np.asarray(polytope["h"], dtype=float), H.shape[:1])
    except (TypeError, ValueError):
        H, h = np.full((1, dimension), np.nan), np.zeros(1)
    if H.ndim != 2 or H.shape[1] != dimension or not np.isfinite(H).all() or np.isnan(h).any():
        raise _polytope_error(f"rows H of {dimension} numbers, and a number h for each", repr(polytope))
    if ((H == 0.0).all(axis=1) & (h < 0.0)).any() or np.isneginf(h).any():
        raise _polytope_error("a polytope with a point in it", "an empty one")
    is_kept = (H != 0.0).any(axis=1) & np.isfinite(h)
    return H[is_kept], h[is_kept]


def _find_interval(slopes: Array, sides: Array) -> tuple[float, float] | None:
    """Return the interval of rows ``slope t <= side``; ``None`` where an end is no double, or is missing."""
    ends = [Fraction(float(b)) / Fraction(float(a)) for a, b in zip(slopes, sides, strict=True)]
    below = [end for end, slope in zip(ends, slopes, strict=True) if slope < 0.0]
    above = [end for end, slope in zip(ends, slopes, strict=True) if slope > 0.0]
    if not below or not above or max(below) > min(above):
        return None
    low, high = max(below), min(above)
    return (float(low), float(high)) if (Fraction(float(low)), Fraction(float(high))) == (low, high) else None
