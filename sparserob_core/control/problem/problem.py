"""Uncertain linear optimal control problems, as data."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, get_args

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import noun
from sparserob_core.control.policies.measurements import Measurements
from sparserob_core.control.problem.cost import WEIGHTS, Cost, checked_weights, counted, integrals
from sparserob_core.control.problem.disturbances import (
    Breakpoints,
    Classes,
    Disturbance,
    DisturbanceClass,
    apart,
    joined,
)
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.repeat import RETURN, SAME, Repeating, ending, widths
from sparserob_core.control.problem.terms.windows import (
    MixedConstraint,
    PathConstraint,
    Setting,
    Window,
    checked_set,
    restricts_nothing,
)
from sparserob_core.control.sets.integrals import enclosed
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


def _pieces(times: Array, begin: float, horizon: float) -> Array:
    """Breakpoints from ``begin`` on, with what is left of the piece that has begun."""
    later = [time - begin for time in times.tolist() if not over(time, begin, horizon)]
    return np.array([0.0, *later[:-1], horizon])


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
    cost are about the command, and what integrals say of it. ``None``: what is commanded is delivered. ``commanded``:
    states that add up what is commanded, which no error reaches; those of a larger problem, made of integrals.

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
    path: Sequence[PathConstraint | MixedConstraint | ConvexSet] = field(default=(), metadata=each(PathConstraint))
    terminal: Sequence[ConvexSet | Equality] = field(default=(), metadata=STATES)
    integral: Sequence[IntegralConstraint] = field(default=(), metadata=each(IntegralConstraint))
    title: str = field(default="", metadata=UNITLESS)
    initial_control: npt.ArrayLike | None = field(default=None, metadata=CONTROLS)
    control_step: ConvexSet | None = field(default=None, metadata=CONTROLS)
    names: Names = field(default=UNNAMED, metadata=UNITLESS)
    cost: Cost = field(default=Cost(), metadata=TERMS)
    disturbances: Sequence[Disturbance] = field(default=(), metadata=UNITLESS)  # none after construction
    measurements: Measurements | None = field(default=None, metadata=TERMS)
    repeat: bool | Repeating = field(default=False, metadata=UNITLESS)
    execution: npt.ArrayLike | None = field(default=None, metadata=UNITLESS)
    commanded: tuple[int, ...] = field(default=(), metadata=UNITLESS)
    disturbance_breakpoints: Breakpoints | None = field(default=None, metadata=measured(lambda of: of.time, _pieces))

    __repr__ = noun

    def __post_init__(self) -> None:
        horizon = as_bound("horizon", self.horizon)
        if horizon.shape != (1,) or not 0.0 < horizon[0] < np.inf:
            raise InputError(path="horizon", expected="a positive, finite time", got=f"{self.horizon!r}")
        self._set("horizon", float(horizon[0]))
        self._check_system()
        self._join_disturbances()
        self._set("initial_state", self._state())
        self._set("initial_set", self._deviations())
        self._set("weights", checked_weights(self.weights, self.system.controls, self.horizon))
        self._set("initial_control", self._control_before())
        self._set("cost", self._costs())
        checked_set("control", self.control, self.system.controls, "controls", bounded=True)
        if self.control_step is not None:
            step = checked_set("control_step", self.control_step, self.system.controls, "controls")
            self._set("control_step", None if restricts_nothing(step) else step)
        self._check_disturbance()
        bound = self.measurable
        if self.system.varies and bound is not None and not enclosed(bound):
            raise InputError(
                path="disturbance",
                expected="a box, polytope, ellipsoid, ball or zonotope where the system changes with time and"
                " disturbances are measurable",
                got=bound.kind,
            )
        self._set("measurements", self._measured())
        self._check_names()
        for one in fields(self):
            if KIND in one.metadata:
                self._set(one.name, tuple(self._constraints(one.name, one.metadata[KIND])))
        self._set("terminal", tuple(self._terminal()))
        if self.repeat is not Repeating.IMPOSED:
            self._return()
        self._check_uncertain()
        self._set("execution", self._executed())
        sealed(self)

    @property
    def classes(self) -> frozenset[DisturbanceClass]:
        """Of which classes the disturbances are; none where there are none."""
        if self.disturbance is None:
            return frozenset()
        kinds = self.disturbance_class
        return frozenset({kinds} if isinstance(kinds, str) else kinds)

    @property
    def measurable(self) -> ConvexSet | None:
        """The set of the measurable disturbances, 0 along the columns of others; ``None`` where there are none."""
        return apart(self.disturbance, self.disturbance_class, "measurable")

    @property
    def lists(self) -> dict[str, tuple[Window, ...]]:
        """The constraints that are listed, by the field that lists them."""
        return {one.name: getattr(self, one.name) for one in fields(self) if KIND in one.metadata}

    @property
    def sums(self) -> dict[str, tuple[Window, ...]]:
        """Those of them that are not on the path: they add up what state and control do."""
        return {name: entries for name, entries in self.lists.items() if name != "path" and entries}

    def called(self, name: str) -> list[str]:
        """What messages, tables and figures call the constraints of a list: by their own name, or by their place."""
        entries = self.lists[name]
        several = sum(entry.stated for entry in entries) > 1
        return [entry.name or (f"{name}[{i}]" if several else name) for i, entry in enumerate(entries)]

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
    def ends(self) -> list[ConvexSet]:
        """Those sets, and what fixes values as sets."""
        return [*self.terminal_sets, *(end.box for end in self.terminal_equalities)]

    @property
    def terminal_equalities(self) -> list[Equality]:
        """What fixes values of the final state."""
        return [end for end in self.terminal if isinstance(end, Equality)]

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_system(self) -> None:
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
        """Raise `InputError` for what is not proven of a system that changes with time and has parameters."""
        system = self.system
        if system.powers is not None:
            self._check_expanded()
        for i, end in enumerate(self.terminal):
            if not isinstance(end, Equality) or system.dependence is None:
                continue
            for parameter, state in np.argwhere(system.dependence.reached).tolist():
                if state in end.fixed:
                    returns = self.repeat and widths(self.initial_set, system.states)[state] == 0.0
                    raise InputError(
                        path="repeat" if returns else f"terminal.{i}",
                        expected="final values fixed of states that no parameter reaches, beside the time t",
                        got=f"{self.names.state(state)}, which {system.names[parameter]} reaches",
                    )

    def _check_expanded(self) -> None:
        """The same where the state is no affine function of the parameters."""
        if self.terminal_equalities:
            raise InputError(
                path="system.parameters",
                expected="none beside fixed final values and the time t, or such that the state depends on affinely: to"
                " the first power in B, E and c, and in A where they multiply what depends on none",
                got="others",
            )

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
            "parameters in another set than a box": not self._is_boxed(),
            "measurable disturbances in a curved set where the system has pieces, a delay or parameters": any(
                one.halfspaces() is None for one in filter(None, [self.measurable])
            )
            and (bool(self.system.switches) or self.system.delay > 0.0 or self.system.parameter_count > 0),
            "curved sets of states with parameters that the state does not depend on affinely": self._is_expanded()
            and any(one.halfspaces() is None for one in sets),
        }
        for beside, given in refused.items():
            if given:
                raise InputError(path="execution", expected=f"none beside {beside}", got=f"{shares.tolist()}")
        return shares

    def _is_boxed(self) -> bool:
        """Whether parameters are in a box, or there are none."""
        try:
            _ = self.system.in_time(self.horizon)
        except InputError:
            return False
        return True

    def _is_expanded(self) -> bool:
        """Whether there are such of which the state is no affine function."""
        return self._is_boxed() and self.system.in_time(self.horizon).powers is not None

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
        bound = checked_set("initial_set", self.initial_set, self.system.states, "states", bounded=True)
        axes = np.eye(bound.dimension)
        size = float(bound.reach(axes).max())
        if not bound.contains(np.zeros(bound.dimension), SAME * size):
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
            measured = self.measurements.checked(self.system.states, self.horizon)
            require_consistent("noise", measured.noise)
        except InputError as error:
            raise error.under("measurements") from None
        return measured

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
        checked_set("disturbance", self.disturbance, self.system.disturbances, "columns of E", bounded=True)
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

    def _constraints(self, name: str, kind: type[Window]) -> Iterator[Window]:
        """Those that a field lists."""
        of = "sets" if kind is PathConstraint else kind.__name__
        setting = Setting(self.system.states, self.system.controls, self.system.delay, self.horizon)
        for i, entry in enumerate(_listed(name, getattr(self, name), of)):
            found = kind.of(f"{name}.{i}", entry).checked(f"{name}.{i}", setting)
            if found.restricts:
                yield found

    def _return(self) -> None:
        """Have every final state among the initial ones, where the plan repeats."""
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
        self._set("repeat", Repeating.IMPOSED)
        path, ends = ending(self.initial_set, np.asarray(self.initial_state, dtype=float), self.horizon)
        self._set("path", (*self.path, *path))
        self._set("terminal", (*self.terminal, *ends))

    def _terminal(self) -> list[ConvexSet | Equality]:
        kept: list[ConvexSet | Equality] = []
        for i, item in enumerate(_listed("terminal", self.terminal)):
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
    """A problem that a config can name: its options are its fields."""

    @abstractmethod
    def build(self) -> OptimalControlProblem | SemiInfiniteProgram:
        """The problem; raises `InputError` when the options do not describe one."""


def _listed(name: str, value: object, of: str = "sets") -> list[object]:
    if isinstance(value, ConvexSet | Window | Equality):
        return [value]
    if not isinstance(value, Sequence):
        raise InputError(path=name, expected=f"a list of {of}", got=f"{type(value).__name__}")
    return list(value)
