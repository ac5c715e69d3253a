"""MaxLIPO with a trust region: every other point maximises an upper bound fitted to the values, every other one climbs
from the best."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import Field

import sparserob_core as sr
from sparserob_maxlipo.ascents import Ascents
from sparserob_maxlipo.ceiling import Ceiling
from sparserob_maxlipo.slopes import Slopes

MODELLED = 30
"""Most coordinates for which the trust region fits quadratics."""
SECONDARY = 6
"""Global steps before a local one, once the best point is a local maximum and ascents begin lower."""


NUMBERS = 2**17
"""Coordinates of the candidates of one global step: as many candidates as a user asks for up to 131 coordinates. Ten
times as many, and a step over thousands of coordinates takes a tenth of a second, though the highest candidate is there
hardly better than any; a tenth, and from 13 coordinates on there are fewer than what was asked for."""


class MaxLIPO(sr.Maximiser, sr.Options):
    """MaxLIPO+TR as in dlib (King 2017, after LIPO of Malherbe and Vayatis 2017), reproducible and about ten times as
    fast.

    ``U(x) = min_i y_i + sqrt(o_i + sum_j s_j (x_j - x_ij)^2)`` with the least slopes ``s`` and per-point noise ``o``
    (which absorbs jumps) such that ``U(x_i) >= y_i`` at all evaluated points, up to a millionth of the spread of the
    values. Steps alternate: the highest of many random candidates under ``U``, and a step of
    `sparserob_core.TrustRegion` from the best point. When that has converged, every seventh step climbs from the next
    best point elsewhere. The first point is the centre of the box; a share is uniform, so that the search is
    consistent.

    ``U`` is fitted, not known: it bounds nothing with proof, and ``inf`` is returned. The slopes need few evaluations
    only in few coordinates; as their number grows the highest candidate becomes just another uniform point. Beyond 30
    coordinates that move, quadratics are not fitted either: the local step is then the best candidate, under ``U``, of
    those that change one or few blocks of the best point. The time per evaluation grows in proportion to their number:
    use it for functions that take a millisecond or more.

    Notes ``local`` (0 or 1, of the last step) and, in widths of the box, the ``radius`` of the trust region while
    quadratics are fitted, else the ``reach`` of the local step: half of the changes that it draws are shorter.
    """

    candidates: int = Field(default=1000, ge=10, le=100_000)
    """Random points of which the one with the highest bound is evaluated; fewer beyond 131 coordinates, where they are
    nearly alike."""

    uniform: float = Field(default=0.02, ge=0.0, le=1.0)
    """Share of the global steps that take a uniform point instead; 0 gives up consistency."""

    trust_region: bool = True
    """Whether every other step is local."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        steps = _Steps(objective, rng)
        steps.begin()
        global_steps = 0
        while objective.remaining:
            if (
                self.trust_region
                and global_steps >= (SECONDARY if steps.ascents.secondary else 1)
                and steps.step_locally()
            ):
                global_steps = 0
            else:
                steps.step_globally(self.candidates, self.uniform)
                global_steps += 1
            steps.note(local=global_steps == 0)
        return float("inf")


class _Steps:
    """State of one search: the evaluated points in the unit box, and the two kinds of step."""

    def __init__(self, objective: sr.Objective, rng: np.random.Generator) -> None:
        self.objective, self.rng, self.dimension = objective, rng, objective.domain.dimension
        _, self.blocks = np.unique(np.arange(self.dimension) // objective.block, return_inverse=True)
        self.slopes, self.ceiling = Slopes(self.dimension, objective.remaining + 1), Ceiling()
        self.ascents, self.reach = Ascents(self.slopes), 0.1

    def begin(self) -> None:
        """Evaluate the centre, or take over the point that an earlier search has found; then evaluate uniform points up
        to ``max(3, d)``, at most thirty."""
        domain, objective = self.objective.domain, self.objective
        if objective.evaluations and np.isfinite(objective.best_value):
            unit = (objective.best_point - domain.lower) / (domain.upper - domain.lower)
            self.slopes.add(np.clip(unit, 0.0, 1.0), objective.best_value)
        else:
            self.evaluate(np.full(self.dimension, 0.5))
        while objective.remaining and self.slopes.count < min(max(3, self.dimension), 30):
            self.evaluate(self.rng.random(self.dimension))

    def evaluate(self, unit: np.ndarray) -> float:
        domain = self.objective.domain
        point = domain.lower + unit * (domain.upper - domain.lower)
        value = float(self.objective.evaluate(np.clip(point, domain.lower, domain.upper)[np.newaxis])[0])
        self.slopes.add(unit, value)
        return value

    def note(self, local: bool) -> None:
        """Note which kind the last step was, and how far the local ones go from the best point."""
        fitted = self.dimension <= MODELLED
        reach = self.ascents.radius if fitted else self.reach
        self.objective.note(local=float(local), **{"radius" if fitted else "reach": reach})
        if self.objective.observed and reach > 0.0:
            domain = self.objective.domain
            ends = np.array([self.slopes.top - reach, self.slopes.top + reach])
            lower, upper = domain.lower + ends * (domain.upper - domain.lower)
            role = "trust region" if fitted else "reach of a local step"
            self.objective.sketch(role, lower[np.newaxis], upper[np.newaxis], rounded=fitted)

    def step_locally(self) -> bool:
        """Make a local step; return whether there was one to make."""
        if not np.isfinite(self.slopes.best):
            return False
        if self.dimension > MODELLED:
            self._change_blocks()
            return True
        point = self.ascents.propose()
        if point is None:
            return False
        self.ascents.tell(self.evaluate(point))
        return True

    def step_globally(self, candidates: int, uniform: float) -> None:
        slopes = self.slopes
        if self.rng.random() < uniform or not np.isfinite(slopes.best):
            point = self.rng.random(self.dimension)
        else:
            count = min(candidates, max(10, NUMBERS // self.dimension))
            point = self.ceiling.highest(slopes, self.rng.random((count, self.dimension)))
        value = self.evaluate(point)
        if self.dimension <= MODELLED:
            self.ascents.note_global(point, value)

    def _change_blocks(self) -> None:
        """Evaluate a change of one or few blocks of the best point, adapted to success, where there are too many
        coordinates for a model."""
        slopes, rng = self.slopes, self.rng
        trials, blocks = np.repeat(slopes.top[np.newaxis], 32, axis=0), int(self.blocks[-1]) + 1
        for trial in trials:
            is_moved = np.zeros(blocks, dtype=bool)
            is_moved[rng.integers(blocks, size=rng.integers(1, 4))] = True
            is_changed = is_moved[self.blocks]
            trial[is_changed] += self.reach * rng.standard_cauchy(int(is_changed.sum()))
        trials = 1.0 - np.abs(1.0 - np.abs(trials) % 2.0)
        best = slopes.best
        is_better = self.evaluate(self.ceiling.highest(slopes, trials)) > best
        self.reach = min(0.5, 1.5 * self.reach) if is_better else max(1e-6, 0.93 * self.reach)


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``maxlipo``."""
    yield sr.MaximiserPlugin(
        name="maxlipo", factory=MaxLIPO, summary="fitted upper bound and trust region in turn, for costly functions"
    )
