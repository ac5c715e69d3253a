"""Guards control/constraints/flat: the separation of state constraints: the largest violation over times and
parameters, against dense grids."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from sparserob_core.control.constraints import flat
from sparserob_core.control.constraints.explanation import combination
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.names import UNNAMED
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.sets.sets import Ellipsoid, Polytope
from sparserob_core.sip.convex_set import Box
from tests.support.plants import indicators, random_system, uniform, worst_case

HORIZON = 3.0
GRIDS = {"uniform": uniform(12, HORIZON), "uneven": indicators([0.0, 0.4, 0.5, 1.0, 1.6, 2.2, HORIZON])}
BOUNDS = {
    "none": None,
    "box": Box([-0.1, -0.3], [0.2, 0.1]),
    "ellipsoid": Ellipsoid([0.0, 0.1], [[0.04, 0.01], [0.01, 0.02]]),
}


def constraint_of(rng, system, dictionary, bound=None, rows=2, start=0.0, stop=HORIZON):
    functionals = worst_case(system, dictionary, None, bound, initial_state=rng.normal(size=system.states))
    return FlatConstraint(
        "path",
        functionals,
        rng.normal(size=(rows, system.states)),
        rng.normal(size=rows),
        start,
        stop,
        ParameterIndex(system.parameters),
    )


def violations(constraint, x, indices):
    G, rhs = constraint.rows(indices)
    return G @ x - rhs


def polished(constraint, x, per_piece=40):
    """The largest violation of a known system: a dense grid on every piece, its best points improved by Brent's
    method."""
    breaks = constraint.functionals.response.grid.breakpoints
    inside = breaks[(breaks > constraint.start) & (breaks < constraint.stop)]
    ends = np.unique(np.concatenate([[constraint.start], inside, [constraint.stop]]))
    best = -np.inf
    for left, right in itertools.pairwise(ends):
        times = np.linspace(left, right, per_piece)
        found = violations(constraint, x, times[:, None])
        best = max(best, found.max())
        for row in range(found.shape[1]):
            k = int(found[:, row].argmax())
            answer = minimize_scalar(
                lambda t, row=row: -violations(constraint, x, np.array([[t]]))[0, row],
                method="bounded",
                bounds=(times[max(k - 1, 0)], times[min(k + 1, per_piece - 1)]),
                options={"xatol": 1e-10},
            )
            best = max(best, -answer.fun)
    return best


@settings(max_examples=8, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    grid=st.sampled_from(sorted(GRIDS)),
    bound=st.sampled_from(sorted(BOUNDS)),
    window=st.sampled_from([(0.0, 3.0), (0.35, 2.9)]),
)
def test_the_worst_violation_of_a_smooth_path_is_found_between_the_nodes(seed, grid, bound, window):
    rng = np.random.default_rng(seed)
    A = np.array([[0.0, 1.0], [-rng.uniform(0.5, 4), -rng.uniform(-0.2, 1)]])
    system = LinearSystem(A, [[0.0], [1.0]], np.array([[0.0, 0.0], [1.0, 0.5]]))
    constraint = constraint_of(rng, system, GRIDS[grid], BOUNDS[bound], start=window[0], stop=window[1])
    constraint = FlatConstraint(
        "path",
        constraint.functionals,
        np.array([[1.0, 0.0], [-1.0, 0.0]]),
        constraint.h,
        *window,
        constraint.parameters,
    )
    x = rng.normal(size=constraint.functionals.variables)
    found = constraint.worst(x)
    truth = polished(constraint, x)
    assert found.violations[0] <= truth + 1e-9
    assert found.violations[0] >= truth - 1e-3
    assert (np.diff(found.violations) <= 0).all()
    at = violations(constraint, x, found.indices)[np.arange(found.rows.size), found.rows]
    assert np.allclose(at, found.violations, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
@settings(max_examples=12, deadline=None, phases=[Phase.generate])
@given(seed=st.integers(0, 10**6), grid=st.sampled_from(sorted(GRIDS)), bound=st.sampled_from(sorted(BOUNDS)))
def test_the_worst_violation_of_any_path_is_found_within_a_millionth(seed, grid, bound):
    """Also where the control kinks the path at a breakpoint, and where a piece is long for the speed of the system."""
    rng = np.random.default_rng(seed)
    constraint = constraint_of(rng, random_system(rng), GRIDS[grid], BOUNDS[bound])
    x = rng.normal(size=constraint.functionals.variables)
    assert constraint.worst(x).violations[0] >= polished(constraint, x) - 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_a_smooth_peak_between_coarse_samples_is_found_to_round_off_in_few_looks(seed, monkeypatch):
    """A parabola through samples as coarse as these misses the peak by far more than is allowed."""
    rng = np.random.default_rng(seed)
    system = LinearSystem([[0.0, 1.0], [-rng.uniform(1, 4), -rng.uniform(0, 0.5)]], [[0.0], [1.0]], np.eye(2))
    functionals = worst_case(system, uniform(6, HORIZON), None, BOUNDS["box"], initial_state=rng.normal(size=2))
    constraint = FlatConstraint(
        "path", functionals, np.array([[1.0, 0.0], [-1.0, 0.0]]), np.ones(2), 0.0, HORIZON, ParameterIndex(None)
    )
    x = 0.1 * rng.normal(size=functionals.variables)
    looks, violations_at = [], FlatConstraint.violations
    monkeypatch.setattr(
        FlatConstraint, "violations", lambda self, *given: looks.append(1) or violations_at(self, *given)
    )
    found = constraint.worst(x)
    assert 2 <= len(looks) <= 5
    near = found.indices[0, 0] + 1e-3 * np.linspace(-1.0, 1.0, 201)
    beside = violations_at(constraint, x, np.clip(near, 0.0, HORIZON)[:, None], np.full(201, found.rows[0]))
    assert found.violations[0] >= beside.max() - 1e-11


def test_a_path_that_peaks_at_a_kink_is_separated_at_the_kink():
    """``x' = u`` with u = 1 and then -1/3: the largest state is at the breakpoint."""
    functionals = worst_case(LinearSystem([[0.0]], [[1.0]]), uniform(2, 2.0), initial_state=[0.0])
    constraint = FlatConstraint("path", functionals, np.array([[1.0]]), np.array([0.9]), 0.0, 2.0, ParameterIndex(None))
    found = constraint.worst(np.array([1.0, -1 / 3]))
    assert abs(found.violations[0] - 0.1) <= 1e-9
    assert abs(found.indices[0, 0] - 1.0) <= 1e-9


def test_among_many_pieces_the_worst_violation_is_the_same_and_the_others_are_met(monkeypatch):
    """What is well below 0 at a sample is told as it is there; what is not is refined as ever."""
    rng, dictionary = np.random.default_rng(3), uniform(40, HORIZON)
    system = LinearSystem([[0.0, 1.0], [-9.0, -0.1]], [[0.0], [1.0]])
    constraint = constraint_of(rng, system, dictionary, Box([-0.1, -0.3], [0.2, 0.1]), rows=4)
    x = rng.uniform(-1, 1, size=constraint.functionals.variables)
    height = constraint.worst(x).violations.max()
    for lowered in (0.0, height, height + 1.0):  # violated, touched, met
        moved = replace(constraint, h=constraint.h + lowered)
        few = moved.worst(x)
        monkeypatch.setattr(flat, "SAMPLED_ONLY_PIECES", 1)
        many = replace(moved, shared=None).worst(x)
        monkeypatch.undo()
        assert many.violations[0] == pytest.approx(few.violations[0], abs=1e-12)
        assert (np.sort(many.violations) <= np.sort(few.violations) + 1e-12).all()
        assert (many.violations > 0.0).sum() == (few.violations > 0.0).sum()
        found = violations(moved, x, many.indices)[np.arange(many.rows.size), many.rows]
        np.testing.assert_allclose(found, many.violations, atol=1e-11)


def test_along_a_wall_rows_of_many_entries_are_few(monkeypatch):
    """``x' = u`` with u = 1 rises above its wall on all pieces but the first ones: one row for each, or as few as there
    are entries for."""
    functionals = worst_case(LinearSystem([[0.0]], [[1.0]]), uniform(40, 2.0), initial_state=[0.0])
    constraint = FlatConstraint("path", functionals, np.array([[1.0]]), np.array([0.1]), 0.0, 2.0, ParameterIndex(None))
    assert 35 <= (constraint.worst(np.ones(40)).violations > 0.0).sum() <= 40
    monkeypatch.setattr(flat, "SPANNED", 400)
    few = replace(constraint, shared=None).worst(np.ones(40))
    assert 10 <= (few.violations > 0.0).sum() <= 12
    assert few.violations[0] == pytest.approx(1.9)


def test_a_window_that_starts_just_before_a_sample_is_searched():
    functionals = worst_case(LinearSystem([[0.0]], [[1.0]]), uniform(10, 1.0), initial_state=[0.0])
    for start in (0.3, np.nextafter(0.3, 0), 0.3 - 1e-14, 0.1 + 0.2):
        constraint = FlatConstraint(
            "path", functionals, np.array([[1.0]]), np.array([0.0]), start, 1.0, ParameterIndex(None)
        )
        assert abs(constraint.worst(np.ones(10)).violations[0] - 1.0) <= 1e-9
        assert abs(constraint.worst(-np.ones(10)).violations[0] - -0.3) <= 1e-9


def oscillator(damping=0.0):
    return lambda p: np.array([[0 * p[0], 1 + 0 * p[0]], [-(p[0] ** 2), -damping + 0 * p[0]]])


@pytest.mark.parametrize("horizon", [2.0, 2 * np.pi])
def test_the_worst_frequency_may_be_inside_the_box(horizon):
    """``x(T) = cos(omega T)`` of a free oscillator: the largest over the frequencies is 1 at an interior one, 2 pi."""
    system = LinearSystem(
        oscillator(), [[0.0], [1.0]], parameters=Box([2 * np.pi / horizon - 0.07], [2 * np.pi / horizon + 0.1])
    )
    functionals = worst_case(system, uniform(10, horizon), initial_state=[1.0, 0.0])
    constraint = FlatConstraint(
        "terminal",
        functionals,
        np.array([[1.0, 0.0]]),
        np.array([0.8]),
        horizon,
        horizon,
        ParameterIndex(system.parameters),
    )
    found = constraint.worst(np.zeros(10))
    assert abs(found.violations[0] - 0.2) <= 1e-9
    assert abs(found.indices[0, 1] - 2 * np.pi / horizon) <= 1e-4


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10**6), nu=st.sampled_from([1, 2, 3]), bound=st.sampled_from(["none", "box"]))
def test_the_worst_violation_over_parameters_is_no_less_than_any_sampled_one(seed, nu, bound):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(nu + 1, 2, 2)), rng.normal(size=(nu + 1, 2, 1))
    system = LinearSystem(
        lambda p: A[0] + 0.4 * sum(np.sin(p[i]) * A[i + 1] for i in range(nu)),
        lambda p: B[0] + 0.4 * sum(p[i] * p[0] * B[i + 1] for i in range(nu)),
        parameters=Box([-1.0] * nu, [1.0] * nu),
    )
    constraint = constraint_of(rng, system, uniform(6, HORIZON), BOUNDS[bound])
    x = rng.normal(size=6)
    found = constraint.worst(x)
    indices = np.hstack([rng.uniform(0, HORIZON, (1500, 1)), rng.uniform(-1, 1, (1500, nu))])
    indices[:500, 1:] = np.sign(indices[:500, 1:])
    indices[:100, 0] = HORIZON
    best = found.indices[0] + 0.02 * rng.normal(size=(500, 1 + nu))  # and near the answer
    indices = np.vstack([indices, np.clip(best, constraint.index_set.lower, constraint.index_set.upper)])
    assert found.violations[0] >= violations(constraint, x, indices).max() - 1e-6


def test_parameters_in_a_polytope_are_searched_inside_it_only():
    simplex = Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.0, 0.0, 1.0])
    system = LinearSystem(np.zeros((2, 2)), lambda p: np.array([[p[0]], [p[1]]]), parameters=simplex)
    functionals = worst_case(system, uniform(4, 1.0), initial_state=[0.0, 0.0])
    for c, truth in (([1.0, 1.0], 1.0), ([1.0, -1.0], 1.0), ([2.0, 1.0], 2.0), ([-1.0, -1.0], 0.0)):
        constraint = FlatConstraint(
            "end", functionals, np.array([c]), np.array([0.0]), 1.0, 1.0, ParameterIndex(simplex)
        )
        found = constraint.worst(np.ones(4))
        assert abs(found.violations[0] - truth) <= 1e-6
        assert simplex.contains(constraint.parameters.clamp(found.indices[:, 1:]), 1e-9).all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6), nu=st.sampled_from([0, 2]), bound=st.sampled_from(sorted(BOUNDS)))
def test_violations_without_rows_equal_those_of_the_rows(seed, nu, bound):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 2, 2))
    system = (
        LinearSystem(lambda p: A[0] + p[0] * A[1] + p[1] * A[2], np.ones((2, 1)), parameters=Box([-1, -1], [1, 1]))
        if nu
        else random_system(rng)
    )
    constraint = constraint_of(rng, system, GRIDS["uneven"], BOUNDS[bound])
    x = rng.normal(size=constraint.functionals.variables)
    indices = np.hstack([rng.uniform(0, HORIZON, (7, 1)), rng.uniform(-1, 1, (7, nu))])
    full = violations(constraint, x, indices)
    for row in range(2):
        assert np.allclose(constraint.violations(x, indices, np.full(7, row)), full[:, row], rtol=1e-10, atol=1e-11)


def test_the_cells_partition_the_index_set():
    rng = np.random.default_rng(1)
    for start, stop in ((0.0, HORIZON), (0.45, 2.0), (HORIZON, HORIZON), (0.0, 0.0), (0.4, 0.4)):
        constraint = constraint_of(rng, random_system(rng), GRIDS["uneven"], start=start, stop=stop)
        lower, upper = constraint.cells
        assert lower[0, 0] == start
        assert upper[-1, 0] == stop
        assert np.array_equal(lower[1:], upper[:-1])
        breaks = constraint.functionals.response.grid.breakpoints
        assert not ((lower < breaks) & (breaks < upper)).any()


def test_the_explanation_of_a_constraint_carries_its_worst_disturbance():
    rng = np.random.default_rng(2)
    constraint = constraint_of(rng, random_system(rng), GRIDS["uneven"], BOUNDS["box"])
    words = constraint.explain(np.array([1.3]), 1)
    assert words.time == 1.3
    assert words.disturbance.shape == (2, 6)
    assert "the disturbance alone moves it by" in words.text


def test_a_bound_at_zero_has_no_sign():
    functionals = worst_case(random_system(np.random.default_rng(0), 2), GRIDS["uniform"], None, None)
    both, none = np.array([[-1.0, 0.0], [1.0, 0.0]]), ParameterIndex(None)
    constraint = FlatConstraint("path", functionals, both, np.array([0.0, 0.0]), 0.0, HORIZON, none)
    below = constraint.explain(np.array([1.5]), 0)
    assert below.statement == "path: x1(1.5) >= 0" and "-0" not in below.bound


def test_a_direction_in_words_has_its_largest_terms() -> None:
    few = np.array([1.0, 0.0, -0.5, 0.1, 0.2, 0.3, 0.4])
    assert combination(few, UNNAMED, "(5)") == "x1(5) - 0.5 x3(5) + 0.1 x4(5) + 0.2 x5(5) + 0.3 x6(5) + 0.4 x7(5)"
    words = combination(np.append(few, 0.9), UNNAMED)
    assert words == "x1 - 0.5 x3 + 0.2 x5 + 0.3 x6 + 0.4 x7 + 0.9 x8 + ... (1 smaller term)"
    assert combination(np.ones(270), UNNAMED) == "x1 + x2 + x3 + x4 + x5 + x6 + ... (264 smaller terms)"
