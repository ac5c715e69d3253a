"""Candidates of a walk in a box: reflected steps, of few coordinates at a time, at scales that adapt."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import exp, pi, sqrt, tan
from typing import TYPE_CHECKING

import numpy as np

import sparserob_core as sr

if TYPE_CHECKING:
    from sparserob_simulated_annealing import SimulatedAnnealing

CHUNK = 256
FEW = 3
SMALLEST, LARGEST = 1e-13, 0.5
UNIFORM, ONE, SEVERAL, FULL = 0.0, 1.0, 2.0, 3.0  # what a candidate changes: everything anew, one coordinate, ...
VISITS = 20  # evaluations per scale that are needed to adapt it


class Moves:
    """Source of candidates near a point, which learns from whether they are accepted.

    A step is noise times a scale times the width of the box, so that the units of the coordinates do not matter. In a
    space of tuples (``block > 1``) the scale of a coordinate is that of its place within its block. ``scale`` is that
    of the last candidate, ``kind`` what it changed: `UNIFORM` everything, drawn anew, `ONE` coordinate, `SEVERAL`, or
    `FULL` (all, or a whole block).
    """

    def __init__(self, options: SimulatedAnnealing, objective: sr.Objective, rng: np.random.Generator) -> None:
        domain = objective.domain
        self.options, self.rng, self.lower, self.upper = options, rng, domain.lower, domain.upper
        self.dimension, self.widths = domain.dimension, domain.upper - domain.lower
        self.block = objective.block if objective.block < self.dimension else 1
        self.places = self.block if self.block > 1 else self.dimension
        per_coordinate = options.adapt == "coordinate" and self.places * VISITS <= objective.remaining
        self.several = self.places if per_coordinate else 1
        self.uniforms = _stream(rng.random)
        self.normals = _stream(rng.standard_normal)
        kinds = (options.one, options.few, options.full)
        self.until_one, self.until_few = kinds[0] / sum(kinds), (kinds[0] + kinds[1]) / sum(kinds)
        self.restart()

    def restart(self) -> None:
        """Forget what was learned."""
        self.scales = [self.options.initial_scale] * self.several
        self.factors = {"few": 1.0 / sqrt(2.0), "full": 1.0 / sqrt(self.places)}
        self.scale, self._moved = self.options.initial_scale, ""
        self.kind = UNIFORM
        self._place = 0
        self.acting: np.ndarray | None = None
        self._rests = True

    def uniform(self, count: int) -> np.ndarray:
        """Draw ``count`` points uniformly from the box, ``(count, d)``."""
        points = self.rng.random((count, self.dimension))
        points *= self.widths
        points += self.lower
        return np.clip(points, self.lower, self.upper, out=points)

    def candidate(self, current: np.ndarray, acting: np.ndarray | None = None) -> np.ndarray:
        """Draw a candidate ``(d,)`` for a walk that is at ``current (d,)``; only one array of this size is made.

        ``acting``: the blocks on which the value there rests, by their numbers, as far as that is known; the share of
        the moves that is theirs (``acting`` of the options) changes one of them.
        """
        self.acting, self._rests = acting, acting is None or not acting.size
        if next(self.uniforms) < self.options.exploration:
            self._moved, self.scale, self.kind = "", 1.0, UNIFORM
            return np.asarray(self.uniform(1)[0])
        point = current.copy()
        kind = next(self.uniforms)
        coarse = next(self.uniforms) < self.options.coarse
        if kind < self.until_one or self.dimension == 1:
            self.kind = ONE
            self._one(point, coarse)
            return point
        few = kind < self.until_few and (self.block > 1 or self.dimension > FEW)
        self.kind = SEVERAL if few else FULL
        if self.block > 1:
            self._blocks(point, "few" if few else "full", coarse)
        else:
            self._coordinates(point, "few" if few else "full", coarse)
        return point

    def learn(self, accepted: bool) -> None:
        """Widen the steps of the kind that was taken last if it was accepted, narrow them if not. Nothing is learnt of
        a move of coordinates on which the value does not rest: it would be accepted at any width."""
        if self._moved and self._rests and self.options.adapt != "none":
            change = exp(self.options.adaptation * (float(accepted) - self.options.acceptance))
            if self._moved == "one":
                self.scales[self._place] = min(LARGEST, max(SMALLEST, self.scales[self._place] * change))
            else:
                self.factors[self._moved] = min(10.0, max(1e-6, self.factors[self._moved] * change))

    def _one(self, moved: np.ndarray, coarse: bool) -> None:
        coordinate = self._random_coordinate()
        self._place = coordinate % self.places if self.several > 1 else 0
        self.scale, self._moved = (self.options.initial_scale, "") if coarse else (self.scales[self._place], "one")
        self._shift(moved, coordinate, self.scale)

    def _coordinates(self, moved: np.ndarray, kind: str, coarse: bool) -> None:
        factor, self._moved = (1.0, "") if coarse else (self.factors[kind], kind)
        if kind == "few":
            for _ in range(2 + int(next(self.uniforms) * (FEW - 1))):
                coordinate = self._random_coordinate()
                self.scale = factor * (
                    self.options.initial_scale if coarse else self.scales[coordinate if self.several > 1 else 0]
                )
                self._shift(moved, coordinate, self.scale)
        else:
            self._shift_part(moved, slice(0, self.dimension), factor, coarse)

    def _blocks(self, moved: np.ndarray, kind: str, coarse: bool) -> None:
        count = 1 if kind == "full" else 2 + int(next(self.uniforms) * (FEW - 1))
        self._moved = "" if coarse else kind
        for _ in range(count):
            first = self._random_coordinate() // self.block * self.block
            block = slice(first, first + self.block)
            if coarse:
                self.scale = 1.0
                values = self.lower[block] + self.rng.random(self.block) * self.widths[block]
                moved[block] = np.clip(values, self.lower[block], self.upper[block])
            else:
                self._shift_part(moved, block, self.factors[kind], coarse)

    def _random_coordinate(self) -> int:
        if self.acting is None or not self.acting.size:
            return int(next(self.uniforms) * self.dimension)
        if next(self.uniforms) < self.options.acting:
            self._rests = True
            position = next(self.uniforms) * self.acting.size
            return int(self.acting[int(position)]) * self.block + int(position % 1.0 * self.block)
        coordinate = int(next(self.uniforms) * self.dimension)
        self._rests = self._rests or bool((self.acting == coordinate // self.block).any())
        return coordinate

    def _shift(self, moved: np.ndarray, at: int, scale: float) -> None:
        """Move one coordinate, in place."""
        lower, upper, width = float(self.lower[at]), float(self.upper[at]), float(self.widths[at])
        noise = tan(pi * (next(self.uniforms) - 0.5)) if self.options.step == "cauchy" else next(self.normals)
        shifted = float(moved[at]) + scale * width * noise
        if not lower <= shifted <= upper:
            folded = width - abs(width - (shifted - lower) % (2.0 * width))
            shifted = min(max(lower + folded, lower), upper)
        moved[at] = shifted

    def _shift_part(self, moved: np.ndarray, part: slice, factor: float, coarse: bool) -> None:
        """Move all coordinates of ``part``, in place."""
        lower, upper, widths = self.lower[part], self.upper[part], self.widths[part]
        scales = (
            np.array(self.scales)
            if self.several > 1 and not coarse
            else self.options.initial_scale
            if coarse
            else self.scales[0]
        )
        self.scale = factor * float(np.mean(scales))
        noise = (
            np.tan(pi * (self.rng.random(widths.size) - 0.5))
            if self.options.step == "cauchy"
            else self.rng.standard_normal(widths.size)
        )
        shifted = moved[part] + factor * scales * widths * noise
        outside = (shifted < lower) | (shifted > upper)
        if outside.any():
            low, width = lower[outside], widths[outside]
            shifted[outside] = low + (width - np.abs(width - (shifted[outside] - low) % (2.0 * width)))
        moved[part] = np.clip(shifted, lower, upper)


def _stream(draw: Callable[[int], np.ndarray]) -> Iterator[float]:
    """Yield numbers one at a time, drawn many at a time: a tenth of the cost."""
    while True:
        yield from draw(CHUNK).tolist()
