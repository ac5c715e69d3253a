"""Guards sip/search/handed.py, and that no shipped search and no foreign one takes notice of units: the same seed walks
the same way, to the last bit, in coordinates and values that differ by powers of two."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

import sparserob_core as sr
from sparserob_core.sip.search.handed import power_of_two

LOWER, UPPER = np.array([-2.0, -3.0]), np.array([3.0, 2.5])
UNITS = [((30, 30), 0), ((-40, -40), 0), ((0, 0), -30), ((0, 0), 60), ((20, -7), -41)]


def hills(points):
    return np.cos(3 * points).sum(axis=1) - ((points - 0.3) ** 2).sum(axis=1)


def simplex():
    return sr.from_minimiser(lambda f, start: scipy.optimize.minimize(f, start, method="Nelder-Mead"))


class Halving:
    """Asks around its best point; it compares a gain with a number of its own."""

    def __init__(self, rng):
        self.rng, self.best, self.loss, self.step = rng, np.full(2, 0.5), 1e3, 0.4

    def ask(self):
        return np.clip(self.best + self.step * self.rng.standard_normal(2), 0.0, 1.0)

    def tell(self, point, loss):
        if loss < self.loss - 1e-3:
            self.best, self.loss = point, loss
        else:
            self.step *= 0.99


SEARCHES = {name: (lambda name=name: name) for name in sr.load_registry().names("maximiser") if name != "lipo"}
SEARCHES["from_minimiser"] = simplex
SEARCHES["from_ask_tell"] = lambda: sr.from_ask_tell(lambda dimension, budget, rng: Halving(rng))


def walk(search, box_unit, value_unit, polish, **options):
    box_unit = np.array(box_unit)
    report = sr.maximise(
        lambda points: np.ldexp(hills(np.ldexp(points, -box_unit)), value_unit),
        sr.Box(np.ldexp(LOWER, box_unit), np.ldexp(UPPER, box_unit)),
        search,
        budget=60,
        seed=3,
        polish=polish,
        **options,
    )
    assert np.isfinite(report.trace.values).all()
    return np.ldexp(report.trace.points, -box_unit).tolist(), np.ldexp(report.trace.values, -value_unit).tolist()


@pytest.mark.first(3)
@pytest.mark.parametrize("polish", [0, 0.3])
@pytest.mark.parametrize("name", SEARCHES)
def test_the_same_seed_walks_the_same_way_in_other_units(name, polish):
    if name in ("cma", "nevergrad"):
        pytest.importorskip(name)
    plain = walk(SEARCHES[name](), (0, 0), 0, polish)
    for box_unit, value_unit in UNITS:
        assert walk(SEARCHES[name](), box_unit, value_unit, polish) == plain, (box_unit, value_unit)


@pytest.mark.parametrize("unit", [-20, 35])
def test_a_lipschitz_constant_is_in_the_units_of_the_user(unit):
    plain = walk("lipo", (0, 0), 0, 0, constant=20.0)
    assert walk("lipo", (unit, unit), 0, 0, constant=float(np.ldexp(20.0, -unit))) == plain
    assert walk("lipo", (0, 0), unit, 0, constant=float(np.ldexp(20.0, unit))) == plain


class Looking(sr.Maximiser):
    """Notes what it is shown."""

    scaled = True

    def search(self, objective, rng):
        self.domain = objective.domain
        self.values = objective.evaluate((objective.domain.lower + objective.domain.upper)[np.newaxis] / 2)
        self.best = objective.best_point, objective.best_value
        self.slope = objective.value_and_gradient(objective.domain.lower)[1]
        return float(self.values[0]) * 4


def test_a_search_that_asks_for_it_is_shown_a_box_and_values_of_about_one():
    looking = Looking()
    report = sr.maximise(
        lambda x: 1e-7 * (x.sum(axis=1) + 3e9),
        sr.Box([0.0, 2e-12], [3e9, 5e-12]),
        looking,
        budget=9,
        polish=0,
        gradient=lambda x: np.full(2, 1e-7),
    )
    width = looking.domain.upper - looking.domain.lower
    assert ((width >= 1.0) & (width < 2.0)).all()
    assert 1.0 <= looking.values[0] < 2.0
    assert looking.best[1] == looking.values[0]
    assert report.best_value == pytest.approx(450.0)
    assert report.upper_bound == 4 * report.best_value, "what it claims is told in the user's units"
    assert looking.slope[0] == pytest.approx(1e-7 * (3e9 / width[0]) * looking.values[0] / report.best_value)


def test_units_are_powers_of_two_that_leave_room():
    sizes = np.array([1.0, 1.9, 2.0, 5.0, 1e-300, 3e-310, 1e300, 1.7e308])
    units = power_of_two(sizes)
    assert (np.frexp(units)[0] == 0.5).all()
    assert ((sizes[:5] / units[:5] >= 1.0) & (sizes[:5] / units[:5] < 2.0)).all()
    assert np.isfinite(1.0 / units).all()
