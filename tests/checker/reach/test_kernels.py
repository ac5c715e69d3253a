"""Guards checker/sets/summands: integrals of the largest of polynomials, by hand and by the trapezoidal rule."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.checker.sets.known import summands_of
from sparserob_core.checker.sets.summands import (
    _evaluate_polynomials,
    _find_crossings,
    channels,
    integrate,
    integrate_maximum,
)
from sparserob_core.control.sets.sets import Box, NormBall, Zonotope


def largest(P, end, count=8_001):
    """The integral of the largest of polynomials ``P (p + 1, v)`` from -1 to ``end``, by the trapezoidal rule."""
    u = np.linspace(-1.0, end, count)
    return float(np.trapezoid((u[:, None] ** np.arange(len(P)) @ P).max(axis=1), u))


def test_the_integral_of_the_largest_of_polynomials_is_enclosed_and_sharp():
    rng = np.random.default_rng(1)
    P = rng.normal(size=(12, 5, 3)) * 0.7 ** np.arange(5)[:, None]
    ends = np.where(np.arange(12) % 3, 1.0, rng.uniform(-0.9, 0.9, size=12))
    none = np.zeros((12, 3))
    value, more, less = integrate_maximum(P, none, ends)
    truth = np.array([largest(p, end) for p, end in zip(P, ends, strict=True)])
    assert (less <= 1e-13).all()  # what rounding does to what is added up
    assert (value <= truth + 1e-6).all() and (truth <= value + more + 1e-6).all()
    assert (more <= 1e-12).all()


def test_two_that_cross_are_integrated_from_crossing_to_crossing():
    """``|u|`` from -1 to 1 is 1, ``max(u^2, 1/4)`` is 1/4 + 2 (1/3 - 1/24 - 1/8)."""
    P = np.zeros((2, 3, 2))
    P[0, 1] = [1.0, -1.0]
    P[1, 2, 0], P[1, 0, 1] = 1.0, 0.25
    value, more, less = integrate_maximum(P, np.zeros((2, 2)), np.ones(2))
    assert value == pytest.approx([1.0, 2.0 * (0.125 + (1.0 - 0.125) / 3.0)])
    assert (more < 1e-12).all() and (less <= 1e-13).all()


def test_many_parts_are_added_up_with_what_rounding_does_to_them():
    """``max(T, -T)`` of Chebyshev's polynomial of degree 8 has 9 parts, whose integrals cancel in its powers."""
    T = np.polynomial.chebyshev.cheb2poly([0] * 8 + [1])
    value, more, less = integrate_maximum(np.stack([T, -T], axis=1)[None], np.zeros((1, 2)), np.ones(1))
    turns = np.concatenate([[1.0], np.cos(np.pi * (2 * np.arange(8) + 1) / 16), [-1.0]])
    whole = [np.cos(9 * a) / 18 - np.cos(7 * a) / 14 for a in np.arccos(turns)]
    truth = float(np.abs(np.diff(whole)).sum())
    assert value[0] - less[0] <= truth <= value[0] + more[0]
    assert 1e-14 < less[0] < 1e-10


def test_segments_together_reach_as_far_as_all_of_them():
    generators = np.array([[0.5, -0.25], [0.25, 1.0], [-0.125, 0.5]])
    summands = summands_of(Zonotope(np.array([3.0, -2.0]), generators))
    far = sum(summand.radii for summand in summands)
    np.testing.assert_allclose(far, np.abs(generators).sum(axis=0), rtol=1e-11)
    assert (far >= np.abs(generators).sum(axis=0)).all()
    plain, zero = np.array([[[1.0, 0.5], [0.2, -0.3]]]), np.zeros((1, 2))
    low, high = (end.sum() for end in integrate(summands, plain, zero))
    u = np.linspace(-1.0, 1.0, 20_001)
    true = float(np.trapezoid(np.abs((plain[0, 0] + u[:, None] * plain[0, 1]) @ generators.T).sum(axis=1), u)) / 2.0
    assert abs(low - true) < 1e-7 and low < high < low + 1e-13


def test_channels_are_those_whose_support_functions_are_absolute_values():
    low, high = integrate(channels(2), np.array([[[0.0, -3.0], [1.0, 0.0]]]), np.array([[0.0, 0.5]]))
    assert low[0] == pytest.approx([0.5, 2.5]) and high[0] == pytest.approx([0.5, 4.5])
    assert low[0, 0] <= 0.5 <= high[0, 0]


def test_errors_of_polynomials_are_errors_of_the_integral():
    """What stands for the largest is off by its own error; another one may be larger by both."""
    P = np.array([[[3.0, 1.0]]])
    for e in ([0.1, 0.4], [0.4, 0.1], [0.25, 0.25]):
        value, more, less = integrate_maximum(P, np.array([e]), np.array([0.5]))
        assert value[0] == pytest.approx(4.5)
        assert more[0] == pytest.approx(1.5 * (e[0] + 2.0 * max(e)))
        assert less[0] == pytest.approx(1.5 * e[0])


def test_roots_are_found_between_signs_that_differ_and_the_middle_is_taken_elsewhere():
    P = np.array([[0.0, 1.0, 0.0], [-0.25, 0.0, 1.0], [1.0, 0.0, 1.0], [1e-300, 0.0, 0.0]])
    start, stop = np.array([-0.7, 0.0, -1.0, -1.0]), np.array([1.0, 1.0, 0.5, 0.0])
    assert _find_crossings(P, start, stop) == pytest.approx([0.0, 0.5, -0.25, -0.5], abs=1e-7)
    assert _evaluate_polynomials(P, np.array([0.5, 0.5, 2.0, 0.0])).tolist() == [0.5, 0.0, 5.0, 1e-300]


def test_summands_are_segments_of_a_box_and_corners_of_what_has_them():
    box = summands_of(Box([-1.0, 2.0], [3.0, 5.0]))
    assert [summand.corners.tolist() for summand in box] == [[[2.0, 0.0], [-2.0, 0.0]], [[0.0, 1.5], [0.0, -1.5]]]
    (ball,) = summands_of(NormBall(1.0, 0.5, centre=[1.0, 2.0]))
    assert sorted(ball.corners.tolist()) == [[-0.5, 0.0], [0.0, -0.5], [0.0, 0.5], [0.5, 0.0]]
    assert (ball.rad < 1e-15).all()
    # in two channels the segments add up, the ball is the largest of its corners
    line, none = np.array([[[1.0, -2.0]]]), np.zeros((1, 2))
    assert np.mean([ends.sum() for ends in integrate(box, line, none)]) == pytest.approx(2.0 + 3.0)
    assert np.mean(integrate([ball], line, none)) == pytest.approx(1.0)
