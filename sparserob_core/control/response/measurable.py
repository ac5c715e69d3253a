"""Support of the reachable set when the disturbance may be any measurable function with values in a set.

``sigma(t) = int_0^t h_W(E' e^{A' s} c) ds``: the integral and the maximum commute (Aumann 1965).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import block_norms, product
from sparserob_core.control.enclosures.matrix_exponential import transitions
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Response
from sparserob_core.sip.convex_set import Array, ConvexSet

LEGENDRE = np.polynomial.legendre.Legendre.basis(5)
# Gauss-Lobatto: the ends are nodes, so that no kink hides beside them
NODES = np.concatenate([[-1.0], LEGENDRE.deriv().roots(), [1.0]])
WEIGHTS = 1.0 / (15.0 * LEGENDRE(NODES) ** 2)
ACCURACY = 1e-14  # of an integral over one interval, relative to the largest integrand times the horizon
TABLES_KEPT = 64  # directions and parameters whose integrals are remembered
MOST_SHORT = 4096  # intervals that one is cut into before any is halved
HALVINGS = 48  # of an interval across a kink of the integrand: what is left of it is below rounding


@dataclass(frozen=True, eq=False)
class MeasurableSupport:
    """The support ``sigma`` for one set ``bound``; integrals up to the grid's breakpoints are remembered per direction
    and parameter."""

    response: Response
    bound: ConvexSet
    _tables: dict[bytes, tuple[Array, Array, Array]] = field(default_factory=dict, repr=False)

    def __call__(self, times: Array, directions: Array, parameters: Array) -> Array:
        """``sigma (k,)`` at ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``."""
        unique, which = np.unique(np.hstack([directions, parameters]), axis=0, return_inverse=True)
        which = which.reshape(-1)
        result = np.empty(times.size)
        for position, row in enumerate(unique):
            here = which == position
            starts, total, A = self._table(row[: directions.shape[1]], row[directions.shape[1] :])
            breakpoints = self.response.grid.breakpoints
            pieces = self.response.grid.locate(times[here])
            within = np.clip(times[here] - breakpoints[pieces], 0.0, None)
            result[here] = total[pieces] + self._integrals(A, starts[pieces], within)
        return result

    def _table(self, direction: Array, parameter: Array) -> tuple[Array, Array, Array]:
        """Rows ``c'e^{A s}`` at the breakpoints, the integral up to them, and ``[A, E]`` at the parameter."""
        key = direction.tobytes() + parameter.tobytes()
        if key not in self._tables:
            A, _, W = self.response.system.matrices(parameter[None])
            both = np.hstack([A[0], W[0]])
            breakpoints = self.response.grid.breakpoints
            starts = np.einsum("i,lij->lj", direction, transitions(A[0][None], breakpoints)[0])
            integrals = self._integrals(both, starts[:-1], np.diff(breakpoints))
            remember(self._tables, key, (starts, np.concatenate([[0.0], np.cumsum(integrals)]), both), TABLES_KEPT)
        return self._tables[key]

    def _integrals(self, both: Array, starts: Array, lengths: Array) -> Array:
        """``int_0^length h(E' y(s)) ds`` from rows ``y(0) = starts (l, d)``: Gauss-Lobatto, halving what has not
        converged (kinks)."""
        A, W = both[:, : both.shape[0]], both[:, both.shape[0] :]
        total = np.zeros(lengths.size)
        fastest = float(np.abs(np.linalg.eigvals(A)).max())
        count = int(np.clip(np.ceil(fastest * lengths.max(initial=0.0)), 1, MOST_SHORT))
        owner = np.repeat(np.arange(lengths.size), count)  # short intervals, on which the quadrature is at home
        offsets = np.outer(lengths, np.arange(count) / count)
        starts = np.einsum("li,lqij->lqj", starts, transitions(A[None, None], offsets)[0]).reshape(-1, A.shape[0])
        lengths = lengths[owner] / count
        whole, size = self._quadrature(A, W, starts, lengths)
        accuracy = ACCURACY * max(
            float(size.max(initial=0.0)) * float(self.response.grid.breakpoints[-1]), np.finfo(float).tiny
        )
        for _ in range(HALVINGS):
            middles = np.einsum("li,lij->lj", starts, transitions(A[None], lengths / 2)[0])
            left, right = (
                self._quadrature(A, W, starts, lengths / 2)[0],
                self._quadrature(A, W, middles, lengths / 2)[0],
            )
            open_ = np.abs(left + right - whole) > accuracy
            np.add.at(total, owner[~open_], (left + right)[~open_])
            starts, lengths = np.vstack([starts[open_], middles[open_]]), np.tile(lengths[open_] / 2, 2)
            whole, owner = np.concatenate([left[open_], right[open_]]), np.tile(owner[open_], 2)
            if not owner.size:
                return total
        np.add.at(total, owner, whole)
        return total

    def _quadrature(self, A: Array, W: Array, starts: Array, lengths: Array) -> tuple[Array, Array]:
        flow, _ = transitions(A[None, None], lengths[:, None] * (NODES + 1) / 2)
        values = self.bound.support(np.einsum("li,lqij,jw->lqw", starts, flow, W, optimize=True))
        return (values * WEIGHTS).sum(axis=1) * lengths / 2, np.abs(values).max(axis=1, initial=0.0)


@dataclass(frozen=True, eq=False)
class MeasurableCellSupport:
    """The support function of measurable disturbances on functionals ``rows (r, d)`` of a *known* system, in the form
    of `DisturbanceSupport`; ``lifted`` is that system.

    ``sigma`` is an integral with a Lipschitz integrand, so its second derivative is bounded by that of the integrand's
    argument.
    """

    support: MeasurableSupport
    rows: Array
    lifted: LiftedSystem

    def steepness(self, times: Array) -> Array:
        """No parameters, no steepness: ``(k, r, 0)``."""
        return np.zeros((times.size, self.rows.shape[0], 0))

    def at(self, times: Array, ends: Array) -> tuple[Array, Array]:
        """The support function ``(k, r, 1)`` and an excess of zero ``(k, r)``; ``ends (k, r, 0)``."""
        k, r = times.size, self.rows.shape[0]
        sigma = self.support(np.repeat(times, r), np.tile(self.rows, (k, 1)), np.zeros((k * r, 0)))
        return sigma.reshape(k, r, 1), np.zeros((k, r))

    def deviation(self, start: Array, widths: Array) -> Array:
        """Bounds ``(k, r)`` of how far ``sigma`` is from its chord on ``[start, start + width]``: by the slope of
        ``h(E' e^{A' s} c)``, or by twice its integral, mode by mode."""
        bound, lifted, comparison = self.support.bound, self.lifted, self.lifted.comparison
        rows, W = self.rows @ lifted.transform, lifted.W[0]
        slopes = rows @ lifted.forward.flows(start)[0] @ lifted.A[0]  # (k, r, d)
        reach = comparison.over(widths)
        drive = self._drive
        square = (widths**2 / 8)[:, None]
        moved = product(block_norms(slopes, lifted.starts), product(reach.departure, drive[:, None]))[..., 0]
        exact = square * (bound.reach(slopes @ W) + moved)
        now = product(comparison.over(start).flow, drive[:, None])
        by_mode = np.minimum(
            square * product(comparison.sizes, product(reach.peak, now))[..., 0],
            2.0 * product(reach.integral, now)[..., 0],
        )
        return np.asarray(np.minimum(exact, product(block_norms(rows, lifted.starts), by_mode.T).T))

    @property
    def neglected(self) -> Array:
        """What rounding may change of ``e^{A' s} c``, times the disturbance, at most, ``(r, L)``."""
        lifted = self.lifted
        _, remainder = lifted.row_bounds(self.rows @ lifted.transform)
        pushed = np.cumsum(remainder @ self._drive * lifted.fine.lengths, axis=1)
        return np.asarray(pushed[:, lifted.ends[1:] - 1])

    @property
    def reached(self) -> Array:
        """As in `DisturbanceSupport`, ``(L, q)``."""
        reach = self.lifted.comparison.over(self.lifted.grid.breakpoints[1:])
        return np.asarray(product(reach.integral, self._drive[:, None])[..., 0])

    @property
    def _drive(self) -> Array:
        norms = block_norms(np.linalg.norm(self.lifted.W[0], axis=1), self.lifted.starts)
        return np.asarray(self.support.bound.radius_bound * norms)
