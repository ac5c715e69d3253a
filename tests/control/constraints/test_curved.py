"""Guards where a curved set is found to be left, along time: at its maxima, and all along a wall that is ridden."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.local_maxima import MAX_RETURNED, along_spans, find_kink_neighbours, ridden
from sparserob_core.control.reach.many_directions import ManyDirections
from sparserob_core.control.sets.directions import sampled
from sparserob_core.sip.proof.branch_and_bound import prove_family
from tests.known_answers.test_walls import ridden as problem
from tests.support.transcribed import family_of


@pytest.fixture(scope="module", params=[False, True], ids=["known", "uncertain"])
def curved(request: pytest.FixtureRequest) -> CurvedConstraint:
    """The ellipse that moves, of 16 pieces."""
    return family_of(problem("curved", 16, uncertain=request.param), "path").source


def dense(constraint: CurvedConstraint, x: Any, times: Any) -> Any:
    """The worst violations at times, over directions and parameters, by many samples of both."""
    angles = np.linspace(0.0, 2 * np.pi, 181)
    z = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    box = constraint.index_set
    count = constraint.parameters.count
    corners = np.linspace(box.lower[1 : 1 + count], box.upper[1 : 1 + count], 5 if count else 1)
    every = np.vstack([np.hstack([np.tile(corner, (len(z), 1)), z]) for corner in corners])
    found = []
    for time in times:
        at = np.hstack([np.full((len(every), 1), time), every])
        found.append(constraint.violations(x, at, np.zeros(len(at), dtype=int)).max())
    return np.array(found)


def test_the_worst_violation_is_not_below_that_of_dense_samples(curved: CurvedConstraint) -> None:
    for x in np.random.default_rng(3).uniform(0.0, 1.2, (2, curved.functionals.variables)):
        found = curved.worst(x)
        assert found.violations[0] >= dense(curved, x, np.linspace(0.25, 4.0, 61)).max() - 1e-3
        rows = np.zeros(found.violations.size, dtype=int)
        np.testing.assert_allclose(found.violations, curved.violations(x, found.indices, rows), rtol=0.0, atol=1e-9)


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "beside",
    [{"disturbance": {"box": [0.1, 0.05]}, "disturbance_class": "measurable"}, {"execution": [0.1, 0.2]}],
    ids=["measurable", "errors"],
)
def test_what_is_climbed_to_roughly_is_told_exactly_and_is_hardly_below_dense_samples(beside: Any) -> None:
    config = problem("curved", 16)
    plant = {"A": [[-0.5, 1.0], [-1.0, -0.5]], "B": [[1.0, 0.2], [0.0, 1.0]]}
    config["problem"] = {**config["problem"], "system": plant, **beside}
    constraint = family_of(config, "path").source
    control = np.random.default_rng(3).uniform(0.0, 1.2, constraint.functionals.coefficients)
    x = np.concatenate([control, np.abs(control)])[: constraint.functionals.variables]
    found = constraint.worst(x)
    rows, top = np.zeros(found.violations.size, dtype=int), dense(constraint, x, np.linspace(0.25, 4.0, 9)).max()
    np.testing.assert_allclose(found.violations, constraint.violations(x, found.indices, rows), rtol=0.0, atol=1e-12)
    assert found.violations[0] >= top - 1e-3
    at = constraint.functionals_at(found.indices)[:3]
    exact, rough = (constraint.functionals.values(x, *at, how) for how in (False, True))
    np.testing.assert_allclose(rough, exact, rtol=0.0, atol=1e-2)
    if "execution" in beside:  # what is constant on pieces is among all errors
        assert (rough <= exact + 1e-12).all() and (rough < exact - 1e-4).any()


def test_a_set_that_is_left_is_imposed_all_along(curved: CurvedConstraint) -> None:
    x = np.zeros(curved.functionals.variables)  # the state falls to 0, and the ellipse is left for good
    found = curved.worst(x)
    assert found.violations.size <= MAX_RETURNED
    left = found.indices[found.violations > 0.0, 0]
    pieces = np.arange(0.25, 4.0, 0.25)
    gone = pieces[(dense(curved, x, pieces) > 0.0) & (dense(curved, x, pieces + 0.25) > 0.0)]
    near = np.abs(gone[:, None] - left).min(axis=1)
    assert near.max() <= 0.5


def test_directions_at_a_held_time_are_the_worst_ones(curved: CurvedConstraint) -> None:
    x, times = np.full(curved.functionals.variables, 0.6), np.array([0.4, 1.3, 3.9])
    box = curved.index_set
    middle = (box.lower + box.upper)[1 : 1 + curved.parameters.count] / 2
    z = sampled(2)
    best = [
        curved.violations(x, np.hstack([np.tile([t, *middle], (len(z), 1)), z]), np.zeros(len(z), int)).argmax()
        for t in times
    ]
    start = np.hstack([times[:, None], np.tile(middle, (3, 1)), z[best]])
    turned, heights = curved._climb_directions(x, start)
    np.testing.assert_array_equal(turned[:, :-2], start[:, :-2])
    np.testing.assert_allclose(heights, curved.violations(x, turned, np.zeros(3, dtype=int)), rtol=0.0, atol=1e-12)
    angles = np.linspace(0.0, 2 * np.pi, 2001)
    for k in range(3):
        around = np.tile(start[k], (angles.size, 1))
        around[:, -2:] = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        assert heights[k] >= curved.violations(x, around, np.zeros(angles.size, dtype=int)).max() - 1e-9


def test_what_a_direction_makes_of_the_worst_case_is_linear_in_weights_of_the_axes(curved: CurvedConstraint) -> None:
    rng = np.random.default_rng(4)
    functionals, x = curved.functionals, rng.uniform(0.0, 2.0, curved.functionals.variables)
    times, c = rng.uniform(0.3, 4.0, 6), rng.normal(size=(6, 2))
    box = curved.index_set
    parameters = rng.uniform(box.lower[1:-2], box.upper[1:-2], (6, curved.parameters.count))
    which = np.array([5, 5, 0, 0, 3, 3])
    found = ManyDirections(functionals).turning(x, times, parameters)(c, which)
    np.testing.assert_allclose(found, functionals.values(x, times[which], c, parameters[which]), rtol=1e-12)


def test_speeds_that_a_round_wall_hardly_limits_take_no_cells() -> None:
    """Of twelve faces of directions in six states the six of positions are open at first; speeds need not be halved."""
    at = 0.9 * 0.35 / np.sqrt(3.0)  # the vehicle rests there, nine tenths of the way to the wall
    A, B = np.eye(6, k=3), np.eye(6)[:, 3:]
    shape = np.diag([0.35**2] * 3 + [1e4] * 3)
    stated = {
        "name": "linear",
        "system": {"A": A.tolist(), "B": B.tolist(), "E": B.tolist()},
        "horizon": 4.0,
        "initial_state": [at, at, -at, 0.0, 0.0, 0.0],
        "control": {"box": 6.0},
        "disturbance": {"box": 0.001},
        "path": [{"ellipsoid": {"shape": shape.tolist()}, "from": 1.0}],
    }
    pieces = {name: {"name": "piecewise_constant", "pieces": 8} for name in ("control", "disturbance")}
    family = family_of({"problem": stated, "dictionaries": pieces}, "path")
    assert prove_family(family, np.zeros(24), cells=400).verdict == "proven"


def test_a_violation_that_rises_and_falls_beside_a_kink_is_met() -> None:
    times, kinks = np.linspace(0.0, 2.0, 9), np.array([0, 4, 8])

    def height(at: Any) -> Any:
        later = at - 1.0
        return np.where(later >= 0.0, -0.001 + 0.08 * later - 0.5 * later**2, -0.001 * at)

    line = height(times)  # no sample is above 0, and neither the one at the kink nor those beside it are maxima
    assert [0, 0, 5] in find_kink_neighbours(line[None, None], times, kinks, MAX_RETURNED).tolist()
    held, pieces = np.hstack([times[:, None], np.ones((9, 1))]), np.repeat([0, 1, 2], [1, 4, 4])

    def turned(points: Any) -> Any:
        return points, height(points[:, 0])

    indices, found = ridden(held, line, pieces, kinks, turned, turned)
    assert found[0] == pytest.approx(0.0022)
    assert indices[0, 0] == pytest.approx(1.08)


def test_spans_are_thinned_evenly_and_leave_what_is_near_a_maximum() -> None:
    heights, pieces = np.linspace(0.1, 1.0, 40)[None, None], np.repeat(np.arange(20), 2)
    spans = along_spans(heights, np.array([[0, 0, 39]]), pieces, 100)[:, 2]
    assert pieces[spans].tolist() == list(range(18))
    assert along_spans(heights, np.array([[0, 0, 39]]), pieces, 6)[:, 2].size == 6
