"""CMA-ES, the evolution strategy that adapts its covariance, by the package of its author, with restarts."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

import sparserob_core as sr

FULL = 100
"""Most coordinates with a full covariance: one of a thousand takes 8 MB, and as many evaluations as coordinates to
learn anything. Ten times fewer would lose the turned ellipsoids in ten coordinates, which it is for."""


class CMA(sr.Maximiser, sr.Options):
    """Covariance matrix adaptation (Hansen and Ostermeier 2001), by the package ``cma``, started anew with a larger
    population whenever it has converged (IPOP: Auger and Hansen 2005).

    A generation is evaluated in one batch. It begins at the best point that is known, if there is one, and else at a
    uniform point of the box, as every restart does. It learns which directions are steep, however they are turned: what
    other searches lose on narrow ridges it wins, for some hundred evaluations in each coordinate. Beyond a hundred
    coordinates the covariance stays diagonal. It proves no upper bound.

    An optional extra: ``pip install cma``. Notes ``sigma``, the step in widths of the box, for every generation.
    """

    scaled: ClassVar[bool] = True

    sigma: float = Field(default=0.25, gt=0.0, le=1.0)
    """First step, as a share of the box."""

    population: int | None = Field(default=None, ge=2)
    """Points of the first generation; ``null``: four, and three for each factor of e in the number of coordinates."""

    growth: float = Field(default=2.0, ge=1.0)
    """The factor by which the population grows at a restart."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        strategies = 0

        def create(dimension: int, budget: int, rng: np.random.Generator) -> _Strategy:
            nonlocal strategies
            start = rng.random(dimension)
            if not strategies and objective.evaluations:
                domain = objective.domain
                start = np.clip((objective.best_point - domain.lower) / (domain.upper - domain.lower), 0.0, 1.0)
            first = self.population or int(4 + 3 * np.log(dimension))
            strategies += 1
            return _Strategy(objective, start, self.sigma, int(first * self.growth ** (strategies - 1)), rng)

        return sr.from_ask_tell(create).search(objective, rng)


class _Strategy:
    """Descent of CMA-ES in the unit box; its warnings, such as that all losses are equal, are nobody's concern."""

    def __init__(
        self, objective: sr.Objective, start: np.ndarray, sigma: float, population: int, rng: np.random.Generator
    ) -> None:
        self.objective = objective
        options = {
            "bounds": [0.0, 1.0],
            "popsize": population,
            "randn": lambda *shape: rng.standard_normal(shape),
            "seed": np.nan,  # which leaves the random numbers of the process alone
            "CMA_diagonal": start.size > FULL,
            "maxstd_boundrange": np.inf,  # a limit that cannot be set in one dimension, and the bounds limit enough
            "verbose": -9,
            "verb_log": 0,
        }
        with _quiet():
            self.strategy: Any = _package().CMAEvolutionStrategy(start, sigma, options)

    def ask(self) -> Any:
        with _quiet():
            return self.strategy.ask()

    def tell(self, asked: Any, losses: Any) -> None:
        with _quiet():
            self.strategy.tell(asked, losses)
        self.objective.note(sigma=float(self.strategy.sigma))

    def stop(self) -> bool:
        with _quiet():
            return bool(self.strategy.stop())


@contextmanager
def _quiet() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _package() -> Any:
    try:
        import cma
    except ImportError as error:
        raise sr.UnknownPluginError(f"cma: {sr.not_installed('cma')}") from error
    return cma


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``cma``."""
    yield sr.MaximiserPlugin(
        name="cma",
        factory=CMA,
        summary="evolution strategy that adapts its covariance, with restarts (extra)",
        needs=("cma", "cma"),
    )
