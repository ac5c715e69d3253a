"""Random plants with several unstable modes and controls, whose problems a regulator with a random reference solves.

The regulator is followed in doubles. Walls, ends and the control's bound are at least a tenth more than it needs, so
that a run that ends `infeasible`, or claims a bound above its cost, is wrong. What a claimed policy does is followed in
balls, under every vertex of the deviations; nothing of the package is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.linalg import block_diag, solve_discrete_are

import sparserob_core as sr
from tests.support.nodes import transition

BITS = 1200  # 360 digits: signs are lost at every piece, as gains of 1e4 multiply a growing state
INSIDE = 5  # parts of a piece at whose ends states are looked at
EXCUSED = 1e-9  # of the size of a row


@dataclass(frozen=True)
class Feasible:
    """A problem as the options of `sr.run`, and its arrays; ``known``: what a policy costs that keeps its constraints.
    Deviations are those of the initial state, within ``radii``, and of the disturbance, within ``noise``."""

    options: dict[str, Any]
    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    centre: np.ndarray
    radii: np.ndarray
    noise: float
    walls: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bound: float
    known: float


def feasible(number: int) -> Feasible:
    """Return the problem of a number: in open loop, tracked, pushed, or pushed from a box of initial states, in
    turns."""
    rng, kind = np.random.default_rng([98, number]), number % 4
    d, m, pieces = int(rng.integers(2, 7)), int(rng.integers(1, 3)), int(rng.choice([10, 20]))
    A, B, horizon, K = _controllable(rng, d, m, pieces, 18.0 if kind == 0 else 45.0)
    E = np.round(rng.normal(size=(d, kind // 2)), 2)
    noise = float(10.0 ** rng.uniform(-4.0, -1.5)) * (kind >= 2)
    centre = np.round(rng.uniform(-1.0, 1.0, size=d), 2)
    radii = np.round(rng.uniform(0.005, 0.05, size=d), 3) * (kind == 3)
    plant, start = (A, B, E, horizon / pieces), np.column_stack([centre, np.diag(radii)])
    nominal = 0.1 * rng.normal(size=(pieces, m)) * max(1.0, float(np.abs(K @ centre).max()))
    states, controls, final = _follow(plant, K, nominal, start, noise)
    walls = np.round(states * rng.uniform(1.1, 2.0, size=d) + 0.02, 3)
    walls[rng.uniform(size=d) < 0.3] = np.nan
    bound = float(np.round(controls.max() * rng.uniform(1.15, 2.5) + 0.01, 2))
    size = 1.3 * np.abs(final[:, 1:]).sum(axis=1) + 10.0 ** rng.uniform(-3.0, -0.7)
    low, high = final[:, 0] - size, final[:, 0] + size
    problem: dict[str, Any] = {
        "name": "linear",
        "system": {"A": A.tolist(), "B": B.tolist()},
        "horizon": horizon,
        "initial_state": {"centre": centre.tolist(), "box": radii.tolist()} if kind == 3 else centre.tolist(),
        "control": {"box": bound},
        "terminal": [{"box": {"lower": low.tolist(), "upper": high.tolist()}}],
    }
    if np.isfinite(walls).any():
        problem["path"] = [{"box": [None if np.isnan(wall) else wall for wall in walls.tolist()]}]
    if noise:
        problem["system"]["E"], problem["disturbance"] = E.tolist(), {"box": noise}
    options: dict[str, Any] = {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "limits": {"seconds": 60},
    }
    if kind:
        options["policy"] = {"name": "affine", "cost": "peak", "prestabilise": "auto", "causal_signals": 0}
    known = float(controls.sum()) * horizon / pieces
    return Feasible(options, A, B, E, centre, radii, noise, walls, low, high, bound, known)


def _controllable(
    rng: np.random.Generator, d: int, m: int, pieces: int, farthest: float
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Return a plant, its horizon, and the gain of a regulator that holds it by moderate controls."""
    while True:
        horizon = float(np.round(rng.uniform(1.0, 8.0), 2))
        rate = float(rng.uniform(5.0, farthest)) / horizon
        turn, growth = rng.uniform(0.2, 1.5), rng.uniform(-1.0, 0.6)
        turning = rate * np.array([[growth, turn], [-turn, growth]])
        modes = block_diag(rate, turning, np.diag(rng.uniform(-1.0, 0.6, size=5) * rate))[:d, :d]
        T = rng.normal(size=(d, d))
        A, B = np.round(T @ modes @ np.linalg.inv(T), 3), np.round(rng.normal(size=(d, m)), 2)
        Phi, Gamma = transition(A, B, horizon / pieces)
        try:
            P = solve_discrete_are(Phi, Gamma, np.eye(d), np.eye(m))
        except np.linalg.LinAlgError:
            continue
        K = -np.linalg.solve(np.eye(m) + Gamma.T @ P @ Gamma, Gamma.T @ P @ Phi)
        is_held = np.abs(np.linalg.eigvals(Phi + Gamma @ K)).max() < 0.97
        if is_held and np.linalg.cond(T) < 60.0 and np.abs(K).max() < 1e4:
            return A, B, horizon, K


def _follow(
    plant: tuple[np.ndarray, np.ndarray, np.ndarray, float],
    K: np.ndarray,
    nominal: np.ndarray,
    start: np.ndarray,
    noise: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the largest states ``(d,)``, the largest controls ``(pieces, m)``, and the final state with its answers
    to the deviations, under the regulator."""
    A, B, E, step = plant
    (d, mw), pieces = E.shape, len(nominal)
    (Phi, Gamma), Delta = transition(A, B, step / INSIDE), transition(A, E, step / INSIDE)[1]
    state = np.hstack([start, np.zeros((d, mw * pieces))])
    largest, controls = np.abs(state).sum(axis=1), np.zeros(nominal.shape)
    for k in range(pieces):
        u = K @ state
        u[:, 0] += nominal[k]
        controls[k] = np.abs(u).sum(axis=1)
        for _ in range(INSIDE):
            state = Phi @ state + Gamma @ u
            state[:, start.shape[1] + mw * k :][:, :mw] += noise * Delta
            largest = np.maximum(largest, np.abs(state).sum(axis=1))
    return largest, controls, state


def exceeded(problem: Feasible, outcome: sr.Outcome) -> float:
    """Return the largest violation of a claimed policy by its states and controls, as a share of what its row may
    excuse: above 1 it is false."""
    from flint import arb, arb_mat, ctx

    with ctx.workprec(BITS):
        stored = dict(np.load(outcome.directory / "solution.npz"))
        inner, gains, breakpoints = stored.get("prestabilise"), stored.get("gains"), stored["breakpoints"]
        decided = stored["control"] if inner is None else stored["theta"]
        (d, m), mw, pieces = problem.B.shape, problem.E.shape[1], decided.shape[1]
        inputs = np.hstack([problem.A, problem.B, problem.E])
        rates = arb_mat(np.vstack([inputs, np.zeros((m + mw, inputs.shape[1]))]).tolist())
        begun = np.zeros((d, 1 + d + mw * pieces))
        begun[:, : 1 + d] = np.column_stack([problem.centre, np.diag(problem.radii)])
        state, told = arb_mat(begun.tolist()), [arb_mat((begun * (np.arange(begun.shape[1]) > 0)).tolist())]
        excess, sizes = list[np.ndarray](), np.zeros(d)
        for k, (begin, end) in enumerate(pairwise(breakpoints.tolist())):
            flow = (rates * ((arb(end) - arb(begin)) / INSIDE)).exp().tolist()[:d]
            Phi, Gamma = arb_mat([row[:d] for row in flow]), arb_mat([row[d:] for row in flow])
            nominal, pushed = np.zeros((m, begun.shape[1])), np.zeros((m + mw, begun.shape[1]))
            nominal[:, 0], pushed[m:, 1 + d + mw * k :][:, :mw] = decided[:, k], problem.noise * np.eye(mw)
            u = arb_mat(nominal.tolist())
            for gain, innovation in zip([] if gains is None else gains[k], told, strict=False):
                u = u + arb_mat(gain.tolist()) * innovation
            u = u if inner is None else u + arb_mat(inner[k].tolist()) * state
            excess.append((np.abs(_span(u)).max(axis=0) - problem.bound) / problem.bound)
            happened = arb_mat(u.tolist() + arb_mat(pushed.tolist()).tolist()[m:])
            innovation = arb_mat(d, begun.shape[1])
            for _ in range(INSIDE):
                state = Phi * state + Gamma * happened
                innovation = Phi * innovation + Gamma * arb_mat(pushed.tolist())
                reached = np.abs(_span(state)).max(axis=0)
                sizes = np.maximum(sizes, reached)
                walled = np.isfinite(problem.walls)
                excess.append(((reached - problem.walls) / (2.0 * problem.walls))[walled])
            told.append(innovation)
        least, most = _span(state)
        ends = np.max([np.abs(problem.low), np.abs(problem.high), problem.high - problem.low, sizes], axis=0)
        excess.append(np.maximum(most - problem.high, problem.low - least) / ends)
        return float(max(each.max(initial=-1.0) for each in excess)) / EXCUSED


def _span(rows: Any) -> np.ndarray:
    """Return the least and the largest value of every row over the vertices of the deviations, ``(2, r)``."""
    middles = [row[0] for row in rows.tolist()]
    radii = [sum((abs(entry) for entry in row[1:]), 0) for row in rows.tolist()]
    return np.array(
        [[float((middle + sign * radius).mid()) for middle, radius in zip(middles, radii, strict=True)]
         for sign in (-1, 1)]
    )  # fmt: skip
