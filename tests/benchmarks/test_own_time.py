"""Guards speed: the own time of searches per evaluation: nevergrad's beside bare nevergrad, maxlipo's in 250, 1000 and
4020 coordinates beside one product of all its points with one of them, in one run. Ratios are asserted, never times."""

from __future__ import annotations

import time

import numpy as np
import pytest

import sparserob_core as sr

pytestmark = pytest.mark.benchmark
clock = time.process_time
TURNS = 7


def bowl(points: np.ndarray) -> np.ndarray:
    values: np.ndarray = -((points - 0.3) ** 2).sum(axis=1)
    return values


@pytest.mark.parametrize(("optimiser", "dimension"), [("TwoPointsDE", 2), ("TwoPointsDE", 40), ("CMA", 10)])
def test_nevergrad_takes_hardly_longer_for_an_evaluation_than_without_the_adapter(optimiser, dimension, capsys):
    ng = pytest.importorskip("nevergrad")
    evaluations, box = 300, sr.Box(np.zeros(dimension), np.ones(dimension))

    def bare(seed: int) -> None:
        array = ng.p.Array(shape=(dimension,), lower=np.zeros(dimension), upper=np.ones(dimension))
        array.random_state = np.random.RandomState(seed)
        bare = ng.optimizers.registry[optimiser](parametrization=array, budget=evaluations, num_workers=1)
        for _ in range(evaluations):
            asked = bare.ask()
            bare.tell(asked, -float(bowl(asked.value[np.newaxis])[0]))

    def ours(seed: int) -> None:
        sr.maximise(bowl, box, "nevergrad", budget=evaluations, seed=seed, polish=0.0, optimiser=optimiser)

    bare(0), ours(0)  # imports
    spent = {bare: [], ours: []}
    for turn in range(TURNS):
        for search, seconds in spent.items():
            began = clock()
            search(turn)
            seconds.append(clock() - began)
    least = {search: min(seconds) / evaluations for search, seconds in spent.items()}
    ratio = least[ours] / least[bare]
    with capsys.disabled():
        print(
            f"\n{optimiser}, {dimension} coordinates: bare {1e6 * least[bare]:.0f} us for an evaluation, here"
            f" {1e6 * least[ours]:.0f} us: {ratio:.2f} times"
        )
    assert ratio < 1.6


def test_maxlipo_takes_no_longer_for_an_evaluation_in_thousands_of_coordinates_than_a_few_looks_at_its_points(capsys):
    """A step asks some dozens of candidates at all points, and cannot be faster than their product; the ratio to it
    says how much is added, in 250 coordinates (where calls weigh more than numbers), 1000 and 4020."""
    evaluations, candidates, lines = 400, 32, []
    sr.maximise(bowl, sr.Box(np.zeros(2), np.ones(2)), "maxlipo", budget=5, seed=0, polish=0.0)  # imports
    for dimension in (250, 1000, 4020):
        box = sr.Box(np.zeros(dimension), np.ones(dimension))
        began = clock()
        report = sr.maximise(bowl, box, "maxlipo", budget=evaluations, seed=0, polish=0.0)
        own = (clock() - began) / evaluations
        points = report.trace.points[: evaluations // 2]  # as many as there are in the middle of the search
        products = []
        for _ in range(TURNS):
            began = clock()
            points @ points[:candidates].T
            products.append(clock() - began)
        lines.append((dimension, own, own / min(products)))
    with capsys.disabled():
        for dimension, own, ratio in lines:
            print(
                f"\nmaxlipo, {dimension} coordinates: {1e3 * own:.1f} ms for one of {evaluations} evaluations,"
                f" {ratio:.0f} times a product of its points with the candidates of a step",
                end="",
            )
        print()
    assert lines[-1][2] < 30.0
    assert lines[-1][1] < 16.0 * lines[0][1]  # as many times as there are coordinates
