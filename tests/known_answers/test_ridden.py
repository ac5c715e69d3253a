"""Guards that who rides a wall is not left without a proven control: problems of ordinary kinds, drawn at random."""

from __future__ import annotations

import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.limits import deadline as limits
from sparserob_core.sip.limits.deadline import Deadline
from tests.support.draws import taken
from tests.support.ridden import unseen

DRAWN = (1, 2, 4, 7, 12, 13, 18, 21, 22, 25, 27, 28)  # of which a proven control is known


def test_equal_numbers_give_equal_problems_and_others_give_others() -> None:
    assert unseen(3) == unseen(3)
    assert len({unseen(seed).said for seed in range(30)}) > 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", DRAWN[: taken(len(DRAWN))])
def test_a_wall_that_is_ridden_leaves_a_proven_control_after_seconds(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seconds of the processor: a busy machine takes longer by the clock."""
    clock = SimpleNamespace(monotonic=time.process_time, perf_counter=time.process_time)
    monkeypatch.setattr(limits, "time", clock)
    monkeypatch.setattr(Deadline, "enforced", lambda self: nullcontext())  # its alarm goes by the clock on the wall
    result = sr.run(unseen(seed).config, {"limits.seconds": 5}, quiet=True, figures=False).result
    assert result.status in ("certified", "verified")
    assert result.lower_bound <= result.upper_bound < np.inf
