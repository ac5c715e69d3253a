"""Guards checker/problem/held.py: what components give that have one value on several pieces is their sum, with the
first of these, no more certain than the parts; and where they may jump."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from flint import arb

import sparserob_core as sr
from sparserob_core.checker.problem.held import HeldComponents, on_one_grid, summed
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box, Product

CHANGES = [0.0, 0.4, 1.0, 1.7, 2.0]
LASTING = HeldComponents(CHANGES, ((slice(0, 1), np.array([0, 2])), (slice(1, 3), np.array([0, 1, 4]))))
PIECES = {0: {0: [0, 1], 2: [2, 3, 4]}, 1: {0: [0], 1: [1, 2, 3], 4: [4]}, 2: {0: [0], 1: [1, 2, 3], 4: [4]}}


@pytest.mark.parametrize("begun", [1, 2, 3, 5])
def test_sums_hold_the_exact_ones_and_lie_with_the_first_piece(begun):
    rng = np.random.default_rng(begun)
    mid = rng.normal(size=(begun, 2, 1, 3, 2)) * 10.0 ** rng.integers(-8, 8, size=(begun, 2, 1, 3, 2))
    rad = 1e-14 * np.abs(mid)
    kept = mid.copy(), rad.copy()
    found, off = LASTING.gathered(mid, rad)
    assert (mid == kept[0]).all() and (rad == kept[1]).all()
    for at in np.ndindex(2, 1, 3, 2):
        here = (slice(None), *at)
        for first, pieces in PIECES[at[2]].items():
            inside = [k for k in pieces if k < begun]
            for piece in inside[1:]:
                assert found[(piece, *at)] == off[(piece, *at)] == 0.0
            if inside:
                exact = sum(Fraction(x) for x in mid[here][inside])
                lost = sum(Fraction(x) for x in rad[here][inside])
                assert abs(Fraction(found[(first, *at)]) - exact) + lost <= Fraction(off[(first, *at)])
                assert off[(first, *at)] <= 1.1 * float(lost) + 1e-14 * np.abs(mid[here][inside]).sum()


def test_balls_are_summed_too():
    weights = [[arb(k + 10 * j) for j in range(3)] for k in range(5)]
    found = summed(LASTING, weights)
    assert [float(one[0]) for one in found] == [1.0, 0.0, 9.0, 0.0, 0.0]
    assert [float(one[1]) for one in found] == [10.0, 36.0, 0.0, 0.0, 14.0]
    assert float(weights[1][0]) == 1.0  # what is given stays
    assert summed(None, weights) == weights
    turned = summed(LASTING, [[-w if k % 2 else w for w in one] for k, one in enumerate(weights)])
    assert [float(one[0]) for one in turned] == [-1.0, 0.0, 3.0, 0.0, 0.0]
    assert [float(one[1]) for one in turned] == [10.0, -12.0, 0.0, 0.0, 14.0]


def test_breakpoints_are_one_where_they_differ_by_rounding_alone():
    """Those of the dictionary where a disturbance has none."""
    one = Box([-1.0], [1.0])
    problem = sr.OptimalControlProblem(
        system=LinearSystem(np.zeros((1, 1)), np.ones((1, 1)), E=np.ones((1, 3))),
        horizon=2.0,
        initial_state=[0.0],
        control=one,
        disturbance=Product((one, one, one)),
        disturbance_breakpoints=(np.array([0.0, 0.5, 0.501, 2.0]), np.array([0.0, 0.5 + 1e-14, 0.5001, 2.0]), None),
    )
    known, joint = on_one_grid(problem, sr.Dictionary.indicators([0.0, 1.0, 2.0]))
    assert joint.breakpoints.tolist() == [0.0, 0.5, 0.5001, 0.501, 1.0, 2.0]
    assert [list(one) for one in known.disturbance_breakpoints or ()][2] == [0.0, 1.0, 2.0]
    lasting = HeldComponents.of(known, joint.breakpoints[:-1].tolist())
    assert lasting is not None
    assert [firsts.tolist() for _, firsts in lasting.parts] == [[0, 1, 3], [0, 1, 2], [0, 4]]


def test_a_component_may_jump_where_a_piece_of_its_own_begins():
    assert LASTING.may_jump(1.0).tolist() == [True, False, False]
    assert LASTING.may_jump(0.4).tolist() == [False, True, True]
    assert LASTING.may_jump(1.7).tolist() == [False, False, False]
    assert LASTING.may_jump(2.0).tolist() == [False, True, True]
    assert not LASTING.may_jump(0.5).any()
