"""Guards sip/working/robust: what a decision of the second objective must meet before it is preferred."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

import sparserob_core as sr
from sparserob_core.sip.finite import Spread, UncertainRows
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.program import Separation
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.working import robust
from sparserob_core.sip.working.ledger import CheckedAnswer, Ledger
from sparserob_core.sip.working.robust import RobustRows
from sparserob_piqp import Piqp

AT = np.array([[0.5]])


def program(q: list[float], among: tuple[sr.SemiInfiniteProgram, int] | None = None) -> sr.SemiInfiniteProgram:
    """``q x`` over ``x_0 >= 0.5`` and ``x_1 >= t`` for t in [0, 1] and all deviations of at most 0."""

    def uncertain(index: np.ndarray) -> UncertainRows:
        row, each = csr_array([[0.0, -1.0]]), np.zeros(1, dtype=int)
        return UncertainRows(row, -index, each, np.ones(1), (csr_array((1, 2)),), np.zeros((1, 1)))

    family = sr.ConstraintFamily(
        name="above",
        index_set=sr.Box([0.0], [1.0]),
        rows=lambda t: (np.tile([0.0, -1.0], (len(t), 1, 1)), -t),
        uncertain=uncertain,
        start=np.zeros((0, 1)),
    )
    spread = Spread(((1, sr.Box([0.0], [0.0])),))
    return sr.SemiInfiniteProgram(n=2, q=q, lower=[0.5, 0.0], upper=9.0, families=[family], spread=spread, among=among)


@pytest.mark.parametrize("rounds", [1, 2])
def test_a_decision_that_violates_a_row_that_is_imposed_is_not_preferred(
    rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The row costs the first objective nothing, the second begins without it, and the search overlooks it."""
    nothing = Separation(AT, np.zeros(1, dtype=int), np.array([-1.0]))
    monkeypatch.setattr(robust, "separate", lambda posed, *_: [(posed.families[0], nothing)])
    monkeypatch.setattr(robust, "CHOOSING", rounds)
    case, tools = program([1.0, 0.0], (program([0.0, 1.0]), 2)), Tools(Piqp())
    ledger = Ledger(case, RelaxedProgram(case, tools.solver), tools, 1e-7)
    working = RobustRows.start(case, ledger, Exchange().close)
    working.impose([(AT, np.zeros(1, dtype=int), "above")])
    answer = working.relax(ledger, lambda x, cells=0: (), False)
    assert isinstance(answer, CheckedAnswer) and case.among is not None
    preferred = working._optimise_second(ledger, answer, *case.among)
    if rounds == 1:
        assert preferred is None
    else:
        assert preferred == pytest.approx([0.5, 0.5 + working.margin], abs=1e-9)
