"""Guards plugins/sparserob_nevergrad: nevergrad's optimisers behind the contract: names, budget, random numbers, and
what happens when one of them raises."""

from __future__ import annotations

import random
import subprocess
import sys
import threading

import numpy as np
import pytest
from numpy.random import mtrand

import sparserob_core as sr
from sparserob_core.sip.search.search import CountedObjective, Target, maximise
from sparserob_nevergrad import Nevergrad
from sparserob_nevergrad.guarded import Guarded

pytest.importorskip("nevergrad")

BOX = sr.Box(np.array([-5.0, -4.0]), np.array([5.0, 6.0]))
NUMPY_TYPE_ERROR = "only 0-dimensional arrays can be converted to Python scalars"


def bowl(points):
    return -((points - 0.3) ** 2).sum(axis=1)


def search(function=bowl, domain=BOX, budget=60, seed=0, **options):
    return maximise(Target(function, domain), Nevergrad(**options), budget, np.random.default_rng(seed))


@pytest.fixture
def registry():
    from nevergrad.optimization import registry

    added = []

    def add(name, optimiser):
        registry[name] = optimiser
        added.append(name)

    yield add
    for name in added:
        registry.pop(name)


class Crashing:
    """An optimiser that asks for points on the diagonal, and raises when it is asked for the ``last`` time."""

    last = 8

    def __init__(self, parametrization, budget, num_workers):
        self.parametrization, self.budget, self.asked = parametrization, budget, 0

    def ask(self):
        self.asked += 1
        if self.asked == self.last:
            raise TypeError(NUMPY_TYPE_ERROR)
        return self.parametrization.spawn_child(new_value=np.full(2, 0.5 + 0.01 * (self.asked % 40)))

    def tell(self, candidate, loss):
        assert candidate.value.shape == (2,)
        assert isinstance(loss, float)


def recording(heard, refuses):
    """An optimiser that writes down what it is told and shown; ``refuses`` what it has not asked for."""
    from nevergrad.common.errors import TellNotAskedNotSupportedError

    class Recording(Crashing):
        last = 10**9

        def tell(self, candidate, loss):
            if refuses and not self.asked:
                raise TellNotAskedNotSupportedError
            heard.append(("told", candidate.value.tolist(), loss))

        def suggest(self, unit):
            heard.append(("shown", unit.tolist()))

    return Recording


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["TwoPointsDE", "OnePlusOne", "CMA", "PSO", "Cobyla"])
def test_an_optimiser_by_name_climbs_and_spends_the_budget_exactly(name):
    report = search(budget=200, optimiser=name)
    assert report.evaluations == 200
    assert report.best_value > -0.1
    assert (report.trace.notes["spread"][:, 1] <= 1.0).all()


def test_a_misspelt_name_names_the_nearest_one():
    with pytest.raises(
        sr.InputError,
        match="nevergrad: optimiser: there is no optimiser 'OnePlusTwo'; the nearest name is 'OnePlusOne'",
    ):
        search(optimiser="OnePlusTwo")
    with pytest.raises(sr.InputError, match=r"nevergrad: fallback: .* the nearest name is 'NGOpt'"):
        search(fallback="NGOpt!")


def test_a_missing_package_is_found_before_anything_is_solved_or_written(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "nevergrad", None)
    config = {
        "problem": {
            "name": "linear",
            "system": {"A": [[0]], "B": [[1]]},
            "horizon": 1.0,
            "initial_state": [1],
            "control": {"box": 1.0},
            "terminal": [{"box": [0.5]}],
        },
        "method": "sparserob",
        "maximiser": "nevergrad",
    }
    with pytest.raises(sr.PluginError, match=r"nevergrad is not installed; `pip install 'nevergrad>=1.0.12'`"):
        sr.run(config, out=tmp_path / "out", quiet=True)
    assert not (tmp_path / "out").exists()


def test_a_missing_package_is_one_sentence_that_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "nevergrad.optimization", None)
    with pytest.raises(
        sr.PluginError,
        match=r"nevergrad: nevergrad is not installed; `pip install 'nevergrad>=1.0.12'` brings it",
    ):
        search()


def test_listing_the_plugins_does_not_import_the_package():
    code = (
        "import sys, sparserob_core as sr; registry = sr.load_registry(); assert 'nevergrad' in"
        " registry.names('maximiser'); registry.build('maximiser', 'nevergrad'); assert 'nevergrad' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_generator_alone_decides_the_search_and_the_global_random_numbers_are_left_alone():
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    np.random.standard_normal()  # noqa: NPY002  the second number of the pair waits
    whole = mtrand.get_bit_generator(), np.random.get_state()[2:]  # noqa: NPY002
    before = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    first = search(optimiser="CMA").trace.points
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before  # noqa: NPY002
    assert (mtrand.get_bit_generator(), np.random.get_state()[2:]) == whole  # noqa: NPY002
    assert whole[1][1] == 1
    np.random.seed(2)  # noqa: NPY002
    assert first.tolist() == search(optimiser="CMA").trace.points.tolist()
    assert first.tolist() != search(optimiser="CMA", seed=1).trace.points.tolist()


@pytest.mark.parametrize("in_memory", [True, False])
def test_a_number_of_a_normal_pair_that_waits_is_there_after_every_step_whoever_draws_between_them(
    in_memory, monkeypatch
):
    from sparserob_nevergrad import guarded as module

    assert module._place() or sys.implementation.name != "cpython"
    if not in_memory:  # as where it is not known where the state lies
        monkeypatch.setattr(module, "_place", lambda: 0)
    """One draw, none, or two between two steps: the next ones are those of a generator that nobody exchanged."""
    guarded = Guarded(None, 1, 1, np.random.default_rng(0))
    draws = (1, 0, 1, 2, 0, 0, 3, 1, 0, 1, 0, 624, 624, 1)
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    alone = np.random.standard_normal(sum(draws)).tolist(), [random.gauss() for _ in range(sum(draws))]  # noqa: NPY002
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    drawn, inside = ([], []), []
    for step, count in enumerate(draws):
        with guarded._guard():
            np.random.standard_normal(1)  # noqa: NPY002
            inside += [random.gauss() for _ in range(step % 3)]
        drawn[0].extend(np.random.standard_normal(count))  # noqa: NPY002
        drawn[1].extend(random.gauss() for _ in range(count))
    assert drawn == alone
    own = random.Random(int(np.random.default_rng(0).integers(2**31, size=3)[0]))
    assert inside == [own.gauss() for _ in inside]


def test_an_optimiser_that_raises_is_explained_and_the_fallback_is_told_all_that_was_evaluated(registry):
    heard = []
    registry("Crashing", Crashing)
    registry("Recording", recording(heard, refuses=False))
    with pytest.warns(
        UserWarning,
        match=(
            f"nevergrad's Crashing failed after 7 evaluations .TypeError: {NUMPY_TYPE_ERROR}.; "
            "the search goes on with Recording"
        ),
    ) as caught:
        report = search(optimiser="Crashing", fallback="Recording")
    assert len(caught) == 1
    assert report.evaluations == 60
    unit = (report.trace.points - BOX.lower) / (BOX.upper - BOX.lower)
    np.testing.assert_allclose([at for _, at, _ in heard[:7]], unit[:7])
    losses = np.array([loss for *_, loss in heard[:7]])  # in units of about 1, a power of two
    unit_of_losses = losses[0] / -report.trace.values[0]
    assert np.frexp(unit_of_losses)[0] == 0.5
    np.testing.assert_allclose(losses, -report.trace.values[:7] * unit_of_losses)


def test_a_fallback_that_takes_only_what_it_asked_for_is_shown_the_best(registry):
    heard = []
    registry("Crashing", Crashing)
    registry("Recording", recording(heard, refuses=True))
    with pytest.warns(UserWarning, match="goes on with Recording"):
        report = search(optimiser="Crashing", fallback="Recording")
    best = report.trace.points[np.argmax(report.trace.values[:7])]
    np.testing.assert_allclose(heard[0][1], (best - BOX.lower) / (BOX.upper - BOX.lower))
    assert report.evaluations == 60


@pytest.mark.parametrize("fallback", [None, "Crashing"])
def test_without_a_fallback_that_works_the_search_ends_with_what_was_found(registry, fallback):
    registry("Crashing", Crashing)
    with pytest.warns(UserWarning, match="nevergrad's Crashing failed") as caught:
        report = search(optimiser="Crashing", fallback=fallback)
    assert len(caught) == (1 if fallback is None else 2)
    assert str(caught[-1].message).endswith("the search ends here")
    assert report.evaluations == (7 if fallback is None else 14)
    assert report.best_value == report.trace.values.max()
    assert "nevergrad's Crashing failed" in report.stopped


def test_an_optimiser_that_raises_before_anything_is_found_is_an_error_of_the_plugin(registry):
    class Stillborn(Crashing):
        last = 1

    registry("Stillborn", Stillborn)
    with (
        pytest.warns(UserWarning, match="failed after 0"),
        pytest.raises(sr.PluginError, match="Stillborn failed after 0 evaluations"),
    ):
        search(optimiser="Stillborn", fallback=None)


def test_what_the_function_raises_is_not_taken_for_a_fault_of_the_optimiser():
    calls = []

    def failing(points):
        calls.append(1)
        raise TypeError(NUMPY_TYPE_ERROR)

    with pytest.raises(sr.EvaluationError, match="the function failed after 0 evaluations"):
        search(failing)
    assert len(calls) == 1


PORTFOLIO = ("NGOpt", "CMA", "OnePlusOne", "DE", "TBPSA")
FIRST = {("NGOpt", 1, 10), ("NGOpt", 1, 100), ("NGOpt", 2, 100), ("NGOpt", 20, 100), ("TBPSA", 20, 100), ("DE", 1, 10)}
CASES = [
    pytest.param(name, dimension, budget, marks=[] if (name, dimension, budget) in FIRST else pytest.mark.slow)
    for name in PORTFOLIO
    for dimension in (1, 2, 3, 5, 10, 20)
    for budget in (10, 100, 500, 2000)
    if budget < 2000 or dimension in {1, 3, 20}
]


@pytest.mark.first(3)
@pytest.mark.parametrize(("name", "dimension", "budget"), CASES)
def test_they_spend_every_budget_in_every_dimension_without_a_fallback(name, dimension, budget):
    box = sr.Box(np.full(dimension, -2.0), np.full(dimension, 3.0))
    report = search(domain=box, budget=budget, optimiser=name, fallback=None)
    assert report.evaluations == budget
    assert report.stopped == "the budget is spent"
    at_random = maximise(
        Target(bowl, box), sr.load_registry().build("maximiser", "random_search"), budget, np.random.default_rng(0)
    )
    assert budget < 500 or report.best_value >= at_random.best_value


def test_an_array_of_one_number_is_a_number_to_the_model_of_ngopt():
    search(budget=2)
    from nevergrad.optimization import metamodel

    assert metamodel.float(np.array([[0.25]])) == metamodel.float(0.25) == metamodel.float("0.25") == 0.25
    with pytest.raises(ValueError, match="size 1"):
        metamodel.float(np.zeros(2))


@pytest.mark.slow
def test_an_optimiser_with_a_thread_of_its_own_leaves_none_behind_and_warns_of_nothing():
    before = threading.active_count()
    for _ in range(3):
        assert search(optimiser="Cobyla", budget=300).evaluations == 300
    for thread in threading.enumerate()[before:]:
        thread.join(10.0)
    assert threading.active_count() == before


def test_losses_that_are_no_numbers_are_told_as_large_ones(registry):
    heard = []
    registry("Recording", recording(heard, refuses=False))
    search(lambda points: np.where(points[:, 0] < 0.6, -np.inf, np.nan), optimiser="Recording")
    assert {loss for *_, loss in heard} == {1e20}


def test_a_search_that_is_continued_is_told_of_the_best_point(registry):
    heard = []
    registry("Recording", recording(heard, refuses=False))
    objective = CountedObjective(Target(bowl, BOX), 5)
    objective.evaluate(np.array([[0.0, 1.0]]))
    Nevergrad(optimiser="Recording").search(objective, np.random.default_rng(0))
    assert heard[0] == ("told", [0.5, 0.5], pytest.approx(0.58))


def test_sides_of_length_zero_stay_where_they_are():
    report = search(domain=sr.Box(np.array([0.0, 0.7]), np.array([1.0, 0.7])))
    assert (report.trace.points[:, 1] == 0.7).all()
    assert search(domain=sr.Box(np.ones(2), np.ones(2))).evaluations == 1
