"""Random problems with sets that have no interior, or none that doubles resolve, and what they cost: a linear program in
coordinates of the span of the set, with exact transitions, by HiGHS. Nothing of the package is used.

A set is ``{c + V s}``, ``V (d, r)``, where ``|s_i| <= 1``, thickened by a ball of `THICK` or not at all. A ball that is
so small is a point, ``r = 0``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog

THICK = (0.0, 1e-15, 1e-12)
PLACES = ("disturbance", "initial", "terminal", "path")
POLICIES = ("open_loop", "affine")
POINTS = ("norm", "ellipsoid")  # kinds that are balls


@dataclass(frozen=True)
class Span:
    """``{c + V s : |s_i| <= 1}``, ``c (d,)``, ``V (d, r)``."""

    c: np.ndarray
    V: np.ndarray


@dataclass(frozen=True)
class Problem:
    """A problem of two states that begins in ``x``, with pieces of equal length, as numbers."""

    A: np.ndarray
    B: np.ndarray
    x: np.ndarray
    horizon: float
    pieces: int
    control: float
    policy: str
    kind: str
    thick: float
    place: str
    disturbance: Span | None = None
    initial: Span | None = None
    rows: list[tuple[int, np.ndarray, np.ndarray]] = field(default_factory=list)
    """``H x <= h`` at the end of so many pieces."""
    ends: list[tuple[int, Span]] = field(default_factory=list)
    """The state is in the span at the end of so many pieces."""
    config: dict[str, Any] = field(default_factory=dict)


def _config_of(kind: str, thick: float, span: Span, rng: np.random.Generator) -> dict[str, Any]:
    """A set of a kind, as a config says it."""
    d, r = span.V.shape
    if kind == "box":
        half = np.abs(span.V).sum(axis=1) + thick
        return {"box": {"lower": (span.c - half).tolist(), "upper": (span.c + half).tolist()}}
    if kind == "polytope":
        across = np.linalg.svd(span.V.T)[2][r:] if r else np.eye(d)
        within = np.linalg.pinv(span.V) if r else np.zeros((0, d))
        H, h = np.vstack([across, within]), np.append(np.full(len(across), thick), np.ones(r))
        return {"polytope": {"H": np.vstack([H, -H]).tolist(), "h": np.append(h + H @ span.c, h - H @ span.c).tolist()}}
    if kind == "norm":
        p = rng.choice([1.0, 1.5, 2.0, 3.0, np.inf])
        return {"norm": {"p": "inf" if np.isinf(p) else float(p), "radius": thick, "centre": span.c.tolist()}}
    if kind == "ellipsoid":
        return {"ellipsoid": {"centre": span.c.tolist(), "shape": (max(thick, 1e-15) ** 2 * np.eye(d)).tolist()}}
    generators = [*span.V.T.tolist(), *([[0.0] * d] if r == 0 else [])]
    if thick:
        generators.append((thick * rng.normal(size=d)).tolist())
    elif r and rng.random() < 0.3:  # two segments along each other are one
        generators = [(0.25 * span.V[:, 0]).tolist(), *generators[1:], (0.75 * span.V[:, 0]).tolist()]
    return {"zonotope": {"generators": generators, "centre": span.c.tolist()}}


def draw(seed: int) -> Problem:
    """One of them; by its number every kind, thickness, place and policy in turn."""
    rng = np.random.default_rng([41, seed])
    kinds = ("box", "polytope", "norm", "ellipsoid", "zonotope")
    kind, thick, place, policy = (
        kinds[seed % 5],
        THICK[seed // 5 % 3],
        PLACES[seed // 15 % 4],
        POLICIES[seed // 60 % 2],
    )
    d, pieces = 2, int(rng.integers(4, 7))
    A = np.array([[0.0, 1.0], [0.0, 0.0]]) + (rng.normal(scale=0.4, size=(2, 2)) if rng.random() < 0.7 else 0.0)
    B, x = np.array([[0.0], [1.0]]), rng.choice([-1.0, 1.0]) * np.array([1.0, rng.uniform(-0.3, 0.3)])
    horizon, control = 2.0, 4.0
    small = 0.03 if place in ("disturbance", "initial") else 0.15
    r = 0 if kind in POINTS else int(rng.integers(0, 2)) if kind != "zonotope" or rng.random() < 0.2 else 1
    V = small * rng.uniform(0.4, 1.0, size=(d, r)) * rng.choice([-1.0, 1.0], size=(d, r))
    if kind == "box" and r:
        V[int(rng.integers(0, 2)), 0] = 0.0
    centred = place in ("disturbance", "initial")
    centre = (np.zeros(d) if rng.random() < 0.5 else 0.02 * rng.normal(size=d)) if centred else 0.1 * rng.normal(size=d)
    span = Span(centre, V)
    stated = _config_of(kind, thick, span, rng)
    final = 0.35 if centred else 0.8
    everywhere = np.vstack([np.eye(d), -np.eye(d)]), np.full(2 * d, final)
    more: dict[str, Any] = {"terminal": [{"box": [final] * d}]}
    ends, rows = [], [(pieces, *everywhere)]
    noise, initial = None, None
    if policy == "affine" and not centred:  # something to answer that is over by then, so that what is thin can be met
        initial = Span(np.zeros(d), 0.02 * np.eye(d))
        more["initial_state"] = {"centre": x.tolist(), "box": [0.02] * d}
    if place == "initial":
        x, span = x + span.c, Span(np.zeros(d), span.V)
        stated = _config_of(kind, thick, span, rng)
        next(iter(stated.values())).pop("centre", None)
    if place == "disturbance":
        more["disturbance"], noise = stated, span
    elif place == "initial":
        more["initial_state"], initial = {"centre": x.tolist(), **stated}, span
    elif place == "terminal":
        more["terminal"], ends, rows = [stated], [(pieces, span)], []
    else:
        k = pieces - 1
        ends, more["path"] = [(k, span)], [{**stated, "from": k * horizon / pieces, "to": k * horizon / pieces}]
    config = {
        "problem": {
            "name": "linear",
            "system": {"A": A.tolist(), "B": B.tolist()},
            "horizon": horizon,
            "control": {"box": [control]},
            **({} if "initial_state" in more else {"initial_state": x.tolist()}),
            **more,
        },
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "policy": {"name": policy} if policy == "open_loop" else {"name": policy, "cost": "peak"},
        "observers": [],
    }
    return Problem(A, B, x, horizon, pieces, control, policy, kind, thick, place, noise, initial, rows, ends, config)


def value(problem: Problem) -> float:
    """What the thin sets cost where they have no thickness at all; infinite where nothing is feasible."""
    d, K, step = len(problem.A), problem.pieces, problem.horizon / problem.pieces
    noise = problem.disturbance or Span(np.zeros(d), np.zeros((d, 0)))
    begun = problem.initial or Span(np.zeros(d), np.zeros((d, 0)))
    big = expm(step * np.block([[problem.A, problem.B, np.eye(d)], [np.zeros((1 + d, 2 * d + 1))]]))
    Phi, Gamma, Delta = big[:d, :d], big[:d, d : d + 1], big[:d, d + 1 :]
    # variables: v (K), peaks (K), and of every piece k its answers to every known number of deviations
    blocks = [begun.V.shape[1], *[noise.V.shape[1]] * K]
    offsets = np.cumsum([0, *blocks])
    Q = int(offsets[-1])
    known = [int(offsets[k + 1]) if problem.policy == "affine" else 0 for k in range(K)]
    first = 2 * K + np.cumsum([0, *known])
    n = int(first[-1])
    nominal, answers = [np.zeros((d, n))], [np.zeros((d, Q, n))]
    base, given = [problem.x + begun.c], [np.concatenate([begun.V, np.zeros((d, Q - begun.V.shape[1]))], axis=1)]
    for k in range(K):
        one = Phi @ nominal[-1]
        one[:, k] += Gamma[:, 0]
        many = np.einsum("ij,jqn->iqn", Phi, answers[-1])
        for q in range(known[k]):
            many[:, q, first[k] + q] += Gamma[:, 0]
        push = Phi @ given[-1]
        push[:, offsets[k + 1] : offsets[k + 2]] += Delta @ noise.V
        nominal, answers, given = [*nominal, one], [*answers, many], [*given, push]
        base.append(Phi @ base[-1] + Delta @ noise.c)
    A_ub, b_ub, A_eq, b_eq, extra = [], [], [], [], n

    def bounded(linear: np.ndarray, row: np.ndarray, constant: np.ndarray, limit: float) -> None:
        """``linear'z + sum_q |row_q'z + constant_q| <= limit``, with a variable more for every absolute value."""
        nonlocal extra
        sizes = [q for q in range(len(constant)) if row[q].any()]
        rest = float(np.abs(np.delete(constant, sizes)).sum())
        total = {"linear": linear, "more": list(range(extra, extra + len(sizes)))}
        for place, q in zip(total["more"], sizes, strict=True):
            for sign in (1.0, -1.0):
                A_ub.append((sign * row[q], [(place, -1.0)]))
                b_ub.append(-sign * constant[q])
        A_ub.append((linear, [(place, 1.0) for place in total["more"]]))
        b_ub.append(limit - rest)
        extra += len(sizes)

    for k in range(K):
        row = np.zeros((known[k], n))
        row[np.arange(known[k]), first[k] + np.arange(known[k])] = 1.0
        for sign in (1.0, -1.0):
            linear = np.zeros(n)
            linear[k], linear[K + k] = sign, -1.0
            bounded(linear, row, np.zeros(known[k]), 0.0)
    for k, H, h in problem.rows:
        for c, limit in zip(H, h, strict=True):
            bounded(c @ nominal[k], np.einsum("i,iqn->qn", c, answers[k]), c @ given[k], limit - c @ base[k])
    for k, span in problem.ends:
        r = span.V.shape[1]
        across = np.linalg.svd(span.V.T)[2][r:] if r else np.eye(d)
        for c in across:
            A_eq.append(c @ nominal[k])
            b_eq.append(c @ (span.c - base[k]))
            for q in range(Q):
                A_eq.append(c @ answers[k][:, q])
                b_eq.append(-c @ given[k][:, q])
        for c in np.linalg.pinv(span.V) if r else []:
            for sign in (1.0, -1.0):
                away = sign * c @ (base[k] - span.c)
                bounded(
                    sign * c @ nominal[k], np.einsum("i,iqn->qn", sign * c, answers[k]), sign * c @ given[k], 1.0 - away
                )
    table = np.zeros((len(A_ub), extra))
    for row, (linear, more) in zip(table, A_ub, strict=True):
        row[:n] = linear
        for place, coefficient in more:
            row[place] += coefficient
    cost = np.zeros(extra)
    cost[K : 2 * K] = step
    bounds = [(-problem.control, problem.control)] * K + [(0.0, problem.control)] * K + [(None, None)] * (extra - 2 * K)
    equal = np.hstack([np.array(A_eq).reshape(-1, n), np.zeros((len(A_eq), extra - n))]) if A_eq else None
    found = linprog(cost, table, b_ub, equal, b_eq if A_eq else None, bounds=bounds, method="highs")
    return float(found.fun) if found.status == 0 else np.inf
