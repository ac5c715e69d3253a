"""The worst that can happen to one constraint at a decision, as a parameter and a signal that can be plotted and
replayed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.flows import DoublingExponentials
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.varying_motion import VaryingMotion
from sparserob_core.control.response.response import Response
from sparserob_core.control.transcription.record import Feedback, Transcription
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.program import OwnUnits, Separation

if TYPE_CHECKING:
    from sparserob_core.control.feedback.closed_loop import ClosedLoop

PARTS_PER_PIECE = 4  # equal parts of every piece on which a measurable worst case is looked for
SWITCH_HALVINGS = 40  # of a part across a switch of the worst disturbance
SIGNAL = 4096  # parts at most; a set without corners has a worst disturbance that is constant nowhere
LOSS_TOLERANCE = 1e-14  # of the largest integrand times the horizon: what a constant on a part may lose


@dataclass(frozen=True, eq=False, kw_only=True)
class Adversary:
    """The worst case of one family: ``direction'x(time) - bound = violation`` (negative: a margin) under
    ``parameter (nu,)`` and the disturbance, from ``initial_state (d,)``; what the control itself uses of the bound of a
    mixed constraint is taken off.

    ``direction (d,)`` is row ``row`` of a set with flat sides, or a unit normal of a curved one. The disturbance
    ``(mw, L)`` is constant between ``breakpoints (L + 1,)``; ``None`` where there is none. ``deviation (Q,)``: under
    feedback what the control answers, as in `ClosedLoop`; ``noise (K, p)`` that of what is measured, if any.
    """

    name: str
    row: int
    time: float
    direction: Array
    bound: float
    parameter: Array
    violation: float
    breakpoints: Array
    disturbance: Array | None
    initial_state: Array
    deviation: Array | None = None
    noise: Array | None = None

    __repr__ = brief


def find_adversaries(model: Transcription, decision: Array) -> list[Adversary]:
    """The worst case of every constraint on the state of a problem, as far as there is one."""
    adversaries = [
        find_adversary(constraint, decision, model.feedback, model.program.own_units)
        for constraint in model.constraints
    ]
    return [adversary for adversary in adversaries if adversary is not None]


def find_adversary(
    constraint: StateConstraint, decision: Array, feedback: Feedback | None = None, own: OwnUnits | None = None
) -> Adversary | None:
    """The `Adversary` of a constraint, at the largest violation that its separation finds; ``None`` if it finds
    none. Under ``feedback`` that of the closed loop. Where the program is known in its ``own`` units, in which a method
    has looked at every sample before, it is sought there."""
    if feedback is not None:
        return _find_in_closed_loop(constraint, decision, feedback.loop)
    separation = constraint.worst(decision) if own is None else _separate_in_own_units(constraint, decision, own)
    if not separation.violations.size:
        return None
    row = int(separation.rows[0])
    times, directions, parameters, bounds = (
        values[row] for values in constraint.functionals_at(separation.indices[:1])
    )
    time, direct = float(times), constraint.direct(separation.indices[:1, 0])
    bounds = bounds if direct is None else bounds - direct[row] @ decision
    breakpoints, disturbance = worst_signal(constraint.functionals, time, directions, parameters)
    return Adversary(
        name=constraint.name,
        row=row,
        time=time,
        direction=directions,
        bound=float(bounds),
        parameter=parameters,
        violation=float(separation.violations[0]),
        breakpoints=breakpoints,
        disturbance=disturbance,
        initial_state=constraint.functionals.response.initial_state
        + constraint.functionals.worst_deviations(np.array([time]), directions[None], parameters[None])[0],
    )


def _separate_in_own_units(constraint: StateConstraint, decision: Array, own: OwnUnits) -> Separation:
    """The largest violation of all rows in the user's units, its place found in the program's ``own``."""
    family = own.program.family(constraint.name)
    family = family.reduced or family
    source, rows, begins = family.source, family.row_units, family.index_units
    assert isinstance(source, StateConstraint) and rows is not None and begins is not None
    looked_at = source if (rows == rows[0]).all() else source.looked_at_in(1.0 / rows)  # one row may be in metres
    separation = looked_at.worst(decision / own.decision[: decision.size])
    indices, row = separation.indices[:1] * begins, separation.rows[:1]
    return Separation(indices, row, constraint.violations(decision, indices, row))


def _find_in_closed_loop(constraint: StateConstraint, decision: Array, loop: ClosedLoop) -> Adversary:
    from sparserob_core.control.constraints.feedback import FeedbackConstraint

    robust_constraint = FeedbackConstraint.of(constraint, loop)
    worst = robust_constraint.worst(decision)
    row, time = int(worst.rows[0]), float(worst.indices[0, 0])
    _, directions, _, bounds = constraint.functionals_at(worst.indices[:1])
    response, direction = constraint.functionals.response, directions[row]
    deviation, offset = robust_constraint.against(decision, worst.indices[0], row)
    breakpoints, disturbance = response.grid.breakpoints, None
    if constraint.functionals.disturbance is not None:
        disturbance = loop.signal(deviation)
    return Adversary(
        name=constraint.name,
        row=row,
        time=time,
        direction=direction,
        bound=float(bounds[row]) - offset,
        parameter=np.zeros(0),
        initial_state=loop.compute_initial_state(deviation),
        violation=float(worst.violations[0]),
        breakpoints=breakpoints,
        disturbance=disturbance,
        deviation=deviation,
        noise=loop.noises(deviation),
    )


def worst_signal(
    functionals: WorstFunctionals, time: float, direction: Array, parameter: Array
) -> tuple[Array, Array | None]:
    """``breakpoints (L + 1,)`` and a disturbance ``(mw, L)`` that maximises ``direction'x(time)``; ``None`` without
    disturbances.

    Among measurable disturbances the maximiser is ``w(s)`` in the set with the largest
    ``direction'e^{A (time - s)} E w`` (Pontryagin's principle): constant between finitely many switches for a polytope,
    approached by `SIGNAL` constants for a set without corners.
    """
    grid, model, support = functionals.response.grid, functionals.disturbance, functionals.measurable
    if model is None or support is None:
        return grid.breakpoints, functionals.parts(time, direction, parameter).disturbance
    bound = support.bound
    flow = _build_adjoint(functionals.response, parameter, time, direction)
    starts = np.concatenate(
        [
            begin + (end - begin) * np.arange(PARTS_PER_PIECE) / PARTS_PER_PIECE
            for begin, end in pairwise(functionals.response.propagator.marks if grid.varying else grid.breakpoints)
        ]
    )
    ends = np.append(starts[1:], grid.breakpoints[-1])
    is_past = starts < time
    starts, ends = _refine_parts(
        bound, flow, (starts[is_past], np.minimum(ends[is_past], time)), float(grid.breakpoints[-1])
    )
    values = bound.support_point(flow.gains(starts, ends))
    if time < grid.breakpoints[-1]:  # afterwards nothing matters
        starts, values = np.append(starts, time), np.vstack([values, bound.interior_point()])
    points, signal = _merge_equal_parts(starts, values, grid.breakpoints)
    if model.on_blocks is not None:  # of other columns
        weights = functionals.response.weights(np.array([time]), direction[None], parameter[None]).disturbance
        block_signal = model.on_blocks.worst(weights)[0]
        signal = signal + block_signal[:, grid.locate((points[:-1] + points[1:]) / 2)]
    return points, signal


def evaluate_disturbance(
    functionals: WorstFunctionals, time: float, direction: Array, parameter: Array, signal: tuple[Array, Array]
) -> float:
    """Return the contribution of a disturbance to ``direction'x(time)``.

    The ``signal`` consists of breakpoints ``(L + 1,)``, among which are those of the grid, and values ``(mw, L)``
    between them.
    """
    ends, values = signal
    is_past = ends[:-1] < time
    flow = _build_adjoint(functionals.response, parameter, time, direction)
    return float((flow.gains(ends[:-1][is_past], np.minimum(ends[1:][is_past], time)) * values.T[is_past]).sum())


@dataclass(frozen=True, eq=False)
class _SwitchedAdjoint:
    """Adjoint of a functional ``direction'x(time)``, propagated backwards through the phases of a switched system.

    Parameters
    ----------
    ends : ndarray, shape (J,)
        End of each phase, or the time of the functional where that is earlier.
    rows : ndarray, shape (J, d)
        Adjoint at these ends.
    exponentials : list of DoublingExponentials
        Exponentials of the matrix of each phase.
    E : list of ndarray
        Matrix of the disturbance in each phase.
    """

    ends: Array
    rows: Array
    exponentials: list[DoublingExponentials]
    E: list[Array]

    @staticmethod
    def of(response: Response, parameter: Array, time: float, direction: Array) -> _SwitchedAdjoint:
        """Compute the adjoint of a functional at a ``time`` with a ``direction (d,)``."""
        matrices = [[matrix[0] for matrix in mode.matrices(parameter[None])] for mode in response.system.modes]
        exponentials, begins = (
            [DoublingExponentials(A) for A, _, _ in matrices],
            np.array([0.0, *response.system.switches]),
        )
        ends = np.minimum(np.append(begins[1:], response.grid.breakpoints[-1]), time)
        rows = np.tile(direction, (ends.size, 1))
        for mode in range(ends.size - 1, 0, -1):
            rows[mode - 1] = exponentials[mode].rows(rows[[mode]], ends[[mode]] - ends[[mode - 1]])[0][0]
        return _SwitchedAdjoint(ends, rows, exponentials, [E for _, _, E in matrices])

    def at(self, times: Array, inside: Array) -> Array:
        """Return ``E' Phi(time, s)' direction`` at ``times (k,)``, in the phases that hold the times ``inside (k,)``:
        ``(k, mw)``."""
        return self._evaluate_by_phase(times, inside, lambda exponentials, rows, indices: rows)

    def gains(self, starts: Array, ends: Array) -> Array:
        """Return the integrals of ``E' Phi(time, s)' direction`` from ``starts (k,)`` to ``ends (k,)``, each within one
        phase: ``(k, mw)``."""

        def integrated(exponentials: DoublingExponentials, rows: Array, which: np.ndarray) -> Array:
            return exponentials.rows(rows, (ends - starts)[which])[1]

        return self._evaluate_by_phase(ends, (starts + ends) / 2, integrated)

    def _evaluate_by_phase(
        self, times: Array, inside: Array, made: Callable[[DoublingExponentials, Array, np.ndarray], Array]
    ) -> Array:
        values, modes = np.zeros((times.size, self.E[0].shape[1])), np.searchsorted(self.ends[:-1], inside)
        for mode in np.unique(modes):
            indices = np.flatnonzero(modes == mode)
            rows = self.exponentials[mode].orbits(self.rows[[mode]], self.ends[mode] - times[indices])[0][:, 0]
            values[indices] = made(self.exponentials[mode], rows, indices) @ self.E[mode]
        return values


@dataclass(frozen=True, eq=False)
class _VaryingAdjoint:
    """Adjoint of a functional with the ``row (d,)`` at its ``time``, propagated backwards through a system that changes
    with time."""

    motion: VaryingMotion
    row: Array
    time: float

    def at(self, times: Array, inside: Array) -> Array:
        """Return ``E' Phi(time, s)' row`` at ``times (k,)``, on the pieces that hold the times ``inside (k,)``:
        ``(k, mw)``."""
        pieces = np.minimum(self.motion.place(inside), self.motion.origin.size - 1)
        inputs = self.motion.law(times, pieces)[0][:, :, self.motion.states :]
        return np.asarray((self._propagate_back(times)[:, None] @ inputs)[:, 0, self.motion.expansion.channels[0] :])

    def gains(self, starts: Array, ends: Array) -> Array:
        """Return the integrals of ``E' Phi(time, s)' row`` from ``starts (k,)`` to ``ends (k,)``: ``(k, mw)``."""
        input_response = self.motion.expansion.flow(starts, ends).disturbance
        return np.asarray((self._propagate_back(ends)[:, None] @ input_response)[:, 0])

    def _propagate_back(self, times: Array) -> Array:
        """Return the functional propagated backwards to earlier ``times (k,)``: ``(k, d)``."""
        ends, rows = self._rows_at_ends
        pieces = np.minimum(self.motion.place(times), ends.size - 1)
        state = self.motion.expansion.flow(times, ends[pieces]).state
        return np.asarray((rows[pieces][:, None] @ state)[:, 0])

    @cached_property
    def _rows_at_ends(self) -> tuple[Array, Array]:
        """Ends of the pieces between marks, up to the piece that holds the time of the functional, ``(K,)``, and the
        functional there, ``(K, d)``. The last end is the time itself."""
        motion, marks = self.motion, self.motion.grid.breakpoints
        last = max(0, int(np.searchsorted(marks, self.time)) - 1)
        ends, rows = np.append(marks[1 : last + 1], self.time), np.tile(self.row, (last + 1, 1))
        if last:
            rows[last - 1] = self.row @ motion.expansion.flow(marks[[last]], np.array([self.time])).state[0]
        for k in range(last - 2, -1, -1):
            rows[k] = rows[k + 1] @ motion.flow.state[k + 1]
        return ends, rows


DisturbanceAdjoint: TypeAlias = _SwitchedAdjoint | _VaryingAdjoint


def _build_adjoint(response: Response, parameter: Array, time: float, direction: Array) -> DisturbanceAdjoint:
    if response.grid.varying:
        response = response.at(parameter)
        return _VaryingAdjoint(VaryingMotion(response.propagator, response.initial_state), direction, time)
    return _SwitchedAdjoint.of(response, parameter, time, direction)


def _refine_parts(
    bound: ConvexSet, flow: DisturbanceAdjoint, parts: tuple[Array, Array], horizon: float
) -> tuple[Array, Array]:
    """The parts, halved wherever the best constant on one is not the best at both of its ends; the most lossy of them
    when they are too many."""
    starts, ends = parts
    active = np.arange(starts.size)
    for _ in range(SWITCH_HALVINGS):
        loss, size = _measure_loss(bound, flow, starts[active], ends[active])
        allowed = LOSS_TOLERANCE * size * horizon
        middles = (starts[active] + ends[active]) / 2
        open_ = np.flatnonzero((loss > allowed) & (middles > starts[active]) & (middles < ends[active]))
        open_ = open_[np.argsort(-loss[open_], kind="stable")][: max(0, SIGNAL - starts.size)]
        if not open_.size:
            break
        split, middles = active[open_], middles[open_]
        starts, ends = np.concatenate([starts, middles]), np.concatenate([ends, ends[split]])
        ends[split] = middles
        active = np.concatenate([split, np.arange(starts.size - split.size, starts.size)])
    order = np.argsort(starts)
    return starts[order], ends[order]


def _measure_loss(bound: ConvexSet, flow: DisturbanceAdjoint, starts: Array, ends: Array) -> tuple[Array, float]:
    """Return the loss of the best constant on each part against the best values at its two ends, times the part's
    length, ``(k,)``, and the largest absolute support value there."""
    best = bound.support_point(flow.gains(starts, ends))
    loss, largest = np.zeros(starts.size), 0.0
    for times in (starts, ends):
        rows = flow.at(times, (starts + ends) / 2)
        height = bound.support(rows)
        loss += (ends - starts) * (height - (best * rows).sum(axis=1))
        largest = max(largest, float(np.abs(height).max(initial=0.0)))
    return loss, largest


def _merge_equal_parts(starts: Array, values: Array, breakpoints: Array) -> tuple[Array, Array]:
    """Parts with the same value as one, but for the breakpoints of the grid, which all stay."""
    changes = np.concatenate([[True], (np.diff(values, axis=0) != 0).any(axis=1)])
    points = np.unique(np.concatenate([breakpoints, starts[changes]]))
    indices = np.searchsorted(starts, (points[:-1] + points[1:]) / 2, side="right") - 1
    return points, values[indices].T
