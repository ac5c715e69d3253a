"""Reasons why nothing is feasible that need no solver: a constraint that no decision meets, and two that leave nothing
between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.finite import FiniteProgram
from sparserob_core.sip.inner.duality import dual_bound
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
    the sum's violation."""

    kind: Kind
    rows: Rows
    multipliers: Array
    amount: float
    text: str


def reasons(program: SemiInfiniteProgram) -> list[Reason]:
    """What is impossible at the corners and centres of every family's cells, at most one reason for every row of a
    family."""
    return [reason for family in program.families for reason in _of_family(program.finite, family.reduced or family)]


def _of_family(base: FiniteProgram, family: ConstraintFamily) -> Iterator[Reason]:
    indices = _looked_at(family)
    if not indices.shape[0]:
        return
    G, h = family.rows(indices)
    least = least_of(base, G.reshape(-1, base.n), h.reshape(-1)).reshape(h.shape)
    size = np.linalg.norm(G, axis=2)
    scale = REAL * np.maximum(family.scale, np.abs(h))
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
    return Reason(kind, rows, multipliers, amount, sentence(kind, family, rows, amount))


def sentence(kind: Kind, family: ConstraintFamily, rows: Rows, amount: float) -> str:
    """The reason in words and numbers, as far as the family can tell them."""
    if family.explain is None:
        named = " and ".join(
            f"row {cut.row} of {cut.family} at {np.array2string(cut.index, precision=6)}" for cut in rows.cuts
        )
        return (
            f"{named} cannot hold: {'their sum' if len(rows.cuts) > 1 else 'it'} is violated by at least {amount:.4g},"
            " whatever the decision"
        )
    words = [family.explain(cut.index, cut.row) for cut in rows.cuts]
    if not words[0].quantity:
        return f"{' and '.join(one.text for one in words)}: violated by at least {amount:.4g}, whatever the decision"
    at = f", at {words[0].where}" if words[0].where and words[0].time else ""
    if kind == "beyond every decision":
        return _beyond(family.name, words[0]) + at
    if kind == "nothing between":
        return _between(family.name, words[0], words[1]) + at
    return _out_of_reach(family.name, words[0], amount, -float(rows.h[0])) + at


def _beyond(name: str, one: Explanation) -> str:
    reached = one.free + one.sign * one.sigma
    pushed = f" under the worst disturbance, which moves it by {one.sigma:.4g}," if one.sigma > 0 else ""
    return f"{one.quantity} = {reached:.6g}{pushed} is outside {one.bound} ({name}), whatever the decision"


def _between(name: str, one: Explanation, two: Explanation) -> str:
    allowed, moved = (one.sign * one.limit + two.sign * two.limit) / 2, (one.sigma + two.sigma) / 2
    if moved > 0:
        more, less = told_apart(moved, allowed)
        return f"the disturbance alone moves {one.quantity} by {more}, {_set(name)} allows {less}"
    return f"{one.text} and {two.text} leave nothing between them"


def _out_of_reach(name: str, one: Explanation, amount: float, needed: float) -> str:
    verb, pushed = (
        ("raise" if one.sign < 0 else "lower"),
        f", {one.sigma:.4g} of it for the worst disturbance" if one.sigma > 0 else "",
    )
    if needed - amount < 0:
        return f"{one.text} is violated by at least {amount:.4g}, whatever the control"
    can, must = told_apart(needed - amount, needed)
    return (
        f"the control can {verb} {one.quantity} by at most {can}, and {must} is needed{pushed}: "
        f"without control it is {one.free:.4g}, {_set(name)} asks for {one.bound}"
    )


def told_apart(one: float, two: float) -> tuple[str, str]:
    """Two numbers with four digits, or as many as it takes to tell them apart."""
    texts = [(f"{one:.{digits}g}", f"{two:.{digits}g}") for digits in range(4, 17)]
    return next((pair for pair in texts if pair[0] != pair[1]), texts[-1])


def _set(name: str) -> str:
    return {"terminal": "the terminal set", "path": "the path set"}.get(name, name)
