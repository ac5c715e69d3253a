"""The contract of a solver: whatever it says, what comes out of the check is right or says that it failed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.finite import FiniteProgram, FiniteSolution
from sparserob_core.sip.inner.solve import solve_finite
from sparserob_core.sip.solver import Solver

EPSILONS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)


@dataclass(frozen=True, eq=False)
class Instance:
    """A finite program, and the interval that its value is known to lie in (``inf, inf``: it is infeasible)."""

    name: str
    program: FiniteProgram
    lowest: float
    highest: float

    @property
    def feasible(self) -> bool:
        """Whether the program has a solution."""
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
    """With ``epsilon/2 sum_k weights_k x_k^2`` added to the cost."""
    from scipy.sparse import csc_array, diags_array

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
    kept = np.isfinite(h)
    found = linprog(
        np.concatenate([program.q, program.weights]),
        G[kept],
        h[kept],
        A,
        program.b,
        [(None, None)] * (n + k),
        method="highs",
    )
    value = float(found.fun) if found.status == 0 else np.inf
    return Instance(name, program, value - 1e-7 * max(1.0, abs(value)), value + 1e-7 * max(1.0, abs(value)))


def linear_instances() -> Iterator[Instance]:
    """Programs without a quadratic cost: feasible, degenerate, with duplicated rows, equalities, odd bounds, another
    image."""
    from scipy.sparse import csc_array

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


class SolverContract(ABC):
    """What every solver must keep, behind the check: subclass it as ``class TestMine(SolverContract)`` and give
    ``create``.

    A solver may fail where a program is too hard for it; it may not be believed when it is wrong. ``may_fail`` is the
    number of instances of a test on which it may give up.
    """

    may_fail = 0

    @abstractmethod
    def create(self) -> Solver:
        """A new solver."""

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
        assert len(failures) <= self.may_fail, failures
        return solutions

    def test_linear_programs_are_solved_or_given_up(self) -> None:
        self.solve_all(linear_instances())

    def test_badly_scaled_programs_are_solved_or_given_up(self) -> None:
        self.solve_all(badly_scaled_instances())

    def test_regularised_programs_are_solved_or_given_up(self) -> None:
        self.solve_all(regularised_instances())

    def test_infeasible_programs_are_proven_infeasible_or_given_up(self) -> None:
        for solution in self.solve_all(infeasible_instances()):
            assert solution.status == "failed" or solution.infeasibility > 0

    def test_the_regularised_value_rises_with_epsilon(self) -> None:
        solver = self.create()
        solutions = [solve_finite(regularised(robust_terminal(), epsilon), solver) for epsilon in EPSILONS]
        values = [solution.value for solution in solutions if solution.status == "optimal"]
        assert all(after <= before + 1e-8 for before, after in pairwise(values))


def compare(instance: Instance, solution: FiniteSolution) -> None:
    """Raise `AssertionError` when a checked answer contradicts what is known of the instance."""
    if solution.status == "failed":
        return
    assert (solution.status == "optimal") == instance.feasible, (
        f"{instance.name}: {solution.status}, {solution.message}"
    )
    if not instance.feasible:
        return
    program, x = instance.program, solution.x
    slack = 1e-6 * max(min(1.0, float(program.weights.max())), abs(instance.highest))
    assert instance.lowest - slack <= solution.value <= instance.highest + slack, (
        f"{instance.name}: {solution.value}, {solution.message}"
    )
    assert solution.lower_bound <= instance.highest + 1e-3 * slack, (
        f"{instance.name}: the lower bound {solution.lower_bound} is too high"
    )
    for violations, rows in ((program.G @ x - program.h, program.G), (np.abs(program.A @ x - program.b), program.A)):
        allowed = 1e-8 * np.maximum(1.0, np.abs(rows) @ np.abs(x))
        assert (violations <= allowed).all(), f"{instance.name}: a row is violated by {violations.max():.1e}"
