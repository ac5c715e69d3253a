"""What an inner convex solver is asked, and what it claims; nothing of it is believed before `check`. Who answers the
finite programs of a run: whoever is quickest (`Auto`), or the solver that was named (`Named`)."""

from __future__ import annotations

import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from sparserob_core.errors import InputError
from sparserob_core.options import Options
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import CLOSED_FORM, DUAL_NEWTON, HIGHS, SOLVER
from sparserob_core.sip.limits.apart import POSSIBLE, call_apart
from sparserob_core.sip.limits.deadline import Deadline

if TYPE_CHECKING:
    from scipy.sparse import csc_array


# Of the numbers that are added up in a residual: 64 units of rounding (Higham 2002, section 3.1). Ten times less, and
# an optimum to the last bit of numbers of a million is none; ten times more, and a digit that there is is given away.
ROUNDING = 2.0**-46
logger = logging.getLogger("sparserob")
AUTO = "auto"  # the name of `Auto`
# Multiplications in a factorisation, about, from which a program is solved in a process of its own where time is
# limited: a tenth of a second for all iterations. Ten times as many take as long as a limit may be missed by on a busy
# machine; for a tenth the process itself, some milliseconds, would be noticed.
LONG = 1e7
SHORTCUTS = frozenset({CLOSED_FORM, DUAL_NEWTON, HIGHS})
NUMBERS = re.compile(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """minimise ``1/2 x'P x + q'x`` subject to ``G x <= h``, ``A x = b``, ``lower <= x <= upper``, and to ``cones``
    where there are any, which is for solvers alone that say that they are ``conic``.

    ``n`` variables, ``r`` rows, ``e`` equalities; ``r`` and ``e`` may be 0, the arrays are then empty and none is
    missing. ``P`` is the whole symmetric matrix, not one triangle of it, positive semidefinite, and often 0. ``h`` and
    ``b`` are finite; bounds may be infinite, and equal. Matrices are of scipy's sparse class ``csc_array``; some
    solvers want ``csc_matrix`` or ``toarray()``. Nothing of it is to be changed.
    """

    P: csc_array
    """``(n, n)``."""
    q: Array
    """``(n,)``."""
    G: csc_array
    """``(r, n)``."""
    h: Array
    """``(r,)``."""
    A: csc_array
    """``(e, n)``."""
    b: Array
    """``(e,)``."""
    lower: Array
    """``(n,)``, ``-inf`` where there is no bound."""
    upper: Array
    """``(n,)``, ``inf`` where there is no bound."""
    cones: tuple[np.ndarray, ...] = ()
    """The variables of each second-order cone: the first is at least the Euclidean norm of the others. No variable is
    in two of them."""

    @property
    def work(self) -> float:
        """About how many multiplications a factorisation takes: every entry of the rows meets those of its column, or
        of its row where these are fewer; and a hundredth of those of a solver that makes everything dense."""
        n, r = self.q.size, self.h.size + self.b.size
        return float((self.G.nnz + self.A.nnz) * (1 + min(n, r)) + 0.01 * (n + r) ** 3)

    def slope_missed(self, slope: Array) -> Array:
        """By how much the slope ``(n,)`` of the Lagrangian of all that is no cone misses what it may be, ``(n,)``: 0,
        and in a cone's variables a point of that cone."""
        missed = np.abs(slope)
        for cone in self.cones:
            missed[cone] = 0.0
            missed[cone[0]] = max(float(np.linalg.norm(slope[cone[1:]])) - slope[cone[0]], 0.0)
        return missed


@dataclass(frozen=True, eq=False)
class Claim:
    """What a solver says: ``x (n,)``, and multipliers with ``P x + q + G'z + A'y + z_box = 0``; in the variables of a
    cone that sum is the multiplier of the cone, and is in the cone.

    ``z (r,)`` of the rows is at least 0, and 0 where a row is not active. ``y (e,)`` of the equalities has any sign.
    ``z_box (n,)`` of the bounds is at most 0 at a lower and at least 0 at an upper bound, and 0 between them. Solvers
    that maximise, or that write ``G x >= h``, have some of these signs reversed.

    ``status`` is ``solved``, ``infeasible`` (then ``z, y`` may carry the Farkas ray: ``z >= 0``, and ``G'z + A'y``
    together with the bounds proves that no ``x`` exists), or ``failed`` for everything else, an unbounded program too.
    Arrays of a claim that is not ``solved`` may hold NaN; ``message`` is for a reader.

    An example: minimise ``x1^2/2 + x2^2/2 - 5 x1 + x2`` subject to ``x1 + x2 <= 1``, ``x1 - x2 = 1``,
    ``0 <= x <= 2``. The optimum is ``x = (1, 0)``, where ``P x + q = (-4, 1)``; ``z = 1.5`` and ``y = 2.5`` balance it:

    >>> import numpy as np
    >>> P, q = np.eye(2), np.array([-5.0, 1.0])
    >>> G, A = np.array([[1.0, 1.0]]), np.array([[1.0, -1.0]])
    >>> claim = Claim("solved", np.array([1.0, 0.0]), np.array([1.5]), np.array([2.5]), np.zeros(2))
    >>> (P @ claim.x + q + G.T @ claim.z + A.T @ claim.y + claim.z_box).tolist()
    [0.0, 0.0]

    Without the row: ``x = (2, 1)``, ``y = 2``, ``z_box = (1, 0)``. Without the equality: ``x = (1, 0)``, ``z = 4``,
    ``z_box = (0, -5)``. With the bounds alone: ``x = (2, 0)``, ``z_box = (3, -1)``, positive at the upper bound of
    ``x1`` and negative at the lower one of ``x2``.
    """

    status: Literal["solved", "infeasible", "failed"]
    x: Array
    z: Array
    y: Array
    z_box: Array
    message: str = ""

    def judged(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """The same as ``solved`` where its residuals say so, whatever word the solver ended with: one that stops at its
        last iteration, since double precision has no digits left, has solved the program. Arrays of wrong sizes, or
        with entries that are not finite, solve nothing; ``infeasible`` stays."""
        if self.status != "failed" or not self.met(program, accuracy):
            return self
        return replace(self, status="solved", message=f"{self.message}, with an answer that holds")

    def met(self, program: QuadraticProgram, accuracy: float) -> bool:
        """Whether rows, bounds, slopes, signs of multipliers and the gap of the two objectives are missed by at most
        ``accuracy``, or by the rounding of the largest numbers that are added up in them."""
        x, z, y, box = self.x, self.z, self.y, self.z_box
        pairs = ((x, program.q), (z, program.h), (y, program.b), (box, program.q))
        if not all(np.shape(got) == want.shape and np.isfinite(got).all() for got, want in pairs):
            return False
        low, high, size = np.isfinite(program.lower), np.isfinite(program.upper), np.abs(x)
        P, G, A = program.P, program.G, program.A
        above, below = np.maximum(box, 0.0), np.minimum(box, 0.0)
        signs = max(-z.min(initial=0.0), above[~high].max(initial=0.0), -below[~low].min(initial=0.0))
        outside = np.maximum(program.lower - x, x - program.upper)
        terms = np.concatenate(
            [
                x * (P @ x) + program.q * x,
                program.h * z,
                program.b * y,
                above[high] * program.upper[high],
                below[low] * program.lower[low],
            ]
        )
        slope = P @ x + program.q + G.T @ z + A.T @ y + box
        slopes = abs(P) @ size + np.abs(program.q) + abs(G).T @ np.abs(z) + abs(A).T @ np.abs(y) + np.abs(box)
        missed = (
            (G @ x - program.h, abs(G) @ size + np.abs(program.h)),
            (np.abs(A @ x - program.b), abs(A) @ size + np.abs(program.b)),
            (outside, size),
            (np.array([np.linalg.norm(x[cone[1:]]) - x[cone[0]] for cone in program.cones]), size),
            (program.slope_missed(slope), slopes),
            (np.abs(terms.sum(keepdims=True)), np.abs(terms).sum(keepdims=True)),
        )
        return signs <= accuracy and all(
            amount.max(initial=0.0) <= max(accuracy, ROUNDING * float(sizes.max(initial=0.0)))
            for amount, sizes in missed
        )


class Solver(ABC):
    """An inner convex solver: one quadratic program in, one claim out.

    Capabilities, declared by the adapter: ``warm_start`` (starts from its last solution), ``sparse`` (exploits sparse
    rows), ``conic`` (takes programs with ``cones``, second-order ones). ``aborts``: on some programs its compiled code
    ends the process, so that it is asked in a process of its own where the system has one.
    """

    warm_start: ClassVar[bool] = False
    sparse: ClassVar[bool] = False
    conic: ClassVar[bool] = False
    aborts: ClassVar[bool] = False

    @property
    def delegate(self) -> str:
        """The name of the solver to which it hands every program on; ``""`` unless it is a way to several: tables and
        messages tell it beside its own."""
        return ""

    @abstractmethod
    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Solve to the absolute residuals ``accuracy``; never raise for a program that is merely hard.

        Rows arrive with unit norm and the cost with its largest linear coefficient near 1. A claim that is not
        ``solved`` may still carry the last iterate: it is checked all the same. With ``infeasible``, ``z, y`` may carry
        the Farkas ray.
        """


@dataclass(frozen=True)
class Unanswered:
    """How many programs of a ``kind`` the solver that was named did not answer, why, in the words of the first, and by
    whom they were answered instead."""

    kind: str
    count: int
    reason: str
    by: str


@final
class Auto(Solver, Options):
    """No solver by name: the optimum in closed form where no row is active, Newton's method on the dual from the last
    solution, the simplex method for linear programs with thousands of entries; and ``general`` for what is left. All of
    them are checked alike."""

    sparse: ClassVar[bool] = True

    general: Any = Field(default={"name": "piqp"}, json_schema_extra={"component": "solver"})
    """The solver that is asked where none of these answers."""

    cones: Any = Field(default={"name": "clarabel"}, json_schema_extra={"component": "solver"})
    """The solver that is asked where norms of groups are in the cost; one that is not conic leaves these to
    ``general``."""

    _called: str = PrivateAttr(default=SOLVER)
    _called_of_cones: str = PrivateAttr(default=SOLVER)

    @model_validator(mode="after")
    def _named(self) -> Auto:
        if isinstance(self.general, Mapping):
            self._called = str(self.general.get("name"))
        if isinstance(self.cones, Mapping):
            self._called_of_cones = str(self.cones.get("name"))
        for path, name in (("general", self._called), ("cones", self._called_of_cones)):
            if name == AUTO or isinstance(getattr(self, path), Auto):
                raise InputError(path=path, expected="a solver that answers by itself", got=AUTO)
        return self

    @property
    def called(self) -> str:
        """The name of the ``general`` solver."""
        return whole_name(self.general, self._called)

    @property
    def of_cones(self) -> tuple[Solver, str] | None:
        """The solver of ``cones`` and its name, if it is conic."""
        if not isinstance(self.cones, Solver) or not self.cones.conic:
            return None
        return self.cones, whole_name(self.cones, self._called_of_cones)

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """See `Solver.solve`: the claim of the ``general`` solver."""
        claim: Claim = self.general.solve(program, accuracy)
        return claim


@final
class Failures:
    """What the solver that was named did not answer, of how many ``calls`` in all: reasons that differ in their numbers
    alone are one. ``name``: the solver's; the first program of each kind that another one answers is then logged as it
    happens, so that no command and no function of Python has to remember to tell it."""

    def __init__(self, name: str = "") -> None:
        self.calls, self.name = 0, name
        self._known: dict[tuple[str, str, str], Unanswered] = {}
        self._logged = set[tuple[str, str]]()

    def add(self, kind: str, reason: str, by: str, count: int = 1) -> None:
        """Note that programs of a ``kind`` were answered by somebody else."""
        key = (kind, NUMBERS.sub("#", reason), by)
        known = self._known.get(key, Unanswered(kind, 0, reason, by))
        self._known[key] = replace(known, count=known.count + count)
        if self.name and (kind, by) not in self._logged:
            self._logged.add((kind, by))
            logger.warning("solver %s did not answer a %s program, %s did: %s", self.name, kind, by, reason)

    def without_log(self) -> Failures:
        """Itself, which logs nothing any more: in a worker, whose account whoever has sent it work goes on with."""
        self.name = ""
        return self

    def resume(self, calls: int, missed: Iterable[Unanswered]) -> None:
        """Go on from an account that was kept before, and was told then."""
        self.calls += calls
        for one in missed:
            self._logged.add((one.kind, one.by))
            self.add(one.kind, one.reason, one.by, one.count)

    def __iter__(self) -> Iterator[Unanswered]:
        return iter(tuple(self._known.values()))

    def since(self, before: tuple[Unanswered, ...]) -> tuple[Unanswered, ...]:
        """What was added to ``before``, an earlier ``tuple`` of the same."""
        counts = {replace(one, count=0): one.count for one in before}
        new = (replace(one, count=one.count - counts.get(replace(one, count=0), 0)) for one in self)
        return tuple(one for one in new if one.count)


@final
class Named(Solver):
    """A solver that was named: it answers every finite program. Where no answer of it is believed, ``instead`` is
    asked, and ``failures`` says so, in the log too."""

    def __init__(self, solver: Solver, name: str, instead: Solver) -> None:
        self.solver, self.name, self.instead, self.failures = solver, name, instead, Failures(name)

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """See `Solver.solve`."""
        return self.solver.solve(program, accuracy)


@final
class Asked(Solver):
    """A solver, and the account of what it is asked: the number of ``calls`` of it, and its ``failures``.

    ``name``: whose its answers are. ``quick``: who may answer before it is asked (`CLOSED_FORM`, `DUAL_NEWTON` from the
    last solution, `HIGHS`). ``instead``: who is asked where no answer of it is believed. ``cones``: who is asked for a
    program with second-order cones, and the name: itself, if it is conic and nobody else is given.
    """

    def __init__(
        self,
        solver: Solver,
        name: str = SOLVER,
        quick: frozenset[str] = SHORTCUTS,
        instead: Asked | None = None,
        failures: Failures | None = None,
        cones: tuple[Solver, str] | None = None,
    ) -> None:
        self.solver, self.name, self.quick, self.instead = solver, name, quick, instead
        self.cones = (solver, name) if cones is None and solver.conic else cones
        self.calls, self.failures = 0, Failures() if failures is None else failures
        self.deadline = Deadline()

    @staticmethod
    def of(solver: Solver) -> Asked:
        """What a solver is asked: of `Auto` and of one that nobody has named, only what it is needed for; of one that
        was `Named`, everything. The dual Newton method starts from the last solution in any case."""
        match solver:
            case Asked():
                return solver
            case Named():
                quick = frozenset({solver.name} & {DUAL_NEWTON})
                return Asked(solver.solver, solver.name, quick, Asked.of(solver.instead), solver.failures)
            case Auto():
                return Asked(solver.general, solver.called, cones=solver.of_cones)
        return Asked(solver)

    def until(self, deadline: Deadline) -> Asked:
        """Itself, no longer waited for from the ``deadline`` on, nor is who is asked instead."""
        self.deadline = deadline
        if self.instead is not None:
            self.instead.until(deadline)
        return self

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """See `Solver.solve`."""
        self.calls += 1
        self.failures.calls += 1
        asked = self.cones[0] if program.cones and self.cones is not None else self.solver
        if POSSIBLE and (asked.aborts or (self.deadline.bounded and program.work > LONG)):
            return call_apart(lambda: asked.solve(program, accuracy), self.deadline)
        return asked.solve(program, accuracy)


def named(solver: Solver, name: str, instead: Solver) -> Solver:
    """The solver as one that was `Named`; `Auto` is no solver by name."""
    return solver if isinstance(solver, Auto | Named | Asked) else Named(solver, whole_name(solver, name), instead)


def whole_name(solver: object, name: str) -> str:
    """What a solver of that name is told as: with the one to which it hands its programs on, where that is another."""
    delegate = solver.delegate if isinstance(solver, Solver) else ""
    return f"{name} ({delegate})" if delegate else name


def quickest(solver: Solver) -> Solver:
    """Who answers instead of a solver that was `Named`, for what is drawn of a run and is no part of it."""
    return solver.instead if isinstance(solver, Named) else solver
