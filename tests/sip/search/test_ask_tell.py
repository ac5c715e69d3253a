"""Guards sip/search/ask_tell.py: a search by hand asks what the same search asks of a function, goes on from its
state in another process, serves several workers, refuses what was not asked, and leaves no thread behind."""

from __future__ import annotations

import gc
import json
import pickle
import subprocess
import sys
import threading

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.search.ranges import Ranges

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


@pytest.mark.first(10)
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


@pytest.mark.first(3)
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
        assert again.state() == broken.state(), "what was told is its own, not aside, before it is asked again too"
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
    with pytest.raises(sr.InputError, match="tell: expected points that were asked for and have no value yet"):
        search.tell(np.zeros((1, 2)), np.zeros(1))
    points = search.ask(3)
    for wrong, values, words in (
        (points, np.zeros(2), r"got shapes \(3, 2\) and \(2,\)"),
        (points[:, :1], np.zeros(3), r"expected points of shape \(j, 2\), and as many values, got shapes \(3, 1\)"),
        (points + 0.1, np.zeros(3), "expected points that were asked for and have no value yet, got "),
        (points[[0, 1, 0]], np.zeros(3), "expected points that were asked for and have no value yet, got "),
        (points, ["many", "few", "none"], "tell: expected points and numbers, got "),
        (points, None, "as many values"),
    ):
        with pytest.raises(sr.InputError, match=words):
            search.tell(wrong, values)
    assert search.evaluations == 0
    assert search.ask(3).tolist() == points.tolist()
    search.tell(points, bowl(points))
    assert search.evaluations == 3
    with pytest.raises(sr.InputError, match="have no value yet"):
        search.tell(points, bowl(points))
    for bad in (0, -1, True, 1.5):
        with pytest.raises(sr.InputError, match="expected a number of points of at least 1"):
            search.ask(bad)
    search.close()


@pytest.mark.parametrize("name", ["random_search", "sequool", "direct"])
def test_values_may_be_told_in_any_order_and_in_part(name):
    straight = sr.ask_tell(BOX, name, budget=40, seed=3)
    by_hand(straight)
    search, order = sr.ask_tell(BOX, name, budget=40, seed=3), np.random.default_rng(0)
    while not search.done:
        points = order.permutation(search.ask(7))
        part = points[: 1 + len(points) // 2]
        search.tell(part, bowl(part))
    assert search.report().trace.points.tolist() == straight.report().trace.points.tolist()
    assert search.best_value == straight.best_value
    assert search.evaluations == straight.evaluations


def test_a_single_point_is_told_with_a_number():
    with sr.ask_tell(BOX, "simulated_annealing", budget=10) as search:
        point = search.ask()[0]
        search.tell(point, 2.5)
        assert (search.best_value, search.best_point.tolist()) == (2.5, point.tolist())


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ["simulated_annealing", "maxlipo", "direct", "random_search"])
def test_workers_are_given_different_points_and_the_search_stays_the_same(name):
    alone = sr.ask_tell(BOX, name, budget=30, seed=5)
    by_hand(alone)
    search, workers, rounds = sr.ask_tell(BOX, name, budget=30, seed=5), list[np.ndarray](), 0
    while not search.done:
        while len(workers) < 3 and len(point := search.ask(fresh=True)):
            workers.append(point[0])
        assert len({tuple(point) for point in workers}) == len(workers), "no two evaluate the same"
        late = workers.pop(rounds % len(workers))
        search.tell(late, bowl(late[np.newaxis])[0])
        rounds += 1
    assert search.report().trace.points.tolist() == alone.report().trace.points.tolist()
    assert search.evaluations >= alone.evaluations
    assert search.best_value >= alone.best_value, "what others have found beside it counts"
    for point in workers:
        search.tell(point, bowl(point[np.newaxis])[0])


def test_a_worker_that_is_lost_is_made_up_for():
    with sr.ask_tell(BOX, "simulated_annealing", budget=10) as search:
        lost = search.ask(fresh=True)
        assert search.ask(fresh=True).tolist() != lost.tolist()
        assert search.ask().tolist() == lost.tolist(), "asked plainly, it gives what the search waits for"


def test_what_idle_workers_evaluated_is_kept_in_the_state():
    with sr.ask_tell(BOX, "simulated_annealing", budget=20, seed=1) as search:
        waited, ahead = search.ask(fresh=True), search.ask(2, fresh=True)
        assert len(ahead) == 2
        search.tell(ahead, np.array([5.0, 4.0]))
        state = json.loads(json.dumps(search.state()))
    assert state["aside"] == [0, 1]
    with sr.ask_tell(BOX, "simulated_annealing", budget=20, seed=1, state=state) as again:
        assert again.ask().tolist() == waited.tolist()
        assert (again.best_value, again.evaluations) == (5.0, 2)


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ["random_search", "direct", "maxlipo", "simulated_annealing", "sequool"])
def test_a_larger_budget_is_the_search_that_had_it_from_its_beginning(name):
    short = sr.ask_tell(BOX, name, budget=20, seed=2, polish=0)
    by_hand(short)
    longer = sr.ask_tell(BOX, name, budget=45, seed=2, polish=0, state=json.loads(json.dumps(short.state())))
    assert longer.best_value == short.best_value
    by_hand(longer)
    whole = sr.ask_tell(BOX, name, budget=45, seed=2, polish=0)
    by_hand(whole)
    assert longer.report().trace.points.tolist() == whole.report().trace.points.tolist()
    aside = len(longer.state().get("aside", []))
    assert longer.evaluations == whole.evaluations + aside
    if name in ("random_search", "direct", "maxlipo"):  # whose points do not depend on the budget
        assert aside == 0
    with pytest.raises(sr.InputError, match=r"state\.budget: expected at most 20, as given, got 45"):
        sr.ask_tell(BOX, name, budget=20, seed=2, polish=0, state=longer.state())


def test_minimising_is_maximising_with_the_other_sign():
    up = sr.ask_tell(BOX, "sequool", budget=30)
    by_hand(up)
    down = sr.ask_tell(BOX, "sequool", budget=30, minimise=True)
    assert down.best_value == np.inf
    by_hand(down, lambda points: -bowl(points))
    assert down.report().trace.points.tolist() == up.report().trace.points.tolist()
    assert (down.best_value, down.best_point.tolist()) == (-up.best_value, up.best_point.tolist())
    least, most = down.report(), up.report()
    assert (least.best_value, least.lower_bound) == (-most.best_value, -most.upper_bound)
    assert (least.upper_bound, most.lower_bound) == (np.inf, -np.inf)
    assert least.trace.values.tolist() == (-most.trace.values).tolist()
    assert least.trace.best.tolist() == np.minimum.accumulate(least.trace.values).tolist()
    with pytest.raises(sr.InputError, match=r"state\.minimise: expected False, as given, got True"):
        sr.ask_tell(BOX, "sequool", budget=30, state=down.state())


MIXED = sr.Box([1.0, 1e-6, 2.0, 1.0], [4.0, 1e2, 2.0, 1000.0])
RANGES = {"integer": [0, 2, 3], "logarithmic": [1, 3]}


@pytest.mark.first(3)
@pytest.mark.parametrize("name", [name for name in NAMES if name != "gradient_ascent"])  # which refuses them
def test_whole_and_logarithmic_ranges_are_kept_and_filled(name):
    search = sr.ask_tell(MIXED, name, budget=200, seed=1, **RANGES, start=[[2.0, 1e-3, 2.0, 10.0]])
    assert search.ask(1).tolist()[0] == pytest.approx([2.0, 1e-3, 2.0, 10.0], rel=1e-12)
    asked: list[list[float]] = []

    def function(points):
        asked.extend(points.tolist())
        return -((points[:, 0] - 3.0) ** 2) - (np.log10(points[:, 1]) + 4.0) ** 2 - np.log10(points[:, 3] / 50.0) ** 2

    by_hand(search, function)
    points = np.array(asked)
    assert ((points >= MIXED.lower) & (points <= MIXED.upper)).all()
    assert (points[:, [0, 2, 3]] == np.round(points[:, [0, 2, 3]])).all()
    assert len({tuple(point) for point in asked}) == len(asked) == search.evaluations, "no point is evaluated twice"
    assert set(points[:, 0]) >= {2.0, 3.0}
    assert search.best_point[0] == 3.0
    assert search.best_value > -0.6
    assert search.report().best_point.tolist() == search.best_point.tolist()


def test_every_whole_number_and_every_decade_of_a_range_are_as_long():
    ranges = Ranges(sr.Box([0.0, 1e-4], [3.0, 1e4]), integer=[0], logarithmic=[1])
    box, even = ranges.searched, (np.arange(4000) + 0.5) / 4000
    points = ranges.shown(box.lower + even[:, np.newaxis] * (box.upper - box.lower))
    assert np.bincount(points[:, 0].astype(int)).tolist() == [1000] * 4, "the ends of a range as its middle"
    decades = np.floor(np.log10(points[:, 1])).astype(int) + 4
    assert np.bincount(decades).tolist() == [500] * 8
    assert ranges.shown(ranges.hidden(points)) == pytest.approx(points, rel=1e-12)


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"integer": [4]}, "integer: expected coordinates, whole numbers from 0 to 3, got"),
        ({"integer": [1]}, r"integer.1: expected whole bounds, got \[1e-06, 100.0\]"),
        ({"logarithmic": "1"}, "logarithmic: expected coordinates"),
        ({"logarithmic": [-1]}, "logarithmic: expected coordinates"),
        ({"minimise": 1}, "minimise: expected true or false, got 1"),
    ],
)
def test_ranges_that_there_are_not_are_refused_by_their_key(ranges, words):
    with pytest.raises(sr.InputError, match=words):
        sr.ask_tell(MIXED, "sequool", **ranges)
    with pytest.raises(sr.InputError, match=r"logarithmic\.0: expected a positive lower bound, got 0.0"):
        sr.ask_tell(sr.Box([0.0], [1.0]), "sequool", logarithmic=[0])


def test_a_search_that_is_not_over_reports_the_least_value_where_it_was_told():
    search = sr.ask_tell(MIXED, "sobol", budget=40, minimise=True, **RANGES)
    by_hand(search, lambda points: points[:, 1], until=7)
    before = search.report()
    search.close()
    for report in (before, search.report(), pickle.loads(pickle.dumps(search)).report()):
        assert report.best_value == report.best_point[1] == search.best_value == report.trace.values.min()
        assert report.trace.points[:, 1].tolist() == report.trace.values.tolist()
        assert report.trace.best.tolist() == np.minimum.accumulate(report.trace.values).tolist()


@pytest.mark.parametrize("name", ["simulated_annealing", "maxlipo", "random_search"])
def test_a_search_is_pickled_and_goes_on(name):
    arguments = {"box": MIXED, "name": name, "budget": 40, "seed": 2, "minimise": True, **RANGES}
    whole = sr.ask_tell(**arguments)
    by_hand(whole, lambda points: points[:, 0] * points[:, 1])
    search = sr.ask_tell(**arguments)
    by_hand(search, lambda points: points[:, 0] * points[:, 1], k=3, until=11)
    again = pickle.loads(pickle.dumps(search))
    assert again.ask(2).tolist() == search.ask(2).tolist()
    assert (again.evaluations, again.best_value) == (search.evaluations, search.best_value)
    by_hand(again, lambda points: points[:, 0] * points[:, 1])
    assert again.report().trace.points.tolist() == whole.report().trace.points.tolist()
    search.close()
    assert pickle.loads(pickle.dumps(search)).done, "what is closed stays closed"


def test_a_state_of_an_earlier_version_is_taken_up():
    with sr.ask_tell(BOX, "sequool", budget=30) as search:
        by_hand(search, until=5)
        state, next_points = search.state(), search.ask()
    for key in ("minimise", "integer", "logarithmic"):
        del state[key]
    with sr.ask_tell(BOX, "sequool", budget=30, state=state) as again:
        assert again.ask().tolist() == next_points.tolist()


def test_threads_share_a_search():
    search = sr.ask_tell(BOX, "simulated_annealing", budget=40, seed=1)

    def worker():
        while not search.done:
            points = search.ask(fresh=True)
            if len(points):
                search.tell(points, bowl(points))

    threads = [threading.Thread(target=worker) for _ in range(3)]
    for one in threads:
        one.start()
    for one in threads:
        one.join(30.0)
    assert search.done
    assert search.best_value == max(bowl(np.array(search.state()["points"])))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 3}, "state.seed: expected 2, as given, got 3"),
        ({"budget": 99}, "state.budget: expected at most 30, as given, got 99"),
        ({"upper": [1.0, 4.0]}, "state.upper"),
        ({"aside": [0]}, "state.aside: expected numbers of points"),
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


def test_a_search_says_how_far_it_is_and_is_not_moved_by_it():
    search = sr.ask_tell(sr.Box([0.0], [1.0]), "sobol", budget=8, minimise=True)
    assert repr(search) == "AskTell: 0 of 8 evaluations, least value inf"
    search.tell(search.ask(1), [0.25])
    assert repr(search) == "AskTell: 1 of 8 evaluations, least value 0.25"


@pytest.mark.parametrize("name", ["maxlipo", "sobol", "simulated_annealing"])
def test_one_process_asks_and_another_one_tells(name):
    arguments = {"box": BOX, "name": name, "budget": 30, "seed": 4, "polish": 0}
    asking = sr.ask_tell(**arguments)
    out = [asking.ask(1, fresh=True)[0] for _ in range(4)]
    asking.tell(out[1], [bowl(out[1][np.newaxis])[0]])
    state = json.loads(json.dumps(asking.state()))
    telling = sr.ask_tell(**arguments, state=state)
    assert telling.state() == state
    new = telling.ask(1, fresh=True)
    assert new.tolist()[0] not in [point.tolist() for point in out], "what is out is not given again"
    for point in (out[0], out[2], out[3]):
        telling.tell(point, bowl(point[np.newaxis]))
    with pytest.raises(sr.InputError, match="no value yet"):
        telling.tell(out[2], [0.0])
    back = sr.ask_tell(**arguments, state=json.loads(json.dumps(telling.state())))
    assert back.evaluations == 4
    back.tell(new, bowl(new))
    by_hand(back)
    assert back.done
    for search in (asking, telling, back):
        search.close()


def test_points_of_workers_that_never_come_back_are_let_go():
    arguments = {"box": BOX, "name": "sobol", "budget": 6, "polish": 0}
    with sr.ask_tell(**arguments) as asking:
        lost = asking.ask(4, fresh=True).tolist()
        state = asking.state()
    with sr.ask_tell(**arguments, state=state) as again:
        assert again.ask(4).tolist() == lost, "what the search waits for"
        assert not [point for point in again.ask(2, fresh=True).tolist() if point in lost]
    with sr.ask_tell(**arguments, state={**state, "out": [], "ahead": []}) as again:
        assert again.ask(4, fresh=True).tolist() == lost
    for broken in ({"out": [[9.0, 9.0]]}, {"out": 3}, {"out": [[0.0, 0.0]], "ahead": [1]}):
        with pytest.raises(sr.InputError, match=r"state\."):
            sr.ask_tell(**arguments, state={**state, **broken})


def test_target_patience_and_known_points_hold_by_hand_too():
    search = sr.ask_tell(BOX, "random_search", budget=300, minimise=True, target=0.5, seed=2)
    while not search.done:
        points = search.ask(1)
        search.tell(points, -bowl(points))
    assert search.best_value <= 0.5
    assert search.evaluations < 300 and search.report().stopped == "the target 0.5 is reached"
    known = (np.array([[0.0, 0.0], [-1.0, 2.0]]), [3.0, 1.0])
    search = sr.ask_tell(BOX, "simulated_annealing", budget=50, minimise=True, known=known, patience=5, polish=0)
    while not search.done:
        points = search.ask()
        search.tell(points, np.full(len(points), 2.0))
    assert search.evaluations == 5
    assert search.report().best_value == 1.0
    assert search.report().best_point.tolist() == [-1.0, 2.0]
    state = json.loads(json.dumps(search.state()))
    again = sr.ask_tell(
        BOX, "simulated_annealing", budget=50, minimise=True, known=known, patience=5, polish=0, state=state
    )
    assert again.done


def test_whole_numbers_are_refused_by_a_search_that_follows_slopes():
    with pytest.raises(sr.InputError, match="a maximiser that compares values, such as simulated_annealing"):
        sr.ask_tell(sr.Box([0, 0.0], [9, 1.0]), "gradient_ascent", budget=20, integer=[0])
