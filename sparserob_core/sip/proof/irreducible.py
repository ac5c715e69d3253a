"""Irreducible infeasible subsystems: constraints that cannot hold together, none of which can be left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sparserob_core.sip.finite import FiniteSolution
from sparserob_core.sip.inner.duality import farkas_bound, farkas_proof, measure, remove_cost
from sparserob_core.sip.inner.solve import SIMPLEX_STEPS_PER_ROW, elastic_program, interpret_elastic_answer
from sparserob_core.sip.inner.vertex import simplex
from sparserob_core.sip.proof.reasons import reasons
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram, Rows

# Number of rows above which a proof with fewer rows is sought first: the filter solves a program for each row.
# With a tenth of it, a vertex is sought where the filter takes a moment; with ten times as many, it takes minutes.
MAX_FILTERED_ROWS = 40


def find_irreducible_rows(
    relaxed: RelaxedProgram, rows: Rows, solution: FiniteSolution
) -> tuple[Rows, FiniteSolution, bool]:
    """Return rows that cannot hold together, none of which was found to be dispensable, with multipliers as a proof.

    A constraint that is impossible by itself, or two constraints that leave nothing between them, are returned at once
    (`reasons`). Otherwise the deletion filter (Chinneck and Dravnieks 1991) is applied. The filter leaves every row out
    once, the least important first. A row stays out if the others are infeasible without it. A row that was needed
    stays needed when others are removed. The multipliers prove that the rows cannot hold together. A row also stays
    where neither a decision nor a proof of infeasibility was found without it.

    Parameters
    ----------
    relaxed : RelaxedProgram
        The relaxed program.
    rows : Rows
        Rows that cannot hold together.
    solution : FiniteSolution
        Solution whose multipliers prove that.

    Returns
    -------
    rows : Rows
        Rows of the subsystem.
    solution : FiniteSolution
        Solution with the multipliers that prove it.
    shown : bool
        True where, for each row, a decision was found that meets all the others.
    """
    fixed = relaxed.program.finite.h.size
    plain = _find_evident_reason(relaxed, solution)
    if plain is not None:
        return *plain, False
    solution = _move_to_vertex(relaxed, rows, solution)
    y = solution.y[fixed:]
    support = np.flatnonzero(y > 0.0)
    rows, y = rows.take(support), y[support]
    needed, shown = np.zeros(y.size, dtype=bool), True
    while not needed.all() and y.size > 1:
        position = int(np.flatnonzero(~needed)[np.argmin(y[~needed])])
        keep = np.arange(y.size) != position
        without = relaxed.solve(rows.take(keep), 0.0)
        if without.status != "infeasible":
            needed[position] = True
            shown = shown and without.status == "optimal"
            continue
        solution, y = without, without.y[fixed:]
        rows, needed, positive = rows.take(keep), needed[keep], y > 0.0
        rows, needed, y = rows.take(positive), needed[positive], y[positive]
    alone = not (fixed or relaxed.program.finite.b.size)  # of a single row: bounds of the decision can always hold
    return rows, replace(solution, y=np.concatenate([solution.y[:fixed], y])), shown and bool(needed.all() or alone)


def _move_to_vertex(relaxed: RelaxedProgram, rows: Rows, solution: FiniteSolution) -> FiniteSolution:
    """Return a solution whose proof has few rows, where the given proof has many.

    The new multipliers are an optimal vertex of the dual of the elastic program. At a vertex, no more multipliers are
    positive than that program has variables: one more than the decision has.
    """
    fixed, size = relaxed.program.finite.h.size, np.count_nonzero(solution.y)
    if size <= MAX_FILTERED_ROWS:
        return solution
    finite = relaxed.finite(rows.G, rows.h, 0.0)
    corner = simplex(elastic_program(finite), SIMPLEX_STEPS_PER_ROW * (finite.n + finite.h.size))
    if corner.status != "optimal":
        return solution
    x, y, mu, z = interpret_elastic_answer(finite, (corner.x, corner.y, corner.mu, corner.z))
    amount = farkas_proof(finite, y, mu, z, relaxed.tolerance)
    if amount is None or np.count_nonzero(y) >= size or not y[fixed:].any():
        return solution
    measured = measure(remove_cost(finite), x, y, mu, z)
    return replace(solution, y=y, mu=mu, z=measured.z, infeasibility=amount)


def _find_evident_reason(relaxed: RelaxedProgram, solution: FiniteSolution) -> tuple[Rows, FiniteSolution] | None:
    """Return the rows of the first reason that needs no solver, with its multipliers, if they are rows of this
    program."""
    base = relaxed.program.finite
    for reason in reasons(relaxed.program):
        if relaxed.program.family(reason.rows.cuts[0].family).reduced is not None:
            continue
        y = np.concatenate([np.zeros(base.h.size), reason.multipliers])
        finite = relaxed.finite(reason.rows.G, reason.rows.h, 0.0)
        amount = farkas_bound(finite, y, np.zeros(base.b.size)) if reason.rows.G.any() else np.inf
        if amount > relaxed.tolerance:
            mu = np.zeros(base.b.size)
            z = measure(remove_cost(finite), solution.x, y, mu).z
            return reason.rows, replace(
                solution, y=y, mu=mu, z=z, infeasibility=amount, message=f"infeasible: {reason.text}"
            )
    return None
