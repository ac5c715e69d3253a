"""Guards checker/claims of plans that repeat: for ever is claimed where every constraint of a period holds, and every
final state is one of the initial states, inside their set by more than counts as none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.claims import claims, multipliers
from sparserob_core.checker.claims.answers import NamedDeviations, feedback_of
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.claims import ASIDE
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.sets.sets import Box

HOLDS = {"control": "holds", "path": "holds"}


@pytest.fixture(autouse=True)
def precision() -> Any:
    with ctx.workprec(96):
        yield


def case_of(certificate: dict[str, Any] | None = None, delay: float = 0.0, **more: Any) -> Case:
    """``x' = u``, or what decays; from 1 and back."""
    problem = sr.OptimalControlProblem(
        **{
            "system": LinearSystem(np.zeros((1, 1)), np.ones((1, 1))),
            "horizon": 2.0,
            "initial_state": [1.0],
            "control": Box([-1.0], [1.0]),
            "repeat": True,
            **more,
        }
    )
    if delay:
        object.__setattr__(problem, "system", problem.system.with_delay(delay))
    grid = sr.Dictionary.indicators([0.0, 1.0, 2.0])
    return Case(problem, grid, grid, {"decision": [[-0.5, 0.5]], "repeat": True, **(certificate or {})})


def begun(width: float) -> dict[str, Any]:
    return {"system": LinearSystem([[-1.0]], [[1.0]]), "initial_set": Box([-width], [width])}


def test_what_holds_in_one_period_holds_for_ever() -> None:
    assert "every period" in claims._verify_repeat(case_of(), HOLDS)
    assert "every period" in claims._verify_repeat(case_of(**begun(0.25)), HOLDS)
    for name in (*ASIDE, "cost", "lower bound"):
        assert claims._verify_repeat(case_of(), {**HOLDS, name: "fails"})
    for name in ("path", "control", "return"):
        for verdict, kind in (("fails", Broken), ("not checked", Unchecked)):
            with pytest.raises(kind, match=name):
                claims._verify_repeat(case_of(), {**HOLDS, name: verdict})


def test_a_plan_that_does_not_repeat_is_none_for_ever() -> None:
    for said in (None, 1, "true", False):
        with pytest.raises(Broken):
            claims._verify_repeat(case_of({"repeat": said}), HOLDS)
    with pytest.raises(Broken):
        claims._verify_repeat(case_of(repeat=False), HOLDS)
    with pytest.raises(Broken, match="delay"):
        claims._verify_repeat(case_of(delay=0.25), HOLDS)
    elsewhere = case_of()
    object.__setattr__(elsewhere.problem, "initial_state", np.array([1.0 + 1e-12]))
    with pytest.raises(Broken, match="does not end there"):
        claims._verify_repeat(elsewhere, HOLDS)


def test_what_counts_as_no_violation_of_the_return_is_still_an_initial_state() -> None:
    case = case_of(**begun(0.25))
    (window,) = case.returned
    assert (window.start, window.stop) == (2.0, 2.0)
    assert 0.25 * (1.0 - 1e-6) < float(window.shape.upper[0]) < 0.25
    claims._require_strict_return(case, window)
    for width in (0.25, 0.25 * (1.0 + 1e-9), 0.5):
        with pytest.raises(Unchecked, match="too thin"):
            claims._require_strict_return(case, replace(window, shape=Box([-width], [width])))
    with pytest.raises(Unchecked, match="not told apart"):
        claims._require_strict_return(case, replace(window, shape=Box([-np.inf], [0.2])))
    # beside numbers that are much larger what counts as none is more than the set
    with pytest.raises(Unchecked, match="too thin"):
        thin = case_of(**{**begun(1e-7), "initial_state": [1e9], "control": Box([-1e9], [1e9])})
        claims._require_strict_return(thin, *thin.returned)


def test_the_next_periods_deviation_is_one_of_the_initial_states() -> None:
    case = replace(case_of(**begun(0.25)), policy=sr.AffinePolicy())
    answers = feedback_of(case)
    now = NamedDeviations(case, answers.loop_at_rest, [[arb(0.1)]])
    ((inside,),) = answers.following(now, {"following": [0.2]}, "return").z
    assert float(inside.mid()) == pytest.approx(0.2)
    for wrong in ([0.25 + 1e-15], [-0.3], [0.1, 0.1], [], None, "0.1"):
        with pytest.raises(Broken, match=r"following|deviation"):
            answers.following(now, {"following": wrong}, "return")
    alone = feedback_of(replace(case_of(), policy=sr.AffinePolicy()))
    assert alone.following(NamedDeviations(alone.case, alone.loop_at_rest, []), {}, "return").z == []


def test_a_step_across_the_seam_is_the_first_control_of_the_next_period_less_the_last_one() -> None:
    """``u_0 + M e`` of the next deviation, less ``u_1``; an open loop sees no deviations."""
    gains = np.zeros((2, 2, 1, 1))
    gains[0, 0] = -0.5
    given = {**begun(0.25), "control_step": Box([-0.4], [0.7])}
    case = replace(case_of({"gains": gains.tolist()}, **given), policy=sr.AffinePolicy())
    said = {"constraint": "control_step", "time": 2.0, "direction": [1.0], "parameter": [], "multiplier": 2.0}
    entry = {**said, "deviation": [0.1], "following": [-0.2]}
    last, first = multipliers.rows_of(case, entry)
    assert (last[0], first[0]) == (2.0, 2.0)
    for (_, row), piece, sign in ((last, 1, -1.0), (first, 0, 1.0)):
        slopes = [[float(x.mid()) for x in one] for one in row.slope]
        assert slopes == [[sign if k == piece else 0.0] for k in (0, 1)]
    assert float(last[1].constant.mid()) == pytest.approx(-0.7) and float(first[1].constant.mid()) == 0.0
    inside = multipliers.rows_of(case, {**entry, "time": 1.0})
    ((_, row),) = inside
    assert [[float(x.mid()) for x in one] for one in row.slope] == [[-1.0], [1.0]]
    alone = case_of(control_step=Box([-0.4], [0.7]))
    ((_, row),) = multipliers.rows_of(alone, said)
    assert [[float(x.mid()) for x in one] for one in row.slope] == [[1.0], [-1.0]]
    for wrong in ({**entry, "time": 0.5}, {**entry, "following": [0.3]}):
        with pytest.raises(Broken):
            multipliers.rows_of(case, wrong)
