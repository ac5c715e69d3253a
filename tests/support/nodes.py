"""Multiple shooting: the states at the ends of pieces are variables, between which little grows (Bock and Plitt 1984).
Under feedback so are their answers to every deviation (Anderson, Doyle, Low and Matni 2019, "System level synthesis").
A reference for plants that amplify, by HiGHS, which proves nothing between its nodes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from scipy.linalg import expm, solve_discrete_are
from scipy.optimize import linprog
from scipy.sparse import coo_array

CONFIGS = Path(__file__).parents[2] / "configs"
ACCURACY = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


class Shot(NamedTuple):
    """The least cost, and the nominal control ``(m, K)`` of it."""

    cost: float
    control: np.ndarray


@dataclass
class Columns:
    """What is affine in the deviations: its nominal and its answer to each, with variables of their own and the same
    weights."""

    variables: np.ndarray  # (n, 1 + deviations)
    weights: np.ndarray  # (n,)
    constants: np.ndarray  # (1 + deviations,)

    @classmethod
    def of(cls, variables: np.ndarray, constants: np.ndarray | None = None) -> Columns:
        """A variable of every column, and a constant."""
        return cls(variables[None], np.ones(1), np.zeros(len(variables)) if constants is None else constants)

    def less(self, variables: np.ndarray) -> Columns:
        return Columns(np.vstack([self.variables, variables]), np.append(self.weights, -1.0), self.constants)


@dataclass
class Rows:
    """Rows of a sparse linear program, entry by entry."""

    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    limits: list[float] = field(default_factory=list)

    def add(self, variables: np.ndarray, weights: np.ndarray, limit: float) -> None:
        self.entries.append((np.full(len(variables), len(self.limits)), variables, weights))
        self.limits.append(limit)

    def table(self, count: int) -> coo_array:
        if not self.entries:
            return coo_array((0, count))
        rows, columns, weights = (np.concatenate(parts) for parts in zip(*self.entries, strict=True))
        return coo_array((weights, (rows.astype(int), columns.astype(int))), shape=(len(self.limits), count))


@dataclass
class NodeProgram:
    """A linear program in states at nodes, controls, and the answers of both to deviations within ``radii``."""

    radii: np.ndarray
    bounds: list[tuple[float | None, float | None]] = field(default_factory=list)
    below: Rows = field(default_factory=Rows)
    equal: Rows = field(default_factory=Rows)

    def variables(self, *shape: int, least: float | None = None) -> np.ndarray:
        first = len(self.bounds)
        self.bounds += [(least, None)] * int(np.prod(shape))
        return np.arange(first, len(self.bounds)).reshape(shape)

    def hold(self, what: Columns, limit: float, price: int | None = None) -> None:
        """Hold ``|what|`` below a limit, and a variable if there is one, for every deviation within its radius."""
        sizes = self.variables(self.radii.size, least=0.0)
        for size, variables, constant in zip(sizes, what.variables.T[1:], what.constants[1:], strict=True):
            for sign in (1.0, -1.0):
                self.below.add(np.append(variables, size), np.append(sign * what.weights, -1.0), -sign * constant)
        taken = [] if price is None else [price]
        for sign in (1.0, -1.0):
            variables = np.concatenate([what.variables[:, 0], sizes, np.array(taken, dtype=int)])
            weights = np.concatenate([sign * what.weights, self.radii, -np.ones(len(taken))])
            self.below.add(variables, weights, limit - sign * what.constants[0])

    def fix(self, what: Columns) -> None:
        """Fix ``what`` at 0 for every deviation."""
        for variables, constant in zip(what.variables.T, what.constants, strict=True):
            self.equal.add(variables, what.weights, -constant)

    def solve(self, prices: np.ndarray, price: float) -> np.ndarray:
        count = len(self.bounds)
        objective = np.zeros(count)
        objective[prices] = price
        found = linprog(
            objective,
            A_ub=self.below.table(count).tocsr(),
            b_ub=self.below.limits,
            A_eq=self.equal.table(count).tocsr(),
            b_eq=self.equal.limits,
            bounds=self.bounds,
            method="highs-ipm",
            options=ACCURACY,
        )
        assert found.status == 0, found.message
        return np.asarray(found.x)


def transition(A: np.ndarray, B: np.ndarray, span: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the flow of a state, and of an input that is constant, over a span of time."""
    (d, m) = B.shape
    generator = np.zeros((d + m, d + m))
    generator[:d] = np.hstack([A, B])
    flow = expm(generator * span)[:d]
    return flow[:, :d], flow[:, d:]


@dataclass(frozen=True)
class Story:
    """A shipped config whose sets are boxes, with its states in units of their walls."""

    A: np.ndarray
    B: np.ndarray
    E: np.ndarray
    C: np.ndarray
    radii: dict[str, np.ndarray]  # of initial states, disturbances, and noises
    centre: np.ndarray
    walled: np.ndarray
    ends: list[tuple[int, float, float | None]]  # state, value, radius: none where it is fixed for every deviation
    bound: float
    first: list[float]
    change: float
    pieces: int
    step: float

    @classmethod
    def read(cls, config: str) -> Story:
        options = yaml.safe_load((CONFIGS / f"{config}.yaml").read_text())
        problem, pieces = options["problem"], options["dictionaries"]["control"]["pieces"]
        walls = np.array(problem["path"][0]["box"], dtype=float)  # null is nan
        size = np.where(np.isfinite(walls), walls, 1.0)
        d = walls.size
        A, B, E = (
            np.array(problem["system"].get(name, np.zeros((d, 0))), dtype=float) / size[:, None] for name in "ABE"
        )
        start, measured = problem["initial_state"], problem.get("measurements", {})
        centre, begun = (start["centre"], start["box"]) if isinstance(start, dict) else (start, [0.0] * d)
        C = np.array(measured.get("C", np.eye(d)), dtype=float) * size
        radii = {
            "begun": np.array(begun, dtype=float) / size,
            "pushed": np.full(E.shape[1], problem.get("disturbance", {}).get("box", 0.0)),
            "noise": np.full(len(C), measured.get("noise", {}).get("box", 0.0)),
        }
        ends: list[tuple[int, float, float | None]] = []
        sets = problem.get("terminal", [{"box": begun}] if problem.get("repeat") else [])
        for kind, i, value in ((kind, i, v) for s in sets for kind, vs in s.items() for i, v in enumerate(vs)):
            if value is not None:
                fixed = kind == "equals"
                ends.append((i, value / size[i] if fixed else 0.0, None if fixed else value / size[i]))
        change = problem.get("control_step", {}).get("box", np.inf)
        first = problem.get("initial_control", [0.0] * B.shape[1])
        return cls(
            A * size, B, E, C, radii, np.array(centre, dtype=float) / size, np.isfinite(walls), ends,
            problem["control"]["box"], first, change, pieces, problem["horizon"] / pieces,
        )  # fmt: skip

    def innovations(self) -> np.ndarray:
        """Return what each measurement tells of initial states, disturbances, and noises: ``(pieces, p, deviations)``.
        Any gain of the observer gives the same policies; with exact states, what is told is the last disturbance."""
        (Phi, Gamma), (p, d), (_, mw) = transition(self.A, self.E, self.step), self.C.shape, self.E.shape
        gain, noise = Phi, self.radii["noise"]
        if noise.any():
            P = solve_discrete_are(Phi.T, self.C.T, 1e-3 * np.eye(d), np.diag(noise**2))
            gain = Phi @ P @ self.C.T @ np.linalg.inv(self.C @ P @ self.C.T + np.diag(noise**2))
        else:
            gain = Phi @ np.linalg.inv(self.C)
        told = np.zeros((self.pieces, p, d + (mw + p) * self.pieces))
        error = np.eye(d, told.shape[2])
        for k in range(self.pieces):
            told[k] = self.C @ error
            told[k, :, d + mw * self.pieces + p * k :][:, :p] += np.eye(p)
            error = Phi @ error - gain @ told[k]
            error[:, d + mw * k : d + mw * (k + 1)] += Gamma
        return told


def independent(rows: np.ndarray) -> np.ndarray:
    """Return orthonormal rows of the same span."""
    _, sizes, right = np.linalg.svd(rows, full_matrices=False)
    return right[: int((sizes > 1e-9 * sizes.max(initial=1e-300)).sum())]


@dataclass
class Shooting:
    """The program of a story: variables of its states at nodes, of its controls, and of what these cost."""

    story: Story

    def __post_init__(self) -> None:
        story = self.story
        (d, m), mw, pieces = story.B.shape, story.E.shape[1], story.pieces
        tiled = [np.tile(story.radii[name], pieces) for name in ("pushed", "noise")]
        every = np.concatenate([story.radii["begun"], *tiled])
        live = np.flatnonzero(every)
        self.program = NodeProgram(every[live])
        self.states = self.program.variables(pieces + 1, d, 1 + live.size)
        self.inputs = self.program.variables(pieces, m, 1 + live.size)
        self.prices = self.program.variables(pieces, m, least=0.0)
        self.told = story.innovations()[:, :, live]
        self.nothing = np.zeros(live.size)
        self.pushes = np.zeros((pieces, mw, 1 + live.size))
        for k, i in np.ndindex(pieces, mw):
            self.pushes[k, i, 1:] = live == d + mw * k + i
        for i in range(d):
            self.program.fix(Columns.of(self.states[0, i], -np.append(story.centre[i], live == i)))

    def answer(self, k: int) -> None:
        """Let the control of a piece answer what is told by then."""
        heard = np.vstack([independent(told) for told in self.told[: k + 1]])
        answers = self.program.variables(self.inputs.shape[1], len(heard))
        for i, column in np.ndindex(len(answers), self.nothing.size):
            variables = np.append(answers[i], self.inputs[k, i, 1 + column])
            self.program.equal.add(variables, np.append(-heard[:, column], 1.0), 0.0)

    def limit(self, k: int, i: int) -> None:
        """Keep a control and its change within their bounds, and charge it."""
        control = Columns.of(self.inputs[k, i])
        self.program.hold(control, self.story.bound)
        self.program.hold(control, 0.0, self.prices[k, i])
        if np.isfinite(self.story.change):
            first = Columns.of(self.inputs[k, i], -np.append(self.story.first[i], self.nothing))
            self.program.hold(control.less(self.inputs[k - 1, i]) if k else first, self.story.change)

    def follow(self, k: int, parts: int) -> None:
        """Follow the states through a piece, and hold their walls at some times of it."""
        story = self.story
        for number in range(1, parts + 1):
            span = story.step * number / parts
            (Phi, Gamma), (_, push) = transition(story.A, story.B, span), transition(story.A, story.E, span)
            for i in range(len(Phi)):
                variables = np.vstack([self.states[k], self.inputs[k]])
                state = Columns(variables, np.append(Phi[i], Gamma[i]), push[i] @ self.pushes[k])
                if number == parts:
                    self.program.fix(state.less(self.states[k + 1, i]))
                if story.walled[i]:
                    self.program.hold(state if number < parts else Columns.of(self.states[k + 1, i]), 1.0)

    def end(self) -> None:
        for i, value, radius in self.story.ends:
            state = Columns.of(self.states[-1, i], -np.append(value, self.nothing))
            if radius is None:
                self.program.fix(state)
            else:
                self.program.hold(state, radius)


def at_nodes(config: str, parts: int) -> Shot:
    """Solve a shipped config whose sets are boxes, for ``int |u|`` in open loop and the peak of a policy; walls hold at
    ``parts`` times of every piece."""
    story = Story.read(config)
    shooting = Shooting(story)
    for k in range(story.pieces):
        shooting.answer(k)
        for i in range(story.B.shape[1]):
            shooting.limit(k, i)
        shooting.follow(k, parts)
    shooting.end()
    solution = shooting.program.solve(shooting.prices.ravel(), story.step)
    control = np.ascontiguousarray(solution[shooting.inputs[:, :, 0]].T)
    return Shot(float(story.step * solution[shooting.prices].sum()), control)
