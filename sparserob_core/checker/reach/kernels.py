"""Inputs that may change at any time: their effect on the state, and how far sums of their integrals rise above a
chord."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import comb
from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.reach.closed_loop import ORDER
from sparserob_core.checker.reach.states import enclosed
from sparserob_core.checker.reach.tube import Around
from sparserob_core.checker.sets.parameters import Corners
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.sip.convex_set import Array


class Added(NamedTuple):
    """Bounds of what bounded inputs add to a row, over a box of parameters.

    Attributes
    ----------
    ends
        Coefficients ``(T, M)`` in the parameters, one row for each of ``T`` times.
    off
        The upper bound of how far the true value exceeds them, and the chord between two times.
    over
        The upper bound of how far they exceed the true value in the middle of the box by more than ``off``.
    wide
        The part of ``off`` that is due to the width of each parameter, ``(nu,)``; empty where there is none.
    """

    ends: Array
    off: float
    over: float
    wide: Array


class BoundedInput(ABC):
    """An input that enters at any time and of which only its size is known: errors of execution, and measurable
    disturbances about the middle of their set."""

    @abstractmethod
    def at(self, parameter: Sequence[float]) -> BoundedInputHere:
        """Return the input at one parameter; the parameter is empty for a known system."""

    @abstractmethod
    def over(self, c: Array, times: Sequence[float], within: tuple[Corners, Around] | None) -> Added:
        """Return bounds of what the worst input adds to ``c'x``, ``c (d,)``, at one time, or at two without a mark
        between them, over the corners ``within`` of a box of parameters with its monomials; ``None`` for a known
        system."""


class BoundedInputHere(BoundedInput):
    """A `BoundedInput` of a known system."""

    @abstractmethod
    def added_at(self, c: Array, times: Array) -> tuple[Array, Array]:
        """Return lower and upper bounds, ``(k,)`` each, of what the worst input adds to ``c'x``, ``c (d,)``, at
        ``times (k,)``."""

    @abstractmethod
    def least(self, c: Array, time: float) -> Array:
        """Return lower bounds ``(K, m)`` of what the worst input adds to ``c'x(t)``, for a command of size 1 on one
        piece in one channel."""

    @abstractmethod
    def bound_chord_errors(self, c: Array, start: Array, stop: Array) -> Array:
        """Return upper bounds ``(k,)`` of how far `added_at` lies above its chord on every interval from ``start (k,)``
        to ``stop (k,)``, each within one piece of the command and one segment of the system."""

    def added(self, c: Array, time: float) -> tuple[float, float]:
        """Return a lower and an upper bound of what the worst input adds to ``c'x(t)``, ``c (d,)``."""
        (low,), (high,) = self.added_at(c, np.array([time]))
        return float(low), float(high)

    def bound_chord_error(self, c: Array, start: float, stop: float) -> float:
        """Return `bound_chord_errors` on one interval."""
        return float(self.bound_chord_errors(c, np.array([start]), np.array([stop]))[0])

    def at(self, parameter: Sequence[float]) -> BoundedInputHere:
        """Return the input itself, since the system is known."""
        return self

    def over(self, c: Array, times: Sequence[float], within: tuple[Corners, Around] | None) -> Added:
        """Return the mean of both bounds at every time, and an error bound that includes the curvature in time."""
        ends = np.array(self.added_at(c, np.array(times)))
        gap = float((ends[1] - ends[0]).max())
        chord_error = self.bound_chord_error(c, times[0], times[-1]) if times[-1] > times[0] else 0.0
        return Added(ends.mean(axis=0)[:, None], gap + chord_error, 0.0, np.zeros(0))


def compute_kernel(law: VerifiedFlow, start: float, stop: float, columns: slice) -> Enclosed:
    """Return the kernel of an interval without marks: its length times some ``columns`` of ``Phi(stop, s) [B c E](s)``.
    Coefficients ``(p + 1, M, d, m)`` are those of powers of ``u`` from -1 to 1; the remainder is in the radius of the
    first. ``(1 + u) / 2`` is the share of the interval that is left at ``s``."""
    terms, remainder = law.kernel(start, stop)
    d, (count, size) = law.states, (len(terms), terms[0].shape[1])
    table = arb_mat([[x for matrix in term.parts for x in matrix.entries()] for term in terms])
    weights = arb_mat([[arb(comb(n, j)) / 2**n for n in range(count)] for j in range(count)])
    kernel = Enclosed.all([weights * table], (count, law.monomials.size, d, size))
    kernel.rad[0, 0] += remainder
    return kernel[..., columns]


def above_chord(
    law: VerifiedFlow, rows: Array, start: float, stop: float, start_bounds: Array, size: Array, first: int
) -> Array:
    """Return upper bounds ``(r,)`` of how far sums of integrals of ``|c'Phi(t, s) B_j(s)|`` up to ``t`` lie above their
    chords on a cell between two marks, at every parameter, for ``rows (r, d)``. ``start_bounds (d,)`` bounds these
    sums at ``start`` for every state, ``size (m,)`` the inputs, which enter by the columns from the ``first`` one on.

    An integrand that started before is ``|c'Phi(t, start) y|``. It lies above its chord by no more than ``c'Phi(t,
    start) y`` differs from its own chord: a term ``a s^n`` by at most ``(n - 1) n^(-n / (n - 1)) |a|``. What starts
    within the cell has a second derivative of at least ``-|c'B'| - |c'A B| - int |c'(A' + A^2) Phi B| ds``."""
    lines, width = exactly(rows), (stop - start) * (1.0 + rounding(2))
    row_bounds, d = np.abs(rows), lines.ncols()
    terms, remainder = law.within(start, stop, start, stop, ORDER + 1)
    total = 2.0 * (row_bounds @ remainder[:, :d]) @ start_bounds
    for n, term in enumerate(terms[2:], 2):
        values = enclosed([term.columns(0, d).along(lines)])
        total += (n - 1) * n ** (-n / (n - 1)) * ((np.abs(values.mid) + values.rad).sum(axis=(0, 1)) @ start_bounds)
    if size.any():
        bounds, slope, units = law.sizes(start, stop)
        entering = slice(d + first, d + first + size.size)
        A, B = bounds[:, :d], bounds[:, entering]
        pace = float((A * units / units[:, None]).sum(axis=1).max())
        state_bound = np.exp(pace * width) * units * ((B @ size) / units).max()
        second = (slope[:, entering] + A @ B) @ size + width * (slope[:, :d] + A @ A) @ state_bound
        total += width**2 / 8.0 * (row_bounds @ second)
    return np.asarray(total * OUTWARD * (1.0 + rounding(8 * d * d)))
