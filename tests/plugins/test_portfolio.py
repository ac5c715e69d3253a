"""Guards plugins/sparserob_portfolio: every member tries, the best goes on, and nothing is paid for twice."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.benchmark.landscapes import BenchmarkFunction, classic
from sparserob_core.experiment.config.load import load_config
from sparserob_portfolio import Portfolio
from tests.support.places import CONFIGS

BOX = sr.Box(np.array([-1.0, -2.0]), np.array([2.0, 1.0]))
LOST_BY_SOME = ("needle", "hartmann 3", "shekel", "hartmann 6", "ellipsoid")


def bowl(points):
    return -((points - 0.3) ** 2).sum(axis=1)


def search(function=bowl, budget=200, seed=0, box=BOX, **options):
    return sr.maximise(function, box, Portfolio(**options), budget=budget, seed=seed, polish=0)


def test_each_member_tries_with_its_part_and_the_one_that_came_farthest_goes_on():
    report = search(members=["random_search", "gradient_ascent"], trial=0.4)
    turns = report.trace.notes["member"]
    assert turns[:, 1].tolist() == [1.0, 2.0, 2.0]
    assert turns[:, 0].tolist() == [0.0, 40.0, 80.0]
    assert report.evaluations == 200 and report.best_value > -1e-9


def test_what_a_member_asks_for_again_is_not_paid_for_twice():
    report = search(members=["sequool", "random_search"], budget=300)
    points = report.trace.points
    assert len(np.unique(points, axis=0)) == len(points) == 300


def test_members_have_options_of_their_own_and_unknown_ones_are_named():
    search(members=[{"name": "direct", "eps": 0.1}, "sobol"])
    with pytest.raises(sr.InputError, match="maximiser direct: ep: unknown"):
        search(members=[{"name": "direct", "ep": 0.1}])
    with pytest.raises(sr.UnknownPluginError, match="simulated_annealing"):
        search(members=["simulated_anealing"])
    with pytest.raises(sr.InputError, match="expected the name of a maximiser in each mapping"):
        search(members=[{"openings": 3}])


MINE = """
import sparserob_core as sr

class Mine(sr.Maximiser, sr.Options):
    'Evaluates the lower corner.'

    repeats: int = 1

    def search(self, objective, rng):
        for _ in range(self.repeats):
            objective.evaluate(objective.domain.lower[None])
        return float('inf')

@sr.hookimpl
def sparserob_maximisers():
    yield sr.MaximiserPlugin(name='mine', factory=Mine, summary='the lower corner')
"""


def test_members_come_from_the_plugins_that_a_config_names(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    members = ["mine", {"name": "mine", "repeats": 3}]
    chosen = sr.load_registry([tmp_path / "mine.py"]).build("maximiser", "portfolio", {"members": members})
    assert np.unique(sr.maximise(bowl, BOX, chosen, budget=50, polish=0).trace.points, axis=0).tolist() == [[-1, -2]]
    with pytest.raises(sr.UnknownPluginError, match="no maximiser is named 'mine'"):
        search(members=members)


def test_options_of_members_are_checked_where_a_config_is_read(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    config = tmp_path / "config.yaml"
    base = CONFIGS / "experiment1_repaired.yaml"
    config.write_text(f"extends: {base}\nplugins: [mine.py]\n")
    names = "maximiser={name: portfolio, members: [sequool, {name: mine, repeat: 3}]}"
    with pytest.raises(sr.ConfigError, match=r"mine: repeat: unknown key; did you mean 'repeats'"):
        load_config(config, [names])
    assert load_config(config, [names.replace("repeat:", "repeats:")]).config.maximiser.name == "portfolio"


def test_a_member_that_makes_no_sense_of_whole_numbers_is_refused_with_them():
    with pytest.raises(sr.InputError, match="integer: expected none, or a maximiser that compares values"):
        sr.ask_tell(BOX, Portfolio(members=["sequool", "gradient_ascent"]), budget=20, integer=[0])
    assert not sr.ask_tell(BOX, Portfolio(members=["sequool"]), budget=20, integer=[0]).done


def test_members_that_find_nothing_left_to_gain_end_the_search():
    class Once(sr.Maximiser):
        """Evaluates the middle."""

        def search(self, objective, rng):
            objective.evaluate((objective.domain.lower + objective.domain.upper)[np.newaxis] / 2)
            return np.inf

    portfolio = Portfolio(members=["sobol"])
    portfolio._built = lambda: [Once(), Once()]
    report = sr.maximise(bowl, BOX, portfolio, budget=50, polish=0)
    assert report.evaluations == 2 and report.stopped == "the maximiser found nothing left to gain"


def test_a_package_that_is_missing_costs_only_its_member(monkeypatch):
    monkeypatch.setattr("sparserob_portfolio.find_spec", lambda name: None)
    assert search().trace.notes["member"][:, 1].max() == 2.0


@pytest.mark.skipif(find_spec("cma") is None, reason="cma, which one member is, is not installed")
@pytest.mark.parametrize(
    "landscape",
    [
        pytest.param(one, marks=() if one.name == "needle" else pytest.mark.slow)
        for one in classic()
        if one.name in LOST_BY_SOME
    ],
    ids=lambda one: one.name,
)
def test_what_some_searches_lose_it_finds(landscape: BenchmarkFunction):
    found = [
        sr.maximise(landscape.target.function, landscape.target.domain, Portfolio(), budget=1000, seed=seed).best_value
        for seed in range(5)
    ]
    slack = 1e-3 * (landscape.maximum - landscape.begin(0))
    assert np.median(found) >= landscape.maximum - slack
