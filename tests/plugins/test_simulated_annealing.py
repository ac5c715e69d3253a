"""Guards plugins/sparserob_simulated_annealing: simulated annealing: what its candidates are, how it cools and
restarts, and that it finds the basin of a function with many."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.rules import Improvement, Selection
from sparserob_core.sip.search.search import CountedObjective, Rules, Target, maximise
from sparserob_simulated_annealing import SimulatedAnnealing

SQUARE = sr.Box(np.array([-1.0, 3.0]), np.array([1.0, 13.0]))
LIMIT = 4.0  # standard deviations
STILL = {"exploration": 0.0, "samples": 1, "restarts": 0}


def level(points):
    return np.zeros(len(points))


def corner(points):
    return -np.abs(points - SQUARE.lower).sum(axis=1)


def rastrigin(points):
    moved = points - np.array([0.7123, -1.3391, 1.0417])
    return -(moved**2 + 10 - 10 * np.cos(2 * np.pi * moved)).sum(axis=1)


def ever_lower():
    """A function whose values only fall, so that a walk which accepts improvements only stays where it began."""
    calls = iter(range(10**9))
    return lambda points: np.array([-float(next(calls)) for _ in points])


def search(function, domain=SQUARE, budget=1000, seed=0, rules=None, block=1, **options):
    return maximise(
        Target(function, domain, block=block), SimulatedAnnealing(**options), budget, np.random.default_rng(seed), rules
    )


def unit_box(dimension):
    return sr.Box(np.zeros(dimension), np.ones(dimension))


def changes(budget, block, dimension, **options):
    """Which coordinates each candidate changes, of a walk that never leaves its first point."""
    points = search(
        ever_lower(), unit_box(dimension), budget, rules=Rules(selection=Improvement()), block=block, **STILL, **options
    ).trace.points
    return points[1:] != points[0]


@pytest.mark.slow
def test_a_uniform_share_of_the_candidates_visits_every_region_at_its_rate():
    report = search(
        corner,
        budget=8000,
        exploration=0.3,
        one=1.0,
        few=0.0,
        full=0.0,
        coarse=0.0,
        initial_scale=1e-3,
        adapt="none",
        restarts=0,
    )
    uniform = report.trace.points[10:][report.trace.notes["scale"][:, 1] == 1.0]
    assert abs(len(uniform) - 0.3 * 7990) < LIMIT * np.sqrt(0.3 * 0.7 * 7990)
    unit = (uniform - SQUARE.lower) / (SQUARE.upper - SQUARE.lower)
    counts = np.histogram2d(*unit.T, bins=5, range=[[0, 1], [0, 1]])[0]
    expected = len(uniform) / 25
    assert (np.abs(counts - expected) < LIMIT * np.sqrt(expected)).all()


def test_without_the_uniform_share_small_steps_stay_in_one_basin():
    report = search(corner, budget=2000, step="gaussian", coarse=0.0, initial_scale=1e-3, adapt="none", **STILL)
    far = np.abs(report.trace.points - report.trace.points[0]).max(axis=0) / (SQUARE.upper - SQUARE.lower)
    unseen = np.histogram2d(*report.trace.points.T, bins=5, range=[[-1, 1], [3, 13]])[0] == 0
    assert far.max() < 1.0
    assert unseen.any()


@pytest.mark.slow
@pytest.mark.parametrize("step", ["gaussian", "cauchy"])
@pytest.mark.parametrize("kind", ["one", "full"])
def test_reflected_steps_favour_no_place_of_the_box(step, kind):
    # On a level function every candidate is accepted, and a symmetric kernel has the uniform distribution as its
    # stationary one.
    weights = {"one": 0.0, "few": 0.0, "full": 0.0, kind: 1.0}
    report = search(level, budget=20_000, step=step, adapt="none", initial_scale=0.5, coarse=0.0, **STILL, **weights)
    unit = (report.trace.points - SQUARE.lower) / (SQUARE.upper - SQUARE.lower)
    assert np.abs(unit.mean(axis=0) - 1 / 2).max() < 0.02
    assert np.abs(unit.var(axis=0) - 1 / 12).max() < 0.01
    assert not (np.isin(unit, [0.0, 1.0])).any()


def test_a_move_of_one_coordinate_changes_one_and_every_coordinate_has_its_turn():
    moved = changes(400, 1, 7, one=1.0, few=0.0, full=0.0)
    assert (moved.sum(axis=1) == 1).all()
    assert moved.any(axis=0).all()


def test_a_move_of_few_coordinates_changes_at_most_three_and_a_full_one_all():
    assert set(changes(200, 1, 9, one=0.0, few=1.0, full=0.0).sum(axis=1)) <= {1, 2, 3}
    assert (changes(200, 1, 9, one=0.0, few=0.0, full=1.0).sum(axis=1) == 9).all()


@pytest.mark.parametrize("coarse", [0.0, 1.0])
def test_in_a_space_of_tuples_a_move_changes_one_coordinate_or_one_block_or_up_to_three(coarse):
    def blocks(**weights):
        return changes(300, 4, 20, coarse=coarse, **weights).reshape(-1, 5, 4)

    whole = blocks(one=0.0, few=0.0, full=1.0)
    assert (whole.all(axis=2).sum(axis=1) == 1).all()
    assert (whole.any(axis=2).sum(axis=1) == 1).all()
    assert whole.any(axis=2).any(axis=0).all()
    several = blocks(one=0.0, few=1.0, full=0.0)
    assert set(several.any(axis=2).sum(axis=1)) == {1, 2, 3}
    assert (blocks(one=1.0, few=0.0, full=0.0).sum(axis=(1, 2)) == 1).all()


def resting_on(blocks, share, budget=3000, **options):
    """How often a walk that never leaves its second point moves one coordinate of each of five blocks, where the value
    rests on some of them."""
    acting = np.isin(np.arange(5), blocks)
    values = iter([0.0, 1.0])
    target = Target(
        lambda points: np.array([next(values, -1.0) for _ in points]), unit_box(20), block=4, acting=lambda: acting
    )
    options = {**STILL, "one": 1.0, "few": 0.0, "full": 0.0, "coarse": 0.0, **options}
    points = maximise(
        target,
        SimulatedAnnealing(acting=share, **options),
        budget,
        np.random.default_rng(0),
        Rules(selection=Improvement()),
    ).trace.points
    return (points[2:] != points[1]).reshape(-1, 5, 4).sum(axis=(0, 2)), points


def test_moves_favour_what_the_value_rests_on_and_everything_else_keeps_its_turn():
    counts, points = resting_on([1, 4], 0.8)
    total = len(points) - 2
    for block, count in enumerate(counts):
        expected = total * (0.2 / 5 + (0.4 if block in (1, 4) else 0.0))
        assert abs(count - expected) < LIMIT * np.sqrt(expected)
    within = (points[2:] != points[1]).sum(axis=0).reshape(5, 4)
    assert (np.abs(within - counts[:, np.newaxis] / 4) < LIMIT * np.sqrt(counts[:, np.newaxis] / 4)).all()


def test_where_nothing_acts_or_nothing_is_known_all_coordinates_are_alike():
    counts, _ = resting_on([], 0.8)
    assert (np.abs(counts - counts.mean()) < LIMIT * np.sqrt(counts.mean())).all()
    unknown = maximise(
        Target(lambda p: -((p - 0.3) ** 2).sum(axis=1), unit_box(4)),
        SimulatedAnnealing(),
        200,
        np.random.default_rng(0),
    )
    told = maximise(
        Target(lambda p: -((p - 0.3) ** 2).sum(axis=1), unit_box(4)),
        SimulatedAnnealing(acting=0.1),
        200,
        np.random.default_rng(0),
    )
    assert unknown.trace.points.tolist() == told.trace.points.tolist()  # not even another random number is drawn


def test_the_acting_blocks_are_those_of_the_point_at_which_the_walk_stands():
    """A maximum of blocks: only the highest one acts, and the walk is never told of a point that it refused."""
    asked = []

    def highest(points):
        asked.append(points[-1].copy())
        return points.reshape(len(points), 5, 4).sum(axis=2).max(axis=1)

    def acting():
        return np.arange(5) == asked[-1].reshape(5, 4).sum(axis=1).argmax()

    target = Target(highest, unit_box(20), block=4, acting=acting)
    options = {**STILL, "one": 1.0, "few": 0.0, "full": 0.0, "acting": 1.0}
    trace = maximise(target, SimulatedAnnealing(**options), 400, np.random.default_rng(1)).trace
    stood, first = trace.points[0], True
    for point, (_, accepted) in zip(trace.points[1:], trace.notes["accepted"], strict=True):
        moved = np.flatnonzero((point != stood).reshape(5, 4).any(axis=1))
        assert first or moved.tolist() == [stood.reshape(5, 4).sum(axis=1).argmax()]
        stood, first = (point, False) if accepted else (stood, first)


def test_of_a_move_of_what_does_not_count_no_step_is_widened():
    """The value rests on the first block only: the others may go anywhere, and that says nothing of the first."""
    target = Target(
        lambda points: -np.abs(points[:, :4] - 0.5).sum(axis=1),
        unit_box(20),
        block=4,
        acting=lambda: np.arange(5) == 0,
    )

    def last_scale(acting):
        options = {**STILL, "one": 1.0, "few": 0.0, "full": 0.0, "coarse": 0.0, "adapt": "global", "step": "gaussian"}
        maximiser = SimulatedAnnealing(acting=acting, cooling_range=1e-6, **options)
        return maximise(target, maximiser, 3000, np.random.default_rng(0)).trace.notes["scale"][-1, 1]

    assert last_scale(1.0) < 0.01
    assert last_scale(0.0) < 0.1  # 2 400 of 3 000 moves are accepted at any width


def test_an_objective_of_somebody_else_need_not_know_what_acts():
    class Plain:
        """What an objective offered before ``acting``."""

        def __init__(self, objective):
            self._objective = objective

        def __getattr__(self, name):
            if name == "acting":
                raise AttributeError(name)
            return getattr(self._objective, name)

    objective = CountedObjective(Target(corner, SQUARE), 50)
    with pytest.raises(sr.SearchEnded):
        SimulatedAnnealing().search(Plain(objective), np.random.default_rng(0))
        objective.evaluate(objective.best_point[np.newaxis])
    assert objective.evaluations == 50


def test_only_the_uniform_share_changes_every_block():
    points = search(
        ever_lower(), unit_box(20), 2000, rules=Rules(selection=Improvement()), block=4, exploration=0.1, samples=1
    ).trace.points
    every = (points[1:] != points[0]).reshape(-1, 5, 4).any(axis=2).all(axis=1)
    assert abs(every.sum() - 0.1 * 1999) < LIMIT * np.sqrt(0.1 * 0.9 * 1999)


def test_a_move_in_many_dimensions_draws_random_numbers_for_what_changes_only():
    class Counting(np.random.Generator):
        drawn = 0

        def random(self, size=None):
            Counting.drawn += int(np.prod(size or 1))
            return super().random(size)

    block, dimension, budget = 501, 250 * 501, 60
    objective = CountedObjective(Target(level, unit_box(dimension), block=block), budget)
    with pytest.raises(sr.SearchEnded):
        SimulatedAnnealing(**STILL).search(objective, Counting(np.random.PCG64(0)))
        objective.evaluate(objective.best_point[np.newaxis])
    assert Counting.drawn < dimension + 3 * block * budget


def test_the_geometric_schedule_goes_from_the_first_temperature_to_the_last_in_equal_ratios():
    report = search(corner, budget=500, initial_temperature=2.0, cooling_range=1e-6, restarts=0)
    temperature = report.trace.notes["temperature"][:, 1]
    ratio = 1e-6 ** (1 / temperature.size)
    np.testing.assert_allclose(temperature, 2.0 * ratio ** np.arange(temperature.size), rtol=1e-9)


def test_the_logarithmic_schedule_is_inverse_to_the_logarithm_of_the_time():
    temperature = search(corner, budget=500, initial_temperature=2.0, cooling="logarithmic", restarts=0).trace.notes[
        "temperature"
    ][:, 1]
    np.testing.assert_allclose(temperature * np.log(np.arange(temperature.size) + 2), 2.0 * np.log(2), rtol=1e-12)


def test_the_gap_driven_temperature_is_a_power_of_the_gap_to_the_record():
    class Recorded(Selection):
        pairs = ()

        def __call__(self, current, candidate, temperature, rng):
            self.pairs += ((current, temperature),)
            return True

    rule = Recorded()
    report = search(
        corner,
        budget=300,
        cooling="gap",
        gap_factor=0.5,
        gap_power=1.5,
        initial_temperature=1e-6,
        restarts=0,
        samples=1,
        rules=Rules(selection=rule),
    )
    record = report.trace.best[:-1]
    current, temperature = np.array(rule.pairs).T
    far = record - current > 1e-5
    assert far.sum() > 100
    np.testing.assert_allclose(temperature[far], 0.5 * (record - current)[far] ** 1.5, rtol=1e-9)


def test_the_first_temperature_follows_the_units_of_the_function():
    first, scaled = (
        search(lambda points, c=c: c * corner(points)).trace.notes["temperature"][:, 1] for c in (1.0, 1024.0)
    )
    np.testing.assert_allclose(scaled, 1024.0 * first, rtol=1e-12)


def test_each_restart_heats_again_by_its_share():
    temperature = search(corner, budget=1000, initial_temperature=8.0, reheat=0.25, restarts=3).trace.notes[
        "temperature"
    ][:, 1]
    starts = np.flatnonzero(np.diff(temperature) > 0) + 1
    np.testing.assert_allclose(temperature[[0, *starts]], [8.0, 2.0, 0.5, 0.125])
    assert np.diff([0, *starts, temperature.size]).std() < 2


def test_a_restart_from_the_best_begins_there_and_one_anew_at_uniform_points():
    calm = {
        "restarts": 1,
        "exploration": 0.0,
        "one": 1.0,
        "few": 0.0,
        "full": 0.0,
        "coarse": 0.0,
        "initial_scale": 1e-4,
        "step": "gaussian",
        "adapt": "none",
        "samples": 5,
    }
    for begin in ("best", "anew"):
        report = search(
            lambda points: -((points - SQUARE.upper) ** 2).sum(axis=1), budget=505, restart_from=begin, **calm
        )
        steps = np.abs(np.diff(report.trace.points, axis=0)).max(axis=1)[5:]
        assert (steps > 0.1).any() == (begin == "anew")


def test_what_a_walk_accepts_is_decided_by_the_rule_of_the_search_alone():
    class Recorded(Selection):
        asked = ()

        def __call__(self, current, candidate, temperature, rng):
            self.asked += ((current, candidate),)
            return len(self.asked) % 3 == 0

    rule = Recorded()
    report = search(corner, budget=300, samples=1, restarts=0, rules=Rules(selection=rule))
    values = report.trace.values
    assert [candidate for _, candidate in rule.asked] == values[1:].tolist()
    current = values[0]
    for turn, (before, candidate) in enumerate(rule.asked, start=1):
        assert before == current
        current = candidate if turn % 3 == 0 else current
    assert report.trace.notes["accepted"][:, 1].tolist() == [float(turn % 3 == 0) for turn in range(1, 300)]


def test_scales_widen_when_everything_is_accepted_and_narrow_when_nothing_is():
    options = {"one": 1.0, "few": 0.0, "full": 0.0, "coarse": 0.0, **STILL}
    wide = search(level, **options).trace.notes["scale"][:, 1]
    narrow = search(ever_lower(), rules=Rules(selection=Improvement()), **options).trace.notes["scale"][:, 1]
    assert wide[-1] == 0.5
    assert narrow[-1] < 1e-6
    assert (search(level, adapt="none", **options).trace.notes["scale"][:, 1] == 0.1).all()


@pytest.mark.parametrize(
    "options",
    [
        {"step": "gaussian"},
        {"cooling": "logarithmic"},
        {"cooling": "gap"},
        {"restart_from": "anew"},
        {"adapt": "global"},
        {"adapt": "none"},
        {"exploration": 1.0},
        {"restarts": 50},
        {"samples": 1000},
        {"coarse": 1.0},
    ],
)
@pytest.mark.parametrize("budget", [1, 2, 3, 11, 150])
def test_the_budget_is_spent_to_the_last_evaluation_with_every_option(options, budget):
    assert search(corner, budget=budget, **options).evaluations == budget


def test_a_search_that_is_continued_starts_from_the_best_point():
    box = unit_box(6)
    objective = CountedObjective(
        Target(lambda points: -((points - 0.25) ** 2).sum(axis=1), box), 200, Rules(selection=Improvement())
    )
    known = np.full((1, 6), 0.2501)
    objective.evaluate(known)
    SimulatedAnnealing(one=1.0, few=0.0, full=0.0, coarse=0.0, **STILL).search(objective, np.random.default_rng(0))
    later = objective.report("").trace.points[2:]
    assert ((later[0] != known[0]).sum()) == 1


def test_sides_of_length_zero_stay_and_cost_nothing():
    box = sr.Box(np.array([0.0, 2.0, 5.0]), np.array([1.0, 2.0, 5.0]))
    report = search(lambda points: -((points[:, 0] - 0.3) ** 2), box, 300)
    assert (report.trace.points[:, 1:] == [2.0, 5.0]).all()
    assert np.unique(report.trace.points[:, 0]).size > 250
    point = search(level, sr.Box(np.ones(3), np.ones(3)), 300)
    assert (point.evaluations, point.upper_bound) == (1, 0.0)


def test_weights_that_allow_no_move_are_refused():
    with pytest.raises(ValueError, match="at least one of the weights must be positive"):
        SimulatedAnnealing(one=0.0, few=0.0, full=0.0)


@pytest.mark.slow
def test_the_basin_of_a_shifted_rastrigin_function_is_found_within_800_evaluations_in_most_runs():
    box = sr.Box(np.full(3, -5.12), np.full(3, 5.12))
    found = [search(rastrigin, box, 800, seed).best_value > -0.5 for seed in range(20)]
    assert np.mean(found) >= 0.7  # scipy's dual_annealing, with 1000 evaluations, 0.70 to 0.75


@pytest.mark.slow
def test_with_a_polish_the_shifted_rastrigin_function_is_solved_within_1000_evaluations_in_most_runs():
    box = sr.Box(np.full(3, -5.12), np.full(3, 5.12))
    regrets = [-search(rastrigin, box, 1000, seed, Rules(polish=0.2)).best_value for seed in range(20)]
    assert np.median(regrets) < 1e-9


@pytest.mark.parametrize("restart_from", ["best", "anew"])
def test_the_notes_say_at_which_evaluation_the_walk_stands_and_what_it_moved(restart_from):
    report = search(corner, budget=400, restarts=2, restart_from=restart_from)
    notes, values = report.trace.notes, report.trace.values
    steps, stands = notes["stands"][:, 0].astype(int), notes["stands"][:, 1].astype(int)
    accepted, cycle = notes["accepted"][:, 1] > 0, notes["cycle"][:, 1]
    assert (stands >= 1).all() and (stands <= steps).all()
    assert (stands[accepted] == steps[accepted]).all()
    same = (np.diff(cycle) == 0) & ~accepted[1:]
    assert (np.diff(stands)[same] == 0).all()
    heated = np.flatnonzero(np.diff(cycle)) + 1
    assert heated.size == 2
    if restart_from == "best":  # where nothing was accepted yet, it stands at the best point
        for k in heated[~accepted[heated]]:
            assert values[stands[k] - 1] == values[: steps[k] - 1].max()
    changed = (np.diff(report.trace.points, axis=0) != 0).sum(axis=1)
    assert set(notes["move"][:, 1]) <= {0.0, 1.0, 2.0, 3.0}
    one, after = notes["move"][:, 1] == 1.0, np.append(False, accepted[:-1] & (np.diff(cycle) == 0))
    alone = np.flatnonzero(one & after)
    assert alone.size and all(changed[steps[k] - 2] == 1 for k in alone)
