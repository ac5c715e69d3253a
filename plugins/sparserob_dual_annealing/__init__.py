"""Dual annealing, generalised simulated annealing with local searches, by the implementation in scipy."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

import sparserob_core as sr

# Times a side of the box, and times a value, both of about 1: scipy's visits, the steps of its differences and the gain
# at which its local searches stop are numbers. On a side of 1 differences find fewer digits; with values of 1 a local
# search stops at a gain of 2e-9 of the first one.
SPAN, HEIGHT = 16.0, 1024.0


class DualAnnealing(sr.Maximiser, sr.Options):
    """Generalised simulated annealing (Tsallis and Stariolo 1996) that sends an L-BFGS-B search with finite differences
    from what it finds (Xiang, Sun, Fan and Gong 1997).

    The local searches make it the most accurate of the annealing methods on smooth functions of a few variables; each
    gradient costs ``d + 1`` evaluations, so beyond some hundred dimensions the budget is gone before the first search
    has moved. Its visiting distribution narrows with the temperature and has moves of one coordinate, so Belisle's
    condition (1992) does not hold; ``simulated_annealing`` keeps it. It chooses by its own acceptance, whatever
    selection rule the method was given. In a space of tuples every other step changes every block. It proves no upper
    bound.
    """

    scaled: ClassVar[bool] = True

    initial_temp: float = Field(default=5230.0, gt=0.01, le=5e4)
    """First temperature of the visiting distribution, in scipy's units: higher is wider."""

    visit: float = Field(default=2.62, gt=1.0, lt=3.0)
    """Tail of the visiting distribution (q_v): larger is heavier."""

    accept: float = Field(default=-5.0, gt=-1e4, le=-5.0)
    """Parameter of the acceptance (q_a): lower accepts less that is worse."""

    restart_temp_ratio: float = Field(default=2e-5, gt=0.0, lt=1.0)
    """Temperature, relative to the first one, at which the annealing begins again."""

    no_local_search: bool = False
    """Annealing only."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        from scipy.optimize import dual_annealing

        lower, upper = SPAN * objective.domain.lower, SPAN * objective.domain.upper
        start = SPAN * objective.best_point if objective.evaluations else None
        # scipy renamed the argument (1.15), and knows no end but a count of its iterations: the objective ends the
        # search.
        seed_option: dict[str, Any] = {"rng" if "rng" in inspect.signature(dual_annealing).parameters else "seed": rng}
        minima = _Found(objective)
        while objective.remaining:
            dual_annealing(
                _Energy(objective),
                list(zip(lower, upper, strict=True)),
                maxiter=objective.remaining + 1,
                initial_temp=self.initial_temp,
                restart_temp_ratio=self.restart_temp_ratio,
                visit=self.visit,
                accept=self.accept,
                no_local_search=self.no_local_search,
                x0=start,
                callback=minima.found,
                **seed_option,
            )
        return float("inf")


class _Found:
    """Record of the points where scipy says that the best so far was found, by annealing or by a local search."""

    def __init__(self, objective: sr.Objective) -> None:
        self.objective, self.points = objective, list[np.ndarray]()

    def found(self, point: np.ndarray, energy: float, context: int) -> None:
        """Record a point and return ``None``, as scipy's ``callback`` must for the search to go on."""
        domain = self.objective.domain
        self.points.append(np.clip(point / SPAN, domain.lower, domain.upper))
        self.objective.sketch("the best in turn", np.array(self.points[-60:]))


class _Energy:
    """The negated objective at one point. Where the objective is ``-inf``, which scipy's differences cannot rank, it is
    the worst finite value that was seen."""

    def __init__(self, objective: sr.Objective) -> None:
        self.objective, self.worst = objective, -np.inf

    def __call__(self, point: np.ndarray) -> float:
        domain = self.objective.domain
        value = -HEIGHT * float(
            self.objective.evaluate(np.clip(point / SPAN, domain.lower, domain.upper)[np.newaxis])[0]
        )
        if np.isinf(value):
            return self.worst if np.isfinite(self.worst) else 0.0
        self.worst = max(self.worst, value)
        return value


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``dual_annealing``."""
    yield sr.MaximiserPlugin(
        name="dual_annealing", factory=DualAnnealing, summary="generalised annealing with L-BFGS-B (scipy)"
    )
