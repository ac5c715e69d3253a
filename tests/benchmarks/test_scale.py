"""Guards speed: what an experiment takes as its pieces grow in number, and what many states take: seconds, memory,
files; the whole command, and its check."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from tests.support.places import CONFIGS

pytestmark = pytest.mark.benchmark

EXPONENT = 1.15
GOALS = {10_000: (3.0, 400.0), 100_000: (20.0, 2000.0)}  # seconds, MB


def command(pieces: int, out: Path) -> tuple[float, float, float]:
    """Seconds of the processor, megabytes and bytes of the certificate for each piece."""
    changes = [f"dictionaries.{name}.pieces={pieces}" for name in ("control", "disturbance")]
    asked = [sys.executable, "-m", "sparserob_core", "run", str(CONFIGS / "experiment1_repaired.yaml"), *changes]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run([*asked, "--no-figures", "--quiet", "--out", str(out)], check=True, timeout=600)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert json.loads((out / "result.json").read_text())["status"] == "certified"
    assert spent <= 3.0 * (time.perf_counter() - began)
    return spent, after.ru_maxrss / 1024.0, (out / "certificate.json").stat().st_size / pieces


def test_seconds_and_memory_grow_no_faster_than_the_pieces(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = np.array([250, 1000, 10_000, 100_000])  # increasing, since memory is the largest so far
    found = np.array([command(int(size), tmp_path / str(size)) for size in sizes])
    own = found[1:, :2] - found[0, :2]  # without what every process takes
    slopes = np.polyfit(np.log(sizes[2:]), np.log(own[1:]), 1)[0]
    with capsys.disabled():
        for size, (seconds, memory, share) in zip(sizes, found, strict=True):
            print(f"\n{size} pieces: {seconds:.2f} s, {memory:.0f} MB, certificate {share:.0f} bytes a piece", end="")
        print(f"\nexponents: time {slopes[0]:.2f}, memory {slopes[1]:.2f}")
    assert (slopes <= EXPONENT).all()
    for size, (seconds, memory, _) in zip(sizes, found, strict=True):
        most = GOALS.get(int(size), (np.inf, np.inf))
        assert seconds <= most[0] and memory <= most[1]


def test_a_hundred_thousand_pieces_are_checked_within_memory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command(100_000, tmp_path / "run")
    code = (
        "import resource, sys, time; import sparserob_core as sr; found = sr.check(sys.argv[1]);"
        "print(found.status, time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "run")], check=True, timeout=1200, capture_output=True, text=True
    )
    status, seconds, memory = done.stdout.split()
    with capsys.disabled():
        print(f"\ncheck of 100 000 pieces: {status}, {float(seconds):.1f} s, {float(memory):.0f} MB")
    assert status == "verified"
    assert float(memory) <= 2000.0


def chain(states: int, constrained: int, room: float = 1.2) -> sr.OptimalControlProblem:
    """Masses in a row between springs, pulled at four of them, with a disturbance at two others: the pulled ones, and
    their neighbours by half, begin away from rest; some are to stay near it, within ``room``, and the pulled ones are
    to end there."""
    masses, d = states // 2, states
    stiffness = 2.0 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    A = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-stiffness, -0.1 * stiffness - 0.05 * np.eye(masses)]])
    pulled, hit = (np.linspace(0, masses - 1, count).round().astype(int)[1:-1] for count in (6, 4))
    start = np.zeros(d)
    start[pulled], start[pulled - 1], start[pulled + 1] = 3.0, 1.5, 1.5
    others = np.linspace(0, masses - 1, constrained - pulled.size).round().astype(int)
    stays, ends = np.unique(np.concatenate([pulled, others]))[:constrained], np.concatenate([pulled, masses + pulled])

    def near(which: np.ndarray, bound: float) -> sr.Polytope:
        rows = np.eye(d)[which]
        return sr.Polytope(np.vstack([rows, -rows]), np.full(2 * which.size, bound))

    return sr.OptimalControlProblem(
        system=sr.LinearSystem(A, np.eye(d)[:, masses + pulled], np.eye(d)[:, masses + hit]),
        horizon=5.0,
        initial_state=start,
        control=sr.Box(-4.0 * np.ones(pulled.size), 4.0 * np.ones(pulled.size)),
        disturbance=sr.Box(-0.02 * np.ones(hit.size), 0.02 * np.ones(hit.size)),
        path=[sr.PathConstraint(near(stays, room), start=1.5)],
        terminal=[near(ends, 0.1)],
    )


@pytest.mark.parametrize(
    ("states", "pieces", "room", "most"),
    [(100, 100, 1.2, 3.0), (200, 1000, 1.2, 30.0), (200, 10_000, 0.5, 30.0), (200, 100_000, 0.5, 60.0)],
)
def test_a_chain_of_masses(
    states: int, pieces: int, room: float, most: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """In seconds of the processor, and with no more than 2 GB. With less room the path constraint is active too."""
    sr.solve(chain(10, 4), control={"name": "piecewise_constant", "pieces": 10})  # what is imported is not measured
    began = time.process_time()
    found = sr.solve(chain(states, 10, room), control={"name": "piecewise_constant", "pieces": pieces})
    spent, memory = time.process_time() - began, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    active = sorted({cut.family for cut in found.dual.cuts})
    with capsys.disabled():
        print(
            f"\n{states} states, {pieces} pieces: {found.status}, J = {found.value:.6f}, {spent:.1f} s,"
            f" {memory:.0f} MB, active: {', '.join(active)}"
        )
    assert found.status == "certified"
    assert active == (["path", "terminal"] if room < 1.0 else ["terminal"])
    assert spent <= most
    assert memory <= 2000.0
