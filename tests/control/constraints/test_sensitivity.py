"""Guards control/constraints/sensitivity: derivatives of constraints in their index, against differences of what the
constraints themselves say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.control.constraints.control import ControlConstraint, Places
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.sets.sets import Ellipsoid, NormBall, Polytope, cylinder
from sparserob_core.control.transcription.transcribe import transcribe
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.program import ConstraintFamily
from sparserob_core.sip.relaxed.index_gradient import STEP, index_gradient
from tests.support.plants import indicators, random_system, uniform, walsh

HORIZON = 3.0
GRIDS = {"uniform": uniform(12, HORIZON), "uneven": indicators([0.0, 0.4, 0.5, 1.0, 1.6, 2.2, HORIZON])}
BOUNDS = {
    "none": (None, "piecewise_constant"),
    "box": (Box([-0.1, -0.3], [0.2, 0.1]), "piecewise_constant"),
    "ellipse": (Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.02]]), "piecewise_constant"),
    "triangle": (Polytope([[1.0, 1.0], [-1.0, 0.2], [0.0, -1.0]], [0.3, 0.2, 0.1]), "piecewise_constant"),
    "3-norm": (NormBall(p=3.0, radius=0.2, dimension=2), "piecewise_constant"),
    "l1_ball": (Box([-0.1, -0.3], [0.1, 0.3]), "l1_ball"),
    "measurable": (Box([-0.1, -0.3], [0.2, 0.1]), "measurable"),
}
SETS = {
    "box": Box([-0.4, -0.2], [0.3, 0.5]),
    "ellipse": Ellipsoid([0.1, 0.0], [[0.09, 0.03], [0.03, 0.16]]),
    "simplex": Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.0, 0.0, 0.5]),
    "diamond": NormBall(p=1.0, radius=0.4, centre=[0.1, 0.0]),
    "3-norm": NormBall(p=3.0, radius=0.4, dimension=2),
    "segment": Box([-0.4, 0.2], [0.3, 0.2]),
}
CURVED = {
    "ellipse": Ellipsoid([0.1, 0.2], [[0.5, 0.2], [0.2, 0.8]]),
    "disc": NormBall(p=2.0, radius=0.7, dimension=2),
    "4-norm": NormBall(p=4.0, radius=0.7, centre=[0.0, 0.3]),
}


def uncertain(rng, convex=SETS["box"], enclosable=True, shift=0.0):
    """A system whose matrices are nonlinear functions of two parameters."""
    A, B, E = rng.normal(size=(3, 2, 2)), rng.normal(size=(2, 2, 1)), rng.normal(size=(2, 2, 2))

    def drift(p):
        p = p if enclosable else [float(entry) for entry in p]
        return A[0] + shift * np.eye(2) + np.sin(p[0]) * A[1] + np.exp(p[0] * p[1]) * A[2]

    return LinearSystem(
        drift, lambda p: B[0] + p[1] ** 2 * B[1], lambda p: E[0] + p[0] * p[1] * E[1], parameters=convex
    )


def family_of(
    rng, system, bound="none", sets="flat", grid="uniform", formulation="reduced", window=(0.0, None), disturbance=None
):
    convex, kind = BOUNDS[bound]
    flat = Polytope(np.vstack([rng.normal(size=(3, system.states))]), np.ones(3))
    constraint = flat if sets == "flat" else cylinder(CURVED[sets], system.states)
    start = rng.normal(size=system.states)
    problem = OptimalControlProblem(
        system=system,
        horizon=HORIZON,
        initial_state=start,
        disturbance=convex,
        control=Box([-1] * system.controls, [1] * system.controls),
        disturbance_class=kind,
        path=[PathConstraint(constraint, *window)],
    )
    return transcribe(problem, GRIDS[grid], disturbance, formulation).families[0]


def indices_in(rng, family, count=6):
    lower, upper = family.index_set.lower, family.index_set.upper
    return lower + rng.uniform(0.01, 0.99, size=(count, lower.size)) * (upper - lower)


def some_rows(rng, family, indices):
    return rng.integers(0, family.rows(indices[:1])[1].shape[1], indices.shape[0])


def rounding_of(family, x, indices, rows):
    """Of the violations, which are differences of large numbers in fast growing systems."""
    G, rhs = (part[np.arange(rows.size), rows] for part in family.rows(indices))
    return 4e-15 * (np.abs(G) @ np.abs(x) + np.abs(rhs))


def assert_it_is_the_derivative(family, x, indices, rows):
    """Between the slopes on both sides of every coordinate, which are one slope where there is no kink; there to seven
    figures, mostly."""
    claimed = family.gradient(x, indices, rows)
    assert claimed.shape == indices.shape
    assert claimed.dtype == float
    step = 1e-5 * (family.index_set.upper - family.index_set.lower)
    pick = np.arange(rows.size)
    here = family.violations(x, indices)[pick, rows]
    rounding = rounding_of(family, x, indices, rows)
    close = []
    for axis in range(indices.shape[1]):
        if step[axis] == 0.0:
            assert (claimed[:, axis] == 0.0).all()
            continue
        move = np.zeros(indices.shape[1])
        move[axis] = step[axis]
        ahead, behind = (family.violations(x, indices + sign * move)[pick, rows] for sign in (1, -1))
        forward, backward = (ahead - here) / step[axis], (here - behind) / step[axis]
        allowed = 2e-7 * (1.0 + np.abs(claimed[:, axis])) + rounding / step[axis]
        error = np.abs(claimed[:, axis] - (forward + backward) / 2)
        assert (error <= np.abs(forward - backward) / 2 * (1 + 1e-6) + allowed).all()
        close.append(error <= allowed)
    assert not close or np.mean(close) >= 0.8


def decision(rng, family, system, grid="uniform"):
    return rng.normal(size=system.controls * GRIDS[grid].functions)


@settings(max_examples=24, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    bound=st.sampled_from(sorted(BOUNDS)),
    grid=st.sampled_from(sorted(GRIDS)),
    shift=st.sampled_from([-2.0, 0.0, 1.5]),
)
def test_the_slope_in_time_is_that_of_the_worst_case(seed, bound, grid, shift):
    rng = np.random.default_rng(seed)
    system = random_system(rng)
    system = LinearSystem(system.phases[0].A + shift * np.eye(2), system.phases[0].B, system.phases[0].E)
    family = family_of(rng, system, bound, grid=grid, disturbance=GRIDS["uneven"])
    indices = indices_in(rng, family)
    assert_it_is_the_derivative(family, decision(rng, family, system, grid), indices, some_rows(rng, family, indices))


@settings(max_examples=24, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    bound=st.sampled_from(sorted(set(BOUNDS) - {"measurable"})),
    convex=st.sampled_from(sorted(SETS)),
    enclosable=st.booleans(),
    shift=st.sampled_from([-1.5, 0.0]),
)
def test_the_slopes_in_uncertain_parameters_are_those_of_the_worst_case(seed, bound, convex, enclosable, shift):
    rng = np.random.default_rng(seed)
    system = uncertain(rng, SETS[convex], enclosable, shift)
    family = family_of(rng, system, bound)
    indices = indices_in(rng, family)
    assert_it_is_the_derivative(family, decision(rng, family, system), indices, some_rows(rng, family, indices))


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    bound=st.sampled_from(sorted(set(BOUNDS) - {"measurable"})),
    sets=st.sampled_from(sorted(CURVED)),
    parameters=st.booleans(),
    formulation=st.sampled_from(["reduced", "literal"]),
)
def test_the_slopes_in_the_direction_of_a_curved_set_are_those_of_the_worst_case(
    seed, bound, sets, parameters, formulation
):
    rng = np.random.default_rng(seed)
    system = uncertain(rng) if parameters else random_system(rng, states=3)
    family = family_of(rng, system, bound, sets, formulation=formulation)
    indices = indices_in(rng, family)
    assert_it_is_the_derivative(family, decision(rng, family, system), indices, np.zeros(len(indices), dtype=int))


@pytest.mark.parametrize("sets", ["flat", "disc"])
def test_measurable_disturbances_have_slopes_in_parameters_and_directions_too(sets):
    rng = np.random.default_rng(3)
    system = uncertain(rng)
    family = family_of(rng, system, "measurable", sets)
    indices = indices_in(rng, family, 2)
    assert_it_is_the_derivative(family, decision(rng, family, system), indices, some_rows(rng, family, indices))


@pytest.mark.first(1)
@pytest.mark.parametrize("varies", [False, True], ids=["constant", "in time"])
def test_errors_of_execution_have_slopes_in_directions_too(varies):
    rng = np.random.default_rng(4)
    plant = random_system(rng, states=3)
    if varies:
        dressed = [[f"{entry} + 0.1*sin(t)" for entry in row] for row in plant.phases[0].A]
        plant = VaryingSystem.of(dressed, np.asarray(plant.phases[0].B).tolist(), HORIZON)
    m = plant.controls
    problem = OptimalControlProblem(
        system=plant,
        horizon=HORIZON,
        initial_state=rng.normal(size=3),
        control=Box([-1] * m, [1] * m),
        execution=np.full(m, 0.3),
        path=[PathConstraint(cylinder(CURVED["disc"], 3))],
    )
    (family,) = transcribe(problem, GRIDS["uneven"]).families
    control = rng.normal(size=m * GRIDS["uneven"].pieces)
    indices = indices_in(rng, family, 4)
    x = np.concatenate([control, np.abs(control)])
    assert_it_is_the_derivative(family, x, indices, np.zeros(4, dtype=int))


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    bound=st.sampled_from(sorted(set(BOUNDS) - {"none"})),
    convex=st.sampled_from([None, "box", "ellipse", "simplex"]),
    grid=st.sampled_from(sorted(GRIDS)),
)
def test_the_literal_index_has_slopes_in_every_coefficient_of_the_disturbance(seed, bound, convex, grid):
    rng = np.random.default_rng(seed)
    system = random_system(rng) if convex is None else uncertain(rng, SETS[convex])
    family = family_of(rng, system, bound, grid=grid, formulation="literal", disturbance=GRIDS["uneven"])
    indices = indices_in(rng, family, 4)
    assert_it_is_the_derivative(family, decision(rng, family, system, grid), indices, some_rows(rng, family, indices))


def test_an_incomplete_dictionary_of_disturbances_has_slopes_in_its_coefficients():
    rng = np.random.default_rng(5)
    system = random_system(rng)
    for formulation in ("reduced", "literal"):
        family = family_of(rng, system, "triangle", formulation=formulation, disturbance=walsh(4, HORIZON, 3))
        indices = indices_in(rng, family, 4)
        assert_it_is_the_derivative(family, decision(rng, family, system), indices, some_rows(rng, family, indices))


def test_the_nominal_constraint_has_a_slope_in_time():
    rng = np.random.default_rng(6)
    system = uncertain(rng)
    family = family_of(rng, system, "box").nominal
    indices = indices_in(rng, family)
    assert_it_is_the_derivative(family, decision(rng, family, system), indices, some_rows(rng, family, indices))


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), formulation=st.sampled_from(["reduced", "literal"]))
def test_minimum_attention_has_the_slopes_of_its_augmented_system(seed, formulation):
    """``(x, u)' = [[A(p), B], [0, 0]] (x, u) + [0; I] v + [E; 0] w``: the parameters are in one block only."""
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(2, 2, 2)), rng.normal(size=(2, 1))

    def augmented(p):
        rows = np.zeros((3, 3)) + 0 * p[0]
        rows[:2] = np.hstack([A[0] + p[0] * A[1], B])
        return rows

    system = LinearSystem(augmented, np.eye(3, 1, -2), np.eye(3, 2), parameters=Box([-0.3], [0.3]))
    family = family_of(rng, system, "box", formulation=formulation)
    indices = indices_in(rng, family, 4)
    assert_it_is_the_derivative(family, decision(rng, family, system), indices, some_rows(rng, family, indices))


@pytest.mark.parametrize("bound", sorted(BOUNDS))
@pytest.mark.parametrize("formulation", ["reduced", "literal"])
@pytest.mark.parametrize("sets", ["flat", "disc"])
def test_the_slope_at_a_breakpoint_is_from_the_left_and_at_the_start_from_the_right(bound, formulation, sets):
    rng = np.random.default_rng(8)
    for window, grid in (((0.0, HORIZON), "uniform"), ((0.5, 2.5), "uniform"), ((0.5, 2.2), "uneven")):
        system = random_system(rng)
        family = family_of(rng, system, bound, sets, grid, formulation, window)
        x, breaks = decision(rng, family, system, grid), GRIDS[grid].breakpoints
        times = np.concatenate([window[:1], breaks[(breaks > window[0]) & (breaks < window[1])], window[1:]])
        indices = indices_in(rng, family, times.size)
        indices[:, 0] = times
        rows, pick = some_rows(rng, family, indices), np.arange(times.size)
        sides = np.where(times > window[0], -1.0, 1.0)
        values = []
        for step in (0.0, 1e-5, 2e-5):
            moved = indices.copy()
            moved[:, 0] += step * sides
            values.append(family.violations(x, moved)[pick, rows])
        slope = sides * (4 * values[1] - values[2] - 3 * values[0]) / 2e-5
        assert np.allclose(family.gradient(x, indices, rows)[:, 0], slope, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("sets", sorted(CURVED))
def test_a_curved_set_of_controls_has_slopes_in_its_direction(sets):
    rng = np.random.default_rng(15)
    grid = GRIDS["uneven"]
    places = Places.of_values(grid.breakpoints, CURVED[sets].dimension)
    family = ControlConstraint.of("control", CURVED[sets], places, grid).family()
    indices = indices_in(rng, family, 20)
    assert_it_is_the_derivative(family, rng.normal(size=12), indices, np.zeros(20, dtype=int))


def test_the_time_of_a_terminal_constraint_does_not_move():
    rng = np.random.default_rng(9)
    for formulation, system in (
        ("reduced", uncertain(rng)),
        ("literal", uncertain(rng)),
        ("reduced", random_system(rng)),
    ):
        for sets in ("flat", "disc"):
            family = family_of(rng, system, "box", sets, formulation=formulation, window=(HORIZON, HORIZON))
            indices = indices_in(rng, family)
            x, rows = decision(rng, family, system), some_rows(rng, family, indices)
            assert (family.gradient(x, indices, rows)[:, 0] == 0).all()
            assert_it_is_the_derivative(family, x, indices, rows)


def test_a_direction_that_is_none_has_no_slope_and_no_index_has_no_rows():
    rng = np.random.default_rng(10)
    system = random_system(rng)
    for formulation, sets in (("reduced", "disc"), ("literal", "disc"), ("literal", "flat")):
        family = family_of(rng, system, "box", sets, formulation=formulation)
        indices, x = indices_in(rng, family), decision(rng, family, system)
        if sets == "disc":
            indices[:, -2:] = 0.0
            assert (family.gradient(x, indices, np.zeros(6))[:, -2:] == 0).all()
        assert family.gradient(x, indices[:0], np.zeros(0)).shape == (0, indices.shape[1])


def test_an_index_by_itself_has_the_same_slopes_as_among_others():
    rng = np.random.default_rng(11)
    for system in (random_system(rng), uncertain(rng, SETS["ellipse"])):
        family = family_of(rng, system, "ellipse", formulation="literal")
        indices, x = indices_in(rng, family, 70), decision(rng, family, system)
        rows = some_rows(rng, family, indices)
        together = family.gradient(x, indices, rows)
        for i in (0, 33, 69):
            assert np.allclose(
                family.gradient(x, indices[i : i + 1], rows[i : i + 1])[0], together[i], rtol=1e-9, atol=1e-10
            )


def circle_family(**more):
    """``cos(xi_1) x_1 + xi_2^2 x_2 <= 1`` and ``xi_1 xi_2 x_2 <= 0``; the third coordinate cannot move."""

    def rows(indices):
        assert (indices >= box.lower).all()
        assert (indices <= box.upper).all()
        G = np.stack(
            [
                np.stack([np.cos(indices[:, 0]), indices[:, 1] ** 2], 1),
                np.stack([0 * indices[:, 0], indices[:, 0] * indices[:, 1]], 1),
            ],
            1,
        )
        return G, np.tile([1.0, 0.0], (len(indices), 1))

    box = Box([0.0, -1.0, 2.0], [5.0, 3.0, 2.0])
    return ConstraintFamily(name="circle", index_set=box, rows=rows, **more)


def test_a_family_without_a_gradient_is_differenced_inside_its_index_set():
    rng = np.random.default_rng(14)
    family, x = circle_family(), np.array([0.7, -1.3])
    box = family.index_set
    indices = rng.uniform(box.lower, box.upper, size=(30, 3))
    indices[:10, 0], indices[10:20, 0], indices[5:15, 1], indices[15:20, 1] = 0.0, 5.0, -1.0, 3.0
    rows = rng.integers(0, 2, 30)
    a, b = indices[:, 0], indices[:, 1]
    truth = np.where(
        rows[:, None] == 0,
        np.stack([-np.sin(a) * x[0], 2 * b * x[1], 0 * a], 1),
        np.stack([b * x[1], a * x[1], 0 * a], 1),
    )
    assert np.allclose(index_gradient(family, x, indices, rows), truth, rtol=0, atol=1e-8)
    assert index_gradient(family, x, indices[:0], rows[:0]).shape == (0, 3)


def test_a_family_with_a_gradient_is_asked_for_it():
    family = circle_family(gradient=lambda x, indices, rows: np.full(indices.shape, 4.0))
    assert (index_gradient(family, np.zeros(2), np.zeros((2, 3)), np.zeros(2, dtype=int)) == 4).all()


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6), formulation=st.sampled_from(["reduced", "literal"]))
def test_differences_and_slopes_agree_inside_and_on_the_faces(seed, formulation):
    rng = np.random.default_rng(seed)
    system = uncertain(rng, shift=-1.0)
    family = family_of(rng, system, "ellipse" if formulation == "reduced" else "box", formulation=formulation)
    box = family.index_set
    indices = indices_in(rng, family)
    indices[:2], indices[2:4] = box.lower, box.upper
    x, rows = decision(rng, family, system), some_rows(rng, family, indices)
    found = index_gradient(replace(family, gradient=None), x, indices, rows)
    slopes, width = index_gradient(family, x, indices, rows), family.index_set.upper - family.index_set.lower
    allowed = 1e-7 + 1e-6 * np.abs(slopes) + rounding_of(family, x, indices, rows)[:, None] / (STEP * width)
    assert (np.abs(found - slopes) <= allowed).all()
