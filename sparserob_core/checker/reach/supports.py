"""The support function of a set at polynomials, as a polynomial with an error."""

from __future__ import annotations

import numpy as np

from sparserob_core.checker.arithmetic.bernstein import bernstein
from sparserob_core.checker.arithmetic.monomials import Monomials
from sparserob_core.checker.sets.polynomials import OUTWARD, ROUNDING, lengths, rounding
from sparserob_core.checker.sets.shape import Shape
from sparserob_core.sip.convex_set import Array


def bounded(
    shape: Shape, monomials: Monomials, every: Array, errors: Array, z: Array, sharp: bool
) -> tuple[Array, Array, Array, Array]:
    """Bounds of the sum of a set's support functions at weights ``(pieces, J + 1, M, mw, b)`` that are off by at
    most ``errors``, for combinations ``z (k, b)`` of them: coefficients ``(k, J + 1, M)``, their error ``(k,)``, how
    much of that, or of the coefficients, is due to switching, and about how much of that would go in smaller boxes of
    parameters. ``sharp``: less of it where the set is round, which takes longer."""
    pieces = every.shape[0]
    mid, w, lost, error, kinks, share = _linear(shape, every, errors, z, pieces)
    k, mw = mid.shape[0], mid.shape[-1]
    if not sharp or shape.round is None:
        moved = np.einsum("ilw,iljkw->ijk", w, mid)
        return moved, error.sum(axis=1) * OUTWARD, kinks.sum(axis=1) * OUTWARD, (share * kinks).sum(axis=1)
    # of every piece the better of this linear bound and of a polynomial above the length of L'f
    m, L = shape.round
    parts = (mid @ L).reshape(-1, *mid.shape[2:4], L.shape[1])
    above, off, over = (part.reshape(k, pieces, *part.shape[1:]) for part in lengths(monomials, parts))
    spare = (lost + rounding(mw) * np.abs(mid).sum(axis=(2, 3))) @ np.abs(L)
    off = off + np.linalg.norm(spare, axis=2) + lost @ np.abs(m)
    off = (off + rounding(pieces) * np.abs(above).sum(axis=(2, 3))) * OUTWARD
    better = off < error
    linear = np.einsum("ilw,iljkw->iljk", w, mid)
    moved = np.where(better[:, :, None, None], above + mid @ m, linear).sum(axis=1)
    error, kinks = np.where(better, off, error), np.where(better, over, kinks)
    return moved, error.sum(axis=1) * OUTWARD, kinks.sum(axis=1) * OUTWARD, (share * kinks).sum(axis=1)


def _linear(
    shape: Shape, every: Array, errors: Array, z: Array, count: int
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """The weights ``(k, pieces, J + 1, M, mw)`` for combinations ``z (k, b)``, the points ``(k, pieces, mw)`` of the
    set that are best at them or nearly, what is lost of the weights, ``(k, pieces, mw)``, where up to ``count``
    pieces are added up, and by how much the points' products may be too small, ``(k, pieces)``; with what of that is
    due to switching, and about what share of this to the size of the box of parameters."""
    mid = np.einsum("ljkwb,ib->iljkw", every, z)
    rad = np.einsum("ljkwb,ib->iljkw", errors + rounding(z.shape[1]) * np.abs(every), np.abs(z)) * OUTWARD
    k, pieces, mw = mid.shape[0], mid.shape[1], mid.shape[-1]
    value, spread, of_box = _ranges(mid, rad)
    w, excess = shape.bound(value.reshape(-1, mw), spread.reshape(-1, mw))
    w, kinks = w.reshape(k, pieces, mw), excess.reshape(k, pieces) * OUTWARD
    lost = rad.sum(axis=(2, 3)) + rounding(count * mw) * np.abs(mid).sum(axis=(2, 3))
    radius = np.array(shape.radius)
    far, wide = spread @ radius, of_box @ radius
    share = np.divide(wide, far, out=np.zeros_like(far), where=far > 0.0)
    return mid, w, lost, np.einsum("ilw,ilw->il", np.abs(w), lost) * OUTWARD + kinks, kinks, share


def _ranges(mid: Array, rad: Array) -> tuple[Array, Array, Array]:
    """The ranges that weights ``(k, pieces, J + 1, M, mw)`` stay in on the cell: middles and half-widths, ``(k, pieces,
    mw)``, and what parameters have to do with these."""
    k, pieces, orders, _, mw = mid.shape
    ends = bernstein(np.moveaxis(mid[:, :, :, 0], 2, 3).reshape(-1, orders), [False]).reshape(k, pieces, mw, -1)
    highest, lowest = ends.max(axis=3), ends.min(axis=3)
    of_box = np.abs(mid[:, :, :, 1:]).sum(axis=(2, 3))
    spread = (highest - lowest) / 2 + of_box + rad.sum(axis=(2, 3)) + ROUNDING * np.abs(mid[:, :, :, 0]).sum(axis=2)
    return (highest + lowest) / 2, spread * OUTWARD, of_box
