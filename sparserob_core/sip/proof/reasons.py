"""Reasons for infeasibility that need no solver.

Either no decision meets one constraint, or two constraints leave nothing between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import dual_bound
from sparserob_core.sip.inner.vertex import simplex
from sparserob_core.sip.program import ConstraintFamily, Explanation, SemiInfiniteProgram
from sparserob_core.sip.relaxed.relaxed import Rows

Kind: TypeAlias = Literal["beyond every decision", "nothing between", "out of reach"]
MAX_INDICES = 2000  # largest number of indices of a family
EMPTY_ROW_SIZE = 1e-13  # of a family's largest row: size of a row that the decision does not enter
OPPOSITE_ROWS_SUM = 1e-12  # two unit rows are opposite when their sum is shorter than this
REAL = 1e-8  # of the numbers that cancel: violation that is no rounding
MAX_SINGLE_ROWS = 200  # largest number of rows judged one by one, where the image is not the decision itself


@dataclass(frozen=True, eq=False)
class Reason:
    """Rows that no decision satisfies, with multipliers that prove it.

    Parameters
    ----------
    kind : str
        Kind of the reason.
    rows : Rows
        The rows.
    multipliers : ndarray, shape (r,)
        Multipliers of the rows.
    amount : float
        Violation of the weighted sum of the rows.
    text : str
        Sentence that states the reason.
    about : tuple of str
        Key that similar reasons share; only the worst of them is reported.
    """

    kind: Kind
    rows: Rows
    multipliers: Array
    amount: float
    text: str
    about: tuple[str, ...]


def reasons(program: SemiInfiniteProgram) -> list[Reason]:
    """Return the constraints that are impossible at corners and centres of the families' cells.

    At most `MAX_INDICES` indices of a family are examined. Families without cells, and families whose rows have
    deviations, are left out. There is at most one reason for every row of a family. Of rows that mean the same in
    several cases, only the worst is returned.
    """
    candidates = [
        reason
        for family in program.families
        if family.uncertain is None
        for reason in _list_reasons(program.finite, family.reduced or family)
    ]
    worst: dict[tuple[str, ...], Reason] = {}
    for reason in candidates:  # none is reported twice
        if reason.about not in worst or reason.amount > worst[reason.about].amount:
            worst[reason.about] = reason
    return list(worst.values())


def _list_reasons(base: FiniteProgram, family: ConstraintFamily) -> Iterator[Reason]:
    """Yield the reasons among the rows of one family."""
    indices = _choose_indices(family)
    if not indices.shape[0]:
        return
    G, h = family.rows(indices)
    least = least_of(base, G.reshape(-1, base.n), h.reshape(-1)).reshape(h.shape)
    size = np.linalg.norm(G, axis=2)
    scale = REAL * np.maximum(1.0, np.abs(h))
    explained: set[int] = set()
    empty_violation = np.where(size <= EMPTY_ROW_SIZE * size.max(initial=0.0), -h, -np.inf)
    for row in np.flatnonzero((empty_violation > scale).any(axis=0)):
        explained.add(int(row))
        yield _make_reason(
            "beyond every decision",
            family,
            G,
            h,
            indices,
            int(empty_violation[:, row].argmax()),
            [int(row)],
            np.ones(1),
        )
    for first, second, share, missing in _list_opposite_rows(G, h, size):
        if {first, second} & explained or not (worst := int(missing.argmax()), missing.max() > scale.max())[1]:
            continue
        explained |= {first, second}
        yield _make_reason(
            "nothing between", family, G, h, indices, worst, [first, second], np.array([1.0, share[worst]])
        )
    for row in np.flatnonzero((least > scale).any(axis=0)):
        if row not in explained:
            yield _make_reason(
                "out of reach",
                family,
                G,
                h,
                indices,
                int(least[:, row].argmax()),
                [int(row)],
                np.ones(1),
                float(least[:, row].max()),
            )


def least_of(base: FiniteProgram, G: Array, h: Array) -> Array:
    """Return lower bounds of ``G x - h`` over the bounds of the program.

    Where the image is the decision itself, their rounding is not subtracted: `REAL` allows for it.

    Parameters
    ----------
    base : FiniteProgram
        Program whose bounds hold.
    G : ndarray, shape (r, n)
        Rows.
    h : ndarray, shape (r,)
        Right-hand sides.

    Returns
    -------
    ndarray, shape (r,)
        Lower bounds; ``-inf`` for rows that were not examined.
    """
    if base.S is None:
        with np.errstate(invalid="ignore"):
            low, high = np.where(G == 0.0, 0.0, G * base.lower), np.where(G == 0.0, 0.0, G * base.upper)
        return np.asarray(np.minimum(low, high).sum(axis=1) - h)
    least = np.full(h.size, -np.inf)
    order = np.argsort(h, kind="stable")[:MAX_SINGLE_ROWS]
    empty, zero = np.zeros((0, base.n)), np.zeros(0)
    for i in order:
        single = FiniteProgram(
            G[i], np.zeros_like(base.weights), base.lower, base.upper, empty, zero, empty, zero, S=base.S
        )
        least[i] = dual_bound(single, zero, zero) - h[i]
    return least


def least_within(base: FiniteProgram, row: Array) -> float:
    """Return a proven lower bound of ``g'x`` over the bounds and the rows of the program.

    Parameters
    ----------
    base : FiniteProgram
        Program whose bounds, rows and equalities hold.
    row : ndarray, shape (n,)
        The row ``g``.

    Returns
    -------
    float
        Lower bound by the multipliers of a linear program; ``-inf`` where that program is not solved.
    """
    single = replace(base, q=row, weights=np.zeros_like(base.weights), P=None, constant=0.0, blocks=None)
    corner = simplex(single)
    return dual_bound(single, corner.y, corner.mu, corner.z) if corner.status == "optimal" else -np.inf


def _choose_indices(family: ConstraintFamily) -> Array:
    """Return the indices ``(k, d)`` at which the rows of a family are examined."""
    if family.cells is None:
        return np.zeros((0, family.index_set.dimension))
    lower, upper = family.cells
    points = np.unique(np.concatenate([lower, upper, (lower + upper) / 2]), axis=0)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), MAX_INDICES)).round().astype(int))
    return np.asarray(points[chosen])


def _list_opposite_rows(G: Array, h: Array, size: Array) -> Iterator[tuple[int, int, Array, Array]]:
    """Yield all pairs of rows.

    Each item holds the numbers of the two rows, the weight ``(k,)`` of the second, and the violation ``(k,)`` of their
    weighted sum at every index; ``-inf`` where their normals are not opposite.
    """
    count = h.shape[1]
    for first in range(count):
        for second in range(first + 1, count):
            with np.errstate(divide="ignore", invalid="ignore"):
                share = size[:, first] / size[:, second]
                distance = np.linalg.norm(G[:, first] + share[:, None] * G[:, second], axis=1)
                missing = np.where(
                    distance <= OPPOSITE_ROWS_SUM * size[:, first], -(h[:, first] + share * h[:, second]), -np.inf
                )
            yield first, second, share, np.where(np.isnan(missing), -np.inf, missing)


def _make_reason(
    kind: Kind,
    family: ConstraintFamily,
    G: Array,
    h: Array,
    indices: Array,
    at: int,
    which: list[int],
    multipliers: Array,
    amount: float | None = None,
) -> Reason:
    """Return the reason given by rows ``which`` at index number ``at``."""
    cuts = tuple(
        Cut(family.name, indices[at], row, float(m), family.formulation)
        for row, m in zip(which, multipliers, strict=True)
    )
    rows = Rows(G[at, which], h[at, which], cuts)
    amount = float(-multipliers @ rows.h) if amount is None else amount
    text, keys = sentence(kind, family, rows, multipliers, amount), [_explain_cut(family, cut).alike for cut in cuts]
    return Reason(kind, rows, multipliers, amount, text, (kind, *keys) if all(keys) else (text,))


def _explain_cut(family: ConstraintFamily, cut: Cut) -> Explanation:
    """Return the description of a cut's constraint."""
    return family.explanation(cut.index, cut.row)


def sentence(kind: Kind, family: ConstraintFamily, rows: Rows, multipliers: Array, amount: float) -> str:
    """Return the sentence that states a reason, in the user's units as far as the family knows them.

    Parameters
    ----------
    kind : str
        Kind of the reason.
    family : ConstraintFamily
        Family of the rows.
    rows : Rows
        The rows.
    multipliers : ndarray, shape (r,)
        Multipliers of the rows.
    amount : float
        Violation of the weighted sum.

    Returns
    -------
    str
        The sentence.
    """
    units = [family.row_unit(cut.row) for cut in rows.cuts]
    amount = amount * units[0]
    explanations = [_explain_cut(family, cut) for cut in rows.cuts]
    if kind == "beyond every decision":
        return explanations[0].beyond(amount)
    if kind == "nothing between":
        return explanations[0].apart(
            explanations[1], float(multipliers[1] / multipliers[0]) * units[0] / units[1], amount
        )
    return explanations[0].out_of_reach(amount, -float(rows.h[0]) * units[0])
