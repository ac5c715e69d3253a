"""Polish, the last share of a budget: local ascents from the best points of a global search."""

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
"""Largest number of coordinates for which quadratics are fitted."""
MIN_START_DISTANCE = 0.03
"""Least difference of two starts in some coordinate, as a share of the box."""
STARTS = 30
EVALUATIONS_PER_COORDINATE = 8
"""Least number of remaining evaluations for each coordinate, of which a crossing takes one. With fewer, the next start
gains more."""
CONSIDERED = 2000
"""Number of best evaluated points among which starts and neighbours are chosen."""
BOX_SIDE = 20.0
"""Side of the unit box in the coordinates of a quasi-Newton method, whose first step has length 1."""


def polish(objective: Objective, points: Array, values: Array) -> None:
    """Climb from the best evaluated points until the budget is spent or no improvement is possible.

    With gradients, the first method is L-BFGS-B (Byrd, Lu, Nocedal and Zhu 1995), at first in the acting blocks, where
    these are known. Then follows, up to 30 coordinates, the derivative-free `TrustRegion`. Beyond, a compass search
    moves one coordinate, hence one block, at a time. Starts are the best points, then the next best that lie apart. A
    start is given up where its recent progress cannot bring it to the top. Nothing is done without a finite value.

    Parameters
    ----------
    objective : Objective
        The objective, with the remaining budget.
    points : ndarray, shape (k, d)
        Evaluated points.
    values : ndarray, shape (k,)
        Their values.
    """
    finite = np.isfinite(values)
    if not finite.any():
        return
    order = np.flatnonzero(finite)[np.argsort(-values[finite], kind="stable")][:CONSIDERED]
    evaluated_points = _Evaluations(objective, points[order], values[order])
    if objective.differentiable:
        if objective.acting is not None:
            _ascend_with_idle_blocks(evaluated_points, objective.acting)
        _ascend(evaluated_points)
    if evaluated_points.dimension <= MODELLED:
        _climb(evaluated_points)
    else:
        _search_by_compass(evaluated_points)


class _Evaluations:
    """Evaluated points in the unit box, and functions that add to them."""

    def __init__(self, objective: Objective, points: Array, values: Array) -> None:
        self.objective = objective
        self.lower, self.width = objective.domain.lower, objective.domain.upper - objective.domain.lower
        self.dimension = objective.domain.dimension
        self.blocks = np.arange(self.dimension) // objective.block
        self.points = np.clip((points - self.lower) / self.width, 0.0, 1.0)
        self.values = values.copy()

    def starts(self) -> Array:
        """Return the best points that lie apart from one another, best first."""
        order = np.argsort(-self.values, kind="stable")
        chosen = self.points[order[:1]]
        for point in self.points[order[1:]]:
            if len(chosen) == STARTS:
                break
            if (np.abs(chosen - point).max(axis=1) >= MIN_START_DISTANCE).all():
                chosen = np.vstack([chosen, point])
        return chosen

    @property
    def top(self) -> Array:
        """Best point ``(d,)``."""
        best: Array = self.points[self.values.argmax()]
        return best

    def below(self, start: Array) -> tuple[Array, Array]:
        """Return the points and values that are no better than ``start``, itself included."""
        own = self.value_of(start)
        is_below = self.values <= own
        return self.points[is_below], self.values[is_below]

    def value_of(self, point: Array) -> float:
        """Return the value of an evaluated point."""
        return float(self.values[(self.points == point).all(axis=1)].max())

    def place(self, point: Array) -> Array:
        """Return the point of the domain for a point of the unit box."""
        return np.clip(self.lower + point * self.width, self.lower, self.objective.domain.upper)

    def evaluate(self, point: Array) -> float:
        """Return the value at a point of the unit box, and record it."""
        value = float(self.objective.evaluate(self.place(point)[np.newaxis])[0])
        self._add(point, value)
        return value

    def with_gradient(self, point: Array) -> tuple[float, Array]:
        """Return the value and the gradient at a point of the unit box, and record the value."""
        value, gradient = self.objective.value_and_gradient(self.place(point))
        self._add(point, value)
        return value, gradient * self.width

    def _add(self, point: Array, value: float) -> None:
        if self.dimension <= MODELLED or value > self.values.max():
            self.points, self.values = np.vstack([self.points, point]), np.append(self.values, value)


def _ascend(evaluations: _Evaluations) -> None:
    """Run L-BFGS-B from every start; a value of ``-inf`` is replaced by the lowest finite value."""
    lowest = float(evaluations.values.min())

    def descent(scaled: Array) -> tuple[float, Array]:
        value, gradient = evaluations.with_gradient(scaled / BOX_SIDE)
        return -max(value, lowest), -gradient / BOX_SIDE

    for start in evaluations.starts():
        if not evaluations.objective.remaining:
            return
        _minimise(descent, start, evaluations.objective.remaining)


def _ascend_with_idle_blocks(evaluations: _Evaluations, acting: Callable[[], np.ndarray]) -> None:
    """Run L-BFGS-B in the acting blocks from the best point, while every evaluation moves the idle blocks
    (`IdleBlocks`).

    A value depends on a few of many blocks, and the gradient in the others is 0. Moving these costs nothing. Wherever
    ``g`` is below its maximum, some index is violated, so that an idle block near that index acts. The block then joins
    the ascent. Nothing is done where every block acts.
    """
    if not evaluations.objective.remaining:
        return
    idle = IdleBlocks(Box(np.zeros(evaluations.dimension), np.ones(evaluations.dimension)), evaluations.objective.block)
    best = evaluations.top
    value, _ = evaluations.with_gradient(best)
    acts = acting()
    while evaluations.objective.remaining and acts.any() and not acts.all():
        ascent = _BlockLoss(evaluations, acting, idle, _AscentPoint(best, value, acts))
        with suppress(_NewBlockError):
            _minimise(ascent, best[ascent.free], evaluations.objective.remaining)
        best, value, acts = ascent.best.point, ascent.best.value, ascent.best.acts


class _NewBlockError(Exception):
    """Exception that reports an idle block that acts at the best point."""


@dataclass(frozen=True, eq=False)
class _AscentPoint:
    """A point of an ascent.

    Parameters
    ----------
    point : ndarray, shape (d,)
        Point of the unit box.
    value : float
        Its value.
    acts : ndarray of bool, shape (D,)
        True for the blocks that act there.
    """

    point: Array
    value: float
    acts: np.ndarray


class _BlockLoss:
    """Loss and its gradient in the coordinates ``free (d,)`` of the blocks that act at ``start``; ``best`` is the best
    point."""

    def __init__(
        self, evaluations: _Evaluations, acting: Callable[[], np.ndarray], idle: IdleBlocks, start: _AscentPoint
    ) -> None:
        self.evaluations, self.acting, self.idle, self.start, self.best = evaluations, acting, idle, start, start
        self.free = np.repeat(start.acts, evaluations.objective.block)
        self.lowest = float(evaluations.values.min())

    def __call__(self, scaled: Array) -> tuple[float, Array]:
        point = self.start.point.copy()
        point[self.free] = scaled / BOX_SIDE
        point = self.idle.placed(point, self.start.acts)
        value, gradient = self.evaluations.with_gradient(point)
        if value > self.best.value:
            self.best = _AscentPoint(point, value, self.acting())
            if (self.best.acts & ~self.start.acts).any():
                raise _NewBlockError
        return -max(value, self.lowest), -gradient[self.free] / BOX_SIDE


def _minimise(loss: Callable[[Array], tuple[float, Array]], start: Array, most: int) -> None:
    """Minimise a loss by L-BFGS-B in the unit box, from ``start (c,)`` with at most ``most`` evaluations."""
    from scipy.optimize import minimize

    minimize(
        loss,
        start * BOX_SIDE,
        jac=True,
        method="L-BFGS-B",
        bounds=[(0.0, BOX_SIDE)] * start.size,
        options={"maxfun": most, "maxiter": most, "ftol": 1e-16, "gtol": 0.0},
    )


def _climb(evaluations: _Evaluations) -> None:
    """Climb by the trust region from every start, and cross each result with the best point.

    After the first start, the maxima of a separable function fitted to the values are crossed likewise. Where the
    function is separable or nearly so, they are near the highest hill, however many hills there are.
    """
    _climb_and_cross(evaluations, evaluations.top)
    for guess in separable_maxima(evaluations.points, evaluations.values):
        if evaluations.objective.remaining >= EVALUATIONS_PER_COORDINATE * evaluations.dimension and _cross(
            evaluations, guess
        ):
            _climb_and_cross(evaluations, evaluations.top)
    for start in evaluations.starts()[1:]:
        _climb_and_cross(evaluations, start)


def _climb_and_cross(evaluations: _Evaluations, start: Array) -> None:
    """Climb from a start, then cross the result with the best point as long as that improves it."""
    end_point = _climb_from(evaluations, start)
    while _cross(evaluations, end_point):
        end_point = _climb_from(evaluations, evaluations.top)


def _climb_from(evaluations: _Evaluations, start: Array) -> Array:
    """Return the end ``(d,)`` of an ascent, which stops once it can no longer exceed the best value."""
    points, values = evaluations.below(start)
    region, progress, window = TrustRegion(2 * MIN_START_DISTANCE), [float(values.max())], 2 * evaluations.dimension + 4
    while evaluations.objective.remaining:
        point = region.propose(points, values)
        if point is None:
            break
        value = evaluations.evaluate(point)
        region.tell(value)
        points, values = np.vstack([points, point]), np.append(values, value)
        progress.append(max(progress[-1], value))
        missing = float(evaluations.values.max()) - progress[-1]
        if len(progress) > window and missing > 4.0 * (progress[-1] - progress[-1 - window]):
            break
    return np.asarray(points[values.argmax()])


def _cross(evaluations: _Evaluations, other: Array) -> bool:
    """Return whether blocks of another local maximum, each tried alone, improve the best point.

    Local maxima of a nearly separable function may exchange blocks.
    """
    has_improved = False
    for block in np.unique(evaluations.blocks):
        best = evaluations.top
        trial = np.where(evaluations.blocks == block, other, best)
        if not evaluations.objective.remaining or np.abs(trial - best).max() < MIN_START_DISTANCE:
            continue
        before = float(evaluations.values.max())
        has_improved = evaluations.evaluate(trial) > before or has_improved
    return has_improved


def _search_by_compass(evaluations: _Evaluations) -> None:
    """Run a compass search (Hooke and Jeeves 1961).

    The search moves one coordinate at a time up or down, by a step of its own that doubles or halves.
    """
    best, value = evaluations.top.copy(), float(evaluations.values.max())
    steps = np.full(evaluations.dimension, 0.1)
    stride = _choose_stride(evaluations.dimension)
    coordinate = 0
    while evaluations.objective.remaining and steps.max() > 1e-12:
        coordinate = (coordinate + stride) % evaluations.dimension
        is_better = False
        for direction in (steps[coordinate], -steps[coordinate]):
            trial = best.copy()
            trial[coordinate] = min(max(trial[coordinate] + direction, 0.0), 1.0)
            if is_better or trial[coordinate] == best[coordinate] or not evaluations.objective.remaining:
                continue
            trial_value = evaluations.evaluate(trial)
            if trial_value > value:
                best, value, is_better = trial, trial_value, True
        steps[coordinate] = min(0.5, abs(steps[coordinate]) * 2.0) if is_better else 0.5 * steps[coordinate]


def _choose_stride(dimension: int) -> int:
    """Return a step through all coordinates whose order mixes them well: near the golden section, without a common
    factor."""
    stride = max(1, round(0.618 * dimension))
    while np.gcd(stride, dimension) > 1:
        stride += 1
    return stride
