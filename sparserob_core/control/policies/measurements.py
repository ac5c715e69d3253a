"""Measurements of the state: outputs, their noise, and the time from which the control knows them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.term import Term, measured
from sparserob_core.errors import InputError
from sparserob_core.shapes import dense
from sparserob_core.sip.convex_set import Array, Box, ConvexSet, as_bound

LATENCY_ALLOWANCE = (
    1e-12  # of the horizon: what is known by less later than a breakpoint is known at it; ten times less and a latency
)
# of a whole piece is one piece more by rounding, ten times more and nobody would see it


@dataclass(frozen=True, eq=False)
class Measurements(Term):
    """``y_j = C x(tau_j) + v_j`` at every breakpoint ``tau_j`` of the control's dictionary, with ``C (p, d)`` and
    ``v_j`` in the bounded set ``noise``, ``None`` for none; the control knows ``y_j`` from ``tau_j + latency`` on, in
    the time unit of the problem."""

    C: npt.ArrayLike = field(metadata=measured(lambda of: of.outputs[:, None] / of.states))
    noise: ConvexSet | None = field(default=None, metadata=measured(lambda of: of.outputs))
    latency: float = field(default=0.0, metadata=measured(lambda of: of.time))

    __repr__ = noun

    @property
    def outputs(self) -> int:
        """Number ``p`` of outputs that are measured at each breakpoint."""
        return int(np.asarray(self.C).shape[0])

    @property
    def noises(self) -> ConvexSet:
        """The set of the noise; the point 0 where there is none."""
        return self.noise or Box(np.zeros(self.outputs), np.zeros(self.outputs))

    def checked(self, states: int, horizon: float) -> Measurements:
        """Return the measurements after a check, with ``C`` as an array.

        Parameters
        ----------
        states : int
            Number ``d`` of states.
        horizon : float
            Horizon, in the unit of the latency.

        Returns
        -------
        Measurements
            Checked measurements. A noise set that is the point 0 is replaced by ``None``.

        Raises
        ------
        InputError
            Where a field is not valid. The path begins with the key below ``measurements``.
        """
        try:
            C = np.array(dense(self.C), dtype=float)
        except (TypeError, ValueError):
            raise InputError(path="C", expected="a matrix of numbers", got=f"{self.C!r}") from None
        if C.ndim != 2 or C.shape[1] != states or not C.shape[0] or not np.isfinite(C).all():
            raise InputError(
                path="C",
                expected=f"rows of {states} finite numbers, one per state, and a row per output",
                got=f"an array of shape {C.shape}" if np.isfinite(C).all() else "a number that is not finite",
            )
        if not C.any(axis=1).all():
            row = int(np.flatnonzero(~C.any(axis=1))[0])
            raise InputError(path=f"C.{row}", expected="an output that depends on a state", got="zeros")
        noise = self.noise
        if noise is not None:
            if noise.dimension != C.shape[0]:
                expected = f"a set of {C.shape[0]} coordinates, one per output"
                raise InputError(path="noise", expected=expected, got=f"{noise.dimension} coordinates")
            reach = noise.reach(np.eye(C.shape[0]))
            if not np.isfinite(reach).all():
                raise InputError(path="noise", expected="a bounded set", got="an unbounded one")
            noise = noise if reach.any() else None
        latency = as_bound("latency", self.latency)
        if latency.shape != (1,) or not 0.0 <= latency[0] < horizon:
            raise InputError(
                path="latency", expected=f"a time from 0 to less than {horizon:g}, the horizon", got=f"{self.latency!r}"
            )
        return replace(self, C=C, noise=noise, latency=float(latency[0]))

    def units(self, states: Array) -> Array:
        """Return the unit of each output in the user's units, ``(p,)``, for the units ``states (d,)`` of the states.

        Each unit is a power of two, close to the largest ``|C_ij| states_j`` of its row.
        """
        sizes = (np.abs(np.asarray(self.C)) * states).max(axis=1)
        units: Array = np.exp2(np.round(np.log2(sizes)))
        return units

    def in_units(self, units: Any) -> Measurements:
        """Return the measurements with every number converted to these `Units`, and outputs to the units of `units`."""
        return super().in_units(replace(units, outputs=self.units(units.states)))

    def latest(self, breakpoints: Array) -> Array:
        """Return the time of the latest measurement that each piece of the control knows, ``(K,)``; 0 where none is
        known."""
        is_known = self.known(breakpoints)
        latest: Array = np.where(is_known, breakpoints[:-1], 0.0).max(axis=1)
        return latest

    def known(self, breakpoints: Array) -> np.ndarray:
        """Truth values ``(K, K)``: whether the control on piece ``k`` may know what was measured at breakpoint ``j``,
        of the ``breakpoints (K + 1,)`` of the control's dictionary."""
        starts, late = breakpoints[:-1], self.latency - LATENCY_ALLOWANCE * breakpoints[-1]
        is_known: np.ndarray = np.tril(starts[:, None] - starts >= late)
        return is_known
