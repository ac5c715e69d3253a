"""A constraint on the state, which may follow a reference and include the control, and the terms that these add."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import above, ball
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import exactly, stacked
from sparserob_core.checker.outcome import Broken
from sparserob_core.checker.reach.kernels import BoundedInput
from sparserob_core.checker.reach.tube import Polynomial
from sparserob_core.checker.sets.known import known
from sparserob_core.checker.sets.polynomials import HALF_ULP, OUTWARD, Enclosed, rounding
from sparserob_core.checker.sets.shape import Shape
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.checker.reach.tube import Around
    from sparserob_core.checker.sets.parameters import Corners

DIRECTIONS_KEPT = 4096  # sets of directions, needed again at every time; a tenth of it computes some of them anew


@final
@dataclass(frozen=True, eq=False)
class ConstraintWindow:
    """The constraint that ``x(t) - r(t)`` is in ``shape`` for all ``t`` from ``start`` to ``stop``.

    A shape of more coordinates than the ``states`` is a mixed constraint: ``(x(t), u(t))`` is in it, with ``u`` of
    every piece of the control that meets the window in positive length.

    ``reference (q, 1 + d)`` holds times and points between which ``r`` is linear; ``None`` means ``r = 0``."""

    name: str
    shape: ConvexSet
    start: float
    stop: float
    states: int
    reference: Array | None = None

    @property
    def enclosed_set(self) -> Shape:
        """The set in ball arithmetic."""
        return known(self.shape)

    @property
    def is_mixed(self) -> bool:
        """True where the constraint includes the control."""
        return self.shape.dimension > self.states

    def split(self, direction: Array) -> tuple[Array, Array]:
        """Return the parts of a normal on the state ``(d,)`` and on the control ``(m,)``; without the control the
        second is empty."""
        return direction[: self.states], direction[self.states :]

    def limit(self, direction: Array, time: float) -> arb:
        """Return the upper bound of ``c'x + g'u`` that the constraint sets at a time, ``(c, g)`` the direction."""
        c, _ = self.split(direction)
        offset, _ = self.evaluate_reference(time, time)
        terms = [ball(a) * r for a, r in zip(c, offset, strict=True) if a]
        return sum(terms, self.enclosed_set.limit(direction))

    def evaluate_reference(self, start: float, stop: float) -> tuple[list[arb], list[arb]]:
        """Return ``r(start)`` and the derivative ``r'`` on ``[start, stop]``, ``(d,)`` each, between two times of the
        reference; outside of its times ``r`` is constant."""
        zero = [ball(0.0)] * self.states
        if self.reference is None:
            return zero, zero
        times = self.reference[:, 0].tolist()
        segment = bisect_right(times, start) - 1
        if segment < 0 or segment >= len(times) - 1:
            return [ball(v) for v in self.reference[max(segment, 0), 1:]], zero
        (t, *p), (s, *q) = self.reference[segment].tolist(), self.reference[segment + 1].tolist()
        slope = [(ball(b) - ball(a)) / (ball(s) - ball(t)) for a, b in zip(p, q, strict=True)]
        return [ball(a) + v * (ball(start) - ball(t)) for a, v in zip(p, slope, strict=True)], slope

    def cuts(self, breakpoints: Sequence[float]) -> list[float]:
        """Return the times at which the rows have a kink or a jump that the state does not have. ``breakpoints (K +
        1,)`` are those of the control, at which mixed constraints jump."""
        kinks = [] if self.reference is None else self.reference[:, 0].tolist()
        return kinks + (list(breakpoints) if self.is_mixed else [])

    def meets(self, breakpoints: Sequence[float], piece: int, time: float) -> None:
        """Raise `Broken` unless a piece of the control holds a time and meets the window in positive length.
        ``breakpoints (K + 1,)`` are those of the control."""
        if not 0 <= piece < len(breakpoints) - 1:
            raise Broken(f"{self.name}: the control has no piece {piece}")
        begin, end = float(breakpoints[piece]), float(breakpoints[piece + 1])
        if not (begin <= time <= end and max(begin, self.start) < min(end, self.stop)):
            raise Broken(f"{self.name}: piece {piece} of the control is not one of t = {time!r} within the window")


@final
@dataclass(frozen=True, eq=False)
class AddedTerms:
    """The terms ``g'u - c'r(t)`` that are added to ``c'x(t)`` in the rows of a window.

    The coefficients are ``c = z'basis`` and ``g = z'gains``, with ``basis (b, d)`` and ``gains (b, m)``.
    ``breakpoints`` and ``pieces`` are those of the commanded control. ``delivered`` holds the bounded inputs, whose
    worst case is added too."""

    window: ConstraintWindow
    basis: Array
    gains: Array
    breakpoints: Sequence[float]
    pieces: Sequence[arb_mat]
    delivered: Sequence[BoundedInput] = ()

    def added(
        self,
        found: Sequence[Polynomial],
        start: float,
        stop: float,
        z: Array,
        piece: int | None = None,
        within: tuple[Corners, Around] | None = None,
    ) -> list[Polynomial]:
        """Return the polynomials ``found`` of ``c'x``, one for every row of ``z (k, b)``, on an interval with the added
        terms. ``piece`` is the one whose control counts, by default that at ``start``; ``within`` the box of parameters
        with its monomials."""
        offset, slope = self.window.evaluate_reference(start, stop)
        basis = exactly(self.basis)
        level = -basis * stacked([[r] for r in offset])
        if self.window.is_mixed:
            piece_index = bisect_right(self.breakpoints, start) - 1 if piece is None else piece
            control = self.pieces[min(piece_index, len(self.pieces) - 1)]
            level = level + exactly(self.gains) * control
        terms = [level]
        if stop > start and self.window.reference is not None:
            length = ball(stop) - ball(start)
            terms.append(-basis * stacked([[v * length] for v in slope]))
        enclosed = Enclosed.all(terms, (len(terms), self.basis.shape[0]))
        mid = enclosed.mid @ z.T
        error_bounds = (enclosed.rad + rounding(z.shape[1]) * np.abs(enclosed.mid)) @ np.abs(z).T
        found = [_add_terms(poly, mid[:, i, None], float(error_bounds[:, i].sum())) for i, poly in enumerate(found)]
        if not self.delivered:
            return list(found)
        directions, direction_errors = self.directions(z)
        times = [start] if start == stop else [start, stop]
        for bounded_input in self.delivered:
            rows = zip(found, directions, direction_errors, strict=True)
            found = [
                self._add_bounded_input(poly, bounded_input, c, direction_error, times, within)
                for poly, c, direction_error in rows
            ]
        return list(found)

    @remembered(lambda: DIRECTIONS_KEPT, lambda self, z: z.tobytes())
    def directions(self, z: Array) -> tuple[Array, Array]:
        """Return ``c = z'basis`` as floats ``(k, d)``, with bounds ``(k, d)`` of their rounding errors. The floats are
        exact where nothing is added up, and mostly elsewhere."""
        exact = (exactly(z) * exactly(self.basis)).entries()
        floats = [float(x) for x in exact]
        errors = [x - ball(c) for x, c in zip(exact, floats, strict=True)]
        error_bounds = [0.0 if x.is_zero() else above(abs(x)) for x in errors]
        shape = len(z), self.basis.shape[1]
        return np.reshape(floats, shape), np.reshape(error_bounds, shape)

    @staticmethod
    def _add_bounded_input(
        poly: Polynomial,
        one: BoundedInput,
        c: Array,
        off: Array,
        times: Sequence[float],
        within: tuple[Corners, Around] | None,
    ) -> Polynomial:
        """Return a polynomial with the upper bound of what a bounded input adds to ``c'x`` at one time or between two.
        It is sublinear in the direction, so an error ``off (d,)`` of ``c`` adds at most ``off`` times what the axes
        add."""
        bounds = one.over(c, times, within)
        terms, error = bounds.ends[:1], bounds.off
        if len(bounds.ends) > 1:
            rise = bounds.ends[1] - bounds.ends[0]
            terms = np.stack([bounds.ends[0], rise])
            error += rounding(8) * float(np.abs(bounds.ends).sum() + np.abs(rise).sum())
        for state in np.flatnonzero(off):
            axis = np.eye(off.size)[state]
            axis_bounds = [one.over(side, times, within) for side in (axis, -axis)]
            error += off[state] * max(float(np.abs(b.ends).sum(axis=1).max()) + b.off for b in axis_bounds) * OUTWARD
        total = _add_terms(poly, terms, error)
        width_errors = bounds.wide if total.parameter_errors is None else total.parameter_errors + bounds.wide
        turning = total.turning + float(bounds.wide.sum())
        return replace(total, kinks=total.kinks + bounds.over, turning=turning, parameter_errors=width_errors)


def _add_terms(poly: Polynomial, terms: Array, error: float) -> Polynomial:
    """Return the sum of a polynomial and another one with coefficients ``terms (J, M)`` of the first monomials. All
    errors of these coefficients together are at most ``error``."""
    missing = max(0, len(terms) - poly.coefficients.shape[0])
    coefficients = np.pad(poly.coefficients, ((0, missing), (0, 0)))
    changed = coefficients[: len(terms), : terms.shape[1]]
    changed += terms
    error += 2.0 * HALF_ULP * float(np.abs(changed).sum())
    return replace(poly, coefficients=coefficients, error=(poly.error + error) * OUTWARD)
