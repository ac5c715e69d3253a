"""Information that a causal control has about a signal, and the worst continuations that it cannot exclude.

A causal control is a function of the reports that it has received: it is the same under two signals with the same
reports. Where nothing hides a disturbance, its blocks are the reports. Where outputs are measured with a noise, the
outputs are the reports. Two disturbances have the same reports if their outputs differ by no more than the noise can
make up: each signal comes with the noise that makes up the difference, ``v_j = eta_j - C x_j(w)``. So a signal is a
disturbance, an initial state and a history ``eta`` of outputs, relative to the outputs of the nominal signal. All
signals whose noises are in their set are possible. This describes, signal by signal, the set of states that are
possible after a history (Witsenhausen 1968; Bertsekas and Rhodes 1971).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import final

import numpy as np

from sparserob_core.control.feedback.closed_loop import ClosedLoop
from sparserob_core.control.feedback.innovations import build_innovations
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.finite import Spread
from sparserob_core.sip.inner.simplex.counterpart import Growing

# Of a set's size, what is used of it: what hides is derived in balls, and must be proven to be in its set. Ten times
# closer to 1 and a linear program's rounding is as large, ten times farther and bounds are lower by what is seen.
ROOM = 1.0 - 1e-7
KEPT = 1.0 + 2e-8  # of what is left, what a solution may take
NONE = 1e-9  # of a size, below which a number is rounding
LOOKED = 12  # of these for every signal, before what was found is imposed and the tree is solved again
EACH = 3  # rows for which a signal that leaves another one at a report is looked for
TRIED = 200  # signals that a round looks at by a linear program each
CORNERS = 8  # outputs at once up to which the 2^p corners of a box are looked at


class Knowledge(ABC):
    """Information of a causal control about signals.

    Signals are arrays that begin with the deviations ``(Q,)``. The number of reports that every piece of the control
    knows is ``known_reports (K,)``. The rows ``N (R, Q)`` are linear functions of the deviations; ``past_reports (R,)``
    is the number of reports that are older than the time of each row.
    """

    N: Array
    known_reports: np.ndarray
    past_reports: np.ndarray
    work: float = 0.0

    @property
    @abstractmethod
    def reports(self) -> int:
        """Number of reports of a signal."""

    @property
    @abstractmethod
    def nominal(self) -> Array:
        """The nominal signal."""

    @property
    @abstractmethod
    def contribution_bounds(self) -> Array:
        """Upper bounds ``(R,)`` of the contribution of the deviations to every row."""

    @abstractmethod
    def history(self, signal: Array, reports: int) -> bytes:
        """Return the first ``reports`` reports of a signal as bytes; equal bytes mean that a control cannot distinguish
        two signals."""

    @abstractmethod
    def gives(self, signals: Array, offsets: Array) -> Array:
        """Return the largest contribution of the deviations to every row, among signals whose first reports are those
        of a given signal: ``(S, R, reports + 1)``.

        Where this value plus ``offsets``, of the same shape, is not above 0, any number may stand instead that keeps
        the sum at or below 0.
        """

    @abstractmethod
    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """Return the largest contribution of the deviations to a row, among signals whose first ``report`` reports are
        those of the given signal, and a signal that attains it."""

    @abstractmethod
    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """Yield signals that depart from a given one at a report and are the worst for a row from there on.

        Every item holds the number of the given signal, the number of the report, and the new signal. Signals whose row
        has the largest excess come first.

        Parameters
        ----------
        signals : ndarray, shape (S, ...)
            Given signals.
        own : ndarray, shape (S, R)
            Values of the rows under each signal without the deviations. A control is part of them.
        answered : ndarray, shape (R, ...), optional
            Coefficients, in every row, of the control's response to deviations, and to noises, that differ from those
            of the signal. Without it the control does not respond.
        scale : float
            Factor of all deviations.
        units : ndarray, shape (R,)
            Units in which the excess of the rows is compared.
        """

    @abstractmethod
    def known(self, z: Array) -> Array:
        """Return the signal of a disturbance with the deviations ``z (Q,)``."""

    @cached_property
    def first(self) -> np.ndarray:
        """The first piece that may know of a report, ``(reports + 1,)``."""
        return np.searchsorted(self.known_reports, np.arange(self.reports + 1), side="right")


@final
@dataclass(eq=False)
class OfDisturbances(Knowledge):
    """Information of a control from which nothing hides the disturbance. Reports are the blocks of the disturbance,
    ``width`` deviations each, all in ``spread``."""

    N: Array
    spread: Spread
    width: int
    known_reports: np.ndarray
    past_reports: np.ndarray
    work: float = 0.0

    @property
    def reports(self) -> int:
        """Number of blocks of the disturbance."""
        return int(self.N.shape[1] // max(1, self.width))

    @property
    def nominal(self) -> Array:
        """No deviation."""
        return np.zeros(self.N.shape[1])

    @cached_property
    def worst(self) -> Array:
        """The deviations that are the worst for every row, ``(R, Q)``."""
        return extreme(self.spread, self.N)

    @cached_property
    def contribution_bounds(self) -> Array:
        """Upper bounds ``(R,)`` of the contribution of the worst deviations to every row."""
        return np.asarray(np.abs(self.N * self.worst).sum(axis=1))

    def history(self, signal: Array, reports: int) -> bytes:
        """Return the deviations bit by bit."""
        return signal[: reports * self.width].tobytes()

    def gives(self, signals: Array, offsets: Array) -> Array:
        """Return the contribution of the signal's own blocks, plus that of the worst blocks from every report on."""
        return sums(self.by_block(self.N * signals[:, None]).sum(axis=3)) + self._later_support_values

    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """Return the largest contribution to the row, and the signal with the blocks that are the worst for the row
        from ``report`` on."""
        stop, start, z = self.past_reports[row] * self.width, report * self.width, signal.copy()
        z[start:stop] = self.worst[row, start:stop]
        return float(self.N[row, :start] @ z[:start]) + float(self._later_support_values[row, report]), z

    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """Find the signals in closed form, for all rows and reports."""
        responses = np.zeros_like(self.N) if answered is None else answered[:, : self.N.shape[1]]
        closed = responses + self.N
        closed = np.where(np.abs(closed) > NONE * np.abs(self.N), closed, self.N * NONE)
        worst = extreme(self.spread, closed)
        past_values = sums(self.by_block(self.N * signals[:, None]).sum(axis=-1))
        later_responses = self._sum_later_blocks(responses * signals[:, None])
        excess = own[:, :, None] + scale * (past_values - later_responses + self._sum_later_blocks(closed * worst))
        excess = excess / units[:, None]
        excess[:, :, -1] = -np.inf
        excess = np.where(np.arange(excess.shape[2]) < self.past_reports[:, None], excess, -np.inf)
        for flat_index in np.argsort(-excess, axis=None).tolist():
            signal, row, report = (int(v) for v in np.unravel_index(flat_index, excess.shape))
            if excess[signal, row, report] <= NONE:
                return
            child = signals[signal].copy()
            child[report * self.width :] = worst[row, report * self.width :]
            yield signal, report, child

    def known(self, z: Array) -> Array:
        """Return the deviations, which are the signal."""
        return z

    def _sum_later_blocks(self, a: Array) -> Array:
        past = sums(self.by_block(a).sum(axis=-1))
        return np.asarray(past[..., -1:] - past)

    @cached_property
    def _later_support_values(self) -> Array:
        """The most that the disturbance from every block on gives to every row, ``(R, blocks + 1)``."""
        gives = self.by_block(self.N * self.worst).sum(axis=2)
        return sums(gives[:, ::-1])[:, ::-1]

    def by_block(self, a: Array) -> Array:
        """Return numbers of every deviation, block by block."""
        return a.reshape(*a.shape[:-1], self.reports, max(1, self.width))


@final
@dataclass(eq=False)
class OfOutputs(Knowledge):
    """Information of a control that measures outputs with a noise.

    Reports are outputs ``(p,)``. A signal is the deviations and then the outputs relative to the nominal ones,
    ``(Q + J p,)``. Once ``work`` exceeds ``limit``, or the time has ``passed``, no further program is solved, and what
    only such a program can find counts as unknown.

    Parameters
    ----------
    N : ndarray, shape (R, Q)
        Rows on the deviations.
    C : ndarray, shape (J, p, Q)
        Contribution of the deviations to each output.
    spread : Spread
        Set of the deviations of disturbance and initial state.
    hidden : tuple of ndarray
        Half-spaces ``(H, h)``, about the middle, of the values that the noise can certainly add to an output.
    noise : Spread
        Noises of all outputs, about their middle.
    place : slice
        Entries of the noise among all deviations of the loop.
    known_reports : ndarray, shape (K,)
        Number of reports that every piece of the control knows.
    past_reports : ndarray, shape (R,)
        Number of reports that are older than the time of each row.
    limit : float
        Largest work.
    passed : callable
        Function that says whether the time is over.
    """

    N: Array
    C: Array
    spread: Spread
    hidden: tuple[Array, Array]
    noise: Spread
    place: slice
    known_reports: np.ndarray
    past_reports: np.ndarray
    limit: float = np.inf
    passed: Callable[[], bool] = lambda: False
    work: float = 0.0
    _worst_cases: dict[tuple[bytes, int], tuple[float, Array]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._program, (H, h) = Growing(), self.hidden
        self._imposed_history: bytes | None = None
        for entries, count, convex, middle in self.spread.parts:
            low, high = np.full(convex.dimension, -np.inf), np.full(convex.dimension, np.inf)
            if convex.is_box:
                box = convex.bounding_box()
                low, high = box.lower - middle, box.upper - middle
            units = self._column_units[entries]
            none = np.zeros(units.size)
            columns = self._program.variables(np.tile(low, count) / units, np.tile(high, count) / units, none)
            flat = None if convex.is_box else about(convex)
            if flat is None:
                continue
            row, channel = np.nonzero(flat[0])
            for copy in columns.reshape(count, -1):
                coefficients = flat[0][row, channel] * self._column_units[copy[channel]] / flat[1][row]
                none = np.full(flat[1].size, -np.inf)
                self._program.rows([(row, copy[channel], coefficients)], none, np.ones(flat[1].size))
        self._row_numbers = np.zeros((self.reports, h.size), dtype=int)
        for report, output_matrix in enumerate(self.C):
            coefficients = -(H @ output_matrix) * self._column_units / h[:, None]
            row, column = np.nonzero(coefficients)
            free = np.full(h.size, np.inf)
            self._row_numbers[report] = self._program.rows([(row, column, coefficients[row, column])], -free, free)

    @staticmethod
    def of(
        loop: ClosedLoop, N: Array, times: Array, measured: Array, known_reports: np.ndarray, share: float
    ) -> OfOutputs | None:
        """Return the knowledge of a loop that measures outputs with a noise.

        Parameters
        ----------
        loop : ClosedLoop
            Loop with an observer.
        N : ndarray, shape (R, Q)
            Rows on the deviations of disturbance and initial state.
        times : ndarray, shape (R,)
            Times of the rows.
        measured : ndarray, shape (K,)
            Times of the measurements.
        known_reports : ndarray, shape (K,)
            Number of reports that every piece of the control knows.
        share : float
            Factor of the sets of the noise and of the initial states.

        Returns
        -------
        OfOutputs or None
            ``None`` where there is no noise, or where one of the sets, other than the box of a disturbance or of
            initial states, has no half-spaces about its middle.
        """
        observer, sets, initial_count = loop.observer, loop.spread.sets, int(loop.begins.sum())
        if observer is None or not observer.noisy:
            return None
        noise_position = int(loop.noise.start > 0)  # whether a disturbance stands before the noise
        noise = sets[noise_position][1].scaled(share)
        initial_sets = [(1, sets[-1][1].scaled(share))] if initial_count else []
        spread, hidden = Spread((*sets[:noise_position], *initial_sets)), hiding(noise)
        if hidden is None or any(about(convex) is None and not convex.is_box for _, convex in spread.sets):
            return None
        plain, problem = replace(observer, L=np.zeros_like(observer.L)), loop.functionals
        entering = build_innovations(problem.response, problem.dictionary, problem.disturbance, initial_count > 0)
        outputs = plain.compute_innovations(entering, initial_count)
        C = np.concatenate([outputs[:, :, : loop.noise.start], outputs[:, :, loop.noise.stop :]], axis=2)
        begins = np.searchsorted(measured, times)
        return OfOutputs(N, C, spread, hidden, Spread(((measured.size, noise),)), loop.noise, known_reports, begins)

    @property
    def reports(self) -> int:
        """Number ``J`` of measured outputs ``(p,)``."""
        return int(self.C.shape[0])

    @property
    def nominal(self) -> Array:
        """No deviation, and nothing beside the nominal outputs."""
        return np.zeros(self.N.shape[1] + self.C.shape[0] * self.C.shape[1])

    @cached_property
    def contribution_bounds(self) -> Array:
        """Largest contribution ``(R,)`` of the deviations to every row, whatever the outputs."""
        return self.spread.support(self.N)

    def outputs(self, signal: Array) -> Array:
        """Return the outputs ``(J, p)`` of a signal, relative to the nominal ones."""
        return signal[self.N.shape[1] :].reshape(self.C.shape[:2])

    def history(self, signal: Array, reports: int) -> bytes:
        """Return the outputs bit by bit."""
        return self.outputs(signal)[:reports].tobytes()

    def signal(self, z: Array, reference: Array, noise: Array, reports: int) -> Array:
        """Return the signal of deviations ``z (Q,)`` whose first ``reports`` outputs are those of the signal
        ``reference``, and whose later outputs have this ``noise (J, p)``."""
        outputs = self.C @ z + noise
        outputs[:reports] = self.outputs(reference)[:reports]
        return np.concatenate([z, outputs.ravel()]) + 0.0

    def gives(self, signals: Array, offsets: Array) -> Array:
        """Solve one linear program for each row and report, the most promising ones first.

        For a signal, this ends when at least `LOOKED` programs were solved and some row is above 0. Entries that were
        not found are ``-inf``.
        """
        values = np.full(offsets.shape, -np.inf)
        for signal_values, offset, signal in zip(values, offsets, signals, strict=True):
            bounds, is_known = (
                np.broadcast_to(self.contribution_bounds[:, None], offset.shape).copy(),
                np.zeros(offset.shape, dtype=bool),
            )
            for report in range(1, self.reports + 1):
                history = self.history(signal, report)
                for row in np.flatnonzero(bounds[:, report] + offset[:, report] > 0.0).tolist():
                    if (history, row) in self._worst_cases:
                        bounds[row, report], is_known[row, report] = self._find_worst_case(signal, row, report)[0], True
            is_known[:, 0] = True
            signal_values[is_known] = bounds[is_known]
            bounds = np.minimum.accumulate(bounds, axis=1)  # what is hidden for longer gives no more
            is_above, solved = bool((signal_values + offset > 0.0).any()), 0
            promise = np.where(is_known, -np.inf, bounds + offset)
            for flat_index in np.argsort(-promise, axis=None).tolist():
                row, report = divmod(flat_index, self.reports + 1)
                if not promise[row, report] > 0.0 or (is_above and solved >= LOOKED):
                    break
                signal_values[row, report] = self._find_worst_case(signal, row, report)[0]
                is_above, solved = is_above or bool(signal_values[row, report] + offset[row, report] > 0.0), solved + 1
        return values

    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """Return the largest contribution to the row, and the signal of the worst deviations that a noise within its
        set hides for ``report`` reports."""
        worst = self._find_worst_case(signal, row, report)
        return worst[0], self.signal(worst[1], signal, np.zeros(self.C.shape[:2]), report)

    def _find_worst_case(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        key = self.history(signal, report), row
        if key not in self._worst_cases:
            worst = self.along(self.N[row], signal, report)
            self._worst_cases[key] = (-np.inf, np.zeros(0)) if worst is None else worst
        return self._worst_cases[key]

    def along(self, direction: Array, signal: Array, reports: int) -> tuple[float, Array] | None:
        """Return the largest value of ``direction (Q,)`` over all deviations whose first outputs can be those of a
        signal, and a maximiser; ``None`` where it was not found within the limits."""
        if not reports:
            z = extreme(self.spread, direction)
            return float(direction @ z), z
        if self.work > self.limit or self.passed():
            return None
        history = self.history(signal, reports)
        if history != self._imposed_history:
            H, h = self.hidden
            limits = 1.0 - self.outputs(signal) @ H.T / h
            limits[reports:] = np.inf
            self._program.limit(self._row_numbers.ravel(), limits.ravel())
            self._imposed_history = history
        cost = -direction * self._column_units
        cost = cost / (float(np.abs(cost).max(initial=0.0)) or 1.0)
        self._program.highs.changeColsCost(cost.size, np.arange(cost.size, dtype=np.int32), cost)
        is_solved, _, x, _ = self._program.solve()
        self.work += self._program.work + self.C.size
        if not is_solved:
            return None
        z = self._move_into_set(x * self._column_units)
        H, h = self.hidden
        noise_values = (self.outputs(signal) - self.C @ z)[:reports] @ H.T
        return (float(direction @ z), z) if (noise_values <= KEPT * h).all() else None

    def known(self, z: Array) -> Array:
        """Return the signal of a disturbance with the noise that hides it from the outputs as far as it can.

        A noise whose set is no box stays in its middle. The initial state is the middle of its set, unless ``z`` holds
        it. A ``z`` that holds outputs is returned as it is.
        """
        if z.size > self.N.shape[1]:
            return z
        z = np.concatenate([z, np.zeros(self.N.shape[1] - z.size)])
        return self.signal(z, self.nominal, self._clip_noise(-(self.C @ z)), 0)

    def _clip_noise(self, noise: Array) -> Array:
        """Return the noise ``(J, p)`` in a box that is nearest to ``noise``; the middle of a set that is no box."""
        radii = ROOM * self.noise.radii.reshape(noise.shape)
        return np.clip(noise, -radii, radii) if self.noise.is_box else np.zeros(noise.shape)

    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """Find the signals by one linear program each, for at most `TRIED` candidates that promise most."""
        (J, p, Q), R = self.C.shape, self.N.shape[0]
        output_matrix = self.C.reshape(J * p, Q)
        # an output is its noise, and more
        noise_part = np.zeros((R, J * p)) if answered is None else answered[:, self.place]
        candidates: list[tuple[float, int, int, int, float, Array, Array]] = []
        for report in range(J):
            acting = noise_part.copy()
            acting[:, : report * p] = 0.0
            along = self.N + acting @ output_matrix
            noise = self.noise.support(acting)
            bounds = noise + self.spread.support(along)
            rows = np.flatnonzero(report < self.past_reports)
            for number, signal in enumerate(signals):
                offset = own[number] - scale * (acting @ signal[Q:])
                promises = (offset + scale * bounds) / units
                best = rows[np.argsort(-promises[rows])[:EACH]]
                candidates += [
                    (promises[row], number, report, row, offset[row], along[row], acting[row])
                    for row in best[promises[best] > NONE].tolist()
                ]
        candidates.sort(key=lambda candidate: -candidate[0])
        children: list[tuple[float, int, int, Array]] = []
        for _, number, report, row, offset, along, acting in candidates[:TRIED]:
            worst = self.along(along, signals[number], report)
            if worst is None:
                continue
            noise = ROOM * extreme(self.noise, acting)
            excess = (offset + scale * (worst[0] + float(acting @ noise))) / units[row]
            if excess > NONE:
                nearest_noise = self._clip_noise(self.outputs(signals[number]) - self.C @ worst[1])
                noise_part = np.where(acting.reshape(J, p) == 0.0, nearest_noise, noise.reshape(J, p))
                children.append((excess, number, report, self.signal(worst[1], signals[number], noise_part, report)))
        for _, number, report, child in sorted(children, key=lambda item: -item[0]):
            yield number, report, child

    @cached_property
    def _column_units(self) -> Array:
        radii = self.spread.radii
        return np.where(radii > 0.0, radii, 1.0)

    def _move_into_set(self, z: Array) -> Array:
        """Return the deviations moved back into their set, which rounding may have left."""
        for entries, _, convex, middle in self.spread.parts if z.size else ():
            if convex.is_box:
                box, values = convex.bounding_box(), z[entries].reshape(-1, convex.dimension)
                z[entries] = np.clip(values, box.lower - middle, box.upper - middle).ravel()
            else:
                z[entries] *= ROOM
        return z


def about(convex: ConvexSet) -> tuple[Array, Array] | None:
    """Return half-spaces ``(H, h)`` of a set about its middle, ``None`` where it is curved or its middle is on its
    border."""
    flat = convex.halfspaces()
    if flat is None:
        return None
    h = flat[1] - flat[0] @ convex.middle()
    return (flat[0], h) if (h > 0.0).all() else None


def hiding(noise: ConvexSet) -> tuple[Array, Array] | None:
    """Return half-spaces about the middle of what a noise can certainly be: its own, or where it is curved those of a
    box in it; ``None`` where there are none."""
    flat = about(noise)
    if flat is None and noise.halfspaces() is None and noise.dimension <= CORNERS:
        axes, middle = np.eye(noise.dimension), noise.middle()
        radii = np.minimum(noise.support(axes) - middle, noise.support(-axes) + middle) / noise.dimension
        corners = middle + radii * np.array(list(product((-1.0, 1.0), repeat=noise.dimension)))
        flat = about(Box(-radii, radii)) if (noise.gauge(corners) <= 1.0).all() else None
    return None if flat is None else (flat[0], ROOM * flat[1])


def extreme(spread: Spread, along: Array) -> Array:
    """Return an extreme deviation ``(..., Q)`` of the set that is the worst along ``along (..., Q)``; any one where the
    direction is 0."""
    if spread.is_box:
        return np.asarray(np.where(along >= 0.0, 1.0, -1.0) * spread.radii)
    return np.asarray(spread.worst(along))


def sums(a: Array) -> Array:
    """Return the sums over the last axis of the entries before each position, and of all entries."""
    return np.concatenate([np.zeros((*a.shape[:-1], 1)), np.cumsum(a, axis=-1)], axis=-1)
