"""Reasons why nothing is feasible that need no solver: a constraint that no decision meets, and two that leave nothing
between them."""

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
LOOKED_AT = 2000  # indices of a family at most
NONE = 1e-13  # of its largest row, a row that the decision does not enter
PARALLEL = 1e-12  # two unit rows are opposite when their sum is shorter than this
REAL = 1e-8  # of the numbers that cancel, a violation that is no rounding
DENSE = 200  # rows judged one by one where the image is not the decision itself


@dataclass(frozen=True, eq=False)
class Reason:
    """Rows that nothing satisfies, with multipliers ``(r,)`` that prove it, and the sentence that says so. ``amount``:
    the sum's violation; ``about``: the same for all reasons of which the worst says enough."""

    kind: Kind
    rows: Rows
    multipliers: Array
    amount: float
    text: str
    about: tuple[str, ...]


def reasons(program: SemiInfiniteProgram) -> list[Reason]:
    """What is impossible at the corners and centres of every family's cells, at most one reason for every row of a
    family, and of rows that ask for the same in several cases the worst."""
    found = [
        reason
        for family in program.families
        if family.uncertain is None
        for reason in _of_family(program.finite, family.reduced or family)
    ]
    worst: dict[tuple[str, ...], Reason] = {}
    for reason in found:  # none is told twice
        if reason.about not in worst or reason.amount > worst[reason.about].amount:
            worst[reason.about] = reason
    return list(worst.values())


def _of_family(base: FiniteProgram, family: ConstraintFamily) -> Iterator[Reason]:
    indices = _looked_at(family)
    if not indices.shape[0]:
        return
    G, h = family.rows(indices)
    least = least_of(base, G.reshape(-1, base.n), h.reshape(-1)).reshape(h.shape)
    size = np.linalg.norm(G, axis=2)
    scale = REAL * np.maximum(1.0, np.abs(h))
    explained: set[int] = set()
    bare = np.where(size <= NONE * size.max(initial=0.0), -h, -np.inf)
    for row in np.flatnonzero((bare > scale).any(axis=0)):
        explained.add(int(row))
        yield _reason(
            "beyond every decision", family, G, h, indices, int(bare[:, row].argmax()), [int(row)], np.ones(1)
        )
    for one, two, share, missing in _opposite(G, h, size):
        if {one, two} & explained or not (worst := int(missing.argmax()), missing.max() > scale.max())[1]:
            continue
        explained |= {one, two}
        yield _reason("nothing between", family, G, h, indices, worst, [one, two], np.array([1.0, share[worst]]))
    for row in np.flatnonzero((least > scale).any(axis=0)):
        if row not in explained:
            yield _reason(
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
    """Proven lower bounds ``(r,)`` of ``G x - h`` over the bounds of the program; ``-inf`` for rows that were not
    looked at."""
    if base.S is None:
        with np.errstate(invalid="ignore"):
            low, high = np.where(G == 0.0, 0.0, G * base.lower), np.where(G == 0.0, 0.0, G * base.upper)
        return np.asarray(np.minimum(low, high).sum(axis=1) - h)
    least = np.full(h.size, -np.inf)
    order = np.argsort(h, kind="stable")[:DENSE]
    empty, zero = np.zeros((0, base.n)), np.zeros(0)
    for i in order:
        single = FiniteProgram(
            G[i], np.zeros_like(base.weights), base.lower, base.upper, empty, zero, empty, zero, S=base.S
        )
        least[i] = dual_bound(single, zero, zero) - h[i]
    return least


def least_within(base: FiniteProgram, row: Array) -> float:
    """A proven lower bound of ``g'x`` over the bounds and the rows of the program, by the multipliers of a linear
    program; ``-inf`` where that is not solved."""
    alone = replace(base, q=row, weights=np.zeros_like(base.weights), P=None, constant=0.0, blocks=None)
    corner = simplex(alone)
    return dual_bound(alone, corner.y, corner.mu, corner.z) if corner.status == "optimal" else -np.inf


def _looked_at(family: ConstraintFamily) -> Array:
    if family.cells is None:
        return np.zeros((0, family.index_set.dimension))
    lower, upper = family.cells
    points = np.unique(np.concatenate([lower, upper, (lower + upper) / 2]), axis=0)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), LOOKED_AT)).round().astype(int))
    return np.asarray(points[chosen])


def _opposite(G: Array, h: Array, size: Array) -> Iterator[tuple[int, int, Array, Array]]:
    """Pairs of rows that look opposite ways: their numbers, the weight ``(k,)`` of the second, and by how much ``(k,)``
    their sum is violated."""
    count = h.shape[1]
    for one in range(count):
        for two in range(one + 1, count):
            with np.errstate(divide="ignore", invalid="ignore"):
                share = size[:, one] / size[:, two]
                apart = np.linalg.norm(G[:, one] + share[:, None] * G[:, two], axis=1)
                missing = np.where(apart <= PARALLEL * size[:, one], -(h[:, one] + share * h[:, two]), -np.inf)
            yield one, two, share, np.where(np.isnan(missing), -np.inf, missing)


def _reason(
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
    cuts = tuple(
        Cut(family.name, indices[at], row, float(m), family.formulation)
        for row, m in zip(which, multipliers, strict=True)
    )
    rows = Rows(G[at, which], h[at, which], cuts)
    amount = float(-multipliers @ rows.h) if amount is None else amount
    text, alike = sentence(kind, family, rows, multipliers, amount), [_told(family, cut).alike for cut in cuts]
    return Reason(kind, rows, multipliers, amount, text, (kind, *alike) if all(alike) else (text,))


def _told(family: ConstraintFamily, cut: Cut) -> Explanation:
    return family.explanation(cut.index, cut.row)


def sentence(kind: Kind, family: ConstraintFamily, rows: Rows, multipliers: Array, amount: float) -> str:
    """The reason for people, as far as the family can tell it: in the user's units."""
    units = [family.row_unit(cut.row) for cut in rows.cuts]
    amount = amount * units[0]
    told = [_told(family, cut) for cut in rows.cuts]
    if kind == "beyond every decision":
        return told[0].beyond(amount)
    if kind == "nothing between":
        return told[0].apart(told[1], float(multipliers[1] / multipliers[0]) * units[0] / units[1], amount)
    return told[0].out_of_reach(amount, -float(rows.h[0]) * units[0])
