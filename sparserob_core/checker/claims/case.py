"""A run as the checker sees it: the problem's records, and the certificate."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import import_module
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, final, get_args

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.claims.duality import ConstraintRow, Duality, before
from sparserob_core.checker.claims.units import WindowUnits
from sparserob_core.checker.claims.window import Beside, ConstraintWindow
from sparserob_core.checker.cost.price import Price
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.still import modes_at
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.checker.problem.integrals import RunningIntegrals, integrating, spelt
from sparserob_core.checker.problem.lasting import Lasting, on_one_grid
from sparserob_core.checker.problem.superposition import parted
from sparserob_core.checker.problem.turns import in_turns
from sparserob_core.checker.reach.adjoint import AdjointFlow, AdjointRow
from sparserob_core.checker.reach.closed_loop import middle
from sparserob_core.checker.reach.execution import FollowedExecution
from sparserob_core.checker.reach.kernels import BoundedInput, BoundedInputHere
from sparserob_core.checker.reach.measurable import Side, Together
from sparserob_core.checker.reach.missed import BoundedInputAt, BoundedInputOver
from sparserob_core.checker.reach.scene import Scene
from sparserob_core.checker.reach.states import States
from sparserob_core.checker.sets.known import known
from sparserob_core.control.policies.policy import MOST_ANSWERING, Charge, Cost, Policy, WrittenPolicy, answers_of
from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.names import unit_of_row
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.problem.terms.integral import Accumulated
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.sets.sets import Box, ConvexSet, Product, product
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb, arb_mat


RETURN, EQUALS, STEP = "return", "equals", "control_step"
STATES_KEPT = 8  # over boxes of parameters
INSIDE = 1e-8  # of the set of initial states, by which final ones are inside: ten times what counts as no violation, so
# that none is handed on from period to period


@final
@dataclass(frozen=True, eq=False)
class Case:
    """What is checked: a certificate (plain data) against a problem on its two dictionaries; what it integrates, and
    what parameters add beside the time, is made states of it here, once, for every claim; ``given`` is the problem
    before that, where there is another one. ``counts``: its cost is
    the time that the control acts, which may take the values ``letters`` only where there are any; ``policy``: the
    control answers what it measures."""

    problem: OptimalControlProblem
    control: Dictionary
    disturbance: Dictionary
    certificate: Mapping[str, Any]
    clock: Clock = field(default_factory=Clock)
    counts: bool = False
    letters: tuple[float, ...] | None = None
    policy: Policy | None = None
    given: OptimalControlProblem | None = None

    def __post_init__(self) -> None:
        if self.given is None:
            object.__setattr__(self, "given", self.problem)
            object.__setattr__(self, "problem", self._returning(self.problem))
        plain = in_turns(spelt(self.problem))
        known = parted(plain)
        uncertain = isinstance(known.system, VaryingSystem) and known.system.parameters is not None
        if (known is not plain or uncertain) and self.policy is not None:
            raise Unchecked("the checker knows no feedback beside parameters and the time")
        object.__setattr__(self, "problem", in_turns(integrating(known)))
        if self.problem.disturbance_breakpoints is not None:
            known_by, joint = on_one_grid(self.problem, self.disturbance)
            object.__setattr__(self, "problem", known_by)
            object.__setattr__(self, "disturbance", joint)
        if self.policy is not None and self.control.functions == self.control.pieces:
            # as many functions as pieces, which are independent, make all controls on these: what is written are values
            object.__setattr__(self, "control", Dictionary.indicators(self.control.breakpoints))

    @property
    def stated(self) -> OptimalControlProblem:
        """The problem as it was given, whose states come first."""
        return self.problem if self.given is None else self.given

    @cached_property
    def of_control(self) -> str:
        """What the control's own set is called: ``rate`` where a constraint on the path is called ``control``."""
        return "rate" if any(window.name == "control" for window in self.windows) else "control"

    @cached_property
    def answers(self) -> np.ndarray:
        """Truth values ``(K, K)``: whether the control on a piece may answer what is measured at a breakpoint."""
        return answers_of(self.policy, self.control.breakpoints, self.problem.measurements)

    @property
    def unloaded(self) -> bool:
        """Whether the policy is what the certificate says of it, since its component is not at hand."""
        return isinstance(self.policy, WrittenPolicy)

    @property
    def answering(self) -> bool:
        """Whether the control answers what it measures."""
        return self.policy is not None

    @property
    def charge(self) -> Cost:
        """Which cost the policy is charged; that of the nominal control where there is none."""
        return "nominal" if self.policy is None else self.policy.charge.cost

    @cached_property
    def windows(self) -> list[ConstraintWindow]:
        """The state constraints, under the names that the certificate uses."""
        path = [entry for entry in self.problem.windows if not isinstance(entry, Return)]
        d, own = self.problem.system.states, sum(not isinstance(entry, Accumulated) for entry in path)
        ends = self.problem.terminal_sets
        found = [
            ConstraintWindow(
                entry.name or (f"path[{i}]" if own > 1 else "path"),
                entry.set,
                entry.start,
                self.problem.horizon if entry.stop is None else entry.stop,
                d,
                None if entry.relative_to is None else np.asarray(entry.relative_to),
            )
            for i, entry in enumerate(path)
        ]
        found += self.returned
        return found + [
            ConstraintWindow(
                f"terminal[{i}]" if len(ends) > 1 else "terminal", end, self.problem.horizon, self.problem.horizon, d
            )
            for i, end in enumerate(ends)
        ]

    def _returning(self, problem: OptimalControlProblem) -> OptimalControlProblem:
        """The problem with, of a plan that repeats, one constraint more: that every final state is one of the initial
        states, and inside their set by more than what counts as no violation; none where there is but one of each
        coordinate. Derived from the initial states alone, whatever the problem's records say of it."""
        bound, end, path = problem.initial_set, problem.horizon, problem.windows
        path = [entry for entry in path if not isinstance(entry, Return)]
        if not problem.repeat or bound is None or len(self.single) == problem.system.states:
            return replace(problem, path=path) if len(path) < len(problem.path) else problem
        free = np.isin(np.arange(bound.dimension), self.single)
        if free.any():
            if not isinstance(bound, Box):
                raise Unchecked("of a flat set of initial states, the checker knows boxes only")
            bound = Box(np.where(free, -np.inf, bound.lower), np.where(free, np.inf, bound.upper))
        centre = np.asarray(problem.initial_state, dtype=float)
        moved = np.column_stack([[0.0, end], np.vstack([centre, centre])]) if centre.any() else None
        back = Return(bound.scaled(1.0 - INSIDE), end, end, RETURN, moved)
        return replace(problem, path=[*path, back])

    @cached_property
    def returned(self) -> list[ConstraintWindow]:
        """Of a plan that repeats, that every final state is one of the initial states, where there is more than one of
        a coordinate; for every corner of parameters beside the time where these states are in a curved set."""
        return [
            ConstraintWindow(
                entry.name or RETURN,
                entry.set,
                entry.start,
                self.problem.horizon if entry.stop is None else entry.stop,
                entry.set.dimension,
                None if entry.relative_to is None else np.asarray(entry.relative_to),
            )
            for entry in self.problem.windows
            if isinstance(entry, Return)
        ]

    @cached_property
    def single(self) -> list[int]:
        """The coordinates of the stated state in which all initial ones are alike."""
        bound, d = self.stated.initial_set, self.stated.system.states
        if bound is None:
            return list(range(d))
        axes = np.eye(d).tolist()
        both = ((known(bound).support(balls(c)), known(bound).support(balls([-v for v in c]))) for c in axes)
        return [i for i, (up, down) in enumerate(both) if (up + down).is_zero()]

    @property
    def equalities(self) -> list[tuple[int, float]]:
        """The states that are fixed at the end, and at what."""
        return [(int(i), float(end.values[i])) for end in self.problem.terminal_equalities for i in end.fixed]

    def window(self, name: str) -> ConstraintWindow:
        """The constraint of that name."""
        found = [window for window in self.windows if window.name == name]
        if not found:
            raise Broken(f"the problem has no constraint {name!r}")
        return found[0]

    @property
    def measurable(self) -> bool:
        """Whether there are measurable disturbances."""
        return self.problem.measurable is not None

    @cached_property
    def lasting(self) -> Lasting | None:
        """Which components of the disturbance stay what they are for several of its pieces, ``None`` where none do."""
        return Lasting.of(self.problem, self.changes or [])

    @property
    def alike(self) -> bool:
        """Whether all disturbances are of one class, and constant on the same pieces where they are on pieces."""
        return not self.several and self.lasting is None

    def may_jump(self, time: float) -> np.ndarray:
        """Which components of the disturbance ``(mw,)`` may have another value from a time on, of those that are
        constant on pieces."""
        assert self.problem.disturbance is not None
        if self.lasting is not None:
            return self.lasting.may_jump(time)
        return np.full(self.problem.disturbance.dimension, time in (self.changes or ()))

    @property
    def several(self) -> bool:
        """Whether there are others beside them, which are constant on pieces."""
        return not isinstance(self.problem.disturbance_class, str)

    @cached_property
    def changes(self) -> list[float] | None:
        """Where the disturbance may jump; ``None`` when there is none. Other classes than piecewise constant ones are
        not checked; of measurable ones, where those jump by which rows are measured."""
        if self.problem.disturbance is None:
            return None
        if self.measurable and not self.several:
            return self.grid[:-1]
        jumps = np.flatnonzero(self.disturbance.changes) + 1
        if not self.several and self.problem.disturbance_class != "piecewise_constant":
            raise Unchecked(
                "the checker knows piecewise constant and measurable disturbances, not those of the class"
                f" {self.problem.disturbance_class}"
            )
        if self.disturbance.functions != jumps.size + 1:
            raise Unchecked(
                "the checker knows disturbances that take any value on each piece, this dictionary has fewer functions"
                " than pieces"
            )
        return [0.0, *(float(self.disturbance.breakpoints[j]) for j in jumps)]

    @property
    def until(self) -> float:
        """The last time that anything is said of."""
        return max(float(self.control.breakpoints[-1]), float(self.disturbance.breakpoints[-1]), self.problem.horizon)

    @cached_property
    def grid(self) -> list[float]:
        """Every breakpoint of either dictionary, those of the control as late as it acts."""
        self.clock.check()
        ends, last = (self.control.breakpoints[-1], self.disturbance.breakpoints[-1]), self.until
        measured = self.control.breakpoints.tolist() if self.answering else []
        every = np.unique(
            [*self.acting, *measured, *self.disturbance.breakpoints.tolist(), *self.problem.system.switches]
        )
        return [*every[(every < last) & ~np.isin(every, ends)].tolist(), last]

    def piece_at(self, time: float) -> int:
        """The piece of the `grid` that holds a time from 0 on; the last one holds the end too."""
        return min(bisect_right(self.grid, time) - 1, len(self.grid) - 2)

    @cached_property
    def flows(self) -> VerifiedFlows:
        """The flows of the system, over boxes of its parameters and at single ones."""
        return VerifiedFlows.of(self.problem.system, self.until)

    @cached_property
    def marks(self) -> list[float]:
        """The times from each of which to the next the state is a polynomial of the time."""
        return self.flows.marks(self.grid)

    def states(self, box: ParameterBox) -> States:
        """The states that are reached over a box of parameters, or over a larger one."""
        flow = self.flows.holding(box)
        if flow not in self._states:
            if len(self._states) >= STATES_KEPT:
                self._states.pop(next(iter(self._states)))
            self._states[flow] = States(flow, self.scene)
        return self._states[flow]

    @cached_property
    def _states(self) -> dict[VerifiedFlow, States]:
        return {}

    @property
    def nominal_parameter(self) -> list[float]:
        """The parameter at which the cost is counted."""
        bound = self.problem.system.parameters
        return [] if bound is None else nominal_point(bound).tolist()

    @cached_property
    def acting(self) -> list[float]:
        """When every piece of the control begins to act; from 0 on."""
        later: list[float] = np.unique([0.0, *(self.control.breakpoints[:-1] + self.problem.system.delay)]).tolist()
        return later

    @cached_property
    def theta(self) -> Array:
        """The coefficients ``(m, N)`` of the decision."""
        theta = numbers(self.certificate.get("decision"), "decision")
        if theta.shape != (self.problem.system.controls, self.control.functions):
            raise Broken(
                f"the decision has shape {theta.shape}, expected"
                f" {(self.problem.system.controls, self.control.functions)}"
            )
        return theta

    @cached_property
    def pieces(self) -> list[arb_mat]:
        """The control ``(m, 1)`` on every piece of its dictionary."""
        return self.on_pieces(self.theta)

    def on_pieces(self, coefficients: Array) -> list[arb_mat]:
        """A control ``(m, 1)`` on every piece of its dictionary, from coefficients ``(m, N)``; equal ones are one
        object."""
        from flint import arb, arb_mat

        if self.control.is_indicators:
            values, alike = coefficients.T.tolist(), dict[tuple[float, ...], arb_mat]()
            for value in self.clock.each(map(tuple, values)):
                if value not in alike:
                    alike[value] = stacked([[arb(v)] for v in value])
            return [alike[tuple(value)] for value in values]
        columns, none = self.control.sparse.tocsc(), arb(0)
        found, made = [], dict[bytes, arb_mat]()
        for start, stop in self.clock.each(pairwise(columns.indptr.tolist())):
            which, values = columns.indices[start:stop], columns.data[start:stop]
            key = coefficients[:, which].tobytes() + values.tobytes()
            if key not in made:
                terms = list(zip(which.tolist(), values.tolist(), strict=True))
                rows = [sum((arb(float(row[i])) * arb(v) for i, v in terms), none) for row in coefficients]
                made[key] = stacked([[x] for x in rows])
            found.append(made[key])
        return found

    @cached_property
    def scene(self) -> Scene:
        """The control and the disturbance on the common grid."""
        middles = [(a + b) / 2 for a, b in zip(self.grid[:-1], self.grid[1:], strict=True)]
        which = np.clip(np.searchsorted(self.acting, middles, side="right") - 1, 0, len(self.acting) - 1)
        changes, constants = self.changes, 0 if self.problem.system.c is None else 1
        known = [stacked([[v] for v in balls([*before(self.problem)])])] if self.problem.system.delay > 0.0 else []
        inputs = [*known, *self.pieces]
        if constants:
            inputs = [stacked([[v] for v in (*u.entries(), *balls([1.0]))]) for u in self.clock.each(inputs)]
        return Scene(
            self.grid,
            [inputs[k] for k in which],
            [float(v) for v in np.asarray(self.problem.initial_state)],
            None if changes is None else self.held,
            changes or [],
            self.problem.initial_set,
            self.lasting,
        )

    def beside(
        self, window: ConstraintWindow, basis: Array, gains: Array, parameter: Sequence[float] | None = None
    ) -> Beside | None:
        """What stands beside the state in the rows of a constraint, at one parameter where it is given; ``None``:
        nothing."""
        executed, strayed = self.execution, self.strayed
        if parameter is not None:
            executed, strayed = self.delivered_at(parameter), self.strayed_at(parameter)
        delivered = tuple(one for one in (executed, strayed) if one is not None)
        if window.reference is None and not window.is_mixed and not delivered:
            return None
        ends = self.control.breakpoints.tolist()
        return Beside(window, basis, gains, self.scene, ends, self.pieces, delivered)

    @cached_property
    def middle(self) -> Array:
        """The middle of the set of the disturbances, ``(mw,)``; 0 where there are none."""
        bound = self.problem.disturbance
        return np.zeros(self.problem.system.disturbances) if bound is None else _middle(bound)

    @cached_property
    def held(self) -> ConvexSet | None:
        """The set of the disturbances of which every one stays the same between `changes`: where nothing answers
        them, measurable ones are in the middle of their set, and `strayed` says how far they may be from that."""
        bound, classes = self.problem.disturbance, self.problem.disturbance_class
        if self.answering or not self.measurable or bound is None:
            return bound
        parts, kinds = ((bound,), (classes,)) if isinstance(classes, str) else (self._parts(bound), classes)
        middles = [
            one if kind != "measurable" else Box(*2 * (_middle(one),)) for one, kind in zip(parts, kinds, strict=True)
        ]
        found = product(middles)
        return None if isinstance(classes, str) and not _middle(found).any() else found

    @staticmethod
    def _parts(bound: ConvexSet) -> Sequence[ConvexSet]:
        if not isinstance(bound, Product):
            raise Unchecked("of disturbances of several classes, the checker knows lists of sets only")
        return bound.parts

    @cached_property
    def strayed(self) -> BoundedInput | None:
        """What measurable disturbances do beside the middle of their box, where nothing answers them: a command
        of 1 through the columns of ``E`` that is missed by half the widths; of a polytope all of it at once, counted
        from its middle. ``None`` where there are none."""
        bound = self.problem.measurable
        if bound is None or self.answering:
            return None
        ends, system = np.array([0.0, self.grid[-1]]), self.problem.system
        first = system.controls + (system.c is not None)
        if not bound.is_box:
            side = Together(Side.of(bound))
            return self._missing(np.ones(1), ends, [stacked([balls([1.0])])], first, side=side)
        box, about = bound.bounding_box(), _middle(bound)
        sides, single = np.stack([box.upper - about, about - box.lower]), box.upper == box.lower
        most = np.where(single, 0.0, np.nextafter(sides.max(axis=0), np.inf))
        least = np.where(single, 0.0, np.maximum(np.nextafter(sides.min(axis=0), -np.inf), 0.0))
        half = least + (most - least) / 2.0
        off = np.nextafter(np.maximum(most - half, half - least), np.inf)
        return self._missing(half, ends, [stacked([[v] for v in balls([1.0] * half.size)])], first, off)

    def _missing(self, *errors: Any, **more: Any) -> BoundedInput:
        """What is missed at every parameter of the system."""
        if self.flows.box.middle:
            return BoundedInputOver(self.flows, *errors, **more)
        return BoundedInputAt(self.flows.at(()), *errors, **more)

    def strayed_at(self, parameter: Sequence[float]) -> BoundedInputHere | None:
        """`strayed` at one parameter."""
        return None if self.strayed is None else self.strayed.at(parameter)

    @cached_property
    def execution(self) -> BoundedInput | None:
        """How exactly the control is delivered, ``None`` where that is as it is commanded; of no control where the
        certificate has none."""
        shares = self.problem.execution
        if shares is None:
            return None
        system, shares = self.problem.system, np.asarray(shares, dtype=float)
        if self.answering:
            raise Unchecked("the checker knows errors of execution without feedback")
        pieces = [] if self.certificate.get("decision") is None else self.pieces
        if self.still is not None:
            return FollowedExecution(self.problem, shares, self.control.breakpoints, pieces, self.clock)
        acts = self.control.breakpoints
        if system.delay > 0.0:  # what was commanded before is the first piece, and the last ones act too late
            begins = acts[:-1] + system.delay
            acts = np.array([0.0, *begins[begins < self.problem.horizon], self.problem.horizon])
            pieces = [stacked([[v] for v in balls(before(self.problem))]), *pieces][: acts.size - 1 if pieces else 0]
        return self._missing(shares, acts, pieces, numb=self.problem.commanded)

    def delivered_at(self, parameter: Sequence[float]) -> BoundedInputHere | None:
        """`execution` at one parameter."""
        return None if self.execution is None else self.execution.at(parameter)

    def erring(self, c: Array, time: float, parameter: Sequence[float]) -> tuple[Array | None, arb]:
        """What errors of execution add to ``c'x(t)`` at least, at a parameter: of a command of size 1 on every piece,
        ``(K, m)``, ``None`` where there are none; and of what was commanded before."""
        from flint import arb

        delivered = self.delivered_at(parameter)
        found, none = None if delivered is None else delivered.least(c, time), arb(0)
        if found is None or not self.problem.system.delay > 0.0:
            return found, none
        sizes = np.zeros((self.control.pieces, found.shape[1]))
        sizes[: len(found) - 1] = found[1:]
        known = zip(balls(found[0]), balls(before(self.problem)), strict=True)
        return sizes, sum((size * abs(u) for size, u in known), none)

    def at(self, time: float) -> str:
        """A time in words."""
        return f"t = {time:.6g} {self.problem.names.time}".rstrip()

    def measured(self, name: str, direction: Array) -> str:
        """The unit of a row of a constraint with its normal, with a space before it; of a curved set none."""
        held = {self.of_control: self.problem.control, STEP: self.problem.control_step}
        shape = held[name] if name in held else None if name == EQUALS else self.window(name).shape
        if shape is not None and shape.halfspaces() is None:
            return ""
        return unit_of_row(direction, self.problem.names, 0 if name in held else self.problem.system.states)

    def units(self, window: ConstraintWindow) -> WindowUnits:
        """What violations of a constraint are judged by."""
        if window not in self._units:
            self._units[window] = WindowUnits(
                self.problem,
                self.flows,
                self.scene,
                window.shape,
                window.start,
                window.stop,
                window.reference,
                self._acting,
                self.nominal_sizes,
            )
        return self._units[window]

    def nominal_sizes(self, rows: Array, gains: Array) -> Array:
        """Return the largest ``|c'x + g'u|`` along the nominal trajectory of the decision, ``(k,)``: 0 without one.

        They are seen where every piece of the control begins to act, of ``rows (k, d)`` and ``gains (k, m)``, and never
        too large. Under feedback, rows of the state alone count what deviations do too.
        """
        if self.certificate.get("decision") is None:
            return np.zeros(len(rows))
        if self.answering and not gains.any():
            answers = import_module("sparserob_core.checker.claims.answers")  # which is about a case
            return np.asarray(answers.answers_of(self).sizes(rows))
        d = self.problem.system.states
        z = np.array([[(float(x), float(x.rad())) for x in one.entries()] for one in self.nominal_states])
        seen = np.delete(z, d, axis=1)  # without the 1
        both = np.zeros((len(rows), seen.shape[1]))
        both[:, :d], both[:, d : d + gains.shape[1]] = rows, gains
        sizes = np.abs(both @ seen[:, :, 0].T) - np.abs(both) @ seen[:, :, 1].T
        return np.asarray(np.where(np.isfinite(sizes), np.maximum(sizes, 0.0), 0.0).max(axis=1, initial=0.0))

    @cached_property
    def nominal_states(self) -> list[arb_mat]:
        """The nominal ``(x, 1, u)`` of the decision where every piece begins to act, and at the end."""
        return self.price.nominal_states(self.pieces)

    @property
    def _acting(self) -> Array | None:
        """How far each channel of the decision goes, ``(m,)``; not told of a policy, or where there is no decision."""
        if self.answering or self.certificate.get("decision") is None:
            return None
        return np.asarray(np.abs(self.control.control(self.theta)).max(axis=1))

    @cached_property
    def _units(self) -> dict[ConstraintWindow, WindowUnits]:
        return {}

    @cached_property
    def price(self) -> Price:
        return Price(self.problem, self.control, self.flows.at(self.nominal_parameter), self.clock)

    @cached_property
    def running(self) -> RunningIntegrals | None:
        """What is integrated, where nothing else changes with time."""
        system = self.problem.system
        if not isinstance(system, SwitchedSystem):
            return None
        found, d = RunningIntegrals.of(spelt(self.stated)), self.stated.system.states
        return found if found is not None and all(found.is_beside(mode, d) for mode in system.modes) else None

    @property
    def still(self) -> LinearSystem | None:
        """The one system that acts all along, beside what is integrated of it; ``None`` where others do."""
        if self.running is not None:
            return self.running.system
        return self.problem.system if isinstance(self.problem.system, LinearSystem) else None

    @cached_property
    def motion(self) -> AdjointFlow:
        """What rows of a known system have in common, the inputs of the control before those of the disturbance."""
        assert self.still is not None
        (parts,) = modes_at(self.still, [])
        A, B, E = (parts[name] for name in ("A", "B", "E"))
        if self.problem.disturbance is not None:
            B = stacked([[*b, *e] for b, e in zip(B.tolist(), E.tolist(), strict=True)])
        return AdjointFlow.of(A, B, self.grid[-1], self.clock)

    @cached_property
    def adjoints(self) -> dict[bytes, AdjointRow]:
        """Rows that were followed before."""
        return {}

    @cached_property
    def rows(self) -> dict[tuple[object, ...], ConstraintRow]:
        """Constraints that were derived before."""
        return {}

    @cached_property
    def duality(self) -> Duality:
        return Duality(self.problem, self.control, self.changes, self.flows, self.held, self.lasting)


def _middle(bound: ConvexSet) -> Array:
    if not bound.is_box:
        return middle(bound)
    box = bound.bounding_box()
    return np.asarray((box.lower + box.upper) / 2)


def numbers(data: object, name: str) -> Array:
    """Finite numbers from the certificate; raises `Broken` where they are none."""
    if not _numeric(data):
        raise Broken(f"{name}: expected numbers")
    try:
        array = np.array(data, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise Broken(f"{name}: expected numbers") from error
    if not np.isfinite(array).all():
        raise Broken(f"{name}: expected finite numbers")
    return array


def _numeric(data: object) -> bool:
    """Whether that is a number, or lists of them: text and truth values are none."""
    level: list[object] = [data]
    while level:
        kinds = set(map(type, level))
        if not all(issubclass(kind, int | float | list) and kind is not bool for kind in kinds):
            return False
        level = list(chain.from_iterable(value for value in level if isinstance(value, list)))
    return True


def written_policy(certificate: Mapping[str, Any], pieces: int) -> WrittenPolicy:
    """What a certificate says of its policy: the cost that it is charged, and the ranges of breakpoints that each of
    the ``pieces`` answers; raises `Broken` where that is no such thing."""
    data = certificate.get("policy")
    if not isinstance(data, Mapping):
        raise Broken("policy: expected a cost, and the breakpoints that every piece answers")
    rows, said_of_cost = listed(data, "answers"), data.get("cost")
    cost: Cost | None = next((one for one in get_args(Cost) if one == said_of_cost), None)
    if cost is None:
        raise Broken(f"policy: the cost is {said_of_cost!r}, expected one of {', '.join(get_args(Cost))}")
    if len(rows) != pieces:
        raise Broken(f"policy: answers of {len(rows)} pieces, expected {pieces}")
    if pieces > MOST_ANSWERING:
        raise Broken(f"policy: {pieces} pieces that answer, expected at most {MOST_ANSWERING}")
    mask = np.zeros((pieces, pieces), dtype=bool)
    for k, ranges in enumerate(rows):
        for said in ranges if isinstance(ranges, list) else [ranges]:
            whole = isinstance(said, list) and len(said) == 2 and all(type(place) is int for place in said)
            if not whole or not 0 <= said[0] <= said[1] <= k:
                raise Broken(f"policy: piece {k + 1} answers the breakpoints {said!r}, expected a range up to {k}")
            mask[k, said[0] : said[1] + 1] = True
    return WrittenPolicy(mask, Charge(cost))


def number(data: Mapping[str, Any], name: str) -> float:
    """One finite number of the certificate."""
    value = numbers(data.get(name), name)
    if value.shape != ():
        raise Broken(f"{name}: expected a number")
    return float(value)


def listed(data: Mapping[str, Any], name: str) -> Sequence[Any]:
    """One list of the certificate."""
    value = data.get(name)
    if not isinstance(value, list):
        raise Broken(f"{name}: expected a list")
    return value
