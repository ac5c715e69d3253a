"""Guards that a limit is kept whatever the problem is, and that what is known then is a directory that `check` takes:
sip/deadline, sip/apart, the conclusion of a run, certificates without a decision."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.inner.simplex.counterpart import Counterpart, RobustAnswer
from sparserob_core.sip.limits import apart
from sparserob_core.sip.limits.apart import call_apart
from sparserob_core.sip.limits.deadline import LAST_STEP_SECONDS, LIMIT_GRACE_SECONDS, Deadline, OutOfTime

LATE = 2.0  # seconds by which a limit may be missed, of the processor: other processes take their share of the wall's
FORKS = pytest.mark.skipif(not apart.POSSIBLE, reason="there is no fork here")


def chain(states: int, controls: int, pieces: int, **more: Any) -> dict[str, Any]:
    """Damped states in a row that are coupled with their neighbours, from 1 to a box around 0."""
    A = -0.5 * np.eye(states) + 0.4 * (np.eye(states, k=1) + np.eye(states, k=-1))
    B = np.zeros((states, controls))
    B[(np.arange(controls) * states) // controls, np.arange(controls)] = 1.0
    problem = {
        "name": "linear",
        "horizon": 4.0,
        "system": {"A": A.tolist(), "B": B.tolist()},
        "initial_state": [1.0] * states,
        "control": {"box": 2.0},
        "disturbance": {"box": [0.01] * states},
        "path": [{"box": [1.5] * states}],
        "terminal": [{"box": [0.3] * states}],
        **more.pop("problem", {}),
    }
    return {
        "problem": problem,
        "dictionaries": {"control": {"name": "piecewise_constant", "pieces": pieces}},
        "observers": [],
        **more,
    }


OF_TIME = {
    "parameters": {"a": [0.1, 0.3], "b": [0.2, 0.5]},
    "A": [["-a", "b*sin(t)", "0"], ["0.1", "-b", "0.5*exp(-a*t)"], ["b*a", "0.3", "-1"]],
    "B": [["1"], ["0"], ["a"]],
}
MEASURABLE = {
    "system": {
        "A": [["-0.2 - exp(-p*t) + 0.5*q*(1 + q)*sin(t)", 0.1], [0.2, "-0.1 + 0.8*exp(-0.4*t)"]],
        "B": [[1.0], ["-0.2 - 0.8/(1 + 0.3*t)"]],
        "parameters": {"p": [-0.008, 0.016], "q": [-0.009, 0.007]},
        "delay": 0.9,
    },
    "initial_state": [-0.1, 0.5],
    "initial_control": [0.75],
    "control": {"box": {"lower": [-0.3], "upper": [2.5]}},
    "disturbance": [
        {"set": {"box": 0.003}, "E": [["0.9 + 0.2*sin(2*t)"], [-0.8]], "class": "measurable"},
        {"set": {"box": 0.004}, "E": [[-0.6], [0.3]], "class": "measurable"},
    ],
    "execution": [0.03],
    "path": [{"box": [8.0, 8.0]}, {"box": [9.0, 9.0], "from": 2.5}],
    "terminal": [{"box": [5.0, 5.0]}],
}
HEAVY = {
    "measurable_beside_parameters": (chain(2, 1, 40, problem=MEASURABLE), 1.0),
    "in_time_and_parameters": (chain(3, 1, 30, problem={"system": OF_TIME}), 1.0),
    "states": (chain(60, 3, 300), 1.0),
    "channels": (chain(20, 5, 500), 2.0),
    "feedback": (chain(4, 1, 80, policy={"name": "affine"}), 2.0),
    "feedback_of_the_worst": (chain(4, 2, 60, policy={"name": "affine", "cost": "worst"}), 1.0),
    "literal": (chain(3, 1, 60, method={"name": "sparserob", "formulation": "literal"}), 1.0),
    "sparsest": (chain(8, 3, 200, method={"name": "sparsest"}), 2.0),
    "a_dense_solver": (chain(10, 4, 300, solver={"name": "proxqp"}), 1.0),
    "execution": (chain(20, 2, 60, problem={"execution": 0.02}), 1.0),
    "fast": (chain(2, 1, 8, problem={"system": {"A": [[0, 1], ["-1 + sin(10000*t)", 0]], "B": [[0], [1]]}}), 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HEAVY)
def test_a_limit_is_kept_and_what_is_known_then_is_checked(name: str, tmp_path: Path) -> None:
    config, seconds = HEAVY[name]
    began = time.process_time()
    outcome = sr.run(config, {"limits.seconds": seconds}, out=tmp_path / "run", quiet=True)
    assert time.process_time() - began <= seconds + LATE
    assert outcome.status in ("certified", "verified", "refuted", "undecided", "infeasible")
    assert outcome.result.lower_bound >= 0.0
    found = sr.check(tmp_path / "run", seconds=20.0)
    assert not [claim for claim in found.claims if claim.verdict == "fails"]


def small(**more: Any) -> dict[str, Any]:
    system = {"A": [[0, 1], [0, 0]], "B": [[0], [1]]}
    return chain(2, 1, 20, problem={"system": system, "terminal": [{"box": [0.5, 0.3]}], **more})


def overslept(steps: int) -> Any:
    """A step that lasts for ever, as far as the processor is concerned, in so many parts."""

    def step(*_: object, **__: object) -> object:
        for _ in range(steps):
            time.sleep(0.01)
        raise AssertionError("nobody has looked at the time")

    return step


@pytest.mark.parametrize(
    ("place", "status"),
    [
        ("sparserob_core.control.transcription.transcribe.prepare", "undecided"),
        ("sparserob_core.sip.methods.exchange.separate", "refuted"),
        ("sparserob_core.sip.proof.branch_and_bound._branch_and_bound", "undecided"),
        ("sparserob_core.experiment.run.outcome.bounded", "verified"),
        ("sparserob_core.experiment.run.outcome.with_activity", "certified"),
        ("sparserob_core.experiment.run.outcome.with_causal", "certified"),
        ("sparserob_core.experiment.run.journal.adversaries", "certified"),
    ],
)
def test_every_long_step_of_a_run_ends_at_the_limit(
    place: str, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whichever of them lasts for ever: the others say what they know, and `check` takes it."""
    sr.run(small(), out=tmp_path / "first", quiet=True, figures=False)  # what is imported is there
    monkeypatch.setattr(place, overslept(1000))
    outcome = sr.run(small(), {"limits.seconds": 1.0}, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == status
    assert (outcome.directory / "certificate.json").is_file()
    monkeypatch.undo()
    found = sr.check(tmp_path / "run")
    assert not [claim for claim in found.claims if claim.verdict == "fails"]
    assert found.status == "verified" or status == "undecided"


def test_a_limit_within_the_proof_of_infeasibility_says_undecided(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first program of a policy has no answer, and the one that would prove it runs out of time: nothing failed."""
    solve = Counterpart.solve

    def late(
        counterpart: Counterpart, margin: float = 0.0, accuracy: float = 0.0, seconds: float = np.inf
    ) -> RobustAnswer:
        if not counterpart.elastic:
            return solve(counterpart, margin, accuracy, seconds)
        time.sleep(seconds)
        none = np.zeros(0)
        return RobustAnswer(False, "HiGHS: Time limit reached", none, none, np.zeros((0, 0)), none)

    monkeypatch.setattr(Counterpart, "solve", late)
    config = small() | {"policy": {"name": "affine"}}
    config["problem"]["terminal"] = [{"box": [0.001, 0.001]}]
    outcome = sr.run(config, {"limits.seconds": 1.0}, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == "undecided"
    assert outcome.result.message.startswith("the limit of 1 s is reached")
    monkeypatch.undo()
    assert sr.run(config, out=tmp_path / "proven", quiet=True, figures=False).status == "infeasible"


@pytest.mark.parametrize("where", ["main", "thread"])
def test_a_deadline_is_enforced_in_every_thread_and_again_where_it_was_not_heeded(where: str) -> None:
    rung, errors = list[float](), list[BaseException]()

    def work() -> None:
        began, deadline = time.monotonic(), Deadline(0.05)
        try:
            with deadline.enforced():
                while True:
                    try:
                        while True:
                            time.sleep(0.005)
                    except OutOfTime:
                        rung.append(time.monotonic() - began)
                        if len(rung) == 2:
                            raise
        except OutOfTime as error:
            errors.append(error)
        time.sleep(2 * LAST_STEP_SECONDS)  # nothing rings any more

    if where == "main":
        work()
    else:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join(20.0)
    assert len(rung) == 2
    assert rung[0] >= LIMIT_GRACE_SECONDS
    assert [str(error) for error in errors] == ["the limit of 0.05 s is reached"]


@pytest.mark.parametrize("seconds", [30.0, 0.01])
def test_a_limit_in_a_thread_leaves_the_interpreter_as_it_was(seconds: float) -> None:
    program = f"""
import sys, threading, time
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime

def work():
    try:
        with Deadline({seconds}).enforced():
            time.sleep(0.01)
            while {seconds} < 1.0:
                pass
    except OutOfTime:
        pass

thread = threading.Thread(target=work)
thread.start()
thread.join()
sys.setprofile(lambda frame, event, what: None)  # 3.11 hangs here where an exception was withdrawn
(lambda: 0)()
sys.setprofile(None)
work()  # in the main thread, by the alarm
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_within_another_deadline_the_inner_one_counts_and_the_outer_one_goes_on() -> None:
    outer, inner = Deadline(0.5), Deadline(0.01)
    began = time.monotonic()
    with pytest.raises(OutOfTime, match=r"0\.5 s"), outer.enforced():
        with pytest.raises(OutOfTime, match=r"0\.01 s"), inner.enforced():
            time.sleep(20.0)
        time.sleep(20.0)
    assert time.monotonic() - began >= 0.5


@FORKS
def test_a_call_that_nothing_interrupts_is_ended_at_the_deadline() -> None:
    def deaf() -> int:
        signal.signal(signal.SIGALRM, signal.SIG_IGN)
        while True:
            pass

    assert call_apart(lambda: 7, Deadline()) == 7
    with pytest.raises(OutOfTime):
        call_apart(deaf, Deadline(0.1))
    with pytest.raises(ZeroDivisionError):
        call_apart(lambda: 1 // 0, Deadline(5.0))
    with pytest.raises(sr.SolverError, match="SIGABRT"):
        call_apart(os.abort, Deadline())


@FORKS
def test_a_solver_that_ends_the_process_is_told_of_and_another_one_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sparserob_proxqp import ProxQp

    monkeypatch.setattr(ProxQp, "aborts", True)
    monkeypatch.setattr(ProxQp, "solve", lambda *_: os.abort())
    outcome = sr.run(small() | {"solver": {"name": "proxqp"}}, out=tmp_path / "run", quiet=True, figures=False)
    assert outcome.status == "certified"
    notes = [one["note"] for one in outcome.summary["notes"] if one["key"] == "solver.name"]
    assert notes and all(note.startswith("proxqp did not answer") and "SIGABRT" in note for note in notes)
    assert sr.check(tmp_path / "run").status == "verified"


def test_highs_says_that_it_ends_the_process_on_some_programs() -> None:
    registry = sr.load_registry()
    assert registry.build("solver", "highs").aborts
    assert not registry.build("solver", "piqp").aborts


def test_a_certificate_without_a_decision_claims_no_more_than_a_cost_that_is_not_negative(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sparserob_core.control.transcription.transcribe.prepare", overslept(1000))
    sr.run(small(), {"limits.seconds": 0.1}, out=tmp_path / "run", quiet=True)
    monkeypatch.undo()
    assert sr.check(tmp_path / "run").status == "verified"
    for name in ("certificate.json", "result.json"):
        file = tmp_path / "run" / name
        file.write_text(file.read_text().replace('"lower_bound": 0.0', '"lower_bound": 0.001'))
    assert sr.check(tmp_path / "run").status != "verified"
