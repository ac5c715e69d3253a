"""Proof over the continuum: branch and bound on the violation of every constraint family."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ProofProgress, ignore
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram

TOLERANCE = (
    1e-9  # a violation of at most this counts as none (less where the numbers are tiny: `ConstraintFamily.tolerance`)
)
CELLS = 400_000  # cells examined per family before the proof is given up
BATCH = 4096  # cells bounded at a time, worst first
PROBED = 16  # centres of the worst cells at which a witness is looked for, per batch
# halvings after which a witness is also climbed to: a cell's centre may be far from the worst corner of a set
CLIMBED = (
    3,
    6,
    10,
    15,
    20,
    30,
)
MOVES = 24  # steps of such a climb at most


def prove(program: SemiInfiniteProgram, x: Array, notify: Notify = ignore, cells: int = CELLS) -> tuple[Proof, ...]:
    """Prove or refute every family at ``x (n,)``, one `Proof` each."""
    proven = (family.reduced or family for family in program.families)
    return tuple(replace(prove_family(one, x, notify, cells), formulation=one.formulation) for one in proven)


def prove_family(family: ConstraintFamily, x: Array, notify: Notify = ignore, cells: int = CELLS) -> Proof:
    """Bound the violation of one family over its whole index set.

    Cells whose enclosure is at most `TOLERANCE` are closed, the others halved; the centres of the worst are probed for
    a witness, and where that takes long one is climbed to.
    """
    if family.enclosure is None:
        return _by_separation(family, x)
    try:
        return _branch_and_bound(family, x, notify, cells)
    except NotEnclosable as error:
        return replace(_by_separation(family, x), reason=f"{family.name}: {error}")


def _branch_and_bound(family: ConstraintFamily, x: Array, notify: Notify, cells: int) -> Proof:
    start, tolerance = time.perf_counter(), family.tolerance(TOLERANCE)
    lower, upper = (
        family.cells if family.cells is not None else (family.index_set.lower[None], family.index_set.upper[None])
    )
    closed, examined, best = -np.inf, 0, (-np.inf, lower[0], 0)
    leaves: list[tuple[Array, Array]] = []  # one entry per halving
    bounds, split = _bounded(family, x, lower, upper)
    while True:
        examined += bounds.size
        open_ = bounds > tolerance
        leaves.append((lower[~open_], upper[~open_]))
        closed = max(closed, float(bounds[~open_].max(initial=-np.inf)))
        best = max(best, _probe(family, x, lower, upper, bounds), key=lambda found: found[0])
        if open_.any() and best[0] <= tolerance and len(leaves) in CLIMBED and family.index_set.dimension > 1:
            best = max(
                best,
                _climb(family, x, *(corner[bounds.argmax()] for corner in (lower, upper))),
                key=lambda found: found[0],
            )
        if best[0] > tolerance:
            return Proof(family.name, "refuted", np.inf, best[0], best[1], best[2], examined)
        if not open_.any():
            return Proof(family.name, "proven", closed, best[0], best[1], best[2], examined, leaves=_in_order(leaves))
        worst = float(bounds.max())
        notify(
            ProofProgress(
                family=family.name,
                cells=int(open_.sum()),
                bound=worst,
                seconds=time.perf_counter() - start,
                examined=examined,
                budget=cells,
            )
        )
        halves = _halved(lower[open_], upper[open_], split[open_])
        if halves is None or examined + halves[0].shape[0] > cells:
            reason = (
                f"{int(open_.sum())} of {examined} cells were left, where a violation of {worst:.1e} is not excluded"
            )
            return Proof(family.name, "undecided", worst, best[0], best[1], best[2], examined, reason)
        lower, upper = halves
        bounds, split = _bounded(family, x, lower, upper)


def _bounded(family: ConstraintFamily, x: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    assert family.enclosure is not None
    parts = [family.enclosure(x, lower[i : i + BATCH], upper[i : i + BATCH]) for i in range(0, lower.shape[0], BATCH)]
    bounds = np.concatenate([p.bounds for p in parts])
    return np.where(np.isnan(bounds), np.inf, bounds), np.concatenate([p.split for p in parts])


def _probe(family: ConstraintFamily, x: Array, lower: Array, upper: Array, bounds: Array) -> tuple[float, Array, int]:
    worst = np.argsort(-bounds, kind="stable")[:PROBED]
    centres = (lower[worst] + upper[worst]) / 2
    values = family.violations(x, centres)
    position, row = np.unravel_index(int(values.argmax()), values.shape)
    return float(values[position, row]), centres[position], int(row)


def _climb(family: ConstraintFamily, x: Array, lower: Array, upper: Array) -> tuple[float, Array, int]:
    """The largest violation that a climb from the middle of one cell finds, its index and row: steps along every axis
    and along all of them."""
    box, point, radius = family.index_set, (lower + upper) / 2, upper - lower
    best = (-np.inf, point, 0)
    for _ in range(MOVES):
        star = np.clip(np.vstack([point, point + np.diag(radius), point - np.diag(radius)]), box.lower, box.upper)
        values = family.violations(x, star)
        ahead, behind = values[1:].max(axis=1).reshape(2, -1)
        together = np.clip(point + np.sign(ahead - behind) * radius, box.lower, box.upper)[None]
        star, values = np.vstack([star, together]), np.vstack([values, family.violations(x, together)])
        position, row = (int(i) for i in np.unravel_index(int(values.argmax()), values.shape))
        if values[position, row] > best[0]:
            best = (float(values[position, row]), star[position], row)
        else:
            radius = radius / 2
        point = best[1]
    return best


def _in_order(leaves: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    """All leaves, by their lower and then by their upper corners."""
    lower, upper = (np.vstack(corners) for corners in zip(*leaves, strict=True))
    order = np.lexsort(np.hstack([lower, upper]).T[::-1])
    return lower[order], upper[order]


def _halved(lower: Array, upper: Array, split: Array) -> tuple[Array, Array] | None:
    """Both halves of every cell along its coordinate ``split``; ``None`` when a cell is too narrow to be halved in
    floating point."""
    rows = np.arange(split.size)
    middle = (lower[rows, split] + upper[rows, split]) / 2
    if ((middle <= lower[rows, split]) | (middle >= upper[rows, split])).any():
        return None
    left_upper, right_lower = upper.copy(), lower.copy()
    left_upper[rows, split] = middle
    right_lower[rows, split] = middle
    return np.vstack([lower, right_lower]), np.vstack([left_upper, upper])


def _by_separation(family: ConstraintFamily, x: Array) -> Proof:
    """For families without an enclosure: believe a proven bound of their separation, otherwise leave it open."""
    if family.worst is None:
        return Proof(
            family.name,
            "undecided",
            np.inf,
            reason=f"family {family.name} offers no enclosure, so nothing can be excluded",
        )
    found = family.worst(x)
    violation = float(found.violations[0]) if found.violations.size else -np.inf
    index, row = (found.indices[0], int(found.rows[0])) if found.violations.size else (None, 0)
    if violation > family.tolerance(TOLERANCE):
        return Proof(family.name, "refuted", np.inf, violation, index, row)
    if found.bound <= family.tolerance(TOLERANCE):
        return Proof(family.name, "proven", found.bound, violation, index, row)
    return Proof(
        family.name,
        "undecided",
        found.bound,
        violation,
        index,
        row,
        reason=f"family {family.name} offers no enclosure, so nothing can be excluded",
    )
