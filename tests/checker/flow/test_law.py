"""Guards checker/flow/law and checker/flow/plant: polynomials hold the numbers of a system at every time and parameter,
and are narrow; what changes with time is not taken for what does not, and poles are refused."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from flint import arb, arb_mat, arb_poly, ctx

import sparserob_core as sr
from sparserob_core.checker.arithmetic.models import Frame
from sparserob_core.checker.arithmetic.monomials import NONE
from sparserob_core.checker.arithmetic.series import Series
from sparserob_core.checker.flow import law as laws
from sparserob_core.checker.flow.law import LONG, Law, ParameterBox, Stretch
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, VaryingSystem
from sparserob_core.sip.expressions.expression import parse_matrix

RNG = np.random.default_rng(3)
ENTRIES = [
    "exp(-p*t)", "1/(1+p)", "sin(p*t)*cos(p)", "sqrt(1+p*cos(t))", "log(2+p*t)", "tan(p*t/4)", "tanh(p+t)",
    "(1+p)^1.5", "p^9*t", "exp(sin(p*t))/(2+p^2)", "(2+p)^(-2)", "(1+t)^p", "kepler(t+p+p^2, 0.3)", "p + 0*t", "t^3",
]  # fmt: skip


@pytest.fixture(autouse=True)
def _precision():
    with ctx.workprec(192):
        yield


def at(one: Series, point) -> arb_mat:
    own = np.asarray(point, dtype=float)[: one.monomials.count]
    powers = [np.prod(own ** np.array(e, dtype=int)) for e in one.monomials.exponents]
    return sum((part * arb(float(p)) for part, p in zip(one.parts, powers, strict=True)), one.parts[0] * 0)


def seen(law: Law, stretch: Stretch, start: float, stop: float, share: float, point, backwards: bool = False) -> list:
    """``[A B c E]`` as `Stretch.between` has it, per unit of time."""
    A, F = stretch.between(start, stop, backwards)
    whole = [sum((at(one, point) * arb(share) ** n for n, one in enumerate(every[1:], 1)), at(every[0], point))
             for every in (A, F)]  # fmt: skip
    length = arb(stop) - arb(start)
    return [[x / length for x in (*a, *f)] for a, f in zip(whole[0].tolist(), whole[1].tolist(), strict=True)]


def holds(law: Law, points, function, near: float) -> None:
    """Every stretch, from anywhere in it, forwards and backwards, holds what a function says, and little else."""
    middle, halves = np.array(law.box.middle), np.array(law.box.halves)
    assert [one.stop for one in law.stretches[:-1]] == [one.start for one in law.stretches[1:]]
    assert (law.stretches[0].start, law.stretches[-1].stop) == (0.0, law.until)
    for stretch in law.stretches[:: max(1, len(law.stretches) // 2)]:
        low, high = stretch.start, stretch.stop
        for start, stop in ((low, high), (low + 0.3 * (high - low), low + 0.7 * (high - low))):
            for share in (0.37, 1.0):
                for point in points:
                    p = middle + halves * np.array(point)
                    for backwards in (False, True):
                        time = stop - share * (stop - start) if backwards else start + share * (stop - start)
                        truth = np.asarray(function(time, p), dtype=float)
                        found = seen(law, stretch, start, stop, share, point, backwards)
                        for row, values in zip(found, truth, strict=True):
                            for ball, value in zip(row, values, strict=True):
                                off = abs(float(ball.mid()) - value)
                                assert off <= float(ball.rad()) + 1e-13 * (1.0 + abs(value)), (start, stop, time, p)
                                assert float(ball.rad()) <= near


@pytest.mark.parametrize("text", ENTRIES)
def test_numbers_at_every_time_are_in_narrow_balls_where_parameters_are_known(text: str) -> None:
    system = VaryingSystem.of([[text]], [["1"]], 2.0, [[1]], parameters=sr.Box([-0.3], [0.4]), names=["p"])
    entry = system.phases[0].entry("A")
    law = Law(Plant.of(system, 2.0), 2.0, ParameterBox((0.15,), (0.0,)))
    holds(law, [()], lambda t, p: [[float(entry(np.array([t, 0.15], dtype=object))[0, 0]), 1.0, 1.0]], 1e-25)


@pytest.mark.parametrize("degree", [1, 5])
@pytest.mark.parametrize("text", ENTRIES)
def test_numbers_at_every_time_and_parameter_are_in_balls_that_narrow_with_the_degree(text: str, degree: int) -> None:
    system = VaryingSystem.of([[text]], [["1"]], 2.0, [[1]], parameters=sr.Box([-0.3], [0.4]), names=["p"])
    entry = system.phases[0].entry("A")
    law = Law(Plant.of(system, 2.0), 2.0, ParameterBox.between([-0.1], [0.2]), degree)
    points = [(-1.0,), (1.0,)]
    near = 1.0 if degree == 1 else 0.1
    holds(law, points, lambda t, p: [[float(entry(np.array([t, p[0]], dtype=object))[0, 0]), 1.0, 1.0]], near)


def test_phases_hold_their_own_laws_with_drifts_and_disturbances() -> None:
    names, box = ("p1", "p2"), sr.Box([-0.2, 0.0], [0.2, 1.0])
    A, c = (parse_matrix(name, rows, names) for name, rows in (
        ("A", [["p1", "1"], ["-2", "p2**2"]]), ("c", [["p1*p2"], ["1"]])))  # fmt: skip
    first = LinearSystem(A, np.array([[0.0], [1.0]]), np.array([[1.0], [0.5]]), box, names, c)
    other, drift = parse_matrix("A", [["0", "exp(p1)"], ["1", "0"]], names), np.array([[4.0], [0.0]])
    second = LinearSystem(other, np.array([[2.0], [0.0]]), np.array([[0.0], [3.0]]), box, names, drift)
    plant = Plant.of(SwitchedSystem([(0.75, first), (2.0, second)]), 2.0)
    assert (plant.states, plant.driven, len(plant.phases)) == (2, 2, 2)
    law = Law(plant, 2.0, ParameterBox.between([-0.1, 0.2], [0.1, 0.3]), 6)

    def truth(number, p):
        if not number:
            return [[p[0], 1, 0, p[0] * p[1], 1], [-2, p[1] ** 2, 1, 1, 0.5]]
        return [[0, np.exp(p[0]), 2, 4, 0], [1, 0, 0, 0, 3]]

    assert [(one.start, one.stop) for one in law.stretches] == [(0.0, 0.75), (0.75, 2.0)]
    assert all(one.is_still for one in law.stretches)
    for number, stretch in enumerate(law.stretches):
        for point in [(1.0, -1.0), (-1.0, 1.0), (0.2, 0.3)]:
            p = np.array(law.box.middle) + np.array(law.box.halves) * np.array(point)
            found = seen(law, stretch, stretch.start, stretch.stop, 0.5, point)
            for row, values in zip(found, truth(number, p), strict=True):
                for ball, value in zip(row, values, strict=True):
                    assert abs(float(ball.mid()) - value) <= float(ball.rad()) + 1e-15
                    assert float(ball.rad()) < 1e-9


def test_laws_in_turns_that_change_with_time_begin_and_end_where_they_do() -> None:
    system = VaryingSystem.taking_turns(
        [(0.7, ([["t"]], [[1]], None, None)), (2.0, ([["-1/(1 + t)"]], [[0]], None, None))]
    )
    law = Law(Plant.of(system, 2.0), 2.0, ParameterBox())
    assert 0.7 in [one.stop for one in law.stretches]
    for stretch in law.stretches:
        middle = (stretch.start + stretch.stop) / 2
        ((A, B, *_),) = seen(law, stretch, stretch.start, stretch.stop, 0.5, ())
        assert abs(float(A) - (middle if middle < 0.7 else -1 / (1 + middle))) < 1e-15
        assert (middle < 0.7) == B
    shorter = Law(Plant.of(system, 2.0), 0.5, ParameterBox())
    assert shorter.stretches[-1].stop == 0.5 and all(one.start < 0.7 for one in shorter.stretches)


@pytest.mark.parametrize(
    ("rows", "still"),
    [
        ([["1 + 0*t", "t - t"], ["-2", "sqrt(2)"]], True),
        ([["1/3", "exp(1)"], ["sin(pi)", "0"]], True),
        ([["1/(4 - t)", "0"], ["0", "0"]], False),
        ([["exp(-40*t)", "0"], ["0", "0"]], False),
        ([["0", "0"], ["sin(9*t)", "0"]], False),
        ([["t*1e-200", "0"], ["0", "1"]], False),
    ],
)
def test_what_changes_with_time_is_not_taken_for_what_does_not(rows, still: bool) -> None:
    """Not even where a number so wide that it holds all of that were allowed."""
    system = VaryingSystem.of(rows, [[1], [0]], 3.0)
    law = Law(Plant.of(system, 3.0), 3.0, ParameterBox())
    assert [one.is_still for one in law.stretches] == [True] if still else len(law.stretches) > 1
    entering = VaryingSystem.of([[0, 1], [0, 0]], [row[:1] for row in rows], 3.0)
    pushed = Law(Plant.of(entering, 3.0), 3.0, ParameterBox())
    assert len(pushed.stretches) == 1 if still else len(pushed.stretches) > 1
    for one in (*law.stretches, *pushed.stretches):
        radii = [float(c.rad()) for row in one.table[0] for entry in row for c in entry.coeffs()]
        assert max(radii) < 1e-25


def test_strides_of_what_does_not_change_are_powers_of_two_that_move_states_by_little() -> None:
    for rate, longest in ((0.0, 4.0), (1e-3, 4.0), (3.0, 0.5), (1e5, 2.0**-16)):
        (one,) = Law(Plant.of(LinearSystem(np.array([[-rate]]), np.ones((1, 1))), 2.5), 2.5, ParameterBox()).stretches
        assert one.is_still and one.stride == longest
        assert one.stride >= 2.5 or rate * one.stride <= LONG < 2 * rate * one.stride


def test_stretches_of_what_changes_move_states_by_little_each() -> None:
    system = VaryingSystem.of([[0, 1], ["-(400 + 100*sin(20*t))", "-0.1"]], [[0], [1]], 3.0)
    law = Law(Plant.of(system, 3.0), 3.0, ParameterBox())
    for one in law.stretches:
        most, slope = one.sizes
        A = most[:, :2] * one.units / one.units[:, None] * (one.stop - one.start)
        assert A.sum(axis=1).max() <= LONG * (1 + 1e-9)
        times = np.linspace(one.start, one.stop, 9)
        assert most[1, 0] >= np.abs(400 + 100 * np.sin(20 * times)).max() * (1 - 1e-14)
        assert slope[1, 0] >= np.abs(2000 * np.cos(20 * times)).max() * (1 - 1e-14)
        assert most[1, 0] <= 530 and slope[1, 0] <= 5000 and not slope[0].any()


@pytest.mark.parametrize(
    ("rows", "where"),
    [
        ([["1/(0.9871 - t)"]], "0.987"), ([["sqrt(t^2 - 2*t*0.9871 + 0.9871^2 - 1e-9)"]], "0.987"),
        ([["tan(t)"]], "1.570"), pytest.param([["1/(t - 1.9271)^2"]], "1.927", marks=pytest.mark.slow),
        ([["t^0.5"]], "0 "),
    ],
)  # fmt: skip
def test_a_pole_is_refused_with_its_time(rows, where: str) -> None:
    system = VaryingSystem.of(rows, [[1]], 2.0)
    with pytest.raises(Unchecked, match=f"near t = {where}.*not enclosed"):
        _ = Law(Plant.of(system, 2.0), 2.0, ParameterBox()).stretches


@pytest.mark.parametrize("text", ["1 / p1", "log(p1)", "sqrt(p1)", "tan(p1 + pi/2)", "p1**-1"])
def test_a_pole_in_the_box_of_parameters_is_refused(text: str) -> None:
    system = LinearSystem(parse_matrix("A", [[text]], ("p1",)), np.ones((1, 1)), parameters=sr.Box([0.6], [0.8]))
    fine = Law(Plant.of(system, 1.0), 1.0, ParameterBox.between([0.6], [0.8]), 4)
    assert len(fine.stretches) == 1
    with pytest.raises(Unchecked):
        _ = Law(Plant.of(system, 1.0), 1.0, ParameterBox.between([-0.1], [0.3]), 4).stretches


def test_an_entry_that_is_no_arithmetic_is_left_unchecked() -> None:
    system = LinearSystem(lambda p: np.array([[p[0] * 1.0]]), np.ones((1, 1)), parameters=sr.Box([0.6], [0.8]))
    object.__setattr__(system.phases[0], "A", lambda p: np.array([[float(p[0])]]))
    with pytest.raises(Unchecked):
        _ = Law(Plant.of(system, 1.0), 1.0, ParameterBox((0.7,), (0.1,)), 2).stretches


def test_stretches_of_boxes_are_those_of_a_timing() -> None:
    system = VaryingSystem.of(
        [["-p*(1 + sin(3*t))"]], [["1/(4 - t)"]], 3.0, [[1]], parameters=sr.Box([0.0], [30.0]), names=["p"]
    )
    plant = Plant.of(system, 3.0)
    timing = Law(plant, 3.0, ParameterBox((15.0,), (0.0,)))
    law = Law(plant, 3.0, ParameterBox((28.0,), (2.0,)), 3, timing)
    assert [(one.start, one.stop) for one in law.stretches] == [(one.start, one.stop) for one in timing.stretches]
    holds(law, [(-1.0,), (1.0,)], lambda t, p: [[-p[0] * (1 + np.sin(3 * t)), 1 / (4 - t), 1]], 1e-12)
    own = Law(plant, 3.0, ParameterBox((28.0,), (2.0,)), 3)
    assert len(own.stretches) > len(law.stretches)


def test_boxes_hold_their_corners_whatever_is_rounded() -> None:
    for low, high in RNG.uniform(-1.0, 1.0, (200, 2)):
        low, high = min(low, high), max(low, high)
        box = ParameterBox.between([low, 0.3], [high, 0.3])
        with ctx.workprec(200):
            ends = [arb(box.middle[0]) + sign * arb(box.halves[0]) for sign in (-1, 1)]
            assert ends[0] <= low and high <= ends[1] and box.halves[1] == 0.0
            assert ends[1] - ends[0] <= arb(high - low) * (1 + 1e-14) + 1e-15
            left, right = box.halved(0)
            assert arb(left.middle[0]) - arb(left.halves[0]) <= ends[0]
            assert arb(right.middle[0]) + arb(right.halves[0]) >= ends[1]
            assert arb(left.middle[0]) + arb(left.halves[0]) >= arb(right.middle[0]) - arb(right.halves[0])
    wide = box.wider([0.5, 0.0])
    assert wide.halves[0] >= box.halves[0] + 0.5 and wide.halves[1] == 0.0 and box.wider([0.0, 0.0]) is box


def test_a_box_holds_another_exactly() -> None:
    whole = ParameterBox((0.1,), (0.2,))
    assert whole.holds(whole) and whole.holds(ParameterBox((0.1,), (0.0,)))
    up = float(np.nextafter(0.2, 1.0))
    assert not whole.holds(ParameterBox((0.1,), (up,))) and not whole.holds(
        ParameterBox((float(np.nextafter(0.1, 1.0)),), (0.2,))
    )
    assert whole.holds(ParameterBox((0.1 + 2.0**-56,), (0.2 - 2.0**-54,)))
    assert not ParameterBox((0.0, 0.0), (1.0, 1.0)).holds(ParameterBox((0.0, 0.5), (1.0, 0.75)))


def test_powers_of_the_time_that_are_left_out_are_in_the_balls_of_the_first() -> None:
    A = [Series.known(arb_mat([[x]])) for x in (arb(1), arb(0.5), arb(2.0**-60), arb(2.0**-105), arb(-(2.0**-106)))]
    kept = laws._truncate_powers(A, np.ones(1))
    assert len(kept) == 3 and kept[1:] == A[1:3]
    assert 2.0**-105 * 1.5 <= float(kept[0].matrix[0, 0].rad()) <= 2.0**-105 * 1.6
    assert laws._truncate_powers(A[:3], np.ones(1)) == A[:3]


def test_units_are_not_those_of_times_at_which_a_wave_is_0() -> None:
    system = VaryingSystem.of([[0, "sin(2*pi*t)"], [0, "-0.04"]], [[0], [1]], 8.0)
    assert len(Law(Plant.of(system, 8.0), 8.0, ParameterBox()).stretches) < 200


def test_a_plant_is_looked_at_where_it_is_finite() -> None:
    system = VaryingSystem.of([["1/(0.03125 + t)"]], [["1"]], 2.0)
    looks = [one[0, 0] for one in Plant.of(system, 2.0).looked_at([])]
    assert len(looks) == 17 and looks[0] == 32.0 and all(a > b > 0.0 for a, b in pairwise(looks))


def test_an_entry_that_underflows_is_there_and_has_a_size() -> None:
    A = parse_matrix("A", [["0", "p1*1e-200*1e-200"], ["0", "0"]], ("p1",))
    system = LinearSystem(A, np.array([[0.0], [1.0]]), parameters=sr.Box([1], [2]))
    law = Law(Plant.of(system, 1.0), 1.0, ParameterBox((1.5,), (0.5,)), 1)
    assert law.there[0, 1] and not law.there[1, 0]
    assert 0.0 < law.stretches[0].sizes[0][0, 1] < 1e-299


def test_a_plant_that_is_finite_at_no_time_that_is_looked_at_has_units(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Plant, "looked_at", lambda plant, parameter: iter(()))
    law = Law(Plant.of(VaryingSystem.of([["t"]], [[1]], 2.0), 2.0), 2.0, ParameterBox())
    assert law.units.tolist() == [1.0] and law.stretches[-1].stop == 2.0


def test_the_size_of_a_law_counts_the_rounding_of_the_sum_of_its_coefficients() -> None:
    """Coefficients that floats add up to less than they are."""
    coefficients = [1.0, *[2.0**-54] * 20]
    stretch = Stretch(0.0, 2.0, Frame(NONE, 20), [[[arb_poly(coefficients)]]], np.ones(1))
    exact = sum(map(Fraction, coefficients)), sum(n * Fraction(c) for n, c in enumerate(coefficients))
    for size, truth in zip(stretch.sizes, exact, strict=True):
        assert truth <= Fraction(size.item()) <= truth * (1 + Fraction(1, 10**11))


def test_a_box_holds_what_lies_in_it_to_the_last_digit_and_nothing_on_either_side() -> None:
    box = ParameterBox((1.0, -2.0), (0.5, 0.25))
    assert box.holds(box)
    for axis, half in enumerate(box.halves):
        for sign in (-1.0, 1.0):
            for share, expected in ((0.5, True), (0.75, False), (3.0, False)):
                middle, halves = list(box.middle), list(box.halves)
                middle[axis] += sign * share * half
                halves[axis] = half / 2
                assert box.holds(ParameterBox(tuple(middle), tuple(halves))) is expected, (axis, sign, share)
    assert not box.holds(ParameterBox(box.middle, (np.nextafter(0.5, 1.0), 0.25)))
    assert not box.holds(ParameterBox((1.0 + 2.0**-52, -2.0), box.halves))
    assert not ParameterBox((0.0,), (0.5,)).holds(ParameterBox((2.0**-54,), (0.5,)))  # the sum of the floats is 0.5


def test_a_wider_box_holds_all_that_was_asked_for_and_a_box_between_corners_holds_both() -> None:
    draws = np.random.default_rng(5).uniform(0.01, 1.0, (50, 2))
    for half, extra in draws:
        (wide,) = ParameterBox((0.3,), (half,)).wider([extra]).halves
        exact = Fraction(half) + Fraction(extra)
        assert exact <= Fraction(wide) <= exact * (1 + Fraction(1, 2**51))
        box = ParameterBox.between([-half], [extra])
        for end in (-half, extra):
            assert box.holds(ParameterBox((end,), (0.0,)))
    still = ParameterBox((0.3, 0.5), (0.0, 0.25))
    assert still.wider([0.0, 0.0]) is still
    assert still.wider([0.0, 0.125]).halves[0] == 0.0
