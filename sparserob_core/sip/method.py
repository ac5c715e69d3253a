"""What a method is, and the tools that it is handed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import final

import numpy as np
from pydantic import Field

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.regulariser import Regulariser
from sparserob_core.sip.result import Result
from sparserob_core.sip.rules import Geometric
from sparserob_core.sip.solver import Solver

GAP_TOLERANCE = 1e-7  # relative gap at which the bounds have met, unless a method is told otherwise


@final
class Continuation(Options):
    """How the weight of the regulariser decreases.

    The weight ``epsilon`` goes from ``start`` by ``factor`` (the paper's ``Regu``) down to ``stop`` at the latest, or
    until the cost ``J`` changes by no more than ``tolerance`` when it is reduced again (``SC1``).
    """

    start: float = Field(default=1.0, gt=0.0)
    """First weight."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """Each weight is this times the one before."""

    stop: float = Field(default=1e-6, gt=0.0)
    """Last weight at the latest."""

    tolerance: float = Field(default=GAP_TOLERANCE, ge=0.0)
    """Relative change of the cost below which a smaller weight changes nothing any more."""

    def lighter(self, epsilon: float, j: int = 1, regu: Callable[[float, int], float] | None = None) -> float:
        """The weight of iteration ``j``, where the one before had ``epsilon``: by the schedule ``regu``, or else
        ``factor`` times ``epsilon``; not below ``stop``.

        Raises `InputError` for a schedule that does not give a positive weight below ``epsilon``.
        """
        weight: object = (regu or Geometric(factor=self.factor))(epsilon, j)
        if isinstance(weight, int | float | np.floating) and 0.0 < weight < epsilon:
            return max(self.stop, float(weight))
        raise InputError(f"regu: expected a positive weight below {epsilon!r}, got {weight!r}")


@dataclass(frozen=True, eq=False)
class Tools:
    """The components that a config has chosen. ``regulariser`` may be ``None``: the unregularised program is then
    solved.

    ``budget``: evaluations that one search of the maximiser may spend, of which the share ``polish`` goes to a local
    method at its end. ``executor``: workers for programs that do not depend on one another; ``None``: solve them here.
    """

    solver: Solver
    maximiser: Maximiser | None = None
    regulariser: Regulariser | None = None
    continuation: Continuation = field(default_factory=Continuation)
    budget: int = 2000
    polish: float = 0.0
    executor: Executor | None = None
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    notify: Notify = ignore


class ExecutorFactory(ABC):
    """Opens the workers on which independent programs are solved."""

    @abstractmethod
    def open(self) -> AbstractContextManager[Executor]:
        """Workers that live as long as the context; what is submitted to them can be pickled."""


class Method(ABC):
    """A way to solve a semi-infinite program."""

    @abstractmethod
    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """Return a `Result` for every well-posed program; a status never claims more than was proven."""
