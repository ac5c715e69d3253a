"""Guards sparserob_core.testing and every registered component: every registered observer keeps the contract, and the
contract is worth keeping: observers that are bad on purpose fail it."""

from __future__ import annotations

import sys
import threading
import time

import pytest

import sparserob_core as sr
from sparserob_core.testing import ObserverContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()
NAMES = REGISTRY.names("observer")


def test_there_are_observers_to_be_tested():
    assert "progress" in NAMES


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "progress" else pytest.mark.slow, id=f"observer_{name}") for name in NAMES],
)  # others write files or start processes at each of a hundred runs
class TestRegisteredObserver(ObserverContract):
    @pytest.fixture(autouse=True)
    def named(self, name, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        self.name = name

    def create(self):
        return REGISTRY.build("observer", self.name)


class Counting(sr.Observer):
    """An honest observer, for its flawed relatives to inherit from: a thread of its own, and a line on the standard
    error stream."""

    def __init__(self):
        self.over = threading.Event()
        self.thread = None
        self.count, self.quiet = 0, True

    def receive(self, event):
        self.count += 1
        if isinstance(event, sr.RunStarted):
            self.thread, self.quiet = threading.Thread(target=self.over.wait, daemon=True), event.quiet
            self.thread.start()
        if isinstance(event, sr.RunFinished) and not self.quiet:
            print(f"{self.count} events", file=sys.stderr)

    def close(self):
        self.over.set()


@pytest.mark.slow
class TestAnHonestObserver(ObserverContract):
    def create(self):
        return Counting()


class Trusting(Counting):
    """Takes it for granted that a run ends with a decision."""

    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RunFinished):
            event.result.decision.sum()


class Picky(Counting):
    def receive(self, event):
        super().receive(event)
        if not isinstance(
            event, sr.RunStarted | sr.RunFinished | sr.RoundFinished | sr.EvaluationsFinished | sr.ProofProgress
        ):
            raise TypeError("what is this?")


class Hasty(Counting):
    """Takes it for granted that a run has begun before it ends."""

    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RunFinished):
            self.thread.is_alive()


class ControlOnly(Counting):
    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RunStarted):
            self.horizon = event.problem.horizon


class Talkative(Counting):
    def receive(self, event):
        super().receive(event)
        print("an event")


class Shouting(Counting):
    def receive(self, event):
        super().receive(event)
        print("an event", file=sys.stderr)


class OnTerminals(Counting):
    """Draws a line wherever there is a terminal, also where it is to be left alone."""

    def receive(self, event):
        super().receive(event)
        if sys.stderr.isatty():
            print("an event", file=sys.stderr)


class Filing(Counting):
    """Takes it for granted that a run has a directory."""

    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RunStarted):
            (event.directory / "log.txt").touch()


class Leaking(Counting):
    """Starts a thread for each event, and forgets it."""

    def receive(self, event):
        super().receive(event)
        late = threading.Timer(2.0, str)
        late.daemon = True
        late.start()


class Slow(Counting):
    def receive(self, event):
        super().receive(event)
        time.sleep(5e-3)


class Lingering(Counting):
    """Ends its thread only with a run that has come to its end."""

    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RunFinished) and event.result is not None:
            self.over.set()

    def close(self):
        pass


class Scribbling(Counting):
    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RoundFinished):
            event.decision[:] = 0.0


class Meddling(Counting):
    """Changes what is solved: the program in its own units."""

    def receive(self, event):
        super().receive(event)
        if isinstance(event, sr.RunStarted) and event.program.own_units is not None:
            event.program.own_units.program.finite.weights[:] *= 2.0


class Unfinished(Counting):
    def close(self):
        super().close()
        if self.thread is not None and self.count < 6:
            raise OSError("nothing was written yet")


FAULTS = {
    Trusting: "test_it_ends_with_a_run_that_is_interrupted",
    Picky: "test_events_of_an_unknown_kind_and_in_an_unknown_order_are_ignored",
    Hasty: "test_events_of_an_unknown_kind_and_in_an_unknown_order_are_ignored",
    ControlOnly: "test_a_program_that_is_no_control_problem_is_watched_too",
    Talkative: "test_it_leaves_the_standard_output_alone_and_a_quiet_terminal_too",
    Shouting: "test_it_leaves_the_standard_output_alone_and_a_quiet_terminal_too",
    OnTerminals: "test_it_leaves_the_standard_output_alone_and_a_quiet_terminal_too",
    Filing: "test_a_program_that_is_no_control_problem_is_watched_too",
    Leaking: "test_nothing_of_it_is_left_after_a_run",
    Slow: "test_it_does_not_hold_up_the_solver",
    Lingering: "test_it_lets_go_when_it_is_detached_before_the_end",
    Scribbling: "test_it_hears_whole_runs_of_every_method",
    Meddling: "test_the_run_is_the_same_with_and_without_it",
    Unfinished: "test_it_lets_go_when_it_is_detached_before_the_end",
}


@pytest.mark.slow
@pytest.mark.parametrize(("flawed", "test"), FAULTS.items(), ids=[one.__name__ for one in FAULTS])
def test_the_contract_catches_an_observer_that_is_bad_on_purpose(flawed, test, monkeypatch):
    monkeypatch.setattr("sparserob_core.testing.observers.THREAD_GRACE_SECONDS", 0.2)
    made = []

    def create():
        made.append(flawed())
        return made[-1]

    create.__name__ = flawed.__name__
    fails(ObserverContract, create, test)
    for observer in made:
        observer.over.set()
