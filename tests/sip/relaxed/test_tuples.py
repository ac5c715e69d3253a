"""Guards sip/relaxed/tuples: ``g`` as a function of a tuple: the same whatever was evaluated before, blind to the order
of the indices, monotone, and with its gradient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sparserob_core as sr
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.relaxed.tuples import TupleLayout, TupleValue


@pytest.fixture(scope="module")
def tools():
    from sparserob_piqp import Piqp
    from sparserob_regularisers import Ridge

    return Piqp(), Ridge()


def oscillator(formulation, pieces=12):
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0, 1.0], [-2.0, -0.5]], [[0.0], [1.0]]),
        horizon=5.0,
        initial_state=[-1.0, 1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.06, -0.06], [0.06, 0.06]),
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), 0.3)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )
    dictionary = sr.load_registry().build("dictionary", "piecewise_constant", {"pieces": pieces}).build(5.0)
    return sr.transcribe(problem, control=dictionary, disturbance=dictionary, formulation=formulation)


def value(program, tools, count, epsilon=0.1):
    solver, regulariser = tools
    g = TupleValue(program, RelaxedProgram(program, solver, regulariser), count)
    g.epsilon = epsilon
    return g


def drawn(g, rng):
    return rng.uniform(g.domain.lower, g.domain.upper)


def moved(g, point, rng, blocks):
    """The point with some of its indices drawn anew."""
    point = point.copy().reshape(-1, g.block)
    which = rng.choice(len(point), min(blocks, len(point)), replace=False)
    point[which] = rng.uniform(g.layout.slot.lower, g.layout.slot.upper, (len(which), g.block))
    return point.ravel()


@pytest.mark.first(1)
@pytest.mark.parametrize("formulation", ["reduced", "literal"])
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), epsilon=st.sampled_from([1.0, 0.1, 1e-3]))
def test_a_walk_with_memory_gives_the_values_of_a_fresh_start(tools, formulation, seed, epsilon):
    rng, program = np.random.default_rng(seed), oscillator(formulation)
    walking = value(program, tools, 6, epsilon)
    point, earlier = drawn(walking, rng), []
    for _ in range(8):
        point = (
            earlier[rng.integers(len(earlier))]
            if earlier and rng.random() < 0.3
            else moved(walking, point, rng, rng.integers(0, 4))
        )
        earlier.append(point)
        assert walking.at(point) == pytest.approx(value(program, tools, 6, epsilon).at(point), abs=3e-8)


def test_the_value_is_that_of_the_relaxed_program_with_every_family_at_every_index(tools):
    rng, program = np.random.default_rng(1), oscillator("literal")
    g = value(program, tools, 5)
    point = drawn(g, rng)
    indices = {family.name: g.layout.indices(family, point.reshape(5, -1)) for family in program.families}
    assert g.at(point) == pytest.approx(RelaxedProgram(program, *tools).evaluate(indices, 0.1).value, abs=2e-8)


@pytest.mark.parametrize("formulation", ["reduced", "literal"])
def test_the_order_of_the_indices_changes_nothing(tools, formulation):
    rng, program = np.random.default_rng(2), oscillator(formulation)
    g = value(program, tools, 6)
    point = drawn(g, rng)
    shuffled = point.reshape(6, -1)[rng.permutation(6)].ravel()
    assert g.at(shuffled) == pytest.approx(g.at(point), abs=2e-8)


def test_one_index_more_never_lowers_the_value(tools):
    rng, program = np.random.default_rng(3), oscillator("reduced")
    more = value(program, tools, 6)
    point = drawn(more, rng)
    values = [value(program, tools, count).at(point[: count * more.block]) for count in range(1, 7)]
    assert (np.diff(values) >= -3e-8).all()


def test_only_the_rows_of_changed_indices_are_built(tools):
    program, built = oscillator("literal"), []

    def counting(family):
        return replace(family, rows=lambda indices: built.append(len(indices)) or family.rows(indices))

    program = replace(program, families=[counting(family) for family in program.families])
    rng = np.random.default_rng(4)
    g = value(program, tools, 20)
    first = drawn(g, rng)
    g.at(first)
    second = moved(g, first, rng, 1)
    for point, expected in ((second, [1, 1]), (first, []), (second, []), (moved(g, second, rng, 3), [3, 3])):
        built.clear()
        g.at(point)
        assert built == expected


def test_an_index_whose_disturbance_stays_open_is_built_again_only_where_its_time_moves(tools):
    from sparserob_core.experiment.run.inspection import _substitute_worst

    program, built = oscillator("literal"), []
    open_ = np.arange(25) > 0
    worst = [_substitute_worst(family, open_) for family in program.families]

    def watched(family):
        return replace(family, rows=lambda indices: built.append((family.name, len(indices))) or family.rows(indices))

    g, rng = value(replace(program, families=[watched(f) for f in worst]), tools, 6), np.random.default_rng(8)
    point = drawn(g, rng).reshape(6, 25)
    point[:3, 1:] = np.nan
    g.at(point.ravel())
    other = point.copy()
    other[1, 0] /= 2
    built.clear()
    g.at(other.ravel())
    assert built == [("path", 1)]
    fresh = value(replace(program, families=worst), tools, 6)
    assert g.at(other.ravel()) == pytest.approx(fresh.at(other.ravel()), rel=1e-9)


def test_a_family_that_an_index_imposes_where_it_did_before_is_not_built_again(tools):
    program, built = oscillator("reduced"), []

    def watched(family):
        return replace(family, rows=lambda indices: built.append(family.name) or family.rows(indices))

    program = replace(program, families=[watched(family) for family in program.families])
    g, rng = value(program, tools, 5), np.random.default_rng(1)
    point = drawn(g, rng)
    g.at(point)
    assert set(built) == {"path", "terminal"}
    built.clear()
    g.at(moved(g, point, rng, 1))
    assert built == ["path"]
    g.forget()
    built.clear()
    g.at(point)
    assert set(built) == {"path", "terminal"}


def test_what_the_optimum_keeps_is_not_solved_again(tools):
    program = oscillator("reduced")
    g = value(program, tools, 4)
    point = np.array([0.4, 5.0, 2.5, 3.5])
    g.at(point)
    idle = np.setdiff1d(np.arange(4), g.imposed.positions // 6)
    solves = g.relaxed.solves
    point[idle[0]] = 2.6
    before, after = g.solution, g.at(point)
    assert g.relaxed.solves == solves
    assert g.solution is before
    assert after == value(program, tools, 4).at(point)


@pytest.mark.parametrize("formulation", ["reduced", "literal"])
def test_without_what_does_not_act_the_value_is_the_same_and_without_what_does_it_is_less(tools, formulation):
    program = oscillator(formulation)
    g = value(program, tools, 5)
    point = drawn(g, np.random.default_rng(4))
    at, acts = g.at(point), g.acting()
    assert 0 < acts.sum() < 5
    slots = point.reshape(5, -1)
    idle = np.flatnonzero(~acts)
    assert value(program, tools, acts.sum()).at(slots[acts].ravel()) == pytest.approx(at, rel=1e-9)
    if formulation == "literal":  # the terminal row of a reduced tuple is that of every index
        assert value(program, tools, idle.size).at(slots[idle].ravel()) < at - 1e-6


@pytest.mark.first(1)
@pytest.mark.parametrize("formulation", ["reduced", "literal"])
def test_the_gradient_is_that_of_central_differences(tools, formulation):
    rng, program, checked = np.random.default_rng(5), oscillator(formulation, 6), 0
    g = value(program, tools, 3, 0.3)
    width = g.domain.upper - g.domain.lower
    for _ in range(12):
        point = np.clip(drawn(g, rng), g.domain.lower + 1e-4 * width, g.domain.upper - 1e-4 * width)
        g.at(point)
        slope = g.gradient(point)
        for k in np.flatnonzero(width):
            step = np.zeros(point.size)
            step[k] = 1e-5 * width[k]
            up, down, middle = g.at(point + step), g.at(point - step), g.at(point)
            if abs(up + down - 2 * middle) > 1e-3 * abs(up - down) + 1e-9:
                continue  # a kink between the two
            checked += 1
            assert slope[k] == pytest.approx((up - down) / (2 * step[k]), abs=2e-3 * (1 + np.abs(slope).max())), (
                k,
                point,
            )
    assert checked > 30


def test_a_path_that_moves_an_idle_index_has_no_slope(tools):
    g = value(oscillator("reduced"), tools, 4)
    point = np.array([0.4, 5.0, 2.5, 3.5])
    g.at(point)
    active = np.unique(g.imposed.positions[g.imposed.multipliers > 0] // 6)
    slope = g.gradient(point)
    assert not slope[np.setdiff1d(np.arange(4), active)].any()


def test_indices_that_contradict_each_other_make_the_value_infinite_with_a_proof(tools):
    def rows(t):
        return np.where(t < 0.5, 1.0, -1.0)[:, :, None], np.full((len(t), 1), -0.25)

    program = sr.SemiInfiniteProgram(
        n=1,
        q=[1.0],
        lower=-1.0,
        upper=1.0,
        families=[sr.ConstraintFamily(name="split", index_set=sr.Box([0.0], [1.0]), rows=rows)],
    )
    g = value(program, tools, 2, 0.0)
    assert g.at(np.array([0.2, 0.8])) == np.inf
    assert g.solution.status == "infeasible"
    assert g.at(np.array([0.2, 0.3])) == pytest.approx(-1.0)


def test_families_of_different_dimension_share_the_longest_index():
    def family(name, lower, upper):
        return sr.ConstraintFamily(
            name=name, index_set=sr.Box(lower, upper), rows=lambda t: (np.ones((len(t), 1, 1)), np.ones((len(t), 1)))
        )

    layout = TupleLayout([family("short", [0.5], [2.0]), family("long", [0.0, -1.0], [1.0, 1.0])], 3)
    assert layout.domain.dimension == 6
    assert layout.slot.lower.tolist() == [0.0, -1.0]
    assert layout.slot.upper.tolist() == [2.0, 1.0]
    assert layout.indices(layout.families[0], np.array([[0.1, 0.0]])).tolist() == [[0.5]]
    assert layout.indices(layout.families[1], np.array([[1.7, 0.3]])).tolist() == [[1.0, 0.3]]
