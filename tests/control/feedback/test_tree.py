"""Guards control/feedback/tree: the least of every causal policy on a tree of signals, by hand.

``x(2) = 0.5 + u_0 + u_1 + w_0 + w_1 <= 0.2`` with ``|w| <= 0.25``: what is asked of the sum is 0.3, and 0.25 for every
disturbance that is not 0; the second piece knows ``w_0``.
"""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.feedback.knowledge import Knowledge
from sparserob_core.control.feedback.tree import Sampled, Tree
from sparserob_core.control.sets.sets import Box, Polytope
from sparserob_core.sip.finite import Spread

NONE, UP, DOWN = np.zeros(2), np.array([0.25, 0.25]), np.array([-0.25, 0.25])
COUNT = np.zeros(1, dtype=int)


def tree(cost="nominal", control=1.0, prices=(1.0, 1.0), signals=(NONE,), highest=None, T=(1.0, 1.0)):
    bound = Box([-control], [control]) if isinstance(control, float) else control
    sampled = Sampled(np.array([[T]]), np.ones((1, 2)), np.array([-0.3]), COUNT, COUNT, np.array([2.0]))
    known = Knowledge(sampled.N, Spread(((2, Box([-0.25], [0.25])),)), 1, np.array([0, 1]), COUNT + 2)
    made = Tree(sampled, known, bound, np.array([prices]), cost, highest)
    assert all(made.add(z) for z in signals)
    return made


@pytest.mark.parametrize(
    ("cost", "signals", "value"),
    [
        ("nominal", (NONE,), 0.55),  # the second piece may do all it can where w_0 is the worst, at no price
        ("nominal", (NONE, UP), 0.55),
        ("peak", (NONE,), 0.8),
        ("peak", (NONE, UP, DOWN), 0.8),
        ("worst", (NONE,), 0.55),  # of signals that are not in the tree the effort is not seen
        ("worst", (NONE, UP), 0.8),
        ("worst", (NONE, DOWN), 0.55),
    ],
)
def test_the_least_cost_of_a_tree_is_by_hand(cost, signals, value):
    made = tree(cost, signals=signals)
    grown = made.least()
    assert grown.value == pytest.approx(value)
    assert (made.excess(grown) <= 1e-9).all()
    assert grown.u.shape == (len(signals), 1, 2)
    # a policy that is causal: the first piece knows nothing
    assert np.ptp(grown.u[:, 0, 0]) == pytest.approx(0.0, abs=1e-12)
    # weak duality, of the multipliers that are told, for the costs without further columns
    assert (grown.multipliers > 0.0).all()
    if cost != "worst":
        assert grown.multipliers.sum() == pytest.approx(1.0)
    else:
        assert grown.shares.sum() == pytest.approx(1.0)
    asked = sum(
        y * (made.sampled.N[r] @ made.changed(s, r, b) + 0.3)
        for y, s, r, b in zip(grown.multipliers, grown.signals, grown.rows, grown.reports, strict=True)
    )
    assert asked >= grown.value - 1e-9


def test_prices_and_what_the_control_gives_count():
    assert tree(prices=(3.0, 1.0)).least().value == pytest.approx(0.55)
    assert tree(prices=(1.0, 3.0)).least().value == pytest.approx(0.55)
    assert tree(prices=(2.0, 2.0)).least().value == pytest.approx(1.1)
    # with a second piece that has half the effect, the first one does it all
    assert tree(T=(1.0, 0.5)).least().value == pytest.approx(0.55)
    assert tree("peak", T=(0.5, 1.0), prices=(1.0, 1.0)).least().value == pytest.approx(0.8)
    # the first is at most 1: 0.8 / 0.5 is out of its reach alone
    assert tree("peak", T=(0.5, 1.0), prices=(0.1, 1.0)).least().value == pytest.approx(0.1 + 0.3)
    one_sided = Box([-1.0], [0.0])
    assert tree("peak", control=one_sided).least().value == pytest.approx(0.8)
    assert tree(control=Box([0.0], [1.0])).least() is None
    # from which 0 is excluded: 0.1 a piece is there anyway
    assert tree("peak", control=Box([-1.0], [-0.1])).least().value == pytest.approx(0.8)
    assert tree("peak", control=Box([-1.0], [-0.6])).least().value == pytest.approx(1.2)


def test_a_polytope_of_controls_is_one_on_every_piece():
    flat = Polytope(np.array([[2.0], [-4.0]]), np.array([2.0, 4.0]))
    assert tree(control=flat).least().value == pytest.approx(0.55)
    assert tree(control=Polytope(np.array([[2.0], [-4.0]]), np.array([2.0, 1.2]))).least() is None


def test_what_is_out_of_reach_is_so_and_is_relaxed_by_what_it_misses():
    """Together 0.5 of 0.8: the unit of the row is 0.5 + 0.5 + 0.3."""
    weak = tree(control=0.25)
    assert weak.least() is None
    relaxed = tree(control=0.25).relaxed()
    assert relaxed.value == pytest.approx(0.3 / 1.3)
    full = tree()
    assert full.units == pytest.approx([2.8])
    assert full.relaxed(budget=0.5).value == pytest.approx(0.05 / 2.8)
    assert full.relaxed(budget=0.8).value < 0.0
    assert full.relaxed(budget=0.5, central=True).value == pytest.approx(0.05 / 2.8, abs=1e-6)
    # and is the same program as before
    assert full.least().value == pytest.approx(0.55)


def test_the_largest_factor_of_the_disturbance_is_by_hand():
    """``-2 c + 0.3 + 0.5 f <= 0``."""
    for control, factor in ((0.25, 0.4), (0.2, 0.2), (1.0, 1.0)):
        grown = tree(control=control, highest=1.0).least()
        assert grown.value == pytest.approx(factor)
    assert tree(control=0.1, highest=1.0).least() is None


def test_a_signal_is_added_once_and_changed_from_a_block_on():
    made = tree(signals=(NONE, DOWN))
    assert not made.add(DOWN.copy())
    assert not made.add(-0.0 * NONE)
    assert made.knowledge.reports == 2
    assert made.changed(0, 0, 0).tolist() == UP.tolist()
    assert made.changed(0, 0, 1).tolist() == [0.0, 0.25]
    assert made.changed(1, 0, 1).tolist() == DOWN.tolist()
    assert made.changed(0, 0, 2).tolist() == [0.0, 0.0]
    sampled = Sampled(np.ones((1, 1, 2)), np.array([[1.0, 0.0]]), np.array([-0.3]), COUNT, COUNT, np.ones(1))
    known = Knowledge(sampled.N, Spread(((2, Box([-0.25], [0.25])),)), 1, np.array([0, 1]), COUNT + 1)
    early = Tree(sampled, known, Box([-1.0], [1.0]), np.ones((1, 2)), "nominal")
    early.add(NONE)
    assert early.changed(0, 0, 0).tolist() == [0.25, 0.0]
    over = early.excess(early.relaxed())
    assert np.isneginf(over[0, 0]).tolist() == [False, False, True]
