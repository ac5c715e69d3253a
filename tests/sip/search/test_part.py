"""Guards sip/search/part.py: a part spends its own budget, keeps its own accounts, and leaves the whole as it is."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import PluginError
from sparserob_core.sip.maximiser import Maximiser, SearchEnded
from sparserob_core.sip.search.part import SearchPart
from sparserob_core.sip.search.search import CountedObjective, Rules, Target

BOX = sr.Box(np.array([-1.0, -2.0]), np.array([2.0, 1.0]))


def bowl(points):
    return -((points - 0.3) ** 2).sum(axis=1)


def whole(budget=100, rules=None, **target):
    return CountedObjective(Target(bowl, BOX, **target), budget, rules)


def named(name):
    return sr.load_registry().build("maximiser", name)


class Doing(Maximiser):
    """Does what a test says."""

    def __init__(self, act):
        self.act = act

    def search(self, objective, rng):
        self.act(objective)
        return np.inf


@pytest.mark.parametrize("name", ["sequool", "direct", "simulated_annealing", "gradient_ascent", "dual_annealing"])
def test_a_part_spends_its_budget_and_the_whole_goes_on(name):
    objective = whole()
    part = SearchPart(objective, 40, *objective.known())
    part.run(named(name), np.random.default_rng(0))
    assert 35 <= objective.evaluations <= 40 and objective.ended is None
    assert part.best_value == objective.best_value and (part.best_point == objective.best_point).all()
    assert sum(len(values) for _, values in part.found) == objective.evaluations
    objective.evaluate(BOX.lower[np.newaxis])


def test_a_part_knows_nothing_of_another_but_what_it_is_told():
    objective = whole()
    objective.evaluate(np.array([[0.3, 0.3]]))
    alone = SearchPart(objective, 10, *objective.known())
    assert alone.evaluations == 0 and alone.best_value == -np.inf and np.isnan(alone.best_point).all()
    told = SearchPart(objective, 10, np.array([[0.0, 0.0], [0.3, 0.2]]), np.array([-0.18, -0.01]))
    assert told.evaluations == 2 and told.best_point.tolist() == [0.3, 0.2] and told.remaining == 10


def test_what_is_known_costs_nothing_but_is_not_told_for_ever():
    objective = whole()
    points = np.array([[0.0, 0.0], [1.0, 1.0]])
    part = SearchPart(objective, 3, points, np.array([7.0, 8.0]))
    assert part.evaluate(points).tolist() == [7.0, 8.0] and objective.evaluations == 0
    part.evaluate(points)
    assert part.evaluate(points).tolist() == bowl(points).tolist() and objective.evaluations == 2


def test_a_gradient_costs_one_evaluation():
    objective = whole(gradient=lambda point: -2.0 * (point - 0.3))

    def climb(part):
        for _ in range(9):
            part.value_and_gradient(np.array([0.0, 0.0]))

    part = SearchPart(objective, 5, *objective.known())
    part.run(Doing(climb), np.random.default_rng(0))
    assert objective.evaluations == 5 and part.best_value == pytest.approx(-0.18)


def test_the_end_of_the_whole_passes_through_a_part():
    objective = whole(rules=Rules(target=-1.0))
    with pytest.raises(SearchEnded, match="target"):
        SearchPart(objective, 50, *objective.known()).run(named("sobol"), np.random.default_rng(0))


def test_a_part_ends_with_the_budget_of_the_whole():
    objective = whole(10)
    part = SearchPart(objective, 50, *objective.known())
    assert part.remaining == 10
    part.run(named("simulated_annealing"), np.random.default_rng(0))
    assert objective.remaining == part.remaining == 0 and objective.evaluations == 10


def test_the_fault_of_a_member_is_named():
    with pytest.raises(PluginError, match="maximiser Doing: search raised ZeroDivisionError"):
        SearchPart(whole(), 5, *whole().known()).run(Doing(lambda part: 1 / 0), np.random.default_rng(0))
