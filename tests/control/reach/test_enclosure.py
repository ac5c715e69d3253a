"""Guards control/reach/enclosure: bounds of the violation on cells: never below a dense maximum, and close to it on
small cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.sets import Ellipsoid, NormBall, Polytope
from sparserob_core.sip.convex_set import Box
from tests.support.plants import indicators, uniform, walsh, worst_case

HORIZON = 3.0
GRIDS = {"uniform": uniform(6, HORIZON), "uneven": indicators([0.0, 0.4, 0.5, 1.6, HORIZON])}
BOUNDS = {
    "none": None,
    "box": Box([-0.1, -0.3], [0.2, 0.1]),
    "ellipsoid": Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.02]]),
    "1-norm": NormBall(p=1.0, radius=0.2, dimension=2),
    "triangle": Polytope([[1.0, 1.0], [-1.0, 0.2], [0.0, -1.0]], [0.3, 0.2, 0.1]),
}


def system_of(rng, nu, speed=1.0, spread=0.3):
    A, B, E = speed * rng.normal(size=(nu + 1, 2, 2)), rng.normal(size=(nu + 1, 2, 1)), rng.normal(size=(nu + 1, 2, 2))
    if not nu:
        return LinearSystem(A[0], B[0], E[0])

    def affine(matrices):
        return lambda p: (
            matrices[0]
            + sum(
                spread * np.sin(p[i]) * matrices[i + 1] if i == 0 else spread * p[i] * p[0] * matrices[i + 1]
                for i in range(nu)
            )
        )

    return LinearSystem(affine(A), affine(B), affine(E), parameters=Box([-1.0] * nu, [1.0] * nu))


def constraint_of(
    rng, system, dictionary, bound, disturbance=None, kind="piecewise_constant", rows=3, start=0.0, stop=HORIZON
):
    functionals = worst_case(system, dictionary, disturbance, bound, kind, rng.normal(size=system.states))
    return FlatConstraint(
        "path",
        functionals,
        rng.normal(size=(rows, system.states)),
        rng.normal(size=rows),
        start,
        stop,
        ParameterIndex(system.parameters),
    )


def sampled_maximum(constraint, x, lower, upper, rng, count=300):
    """The largest violation at random indices of a cell, its corners and its ends in time included."""
    d = lower.size
    unit = np.vstack(
        [
            rng.uniform(size=(count, d)),
            rng.integers(0, 2, size=(count // 8, d)),
            np.clip(1.5 * rng.uniform(size=(count // 5, d)) - 0.25, 0, 1),
        ]
    )
    indices = lower + unit * (upper - lower)
    G, rhs = constraint.rows(indices)
    return float((G @ x - rhs).max())


def check(constraint, x, rng, lower, upper, count=300, slack=1e-10):
    found = constraint.enclosure(x, lower, upper)
    for low, high, bound in zip(lower, upper, found.bounds, strict=True):
        truth = sampled_maximum(constraint, x, low, high, rng, count)
        assert np.isfinite(bound)
        assert truth <= bound + slack * max(1.0, abs(truth)), f"cell {low} to {high}: {truth} found, {bound} claimed"
    return found


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    nu=st.sampled_from([0, 0, 1, 2, 3]),
    bound=st.sampled_from(sorted(BOUNDS)),
    grid=st.sampled_from(sorted(GRIDS)),
)
def test_no_violation_in_a_cell_is_above_its_bound(seed, nu, bound, grid):
    rng = np.random.default_rng(seed)
    constraint = constraint_of(rng, system_of(rng, nu), GRIDS[grid], BOUNDS[bound])
    x = rng.normal(size=constraint.functionals.variables)
    lower, upper = constraint.cells
    if nu:  # parts of the box of parameters, the same for some of the cells
        ends = np.sort(rng.uniform(-1, 1, (2, nu)), axis=0)
        lower[::2, 1:], upper[::2, 1:] = ends
    check(constraint, x, rng, lower, upper)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), nu=st.sampled_from([0, 1, 2]), bound=st.sampled_from(["none", "box", "ellipsoid"]))
def test_no_violation_in_a_part_of_a_piece_is_above_its_bound(seed, nu, bound):
    rng = np.random.default_rng(seed)
    constraint = constraint_of(rng, system_of(rng, nu, speed=2.0), GRIDS["uneven"], BOUNDS[bound], start=0.2, stop=2.0)
    lower, upper = constraint.cells
    ends = np.sort(rng.uniform(size=(2, lower.shape[0])), axis=0)
    width = upper[:, 0] - lower[:, 0]
    lower[:, 0], upper[:, 0] = lower[:, 0] + ends[0] * width, lower[:, 0] + ends[1] * width
    check(constraint, rng.normal(size=constraint.functionals.variables), rng, lower, upper)


@settings(max_examples=10, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    kind=st.sampled_from(["l1_ball", "incomplete", "walsh", "other pieces", "measurable"]),
    nu=st.sampled_from([0, 1]),
)
def test_every_class_of_disturbances_is_enclosed(seed, kind, nu):
    rng = np.random.default_rng(seed)
    disturbance = {"l1_ball": walsh(4, HORIZON, 3), "incomplete": walsh(4, HORIZON, 2), "walsh": walsh(4, HORIZON)}.get(
        kind, uniform(5, HORIZON)
    )
    bound = Box([-0.2, -0.3], [0.2, 0.3]) if kind == "l1_ball" else BOUNDS["box"]
    system = system_of(rng, 0 if kind == "measurable" else nu)
    of = kind if kind in ("l1_ball", "measurable") else "piecewise_constant"
    constraint = constraint_of(rng, system, GRIDS["uneven"], bound, disturbance, of)
    check(
        constraint,
        rng.normal(size=constraint.functionals.variables),
        rng,
        *constraint.cells,
        count=5 if kind == "measurable" else 300,
    )


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    nu=st.sampled_from([0, 1, 2]),
    bound=st.sampled_from(["none", "box"]),
    initial=st.sampled_from(["box", "ellipsoid", "1-norm", "triangle"]),
    grid=st.sampled_from(sorted(GRIDS)),
)
def test_the_worst_initial_state_of_a_set_is_enclosed(seed, nu, bound, initial, grid):
    rng = np.random.default_rng(seed)
    plain = constraint_of(rng, system_of(rng, nu), GRIDS[grid], BOUNDS[bound])
    constraint = replace(plain, functionals=replace(plain.functionals, initial=BOUNDS[initial]))
    x, (lower, upper) = rng.normal(size=plain.functionals.variables), plain.cells
    if nu:
        lower[::2, 1:], upper[::2, 1:] = np.sort(rng.uniform(-1, 1, (2, nu)), axis=0)
    check(constraint, x, rng, lower, upper)
    middles = (lower + upper) / 2
    exact = [(G @ x - rhs).max() for G, rhs in zip(*constraint.rows(middles), strict=True)]
    np.testing.assert_allclose(constraint.enclosure(x, middles, middles).bounds, exact, rtol=1e-7, atol=1e-7)


def test_an_l1_ball_of_functions_larger_than_one_is_enclosed():
    rng = np.random.default_rng(0)
    large = Dictionary(np.linspace(0, HORIZON, 4), 1000 * np.eye(3))
    for _ in range(3):
        constraint = constraint_of(
            rng, system_of(rng, 1, spread=1.0), GRIDS["uneven"], Box([-0.2, -0.3], [0.2, 0.3]), large, "l1_ball"
        )
        check(constraint, rng.normal(size=constraint.functionals.variables), rng, *constraint.cells)


@pytest.mark.first(5)
@pytest.mark.parametrize("rate", [-3.0, -20.0, -60.0, -400.0, -3000.0])
@pytest.mark.parametrize("bound", ["none", "box"])
def test_a_stiff_system_on_long_pieces_is_enclosed(rate, bound):
    """The lifted norm times the length of a piece is large: no series may cancel, no exponential overflow to a bound
    that is not one."""
    rng = np.random.default_rng(1)
    system = LinearSystem([[rate, 1.0], [0.0, -0.5]], [[1.0], [1.0]])
    constraint = constraint_of(rng, system, uniform(3, HORIZON), BOUNDS[bound])
    x = rng.normal(size=3)
    lower, upper = constraint.cells
    halves = np.linspace(0, 1, 9)
    lower, upper = (
        np.concatenate([lower + f * (upper - lower) for f in halves[:-1]]),
        np.concatenate([lower + f * (upper - lower) for f in halves[1:]]),
    )
    with np.errstate(over="ignore", invalid="ignore"):
        bounds = constraint.enclosure(x, lower, upper).bounds
    assert not np.isnan(bounds).any()
    for low, high, claimed in zip(lower, upper, bounds, strict=True):
        truth = sampled_maximum(constraint, x, low, high, rng, 50)
        assert truth <= claimed + 1e-9


@pytest.mark.parametrize("rate", [-60.0, -400.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_stiff_bound_is_the_violation_at_a_single_time(rate, side):
    """Whatever the sign of the row: an error of the series must not close a cell that is violated."""
    system = LinearSystem([[rate, 1.0], [0.0, -0.5]], [[1.0], [1.0]])
    functionals = worst_case(system, uniform(3, HORIZON), bound=BOUNDS["box"], initial_state=[1.0, 1.0])
    constraint = FlatConstraint(
        "path", functionals, np.array([[side, 0.0]]), np.zeros(1), 0.0, HORIZON, ParameterIndex(None)
    )
    x, times = np.array([0.3, -0.3, 0.8]), np.array([[0.9], [1.0], [2.7], [HORIZON]])
    G, rhs = constraint.rows(times)
    with np.errstate(all="ignore"):
        bounds = constraint.enclosure(x, times, times).bounds
    assert np.allclose(bounds, (G @ x - rhs)[:, 0], rtol=1e-9, atol=1e-9)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("nu", "bound"),
    [
        (0, "box"),
        (1, "none"),
        *(
            pytest.param(nu, bound, marks=pytest.mark.slow)
            for nu, bound in [
                (1, "ellipsoid"),
                (1, "triangle"),
                (2, "box"),
                (0, "none"),
                (0, "ellipsoid"),
                (1, "box"),
                (1, "1-norm"),
                (3, "none"),
            ]
        ),
    ],
)
def test_the_bound_converges_quadratically_as_the_cell_shrinks(nu, bound):
    """Up to where the Taylor model of the parameters and the sign of a disturbance flip; measured over the median of
    several cells."""
    rng = np.random.default_rng(3)
    excess = []
    constraint = constraint_of(rng, system_of(rng, nu), uniform(30, HORIZON), BOUNDS[bound], rows=1)
    x = rng.normal(size=constraint.functionals.variables)
    times, middles = rng.uniform(0, HORIZON, 8), rng.uniform(-0.8, 0.8, (8, nu))
    piece = constraint.functionals.response.grid.locate(times)
    low, high = (
        constraint.functionals.response.grid.breakpoints[piece],
        constraint.functionals.response.grid.breakpoints[piece + 1],
    )
    for size in (0.2, 0.05, 0.0125):
        centre = np.clip(times, low + 0.05 * size, high - 0.05 * size)
        lower = np.hstack([np.maximum(centre - 0.05 * size, low)[:, None], middles - size])
        upper = np.hstack([np.minimum(centre + 0.05 * size, high)[:, None], middles + size])
        bounds = constraint.enclosure(x, lower, upper).bounds
        excess.append(
            [b - sampled_maximum(constraint, x, a, c, rng, 800) for b, a, c in zip(bounds, lower, upper, strict=True)]
        )
    excess = np.median(excess, axis=1)
    assert (excess >= -1e-10).all()
    assert excess[1] <= excess[0] / 8 + 1e-9
    assert excess[2] <= excess[1] / 8 + 1e-9


def test_the_bound_of_a_single_index_is_its_violation():
    rng = np.random.default_rng(4)
    for nu in (0, 1, 2):
        constraint = constraint_of(rng, system_of(rng, nu), GRIDS["uneven"], BOUNDS["box"])
        x = rng.normal(size=constraint.functionals.variables)
        points = np.hstack([np.array([0.0, 0.4, 0.5, 1.1, HORIZON])[:, None], rng.uniform(-1, 1, (5, nu))])
        G, rhs = constraint.rows(points)
        assert np.allclose(
            constraint.enclosure(x, points, points).bounds, (G @ x - rhs).max(axis=1), rtol=1e-9, atol=1e-9
        )


def test_cells_outside_the_set_of_parameters_are_closed():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(2, 2))
    simplex = Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.0, 0.0, 1.0])
    system = LinearSystem(
        lambda p: A + p[0] * np.eye(2), lambda p: np.array([[p[1]], [1 + 0 * p[0]]]), parameters=simplex
    )
    constraint = constraint_of(rng, system, GRIDS["uniform"], None)
    lower, upper = np.array([[0.0, 0.0, 0.0], [0.0, 0.6, 0.6]]), np.array([[0.5, 0.4, 0.4], [0.5, 1.0, 1.0]])
    bounds = constraint.enclosure(rng.normal(size=6), lower, upper).bounds
    assert np.isfinite(bounds[0])
    assert bounds[1] == -np.inf


STIFF = {
    "chemistry": [[-1000.0, 990.0, 0.0], [0.0, -50.0, 49.0], [0.0, 0.0, -1.0]],
    "servo": [[0.0, 1.0], [-1e6, -1000.0]],
    "long oscillation": [[0.0, 40.0], [-160.0, -8.0]],
    "a defective fast mode": [[-500.0, 500.0, 0.0], [0.0, -500.0, 1.0], [0.0, 0.0, -1.0]],
    "unstable": [[6.0, 1.0], [0.5, -200.0]],
}


@pytest.mark.first(7)
@pytest.mark.parametrize("kind", ["piecewise_constant", "measurable", "none"])
@pytest.mark.parametrize("name", sorted(STIFF))
def test_stiff_long_and_unstable_systems_are_enclosed_on_pieces_of_any_length(name, kind):
    rng = np.random.default_rng(5)
    A = np.array(STIFF[name])
    system = LinearSystem(A, rng.normal(size=(A.shape[0], 1)), rng.normal(size=(A.shape[0], 2)))
    bound = None if kind == "none" else BOUNDS["box"]
    of = "measurable" if kind == "measurable" else "piecewise_constant"
    constraint = constraint_of(rng, system, uniform(3, HORIZON), bound, kind=of)
    x = rng.normal(size=3)
    lower, upper = constraint.cells
    for _ in range(
        2 if kind == "measurable" else 6
    ):  # cells at the beginning of every piece, where fast modes move, and the rest of it
        middle = lower + 0.2 * (upper - lower)
        check(constraint, x, rng, middle, upper, count=3 if kind == "measurable" else 100)
        upper = middle


@pytest.mark.parametrize("name", ["chemistry", "servo", "a defective fast mode"])
def test_the_bound_of_a_cell_does_not_depend_on_the_length_of_its_piece(name):
    """Where the fast modes have died away, a cell of a tenth of a second is bounded as if there were no fast mode."""
    A = np.array(STIFF[name])
    system = LinearSystem(A, np.ones((A.shape[0], 1)), np.eye(A.shape[0])[:, :2])
    x = {}
    for pieces in (1, 30):
        rng = np.random.default_rng(6)
        constraint = constraint_of(rng, system, uniform(pieces, HORIZON), None)
        found = constraint.enclosure(np.ones(pieces), np.array([[1.2]]), np.array([[1.3]]))
        truth = sampled_maximum(constraint, np.ones(pieces), np.array([1.2]), np.array([1.3]), rng)
        x[pieces] = found.bounds[0] - truth
        assert x[pieces] <= 0.01


def exact_exponential(A, duration):
    """``e^{A r}`` of a dyadic matrix in 300-bit ball arithmetic."""
    import flint

    flint.ctx.prec = 300
    try:
        return flint.arb_mat([[flint.arb(entry) * flint.arb(duration) for entry in row] for row in A.tolist()]).exp()
    finally:
        flint.ctx.prec = 53


@pytest.mark.parametrize("growth", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("pieces", [1, 8])
def test_the_bound_of_a_single_time_is_above_the_state_in_exact_arithmetic(growth, pieces):
    """The state grows up to ``e^15``, and the rounding of every product on the way with it."""
    import flint

    A = np.array([[growth, 1.0, 0.3], [-0.7, growth - 1, 0.2], [0.1, 0.5, -1.5]])
    system = LinearSystem(A, np.ones((3, 1)), np.eye(3)[:, :1])
    start = np.array([0.7, -1.3, 0.4])
    functionals = worst_case(system, uniform(pieces, HORIZON), initial_state=start)
    truth = exact_exponential(A, HORIZON) * flint.arb_mat([[flint.arb(x)] for x in start.tolist()])
    for sign in (1.0, -1.0):
        for state in range(3):
            exact = float(sign * truth[state, 0].mid())
            one = FlatConstraint(
                "end",
                functionals,
                sign * np.eye(3)[[state]],
                np.array([exact]),
                HORIZON,
                HORIZON,
                ParameterIndex(None),
            )
            found = one.enclosure(np.zeros(functionals.variables), np.array([[HORIZON]]), np.array([[HORIZON]]))
            assert found.bounds[0] + 2e-16 * abs(exact) >= 0.0
            assert found.bounds[0] <= 1e-10 * np.exp(growth * HORIZON)
