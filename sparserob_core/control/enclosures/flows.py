"""Exponentials of a matrix on vectors, each over a duration of its own: what is made is as large as the vectors, and no
matrix is made for a duration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array

from sparserob_core.control.enclosures.decoupling import Decoupling, balance
from sparserob_core.control.enclosures.double_length import flows, product
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array

# share of entries below which products with a matrix are those of its entries: they take some ten times as long each
SPARSE = 0.1
LAST = 1e-17  # relative size of the first term of the series that is left out: less than its rounding
# Numbers of the vectors that go through the series at once (0.4 MB), so that a term of it stays near the processor.
# Without it a plant of 200 states takes a twentieth longer, and 20 MB more; with a tenth of it as long as with it.
NEAR = 50_000
# States up to which the series is a table of matrices, one product for all rows. Without it a move of an annealing walk
# (two states, a row) takes twice as long; matrices of more states are dearer than the series on the row.
FEW_STATES, TERMS = 8, 20  # and the terms of it: 1 / 20! is below 1e-18


class Exponentials(Protocol):
    """``e^{A r}`` and ``int_0^r e^{A s} ds`` of one matrix ``A (d, d)``, over any durations ``r``."""

    def rows(self, rows: Array, durations: Array) -> tuple[Array, Array]:
        """Return ``c'e^{A r}`` and ``c'int_0^r e^{A s} ds`` for ``rows (k, d)`` over ``durations (k,)``, ``(k, d)``
        each."""

    def transitions(self, durations: Array) -> tuple[Array, Array]:
        """Return ``e^{A r}`` and ``int_0^r e^{A s} ds`` for durations ``(k,)``, ``(k, d, d)`` each."""


def products(A: Array):  # type: ignore[no-untyped-def]  # an array, or one of scipy's sparse arrays
    """Return the matrix in the form whose products take the least time: sparse where few of its entries are not 0."""
    if A.shape[0] < 1.0 / SPARSE or np.count_nonzero(A) > SPARSE * A.size:  # one entry of a short row is more
        return A
    return csr_array(A)


@dataclass(frozen=True, eq=False)
class DoublingExponentials:
    """``c'e^{A r}`` and ``c'int_0^r e^{A s} ds``: by transitions over a short time and its doubles, and the exponential
    series over the rest of ``r``.

    The short time is a power of two, so that no duration is rounded, and ``|A|`` times it is at most 1: doubled, the
    transitions are those that scaling and squaring makes, and what rows go through beside is few products. So
    `exponential_rounding` bounds the rounding errors here too. Each doubling would double the rounding errors of the
    ones before. So the transitions are doubled in twice the digits, and rounded once; their integrals are floats. All
    is done in units of the states, powers of two, in which ``A`` is small: in other units there may be so many
    doublings that nothing of the result is correct.
    """

    A: Array

    @cached_property
    def step(self) -> float:
        """The short time."""
        size = _compute_norm(self._scaled_matrix)
        return float(2.0 ** np.floor(-np.log2(size))) if size > 0.0 else 1.0

    @cached_property
    def _scale(self) -> Array:
        """The units ``s (d,)``: ``e^{A r} = S e^{(S^-1 A S) r} S^-1``."""
        scale = balance(self.A)
        return scale if _compute_norm(self.A * scale / scale[:, None]) < _compute_norm(self.A) else np.ones_like(scale)

    @cached_property
    def _scaled_matrix(self) -> Array:
        """The matrix in these units."""
        return np.asarray(self.A * self._scale / self._scale[:, None])

    @cached_property
    def _doubled_transitions(self) -> list[tuple[Array, Array]]:
        """Transitions and their integrals over 1, 2, 4, ... short times, as far as they were asked for."""
        return []

    @cached_property
    def _low_order_parts(self) -> list[Array]:
        """Low-order part of the last transition of `_doubled_transitions`, in twice the digits: a list of one matrix,
        or an empty list."""
        return []

    @cached_property
    def _product_form(self):  # type: ignore[no-untyped-def]
        return products(self._scaled_matrix)

    @cached_property
    def _series_table(self) -> Array:
        """Coefficients ``(TERMS, 2 d^2)`` of ``e^{A r}`` and ``int_0^r e^{A s} ds / r`` in powers of the share of the
        short time that ``r`` is."""
        terms = [np.eye(self.A.shape[0])]
        for order in range(1, TERMS):
            terms.append(terms[-1] @ (self._scaled_matrix * self.step) / order)
        return np.array([[term, term / (order + 1)] for order, term in enumerate(terms)]).reshape(TERMS, -1)

    def _compute_transitions(self, count: int) -> list[tuple[Array, Array]]:
        """Transitions and their integrals over 1, 2, 4, ... short times, ``count`` of them, in own units."""
        while len(self._doubled_transitions) < count:
            if not self._doubled_transitions:
                flow, flow_lo, integral = flows(self._scaled_matrix * self.step)
                integral = integral * self.step
            else:
                (flow, integral), flow_lo = self._doubled_transitions[-1], self._low_order_parts.pop()
                integral = integral + flow @ integral
                flow, flow_lo = product(flow, flow_lo, flow, flow_lo)
            self._doubled_transitions.append((flow, integral))
            self._low_order_parts.append(flow_lo)
        return self._doubled_transitions[:count]

    @shaped
    def rows(
        self, rows: Float[Array, "k d"], durations: Float[Array, " k"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k d"]]:
        """`Exponentials.rows`."""
        count = max(1, NEAR // rows.shape[1])
        stacked = np.empty((2, *rows.shape))
        for start in range(0, len(rows), count):
            batch = slice(start, start + count)
            stacked[0, batch], stacked[1, batch] = self._propagate_rows(rows[batch] * self._scale, durations[batch])
        stacked /= self._scale
        return stacked[0], stacked[1]

    def _propagate_rows(self, rows: Array, durations: Array) -> tuple[Array, Array]:
        steps, remainders = self._split_durations(durations)
        propagated, integrals = np.array(rows, dtype=float), np.zeros(rows.shape)
        for bit, (flow, integral) in enumerate(self._compute_transitions(int(steps.max(initial=0)).bit_length())):
            indices = np.flatnonzero(steps >> bit & 1)
            if indices.size:
                integrals[indices] += propagated[indices] @ integral
                propagated[indices] = propagated[indices] @ flow
        return self._propagate_remainders(propagated, integrals, remainders)

    def _split_durations(self, durations: Array) -> tuple[np.ndarray, Array]:
        """Return the number of whole short times in each of ``durations (k,)``, and the rest of each."""
        durations = np.maximum(durations, 0.0)  # differences of times may be less by rounding
        steps = np.floor(durations / self.step).astype(int)
        return steps, durations - steps * self.step

    def _propagate_remainders(self, flown: Array, driven: Array, rest: Array) -> tuple[Array, Array]:
        """Return rows and their integrals, ``(k, d)`` each, propagated over the last part ``rest (k,)`` of the
        durations."""
        rest = rest[:, None]
        if self.A.shape[0] <= FEW_STATES:
            matrices = ((rest / self.step) ** np.arange(TERMS) @ self._series_table).reshape(-1, 2, *self.A.shape)
            propagated = (flown[:, None, None] @ matrices)[:, :, 0]
            return propagated[:, 0], driven + propagated[:, 1] * rest
        order, term_bound = 1, 1.0
        size = float(rest.max(initial=0.0)) / self.step  # |A r| is at most this
        term, driven = flown, driven + rest * flown
        while term_bound > LAST and size:
            term = np.asarray(term @ self._product_form) * (rest / order)
            flown, driven = flown + term, driven + term * (rest / (order + 1))
            term_bound, order = term_bound * size / order, order + 1
        return flown, driven

    @shaped
    def orbits(
        self, rows: Float[Array, "r d"], durations: Float[Array, " k"]
    ) -> tuple[Float[Array, "k r d"], Float[Array, "k r d"]]:
        """Return `rows` for every row over every duration, ``(k, r, d)`` each; whole short times that durations have in
        common at their beginning are propagated once."""
        steps, remainders = self._split_durations(durations)
        distinct_steps, inverse = np.unique(steps, return_inverse=True)
        propagated = np.array(rows[None] * self._scale, dtype=float)
        integrals, prefixes = np.zeros(propagated.shape), np.zeros(1, dtype=int)
        doubled = self._compute_transitions(int(distinct_steps.max(initial=0)).bit_length())
        for bit in range(len(doubled) - 1, -1, -1):
            beginnings, prefixes = prefixes, np.unique(distinct_steps >> bit)
            parents, odd = np.searchsorted(beginnings, prefixes >> 1), np.flatnonzero(prefixes & 1)
            propagated, integrals = propagated[parents], integrals[parents]
            odd_rows, shape = propagated[odd].reshape(-1, rows.shape[1]), (odd.size, *rows.shape)
            integrals[odd] += (odd_rows @ doubled[bit][1]).reshape(shape)
            propagated[odd] = (odd_rows @ doubled[bit][0]).reshape(shape)
        stacked = np.empty((2, durations.size, *rows.shape))
        count = max(1, NEAR // rows.size)
        for start in range(0, durations.size, count):
            batch = slice(start, start + count)
            beginnings, shape = inverse.reshape(-1)[batch], (-1, rows.shape[1])
            row_remainders = np.repeat(remainders[batch], len(rows))
            values = self._propagate_remainders(
                propagated[beginnings].reshape(shape), integrals[beginnings].reshape(shape), row_remainders
            )
            stacked[:, batch] = np.stack(values).reshape(2, beginnings.size, *rows.shape)
        stacked /= self._scale
        return stacked[0], stacked[1]

    @shaped
    def transitions(self, durations: Float[Array, " k"]) -> tuple[Float[Array, "k d d"], Float[Array, "k d d"]]:
        """Return `Exponentials.transitions`, from the rows of the identity; work arrays hold only some of the durations
        at a time."""
        return self.orbits(np.eye(self.A.shape[0]), durations)


def _compute_norm(A: Array) -> float:
    return float(np.abs(A).sum(axis=0).max())


@dataclass(frozen=True, eq=False)
class Flows:
    """``e^{D r}`` of the normal form ``D (d, d)`` of a decoupling: by scalar exponentials for groups of one block, by
    `DoublingExponentials` for the others."""

    decoupling: Decoupling
    D: Array

    @cached_property
    def _single_modes(self) -> tuple[np.ndarray, Array, np.ndarray, np.ndarray]:
        """Indices of the real modes, and their rates; and the first indices of rotations ``[[a, b], [-b, a]]``, and
        ``a + ib``."""
        singles = [block for block, single in self.decoupling.parts if single]
        real = np.array([block.start for block in singles if block.stop == block.start + 1], dtype=int)
        turning = np.array([block.start for block in singles if block.stop == block.start + 2], dtype=int)
        return real, self.D[real, real], turning, self.D[turning, turning] + 1j * self.D[turning, turning + 1]

    @cached_property
    def _groups(self) -> list[tuple[slice, DoublingExponentials, DoublingExponentials]]:
        """The groups of several blocks, each with its `DoublingExponentials` on rows and on columns."""
        pairs = [(block, self.D[block, block]) for block, single in self.decoupling.parts if not single]
        return [(block, DoublingExponentials(D), DoublingExponentials(np.ascontiguousarray(D.T))) for block, D in pairs]

    @shaped
    def rows(
        self, rows: Float[Array, "k r d"], durations: Float[Array, " k"]
    ) -> tuple[Float[Array, "k r d"], Float[Array, "k r d"]]:
        """``c'e^{D r}`` and ``c'int_0^r e^{D s} ds``, ``(k, r, d)`` each, of ``rows (k, r, d)`` over ``durations
        (k,)``."""
        return self._apply_exponentials(rows, durations, transposed=False)

    @shaped
    def columns(
        self, states: Float[Array, "k d"], drives: Float[Array, "k d"], durations: Float[Array, " k"]
    ) -> Float[Array, "k d"]:
        """Return the states ``(k, d)`` after ``durations (k,)`` under constant ``drives (k, d)``, from
        ``states (k, d)``."""
        propagated, integrals = self._apply_exponentials(np.stack([states, drives], axis=1), durations, transposed=True)
        return propagated[:, 0] + integrals[:, 1]

    def _apply_exponentials(self, rows: Array, durations: Array, transposed: bool) -> tuple[Array, Array]:
        propagated, integrals = np.empty((2, *rows.shape))
        real, rates, turning, spins = self._single_modes
        late = durations[:, None]
        if real.size:
            exponentials, exponential_integrals = np.exp(rates * late), _integrate_exponentials(rates, late)
            propagated[..., real], integrals[..., real] = (
                rows[..., real] * exponentials[:, None],
                rows[..., real] * exponential_integrals[:, None],
            )
        if turning.size:
            spins = spins.conj() if transposed else spins
            points = rows[..., turning] + 1j * rows[..., turning + 1]
            for target, factor in (
                (propagated, np.exp(spins * late)),
                (integrals, _integrate_exponentials(spins, late)),
            ):
                values = points * factor[:, None]
                target[..., turning], target[..., turning + 1] = values.real, values.imag
        for block, along, across in self._groups:
            block_rows = np.ascontiguousarray(rows[..., block]).reshape(-1, block.stop - block.start)
            row_durations = np.repeat(durations, rows.shape[1])
            for target, values in zip(
                (propagated, integrals), (across if transposed else along).rows(block_rows, row_durations), strict=True
            ):
                target[..., block] = values.reshape(*rows.shape[:-1], -1)
        return propagated, integrals


def _integrate_exponentials(rates: np.ndarray, durations: Array) -> np.ndarray:
    """``int_0^r e^{a s} ds`` of rates ``a (q,)`` over durations ``r (k, 1)``, ``(k, q)``."""
    safe = np.where(rates == 0, 1.0, rates)
    return np.where(rates == 0, durations, np.expm1(safe * durations) / safe)
