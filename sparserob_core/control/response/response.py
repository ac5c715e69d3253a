"""State responses by matrix exponentials: no time stepping, any times, any parameters, all vectorised.

On every piece of the merged time grid the inputs are constant, so the state follows
``x(tau_l + r) = Phi(r) x(tau_l) + Gamma(r) (B u_l + E w_l)`` with ``Phi(r) = e^{A r}`` and
``Gamma(r) = int_0^r e^{A s} ds``; both are blocks of one exponential of ``[[A, I], [0, 0]]`` (Van Loan 1978, Theorem
1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.flows import FEW_STATES, Exponentials, Leaps
from sparserob_core.control.enclosures.matrix_exponential import EPSILON, transitions
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.varying.expansion import Expansion
from sparserob_core.control.response.varying.spread import Parts, law_of
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array

# Blocks in which states are computed, where they are of two pieces and more. With a tenth of them what a block adds
# from 0 is made of more products; ten times as many are ten times the steps from block to block.
FEWEST = 64
LITTLE = 0.5  # norm of A times the duration of a block, at most
BLOCK = 32  # pieces of a block in which outputs are computed: what grows with it is as large as what does not
# Numbers in transitions over several pieces, beyond as many as those of single ones have (16 MB). Of pieces that all
# differ there are no more; of few kinds that follow each other in any order there would be one for every piece. With a
# tenth of it rows of such a plant of many pieces go from piece to piece, ten times as many are 160 MB.
STRETCHED = 2_000_000
TINY = float(np.finfo(float).tiny)
STEP = 4 * EPSILON  # of the horizon: times that differ by less are a whole piece apart, or not at all
STEPS_KEPT = 16  # sets of parameters whose transitions are remembered
FLOWS_KEPT = 2  # sets of times that a varying system has flown to: a picture asks for many rows at the same ones
SAME_DURATION = 1e-15  # of the horizon: durations that differ by less are computed once
ALIKE = 1e-13  # of the horizon: pieces whose lengths differ by less are equally long
SAME_TIME = 1e-12  # times closer than this share of the horizon are one


@dataclass(frozen=True, eq=False)
class TimeGrid:
    """The union of the times at which control and disturbance may change what they do.

    ``breakpoints (L+1,)``; ``control_piece (L,)`` and ``disturbance_piece (L,)``: which piece of each dictionary acts
    on a piece of the grid; -1 where the control ``before (m,)`` still does. ``constants``: columns of ``B`` beyond
    those of the control, whose input is always 1 (a drift). ``mode (L,)``: which of several systems that take turns
    acts; ``None`` where there is one. ``elapsed``: what went before the time that is called 0 here, where that is a
    later one. ``varying``: the system changes with time, so that every piece is a mode of its own.
    """

    breakpoints: Array
    control_piece: np.ndarray
    disturbance_piece: np.ndarray
    before: Array | None = None
    constants: int = 0
    mode: np.ndarray | None = None
    elapsed: float = 0.0
    varying: bool = False

    @property
    def pieces(self) -> int:
        return int(self.breakpoints.size - 1)

    @property
    def lengths(self) -> Array:
        return np.diff(self.breakpoints)

    @cached_property
    def decided(self) -> np.ndarray:
        """The pieces ``(J,)`` on which a piece of the control acts."""
        return np.flatnonzero(self.control_piece >= 0)

    @shaped
    def inputs(self, control: Float[Array, "m K"]) -> Float[Array, "mc L"]:
        """What acts through every column of ``B`` on the pieces of this grid, from the control on its own pieces."""
        acting = control[:, np.maximum(self.control_piece, 0)]
        if self.before is not None:
            acting = np.where(self.control_piece >= 0, acting, self.before[:, None])
        return np.vstack([acting, np.ones((self.constants, self.pieces))]) if self.constants else acting

    def commanded(self, breakpoints: Array) -> np.ndarray:
        """Which piece of the control with these ``breakpoints (K + 1,)`` is commanded on every piece of the grid,
        ``(L,)``: the one that acts, where there is no delay."""
        middles = (self.breakpoints[:-1] + self.breakpoints[1:]) / 2
        return np.asarray(np.searchsorted(breakpoints, middles) - 1)

    @property
    def modes(self) -> np.ndarray:
        """Which mode acts on every piece, ``(L,)``."""
        return np.zeros(self.pieces, dtype=int) if self.mode is None else self.mode

    def of_modes(self, matrices: Array) -> Array:
        """The matrices ``(J, d, m)`` of every mode, from ``(d, J m)`` side by side."""
        rows, several, modes = *matrices.shape, len(self.turns)
        apart = matrices.reshape(rows, modes, several // modes)
        return np.ascontiguousarray(apart.swapaxes(0, 1))

    @cached_property
    def turns(self) -> list[slice]:
        """The pieces on which every mode acts, one mode after another."""
        if self.mode is None:
            return [slice(0, self.pieces)]
        ends = np.searchsorted(self.mode, np.arange(int(self.mode[-1]) + 2))
        return [slice(int(start), int(stop)) for start, stop in pairwise(ends)]

    def through(self, gains: Array, matrices: Array) -> Array:
        """``gains @ matrices``: weights ``(..., L, d)`` on what drives every piece as weights ``(..., L, m)`` on its
        inputs; ``matrices (..., d, J m)`` are those of the ``J`` modes side by side."""
        if self.mode is None:
            return np.asarray(gains @ matrices)
        parts = np.split(matrices, len(self.turns), axis=-1)
        return np.concatenate(
            [gains[..., turn, :] @ part for turn, part in zip(self.turns, parts, strict=True)], axis=-2
        )

    def driven(self, matrices: Array, inputs: Array) -> Array:
        """What drives every piece, ``(..., L, d)``, from inputs ``(..., m, L)``; as in `through`."""
        if self.mode is None:
            return np.asarray(np.swapaxes(matrices @ inputs, -1, -2))
        parts = np.split(matrices, len(self.turns), axis=-1)
        force = [part @ inputs[..., turn] for turn, part in zip(self.turns, parts, strict=True)]
        return np.swapaxes(np.concatenate(force, axis=-1), -1, -2)

    def leg(self, mode: int) -> TimeGrid:
        """The pieces of one mode, in times from where it begins."""
        turn, breaks = self.turns[mode], self.breakpoints
        start = float(breaks[turn.start])
        points = breaks[turn.start : turn.stop + 1] - start
        acting, pushing = self.control_piece[turn], self.disturbance_piece[turn]
        return TimeGrid(points, acting, pushing, self.before, self.constants, elapsed=start)

    def refined(self, times: Array) -> TimeGrid:
        """A grid on other times, ``(T,)`` from 0 to the horizon, that include the breakpoints; its inputs are given on
        the pieces of this grid."""
        origin = self.locate((times[:-1] + times[1:]) / 2)
        if self.varying:
            return TimeGrid(times, origin, origin, mode=np.arange(origin.size), varying=True)
        return TimeGrid(times, origin, origin, mode=None if self.mode is None else self.mode[origin])

    @shaped
    def distinct(self, durations: Float[Array, " k"]) -> tuple[Float[Array, " u"], Int[np.ndarray, " k"]]:
        """The distinct durations ``(u,)`` among ``(k,)``, those that differ by rounding as one, and which of them each
        is."""
        horizon = self.breakpoints[-1]
        shares, which = np.unique((durations / horizon).round(15), return_inverse=True)
        return shares * horizon, which.reshape(-1)

    @shaped
    def locate(self, times: Float[Array, " k"]) -> Int[np.ndarray, " k"]:
        """Index of the piece that each time ``(k,)`` lies in; a breakpoint belongs to the piece that it ends."""
        return np.minimum(np.maximum(self.breakpoints.searchsorted(times) - 1, 0), self.pieces - 1)


@shaped
def distinct_times(times: Float[Array, " k"], horizon: float) -> Float[Array, " u"]:
    """The times in increasing order, those closer than rounding as one; the first and the last are kept as they are."""
    points = np.unique(times)
    kept = points[np.concatenate([[True], np.diff(points) > SAME_TIME * horizon])]
    kept[-1] = points[-1]
    answer: Array = kept
    return answer


@shaped
def merge_grids(
    control: Float[Array, " K"],
    disturbance: Float[Array, " M"],
    delay: float = 0.0,
    before: Float[Array, " m"] | None = None,
    constants: int = 0,
    switches: Sequence[float] = (),
    varying: bool = False,
) -> TimeGrid:
    """The merged grid of two sets of breakpoints over the same horizon; a control acts later by ``delay``, less than
    the horizon, and ``before (m,)`` acts until then; when it is commanded, and what it answers is measured, is on the
    grid too. The mode changes at ``switches``, or, of a system that is ``varying`` with time, from piece to piece.

    A breakpoint of the disturbance that is one of the control's but for rounding is taken for it. Two breakpoints of
    one set are never taken for one, however near they are, so that no piece of either is lost.
    """
    begin = control
    if delay > 0.0:
        begin, horizon = control + delay, float(control[-1])
        later = np.concatenate([[0.0], begin[begin < horizon - SAME_TIME * horizon], [horizon]])
        control = _joined(control, later)
    points = _joined(control, disturbance)
    if switches:
        points = _joined(points, np.array(switches))
    middles = (points[:-1] + points[1:]) / 2
    acting, pushing = np.searchsorted(begin, middles) - 1, np.searchsorted(disturbance, middles) - 1
    mode = np.searchsorted(switches, middles) if switches else np.arange(middles.size) if varying else None
    return TimeGrid(points, acting, pushing, before if delay > 0.0 else None, constants, mode, varying=varying)


def _joined(points: Array, others: Array) -> Array:
    """Both sets of breakpoints, those of the second that are one of the first but for rounding left out."""
    after = np.clip(np.searchsorted(points, others), 1, points.size - 1)
    nearest = np.where(others - points[after - 1] <= points[after] - others, after - 1, after)
    near = np.abs(others - points[nearest]) <= SAME_TIME * float(points[-1])
    same = near & (np.diff(np.where(near, nearest, -1), prepend=-1) != 0)  # the first of those near one breakpoint
    return np.union1d(points, others[~same])


@dataclass(frozen=True, eq=False)
class Steps:
    """Matrices at ``v`` parameters, ``A (v, J, d, d)`` of every mode and ``B``, ``E`` of all modes side by side, and
    their transitions over whole pieces of ``q`` distinct modes and lengths: ``Phi = e^{A h}`` and
    ``Gamma = int_0^h e^{A s} ds``, ``(v, q, d, d)`` each; ``modes (q,)``: of which mode these are."""

    A: Array
    B: Array
    E: Array
    Phi: Array
    Gamma: Array
    modes: np.ndarray

    @cached_property
    def inputs(self) -> Array:
        """The columns of ``B`` and of ``E`` of every mode, ``(v, J, d, m + mw)``."""
        parts = (np.stack(np.split(part, self.A.shape[1], axis=-1), axis=1) for part in (self.B, self.E))
        return np.concatenate(list(parts), axis=-1)

    @cached_property
    def pushed(self) -> Array:
        """``[Gamma (B, E), Phi] (v, q, d, m + mw + d)``: a row takes both in one product."""
        return np.concatenate([self.Gamma @ self.inputs[:, self.modes], self.Phi], axis=-1)

    @cached_property
    def driven(self) -> Array:
        """The same of every direction that the state is driven in, ``[Gamma, Phi] (v, q, d, 2 d)``."""
        return np.concatenate([self.Gamma, self.Phi], axis=-1)


class Weights(NamedTuple):
    """Functionals ``c'x(t)`` of ``k`` indices as weights on all that they depend on: ``free (k, d)`` on the initial
    state, ``control (k, L, m)`` on what acts through the columns of ``B`` on every piece, ``disturbance (k, L, mw)`` on
    what acts through those of ``E``."""

    free: Array
    control: Array
    disturbance: Array


@dataclass(frozen=True, eq=False)
class Impulses:
    """What inputs through ``columns M (d, c)`` on a piece give to later states, by the age of the piece: ``e^{A i h}
    Gamma(h) M``; for a known system and equal pieces, whose response is a convolution with this.

    No table of all ages is made. Those of the first ``reach`` ages (baby steps) and rows that went on by a multiple of
    ``reach`` (giant steps) are multiplied: ``O(sqrt(L) d^2)`` numbers for the steps, and one product. Either are
    doubled, so that every step is a product of few transitions, however late it is: where powers of one of them were
    taken, its rounding would grow with the number of pieces.
    """

    propagator: Propagator
    columns: Array

    @cached_property
    def reach(self) -> int:
        """The number of baby steps, a power of two."""
        return int(2 ** ((self.propagator.grid.pieces - 1).bit_length() // 2 + 1))

    @cached_property
    def steps(self) -> Array:
        """``e^{A i h} Gamma(h) M`` side by side for ``i < reach``, ``(d, reach c)``."""
        d, c = self.columns.shape
        first = self.propagator.steps(np.zeros((1, 0))).Gamma[0, 0] @ self.columns
        steps = np.empty((d, min(self.reach, self.propagator.grid.pieces) * c))
        steps[:, :c], done = first, c
        for leap in self.propagator.leaps:
            if done >= steps.shape[1]:
                break
            more = min(done, steps.shape[1] - done)
            steps[:, done : done + more] = leap @ steps[:, :more]
            done += more
        return steps

    def of(self, rows: Array, count: int) -> Array:
        """What pieces of age ``0, ..., count - 1`` give to ``rows (..., d)``: ``(..., count, c)``."""
        c, lead = self.columns.shape[1], rows.shape[:-1]
        if count <= self.reach:
            return np.asarray((rows @ self.steps[:, : count * c]).reshape(*lead, count, c))
        flat = rows.reshape(-1, rows.shape[-1])
        giants = np.empty((flat.shape[0], -(-count // self.reach), flat.shape[1]))
        giants[:, 0], done = flat, 1
        for leap in self.propagator.leaps[self.reach.bit_length() - 1 :]:
            if done >= giants.shape[1]:
                break
            more = min(done, giants.shape[1] - done)
            giants[:, done : done + more] = giants[:, :more] @ leap
            done += more
        found = (giants.reshape(-1, flat.shape[1]) @ self.steps).reshape(flat.shape[0], -1, c)
        return np.asarray(found[:, :count].reshape(*lead, count, c))


@dataclass(frozen=True, eq=False)
class Stretches:
    """What inputs on pieces of any lengths give to later states, over stretches of 1, 2, 4, ... pieces, one beside the
    other from the first piece on: which ``kinds`` they are of, what the ``inputs (q, d, 2^s w)`` on them make of the
    state at their end, and their ``flows (q, d, d)``.

    A row goes back through one stretch for every bit of the number of its piece, where it went through every piece; and
    what it meets within a stretch is a product with few columns. For a known system.
    """

    kinds: list[np.ndarray]
    inputs: list[Array]
    flows: list[Array]

    @staticmethod
    def of(which: np.ndarray, inputs: Array, flows: Array) -> Stretches:
        """Those of pieces of which ``which (L,)`` says what inputs on them make, ``(q, d, w)``, and their transition,
        ``(q, d, d)``: as long ones as have, in all, `STRETCHED` numbers more than those of pieces."""
        every, left = Stretches([which], [inputs], [flows]), flows.size + STRETCHED
        while which.size > 1:
            apart, which = np.unique(which[: which.size // 2 * 2].reshape(-1, 2), axis=0, return_inverse=True)
            which, left = which.reshape(-1), left - len(apart) * flows[0].size
            if left < 0:
                break
            early, late = apart.T
            inputs = np.concatenate([flows[late] @ inputs[early], inputs[late]], axis=2)
            flows = np.stack([flows[second] @ flows[first] for first, second in apart.tolist()])
            every.kinds.append(which)
            every.inputs.append(inputs)
            every.flows.append(flows)
        return every

    def on(self, at: np.ndarray, rows: Array, found: Array) -> None:
        """Take ``rows (k, d)`` at the beginnings of pieces ``at (k,)``, which fall, back to the beginning; what they
        meet is ``found (k, L, w)``."""
        width, longest = found.shape[2], len(self.kinds) - 1
        for level, (kinds, inputs, flows) in enumerate(zip(self.kinds, self.inputs, self.flows, strict=True)):
            numbers, size = at >> level, 2**level
            if level < longest:  # the stretch before, where that is no half of a longer one
                ends = np.append(np.flatnonzero(np.diff(numbers, prepend=-1)), numbers.size).tolist()
                turns = [(int(numbers[first]) - 1, slice(first, last)) for first, last in pairwise(ends)]
                turns = [(number, here) for number, here in turns if number % 2 == 0]
            else:  # of the longest ones, one before the other
                last = int(numbers.max(initial=0))
                begun = np.searchsorted(-numbers, -np.arange(last)).tolist()
                turns = [(number, slice(0, begun[number])) for number in range(last - 1, -1, -1)]
            for number, here in turns:
                kind, rest = kinds[number], rows[here]
                met = (rest @ inputs[kind]).reshape(len(rest), size, width)
                found[here, number * size : (number + 1) * size], rows[here] = met, rest @ flows[kind]


@dataclass(frozen=True, eq=False)
class Propagator:
    """What the responses of one system on one time grid share, from whatever initial state: transition matrices, and
    functionals as weights. ``propagate``: the exponentials of a known system whose matrix has a structure. ``given``:
    the system as polynomials in time, where that is made already.

    What a functional gives to every piece has two ways: of a known system on equal pieces it depends on the age of a
    piece alone (`Impulses`); else rows go back from piece to piece.
    """

    system: System
    grid: TimeGrid
    propagate: Exponentials | None = None
    given: Expansion | None = None
    _steps: dict[bytes, Steps] = field(default_factory=dict, repr=False)
    _flows: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)
    _exponentials: dict[int, Leaps] = field(default_factory=dict, repr=False)

    @cached_property
    def which(self) -> np.ndarray:
        """Which of the distinct modes and lengths, in the order of `Steps`, every piece has, ``(L,)``."""
        lengths = self.grid.lengths / self.grid.breakpoints[-1]
        if self.grid.mode is None and np.ptp(lengths) <= ALIKE:  # rounded, some might go up and others down
            return np.zeros(lengths.size, dtype=int)
        lengths = np.round(lengths / ALIKE)
        mode = np.zeros(lengths.size) if self.grid.mode is None else self.grid.mode
        _, which = np.unique(np.stack([mode, lengths]), axis=1, return_inverse=True)
        return np.asarray(which.reshape(-1))

    @cached_property
    def lengths(self) -> Array:
        """The lengths ``(q,)`` of distinct modes and lengths, as means: the rounding must not add up."""
        means: Array = np.bincount(self.which, self.grid.lengths) / np.bincount(self.which)
        return means

    @cached_property
    def _modes(self) -> np.ndarray:
        """The mode ``(q,)`` of every entry of `Steps`."""
        modes = np.zeros(self.lengths.size, dtype=int)
        if self.grid.mode is not None:
            modes[self.which] = self.grid.mode
        return modes

    @cached_property
    def laws(self) -> Parts | None:
        """How the law of a system that changes with time depends on its parameters, on parts of their box; ``None``
        where the state is an affine function of them, or there are none."""
        return None if self.system.powers is None else law_of(self.system)

    @property
    def law(self) -> Expansion | Parts:
        """The law of a system that changes with time, known or with parameters."""
        found = self.expansion if self.laws is None else self.laws
        assert found is not None
        return found

    def on_cell(self, low: Array, high: Array) -> Propagator:
        """Return what all coefficients of the state do on a cell ``[low, high]`` of parameters (`Parts.on_cell`)."""
        assert self.laws is not None
        return Propagator(self.system, self.grid, given=self.laws.on_cell(low, high))

    def at_point(self, parameter: Array) -> Propagator:
        """Return what the known system at a parameter ``(nu,)`` does."""
        assert self.laws is not None
        return Propagator(self.system, self.grid, given=self.laws.at_point(parameter))

    @shaped
    def steps(self, parameters: Float[Array, "v nu"]) -> Steps:
        """Matrices and whole-piece transitions at parameters ``(v, nu)``; remembered for the last few calls."""
        # no parameters: any number of rows has the same bytes
        key = bytes(str(parameters.shape), "ascii") + parameters.tobytes()
        if key not in self._steps and self.system.varies:
            remember(self._steps, key, self._varying_steps(parameters), STEPS_KEPT)
        if key not in self._steps:
            every = [mode.matrices(parameters) for mode in self.system.modes]
            A, B, E = (
                np.stack([one[0] for one in every], axis=1),
                *(np.concatenate([one[part] for one in every], axis=2) for part in (1, 2)),
            )
            Phi, Gamma = self._transitions(A, self._modes, self.lengths)
            remember(self._steps, key, Steps(A, B, E, Phi, Gamma, self._modes), STEPS_KEPT)
        return self._steps[key]

    def _transitions(self, A: Array, modes: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """``e^{A r}`` and its integral, ``(v, q, d, d)`` each, of ``modes (q,)`` over ``durations (q,)``."""
        if self._depends:
            return transitions(A[:, modes], durations[None])
        found = np.empty((2, 1, durations.size, *A.shape[2:]))
        for mode in np.unique(modes):
            mine = modes == mode
            found[0, 0, mine], found[1, 0, mine] = self.exponentials(mode).transitions(durations[mine])
        return found[0], found[1]

    @cached_property
    def _depends(self) -> bool:
        """Whether the system depends on parameters."""
        return self.system.varies or self.system.parameters is not None

    def exponentials(self, mode: int = 0) -> Exponentials:
        """Those of a mode of a known system."""
        return self.own(mode) if self.propagate is None else self.propagate

    def own(self, mode: int = 0) -> Leaps:
        """Those of the matrix of a mode as it is."""
        if mode not in self._exponentials:
            self._exponentials[mode] = Leaps(self.system.modes[mode].matrices(np.zeros((1, 0)))[0][0])
        return self._exponentials[mode]

    def _varying_weights(self, times: Array, directions: Array, parameters: Array) -> Weights:
        """`weights` of a system that changes with time, without an input matrix for every index."""
        unique, which = unique_rows(parameters)
        steps, pieces, expansion = self.steps(unique), self.grid.locate(times), self.expansion
        order = np.argsort(-pieces, kind="stable")
        rows, at = np.array(directions, dtype=float)[order], pieces[order]
        begun = self.grid.breakpoints[at]
        if expansion is None:
            state, both = self.law.along(begun, np.maximum(times[order], begun), parameters[order])
        else:
            distinct, each = np.unique(np.stack([begun, np.maximum(times[order], begun)]), axis=1, return_inverse=True)
            key, each = distinct.tobytes(), each.reshape(-1)
            if key not in self._flows:
                remember(self._flows, key, self.law.over(distinct[0], distinct[1], parameters[:0]), FLOWS_KEPT)
            state, both = (part[0, each] for part in self._flows[key])
        found = np.zeros((times.size, self.grid.pieces, both.shape[2]))
        found[np.arange(times.size), at] = (rows[:, None] @ both)[:, 0]
        rows = (rows[:, None] @ state)[:, 0]
        self._by_recursion(steps.pushed, which[order], at, rows, found)
        back = np.empty_like(order)
        back[order] = np.arange(order.size)
        channels = self.system.controls
        return Weights(rows[back], found[back, :, :channels], found[back, :, channels:])

    @cached_property
    def marks(self) -> Array:
        """The breakpoints, and the times between which a system that changes with time is one polynomial of it; one of
        these that is a breakpoint but for rounding counts as that, unless another law takes over there: then what
        moves the state jumps, however near a breakpoint is."""
        breaks = self.grid.breakpoints
        for one in self.law.expansions if self.system.varies else ():
            breaks = np.union1d(_joined(breaks, one.ends[1:-1]), one.ends[list(one.turns)])
        return breaks

    @cached_property
    def expansion(self) -> Expansion | None:
        """The system as polynomials in time, where it changes with time and is known."""
        if self.given is not None:
            return self.given
        return Expansion.of(self.system) if self.system.varies and self.laws is None else None

    @property
    def slack(self) -> float:
        """`Expansion.slack` of a system that changes with time, the largest one of all parts."""
        return max((one.slack for one in self.law.expansions), default=0.0) if self.system.varies else 0.0

    def _varying_steps(self, parameters: Array) -> Steps:
        """Steps of a system that changes with time, whose pieces are modes: ``Gamma`` is the length of a piece, and
        ``B`` and ``E`` of a mode are what a piece makes of an input, per time."""
        points = parameters if self.laws is not None else parameters[:1]
        count, pieces, breaks, lengths = len(points), self.grid.pieces, self.grid.breakpoints, self.grid.lengths
        state, pushes = self.law.over(breaks[:-1], breaks[1:], points)
        d, m = state.shape[2], self.system.controls
        A = self.law.averages(breaks, points)
        Gamma = np.broadcast_to(np.eye(d) * lengths[:, None, None], (count, pieces, d, d))
        rates = (pushes / lengths[:, None, None]).swapaxes(1, 2)
        B, E = (np.ascontiguousarray(part).reshape(count, d, -1) for part in (rates[..., :m], rates[..., m:]))
        return Steps(A, B, E, state, Gamma, self._modes)

    def _varying_adjoint(self, times: Array, directions: Array, parameters: Array) -> tuple[Array, Array, Array, Array]:
        """`adjoint` of a system that changes with time; the part of a piece before a time has a ``B`` and an ``E`` of
        its own."""
        unique, which = unique_rows(parameters)
        steps, pieces, m = self.steps(unique), self.grid.locate(times), self.system.controls
        begun, every = self.grid.breakpoints[pieces], np.arange(times.size)
        state, pushes = self.law.along(begun, np.maximum(times, begun), parameters)
        d, L = directions.shape[1], self.grid.pieces
        gains, rows = np.zeros((times.size, L, d)), directions.astype(float)
        length = self.grid.lengths[pieces]
        gains[every, pieces] = rows * length[:, None]
        B, E = steps.B[which], steps.E[which]
        for table, part in ((B, pushes[..., :m]), (E, pushes[..., m:])):
            table.reshape(times.size, d, L, -1)[every, :, pieces] = part / length[:, None, None]
        rows = (rows[:, None] @ state)[:, 0]
        for piece in range(int(pieces.max(initial=0)) - 1, -1, -1):
            active = np.flatnonzero(pieces > piece)
            gains[active, piece] = rows[active] * self.grid.lengths[piece]
            over = steps.Phi[:, piece]
            known = len(over) == 1
            rows[active] = rows[active] @ over[0] if known else (rows[active, None] @ over[which[active]])[:, 0]
        return rows, gains, B, E

    @shaped
    def adjoint(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k L d"], Float[Array, "k d m"], Float[Array, "k d mw"]]:
        """The functional ``c'x(t)`` of each index, as weights on the initial state and on what drives every piece.

        ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)`` give ``free (k, d) = e^{A't} c``,
        ``gains (k, L, d) = int_{piece, s < t} e^{A'(t-s)} c ds``, and the input matrices ``B (k, d, J m)``,
        ``E (k, d, J mw)`` at the parameters, those of several modes side by side (`TimeGrid.through`).
        """
        if self.system.varies:
            return self._varying_adjoint(times, directions, parameters)
        if self.aged(parameters.shape[1]):
            free, (gains,) = self._by_age(times, directions, self._every_state)
            which, steps = np.zeros(times.size, dtype=int), self.steps(np.zeros((1, 0)))
        else:
            free, gains, steps, which = self._piece_by_piece(times, directions, parameters, drives=True)
        return free, gains, steps.B[which], steps.E[which]

    @shaped
    def weights(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Weights:
        """The functional ``c'x(t)`` of each index as weights on what is given and on inputs: `adjoint` and
        `TimeGrid.through`, without ``(k, L, d)`` numbers."""
        if self.system.varies:
            return self._varying_weights(times, directions, parameters)
        if self.aged(parameters.shape[1]):
            channels = self.steps(np.zeros((1, 0))).B.shape[2]
            free, (control, disturbance) = self._by_age(times, directions, self.inputs, channels)
            return Weights(free, control, disturbance)
        free, both, steps, _ = self._piece_by_piece(times, directions, parameters, drives=False)
        channels = steps.B.shape[2] // steps.A.shape[1]
        return Weights(free, both[..., :channels], both[..., channels:])

    def _piece_by_piece(
        self, times: Array, directions: Array, parameters: Array, drives: bool
    ) -> tuple[Array, Array, Steps, np.ndarray]:
        """What functionals give to the initial state ``(k, d)`` and to every input on every piece, ``(k, L, m + mw)``,
        or to what ``drives`` it, ``(k, L, d)``; with the steps at the distinct parameters, and which each has."""
        unique, which = unique_rows(parameters)
        steps, pieces = self.steps(unique), self.grid.locate(times)
        order = np.argsort(-pieces, kind="stable")
        at, within = pieces[order], np.clip(times - self.grid.breakpoints[pieces], 0.0, None)[order]
        rows, last = self._inside(steps, which[order], at, directions[order], within)
        if not drives:
            last = (last[:, None] @ steps.inputs[which[order], self.grid.modes[at]])[:, 0]
        found = np.zeros((times.size, self.grid.pieces, last.shape[1]))
        found[np.arange(times.size), at] = last
        if drives or self._depends:
            self._by_recursion(steps.driven if drives else steps.pushed, which[order], at, rows, found)
        else:
            self._stretches.on(at, rows, found)
        back = np.empty_like(order)
        back[order] = np.arange(order.size)
        return rows[back], found[back], steps, which

    def _by_recursion(self, over: Array, mine: np.ndarray, at: np.ndarray, rows: Array, found: Array) -> None:
        """Take ``rows (k, d)`` at the beginnings of pieces ``at (k,)``, which fall, back to the beginning from piece to
        piece, by ``over (v, q, d, w + d)`` of which each has its parameters ``mine (k,)``; what they meet is
        ``found (k, L, w)``."""
        known, width, first = over.shape[0] == 1, found.shape[2], int(at[0]) if at.size else 0
        begun = np.searchsorted(-at, -np.arange(first)).tolist()  # how many functionals reach back to a piece
        alike = over[mine, 0][:, None] if self.uniform and not known else None
        for piece in range(first - 1, -1, -1):
            active, length = begun[piece], self.which[piece]
            if known:
                both = rows[:active] @ over[0, length]
            else:
                each = over[mine[:active], length] if alike is None else alike[:active, 0]
                both = (rows[:active, None] @ each)[:, 0]
            found[:active, piece], rows[:active] = both[:, :width], both[:, width:]

    @cached_property
    def _stretches(self) -> Stretches:
        """What inputs through the columns of ``B`` and of ``E`` give, for a known system."""
        steps = self.steps(np.zeros((1, 0)))
        return Stretches.of(self.which, steps.Gamma[0] @ steps.inputs[0, self._modes], steps.Phi[0])

    def _inside(
        self, steps: Steps, which: np.ndarray, pieces: np.ndarray, rows: Array, within: Array
    ) -> tuple[Array, Array]:
        """``c'e^{A r}`` and ``c'Gamma(r)``, ``(k, d)`` each, of ``rows (k, d)`` over parts ``within (k,)`` of their
        pieces: no matrix is made for a time where no parameter is uncertain."""
        modes = self.grid.modes[pieces]
        if not self._depends:
            found = np.empty((2, *rows.shape))
            for mode in np.unique(modes):
                mine = modes == mode
                found[0, mine], found[1, mine] = self.exponentials(mode).rows(rows[mine], within[mine])
            return found[0], found[1]
        horizon = self.grid.breakpoints[-1]
        cases, each = np.unique(np.stack([which, modes, np.round(within / horizon, 15)]), axis=1, return_inverse=True)
        flows = transitions(steps.A[cases[0].astype(int), cases[1].astype(int)], cases[2] * horizon)
        flown, driven = ((rows[:, None] @ part[each.reshape(-1)])[:, 0] for part in flows)
        return flown, driven

    def aged(self, parameters: int) -> bool:
        """Whether what a piece gives depends on its age alone, with so many ``parameters``."""
        return not parameters and self.uniform

    def _by_age(self, times: Array, directions: Array, impulses: Impulses, *ends: int) -> tuple[Array, list[Array]]:
        """What functionals give to the initial state ``(k, d)`` and to the columns of ``impulses`` on every piece, in
        parts of these that ``ends`` divide, ``(k, L, c)`` each."""
        pieces, steps = self.grid.locate(times), self.steps(np.zeros((1, 0)))
        rows, entered = self._over_parts(steps, directions, times - self.grid.breakpoints[pieces])
        count = int(pieces.max(initial=0))
        every, signs = np.arange(times.size), np.ones(times.size)
        apart, which = rows, every
        if times.size > 1 and rows.shape[1] > FEW_STATES:
            # later times are shifts of one impulse response, and an opposite row has the opposite one
            signs = np.where(rows[every, np.abs(rows).argmax(axis=1)] < 0.0, -1.0, 1.0)
            apart, which = _apart(rows * signs[:, None])
        by_age, last = impulses.of(apart, count), entered @ impulses.columns
        limits = [0, *ends, last.shape[1]]
        parts = [slice(*pair) for pair in pairwise(limits)]
        found = [np.zeros((times.size, self.grid.pieces, part.stop - part.start)) for part in parts]
        for number, (piece, row, sign) in enumerate(zip(pieces.tolist(), which.tolist(), signs.tolist(), strict=True)):
            if piece:
                backwards = by_age[row, piece - 1 :: -1]
                for gains, part in zip(found, parts, strict=True):
                    np.multiply(backwards[:, part], sign, out=gains[number, :piece])
        for gains, part in zip(found, parts, strict=True):
            gains[every, pieces] = last[:, part]
        return self._leapt(rows, pieces), found

    @cached_property
    def inputs(self) -> Impulses:
        """What the columns of ``B`` and of ``E``, side by side, give by age."""
        steps = self.steps(np.zeros((1, 0)))
        return Impulses(self, np.concatenate([steps.B[0], steps.E[0]], axis=1))

    def _over_parts(self, steps: Steps, rows: Array, within: Array) -> tuple[Array, Array]:
        """``c'e^{A r}`` and ``c'Gamma(r)`` of ``rows (k, d)`` over parts ``within (k,)`` of equal pieces of a known
        system, ``(k, d)`` each."""
        length, least = float(self.lengths[0]), STEP * float(self.grid.breakpoints[-1])
        whole = np.abs(within - length) <= least
        if whole.all():
            return rows @ steps.Phi[0, 0], rows @ steps.Gamma[0, 0]
        return self.exponentials().rows(rows, np.where(np.abs(within) <= least, 0.0, np.where(whole, length, within)))

    @shaped
    def backwards(
        self, times: Float[Array, " k"], directions: Float[Array, "r d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "k r d"]:
        """``e^{A't} c (k, r, d)`` at all ``times (k,)`` for all ``directions (r, d)``, at one parameter: within pieces
        that are alike together, then over whole ones."""
        (k, r), d = (times.size, directions.shape[0]), directions.shape[1]
        if not self.aged(parameter.size):
            known = Leaps(self.steps(parameter[None]).A[0, 0]) if self._depends else self.own()
            return known.orbits(directions, times)[0]
        pieces = self.grid.locate(times)
        within, which = self.grid.distinct(np.maximum(times - self.grid.breakpoints[pieces], 0.0))
        rows = self.own().orbits(directions, within)[0][which].reshape(-1, d)
        return self._leapt(rows, np.repeat(pieces, r)).reshape(k, r, d)

    def _leapt(self, rows: Array, pieces: np.ndarray) -> Array:
        """``rows (k, d)`` that went on by so many whole ``pieces (k,)``, ``(k, d)``."""
        free, together = rows.copy(), int(pieces[0]) if pieces.size and (pieces == pieces[0]).all() else None
        for place, leap in enumerate(self.leaps[: int(pieces.max(initial=0)).bit_length()]):
            if together is None:
                far = (pieces >> place & 1).nonzero()[0]
                free[far] = free[far] @ leap
            elif together >> place & 1:
                free = free @ leap
        return free

    @property
    def uniform(self) -> bool:
        """Whether all pieces of the grid are equally long, and of one mode."""
        return bool(self.lengths.size == 1) and not self.grid.varying

    def block(self, steps: Steps) -> int:
        """How many equal pieces, a power of two, are taken together where the states of many are asked for; 1: none.
        No more than the system moves little on, so that what a block adds from 0 is not much larger than the states."""
        if self.grid.pieces < 2 * FEWEST:
            return 1
        size = np.abs(steps.A)
        pace = max(float(min(one.sum(axis=0).max(), one.sum(axis=1).max())) for one in size[:, 0])
        most = min(self.grid.pieces / FEWEST, LITTLE / max(pace * float(self.lengths[0]), TINY))
        return int(2 ** max(0, int(np.log2(max(1.0, most)))))

    def products(self, pieces: int, block: int) -> int:
        """Through how many products with transitions the states on ``pieces`` pieces go, at most, from the beginning of
        one of the blocks: over blocks, down the tree of parts of one, and up those of its inputs."""
        return pieces + 1 if block == 1 else -(-pieces // block) + 4 * block.bit_length()

    @cached_property
    def drift(self) -> float:
        """How far the breakpoints are, at most, from where equal pieces would put them."""
        breaks, length = self.grid.breakpoints, float(self.lengths[0])
        off = np.abs(breaks - length * np.arange(breaks.size)).max()
        return float(off + 4.0 * EPSILON * (breaks[-1] + self.grid.elapsed))

    def flows(self, durations: Array) -> tuple[Array, Array]:
        """``e^{A r}`` and its integral ``(k, d, d)`` for durations ``(k,)``; for a known system."""
        return self.exponentials().transitions(durations)

    def flows_in(self, pieces: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """`flows` of the systems that act on ``pieces (k,)`` of the grid."""
        A, modes = self.steps(np.zeros((1, 0))).A[0], self.grid.modes[pieces]
        flow, driven = np.empty((2, durations.size, *A.shape[1:]))
        for mode in np.unique(modes):
            mine = modes == mode
            distinct, which = self.grid.distinct(durations[mine])
            flow[mine], driven[mine] = (part[which] for part in self.exponentials(mode).transitions(distinct))
        return flow, driven

    @cached_property
    def leaps(self) -> Array:
        """The transitions over 1, 2, 4, ... pieces, ``(q, d, d)``; for a known system and equal pieces."""
        return self.flows(2.0 ** np.arange(self.grid.pieces.bit_length()) * self.lengths[0])[0]

    def leaps_of(self, steps: Steps, count: int) -> list[Array]:
        """The transposed transitions ``(v, d, d)`` over 1, 2, 4, ... equal pieces, ``count`` of them."""
        if self.system.parameters is None and steps.A.shape[:2] == (1, 1):
            return [leap.T[None] for leap in self.leaps[:count]]
        durations = 2.0 ** np.arange(count) * self.lengths[0]
        flows = self._transitions(steps.A, np.zeros(count, dtype=int), durations)[0]
        return [np.swapaxes(flows[:, place], 1, 2) for place in range(count)]

    @cached_property
    def _every_state(self) -> Impulses:
        return Impulses(self, np.eye(self.system.states))

    @cached_property
    def kernel(self) -> Array:
        """``e^{A i h} Gamma(h)`` for ``i = 0, ..., L - 1``, ``(d, L, d)``: a table of all that `Impulses` tell, for a
        known system and equal pieces."""
        return self._every_state.of(np.eye(self.system.states), self.grid.pieces)

    @cached_property
    def lateness(self) -> tuple[float, float]:
        """How far durations that are used may be from those that are meant: of pieces, where nearly equal ones are
        taken for equal, and within a piece, where they are rounded (`TimeGrid.distinct`)."""
        unequal, elapsed = np.abs(self.grid.lengths - self.lengths[self.which]).max(), self.grid.elapsed
        return float(unequal + EPSILON * elapsed), float(SAME_DURATION * (self.grid.breakpoints[-1] + elapsed))


@dataclass(frozen=True, eq=False)
class Outputs:
    """``H x(t)`` at many ``times (T,)``, for rows ``H (r, d)``, at parameters ``points (v, nu)``, under any control.

    For a known system and equal pieces the states at all breakpoints are never made: only those at the beginning of
    blocks of pieces, and what these and the inputs within a block bring to ``H x`` in it, which is the same in every
    block.
    """

    propagator: Propagator
    H: Array
    times: Array
    points: Array

    @cached_property
    def within(self) -> tuple[np.ndarray, Array, np.ndarray]:
        """The piece of every time, the distinct durations ``(q,)`` since the beginning of a piece, and which of them
        each is, ``(T,)``; durations that differ by the rounding of breakpoints are one."""
        grid = self.propagator.grid
        pieces = grid.locate(self.times)
        since = self.times - grid.breakpoints[pieces]
        order = np.argsort(since, kind="stable")
        group = np.cumsum(np.diff(since[order], prepend=since[order[:1]]) > STEP * float(grid.breakpoints[-1]))
        which = np.empty_like(group)
        which[order] = group
        return pieces, np.bincount(which, since) / np.bincount(which), which

    @cached_property
    def _kinds(self) -> tuple[np.ndarray, Array, np.ndarray]:
        """The distinct modes and durations, ``(q,)`` each, and which of them every time has, ``(T,)``; of a single mode
        they are those of `within`."""
        pieces, durations, which = self.within
        modes = self.propagator.grid.modes[pieces]
        kinds, each = np.unique(np.stack([modes, which]), axis=1, return_inverse=True)
        return kinds[0], durations[kinds[1]], each.reshape(-1)

    @cached_property
    def _steps(self) -> tuple[Array, Array]:
        """``H e^{A r}`` and ``H Gamma(r)`` for the distinct modes and durations: ``(v, q, r, d)`` each."""
        steps, (modes, durations, _) = self.propagator.steps(self.points), self._kinds
        if steps.A.shape[0] > 1:
            flow, driven = transitions(steps.A[:, modes], durations[None])
            return self.H @ flow, self.H @ driven
        found = np.empty((2, 1, durations.size, *self.H.shape))
        for mode in np.unique(modes):
            mine = modes == mode
            known = Leaps(steps.A[0, mode]) if self.points.shape[1] else self.propagator.own(mode)
            found[0, 0, mine], found[1, 0, mine] = known.orbits(self.H, durations[mine])
        return found[0], found[1]

    @cached_property
    def _over_pieces(self) -> tuple[Array, Array] | None:
        """Of a system that changes with time, what the beginning of its piece makes of every time: of the state,
        ``(v, T, r, d)``, and of what acts, ``(v, T, r, m)``."""
        if not self.propagator.system.varies:
            return None
        begun = self.propagator.grid.breakpoints[self.within[0]]
        flow, driven = (
            self.H @ one for one in self.propagator.law.over(begun, np.maximum(self.times, begun), self.points)
        )
        return flow, driven[..., : self.propagator.system.controls]

    def at(self, response: Response, control: Array) -> Array:
        """``(v, r, T)`` from the initial state of a response, under a control ``(m, K)`` on its own pieces."""
        steps, grid = self.propagator.steps(self.points), self.propagator.grid
        if self.propagator.aged(self.points.shape[1]) and self.propagator.block(steps) > 1:
            return self._in_blocks(response.initial_state, grid.inputs(control))[None]
        if self._over_pieces is not None:
            flow, driven = self._over_pieces
            nodes, inputs = response.nodes(control, self.points), grid.inputs(control).T
            pieces = self.within[0]
            held = np.einsum("vtrm,tm->vrt", driven, inputs[pieces])
            return np.asarray(np.einsum("vtri,vti->vrt", flow, nodes[:, pieces]) + held)
        nodes, drive = response.nodes(control, self.points), grid.driven(steps.B, grid.inputs(control))
        pieces, which = self.within[0], self._kinds[2]
        flow, driven = (part[:, which] for part in self._steps)
        found = np.einsum("vtri,vti->vrt", flow, nodes[:, pieces]) + np.einsum(
            "vtri,vti->vrt", driven, drive[:, pieces]
        )
        return np.asarray(found)

    def _in_blocks(self, initial_state: Array, inputs: Array) -> Array:
        """``(r, T)`` from inputs ``(m, L)``."""
        block, first, count = self._blocks
        carried, entered = self._tables
        pieces, durations, which = self.within
        m, d = inputs.shape[0], initial_state.size
        padded = np.zeros(((first + count) * block, m))
        kept = min(padded.shape[0], inputs.shape[1])
        padded[:kept] = inputs[:, :kept].T
        by_block = padded.reshape(first + count, block * m)
        begun, pushed = np.empty((first + count, d)), by_block @ self._pushed
        begun[0], over = initial_state, self._over_block
        for number in range(1, first + count):
            begun[number] = over @ begun[number - 1] + pushed[number - 1]
        found = begun[first:] @ carried + by_block[first:] @ entered
        every = found.reshape(count * block, durations.size, self.H.shape[0])
        return np.asarray(every[pieces - first * block, which].T)

    @cached_property
    def _blocks(self) -> tuple[int, int, int]:
        """How many pieces a block has, the first block that is looked at, and how many are."""
        steps, pieces = self.propagator.steps(self.points), self.within[0]
        block = min(BLOCK, self.propagator.block(steps))
        first = int(pieces.min()) // block
        return block, first, int(pieces.max()) // block + 1 - first

    @cached_property
    def _over_block(self) -> Array:
        """The transition over a block, ``(d, d)``."""
        steps, block = self.propagator.steps(self.points), self._blocks[0]
        return np.asarray(transitions(steps.A[0, 0], block * self.propagator.lengths[:1])[0][0])

    @cached_property
    def _pushed(self) -> Array:
        """What the inputs of a block make of the state at its end, ``(block m, d)``."""
        block, m = self._blocks[0], self.propagator.steps(self.points).B.shape[2]
        every = self.propagator.inputs.of(np.eye(self.H.shape[1]), block)  # (d, block, m + mw)
        return np.ascontiguousarray(every[:, ::-1, :m].reshape(every.shape[0], -1).T)

    @cached_property
    def _tables(self) -> tuple[Array, Array]:
        """What the state at the beginning of a block, ``(d, block q r)``, and the inputs in it, ``(block m, block q
        r)``, bring to ``H x`` on its pieces, for all distinct durations."""
        steps, block = self.propagator.steps(self.points), self._blocks[0]
        flow, driven = (part[0].reshape(-1, self.H.shape[1]) for part in self._steps)  # (q r, d)
        m, rows = steps.B.shape[2], flow.shape[0]
        carried = np.empty((block, rows, self.H.shape[1]))
        carried[0] = flow
        for place in range(1, block):
            carried[place] = carried[place - 1] @ steps.Phi[0, 0]
        older = self.propagator.inputs.of(flow, block)[:, :, :m]  # (q r, block, m)
        entered = np.zeros((block, m, block, rows))
        for place in range(block):
            entered[place, :, place] = (driven @ steps.B[0]).T
            entered[:place, :, place] = older[:, :place][:, ::-1].transpose(1, 2, 0)
        return carried.reshape(block * rows, -1).T, entered.reshape(block * m, block * rows)


@dataclass(frozen=True, eq=False)
class Response:
    """The responses of one system on one time grid, from one initial state ``(d,)``.

    What does not depend on the initial state is the ``propagator``, which responses from other initial states
    (`from_state`) share.
    """

    system: System
    grid: TimeGrid
    initial_state: Array
    propagate: Exponentials | None = None
    shared: Propagator | None = field(default=None, repr=False)

    @cached_property
    def propagator(self) -> Propagator:
        """Transition matrices and functionals; the ``shared`` ones where they are of this system on this grid."""
        given = self.shared
        if given and given.system is self.system and given.grid is self.grid and given.propagate is self.propagate:
            return given
        return Propagator(self.system, self.grid, self.propagate)

    @shaped
    def from_state(self, initial_state: Float[Array, " d"]) -> Response:
        """The responses of the same system from another initial state ``(d,)``."""
        return Response(self.system, self.grid, initial_state, self.propagate, self.propagator)

    @shaped
    def at(self, parameter: Float[Array, " nu"]) -> Response:
        """Return the responses of the known system at one parameter: these where there are no parameters."""
        system = self.system.at(parameter)
        return self if system is self.system else Response(system, self.grid, self.initial_state)

    @shaped
    def steps(self, parameters: Float[Array, "v nu"]) -> Steps:
        """`Propagator.steps`."""
        return self.propagator.steps(parameters)

    @shaped
    def adjoint(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k d"], Float[Array, "k L d"], Float[Array, "k d m"], Float[Array, "k d mw"]]:
        """`Propagator.adjoint`."""
        return self.propagator.adjoint(times, directions, parameters)

    @shaped
    def weights(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Weights:
        """`Propagator.weights`."""
        return self.propagator.weights(times, directions, parameters)

    def numbers(self, parameters: int) -> int:
        """How many numbers `weights` of one index make at once, with so many ``parameters``."""
        system, grid = self.system, self.grid
        width = system.states if parameters else system.controls + system.disturbances
        if self.propagator.laws is not None:  # transitions of every piece
            width *= system.states + system.controls + system.disturbances
        return int(grid.pieces * width)

    def flows(self, durations: Array) -> tuple[Array, Array]:
        """`Propagator.flows`."""
        return self.propagator.flows(durations)

    def flows_in(self, pieces: np.ndarray, durations: Array) -> tuple[Array, Array]:
        """`Propagator.flows_in`."""
        return self.propagator.flows_in(pieces, durations)

    @property
    def uniform(self) -> bool:
        """`Propagator.uniform`."""
        return self.propagator.uniform

    @property
    def lateness(self) -> tuple[float, float]:
        """`Propagator.lateness`."""
        return self.propagator.lateness

    @property
    def kernel(self) -> Array:
        """`Propagator.kernel`."""
        return self.propagator.kernel

    @property
    def which(self) -> np.ndarray:
        """`Propagator.which`."""
        return self.propagator.which

    @shaped
    def states(
        self,
        control: Float[Array, "m K"],
        parameters: Float[Array, "v nu"],
        disturbance: Float[Array, "vw mw M"] | None = None,
        deviations: Float[Array, "vd d"] | None = None,
    ) -> Float[Array, "vx points d"]:
        """States ``(v, L+1, d)`` at the breakpoints of the grid.

        ``control (m, K)`` on the control's pieces (`TimeGrid.inputs`), ``parameters (v, nu)`` (one row serves all
        disturbances), ``disturbance (v, mw, M)`` on the disturbance's pieces or ``None``, ``deviations (v, d)`` of the
        initial state.
        """
        steps = self.steps(parameters)
        count = max(part.shape[0] for part in (parameters, disturbance, deviations) if part is not None)
        drive = self.grid.driven(steps.B, self.grid.inputs(control))
        if disturbance is not None:
            drive = drive + self.grid.driven(steps.E, disturbance[:, :, self.grid.disturbance_piece])
        path = np.empty((count, self.grid.pieces + 1, self.initial_state.size))
        path[:, 0] = self.initial_state if deviations is None else self.initial_state + deviations
        shared, lengths = steps.Phi.shape[0] == 1, self.which.tolist()

        def moved(matrices: Array, vectors: Array) -> Array:
            return np.asarray(vectors @ matrices[0].T if shared else (matrices @ vectors[..., None])[..., 0])

        if self.uniform:
            path[:, 1:] = drive @ steps.Gamma[:, 0].swapaxes(1, 2)
            block = self.propagator.block(steps)
            if block > 1:
                return self._in_blocks(path, steps, block)
        else:
            for piece, length in enumerate(lengths):
                path[:, piece + 1] = moved(steps.Gamma[:, length], drive[:, piece])
        if shared and self.uniform:
            Phi = steps.Phi[0, 0].T
            for piece in range(self.grid.pieces):
                path[:, piece + 1] += path[:, piece] @ Phi
            return path
        for piece, length in enumerate(lengths):
            path[:, piece + 1] += moved(steps.Phi[:, length], path[:, piece])
        return path

    def nodes(self, control: Array, parameters: Array) -> Array:
        """`states` without a disturbance, remembered for the last control, since all constraints ask for them."""
        key = control.tobytes() + parameters.tobytes()
        if key not in self._nodes:
            remember(self._nodes, key, self.states(control, parameters), 1)
        return self._nodes[key]

    @cached_property
    def _nodes(self) -> dict[bytes, Array]:
        return {}

    def _in_blocks(self, path: Array, steps: Steps, block: int) -> Array:
        """``x_{k+1} = Phi x_k + f_k`` from a ``path (v, L+1, d)`` that holds ``x_0, f_0, f_1, ...``, in blocks: what
        the pieces of a block add from 0, two neighbouring parts at a time, the states at the ends of blocks, and those
        inside, each from the part that ends there (Blelloch 1990). No state goes through more products than
        `Propagator.products`, and what is rounded does not grow with the pieces of a block."""
        leaps = self.propagator.leaps_of(steps, block.bit_length())
        done, v, d = 0, path.shape[0], path.shape[2]
        sizes = [block] + [block >> place for place in range(1, block.bit_length())]  # the last block may be shorter
        for size in sizes:
            count, levels = (self.grid.pieces - done) // size, size.bit_length() - 1
            if not count:
                continue
            inside = path[:, done + 1 : done + count * size + 1].reshape(v, count, size, d)
            for level in range(levels):
                step = 2**level
                inside[:, :, 2 * step - 1 :: 2 * step] += _moved(inside[:, :, step - 1 :: 2 * step], leaps[level])
            begun = np.empty((v, count, 1, d))
            begun[:, 0, 0] = path[:, done]
            for number in range(count):
                inside[:, number, -1:] += begun[:, number] @ leaps[levels]
                if number + 1 < count:
                    begun[:, number + 1] = inside[:, number, -1:]
            for level in range(levels - 1, -1, -1):
                step = 2**level
                before = np.concatenate([begun, inside[:, :, 2 * step - 1 :: 2 * step][:, :, :-1]], axis=2)
                inside[:, :, step - 1 :: 2 * step] += _moved(before, leaps[level])
            done += count * size
        return path


def _moved(states: Array, leap: Array) -> Array:
    """``(v, count, k, d)`` states, as rows, by the transposed transitions ``(v, d, d)``."""
    return np.asarray(states.reshape(states.shape[0], -1, states.shape[3]) @ leap).reshape(states.shape)


@shaped
def unique_rows(rows: Float[Array, "k n"]) -> tuple[Float[Array, "u n"], Int[np.ndarray, " k"]]:
    """The rows without copies, in increasing order, and which of them every row is.

    Copies are found by their bytes first: to sort long ones costs a look at all their numbers for every comparison.
    """
    if rows.shape[1] == 0 or rows.shape[0] == 1:
        return rows[:1], np.zeros(rows.shape[0], dtype=int)
    distinct, met = _apart(rows)
    unique, which = np.unique(distinct, axis=0, return_inverse=True)
    return unique, which.reshape(-1)[met]


def _apart(rows: Array) -> tuple[Array, np.ndarray]:
    """The rows without copies, in the order in which they come first, and which of them every row is."""
    apart: dict[bytes, int] = {}
    met = np.array([apart.setdefault(row.tobytes(), len(apart)) for row in rows + 0.0], dtype=int)  # of zeros one
    if len(apart) == len(rows):
        return rows, met
    first = np.empty(len(apart), dtype=int)
    first[met[::-1]] = np.arange(met.size)[::-1]
    return rows[first], met
