"""Guards speed: certified runs of programs that are stated as text, and their checks, beside a plain exchange with
HiGHS that knows the peaks of a fine grid and proves nothing."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest

import sparserob_core as sr
from tests.known_answers.test_programs import VALUES
from tests.support.places import CONFIGS

pytestmark = pytest.mark.benchmark

# times of the plain exchange: for the run, and for the check
MOST = {"long_filter": (2.0, 2.0), "equiripple": (6.0, 4.0), "band_pass": (4.0, 4.0)}
STOCKS, ROUNDS = 4.0, 25  # seconds of the processor, where a machine takes two; rounds of the exchange


def least(call: Callable[[], object]) -> float:
    """Seconds of the processor, the least of three calls after one that is not counted."""
    call()
    seconds = []
    for _ in range(3):
        start = time.process_time()
        call()
        seconds.append(time.process_time() - start)
    return min(seconds)


@pytest.mark.parametrize("name", MOST)
def test_a_run_and_its_check_take_no_longer_than_a_few_plain_exchanges(name: str, tmp_path: Path) -> None:
    numbers = iter(range(100))

    def run() -> None:
        out = tmp_path / str(next(numbers))
        assert sr.run(CONFIGS / f"{name}.yaml", {"observers": []}, out=out, figures=False).result.status == "certified"

    plain, whole = least(VALUES[name]), least(run)
    check = least(lambda: sr.check(tmp_path / "0"))
    print(f"{name}: plain {plain:.2f} s, run {whole / plain:.2f} and check {check / plain:.2f} times as long")
    assert whole <= MOST[name][0] * plain
    assert check <= MOST[name][1] * plain


def test_a_bound_from_moments_in_three_coordinates_takes_few_rounds(tmp_path: Path) -> None:
    start = time.process_time()
    run = sr.run(CONFIGS / "option_three_stocks.yaml", {"observers": []}, out=tmp_path / "run", figures=False)
    seconds = time.process_time() - start
    assert run.result.status == "certified" and run.result.counts["rounds"] <= ROUNDS
    assert seconds <= STOCKS
