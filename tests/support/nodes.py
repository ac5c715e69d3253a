"""Multiple shooting: the states at the ends of pieces are variables, between which nothing grows by much (Bock and
Plitt 1984). A reference for plants that amplify, by HiGHS, which proves nothing between its nodes."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.sparse import csr_array

CONFIGS = Path(__file__).parents[2] / "configs"


class Shot(NamedTuple):
    """The least cost, and the control ``(m, K)`` of it."""

    cost: float
    control: np.ndarray


def at_nodes(config: str, parts: int) -> Shot:
    """Solve a shipped config with a box for a path, a fixed end and ``int |u|``; walls hold at ``parts`` times of every
    piece."""
    options = yaml.safe_load((CONFIGS / f"{config}.yaml").read_text())
    problem, pieces = options["problem"], options["dictionaries"]["control"]["pieces"]
    A, B = (np.array(problem["system"][name], dtype=float) for name in ("A", "B"))
    (d, m), step = B.shape, problem["horizon"] / pieces
    generator = np.zeros((d + m, d + m))
    generator[:d] = np.hstack([A, B])
    flows = [expm(generator * step * number / parts)[:d] for number in range(1, parts + 1)]
    walls = np.array([np.inf if entry is None else entry for entry in problem["path"][0]["box"]])
    walled = np.isfinite(walls)
    size = np.where(walled, walls, 1.0)  # states in units of their walls
    inputs, n = 2 * m * pieces, 2 * m * pieces + d * (pieces + 1)
    rows, between = [], []
    for k in range(pieces):
        for number, flow in enumerate(flows, start=1):
            row = np.zeros((d, n))
            row[:, inputs + d * k : inputs + d * (k + 1)] = flow[:, :d] * size / size[:, None]
            row[:, 2 * m * k : 2 * m * k + m] = flow[:, d:] / size[:, None]
            row[:, 2 * m * k + m : 2 * m * (k + 1)] = -flow[:, d:] / size[:, None]
            if number < parts:
                between += [row[walled], -row[walled]]
                continue
            row[:, inputs + d * (k + 1) : inputs + d * (k + 2)] -= np.eye(d)
            rows.append(row)
    fixed = {0: problem["initial_state"], pieces: problem["terminal"][0]["equals"]}
    bounds = [(0.0, problem["control"]["box"])] * inputs
    for k in range(pieces + 1):
        free = [(-1.0, 1.0) if wall else (None, None) for wall in walled]
        bounds += [(value, value) for value in np.array(fixed[k]) / size] if k in fixed else free
    stacked = np.vstack([np.zeros((0, n)), *between])
    accuracy = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = linprog(
        np.concatenate([np.full(inputs, step), np.zeros(n - inputs)]),
        A_ub=csr_array(stacked),
        b_ub=np.ones(len(stacked)),
        A_eq=csr_array(np.vstack(rows)),
        b_eq=np.zeros(d * pieces),
        bounds=bounds,
        method="highs-ds",
        options=accuracy,
    )
    assert found.status == 0, found.message
    halves = found.x[:inputs].reshape(pieces, 2, m)
    return Shot(float(found.fun), np.ascontiguousarray((halves[:, 0] - halves[:, 1]).T))
