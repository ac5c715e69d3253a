"""Systems whose control answers what it measures, with random gains, and what their states do: stepped from breakpoint
to breakpoint with matrix exponentials, the innovations measured as the policy defines them. Nothing of the package
computes here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.system import LinearSystem, System, VaryingSystem
from sparserob_core.control.sets.sets import Box, ConvexSet, Ellipsoid, NormBall, Polytope


@dataclass(frozen=True, eq=False)
class Loop:
    """``x' = A x + B u + E w + c`` from ``start`` and a set of deviations ``begun``, under ``w`` in ``bound``, constant
    between ``changes``; the control is constant between ``breakpoints``."""

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    breakpoints: np.ndarray
    changes: np.ndarray
    start: np.ndarray
    bound: ConvexSet | None = None
    begun: ConvexSet | None = None
    c: np.ndarray | None = None
    C: np.ndarray | None = None
    """What is seen of the state, with ``noise``, and made an innovation of by ``observer (K, d, p)``."""
    noise: ConvexSet | None = None
    observer: np.ndarray | None = None

    @property
    def system(self) -> System:
        return LinearSystem(self.A, self.B, self.E, c=self.c)

    @property
    def problem(self) -> sr.OptimalControlProblem:
        d, m = self.B.shape
        return sr.OptimalControlProblem(
            system=self.system,
            horizon=float(self.breakpoints[-1]),
            initial_state=self.start,
            initial_set=self.begun,
            control=Box(-9.0 * np.ones(m), 9.0 * np.ones(m)),
            disturbance=self.bound,
            terminal=[Box(-99.0 * np.ones(d), 99.0 * np.ones(d))],
            measurements=None if self.C is None else sr.Measurements(self.C, self.noise),
        )

    @property
    def grids(self) -> tuple[sr.Dictionary, sr.Dictionary]:
        return sr.Dictionary.indicators(self.breakpoints), sr.Dictionary.indicators(self.changes)

    @cached_property
    def grid(self) -> np.ndarray:
        """Every breakpoint."""
        return np.unique(np.concatenate([self.breakpoints, self.changes]))

    @cached_property
    def sets(self) -> list[tuple[ConvexSet, np.ndarray]]:
        """The set and the middle of every block of deviations."""
        found = [] if self.bound is None else [(self.bound, self.bound.middle())] * (self.changes.size - 1)
        found += [] if self.noise is None else [(self.noise, self.noise.middle())] * (self.breakpoints.size - 1)
        return found if self.begun is None else [*found, (self.begun, self.begun.middle())]

    def _step(self, begin: float, lengths: np.ndarray, X: np.ndarray, drive: np.ndarray) -> np.ndarray:
        """``X`` after each of ``lengths (n,)`` from ``begin`` on under a constant drive, ``(n, d, 1 + Q)``."""
        d = len(X)
        table = np.block([[self.A, np.eye(d)], [np.zeros((d, 2 * d))]])
        both = exponentials(table * np.atleast_1d(lengths)[:, None, None])
        return both[:, :d, :d] @ X + both[:, :d, d:] @ drive

    def rates(self, times: np.ndarray, X: np.ndarray, drive: np.ndarray) -> np.ndarray:
        """How fast ``X (n, d, 1 + Q)`` changes at ``times (n,)``."""
        return self.A @ X + drive

    def states(self, v: np.ndarray, M: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The nominal state and every response at ``times (T,)``, ``(T, d, 1 + Q)``, what changes them then, of the
        same shape, and the controls ``(K, m, 1 + Q)``."""
        d, m = self.B.shape
        width = 0 if self.bound is None else self.E.shape[1]
        blocks = 0 if self.bound is None else self.changes.size - 1
        noises = 0 if self.noise is None else (self.breakpoints.size - 1) * self.noise.dimension
        Q = blocks * width + noises + (0 if self.begun is None else d)
        middle = np.zeros(self.E.shape[1]) if self.bound is None else self.bound.middle()
        X = np.zeros((d, 1 + Q))
        X[:, 0] = self.start + (0.0 if self.begun is None else self.begun.middle())
        if self.begun is not None:
            X[:, 1 + blocks * width + noises :] = np.eye(d)
        still = self.E @ middle + (0.0 if self.c is None else np.asarray(self.c).ravel())
        error = np.hstack([np.zeros((d, 1)), X[:, 1:]])
        innovations = [self._innovation(0, error, 1 + blocks * width)]
        (found, rates), controls = np.zeros((2, times.size, d, 1 + Q)), []
        for k, (begin, end) in enumerate(pairwise(self.breakpoints)):
            U = np.zeros((m, 1 + Q))
            U[:, 0] = v[:, k]
            for j in range(k + 1):
                U += M[k, j] @ innovations[j]
            controls.append(U)
            before = X
            inside = self.grid[(self.grid >= begin) & (self.grid <= end)]
            for a, b in pairwise(inside):
                drive = self.B @ U
                drive[:, 0] += still
                if blocks:
                    at = 1 + (np.searchsorted(self.changes, (a + b) / 2) - 1) * width
                    drive[:, at : at + width] += self.E
                last = b == self.grid[-1]
                here = np.flatnonzero((times >= a) & ((times <= b) if last else (times < b)))
                after = self._step(a, np.append(times[here] - a, b - a), X, drive)
                found[here], rates[here] = after[:-1], self.rates(times[here], after[:-1], drive)
                X = after[-1]
            guess = self.B @ U
            guess[:, 0] += still
            length = np.array([end - begin])
            entered = X - self._step(begin, length, before, guess)[0]
            if self.C is not None and self.observer is not None:
                onward = self._step(begin, length, error, 0.0 * error)[0]
                error = onward - self.observer[k] @ innovations[k] + entered
            else:
                error = entered
            if end < self.grid[-1]:
                innovations.append(self._innovation(k + 1, error, 1 + blocks * width))
        return found, rates, np.array(controls)

    def _innovation(self, j: int, error: np.ndarray, noises: int) -> np.ndarray:
        """What is seen at a breakpoint beyond what was predicted, ``(p, 1 + Q)``; entries of the noise begin at
        ``noises``."""
        seen = error.copy() if self.C is None else self.C @ error
        if self.noise is not None:
            place = noises + j * self.noise.dimension
            seen[:, place : place + self.noise.dimension] += np.eye(self.noise.dimension)
        return seen

    def height(self, along: np.ndarray) -> np.ndarray:
        """The largest ``a_0 + a'z`` over all deviations, for ``(..., 1 + Q)``."""
        total, at = along[..., 0].copy(), 1
        for shape, middle in self.sets:
            block = along[..., at : at + shape.dimension]
            total += shape.support(block.reshape(-1, shape.dimension)).reshape(total.shape) - block @ middle
            at += shape.dimension
        return total

    @cached_property
    def radii(self) -> np.ndarray:
        """How far every entry of a deviation comes from its middle, ``(Q,)``."""
        far = []
        for shape, middle in self.sets:
            axes = np.eye(shape.dimension)
            far.append(np.maximum(shape.support(axes) - middle, shape.support(-axes) + middle))
        return np.concatenate([np.zeros(0), *far])


@dataclass(frozen=True, eq=False)
class Changing(Loop):
    """``x' = r(t) A x + f(t) (B u + E w + c)``: the transition is the exponential of ``A`` times the integral of ``r``.
    ``rate``, ``grown``, ``factor``: ``r``, its integral from 0 on and ``f``, as they are written in a config."""

    rate: str = "1"
    grown: str = "t"
    factor: str = "1"

    @property
    def system(self) -> VaryingSystem:
        def times(factor: str, matrix: np.ndarray) -> list[list[str]]:
            return [[f"{float(x)!r} * ({factor})" for x in row] for row in np.atleast_2d(matrix)]

        c = None if self.c is None else times(self.factor, self.c)[0]
        parts = times(self.rate, self.A), times(self.factor, self.B), times(self.factor, self.E)
        return VaryingSystem.of(parts[0], parts[1], float(self.breakpoints[-1]), parts[2], c)

    def _of(self, text: str, times: np.ndarray) -> np.ndarray:
        """One of the three functions at times."""
        names = {"sin": np.sin, "cos": np.cos, "exp": np.exp, "log": np.log, "t": np.asarray(times)}
        return np.asarray(eval(text.replace("^", "**"), {"__builtins__": {}}, names)) + 0.0 * times

    def _step(self, begin: float, lengths: np.ndarray, X: np.ndarray, drive: np.ndarray) -> np.ndarray:
        """The inputs by Gauss' rule: pieces are short beside what changes."""
        points, weights = np.polynomial.legendre.leggauss(16)
        within = begin + np.atleast_1d(lengths)[:, None] * (1.0 + points) / 2.0
        until = self._of(self.grown, begin + np.atleast_1d(lengths))
        whole = exponentials(self.A * (until - self._of(self.grown, np.array(begin)))[:, None, None])
        onward = exponentials(self.A * (until[:, None] - self._of(self.grown, within))[:, :, None, None])
        share = np.atleast_1d(lengths)[:, None] / 2.0 * weights * self._of(self.factor, within)
        return whole @ X + np.einsum("nq,nqij->nij", share, onward) @ drive

    def rates(self, times: np.ndarray, X: np.ndarray, drive: np.ndarray) -> np.ndarray:
        rate, factor = (self._of(text, times)[:, None, None] for text in (self.rate, self.factor))
        return rate * (self.A @ X) + factor * drive


def exponentials(matrices: np.ndarray) -> np.ndarray:
    """Of many small matrices at once: Taylor's series of a 256th of each, squared eight times."""
    small = matrices / 256.0
    term = total = np.broadcast_to(np.eye(matrices.shape[-1]), matrices.shape)
    for order in range(1, 13):
        term = term @ small / order
        total = total + term
    for _ in range(8):
        total = total @ total
    return total


def gains(rng: np.random.Generator, loop: Loop, size: float = 0.4) -> tuple[np.ndarray, np.ndarray]:
    """A random nominal control ``(m, K)`` and gains ``(K, K, m, d)`` that know the past only."""
    d, m = loop.B.shape
    K = loop.breakpoints.size - 1
    M = size * rng.normal(size=(K, K, m, d if loop.C is None else len(loop.C)))
    M[np.triu_indices(K, 1)] = 0.0
    return rng.uniform(-1, 1, size=(m, K)), M


SLOW = np.array([[0.0, 1.0], [-2.0, -0.3]])
FAST = np.array([[0.0, 5.0], [-5.0, -0.1]])
FORCE = np.array([[0.0], [1.0]])
GUST = np.array([[0.3, 0.0], [1.0, -0.5]])
TRIANGLE = Polytope(np.array([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]]), np.array([0.2, 0.1, 0.05]))
LOOPS = {
    "box": Loop(
        SLOW, FORCE, GUST, np.array([0.0, 0.5, 0.7, 1.5, 2.0]), np.array([0.0, 0.4, 1.0, 2.0]), np.array([-1.0, 0.5]),
        Box(np.array([-0.1, 0.0]), np.array([0.2, 0.1])),
    ),
    "ball and begun": Loop(
        SLOW, np.eye(2), GUST, np.linspace(0.0, 2.0, 4), np.linspace(0.0, 2.0, 4), np.array([-1.0, 0.5]),
        NormBall(p=2.0, radius=0.2, centre=np.array([0.1, 0.0])),
        Ellipsoid(np.zeros(2), np.array([[0.02, 0.01], [0.01, 0.03]])), c=np.array([0.1, -9.81]),
    ),
    "fast": Loop(
        FAST, FORCE, GUST, np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 2.0]), np.array([1.0, 0.0]), TRIANGLE,
        Box(np.array([-0.1, -0.05]), np.array([0.05, 0.1])),
    ),
    "outputs": Loop(
        SLOW, FORCE, GUST, np.array([0.0, 0.5, 1.25, 2.0]), np.array([0.0, 0.7, 2.0]), np.array([-1.0, 0.5]),
        Box(np.array([-0.1, 0.0]), np.array([0.2, 0.1])), Box(np.array([-0.1, -0.05]), np.array([0.05, 0.1])),
        C=np.array([[1.0, 0.5]]), noise=Box(np.array([-0.03]), np.array([0.05])),
        observer=np.array([[[0.5], [-0.25]], [[0.75], [0.125]], [[0.25], [1.0]]]),
    ),
    "begun": Loop(
        np.array([[0.0, 1.0], [0.0, 0.0]]), FORCE, FORCE, np.linspace(0.0, 2.0, 4), np.linspace(0.0, 2.0, 4),
        np.array([-1.0, 0.5]), None, TRIANGLE,
    ),
}  # fmt: skip
CHANGING = {
    "turning": Changing(
        SLOW, FORCE, GUST, np.array([0.0, 0.5, 0.7, 1.5, 2.0]), np.array([0.0, 0.4, 1.0, 2.0]), np.array([-1.0, 0.5]),
        Box(np.array([-0.1, 0.0]), np.array([0.2, 0.1])), c=np.array([0.1, -0.3]),
        rate="1 + t", grown="t + t^2/2", factor="cos(3*t)",
    ),
    "fading": Changing(
        SLOW, np.eye(2), GUST, np.linspace(0.0, 2.0, 3), np.linspace(0.0, 2.0, 3), np.array([-1.0, 0.5]),
        NormBall(p=2.0, radius=0.2, centre=np.array([0.1, 0.0])),
        Ellipsoid(np.zeros(2), np.array([[0.02, 0.01], [0.01, 0.03]])),
        rate="2*exp(-t)", grown="2 - 2*exp(-t)", factor="exp(-t)",
    ),
    "level": Changing(
        np.array([[0.0, 1.0], [0.0, 0.0]]), FORCE, FORCE, np.linspace(0.0, 2.0, 4), np.linspace(0.0, 2.0, 4),
        np.array([-1.0, 0.5]), None, TRIANGLE, rate="1 + 0*t", factor="1 + 0*t",
    ),
}  # fmt: skip
STILL = [*LOOPS]
LOOPS.update(CHANGING)
EXACT = [*STILL, "turning", pytest.param("fading", marks=pytest.mark.slow)]
