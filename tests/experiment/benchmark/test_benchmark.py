"""Guards experiment/benchmark: known maxima, expected running times as they are defined, files that IOHanalyzer reads,
and landscapes of g whose maximum nobody exceeds."""

from __future__ import annotations

import json
from importlib.util import find_spec

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.benchmark.landscapes import (
    BenchmarkFunction,
    bbob,
    classic,
    landscape_of,
    landscapes,
    standard,
)
from sparserob_core.experiment.benchmark.searches import Benchmark, Search
from sparserob_core.experiment.comparison.profiles import Instance, Profiles
from sparserob_core.sip.search.search import Target, maximise
from tests.support.places import CONFIGS


@pytest.mark.first(2)
@pytest.mark.parametrize("landscape", list(standard()), ids=lambda one: one.name)
def test_no_point_of_a_standard_function_exceeds_its_maximum_and_a_search_comes_near(landscape):
    report = sr.maximise(landscape.target.function, landscape.target.domain, "simulated_annealing", 3000, 0, 0.3)
    slack = 1e-6 * max(1.0, abs(landscape.maximum))
    assert report.best_value <= landscape.maximum + slack
    assert report.best_value >= landscape.maximum - 0.01 * (landscape.maximum - landscape.begin(0))


@pytest.mark.parametrize("landscape", list(classic()), ids=lambda one: one.name)
def test_no_point_of_a_classic_function_exceeds_its_maximum(landscape):
    box = landscape.target.domain
    points = np.random.default_rng(0).uniform(box.lower, box.upper, (20_000, box.dimension))
    report = sr.maximise(landscape.target.function, box, "sequool", 3000)
    best = max(report.best_value, float(landscape.target.function(points).max()))
    assert best <= landscape.maximum + 1e-6 * max(1.0, abs(landscape.maximum))


def test_all_but_one_classic_function_are_solved_by_somebody():
    """The maxima are attained: Schwefel's is at 420.9687 in every coordinate, the others are found."""
    for landscape in classic():
        box, function = landscape.target.domain, landscape.target.function
        if landscape.name == "schwefel":
            assert function(np.full((1, 5), 420.968746))[0] == pytest.approx(landscape.maximum)
            continue
        start = {"griewank": 60.0 * np.random.default_rng(0).uniform(-0.6, 0.6, 20)[:5]}.get(landscape.name)
        start = {"michalewicz": [2.2029055, 1.5707963, 1.2849916, 1.9230585, 1.7204698]}.get(landscape.name, start)
        report = sr.maximise(function, box, "sequool", 3000, start=start)
        assert report.best_value >= landscape.maximum - 1e-6 * max(1.0, abs(landscape.maximum)), landscape.name


@pytest.mark.skipif(find_spec("ioh") is None, reason="ioh, of the extra bench, is not installed")
def test_bbob_functions_have_their_maximum_where_ioh_says():
    found = list(bbob())
    assert len(found) == 48 and {one.target.domain.dimension for one in bbob(2, [3])} == {3}
    for landscape in found[:8]:
        values = landscape.target.function(
            np.random.default_rng(0).uniform(-5.0, 5.0, (50, landscape.target.domain.dimension))
        )
        assert (values <= landscape.maximum).all()


def searched(bests, budget=10, target=1.0):
    """A benchmark of one contender on one landscape, with these running best values."""
    landscape = BenchmarkFunction("hill", Target(lambda x: x[:, 0], sr.Box([0.0], [1.0])), 1.0, 1, "standard")
    searches = [Search(landscape, "a", seed, np.array(best), 0.001, np.zeros(1)) for seed, best in enumerate(bests)]
    times = [[np.array([one.needed(target) for one in searches])]]
    profiles = Profiles("", "evaluations", 1e-3, ["a"], [Instance("hill", 1.0, True, 2.0)], [[0, 1]], times, [0])
    return Benchmark(profiles, searches, [target], budget)


def test_the_expected_running_time_counts_what_failures_spent():
    found = searched([[0.2, 1.0, 1.0, 1.0], [0.1, 0.2, 0.3, 0.4]])
    assert found.expected_running_time(0, "a") == 2 + 4  # one success after 2, one failure after 4
    assert searched([[0.1], [0.2]]).expected_running_time(0, "a") == np.inf
    assert found.own_microseconds("a") == pytest.approx(1e6 * 0.002 / 8)


def test_a_benchmark_is_the_same_twice_and_leaves_its_files(tmp_path):
    names = ["random_search", "sequool"]
    first = sr.benchmark(names, budget=60, seeds=2, out=tmp_path / "one")
    again = sr.benchmark(names, budget=60, seeds=2)
    for one, other in zip(first.searches, again.searches, strict=True):
        assert (one.best == other.best).all()
    written = json.loads((tmp_path / "one" / "benchmark.json").read_text())
    assert [one["label"] for one in written["contenders"]] == names
    facts = json.loads((tmp_path / "one" / "ioh" / "sequool" / "IOHprofiler_f101_garland.json").read_text())
    assert facts["maximization"] and facts["scenarios"][0]["dimension"] == 1
    table = (tmp_path / "one" / "ioh" / "sequool" / facts["scenarios"][0]["path"]).read_text().splitlines()
    assert table.count("evaluations raw_y") == 2
    last = float(table[-1].split()[1])
    assert last == pytest.approx(facts["scenarios"][0]["runs"][-1]["best"]["y"], rel=1e-11)
    with pytest.raises(sr.InputError, match=r"one: expected a new or an empty directory, got one that holds files$"):
        sr.benchmark(names, budget=60, seeds=2, out=tmp_path / "one")
    (tmp_path / "file").touch()
    with pytest.raises(sr.InputError, match=r"file: expected a directory, got a file$"):
        sr.benchmark(names, budget=60, seeds=2, out=tmp_path / "file")
    with pytest.raises(sr.InputError, match="nobody"):
        sr.benchmark(["nobody"], out=tmp_path / "none")
    assert not (tmp_path / "none").exists() and not list(tmp_path.rglob(".lock"))


@pytest.mark.skipif(find_spec("ioh") is None, reason="ioh, of the extra bench, is not installed")
def test_the_files_have_the_same_keys_as_those_that_ioh_writes(tmp_path):
    import ioh

    problem = ioh.get_problem("Sphere", instance=1, dimension=2, problem_class=ioh.ProblemClass.BBOB)
    logger = ioh.logger.Analyzer(root=str(tmp_path), folder_name="theirs", algorithm_name="a")
    problem.attach_logger(logger)
    problem([0.0, 0.0])
    problem.reset()
    logger.close()
    theirs = json.loads((tmp_path / "theirs" / "IOHprofiler_f1_Sphere.json").read_text())
    sr.benchmark(["random_search"], budget=5, seeds=1, out=tmp_path / "ours")
    ours = json.loads((tmp_path / "ours" / "ioh" / "random_search" / "IOHprofiler_f101_garland.json").read_text())
    assert set(theirs) == set(ours)
    assert set(theirs["scenarios"][0]) == set(ours["scenarios"][0])
    assert set(theirs["scenarios"][0]["runs"][0]) == set(ours["scenarios"][0]["runs"][0])


def test_nobody_exceeds_the_certified_maximum_of_a_landscape_of_g_and_the_gradient_meets_it():
    found = sr.benchmark(
        ["gradient_ascent"], ["g"], budget=200, seeds=1, configs=[CONFIGS / "double_integrator.yaml"], polish=0.2
    )
    assert found.expected_running_time(0, "gradient_ascent") <= 200
    assert found.searches[0].best[-1] <= found.searches[0].landscape.maximum * (1 + 1e-6)


def pieces(count, *dictionaries):
    return {f"dictionaries.{name}": {"name": "piecewise_constant", "pieces": count} for name in dictionaries}


def test_the_maximum_of_g_is_certified_in_the_units_in_which_g_is_searched():
    config = CONFIGS / "experiment3_repaired.yaml"  # whose control has a unit of its own, hence the regulariser too
    landscape = landscape_of(config, 1, "reduced", 20, pieces(20, "control", "disturbance"))
    found = [search(landscape, name, 100, 0) for name in ("random_search", "sequool")]
    assert max(found) <= landscape.maximum * (1 + 1e-6) and found[1] >= landscape.maximum * (1 - 1e-6)


def test_where_few_indices_of_many_act_searches_with_their_defaults_find_what_chance_does_not():
    landscape = landscape_of(CONFIGS / "experiment2_repaired.yaml", 1, "reduced", 50, pieces(50, "control"))
    for seed in range(2):
        assert search(landscape, "random_search", 100, seed) < 0.95 * landscape.maximum
        for name in ("simulated_annealing", "sequool", "portfolio"):
            assert search(landscape, name, 100, seed) > 0.9999 * landscape.maximum


def search(landscape, name, budget, seed):
    """The best value of a search with its defaults, as a run has them."""
    maximiser = sr.load_registry().build("maximiser", name, {})
    return maximise(landscape.fresh().target, maximiser, budget, np.random.default_rng(seed)).best_value


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"suites": ["standart"]}, "suite: expected one of"),
        ({"budget": 0}, "budget: expected a whole number"),
        ({"seeds": 1.5}, "seeds: expected a whole number"),
        ({"polish": 1.0}, "polish: expected a share of the budget, at least 0 and below 1, got 1.0"),
        ({"polish": True}, "polish: expected a share"),
        ({"accuracy": 0.0}, "accuracy: expected a number above 0"),
        ({"maximisers": []}, "maximisers: expected at least one"),
        ({"maximisers": ["sobol", "sobol"]}, "expected each one once"),
    ],
)
def test_wrong_input_is_one_error_that_names_the_argument(changed, said):
    arguments = {"maximisers": ["sobol"], "suites": ["standard"], "budget": 10, "seeds": 1, **changed}
    with pytest.raises(sr.InputError, match=said):
        sr.benchmark(arguments.pop("maximisers"), arguments.pop("suites"), **arguments)


def test_a_config_whose_value_is_not_certified_is_refused():
    with pytest.raises(sr.InputError, match="expected a config whose value is certified, got infeasible"):
        landscape_of(CONFIGS / "experiment1_printed.yaml", 1)


def test_unknown_suites_are_refused_before_anything_is_built():
    with pytest.raises(sr.InputError, match="suite"):
        list(landscapes(["unknown"], ()))


def test_the_command_prints_two_tables(command):
    done = command("benchmark", "sobol", "--budget", "20", "--seeds", "1")
    assert done.returncode == 0
    assert "own us / evaluation" in done.stdout and "expected evaluations" in done.stdout
