"""Semi-infinite programs that are stated as text: decisions, an objective, rows, and families of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array, as_bound
from sparserob_core.sip.convexity import require_convex
from sparserob_core.sip.expressions.index_sets import Index, Region, number_parts, read_index
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import Decisions, StatedRow, Words, parse_cost, parse_rows, read_tables
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram
from sparserob_core.sip.stated.terms import AffineFunction, ExpandedCost, StatedObjective

RESERVED = ("config", "objective", "lower bound", "bounds and rows", "infeasibility", "violation", "status")
"""Names of claims about a program, which no family may have."""
Multiple: TypeAlias = tuple[int, float]
"""An entry of the decision, and the factor before it."""
MAX_PAIRS = 300_000  # of entries, where products are multiplied out in fractions: ten times as many take a minute
MAX_STATED_ENTRIES = 100_000  # of a decision with its residuals: ten times as many take a matrix of gigabytes


@final
@dataclass(frozen=True, eq=False)
class StatedDecision:
    """Entries of the decision with one name.

    Parameters
    ----------
    size : int, optional
        Number of entries; without it the name is a single number.
    lower, upper : array_like, scalar or shape (size,), default -inf and inf
        Bounds.
    """

    size: int | None = None
    lower: npt.ArrayLike = -np.inf
    upper: npt.ArrayLike = np.inf


@final
@dataclass(frozen=True, eq=False)
class StatedFamily:
    """Rows that hold for every index of a set.

    Parameters
    ----------
    name : str
        Name of the family.
    index : mapping, or sequence of mappings
        Interval of every coordinate; or names and a polytope; or a list of these (`ConstraintFamily.from_expressions`).
    rows : sequence of str
        Statements, affine in the decision (`ConstraintFamily.from_expressions`).
    """

    name: str
    index: Index
    rows: Sequence[str]


@final
@dataclass(frozen=True, eq=False)
class StatedProgram:
    """A semi-infinite program as text.

    Parameters
    ----------
    decision : mapping from str to StatedDecision
        Names of the decision, in order.
    minimise : str
        Objective: affine terms, squares and products of affine terms, and absolute values, with sums as in rows. It is
        convex.
    families : sequence of StatedFamily
        Rows that hold for every index.
    rows : sequence of str, default ()
        Rows without an index, with ``<=``, ``>=`` or ``==``.
    tables : mapping from str to array, optional
        Lists of numbers, or matrices, whose entries the texts may name.

    Raises
    ------
    InputError
        If a text cannot be read, or is no such statement; the error names its key.
    """

    decision: Mapping[str, StatedDecision]
    minimise: str
    families: Sequence[StatedFamily]
    rows: Sequence[str] = ()
    tables: Mapping[str, npt.ArrayLike] = field(default_factory=dict)

    @cached_property
    def _words(self) -> Words:
        sizes = {name: entry.size for name, entry in self.decision.items()}
        return Words(Decisions(sizes), (), read_tables(self.tables))

    @cached_property
    def objective(self) -> StatedObjective:
        """The objective, term by term."""
        try:
            return StatedObjective.of(parse_cost(self.minimise, self._words))
        except InputError as error:
            raise error.under("minimise") from None

    @cached_property
    def residuals(self) -> tuple[AffineFunction, ...]:
        """Affine functions of which the objective takes squares or absolute values, and that are more than one entry:
        each is a further entry of the decision, so that no condition is squared.

        Where products are convex only together, such as ``(x + y)*(x - y) + 2*y^2``, they are multiplied out instead.
        """
        objective, n = self.objective, self._words.decisions.n
        if n > MAX_STATED_ENTRIES:
            raise InputError(path="decision", expected=f"at most {MAX_STATED_ENTRIES} entries", got=f"{n}")
        inner = [term for _, term in objective.absolutes]
        every = _list_distinct([term for _, left, right in objective.products for term in (left, right)] + inner)
        if n + len(every) > MAX_STATED_ENTRIES:
            raise InputError(path="minimise", expected=f"at most {MAX_STATED_ENTRIES} terms", got=f"{len(every)}")
        if objective.is_sum_of_squares or objective.count_pairs() > MAX_PAIRS:
            return every
        polynomial = objective.expand(_number_terms(every, n))
        try:
            require_convex("minimise", _build_quadratic(polynomial.products, n + len(every)), n + len(every))
        except InputError:
            return _list_distinct(inner)
        return every

    @cached_property
    def finite_rows(self) -> tuple[StatedRow, ...]:
        """Rows without an index."""
        rows: list[StatedRow] = []
        for i, text in enumerate(self.rows):
            try:
                rows += parse_rows(text, self._words, equalities=True)
            except InputError as error:
                raise error.under("rows", i) from None
        return tuple(rows)

    @cached_property
    def finite_terms(self) -> tuple[tuple[AffineFunction, bool], ...]:
        """Rows without an index, in numbers, and whether each is an equality."""
        return tuple((AffineFunction.list_terms(row.form({}))[0], row.is_equality) for row in self.finite_rows)

    @cached_property
    def decisions(self) -> Decisions:
        """Names of the decision, with as many entries without a name as there are `residuals`."""
        return Decisions(self._words.decisions.sizes, len(self.residuals))

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds of all entries of the decision."""
        sides: list[list[Array]] = [[], []]
        for name, entry in self.decision.items():
            for side, key, given in zip(sides, ("lower", "upper"), (entry.lower, entry.upper), strict=True):
                try:
                    side.append(as_bound(key, given, entry.size or 1))
                except InputError as error:
                    raise error.under("decision", name) from None
            if (sides[0][-1] > sides[1][-1]).any():
                raise InputError(
                    path=f"decision.{name}.lower",
                    expected="numbers that are not above those of upper",
                    got=f"{sides[0][-1].tolist()} and {sides[1][-1].tolist()}",
                )
        count = len(self.residuals)
        return (
            np.concatenate([*sides[0], np.full(count, -np.inf)]),
            np.concatenate([*sides[1], np.full(count, np.inf)]),
        )

    @cached_property
    def regions(self) -> tuple[tuple[Region, ...], ...]:
        """Index sets of every family."""
        regions = []
        for i, family in enumerate(self.families):
            try:
                regions.append(tuple(read_index(family.index)))
            except InputError as error:
                raise error.under("families", i) from None
        return tuple(regions)

    @cached_property
    def parsed(self) -> tuple[tuple[str, ExpressionRows], ...]:
        """Names and rows of all families, one for every piece of their index sets."""
        tables, named_rows = self._words.tables, list[tuple[str, ExpressionRows]]()
        for i, (family, regions) in enumerate(zip(self.families, self.regions, strict=True)):
            if family.name in RESERVED:
                raise InputError(
                    path=f"families.{i}.name", expected="a name that no claim of a check has", got=family.name
                )
            try:
                parts = ExpressionRows.parse_all(regions, family.rows, self.decisions, tables)
            except InputError as error:
                raise error.under("families", i) from None
            named_rows += zip(number_parts(family.name, len(parts)), parts, strict=True)
        return tuple(named_rows)

    @cached_property
    def _places(self) -> Mapping[int, int]:
        return _number_terms(self.residuals, self._words.decisions.n)

    @cached_property
    def polynomial(self) -> ExpandedCost:
        """The objective in the entries of the decision, but for its absolute values."""
        return self.objective.expand(self._places)

    @property
    def absolutes(self) -> list[tuple[float, Multiple]]:
        """Absolute values of the objective: weights, and multiples of entries of the decision."""
        return [(weight, _locate(inner, self._places)) for weight, inner in self.objective.absolutes]

    @property
    def definitions(self) -> list[AffineFunction]:
        """Affine functions that are 0: the `residuals`, each minus its entry of the decision."""
        return [_subtract_entry(term, self._places[id(term)]) for term in self.residuals]

    def build(self) -> SemiInfiniteProgram:
        """Return the program, whose `origin` is this statement."""
        n, polynomial = self.decisions.n, self.polynomial
        q, weights = np.zeros(n), np.zeros(n)
        for i, slope in polynomial.slopes.items():
            q[i] = float(slope)
        for weight, (place, factor) in self.absolutes:
            if weight < 0.0:
                raise InputError(
                    path="minimise", expected="absolute values with weights of at least 0", got=f"{weight:g}"
                )
            weights[place] += weight * abs(factor)
        inequalities = [term for term, is_equality in self.finite_terms if not is_equality]
        equalities = [term for term, is_equality in self.finite_terms if is_equality]
        equalities += self.definitions
        lower, upper = self.bounds
        program = SemiInfiniteProgram(
            n=n,
            q=q,
            P=require_convex("minimise", _build_quadratic(polynomial.products, n), n) if polynomial.products else None,
            weights=weights,
            lower=lower,
            upper=upper,
            G=_build_matrix(inequalities, n),
            h=_list_right_sides(inequalities),
            A=_build_matrix(equalities, n),
            b=_list_right_sides(equalities),
            constant=float(polynomial.constant),
            families=[ConstraintFamily.of_rows(name, rows) for name, rows in self.parsed],
        )
        vars(program)["origin"] = self
        return program


def _is_entry(term: AffineFunction) -> bool:
    """Return whether an affine function is a multiple of one entry of the decision."""
    return term.positions.size == 1 and term.constant == 0.0


def _locate(term: AffineFunction, places: Mapping[int, int]) -> Multiple:
    """Return the entry of the decision whose multiple an affine function is, and the factor."""
    return (int(term.positions[0]), float(term.coefficients[0])) if _is_entry(term) else (places[id(term)], 1.0)


def _subtract_entry(term: AffineFunction, place: int) -> AffineFunction:
    """Return an affine function minus an entry of the decision."""
    return AffineFunction(term.constant, np.append(term.positions, place), np.append(term.coefficients, -1.0))


def _list_distinct(terms: Sequence[AffineFunction]) -> tuple[AffineFunction, ...]:
    """Return the functions that are more than one entry, each once."""
    return tuple({id(term): term for term in terms if not _is_entry(term)}.values())


def _number_terms(terms: Sequence[AffineFunction], first: int) -> dict[int, int]:
    """Return the entry of the decision that stands for each function, by its ``id``."""
    return {id(term): first + k for k, term in enumerate(terms)}


def _build_quadratic(products: Mapping[tuple[int, int], Fraction], n: int) -> object:
    """Return the matrix of products of entries, symmetric, with a factor of 2."""
    from scipy.sparse import csc_array

    keys = np.array(list(products), dtype=int).reshape(-1, 2)
    values = np.array([float(value) for value in products.values()])
    rows, columns = np.concatenate([keys, keys[:, ::-1]]).T
    return csc_array((np.tile(values, 2), (rows, columns)), shape=(n, n))


def _build_matrix(terms: Sequence[AffineFunction], n: int) -> Array | None:
    """Return the matrix of rows ``term(x) <= 0``; ``None`` where there are none."""
    if not terms:
        return None
    matrix = np.zeros((len(terms), n))
    for i, term in enumerate(terms):
        matrix[i, term.positions] = term.coefficients
    return matrix


def _list_right_sides(terms: Sequence[AffineFunction]) -> Array | None:
    """Return the right-hand sides of rows ``term(x) <= 0``; ``None`` where there are none."""
    return np.array([-term.constant for term in terms]) if terms else None
