"""Guards checker/claims: what is not known, or no part of the problem, is refused where it stands and by its own
sentence, whatever would refuse it later."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import ctx

import sparserob_core as sr
from sparserob_core.checker.claims import causal as causal_bounds
from sparserob_core.checker.claims import claims, multipliers, replay
from sparserob_core.checker.claims.answers import feedback_of
from sparserob_core.checker.claims.case import number
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.control.policies.affine import AffinePolicy
from sparserob_core.control.sets.sets import Box, NormBall
from tests.checker.claims.test_windows import case_of, causal

# two pieces of the control with one function, which is not the indicator of both
FEWER = sr.Dictionary(np.array([0.0, 1.0, 2.0]), np.array([[1.0, -1.0]]))
FINE = sr.Dictionary.indicators([0.0, 0.5, 1.0, 2.0])
PLANE = {
    "system": sr.LinearSystem(np.zeros((1, 1)), np.ones((1, 2)), E=np.ones((1, 1))),
    "control": NormBall(2.0, 1.0, dimension=2), "decision": ((0.3, 0.0), (0.4, 0.0)), "cost": sr.Cost(group="all"),
    "disturbance": None, "terminal": [Box([-9.0], [0.2])],
}  # fmt: skip
ROW = {"constraint": "terminal", "time": 2.0, "direction": [1.0], "parameter": [], "multiplier": 1.0}


def multiplied(**more: Any) -> Callable[[], object]:
    said = {"constraints": [ROW], "equalities": [], "pieces": None, "tangent": [[0.3, 0.0], [0.4, 0.0]], **more}
    return lambda: multipliers.multiplied(case_of(certificate={"multipliers": said}, **PLANE), priced=True)


def causally(**change: Any) -> Callable[[], object]:
    def asked() -> object:
        case, _ = causal()
        return causal_bounds.causal_bound(case, {**case.certificate["causal"], **change}, True)

    return asked


def moved(case: Any, **change: Any) -> Any:
    return replace(case, **change)


REFUSED: dict[str, tuple[Callable[[], object], type[Exception], str]] = {
    "fewer functions": (
        lambda: moved(case_of(), disturbance=FEWER).disturbances.changes,
        Unchecked,
        "fewer functions than pieces",
    ),
    "answers to what is pushed at any time": (
        lambda: (
            feedback_of(
                case_of(
                    policy=AffinePolicy(),
                    disturbance_class="measurable",
                    certificate={"gains": np.zeros((2, 2, 1, 1)).tolist()},
                )
            ).loop
        ),
        Unchecked,
        "feedback under disturbances on the pieces of one dictionary",
    ),
    "a decision of another shape": (lambda: case_of(decision=((0.5,),)).theta, Broken, r"shape \(1, 1\), expected \(1"),
    "numbers for one": (lambda: number({"time": [1.0, 2.0]}, "time"), Broken, "time: expected a number"),
    "no number at all": (lambda: number({}, "time"), Broken, "time: expected numbers"),
    "a truth value": (lambda: number({"time": True}, "time"), Broken, "time: expected numbers"),
    "no step": (
        lambda: case_of(control_step=Box([-1.0], [1.0])).duality.step_row(np.ones(1), 0.5),
        Broken,
        "there is no step at t = 0.5",
    ),
    "no step at the beginning": (
        lambda: case_of(control_step=Box([-1.0], [1.0])).duality.step_row(np.ones(1), 0.0),
        Broken,
        "no step at t = 0.0",
    ),
    "multipliers that are no mapping": (lambda: multipliers.weighted(case_of(), []), Broken, "expected those of"),
    "an equality that is none": (multiplied(equalities=[1.0]), Broken, "1 multipliers of equalities, expected 0"),
    "vectors of another shape": (multiplied(norms=[[0.1, 0.2]]), Broken, r"shape \(1, 2\), expected \(2, 2\)"),
    "vectors that are no numbers": (multiplied(norms="none"), Broken, "norms: expected numbers"),
    "a tangent of another shape": (multiplied(tangent=[[0.3], [0.4]]), Broken, r"shape \(2, 1\), expected \(2, 2\)"),
    "pieces of another shape": (
        lambda: multipliers.weighted(
            moved(case_of(), control=FEWER), {"constraints": [], "equalities": [], "pieces": [[1.0]]}
        ),
        Broken,
        r"pieces: shape \(1, 1\), expected \(1, 2\)",
    ),
    "no tree of all pieces": (
        lambda: claims._bound_by_tree(moved(case_of(certificate={"tree": {"nodes": []}}), control=FEWER)),
        Unchecked,
        "fewer functions than pieces",
    ),
    "a causal entry that is text": (causally(multipliers=["terminal"]), Broken, "expected a signal, a constraint"),
    "causal policies in fewer functions": (
        lambda: causal_bounds.causal_bound(moved(causal()[0], control=FEWER), causal()[0].certificate["causal"], True),
        Unchecked,
        "in indicators",
    ),
    "a causal claim that is none": (
        lambda: claims._verify_causal_bound(moved(causal()[0], certificate={"causal": [1.0]})),
        Broken,
        "expected lower_bound, signals and multipliers",
    ),
    "a disturbance that jumps within a piece": (
        lambda: replay._read_disturbance(
            moved(case_of(), control=FINE, disturbance=sr.Dictionary.indicators([0.0, 1.0, 2.0])), [[0.1, 0.2, 0.2]]
        ),
        Broken,
        "jumps within a piece, at t = 0.5",
    ),
    "a disturbance on another grid": (
        lambda: replay._read_disturbance(case_of(), [[0.1]]),
        Unchecked,
        "on another grid",
    ),
    "a deviation of another size": (
        lambda: replay._read_deviations(case_of(initial_set=Box([-0.1], [0.1])), {"deviation": [0.0, 0.0]}),
        Broken,
        r"deviation: shape \(2,\), expected \(1,\)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_known_or_no_part_of_the_problem_is_refused_by_its_own_sentence(name: str) -> None:
    asked, kind, text = REFUSED[name]
    with ctx.workprec(96), pytest.raises(kind, match=text):
        asked()


@pytest.mark.parametrize("where", ["multipliers", "causal"])
def test_as_many_multipliers_as_are_read_and_no_more(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module, name = (multipliers, "MAX_MULTIPLIERS") if where == "multipliers" else (causal_bounds, "MAX_MULTIPLIERS")
    asked = multiplied() if where == "multipliers" else causally()
    with ctx.workprec(96):
        monkeypatch.setattr(module, name, 1)
        asked()
        monkeypatch.setattr(module, name, 0)
        with pytest.raises(Broken, match="1 multipliers are too many"):
            asked()


def test_what_overflows_or_divides_by_a_ball_around_nothing_is_not_checked() -> None:
    for derive, text in (
        (lambda: str(np.float64(1e200) * np.float64(1e200)), "too large or too small"),
        (lambda: str(np.float64(1.0) / np.float64(0.0)), "too large or too small"),
        (lambda: str(1 / 0), "divisor"),
    ):
        found = claims.judged("it", derive)
        assert (found.name, found.verdict) == ("it", "not checked") and text in found.text


def test_causal_policies_begin_in_the_middle_of_the_initial_states() -> None:
    """One of them is 0.05 farther from where the state has to be than the initial state itself."""
    with ctx.workprec(96):
        case, plain = causal(signals=((0.0, 0.25),))
        begun = moved(case, problem=replace(case.problem, initial_set=Box([-0.05], [0.15])))
        said = case.certificate["causal"]
        assert float(causal_bounds.causal_bound(begun, said, True).mid()) == pytest.approx(plain + 0.05)
