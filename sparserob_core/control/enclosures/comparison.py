"""How large the parts of a linear system's state can become, block by block: comparison systems.

For ``z' = A z`` in blocks ``z_1, ..., z_q``, the norms obey ``|z_j|' <= mu(A_jj) |z_j| + sum_k |A_jk| |z_k|`` with the
logarithmic norm ``mu`` (Dahlquist 1958), so ``|z(r)| <= e^{M r} |z(0)|`` entry by entry, with ``M`` of these numbers
(Strom 1975, section 4; Bellman 1962). ``M`` is as stable as the blocks are, where one norm of all of ``A`` would count
the fastest decay as the fastest growth; and it does not change when a block is measured in another unit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.matrix_exponential import transitions
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array

SAFE = 1.0 + 1e-6  # on every bound: sums of numbers of one sign, whose rounding is far below this
KEPT = 64


@shaped
def block_norms(values: Float[Array, "*k d"], starts: Int[np.ndarray, " q"]) -> Float[Array, "*k q"]:
    """Norms ``(..., q)`` of the blocks of vectors ``(..., d)``."""
    return np.asarray(np.sqrt(np.add.reduceat(values * values, starts, axis=-1)))


@shaped
def block_sizes(matrices: Float[Array, "*k d d"], starts: Int[np.ndarray, " q"]) -> Float[Array, "*k q q"]:
    """Norms ``(..., q, q)`` of the blocks of matrices ``(..., d, d)``, at most too large (Frobenius)."""
    rows = np.add.reduceat(matrices * matrices, starts, axis=-2)
    return np.asarray(np.sqrt(np.add.reduceat(rows, starts, axis=-1)))


@shaped
def comparison_matrix(D: Float[Array, "d d"], starts: Int[np.ndarray, " q"]) -> Float[Array, "q q"]:
    """``M (q, q)`` of a matrix ``D (d, d)``: logarithmic norms of the diagonal blocks, norms of the others."""
    M = block_sizes(D, starts)
    ends = np.append(starts[1:], D.shape[0])
    for i, (start, stop) in enumerate(zip(starts, ends, strict=True)):
        block = D[start:stop, start:stop]
        M[i, i] = block[0, 0] if stop == start + 1 else np.linalg.eigvalsh((block + block.T) / 2)[-1]
    return M


class Reach(NamedTuple):
    """Bounds for all durations ``r <= width``, ``(k, q, q)`` each: of ``|e^{A r}|`` at the end, ``r = width``
    (``flow``), and of ``int_0^r |e^{A s}| ds``, ``|e^{A r}|`` and ``|e^{A r} - I|`` up to there."""

    flow: Array
    integral: Array
    peak: Array
    departure: Array


@dataclass(frozen=True, eq=False)
class ComparisonSystem:
    """Bounds for ``z' = A z``: ``metzler (q, q)`` is ``M``, ``sizes (q, q)`` the norms of the blocks of ``A``."""

    metzler: Array
    sizes: Array
    _known: dict[bytes, Reach] = field(default_factory=dict, repr=False)

    def over(self, widths: Array) -> Reach:
        """The bounds for ``widths (k,)``.

        With ``M = P - N``, ``P >= 0`` and ``N >= 0`` diagonal, ``e^{M r} <= I + P int_0^r e^{M s} ds``: a stable
        system stays bounded however long it runs.
        """
        key = widths.tobytes()
        if key not in self._known:
            remember(self._known, key, self._over(widths), KEPT)
        return self._known[key]

    @cached_property
    def rising(self) -> Array:
        """``P``: ``M`` without what decays."""
        return np.where(np.eye(self.metzler.shape[0]) > 0, np.maximum(self.metzler, 0.0), self.metzler)

    @shaped
    def slips(
        self, slack: Float[Array, "q q"], widths: Float[Array, " k"]
    ) -> tuple[Float[Array, "k q q"], Float[Array, "k q q"]]:
        """How much ``e^{(A + S) r}`` and its integral differ from those of ``A`` at ``r = width``, for any ``S`` with
        blocks of norm ``slack (q, q)``: ``(k, q, q)`` each.

        The difference is ``int_0^r e^{A (r - s)} S e^{(A + S) s} ds``, which is a block of one exponential.
        """
        q = slack.shape[0]
        both = np.block([[self.metzler, slack], [np.zeros((q, q)), self.metzler + slack]])
        distinct, which = np.unique(widths, return_inverse=True)
        with np.errstate(over="ignore", invalid="ignore"):
            flow, integral = (finite(SAFE * part[:, :q, q:]) for part in transitions(both, distinct))
        return flow[which.reshape(-1)], integral[which.reshape(-1)]

    def _over(self, widths: Array) -> Reach:
        distinct, which = np.unique(widths, return_inverse=True)
        one = np.eye(self.metzler.shape[0])
        with np.errstate(over="ignore", invalid="ignore"):
            flow, integral = (finite(SAFE * part) for part in transitions(self.metzler, distinct))
            peak = one + SAFE * product(self.rising, integral)
            departure = np.minimum(SAFE * product(self.sizes, integral), one + peak)
        return Reach(*(part[which.reshape(-1)] for part in (flow, integral, peak, departure)))


def finite(values: Array) -> Array:
    """Bounds; those that overflowed are infinite."""
    return np.where(np.isnan(values), np.inf, np.maximum(values, 0.0))


def product(left: Array, right: Array) -> Array:
    """The product of matrices of bounds, in which nothing times infinity is nothing."""
    if np.isfinite(left).all() and np.isfinite(right).all():
        return np.asarray(left @ right)
    with np.errstate(invalid="ignore"):
        terms = left[..., :, :, None] * right[..., None, :, :]
    return np.asarray(np.where(np.isnan(terms), 0.0, terms).sum(axis=-2))
