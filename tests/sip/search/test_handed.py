"""Guards sip/search/handed: a maximiser sees the coordinates that can move, and the report speaks of all of them."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.events import EvaluationsFinished
from sparserob_core.sip.search.search import Rules, Target, maximise

BOX = sr.Box([-1.0, 0.5, 2.0] * 3, [1.0, 0.5, 3.0] * 3)
FREE = np.tile([True, False, True], 3)


def hill(points):
    return -((points - 0.25) ** 2).sum(axis=1)


class Probe(sr.Maximiser):
    """Looks at everything that an objective offers."""

    def search(self, objective, rng):
        self.domain, self.block = objective.domain, objective.block
        self.value = float(objective.evaluate(np.array([objective.domain.lower]))[0])
        self.found, self.slope = objective.value_and_gradient(objective.domain.upper)
        self.best = objective.best_point
        objective.note(temperature=3.0)
        return np.inf


def test_a_maximiser_sees_the_coordinates_that_can_move_and_their_part_of_each_index():
    probe = Probe()
    report = maximise(
        Target(hill, BOX, lambda p: -2 * (p - 0.25), block=3),
        probe,
        9,
        np.random.default_rng(0),
        Rules(polish=0.0),
        start=BOX.lower,
    )
    assert probe.domain.lower.tolist() == BOX.lower[FREE].tolist()
    assert probe.domain.upper.tolist() == BOX.upper[FREE].tolist()
    assert probe.block == 2
    assert probe.value == hill(BOX.lower[np.newaxis])[0]
    assert probe.slope.tolist() == (-2 * (BOX.upper - 0.25))[FREE].tolist()
    assert probe.best.tolist() == report.best_point[FREE].tolist()
    assert report.best_point.tolist() == BOX.lower.tolist()
    assert report.trace.points.tolist() == [BOX.lower.tolist(), BOX.lower.tolist(), BOX.upper.tolist()]
    assert report.trace.notes["temperature"].tolist() == [[3, 3.0]]


def test_where_the_indices_do_not_move_alike_every_coordinate_is_a_block_of_its_own():
    probe = Probe()
    box = sr.Box([0.0, 0.0, 0.0, 1.0], [1.0, 1.0, 1.0, 1.0])
    maximise(Target(hill, box, lambda p: p, block=2), probe, 9, np.random.default_rng(0))
    assert probe.block == 1


def test_where_nothing_moves_the_only_point_is_evaluated_once_and_nobody_is_asked():
    class Never(sr.Maximiser):
        def search(self, objective, rng):
            raise AssertionError("asked")

    for start in (None, np.array([0.5, 0.5])):
        report = maximise(
            Target(hill, sr.Box([0.5, 0.5], [0.5, 0.5])), Never(), 9, np.random.default_rng(0), start=start
        )
        assert (report.evaluations, report.best_value, report.upper_bound) == (1, -0.125, -0.125)


def test_events_tell_of_all_coordinates():
    heard = []
    maximise(Target(hill, BOX, lambda p: p, block=3), Probe(), 9, np.random.default_rng(0), None, heard.append)
    events = [event for event in heard if isinstance(event, EvaluationsFinished)]
    assert {event.domain.dimension for event in events} == {9}
    assert {event.block for event in events} == {3}


@pytest.mark.first(11)
@pytest.mark.parametrize("name", sr.load_registry().names("maximiser"))
@pytest.mark.parametrize("polish", [0.0, 0.4])
def test_a_coordinate_with_a_single_value_changes_no_search(name, polish):
    narrow = sr.Box(BOX.lower[FREE], BOX.upper[FREE])

    def search(box, moving, block):
        target = Target(lambda points: hill(points[:, moving]), box, block=block)
        built = sr.load_registry().build("maximiser", name)
        return maximise(target, built, 40, np.random.default_rng(2), Rules(polish=polish))

    wide, plain = search(BOX, FREE, 3), search(narrow, np.full(6, True), 2)
    assert wide.trace.points[:, FREE].tolist() == plain.trace.points.tolist()
    assert wide.trace.values.tolist() == plain.trace.values.tolist()
    assert (wide.trace.points[:, ~FREE] == 0.5).all()


@pytest.mark.parametrize(
    ("answer", "words"),
    [(None, "returned None"), ("inf", "returned 'inf'"), (True, "returned True"), ([1.0], "returned")],
)
def test_what_is_no_upper_bound_is_refused_with_the_name_of_the_maximiser(answer, words):
    class Odd(sr.Maximiser):
        def search(self, objective, rng):
            return answer

    with pytest.raises(sr.PluginError, match=f"maximiser Odd: search {words}"):
        maximise(Target(hill, BOX), Odd(), 9, np.random.default_rng(0))


@pytest.mark.parametrize("even", [True, False])
def test_which_blocks_act_is_handed_on_where_every_block_moves_alike(even):
    class Asking(Probe):
        def search(self, objective, rng):
            self.acting = objective.acting
            return super().search(objective, rng)

    probe, acts = Asking(), np.array([True, False, True])
    box = BOX if even else sr.Box(BOX.lower, [*BOX.upper[:-1], 2.0])
    target = Target(hill, box, lambda p: p, block=3, acting=lambda: acts)
    maximise(target, probe, 9, np.random.default_rng(0))
    assert probe.acting() is acts if even else probe.acting is None


class Middle(sr.Maximiser):
    """Evaluates the middle of its box alone, and shows it."""

    apart = True

    def search(self, objective, rng):
        middle = (objective.domain.lower + objective.domain.upper)[np.newaxis] / 2.0
        objective.sketch("cells", middle - 0.01, middle + 0.01)
        objective.evaluate(middle)
        self.best, self.linear = objective.best_point, objective.linear
        return np.inf


def test_in_the_middle_of_a_tuple_its_indices_are_apart():
    """Five indices ``(t, p)``: times in the middles of five equal parts, parameters no two within a tenth."""
    box, maximiser, seen = sr.Box([0.0, -1.0] * 5, [10.0, 1.0] * 5), Middle(), []
    acting = Target(hill, box, block=2, acting=lambda: np.ones(5, dtype=bool))
    report = maximise(acting, maximiser, 1, np.random.default_rng(0), notify=seen.append)
    place = report.best_point.reshape(5, 2)
    assert place[:, 0] == pytest.approx([1.0, 3.0, 5.0, 7.0, 9.0])
    assert np.diff(np.sort(place[:, 1])).min() > 0.1
    assert maximiser.best == pytest.approx([5.0, 0.0] * 5) and maximiser.linear is None
    plain = maximise(Target(hill, box, block=2), Middle(), 1, np.random.default_rng(0))
    assert plain.best_point == pytest.approx([5.0, 0.0] * 5)


def test_shifted_points_are_within_the_box_and_lead_back():
    from sparserob_core.sip.search.handed import Apart

    class Here:
        domain, block = sr.Box([2.0, -1.0, 0.0] * 4, [5.0, 1.0, 1.0] * 4), 3

    apart = Apart(Here())
    points = np.random.default_rng(1).uniform(Here.domain.lower, Here.domain.upper, size=(200, 12))
    points = np.vstack([points, Here.domain.lower, Here.domain.upper])
    full = apart.full(points)
    assert (full >= Here.domain.lower).all() and (full <= Here.domain.upper).all()
    assert apart.own(full)[:200] == pytest.approx(points[:200], abs=1e-12)
    assert apart.full(apart.own(points))[:200] == pytest.approx(points[:200], abs=1e-12)
