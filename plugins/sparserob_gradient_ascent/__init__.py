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
        """See `sparserob_core.Maximiser`."""
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
        """A uniform point of the box."""
        return self.place(SCALE * rng.random(self.width.size))

    def redrawn(self, rng: np.random.Generator) -> sr.Array:
        """The best point, with the blocks anew in which the last gradient there was zero."""
        point, fresh = self.objective.best_point.copy(), self.uniform(rng)
        if not (np.isfinite(point).all() and np.array_equal(point, self.at)):
            return fresh
        still = ~self.slope.reshape(-1, self.objective.block).any(axis=1)
        idle = np.repeat(still, self.objective.block)
        point[idle] = fresh[idle]
        return point if idle.any() else fresh

    def place(self, scaled: sr.Array) -> sr.Array:
        """The point of the box."""
        return np.clip(self.domain.lower + scaled / SCALE * self.width, self.domain.lower, self.domain.upper)

    def run(self, start: sr.Array, steps: int) -> None:
        """One ascent; a value of ``-inf`` is shown to the local method as the worst that was seen."""
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
        """The negated objective and its gradient."""
        point = self.place(scaled)
        value, slope = (
            self.objective.value_and_gradient(point) if self.objective.differentiable else self.differences(point)
        )
        if np.isfinite(value):
            self.worst = min(self.worst, value)
        if np.array_equal(point, self.objective.best_point):
            self.slope, self.at = slope, point
        self.objective.note(ascent=self.ascent, slope=float(np.abs(slope * self.width).max()))
        shown = value if np.isfinite(value) else (self.worst if np.isfinite(self.worst) else 0.0)
        return -shown, -slope * self.width / SCALE

    def differences(self, point: sr.Array) -> tuple[float, sr.Array]:
        """One-sided differences, inwards, in batches that fit into memory; 0 where a value is not finite."""
        value, slope = float(self.objective.evaluate(point[np.newaxis])[0]), np.zeros(point.size)
        inside = point + STEP * self.width <= self.domain.upper
        moved = np.clip(point + np.where(inside, STEP, -STEP) * self.width, self.domain.lower, self.domain.upper)
        batch = max(1, NUMBERS // point.size)
        for first in range(0, point.size if np.isfinite(value) else 0, batch):
            axes = np.arange(first, min(first + batch, point.size))
            beside = np.repeat(point[np.newaxis], axes.size, axis=0)
            beside[np.arange(axes.size), axes] = moved[first : first + batch]
            values, run = self.objective.evaluate(beside), moved[first : first + batch] - point[axes]
            usable = np.isfinite(values) & (run != 0.0)
            slope[axes[usable]] = (values[usable] - value) / run[usable]
        return value, slope


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``gradient_ascent``."""
    yield sr.MaximiserPlugin(
        name="gradient_ascent", factory=GradientAscent, summary="quasi-Newton ascents along the gradient, with restarts"
    )
