"""Search that both methods share: draw candidates until one can still beat the best value, evaluate it, and learn from
it."""

from __future__ import annotations

from typing import Final

import numpy as np

import sparserob_core as sr
from sparserob_lipo.evaluated import Evaluated

MAX_DRAWS: Final = 1024  # candidates per evaluation
FAIR_DRAWS: Final = 64  # of which every other one is uniform; of the later ones every eighth
FEWEST: Final = 8
MAX_AT_ONCE: Final = 256
DRAWS_PER_HALVING: Final = 32  # candidates in boxes around the best point until these are half as large
MAX_HALVINGS: Final = 40  # a box of 1e-12 of the sides; much smaller ones would repeat the best point
BLOCK_NUMBERS: Final = 2**17  # coordinates of the candidates that are drawn at once
SHOWN_EVERY: Final = 16  # evaluations
SHOWN: Final = 400  # balls, which is what a sketch keeps
WORK: Final = 2**31  # differences of coordinates that the candidates of one evaluation may cost


class Walk:
    """Search that evaluates one point after the other, in coordinates ``z = (x - lower) / scale``.

    ``scale`` is the length of the longest side, or ``(d,)`` that of each: then ``z`` lies in the unit cube. Values of
    ``-inf`` are counted, and take no part in slopes and exclusions.
    """

    def __init__(self, objective: sr.Objective, rng: np.random.Generator, uniform_scale: bool) -> None:
        self.objective, self.rng = objective, rng
        self.lower, self.upper = objective.domain.lower, objective.domain.upper
        self.dimension = objective.domain.dimension
        self.sides = self.upper - self.lower
        self.scale = np.full_like(self.sides, self.sides.max()) if uniform_scale else self.sides
        self.evaluated = Evaluated(self.dimension, objective.remaining + 1)
        self.undefined, self.drawn, self.rejected, self._last, self._skipped = 0, 0, 0, FEWEST, 0
        if objective.evaluations and np.isfinite(objective.best_value):
            self.evaluated.add(self._scaled(objective.best_point), objective.best_value)

    def explore(self) -> None:
        """Evaluate a uniform point."""
        self._evaluate(self._inside(self.rng.random(self.dimension)))

    def exploit(self, constant: float) -> None:
        """Evaluate the first candidate that the constant does not exclude. Where it excludes all, evaluate that of the
        highest bound among the last."""
        if not self.evaluated.count:
            self.explore()
            return
        drawn, size = 0, self._last
        max_draws = min(MAX_DRAWS, max(2 * FEWEST, WORK // (self.evaluated.count * self.dimension)))
        while True:
            size = max(1, min(size, max_draws - drawn, MAX_AT_ONCE, BLOCK_NUMBERS // self.dimension))
            points = self._candidates(drawn, size)
            scaled = self._scaled(points)
            first = self.evaluated.first_possible(scaled, constant)
            if first is not None or drawn + size >= max_draws:
                break
            drawn, size = drawn + size, 2 * size
        chosen = int(np.argmax(self.evaluated.bounds(scaled, constant))) if first is None else first
        draw_count = drawn + (size if first is None else first + 1)
        self.drawn, self.rejected = self.drawn + draw_count, self.rejected + draw_count - (first is not None)
        self._last = max(FEWEST, draw_count)
        # towards boxes half as deep as the last that were needed
        self._skipped = (self._skipped + max(0, draw_count - FAIR_DRAWS)) // 2
        self._evaluate(points[chosen])

    def note(self, constant: float) -> None:
        """Note the constant in use, in units of the value per unit of ``z``, and the share of candidates that it has
        excluded. Show now and then the largest of the balls that it excludes."""
        is_shown = self.objective.observed and self.objective.evaluations % SHOWN_EVERY == 0
        if is_shown and constant > 0.0 and self.evaluated.count:
            centres, radii = self.evaluated.balls(constant, SHOWN)
            middles, reach = self.lower + self.scale * centres, radii[:, np.newaxis] * self.scale
            self.objective.sketch("excluded", middles - reach, middles + reach, rounded=True)
        self.objective.note(constant=constant, rejected=self.rejected / max(1, self.drawn))

    def _candidates(self, drawn: int, count: int) -> np.ndarray:
        """Draw the candidates number ``drawn, ...``: uniform ones, number 0 among them, and others in ever smaller
        boxes around the best point."""
        numbers = np.arange(drawn, drawn + count)
        points = self._inside(self.rng.random((count, self.dimension)))
        is_near = np.where(numbers < FAIR_DRAWS, numbers % 2, numbers % 8) > 0
        if is_near.any():
            late_numbers = np.maximum(numbers - FAIR_DRAWS, 0)
            # candidates in boxes before this one
            steps = np.minimum(numbers, FAIR_DRAWS) // 2 + late_numbers - (late_numbers + 7) // 8
            steps = np.minimum(steps + np.where(late_numbers > 0, self._skipped, 0), MAX_HALVINGS * DRAWS_PER_HALVING)
            reach = np.exp2(-steps[is_near] / DRAWS_PER_HALVING)[:, np.newaxis] * self.sides
            best = self.lower + self.scale * self.evaluated.best_point
            low, high = np.maximum(best - reach, self.lower), np.minimum(best + reach, self.upper)
            share = self.rng.random((len(reach), self.dimension))
            points[is_near] = np.clip(low + share * (high - low), self.lower, self.upper)
        return points

    def _inside(self, unit: np.ndarray) -> np.ndarray:
        return np.clip(self.lower + unit * self.sides, self.lower, self.upper)

    def _scaled(self, points: np.ndarray) -> np.ndarray:
        scaled: np.ndarray = (points - self.lower) / self.scale
        return scaled

    def _evaluate(self, point: np.ndarray) -> None:
        value = float(self.objective.evaluate(point[np.newaxis])[0])
        if np.isfinite(value):
            self.evaluated.add(self._scaled(point), value)
        else:
            self.undefined += 1
