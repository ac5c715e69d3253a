"""Guards checker/flow/flows: flows over boxes hold those of every parameter in them, larger boxes serve smaller ones
where they are close, and what is said to be 0, or the same at every parameter, is."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from flint import arb, ctx

import sparserob_core as sr
from sparserob_core.checker.flow import flows as several
from sparserob_core.checker.flow.flow import VerifiedFlow
from sparserob_core.checker.flow.flows import VerifiedFlows
from sparserob_core.checker.flow.law import ParameterBox
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.control.problem.system import LinearSystem, VaryingSystem
from sparserob_core.sip.expressions.expression import parse_matrix


@pytest.fixture(autouse=True)
def _precision():
    with ctx.workprec(192):
        yield


def moving(text: str, low: float, high: float, until: float = 3.0) -> VerifiedFlows:
    system = VaryingSystem.of([[text]], [[1]], until, [[1]], parameters=sr.Box([low], [high]), names=["p"])
    return VerifiedFlows(Plant.of(system, until), until, ParameterBox.between([low], [high]))


SYSTEM = ("-0.5 - p*sin(2*t)", -0.3, 0.6)


def decay(t: float, p: float) -> float:
    return float(np.exp(-t / 2 - p * (1 - np.cos(2 * t)) / 2))


def transition(flow, p: float, start: float, stop: float) -> arb:
    (m,), (h,) = flow.box.middle, flow.box.halves
    share = (arb(p) - arb(m)) / arb(h) if h else arb(0)
    return sum((part[0, 0] * share**k for k, part in enumerate(flow.over(start, stop)[0].parts)), arb(0))


@pytest.mark.parametrize(
    ("low", "high"), [(-0.3, 0.6), (0.1, 0.2), (-0.3, -0.3), (0.0, 0.0), (0.59, 0.6), (0.4999, 0.5001)]
)
def test_a_flow_that_holds_a_box_is_right_at_every_parameter_in_it(low: float, high: float) -> None:
    every = moving(*SYSTEM)
    box = ParameterBox.between([low], [high])
    flow = every.holding(box)
    assert flow.box.holds(box) or flow.box == box
    for p in (low, high, (low + high) / 2):
        for start, stop in ((0.0, 3.0), (0.7, 1.9)):
            found = transition(flow, p, start, stop)
            truth = decay(stop, p) / decay(start, p)
            assert abs(float(found.mid()) - truth) <= float(found.rad()) + 1e-14
            assert float(found.rad()) < 1e-9


def test_larger_boxes_serve_smaller_ones_where_they_are_close() -> None:
    every = moving(*SYSTEM)
    small = [ParameterBox.between([low], [low + 0.01]) for low in (-0.25, 0.1, 0.55)]
    assert {every.holding(one) for one in small} == {every.holding(every.box)}


@pytest.mark.slow
def test_boxes_are_halved_where_they_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    small = [ParameterBox.between([low], [low + 0.01]) for low in (-0.25, 0.1, 0.55)]
    monkeypatch.setattr(several, "CLOSE", 1e-25)
    apart = moving(*SYSTEM)
    held = [apart.holding(one) for one in small]
    assert len(set(held)) == 3
    for one, flow in zip(small, held, strict=True):
        assert flow.box.holds(one)
        assert abs(transition(flow, one.middle[0], 0.0, 3.0) - decay(3.0, one.middle[0])) < 1e-14
    # a box across all that is halved has a flow of its own
    across = ParameterBox.between([0.149], [0.151])
    assert apart.holding(across).box.holds(across)


def test_what_goes_away_in_the_middle_of_the_parameters_is_followed_elsewhere() -> None:
    """``p sin(12 t)`` with ``p`` from -0.1 to 0.1: at 0 nothing changes with time."""
    every = moving("-1 + p*sin(12*t)", -0.1, 0.1)
    assert len(every.timing.stretches) > 8
    assert every.marks([0.0, 3.0]) == every.holding(every.box).marks([0.0, 3.0])
    for low, high in ((-0.1, 0.1), (0.05, 0.06), (0.0, 0.0)):
        flow = every.holding(ParameterBox.between([low], [high]))
        for p in (low, high):
            found = transition(flow, p, 0.0, 3.0)
            truth = np.exp(-3.0 + p * (1 - np.cos(36.0)) / 12)
            assert abs(float(found.mid()) - truth) <= float(found.rad()) + 1e-14 and float(found.rad()) < 1e-6


def test_a_parameter_at_which_nothing_changes_with_time_has_a_flow_over_the_stretches_of_all() -> None:
    every = moving("-1 + p*sin(9*t)", 0.0, 0.2)
    flow = every.over(ParameterBox((0.0,), (0.0,)), 4)
    assert abs(transition(flow, 0.0, 0.1, 2.9) - (arb("-2.8")).exp()) < 1e-14
    marks = flow.marks([0.0, 3.0])
    for a, b in pairwise(marks):
        assert abs(flow.step(a, b).parts[0][0, 0] - (arb(a) - arb(b)).exp()) < 1e-14


def test_what_does_not_change_with_time_has_a_flow_for_every_box() -> None:
    A = parse_matrix("A", [["p1"]], ("p1",))
    system = LinearSystem(A, np.ones((1, 1)), parameters=sr.Box([-1.0], [1.0]))
    every = VerifiedFlows(Plant.of(system, 1.0), 1.0, ParameterBox((0.0,), (1.0,)))
    box = ParameterBox((0.5,), (0.25,))
    flow = every.holding(box)
    assert flow.box == box and flow.monomials.degree == every.degree == 8
    assert every.holding(box) is flow and every.over(box, 3) is not flow
    known = VerifiedFlows(Plant.of(LinearSystem(np.eye(1), np.ones((1, 1))), 1.0), 1.0)
    assert known.holding(ParameterBox()) is known.at(()) and known.degree == 0


def test_a_flow_that_is_a_polynomial_in_the_parameters_is_known_to_the_last_digit() -> None:
    box, names = sr.Box([-0.5, 0.5], [0.5, 1.5]), ["p", "q"]
    for A, B, degree in (
        ([[0, "t"], [0, 0]], [["p"], ["q"]], 1),  # only inputs depend on parameters
        ([[0, "t*p"], [0, 0]], [[0], ["q^2"]], 3),  # a chain of two states: p times q^2
        ([[0, "t"], ["p", 0]], [[0], [1]], 5),  # a circle: no polynomial
        ([[0, "t"], [-1, 0]], [["exp(p)"], ["q"]], 5),
        ([[0, "t"], [-1, 0]], [[1], [0]], 1),  # nothing depends on them
    ):  # fmt: skip
        system = VaryingSystem.of(A, B, 2.0, [[1, 0], [0, 1]], parameters=box, names=names)
        every = VerifiedFlows(Plant.of(system, 2.0), 2.0, ParameterBox.between([-0.5, 0.5], [0.5, 1.5]))
        limit = every.over(every.box, 5)
        for point in ([-0.5, 0.5], [0.25, 1.375]):
            s = [(arb(x) - m) / h for x, m, h in zip(point, every.box.middle, every.box.halves, strict=True)]
            known = VerifiedFlow(every.plant, 2.0).at(point).over(0.0, 2.0)
            for mine, wide, other in zip(every.at(point).over(0.0, 2.0), limit.over(0.0, 2.0), known, strict=True):
                powers = [s[0] ** m * s[1] ** n for m, n in wide.monomials.exponents]
                total = sum((part * power for part, power in zip(wide.parts, powers, strict=True)), wide.parts[0] * 0)
                for a, b, c in zip(mine.matrix.entries(), total.entries(), other.matrix.entries(), strict=True):
                    assert a.overlaps(c) and b.overlaps(c)
                    assert float(a.rad()) < 1e-25 and float(b.rad()) < (1e-15 if degree < 5 else 0.1)


def test_the_parameter_that_matters_most_is_halved() -> None:
    system = VaryingSystem.of(
        [["-p*(1 + sin(t)) - 0.001*q"]], [[1]], 2.0, [[1]], parameters=sr.Box([0.0, 0.0], [1.0, 9.0]), names=["p", "q"]
    )
    every = VerifiedFlows(Plant.of(system, 2.0), 2.0, ParameterBox.between([0.0, 0.0], [1.0, 9.0]))
    assert every._choose_axis(every.box) == 0
    assert every._choose_axis(ParameterBox((0.5, 4.5), (1e-6, 4.5))) == 1


def test_no_more_flows_are_remembered_than_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(several, "KEPT", 3)
    every = moving(*SYSTEM)
    for k in range(6):
        every.over(ParameterBox((0.1 * k,), (0.01,)), 2)
    assert len(every.__dict__["_over_remembered"]) == 3


def test_entries_that_are_ever_other_than_0_or_depend_on_parameters_are_links() -> None:
    # sin(16 pi t / 3) is 0 at 17 times that are evenly spaced; p^2 has no linear part
    system = VaryingSystem.of(
        [["0*t", "sin(16.755160819145562*t)"], [0, "p^2"]], [[0, "q - q"], ["t", 2]], 3.0, [[0], ["p*t - t*p"]],
        parameters=sr.Box([-0.5, -0.5], [0.5, 0.5]), names=["p", "q"], c=["q*sin(t)", 0],
    )  # fmt: skip
    there, moved = VerifiedFlows(Plant.of(system, 3.0), 3.0, ParameterBox((0.0, 0.0), (0.5, 0.5))).links
    assert there.astype(int).tolist()[0] == [0, 1, 0, 0, 1, 0]
    assert there.astype(int).tolist()[1][:5] == [0, 1, 1, 1, 0]
    assert moved.astype(int).tolist()[0] == [0, 0, 0, 0, 1, 0]
    assert moved.astype(int).tolist()[1][:5] == [0, 1, 0, 0, 0]


def test_at_one_parameter_or_none_nothing_depends_on_it() -> None:
    system = VaryingSystem.of([["-t", "sin(3*t)"], [0, 0]], [[0], [1]], 2.0)
    there, moved = VerifiedFlows(Plant.of(system, 2.0), 2.0).links
    assert there.astype(int).tolist()[0][:3] == [1, 1, 0] and not moved.any()
    A = parse_matrix("A", [["p1**3", "1"], ["0", "exp(p1)"]], ("p1",))
    still = LinearSystem(A, np.array([[0.0], [1.0]]), parameters=sr.Box([-1.0], [1.0]))
    there, moved = VerifiedFlows(Plant.of(still, 1.0), 1.0, ParameterBox((0.0,), (1.0,))).links
    assert there[:, :2].astype(int).tolist() == [[1, 1], [0, 1]] and moved[:, :2].astype(int).tolist() == [
        [1, 0],
        [0, 1],
    ]
