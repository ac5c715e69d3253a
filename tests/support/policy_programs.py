"""Affine policies of small systems under boxes as one linear program, written without the package: rows at given times,
absolute values by two rows each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.sparse import coo_array, csr_array


@dataclass
class PolicyProgram:
    """``x' = A x + B u + E w``, ``K`` pieces of control and disturbance, ``|w_i| <= width_i``, ``|x(0) - x0|_i <=
    begun_i``; ``u_k = v_k + F_k z``, where ``F_k`` knows the initial state and the disturbances of earlier pieces.

    What is affine in the variables and in the deviations ``z (Q,)`` is an array ``(1 + Q, 1 + n)``: the nominal and the
    answers to each deviation, each a number and coefficients of the variables.
    """

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    x0: np.ndarray
    horizon: float
    K: int
    width: np.ndarray
    begun: np.ndarray
    rows: list[tuple[dict[int, float], float]] = field(default_factory=list)
    fixed: list[tuple[np.ndarray, float]] = field(default_factory=list)
    more: int = 0

    def __post_init__(self) -> None:
        m, mw, d = self.B.shape[1], self.E.shape[1], self.x0.size
        self.radii = np.concatenate([np.tile(self.width, self.K), self.begun])
        self.known_from = np.concatenate([np.repeat(np.arange(1, self.K + 1), mw), np.zeros(d, dtype=int)])
        names = [(k, i, q) for k in range(self.K) for i in range(m) for q in np.flatnonzero(self.known_from <= k)]
        self.place = {name: 2 * m * self.K + n for n, name in enumerate(names)}
        self.n = 2 * m * self.K + len(names)

    def control(self, k: int) -> np.ndarray:
        """``u_k``, ``(m, 1 + Q, 1 + n)``."""
        u = np.zeros((self.B.shape[1], 1 + self.radii.size, 1 + self.n))
        for i in range(len(u)):
            u[i, 0, 1 + i * self.K + k] = 1.0
            for q in np.flatnonzero(self.known_from <= k):
                u[i, 1 + q, 1 + self.place[k, i, int(q)]] = 1.0
        return u

    def state(self, t: float) -> np.ndarray:
        """``x(t)``, ``(d, 1 + Q, 1 + n)``."""
        d, mw, h = self.x0.size, self.E.shape[1], self.horizon / self.K
        x = np.zeros((d, 1 + self.radii.size, 1 + self.n))
        x[:, 0, 0] = self.x0
        x[:, 1 + self.K * mw :, 0] = np.eye(d)
        for k in range(self.K):
            length = min(h, t - k * h)
            if length <= 1e-12:
                break
            both = expm(np.block([[self.A, np.eye(d)], [np.zeros((d, 2 * d))]]) * length)
            drive = np.tensordot(self.B, self.control(k), 1)
            drive[:, 1 + k * mw : 1 + (k + 1) * mw, 0] += self.E
            x = np.tensordot(both[:d, :d], x, 1) + np.tensordot(both[:d, d:], drive, 1)
        return x

    def below(self, what: np.ndarray, limit: float, less: dict[int, float] | None = None) -> None:
        """``what (1 + Q, 1 + n)`` is at most ``limit``, whatever happens; ``less``: variables that are taken off."""
        row = {int(c): float(what[0, 1 + c]) for c in np.flatnonzero(what[0, 1:])}
        row |= {c: -value for c, value in (less or {}).items()}
        for q in np.flatnonzero(np.abs(what[1:]).any(axis=1) & (self.radii > 0.0)):
            size = self.n + self.more
            self.more += 1
            row[size] = float(self.radii[q])
            for sign in (1.0, -1.0):
                inner = {int(c): sign * float(what[1 + q, 1 + c]) for c in np.flatnonzero(what[1 + q, 1:])}
                self.rows.append(({**inner, size: -1.0}, -sign * float(what[1 + q, 0])))
        self.rows.append((row, limit - float(what[0, 0])))

    def equal(self, what: np.ndarray, value: float) -> None:
        """``what (1 + Q, 1 + n)`` is ``value``, whatever happens."""
        self.fixed.append((what[0, 1:], value - float(what[0, 0])))
        self.fixed += [(what[1 + q, 1:], -float(what[1 + q, 0])) for q in np.flatnonzero(self.radii > 0.0)]

    def within(self, bound: float) -> None:
        """``|u_i| <= bound``, whatever happens."""
        for k in range(self.K):
            for u in self.control(k):
                for sign in (1.0, -1.0):
                    self.below(sign * u, bound)

    @property
    def table(self) -> tuple[csr_array, np.ndarray]:
        """All rows ``table x <= limits`` of the variables, with those that absolute values need beside them."""
        entries = [(r, c, v) for r, (row, _) in enumerate(self.rows) for c, v in row.items()]
        r, c, v = (np.array(part) for part in zip(*entries, strict=True))
        shape = (len(self.rows), self.n + self.more)
        return coo_array((v, (r.astype(int), c.astype(int))), shape=shape).tocsr(), np.array([b for _, b in self.rows])

    def solve(self, bound: float, cost: str) -> float:
        """The least cost with ``|u_i| <= bound``; infinite where nothing is feasible."""
        m, K = self.B.shape[1], self.K
        self.within(bound)
        for k in range(K):
            u = self.control(k)
            for i in range(m):
                price = m * K + i * K + k
                for sign in (1.0, -1.0):
                    priced = sign * u[i] if cost == "peak" else sign * u[i] * (np.arange(len(u[i])) == 0)[:, None]
                    self.below(priced, 0.0, {price: 1.0})
        table, limits = self.table
        objective = np.zeros(table.shape[1])
        objective[m * K : 2 * m * K] = self.horizon / K
        equalities = {} if not self.fixed else {
            "A_eq": csr_array(np.array([np.pad(row, (0, self.more)) for row, _ in self.fixed])),
            "b_eq": [value for _, value in self.fixed],
        }  # fmt: skip
        found = linprog(objective, table, limits, bounds=(None, None), method="highs-ds", **equalities)
        return float(found.fun) if found.status == 0 else np.inf
