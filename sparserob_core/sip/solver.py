"""Inner convex solvers: quadratic programs, the answers that a solver claims, and the choice of the solver.

No answer is used before it was checked. The finite programs of a run are answered by the quickest method (`Auto`), or
by the solver that the user named (`Named`).
"""

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


# Rounding allowed in a residual, relative to the numbers added up in it: 64 units (Higham 2002, section 3.1). With a
# tenth of it, an optimum to the last bit of numbers of a million is refused; with ten times as much, a digit is wasted.
RESIDUAL_ROUNDING = 2.0**-46
logger = logging.getLogger("sparserob")
AUTO = "auto"  # the name of `Auto`
# Approximate number of multiplications in a factorisation from which a program is solved in a process of its own where
# time is limited: a tenth of a second for all iterations. Ten times as many take as long as a limit may be exceeded on
# a busy machine. With a tenth, the start of the process, some milliseconds, would be noticed.
SEPARATE_PROCESS_WORK = 1e7
SHORTCUTS = frozenset({CLOSED_FORM, DUAL_NEWTON, HIGHS})
NUMBERS = re.compile(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """A convex quadratic program, possibly with second-order cones.

    Minimise ``1/2 x'P x + q'x`` subject to ``G x <= h``, ``A x = b``, ``lower <= x <= upper`` and the ``cones``. Only
    solvers that declare ``conic`` receive programs with cones. There are ``n`` variables, ``r`` rows and ``e``
    equalities; ``r`` and ``e`` may be 0, and the arrays are then empty, never missing. No array may be changed.

    Parameters
    ----------
    P : csc_array, shape (n, n)
        The whole symmetric matrix, not one triangle of it; positive semidefinite, and often 0.
    q : ndarray, shape (n,)
        Linear cost.
    G : csc_array, shape (r, n)
        Rows of the inequalities.
    h : ndarray, shape (r,)
        Right-hand sides of the inequalities, finite.
    A : csc_array, shape (e, n)
        Rows of the equalities.
    b : ndarray, shape (e,)
        Right-hand sides of the equalities, finite.
    lower, upper : ndarray, shape (n,)
        Bounds, infinite where there is none; they may be equal.
    cones : tuple of ndarray of int, default ()
        Variables of each second-order cone.

    Notes
    -----
    Matrices are of scipy's sparse class ``csc_array``. Some solvers need ``csc_matrix`` or ``toarray()``.
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
    """Variables of each second-order cone: the first is at least the Euclidean norm of the others. The cones share no
    variable."""

    @property
    def work(self) -> float:
        """Approximate number of multiplications of one factorisation.

        Every entry of the rows is multiplied with the entries of its column, or of its row where these are fewer. A
        hundredth of the work of a dense factorisation is added.
        """
        n, r = self.q.size, self.h.size + self.b.size
        return float((self.G.nnz + self.A.nnz) * (1 + min(n, r)) + 0.01 * (n + r) ** 3)

    def slope_missed(self, slope: Array) -> Array:
        """Return the stationarity residual ``(n,)`` of a gradient of the Lagrangian.

        Parameters
        ----------
        slope : ndarray, shape (n,)
            Gradient of the Lagrangian without the terms of the cones.

        Returns
        -------
        ndarray, shape (n,)
            The absolute value of each entry. For the variables of a cone, the residual is in the first entry: the
            amount by which the gradient is outside of the cone.
        """
        residuals = np.abs(slope)
        for cone in self.cones:
            residuals[cone] = 0.0
            residuals[cone[0]] = max(float(np.linalg.norm(slope[cone[1:]])) - slope[cone[0]], 0.0)
        return residuals


@dataclass(frozen=True, eq=False)
class Claim:
    """Answer of a solver, not yet checked: a point, multipliers and a status.

    The multipliers satisfy ``P x + q + G'z + A'y + z_box = 0``. In the variables of a cone this sum is the multiplier
    of the cone, and lies in the cone. Solvers that maximise, or that write ``G x >= h``, have some of these signs
    reversed.

    Parameters
    ----------
    status : {"solved", "infeasible", "failed"}
        ``infeasible``: ``z`` and ``y`` may hold the Farkas ray. Then ``z >= 0``, and ``G'z + A'y`` together with the
        bounds proves that no ``x`` exists. ``failed``: everything else, an unbounded program too.
    x : ndarray, shape (n,)
        The point.
    z : ndarray, shape (r,)
        Multipliers of the rows: at least 0, and 0 where a row is not active.
    y : ndarray, shape (e,)
        Multipliers of the equalities, of any sign.
    z_box : ndarray, shape (n,)
        Multipliers of the bounds: at most 0 at a lower bound, at least 0 at an upper bound, and 0 between them.
    message : str
        Text for a reader.

    Notes
    -----
    Arrays of a claim that is not ``solved`` may hold NaN.

    Examples
    --------
    Minimise ``x1^2/2 + x2^2/2 - 5 x1 + x2`` subject to ``x1 + x2 <= 1``, ``x1 - x2 = 1``, ``0 <= x <= 2``. The optimum
    is ``x = (1, 0)``, where ``P x + q = (-4, 1)``. The multipliers ``z = 1.5`` and ``y = 2.5`` balance it:

    >>> import numpy as np
    >>> P, q = np.eye(2), np.array([-5.0, 1.0])
    >>> G, A = np.array([[1.0, 1.0]]), np.array([[1.0, -1.0]])
    >>> claim = Claim("solved", np.array([1.0, 0.0]), np.array([1.5]), np.array([2.5]), np.zeros(2))
    >>> (P @ claim.x + q + G.T @ claim.z + A.T @ claim.y + claim.z_box).tolist()
    [0.0, 0.0]

    Without the row: ``x = (2, 1)``, ``y = 2``, ``z_box = (1, 0)``. Without the equality: ``x = (1, 0)``, ``z = 4``,
    ``z_box = (0, -5)``. With the bounds alone: ``x = (2, 0)``, ``z_box = (3, -1)``, positive at the upper bound of
    ``x1`` and negative at the lower bound of ``x2``.
    """

    status: Literal["solved", "infeasible", "failed"]
    x: Array
    z: Array
    y: Array
    z_box: Array
    message: str = ""

    def judged(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Return this claim as ``solved`` where its residuals are small enough, whatever status the solver reported.

        A solver that stops at its last iteration, because double precision has no more digits, has solved the program.
        Arrays of wrong sizes, or with entries that are not finite, solve nothing. The status ``infeasible`` stays.

        Parameters
        ----------
        program : QuadraticProgram
            The program that was solved.
        accuracy : float
            Largest residual allowed.

        Returns
        -------
        Claim
            This claim, or a copy of it with the status ``solved``.
        """
        if self.status != "failed" or not self.met(program, accuracy):
            return self
        return replace(self, status="solved", message=f"{self.message}, with an answer that holds")

    def met(self, program: QuadraticProgram, accuracy: float) -> bool:
        """Return whether all residuals are at most ``accuracy``, or rounding errors.

        Checked are rows, equalities, bounds, cones, stationarity, signs of multipliers, and the gap of the two
        objectives. Rounding errors are relative to the largest numbers that are added up in a residual.

        Parameters
        ----------
        program : QuadraticProgram
            The program that was solved.
        accuracy : float
            Largest residual allowed.

        Returns
        -------
        bool
            False also for arrays of wrong sizes, or with entries that are not finite.
        """
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
        residuals = (
            (G @ x - program.h, abs(G) @ size + np.abs(program.h)),
            (np.abs(A @ x - program.b), abs(A) @ size + np.abs(program.b)),
            (outside, size),
            (np.array([np.linalg.norm(x[cone[1:]]) - x[cone[0]] for cone in program.cones]), size),
            (program.slope_missed(slope), slopes),
            (np.abs(terms.sum(keepdims=True)), np.abs(terms).sum(keepdims=True)),
        )
        return signs <= accuracy and all(
            amount.max(initial=0.0) <= max(accuracy, RESIDUAL_ROUNDING * float(sizes.max(initial=0.0)))
            for amount, sizes in residuals
        )


class Solver(ABC):
    """An inner convex solver, which answers one quadratic program at a time.

    An adapter declares its capabilities as class attributes, all false by default. ``warm_start``: it starts from its
    last solution. ``sparse``: it exploits sparse rows. ``conic``: it accepts programs with second-order ``cones``.
    ``aborts``: its compiled code ends the process on some programs. Such a solver runs in a process of its own where
    the system has one.
    """

    warm_start: ClassVar[bool] = False
    sparse: ClassVar[bool] = False
    conic: ClassVar[bool] = False
    aborts: ClassVar[bool] = False

    @property
    def delegate(self) -> str:
        """Name of the solver that answers every program for this one; empty unless this is an interface to several
        solvers.

        Tables and messages show it next to the solver's own name.
        """
        return ""

    @abstractmethod
    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Solve a program to the absolute residuals ``accuracy``; never raise for a program that is only hard.

        Parameters
        ----------
        program : QuadraticProgram
            The program. Its rows have unit norm, and the largest linear coefficient of its cost is near 1.
        accuracy : float
            Absolute residual to be reached.

        Returns
        -------
        Claim
            The answer. A claim that is not ``solved`` may hold the last iterate, which is checked too. A claim with
            ``infeasible`` may hold the Farkas ray in ``z`` and ``y``.
        """


@dataclass(frozen=True)
class Unanswered:
    """Programs of one kind that the named solver did not answer.

    Parameters
    ----------
    kind : str
        Kind of the programs.
    count : int
        Number of programs.
    reason : str
        Reason of the first failure.
    by : str
        Name of whoever answered them instead.
    """

    kind: str
    count: int
    reason: str
    by: str


@final
class Auto(Solver, Options):
    """No solver by name: every program is answered by the quickest method that suits it, and all answers are checked
    alike.

    The methods are the optimum in closed form where no row is active, Newton's method on the dual from the last
    solution, and the simplex method for linear programs with thousands of entries. The solver ``general`` answers the
    rest.
    """

    sparse: ClassVar[bool] = True

    general: Any = Field(default={"name": "piqp"}, json_schema_extra={"component": "solver"})
    """The solver for programs that none of these methods answers."""

    cones: Any = Field(default={"name": "clarabel"}, json_schema_extra={"component": "solver"})
    """The solver for costs with norms of groups; a solver that is not conic leaves these programs to ``general``."""

    _general_name: str = PrivateAttr(default=SOLVER)
    _cones_name: str = PrivateAttr(default=SOLVER)

    @model_validator(mode="after")
    def _record_names(self) -> Auto:
        if isinstance(self.general, Mapping):
            self._general_name = str(self.general.get("name"))
        if isinstance(self.cones, Mapping):
            self._cones_name = str(self.cones.get("name"))
        for path, name in (("general", self._general_name), ("cones", self._cones_name)):
            if name == AUTO or isinstance(getattr(self, path), Auto):
                raise InputError(path=path, expected="a solver that answers by itself", got=AUTO)
        return self

    @property
    def called(self) -> str:
        """Name of the ``general`` solver."""
        return whole_name(self.general, self._general_name)

    @property
    def of_cones(self) -> tuple[Solver, str] | None:
        """Solver for ``cones`` and its name; ``None`` where it is not conic."""
        if not isinstance(self.cones, Solver) or not self.cones.conic:
            return None
        return self.cones, whole_name(self.cones, self._cones_name)

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Return the claim of the ``general`` solver.

        Parameters
        ----------
        program : QuadraticProgram
            The program.
        accuracy : float
            Absolute residual to be reached.

        Returns
        -------
        Claim
            The answer.
        """
        claim: Claim = self.general.solve(program, accuracy)
        return claim


@final
class Failures:
    """Account of a named solver: the number of its calls, and the programs that it did not answer.

    Reasons that differ only in their numbers count as one. With a ``name``, the first program of each kind that another
    solver answers is logged at once. So no command has to report it.
    """

    def __init__(self, name: str = "") -> None:
        self.calls, self.name = 0, name
        self._entries: dict[tuple[str, str, str], Unanswered] = {}
        self._logged_kinds = set[tuple[str, str]]()

    def add(self, kind: str, reason: str, by: str, count: int = 1) -> None:
        """Add programs that the named solver did not answer.

        Parameters
        ----------
        kind : str
            Kind of the programs.
        reason : str
            Reason of the failure.
        by : str
            Name of whoever answered them instead.
        count : int, default 1
            Number of programs.
        """
        key = (kind, NUMBERS.sub("#", reason), by)
        entry = self._entries.get(key, Unanswered(kind, 0, reason, by))
        self._entries[key] = replace(entry, count=entry.count + count)
        if self.name and (kind, by) not in self._logged_kinds:
            self._logged_kinds.add((kind, by))
            logger.warning("solver %s did not answer a %s program, %s did: %s", self.name, kind, by, reason)

    def without_log(self) -> Failures:
        """Return this account, which logs nothing from now on; for a worker, whose account is continued by its
        sender."""
        self.name = ""
        return self

    def resume(self, calls: int, unanswered: Iterable[Unanswered]) -> None:
        """Continue from an account that was stored before and has been logged then.

        Parameters
        ----------
        calls : int
            Number of calls in the stored account.
        unanswered : iterable of Unanswered
            Programs of the stored account.
        """
        self.calls += calls
        for entry in unanswered:
            self._logged_kinds.add((entry.kind, entry.by))
            self.add(entry.kind, entry.reason, entry.by, entry.count)

    def __iter__(self) -> Iterator[Unanswered]:
        return iter(tuple(self._entries.values()))

    def since(self, before: tuple[Unanswered, ...]) -> tuple[Unanswered, ...]:
        """Return the programs that were added after ``before``, an earlier ``tuple`` of this account."""
        counts = {replace(entry, count=0): entry.count for entry in before}
        differences = (replace(entry, count=entry.count - counts.get(replace(entry, count=0), 0)) for entry in self)
        return tuple(entry for entry in differences if entry.count)


@final
class Named(Solver):
    """A solver that the user named: it answers every finite program.

    Where none of its answers passes the check, ``instead`` is called. The account ``failures`` records this, and logs
    it.
    """

    def __init__(self, solver: Solver, name: str, instead: Solver) -> None:
        self.solver, self.name, self.instead, self.failures = solver, name, instead, Failures(name)

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Return the claim of the named solver.

        Parameters
        ----------
        program : QuadraticProgram
            The program.
        accuracy : float
            Absolute residual to be reached.

        Returns
        -------
        Claim
            The answer.
        """
        return self.solver.solve(program, accuracy)


@final
class AccountedSolver(Solver):
    """A solver with an account of its calls, and with the solvers that may answer before it or instead of it.

    Parameters
    ----------
    solver : Solver
        The solver.
    name : str
        Name under which its answers are recorded.
    quick : frozenset of str
        Methods that may answer before the solver is called: `CLOSED_FORM`, `DUAL_NEWTON` from the last solution,
        `HIGHS`.
    instead : AccountedSolver, optional
        Solver that is called where no answer of this one passes the check.
    failures : Failures, optional
        Account of unanswered programs; a new one by default.
    cones : tuple of (Solver, str), optional
        Solver for programs with second-order cones, and its name. By default this is the solver itself, if it is conic.
    """

    def __init__(
        self,
        solver: Solver,
        name: str = SOLVER,
        quick: frozenset[str] = SHORTCUTS,
        instead: AccountedSolver | None = None,
        failures: Failures | None = None,
        cones: tuple[Solver, str] | None = None,
    ) -> None:
        self.solver, self.name, self.quick, self.instead = solver, name, quick, instead
        self.cones = (solver, name) if cones is None and solver.conic else cones
        self.calls, self.failures = 0, Failures() if failures is None else failures
        self.deadline = Deadline()

    @staticmethod
    def of(solver: Solver) -> AccountedSolver:
        """Return a solver with the account that its kind needs.

        `Auto`, and a solver that nobody named, answers only what the quick methods do not. A `Named` solver answers
        everything. The dual Newton method always starts from the last solution.
        """
        match solver:
            case AccountedSolver():
                return solver
            case Named():
                quick = frozenset({solver.name} & {DUAL_NEWTON})
                return AccountedSolver(
                    solver.solver, solver.name, quick, AccountedSolver.of(solver.instead), solver.failures
                )
            case Auto():
                return AccountedSolver(solver.general, solver.called, cones=solver.of_cones)
        return AccountedSolver(solver)

    def until(self, deadline: Deadline) -> AccountedSolver:
        """Return this solver, after a ``deadline`` was set for it and for the solver called instead."""
        self.deadline = deadline
        if self.instead is not None:
            self.instead.until(deadline)
        return self

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Return the claim of the solver, or of the solver for cones, and count the call.

        The call runs in a process of its own where the solver may end the process, or where the program is large and
        time is limited.

        Parameters
        ----------
        program : QuadraticProgram
            The program.
        accuracy : float
            Absolute residual to be reached.

        Returns
        -------
        Claim
            The answer.
        """
        self.calls += 1
        self.failures.calls += 1
        solver = self.cones[0] if program.cones and self.cones is not None else self.solver
        if POSSIBLE and (solver.aborts or (self.deadline.bounded and program.work > SEPARATE_PROCESS_WORK)):
            return call_apart(lambda: solver.solve(program, accuracy), self.deadline)
        return solver.solve(program, accuracy)


def named(solver: Solver, name: str, instead: Solver) -> Solver:
    """Return the solver as a `Named` one.

    Parameters
    ----------
    solver : Solver
        The solver.
    name : str
        Its name.
    instead : Solver
        Solver that is called where no answer passes the check.

    Returns
    -------
    Solver
        The named solver; `Auto`, and a solver that is named already, are returned unchanged.
    """
    return (
        solver
        if isinstance(solver, Auto | Named | AccountedSolver)
        else Named(solver, whole_name(solver, name), instead)
    )


def whole_name(solver: object, name: str) -> str:
    """Return the name of a solver for messages, with the name of its delegate in parentheses where it has one."""
    delegate = solver.delegate if isinstance(solver, Solver) else ""
    return f"{name} ({delegate})" if delegate else name


def quickest(solver: Solver) -> Solver:
    """Return the substitute of a `Named` solver, or the solver itself; used for pictures, which are no part of
    the run."""
    return solver.instead if isinstance(solver, Named) else solver
