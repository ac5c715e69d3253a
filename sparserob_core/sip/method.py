"""What a method is, and the tools that it is handed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias, final

import numpy as np
from pydantic import Field, model_validator

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convexity import Regulariser
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import Result
from sparserob_core.sip.solver import Solver

ROUNDING = 1e-12  # relative: what a product of factors is off by; weights that are meant to differ do so by far more
GAP_TOLERANCE = 1e-7  # relative gap at which the bounds have met, unless a method has another one


@final
class Continuation(Options):
    """How the weight of the regulariser decreases.

    The weight ``epsilon`` goes from ``start`` by ``factor`` (the paper's ``Regu``) down to ``stop`` at the latest, or
    until the cost ``J`` changes by no more than ``tolerance`` when it is reduced again (``SC1``). The method
    ``exchange`` takes several steps at once, down to an eighth of a weight, as long as its gap is open.
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
        ``factor`` times ``epsilon``; not below ``stop``, and ``stop`` where nothing but rounding is between the two:
        the same program would be solved once more.

        Raises `InputError` for a schedule that does not give a positive weight below ``epsilon``.
        """
        weight: object = self.factor * epsilon if regu is None else regu(epsilon, j)
        if isinstance(weight, int | float | np.floating) and 0.0 < weight < epsilon:
            return self.stop if weight <= self.stop * (1.0 + ROUNDING) else float(weight)
        raise InputError(f"regu: expected a positive weight below {epsilon!r}, got {weight!r}")

    @model_validator(mode="after")
    def _decreases(self) -> Continuation:
        if self.stop > self.start:
            raise InputError(path="stop", expected=f"at most start, which is {self.start!r}", got=f"{self.stop!r}")
        return self


Rebuild: TypeAlias = Callable[[], tuple[SemiInfiniteProgram, Solver, Regulariser | None]]
"""Makes a program, the solver and the regulariser anew; it can be pickled, and equal ones make the same."""


@dataclass(frozen=True, eq=False)
class Tools:
    """The components that a config has chosen. ``regulariser`` may be ``None``: the unregularised program is then
    solved.

    ``budget``: evaluations that one search of the maximiser may spend, of which the share ``polish`` goes to a local
    method at its end (`sip.search.search.Rules`). ``executor``: workers for programs that do not depend on one another;
    ``None``: solve them here.
    ``rebuild`` makes the program that the method is handed, its solver and its regulariser anew on a worker, since a
    program with functions of a user cannot be sent; ``None``: it cannot be made there.
    ``deadline``: when a method has to end with what it knows.
    """

    solver: Solver
    maximiser: Maximiser | None = None
    regulariser: Regulariser | None = None
    continuation: Continuation = field(default_factory=Continuation)
    budget: int = 2000
    polish: float | None = None
    executor: Executor | None = None
    rebuild: Rebuild | None = None
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    notify: Notify = ignore
    deadline: Deadline = field(default_factory=Deadline)


class ExecutorFactory(ABC):
    """Opens the workers on which independent programs are solved."""

    @property
    def parallel(self) -> bool:
        """Whether calls are made side by side; if not, it is of no use to send them."""
        return True

    @abstractmethod
    def open(self) -> AbstractContextManager[Executor]:
        """Workers that live as long as the context; what is submitted to them can be pickled."""


class Method(ABC):
    """A way to solve a semi-infinite program.

    ``searches``: whether it maximises ``g`` over tuples of indices, so that its `EvaluationsFinished` are about tuples;
    observers then show the search. ``counts``: whether the cost of its result is the time that a control acts.
    ``robust``: whether it solves programs whose rows must hold for every deviation (`SemiInfiniteProgram.spread`).
    """

    searches: ClassVar[bool] = False
    counts: ClassVar[bool] = False
    robust: ClassVar[bool] = False

    @abstractmethod
    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """Return a `Result` for every well-posed program; a status never claims more than was proven."""


def require_suited(method: Method, program: SemiInfiniteProgram, name: str = "") -> None:
    """Raise `InputError` for a program with deviations, under feedback, where the method is for plain rows."""
    if program.spread is not None and not method.robust:
        raise InputError(
            path="method.name",
            expected="exchange: with a policy that answers what is measured, a constraint is no row of the decision",
            got=name or type(method).__name__,
        )
