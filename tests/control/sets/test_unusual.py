"""Guards control/sets: what a linear program or a hull does not answer is said, never guessed."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.optimize

from sparserob_core.control.sets.sets import Box, Ellipsoid, Equality, NormBall, Polytope, Zonotope
from sparserob_core.errors import InputError

SQUARE = np.vstack([np.eye(2), -np.eye(2)]), np.ones(4)


def test_a_polytope_about_which_a_program_says_nothing_is_refused(monkeypatch):
    monkeypatch.setattr(scipy.optimize, "linprog", lambda *a, **k: SimpleNamespace(status=4, message="numbers failed"))
    with pytest.raises(InputError, match=r"could not decide whether it is empty \(numbers failed\)"):
        Polytope(*SQUARE)


def test_where_a_program_fails_a_support_is_infinite_and_never_too_small(monkeypatch):
    made = Polytope(*SQUARE)
    assert made._maximise(np.array([3.0, -4.0])) == (pytest.approx(7.0), pytest.approx([1.0, -1.0]))
    assert made._maximise(np.zeros(2))[0] == 0.0
    monkeypatch.setattr(scipy.optimize, "linprog", lambda *a, **k: SimpleNamespace(status=1, message=""))
    value, point = made._maximise(np.array([3.0, -4.0]))
    assert value == np.inf and made.contains(point)


def test_flat_polytopes_have_their_vertices_and_keep_their_support():
    segment = Polytope([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], [1.0, 0.5, 0.25, -0.25])
    assert segment.vertices.tolist() == [[-0.5, 0.25], [1.0, 0.25]]
    c = np.array([[1.0, 2.0], [-3.0, 1.0]])
    assert segment.support(c) == pytest.approx([1.0 + 0.5, 1.5 + 0.25])
    assert segment.amid() == pytest.approx([0.25, 0.25])
    assert Polytope(*SQUARE).amid() == pytest.approx([0.0, 0.0])
    assert sorted(map(tuple, np.round(Polytope(*SQUARE).vertices, 9).tolist())) == [(-1, -1), (-1, 1), (1, -1), (1, 1)]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e-200, 1e-30, 1e30, 1e200])
def test_polytopes_of_numbers_of_very_different_sizes_have_their_support(size):
    """Each set is a square, or one of which a row in other units cuts off nothing, or a half."""
    (H, h), c = SQUARE, np.vstack([np.eye(2), -np.eye(2)])
    cases = {
        "a row in other units": ([*H, [size, size]], [*h, size], [1.0, 1.0, 1.0, 1.0]),
        "a row through the middle, or far away": ([*H, [size, size]], [*h, 1.0], [1.0, 1.0, 1.0, 1.0]),
        "an entry beside 1": ([*H, [0.0, 1.0], [size, 0.0]], [*h, 1.0, size], [1.0, 1.0, 1.0, 1.0]),
        "entries of one row": ([*H, [size, 1.0]], [*h, max(size, 1.0)], [1.0, 1.0, 1.0, 1.0]),
        "a side": ([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], [size, 1.0, 1.0, 1.0], [size, 1.0, 1.0, 1.0]),
        "a coordinate": (H * [size, 1.0], h, [1.0 / size, 1.0, 1.0 / size, 1.0]),
    }
    for name, (rows, sides, expected) in cases.items():
        polytope = Polytope(rows, sides)
        widths = np.tile(np.add(expected[:2], expected[2:]), 2)
        assert polytope.is_bounded and polytope.contains(polytope.interior_point()), name
        assert polytope.support(c) / widths == pytest.approx(expected / widths, abs=1e-12), name
        if name != "a side":  # of which 4 is no width
            with pytest.raises(InputError, match="empty, no point"):
                Polytope([*np.asarray(rows), [size, 0.0]], [*sides, -3.0 * size * expected[2]])


@pytest.mark.parametrize(
    "bound", [Polytope(*SQUARE), Polytope([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], [1.0, 0.5, 0.5])]
)
def test_extreme_samples_lie_on_the_boundary(bound):
    rng = np.random.default_rng(1)
    points = bound.sample_extreme(30, rng)
    assert points.shape == (30, 2) and bound.violation(points) == pytest.approx(np.zeros(30), abs=1e-9)
    inside = bound.sample(200, rng)
    assert bound.contains(inside, 1e-9).all()
    low, high = bound.bounding_box().lower, bound.bounding_box().upper
    assert (inside.min(axis=0) < low + 0.2 * (high - low)).all() and (
        inside.max(axis=0) > high - 0.4 * (high - low)
    ).all()


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: Ellipsoid([0.0], "wide"), "shape must be a square matrix of numbers"),
        (lambda: Ellipsoid([0.0, 0.0], [[1.0, 0.0]]), r"square matrix of finite numbers, got shape \(1, 2\)"),
        (lambda: Ellipsoid([0.0, 0.0], [[1.0, 2.0], [2.0, 1.0]]), "symmetric positive definite"),
        (lambda: Ellipsoid([0.0, 0.0], [[1.0, 0.1], [0.2, 1.0]]), "symmetric positive definite"),
        (lambda: NormBall(0.5, 1.0, dimension=2), "a number of at least 1"),
        (lambda: NormBall(2.0, -1.0, dimension=2), "a finite number, at least 0"),
        (lambda: NormBall(2.0, np.inf, dimension=2), "a finite number, at least 0"),
        (lambda: NormBall(2.0, 1.0), "a centre, or a dimension"),
        (lambda: NormBall(2.0, 1.0, dimension=0), "at least 1"),
        (lambda: NormBall(2.0, 1.0, centre=[np.inf]), "finite numbers"),
        (lambda: Polytope("H", [1.0]), "H must be a matrix of numbers"),
        (lambda: Polytope([[np.inf]], [1.0]), "matrix of finite numbers"),
        (lambda: Polytope([[1.0]], [-np.inf]), "h must not be -inf"),
        (lambda: Polytope([[1.0], [0.0]], [1.0, -1.0]), "empty, row 1 of H is zero"),
        (lambda: Polytope([[1.0], [-1.0]], [1.0, -2.0]), "empty, no point satisfies"),
        (lambda: Zonotope([0.0], "wide"), "generators must be rows of numbers"),
        (lambda: Zonotope([0.0], [1.0]), r"rows of finite numbers, one for each, got shape \(1,\)"),
        (lambda: Zonotope([0.0], [[np.nan]]), "rows of finite numbers"),
        (lambda: Zonotope([0.0, 0.0, 0.0], [[1.0, 0.0]]), "zonotope.centre: expected 2 numbers, got 3"),
        (lambda: Equality("x"), "a list of numbers, null where free"),
        (lambda: Equality([np.inf]), "a list of finite numbers"),
        (lambda: Equality([]), "a list of finite numbers"),
    ],
)
def test_numbers_that_describe_no_set_are_refused_by_what_was_expected(build, sentence):
    with pytest.raises(InputError, match=sentence):
        build()


def test_a_zonotope_is_made_of_lists_as_of_arrays():
    made = Zonotope([0.5, 0.0], [[1.0, 0.0], [0.5, 0.5]])
    assert made.dimension == 2 and made.support(np.array([1.0, 1.0])) == 0.5 + 1.0 + 1.0


def test_what_is_fixed_has_the_dimension_of_the_state():
    assert Equality([0.5, None, 1.0]).dimension == 3 and Box([-1.0], [1.0]).dimension == 1
