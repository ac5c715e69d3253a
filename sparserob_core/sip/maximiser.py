"""The outer maximisation: what a maximiser is, what it is handed, and the report."""

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
    """Raised through a maximiser to end its search; a maximiser lets it pass. Its text is `Report.stopped`."""


@dataclass(frozen=True, eq=False)
class LinearBlocks:
    """What a function of ``D`` blocks of coordinates says of itself whose blocks count by one linear piece each, at
    most: as the indices of a tuple do, by the constraints that they impose.

    ``coordinates (d,)``: where a block is linear, as long as its other coordinates stay. ``acting()``: which blocks
    ``(D,)`` the value at the point that was evaluated last rests on. ``steepest(point (d,))``: that point ``(d,)`` with
    the linear coordinates of every block at the vertex where the block weighs most, as seen from the point that was
    evaluated last (the linear maximisation of Frank and Wolfe 1956); a block that acts keeps to what it acts by. To go
    there while the acting blocks keep their other coordinates never makes the value less. No evaluation is spent.
    """

    coordinates: np.ndarray
    acting: Callable[[], np.ndarray]
    steepest: Callable[[Array], Array]


class Objective(Protocol):
    """What a maximiser is handed: a box, a batched function that counts, and a place for notes.

    The box has at least one coordinate, and ``lower < upper`` in every one: coordinates with a single value are not
    shown, and where none can move no maximiser is asked.
    """

    @property
    def domain(self) -> Box:
        """Where the function is defined, ``d`` coordinates."""

    @property
    def block(self) -> int:
        """How many consecutive coordinates belong together: 1, or the coordinates of one index where points are tuples
        of indices; to change one block at a time is then cheap."""

    @property
    def budget(self) -> int:
        """Evaluations that the search may spend in all."""

    @property
    def evaluations(self) -> int:
        """Evaluations so far."""

    @property
    def best_point(self) -> Array:
        """The best point so far ``(d,)``, a good one to start from; NaN while ``evaluations`` is 0."""

    @property
    def best_value(self) -> float:
        """The best value so far; ``-inf`` while ``evaluations`` is 0."""

    def known(self) -> tuple[Array, Array]:
        """Points ``(k, d)`` that were evaluated before the maximiser was asked, and their values ``(k,)``: its start,
        and those that are known from elsewhere. ``best_point`` is the best of them then."""

    @property
    def differentiable(self) -> bool:
        """Whether `value_and_gradient` is offered."""

    @property
    def acting(self) -> Callable[[], np.ndarray] | None:
        """Which of the ``d / block`` blocks the value at the point that was evaluated last rests on, as truths: the
        others may be moved a little, and as a rule far, without any change. ``None`` where that is not known. No
        evaluation is spent."""

    @property
    def linear(self) -> LinearBlocks | None:
        """In which coordinates its blocks are linear, and where they weigh most; ``None`` where they are not.
        `block_ascent` is what can be made of it."""

    @property
    def remaining(self) -> int:
        """Evaluations that are left; 0 once the search is ended."""

    def evaluate(self, points: Array) -> Array:
        """Values ``(k,)`` at points ``(k, d)``; NaN comes back as ``-inf``.

        A point outside the domain raises `PluginError`. With fewer than ``k`` evaluations left, the first ``remaining``
        points are evaluated, recorded, and the search is ended; so it is by a value of ``+inf``: both raise
        `SearchEnded`, which is not to be caught.
        """

    def value_and_gradient(self, point: Array) -> tuple[float, Array]:
        """Value and gradient ``(d,)`` at one point ``(d,)``; counts as one evaluation. The gradient is 0 where the
        value is not finite.

        Raises `InputError` where no gradient is offered, and as `evaluate` does.
        """

    def accepts(self, current: float, candidate: float, temperature: float, rng: np.random.Generator) -> bool:
        """Whether a walk goes on from the candidate (the paper's ``SlCr``): Metropolis' rule, unless the method was
        given another."""

    def note(self, **scalars: float) -> None:
        """Pass scalars (temperature, acceptance, ...) to the trace and to observers."""

    @property
    def observed(self) -> bool:
        """Whether anybody looks at sketches; where not, they need not be made. A search must not depend on it."""

    def sketch(self, role: str, lower: Array, upper: Array | None = None, rounded: bool = False) -> None:
        """Show observers what the search looks at, or has ruled out: points ``lower (k, d)``, boxes from ``lower`` to
        ``upper``, or the ellipsoids within these boxes (``rounded``).

        ``role`` says in words what they are; of every role the last sketch is shown, of which the first 400 rows. It is
        no part of the trace, and changes nothing.
        """


class Maximiser(ABC):
    """A global maximiser over a box.

    ``scaled``: it is shown a box whose sides have a length of about 1, and values of about 1, in units that are powers
    of two: the units of the user then change nothing, whatever numbers of its own it compares with. One that only
    compares values, or has a constant of the user's, as a Lipschitz constant or a temperature, does without.
    ``apart``: of tuples of indices it is shown every index shifted round its box, so that all of them are apart where
    it begins, in the middle; one that draws its points at random does without.
    ``whole``: it makes sense of a function that is constant between whole numbers; one that follows slopes does not.
    """

    scaled: ClassVar[bool] = False
    apart: ClassVar[bool] = False
    whole: ClassVar[bool] = True

    @property
    def polished(self) -> float:
        """The share of a budget that goes to a local method at the end of `sparserob_core.maximise` and
        `sparserob_core.ask_tell`, unless the user says otherwise; 0 where that would spoil what the maximiser is for,
        such as an upper bound, or being a yardstick."""
        return 0.2

    @abstractmethod
    def search(self, objective: Objective, rng: np.random.Generator) -> float:
        """Evaluate until the budget is spent or nothing is left to gain; return a proven upper bound of the maximum, or
        ``inf``."""


class EvaluationError(SparseRobError):
    """The function that is maximised raised, or did not return one real number per point, or NaN at all of them;
    ``report`` holds what was found before."""

    def __init__(self, message: str, report: Report) -> None:
        super().__init__(message)
        self.report = report


@dataclass(frozen=True, eq=False)
class Trace:
    """Every evaluation in order: ``points (n, d)``, ``values (n,)``, the running ``best (n,)``, and for each name that
    was noted the rows ``(evaluations so far, value)`` as ``notes[name] (j, 2)``. ``points`` is empty ``(0, d)`` where
    all of them would be too many; ``seconds (n,)`` since the search began, when each value was known. After the first
    ``searched`` of them the local method went on that polishes (``None``: it did not)."""

    points: Array
    values: Array
    best: Array
    seconds: Array
    notes: Mapping[str, Array] = field(default_factory=dict)
    searched: int | None = None

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Report:
    """The outcome of a search: the best evaluated value and where, and a proven ``upper_bound`` of the maximum
    (``inf``: none).

    ``stopped`` says why the search ended; ``missing`` evaluations gave NaN, which counts as ``-inf``;
    ``best_point`` is NaN ``(d,)`` when nothing was evaluated. Of a search for the minimum (`ask_tell`) the best value
    is the least, NaN counts as ``inf``, and what is proven is a ``lower_bound`` of the minimum (``-inf``: none).
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
