"""A run as the checker sees it: the records of the problem, and the certificate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, pairwise
from typing import TYPE_CHECKING, Any, final, get_args

import numpy as np
from flint import arb, arb_mat, ctx

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.series import stacked
from sparserob_core.checker.claims.window import AddedTerms, ConstraintWindow
from sparserob_core.checker.cost.duality import Duality
from sparserob_core.checker.cost.price import Price
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.segment import SHARP
from sparserob_core.checker.outcome import Broken, Clock, Unchecked
from sparserob_core.checker.problem.disturbances import Disturbances
from sparserob_core.checker.problem.held import on_one_grid
from sparserob_core.checker.problem.integrals import integrating, spelt
from sparserob_core.checker.problem.returning import RETURN, returning
from sparserob_core.checker.problem.superposition import parted
from sparserob_core.checker.problem.time_varying import make_time_varying
from sparserob_core.checker.problem.timing import Timing, before, join_breakpoints
from sparserob_core.checker.reach.followed import FollowedRows
from sparserob_core.checker.reach.inner_loop import NoInnerLoop, VerifiedInnerLoop, lost_digits
from sparserob_core.checker.reach.sources import Sources
from sparserob_core.checker.reach.states import Scene, StatesOverBoxes
from sparserob_core.checker.sets.known import middle
from sparserob_core.control.policies.policy import MAX_ANSWERING, Charge, Cost, Policy, WrittenPolicy, answers_of
from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.integral import Accumulated
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.problem.terms.windows import MixedConstraint, PathConstraint


EQUALS, STEP = "equals", "control_step"


@final
@dataclass(frozen=True, eq=False)
class Case:
    """A certificate, as plain data, and the problem that it is checked against, on the problem's two dictionaries.

    ``given`` is the problem as it was given. In ``problem`` its integrals are made states, once for every claim. So are
    the parameters of a system that changes with time, where the state is an affine function of them. ``counts`` says
    that the cost is the time that the control acts. The control may then take the values ``letters`` only, where there
    are any. With a ``policy`` the control answers what it measures. ``clock`` says when to stop."""

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
            object.__setattr__(self, "problem", returning(self.problem))
        plain = make_time_varying(spelt(self.problem))
        expanded = parted(plain)
        is_uncertain = expanded.system.varies and expanded.system.parameters is not None
        if (expanded is not plain or is_uncertain) and self.policy is not None:
            raise Unchecked("the checker knows no feedback beside parameters and the time")
        object.__setattr__(self, "problem", make_time_varying(integrating(expanded)))
        if self.problem.disturbance_breakpoints is not None:
            problem, dictionary = on_one_grid(self.problem, self.disturbance)
            object.__setattr__(self, "problem", problem)
            object.__setattr__(self, "disturbance", dictionary)
        if self.policy is not None:
            times = np.union1d(self.control.breakpoints, self.control.breakpoints + self.problem.system.delay)
            breakpoints = join_breakpoints(self.disturbance.breakpoints, times)
            object.__setattr__(self, "disturbance", self.disturbance.on(breakpoints))
        if self.policy is not None and self.control.functions == self.control.pieces:
            # as many independent functions as pieces make every control on these; the certificate writes its values
            object.__setattr__(self, "control", Dictionary.indicators(self.control.breakpoints))

    @property
    def original_problem(self) -> OptimalControlProblem:
        """The problem as it was given, whose states come first."""
        return self.problem if self.given is None else self.given

    @cached_property
    def of_control(self) -> str:
        """The name of the control's own set: ``rate`` where a constraint on the path is called ``control``."""
        return "rate" if any(window.name == "control" for window in self.windows) else "control"

    @cached_property
    def answers(self) -> np.ndarray:
        """Truth values ``(K, K)``: whether the control on a piece may answer what is measured at a breakpoint."""
        return answers_of(self.policy, self.control.breakpoints, self.problem.measurements)

    @property
    def answering(self) -> bool:
        """True where the control answers what it measures."""
        return self.policy is not None

    @property
    def charge(self) -> Cost:
        """The kind of cost that the policy is charged; ``nominal``, that of the nominal control, without a policy."""
        return "nominal" if self.policy is None else self.policy.charge.cost

    @cached_property
    def windows(self) -> list[ConstraintWindow]:
        """The state constraints, under the names that the certificate uses."""
        path = [entry for entry in self.problem.windows if not isinstance(entry, Return)]
        d, path_count = self.problem.system.states, sum(not isinstance(entry, Accumulated) for entry in path)
        terminal_sets, horizon = self.problem.terminal_sets, self.problem.horizon
        path_windows = [
            _make_window(self.problem, entry, f"path[{i}]" if path_count > 1 else "path")
            for i, entry in enumerate(path)
        ]
        names = [f"terminal[{i}]" if len(terminal_sets) > 1 else "terminal" for i in range(len(terminal_sets))]
        terminal_windows = [
            ConstraintWindow(name, end, horizon, horizon, d) for name, end in zip(names, terminal_sets, strict=True)
        ]
        return [*path_windows, *self.returned, *terminal_windows]

    @cached_property
    def returned(self) -> list[ConstraintWindow]:
        """The constraints that every final state of a plan that repeats is one of the initial states; none where that
        is one point, and of a curved set one for every corner of the parameters that were made states."""
        return [
            _make_window(self.problem, entry, RETURN) for entry in self.problem.windows if isinstance(entry, Return)
        ]

    @property
    def equalities(self) -> list[tuple[int, float]]:
        """The states that are fixed at the end, each with its value."""
        return [(int(i), float(end.values[i])) for end in self.problem.terminal_equalities for i in end.fixed]

    def window(self, name: str) -> ConstraintWindow:
        """Return the constraint of that name; raise `Broken` where there is none."""
        windows = [window for window in self.windows if window.name == name]
        if not windows:
            raise Broken(f"the problem has no constraint {name!r}")
        return windows[0]

    @property
    def measurable(self) -> bool:
        """True where there are measurable disturbances."""
        return self.problem.measurable is not None

    @cached_property
    def timing(self) -> Timing:
        """The times at which an input may begin to act."""
        breakpoints = self.control.breakpoints, self.disturbance.breakpoints
        return Timing(self.problem, *breakpoints, self.answering, self.clock)

    @cached_property
    def disturbances(self) -> Disturbances:
        """The disturbances on the pieces of their dictionary."""
        return Disturbances(self.problem, self.disturbance, self.timing)

    @cached_property
    def followed(self) -> FollowedRows:
        """The rows that are followed by their adjoints."""
        return FollowedRows(self.problem, self.timing, self.disturbances)

    @cached_property
    def sources(self) -> Sources:
        """The inputs that act at any time and of which only the size is known."""
        pieces = lambda: [] if self.certificate.get("decision") is None else self.pieces  # noqa: E731
        return Sources(self.problem, self.timing, self.flows, pieces, self.followed)

    @cached_property
    def flows(self) -> VerifiedFlows:
        """The flows of the system, over boxes of its parameters and at single parameters."""
        return VerifiedFlows.of(self.problem.system, self.timing.until, 2.0**-ctx.prec if lost_by(self) else SHARP)

    @cached_property
    def states(self) -> StatesOverBoxes:
        """The states that are reached over boxes of parameters."""
        return StatesOverBoxes(self.flows, self.scene)

    @cached_property
    def theta(self) -> Array:
        """The coefficients ``(m, N)`` of the decision."""
        return shaped(self.certificate, "decision", (self.problem.system.controls, self.control.functions))

    @cached_property
    def pieces(self) -> list[arb_mat]:
        """The control ``(m, 1)`` on every piece of its dictionary; under feedback the nominal one."""
        return self.inner.nominal(self.on_pieces(self.theta))

    @cached_property
    def inner(self) -> VerifiedInnerLoop | NoInnerLoop:
        """The inner loop of the policy."""
        gains, problem = _read_inner_gains(self), self.problem
        if not gains.size:
            return NoInnerLoop()
        start = balls(np.asarray(problem.initial_state))
        if problem.initial_set is not None:
            start = [a + b for a, b in zip(start, balls(middle(problem.initial_set)), strict=True)]
        disturbance = np.zeros(problem.system.disturbances)
        if problem.disturbance is not None:
            disturbance = middle(problem.disturbance)
        grid = sorted({*self.timing.grid, *(self.disturbances.changes or [])})
        breakpoints = self.control.breakpoints.tolist()
        return VerifiedInnerLoop(self.flows.at(()), breakpoints, grid, gains, start, disturbance)

    def on_pieces(self, coefficients: Array) -> list[arb_mat]:
        """Return the control ``(m, 1)`` on every piece of its dictionary, from its coefficients ``(m, N)``. Equal
        values are one object."""
        if self.control.is_indicators:
            values, pieces_by_value = coefficients.T.tolist(), dict[tuple[float, ...], arb_mat]()
            for value in self.clock.each(map(tuple, values)):
                if value not in pieces_by_value:
                    pieces_by_value[value] = stacked([[arb(v)] for v in value])
            return [pieces_by_value[tuple(value)] for value in values]
        columns, zero = self.control.sparse.tocsc(), arb(0)
        pieces, pieces_by_key = [], dict[bytes, arb_mat]()
        for start, stop in self.clock.each(pairwise(columns.indptr.tolist())):
            functions, values = columns.indices[start:stop], columns.data[start:stop]
            key = coefficients[:, functions].tobytes() + values.tobytes()
            if key not in pieces_by_key:
                terms = list(zip(functions.tolist(), values.tolist(), strict=True))
                rows = [sum((arb(float(row[i])) * arb(v) for i, v in terms), zero) for row in coefficients]
                pieces_by_key[key] = stacked([[x] for x in rows])
            pieces.append(pieces_by_key[key])
        return pieces

    @cached_property
    def scene(self) -> Scene:
        """The control and the disturbance on the common grid."""
        grid, acting = self.timing.grid, self.timing.acting
        middles = [(a + b) / 2 for a, b in pairwise(grid)]
        piece_indices = np.clip(np.searchsorted(acting, middles, side="right") - 1, 0, len(acting) - 1)
        changes = self.disturbances.changes
        early_inputs = (
            [stacked([[v] for v in balls([*before(self.problem)])])] if self.problem.system.delay > 0.0 else []
        )
        inputs = [*early_inputs, *self.sources.find_means(self.pieces)]
        if self.problem.system.drifts:
            inputs = [stacked([[v] for v in (*u.entries(), *balls([1.0]))]) for u in self.clock.each(inputs)]
        return Scene(
            grid,
            [inputs[k] for k in piece_indices],
            [float(v) for v in np.asarray(self.problem.initial_state)],
            None if changes is None else self.disturbances.held,
            changes or [],
            self.problem.initial_set,
            self.disturbances.held_components,
        )

    def build_added_terms(
        self, window: ConstraintWindow, basis: Array, gains: Array, parameter: Sequence[float] | None = None
    ) -> AddedTerms | None:
        """Return the terms that are added to the state in the rows ``basis (b, d)`` on the state and ``gains (b, m)``
        on the control, ``None`` where there are none; at one ``parameter (nu,)``, or at all of them."""
        entering = self.sources.entering if parameter is None else self.sources.entering_at(parameter)
        if window.reference is None and not window.is_mixed and not entering:
            return None
        return AddedTerms(window, basis, gains, self.control.breakpoints.tolist(), self.pieces, entering)

    @cached_property
    def price(self) -> Price:
        """The cost of the problem."""
        return Price(self.problem, self.control, self.flows.at(nominal_parameter(self.problem)), self.clock)

    @cached_property
    def duality(self) -> Duality:
        """The data that lower bounds are derived from."""
        disturbances = self.disturbances
        return Duality(
            self.problem,
            self.control,
            disturbances.changes,
            self.followed if self.followed.are_best else self.flows,
            disturbances.held,
            disturbances.held_components,
        )


def nominal_parameter(problem: OptimalControlProblem) -> list[float]:
    """Return the parameter ``(nu,)`` of the nominal trajectory, at which the middle of the disturbance is
    propagated."""
    bound = problem.system.parameters
    return [] if bound is None else nominal_point(bound).tolist()


def _read_inner_gains(case: Case) -> Array:
    """Return the gains ``(K, m, d)`` of a feedback of the state beside the decision; an empty array where the policy
    has none."""
    if case.policy is None or case.policy.inner_gain is None:
        return np.zeros((0, 0, 0))
    problem, system = case.problem, case.problem.system
    if system.delay > 0.0 or (problem.repeat and problem.control_step is not None):
        raise Unchecked("the checker knows an inner loop of controls that act at once, without steps between periods")
    if system.parameter_count or system.varies:
        raise Unchecked("the checker knows an inner loop of known systems that do not change with time")
    return shaped(case.certificate, "prestabilise", (case.control.pieces, system.controls, system.states))


def lost_by(case: Case) -> float:
    """Return the exponent of what balls and multipliers lose beside an inner loop; 0 without one. More digits are kept
    there; no claim rests on it."""
    try:
        gains = _read_inner_gains(case)
        corrections = _read_corrections(case)
    except (Broken, Unchecked):  # the claims about them say so
        return 0.0
    matrices = (
        [[matrix[0] for matrix in mode.matrices(np.zeros((1, 0)))[:2]] for mode in case.problem.system.modes]
        if gains.size
        else []
    )
    return lost_digits(matrices, np.diff(case.control.breakpoints), gains, corrections)


def _read_corrections(case: Case) -> Array:
    """Return the products ``L_k C (K, d, d)`` of an observer; an empty array where states are measured."""
    observer, measurements = observer_gains(case), case.problem.measurements
    return observer @ np.asarray(measurements.C) if measurements is not None and observer.size else observer


def observer_gains(case: Case) -> Array:
    """Return the observer gains ``(K, d, p)`` that make innovations of the outputs; an empty array without answered
    outputs. Any gains that are written are valid."""
    measurements = case.problem.measurements
    if measurements is None or not case.answering:
        return np.zeros((0, 0, 0))
    shape = case.control.pieces, case.problem.system.states, measurements.outputs
    return shaped(case.certificate, "observer", shape)


def _make_window(
    problem: OptimalControlProblem, entry: PathConstraint | MixedConstraint, name: str
) -> ConstraintWindow:
    """Return the constraint of one entry of a problem, under the entry's own name where it has one."""
    stop = problem.horizon if entry.stop is None else entry.stop
    reference = None if entry.relative_to is None else np.asarray(entry.relative_to)
    return ConstraintWindow(entry.name or name, entry.set, entry.start, stop, problem.system.states, reference)


def numbers(data: object, name: str) -> Array:
    """Return finite numbers from the certificate; raise `Broken` where the data are something else."""
    if not _is_numeric(data):
        raise Broken(f"{name}: expected numbers")
    try:
        array = np.array(data, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise Broken(f"{name}: expected numbers") from error
    if not np.isfinite(array).all():
        raise Broken(f"{name}: expected finite numbers")
    return array


def shaped(data: Mapping[str, Any], key: str, shape: tuple[int, ...], whose: str = "") -> Array:
    """Return finite numbers of one shape under a key of the certificate; raise `Broken` where they are something else.
    ``whose`` names their entry, before the key in messages."""
    array = numbers(data.get(key), f"{whose}{key}")
    if array.shape != shape:
        raise Broken(f"{whose}{key}: shape {array.shape}, expected {shape}")
    return array


def _is_numeric(data: object) -> bool:
    """Return whether the data are a number or nested lists of numbers; text and truth values are none."""
    level: list[object] = [data]
    while level:
        kinds = set(map(type, level))
        if not all(issubclass(kind, int | float | list) and kind is not bool for kind in kinds):
            return False
        level = list(chain.from_iterable(value for value in level if isinstance(value, list)))
    return True


def written_policy(certificate: Mapping[str, Any], pieces: int) -> WrittenPolicy:
    """Return the policy that a certificate describes: the cost that it is charged, and what each piece answers. The
    answers are ranges of breakpoints for each of the ``pieces``. Raise `Broken` where there is no such policy."""
    data = certificate.get("policy")
    if not isinstance(data, Mapping):
        raise Broken("policy: expected a cost, and the breakpoints that every piece answers")
    rows, written_cost = listed(data, "answers"), data.get("cost")
    cost: Cost | None = next((kind for kind in get_args(Cost) if kind == written_cost), None)
    if cost is None:
        raise Broken(f"policy: the cost is {written_cost!r}, expected one of {', '.join(get_args(Cost))}")
    if len(rows) != pieces:
        raise Broken(f"policy: answers of {len(rows)} pieces, expected {pieces}")
    if pieces > MAX_ANSWERING:
        raise Broken(f"policy: {pieces} pieces that answer, expected at most {MAX_ANSWERING}")
    mask = np.zeros((pieces, pieces), dtype=bool)
    for k, ranges in enumerate(rows):
        for indices in ranges if isinstance(ranges, list) else [ranges]:
            is_range = isinstance(indices, list) and len(indices) == 2 and all(type(index) is int for index in indices)
            if not is_range or not 0 <= indices[0] <= indices[1] <= k:
                raise Broken(f"policy: piece {k + 1} answers the breakpoints {indices!r}, expected a range up to {k}")
            mask[k, indices[0] : indices[1] + 1] = True
    inner = certificate.get("prestabilise")
    return WrittenPolicy(mask, Charge(cost), None if inner is None else numbers(inner, "prestabilise"))


def number(data: Mapping[str, Any], name: str) -> float:
    """Return one finite number of the certificate; raise `Broken` where there is none."""
    value = numbers(data.get(name), name)
    if value.shape != ():
        raise Broken(f"{name}: expected a number")
    return float(value)


def listed(data: Mapping[str, Any], name: str) -> Sequence[Any]:
    """Return one list of the certificate; raise `Broken` where there is none."""
    value = data.get(name)
    if not isinstance(value, list):
        raise Broken(f"{name}: expected a list")
    return value
