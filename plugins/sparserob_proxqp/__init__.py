"""ProxQP (Bambade, El-Kazdadi, Taylor, Carpentier 2022): a primal-dual augmented Lagrangian method."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

import sparserob_core as sr


class ProxQp(sr.Solver, sr.Options):
    """Solver that is precise on strictly convex programs; slow, and given to false claims of infeasibility, when the
    curvature is small."""

    sparse: ClassVar[bool] = True

    max_iterations: int = Field(default=200, ge=1, le=100_000)
    """Outer (augmented Lagrangian) iterations before giving up."""
    max_inner_iterations: int = Field(default=100, ge=1, le=100_000)
    """Newton iterations of one outer iteration."""
    backend: Literal["dense", "sparse"] = "dense"
    """Factorisation; the dense one is the more reliable, and fast up to about a thousand variables."""

    def solve(self, program: sr.QuadraticProgram, accuracy: float) -> sr.Claim:
        from proxsuite import proxqp

        n, e, r = program.q.size, program.b.size, program.h.size
        no_floor = np.full(r, -np.inf)
        if self.backend == "dense":
            solver = proxqp.dense.QP(n, e, r, True)
            self._tune(solver.settings, accuracy)
            solver.init(
                program.P.toarray(),
                program.q,
                program.A.toarray(),
                program.b,
                program.G.toarray(),
                no_floor,
                program.h,
                program.lower,
                program.upper,
            )
        else:
            from scipy.sparse import csc_matrix, eye_array, vstack

            rows = csc_matrix(vstack([program.G, eye_array(n)], format="csc"))
            solver = proxqp.sparse.QP(n, e, r + n)
            self._tune(solver.settings, accuracy)
            solver.init(
                csc_matrix(program.P),
                program.q,
                csc_matrix(program.A),
                program.b,
                rows,
                np.concatenate([no_floor, program.lower]),
                np.concatenate([program.h, program.upper]),
            )
        solver.solve()
        result, status = solver.results, solver.results.info.status
        statuses: dict[Any, Literal["solved", "infeasible"]] = {
            proxqp.PROXQP_SOLVED: "solved",
            proxqp.PROXQP_PRIMAL_INFEASIBLE: "infeasible",
        }
        claim = sr.Claim(
            statuses.get(status, "failed"),
            np.array(result.x),
            np.array(result.z[:r]),
            np.array(result.y),
            np.array(result.z[r:]),
            f"{status.name} after {result.info.iter_ext} outer iterations",
        )
        return claim.judged(program, accuracy)

    # The default of 1e-4 ends feasible programs as infeasible; without any detection infeasible ones run to the limit
    # (80 s at N = 250).
    def _tune(self, settings: Any, accuracy: float) -> None:
        settings.eps_abs, settings.eps_rel = accuracy, 0.0
        settings.check_duality_gap, settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = True, accuracy, 0.0
        settings.max_iter, settings.max_iter_in = self.max_iterations, self.max_inner_iterations
        settings.eps_primal_inf = settings.eps_dual_inf = 1e-8


@sr.hookimpl
def sparserob_solvers() -> Iterator[sr.SolverPlugin]:
    """Offer the solver."""
    yield sr.SolverPlugin(
        name="proxqp", factory=ProxQp, summary="primal-dual augmented Lagrangian; slow on nearly linear programs"
    )
