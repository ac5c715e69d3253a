"""Guards what maximisers show of themselves beside their evaluations: what a sketch says is true of the search, and
being looked at changes nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.plugins.registry import load_own_registry
from sparserob_core.sip.events import SKETCHED, EvaluationsFinished, ignore
from sparserob_core.sip.search.search import Target, maximise

BOX = sr.Box([0.0, -1.0, 5.0], [2.0, 1.0, 5.0])  # the third coordinate cannot move
BUDGET = 300


def hills(points):
    x, y = points[:, 0], points[:, 1]
    return -np.hypot(x - 0.7, y - 0.2) + 0.3 * np.sin(7 * x) * np.cos(5 * y)


def watched(name, budget=BUDGET, **options):
    """The report of a search, and the sketches of all its events, in order, each with its role and its event."""
    events: list[EvaluationsFinished] = []
    maximiser = load_own_registry().build("maximiser", name, options)
    report = maximise(Target(hills, BOX), maximiser, budget, np.random.default_rng(0), notify=events.append)
    return report, [(role, sketch, event) for event in events for role, sketch in event.sketches.items()]


@pytest.fixture(autouse=True)
def _every_step_is_told(monkeypatch):
    monkeypatch.setattr("sparserob_core.sip.search.notifier.SECONDS_BETWEEN_EVENTS", -1.0)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("name", "role", "options"),
    [
        ("sequool", "cells opened", {}),
        ("direct", "rectangles, the best ones", {}),
        ("adalipo", "excluded", {}),
        ("maxlipo", "trust region", {}),
        ("dual_annealing", "the best in turn", {}),
    ],
)
def test_sketches_are_in_the_box_and_being_looked_at_changes_nothing(name, role, options):
    report, shown = watched(name, 120, **options)
    mine = [sketch for told, sketch, _ in shown if told == role]
    assert mine
    for sketch in mine:
        assert sketch.lower.shape == sketch.upper.shape and sketch.lower.shape[1] == 3
        assert 1 <= len(sketch.lower) <= SKETCHED and (sketch.lower <= sketch.upper).all()
        if not sketch.rounded:  # of a ball that is excluded a part may lie beyond the box
            assert (sketch.lower >= BOX.lower).all() and (sketch.upper <= BOX.upper).all()
        assert (sketch.lower[:, 2] == 5.0).all() and (sketch.upper[:, 2] == 5.0).all()
    maximiser = load_own_registry().build("maximiser", name, options)
    alone = maximise(Target(hills, BOX), maximiser, 120, np.random.default_rng(0), notify=ignore)
    assert (alone.trace.points == report.trace.points).all()


@pytest.mark.slow
def test_nearly_half_of_what_a_local_step_of_maxlipo_changes_in_many_coordinates_stays_in_the_reach_that_it_shows():
    box = sr.Box(np.zeros(36), np.arange(1.0, 37.0))
    events: list[EvaluationsFinished] = []
    maximiser = load_own_registry().build("maximiser", "maxlipo", {"candidates": 10})
    target = Target(lambda points: -np.abs(points / box.upper - 0.4).sum(axis=1), box)
    trace = maximise(target, maximiser, 120, np.random.default_rng(0), notify=events.append).trace
    shares = []
    for before, event in pairwise(events):
        reach = before.sketches.get("reach of a local step")
        if reach is not None and event.notes["local"] == 1.0:
            best = trace.points[: before.total][trace.values[: before.total].argmax()]
            assert (reach.lower <= best).all() and (best <= reach.upper).all()
            moved = trace.points[event.total - 1]
            changed = moved != best
            shares += ((moved >= reach.lower[0]) & (moved <= reach.upper[0]))[changed].tolist()
    assert len(shares) > 40 and 0.3 < np.mean(shares) < 0.6  # of what is drawn half


def test_the_points_that_sequool_evaluates_next_are_in_the_cells_that_it_opens():
    report, shown = watched("sequool")
    cells = [(sketch, event) for _, sketch, event in shown]
    assert len(cells) > 10
    for sketch, event in cells[:-1]:
        following = report.trace.points[event.total : event.total + 2]
        inside = ((following[:, None] >= sketch.lower - 1e-12) & (following[:, None] <= sketch.upper + 1e-12)).all(
            axis=2
        )
        assert inside.any(axis=1).all()


def test_what_lipo_shows_as_excluded_it_never_evaluates_afterwards():
    centre = np.array([0.7, 0.2])
    cone = Target(lambda points: -3.0 * np.linalg.norm(points - centre, axis=1), sr.Box([0.0, -1.0], [2.0, 1.0]))
    events: list[EvaluationsFinished] = []
    lipo = load_own_registry().build("maximiser", "lipo", {"constant": 3.5})
    trace = maximise(cone, lipo, 120, np.random.default_rng(0), notify=events.append).trace
    tried = 0
    for event in events:
        for sketch in event.sketches.values():
            middle, reach = (sketch.lower + sketch.upper) / 2, (sketch.upper - sketch.lower) / 2
            later = trace.points[event.total :]
            within = (((later[:, None] - middle) / reach) ** 2).sum(axis=2) < 1.0 - 1e-9
            assert not within.any()
            tried += later.shape[0]
    assert tried > 100


def test_a_population_is_that_of_the_optimiser():
    pytest.importorskip("nevergrad")
    _, shown = watched("nevergrad", 200)
    sizes = [len(sketch.lower) for role, sketch, _ in shown if role == "population"]
    assert sizes and sizes[-1] == 30
    assert all(sketch.points for _, sketch, _ in shown)


def test_of_a_sketch_only_so_many_rows_are_kept_and_it_cannot_be_written_to():
    class Large(sr.Maximiser):
        def search(self, objective, rng):
            objective.evaluate(objective.domain.lower[np.newaxis])
            objective.sketch("many", np.tile(objective.domain.lower, (1000, 1)))
            objective.evaluate(objective.domain.upper[np.newaxis])
            return np.inf

    events: list[EvaluationsFinished] = []
    maximise(Target(hills, BOX), Large(), 3, np.random.default_rng(0), notify=events.append)
    sketch = next(event.sketches["many"] for event in events if event.sketches)
    assert sketch.lower.shape == (SKETCHED, 3)
    with pytest.raises(ValueError, match="read-only"):
        sketch.lower[0, 0] = 1.0


def test_sketches_come_back_in_the_users_units():
    from sparserob_core.sip.methods.own_units import UsersUnits

    units = UsersUnits.__new__(UsersUnits)
    units.tuple_units, units.cost = lambda size, block: np.full(size, 4.0), 2.0
    units.decision = units.image = units.equalities = np.ones(0)
    own = EvaluationsFinished(
        count=1,
        total=1,
        best_value=1.0,
        best_point=np.ones(2),
        sketches={"a": sr.Sketch(np.ones((1, 2)), 2 * np.ones((1, 2))), "b": sr.Sketch(*(np.ones((1, 2)),) * 2)},
    )
    told = units.event(replace(own, domain=sr.Box([0.0, 0.0], [1.0, 1.0])))
    assert told.sketches["a"].upper.tolist() == [[8.0, 8.0]]
    assert told.sketches["b"].points and told.sketches["b"].lower.tolist() == [[4.0, 4.0]]
