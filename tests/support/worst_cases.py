"""Worst cases of known systems by a walk back in time with exponentials of small matrices: nothing of the package but
the support functions of its sets; and problems with their cases for the checker, of which they are the truth."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box, Ellipsoid
from sparserob_core.sip.convex_set import Array, ConvexSet
from tests.support.closed_loops import exponentials


@dataclass(frozen=True, eq=False)
class Weights:
    """Of rows at a time: what the initial state is worth ``(r, d)``, the control on every piece ``(r, K, m)``, the one
    before time 0 ``(r, m)``, a drift ``(r,)``, and the disturbance on every block ``(r, M, mw)``."""

    free: Array
    control: Array
    before: Array
    drift: Array
    blocks: Array


@dataclass(frozen=True, eq=False)
class Motion:
    """``x' = A x + B u(t - delay) + E w + c``, the matrices of one leg after another up to the ``ends`` of these; ``u``
    is constant between ``breakpoints (K + 1,)``, ``w`` from each of ``changes (M,)`` on."""

    legs: list[tuple[Array, Array, Array, Array]]
    ends: list[float]
    start: Array
    breakpoints: Array
    changes: Array
    delay: float = 0.0
    _steps: dict[tuple[float, float], Array] = field(default_factory=dict)

    @cached_property
    def acting(self) -> list[float]:
        """When every piece of the control begins to act."""
        return [float(t) + self.delay for t in self.breakpoints[:-1]]

    def weights(self, rows: Array, time: float) -> Weights:
        """Those of ``rows x(time)``, ``rows (r, d)``, piece by piece from the end."""
        d, m, mw = self.start.size, self.legs[0][1].shape[1], self.legs[0][2].shape[1]
        v, r = np.asarray(rows, dtype=float), len(rows)
        control, before, drift = np.zeros((r, len(self.acting), m)), np.zeros((r, m)), np.zeros(r)
        blocks = np.zeros((r, len(self.changes), mw))
        cuts = {0.0, time, *(t for t in (*self.ends, *self.acting, *map(float, self.changes)) if 0.0 < t < time)}
        for begin, end in reversed(list(pairwise(sorted(cuts)))):
            leg = bisect_right(self.ends, begin)
            given = v @ self._step(leg, begin, end - begin)
            v, inputs = given[:, :d], given[:, d:]
            k = bisect_right(self.acting, begin) - 1
            if k < 0:
                before += inputs[:, :m]
            else:
                control[:, k] += inputs[:, :m]
            if len(self.changes):
                blocks[:, bisect_right(self.changes, begin) - 1] += inputs[:, m : m + mw]
            drift += inputs[:, -1]
        return Weights(v, control, before, drift, blocks)

    def _step(self, leg: int, begin: float, length: float) -> Array:
        """The transition and the integrals of the inputs, ``(d, d + m + mw + 1)``."""
        key = float(leg), round(length, 12)
        if key not in self._steps:
            A, B, E, c = self.legs[leg]
            M, d = np.hstack([B, E, c[:, None]]), len(A)
            block = np.zeros((d + M.shape[1],) * 2)
            block[:d, :d], block[:d, d:] = A, M
            self._steps[key] = expm(block * length)[:d]
        return self._steps[key]

    def heights(
        self, rows: Array, time: float, u: Array, bound: ConvexSet | None, begun: ConvexSet | None, before: Array
    ) -> Array:
        """The largest ``rows x(time)`` over disturbances and initial states ``(r,)``, under ``u (m, K)``."""
        w = self.weights(rows, time)
        total = w.free @ self.start + (w.control * u.T).sum(axis=(1, 2)) + w.before @ before + w.drift
        if bound is not None:
            total = total + bound.support(w.blocks).sum(axis=1)
        return np.asarray(total if begun is None else total + begun.support(w.free))


@dataclass(frozen=True, eq=False)
class Varying(Motion):
    """``x' = (1 + t) A x + (1 - t / 4) (B u + E w + c)``: the transition is the exponential of ``A`` times the integral
    of its factor, what the inputs do is integrated by Gauss' rule."""

    RATE, FACTOR = "(1 + t)", "(1 - t/4)"

    def _step(self, leg: int, begin: float, length: float) -> Array:
        key = round(begin, 12), round(length, 12)
        if key not in self._steps:
            A, B, E, c = self.legs[leg]
            points, weights = np.polynomial.legendre.leggauss(16)
            end, within = begin + length, begin + length * (1.0 + points) / 2.0
            grown = (end - within) * (1.0 + (end + within) / 2.0)
            onward = exponentials(A * np.append(grown, length * (1.0 + begin + length / 2.0))[:, None, None])
            share = length / 2.0 * weights * (1.0 - within / 4.0)
            forced = np.tensordot(share, onward[:-1], axes=1) @ np.hstack([B, E, c[:, None]])
            self._steps[key] = np.hstack([onward[-1], forced])
        return self._steps[key]


HORIZON = 2.0
A = np.array([[0.0, 1.0], [-3.0, -0.4]])
OTHER = np.array([[-0.5, 2.0], [-1.0, 0.1]])
B, E = np.array([[0.3, 0.0], [1.0, -0.7]]), np.array([[0.4, 1.0], [-0.2, 0.5]])
C = np.array([0.25, -0.5])
START, BEFORE = np.array([0.5, -0.25]), np.array([0.7, -0.3])
ENDS, CHANGES = np.array([0.0, 0.5, 1.25, 2.0]), np.array([0.0, 0.75, 1.5])
BOUND, BEGUN = Box([-0.1, -0.3], [0.2, 0.1]), Ellipsoid([0.02, 0.0], [[0.01, 0.004], [0.004, 0.02]])
CONTROL = Box([-1.0, -2.0], [1.5, 0.5])
MOVING = np.array([[0.25, 0.5, 0.0], [1.0, -0.5, 0.75], [1.875, 0.25, -0.5]])
DIRECTIONS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.5, -1.25], [-0.75, -0.5]])
TIMES = np.arange(0.0, HORIZON + 1e-9, 1.0 / 32.0)


@dataclass(frozen=True, eq=False)
class Kind:
    """A problem, its case and the same motion here."""

    motion: Motion
    system: Any
    begun: ConvexSet | None
    bound: ConvexSet | None
    u: Array

    def case(self, certificate: dict[str, Any] | None = None, **more: Any) -> Case:
        late = {"initial_control": BEFORE} if self.motion.delay else {}
        given = {"disturbance": self.bound, "initial_set": self.begun, "control": CONTROL, **late, **more}
        problem = sr.OptimalControlProblem(
            system=self.system, horizon=HORIZON, initial_state=START, **given
        )  # fmt: skip
        said = {"decision": self.u.tolist(), "status": "verified", **(certificate or {})}
        grids = [sr.Dictionary.indicators(ends) for ends in (ENDS, [*CHANGES, HORIZON])]
        return Case(problem, *grids, said)

    def heights(self, time: float, rows: Array = DIRECTIONS) -> Array:
        return self.motion.heights(rows, time, self.u, self.bound, self.begun, BEFORE)

    @cached_property
    def sampled(self) -> Array:
        """At `TIMES`, ``(T, r)``."""
        return np.array([self.heights(float(t)) for t in TIMES])


@cache
def kind(name: str) -> Kind:
    legs, ends, delay = [(A, B, E, C)], list[float](), 0.0
    system: Any = LinearSystem(A, B, E, c=C)
    if name == "turning":
        legs, ends = [(A, B, E, C), (OTHER, B[::-1], E, -C), (A.T, B, 2.0 * E, C)], [0.625, 1.25]
        pieces = [(end, LinearSystem(*leg[:3], c=leg[3])) for end, leg in zip([*ends, HORIZON], legs, strict=True)]
        system = SwitchedSystem(pieces)
    if name == "late":
        delay = 0.375
        system = system.with_delay(delay)
    if name == "varying":
        delay = 0.375
        parts = [
            [[f"{x!r}*{factor}" for x in row] for row in np.atleast_2d(M).tolist()]
            for M, factor in zip((A, B, E, C), (Varying.RATE, *[Varying.FACTOR] * 3), strict=True)
        ]
        system = VaryingSystem.of(parts[0], parts[1], HORIZON, parts[2], parts[3][0], delay=delay)
    if name == "alone":
        legs, system = [(A, B, E, 0.0 * C)], LinearSystem(A, B, E)
    moves = Varying if name == "varying" else Motion
    motion = moves(legs, ends, START, ENDS, CHANGES if name != "alone" else np.zeros(0), delay)
    u = np.array([[0.5, -1.0, 1.5], [-2.0, 0.25, -0.5]])
    return Kind(motion, system, None if name == "alone" else BEGUN, None if name == "alone" else BOUND, u)


KINDS = ("alone", "known", "turning", "late", "varying")


def walls(name: str, which: str, made: Kind) -> tuple[Any, Array, Array]:
    """What makes a constraint of limits; the times of its window, and the highest rows at these, ``(T, r)``: on both
    sides of a jump of the control."""
    start, stop = 0.25, 1.875
    seen = (start <= TIMES) & (stop >= TIMES)
    inside, heights = TIMES[seen], made.sampled[seen]
    if which == "fixed":
        return lambda h: sr.PathConstraint(sr.Polytope(DIRECTIONS, h), start, stop), inside, heights
    if which == "moving":
        shift = np.stack([np.interp(inside, MOVING[:, 0], MOVING[:, i]) for i in (1, 2)], axis=1)
        at = heights - shift @ DIRECTIONS.T
        return lambda h: sr.PathConstraint(sr.Polytope(DIRECTIONS, h), start, stop, relative_to=MOVING), inside, at
    gains = np.array([[0.5, 0.0], [-0.25, 1.0], [0.0, -0.5], [1.0, 1.0]])
    beside = [
        made.u.T[np.clip(np.searchsorted(ENDS, inside, side=side) - 1, 0, 2)] @ gains.T for side in ("left", "right")
    ]
    return lambda h: sr.MixedConstraint(DIRECTIONS, gains, h, start, stop), inside, heights + np.maximum(*beside)
