"""Guards experiment/run/events: what a run tells: in which order, how often, and that what it tells is what was
done."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.directory.finished import read_arrays
from sparserob_core.experiment.directory.rounds import round_arrays, with_decisions
from sparserob_core.experiment.run.events import Broadcast
from sparserob_core.sip.events import Batch, gains
from sparserob_core.testing.observers import CONFIG, METHODS

SQUARE = sr.Box(np.zeros(2), np.ones(2))


class Listener(sr.Observer):
    """Keeps what it hears; fails or presses Ctrl-C at an event of one kind."""

    def __init__(
        self, kind: type[sr.Event] | None = None, failure: BaseException | None = None, closing: Exception | None = None
    ) -> None:
        self.kind, self.failure, self.closing = kind, failure, closing
        self.heard: list[sr.Event] = []
        self.closed = 0

    def receive(self, event: sr.Event) -> None:
        self.heard.append(event)
        if self.kind is not None and isinstance(event, self.kind) and self.failure is not None:
            raise self.failure

    def close(self) -> None:
        self.closed += 1
        if self.closing is not None:
            raise self.closing

    def only(self, kind: type) -> list:
        """What it heard of one kind."""
        return [event for event in self.heard if isinstance(event, kind)]


@pytest.fixture
def watched(tmp_path: Path) -> Callable[..., sr.Outcome]:
    """A run of one of the methods of the observers' contract, in a directory of its own."""

    def run(method: str, *observers: sr.Observer) -> sr.Outcome:
        count = len(list(tmp_path.iterdir()))
        return sr.run({**CONFIG, **METHODS[method]}, out=tmp_path / f"run{count}", figures=False, observers=observers)

    return run


def same(first: sr.Outcome, second: sr.Outcome) -> bool:
    """Whether two runs have done the same, number by number."""
    traces = [one.result.trace.value.tolist() if one.result.trace else [] for one in (first, second)]
    rounds = [
        [(r.lower_bound, r.violation, r.imposed and r.multipliers.tolist()) for r in one.result.history]
        for one in (first, second)
    ]
    decisions = [None if one.result.decision is None else one.result.decision.tolist() for one in (first, second)]
    return (
        traces[0] == traces[1]
        and rounds[0] == rounds[1]
        and decisions[0] == decisions[1]
        and first.status == second.status
    )


@pytest.mark.first(2)
@pytest.mark.parametrize("method", METHODS)
def test_a_run_begins_and_ends_once_and_everything_is_in_between(
    method: str, watched: Callable[..., sr.Outcome]
) -> None:
    listener = Listener()
    outcome = watched(method, listener)
    assert [type(event) for event in (listener.heard[0], listener.heard[-1])] == [sr.RunStarted, sr.RunFinished]
    assert len(listener.only(sr.RunStarted)) == len(listener.only(sr.RunFinished)) == listener.closed == 1
    told = listener.only(sr.RunFinished)[0].result
    assert told is not None
    assert all(getattr(told, one.name) is getattr(outcome.result, one.name) for one in fields(sr.Result))
    assert [event.round for event in listener.only(sr.RoundFinished)] == list(range(1, len(outcome.result.history) + 1))
    assert len(listener.heard) >= 3


@pytest.mark.first(1)
@pytest.mark.parametrize("method", METHODS)
def test_the_run_is_the_same_with_and_without_observers(method: str, watched: Callable[..., sr.Outcome]) -> None:
    listener = Listener()
    assert same(watched(method, listener, Listener()), watched(method))
    for event in listener.only(sr.EvaluationsFinished):
        assert event.batch.trace.values.size == event.count


def test_the_batches_of_a_run_are_its_trace(watched: Callable[..., sr.Outcome]) -> None:
    listener = Listener()
    trace = watched("sparserob", listener).result.trace
    assert trace is not None
    events = listener.only(sr.EvaluationsFinished)
    assert np.concatenate([event.batch.trace.values for event in events]).tolist() == trace.value.tolist()
    assert np.concatenate([np.full(event.count, event.round - 1) for event in events]).tolist() == trace.outer.tolist()
    assert np.concatenate([np.full(event.count, event.epsilon) for event in events]).tolist() == trace.epsilon.tolist()
    assert events[-1].lower_bound == trace.bound[-1]
    for event in events:
        assert event.domain is not None
        assert event.batch.trace.points.shape == (event.count, event.domain.dimension)
        assert event.batch.trace.best[-1] == event.best_value
        assert event.total <= event.budget
        assert set(event.notes) >= {"temperature", "accepted", "scale", "stands", "cycle", "move"} or event.total < 20


@pytest.mark.slow
def test_a_round_tells_the_decision_its_violations_and_the_cuts_that_came_and_went(
    watched: Callable[..., sr.Outcome],
) -> None:
    listener = Listener()
    for method in ("exchange", "sparserob"):
        watched(method, listener)
        program, cuts = listener.only(sr.RunStarted)[-1].program, set()
        for event in [
            one
            for one in listener.heard[listener.heard.index(listener.only(sr.RunStarted)[-1]) :]
            if isinstance(one, sr.RoundFinished)
        ]:
            assert event.cost == program.cost(event.decision)
            assert max(found.violations[0] for found in event.separations.values()) == event.violation
            for name, found in event.separations.items():
                at_index = program.family(name).violations(event.decision, found.indices[:1])[0, found.rows[0]]
                assert at_index == pytest.approx(found.violations[0], abs=1e-9)
            keys = {(cut.family, cut.index.tobytes(), cut.row) for cut in event.imposed}
            added, dropped = (
                {(cut.family, cut.index.tobytes(), cut.row) for cut in part} for part in (event.added, event.dropped)
            )
            assert (len(added), len(dropped)) == (event.cuts_added, event.cuts_dropped)
            assert (cuts | added) - dropped == keys
            assert event.multipliers.shape == (len(event.imposed),)
            cuts = keys
        assert cuts


def test_the_indices_of_a_family_without_closed_form_are_told_while_they_are_searched() -> None:
    def rows(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return -np.stack([t[:, 0] ** k for k in range(3)], axis=1)[:, None, :], -np.exp(t)

    heard: list[sr.Event] = []
    family = sr.ConstraintFamily(name="above", index_set=sr.Box([0.0], [1.0]), rows=rows)
    program = sr.SemiInfiniteProgram(n=3, q=[1, 1 / 2, 1 / 3], lower=-10.0, upper=10.0, families=[family])
    sr.solve(program, maximiser="random_search", budget=100, notify=heard.append)
    searched = [event for event in heard if isinstance(event, sr.EvaluationsFinished)]
    assert searched
    assert {(event.family, event.total, event.budget) for event in searched} == {("above", 100, 100)}
    rounds = [event.round for event in heard if isinstance(event, sr.RoundFinished)]
    assert {event.round for event in searched} <= set(rounds)


def test_nothing_can_be_written_into_an_event(watched: Callable[..., sr.Outcome]) -> None:
    listener = Listener()
    watched("sparserob", listener)
    search, finished = listener.only(sr.EvaluationsFinished)[-1], listener.only(sr.RoundFinished)[-1]
    for array in (search.best_point, search.domain.lower, search.domain.upper, finished.decision, finished.multipliers):
        with pytest.raises(ValueError, match="read-only"):
            array[:] = 0.0


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> sr.Outcome:
    """A search that nobody watches."""
    out = tmp_path_factory.mktemp("plain") / "run"
    return sr.run({**CONFIG, **METHODS["sparserob"]}, out=out, figures=False)


KINDS = (sr.RunStarted, sr.EvaluationsFinished, sr.RoundFinished, sr.ProofProgress, sr.RunFinished)


@pytest.mark.parametrize(
    ("kind", "failure"),
    [
        (sr.RoundFinished, ValueError("oh")),
        *(
            pytest.param(kind, failure, marks=pytest.mark.slow)
            for kind in KINDS
            for failure in (ValueError("oh"), SystemExit("enough"))
            if kind is not sr.RoundFinished or isinstance(failure, SystemExit)
        ),
    ],
)
def test_an_observer_that_fails_is_named_once_detached_and_closed_and_the_run_is_the_same(
    kind: type[sr.Event],
    failure: BaseException,
    watched: Callable[..., sr.Outcome],
    plain: sr.Outcome,
    caplog: pytest.LogCaptureFixture,
) -> None:
    clumsy, listener = Listener(kind, failure), Listener()
    with caplog.at_level(logging.WARNING, logger="sparserob"):
        outcome = watched("sparserob", clumsy, listener)
    assert [record.getMessage() for record in caplog.records] == [
        f"observer 'Listener' is detached: {type(failure).__name__}: {failure}"
    ]
    assert isinstance(clumsy.heard[-1], kind)
    assert len(clumsy.only(kind)) == clumsy.closed == listener.closed == 1
    assert isinstance(listener.heard[-1], sr.RunFinished)
    assert same(outcome, plain)


def test_an_observer_that_fails_to_close_is_named_too(
    watched: Callable[..., sr.Outcome], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, logger="sparserob"):
        watched("exchange", Listener(closing=OSError("disk full")))
    assert [record.getMessage() for record in caplog.records] == ["observer 'Listener' is detached: OSError: disk full"]


@pytest.mark.first(2)
@pytest.mark.parametrize("kind", KINDS)
def test_an_interrupt_ends_the_run_and_everybody_hears_of_it(
    kind: type[sr.Event], watched: Callable[..., sr.Outcome]
) -> None:
    first, pressing, last = Listener(), Listener(kind, KeyboardInterrupt()), Listener()
    if kind in (sr.RunStarted, sr.RunFinished):
        with pytest.raises(KeyboardInterrupt):
            watched("sparserob", first, pressing, last)
    else:
        result = watched("sparserob", first, pressing, last).result
        assert result.stopped == "interrupted from the keyboard"
        assert result.status in ("verified", "refuted", "undecided")
        assert result.decision is not None
    for listener in (first, pressing, last):
        assert listener.closed == 1
    for listener in (first, pressing):
        assert isinstance(listener.heard[-1], sr.RunFinished)
        assert len(listener.only(sr.RunFinished)) == len(listener.only(sr.RunStarted)) == 1
    assert not last.heard or isinstance(last.heard[-1], sr.RunFinished), "who has heard of the start hears of the end"
    if kind is not sr.RunFinished:
        assert first.only(sr.RunFinished)[0].message.endswith("interrupted from the keyboard")


def test_a_method_that_fails_is_heard_of(config: Path, tmp_path: Path) -> None:
    listener = Listener()
    with pytest.raises(sr.PluginError, match=r"method 'stub' .*solve raised RuntimeError: the stub fell over"):
        sr.run(config, {"method.fail": True}, out=tmp_path / "out", observers=[listener])
    assert [type(event) for event in listener.heard] == [sr.RunStarted, sr.RoundFinished, sr.RunFinished]
    assert listener.heard[-1].status == "failed"
    assert listener.heard[-1].message.endswith("solve raised RuntimeError: the stub fell over")
    assert listener.closed == 1


def test_nobody_hears_anything_after_the_end_nor_the_end_of_what_has_not_begun() -> None:
    listener = Listener()
    broadcast = Broadcast([("listener", listener)])
    ending = sr.RunFinished(status="failed", message="", seconds=0.0)
    broadcast(ending)
    broadcast(ending)
    broadcast(sr.Event())
    assert listener.heard == []
    assert listener.closed == 1


def test_nothing_is_collected_where_nobody_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    def collected(*arguments: object) -> None:
        raise AssertionError("collected for nobody")

    monkeypatch.setattr("sparserob_core.sip.search.notifier.Notifier.__init__", collected)
    assert sr.maximise(lambda x: -x[:, 0], SQUARE, "random_search", budget=50, polish=0.0).evaluations == 50
    with pytest.raises(AssertionError, match="for nobody"):
        sr.maximise(lambda x: -x[:, 0], SQUARE, "random_search", budget=50, notify=lambda event: None, polish=0.0)


@pytest.mark.slow
def test_there_are_few_events_for_many_evaluations_and_all_of_them_are_told() -> None:
    heard: list[sr.EvaluationsFinished] = []
    report = sr.maximise(
        lambda x: -((x - 0.3) ** 2).sum(axis=1),
        SQUARE,
        "simulated_annealing",
        budget=20_000,
        notify=heard.append,
        polish=0.0,
    )
    assert 20 <= len(heard) <= 22 + report.trace.seconds[-1] / 0.05
    assert np.concatenate([event.batch.trace.points for event in heard]).tolist() == report.trace.points.tolist()
    assert np.concatenate([event.batch.trace.best for event in heard]).tolist() == report.trace.best.tolist()
    for name, rows in report.trace.notes.items():
        assert np.concatenate([event.batch.trace.notes[name] for event in heard]).tolist() == rows.tolist()
    assert np.all(np.diff(np.concatenate([event.batch.trace.seconds for event in heard])) >= 0.0)


def test_the_moves_are_those_of_the_walk() -> None:
    class Walking(sr.Maximiser):
        """Changes coordinate 0, 1, 0, 1, ...; the second, fifth, ... are refused."""

        def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
            point = np.full(2, 0.5)
            objective.evaluate(point[np.newaxis])
            objective.note(accepted=1.0)
            for k in range(objective.remaining):
                candidate = point.copy()
                candidate[k % 2] = rng.random()
                objective.evaluate(candidate[np.newaxis])
                accepted = k % 3 != 1
                objective.note(accepted=float(accepted))
                point = candidate if accepted else point
            return np.inf

    heard: list[sr.EvaluationsFinished] = []
    for pause in (1e9, 0.0):  # one batch, or one for each evaluation
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("sparserob_core.sip.search.notifier.SECONDS_BETWEEN_EVENTS", pause)
            patch.setattr("sparserob_core.sip.search.notifier.MIN_EVENTS", 1)
            sr.maximise(lambda x: x[:, 0], SQUARE, Walking(), budget=13, notify=heard.append, polish=0.0)
    assert [event.count for event in heard] == [13] + [1] * 13
    together = [tuple(row) for row in heard[0].batch.moves.tolist()]
    singly = [(event.batch.first + row, column) for event in heard[1:] for row, column in event.batch.moves.tolist()]
    assert together == singly == [(k + 1, k % 2) for k in range(12)]
    walk = heard[0].batch
    stood = [walk.trace.values[max(j for j in range(k + 1) if j == 0 or j % 3 != 2)] for k in range(12)]
    assert np.array_equal(walk.gains[1:], walk.trace.values[1:] - stood)
    assert np.isnan(walk.gains[0])
    assert walk.gains[1:].tolist() == [event.batch.gains[0] for event in heard[2:]]
    changing = [k for k in range(12) if walk.gains[k + 1] != 0.0]
    assert changing == list(range(0, 12, 2))  # the second coordinate changes nothing
    assert walk.acceptance == pytest.approx(np.mean([k % 3 != 1 for k in changing]))


def test_from_nowhere_to_nowhere_nothing_is_gained() -> None:
    values, accepted = np.array([-np.inf, -np.inf, 1.0, -np.inf, 2.0]), np.array([True, True, True, False, True])
    assert gains(values, accepted).tolist()[1:] == [0.0, np.inf, -np.inf, 1.0]


def test_rounding_is_no_change_and_the_last_steps_of_a_walk_are() -> None:
    values = 0.6 * np.array([1.0, 1.0 + 1e-12, 1.0 - 1e-12, 1.0 + 1e-8, -1.0])
    assert np.sign(gains(values, np.zeros(5, dtype=bool), 0.6)).tolist() == [0, 0, 0, 1, -1]
    assert (gains(1e-20 * values, np.zeros(5, dtype=bool), 0.6e-20)[3:] != 0.0).all()


def test_events_tell_the_maximiser_from_the_polish_and_none_is_of_both() -> None:
    heard: list[sr.EvaluationsFinished] = []
    trace = sr.maximise(
        lambda x: -((x - 0.3) ** 2).sum(axis=1), SQUARE, "random_search", 50, notify=heard.append, polish=0.4
    ).trace
    assert trace.searched == 30
    assert trace.values.size > trace.searched
    for event in heard:
        first = event.total - event.count
        assert event.phase == ("polish" if first >= trace.searched else "search")
        assert event.phase == "polish" or event.total <= trace.searched
    assert {event.phase for event in heard} == {"search", "polish"}


def test_a_batch_of_nothing_has_an_empty_trace_and_no_moves() -> None:
    assert Batch().trace.values.size == 0
    assert Batch().moves.shape == (0, 2)
    assert Batch().gains.size == 0
    assert np.isnan(Batch().acceptance)


@pytest.mark.slow
def test_large_points_are_not_kept_for_long() -> None:
    heard: list[sr.EvaluationsFinished] = []
    box = sr.Box(np.zeros(2**18), np.ones(2**18))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sparserob_core.sip.search.notifier.SECONDS_BETWEEN_EVENTS", 1e9)
        sr.maximise(lambda x: x[:, 0], box, "simulated_annealing", budget=100, notify=heard.append, polish=0.0)
    assert len(heard) > 100 / 12
    assert max(event.batch.trace.points.size for event in heard) <= 2 * 2**21


@pytest.mark.parametrize(
    ("maximiser", "names"),
    [
        ("simulated_annealing", {"temperature", "accepted", "scale", "stands", "cycle", "move"}),
        ("sequool", {"depth", "openings", "hmax"}),
        ("maxlipo", {"local", "radius"}),
        ("adalipo", {"constant", "rejected"}),
        ("gradient_ascent", {"ascent", "slope"}),
        ("nevergrad", {"spread"}),
        ("cma", {"sigma"}),
    ],
)
def test_maximisers_tell_how_they_stand_in_their_own_terms(maximiser: str, names: set[str]) -> None:
    if maximiser in ("cma", "nevergrad"):
        pytest.importorskip(maximiser)
    heard: list[sr.EvaluationsFinished] = []
    sr.maximise(lambda x: -((x - 0.3) ** 2).sum(axis=1), SQUARE, maximiser, budget=60, notify=heard.append, polish=0.0)
    assert set(heard[-1].notes) == names
    assert all(np.isfinite(value) for value in heard[-1].notes.values())


@pytest.mark.first(1)
@pytest.mark.parametrize("method", ["exchange", "sparserob", "scenario"])
def test_rounds_and_searches_are_read_back_as_they_were(method: str, watched: Callable[..., sr.Outcome]) -> None:
    listener = Listener()
    outcome = watched(method, listener)
    columns = read_arrays(outcome.directory / "trace.npz")
    plain = [
        sr.RoundFinished(**{name: columns[name][row].item() for name in columns})
        for row in range(len(columns["round"]))
    ]
    read = with_decisions(plain, read_arrays(outcome.directory / "rounds.npz"))
    for told, entry in zip(listener.only(sr.RoundFinished), read, strict=True):
        assert entry.decision is not None
        assert (entry.decision.tolist(), entry.multipliers.tolist(), entry.cost) == (
            told.decision.tolist(),
            told.multipliers.tolist(),
            told.cost,
        )
        assert (entry.simplified, entry.cuts_added, entry.cuts_dropped) == (
            told.simplified,
            len(entry.added),
            len(entry.dropped),
        )
        for part in ("imposed", "added", "dropped"):
            pairs = [[(cut.family, cut.index.tolist(), cut.row) for cut in getattr(one, part)] for one in (told, entry)]
            assert sorted(pairs[0]) == sorted(pairs[1])
    if method == "sparserob":
        trace, searched = (
            sr.SearchTrace.stored(read_arrays(outcome.directory / "evaluations.npz")),
            listener.only(sr.EvaluationsFinished),
        )
        assert trace.points.tolist() == np.concatenate([event.batch.trace.points for event in searched]).tolist()
        noted = np.concatenate(
            [event.batch.trace.notes.get("temperature", np.empty((0, 2)))[:, 1] for event in searched]
        )
        assert trace.notes["temperature"][~np.isnan(trace.notes["temperature"])].tolist() == noted.tolist()


def test_decisions_that_do_not_belong_to_the_rounds_are_refused(watched: Callable[..., sr.Outcome]) -> None:
    outcome = watched("exchange")
    arrays = round_arrays(outcome.result.history)
    with pytest.raises(ValueError, match="expected 1 rounds"):
        with_decisions(outcome.result.history[:1], arrays)
    assert with_decisions(outcome.result.history, {}) == tuple(outcome.result.history)
    assert round_arrays([]) == {}


def test_a_round_on_a_simplified_program_says_so(watched: Callable[..., sr.Outcome]) -> None:
    listener = Listener()
    watched("scenario", listener)
    watched("exchange", listener)
    assert {event.simplified for event in listener.only(sr.RoundFinished)} == {True, False}
