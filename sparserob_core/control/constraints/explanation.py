"""One constraint of the state in words and numbers."""

from __future__ import annotations

import numpy as np

from sparserob_core.control.response.functional import WorstCase
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.program import Explanation


def explanation(
    name: str, functionals: WorstCase, H: Array, h: Array, row: int, time: float, parameter: Array
) -> Explanation:
    """Row ``row`` of ``H x(t) <= h`` at a time and a parameter ``(nu,)``: what is bounded, when, and what the
    uncertainty does to it."""
    direction, system = H[row], functionals.response.system
    sign = -1.0 if np.count_nonzero(direction) == 1 and direction.sum() < 0 else 1.0
    at = (np.array([time]), direction[None], parameter[None])
    sigma = float(functionals.offsets(*at)[0])
    free, limit = sign * float(functionals.rows(*at)[1][0] - sigma) + 0.0, sign * float(h[row])
    quantity, where = (
        combination(sign * direction, f"({time:.6g})"),
        system.describe(parameter) if parameter.size else "",
    )
    remarks = [f"the initial state gives {free:.6g}"] if time <= 0 else []
    remarks += [f"the disturbance alone moves it by {sigma:.4g}"] if sigma > 0 else []
    remarks += [f"at {where}"] if where else []
    text = f"{name}: {quantity} {'>=' if sign < 0 else '<='} {limit:.6g}"
    return Explanation(
        f"{text} ({', '.join(remarks)})" if remarks else text,
        time,
        parameter,
        functionals.worst_disturbance(time, direction, parameter),
        quantity=quantity,
        bound=_bound(sign * direction, limit, _opposite(H, h, row), sign),
        limit=limit,
        free=free,
        sigma=sigma,
        sign=sign,
        where=where,
        direction=direction,
    )


def combination(direction: Array, suffix: str = "") -> str:
    """``c'x`` in words, such as ``x1(5)`` or ``x1(5) - 0.5 x2(5)``; the suffix stands behind every state."""
    parts: list[str] = []
    for state in np.flatnonzero(direction):
        size = abs(direction[state])
        sign = "-" if direction[state] < 0 else "+" if parts else ""
        parts.append(f"{sign}{' ' if parts else ''}{'' if size == 1 else f'{size:.4g} '}x{state + 1}{suffix}")
    return " ".join(parts) or "0"


def _opposite(H: Array, h: Array, row: int) -> float | None:
    """The least right-hand side of the rows that look the other way; ``None`` without one."""
    found = h[(-H[row] == H).all(axis=1)]
    return float(found.min()) if found.size else None


def _bound(direction: Array, limit: float, opposite: float | None, sign: float) -> str:
    """``|x1| <= 0.7``, ``-0.2 <= x1 <= 0.3`` or ``x1 >= -0.7``."""
    words = combination(direction)
    if opposite is None:
        return f"{words} {'>=' if sign < 0 else '<='} {limit:.6g}"
    low, high = sorted([limit, -sign * opposite])
    return f"|{words}| <= {high:.6g}" if low == -high else f"{low:.6g} <= {words} <= {high:.6g}"
