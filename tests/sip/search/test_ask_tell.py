"""Guards sip/search/ask_tell.py: a search by hand asks what the same search asks of a function, goes on from its
state in another process, refuses what was not asked, and leaves no thread behind."""

from __future__ import annotations

import gc
import json
import subprocess
import sys
import threading

import numpy as np
import pytest

import sparserob_core as sr

BOX = sr.Box([-2.0, -1.0], [1.0, 3.0])
NAMES = ["sequool", "simulated_annealing", "maxlipo", "direct", "gradient_ascent", "random_search", "dual_annealing"]


def bowl(points):
    return -((points - 0.3) ** 2).sum(axis=1)


def by_hand(search, function=bowl, k=None, until=np.inf):
    """Ask and tell to the end, or until that many values were told; the sizes of what was asked."""
    sizes = []
    while not search.done and search.evaluations < until:
        points = search.ask(k)
        search.tell(points, function(points))
        sizes.append(len(points))
    return sizes


def searching():
    return [one for one in threading.enumerate() if one.name == "sparserob maximiser"]


@pytest.fixture(autouse=True)
def no_thread_is_left():
    yield
    if searching():
        gc.collect()  # a search that nobody holds any more may hold itself; in a large process this takes a second
    alive = searching()
    for one in alive:
        one.join(5.0)
    assert not [one for one in alive if one.is_alive()]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("k", [None, 1, 3])
def test_it_asks_what_the_same_search_asks_of_a_function(name, k):
    direct = sr.maximise(bowl, BOX, name, budget=60, seed=4, polish=0.2)
    search = sr.ask_tell(BOX, name, budget=60, seed=4, polish=0.2)
    sizes = by_hand(search, k=k)
    report = search.report()
    assert max(sizes) <= (k or 60)
    assert report.trace.points.tolist() == direct.trace.points.tolist()
    assert report.best_value == direct.best_value == search.best_value
    assert report.stopped == direct.stopped
    assert search.ask().shape == (0, 2)


def test_whole_batches_are_asked_where_a_maximiser_has_them():
    search = sr.ask_tell(BOX, "random_search", budget=100)
    assert by_hand(search, k=8) == [8] * 12 + [4]


@pytest.mark.parametrize("name", NAMES)
def test_it_goes_on_from_its_state_as_if_it_had_never_stopped(name):
    arguments = {"box": BOX, "name": name, "budget": 50, "seed": 2, "polish": 0.2}
    whole = sr.ask_tell(**arguments)
    by_hand(whole)
    for told in (0, 1, 17, 50):
        with sr.ask_tell(**arguments) as broken:
            by_hand(broken, k=2, until=told)
            asked = broken.ask().tolist()
            text = json.dumps(broken.state())
        again = sr.ask_tell(**arguments, state=json.loads(text))
        assert again.evaluations == broken.evaluations
        assert again.ask().tolist() == asked, "what was asked and not told is asked again"
        by_hand(again)
        assert again.report().trace.points.tolist() == whole.report().trace.points.tolist()


def test_a_state_is_taken_up_in_a_fresh_process():
    search = sr.ask_tell(BOX, "simulated_annealing", budget=40, seed=1)
    by_hand(search, until=10)
    code = (
        "import json, sys, sparserob_core as sr; "
        "search = sr.ask_tell(sr.Box([-2.0, -1.0], [1.0, 3.0]), 'simulated_annealing', budget=40, seed=1, "
        "state=json.load(sys.stdin)); print(json.dumps(search.ask().tolist()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(search.state()), capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == search.ask().tolist()
    search.close()


def test_values_that_are_no_numbers_survive_a_state():
    search = sr.ask_tell(BOX, "sequool", budget=30)
    odd = iter([np.nan, -np.inf, 1.0, 2.0] * 10)
    by_hand(search, lambda points: np.array([next(odd) for _ in points]), until=20)
    state = json.loads(json.dumps(search.state(), allow_nan=False))
    again = sr.ask_tell(BOX, "sequool", budget=30, state=state)
    assert again.best_value == 2.0
    assert again.ask().tolist() == search.ask().tolist()
    again.close()
    search.close()


def test_an_infinite_value_ends_it():
    search = sr.ask_tell(BOX, "random_search", budget=30)
    points = search.ask(5)
    search.tell(points, np.full(5, 1.0))
    rest = search.ask()
    search.tell(rest, np.full(25, np.inf))
    assert search.done
    assert search.report().best_value == np.inf


def test_what_was_not_asked_is_refused_and_nothing_is_taken():
    search = sr.ask_tell(BOX, "random_search", budget=30)
    with pytest.raises(sr.InputError, match="tell: nothing was asked since the last tell"):
        search.tell(np.zeros((1, 2)), np.zeros(1))
    points = search.ask(3)
    for wrong, values, words in (
        (
            points[:2],
            np.zeros(2),
            r"expected the 3 points of the last ask, shape \(3, 2\), and as many values, got shapes",
        ),
        (points, np.zeros(2), r"got shapes \(3, 2\) and \(2,\)"),
        (points[::-1], np.zeros(3), "expected the points of the last ask in their order, got "),
        (points + 0.1, np.zeros(3), "in their order"),
        (points, ["many", "few", "none"], "tell: expected points and numbers, got "),
        (points, None, "as many values"),
    ):
        with pytest.raises(sr.InputError, match=words):
            search.tell(wrong, values)
    assert search.evaluations == 0
    assert search.ask(3).tolist() == points.tolist()
    search.tell(points, bowl(points))
    assert search.evaluations == 3
    with pytest.raises(sr.InputError, match="nothing was asked"):
        search.tell(points, bowl(points))
    for bad in (0, -1, True, 1.5):
        with pytest.raises(sr.InputError, match="expected a number of points of at least 1"):
            search.ask(bad)
    search.close()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 3}, "state.seed: expected 2, as given, got 3"),
        ({"budget": 99}, "state.budget"),
        ({"upper": [1.0, 4.0]}, "state.upper"),
        ({"format": 7}, "expected what `state\\(\\)` gave, format 1"),
        ({"points": [[0.0, 0.0]]}, "state.points: expected a list of points, and a value for each"),
        ({"points": [[0.0, 9.0]], "values": [1.0]}, "state.points.0: expected a point of the domain"),
        ({"points": [[0.0, 0.0]], "values": ["many"]}, "state.values.0: expected a point and a number"),
    ],
)
def test_a_state_of_another_search_is_refused_by_the_key_at_fault(change, words):
    search = sr.ask_tell(BOX, "sequool", budget=30, seed=2)
    state = {**search.state(), **change}
    search.close()
    with pytest.raises(sr.InputError, match=words):
        sr.ask_tell(BOX, "sequool", budget=30, seed=2, state=state)


def test_a_state_that_the_search_would_not_have_is_refused_when_it_is_asked():
    search = sr.ask_tell(BOX, "sequool", budget=30)
    by_hand(search, until=5)
    state = search.state()
    search.close()
    state["points"][3] = [0.123, 0.5]
    again = sr.ask_tell(BOX, "sequool", budget=30, state=state)
    with pytest.raises(sr.InputError, match=r"the search asks for .* where \[0.123, 0.5\] was told"):
        again.ask()


def test_what_a_maximiser_raises_is_raised_where_it_is_asked():
    class Falling(sr.Maximiser):
        def search(self, objective, rng):
            objective.evaluate(objective.domain.lower[np.newaxis])
            raise RuntimeError("it fell over")

    search = sr.ask_tell(BOX, Falling(), budget=30)
    points = search.ask()
    search.tell(points, bowl(points))
    for _ in range(2):
        with pytest.raises(sr.PluginError, match=r"Falling.*: search raised RuntimeError: it fell over"):
            search.ask()
    assert search.state()["values"] == bowl(points).tolist(), "what was told is not lost"


def test_a_search_that_is_closed_says_so_and_one_that_is_forgotten_ends():
    with sr.ask_tell(BOX, "sequool", budget=30) as search:
        by_hand(search, until=4)
        assert search.report().stopped == "the search has not ended"
    assert search.done
    report = search.report()
    assert report.stopped == "the search was closed"
    assert report.evaluations == len(report.trace.values) == search.evaluations >= 4
    sr.ask_tell(BOX, "sequool", budget=30).ask()  # forgotten at once


def test_initial_points_are_asked_for_first():
    first = [[0.0, 0.0], [0.5, 0.5]]
    search = sr.ask_tell(BOX, "simulated_annealing", budget=30, start=first)
    assert search.ask().tolist() == first
    search.close()


def test_a_box_without_bounds_is_refused():
    with pytest.raises(sr.InputError, match="expected a bounded box"):
        sr.ask_tell(sr.Box([0.0], [np.inf]), "sequool")
