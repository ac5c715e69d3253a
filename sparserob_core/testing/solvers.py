"""The contract of a solver: its claims are what a claim means, and what comes out of the check is right or says that it
failed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.sparse import csc_array, diags_array

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver
from sparserob_core.testing.contract import Contract, broken, demand

EPSILONS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
ASKED = 1e-9  # the accuracy that is asked for
BELIEVED = "the check believes a wrong answer, which it never should, whatever the solver says; please report it"


@dataclass(frozen=True, eq=False)
class Instance:
    """A finite program, and the interval that its value is known to lie in (``inf, inf``: it is infeasible)."""

    name: str
    program: FiniteProgram
    lowest: float
    highest: float

    @property
    def feasible(self) -> bool:
        """True where the program has a solution."""
        return bool(np.isfinite(self.highest))


def finite_program(
    weights: Array, G: Array, h: Array, A: Array | None = None, b: Array | None = None, bound: float = 1.0
) -> FiniteProgram:
    """An L1 program in ``x`` with ``|x| <= bound`` and no linear or quadratic cost."""
    n = weights.size
    return FiniteProgram(
        np.zeros(n),
        weights,
        np.full(n, -bound),
        np.full(n, bound),
        G,
        h,
        np.zeros((0, n)) if A is None else A,
        np.zeros(0) if b is None else b,
    )


def double_integrator(pieces: int = 50, horizon: float = 5.0) -> tuple[Array, Array]:
    """Piece lengths ``(N,)``, and the rows ``(2, N)`` of position and speed at the horizon for a piecewise constant
    control."""
    step = horizon / pieces
    middle = (np.arange(pieces) + 0.5) * step
    return np.full(pieces, step), step * np.vstack([horizon - middle, np.ones(pieces)])


def regularised(program: FiniteProgram, epsilon: float) -> FiniteProgram:
    """Return the program with ``epsilon/2 sum_k weights_k x_k^2`` added to its cost."""
    return program if epsilon == 0 else replace(program, P=csc_array(diags_array(epsilon * program.weights)))


def robust_terminal(spread: float = 1.0) -> FiniteProgram:
    """Double integrator from (4, 0), ``|w| <= 0.02 spread``, ``|x(5)| <= (0.5, 0.3)``: 1.6 at spread 1, infeasible
    beyond 1.43."""
    weights, rows = double_integrator()
    slack = np.array([0.5, 0.3]) - 0.02 * spread * np.array([17.5, 5.0])
    start = np.array([4.0, 0.0])
    return finite_program(weights, np.vstack([rows, -rows]), np.concatenate([slack - start, slack + start]))


def to_origin(position: float, speed: float) -> FiniteProgram:
    """Double integrator to the origin in time 5: two equalities."""
    weights, rows = double_integrator()
    return finite_program(weights, np.zeros((0, 50)), np.zeros(0), rows, -np.array([position + 5 * speed, speed]))


def one_row(epsilon: float, demand: float = 0.6) -> Instance:
    """``a'x >= demand |a|_1`` with the weights ``1/n``: its dual has one variable, and is solved here by bisection."""
    from scipy.optimize import brentq

    n = 30
    a = np.cos(np.arange(n)) * np.linspace(0.2, 3.0, n)
    reach = demand * float(np.abs(a).sum())
    program = finite_program(np.full(n, 1.0 / n), -a[None], np.array([-reach]))

    def decision(y: float) -> Array:
        return np.asarray(np.clip(np.sign(a) * np.maximum(y * np.abs(a) - 1 / n, 0) * n / epsilon, -1, 1))

    y = brentq(lambda y: float(a @ decision(y)) - reach, 0.0, 1e3, xtol=1e-16, rtol=1e-14, maxiter=500)
    x = decision(y)
    dual = y * reach + float(np.sum((np.abs(x) + epsilon / 2 * x * x) / n - y * a * x))
    return Instance(f"one row, epsilon {epsilon:g}", regularised(program, epsilon), dual - 1e-9, dual + 1e-9)


def by_linear_programming(name: str, program: FiniteProgram) -> Instance:
    """An instance without quadratic cost, whose value HiGHS finds in another form."""
    from scipy.optimize import linprog

    n, k = program.n, program.weights.size
    S = np.eye(n) if program.S is None else program.S.toarray()
    G = np.vstack(
        [
            np.hstack([program.G, np.zeros((program.h.size, k))]),
            np.hstack([S, -np.eye(k)]),
            np.hstack([-S, -np.eye(k)]),
            np.hstack([S, np.zeros((k, k))]),
            np.hstack([-S, np.zeros((k, k))]),
        ]
    )
    h = np.concatenate([program.h, np.zeros(2 * k), program.upper, -program.lower])
    A = np.hstack([program.A, np.zeros((program.b.size, k))])
    is_finite = np.isfinite(h)
    solution = linprog(
        np.concatenate([program.q, program.weights]),
        G[is_finite],
        h[is_finite],
        A,
        program.b,
        [(None, None)] * (n + k),
        method="highs",
    )
    value = float(solution.fun) if solution.status == 0 else np.inf
    return Instance(name, program, value - 1e-7 * max(1.0, abs(value)), value + 1e-7 * max(1.0, abs(value)))


def linear_instances() -> Iterator[Instance]:
    """Programs without a quadratic cost: feasible, degenerate, with duplicated rows, equalities, odd bounds, another
    image."""
    robust = robust_terminal()
    rows, h = robust.G, robust.h
    yield Instance("robust terminal", robust, 1.6, 1.6)
    yield Instance(
        "duplicated rows",
        replace(robust, G=np.vstack([rows, rows, 2 * rows]), h=np.concatenate([h, h, 2 * h])),
        1.6,
        1.6,
    )
    yield Instance("empty rows", replace(robust, G=np.vstack([rows, 0 * rows]), h=np.concatenate([h, 0 * h])), 1.6, 1.6)
    yield Instance(
        "a row without a right-hand side", replace(robust, h=np.concatenate([h[:2], [np.inf], h[3:]])), 1.6, 1.6
    )
    yield Instance("many optimisers", to_origin(10, -3), 3.0, 3.0)
    yield by_linear_programming("equalities", to_origin(1, 1))
    yield Instance("no row", replace(robust, G=rows[:0], h=h[:0]), 0.0, 0.0)
    seventh, late = np.arange(50) % 7 == 0, np.arange(50) > 30
    yield by_linear_programming(
        "one-sided and fixed",
        replace(
            robust,
            lower=np.where(seventh, -0.25, np.where(late, 0.0, -1.0)),
            upper=np.where(seventh, -0.25, np.where(late, 0.4, 2.0)),
        ),
    )
    yield by_linear_programming(
        "some weights zero", replace(robust, weights=np.where(np.arange(50) % 5 == 0, 0.0, robust.weights))
    )
    turn = csc_array(np.linalg.qr(np.random.default_rng(1).standard_normal((50, 50)))[0])
    yield Instance("rotated", replace(robust, S=turn, G=rows @ turn), 1.6, 1.6)
    memory = np.vstack([np.eye(50), np.tril(np.full((50, 50), 0.1))])
    yield by_linear_programming(
        "bounded sums",
        replace(
            to_origin(1, 1),
            S=csc_array(memory),
            weights=np.repeat([0.1, 0.0], 50),
            lower=np.repeat([-1.0, -1.6], 50),
            upper=np.repeat([1.0, 0.2], 50),
        ),
    )
    powers = np.linspace(0, 1, 12)[:, None] ** np.arange(3)
    free = finite_program(np.zeros(3), -powers, -np.exp(powers[:, 1]), bound=np.inf)
    yield by_linear_programming("free variables", replace(free, q=1 / np.arange(1.0, 4.0)))


def badly_scaled_instances() -> Iterator[Instance]:
    """`robust_terminal` in other units: of the rows, the cost, the decision."""
    robust = robust_terminal()
    for factor in (1e-6, 1e6):
        units = np.array([factor, 1.0, 1.0, 1 / factor])
        yield Instance(
            f"rows times {factor:g}", replace(robust, G=robust.G * units[:, None], h=robust.h * units), 1.6, 1.6
        )
        yield Instance(
            f"cost times {factor:g}", replace(robust, weights=factor * robust.weights), 1.6 * factor, 1.6 * factor
        )
        large = replace(robust, lower=robust.lower * factor, upper=robust.upper * factor, G=robust.G / factor)
        yield Instance(f"decision times {factor:g}", large, 1.6 * factor, 1.6 * factor)


def regularised_instances() -> Iterator[Instance]:
    """The value lies between the linear program's and that plus the regulariser at any optimiser of it."""
    for epsilon in EPSILONS:
        yield one_row(epsilon)
        # An optimal control of the linear program is 16 pieces of -1 at the beginning: its regulariser is 1.6/2.
        yield Instance(
            f"robust terminal, epsilon {epsilon:g}", regularised(robust_terminal(), epsilon), 1.6, 1.6 + 0.8 * epsilon
        )
        # int u^2 = 3 - 1/sqrt 3 is the least of all optimisers, and piecewise constant ones are not better.
        least = 3 + epsilon / 2 * (3 - 1 / np.sqrt(3))
        around = least - 0.01 * epsilon, least + 0.01 * epsilon
        yield Instance(f"many optimisers, epsilon {epsilon:g}", regularised(to_origin(10, -3), epsilon), *around)


def infeasible_instances() -> Iterator[Instance]:
    """Programs without a feasible point, some only just."""
    rows = np.vstack([np.ones(50), -np.ones(50)])
    weights = np.full(50, 0.1)
    programs = {
        "too much disturbance": robust_terminal(spread=2.0),
        "out of reach": to_origin(40, 0),
        "opposed rows": finite_program(weights, rows, np.array([1.0, -1.5])),
        "opposed rows, only just": finite_program(weights, rows, np.array([1.0, -1.0 - 1e-5])),
        "beyond the bounds, only just": finite_program(weights, rows[1:], np.array([-50.0 - 1e-5])),
        "contradicting equalities": finite_program(weights, rows[:0], np.zeros(0), np.abs(rows), np.array([1.0, 2.0])),
        "an empty row": finite_program(weights, 0 * rows, np.array([1.0, -1.0])),
        "crossed bounds": replace(robust_terminal(), lower=np.full(50, 2.0)),
    }
    for name, program in programs.items():
        for epsilon in (1.0, 1e-6, 0.0):
            yield Instance(f"infeasible: {name}, epsilon {epsilon:g}", regularised(program, epsilon), np.inf, np.inf)


def coupled_instances() -> Iterator[Instance]:
    """Programs that only a solver can solve: decisions that a full ``P``, or an image of their own, ties together.

    Each is made from its optimum: a decision, multipliers, and the linear cost for which they are optimal.
    """
    for seed in range(8):
        rng = np.random.default_rng(seed)
        n, rows, equalities = 6 + 2 * seed, 5, seed % 3
        S = None if seed % 2 else np.vstack([np.eye(n), np.tril(np.ones((n, n))) / n])
        images = n if S is None else 2 * n
        P = None if seed >= 6 else rng.normal(size=(n, n)) / np.sqrt(n)
        P = None if P is None else csc_array(P @ P.T + 0.05 * np.eye(n))
        x = np.where(rng.random(n) < 0.3, 0.0, rng.uniform(-1.0, 1.0, n))
        s = x if S is None else S @ x
        weights, reach = rng.uniform(0.1, 1.0, images), np.where(rng.random(images) < 0.3, 0.0, 1.0)
        at_top = (rng.random(images) < 0.2) & (s > 0.0)
        slope = np.where(s == 0.0, rng.uniform(-0.9, 0.9, images), np.sign(s)) * weights
        slope[at_top] += rng.uniform(0.1, 1.0, int(at_top.sum()))
        G, A = rng.normal(size=(rows, n)), rng.normal(size=(equalities, n))
        y = np.where(np.arange(rows) < 3, rng.uniform(0.1, 1.0, rows), 0.0)
        pull = G.T @ y + A.T @ rng.normal(size=equalities) + (slope if S is None else S.T @ slope)
        program = FiniteProgram(
            -pull - (0.0 if P is None else P @ x),
            weights,
            s - 0.5 - reach,
            np.where(at_top, s, s + 0.5 + reach),
            G,
            G @ x + np.where(y > 0.0, 0.0, 0.7),
            A,
            A @ x,
            P,
            None if S is None else csc_array(S),
        )
        value = program.objective(x)
        slack = 1e-8 * max(1.0, program.magnitude(x))
        kind = "linear" if P is None else "quadratic"
        yield Instance(f"coupled {kind} program {seed}", program, value - slack, value + slack)


@dataclass(frozen=True, eq=False)
class Question:
    """A quadratic program as a solver is handed it, and its value (``inf``: infeasible, ``-inf``: unbounded)."""

    name: str
    program: QuadraticProgram
    value: float


def question(
    name: str,
    rng: np.random.Generator,
    n: int,
    rows: int,
    equalities: int,
    bounded: bool,
    curved: bool,
    cones: tuple[int, ...] = (),
) -> Question:
    """A program made from its optimum: rows of unit norm, every second one active; a third of the bounds reached.
    ``cones``: the sizes of those of the first variables; the optimum is on one, at the apex of the next, and inside of
    the third."""
    half = rng.normal(size=(n, n)) / np.sqrt(n)
    P = half @ half.T + 0.1 * np.eye(n) if curved else np.zeros((n, n))
    G, A = rng.normal(size=(rows, n)), rng.normal(size=(equalities, n))
    G, A = (M / np.linalg.norm(M, axis=1, keepdims=True) for M in (G, A))
    x, pull, first = rng.uniform(-1.0, 1.0, n), np.zeros(n), 0
    members = []
    for number, size in enumerate(cones):
        cone = np.arange(first, first + size)
        norm = float(np.linalg.norm(x[cone[1:]]))
        if number % 3 == 0:
            x[cone[0]], pull[cone] = norm, 0.7 * np.append(norm, -x[cone[1:]])
        elif number % 3 == 1:
            pull[cone], x[cone] = np.append(norm + 0.4, x[cone[1:]]), 0.0
        else:
            x[cone[0]] = norm + 0.4
        members.append(cone)
        first += size
    z = np.where(np.arange(rows) % 2 == 0, rng.uniform(0.2, 1.0, rows), 0.0)
    side = np.arange(n) % 3 if bounded else np.full(n, 2)  # at the lower bound, at the upper one, at neither
    lower = np.where(side == 0, x, np.where(np.arange(n) % 2 == 0, -np.inf, x - 1.0)) if bounded else -np.inf
    upper = np.where(side == 1, x, np.where(np.arange(n) % 2 == 1, np.inf, x + 1.0)) if bounded else np.inf
    z_box = np.where(side == 0, -1.0, np.where(side == 1, 1.0, 0.0)) * rng.uniform(0.2, 1.0, n)
    q = pull - (P @ x + G.T @ z + A.T @ rng.normal(size=equalities) + z_box)
    scale = float(np.abs(q).max())
    program = QuadraticProgram(
        csc_array(P / scale),
        q / scale,
        csc_array(G),
        G @ x + np.where(z > 0.0, 0.0, 0.5),
        csc_array(A),
        A @ x,
        np.broadcast_to(lower, n).astype(float),
        np.broadcast_to(upper, n).astype(float),
        tuple(members),
    )
    return Question(name, program, objective(program, x))


def questions(conic: bool = False) -> Iterator[Question]:
    """Programs with and without curvature, rows, equalities and bounds, and for a ``conic`` solver with cones; each has
    a solution."""
    rng = np.random.default_rng(11)
    yield question("one variable", rng, 1, 1, 0, False, True)
    yield question("bounds only", rng, 7, 0, 0, True, True)
    yield question("rows only", rng, 6, 9, 0, False, True)
    yield question("equalities only", rng, 8, 0, 3, False, True)
    yield question("everything", rng, 12, 10, 3, True, True)
    yield question("everything, larger", rng, 60, 40, 10, True, True)
    yield question("a linear program", rng, 9, 12, 2, True, False)
    yield question("a linear program, larger", rng, 50, 60, 5, True, False)
    if conic:
        yield question("a cone", rng, 4, 3, 0, False, True, (4,))
        yield question("cones and everything", rng, 20, 12, 3, True, True, (3, 2, 5, 4))
        yield question("cones without curvature", rng, 24, 20, 2, True, False, (3, 3, 3, 3, 4, 4))


def hopeless() -> Iterator[Question]:
    """Programs without a solution: nothing is feasible, or the cost falls for ever."""
    for n, curved in ((2, True), (10, False)):
        eye, none = np.eye(n), np.zeros((0, n))
        P, q, free = csc_array(eye * curved), np.ones(n), np.full(n, np.inf)
        opposed, rhs = np.vstack([eye[0], -eye[0]]), np.array([-1.0, -1.0])
        yield Question(
            "opposed rows",
            QuadraticProgram(P, q, csc_array(opposed), rhs, csc_array(none), np.zeros(0), -free, free),
            np.inf,
        )
        yield Question(
            "an equality out of reach",
            QuadraticProgram(
                P, q, csc_array(none), np.zeros(0), csc_array(eye[:1]), np.array([3.0]), -np.ones(n), np.ones(n)
            ),
            np.inf,
        )
    yield Question(
        "unbounded",
        QuadraticProgram(
            csc_array((n, n)), q, csc_array(-eye[:1]), np.zeros(1), csc_array(none), np.zeros(0), -free, free
        ),
        -np.inf,
    )


def objective(program: QuadraticProgram, x: Array) -> float:
    """``1/2 x'P x + q'x``."""
    return float(x @ (program.P @ x) / 2 + program.q @ x)


def misses(program: QuadraticProgram, claim: Claim) -> dict[str, float]:
    """Return the residual of each condition of optimality (Karush 1939; Kuhn and Tucker 1951) at a claim, by the
    condition in words."""
    x, z, y, z_box = claim.x, claim.z, claim.y, claim.z_box
    stationary = program.P @ x + program.q + program.G.T @ z + program.A.T @ y + z_box
    low, high = np.minimum(z_box, 0.0), np.maximum(z_box, 0.0)
    open_below, open_above = np.isneginf(program.lower), np.isposinf(program.upper)
    lower, upper = np.where(open_below, 0.0, program.lower), np.where(open_above, 0.0, program.upper)
    dual = -float(program.h @ z + program.b @ y + upper @ high + lower @ low) - float(x @ (program.P @ x)) / 2

    def largest(values: Array) -> float:
        return float(np.max(values, initial=0.0))

    return {
        "G x <= h": largest(program.G @ x - program.h),
        "A x = b": largest(np.abs(program.A @ x - program.b)),
        "lower <= x <= upper": largest(np.maximum(program.lower - x, x - program.upper)),
        "the first of a cone's variables is at least the norm of the others": largest(
            np.array([np.linalg.norm(x[cone[1:]]) - x[cone[0]] for cone in program.cones])
        ),
        "P x + q + G'z + A'y + z_box = 0": largest(program.slope_missed(stationary)),
        "z >= 0": largest(-z),
        "z_box >= 0 where lower is -inf, z_box <= 0 where upper is inf": largest(
            np.concatenate([-z_box[open_below], z_box[open_above]])
        ),
        "the cost is that of the multipliers (complementary slackness)": abs(objective(program, x) - dual),
    }


class CountedSolver(Solver):
    """Passes everything on to a solver, and counts the calls."""

    def __init__(self, solver: Solver) -> None:
        self.solver, self.calls = solver, 0

    def solve(self, program: QuadraticProgram, accuracy: float) -> Claim:
        """Pass it on."""
        self.calls += 1
        return self.solver.solve(program, accuracy)


class SolverContract(Contract[Solver], kind="solver"):
    """Contract of a solver: subclass it as ``class TestMine(SolverContract)`` and give ``component``.

    The first tests examine its claims themselves: shapes, signs of multipliers, residuals, programs without a solution.
    The other tests examine the result of the check (`sip.inner`), which believes nothing. There a solver may fail where
    a program is too hard for it, but it may not be believed when it is wrong. ``may_fail``: the number of programs of a
    test on which it may give up. ``precision``: the residuals at which a claim of its own counts as a solution, when it
    is asked for 1e-9; a first-order method needs a larger value.
    """

    may_fail = 0
    precision = 1e-6

    def claim(self, solver: Solver, question: Question) -> Claim:
        """Return the claim of a solver about a question; the contract is broken where it raises, or returns no valid
        claim."""
        program = question.program
        try:
            answer: object = solver.solve(program, ASKED)
        except Exception as error:  # noqa: BLE001  a solver may raise anything, and must not
            broken(
                f"{question.name}: solve raised {type(error).__name__}: {error}",
                'return a Claim with the status "failed" and the reason as its message',
            )
        claim = answer if isinstance(answer, Claim) else None
        if claim is None or claim.status not in ("solved", "infeasible", "failed"):
            broken(
                f"{question.name}: solve returned {answer!r}",
                'return a Claim whose status is "solved", "infeasible" or "failed"',
            )
        if claim.status == "solved":
            for name, like in (("x", program.q), ("z", program.h), ("y", program.b), ("z_box", program.q)):
                value = np.asarray(getattr(claim, name))
                demand(
                    value.shape == like.shape and value.dtype.kind == "f" and bool(np.isfinite(value).all()),
                    f"{question.name}: {name} has shape {value.shape} and type {value.dtype}, or numbers that are not "
                    f"finite; expected {like.size} finite numbers",
                    "x and z_box have one number for each variable, z for each row of G, y for each row of A",
                )
        return claim

    def test_a_claim_satisfies_the_conditions_of_optimality(self) -> None:
        solver, given_up = self.create(), []
        for question in questions(solver.conic):
            claim = self.claim(solver, question)
            demand(
                claim.status != "infeasible",
                f'{question.name}: claims "infeasible" of a program that has a solution',
                'claim "infeasible" only with a Farkas ray, and "failed" where the method merely got stuck',
            )
            if claim.status == "failed":
                given_up.append(f"{question.name} ({claim.message})")
                continue
            for condition, residual in misses(question.program, claim).items():
                demand(
                    residual <= self.precision,
                    f"{question.name}: claims a solution that misses `{condition}` by {residual:.1e} "
                    f"(asked for {ASKED:g}, allowed {self.precision:g})",
                    "compare the signs of your solver's multipliers with `P x + q + G'z + A'y + z_box = 0`, hand its "
                    "tolerances `accuracy`, and see that every part of the program reaches it",
                )
            demand(
                abs(objective(question.program, claim.x) - question.value) <= 10 * self.precision,
                f"{question.name}: the cost at x is {objective(question.program, claim.x):.9g}, the optimum "
                f"{question.value:.9g}",
                "see that P is taken as a whole (or its upper triangle, where your solver wants that) and with 1/2",
            )
        demand(
            len(given_up) <= self.may_fail,
            f"gives up on {', '.join(given_up)}",
            "these programs are small and well scaled; if it is right to give up, set `may_fail`",
        )

    def test_a_program_without_a_solution_is_not_claimed_to_be_solved(self) -> None:
        solver = self.create()
        for question in hopeless():
            claim = self.claim(solver, question)
            demand(
                claim.status != "solved" or max(misses(question.program, claim).values()) > self.precision,
                f"{question.name}: a contradiction, a claim that no solution can satisfy holds",
                "this is a fault of the contract; please report it",
            )
            demand(
                claim.status != "solved",
                f"{question.name}: claims to have solved a program that has no solution",
                'translate the status of your solver: only its word for an optimum is "solved"',
            )
            demand(
                claim.status != "infeasible" or question.value == np.inf,
                f'{question.name}: claims "infeasible" of a program whose cost falls for ever',
                '"dual infeasible" is not "infeasible": claim "failed" there',
            )

    def test_the_program_is_left_as_it_was(self) -> None:
        from copy import deepcopy

        solver = self.create()
        for question in questions():
            before = deepcopy(question.program)
            self.claim(solver, question)
            changed = [
                name
                for name in ("P", "q", "G", "h", "A", "b", "lower", "upper")
                if not np.array_equal(_make_dense(getattr(before, name)), _make_dense(getattr(question.program, name)))
            ]
            demand(
                not changed,
                f"{question.name}: solve has changed {', '.join(changed)} of the program",
                "copy what your solver scales in place, infinite bounds above all",
            )

    def test_a_second_program_is_not_solved_by_the_answer_to_the_first(self) -> None:
        solver = self.create()
        for question in [*questions(), *questions()]:
            again, fresh = self.claim(solver, question), self.claim(self.create(), question)
            if "solved" == again.status == fresh.status:
                distance = float(np.abs(again.x - fresh.x).max())
                demand(
                    distance <= 1e3 * self.precision,
                    f"{question.name}: an old and a new solver give answers that are {distance:.1e} apart",
                    "a warm start may save time, but must not change the answer: set up every program anew",
                )
            demand(
                again.status == fresh.status,
                f"{question.name}: an old solver says {again.status}, a new one {fresh.status}",
                "set up every program anew: shapes, bounds and P may all differ from the last one's",
            )

    def test_programs_that_need_a_solver_are_solved(self) -> None:
        for instance in coupled_instances():
            counted = CountedSolver(self.create())
            solve_finite(instance.program, counted)
            demand(counted.calls, f"{instance.name}: solved without the solver", "this is a fault of the contract")
        self.solve_all(coupled_instances())

    def solve_all(self, instances: Iterator[Instance]) -> list[FiniteSolution]:
        """Solve each, compare with what is known, count the failures."""
        solver = self.create()
        solutions = []
        failures = []
        for instance in instances:
            solution = solve_finite(instance.program, solver)
            compare(instance, solution)
            solutions.append(solution)
            if solution.status == "failed":
                failures.append(f"{instance.name}: {solution.attempts}")
        demand(
            len(failures) <= self.may_fail,
            f"gives up on {len(failures)} programs, or is not believed: {'; '.join(failures)}",
            "the words after each program say what was wrong with each attempt; `may_fail` is how many are allowed",
        )
        return solutions

    def test_linear_programs_are_solved_or_given_up(self) -> None:
        self.solve_all(linear_instances())

    def test_badly_scaled_programs_are_solved_or_given_up(self) -> None:
        self.solve_all(badly_scaled_instances())

    def test_regularised_programs_are_solved_or_given_up(self) -> None:
        self.solve_all(regularised_instances())

    def test_infeasible_programs_are_proven_infeasible_or_given_up(self) -> None:
        for solution in self.solve_all(infeasible_instances()):
            demand(
                solution.status == "failed" or solution.infeasibility > 0,
                f"infeasible without a proof: {solution.message}",
                "this is a fault of the check; please report it",
            )

    def test_the_regularised_value_rises_with_epsilon(self) -> None:
        solver = self.create()
        solutions = [solve_finite(regularised(robust_terminal(), epsilon), solver) for epsilon in EPSILONS]
        values = [solution.value for solution in solutions if solution.status == "optimal"]
        demand(
            all(after <= before + 1e-8 for before, after in pairwise(values)),
            f"the value rises where the weight of the regulariser falls: {values}",
            "this is a fault of the check; please report it",
        )


def compare(instance: Instance, solution: FiniteSolution) -> None:
    """Raise `AssertionError` when a checked answer contradicts what is known of the instance."""
    if solution.status == "failed":
        return
    demand(
        (solution.status == "optimal") == instance.feasible,
        f"{instance.name}: {solution.status} is believed, which is wrong ({solution.message})",
        BELIEVED,
    )
    if not instance.feasible:
        return
    program, x = instance.program, solution.x
    slack = 1e-6 * max(min(1.0, float(program.weights.max())), abs(instance.highest))
    demand(
        instance.lowest - slack <= solution.value <= instance.highest + slack,
        f"{instance.name}: the value {solution.value} is believed, which lies in [{instance.lowest}, "
        f"{instance.highest}] ({solution.message})",
        BELIEVED,
    )
    demand(
        solution.lower_bound <= instance.highest + 1e-3 * slack,
        f"{instance.name}: the lower bound {solution.lower_bound} is too high",
        BELIEVED,
    )
    for violations, rows in ((program.G @ x - program.h, program.G), (np.abs(program.A @ x - program.b), program.A)):
        allowed = 1e-8 * np.maximum(1.0, np.abs(rows) @ np.abs(x))
        demand(
            (violations <= allowed).all(),
            f"{instance.name}: a row is violated by {violations.max(initial=0.0):.1e}",
            BELIEVED,
        )


def _make_dense(value: object) -> Array:
    return np.asarray(value.toarray() if hasattr(value, "toarray") else value)
