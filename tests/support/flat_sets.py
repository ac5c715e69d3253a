"""Random problems with sets that have no interior, or none that doubles resolve, and what they cost: a linear program
in coordinates of the span of the set, with exact transitions, by HiGHS. Nothing of the package is used.

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
    """A problem of two or three states that begins in ``x``, with pieces of equal length, as numbers."""

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
    """One of them; by its number every kind, thickness, place and policy in turn. Feedback has no curved states."""
    rng = np.random.default_rng([41, seed])
    kinds = ("box", "polytope", "norm", "ellipsoid", "zonotope")
    kind, thick, place, policy = (
        kinds[seed % 5],
        THICK[seed // 5 % 3],
        PLACES[seed // 15 % 4],
        POLICIES[seed // 60 % 2],
    )
    if kind in POINTS and place in ("terminal", "path"):
        policy = "open_loop"
    d, pieces = 2 + int(seed % 3 == 2), int(rng.integers(4, 7))
    A = np.eye(d, k=1) + (rng.normal(scale=0.4, size=(d, d)) if rng.random() < 0.7 else 0.0)
    B = np.eye(d)[:, d - 1 :]
    x = rng.choice([-1.0, 1.0]) * np.append(1.0, rng.uniform(-0.3, 0.3, size=d - 1))
    horizon, control = 2.0, 4.0 ** (d - 1)
    small = 0.03 if place in ("disturbance", "initial") else 0.15
    r = 0 if kind in POINTS else int(rng.integers(kind == "zonotope" and rng.random() < 0.8, d))
    V = small * rng.uniform(0.4, 1.0, size=(d, r)) * rng.choice([-1.0, 1.0], size=(d, r))
    if kind == "box":
        V = V * np.eye(d)[:, rng.permutation(d)[:r]]
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


class Rows:
    """Rows of a linear program over ``n`` variables, and one more for every absolute value in them."""

    def __init__(self, n: int) -> None:
        self.n = self.size = n
        self.least: list[tuple[np.ndarray, list[tuple[int, float]], float]] = []
        self.equal: list[tuple[np.ndarray, float]] = []

    def bounded(self, linear: np.ndarray, row: np.ndarray, constant: np.ndarray, limit: float) -> None:
        """``linear'z + sum_q |row_q'z + constant_q| <= limit``."""
        sizes = [q for q in range(len(constant)) if row[q].any()]
        places = range(self.size, self.size + len(sizes))
        self.size += len(sizes)
        for place, q in zip(places, sizes, strict=True):
            for sign in (1.0, -1.0):
                self.least.append((sign * row[q], [(place, -1.0)], -sign * constant[q]))
        rest = float(np.abs(np.delete(constant, sizes)).sum())
        self.least.append((linear, [(place, 1.0) for place in places], limit - rest))

    def solved(self, cost: np.ndarray, bounds: list[tuple[float | None, float | None]]) -> float:
        """The least cost; infinite where nothing is feasible."""
        table, rhs = np.zeros((len(self.least), self.size)), np.array([limit for *_, limit in self.least])
        for row, (linear, more, _) in zip(table, self.least, strict=True):
            row[: self.n] = linear
            for place, coefficient in more:
                row[place] = coefficient
        equal = np.zeros((len(self.equal), self.size))
        equal[:, : self.n] = np.array([linear for linear, _ in self.equal]).reshape(-1, self.n)
        costs = np.append(cost, np.zeros(self.size - self.n))
        every = bounds + [(None, None)] * (self.size - len(bounds))
        ends = np.array([limit for _, limit in self.equal])
        found = linprog(costs, table, rhs, equal, ends, bounds=every, method="highs")
        return float(found.fun) if found.status == 0 else np.inf


@dataclass(frozen=True)
class Motion:
    """The state at the end of every piece, linear in ``n`` variables ``z``: ``base + nominal z``, and by how much every
    one of ``Q`` numbers between -1 and 1 moves it, ``given + answers z``. ``first``: where the answers of every piece
    to ``known`` of these numbers begin."""

    n: int
    known: list[int]
    first: np.ndarray
    base: list[np.ndarray]
    nominal: list[np.ndarray]
    given: list[np.ndarray]
    answers: list[np.ndarray]


def motion(problem: Problem) -> Motion:
    """That of a problem: its variables are the control, the peaks, and what is answered."""
    d, K, step = len(problem.A), problem.pieces, problem.horizon / problem.pieces
    noise = problem.disturbance or Span(np.zeros(d), np.zeros((d, 0)))
    begun = problem.initial or Span(np.zeros(d), np.zeros((d, 0)))
    big = expm(step * np.block([[problem.A, problem.B, np.eye(d)], [np.zeros((1 + d, 2 * d + 1))]]))
    Phi, Gamma, Delta = big[:d, :d], big[:d, d : d + 1], big[:d, d + 1 :]
    offsets = np.cumsum([0, begun.V.shape[1], *[noise.V.shape[1]] * K])
    Q = int(offsets[-1])
    known = [int(offsets[k + 1]) if problem.policy == "affine" else 0 for k in range(K)]
    first = 2 * K + np.cumsum([0, *known])
    n = int(first[-1])
    nominal, answers = [np.zeros((d, n))], [np.zeros((d, Q, n))]
    base, given = [problem.x + begun.c], [np.concatenate([begun.V, np.zeros((d, Q - begun.V.shape[1]))], axis=1)]
    for k in range(K):
        one, many, push = Phi @ nominal[-1], np.einsum("ij,jqn->iqn", Phi, answers[-1]), Phi @ given[-1]
        one[:, k] += Gamma[:, 0]
        for q in range(known[k]):
            many[:, q, first[k] + q] += Gamma[:, 0]
        push[:, offsets[k + 1] : offsets[k + 2]] += Delta @ noise.V
        nominal, answers, given = [*nominal, one], [*answers, many], [*given, push]
        base.append(Phi @ base[-1] + Delta @ noise.c)
    return Motion(n, known, first, base, nominal, given, answers)


def value(problem: Problem) -> float:
    """What the thin sets cost where they have no thickness at all; infinite where nothing is feasible."""
    of, K = motion(problem), problem.pieces
    rows = Rows(of.n)

    def kept(k: int, c: np.ndarray, limit: float) -> None:
        at_most = limit - float(c @ of.base[k])
        rows.bounded(c @ of.nominal[k], np.einsum("i,iqn->qn", c, of.answers[k]), c @ of.given[k], at_most)

    for k in range(K):
        answered = np.eye(of.n)[of.first[k] : of.first[k] + of.known[k]]
        for sign in (1.0, -1.0):
            rows.bounded(sign * np.eye(of.n)[k] - np.eye(of.n)[K + k], answered, np.zeros(of.known[k]), 0.0)
    for k, H, h in problem.rows:
        for c, limit in zip(H, h, strict=True):
            kept(k, c, limit)
    for k, span in problem.ends:
        r = span.V.shape[1]
        for c in np.linalg.svd(span.V.T)[2][r:] if r else np.eye(len(span.c)):
            rows.equal.append((c @ of.nominal[k], c @ (span.c - of.base[k])))
            rows.equal += [(c @ of.answers[k][:, q], -c @ push) for q, push in enumerate(of.given[k].T)]
        for c in np.linalg.pinv(span.V) if r else []:
            kept(k, c, 1.0 + c @ span.c)
            kept(k, -c, 1.0 - c @ span.c)
    cost = np.zeros(of.n)
    cost[K : 2 * K] = problem.horizon / K
    return rows.solved(cost, [(-problem.control, problem.control)] * K + [(0.0, problem.control)] * K)
