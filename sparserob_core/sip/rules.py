"""The four pieces of the paper's algorithm that a user may replace: ``Regu``, ``SC1``, ``SC2`` and ``SlCr``.

Each is an object that is called; a plain function with the same arguments serves as well, and under a name too:
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
    """What one outer iteration ``j`` ended with: ``epsilon``, the best ``value`` of ``g``, the ``cost`` J of its
    optimiser ``decision (n,)``, and the lower bound of the semi-infinite program that its multipliers prove."""

    j: int
    epsilon: float
    value: float
    cost: float
    lower_bound: float
    decision: Array


@dataclass(frozen=True, eq=False)
class Progress:
    """How a search stands: ``evaluations`` so far, ``best_value``, the last scalars that the maximiser noted
    (``temperature``, ...), and ``improvements``, the pairs (evaluations so far, best value) at which the best value
    rose."""

    evaluations: int
    best_value: float
    notes: Mapping[str, float]
    improvements: Sequence[tuple[int, float]]

    def gain(self, window: int) -> float:
        """By how much the best value rose within the last ``window`` evaluations; ``inf`` where there were not so
        many."""
        earlier = bisect_right(self.improvements, (self.evaluations - window, np.inf)) - 1
        return np.inf if earlier < 0 or window >= self.evaluations else self.best_value - self.improvements[earlier][1]


class Rule:
    """One of the four pieces of the paper's loop, an object that is called: a `Schedule`, an `OuterStop`, an
    `InnerStop` or a `Selection`."""

    @classmethod
    def of(cls, function: Callable[..., object]) -> type[Self]:
        """A class of rules of this kind, without options, that answer with a plain function."""
        own = {"__call__": staticmethod(function), "__reduce__": lambda rule: (_rule, (cls, function))}
        named = {"__doc__": function.__doc__, "__module__": function.__module__}
        return type(function.__name__, (cls,), {**own, **named})


def _rule(kind: type[Rule], function: Callable[..., object]) -> Rule:
    """A rule that was pickled."""
    return kind.of(function)()


class Schedule(Rule, ABC):
    """``Regu``: the weight of the regulariser in the next outer iteration."""

    @abstractmethod
    def __call__(self, epsilon: float, j: int) -> float:
        """The weight in iteration ``j = 1, 2, ...`` where iteration ``j - 1`` had ``epsilon``; smaller, and
        positive."""


class OuterStop(Rule, ABC):
    """``SC1``: when the optimisers of successive outer iterations are near enough to one another."""

    @abstractmethod
    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        """Whether to stop after these outer iterations, of which there is at least one."""


class InnerStop(Rule, ABC):
    """``SC2``: when one global maximisation has gone on for long enough; its budget bounds it in any case."""

    @abstractmethod
    def __call__(self, progress: Progress) -> bool:
        """Whether to stop the search; asked after every batch of evaluations."""


class Selection(Rule, ABC):
    """``SlCr``: whether a walk goes on from a candidate."""

    @abstractmethod
    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Whether the candidate's value replaces the current one, at a temperature that is not negative."""


@final
class Geometric(Schedule, Options):
    """``factor`` times the weight before: the paper's ``2^-j`` times the first, for the factor 1/2."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """What the weight is multiplied by."""

    def __call__(self, epsilon: float, j: int) -> float:
        return self.factor * epsilon


@final
class Accelerating(Schedule, Options):
    """``factor^j`` times the weight before: the paper's ``Regu(epsilon, j) = 2^-j epsilon`` applied again and again."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """What the weight is multiplied by."""

    def __call__(self, epsilon: float, j: int) -> float:
        return self.factor**j * epsilon


@final
class OptimisersSettle(OuterStop, Options):
    """The norm of the difference of successive optimisers is at most ``tolerance``, relative to the norm of the last
    one or 1."""

    tolerance: float = Field(default=1e-3, ge=0.0)
    """Norm of the difference of successive optimisers, relative to the last one's norm or 1."""

    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        if len(steps) < 2:
            return False
        last, before = steps[-1].decision, steps[-2].decision
        return bool(np.linalg.norm(last - before) <= self.tolerance * max(1.0, float(np.linalg.norm(last))))


@final
class CostsSettle(OuterStop, Options):
    """The cost ``J`` of successive optimisers changes by at most ``tolerance``, relative to it or 1."""

    tolerance: float = Field(default=1e-6, ge=0.0)
    """Difference of successive costs, relative to the last one or 1."""

    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        return len(steps) >= 2 and abs(steps[-1].cost - steps[-2].cost) <= self.tolerance * max(
            1.0, abs(steps[-1].cost)
        )


@final
class Iterations(OuterStop, Options):
    """After ``count`` outer iterations."""

    count: int = Field(default=10, ge=1)
    """Outer iterations."""

    def __call__(self, steps: Sequence[OuterStep]) -> bool:
        return len(steps) >= self.count


@final
class Evaluations(InnerStop, Options):
    """After ``count`` evaluations; ``None``: when the budget is spent."""

    count: int | None = Field(default=None, ge=1)
    """Evaluations of one search; null: its budget."""

    def __call__(self, progress: Progress) -> bool:
        return self.count is not None and progress.evaluations >= self.count


@final
class TemperatureFloor(InnerStop, Options):
    """When the temperature that an annealing maximiser notes is at most ``floor``; other maximisers note none, and are
    not stopped."""

    floor: float = Field(default=1e-6, ge=0.0)
    """Temperature at which an annealing maximiser stops."""

    def __call__(self, progress: Progress) -> bool:
        return progress.notes.get("temperature", np.inf) <= self.floor


@final
class Stalled(InnerStop, Options):
    """When the best value rose by no more than ``tolerance`` within the last ``window`` evaluations."""

    window: int = Field(default=200, ge=1)
    """Evaluations that are looked back upon."""

    tolerance: float = Field(default=1e-9, ge=0.0)
    """Rise of the best value within the window that is no rise."""

    def __call__(self, progress: Progress) -> bool:
        return progress.gain(self.window) <= self.tolerance


@final
class Metropolis(Selection, Options):
    """Accept what is not worse, and what is worse by ``delta`` with probability ``exp(-delta / temperature)``
    (Metropolis et al. 1953)."""

    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        if candidate >= current:
            return True
        return temperature > 0.0 and rng.random() < exp(max(-700.0, (candidate - current) / temperature))


@final
class Threshold(Selection, Options):
    """Accept what is worse by no more than the temperature (threshold accepting: Dueck and Scheuer 1990)."""

    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        return candidate >= current - temperature


@final
class Improvement(Selection, Options):
    """Accept only what is not worse."""

    def __call__(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        return candidate >= current
