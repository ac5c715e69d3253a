"""Optimisers of other packages as maximisers: optimisers with ``ask`` and ``tell``, and functions that minimise from a
start."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Protocol, final

import numpy as np

from sparserob_core.errors import PluginError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.maximiser import Maximiser, Objective

ABSENT_VALUE_LOSS = 1e20  # loss where the function has no value; it is finite, since some optimisers compute with it


class AskTellOptimiser(Protocol):
    """An optimiser that minimises by ``asked = ask()`` and ``tell(asked, loss)``, as those of cma, nevergrad and
    optuna."""

    def ask(self) -> Any:
        """Return the next candidate: one point, several points, or an object from which points can be read."""

    def tell(self, asked: Any, losses: Any, /) -> Any:
        """Receive the loss of one point, or a list of the losses of several."""


@final
class FromAskTell(Maximiser):
    """A maximiser made from an optimiser with ``ask`` and ``tell`` (`from_ask_tell`)."""

    scaled: ClassVar[bool] = True

    def __init__(
        self, create: Callable[[int, int, np.random.Generator], AskTellOptimiser], read: Callable[[Any], Any]
    ) -> None:
        self.create, self.read = create, read

    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """Spend the budget; return ``inf``, for nothing is proven."""
        unit = _UnitObjective(objective)
        while objective.remaining:
            optimiser = self.create(objective.domain.dimension, objective.remaining, rng)
            stop: Callable[[], object] = getattr(optimiser, "stop", bool)
            first = True
            while objective.remaining and (first or not stop()):
                first = False
                query = optimiser.ask()
                points = np.array(self.read(query), dtype=float)
                losses = unit.losses(np.atleast_2d(points))
                optimiser.tell(query, losses.tolist() if points.ndim == 2 else float(losses[0]))
        return float("inf")


@final
class FromMinimiser(Maximiser):
    """A maximiser made from a function that minimises (`from_minimiser`)."""

    scaled: ClassVar[bool] = True

    def __init__(self, minimise: Callable[[Callable[[Any], float], Array], object]) -> None:
        self.minimise = minimise

    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """Spend the budget; return ``inf``, for nothing is proven."""
        unit = _UnitObjective(objective)
        start = unit.best if objective.evaluations else np.full(objective.domain.dimension, 0.5)
        while objective.remaining:
            before = objective.evaluations
            self.minimise(lambda point: float(unit.losses(np.atleast_2d(np.asarray(point, dtype=float)))[0]), start)
            if objective.evaluations == before:
                raise PluginError("minimise asked for no value")
            start = rng.random(objective.domain.dimension)
        return float("inf")


def from_ask_tell(
    create: Callable[[int, int, np.random.Generator], AskTellOptimiser], read: Callable[[Any], Any] = np.asarray
) -> Maximiser:
    """Return a maximiser made from an optimiser with ``ask`` and ``tell``, which minimises over the unit box.

    A loss is the negative value, and at most 1e20. Points outside of the box are moved to it.

    Parameters
    ----------
    create : callable
        ``create(d, budget, rng)`` makes an optimiser over ``[0, 1]^d``; its seed should be drawn from ``rng``. If the
        optimiser has a method ``stop`` that returns true, a new one is made, until the budget is spent.
    read : callable, default numpy.asarray
        ``read(optimiser.ask())`` is one point ``(d,)``, whose loss is passed to ``tell`` as a number, or points ``(k,
        d)``, whose losses are passed as a list.

    Returns
    -------
    Maximiser
        The maximiser.
    """
    return FromAskTell(create, read)


def from_minimiser(minimise: Callable[[Callable[[Any], float], Array], object]) -> Maximiser:
    """Return a maximiser made from a function ``minimise(f, x0)``, such as those of scipy.

    The function minimises over the unit box, first from its centre or from the best point so far, then from random
    points until the budget is spent.

    Parameters
    ----------
    minimise : callable
        ``minimise(f, x0)``. ``f`` takes one point ``(d,)``; a point outside of the box is moved to it. The return value
        is ignored.

    Returns
    -------
    Maximiser
        The maximiser.
    """
    return FromMinimiser(minimise)


class _UnitObjective:
    """An objective in the unit box, with losses instead of values."""

    def __init__(self, objective: Objective) -> None:
        self.objective, self.lower = objective, objective.domain.lower
        self.width = objective.domain.upper - objective.domain.lower

    @property
    def best(self) -> Array:
        """Best point so far ``(d,)`` in the unit box."""
        return np.asarray(np.clip((self.objective.best_point - self.lower) / self.width, 0.0, 1.0))

    def losses(self, points: Array) -> Array:
        """Return the losses ``(k,)``, at most `ABSENT_VALUE_LOSS` in size, at points ``(k, d)``, which are moved to the
        unit box."""
        inside = np.clip(np.nan_to_num(points, nan=0.5), 0.0, 1.0)
        placed = np.clip(self.lower + inside * self.width, self.lower, self.objective.domain.upper)
        return np.clip(-self.objective.evaluate(placed), -ABSENT_VALUE_LOSS, ABSENT_VALUE_LOSS)
