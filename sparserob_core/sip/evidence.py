"""Evidence for a claim: imposed constraints with multipliers, proofs over the continuum, and reasons for
infeasibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.quantities import RECORDS, quantity
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import TOLERANCE, Formulation


@dataclass(frozen=True, eq=False)
class Cut:
    """An imposed constraint: row ``row`` of the family ``family`` at ``index``.

    Parameters
    ----------
    family : str
        Name of the family.
    index : ndarray, shape (d,)
        Index of the constraint.
    row : int
        Row of the family at that index.
    multiplier : float, default 0
        Multiplier in the last relaxed program, at least 0.
    formulation : Formulation, default "reduced"
        Formulation of the family to which the index belongs.
    """

    family: str
    index: Array = field(metadata=quantity("index"))
    row: int
    multiplier: float = field(default=0.0, metadata=quantity("price"))
    formulation: Formulation = "reduced"

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Dual:
    """Multipliers that prove a lower bound of the semi-infinite program's value, or its infeasibility.

    Parameters
    ----------
    bound : float
        The lower bound.
    cuts : sequence of Cut
        Imposed constraints with their multipliers.
    mu : ndarray, shape (e,)
        Multipliers of the equalities.
    z : ndarray, shape (k,), optional
        Multipliers of the image ``S x``; ``None`` where ``S`` is the identity.
    fixed : ndarray, shape (r,)
        Multipliers of the program's fixed rows ``G x <= h``.
    at : ndarray, shape (n,), optional
        Decision at which quadratic terms and norms of the cost are replaced by their tangents, where there are any.
    """

    bound: float = field(metadata=quantity("value"))
    cuts: Sequence[Cut] = field(metadata=RECORDS)
    mu: Array = field(metadata=quantity("mu"))
    z: Array | None = field(default=None, metadata=quantity("z"))
    fixed: Array = field(default_factory=lambda: np.zeros(0), metadata=quantity("cost"))
    at: Array | None = field(default=None, metadata=quantity("decision"))

    __repr__ = brief

    def of_fixed_rows(self, count: int) -> Array:
        """Return the multipliers ``(count,)`` of the fixed rows; 0 where none are given."""
        return self.fixed if self.fixed.size else np.zeros(count)


NO_BOUND = Dual(-np.inf, (), np.zeros(0))


@final
@dataclass(frozen=True, eq=False)
class InfeasibleSubsystem:
    """Reasons for infeasibility, one sentence each.

    Either ``reasons`` holds sentences each of which suffices alone, or ``members`` are constraints that cannot hold
    together: an irreducible infeasible subsystem (Chinneck and Dravnieks 1991) where ``irreducible`` is true.

    Parameters
    ----------
    reasons : tuple of str
        Sentences each of which suffices alone.
    members : tuple of str
        Constraints of the subsystem.
    amount : float, default inf
        At least one member is violated by at least this many times the norm of its row. Infinite where the decision
        enters no member.
    others : int, default 0
        Number of further reasons or members that are not listed.
    equalities : bool, default False
        Whether the program has equalities, which belong to every subsystem.
    demand : str
        Requirement that a weighted sum of the members makes, in words.
    decides : str, default "decision"
        Name of the decision in the field of the problem.
    irreducible : bool, default True
        Whether a decision was found for the members without any one of them.
    """

    reasons: tuple[str, ...] = ()
    members: tuple[str, ...] = ()
    amount: float = np.inf
    others: int = 0
    equalities: bool = False
    demand: str = ""
    decides: str = "decision"
    irreducible: bool = True

    __repr__ = brief

    def sentence(self, amounts: bool = True) -> str:
        """Return all reasons as one sentence; ``amounts=False`` leaves numbers out where the units of the rows have no
        meaning."""
        if self.reasons:
            count = len(self.reasons) + self.others
            head = f"{count} separate reasons: " if count > 1 else ""
            return head + "; ".join([*self.reasons, *([f"and {self.others} more"] if self.others else [])])
        has_amount = amounts and np.isfinite(self.amount)
        whatever = f"whatever the {self.decides}"
        if not self.members:
            kind = "equalities" if self.equalities else "fixed constraints"
            by = f": one is missed by at least {self.amount:.4g} times its norm" if has_amount else ""
            return f"the {kind} cannot be met within the bounds, {whatever}{by}"
        if len(self.members) + self.others > 1:
            head = "these cannot hold together" + (", though all but any one of them can" if self.irreducible else "")
        else:
            head = "nothing meets this " + ("and the equalities" if self.equalities else "within the bounds")
        by = f" (one is violated by at least {self.amount:.4g} times its norm, {whatever})" if has_amount else ""
        named = "; ".join([*self.members, *([f"and {self.others} more"] if self.others else [])])
        return f"{head}{by}: {named}" + (f"; {self.demand}" if self.demand else "")


@dataclass(frozen=True, eq=False)
class Proof:
    """Verdict on one constraint family at one decision.

    ``proven``: no index violates the family by more than ``bound``, which is at most ``allowed``. ``refuted``: the
    constraint ``row`` at ``index`` is violated by ``violation``. ``undecided``: see ``reason``.

    Parameters
    ----------
    family : str
        Name of the family.
    verdict : {"proven", "refuted", "undecided"}
        The verdict.
    bound : float
        Upper bound of the violation, in the units of the program that was solved.
    violation : float, default -inf
        Violation of the witness.
    index : ndarray, shape (d,), optional
        Index of the witness.
    row : int, default 0
        Row of the witness.
    cells : int, default 0
        Number of cells that were bounded.
    reason : str
        Reason why nothing is decided.
    leaves : tuple of ndarray, shape (k, d) each, optional
        Lower and upper corners of the closed cells that are the proof, in lexicographic order. The cells subdivide
        those of the family. ``None`` unless proven by branch and bound.
    formulation : Formulation, default "reduced"
        Formulation to which the index belongs.
    unit : float, default 1
        Value in the user's units of a violation of 1 of that row.
    measured : str
        Name of that unit, where it is known.
    units : ndarray, shape (r,), optional
        Value of a violation of 1 for all rows.
    share : float, optional
        The bound in each row's own unit, kept after the proof is reported in the user's units.
    allowed : float, default TOLERANCE
        Violation that counts as none, in the units of ``bound``.
    """

    family: str
    verdict: Literal["proven", "refuted", "undecided"]
    bound: float = field(metadata=quantity("bound"))
    violation: float = field(default=-np.inf, metadata=quantity("row"))
    index: Array | None = field(default=None, metadata=quantity("index"))
    row: int = 0
    cells: int = 0
    reason: str = ""
    leaves: tuple[Array, Array] | None = field(default=None, metadata=quantity("index"))
    formulation: Formulation = "reduced"
    unit: float = 1.0
    measured: str = ""
    units: Array | None = None
    share: float | None = None
    allowed: float = TOLERANCE

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Leaf:
    """Result for one part of a `Tree`.

    Parameters
    ----------
    dual : Dual
        Multipliers that bound the count in this part or, where ``feasible`` is false, prove that the part holds no
        feasible decision.
    feasible : bool, default True
        False where the part is proven infeasible.
    """

    dual: Dual = field(metadata=RECORDS)
    feasible: bool = True


@dataclass(frozen=True, eq=False)
class Branch:
    """Division of one part of a `Tree` into two, at one entry of ``S x``.

    The entry is 0 in the first part and counts in the second. Where ``at`` is given, the entry is at most its first
    letter in the first part, and at least its second letter in the second part.

    Parameters
    ----------
    image : int
        Number of the entry.
    first, second : int
        Numbers of the nodes that are the two parts.
    at : tuple of (float, float), optional
        Two neighbouring letters of an alphabet.
    """

    image: int
    first: int
    second: int
    at: tuple[float, float] | None = None


Tree: TypeAlias = "Sequence[Leaf | Branch]"
"""Nodes of a branch and bound; the first node is the whole set of decisions."""


@dataclass(frozen=True, eq=False)
class Sparsest:
    """Record of a method that minimises a count, in addition to the count itself; numbers are in the user's units.

    Parameters
    ----------
    norm : float
        Cost J of its decision.
    plain : float, optional
        Cost of an optimum of J, where one is known.
    plain_count : float, optional
        Count of that optimum.
    tree : Tree
        Branch and bound that proves the lower bound.
    letters : sequence of float, optional
        Alphabet to which the entries of ``S x`` are restricted, where there is one.
    """

    norm: float = field(metadata=quantity("cost"))
    plain: float | None = field(metadata=quantity("cost"))
    plain_count: float | None
    tree: Tree = field(metadata=RECORDS)
    letters: Sequence[float] | None = None

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Activity:
    """Proven bounds of the least count of a program (`SemiInfiniteProgram.activity`) over all feasible decisions.

    Counts are shares of the largest count.

    Parameters
    ----------
    lower : float
        Lower bound of the least count.
    upper : float, optional
        Count of the decision that is returned, or of ``decision``; ``None`` where neither is proven.
    dual : Dual, optional
        Multipliers of a program of its own that prove ``lower``; ``None``: the multipliers of the cost prove it.
    decision : ndarray, shape (n,), optional
        Another decision whose count is ``upper``.
    proofs : sequence of Proof
        Proofs of that decision.
    norm : bool, default True
        Whether the cost of the program is a sum of absolute values.
    """

    lower: float
    upper: float | None
    dual: Dual | None = None
    decision: Array | None = None
    proofs: Sequence[Proof] = ()
    norm: bool = True
