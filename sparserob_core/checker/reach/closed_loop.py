"""A closed loop in ball arithmetic, computed from the gains alone: the control answers what it measures.

The control on piece ``k`` is ``u_k = v_k + sum_j M_kj e_j``, with the innovations ``e_j`` of the module `innovations`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import above, ball, balls
from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import around, exactly, identity, stacked
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.reach.deviations import Deviations
from sparserob_core.checker.reach.innovations import VerifiedInnovations, find_piece
from sparserob_core.checker.sets.polynomials import OUTWARD, Enclosed, rounding
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.policies.measurements import Measurements
    from sparserob_core.control.problem.system import System

NO_GAINS = np.zeros((0, 0, 0))
ORDER = 8  # degree of the states in the time on a cell; the remainder counts twice, half of it needs shorter cells


@final
@dataclass(frozen=True, eq=False)
class VerifiedLoop:
    """A known system under a control that answers innovations, with ``Q`` entries of deviations.

    Attributes
    ----------
    initial_state
        The initial state from which ``initial`` is counted, ``(d,)``.
    nominal
        The nominal control on each of ``K`` pieces, ``(m, 1)``.
    gains
        The answers of every piece to every innovation, ``(K, K, m, d)``; to those of the outputs, ``(K, K, m, p)``.
    grid, breakpoints, changes
        All breakpoints; those of the control; the times at which the disturbance may jump.
    shape, initial
        The set of the disturbance, and the set of deviations of the initial state; ``None`` where there is none.
    before
        The control that acts until the delay is over, ``(m,)``.
    measured, observer
        What is measured of the state at every breakpoint, and the gains of the observer ``(K, d, p)`` that makes
        innovations of it; ``None`` where the whole state is measured.
    law
        The flow of the system, where it is known already.
    inner
        The gains ``(K, m, d)`` of a feedback of the state at the breakpoints, beside the answers; empty without one.
    """

    system: System
    initial_state: list[float]
    nominal: Sequence[arb_mat]
    gains: Array
    grid: list[float]
    breakpoints: list[float]
    changes: list[float]
    shape: ConvexSet | None
    initial: ConvexSet | None = None
    before: tuple[float, ...] = ()
    measured: Measurements | None = None
    observer: Array | None = None
    law: VerifiedFlow | None = None
    inner: Array = field(default_factory=lambda: NO_GAINS)

    @cached_property
    def flow(self) -> VerifiedFlow:
        """The flow of the system: its ``law`` where that is given."""
        until = self.grid[-1]
        return VerifiedFlow(Plant.of(self.system, until), until) if self.law is None else self.law

    @cached_property
    def acting(self) -> list[float]:
        """The time at which every piece of the control begins to act: its breakpoint plus the delay."""
        return [time + self.system.delay for time in self.breakpoints[:-1]]

    @cached_property
    def deviations(self) -> Deviations:
        """The deviations that the control may have to answer."""
        noise, K = None if self.measured is None else self.measured.noise, len(self.breakpoints) - 1
        width, noises = self.system.disturbances, 0 if noise is None else K
        return Deviations(self.shape, width, self.initial, len(self.changes), noise, noises)

    @cached_property
    def innovations(self) -> VerifiedInnovations:
        """The innovations that the control measures at its breakpoints."""
        return VerifiedInnovations(
            self.flow, self.deviations, self.grid, self.breakpoints, self.changes, self.measured, self.observer
        )

    def _find_acting_indices(self, piece: int) -> tuple[int, int]:
        """Return the indices of the piece of the control and of the block of the disturbance that act on a piece of the
        grid. The piece of the control is -1 before the delay is over."""
        return find_piece(self.acting, self.grid, piece), find_piece(self.changes, self.grid, piece)

    def _compute_part_flow(self, piece: int, start: float, stop: float) -> tuple[arb_mat, arb_mat]:
        """Return the transition ``(d, d)`` of a part of a piece of the grid, and what the inputs add to the nominal
        state and to the responses, ``(d, 1 + Q)``."""
        Phi, Gamma, Delta = self.flow.over(start, stop)
        return Phi.matrix, Gamma.append_columns(Delta).matrix * self.drives[piece]

    @cached_property
    def effects(self) -> list[list[list[arb]]]:
        """The matrices ``F_k (m, Q)`` by which the control on each piece depends on the deviations."""
        return [[row[1:] for row in self.inputs(k).tolist()] for k in range(self.gains.shape[0])]

    def _drive(self, piece: int, control: arb_mat) -> arb_mat:
        """Return the inputs on a piece of the grid, control, drift and disturbance, as nominal values and responses:
        with a drift ``(m + 1 + mw, 1 + Q)``, without one ``(m + mw, 1 + Q)``."""
        _, block = self._find_acting_indices(piece)
        zeros = [0.0] * self.deviations.starts[-1]
        drift = [balls([1.0, *zeros])] if self.flow.driven > self.system.controls else []
        entering = [balls([middle, *zeros]) for middle in self.deviations.middle.tolist()]
        for i, row in enumerate(entering if self.deviations.blocks else ()):
            column = 1 + block * self.system.disturbances + i
            row[column] = row[column] + 1
        return stacked([*control.tolist(), *drift, *entering])

    @property
    def drives(self) -> list[arb_mat]:
        """The inputs on each piece of the grid (`_drive`)."""
        return self._path[1]

    @property
    def nodes(self) -> list[arb_mat]:
        """The nominal state and the responses to all deviations at every breakpoint of the grid, ``(d, 1 + Q)``."""
        return self._path[0]

    @cached_property
    def _path(self) -> tuple[list[arb_mat], list[arb_mat], dict[int, arb_mat]]:
        """The `nodes`, the `drives`, and the control on every piece with its answers, ``(m, 1 + Q)``."""
        begin, answers = [ball(v) for v in self.initial_state], identity(self.system.states).tolist()
        if self.initial is None:
            answers = [[] for _ in begin]
        else:
            begin = [v + ball(m) for v, m in zip(begin, self.deviations.sets[-1][1], strict=True)]
        zero = [ball(0)] * self.deviations.starts[self.deviations.initial_block]
        nodes = [stacked([[v, *zero, *row] for v, row in zip(begin, answers, strict=True)])]
        drives, controls, beginning = list[arb_mat](), dict[int, arb_mat](), nodes[0]
        d, m = self.system.states, self.system.controls
        for piece, ends in enumerate(pairwise(self.grid)):
            k = self._find_acting_indices(piece)[0]
            if k not in controls:
                controls[k], K = self._decide(k), exactly(self.inner[k]) if self.inner.size else None
                beginning, transition, added = nodes[-1], identity(d), nodes[-1] * 0
                controls[k] = controls[k] if K is None else controls[k] + K * beginning
            drives.append(self._drive(piece, controls[k]))
            flow, forced, disturbed = self.flow.over(*ends)
            Phi, Gamma = flow.matrix, forced.append_columns(disturbed).matrix
            if K is None:
                nodes.append(Phi * nodes[-1] + Gamma * drives[-1])
                continue
            # the state where the control began is multiplied once, since signs that are lost in balls do not come back
            transition = Phi * transition + forced.columns(0, m).matrix * K
            added = Phi * added + Gamma * self._drive(piece, self._decide(k))
            nodes.append(transition * beginning + added)
        return nodes, drives, controls

    def state(self, piece: int, time: float) -> arb_mat:
        """Return the nominal state and the responses at a time in a piece of the grid, ``(d, 1 + Q)``."""
        if time == self.grid[piece]:
            return self.nodes[piece]
        if time == self.grid[piece + 1]:
            return self.nodes[piece + 1]
        Phi, effect = self._compute_part_flow(piece, self.grid[piece], time)
        return Phi * self.nodes[piece] + effect

    def inputs(self, k: int) -> arb_mat:
        """Return the nominal control and its answers on a piece of the control, ``(m, 1 + Q)``; on piece -1 the control
        before."""
        return self._path[2][k] if self.inner.size else self._decide(k)

    @remembered()
    def _decide(self, k: int) -> arb_mat:
        """Return the `inputs` on a piece of the control, without the feedback of the state by the inner loop, but with
        the part of it that is missing where outputs are measured."""
        starts, zero = self.deviations.starts, ball(0)
        if k < 0:
            return stacked([[ball(v), *[zero] * starts[-1]] for v in self.before])
        rows = [[v, *[zero] * starts[-1]] for v in self.nominal[k].entries()]
        for j in np.flatnonzero(self.gains[k].any(axis=(1, 2))).tolist():
            M = exactly(self.gains[k, j])
            for block, matrix in self.innovations.matrices[j].items():
                self._add_response(rows, block, M * matrix)
        for block, matrix in self.innovations.errors[k].items() if self.inner.size else ():
            self._add_response(rows, block, -exactly(self.inner[k]) * matrix)
        return stacked(rows)

    def _add_response(self, rows: list[list[arb]], block: int, response: arb_mat) -> None:
        """Add a ``response (m, mw)`` to one block of the deviations to ``rows (m, 1 + Q)``."""
        for row, values in zip(rows, response.tolist(), strict=True):
            for b, value in enumerate(values, 1 + self.deviations.starts[block]):
                row[b] = row[b] + value

    def bound_missing(self, gains: Array) -> Array:
        """Return upper bounds ``(m,)`` of what feedbacks ``gains (K, m, d)`` of the state at the breakpoints do not
        know of it, under any deviation; 0 where the state is measured."""
        largest = np.zeros(gains.shape[1])
        for gain, errors in zip(gains, self.innovations.errors, strict=True):
            rows = [[ball(0.0)] * (1 + self.deviations.starts[-1]) for _ in largest]
            for block, matrix in errors.items():
                self._add_response(rows, block, exactly(gain) * matrix)
            both = [[self.deviations.support([sign * x for x in row[1:]]) for sign in (1, -1)] for row in rows]
            largest = np.maximum(largest, [above(high.max(low)) for high, low in both])
        return largest

    def answers(self, k: int) -> arb_mat:
        """Return the answers on a piece of the control with 0 as nominal control, ``(m, 1 + Q)``."""
        return stacked([[ball(0), *row[1:]] for row in self.inputs(k).tolist()])

    def on(self, piece: int) -> int:
        """Return the index of the piece of the control that is commanded on a piece of the grid. Without a delay, this
        piece acts there."""
        return find_piece(self.breakpoints, self.grid, piece)

    def heights(self, state: arb_mat, rows: Array | arb_mat, added_terms: arb_mat | None = None) -> list[arb]:
        """Return the largest ``c'x`` over all deviations, for every row ``c`` of ``rows (r, d)``, from a nominal
        ``state`` and its responses ``(d, 1 + Q)``. A nominal value and responses ``added_terms (r, 1 + Q)`` are added
        to each row."""
        product = exactly(rows) * state
        along = (product if added_terms is None else product + added_terms).tolist()
        return [row[0] + self.deviations.support(row[1:]) for row in along]

    def highest(self, piece: int, time: float, rows: Array | arb_mat, added_terms: arb_mat | None = None) -> list[arb]:
        """Return the `heights` of ``rows (r, d)`` at a time in a piece of the grid."""
        return self.heights(self.state(piece, time), rows, added_terms)

    def bound_chord_error(self, piece: int, start: float, stop: float, rows: Array | arb_mat) -> Array:
        """Return upper bounds ``(r,)`` of how far ``max c'x(t)`` lies above its chord on ``[start, stop]``, a part of a
        piece of the grid without marks. The states are a polynomial in the share ``s`` of the cell, and a term
        ``a s^n`` differs from its chord by at most ``(n - 1) n^(-n / (n - 1)) |a|``."""
        terms, remainder = self.flow.within(start, stop, start, stop, ORDER + 1)
        augmented = stacked([*self.state(piece, start).tolist(), *self.drives[piece].tolist()])
        line, sizes = exactly(rows), np.concatenate([[1.0], self.deviations.radii])
        total = np.zeros((line.nrows(), sizes.size))
        for n, term in enumerate(terms[2:], 2):
            enclosure = Enclosed.of(line * (term.matrix * augmented))
            total += (np.abs(enclosure.mid) + enclosure.rad) * ((n - 1) * n ** (-n / (n - 1)) * OUTWARD)
        # twice, since the remainder changes both the states within the cell and the ends of the chord
        enclosure = Enclosed.of(line * (around(remainder) * augmented))
        total += 2.0 * (np.abs(enclosure.mid) + enclosure.rad)
        return np.asarray(total @ sizes * (1.0 + rounding(sizes.size)) * OUTWARD)
