"""Other people's optimisers as maximisers: those that are asked and told, and functions that minimise from a start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, final

import numpy as np

from sparserob_core.errors import PluginError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.maximiser import Maximiser, Objective

WORST = 1e20  # what is told where the function has no value; some optimisers compute with it


class Asked(Protocol):
    """An optimiser that minimises: ``asked = ask()``, ``tell(asked, loss)``, as those of cma, nevergrad and optuna."""

    def ask(self) -> Any:
        """What is to be evaluated: one point, several, or something that a point can be read from."""

    def tell(self, asked: Any, losses: Any, /) -> Any:
        """The loss of one point, or a list of the losses of several."""


@final
class FromAskTell(Maximiser):
    """See `from_ask_tell`."""

    scaled: ClassVar[bool] = True

    def __init__(self, create: Callable[[int, int, np.random.Generator], Asked], read: Callable[[Any], Any]) -> None:
        self.create, self.read = create, read

    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """See `sparserob_core.Maximiser`."""
        unit = _Unit(objective)
        while objective.remaining:
            optimiser = self.create(objective.domain.dimension, objective.remaining, rng)
            stop: Callable[[], object] = getattr(optimiser, "stop", bool)
            first = True
            while objective.remaining and (first or not stop()):
                first = False
                asked = optimiser.ask()
                points = np.array(self.read(asked), dtype=float)
                losses = unit.losses(np.atleast_2d(points))
                optimiser.tell(asked, losses.tolist() if points.ndim == 2 else float(losses[0]))
        return float("inf")


@final
class FromMinimiser(Maximiser):
    """See `from_minimiser`."""

    scaled: ClassVar[bool] = True

    def __init__(self, minimise: Callable[[Callable[[Any], float], Array], object]) -> None:
        self.minimise = minimise

    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """See `sparserob_core.Maximiser`."""
        unit = _Unit(objective)
        start = unit.best if objective.evaluations else np.full(objective.domain.dimension, 0.5)
        while objective.remaining:
            before = objective.evaluations
            self.minimise(lambda point: float(unit.losses(np.atleast_2d(np.asarray(point, dtype=float)))[0]), start)
            if objective.evaluations == before:
                raise PluginError("minimise asked for no value")
            start = rng.random(objective.domain.dimension)
        return float("inf")


def from_ask_tell(
    create: Callable[[int, int, np.random.Generator], Asked], read: Callable[[Any], Any] = np.asarray
) -> Maximiser:
    """A maximiser from an optimiser that is asked and told.

    ``create(d, budget, rng)`` makes one that *minimises* over the unit box ``[0, 1]^d``; draw its seed from ``rng``.
    ``read(optimiser.ask())`` is one point ``(d,)``, whose loss is told as a number, or points ``(k, d)``, whose losses
    are told as a list; points outside are moved to the box. Where it has a method ``stop`` that says so, it is made
    anew until the budget is spent. A loss is the value with the other sign, and at most 1e20.
    """
    return FromAskTell(create, read)


def from_minimiser(minimise: Callable[[Callable[[Any], float], Array], object]) -> Maximiser:
    """A maximiser from a function ``minimise(f, x0)``, such as those of scipy.

    It minimises over the unit box, from its centre or from the best point so far, and anew from random points until the
    budget is spent; what it returns is not looked at. ``f`` takes one point ``(d,)``; points outside are moved to the
    box.
    """
    return FromMinimiser(minimise)


class _Unit:
    """An objective in the unit box, with losses instead of values."""

    def __init__(self, objective: Objective) -> None:
        self.objective, self.lower = objective, objective.domain.lower
        self.width = objective.domain.upper - objective.domain.lower

    @property
    def best(self) -> Array:
        return np.asarray(np.clip((self.objective.best_point - self.lower) / self.width, 0.0, 1.0))

    def losses(self, points: Array) -> Array:
        inside = np.clip(np.nan_to_num(points, nan=0.5), 0.0, 1.0)
        placed = np.clip(self.lower + inside * self.width, self.lower, self.objective.domain.upper)
        return np.clip(-self.objective.evaluate(placed), -WORST, WORST)
