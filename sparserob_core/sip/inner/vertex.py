"""Multipliers of the unregularised program from a decision of the regularised one."""

from __future__ import annotations

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram

FREE = 1e-7  # an entry further than this from 0 and from both bounds, relative to their distance, is free
TIGHT = 1e-9  # a row with a slack below this may carry a multiplier
ACTIVE = 1e-9  # a row with a multiplier above this, relative to the largest, is active


def vertex_multipliers(program: FiniteProgram, x: Array, y: Array, mu: Array) -> tuple[Array, Array]:
    """``(y, mu)`` that make the linearised cost stationary in the free entries of ``x (n,)``, in the least-squares
    sense, with ``y >= 0``.

    The multipliers ``y (r,)``, ``mu (e,)`` of a regularised program differ from those of the plain one by the slope of
    the regulariser; at an exactly regularised optimiser these are the plain ones (Friedlander and Tseng 2007, section
    2). Any answer is safe: weak duality decides what it is worth. ``S`` must be the identity and ``P`` absent,
    otherwise the multipliers come back unchanged.
    """
    from scipy.optimize import nnls

    tight = program.h - program.G @ x <= TIGHT * np.maximum(1.0, np.abs(program.h))
    active = np.flatnonzero((y > ACTIVE * y.max(initial=0.0)) | tight)
    if program.S is not None or program.P is not None or not active.size + mu.size:
        return y, mu
    width = np.where(np.isfinite(program.upper - program.lower), program.upper - program.lower, 1.0)
    kink = np.where(program.weights > 0.0, np.abs(x), np.inf)
    away = np.minimum(kink, np.minimum(x - program.lower, program.upper - x))
    free = away > FREE * width
    rows = np.vstack([program.G[active], program.A, -program.A])[:, free]
    slope = -program.q[free] - program.weights[free] * np.sign(x[free])
    try:
        found, _ = nnls(rows.T, slope)
    except RuntimeError:  # its iteration limit: these multipliers were an offer only
        return y, mu
    plain, count = np.zeros_like(y), active.size
    plain[active] = found[:count]
    return plain, found[count : count + mu.size] - found[count + mu.size :]
