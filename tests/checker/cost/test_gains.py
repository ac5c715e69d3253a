"""Guards checker/cost/gains: what gains can add to a sum of constraints is bounded, held against linear programs."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from flint import arb, arb_mat, ctx
from scipy.optimize import linprog

import sparserob_core as sr
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.cost.duality import ConstraintRow
from sparserob_core.checker.cost.gains import GainsBound, find_independent
from sparserob_core.checker.reach.closed_loop import VerifiedLoop
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.control.sets.sets import Box, Polytope, Zonotope
from sparserob_core.experiment.check.check import check

ONE = np.array([[0.0], [1.0]])
PLANTS = {
    "one state": (np.array([[-0.1]]), np.array([[1.0]])),
    "one push on two states": (np.array([[0.0, 1.0], [-2.0, -0.5]]), ONE),
    "two pushes that are one": (np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.5, 1.0], [1.0, 2.0]])),
    "a state that nothing reaches": (np.diag([-1.0, -0.5, 0.3]), np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])),
    "two states that are one": (np.diag([-0.5, 0.4, 0.4]), np.array([[1.0], [1.0], [1.0]])),
}
GRIDS = {
    "alike": [0.0, 1.0, 2.0, 3.0, 4.0],
    "four at first": [0.0, 0.2, 0.4, 0.6, 3.5, 4.0],
    "finer": [0.0, 0.4, 0.9, 1.3, 1.6, 2.2, 2.7, 3.1, 4.0],
    "coarser": [0.0, 2.5, 4.0],
    "of which some agree": [0.0, 0.75, 1.5, 2.25, 3.0, 4.0],
}


@pytest.fixture(autouse=True)
def precision():
    with ctx.workprec(96):
        yield


def loop_of(system, changes, shape, initial=None):
    d, ends = system.states, [0.0, 1.0, 2.0, 3.0, 4.0]
    return VerifiedLoop(
        system, [0.0] * d, [arb_mat(1, 1)] * 4, np.zeros((4, 4, 1, d)), sorted({*ends, *changes}), ends, changes[:-1],
        shape, initial,
    )  # fmt: skip


def matrix_of(loop, k):
    """The floats ``D (k d, blocks mw)`` from all deviations to what the control on piece ``k`` may answer."""
    d, starts = loop.innovations.outputs, loop.deviations.starts
    D = np.zeros(((k + 1) * d, starts[-1]))
    for j in range(k + 1):
        for block, part in loop.innovations.matrices[j].items():
            D[j * d : (j + 1) * d, starts[block] : starts[block + 1]] = [[float(x) for x in r] for r in part.tolist()]
    return D


def most_of(D, q, widths, room):
    """The largest ``F q`` over ``F = M D`` with a width ``sum |F| widths`` of at most ``room``, by a linear program."""
    _, sizes, rows = np.linalg.svd(D)
    basis = rows[: int((sizes > 1e-9).sum())]  # F = a basis, |F| <= s
    r, n = basis.shape
    bounds = np.block([[basis.T, -np.eye(n)], [-basis.T, -np.eye(n)], [np.zeros((1, r)), widths[None]]])
    found = linprog(
        -np.concatenate([basis @ q, np.zeros(n)]), bounds, np.append(np.zeros(2 * n), room),
        bounds=[(None, None)] * r + [(0, None)] * n,
    )  # fmt: skip
    return -found.fun


def rows_of(loop, rng, honest, k=3):
    """Three rows on piece ``k`` with deviations; ``honest`` ones whose innovations add up to 0 there."""
    n = loop.deviations.starts[-1]
    slopes, weights = rng.normal(size=3), rng.uniform(0.5, 1.0, 3)
    z = rng.uniform(-1.0, 1.0, (3, n))
    if honest:
        D = matrix_of(loop, k)
        total = (weights * slopes) @ z
        z[2] -= np.linalg.pinv(D, 1e-9) @ (D @ total) / (weights[2] * slopes[2])
    rows = [
        (y, ConstraintRow(arb(0), [[arb(s if i == k else 0.0)] for i in range(4)],
                          deviations=[[arb(float(x)) for x in v[a:b]] for a, b in pairwise(loop.deviations.starts)]))
        for y, s, v in zip(weights.tolist(), slopes.tolist(), z, strict=True)
    ]  # fmt: skip
    return rows, (weights * slopes) @ z


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("name", PLANTS)
def test_no_gains_add_more_and_honest_rows_leave_them_nothing(name: str, grid: str) -> None:
    A, E = PLANTS[name]
    rng, half = np.random.default_rng(3), np.linspace(0.5, 1.5, E.shape[1])
    loop = loop_of(LinearSystem(A, np.ones((len(A), 1)), E), GRIDS[grid], Box(-half, half))
    bound = GainsBound(loop, np.tril(np.ones((4, 4), dtype=bool)), Box([-1.0], [1.0]))
    widths = np.tile(2.0 * half, loop.deviations.blocks)
    for _ in range(3):
        rows, q = rows_of(loop, rng, honest=False)
        least = most_of(matrix_of(loop, 3), q, widths, 2.0)
        assert float(bound.of(rows)) >= least - 1e-9
        assert float(bound.of(rows_of(loop, rng, honest=True)[0])) <= 1e-9 * np.abs(q).max()


def test_the_bound_is_attained_where_one_number_is_measured_of_one_block() -> None:
    """``D`` is regular, and ``F`` free: all of the width is spent on the block of the largest share."""
    loop = loop_of(LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1))), GRIDS["alike"], Box([-1.0], [1.0]))
    bound = GainsBound(loop, np.tril(np.ones((4, 4), dtype=bool)), Box([-3.0], [3.0]))
    rows, q = rows_of(loop, np.random.default_rng(1), honest=False)
    assert float(bound.of(rows)) == pytest.approx(6.0 * np.abs(q[:3]).max() / 2.0)  # the last block is measured by none
    assert float(bound.of(rows)) == pytest.approx(most_of(matrix_of(loop, 3), q, np.full(4, 2.0), 6.0))


def test_a_direction_that_is_not_measured_leaves_gains_nothing() -> None:
    """Of an initial state only the first entry is measured: gains cannot answer the second one, however large."""
    system = LinearSystem(PLANTS["one push on two states"][0], np.ones((2, 1)), np.eye(2))
    loop = loop_of(system, GRIDS["alike"], None, Box([-1.0, -1.0], [1.0, 1.0]))
    seen = {loop.deviations.initial_block: arb_mat([[1, 0], [0, 0]])}
    loop.innovations.__dict__["_effects"] = [seen, {}, {}, {}], [{}] * 4
    bound = GainsBound(loop, np.tril(np.ones((4, 4), dtype=bool)), Box([-1.0], [1.0]))
    entry = loop.deviations.starts[loop.deviations.initial_block]
    for first, second in ((0.0, 5.0), (0.25, 5.0), (0.25, 0.0)):
        z = [arb(0)] * entry + [arb(first), arb(second)]
        row = ConstraintRow(arb(0), [[arb(1)]] + [[arb(0)]] * 3, deviations=[z[:entry], z[entry:]] if entry else [z])
        assert float(bound.of([(1.0, row)])) == pytest.approx(first, abs=1e-15)


def test_deviations_of_the_initial_state_and_of_thin_sets_are_counted_along_their_segments() -> None:
    rng, E = np.random.default_rng(7), np.eye(2)
    system = LinearSystem(PLANTS["one push on two states"][0], np.ones((2, 1)), E)
    for shape, vector, size in (
        (Zonotope([0.0, 0.0], [[1.0, 0.5]]), [1.0, 0.5], 2.0),
        (Polytope([[0.5, -1.0], [-0.5, 1.0], [1.0, 0.0], [-1.0, 0.0]], [0.0, 0.0, 1.0, 1.0]), [1.0, 0.5], 2.0),
    ):
        loop = loop_of(system, GRIDS["finer"], shape, Box([-0.1, -0.2], [0.1, 0.2]))
        bound = GainsBound(loop, np.tril(np.ones((4, 4), dtype=bool)), Box([-1.0], [1.0]))
        count, lines = loop.deviations.blocks, np.zeros((loop.deviations.starts[-1], loop.deviations.blocks + 2))
        for block in range(count):
            lines[2 * block : 2 * block + 2, block] = vector
        lines[2 * count :, count:] = np.eye(2)
        shares = rng.normal(size=count + 2)
        z = lines @ shares
        parts = [[arb(float(x)) for x in z[a:b]] for a, b in pairwise(loop.deviations.starts)]
        rows = [(1.0, ConstraintRow(arb(0), [[arb(float(i == 3))] for i in range(4)], deviations=parts))]
        least = most_of(matrix_of(loop, 3) @ lines, shares, np.append(np.full(count, size), [0.2, 0.4]), 2.0)
        assert float(bound.of(rows)) >= least - 1e-9


def test_what_a_disturbance_moves_is_found_without_rounding() -> None:
    moved = {
        "one state": ([0], [0], [[1]]),
        "one push on two states": ([0, 1], [0], [[1]]),
        "two pushes that are one": ([0, 1], [0], [[1, 2]]),
        "a state that nothing reaches": ([0, 1], [0, 1], [[1, 0], [0, 1]]),
        "two states that are one": ([0, 1], [0], [[1]]),
    }
    for name, (states, vectors, table) in moved.items():
        A, E = PLANTS[name]
        loop = loop_of(
            LinearSystem(A, np.ones((len(A), 1)), E), GRIDS["alike"], Box(-np.ones(E.shape[1]), np.ones(E.shape[1]))
        )
        found = find_independent(loop, np.eye(E.shape[1], dtype=int).tolist())
        assert found[:2] == (states, vectors)
        assert found[2] == arb_mat(table)
    A, E = PLANTS["two pushes that are one"]
    modes = [LinearSystem(A, np.ones((2, 1)), matrix) for matrix in (E, E[:, ::-1])]
    loop = loop_of(SwitchedSystem([(1.5, modes[0]), (4.0, modes[1])]), GRIDS["alike"], Box(-np.ones(2), np.ones(2)))
    assert find_independent(loop, [[1, 0], [0, 1]])[1] == [0, 1]  # they are one in each mode, in another way
    below = [["0", "0", "0"], ["t", "0", "0"], ["0", "0", "1"]]
    timed = VaryingSystem.of(below, [["1"], ["1"], ["1"]], 4.0, [["1", "1"], ["0", "exp(1e-17 + 0*t)"], ["0", "0"]])
    with ctx.workprec(192):
        found = find_independent(loop_of(timed, GRIDS["alike"], Box(-np.ones(2), np.ones(2))), [[1, 0], [0, 1]])
    assert found[:2] == ([0, 1], [0, 1])  # columns that differ by 1e-17 are two, and the third state is reached by none


def test_breakpoints_that_differ_by_rounding_are_one() -> None:
    """At 9/15 and 12/20 of three units of time doubles differ in the last place. A block that begins there is not
    measured there."""
    problem = sr.OptimalControlProblem(
        system=LinearSystem([[0.0, 1.0], [9.0, 0.0]], ONE, ONE), horizon=3.0, initial_state=[0.3, 0.0],
        control=Box([-3.0], [3.0]), disturbance=Box([-0.3], [0.3]),
    )  # fmt: skip
    control, disturbance = (sr.Dictionary.indicators(np.linspace(0.0, 3.0, n + 1)) for n in (15, 20))
    assert control.breakpoints[9] != disturbance.breakpoints[12]
    case = Case(problem, control, disturbance, {}, policy=AffinePolicy())
    assert case.disturbance.breakpoints[12] == control.breakpoints[9]
    assert len(case.timing.grid) == 31
    bound = GainsBound(VerifiedLoop(
        problem.system, [0.3, 0.0], [arb_mat(1, 1)] * 15, np.zeros((15, 15, 1, 2)), case.timing.grid,
        control.breakpoints.tolist(), case.disturbances.changes, problem.disturbance,
    ), case.answers, problem.control)  # fmt: skip
    assert 12 not in {block for members in bound._cluster_breakpoints(9) for block in bound._list_blocks(members)}


def test_breakpoints_are_moved_for_what_is_measured_alone_and_by_rounding_alone() -> None:
    """In open loop every time is taken as it is, and so are the last one and those that differ by more."""
    problem = sr.OptimalControlProblem(
        system=LinearSystem([[0.0, 1.0], [9.0, 0.0]], ONE, ONE), horizon=3.0, initial_state=[0.3, 0.0],
        control=Box([-3.0], [3.0]), disturbance=Box([-0.3], [0.3]),
    )  # fmt: skip
    control = sr.Dictionary.indicators(np.linspace(0.0, 3.0, 16))
    near = control.breakpoints + 3.0 * np.array([0.0, 1e-13, *[1e-16] * 13, 2e-16])
    disturbance = sr.Dictionary.indicators(near)
    in_open_loop = Case(problem, control, disturbance, {})
    assert in_open_loop.disturbance.breakpoints.tolist() == near.tolist()
    answering = Case(problem, control, disturbance, {}, policy=AffinePolicy())
    assert answering.disturbance.breakpoints.tolist() == [0.0, near[1], *control.breakpoints[2:-1], near[-1]]


HONEST = {
    "breakpoints that differ by rounding": (
        {"A": [[0, 1], [9, 0]], "B": [[0], [1]], "E": [[0], [1]]}, 3.0, [0.3, 0], 3.0, 0.3, [0.1, 0.3],
        [0.32, 0.8], (15, 20),
    ),
    "two disturbances that are one": (
        {"A": [[0, 1], [0, 0]], "B": [[0], [1]], "E": [[0, 0], [1, 1]]}, 5.0, [4, 0], 1.0, [0.15, 0.15], [0.5, 0.4],
        [4.2, 1.6], (10, 10),
    ),
    "a state that nothing reaches": (
        {"A": [[0, 1, 0], [0, 0, 1], [0, 0, -1]], "B": [[0], [1], [0]], "E": [[0], [1], [0]]}, 5.0, [4, 0, 0.1], 1.0,
        0.3, [0.5, 0.4, 1.0], [4.2, 1.6, 1.0], (10, 40),
    ),
    "two carts that are one": (
        {"A": [[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]], "B": [[0], [1], [0], [1]],
         "E": [[0], [1], [0], [1]]}, 5.0, [4, 0, 4, 0], 1.0, 0.3, [0.5, 0.4, 0.5, 0.4], [4.2, 1.6, 4.2, 1.6], (10, 40),
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", HONEST)
def test_honest_runs_are_verified_whatever_depends_on_what(name: str, tmp_path: Path) -> None:
    system, horizon, start, force, push, end, wall, (pieces, blocks) = HONEST[name]
    said = {
        "problem": {
            "name": "linear", "system": system, "horizon": horizon, "initial_state": start,
            "control": {"box": force}, "disturbance": {"box": push}, "path": [{"box": wall}],
            "terminal": [{"box": end}],
        },
        "dictionaries": {
            "control": {"name": "piecewise_constant", "pieces": pieces},
            "disturbance": {"name": "piecewise_constant", "pieces": blocks},
        },
        "policy": {"name": "affine"}, "seed": 0,
    }  # fmt: skip
    outcome = sr.run(said, out=tmp_path / "run", quiet=True, figures=False)
    found = check(outcome.directory)
    assert found.status == "verified", [claim.text for claim in found.claims if claim.verdict != "holds"]


@pytest.mark.parametrize("breakpoints", [[0, 0.2, 0.4, 0.6, 3.5, 4], [0, 1.5, 1.7, 4], [0, 0.3, 2, 2.1, 2.2, 4]])
def test_the_lower_bound_of_a_policy_is_verified_where_the_disturbance_has_breakpoints_of_its_own(
    breakpoints: list[float], tmp_path: object
) -> None:
    config = {
        "problem": {
            "name": "linear",
            "system": {"A": [[-0.1]], "B": [[1]], "E": [[1]]},
            "horizon": 4.0,
            "initial_state": [2],
            "control": {"box": 1.0},
            "disturbance": {"box": [0.2]},
            "terminal": [{"box": [0.3]}],
        },
        "dictionaries": {
            "control": {"name": "piecewise_constant", "pieces": 4},
            "disturbance": {"name": "piecewise_constant", "breakpoints": breakpoints},
        },
        "policy": {"name": "affine", "cost": "peak"},
        "observers": [],
    }
    sr.run(config, out=f"{tmp_path}/run", quiet=True, figures=False)
    assert sr.check(f"{tmp_path}/run").status == "verified"
