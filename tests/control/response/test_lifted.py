"""Guards control/response/lifted: taylor models of uncertain systems, and bounds of polynomials: they enclose what
sampling finds."""

from __future__ import annotations

import tracemalloc
from contextlib import contextmanager

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from sparserob_core.control.enclosures.comparison import block_norms
from sparserob_core.control.enclosures.polynomial import polynomial_bound
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.reach.disturbance_support import DisturbanceSupport
from sparserob_core.control.reach.many_directions import ManyDirections
from sparserob_core.control.response import lifted as lifted_module
from sparserob_core.control.response import response as response_module
from sparserob_core.control.response.lifted import frozen, lift
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.expressions.taylor import TaylorSpace
from tests.support.plants import indicators, simulated, uniform, worst_case

HORIZON = 3.0


def oscillator(p):
    return np.array([[0 * p[0], 1 + 0 * p[0]], [-(p[0] ** 2), -0.1 + 0 * p[0]]])


def family(entries):
    """A function of ``p`` from a matrix of functions of ``p``."""
    return lambda p: np.array([[entry(p) if callable(entry) else entry + 0 * p[0] for entry in row] for row in entries])


SYSTEMS = {  # name: (A, B, E, centre, radius)
    "stable": (
        family([[lambda p: -1 + p[0], 0.5], [0.0, lambda p: -2 + p[1]]]),
        np.ones((2, 1)),
        np.eye(2),
        [0.1, -0.2],
        [0.3, 0.4],
    ),
    "oscillating": (oscillator, [[0.0], [1.0]], np.eye(2), [2.0], [0.3]),
    "unstable": (
        family([[lambda p: 0.8 + p[0], 1.0], [0.2, lambda p: 0.5 * p[0]]]),
        np.ones((2, 1)),
        np.eye(2),
        [0.0],
        [0.3],
    ),
    "sine": (
        family([[0.0, 1.0], [lambda p: -np.sin(p[0]), lambda p: -0.2 * np.cos(p[0])]]),
        np.ones((2, 1)),
        np.eye(2),
        [1.0],
        [0.7],
    ),
    "defective": (
        family([[lambda p: -1 + p[0], 1.0, 0.0], [0.0, lambda p: -1 + p[0], 1.0], [0.0, 0.0, -1.0]]),
        [[0.0], [0.0], [1.0]],
        np.eye(3)[:, :2],
        [0.0],
        [0.2],
    ),
    "integrators": (
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        family([[0.0], [lambda p: 1 / (1 + p[0])]]),
        family([[1.0, 0.0], [0.0, lambda p: p[0]]]),
        [0.1],
        [0.4],
    ),
    "everything": (
        family([[lambda p: -0.5 + p[0] * p[1], 1.0], [lambda p: -(p[2] ** 2), lambda p: -0.3 + p[1]]]),
        family([[lambda p: p[0]], [lambda p: 1 + p[1]]]),
        family([[lambda p: 1 + p[2], 0.0], [lambda p: p[0], lambda p: np.exp(p[1])]]),
        [0.0, 0.1, 1.5],
        [0.3, 0.2, 0.2],
    ),
    "four": (
        family([[lambda p: -0.5 + p[0], lambda p: 1 + p[1]], [lambda p: -2 + p[2], lambda p: -0.3 + p[3]]]),
        np.ones((2, 1)),
        family([[lambda p: 1 + p[0], 0.0], [0.0, lambda p: 1 + p[3]]]),
        [0.0] * 4,
        [0.2] * 4,
    ),
    "fast": (family([[lambda p: -12 + p[0], 2.0], [1.0, -0.5]]), np.ones((2, 1)), np.eye(2), [0.0], [1.0]),
}
GRIDS = {
    "uniform": uniform(6, HORIZON),
    "uneven": indicators([0.0, 0.4, 0.5, 1.6, HORIZON]),
    "single": uniform(1, HORIZON),
}


def made(name, grid, scale=1.0, bound=None):
    A, B, E, centre, radius = SYSTEMS[name]
    centre, radius = np.array(centre), scale * np.array(radius)
    system = LinearSystem(A, B, E, parameters=Box(centre - radius, centre + radius))
    functionals = worst_case(system, GRIDS[grid], bound=bound, initial_state=np.arange(1.0, 1 + system.states))
    return functionals, lift(
        system.phases[0], functionals.response.grid, functionals.response.initial_state, centre, radius
    )


def state_remainder(lifted, control):
    """Norm bounds ``(L, q)`` of the remainder of the state's Taylor models, and of these, piece by piece."""
    every, none = np.eye(lifted.starts.size), np.zeros((lifted.starts.size,) * 2)
    return lifted.along(control, every, none).T, lifted.along(control, none, every).T


def deltas(rng, nu):
    return np.vstack([rng.uniform(-1, 1, (6, nu)), np.sign(rng.normal(size=(4, nu)))])


@pytest.mark.first(27)
@pytest.mark.parametrize("grid", sorted(GRIDS))
@pytest.mark.parametrize("name", sorted(SYSTEMS))
@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_the_taylor_model_of_the_state_encloses_every_trajectory_of_the_cell(name, grid, scale):
    rng = np.random.default_rng(1)
    functionals, lifted = made(name, grid, scale)
    system, response = functionals.response.system, functionals.response
    control = rng.normal(size=(1, GRIDS[grid].pieces))
    nodes = lifted.nodes(control)
    remainder, _ = state_remainder(lifted, control)
    _, _, _, centre, radius = SYSTEMS[name]
    for delta in deltas(rng, lifted.space.nu):
        p = np.array(centre) + scale * np.array(radius) * delta
        A, B, _ = (matrix[0] for matrix in system.phases[0].matrices(p[None]))
        polynomial = np.einsum("a,lai->li", lifted.space.monomials(delta[None])[0], nodes)
        for piece, stop in enumerate(response.grid.breakpoints[1:]):
            truth = simulated(A, [(B, GRIDS[grid].breakpoints, control)], response.initial_state, stop, np.array([0.0]))
            error = np.abs(np.linalg.solve(lifted.transform, truth) - polynomial[piece + 1])
            allowed = remainder[piece] * (1 + 1e-9) + 1e-11 * max(1.0, np.abs(truth).max()) * np.linalg.cond(
                lifted.transform
            )
            assert (block_norms(error, lifted.starts) <= allowed).all()


@pytest.mark.parametrize("name", sorted(SYSTEMS))
def test_the_taylor_model_of_a_functional_encloses_it_over_the_cell(name):
    rng = np.random.default_rng(2)
    functionals, lifted = made(name, "uneven")
    _, _, _, centre, radius = SYSTEMS[name]
    direction = rng.normal(size=lifted.states)
    nodes, remainder = lifted.row_nodes(direction[None])[0], lifted.row_bounds(direction[None])[1][0]
    for delta in deltas(rng, lifted.space.nu):
        A = functionals.response.system.phases[0].matrices((np.array(centre) + np.array(radius) * delta)[None])[0][0]
        T = lifted.transform
        for piece, stop in enumerate(lifted.fine.breakpoints[1:]):
            truth = direction @ np.linalg.solve(T, expm(A * stop) @ T)
            polynomial = lifted.space.monomials(delta[None])[0] @ nodes[piece + 1]
            allowed = remainder[piece] * (1 + 1e-9) + 1e-10 * max(1.0, np.linalg.norm(truth))
            assert (block_norms(truth - polynomial, lifted.starts) <= allowed).all()


@pytest.mark.first(13)
@pytest.mark.parametrize("name", sorted(SYSTEMS))
@pytest.mark.parametrize("grid", sorted(GRIDS))
def test_the_push_is_enclosed_over_the_cell(name, grid):
    rng = np.random.default_rng(3)
    functionals, lifted = made(name, grid, bound=Box([-0.1, -0.3], [0.2, 0.1]))
    _, _, _, centre, radius = SYSTEMS[name]
    directions = rng.normal(size=(2, lifted.states))
    sigma = DisturbanceSupport(lifted, functionals.disturbance, directions @ lifted.transform)
    times = np.append(rng.uniform(0, HORIZON, 4), HORIZON)
    coefficients, excess = sigma.at(times, np.zeros((times.size, 2, lifted.space.nu)))
    neglected = sigma.neglected[:, functionals.response.grid.locate(times)].T
    for delta in deltas(rng, lifted.space.nu):
        p = np.array(centre) + np.array(radius) * delta
        truth = ManyDirections(functionals).profile(times, directions, p)
        bound = coefficients @ lifted.space.monomials(delta[None])[0] + excess + neglected
        assert (truth <= bound + 1e-10 * np.maximum(1.0, np.abs(truth))).all()


@pytest.mark.parametrize("name", ["oscillating", "sine", "unstable"])
def test_the_remainder_vanishes_with_the_cell(name):
    """Degree 6 for one parameter: halving a small cell divides what is neglected by about ``2^7``."""
    control = np.ones((1, 6))
    sizes = []
    for scale in (0.5, 0.25, 0.125):
        _, lifted = made(name, "uniform", scale)
        sizes.append(state_remainder(lifted, control)[0].max())
    assert sizes[1] <= sizes[0] / 60
    assert sizes[2] <= sizes[1] / 60


@pytest.mark.parametrize("nu", [1, 4])
def test_products_of_a_functional_and_an_uncertain_disturbance_matrix_are_enclosed(nu):
    """``sigma = (1 + p) int_0^1 e^{0.3 q s} ds`` at the corner of the cell: terms above the degree of the models may
    not be lost."""
    system = LinearSystem(
        lambda p: np.array([[0.3 * p[0]]]),
        [[1.0]],
        lambda p: np.array([[1 + p[-1]]]),
        parameters=Box([-1.0] * nu, [1.0] * nu),
    )
    for rate in (1.0, 3.0, 10.0):
        quick = LinearSystem(
            lambda p, rate=rate: np.array([[rate * 0.3 * p[0]]]),
            [[1.0]],
            system.phases[0].E,
            parameters=system.parameters,
        )
        functionals = worst_case(quick, uniform(200, 1.0), bound=Box([1.0], [1.0]), initial_state=[0.0])
        lifted = lift(quick.phases[0], functionals.response.grid, np.zeros(1), np.zeros(nu), np.ones(nu))
        sigma = DisturbanceSupport(lifted, functionals.disturbance, lifted.transform)
        coefficients, excess = sigma.at(np.array([1.0]), np.zeros((1, 1, nu)))
        enclosed = coefficients[0, 0] @ lifted.space.monomials(np.ones((1, nu)))[0]
        slack = excess[0, 0] + sigma.neglected[0, -1]
        truth = 2 * np.expm1(0.3 * rate) / (0.3 * rate)
        assert abs(truth - enclosed) <= slack * (1 + 1e-9) + 1e-12, (
            f"rate {rate}: off by {truth - enclosed}, allowed {slack}"
        )


def test_what_is_neglected_counts_the_size_of_the_functions_of_an_l1_ball():
    system = LinearSystem(lambda p: np.array([[3 * p[0]]]), [[1.0]], parameters=Box([-1.0], [1.0]))
    large = Dictionary(np.array([0.0, 1.0]), np.array([[1000.0]]))
    functionals = worst_case(system, uniform(100, 1.0), large, Box([-1.0], [1.0]), "l1_ball", [0.0])
    lifted = lift(system.phases[0], functionals.response.grid, np.zeros(1), np.zeros(1), np.ones(1))
    sigma = DisturbanceSupport(lifted, functionals.disturbance, lifted.transform)
    coefficients, excess = sigma.at(np.array([1.0]), np.zeros((1, 1, 1)))
    enclosed = coefficients[0, 0] @ lifted.space.monomials(np.ones((1, 1)))[0]
    assert excess[0, 0] >= 0
    # the same disturbance is the worst on the whole cell
    assert abs(1000 * np.expm1(3) / 3 - enclosed) <= sigma.neglected[0, -1]


def test_of_a_known_system_only_rounding_is_left_out():
    system = LinearSystem([[0, 1], [-1, 0]], [[0.0], [1.0]])
    functionals = worst_case(system, GRIDS["uniform"], bound=Box([-1, -1], [1, 1]), initial_state=[1.0, 0.0])
    lifted = lift(system.phases[0], functionals.response.grid, np.array([1.0, 0.0]), np.zeros(0), np.zeros(0))
    assert state_remainder(lifted, np.ones((1, 6)))[0].max() < 1e-11
    assert DisturbanceSupport(lifted, functionals.disturbance, lifted.transform).neglected.max() < 1e-11
    states = functionals.response.states(np.ones((1, 6)), np.zeros((1, 0)))[0]
    assert np.allclose(lifted.nodes(np.ones((1, 6)))[:, 0] @ lifted.transform.T, states)


def test_a_frozen_system_is_the_system_at_that_parameter():
    functionals, _ = made("everything", "uniform")
    p = np.array([0.2, 0.1, 1.4])
    lifted = frozen(
        functionals.response.system.phases[0], functionals.response.grid, functionals.response.initial_state, p
    )
    control = np.ones((1, 6))
    assert np.allclose(lifted.nodes(control)[:, 0], functionals.response.states(control, p[None])[0], rtol=1e-12)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), nu=st.integers(1, 4), degree=st.integers(1, 4), sparse=st.booleans())
def test_the_bound_of_a_polynomial_is_above_its_dense_maximum(seed, nu, degree, sparse):
    rng = np.random.default_rng(seed)
    space = TaylorSpace(nu, degree)
    coefficients = rng.normal(size=(5, space.size)) * 0.4**space.degrees
    if sparse:
        coefficients *= rng.integers(0, 2, size=coefficients.shape)
    points = np.vstack(
        [
            rng.uniform(-1, 1, (2000, nu)),
            np.sign(rng.normal(size=(50, nu))),
            np.clip(2 * rng.normal(size=(500, nu)), -1, 1),
        ]
    )
    values = coefficients @ space.monomials(points).T
    bound, spread = polynomial_bound(space, coefficients)
    assert (bound >= values.max(axis=1) - 1e-12).all()
    assert (spread >= 0).all()
    assert spread.shape == (5, nu)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), nu=st.integers(1, 3))
def test_the_bound_of_a_concave_quadratic_with_its_top_inside_is_exact(seed, nu):
    rng = np.random.default_rng(seed)
    space = TaylorSpace(nu, 2)
    factor = rng.normal(size=(nu, nu)) + 2 * np.eye(nu)
    hessian, top = -factor @ factor.T, rng.uniform(-0.5, 0.5, nu)
    coefficients = np.zeros(space.size)
    unit = np.eye(nu, dtype=int)
    gradient = -hessian @ top
    for i in range(nu):
        coefficients[space.index[tuple(unit[i])]] = gradient[i]
        for j in range(i + 1):
            coefficients[space.index[tuple(unit[i] + unit[j])]] = hessian[i, j] / (2 if i == j else 1)
    bound, _ = polynomial_bound(space, coefficients[None])
    # A coordinate may be monotone on the box only if its range says so, and the top is inside.
    assert abs(bound[0] - -0.5 * top @ hessian @ top) <= 1e-10 * max(1.0, np.abs(hessian).max())


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_bound_of_a_quadratic_in_one_variable_is_exact(seed):
    space = TaylorSpace(1, 2)
    coefficients = np.random.default_rng(seed).normal(size=(50, 3))
    values = coefficients @ space.monomials(np.linspace(-1, 1, 20001)[:, None]).T
    bound, _ = polynomial_bound(space, coefficients)
    assert (np.abs(bound - values.max(axis=1)) <= 1e-7).all()


def test_the_bound_of_a_quadratic_converges_quadratically_as_its_box_shrinks():
    rng = np.random.default_rng(0)
    space = TaylorSpace(3, 2)
    base = rng.normal(size=space.size)
    points = rng.uniform(-1, 1, (20000, 3))
    gaps = []
    for radius in (1.0, 0.25, 1 / 16):
        scaled = base * radius**space.degrees
        gaps.append(
            polynomial_bound(space, scaled[None])[0][0]
            - (space.monomials(np.vstack([points, np.sign(points)])) @ scaled).max()
        )
    assert gaps[1] <= gaps[0] / 8 + 1e-12
    assert gaps[2] <= gaps[1] / 8 + 1e-12


def test_polynomials_without_variables_are_their_constants():
    bound, spread = polynomial_bound(TaylorSpace(0, 0), np.array([[[1.0], [-2.0]]]))
    assert bound.tolist() == [[1.0, -2.0]]
    assert spread.shape == (1, 2, 0)


KNOWN = {  # name: (A, horizon)
    "oscillating": ([[0.0, 1.0], [-4.0, -0.1]], 3.0),
    "unstable": ([[0.8, 1.0, 0.0], [0.2, 0.5, 0.0], [0.0, 1.0, -1.0]], 6.0),
    "stiff": ([[-1e4, 9e3, 0.0], [0.0, -50.0, 49.0], [0.0, 0.0, -1.0]], 2.0),
    "defective": ([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]], 4.0),
    "badly scaled": ([[-1.0, 1e-5], [1e5, -2.0]], 2.0),
}
UNEVEN = np.random.default_rng(5).uniform(0.2, 1.8, 60)
LONG = {
    "equal": np.linspace(0.0, 1.0, 61),
    "uneven": np.append(0.0, np.cumsum(UNEVEN) / UNEVEN.sum()),
    "tiny": np.append(np.linspace(0.0, 1e-6, 51), np.linspace(0.1, 1.0, 10)),
}


def known(name, grid):
    """A known system on 60 pieces, with a disturbance, and its functionals."""
    A, horizon = np.array(KNOWN[name][0]), KNOWN[name][1]
    d = A.shape[0]
    system = LinearSystem(A, np.eye(d)[:, -1:], np.eye(d))
    dictionary = indicators(horizon * LONG[grid])
    functionals = worst_case(
        system, dictionary, bound=Box(-np.ones(d), np.ones(d)), initial_state=np.arange(1.0, d + 1)
    )
    return functionals, lambda: lift(
        system.phases[0],
        functionals.response.grid,
        functionals.response.initial_state,
        np.zeros(0),
        np.zeros(0),
    )


@pytest.mark.parametrize("grid", sorted(LONG))
@pytest.mark.parametrize("name", sorted(KNOWN))
def test_what_rounding_changes_over_spans_of_many_pieces_is_no_hundred_times_that_of_each_piece(
    name, grid, monkeypatch
):
    functionals, lifting = known(name, grid)
    rng = np.random.default_rng(4)
    control, rows = rng.choice([-1.0, 0.0, 1.0], size=(1, 60)), rng.normal(size=(2, len(KNOWN[name][0])))
    plain = lifting()
    assert plain.spans.size == 60
    monkeypatch.setattr(lifted_module, "SPANS", 12)
    monkeypatch.setattr(lifted_module, "SHORT", np.inf)
    spanned = lifting()
    assert spanned.spans.size == 12
    for mine, alone in zip(state_remainder(spanned, control), state_remainder(plain, control), strict=True):
        assert mine.max() <= 100.0 * alone.max()
    met = block_norms(spanned.nodes(control)[:, 0], spanned.starts)
    assert (state_remainder(spanned, control)[1] >= np.maximum(met[:-1], met[1:])).all()
    supports = [DisturbanceSupport(one, functionals.disturbance, rows @ one.transform) for one in (spanned, plain)]
    mine, alone = (support.neglected for support in supports)
    assert (mine.max(axis=1) <= 100.0 * alone.max(axis=1)).all()


@pytest.mark.parametrize("blocks", [False, True])
@pytest.mark.parametrize("name", sorted(KNOWN))
def test_states_and_rows_are_as_near_to_the_truth_as_spans_of_many_pieces_say(name, blocks, monkeypatch):
    """The truth is an exponential in balls of 400 bits. In blocks: states through a tree of parts, rows by age."""
    monkeypatch.setattr(lifted_module, "SPANS", 12)
    if blocks:
        monkeypatch.setattr(response_module, "FEWEST", 7)
        monkeypatch.setattr(response_module, "LITTLE", np.inf)
    functionals, lifting = known(name, "equal")
    lifted, A = lifting(), np.array(KNOWN[name][0])
    d, breaks = A.shape[0], functionals.response.grid.breakpoints
    control = np.random.default_rng(4).choice([-1.0, 0.0, 1.0], size=(1, 60))
    rows = np.random.default_rng(6).normal(size=(2, d))
    nodes, remainder = lifted.nodes(control)[:, 0], state_remainder(lifted, control)[0]
    weights = lifted.backward.adjoint(breaks[1:], np.repeat(rows[:1], 60, axis=0), np.zeros((60, 0)))[0]
    missed = lifted.row_bounds(rows, by_age=blocks)[1][0][lifted.span]
    assert (lifted._block_size == 8) == blocks
    with balls(400):
        T = flint.arb_mat(lifted.transform.tolist())
        state = T.inv() * flint.arb_mat(functionals.response.initial_state[:, None].tolist())
        own, row = T.inv() * flint.arb_mat(A.tolist()) * T, flint.arb_mat(rows[:1].tolist())
        drive = T.inv() * flint.arb_mat(np.eye(d)[:, -1:].tolist())
        for piece in range(60):
            length = flint.arb(float(breaks[piece + 1])) - flint.arb(float(breaks[piece]))
            block = flint.arb_mat(d + 1, d + 1)
            for i in range(d):
                for j in range(d):
                    block[i, j] = own[i, j] * length
                block[i, d] = drive[i, 0] * float(control[0, piece]) * length
            moved = block.exp() * flint.arb_mat([*[[state[i, 0]] for i in range(d)], [1]])
            state = flint.arb_mat([[moved[i, 0]] for i in range(d)])
            off = np.array([float(abs(state[i, 0] - float(nodes[piece + 1, i])).upper()) for i in range(d)])
            assert (block_norms(off, lifted.starts) <= remainder[piece]).all()
            row = row * (own * length).exp()
            off = np.array([float(abs(row[0, i] - float(weights[piece, i])).upper()) for i in range(d)])
            assert (block_norms(off, lifted.starts) <= missed[piece]).all()


@contextmanager
def balls(bits):
    before, flint.ctx.prec = flint.ctx.prec, bits
    try:
        yield
    finally:
        flint.ctx.prec = before


def test_what_the_proof_leaves_out_of_known_systems_does_not_grow_with_the_pieces():
    """A hundred times as many pieces, in blocks and by age, are not rounded a hundred times as much."""
    found = []
    for pieces in (2000, 200_000):
        system = LinearSystem(KNOWN["oscillating"][0], [[0.0], [1.0]])
        bound = Box([-0.1, -0.1], [0.1, 0.1])
        functionals = worst_case(system, uniform_of_many(pieces, 3.0), bound=bound, initial_state=[1.0, 0.5])
        lifted = lift(system.phases[0], functionals.response.grid, np.array([1.0, 0.5]), np.zeros(0), np.zeros(0))
        control = np.ones((1, pieces))
        control[:, pieces // 3 :] = -1.0
        rows = np.eye(2) @ lifted.transform
        left = state_remainder(lifted, control)[0].max()
        found.append((left, DisturbanceSupport(lifted, functionals.disturbance, rows).neglected.max()))
    assert (np.array(found[1]) <= 4.0 * np.array(found[0])).all()
    assert max(found[1]) <= 1e-10


def test_spans_of_many_pieces_are_short_where_the_system_moves_much():
    system = LinearSystem([[30.0, 0.0], [0.0, -1.0]], [[0.0], [1.0]])
    grid = worst_case(system, uniform(2000, 3.0)).response.grid
    lifted = lift(system.phases[0], grid, np.ones(2), np.zeros(0), np.zeros(0))
    assert lifted.spans.size < 2000
    assert 30.0 * np.diff(grid.breakpoints[lifted.spans]).max() <= lifted_module.SHORT
    assert np.isfinite(state_remainder(lifted, np.ones((1, 2000)))[0]).all()


def test_what_is_bounded_of_many_states_takes_no_more_memory_than_the_path():
    """Of 20 000 pieces and 40 states: bounds piece by piece of every mode would be 20 times the path."""
    masses = 20
    stiffness = 2.0 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    A = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-stiffness, -0.1 * stiffness]])
    functionals = worst_case(LinearSystem(A, np.eye(40)[:, -1:], np.eye(40)[:, -2:]), uniform_of_many(20_000, 5.0))
    lifted = lift(
        functionals.response.system.phases[0], functionals.response.grid, np.ones(40), np.zeros(0), np.zeros(0)
    )
    control = np.ones((1, 20_000))
    path = lifted.nodes(control).nbytes
    tracemalloc.start()
    try:
        lifted.row_bounds(np.eye(40)[:10])
        lifted.along(control, np.ones((10, lifted.starts.size)), np.ones((10, lifted.starts.size)))
        assert tracemalloc.get_traced_memory()[1] <= 1.5 * path
    finally:
        tracemalloc.stop()


def uniform_of_many(pieces, horizon):
    return Dictionary.indicators(np.linspace(0.0, horizon, pieces + 1))


@pytest.mark.parametrize("name", ["oscillating", "stable"])
def test_sums_over_ages_that_are_remembered_are_those_of_any_times(name):
    functionals, lifted = made(name, "uniform", bound=Box([-0.1, -0.3], [0.2, 0.1]))
    sigma = DisturbanceSupport(lifted, functionals.disturbance, np.array([[1.0, 0.0], [0.5, -2.0]]) @ lifted.transform)
    times, ends = lifted.grid.breakpoints[1:], np.zeros((6, 2, lifted.space.nu))
    widths = np.full(6, 0.01)
    at, bend = sigma.at(times, ends), sigma.deviation(times - 0.01, widths)
    again = sigma.at(times[::-1], ends), sigma.deviation(times - 0.01, widths)
    beside, none = np.append(times, 0.1), np.zeros((7, 2, lifted.space.nu))
    for one, same, other in zip(at, again[0], sigma.at(beside, none), strict=True):
        np.testing.assert_array_equal(one, same[::-1])
        np.testing.assert_allclose(one, other[:-1], rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(bend, again[1])
    begun = sigma.deviation(times[:-1], widths[:-1])
    mixed = sigma.deviation(np.append(times[:-1], 0.1), widths)
    np.testing.assert_allclose(begun, mixed[:-1], rtol=1e-12)
