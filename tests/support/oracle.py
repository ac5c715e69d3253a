"""One oracle for every config: a lower and an upper value of its cost by linear programs on samples.

Read from the package are the records that a config states: matrices at a time and a parameter, sets, windows, values of
a dictionary. Everything else is written anew. The plant is integrated step by step with `scipy.linalg.expm` (Magnus'
method of the fourth order where it changes with time), the programs are solved by HiGHS.

**Lower value.** A relaxation: every constraint is imposed at a sample of times, parameters, directions of curved sets
and sources, and costs that are no sums of absolute values are replaced by tangents below them. Measurable disturbances
and errors of execution are sampled as functions that are constant on the steps between two times. No control that keeps
the constraints costs less, but for the tolerance of the programs.

**Upper value.** The cost of a control that was found by the same program with every bound tightened by `TIGHT`, and
that keeps all constraints on a sample four times as fine. Where it does not, the program on the finer sample is solved,
with every bound tightened by `BETWEEN`, which is more than what happens between two of its times. On every step of it
measurable disturbances and errors of execution add the larger of two values: what the best constant function adds, and
what the trapezoidal rule says of the best function.

**Under feedback** (`affine`) both are programs of nominal controls and answers. The lower one answers every source once
its piece is over: a relaxation of every policy of this form, also of one that measures less. The upper one answers the
same, or nothing where the policy measures outputs. The cost ``worst`` lies between those of ``nominal`` and ``peak``.
Where a program has not all of its rows after `ANSWERED` rounds, its value is still a lower one, and there is no upper
one.

A cost that is the time of action (`sparsest`) is a program in integers on the same samples.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, singledispatch
from pathlib import Path
from typing import Any

import clarabel
import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog
from scipy.sparse import csc_array

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.windows import MixedConstraint
from sparserob_core.control.sets.budget import BudgetedBox
from sparserob_core.control.sets.curved import Ellipsoid, NormBall
from sparserob_core.control.sets.polytope import Polytope
from sparserob_core.control.sets.sets import Box, Product
from sparserob_core.control.sets.zonotope import Zonotope
from sparserob_core.experiment.assemble import control_problem_of, counting, dictionaries_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.convex_set import ConvexSet

Array = np.ndarray
TIGHT, BETWEEN = 1e-6, 1e-4
"""Shares of the largest bound of its set by which a bound is tightened: more than HiGHS misses it by; and than a curve
rises between samples, `(T / 192)^2 / 8` times its second derivative, and a circle between two of 256 tangents."""
STEPS, DIRECTIONS, PARAMETERS = 48, 64, {1: 7, 2: 4, 3: 3}
"""Steps of the horizon, directions of a curved set, and values of each parameter by their number, at least."""
FINER = 4
SOLVED = 1e-9  # the tolerance that HiGHS is given; ten times smaller is refused
KEPT = 1e-7  # of a bound, by how much a row may be missed that is not imposed; ten times more is seen in a cost
INTEGER = 5e-6  # the same of a program in integers, whose values HiGHS rounds by about as much
ROUNDS, CUTS = 400, 60  # of a program whose rows are added as they are violated, and rows at once
ANSWERED = 100  # such rounds under feedback: where many policies cost the same, each row is met by another one
AGREED = 2e-6  # of a cost: `KEPT` times the multipliers of rows, some ten in sum; with ten times more much is missed
NEAR = 1e-7  # of a cost: tangents of its curved terms are added until they are as near as this


@singledispatch
def support_point(convex: ConvexSet, c: Array) -> Array:
    """A point of a set that is farthest in each of the directions ``(k, d)``."""
    raise NotImplementedError(f"no oracle for {convex.kind}")


@support_point.register
def _(convex: Box, c: Array) -> Array:
    return np.where(c > 0.0, convex.upper, convex.lower)


@support_point.register
def _(convex: Ellipsoid, c: Array) -> Array:
    size = np.sqrt(np.einsum("...i,ij,...j", c, convex.shape, c))[..., None]
    return convex.centre + c @ convex.shape / np.where(size > 0.0, size, 1.0)


@support_point.register
def _(convex: NormBall, c: Array) -> Array:
    p = convex.p
    if p == np.inf or convex.radius == 0.0:
        return convex.centre + convex.radius * np.sign(c)
    if p == 1.0:
        largest = np.arange(c.shape[-1]) == np.abs(c).argmax(axis=-1)[..., None]
        return convex.centre + convex.radius * np.sign(c) * largest
    dual = np.sign(c) * np.abs(c) ** (1.0 / (p - 1.0))
    size = (np.abs(dual) ** p).sum(axis=-1, keepdims=True) ** (1.0 / p)
    return convex.centre + convex.radius * dual / np.where(size > 0.0, size, 1.0)


@support_point.register
def _(convex: Zonotope, c: Array) -> Array:
    return convex.centre + np.sign(c @ convex.generators.T) @ convex.generators


@support_point.register
def _(convex: Polytope, c: Array) -> Array:
    corners = vertices(convex.H, convex.h)
    return corners[(c @ corners.T).argmax(axis=-1)]


@support_point.register
def _(convex: Product, c: Array) -> Array:
    ends = np.cumsum([one.dimension for one in convex.parts])[:-1]
    parts = zip(convex.parts, np.split(c, ends, axis=-1), strict=True)
    return np.concatenate([support_point(one, part) for one, part in parts], axis=-1)


@dataclass(frozen=True)
class Signals:
    """Signals ``(n mw,)`` on pieces of such ``lengths``, piece after piece, in a box with a budget."""

    values: BudgetedBox
    lengths: Array

    @property
    def dimension(self) -> int:
        return self.values.dimension * self.lengths.size


@support_point.register
def _(convex: Signals, c: Array) -> Array:
    """By linear programs of the positive and the negative part, or by cones."""
    box, radii = convex.values, np.tile(convex.values.upper, convex.lengths.size)
    costs = np.repeat(convex.lengths, box.dimension)
    points = []
    for row in c.reshape(-1, convex.dimension):
        size = float(np.abs(row).max(initial=0.0)) or 1.0
        if box.p == 1:
            bounds = list(zip(np.zeros(2 * radii.size), np.tile(radii, 2), strict=True))
            parts = linprog(np.append(-row, row) / size, np.append(costs, costs)[None], [box.size], bounds=bounds).x
            points.append(parts[: radii.size] - parts[radii.size :])
        else:
            eye = np.eye(radii.size)
            G = csc_array(np.vstack([eye, -eye, np.zeros((1, radii.size)), -np.diag(np.sqrt(costs))]))
            h = np.concatenate([radii, radii, [np.sqrt(box.size)], np.zeros(radii.size)])
            cones = [clarabel.NonnegativeConeT(2 * radii.size), clarabel.SecondOrderConeT(1 + radii.size)]
            settings = clarabel.DefaultSettings()
            settings.verbose = False
            nothing = csc_array((radii.size, radii.size))
            points.append(clarabel.DefaultSolver(nothing, -row / size, G, h, cones, settings).solve().x)
    return np.array(points).reshape(c.shape)


def vertices(H: Array, h: Array) -> Array:
    """The corners of a bounded polytope in few dimensions: every choice of as many sides that meet in one of its
    points."""
    found = []
    for sides in itertools.combinations(range(len(h)), H.shape[1]):
        rows = H[list(sides)]
        if abs(np.linalg.det(rows)) > 1e-12:
            point = np.linalg.solve(rows, h[list(sides)])
            if (H @ point <= h + 1e-9 * (1.0 + np.abs(h))).all():
                found.append(point)
    return np.array(found)


def support(convex: ConvexSet, c: Array) -> Array:
    """The support function of a set in directions ``(..., d)``."""
    return np.einsum("...i,...i", c, support_point(convex, c))


def middle(convex: ConvexSet) -> Array:
    """The middle of the bounding box of a set, which must hold it: the point of the nominal trajectory."""
    axes = np.eye(convex.dimension)
    return (support(convex, axes) - support(convex, -axes)) / 2


def sides(convex: ConvexSet, directions: int) -> tuple[Array, Array]:
    """Rows ``H x <= h``: those of a flat set, else of a sample of directions."""
    flat = convex.halfspaces()
    if flat is not None:
        return np.asarray(flat[0]), np.asarray(flat[1])
    if convex.dimension == 2:
        angle = 2 * np.pi * np.arange(directions) / directions
        H = np.column_stack([np.cos(angle), np.sin(angle)])
    else:
        H = np.random.default_rng(1).standard_normal((directions * convex.dimension, convex.dimension))
        H = np.vstack([np.eye(convex.dimension), -np.eye(convex.dimension), H])
        H /= np.linalg.norm(H, axis=1, keepdims=True)
    return H, support(convex, H)


@dataclass(frozen=True)
class Source:
    """What is uncertain and enters by columns of the inputs: its set, its ``pieces``, the number of one for every step,
    or ``None`` where it is measurable, and from which piece of the control on each is ``known``."""

    columns: slice
    bound: ConvexSet
    pieces: Array | None
    known: Array
    lengths: Array | None = None  # of the pieces, where a budget couples them


@dataclass
class Rows:
    """``constant + on_u u + on_size s + sources <= bound``, ``(R, ...)``, with ``s`` the absolute values of the control
    and of its changes: of blocks the effects ``(R, q)`` on the
    coordinates of each, of other sources the most that they add (``added``)."""

    on_u: Array
    on_size: Array
    constant: Array
    added: Array
    blocks: list[Array]
    bound: Array
    size: Array

    @staticmethod
    def joined(parts: list[Rows]) -> Rows:
        """All of them in one."""
        stacked = {
            name: np.concatenate([getattr(one, name) for one in parts])
            for name in ("on_u", "on_size", "constant", "added", "bound", "size")
        }
        blocks = [np.concatenate(every) for every in zip(*(one.blocks for one in parts), strict=True)]
        return Rows(blocks=blocks, **stacked)


@dataclass
class Plan:
    """A problem on a grid of times: what its config states, and how fine the samples are."""

    problem: OptimalControlProblem
    breakpoints: Array
    values: Array
    of_disturbance: Array
    finer: int
    charge: str | None = None
    above: bool = False
    times: Array = field(init=False)

    def __post_init__(self) -> None:
        problem, T = self.problem, self.problem.horizon
        delay, own = problem.system.delay, problem.disturbance_breakpoints or ()
        ends = [0.0, T, *self.breakpoints, *(self.breakpoints + delay), *self.of_disturbance]
        ends += (self.breakpoints + problem.jitter).tolist()
        ends += [phase.begin for phase in problem.system.phases]
        for one in (*problem.windows, *problem.integral):
            ends += [one.start, float(one.stop or 0.0)]
            ends += [] if one.relative_to is None else np.asarray(one.relative_to)[:, 0].tolist()
        ends += [time for one in own if one is not None for time in one]
        marks = np.unique(np.round([time for time in ends if 0.0 <= time <= T], 12))
        marks = marks[np.append(True, np.diff(marks) > 1e-9 * T)]
        count = [2 * max(1, int(np.ceil((b - a) / T * STEPS * self.finer / 2))) for a, b in itertools.pairwise(marks)]
        parts = [np.linspace(a, b, n + 1)[:-1] for (a, b), n in zip(itertools.pairwise(marks), count, strict=True)]
        self.times = np.append(np.concatenate(parts), T)

    @property
    def middles(self) -> Array:
        return (self.times[1:] + self.times[:-1]) / 2

    @property
    def K(self) -> int:
        return self.breakpoints.size - 1

    @property
    def m(self) -> int:
        return self.problem.system.controls

    def piece(self, breakpoints: Array, times: Array) -> Array:
        """The number of the piece of each time, -1 before the first one."""
        return np.searchsorted(breakpoints, times, side="right") - 1

    @cached_property
    def acting(self) -> Array:
        """Of every step the piece of the control that acts, later by the delay."""
        return self.piece(self.breakpoints + self.problem.system.delay, self.middles)

    @cached_property
    def late(self) -> Array:
        """Of every step whether a change of the control may come after it."""
        changes = self.breakpoints[1:-1]
        before = np.searchsorted(changes, self.middles, side="right") - 1
        return (before >= 0) & (self.middles < changes[np.maximum(before, 0)] + self.problem.jitter)

    @cached_property
    def commanded(self) -> Array:
        """Of every step the piece of the control that is commanded."""
        return self.piece(self.breakpoints, self.middles)

    @cached_property
    def integrals(self) -> list[tuple[Array, Array, Any]]:
        """Every row that is integrated, ``(d,)`` and ``(m,)``, with its constraint and the bounds of it."""
        found = []
        for one in self.problem.integral:
            H, G = np.atleast_2d(one.H), np.atleast_2d(one.G)
            lower, upper = (np.broadcast_to(np.asarray(side, dtype=float), len(H)) for side in (one.lower, one.upper))
            found += [(H[i], G[i], (one, float(lower[i]), float(upper[i]))) for i in range(len(H))]
        return found

    @property
    def states(self) -> int:
        """Those of the plant and the integrals."""
        return self.problem.system.states + len(self.integrals)

    @cached_property
    def sources(self) -> list[Source]:
        """The disturbances, one for each part that has pieces of its own, and the initial deviations (columns of the
        state)."""
        problem, found, first = self.problem, [], 0
        whole, own, kinds = problem.disturbance, problem.disturbance_breakpoints, problem.disturbance_class
        parts = () if whole is None else whole.parts if isinstance(whole, Product) else (whole,)
        for i, part in enumerate(parts):
            kind = kinds if isinstance(kinds, str) else kinds[i]
            ends = self.of_disturbance if own is None or own[i] is None else np.asarray(own[i])
            columns, first = slice(first, first + part.dimension), first + part.dimension
            if kind == "measurable":
                found.append(Source(columns, part, None, np.zeros(0)))
            elif kind == "piecewise_constant":
                known = np.searchsorted(self.breakpoints, ends[1:] - 1e-9)
                source = Source(columns, part, self.piece(ends, self.middles), known)
                found.append(replace(source, lengths=np.diff(ends)) if isinstance(part, BudgetedBox) else source)
            else:
                raise NotImplementedError(f"no oracle for disturbances of the class {kind}")
        return found

    @cached_property
    def blocks(self) -> list[tuple[ConvexSet, int]]:
        """What is constant: the set and from which piece of the control on it is known; the initial deviation last."""
        found: list[tuple[ConvexSet, int]] = []
        for one in self.sources:
            if one.lengths is not None:
                found.append((Signals(one.bound, one.lengths), int(one.known[-1])))
            elif one.pieces is not None:
                found += [(one.bound, int(k)) for k in one.known]
        start = self.problem.initial_set
        return [*found, *([] if start is None else [(start, 0)])]

    def parameters(self) -> Array:
        """A grid on the box of parameters, its corners among them, and the middle; one empty point without any."""
        bound = self.problem.system.parameters
        if bound is None:
            return np.zeros((1, 0))
        if not isinstance(bound, Box):
            raise NotImplementedError(f"no oracle for parameters in a {bound.kind}")
        count = (PARAMETERS.get(bound.dimension, 2) - 1) * min(self.finer, 2) + 1
        axes = [np.linspace(a, b, count) for a, b in zip(bound.lower, bound.upper, strict=True)]
        return np.vstack([np.array(list(itertools.product(*axes))), (bound.lower + bound.upper) / 2])


class Flow:
    """A plan at one parameter, integrated: transitions from 0 to every time, and what a step's inputs add, drawn back
    to 0. Inputs are the acting control, the commanded one (of integrals), the disturbances and the drift."""

    def __init__(self, plan: Plan, parameter: Array) -> None:
        self.plan = plan
        D, steps = plan.states, plan.times.size - 1
        self.transition, pulled = np.zeros((steps + 1, D, D)), []
        self.transition[0] = np.eye(D)
        at_ends = []
        for i, (a, b) in enumerate(itertools.pairwise(plan.times)):
            step, near = b - a, np.sqrt(3) / 6
            first, second = (self._law((a + b) / 2 + s * step * near, parameter) for s in (-1.0, 1.0))
            exponent = step / 2 * (first + second) + np.sqrt(3) / 12 * step**2 * (second @ first - first @ second)
            both = expm(exponent)
            self.transition[i + 1] = both[:D, :D] @ self.transition[i]
            pulled.append(np.linalg.solve(self.transition[i + 1], both[:D, D:]))
            if plan.above:
                ends = (self._law(time, parameter, (a + b) / 2)[:D, D:] for time in (a, b))
                at_ends.append([step * np.linalg.solve(self.transition[i + k], B) for k, B in enumerate(ends)])
        self.pulled, self.at_ends = np.array(pulled), np.array(at_ends)

    def _law(self, time: float, parameter: Array, within: float | None = None) -> Array:
        """The matrix of the states and the inputs, which do not change within a step; ``within``: a time of the step
        that ``time`` is an end of."""
        plan, T = self.plan, self.plan.problem.horizon
        inner = time if within is None else within
        law = next(phase for phase in plan.problem.system.until(T) if phase.begin <= inner <= phase.until)
        point = np.append(time, parameter) if law.timed else parameter
        A, B, E = (part[0] for part in law.matrices(point[None]))
        drift = law.forced.matrices(point[None])[1][0][:, B.shape[1] :]
        d, m, mw = len(A), B.shape[1], E.shape[1]
        D = plan.states
        whole = np.zeros((D + 2 * m + mw + 1, D + 2 * m + mw + 1))
        whole[:d, :d], whole[:d, D : D + m], whole[:d, D + 2 * m : D + 2 * m + mw] = A, B, E
        whole[:d, -1:] = drift if drift.size else 0.0
        for i, (H, G, (one, _, _)) in enumerate(plan.integrals):
            if one.start <= inner <= one.stop:
                whole[d + i, :d], whole[d + i, D + m : D + 2 * m] = H, G
        return whole

    def rows(self, j: int, H: Array, bound: Array) -> Rows:
        """``H x <= bound`` at a time, of the first of the states."""
        plan, problem = self.plan, self.plan.problem
        m, K, R = plan.m, plan.K, len(H)
        size = np.full(R, max(1e-3, float(np.abs(bound[np.isfinite(bound)]).max(initial=0.0))))
        back = H @ self.transition[j][: H.shape[1]]
        effect = np.einsum("rd,sdk->rsk", back, self.pulled[:j])
        ends = np.einsum("rd,sedk->rsek", back, self.at_ends[:j]) if plan.above else effect[:, :, None]
        start = np.concatenate([np.asarray(problem.initial_state, dtype=float), np.zeros(len(plan.integrals))])
        constant, added = back @ start + effect[:, :, -1].sum(axis=1), np.zeros(R)
        on_u, on_size = np.zeros((R, m, K + 1)), np.zeros((R, m, K + 1))  # the last one: before the delay is over
        on_change = np.zeros((R, m, K - 1))
        for i in range(m):
            np.add.at(on_u[:, i].T, plan.acting[:j], effect[:, :, i].T)
            if problem.execution is not None:
                share = float(np.asarray(problem.execution)[i])
                most = np.abs(effect[:, :, i])
                if plan.above:
                    most = np.maximum(most, np.abs(ends[..., i]).mean(axis=2))
                np.add.at(on_size[:, i].T, plan.acting[:j], share * most.T)
            if problem.jitter:  # half of the old and half of the new value, and up to half of the change beside it
                late = np.flatnonzero(plan.late[:j])
                half = effect[:, late, i].T / 2
                np.add.at(on_u[:, i].T, plan.acting[late], -half)
                np.add.at(on_u[:, i].T, plan.acting[late] - 1, half)
                np.add.at(on_change[:, i].T, plan.acting[late] - 1, np.abs(half))
            np.add.at(on_u[:, i].T, plan.commanded[:j], effect[:, :, m + i].T)
        before = np.zeros(m) if problem.initial_control is None else np.asarray(problem.initial_control, dtype=float)
        constant = constant + on_u[:, :, -1] @ before + on_size[:, :, -1] @ np.abs(before)
        blocks = []
        for one in plan.sources:
            pushed = effect[:, :, 2 * m :][:, :, one.columns]
            if one.pieces is None:
                most = support(one.bound, pushed)
                if plan.above:
                    most = np.maximum(most, support(one.bound, ends[..., 2 * m :][..., one.columns]).mean(axis=2))
                added = added + most.sum(axis=1)
                continue
            sums = np.zeros((one.known.size, R, pushed.shape[2]))
            np.add.at(sums, one.pieces[:j], pushed.transpose(1, 0, 2))
            blocks += list(sums) if one.lengths is None else [sums.transpose(1, 0, 2).reshape(R, -1)]
        blocks += [] if problem.initial_set is None else [back[:, : problem.system.states]]
        sizes = on_size[:, :, :K].reshape(R, -1), on_change.reshape(R, -1)
        flat = (on_u[:, :, :K].reshape(R, -1), np.hstack(sizes))
        return Rows(*flat, constant, added, blocks, bound, size)


def constraints(plan: Plan, parameter: Array) -> tuple[Rows, list[tuple[Array, float]], Flow]:
    """Every row on the state at one parameter, and the fixed final values as rows of the control."""
    flow, problem, last = Flow(plan, parameter), plan.problem, plan.times.size - 1
    found = [rows for window in problem.windows for rows in of_window(flow, window)]
    for end in problem.terminal_sets:
        H, h = sides(end, DIRECTIONS * plan.finer)
        found.append(flow.rows(last, H, h))
    every, d = np.eye(plan.states), problem.system.states
    for i, (_, _, (_, lower, upper)) in enumerate(plan.integrals):
        h = np.array([upper, -lower])
        found.append(flow.rows(last, (np.array([[1.0], [-1.0]]) * every[d + i])[np.isfinite(h)], h[np.isfinite(h)]))
    fixed = []
    for end in problem.terminal_equalities:
        for i in end.fixed.tolist():
            row = flow.rows(last, every[[i]], np.zeros(1))
            fixed.append((row.on_u[0], float(np.asarray(end.values)[i]) - float(row.constant[0])))
    return Rows.joined(found) if found else _none(plan), fixed, flow


def of_window(flow: Flow, window: Any) -> Iterator[Rows]:
    """The rows of a constraint on the path, at the times within its window: of a mixed one with the control of every
    piece that it holds on."""
    plan, mixed, slack = flow.plan, isinstance(window, MixedConstraint), 1e-9 * flow.plan.problem.horizon
    H, h = sides(window.set, DIRECTIONS * plan.finer)
    d, last = plan.problem.system.states, plan.times.size - 1
    inside = (plan.times >= window.start - slack) & (plan.times <= float(window.stop or 0.0) + slack)
    moved = None if window.relative_to is None else np.asarray(window.relative_to, dtype=float)
    for j in np.flatnonzero(inside):
        if not mixed:
            at = (
                0.0
                if moved is None
                else H @ [np.interp(plan.times[j], moved[:, 0], column) for column in moved[:, 1:].T]
            )
            yield flow.rows(j, H, h + at)
            continue
        for k in {int(plan.commanded[i]) for i in (j - 1, j) if 0 <= i < last and inside[i] and inside[i + 1]}:
            rows = flow.rows(j, H[:, :d], h)
            rows.on_u.reshape(len(h), plan.m, plan.K)[:, :, k] += H[:, d:]
            yield rows


def _none(plan: Plan) -> Rows:
    """No row at all."""
    blocks = [np.zeros((0, bound.dimension)) for bound, _ in plan.blocks]
    shapes = (0, plan.m * plan.K), (0, plan.m * (2 * plan.K - 1))
    return Rows(np.zeros(shapes[0]), np.zeros(shapes[1]), np.zeros(0), np.zeros(0), blocks, np.zeros(0), np.zeros(0))


def of_control(plan: Plan) -> Rows:
    """The rows of the control's own set on every piece, and of its steps."""
    problem, m, K = plan.problem, plan.m, plan.K
    parts = list[tuple[Array, float, float]]()
    pick = np.eye(m * K).reshape(m, K, m * K)
    H, h = sides(problem.control, DIRECTIONS * plan.finer)
    for k in range(K):
        parts += [(row @ pick[:, k], limit, np.abs(h).max()) for row, limit in zip(H, h, strict=True)]
    if problem.control_step is not None:
        H, h = sides(problem.control_step, DIRECTIONS * plan.finer)
        steps = [(pick[:, k] - pick[:, k - 1], np.zeros(m)) for k in range(1, K)]
        if problem.initial_control is not None:
            steps.append((pick[:, 0], np.asarray(problem.initial_control, dtype=float)))
        if problem.repeat:
            steps.append((pick[:, 0] - pick[:, K - 1], np.zeros(m)))
        for step, off in steps:
            parts += [(row @ step, limit + row @ off, np.abs(h).max()) for row, limit in zip(H, h, strict=True)]
    on_u, bound, size = (np.array(part) for part in zip(*parts, strict=True))
    blocks = [np.zeros((len(bound), one.dimension)) for one, _ in plan.blocks]
    none, sizes = np.zeros(len(bound)), np.zeros((len(bound), m * (2 * K - 1)))
    return Rows(on_u, sizes, none, none, blocks, bound, size)


@dataclass(frozen=True)
class Curve:
    """``u' Q u + q' u + c`` of the controls on pieces, a convex part of a cost."""

    Q: Array
    q: Array
    c: float

    def at(self, u: Array) -> tuple[float, Array]:
        """Its value and its gradient."""
        return float(u @ self.Q @ u + self.q @ u + self.c), 2 * self.Q @ u + self.q


def curve(plan: Plan, flow: Flow) -> Curve | None:
    """The quadratic terms of a cost along the nominal trajectory, by Simpson's rule on pairs of steps."""
    problem, n, d = plan.problem, plan.m * plan.K, plan.problem.system.states
    state, control, final = problem.cost.terms
    if not problem.cost.is_quadratic:
        return None
    Q, q, c = np.zeros((n, n)), np.zeros(n), 0.0
    centres = [middle(bound) for bound, _ in plan.blocks]

    def add(term: Any, j: int, weight: float) -> None:
        nonlocal Q, q, c
        row = flow.rows(j, np.eye(d), np.zeros(d))
        pushed = [effect @ centre for effect, centre in zip(row.blocks, centres, strict=True)]
        off = row.constant + sum(pushed, np.zeros(d)) - term.reference
        if any(one.pieces is None and middle(one.bound).any() for one in plan.sources):
            raise NotImplementedError("no oracle for quadratic costs with measurable disturbances about another centre")
        Q += weight * row.on_u.T @ term.Q @ row.on_u
        q += 2 * weight * row.on_u.T @ term.Q @ off
        c += float(weight * off @ term.Q @ off)

    if state is not None:
        for i in range(0, plan.times.size - 2, 2):
            step = (plan.times[i + 2] - plan.times[i]) / 6
            for j, weight in ((i, step), (i + 1, 4 * step), (i + 2, step)):
                add(state, j, weight)
    if final is not None:
        add(final, plan.times.size - 1, 1.0)
    if control is not None:
        Q = Q + np.kron(control.Q, np.diag(np.diff(plan.breakpoints)))
    return Curve(Q, q, c)


@dataclass
class Program:
    """Controls on pieces and answers to blocks, such that rows hold whatever the blocks are; rows and tangents are
    added as they are violated.

    Variables: coefficients of the functions, sizes of the control on every piece, norms of groups, one number for the
    curved terms, whether a piece acts (of each group), which letter it takes, and answers.
    """

    plan: Plan
    rows: Rows
    fixed: list[tuple[Array, float]]
    curved: Curve | None
    counts: bool
    alphabet: tuple[float, ...] | None
    answering: bool

    def __post_init__(self) -> None:
        plan, problem = self.plan, self.plan.problem
        m, K = plan.m, plan.K
        self.U = np.kron(np.eye(m), plan.values.T)  # controls on pieces of the coefficients
        grouped = [*problem.cost.blocks]
        alone = [(i,) for i in range(m) if not any(i in group for group in grouped)]
        self.groups = [*grouped, *alone]
        sizes = {
            "theta": self.U.shape[1],
            "size": m * (2 * K - 1),
            "norm": len(self.groups) * K,
            "curve": 1,
            "acts": len(self.groups) * K if self.counts else 0,
            "letter": m * K * len(self.alphabet) if self.alphabet is not None else 0,
        }
        self.answers = [
            (number, i, k, q)
            for number, (bound, known) in enumerate(plan.blocks if self.answering else ())
            for i in range(m)
            for k in range(known, K)
            for q in range(bound.dimension)
        ]
        sizes["answers"] = len(self.answers)
        ends = np.cumsum([0, *sizes.values()])
        self.at = {name: slice(a, b) for name, a, b in zip(sizes, ends[:-1], ends[1:], strict=True)}
        self.n = int(ends[-1])
        self.cuts, self.limits, self.sizes = list[Array](), list[float](), list[float]()
        self._sizes()

    def _sizes(self) -> None:
        """Sizes are no less than absolute values, and norms than the size of each channel; pieces that act."""
        plan, K = self.plan, self.plan.K
        largest = np.maximum(*(support(plan.problem.control, s * np.eye(plan.m)) for s in (1.0, -1.0)))
        own_size = np.eye(plan.m * (2 * K - 1))
        for number, (i, k) in enumerate(np.ndindex(plan.m, K - 1)):
            for sign in (1.0, -1.0):
                change = self.U[i * K + k + 1] - self.U[i * K + k]
                self._add(0.0, theta=sign * change, size=-own_size[plan.m * K + number])
        for i in range(plan.m * K):
            for sign in (1.0, -1.0):
                self._add(0.0, theta=sign * self.U[i], size=-own_size[i])
            g = next(number for number, group in enumerate(self.groups) if i // K in group)
            own = np.eye(len(self.groups) * K)[g * K + i % K]
            self._add(0.0, size=own_size[i], norm=-own)
            if self.counts:
                self._add(0.0, size=own_size[i], acts=-largest[i // K] * own)
        self.equal, self.values = list[Array](), list[float]()
        for row, value in self.fixed:
            self.equal.append(self._row(theta=row @ self.U))
            self.values.append(value)
        if self.alphabet is not None:
            for i in range(plan.m * K):
                letters = np.zeros((plan.m * K, len(self.alphabet)))
                letters[i] = 1.0
                self.equal += [self._row(letter=letters.ravel())]
                letters[i] = self.alphabet
                self.equal += [self._row(letter=letters.ravel(), theta=-self.U[i])]
                self.values += [1.0, 0.0]

    def _row(self, **parts: Array) -> Array:
        row = np.zeros(self.n)
        for name, part in parts.items():
            row[self.at[name]] += part
        return row

    def _add(self, limit: float, tightened: float = 0.0, **parts: Array) -> None:
        self.cuts.append(self._row(**parts))
        self.limits.append(limit)
        self.sizes.append(tightened)

    @cached_property
    def objective(self) -> Array:
        """What each variable costs."""
        problem, ends = self.plan.problem, self.plan.breakpoints
        weights = np.asarray(problem.weights, dtype=float)
        times, rows = (np.zeros(1), weights[None]) if weights.ndim == 1 else (weights[:, 0], weights[:, 1:])
        later = np.append(times[1:], np.inf)
        price = np.zeros((len(self.groups), self.plan.K))
        for g, group in enumerate(self.groups):
            for k in range(self.plan.K):
                shared = np.minimum(ends[k + 1], later) - np.maximum(ends[k], times)
                price[g, k] = np.maximum(shared, 0.0) @ rows[:, group[0]]
        if self.counts:
            per = rows[0] if weights.ndim == 1 else np.ones(rows.shape[1])
            time = np.array([[per[list(group)].sum()] for group in self.groups]) * np.diff(ends)
            return self._row(acts=time.ravel())
        return self._row(norm=problem.cost.l1 * price.ravel(), curve=np.ones(1))

    def gains(self, x: Array) -> list[Array]:
        """Of every block the answers ``(m K, q)``."""
        found = [np.zeros((self.plan.m * self.plan.K, bound.dimension)) for bound, _ in self.plan.blocks]
        for value, (number, i, k, q) in zip(x[self.at["answers"]], self.answers, strict=True):
            found[number][i * self.plan.K + k, q] = value
        return found

    def excess(self, x: Array, rows: Rows) -> tuple[Array, list[Array]]:
        """By how much each row is violated at the worst of the blocks, ``(R,)``, and that."""
        u, size = self.U @ x[self.at["theta"]], x[self.at["size"]]
        total = rows.constant + rows.added + rows.on_u @ u + rows.on_size @ size - rows.bound
        worst = []
        for (bound, _), effect, gain in zip(self.plan.blocks, rows.blocks, self.gains(x), strict=True):
            every = effect + rows.on_u @ gain
            worst.append(support_point(bound, every))
            total = total + (every * worst[-1]).sum(axis=1)
        return total, worst

    def _cut(self, r: int, worst: list[Array]) -> None:
        """Impose one row at one sample of the blocks."""
        rows, answers = self.rows, np.zeros(len(self.answers))
        constant = rows.constant[r] + rows.added[r]
        constant += sum(effect[r] @ point[r] for effect, point in zip(rows.blocks, worst, strict=True))
        for place, (number, i, k, q) in enumerate(self.answers):
            answers[place] = rows.on_u[r, i * self.plan.K + k] * worst[number][r, q]
        limit = rows.bound[r] - constant
        self._add(limit, rows.size[r], theta=rows.on_u[r] @ self.U, size=rows.on_size[r], answers=answers)

    def _tangents(self, x: Array) -> bool:
        """Impose tangents of norms and of the curved terms; whether any was needed."""
        u, K, needed = self.U @ x[self.at["theta"]], self.plan.K, False
        for g, group in enumerate(self.groups):
            for k in range(K if len(group) > 1 else 0):
                own = [i * K + k for i in group]
                norm = float(np.linalg.norm(u[own]))
                if norm > x[self.at["norm"]][g * K + k] + NEAR * max(norm, 1e-2):
                    slope = np.zeros(u.size)
                    slope[own] = u[own] / norm
                    self._add(0.0, theta=slope @ self.U, norm=-np.eye(len(self.groups) * K)[g * K + k])
                    needed = True
        if self.curved is not None:
            value, slope = self.curved.at(u)
            if value > float(x[self.at["curve"]][0]) + NEAR * max(abs(value), 1e-2):
                self._add(slope @ u - value, theta=slope @ self.U, curve=-np.ones(1))
                needed = True
        return needed

    def solve(self, margin: float, peaks: bool) -> Array | None:
        """The cheapest variables; ``None`` where nothing is feasible. With ``peaks`` sizes are those of the largest
        control that any block causes. `ended` says whether all rows are met; under feedback it may not be."""
        self.ended = False
        bounds = [(None, None)] * self.n
        least = 0.0 if self.curved is None else -1e6
        for name, low, high in (("curve", least, None), ("acts", 0.0, 1.0), ("letter", 0.0, 1.0), ("norm", 0.0, None)):
            bounds[self.at[name]] = [(low, high)] * (self.at[name].stop - self.at[name].start)
        bounds[self.at["answers"]] = [(-1e4, 1e4)] * len(self.answers)
        widest = float(np.abs(np.linalg.pinv(self.U)).sum()) * 1e3
        bounds[self.at["theta"]] = [(-widest, widest)] * self.U.shape[1]
        whole = np.zeros(self.n)
        whole[self.at["acts"]] = whole[self.at["letter"]] = 1
        kept = INTEGER if whole.any() else KEPT
        exact = {f"{one}_feasibility_tolerance": SOLVED for one in ("primal", "dual")}
        options = {"mip_rel_gap": SOLVED} if whole.any() else exact
        for _ in range(ANSWERED if self.answering else ROUNDS):
            found = linprog(
                self.objective,
                np.array(self.cuts),
                np.array(self.limits) - margin * np.array(self.sizes),
                np.array(self.equal) if self.equal else None,
                self.values or None,
                bounds,
                integrality=whole if whole.any() else None,
                options=options,
            )
            if found.status == 2:
                self.ended = True
                return None
            assert found.status == 0, found.message
            over, worst = self.excess(found.x, self.rows)
            over = over + margin * self.rows.size
            needed = self._tangents(found.x)
            needed |= peaks and self._peaks(found.x)
            chosen = np.argsort(-over / self.rows.size)[:CUTS]
            chosen = chosen[over[chosen] > kept * self.rows.size[chosen]]
            for r in chosen:
                self._cut(int(r), worst)
            if not chosen.size and not needed:
                self.ended = True
                return np.asarray(found.x)
        assert self.answering, "the program of the oracle did not end"
        return np.asarray(found.x)

    def _peaks(self, x: Array) -> bool:
        """Impose that sizes are those of the control that the worst blocks cause; whether any was not."""
        needed, gains, size = False, self.gains(x), x[self.at["size"]]
        u = self.U @ x[self.at["theta"]]
        for i in range(u.size):
            for sign in (1.0, -1.0):
                points = [support_point(b, sign * g[[i]])[0] for (b, _), g in zip(self.plan.blocks, gains, strict=True)]
                most = sign * u[i] + sum(sign * g[i] @ p for g, p in zip(gains, points, strict=True))
                if most > size[i] + KEPT:
                    answers = np.zeros(len(self.answers))
                    for place, (number, channel, k, q) in enumerate(self.answers):
                        answers[place] = sign * points[number][q] * (channel * self.plan.K + k == i)
                    self._add(0.0, theta=sign * self.U[i], size=-np.eye(size.size)[i], answers=answers)
                    needed = True
        return needed

    def cost(self, x: Array) -> float:
        """What these variables cost, curved terms and norms as they are."""
        if self.counts:
            return float(self.objective @ np.round(x * (np.arange(self.n) >= self.at["acts"].start)))
        u, true = self.U @ x[self.at["theta"]], x.copy()
        for g, group in enumerate(self.groups):
            own = slice(self.at["norm"].start + g * self.plan.K, self.at["norm"].start + (g + 1) * self.plan.K)
            if len(group) > 1:
                true[own] = np.linalg.norm([u[i * self.plan.K : (i + 1) * self.plan.K] for i in group], axis=0)
        if self.curved is not None:
            true[self.at["curve"]] = self.curved.at(u)[0]
        return float(self.objective @ true)


def bounds_of(config: dict[str, Any] | str | Path) -> tuple[float, float]:
    """A lower and an upper value of the cost of a config, infinite where nothing is feasible on the samples, and where
    no margin gave a feasible control. Raises `NotImplementedError` for what it has no program for."""
    loaded = load_config(config)
    problem = control_problem_of(loaded, "a control problem")
    control, disturbance = dictionaries_of(loaded, problem.horizon)
    if problem.disturbance is not None and disturbance.functions < disturbance.pieces:
        raise NotImplementedError("no oracle for disturbances of fewer functions than pieces")
    policy = loaded.config.policy
    charge = policy.options.get("cost", "nominal") if policy.name == "affine" else None
    if policy.name not in ("affine", "open_loop"):
        raise NotImplementedError(f"no oracle for the policy {policy.name}")
    counts, alphabet = counting(loaded)
    plan = Plan(problem, control.breakpoints, np.asarray(control.values), disturbance.breakpoints, 1, charge)
    return _bounds(plan, counts, alphabet)


def outside(result: Any, values: tuple[float, float]) -> list[str]:
    """What of a result's bounds contradicts a lower and an upper value, but for `AGREED` of a cost."""
    lower, upper = values
    room = AGREED * max(1.0, abs(upper) if np.isfinite(upper) else 0.0)
    wrong = []
    if result.status in ("certified", "verified") and not result.upper_bound >= lower - room:
        wrong.append(f"a control costs {result.upper_bound:.10g}, but none costs less than {lower:.10g}")
    if result.status == "infeasible" and np.isfinite(upper):
        wrong.append(f"nothing is feasible, but a control costs {upper:.10g}")
    if result.lower_bound is not None and not result.lower_bound <= upper + room:
        wrong.append(f"no control costs less than {result.lower_bound:.10g}, but one costs {upper:.10g}")
    return wrong


def _sampled(plan: Plan) -> tuple[Rows, list[tuple[Array, float]], Curve | None]:
    """All rows of a plan at all parameters; the curved cost is that of the last one, the middle."""
    every = [constraints(plan, parameter) for parameter in plan.parameters()]
    rows = Rows.joined([of_control(plan), *(one for one, _, _ in every)])
    return rows, [entry for _, fixed, _ in every for entry in fixed], curve(plan, every[-1][2])


def _bounds(plan: Plan, counts: bool, alphabet: tuple[float, ...] | None) -> tuple[float, float]:
    feedback, peak = plan.charge is not None, plan.charge == "peak"
    program = Program(plan, *_sampled(plan), counts, alphabet, feedback)
    found = program.solve(0.0, peak)
    lower = np.inf if found is None else float(program.objective @ found)
    if feedback and plan.problem.measurements is not None:  # the upper one answers nothing
        program = Program(plan, *_sampled(plan), counts, alphabet, False)
    peak = plan.charge in ("peak", "worst")
    found = program.solve(TIGHT, peak)
    if found is not None and program.ended:
        program.rows = _sampled(replace(plan, finer=FINER, above=True))[0]
        if (program.excess(found, program.rows)[0] > 0.0).any():
            found = program.solve(BETWEEN, peak)
    return lower, np.inf if found is None or not program.ended else program.cost(found)
