"""Random problems whose control answers what it measures, and what is true of them: linear programs, or programs over
cones, of a nominal control and its answers, sampled on fine grids of time. Nothing of the package is used.

What a policy may answer to is what it measures beyond what the same control gives without any disturbance, deviation
and noise (purified outputs): all affine policies of the outputs are affine in them. Where the memory is short, a policy
acts through its effects instead: how the control on piece ``k`` depends on the disturbance of the pieces before it.
There every disturbance of a piece can be told from the state at its end, so that they may be any numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import clarabel
import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array, csc_matrix, csr_array

from tests.support.instances import (
    TOGETHER,
    Curved,
    Flat,
    Instance,
    Sampled,
    Shape,
    Units,
    charge,
    config,
    drawn,
    drawn_units,
    in_time,
    over_cones,
    quadratic,
    richer,
    sample,
)

FURTHER = 6 * TOGETHER  # numbers of policies with one of `KINDS` among their features
KINDS = ("worst", "fixed", "repeat", "worst", "repeat")  # by the last digit
ROUND = 5 * TOGETHER  # numbers of policies among whose sets of deviations there are ellipsoids
LARGER = 2.0  # times the disturbance that open loops are tested with
PER_PIECE = 8
AT_ONCE = 80  # rows that are imposed where they are violated
MAX_ANSWERED = 7  # deviations that are answered, of which all corners are looked at
MET = 1e-9  # a row that is violated by less is met


@dataclass(frozen=True)
class Outputs:
    """``C x`` with noises within ``noise (p,)``, known ``late`` pieces later; ``latency`` in pieces, not more."""

    C: np.ndarray
    noise: np.ndarray
    latency: float

    @property
    def late(self) -> int:
        return int(np.ceil(self.latency - 1e-9))


@dataclass(frozen=True)
class Answered:
    """A problem, its units, what its policy is charged, for how many pieces it answers (0: for ever), and its outputs
    with what one of each is in the user's units, where these are not the state. ``repeat``: it begins again at the
    horizon."""

    problem: Instance
    units: Units
    cost: str
    lag: int
    outputs: Outputs | None = None
    scale: np.ndarray | None = None
    repeat: bool = False

    def config(self) -> dict[str, Any]:
        """In the user's units."""
        step = float(self.problem.edges[1] * self.units.time)
        policy = {"name": "affine", "cost": self.cost, "causal_signals": 4}
        memory = {"memory": self.lag * step} if self.lag else {}
        stated = {**config(self.problem, self.units), "policy": {**policy, **memory}}
        if self.repeat:
            stated["problem"]["repeat"] = True
        if self.outputs is not None:
            assert self.scale is not None
            seen: dict[str, Any] = {"C": (self.scale[:, None] * self.outputs.C / self.units.states).tolist()}
            if self.outputs.noise.any():
                seen["noise"] = {"box": (self.scale * self.outputs.noise).tolist()}
            stated["problem"]["measurements"] = {**seen, "latency": self.outputs.latency * step}
        return stated


def answered(number: int) -> Answered:
    """The instance of a number: a known system between flat sets under a box of disturbances, equal pieces; from
    `TOGETHER` on with all features that a policy may have, each or not (`together`)."""
    if number >= TOGETHER:
        return further(number) if number >= FURTHER else together(number)
    rng = np.random.default_rng([number, 39])
    while True:
        problem = drawn(rng)
        K, shapes = len(problem.edges) - 1, [*problem.terminal, *(one for one, _, _ in problem.path), problem.control]
        plain = problem.dictionary == "piecewise_constant" and np.ptp(np.diff(problem.edges)) < 1e-12
        flat = all(isinstance(one, Flat) for one in shapes)
        if plain and flat and 4 <= K <= 8 and problem.ends_at is None and not problem.slopes and problem.terminal:
            break
    width = LARGER * rng.uniform(0.002, 0.05, problem.E.shape[1])
    problem = replace(problem, disturbance=Flat.box(width))
    cost, lag = str(rng.choice(["nominal", "peak"])), int(rng.choice([0, 0, 1, 3]))
    return Answered(problem, drawn_units(rng, problem), cost, lag)


def together(number: int) -> Answered:
    """Initial states, drift, delay, two modes, moving and mixed walls, steps, squares and groups, outputs with noise
    and latency, unequal pieces and waves, curved controls, each or not, in one problem."""
    rng = np.random.default_rng([number, 40])
    while True:
        problem = drawn(rng)
        K, d = len(problem.edges) - 1, len(problem.A)
        flat = all(isinstance(one, Flat) for one in [*problem.terminal, *(one for one, _, _ in problem.path)])
        if flat and 3 <= K <= 8 and d <= 3 and problem.ends_at is None and not problem.slopes and problem.terminal:
            break
    m, equal = len(problem.weights), np.ptp(np.diff(problem.edges)) < 1e-12
    has = rng.random(6) < 0.5
    problem = replace(problem, disturbance=Flat.box(LARGER * rng.uniform(0.002, 0.05, problem.E.shape[1])))
    if has[0]:
        problem = replace(problem, initial_set=Flat.box(rng.uniform(0.002, 0.05, d)))
    if has[1]:
        problem = richer(rng, problem)
    if has[2]:
        timed = in_time(rng, problem)  # an initial control other than 0 is no step from 0
        problem = timed if problem.step is None else replace(timed, late=0, before=None)
    problem = rounder(number, problem)
    units, cost = drawn_units(rng, problem), str(rng.choice(["nominal", "peak"]))
    if has[3]:
        problem = replace(problem, charge=charge(rng, d, m))
        if problem.charge is not None and problem.charge.grouped:  # one weight and one unit for all of a group
            problem, cost = replace(problem, weights=np.full(m, problem.weights[0])), "nominal"
            units = replace(units, controls=np.full(m, units.controls[0]))
    outputs, scale, lag = None, None, 0
    if has[4]:
        p = int(rng.integers(1, d + 1))
        noise = rng.uniform(0.001, 0.02, p) * rng.choice([0.0, 1.0], p=[0.3, 0.7])
        outputs = Outputs(rng.normal(size=(p, d)), noise, float(rng.choice([0.0, 0.5, 1.0])) if equal else 0.0)
        scale = 10.0 ** rng.uniform(-6, 6, p)
    elif has[5] and equal and problem.dictionary == "piecewise_constant":
        lag = int(rng.integers(1, 4))
    return Answered(problem, units, cost, lag, outputs, scale)


def _fits(problem: Instance, kind: str) -> bool:
    """Whether an instance can have a feature of `KINDS`, and a truth of a size that is solved in seconds."""
    K, d = len(problem.edges) - 1, len(problem.A)
    if problem.dictionary != "piecewise_constant" or problem.slopes or d > 3:
        return False
    flat = all(isinstance(one, Flat) for one in [*problem.terminal, *(one for one, _, _ in problem.path)])
    if kind == "fixed":
        return K <= 8 and flat and problem.ends_at is not None
    small = {"worst": K <= 5, "repeat": K <= 8}[kind]
    return small and flat and problem.ends_at is None and bool(problem.terminal)


def _fuller(rng: np.random.Generator, problem: Instance, kind: str, has: np.ndarray) -> Instance:
    """With what `richer` and `in_time` draw, as far as it stands beside a feature of `KINDS`."""
    if has[1]:
        fuller = richer(rng, problem)
        problem = problem if kind == "repeat" and fuller.step is not None else fuller
    if has[2]:
        timed = in_time(rng, problem)
        early = problem.step is not None or kind == "repeat"  # of a plan that repeats steps go on across the seam
        problem = replace(timed, late=0, before=None) if early else timed
    return problem


def further(number: int) -> Answered:
    """One of `KINDS` in turn: a cost of the largest effort, fixed final states, a plan that begins again;
    beside it what `together` draws, as far as the truth is a program."""
    rng, kind = np.random.default_rng([number, 42]), KINDS[number % len(KINDS)]
    problem = drawn(rng)
    while not _fits(problem, kind):
        problem = drawn(rng)
    (d, m), has = problem.B.shape, rng.random(6) < 0.5
    if kind == "worst":
        problem = replace(problem, E=problem.E[:, :1])
    if kind == "fixed":
        problem = replace(problem, disturbance=None)  # it would reach what is fixed
    else:
        width = LARGER * rng.uniform(0.002, 0.05, problem.E.shape[1]) * (0.5 if kind == "repeat" else 1.0)
        problem = replace(problem, disturbance=Flat.box(width))
    if kind == "repeat":
        wide, more = Flat.box(rng.uniform(0.1, 0.6, d)), rng.uniform(1.0, 4.0)
        problem = replace(
            problem,
            initial_state=0.1 * problem.initial_state,
            initial_set=wide,
            terminal=[one.scaled(more) for one in problem.terminal],
            path=[(one.scaled(more), start, stop) for one, start, stop in problem.path],
        )
    elif has[0] or kind == "fixed":
        problem = replace(problem, initial_set=Flat.box(rng.uniform(0.002, 0.05, d)))
    problem = _fuller(rng, problem, kind, has)
    cost = "worst" if kind == "worst" else str(rng.choice(["nominal", "peak"]))
    if has[3]:
        problem = replace(problem, charge=replace(charge(rng, d, m), grouped=False))
    units, outputs, scale = drawn_units(rng, problem), None, None
    if has[4] and kind != "worst":
        p = int(rng.integers(1, d + 1))
        noise = rng.uniform(0.001, 0.02, p) * (rng.random() < 0.5 and kind != "fixed")
        outputs, scale = Outputs(rng.normal(size=(p, d)), noise, 0.0), 10.0 ** rng.uniform(-6, 6, p)
    return Answered(problem, units, cost, 0, outputs, scale, kind == "repeat")


def rounder(number: int, problem: Instance) -> Instance:
    """From `ROUND` on with ellipsoids for the boxes of the disturbance and the initial states, each or not."""
    rng = np.random.default_rng([number, 41])  # the numbers of what was drawn before stay as they are

    def turned(shape: Shape, size: int) -> Shape:
        axes = shape.support(np.eye(size))[:, None] * np.linalg.qr(rng.normal(size=(size, size)))[0]
        return Curved(size, 2.0, axes=axes)

    has, (d, q) = (rng.random(2) < 0.4) & (number >= ROUND), problem.E.shape
    if has[0] and q > 1 and problem.disturbance is not None:
        problem = replace(problem, disturbance=turned(problem.disturbance, q))
    if has[1] and d > 1 and problem.initial_set is not None:
        problem = replace(problem, initial_set=turned(problem.initial_set, d))
    return problem


@dataclass(frozen=True)
class _Row:
    """``on_v'u + own'z <= limit`` for every deviation ``z``, or no more than the variable ``top``."""

    on_v: np.ndarray
    own: np.ndarray
    limit: float
    top: int | None = None


class _Program:
    """A program that grows: variables with prices and bounds, sparse rows ``<=``, squares of the first ones, and norms
    of some of them below others."""

    def __init__(self) -> None:
        self.prices: list[float] = []
        self.bounds: list[tuple[float | None, float | None]] = []
        self.rows: list[tuple[np.ndarray, np.ndarray]] = []
        self.limits: list[float] = []
        self.P, self.constant, self.size = np.zeros((0, 0)), 0.0, 1.0
        self.norms: list[tuple[np.ndarray, int]] = []

    def variables(self, count: int, price: float = 0.0, low: float | None = None) -> np.ndarray:
        first = len(self.prices)
        self.prices += [price] * count
        self.bounds += [(low, None)] * count
        return np.arange(first, first + count)

    def row(self, where: np.ndarray, values: np.ndarray, limit: float) -> None:
        self.rows.append((where, values))
        self.limits.append(limit)

    def least(self) -> tuple[float, np.ndarray]:
        """The optimal value with its variables, ``inf`` where nothing is feasible."""
        number = np.repeat(np.arange(len(self.rows)), [len(where) for where, _ in self.rows])
        where, values = (np.concatenate([one[part] for one in self.rows]) for part in (0, 1))
        table = coo_array((values, (number, where)), shape=(len(self.rows), len(self.prices))).tocsr()
        if self.P.any() or self.norms:
            return self._over_cones(table)
        done = linprog(self.prices, table, self.limits, bounds=self.bounds, method="highs")
        if done.status not in (0, 2):
            raise ArithmeticError(done.message)
        return (float(done.fun) + self.constant, done.x) if done.status == 0 else (np.inf, np.zeros(0))

    def _over_cones(self, table: csr_array) -> tuple[float, np.ndarray]:
        n = len(self.prices)
        ends = [
            (sign, i, sign * end)
            for i, sides in enumerate(self.bounds)
            for sign, end in zip((-1.0, 1.0), sides, strict=True)
            if end is not None
        ]
        sides = coo_array(
            ([sign for sign, _, _ in ends], (np.arange(len(ends)), [i for _, i, _ in ends])), shape=(len(ends), n)
        )
        blocks, right = [table.tocoo(), sides], [*self.limits, *(end for _, _, end in ends)]
        cones: list[Any] = [clarabel.NonnegativeConeT(len(right))]
        for places, top in self.norms:
            at = np.append(top, places)
            blocks.append(coo_array((-np.ones(at.size), (np.arange(at.size), at)), shape=(at.size, n)))
            right += [0.0] * at.size
            cones.append(clarabel.SecondOrderConeT(at.size))
        heights = np.cumsum([0, *(block.shape[0] for block in blocks)])
        stacked = csc_matrix(
            coo_array(
                (
                    np.concatenate([block.data for block in blocks]),
                    (
                        np.concatenate([block.row + at for block, at in zip(blocks, heights, strict=False)]),
                        np.concatenate([block.col for block in blocks]),
                    ),
                ),
                shape=(int(heights[-1]), n),
            )
        )
        whole = np.zeros((n, n))
        whole[: len(self.P), : len(self.P)] = self.P
        answer = over_cones(
            csc_matrix(np.triu(whole)) / self.size, np.array(self.prices) / self.size, stacked, np.array(right), cones
        )
        if answer is None:
            return np.inf, np.zeros(0)
        return answer.obj_val * self.size + self.constant, np.array(answer.x)


def truth_answered(one: Answered) -> tuple[float, float]:
    """Two values that enclose the optimal cost of affine policies: constraints at the samples alone, and with room for
    what lies between them."""
    some = sample(one.problem, PER_PIECE, np.zeros(0))
    lower = _sampled(one, some, False)
    return (lower, lower) if np.isinf(lower) else (lower, _sampled(one, some, True))


def _sampled(one: Answered, some: Sampled, tight: bool) -> float:
    policy = _Policy(one, some)
    always = [*_control_rows(one.problem, tight, policy.still), *policy.charged(one.cost)]
    sought = list[_Row]()
    for shape, start, stop in one.problem.path:
        inside, room = np.flatnonzero((some.times >= start - 1e-12) & (some.times <= stop + 1e-12)), 0.0 * some.sag
        if tight:  # with one more time on either side, the chords cover the whole window
            first, last = np.searchsorted(some.times, [start, stop], side="right")
            inside, room = np.arange(max(first - 1, 0), min(last + 1, len(some.times))), some.sag
        sought += _state_rows(policy, shape, inside, room, tight, one.problem.reference)
    for shape in one.problem.terminal:
        always += _state_rows(policy, shape, np.array([len(some.times) - 1]), 0.0 * some.sag, tight, None)
    if one.repeat:
        assert one.problem.initial_set is not None
        begun = np.append(0.0, one.problem.initial_state)[None]
        always += _state_rows(
            policy, one.problem.initial_set, np.array([len(some.times) - 1]), 0.0 * some.sag, tight, begun
        )
    if one.problem.ends_at is not None:
        policy.fix(one.problem.ends_at)
    if one.problem.mixed is not None:
        sought += _mixed_rows(policy, one.problem, some.sag if tight else 0.0 * some.sag)
    return policy.least(always, sought)


def _state_rows(
    policy: _Policy, shape: Shape, which: np.ndarray, room: np.ndarray, tight: bool, reference: np.ndarray | None
) -> list[_Row]:
    """``x`` at these samples in a set, about a reference where there is one."""
    some, found = policy.some, list[_Row]()
    H, h, inside = shape.rows()
    h = h * (inside if tight else 1.0)
    for j, (c, b) in product(which, zip(H, h, strict=True)):
        limit = float(b - np.abs(c) @ room - c @ some.free[j])
        if reference is not None:
            at, *points = reference.T
            limit += float(c @ [np.interp(some.times[j], at, column) for column in points])
        found.append(_Row(c @ some.response[j], policy.own(c, j), limit))
    return found


def _mixed_rows(policy: _Policy, problem: Instance, room: np.ndarray) -> list[_Row]:
    """Bounds of state and control together; both ends of a piece are looked at with its own control."""
    assert problem.mixed is not None
    (H, G, h, start, stop), some, K = problem.mixed, policy.some, len(problem.edges) - 1
    found = list[_Row]()
    for k in range(K):
        low, high = max(start, problem.edges[k]), min(stop, problem.edges[k + 1])
        if low >= high:
            continue
        for j in np.flatnonzero((some.times >= low - 1e-9) & (some.times <= high + 1e-9)):
            for c, g, b in zip(H, G, h, strict=True):
                on_v = c @ some.response[j] + np.kron(g, np.eye(K)[k])
                found.append(_Row(on_v, policy.own(c, j), float(b - np.abs(c) @ room - c @ some.free[j])))
    return found


def _control_rows(problem: Instance, tight: bool, still: np.ndarray) -> list[_Row]:
    """The control and its steps in their sets."""
    K, found = len(problem.edges) - 1, list[_Row]()
    steps = np.eye(K) - np.eye(K, k=-1)  # the first is from 0
    for shape, pieces in ((problem.control, np.eye(K)), (problem.step, steps)):
        if shape is None:
            continue
        H, h, inside = shape.rows()
        for piece, (c, b) in product(pieces, zip(H, h * (inside if tight else 1.0), strict=True)):
            found.append(_Row(np.kron(c, piece), still, float(b)))
    return found


class _Policy:
    """A nominal control ``v (m K,)``, channel by channel, and for each of the deviations (the disturbance on every
    piece, the initial state, the noise of every output) how the control answers it: a matrix ``(m K, gains)``."""

    def __init__(self, one: Answered, some: Sampled) -> None:
        problem = self.problem = one.problem
        self.some, self.program = some, _Program()
        m, (d, q), K, S = len(problem.weights), problem.E.shape, len(problem.edges) - 1, some.noise.shape[3]
        pushed = np.zeros(q) if problem.disturbance is None else problem.disturbance.support(np.eye(q))
        seen = Outputs(np.eye(d), np.zeros(d), 0.0) if one.outputs is None else one.outputs
        p = len(seen.C)
        begun = np.zeros(d) if problem.initial_set is None else problem.initial_set.support(np.eye(d))
        noisy = np.tile(seen.noise, K)
        self.radii = np.concatenate([np.repeat(pushed, S), begun, noisy])
        self.still = np.zeros(self.radii.size)
        self.blocks = [(np.array([z]), np.eye(1) * self.radii[z]) for z in np.flatnonzero(self.radii)]
        places = [*(np.arange(piece, q * S, S) for piece in range(S)), q * S + np.arange(d)]
        for block, shape in zip(places, [*[problem.disturbance] * S, problem.initial_set], strict=True):
            if isinstance(shape, Curved):
                assert shape.axes is not None
                self.blocks = [one for one in self.blocks if one[0][0] not in block]
                self.blocks.append((block, shape.radius * shape.axes))
        self.v = self.program.variables(m * K)
        for i, side in zip(self.v, problem.sides.T, strict=True):
            self.program.bounds[i] = (-side[1], side[0])
        purified = np.zeros((K, p, self.radii.size))
        for j in range(K):
            at = j * PER_PIECE
            purified[j, :, : q * S] = seen.C @ some.noise[at].reshape(d, q * S)
            purified[j, :, q * S : q * S + d] = seen.C @ some.flow[at]
            purified[j, :, q * S + d + j * p : q * S + d + (j + 1) * p] = np.eye(p)
        entries = list[tuple[int, int, float]]()  # of the control, of the deviation, how much; one list for each gain
        gains = list[list[tuple[int, int, float]]]()
        for k, i in product(range(K), range(m)):
            if one.lag:
                names = [a * K + piece for piece in range(max(0, k - 1 - one.lag), k) for a in range(q)]
                names += [q * K + a for a in range(d)] if k <= one.lag else []
                gains += [[(i * K + k, name, 1.0)] for name in names if self.radii[name]]
                continue
            for j, o in product(range(k - seen.late + 1), range(p)):
                entries = [(i * K + k, int(z), float(purified[j, o, z])) for z in np.flatnonzero(purified[j, o])]
                gains.append([entry for entry in entries if self.radii[entry[1]]])
        gains = [one for one in gains if one]
        self.gains = self.program.variables(len(gains))
        flat = [(z, u, g, value) for g, parts in enumerate(gains) for u, z, value in parts]
        self.answers = [csr_array((m * K, len(gains))) for _ in self.radii]
        for name in {z for z, *_ in flat}:
            mine = [(u, g, value) for z, u, g, value in flat if z == name]
            u, g, value = (np.array(part) for part in zip(*mine, strict=True))
            self.answers[name] = csr_array(coo_array((value, (u, g)), shape=(m * K, len(gains))))

    def own(self, c: np.ndarray, j: int) -> np.ndarray:
        """What ``c'x`` at a sample has of every deviation without an answer."""
        found = self.still.copy()
        pushed = np.einsum("d,dqk->qk", c, self.some.noise[j]).ravel()
        found[: pushed.size] = pushed
        found[pushed.size : pushed.size + c.size] = c @ self.some.flow[j]
        return found

    def fix(self, ends: np.ndarray) -> None:
        """The final state where it is a number, whatever deviates."""
        last = len(self.some.times) - 1
        for i in np.flatnonzero(np.isfinite(ends)):
            on_v, own = self.some.response[last, i], self.own(np.eye(ends.size)[i], last)
            needed = [(self.v, on_v, float(ends[i] - self.some.free[last, i]))]
            needed += [(self.gains, on_v @ self.answers[z], float(-own[z])) for z in np.flatnonzero(self.radii)]
            for places, values, level in needed:
                for sign in (1.0, -1.0):
                    self.program.row(places[values != 0.0], sign * values[values != 0.0], sign * level)

    def _worst(self) -> None:
        """The largest effort, by every corner of what is answered."""
        answered = [z for z in np.flatnonzero(self.radii) if self.answers[z].nnz]
        assert len(answered) <= MAX_ANSWERED
        (top,) = self.program.variables(1, 1.0, 0.0)
        for signs in product((1.0, -1.0), repeat=len(answered)):
            corner = sum(
                (sign * self.radii[z] * self.answers[z] for sign, z in zip(signs, answered, strict=True)),
                0.0 * self.answers[0],
            ).toarray()
            efforts = self.program.variables(self.v.size, low=0.0)
            for i, effort in enumerate(efforts):
                used = np.flatnonzero(corner[i])
                for sign in (1.0, -1.0):
                    places = np.array([self.v[i], *self.gains[used], effort])
                    self.program.row(places, np.array([sign, *(sign * corner[i, used]), -1.0]), 0.0)
            self.program.row(np.append(efforts, top), np.append(self.problem.price, -1.0), 0.0)

    def impose(self, row: _Row) -> None:
        where = np.flatnonzero(row.on_v)
        tops = list[int]()
        for block, axes in self.blocks:
            answers = axes.T @ np.stack([row.on_v @ self.answers[z] for z in block])
            own = axes.T @ row.own[block]
            if not (answers.any() or own.any()):
                continue
            (top,) = self.program.variables(1, low=0.0)
            tops.append(int(top))
            sizes = [int(top)] if len(block) == 1 else self.program.variables(len(block)).tolist()
            for answer, alone, size in zip(answers, own, sizes, strict=True):
                used = np.flatnonzero(answer)
                for sign in (1.0, -1.0):  # above both, or equal to the one
                    other = -1.0 if len(block) == 1 else -sign
                    places = np.append(self.gains[used], size)
                    self.program.row(places, np.append(sign * answer[used], other), float(-sign * alone))
            if len(block) > 1:
                self.program.norms.append((np.array(sizes), int(top)))
        more = [] if row.top is None else [row.top]
        at = np.concatenate([self.v[where], np.array([*tops, *more], dtype=int)])
        self.program.row(at, np.concatenate([row.on_v[where], np.ones(len(tops)), [-1.0] * len(more)]), row.limit)

    def charged(self, cost: str) -> list[_Row]:
        """Prices and squares of the nominal control, or of the largest that deviations make of it."""
        problem, K, found = self.problem, len(self.problem.edges) - 1, list[_Row]()
        if problem.charge is not None:
            self.program.size = problem.largest
            P, q, self.program.constant = quadratic(problem)
            self.program.P = P
            for i, price in zip(self.v, q, strict=True):
                self.program.prices[i] = float(price)
            if problem.charge.grouped:
                for k, top in enumerate(self.program.variables(K, low=0.0)):
                    self.program.prices[top] = float(problem.price[k])
                    self.program.norms.append((self.v[k::K], int(top)))
                return found
        if cost == "worst":
            self._worst()
            return found
        tops = self.program.variables(self.v.size, low=0.0)
        for i, (price, top) in enumerate(zip(problem.price, tops, strict=True)):
            self.program.prices[top] = float(price)
            for sign in (1.0, -1.0):
                if cost == "peak":
                    found.append(_Row(sign * np.eye(self.v.size)[i], self.still, 0.0, int(top)))
                else:
                    self.program.row(np.array([self.v[i], top]), np.array([sign, -1.0]), 0.0)
        return found

    def least(self, always: list[_Row], sought: list[_Row]) -> float:
        """The least cost; of what is ``sought`` the rows that are violated are imposed."""
        for row in always:
            self.impose(row)
        while True:
            value, x = self.program.least()
            if np.isinf(value) or not sought:
                return value
            v, gains = x[self.v], x[self.gains]
            U = np.stack([answer @ gains for answer in self.answers])  # (deviations, m K)
            on_v, own = np.stack([row.on_v for row in sought]), np.stack([row.own for row in sought])
            over = on_v @ v - np.array([row.limit for row in sought])
            for block, axes in self.blocks:
                over += np.linalg.norm((own + on_v @ U.T)[:, block] @ axes, axis=1)
            worst = np.argsort(-over)[:AT_ONCE]
            worst = worst[over[worst] > MET]
            if not worst.size:
                return value
            for place in worst:
                self.impose(sought[place])
            kept = np.delete(np.arange(len(sought)), worst)
            sought = [sought[place] for place in kept]
