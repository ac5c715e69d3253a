"""Semi-infinite programs: one decision, finitely many terms in the cost, families of uncountably many constraints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import product
from typing import ClassVar, Literal, TypeAlias, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import brief
from sparserob_core.errors import InputError
from sparserob_core.shapes import Float, sealed, shaped
from sparserob_core.sip.convex_set import Array, Box, as_bound
from sparserob_core.sip.convexity import require_convex, sparse_matrix
from sparserob_core.sip.finite import Blocks, FiniteProgram, Spread, UncertainRows

Formulation: TypeAlias = Literal["reduced", "nominal", "literal", "sampled"]
"""What an index of a family says. ``reduced``: everything but the uncertainty that is maximised in closed form;
``nominal``: nothing of the uncertainty; ``literal``: all of it; ``sampled``: the number of a sample."""


TOLERANCE = 1e-9  # of a row's own unit: a violation of at most this counts as none (docs/decisions/0016)
OUTSIDE = 1e-9  # of its sides and its distance from 0: how far outside of an index set rounding may put an index
NARROW = 1e-12  # of its side: a gap between two cells that is rounding of their corners
PARTS = 4_000_000  # of a grid between the corners of all cells: 32 MB
EQUALITY = 1e-12  # of the numbers that are added up: an equality that is missed by at most this counts as met


@dataclass(frozen=True, eq=False)
class Separation:
    """The most violated constraints of one family at a decision, worst first.

    ``indices (k, d)``, ``rows (k,)`` the row of the family at that index, ``violations (k,)`` (``rows x - rhs``,
    negative when satisfied), and ``bound``: a proven upper bound on the family's violation over its whole index set,
    ``inf`` if none is known. ``formulation`` is that of the indices.
    """

    indices: Array
    rows: Array
    violations: Array
    bound: float = np.inf
    formulation: Formulation = "reduced"


@dataclass(frozen=True, eq=False)
class Enclosure:
    """Proven upper bounds ``(k,)`` of the violation on index cells, and the coordinate ``(k,)`` whose halving would
    help most. ``bend (k,)``, where it is known: what of the bounds falls with the square of a cell's width, of a family
    whose index is one number; its separation then says where cells have to be short, unless rows have deviations."""

    bounds: Array
    split: Array
    bend: Array | None = None


@dataclass(frozen=True, eq=False)
class WorstConstraint:
    """The worst constraint found: by how much it is violated (negative: satisfied with that margin), and which one it
    is: row ``row`` of family ``constraint`` at ``index (d,)``, an index of that ``formulation``."""

    violation: float
    constraint: str
    index: Array
    row: int = 0
    formulation: Formulation = "reduced"

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Explanation(ABC):
    """One constraint for people: what it says (``text``), and the sentences that are asked for where nothing is
    feasible.

    Programs know no more of a constraint than its row; whoever states a family knows what it is about, and tells it in
    a subclass. ``decides`` is what the field calls the decision.
    """

    text: str
    decides: ClassVar[str] = "decision"

    @abstractmethod
    def witness(self, worst: WorstConstraint) -> WorstConstraint:
        """The worst constraint, which is this one, with what the field knows of it."""

    def short(self) -> str:
        """What it asks for, without remarks."""
        return self.text

    def of_sample(self, number: int) -> Explanation:
        """The same constraint for one sample of what is uncertain, whatever it says of another case."""
        return Unexplained(f"{self.text} (sample {number})")

    @property
    def alike(self) -> str:
        """What it asks for, where other rows of its family ask for the same in another case; empty elsewhere."""
        return ""

    def beyond(self, amount: float) -> str:
        """No decision enters the constraint, and it is violated by ``amount``."""
        return self.out_of_reach(amount, 0.0)

    def apart(self, other: Explanation, share: float, amount: float) -> str:
        """The decision enters this constraint and ``share`` times the ``other`` with opposite signs, and their sum is
        violated by ``amount``."""
        return (
            f"{self.text} and {other.text} cannot hold: their sum is violated by at least {amount:.4g}, "
            f"whatever the {self.decides}"
        )

    def out_of_reach(self, amount: float, needed: float) -> str:
        """The constraint alone is violated by ``amount`` at least; it asks the decision to lower the left side by
        ``needed``."""
        return f"{self.text} cannot hold: it is violated by at least {amount:.4g}, whatever the {self.decides}"


@final
@dataclass(frozen=True, eq=False)
class Unexplained(Explanation):
    """A constraint of a family that does not explain itself."""

    def witness(self, worst: WorstConstraint) -> WorstConstraint:
        return worst


def told_apart(one: float, two: float) -> tuple[str, str]:
    """Two numbers with four digits, or as many as it takes to tell them apart."""
    texts = [(f"{one:.{digits}g}", f"{two:.{digits}g}") for digits in range(4, 17)]
    return next((pair for pair in texts if pair[0] != pair[1]), texts[-1])


@dataclass(frozen=True, eq=False, kw_only=True)
class ConstraintFamily:
    """``rows(xi) x <= rhs(xi)`` for every index ``xi`` in a compact box.

    ``rows`` maps indices ``(k, d)`` to ``(G (k, r, n), h (k, r))``. A violation of at most `TOLERANCE` counts as none,
    in the numbers of the rows as they are stated: rows of 1e-10 are to be divided by that. The rest is optional, and
    used when offered:

    ``scale(x)``      of what a proof may excuse `TOLERANCE` at a decision, in the numbers of the rows (`allowed`): 1
        unless a row is smaller than that, or is an equality in a finer unit;

    ``chosen(indices (k, d), rows (k,))``  one row of each index, ``(G (k, n), h (k,))``, where all would take longer;
    ``worst(x)``      exact separation (a `Separation`);
    ``enclosure(x, lower (k, d), upper (k, d))``  an `Enclosure` of the violation on cells, for proofs;
    ``cells``         ``(lower, upper)``, a partition of the index set on whose cells the enclosure converges;
    ``gradient(x, indices (k, d), rows (k,))``  derivative ``(k, d)`` of ``row x - rhs`` in the index;
    ``linear (d,)``   whether the right-hand sides are linear, and the rows constant, in a coordinate of the index while
        the coordinates that are not linear stay (over the set that these stand for, where that is no box);
    ``steepest(x, indices (k, d), rows (k,))``  the indices with their linear coordinates where the row is violated
        most, one row per index; a row of -1 stands for the one that is then violated most (a `Separation`, in the order
        of ``indices``);
    ``nominal``       the same constraints without the uncertainty;
    ``sample(count, rng)``  the same constraints for ``count`` sampled uncertainties only;
    ``literal``       the same constraints with an inner maximisation left to the index, and ``reduced``, from such a
        family, the way back;
    ``formulation``   what its indices say (`Formulation`); a cut says it too, so that its index can be understood;
    ``source``        what the family was made of: never looked at here, handed back to whoever made it;
    ``hindrance(lower (d,), upper (d,))``  what keeps the enclosure of a cell wide, and what would help, in words;
    ``row_units (r,)``, ``index_units (d,)``  what a violation of 1 and each coordinate of an index are in the user's
        units, for a family in units of its own (`OwnUnits`);
    ``measured (r,)``, ``along``  what these units are called, for every row and for the first coordinate of an index,
        where that is known;
    ``explain(index (d,), row)``  one constraint for people (an `Explanation`);
    ``excess(x, indices (k, d))``  the violations ``(k, r)`` at indices, where no rows need be built for them;
    ``uncertain(index (d,))``  for rows that must hold for every deviation in the program's `Spread`: these rows. Such a
        family is not linear in the decision: ``rows`` refuses, ``excess`` is offered, and ``start (k, d)`` are the
        indices that a method begins with; ``defines``: whether it only bounds variables that the program's ``settle``
        puts at what bounds them, so that it is never the worst one;
        ``scaled(factor)``: the same constraints where all deviations are so many times as large.
    """

    name: str
    index_set: Box
    rows: Callable[[Array], tuple[Array, Array]]
    scale: Callable[[Array], float] | None = None
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
    uncertain: Callable[[Array], UncertainRows] | None = None
    excess: Callable[[Array, Array], Array] | None = None
    start: Array | None = None
    defines: bool = False
    scaled: Callable[[float], ConstraintFamily] | None = None
    formulation: Formulation = "reduced"
    source: object = None

    def __post_init__(self) -> None:
        sealed(self)

    @property
    def provable(self) -> bool:
        """Whether anything could prove that a decision meets all of its constraints; of rows alone nothing can."""
        proven = self.reduced or self
        return proven.enclosure is not None or proven.worst is not None

    def formulated(self, formulation: Formulation) -> ConstraintFamily | None:
        """The same constraints with the indices of another formulation; ``None`` where the family does not have it.

        A family on which the uncertainty does not act is the same in all of them.
        """
        if formulation == self.formulation:
            return self
        forms = {"reduced": self.reduced, "nominal": self.nominal, "literal": self.literal}
        return forms.get(formulation)

    @shaped
    def separated(self, x: Float[Array, " n"]) -> Separation:
        """What `worst` finds at ``x``; raises `InputError` where that is no separation of this family: violations that
        are no numbers, indices outside of the index set, a bound below a violation."""
        assert self.worst is not None
        found, box = self.worst(x), self.index_set
        indices, violations = np.asarray(found.indices, dtype=float), np.asarray(found.violations, dtype=float)
        if indices.ndim != 2 or not len(indices) == np.size(found.rows) == violations.size:
            raise self._wrong("worst", "indices (k, d), rows (k,) and violations (k,)", f"shape {indices.shape}")
        if np.asarray(found.rows).dtype.kind not in "iu" or (np.asarray(found.rows) < 0).any():
            raise self._wrong("worst", "numbers of rows, from 0", f"{np.asarray(found.rows).tolist()}")
        if np.isnan(violations).any():
            raise self._wrong("worst", "violations that are numbers", f"{violations.tolist()}")
        if violations.size and found.bound < violations.max() - TOLERANCE:
            raise self._wrong("worst", f"a bound of at least {violations.max():.6g}, its own", f"{found.bound:.6g}")
        if indices.shape[1] != box.dimension:
            raise self._wrong("worst", f"indices (k, {box.dimension})", f"shape {indices.shape}")
        room = OUTSIDE * (box.upper - box.lower + np.abs(box.lower) + np.abs(box.upper))
        outside = ~((indices >= box.lower - room) & (indices <= box.upper + room)).all(axis=1)
        if outside.any():
            raise self._wrong("worst", "indices of the index set", f"{indices[outside][0].tolist()}")
        return found

    @shaped
    def enclosed(self, x: Float[Array, " n"], lower: Float[Array, "k d"], upper: Float[Array, "k d"]) -> Enclosure:
        """What `enclosure` says of cells; raises `InputError` where that is not one bound for each. One that is no
        number says nothing, and is infinite."""
        assert self.enclosure is not None
        found = self.enclosure(x, lower, upper)
        if np.shape(found.bounds) != (len(lower),) or np.shape(found.split) != (len(lower),):
            got = f"shapes {np.shape(found.bounds)} and {np.shape(found.split)}"
            raise self._wrong("enclosure", f"bounds and coordinates ({len(lower)},)", got)
        return replace(found, bounds=np.where(np.isnan(found.bounds), np.inf, found.bounds))

    @cached_property
    def partition(self) -> tuple[Array, Array]:
        """The `cells`, or the whole index set; raises `InputError` where an index is in none of them."""
        box = self.index_set
        if self.cells is None:
            return box.lower[None], box.upper[None]
        lower, upper = self.cells
        missing = uncovered(lower, upper, box)
        if missing is not None:
            raise self._wrong("cells", "cells that cover the index set", f"none around {missing.tolist()}")
        return lower, upper

    def _wrong(self, what: str, expected: str, got: str) -> InputError:
        return InputError(f"family {self.name!r}: {what}: expected {expected}, got {got}")

    @shaped
    def explanation(self, index: Float[Array, " d"], row: int) -> Explanation:
        """One constraint for people, by its number and index where the family does not explain itself."""
        if self.explain is not None:
            return self.explain(index, row)
        return Unexplained(f"row {row} of {self.name} at {np.array2string(index, precision=6)}")

    def row_unit(self, row: int) -> float:
        """What a violation of 1 of a row is in the user's units."""
        return 1.0 if self.row_units is None else float(self.row_units[row])

    def allowed(self, x: Array) -> float:
        """Return the violation that a proof at the decision ``x (n,)`` may count as none."""
        return TOLERANCE if self.scale is None else TOLERANCE * self.scale(x)

    def measure(self, row: int | None = None) -> str:
        """What a violation of a row is measured in, or, without one, that of any of them, such as ``m or m/s``; empty
        where that is not known."""
        if row is not None:
            return self.measured[row] if row < len(self.measured) else ""
        return " or ".join(dict.fromkeys(self.measured)) if all(self.measured) else ""

    @shaped
    def violations(self, x: Float[Array, " n"], indices: Float[Array, "k d"]) -> Float[Array, "k r"]:
        """``rows(xi) x - rhs(xi)`` at indices ``(k, d)``, as ``(k, r)``; positive where violated."""
        if self.excess is not None:
            return self.excess(x, indices)
        G, h = self.rows_at(indices, x.size)
        return np.asarray(G @ x - h, dtype=float)

    def rows_at(self, indices: Array, n: int) -> tuple[Array, Array]:
        """The rows ``(k, r, n)`` and right-hand sides ``(k, r)`` at indices ``(k, d)``; raises `InputError` where what
        `rows` gives is of another shape."""
        G, h = self.rows(indices)
        if np.ndim(G) != 3 or np.shape(G)[::2] != (len(indices), n) or np.shape(G)[:2] != np.shape(h):
            raise InputError(
                f"family {self.name!r}: expected rows of shape ({len(indices)}, r, {n}) and right-hand sides"
                f" ({len(indices)}, r), got {np.shape(G)} and {np.shape(h)}"
            )
        return G, h


def uncovered(lower: Array, upper: Array, box: Box) -> Array | None:
    """A point ``(d,)`` of the box that is in none of the cells between corners ``(k, d)``; ``None`` where there is
    none, or where all cells are on faces of the box, as those of a cube of directions, whose inner points are multiples
    of others.

    Between the corners of all cells the box is a grid, of which every part is in a cell or outside of it; a grid of
    more than `PARTS` parts is not made, and then the volumes of the cells are compared with that of the box.
    """
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    if lower.ndim != 2 or lower.shape != upper.shape or lower.shape[1:] != box.lower.shape or not lower.size:
        return box.lower
    moves = np.flatnonzero(box.upper > box.lower)
    low, sides = box.lower[moves], (box.upper - box.lower)[moves]
    begins, ends = ((corners[:, moves] - low) / sides for corners in (lower, upper))
    filled = np.prod(np.minimum(ends, 1.0) - np.maximum(begins, 0.0), axis=1)
    if not np.isfinite(filled).all():
        return box.lower
    if ((begins == ends) & ((begins == 0.0) | (begins == 1.0))).any(axis=1).all() and moves.size:
        return None
    edges = [_apart(np.concatenate([begins[:, i], ends[:, i], [0.0, 1.0]])) for i in range(moves.size)]
    middle = (box.lower + box.upper) / 2
    if np.prod([float(one.size) for one in edges]) > PARTS:
        return middle if filled.sum() < 1.0 - OUTSIDE else None
    places = [
        [np.searchsorted(edges[i], corners[:, i] - NARROW) for i in range(moves.size)] for corners in (begins, ends)
    ]
    count = np.zeros([one.size for one in edges], dtype=int)
    for corner in product((0, 1), repeat=moves.size):
        at = tuple(places[side][i] for i, side in enumerate(corner))
        np.add.at(count, at, -1 if sum(corner) % 2 else 1)
    for axis in range(moves.size):
        count = np.cumsum(count, axis=axis)
    empty = np.argwhere(count[(slice(None, -1),) * moves.size] <= 0)
    if not empty.size:
        return None
    middle[moves] = low + sides * [(edges[i][at] + edges[i][at + 1]) / 2 for i, at in enumerate(empty[0])]
    return middle


def _apart(corners: Array) -> Array:
    """Shares of a side in order, those outside of it moved to its ends, of which none are nearer than `NARROW`."""
    edges = np.unique(np.clip(corners, 0.0, 1.0))
    kept: Array = edges[np.append(True, np.diff(edges) > NARROW)]
    return kept


@dataclass(frozen=True, eq=False)
class EqualityErrors:
    """Upper bounds ``missed (e,)`` of the errors of equalities at a decision, with all rounding counted, and the errors
    ``allowed (e,)`` that a claim may excuse. ``advice``: the reason for large bounds, and what would help."""

    missed: Array
    allowed: Array
    advice: str = ""

    @property
    def kept(self) -> bool:
        """Whether every equality holds up to what is allowed."""
        return bool((self.missed <= self.allowed).all())


@dataclass(frozen=True, eq=False)
class SemiInfiniteProgram:
    """minimise ``sum_k weights_k |(S x)_k| + 1/2 x'P x + q'x + constant`` subject to ``lower <= S x <= upper``,
    ``G x <= h``, ``A x = b`` and every constraint family at every index. A row with an ``h`` of infinity asks for
    nothing.

    ``n`` is the number of decision variables; ``P (n, n)`` is symmetric and positive semidefinite but for rounding
    (`require_convex`), or refused; ``S (k, n)`` is the identity when ``None``; ``lower``, ``upper`` and
    ``weights`` are numbers or ``(k,)``. ``lengths``: how much each entry of ``S x`` counts in a weighted regulariser
    (piece lengths), ``(k,)``. ``activity``: what it counts, always in the user's units, that an entry of ``S x`` is not
    0, of the first entries or all, where that means something (`working.counting`).
    ``twin`` makes the same program in its own units (`own_units`); ``cost_unit`` is what a cost of 1 is in the user's
    units, for a program in its own, and ``image_units (k,)`` what 1 of each entry of ``S x`` is.
    ``blocks (k,)``: images with the same number of at least 0 count together, with their weight times their Euclidean
    norm; -1 is one that counts alone. ``largest``: the largest possible cost, where it is known
    (`largest_cost`).
    ``spread``: the deviations for all of which the ``uncertain`` rows of its families hold;
    ``guide``: a program that is easier, whose decision begins with so many of the same entries: where a method may look
    for this one's optimum;
    ``among``: a program with the same constraints and another cost, whose decision begins with so many of the same
    entries: which of the decisions that cost as little is to be returned;
    ``settle(x)``: a decision that meets the same constraints and costs no more, such as one whose bounds are no looser
    than they must be;
    ``errors(x)``: proven bounds of the errors of ``A x = b``, where the entries of ``A`` and ``b`` are rounded
    (`EqualityErrors`).
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
        G, h = self._rows("G", self.G, "h", self.h)
        A, b = self._rows("A", self.A, "b", self.b)
        weights = _vector("weights", 0.0 if self.weights is None else self.weights, images)
        if (weights < 0).any():
            raise InputError(f"weights: expected numbers that are not negative, got {weights.min()}")
        lower, upper = as_bound("lower", self.lower, images), as_bound("upper", self.upper, images)
        if (lower > upper).any():
            raise InputError("lower: is above upper, so nothing is feasible")
        q = _vector("q", 0.0 if self.q is None else self.q, self.n)
        names = [family.name for family in self.families]
        if len(set(names)) < len(names):
            raise InputError(f"families: names must differ, got {names}")
        object.__setattr__(self, "families", tuple(self.families))
        constant = _vector("constant", self.constant, 1)
        finite = FiniteProgram(
            q=q, weights=weights, lower=lower, upper=upper, G=G, h=h, A=A, b=b, P=P, S=S, constant=float(constant[0])
        )
        finite = replace(finite, blocks=self._blocks(weights))
        sealed(finite)
        for name, kept in (("S", finite.S), ("P", finite.P), ("finite", finite)):
            object.__setattr__(self, name, kept)
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, list):
                object.__setattr__(self, each.name, np.array(value))
        sealed(self)

    def _blocks(self, weights: Array) -> Blocks | None:
        if self.blocks is None:
            return None
        given = np.asarray(self.blocks)
        if given.shape != weights.shape or given.dtype.kind not in "iu":
            raise InputError(f"blocks: expected {weights.size} whole numbers, got shape {given.shape}")
        _, number = np.unique(np.where(given < 0, -1, given), return_inverse=True)
        blocks = Blocks(number.reshape(-1) - int((given < 0).any()))
        if (weights[blocks.entries] != weights[blocks.first][blocks.of]).any():
            raise InputError("weights: expected one weight for all images of a block")
        return blocks if blocks.entries.size else None

    def _rows(self, left: str, matrix: object, right: str, bounds: object) -> tuple[Array, Array]:
        if (matrix is None) != (bounds is None):
            raise InputError(f"{left}, {right}: give both or neither")
        if matrix is None:
            return np.zeros((0, self.n)), np.zeros(0)
        rows = np.atleast_2d(np.asarray(matrix, dtype=float))
        if rows.ndim != 2 or rows.shape[1] != self.n or not np.isfinite(rows).all():
            raise InputError(f"{left}: expected finite numbers of shape (rows, {self.n}), got shape {rows.shape}")
        return rows, (_vector if left == "A" else _upper)(right, bounds, rows.shape[0])

    @property
    def own_units(self) -> OwnUnits | None:
        """The same program in its own units; ``None`` for one that has none, or that was changed since."""
        own = None if self.twin is None else self.twin()
        if own is None or len(own.of) != len(self._parts):
            return None
        return own if all(mine is theirs for mine, theirs in zip(self._parts, own.of, strict=True)) else None

    @property
    def _parts(self) -> tuple[object, ...]:
        """Everything that the program is but its twin. Its arrays cannot be written to, its families and sets are
        frozen records of such, so that the same objects are the same program."""
        own = [getattr(self, each.name) for each in fields(self) if each.name not in ("twin", "finite", "families")]
        return (*own, *self.families)

    def mirrored(self, twin: Callable[[SemiInfiniteProgram], OwnUnits]) -> SemiInfiniteProgram:
        """This program with a twin in its own units, which is made when it is first asked for."""
        made: list[OwnUnits] = []

        def once() -> OwnUnits:
            if not made:
                made.append(replace(twin(self), of=self._parts))
            return made[0]

        return replace(self, twin=once)

    @property
    def image_size(self) -> int:
        """Entries of ``S x`` that the regulariser is about: those with a length, or all of them."""
        return self.finite.weights.size if self.lengths is None else int(np.size(self.lengths))

    def family(self, name: str) -> ConstraintFamily:
        """The family of that name."""
        return next(family for family in self.families if family.name == name)

    def formulated(self, name: str, formulation: Formulation) -> ConstraintFamily | None:
        """The family of that name whose indices are those of a formulation (`ConstraintFamily.formulated`)."""
        return self.family(name).formulated(formulation)

    @cached_property
    def origin(self) -> object:
        """What the program was made of, where whoever made it has said so; ``None`` once anything of it is replaced."""
        return None

    @cached_property
    def largest_cost(self) -> float:
        """The largest possible cost: that of the bounds. Where an entry that costs something has no bound, a million
        of the largest coefficient, but at most a million. Nothing that is claimed depends on it."""
        if self.largest is not None:
            return self.largest
        program = self.finite
        reach = np.maximum(np.abs(program.lower), np.abs(program.upper))
        size = np.full(self.n, np.inf) if program.S is not None else reach
        curvature = np.zeros(self.n) if program.P is None else abs(program.P).sum(axis=0)
        with np.errstate(invalid="ignore"):
            terms = [
                np.where(cost > 0.0, cost * far, 0.0)
                for cost, far in ((program.weights, reach), (np.abs(program.q), size), (curvature / 2, size**2))
            ]
        largest = float(sum(term.sum() for term in terms)) + abs(program.constant)
        if np.isfinite(largest):
            return largest
        coefficients = (program.weights, np.abs(program.q), curvature)
        return 1e6 * min(1.0, max(float(cost.max(initial=0.0)) for cost in coefficients))

    @shaped
    def cost(self, x: Float[Array, " n"]) -> float:
        """``J(x)``, recomputed from the data."""
        return self.finite.objective(x)

    @shaped
    def added(self, x: Float[Array, " n"]) -> float:
        """What is added up to ``J(x)``: its absolute values, linear, quadratic and constant terms, each by its absolute
        value. More than ``|J(x)|`` where they cancel, as where a state is to follow a reference."""
        return self.finite.added(x)


@dataclass(frozen=True, eq=False)
class OwnUnits:
    """``program``: a program in its own units, every factor a power of two; ``decision (n,)``, ``image (k,)``,
    ``equalities (e,)``, ``cost``: what one of each is in the user's. Its families know their own
    (`ConstraintFamily.row_units`). ``of``: all that the program is that it stands for. ``wider``: where these
    units are for decisions that are small beside their bounds, makes the program in units for all decisions."""

    program: SemiInfiniteProgram
    decision: Array
    image: Array
    equalities: Array
    cost: float
    wider: Callable[[], OwnUnits] | None = None
    of: tuple[object, ...] = field(default=(), repr=False)


def _vector(name: str, value: object, size: int) -> Array:
    vector = as_bound(name, value, size)
    if not np.isfinite(vector).all():
        raise InputError(f"{name}: expected finite numbers, got {vector.tolist()}")
    return vector


def _upper(name: str, value: object, size: int) -> Array:
    """Right-hand sides of inequalities; infinity asks for nothing."""
    vector = as_bound(name, value, size)
    if (vector == -np.inf).any():
        raise InputError(f"{name}: expected numbers, or inf for a row that asks for nothing, got {vector.tolist()}")
    return vector
