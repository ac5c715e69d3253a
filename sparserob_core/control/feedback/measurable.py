"""Measurable disturbances under feedback: their effects on the state within a piece and at its end.

The control measures the state at breakpoints. So, of a disturbance on a piece of the grid, only one vector counts once
the piece is over: its effect on the state at the end, a point of a `Zonoid`. On the piece that holds ``t`` the control
has not responded yet. The contribution of this piece to ``c'x(t)`` is the support function of a set that does not
depend on the decision.
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
from sparserob_core.control.feedback.zonoid import FAST, PARTS, Arc, KernelPolynomial, Zonoid, corners
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.measurable import SUPPORT_ERROR
from sparserob_core.control.reach.varying_execution import VaryingExecution, VaryingExecutionCellSupport
from sparserob_core.control.reach.varying_measurable import VaryingMeasurable
from sparserob_core.control.reach.varying_motion import OUTWARD, VaryingMotion
from sparserob_core.control.sets.sets import Polytope
from sparserob_core.sip.convex_set import Array, ConvexSet

KNOWN = np.zeros((1, 0))
TERMS = 8  # of the expansion that bounds a slope
ENCLOSED_KEPT = 8  # lists of times at which what a piece has done is remembered: both ends of the cells of a few rows
ANSWERED_SHARE = 1e-7  # of the largest extent of a piece's set, one along which it is answered


@dataclass(frozen=True, eq=False)
class MeasurablePieces:
    """Effects of measurable disturbances on the state, one point of a zonoid for every piece of a grid.

    Parameters
    ----------
    functionals : WorstFunctionals
        Functionals of the system.
    zonoids : tuple of Zonoid
        Sets of effects, one for every piece, in the problem's own units.
    states : ndarray, shape (d,)
        Own units of the states, in the units of ``functionals``.
    disturbances : ndarray, shape (mw,)
        Own units of the disturbance, in the units of ``functionals``.
    composed : dict
        Signals that were found for points of the zonoids, in any units.
    """

    functionals: WorstFunctionals
    zonoids: tuple[Zonoid, ...]
    states: Array
    disturbances: Array
    composed: dict[tuple[int, bytes], Arc] = field(default_factory=dict, repr=False)

    def in_units_of(self, functionals: WorstFunctionals, states: Array, disturbances: Array) -> MeasurablePieces:
        """Return the same effects for ``functionals`` of the same problem in other units.

        The own units of the zonoids are ``states (d,)`` and ``disturbances (mw,)`` in the units of ``functionals``.
        """
        return replace(self, functionals=functionals, states=states, disturbances=disturbances[: self.middle.size])

    @cached_property
    def sets(self) -> tuple[tuple[int, ConvexSet], ...]:
        """The sets of the deviations, one block for every piece, as in `Spread`."""
        sets: list[tuple[int, ConvexSet]] = []
        for zonoid in self.zonoids:
            if sets and sets[-1][1] is zonoid:
                sets[-1] = (sets[-1][0] + 1, zonoid)
            elif zonoid.dimension:
                sets.append((1, zonoid))
        return tuple(sets)

    @property
    def size(self) -> int:
        """Number ``Q`` of entries of a deviation."""
        return sum(zonoid.dimension for zonoid in self.zonoids)

    @cached_property
    def _starts(self) -> list[int]:
        return list(accumulate((zonoid.dimension for zonoid in self.zonoids), initial=0))

    def at(self, piece: int) -> tuple[slice, Array]:
        """Return the slice of a piece's entries among all deviations, and the matrix ``(d, r)`` from them to the state
        at the end of the piece."""
        outward = self.states[:, None] * self.zonoids[piece].outward
        return slice(self._starts[piece], self._starts[piece + 1]), outward

    def mark_answered(self, piece: int) -> np.ndarray:
        """Return which coordinates ``(r,)`` of a piece the control responds to: those whose extent is not
        negligible."""
        sizes = np.linalg.norm(self.zonoids[piece].outward, axis=0)
        large: np.ndarray = sizes > ANSWERED_SHARE * sizes.max(initial=0.0)
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
        """Largest deviation of every channel of the disturbance, ``(mw,)``."""
        model = self.functionals.disturbance
        assert model is not None
        axes = np.eye(self.middle.size)
        ends = (model.bound.support(axes) - self.middle, model.bound.support(-axes) + self.middle)
        radii: Array = np.maximum(*ends)
        return radii

    def within(self, times: Array, H: Array, pieces: np.ndarray | None = None) -> Array:
        """Return the largest contribution, until ``times (k,)``, of the piece that holds the time to ``H x(t)``:
        ``(k, r)``.

        It is the middle of its bounds, for whose distance `allowance` allows. The contribution of the middle of the
        disturbance is not included. ``pieces (k,)`` names the pieces; without it they are those of the grid that hold
        the times.
        """
        response, k, r = self.functionals.response, times.size, H.shape[0]
        pieces = response.grid.locate(times) if pieces is None else pieces
        distinct, inverse = np.unique(
            np.clip(times - response.grid.breakpoints[pieces], 0.0, None), return_inverse=True
        )
        count = distinct.size
        none = np.zeros((count * r, 0))
        support = self.functionals.measurable
        assert support is not None
        contributions = support(np.repeat(distinct, r), np.tile(H, (count, 1)), none).reshape(count, r)
        _, E = self._matrices
        contributions = contributions - (H @ response.flows(distinct)[1] @ (E @ self.middle))
        return np.asarray(contributions[inverse.reshape(k)])

    def allowance(self, lower: Array, upper: Array, H: Array, pieces: np.ndarray) -> Array:
        """Bound the excess of `within` over its chord on cells ``[lower, upper] (k,)`` of ``pieces (k,)``: ``(k, r)``.

        The bound uses that the integrand is Lipschitz. It includes the relative error `SUPPORT_ERROR` that is allowed
        for `within`.
        """
        response, (A, E) = self.functionals.response, self._matrices
        offsets = np.clip(lower - response.grid.breakpoints[pieces], 0.0, None)
        h = (upper - lower)[:, None]
        row = H @ response.flows(offsets)[0] @ A
        slope, factor = np.zeros(row.shape[:2]), np.ones_like(h)
        for order in range(TERMS):
            slope += factor * (np.abs(row @ E) @ self._radii)
            row, factor = row @ A, factor * h / (order + 1)
        input_bound = float(np.linalg.norm(np.abs(E) @ self._radii))
        with np.errstate(over="ignore", invalid="ignore"):
            slope += factor * np.exp(np.linalg.norm(A, 2) * h) * np.linalg.norm(row, axis=2) * input_bound
        return np.asarray(h**2 / 8.0 * slope + SUPPORT_ERROR * np.abs(self.within(upper, H, pieces)))

    @property
    def effect_sizes(self) -> tuple[Array, Array]:
        """Sizes that `VaryingMotion.bound_state_errors` needs for a system whose transitions are inexact; 0 here, where
        they are not.

        The first array ``(K, d)`` bounds the contribution of the current piece to every state, at all marks but the
        last. The second array ``(K, d, m)`` bounds what drives the states between marks.
        """
        L, d = self.functionals.response.grid.pieces, self.states.size
        return np.zeros((L, d)), np.zeros((L, d, 0))

    def compute_transitions(self, pieces: np.ndarray, times: Array) -> Array:
        """Return the transitions ``(k, d, d)`` of the state from the ends of ``pieces (k,)`` to later ``times (k,)``;
        the identity for earlier times."""
        response = self.functionals.response
        return response.flows(np.clip(times - response.grid.breakpoints[pieces + 1], 0.0, None))[0]

    def build_kernel(self, piece: int, until: float) -> KernelPolynomial:
        """Return the kernel from a disturbance on ``piece`` to the state at the time ``until`` within the piece."""
        return KernelPolynomial.of(*self._matrices, until - float(self.functionals.response.grid.breakpoints[piece]))

    def weights(self, time: float, H: Array, pieces: np.ndarray) -> Array:
        """Return the contribution of every deviation to ``H x(time)`` without control, ``(r, Q)``.

        Every row takes the state in one of ``pieces (r,)``; only deviations of earlier pieces contribute.
        """
        weights, count = np.zeros((H.shape[0], self.size)), int(pieces.max(initial=0))
        flows = self.compute_transitions(np.arange(count), np.full(count, time))
        for piece in range(count):
            entries, outward = self.at(piece)
            rows = pieces > piece
            weights[rows, entries] = H[rows] @ flows[piece] @ outward
        return weights

    def signal(self, deviation: Array, time: float, direction: Array | None, over: int) -> tuple[Array, Array]:
        """Return breakpoints ``(L + 1,)``, with those of the grid, and a disturbance ``(mw, L)`` between them that has
        the ``deviation (Q,)``.

        On piece ``over``, in which the state is taken, the disturbance is the worst for ``direction'x(time)`` until
        ``time``, and the middle for the rest of the piece.
        """
        grid = self.functionals.response.grid
        arcs, ends, values = self._compose_arcs(deviation), [], []
        for piece, (start, stop) in enumerate(zip(grid.breakpoints[:-1], grid.breakpoints[1:], strict=True)):
            if direction is not None and piece == over and time > start:
                arc = self._build_partial_zonoid(piece, time).best(direction)
                ends += [start + arc.ends[:-1] * (time - start), [min(time, stop)]]
                values.append(arc.values)
                if time < stop:
                    ends.append([stop])
                    values.append(np.zeros((1, self.middle.size)))
                continue
            arc = arcs[piece]
            ends += [start + arc.ends[:-1] * (stop - start), [stop]]
            values.append(arc.values * self.disturbances)
        points = np.concatenate([[grid.breakpoints[0]], *ends])
        is_kept = np.diff(points) > 0.0
        return np.concatenate([points[:1], points[1:][is_kept]]), (self.middle + np.vstack(values)[is_kept]).T

    def compose(self, deviations: Sequence[Array]) -> None:
        """Find the signals on all pieces that have these deviations ``(Q,)``, all at once, and keep them."""
        points_of_zonoids: dict[int, dict[bytes, tuple[int, Array]]] = {}
        for deviation in deviations:
            for piece, zonoid in enumerate(self.zonoids):
                point = deviation[self.at(piece)[0]]
                if point.size and point.any() and (id(zonoid), point.tobytes()) not in self.composed:
                    points_of_zonoids.setdefault(id(zonoid), {})[point.tobytes()] = (piece, point)
        for key, points in points_of_zonoids.items():
            piece = next(iter(points.values()))[0]
            arcs = self.zonoids[piece].signals(np.stack([point for _, point in points.values()]))
            self.composed.update({(key, point): arc for point, arc in zip(points, arcs, strict=True)})

    def attained(self, deviation: Array) -> Array:
        """Return the deviation ``(Q,)`` of the `signal` of a given deviation; the two differ by the residual of
        composing the signal."""
        effects = np.zeros(self.size)
        for piece, (zonoid, arc) in enumerate(zip(self.zonoids, self._compose_arcs(deviation), strict=True)):
            effects[self.at(piece)[0]] = zonoid.evaluate_signal(arc)
        return effects

    def _compose_arcs(self, deviation: Array) -> list[Arc]:
        """Return the signals on all pieces that have a deviation ``(Q,)``."""
        self.compose([deviation])
        zero_arc = Arc(np.ones(1), np.zeros((1, self.middle.size)))
        points = [deviation[self.at(piece)[0]].tobytes() for piece in range(len(self.zonoids))]
        return [
            self.composed.get((id(zonoid), point), zero_arc) for zonoid, point in zip(self.zonoids, points, strict=True)
        ]

    def _build_partial_zonoid(self, piece: int, time: float) -> Zonoid:
        """Return the set of effects of a piece on the state at a time within it, in the coordinates of the state."""
        model, identity = self.functionals.disturbance, np.eye(self.states.size)
        assert model is not None
        return Zonoid(self.build_kernel(piece, time), tuple(corners(model.bound)), identity, identity)


@final
@dataclass(frozen=True, eq=False)
class VaryingPieces(MeasurablePieces):
    """`MeasurablePieces` of a system that changes with time.

    The effect of a piece on the state until now is computed by `VaryingExecution`, as that of errors of a command that
    acts on this piece alone.
    """

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

    def _build_unit_command(self, piece: int) -> Array:
        """Return the command that is 1 on one piece alone, ``(m, L)``."""
        command = np.zeros((self.errors.shares.size, self.functionals.response.grid.pieces))
        command[:, piece] = 1.0
        return command

    def enclosed(self, times: Array, H: Array, pieces: np.ndarray) -> Array:
        """Return a lower and an upper bound of `within`, which do not include the error of the transitions,
        ``(k, r, 2)``.

        Results are kept, since a bound over cells asks for their ends more than once.
        """
        key = b"".join(array.tobytes() for array in (times, H, pieces))
        if key in self._enclosures:
            return self._enclosures[key]
        oriented = H if self.errors.bound is not None else H * _compute_leading_signs(H)[:, None]
        rows, row_inverse = np.unique(oriented + 0.0, axis=0, return_inverse=True)  # of a box opposite rows are one
        enclosures, r = np.zeros((times.size, len(rows), 2)), len(rows)
        for piece in np.unique(pieces):
            indices = np.flatnonzero(pieces == piece)
            distinct, time_inverse = np.unique(times[indices], return_inverse=True)
            bounds = self.errors.enclosed(
                self._build_unit_command(piece), np.repeat(distinct, r), np.tile(rows, (distinct.size, 1))
            )
            enclosures[indices] = bounds.reshape(distinct.size, r, 2)[time_inverse.reshape(-1)]
        remember(self._enclosures, key, enclosures[:, row_inverse.reshape(-1)], ENCLOSED_KEPT)
        return self._enclosures[key]

    @cached_property
    def _enclosures(self) -> dict[bytes, Array]:
        return {}

    def within(self, times: Array, H: Array, pieces: np.ndarray | None = None) -> Array:
        pieces = self.functionals.response.grid.locate(times) if pieces is None else pieces
        return np.asarray(self.enclosed(times, H, pieces).mean(axis=2))

    def allowance(self, lower: Array, upper: Array, H: Array, pieces: np.ndarray) -> Array:
        deviations = np.zeros((lower.size, H.shape[0]))
        for piece in np.unique(pieces):
            indices = np.flatnonzero(pieces == piece)
            cell_support = VaryingExecutionCellSupport(self.errors, self._build_unit_command(piece), H, self.motion)
            deviations[indices] = cell_support.deviation(lower[indices], upper[indices] - lower[indices])
        widths = np.max([np.ptp(self.enclosed(end, H, pieces), axis=2) for end in (lower, upper)], axis=0)
        return np.asarray((deviations + widths / 2.0) * OUTWARD)

    @cached_property
    def effect_sizes(self) -> tuple[Array, Array]:
        """Sizes that `VaryingMotion.bound_state_errors` needs; the errors of kernels are added to the flows of inputs,
        as larger inputs."""
        motion, errors = self.motion, self.errors
        axes = np.vstack([np.eye(motion.states), -np.eye(motion.states)])
        ends = self.enclosed(motion.grid.breakpoints[:-1], axes, motion.origin)[..., 1]
        state_bounds = np.maximum(ends, 0.0).reshape(len(ends), 2, -1).max(axis=1)
        kernel, flow, columns = errors.kernel, motion.flow, errors.columns
        input_sizes = flow.sizes[..., columns] + kernel.sizes[..., columns] * (kernel.error / flow.error)[:, None, None]
        return state_bounds * OUTWARD, input_sizes * errors.error_radii * OUTWARD

    def compute_transitions(self, pieces: np.ndarray, times: Array) -> Array:
        ends = self.functionals.response.grid.breakpoints[pieces + 1]
        return np.asarray(self.motion.expansion.flow(ends, np.maximum(ends, times)).state)

    def build_kernel(self, piece: int, until: float) -> KernelPolynomial:
        """Return the kernel as in `MeasurablePieces.build_kernel`, joined from the kernels between marks, each on parts
        in which the system does not change much."""
        motion, channels = self.motion, self.motion.expansion.channels[0]
        start, marks = float(self.functionals.response.grid.breakpoints[piece]), motion.grid.breakpoints
        ends = np.concatenate([[start], marks[(marks > start) & (marks < until)], [until]])
        kernel, transition = motion.expansion.kernel(ends[:-1], ends[1:]), np.eye(motion.states)
        kernels = [np.zeros((0, 0, 0))] * (ends.size - 1)
        for k, step in reversed(list(enumerate(motion.expansion.flow(ends[:-1], ends[1:]).state))):
            kernels[k], transition = transition @ kernel.terms[k][..., channels:], transition @ step
        lengths = np.diff(ends)
        paces = np.ceil(motion.paces[motion.place(ends[:-1])] * lengths / FAST)
        counts = np.clip(np.maximum(paces, np.ceil(PARTS * lengths / (until - start))), 1, None).astype(int)
        return KernelPolynomial.joined(kernels[::-1], (until - ends)[::-1], counts[::-1].tolist())


def _compute_leading_signs(H: Array) -> Array:
    """Return the signs ``(r,)`` with which the first numbers of ``H (r, d)`` other than 0 are positive."""
    first = H[np.arange(len(H)), (H != 0.0).argmax(axis=1)]
    return np.where(first < 0.0, -1.0, 1.0)


def measurable_pieces(functionals: WorstFunctionals) -> MeasurablePieces | None:
    """Return the effects of measurable disturbances on the pieces of a grid, in the units of ``functionals``; ``None``
    where there is no measurable disturbance."""
    model, response = functionals.disturbance, functionals.response
    if model is None or model.kind != "measurable":
        return None
    system, ends = response.system, response.grid.breakpoints[1:].tolist()
    kind = VaryingPieces if response.grid.varying else MeasurablePieces
    pieces = kind(functionals, (), np.ones(system.states), np.ones(system.disturbances))
    zonoids: dict[int, Zonoid] = {}
    for piece, step in enumerate(response.which.tolist()):
        if step not in zonoids:
            zonoids[step] = Zonoid.of(pieces.build_kernel(piece, ends[piece]), model.bound)
    return replace(pieces, zonoids=tuple(zonoids[step] for step in response.which.tolist()))
