"""Comparison systems: bounds of the norms of the parts of a linear system's state, block by block.

For ``z' = A z`` in blocks ``z_1, ..., z_q``, the norms obey ``|z_j|' <= mu(A_jj) |z_j| + sum_k |A_jk| |z_k|`` with the
logarithmic norm ``mu`` (Dahlquist 1958). So ``|z(r)| <= e^{M r} |z(0)|`` entry by entry, with ``M`` of these numbers
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
# neighbouring durations share a bound if they differ by at most this share of them and `NOTHING` of the longest
EQUAL = 1e-9
NOTHING = 1e-12
STORAGE_LIMIT = (
    10_000_000  # numbers in the matrices of one kind, beyond which durations that differ by `NEAR` share one too
)
NEAR = 1e-2
# Multiplications that exponentials of cells, and of slack, may take, beyond which those whose widths differ by `WIDE`
# share one: with ten times as many, a look at a plant of 350 states, at cells of hundreds of widths, takes half a
# minute; with a tenth, bounds of plants of 50 states are rougher than they need be.
WORK, WIDE = 5e7, 0.2
BITS = 30  # to which the ends of durations that differ are rounded outwards
AT_ONCE = 4_000_000  # numbers of the exponentials that are made at a time
SMALL = 256  # numbers in the matrices of one kind, up to which it is not looked for durations that are alike
FEW = 4  # times as many durations as matrices, from which every matrix is applied to all its durations at once
APART = 1e-6  # what couples the blocks, added up over a duration, up to which its third power is below all rounding
LONG = 256  # equal durations from which what adds up over them is summed in blocks


@shaped
def block_norms(values: Float[Array, "*k d"], starts: Int[np.ndarray, " q"]) -> Float[Array, "*k q"]:
    """Norms ``(..., q)`` of the blocks of vectors ``(..., d)``."""
    return np.asarray(np.sqrt(np.add.reduceat(values * values, starts, axis=-1)))


@shaped
def block_sizes(matrices: Float[Array, "*k d d"], starts: Int[np.ndarray, " q"]) -> Float[Array, "*k q q"]:
    """Return upper bounds ``(..., q, q)`` of the 2-norms of the blocks of matrices ``(..., d, d)``: Frobenius norms."""
    rows = np.add.reduceat(matrices * matrices, starts, axis=-2)
    return np.asarray(np.sqrt(np.add.reduceat(rows, starts, axis=-1)))


@shaped
def comparison_matrix(D: Float[Array, "d d"], starts: Int[np.ndarray, " q"]) -> Float[Array, "q q"]:
    """Return ``M (q, q)`` of a matrix ``D (d, d)``: logarithmic 2-norms of the diagonal blocks, Frobenius norms of the
    others."""
    M = block_sizes(D, starts)
    ends = np.append(starts[1:], D.shape[0])
    for i, (start, stop) in enumerate(zip(starts, ends, strict=True)):
        block = D[start:stop, start:stop]
        M[i, i] = block[0, 0] if stop == start + 1 else np.linalg.eigvalsh((block + block.T) / 2)[-1]
    return M


@dataclass(frozen=True, eq=False)
class NormBounds:
    """A matrix of bounds for each of ``k`` durations: ``matrices (u, q', q)``, and the index ``which (k,)`` of the
    matrix of each duration. Durations that are nearly equal share one matrix, which holds for all of them."""

    matrices: Array
    which: np.ndarray

    @property
    def transposed(self) -> NormBounds:
        """The bounds on rows, where these are on columns."""
        return NormBounds(np.swapaxes(self.matrices, 1, 2), self.which)

    @shaped
    def on(self, norms: Float[Array, "*r k q"]) -> Float[Array, "*r k p"]:
        """Return the products ``(..., k, q')`` of the matrix of each duration with block norms ``(..., k, q)`` of its
        own."""
        if self.matrices.shape[0] == 1:
            return product(norms, self.matrices[0].T)
        if self.which.size < FEW * self.matrices.shape[0] and self.matrices[0].size * self.which.size <= STORAGE_LIMIT:
            return np.asarray(product(self.matrices[self.which], norms[..., None])[..., 0])
        bounds = np.empty((*norms.shape[:-1], self.matrices.shape[1]))
        for number, indices in enumerate(self._duration_indices):
            bounds[..., indices, :] = product(norms[..., indices, :], self.matrices[number].T)
        return bounds

    @shaped
    def summed(self, start: Float[Array, "*r q"], added: Float[Array, "*r k q"]) -> Float[Array, "*r points q"]:
        """Return the ``k + 1`` vectors of bounds that begin at ``start (..., q)``.

        Each duration multiplies the vector by its matrix and then adds its row of ``added (..., k, q)``.
        """
        sums = np.empty((*added.shape[:-2], added.shape[-2] + 1, added.shape[-1]))
        sums[..., 0, :], sums[..., 1:, :] = start, added
        with np.errstate(over="ignore", invalid="ignore"):
            if self.matrices.shape[0] == 1 and self.which.size >= LONG:
                self._sum_in_blocks(sums)
            else:
                for step, number in enumerate(self.which.tolist()):
                    sums[..., step + 1, :] += sums[..., step, :] @ self.matrices[number].T
        if not np.isfinite(sums).all():  # something is infinite, and 0 times infinity is to be 0
            sums[..., 0, :], sums[..., 1:, :] = start, added
            for step, number in enumerate(self.which.tolist()):
                sums[..., step + 1, :] += product(sums[..., step, None, :], self.matrices[number].T)[..., 0, :]
        return sums

    def _sum_in_blocks(self, found: Array) -> None:
        """Turn ``found``, which holds ``start`` and ``added``, into the result of `summed` for one matrix.

        The sums are taken first from 0 in every block of as many durations, all blocks at once. After that the bounds
        that grow from the vector at the beginning of each block are added.
        """
        flow, size, count = self.matrices[0].T, int(np.sqrt(self.which.size)), self.which.size
        blocks, q = count // size, flow.shape[0]
        inside = found[..., 1 : blocks * size + 1, :].reshape(*found.shape[:-2], blocks, size, q)
        for step in range(1, size):
            inside[..., step, :] += inside[..., step - 1, :] @ flow
        powers = [flow]  # the bounds over 1, 2, 3, ... durations
        while len(powers) < size:
            powers.append(powers[-1] @ flow)
        start, joined_powers = found[..., 0, :], np.concatenate(powers, axis=1)
        for block in range(blocks):
            inside[..., block, :, :] += (start @ joined_powers).reshape(*start.shape[:-1], size, q)
            start = inside[..., block, -1, :]
        found[..., 1 : blocks * size + 1, :] = inside.reshape(*found.shape[:-2], blocks * size, q)
        for step in range(blocks * size, count):
            found[..., step + 1, :] += found[..., step, :] @ flow

    @cached_property
    def _duration_indices(self) -> list[np.ndarray]:
        order = np.argsort(self.which, kind="stable")
        return np.split(order, np.cumsum(np.bincount(self.which, minlength=self.matrices.shape[0]))[:-1])


class Reach(NamedTuple):
    """Bounds for durations ``width (k,)``: of ``|e^{A r}|`` at the end, ``r = width`` (``flow``), and for all
    ``r <= width`` of ``int_0^r |e^{A s}| ds``, ``|e^{A r}|`` and ``|e^{A r} - I|``."""

    flow: NormBounds
    integral: NormBounds
    peak: NormBounds
    departure: NormBounds


@dataclass(frozen=True, eq=False)
class ComparisonSystem:
    """Bounds for ``z' = A z``: ``metzler (q, q)`` is ``M``, and ``sizes (q, q)`` bounds the norms of the blocks of
    ``A``."""

    metzler: Array
    sizes: Array
    _cached_bounds: dict[bytes, tuple[Array, Array, Array, Array]] = field(default_factory=dict, repr=False)

    def over(self, widths: Array, cells: bool = False) -> Reach:
        """Return the bounds for ``widths (k,)``; the bounds of ``cells``, which may be halved, are rougher where they
        are many.

        With ``M = P - N``, ``P >= 0`` and ``N >= 0`` diagonal, ``e^{M r} <= I + P int_0^r e^{M s} ds``: a stable system
        stays bounded however long it runs.
        """
        if widths.size * self.sizes.size <= SMALL:  # each for itself: it takes longer to see which are alike
            shortest, longest, groups = widths, widths, np.arange(widths.size)
        else:
            shortest, longest, groups = alike(widths, self.sizes.size, rough=cells)
        key = shortest.tobytes() + longest.tobytes()
        if key not in self._cached_bounds:
            capacity = STORAGE_LIMIT // max(1, shortest.size * self.sizes.size)
            remember(self._cached_bounds, key, self._compute_bounds(shortest, longest), max(1, min(KEPT, capacity)))
        return Reach(*(NormBounds(bounds, groups) for bounds in self._cached_bounds[key]))

    @cached_property
    def rising(self) -> Array:
        """``P``: ``M`` with the negative entries of its diagonal set to 0."""
        return rising(self.metzler)

    @shaped
    def slips(self, slack: Float[Array, "q q"], widths: Float[Array, " k"]) -> tuple[NormBounds, NormBounds]:
        """Return bounds of the difference of ``e^{(A + S) r}``, and of its integral, from those of ``A`` at
        ``r = width (k,)``.

        The bounds hold for any ``S`` with blocks of norm at most ``slack (q, q)``. The difference is
        ``int_0^r e^{A (r - s)} S e^{(A + S) s} ds``, which is a block of one exponential.
        """
        q = slack.shape[0]
        both = np.block([[self.metzler, slack], [np.zeros((q, q)), self.metzler + slack]])
        # however rough, they are as small as the slack
        shortest, longest, groups = alike(widths, both.size, rough=True)
        with np.errstate(over="ignore", invalid="ignore"):
            flow, integral = (matrices[:, :q, q:] for matrices in flows_between(both, shortest, longest))
        return NormBounds(flow, groups), NormBounds(integral, groups)

    def _compute_bounds(self, shortest: Array, longest: Array) -> tuple[Array, Array, Array, Array]:
        identity = np.eye(self.metzler.shape[0])
        with np.errstate(over="ignore", invalid="ignore"):
            rates = np.diagonal(self.metzler)
            coupling = self.metzler - np.diag(rates)
            if rates.size * coupling.max() * longest.max(initial=0.0) <= APART:
                flow, integral = flows_apart(rates, coupling, shortest, longest)
            else:
                flow, integral = flows_between(self.metzler, shortest, longest)
            peak = identity + SAFE * product(self.rising, integral)
            departure = np.minimum(SAFE * product(self.sizes, integral), identity + peak)
        return flow, integral, peak, departure


@shaped
def alike(
    durations: Float[Array, " k"], numbers: int, rough: bool = False
) -> tuple[Float[Array, " u"], Float[Array, " u"], Int[np.ndarray, " k"]]:
    """Group nearly equal durations.

    Parameters
    ----------
    durations : array (k,)
        The durations.
    numbers : int
        Numbers to be kept for every group, in a square matrix.
    rough : bool
        True where groups may be wide, to save time.

    Returns
    -------
    array (u,), array (u,), array (k,)
        The shortest and the longest duration of each group, rounded outwards where they differ; and the group of each
        duration.
    """
    distinct, inverse = np.unique(durations, return_inverse=True)
    nothing, share = NOTHING * distinct.max(initial=0.0), EQUAL
    group = np.cumsum(np.diff(distinct, prepend=distinct[:1]) > share * distinct + nothing)
    count = int(group[-1]) + 1 if group.size else 0
    ratio = WIDE if rough and count * numbers**1.5 > WORK else NEAR if count * numbers > STORAGE_LIMIT else 0.0
    if ratio:  # in steps of a ratio, where there are very many
        steps = np.floor(np.log(np.maximum(distinct, nothing) / nothing) / np.log1p(ratio))
        group = np.unique(steps, return_inverse=True)[1]
    first = np.flatnonzero(np.diff(group, prepend=-1))
    shortest, longest = distinct[first], distinct[np.append(first, distinct.size)[1:] - 1]
    differ = shortest < longest
    shortest = np.where(differ, _round_to_side(shortest, np.floor), shortest)
    return shortest, np.where(differ, _round_to_side(longest, np.ceil), longest), group[inverse.reshape(-1)]


def _round_to_side(values: Array, to: np.ufunc) -> Array:
    """Return numbers rounded ``to`` one side, to ``BITS`` bits, so that most numbers that differ by rounding become
    equal."""
    mantissa, exponent = np.frexp(values)
    return np.asarray(np.ldexp(to(np.ldexp(mantissa, BITS)), exponent - BITS))


def flows_between(metzler: Array, shortest: Array, longest: Array) -> tuple[Array, Array]:
    """Bounds ``(u, q, q)`` of ``e^{M r}`` for all ``r`` from ``shortest`` to ``longest (u,)``, and of its integral
    until the longest."""
    differ = np.flatnonzero(shortest < longest)
    durations = np.concatenate([shortest, longest[differ] - shortest[differ]])
    flow, integral = np.empty((2, durations.size, *metzler.shape))
    step = max(1, AT_ONCE // (4 * metzler.size))
    for start in range(0, durations.size, step):
        batch = slice(start, start + step)
        flow[batch], integral[batch] = (finite(SAFE * bound) for bound in transitions(metzler, durations[batch]))
    flow = flow[: shortest.size]
    if differ.size:  # e^{M (r + s)} = e^{M r} e^{M s}
        extra_integral, integral = integral[shortest.size :], integral[: shortest.size].copy()
        early_flow, identity = flow[differ], np.eye(metzler.shape[0])
        integral[differ] += SAFE * product(early_flow, extra_integral)
        flow[differ] = product(early_flow, identity + SAFE * product(rising(metzler), extra_integral))
    return flow, integral


def flows_apart(rates: Array, coupling: Array, shortest: Array, longest: Array) -> tuple[Array, Array]:
    """Return the bounds of `flows_between` for ``M = D + S``, with scalar exponentials only.

    ``D`` is diagonal with ``rates (q,)``, ``S >= 0`` is the ``coupling (q, q)``, and ``q`` times its largest entry
    times the longest duration is at most 1/2.

    The bounds are from Duhamel's series ``e^{M r} = e^{D r} + int_0^r e^{D (r - s)} S e^{D s} ds + ...``, all of whose
    terms grow with ``S``. The term of first order is ``S_ij`` times the divided difference of ``e^{x r}`` at the rates
    ``i`` and ``j``. That is ``e^{b r} (e^{(a - b) r} - 1) / (a - b)`` with the larger rate ``b``, whose last factor
    rises with ``r``. Its integral, over ``0 <= s <= t <= r``, is at most that over the square, and at most the area of
    the triangle times the largest value. The other terms are at most ``r^k S^k / k!`` times ``e^{r max(0, D)}``, and
    ``S^k`` is at most ``q^{k - 1} s^k`` with the largest coupling ``s``.
    """
    q, early, late = rates.size, shortest[:, None], longest[:, None]
    diagonal_flow, diagonal_integral = np.exp(rates * np.where(rates < 0, early, late)), _integrate_growth(rates, late)
    larger, difference = np.maximum.outer(rates, rates), -np.abs(np.subtract.outer(rates, rates))
    early, late = early[..., None], late[..., None]
    share = np.exp(larger * np.where(larger < 0, early, late)) * _integrate_growth(difference, late)
    triangle = late**2 / 2 * np.exp(np.maximum(larger, 0.0) * late)
    twice = np.minimum(diagonal_integral[:, :, None] * diagonal_integral[:, None, :], triangle)
    third = (q * coupling.max() * late) ** 3 / (5 * q)  # e^x - 1 - x - x^2 / 2 <= x^3 / 5 where x <= 1/2
    higher = _scale_couplings(
        late**2 / 2 * product(coupling, coupling) + third, np.exp(max(0.0, float(rates.max())) * late)
    )
    flow, integral = _scale_couplings(coupling, share) + higher, _scale_couplings(coupling, twice) + late * higher
    indices = np.arange(q)
    flow[:, indices, indices] += diagonal_flow
    integral[:, indices, indices] += diagonal_integral
    return finite(SAFE * flow), finite(SAFE * integral)


def _scale_couplings(couplings: Array, growth: Array) -> Array:
    """Return couplings times their growth, where a coupling of 0 gives 0 even if the growth is infinite."""
    return np.asarray(np.where(couplings > 0, couplings * growth, 0.0))


def _integrate_growth(rates: Array, durations: Array | float) -> Array:
    """The integrals ``(e^{a r} - 1) / a`` of what grows at ``rates`` ``a`` over ``durations`` ``r``."""
    safe = np.where(rates == 0, 1.0, rates)
    return np.asarray(np.where(rates == 0, durations, np.expm1(safe * durations) / safe))


def rising(metzler: Array) -> Array:
    """Return a comparison matrix ``(q, q)`` with the negative entries of its diagonal set to 0."""
    return np.where(np.eye(metzler.shape[0]) > 0, np.maximum(metzler, 0.0), metzler)


def finite(values: Array) -> Array:
    """Return bounds that are at least 0, and infinite where they overflowed."""
    return np.where(np.isnan(values), np.inf, np.maximum(values, 0.0))


def product(left: Array, right: Array) -> Array:
    """Return the product of matrices of bounds, in which 0 times infinity is 0; NaN is taken for infinity."""
    largest = np.maximum.reduce(left, axis=None, initial=0.0), np.maximum.reduce(right, axis=None, initial=0.0)
    if largest[0] < np.inf and largest[1] < np.inf:  # and is a number
        return np.asarray(left @ right)
    infinite_left, infinite_right = ~np.isfinite(left), ~np.isfinite(right)
    infinite_terms = (infinite_left * 1.0) @ (infinite_right | (right > 0)) + (left > 0) @ (infinite_right * 1.0)
    finite_product = np.where(infinite_left, 0.0, left) @ np.where(infinite_right, 0.0, right)
    return np.asarray(np.where(infinite_terms > 0, np.inf, finite_product))
