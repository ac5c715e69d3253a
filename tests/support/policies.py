"""Random problems whose control answers what it measures, and what is true of them: linear programs over a nominal
control and its answers, sampled on fine grids of time. Nothing of the package is used.

A policy acts through its effects: how the control on piece ``k`` depends on the disturbance of the pieces before it.
Where every disturbance of a piece can be told from the state at its end, they may be any numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array

from tests.support.instances import Flat, Instance, Units, config, drawn, drawn_units, sample

LARGER = 2.0  # times the disturbance that open loops are tested with
PER_PIECE = 8


@dataclass(frozen=True)
class Answered:
    """A problem, its units, what its policy is charged, and for how many pieces it answers (0: for ever)."""

    problem: Instance
    units: Units
    cost: str
    lag: int

    def config(self) -> dict[str, Any]:
        """In the user's units."""
        step = float(self.problem.edges[1] * self.units.time)
        policy = {"name": "affine", "cost": self.cost, "causal_signals": 4}
        memory = {"memory": self.lag * step} if self.lag else {}
        return {**config(self.problem, self.units), "policy": {**policy, **memory}}


def answered(number: int) -> Answered:
    """The instance of a number: a known system between flat sets under a box of disturbances, equal pieces."""
    rng = np.random.default_rng([number, 39])
    while True:
        problem = drawn(rng)
        K, shapes = len(problem.edges) - 1, [*problem.terminal, *(one for one, _, _ in problem.path), problem.control]
        plain = problem.dictionary == "piecewise_constant" and np.ptp(np.diff(problem.edges)) < 1e-12
        flat = all(isinstance(one, Flat) for one in shapes)
        if plain and flat and 4 <= K <= 8 and problem.ends_at is None and not problem.slopes and problem.terminal:
            break
    width = LARGER * rng.uniform(0.002, 0.05, problem.E.shape[1])
    problem = replace(problem, disturbance=Flat.box(width))
    cost, lag = str(rng.choice(["nominal", "peak"])), int(rng.choice([0, 0, 1, 3]))
    return Answered(problem, drawn_units(rng, problem), cost, lag)


class _Program:
    """A linear program that grows: variables with prices and bounds, sparse rows ``<=``."""

    def __init__(self) -> None:
        self.prices: list[float] = []
        self.bounds: list[tuple[float | None, float | None]] = []
        self.rows: list[tuple[np.ndarray, np.ndarray]] = []
        self.limits: list[float] = []

    def variables(self, count: int, price: float = 0.0, low: float | None = None) -> np.ndarray:
        first = len(self.prices)
        self.prices += [price] * count
        self.bounds += [(low, None)] * count
        return np.arange(first, first + count)

    def row(self, where: np.ndarray, values: np.ndarray, limit: float) -> None:
        self.rows.append((where, values))
        self.limits.append(limit)

    def sizes(self, where: np.ndarray, values: np.ndarray, constants: np.ndarray) -> np.ndarray:
        """New variables that are no less than ``|values_i x[where] + constants_i|``."""
        tops = self.variables(len(constants), low=0.0)
        for i, top in enumerate(tops):
            some = values[i] != 0.0
            for sign in (1.0, -1.0):
                self.row(np.append(where[some], top), np.append(sign * values[i][some], -1.0), -sign * constants[i])
        return tops

    def least(self) -> float:
        """The optimal value, ``inf`` where nothing is feasible."""
        number = np.repeat(np.arange(len(self.rows)), [len(where) for where, _ in self.rows])
        where, values = (np.concatenate([one[part] for one in self.rows]) for part in (0, 1))
        table = coo_array((values, (number, where)), shape=(len(self.rows), len(self.prices))).tocsr()
        done = linprog(self.prices, table, self.limits, bounds=self.bounds, method="highs")
        if done.status not in (0, 2):
            raise ArithmeticError(done.message)
        return float(done.fun) if done.status == 0 else np.inf


def truth_answered(one: Answered) -> tuple[float, float]:
    """Two values that enclose the optimal cost of affine policies: constraints at the samples alone, and with room for
    what lies between them."""
    some = sample(one.problem, PER_PIECE, np.zeros(0))
    lower = _sampled(one, some, False)
    return (lower, lower) if np.isinf(lower) else (lower, _sampled(one, some, True))


def _sampled(one: Answered, some: Any, tight: bool) -> float:
    policy, K = _Policy(one), len(one.problem.edges) - 1
    H, h, _ = one.problem.control.rows()
    for k, (c, b) in product(range(K), zip(H, h, strict=True)):
        policy.bounded(np.kron(c, np.eye(K)[k]), policy.still, float(b))
    end = one.problem.edges[-1]
    for shape, start, stop in [*one.problem.path, *((shape, end, end) for shape in one.problem.terminal)]:
        inside = np.flatnonzero((some.times >= start - 1e-12) & (some.times <= stop + 1e-12))
        room = 0.0 * some.sag
        if tight and start < end:  # with one more time on either side, the chords cover the whole window
            first, last = np.searchsorted(some.times, [start, stop], side="right")
            inside, room = np.arange(max(first - 1, 0), min(last + 1, len(some.times))), some.sag
        H, h, _ = shape.rows()
        for j, (c, b) in product(inside, zip(H, h, strict=True)):
            pushed = np.einsum("d,dqk->qk", c, some.noise[j])
            policy.bounded(c @ some.response[j], pushed, float(b - np.abs(c) @ room - c @ some.free[j]))
    return policy.charged(one.cost)


class _Policy:
    """A nominal control ``v (m K,)``, channel by channel, and effects ``F (K, m, K, q)``: of the control on piece ``k``
    of the disturbance on piece ``l`` before it; -1 where there is none."""

    def __init__(self, one: Answered) -> None:
        problem = self.problem = one.problem
        m, q, K = len(problem.weights), problem.E.shape[1], len(problem.edges) - 1
        assert problem.disturbance is not None
        self.half, self.still, self.program = problem.disturbance.support(np.eye(q)), np.zeros((q, K)), _Program()
        self.v, self.F = self.program.variables(m * K), np.full((K, m, K, q), -1)
        for k in range(K):
            oldest = max(0, k - 1 - one.lag) if one.lag else 0
            names = self.program.variables(m * (k - oldest) * q)
            self.F[k, :, oldest:k] = names.reshape(m, k - oldest, q)
        for i, side in zip(self.v, problem.sides.T, strict=True):
            self.program.bounds[i] = (-side[1], side[0])

    def bounded(self, on_v: np.ndarray, own: np.ndarray, limit: float, top: int | None = None) -> None:
        """``on_v'u + own'w <= limit`` for every disturbance, or no more than a variable."""
        m, K = self.F.shape[1:3]
        gains, where = on_v.reshape(m, K), np.flatnonzero(on_v)
        tops, widths = [], []
        for a, piece in product(*map(range, own.shape)):
            place = self.F[:, :, piece, a].T  # (m, K)
            used = (place >= 0) & (gains != 0.0)
            if used.any() or own[a, piece]:
                tops.append(self.program.sizes(place[used], gains[used][None], own[None, a, piece])[0])
                widths.append(self.half[a])
        more = [] if top is None else [top]
        at = np.concatenate([self.v[where], np.array([*tops, *more], dtype=int)])
        self.program.row(at, np.concatenate([on_v[where], widths, [-1.0] * len(more)]), limit)

    def charged(self, cost: str) -> float:
        """The least cost."""
        tops = self.program.variables(self.v.size, low=0.0)
        for i, (price, top) in enumerate(zip(self.problem.price, tops, strict=True)):
            self.program.prices[top] = float(price)
            for sign in (1.0, -1.0):
                if cost == "peak":
                    self.bounded(sign * np.eye(self.v.size)[i], self.still, 0.0, int(top))
                else:
                    self.program.row(np.array([self.v[i], top]), np.array([sign, -1.0]), 0.0)
        return self.program.least()
