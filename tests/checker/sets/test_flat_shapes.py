"""Guards what the checker says of sets without an interior, or with next to none: points that are in them exactly,
segments along which they are long, sides across what they span."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb, ctx, fmpq

import sparserob_core as sr
from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.checker.sets.known import known
from sparserob_core.control.sets.sets import Box, NormBall, Polytope, Product

ACROSS = np.array([2.0, -1.0, 0.5])  # a normal whose plane floats name exactly
U, V, W = np.array([0.25, 0.5, 0.0]), np.array([0.125, 0.0, -0.5]), np.array([0.125, 0.75, 0.99999])
SPUN = np.array([0.3, 0.7])


def slab(thick: float) -> Polytope:
    """A segment from 0 to 2 along `SPUN`, so thick, as a polytope."""
    H = np.array([[0.7, -0.3], [-0.7, 0.3], SPUN, -SPUN])
    return Polytope(H, np.array([thick, thick, 2.0 * SPUN @ SPUN, 0.0]))


FLAT = {
    "segment": sr.Zonotope(np.array([0.1, 0.2]), SPUN[None]),
    "point": sr.Zonotope(np.array([0.1, 0.2]), np.zeros((1, 2))),
    "segments along one another": sr.Zonotope(np.zeros(2), np.array([SPUN, -2.0 * SPUN, 0.5 * SPUN])),
    "parallelogram": sr.Zonotope(np.array([0.0, 1.0, 0.0]), np.array([U, V])),
    "hexagon": sr.Zonotope(np.zeros(3), np.array([U, V, U + V])),
    "line in space": sr.Zonotope(np.zeros(3), np.array([[0.1, 0.3, 0.7]])),
    "thin": sr.Zonotope(np.zeros(2), np.array([SPUN, [1e-12, -3e-12]])),
    "polytope": slab(0.0),
    "thin polytope": slab(1e-13),
}


def across(vectors, offset):
    """How far a vector is from what exact ones span, at most, by their exact projection."""
    rest = list(offset)
    basis: list[list[fmpq]] = []
    for vector in vectors:
        one = [fmpq(v.numerator, v.denominator) for v in vector]
        for other in basis:
            share = sum(a * b for a, b in zip(one, other, strict=True)) / sum(b * b for b in other)
            one = [a - share * b for a, b in zip(one, other, strict=True)]
        basis.append(one)
        share = sum((x * arb(a) for x, a in zip(rest, one, strict=True)), arb(0)) / arb(sum(a * a for a in one))
        rest = [x - share * arb(a) for x, a in zip(rest, one, strict=True)]
    return max(float(abs(x).upper()) for x in rest)


def drawn(source, rng):
    """A point of the set as floats name it, rounded."""
    shares = rng.dirichlet(np.ones(6))
    return shares @ source.support_point(rng.normal(size=(6, source.dimension)))


@pytest.mark.parametrize("name", FLAT)
def test_a_point_of_a_flat_set_is_told_by_one_next_to_it_that_is_in_it_exactly(name):
    source, rng = FLAT[name], np.random.default_rng(1)
    with ctx.workprec(200):
        shape = known(source)
        vectors = [vector for vector, _ in shape.segments]
        first = shape.member(source.middle())
        size = float(np.abs(source.bounding_box().upper).max())
        for _ in range(20):
            point = drawn(source, rng)
            found = shape.member(point)
            assert [float(x.mid()) for x in found] == pytest.approx(point, abs=1e-11 * size)
            for c in rng.normal(size=(20, source.dimension)):  # no direction in which it is outside
                height = sum((a * x for a, x in zip(balls(c), found, strict=True)), arb(0))
                assert float((height - shape.support(balls(c))).upper()) <= 1e-45
            assert across(vectors, [x - y for x, y in zip(found, first, strict=True)]) <= 1e-45
            assert shape.member(point + 1e-3 * size * rng.normal(size=point.size) + 1e-3) is None


@pytest.mark.parametrize("name", FLAT)
def test_a_flat_set_is_as_long_along_any_direction_as_its_segments_say(name):
    source, rng = FLAT[name], np.random.default_rng(2)
    with ctx.workprec(200):
        shape = known(source)
        for c in rng.normal(size=(50, source.dimension)):
            width = shape.support(balls(c)) + shape.support(balls(-c))
            for vector, length in shape.segments:
                along = float(abs(sum((Fraction(float(a)) * v for a, v in zip(c, vector, strict=True)), Fraction(0))))
                assert float(length) * along <= float(width.upper()) * (1.0 + 1e-12)
        assert (not shape.segments) == (name == "point")
    if name in ("segment", "polytope"):  # of one segment that is all there is
        ((vector, length),) = shape.segments
        assert float(length) * np.abs([float(v) for v in vector]) == pytest.approx(2.0 * SPUN)


def test_segments_along_one_another_are_one():
    ((vector, length),) = known(FLAT["segments along one another"]).segments
    assert length == 2 and [abs(float(v)) for v in vector] == pytest.approx(3.5 * SPUN)
    assert len(known(FLAT["hexagon"]).segments) == len(known(FLAT["parallelogram"]).segments) == 2


def test_sets_with_an_interior_have_none_of_it_and_hold_their_points_themselves():
    rng = np.random.default_rng(3)
    for source in (
        Box([-1.0, 0.0], [1.0, 0.5]),
        slab(1e-3),
        sr.Zonotope(np.zeros(2), np.array([SPUN, [1e-4, -1e-4]])),
        NormBall(2.0, 1e-12, [0.1, 0.2]),
        NormBall(1.0, 0.5, [0.1, 0.2]),
    ):
        shape, middle = known(source), source.interior_point()
        assert shape.segments is None
        assert [float(x.mid()) for x in shape.member(middle)] == middle.tolist()
        assert shape.member(middle + 1.0 + rng.uniform(size=2)) is None
        assert shape.contains(middle) and not shape.contains(middle + 2.0)


def test_a_corner_that_was_rounded_is_told_by_a_point_next_to_it():
    """Of a thin zonotope no float may be next to the corner within it: an honest run was refused for that."""
    source = sr.Zonotope(np.zeros(2), np.array([[0.03, 0.02], [-7e-7, 1.1e-6]]))
    shape, corner = known(source), source.generators.sum(axis=0) * (1.0 + 1e-15)
    assert shape.segments is None and not shape.holds(balls(corner))
    with ctx.workprec(200):
        found = shape.member(corner)
        assert [float(x.mid()) for x in found] == pytest.approx(corner, rel=1e-14)
        for c in np.random.default_rng(4).normal(size=(50, 2)):
            height = sum((a * x for a, x in zip(balls(c), found, strict=True)), arb(0))
            assert float((height - shape.support(balls(c))).upper()) <= 1e-45
    with pytest.raises(Unchecked, match="rounding may have taken"):
        shape.contains(corner)


def test_a_set_that_is_thin_in_one_direction_of_three_keeps_its_points():
    """Its corners span all three: no point of it is moved into a plane of which no corner is known."""
    box = Polytope(np.vstack([np.eye(3), -np.eye(3)]), np.array([1.0, 1.0, 1e-10] * 2))
    assert known(box).segments is None
    assert [float(x.mid()) for x in known(box).member([0.5, 0.25, 5e-11])] == [0.5, 0.25, 5e-11]
    thin = known(sr.Zonotope(np.zeros(3), np.array([[1.0, 1.0, 1.0], [1.0, -1.0, 0.0], [1e-10, 1e-10, -2e-10]])))
    assert len(thin.segments) == 2  # short segments are left out
    near = thin.member([1.0 + 5e-11, 5e-11, 0.5 - 1e-10])
    assert float((near[0] + near[1] - 2 * near[2]).mid()) == pytest.approx(0.0, abs=1e-14)
    assert thin.member([1.0, 0.0, 0.5 - 1e-7]) is None
    leant = known(sr.Zonotope(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 1e-9]])))
    assert leant.segments is None


@pytest.mark.parametrize("kind", ["polytope", "zonotope"])
def test_a_coordinate_in_another_unit_makes_no_set_thin(kind):
    """A rectangle of 1e4 times 1e-6 was taken for a segment, and its middle for an end: an honest run was refused."""
    box = Polytope(np.vstack([np.eye(2), -np.eye(2)]), np.array([1e4, 1e-6] * 2))
    shape = known(box if kind == "polytope" else sr.Zonotope(np.zeros(2), np.diag([1e4, 1e-6])))
    assert shape.segments is None
    assert [float(x.mid()) for x in shape.member([0.0, 1e-19])] == [0.0, 1e-19]


def test_a_product_has_its_points_part_by_part():
    source = Product((FLAT["segment"], Box([-1.0], [1.0])))
    near = known(source).member([0.1 + 0.5 * SPUN[0], 0.2 + 0.5 * SPUN[1], 0.25])
    assert [float(x.mid()) for x in near] == pytest.approx([0.25, 0.55, 0.25], rel=1e-12)
    assert known(source).member([0.1, 0.2, 1.5]) is None and known(source).member([0.1, 0.3, 0.5]) is None


@pytest.mark.parametrize("name", ["segment", "parallelogram", "hexagon", "line in space", "point"])
def test_a_flat_zonotope_has_opposite_sides_that_are_the_set(name):
    """No point beside it is within them, and no point of it is further out than rounding."""
    source, rng = FLAT[name], np.random.default_rng(5)
    shape = known(source)
    H = np.array([c for c, _ in shape.facets])
    h = np.array([float(b.mid()) for _, b in shape.facets])
    assert h == pytest.approx(source.support(H), abs=1e-12) and (h <= source.support(H) + 1e-15).all()
    points = np.array([drawn(source, rng) for _ in range(20)])
    assert (points @ H.T <= h + 1e-12).all()
    H, h = source.halfspaces()
    assert h == pytest.approx(source.support(H), abs=1e-12) and (source.support(H) <= h).all()
    assert (points @ H.T <= h).all() and source.contains(points, 0.0).all()
    d = source.dimension
    for _ in range(40):
        off = 0.01 * rng.normal(size=d)
        told = float(
            np.max([c @ (source.centre + off) - source.support(c[None])[0] for c in rng.normal(size=(400, d))])
        )
        assert told <= 0.0 or not source.contains(source.centre + off, 1e-9)


def test_of_a_plane_that_floats_name_the_normal_is_that():
    H, _ = FLAT["parallelogram"].halfspaces()
    normal = ACROSS / np.linalg.norm(ACROSS)
    assert U @ ACROSS == V @ ACROSS == 0.0
    assert np.abs(H @ normal).max() == pytest.approx(1.0)
    exact = np.array([c for c, _ in known(FLAT["parallelogram"]).facets])
    assert np.abs(exact @ normal).max() == pytest.approx(1.0)


def test_an_exact_side_of_more_bits_than_a_float_is_rounded_outwards() -> None:
    """A zonotope about 2^-55: where the least value of ``-x`` is attained, doubles have no number."""
    with ctx.workprec(96):
        shape = known(sr.Zonotope(np.array([2.0**-55, 0.0]), np.array([[1.0, 0.0], [0.0, 1.0], [0.25, 0.25]])))
        least = shape.least([arb(0)] * 2, [arb(0)] * 2, [arb(-1), arb(0)])
        assert not least > -shape.support([arb(1), arb(0)])
