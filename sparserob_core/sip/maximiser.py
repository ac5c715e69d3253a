"""Outer maximisation: the maximiser, the objective that it receives, and the report of its search."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.errors import SparseRobError
from sparserob_core.sip.convex_set import Array, Box


class SearchEnded(Exception):
    """Exception that ends a search; a maximiser must not catch it. Its text becomes `Report.stopped`."""


@dataclass(frozen=True, eq=False)
class LinearBlocks:
    """Structure of a function of ``D`` blocks of coordinates, each of which enters by at most one linear piece.

    The indices of a tuple are such blocks: they enter by the constraints that they impose.

    Parameters
    ----------
    coordinates : ndarray of int, shape (d,)
        Coordinates in which a block is linear while its other coordinates are fixed.
    acting : callable
        ``acting()``: truth values ``(D,)``, true for the blocks on which the last evaluated value depends.
    steepest : callable
        ``steepest(point (d,))``: the point ``(d,)`` with the linear coordinates of every block at a vertex. Each vertex
        is the one at which the block has the largest effect, judged from the last evaluated point (the linear
        maximisation of Frank and Wolfe 1956). A block that acts keeps the piece by which it acts. Moving there never
        decreases the value while the acting blocks keep their other coordinates. No evaluation is spent.
    """

    coordinates: np.ndarray
    acting: Callable[[], np.ndarray]
    steepest: Callable[[Array], Array]


class Objective(Protocol):
    """Objective of a maximiser: a box, a batched function that counts its evaluations, and a place for notes.

    The box has at least one coordinate, and ``lower < upper`` in each. Coordinates with a single value are hidden.
    Where none can move, no maximiser is called.
    """

    @property
    def domain(self) -> Box:
        """Box on which the function is defined, with ``d`` coordinates."""

    @property
    def block(self) -> int:
        """Number of consecutive coordinates that belong together.

        The number is 1, or that of the coordinates of one index where points are tuples of indices. Changing one block
        at a time is then cheap.
        """

    @property
    def budget(self) -> int:
        """Total number of evaluations that the search may spend."""

    @property
    def evaluations(self) -> int:
        """Number of evaluations so far."""

    @property
    def best_point(self) -> Array:
        """Best point so far ``(d,)``, a good starting point; NaN while ``evaluations`` is 0."""

    @property
    def best_value(self) -> float:
        """Largest value so far; ``-inf`` while ``evaluations`` is 0."""

    def known(self) -> tuple[Array, Array]:
        """Return the points ``(k, d)`` that were evaluated before the search, and their values ``(k,)``.

        The points are the starting point and points known from elsewhere. At the start of the search, ``best_point`` is
        the best of them.
        """

    @property
    def differentiable(self) -> bool:
        """True where `value_and_gradient` is offered."""

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """Function that returns which blocks the last evaluated value depends on; ``None`` where that is not known.

        The function returns truth values for the ``d / block`` blocks. The other blocks may be moved a little, and
        usually far, without any change of the value. No evaluation is spent.
        """

    @property
    def linear(self) -> LinearBlocks | None:
        """Linear coordinates of the blocks, and their steepest vertices; ``None`` where the blocks are not linear.

        `block_ascent` uses this structure.
        """

    @property
    def remaining(self) -> int:
        """Number of evaluations left; 0 once the search has ended."""

    def evaluate(self, points: Array) -> Array:
        """Return the values ``(k,)`` at points ``(k, d)``; NaN is replaced by ``-inf``.

        With fewer than ``k`` evaluations left, the first ``remaining`` points are evaluated and recorded, and the
        search ends. A value of ``+inf`` ends the search too.

        Parameters
        ----------
        points : ndarray, shape (k, d)
            Points of the domain.

        Returns
        -------
        ndarray, shape (k,)
            Values.

        Raises
        ------
        PluginError
            Where a point is outside of the domain.
        SearchEnded
            Where the search has ended; a maximiser must not catch it.
        """

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """Return the value and the gradient ``(d,)`` at one point ``(d,)``; this counts as one evaluation.

        The gradient is 0 where the value is not finite.

        Raises
        ------
        InputError
            Where no gradient is offered.
        PluginError, SearchEnded
            In the cases of `evaluate`.
        """

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Return whether the search moves to a candidate point (the paper's ``SlCr``).

        The rule is Metropolis' rule unless the method was given another.

        Parameters
        ----------
        current, candidate : float
            Values at the current point and at the candidate.
        temperature : float
            Temperature, not negative.
        rng : numpy.random.Generator
            Random numbers.

        Returns
        -------
        bool
            True where the candidate becomes the current point.
        """

    def note(self, **scalars: float) -> None:
        """Record scalars (temperature, acceptance, ...) in the trace, and pass them to observers."""

    @property
    def observed(self) -> bool:
        """True where anybody looks at sketches; otherwise they need not be made. A search must not depend on it."""

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """Show observers the points or regions that the search considers or has ruled out.

        For each role the last sketch is shown, with its first 400 rows. A sketch is no part of the trace, and changes
        nothing.

        Parameters
        ----------
        role : str
            Meaning of the rows, in words.
        lower : ndarray, shape (k, d)
            Points, or lower corners of boxes.
        upper : ndarray, shape (k, d), optional
            Upper corners of boxes; ``None`` for points.
        rounded : bool, default False
            Whether the regions are the ellipsoids within the boxes.
        """


class Maximiser(ABC):
    """A global maximiser over a box.

    Class attributes declare what it needs. ``scaled`` (false by default): it receives a box with sides of length about
    1, and values of about 1, in units that are powers of two. The user's units then do not affect the numbers with
    which it compares. A maximiser that only compares values, or that takes a constant from the user, such as a
    Lipschitz constant or a temperature, needs no scaling. ``apart`` (false by default): each index of a tuple is
    shifted round its box, so that all indices differ in the middle of the box, where the maximiser starts. A maximiser
    that draws its points at random does not need this. ``whole`` (true by default): it can maximise a function that is
    constant between whole numbers; a maximiser that follows gradients cannot.
    """

    scaled: ClassVar[bool] = False
    apart: ClassVar[bool] = False
    whole: ClassVar[bool] = True

    @property
    def polished(self) -> float:
        """Default share of a budget for a local method at the end of a search: a fifth, unless a class overrides it.

        The share applies to `sparserob_core.maximise` and `sparserob_core.ask_tell`. A class should return 0 where
        polishing would spoil the maximiser's purpose, such as an upper bound or a reference for comparison.
        """
        return 0.2

    @abstractmethod
    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """Evaluate the objective until the budget is spent or no improvement is possible.

        Parameters
        ----------
        objective : Objective
            The function, its box and its budget.
        rng : numpy.random.Generator
            The only source of random numbers.

        Returns
        -------
        float
            A proven upper bound of the maximum, or ``inf``.
        """


class EvaluationError(SparseRobError):
    """Error in the function that is maximised.

    The function raised an exception, did not return one real number per point, or returned NaN at all points.
    ``report`` holds the results until then.
    """

    def __init__(self, message: str, report: Report) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True, eq=False)
class Trace:
    """Every evaluation of a search, in order.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        Points; empty ``(0, d)`` where all of them would be too many.
    values : ndarray, shape (n,)
        Values.
    best : ndarray, shape (n,)
        Largest value until each evaluation.
    seconds : ndarray, shape (n,)
        Seconds from the start of the search until each value was known.
    notes : mapping of str to ndarray, shape (j, 2)
        For each noted name, the rows ``(evaluations so far, value)``.
    searched : int, optional
        Number of evaluations before the local method took over to polish; ``None``: it did not.
    """

    points: Array
    values: Array
    best: Array
    seconds: Array
    notes: Mapping[str, Array] = field(default_factory=dict)
    searched: int | None = None

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Report:
    """Outcome of a search.

    A search for the minimum (`ask_tell`) has the same record: its best value is the least, NaN counts as ``inf``, and
    ``lower_bound`` is what was proven.

    Parameters
    ----------
    best_value : float
        Best evaluated value.
    best_point : ndarray, shape (d,)
        Point of that value; NaN where nothing was evaluated.
    evaluations : int
        Number of evaluations.
    upper_bound : float
        Proven upper bound of the maximum; ``inf``: none.
    trace : Trace
        All evaluations.
    stopped : str
        Reason why the search ended.
    interrupted : bool, default False
        Whether the search was interrupted.
    missing : int, default 0
        Number of evaluations that gave NaN, which counts as ``-inf``.
    lower_bound : float, default -inf
        Proven lower bound of the minimum; ``-inf``: none.
    """

    best_value: float
    best_point: Array
    evaluations: int
    upper_bound: float
    trace: Trace
    stopped: str
    interrupted: bool = False
    missing: int = 0
    lower_bound: float = -np.inf

    __repr__ = brief
