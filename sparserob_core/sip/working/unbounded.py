"""Programs without an optimum: rays along which the cost falls without bound, and rows that exclude such rays.

A relaxed program may be unbounded below only because few constraints are imposed. The recession program decides whether
the whole program is unbounded (Rockafellar 1970, section 8). The recession program is the same program with right-hand
sides 0, whose decision is a direction ``d`` of bounded size with ``P d = 0``. Its value is negative exactly where a
feasible convex program falls along a ray. Where it is not negative, the indices that prove this bound the relaxed
program too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import ignore
from sparserob_core.sip.evidence import Cut, Dual
from sparserob_core.sip.inner.duality import balance_rows
from sparserob_core.sip.inner.vertex import simplex
from sparserob_core.sip.method import Tools
from sparserob_core.sip.program import ConstraintFamily, SemiInfiniteProgram
from sparserob_core.sip.relaxed.relaxed import rows_of
from sparserob_core.sip.result import Result, Status
from sparserob_core.sip.separation.separation import separate
from sparserob_core.sip.working.ledger import (
    SEARCH_TOLERANCE,
    Close,
    Ledger,
    Prover,
    Violated,
    prove_nothing,
    select_violated,
)

SPENT = 1e-12  # of a bound: what it loses for multipliers of rows without one; ten times less is lost in rounding
NO_FALL = 1e-12  # of the largest coefficient: fall of the cost per unit of a direction that is certainly rounding
MAX_BOUNDING_ROUNDS = 200  # of collecting rows that bound a program; a fifth serve quadratic forms in three coordinates
FALLS = 1e-7  # of the largest coefficient: fall of the cost per unit of a direction that is no rounding
# Largest number of moving coordinates for which the first rows are on a grid: two points along each of ten coordinates
# are a thousand indices.
MAX_GRID_COORDINATES = 8
# First rows of a family for every variable: with one, polynomials take twice as long, with four filters do
ROWS_PER_VARIABLE = 2
DENSER = 2  # points more along every coordinate: both parities are tried; ten more are many rows in four coordinates
# Entries of a decision up to which its first rows are looked at: ten times as many take a minute
MAX_SCANNED_ENTRIES = 300
MAX_RAY_ENTRIES = 6  # largest number of entries of a ray in the message


def recession_program(program: SemiInfiniteProgram) -> SemiInfiniteProgram:
    """Return the program of the cost along directions ``d`` of size at most 1 in which the constraints are never
    left."""
    base, images = program.finite, program.finite.weights.size
    n, empty = program.n, (np.zeros((0, program.n)), np.zeros(0))
    size = (np.vstack([np.eye(n), -np.eye(n)]), np.ones(2 * n)) if base.S is not None else empty
    flat = np.zeros((0, n)) if base.P is None else base.P.toarray()
    A = np.vstack([base.A, flat[flat.any(axis=1)]])
    finite = np.isfinite(base.h)
    G, h = np.vstack([base.G[finite], size[0]]), np.concatenate([np.zeros(int(finite.sum())), size[1]])
    return SemiInfiniteProgram(
        n=n,
        q=base.q,
        weights=base.weights,
        S=base.S,
        blocks=program.blocks,
        lower=np.where(np.isfinite(base.lower), np.zeros(images), -1.0),
        upper=np.where(np.isfinite(base.upper), np.zeros(images), 1.0),
        G=G if h.size else None,
        h=h if h.size else None,
        A=A if len(A) else None,
        b=np.zeros(len(A)) if len(A) else None,
        families=[_make_homogeneous(family) for family in program.families],
    )


def _make_homogeneous(family: ConstraintFamily) -> ConstraintFamily:
    """Return the family with right-hand sides 0."""

    def rows(indices: Array) -> tuple[Array, Array]:
        G, h = family.rows(indices)
        return G, np.zeros_like(h)

    def excess(x: Array, indices: Array) -> Array:
        return family.violations(x, indices) - family.violations(np.zeros_like(x), indices)

    offered = None if family.excess is None else excess
    return ConstraintFamily(name=family.name, index_set=family.index_set, rows=rows, excess=offered)


def _has_bounds(program: SemiInfiniteProgram) -> bool:
    """Return whether every entry of the decision has two finite bounds."""
    return program.finite.S is None and program.finite.bounded


def first_rows(program: SemiInfiniteProgram) -> list[tuple[Array, np.ndarray, str]]:
    """Return rows that usually make an unbounded relaxed program bounded.

    A family gets at least `ROWS_PER_VARIABLE` indices for every variable of the decision, and as many more, if at most
    `MAX_GRID_COORDINATES` coordinates of its index can move; otherwise it gets one index. They are dense at the faces
    of the index set, where polynomials and cosines grow most (nodes of Chebyshev). Where such a grid happens to meet
    the zeros of a term, as that of three angles does for a sine, it does not bound the decision, and one with more
    points is tried. Nothing is returned where the decision has bounds.
    """
    if _has_bounds(program):
        return []
    first = _list_grid_rows(program, 0)
    if program.n > MAX_SCANNED_ENTRIES:
        return first
    grids = (first, *(_list_grid_rows(program, more) for more in range(1, DENSER + 1)))
    return next((rows for rows in grids if _is_bounded_by(program, rows)), first)


def _list_grid_rows(program: SemiInfiniteProgram, more: int) -> list[tuple[Array, np.ndarray, str]]:
    """Return the rows of all families on grids, with so many ``more`` points along every coordinate that moves."""
    rows: list[tuple[Array, np.ndarray, str]] = []
    for family in program.families:
        box = family.index_set
        free_axes = np.flatnonzero(box.upper > box.lower)
        count = ROWS_PER_VARIABLE * (program.n + 1) if free_axes.size <= MAX_GRID_COORDINATES else 1
        side = int(np.ceil(count ** (1.0 / max(1, free_axes.size)) - 1e-9)) + more * (count > 1)
        share = 0.5 - 0.5 * np.cos(np.pi * np.arange(side) / max(1, side - 1)) if side > 1 else np.array([0.5])
        lines = [share if i in free_axes else np.zeros(1) for i in range(box.dimension)]
        unit = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, box.dimension)
        indices = np.clip(box.lower + unit * (box.upper - box.lower), box.lower, box.upper)
        each = family.violations(np.zeros(program.n), indices[:1]).shape[1]
        rows.append((np.repeat(indices, each, axis=0), np.tile(np.arange(each), len(indices)), family.name))
    return rows


def _is_bounded_by(program: SemiInfiniteProgram, rows: Violated) -> bool:
    """Return whether rows, together with those without an index, bound the entries of cheap decisions that neither a
    bound nor a square holds."""
    base = program.finite
    free, finite = _list_free_entries(program), np.isfinite(base.h)
    table, equalities = np.vstack([rows_of(program, rows).G, base.G[finite]])[:, free], base.A[:, free]
    if np.linalg.matrix_rank(np.vstack([table, equalities])) < int(free.sum()):
        return False  # a column of rounding only, which a linear program does not see
    return balance_rows(table, equalities, base.q[free]) is not None


def _list_free_entries(program: SemiInfiniteProgram) -> np.ndarray:
    """Return which entries of a decision have neither two bounds nor a curvature; all of one with an image."""
    base = program.finite
    if base.S is not None:
        return np.ones(program.n, dtype=bool)
    free = np.isinf(base.lower) | np.isinf(base.upper)
    if base.P is not None:
        free &= (base.curvature if base.curvature is not None else base.P.diagonal()) == 0.0
    return np.asarray(free)


def bounding_rows(
    program: SemiInfiniteProgram, tools: Tools, close: Close, start: Sequence[Cut] = ()
) -> tuple[Array | None, list[tuple[Array, np.ndarray, str]]]:
    """Return a ray along which the cost falls without bound, or rows that exclude such rays.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program.
    tools : Tools
        Components of the run.
    close : Close
        Exchange that closes the gap of the recession program.
    start : sequence of Cut, default ()
        Constraints that are imposed already.

    Returns
    -------
    ray : ndarray, shape (n,), or None
        The ray, where there is one.
    rows : list
        Indices, rows and names of families that exclude a ray, where none was found.
    """
    base = program.finite
    if _has_bounds(program):
        return None, []
    steps, recession = replace(tools, regulariser=None, notify=ignore), recession_program(program)
    coefficient = max(float(np.abs(base.q).max(initial=0.0)), float(base.weights.max(initial=0.0)))
    rows, is_bounded = _collect_rows(recession, steps, _group_by_family(start), NO_FALL * coefficient)
    if is_bounded:
        return None, rows
    result = close(recession, steps, prove_nothing, rows)
    if result.decision is not None and not result.stopped and result.cost < -FALLS * coefficient:
        return result.decision / np.abs(result.decision).max(), []
    return None, _group_by_family(result.history[-1].imposed if result.history else ())


def _collect_rows(
    recession: SemiInfiniteProgram, tools: Tools, start: Violated, fall: float
) -> tuple[list[tuple[Array, np.ndarray, str]], bool]:
    """Return rows with which the cost of a recession program falls by at most ``fall``, beginning with those of
    ``start``, and whether they were found: by vertices, each of which is left by the rows that it violates most."""
    chosen = list(start)
    if recession.finite.blocks is not None:
        return chosen, False
    rows = rows_of(recession, chosen)
    for number in range(MAX_BOUNDING_ROUNDS):
        tools.deadline.check()
        base, G = recession.finite, np.unique(rows.G, axis=0)  # rows that differ on the right alone are the same here
        corner = simplex(replace(base, G=np.vstack([base.G, G]), h=np.concatenate([base.h, np.zeros(len(G))])))
        if corner.status != "optimal":
            return chosen, False
        if recession.cost(corner.x) >= -fall:
            return chosen, True
        violated = [
            select_violated(*pair)
            for pair in separate(recession, corner.x, replace(tools, budget=0), SEARCH_TOLERANCE, number)
        ]
        fresh = [entry for entry in violated if entry[1].size]
        if not fresh:
            return chosen, False
        rows = rows.joined(rows_of(recession, fresh))
        chosen += fresh
    return chosen, False


def complete_multipliers(program: SemiInfiniteProgram, dual: Dual, is_priced: bool) -> Dual:
    """Return multipliers that can be moved so that every entry without bounds has exactly the slope that it needs.

    As many of them as there are such entries have to be positive by more than rounding, and their rows independent.
    Where they are fewer, small multiples of a positive combination of rows and the cost are added, in which those
    entries cancel (`balance_rows`). The bound then loses the share `SPENT` of itself.

    Parameters
    ----------
    program : SemiInfiniteProgram
        The program, without an image ``S`` and without blocks.
    dual : Dual
        Its multipliers.
    is_priced : bool
        Whether they prove a bound of the cost; otherwise they prove that nothing is feasible.
    """
    base = program.finite
    free = _list_free_entries(program) if is_priced else np.isinf(base.lower) | np.isinf(base.upper)
    if not free.any() or dual.mu.size != base.b.size:
        return dual
    own_cuts = sorted(dual.cuts, key=lambda cut: cut.family)
    own, fixed = rows_of(program, _group_by_family(own_cuts)), dual.of_fixed_rows(base.h.size)
    multipliers = np.array([cut.multiplier for cut in own_cuts])
    least = SPENT * max(multipliers.max(initial=0.0), fixed.max(initial=0.0))
    used = np.vstack([own.G[multipliers > least], base.G[fixed > least], base.A])[:, free]
    if np.linalg.matrix_rank(used) == int(free.sum()):
        return dual
    rows = own.joined(rows_of(program, first_rows(program)))
    finite = np.isfinite(base.h)
    table = np.vstack([rows.G, base.G[finite]])
    right = np.concatenate([rows.h, base.h[finite]])
    if np.linalg.matrix_rank(np.vstack([table, base.A])[:, free]) < int(free.sum()):
        return dual
    cost = base.q[free] if is_priced else np.zeros(int(free.sum()))
    combination = balance_rows(table[:, free], base.A[:, free], cost)
    if combination is None:
        return dual
    added, moved, factor = combination
    size = abs(dual.bound) if is_priced else float(multipliers.sum())
    loss = float(np.abs(added) @ np.abs(right) + np.abs(moved) @ np.abs(base.b)) or 1.0
    share = SPENT * (size or 1.0) / loss
    kept = 1.0 - share * factor
    y = kept * np.concatenate([multipliers, np.zeros(rows.h.size - own.h.size)])
    y = y + share * added[: rows.h.size]
    fixed = kept * fixed
    fixed[finite] += share * added[rows.h.size :]
    cuts = tuple(replace(cut, multiplier=float(value)) for cut, value in zip(rows.cuts, y, strict=True))
    return replace(dual, cuts=cuts, fixed=fixed, mu=kept * dual.mu + share * moved)


def _group_by_family(cuts: Sequence[Cut]) -> list[tuple[Array, np.ndarray, str]]:
    """Return the constraints of cuts as indices, rows and names, grouped by families."""
    names = dict.fromkeys(cut.family for cut in cuts)
    groups = [[cut for cut in cuts if cut.family == name] for name in names]
    return [(np.array([c.index for c in group]), np.array([c.row for c in group]), group[0].family) for group in groups]


def falls_for_ever(ledger: Ledger, close: Close, prover: Prover, ray: Array) -> Result:
    """Return the result for a program whose cost falls along a ray.

    The result has a decision that meets the constraints, where there is one, judged like any other, and no lower bound.

    Parameters
    ----------
    ledger : Ledger
        Accounts of the method.
    close : Close
        Exchange that finds a feasible decision.
    prover : Prover
        Prover of the families.
    ray : ndarray, shape (n,)
        The ray.

    Returns
    -------
    Result
        The result.
    """
    program, tools = ledger.program, ledger.tools
    feasible = replace(program, q=None, P=None, weights=None, blocks=None, constant=0.0, families=program.families)
    result = close(feasible, replace(tools, regulariser=None), prover)
    if result.decision is None:
        return result
    cost = program.cost(result.decision)
    slope = float(program.finite.weights @ np.abs(program.finite.image(ray)) + program.finite.q @ ray)
    order = np.argsort(-np.abs(ray), kind="stable")[:MAX_RAY_ENTRIES]
    terms = ", ".join(f"{ray[i]:.4g} in x{i + 1}" for i in np.sort(order))
    dots = ", ..." if program.n > MAX_RAY_ENTRIES else ""
    is_proven = result.status in ("certified", "verified")
    met = (
        "the decision is proven to meet the constraints" if is_proven else "the decision meets them as far as was seen"
    )
    text = f"unbounded below: along the ray ({terms}{dots}) the cost falls for ever, by {-slope:.4g} per unit; {met}"
    status: Status = "verified" if is_proven else result.status
    return replace(
        result,
        status=status,
        message=text if status == "verified" else f"{text}; {result.message}",
        cost=cost,
        value=cost,
        lower_bound=-np.inf,
        upper_bound=cost if status == "verified" else np.inf,
        cost_scale=program.added(result.decision),
        ray=ray,
    )
