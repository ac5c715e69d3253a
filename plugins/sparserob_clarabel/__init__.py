"""Clarabel (Goulart and Chen 2024): an interior-point method on the homogeneous embedding, for conic programs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

import sparserob_core as sr


class Clarabel(sr.Solver, sr.Options):
    """Interior-point solver for conic programs, robust and precise; slower than PIQP on programs with few rows. Gives a
    Farkas ray when a program is infeasible."""

    sparse: ClassVar[bool] = True
    conic: ClassVar[bool] = True

    max_iterations: int = Field(default=200, ge=1, le=10_000)
    """Interior-point iterations before giving up."""

    def solve(self, program: sr.QuadraticProgram, accuracy: float) -> sr.Claim:
        import clarabel
        from scipy.sparse import csc_array, csc_matrix, eye_array, triu, vstack

        n, e, r = program.q.size, program.b.size, program.h.size
        bounded_above, bounded_below = (
            np.flatnonzero(np.isfinite(program.upper)),
            np.flatnonzero(np.isfinite(program.lower)),
        )
        identity = eye_array(n, format="csr")
        cone_variables = np.concatenate([np.zeros(0, dtype=int), *program.cones])  # variables, cone after cone
        cone_rows = csc_array(
            (-np.ones(cone_variables.size), (np.arange(cone_variables.size), cone_variables)),
            shape=(cone_variables.size, n),
        )
        rows = csc_matrix(
            vstack([program.A, program.G, identity[bounded_above], -identity[bounded_below], cone_rows], format="csc")
        )
        rhs = np.concatenate([program.b, program.h, program.upper[bounded_above], -program.lower[bounded_below]])
        cones = [clarabel.ZeroConeT(e), clarabel.NonnegativeConeT(rhs.size - e)]
        cones += [clarabel.SecondOrderConeT(cone.size) for cone in program.cones]
        rhs = np.concatenate([rhs, np.zeros(cone_variables.size)])
        solver = clarabel.DefaultSolver(
            csc_matrix(triu(program.P, format="csc")), program.q, rows, rhs, cones, self._settings(program, accuracy)
        )
        solution = solver.solve()
        dual, z_box = np.array(solution.z), np.zeros(n)
        z_box[bounded_above] = dual[e + r : e + r + bounded_above.size]
        z_box[bounded_below] -= dual[e + r + bounded_above.size : rhs.size - cone_variables.size]
        statuses: dict[Any, Literal["solved", "infeasible"]] = {"Solved": "solved", "PrimalInfeasible": "infeasible"}
        claim = sr.Claim(
            statuses.get(str(solution.status), "failed"),
            np.array(solution.x),
            dual[e : e + r],
            dual[:e],
            z_box,
            f"{solution.status} after {solution.iterations} iterations",
        )
        return claim.judged(program, accuracy)

    def _settings(self, program: sr.QuadraticProgram, accuracy: float) -> Any:
        import clarabel

        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.max_iter = self.max_iterations
        settings.max_threads = 1
        settings.equilibrate_enable = not program.cones  # rows have unit norm, and a cone scaled as one loses digits
        settings.tol_gap_abs = settings.tol_feas = settings.tol_gap_rel = accuracy
        settings.tol_infeas_abs = settings.tol_infeas_rel = accuracy
        return settings


@sr.hookimpl
def sparserob_solvers() -> Iterator[sr.SolverPlugin]:
    """Offer the solver."""
    yield sr.SolverPlugin(
        name="clarabel", factory=Clarabel, summary="interior point on the homogeneous embedding, conic; robust"
    )
