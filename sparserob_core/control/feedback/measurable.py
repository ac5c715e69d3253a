"""Measurable disturbances under feedback: what they have done to the state when a piece is over, and until then.

The control sees the state at breakpoints. So of a disturbance on a piece of the grid only one vector counts once the
piece is over, what it has made of the state by then: a point of a `Zonoid`. On the piece that holds ``t`` nothing has
been answered yet, and what it adds to ``c'x(t)`` is the support function of a set that no decision enters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from typing import final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.feedback.zonoid import FAST, PARTS, Arc, Pushes, Zonoid, corners
from sparserob_core.control.reach.functional import WorstCase
from sparserob_core.control.reach.measurable import MISSED
from sparserob_core.control.reach.varying_execution import VaryingExecution, VaryingExecutionCellSupport
from sparserob_core.control.reach.varying_measurable import VaryingMeasurable
from sparserob_core.control.reach.varying_motion import OUTWARD, VaryingMotion
from sparserob_core.control.sets.sets import Polytope
from sparserob_core.sip.convex_set import Array, ConvexSet

KNOWN = np.zeros((1, 0))
TERMS = 8  # of the expansion that bounds a slope
ENCLOSED_KEPT = 8  # lists of times at which what a piece has done is remembered: both ends of the cells of a few rows
SEEN = 1e-7  # of the largest extent of a piece's set, one along which it is answered


@dataclass(frozen=True, eq=False)
class MeasurablePieces:
    """What measurable disturbances do on every piece of a grid: a point of each of ``zonoids``, whose coordinates are
    those of the problem's own units; ``states (d,)`` and ``disturbances (mw,)`` are these in the units of
    ``functionals``. ``composed``: the signals that were found for points of the zonoids, in any units."""

    functionals: WorstCase
    zonoids: tuple[Zonoid, ...]
    states: Array
    disturbances: Array
    composed: dict[tuple[int, bytes], Arc] = field(default_factory=dict, repr=False)

    def in_units_of(self, functionals: WorstCase, states: Array, disturbances: Array) -> MeasurablePieces:
        """The same of the same problem in other units."""
        return replace(self, functionals=functionals, states=states, disturbances=disturbances[: self.middle.size])

    @cached_property
    def sets(self) -> tuple[tuple[int, ConvexSet], ...]:
        """The sets of the deviations, one block for every piece, as in `Spread`."""
        sets: list[tuple[int, ConvexSet]] = []
        for one in self.zonoids:
            if sets and sets[-1][1] is one:
                sets[-1] = (sets[-1][0] + 1, one)
            elif one.dimension:
                sets.append((1, one))
        return tuple(sets)

    @property
    def size(self) -> int:
        """How many entries a deviation has."""
        return sum(one.dimension for one in self.zonoids)

    @cached_property
    def _starts(self) -> list[int]:
        return list(accumulate((one.dimension for one in self.zonoids), initial=0))

    def at(self, piece: int) -> tuple[slice, Array]:
        """The entries of a piece, and what they are of the state at its end, ``(d, r)``."""
        outward = self.states[:, None] * self.zonoids[piece].outward
        return slice(self._starts[piece], self._starts[piece + 1]), outward

    def seen(self, piece: int) -> np.ndarray:
        """Along which of a piece's coordinates it is answered, ``(r,)``: not where nearly nothing happens."""
        sizes = np.linalg.norm(self.zonoids[piece].outward, axis=0)
        large: np.ndarray = sizes > SEEN * sizes.max(initial=0.0)
        return large

    @cached_property
    def middle(self) -> Array:
        """The middle of the disturbance's set, ``(mw,)``."""
        model = self.functionals.disturbance
        assert model is not None
        middle: Array = model.bound.middle()
        return middle

    @cached_property
    def _matrices(self) -> tuple[Array, Array]:
        steps = self.functionals.response.steps(KNOWN)
        return steps.A[0, 0], steps.E[0]

    @cached_property
    def _radii(self) -> Array:
        """How far each channel deviates, ``(mw,)``."""
        model = self.functionals.disturbance
        assert model is not None
        axes = np.eye(self.middle.size)
        ends = (model.bound.support(axes) - self.middle, model.bound.support(-axes) + self.middle)
        far: Array = np.maximum(*ends)
        return far

    def within(self, times: Array, H: Array, pieces: np.ndarray | None = None) -> Array:
        """What the piece of the grid that holds each of ``times (k,)``, or these, has added to ``H x(t)`` by then at
        most, beyond the middle: ``(k, r)``."""
        response, k, r = self.functionals.response, times.size, H.shape[0]
        pieces = response.grid.locate(times) if pieces is None else pieces
        distinct, which = np.unique(np.clip(times - response.grid.breakpoints[pieces], 0.0, None), return_inverse=True)
        count = distinct.size
        none = np.zeros((count * r, 0))
        support = self.functionals.measurable
        assert support is not None
        found = support(np.repeat(distinct, r), np.tile(H, (count, 1)), none).reshape(count, r)
        _, E = self._matrices
        found = found - (H @ response.flows(distinct)[1] @ (E @ self.middle))
        return np.asarray(found[which.reshape(k)])

    def allowance(self, lower: Array, upper: Array, H: Array, pieces: np.ndarray) -> Array:
        """By how much `within` may lie above its chord on cells ``[lower, upper] (k,)`` of these pieces, ``(k, r)``:
        the integrand is Lipschitz; with what its quadrature may miss."""
        response, (A, E) = self.functionals.response, self._matrices
        within = np.clip(lower - response.grid.breakpoints[pieces], 0.0, None)
        h = (upper - lower)[:, None]
        row = H @ response.flows(within)[0] @ A
        slope, factor = np.zeros(row.shape[:2]), np.ones_like(h)
        for order in range(TERMS):
            slope += factor * (np.abs(row @ E) @ self._radii)
            row, factor = row @ A, factor * h / (order + 1)
        far = float(np.linalg.norm(np.abs(E) @ self._radii))
        with np.errstate(over="ignore", invalid="ignore"):
            slope += factor * np.exp(np.linalg.norm(A, 2) * h) * np.linalg.norm(row, axis=2) * far
        return np.asarray(h**2 / 8.0 * slope + MISSED * np.abs(self.within(upper, H, pieces)))

    @property
    def reached(self) -> tuple[Array, Array]:
        """Of a system whose transitions may be off: what the piece under way can have made of every state at all marks
        but the last, ``(K, d)``; and how much drives states between marks, ``(K, d, m)``, as `VaryingMotion.left_out`
        counts it. Nothing here."""
        L, d = self.functionals.response.grid.pieces, self.states.size
        return np.zeros((L, d)), np.zeros((L, d, 0))

    def carried(self, pieces: np.ndarray, times: Array) -> Array:
        """The transitions ``(k, d, d)`` from the ends of ``pieces (k,)`` until later ``times (k,)``, or none."""
        response = self.functionals.response
        return response.flows(np.clip(times - response.grid.breakpoints[pieces + 1], 0.0, None))[0]

    def pushes(self, piece: int, until: float) -> Pushes:
        """What a disturbance on a piece makes of the state at a time in it."""
        return Pushes.of(*self._matrices, until - float(self.functionals.response.grid.breakpoints[piece]))

    def weights(self, time: float, H: Array, pieces: np.ndarray) -> Array:
        """What a deviation gives to ``H x(time)`` without any control, ``(r, Q)``; every row sees the state from one of
        ``pieces (r,)``, and what happens in that one is not part of it."""
        found, over = np.zeros((H.shape[0], self.size)), int(pieces.max(initial=0))
        flows = self.carried(np.arange(over), np.full(over, time))
        for piece in range(over):
            place, outward = self.at(piece)
            rows = pieces > piece
            found[rows, place] = H[rows] @ flows[piece] @ outward
        return found

    def signal(self, deviation: Array, time: float, direction: Array | None, over: int) -> tuple[Array, Array]:
        """Breakpoints ``(L + 1,)``, those of the grid among them, and a disturbance ``(mw, L)`` between them that has
        the ``deviation (Q,)``; on piece ``over``, in which the state is looked at, the worst for ``direction'x(time)``,
        and the middle after that."""
        grid = self.functionals.response.grid
        made, ends, values = self._arcs(deviation), [], []
        for piece, (start, stop) in enumerate(zip(grid.breakpoints[:-1], grid.breakpoints[1:], strict=True)):
            if direction is not None and piece == over and time > start:
                one = self._last(piece, time).best(direction)
                ends += [start + one.ends[:-1] * (time - start), [min(time, stop)]]
                values.append(one.values)
                if time < stop:
                    ends.append([stop])
                    values.append(np.zeros((1, self.middle.size)))
                continue
            one = made[piece]
            ends += [start + one.ends[:-1] * (stop - start), [stop]]
            values.append(one.values * self.disturbances)
        points = np.concatenate([[grid.breakpoints[0]], *ends])
        kept = np.diff(points) > 0.0
        return np.concatenate([points[:1], points[1:][kept]]), (self.middle + np.vstack(values)[kept]).T

    def compose(self, deviations: Sequence[Array]) -> None:
        """Find the signals on all pieces that have these deviations ``(Q,)``, all at once, and keep them."""
        alike: dict[int, dict[bytes, tuple[int, Array]]] = {}
        for deviation in deviations:
            for piece, one in enumerate(self.zonoids):
                point = deviation[self.at(piece)[0]]
                if point.size and point.any() and (id(one), point.tobytes()) not in self.composed:
                    alike.setdefault(id(one), {})[point.tobytes()] = (piece, point)
        for key, points in alike.items():
            piece = next(iter(points.values()))[0]
            made = self.zonoids[piece].signals(np.stack([point for _, point in points.values()]))
            self.composed.update({(key, point): arc for point, arc in zip(points, made, strict=True)})

    def attained(self, deviation: Array) -> Array:
        """The deviation ``(Q,)`` that the `signal` of one has: it misses it by what composing leaves."""
        found = np.zeros(self.size)
        for piece, (one, arc) in enumerate(zip(self.zonoids, self._arcs(deviation), strict=True)):
            found[self.at(piece)[0]] = one.reached(arc)
        return found

    def _arcs(self, deviation: Array) -> list[Arc]:
        """The signals on all pieces that have a deviation ``(Q,)``."""
        self.compose([deviation])
        rest = Arc(np.ones(1), np.zeros((1, self.middle.size)))
        points = [deviation[self.at(piece)[0]].tobytes() for piece in range(len(self.zonoids))]
        return [self.composed.get((id(one), point), rest) for one, point in zip(self.zonoids, points, strict=True)]

    def _last(self, piece: int, time: float) -> Zonoid:
        """What happens on a piece until a time, in the coordinates of the state."""
        model, identity = self.functionals.disturbance, np.eye(self.states.size)
        assert model is not None
        return Zonoid(self.pushes(piece, time), tuple(corners(model.bound)), identity, identity)


@final
@dataclass(frozen=True, eq=False)
class VaryingPieces(MeasurablePieces):
    """`MeasurablePieces` of a system that changes with time: what a piece has made of the state until now is what
    `VaryingExecution` says of errors, if nothing but this piece acts."""

    @cached_property
    def errors(self) -> VaryingExecution:
        """The disturbances, less their middle, as errors of a command of 1 on every piece of the grid."""
        model, response = self.functionals.disturbance, self.functionals.response
        assert model is not None
        bound, sides = model.bound, model.bound.halfspaces()
        if not bound.is_box:
            assert sides is not None
            sizes = np.abs(sides[0]) @ np.abs(self.middle) + np.abs(sides[1])
            about = sides[1] - sides[0] @ self.middle + rounding(self.middle.size + 2) * sizes
            bound = Polytope(sides[0], np.maximum(about, 0.0))
        errors = VaryingMeasurable(response, bound).errors
        assert isinstance(errors, VaryingExecution)  # under feedback there are no parameters beside the time
        return replace(errors, breakpoints=response.grid.breakpoints)

    @property
    def motion(self) -> VaryingMotion:
        """The system between all marks."""
        return self.errors.motion

    def _alone(self, piece: int) -> Array:
        """The command that is 1 on one piece alone, ``(m, L)``."""
        found = np.zeros((self.errors.shares.size, self.functionals.response.grid.pieces))
        found[:, piece] = 1.0
        return found

    def enclosed(self, times: Array, H: Array, pieces: np.ndarray) -> Array:
        """What `within` is at least and at most, but for what transitions are off by, ``(k, r, 2)``; remembered, since
        a bound over cells asks for their ends more than once."""
        key = b"".join(part.tobytes() for part in (times, H, pieces))
        if key in self._enclosed:
            return self._enclosed[key]
        turned = H if self.errors.bound is not None else H * _turned(H)[:, None]
        rows, which = np.unique(turned + 0.0, axis=0, return_inverse=True)  # of a box opposite rows are one
        found, r = np.zeros((times.size, len(rows), 2)), len(rows)
        for piece in np.unique(pieces):
            here = np.flatnonzero(pieces == piece)
            distinct, place = np.unique(times[here], return_inverse=True)
            bounds = self.errors.enclosed(self._alone(piece), np.repeat(distinct, r), np.tile(rows, (distinct.size, 1)))
            found[here] = bounds.reshape(distinct.size, r, 2)[place.reshape(-1)]
        remember(self._enclosed, key, found[:, which.reshape(-1)], ENCLOSED_KEPT)
        return self._enclosed[key]

    @cached_property
    def _enclosed(self) -> dict[bytes, Array]:
        return {}

    def within(self, times: Array, H: Array, pieces: np.ndarray | None = None) -> Array:
        pieces = self.functionals.response.grid.locate(times) if pieces is None else pieces
        return np.asarray(self.enclosed(times, H, pieces).mean(axis=2))

    def allowance(self, lower: Array, upper: Array, H: Array, pieces: np.ndarray) -> Array:
        found = np.zeros((lower.size, H.shape[0]))
        for piece in np.unique(pieces):
            here = np.flatnonzero(pieces == piece)
            over = VaryingExecutionCellSupport(self.errors, self._alone(piece), H, self.motion)
            found[here] = over.deviation(lower[here], upper[here] - lower[here])
        off = np.max([np.ptp(self.enclosed(end, H, pieces), axis=2) for end in (lower, upper)], axis=0)
        return np.asarray((found + off / 2.0) * OUTWARD)

    @cached_property
    def reached(self) -> tuple[Array, Array]:
        """What kernels are off by stands beside what the flows of inputs are."""
        motion, errors = self.motion, self.errors
        axes = np.vstack([np.eye(motion.states), -np.eye(motion.states)])
        ends = self.enclosed(motion.grid.breakpoints[:-1], axes, motion.origin)[..., 1]
        begun = np.maximum(ends, 0.0).reshape(len(ends), 2, -1).max(axis=1)
        kernel, flow, columns = errors.kernel, motion.flow, errors.columns
        pushed = flow.sizes[..., columns] + kernel.sizes[..., columns] * (kernel.error / flow.error)[:, None, None]
        return begun * OUTWARD, pushed * errors.far * OUTWARD

    def carried(self, pieces: np.ndarray, times: Array) -> Array:
        ends = self.functionals.response.grid.breakpoints[pieces + 1]
        return np.asarray(self.motion.expansion.flow(ends, np.maximum(ends, times)).state)

    def pushes(self, piece: int, until: float) -> Pushes:
        """As that of a system that stays as it is, from the kernels between marks, each on parts in which the system
        does not change much."""
        motion, channels = self.motion, self.motion.expansion.channels[0]
        start, marks = float(self.functionals.response.grid.breakpoints[piece]), motion.grid.breakpoints
        ends = np.concatenate([[start], marks[(marks > start) & (marks < until)], [until]])
        kernel, onward = motion.expansion.kernel(ends[:-1], ends[1:]), np.eye(motion.states)
        every = [np.zeros((0, 0, 0))] * (ends.size - 1)
        for k, step in reversed(list(enumerate(motion.expansion.flow(ends[:-1], ends[1:]).state))):
            every[k], onward = onward @ kernel.terms[k][..., channels:], onward @ step
        lengths = np.diff(ends)
        paces = np.ceil(motion.paces[motion.place(ends[:-1])] * lengths / FAST)
        counts = np.clip(np.maximum(paces, np.ceil(PARTS * lengths / (until - start))), 1, None).astype(int)
        return Pushes.joined(every[::-1], (until - ends)[::-1], counts[::-1].tolist())


def _turned(H: Array) -> Array:
    """The signs ``(r,)`` with which the first numbers of ``H (r, d)`` other than 0 are positive."""
    first = H[np.arange(len(H)), (H != 0.0).argmax(axis=1)]
    return np.where(first < 0.0, -1.0, 1.0)


def measurable_pieces(functionals: WorstCase) -> MeasurablePieces | None:
    """What measurable disturbances do on the pieces of a grid, in the units of ``functionals``; ``None`` where there is
    none."""
    model, response = functionals.disturbance, functionals.response
    if model is None or model.kind != "measurable":
        return None
    system, ends = response.system, response.grid.breakpoints[1:].tolist()
    kind = VaryingPieces if response.grid.varying else MeasurablePieces
    pieces = kind(functionals, (), np.ones(system.states), np.ones(system.disturbances))
    made: dict[int, Zonoid] = {}
    for piece, which in enumerate(response.which.tolist()):
        if which not in made:
            made[which] = Zonoid.of(pieces.pushes(piece, ends[piece]), model.bound)
    return replace(pieces, zonoids=tuple(made[which] for which in response.which.tolist()))
