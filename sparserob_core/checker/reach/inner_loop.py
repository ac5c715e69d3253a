"""State feedback beside the decision, ``u_k = K_k x(tau_k) + v_k``, in ball arithmetic.

The nominal control follows from the decided part ``v`` and the gains ``K``. A constraint on the control ``u`` becomes
one on ``v``, and a bound of ``|K_k x(tau_k)|`` under every control that keeps the constraints gives the range of ``v``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from flint import arb, arb_mat

from sparserob_core.checker.arithmetic.balls import above, ball, balls
from sparserob_core.checker.arithmetic.series import exactly, identity, middles, stacked, zeros
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.plant import held_about
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

GROWTHS = 3.0  # times the growth of a plant whose digits are kept: with half of them bounds are as wide as the numbers
SPANS = (1, 2, 4, 8)  # pieces of the control, over which constraints on the states are read together
ROUNDED = 1.0 + 2.0**-30  # factor of a range that is computed in floats: it may be a little wider for nothing
LEAST = 1e-12  # of the largest width, the least that a guess divides by; no claim rests on it
TINY = float(np.finfo(float).tiny)


@final
@dataclass(frozen=True, eq=False)
class StateBound:
    """Bounds of ``C x`` at the breakpoints of the control at which a constraint holds.

    Attributes
    ----------
    rows
        The rows ``C (r, d)``.
    values
        A ball that contains each value, ``(r, 1)``, at every breakpoint; ``None`` where the constraint does not hold.
    """

    rows: Array
    values: Sequence[arb_mat | None]


@final
@dataclass(frozen=True, eq=False)
class PlantInputs:
    """Inputs that drive a plant, and bounds of its states.

    Attributes
    ----------
    initial, control, disturbance
        Balls that contain the initial state ``(d, 1)``, the control ``(m, 1)`` and the disturbance ``(mw, 1)``.
    bounds
        The constraints on the state.
    missing
        Bounds ``(m,)`` of what the feedback does not know of the state.
    """

    initial: arb_mat
    control: arb_mat
    disturbance: arb_mat
    bounds: Sequence[StateBound]
    missing: Array


@final
@dataclass(frozen=True, eq=False)
class VerifiedInnerLoop:
    """The plant from breakpoint to breakpoint of the control, and the ``gains (K, m, d)`` of its feedback.

    Attributes
    ----------
    flow
        The flow of the plant.
    breakpoints
        The breakpoints of the control, ``(K + 1,)``.
    grid
        These, and all other times at which an input may jump.
    gains
        The gains.
    start, middle
        The initial state ``(d,)`` and the disturbance ``(mw,)`` from which deviations are counted.
    """

    flow: VerifiedFlow
    breakpoints: Sequence[float]
    grid: Sequence[float]
    gains: Array
    start: Sequence[arb]
    middle: Array

    @property
    def acts(self) -> bool:
        """True: there is a feedback."""
        return True

    @cached_property
    def matrices(self) -> list[arb_mat]:
        """The gain ``(m, d)`` of every piece."""
        return [exactly(gain) for gain in self.gains]

    @cached_property
    def plant(self) -> list[tuple[arb_mat, arb_mat, arb_mat, list[arb_mat]]]:
        """For every piece the transition ``(d, d)``, and the responses to a constant control ``(d, m)``, to a drift
        ``(d, 1)``, and to the disturbance on each part of the piece between two times of the grid, ``(d, mw)``."""
        steps, m, d = list[tuple[arb_mat, arb_mat, arb_mat, list[arb_mat]]](), *self.gains.shape[1:]
        for start, stop in pairwise(self.breakpoints):
            Phi, Gamma, drift, parts = identity(d), zeros(d, m), zeros(d, 1), list[arb_mat]()
            for ends in pairwise([start, *(t for t in self.grid if start < t < stop), stop]):
                flow, forced, Delta = self.flow.over(*ends)
                B, c = forced.columns(0, m).matrix, forced.columns(m, None)
                Phi, Gamma, drift = flow.matrix * Phi, flow.matrix * Gamma + B, flow.matrix * drift
                drift = drift + c.matrix if c.shape[1] else drift
                parts = [flow.matrix * part for part in parts] + ([Delta.matrix] if Delta.shape[1] else [])
            steps.append((Phi, Gamma, drift, parts))
        return steps

    def _enter(self, piece: int, disturbance: arb_mat) -> arb_mat:
        """Return what drift and ``disturbance (mw, 1)`` add to the state on a piece, ``(d, 1)``."""
        _, _, drift, parts = self.plant[piece]
        return sum((part * disturbance for part in parts), drift)

    @cached_property
    def entering(self) -> list[arb_mat]:
        """Terms ``(d, 1)`` that enter the nominal state at every breakpoint since the one before: at the first one the
        initial state."""
        disturbance = arb_mat(self.middle.size, 1, balls(self.middle))
        first = stacked([[v] for v in self.start])
        return [first, *(self._enter(piece, disturbance) for piece in range(len(self.gains) - 1))]

    def nominal(self, decided: list[arb_mat]) -> list[arb_mat]:
        """Return the nominal control ``(m, 1)`` on every piece, from its ``decided`` part."""
        controls, state = list[arb_mat](), self.entering[0]
        for k, (K, v) in enumerate(zip(self.matrices, decided, strict=True)):
            controls.append(K * state + v)
            if k + 1 < len(decided):
                Phi, Gamma, _, _ = self.plant[k]
                # one transition of the state, since signs that are lost in balls are not found again
                state = (Phi + Gamma * K) * state + Gamma * v + self.entering[k + 1]
        return controls

    def on_decided(
        self,
        slope: list[list[arb]],
        deviations: Callable[[], tuple[Sequence[Sequence[arb]], Sequence[Sequence[arb]]]],
    ) -> tuple[arb, list[list[arb]]]:
        """Return ``sum_k slope_k u_k`` as a constant, and slopes of the decided part of the control.

        Parameters
        ----------
        slope
            Slopes ``(K, m)`` of the control.
        deviations
            A function that gives what deviations add to the nominal state at every breakpoint since the one before,
            and the errors of the states that the feedback acts on, ``(K, d)`` each.

        Returns
        -------
        constant
            The constant.
        slopes
            Slopes ``(K, m)`` of the decided part, and of the answers to innovations.
        """
        row = zeros(1, self.gains.shape[2])
        constant, slopes, (entering, errors) = ball(0.0), list[list[arb]](), deviations()
        for k in range(len(self.gains) - 1, -1, -1):
            Phi, Gamma, _, _ = self.plant[k]
            on_control = stacked([slope[k]]) + row * Gamma
            on_state = on_control * self.matrices[k]
            constant = constant - (on_state * stacked([[v] for v in errors[k]]))[0, 0]
            row = row * Phi + on_state
            slopes.append(on_control.entries())
            added = stacked([[v] for v in entering[k]])
            constant = constant + (row * (self.entering[k] + added))[0, 0]
        return constant, slopes[::-1]

    def widen(self, control: ConvexSet, collect: Callable[[], PlantInputs]) -> ConvexSet:
        """Return a set of the decided part of the control on every piece, for a control in a set, and the inputs of the
        plant that ``collect`` gives. It is a box."""
        inputs = collect()
        # deviations are counted from middles, which rounding may move out of thin sets
        sizes = ROUNDED * (
            np.array([above(abs(u)) for u in inputs.control.entries()]) + self.reach(inputs) + inputs.missing
        )
        return Box(-sizes, sizes)

    def reach(self, inputs: PlantInputs) -> Array:
        """Return upper bounds ``(m,)`` of ``|K_k x(tau_k)|`` under every control that keeps the constraints.

        Every state is bounded in coordinates ``z = W x``, from the breakpoint before, from the breakpoint after, and by
        the constraints at the next few breakpoints.
        """
        control, disturbance = inputs.control, inputs.disturbance
        W = exactly(_part_modes(middles(self.plant[0][0])))
        inverse = W.inv()
        steps = [
            (
                W * Phi * inverse,
                Driving([(W * Gamma, control), (W, drift), *((W * part, disturbance) for part in parts)]),
            )
            for Phi, Gamma, drift, parts in self.plant
        ]
        rows = [(exactly(bound.rows) * inverse, bound.values) for bound in inputs.bounds]
        states = [W * inputs.initial]
        for k in range(len(steps) + 1):
            for span in SPANS:
                states[k] = _narrow(states[k], *read_constraints(k, span, steps, rows))
            if k < len(steps):
                states.append(steps[k][0] * states[k] + steps[k][1].total)
        for k in range(len(steps) - 1, -1, -1):
            states[k] = _narrow(states[k], steps[k][0].tolist(), (states[k + 1] - steps[k][1].total).entries())
        largest = np.zeros(self.gains.shape[1])
        for K, state in zip(self.matrices, states, strict=False):
            largest = np.maximum(largest, [above(abs(x)) for x in (K * inverse * state).entries()])
        return largest


@final
class NoInnerLoop:
    """No feedback beside the decision: the decided part of the control is the control."""

    @property
    def acts(self) -> bool:
        """False: there is no feedback."""
        return False

    @property
    def gains(self) -> Array:
        """The gains: an empty array."""
        return np.zeros((0, 0, 0))

    def nominal(self, decided: list[arb_mat]) -> list[arb_mat]:
        """Return the ``decided`` control."""
        return decided

    def on_decided(
        self,
        slope: list[list[arb]],
        deviations: Callable[[], tuple[Sequence[Sequence[arb]], Sequence[Sequence[arb]]]],
    ) -> tuple[arb, list[list[arb]]]:
        """Return the constant 0 and the same ``slope``, whatever the deviations are."""
        return ball(0.0), slope

    def widen(self, control: ConvexSet, collect: Callable[[], PlantInputs]) -> ConvexSet:
        """Return the same set, whatever the inputs of the plant are."""
        return control


@final
@dataclass(frozen=True, eq=False)
class Driving:
    """Terms that are added to the state on a piece: responses, each to an input of its own."""

    terms: list[tuple[arb_mat, arb_mat]]

    @cached_property
    def total(self) -> arb_mat:
        """The sum, ``(d, 1)``."""
        first, *others = (response * part for response, part in self.terms)
        return sum(others, first)


def read_constraints(
    k: int,
    span: int,
    steps: Sequence[tuple[arb_mat, Driving]],
    bounds: Sequence[tuple[arb_mat, Sequence[arb_mat | None]]],
) -> tuple[list[list[arb]], list[arb]]:
    """Return rows on the state at breakpoint ``k`` with their values, from the constraints at this and the next
    ``span`` breakpoints."""
    d, last = (steps[0][0].nrows(), min(k + span, len(steps)))
    rows, values, flow, terms = list[list[arb]](), list[arb](), identity(d), list[tuple[arb_mat, arb_mat]]()
    for j in range(k, last + 1):
        for C, by_breakpoint in bounds:
            value = by_breakpoint[j]
            if value is None:
                continue
            rows += (C * flow).tolist()
            for response, part in terms:
                value = value - (C * response) * part
            values += value.entries()
        if j < last:
            Phi, driving = steps[j]
            terms, flow = [(Phi * response, part) for response, part in terms] + driving.terms, Phi * flow
    return rows, values


def _narrow(state: arb_mat, rows: list[list[arb]], values: list[arb]) -> arb_mat:
    """Return balls of a ``state (d, 1)`` that rows with these values narrow.

    With all rows ``R``, those of the state itself among them, ``x = M R x + (1 - M R) x`` for any ``M``.
    """
    d = state.nrows()
    table, given = stacked([*identity(d).tolist(), *rows]), stacked([[v] for v in [*state.entries(), *values]])
    widths = 2.0 * np.array([float(v.rad()) for (v,) in given.tolist()])
    weights = 1.0 / np.maximum(widths, LEAST * widths.max() + TINY)
    M = exactly(np.linalg.pinv(weights[:, None] * middles(table)) * weights)
    narrowed = M * given + (identity(d) - M * table) * state
    pairs = zip(state.entries(), narrowed.entries(), strict=True)
    return stacked([[before if above(before.rad()) <= above(after.rad()) else after] for before, after in pairs])


def lost_digits(
    plants: Sequence[Sequence[Array]], lengths: Array, gains: Array, corrections: Sequence[Array] | Array = ()
) -> float:
    """Return the exponent of what balls and multipliers lose beside gains ``(K, m, d)`` on pieces of ``lengths (K,)``;
    0 without gains. ``plants`` are the matrices ``(A, B)`` of every mode, and ``corrections`` the products
    ``L_k C (d, d)`` of an observer on every piece, where outputs are measured.

    Rows in states lose what the plant amplifies by, their adjoints and products of both as much again. The states of
    the loop, and the errors of an observer, lose what the sizes of their transitions amplify by, as signs are lost in
    balls.
    """
    if not gains.size:
        return 0.0
    steps = [[held_about(A, B, length) for A, B in plants] for length in lengths]
    exponent = _wrap([[Phi + Gamma @ K for Phi, Gamma in step] for step, K in zip(steps, gains, strict=True)])
    exponent += _wrap([[Phi - LC for Phi, _ in step] for step, LC in zip(steps, corrections, strict=False)])
    rates = [float(np.linalg.eigvals(A).real.max()) for A, _ in plants]
    return GROWTHS * float(lengths.sum()) * max(0.0, *rates) + exponent


def _wrap(steps: Sequence[Sequence[Array]]) -> float:
    """Return the exponent by which the sizes of transitions ``(d, d)`` amplify, one after the other, in the worst mode
    of each."""
    exponent, wrapped = 0.0, None
    for modes in steps:
        wrapped = np.ones(len(modes[0])) if wrapped is None else wrapped
        sizes = max((np.abs(mode) @ wrapped for mode in modes), key=np.sum)
        exponent, wrapped = exponent + max(0.0, float(np.log(sizes.max()))), sizes / sizes.max()
    return exponent


def _part_modes(Phi: Array) -> Array:
    """Return coordinates of the states in which a transition ``(d, d)`` parts what decays from what grows: a guess, as
    any invertible matrix serves."""
    from scipy.linalg import schur, solve_sylvester

    T, Q, decaying = schur(Phi, output="real", sort="iuc")
    basis = np.eye(len(T))
    basis[:decaying, decaying:] = solve_sylvester(
        T[:decaying, :decaying], -T[decaying:, decaying:], -T[:decaying, decaying:]
    )
    return np.asarray(np.linalg.inv(Q @ basis))
