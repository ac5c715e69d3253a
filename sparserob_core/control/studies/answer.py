"""The answer to a control problem as functions of time: the control, the tube of states around it, the worst cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from sparserob_core.brief import brief
from sparserob_core.control.policies.policy import Policy
from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.adversary import Adversary, find_adversary
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.result import Result

if TYPE_CHECKING:
    from sparserob_core.control.studies.causal import CausalBound

MAX_TUBE_PARAMETERS = 27  # at most, at which the tube of an uncertain system is computed
INSTANTS = 20_000  # functionals that are asked for at once


@final
@dataclass(frozen=True, eq=False)
class Signal:
    """A piecewise constant function of time: ``values (m, K)`` between ``breakpoints (K + 1,)``.

    Called with a time, it gives ``(m,)``, and with times ``(k,)``, ``(m, k)``; at a breakpoint the piece that begins
    there counts, at the last one the piece that ends there. Raises `InputError` for times outside.
    """

    breakpoints: Array
    values: Array

    def __call__(self, time: npt.ArrayLike) -> Array:
        times = _parse_times(time, float(self.breakpoints[-1]))
        pieces = np.clip(np.searchsorted(self.breakpoints, times, side="right") - 1, 0, self.values.shape[1] - 1)
        return np.asarray(self.values[:, pieces])

    def __repr__(self) -> str:
        m, pieces = self.values.shape
        return f"Signal of {m} channel{'s' * (m > 1)}, {pieces} pieces on [0, {self.breakpoints[-1]:g}]"


@final
@dataclass(frozen=True, eq=False)
class Tube:
    """Range of the states over all disturbances and initial states, at given times.

    Parameters
    ----------
    times : ndarray, shape (T,)
        Times.
    nominal : ndarray, shape (d, T)
        States at the centre of every uncertainty set.
    lower, upper : ndarray, shape (d, T)
        Least and largest values of the states, at the parameters of a lattice. For a system that depends on the time
        and on parameters, all parameters are covered.
    """

    times: Array
    nominal: Array
    lower: Array
    upper: Array

    __repr__ = brief


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ControlResult(Result):
    """The `Result` of a control problem; ``model`` is what the problem became; ``causal``, of a run under feedback, a
    bound against every causal policy.

    ``control``, ``tube`` and ``adversary`` raise `InputError` where there is no decision. It can be pickled if the
    problem can: the program is then built anew where it is read.
    """

    model: Transcription = field(repr=False)
    causal: CausalBound | None = field(default=None, repr=False)

    @staticmethod
    def of(result: Result, model: Transcription, causal: CausalBound | None = None) -> ControlResult:
        """The result with its problem."""
        values = {entry.name: getattr(result, entry.name) for entry in fields(Result)}
        return ControlResult(**values, model=model, causal=causal)

    @property
    def _unit(self) -> str:
        unit = self.model.problem.cost_unit
        return f" {unit}" if unit else ""

    @property
    def plain(self) -> Result:
        """Result without its problem."""
        return Result(**{entry.name: getattr(self, entry.name) for entry in fields(Result)})

    @property
    def problem(self) -> OptimalControlProblem:
        """The control problem."""
        return self.model.problem

    @property
    def control(self) -> Signal:
        """The control as a function of time, and as breakpoints with values ``(m, K)``."""
        return Signal(self.model.control.breakpoints, self.model.pieces(self._require_decision()))

    def tube(self, times: npt.ArrayLike) -> Tube:
        """The states at times ``(T,)``, and how far the disturbance may bring them: exact for known systems, at
        sampled parameters for uncertain ones."""
        return tube(self.model, self._require_decision(), np.atleast_1d(_parse_times(times, self.problem.horizon)))

    def adversary(self, constraint: str) -> Adversary:
        """The worst case of the constraint of that name: time, parameter and disturbance, as arrays. Raises
        `InputError` for a name that no constraint on the state has."""
        named = {entry.name: entry for entry in self.model.constraints}
        if constraint not in named:
            names = ", ".join(named) or "none on the state"
            raise InputError(path="constraint", expected=f"one of {names}", got=f"{constraint!r}")
        worst_case = find_adversary(
            named[constraint], self._require_decision(), self.model.feedback, self.model.program.own_units
        )
        if worst_case is None:
            raise InputError(f"the constraint {constraint} has no worst case at this decision")
        return worst_case

    def _require_decision(self) -> Array:
        if self.decision is None:
            raise InputError(f"there is no control: the result is {self.status}: {self.message}")
        return np.asarray(self.decision, dtype=float).ravel()

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        model = self.model
        arguments = (model.problem, model.control, model.disturbance, model.formulation, model.policy)
        return _read, (self.plain, *arguments, self.causal)


def _read(
    result: Result,
    problem: OptimalControlProblem,
    control: Dictionary,
    disturbance: Dictionary,
    form: Any,
    policy: Policy | None = None,
    causal: CausalBound | None = None,
) -> ControlResult:
    from sparserob_core.control.transcription.transcribe import prepare

    return ControlResult.of(result, prepare(problem, control, disturbance, form, policy), causal)


def tube(model: Transcription, theta: Array, times: Array, states: Sequence[int] | None = None) -> Tube:
    """The tube at a decision ``theta (m N,)``, or the whole one under feedback, and at ``times (T,)``; where ``states``
    are named, of these alone, in rows of their own order."""
    axes = np.eye(model.problem.system.states)[slice(None) if states is None else [*states]]
    upper, lower = supports(model, theta, times, axes), -supports(model, theta, times, -axes)
    if model.feedback is not None:
        return Tube(times, axes @ model.feedback.loop.states(theta, times)[:, :, 0].T, lower, upper)
    bound = model.problem.system.parameters
    middle = np.tile(np.zeros(0) if bound is None else nominal_point(bound), (times.size, 1))
    central = model.functionals.central()
    nominal = [central.values(theta, times, np.tile(axis, (times.size, 1)), middle) for axis in axes]
    return Tube(times, np.array(nominal), lower, upper)


def supports(model: Transcription, theta: Array, times: Array, directions: Array) -> Array:
    """``max c'x(t)`` over every disturbance and parameter, for ``directions (q, d)``, as ``(q, T)``; exact and at
    sampled parameters as in a `tube`."""
    if model.feedback is not None:
        return model.feedback.loop.values(theta, times, directions).T
    lattice, _ = model.parameters.lattice()
    if len(lattice) > MAX_TUBE_PARAMETERS:
        lattice = lattice[np.unique(np.linspace(0, len(lattice) - 1, MAX_TUBE_PARAMETERS).round().astype(int))]
    rows, all_directions = model.problem.names.corners.everywhere(directions)
    count, largest = len(all_directions) * len(lattice), np.full((len(directions), times.size), -np.inf)
    along, p = np.repeat(all_directions, len(lattice), axis=0), np.tile(lattice, (len(all_directions), 1))
    size = max(1, INSTANTS // count)
    for start in range(0, times.size, size):
        batch = slice(start, start + size)
        time_count = times[batch].size
        at = np.tile(times[batch], count), np.repeat(along, time_count, axis=0), np.repeat(p, time_count, axis=0)
        values = model.functionals.values(theta, *at).reshape(len(all_directions), len(lattice), time_count).max(axis=1)
        np.maximum.at(largest[:, batch], rows, values)
    return largest


def _parse_times(time: npt.ArrayLike, horizon: float) -> Array:
    try:
        times = np.array(time, dtype=float)
    except (TypeError, ValueError):
        raise InputError(path="times", expected="numbers", got=f"{time!r}") from None
    if times.ndim > 1 or not ((times >= 0.0) & (times <= horizon)).all():
        raise InputError(path="times", expected=f"a time, or times (k,), from 0 to {horizon:g}", got=f"{time!r}")
    return times
