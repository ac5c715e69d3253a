"""PIQP (Schwan, Jiang, Kuhn, Jones 2023): a proximal interior-point method with a sparse factorisation."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from pydantic import Field

import sparserob_core as sr


class Piqp(sr.Solver, sr.Options):
    """Solver that `auto` asks: fast on small and medium sparse programs, and precise."""

    sparse: ClassVar[bool] = True

    max_iterations: int = Field(default=150, ge=1, le=10_000)
    """Interior-point iterations before giving up."""

    def solve(self, program: sr.QuadraticProgram, accuracy: float) -> sr.Claim:
        import piqp

        solver = piqp.SparseSolver()
        settings = solver.settings
        settings.max_iter = self.max_iterations
        settings.eps_abs = settings.eps_duality_gap_abs = accuracy
        settings.eps_rel = settings.eps_duality_gap_rel = 0.0
        solver.setup(
            program.P, program.q, program.A, program.b, program.G, None, program.h, program.lower, program.upper
        )
        status = solver.solve()
        result = solver.result
        statuses: dict[Any, Literal["solved", "infeasible"]] = {
            piqp.PIQP_SOLVED: "solved",
            piqp.PIQP_PRIMAL_INFEASIBLE: "infeasible",
        }
        claim = sr.Claim(
            statuses.get(status, "failed"),
            result.x,
            result.z_u,
            result.y,
            result.z_bu - result.z_bl,
            f"{status.name} after {result.info.iter} iterations",
        )
        return claim.judged(program, accuracy)


@sr.hookimpl
def sparserob_solvers() -> Iterator[sr.SolverPlugin]:
    """Offer the solver."""
    yield sr.SolverPlugin(
        name="piqp", factory=Piqp, summary="proximal interior point, sparse; fast and precise; whom auto asks"
    )
