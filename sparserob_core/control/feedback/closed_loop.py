"""What the state does when the control answers the disturbance: linear in the deviations, exactly, at all times.

With the effects ``F`` of the gains, the control on piece ``k`` is ``u_k = v_k + F_k w``, and the state
``x(t) = x_v(t) + sum_q y_q(t) w_q``: every ``y_q`` is the state of the same system from 0, driven by column ``q`` of
the effects and by its own entry of the disturbance; where the initial states are a set, its last columns begin there.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.feedback.innovations import KNOWN, Answers, innovations_seen
from sparserob_core.control.feedback.measurable import MeasurablePieces
from sparserob_core.control.feedback.observer import Observer, innovations_of
from sparserob_core.control.reach.functional import WorstCase
from sparserob_core.control.reach.measurable import MISSED
from sparserob_core.control.reach.varying_motion import VaryingMotion
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.finite import Spread, UncertainRows, table_of

if TYPE_CHECKING:
    from sparserob_core.control.response.response import Steps, TimeGrid

TERMS = 8  # of the Taylor expansion that bounds a curvature
ROUND_OFF = 2.0**-46  # of the numbers that are added up
FLOWS_KEPT = 8  # lists of times to which transitions of a system in t are remembered: each round asks for the same


@final
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The functionals of one system whose control answers what it sees.

    The decision ``x (n,)`` begins with the nominal control ``v (m, K)``, raveled; the variables of ``answers`` follow,
    and then whatever else the program has. ``spread``: the deviations of the disturbance, block after block (of
    ``measurable`` ones what they make of the state at the end of every piece of the grid), of the noise of what is
    measured, breakpoint after breakpoint, and of the initial state where there is a set of them. ``observer``: what
    makes innovations of outputs; they are those of the whole state where there is none. ``anew``: before those of the
    initial state come those of the next period's, of a plan that repeats, which only the step across the seam sees.
    """

    functionals: WorstCase
    answers: Answers
    spread: Spread
    variables: int
    measurable: MeasurablePieces | None = None
    observer: Observer | None = None
    anew: bool = False
    _paths: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)
    _flows: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    @property
    def nominal_size(self) -> int:
        """How many variables the nominal control has."""
        return self.functionals.variables

    @property
    def scales(self) -> bool:
        """Whether deviations are those of a disturbance alone, as it is, so that they can be `scaled`."""
        return self.measurable is None and len(self.spread.sets) == 1

    def scaled(self, factor: float) -> ClosedLoop:
        """The same loop where all deviations are ``factor`` times as large."""
        sets = tuple((count, convex.scaled(factor)) for count, convex in self.spread.sets)
        return replace(self, spread=replace(self.spread, sets=sets), _paths={})

    def nominal(self, x: Array) -> Array:
        """The nominal control ``(m, K)``."""
        return x[: self.nominal_size].reshape(-1, self.functionals.dictionary.pieces)

    def effects(self, x: Array) -> Array:
        """``F (K, m, Q)``."""
        return self.answers.effects(x[self.nominal_size : self.nominal_size + self.answers.variables])

    def gains(self, x: Array) -> Array:
        """``M (K, K, m, d)``."""
        return self.answers.gains(x[self.nominal_size : self.nominal_size + self.answers.variables])

    def written(self, x: Array | None) -> dict[str, Array]:
        """What is written down of how a decision answers: its `gains`, where there is a decision, and of outputs the
        ``observer (K, d, p)``."""
        observer = {} if self.observer is None else {"observer": self.observer.L}
        return observer if x is None else {"gains": self.gains(x), **observer}

    @cached_property
    def motion(self) -> VaryingMotion | None:
        """The system between all marks, where it changes with time."""
        (first, *_) = self.functionals.legs(KNOWN[0], KNOWN[0]) if self.functionals.response.grid.varying else (None,)
        return first if isinstance(first, VaryingMotion) else None

    @cached_property
    def grid(self) -> TimeGrid:
        """The pieces between whose ends nothing jumps; of a system that changes with time, on which it is one
        polynomial of it: ``L`` of them."""
        return self.functionals.response.grid if self.motion is None else self.motion.grid

    @cached_property
    def origin(self) -> np.ndarray:
        """The piece of the grid of control and disturbance that each of these is in, ``(L,)``."""
        return np.arange(self.grid.pieces) if self.motion is None else self.motion.origin

    @cached_property
    def steps(self) -> Steps:
        """Matrices and transitions of the system."""
        return self.functionals.response.steps(KNOWN)

    @cached_property
    def entries(self) -> Array:
        """Which entries of the deviations act on every piece of the grid, and how: ``(L, mw, Q)``."""
        model, grid = self.functionals.disturbance, self.functionals.response.grid
        width = self.functionals.response.system.disturbances
        table = np.zeros((grid.pieces, width, self.spread.size))
        if model is not None and self.measurable is None:
            assert model.starts is not None
            block = np.searchsorted(model.starts, np.arange(grid.pieces), side="right") - 1
            for i in range(width):
                table[np.arange(grid.pieces), i, block * width + i] = 1.0
        return table

    @cached_property
    def begins(self) -> Array:
        """Which entries of the deviations are those of the initial state, ``(d, Q)``."""
        d = self.functionals.response.initial_state.size
        count = 0 if self.functionals.initial is None else d
        return np.hstack([np.zeros((d, self.spread.size - count)), np.eye(d, count)])

    @property
    def noise(self) -> slice:
        """Which entries of the deviations are those of the noise; none where there is none."""
        last = self.spread.size - int(self.begins.sum()) * (1 + self.anew)
        noisy = self.observer is not None and self.observer.noisy
        return slice(last - (self.answers.shape[0] * self.answers.shape[3] if noisy else 0), last)

    def noises(self, deviation: Array) -> Array | None:
        """The noise ``(K, p)`` of a deviation ``(Q,)``; ``None`` where there is none."""
        point = (self.spread.middle + deviation)[self.noise]
        return point.reshape(self.answers.shape[0], -1) if point.size else None

    @cached_property
    def innovations(self) -> Array:
        """What every innovation is of the deviations, ``(K, p, Q)``."""
        problem, begun = self.functionals, int(self.begins.sum())
        seen = innovations_seen(
            problem.response, problem.dictionary, problem.disturbance, begun > 0, pieces=self.measurable
        )
        return innovations_of(seen, begun, self.observer, self.anew)

    @cached_property
    def expected(self) -> tuple[Array, Array]:
        """The least and the largest of every innovation, ``(K, p)`` each."""
        return -self.spread.support(-self.innovations), self.spread.support(self.innovations)

    @cached_property
    def following(self) -> Array:
        """Which entries of the deviations are those of the next period's initial state, ``(d, Q)``."""
        d = self.begins.shape[0]
        return np.roll(self.begins, -d, axis=1) * self.anew

    @cached_property
    def start(self) -> Array:
        """The initial state ``(d,)`` that deviations are counted from."""
        begun: Array = self.functionals.response.initial_state + self.begins @ self.spread.middle
        return begun

    @cached_property
    def middles(self) -> Array:
        """The middle of the disturbance on every piece of the grid, ``(L, mw)``."""
        if self.measurable is not None:
            return np.tile(self.measurable.middle, (self.functionals.response.grid.pieces, 1))
        return np.asarray(self.entries @ self.spread.middle)

    def inputs(self, x: Array) -> Array:
        """What acts on the pieces of the grid, nominally and as answers: control, drift and disturbance, ``(L, m + mw,
        1 + Q)``."""
        grid, m, origin = self.grid, self.answers.shape[1], self.origin
        nominal = np.concatenate([grid.inputs(self.nominal(x)).T[:, :, None], self.middles[origin, :, None]], axis=1)
        acts, entries = grid.control_piece >= 0, self.entries[origin]
        answered = np.zeros((*nominal.shape[:2], entries.shape[2]))
        answered[:, nominal.shape[1] - entries.shape[1] :] = entries
        answered[acts, :m] = self.effects(x)[grid.control_piece[acts]]
        return np.concatenate([nominal, answered], axis=2)

    def drives(self, x: Array) -> Array:
        """What drives the nominal state and every response, on the pieces of the grid: ``(L, d, 1 + Q)``; of a system
        that changes with time, through which matrices too, so that it is the `inputs` themselves."""
        if self.motion is not None:
            return self.inputs(x)
        B, E = (self.grid.of_modes(matrices)[self.grid.modes] for matrices in (self.steps.B[0], self.steps.E[0]))
        return np.asarray(np.concatenate([B, E], axis=2) @ self.inputs(x))

    def path(self, x: Array) -> tuple[Array, Array]:
        """The nominal state and every response at the breakpoints of the grid, ``(L + 1, d, 1 + Q)``, and what drives
        them; those of the last few decisions are remembered. What measurable disturbances have done is told when a
        piece is over."""
        key = x.tobytes()
        if key not in self._paths:
            response, drives, motion = self.functionals.response, self.drives(x), self.motion
            Phi, Gamma, which = self.steps.Phi[0], self.steps.Gamma[0], response.which
            if motion is not None:
                Phi, Gamma, which = motion.flow.state, motion.inputs, motion.every
            nodes = np.zeros((drives.shape[0] + 1, self.start.size, drives.shape[2]))
            nodes[0] = np.column_stack([self.start, self.begins])
            over = np.append(np.diff(self.origin) > 0, True)
            for piece, length in enumerate(which.tolist()):
                nodes[piece + 1] = Phi[length] @ nodes[piece] + Gamma[length] @ drives[piece]
                if self.measurable is not None and over[piece]:
                    place, outward = self.measurable.at(int(self.origin[piece]))
                    nodes[piece + 1, :, 1:][:, place] += outward
            while len(self._paths) > 1:
                self._paths.pop(next(iter(self._paths)))
            self._paths[key] = (nodes, drives)
        return self._paths[key]

    def states(self, x: Array, times: Array, pieces: np.ndarray | None = None) -> Array:
        """The nominal state and every response at ``times (k,)``, which lie in these pieces: ``(k, d, 1 + Q)``."""
        pieces = self.grid.locate(times) if pieces is None else pieces
        nodes, drives = self.path(x)
        flow, driven = self._flows_in(pieces, np.clip(times - self.grid.breakpoints[pieces], 0.0, None))
        return np.asarray(flow @ nodes[pieces] + driven @ drives[pieces])

    def _enclosed(self, x: Array, times: Array, pieces: np.ndarray) -> tuple[Array, Array]:
        """The `states` at ``times (k,)`` on these pieces, and their rounding error under any deviation, ``(k, d)``."""
        nodes, drives = self.path(x)
        flow, driven = self._flows_in(pieces, np.clip(times - self.grid.breakpoints[pieces], 0.0, None))
        sizes, pushed, errors = self._rounded(x)
        added = np.abs(flow) @ sizes[pieces, :, None] + np.abs(driven) @ pushed[pieces, :, None]
        off = ROUND_OFF * added + np.abs(flow) @ errors[pieces, :, None]
        return np.asarray(flow @ nodes[pieces] + driven @ drives[pieces]), off[:, :, 0]

    def _rounded(self, x: Array) -> tuple[Array, Array, Array]:
        """The sizes of the nodes ``(L + 1, d)`` and of what drives them ``(L, ..)`` under any deviation, and the
        rounding error of every node.

        Each step rounds `ROUND_OFF` of what it adds up, and the transitions to the node amplify that. Those of a system
        that changes with time are counted by its motion.
        """
        key = x.tobytes()
        if key not in self._errors:
            (nodes, drives), radii = self.path(x), np.concatenate([[1.0], self.spread.radii])
            sizes, pushed = np.abs(nodes) @ radii, np.abs(drives) @ radii
            errors = np.zeros_like(sizes)
            if self.motion is None:
                Phi, Gamma, which = self.steps.Phi[0], self.steps.Gamma[0], self.functionals.response.which
                every = np.empty((which.size, *Phi.shape[1:]))
                step = np.einsum("kij,kj->ki", np.abs(Phi)[which], sizes[:-1])
                step = ROUND_OFF * (step + np.einsum("kij,kj->ki", np.abs(Gamma)[which], pushed))
                for piece, length in enumerate(which.tolist()):
                    every[:piece] = Phi[length] @ every[:piece]
                    every[piece] = np.eye(self.start.size)
                    errors[piece + 1] = np.einsum("kij,kj->i", np.abs(every[: piece + 1]), step[: piece + 1])
            self._errors.clear()
            self._errors[key] = sizes, pushed, errors
        return self._errors[key]

    @cached_property
    def _errors(self) -> dict[bytes, tuple[Array, Array, Array]]:
        return {}

    def sizes(self, x: Array, rows: Array) -> Array:
        """Return the largest ``|c'x|`` at the breakpoints under any deviation, ``(r,)`` of ``rows (r, d)``."""
        along = rows @ self.path(x)[0]
        return np.asarray(np.maximum(self.height(along), self.height(-along)).max(axis=0))

    def _flows_in(self, pieces: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """What the first ``durations (k,)`` of ``pieces (k,)`` of the grid make of a state, and of what drives it."""
        if self.motion is None:
            return self.functionals.response.flows_in(pieces, durations)
        starts = self.grid.breakpoints[pieces]
        key = np.concatenate([starts, durations]).tobytes()
        if key not in self._flows:
            distinct, which = np.unique(np.stack([starts, starts + durations]), axis=1, return_inverse=True)
            over, which = self.motion.expansion.flow(distinct[0], distinct[1]), which.reshape(-1)
            driven = np.concatenate([over.control, over.disturbance], axis=2)
            remember(self._flows, key, (over.state[which], driven[which]), FLOWS_KEPT)
        return self._flows[key]

    def height(self, along: Array) -> Array:
        """``max_w`` of functionals ``(..., 1 + Q)`` of the nominal state and the responses."""
        return np.asarray(along[..., 0] + self.spread.support(along[..., 1:]))

    def values(self, x: Array, times: Array, H: Array) -> Array:
        """``max_w H x(t)`` at ``times (k,)`` for ``H (r, d)``: ``(k, r)``."""
        found = self.height(H @ self.states(x, times))
        return found if self.measurable is None else found + self.measurable.within(times, H)

    def bounds(self, x: Array, lower: Array, upper: Array, H: Array) -> Array:
        """Upper bounds ``(k, r)`` of ``max_w H x(t)`` over cells of time ``[lower, upper] (k,)``, each within one piece
        of the grid."""
        return self.bounded(x, lower, upper, H)[0]

    def bounded(
        self,
        x: Array,
        lower: Array,
        upper: Array,
        H: Array,
        beside: tuple[Array, Array] | None = None,
    ) -> tuple[Array, Array]:
        """The bounds, ``H (r, d)`` or ``(k, r, d)``, and how much of each is owed to the length of the cell;
        ``beside``: what is added at both ends, ``(k, r, 1 + Q)`` or ``(k, r, 1)`` each, and linear between.

        On a cell every functional is within ``(b - a)^2 / 8`` times its largest second derivative of its chord, and a
        support function of a chord lies below the chord of the support functions.
        """
        pieces = self.grid.locate((lower + upper) / 2)
        states, off = self._enclosed(x, np.concatenate([lower, upper]), np.tile(pieces, 2))
        ends, off = np.split(states, 2), np.maximum(*np.split(off, 2))
        along = [H @ end for end in ends]
        radii = np.concatenate([[1.0], self.spread.radii])
        late = self._late(x, H, lower, upper - lower, pieces, ends[0])
        size = np.abs(H) @ np.maximum(np.abs(ends[0]), np.abs(ends[1]))
        for end, more in zip(along, beside or (), strict=False):
            end[..., : more.shape[-1]] += more
            size[..., : more.shape[-1]] += np.abs(more)
        found, lost = [self.height(one) for one in along], ROUND_OFF * (size @ radii)
        lost += (np.abs(H) @ off[:, :, None])[:, :, 0]
        if self.motion is not None:
            lost += (np.abs(H) @ self._left_out(x, self.motion)[pieces][:, :, None])[:, :, 0]
        if self.measurable is not None:
            under_way = self.origin[pieces]
            inside = (self.measurable.within(end, H, under_way) for end in (lower, upper))
            found = [value + more for value, more in zip(found, inside, strict=True)]
            lost += self.measurable.allowance(lower, upper, H, under_way) + MISSED * (size @ radii)
        most = np.maximum(*found) + late + lost
        return np.where(np.isnan(most), np.inf, most), late

    def _late(self, x: Array, H: Array, start: Array, width: Array, pieces: np.ndarray, states: Array) -> Array:
        """How far ``H x(t)`` may be from its chord on ``[start, start + width]``, each within one of the ``pieces
        (k,)``, from ``states (k, d, 1 + Q)`` at the start, for any deviations: ``(k, r)``."""
        drives, radii = self.path(x)[1][pieces], np.concatenate([[1.0], self.spread.radii])
        if self.motion is not None:
            return self.motion.bent(H, start, width, pieces, states, drives, radii)
        modes = self.grid.modes[pieces]
        A = self.steps.A[0, modes]  # (1, d, d) of one system, (k, d, d) of several
        h, rates = width[:, None, None], A @ states + drives
        row, factor = H @ A, np.ones_like(h)
        second = np.zeros((start.size, H.shape[-2], radii.size))
        for order in range(TERMS):
            second += factor * np.abs(row @ rates)
            row, factor = row @ A, factor * h / (order + 1)
        growth = np.linalg.norm(self.steps.A[0], 2, axis=(1, 2))[modes, None, None] * h
        with np.errstate(over="ignore", invalid="ignore"):
            tail = (
                factor
                * np.exp(growth)
                * np.linalg.norm(row, axis=-1)[..., None]
                * np.linalg.norm(rates, axis=1, keepdims=True)
            )
        return np.asarray((h[..., 0] ** 2 / 8.0) * ((second + tail) @ radii))

    def _left_out(self, x: Array, motion: VaryingMotion) -> Array:
        """What the transitions of a system that changes with time may be off by, on every piece, ``(L, d)``."""
        nodes, inputs = self.path(x)
        radii = np.concatenate([[1.0], self.spread.radii])
        begun, pushed = np.abs(nodes[:-1]) @ radii, motion.flow.sizes * (np.abs(inputs) @ radii)[:, None]
        if self.measurable is not None:
            under_way, driven = self.measurable.reached
            begun, pushed = begun + under_way, np.concatenate([pushed, driven], axis=2)
        return motion.left_out(begun, pushed)

    def worst(self, x: Array, time: float, direction: Array) -> Array:
        """A deviation ``(Q,)`` that attains the worst case of ``c'x(t)``."""
        along = direction @ self.states(x, np.array([time]))[0]
        return self.spread.worst(along[1:])

    def seen_from(self, times: Array, acting: np.ndarray | None = None) -> np.ndarray:
        """The pieces ``(k,)`` of the grid in which the state at ``times (k,)`` is looked at. A breakpoint is one of the
        piece that it ends; but where the control on a piece ``acting (k,)`` stands beside the state, which begins then,
        of that: this control has answered what happened before."""
        ends, found = self.functionals.dictionary.breakpoints, self.grid.locate(times)
        return found if acting is None else np.maximum(found, np.searchsorted(self.grid.commanded(ends), acting))

    def signal(
        self, deviation: Array, time: float, direction: Array | None, acting: int | None = None
    ) -> tuple[Array, Array]:
        """Breakpoints and the disturbance ``(mw, L)`` between them that has a deviation ``(Q,)``: on the pieces of the
        grid, or measurable and the worst for ``direction'x(time)`` on the piece that holds ``time``, where the control
        on piece ``acting`` may stand beside it."""
        if self.measurable is not None:
            beside = None if acting is None else np.array([acting])
            over = int(self.origin[self.seen_from(np.array([time]), beside)[0]])
            return self.measurable.signal(deviation, time, direction, over)
        return self.functionals.response.grid.breakpoints, (self.entries @ (self.spread.middle + deviation)).T

    def begun(self, deviation: Array) -> Array:
        """The initial state ``(d,)`` of a deviation ``(Q,)``."""
        return np.asarray(self.start + self.begins @ deviation)

    def state_rows(
        self, time: float, H: Array, h: Array, part: np.ndarray, factor: Array, acting: np.ndarray | None = None
    ) -> UncertainRows:
        """The rows ``H x(t) <= h`` at one time, beside the control on the pieces ``acting (r,)`` where that is given,
        as `UncertainRows`: row ``r`` is ``factor_r`` times the direction of its ``part_r``, the first row with which it
        shares it."""
        count = H.shape[0]
        firsts = [int(np.flatnonzero(part == p)[0]) for p in range(int(part.max()) + 1)]
        free, weights, on_noise = self.functionals.response.weights(np.full(count, time), H, np.zeros((count, 0)))
        on_control = self.functionals.on_decision(weights)  # (r, m K), channel-major
        offset = free @ self.start + self.functionals.given(weights)
        offset = offset + np.einsum("rli,li->r", on_noise, self.middles)
        K = self.functionals.dictionary.pieces
        at, which, value = self.answers.effect
        m, Q = self.answers.shape[1], self.spread.size
        position, entry = at // Q, at % Q
        piece, channel = position // m, position % m
        parts = []
        for first in firsts:
            data = on_control[first].reshape(m, K)[channel, piece] * value
            kept = data != 0.0
            parts.append(table_of(entry[kept], self.nominal_size + which[kept], data[kept], (Q, self.variables)))
        rows, columns = np.nonzero(on_control)
        g = table_of(rows, columns, on_control[rows, columns], (count, self.variables))
        d = np.einsum("pli,liq->pq", on_noise[firsts], self.entries) + free[firsts] @ self.begins
        if self.measurable is not None:
            pieces = self.origin[self.seen_from(np.full(count, time), acting)]
            d[:, : self.measurable.size] = self.measurable.weights(time, H[firsts], pieces[firsts])
            for piece in np.unique(pieces):
                rows = pieces == piece
                offset[rows] += self.measurable.within(np.array([time]), H[rows], np.array([piece]))[0]
        return UncertainRows(g, h - offset, part, factor, tuple(parts), d)

    def with_control(self, rows: UncertainRows, G: Array, pieces: np.ndarray, following: bool = False) -> UncertainRows:
        """The rows with ``G u_k`` added on the left, ``G (r, m)``, of the piece ``k`` of each, ``(r,)``; rows of one
        part have the same direction of the control, times their factors, and the same piece. ``following``: the first
        control of the next period, which answers that one's initial state."""
        from scipy.sparse import csr_array

        K, Q = self.functionals.dictionary.pieces, self.spread.size
        row, channel = np.nonzero(G)
        place = (row, channel * K + pieces[row])
        g = csr_array(rows.g + csr_array((G[row, channel], place), shape=rows.g.shape))
        parts = []
        for p, C in enumerate(rows.C):
            first = int(np.flatnonzero(rows.part == p)[0])
            at, which, value = self.of_piece(int(pieces[first]))
            seen = at % Q - following * self.begins.shape[0]
            added = csr_array((G[first][at // Q] * value, (seen, self.nominal_size + which)), shape=C.shape)
            parts.append(csr_array(C + added))
        return replace(rows, g=g, C=tuple(parts))

    def control_rows(self, piece: int, H: Array, h: Array, extra: Array | None = None) -> UncertainRows:
        """The rows ``H u_k <= h`` on one piece for every deviation; ``extra (r, n)`` is added on the left."""
        part, factor = shared(H, self.spread)
        firsts = [int(np.flatnonzero(part == p)[0]) for p in range(int(part.max()) + 1)]
        at, which, value = self.of_piece(piece)
        Q, K = self.spread.size, self.functionals.dictionary.pieces
        channel, entry = at // Q, at % Q
        parts = []
        for first in firsts:
            data = H[first][channel] * value
            kept = data != 0.0
            parts.append(table_of(entry[kept], self.nominal_size + which[kept], data[kept], (Q, self.variables)))
        rows, channels = np.nonzero(H)
        columns, values = channels * K + piece, H[rows, channels]
        if extra is not None:
            more = np.nonzero(extra)
            rows, columns = np.concatenate([rows, more[0]]), np.concatenate([columns, more[1]])
            values = np.concatenate([values, extra[more]])
        g = table_of(rows, columns, values, (H.shape[0], self.variables))
        return UncertainRows(g, h, part, factor, tuple(parts), np.zeros((len(firsts), Q)))

    def controls(self, x: Array) -> Array:
        """The nominal control and its answers to the deviations on every piece, ``(K, m, 1 + Q)``."""
        return np.concatenate([self.nominal(x).T[:, :, None], self.effects(x)], axis=2)

    def of_piece(self, piece: int) -> tuple[np.ndarray, np.ndarray, Array]:
        """Of `Answers.effect` what is about one piece: positions in ``(m, Q)``, variables and values."""
        at, which, value = self.answers.effect
        first, last = self._bounds_of_pieces[piece : piece + 2]
        m, Q = self.answers.shape[1], self.spread.size
        return at[first:last] - piece * m * Q, which[first:last], value[first:last]

    @cached_property
    def _bounds_of_pieces(self) -> np.ndarray:
        """Where the entries of `Answers.effect` of every piece begin; they come piece by piece."""
        K, m, Q, _ = self.answers.shape
        return np.searchsorted(self.answers.effect[0] // max(1, m * Q), np.arange(K + 1))


def shared(H: Array, spread: Spread) -> tuple[np.ndarray, Array]:
    """Which rows of ``H (r, d)`` look the same way or, where deviations are symmetric, opposite ways: the part of every
    row and the factor that it is of the first row of that part."""
    part, factor = np.zeros(H.shape[0], dtype=int), np.ones(H.shape[0])
    firsts: list[int] = []
    for row in range(H.shape[0]):
        for p, first in enumerate(firsts):
            at = int(np.abs(H[first]).argmax())
            share = H[row, at] / H[first, at]
            if np.array_equal(H[row], share * H[first]) and (share > 0.0 or spread.is_symmetric):
                part[row], factor[row] = p, share
                break
        else:
            part[row] = len(firsts)
            firsts.append(row)
    return part, factor


def deviations_of(
    bound: ConvexSet | None,
    blocks: int,
    initial: ConvexSet | None = None,
    noise: ConvexSet | None = None,
    measured: int = 0,
    periods: int = 1,
) -> Spread:
    """The deviations of a disturbance with values in ``bound``, ``blocks`` times, of a ``noise``, ``measured`` times,
    and of the initial state where its own are in ``initial``, of so many ``periods``."""
    every = ((blocks, bound), (measured, noise), (periods, initial))
    return Spread(tuple((count, one) for count, one in every if one is not None))
