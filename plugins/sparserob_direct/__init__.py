"""DIRECT, the deterministic division of a box into ever smaller rectangles, by the implementation in scipy."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from pydantic import Field

import sparserob_core as sr

SHOWN_EVERY = 32  # evaluations
MOST_SHOWN = 200  # rectangles
RETOLD = 3000  # points whose rectangles are followed


class Direct(sr.Maximiser, sr.Options):
    """Dividing rectangles (Jones, Perttunen and Stuckman 1993), with the local bias of Gablonsky and Kelley (2001)
    unless switched off.

    Deterministic: the generator is not used. It proves no upper bound.
    """

    scaled: ClassVar[bool] = True
    apart: ClassVar[bool] = True

    eps: float = Field(default=1e-8, ge=0.0, le=1.0)
    """Least improvement, relative to the best value, that a rectangle must promise: small is local and accurate."""

    locally_biased: bool = True
    """Divide at most one rectangle of each size per iteration: faster when the maxima are few."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """See `sparserob_core.Maximiser`."""
        from scipy.optimize import Bounds, direct

        # An iteration takes two evaluations at least, so only the budget ends the search; scipy allocates memory for
        # maxiter.
        direct(
            _Descent(objective),
            Bounds(objective.domain.lower, objective.domain.upper),
            eps=self.eps,
            maxfun=objective.remaining,
            maxiter=objective.remaining + 1,
            locally_biased=self.locally_biased,
            vol_tol=0.0,
            len_tol=0.0,
        )
        return float("inf")


class _Descent:
    """The negated objective at one point.

    scipy finishes its iteration beyond ``maxfun``, and averages values: once the budget is spent, and where the
    objective is ``-inf``, it is given the worst finite value that was seen.
    """

    def __init__(self, objective: sr.Objective) -> None:
        self.objective, self.worst, self.cells = objective, -np.inf, Rectangles(objective.domain)

    def __call__(self, point: np.ndarray) -> float:
        domain = self.objective.domain
        if not self.objective.remaining:
            return self._substitute()
        asked = np.clip(point, domain.lower, domain.upper)
        value = -float(self.objective.evaluate(asked[np.newaxis])[0])
        if self.objective.observed:
            self.cells.add(asked, -value)
            if self.objective.evaluations % SHOWN_EVERY == 0:
                self.objective.sketch("rectangles, the best ones", *self.cells.boxes())
        if np.isinf(value):
            return self._substitute()
        self.worst = max(self.worst, value)
        return value

    def _substitute(self) -> float:
        return self.worst if np.isfinite(self.worst) else 0.0


class Rectangles:
    """The division of the box, retold from the points that are asked for: scipy keeps it to itself.

    A rectangle is cut into thirds along its longest sides: points come in pairs beside its centre, and the side whose
    pair has the better value is cut first. Where a pair is complete for every side that is asked for, its cuts are
    known; until then the rectangle stands as it was. For showing, never for the search.
    """

    def __init__(self, domain: sr.Box) -> None:
        self.domain = domain
        self.centres = np.zeros((0, domain.dimension))
        self.levels = np.zeros((0, domain.dimension), dtype=int)
        self.values = np.zeros(0)
        self.parent, self.pending = -1, list[tuple[int, int]]()

    def add(self, point: np.ndarray, value: float) -> None:
        """A point ``(d,)`` that was evaluated."""
        if len(self.centres) >= RETOLD:
            return
        unit = (point - self.domain.lower) / (self.domain.upper - self.domain.lower)
        parent, axis = self._origin(unit)
        if self.pending and (parent != self.parent):
            self._cut()
            parent, axis = self._origin(unit)
        self.centres = np.vstack([self.centres, unit])
        self.values = np.append(self.values, value)
        level = self.levels[parent] if parent >= 0 else np.zeros(unit.size, dtype=int)
        self.levels = np.vstack([self.levels, level])
        self.parent = parent
        if parent >= 0:
            self.pending.append((axis, len(self.centres) - 1))

    def boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners ``(k, d)``, of the best rectangles first; not of those that are just being cut."""
        done = np.ones(len(self.centres), dtype=bool)
        done[[row for _, row in self.pending]] = False
        order = np.argsort(np.where(done, -self.values, np.inf), kind="stable")[: min(MOST_SHOWN, int(done.sum()))]
        half, width = 0.5 / 3.0 ** self.levels[order], self.domain.upper - self.domain.lower
        return (
            self.domain.lower + np.clip(self.centres[order] - half, 0.0, 1.0) * width,
            self.domain.lower + np.clip(self.centres[order] + half, 0.0, 1.0) * width,
        )

    def _origin(self, unit: np.ndarray) -> tuple[int, int]:
        """The rectangle beside whose centre a point lies, by a third of a side, and along which; -1 for the first."""
        if not len(self.centres):
            return -1, 0
        offset = np.abs(self.centres - unit)
        moved = offset > 1e-12
        axis = offset.argmax(axis=1)
        step = offset[np.arange(len(offset)), axis] * 3.0 ** (self.levels[np.arange(len(offset)), axis] + 1)
        fits = (moved.sum(axis=1) == 1) & (np.abs(step - 1.0) < 1e-6)
        # the rectangle in work first, else the youngest
        found = np.flatnonzero(fits)
        if not found.size:
            return -1, 0
        at = self.parent if self.parent in found else int(found[-1])
        return at, int(axis[at])

    def _cut(self) -> None:
        axes = {axis: [row for other, row in self.pending if other == axis] for axis, _ in self.pending}
        order = sorted(axes, key=lambda axis: -max(self.values[row] for row in axes[axis]))
        for place, axis in enumerate(order):
            later = [row for other in order[place:] for row in axes[other]]
            for row in (self.parent, *later):
                self.levels[row, axis] += 1
        self.pending = []


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``direct``."""
    yield sr.MaximiserPlugin(name="direct", factory=Direct, summary="dividing rectangles, deterministic (scipy)")
