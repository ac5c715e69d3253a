"""State of the closed loop at all times: an exact affine function of the deviations.

With the effects ``F`` of the gains, the control on piece ``k`` is ``u_k = v_k + F_k w`` (with an `InnerLoop`, plus
``K_k x(tau_k)``, less what it does not know of ``x(tau_k)`` where outputs are measured), and the state is
``x(t) = x_v(t) + sum_q y_q(t) w_q``. Every response ``y_q`` is the state of the same system from 0, driven by column
``q`` of the effects and by its own entry of the disturbance. Where the initial states are a set, the last entries of
``w`` are deviations of the initial state, and their responses begin at its unit vectors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.feedback.innovations import KNOWN, Answers, build_innovations
from sparserob_core.control.feedback.observer import Observer, innovations_of
from sparserob_core.control.feedback.prestabilised import SampledPlant
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.varying_motion import VaryingMotion
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread

if TYPE_CHECKING:
    from sparserob_core.control.response.inner_loop import InnerLoop
    from sparserob_core.control.response.response import PieceTransitions
    from sparserob_core.control.response.time_grid import TimeGrid

ROUND_OFF = 2.0**-46  # of the numbers that are added up
FLOWS_KEPT = 8  # lists of times to which transitions of a system in t are remembered: each round asks for the same


@final
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """Functionals of one system whose control responds to its measurements.

    The decision ``x (n,)`` begins with the nominal control ``v (m, K)``, raveled. The variables of ``answers`` follow,
    and then all other variables of the program.

    Parameters
    ----------
    functionals : WorstFunctionals
        Functionals of the system.
    answers : Answers
        Variables of the gains.
    spread : Spread
        Set of deviations: those of the disturbance, block after block; those of the noise, breakpoint after breakpoint;
        and those of the initial state, where there is a set of them.
    variables : int
        Number of variables of the program.
    observer : Observer, optional
        Source of the innovations of outputs. Without an observer they are the innovations of the whole state.
    anew : bool, default False
        Whether the plan repeats with a new initial state. The deviations of the next period's initial state then stand
        before those of the initial state; only the step across the seam depends on them.
    """

    functionals: WorstFunctionals
    answers: Answers
    spread: Spread
    variables: int
    observer: Observer | None = None
    anew: bool = False
    _paths: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)
    _flows: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    @property
    def nominal_size(self) -> int:
        """Number of variables of the nominal control."""
        return self.functionals.variables

    @property
    def scales(self) -> bool:
        """True where the deviations are in copies of a single set, so that they can be `scaled`."""
        return len(self.spread.sets) == 1

    def scaled(self, factor: float) -> ClosedLoop:
        """Return the same loop with all deviations multiplied by ``factor``."""
        sets = tuple((count, convex.scaled(factor)) for count, convex in self.spread.sets)
        return replace(self, spread=replace(self.spread, sets=sets), _paths={})

    def nominal(self, x: Array) -> Array:
        """Return the nominal control ``(m, K)`` of the decision ``x (n,)``."""
        return np.ascontiguousarray(self.controls(x)[:, :, 0].T)

    def effects(self, x: Array) -> Array:
        """Return the effects ``F (K, m, Q)`` of the deviations on the control, at the decision ``x (n,)``."""
        return np.ascontiguousarray(self.controls(x)[:, :, 1:])

    def controls(self, x: Array) -> Array:
        """Return the nominal control and its answers to the deviations on every piece, ``(K, m, 1 + Q)``."""
        decided, inner = self.decided(x), self.inner
        if not inner.acts:
            return decided
        return np.asarray(decided + inner.gains @ self.path(x)[0][self.firsts])

    def decided(self, x: Array) -> Array:
        """Return the part of `controls` without the feedback ``K_k x(tau_k)`` of the inner loop, ``(K, m, 1 + Q)``.
        It is what is decided, with the `missing` part of this feedback."""
        nominal = x[: self.nominal_size].reshape(-1, self.functionals.dictionary.pieces)
        effects = self.answers.effects(x[self.nominal_size : self.nominal_size + self.answers.variables])
        effects = effects + self.missing if self.inner.acts else effects
        return np.concatenate([nominal.T[:, :, None], effects], axis=2)

    @cached_property
    def missing(self) -> Array:
        """Responses ``(K, m, Q)`` of what the inner loop adds to the control to the errors of the states that it acts
        on, which no decision changes; 0 where states are measured."""
        return np.asarray(-self.inner.gains @ self._measured[1])

    @cached_property
    def widest(self) -> Array:
        """Upper bounds ``(m,)`` of the `missing` part of the control under any deviation; 0 without an inner loop."""
        if not self.inner.acts:
            return np.zeros(self.answers.shape[1])
        bounds = np.maximum(self.spread.support(self.missing), self.spread.support(-self.missing))
        return np.asarray(bounds.max(axis=0))

    @property
    def inner(self) -> InnerLoop:
        """Feedback of the state beside the decision."""
        return self.functionals.response.inner

    @cached_property
    def firsts(self) -> np.ndarray:
        """Piece of the loop's grid with which each piece of the control begins, ``(K,)``."""
        return np.flatnonzero(np.diff(self.grid.control_piece, prepend=-1) > 0)

    def gains(self, x: Array) -> Array:
        """Return the gains ``M (K, K, m, d)`` at the decision ``x (n,)``."""
        return self.answers.gains(x[self.nominal_size : self.nominal_size + self.answers.variables])

    def respond(self, x: Array, innovations: Sequence[Array]) -> Array:
        """Return what is added to the nominal control on every piece, ``(m, K)``, by the ``innovations (d,)`` that were
        measured so far, if nothing more happens than that."""
        gains, measured = self.gains(x), np.array(innovations)
        answered = np.einsum("kjmd,jd->km", gains[:, : len(measured)], measured)
        if not self.inner.acts:
            return np.asarray(answered.T)
        response, none = self.functionals.response, np.zeros(self.functionals.response.system.disturbances)
        plant, state = SampledPlant.of(response, self.functionals.dictionary, none, none), np.zeros(self.start.size)
        for k, (Phi, Gamma) in enumerate(zip(plant.Phi, plant.Gamma, strict=True)):
            state = state + measured[k] if k < len(measured) else state
            answered[k] += self.inner.gains[k] @ state
            state = Phi @ state + Gamma @ answered[k]
        return np.asarray(answered.T)

    def written(self, x: Array | None) -> dict[str, Array]:
        """Return the arrays of the feedback that are stored in files: its ``gains`` at the decision ``x``, if there is
        one; the gains ``(K, d, p)`` of its ``observer``, if outputs are measured; and the gains ``(K, m, d)`` of its
        inner loop, ``prestabilise``, if there is one."""
        fixed = {} if self.observer is None else {"observer": self.observer.L}
        fixed |= {"prestabilise": self.inner.gains} if self.inner.acts else {}
        return fixed if x is None else {"gains": self.gains(x), **fixed}

    @cached_property
    def motion(self) -> VaryingMotion | None:
        """The system between all marks, where it changes with time."""
        if not self.functionals.response.grid.varying:
            return None
        (motion,) = self.functionals.over_cells.legs(KNOWN[0], KNOWN[0])
        return motion if isinstance(motion, VaryingMotion) else None

    @cached_property
    def grid(self) -> TimeGrid:
        """The pieces between whose ends nothing jumps; of a system that changes with time, on which it is one
        polynomial of it: ``L`` of them."""
        return self.functionals.response.grid if self.motion is None else self.motion.grid

    @cached_property
    def origin(self) -> np.ndarray:
        """Piece of the grid of control and disturbance that holds each piece of the loop's own grid, ``(L,)``."""
        return np.arange(self.grid.pieces) if self.motion is None else self.motion.origin

    @cached_property
    def steps(self) -> PieceTransitions:
        """Matrices and transitions of the system."""
        return self.functionals.response.steps(KNOWN)

    @cached_property
    def entries(self) -> Array:
        """Matrices ``(L, mw, Q)`` from all deviations to the deviation of the disturbance on every piece of the
        grid."""
        model, grid = self.functionals.disturbance, self.functionals.response.grid
        width = self.functionals.response.system.disturbances
        table = np.zeros((grid.pieces, width, self.spread.size))
        if model is not None:
            assert model.starts is not None
            block = np.searchsorted(model.starts, np.arange(grid.pieces), side="right") - 1
            for i in range(width):
                table[np.arange(grid.pieces), i, block * width + i] = 1.0
        return table

    @cached_property
    def begins(self) -> Array:
        """Matrix ``(d, Q)`` from all deviations to the deviation of the initial state."""
        d = self.functionals.response.initial_state.size
        count = 0 if self.functionals.initial is None else d
        return np.hstack([np.zeros((d, self.spread.size - count)), np.eye(d, count)])

    @property
    def noise(self) -> slice:
        """Slice of the deviations that belongs to the noise of the measurements; empty where there is no noise."""
        last = self.spread.size - int(self.begins.sum()) * (1 + self.anew)
        noisy = self.observer is not None and self.observer.noisy
        return slice(last - (self.answers.shape[0] * self.answers.shape[3] if noisy else 0), last)

    def noises(self, deviation: Array) -> Array | None:
        """Return the noise ``(K, p)`` of a deviation ``(Q,)``; ``None`` where there is none."""
        point = (self.spread.middle + deviation)[self.noise]
        return point.reshape(self.answers.shape[0], -1) if point.size else None

    @property
    def innovations(self) -> Array:
        """Matrices ``(K, p, Q)`` from all deviations to every innovation."""
        return self._measured[0]

    @cached_property
    def _measured(self) -> tuple[Array, Array]:
        """Matrices from all deviations to every innovation, ``(K, p, Q)``, and to the errors of the states that the
        control knows, ``(K, d, Q)``."""
        problem, initial_count = self.functionals, int(self.begins.sum())
        state_innovations = build_innovations(
            problem.response, problem.dictionary, problem.disturbance, initial_count > 0
        )
        return innovations_of(state_innovations, initial_count, self.observer, self.anew)

    @cached_property
    def expected(self) -> tuple[Array, Array]:
        """The least and the largest of every innovation, ``(K, p)`` each."""
        return -self.spread.support(-self.innovations), self.spread.support(self.innovations)

    @cached_property
    def following(self) -> Array:
        """Matrix ``(d, Q)`` from all deviations to that of the next period's initial state; 0 unless the plan repeats
        ``anew``."""
        d = self.begins.shape[0]
        return np.roll(self.begins, -d, axis=1) * self.anew

    @cached_property
    def start(self) -> Array:
        """The initial state ``(d,)`` that deviations are counted from."""
        initial_state: Array = self.functionals.response.initial_state + self.begins @ self.spread.middle
        return initial_state

    @cached_property
    def middles(self) -> Array:
        """The middle of the disturbance on every piece of the grid, ``(L, mw)``."""
        return np.asarray(self.entries @ self.spread.middle)

    def inputs(self, x: Array) -> Array:
        """Return the nominal inputs on the pieces of the grid and their responses to the deviations,
        ``(L, m + mw, 1 + Q)``, without the inner loop. The rows are control, drift and disturbance."""
        grid, m, origin, decided = self.grid, self.answers.shape[1], self.origin, self.decided(x)
        nominal = np.concatenate(
            [grid.inputs(np.ascontiguousarray(decided[:, :, 0].T)).T[:, :, None], self.middles[origin, :, None]], axis=1
        )
        has_control, entries = grid.control_piece >= 0, self.entries[origin]
        responses = np.zeros((*nominal.shape[:2], entries.shape[2]))
        responses[:, nominal.shape[1] - entries.shape[1] :] = entries
        responses[has_control, :m] = decided[grid.control_piece[has_control], :, 1:]
        return np.concatenate([nominal, responses], axis=2)

    def drives(self, x: Array) -> Array:
        """Return the driving terms of the nominal state and of every response on the pieces of the grid,
        ``(L, d, 1 + Q)``.

        In a system that changes with time, the matrices of the inputs change within a piece. The `inputs` themselves
        are then returned.
        """
        if self.motion is not None:
            return self.inputs(x)
        B, E = (self.grid.of_modes(matrices)[self.grid.modes] for matrices in (self.steps.B[0], self.steps.E[0]))
        return np.asarray(np.concatenate([B, E], axis=2) @ self.inputs(x))

    def path(self, x: Array) -> tuple[Array, Array]:
        """Return the nominal state and every response at the breakpoints of the grid, ``(L + 1, d, 1 + Q)``, and their
        `drives`.

        Results for the last two decisions are kept.
        """
        key = x.tobytes()
        if key not in self._paths:
            response, drives, motion = self.functionals.response, self.drives(x), self.motion
            Phi, Gamma, step_numbers = self.steps.Phi[0], self.steps.Gamma[0], response.which
            if motion is not None:
                Phi, Gamma, step_numbers = motion.flow.state, motion.inputs, motion.every
            nodes = np.zeros((drives.shape[0] + 1, self.start.size, drives.shape[2]))
            nodes[0] = np.column_stack([self.start, self.begins])
            feedback = np.zeros((0, drives.shape[2]))
            for piece, step in enumerate(step_numbers.tolist()):
                if self.inner.acts:
                    if piece in self.firsts:
                        feedback = self.inner.gains[self.grid.control_piece[piece]] @ nodes[piece]
                    drives[piece] += self._control_matrices[piece] @ feedback
                nodes[piece + 1] = Phi[step] @ nodes[piece] + Gamma[step] @ drives[piece]
            while len(self._paths) > 1:
                self._paths.pop(next(iter(self._paths)))
            self._paths[key] = (nodes, drives)
        return self._paths[key]

    def states(self, x: Array, times: Array) -> Array:
        """Return the nominal state and every response at ``times (k,)``: ``(k, d, 1 + Q)``."""
        (nodes, drives), pieces = self.path(x), self.grid.locate(times)
        flow, input_flow = self.compute_flows(pieces, np.clip(times - self.grid.breakpoints[pieces], 0.0, None))
        return np.asarray(flow @ nodes[pieces] + input_flow @ drives[pieces])

    def bound_rounding_errors(self, x: Array) -> tuple[Array, Array, Array, Array]:
        """Return bounds under any deviation: of the sizes of the nodes ``(L + 1, d)`` and of what drives them
        ``(L, ..)``, and of the rounding errors of both.

        Each step is allowed an error of `ROUND_OFF` times the absolute numbers that it adds up, and the transitions to
        the node amplify that; those with the inner loop, which answers errors as it answers states. Transitions of a
        system that changes with time are counted by its motion.
        """
        key = x.tobytes()
        if key not in self._rounding_bounds:
            (nodes, drives), radii = self.path(x), np.concatenate([[1.0], self.spread.radii])
            sizes, drive_sizes = np.abs(nodes) @ radii, np.abs(drives) @ radii
            errors, drive_errors = np.zeros_like(sizes), np.zeros_like(drive_sizes)
            if self.motion is None:
                Phi, Gamma, step_numbers = (
                    self.steps.Phi[0],
                    self.steps.Gamma[0],
                    self.functionals.response.which,
                )
                step_errors = np.einsum("kij,kj->ki", np.abs(Phi)[step_numbers], sizes[:-1])
                step_errors = ROUND_OFF * (
                    step_errors + np.einsum("kij,kj->ki", np.abs(Gamma)[step_numbers], drive_sizes)
                )
                d, m = self.start.size, len(self.inner.gains[0]) if self.inner.acts else 0
                transitions = np.empty((step_numbers.size, d + m, d))
                for piece, step in enumerate(step_numbers.tolist()):
                    transitions[:piece] = self._augment(piece, Phi[step], Gamma[step]) @ transitions[:piece]
                    transitions[piece] = np.eye(d + m, d)
                    bounds = np.einsum("kij,kj->i", np.abs(transitions[: piece + 1]), step_errors[: piece + 1])
                    errors[piece + 1] = bounds[:d]
            if self.inner.acts:
                feedback = np.abs(self.inner.gains) @ errors[self.firsts][:, :, None]
                drive_errors = (np.abs(self._control_matrices) @ feedback[self.grid.control_piece])[:, :, 0]
            self._rounding_bounds.clear()
            self._rounding_bounds[key] = sizes, drive_sizes, errors, drive_errors
        return self._rounding_bounds[key]

    def _augment(self, piece: int, Phi: Array, Gamma: Array) -> Array:
        """Return the transition over a piece of the grid of the state and of what the inner loop holds, ``(d + m, d +
        m)``; that of the state alone without an inner loop."""
        if not self.inner.acts:
            return Phi
        d, m = Phi.shape[0], self._control_matrices.shape[2]
        hold = np.eye(d + m)
        if piece in self.firsts:
            hold[d:] = np.hstack([self.inner.gains[self.grid.control_piece[piece]], np.zeros((m, m))])
        flow = np.eye(d + m)
        flow[:d] = np.hstack([Phi, Gamma @ self._control_matrices[piece]])
        return np.asarray(flow @ hold)

    @cached_property
    def _control_matrices(self) -> Array:
        """Columns of ``B`` through which the control acts on every piece of the grid, ``(L, d, m)``."""
        propagator = self.functionals.response.propagator
        return np.stack([self.inner.matrix(propagator, piece) for piece in range(self.grid.pieces)])

    @cached_property
    def _rounding_bounds(self) -> dict[bytes, tuple[Array, Array, Array, Array]]:
        return {}

    def sizes(self, x: Array, rows: Array) -> Array:
        """Return the largest ``|c'x|`` at the breakpoints under any deviation, ``(r,)`` of ``rows (r, d)``."""
        along = rows @ self.path(x)[0]
        return np.asarray(np.maximum(self.height(along), self.height(-along)).max(axis=0))

    def compute_flows(self, pieces: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """Return the matrices that propagate a state, and the terms that drive it, over the first ``durations (k,)`` of
        ``pieces (k,)`` of the grid."""
        if self.motion is None:
            return self.functionals.response.propagator.flows_in(pieces, durations)
        starts = self.grid.breakpoints[pieces]
        key = np.concatenate([starts, durations]).tobytes()
        if key not in self._flows:
            distinct, inverse = np.unique(np.stack([starts, starts + durations]), axis=1, return_inverse=True)
            flows, inverse = self.motion.expansion.flow(distinct[0], distinct[1]), inverse.reshape(-1)
            input_flow = np.concatenate([flows.control, flows.disturbance], axis=2)
            remember(self._flows, key, (flows.state[inverse], input_flow[inverse]), FLOWS_KEPT)
        return self._flows[key]

    def height(self, along: Array) -> Array:
        """Return ``max_w`` of functionals ``(..., 1 + Q)`` of the nominal state and the responses."""
        return np.asarray(along[..., 0] + self.spread.support(along[..., 1:]))

    def values(self, x: Array, times: Array, H: Array) -> Array:
        """Return ``max_w H x(t)`` at ``times (k,)`` for ``H (r, d)``: ``(k, r)``."""
        return self.height(H @ self.states(x, times))

    def worst(self, x: Array, time: float, direction: Array) -> Array:
        """Return a deviation ``(Q,)`` that attains the worst case of ``c'x(t)``."""
        along = direction @ self.states(x, np.array([time]))[0]
        return self.spread.worst(along[1:])

    def signal(self, deviation: Array) -> Array:
        """Return the disturbance ``(mw, L)`` on the pieces of the grid that has a deviation ``(Q,)``."""
        return np.asarray((self.entries @ (self.spread.middle + deviation)).T)

    def compute_initial_state(self, deviation: Array) -> Array:
        """Return the initial state ``(d,)`` of a deviation ``(Q,)``."""
        return np.asarray(self.start + self.begins @ deviation)


def deviations_of(
    bound: ConvexSet | None,
    blocks: int,
    initial: ConvexSet | None = None,
    noise: ConvexSet | None = None,
    measured: int = 0,
    periods: int = 1,
) -> Spread:
    """Return the deviations of a disturbance with values in ``bound``, ``blocks`` times, of a ``noise``, ``measured``
    times, and of the initial state where its own are in ``initial``, of so many ``periods``."""
    counted_sets = ((blocks, bound), (measured, noise), (periods, initial))
    return Spread(tuple((count, convex) for count, convex in counted_sets if convex is not None))
