"""Guards speed: what a step of a controller takes: a policy applied, and a re-solve with both bounds and its proof."""

from __future__ import annotations

import time

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.loop.controller import resolving
from tests.support.places import CONFIGS

pytestmark = pytest.mark.benchmark
WARMED, MEASURED = 40, 60
CONFIG = {
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [-1, 1],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.05, 0.05]},
        "path": [{"box": [0.7, None], "from": 0.5}],
        "terminal": [{"box": [0.3, 0.3]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 250}},
}


def told(capsys: pytest.CaptureFixture[str], what: str, seconds: list[float]) -> float:
    median, late = np.quantile(1e3 * np.array(seconds), [0.5, 0.99])
    with capsys.disabled():
        print(f"\n{what}: {median:.2f} ms (median), {late:.2f} ms (99 %)")
    return float(median)


def test_a_warm_re_solve_of_250_pieces_is_ten_times_faster_than_the_exchange(tmp_path, capsys) -> None:
    outcome = sr.run(CONFIG, out=tmp_path / "run", quiet=True, figures=False)
    plan, resolver, rng = sr.controller(outcome).plan, resolving(outcome.experiment, None), np.random.default_rng(0)
    quick, slow = [], []
    for number in range(WARMED + MEASURED):
        state, began = np.array([-1, 1]) + 0.02 * rng.standard_normal(2), time.perf_counter()
        answer = resolver.answer(plan, 0, state, None, [np.zeros(2)])
        quick += [time.perf_counter() - began] if number >= WARMED else []
        assert answer.plan is not None
        assert answer.cost - answer.lower <= 1e-7 * answer.cost
    resolver._trackers[0] = None
    for _ in range(5):
        state, began = np.array([-1, 1]) + 0.02 * rng.standard_normal(2), time.perf_counter()
        resolver.answer(plan, 0, state, None, [np.zeros(2)])
        slow.append(time.perf_counter() - began)
    median = told(capsys, "open loop, 250 pieces, one new initial state", quick)
    assert 10.0 * median <= told(capsys, "the same by the exchange, from the rows of the plan", slow)


def test_a_policy_is_applied_or_retuned_in_a_fraction_of_a_re_solve(tmp_path, capsys) -> None:
    overrides = {"dictionaries.control.pieces": 40, "policy.cost": "nominal"}
    outcome = sr.run(CONFIGS / "experiment1_feedback.yaml", overrides, tmp_path / "run", quiet=True, figures=False)
    medians = []
    for what, resolve, seconds, steps in (
        ("applied", False, None, 40),
        ("the nominal control chosen anew", True, 0.02, 40),
        ("the whole program solved anew", True, None, 4),  # which takes seconds
    ):
        controller, spent = sr.controller(outcome, resolve, seconds=seconds), list[float]()
        for _ in range(1 if steps < 40 else 5):
            controller.reset()
            state, rng = np.array([-1.0, 1.0]), np.random.default_rng(0)
            for begin in controller.breakpoints[:steps]:
                controller.step(begin, state)
                state = outcome.tube([float(begin) + 0.125]).nominal[:, 0] + 0.01 * rng.uniform(-1, 1, 2)
            spent += [one.seconds for one in controller.steps]
        medians.append(told(capsys, f"feedback, 40 pieces, {what}", spent))
    assert 100.0 * medians[0] <= medians[2]
    assert 20.0 * medians[1] <= medians[2]
