"""Guards speed: a certified solve of experiment 1 with 50 pieces in a process that has done it before, beside one cold
solve of its final program alone, in one run.

The cold solvers are given the rows that were imposed in the end, ready made, in the sparse epigraph form that one
would write by hand; they prove nothing between the samples.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest

import sparserob_core as sr
from tests.benchmarks.test_annealing_moves import cold

pytestmark = pytest.mark.benchmark

PIECES, TIMES = 50, 60
MOST, GOAL = {"again": 10.0, "anew": 30.0}, 0.010  # cold solves of PIQP; seconds


def problem(velocity: float = 1.0) -> sr.OptimalControlProblem:
    return sr.OptimalControlProblem(
        system=sr.LinearSystem([[0, 1], [-2, -0.5]], [[0], [1]], np.eye(2)),
        horizon=5.0,
        initial_state=[-1, velocity],
        control=sr.Box([-1.0], [1.0]),
        disturbance=sr.Box([-0.06, -0.06], [0.06, 0.06]),
        path=[sr.PathConstraint(sr.Box([-0.7, -np.inf], [0.7, np.inf]), start=0.3)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )


def median(run: Callable[[int], object]) -> float:
    """Seconds of the processor, the median of many runs, which are told their number."""
    run(0), run(1)
    seconds = []
    for number in range(TIMES):
        began = time.process_time()
        run(number)
        seconds.append(time.process_time() - began)
    return float(np.median(seconds))


def measured() -> dict[str, float]:
    """Medians in seconds. Again: the same program. Anew: a problem that was never seen, from an initial state of its
    own."""
    program = sr.transcribe(problem(), sr.Dictionary.indicators(np.linspace(0.0, 5.0, PIECES + 1)))
    found = sr.solve(program, regulariser="ridge")
    assert found.status == "certified"

    def anew(number: int) -> None:
        solved = sr.solve(problem(1.0 - 0.002 * number), control={"name": "piecewise_constant", "pieces": PIECES})
        assert solved.status == "certified"

    spent = {"again": median(lambda _: sr.solve(program, regulariser="ridge")), "anew": median(anew)}
    rows = [program.family(cut.family).rows(cut.index[None]) for cut in found.indices]
    G, h = (np.array([part[i][0, cut.row] for part, cut in zip(rows, found.indices, strict=True)]) for i in (0, 1))
    for solver, weight in (("piqp", found.epsilon), ("highs", 0.0)):
        answers: list[np.ndarray] = []
        spent[solver] = median(
            lambda _, one=solver, w=weight, kept=answers: kept.append(cold(program, G, h, w, one)[1])
        )
        assert abs(float(program.finite.weights @ np.abs(answers[-1])) - found.upper_bound) <= 1e-3
    return spent


def test_a_certified_solve_costs_a_few_cold_ones(capsys: pytest.CaptureFixture[str]) -> None:
    """In a process of its own, in which no shapes are checked."""
    code = "import json; from tests.benchmarks.test_small_problems import measured; print(json.dumps(measured()))"
    done = subprocess.run([sys.executable, "-c", code], check=True, timeout=600, capture_output=True, text=True)
    spent = json.loads(done.stdout.splitlines()[-1])  # HiGHS may have introduced itself before
    with capsys.disabled():
        print(f"\n{PIECES} pieces: " + ", ".join(f"{name} {1e3 * one:.1f} ms" for name, one in spent.items()))
    for name, most in MOST.items():
        assert spent[name] <= most * spent["piqp"]
    if spent["again"] > GOAL:
        pytest.xfail(f"the goal is {GOAL:g} s, it took {spent['again']:.4f} s")
