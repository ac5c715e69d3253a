"""What a method is, and the tools that it is handed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np

from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.regulariser import Regulariser
from sparserob_core.sip.result import Result
from sparserob_core.sip.solver import Solver


@dataclass(frozen=True)
class Continuation:
    """How the weight ``epsilon`` of the regulariser decreases: from ``start`` by ``factor`` down to ``stop`` at most
    (the paper's ``Regu``), or until the cost ``J`` changes by no more than ``tolerance`` (relative) when it is reduced
    again (``SC1``).
    """

    start: float = 1.0
    factor: float = 0.5
    stop: float = 1e-6
    tolerance: float = 1e-7


@dataclass(frozen=True, eq=False)
class Tools:
    """The components that a config has chosen. ``regulariser`` may be ``None``: the unregularised program is then
    solved.

    ``budget``: evaluations that one search of the maximiser may spend, of which the share ``polish`` goes to a local
    method at its end.
    """

    solver: Solver
    maximiser: Maximiser | None = None
    regulariser: Regulariser | None = None
    continuation: Continuation = Continuation()
    budget: int = 2000
    polish: float = 0.0
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    notify: Notify = ignore


class Method(ABC):
    """A way to solve a semi-infinite program."""

    @abstractmethod
    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """Return a `Result` for every well-posed program; a status never claims more than was proven."""
