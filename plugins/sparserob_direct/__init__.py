"""DIRECT, the deterministic division of a box into ever smaller rectangles, by the implementation in scipy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydantic import Field

import sparserob_core as sr


class Direct(sr.Maximiser, sr.Options):
    """Dividing rectangles (Jones, Perttunen and Stuckman 1993), with the local bias of Gablonsky and Kelley (2001)
    unless switched off.

    Deterministic: the generator is not used. It proves no upper bound.
    """

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
        self.objective, self.worst = objective, -np.inf

    def __call__(self, point: np.ndarray) -> float:
        domain = self.objective.domain
        if not self.objective.remaining:
            return self._substitute()
        value = -float(self.objective.evaluate(np.clip(point, domain.lower, domain.upper)[np.newaxis])[0])
        if np.isinf(value):
            return self._substitute()
        self.worst = max(self.worst, value)
        return value

    def _substitute(self) -> float:
        return self.worst if np.isfinite(self.worst) else 0.0


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``direct``."""
    yield sr.MaximiserPlugin(name="direct", factory=Direct, summary="dividing rectangles, deterministic (scipy)")
