"""Ascent along the gradient from many starts: for functions that have one, such as the relaxed value ``g`` of a tuple
of indices."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
from pydantic import Field

import sparserob_core as sr

STEP = 1e-6  # of a side, for differences where no gradient is offered
NUMBERS = 1_000_000  # in one batch of points
SCALE = 10.0  # length of the box's sides for the local method, whose first step has length 1


class GradientAscent(sr.Maximiser, sr.Options):
    """Projected quasi-Newton ascent (L-BFGS-B: Byrd, Lu, Nocedal and Zhu 1995) from the best point and from new starts,
    until the budget is spent.

    A start is uniform in the box or, with probability ``redraw``, the best point with those blocks of coordinates drawn
    anew in which the gradient vanishes there: of a tuple of indices these are the ones that impose nothing, and the
    others are kept. Where the blocks are linear in some coordinates (`Objective.linear`), as tuples of literal indices
    are, `block_ascent` comes first. With gradients, one evaluation is one step in any dimension; without, each gradient
    is taken from differences and costs an evaluation per coordinate, so that in high dimension little is left. Where
    the function has kinks, as ``g`` does, a local method may stop at one: the restarts are what it relies on. Proves no
    upper bound.

    Notes ``ascent`` (its number, from 1) and ``slope`` (the largest entry of the gradient, per width of the box) at
    every step.
    """

    scaled: ClassVar[bool] = True
    whole: ClassVar[bool] = False

    redraw: float = Field(default=0.5, ge=0.0, le=1.0)
    """Share of the restarts that keep the blocks of the best point with a gradient, and draw the others anew."""

    steps: int = Field(default=50, ge=1)
    """Evaluations of one ascent at most."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        climb = _Climb(objective)
        start = objective.best_point if objective.evaluations else climb.uniform(rng)
        if objective.linear is not None:
            sr.block_ascent(objective, start)
            start = objective.best_point
        while objective.remaining:
            climb.run(start, self.steps)
            start = climb.redrawn(rng) if rng.random() < self.redraw else climb.uniform(rng)
        return float("inf")


class _Climb:
    """Ascents in the coordinates ``s (d,)`` of ``[0, SCALE]``."""

    def __init__(self, objective: sr.Objective) -> None:
        self.objective, self.domain = objective, objective.domain
        self.width = objective.domain.upper - objective.domain.lower
        self.slope, self.at, self.worst, self.ascent = np.zeros(objective.domain.dimension), np.zeros(0), np.inf, 0

    def uniform(self, rng: np.random.Generator) -> sr.Array:
        """Draw a uniform point of the box."""
        return self.place(SCALE * rng.random(self.width.size))

    def redrawn(self, rng: np.random.Generator) -> sr.Array:
        """Return the best point, with the blocks drawn anew in which the last gradient there was zero."""
        point, uniform_point = self.objective.best_point.copy(), self.uniform(rng)
        if not (np.isfinite(point).all() and np.array_equal(point, self.at)):
            return uniform_point
        is_flat = ~self.slope.reshape(-1, self.objective.block).any(axis=1)
        is_idle = np.repeat(is_flat, self.objective.block)
        point[is_idle] = uniform_point[is_idle]
        return point if is_idle.any() else uniform_point

    def place(self, scaled: sr.Array) -> sr.Array:
        """Return the point of the box at the coordinates ``scaled (d,)``."""
        return np.clip(self.domain.lower + scaled / SCALE * self.width, self.domain.lower, self.domain.upper)

    def run(self, start: sr.Array, steps: int) -> None:
        """Run one ascent; a value of ``-inf`` is shown to the local method as the worst that was seen."""
        from scipy.optimize import minimize

        self.ascent += 1
        scaled = np.clip((start - self.domain.lower) / self.width, 0.0, 1.0) * SCALE
        minimize(
            self.descent,
            scaled,
            jac=True,
            method="L-BFGS-B",
            bounds=[(0.0, SCALE)] * scaled.size,
            options={"maxfun": steps, "maxiter": steps, "ftol": 1e-15, "gtol": 1e-14},
        )

    def descent(self, scaled: sr.Array) -> tuple[float, sr.Array]:
        """Return the negated objective and its gradient at ``scaled (d,)``."""
        point = self.place(scaled)
        value, slope = (
            self.objective.value_and_gradient(point) if self.objective.differentiable else self.differences(point)
        )
        if np.isfinite(value):
            self.worst = min(self.worst, value)
        if np.array_equal(point, self.objective.best_point):
            self.slope, self.at = slope, point
        self.objective.note(ascent=self.ascent, slope=float(np.abs(slope * self.width).max()))
        finite_value = value if np.isfinite(value) else (self.worst if np.isfinite(self.worst) else 0.0)
        return -finite_value, -slope * self.width / SCALE

    def differences(self, point: sr.Array) -> tuple[float, sr.Array]:
        """Return the value and one-sided differences, taken inwards in batches that fit into memory; 0 where a value is
        not finite."""
        value, slope = float(self.objective.evaluate(point[np.newaxis])[0]), np.zeros(point.size)
        is_inside = point + STEP * self.width <= self.domain.upper
        shifted = np.clip(point + np.where(is_inside, STEP, -STEP) * self.width, self.domain.lower, self.domain.upper)
        batch = max(1, NUMBERS // point.size)
        for first in range(0, point.size if np.isfinite(value) else 0, batch):
            axes = np.arange(first, min(first + batch, point.size))
            points = np.repeat(point[np.newaxis], axes.size, axis=0)
            points[np.arange(axes.size), axes] = shifted[first : first + batch]
            values, steps = self.objective.evaluate(points), shifted[first : first + batch] - point[axes]
            is_usable = np.isfinite(values) & (steps != 0.0)
            slope[axes[is_usable]] = (values[is_usable] - value) / steps[is_usable]
        return value, slope


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``gradient_ascent``."""
    yield sr.MaximiserPlugin(
        name="gradient_ascent", factory=GradientAscent, summary="quasi-Newton ascents along the gradient, with restarts"
    )
