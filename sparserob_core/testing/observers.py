"""The contract of an observer: it hears whole runs, broken off or not, lets go of everything afterwards, and changes
nothing."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, final

import numpy as np

from sparserob_core.experiment.run.events import (
    Event,
    Observer,
    PointProgress,
    RunFinished,
    RunStarted,
    SweepFinished,
    SweepProgress,
    SweepStarted,
)
from sparserob_core.experiment.run.outcome import Outcome
from sparserob_core.experiment.run.run import run
from sparserob_core.sip.convex_set import Box
from sparserob_core.sip.events import Batch, EvaluationsFinished, ProofProgress, RoundFinished
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.result import Result
from sparserob_core.testing.contract import Contract, broken, demand

CONFIG: Mapping[str, Any] = {
    "title": "A double integrator",
    "problem": {
        "name": "linear",
        "system": {"A": [[0, 1], [0, "p1"]], "B": [[0], [1]], "parameters": {"p1": [-0.1, 0.1]}},
        "horizon": 2.0,
        "initial_state": [1, 0],
        "control": {"box": 1.0},
        "disturbance": {"box": [0.01, 0.01]},
        "path": [{"box": [2.0, None], "from": 1.8}],
        "terminal": [{"box": [0.5, 0.5]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 10}},
    "observers": [],
}
SEARCH = {
    "method": {"name": "sparserob", "indices": 4},
    "maximiser": {"name": "simulated_annealing", "budget": 20, "polish": 0.0},  # its proof has steps
    "continuation": {"start": 1e-2, "factor": 0.1, "stop": 1e-3},
}
METHODS: Mapping[str, Mapping[str, Any]] = {
    "exchange": {},
    "sparserob": SEARCH,
    "scenario": {"method": {"name": "scenario", "scenarios": 20}},
    "infeasible": {"problem": {**CONFIG["problem"], "horizon": 0.5, "path": []}},
}
BROKEN_OFF = (1, 2, 4)  # the events after which a run is interrupted: at once, and in the middle
MEASURED_EVENTS = 300  # of which the median time is taken
THREAD_GRACE_SECONDS = 5.0  # seconds that an observer may take to end its threads
FRAMEWORK = "this is a fault of the framework, or of the contract; please report it"
MAX_SECONDS_PER_EVENT = 2e-3  # seconds that an event may take on the solver's thread, the median of many


@final
class Recording(Observer):
    """Passes everything on to the observer that is tested, and keeps every event it received, and what went wrong."""

    def __init__(self, observer: Observer, fails_at: int | None = None, failure: BaseException | None = None) -> None:
        self.observer, self.fails_at, self.failure = observer, fails_at, failure
        self.events: list[Event] = []
        self.errors: list[Exception] = []
        self.closed = 0

    def receive(self, event: Event) -> None:
        """Pass it on, then fail where that was asked for."""
        self.events.append(event)
        self._note_error(lambda: self.observer.receive(event))
        if self.failure is not None and len(self.events) - 1 == self.fails_at:
            raise self.failure

    def close(self) -> None:
        """Pass it on."""
        self.closed += 1
        self._note_error(self.observer.close)

    def _note_error(self, call: Any) -> None:
        try:
            call()
        except Exception as error:
            self.errors.append(error)
            raise


class ObserverContract(Contract[Observer], kind="observer"):
    """Contract of an observer: subclass it in a test module as ``class TestMine(ObserverContract)`` and give
    ``component``.

    The core keeps the order of events, detaches an observer that raises, and closes it. The contract checks that an
    observer can live with that: no event is a surprise, a run may end at any of them, and afterwards nothing is left.
    """

    def watched(self, method: str, observer: Recording | None = None, quiet: bool = False) -> tuple[Outcome, Recording]:
        """Perform one run of `METHODS`, watched by a new observer or by the given one."""
        recording = observer or Recording(self.create())
        with TemporaryDirectory() as directory:
            return (
                run(
                    {**CONFIG, **METHODS[method]},
                    out=Path(directory) / "run",
                    figures=False,
                    quiet=quiet,
                    observers=[recording],
                ),
                recording,
            )

    def test_it_hears_whole_runs_of_every_method(self) -> None:
        kinds: set[type[Event]] = set()
        for method in METHODS:
            _, recording = self.watched(method)
            _check_unharmed(recording, f"a run of {method}")
            first, last = recording.events[0], recording.events[-1]
            demand(isinstance(first, RunStarted) and isinstance(last, RunFinished), f"{method}: {first}", FRAMEWORK)
            demand(recording.closed == 1, f"{method}: it was closed {recording.closed} times", FRAMEWORK)
            kinds |= {type(event) for event in recording.events}
        demand(
            kinds >= {RoundFinished, EvaluationsFinished, ProofProgress},
            "not every event was there to be heard",
            FRAMEWORK,
        )

    def test_the_run_is_the_same_with_and_without_it(self) -> None:
        for method in METHODS:
            watched, recording = self.watched(method)
            _check_unharmed(recording, f"a run of {method}")
            demand(
                numbers(watched.result) == _run_unwatched(method),
                f"{method}: the observer has changed the result",
                "only look at what an event holds: copy arrays before you change them, and ask `inspection` for the "
                "rest, which has a copy of its own",
            )

    def test_it_ends_with_a_run_that_is_interrupted(self) -> None:
        for count in (0, *BROKEN_OFF):  # before anything is solved there is no result, later there is what is known
            with nothing_left():
                recording = Recording(self.create(), count, KeyboardInterrupt())
                with suppress(KeyboardInterrupt):
                    self.watched("sparserob", recording)
                _check_unharmed(recording, f"a run that is interrupted after {count} events")
                demand(isinstance(recording.events[-1], RunFinished), "the last event is missing", FRAMEWORK)
                demand(recording.closed == 1, f"it was closed {recording.closed} times", FRAMEWORK)

    def test_it_lets_go_when_it_is_detached_before_the_end(self) -> None:
        for count in (0, *BROKEN_OFF):
            with nothing_left():
                outcome, recording = self.watched(
                    "sparserob", Recording(self.create(), count, RuntimeError("detached by the contract"))
                )
                _check_unharmed(recording, f"a run from which it is detached after {count} events")
                demand(len(recording.events) == count + 1, "it heard more after it was detached", FRAMEWORK)
                demand(recording.closed == 1, f"it was closed {recording.closed} times", FRAMEWORK)
                demand(outcome.result.decision is not None, "the run did not go on without it", FRAMEWORK)

    def test_nothing_of_it_is_left_after_a_run(self) -> None:
        for method in METHODS:
            with nothing_left():
                self.watched(method)

    def test_it_leaves_the_standard_output_alone_and_a_quiet_terminal_too(self) -> None:
        for quiet in (False, True):
            with redirect_stdout(io.StringIO()) as output, redirect_stderr(_Terminal()) as errors:
                self.watched("sparserob", quiet=quiet)
            demand(
                output.getvalue() == "",
                f"it writes to the standard output, which belongs to the result: {output.getvalue()[:60]!r}",
                "write to a file of the run's directory, or to the standard error stream",
            )
            demand(
                not (quiet and errors.getvalue()),
                f"it writes to the standard error stream of a quiet run: {errors.getvalue()[:60]!r}",
                "look at `RunStarted.quiet`, and leave the terminal alone where it is true",
            )

    def test_events_of_an_unknown_kind_and_in_an_unknown_order_are_ignored(self) -> None:
        self._send_events(
            (_LaterEvent(), *bare_events(), _LaterEvent(), *bare_events()[-1:]),
            "events of later versions, and out of order",
        )

    def test_a_program_that_is_no_control_problem_is_watched_too(self) -> None:
        self._send_events((started(), *bare_events()), "a program that is no control problem")

    def test_a_study_is_watched_or_ignored(self) -> None:
        with TemporaryDirectory() as directory:
            self._send_events(study_events(Path(directory)), "a study")

    def _send_events(self, events: Sequence[Event], what: str) -> None:
        recording = Recording(self.create())
        with suppress(Exception):
            for event in events:
                recording.receive(event)
        with suppress(Exception):
            recording.close()
        _check_unharmed(recording, what)

    def test_it_does_not_hold_up_the_solver(self) -> None:
        observer, seconds = self.create(), []
        observer.receive(started())
        try:
            for number in range(MEASURED_EVENTS):
                event = bare_events()[2 if number % 3 else 0]
                start = time.perf_counter()
                observer.receive(event)
                seconds.append(time.perf_counter() - start)
            observer.receive(RunFinished(status="failed", message="broken off", seconds=1.0))
        finally:
            observer.close()
        demand(
            float(np.median(seconds)) < MAX_SECONDS_PER_EVENT,
            f"an event takes {1e3 * float(np.median(seconds)):.1f} ms on the solver's thread",
            "put events into a `queue.SimpleQueue`, and let a thread of your own, begun at `RunStarted` and joined in "
            "`close`, do the work",
        )


@cache
def _run_unwatched(method: str) -> object:
    """The numbers of a run of `METHODS` that nobody watches; the same for every observer."""
    with TemporaryDirectory() as directory:
        alone = run({**CONFIG, **METHODS[method]}, out=Path(directory) / "run", figures=False, quiet=True)
    return numbers(alone.result)


def _check_unharmed(recording: Recording, what: str) -> None:
    """Raise `ContractBroken` where the observer raised."""
    if recording.errors:
        error, count = recording.errors[0], len(recording.events)
        event = type(recording.events[-1]).__name__ if recording.events else "nothing"
        broken(
            f"{what}: after {count} events, the last of them {event}, it raised {type(error).__name__}: {error}",
            "any event may be the last or the first; results, directories, problems and decisions may be None; events "
            "of kinds that you do not know are to be ignored, and arrays of events cannot be written to",
        )


@final
class _Terminal(io.StringIO):
    """A standard error stream that somebody looks at."""

    def isatty(self) -> bool:
        """Return ``True``: the stream passes for a terminal."""
        return True


@final
class _LaterEvent(Event):
    """An event of a later version."""


def started() -> RunStarted:
    """The start of a run that is no control problem and has no directory."""
    program = SemiInfiniteProgram(n=2, q=np.ones(2), lower=-1.0, upper=1.0)
    return RunStarted(title="a program", directory=None, problem=None, program=program)


def study_events(directory: Path) -> Sequence[Event]:
    """A study of two points, of which the second one failed."""
    rows: dict[int, dict[str, Any]] = {
        0: {"status": "certified", "cost": 1.0, "lower_bound": 1.0, "upper_bound": 1.0},
        1: {"status": "failed", "message": "no answer"},
    }
    opening = SweepStarted(
        title="two", directory=directory, axes=["seed"], logarithmic=[False], points=[[0], [1]], arrangement="grid"
    )
    return (
        opening,
        SweepProgress(text="0 of 2 points done", total=2),
        PointProgress(point=0),
        PointProgress(point=0, round=1, lower_bound=0.5),
        SweepProgress(text="1 of 2 points done", done=1, total=2, row=rows[0], axes=["seed"], places=[0]),
        SweepFinished(rows=rows, seconds=1.0, stopped="interrupted from the keyboard", pressed=True),
    )


def bare_events() -> Sequence[Event]:
    """Return events of every kind with as little content as possible, and the end of a run without a result."""
    points, values = np.array([[0.5, 0.5], [0.25, 0.5]]), np.array([-np.inf, -1.0])
    batch = Batch([points], [values], [(2, 0.1)], {"temperature": [(1, 2.0), (2, 1.0)]})
    return (
        RoundFinished(round=1, epsilon=0.0, lower_bound=-np.inf, upper_bound=np.inf, violation=-np.inf),
        EvaluationsFinished(count=1, total=1, best_value=-np.inf),
        EvaluationsFinished(
            count=2,
            total=2,
            best_value=-1.0,
            seconds=0.1,
            notes={"temperature": 1.0},
            budget=4,
            best_point=points[1],
            domain=Box(np.zeros(2), np.ones(2)),
            family="above",
            batch=batch,
        ),
        ProofProgress(family="above", cells=3, bound=np.inf),
        RunFinished(status="failed", message="broken off", seconds=1.0),
    )


@contextmanager
def nothing_left() -> Iterator[None]:
    """Fails when more threads are alive afterwards than before."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + THREAD_GRACE_SECONDS
    while (new_threads := set(threading.enumerate()) - before) and time.monotonic() < deadline:
        time.sleep(0.01)
    demand(
        not new_threads,
        f"threads are still running after the run: {', '.join(thread.name for thread in new_threads)}",
        "end and join them in `close`, which is called however a run ends, with or without `RunFinished`",
    )


def numbers(result: Result) -> list[object]:
    """Return all parts of a result that must not depend on its observers."""
    decision = None if result.decision is None else result.decision.tolist()
    trace = [] if result.trace is None else result.trace.value.tolist()
    rounds = [(event.lower_bound, event.upper_bound, event.violation, event.active_indices) for event in result.history]
    return [result.status, result.message, decision, trace, rounds, result.lower_bound, result.upper_bound]
