"""Guards sip/inner/simplex/interruptible: HiGHS ends at an interrupt, and what it makes of whole numbers."""

from __future__ import annotations

import signal
import threading
import time
from typing import Any

import highspy
import numpy as np
import pytest
from scipy.optimize import LinearConstraint

from sparserob_core.sip.inner.simplex import interruptible
from sparserob_core.sip.inner.simplex.interruptible import run, solve_with_integers


def long(seconds: float) -> tuple[np.ndarray, list[LinearConstraint], np.ndarray, np.ndarray, int, float, float]:
    """A covering program in whole numbers that takes HiGHS far more than these seconds."""
    rng = np.random.default_rng(1)
    table = rng.uniform(size=(60, 120))
    return rng.uniform(size=120), [LinearConstraint(table, 12.0, np.inf)], np.zeros(120), np.ones(120), 0, seconds, 0.0


def test_whole_numbers_cost_least() -> None:
    cost, lower, upper = np.ones(3), np.array([-1.0, 0.0, 0.0]), np.array([3.0, 1.0, 1.0])
    row = np.array([[1.0, 2.0, 3.5]])
    found = solve_with_integers(cost, [LinearConstraint(row, 4.0, np.inf)], lower, upper, 1, 5.0, 0.0)
    assert found is not None
    np.testing.assert_allclose(found, [-1.0, 1.0, 1.0], atol=1e-9)
    assert solve_with_integers(cost, [LinearConstraint(row, 40.0, np.inf)], lower, upper, 1, 5.0, 0.0) is None


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no alarm")
def test_an_interrupt_ends_the_solver() -> None:
    def ring(number: int, frame: Any) -> None:
        raise KeyboardInterrupt("now")

    before = signal.signal(signal.SIGALRM, ring)
    began = time.monotonic()
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        with pytest.raises(KeyboardInterrupt, match="now"):
            solve_with_integers(*long(60.0))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert time.monotonic() - began < 20.0


def test_who_does_not_look_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruptible, "HIGHS_GRACE_SECONDS", 0.01)
    waited: list[Any] = []
    monkeypatch.setattr(interruptible.atexit, "register", waited.append)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a script runs this beside itself
    free = threading.Event()

    class Heard:
        def __iadd__(self, asked: object) -> Heard:
            return self

    class Deaf:
        cbSimplexInterrupt = cbIpmInterrupt = cbMipInterrupt = Heard()

        def run(self) -> None:
            signal.raise_signal(signal.SIGINT)
            free.wait(10.0)

    try:
        with pytest.raises(KeyboardInterrupt):
            run(Deaf())
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(waited) == 1
    free.set()
    assert waited[0](5.0)


def test_after_an_interrupt_the_same_program_is_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(interruptible, "HIGHS_GRACE_SECONDS", 20.0)  # a loaded machine hears late
    highs = highspy.Highs()
    for name, value in (("output_flag", False), ("solver", "simplex"), ("presolve", "off")):
        highs.setOptionValue(name, value)
    columns, number = [highs.addVariable(0.0, 1.0, -1.0) for _ in range(3)], signal.SIGINT
    highs.addConstr(columns[0] + columns[1] + columns[2] <= 2.0)
    real, before = highs.run, signal.signal(number, signal.default_int_handler)

    class Interrupted:
        """The program, whose first run is interrupted from the keyboard."""

        def __getattr__(self, name: str) -> Any:
            return getattr(highs, name)

        def __setattr__(self, name: str, value: Any) -> None:
            setattr(highs, name, value)

        def run(self) -> Any:
            signal.raise_signal(number)
            time.sleep(0.2)  # until the main thread has heard of it
            return real()

    try:
        with pytest.raises(KeyboardInterrupt):
            run(Interrupted())
        assert highs.getModelStatus() == highspy.HighsModelStatus.kInterrupt
        run(highs)
    finally:
        signal.signal(number, before)
    assert highs.getModelStatus() == highspy.HighsModelStatus.kOptimal
    assert highs.getInfo().objective_function_value == pytest.approx(-2.0)


def test_in_another_thread_it_just_solves() -> None:
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    solving = threading.Thread(target=run, args=(highs,))
    solving.start()
    solving.join()
    assert highs.getModelStatus() == highspy.HighsModelStatus.kModelEmpty
