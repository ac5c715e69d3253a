"""`Execution` of systems that change with time: ``c'Phi(t, s) B_j(s)`` takes the place of ``c'e^{A(t-s)} B_j``.

On every piece between two marks ``Phi(end, s) B(s)`` is a polynomial but for a remainder (`Expansion.kernel`), and what
the time after it makes of its end is a row. In the time ``t`` each integrand obeys the equation of the state, so that
the sum is nowhere further above its chord than that says.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.comparison import product
from sparserob_core.control.enclosures.matrix_exponential import rounding
from sparserob_core.control.enclosures.polynomial import distinct_patterns
from sparserob_core.control.enclosures.taylor import Combination
from sparserob_core.control.reach.execution import Execution
from sparserob_core.control.reach.measurable import ACCURACY, AT_ONCE, KEPT, TINY
from sparserob_core.control.reach.support import (
    KnownCellSupport,
    Support,
    _corners,
    between_corners,
    over_directions,
)
from sparserob_core.control.reach.varying_motion import (
    OUTWARD,
    SpreadMotion,
    VaryingMotion,
)
from sparserob_core.control.response.lifted import LiftedSystem
from sparserob_core.control.response.response import Propagator, Response, unique_rows
from sparserob_core.control.response.varying.expansion import Kernel
from sparserob_core.control.sets.integrals import CUTS, HALVINGS, absolute, integrated
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet

POINTS_KEPT = 256  # parameters whose errors are remembered: twice the points of a lattice of parameters
CELLS_KEPT = 16  # cells of parameters whose errors are: those of all rows of a few constraints
STEP = 1e-6  # of the horizon, over which a slope is a difference: a tenth of it shows what integrals are rounded to


@final
@dataclass(frozen=True, eq=False)
class VaryingExecution(Execution):
    """`Execution` of a system that changes with time; ``disturbing``: what is commanded enters through ``E``, all of
    it on every piece between ``breakpoints``, as the disturbances of a `VaryingMeasurable` do. ``bound``: a set of
    what enters by the columns ``through (m,)`` of ``E`` at once, in the place of channels of their own; there is one
    share of 1 then, and integrals are those of its support function."""

    disturbing: bool = False
    bound: ConvexSet | None = None
    through: np.ndarray | None = None
    _lengths: dict[bytes, Array] = field(default_factory=dict, repr=False)
    _ways: dict[bytes, tuple[Array, Kernel]] = field(default_factory=dict, repr=False)
    _reaching: dict[bytes, VaryingExecutionCellSupport] = field(default_factory=dict, repr=False)

    def none(self) -> VaryingExecution:
        """`Execution.none`; what is remembered is of these shares."""
        return replace(self, shares=np.zeros(self.shares.size), _lengths={}, _reaching={})

    def following(self, propagator: Propagator, initial_state: Array) -> VaryingExecution:
        """Return the errors along states ``(d,)`` or their coefficients ``(M d,)``, that a propagator moves."""
        response = Response(propagator.system, propagator.grid, initial_state, shared=propagator)
        felt = np.tile(self.felt, initial_state.size // self.felt.size)
        return replace(self, response=response, felt=felt, _lengths={}, _ways={}, _reaching={})

    def over(
        self,
        control: Array,
        rows: Array,
        leg: LiftedSystem | VaryingMotion | SpreadMotion,
        joined: Combination | None = None,
    ) -> Support:
        """`Execution.over`."""
        assert isinstance(leg, VaryingMotion)
        return over_directions(lambda every: VaryingExecutionCellSupport(self, control, every, leg), rows, leg, joined)

    def reaching(self, control: Array) -> VaryingExecutionCellSupport:
        """What errors of a control can have made of all coefficients, whatever the functional; remembered."""
        key = control.tobytes()
        if key not in self._reaching:
            found = VaryingExecutionCellSupport(self, control, np.zeros((0, self.motion.states)), self.motion)
            remember(self._reaching, key, found, KEPT)
        return self._reaching[key]

    @cached_property
    def motion(self) -> VaryingMotion:
        """That of the response."""
        return VaryingMotion(self.response.propagator, self.response.initial_state)

    @cached_property
    def columns(self) -> np.ndarray:
        """The columns of ``[B E]`` through which errors enter."""
        first = self.motion.expansion.channels[0] if self.disturbing else 0
        return first + (np.arange(self.far.size) if self.through is None else self.through)

    @cached_property
    def far(self) -> Array:
        """How far from 0 at most what enters by each column is, ``(m,)``, where the command is 1."""
        if self.bound is None:
            return self.shares
        box = self.bound.bounding_box()
        return np.asarray(np.maximum(np.abs(box.lower), np.abs(box.upper)) * OUTWARD)

    @cached_property
    def around(self) -> VaryingExecution:
        """The errors of the box around the set, where there is one."""
        if self.bound is None:
            return self
        return replace(self, shares=self.far, bound=None, _lengths={}, _reaching={})

    @cached_property
    def acting(self) -> np.ndarray:
        """What acts between marks, ``(L,)``: a piece of the command, after what did before the first of them where
        they act late (`acts`)."""
        grid = self.motion.grid
        if not self.disturbing:
            return np.asarray(grid.control_piece + self.late)
        middles = (grid.breakpoints[:-1] + grid.breakpoints[1:]) / 2
        return np.clip(np.searchsorted(self.breakpoints, middles) - 1, 0, self.breakpoints.size - 2)

    @property
    def late(self) -> int:
        """How much acts before the first piece of the command: 1, or 0 where that acts at once."""
        return int(self.motion.grid.before is not None and not self.disturbing)

    def acts(self, control: Array) -> Array:
        """The size of all that acts, ``(m, late + K)``, from a command ``(m, K)``."""
        size, before = np.abs(control), self.motion.grid.before
        return size if before is None or not self.late else np.column_stack([np.abs(before), size])

    @cached_property
    def kernel(self) -> Kernel:
        """Of the pieces between all marks."""
        marks = self.motion.grid.breakpoints
        return self.motion.expansion.kernel(marks[:-1], marks[1:])

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """`Execution.lengths`."""
        found = self._of_each(times, directions)[:, :, self.late :]
        return found.reshape(times.size, self.shares.size * (self.breakpoints.size - 1))

    @shaped
    def given(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, " k"]:
        """`Execution.given`, where commands act late."""
        if not self.late:
            return np.zeros(times.size)
        return self.added(np.zeros((self.shares.size, self.breakpoints.size - 1)), times, directions)

    def _of_each(self, times: Array, directions: Array) -> Array:
        """What each size of 1 of all that acts adds, ``(k, m, late + K)``."""
        every = np.ones((self.shares.size, self.late + self.breakpoints.size - 1), dtype=bool)
        return np.asarray(self._over_pieces(times, directions, every).mean(axis=3))

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.added`."""
        return np.asarray(self._summed(control, times, directions).mean(axis=1))

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`Execution.sampled`: where that is not too much, from the lengths, which are the same for every control."""
        if times.size * self.size > AT_ONCE:
            return self.added(control, times, directions)
        key = times.tobytes() + directions.tobytes()
        if key not in self._lengths:
            found = self._of_each(times, directions)
            remember(self._lengths, key, found.reshape(times.size, found.shape[1] * found.shape[2]), KEPT)
        return np.asarray(self._lengths[key] @ self.acts(control).ravel())

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.slope`, as a difference over a little time before; nothing is proven by it."""
        before = np.maximum(times - STEP * float(self.breakpoints[-1]), 0.0)
        now, then = (self.added(control, at, directions) for at in (times, before))
        return np.asarray((now - then) / np.where(times > before, times - before, 1.0))

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`, but for what transitions are off by."""
        bounds = self._summed(control, times, directions)
        lost = rounding(self.size + 8) * np.abs(bounds).max(axis=1)
        return np.asarray(bounds + lost[:, None] * [-1.0, 1.0])

    def _summed(self, control: Array, times: Array, directions: Array) -> Array:
        """What errors of a control add, between two bounds, ``(k, 2)``."""
        size = self.acts(control)
        bounds: Array = self._over_pieces(times, directions, np.asarray(size > 0.0))
        return np.asarray(np.einsum("kjpe,jp->ke", bounds, size))

    def _over_pieces(self, times: Array, directions: Array, wanted: np.ndarray) -> Array:
        """Bounds of ``share_j int |c'Phi(t, s) B_j(s)| ds`` over all that acts, ``(k, m, late + K, 2)``; 0 for what is
        not ``wanted (m, late + K)``."""
        found = np.zeros((times.size, *wanted.shape, 2))
        asked = np.logical_and(wanted, self.shares[:, None] > 0.0)
        acting = self.acting
        pieces = np.flatnonzero(asked[:, acting].any(axis=0))
        if not pieces.size or not times.size:
            return found
        directions = directions * self.felt
        each = max(1, AT_ONCE // (pieces.size * self.kernel.terms[0].size + acting.size * directions.shape[1]))
        for begin in range(0, times.size, each):
            part = slice(begin, begin + each)
            for who, piece, bounds in self._bounds(times[part], directions[part], pieces, asked):
                np.add.at(found.swapaxes(1, 2), (begin + who, acting[piece]), bounds)
        return found

    def _bounds(
        self, times: Array, directions: Array, pieces: np.ndarray, asked: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Array]]:
        """Of ``times (k,)`` and ``pieces`` between marks that begin before them: the numbers of both, ``(q,)``, and the
        bounds ``(q, m, 2)``; of pieces that are over by then, and of those that are not."""
        motion, grid = self.motion, self.motion.grid
        steps = motion.flow.state
        place = np.clip(np.searchsorted(grid.breakpoints, times, side="left") - 1, 0, grid.pieces - 1)
        distinct, where = np.unique(np.stack([times, grid.breakpoints[place]]), axis=1, return_inverse=True)
        where = where.reshape(-1)
        begun, kernel = self._begun(distinct)
        row, rows = np.zeros(directions.shape), np.empty((times.size, *directions.shape[1:], grid.pieces))
        first = np.einsum("ki,kij->kj", directions, begun[where])
        for k in range(int(place.max()) - 1, int(pieces[0]) - 1, -1):  # rows on the end of every piece
            row = np.where((place == k + 1)[:, None], first, row)
            rows[:, :, k] = row
            row = row @ steps[k]
        who, which = np.nonzero(pieces < place[:, None])
        piece = pieces[which]
        yield who, piece, self._along(self.kernel, piece, rows[who, :, piece], asked[:, self.acting[piece]])
        here = np.flatnonzero(np.isin(place, pieces) & np.greater(times, grid.breakpoints[place]))
        piece = place[here]
        yield here, piece, self._along(kernel, where[here], directions[here], asked[:, self.acting[piece]])

    def _begun(self, distinct: Array) -> tuple[Array, Kernel]:
        """Of times, and the breakpoints before them, ``(2, k)``: the transitions from these, ``(k, d, d)``, and the
        kernel on the way; remembered, since the same times are asked for in many directions."""
        key = distinct.tobytes()
        if key not in self._ways:
            until, expansion = np.maximum(*distinct), self.motion.expansion
            found = expansion.flow(distinct[1], until).state, expansion.kernel(distinct[1], until)
            remember(self._ways, key, found, max(1, AT_ONCE // (found[0].size + found[1].terms.size)))
        return self._ways[key]

    def _along(self, kernel: Kernel, which: np.ndarray, rows: Array, asked: np.ndarray) -> Array:
        """Bounds ``(q, m, 2)`` of what intervals ``which (q,)`` of a kernel make of ``rows (q, d)`` on their ends, of
        channels that are ``asked (m, q)``."""
        m, units, columns = self.shares.size, self.motion.expansion.units, self.columns
        if self.bound is not None:
            return self._together(self.bound, kernel, which, rows)
        sizes = np.einsum("qd,qdm->qm", np.abs(rows), np.abs(kernel.terms[..., columns]).sum(axis=1)[which])
        lost = np.einsum("qd,qdm->qm", np.abs(rows) * units, kernel.sizes[which][..., columns])
        lost = lost * kernel.error[which, None]
        # a cut rounds every coefficient four times for every order; halves, of half the length each, twice in all
        lost = lost + rounding(rows.shape[1] + (2 + 4 * CUTS) * kernel.terms.shape[1] + HALVINGS) * sizes
        bounds = np.zeros((which.size, m, 2))
        for j, share in enumerate(self.shares):
            mine = np.flatnonzero(asked[j])
            terms = np.einsum("qd,qpd->qp", rows[mine], kernel.terms[which[mine], :, :, columns[j]])
            accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes[mine, j], TINY)
            found = absolute(terms, accuracy)
            found = found + lost[mine, j, None] * [-1.0, 1.0]
            bounds[mine, j] = share * np.maximum(found, 0.0) * [1.0 / OUTWARD, OUTWARD]
        return bounds

    def _together(self, bound: ConvexSet, kernel: Kernel, which: np.ndarray, rows: Array) -> Array:
        """`_along` of a set of what enters by all columns, ``(q, 1, 2)``."""
        columns, far = self.columns, self.far
        sizes = np.einsum("qd,qdm->qm", np.abs(rows), np.abs(kernel.terms[..., columns]).sum(axis=1)[which]) @ far
        units = np.abs(rows) * self.motion.expansion.units
        lost = np.einsum("qd,qdm->qm", units, kernel.sizes[which][..., columns]) @ far * kernel.error[which]
        lost = lost + rounding(rows.shape[1] + 2 * kernel.terms.shape[1] + HALVINGS + 2 * far.size) * sizes
        terms = np.einsum("qd,qpdm->qpm", rows, kernel.terms[which][..., columns])
        accuracy = np.maximum(ACCURACY * self.motion.grid.pieces * sizes, TINY)
        found = integrated(bound, terms, np.ones(which.size), accuracy)
        return np.asarray(found + OUTWARD * lost[:, None] * [-1.0, 1.0])[:, None]


@final
@dataclass(frozen=True, eq=False)
class UncertainExecution(Execution):
    """`Execution` of a system that changes with time and has parameters: ``known`` is that of a known one, to be made
    for each parameter and on each cell. Directions are followed by their parameters (`seen`)."""

    known: VaryingExecution
    _at: dict[bytes, VaryingExecution] = field(default_factory=dict, repr=False)
    _on: dict[bytes, tuple[SpreadMotion, VaryingExecution]] = field(default_factory=dict, repr=False)

    def none(self) -> UncertainExecution:
        """`Execution.none`."""
        return replace(self, shares=np.zeros(self.shares.size), known=self.known.none(), _at={}, _on={})

    @property
    def around(self) -> UncertainExecution:
        """`VaryingExecution.around`."""
        around = self.known.around
        return self if around is self.known else replace(self, shares=around.shares, known=around, _at={}, _on={})

    def seen(self, directions: Array, parameters: Array) -> Array:
        """`Execution.seen`: with the parameters behind them."""
        return np.hstack([directions, parameters])

    def at(self, parameter: Array) -> VaryingExecution:
        """Return the errors of the known system at a ``parameter (nu,)``; the last ones are remembered."""
        if not self.shares.any():  # there may be no parameters
            return self.known
        key = parameter.tobytes()
        if key not in self._at:
            found = self.known.following(self.response.propagator.at_point(parameter), self.response.initial_state)
            remember(self._at, key, found, POINTS_KEPT)
        return self._at[key]

    def over(
        self,
        control: Array,
        rows: Array,
        leg: LiftedSystem | VaryingMotion | SpreadMotion,
        joined: Combination | None = None,
    ) -> Support:
        """`Execution.over`."""
        assert isinstance(leg, SpreadMotion)
        assert joined is None  # refused beside curved sets
        key = id(leg).to_bytes(8)  # of a leg that is kept beside
        if key not in self._on:
            every = self.known.following(leg.motion.propagator, leg.motion.initial_state)
            remember(self._on, key, (leg, every), CELLS_KEPT)
        return SpreadExecutionSupport(self._on[key][1].reaching(control), rows, leg)

    def _each(
        self, directions: Array, found: Array, of: Callable[[VaryingExecution, np.ndarray, Array], Array]
    ) -> Array:
        """Fill what is ``found (k, ...)`` with what it is ``of`` the errors at every parameter."""
        d = self.felt.size
        unique, which = unique_rows(directions[:, d:])
        for number, parameter in enumerate(unique):
            here = np.flatnonzero(which == number)
            found[here] = of(self.at(parameter), here, directions[here, :d])
        return found

    @shaped
    def lengths(self, times: Float[Array, " k"], directions: Float[Array, "k d"]) -> Float[Array, "k n"]:
        """`Execution.lengths`."""
        found = np.empty((times.size, self.size))
        return self._each(directions, found, lambda one, here, c: one.lengths(times[here], c))

    def given(self, times: Array, directions: Array) -> Array:
        """`Execution.given`."""
        return self._each(directions, np.empty(times.size), lambda one, here, c: one.given(times[here], c))

    @shaped
    def added(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.added`."""
        return self._each(directions, np.empty(times.size), lambda one, here, c: one.added(control, times[here], c))

    def sampled(self, control: Array, times: Array, directions: Array) -> Array:
        """`Execution.sampled`."""
        return self._each(directions, np.empty(times.size), lambda one, here, c: one.sampled(control, times[here], c))

    @shaped
    def slope(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, " k"]:
        """`Execution.slope`."""
        return self._each(directions, np.empty(times.size), lambda one, here, c: one.slope(control, times[here], c))

    @shaped
    def enclosed(
        self, control: Float[Array, "m K"], times: Float[Array, " k"], directions: Float[Array, "k d"]
    ) -> Float[Array, "k 2"]:
        """`Execution.enclosed`."""
        found = np.empty((times.size, 2))
        return self._each(directions, found, lambda one, here, c: one.enclosed(control, times[here], c))


def followed(errors: VaryingExecution) -> VaryingExecution | UncertainExecution:
    """Return the errors of a system that changes with time: where it has parameters, at each of them and on cells."""
    if errors.response.propagator.laws is None:
        return errors
    return UncertainExecution(errors.response, errors.breakpoints, errors.shares, errors.felt, errors)


@final
@dataclass(frozen=True, eq=False)
class VaryingExecutionCellSupport(KnownCellSupport):
    """`ExecutionCellSupport` of a system that changes with time; ``motion`` is its."""

    execution: VaryingExecution
    control: Array
    rows: Array
    motion: VaryingMotion

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r 0"]
    ) -> tuple[Float[Array, "k r 1"], Float[Array, "k r"]]:
        """What is added ``(k, r, 1)`` and how far it may be from that, ``(k, r)``; ``ends (k, r, 0)``."""
        return self.between(self.execution.enclosed(self.control, *self.repeated(times)))

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """Bounds ``(k, r)`` of how far it is above its chord on ``[start, start + width]``, each inside one piece.

        With ``g(t, s) = c'Phi(t, s) B(s)`` the second derivative of the integral of ``|g|`` up to ``t`` is at least
        ``-|c'B'| - |c'A B| - int |g_tt| ds``, and ``g_tt = c'(A' + A^2) Phi B``: where ``g`` changes its sign the slope
        jumps upwards only. All of it is bounded at the start, and how much it changes within the cell.
        """
        motion, d, columns = self.motion, self.motion.states, self.execution.columns
        pieces = np.minimum(motion.place(start), motion.origin.size - 1)
        (law, slope), width = motion.law(start, pieces), widths[:, None]
        entering = np.append(np.arange(d), d + columns)
        law, slope = law[:, :, entering], slope[:, :, entering]
        most, second, third = (one[pieces][:, :, entering] for one in (motion.most, motion.second, motion.third))
        begun, pushed = self._sizes(start), self.sizing[pieces]
        exact = np.abs(self.rows @ (slope[:, :, :d] + law[:, :, :d] @ law[:, :, :d]))
        now = np.abs(self.rows @ slope[:, :, d:]) + np.abs(self.rows @ law[:, :, :d] @ law[:, :, d:])
        entered = width * np.einsum("kim,km->ki", most[:, :, d:], pushed)
        grown = motion.grown(pieces, widths, begun + entered)
        turned = np.einsum("kij,kj->ki", third[:, :, :d], grown) + np.einsum("kim,km->ki", third[:, :, d:], pushed)
        turned = width * turned + np.einsum("kij,kj->ki", second[:, :, :d], entered)
        rounded = np.einsum("kij,kj->ki", second[:, :, :d], begun) + np.einsum("kim,km->ki", second[:, :, d:], pushed)
        turned = turned + rounding(2 * motion.terms) * rounded
        along = np.einsum("krj,kj->kr", exact, begun) + np.einsum("krm,km->kr", now, pushed)
        return np.asarray(width**2 / 8 * (along + turned @ np.abs(self.rows).T) * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, on every piece: ``(r, K)``."""
        return product(np.abs(self.rows), self.missed.T)

    @cached_property
    def missed(self) -> Array:
        """What states are off by, on every piece, ``(K, d)``."""
        pushed = self.motion.flow.sizes[..., self.execution.columns] * self.sizing[:, None]
        return self.motion.left_out(self.at_marks[:-1], pushed)

    @cached_property
    def reached(self) -> Array:
        """As in `VaryingSupport`, ``(K, d)``."""
        motion, lengths = self.motion, self.motion.grid.lengths
        columns = motion.states + self.execution.columns
        entered = np.einsum("kim,km->ki", motion.most[:, :, columns], self.sizing)
        return motion.grown(motion.every, lengths, self.at_marks[:-1] + lengths[:, None] * entered)

    @cached_property
    def sizing(self) -> Array:
        """How large errors may be on every piece between marks, ``(K, m)``."""
        size = self.execution.far[:, None] * self.execution.acts(self.control)
        return np.asarray(size[:, self.execution.acting].T * OUTWARD)

    @cached_property
    def at_marks(self) -> Array:
        """What errors can have made of every state at the marks, ``(K + 1, d)``, at most."""
        return self._sizes(self.motion.grid.breakpoints)

    def _sizes(self, times: Array) -> Array:
        """What errors can have made of every state, ``(k, d)``, at most; of a set of what enters by several columns at
        once those of the box around it, whose integrals are of absolute values."""
        around, d = self.execution.around, self.motion.states
        control = np.repeat(self.control, around.shares.size // self.execution.shares.size, axis=0)
        found = around.enclosed(control, *self._each(times, np.eye(d)))[:, 1]
        return np.asarray(np.maximum(found, 0.0).reshape(-1, d) * OUTWARD)

    @staticmethod
    def _each(times: Array, rows: Array) -> tuple[Array, Array]:
        """Every time with every row."""
        return np.repeat(times, len(rows)), np.tile(rows, (times.size, 1))


@final
@dataclass(frozen=True, eq=False)
class SpreadExecutionSupport:
    """What errors of execution add to functionals ``rows (r, d)`` over a cell of parameters, in the form of `Support`;
    ``every`` is what they make of all coefficients.

    Of one parameter alone a polynomial ``f`` is nowhere further from its chord than half the largest ``f''`` on
    ``[-1, 1]``, and the absolute value of the chord is not above the chord of the absolute values. So the integrals
    of ``|f|`` are, one parameter after another, at most what is linear in each between those at the corners, and half
    of those of the second derivatives more.
    """

    every: VaryingExecutionCellSupport
    rows: Array
    motion: SpreadMotion

    @shaped
    def steepness(self, times: Float[Array, " k"]) -> Float[Array, "k r nu"]:
        """`Support.steepness`."""
        return np.asarray(self._sizes(times) @ self.motion.space.exponents)

    @shaped
    def at(
        self, times: Float[Array, " k"], ends: Float[Array, "k r nu"]
    ) -> tuple[Float[Array, "k r M"], Float[Array, "k r"]]:
        """`Support.at`."""
        space, sizes, of = self.motion.space, self._sizes(times), self.every
        coefficients, excess = np.zeros((*ends.shape[:2], space.size)), np.zeros(ends.shape[:2])
        patterns, which = distinct_patterns(ends)
        for position, pattern in enumerate(patterns):
            here, row = np.nonzero(which == position)
            free, corners = np.flatnonzero(pattern == 0.0), _corners(pattern)
            powers = space.monomials(corners)
            directions = (powers[:, :, None] * self.rows[row][:, None, None, :]).reshape(len(row) * len(corners), -1)
            bounds = of.execution.enclosed(of.control, np.repeat(times[here], len(corners)), directions)
            bounds = bounds.reshape(len(row), len(corners), 2)
            off = (bounds[..., 1] - bounds[..., 0]).max(axis=1) / 2
            bent = sizes[here, row] @ (space.exponents[:, free] * (space.exponents[:, free] - 1)).sum(axis=1)
            coefficients[here, row], beyond = between_corners(space, pattern, bounds.mean(axis=2))
            excess[here, row] = (off + bent / 2 + beyond) * OUTWARD
        return coefficients, excess

    @shaped
    def deviation(self, start: Float[Array, " k"], widths: Float[Array, " k"]) -> Float[Array, "k r"]:
        """`VaryingExecutionCellSupport.deviation`, by the largest numbers on every piece."""
        bent = self._bent[self._pieces(start)] @ self.motion.sizes(np.abs(self.rows)).T
        return np.asarray((widths**2 / 8)[:, None] * bent * OUTWARD)

    @cached_property
    def neglected(self) -> Array:
        """What is off in the transitions, with what is beyond the degree, on every piece: ``(r, K)``."""
        of, motion, rows = self.every, self.motion, np.abs(self.rows)
        inputs = np.zeros((len(of.sizing), of.motion.most.shape[2] - of.motion.states))
        inputs[:, of.execution.columns] = of.sizing
        lost = motion.truncation.lost(of.at_marks[:-1] + of.missed, inputs)
        return np.asarray((motion.sizes(rows) @ of.missed.T + rows @ lost.T) * OUTWARD)

    @cached_property
    def reached(self) -> Array:
        """`Support.reached`, with what rounding there is more of them."""
        return np.asarray((1.0 + self.motion.space.size) * self.motion.folded(self.every.reached))

    @cached_property
    def _bent(self) -> Array:
        """The second derivative in time of every coefficient, at most, on every piece, ``(K, states)``."""
        of, d = self.every, self.every.motion.states
        second = of.motion.second
        pushed = second[:, :, d + of.execution.columns]
        found = np.einsum("kij,kj->ki", second[:, :, :d], of.reached) + np.einsum("kim,km->ki", pushed, of.sizing)
        return np.asarray(found * OUTWARD)

    def _sizes(self, times: Array) -> Array:
        """What errors add along every coefficient on the cell, at most, ``(k, r, M)``."""
        reached = self.every.reached[self._pieces(times)].reshape(times.size, self.motion.space.size, -1)
        along = np.einsum("rd,kad->kra", np.abs(self.rows), reached)
        return np.asarray(along * OUTWARD)

    def _pieces(self, times: Array) -> np.ndarray:
        return np.asarray(np.minimum(self.every.motion.place(times), self.every.motion.origin.size - 1))
