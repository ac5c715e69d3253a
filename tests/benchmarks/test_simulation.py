"""Guards speed: ten thousand exact trajectories beside a plain loop over them with scipy, in one run on one machine."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.control.studies.simulate import fine_times, refine_grid, simulate_states
from sparserob_core.control.transcription.transcribe import prepare

PIECES, TRAJECTORIES, LOOPED = 250, 10_000, 20
CONFIG = {
    "title": "Spring-mass-damper under process noise",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [-2, -0.5]], "B": [[0], [1]]},
        "horizon": 5.0,
        "initial_state": [-1, 1],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.06, 0.06]},
        "path": [{"box": [0.7, None], "from": 0.3}],
        "terminal": [{"box": [0.3, 0.3]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": PIECES}},
}


def looped(A, B, control, disturbances, start, times, which):
    """One trajectory after another, one exponential per length of a step."""
    lengths = np.diff(times)
    flows = {}
    for length in np.unique(np.round(lengths, 12)):
        block = np.zeros((4, 4))
        block[:2, :2], block[:2, 2:] = A, np.eye(2)
        flows[length] = expm(block * length)
    paths = np.empty((len(disturbances), times.size, 2))
    for number, signal in enumerate(disturbances):
        state = paths[number, 0] = start
        for step, length in enumerate(np.round(lengths, 12)):
            flow = flows[length]
            state = flow[:2, :2] @ state + flow[:2, 2:] @ (B @ control[:, which[step]] + signal[:, which[step]])
            paths[number, step + 1] = state
    return paths


@pytest.mark.benchmark
def test_many_trajectories_cost_far_less_than_a_loop_over_them():
    dictionary = Dictionary(np.linspace(0.0, 5.0, PIECES + 1), np.eye(PIECES))
    A, B = np.array([[0.0, 1.0], [-2.0, -0.5]]), np.array([[0.0], [1.0]])
    problem = sr.OptimalControlProblem(
        system=sr.LinearSystem(A, B),
        horizon=5.0,
        initial_state=[-1, 1],
        control=sr.Box([-1], [1]),
        disturbance=sr.Box([-0.06, -0.06], [0.06, 0.06]),
    )
    model = prepare(problem, dictionary, dictionary)
    times = fine_times(model.response, ParameterIndex(None), np.zeros(0))
    fine = Response(problem.system, refine_grid(model.response.grid, times), model.response.initial_state)
    rng = np.random.default_rng(0)
    control, disturbances = rng.uniform(-1, 1, (1, PIECES)), rng.uniform(-0.06, 0.06, (2000, 2, PIECES))
    started = time.perf_counter()
    paths = np.stack(list(simulate_states(fine, control, np.zeros((2000, 0)), disturbances)))
    ours = (time.perf_counter() - started) / 2000
    started = time.perf_counter()
    theirs_paths = looped(
        A, B, control, disturbances[:LOOPED], model.response.initial_state, times, fine.grid.control_piece
    )
    theirs = (time.perf_counter() - started) / LOOPED
    assert np.abs(paths[:, :, :LOOPED].transpose(2, 0, 1) - theirs_paths).max() <= 1e-10
    print(
        f"\none trajectory at {times.size} times: batched {1e6 * ours:.1f} us, loop {1e6 * theirs:.1f} us,"
        f" {theirs / ours:.0f} times as long"
    )
    assert theirs > 20 * ours


@pytest.mark.benchmark
@pytest.mark.parametrize("law", ["iid", "vertices", "slow", "neighbours"])
def test_ten_thousand_trajectories_take_less_than_a_second(law, tmp_path):
    outcome = sr.run(CONFIG, out=tmp_path / "run", quiet=True, figures=False)
    seconds = min(sr.simulate(outcome, TRAJECTORIES, law).seconds for _ in range(3))
    print(f"\n{law}: {TRAJECTORIES} trajectories, {PIECES} pieces: {seconds:.3f} s")
    assert seconds < 1.0
