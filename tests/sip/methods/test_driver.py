"""Guards sip/methods/driver: every run passes the same functions of driver, exchange, ledger and tightening, whatever
is imposed; a driver ends with the first result, or with what is known."""

from __future__ import annotations

import signal
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import sparserob_core as sr
from sparserob_core.experiment.assemble import assemble, tools_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.sip.limits import deadline as limits
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods import driver, exchange
from sparserob_core.sip.methods.driver import drive
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.result import Result
from sparserob_core.sip.working import ledger, tightening, working
from tests.support.entered import CORE, entered
from tests.support.problems import spring

SHARED = [
    str(Path(str(module.__file__)).relative_to(CORE)) for module in (driver, exchange, ledger, tightening, working)
]
RESULT = Result(status="undecided", message="", counts={}, seconds=0.0)


def case(policy: str) -> tuple[sr.SemiInfiniteProgram, Tools]:
    problem = spring(0.05, since=0.5)
    control = {"name": "piecewise_constant", "pieces": 4}
    config = {"problem": problem, "dictionaries": {"control": control}, "policy": {"name": policy}}
    loaded = load_config(config)
    return assemble(loaded).program, tools_of(loaded)


def test_a_run_with_feedback_and_one_without_pass_the_same_functions_of_the_driver() -> None:
    cases = [case(policy) for policy in ("open_loop", "affine")]
    assert [program.spread is None for program, _ in cases] == [True, False]
    results, passed = zip(*[entered(partial(Exchange().solve, *each), *SHARED) for each in cases], strict=True)
    assert [result.status for result in results] == ["certified", "certified"]
    # what tightens a decision is asked for that by the course of a run, which is not the same
    met = [{one for one in each if not one.startswith("sip.working.tightening._")} for each in passed]
    assert met[0] == met[1]
    steps = {f"sip.methods.exchange.Rounds.{name}" for name in ("step", "_explain_ending", "_choose_result")}
    assert steps | {"sip.methods.driver.drive", "sip.working.tightening.proofs_of"} <= passed[0]
    assert {"sip.working.working.Working.pay", "sip.working.ledger.Ledger.tell"} <= passed[0]


def test_the_first_step_with_a_result_is_the_last() -> None:
    taken: list[int] = []

    def step(number: int) -> Result | None:
        taken.append(number)
        return RESULT if number == 3 else None

    assert drive(Deadline(), step, pytest.fail) is RESULT
    assert taken == [1, 2, 3]


@pytest.mark.parametrize("when", ["before a step", "within a step"])
def test_what_is_known_is_the_answer_where_the_time_is_over(when: str) -> None:
    deadline, errors = Deadline(), list[KeyboardInterrupt]()

    def step(number: int) -> Result | None:
        if number == 2:
            raise AssertionError("no step is begun when the time is over")
        if when == "within a step":
            raise KeyboardInterrupt
        deadline.interrupt(OutOfTime("the time is over"))
        return None

    def stopped(error: KeyboardInterrupt) -> Result:
        errors.append(error)
        return RESULT

    assert drive(deadline, step, stopped) is RESULT
    assert [isinstance(error, OutOfTime) for error in errors] == [when == "before a step"]


def test_a_library_that_makes_another_error_of_the_alarm_ends_the_run_like_the_alarm(monkeypatch: Any) -> None:
    monkeypatch.setattr(limits, "LIMIT_GRACE_SECONDS", 0.0)

    def step(number: int) -> Result:
        try:
            signal.pause()
        except OutOfTime:
            raise TypeError("cannot compare") from None
        return RESULT

    heard: list[KeyboardInterrupt] = []

    def stopped(error: KeyboardInterrupt) -> Result:
        heard.append(error)
        return RESULT

    assert drive(Deadline(0.01), step, stopped) is RESULT
    assert [type(error) for error in heard] == [OutOfTime] and isinstance(heard[0].__cause__, TypeError)

    def broken(number: int) -> Result:
        raise TypeError("cannot compare")

    with pytest.raises(TypeError):
        drive(Deadline(60.0), broken, stopped)
