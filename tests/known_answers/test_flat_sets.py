"""Guards runs with sets that have no interior, or none that doubles resolve: what a run claims `check` verifies, costs
are those of independent programs, and controllers know the states that such sets lead to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from tests.support.draws import taken
from tests.support.flat_sets import Problem, Span, draw, value

# a kind of set each: boxes, polytopes, balls, ellipsoids, zonotopes; everywhere, without and with feedback
FIRST = (4, 19, 34, 40, 43, 56, 64, 73, 74, 79, 85, 86, 94, 109)
COUNT = taken(240)
REST = [seed for seed in np.random.default_rng(41).permutation(240).tolist() if seed not in FIRST][:COUNT]


def within(span: Span | None, rng: np.random.Generator, d: int) -> np.ndarray:
    """A point well within a span."""
    return np.zeros(d) if span is None else span.c + span.V @ rng.uniform(-0.999, 0.999, size=span.V.shape[1])


def is_covered(problem: Problem, outcome: sr.Outcome, seed: int, off: float = 0.0) -> bool:
    """Whether a controller says so of what a disturbance within its set does from an initial state within its own, the
    first of them ``off`` by so much along every axis."""
    rng, controller = np.random.default_rng(seed), sr.controller(outcome)
    d, step = len(problem.A), problem.horizon / problem.pieces
    big = expm(step * np.block([[problem.A, problem.B, np.eye(d)], [np.zeros((1 + d, 2 * d + 1))]]))
    x = problem.x + within(problem.initial, rng, d) + off
    for time in controller.breakpoints[: problem.pieces]:
        u = controller.step(float(time), x)
        x = big[:d] @ np.concatenate([x, u, within(problem.disturbance, rng, d)])
    return controller.covered


@pytest.mark.parametrize("seed", [*FIRST, *(pytest.param(seed, marks=pytest.mark.slow) for seed in REST)])
def test_a_run_with_thin_sets_ends_as_check_and_an_independent_program_say(seed: int, tmp_path: Path) -> None:
    problem = draw(seed)
    outcome, expected = sr.run(problem.config, out=tmp_path / "run", quiet=True, figures=False), value(problem)
    assert {claim.verdict for claim in sr.check(outcome).claims} == {"holds"}
    if np.isinf(expected):
        assert outcome.status == "infeasible"
        return
    assert outcome.status == "certified"
    assert outcome.summary["cost"] == pytest.approx(expected, rel=2e-7, abs=1e-9)
    assert outcome.summary["lower_bound"] == pytest.approx(expected, rel=2e-7, abs=1e-9)
    assert all(is_covered(problem, outcome, number) for number in range(3))
    assert not is_covered(problem, outcome, 0, off=0.1)


@pytest.mark.parametrize("seed", [65, 85])
@pytest.mark.parametrize("thick", [1e-10, pytest.param(1e-9, marks=pytest.mark.slow), 1e-8, 1e-7])
def test_between_a_point_and_a_set_nothing_is_lost(seed: int, thick: float, tmp_path: Path) -> None:
    """Of disturbances (65) and initial states (85): effects were numbers of 1e8, and named points rounded."""
    config = draw(seed).config
    if seed == 85:
        config["problem"]["initial_state"]["box"] = {"lower": [-thick] * 2, "upper": [thick] * 2}
    else:
        box = config["problem"]["disturbance"]["box"]
        box["upper"][0] = box["lower"][0] + 2.0 * thick
    outcome = sr.run(config, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status in ("certified", "verified")
    assert outcome.summary["cost"] == pytest.approx({65: 2.5114338, 85: 1.2992414}[seed], rel=1e-6)
    assert outcome.summary["cost"] - outcome.summary["lower_bound"] <= 1e-5
    assert {claim.verdict for claim in sr.check(outcome).claims} == {"holds"}


def test_the_draws_hold_every_kind_of_set_thickness_place_and_policy() -> None:
    every = [draw(seed) for seed in range(240)]
    assert len({(one.kind, one.thick, one.place, one.policy) for one in every}) == 5 * 3 * 4 * 2 - 2 * 3 * 2
    spans = [one.disturbance or one.initial for one in every if one.place in ("disturbance", "initial")]
    assert {span.V.shape for span in spans if span is not None} == {(2, 0), (2, 1), (3, 0), (3, 1), (3, 2)}
