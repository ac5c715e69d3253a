"""The optimisers of nevergrad, by name, through ask and tell."""

from __future__ import annotations

import math
from collections.abc import Iterator
from difflib import get_close_matches
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

import sparserob_core as sr
from sparserob_nevergrad.guarded import Failed, Guarded, within

SHOWN_EVERY = 16  # evaluations


class Nevergrad(sr.Maximiser, sr.Options):
    """Optimiser of nevergrad's registry, any of them (Rapin and Teytaud 2018): evolution strategies, differential
    evolution, particle swarms, and portfolios of them such as NGOpt, which chooses by dimension and budget.

    An optional extra: ``pip install nevergrad``. It works in the unit box, one point at a time, with its
    random numbers drawn from the generator of the search and the global ones left as they were. Some of nevergrad's
    portfolios are not repeatable all the same: NGOpt in three dimensions or more may run ``cma.fmin2``, which takes its
    seed from the clock. Where the function has no value it is given the loss 1e20. What an optimiser guarantees, and in
    how many dimensions it is of use, nevergrad's documentation says for each; in a space of tuples nearly all of them
    change every block at each step. It proves no upper bound.

    An optimiser that raises does not end the run. The exception is reported in one warning, and the search goes on with
    ``fallback``, which is given all that was evaluated, or else the best of it. (That NGOpt and its relatives raise
    with numpy 2.4 or later, for an array of one number, is mended here.)

    Its own time is 0.2 to 20 milliseconds for each evaluation, to which less than a tenth of a millisecond is added
    here: half of it keeps the account of the search. Importing it takes seconds. Notes ``spread``: the distance, root
    mean square over the coordinates and in widths of the box, of each evaluated point from the best one.
    """

    scaled: ClassVar[bool] = True

    optimiser: str = Field(default="TwoPointsDE", min_length=1)
    """A name in nevergrad's registry: CMA, DE, NGOpt, OnePlusOne, PSO, TBPSA, TwoPointsDE, ..."""

    fallback: str | None = Field(default="CMA", min_length=1)
    """The optimiser that goes on when the first one raises; none: the search ends there, with what was found."""

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        import warnings

        registry = _registry()
        names = [
            _known(key, name, registry)
            for key, name in (("optimiser", self.optimiser), ("fallback", self.fallback))
            if name
        ]
        walk = _AskAndTell(objective, rng)
        for name, next_name in zip(names, [*names[1:], None], strict=True):
            try:
                walk.run(Guarded(registry[name], objective.domain.dimension, objective.remaining, rng))
            except Failed as failure:
                reason = (
                    f"nevergrad's {name} failed after {objective.evaluations} evaluations ({failure}); the search "
                    + (f"goes on with {next_name}" if next_name else "ends here")
                )
                warnings.warn(reason, stacklevel=2)
                if next_name is None:
                    raise _ended(objective, reason) from failure
            else:
                break
        return float("inf")


class _AskAndTell:
    """Record of the points and losses so far, in the unit box."""

    def __init__(self, objective: sr.Objective, rng: np.random.Generator) -> None:
        self.objective, self.lower, self.upper = objective, objective.domain.lower, objective.domain.upper
        self.width = self.upper - self.lower
        self.told: list[tuple[np.ndarray, float]] = []
        self.best, self.top = np.full(self.lower.size, np.nan), -np.inf  # the best point in the unit box, and its value
        if objective.evaluations:
            self.told.append((self._unit(objective.best_point), _loss(objective.best_value)))

    def run(self, optimiser: Guarded) -> None:
        """Ask, evaluate and tell until the budget is spent; raises `Failed` when the optimiser does."""
        try:
            optimiser.learn(self.told)
            loss = None
            while self.objective.remaining:
                unit = optimiser.next(loss)
                point = within(self.lower + unit * self.width, self.lower, self.upper)
                value = float(self.objective.evaluate(point[np.newaxis])[0])
                loss = _loss(value)
                self.told.append((unit, loss))
                self.objective.note(spread=self._spread(unit))
                if self.objective.observed and self.objective.evaluations % SHOWN_EVERY == 0:
                    self._show(optimiser.population())
        finally:
            optimiser.close()

    def _show(self, units: np.ndarray) -> None:
        """Show where the population is, for an optimiser that has one."""
        if len(units):
            self.objective.sketch("population", self.lower + units * self.width)

    def _unit(self, moved: np.ndarray) -> np.ndarray:
        return within((moved - self.lower) / self.width, 0.0, 1.0)

    def _spread(self, unit: np.ndarray) -> float:
        if self.objective.best_value != self.top or np.isnan(self.best[0]):
            self.best, self.top = self._unit(self.objective.best_point), self.objective.best_value
        deviation = unit - self.best
        return math.sqrt(float(deviation @ deviation) / deviation.size)


def _loss(value: float) -> float:
    return min(max(-value, -1e20), 1e20)


def _ended(objective: sr.Objective, reason: str) -> Exception:
    """Return the end of the search if something was found, else the fault of the plugin."""
    return sr.SearchEnded(reason) if objective.evaluations else sr.PluginError(reason)


def _known(key: str, name: str, registry: Any) -> str:
    if name in registry:
        return name
    nearest = get_close_matches(name, list(registry), 1, 0.0)
    raise sr.InputError(f"nevergrad: {key}: there is no optimiser {name!r}; the nearest name is {nearest[0]!r}")


def _registry() -> Any:
    import warnings

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from nevergrad.optimization import metamodel, registry
    except ImportError as error:
        raise sr.UnknownPluginError(f"nevergrad: {sr.not_installed('nevergrad')}") from error
    # It calls float() with an array of one number, which numpy 2.4 and later refuse, and so fails in NGOpt.
    metamodel.float = _number
    return registry


def _number(value: Any) -> float:
    """Return the only entry of an array, or the number itself, as a float."""
    return float(np.asarray(value).item()) if isinstance(value, np.ndarray) else float(value)


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``nevergrad``."""
    yield sr.MaximiserPlugin(
        name="nevergrad",
        factory=Nevergrad,
        summary="any optimiser of nevergrad (extra)",
        needs=("nevergrad", "nevergrad"),
    )
