"""Guards control/sets/sets: a product of sets is what each of its parts says of its own coordinates, together."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.sets.directions import neighbours, sampled
from sparserob_core.control.sets.sets import Box, Ellipsoid, NormBall, Polytope, Product, product

TRIANGLE = Polytope([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]], [0.2, 0.3, 1.1])
ROUND = Ellipsoid([0.1, -0.2], [[1.0, 0.3], [0.3, 0.5]])
PARTS = (NormBall(p=3.0, radius=0.7, centre=[0.1, -0.3]), Box([-0.4], [0.9]), ROUND)
MIXED = Product(PARTS)
OWN = [slice(0, 2), slice(2, 3), slice(3, 5)]


def test_a_product_reaches_as_far_as_its_parts_do_together():
    rng = np.random.default_rng(1)
    c = rng.normal(size=(7, 5))
    assert MIXED.dimension == 5 and MIXED.is_bounded and not MIXED.is_symmetric
    assert MIXED.kind == "product of normball and box and ellipsoid"
    found = MIXED.support(c)
    assert found == pytest.approx(sum(part.support(c[:, own]) for part, own in zip(PARTS, OWN, strict=True)), rel=1e-14)
    reached = MIXED.support_point(c)
    assert (c * reached).sum(axis=1) == pytest.approx(found, rel=1e-9)
    for part, own in zip(PARTS, OWN, strict=True):
        assert part.contains(reached[:, own], 1e-9).all()
        assert part.contains(MIXED.interior_point()[own]) and part.contains(MIXED.middle()[own])
    assert Product((Box([-1.0, 0.0], [1.0, 3.0]), Box([-1.0], [1.0]))).is_symmetric
    assert not Product((ROUND, Polytope([[1.0]], [1.0]))).is_bounded


def test_a_point_is_as_far_outside_as_it_is_outside_of_every_part():
    """``3, 4`` beyond two parts are 5 beyond the product; within, the nearest boundary counts."""
    both = Product((Box([-1.0], [1.0]), Ellipsoid([0.0, 0.0], np.eye(2))))
    points = np.array([[4.0, 0.0, 5.0], [4.0, 0.0, 0.5], [0.9, 0.3, 0.4], [-0.2, 0.0, 0.75]])
    assert both.violation(points) == pytest.approx([5.0, 3.0, -0.1, -0.25])
    assert both.gauge(points) == pytest.approx([5.0, 4.0, 0.9, 0.75])
    assert both.contains(points).tolist() == [False, False, True, True]
    normals = both.normal(points)
    assert (normals[2:] / np.linalg.norm(normals[2:], axis=1)[:, None]).tolist() == [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    assert normals[1, 0] > 0.0 and (normals[1, 1:] == 0.0).all()


def test_samples_of_a_product_are_those_of_its_parts():
    rng = np.random.default_rng(2)
    for points in (MIXED.sample(40, rng), MIXED.sample_extreme(40, rng)):
        assert points.shape == (40, 5) and MIXED.contains(points, 1e-9).all()
    for part, own in zip(PARTS, OWN, strict=True):  # the last ones are on the boundary of every part
        assert part.violation(points[:, own]) == pytest.approx(np.zeros(40), abs=1e-8)
        assert np.ptp(points[:, own], axis=0).min() > 0.5


def test_a_product_in_other_units_and_of_another_size_is_that_of_its_parts():
    rng = np.random.default_rng(3)
    c, units = rng.normal(size=(5, 5)), np.array([2.0, 0.5, 10.0, 1.5, 0.25])
    middle = MIXED.middle()
    assert MIXED.scaled(0.3).support(c) == pytest.approx(c @ middle + 0.3 * (MIXED.support(c) - c @ middle))
    assert MIXED.in_units(units).support(c) == pytest.approx(MIXED.support(c / units))


@pytest.mark.parametrize("size", [0.02, 0.5])
def test_what_a_product_loses_around_a_direction_is_what_its_parts_lose(size):
    rng = np.random.default_rng(4)
    centre, spread = rng.normal(size=5), size * rng.normal(size=(2, 5))
    shares = np.vstack([rng.uniform(-1.0, 1.0, (60, 2)), [[1, 1], [1, -1], [-1, 1], [-1, -1]]])
    around = MIXED.support(centre + shares @ spread)
    lost = around - (centre + shares @ spread) @ MIXED.support_point(centre)
    assert lost.max() <= MIXED.linearisation_excess(centre, spread) + 1e-12
    parts = [part.linearisation_excess(centre[own], spread[:, own]) for part, own in zip(PARTS, OWN, strict=True)]
    assert MIXED.linearisation_excess(centre, spread) == pytest.approx(sum(parts))
    point, excess = MIXED.support_majorant(centre, spread)
    assert (around <= (centre + shares @ spread) @ point + excess + 1e-12).all()
    assert excess == pytest.approx(
        sum(part.support_majorant(centre[own], spread[:, own])[1] for part, own in zip(PARTS, OWN, strict=True))
    )
    value, gradient, hessian = MIXED.support_minorant(centre, spread)
    assert (around >= value + shares @ gradient + 0.5 * np.einsum("si,ij,sj->s", shares, hessian, shares) - 1e-12).all()
    assert value == pytest.approx(float(MIXED.support(centre)))
    assert gradient == pytest.approx(spread @ MIXED.support_point(centre))


def test_a_product_of_boxes_is_a_box_and_one_of_flat_sets_a_polytope():
    assert product([ROUND]) is ROUND
    box = product([Box([-1.0], [2.0]), Box([0.0, -3.0], [1.0, 4.0])])
    assert isinstance(box, Box) and (box.lower == [-1.0, 0.0, -3.0]).all() and (box.upper == [2.0, 1.0, 4.0]).all()
    flat = product([TRIANGLE, Box([-1.0], [2.0])])
    assert isinstance(flat, Polytope)
    c = np.random.default_rng(5).normal(size=(9, 3))
    assert flat.support(c) == pytest.approx(TRIANGLE.support(c[:, :2]) + Box([-1.0], [2.0]).support(c[:, 2:]))
    assert isinstance(product([TRIANGLE, ROUND]), Product)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_directions_beside_one_are_a_step_of_the_lattice_away(dimension):
    points, beside = sampled(dimension), neighbours(dimension)
    step = np.diff(np.unique(points[:, 0]))[0]
    for number, point in enumerate(points):
        near = np.flatnonzero(np.abs(points - point).max(axis=1) < 1.5 * step)
        assert sorted(set(beside[number].tolist())) == near.tolist()
