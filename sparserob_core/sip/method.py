"""Methods for semi-infinite programs, and the tools that a method receives."""

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

# Relative rounding error of a product of factors; weights that are meant to differ do so by far more
WEIGHT_ROUNDING = 1e-12
GAP_TOLERANCE = 1e-7  # relative gap at which the gap counts as closed, unless a method has another one


@final
class Continuation(Options):
    """Decreasing weights of the regulariser.

    The weight ``epsilon`` starts at ``start`` and is multiplied by ``factor`` (the paper's ``Regu``). The decrease ends
    at ``stop`` at the latest, or where a further reduction changes the cost ``J`` by no more than ``tolerance``
    (``SC1``). While its gap is open, the method ``exchange`` takes several steps at once, down to an eighth of a
    weight.
    """

    start: float = Field(default=1.0, gt=0.0)
    """First weight."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """Ratio of each weight to the one before."""

    stop: float = Field(default=1e-6, gt=0.0)
    """Smallest weight."""

    tolerance: float = Field(default=GAP_TOLERANCE, ge=0.0)
    """Relative change of the cost that counts as none."""

    def lighter(self, epsilon: float, j: int = 1, regu: Callable[[float, int], float] | None = None) -> float:
        """Return the weight of iteration ``j``, whose predecessor had the weight ``epsilon``.

        A weight within rounding of ``stop`` is replaced by ``stop``. Otherwise nearly the same program would be solved
        once more.

        Parameters
        ----------
        epsilon : float
            Weight of the iteration before.
        j : int, default 1
            Number of the iteration.
        regu : callable, optional
            Schedule ``regu(epsilon, j)``; by default ``factor * epsilon``.

        Returns
        -------
        float
            The weight, at least ``stop``.

        Raises
        ------
        InputError
            Where the schedule does not return a positive weight below ``epsilon``.
        """
        weight: object = self.factor * epsilon if regu is None else regu(epsilon, j)
        if isinstance(weight, int | float | np.floating) and 0.0 < weight < epsilon:
            return self.stop if weight <= self.stop * (1.0 + WEIGHT_ROUNDING) else float(weight)
        raise InputError(f"regu: expected a positive weight below {epsilon!r}, got {weight!r}")

    @model_validator(mode="after")
    def _check_decrease(self) -> Continuation:
        if self.stop > self.start:
            raise InputError(path="stop", expected=f"at most start, which is {self.start!r}", got=f"{self.stop!r}")
        return self


Rebuild: TypeAlias = Callable[[], tuple[SemiInfiniteProgram, Solver, Regulariser | None]]
"""Function that makes the program, the solver and the regulariser anew. The function can be pickled, and equal
functions make equal objects."""


@dataclass(frozen=True, eq=False)
class Tools:
    """Components that the user has chosen for a method.

    Parameters
    ----------
    solver : Solver
        Solver of the finite programs.
    maximiser : Maximiser, optional
        Global maximiser; ``None`` where none was chosen.
    regulariser : Regulariser, optional
        Regulariser; ``None``: the unregularised program is solved.
    continuation : Continuation
        Weights of the regulariser.
    budget : int, default 2000
        Evaluations that one search of the maximiser may spend.
    polish : float, optional
        Share of the budget for a local method at the end of a search (`sip.search.search.Rules`).
    executor : Executor, optional
        Workers for independent programs; ``None``: the programs are solved in this process.
    rebuild : Rebuild, optional
        Makes the method's program, its solver and its regulariser anew on a worker. A program that contains functions
        of a user cannot be sent there. ``None``: they cannot be made on a worker.
    rng : numpy.random.Generator
        Random numbers; seed 0 by default.
    notify : callable
        Receives every event; by default events are ignored.
    deadline : Deadline
        Time at which a method has to end with its best answer; unlimited by default.
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
    """Source of the workers on which independent programs are solved."""

    @property
    def parallel(self) -> bool:
        """True where calls run at the same time; where it is false, sending calls to the workers gains nothing."""
        return True

    @abstractmethod
    def open(self) -> AbstractContextManager[Executor]:
        """Return a context manager that yields the workers; they live as long as the context.

        Whatever is submitted to the workers can be pickled.

        Returns
        -------
        context manager
            Yields a ``concurrent.futures.Executor``.
        """


class Method(ABC):
    """A method for semi-infinite programs.

    Class attributes, all false by default, describe it. ``searches``: it maximises ``g`` over tuples of indices. Its
    `EvaluationsFinished` are then about tuples, and observers show the search. ``counts``: the cost of its result is
    the time during which a control acts. ``robust``: it solves programs whose rows must hold for every deviation
    (`SemiInfiniteProgram`, field ``spread``).
    """

    searches: ClassVar[bool] = False
    counts: ClassVar[bool] = False
    robust: ClassVar[bool] = False

    @abstractmethod
    def solve(self, program: SemiInfiniteProgram, tools: Tools) -> Result:
        """Solve a semi-infinite program.

        Parameters
        ----------
        program : SemiInfiniteProgram
            The program.
        tools : Tools
            Components that the user has chosen.

        Returns
        -------
        Result
            A result for every well-posed program. Its status never claims more than was proven.
        """


def require_suited(method: Method, program: SemiInfiniteProgram, name: str = "") -> None:
    """Raise `InputError` where a program has deviations, as under feedback, and the method is for plain rows only."""
    if program.spread is not None and not method.robust:
        raise InputError(
            path="method.name",
            expected="exchange: with a policy that answers what is measured, a constraint is no row of the decision",
            got=name or type(method).__name__,
        )
