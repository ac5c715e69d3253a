"""What inputs at any time of an interval make of the state at its end, and how far sums of their integrals bend."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import comb
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.reach.closed_loop import ORDER
from sparserob_core.checker.reach.states import enclosed
from sparserob_core.checker.reach.tube import Around
from sparserob_core.checker.sets.parameters import Corners
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat


class Added(NamedTuple):
    """Coefficients ``ends (T, M)`` over a box of parameters of what errors add at times, by how much they are ``off``
    at most, how far ``over`` the truth in the middle of the box, and how much of it is the width of each parameter."""

    ends: Array
    off: float
    over: float
    wide: Array


class BoundedInput(ABC):
    """What enters at any time and is known by its size alone: errors of execution, and measurable disturbances about
    the middle of their set."""

    @abstractmethod
    def at(self, parameter: Sequence[float]) -> BoundedInputHere:
        """That at one parameter, of which there may be none."""

    @abstractmethod
    def over(self, c: Array, times: Sequence[float], within: tuple[Corners, Around] | None) -> Added:
        """What the worst adds to ``c'x`` at one or two ``times``, between which there is no mark, ``within`` a box of
        parameters with the monomials on it."""


class BoundedInputHere(BoundedInput):
    """`BoundedInput` of a known system."""

    @abstractmethod
    def added(self, c: Array, time: float) -> tuple[float, float]:
        """What the worst of it adds to ``c'x(t)``, between two numbers."""

    @abstractmethod
    def least(self, c: Array, time: float) -> Array:
        """What a command of size 1 on every piece adds at least to ``c'x(t)``, ``(K, m)``."""

    @abstractmethod
    def bent(self, c: Array, start: float, stop: float) -> float:
        """How far `added` may be above its chord on ``[start, stop]``, which lies within one piece and one segment."""

    def at(self, parameter: Sequence[float]) -> BoundedInputHere:
        """`BoundedInput.at`."""
        return self

    def over(self, c: Array, times: Sequence[float], within: tuple[Corners, Around] | None) -> Added:
        """`BoundedInput.over`."""
        ends = np.array([self.added(c, time) for time in times])
        off = float((ends[:, 1] - ends[:, 0]).max())
        bent = self.bent(c, times[0], times[-1]) if times[-1] > times[0] else 0.0
        return Added(ends.mean(axis=1)[:, None], off + bent, 0.0, np.zeros(0))


def pushes(law: VerifiedFlow, start: float, stop: float, columns: slice) -> Enclosed:
    """What some ``columns`` of ``[B E]`` make, at any time of an interval without marks, of the state at its end, times
    its length: coefficients ``(p + 1, M, d, m)`` of powers of ``u`` from -1 to 1 across what is left of it."""
    from flint import arb, arb_mat

    terms, off = law.kernel(start, stop)
    d, (count, size) = law.states, (len(terms), terms[0].shape[1])
    table = arb_mat([[x for part in term.parts for x in part.entries()] for term in terms])
    weights = arb_mat([[arb(comb(n, j)) / 2**n for n in range(count)] for j in range(count)])
    found = Enclosed.all([weights * table], (count, law.monomials.size, d, size))
    found.rad[0, 0] += off
    return Enclosed(found.mid[..., columns], found.rad[..., columns])


def above_chord(
    law: VerifiedFlow, rows: Array | arb_mat, start: float, stop: float, begun: Array, size: Array, first: int
) -> Array:
    """How far sums of integrals of ``|c'Phi(t, s) B_j(s)|`` up to the time may be above their chords on ``[start,
    stop]``, which lies between two marks, for ``rows (r, d)``: ``(r,)``, at every parameter. Of every state they are at
    most ``begun (d,)`` at the start, and ``size (m,)`` is what drives them through the columns of ``[B E]`` from the
    ``first`` one on.

    An integrand that began before is ``|c'Phi(t, start) y|``, above its chord by no more than ``c'Phi(t, start) y``
    is from its own: its terms ``a s^n`` by at most ``(n - 1) n^(-n / (n - 1)) |a|``. What begins within the
    cell has a second derivative of at least ``-|c'B'| - |c'A B| - int |c'(A' + A^2) Phi B| ds``.
    """
    lines, width = exactly(rows), (stop - start) * (1.0 + rounding(2))
    large, d = Enclosed.of(lines), lines.ncols()
    far = np.abs(large.mid) + large.rad
    terms, off = law.within(start, stop, start, stop, ORDER + 1)
    total = 2.0 * (far @ off[:, :d]) @ begun
    for n, term in enumerate(terms[2:], 2):
        found = enclosed([term.columns(0, d).along(lines)])
        total += (n - 1) * n ** (-n / (n - 1)) * ((np.abs(found.mid) + found.rad).sum(axis=(0, 1)) @ begun)
    if size.any():
        most, slope, units = law.sizes(start, stop)
        entering = slice(d + first, d + first + size.size)
        A, B = most[:, :d], most[:, entering]
        pace = float((A * units / units[:, None]).sum(axis=1).max())
        grown = np.exp(pace * width) * units * ((B @ size) / units).max()
        second = (slope[:, entering] + A @ B) @ size + width * (slope[:, :d] + A @ A) @ grown
        total += width**2 / 8.0 * (far @ second)
    return np.asarray(total * OUTWARD * (1.0 + rounding(8 * d * d)))
