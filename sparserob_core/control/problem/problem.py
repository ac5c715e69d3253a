"""Uncertain linear optimal control problems, as data."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, get_args

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.combinations import refusal, refuse_cases
from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.cost import WEIGHTS, Cost, checked_weights, counted, integrals
from sparserob_core.control.problem.delivery import Delivery
from sparserob_core.control.problem.disturbances import (
    Breakpoints,
    Classes,
    Disturbance,
    DisturbanceClass,
    join_disturbances,
    select_class,
)
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.repeat import RETURN, SET_ROUNDING, Repeating, require_return, widths
from sparserob_core.control.problem.terms.windows import (
    MixedConstraint,
    PathConstraint,
    Setting,
    Window,
    checked_set,
    restricts_nothing,
)
from sparserob_core.control.sets.integrals import can_enclose_integrals
from sparserob_core.control.sets.sets import Equality, Product
from sparserob_core.control.sets.strangers import require_consistent
from sparserob_core.control.term import (
    CONTROLS,
    KIND,
    SAME_TIME,
    STATES,
    TERMS,
    TIME,
    UNITLESS,
    Term,
    each,
    measured,
    over,
)
from sparserob_core.errors import InputError
from sparserob_core.shapes import sealed
from sparserob_core.sip.convex_set import Array, ConvexSet, as_bound

if TYPE_CHECKING:
    from sparserob_core.sip.program import SemiInfiniteProgram

SYSTEM = {
    "in_units": lambda system, units: units.of_system(system),
    "remaining": lambda system, begin, horizon: system.remaining(begin, horizon),
}

DISTURBANCE = {
    "in_units": lambda bound, units: bound.in_units(units.disturbances).in_units_of_time(units.time),
    "remaining": lambda bound, begin, horizon: bound,
}


def _shift_breakpoints(times: Array, begin: float, horizon: float) -> Array:
    """Return breakpoints from the time ``begin`` on, counted from there.

    The first interval is the rest of the interval that contains ``begin``.
    """
    later = [time - begin for time in times.tolist() if not over(time, begin, horizon)]
    return np.array([0.0, *later[:-1], horizon])


@dataclass(frozen=True, eq=False, kw_only=True)
class OptimalControlProblem(Term):
    """The problem to minimise a `Cost` under constraints that hold for every disturbance, parameter and initial state.

    Minimise ``sum_i weights_i int_0^T |u_i(t)| dt``, or another `Cost`, subject to

    * ``x' = A(p) x + B(p) u + E(p) w + c(p)`` with ``x(0)`` in ``initial_state + initial_set``
    * ``u(t)`` in ``control`` at all times
    * ``x(t)`` in every set of ``path`` during its window; a `MixedConstraint` bounds ``x(t)`` and ``u(t)`` together
    * ``x(T)`` in every set of ``terminal``, where ``T = horizon``
    * the integrals of state and control within the bounds of every `IntegralConstraint`

    The state is ``x (d,)``, the control ``u (m,)``, the disturbance ``w (mw,)``, the parameter ``p (nu,)``. Times are
    in the time unit of the system.

    Parameters
    ----------
    system : System
        The system; its last phase ends at the horizon, unless it is a `LinearSystem`, which has no end.
    horizon : float
        The positive, finite horizon ``T``.
    initial_state : array (d,)
        The centre of the initial states. An initial state outside of a path set is legal; that problem is infeasible.
    control : ConvexSet
        The bounded set of ``u(t)``.
    initial_set : ConvexSet, optional
        The bounded set of deviations from ``initial_state``, which contains 0. Without it the initial state is known.
    weights : float, array (m,) or array (r, 1 + m), optional
        Positive weights of the controls, or rows of a time and the weights from then on, which may be 0. The first time
        is 0. All weights are 1 unless given.
    disturbance : ConvexSet, optional
        The bounded set of ``w(t)``; ``None`` (the default) where there is no disturbance.
    disturbance_class : {"piecewise_constant", "measurable", "l1_ball"}, default "piecewise_constant"
        The class of the functions ``w``; see Notes.
    path : sequence of PathConstraint, MixedConstraint or ConvexSet, optional
        The constraints during windows of time. A set without a window holds at all times.
    terminal : sequence of ConvexSet or Equality, optional
        The sets of the final state, and values that are fixed.
    integral : sequence of IntegralConstraint, optional
        The bounds of integrals of state and control over windows of time.
    title : str, default ""
        The title in tables and figures.
    initial_control : array (m,), optional
        The control before time 0; ``None`` (the default) where it does not matter.
    control_step : ConvexSet, optional
        The set of every change ``u_{k+1} - u_k`` from one interval of the control's dictionary to the next. It also
        holds ``u_0 - initial_control`` where that control is given. Steps are free unless it is given.
    names : Names, optional
        The names and units for messages, tables and figures.
    cost : Cost, optional
        The cost; the weighted L1 norm of the control unless given.
    disturbances : sequence of Disturbance, optional
        A list of disturbances instead of ``disturbance``; ``w`` holds all of them, one after another.
    measurements : Measurements, optional
        The measurements of a policy that answers them. Unless given, the whole state is measured without noise and at
        once. A control that answers nothing does not depend on them.
    repeat : bool, default False
        True where the plan begins again at the horizon, for ever; see Notes.
    execution : array (m,), optional
        The relative error of execution of each control, from 0 to 1; see Notes. No errors unless given.
    jitter : float, default 0
        The time by which every change of the control may come late, less than every interval of the control's
        dictionary; see Notes.
    commanded : tuple of int, optional
        The states that are integrals of the commanded control, which no error of execution reaches. They occur in
        larger problems that are made of integrals; users do not give them.
    disturbance_breakpoints : tuple, optional
        The breakpoints of each part of a product of disturbances, made from ``disturbances``. A part has ``None`` where
        its breakpoints are those of the disturbance's dictionary; users do not give them.

    Raises
    ------
    InputError
        If a field is unsuitable, or if nothing can be proven yet of such a combination of fields.

    Notes
    -----
    Classes of disturbances. ``piecewise_constant``: the value on every interval of the disturbance's dictionary is in
    the set. ``measurable``: any measurable function with values in the set; a policy does not answer these.
    ``l1_ball``: the coefficients of channel ``i`` in the dictionary have an absolute sum of at most ``upper_i``, where
    the set is a symmetric box; these are far fewer disturbances.

    Repetition. Every final state is one of the initial states. All constraints hold from there for another period, and
    therefore for all time. The step from any last control to any first one is in ``control_step`` too. No set has to be
    invariant within a period. Whatever changes with time begins again too, with the horizon as its period. Final states
    stay inside of the set by the share `WITHIN`, so that a proof up to a tolerance holds for ever. A coordinate with a
    single initial value is fixed at the end, up to rounding.

    Errors of execution. The delivered control differs from the commanded control by at most this share of the command.
    The difference may be any function of time, and is 0 where the command is 0. Every constraint on the state holds
    nonetheless. The set of the control, the set of its steps, the cost, and the control in mixed constraints and
    integrals refer to the command.

    Jitter. From a change of the control until ``jitter`` later, each delivered control may be any function of time with
    values between the old and the new value. So every change may come late by another time, may take several steps, or
    may be gradual. The first value acts from the beginning. Every constraint on the state holds nonetheless. The set of
    the control, the set of its steps and the cost refer to the plan, and quadratic terms to its trajectory.

    Fields after construction. ``weights`` is ``(m,)``, or ``(r, 1 + m)`` where rows are given. ``path``, ``terminal``
    and ``integral`` are tuples, every window has its ``stop``, and constraints that restrict nothing are gone. For a
    problem that repeats, the `Return` is the last entry of the path, and the fixed values are the last terminal
    equality.

    Lists of disturbances. After construction ``disturbance`` is the product of their sets, and the list is empty. ``E``
    of the system has the columns of all of them, which are 0 in phases outside of a window. Where there are two
    classes, ``disturbance_class`` has the class of every part of the product. Where a disturbance has its own
    breakpoints, ``disturbance_breakpoints`` has those of every part.

    Examples
    --------
    >>> import sparserob_core as sr
    >>> problem = sr.OptimalControlProblem(
    ...     system=sr.LinearSystem([[0, 1], [0, 0]], [[0], [1]]),
    ...     horizon=4.0,
    ...     initial_state=[1, 0],
    ...     control=sr.Box([-1], [1]),
    ...     disturbance=sr.Box([-0.01, -0.01], [0.01, 0.01]),
    ...     terminal=[sr.Box([-0.2, -0.2], [0.2, 0.2])],
    ... )
    >>> problem.weights
    array([1.])
    """

    system: System = field(metadata=SYSTEM)
    horizon: float = field(metadata=TIME)
    initial_state: npt.ArrayLike = field(metadata=STATES)
    control: ConvexSet = field(metadata=CONTROLS)
    initial_set: ConvexSet | None = field(default=None, metadata=STATES)
    weights: npt.ArrayLike | None = field(default=None, metadata=WEIGHTS)
    disturbance: ConvexSet | None = field(default=None, metadata=DISTURBANCE)
    disturbance_class: Classes = field(default="piecewise_constant", metadata=UNITLESS)
    path: Sequence[PathConstraint | MixedConstraint | ConvexSet] = field(default=(), metadata=each(PathConstraint))
    terminal: Sequence[ConvexSet | Equality] = field(default=(), metadata=STATES)
    integral: Sequence[IntegralConstraint] = field(default=(), metadata=each(IntegralConstraint))
    title: str = field(default="", metadata=UNITLESS)
    initial_control: npt.ArrayLike | None = field(default=None, metadata=CONTROLS)
    control_step: ConvexSet | None = field(default=None, metadata=CONTROLS)
    names: Names = field(default=UNNAMED, metadata=UNITLESS)
    cost: Cost = field(default=Cost(), metadata=TERMS)
    disturbances: Sequence[Disturbance] = field(default=(), metadata=UNITLESS)  # empty after construction
    measurements: Measurements | None = field(default=None, metadata=TERMS)
    repeat: bool | Repeating = field(default=False, metadata=UNITLESS)
    execution: npt.ArrayLike | None = field(default=None, metadata=UNITLESS)
    jitter: float = field(default=0.0, metadata=measured(lambda of: of.time))
    commanded: tuple[int, ...] = field(default=(), metadata=UNITLESS)
    disturbance_breakpoints: Breakpoints | None = field(
        default=None, metadata=measured(lambda of: of.time, _shift_breakpoints)
    )

    __repr__ = noun

    def __post_init__(self) -> None:
        horizon = as_bound("horizon", self.horizon)
        if horizon.shape != (1,) or not 0.0 < horizon[0] < np.inf:
            raise InputError(path="horizon", expected="a positive, finite time", got=f"{self.horizon!r}")
        self._set_field("horizon", float(horizon[0]))
        self._check_system()
        self._join_disturbances()
        self._set_field("initial_state", self._check_initial_state())
        self._set_field("initial_set", self._check_initial_set())
        self._set_field("weights", checked_weights(self.weights, self.system.controls, self.horizon))
        self._set_field("initial_control", self._check_initial_control())
        self._set_field("cost", self._check_cost())
        checked_set("control", self.control, self.system.controls, "controls", bounded=True)
        if self.control_step is not None:
            step = checked_set("control_step", self.control_step, self.system.controls, "controls")
            self._set_field("control_step", None if restricts_nothing(step) else step)
        self._check_disturbance()
        bound = self.measurable
        if bound is not None and not can_enclose_integrals(bound):
            raise InputError(
                path="disturbance",
                expected="a box, polytope, ellipsoid, ball or zonotope, or another set that states its `continued`,"
                " where disturbances are measurable",
                got=bound.kind,
            )
        self._set_field("measurements", self._check_measurements())
        self._check_names()
        for attribute in fields(self):
            if KIND in attribute.metadata:
                self._set_field(
                    attribute.name, tuple(self._check_constraints(attribute.name, attribute.metadata[KIND]))
                )
        self._set_field("terminal", tuple(self._check_terminal()))
        if self.repeat is not Repeating.IMPOSED:
            self._require_return()
        self._check_uncertain()
        self._set_field("execution", self._check_execution())
        self._set_field("jitter", self._check_jitter())
        if self.delivery is not None:
            self._refuse_beside_delivery()
        sealed(self)

    @property
    def classes(self) -> frozenset[DisturbanceClass]:
        """The classes of the disturbances; an empty set where there are no disturbances."""
        if self.disturbance is None:
            return frozenset()
        kinds = self.disturbance_class
        return frozenset({kinds} if isinstance(kinds, str) else kinds)

    @property
    def measurable(self) -> ConvexSet | None:
        """The set of the measurable disturbances, 0 along the columns of others; ``None`` where there are none."""
        return select_class(self.disturbance, self.disturbance_class, "measurable")

    @property
    def lists(self) -> dict[str, tuple[Window, ...]]:
        """The constraints of the fields that are lists of terms, by the name of the field."""
        return {
            attribute.name: getattr(self, attribute.name) for attribute in fields(self) if KIND in attribute.metadata
        }

    @property
    def sums(self) -> dict[str, tuple[Window, ...]]:
        """The constraints that accumulate state and control over time, by their field, where there are any."""
        return {name: entries for name, entries in self.lists.items() if name != "path" and entries}

    def called(self, name: str) -> list[str]:
        """Return the names by which messages, tables and figures call the constraints of one list.

        A constraint without a name is called by the name of the list, with its position where the user gave several.
        """
        entries = self.lists[name]
        is_numbered = sum(entry.stated for entry in entries) > 1
        return [entry.name or (f"{name}[{i}]" if is_numbered else name) for i, entry in enumerate(entries)]

    @property
    def windows(self) -> list[PathConstraint | MixedConstraint]:
        """The constraints on the path; none of them is a bare set after construction."""
        return [entry for entry in self.path if not isinstance(entry, ConvexSet)]

    @property
    def of_states(self) -> list[PathConstraint]:
        """The constraints on the path that bound the state alone."""
        return [entry for entry in self.windows if isinstance(entry, PathConstraint)]

    @property
    def terminal_sets(self) -> list[ConvexSet]:
        """The sets of the final state, without those that fix values."""
        return [end for end in self.terminal if not isinstance(end, Equality)]

    @property
    def ends(self) -> list[ConvexSet]:
        """The sets of the final state, and after them the equalities as sets."""
        return [*self.terminal_sets, *(end.box for end in self.terminal_equalities)]

    @property
    def terminal_equalities(self) -> list[Equality]:
        """The equalities that fix values of the final state."""
        return [end for end in self.terminal if isinstance(end, Equality)]

    def _set_field(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_system(self) -> None:
        """Raise `InputError` where the system, its delay or its last phase does not fit the horizon."""
        if not isinstance(self.system, System):
            raise InputError(path="system", expected="a LinearSystem", got=f"{type(self.system).__name__}")
        if not (self.system.delay == 0.0 or SAME_TIME * self.horizon < self.system.delay < self.horizon):
            raise InputError(
                path="system.delay",
                expected=f"less than {self.horizon:g} (the horizon), or no control ever acts, and more than rounding",
                got=f"{self.system.delay:g}",
            )
        self.system.check_horizon(self.horizon)

    def _check_uncertain(self) -> None:
        """Raise `InputError` for fixed final values that a parameter changes, of a system that depends on time."""
        system = self.system
        if system.powers is not None:
            self._check_expanded()
        if system.dependence is None:
            return
        for i, end in enumerate(self.terminal):
            if not isinstance(end, Equality):
                continue
            for parameter, state in np.argwhere(system.dependence.affected).tolist():
                if state in end.fixed:
                    returns = self.repeat and widths(self.initial_set, system.states)[state] == 0.0
                    raise refusal(
                        "fixed final state",
                        "parameters and entries in t",
                        path="repeat" if returns else f"terminal.{i}",
                        got=f"{self.names.state(state)}, which {system.names[parameter]} reaches",
                    )

    def _check_expanded(self) -> None:
        """Raise `InputError` for fixed final values where the state is no affine function of the parameters."""
        is_fixed = bool(self.terminal_equalities)
        refuse_cases("fixed final state", {"general parameters and entries in t": is_fixed}, got="others")

    def _check_execution(self) -> Array | None:
        """Return the errors of execution ``(m,)``, or ``None`` where there are none."""
        if self.execution is None:
            return None
        m = self.system.controls
        shares = np.atleast_1d(as_bound("execution", self.execution))
        if shares.shape != (m,) or not ((shares >= 0.0) & (shares <= 1.0)).all():
            raise InputError(
                path="execution", expected=f"{m} numbers from 0 to 1, one per control", got=f"{shares.tolist()}"
            )
        return shares if shares.any() else None

    def _check_jitter(self) -> float:
        """Return the jitter; raise `InputError` where it is no time within the horizon."""
        jitter = as_bound("jitter", self.jitter)
        if jitter.shape != (1,) or not (jitter[0] == 0.0 or SAME_TIME * self.horizon < jitter[0] < self.horizon):
            expected = f"0, or a time below {self.horizon:g} (the horizon) and above rounding"
            raise InputError(path="jitter", expected=expected, got=f"{self.jitter!r}")
        return float(jitter[0])

    def _refuse_beside_delivery(self) -> None:
        """Raise `InputError` for combinations with errors of execution, or with changes that come late, of which
        nothing can be proven."""
        sets = [entry if isinstance(entry, ConvexSet) else entry.set for entry in (*self.path, *self.terminal_sets)]
        timed = self._find_timed_system()
        cases = {
            "fixed final state": bool(self.terminal_equalities),
            "parameters in no box": timed is None,
            "measurable in a curved set": any(bound.halfspaces() is None for bound in filter(None, [self.measurable]))
            and (bool(self.system.switches) or self.system.parameter_count > 0),
            "curved path and general parameters": timed is not None
            and timed.powers is not None
            and any(bound.halfspaces() is None for bound in sets),
        }
        beside_jitter = {
            "execution": self.execution is not None,
            "delay": self.system.delay > 0.0,
            "repeat": bool(self.repeat),
            "mixed": any(isinstance(entry, MixedConstraint) for entry in self.windows),
            "integral": any(np.any(entry.G) for entry in self.integral),
        }
        if self.jitter:
            refuse_cases("jitter", {**beside_jitter, **cases}, got=f"{self.jitter:g}")
        else:
            refuse_cases("execution", cases, got=f"{np.asarray(self.execution).tolist()}")

    @property
    def has_budget(self) -> bool:
        """True where the values of the disturbance at different times share a budget."""
        return self.disturbance is not None and not self.disturbance.is_pointwise

    @property
    def delivery(self) -> Delivery | None:
        """The way in which the delivered control may differ from the command; ``None`` where it does not."""
        if self.jitter:
            return Delivery(np.ones(self.system.controls), self.jitter)
        return None if self.execution is None else Delivery(np.asarray(self.execution))

    def _find_timed_system(self) -> System | None:
        """Return the system as one whose entries depend on the time; ``None`` where its parameters are in no box."""
        try:
            return self.system.in_time(self.horizon)
        except InputError:
            return None

    def _check_initial_state(self) -> Array:
        """Return the centre ``(d,)`` of the initial states; raise `InputError`."""
        d = self.system.states
        state = np.atleast_1d(as_bound("initial_state", self.initial_state))
        if state.size != d or not np.isfinite(state).all():
            raise InputError(
                path="initial_state", expected=f"{d} finite numbers, one per state", got=f"{state.tolist()}"
            )
        return state

    def _check_initial_set(self) -> ConvexSet | None:
        """Return the set of initial deviations, or ``None`` for 0 alone; raise `InputError` where 0 is not in it."""
        if self.initial_set is None:
            return None
        bound = checked_set("initial_set", self.initial_set, self.system.states, "states", bounded=True)
        axes = np.eye(bound.dimension)
        size = float(bound.reach(axes).max())
        if not bound.contains(np.zeros(bound.dimension), SET_ROUNDING * size):
            raise InputError(
                path="initial_set",
                expected="a set of deviations that holds 0, so that the centre is one of the initial states",
                got=f"{bound.kind} without it",
            )
        return bound if size > 0.0 else None

    def prices(self, breakpoints: Array) -> Array:
        """Return the cost ``(m, K)`` of each control per absolute value on the intervals of ``breakpoints (K + 1,)``.

        The cost is the integral of the weight, which is exact, times the factor of the L1 norm.
        """
        return float(self.cost.l1) * integrals(self.weights, breakpoints)

    @property
    def counts(self) -> Array:
        """The number ``(m,)`` by which each control counts per active time.

        It is the weight of the control, or 1 where weights change with time.
        """
        return counted(self.weights)

    @property
    def cost_unit(self) -> str:
        """The unit of the cost: the unit of the integral of a control over time.

        The text is empty where this unit is not known. It is also empty where weights or quadratic terms give the cost
        another unit, which no name states.
        """
        weights = np.asarray(self.weights)
        is_weighted = weights.ndim == 2 or bool((weights != 1.0).any())
        return "" if is_weighted or self.cost.is_quadratic else self.names.effort

    def _check_measurements(self) -> Measurements | None:
        """Return the checked measurements, or ``None`` where there are none; raise `InputError`."""
        if self.measurements is None:
            return None
        if not isinstance(self.measurements, Measurements):
            raise InputError(path="measurements", expected="Measurements", got=type(self.measurements).__name__)
        try:
            measurements = self.measurements.checked(self.system.states, self.horizon)
            require_consistent("noise", measurements.noise)
        except InputError as error:
            raise error.under("measurements") from None
        return measurements

    def _check_cost(self) -> Cost:
        """Return the checked cost; raise `InputError`."""
        if not isinstance(self.cost, Cost):
            raise InputError(path="cost", expected="a Cost", got=f"{type(self.cost).__name__}")
        try:
            return self.cost.checked(self.system.states, self.system.controls, np.asarray(self.weights))
        except InputError as error:
            raise error.under("cost") from None

    def _check_initial_control(self) -> Array | None:
        """Return the control ``(m,)`` before time 0, or ``None`` where it is not given; raise `InputError`."""
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
        """Raise `InputError` where the disturbance, its class, its breakpoints and the system do not fit."""
        kinds, bound = self.disturbance_class, self.disturbance
        if isinstance(kinds, tuple) and isinstance(bound, Product) and len(bound.parts) == len(kinds):
            is_known = set(kinds) == {"piecewise_constant", "measurable"}
        else:
            is_known = isinstance(kinds, str) and kinds in get_args(DisturbanceClass)
        if not is_known:
            raise InputError(
                path="disturbance_class",
                expected=f"one of {', '.join(get_args(DisturbanceClass))}",
                got=f"{self.disturbance_class!r}",
            )
        breakpoints, factors = self.disturbance_breakpoints, bound.parts if isinstance(bound, Product) else ()
        if breakpoints is not None and (len(breakpoints) != len(factors) or kinds != "piecewise_constant"):
            raise InputError(
                path="disturbance_breakpoints",
                expected="those of every part of a product of piecewise constant disturbances, made by disturbances",
                got=f"{len(breakpoints)} for {len(factors)} parts",
            )
        if self.disturbance is None:
            return
        checked_set("disturbance", self.disturbance, self.system.disturbances, "columns of E", bounded=True)
        if not self.disturbance.is_pointwise and kinds != "piecewise_constant":
            expected = (
                "disturbance_class piecewise_constant beside a budget; more pieces in dictionaries.disturbance come"
            )
            raise InputError(
                path="disturbance_class",
                expected=f"{expected} as close to a measurable disturbance as is wanted",
                got=f"{kinds}",
            )
        box = self.disturbance.bounding_box()
        symmetric = self.disturbance.is_box and np.array_equal(box.lower, -box.upper)
        if self.disturbance_class == "l1_ball" and not symmetric:
            raise InputError(
                "the class l1_ball needs a box that is symmetric about the origin, such as box: 0.1", path="disturbance"
            )

    def _join_disturbances(self) -> None:
        """Replace the list of disturbances by the single disturbance that holds all of them."""
        disturbances: object = self.disturbances
        if not isinstance(disturbances, Sequence) or not all(
            isinstance(disturbance, Disturbance) for disturbance in disturbances
        ):
            raise InputError(path="disturbance", expected="a list of Disturbance", got=f"{type(disturbances).__name__}")
        if not disturbances:
            return
        if self.disturbance is not None or self.disturbance_class not in ("piecewise_constant", disturbances[0].kind):
            raise InputError(
                path="disturbance_class" if self.disturbance is None else "disturbance",
                expected="none beside a list of disturbances, each of which has its own",
                got=f"{self.disturbance_class}" if self.disturbance is None else self.disturbance.kind,
            )
        system, bound, kind, breakpoints = join_disturbances(self.system, disturbances, self.horizon)
        self._set_field("system", system)
        self._set_field("disturbance", bound)
        self._set_field("disturbance_class", kind)
        self._set_field("disturbance_breakpoints", breakpoints)
        self._set_field("disturbances", ())

    def _check_names(self) -> None:
        """Raise `InputError` where the names do not fit the numbers of states, controls and disturbances."""
        if not isinstance(self.names, Names):
            raise InputError(path="names", expected="Names(states=[...], ...)", got=f"{type(self.names).__name__}")
        self.names.fitting(self.system.states, self.system.controls, self.system.disturbances)

    def _check_constraints(self, name: str, kind: type[Window]) -> Iterator[Window]:
        """Yield the checked constraints of the field ``name`` that exclude anything, as terms of one ``kind``."""
        noun = "sets" if kind is PathConstraint else kind.__name__
        setting = Setting(self.system.states, self.system.controls, self.system.delay, self.horizon)
        for i, entry in enumerate(_list_entries(name, getattr(self, name), noun)):
            constraint = kind.of(f"{name}.{i}", entry).checked(f"{name}.{i}", setting)
            if constraint.restricts:
                yield constraint

    def _require_return(self) -> None:
        """Require that every final state is one of the initial states, where the plan repeats."""
        if not isinstance(self.repeat, bool | np.bool_):
            raise InputError(path="repeat", expected="true or false", got=f"{self.repeat!r}")
        if not self.repeat:
            return
        self.system.check_period()
        if self.system.delay > 0.0:
            raise InputError(
                path="repeat",
                expected="a control that acts at once: with system.delay the last controls of a period act in the next",
                got=f"a delay of {self.system.delay:g}",
            )
        if any(entry.name == RETURN for entry in self.windows):
            raise InputError(path="repeat", expected=f"no path constraint named {RETURN}, which is that of repeat")
        self._set_field("repeat", Repeating.IMPOSED)
        path, ends = require_return(self.initial_set, np.asarray(self.initial_state, dtype=float), self.horizon)
        self._set_field("path", (*self.path, *path))
        self._set_field("terminal", (*self.terminal, *ends))

    def _check_terminal(self) -> list[ConvexSet | Equality]:
        """Return the checked sets and equalities of the final state that restrict anything; raise `InputError`."""
        kept: list[ConvexSet | Equality] = []
        for i, item in enumerate(_list_entries("terminal", self.terminal)):
            if not isinstance(item, Equality):
                end = checked_set(f"terminal.{i}", item, self.system.states, "states")
                kept += [] if restricts_nothing(end) else [end]
                continue
            if item.dimension != self.system.states:
                raise InputError(
                    path=f"terminal.{i}",
                    expected=f"{self.system.states} values, one per state",
                    got=f"{item.dimension}",
                )
            kept += [item] if item.fixed.size else []
        return kept


class ProblemFactory(ABC):
    """A problem that a config can name; its options are the fields of the class."""

    @abstractmethod
    def build(self) -> OptimalControlProblem | SemiInfiniteProgram:
        """Return the problem; raise `InputError` where the options do not describe one."""


def _list_entries(name: str, value: object, of: str = "sets") -> list[object]:
    """Return the entries of a list, or the single entry that stands instead of a list; raise `InputError`."""
    if isinstance(value, ConvexSet | Window | Equality):
        return [value]
    if not isinstance(value, Sequence):
        raise InputError(path=name, expected=f"a list of {of}", got=f"{type(value).__name__}")
    return list(value)
