"""The size of a row, in numbers that a user can read: a claim may excuse a billionth of it (decision 0088).

The size of ``c'x + g'u <= b`` is the largest of its bound ``|b|``, the width between it and its opposite row, and the
largest ``|c'x(t) + g'u(t)|`` along the nominal trajectory of a decision. What the plant could reach without that
decision plays no part: of an unstable plant that grows like ``e^{At}``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.reach.functional import WorstFunctionals

PARALLEL = 1e-14  # of the largest entry: rows that differ by less are opposite ones
# Breakpoints at which the nominal trajectory is looked at. A tenth of them may miss most of a swing, and a proof then
# excuses less than it may; with ten times as many, programs of many states take longer and excuse hardly more.
LOOKED_AT = 64


def widths(H: Array, h: Array) -> Array:
    """Return the width ``h + h'`` between each row of ``H x <= h`` and the nearest opposite one, ``(r,)``.

    Parameters
    ----------
    H, h : Array
        Rows ``(r, d)`` and bounds ``(r,)``.

    Returns
    -------
    Array
        Widths ``(r,)``, infinite for a row without an opposite one.
    """
    width = np.full(h.size, np.inf)
    sizes = np.abs(H).max(axis=1, initial=0.0)
    for row in range(h.size):
        share = sizes[row] / np.where(sizes > 0.0, sizes, 1.0)
        opposite = (np.abs(H[row] + H * share[:, None]) <= PARALLEL * sizes[row]).all(axis=1)
        width[row] = float(np.min(np.abs(h[row] + h[opposite] * share[opposite]), initial=np.inf))
    return width


def row_sizes(H: Array, h: Array) -> Array:
    """Return the sizes ``(r,)`` that the rows ``H x <= h`` have by themselves: bound or width, the larger one."""
    width = widths(H, h)
    return np.maximum(np.abs(h), np.where(np.isfinite(width), width, 0.0))


def nominal_sizes(functionals: WorstFunctionals, x: Array, H: Array, G: Array | None = None) -> Array:
    """Return the largest ``|H x(t) + G u(t)|`` along the nominal trajectory of a decision.

    Parameters
    ----------
    functionals : WorstFunctionals
        The functionals of the state.
    x : Array
        The decision ``(n,)``.
    H, G : Array
        Rows on the state ``(r, d)``, and on the control ``(r, m)`` where they look at it.

    Returns
    -------
    Array
        Sizes ``(r,)``, seen at the beginnings of some pieces and at the end: never more than the true ones.
    """
    nominal, parameters = functionals.central(), functionals.response.system.parameters
    breakpoints = nominal.response.grid.breakpoints
    chosen = np.linspace(0, breakpoints.size - 1, min(breakpoints.size, LOOKED_AT)).round().astype(int)
    times = breakpoints[np.unique(chosen)]
    rows, point = np.tile(H, (times.size, 1)), np.zeros(0) if parameters is None else nominal_point(parameters)
    flat_values = nominal.values(x, np.repeat(times, len(H)), rows, np.tile(point, (len(rows), 1)))
    values = flat_values.reshape(times.size, len(H))
    if G is not None:
        starts = nominal.dictionary.breakpoints[:-1]
        pieces = np.clip(np.searchsorted(starts, times, side="right") - 1, 0, starts.size - 1)
        values = values + nominal.control(x)[:, pieces].T @ G.T
    return np.asarray(np.abs(values).max(axis=0))
