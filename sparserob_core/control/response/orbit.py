"""States of a known plant at the breakpoints, in more digits than doubles have.

A plant that grows by ``e^18`` over its horizon multiplies what is rounded at the beginning by as much. Where a control
ends then depends on its last digits. States are points with more bits. What a step from one to the next misses is
bounded by balls (Johansson 2017, "Arb: efficient arbitrary-precision midpoint-radius interval arithmetic", IEEE Trans.
Comput. 66), and grows by the logarithmic norm in the coordinates of the modes (Dahlquist 1958). Balls alone would grow
by the norms of all steps, however the plant turns them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property
from itertools import pairwise
from math import ceil, log
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.decoupling import decoupled
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from flint import arb_mat

    from sparserob_core.control.response.time_grid import TimeGrid

# Logarithm of a growth from which states are followed so: of sixteen digits a plant then keeps fewer than twelve. With
# half of it plants take longer that lose nothing, with twice as much a certificate is lost at the end of a horizon.
NOTABLE = 10.0
# Bits of a number beside those that the growth takes twice: once for the states, once for what lands on the last digits
# of a double. With half of them errors are no longer those of rounding to doubles; twice as many take as long.
BITS = 128
SHIFTS, DEEPEST = (0, 2, 4, 8, 12, 16, 24, 32), 300  # powers of two between modes, and in all, that are tried
SHORT = 1e-12  # of the values and of what the state does: what is missing, from which more entries move
GROUPS = 64  # in which entries are rounded: ten times as many take as many times as long, and land no better
NEARLY = 1e-6  # of the largest entry of a control: a change that is for more than rounding
FASTEST = 300.0  # logarithm of the growth of errors up to which states are followed so: bounds are doubles
TINY = float(np.finfo(float).tiny)  # what a conversion to a double may lose of the smallest numbers
OUTWARD = 1.0 + 2.0**-44  # for what a conversion to a double rounds


def growth(system: System, horizon: float) -> float:
    """Return the exponent of ``e`` by which the state can grow over the horizon: the largest real part of an eigenvalue
    of ``A(p)``, at a lattice of parameters, times the horizon; 0 where nothing grows."""
    points = ParameterIndex(system.parameters).lattice()[0]
    rate = max(float(np.linalg.eigvals(mode.matrices(points)[0]).real.max()) for mode in system.modes)
    return max(0.0, rate * horizon)


def column(entries: Array) -> arb_mat:
    """Return exact numbers ``(k,)`` as a column."""
    from flint import arb, arb_mat

    return arb_mat(entries.size, 1, [arb(entry) for entry in entries.tolist()])


def _bound_entries(matrix: arb_mat) -> Array:
    """Return upper bounds of the absolute values of the entries of a matrix, row after row."""
    return np.array([float(abs(entry).upper()) for entry in matrix.entries()]) * OUTWARD + TINY


def _bound_rate(matrix: list[list[Any]]) -> Any:
    """Return an upper bound of the largest eigenvalue of the symmetric part of a matrix, in any kind of numbers
    (Gershgorin 1931)."""
    count = range(len(matrix))
    return max(sum((abs(matrix[i][j] + matrix[j][i]) / 2 for j in count if j != i), matrix[i][i]) for i in count)


@dataclass(frozen=True, eq=False)
class Measure:
    """Norm ``|T^-1 x|`` of states in which a plant grows by at most ``e^{rate t}``: ``transform (d, d)`` is ``T``, and
    ``size (d, d)`` bounds the entries of its inverse."""

    transform: Array
    size: Array
    rate: float

    @staticmethod
    def of(A: Array) -> Measure:
        """Return the norm in the coordinates of the modes of ``A (d, d)``, with its logarithmic norm."""
        from flint import arb_mat, ctx

        T = decoupled(A).transform
        candidates = [T * 2.0 ** (-shift * np.arange(len(A))) for shift in SHIFTS if shift * len(A) < DEEPEST]
        inverses = (np.linalg.inv(candidate) for candidate in candidates)
        rates = [_bound_rate((V @ A @ S).tolist()) for V, S in zip(inverses, candidates, strict=True)]
        T = candidates[int(np.argmin(rates))]
        with ctx.workprec(BITS):
            exact = arb_mat(T.tolist())
            inverse = exact.inv()
            rate = float(_bound_rate((inverse * arb_mat(A.tolist()) * exact).tolist()).upper())
            size = _bound_entries(inverse).reshape(T.shape)
        return Measure(T, size, max(rate, 0.0) * OUTWARD)

    def pass_by(self, error: float, length: float, missed: Array) -> float:
        """Return the norm of an error after a piece of some length, at whose end states are ``missed (d,)`` too."""
        exponent = self.rate * length
        carried_error = float(np.exp(exponent)) * (1.0 + (exponent + 1.0) * (OUTWARD - 1.0)) * error
        return OUTWARD * (carried_error + float((self.size @ missed).sum()) * OUTWARD)

    def enter(self, before: Measure, error: float) -> float:
        """Return the norm of an error of which the norm of the phase before is ``error``."""
        return float(np.linalg.norm(self.size @ np.abs(before.transform))) * error * OUTWARD

    def entries(self, error: float) -> Array:
        """Return bounds ``(d,)`` of the entries of an error of a norm."""
        return np.asarray(np.linalg.norm(self.transform, axis=1) * error * OUTWARD)


@dataclass(frozen=True, eq=False)
class Orbit:
    """States of the plant ``x' = A x + B u`` at the breakpoints of a grid, from ``initial_state (d,)``.

    ``modes``: ``A (d, d)`` and ``B (d, m)`` of every phase, with the columns of constant inputs after those of the
    control; they are exact. ``bits``: those of every number.
    """

    modes: tuple[tuple[Array, Array], ...]
    grid: TimeGrid
    bits: int
    initial_state: Array
    _steps: dict[tuple[int, Fraction], tuple[arb_mat, arb_mat]] = field(default_factory=dict, repr=False)
    _weights: dict[bytes, tuple[arb_mat, list[arb_mat]]] = field(default_factory=dict, repr=False)
    _states: dict[bytes, tuple[Array, Array]] = field(default_factory=dict, repr=False)

    @staticmethod
    def of(system: System, grid: TimeGrid) -> Orbit | None:
        """Return the orbit from 0 of a plant that grows by ``e`` to the power of `NOTABLE`; ``None`` of others.

        Plants with parameters, or with entries in time, have none.
        """
        if system.varies or system.parameters is not None:
            return None
        exponent = growth(system, float(grid.breakpoints[-1]))
        if exponent < NOTABLE:
            return None
        every = [mode.matrices(np.zeros((1, 0))) for mode in system.modes]
        modes = tuple((A[0], B[0]) for A, B, _ in every)
        orbit = Orbit(modes, grid, BITS + ceil(2.0 * exponent / log(2.0)), np.zeros(system.states))
        rate = max(measure.rate for measure in orbit._measures)
        exponent = max(exponent, rate * float(grid.breakpoints[-1]))
        return replace(orbit, bits=BITS + ceil(2.0 * exponent / log(2.0))) if exponent <= FASTEST else None

    def from_state(self, initial_state: Array) -> Orbit:
        """Return the states from another initial state ``(d,)``; what does not depend on it is shared."""
        return replace(self, initial_state=initial_state, _states={})

    @shaped
    def states(self, control: Float[Array, "m K"]) -> tuple[Float[Array, "points d"], Float[Array, "points d"]]:
        """Return the states at the breakpoints ``(L + 1, d)`` under a control on its own pieces, and bounds of their
        errors; remembered for the last control."""
        key = control.tobytes()
        if key not in self._states:
            remember(self._states, key, self._follow(self.grid.inputs(control)), 1)
        return self._states[key]

    def _follow(self, inputs: Array) -> tuple[Array, Array]:
        """Return `states` under ``inputs (m, L)`` on the pieces."""
        from flint import ctx

        modes = [mode for mode, _ in self._pieces]
        with ctx.workprec(self.bits):
            steps, state = self._compute_steps(), column(self.initial_state)
            path, missed = [state], []
            for step, entries in zip(self._pieces, inputs.T, strict=True):
                flow, response = steps[step]
                ball = flow * state + response * column(entries)
                state = ball.mid()
                path.append(state)
                missed.append(_bound_entries(ball - state))
            rounded = np.array([[float(entry) for entry in state.entries()] for state in path])
            distances = [_bound_entries(state - column(own)) for state, own in zip(path, rounded, strict=True)]
        errors, before, error = [np.zeros(len(distances[0]))], modes[0], 0.0
        for mode, length, miss in zip(modes, self.grid.lengths.tolist(), missed, strict=True):
            measure = self._measures[mode]
            error = error if mode == before else measure.enter(self._measures[before], error)
            error, before = measure.pass_by(error, length, miss), mode
            errors.append(measure.entries(error))
        return rounded, OUTWARD * (np.array(distances) + np.array(errors))

    @cached_property
    def _measures(self) -> list[Measure]:
        return [Measure.of(A) for A, _ in self.modes]

    @shaped
    def landed(
        self,
        control: Float[Array, "m K"],
        H: Float[Array, "e d"],
        values: Float[Array, " e"],
        limits: tuple[Float[Array, " m"], Float[Array, " m"]],
    ) -> Float[Array, "m K"]:
        """Return a control whose final state ``x`` has ``H x = values`` as nearly as doubles allow.

        Only entries that are neither 0 nor at one of their ``limits`` move, by what rounding may have done to them; a
        few of the last ones that are 0 do where the others do not suffice. The early ones are rounded first, and the
        later ones make up for that: their last digits move the final state by less. The control itself is returned
        where more than rounding is missing.
        """
        from flint import ctx

        entries, (lower, upper) = control.T.ravel(), (np.tile(limit, control.shape[1]) for limit in limits)  # by pieces
        most = NEARLY * np.abs(entries).max(initial=0.0)
        is_inside = (entries > lower + most) & (entries < upper - most)
        moving, idle = (np.flatnonzero(is_inside & mask) for mask in (entries != 0.0, entries == 0.0))
        with ctx.workprec(self.bits):
            effects, missing = self._find_effects(control, H, values)
            landed, left = _round_towards(entries, moving, effects, missing, most)
            if left > SHORT * float(np.abs(values).max() + np.abs(self.states(control)[0] @ H.T).max()):
                more = np.sort(np.append(moving, idle[-len(values) :]))
                again, left_then = _round_towards(entries, more, effects, missing, most)
                landed = again if left_then < left else landed
        return control if landed is entries else np.ascontiguousarray(landed.reshape(control.T.shape).T)

    def _find_effects(self, control: Array, H: Array, values: Array) -> tuple[list[arb_mat], arb_mat]:
        """Return the effect ``(e, 1)`` of every entry of a control on ``H x`` at the end, piece after piece, and what
        ``H x`` misses of ``values (e,)``."""
        from flint import arb_mat

        rows, weights = self._weigh(H)
        missing = column(values) - rows * column(self.initial_state)
        effects = [arb_mat(len(values), 1) for _ in range(control.size)]
        pieces = zip(weights, self.grid.inputs(control).T, self.grid.control_piece.tolist(), strict=True)
        for weight, entries, piece in pieces:
            missing = missing - weight * column(entries)
            for channel in range(len(control) if piece >= 0 else 0):
                place = piece * len(control) + channel
                effects[place] = effects[place] + _take_column(weight, channel)
        return [effect.mid() for effect in effects], missing.mid()

    def _weigh(self, H: Array) -> tuple[arb_mat, list[arb_mat]]:
        """Return the weights of ``H x`` at the end on the initial state ``(e, d)`` and on the inputs on every piece
        ``(e, m)``; remembered for the last rows."""
        from flint import arb_mat

        key = H.tobytes()
        if key not in self._weights:
            steps, rows, weights = self._compute_steps(), arb_mat(H.tolist()), []
            for step in reversed(self._pieces):
                flow, response = steps[step]
                weights.append(rows * response)
                rows = rows * flow
            remember(self._weights, key, (rows, weights[::-1]), 1)
        return self._weights[key]

    @cached_property
    def _pieces(self) -> list[tuple[int, Fraction]]:
        """Mode and exact length of every piece, ``(L,)``."""
        ends = [Fraction(end) for end in self.grid.breakpoints.tolist()]
        lengths = [stop - start for start, stop in pairwise(ends)]
        return list(zip(self.grid.modes.tolist(), lengths, strict=True))

    def _compute_steps(self) -> dict[tuple[int, Fraction], tuple[arb_mat, arb_mat]]:
        """Return the transition over every kind of piece and the response to inputs on it; remembered."""
        from flint import arb, arb_mat

        for mode, length in set(self._pieces) - set(self._steps):
            A, B = self.modes[mode]
            (d, m), generator = B.shape, np.zeros((sum(B.shape), sum(B.shape)))
            generator[:d] = np.hstack([A, B])
            seconds = arb(length.numerator) / arb(length.denominator)
            flow = (arb_mat(generator.tolist()) * seconds).exp().tolist()
            table = arb_mat([row[:d] for row in flow[:d]]), arb_mat([row[d : d + m] for row in flow[:d]])
            self._steps[mode, length] = table
        return self._steps


def _round_towards(
    entries: Array, moving: np.ndarray, effects: list[arb_mat], missing: arb_mat, most: float
) -> tuple[Array, float]:
    """Return entries in doubles with which nothing is ``missing (e, 1)``, and the largest size of what still is; the
    ``entries`` themselves where one of the ``moving`` would move by more than ``most``.

    All that are left move by least together; one group of them after the other is rounded.
    """
    if not moving.size:
        return entries, np.inf
    landed, groups = entries.copy(), np.array_split(moving, min(GROUPS, moving.size))
    tables = [_join_columns([effects[place] for place in group.tolist()]) for group in groups]
    squares = _sum_squares(tables, missing.nrows())
    for number, group in enumerate(groups):
        changes = _find_changes(tables[number:], squares[number], missing)
        if not (np.abs(changes) <= most).all():
            return entries, np.inf
        landed[group] = entries[group] + changes
        for place in group.tolist():
            missing = (missing - effects[place] * column(landed[place : place + 1] - entries[place])).mid()
    return landed, float(_bound_entries(missing).max(initial=0.0))


def _join_columns(columns: list[arb_mat]) -> arb_mat:
    """Return the matrix ``(e, f)`` of some columns ``(e, 1)``."""
    from flint import arb_mat

    return arb_mat([list(row) for row in zip(*(column.entries() for column in columns), strict=True)])


def _sum_squares(tables: list[arb_mat], count: int) -> list[arb_mat]:
    """Return the sums ``(e, e)`` of ``C C'`` over the effects ``C (e, f)`` of every group and those after it; ``count``
    is ``e``."""
    from flint import arb_mat

    sums = [arb_mat(count, count)]
    for table in reversed(tables):
        sums.append((sums[-1] + table * table.transpose()).mid())
    return sums[:0:-1]


def _find_changes(tables: list[arb_mat], squares: arb_mat, missing: arb_mat) -> Array:
    """Return the changes ``(f,)`` of a group of entries, the first of ``tables`` of effects.

    Together with those of the groups after it they make up for what is ``missing (e, 1)``, and are least; or they leave
    least of it, where the entries are few. They are 0 where some of the values do not depend on the entries.
    """
    first = tables[0].transpose()
    try:
        if sum(table.ncols() for table in tables) >= squares.nrows():
            least = first * squares.solve(missing).mid()
        else:
            C = _join_columns([_take_column(table, number) for table in tables for number in range(table.ncols())])
            least = (C.transpose() * C).mid().solve(C.transpose() * missing)
    except ZeroDivisionError:
        return np.zeros(first.nrows())
    return np.array([float(entry.mid()) for entry in least.entries()[: first.nrows()]])


def _take_column(table: arb_mat, number: int) -> arb_mat:
    """Return one column ``(e, 1)`` of a matrix ``(e, f)``."""
    from flint import arb_mat

    return arb_mat([[row[number]] for row in table.tolist()])
