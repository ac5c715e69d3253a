"""Random plants that amplify by up to ``e^40`` over their horizon, and what claimed controls do to them in 60 digits.

Nothing is shared with the package but the numbers that a run writes: transitions are exponentials of ball matrices at
`BITS` bits, the state is an affine function of the disturbances on every piece, and the worst of it is a sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

import sparserob_core as sr

BITS = 256  # 77 digits: of a growth of e^60 50 are left
INSIDE = 4  # parts of a piece at whose ends the state is looked at
EXCUSED = 1e-9  # of the size of a row


@dataclass(frozen=True)
class Amplified:
    """A drawn problem as the options of `sr.run`, with what the check of its answer needs: ``A``, ``B``, ``E``, how
    many ``pieces``, the ``rows`` ``(H, h, from)`` of every constraint, and the ``fixed`` final state, if any."""

    options: dict[str, Any]
    A: np.ndarray
    B: np.ndarray
    E: np.ndarray | None
    bound: float
    rows: list[tuple[np.ndarray, np.ndarray, float]]
    fixed: np.ndarray | None
    exponent: float


def drawn(number: int) -> Amplified:
    """Return the problem of a number: every third answers what it measures, every second ends in a fixed state."""
    return _draw(number, np.random.default_rng([41, number]), 3, (3.0, 40.0))


def drawn_far(number: int) -> Amplified:
    """Return a problem as `drawn` does, with up to 5 states, that grows by ``e^40`` to ``e^60``."""
    return _draw(number, np.random.default_rng([43, number]), 5, (40.0, 60.0))


def _draw(number: int, rng: np.random.Generator, states: int, exponents: tuple[float, float]) -> Amplified:
    d, pieces = int(rng.integers(1, 1 + states)), int(rng.choice([10, 20, 40]))
    exponent, horizon = float(rng.uniform(*exponents)), float(rng.uniform(1.0, 8.0))
    feedback, ends_fixed = number % 3 == 0, number % 2 == 0
    T = rng.normal(size=(d, d)) + 2.0 * np.eye(d)
    rates = np.concatenate([[exponent / horizon], rng.uniform(-3.0, 0.5, size=d - 1) * exponent / horizon / 3.0])
    A = np.round(T @ np.diag(rates) @ np.linalg.inv(T), 3)
    B = np.round(rng.normal(size=(d, 1)), 2) + 0.5
    x0 = np.round(rng.uniform(-1.0, 1.0, size=d), 2)
    x0[0] += 0.3
    left = np.linalg.solve(T.T, np.eye(d)[0])  # of the unstable mode, about
    needed = abs(left @ x0) * rates[0] / max(abs(float(left @ B[:, 0])), 0.1)
    reach = float(np.round(4.0 * needed + 1.0, 1))
    wall = np.round(np.abs(x0) * rng.uniform(1.3, 3.0) + 0.5, 2)
    noise = float(10.0 ** rng.uniform(-6, -2)) if feedback and not ends_fixed else 0.0
    E = np.eye(d) if noise else None
    problem: dict[str, Any] = {
        "name": "linear",
        "system": {"A": A.tolist(), "B": B.tolist()},
        "horizon": horizon,
        "initial_state": x0.tolist(),
        "control": {"box": reach},
        "path": [{"box": wall.tolist()}],
    }
    rows = [(np.vstack([np.eye(d), -np.eye(d)]), np.concatenate([wall, wall]), 0.0)]
    end, fixed = np.round(rng.uniform(-0.3, 0.3, size=d), 2), None
    if ends_fixed:
        fixed = end * (rng.uniform(size=d) < 0.7)
        problem["terminal"] = [{"equals": fixed.tolist()}]
    else:
        size = float(10.0 ** rng.uniform(-4, -0.5))
        problem["terminal"] = [{"box": {"lower": (end - size).tolist(), "upper": (end + size).tolist()}}]
        rows.append((np.vstack([np.eye(d), -np.eye(d)]), np.concatenate([end + size, size - end]), horizon))
    if noise:
        problem["disturbance"] = {"box": [noise] * d}
    options: dict[str, Any] = {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "limits": {"seconds": 20},
    }
    if feedback:
        options["policy"] = {"name": "affine"}
    return Amplified(options, A, B, E, noise, rows, fixed, exponent)


def exceeded(problem: Amplified, outcome: sr.Outcome) -> float:
    """Return the largest violation of a claimed control, as a share of what its row may excuse: above 1 it is false.

    What a row may excuse is `EXCUSED` times the largest of its bound, its width, and what it does along the nominal
    trajectory.
    """
    from flint import arb_mat, ctx

    with ctx.workprec(BITS):
        solution = dict(np.load(outcome.directory / "solution.npz"))
        breakpoints, gains, inner = solution["breakpoints"], solution.get("gains"), solution.get("prestabilise")
        control = solution["control"] if inner is None else solution["theta"]
        d, K = len(problem.A), control.shape[1]
        mw = 0 if problem.E is None else problem.E.shape[1]
        steps = [_step(problem, (b - a) / INSIDE) for a, b in pairwise(breakpoints)]
        state = _columns(np.asarray(problem.options["problem"]["initial_state"])[:, None], 1 + K * mw)
        seen, innovations, times = [state], list[Any](), [0.0]
        for k, (Phi, Gamma, Delta) in enumerate(steps):
            u = _columns(control[:, k : k + 1], 1 + K * mw)
            for j, innovation in enumerate(innovations):
                if gains is not None:
                    u = u + arb_mat(gains[k, j + 1].tolist()) * innovation
            if inner is not None:
                u = u + arb_mat(inner[k].tolist()) * state
            pushed = arb_mat(d, 1 + K * mw)
            if Delta is not None:
                chosen = arb_mat(
                    mw, 1 + K * mw, [float(c == 1 + k * mw + i) for i in range(mw) for c in range(1 + K * mw)]
                )
                pushed = Delta * chosen
            innovation = arb_mat(d, 1 + K * mw)
            for part in range(INSIDE):
                state = Phi * state + Gamma * u + pushed
                innovation = Phi * innovation + pushed
                seen.append(state)
                times.append(float(breakpoints[k] + (breakpoints[k + 1] - breakpoints[k]) * (part + 1) / INSIDE))
            innovations.append(innovation)
        times[-1] = float(breakpoints[-1])
        return _worst(problem, seen, np.array(times))


def _worst(problem: Amplified, seen: list[Any], times: np.ndarray) -> float:
    from flint import arb_mat

    d, worst = len(problem.A), 0.0
    nominal = np.array([[float(row[0].mid()) for row in state.tolist()] for state in seen])  # (times, d)
    for H, h, start in problem.rows:
        opposite = h[: len(h) // 2] + h[len(h) // 2 :]
        sizes = np.max([np.abs(h), np.tile(opposite, 2), np.abs(nominal @ H.T).max(axis=0)], axis=0)
        for state, time in zip(seen, times, strict=True):
            if time < start:
                continue
            along = (arb_mat(H.tolist()) * state).tolist()
            for row, limit, size in zip(along, h.tolist(), sizes.tolist(), strict=True):
                most = row[0] - limit
                for entry in row[1:]:
                    most = most + abs(entry) * problem.bound
                worst = max(worst, float(most.mid()) / (EXCUSED * size))
    if problem.fixed is not None:
        sizes = np.maximum(np.abs(problem.fixed), np.abs(nominal).max(axis=0))
        for i in range(d):
            row = seen[-1].tolist()[i]
            off = abs(row[0] - float(problem.fixed[i]))
            worst = max(worst, float(off.mid()) / (EXCUSED * sizes[i]))
    return worst


def _columns(first: np.ndarray, count: int) -> Any:
    """A matrix with this first column, and zeros beside it."""
    from flint import arb_mat

    rows = [[float(value), *[0.0] * (count - 1)] for value in first[:, 0]]
    return arb_mat(rows)


def _step(problem: Amplified, length: float) -> tuple[Any, Any, Any]:
    """What a time makes of a state, a control and a disturbance."""
    from flint import arb, arb_mat

    inputs = problem.B if problem.E is None else np.hstack([problem.B, problem.E])
    d, m = problem.B.shape
    size = d + inputs.shape[1]
    whole = np.zeros((size, size))
    whole[:d, :d], whole[:d, d:] = problem.A, inputs
    rows = (arb_mat(whole.tolist()) * arb(length)).exp().tolist()
    Phi = arb_mat([row[:d] for row in rows[:d]])
    Gamma = arb_mat([row[d : d + m] for row in rows[:d]])
    return Phi, Gamma, None if problem.E is None else arb_mat([row[d + m :] for row in rows[:d]])
