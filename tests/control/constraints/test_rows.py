"""Guards control/constraints/state, literal, feedback: one row of an index by itself is that of all of
them, a literal index holds the disturbance that is the worst, and deviations that are told reach what is told."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.control.constraints.feedback import FeedbackConstraint
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.sets import Box, Equality
from tests.control.constraints.test_answers import drawn, family, model
from tests.support.families import program

OPEN = ["known", "parametric", "taking turns", "measurable"]
UNITS = Units(8.0, np.array([2.0, 4.0]), np.array([16.0]), np.ones(1), np.array([0.5]), 1.0)


def indices(one, rng, count=5):
    box = one.index_set
    return rng.uniform(box.lower, box.upper, size=(count, box.dimension))


@pytest.mark.parametrize("kind", OPEN)
def test_one_row_of_each_index_is_that_of_all_rows(kind):
    rng, made = np.random.default_rng(1), program(kind)
    x = rng.normal(size=made.n)
    for one in (one for one in made.families if isinstance(one.source, StateConstraint)):
        at, source = indices(one, rng), one.source
        G, rhs = source.rows(at)
        rows = rng.integers(0, rhs.shape[1], size=len(at))
        mine = np.arange(len(at)), rows
        chosen = source.chosen(at, rows)
        assert chosen[0] == pytest.approx(G[mine], abs=1e-13) and chosen[1] == pytest.approx(rhs[mine], abs=1e-13)
        assert source.at(x, at) == pytest.approx(G @ x - rhs, abs=1e-12)
        assert source.violations(x, at, rows) == pytest.approx((G @ x - rhs)[mine], abs=1e-12)
        normals = source.normals_at(at[0])
        directions = source.functionals_at(at[:1])[1]
        assert (normals[:, :2] == directions).all()
        told, units = source.normals_in(UNITS)
        assert units.tolist() == ([2.0, 4.0] if source.gains is None else [2.0, 4.0, 16.0])
        assert told.shape[1] == units.size
        assert source.index_units(UNITS).tolist() == [8.0, 0.5]


def test_a_row_is_about_the_states_that_it_looks_at():
    made = {one.name: one.source for one in program("known").families}
    assert made["path"].states_of(0).tolist() in ([True, False], [False, True])
    every = np.array([made["path"].states_of(row) for row in range(4)])
    assert every.sum() == 4 and every.any(axis=0).all()
    assert made["mixed"].states_of(0).tolist() == [True, True] and made["mixed"].states_of(1).tolist() == [False, True]
    assert made["curved"].states_of(0).tolist() == [True, True]
    assert not made["path"].states_of(9).any()


@pytest.mark.parametrize("kind", ["known", "parametric"])
def test_a_literal_index_holds_the_worst_disturbance_and_none_is_worse(kind):
    rng, made = np.random.default_rng(2), program(kind)
    x = rng.normal(size=made.n)
    for reduced in made.families:
        one = reduced.formulated("literal")
        if reduced.name not in ("path", "mixed", "curved") or one is None:
            continue
        found, plainly = one.worst(x), reduced.worst(x)
        few = slice(0, 4)
        assert found.bound == pytest.approx(plainly.bound)
        real = one.violations(x, found.indices[few])[np.arange(len(found.rows[few])), found.rows[few]]
        assert real == pytest.approx(found.violations[few], abs=1e-9)
        assert found.violations == pytest.approx(plainly.violations)
        at = indices(one, rng, 4)
        free = at.shape[1] - reduced.index_set.dimension
        plain = np.delete(at, np.arange(1, 1 + free), axis=1)
        values = reduced.violations(x, plain)
        worst = one.steepest(x, at, np.full(4, -1))
        assert worst.rows.tolist() == values.argmax(axis=1).tolist()
        assert worst.violations == pytest.approx(values.max(axis=1), abs=1e-9)
        assert (np.delete(worst.indices, np.arange(1, 1 + free), axis=1) == plain).all()
        reached = one.violations(x, worst.indices)[np.arange(4), worst.rows]
        assert reached == pytest.approx(worst.violations, abs=1e-9)
        rows = np.array([rng.integers(0, values.shape[1]) for _ in range(4)])
        of_rows = one.steepest(x, at, rows)
        assert of_rows.rows.tolist() == rows.tolist()
        assert of_rows.violations == pytest.approx(values[np.arange(4), rows], abs=1e-9)
        assert (one.violations(x, at)[np.arange(4), rows] <= of_rows.violations + 1e-12).all()
        assert one.explain(at[0], 0).text == reduced.explain(plain[0], 0).text


@pytest.mark.parametrize("kind", ["feedback"])
def test_a_deviation_that_is_told_reaches_the_violation(kind):
    """The row at the worst deviation, with what the control adds to it then, is as far beyond its limit as is told."""
    rng, made = np.random.default_rng(3), program(kind)
    x = rng.normal(size=made.n)
    looked = 0
    for one in made.families:
        source = one.source
        if not isinstance(source, StateConstraint):
            continue
        loop = next(f.source.loop for f in made.families if f.name == "control")
        held = FeedbackConstraint.of(source, loop)
        for index in indices(one, rng, 2):
            values = one.violations(x, index[None])[0]
            for row, value in enumerate(values):
                w, beside = held.against(x, index, row)
                assert (np.abs(w) <= loop.spread.radii + 1e-12).all()
                _, directions, _, bounds = source.functionals_at(index[None])
                states = loop.states(x, index[:1])[0]
                reached = directions[row] @ (states[:, 0] + states[:, 1:] @ w)
                if source.gains is None:
                    assert beside == 0.0
                else:
                    control = loop.controls(x)[source.commanded(index[:1])[0, row]]
                    assert beside == pytest.approx(source.gains[row] @ (control[:, 0] + control[:, 1:] @ w))
                assert reached + beside - bounds[row] == pytest.approx(value, abs=1e-9)
                looked += 1
    assert looked > 20


def test_fixed_states_are_met_for_every_deviation_or_said_to_be_out_of_reach():
    """The last disturbance enters after the last measurement: where there is none, an equality can be met."""
    late = model(terminal=[Equality([0.2, None])], blocks=3)
    one = family(late, "equals")
    said = one.explain(np.array([2.0]), 0).text
    assert said.endswith("(what comes after the last measurement, at 1.33333 s, reaches it unanswered)"), said
    early = model(terminal=[Equality([0.2, None])], disturbance=None, control=Box([-9.0, -9.0], [9.0, 9.0]))
    one = family(early, "equals")
    assert "unanswered" not in one.explain(np.array([2.0]), 0).text
    x, _ = drawn(early, 4)
    met = one.source.met(x)
    rows = one.uncertain(np.array([2.0]))
    assert rows.exact and np.abs(rows.excess(x, early.program.spread)).max() > 1e-3
    assert rows.excess(met, early.program.spread) == pytest.approx(np.zeros(2), abs=1e-12)
    rng = np.random.default_rng(5)
    table, rhs = rows.equations
    assert table @ met == pytest.approx(rhs, abs=1e-12)
    null = np.eye(met.size) - np.linalg.pinv(table.toarray()) @ table.toarray()
    for _ in range(5):  # no other decision that meets them is nearer
        other = met + null @ rng.normal(size=met.size)
        assert table @ other == pytest.approx(rhs, abs=1e-9)
        assert np.linalg.norm(other - x) > np.linalg.norm(met - x)
