"""Guards control/enclosures/valid_inequalities: sets of parameters that are no boxes: what lies beyond them does not
count, and nothing inside them is missed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize

from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.constraints.local_maxima import step_out
from sparserob_core.control.enclosures.polynomial import polynomial_bound
from sparserob_core.control.enclosures.valid_inequalities import cheapest_multipliers
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.sets import Ellipsoid, NormBall, Polytope
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.expressions.taylor import TaylorSpace
from sparserob_core.sip.program import ConstraintFamily
from sparserob_core.sip.proof.branch_and_bound import prove_family
from tests.support.plants import uniform, worst_case

SETS = {
    "triangle": Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.6, 0.6, 0.5]),
    "ellipsoid": Ellipsoid([0.1, -0.1], [[0.3, 0.1], [0.1, 0.2]]),
    "ball": NormBall(p=2.0, radius=0.5, dimension=2),
    "diamond": NormBall(p=1.0, radius=0.6, dimension=2),
    "rounded": NormBall(p=3.0, radius=0.5, dimension=2),
}
MANY = [pytest.param(name, marks=() if name in ("triangle", "rounded") else pytest.mark.slow) for name in sorted(SETS)]


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_the_multipliers_bound_a_linear_program_from_above(seed):
    rng = np.random.default_rng(seed)
    nu, q = int(rng.integers(1, 4)), int(rng.integers(1, 5))
    A, g = rng.normal(size=(q, nu)), rng.normal(size=(3, 2, nu))
    s = A @ rng.uniform(-1, 1, nu) + rng.uniform(0, 0.3, q)
    multipliers = cheapest_multipliers(A, s, g)
    assert (multipliers >= 0).all()
    bound = multipliers @ s + np.abs(g - multipliers @ A).sum(axis=-1)
    for place in np.ndindex(3, 2):
        truth = -linprog(-g[place], A_ub=A, b_ub=s, bounds=(-1, 1)).fun
        assert truth - 1e-9 <= bound[place] <= np.abs(g[place]).sum() + 1e-12


def test_at_a_corner_of_the_set_the_multipliers_are_exact():
    A, s = np.array([[1.0, 0.5], [0.2, 1.0]]), np.array([0.1, -0.2])
    corner, weights = np.linalg.solve(A, s), np.array([0.7, 1.3])
    g = weights @ A
    found = cheapest_multipliers(A, s, g)
    assert np.allclose(found, weights)
    assert abs(found @ s - g @ corner) <= 1e-12


@pytest.mark.first(1)
@pytest.mark.parametrize("name", MANY)
def test_what_is_added_is_nowhere_negative_on_the_set(name):
    rng, index, space, tried = np.random.default_rng(0), ParameterIndex(SETS[name]), TaylorSpace(2, 4), 0
    for _ in range(60):
        low, high = np.sort(rng.uniform(index.box.lower, index.box.upper, (2, 2)), axis=0)
        cuts, delta = index.cuts(low, high), rng.uniform(-1, 1, (400, 2))
        delta = delta[SETS[name].contains((low + high) / 2 + delta * (high - low) / 2, 0.0)]
        if cuts is None or not len(delta):
            continue
        total = rng.normal(size=(3, 2, space.size)) * 0.5**space.degrees
        added = cuts.lowered(space, total, 0.0)[0] - total
        values = np.einsum("am,krm->kra", space.monomials(delta), added)
        assert (values >= -1e-12 * np.abs(added).max()).all()
        tried += bool(added.any())
    assert tried > 10


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_a_concave_quadratic_is_bounded_by_its_maximum_on_the_box(seed):
    rng = np.random.default_rng(seed)
    nu, shift = int(rng.integers(2, 5)), rng.choice([0.0, 3.0])
    space, root = TaylorSpace(nu, 2), rng.normal(size=(nu, nu))
    g, H = 2 * rng.normal(size=nu), shift * np.eye(nu) - root @ root.T - 0.01 * np.eye(nu)
    coefficients = np.zeros(space.size)
    for i, j in np.ndindex(nu, nu):
        coefficients[space.index[tuple(int(k == i) for k in range(nu))]] = g[i]
        coefficients[space.index[tuple(int(k == i) + int(k == j) for k in range(nu))]] += H[i, j] / 2
    starts = np.clip(1.5 * rng.uniform(-1, 1, (4000, nu)), -1, 1)
    bound, truth = polynomial_bound(space, coefficients)[0], (space.monomials(starts) @ coefficients).max()
    assert bound >= truth - 1e-9
    if not shift:
        found = minimize(
            lambda s: -(g @ s + s @ H @ s / 2),
            np.zeros(nu),
            jac=lambda s: -(g + H @ s),
            bounds=[(-1, 1)] * nu,
            tol=1e-14,
        )
        assert bound <= -found.fun + 1e-5


@pytest.mark.parametrize("name", sorted(SETS))
def test_a_step_to_the_support_point_ends_where_a_linear_function_is_highest(name):
    rng, direction = np.random.default_rng(1), np.array([0.3, 1.0])
    start = np.hstack(
        [np.zeros((3, 1)), np.tile(SETS[name].interior_point(), (3, 1)) + 0.05 * rng.uniform(-1, 1, (3, 2))]
    )
    points, values = step_out(lambda at, which: at[:, 1:] @ direction, start, start[:, 1:] @ direction, SETS[name])
    assert np.allclose(values, SETS[name].support(direction[None]), atol=1e-6)
    assert np.allclose(points[:, 1:] @ direction, values)
    assert SETS[name].contains(points[:, 1:]).all()


@pytest.mark.slow
def test_a_constraint_that_an_ellipsoid_of_parameters_makes_active_is_proven_with_few_cells():
    constraint = constraint_over(SETS["ellipsoid"], np.random.default_rng(3), None, curved=False)
    x = np.ones(5)
    highest = constraint.worst(x)
    tight = FlatConstraint(
        "path",
        constraint.functionals,
        constraint.H,
        constraint.h + highest.violations[0] + 1e-8,
        0.0,
        2.0,
        constraint.parameters,
    )
    family = ConstraintFamily(
        name="path", index_set=tight.index_set, rows=tight.rows, enclosure=tight.enclosure, cells=tight.cells
    )
    proof = prove_family(family, x, cells=3000)
    assert proof.verdict == "proven", proof.reason


def constraint_over(parameters, rng, bound, curved):
    A, B = rng.normal(size=(3, 2, 2)), rng.normal(size=(2, 1))
    system = LinearSystem(
        lambda p: A[0] + p[0] * A[1] + p[0] * p[1] * A[2],
        lambda p: B + np.array([[p[1]], [p[0] * p[0]]]),
        parameters=parameters,
    )
    functionals, index = (
        worst_case(system, uniform(5, 2.0), bound=bound, initial_state=rng.normal(size=2)),
        ParameterIndex(parameters),
    )
    if curved:
        return CurvedConstraint(
            "path", functionals, Ellipsoid(rng.normal(size=2), [[1.0, 0.2], [0.2, 0.5]]), 0.0, 2.0, index
        )
    return FlatConstraint("path", functionals, rng.normal(size=(2, 2)), rng.normal(size=2), 0.0, 2.0, index)


@pytest.mark.first(1)
@settings(max_examples=4, deadline=None)
@pytest.mark.parametrize("name", MANY)
@pytest.mark.parametrize("curved", [False, True])
@given(seed=st.integers(0, 10**6), disturbed=st.booleans())
def test_no_parameter_of_the_set_in_a_cell_is_above_its_bound(name, curved, seed, disturbed):
    rng = np.random.default_rng(seed)
    parameters = SETS[name]
    constraint = constraint_over(parameters, rng, Box([-0.1, -0.2], [0.2, 0.1]) if disturbed else None, curved)
    x, box, inside = rng.normal(size=5), constraint.index_set, 0
    for _ in range(6):
        lower, upper = (
            ends[[row]].copy() for row in [rng.integers(constraint.cells[0].shape[0])] for ends in constraint.cells
        )
        upper[0, 0] = lower[0, 0] + 0.4
        ends = np.sort(rng.uniform(box.lower[1:3], box.upper[1:3], (2, 2)), axis=0)
        lower[0, 1:3], upper[0, 1:3] = ends
        points = rng.uniform(lower, upper, (400, box.dimension))
        points[:200, 1:3] = np.clip(constraint.parameters.clamp(points[:200, 1:3]), ends[0], ends[1])
        points = points[parameters.contains(points[:, 1:3], 0.0)]
        bound = float(constraint.enclosure(x, lower, upper).bounds[0])
        inside += len(points)
        if len(points):
            G, rhs = constraint.rows(points)
            # of the directions that are bounded
            lengths = np.linalg.norm(points[:, 3:], axis=1) if curved else np.ones(len(points))
            assert (lengths[:, None] * (G @ x - rhs)).max() <= bound + 1e-9
    assert inside


@pytest.mark.parametrize("name", MANY)
def test_a_cell_is_left_out_only_if_the_set_does_not_meet_it(name):
    rng, index = np.random.default_rng(0), ParameterIndex(SETS[name])
    centres = rng.uniform(-1.2, 1.2, (300, 1, 2))
    low, high = centres - 0.1, centres + 0.1
    points = rng.uniform(low, high, (300, 200, 2))
    meets = SETS[name].contains(points.reshape(-1, 2), 0.0).reshape(300, 200).any(axis=1)
    touched = index.touches(low[:, 0], high[:, 0])
    assert (touched | ~meets).all()
    assert meets.any()
    assert (~touched).sum() > 50
