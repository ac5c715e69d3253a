"""The last share of a budget: local ascents from the best points that a global search has left."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.maximiser import Objective
from sparserob_core.sip.search.block_ascent import IdleBlocks
from sparserob_core.sip.search.separable import separable_maxima
from sparserob_core.sip.search.trust_region import TrustRegion

MODELLED = 30
"""Most coordinates for which quadratics are fitted."""
APART = 0.03
"""Starts differ by this share of the box at least, in some coordinate."""
STARTS = 30
AFFORDED = 8
"""Evaluations left for each coordinate, of which a crossing takes one: with fewer the next start gains more."""
CONSIDERED = 2000
"""Best evaluated points among which starts and neighbours are looked for."""
LONGEST = 20.0
"""The unit box as a quasi-Newton method sees it, whose first step has length 1."""


def polish(objective: Objective, points: Array, values: Array) -> None:
    """Climb from the best of the evaluated ``points (k, d)`` with ``values (k,)`` until the budget is spent or nothing
    is left to gain.

    With gradients: L-BFGS-B (Byrd, Lu, Nocedal and Zhu 1995), first in the blocks that act, where these are known.
    Then, up to 30 coordinates, the derivative-free `TrustRegion`; beyond, a compass search that moves one coordinate,
    hence one block, at a time. Starts are the best points, then the next best that lie apart; one that its recent
    progress cannot bring to the top is given up. Nothing is done without a finite value.
    """
    finite = np.isfinite(values)
    if not finite.any():
        return
    order = np.flatnonzero(finite)[np.argsort(-values[finite], kind="stable")][:CONSIDERED]
    seen = _Seen(objective, points[order], values[order])
    if objective.differentiable:
        if objective.acting is not None:
            _ascend_with_idle_blocks(seen, objective.acting)
        _ascend(seen)
    if seen.dimension <= MODELLED:
        _climb(seen)
    else:
        _feel(seen)


class _Seen:
    """The evaluated points in the unit box, and a function that adds to them."""

    def __init__(self, objective: Objective, points: Array, values: Array) -> None:
        self.objective = objective
        self.lower, self.width = objective.domain.lower, objective.domain.upper - objective.domain.lower
        self.dimension = objective.domain.dimension
        self.blocks = np.arange(self.dimension) // objective.block
        self.points = np.clip((points - self.lower) / self.width, 0.0, 1.0)
        self.values = values.copy()

    def starts(self) -> Array:
        """The best points that lie apart from one another, best first."""
        order = np.argsort(-self.values, kind="stable")
        chosen = self.points[order[:1]]
        for point in self.points[order[1:]]:
            if len(chosen) == STARTS:
                break
            if (np.abs(chosen - point).max(axis=1) >= APART).all():
                chosen = np.vstack([chosen, point])
        return chosen

    @property
    def top(self) -> Array:
        """The best point."""
        best: Array = self.points[self.values.argmax()]
        return best

    def below(self, start: Array) -> tuple[Array, Array]:
        """A point and everything that is no better."""
        own = self.value_of(start)
        kept = self.values <= own
        return self.points[kept], self.values[kept]

    def value_of(self, point: Array) -> float:
        return float(self.values[(self.points == point).all(axis=1)].max())

    def place(self, point: Array) -> Array:
        """The point of the domain."""
        return np.clip(self.lower + point * self.width, self.lower, self.objective.domain.upper)

    def evaluate(self, point: Array) -> float:
        value = float(self.objective.evaluate(self.place(point)[np.newaxis])[0])
        self._add(point, value)
        return value

    def with_gradient(self, point: Array) -> tuple[float, Array]:
        value, gradient = self.objective.value_and_gradient(self.place(point))
        self._add(point, value)
        return value, gradient * self.width

    def _add(self, point: Array, value: float) -> None:
        if self.dimension <= MODELLED or value > self.values.max():
            self.points, self.values = np.vstack([self.points, point]), np.append(self.values, value)


def _ascend(seen: _Seen) -> None:
    """L-BFGS-B from every start; a value of ``-inf`` is shown to it as the lowest that is finite."""
    lowest = float(seen.values.min())

    def descent(scaled: Array) -> tuple[float, Array]:
        value, gradient = seen.with_gradient(scaled / LONGEST)
        return -max(value, lowest), -gradient / LONGEST

    for start in seen.starts():
        if not seen.objective.remaining:
            return
        _minimise(descent, start, seen.objective.remaining)


def _ascend_with_idle_blocks(seen: _Seen, acting: Callable[[], np.ndarray]) -> None:
    """L-BFGS-B in the blocks that act, from the best point, while the idle ones are placed anew for every evaluation
    (`IdleBlocks`).

    A value rests on few blocks of many, and the gradient in the others is 0. To move these costs nothing. Wherever `g`
    is below its maximum, some index is violated, so that an idle block that comes near it acts; it then joins the
    ascent. Nothing is done where every block acts.
    """
    if not seen.objective.remaining:
        return
    idle = IdleBlocks(Box(np.zeros(seen.dimension), np.ones(seen.dimension)), seen.objective.block)
    best = seen.top
    value, _ = seen.with_gradient(best)
    acts = acting()
    while seen.objective.remaining and acts.any() and not acts.all():
        ascent = _BlockLoss(seen, acting, idle, _Standing(best, value, acts))
        with suppress(_NewcomerError):
            _minimise(ascent, best[ascent.free], seen.objective.remaining)
        best, value, acts = ascent.best.point, ascent.best.value, ascent.best.acts


class _NewcomerError(Exception):
    """An idle block acts at the best point."""


@dataclass(frozen=True, eq=False)
class _Standing:
    """A point ``(d,)`` of the unit box, its value, and the blocks ``(D,)`` that act there."""

    point: Array
    value: float
    acts: np.ndarray


class _BlockLoss:
    """The loss in the coordinates ``free (d,)`` of the blocks that act at a point ``start``, and its slope; ``best`` is
    the best point until now."""

    def __init__(self, seen: _Seen, acting: Callable[[], np.ndarray], idle: IdleBlocks, start: _Standing) -> None:
        self.seen, self.acting, self.idle, self.start, self.best = seen, acting, idle, start, start
        self.free = np.repeat(start.acts, seen.objective.block)
        self.lowest = float(seen.values.min())

    def __call__(self, scaled: Array) -> tuple[float, Array]:
        point = self.start.point.copy()
        point[self.free] = scaled / LONGEST
        point = self.idle.placed(point, self.start.acts)
        value, gradient = self.seen.with_gradient(point)
        if value > self.best.value:
            self.best = _Standing(point, value, self.acting())
            if (self.best.acts & ~self.start.acts).any():
                raise _NewcomerError
        return -max(value, self.lowest), -gradient[self.free] / LONGEST


def _minimise(loss: Callable[[Array], tuple[float, Array]], start: Array, most: int) -> None:
    """L-BFGS-B in the unit box from ``start (c,)``, with ``most`` evaluations."""
    from scipy.optimize import minimize

    minimize(
        loss,
        start * LONGEST,
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, LONGEST)] * start.size,
        options={"maxfun": most, "maxiter": most, "ftol": 1e-16, "gtol": 0.0},
    )


def _climb(seen: _Seen) -> None:
    """The trust region from every start; what a start found is crossed with the best.

    After the first, the maxima of a separable function that goes through the values are crossed likewise: of one that
    is separable, or nearly so, these are near the highest hill, however many hills there are.
    """
    _climb_and_cross(seen, seen.top)
    for guess in separable_maxima(seen.points, seen.values):
        if seen.objective.remaining >= AFFORDED * seen.dimension and _cross(seen, guess):
            _climb_and_cross(seen, seen.top)
    for start in seen.starts()[1:]:
        _climb_and_cross(seen, start)


def _climb_and_cross(seen: _Seen, start: Array) -> None:
    found = _climb_from(seen, start)
    while _cross(seen, found):
        found = _climb_from(seen, seen.top)


def _climb_from(seen: _Seen, start: Array) -> Array:
    """The end of an ascent, which goes on while it may still come out on top."""
    points, values = seen.below(start)
    region, progress, window = TrustRegion(2 * APART), [float(values.max())], 2 * seen.dimension + 4
    while seen.objective.remaining:
        point = region.propose(points, values)
        if point is None:
            break
        value = seen.evaluate(point)
        region.tell(value)
        points, values = np.vstack([points, point]), np.append(values, value)
        progress.append(max(progress[-1], value))
        missing = float(seen.values.max()) - progress[-1]
        if len(progress) > window and missing > 4.0 * (progress[-1] - progress[-1 - window]):
            break
    return np.asarray(points[values.argmax()])


def _cross(seen: _Seen, other: Array) -> bool:
    """Whether the best point gains by blocks of another local maximum, each tried alone: those of a nearly separable
    function may be exchanged."""
    crossed = False
    for block in np.unique(seen.blocks):
        best = seen.top
        trial = np.where(seen.blocks == block, other, best)
        if not seen.objective.remaining or np.abs(trial - best).max() < APART:
            continue
        before = float(seen.values.max())
        crossed = seen.evaluate(trial) > before or crossed
    return crossed


def _feel(seen: _Seen) -> None:
    """Compass search (Hooke and Jeeves 1961): one coordinate at a time up or down, by a step of its own that doubles or
    halves."""
    best, value = seen.top.copy(), float(seen.values.max())
    steps = np.full(seen.dimension, 0.1)
    stride = _stride(seen.dimension)
    coordinate = 0
    while seen.objective.remaining and steps.max() > 1e-12:
        coordinate = (coordinate + stride) % seen.dimension
        gained = False
        for direction in (steps[coordinate], -steps[coordinate]):
            trial = best.copy()
            trial[coordinate] = min(max(trial[coordinate] + direction, 0.0), 1.0)
            if gained or trial[coordinate] == best[coordinate] or not seen.objective.remaining:
                continue
            reached = seen.evaluate(trial)
            if reached > value:
                best, value, gained = trial, reached, True
        steps[coordinate] = min(0.5, abs(steps[coordinate]) * 2.0) if gained else 0.5 * steps[coordinate]


def _stride(dimension: int) -> int:
    """A step through all coordinates in an order that is spread over them: next to the golden section, and without
    common factor."""
    stride = max(1, round(0.618 * dimension))
    while np.gcd(stride, dimension) > 1:
        stride += 1
    return stride
