"""Guards sip/proof/reasons and what sip/proof/verdict makes of it: what is impossible is told at the index where most
is missing, by as much as linear programs say."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import csr_matrix

import sparserob_core as sr
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.proof.reasons import _choose_indices, least_of, least_within, reasons
from sparserob_core.sip.proof.verdict import infeasible_subsystem
from sparserob_core.sip.relaxed.relaxed import Rows

TIMES = np.linspace(0.0, 1.0, 9)  # the ends and centres of four cells


def program(G, h, **more):
    """Rows ``(9, r, n)`` and their right-hand sides ``(9, r)`` at the ends and centres of four cells of time."""
    family = sr.ConstraintFamily(
        name="walls",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (G[np.rint(8 * t[:, 0]).astype(int)], h[np.rint(8 * t[:, 0]).astype(int)]),
        cells=(TIMES[:-1:2, None], TIMES[2::2, None]),
    )
    n = G.shape[2]
    box = {"lower": np.full(n, -1.0), "upper": np.array([2.0] * n), **more}
    return sr.SemiInfiniteProgram(n=n, weights=1.0, families=[family], **box)


def least(program, row):
    """The least of ``row'x`` over the bounds of the decision and of what is a linear image of it."""
    finite = program.finite
    S = np.eye(finite.n) if finite.S is None else finite.S.toarray()
    found = linprog(row, np.vstack([S, -S]), np.concatenate([finite.upper, -finite.lower]), bounds=(None, None))
    return float(found.fun)


@pytest.mark.parametrize("seed", range(12))
def test_every_row_that_no_decision_meets_is_told_where_it_is_missed_most(seed):
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(9, 3, 2)) * rng.uniform(0.3, 3.0, (1, 3, 1))
    truth = np.array([[least(program(G, np.zeros((9, 3))), row) for row in rows] for rows in G])
    h = truth + rng.normal(size=(9, 3)) - 0.2  # about half of all rows are out of reach somewhere
    h[:, 2] = truth[:, 2] + 0.1
    missing = truth - h
    found = reasons(program(G, h))
    assert {one.rows.cuts[0].row for one in found} == {row for row in range(3) if missing[:, row].max() > 0.0}
    for one in found:
        row, at = one.rows.cuts[0].row, int(np.rint(8 * one.rows.cuts[0].index[0]))
        assert (one.kind, at) == ("out of reach", int(missing[:, row].argmax()))
        assert one.amount == pytest.approx(missing[at, row])
        assert one.rows.G[0].tolist() == G[at, row].tolist() and one.rows.h[0] == h[at, row]


@pytest.mark.parametrize("seed", range(8))
def test_walls_that_leave_nothing_between_them_are_told_where_they_cross_most(seed):
    rng = np.random.default_rng(seed)
    G, h = rng.normal(size=(9, 3, 2)), rng.uniform(20.0, 30.0, (9, 3))
    share = rng.uniform(0.3, 3.0, 9)
    G[:, 2] = -G[:, 0] / share[:, None]
    crossed = rng.permutation(np.array([-2.0, -1.0, -0.5, -0.1, 0.2, 0.4, 0.6, 0.8, 1.0]))
    h[:, 0] = rng.uniform(-0.2, 0.2, 9)
    h[:, 2] = -(crossed + h[:, 0]) / share
    made = program(G, h, lower=np.full(2, -100.0), upper=np.full(2, 100.0))
    (one,) = reasons(made)
    at = int(np.rint(8 * one.rows.cuts[0].index[0]))
    assert (one.kind, [cut.row for cut in one.rows.cuts], at) == ("nothing between", [0, 2], int(crossed.argmax()))
    assert one.amount == pytest.approx(1.0) and one.multipliers == pytest.approx([1.0, share[at]])
    assert not reasons(program(G, h + np.array([1.0, 0.0, 0.0]), lower=made.finite.lower, upper=made.finite.upper))


def test_a_row_that_the_decision_does_not_enter_is_told_where_it_is_missed_most():
    rng = np.random.default_rng(0)
    G, h = rng.normal(size=(9, 2, 2)), rng.uniform(20.0, 30.0, (9, 2))
    G[:, 1], h[:, 1] = 1e-15 * G[:, 0], [1.0, -0.3, 0.2, -0.7, -0.1, 1.0, 1.0, -0.2, 1.0]
    (one,) = reasons(program(G, h))
    assert (one.kind, one.rows.cuts[0].index.tolist()) == ("beyond every decision", [3 / 8])
    assert one.amount == pytest.approx(0.7)


def test_cells_are_looked_at_at_their_corners_and_centres_and_a_thinned_choice_keeps_both_ends():
    made = program(np.ones((9, 1, 1)), np.ones((9, 1))).families[0]
    assert _choose_indices(made).ravel().tolist() == TIMES.tolist()
    edges = np.linspace(0.0, 1.0, 3001)
    many = sr.ConstraintFamily(
        name="walls", index_set=made.index_set, rows=made.rows, cells=(edges[:-1, None], edges[1:, None])
    )
    chosen = _choose_indices(many).ravel()
    assert chosen.size == 2000 and (chosen[0], chosen[-1]) == (0.0, 1.0) and np.diff(chosen).max() < 4.5 / 6000


@pytest.mark.parametrize("seed", range(7))
def test_one_row_that_slanted_sides_forbid_is_told_by_what_a_linear_program_misses(seed):
    """The bounds of an image of the decision count too, which are no bounds of its entries."""
    rng = np.random.default_rng(seed)
    S = csr_matrix(np.vstack([np.eye(3), rng.normal(size=(3, 3))]))
    low = np.concatenate([np.full(3, -1.0), rng.uniform(-1.0, -0.3, 3)])
    row = rng.normal(size=3)
    made = program(np.ones((9, 1, 3)), np.full((9, 1), 99.0), S=S, lower=low, upper=-low)
    truth = least(made, row)
    loose = float(-np.abs(row).sum())
    assert loose < truth and least_within(made.finite, row) == pytest.approx(truth)
    assert least_of(made.finite, row[None], np.zeros(1))[0] <= truth + 1e-9
    for limit in (truth - 0.4, (truth + loose) / 2):
        rows = Rows(row[None], np.array([limit]), (Cut("walls", np.zeros(1), 0, 0.0),))
        for y in (1.0, 7.0):
            told, worst = infeasible_subsystem(made, rows, np.array([y]), 1e-9, True)
            assert len(told.reasons) == 1 and worst is not None
            assert worst.violation == pytest.approx(truth - limit, rel=1e-6)


def test_of_many_reasons_those_that_are_not_named_are_counted():
    """Nine rows that ask for more than the decision can give: six are named, three are others."""
    rng = np.random.default_rng(1)
    G, missing = np.tile(rng.uniform(0.5, 1.5, (9, 2)), (9, 1, 1)), rng.uniform(0.3, 0.9, 9)
    h = np.tile(-G[0].sum(axis=1) - missing, (9, 1))
    made = program(G, h)
    rows = Rows(G[0], h[0], tuple(Cut("walls", np.zeros(1), row, 0.0) for row in range(9)))
    told, worst = infeasible_subsystem(made, rows, np.full(9, 0.1), 0.01, True)
    assert (len(told.reasons), told.others) == (6, 3) and len({*told.reasons}) == 6
    assert worst is not None and worst.violation == pytest.approx(missing[0])


@pytest.mark.parametrize(
    ("factor", "demand"),
    [
        (1.0, "weighted by 1, 1 they ask the decision for 1, and it can give at most 0.9"),
        (0.1, "weighted by 1, 0.1 they ask the decision for 0.1, and it can give at most 0.09"),
    ],
)
def test_rows_that_clash_together_are_told_with_what_their_sum_asks_for(factor, demand):
    """``x + y <= -0.6`` and ``-x <= -0.4``, the second one times a factor: the sum ``y <= -1`` is met by no ``y`` from
    -0.9 on. The largest weight is told as 1."""
    G = np.array([[1.0, 1.0], [-factor, 0.0], [0.0, 1.0]])
    h = np.array([-0.6, -0.4 * factor, 5.0])
    made = program(np.tile(G, (9, 1, 1)), np.tile(h, (9, 1)), lower=np.array([-9.0, -0.9]), upper=np.full(2, 9.0))
    rows = Rows(G, h, tuple(Cut("walls", np.zeros(1), row, 0.0) for row in range(3)))
    told, worst = infeasible_subsystem(made, rows, np.array([1.0, 1.0 / factor, 0.0]), 0.02, True)
    assert len(told.members) == 2 and (told.others, told.amount, told.equalities) == (0, 0.02, False)
    assert told.demand == demand
    assert worst is not None and worst.violation == 0.02
