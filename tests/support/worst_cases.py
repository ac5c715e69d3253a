"""Worst cases of known systems by a walk back in time with exponentials of small matrices: nothing of the package but
the support functions of its sets."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import expm

from sparserob_core.sip.convex_set import Array, ConvexSet


@dataclass(frozen=True, eq=False)
class Weights:
    """Of rows at a time: what the initial state is worth ``(r, d)``, the control on every piece ``(r, K, m)``, the one
    before time 0 ``(r, m)``, a drift ``(r,)``, and the disturbance on every block ``(r, M, mw)``."""

    free: Array
    control: Array
    before: Array
    drift: Array
    blocks: Array


@dataclass(frozen=True, eq=False)
class Motion:
    """``x' = A x + B u(t - delay) + E w + c``, the matrices of one leg after another up to the ``ends`` of these; ``u``
    is constant between ``breakpoints (K + 1,)``, ``w`` from each of ``changes (M,)`` on."""

    legs: list[tuple[Array, Array, Array, Array]]
    ends: list[float]
    start: Array
    breakpoints: Array
    changes: Array
    delay: float = 0.0
    _steps: dict[tuple[int, float], Array] = field(default_factory=dict)

    @cached_property
    def acting(self) -> list[float]:
        """When every piece of the control begins to act."""
        return [float(t) + self.delay for t in self.breakpoints[:-1]]

    def weights(self, rows: Array, time: float) -> Weights:
        """Those of ``rows x(time)``, ``rows (r, d)``, piece by piece from the end."""
        d, m, mw = self.start.size, self.legs[0][1].shape[1], self.legs[0][2].shape[1]
        v, r = np.asarray(rows, dtype=float), len(rows)
        control, before, drift = np.zeros((r, len(self.acting), m)), np.zeros((r, m)), np.zeros(r)
        blocks = np.zeros((r, len(self.changes), mw))
        cuts = {0.0, time, *(t for t in (*self.ends, *self.acting, *map(float, self.changes)) if 0.0 < t < time)}
        for begin, end in reversed(list(pairwise(sorted(cuts)))):
            leg = bisect_right(self.ends, begin)
            given = v @ self._step(leg, end - begin)
            v, inputs = given[:, :d], given[:, d:]
            k = bisect_right(self.acting, begin) - 1
            if k < 0:
                before += inputs[:, :m]
            else:
                control[:, k] += inputs[:, :m]
            if len(self.changes):
                blocks[:, bisect_right(self.changes, begin) - 1] += inputs[:, m : m + mw]
            drift += inputs[:, -1]
        return Weights(v, control, before, drift, blocks)

    def _step(self, leg: int, length: float) -> Array:
        """The transition and the integrals of the inputs, ``(d, d + m + mw + 1)``."""
        key = leg, round(length, 12)
        if key not in self._steps:
            A, B, E, c = self.legs[leg]
            M, d = np.hstack([B, E, c[:, None]]), len(A)
            block = np.zeros((d + M.shape[1],) * 2)
            block[:d, :d], block[:d, d:] = A, M
            self._steps[key] = expm(block * length)[:d]
        return self._steps[key]

    def heights(
        self, rows: Array, time: float, u: Array, bound: ConvexSet | None, begun: ConvexSet | None, before: Array
    ) -> Array:
        """The largest ``rows x(time)`` over disturbances and initial states ``(r,)``, under ``u (m, K)``."""
        w = self.weights(rows, time)
        total = w.free @ self.start + (w.control * u.T).sum(axis=(1, 2)) + w.before @ before + w.drift
        if bound is not None:
            total = total + bound.support(w.blocks).sum(axis=1)
        return np.asarray(total if begun is None else total + begun.support(w.free))
