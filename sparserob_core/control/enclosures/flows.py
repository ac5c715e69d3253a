"""Exponentials of a matrix on vectors, each over a duration of its own: what is made is as large as the vectors, and no
matrix is made for a duration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

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
        """Both of ``rows (k, d)`` over ``durations (k,)``, ``(k, d)`` each."""

    def transitions(self, durations: Array) -> tuple[Array, Array]:
        """Both as matrices, for durations ``(k,)``: ``(k, d, d)`` each."""


def products(A: Array):  # type: ignore[no-untyped-def]  # an array, or one of scipy's sparse arrays
    """The matrix as products with it take the least time: that of its entries where few of them are not 0."""
    if A.shape[0] < 1.0 / SPARSE or np.count_nonzero(A) > SPARSE * A.size:  # one entry of a short row is more
        return A
    from scipy.sparse import csr_array

    return csr_array(A)


@dataclass(frozen=True, eq=False)
class Leaps:
    """``c'e^{A r}`` and ``c'int_0^r e^{A s} ds``: by transitions over a short time and its doubles, and the exponential
    series over what is left of ``r``.

    The short time is a power of two, so that no duration is rounded, and ``|A|`` times it is at most 1: doubled, the
    transitions are those that scaling and squaring makes, and what rows go through beside is few products. So
    `exponential_rounding` bounds what is rounded here too. Each doubling would double what the ones before have
    rounded; so they are made in twice the digits, and rounded once. All is done in units of the states, powers of two,
    in which ``A`` is small: in units of somebody else, the doubles of a time may be too many for any of it to be seen.
    """

    A: Array

    @cached_property
    def step(self) -> float:
        """The short time."""
        size = _norm(self._own)
        return float(2.0 ** np.floor(-np.log2(size))) if size > 0.0 else 1.0

    @cached_property
    def _scale(self) -> Array:
        """The units ``s (d,)``: ``e^{A r} = S e^{(S^-1 A S) r} S^-1``."""
        scale = balance(self.A)
        return scale if _norm(self.A * scale / scale[:, None]) < _norm(self.A) else np.ones_like(scale)

    @cached_property
    def _own(self) -> Array:
        """The matrix in these units."""
        return np.asarray(self.A * self._scale / self._scale[:, None])

    @cached_property
    def _doubled(self) -> list[tuple[Array, Array]]:
        """Transitions and their integrals over 1, 2, 4, ... short times, as far as they were asked for."""
        return []

    @cached_property
    def _lost(self) -> list[Array]:
        """What the last of these transitions is rounded by."""
        return []

    @cached_property
    def _products(self):  # type: ignore[no-untyped-def]
        return products(self._own)

    @cached_property
    def _table(self) -> Array:
        """Coefficients ``(TERMS, 2 d^2)`` of ``e^{A r}`` and ``int_0^r e^{A s} ds / r`` in powers of the share of the
        short time that ``r`` is."""
        terms = [np.eye(self.A.shape[0])]
        for order in range(1, TERMS):
            terms.append(terms[-1] @ (self._own * self.step) / order)
        return np.array([[term, term / (order + 1)] for order, term in enumerate(terms)]).reshape(TERMS, -1)

    def _over(self, count: int) -> list[tuple[Array, Array]]:
        """Transitions and their integrals over 1, 2, 4, ... short times, ``count`` of them, in own units."""
        while len(self._doubled) < count:
            if not self._doubled:
                flow, lost, driven = flows(self._own * self.step)
                driven = driven * self.step
            else:
                (flow, driven), lost = self._doubled[-1], self._lost.pop()
                driven = driven + flow @ driven
                flow, lost = product(flow, lost, flow, lost)
            self._doubled.append((flow, driven))
            self._lost.append(lost)
        return self._doubled[:count]

    @shaped
    def rows(
        self, rows: Float[Array, "k d"], durations: Float[Array, " k"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k d"]]:
        """`Exponentials.rows`."""
        count = max(1, NEAR // rows.shape[1])
        found = np.empty((2, *rows.shape))
        for start in range(0, len(rows), count):
            part = slice(start, start + count)
            found[0, part], found[1, part] = self._rows(rows[part] * self._scale, durations[part])
        found /= self._scale
        return found[0], found[1]

    def _rows(self, rows: Array, durations: Array) -> tuple[Array, Array]:
        whole, rest = self._parted(durations)
        flown, driven = np.array(rows, dtype=float), np.zeros(rows.shape)
        for place, (flow, integral) in enumerate(self._over(int(whole.max(initial=0)).bit_length())):
            far = np.flatnonzero(whole >> place & 1)
            if far.size:
                driven[far] += flown[far] @ integral
                flown[far] = flown[far] @ flow
        return self._through(flown, driven, rest)

    def _parted(self, durations: Array) -> tuple[np.ndarray, Array]:
        """How many short times durations ``(k,)`` have, and what is left of them."""
        durations = np.maximum(durations, 0.0)  # differences of times may be less by rounding
        whole = np.floor(durations / self.step).astype(int)
        return whole, durations - whole * self.step

    def _through(self, flown: Array, driven: Array, rest: Array) -> tuple[Array, Array]:
        """What ``rest (k,)`` of the durations makes of both of rows, ``(k, d)`` each."""
        rest = rest[:, None]
        if self.A.shape[0] <= FEW_STATES:
            both = ((rest / self.step) ** np.arange(TERMS) @ self._table).reshape(-1, 2, *self.A.shape)
            moved = (flown[:, None, None] @ both)[:, :, 0]
            return moved[:, 0], driven + moved[:, 1] * rest
        order, left = 1, 1.0
        size = float(rest.max(initial=0.0)) / self.step  # |A r| is at most this
        term, driven = flown, driven + rest * flown
        while left > LAST and size:
            term = np.asarray(term @ self._products) * (rest / order)
            flown, driven = flown + term, driven + term * (rest / (order + 1))
            left, order = left * size / order, order + 1
        return flown, driven

    @shaped
    def orbits(
        self, rows: Float[Array, "r d"], durations: Float[Array, " k"]
    ) -> tuple[Float[Array, "k r d"], Float[Array, "k r d"]]:
        """`rows` where each goes over every duration: what durations begin with, in short times, is gone over once."""
        whole, rest = self._parted(durations)
        wholes, which = np.unique(whole, return_inverse=True)
        flown = np.array(rows[None] * self._scale, dtype=float)
        driven, numbers = np.zeros(flown.shape), np.zeros(1, dtype=int)
        doubled = self._over(int(wholes.max(initial=0)).bit_length())
        for place in range(len(doubled) - 1, -1, -1):
            begun, numbers = numbers, np.unique(wholes >> place)
            before, odd = np.searchsorted(begun, numbers >> 1), np.flatnonzero(numbers & 1)
            flown, driven = flown[before], driven[before]
            through, shape = flown[odd].reshape(-1, rows.shape[1]), (odd.size, *rows.shape)
            driven[odd] += (through @ doubled[place][1]).reshape(shape)
            flown[odd] = (through @ doubled[place][0]).reshape(shape)
        found = np.empty((2, durations.size, *rows.shape))
        count = max(1, NEAR // rows.size)
        for start in range(0, durations.size, count):
            part = slice(start, start + count)
            begun, shape = which.reshape(-1)[part], (-1, rows.shape[1])
            late = np.repeat(rest[part], len(rows))
            both = self._through(flown[begun].reshape(shape), driven[begun].reshape(shape), late)
            found[:, part] = np.stack(both).reshape(2, begun.size, *rows.shape)
        found /= self._scale
        return found[0], found[1]

    @shaped
    def transitions(self, durations: Float[Array, " k"]) -> tuple[Float[Array, "k d d"], Float[Array, "k d d"]]:
        """`Exponentials.transitions`, of the rows of the identity: few of them at once are in the making."""
        return self.orbits(np.eye(self.A.shape[0]), durations)


def _norm(A: Array) -> float:
    return float(np.abs(A).sum(axis=0).max())


@dataclass(frozen=True, eq=False)
class Flows:
    """``e^{D r}`` of the normal form ``D (d, d)`` of a decoupling: modes that are blocks of their own by numbers, those
    of a group by `Leaps`."""

    decoupling: Decoupling
    D: Array

    @cached_property
    def _singles(self) -> tuple[np.ndarray, Array, np.ndarray, np.ndarray]:
        """Where the real modes are, and their rates; where rotations ``[[a, b], [-b, a]]`` begin, and ``a + ib``."""
        alone = [part for part, single in self.decoupling.parts if single]
        real = np.array([part.start for part in alone if part.stop == part.start + 1], dtype=int)
        turning = np.array([part.start for part in alone if part.stop == part.start + 2], dtype=int)
        return real, self.D[real, real], turning, self.D[turning, turning] + 1j * self.D[turning, turning + 1]

    @cached_property
    def _groups(self) -> list[tuple[slice, Leaps, Leaps]]:
        """Every group, on rows and on columns."""
        found = [(part, self.D[part, part]) for part, single in self.decoupling.parts if not single]
        return [(part, Leaps(D), Leaps(np.ascontiguousarray(D.T))) for part, D in found]

    @shaped
    def rows(
        self, rows: Float[Array, "k r d"], durations: Float[Array, " k"]
    ) -> tuple[Float[Array, "k r d"], Float[Array, "k r d"]]:
        """``c'e^{D r}`` and ``c'int_0^r e^{D s} ds``, ``(k, r, d)`` each, of ``rows (k, r, d)`` over ``durations
        (k,)``."""
        return self._applied(rows, durations, transposed=False)

    @shaped
    def columns(
        self, states: Float[Array, "k d"], drives: Float[Array, "k d"], durations: Float[Array, " k"]
    ) -> Float[Array, "k d"]:
        """Where ``states (k, d)`` are after ``durations (k,)`` under constant ``drives (k, d)``."""
        flown, driven = self._applied(np.stack([states, drives], axis=1), durations, transposed=True)
        return flown[:, 0] + driven[:, 1]

    def _applied(self, rows: Array, durations: Array, transposed: bool) -> tuple[Array, Array]:
        flown, driven = np.empty((2, *rows.shape))
        real, rates, turning, spins = self._singles
        late = durations[:, None]
        if real.size:
            grown, added = np.exp(rates * late), _integrals(rates, late)
            flown[..., real], driven[..., real] = rows[..., real] * grown[:, None], rows[..., real] * added[:, None]
        if turning.size:
            spins = spins.conj() if transposed else spins
            points = rows[..., turning] + 1j * rows[..., turning + 1]
            for found, factor in ((flown, np.exp(spins * late)), (driven, _integrals(spins, late))):
                moved = points * factor[:, None]
                found[..., turning], found[..., turning + 1] = moved.real, moved.imag
        for part, along, across in self._groups:
            mine = np.ascontiguousarray(rows[..., part]).reshape(-1, part.stop - part.start)
            every = np.repeat(durations, rows.shape[1])
            for found, moved in zip((flown, driven), (across if transposed else along).rows(mine, every), strict=True):
                found[..., part] = moved.reshape(*rows.shape[:-1], -1)
        return flown, driven


def _integrals(rates: np.ndarray, durations: Array) -> np.ndarray:
    """``int_0^r e^{a s} ds`` of rates ``a (q,)`` over durations ``r (k, 1)``, ``(k, q)``."""
    safe = np.where(rates == 0, 1.0, rates)
    return np.where(rates == 0, durations, np.expm1(safe * durations) / safe)
