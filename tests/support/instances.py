"""Random robust problems over any sets, in any units, and what is true of them: programs sampled on fine grids of
times, directions and parameters, by matrix exponentials, HiGHS and Clarabel. Nothing of the package is used.

The truth of a known system is proven: a trajectory departs from its chords by at most ``step^2 / 8`` times its
curvature, and a curved set lies between the polytope of its tangents and a smaller copy of that. Of an uncertain one
the lower value is proven, the upper one is that of a control with room to spare on a grid of parameters four times as
fine.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise, product
from typing import Any

import clarabel
import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.sparse import csc_matrix
from scipy.spatial import HalfspaceIntersection


@dataclass(frozen=True)
class Flat:
    """``H x <= h``; a box when ``H`` is the identity over its negative."""

    H: np.ndarray
    h: np.ndarray

    uniform = False

    @staticmethod
    def box(half_widths: np.ndarray) -> Flat:
        eye = np.eye(len(half_widths))
        return Flat(np.vstack([eye, -eye]), np.concatenate([half_widths, half_widths]))

    def scaled(self, factor: float) -> Flat:
        return Flat(self.H, self.h * factor)

    def rows(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Half-spaces, and by how much they are scaled to lie inside."""
        some = np.isfinite(self.h)
        return self.H[some], self.h[some], 1.0

    def support(self, normals: np.ndarray) -> np.ndarray:
        """``max v'x`` for every row ``v`` of ``(..., d)``."""
        flat = normals.reshape(-1, normals.shape[-1])
        d = flat.shape[1]
        if len(self.H) == 2 * d and np.array_equal(self.H[:d], np.eye(d)):
            value = np.maximum(flat, 0) @ self.h[:d] + np.maximum(-flat, 0) @ self.h[d:]
        else:
            value = (flat @ _vertices(self).T).max(axis=1)
        return value.reshape(normals.shape[:-1])

    def config(self, scale: np.ndarray, rows: np.ndarray | None) -> dict[str, Any]:
        """In the user's units ``scale * x``; with a factor for every row, as a polytope."""
        d = len(scale)
        box = len(self.h) == 2 * d and np.array_equal(self.H[:d], np.eye(d))
        if box and rows is None:
            return {"box": [float(v) if np.isfinite(v) else None for v in self.h[:d] * scale]}
        some = np.isfinite(self.h)
        factor = np.resize(np.ones(1) if rows is None else rows, len(self.h))[some]
        return {
            "polytope": {"H": (factor[:, None] * self.H[some] / scale).tolist(), "h": (factor * self.h[some]).tolist()}
        }


def _vertices(shape: Flat) -> np.ndarray:
    if shape.H.shape[1] == 1:
        return np.array(
            [
                [min(h / a for a, h in zip(shape.H[:, 0], shape.h, strict=True) if a > 0)],
                [max(h / a for a, h in zip(shape.H[:, 0], shape.h, strict=True) if a < 0)],
            ]
        )
    return HalfspaceIntersection(np.column_stack([shape.H, -shape.h]), np.zeros(shape.H.shape[1])).intersections


@dataclass(frozen=True)
class Curved:
    """``|x|_p <= radius``, or with axes ``(d, d)`` the ellipsoid ``{axes z: |z|_2 <= radius}``."""

    d: int
    p: float
    radius: float = 1.0
    axes: np.ndarray | None = None

    @property
    def uniform(self) -> bool:
        """Whether it is of its kind in units that are the same for all components only."""
        return self.axes is None

    def scaled(self, factor: float) -> Curved:
        return replace(self, radius=self.radius * factor)

    def rows(self) -> tuple[np.ndarray, np.ndarray, float]:
        z, inside = tangents(self.d, self.p)
        axes = np.eye(self.d) if self.axes is None else self.axes
        H = z @ np.linalg.inv(axes)
        return H, self.support(H), inside

    def support(self, normals: np.ndarray) -> np.ndarray:
        q = np.inf if self.p == 1 else 1.0 if np.isinf(self.p) else self.p / (self.p - 1)
        along = normals if self.axes is None else normals @ self.axes
        return self.radius * np.linalg.norm(along, q, axis=-1)

    def config(self, scale: np.ndarray, rows: np.ndarray | None) -> dict[str, Any]:
        if self.axes is None:
            p = "inf" if np.isinf(self.p) else self.p
            return {"norm": {"p": p, "radius": float(self.radius * scale[0])}}
        axes = scale[:, None] * self.axes * self.radius
        shape = axes @ axes.T
        return {"ellipsoid": {"shape": ((shape + shape.T) / 2).tolist()}}


Shape = Flat | Curved


@cache
def tangents(d: int, p: float) -> tuple[np.ndarray, float]:
    """Directions ``(r, d)`` in which a p-ball is bounded from outside, and the factor that brings what they bound
    inside."""
    if d == 1 or np.isinf(p):
        return np.vstack([np.eye(d), -np.eye(d)]), 1.0
    if p == 1:
        return np.array(list(product([1.0, -1.0], repeat=d))), 1.0
    if d == 2:
        angle = 2 * np.pi * np.arange(96) / 96
        z = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        z = np.random.default_rng(0).normal(size=(240, d))
        z /= np.linalg.norm(z, axis=1)[:, None]
        for _ in range(40):  # points that repel one another cover the sphere evenly
            apart = z[:, None] - z[None]
            far = np.linalg.norm(apart, axis=2) + np.eye(len(z))
            z += 0.5 * (apart / far[..., None] ** 3).sum(axis=1) / len(z)
            z /= np.linalg.norm(z, axis=1)[:, None]
    q = p / (p - 1)
    corners = HalfspaceIntersection(np.column_stack([z, -np.linalg.norm(z, q, axis=1)]), np.zeros(d)).intersections
    return z, 1.0 / float(np.linalg.norm(corners, p, axis=1).max())


@dataclass(frozen=True)
class Charge:
    """``l1`` times the absolute values, or the norm of all channels where they are ``grouped``, and quadratic terms of
    the state where every parameter, disturbance and deviation is at the centre of its set: ``Q``, ``R`` and ``final``,
    none where empty."""

    l1: float = 1.0
    grouped: bool = False
    Q: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    reference: np.ndarray = field(default_factory=lambda: np.zeros(0))
    R: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    final: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def config(self, units: Units) -> dict[str, Any]:
        """The key ``cost`` in the user's units, in which weights have the cost's factor."""
        found: dict[str, Any] = {"l1": self.l1}
        price, X = units.cost, np.outer(units.states, units.states)
        if self.grouped:
            found["group"] = "all"
        if self.Q.size:
            found["state"] = {"Q": _even(price * self.Q / X), "reference": (self.reference * units.states).tolist()}
        if self.R.size:
            found["control"] = {"R": _even(price * self.R / np.outer(units.controls, units.controls))}
        if self.final.size:
            found["final"] = {"Q": _even(price * units.time * self.final / X)}
        return found


def _even(matrix: np.ndarray) -> list[list[float]]:
    return ((matrix + matrix.T) / 2).tolist()


@dataclass(frozen=True)
class Source:
    """A further disturbance ``E w``, ``w`` in a set, constant between every two of some ``edges`` of the control, which
    are told by their numbers; ``units``: how many of the user's one of each entry is."""

    E: np.ndarray
    shape: Flat
    edges: np.ndarray
    units: np.ndarray


@dataclass(frozen=True)
class Totals:
    """``lower <= int H x + G u dt <= upper`` from one edge to another, which are told by their numbers."""

    H: np.ndarray
    G: np.ndarray
    first: int
    last: int
    lower: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True)
class Instance:
    """``x' = (A + sum_k p_k slopes_k) x + B u + E w`` with ``|p_k| <= 1``, all sets about 0, the control and the
    disturbance constant between ``edges``; ``x(0)`` anywhere in ``initial_state`` plus ``initial_set``.

    ``drift (d,)`` is added to ``x'``. The control acts ``late`` pieces later, ``before (m,)`` until then. From the edge
    of that number on, ``second`` gives other ``A``, ``B`` and drift.

    ``reference (q, 1 + d)``: where the set of the path is about, with kinks at edges. ``mixed``: ``H x + G u <= h`` in
    a window from and to the middle of a piece. ``step``: the set of every ``u_{k+1} - u_k``, and of ``u_0`` itself.

    ``prices (m, K)``: the weights on every piece, where they change. ``waves``: ``A`` is ``A + W sin(r t)``.
    ``repeat``: it begins again at the horizon: final states are initial ones, and ``u_0`` follows the last control."""

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    initial_state: np.ndarray
    edges: np.ndarray
    control: Shape
    weights: np.ndarray
    disturbance: Shape | None = None
    terminal: list[Shape] = field(default_factory=list)
    ends_at: np.ndarray | None = None
    path: list[tuple[Shape, float, float]] = field(default_factory=list)
    slopes: list[np.ndarray] = field(default_factory=list)
    dictionary: str = "piecewise_constant"
    initial_set: Shape | None = None
    charge: Charge | None = None
    drift: np.ndarray | None = None
    late: int = 0
    before: np.ndarray | None = None
    second: tuple[int, np.ndarray, np.ndarray, np.ndarray] | None = None
    reference: np.ndarray | None = None
    mixed: tuple[np.ndarray, np.ndarray, np.ndarray, float, float] | None = None
    step: Shape | None = None
    prices: np.ndarray | None = None
    sources: tuple[Source, ...] = ()
    totals: Totals | None = None
    waves: tuple[np.ndarray, float] | None = None
    repeat: bool = False

    def mode(self, piece: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``A``, ``B`` and the drift on a piece."""
        if self.second is not None and piece >= self.second[0]:
            return self.second[1:]
        return self.A, self.B, np.zeros(len(self.A)) if self.drift is None else self.drift

    @property
    def price(self) -> np.ndarray:
        """The price ``(m K,)`` of ``|u|`` on every piece."""
        factor = 1.0 if self.charge is None else self.charge.l1
        weights = self.weights[:, None] if self.prices is None else self.prices
        return factor * (weights * np.diff(self.edges)).ravel()

    @property
    def largest(self) -> float:
        """A cost that is not small: the largest of the absolute values, and what no control at all costs."""
        found = float(self.price @ self.bounds)
        if self.charge is None:
            return found
        P, _, constant = quadratic(self)
        return found + constant + float(self.bounds @ np.abs(P) @ self.bounds) / 2

    @property
    def sides(self) -> np.ndarray:
        """The largest ``u``, and the largest ``-u``, ``(2, m K)``."""
        eye = np.eye(len(self.weights))
        return np.repeat([self.control.support(eye), self.control.support(-eye)], len(self.edges) - 1, axis=1)

    @property
    def bounds(self) -> np.ndarray:
        """The largest ``|u|`` ``(m K,)``."""
        return self.sides.max(axis=0)


@dataclass(frozen=True)
class Sampled:
    """At the fine times ``(J,)``, for one parameter: the state without control ``(J, d)``, its response to the pieces
    ``(J, d, m K)`` and to the disturbance ``(J, d, q, K)``, what becomes of an initial state ``(J, d, d)``, and how far
    a state may leave its chords ``(d,)``. ``more``: the noise of every source. ``totals``: the integrals at the end, as
    free motion, response, noise, noise of every source and flow."""

    times: np.ndarray
    free: np.ndarray
    response: np.ndarray
    noise: np.ndarray
    flow: np.ndarray
    sag: np.ndarray
    more: tuple[np.ndarray, ...] = ()
    totals: tuple[np.ndarray, ...] = ()


MAGNUS = 4  # parts of a step of the fine grid, where `A` changes with time


def sample(problem: Instance, per_piece: int, parameter: np.ndarray) -> Sampled:
    """Step through the fine grid with the exact discretisation of one step."""
    varied = sum((p * slope for p, slope in zip(parameter, problem.slopes, strict=True)), np.zeros_like(problem.A))
    (d, m), K = problem.B.shape, len(problem.edges) - 1
    every = np.hstack([problem.E, *(source.E for source in problem.sources)])
    q, r = every.shape[1], 0 if problem.totals is None else len(problem.totals.H)
    D = d + r  # integrals are further states
    steps = np.repeat(np.diff(problem.edges) / per_piece, per_piece)
    count = K * per_piece + 1
    free, response, noise = np.zeros((count, D)), np.zeros((count, D, m, K)), np.zeros((count, D, q, K))
    free[0, :d], flow = problem.initial_state, np.broadcast_to(np.eye(D), (count, D, D)).copy()
    size, now = D + m + q + 1, 0.0
    for j in range(count - 1):
        piece = j // per_piece
        if j % per_piece == 0 or problem.waves is not None:
            A, B, c = problem.mode(piece)
            block = np.zeros((size, size))
            block[:d] = np.hstack([A + varied, np.zeros((d, r)), B, every, c[:, None]])
            if problem.totals is not None and problem.totals.first <= piece < problem.totals.last:
                block[d:D, :d] = problem.totals.H
            big = expm(steps[j] * block) if problem.waves is None else _waved(block, problem.waves, now, steps[j])
            Ad, Bd, Ed, cd = big[:D, :D], big[:D, D : D + m], big[:D, D + m : -1], big[:D, -1]
        now += steps[j]
        free[j + 1], flow[j + 1] = Ad @ free[j] + cd, Ad @ flow[j]
        response[j + 1] = np.einsum("ij,jmk->imk", Ad, response[j])
        if piece >= problem.late:
            response[j + 1, :, :, piece - problem.late] += Bd
        elif problem.before is not None:
            free[j + 1] += Bd @ problem.before
        noise[j + 1] = np.einsum("ij,jqk->iqk", Ad, noise[j])
        noise[j + 1, :, :, j // per_piece] += Ed
    times = np.concatenate([[0.0], np.cumsum(steps)])
    times[per_piece::per_piece] = problem.edges[1:]
    response = response.reshape(count, D, m * K)
    ends = np.cumsum([0, problem.E.shape[1], *(source.E.shape[1] for source in problem.sources)])
    own, *more = (noise[:, :, first:last] for first, last in pairwise(ends))
    more = [np.add.reduceat(n, source.edges[:-1], axis=3) for n, source in zip(more, problem.sources, strict=True)]
    last = (free[-1, d:], response[-1, d:], own[-1, d:], *(n[-1, d:] for n in more), flow[-1, d:, :d])
    free, response, own, flow = free[:, :d], response[:, :d], own[:, :d], flow[:, :d, :d]
    sampled = Sampled(times, free, response, own, flow, np.zeros(d), tuple(n[:, :d] for n in more), last if r else ())
    w = np.zeros(problem.E.shape[1])
    if problem.disturbance is not None:
        eye = np.eye(w.size)
        w = np.maximum(problem.disturbance.support(eye), problem.disturbance.support(-eye))
    pushed = np.abs(problem.E) @ w
    for source in problem.sources:
        pushed = pushed + np.abs(source.E) @ source.shape.support(np.eye(source.E.shape[1]))
    both = deviations(problem, sampled, np.vstack([np.eye(d), -np.eye(d)]))
    deviation = np.maximum(both[:, :d], both[:, d:])
    farthest = np.abs(free) + np.abs(sampled.response) @ problem.bounds + deviation
    largest = problem.bounds[:: len(problem.edges) - 1]
    largest = largest if problem.before is None else np.maximum(largest, np.abs(problem.before))
    curvature = np.zeros(d)
    for A, B, c in (problem.mode(0), problem.mode(K - 1)):
        inputs, here = np.abs(B) @ largest + pushed + np.abs(c), A + varied
        twice, once, far = np.abs(here @ here), np.abs(here), farthest.max(axis=0)
        if problem.waves is not None:
            W, rate = problem.waves
            once = once + np.abs(W)
            twice = once @ once + rate * np.abs(W)
        curvature = np.maximum(curvature, twice @ far + once @ inputs)
    return replace(sampled, sag=curvature * steps.max() ** 2 / 8)


def _waved(block: np.ndarray, waves: tuple[np.ndarray, float], now: float, step: float) -> np.ndarray:
    """What a step does where ``A`` changes with time: Magnus' series of order four on parts of it."""
    (W, rate), d, done, h = waves, len(waves[0]), np.eye(len(block)), step / MAGNUS
    for part in range(MAGNUS):
        middle = now + (part + 0.5) * h
        early, late = block.copy(), block.copy()
        for one, sign in ((early, -1.0), (late, 1.0)):
            one[:d, :d] += W * np.sin(rate * (middle + sign * h / np.sqrt(12.0)))
        turned = np.sqrt(3.0) / 12.0 * h**2 * (late @ early - early @ late)
        done = expm(h / 2 * (early + late) + turned) @ done
    return done


def deviations(problem: Instance, sampled: Sampled, normals: np.ndarray) -> np.ndarray:
    """The worst ``c'x`` ``(J, r)`` of the disturbance and the initial deviation alone, for every row ``c``."""
    begun = np.zeros((len(sampled.times), len(normals)))
    if problem.initial_set is not None:
        begun = problem.initial_set.support(np.einsum("rd,jde->jre", normals, sampled.flow))
    for source, noise in zip(problem.sources, sampled.more, strict=True):
        begun = begun + source.shape.support(np.einsum("rd,jdqk->jrkq", normals, noise)).sum(axis=-1)
    if problem.disturbance is None:
        return begun
    return begun + problem.disturbance.support(np.einsum("rd,jdqk->jrkq", normals, sampled.noise)).sum(axis=-1)


def total_rows(problem: Instance, sampled: Sampled, spare: float) -> list[Rows]:
    """Rows of the bounds of integrals."""
    if problem.totals is None:
        return []
    totals, K = problem.totals, len(problem.edges) - 1
    free, response, own, *more, flow = sampled.totals
    inside = (np.arange(K) >= totals.first) & (np.arange(K) < totals.last)
    response = response + np.stack([np.kron(row, inside * np.diff(problem.edges)) for row in totals.G])
    found = []
    for sign, limit in ((1.0, totals.upper), (-1.0, -totals.lower)):
        some = np.isfinite(limit)
        room = limit - spare * np.where(some, np.abs(limit), 0.0) - sign * free
        pairs: list[tuple[Shape | None, np.ndarray]] = [(problem.disturbance, own)]
        pairs += [(source.shape, noise) for source, noise in zip(problem.sources, more, strict=True)]
        for shape, noise in pairs:
            if shape is not None:
                room = room - shape.support(sign * np.swapaxes(noise, 1, 2)).sum(axis=-1)
        if problem.initial_set is not None:
            room = room - problem.initial_set.support(sign * flow)
        found.append((sign * response[some], room[some]))
    return found


Rows = tuple[np.ndarray, np.ndarray]


def path_rows(problem: Instance, sampled: Sampled, tight: bool, spare: float) -> tuple[Rows, Rows]:
    """Rows ``G u <= h`` of the path constraints, most of which will not matter, and of the end; with room for what lies
    between the samples if ``tight``, and ``spare`` times the right-hand side besides."""
    times, K = sampled.times, sampled.response.shape[2]
    path, end = [(np.empty((0, K)), np.empty(0))], [(np.empty((0, K)), np.empty(0))]

    def rows(shape: Shape, which: np.ndarray, sag: np.ndarray) -> Rows:
        H, h, inside = shape.rows()
        h = h * ((inside if tight else 1.0) - spare)
        room = h - np.abs(H) @ sag - (H @ sampled.free[which].T).T - deviations(problem, sampled, H)[which]
        return np.einsum("rd,jdk->jrk", H, sampled.response[which]).reshape(-1, K), room.ravel()

    for shape, start, stop in problem.path:
        inside = np.flatnonzero((times >= start - 1e-12) & (times <= stop + 1e-12))
        if tight:  # with one more time on either side, the chords cover the whole window
            first, last = np.searchsorted(times, [start, stop], side="right")
            inside = np.arange(max(first - 1, 0), min(last + 1, len(times)))
        G, room = rows(shape, inside, sampled.sag if tight else 0 * sampled.sag)
        if problem.reference is not None:
            at, *points = problem.reference.T
            moved = np.stack([np.interp(times[inside], at, column) for column in points], axis=1)
            room = room + (moved @ shape.rows()[0].T).ravel()
        path.append((G, room))
    if problem.mixed is not None:
        path += mixed_rows(problem, sampled, sampled.sag if tight else 0 * sampled.sag, spare)
    last = np.array([len(times) - 1])
    end += [rows(shape, last, 0 * sampled.sag) for shape in problem.terminal]
    if problem.repeat and problem.initial_set is not None:
        G, room = rows(problem.initial_set, last, 0 * sampled.sag)
        end.append((G, room + problem.initial_set.rows()[0] @ problem.initial_state))
    end += total_rows(problem, sampled, spare)
    return tuple(tuple(np.concatenate(part) for part in zip(*some, strict=True)) for some in (path, end))  # type: ignore[return-value]


def mixed_rows(problem: Instance, sampled: Sampled, sag: np.ndarray, spare: float) -> list[Rows]:
    """Rows of the bounds of state and control together, piece by piece; both ends of a piece are looked at with its own
    control."""
    assert problem.mixed is not None
    H, own, h, start, stop = problem.mixed
    found, times, K = [], sampled.times, len(problem.edges) - 1
    for k in range(K):
        low, high = max(start, problem.edges[k]), min(stop, problem.edges[k + 1])
        which = np.flatnonzero((times >= low - 1e-9) & (times <= high + 1e-9)) if low < high else np.zeros(0, dtype=int)
        G = np.einsum("rd,jdk->jrk", H, sampled.response[which]) + np.kron(own, np.eye(K)[k])
        room = h * (1 - spare) - np.abs(H) @ sag - sampled.free[which] @ H.T - deviations(problem, sampled, H)[which]
        found.append((G.reshape(-1, G.shape[2]), room.ravel()))
    return found


def control_rows(problem: Instance, tight: bool) -> Rows:
    """Rows ``G u <= h`` of the set of controls, piece by piece, and of the set of their steps."""
    m, K = len(problem.weights), len(problem.edges) - 1
    H, h, inside = problem.control.rows()
    slanted = (H != 0).sum(axis=1) > 1  # the others are bounds
    H, h = H[slanted], h[slanted]
    rows = np.vstack([np.kron(H, np.eye(K)[k]) for k in range(K)]).reshape(-1, m * K)
    limits = np.tile(h * (inside if tight else 1.0), K)
    if problem.step is None:
        return rows, limits
    H, h, inside = problem.step.rows()
    steps = np.eye(K) - np.eye(K, k=-1)  # the first is from 0
    steps[0, -1] -= float(problem.repeat)
    rows = np.vstack([rows, *(np.kron(H, steps[k]) for k in range(K))])
    return rows, np.append(limits, np.tile(h * (inside if tight else 1.0), K))


def nominal(shape: Shape | None, size: int) -> np.ndarray:
    """The middle of the bounding box where that is inside, else the mean of the corners."""
    if shape is None or isinstance(shape, Curved):
        return np.zeros(size)
    eye = np.eye(size)
    middle = (shape.support(eye) - shape.support(-eye)) / 2
    return middle if (shape.H @ middle <= shape.h + 1e-9).all() else _vertices(shape).mean(axis=0)


def quadratic(problem: Instance) -> tuple[np.ndarray, np.ndarray, float]:
    """The quadratic terms as ``u'P u/2 + q'u + constant``, by Boole's rule on a grid so fine that what is fastest moves
    by a twentieth in a step: the rule is then right to nine digits."""
    charge = problem.charge
    assert charge is not None
    fastest = max(float(np.linalg.norm(problem.mode(k)[0], 2)) for k in (0, len(problem.edges) - 2))
    fastest += 0.0 if problem.waves is None else float(np.linalg.norm(problem.waves[0], 2)) + problem.waves[1]
    steps = 4 * max(6, int(np.ceil(5 * fastest * np.diff(problem.edges).max())))
    some = sample(replace(problem, slopes=[]), steps, np.zeros(0))
    free = some.free + np.einsum("aidk,d->ai", some.noise, nominal(problem.disturbance, problem.E.shape[1]))
    free = free + some.flow @ nominal(problem.initial_set, len(problem.A))
    n, d = len(problem.price), len(problem.A)
    P, q, constant = np.zeros((n, n)), np.zeros(n), 0.0
    weights = np.zeros(len(some.times))
    for k, length in enumerate(np.diff(problem.edges)):
        for first in range(k * steps, (k + 1) * steps, 4):
            weights[first : first + 5] += 2 * length / steps / 45 * np.array([7, 32, 12, 32, 7])
    for Q, r, share in (
        (charge.Q, charge.reference, weights),
        (charge.final, np.zeros(d), np.eye(len(weights))[-1]),
    ):
        if Q.size:
            away, driven = free - r, some.response.transpose(1, 0, 2)
            P += 2 * np.einsum("iak,ij,jal->kl", driven * share[:, None], Q, driven, optimize=True)
            q += 2 * np.einsum("iak,ij,aj->k", driven * share[:, None], Q, away, optimize=True)
            constant += float(np.einsum("a,ai,ij,aj->", share, away, Q, away))
    if charge.R.size:
        P += 2 * np.kron(charge.R, np.diag(np.diff(problem.edges)))
    return P, q, constant


def over_cones(P: csc_matrix, q: np.ndarray, A: csc_matrix, b: np.ndarray, cones: list[Any]) -> Any:
    """The answer of a solver for cones, ``None`` where nothing is feasible. What it calls almost solved was off by 1e-5
    once: without its own scaling it got there; else nothing is known."""
    for scaled in (True, False):
        settings = clarabel.DefaultSettings()
        settings.verbose, settings.equilibrate_enable = False, scaled
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
        answer = clarabel.DefaultSolver(P, q, A, b, cones, settings).solve()
        status = str(answer.status)
        if status == "PrimalInfeasible":
            return None
        if status == "Solved":
            return answer
    raise ArithmeticError(status)


def charged(
    problem: Instance,
    rows: np.ndarray,
    limits: np.ndarray,
    equal: np.ndarray | None,
    at: np.ndarray | None,
    side: float,
) -> tuple[float, np.ndarray | None]:
    """The least `Charge` of controls ``(m K,)`` under ``rows u <= limits`` and ``equal u = at``, with bounds drawn in
    to ``side``, by a solver for cones; ``inf`` where there is none."""
    P, q, constant = quadratic(problem)
    n, m, K = len(q), len(problem.weights), len(problem.edges) - 1
    grouped = problem.charge is not None and problem.charge.grouped
    tops = K if grouped else n
    bare, own = np.zeros((n, tops)), np.eye(n)
    some = np.isfinite(limits)
    blocks, right = [np.hstack([rows[some], np.zeros((int(some.sum()), tops))])], [limits[some]]
    high, low = problem.sides * side
    blocks += [np.hstack([own, bare]), np.hstack([-own, bare])]
    right += [high, low]
    if not grouped:
        blocks += [np.hstack([own, -own]), np.hstack([-own, -own])]
        right += [np.zeros(n), np.zeros(n)]
    cones: list[Any] = [clarabel.NonnegativeConeT(sum(len(part) for part in right))]
    if grouped:
        for k in range(K):
            block = np.zeros((m + 1, n + tops))
            block[0, n + k] = -1.0
            block[1 + np.arange(m), np.arange(m) * K + k] = -1.0
            blocks.append(block)
            right.append(np.zeros(m + 1))
            cones.append(clarabel.SecondOrderConeT(m + 1))
    if equal is not None and at is not None and at.size:
        blocks.append(np.hstack([equal, np.zeros((len(at), tops))]))
        right.append(at)
        cones.append(clarabel.ZeroConeT(len(at)))
    whole = np.zeros((n + tops, n + tops))
    whole[:n, :n] = P
    size = problem.largest  # the solver's accuracies are absolute, and costs may be a millionth
    answer = over_cones(
        csc_matrix(np.triu(whole)) / size,
        np.concatenate([q, problem.price[:tops] if grouped else problem.price]) / size,
        csc_matrix(np.vstack(blocks)),
        np.concatenate(right),
        cones,
    )
    if answer is None:
        return np.inf, None
    return answer.obj_val * size + constant, np.array(answer.x[:n])


def optimum(
    problem: Instance, samples: list[Sampled], tight: bool, spare: float = 0.0
) -> tuple[float, np.ndarray | None]:
    """The optimal cost, ``inf`` when infeasible, and a control ``(m K,)``; rows are added where it violates them."""
    pairs = [path_rows(problem, some, tight, spare) for some in samples]
    G, h = (np.concatenate(part) for part in zip(*(pair[0] for pair in pairs), strict=True))
    always = [control_rows(problem, tight), *(pair[1] for pair in pairs)]
    rows, limits = (np.concatenate(part) for part in zip(*always, strict=True))
    equal, at = None, None
    if problem.ends_at is not None:
        some = np.isfinite(problem.ends_at)
        last = samples[0].response[-1][some]
        equal, at = np.hstack([last, -last]), problem.ends_at[some] - samples[0].free[-1][some]
    size, used, inside = len(problem.price), np.zeros(len(h), dtype=bool), problem.control.rows()[2]
    for _ in range(200):
        both = np.concatenate([rows, G[used]])
        if problem.charge is not None:
            half = None if equal is None else equal[:, :size]
            fun, u = charged(problem, both, np.concatenate([limits, h[used]]), half, at, inside if tight else 1.0)
            if u is None:
                return np.inf, None
            excess = np.where(used, -np.inf, G @ u - h)
            if not (excess > 1e-9).any():
                return fun, u
            worst = np.argsort(-excess)[:60]
            used[worst[excess[worst] > 1e-9]] = True
            continue
        answer = linprog(
            np.tile(problem.price, 2),
            np.hstack([both, -both]),
            np.concatenate([limits, h[used]]),
            equal,
            at,
            bounds=np.stack([np.zeros(2 * size), problem.sides.ravel() * (inside if tight else 1.0)], axis=1),
            method="highs",
            options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
        )
        if answer.status == 2:
            return np.inf, None
        if answer.status != 0:
            raise ArithmeticError(answer.message)
        u = answer.x[:size] - answer.x[size:]
        excess = np.where(used, -np.inf, G @ u - h)
        worst = np.argsort(-excess)[:60]
        worst = worst[excess[worst] > 1e-9]
        if not len(worst):
            return float(answer.fun), u
        used[worst] = True
    raise ArithmeticError("the independent program did not end")


def truth(problem: Instance, per_piece: int = 24) -> tuple[float, float]:
    """Two values that enclose the optimal cost; ``(inf, inf)`` of an infeasible problem, and an upper one of ``inf``
    where nothing is known."""
    n = len(problem.slopes)

    def grid(count: int, per_piece: int) -> list[Sampled]:
        axes = np.linspace(-1, 1, count) if n else np.zeros(1)
        return [sample(problem, per_piece, np.array(p)) for p in product(axes, repeat=n)]

    if n:
        per_piece = 6
    lower, _ = optimum(problem, grid(3, per_piece), tight=False)
    if np.isinf(lower):
        return lower, lower
    if not n:
        return lower, optimum(problem, grid(1, per_piece), tight=True)[0]
    upper, u = optimum(problem, grid(5 if n == 1 else 3, per_piece), tight=True, spare=4e-3)
    if u is None:
        return lower, np.inf
    for some in grid(17 if n == 1 else 9, per_piece):
        for G, h in path_rows(problem, some, True, 2e-3):
            if len(h) and (G @ u > h).any():
                return lower, np.inf
    return lower, upper


def largest_violation(problem: Instance, u: np.ndarray, per_piece: int = 24) -> float:
    """By how much a sampled row is violated by the control ``(m K,)``, as a share of what its terms can be."""
    rows = [control_rows(problem, False)]
    for p in product([-1.0, 0.0, 1.0], repeat=len(problem.slopes)):
        rows += path_rows(problem, sample(problem, per_piece, np.array(p)), tight=False, spare=0.0)
    return max(float(((G @ u - h) / (np.abs(G) @ problem.bounds + np.abs(h))).max(initial=0.0)) for G, h in rows)


@dataclass(frozen=True)
class Units:
    """How many of the user's units one of the instance's is; and factors of the rows of polytopes, none for boxes."""

    time: float
    states: np.ndarray
    controls: np.ndarray
    disturbances: np.ndarray
    parameters: np.ndarray
    cost: float
    rows: np.ndarray | None = None

    @property
    def value(self) -> float:
        """What a cost of 1 is."""
        return self.time * self.cost


def _system(problem: Instance, units: Units, mode: tuple[np.ndarray, np.ndarray, np.ndarray]) -> dict[str, Any]:
    """One mode in the user's units."""
    X, to, d = units.states[:, None], 1.0 / units.time, len(problem.A)
    A = to * X * mode[0] / units.states
    system: dict[str, Any] = {"A": A.tolist(), "B": (to * X * mode[1] / units.controls).tolist()}
    if problem.disturbance is not None and not problem.sources:
        system["E"] = (to * X * problem.E / units.disturbances).tolist()
    if mode[2].any():
        system["c"] = (to * units.states * mode[2]).tolist()
    if problem.slopes:
        sides = units.parameters[: len(problem.slopes)]
        slopes = [to * X * s / units.states / side for s, side in zip(problem.slopes, sides, strict=True)]
        system["A"] = [
            [
                repr(float(A[i, j])) + "".join(f" + ({float(s[i, j])!r})*p{k}" for k, s in enumerate(slopes))
                for j in range(d)
            ]
            for i in range(d)
        ]
    if problem.waves is not None:
        W, rate = to * X * problem.waves[0] / units.states, to * problem.waves[1]
        system["A"] = [
            [f"{float(A[i, j])!r} + ({float(W[i, j])!r})*sin({float(rate)!r}*t)" for j in range(d)] for i in range(d)
        ]
    return system


def control_config(problem: Instance, units: Units) -> dict[str, Any]:
    """What is said of the control beside its set, in the user's units."""
    if problem.step is not None:
        step = {"control_step": problem.step.config(units.controls, None)}
        return step if problem.repeat else {**step, "initial_control": 0.0}
    return {} if problem.before is None else {"initial_control": (problem.before * units.controls).tolist()}


def path_config(problem: Instance, units: Units, horizon: float) -> list[dict[str, Any]]:
    """The entries of the path in the user's units."""
    windows: list[dict[str, Any]] = [
        {**shape.config(units.states, units.rows), "from": start * units.time, "to": min(stop * units.time, horizon)}
        for shape, start, stop in problem.path
    ]
    if problem.reference is not None and windows:
        windows[0]["relative_to"] = (problem.reference * np.append(units.time, units.states)).tolist()
    if problem.mixed is not None:
        H, G, h, start, stop = problem.mixed
        mixed = {"H": (H / units.states).tolist(), "G": (G / units.controls).tolist(), "h": h.tolist()}
        windows.append({"mixed": mixed, "from": start * units.time, "to": stop * units.time})
    return windows


def config(problem: Instance, units: Units) -> dict[str, Any]:
    """The instance in the user's units, as a config of the package."""
    system = _system(problem, units, problem.mode(0))
    if problem.second is not None:
        until = problem.edges[[problem.second[0], -1]] * units.time
        modes = (system, _system(problem, units, problem.second[1:]))
        system = {"pieces": [{"until": float(t), **one} for t, one in zip(until, modes, strict=True)]}
    if problem.slopes:
        sides = units.parameters[: len(problem.slopes)]
        system["parameters"] = {f"p{k}": [-float(side), float(side)] for k, side in enumerate(sides)}
    if problem.late:
        system["delay"] = float(problem.edges[problem.late] * units.time)
    horizon = float(problem.edges[-1] * units.time)
    equal = problem.edges.size < 3 or np.ptp(np.diff(problem.edges)) < 1e-12
    pieces = {"name": "piecewise_constant", "pieces": problem.edges.size - 1}
    if not equal:
        edges = (problem.edges * units.time).tolist()
        pieces = {"name": "piecewise_constant", "breakpoints": [*edges[:-1], horizon]}
    windows = path_config(problem, units, horizon)
    ends: list[dict[str, Any]] = [shape.config(units.states, units.rows) for shape in problem.terminal]
    if problem.ends_at is not None:
        ends.append({"equals": [float(v) if np.isfinite(v) else None for v in problem.ends_at * units.states]})
    begin: Any = (units.states * problem.initial_state).tolist()
    if problem.initial_set is not None:
        begin = {"centre": begin, **problem.initial_set.config(units.states, units.rows)}
    stated = {
        "name": "linear",
        "system": system,
        "horizon": horizon,
        "initial_state": begin,
        "weights": (problem.weights * units.cost / units.controls).tolist(),
        "control": problem.control.config(units.controls, units.rows),
        "path": windows,
        "terminal": ends,
    }
    if problem.charge is not None:
        stated["cost"] = problem.charge.config(units)
    stated |= control_config(problem, units)
    if problem.disturbance is not None:
        stated["disturbance"] = problem.disturbance.config(units.disturbances, units.rows)
    stated |= _further(problem, units, stated)
    control = pieces if problem.dictionary == "piecewise_constant" else {**pieces, "name": problem.dictionary}
    return {"problem": stated, "dictionaries": {"control": control, "disturbance": pieces}, "observers": []}


def _further(problem: Instance, units: Units, stated: dict[str, Any]) -> dict[str, Any]:
    """Keys of prices by piece, a list of disturbances, integrals, and a plan that begins again."""
    found: dict[str, Any] = {"repeat": True} if problem.repeat else {}
    times, to = problem.edges * units.time, units.states[:, None] / units.time
    times[-1] = stated["horizon"]
    if problem.prices is not None:
        prices = problem.prices.T * units.cost / units.controls
        found["weights"] = np.column_stack([times[:-1], prices]).tolist()
    if problem.sources:
        own = [] if problem.disturbance is None else [(problem.E, problem.disturbance, units.disturbances, None)]
        own += [(one.E, one.shape, one.units, times[one.edges].tolist()) for one in problem.sources]
        found["disturbance"] = [
            {
                "set": shape.config(scale, units.rows),
                "E": (to * E / scale).tolist(),
                **({} if edges is None else {"breakpoints": edges}),
            }
            for E, shape, scale, edges in own
        ]
    if problem.totals is not None:
        one, scale = problem.totals, units.time
        found["integral"] = [
            {
                "H": (one.H / units.states / scale).tolist(),
                "G": (one.G / units.controls / scale).tolist(),
                "from": float(times[one.first]),
                "to": float(times[one.last]),
                "lower": [float(v) if np.isfinite(v) else None for v in one.lower],
                "upper": [float(v) if np.isfinite(v) else None for v in one.upper],
            }
        ]
    return found


def drawn_units(rng: np.random.Generator, problem: Instance) -> Units:
    """No change in one case of four, or factors from 1e-6 to 1e6 for every quantity, and in half of these cases from
    1e-12 to 1e12 for every row."""

    def some(size: int, decades: float, shapes: list[Shape | None]) -> np.ndarray:
        if any(shape is not None and shape.uniform for shape in shapes):
            return np.full(size, 10.0 ** rng.uniform(-decades, decades))
        return 10.0 ** rng.uniform(-decades, decades, size)

    far = rng.choice([0.0, 1.0, 1.0, 1.0])
    states: list[Shape | None] = [*problem.terminal, *(one for one, _, _ in problem.path), problem.initial_set]
    return Units(
        time=float(10.0 ** rng.uniform(-4 * far, 4 * far)),
        states=some(problem.B.shape[0], 6 * far, states),
        controls=some(problem.B.shape[1], 6 * far, [problem.control, problem.step]),
        disturbances=some(problem.E.shape[1], 6 * far, [problem.disturbance]),
        parameters=10.0 ** rng.uniform(-6 * far, 6 * far, 2),
        cost=float(10.0 ** rng.uniform(-6 * far, 6 * far)),
        rows=10.0 ** rng.uniform(-12, 12, 16) if far and rng.random() < 0.5 else None,
    )


def drawn(rng: np.random.Generator) -> Instance:
    """A stable or mildly unstable system of one to four states; sets about what a control reaches, so that about half
    of the instances are feasible."""
    d, m = int(rng.choice([1, 2, 2, 2, 3, 3, 4])), int(rng.integers(1, 3))
    A = rng.normal(size=(d, d)) * rng.choice([0.3, 1.0, 2.0])
    A -= np.eye(d) * max(0.0, np.linalg.eigvals(A).real.max() - rng.uniform(-1, 0.8))
    uncertain = int(rng.choice([0, 0, 0, 1, 2])) if d < 4 else 0
    dictionary = str(rng.choice(["piecewise_constant", "piecewise_constant", "unequal", "haar", "walsh"]))
    K = int(2 ** rng.integers(2, 5)) if dictionary in ("haar", "walsh") else int(rng.integers(4, 20))
    horizon = float(np.round(rng.uniform(0.5, 4), 3))
    inner = np.sort(rng.uniform(0.03, 0.97, K - 1)) if dictionary == "unequal" else np.arange(1, K) / K
    problem = Instance(
        A=A,
        B=rng.normal(size=(d, m)),
        E=np.eye(d) if rng.random() < 0.5 else rng.normal(size=(d, int(rng.integers(1, d + 1)))),
        initial_state=rng.normal(size=d),
        edges=horizon * np.concatenate([[0.0], inner, [1.0]]),
        control=shape(rng, rng.uniform(0.3, 2, m), bounded=True),
        weights=rng.uniform(0.5, 2, m),
        slopes=[rng.normal(size=(d, d)) * 0.03 for _ in range(uncertain)],
        dictionary="piecewise_constant" if dictionary == "unequal" else dictionary,
    )
    if rng.random() < 0.7:
        q = problem.E.shape[1]
        problem = replace(problem, disturbance=shape(rng, rng.uniform(0.002, 0.05, q), bounded=True))
    u = rng.uniform(-1, 1, (m, K)) * problem.bounds.reshape(m, K) * (rng.random((m, K)) < 0.4) / m
    some = sample(problem, 8, np.zeros(uncertain))
    x = some.free + some.response @ u.ravel()

    def about(which: np.ndarray, room: float) -> Shape:
        """A set that the states there are in when ``room`` is 1."""
        reach = np.abs(x[which]).max(axis=0) + 1e-2
        bare = shape(rng, reach * rng.uniform(0.3, 1, d), bounded=False)
        H, h, _ = bare.rows()
        share = ((x[which] @ H.T + deviations(problem, some, H)[which]) / h).max(initial=1e-3)
        return bare.scaled(float(share * room))

    room = rng.uniform(0.3, 1.3) if not uncertain else rng.uniform(0.7, 2.0)
    if problem.disturbance is None and not uncertain and K * m > d + 2 and rng.random() < 0.5:
        ends = np.where(rng.random(d) < 0.7, x[-1] * rng.choice([1.0, 1.0, 1.3]), np.nan)
        if np.isfinite(ends).any():
            problem = replace(problem, ends_at=ends)
    if problem.ends_at is None:
        problem = replace(problem, terminal=[about(np.array([len(x) - 1]), room)])
    if rng.random() < 0.6:
        start, stop = np.sort(rng.uniform(0, horizon, 2))
        start = 0.0 if rng.random() < 0.2 else start
        stop = start if rng.random() < 0.1 else horizon if rng.random() < 0.3 else stop
        which = np.flatnonzero((some.times >= start - some.times[1]) & (some.times <= stop + some.times[1]))
        if which.size:
            problem = replace(problem, path=[(about(which, rng.uniform(0.7, 1.5)), float(start), float(stop))])
    return problem


def shape(rng: np.random.Generator, half_widths: np.ndarray, bounded: bool) -> Shape:
    """A set about 0 of about these half-widths."""
    d = len(half_widths)
    kind = rng.choice(["box", "box", "polytope", "ellipsoid", "norm"]) if d <= 3 else rng.choice(["box", "polytope"])
    if kind == "box":
        free = np.zeros(d, bool) if bounded else rng.random(d) < 0.3
        return Flat.box(np.where(free & ~free.all(), np.inf, half_widths))
    if kind == "polytope":
        H = np.vstack([np.eye(d), -np.eye(d), rng.normal(size=(2, d))])
        reach = np.abs(H[2 * d :]) @ half_widths
        return Flat(H, np.concatenate([half_widths, half_widths, reach * rng.uniform(0.5, 0.9, 2)]))
    if kind == "ellipsoid":
        turn = np.linalg.qr(rng.normal(size=(d, d)))[0]
        return Curved(d, 2.0, axes=half_widths[:, None] * turn)
    return Curved(d, float(rng.choice([1.0, 1.5, 2.0, 3.0, np.inf])), radius=float(half_widths.mean()))


def on_the_boundary(rng: np.random.Generator, share: float) -> Instance | None:
    """A known system between boxes whose terminal set is ``1 + share`` times the smallest one that can be reached."""
    problem = drawn(rng)
    K, m, d = len(problem.edges) - 1, len(problem.weights), len(problem.A)
    widths = rng.uniform(0.3, 1, d)
    noise = None if problem.disturbance is None else Flat.box(rng.uniform(0.002, 0.05, problem.E.shape[1]))
    control, end = Flat.box(rng.uniform(0.1, 0.6, m)), Flat.box(widths)
    problem = replace(problem, control=control, disturbance=noise, path=[], slopes=[], ends_at=None, terminal=[end])
    G, h = path_rows(problem, sample(problem, 1, np.zeros(0)), tight=False, spare=0.0)[1]
    answer = linprog(
        np.append(np.zeros(m * K), 1.0),
        np.hstack([G, -np.tile(widths, 2)[:, None]]),
        h - np.tile(widths, 2),
        bounds=[*((-b, b) for b in problem.bounds), (0, None)],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if answer.status != 0 or answer.fun < 1e-2:
        return None  # the origin is reached
    return replace(problem, terminal=[end.scaled(float(answer.fun) * (1 + share))])


TOGETHER = 1_000_000  # numbers of instances that may have every feature at once


def together(seed: int) -> tuple[Instance, Units]:
    """Initial states, another cost, what `in_time` and what `richer` draw, each or not, in one problem."""
    rng = np.random.default_rng([seed, 5])
    problem = drawn(rng)
    has = rng.random(4) < 0.6
    if has[0] and problem.ends_at is None:
        problem = replace(problem, initial_set=shape(rng, rng.uniform(0.002, 0.05, len(problem.A)), bounded=True))
    if has[1]:
        problem = richer(rng, problem)
    if has[2] and problem.ends_at is None:
        timed = in_time(rng, problem)  # an initial control other than 0 is no step from 0
        problem = timed if problem.step is None else replace(timed, late=0, before=None)
    units = drawn_units(rng, problem)
    if has[3]:
        problem = replace(problem, charge=charge(rng, *problem.B.shape))
        if problem.charge is not None and problem.charge.grouped:  # one weight and one unit for all of a group
            m = len(problem.weights)
            problem = replace(problem, weights=np.full(m, problem.weights[0]))
            units = replace(units, controls=np.full(m, units.controls[0]))
    return problem, units


FURTHER = 6 * TOGETHER  # numbers of instances with what `further` draws besides


def further(seed: int) -> tuple[Instance, Units]:
    """What `together` draws, with prices by piece, disturbances on pieces of their own, bounds of integrals, entries in
    ``t``, and a plan that begins again, each or not."""
    problem, units = together(seed)
    rng = np.random.default_rng([seed, 6])
    (d, m), K, has = problem.B.shape, len(problem.edges) - 1, rng.random(5) < 0.5
    if has[0] and not (problem.charge is not None and problem.charge.grouped):
        problem = replace(problem, prices=rng.uniform(0.5, 2, (m, K)) * problem.weights[:, None])
    if has[1] and problem.ends_at is None:
        problem = replace(problem, sources=tuple(_source(rng, d, K) for _ in range(int(rng.integers(1, 3)))))
    if has[2] and not problem.slopes:
        problem = replace(problem, waves=(0.2 * rng.normal(size=(d, d)), float(rng.uniform(0.5, 4))))
    if has[3] and problem.ends_at is None and problem.reference is None and problem.waves is None:
        problem = _again(rng, problem)
    if has[4] and not problem.repeat:
        problem = replace(problem, totals=_totals(rng, problem))
    return problem, units


def _source(rng: np.random.Generator, d: int, K: int) -> Source:
    q = int(rng.integers(1, d + 1))
    edges = np.unique(np.concatenate([[0, K], rng.integers(0, K + 1, 3)]))
    shape = Flat.box(rng.uniform(0.002, 0.05, q))
    return Source(rng.normal(size=(d, q)), shape, edges, 10.0 ** rng.uniform(-6, 6, q))


def _again(rng: np.random.Generator, problem: Instance) -> Instance:
    """A plan that begins again, near rest, from a set that a period may bring back."""
    more, d = rng.uniform(1.0, 4.0), len(problem.A)
    return replace(
        problem,
        repeat=True,
        initial_state=0.1 * problem.initial_state,
        initial_set=Flat.box(rng.uniform(0.1, 0.6, d)),
        late=0,
        before=None,
        terminal=[one.scaled(more) for one in problem.terminal],
        path=[(one.scaled(more), start, stop) for one, start, stop in problem.path],
    )


def _totals(rng: np.random.Generator, problem: Instance) -> Totals:
    """Bounds about what the integrals of no control are, which half of the controls keep or so."""
    (d, m), K, r = problem.B.shape, len(problem.edges) - 1, int(rng.integers(1, 3))
    first, last = np.sort(rng.choice(K + 1, 2, replace=False))
    H, G, free = rng.normal(size=(r, d)), rng.normal(size=(r, m)) * rng.choice([0.0, 1.0]), np.full(r, np.inf)
    G = 0.0 * G if problem.late else G  # what is commanded late never acts
    bare = Totals(H, G, int(first), int(last), -free, free)
    found = sample(replace(problem, totals=bare), 1, np.zeros(len(problem.slopes)))
    middle, reach = found.totals[0], np.abs(found.totals[1]) @ problem.bounds
    wide = rng.uniform(0.1, 0.7) * reach
    for noise in found.totals[2:-1]:
        wide = wide + 0.05 * np.abs(noise).sum(axis=(1, 2))
    wide = wide + 0.6 * np.abs(found.totals[-1]).sum(axis=1) * (problem.initial_set is not None)
    return replace(bare, lower=middle - np.where(rng.random(r) < 0.5, np.inf, wide), upper=middle + wide)


def instance(seed: int) -> tuple[Instance, Units]:
    """Number ``seed``: from `TOGETHER` on what `together` draws. Before, every tenth one on the boundary, feasible or
    infeasible by 1e-6; every third of the others from a set of initial states, every fourth with another cost than the
    L1 norm, and of the others every sixth with what `in_time` draws."""
    if seed >= TOGETHER:
        return further(seed) if seed >= FURTHER else together(seed)
    rng = np.random.default_rng(seed)
    problem = on_the_boundary(rng, 1e-6 if seed % 20 else -1e-6) if seed % 10 == 0 else None
    problem = problem if problem is not None else drawn(rng)
    if seed % 3 == 1 and seed % 10 and problem.ends_at is None:
        own = np.random.default_rng([seed, 1])  # the numbers of what was drawn before stay as they are
        widths = own.uniform(0.002, 0.05, len(problem.A))
        problem = replace(problem, initial_set=shape(own, widths, bounded=True))
    if seed % 6 == 3 and seed % 10:
        problem = richer(np.random.default_rng([seed, 4]), problem)
    units = drawn_units(rng, problem)
    if seed % 4 == 2 and seed % 10:
        own = np.random.default_rng([seed, 2])
        problem = replace(problem, charge=charge(own, *problem.B.shape))
        if problem.charge is not None and problem.charge.grouped:  # one weight and one unit for all of a group
            m = len(problem.weights)
            problem = replace(problem, weights=np.full(m, problem.weights[0]))
            units = replace(units, controls=np.full(m, units.controls[0]))
    if seed % 6 == 2 and seed % 10 and problem.ends_at is None and problem.charge is None:
        problem = in_time(np.random.default_rng([seed, 3]), problem)
    return problem, units


def charge(rng: np.random.Generator, d: int, m: int) -> Charge:
    """Some terms of a cost, semidefinite ones of any rank."""

    def some(size: int) -> np.ndarray:
        root = rng.normal(size=(size, int(rng.integers(1, size + 1))))
        return root @ root.T + 1e-6 * np.eye(size) if rng.random() < 0.5 else np.zeros((0, 0))

    found = Charge(Q=some(d), reference=0.3 * rng.normal(size=d), R=some(m), final=some(d))
    plain = not (found.Q.size or found.R.size or found.final.size)
    l1 = float(rng.choice([0.2, 1.0, 3.0] if plain else [0.0, 0.2, 1.0, 3.0]))
    return replace(found, l1=l1, grouped=bool(l1 and m > 1 and rng.random() < 0.5))


def in_time(rng: np.random.Generator, problem: Instance) -> Instance:
    """The same with a drift, a delay of whole pieces where these are equal, and a second mode, each or not."""
    (d, m), K = problem.B.shape, len(problem.edges) - 1
    if rng.random() < 0.6:
        problem = replace(problem, drift=rng.normal(size=d) * 0.03)
    if rng.random() < 0.5 and np.ptp(np.diff(problem.edges)) < 1e-12:
        problem = replace(problem, late=int(rng.integers(1, max(2, K // 3))), before=rng.normal(size=m) * 0.1)
    if rng.random() < 0.6:
        A, B = problem.A + 0.2 * rng.normal(size=(d, d)), problem.B * rng.uniform(0.7, 1.4)
        problem = replace(problem, second=(int(rng.integers(1, K)), A, B, rng.normal(size=d) * 0.02))
    return problem


def richer(rng: np.random.Generator, problem: Instance) -> Instance:
    """With a set that moves, bounds of state and control together, or bounded steps."""
    (d, m), K, edges = problem.B.shape, len(problem.edges) - 1, problem.edges
    kind = rng.choice(["moving", "mixed", "step"] if problem.path else ["mixed", "step"])
    if kind == "step":
        return replace(problem, step=shape(rng, rng.uniform(0.2, 1.0) * problem.control.support(np.eye(m)), True))
    reach = np.abs(sample(problem, 1, np.zeros(len(problem.slopes))).free).max(axis=0) + 0.1
    if kind == "moving":
        kept = np.unique(np.concatenate([[0, K], rng.integers(0, K + 1, 3)]))
        points = 0.2 * reach * rng.normal(size=(kept.size, d))
        return replace(problem, reference=np.hstack([edges[kept, None], points]))
    rows = int(rng.integers(1, 3))
    H, G = rng.normal(size=(rows, d)), rng.normal(size=(rows, m))
    h = rng.uniform(0.5, 1.2) * (np.abs(H) @ reach + np.abs(G) @ problem.control.support(np.eye(m)))
    first, last = np.sort(rng.choice(K, 2, replace=False))
    middle = (edges[:-1] + edges[1:]) / 2
    return replace(problem, mixed=(H, G, h, float(middle[first]), float(middle[last])))
