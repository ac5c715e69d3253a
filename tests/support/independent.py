"""An independent answer: the robust program sampled on a fine time grid, by matrix exponentials and HiGHS; nothing of
the package is used.

For a known system with box sets. Between two of its times a trajectory departs from the chord by at most ``step^2 / 8``
times its curvature, so imposing the path constraints at the fine times only, and imposing them there with that much to
spare, encloses the value.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog


@dataclass(frozen=True)
class Problem:
    """``x' = A x + B u + w`` in boxes: ``|u| <= control``, ``|w| <= disturbance``, ``|x| <= half_width`` in windows and
    at the end."""

    A: np.ndarray
    B: np.ndarray
    initial_state: np.ndarray
    horizon: float
    pieces: int
    control: np.ndarray
    weights: np.ndarray
    disturbance: np.ndarray
    terminal: np.ndarray
    path: list[tuple[np.ndarray, float, float]] = field(default_factory=list)

    def config(self) -> dict:
        """The same problem as a config of the package."""

        def box(values):
            return {"box": [float(v) if np.isfinite(v) else None for v in values]}

        return {
            "problem": {
                "name": "linear",
                "system": {"A": self.A.tolist(), "B": self.B.tolist()},
                "horizon": self.horizon,
                "initial_state": self.initial_state.tolist(),
                "control": box(self.control),
                "weights": self.weights.tolist(),
                "disturbance": box(self.disturbance) if self.disturbance.any() else None,
                "path": [{**box(width), "from": start, "to": stop} for width, start, stop in self.path],
                "terminal": [box(self.terminal)],
            },
            "dictionaries": {"control": {"name": "piecewise_constant", "pieces": self.pieces}},
        }


@dataclass(frozen=True)
class Sampled:
    """At the fine times ``(J,)``: the state without control ``(J, d)``, its response to the pieces ``(J, d, m K)``, the
    worst deviation ``(J, d)``, and how far the state may leave its chords ``(d,)``."""

    times: np.ndarray
    free: np.ndarray
    response: np.ndarray
    deviation: np.ndarray
    sag: np.ndarray


def sample(problem: Problem, per_piece: int) -> Sampled:
    """Step through the fine grid with the exact discretisation of one step."""
    A, d, m, K = problem.A, len(problem.A), problem.B.shape[1], problem.pieces
    step = problem.horizon / (K * per_piece)
    big = expm(step * np.block([[A, problem.B, np.eye(d)], [np.zeros((m + d, d + m + d))]]))
    Ad, Bd, Ed = big[:d, :d], big[:d, d : d + m], big[:d, d + m :]
    count = K * per_piece + 1
    free, response = np.zeros((count, d)), np.zeros((count, d, m * K))
    noise, deviation = np.zeros((d, d * K)), np.zeros((count, d))
    free[0] = problem.initial_state
    for j in range(count - 1):
        piece = j // per_piece
        free[j + 1] = Ad @ free[j]
        response[j + 1] = Ad @ response[j]
        response[j + 1][:, piece::K] += Bd
        noise = Ad @ noise
        noise[:, piece::K] += Ed
        deviation[j + 1] = np.abs(noise) @ np.repeat(problem.disturbance, K)
    farthest = np.abs(free) + np.abs(response) @ np.repeat(problem.control, K) + deviation
    inputs = np.abs(problem.B) @ problem.control + problem.disturbance
    curvature = np.abs(A @ A) @ farthest.max(axis=0) + np.abs(A) @ inputs
    return Sampled(step * np.arange(count), free, response, deviation, curvature * step**2 / 8)


def gridded(problem: Problem, sampled: Sampled, spare: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows ``G u <= h`` of the path constraints ``(r, m K)`` with ``spare`` times the sag to spare, and the time
    ``(r,)`` of each."""
    rows, bounds, times = [], [], []
    for width, start, stop in problem.path:
        # with one more time on either side, the chords cover the whole window
        beyond = 1e-12 + spare * sampled.times[1]
        inside = (sampled.times >= start - beyond) & (sampled.times <= stop + beyond)
        for i in np.flatnonzero(np.isfinite(width)):
            room = width[i] - sampled.deviation[inside, i] - spare * sampled.sag[i]
            rows += [sampled.response[inside, i], -sampled.response[inside, i]]
            bounds += [room - sampled.free[inside, i], room + sampled.free[inside, i]]
            times += [sampled.times[inside]] * 2
    if not rows:
        return np.empty((0, sampled.response.shape[2])), np.empty(0), np.empty(0)
    return np.concatenate(rows), np.concatenate(bounds), np.concatenate(times)


def terminal_rows(problem: Problem, sampled: Sampled) -> tuple[np.ndarray, np.ndarray]:
    """Rows ``G u <= h`` of the terminal box."""
    room = problem.terminal - sampled.deviation[-1]
    G, h = (
        np.concatenate([sampled.response[-1], -sampled.response[-1]]),
        np.concatenate([room - sampled.free[-1], room + sampled.free[-1]]),
    )
    return G[np.isfinite(h)], h[np.isfinite(h)]


def cost(problem: Problem) -> np.ndarray:
    """The price ``(m K,)`` of ``|u|`` on every piece."""
    return np.repeat(problem.weights, problem.pieces) * problem.horizon / problem.pieces


def value(problem: Problem, sampled: Sampled, spare: float = 0.0) -> float:
    """The optimal cost, ``inf`` when infeasible; rows are added where the optimiser violates them, worst of each
    stretch first."""
    price, bound = cost(problem), np.repeat(problem.control, problem.pieces)
    G, h, _ = gridded(problem, sampled, spare)
    rows, limits = terminal_rows(problem, sampled)
    used = np.zeros(len(h), dtype=bool)
    for _ in range(100):
        both = np.concatenate([rows, G[used]])
        answer = linprog(
            np.concatenate([price, price]),
            np.hstack([both, -both]),
            np.concatenate([limits, h[used]]),
            bounds=np.stack([np.zeros(2 * bound.size), np.tile(bound, 2)], axis=1),
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if answer.status == 2:
            return np.inf
        excess = G @ (answer.x[: bound.size] - answer.x[bound.size :]) - h
        peaks = (excess > 1e-9) & (excess >= np.roll(excess, 1)) & (excess >= np.roll(excess, -1))
        if not (peaks & ~used).any():
            return float(answer.fun)
        used |= peaks
    raise AssertionError("the independent program did not end")


def enclosed_value(problem: Problem, per_piece: int = 64) -> tuple[float, float]:
    """Two values that enclose the optimal cost over all times."""
    sampled = sample(problem, per_piece)
    return value(problem, sampled), value(problem, sampled, spare=1.0)


def random_problem(seed: int) -> Problem:
    """A double integrator, an oscillator, or a spring-mass-damper, or two coupled masses with two controls, at
    random."""
    rng = np.random.default_rng(seed)
    kind = seed % 4
    stiffness, damping = [
        (0.0, 0.0),
        (rng.uniform(0.5, 2), 0.0),
        (rng.uniform(1, 3), rng.uniform(0.2, 0.8)),
        (1.0, 0.1),
    ][kind]
    if kind < 3:
        A, B = np.array([[0.0, 1.0], [-stiffness, -damping]]), np.array([[0.0], [1.0]])
    else:
        A = np.array([[0, 1, 0, 0], [-2, -damping, 1, 0], [0, 0, 0, 1], [1, 0, -2, -damping]])
        B = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    d, m = B.shape
    horizon = float(np.round(rng.uniform(3, 6), 2))
    start = float(np.round(0.5 * horizon, 2))
    reach = 2.0 if kind in (1, 2) else 1.2
    width = np.where(np.arange(d) % 2 == 0, rng.uniform(0.5, 0.8), np.inf)
    return Problem(
        A=A,
        B=B,
        initial_state=np.round(rng.uniform(-reach, reach, d), 2),
        horizon=horizon,
        pieces=int(rng.integers(15, 30)),
        control=np.round(rng.uniform(0.9, 1.6, m), 2),
        weights=np.round(rng.uniform(0.5, 2, m), 2),
        disturbance=np.round(rng.uniform(0.0, 0.04, d), 3),
        terminal=np.round(rng.uniform(0.3, 0.6, d), 2),
        path=[(np.round(width, 2), start, horizon)],
    )


def worst_violation(problem: Problem, control: np.ndarray, per_piece: int = 32) -> float:
    """By how much the control ``(m, K)`` violates a path or terminal constraint at a fine time, under the worst
    disturbance."""
    A, d, m, K = problem.A, len(problem.A), problem.B.shape[1], problem.pieces
    step = problem.horizon / (K * per_piece)
    big = expm(step * np.block([[A, problem.B, np.eye(d)], [np.zeros((m + d, d + m + d))]]))
    Ad, Bd, Ed = big[:d, :d], big[:d, d : d + m], big[:d, d + m :]
    state, noise, bounds, worst = (
        problem.initial_state.copy(),
        np.zeros((d, d * K)),
        np.repeat(problem.disturbance, K),
        -np.inf,
    )
    for j in range(K * per_piece):
        state = Ad @ state + Bd @ control[:, j // per_piece]
        noise = Ad @ noise
        noise[:, j // per_piece :: K] += Ed
        extent = np.abs(state) + np.abs(noise) @ bounds
        for width, start, stop in problem.path:
            if start - 1e-12 <= (j + 1) * step <= stop + 1e-12:
                worst = max(worst, float((extent - width).max()))
    return max(worst, float((extent - problem.terminal).max()))
