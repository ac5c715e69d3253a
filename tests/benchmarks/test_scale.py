"""Guards speed: what an experiment takes as its pieces grow in number: seconds, memory, files; the whole command."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

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
