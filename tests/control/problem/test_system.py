"""Guards control/problem/system: matrices at parameters and times, their enclosures, and plants of phases."""

from __future__ import annotations

import copy
import math
import pickle
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import LinearSystem, SwitchedSystem, System, VaryingSystem
from sparserob_core.control.sets.sets import Box, NormBall, Polytope
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.expressions.expression import parse_matrix
from sparserob_core.sip.expressions.taylor import TaylorSpace

BOX = Box(np.array([0.5, -0.2]), np.array([1.5, 0.2]))


def oscillator(p):
    return np.array([[0, 1], [-(p[0] ** 2), -np.exp(p[1])]])


def by_callables() -> LinearSystem:
    return LinearSystem(
        oscillator, lambda p: np.array([[0.0], [1.0]]) / p[0], E=np.array([[0.0], [1.0]]), parameters=BOX
    )


def by_expressions() -> LinearSystem:
    names = ("omega", "zeta")
    A = parse_matrix("A", [[0, 1], ["-omega**2", "-exp(zeta)"]], names)
    B = parse_matrix("B", [[0], ["1/omega"]], names)
    return LinearSystem(A, B, E=parse_matrix("E", [[0], [1]], names), parameters=BOX, names=names)


def test_a_known_system_has_one_parameter_vector_of_length_zero() -> None:
    system = LinearSystem([[0, 1], [0, 0]], [[0], [1]])
    assert (system.states, system.controls, system.disturbances, system.parameter_count) == (2, 1, 2, 0)
    A, B, E = system.phases[0].matrices(np.zeros((3, 0)))
    assert A.shape == (3, 2, 2) and B.shape == (3, 2, 1)
    np.testing.assert_array_equal(E[2], np.eye(2))


def test_callables_and_expressions_give_the_same_matrices() -> None:
    points = np.random.default_rng(0).uniform(BOX.lower, BOX.upper, (20, 2))
    for left, right in zip(
        by_callables().phases[0].matrices(points), by_expressions().phases[0].matrices(points), strict=True
    ):
        np.testing.assert_allclose(left, right)
    assert by_callables().names == ("p1", "p2")
    assert by_expressions().describe(np.array([1.0, 0.1])) == "omega = 1, zeta = 0.1"


@pytest.mark.parametrize("make", [by_callables, by_expressions])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_taylor_models_enclose_every_entry_over_the_cell(make, seed: int) -> None:
    rng = np.random.default_rng(seed)
    system, space = make(), TaylorSpace(2, 3)
    centre, radius = rng.uniform([0.8, -0.1], [1.2, 0.1]), rng.uniform(0, 0.1, 2)
    models = system.phases[0].taylor(space, centre, radius)
    delta = rng.uniform(-1, 1, (30, 2))
    for truth, coefficients, remainder in zip(
        system.phases[0].matrices(centre + radius * delta), models[::2], models[1::2], strict=True
    ):
        value = np.einsum("km,mij->kij", space.monomials(delta), coefficients)
        assert (np.abs(value - truth) <= remainder + 1e-13).all()


def test_constant_plus_parameter_times_array_is_enclosed() -> None:
    base, change = np.array([[0.0, 1.0], [-1.0, 0.0]]), np.diag([1.0, 2.0])
    system = LinearSystem(lambda p: base + p[0] * change, [[0], [1]], parameters=Box([-1.0], [1.0]))
    coefficients, remainder, *_ = system.phases[0].taylor(TaylorSpace(1, 2), np.array([0.0]), np.array([0.5]))
    np.testing.assert_array_equal(coefficients[:2], [base, 0.5 * change])
    assert remainder[base != 0].max() == 0.0  # numbers are what they are
    assert 0.0 < remainder[change != 0].max() < 1e-14  # and a product is rounded


@pytest.mark.parametrize(
    "function",
    [
        lambda p: np.array([[math.sin(p[0])]]),
        lambda p: np.array([[1.0 if p[0] > 0 else 0.0]]),
        lambda p: np.array([[p[0]]], dtype=float),
        lambda p: np.linalg.inv(np.array([[p[0] + 3.0]])),
        lambda p: np.array([[np.floor(p[0])]]),
        lambda p: np.array([[1 / (p[0] + 2.0)]]) if isinstance(p[0], float) else np.array([[1 / p[0]]]),
    ],
)
def test_a_function_that_cannot_be_enclosed_says_so_only_when_asked(function) -> None:
    system = LinearSystem(function, [[1.0]], parameters=Box([-1.0], [1.0]))
    assert system.phases[0].matrices(np.array([[0.5]]))[0].shape == (1, 1, 1)
    with pytest.raises(NotEnclosable, match="A"):
        system.phases[0].taylor(TaylorSpace(1, 2), np.array([0.0]), np.array([1.0]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: LinearSystem([[0, 1]], [[1]]), "A must be square"),
        (lambda: LinearSystem([[0.0]], [[1], [2]]), "B must have 1 rows"),
        (lambda: LinearSystem([[0.0]], [1.0]), "B must be a matrix"),
        (lambda: LinearSystem([[np.nan]], [[1.0]]), "A must be a matrix of finite numbers"),
        (lambda: LinearSystem([["a"]], [[1.0]]), "A must be a matrix of numbers or a function"),
        (lambda: LinearSystem(lambda p: p, [[1.0]]), "no set of parameters is given"),
        (
            lambda: LinearSystem(lambda p: p, [[1.0]], parameters=Box([0.0], [1.0])),
            "the function A must return a matrix",
        ),
        (
            lambda: LinearSystem(lambda p: [[p[3]]], [[1.0]], parameters=Box([0.0], [1.0])),
            "the function A failed at p1 = 0.5",
        ),
        (
            lambda: LinearSystem(lambda p: [[np.log(p[0])]], [[1.0]], parameters=Box([0.0], [1.0])),
            "A is not finite at p1 = 0",
        ),
        (lambda: LinearSystem([[0.0]], [[1.0]], parameters=Box([0.0], [np.inf])), "must be bounded"),
        (
            lambda: LinearSystem([[0.0]], [[1.0]], parameters=Box([0.0], [1.0]), names=("a", "b")),
            "expected 1 parameter names",
        ),
        (lambda: LinearSystem(parse_matrix("A", [["q"]], ("q",)), [[1.0]]), "the system has none"),
    ],
)
def test_a_system_at_fault_names_the_matrix_and_what_was_expected(build, message: str) -> None:
    with pytest.raises(InputError, match=message):
        build()


def test_parameters_may_fill_a_polytope() -> None:
    triangle = Polytope(np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 1.0]]), np.array([0.0, 0.0, 1.0]))
    system = LinearSystem(lambda p: [[np.sqrt(1.0 - p[0] - p[1] + 1e-9)]], [[1.0]], parameters=triangle)
    assert system.parameter_count == 2


def other_for_numbers(p):
    return [[(-1.0 if isinstance(p[0], float) else -9.0) + 0.0 * p[0]]]


def drawn(p):
    return [[np.random.default_rng().normal() + 0.0 * p[0]]]


@pytest.mark.parametrize("function", [other_for_numbers, drawn])
def test_a_function_that_is_another_one_for_taylor_models_is_refused(function):
    """Rows would be those of one system, and proofs those of another."""
    system = LinearSystem(function, [[1.0]], parameters=Box([-0.5], [0.5]))
    space = TaylorSpace(1, 2)
    with pytest.raises(InputError, match=r"system\.A: expected a function that depends on its argument alone, .*p1 = "):
        system.phases[0].taylor(space, np.zeros(1), np.full(1, 0.5))


def test_a_function_that_cancels_is_the_same_for_taylor_models():
    def A(p):
        return [[1.0, np.sin(p[0]) - p[0]], [(1.0 + p[0]) ** 2 - 1.0 - 2.0 * p[0] - p[0] ** 2, np.exp(-p[0])]]

    system = LinearSystem(A, [[1.0], [0.0]], parameters=Box([-0.5], [0.5]))
    for centre in np.linspace(-0.5, 0.5, 7):
        system.phases[0].taylor(TaylorSpace(1, 3), np.array([centre]), np.full(1, 1e-3))


# What is true of plants: where one is after a while, by the matrix exponential, whatever was done to it.

OSCILLATOR = LinearSystem([[0.0, 1.0], [-1.0, -0.1]], [[0.0], [1.0]])
FALLING = LinearSystem([[0.0, 1.0], [-2.0, 0.3]], [[1.0], [0.5]], [[0.0, 1.0], [2.0, 0.0]], c=[0.5, -1.0])
UNCERTAIN = LinearSystem(
    lambda p: np.array([[0.0, p[0]], [-p[0], p[1]]]), [[0.0], [2.0]], parameters=BOX, c=lambda p: [p[1], 1.0]
)
ENDS, SHARE = (1.0, 1.75, 3.0), Box([-0.5], [0.5])


def switched(delay: float = 0.0) -> SwitchedSystem:
    return SwitchedSystem(list(zip(ENDS, (OSCILLATOR, UNCERTAIN, FALLING), strict=True)), delay)


def varying(delay: float = 0.0, parameters: Box | None = SHARE) -> System:
    """Three laws in the time, in which a parameter stands to the first power where it is multiplied by known states."""
    k = "k" if parameters is not None else 0.25
    names = ("k",) if parameters is not None else ()
    first = ([[0.0, 1.0], ["-t", "-0.1"]], [[0.0], [f"1 + {k}"]], None, None)
    second = ([[0.0, "t**2"], [-1.0, 0.0]], [[f"{k}*t"], [1.0]], [["t", 0.0], [0.0, 1.0]], ["sin(t)", f"{k}"])
    pieces = [(ENDS[0], first), (ENDS[1], second), (ENDS[2], first)]
    return VaryingSystem.taking_turns(pieces, delay=delay, parameters=parameters, names=names)


def law_of(t: float, k: float) -> dict[str, np.ndarray]:
    """The matrices of `varying` by numpy alone."""
    if ENDS[0] <= t < ENDS[1]:
        return {
            "A": np.array([[0.0, t**2], [-1.0, 0.0]]), "B": np.array([[k * t], [1.0]]),
            "E": np.array([[t, 0.0], [0.0, 1.0]]), "c": np.array([[np.sin(t)], [k]]),
        }  # fmt: skip
    A, B = np.array([[0.0, 1.0], [-t, -0.1]]), np.array([[0.0], [1.0 + k]])
    return {"A": A, "B": B, "E": np.eye(2), "c": np.zeros((2, 1))}


def phase_at(system: System, time: float) -> Phase:
    return next(phase for phase in system.phases if phase.begin <= time < phase.until)


def matrices_at(system: System, time: float, parameter: np.ndarray) -> dict[str, np.ndarray]:
    """Of a system at a time and a parameter, its matrices; the drift as `forced` has it."""
    phase = phase_at(system, time)
    arguments = np.append(time, parameter) if system.varies else parameter
    found = dict(zip("ABE", (part[0] for part in phase.matrices(arguments[None])), strict=True))
    found["c"] = phase.forced.matrices(arguments[None])[1][0][:, found["B"].shape[1] :]
    return found


def alike(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    for name in "ABEc":
        np.testing.assert_allclose(one[name], other[name], rtol=1e-13, atol=1e-15, err_msg=name)


def reached(system: System, times: list[float], parameter: np.ndarray, start: np.ndarray) -> list[np.ndarray]:
    """The states of a system whose phases are constant at several times, under ``u = 0.7``, ``w = (0.2, -0.4)``."""
    found, state, now = [], np.append(start, 1.0), 0.0
    while len(found) < len(times):
        target = times[len(found)]
        phase = phase_at(system, now)
        part = matrices_at(system, now, parameter)
        drift = part["c"][:, 0] if part["c"].size else 0.0
        push = part["B"] @ [0.7] + part["E"] @ [0.2, -0.4] + drift
        stop = min(target, phase.until)
        whole = np.block([[part["A"], push[:, None]], [np.zeros((1, 3))]])
        state, now = expm(whole * (stop - now)) @ state, stop
        if now >= target:
            found.append(state[:2])
    return found


P = np.array([0.9, 0.1])
START = np.array([1.0, -2.0])
LATE = [ENDS[0], 1.2, ENDS[1], 2.2, 2.9]


def test_pieces_share_their_parameters_and_drift_by_nothing_where_they_have_none():
    system = switched(0.25)
    assert (system.states, system.controls, system.disturbances, system.parameter_count) == (2, 1, 2, 2)
    assert system.parameters is BOX and tuple(system.names) == ("p1", "p2") and system.delay == 0.25
    assert system.switches == ENDS[:-1] and system.horizon == ENDS[-1] and system.drifts and not system.varies
    assert system.modes == system.phases and all(phase.domain is BOX for phase in system.phases)
    zero = {"E": np.eye(2), "c": np.zeros((2, 1))}
    alike(matrices_at(system, 0.5, P), {"A": [[0.0, 1.0], [-1.0, -0.1]], "B": [[0.0], [1.0]], **zero})
    uncertain = {"A": [[0.0, 0.9], [-0.9, 0.1]], "B": [[0.0], [2.0]], "E": np.eye(2), "c": [[0.1], [1.0]]}
    alike(matrices_at(system, 1.5, P), uncertain)
    alike(
        matrices_at(system, 2.5, P),
        {"A": [[0.0, 1.0], [-2.0, 0.3]], "B": [[1.0], [0.5]], "E": [[0.0, 1.0], [2.0, 0.0]], "c": [[0.5], [-1.0]]},
    )
    assert system.describe(P) == "p1 = 0.9, p2 = 0.1"


def test_one_piece_ends_at_its_horizon_and_has_no_switch():
    one = SwitchedSystem([(2.0, OSCILLATOR)])
    assert one.horizon == 2.0 and one.switches == () and not one.drifts and one.parameters is None
    assert OSCILLATOR.horizon == np.inf and OSCILLATOR.names == () and OSCILLATOR.parameter_count == 0
    assert one.forced is one and OSCILLATOR.remaining(1.0, 2.0) is OSCILLATOR
    assert one.remaining(1.0, 1.0).horizon == np.inf  # it does not change any more


def test_a_drift_that_is_forced_takes_the_state_where_it_was():
    system = switched(0.25)
    forced, wanted = system.forced, reached(system, LATE, P, START)
    assert forced.controls == 2 and not forced.drifts and forced.delay == 0.0 and forced.switches == system.switches
    assert forced.parameters is BOX
    for begin in (0.5, 1.5, 2.5):
        one, other = matrices_at(system, begin, P), matrices_at(forced, begin, P)
        np.testing.assert_array_equal(other["B"], np.hstack([one["B"], one["c"]]))
    assert len(wanted) == len(LATE)


@pytest.mark.parametrize("begin", [0.0, 0.4, 1.0, 1.0 - 1e-13, 1.0 + 1e-13, 1.3, 1.75, 2.0])
@pytest.mark.parametrize("delay", [0.0, 0.25])
def test_what_is_left_goes_on_where_the_whole_is(begin, delay):
    system = switched(delay)
    left = system.remaining(begin, ENDS[-1] - begin)
    assert left.phases[0].begin == 0.0 and left.delay == delay and left.parameters is BOX
    assert [phase.until for phase in left.phases[:-1]] == [phase.begin for phase in left.phases[1:]]
    several = [switch for switch in ENDS[:-1] if switch > begin + 1e-9]
    assert left.switches == pytest.approx([switch - begin for switch in several], abs=1e-15)
    assert left.horizon == (pytest.approx(ENDS[-1] - begin) if several else np.inf)
    later = [time for time in LATE if time > begin + 1e-9]
    whole = reached(system, [begin, *later] if begin else later, P, START)
    before = whole[0] if begin else START
    found = reached(left, [time - begin for time in later], P, before)
    np.testing.assert_allclose(found, whole[1:] if begin else whole, rtol=1e-9)


def test_of_a_shorter_horizon_no_phase_is_left_that_begins_after_it():
    assert [phase.until for phase in switched().remaining(0.5, 1.0).phases] == [0.5, 1.0]
    assert [phase.until for phase in switched().remaining(0.5, 0.5 + 1e-13).phases] == [np.inf]
    assert [phase.until for phase in varying().remaining(0.5, 1.0).phases] == [0.5, 1.0]
    assert [phase.until for phase in varying().remaining(0.5, 0.5).phases] == [0.5]


@pytest.mark.parametrize("begin", [0.0, 0.4, 1.0, 1.0 - 1e-13, 1.0 + 1e-13, 1.3, 2.0])
def test_what_is_left_of_a_system_in_time_has_the_matrices_of_later_times(begin):
    system, parameter = varying(0.25), np.array([0.3])
    left = system.remaining(begin, ENDS[-1] - begin)
    assert left.varies and left.phases[0].begin == 0.0 and left.delay == 0.25 and left.horizon == ENDS[-1] - begin
    left.check_horizon(ENDS[-1] - begin)
    for time in (begin + 1e-6, 1.2, 1.74, 1.76, 2.99):
        if time > begin:
            alike(matrices_at(left, time - begin, parameter), law_of(time, 0.3))
    assert left.parameters is system.parameters and tuple(left.names) == ("k",)


def test_a_system_in_time_has_its_matrices_and_is_known_at_a_parameter():
    system, parameter = varying(0.25), np.array([0.3])
    assert system.varies and system.switches == () and system.horizon == ENDS[-1] and system.drifts
    assert (system.states, system.controls, system.parameter_count, tuple(system.names)) == (2, 1, 1, ("k",))
    assert system.describe(parameter) == "k = 0.3"
    known = system.at(parameter)
    assert known.parameters is None and known.delay == 0.25 and known.at(np.zeros(0)) is known and known.varies
    for time in (0.0, 0.5, 1.0, 1.5, 1.75, 2.5):
        alike(matrices_at(system, time, parameter), law_of(time, 0.3))
        alike(matrices_at(known, time, np.zeros(0)), law_of(time, 0.3))
        forced = matrices_at(system.forced, time, parameter)["B"]
        np.testing.assert_allclose(forced, np.hstack([law_of(time, 0.3)["B"], law_of(time, 0.3)["c"]]))
    assert system.forced.delay == 0.0 and system.forced.parameters is system.parameters
    plain = VaryingSystem.of([["t"]], [[1.0]], 2.0)
    assert plain.forced is plain and not plain.drifts and plain.dependence is None and plain.powers is None


def test_a_system_of_constant_phases_is_known_at_a_parameter_too():
    known = switched(0.25).at(P)
    assert known.parameters is None and known.delay == 0.25 and known.switches == ENDS[:-1]
    np.testing.assert_allclose(reached(known, LATE, np.zeros(0), START), reached(switched(), LATE, P, START))
    assert OSCILLATOR.at(np.zeros(0)) is OSCILLATOR and UNCERTAIN.at(P).horizon == np.inf


@pytest.mark.parametrize("make", [switched, UNCERTAIN.with_delay])
def test_in_time_a_system_goes_where_it_went(make):
    system = make(0.25)
    moved = system.in_time(ENDS[-1])
    assert moved.varies and moved.delay == 0.25 and moved.parameters is BOX and moved.horizon == ENDS[-1]
    assert moved.in_time(ENDS[-1]) is moved and tuple(moved.names) == ("p1", "p2")
    assert [phase.begin for phase in moved.phases] == [0.0, *system.switches]
    for time in (0.0, 0.5, 1.0, 1.5, 1.75, 2.5):
        alike(matrices_at(moved, time, P), matrices_at(system, time, P))
    assert OSCILLATOR.in_time(2.0).parameters is None
    ball = LinearSystem([[0.0]], [[1.0]], parameters=NormBall(2.0, 1.0, dimension=2))
    with pytest.raises(InputError, match=r"^system.parameters: expected a bounded box beside the time t"):
        ball.in_time(1.0)


def factors() -> tuple[np.ndarray, ...]:
    x, u, w, time = np.array([4.0, 0.5]), np.array([8.0]), np.array([0.25, 2.0]), 0.5
    rate = time / x[:, None]
    return rate * x, rate * u, rate * w, rate


@pytest.mark.parametrize("make", [switched, varying, OSCILLATOR.with_delay])
def test_units_of_a_system_lead_there_and_back(make):
    system = make(0.25)
    A, B, E, c = factors()
    units = 2.0 ** np.arange(1, 1 + system.parameter_count)
    other = system.in_units(A, B, E, units, c, 0.5)
    assert other.delay == 0.5 and other.horizon == 2.0 * system.horizon
    assert other.switches == tuple(2.0 * time for time in system.switches)
    stated = other.stated
    if system.parameters is None:  # whose matrices are numbers, and any units are as good
        assert stated is other
        return
    assert system.stated is system and stated.delay == 0.25 and stated.parameters.is_same(system.parameters)
    assert all(one is two for one, two in zip(stated.phases, system.phases, strict=True))
    assert other.describe(np.ones(units.size)) == system.describe(units)
    twice = other.in_units(A, B, E, units, c, 0.5)
    assert twice.delay == 1.0 and twice.stated.delay == 0.25 and twice.stated.parameters.is_same(system.parameters)
    back = other.in_units(1.0 / A, 1.0 / B, 1.0 / E, 1.0 / units, 1.0 / c, 2.0)
    parameter = P[: units.size] / 3.0 + 0.4
    for time in (0.0, 0.5, 1.0, 1.5, 2.5):
        plain = matrices_at(system, time, parameter)
        wanted = {name: plain[name] * one for name, one in zip("ABEc", (A, B, E, c), strict=True)}
        alike(matrices_at(other, 2.0 * time, parameter / units), wanted)
        alike(matrices_at(back, time, parameter), plain)
        wanted = {name: wanted[name] * one for name, one in zip("ABEc", (A, B, E, c), strict=True)}
        alike(matrices_at(twice, 4.0 * time, parameter / units**2), wanted)
    ones = system.in_units(np.ones_like(A), np.ones_like(B), np.ones_like(E), np.ones(units.size))
    assert (ones.horizon, ones.delay) == (system.horizon, 0.25)
    alike(matrices_at(ones, 2.5, parameter), matrices_at(system, 2.5, parameter))


def test_what_is_left_of_a_system_in_units_is_that_of_the_stated_one():
    A, B, E, c = factors()
    other = switched(0.25).in_units(A, B, E, np.ones(2), c, 0.5)
    left = other.remaining(1.0, 5.0)
    assert [phase.until for phase in left.phases] == [1.0, 2.5, 5.0]
    assert [phase.until for phase in left.stated.phases] == [0.5, 1.25, 2.5]
    again = left.in_units(A, B, E, np.ones(2), c, 0.5)
    assert [phase.until for phase in again.phases] == [2.0, 5.0, 10.0]
    smaller = other.with_parameters(Box([0.6, 0.0], [0.7, 0.1]))
    assert smaller.stated.parameters.is_same(Box([0.6, 0.0], [0.7, 0.1]))
    assert all(phase.domain.is_same(smaller.parameters) for phase in smaller.stated.phases)


def test_other_parameters_are_those_of_every_phase():
    box = Box([0.6, 0.0], [0.7, 0.1])
    smaller = switched(0.25).with_parameters(box)
    assert smaller.parameters is box and smaller.delay == 0.25 and all(one.domain is box for one in smaller.phases)
    late = varying(0.25).with_parameters(Box([0.1], [0.2]))
    assert tuple(late.names) == ("k",) and late.box.upper.tolist() == [0.2] and late.delay == 0.25
    assert [one.domain.lower.tolist() for one in late.phases] == [[0.0, 0.1], [1.0, 0.1], [1.75, 0.1]]
    with pytest.raises(InputError, match=r"^system.parameters: expected a bounded box beside the time"):
        varying().with_parameters(NormBall(2.0, 1.0, dimension=1))


def test_a_law_may_call_its_time_as_it_likes():
    A = parse_matrix("A", [["-s*k"]], ("s", "k"))
    law = LinearSystem(A, [[1.0]], parameters=Box([0.0, 1.0], [2.0, 3.0]), names=("s", "k"))
    system = VaryingSystem(law, 2.0, parameters=Box([1.0], [3.0])).with_parameters(Box([1.0], [2.0]))
    assert tuple(system.phases[0].names) == ("s", "k") and tuple(system.names) == ("k",)


def test_other_phases_last_as_long_as_the_system():
    system = switched(0.25)
    cut = [phase.between(phase.begin, phase.until) for phase in system.until(3.0)]
    assert system.in_phases(cut).phases == system.phases and system.in_phases(cut).delay == 0.25
    until = OSCILLATOR.until(5.0)
    assert [(phase.begin, phase.until) for phase in until] == [(0.0, 5.0)]
    assert OSCILLATOR.in_phases(until).horizon == np.inf
    both = OSCILLATOR.in_phases([until[0].between(0.0, 2.0), until[0].between(2.0, 5.0)])
    assert both.switches == (2.0,) and both.horizon == 5.0
    assert [phase.until for phase in system.until(3.0 + 1e-13)] == [1.0, 1.75, 3.0 + 1e-13]
    one = SwitchedSystem([(2.0, OSCILLATOR)])
    assert one.in_phases([one.phases[0].between(0.5, 7.0)]).until(2.0)[0].begin == 0.0
    assert one.in_phases([one.phases[0].between(0.0, 7.0)]).horizon == 2.0


def test_the_middle_of_the_parameters_and_how_far_they_are_from_it():
    box = Box([0.1, -0.3, 2.0], [0.7, 0.3, 2.0])
    law = LinearSystem(
        lambda p: np.array([[-1.0 + 0.0 * p[0]]]),
        lambda p: np.array([[p[1] + p[2] + p[3]]]),
        parameters=Box([0.0, *box.lower], [1.0, *box.upper]),
    )
    centre, most = VaryingSystem(law, 1.0, parameters=box).deviations
    np.testing.assert_array_equal(centre, box.interior_point())
    for low, high, middle, radius in zip(box.lower, box.upper, centre, most, strict=True):
        exact = max(Fraction(high) - Fraction(middle), Fraction(middle) - Fraction(low))
        assert Fraction(radius) >= exact and radius <= float(exact) * (1.0 + 1e-15)
    assert [part.tolist() for part in OSCILLATOR.deviations] == [[], []]


@pytest.mark.parametrize("seed", range(20))
def test_a_deviation_is_never_less_than_the_numbers_say(seed):
    rng = np.random.default_rng(seed)
    low, high = np.sort(rng.uniform(-1.0, 1.0, (2, 5)) * 10.0 ** rng.integers(-9, 9, 5), axis=0)
    names = ["a", "b", "c", "d", "e"]
    system = VaryingSystem.of([[-1.0]], [[" + ".join(names)]], 1.0, parameters=Box(low, high), names=names)
    centre, most = system.deviations
    for j in range(5):
        ends = [abs(Fraction(end) - Fraction(centre[j])) for end in (low[j], high[j])]
        assert Fraction(most[j]) >= max(ends)
        assert Fraction(float(np.nextafter(most[j], 0.0))) <= max(ends)


def test_powers_are_told_where_the_state_is_no_affine_function():
    affine = varying()
    assert affine.powers is None and affine.dependence is not None
    bent = VaryingSystem.of([["-k**2"]], [[1.0]], 1.0, parameters=Box([0.5], [1.0]), names=("k",))
    assert bent.powers == 2 and bent.dependence is None
    assert switched().powers is None and switched().dependence is None


def test_the_states_of_a_superposed_system_add_up_to_those_of_the_system():
    """At every time, ``x' = A x + B u + E w + c`` at a parameter is the same combination of the rates of all states."""
    system, rng = varying(0.25), np.random.default_rng(3)
    depends = system.dependence
    assert depends is not None
    whole = system.superposed(depends)
    assert whole.varies and whole.parameters is None and whole.delay == 0.25 and whole.horizon == system.horizon
    assert [(phase.begin, phase.until) for phase in whole.phases] == [
        (phase.begin, phase.until) for phase in system.phases
    ]
    for k in (-0.5, 0.1, 0.5):
        rows = depends.rows((np.array([k]) - depends.centre) / depends.units)
        for time in (0.5, 1.5, 2.5):
            every, one = matrices_at(whole, time, np.zeros(0)), law_of(time, k)
            states, u, w = rng.normal(size=whole.states), rng.normal(size=1), rng.normal(size=2)
            rates = every["A"] @ states + every["B"] @ u + every["E"] @ w + every["c"][:, 0]
            wanted = one["A"] @ (rows @ states) + one["B"] @ u + one["E"] @ w + one["c"][:, 0]
            np.testing.assert_allclose(rows @ rates, wanted, rtol=1e-12, atol=1e-12)


def test_modes_of_a_system_in_time_are_what_it_is_at_times_near_its_ends_and_between():
    system = varying()
    modes = system.modes
    assert len(modes) == 3 * 65 and modes is system.modes
    starts = [matrices_at(system, time, np.zeros(1)) for time in (0.0, 1.0, 1.75)]
    stops = [law_of(1.0 - 1e-12, 0.0), law_of(1.75 - 1e-12, 0.0), law_of(3.0, 0.0)]
    for i, (start, stop) in enumerate(zip(starts, stops, strict=True)):
        part = modes[65 * i : 65 * (i + 1)]
        for mode, wanted in ((part[0], start), (part[-1], stop)):
            assert mode.domain is None
            for name in "ABEc":
                np.testing.assert_allclose(np.asarray(mode.entry(name)), wanted[name], atol=1e-9)
    times = [-float(np.asarray(mode.A)[1, 0]) for mode in modes[:65]]
    np.testing.assert_allclose(times, (1.0 - np.cos(np.linspace(0.0, np.pi, 65))) / 2.0, atol=1e-12)
    undriven = VaryingSystem.of([["t"]], [[1.0]], 2.0)
    assert undriven.modes[0].c is None and float(np.asarray(undriven.modes[-1].A)[0, 0]) == 2.0


def test_modes_keep_the_parameters_that_the_state_is_no_affine_function_of():
    box = Box([0.5], [1.0])
    system = VaryingSystem.of([["-t*k**2"]], [[1.0]], 2.0, parameters=box, names=("k",))
    assert len(system.modes) == 65 and all(mode.domain is system.parameters for mode in system.modes)
    np.testing.assert_allclose(system.modes[-1].matrices(np.array([[0.7]]))[0], [[[-2.0 * 0.49]]])
    np.testing.assert_allclose(system.modes[32].matrices(np.array([[0.7]]))[0], [[[-0.49]]])


def turning(horizon: float, change: str = "0", where: str = "A", **rest: Any) -> System:
    """A system with the period 2 of which one entry is another at the end."""
    A = [[0.0, f"sin(3.141592653589793*t) + ({change if where == 'A' else '0'})"], [-1000.0, 0.0]]
    parts = {name: [[f"cos(3.141592653589793*t) + ({change if where == name else '0'})"], [0.0]] for name in ("B", "E")}
    c = [0.0, f"cos(3.141592653589793*t) + ({change if where == 'c' else '0'})"]
    return VaryingSystem.of(A, parts["B"], horizon, parts["E"], c, **rest)


def test_a_period_is_one_but_for_rounding():
    turning(2.0).check_period()
    turning(4.0).check_period()
    turning(2.0, "4e-10*t").check_period()  # of sizes 1
    for system in (OSCILLATOR, switched(), varying()):
        system.check_period()  # the pieces take their turns again
    box = Box([-1.0], [1.0])
    turning(2.0, "k", parameters=box, names=("k",)).check_period()


@pytest.mark.parametrize(
    ("where", "entry"), [("A", r"A\[1\]\[2\]"), ("B", r"B\[1\]\[1\]"), ("E", r"E\[1\]\[1\]"), ("c", r"c\[2\]")]
)
@pytest.mark.parametrize("change", ["6e-10*t", "-6e-10*t", "0.001*t"])
def test_an_entry_that_is_another_at_the_end_is_named(where, entry, change):
    with pytest.raises(InputError, match=f"^repeat: expected a horizon that is a period .*, got {entry} = .* at 2$"):
        turning(2.0, change, where).check_period()


def test_an_entry_is_measured_by_its_own_size():
    """``1e-7`` of ``1000`` is rounding where it is ``1e-7`` of its size in between, whatever its ends are."""
    VaryingSystem.of([["1000*sin(3.141592653589793*t/2) + 1e-7*t"]], [[1.0]], 2.0).check_period()
    VaryingSystem.of([["-1000*sin(3.141592653589793*t/2) + 1e-7*t"]], [[1.0]], 2.0).check_period()
    with pytest.raises(InputError, match=r"^repeat: "):
        VaryingSystem.of([["sin(3.141592653589793*t/2) + 1e-7*t"]], [[1.0]], 2.0).check_period()


def laws() -> tuple[LinearSystem, LinearSystem]:
    time = Box([0.0], [3.0])
    return (
        LinearSystem(lambda p: [[-p[0]]], [[1.0]], parameters=time),
        LinearSystem(lambda p: [[p[0] ** 2]], [[2.0]], parameters=time, c=lambda p: [p[0]]),
    )


def test_laws_take_turns_where_they_are_told_to():
    first, second = laws()
    system = VaryingSystem(first, 3.0, 0.5, ((1.0, second),))
    assert [(phase.begin, phase.until) for phase in system.phases] == [(0.0, 1.0), (1.0, 3.0)]
    assert system.delay == 0.5 and system.parameters is None and system.drifts and system.names == ()
    alike(matrices_at(system, 0.5, np.zeros(0)), {"A": [[-0.5]], "B": [[1.0]], "E": [[1.0]], "c": np.zeros((1, 1))})
    alike(matrices_at(system, 2.0, np.zeros(0)), {"A": [[4.0]], "B": [[2.0]], "E": [[1.0]], "c": [[2.0]]})
    alone = VaryingSystem(first, 3.0)
    assert alone.phases[0].until == 3.0 and not alone.drifts


FILLED = [
    (lambda: switched().check_horizon(3.5), "system.pieces.2.until: expected 3.5, the horizon, since it is the last"),
    (lambda: switched().check_horizon(2.5), "system.pieces.2.until: expected 2.5, the horizon, since it is the last"),
    (lambda: varying().check_horizon(3.5), "system.pieces.2.until: expected 3.5, the horizon, since it is the last"),
    (lambda: VaryingSystem(laws()[0], 3.0).check_horizon(2.0), "system: expected a law up to 2, .* got up to 3"),
    (
        lambda: SwitchedSystem([(2.0 - 1e-13, OSCILLATOR), (2.0, OSCILLATOR)]).check_horizon(2.0),
        "system.pieces.1.until: expected a time that is after 2 by more than rounding, got 2.0",
    ),
    (
        lambda: SwitchedSystem([(1e-13, OSCILLATOR), (2.0, OSCILLATOR)]).check_horizon(2.0),
        "system.pieces.0.until: expected a time that is after 0 by more than rounding, got 1e-13",
    ),
]
PIECES = [
    (lambda: SwitchedSystem([]), "system.pieces: expected pairs of a time and a LinearSystem, got none"),
    (lambda: SwitchedSystem([1.0]), "system.pieces.0: expected a pair of a time and a LinearSystem, got 1.0"),
    (lambda: SwitchedSystem([(1.0, OSCILLATOR, 2)]), "system.pieces.0: expected a pair of a time and a LinearSystem"),
    (lambda: SwitchedSystem([("a", OSCILLATOR)]), "system.pieces.0.until: expected a time, got 'a'"),
    (lambda: SwitchedSystem([(True, OSCILLATOR)]), "system.pieces.0.until: expected a time, got True"),
    (lambda: SwitchedSystem([(0.0, OSCILLATOR)]), "system.pieces.0.until: expected a time after 0, got 0"),
    (lambda: SwitchedSystem([(np.inf, OSCILLATOR)]), "system.pieces.0.until: expected a time after 0, got inf"),
    (
        lambda: SwitchedSystem([(1.0, OSCILLATOR), (2.0, OSCILLATOR), (2.0, OSCILLATOR)]),
        "system.pieces.2.until: expected a time after 2, got 2",
    ),
    (lambda: SwitchedSystem([(1.0, 3)]), "system.pieces.0: expected a LinearSystem without delay, got int"),
    (
        lambda: SwitchedSystem([(1.0, OSCILLATOR.with_delay(0.5))]),
        "system.pieces.0: expected a LinearSystem without delay, got a delay of its own",
    ),
    (
        lambda: SwitchedSystem([(1.0, OSCILLATOR), (2.0, LinearSystem([[0.0]], [[1.0]]))]),
        "system.pieces.1: expected 2 states, as the other pieces, got 1",
    ),
    (
        lambda: SwitchedSystem([(1.0, OSCILLATOR), (2.0, LinearSystem(np.eye(2), np.eye(2)))]),
        "system.pieces.1: expected 1 controls, as the other pieces, got 2",
    ),
    (
        lambda: SwitchedSystem([(1.0, OSCILLATOR), (2.0, LinearSystem(np.eye(2), np.ones((2, 1)), np.ones((2, 1))))]),
        "system.pieces.1: expected 2 disturbances, as the other pieces, got 1",
    ),
    (
        lambda: SwitchedSystem([(1.0, UNCERTAIN), (2.0, OSCILLATOR.with_parameters(Box([0.5, -0.2], [1.5, 0.3])))]),
        "system.pieces.1: expected the parameters of the other pieces, got others",
    ),
    (
        lambda: SwitchedSystem(
            [
                (1.0, OSCILLATOR),
                (2.0, UNCERTAIN),
                (3.0, LinearSystem(np.eye(2), np.ones((2, 1)), None, BOX, ("a", "b"))),
            ]
        ),
        "system.pieces.2: expected the parameters of the other pieces, got others",
    ),
    (lambda: VaryingSystem(OSCILLATOR, 1.0), "system: expected a law whose first parameter is the time, .* another"),
    (
        lambda: VaryingSystem(laws()[0].with_delay(0.5), 1.0),
        "system: expected a law whose first parameter is the time, .* without a delay of its own, got another",
    ),
    (lambda: VaryingSystem(laws()[0], 1.0, parameters=Box([0.0], [1.0])), "system: expected a law whose first"),
    (lambda: VaryingSystem(laws()[0], 2.0, later=((1.0, OSCILLATOR),)), "system: expected a law whose first"),
    (
        lambda: VaryingSystem(
            SwitchedSystem([(1.0, laws()[0]), (2.0, laws()[1])]),
            2.0,
        ),
        "system: expected a law whose first",
    ),
    (
        lambda: VaryingSystem(laws()[0], 2.0, later=((1.0, laws()[1]), (1.0, laws()[0]))),
        "system.pieces.1.until: expected a time after 1, got 1",
    ),
    (
        lambda: VaryingSystem(laws()[0], 2.0, later=((3.0, laws()[1]),)),
        "system.pieces.1.until: expected a time after 3, got 2",
    ),
    (lambda: VaryingSystem.of([["t"]], [[1.0]], 0.0), "system.until: expected a time after 0, got 0"),
    (lambda: VaryingSystem(laws()[0], -1.0), "system.until: expected a time after 0, got -1"),
    (lambda: VaryingSystem.taking_turns([]), "system.pieces: expected at least one, got none"),
    (lambda: VaryingSystem.of([["t"]], [[1.0]], np.inf), "system.until: expected a time after 0, got inf"),
    (
        lambda: VaryingSystem.taking_turns([(1.0, ([["t"]], [[1.0]], None, None))] * 2),
        "system.pieces.1.until: expected a time after 1, got 1",
    ),
    (
        lambda: VaryingSystem.taking_turns(
            [(1.0, ([["t"]], [[1.0]], None, None)), (2.0, ([["q"]], [[1.0]], None, None))]
        ),
        "system.pieces.1.A",
    ),
    (lambda: VaryingSystem.of([["t"]], [[1.0]], 1.0, define={"t": 1.0}), "system.define"),
    (
        lambda: VaryingSystem.of([["t"]], [[1.0]], 1.0, parameters=Box([0.0], [1.0]), names=("t",)),
        "system.parameters: expected 1 names, none of them t, which is the time, got t",
    ),
    (
        lambda: VaryingSystem.of([["t"]], [[1.0]], 1.0, parameters=Box([0.0], [1.0]), names=("a", "b")),
        "system.parameters: expected 1 names, none of them t, which is the time, got a, b",
    ),
    (
        lambda: VaryingSystem.of([["t"]], [[1.0]], 1.0, names=("a",)),
        "system.parameters: expected 0 names, none of them t, which is the time, got a",
    ),
    (
        lambda: VaryingSystem.of([["t"]], [[1.0]], 1.0, parameters=NormBall(2.0, 1.0, dimension=1)),
        "system.parameters: expected a bounded box beside the time t",
    ),
]


@pytest.mark.parametrize(("build", "said"), [*FILLED, *PIECES], ids=range(len(FILLED) + len(PIECES)))
def test_a_plant_at_fault_is_one_sentence_that_begins_with_its_key(build, said):
    with pytest.raises(InputError, match=f"^{said}") as caught:
        build()
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("horizon", [np.inf, np.nan])
def test_laws_end_at_a_time_that_is_a_number(horizon):
    with pytest.raises(InputError, match=f"^system.until: expected a time after 0, got {horizon}$"):
        VaryingSystem(laws()[0], horizon)
    with pytest.raises(InputError, match=f"^system.pieces.1.until: expected a time after 1, got {horizon}$"):
        VaryingSystem(laws()[0], horizon, later=((1.0, laws()[1]),))


def test_what_is_no_piece_is_called_by_what_made_it():
    undriven = VaryingSystem.of([["t"]], [[1.0]], 2.0)
    for plant, kind in ((varying(), "Varying"), (undriven, "Varying"), (switched(), "Switched")):
        with pytest.raises(InputError, match=f"^system.pieces.0: expected .* without delay, got {kind}System$"):
            SwitchedSystem([(1.0, plant)])


@pytest.mark.parametrize("delay", [-1.0, np.nan, np.inf, True, "1", None])
def test_a_delay_is_a_finite_time(delay):
    for build in (lambda: OSCILLATOR.with_delay(delay), lambda: SwitchedSystem([(1.0, OSCILLATOR)], delay)):
        with pytest.raises(InputError, match=r"^system.delay: expected a finite time, not negative, got "):
            build()
    assert [OSCILLATOR.with_delay(one).delay for one in (0, 2, np.float64(0.5), np.int64(3))] == [0.0, 2.0, 0.5, 3.0]


def test_phases_that_fill_the_horizon_but_for_rounding_are_taken():
    for system in (switched(), varying()):
        for horizon in (3.0, 3.0 * (1.0 + 0.9e-12), 3.0 * (1.0 - 0.9e-12)):
            system.check_horizon(horizon)
        for horizon in (3.0 * (1.0 + 1.2e-12), 3.0 * (1.0 - 1.2e-12)):
            with pytest.raises(InputError):
                system.check_horizon(horizon)
    OSCILLATOR.check_horizon(17.0)
    SwitchedSystem([(2e-11, OSCILLATOR), (2.0, OSCILLATOR)]).check_horizon(2.0)


def test_parameters_beside_the_time_are_p1_and_so_on_unless_they_are_named():
    system = VaryingSystem.of([["-p1*t"]], [["p2"]], 1.0, parameters=Box([0.0, 1.0], [1.0, 2.0]))
    assert tuple(system.names) == ("p1", "p2")
    defined = VaryingSystem.of([["-w*t"]], [[1.0]], 1.0, define={"w": "2*t"})
    alike(
        matrices_at(defined, 0.5, np.zeros(0)),
        {"A": [[-0.5]], "B": [[1.0]], "E": [[1.0]], "c": np.zeros((1, 0))},
    )


def test_a_system_is_shown_by_what_makes_it():
    plain = LinearSystem([[0.5]], [[1.0]])
    assert repr(plain) == "LinearSystem(A=[[0.5]], B=[[1.]], E=[[1.]], delay=0)"
    assert repr(plain.with_delay(0.5)) == "LinearSystem(A=[[0.5]], B=[[1.]], E=[[1.]], delay=0.5)"
    bounded = plain.with_parameters(Box([0.0], [1.0]))
    assert repr(bounded).splitlines()[0] == "LinearSystem"
    assert "  parameters: Box(lower=[0.], upper=[1.])" in repr(bounded).splitlines()
    assert repr(switched(0.5)).splitlines()[:2] == ["SwitchedSystem", "  phases: [Phase, Phase, Phase]"]
    assert repr(varying(0.5)).startswith("VaryingSystem(phases=[Phase, Phase, Phase], parameters=Box(")
    problem = OptimalControlProblem(system=plain, horizon=1.0, initial_state=[1.0], control=Box([-1.0], [1.0]))
    assert "  system: LinearSystem(A=[[0.5]], B=[[1.]], E=[[1.]], delay=0)" in repr(problem).splitlines()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_of_a_system_is_the_same_plant(copied):
    A, B, E, c = factors()
    late = varying(0.25).remaining(0.5, 2.5)
    units = late.in_units(A, B, E, np.ones(1), c, 0.5)
    steady = SwitchedSystem([(1.0, OSCILLATOR), (3.0, FALLING)]).in_time(3.0)
    for system in (late, units, steady):
        other = copied(system)
        assert type(other) is type(system) and other.horizon == system.horizon and other.delay == system.delay
        parameter = np.full(system.parameter_count, 0.3)
        alike(matrices_at(other, 0.75, parameter), matrices_at(system, 0.75, parameter))


def test_a_plant_is_constant_where_one_set_of_matrices_holds_all_the_time():
    undriven = VaryingSystem.of([["t"]], [[1.0]], 2.0)
    assert OSCILLATOR.is_constant and UNCERTAIN.is_constant and OSCILLATOR.with_delay(0.5).is_constant
    assert not switched().is_constant and not varying().is_constant and not undriven.is_constant
