"""Guards deviations of sets without an interior: along what they differ, how long they are, and which a proof names."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.sets.sets import Product
from sparserob_core.sip.convex_set import null_space, projector
from sparserob_core.sip.finite import Spread

G = np.array([0.6, 0.8])
SEGMENT = sr.Zonotope(np.array([0.1, 0.2]), G[None])
PLATE = sr.Zonotope(np.zeros(3), np.array([[0.25, 0.5, 0.0], [0.125, 0.0, -0.5]]))
THIN = sr.Zonotope(np.zeros(2), np.array([G, [-8e-12, 6e-12]]))


def test_a_set_without_an_interior_spans_what_its_points_differ_by() -> None:
    assert np.abs(SEGMENT.span @ G) == pytest.approx([1.0]) and THIN.span.shape == (1, 2)
    assert PLATE.span.shape == (2, 3) and np.abs(PLATE.span @ [2.0, -1.0, 0.5]).max() < 1e-14
    assert sr.Box([0.0, 0.0], [0.0, 1.0]).span.tolist() == [[0.0, 1.0]]
    assert sr.Box([0.0, 0.0], [1e-12, 1.0]).span.tolist() == np.eye(2).tolist()  # long beside its own length
    both = Product((SEGMENT, sr.Box([-1.0], [1.0]))).span
    assert both.shape == (2, 3) and both[1].tolist() == [0.0, 0.0, 1.0]
    assert sr.NormBall(2.0, 1.0, [0.0, 0.0]).span.tolist() == np.eye(2).tolist()
    turned = SEGMENT.in_units(np.array([2.0, 0.25])).span
    assert turned / np.linalg.norm(turned) @ [3.2, -0.3] == pytest.approx([0.0], abs=1e-14)


def test_projectors_and_null_spaces_are_exact_along_axes() -> None:
    assert null_space(np.array([[0.0, 3.0, 0.0]])).tolist() == [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    assert projector(np.eye(3)[:2]).tolist() == np.diag([1.0, 1.0, 0.0]).tolist()
    assert projector(np.zeros((0, 2))).tolist() == np.zeros((2, 2)).tolist()
    assert projector(np.eye(2)).tolist() == np.eye(2).tolist()
    assert projector(np.array([[3.0, 4.0]])) == pytest.approx(np.outer(G, G))
    rows = np.random.default_rng(1).normal(size=(2, 4))
    across = null_space(rows)
    assert across @ rows.T == pytest.approx(np.zeros((2, 2)), abs=1e-14) and across @ across.T == pytest.approx(
        np.eye(2)
    )


@pytest.mark.parametrize(
    "convex", [SEGMENT, PLATE, THIN, sr.Zonotope(np.zeros(2), np.array([[0.02, 0.03], [1.0, 0.5]]))]
)
def test_a_set_is_as_wide_along_anything_as_its_chords_say(convex: sr.Zonotope) -> None:
    spread, rng = Spread(((2, convex),)), np.random.default_rng(2)
    d = convex.dimension
    for a in rng.normal(size=(50, d)):
        width = float(convex.support(a[None])[0] + convex.support(-a[None])[0])
        for b in (np.concatenate([a, np.zeros(d)]), np.concatenate([np.zeros(d), a])):
            assert width >= float((spread.chords * np.abs(spread.within(b))).max()) * (1.0 - 1e-9)
    assert (spread.chords > 0.0).all()


def test_along_a_segment_chords_are_all_of_it() -> None:
    """``P e_1`` is ``0.36 e_1 + 0.48 e_2``: the segment holds 2 / 0.6 of these."""
    spread = Spread(((1, SEGMENT),))
    assert spread.chords == pytest.approx([2.0 / 0.6, 2.0 / 0.8])
    assert spread.leans and not Spread(((1, sr.Box([0.0, 0.0], [0.0, 1.0])),)).leans


def test_what_is_answered_is_within_the_span_and_what_is_still_is_not_answered() -> None:
    a = np.random.default_rng(3).normal(size=(4, 6))
    spread = Spread(((2, SEGMENT), (1, sr.Box([0.0, -1.0], [0.0, 1.0]))))
    found = spread.within(a)
    assert (
        found[:, :2] == pytest.approx(np.outer(a[:, :2] @ G, G))
        and found[:, 4:].tolist() == (a[:, 4:] * [0, 1]).tolist()
    )
    still = np.array([False, False, True, True, False, False])
    calm = Spread(spread.sets, still=still)
    assert calm.within(a)[:, 2:4].tolist() == calm.named(a)[:, 2:4].tolist() == np.zeros((4, 2)).tolist()
    assert calm.within(a)[:, :2] == pytest.approx(found[:, :2])
    assert calm.support(a) == pytest.approx(spread.support(a)) and calm.radii.tolist() == spread.radii.tolist()


def test_a_proof_names_deviations_within_the_span_and_those_of_other_sets_as_they_are() -> None:
    spread = Spread(((1, THIN), (1, sr.Box([-1.0, 0.0], [1.0, 0.0]))))
    w = np.concatenate([G + np.array([-8e-12, 6e-12]), [0.5, 0.0]])
    assert spread.named(w)[:2] == pytest.approx(G, rel=1e-15) and spread.named(w)[2:].tolist() == [0.5, 0.0]
    plain = Spread(((1, sr.Zonotope(np.zeros(2), np.array([[0.5, 0.25], [-0.25, 1.0]]))),))
    assert plain.named(np.array([0.3, 0.7])).tolist() == [0.3, 0.7]


def test_what_is_lost_of_a_point_is_its_rounding_beside_how_far_it_deviates() -> None:
    """A point 0.5 from 0 that deviates by 2^-30 is written to 2^-54, which is 2^-24 of that; entries that are still, or
    do not deviate, are not named."""
    box = sr.Box([0.5 - 2.0**-30, -1.0, 3.0], [0.5 + 2.0**-30, 1.0, 3.0])
    assert Spread(((1, box),)).lost == pytest.approx(2.0**-52 * 2.0**29, rel=1e-6)
    assert Spread(((1, box),), still=np.array([True, False, False])).lost == 2.0**-52
    assert Spread(()).lost == 2.0**-52
    point, deviation = box.upper[0], 2.0**-30 * (1 - 2.0**-20)
    missed = abs((0.5 + deviation * (1 + 2.0**-25)) - 0.5 - deviation * (1 + 2.0**-25))
    assert point == 0.5 + 2.0**-30 and 0.0 < missed <= Spread(((1, box),)).lost * deviation
