"""What supports a claim: imposed constraints with their multipliers, proofs over the continuum, and witnesses against
it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import Formulation


@dataclass(frozen=True, eq=False)
class Cut:
    """One imposed constraint: row ``row`` of family ``family`` at ``index (d,)``, with its multiplier in the last
    relaxed program. ``formulation`` says which form of the family the index belongs to."""

    family: str
    index: Array
    row: int
    multiplier: float = 0.0
    formulation: Formulation = "reduced"


@dataclass(frozen=True, eq=False)
class Dual:
    """Multipliers that prove a lower ``bound`` of the semi-infinite program's value, or of its infeasibility: those of
    the imposed constraints (in ``cuts``), ``mu (e,)`` of the equalities, and ``z (k,)`` of the image ``S x`` unless
    ``S`` is the identity.
    """

    bound: float
    cuts: Sequence[Cut]
    mu: Array
    z: Array | None = None


NO_BOUND = Dual(-np.inf, (), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Witness:
    """The worst constraint found: by how much it is violated (negative: satisfied with that margin), which one, and
    where.

    ``time``, ``parameter`` and ``disturbance`` are filled for control problems; ``disturbance`` is ``(mw, pieces)``.
    """

    violation: float
    constraint: str
    index: Array
    row: int = 0
    formulation: Formulation = "reduced"
    time: float | None = None
    parameter: Array | None = None
    disturbance: Array | None = field(default=None, repr=False)


@dataclass(frozen=True, eq=False)
class Proof:
    """What is known of one family at one decision: ``proven`` (no index violates it by more than
    ``bound <= TOLERANCE``), ``refuted`` (``index``, ``row`` violate it by ``violation``) or ``undecided`` (``reason``).

    ``leaves``: the lower and upper corners ``(k, d)`` of the closed cells that prove it, a subdivision of the family's
    ``cells``, in lexicographic order; ``None`` unless proven by branch and bound. ``formulation`` is that of the index.
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
