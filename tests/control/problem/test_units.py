"""Guards control/term.py, control/problem/units.py and `in_units` of sets and systems: other units, the same thing in
other numbers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.control.problem.cost import Quadratic
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.problem.terms.integral import Accumulated
from sparserob_core.control.problem.terms.repeat import Return
from sparserob_core.control.problem.units import Units, power_of_two
from sparserob_core.control.sets.sets import Box, Cylinder, Ellipsoid, NormBall, Polytope
from sparserob_core.control.term import TERMS, TIME, UNITLESS, Term, measured
from sparserob_core.sip.expressions.expression import parse_matrix
from sparserob_core.sip.expressions.taylor import TaylorSpace

SETS = [
    Box(np.array([-1.0, 0.5]), np.array([2.0, 0.75])),
    Polytope(np.array([[1.0, 1.0], [-1.0, 2.0], [0.0, -3.0]]), np.array([1.0, 2.0, 3.0])),
    Ellipsoid(np.array([0.5, -1.0]), np.array([[2.0, 0.3], [0.3, 0.1]])),
    NormBall(2.0, 0.7, np.array([0.1, 0.2])),
    NormBall(3.0, 0.7, np.array([0.1, 0.2])),
    NormBall(1.0, 0.7, np.array([0.1, 0.2])),
    NormBall(np.inf, 0.7, np.array([0.1, 0.2])),
]


@pytest.mark.parametrize("convex", SETS, ids=lambda convex: type(convex).__name__)
def test_a_set_in_other_units_holds_the_same_points(convex):
    rng, units = np.random.default_rng(3), np.array([2.0**-40, 2.0**17])
    other, c = convex.in_units(units), rng.normal(size=(30, 2))
    points = rng.normal(size=(200, 2)) * 1.5
    np.testing.assert_allclose(other.support(c * units), convex.support(c), rtol=1e-12)
    np.testing.assert_allclose(other.support_point(c * units) * units, convex.support_point(c), rtol=1e-9, atol=1e-12)
    inside = convex.contains(points, 0.0)
    np.testing.assert_array_equal(other.contains(points / units, 0.0), inside)
    np.testing.assert_allclose(convex.in_units(units).in_units(1 / units).support(c), convex.support(c), rtol=1e-12)


@pytest.mark.parametrize("convex", SETS[2:5], ids=lambda convex: type(convex).__name__)
def test_the_frame_of_a_curved_set_is_round_and_follows_its_units_exactly(convex):
    rng, units = np.random.default_rng(4), np.array([2.0**-30, 2.0**9])
    z = rng.normal(size=(100, 2))
    z /= np.linalg.norm(z, axis=1)[:, None]
    c = z @ convex.frame
    room = convex.support(c) - c @ convex.interior_point()
    assert room.max() <= 2.0 * room.min()
    np.testing.assert_array_equal(convex.in_units(units).frame, convex.frame * units)
    tall = Cylinder(convex, 3)
    np.testing.assert_array_equal(tall.frame[:, :2], convex.frame)
    np.testing.assert_array_equal(tall.frame[:, 2], 0.0)


def test_an_ellipsoid_that_is_thin_beyond_the_eps_is_one_still():
    thin = Ellipsoid(np.zeros(2), np.array([[1e-24, 0.5e-12], [0.5e-12, 1.0]]))
    np.testing.assert_allclose(thin.in_units(np.array([2.0**-40, 1.0])).shape[0, 0], 1e-24 * 2.0**80)


@pytest.mark.parametrize("size", [1e-300, 3e-12, 0.6, 1.0, 1.2, 1.3, 7e11])
def test_the_power_of_two_follows_its_size_exactly(size):
    unit = float(power_of_two(np.array(size)))
    assert 0.6 <= size / unit <= 1.21 and np.log2(unit) == round(np.log2(unit))
    assert power_of_two(np.array(size * 2.0**50)) == unit * 2.0**50
    assert power_of_two(np.array([0.0, np.inf])).tolist() == [1.0, 1.0]


def test_an_uncertain_system_in_other_units_is_the_same_in_values_and_taylor_models():
    names = ("p1", "p2")
    matrices = [
        parse_matrix("A", [["-1 + p1", "p2**2"], [0.0, "sin(p1)"]], names),
        parse_matrix("B", [[1.0], ["p2"]], names),
    ]
    plain = LinearSystem(*matrices, parameters=Box(np.array([1.0, 2.0]), np.array([1.5, 4.0])), names=names)
    d, m, w, p = np.array([4.0, 0.5]), np.array([8.0]), np.array([0.25, 2.0]), np.array([0.5, 1024.0])
    rate = 16.0 / d[:, None]
    factors = (rate * d, rate * m, rate * w)
    other = plain.in_units(*factors, p)
    points = np.array([[1.0, 2.0], [1.5, 3.0]])
    for ours, theirs, factor in zip(
        other.phases[0].matrices(points / p), plain.phases[0].matrices(points), factors, strict=True
    ):
        np.testing.assert_array_equal(ours, theirs * factor)
    middle, radius = np.array([1.25, 3.0]), np.array([0.25, 1.0])
    space = TaylorSpace(2, 3)
    found, wanted = other.phases[0].taylor(space, middle / p, radius / p), plain.phases[0].taylor(space, middle, radius)
    for ours, theirs, name in zip(found, wanted, "AABBEE", strict=True):
        np.testing.assert_array_equal(ours, theirs * factors["ABE".index(name)])
    assert other.describe(points[0] / p) == plain.describe(points[0])


KNOWN = {
    sr.OptimalControlProblem, sr.PathConstraint, sr.MixedConstraint, sr.IntegralConstraint, Accumulated, Return,
    sr.Cost, Quadratic, sr.Measurements,
}  # fmt: skip


def kinds(term: type) -> set[type]:
    """Every term that there is."""
    own = {term} if is_dataclass(term) and term.__module__.startswith("sparserob_core") else set()
    return own.union(*(kinds(one) for one in term.__subclasses__()))


def test_every_field_of_every_term_says_its_unit_and_what_is_left_of_it() -> None:
    assert kinds(Term) == KNOWN
    told = [(one, each) for one in KNOWN for each in fields(one)]
    assert not [(one, each.name) for one, each in told if not {"in_units", "remaining"} <= set(each.metadata)]
    assert {each.name for _, each in told if each.metadata == UNITLESS} == {one.split(".")[-1] for one in NUMBERS}


# What has no unit, by its field: shares, choices, and what a row of the user's is bounded by in the user's own unit.
NUMBERS = {
    "disturbance_class", "title", "names", "repeat", "execution", "commanded", "path.name", "path.h", "integral.lower",
    "integral.upper", "integral.name", "cost.group", "cost.l1", "disturbances",
}  # fmt: skip


def problems() -> list[sr.OptimalControlProblem]:
    """Problems that have, together, every field, each with numbers that are not what a field has by default."""
    system: dict[str, Any] = {
        "system": sr.LinearSystem(
            [[0.5, 2.0], [-3.0, 0.25]], [[0.75], [1.5]], E=[[1.25], [0.5]], c=[0.5, 3.0], delay=0.5
        ),
        "horizon": 3.0,
        "initial_state": [1.5, -0.5],
        "initial_set": sr.Box([-0.25, -0.75], [0.25, 0.75]),
        "control": sr.Box([-3.0], [1.25]),
        "disturbance": sr.Box([-0.5], [0.5]),
        "initial_control": [0.75],
        "title": "all of it",
    }
    path = [
        sr.PathConstraint(sr.Box([-7.0, -9.0], [7.0, 5.0]), 0.5, 2.5, "wall", [[0.0, 0.5, 0.25], [3.0, 1.5, 0.75]]),
        sr.MixedConstraint([[1.0, 3.0]], [[2.0]], [9.0], 0.75, 1.75, "mixed"),
    ]
    weight = [[3.0, 1.0], [1.0, 5.0]]
    cost = sr.Cost(l1=0.5, state={"Q": weight, "reference": [1.5, 2.5]}, control={"R": [[7.0]]}, final={"Q": weight})
    return [
        sr.OptimalControlProblem(
            **system, path=path, terminal=[sr.Box([-5.0, -3.0], [3.0, 7.0])], weights=[1.5], cost=cost,
            control_step=sr.Box([-0.75], [0.75]), names=sr.Names(time="s"),
            measurements=sr.Measurements([[1.25, 0.5]], sr.Box([-0.5], [0.25]), 0.75),
        ),
        sr.OptimalControlProblem(
            **system, integral=[sr.IntegralConstraint([[1.0, 3.0]], [[5.0]], [-7.0], [11.0], 0.5, 2.5, "sum")],
        ),
        sr.OptimalControlProblem(**system, disturbance_class="measurable"),
        sr.OptimalControlProblem(
            system=sr.LinearSystem([[0.5, 2.0], [-3.0, 0.25]], [[0.75], [1.5]]), horizon=3.0, initial_state=[1.5, -0.5],
            control=sr.Box([-3.0], [1.25]), execution=[0.125], commanded=(1,),
        ),
        sr.OptimalControlProblem(
            system=sr.LinearSystem([[0.5, 2.0], [-3.0, 0.25]], [[0.75], [1.5]]), horizon=3.0, initial_state=[1.5, -0.5],
            control=sr.Box([-3.0], [1.25]), jitter=0.375,
        ),
        sr.OptimalControlProblem(
            system=sr.LinearSystem([[0.5, 2.0], [-3.0, 0.25]], [[0.75], [1.5]]), horizon=3.0, initial_state=[1.5, -0.5],
            control=sr.Box([-3.0], [1.25]),
            disturbances=[sr.Disturbance(sr.Box([-0.5], [0.5]), [[1.25], [0.5]], breakpoints=[0.0, 1.25, 3.0])],
        ),
    ]  # fmt: skip


def numbers(record: Any, path: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every number of a record, with the fields that lead to it."""
    if isinstance(record, sr.System):
        yield from (
            (f"{path}.{name}", part[0])
            for name, part in zip("ABE", record.forced.phases[0].matrices(np.zeros((1, 0))), strict=True)
        )
        yield f"{path}.delay", np.array(record.delay)
    elif is_dataclass(record):
        for one in fields(record):
            yield from numbers(getattr(record, one.name), f"{path}.{one.name}".lstrip("."))
    elif isinstance(record, list | tuple) and any(is_dataclass(one) for one in record):
        for one in record:
            yield from numbers(one, path)
    elif record is not None and not isinstance(record, str | bool):
        values = np.asarray(record)
        if values.dtype.kind in "fi" and values.size:
            yield path, values.astype(float)


def test_every_number_of_every_record_of_a_problem_is_converted_or_has_no_unit():
    units = Units(2.0, np.array([8.0, 0.125]), np.array([32.0]), np.array([0.5]), np.zeros(0), 128.0)
    back = Units(*(1.0 / np.asarray(getattr(units, one.name)) for one in fields(Units)))
    met = set[str]()
    for problem in problems():
        other = units.of_problem(problem)
        mine, its, again = (list(numbers(one)) for one in (problem, other, back.of_problem(other)))
        assert [path for path, _ in mine] == [path for path, _ in its]
        for (path, value), (_, converted), (_, returned) in zip(mine, its, again, strict=True):
            np.testing.assert_array_equal(returned, value, err_msg=path)
            assert np.array_equal(converted, value) == (path in NUMBERS or not value.any()), path
            met.add(path.split(".")[0])
        met |= {one.name for one in fields(problem) if isinstance(getattr(problem, one.name), str | sr.Names)}
    left = {one.name for one in fields(sr.OptimalControlProblem)} - met
    assert left <= {"disturbances", "repeat"}, left


def quantities(problem: sr.OptimalControlProblem, x: np.ndarray, u: np.ndarray, time: float) -> dict[str, np.ndarray]:
    """What a problem says of a state and a control that last for so long."""
    state, control, final = problem.cost.terms
    found = {"l1": time * (problem.weights @ np.abs(u))}
    for name, term, v, lasting in (("state", state, x, time), ("control", control, u, time), ("final", final, x, 1.0)):
        if term is not None:
            found[name] = lasting * ((v - term.reference) @ term.Q @ (v - term.reference))
    for entry in [*problem.windows, *problem.integral]:
        if not isinstance(entry, sr.PathConstraint):
            lasting = time if isinstance(entry, sr.IntegralConstraint) else 1.0
            found[entry.name] = lasting * (entry.H @ x + entry.G @ u)
    return found


def test_costs_integrals_and_rows_of_state_and_control_are_the_same_in_other_units():
    units = Units(2.0, np.array([8.0, 0.125]), np.array([32.0]), np.array([0.5]), np.zeros(0), 128.0)
    x, u, met = np.array([1.25, -0.75]), np.array([1.5]), set[str]()
    for problem in problems()[:2]:
        mine = quantities(problem, x, u, 3.0)
        its = quantities(units.of_problem(problem), x / units.states, u / units.controls, 3.0 / units.time)
        for name, value in mine.items():
            in_cost = name in ("l1", "state", "control", "final")
            np.testing.assert_allclose(its[name], value / (units.cost if in_cost else 1.0), rtol=1e-14, err_msg=name)
            met.add(name)
    assert met == {"l1", "state", "control", "final", "mixed", "sum"}


def test_what_is_left_of_a_problem_in_two_steps_is_what_is_left_of_it_in_one():
    for problem in problems():
        if not problem.integral:
            once, twice = problem.remaining(1.0, 2.0), problem.remaining(0.75, 2.25).remaining(0.25, 2.0)
            for (path, value), (_, other) in zip(numbers(once), numbers(twice), strict=True):
                np.testing.assert_allclose(other, value, rtol=1e-15, err_msg=path)
            whole = [value.tolist() for _, value in numbers(problem.remaining(0.0, 3.0))]
            assert whole == [value.tolist() for _, value in numbers(problem)]
            assert once.horizon == 2.0 and all(0.0 <= one.start <= one.stop <= 2.0 for one in once.windows)
    first, *_ = problems()
    assert [one.name for one in first.remaining(2.0, 1.0).windows] == ["wall"]  # the other one is over
    wall, mixed = (one.remaining(0.0, 0.75) for one in first.windows)
    assert wall.stop == 0.75 and mixed is None  # which has not begun
    turns = sr.SwitchedSystem([(until, sr.LinearSystem([[until]], [[1.0]])) for until in (1.0, 2.0, 3.0)])
    assert turns.remaining(0.5, 1.25).switches == (0.5,) and turns.remaining(1.0, 1.0).switches == ()
    assert first.windows[0].remaining(1.0, 2.0).relative_to.tolist() == [
        [0.0, 0.5 + 1 / 3, 0.25 + 1 / 6],
        [2.0, 1.5, 0.75],
    ]


def test_an_integral_that_has_begun_is_no_integral_any_more():
    entry = problems()[1].integral[0]
    assert (late := entry.remaining(0.25, 2.75)).start == 0.25 and late.stop == 2.25
    assert entry.remaining(2.5, 0.5) is None
    for begin, horizon in ((0.75, 2.25), (0.0, 2.0)):
        with pytest.raises(sr.InputError, match="part of an integral"):
            entry.remaining(begin, horizon)


def test_a_factor_on_a_constraint_is_one_on_its_bounds_about_their_middle():
    for entry in [*problems()[0].windows, *problems()[1].integral]:
        for wider in (entry.scaled(2.0), entry.scaled(4.0).scaled(0.5)):
            axes = np.vstack([np.eye(entry.bounds.dimension), -np.eye(entry.bounds.dimension)])
            widths = [one.bounds.support(axes).reshape(2, -1).sum(axis=0) for one in (entry, wider)]
            np.testing.assert_allclose(widths[1], 2.0 * widths[0], rtol=1e-15)
    with pytest.raises(sr.InputError, match="0 is no middle"):
        _ = sr.MixedConstraint([[1.0]], [[1.0]], [0.0]).bounds
    with pytest.raises(sr.InputError, match="no factor enlarges"):
        _ = sr.Equality([0.0]).bounds


@dataclass(frozen=True, eq=False)
class Budget(Term):
    """A fact that no problem knows: at most so much of each control per time, from a time on."""

    most: Any = field(metadata=measured(lambda of: of.controls / of.time))
    start: float = field(default=0.0, metadata=TIME)


@dataclass(frozen=True, eq=False)
class Listed(Term):
    """A record that lists such facts beside others, and has no code for any of them."""

    every: tuple[Term, ...] = field(metadata=TERMS)


def test_a_new_term_is_its_fields_and_whatever_lists_it_converts_it():
    units = Units(2.0, np.array([8.0]), np.array([32.0, 4.0]), np.zeros(0), np.zeros(0), 1.0)
    listed = Listed((Budget(np.array([64.0, 2.0]), 3.0), sr.PathConstraint(sr.Box([-8.0], [16.0]), 0.5, 1.0)))
    budget, path = listed.in_units(units).every
    assert budget.most.tolist() == [4.0, 1.0] and budget.start == 1.5 and path.set.upper.tolist() == [2.0]
    (left,) = listed.remaining(1.0, 4.0).every  # the window is over
    assert left.most.tolist() == [64.0, 2.0] and left.start == 2.0
    assert not left.most.flags.writeable
