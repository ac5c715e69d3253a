"""Policies in purified outputs of a double integrator as one linear program, written without the package.

Purified outputs are what outputs have beyond those of the same control without disturbance and noise; the policies that
are affine in them are all that are affine in the outputs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import linprog


def flow(s: float) -> tuple[np.ndarray, np.ndarray]:
    """The transition over a time, and what a constant push makes of the state by then."""
    return np.array([[1.0, s], [0.0, 1.0]]), np.array([s * s / 2, s])


@dataclass
class OutputProgram:
    """``K`` pieces, outputs ``C x`` with noises within ``noise``, known ``late`` pieces later, rows at ``nodes`` times
    a piece. Variables: ``v``, ``|v|``, gains; then the absolute values of every row."""

    problem: dict[str, Any]
    K: int
    C: np.ndarray
    noise: float
    late: int
    nodes: int
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        p = len(self.C)
        self.h, self.Q = self.problem["horizon"] / self.K, self.K + self.K * p
        self.radii = np.append(np.full(self.K, self.problem["disturbance"]["box"]), np.full(self.K * p, self.noise))
        self.gains = [(k, j, o) for k in range(self.K) for j in range(k - self.late + 1) for o in range(p)]
        self.n = 2 * self.K + len(self.gains)
        self.seen = self._seen()
        self.controls = [self._control(k) for k in range(self.K)]

    def _seen(self) -> np.ndarray:
        """Purified outputs ``(K, p, Q)`` of one deviation each."""
        p = len(self.C)
        seen, x = np.zeros((self.K, p, self.Q)), np.zeros((2, self.Q))
        for j in range(self.K):
            seen[j] = self.C @ x
            seen[j][:, self.K + j * p : self.K + (j + 1) * p] += np.eye(p)
            Phi, Gamma = flow(self.h)
            x = Phi @ x
            x[:, j] += Gamma
        return seen

    def _control(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """``u_k``: what of it is nominal ``(n,)``, and answers to deviations ``(Q, n)``."""
        nominal, answers = np.zeros(self.n), np.zeros((self.Q, self.n))
        nominal[k] = 1.0
        for place, (piece, j, o) in enumerate(self.gains):
            if piece == k:
                answers[:, 2 * self.K + place] = self.seen[j, o]
        return nominal, answers

    def _state(self, t: float, c: np.ndarray, limit: float) -> None:
        """``c'x(t) <= limit`` for every deviation."""
        nominal, answers, given = np.zeros(self.n), np.zeros((self.Q, self.n)), np.zeros(self.Q)
        for k in range(self.K):
            length = min(self.h, t - k * self.h)
            if length > 1e-12:
                weight = float(c @ flow(t - k * self.h - length)[0] @ flow(length)[1])
                nominal, answers = nominal + weight * self.controls[k][0], answers + weight * self.controls[k][1]
                given[k] = weight
        self.rows.append((nominal, answers, given, limit - float(c @ flow(t)[0] @ self.problem["initial_state"])))

    def least(self) -> float:
        """The least integral of the nominal control's absolute values."""
        problem, end = self.problem, self.problem["horizon"]
        for t in (np.arange(1, self.K * self.nodes + 1) * (self.h / self.nodes)).tolist():
            box = (problem["path"] if t < end - 1e-9 else problem["terminal"])[0]["box"]
            for c in np.vstack([np.eye(2), -np.eye(2)]):
                self._state(t, c, float(np.abs(c) @ box))
        for nominal, answers in self.controls:
            self.rows += [(s * nominal, s * answers, np.zeros(self.Q), problem["control"]["box"]) for s in (1.0, -1.0)]
        return self._solved()

    def _solved(self) -> float:
        total, A, b = self.n + len(self.rows) * self.Q, list[np.ndarray](), list[float]()

        def add(limit: float, *entries: tuple[int, np.ndarray]) -> None:
            row = np.zeros(total)
            for start, values in entries:
                row[start : start + values.size] = values
            A.append(row)
            b.append(limit)

        for number, (nominal, answers, given, limit) in enumerate(self.rows):
            place = self.n + number * self.Q
            add(limit, (0, nominal), (place, self.radii))
            for q in np.flatnonzero(self.radii).tolist():
                for sign in (1.0, -1.0):
                    add(-sign * given[q], (0, sign * answers[q]), (place + q, np.array([-1.0])))
        for k in range(self.K):
            for sign in (1.0, -1.0):
                add(0.0, (k, np.array([sign])), (self.K + k, np.array([-1.0])))
        cost = np.zeros(total)
        cost[self.K : 2 * self.K] = self.h
        bounds = [(None, None)] * self.n + [(0, None)] * (total - self.n)
        found = linprog(cost, A_ub=np.array(A), b_ub=np.array(b), bounds=bounds)
        assert found.status == 0, found.message
        return float(found.fun)
