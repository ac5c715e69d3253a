"""Problems of ordinary kinds, drawn at random, whose worst case rides on its wall: heated houses, tanks in a row,
vehicles in corridors, along walls that rest, slope, move with bends or are curved.

The cheapest control rides the wall by construction: a house and a tank lose what holds them, a vehicle drifts or the
corridor moves away from it. In each there is room for a control that keeps away.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

WALLS = ("resting", "sloped", "bent", "curved", "curved and bent")
SEED = 25_000  # of the first problem


class Ridden(NamedTuple):
    """A config, and what was drawn, in words."""

    said: str
    config: dict[str, Any]


class _Kind(NamedTuple):
    """A system, written with its parameter ``p``, and the sizes that belong to it: of states, walls and bounds."""

    A: list[list[str]]
    B: np.ndarray
    E: np.ndarray
    drifts: tuple[list[str], list[str]] | None
    parameter: list[float]
    start: np.ndarray
    control: dict[str, Any]
    disturbance: list[float]
    watched: int
    room: float
    swing: float
    radius: float
    step: float
    held: list[float]


def unseen(seed: int) -> Ridden:
    """The problem with this number; equal numbers give equal problems."""
    rng = np.random.default_rng(SEED + seed)
    wall, name = WALLS[rng.integers(len(WALLS))], ("house", "tanks", "vehicle")[seed % 3]
    feedback = bool(rng.random() < 0.2) and not wall.startswith("curved")
    uncertain, drift, delay, spread, legs, step = rng.random(6) < (0.5 * (not feedback), 0.5, 0.25, 0.4, 0.25, 0.3)
    pieces = int(rng.choice([10, 12, 16, 24] if feedback else [12, 16, 24, 32, 48, 64]))
    horizon = float(rng.choice([4, 6, 8, 12, 24]))
    method = "exchange" if feedback else str(rng.choice(["exchange", "sparsest", "reweighted"], p=[0.8, 0.1, 0.1]))
    control = str(rng.choice(["piecewise_constant", "haar", "walsh"], p=[0.8, 0.1, 0.1]))
    if method != "exchange" or delay or step:
        control = "piecewise_constant"
    pieces = pieces if control == "piecewise_constant" else 16
    kind = {"house": _house, "tanks": _tanks, "vehicle": _vehicle}[name](rng, bool(uncertain), bool(drift))
    horizon = min(horizon, 6.0) if name == "vehicle" else horizon

    size = len(kind.A)
    system: dict[str, Any] = {"A": kind.A, "B": kind.B.tolist(), "E": kind.E.tolist()}
    if kind.drifts is not None and legs:
        change = round(horizon * rng.uniform(0.3, 0.7), 2)
        ends = zip((change, horizon), kind.drifts, strict=True)
        system = {"pieces": [{"until": until, **system, "c": drift} for until, drift in ends]}
    elif kind.drifts is not None:
        system["c"] = kind.drifts[0]
    if uncertain:
        system["parameters"] = {"p": kind.parameter}
    problem = {
        "name": "linear",
        "system": system,
        "horizon": horizon,
        "initial_state": {"centre": kind.start.tolist(), "box": [kind.step / 100] * size}
        if spread
        else kind.start.tolist(),
        "control": {"box": kind.control},
        "disturbance": {"box": kind.disturbance},
        "path": _walls(rng, wall, kind, horizon, name),
    }
    if delay:
        system["delay"] = round(horizon / pieces * rng.uniform(0.2, 1.6), 3)
        problem["initial_control"] = kind.held
    if step:
        problem["control_step"] = {"box": kind.step}
    config: dict[str, Any] = {
        "problem": problem,
        "dictionaries": {"control": _functions(control, pieces)},
        "method": {"name": method},
        "observers": [],
    }
    if feedback:
        config["policy"] = {"name": "affine"}
    else:
        config["dictionaries"]["disturbance"] = _functions("piecewise_constant", pieces)
    flags = zip(
        ("feedback", "parameters", "drift", "delay", "initial set", "legs", "steps"),
        (feedback, uncertain, kind.drifts is not None, delay, spread, "pieces" in system, step),
        strict=True,
    )
    drawn = [flag for flag, there in flags if there]
    return Ridden(f"{name}, {wall}, {', '.join(drawn)}; {method}, {control} {pieces}, {size} states", config)


def _functions(name: str, pieces: int) -> dict[str, Any]:
    return {"name": name, "pieces": pieces}


def _house(rng: np.random.Generator, uncertain: bool, drift: bool) -> _Kind:
    """Heated rooms, side by side, and sometimes a heavy wall; outside it is cold."""
    rooms = int(rng.integers(1, 4))
    size = rooms + int(rng.random() < 0.6)
    capacity, loss = rng.uniform(0.4, 1.5, size), rng.uniform(0.06, 0.14, size)
    capacity[rooms:] = rng.uniform(4, 8, size - rooms)
    between = np.triu(rng.uniform(0.1, 0.5, (size, size)), 1)
    between = between + between.T
    lost = ["p" if uncertain and i == 0 else f"{loss[i]:.4f}" for i in range(size)]
    outside = rng.uniform(-4, 5)
    warmer = outside + rng.uniform(1, 6)
    drifts = tuple([f"{lost[i]}*({t:.3f})/{capacity[i]:.4f}" for i in range(size)] for t in (outside, warmer))
    return _Kind(
        [
            [
                f"-({lost[i]}+{between[i].sum():.4f})/{capacity[i]:.4f}"
                if i == j
                else f"{between[i, j] / capacity[i]:.5f}"
                for j in range(size)
            ]
            for i in range(size)
        ],
        np.diag(1.0 / capacity)[:, :rooms],
        (loss / capacity)[:, None],
        (drifts[0], drifts[1]),
        [0.9 * float(loss[0]), 1.1 * float(loss[0])],
        np.full(size, 19.0),
        {"lower": 0.0, "upper": 8.0},
        [float(rng.uniform(0.3, 1.0))],
        rooms,
        0.6,
        1.6,
        0.8,
        4.0,
        [float(one * (19 - outside)) for one in loss[:rooms]],
    )


def _tanks(rng: np.random.Generator, uncertain: bool, drift: bool) -> _Kind:
    """Tanks of which each flows into the next, filled one by one; what is drawn from them is uncertain."""
    size = int(rng.integers(1, 5))
    flow = rng.uniform(0.15, 0.5, size)
    drained = ["p" if uncertain and i == 0 else f"{flow[i]:.4f}" for i in range(size)]
    return _Kind(
        [[f"-{drained[i]}" if i == j else drained[j] if j == i - 1 else "0" for j in range(size)] for i in range(size)],
        np.diag(rng.uniform(0.5, 1.0, size)),
        -np.eye(size),
        (["-0.05"] * size, ["-0.08"] * size) if drift else None,
        [0.96 * float(flow[0]), 1.04 * float(flow[0])],
        np.full(size, 1.5),
        {"lower": 0.0, "upper": 4.0},
        rng.uniform(0.01, 0.05, size).tolist(),
        size,
        0.3,
        0.7,
        0.4,
        2.0,
        [1.5 * float(one) for one in flow],
    )


def _vehicle(rng: np.random.Generator, uncertain: bool, drift: bool) -> _Kind:
    """Masses with friction on a line, in a plane or in space, between two walls; a wind may drift them."""
    axes = int(rng.integers(1, 4))
    friction = float(rng.uniform(0.1, 0.4))
    A = [["0"] * (2 * axes) for _ in range(2 * axes)]
    for axis in range(axes):
        A[axis][axes + axis] = "1"
        A[axes + axis][axes + axis] = "-p" if uncertain else f"-{friction:.4f}"
    force = np.vstack([np.zeros((axes, axes)), np.eye(axes)])
    still = ["0"] * axes
    return _Kind(
        A,
        force,
        force,
        (still + ["-0.2"] * axes, still + ["0.1"] * axes) if drift else None,
        [0.85 * friction, 1.15 * friction],
        np.zeros(2 * axes),
        {"lower": -6.0, "upper": 6.0},
        [float(rng.uniform(0.002, 0.01))] * axes,
        axes,
        0.25,
        0.8,
        0.35,
        6.0,
        [0.0] * axes,
    )


def _walls(rng: np.random.Generator, wall: str, kind: _Kind, horizon: float, name: str) -> list[dict[str, Any]]:
    """The wall below, and for some the one above; or an ellipsoid around what is watched."""
    size, begins = len(kind.A), round(horizon / 8, 3)
    ahead = np.arange(size) < kind.watched
    if wall.startswith("curved") and kind.watched > 1:
        shape = np.diag(np.where(ahead, kind.radius**2 * rng.uniform(0.7, 1.3, size), 1e4))
        lean = rng.uniform(-0.3, 0.3) * np.sqrt(shape[0, 0] * shape[1, 1])
        shape[0, 1] = shape[1, 0] = lean
        rows = _line(rng, "bent" if "bent" in wall else "sloped", kind.start, 0.0, kind.swing * ahead, horizon)
        return [{"ellipsoid": {"shape": shape.tolist()}, "relative_to": rows, "from": begins}]
    rows = _line(rng, wall if wall in ("resting", "sloped") else "bent", kind.start, kind.room, kind.swing, horizon)
    H = np.eye(size)[: kind.watched]
    below = {"polytope": {"H": (-H).tolist(), "h": [0.0] * kind.watched}, "relative_to": rows, "from": begins}
    if name == "tanks" or (name == "house" and rng.random() < 0.5):
        return [below]
    width = 2 * kind.room if name == "vehicle" else 6.0
    narrows = rng.uniform(0.6, 1.0)
    far = [[t, *(np.array(at) + width * (1.0 - (1.0 - narrows) * t / horizon))] for t, *at in rows]
    above = {"polytope": {"H": H.tolist(), "h": [0.0] * kind.watched}, "relative_to": far, "from": begins}
    return [below, above]


def _line(
    rng: np.random.Generator, wall: str, start: np.ndarray, room: float, swing: float | np.ndarray, horizon: float
) -> list[list[float]]:
    """Rows ``(time, level of each state)`` of a line that begins so far below ``start``."""
    first = start - room
    if wall == "resting":
        rows = [[0.0, *first], [horizon, *first]]
    elif wall == "sloped":
        rows = [[0.0, *first], [horizon, *(first + swing * rng.uniform(-0.5, 0.8, start.size))]]
    else:
        rows = [[0.0, *first]]
        bends = np.unique(np.round(np.sort(rng.uniform(0.05, 0.95, int(rng.integers(4, 9)))) * horizon, 2))
        for number, time in enumerate(bends):
            if time - rows[-1][0] >= horizon / 16:
                level = first + swing * rng.uniform(-0.4, 0.8, start.size) if number % 2 == 0 else rows[-1][1:]
                rows.append([time, *level])
        rows.append([horizon, *rows[-1][1:]])
    return [[float(number) for number in row] for row in rows]
