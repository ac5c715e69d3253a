"""LIPO and AdaLIPO: only points are evaluated that, by a Lipschitz constant, can still beat the best value."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator

import numpy as np
from pydantic import Field

import sparserob_core as sr
from sparserob_lipo.bound import lipschitz_bound
from sparserob_lipo.walk import Walk


class Lipo(sr.Maximiser, sr.Options):
    """LIPO (Malherbe and Vayatis, ICML 2017) for a function whose Lipschitz constant is known.

    A point ``x`` is evaluated only if ``min_i f(x_i) + constant |x - x_i| >= max_i f(x_i)``. Candidates are drawn in
    turn from the whole box and from ever smaller boxes around the best point; the first of each evaluation is uniform.
    If the constant is right, the best value after ``n`` evaluations is therefore never below that of the ``n``
    independent uniform points that these first candidates are, seed by seed. The paper compares the distributions for
    uniform candidates, and proves an exponentially falling regret where ``f* - f(x) >= c |x - x*|``. Where 1024
    candidates are excluded, that of the highest bound among the last is evaluated: the search never hangs.

    Upper bound: the highest Lipschitz bound over a partition of the box, proven provided that the constant is one;
    ``inf`` without a constant, when two values or a value of ``-inf`` refute it, or when the search is ended before its
    budget.

    In high dimension: balls cover a vanishing part of the box, nothing is excluded, and the search tends to pure random
    search; the bound says little. It is for costly functions of up to some five coordinates. An evaluation costs time
    in proportion to those before it. Permutations of an index tuple are different points to it.
    """

    constant: float | None = Field(default=None, gt=0.0)
    """A Lipschitz constant: ``|f(x) - f(y)| <= constant |x - y|`` in the Euclidean norm and the box's own units.
    ``null``: none is known, so nothing can be excluded, and the search is pure random search; ``adalipo`` estimates
    one."""

    @property
    def polished(self) -> float:
        """Share of the budget for a local method: none, as the evaluations make the upper bound."""
        return 0.0

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return an upper bound, ``inf`` without a constant; see
        `sparserob_core.Maximiser`."""
        walk = Walk(objective, rng, uniform_scale=True)
        if self.constant is None:
            while objective.remaining:
                walk.explore()
            return math.inf
        constant = self.constant * float(walk.scale[0])
        while objective.remaining:
            walk.exploit(constant)
            walk.note(constant)
        bound = math.inf if walk.undefined else lipschitz_bound(walk.evaluated, constant, walk.sides / walk.scale)
        return max(objective.best_value, bound)


class AdaLipo(sr.Maximiser, sr.Options):
    """AdaLIPO (Malherbe and Vayatis, ICML 2017): LIPO with an estimate of the Lipschitz constant.

    With probability ``exploration`` the next point is uniform; otherwise it is a candidate that `Lipo`'s test admits
    with the estimate: the smallest ``unit (1 + growth)^i``, ``i`` an integer, that is no smaller than the steepest
    slope between any two evaluated points; ``unit`` is the power of two below the first such slope. Distances are taken
    in the unit cube that the box is scaled to, so units of the coordinates and of the value do not matter; on a cube
    this is the paper's rule.

    Consistent for every Lipschitz function because ``exploration > 0`` (proven there), however the other candidates are
    drawn: as in `Lipo` in turn from the whole box and from ever smaller boxes around the best point, 1024 at most, then
    one of a high bound. It proves no upper bound. Values of ``-inf`` take
    no part in the slopes.

    In high dimension: nearly nothing is excluded, and the search tends to pure random search. A function that is not
    Lipschitz, or noise, drives the estimate up with the same effect. It is for costly functions of up to some five
    coordinates. An evaluation costs time in proportion to those before it. Permutations of an index tuple are different
    points to it.
    """

    exploration: float = Field(default=0.1, gt=0.0, le=1.0)
    """Probability that a point is uniform; the paper's experiments: 0.1."""

    growth: float | None = Field(default=None, gt=0.0, le=10.0)
    """Spacing of the grid of constants; ``null``: 0.01 divided by the number of coordinates, as in the paper's
    experiments."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        walk = Walk(objective, rng, uniform_scale=False)
        ratio = math.log1p(self.growth or 0.01 / walk.dimension)
        unit = 0.0
        while objective.remaining:
            unit = unit or _power_of_two(walk.evaluated.slope)
            constant = min(unit * _on_grid(walk.evaluated.slope / (unit or 1.0), ratio), sys.float_info.max)
            if rng.random() < self.exploration:
                walk.explore()
            else:
                walk.exploit(constant)
            walk.note(constant)
        return math.inf


def _power_of_two(slope: float) -> float:
    """Return the power of two next below a slope, which is the unit of its grid; 0 for a slope of 0 or beyond all
    numbers."""
    return math.ldexp(1.0, math.frexp(slope)[1] - 1) if 0.0 < slope < math.inf else 0.0


def _on_grid(slope: float, ratio: float) -> float:
    """Return the smallest ``exp(ratio i)``, ``i`` an integer, that is not below the slope; 0 for a slope of 0."""
    if slope == 0.0:
        return 0.0
    return max(slope, math.exp(min(ratio * math.ceil(math.log(slope) / ratio), 709.0)))


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``lipo`` and ``adalipo``."""
    yield sr.MaximiserPlugin(
        name="lipo", factory=Lipo, summary="LIPO for a known Lipschitz constant, with an upper bound"
    )
    yield sr.MaximiserPlugin(name="adalipo", factory=AdaLipo, summary="LIPO with an estimated Lipschitz constant")
