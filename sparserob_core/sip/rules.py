"""The four rules of the paper's algorithm that a user may replace: ``Regu``, ``SC1``, ``SC2`` and ``SlCr``.

Each rule is an object that is called. A plain function with the same arguments serves as well, also under a name:
``RulePlugin(name="mine", factory=Selection.of(function))``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import exp
from typing import Self, final

import numpy as np
from pydantic import Field

from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array


@dataclass(frozen=True, eq=False)
class OuterStep:
    """Outcome of one outer iteration.

    Parameters
    ----------
    j : int
        Number of the iteration.
    epsilon : float
        Weight of the regulariser.
    value : float
        Largest value of ``g`` that was found.
    cost : float
        Cost J of the optimiser.
    lower_bound : float
        Lower bound of the semi-infinite program, proven by the multipliers of the optimiser.
    decision : ndarray, shape (n,)
        The optimiser.
    """

    j: int
    epsilon: float
    value: float
    cost: float
    lower_bound: float
    decision: Array


@dataclass(frozen=True, eq=False)
class Progress:
    """State of a search.

    Parameters
    ----------
    evaluations : int
        Number of evaluations so far.
    best_value : float
        Largest value so far.
    notes : mapping of str to float
        Last scalars that the maximiser noted (``temperature``, ...).
    improvements : sequence of (int, float)
        Pairs (evaluations so far, best value) at which the best value rose.
    """

    evaluations: int
    best_value: float
    notes: Mapping[str, float]
    improvements: Sequence[tuple[int, float]]

    def gain(self, window: int) -> float:
        """Return the rise of the best value within the last ``window`` evaluations; ``inf`` where there were fewer."""
        earlier = bisect_right(self.improvements, (self.evaluations - window, np.inf)) - 1
        return np.inf if earlier < 0 or window >= self.evaluations else self.best_value - self.improvements[earlier][1]


class Rule:
    """A rule of the paper's algorithm, an object that is called.

    Every rule is a `Schedule`, an `OuterStop`, an `InnerStop` or a `Selection`.
    """

    @classmethod
    def of(cls, function: Callable[..., object]) -> type[Self]:
        """Return a class of rules of this kind, without options, whose answers are those of a plain function."""
        own = {"__call__": staticmethod(function), "__reduce__": lambda rule: (_make_rule, (cls, function))}
        named = {"__doc__": function.__doc__, "__module__": function.__module__}
        return type(function.__name__, (cls,), {**own, **named})


def _make_rule(kind: type[Rule], function: Callable[..., object]) -> Rule:
    """Return a rule made from a function, for unpickling."""
    return kind.of(function)()


class Schedule(Rule, ABC):
    """``Regu``: the rule for the weight of the regulariser in the next outer iteration."""

    @abstractmethod
    def __call__(self, epsilon: float, j: int) -> float:
        """Return the weight of iteration ``j``; positive, and smaller than ``epsilon``.

        Parameters
        ----------
        epsilon : float
            Weight of iteration ``j - 1``.
        j : int
            Number of the iteration, from 1.

        Returns
        -------
        float
            The weight.
        """


class OuterStop(Rule, ABC):
    """``SC1``: the rule that stops the outer iterations, once successive optimisers are near enough to one another."""

    @abstractmethod
    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        """Return whether to stop after these outer iterations, of which there is at least one."""


class InnerStop(Rule, ABC):
    """``SC2``: the rule that stops one global maximisation; the budget bounds it in any case."""

    @abstractmethod
    def __call__(self, progress: Progress) -> bool:
        """Return whether to stop the search; called after every batch of evaluations."""


class Selection(Rule, ABC):
    """``SlCr``: the rule by which a search moves to a candidate point."""

    @abstractmethod
    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Return whether the candidate replaces the current point.

        Parameters
        ----------
        current, candidate : float
            Values of ``g`` at the two points.
        temperature : float
            Temperature, not negative.
        rng : numpy.random.Generator
            Random numbers.

        Returns
        -------
        bool
            True where the candidate becomes the current point.
        """


@final
class Geometric(Schedule, Options):
    """``factor`` times the weight before: the paper's ``2^-j`` times the first, for the factor 1/2."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """Ratio of each weight to the one before."""

    def __call__(self, epsilon: float, j: int) -> float:
        return self.factor * epsilon


@final
class Accelerating(Schedule, Options):
    """``factor^j`` times the weight before: the paper's ``Regu(epsilon, j) = 2^-j epsilon`` applied again and again."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """Ratio of the weights in iteration 1; in iteration j the ratio is the j-th power of it."""

    def __call__(self, epsilon: float, j: int) -> float:
        return self.factor**j * epsilon


@final
class OptimisersSettle(OuterStop, Options):
    """A distance of successive optimisers of at most ``tolerance``, relative to the norm of the last one or 1."""

    tolerance: float = Field(default=1e-3, ge=0.0)
    """Distance of successive optimisers, relative to the norm of the last one or 1."""

    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        if len(steps) < 2:
            return False
        last, before = steps[-1].decision, steps[-2].decision
        return bool(np.linalg.norm(last - before) <= self.tolerance * max(1.0, float(np.linalg.norm(last))))


@final
class CostsSettle(OuterStop, Options):
    """A change of the cost ``J`` of successive optimisers of at most ``tolerance``, relative to the last cost or 1."""

    tolerance: float = Field(default=1e-6, ge=0.0)
    """Difference of successive costs, relative to the last cost or 1."""

    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        return len(steps) >= 2 and abs(steps[-1].cost - steps[-2].cost) <= self.tolerance * max(
            1.0, abs(steps[-1].cost)
        )


@final
class Iterations(OuterStop, Options):
    """A fixed number ``count`` of outer iterations."""

    count: int = Field(default=10, ge=1)
    """Number of outer iterations."""

    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        return len(steps) >= self.count


@final
class Evaluations(InnerStop, Options):
    """A fixed number ``count`` of evaluations; ``None``: the whole budget."""

    count: int | None = Field(default=None, ge=1)
    """Number of evaluations of one search; null: its budget."""

    def __call__(self, progress: Progress) -> bool:
        return self.count is not None and progress.evaluations >= self.count


@final
class TemperatureFloor(InnerStop, Options):
    """A temperature of at most ``floor``, as noted by an annealing maximiser; other maximisers note none, and are not
    stopped."""

    floor: float = Field(default=1e-6, ge=0.0)
    """Temperature at which an annealing maximiser stops."""

    def __call__(self, progress: Progress) -> bool:
        return progress.notes.get("temperature", np.inf) <= self.floor


@final
class Stalled(InnerStop, Options):
    """A rise of the best value of no more than ``tolerance`` within the last ``window`` evaluations."""

    window: int = Field(default=200, ge=1)
    """Number of last evaluations in which the best value has to rise."""

    tolerance: float = Field(default=1e-9, ge=0.0)
    """Rise of the best value within the window that counts as none."""

    def __call__(self, progress: Progress) -> bool:
        return progress.gain(self.window) <= self.tolerance


@final
class Metropolis(Selection, Options):
    """Acceptance of a candidate that is not worse, and of one worse by ``delta`` with probability ``exp(-delta /
    temperature)`` (Metropolis et al. 1953)."""

    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        if candidate >= current:
            return True
        return temperature > 0.0 and rng.random() < exp(max(-700.0, (candidate - current) / temperature))


@final
class Threshold(Selection, Options):
    """Acceptance of a candidate that is worse by no more than the temperature (threshold accepting: Dueck and Scheuer
    1990)."""

    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        return candidate >= current - temperature


@final
class Improvement(Selection, Options):
    """Acceptance of a candidate that is not worse."""

    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        return candidate >= current
