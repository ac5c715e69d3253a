"""Guards checker/arithmetic/models: numbers that depend on the time and on parameters hold the function's value at
every time and parameter, and little else, also where most of it is beyond what is kept."""

from __future__ import annotations

import math

import numpy as np
import pytest
from flint import arb, arb_poly, arb_series, ctx

from sparserob_core.checker.arithmetic import models
from sparserob_core.checker.arithmetic.models import Frame, Model, kepler_root, kepler_series
from sparserob_core.checker.arithmetic.monomials import NONE, Monomials
from sparserob_core.checker.outcome import Unchecked

CENTRES, HALVES = (0.7, 0.4, -0.3), (0.05, 0.08, 0.03)  # of the time, and of two parameters
RNG = np.random.default_rng(0)
POINTS = [tuple(map(float, one)) for one in (*RNG.uniform(-1.0, 1.0, (12, 3)), *RNG.choice([-1.0, 1.0], (8, 3)))]
FRAMES = [Frame(NONE, 12), Frame(Monomials(1, 8), 12), Frame(Monomials(2, 6), 12)]
SMALL = [
    Frame(NONE, 1),
    Frame(NONE, 3),
    Frame(Monomials(1, 1), 1),
    Frame(Monomials(2, 1), 2),
    Frame(Monomials(2, 3), 1),
]


def argument(frame: Frame, width: float = 1.0) -> Model:
    """The time, plus the parameters of the frame; of wide ones ``width`` times as much."""
    found = frame.time(arb(CENTRES[0]), arb(width * HALVES[0]))
    for j in range(frame.monomials.count):
        found = found + frame.parameter(j, arb(CENTRES[1 + j]), arb(width * HALVES[1 + j]))
    return found


def number(frame: Frame, point: tuple[float, ...], width: float = 1.0) -> arb:
    """What `argument` is at a point."""
    used = zip(CENTRES, HALVES, point, strict=True)
    return sum((arb(c) + arb(width * h) * arb(x) for c, h, x in list(used)[: 1 + frame.monomials.count]), arb(0))


def at(model: Model, point: tuple[float, ...]) -> arb:
    """The value of a model at a time and parameters from -1 to 1."""
    total = arb(0)
    for part, e in zip(model.parts, model.frame.monomials.exponents, strict=True):
        if part is not None:
            power = math.prod((arb(x) ** k for x, k in zip(point[1:], e, strict=False)), start=arb(1))
            total += part(arb(point[0])) * power
    return total


def kepler(M: arb) -> arb:
    return kepler_root(M, arb(0.3))


FUNCTIONS = {
    "plus": (lambda x: 3 - -x + (2 - x) - 1 + +x, lambda x: 4 + x),
    "times": (lambda x: x * x * 2.5 - x, lambda x: arb(2.5) * x * x - x),
    "divided": (lambda x: x / (1 + x * x) - 2 / x, lambda x: x / (1 + x * x) - 2 / x),
    "cube": (lambda x: x**3, lambda x: x**3),
    "high power": (lambda x: x**70, lambda x: x**70),
    "inverse square": (lambda x: x**-2, lambda x: 1 / (x * x)),
    "root by power": (lambda x: x**2.5, lambda x: x**2 * x.sqrt()),
    "power of two": (lambda x: 2.0**x, lambda x: arb(2) ** x),
    "of itself": (lambda x: x**x, lambda x: x**x),
    "nothing": (lambda x: x**0, lambda x: arb(1)),
    "exp": (lambda x: x.exp(), lambda x: x.exp()),
    "sin": (lambda x: (3 * x).sin(), lambda x: (3 * x).sin()),
    "cos": (lambda x: (3 * x).cos(), lambda x: (3 * x).cos()),
    "tan": (lambda x: (x / 2).tan(), lambda x: (x / 2).tan()),
    "log": (lambda x: x.log(), lambda x: x.log()),
    "sqrt": (lambda x: x.sqrt(), lambda x: x.sqrt()),
    "tanh": (lambda x: x.tanh(), lambda x: x.tanh()),
    "kepler": (lambda x: x.kepler(0.3), kepler),
    "absolute": (lambda x: abs(x - 9) - abs(x), lambda x: 9 - x - abs(x)),
    "modulus": (lambda x: abs(-x) + abs(x), lambda x: 2 * x),
    "negative": (lambda x: (x - 9) ** 3 * (x - 9) ** -1, lambda x: (x - 9) ** 2),
}  # fmt: skip
CLOSE = (1e-15, 2e-11, 5e-7)  # in 0, 1, 2 parameters, relative to 1 and the value
ROUGH = {
    "divided": (1e-14, 2e-10, 5e-6),
    "inverse square": (1e-9, 1e-8, 5e-2),
    "root by power": (1e-15, 1e-10, 2e-6),
    "high power": (1e-8, np.inf, np.inf),
}


@pytest.mark.parametrize("frame", FRAMES, ids=["0", "1", "2"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_is_in_its_model_at_every_point_and_the_model_is_narrow(name: str, frame: Frame) -> None:
    function, true = FUNCTIONS[name]
    with ctx.workprec(160):
        model = function(argument(frame))
    with ctx.workprec(600):
        truths = [true(number(frame, point)) for point in POINTS]
        balls = [at(model, point) for point in POINTS]
    assert all(ball.contains(truth) for ball, truth in zip(balls, truths, strict=True))
    widths = [float(ball.rad()) / (1.0 + float(abs(truth))) for ball, truth in zip(balls, truths, strict=True)]
    assert max(widths) <= ROUGH.get(name, CLOSE)[frame.monomials.count]


@pytest.mark.parametrize("width", [1.0, 3.0])
@pytest.mark.parametrize("frame", SMALL, ids=lambda one: f"{one.monomials.count}-{one.monomials.degree}-{one.order}")
@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_is_beyond_a_small_frame_is_not_lost(name: str, frame: Frame, width: float) -> None:
    function, true = FUNCTIONS[name]
    with ctx.workprec(160):
        try:
            model = function(argument(frame, width))
        except Unchecked:  # it is not finite across so wide a box
            assert width == 3.0 and frame.monomials.count == 2
            return
    with ctx.workprec(600):
        for point in POINTS:
            assert at(model, point).contains(true(number(frame, point, width)))


@pytest.mark.parametrize("share", [-1.0, -0.8, 0.7, 1.0])
def test_an_absolute_value_with_a_kink_holds_both_sides_and_no_more_than_the_shorter_one(share: float) -> None:
    frame, half = Frame(NONE, 3), 0.5
    model = abs(frame.time(arb(share * half), arb(half)))
    for point in np.linspace(-1.0, 1.0, 41).tolist():
        assert at(model, (point,)).contains(abs(arb(half) * (arb(point) + arb(share))))
    shorter = half * (1.0 - abs(share))
    assert abs(float(at(model, (0.0,)).rad()) - 2.0 * shorter) <= 1e-8


@pytest.mark.parametrize("frame", [Frame(NONE, 2), Frame(Monomials(1, 2), 0), Frame(Monomials(2, 2), 2)], ids=str)
def test_products_hold_exactly_what_they_are_up_to_what_is_beyond(frame: Frame) -> None:
    """All signs alike, so that at the corner all that is beyond is needed: the radius is that, and no more."""
    ones = arb_poly([arb(1)] * (frame.order + 1))
    model = Model(frame, [ones] * frame.monomials.size)
    square = model * model
    truth = arb((frame.order + 1) * frame.monomials.size) ** 2
    found = at(square, (1.0,) * 3)
    assert found.contains(truth)
    assert found.rad() * 2 <= (truth - sum((part[k] for part in square.parts for k in range(frame.order + 1)),
                                           arb(0)).mid()) * 2.001 + 1e-9  # fmt: skip
    assert all(part.length() <= frame.order + 1 for part in square.parts)


def test_degrees_beyond_are_counted_once_each_and_all() -> None:
    frame = Frame(Monomials(1, 3), 0)
    left = Model(frame, [arb_poly([1]), arb_poly([10]), arb_poly([100]), arb_poly([1000])])
    right = Model(frame, [arb_poly([1]), arb_poly([2]), arb_poly([3]), arb_poly([5])])
    beyond = 10 * 5 + 100 * (3 + 5) + 1000 * (2 + 3 + 5)
    for product in (left * right, right * left):
        (first, *_) = product.parts
        assert beyond <= float(first[0].rad()) <= beyond * (1 + 1e-6)
    none = Model(frame, [None, None, None, arb_poly([1])])
    assert float((none * none).parts[0][0].rad()) >= 1.0


@pytest.mark.parametrize("frame", FRAMES, ids=["0", "1", "2"])
def test_the_modulus_of_values_of_both_signs_is_hardly_larger_than_they_are(frame: Frame) -> None:
    with ctx.workprec(160):
        shifts = [argument(frame) - frame.number(number(frame, point)) for point in POINTS]
    with ctx.workprec(600):
        for place, shifted in zip(POINTS, shifts, strict=True):
            for point in POINTS:
                assert at(abs(shifted), point).contains(abs(number(frame, point) - number(frame, place)))
            assert abs(shifted).size.upper() <= 1.500001 * shifted.size.upper()


def test_the_size_of_a_model_is_the_most_that_it_can_be() -> None:
    frame = Frame(Monomials(1, 1), 1)
    model = Model(frame, [arb_poly([arb(-1, 0.5), 2]), arb_poly([arb(0), -3])])
    assert abs(float(model.size.upper()) - 6.5) < 1e-6
    assert model.constant.contains(-1.5) and Model(frame, [None, None]).constant == 0


def test_a_parameter_of_no_width_is_a_number() -> None:
    frame = Frame(Monomials(2, 3), 2)
    found = frame.parameter(1, arb(2), arb(0))
    assert [part is None for part in found.parts] == [False, *[True] * 9] and found.constant == 2


def test_functions_of_balls_hold_those_of_every_number_in_them() -> None:
    for function in (Model.exp, Model.sin, Model.cos, Model.tan, Model.log, Model.sqrt, Model.tanh):
        with ctx.workprec(96):
            wide = function(Frame(NONE, 4).number(arb(0.7, 0.1))).constant
            for p in (0.6001, 0.65, 0.7, 0.75, 0.7999):
                assert wide.contains(function(Frame(NONE, 0).number(arb(p))).constant.mid())


def test_what_has_no_value_is_refused_by_name() -> None:
    with ctx.workprec(96):
        t = Frame(NONE, 4).time(arb(0.0), arb(0.25))
        for function in (t.log, t.sqrt, lambda: 1.0 / t, lambda: t / 0.0, lambda: t**-1, lambda: t**1.5,
                         (t * 20).tan, (t * 1e9).exp().exp):  # fmt: skip
            with pytest.raises(Unchecked, match="not finite"):
                function()
        with pytest.raises(Unchecked, match="holds a str, expected a number"):
            t + "1"


@pytest.mark.parametrize(("M", "e"), [(0.0, 0.9), (0.3, 0.9), (-5.0, 0.2), (40.0, 0.99), (1.0, 0.0)])
def test_keplers_equation_is_solved_in_balls(M: float, e: float) -> None:
    with ctx.workprec(160):
        E = kepler_root(arb(M), arb(e))
        assert (E - arb(e) * E.sin()).overlaps(arb(M)) and float(E.rad()) < 1e-36
        before, ctx.cap = ctx.cap, 9
        try:
            anomaly = arb_series([arb(M), 2, 1], 9)
            found = kepler_series(anomaly, e, 9)
            left = found - arb_series([arb(e)], 9) * found.sin() - anomaly
            assert all(left[k].contains(0) and float(left[k].rad()) < 1e-20 for k in range(9))
            wide = kepler_series(arb_series([arb(M).union(arb(M + 2**-20)), 2, 1], 9), e, 9)
            other = kepler_series(arb_series([arb(M + 2**-21), 2, 1], 9), e, 9)
            assert all(wide[k].contains(other[k]) and wide[k].contains(found[k]) for k in range(9))
        finally:
            ctx.cap = before


@pytest.mark.parametrize("steps", [0, 1, 2, 3])
def test_a_root_that_newton_has_not_found_yet_is_held_all_the_same(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with ctx.workprec(160):
        truth = kepler_root(arb(0.3), arb(0.9))
        monkeypatch.setattr(models, "NEWTON", steps)
        for far in (0.3, -0.3):
            wide = kepler_root(arb(far), arb(0.9))
            assert wide.contains(truth if far > 0 else -truth)
            assert float(wide.rad()) < 2.0
