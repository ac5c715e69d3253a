"""Guards sip/search/block_ascent: vertices in the coordinates in which blocks are linear, a search in the others; on a
function whose maximum is known, and on the paper's tuples with the disturbance in them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.maximiser import LinearBlocks
from sparserob_core.sip.relaxed.relaxed import RelaxedProgram
from sparserob_core.sip.relaxed.tuples import TupleValue
from sparserob_core.sip.search.search import CountedObjective, Rules, Target, maximise
from tests.support.places import CONFIGS

PIECES = 6


class Peaks:
    """The largest of the blocks ``(t, b_1 ... b_m, still)``: ``a(t)'b + 1 - (t - s)^2``; its maximum over ``b`` in
    ``[-1, 1]^m`` is ``|a(t)|_1 + 1 - (t - s)^2``."""

    m, blocks, place = 5, 4, 0.618

    def __init__(self):
        self.last = np.zeros((self.blocks, self.m + 2))
        lower = np.tile(np.concatenate([[0.0], -np.ones(self.m), [2.0]]), self.blocks)
        upper = np.tile(np.concatenate([[1.0], np.ones(self.m), [2.0]]), self.blocks)
        self.domain = sr.Box(lower, upper)
        linear = np.tile(np.concatenate([[False], np.ones(self.m, dtype=bool), [False]]), self.blocks)
        self.linear = LinearBlocks(linear, self.acting, self.steepest)

    def slopes(self, t):
        return np.cos(np.outer(t, 1.0 + np.arange(self.m)))

    def each(self, blocks):
        return (self.slopes(blocks[:, 0]) * blocks[:, 1:-1]).sum(axis=1) + 1.0 - (blocks[:, 0] - self.place) ** 2

    def __call__(self, points):
        values = []
        for point in points:
            self.last = point.reshape(self.blocks, -1)
            values.append(self.each(self.last).max())
        return np.array(values)

    def acting(self):
        found = self.each(self.last)
        return found == found.max()

    def steepest(self, point):
        blocks = point.reshape(self.blocks, -1).copy()
        blocks[:, 1:-1] = np.sign(self.slopes(blocks[:, 0]))
        return blocks.ravel()

    @property
    def maximum(self):
        t = np.linspace(0.0, 1.0, 2_000_001)
        return float((np.abs(self.slopes(t)).sum(axis=1) + 1.0 - (t - self.place) ** 2).max())


def test_the_ascent_meets_the_maximum_of_a_known_function_and_never_descends():
    peaks = Peaks()
    objective = CountedObjective(Target(peaks, peaks.domain, block=peaks.m + 2, linear=peaks.linear), 400)
    objective.evaluate(np.random.default_rng(0).uniform(peaks.domain.lower, peaks.domain.upper)[np.newaxis])
    sr.block_ascent(objective)
    values = objective.seen()[1]
    assert (np.diff(values) >= 0.0).all()
    assert objective.best_value == pytest.approx(peaks.maximum, abs=1e-8)
    assert objective.evaluations < 400


def test_an_ascent_that_is_given_its_start_evaluates_it_once():
    peaks = Peaks()
    target = Target(peaks, peaks.domain, block=peaks.m + 2, linear=peaks.linear)
    objective, rng = CountedObjective(target, 400), np.random.default_rng(0)
    start = rng.uniform(peaks.domain.lower, peaks.domain.upper)
    sr.block_ascent(objective, start)
    assert objective.best_value == pytest.approx(peaks.maximum, abs=1e-8)
    points = maximise(
        target, sr.load_registry().build("maximiser", "gradient_ascent"), 50, np.random.default_rng(0)
    ).trace.points
    for seen, first in ((objective.seen()[0], start), (points, points[0])):
        assert (seen[0] == first).all() and not (seen[1] == first).all()


@pytest.mark.first(1)
@pytest.mark.parametrize("polish", [0.0, 0.5])
def test_a_polish_takes_the_ascent_for_every_maximiser_and_sees_only_what_can_move(polish):
    class Once(sr.Maximiser):
        def search(self, objective, rng):
            objective.evaluate(objective.domain.lower[np.newaxis])
            assert objective.linear.coordinates.shape == objective.domain.lower.shape
            return float("inf")

    peaks = Peaks()
    target = Target(peaks, peaks.domain, block=peaks.m + 2, linear=peaks.linear)
    report = maximise(target, Once(), 200, np.random.default_rng(0), Rules(polish=polish))
    assert (report.best_value > peaks.maximum - 1e-3) == (polish > 0.0)


def test_a_polish_ends_where_the_ascent_does_and_gives_back_what_is_left():
    class Once(sr.Maximiser):
        def search(self, objective, rng):
            domain = objective.domain
            objective.evaluate(rng.uniform(domain.lower, domain.upper)[np.newaxis])
            return float("inf")

    peaks, few = Peaks(), 5
    target = Target(peaks, peaks.domain, block=peaks.m + 2, linear=peaks.linear)
    report = maximise(target, Once(), 2000, np.random.default_rng(0), Rules(polish=0.9))
    assert report.evaluations < 400 and report.stopped.endswith("; then polished")
    assert report.best_value == pytest.approx(peaks.maximum, abs=1e-8)
    objective = CountedObjective(target, few)
    objective.evaluate(peaks.domain.lower[np.newaxis])
    with pytest.raises(sr.SearchEnded):
        sr.block_ascent(objective)
    assert objective.evaluations == few
    whole = maximise(replace(target, linear=None), Once(), 2000, np.random.default_rng(0), Rules(polish=0.9))
    assert whole.evaluations > 400  # a polish without blocks is as it was


def test_a_polish_that_nobody_speaks_of_is_the_maximiser_s_own_share_where_blocks_are_linear_and_nothing_elsewhere():
    class Yardstick(sr.Maximiser):
        share = 0.0

        @property
        def polished(self):
            return self.share

        def search(self, objective, rng):
            objective.evaluate(objective.domain.lower[np.newaxis])
            return float("inf")

    class Searching(Yardstick):
        share = 0.25

    peaks = Peaks()
    for linear in (peaks.linear, None):
        target = Target(peaks, peaks.domain, block=peaks.m + 2, linear=linear)
        for maximiser in (Searching(), Yardstick()):
            trace = maximise(target, maximiser, 100, np.random.default_rng(0)).trace
            polished = linear is not None and maximiser.share > 0.0
            assert trace.searched == (1 if polished else None)
            assert trace.values.size == (26 if polished else 1)


def test_an_objective_that_is_not_linear_in_blocks_is_left_alone():
    objective = CountedObjective(Target(lambda x: -(x**2).sum(axis=1), sr.Box([-1.0], [1.0])), 10)
    objective.evaluate(np.array([[0.5]]))
    sr.block_ascent(objective)
    assert objective.evaluations == 1


def tuples(disturbance, path, count=3):
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem([[0.0, 1.0], [-2.0, -0.5]], [[0.0], [1.0]]),
        horizon=5.0,
        initial_state=[-1.0, 1.0],
        control=sr.Box([-1.0], [1.0]),
        disturbance=disturbance,
        path=[sr.PathConstraint(path, 0.3)],
        terminal=[sr.Box([-0.5, -0.5], [0.5, 0.5])],
    )
    registry = sr.load_registry()
    dictionary = registry.build("dictionary", "piecewise_constant", {"pieces": PIECES}).build(5.0)
    program = sr.transcribe(problem, control=dictionary, disturbance=dictionary, formulation="literal")
    relaxed = RelaxedProgram(program, registry.build("solver", "piqp", {}), registry.build("regulariser", "ridge", {}))
    g = TupleValue(program, relaxed, count)
    g.epsilon = 0.1
    return g


SETS = {
    "box": sr.Box([-0.03, -0.02], [0.04, 0.05]),
    "ellipsoid": sr.Ellipsoid([0.0, 0.01], [[0.002, 0.0005], [0.0005, 0.001]]),
}
WALLS = {
    "flat": sr.Box([-0.9, -np.inf], [0.9, np.inf]),
    "curved": sr.Ellipsoid([0.0, 0.0], [[1.2, 0.1], [0.1, 3.0]]),
}


@pytest.mark.first(2)
@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize("disturbance", SETS)
def test_the_steepest_index_is_the_one_at_which_no_disturbance_is_worse(disturbance, walls):
    g = tuples(SETS[disturbance], WALLS[walls])
    rng = np.random.default_rng(1)
    point = rng.uniform(g.domain.lower, g.domain.upper)
    g.at(point)
    x = g.solution.x
    vertices = np.array(list(product([0.0, 1.0], repeat=4)))
    for family in g.program.families:
        box = family.index_set
        indices = g.layout.indices(family, point.reshape(-1, g.block))
        for row in (-1, 0):
            found = family.steepest(x, indices, np.full(len(indices), row))
            at = family.violations(x, found.indices)[np.arange(len(indices)), found.rows]
            assert found.violations == pytest.approx(at, abs=1e-12)
            assert (found.indices[:, ~family.linear] == indices[:, ~family.linear]).all()
            for index, which, worst in zip(found.indices, found.rows, at, strict=True):
                others = np.tile(index, (400, 1))
                others[:, family.linear] = rng.uniform(box.lower, box.upper, others.shape)[:, family.linear]
                corners = np.flatnonzero(family.linear)[rng.choice(family.linear.sum(), 4, replace=False)]
                others[: len(vertices), corners] = box.lower[corners] + vertices * (box.upper - box.lower)[corners]
                rows = family.violations(x, others)
                assert (rows[:, which] <= worst + 1e-12).all()
                if row < 0:
                    assert (rows <= worst + 1e-12).all()


@pytest.mark.parametrize("walls", WALLS)
@pytest.mark.parametrize("disturbance", SETS)
def test_the_value_of_a_tuple_does_not_fall_when_all_of_its_indices_go_to_their_vertex(disturbance, walls):
    g = tuples(SETS[disturbance], WALLS[walls], count=5)
    rng = np.random.default_rng(2)
    for _ in range(5):
        point = rng.uniform(g.domain.lower, g.domain.upper)
        before = g.at(point)
        assert g.at(g.linear.steepest(point)) >= before - 1e-9


def test_reduced_tuples_are_not_linear():
    g = tuples(SETS["box"], WALLS["flat"])
    problem = g.program.families[0].reduced
    assert problem.linear is None


def share(tmp_path, pieces, indices, maximiser, seed=0, **rest):
    """The proven lower bound of the paper's method with literal indices, as a share of the exact value."""
    dictionary = {"name": "piecewise_constant", "pieces": pieces}
    dictionaries = {"control": dictionary, "disturbance": dictionary}
    quiet = {"quiet": True, "figures": False}
    exact = sr.run(
        CONFIGS / "experiment1_literal.yaml",
        {"dictionaries": dictionaries, "method": {"name": "exchange"}},
        out=tmp_path / "exact",
        **quiet,
    ).result
    assert exact.status == "certified"
    method = {"name": "sparserob", "formulation": "literal", "indices": indices, "sc2": {"name": "evaluations"}}
    changed = {
        "method": method,
        "maximiser": maximiser,
        "dictionaries": dictionaries,
        "continuation": {"start": 1e-3, "stop": 1e-3},
        "seed": seed,
        **rest,
    }
    found = sr.run(CONFIGS / "experiment1_literal.yaml", changed, out=tmp_path / "found", **quiet).result
    assert found.lower_bound <= exact.upper_bound
    return found.lower_bound / exact.lower_bound


def test_literal_tuples_meet_the_value_in_tens_of_evaluations(tmp_path):
    assert share(tmp_path, 30, 8, {"name": "gradient_ascent", "budget": 100}) >= 0.9999


ASCENT = {"name": "gradient_ascent", "budget": 200}
ANNEALING = {"name": "simulated_annealing", "budget": 500, "polish": 0.2}
SEQUOOL = {"name": "sequool", "budget": 500, "polish": 0.2}


@pytest.mark.slow
@pytest.mark.parametrize(
    "indices, seed, maximiser",
    [
        *((8, seed, maximiser) for seed in range(3) for maximiser in (ASCENT, ANNEALING)),
        (8, 0, SEQUOOL),  # 125 250 coordinates one after another take it minutes
        (250, 0, ASCENT),
        (250, 0, ANNEALING),
    ],
    ids=str,
)
def test_at_the_paper_s_size_literal_tuples_meet_the_value(indices, seed, maximiser, tmp_path):
    assert share(tmp_path, 250, indices, maximiser, seed) >= 0.9999
