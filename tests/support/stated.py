"""Certificates of programs that are stated as text, as a run writes them, without a directory."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

import sparserob_core as sr
from sparserob_core.checker.outcome import Clock, Finding
from sparserob_core.checker.program.claims import ProgramCase, check_program
from sparserob_core.sip.stated.statement import StatedDecision, StatedFamily, StatedProgram

GAP = 1e-7


def state(
    decision: dict[str, Any], minimise: str, *rows: str, index: Any = None, finite: Any = (), tables: Any = None
) -> StatedProgram:
    """Return a program of one family ``f``; a decision is its size, or a tuple of its size and its bounds."""
    entries = {
        name: StatedDecision(*(entry if isinstance(entry, tuple) else (entry,))) for name, entry in decision.items()
    }
    families = [StatedFamily("f", index or {"t": (0.0, 1.0)}, rows)] if rows else []
    return StatedProgram(entries, minimise, families, finite, tables or {})


def certify(program: StatedProgram, seconds: float = 20.0, **changes: Any) -> dict[str, Any]:
    """Return the certificate of the program's run, with some of its numbers replaced."""
    built = program.build()
    result = sr.solve(built, tolerance=GAP, seconds=seconds)
    dual = result.dual
    rows = dual.of_fixed_rows(built.finite.h.size)
    constraints = [
        {"family": cut.family, "index": cut.index, "row": cut.row, "multiplier": cut.multiplier} for cut in dual.cuts
    ]
    data = {
        "status": result.status,
        "cost": result.cost,
        "lower_bound": result.lower_bound if np.isfinite(result.lower_bound) else None,
        "gap_tolerance": GAP,
        "decision": result.decision,
        "multipliers": {"constraints": constraints, "rows": rows, "equalities": dual.mu, "tangent": dual.at},
        "witness": None,
    }
    return {**json.loads(json.dumps(data, default=lambda array: array.tolist())), **changes}


def judge(
    program: StatedProgram, certificate: dict[str, Any], seconds: float = 60.0, gap: float | None = GAP
) -> dict[str, Finding]:
    """Return the findings of the checker by name."""
    return {found.name: found for found in check_program(ProgramCase(program, certificate, Clock(seconds)), gap)}
