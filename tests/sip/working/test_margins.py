"""Guards sip/working/working: the rules of margins, which are the same for rows of the decision and for rows that must
hold for every deviation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

import sparserob_core as sr
from sparserob_core.sip.evidence import Proof
from sparserob_core.sip.finite import FiniteSolution, Spread, UncertainRows
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import Separation
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.working.ledger import CheckedAnswer, Ledger
from sparserob_core.sip.working.plain import PlainRows
from sparserob_core.sip.working.robust import RobustRows
from sparserob_core.sip.working.working import ALLOWANCES, LARGEST_MARGIN, SMALLEST_MARGIN, Working
from sparserob_piqp import Piqp

KINDS = ("plain", "robust")
AT = np.array([[0.5]])


def program(kind: str) -> sr.SemiInfiniteProgram:
    """The least ``x >= t`` for t in [0, 1], and in the second kind for all deviations of at most 0."""

    def uncertain(index: np.ndarray) -> UncertainRows:
        nothing = csr_array((1, 1))
        row, each = csr_array([[-1.0]]), np.zeros(1, dtype=int)
        return UncertainRows(row, -index, each, np.ones(1), (nothing,), np.zeros((1, 1)))

    family = sr.ConstraintFamily(
        name="above",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (-np.ones((len(t), 1, 1)), -t),
        uncertain=uncertain,
        start=np.zeros((0, 1)),
    )
    spread = Spread(((1, sr.Box([0.0], [0.0])),)) if kind == "robust" else None
    return sr.SemiInfiniteProgram(n=1, q=[1.0], lower=0.0, upper=9.0, families=[family], spread=spread)


def begun(kind: str) -> tuple[Working, Ledger]:
    """A working set with one row imposed, and its accounts."""
    case, tools = program(kind), Tools(Piqp())
    ledger = Ledger(case, RelaxedProgram(case, tools.solver), tools, 1e-7)
    close = Exchange().close
    working = PlainRows.start(case, tools, True, close) if kind == "plain" else RobustRows.start(case, ledger, close)
    assert working.impose([(AT, np.zeros(1, dtype=int), "above")]) == 1
    return working, ledger


def answer(working: Working, ledger: Ledger) -> CheckedAnswer:
    found = working.relax(ledger, lambda x, cells=0: (), False)
    assert isinstance(found, CheckedAnswer)
    return found


def violated(amount: float) -> Separation:
    return Separation(AT, np.zeros(1, dtype=int), np.array([amount]))


def undecided(bound: float) -> Proof:
    return Proof("above", "undecided", bound, index=AT[0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_margin_costs_no_more_than_four_tenths_of_the_tolerated_gap_and_is_worth_having(kind: str) -> None:
    working, ledger = begun(kind)
    exact = answer(working, ledger)
    assert exact.solution.x == pytest.approx([0.5], abs=1e-12)
    assert working.margin > 0.0
    tightened = answer(working, ledger)
    spent = tightened.solution.x[0] - 0.5
    assert 0.05 * ledger.tolerance * 0.5 <= spent <= 0.4 * ledger.tolerance * 0.5
    assert ledger.gap(tightened.solution.x) <= ledger.tolerance


@pytest.mark.parametrize("kind", KINDS)
def test_an_imposed_row_that_is_violated_is_tightened_by_twice_as_much_and_no_other(kind: str) -> None:
    working, ledger = begun(kind)
    family = working.program.families[0]
    answer(working, ledger)
    before = working.margin
    assert not working.tighten([(family, Separation(AT / 2, np.zeros(1, dtype=int), np.array([1e-7])))])
    assert not working.tighten([(family, violated(1e-10))])
    assert working.margin == before
    assert working.tighten([(family, violated(1e-7))])
    assert working.margin == working.floor == pytest.approx(2e-7)
    assert working.tighten([(family, violated(1.0))])
    assert working.margin == LARGEST_MARGIN
    assert not working.tighten([(family, violated(1.0))])


@pytest.mark.parametrize("kind", KINDS)
def test_what_rounding_leaves_open_is_allowed_for_a_few_times_and_what_is_more_is_not(kind: str) -> None:
    working, ledger = begun(kind)
    exact = answer(working, ledger)
    before = working.margin
    assert not working.allow_for(ledger, exact, [undecided(1e-5)])
    assert not working.allow_for(ledger, exact, [undecided(np.inf)])
    refuted = Proof("above", "refuted", np.inf, violation=1e-8, index=AT[0])
    assert not working.allow_for(ledger, exact, [refuted])
    assert working.margin == before
    for number in range(1, ALLOWANCES + 1):
        assert working.allow_for(ledger, exact, [undecided(2e-9)])
        assert working.margin == pytest.approx(before + number * 2.5e-9)
    assert not working.allow_for(ledger, exact, [undecided(2e-9)])


@pytest.mark.parametrize("kind", KINDS)
def test_more_than_the_largest_margin_is_allowed_for_where_the_tolerated_gap_pays_for_it(kind: str) -> None:
    working, ledger = begun(kind)
    exact = answer(working, ledger)  # a margin of 1 costs 1, of a cost of 0.5
    working.margin, ledger.tolerance = LARGEST_MARGIN, 1e-4
    assert not working.allow_for(ledger, exact, [undecided(2.1e-5)])
    assert working.allow_for(ledger, exact, [undecided(1.8e-5)])
    assert working.margin == working.floor == working.ceiling == pytest.approx(LARGEST_MARGIN + 1.25 * 1.8e-5)
    tightened = answer(working, ledger)
    assert tightened.solution.x == pytest.approx([0.5 + working.margin], abs=1e-11)
    assert ledger.gap(tightened.solution.x) <= ledger.tolerance


@pytest.mark.parametrize("kind", KINDS)
def test_a_margin_that_left_nothing_is_not_bought_again(kind: str) -> None:
    working, ledger = begun(kind)
    exact = answer(working, ledger)
    assert working.thin()
    ledger.tolerance = 1.0
    assert not working.allow_for(ledger, exact, [undecided(1e-8)])


@pytest.mark.parametrize("kind", KINDS)
def test_a_margin_that_leaves_nothing_becomes_less_until_there_is_none(kind: str) -> None:
    working, _ = begun(kind)
    working.margin, tried = LARGEST_MARGIN, []
    while working.thin():
        tried.append(working.margin)
    assert tried == pytest.approx([1e-9, 1e-12, 1e-15, 0.0], rel=1e-9, abs=0.0)
    assert min(margin for margin in tried if margin) >= SMALLEST_MARGIN * (1.0 - 1e-9)
    assert not working.slater and working.ceiling == 0.0
    assert not working.tighten([(working.program.families[0], violated(1e-7))])


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_violated_is_imposed_once(kind: str) -> None:
    working, ledger = begun(kind)
    found = answer(working, ledger)
    later = np.array([[0.75]])
    assert working.exchange(found, [(AT, np.zeros(1, dtype=int), "above")], 1) == 0
    assert working.exchange(found, [(later, np.zeros(1, dtype=int), "above")], 1) == 1
    assert working.size == 2
    assert answer(working, ledger).solution.x == pytest.approx([0.75], abs=1e-6)
    assert isinstance(found.solution, FiniteSolution)


def test_a_cost_that_falls_far_in_the_last_round_gets_the_margin_that_it_can_pay_for():
    """The first decision costs twenty times as much as the optimum, so that its margin is more than the gap."""
    rows = "s^2*(1 - 3.8*r*(1 - r)) + 2*(1 - s)^2 + s*(1.6*r - 0.6)*(1 - s) >= t"
    family = sr.ConstraintFamily.from_expressions(
        "form", index={"s": (0.0, 1.0), "r": (0.0, 1.0)}, rows=rows, decision={"t": None}
    )
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[-1.0], families=[family]))
    assert result.status == "certified"
    assert abs(result.cost + 0.05) <= 1e-8  # at s = 1 and r = 1/2
