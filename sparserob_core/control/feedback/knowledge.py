"""What a control knows of a signal, and what a constraint can still meet that the control does not know yet.

A causal control is a function of the reports that reached it: under two signals with the same reports it is the same.
Where nothing hides a disturbance, its blocks are the reports. Where outputs are measured with a noise, the outputs are:
two disturbances whose outputs differ by no more than the noise can make up have the same reports, since each signal
comes with the noise that makes up the difference, ``v_j = eta_j - C x_j(w)``. So a signal is a disturbance, an initial
state and a history ``eta`` of outputs beside those of the nominal signal, and any are possible with which all noises
are in their set. This is what a set of states that are possible after a history says (Witsenhausen 1968; Bertsekas and
Rhodes 1971), signal by signal.
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
from sparserob_core.control.feedback.innovations import innovations_seen
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
    """``seen (K,)``: how many reports every piece of the control knows. Signals are arrays that begin with the
    deviations ``(Q,)``; rows ask ``N (R, Q)`` of these, of which ``begun (R,)`` reports are older than their times."""

    N: Array
    seen: np.ndarray
    begun: np.ndarray
    work: float = 0.0

    @property
    @abstractmethod
    def reports(self) -> int:
        """How many there are."""

    @property
    @abstractmethod
    def nominal(self) -> Array:
        """The nominal signal."""

    @property
    @abstractmethod
    def most(self) -> Array:
        """The most that deviations give to every row, ``(R,)``, or more."""

    @abstractmethod
    def history(self, signal: Array, reports: int) -> bytes:
        """What the first so many reports of a signal are: equal where a control cannot tell two apart."""

    @abstractmethod
    def gives(self, signals: Array, beside: Array) -> Array:
        """The most that deviations give to every row, of which the first reports are those of a signal, ``(S, R,
        reports + 1)``; where that and what is ``beside`` it, of the same shape, are not above 0, any number that does
        not lift them above it."""

    @abstractmethod
    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """What gives the most to a row of all signals whose first reports are those of this one, and how much."""

    @abstractmethod
    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """Signals that leave one of these at a report, by number both, and are the worst for a row from there on, those
        that exceed theirs by most ``units (R,)`` first. ``own (S, R)``: what the rows have otherwise under each, of
        which a control is part that adds ``answered (R, ..)`` of all deviations, noises too, to what it does under the
        signal; nothing where that is ``None``. All deviations count ``scale`` times."""

    @abstractmethod
    def known(self, z: Array) -> Array:
        """The signal of a disturbance with these deviations ``(Q,)``."""

    @cached_property
    def first(self) -> np.ndarray:
        """The first piece that may know of a report, ``(reports + 1,)``."""
        return np.searchsorted(self.seen, np.arange(self.reports + 1), side="right")


@final
@dataclass(eq=False)
class OfDisturbances(Knowledge):
    """Reports are the blocks of the disturbance, ``width`` deviations each, all in ``spread``."""

    N: Array
    spread: Spread
    width: int
    seen: np.ndarray
    begun: np.ndarray
    work: float = 0.0

    @property
    def reports(self) -> int:
        """How many blocks there are."""
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
    def most(self) -> Array:
        """Under the worst deviations."""
        return np.asarray(np.abs(self.N * self.worst).sum(axis=1))

    def history(self, signal: Array, reports: int) -> bytes:
        """The deviations bit by bit."""
        return signal[: reports * self.width].tobytes()

    def gives(self, signals: Array, beside: Array) -> Array:
        """The signal's own blocks, and the worst from a report on."""
        return sums(self.by_block(self.N * signals[:, None]).sum(axis=3)) + self._pushed

    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """One that is the worst for the row from the block on."""
        begun, end, z = self.begun[row] * self.width, report * self.width, signal.copy()
        z[end:begun] = self.worst[row, end:begun]
        return float(self.N[row, :end] @ z[:end]) + float(self._pushed[row, report]), z

    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """In closed form."""
        acted = np.zeros_like(self.N) if answered is None else answered[:, : self.N.shape[1]]
        closed = acted + self.N
        closed = np.where(np.abs(closed) > NONE * np.abs(self.N), closed, self.N * NONE)
        worst = extreme(self.spread, closed)
        past = sums(self.by_block(self.N * signals[:, None]).sum(axis=-1))
        given = self._after(acted * signals[:, None])
        over = own[:, :, None] + scale * (past - given + self._after(closed * worst))
        over = over / units[:, None]
        over[:, :, -1] = -np.inf
        over = np.where(np.arange(over.shape[2]) < self.begun[:, None], over, -np.inf)
        for place in np.argsort(-over, axis=None).tolist():
            signal, row, report = (int(v) for v in np.unravel_index(place, over.shape))
            if over[signal, row, report] <= NONE:
                return
            child = signals[signal].copy()
            child[report * self.width :] = worst[row, report * self.width :]
            yield signal, report, child

    def known(self, z: Array) -> Array:
        """It is its deviations."""
        return z

    def _after(self, a: Array) -> Array:
        past = sums(self.by_block(a).sum(axis=-1))
        return np.asarray(past[..., -1:] - past)

    @cached_property
    def _pushed(self) -> Array:
        """The most that the disturbance from every block on gives to every row, ``(R, blocks + 1)``."""
        gives = self.by_block(self.N * self.worst).sum(axis=2)
        return sums(gives[:, ::-1])[:, ::-1]

    def by_block(self, a: Array) -> Array:
        """Numbers of every deviation, block by block."""
        return a.reshape(*a.shape[:-1], self.reports, max(1, self.width))


@final
@dataclass(eq=False)
class OfOutputs(Knowledge):
    """Reports are outputs ``(p,)``: ``C (J, p, Q)`` is what the deviations in ``spread`` give to each, and ``hidden``,
    half-spaces ``(H, h)``, holds what a ``noise``, both about its middle, can add to them; ``place``: that of the noise
    among all deviations. A signal is the deviations and then the outputs beside the nominal ones, ``(Q + J p,)``. No
    more than ``limit`` of ``work`` is done, and nothing once its time has ``passed``: what is not known by then is not
    asked of anybody."""

    N: Array
    C: Array
    spread: Spread
    hidden: tuple[Array, Array]
    noise: Spread
    place: slice
    seen: np.ndarray
    begun: np.ndarray
    limit: float = np.inf
    passed: Callable[[], bool] = lambda: False
    work: float = 0.0
    _held: dict[tuple[bytes, int], tuple[float, Array]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._linear, (H, h) = Growing(), self.hidden
        self._imposed: bytes | None = None
        for entries, count, convex, middle in self.spread.parts:
            low, high = np.full(convex.dimension, -np.inf), np.full(convex.dimension, np.inf)
            if convex.is_box:
                box = convex.bounding_box()
                low, high = box.lower - middle, box.upper - middle
            far = self._far[entries]
            none = np.zeros(far.size)
            columns = self._linear.variables(np.tile(low, count) / far, np.tile(high, count) / far, none)
            flat = None if convex.is_box else about(convex)
            if flat is None:
                continue
            row, channel = np.nonzero(flat[0])
            for copy in columns.reshape(count, -1):
                asked = flat[0][row, channel] * self._far[copy[channel]] / flat[1][row]
                none = np.full(flat[1].size, -np.inf)
                self._linear.rows([(row, copy[channel], asked)], none, np.ones(flat[1].size))
        self._rows = np.zeros((self.reports, h.size), dtype=int)
        for report, given in enumerate(self.C):
            asked = -(H @ given) * self._far / h[:, None]
            row, column = np.nonzero(asked)
            free = np.full(h.size, np.inf)
            self._rows[report] = self._linear.rows([(row, column, asked[row, column])], -free, free)

    @staticmethod
    def of(
        loop: ClosedLoop, N: Array, times: Array, measured: Array, seen: np.ndarray, share: float
    ) -> OfOutputs | None:
        """Of a ``loop`` whose outputs are ``measured (K,)`` at these times, with a noise, and rows that look at ``times
        (R,)`` and ask ``N (R, Q)`` of disturbance and initial state; ``None`` where there is no noise, or one of these
        is in a set that is curved or flat. ``share``: which of the noise and of the initial states is used."""
        observer, sets, begun = loop.observer, loop.spread.sets, int(loop.begins.sum())
        if observer is None or not observer.noisy or loop.measurable is not None:
            return None
        first = int(loop.noise.start > 0)  # whether a disturbance stands before the noise
        noise = sets[first][1].scaled(share)
        own = [(1, sets[-1][1].scaled(share))] if begun else []
        spread, hidden = Spread((*sets[:first], *own)), hiding(noise)
        if hidden is None or any(about(one) is None and not one.is_box for _, one in spread.sets):
            return None
        plain, problem = replace(observer, L=np.zeros_like(observer.L)), loop.functionals
        entering = innovations_seen(problem.response, problem.dictionary, problem.disturbance, begun > 0)
        given = plain.seen(entering, begun)
        C = np.concatenate([given[:, :, : loop.noise.start], given[:, :, loop.noise.stop :]], axis=2)
        begins = np.searchsorted(measured, times)
        return OfOutputs(N, C, spread, hidden, Spread(((measured.size, noise),)), loop.noise, seen, begins)

    @property
    def reports(self) -> int:
        """How many outputs there are."""
        return int(self.C.shape[0])

    @property
    def nominal(self) -> Array:
        """No deviation, and nothing beside the nominal outputs."""
        return np.zeros(self.N.shape[1] + self.C.shape[0] * self.C.shape[1])

    @cached_property
    def most(self) -> Array:
        """Under the worst deviations, whatever is seen of them."""
        return self.spread.support(self.N)

    def outputs(self, signal: Array) -> Array:
        """Those of a signal, ``(J, p)``."""
        return signal[self.N.shape[1] :].reshape(self.C.shape[:2])

    def history(self, signal: Array, reports: int) -> bytes:
        """The outputs bit by bit."""
        return self.outputs(signal)[:reports].tobytes()

    def signal(self, z: Array, beside: Array, noise: Array, reports: int) -> Array:
        """Deviations ``z (Q,)`` whose first outputs are those of another signal ``beside``, and then those with this
        ``noise (J, p)``."""
        own = self.C @ z + noise
        own[:reports] = self.outputs(beside)[:reports]
        return np.concatenate([z, own.ravel()]) + 0.0

    def gives(self, signals: Array, beside: Array) -> Array:
        """By a linear program each, of what promises most first, until `LOOKED` were solved and one lifts a row."""
        found = np.full(beside.shape, -np.inf)
        for own, rest, signal in zip(found, beside, signals, strict=True):
            most, known = np.broadcast_to(self.most[:, None], rest.shape).copy(), np.zeros(rest.shape, dtype=bool)
            for report in range(1, self.reports + 1):
                history = self.history(signal, report)
                for row in np.flatnonzero(most[:, report] + rest[:, report] > 0.0).tolist():
                    if (history, row) in self._held:
                        most[row, report], known[row, report] = self._worst(signal, row, report)[0], True
            known[:, 0] = True
            own[known] = most[known]
            most = np.minimum.accumulate(most, axis=1)  # what is hidden for longer gives no more
            lifted, solved = bool((own + rest > 0.0).any()), 0
            promise = np.where(known, -np.inf, most + rest)
            for place in np.argsort(-promise, axis=None).tolist():
                row, report = divmod(place, self.reports + 1)
                if not promise[row, report] > 0.0 or (lifted and solved >= LOOKED):
                    break
                own[row, report] = self._worst(signal, row, report)[0]
                lifted, solved = lifted or bool(own[row, report] + rest[row, report] > 0.0), solved + 1
        return found

    def changed(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        """The worst of all deviations that a noise within its set hides so long."""
        worst = self._worst(signal, row, report)
        return worst[0], self.signal(worst[1], signal, np.zeros(self.C.shape[:2]), report)

    def _worst(self, signal: Array, row: int, report: int) -> tuple[float, Array]:
        key = self.history(signal, report), row
        if key not in self._held:
            worst = self.along(self.N[row], signal, report)
            self._held[key] = (-np.inf, np.zeros(0)) if worst is None else worst
        return self._held[key]

    def along(self, direction: Array, signal: Array, reports: int) -> tuple[float, Array] | None:
        """The largest of ``direction (Q,)`` over all deviations whose first outputs can be those of a signal, and where
        it is; ``None`` where that was not found within the limits."""
        if not reports:
            z = extreme(self.spread, direction)
            return float(direction @ z), z
        if self.work > self.limit or self.passed():
            return None
        history = self.history(signal, reports)
        if history != self._imposed:
            H, h = self.hidden
            limits = 1.0 - self.outputs(signal) @ H.T / h
            limits[reports:] = np.inf
            self._linear.limit(self._rows.ravel(), limits.ravel())
            self._imposed = history
        cost = -direction * self._far
        cost = cost / (float(np.abs(cost).max(initial=0.0)) or 1.0)
        self._linear.highs.changeColsCost(cost.size, np.arange(cost.size, dtype=np.int32), cost)
        done, _, x, _ = self._linear.solve()
        self.work += self._linear.work + self.C.size
        if not done:
            return None
        z = self._inside(x * self._far)
        H, h = self.hidden
        hides = (self.outputs(signal) - self.C @ z)[:reports] @ H.T
        return (float(direction @ z), z) if (hides <= KEPT * h).all() else None

    def known(self, z: Array) -> Array:
        """With a noise that hides what it can, where no outputs are told; from the middle of the initial states."""
        if z.size > self.N.shape[1]:
            return z
        z = np.concatenate([z, np.zeros(self.N.shape[1] - z.size)])
        return self.signal(z, self.nominal, self._nearest(-(self.C @ z)), 0)

    def _nearest(self, noise: Array) -> Array:
        """The noise ``(J, p)`` that is as near to another one as it can be, of a box; the middle of what is none."""
        far = ROOM * self.noise.radii.reshape(noise.shape)
        return np.clip(noise, -far, far) if self.noise.is_box else np.zeros(noise.shape)

    def leaving(
        self, signals: Array, own: Array, answered: Array | None, scale: float, units: Array
    ) -> Iterator[tuple[int, int, Array]]:
        """By a linear program each, of as many as promise most."""
        (J, p, Q), R = self.C.shape, self.N.shape[0]
        whole = self.C.reshape(J * p, Q)
        told = np.zeros((R, J * p)) if answered is None else answered[:, self.place]  # an output is its noise, and more
        tried: list[tuple[float, int, int, int, float, Array, Array]] = []
        for report in range(J):
            acting = told.copy()
            acting[:, : report * p] = 0.0
            along = self.N + acting @ whole
            noise = self.noise.support(acting)
            most = noise + self.spread.support(along)
            rows = np.flatnonzero(report < self.begun)
            for which, signal in enumerate(signals):
                rest = own[which] - scale * (acting @ signal[Q:])
                most_of_it = (rest + scale * most) / units
                best = rows[np.argsort(-most_of_it[rows])[:EACH]]
                tried += [
                    (most_of_it[row], which, report, row, rest[row], along[row], acting[row])
                    for row in best[most_of_it[best] > NONE].tolist()
                ]
        tried.sort(key=lambda one: -one[0])
        found: list[tuple[float, int, int, Array]] = []
        for _, which, report, row, rest, along, acting in tried[:TRIED]:
            worst = self.along(along, signals[which], report)
            if worst is None:
                continue
            noise = ROOM * extreme(self.noise, acting)
            over = (rest + scale * (worst[0] + float(acting @ noise))) / units[row]
            if over > NONE:
                hides = self._nearest(self.outputs(signals[which]) - self.C @ worst[1])
                told = np.where(acting.reshape(J, p) == 0.0, hides, noise.reshape(J, p))
                found.append((over, which, report, self.signal(worst[1], signals[which], told, report)))
        for _, which, report, child in sorted(found, key=lambda one: -one[0]):
            yield which, report, child

    @cached_property
    def _far(self) -> Array:
        radii = self.spread.radii
        return np.where(radii > 0.0, radii, 1.0)

    def _inside(self, z: Array) -> Array:
        """Deviations that rounding has not taken out of their set."""
        for entries, _, convex, middle in self.spread.parts if z.size else ():
            if convex.is_box:
                box, own = convex.bounding_box(), z[entries].reshape(-1, convex.dimension)
                z[entries] = np.clip(own, box.lower - middle, box.upper - middle).ravel()
            else:
                z[entries] *= ROOM
        return z


def about(convex: ConvexSet) -> tuple[Array, Array] | None:
    """Half-spaces ``(H, h)`` of a set about its middle, ``None`` where it is curved or its middle is on its border."""
    flat = convex.halfspaces()
    if flat is None:
        return None
    h = flat[1] - flat[0] @ convex.middle()
    return (flat[0], h) if (h > 0.0).all() else None


def hiding(noise: ConvexSet) -> tuple[Array, Array] | None:
    """Half-spaces about the middle of what a noise can certainly be: its own, or where it is curved those of a box in
    it; ``None`` where there are none."""
    flat = about(noise)
    if flat is None and noise.halfspaces() is None and noise.dimension <= CORNERS:
        axes, middle = np.eye(noise.dimension), noise.middle()
        far = np.minimum(noise.support(axes) - middle, noise.support(-axes) + middle) / noise.dimension
        corners = middle + far * np.array(list(product((-1.0, 1.0), repeat=noise.dimension)))
        flat = about(Box(-far, far)) if (noise.gauge(corners) <= 1.0).all() else None
    return None if flat is None else (flat[0], ROOM * flat[1])


def extreme(spread: Spread, along: Array) -> Array:
    """An extreme deviation ``(..., Q)`` of the set that is the worst along ``(..., Q)``; any where nothing is."""
    if spread.is_box:
        return np.asarray(np.where(along >= 0.0, 1.0, -1.0) * spread.radii)
    return np.asarray(spread.worst(along))


def sums(a: Array) -> Array:
    """The sums over the last axis of what is before each place, and of all."""
    return np.concatenate([np.zeros((*a.shape[:-1], 1)), np.cumsum(a, axis=-1)], axis=-1)
