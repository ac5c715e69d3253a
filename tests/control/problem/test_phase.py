"""Guards control/problem/phase: what a phase says of its matrices, on whatever clock and in whatever units it is."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.sparse import csr_matrix

from sparserob_core.control.problem.phase import Phase, PhaseInUnits, and_time, boxed
from sparserob_core.control.sets.sets import Box, NormBall
from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.expressions.expression import ExpressionMatrix, parse_column, parse_matrix
from sparserob_core.sip.expressions.taylor import TaylorSpace

RNG = np.random.default_rng(11)
BOX = Box([0.5, -0.2], [1.5, 0.4])
UNITS = {
    "A": np.array([[2.0, 4.0], [0.5, 8.0]]),
    "B": np.array([[0.25], [16.0]]),
    "E": np.array([[2.0, 4.0, 8.0], [0.5, 1.0, 32.0]]),
    "c": np.array([[4.0], [0.125]]),
}


def A(p: Any) -> Any:
    return np.array([[0, p[1]], [-(p[0] ** 2), -np.exp(p[1])]])


def B(p: Any) -> Any:
    return np.array([[0.0], [1.0]]) / p[0]


def E(p: Any) -> Any:
    return np.array([[p[0], 2.0, 0.0], [1.0, p[1], p[0] * p[1]]])


def c(p: Any) -> Any:
    return np.array([0.0 * p[0], p[0] - p[1]])


def expressions(name: str, rows: list[list[str | float]]) -> ExpressionMatrix:
    return parse_matrix(name, rows, ("p1", "p2"))


def phases(**rest: Any) -> list[Phase]:
    """The same phase by functions and by expressions."""
    return [
        Phase(A, B, E, BOX, c=c, **rest),
        Phase(
            expressions("A", [[0, "p2"], ["-p1**2", "-exp(p2)"]]),
            expressions("B", [[0], ["1/p1"]]),
            expressions("E", [["p1", 2, 0], [1, "p2", "p1*p2"]]),
            BOX,
            c=parse_column("c", [0, "p1 - p2"], ("p1", "p2")),
            **rest,
        ),
    ]


def truth(p: Array) -> dict[str, Array]:
    """The matrices of both at one parameter, by numpy alone."""
    found = {name: np.asarray(of(p), dtype=float) for name, of in {"A": A, "B": B, "E": E, "c": c}.items()}
    return {**found, "c": found["c"][:, None]}


def values(phase: Phase, arguments: Array) -> dict[str, Array]:
    """What a phase says at one argument: of its drift by the column that `forced` makes of it."""
    found = dict(zip("ABE", (part[0] for part in phase.matrices(arguments[None])), strict=True))
    if phase.c is not None:
        found["c"] = phase.forced.matrices(arguments[None])[1][0][:, -1:]
    entries = {name: phase.entry(name) for name in found}
    for name, entry in entries.items():
        of = entry(np.array(arguments, dtype=object)) if callable(entry) else entry
        np.testing.assert_allclose(np.asarray(of, dtype=float), found[name], rtol=1e-13, atol=1e-15)
    return found


def same(found: dict[str, Array], wanted: dict[str, Array]) -> None:
    assert found.keys() == wanted.keys()
    for name, one in wanted.items():
        np.testing.assert_allclose(found[name], one, rtol=1e-13, atol=1e-15, err_msg=name)


def points(count: int = 5) -> Array:
    return RNG.uniform(BOX.lower, BOX.upper, (count, 2))


def enclosed(phase: Phase, centre: Array, radius: Array) -> None:
    """That the Taylor models over a cell hold every matrix in it."""
    space, delta = TaylorSpace(centre.size, 3), RNG.uniform(-1.0, 1.0, (20, centre.size))
    models = phase.taylor(space, centre, radius)
    for matrices, coefficients, remainder in zip(
        phase.matrices(centre + radius * delta), models[::2], models[1::2], strict=True
    ):
        said = np.einsum("km,mij->kij", space.monomials(delta), coefficients)
        assert (np.abs(said - matrices) <= remainder + 1e-13 * (1.0 + np.abs(matrices))).all()


def test_functions_and_expressions_say_what_numpy_does():
    for phase in phases():
        assert (phase.states, phase.controls, phase.disturbances, phase.count) == (2, 1, 3, 2)
        assert phase.names == ("p1", "p2") and phase.stated is phase
        for p in points():
            same(values(phase, p), truth(p))
        enclosed(phase.forced, np.array([1.0, 0.1]), np.array([0.2, 0.1]))


def test_several_points_are_as_many_matrices_and_nobody_writes_to_those_of_a_known_phase():
    phase, known = phases()[0], Phase(np.eye(2), np.ones((2, 1)))
    every = points(7)
    for k, p in enumerate(every):
        for found, name in zip(phase.matrices(every), "ABE", strict=True):
            np.testing.assert_array_equal(found[k], truth(p)[name])
    for count in (1, 3):
        for matrix in known.matrices(np.zeros((count, 0))):
            assert matrix.shape[0] == count and not matrix.flags.writeable
    assert known.count == 0 and known.domain is None and known.probes.shape == (1, 0)
    assert (known.begin, known.until, known.timed) == (0.0, np.inf, False)


def test_probes_are_a_middle_and_where_the_domain_ends():
    found = phases()[0].probes
    np.testing.assert_allclose(found[0], [1.0, 0.1])
    assert found.shape == (5, 2)
    np.testing.assert_array_equal(found[1:].max(axis=0), BOX.upper)
    np.testing.assert_array_equal(found[1:].min(axis=0), BOX.lower)


@pytest.mark.parametrize(("j", "place"), [(0, 0.5), (0, 1.5), (1, -0.2), (1, 0.4), (0, 1.0), (1, 0.1)])
def test_an_entry_without_a_value_in_the_middle_or_at_an_end_is_refused(j, place):
    def hole(p: Any) -> Any:
        return np.array([[1.0, 0.0], [np.inf if abs(p[j] - place) < 1e-9 else 0.0, 1.0]])

    for given in ({"A": hole}, {"c": lambda p: hole(p)[:, 0]}):
        with pytest.raises(InputError, match=f"system: {next(iter(given))} is not finite at .*p{j + 1} = {place:g}"):
            Phase(**{"A": A, "B": B, "E": E, "domain": BOX, **given})


def test_a_constant_expression_is_a_number_and_a_sparse_matrix_is_a_dense_one():
    phase = Phase(
        parse_matrix("A", [["2*3"]], ("p1",)), csr_matrix([[2.0]]), domain=Box([0.0], [1.0]), c=csr_matrix([[5.0]])
    )
    assert isinstance(phase.A, np.ndarray) and phase.A.dtype == float
    same(values(phase, np.array([0.5])), {"A": [[6.0]], "B": [[2.0]], "E": [[1.0]], "c": [[5.0]]})


@pytest.mark.parametrize("given", [[1.0, 2.0], [[1.0], [2.0]], np.array([1, 2]), lambda p: [1.0, 2.0]])
def test_a_drift_is_a_column_however_it_is_given(given):
    phase = Phase(np.eye(2), np.ones((2, 1)), domain=Box([0.0], [1.0]), c=given)
    np.testing.assert_array_equal(values(phase, np.array([0.3]))["c"], [[1.0], [2.0]])


def test_a_drift_of_numbers_and_functions_is_enclosed_with_the_controls():
    def mixed(p: Any) -> Any:
        return [3.0, p[0]]

    phase = Phase(np.eye(2), np.ones((2, 1)), domain=Box([0.0], [1.0]), c=mixed)
    coefficients = phase.forced.taylor(TaylorSpace(1, 1), np.array([0.5]), np.array([0.5]))[2]
    np.testing.assert_allclose(coefficients[:, :, 1], [[3.0, 0.5], [0.0, 0.5]])


def test_a_known_phase_has_its_own_matrices_without_arguments():
    known = Phase([[1.0]], [[2.0]], [[3.0]], c=[4.0])
    assert known.entry("c") is not None and Phase([[1.0]], [[2.0]]).entry("c") is None
    same(values(known, np.zeros(0)), {"A": [[1.0]], "B": [[2.0]], "E": [[3.0]], "c": [[4.0]]})


WRONG: list[tuple[Callable[[], object], str]] = [
    (lambda: Phase([[0.0]], [[1.0]], domain=3), "system.parameters: expected a convex set, such as Box.*got int"),  # type: ignore[arg-type]
    (lambda: Phase([[0.0]], [[1.0]], domain=Box([0.0], [np.inf])), "system: the set of parameters must be bounded"),
    (lambda: Phase([[0.0]], [[1.0]], names=("a",)), "system: expected 0 parameter names, got 1: a"),
    (lambda: Phase([[]], [[1.0]]), r"system: A must be a matrix of finite numbers, rows by columns, got \[\[\]\]"),
    (lambda: Phase([1.0], [[1.0]]), r"system: A must be a matrix of finite numbers, rows by columns, got \[1.0\]"),
    (lambda: Phase([[np.nan, 1.0], [0.0, 0.0]], [[1.0], [1.0]]), r"system: A must be .* got \[\[nan, 1.0\], "),
    (lambda: Phase(np.full((2, 4), np.inf), [[1.0]]), r"system: A must be .* got \[\[inf, inf, inf, inf\], "),
    (lambda: Phase(np.full((3, 3), np.inf), [[1.0]]), r"system: A must be .* got an array of shape \(3, 3\)"),
    (lambda: Phase([[0.0]], [[1.0]], np.ones((2, 1))), r"system: E must have 1 rows, as A has, got shape \(2, 1\)"),
    (lambda: Phase([[0.0]], np.ones((2, 1))), r"system: B must have 1 rows, as A has, got shape \(2, 1\)"),
    (lambda: Phase(np.ones((1, 2)), [[1.0]]), r"system: A must be square, got shape \(1, 2\)"),
    (lambda: Phase([["x"]], [[1.0]]), r"system: A must be a matrix of numbers or a function of the parameters, got "),
    (lambda: Phase(lambda p: [[1.0]], [[1.0]]), "system: A is a function of the parameters, but no set of parameters"),
    (lambda: Phase([[0.0]], [[1.0]], c=3.0), "system.c: expected 1 numbers, one per state, got 3.0"),
    (lambda: Phase([[0.0]], [[1.0]], c=[1.0, 2.0]), "system.c: expected 1 numbers, one per state, got 2"),
    (lambda: Phase([[0.0]], [[1.0]], c=[[1.0, 2.0]]), r"system.c: expected 1 .*, got shape \(1, 2\)"),
    (lambda: Phase([[0.0]], [[1.0]], c=[np.nan]), "system: c must be a matrix of finite numbers"),
    (
        lambda: Phase([[0.0]], [[1.0]], domain=Box([0.0], [1.0]), c=lambda p: p[0]),
        r"system: the function c must return a matrix, rows by columns, got ",
    ),
    (
        lambda: Phase(lambda p: np.zeros((0, 0)), [[1.0]], domain=Box([0.0], [1.0])),
        r"system: the function A must return a matrix, rows by columns, got \[\]",
    ),
    (
        lambda: Phase(lambda p: np.zeros((1 + int(p[0]), 1)), [[1.0]], domain=Box([0.0], [1.0])),
        r"system: the function A must always return shape \(1, 1\), got \(2, 1\)",
    ),
    (
        lambda: Phase(lambda p: [[{}["a"]]], [[1.0]], domain=Box([0.0], [1.0])),
        "system: the function A failed at p1 = 0.5: 'a'",
    ),
    (
        lambda: Phase(expressions("A", [["p1"]]), [[1.0]], domain=BOX, names=("a", "b")),
        "system: the expressions of A are in the parameters p1, p2, the system has a, b",
    ),
    (lambda: Phase([[0.0]], [[1.0]]).matrices(np.zeros((1, 1))), r"system: parameters must have shape \(k, 0\), got"),
]


@pytest.mark.parametrize(("build", "said"), WRONG, ids=range(len(WRONG)))
def test_what_is_wrong_is_one_sentence_that_begins_with_its_key(build, said):
    with pytest.raises(InputError, match=f"^{said}") as caught:
        build()
    assert len(str(caught.value).splitlines()) == 1


def test_a_drift_is_one_more_column_of_the_controls():
    for phase in phases(begin=1.0, until=2.0):
        forced = phase.forced
        assert forced is phase.forced and forced.c is None and (forced.begin, forced.until) == (1.0, 2.0)
        for p in points(3):
            wanted = truth(p)
            same(values(forced, p), {"A": wanted["A"], "B": np.hstack([wanted["B"], wanted["c"]]), "E": wanted["E"]})
    known = Phase([[1.0]], [[2.0]])
    assert known.forced is known


def test_a_phase_drifts_by_nothing_where_others_drift():
    known, drifts = Phase([[1.0]], [[2.0]], until=3.0), phases()[0]
    np.testing.assert_array_equal(values(known.drifting(), np.zeros(0))["c"], [[0.0]])
    assert known.drifting().until == 3.0 and drifts.drifting() is drifts


def test_between_other_times_it_has_the_same_matrices():
    for phase in (*phases(), in_units(phases()[0])):
        other = phase.between(1.0, 2.5)
        assert (other.begin, other.until) == (1.0, 2.5) and phase.between(0.0, np.inf) is phase
        assert other.between(1.0, 2.5) is other
        for p in points(2):
            same(values(other, p), values(phase, p))


@pytest.mark.parametrize("drifts", [True, False])
def test_integrals_of_the_state_and_the_control_are_more_states(drifts):
    """By the matrix exponential of a constant control: the integral of an exponential is one of a larger matrix."""
    rows, inputs = RNG.normal(size=(2, 2)), RNG.normal(size=(2, 1))
    for phase in phases():
        if not drifts:
            phase = Phase(phase.A, phase.B, phase.E, phase.domain)
        larger = phase.accumulating(rows, inputs)
        assert larger.states == 4 and (larger.c is not None) is drifts
        for p in points(2):
            wanted, found = truth(p), values(larger, p)
            zero = np.zeros((2, 1))
            below = {"B": inputs, "E": np.zeros((2, 3)), **({"c": zero} if drifts else {})}
            for name, part in below.items():
                np.testing.assert_allclose(found[name], np.vstack([wanted[name], part]), rtol=1e-14)
            start, push = RNG.normal(size=2), wanted["B"] + (wanted["c"] if drifts else 0.0)
            small = np.block([[wanted["A"], push], [np.zeros((1, 3))]])
            times, weights = np.polynomial.legendre.leggauss(20)
            states = [(expm(small * (t + 1.0) / 2.0) @ [*start, 1.0])[:2] for t in times]
            integral = sum(w / 2.0 * (rows @ x + inputs[:, 0]) for w, x in zip(weights, states, strict=True))
            drive = found["B"] + (found["c"] if drifts else 0.0)
            whole = expm(np.block([[found["A"], drive], [np.zeros((1, 5))]])) @ [*start, 0.0, 0.0, 1.0]
            np.testing.assert_allclose(whole[2:4], integral, rtol=1e-10, atol=1e-12)


def in_units(phase: Phase, arguments: Array | None = None, time: float = 4.0) -> PhaseInUnits:
    units = np.array([0.5, 8.0]) if arguments is None else arguments
    found = phase.in_units(UNITS["A"], UNITS["B"], UNITS["E"], units, UNITS["c"], time)
    assert isinstance(found, PhaseInUnits)
    return found


def scaled(matrices: dict[str, Array]) -> dict[str, Array]:
    return {name: one * UNITS[name] for name, one in matrices.items()}


def test_in_other_units_it_is_the_same_phase():
    units = np.array([0.5, 8.0])
    for phase in phases(begin=2.0, until=12.0):
        other = in_units(phase)
        assert (other.begin, other.until, other.count) == (0.5, 3.0, 2) and other.stated is phase
        assert other.describe(np.array([2.0, 0.01])) == "p1 = 1, p2 = 0.08"
        assert (other.states, other.controls, other.disturbances) == (2, 1, 3)
        for p in points(4):
            same(values(other, p / units), scaled(truth(p)))
        np.testing.assert_allclose(other.probes * units, phase.probes)
        enclosed(other, np.array([2.0, 0.0125]), np.array([0.2, 0.01]))
        enclosed(other.forced, np.array([2.0, 0.0125]), np.array([0.2, 0.01]))


def test_units_of_units_are_units_and_lead_back():
    units = np.array([0.5, 8.0])
    for phase in phases(begin=2.0, until=12.0):
        twice = in_units(in_units(phase))
        assert twice.stated is phase and (twice.begin, twice.until) == (0.125, 0.75)
        back = in_units(phase).in_units(*(1.0 / UNITS[name] for name in "ABE"), 1.0 / units, 1.0 / UNITS["c"], 0.25)
        assert (back.begin, back.until) == (2.0, 12.0)
        for p in points(3):
            same(values(twice, p / units**2), scaled(scaled(truth(p))))
            same(values(back, p), truth(p))


@pytest.mark.parametrize("drifts", [True, False])
def test_a_known_phase_in_other_units_is_a_known_phase(drifts):
    wanted = truth(np.array([1.2, 0.1]))
    known = Phase(wanted["A"], wanted["B"], wanted["E"], c=wanted["c"] if drifts else None, begin=2.0, until=12.0)
    other = known.in_units(UNITS["A"], UNITS["B"], UNITS["E"], np.zeros(0), UNITS["c"], 4.0)
    plain = known.in_units(UNITS["A"], UNITS["B"], UNITS["E"], np.zeros(0))
    assert (other.begin, other.until) == (0.5, 3.0) and (plain.begin, plain.until) == (2.0, 12.0)
    found = scaled(wanted)
    same(values(other, np.zeros(0)), found if drifts else {name: found[name] for name in "ABE"})
    if drifts:
        np.testing.assert_array_equal(values(plain, np.zeros(0))["c"], wanted["c"])
    assert (plain.c is None) is not drifts


def test_units_of_the_drift_and_the_time_are_1_unless_given():
    for phase in (phases(until=3.0)[0], in_units(phases(until=12.0)[0])):
        plain = phase.in_units(np.ones((2, 2)), np.ones((2, 1)), np.ones((2, 3)), np.ones(2))
        assert plain.until == 3.0
        same(values(plain, np.array([1.0, 0.01])), values(phase, np.array([1.0, 0.01])))


def test_what_becomes_of_a_phase_in_units_becomes_of_the_one_that_it_is_stated_by():
    box = Box([1.0, -0.01], [2.0, 0.03])
    for phase in phases(begin=2.0, until=12.0):
        other = in_units(phase)
        later = other.between(1.0, 2.0)
        assert (later.stated.begin, later.stated.until) == (4.0, 8.0)
        again = in_units(later)
        assert (again.begin, again.until) == (0.25, 0.5)
        smaller = other.within(box, ("p1", "p2"))
        assert smaller.domain is box and other.within(other.domain, ("p1", "p2")) is other
        assert isinstance(smaller.stated.domain, Box)
        np.testing.assert_array_equal(smaller.stated.domain.lower, [0.5, -0.08])
        np.testing.assert_array_equal(smaller.stated.domain.upper, [1.0, 0.24])
        plain = in_units(Phase(phase.A, phase.B, phase.E, BOX)).drifting()
        forced = plain.forced.matrices(np.array([[2.0, 0.01]]))[1][0]
        np.testing.assert_array_equal(forced[:, 1:], np.zeros((2, 1)))
        assert other.drifting() is other and plain.c is not None


def timed(*rest: Any) -> Phase:
    """The phase of functions whose first parameter is the time."""
    return Phase(A, B, E, BOX, ("t", "k"), c, 0.5, 1.5, True, *rest)


@pytest.mark.parametrize("units", [False, True])
def test_at_one_parameter_it_is_a_known_phase_in_time(units):
    phase, time = (in_units(timed(), np.array([4.0, 8.0])), 4.0) if units else (timed(), 1.0)
    parameter = np.array([0.3 / (8.0 if units else 1.0)])
    known = phase.at(parameter)
    assert known.timed and known.names == ("t",) and (known.begin, known.until) == (0.5 / time, 1.5 / time)
    assert isinstance(known.domain, Box) and known.domain.upper.tolist() == [1.5 / time]
    for t in (0.5, 0.9, 1.5):
        wanted = truth(np.array([t, 0.3]))
        same(values(known, np.array([t / time])), scaled(wanted) if units else wanted)
    enclosed(known, np.array([1.0 / time]), np.array([0.2 / time]))


def test_a_phase_that_is_not_timed_is_known_at_one_parameter_too():
    for phase in phases(begin=2.0, until=12.0):
        known, other = phase.at(np.array([1.2, 0.1])), in_units(phase).at(np.array([2.4, 0.0125]))
        assert known.domain is None and not known.timed and (known.begin, known.until) == (2.0, 12.0)
        same(values(known, np.zeros(0)), truth(np.array([1.2, 0.1])))
        same(values(other, np.zeros(0)), scaled(truth(np.array([1.2, 0.1]))))
    assert Phase([[0.0]], [[1.0]], domain=Box([0.0], [1.0])).at(np.array([0.5])).c is None


def test_during_one_time_it_is_a_phase_of_its_parameters():
    box = Box([-0.2], [0.4])
    still = timed().during(0.7, box)
    assert not still.timed and still.names == ("k",) and still.domain is box and still.until == np.inf
    assert still.describe(np.array([0.25])) == "k = 0.25"
    for k in (-0.2, 0.1, 0.4):
        same(values(still, np.array([k])), truth(np.array([0.7, k])))
    enclosed(still, np.array([0.1]), np.array([0.2]))


@pytest.mark.parametrize("units", [False, True])
def test_expressions_of_other_arguments_are_evaluated_at_many_points_together(units, monkeypatch):
    entries = [parse_matrix("A", [["k*sin(t)", "2"], ["t - k", "k^2"]], ("t", "k"))] * 3
    phase = Phase(*entries, BOX, ("t", "k"), None, 0.5, 1.5, True)
    if units:
        phase = phase.in_units(UNITS["A"], UNITS["A"], UNITS["A"], np.array([4.0, 8.0]), 1.0, 4.0)
    still, points = phase.during(0.7 / (4.0 if units else 1.0), Box([-0.02], [0.04])), np.linspace(-0.02, 0.04, 9)
    one_by_one = [np.array(still.entry("A")(np.array([k])), dtype=float) for k in points]
    monkeypatch.setattr(ExpressionMatrix, "__call__", lambda *_: pytest.fail("a point was evaluated alone"))
    for table in still.matrices(points[:, None]):
        np.testing.assert_allclose(table, one_by_one, rtol=1e-14)
    k = points[3] * (8.0 if units else 1.0)
    wanted = np.array([[k * np.sin(0.7), 2.0], [0.7 - k, k**2]]) * (UNITS["A"] if units else 1.0)
    np.testing.assert_allclose(still.matrices(points[3:4, None])[0][0], wanted, rtol=1e-14)


def test_later_its_clock_begins_again():
    phase = timed()
    late = phase.later(0.0, 0.5, 1.0)
    assert (late.begin, late.until, late.timed, late.names) == (0.0, 0.5, True, ("t", "k"))
    assert isinstance(late.domain, Box)
    np.testing.assert_array_equal(late.domain.lower, [0.0, -0.2])
    np.testing.assert_array_equal(late.domain.upper, [0.5, 0.4])
    argument = np.array([0.25, 0.3])
    same(values(late, argument), truth(np.array([1.25, 0.3])))
    assert argument.tolist() == [0.25, 0.3]  # which belongs to who asks
    same(values(late.later(0.0, 0.25, 0.25), np.array([0.125, 0.3])), truth(np.array([1.375, 0.3])))
    still = Phase([[0.0]], [[1.0]], until=3.0)
    assert (still.later(1.0, 2.0, 0.5).begin, still.later(1.0, 2.0, 0.5).until) == (1.0, 2.0)


def test_in_time_its_matrices_stay_the_same():
    for phase in (*phases(begin=0.5), in_units(phases(begin=2.0)[0])):
        moved = phase.in_time(3.0)
        assert moved.timed and moved.names == ("t", "p1", "p2") and (moved.begin, moved.until) == (0.5, 3.0)
        assert isinstance(moved.domain, Box) and isinstance(phase.domain, Box)
        np.testing.assert_array_equal(moved.domain.lower, [0.5, *phase.domain.lower])
        np.testing.assert_array_equal(moved.domain.upper, [3.0, *phase.domain.upper])
        assert moved.describe(np.array([0.25, 0.125])) == "p1 = 0.25, p2 = 0.125"
        for t in (0.5, 2.0):
            same(values(moved, np.array([t, 1.0, 0.05])), values(phase, np.array([1.0, 0.05])))
    known = Phase([[1.0]], [[2.0]]).in_time(2.0)
    assert known.names == ("t",) and known.count == 1
    with pytest.raises(InputError, match=r"system.parameters: expected a bounded box beside the time t.* got normball"):
        Phase([[0.0]], [[1.0]], domain=NormBall(2.0, 1.0, dimension=2)).in_time(2.0)


def test_within_other_parameters_it_keeps_the_name_of_the_time():
    box = Box([0.0], [0.1])
    phase = Phase(A, B, E, BOX, ("s", "k"), None, 0.5, 1.5, True)
    smaller = phase.within(box, ("k",))
    assert smaller.names == ("s", "k") and isinstance(smaller.domain, Box)
    np.testing.assert_array_equal(smaller.domain.lower, [0.5, 0.0])
    np.testing.assert_array_equal(smaller.domain.upper, [1.5, 0.1])
    still = phases()[0]
    assert still.within(BOX, ("p1", "p2")) is still
    other = still.within(Box([0.6, 0.0], [0.7, 0.1]), ("a", "b"))
    assert other.names == ("a", "b") and other.describe(np.array([0.6, 0.0])) == "a = 0.6, b = 0"


def test_a_set_beside_the_time_is_a_bounded_box():
    box = Box([-0.5, -0.5], [0.5, 0.5])
    assert boxed(box) is box
    for convex in (NormBall(2.0, 1.0, dimension=2), Box([0.0], [np.inf])):
        with pytest.raises(InputError, match=r"system.parameters: expected a bounded box beside the time t"):
            boxed(convex)
    assert and_time(1.0, 2.0, None).upper.tolist() == [2.0]
    assert and_time(1.0, 2.0, Box([3.0], [4.0])).lower.tolist() == [1.0, 3.0]


def apart(places: dict[tuple[int, int], tuple[float, float]], base: Array) -> Callable[[Any], Any]:
    """A function that is other numbers for floats than for Taylor models, at some places."""

    def function(p: Any) -> Any:
        numbers = isinstance(p[0], float)
        found = np.array(base, dtype=object)
        for place, (one, other) in places.items():
            found[place] = (one if numbers else other) + 0.0 * p[0]
        return found

    return function


@pytest.mark.parametrize(("one", "other"), [(-1.0, -9.0), (-9.0, -1.0), (1.0, 1.0 + 2e-9), (1.0, 1.0 - 2e-9)])
def test_one_entry_that_is_another_for_taylor_models_is_named(one, other):
    phase = Phase(apart({(0, 1): (one, other)}, np.zeros((2, 2))), np.ones((2, 1)), domain=Box([-0.5], [0.5]))
    with pytest.raises(InputError) as caught:
        phase.taylor(TaylorSpace(1, 2), np.zeros(1), np.full(1, 0.5))
    said = f"got {one:.9g} and then {other:.9g} in row 1, column 2, at p1 = 0"
    assert str(caught.value).startswith("system.A: expected a function that depends on its argument alone")
    assert said in str(caught.value)


@pytest.mark.parametrize("size", [1000.0, -1000.0])
def test_what_differs_by_rounding_of_the_largest_entry_is_the_same(size):
    places = {(0, 1): (0.0, 1e-7), (1, 0): (size, size * (1.0 + 1e-10))}
    phase = Phase(apart(places, np.zeros((2, 2))), np.ones((2, 1)), domain=Box([-0.5], [0.5]))
    phase.taylor(TaylorSpace(1, 2), np.zeros(1), np.full(1, 0.5))


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda p: np.array([[p[0]]]) if isinstance(p[0], float) else np.array([[p[0], p[0]]]), "returns shape"),
        (lambda p: [[1.0 if isinstance(p[0], float) else "1"]], "returned str for an entry, expected a number"),
        (lambda p: [[np.log(p[0])]], "A: "),
        (lambda p: [[float(p[0])]], "cannot be enclosed over parameters"),
    ],
)
def test_what_is_no_enclosure_says_why(function, said):
    phase = Phase(function, [[1.0]], domain=Box([0.1], [1.0]))
    with pytest.raises(NotEnclosable, match=f"system: .*{said}"):
        phase.taylor(TaylorSpace(1, 2), np.array([0.5]), np.array([0.6]))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_a_copy_says_the_same(copied):
    late = timed().later(0.0, 0.5, 1.0)
    for phase, argument in (
        (phases()[0], [1.0, 0.1]), (in_units(phases()[0]), [2.0, 0.01]), (late, [0.25, 0.3]),
        (timed().at(np.array([0.3])), [0.9]), (phases()[0].in_time(2.0), [0.5, 1.0, 0.1]),
    ):  # fmt: skip
        same(values(copied(phase), np.array(argument)), values(phase, np.array(argument)))


def test_a_phase_is_shown_by_what_was_given():
    shown = repr(Phase([[1.0]], [[2.0]]))
    assert shown == "Phase(A=[[1.]], B=[[2.]], E=[[1.]], begin=0, until=inf, timed=False)"
