"""Uncertain linear optimal control problems, as data."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self, final, get_args

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.cost import Cost
from sparserob_core.control.problem.disturbances import (
    Breakpoints,
    Classes,
    Disturbance,
    DisturbanceClass,
    apart,
    joined,
)
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.problem.prices import WEIGHTS, checked_weights, counted, integrals
from sparserob_core.control.problem.system import (
    LinearSystem,
    SwitchedSystem,
    System,
    VaryingSystem,
    require_period,
)
from sparserob_core.control.sets.sets import Equality, Polytope, Product
from sparserob_core.control.term import CONTROLS, STATES, TERMS, TIME, UNITLESS, Term, measured, over, timed
from sparserob_core.errors import InputError
from sparserob_core.shapes import dense, sealed
from sparserob_core.sip.convex_set import Array, Box, ConvexSet, as_bound

if TYPE_CHECKING:
    from sparserob_core.sip.program import SemiInfiniteProgram

SHORTEST = 1e-12  # of the horizon: a delay that is not rounding
SAME = 1e-12  # of the size of a set, what is rounding
RETURN = "return"  # what the constraint that a plan which repeats ends where it may begin is called
# The share of the set of initial states by which final ones stay inside it, ten times the tolerance of a proof, so that
# no violation is handed on: a tenth of it would let one, ten times as much is seen in the cost.
WITHIN = 1e-8


SYSTEM = {
    "in_units": lambda system, units: units.of_system(system),
    "remaining": lambda system, begin, horizon: system.remaining(begin, horizon),
}


def _moved(rows: npt.ArrayLike, begin: float, horizon: float) -> Array:
    """Rows of a time and a point ``(q, 1 + d)``, from ``begin`` on."""
    given = np.asarray(rows, dtype=float)
    shifted = given - np.eye(1, given.shape[1])[0] * begin
    later: Array = shifted[shifted[:, 0] > 0.0]
    if shifted[0, 0] > 0.0:
        return later
    now = [np.interp(0.0, shifted[:, 0], column) for column in shifted[:, 1:].T]
    return np.vstack([[0.0, *now], later])


def _pieces(times: Array, begin: float, horizon: float) -> Array:
    """Breakpoints from ``begin`` on, with what is left of the piece that has begun."""
    later = [time - begin for time in times.tolist() if not over(time, begin, horizon)]
    return np.array([0.0, *later[:-1], horizon])


class _Window(Term, ABC):
    """What holds from a ``start`` to a ``stop``, wherever it moves: ``relative_to``. One that is ``lasting`` needs a
    window of positive length."""

    start: float
    stop: float | None
    relative_to: npt.ArrayLike | None = None
    lasting: ClassVar[bool] = False

    def remaining(self, begin: float, horizon: float, **given: Any) -> Self | None:
        end = begin + horizon
        late = over(end, self.start) if self.lasting else not over(self.start, end)
        if late or (self.stop is not None and over(self.stop, begin, horizon)):
            return None
        return super().remaining(begin, horizon, **given)

    @property
    @abstractmethod
    def bounds(self) -> ConvexSet:
        """The set that a factor enlarges; raises `InputError` where there is none."""

    @abstractmethod
    def scaled(self, factor: float) -> Self:
        """Itself with its `bounds` larger by that factor about their middle."""


@dataclass(frozen=True, eq=False)
class PathConstraint(_Window):
    """The state stays in ``set`` for all times in ``[start, stop]``; ``stop`` is the horizon when ``None``.

    ``relative_to (q, 1 + d)``: rows of a time and a point, times increasing: then ``x(t) - r(t)`` stays in the set,
    where ``r`` runs from point to point along straight lines. The times cover the window.
    """

    set: ConvexSet = field(metadata=STATES)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    relative_to: npt.ArrayLike | None = field(default=None, metadata=timed(lambda of: of.states, _moved))

    __repr__ = noun

    @property
    def bounds(self) -> ConvexSet:
        return self.set

    def scaled(self, factor: float) -> Self:
        return replace(self, set=self.set.scaled(factor))


@dataclass(frozen=True, eq=False)
class MixedConstraint(_Window):
    """``H x(t) + G u(t) <= h`` for all times in ``[start, stop]``; ``H (r, d)``, ``G (r, m)``, ``h (r,)``, a number for
    all rows alike; ``stop`` is the horizon when ``None``.

    It holds on every piece of the control that meets the window in positive length, its ends included, with the control
    of that piece: where the control jumps, with both of its values. ``u(t)`` is the commanded control, delay or not.
    """

    H: npt.ArrayLike = field(metadata=measured(lambda of: 1.0 / of.states))
    G: npt.ArrayLike = field(metadata=measured(lambda of: 1.0 / of.controls))
    h: npt.ArrayLike = field(metadata=UNITLESS)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    lasting = True  # a control lasts

    __repr__ = noun

    @cached_property
    def set(self) -> Polytope:
        """The set of all ``(x, u)`` that are allowed, ``d + m`` coordinates."""
        return Polytope(np.hstack([np.asarray(self.H), np.asarray(self.G)]), np.asarray(self.h))

    @property
    def bounds(self) -> ConvexSet:
        if not (np.asarray(self.h) > 0.0).all():
            raise InputError("bounds state and control together, and h is not positive: 0 is no middle of it")
        return self.set

    def scaled(self, factor: float) -> Self:
        return replace(self, h=factor * np.asarray(self.h, dtype=float))


@dataclass(frozen=True, eq=False)
class IntegralConstraint(_Window):
    """``lower <= int_start^stop (H x(t) + G u(t)) dt <= upper``, row by row: fuel of a channel, energy of a battery, a
    mean temperature. ``H (r, d)``, ``G (r, m)``, either of them absent: 0; ``lower``, ``upper (r,)``, a number for all
    rows alike, infinite or ``None`` where there is no bound; ``stop`` is the horizon when ``None``.

    ``u(t)`` is the commanded control, delay or not. The running integral from ``start`` on is one more state for each
    row, which nothing measures.
    """

    H: npt.ArrayLike | None = field(default=None, metadata=measured(lambda of: 1.0 / (of.states * of.time)))
    G: npt.ArrayLike | None = field(default=None, metadata=measured(lambda of: 1.0 / (of.controls * of.time)))
    lower: npt.ArrayLike | Sequence[float | None] | None = field(default=None, metadata=UNITLESS)
    upper: npt.ArrayLike | Sequence[float | None] | None = field(default=None, metadata=UNITLESS)
    start: float = field(default=0.0, metadata=TIME)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)

    __repr__ = noun

    def remaining(self, begin: float, horizon: float, **given: Any) -> Self | None:
        left = super().remaining(begin, horizon, **given)
        if left is not None and (self.start < begin or not over(self.stop or 0.0, begin + horizon)):
            raise InputError("a part of an integral is known as a state only: see `accumulated`", path="integral")
        return left

    @property
    def bounds(self) -> Box:
        return Box(np.asarray(self.lower), np.asarray(self.upper))

    def scaled(self, factor: float) -> Self:
        box = self.bounds.scaled(factor)
        return replace(self, lower=box.lower, upper=box.upper)


@final
@dataclass(frozen=True, eq=False)
class Accumulated(PathConstraint):
    """An `IntegralConstraint` where its integral is a state: a window of one time."""


@final
@dataclass(frozen=True, eq=False)
class Return(PathConstraint):
    """The state comes back to where a period may begin, of a plan that repeats: a window of one time, the horizon, and
    the set of initial deviations about their centre. Made by `OptimalControlProblem`."""


class Repeating(Enum):
    """What `repeat` of a problem is whose constraints have the return among them."""

    IMPOSED = "imposed"


@dataclass(frozen=True, eq=False, kw_only=True)
class OptimalControlProblem(Term):
    """Minimise a `Cost`, ``sum_i weights_i int_0^T |u_i(t)| dt`` unless told otherwise, such that for every disturbance
    and every parameter

    ``x' = A(p) x + B(p) u + E(p) w + c(p)``, ``x(0) = initial_state (d,)``, ``u(t)`` in ``control``, ``x(t)`` in every
    ``path`` set during its window (or ``(x(t), u(t))``: `MixedConstraint`), and ``x(T)`` in every ``terminal`` set,
    where ``T = horizon`` (in the time unit of the system), at which the last piece of a `SwitchedSystem` must end.

    ``disturbance``: the bounded set of ``w``, or ``None``; ``disturbance_class`` says which functions it makes:
    ``piecewise_constant`` (every piece of the disturbance's dictionary in the set), ``measurable`` (any measurable
    function into the set), or ``l1_ball`` (the coefficients of channel ``i`` in the dictionary have absolute sum at
    most ``upper_i`` of a symmetric box: a far smaller set). ``initial_control``: the control ``(m,)`` before time 0, or
    ``None`` where it does not matter. ``control_step``: the set of every change ``u_{k+1} - u_k`` from one piece of the
    control's dictionary to the next, of ``u_0 - initial_control`` too where that is told; ``None``: any.
    ``names`` are for messages, tables and figures.

    ``disturbances``: instead of ``disturbance``, a list of them, each with its set, its ``E``, its class, its window
    of time and the pieces on which it is constant; ``w`` is made of all of them, one after another. After construction
    ``disturbance`` is the product of their sets, ``E`` of the system has the columns of theirs (0 in pieces of the
    system outside of a window), and the list is empty; where there are two classes, ``disturbance_class`` has that of
    every part of the product, and where one has pieces of its own, ``disturbance_breakpoints`` has the ends of the
    pieces of every part, ``None`` where these are those of the disturbance's dictionary.

    ``initial_set``: the bounded set of deviations from ``initial_state``, or ``None``; it holds 0. The state begins
    anywhere in ``initial_state + initial_set``, and every constraint holds from there.

    ``integral``: bounds of integrals of state and control over windows, `IntegralConstraint`.

    ``measurements``: what a policy that answers measurements sees; the whole state, without noise and at once, unless
    given. Of a control that answers nothing it changes nothing.

    ``repeat``: at the horizon the plan begins again, for ever. Every final state is then one of the initial states,
    from which all constraints hold for another period, so that they hold for all time; the steps from any last control
    to any first one are in ``control_step`` too. No set has to be invariant in between. What changes with time begins
    again too, and has the horizon as its period. Final states stay inside by `WITHIN` of the set, so that what is
    proven to a tolerance is proven for ever; coordinates of which there is one value are fixed at the end, to rounding.

    ``execution``: a share of the control, from 0 to 1, one for each: what is delivered differs from the command by at
    most that share of it, any function of time, and every constraint on the state holds nonetheless; of nothing
    nothing is missing. What a mixed constraint says of the control, the set of the control, that of its steps and the
    cost are about the command. ``None``: what is commanded is delivered.

    ``weights``: a positive number, one for each control, or rows of a time and the weights from then on, which are not
    negative: prices, or a supply that is free for a while. The first time is 0.

    After construction ``weights`` is ``(m,)``, or ``(r, 1 + m)`` of rows, ``path``, ``terminal`` and ``integral`` are
    tuples, every window has its ``stop``, constraints that restrict nothing are gone, and of a problem that repeats the
    `Return` is the last of the path, and what is fixed then the last of the terminal equalities. An initial state
    outside a path set is legal: that problem is infeasible. Raises `InputError`.
    """

    system: System = field(metadata=SYSTEM)
    horizon: float = field(metadata=TIME)
    initial_state: npt.ArrayLike = field(metadata=STATES)
    control: ConvexSet = field(metadata=CONTROLS)
    initial_set: ConvexSet | None = field(default=None, metadata=STATES)
    weights: npt.ArrayLike | None = field(default=None, metadata=WEIGHTS)
    disturbance: ConvexSet | None = field(default=None, metadata=measured(lambda of: of.disturbances))
    disturbance_class: Classes = field(default="piecewise_constant", metadata=UNITLESS)
    path: Sequence[PathConstraint | MixedConstraint | ConvexSet] = field(default=(), metadata=TERMS)
    terminal: Sequence[ConvexSet | Equality] = field(default=(), metadata=STATES)
    integral: Sequence[IntegralConstraint] = field(default=(), metadata=TERMS)
    title: str = field(default="", metadata=UNITLESS)
    initial_control: npt.ArrayLike | None = field(default=None, metadata=CONTROLS)
    control_step: ConvexSet | None = field(default=None, metadata=CONTROLS)
    names: Names = field(default=UNNAMED, metadata=UNITLESS)
    cost: Cost = field(default=Cost(), metadata=TERMS)
    disturbances: Sequence[Disturbance] = field(default=(), metadata=UNITLESS)  # none after construction
    measurements: Measurements | None = field(default=None, metadata=TERMS)
    repeat: bool | Repeating = field(default=False, metadata=UNITLESS)
    execution: npt.ArrayLike | None = field(default=None, metadata=UNITLESS)
    disturbance_breakpoints: Breakpoints | None = field(default=None, metadata=measured(lambda of: of.time, _pieces))

    __repr__ = noun

    def __post_init__(self) -> None:
        if not isinstance(self.system, LinearSystem | SwitchedSystem | VaryingSystem):
            raise InputError(path="system", expected="a LinearSystem", got=f"{type(self.system).__name__}")
        horizon = as_bound("horizon", self.horizon)
        if horizon.shape != (1,) or not 0.0 < horizon[0] < np.inf:
            raise InputError(path="horizon", expected="a positive, finite time", got=f"{self.horizon!r}")
        self._set("horizon", float(horizon[0]))
        if not (self.system.delay == 0.0 or SHORTEST * self.horizon < self.system.delay < self.horizon):
            raise InputError(
                path="system.delay",
                expected=f"less than {self.horizon:g} (the horizon), or no control ever acts, and more than rounding",
                got=f"{self.system.delay:g}",
            )
        if isinstance(self.system, SwitchedSystem):
            self._check_pieces(self.system)
        self._join_disturbances()
        self._set("initial_state", self._state())
        self._set("initial_set", self._deviations())
        self._set("weights", checked_weights(self.weights, self.system.controls, self.horizon))
        self._set("initial_control", self._control_before())
        self._set("cost", self._costs())
        _checked_set("control", self.control, self.system.controls, "controls", bounded=True)
        if self.control_step is not None:
            step = _checked_set("control_step", self.control_step, self.system.controls, "controls")
            self._set("control_step", None if _restricts_nothing(step) else step)
        self._check_disturbance()
        if isinstance(self.system, VaryingSystem) and self.measurable is not None and not self.measurable.is_box:
            raise InputError(
                path="disturbance",
                expected="a box where the system changes with time and disturbances are measurable",
                got=self.measurable.kind,
            )
        self._set("measurements", self._measured())
        self._check_names()
        windows = [self._windowed(f"path.{i}", entry) for i, entry in enumerate(_listed("path", self.path))]
        self._set("path", tuple(window for window in windows if not _restricts_nothing(window.set)))
        self._set("terminal", tuple(self._terminal()))
        integrals = enumerate(_listed("integral", self.integral, "IntegralConstraint"))
        self._set("integral", tuple(self._integrated(f"integral.{i}", entry) for i, entry in integrals))
        if isinstance(self.system, VaryingSystem):
            self._check_varying(self.system)
            if self.system.parameters is not None:
                self._check_uncertain()
        if self.repeat is not Repeating.IMPOSED:
            self._return()
        self._set("execution", self._executed())
        sealed(self)

    @property
    def measurable(self) -> ConvexSet | None:
        """The set of the measurable disturbances, 0 along the columns of others; ``None`` where there are none."""
        return apart(self.disturbance, self.disturbance_class, "measurable")

    @property
    def windows(self) -> list[PathConstraint | MixedConstraint]:
        """The constraints on the path, of which none is a bare set any more."""
        return [entry for entry in self.path if not isinstance(entry, ConvexSet)]

    @property
    def of_states(self) -> list[PathConstraint]:
        """Those of the `windows` that are about the state alone."""
        return [entry for entry in self.windows if isinstance(entry, PathConstraint)]

    @property
    def terminal_sets(self) -> list[ConvexSet]:
        """The sets that the final state must be in; those that fix values are not among them."""
        return [end for end in self.terminal if not isinstance(end, Equality)]

    @property
    def terminal_equalities(self) -> list[Equality]:
        """What fixes values of the final state."""
        return [end for end in self.terminal if isinstance(end, Equality)]

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_pieces(self, system: SwitchedSystem) -> None:
        last = len(system.pieces) - 1
        begin = 0.0
        for i, (until, _) in enumerate(system.pieces):
            if until - begin <= SHORTEST * self.horizon:
                raise InputError(
                    path=f"system.pieces.{i}.until",
                    expected=f"a time that is after {begin:g} by more than rounding",
                    got=f"{until!r}",
                )
            begin = until
        if abs(system.pieces[last][0] - self.horizon) > SHORTEST * self.horizon:
            raise InputError(
                path=f"system.pieces.{last}.until",
                expected=f"{self.horizon:g}, the horizon, since it is the last piece",
                got=f"{system.pieces[last][0]:g}",
            )

    def _check_varying(self, system: VaryingSystem) -> None:
        """Raise `InputError` where the laws of a system that changes with time do not fill the horizon."""
        last = len(system.later)
        if abs(system.horizon - self.horizon) > SHORTEST * self.horizon:
            raise InputError(
                path=f"system.pieces.{last}.until" if last else "system",
                expected=f"{self.horizon:g}, the horizon, since it is the last piece"
                if last
                else f"a law up to {self.horizon:g}, the horizon",
                got=f"up to {system.horizon:g}",
            )
        for i, (begin, until, _) in enumerate(system.laws):
            if until - begin <= SHORTEST * self.horizon:
                raise InputError(
                    path=f"system.pieces.{i}.until",
                    expected=f"a time that is after {begin:g} by more than rounding",
                    got=f"{until!r}",
                )

    def _check_uncertain(self) -> None:
        """Raise `InputError` for what is not proven of a system that changes with time and has parameters."""
        if self.repeat:
            raise InputError(path="repeat", expected="false where parameters stand beside the time t", got="true")
        where = [(f"path.{i}", one.set) for i, one in enumerate(self.path) if not isinstance(one, ConvexSet)]
        for i, end in enumerate(self.terminal):
            if isinstance(end, Equality):
                raise InputError(
                    path=f"terminal.{i}",
                    expected="no fixed final values where parameters stand beside the time t, which reach them",
                    got="some",
                )
            where.append((f"terminal.{i}", end))
        for path, bound in where:
            if bound.halfspaces() is None:
                expected = "a set with flat sides where parameters stand beside the time t"
                raise InputError(path=path, expected=expected, got=bound.kind)

    def _executed(self) -> Array | None:
        """The errors of execution, ``None`` where there are none; raises `InputError` for what they are not proven
        with yet."""
        if self.execution is None:
            return None
        m = self.system.controls
        shares = np.atleast_1d(as_bound("execution", self.execution))
        if shares.shape != (m,) or not ((shares >= 0.0) & (shares <= 1.0)).all():
            raise InputError(
                path="execution", expected=f"{m} numbers from 0 to 1, one per control", got=f"{shares.tolist()}"
            )
        if not shares.any():
            return None
        sets = [one if isinstance(one, ConvexSet) else one.set for one in (*self.path, *self.terminal_sets)]
        refused = {
            "fixed final values, which an error of execution misses: a terminal set such as box": bool(
                self.terminal_equalities
            ),
            "pieces of the system": isinstance(self.system, SwitchedSystem),
            "uncertain parameters": bool(self.system.parameter_count),
            "a delay": self.system.delay > 0.0,
            "measurable disturbances": self.measurable is not None,
            "integrals of state and control": bool(self.integral),
            "curved sets of states": any(one.halfspaces() is None for one in sets),
            "a cost other than the L1 norm": not self.cost.is_linear,
        }
        for beside, given in refused.items():
            if given:
                raise InputError(path="execution", expected=f"none beside {beside}", got=f"{shares.tolist()}")
        return shares

    def _state(self) -> Array:
        d = self.system.states
        state = np.atleast_1d(as_bound("initial_state", self.initial_state))
        if state.size != d or not np.isfinite(state).all():
            raise InputError(
                path="initial_state", expected=f"{d} finite numbers, one per state", got=f"{state.tolist()}"
            )
        return state

    def _deviations(self) -> ConvexSet | None:
        if self.initial_set is None:
            return None
        bound = _checked_set("initial_set", self.initial_set, self.system.states, "states", bounded=True)
        axes = np.eye(bound.dimension)
        size = float(bound.reach(axes).max())
        if float(bound.violation(np.zeros(bound.dimension))) > SAME * size:
            raise InputError(
                path="initial_set",
                expected="a set of deviations that holds 0, so that the centre is one of the initial states",
                got=f"{bound.kind} without it",
            )
        return bound if size > 0.0 else None

    def prices(self, breakpoints: Array) -> Array:
        """What an absolute value of 1 of each control costs on every piece between ``breakpoints (K + 1,)``,
        ``(m, K)``: the weights, integrated exactly, times the factor of the L1 norm."""
        return float(self.cost.l1) * integrals(self.weights, breakpoints)

    @property
    def counts(self) -> Array:
        """What each control counts per time that it acts, ``(m,)``: its weight, or 1 where weights change with
        time."""
        return counted(self.weights)

    @property
    def cost_unit(self) -> str:
        """What the cost is measured in: the unit of a control's integral over time; empty where it is not known, or
        where weights or quadratic terms give it another one, which no name states."""
        weights = np.asarray(self.weights)
        priced = weights.ndim == 2 or bool((weights != 1.0).any())
        return "" if priced or self.cost.is_quadratic else self.names.effort

    def _measured(self) -> Measurements | None:
        if self.measurements is None:
            return None
        if not isinstance(self.measurements, Measurements):
            raise InputError(path="measurements", expected="Measurements", got=type(self.measurements).__name__)
        try:
            return self.measurements.checked(self.system.states, self.horizon)
        except InputError as error:
            raise error.under("measurements") from None

    def _costs(self) -> Cost:
        if not isinstance(self.cost, Cost):
            raise InputError(path="cost", expected="a Cost", got=f"{type(self.cost).__name__}")
        try:
            return self.cost.checked(self.system.states, self.system.controls, np.asarray(self.weights))
        except InputError as error:
            raise error.under("cost") from None

    def _control_before(self) -> Array | None:
        if self.initial_control is None:
            return None
        m = self.system.controls
        control = np.atleast_1d(as_bound("initial_control", self.initial_control))
        if control.shape != (m,) or not np.isfinite(control).all():
            raise InputError(
                path="initial_control", expected=f"{m} finite numbers, one per control", got=f"{control.tolist()}"
            )
        return control

    def _check_disturbance(self) -> None:
        kinds, bound = self.disturbance_class, self.disturbance
        if isinstance(kinds, tuple) and isinstance(bound, Product) and len(bound.parts) == len(kinds):
            known = set(kinds) == {"piecewise_constant", "measurable"}
        else:
            known = isinstance(kinds, str) and kinds in get_args(DisturbanceClass)
        if not known:
            raise InputError(
                path="disturbance_class",
                expected=f"one of {', '.join(get_args(DisturbanceClass))}",
                got=f"{self.disturbance_class!r}",
            )
        own, parts = self.disturbance_breakpoints, bound.parts if isinstance(bound, Product) else ()
        if own is not None and (len(own) != len(parts) or kinds != "piecewise_constant"):
            raise InputError(
                path="disturbance_breakpoints",
                expected="those of every part of a product of piecewise constant disturbances, made by disturbances",
                got=f"{len(own)} for {len(parts)} parts",
            )
        if self.disturbance is None:
            return
        _checked_set("disturbance", self.disturbance, self.system.disturbances, "columns of E", bounded=True)
        box = self.disturbance.bounding_box()
        symmetric = self.disturbance.is_box and np.array_equal(box.lower, -box.upper)
        if self.disturbance_class == "l1_ball" and not symmetric:
            raise InputError(
                "the class l1_ball needs a box that is symmetric about the origin, such as box: 0.1", path="disturbance"
            )

    def _join_disturbances(self) -> None:
        """One disturbance out of the list: that of all of them side by side."""
        every: object = self.disturbances
        if not isinstance(every, Sequence) or not all(isinstance(one, Disturbance) for one in every):
            raise InputError(path="disturbance", expected="a list of Disturbance", got=f"{type(every).__name__}")
        if not every:
            return
        if self.disturbance is not None or self.disturbance_class not in ("piecewise_constant", every[0].kind):
            raise InputError(
                path="disturbance_class" if self.disturbance is None else "disturbance",
                expected="none beside a list of disturbances, each of which has its own",
                got=f"{self.disturbance_class}" if self.disturbance is None else self.disturbance.kind,
            )
        system, bound, kind, breakpoints = joined(self.system, every, self.horizon)
        self._set("system", system)
        self._set("disturbance", bound)
        self._set("disturbance_class", kind)
        self._set("disturbance_breakpoints", breakpoints)
        self._set("disturbances", ())

    def _check_names(self) -> None:
        if not isinstance(self.names, Names):
            raise InputError(path="names", expected="Names(states=[...], ...)", got=f"{type(self.names).__name__}")
        self.names.fitting(self.system.states, self.system.controls, self.system.disturbances)

    def _windowed(self, where: str, entry: object) -> PathConstraint | MixedConstraint:
        item: PathConstraint | MixedConstraint
        if isinstance(entry, MixedConstraint):
            item = _checked_mixed(f"{where}.mixed", entry, self.system)
        else:
            item = entry if isinstance(entry, PathConstraint) else PathConstraint(entry)  # type: ignore[arg-type]
            _checked_set(where, item.set, self.system.states, "states")
        start, stop = float(item.start), self.horizon if item.stop is None else float(item.stop)
        if not 0.0 <= start <= stop <= self.horizon:
            raise InputError(
                path=where,
                expected=f"0 <= from <= to <= {self.horizon:g} (the horizon)",
                got=f"from {start:g} to {stop:g}",
            )
        if item.lasting and stop - start <= SHORTEST * self.horizon:
            expected = "a window of positive length, since a control lasts"
            raise InputError(path=where, expected=expected, got=f"from {start:g} to {stop:g}")
        told: dict[str, Any] = {"start": start, "stop": stop}
        if item.relative_to is None:
            return replace(item, **told)
        where, slack = f"{where}.relative_to", SHORTEST * self.horizon
        moved = _reference(where, item.relative_to, self.system.states)
        if moved[0, 0] > start + slack or moved[-1, 0] < stop - slack:
            expected = f"rows whose times cover the window, {start:g} to {stop:g}"
            raise InputError(path=where, expected=expected, got=f"{moved[0, 0]:g} to {moved[-1, 0]:g}")
        told["relative_to"] = moved
        return replace(item, **told)

    def _integrated(self, where: str, entry: object) -> IntegralConstraint:
        """With arrays of the right shapes, and a window in which something can be accumulated."""
        if not isinstance(entry, IntegralConstraint):
            raise InputError(path=where, expected="an IntegralConstraint", got=type(entry).__name__)
        d, m, delay = self.system.states, self.system.controls, self.system.delay
        given = [
            (name, _matrix(f"{where}.{name}", rows, f"rows of {columns} finite numbers, one per {of}", columns))
            for name, rows, columns, of in (("H", entry.H, d, "state"), ("G", entry.G, m, "control"))
            if rows is not None
        ]
        if not given or len({len(rows) for _, rows in given}) > 1:
            got = " and ".join(f"{len(rows)} in {name}" for name, rows in given) or "neither"
            raise InputError(path=where, expected="H, or G, or both with as many rows", got=got)
        count, matrices = len(given[0][1]), dict(given)
        H, G = (matrices.get(name, np.zeros((count, columns))) for name, columns in (("H", d), ("G", m)))
        if (empty := np.flatnonzero(~np.hstack([H, G]).any(axis=1))).size:
            raise InputError(path=where, expected="rows that integrate something", got=f"zeros in row {empty[0] + 1}")
        lower, upper = _limits(where, entry, count)
        start, stop = float(entry.start), self.horizon if entry.stop is None else float(entry.stop)
        if not (0.0 <= start < stop - SHORTEST * self.horizon and stop <= self.horizon):
            raise InputError(
                path=where,
                expected=f"0 <= from < to <= {self.horizon:g} (the horizon), apart by more than rounding",
                got=f"from {start:g} to {stop:g}",
            )
        if delay > 0.0 and G.any() and stop + delay > self.horizon * (1.0 + SHORTEST):
            raise InputError(
                path=f"{where}.to",
                expected=f"at most {self.horizon - delay:g}, the horizon less the delay, where G is not 0: a control"
                " that is commanded later never acts",
                got=f"{stop:g}",
            )
        return replace(entry, H=H, G=G, lower=lower, upper=upper, start=start, stop=stop)

    def _return(self) -> None:
        """Have every final state among the initial ones, where the plan repeats."""
        if not isinstance(self.repeat, bool | np.bool_):
            raise InputError(path="repeat", expected="true or false", got=f"{self.repeat!r}")
        if not self.repeat:
            return
        if isinstance(self.system, VaryingSystem):
            require_period(self.system)
        if self.system.delay > 0.0:
            raise InputError(
                path="repeat",
                expected="a control that acts at once: with system.delay the last controls of a period act in the next",
                got=f"a delay of {self.system.delay:g}",
            )
        if self.integral:
            raise InputError(
                path="integral",
                expected="none where the plan repeats, of which integrals over a period are not proven yet",
                got=f"{len(self.integral)}",
            )
        if any(entry.name == RETURN for entry in self.windows):
            raise InputError(path="repeat", expected=f"no path constraint named {RETURN}, which is that of repeat")
        self._set("repeat", Repeating.IMPOSED)
        bound, centre = returning(self.initial_set, np.asarray(self.initial_state, dtype=float))
        if bound is not None:
            moved = np.column_stack([[0.0, self.horizon], np.vstack([centre, centre])])
            ends = (self.horizon, self.horizon, RETURN, moved if centre.any() else None)
            self._set("path", (*self.path, Return(bound.scaled(1.0 - WITHIN), *ends)))
        fixed = np.where(widths(self.initial_set, self.system.states) > 0.0, np.nan, centre)
        self._set("terminal", (*self.terminal, *([] if np.isnan(fixed).all() else [Equality(fixed)])))

    def _terminal(self) -> list[ConvexSet | Equality]:
        kept: list[ConvexSet | Equality] = []
        for i, item in enumerate(_listed("terminal", self.terminal)):
            if not isinstance(item, Equality):
                end = _checked_set(f"terminal.{i}", item, self.system.states, "states")
                kept += [] if _restricts_nothing(end) else [end]
                continue
            if item.dimension != self.system.states:
                raise InputError(
                    path=f"terminal.{i}",
                    expected=f"{self.system.states} values, one per state",
                    got=f"{item.dimension}",
                )
            kept += [item] if item.fixed.size else []
        return kept


def widths(bound: ConvexSet | None, states: int) -> Array:
    """How long a set of deviations is along every axis, ``(d,)``; 0 without one."""
    if bound is None:
        return np.zeros(states)
    axes = np.eye(states)
    return np.asarray(bound.support(axes) + bound.support(-axes))


def returning(bound: ConvexSet | None, centre: Array) -> tuple[ConvexSet | None, Array]:
    """The set of initial deviations with its flat coordinates free, and its centre ``(d,)``; raises `InputError` for
    one that is flat and no box."""
    if bound is None:
        return None, centre
    free = widths(bound, centre.size) == 0.0
    if bound.is_box and free.any():
        box = bound.bounding_box()
        return Box(np.where(free, -np.inf, box.lower), np.where(free, np.inf, box.upper)), centre
    flat = bound.halfspaces()
    if flat is not None:
        room = flat[1] - flat[0] @ bound.interior_point()
        if (room <= SAME * np.abs(flat[0]).max(axis=1) * float(bound.reach(np.eye(centre.size)).max())).any():
            raise InputError(
                path="repeat",
                expected="a set of initial states with an interior, or a box",
                got=f"a {bound.kind} without one",
            )
    return bound, centre


class ProblemFactory(ABC):
    """A problem that a config can name: its options are its fields."""

    @abstractmethod
    def build(self) -> OptimalControlProblem | SemiInfiniteProgram:
        """The problem; raises `InputError` when the options do not describe one."""


def _listed(name: str, value: object, of: str = "sets") -> list[object]:
    if isinstance(value, ConvexSet | PathConstraint | MixedConstraint | IntegralConstraint | Equality):
        return [value]
    if not isinstance(value, Sequence):
        raise InputError(path=name, expected=f"a list of {of}", got=f"{type(value).__name__}")
    return list(value)


def _checked_set(name: str, value: object, dimension: int, of: str, bounded: bool = False) -> ConvexSet:
    if isinstance(value, Equality):
        raise InputError("an equality is allowed in terminal only", path=name)
    if not isinstance(value, ConvexSet):
        raise InputError(
            path=name, expected="a convex set, such as Box, Polytope or Ellipsoid", got=f"{type(value).__name__}"
        )
    if value.dimension != dimension:
        raise InputError(
            path=name,
            expected=f"a set of dimension {dimension}, the number of {of}",
            got=f"dimension {value.dimension}",
        )
    if bounded and not value.is_bounded:
        raise InputError("the set must be bounded", path=name)
    return value


def _checked_mixed(where: str, entry: MixedConstraint, system: System) -> MixedConstraint:
    """With arrays of the right shapes, and a set of ``(x, u)`` that is not empty."""
    H, G = (
        _matrix(f"{where}.{name}", rows, f"rows of {columns} finite numbers, one per {of}", columns)
        for name, rows, columns, of in (
            ("H", entry.H, system.states, "state"),
            ("G", entry.G, system.controls, "control"),
        )
    )
    if len(G) != len(H):
        raise InputError(path=f"{where}.G", expected=f"{len(H)} rows, as H has", got=f"{len(G)}")
    h = as_bound(f"{where}.h", entry.h, len(H))
    if np.isneginf(h).any():
        raise InputError(path=f"{where}.h", expected="numbers above -inf", got=f"{h.tolist()}")
    found = replace(entry, H=H, G=G, h=h)
    try:
        _ = found.set
    except InputError as error:
        raise InputError(error.sentence, path=where) from None
    return found


def _limits(where: str, entry: IntegralConstraint, count: int) -> tuple[Array, Array]:
    """The bounds ``(r,)`` of an integral, infinite where there is none."""
    sides = []
    for name, given, none in (("lower", entry.lower, -np.inf), ("upper", entry.upper, np.inf)):
        filled = [none if v is None else v for v in given] if isinstance(given, list | tuple) else given
        sides.append(as_bound(f"{where}.{name}", none if filled is None else filled, count))
    lower, upper = sides
    if not (lower <= upper).all() or np.isposinf(lower).any() or np.isneginf(upper).any():
        got = f"{lower.tolist()} and {upper.tolist()}"
        raise InputError(path=where, expected="lower bounds that are no larger than the upper ones", got=got)
    if (np.isinf(lower) & np.isinf(upper)).any():
        raise InputError(path=where, expected="a lower or an upper bound of every row", got="a row without one")
    return lower, upper


def _matrix(where: str, rows: object, expected: str, columns: int) -> Array:
    try:
        matrix = np.array(dense(rows), dtype=float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.ndim != 2 or matrix.shape[1] != columns or not matrix.size or not np.isfinite(matrix).all():
        raise InputError(path=where, expected=expected, got=f"{rows!r}")
    return matrix


def _reference(where: str, rows: object, states: int) -> Array:
    """Rows of a time and a point, ``(q, 1 + d)``."""
    moved = _matrix(where, rows, f"rows of {1 + states} finite numbers, a time and a point each", 1 + states)
    if (np.diff(moved[:, 0]) <= 0.0).any():
        raise InputError(path=where, expected="rows whose times increase", got=f"times {moved[:, 0].tolist()}")
    return moved


def _restricts_nothing(value: ConvexSet) -> bool:
    flat = value.halfspaces()
    return flat is not None and flat[1].size == 0
