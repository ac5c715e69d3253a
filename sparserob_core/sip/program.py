"""Semi-infinite programs: one decision, a convex cost, and families of infinitely many constraints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from types import MappingProxyType
from typing import ClassVar, Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import brief
from sparserob_core.errors import InputError
from sparserob_core.quantities import quantity
from sparserob_core.shapes import Float, sealed, shaped
from sparserob_core.sip.convex_set import Array, Box, as_bound
from sparserob_core.sip.convexity import require_convex, sparse_matrix
from sparserob_core.sip.expressions.index_sets import Index, number_parts, read_index
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.slopes import BoundedSlopes
from sparserob_core.sip.expressions.statements import Decisions, read_tables
from sparserob_core.sip.finite import Blocks, FiniteProgram, Spread, UncertainRows

Formulation: TypeAlias = Literal["reduced", "nominal", "literal", "sampled"]
"""Meaning of an index of a family. ``reduced``: the uncertainty that is maximised in closed form is not part of the
index, the rest is; ``nominal``: nothing uncertain is part of it; ``literal``: all of the uncertainty is part of it;
``sampled``: the index is the number of a sample."""


TOLERANCE = 1e-9  # of a row's own unit: a violation of at most this counts as none (docs/decisions/0016)
OUTSIDE = 1e-9  # of the sides of an index set and its distance from 0: error by which rounding may put an index outside
NARROW = 1e-12  # of the side of a box: a gap between two cells that is only rounding of their corners
MAX_GRID_PARTS = 4_000_000  # largest number of parts of the grid between the corners of all cells: 32 MB
EXPRESSED = 0.01  # sharpness of expressions: with 1, excuses cost as much as a gap; a tenth of it is rounding
EQUALITY = 1e-12  # of the numbers that are added up: an equality with at most this residual counts as met


@dataclass(frozen=True, eq=False)
class Separation:
    """The most violated constraints of one family at a decision, worst first.

    Parameters
    ----------
    indices : ndarray, shape (k, d)
        Indices at which the family is violated most.
    rows : ndarray of int, shape (k,)
        Row of the family at each index, from 0.
    violations : ndarray, shape (k,)
        ``rows x - rhs`` of these constraints; negative where a constraint is satisfied.
    bound : float, default inf
        Proven upper bound of the violation of the family over its whole index set; ``inf`` where none is known.
    formulation : Formulation, default "reduced"
        Formulation to which the indices belong.
    """

    indices: Array = field(metadata=quantity("index"))
    rows: Array
    violations: Array = field(metadata=quantity("rows"))
    bound: float = field(default=np.inf, metadata=quantity("bound"))
    formulation: Formulation = "reduced"


@dataclass(frozen=True, eq=False)
class Enclosure:
    """Proven upper bounds of the violation of a family, one for each cell of the index set.

    Parameters
    ----------
    bounds : ndarray, shape (k,)
        Upper bound of the violation of every row over each cell.
    split : ndarray of int, shape (k,)
        Coordinate of each cell whose halving promises the largest improvement.
    bend : ndarray, shape (k,), optional
        Part of each bound that falls with the square of the cell's width. The part is given for a family whose index is
        one number. The separation of such a family then says where cells have to be short, unless its rows have
        deviations.
    """

    bounds: Array
    split: Array
    bend: Array | None = None


@dataclass(frozen=True, eq=False)
class WorstConstraint:
    """The most violated constraint found at a decision: row ``row`` of family ``constraint`` at ``index``.

    Parameters
    ----------
    violation : float
        Amount by which the constraint is violated; negative: it is satisfied with that margin.
    constraint : str
        Name of the family.
    index : ndarray, shape (d,)
        Index of the constraint.
    row : int, default 0
        Row of the family at that index.
    formulation : Formulation, default "reduced"
        Formulation to which the index belongs.
    """

    violation: float = field(metadata=quantity("row"))
    constraint: str
    index: Array = field(metadata=quantity("index"))
    row: int = 0
    formulation: Formulation = "reduced"

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Explanation(ABC):
    """Description of one constraint for a reader: its meaning, and sentences for infeasible programs.

    A program knows only the row of a constraint. Whoever states a family knows its meaning, and describes it in a
    subclass. The class attribute ``decides`` is the name that the field gives to the decision.

    Parameters
    ----------
    text : str
        Meaning of the constraint.
    """

    text: str
    decides: ClassVar[str] = "decision"

    @abstractmethod
    def witness(self, worst: WorstConstraint) -> WorstConstraint:
        """Return the worst constraint, which is this one, with the facts that the field adds to it."""

    def short(self) -> str:
        """Return the meaning of the constraint, without notes."""
        return self.text

    def of_sample(self, number: int) -> Explanation:
        """Return the description of this constraint for one sample of the uncertainty, without its descriptions of
        other cases."""
        return Unexplained(f"{self.text} (sample {number})")

    @property
    def alike(self) -> str:
        """Meaning that the constraint shares with other rows of its family; empty where it shares none."""
        return ""

    def beyond(self, amount: float) -> str:
        """Return the sentence for a constraint that no decision enters and that is violated by ``amount``."""
        return self.out_of_reach(amount, 0.0)

    def apart(self, other: Explanation, share: float, amount: float) -> str:
        """Return the sentence for two constraints that cannot hold together.

        Parameters
        ----------
        other : Explanation
            The second constraint.
        share : float
            Factor of the second constraint: in this constraint plus ``share`` times the other the decision cancels.
        amount : float
            Violation of that sum, whatever the decision.

        Returns
        -------
        str
            One sentence.
        """
        return (
            f"{self.text} and {other.text} cannot hold: their sum is violated by at least {amount:.4g}, "
            f"whatever the {self.decides}"
        )

    def out_of_reach(self, amount: float, needed: float) -> str:
        """Return the sentence for a constraint that no decision satisfies.

        Parameters
        ----------
        amount : float
            Lower bound of the violation.
        needed : float
            Amount by which the decision would have to lower the left side.

        Returns
        -------
        str
            One sentence.
        """
        return f"{self.text} cannot hold: it is violated by at least {amount:.4g}, whatever the {self.decides}"


@final
@dataclass(frozen=True, eq=False)
class Unexplained(Explanation):
    """Description of a constraint whose family offers none."""

    def witness(self, worst: WorstConstraint) -> WorstConstraint:
        return worst


def distinguish_numbers(one: float, two: float) -> tuple[str, str]:
    """Return two numbers as texts of four digits, or of as many more as make the texts differ."""
    texts = [(f"{one:.{digits}g}", f"{two:.{digits}g}") for digits in range(4, 17)]
    return next((pair for pair in texts if pair[0] != pair[1]), texts[-1])


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstraintFamily:
    """Constraints ``rows(xi) x <= rhs(xi)`` for every index ``xi`` in a compact box.

    A violation of at most `TOLERANCE` counts as none, in the numbers of the rows as they are stated. So rows of size
    1e-10 have to be divided by 1e-10. Name, index set and rows are required; the core uses every other field where it
    is given.

    Parameters
    ----------
    name : str
        Name of the family.
    index_set : Box
        Set of all indices, in ``d`` dimensions.
    rows : callable
        Maps indices ``(k, d)`` to ``(G (k, r, n), h (k, r))``, the rows and the right-hand sides.
    scale : callable, optional
        ``scale(x)``: factor of `TOLERANCE` that a proof allows at a decision, in the numbers of the rows (`allowed`).
        Without it the factor is 1. The factor matters for a row that is smaller than 1, and for an equality in a finer
        unit.
    sharpness : float, default 1
        Share of what a proof may count as none up to which it bounds violations, as long as it has found none.
    chosen : callable, optional
        ``chosen(indices (k, d), rows (k,))``: one row of each index, ``(G (k, n), h (k,))``, where all rows would take
        longer.
    worst : callable, optional
        ``worst(x)``: exact separation, a `Separation`.
    enclosure : callable, optional
        ``enclosure(x, lower (k, d), upper (k, d))``: an `Enclosure` of the violation on cells, for proofs.
    cells : tuple of ndarray, optional
        ``(lower (c, d), upper (c, d))``: a partition of the index set into cells on which the enclosure converges.
    gradient : callable, optional
        ``gradient(x, indices (k, d), rows (k,))``: derivative ``(k, d)`` of ``row x - rhs`` in the index.
    linear : ndarray of bool, shape (d,), optional
        Coordinates of the index in which right-hand sides are linear and rows are constant while the other coordinates
        are fixed. A linear coordinate ranges over the set that it stands for, where that set is no box.
    steepest : callable, optional
        ``steepest(x, indices (k, d), rows (k,))``: a `Separation` with one row per index, in the order of ``indices``.
        The linear coordinates of each index are moved to where its row is violated most. A row of -1 stands for the row
        that is then violated most.
    nominal : ConstraintFamily, optional
        The same constraints without the uncertainty.
    sample : callable, optional
        ``sample(count, rng)``: the same constraints for ``count`` sampled uncertainties only.
    literal : ConstraintFamily, optional
        The same constraints with an inner maximisation left to the index.
    reduced : ConstraintFamily, optional
        Of a literal family, the family in which the inner maximisation is done in closed form.
    explain : callable, optional
        ``explain(index (d,), row)``: an `Explanation` of one constraint.
    hindrance : callable, optional
        ``hindrance(lower (d,), upper (d,))``: the reason for a wide enclosure of a cell and a remedy, in words.
    row_units : ndarray, shape (r,), optional
        Value in the user's units of a violation of 1 of each row, for a family in units of its own (`OwnUnits`).
    index_units : ndarray, shape (d,), optional
        Value in the user's units of 1 of each coordinate of an index, likewise.
    measured : sequence of str, length r, optional
        Name of the unit of every row, where it is known.
    along : str, optional
        Name of the unit of the first coordinate of an index, where it is known.
    coordinates : sequence of str, length d, optional
        Name of every coordinate of an index, where it is known.
    uncertain : callable, optional
        ``uncertain(index (d,))``: the `UncertainRows` at an index, which must hold for every deviation in the program's
        `Spread`. Such a family is not linear in the decision: ``rows`` refuses, and ``excess`` is offered.
    excess : callable, optional
        ``excess(x, indices (k, d))``: the violations ``(k, r)`` at indices, computed without building rows.
    rounding : callable, optional
        ``rounding(reach (n,), indices (k, d))``: bounds ``(k, r)`` of the rounding errors of ``row x - rhs`` at every
        decision with ``|x| <= reach``, where these may exceed 1e-14 of the row and its right-hand side, since terms
        cancel. Lower bounds count them.
    start : ndarray, shape (k, d), optional
        Indices that a method imposes first, for a family with ``uncertain`` rows.
    defines : bool, default False
        Whether the family only bounds variables that the program's ``settle`` sets to their bounds. Such a family is
        never the worst one.
    scaled : callable, optional
        ``scaled(factor)``: the same constraints with all deviations multiplied by ``factor``.
    formulation : Formulation, default "reduced"
        Meaning of the indices. A cut records it too, so that its index can be understood.
    believed : str, default "encloses or separates"
        Verb for what a proof takes from whoever states the family and cannot be seen from its rows; empty where the
        proof needs nothing of the kind.
    source : object, optional
        Object from which the family was made. The core never reads it, and returns it to whoever made the family.
    parts : tuple of ConstraintFamily, default ()
        Families for which this one stands, such as the pieces of a polytope: a program has them in its place.
    """

    name: str
    index_set: Box
    rows: Callable[[Array], tuple[Array, Array]]
    scale: Callable[[Array], float] | None = None
    sharpness: float = 1.0
    chosen: Callable[[Array, np.ndarray], tuple[Array, Array]] | None = None
    worst: Callable[[Array], Separation] | None = None
    enclosure: Callable[[Array, Array, Array], Enclosure] | None = None
    cells: tuple[Array, Array] | None = None
    gradient: Callable[[Array, Array, Array], Array] | None = None
    linear: np.ndarray | None = None
    steepest: Callable[[Array, Array, np.ndarray], Separation] | None = None
    nominal: ConstraintFamily | None = None
    sample: Callable[[int, np.random.Generator], ConstraintFamily] | None = None
    literal: ConstraintFamily | None = None
    reduced: ConstraintFamily | None = None
    explain: Callable[[Array, int], Explanation] | None = None
    hindrance: Callable[[Array, Array], str] | None = None
    row_units: Array | None = None
    index_units: Array | None = None
    measured: Sequence[str] = ()
    along: str = ""
    coordinates: Sequence[str] = ()
    uncertain: Callable[[Array], UncertainRows] | None = None
    excess: Callable[[Array, Array], Array] | None = None
    rounding: Callable[[Array, Array], Array] | None = None
    start: Array | None = None
    defines: bool = False
    scaled: Callable[[float], ConstraintFamily] | None = None
    formulation: Formulation = "reduced"
    believed: str = "encloses or separates"
    source: object = None
    parts: tuple[ConstraintFamily, ...] = ()

    def __post_init__(self) -> None:
        sealed(self)

    @staticmethod
    def from_expressions(
        name: str,
        *,
        index: Index,
        rows: Sequence[str] | str,
        decision: Mapping[str, int | None],
        tables: Mapping[str, npt.ArrayLike] = MappingProxyType({}),
    ) -> ConstraintFamily:
        """Return a family whose rows are arithmetic in the coordinates of its index, with the enclosure of a proof.

        Parameters
        ----------
        name : str
            Name of the family.
        index : mapping, or sequence of mappings
            Interval of every coordinate of the index, by name, ``{"x": (0, 1)}``; or ``{"names": ["x", "y"],
            "polytope": {"H": H, "h": h}}``, whose polytope may also be a set with finitely many faces; or a list of
            these, in each of which the rows hold.
        rows : str or sequence of str
            Statements such as ``"sum(a[k] * cos(2*pi*k*w) for k in range(10)) - 1 <= d"``, affine in the decision.
            They know the language of the entries of a system, and also ``>=``, two comparisons in one, ``chebyshev(k,
            x)``, and sums over ranges.
        decision : mapping from str to int or None
            Number of entries of every name of the decision, in order; ``None`` for a single entry without a number.
        tables : mapping from str to array, optional
            Lists of numbers, or matrices, whose entries rows may name: ``c[k]`` or ``F[i, k]``.

        Returns
        -------
        ConstraintFamily
            The family; its ``source`` are the parsed rows. A polytope, or a list, has several ``parts``.

        Raises
        ------
        InputError
            If a text is no such statement, or a name, an interval, a polytope or a table is wrong.

        Examples
        --------
        >>> import sparserob_core as sr
        >>> decision = {"a": 3, "d": None}
        >>> rows = ["-d <= sum(a[k] * x^k for k in range(3)) - exp(x) <= d"]
        >>> family = sr.ConstraintFamily.from_expressions("fit", index={"x": (-1, 1)}, rows=rows, decision=decision)
        >>> result = sr.solve(sr.SemiInfiniteProgram(n=4, q=[0, 0, 0, 1], families=[family]))
        >>> result.status, round(result.cost, 6)
        ('certified', 0.045017)
        """
        pieces = ExpressionRows.parse_all(read_index(index), rows, Decisions(decision), read_tables(tables))
        parts = [
            ConstraintFamily.of_rows(part_name, piece)
            for part_name, piece in zip(number_parts(name, len(pieces)), pieces, strict=True)
        ]
        return parts[0] if len(parts) == 1 else replace(parts[0], name=name, parts=tuple(parts))

    @staticmethod
    def of_rows(name: str, expressions: ExpressionRows) -> ConstraintFamily:
        """Return the family of parsed rows."""
        piece = expressions.piece

        def enclose(x: Array, lower: Array, upper: Array) -> Enclosure:
            return Enclosure(*expressions.enclose(x, lower, upper))

        return ConstraintFamily(
            name=name,
            index_set=Box(expressions.lower, expressions.upper),
            rows=expressions.evaluate,
            enclosure=enclose,
            excess=expressions.violations,
            rounding=expressions.roundings,
            sharpness=EXPRESSED,
            explain=lambda index, row: Unexplained(f"{name}, {expressions.rows[row].text} at {piece.describe(index)}"),
            coordinates=piece.labels,
            believed="",
            source=expressions,
        )

    @staticmethod
    def from_function(
        name: str,
        *,
        index_set: Box,
        rows: Callable[[Array], tuple[Array, Array]],
        lipschitz: npt.ArrayLike | None = None,
        curvature: npt.ArrayLike | None = None,
    ) -> ConstraintFamily:
        """Return a family whose rows are a function of Python, with one number that makes a proof possible.

        The number is believed: a result that rests on it says so. It is compared with differences of the rows at some
        indices. A proof by curvatures needs far fewer cells than one by slopes.

        Parameters
        ----------
        name : str
            Name of the family.
        index_set : Box
            Set of all indices, in ``d`` dimensions.
        rows : callable
            Maps indices ``(k, d)`` to ``(G (k, r, n), h (k, r))``, the rows and the right-hand sides.
        lipschitz : array_like, scalar or shape (d,), optional
            Bound of the modulus of the derivative of every entry of ``G`` and ``h`` in each coordinate of the index.
        curvature : array_like, scalar or shape (d,), optional
            Bound of the modulus of their second derivative in each coordinate; instead of ``lipschitz``.

        Returns
        -------
        ConstraintFamily
            The family.

        Raises
        ------
        InputError
            If not one of the two bounds is given, if it is negative, or if samples of the rows contradict it.

        Examples
        --------
        >>> import numpy as np
        >>> import sparserob_core as sr
        >>> def rows(t):
        ...     return np.hstack([-np.ones_like(t), -t])[:, None], -np.exp(t)
        >>> family = sr.ConstraintFamily.from_function(
        ...     "above", index_set=sr.Box([0.0], [1.0]), rows=rows, curvature=np.e
        ... )
        >>> result = sr.solve(sr.SemiInfiniteProgram(n=2, q=[1.0, 0.5], families=[family]))
        >>> result.status, round(result.cost, 5)
        ('certified', 1.85914)
        """
        slopes = BoundedSlopes.of(rows, index_set.lower, index_set.upper, lipschitz, curvature)

        def enclose(x: Array, lower: Array, upper: Array) -> Enclosure:
            return Enclosure(*slopes.enclose(x, lower, upper))

        what = "states of its slopes" if curvature is None else "states of its curvature"
        return ConstraintFamily(name=name, index_set=index_set, rows=rows, enclosure=enclose, believed=what)

    @property
    def provable(self) -> bool:
        """True where a proof over the whole index set is possible: the family, or its reduced form, has ``enclosure``
        or ``worst``."""
        proven = self.reduced or self
        return proven.enclosure is not None or proven.worst is not None

    def formulated(self, formulation: Formulation) -> ConstraintFamily | None:
        """Return the same constraints with the indices of another formulation.

        Parameters
        ----------
        formulation : Formulation
            The other formulation.

        Returns
        -------
        ConstraintFamily or None
            The family; ``None`` where this family lacks that formulation. For a family on which the uncertainty does
            not act, all formulations have the same constraints.
        """
        if formulation == self.formulation:
            return self
        forms = {"reduced": self.reduced, "nominal": self.nominal, "literal": self.literal}
        return forms.get(formulation)

    @shaped
    def separated(self, x: Float[Array, " n"]) -> Separation:
        """Return the separation by `worst` at the decision ``x``, after a check of its fields.

        Parameters
        ----------
        x : ndarray, shape (n,)
            The decision.

        Returns
        -------
        Separation
            The answer of `worst`.

        Raises
        ------
        InputError
            Where the answer is no separation of this family: wrong shapes, violations that are not numbers, indices
            outside the index set, or a bound below a violation.
        """
        assert self.worst is not None
        separation, box = self.worst(x), self.index_set
        indices, violations = (
            np.asarray(separation.indices, dtype=float),
            np.asarray(separation.violations, dtype=float),
        )
        if indices.ndim != 2 or not len(indices) == np.size(separation.rows) == violations.size:
            raise self._make_error("worst", "indices (k, d), rows (k,) and violations (k,)", f"shape {indices.shape}")
        if np.asarray(separation.rows).dtype.kind not in "iu" or (np.asarray(separation.rows) < 0).any():
            raise self._make_error("worst", "numbers of rows, from 0", f"{np.asarray(separation.rows).tolist()}")
        if np.isnan(violations).any():
            raise self._make_error("worst", "violations that are numbers", f"{violations.tolist()}")
        if violations.size and separation.bound < violations.max() - TOLERANCE:
            raise self._make_error(
                "worst", f"a bound of at least {violations.max():.6g}, its own", f"{separation.bound:.6g}"
            )
        if indices.shape[1] != box.dimension:
            raise self._make_error("worst", f"indices (k, {box.dimension})", f"shape {indices.shape}")
        slack = OUTSIDE * (box.upper - box.lower + np.abs(box.lower) + np.abs(box.upper))
        outside = ~((indices >= box.lower - slack) & (indices <= box.upper + slack)).all(axis=1)
        if outside.any():
            raise self._make_error("worst", "indices of the index set", f"{indices[outside][0].tolist()}")
        return separation

    @shaped
    def enclosed(self, x: Float[Array, " n"], lower: Float[Array, "k d"], upper: Float[Array, "k d"]) -> Enclosure:
        """Return the bounds of `enclosure` on cells at the decision ``x``, after a check of their shapes.

        Parameters
        ----------
        x : ndarray, shape (n,)
            The decision.
        lower, upper : ndarray, shape (k, d)
            Corners of the cells.

        Returns
        -------
        Enclosure
            The answer of `enclosure`. A bound that is NaN proves nothing, and is replaced by infinity.

        Raises
        ------
        InputError
            Where the answer is not one bound and one coordinate for each cell.
        """
        assert self.enclosure is not None
        enclosure = self.enclosure(x, lower, upper)
        if np.shape(enclosure.bounds) != (len(lower),) or np.shape(enclosure.split) != (len(lower),):
            got = f"shapes {np.shape(enclosure.bounds)} and {np.shape(enclosure.split)}"
            raise self._make_error("enclosure", f"bounds and coordinates ({len(lower)},)", got)
        return replace(enclosure, bounds=np.where(np.isnan(enclosure.bounds), np.inf, enclosure.bounds))

    @cached_property
    def partition(self) -> tuple[Array, Array]:
        """Corners ``(lower, upper)`` of the `cells`, or of the whole index set; `InputError` where an index lies in no
        cell."""
        box = self.index_set
        if self.cells is None:
            return box.lower[None], box.upper[None]
        lower, upper = self.cells
        missing = find_uncovered_point(lower, upper, box)
        if missing is not None:
            raise self._make_error("cells", "cells that cover the index set", f"none around {missing.tolist()}")
        return lower, upper

    def _make_error(self, what: str, expected: str, got: str) -> InputError:
        return InputError(f"family {self.name!r}: {what}: expected {expected}, got {got}")

    @shaped
    def explanation(self, index: Float[Array, " d"], row: int) -> Explanation:
        """Return the description of one constraint.

        Parameters
        ----------
        index : ndarray, shape (d,)
            Index of the constraint.
        row : int
            Row of the family at that index.

        Returns
        -------
        Explanation
            Description by the family; where the family offers none, the row number and the index.
        """
        if self.explain is not None:
            return self.explain(index, row)
        return Unexplained(f"row {row} of {self.name} at {np.array2string(index, precision=6)}")

    def row_unit(self, row: int) -> float:
        """Return the value in the user's units of a violation of 1 of a row."""
        return 1.0 if self.row_units is None else float(self.row_units[row])

    def allowed(self, x: Array) -> float:
        """Return the violation that a proof at the decision ``x (n,)`` may count as none."""
        return TOLERANCE if self.scale is None else TOLERANCE * self.scale(x)

    def measure(self, row: int | None = None) -> str:
        """Return the name of the unit of a row, or without ``row`` the names of all units, such as ``m or m/s``; empty
        if unknown."""
        if row is not None:
            return self.measured[row] if row < len(self.measured) else ""
        return " or ".join(dict.fromkeys(self.measured)) if all(self.measured) else ""

    @shaped
    def violations(self, x: Float[Array, " n"], indices: Float[Array, "k d"]) -> Float[Array, "k r"]:
        """Return the violations ``rows(xi) x - rhs(xi)`` at indices.

        Parameters
        ----------
        x : ndarray, shape (n,)
            The decision.
        indices : ndarray, shape (k, d)
            Indices of the family.

        Returns
        -------
        ndarray, shape (k, r)
            Violations; positive where a row is violated.
        """
        if self.excess is not None:
            return self.excess(x, indices)
        G, h = self.rows_at(indices, x.size)
        return np.asarray(G @ x - h, dtype=float)

    def rows_at(self, indices: Array, n: int) -> tuple[Array, Array]:
        """Return the rows and right-hand sides at indices, after a check of their shapes.

        Parameters
        ----------
        indices : ndarray, shape (k, d)
            Indices of the family.
        n : int
            Number of decision variables.

        Returns
        -------
        G : ndarray, shape (k, r, n)
            Rows.
        h : ndarray, shape (k, r)
            Right-hand sides.

        Raises
        ------
        InputError
            Where `rows` returns other shapes.
        """
        G, h = self.rows(indices)
        if np.ndim(G) != 3 or np.shape(G)[::2] != (len(indices), n) or np.shape(G)[:2] != np.shape(h):
            raise InputError(
                f"family {self.name!r}: expected rows of shape ({len(indices)}, r, {n}) and right-hand sides"
                f" ({len(indices)}, r), got {np.shape(G)} and {np.shape(h)}"
            )
        return G, h


def find_uncovered_point(lower: Array, upper: Array, box: Box) -> Array | None:
    """Return a point of the box that lies in none of the cells; ``None`` where the cells cover the box.

    The corners of all cells divide the box into a grid, and each part of the grid is inside a cell or outside of it. A
    grid of more than `MAX_GRID_PARTS` parts is not made. Then the total volume of the cells is compared with that of
    the box.

    Parameters
    ----------
    lower, upper : ndarray, shape (k, d)
        Corners of the cells.
    box : Box
        Box that the cells should cover.

    Returns
    -------
    ndarray, shape (d,), or None
        A point without a cell. ``None`` also where every cell lies on a face of the box. Such cells belong to a cube of
        directions, whose inner points are multiples of points on its faces.
    """
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    if lower.ndim != 2 or lower.shape != upper.shape or lower.shape[1:] != box.lower.shape or not lower.size:
        return box.lower
    free_axes = np.flatnonzero(box.upper > box.lower)
    low, sides = box.lower[free_axes], (box.upper - box.lower)[free_axes]
    begins, ends = ((corners[:, free_axes] - low) / sides for corners in (lower, upper))
    volumes = np.prod(np.minimum(ends, 1.0) - np.maximum(begins, 0.0), axis=1)
    if not np.isfinite(volumes).all():
        return box.lower
    if ((begins == ends) & ((begins == 0.0) | (begins == 1.0))).any(axis=1).all() and free_axes.size:
        return None
    edges = [_merge_edges(np.concatenate([begins[:, i], ends[:, i], [0.0, 1.0]])) for i in range(free_axes.size)]
    middle = (box.lower + box.upper) / 2
    if np.prod([float(axis_edges.size) for axis_edges in edges]) > MAX_GRID_PARTS:
        return middle if volumes.sum() < 1.0 - OUTSIDE else None
    places = [
        [np.searchsorted(edges[i], corners[:, i] - NARROW) for i in range(free_axes.size)] for corners in (begins, ends)
    ]
    count = np.zeros([axis_edges.size for axis_edges in edges], dtype=int)
    for corner in product((0, 1), repeat=free_axes.size):
        at = tuple(places[side][i] for i, side in enumerate(corner))
        np.add.at(count, at, -1 if sum(corner) % 2 else 1)
    for axis in range(free_axes.size):
        count = np.cumsum(count, axis=axis)
    empty = np.argwhere(count[(slice(None, -1),) * free_axes.size] <= 0)
    if not empty.size:
        return None
    middle[free_axes] = low + sides * [(edges[i][at] + edges[i][at + 1]) / 2 for i, at in enumerate(empty[0])]
    return middle


def _merge_edges(corners: Array) -> Array:
    """Return the sorted shares of a side, clipped to [0, 1], without those within `NARROW` of the one before."""
    edges = np.unique(np.clip(corners, 0.0, 1.0))
    kept: Array = edges[np.append(True, np.diff(edges) > NARROW)]
    return kept


@dataclass(frozen=True, eq=False)
class EqualityErrors:
    """Proven bounds of the residuals of equalities at a decision, and the residuals that a claim may excuse.

    Parameters
    ----------
    missed : ndarray, shape (e,)
        Upper bounds of the residuals, with all rounding counted.
    allowed : ndarray, shape (e,)
        Residuals that a claim may excuse.
    advice : str, optional
        Reason for large bounds, and a remedy.
    """

    missed: Array = field(metadata=quantity("equalities"))
    allowed: Array = field(metadata=quantity("equalities"))
    advice: str = ""

    @property
    def kept(self) -> bool:
        """True where every equality holds within its allowed residual."""
        return bool((self.missed <= self.allowed).all())


@dataclass(frozen=True, eq=False)
class SemiInfiniteProgram:
    """Convex semi-infinite program: a convex cost, finitely many linear constraints, and constraint families.

    Minimise ``sum_k weights_k |(S x)_k| + 1/2 x'P x + q'x + constant`` subject to ``lower <= S x <= upper``, ``G x <=
    h``, ``A x = b`` and every constraint of every family at every index.

    Parameters
    ----------
    n : int
        Number of decision variables, at least 1.
    families : sequence of ConstraintFamily, default ()
        Constraint families; their names must differ.
    q : array_like, shape (n,), optional
        Linear cost; 0 by default.
    P : array_like or sparse, shape (n, n), optional
        Quadratic cost, symmetric and positive semidefinite except for rounding (`require_convex`); 0 by default.
    weights : array_like, scalar or shape (k,), optional
        Weights of the absolute values, not negative; 0 by default.
    S : array_like or sparse, shape (k, n), optional
        Matrix of the image ``S x``; the identity by default.
    lower, upper : array_like, scalar or shape (k,), default -inf and inf
        Bounds of ``S x``.
    G : array_like, shape (r, n), optional
        Rows of the inequalities, given together with ``h``.
    h : array_like, shape (r,), optional
        Right-hand sides of the inequalities. A row with ``h`` infinite has no effect.
    A : array_like, shape (e, n), optional
        Rows of the equalities, given together with ``b``.
    b : array_like, shape (e,), optional
        Right-hand sides of the equalities.
    channels : int, default 1
        Number of channels into which the rows of ``S`` are divided (`ControlImage`).
    lengths : ndarray, shape (k,), optional
        Factor of each entry of ``S x`` in a weighted regulariser, such as the length of a piece.
    activity : ndarray, optional
        Price of an entry of ``S x`` that is not 0, in the user's units, for the first entries or for all
        (`working.counting`). The field is given where a count has a meaning.
    cost_unit : float, default 1
        Value in the user's units of a cost of 1, for a program in its own units.
    image_units : ndarray, shape (k,), optional
        Value in the user's units of 1 of each entry of ``S x``, likewise.
    constant : float, default 0
        Constant term of the cost.
    blocks : array_like of int, shape (k,), optional
        Block of each entry of ``S x``. Entries with the same number of at least 0 are one block, which costs its weight
        times its Euclidean norm. An entry with -1 counts alone.
    largest : float, optional
        Largest possible cost, where it is known (`largest_cost`).
    spread : Spread, optional
        Set of the deviations for all of which the ``uncertain`` rows of the families must hold.
    settle : callable, optional
        ``settle(x)``: a decision that meets the same constraints and costs no more, for example one whose bounds are as
        tight as possible.
    errors : callable, optional
        ``errors(x)``: proven bounds of the residuals of ``A x = b`` (`EqualityErrors`), where entries of ``A`` and
        ``b`` are rounded.
    guide : tuple of (SemiInfiniteProgram, int), optional
        An easier program, and the number of first entries that its decision shares with this one. A method may search
        for the optimum near that of the easier program.
    among : tuple of (SemiInfiniteProgram, int), optional
        A program with the same constraints and another cost, and the number of first entries that the two decisions
        share. Its cost selects one of several decisions that are equally cheap.
    twin : callable, optional
        Makes the same program in its own units (`own_units`).

    Raises
    ------
    InputError
        Where a shape is wrong, a number is not finite where it has to be, a weight is negative, ``lower`` is above
        ``upper``, ``P`` is not convex, or two families have the same name.
    """

    n: int
    families: Sequence[ConstraintFamily] = ()
    q: npt.ArrayLike | None = None
    P: object | None = None
    weights: npt.ArrayLike | None = None
    S: object | None = None
    lower: npt.ArrayLike = -np.inf
    upper: npt.ArrayLike = np.inf
    G: npt.ArrayLike | None = None
    h: npt.ArrayLike | None = None
    A: npt.ArrayLike | None = None
    b: npt.ArrayLike | None = None
    channels: int = 1
    lengths: Array | None = None
    activity: Array | None = None
    cost_unit: float = 1.0
    image_units: Array | None = None
    constant: float = 0.0
    blocks: npt.ArrayLike | None = None
    largest: float | None = None
    spread: Spread | None = None
    settle: Callable[[Array], Array] | None = None
    errors: Callable[[Array], EqualityErrors] | None = None
    guide: tuple[SemiInfiniteProgram, int] | None = field(default=None, repr=False)
    among: tuple[SemiInfiniteProgram, int] | None = field(default=None, repr=False)
    twin: Callable[[], OwnUnits] | None = field(default=None, repr=False)
    finite: FiniteProgram = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not hasattr(self.n, "__index__") or self.n < 1:
            raise InputError(f"n: expected the number of decision variables, at least 1, got {self.n!r}")
        S = None if self.S is None else sparse_matrix("S", self.S)
        P = None if self.P is None else require_convex("P", self.P, self.n)
        if S is not None and S.shape[1] != self.n:
            raise InputError(f"S: expected {self.n} columns, got shape {S.shape}")
        images = self.n if S is None else int(S.shape[0])
        G, h = self._check_rows("G", self.G, "h", self.h)
        A, b = self._check_rows("A", self.A, "b", self.b)
        weights = _check_vector("weights", 0.0 if self.weights is None else self.weights, images)
        if (weights < 0).any():
            raise InputError(f"weights: expected numbers that are not negative, got {weights.min()}")
        lower, upper = as_bound("lower", self.lower, images), as_bound("upper", self.upper, images)
        if (lower > upper).any():
            raise InputError("lower: is above upper, so nothing is feasible")
        q = _check_vector("q", 0.0 if self.q is None else self.q, self.n)
        families = tuple(part for family in self.families for part in family.parts or (family,))
        names = [family.name for family in families]
        if len(set(names)) < len(names):
            raise InputError(f"families: names must differ, got {names}")
        object.__setattr__(self, "families", families)
        constant = _check_vector("constant", self.constant, 1)
        finite = FiniteProgram(
            q=q, weights=weights, lower=lower, upper=upper, G=G, h=h, A=A, b=b, P=P, S=S, constant=float(constant[0])
        )
        finite = replace(finite, blocks=self._build_blocks(weights))
        sealed(finite)
        for name, kept in (("S", finite.S), ("P", finite.P), ("finite", finite)):
            object.__setattr__(self, name, kept)
        for entry in fields(self):
            value = getattr(self, entry.name)
            if isinstance(value, list):
                object.__setattr__(self, entry.name, np.array(value))
        sealed(self)

    def _build_blocks(self, weights: Array) -> Blocks | None:
        if self.blocks is None:
            return None
        numbers = np.asarray(self.blocks)
        if numbers.shape != weights.shape or numbers.dtype.kind not in "iu":
            raise InputError(f"blocks: expected {weights.size} whole numbers, got shape {numbers.shape}")
        _, number = np.unique(np.where(numbers < 0, -1, numbers), return_inverse=True)
        blocks = Blocks(number.reshape(-1) - int((numbers < 0).any()))
        if (weights[blocks.entries] != weights[blocks.first][blocks.of]).any():
            raise InputError("weights: expected one weight for all images of a block")
        return blocks if blocks.entries.size else None

    def _check_rows(self, left: str, matrix: object, right: str, bounds: object) -> tuple[Array, Array]:
        if (matrix is None) != (bounds is None):
            raise InputError(f"{left}, {right}: give both or neither")
        if matrix is None:
            return np.zeros((0, self.n)), np.zeros(0)
        rows = np.atleast_2d(np.asarray(matrix, dtype=float))
        if rows.ndim != 2 or rows.shape[1] != self.n or not np.isfinite(rows).all():
            raise InputError(f"{left}: expected finite numbers of shape (rows, {self.n}), got shape {rows.shape}")
        return rows, (_check_vector if left == "A" else _check_upper)(right, bounds, rows.shape[0])

    @property
    def own_units(self) -> OwnUnits | None:
        """Twin of this program in its own units; ``None`` where it has no twin, or was changed after the twin was
        attached."""
        own = None if self.twin is None else self.twin()
        if own is None or len(own.of) != len(self._components):
            return None
        return (
            own
            if all(value is twin_value for value, twin_value in zip(self._components, own.of, strict=True))
            else None
        )

    @property
    def _components(self) -> tuple[object, ...]:
        """All fields of the program except its twin.

        Arrays cannot be written to, and families and sets are frozen records. So the same objects mean the same
        program.
        """
        own = [getattr(self, entry.name) for entry in fields(self) if entry.name not in ("twin", "finite", "families")]
        return (*own, *self.families)

    def mirrored(self, twin: Callable[[SemiInfiniteProgram], OwnUnits]) -> SemiInfiniteProgram:
        """Return this program with a twin in its own units, which is made at its first use.

        Parameters
        ----------
        twin : callable
            Maps a program to the same program in its own units, an `OwnUnits`.

        Returns
        -------
        SemiInfiniteProgram
            This program with the twin.
        """
        cache: list[OwnUnits] = []

        def once() -> OwnUnits:
            if not cache:
                cache.append(replace(twin(self), of=self._components))
            return cache[0]

        return replace(self, twin=once)

    @property
    def image_size(self) -> int:
        """Number of entries of ``S x`` in the regulariser: those with a length, or all of them."""
        return self.finite.weights.size if self.lengths is None else int(np.size(self.lengths))

    def family(self, name: str) -> ConstraintFamily:
        """Return the family with a given name."""
        return next(family for family in self.families if family.name == name)

    def formulated(self, name: str, formulation: Formulation) -> ConstraintFamily | None:
        """Return a family with the indices of another formulation.

        Parameters
        ----------
        name : str
            Name of the family.
        formulation : Formulation
            The other formulation.

        Returns
        -------
        ConstraintFamily or None
            The family; ``None`` where it lacks that formulation.
        """
        return self.family(name).formulated(formulation)

    @cached_property
    def origin(self) -> object:
        """Object from which the program was made, where its maker has set one; ``None`` after any replacement."""
        return None

    @cached_property
    def largest_cost(self) -> float:
        """Largest possible cost within the bounds, used as a scale only: no claim depends on it.

        An entry with a cost may have no bound. Then the value is a million times the largest coefficient, and at most a
        million.
        """
        if self.largest is not None:
            return self.largest
        program = self.finite
        radii = np.maximum(np.abs(program.lower), np.abs(program.upper))
        size = np.full(self.n, np.inf) if program.S is not None else radii
        curvature = np.zeros(self.n) if program.P is None else abs(program.P).sum(axis=0)
        with np.errstate(invalid="ignore"):
            terms = [
                np.where(cost > 0.0, cost * bound, 0.0)
                for cost, bound in ((program.weights, radii), (np.abs(program.q), size), (curvature / 2, size**2))
            ]
        largest = float(sum(term.sum() for term in terms)) + abs(program.constant)
        if np.isfinite(largest):
            return largest
        coefficients = (program.weights, np.abs(program.q), curvature)
        return 1e6 * min(1.0, max(float(cost.max(initial=0.0)) for cost in coefficients))

    @shaped
    def cost(self, x: Float[Array, " n"]) -> float:
        """Return the cost ``J(x)``, computed from the data of the program."""
        return self.finite.objective(x)

    @shaped
    def added(self, x: Float[Array, " n"]) -> float:
        """Return the sum of the sizes of the four terms of ``J(x)``: absolute values, linear, quadratic and constant.

        The sum exceeds ``|J(x)|`` where terms cancel, for example where a state has to follow a reference.
        """
        return self.finite.added(x)


@dataclass(frozen=True, eq=False)
class OwnUnits:
    """A program in its own units, with the factors that lead back to the user's units; every factor is a power of two.

    The families of the program hold their own factors (`ConstraintFamily.row_unit`).

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program in its own units.
    decision : ndarray, shape (n,)
        Value in the user's units of 1 of each decision variable.
    image : ndarray, shape (k,)
        The same factor for each entry of ``S x``.
    equalities : ndarray, shape (e,)
        The same factor for each equality.
    cost : float
        The same factor for the cost.
    wider : callable, optional
        Makes the program in units for all decisions, where these units suit only decisions that are small compared with
        their bounds.
    of : tuple
        All fields of the program that this one represents.
    """

    program: SemiInfiniteProgram
    decision: Array
    image: Array
    equalities: Array
    cost: float
    wider: Callable[[], OwnUnits] | None = None
    of: tuple[object, ...] = field(default=(), repr=False)


def _check_vector(name: str, value: object, size: int) -> Array:
    """Return a vector of ``size`` finite numbers; raise `InputError` otherwise."""
    vector = as_bound(name, value, size)
    if not np.isfinite(vector).all():
        raise InputError(f"{name}: expected finite numbers, got {vector.tolist()}")
    return vector


def _check_upper(name: str, value: object, size: int) -> Array:
    """Return the right-hand sides of inequalities; an entry of infinity is a row without effect, NaN and -inf are
    refused."""
    vector = as_bound(name, value, size)
    if (vector == -np.inf).any():
        raise InputError(f"{name}: expected numbers, or inf for a row that asks for nothing, got {vector.tolist()}")
    return vector
