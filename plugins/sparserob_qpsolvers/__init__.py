"""Solvers that qpsolvers knows (Caron and others 2016-2026), under their own names and with their own settings.

Nothing of qpsolvers is imported before a solver is used: importing it imports every solver that is installed.
"""

from __future__ import annotations

from collections.abc import Iterator

import sparserob_core as sr
from sparserob_qpsolvers.catalogue import NATIVE, SOLVERS


@sr.hookimpl
def sparserob_solvers() -> Iterator[sr.SolverPlugin]:
    """Offer ``qpsolvers``, and each solver that has no adapter of its own by its name."""
    yield sr.SolverPlugin(
        name="qpsolvers",
        factory="sparserob_qpsolvers.through:Qpsolvers",
        summary="any solver of qpsolvers: `solver` names it, further keys are its own settings",
        needs=("qpsolvers", "qpsolvers"),
        open=True,
    )
    for name, solver in SOLVERS.items():
        if name not in NATIVE:
            yield sr.SolverPlugin(
                name=name,
                factory=f"sparserob_qpsolvers.through:{name}",
                summary=f"{solver.summary} (through qpsolvers)",
                needs=(solver.package, solver.package if solver.pip is None else solver.pip),
                open=True,
            )
