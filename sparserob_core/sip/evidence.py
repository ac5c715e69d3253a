"""What supports a claim: imposed constraints with their multipliers, proofs over the continuum, and why nothing is
feasible."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import TOLERANCE, Formulation


@dataclass(frozen=True, eq=False)
class Cut:
    """One imposed constraint: row ``row`` of family ``family`` at ``index (d,)``, with its multiplier in the last
    relaxed program. ``formulation`` says which form of the family the index belongs to."""

    family: str
    index: Array
    row: int
    multiplier: float = 0.0
    formulation: Formulation = "reduced"

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Dual:
    """Multipliers that prove a lower ``bound`` of the semi-infinite program's value, or of its infeasibility: those of
    the imposed constraints (in ``cuts``), ``mu (e,)`` of the equalities, and ``z (k,)`` of the image ``S x`` unless
    ``S`` is the identity; ``fixed (r,)`` are those of the program's fixed rows ``G x <= h``. ``at (n,)``: the decision
    at which quadratic terms, and norms, of the cost are replaced by their tangents, where there are any.
    """

    bound: float
    cuts: Sequence[Cut]
    mu: Array
    z: Array | None = None
    fixed: Array = field(default_factory=lambda: np.zeros(0))
    at: Array | None = None

    __repr__ = brief


NO_BOUND = Dual(-np.inf, (), np.zeros(0))


@final
@dataclass(frozen=True, eq=False)
class InfeasibleSubsystem:
    """Why nothing is feasible, one sentence each: ``reasons`` that suffice alone, or else the ``members`` of an
    irreducible infeasible subsystem (Chinneck and Dravnieks 1991), which cannot hold together.

    ``amount``: of the members one is violated by at least that many times the norm of its row; infinite where the
    decision enters none of them. ``others``: how many further reasons or members there are. ``equalities``: whether the
    program has some, which belong to every subsystem. ``irreducible``: whether no member can be spared. ``demand``:
    what a weighted sum of the members asks for.
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
        """All of it for people; without ``amounts`` where the units of the rows mean nothing to them."""
        if self.reasons:
            count = len(self.reasons) + self.others
            head = f"{count} separate reasons: " if count > 1 else ""
            return head + "; ".join([*self.reasons, *([f"and {self.others} more"] if self.others else [])])
        missed = amounts and np.isfinite(self.amount)
        whatever = f"whatever the {self.decides}"
        if not self.members:
            what = "equalities" if self.equalities else "fixed constraints"
            by = f": one is missed by at least {self.amount:.4g} times its norm" if missed else ""
            return f"the {what} cannot be met within the bounds, {whatever}{by}"
        if len(self.members) + self.others > 1:
            head = "these cannot hold together" + (", though all but any one of them can" if self.irreducible else "")
        else:
            head = "nothing meets this " + ("and the equalities" if self.equalities else "within the bounds")
        by = f" (one is violated by at least {self.amount:.4g} times its norm, {whatever})" if missed else ""
        named = "; ".join([*self.members, *([f"and {self.others} more"] if self.others else [])])
        return f"{head}{by}: {named}" + (f"; {self.demand}" if self.demand else "")


@dataclass(frozen=True, eq=False)
class Proof:
    """What is known of one family at one decision: ``proven`` (no index violates it by more than
    ``bound <= allowed``), ``refuted`` (``index``, ``row`` violate it by ``violation``) or ``undecided`` (``reason``).

    ``leaves``: the lower and upper corners ``(k, d)`` of the closed cells that prove it, a subdivision of the family's
    ``cells``, in lexicographic order; ``None`` unless proven by branch and bound. ``formulation`` is that of the index.
    ``unit``: what a violation of 1 of that row is in the user's units, called ``measured`` where that is known, and
    ``units (r,)`` of all rows. ``bound`` is in the units of the program that was solved; ``share`` is what it was in
    each row's own unit, once it is told in the user's; ``allowed``: the violation that counts as none, likewise.
    """

    family: str
    verdict: Literal["proven", "refuted", "undecided"]
    bound: float
    violation: float = -np.inf
    index: Array | None = None
    row: int = 0
    cells: int = 0
    reason: str = ""
    leaves: tuple[Array, Array] | None = None
    formulation: Formulation = "reduced"
    unit: float = 1.0
    measured: str = ""
    units: Array | None = None
    share: float | None = None
    allowed: float = TOLERANCE

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Leaf:
    """What is known of one part of a `Tree`: multipliers ``dual`` that bound the count there, or, where it is not
    ``feasible``, prove that nothing is feasible there."""

    dual: Dual
    feasible: bool = True


@dataclass(frozen=True, eq=False)
class Branch:
    """Entry ``image`` of ``S x`` is 0 in the ``first`` part and counts in the ``second``; or, where ``at`` says two
    neighbouring letters of an alphabet, it is at most the one and at least the other. The parts are numbers of nodes.
    """

    image: int
    first: int
    second: int
    at: tuple[float, float] | None = None


Tree: TypeAlias = "Sequence[Leaf | Branch]"
"""The nodes of a branch and bound, the first of which is everything."""


@dataclass(frozen=True, eq=False)
class Sparsest:
    """What a method that counts knows beside the count: ``norm``, the cost J of its decision, and of an optimum of J,
    where it has one, the cost ``plain`` and the count ``plain_count``, in the user's units; and the ``tree`` behind its
    lower bound, in which the images are restricted to ``letters`` where there are any."""

    norm: float
    plain: float | None
    plain_count: float | None
    tree: Tree
    letters: Sequence[float] | None = None

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Activity:
    """What is proven of the least count of a program (`SemiInfiniteProgram.activity`) over all feasible decisions, as
    shares of the largest: at least ``lower``, by multipliers ``dual`` of a program of its own or, where that is
    ``None``, by those of the cost; at most ``upper``, the count of the decision that is returned, or of another one,
    ``decision``, with the ``proofs`` of it; ``None`` where neither is proven. ``norm``: whether the cost of the program
    is a sum of absolute values."""

    lower: float
    upper: float | None
    dual: Dual | None = None
    decision: Array | None = None
    proofs: Sequence[Proof] = ()
    norm: bool = True
