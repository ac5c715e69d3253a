"""The contracts of the four pieces of the paper's loop: `Regu`, `SC1`, `SC2` and `SlCr`.

Each piece is an object that is called. It is asked again and again, in one search and the next, so it may keep nothing.
"""

from __future__ import annotations

import random
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np

from sparserob_core.sip.rules import InnerStop, OuterStep, OuterStop, Progress, Schedule, Selection
from sparserob_core.testing.contract import Contract, broken, demand

FIRST = (1.0, 0.3, 1e3, 1e-4)  # weights at which a schedule begins
STOP = 1e-6  # share of the first weight that a schedule has to come down to
MAX_ITERATIONS = 5000  # iterations in which it has to
QUICK = 1e-3  # seconds of a rule that is asked after every batch of evaluations, the median of many
RULE_DRAWS = 2000  # of a rule that draws
SPREAD = 0.05  # of a share of so many draws


@contextmanager
def an_hour_later() -> Iterator[None]:
    """The clocks of `time`, an hour ahead: what reads one answers otherwise, without anybody having to wait."""
    with ExitStack() as stack:
        for name in ("time", "monotonic", "perf_counter", "process_time", "thread_time"):
            ahead = partial(lambda clock: clock() + 3600.0, getattr(time, name))
            stack.enter_context(patch.object(time, name, ahead))
        yield


def asked(call: Callable[[], Any], what: str, mend: str) -> Any:
    """Return the answer of a rule; the contract is broken where the rule raises or warns."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return call()
    except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
        broken(f"{what}: it raised {type(error).__name__}: {error}", mend)


def truth(answer: object, what: str) -> bool:
    """An answer that is true or false."""
    if not isinstance(answer, bool | np.bool_):
        broken(f"{what}: it answered {answer!r}, a {type(answer).__name__}", "return `bool(...)`: True or False")
    return bool(answer)


class ScheduleContract(Contract[Schedule], kind="rule", of=Schedule):
    """Contract of a schedule (the paper's ``Regu``): subclass it as ``class TestMine(ScheduleContract)`` and give
    ``component``.

    Called with the weight ``epsilon`` of iteration ``j - 1`` and ``j = 1, 2, ...``, a schedule returns the weight of
    iteration ``j``: a positive number below ``epsilon``. Sooner or later the weight falls to a millionth of the first
    one. The method stops the schedule at ``continuation.stop``.
    """

    def weight(self, schedule: Schedule, epsilon: float, j: int) -> float:
        """The next weight; a broken contract where it is none."""
        call = f"called with epsilon = {epsilon:g} and j = {j}"
        answer = asked(lambda: schedule(epsilon, j), call, "return a number for every positive weight and every j >= 1")
        if isinstance(answer, bool) or not isinstance(answer, int | float | np.integer | np.floating):
            broken(f"{call}: it answered {answer!r}, a {type(answer).__name__}", "return one number")
        demand(
            0.0 < answer < epsilon,
            f"{call}: it answered {answer!r}",
            "return a positive weight below `epsilon`: the regulariser has to vanish, but not all at once",
        )
        return float(answer)

    def descent(self) -> Iterator[tuple[float, float]]:
        """First weights, each with the one at which its iterations end; every weight between is looked at."""
        schedule = self.create()
        for first in FIRST:
            epsilon, j = first, 0
            while epsilon > STOP * first and j < MAX_ITERATIONS:
                j += 1
                epsilon = self.weight(schedule, epsilon, j)
            yield first, epsilon

    def test_every_weight_is_positive_and_below_the_one_before(self) -> None:
        for _first, _last in self.descent():
            pass

    def test_weights_come_down_to_a_millionth_of_the_first_one(self) -> None:
        for first, epsilon in self.descent():
            demand(
                epsilon <= STOP * first,
                f"from {first:g} the weight has come down to {epsilon:.3g} only after {MAX_ITERATIONS} iterations",
                "multiply by a factor clearly below 1, and add nothing to it",
            )

    def test_the_same_question_has_the_same_answer(self) -> None:
        schedule = self.create()
        questions = [(epsilon, j) for epsilon in FIRST for j in (1, 2, 7, 3, 1)]
        answers = [[self.weight(schedule, *question) for question in questions] for _ in range(2)]
        fresh = [self.weight(self.create(), *question) for question in questions]
        demand(
            answers[0] == answers[1] == fresh,
            "asked the same again, or in another order, it answers otherwise",
            "take `epsilon` and `j` from the arguments; keep neither a count nor the last weight, and draw nothing",
        )

    def test_numbers_of_numpy_do_as_well(self) -> None:
        schedule = self.create()
        demand(
            self.weight(schedule, np.float64(0.5), 2) == self.weight(schedule, 0.5, 2),
            "it answers otherwise where `epsilon` is a number of numpy",
            "use arithmetic only",
        )

    def test_a_method_comes_to_its_end_with_it(self) -> None:
        from sparserob_core.experiment.run.solve import solve
        from sparserob_core.sip.methods.sparserob import SparseRob
        from sparserob_core.sip.rules import Iterations
        from sparserob_core.testing.methods import dipping

        method = SparseRob(indices=2, regu=self.create(), sc1=Iterations(count=4))
        result = solve(dipping(), method, regulariser="ridge", maximiser="random_search", budget=20)
        weights = [event.epsilon for event in result.history]
        demand(
            len(weights) == 4 and all(after < before for before, after in pairwise(weights)),
            f"four outer iterations of the method sparserob had the weights {weights}",
            "return a positive weight below `epsilon`",
        )


def walk(changes: Sequence[float]) -> tuple[OuterStep, ...]:
    """Outer iterations whose optimiser, cost and value change by these amounts, one after another."""
    steps, total = [], 0.0
    for j, change in enumerate(changes):
        total += change
        decision = np.array([1.0 + total, -2.0, 0.5])
        steps.append(OuterStep(j, 2.0**-j, 3.0 + total, 2.0 + total, 1.0 + min(total, 0.5), decision))
    return tuple(steps)


class OuterStopContract(Contract[OuterStop], kind="rule", of=OuterStop):
    """Contract of an outer stopping rule (the paper's ``SC1``): subclass it as ``class TestMine(OuterStopContract)``
    and give ``component``.

    Called with the outer iterations so far (`OuterStep`, the last one last, at least one), the rule returns True or
    False. It does not stop while optimisers and costs still change by as much as their own size, and does once nothing
    changes.
    """

    def stops(self, rule: OuterStop, steps: Sequence[OuterStep]) -> bool:
        """Return the rule's answer; the contract is broken where it is no truth value."""
        call = f"called with {len(steps)} outer iterations"
        answer = asked(lambda: rule(steps), call, "answer for one iteration too, and whatever the numbers in it")
        return truth(answer, call)

    def test_it_stops_where_nothing_changes_any_more(self) -> None:
        rule, steps = self.create(), walk([1.0, *[0.0] * 1000])
        demand(
            any(self.stops(rule, steps[:count]) for count in range(1, len(steps) + 1)),
            "a thousand outer iterations with the same optimiser and the same cost do not stop it",
            "compare the last steps, and stop where they are as near to one another as the rule asks",
        )

    def test_it_goes_on_while_everything_changes(self) -> None:
        rule = self.create()
        for count in (1, 2):
            steps = walk([2.0**k for k in range(count)])
            demand(
                not self.stops(rule, steps),
                f"it stops after {count} outer iterations, though the optimiser has doubled in each",
                "compare the last two steps; one step alone says nothing",
            )

    def test_the_same_steps_have_the_same_answer(self) -> None:
        rule = self.create()
        runs = [walk([1.0, 0.5, 0.0, 0.0, 0.0]), walk([4.0, -4.0, 1e-3, 1e-9]), walk([0.0] * 12)]
        asks = [steps[:count] for steps in runs for count in range(1, len(steps) + 1)]
        answers = [[self.stops(rule, steps) for steps in order] for order in (asks, asks[::-1])]
        with an_hour_later():
            answers.append([self.stops(rule, steps) for steps in asks])
        fresh = [self.stops(self.create(), list(steps)) for steps in asks]
        demand(
            answers[0] == answers[1][::-1] == answers[2] == fresh,
            "asked the same again, or in another order, it answers otherwise",
            "look at the steps only: keep nothing, draw nothing, read no clock",
        )

    def test_the_steps_are_left_as_they_were(self) -> None:
        steps, before = list(walk([1.0, 0.5, 0.0])), walk([1.0, 0.5, 0.0])
        self.stops(self.create(), steps)
        is_unchanged = len(steps) == len(before) and all(
            (a.cost, a.value, a.decision.tolist()) == (b.cost, b.value, b.decision.tolist())
            for a, b in zip(steps, before, strict=False)
        )
        demand(is_unchanged, "it has changed the steps", "copy what you change: the method goes on with these records")

    def test_numbers_that_are_not_finite_are_survived(self) -> None:
        rule = self.create()
        odd = replace(walk([1.0])[0], value=-np.inf, lower_bound=-np.inf)
        self.stops(rule, (odd,))
        self.stops(rule, (odd, odd))
        self.stops(rule, (*walk([1.0, 1.0]), replace(odd, cost=0.0, decision=np.zeros(3))))

    def test_zeros_are_survived(self) -> None:
        still = replace(walk([0.0])[0], value=0.0, cost=0.0, lower_bound=0.0, decision=np.zeros(3))
        self.stops(self.create(), [still] * 50)


def searched(count: int, every: int = 1, rises: float = 1.0, notes: dict[str, float] | None = None) -> Progress:
    """A search after ``count`` evaluations whose best value rose by ``rises`` at every ``every``-th of them."""
    improvements = [(1, 0.0), *((k, rises * k) for k in range(2, count + 1) if k % every == 0)]
    return Progress(count, improvements[-1][1], notes or {}, improvements)


class InnerStopContract(Contract[InnerStop], kind="rule", of=InnerStop):
    """Contract of an inner stopping rule (the paper's ``SC2``): subclass it as ``class TestMine(InnerStopContract)``
    and give ``component``.

    Called with the `Progress` of a search after every batch of evaluations, the rule returns True or False, at once. It
    does not stop a search that has only begun, and needs no note that a maximiser may not write. Once it has stopped a
    search, it never lets that search go on. The budget ends a search in any case.
    """

    def stops(self, rule: InnerStop, progress: Progress) -> bool:
        """Return the rule's answer; the contract is broken where it is no truth value."""
        call = f"called after {progress.evaluations} evaluations, notes {dict(progress.notes)}"
        answer = asked(
            lambda: rule(progress),
            call,
            "ask with `progress.notes.get(name, default)`, and expect -inf as a best value and no improvement at all",
        )
        return truth(answer, call)

    def test_a_search_that_has_only_begun_goes_on(self) -> None:
        rule = self.create()
        for count in (1, 2, 5, 10):
            demand(
                not self.stops(rule, searched(count)),
                f"it stops a search after {count} evaluations, each better than the one before",
                "stop where the search has gone on for long without success",
            )

    def test_whatever_a_search_looks_like_it_answers(self) -> None:
        rule = self.create()
        for progress in (
            Progress(1, -np.inf, {}, []),
            Progress(1, -np.inf, {}, [(1, -np.inf)]),
            Progress(300, -np.inf, {"temperature": 0.0}, [(1, -np.inf)]),
            Progress(10**7, 1e300, {"temperature": np.inf, "other": np.nan}, [(1, -1e300), (2, 1e300)]),
            searched(1000, every=900),
        ):
            self.stops(rule, progress)

    def test_the_same_progress_has_the_same_answer(self) -> None:
        rule = self.create()
        asks = [searched(count, interval) for interval in (1, 50, 10_000) for count in (1, 10, 100, 1000, 5000)]
        asks += [searched(100, 1000, 1.0, {"temperature": heat}) for heat in (1.0, 1e-3, 1e-30)]
        answers = [[self.stops(rule, progress) for progress in order] for order in (asks, asks[::-1])]
        with an_hour_later():
            answers.append([self.stops(rule, progress) for progress in asks])
        fresh = [self.stops(self.create(), progress) for progress in asks]
        demand(
            answers[0] == answers[1][::-1] == answers[2] == fresh,
            "asked the same again, or in another order, it answers otherwise",
            "look at the progress only: keep nothing, draw nothing, read no clock",
        )

    def test_what_is_stopped_stays_stopped_while_nothing_rises(self) -> None:
        rule, stopped = self.create(), 0
        for count in range(1, 3000, 7):
            now = self.stops(rule, searched(count, 10**6))
            demand(
                now or not stopped,
                f"it stops a search after {stopped} evaluations, and not after {count}, though nothing rose since",
                "count what has gone by since the last improvement; maximisers evaluate in batches of any size",
            )
            stopped = count if now and not stopped else stopped

    def test_the_progress_is_left_as_it_was(self) -> None:
        improvements, notes = [(1, 0.0), (5, 1.0), (20, 2.0)], {"temperature": 1.0}
        self.stops(self.create(), Progress(400, 2.0, notes, improvements))
        demand(
            improvements == [(1, 0.0), (5, 1.0), (20, 2.0)] and notes == {"temperature": 1.0},
            "it has changed the progress",
            "copy what you change: the search keeps its accounts there",
        )

    def test_it_takes_no_time(self) -> None:
        rule, seconds, long = self.create(), [], searched(20_000, 3)
        for _ in range(21):
            start = time.perf_counter()
            self.stops(rule, long)
            seconds.append(time.perf_counter() - start)
        demand(
            float(np.median(seconds)) <= QUICK,
            f"one answer takes {1e3 * float(np.median(seconds)):.1f} ms after 20 000 evaluations",
            "it is asked after every batch: look at the end of `improvements`, or bisect",
        )


class SelectionContract(Contract[Selection], kind="rule", of=Selection):
    """Contract of a rule of acceptance (the paper's ``SlCr``): subclass it as ``class TestMine(SelectionContract)`` and
    give ``component``.

    The rule is called with the current value of the walk, the value of a candidate, a temperature (0 or more) and a
    generator of random numbers. It returns whether the walk goes on from the candidate. Values are maximised. A worse
    candidate is accepted the less often the worse it is and the lower the temperature is, never at the temperature 0
    and never at -inf. A better candidate is accepted at least every second time, and always at the temperature 0.
    """

    def accepts(self, rule: Selection, current: float, candidate: float, heat: float, rng: np.random.Generator) -> bool:
        """Return the rule's answer for one candidate; the contract is broken where it is no truth value."""
        call = f"called with current {current:g}, candidate {candidate:g}, temperature {heat:g}"
        answer = asked(
            lambda: rule(current, candidate, heat, rng),
            call,
            "values may be -inf, differences huge, and the temperature 0: ask first which value is larger, and bound "
            "what goes into `exp`",
        )
        return truth(answer, call)

    def share(self, current: float, candidate: float, heat: float) -> float:
        """Return the share of `RULE_DRAWS` trials in which a new rule accepts a candidate."""
        rule, rng = self.create(), np.random.default_rng(5)
        return float(np.mean([self.accepts(rule, current, candidate, heat, rng) for _ in range(RULE_DRAWS)]))

    def test_what_is_better_is_accepted_as_a_rule(self) -> None:
        for current, candidate in ((0.0, 1.0), (-5.0, -4.9), (1e6, 2e6)):
            for heat in (1e-9, 0.3, 10.0):
                share = self.share(current, candidate, heat)
                demand(
                    share >= 0.5 - SPREAD,
                    f"{candidate:g} is accepted for {current:g} in {share:.0%} of all cases only, at {heat:g}",
                    "values are maximised: a larger one is the better one",
                )

    def test_in_the_cold_only_what_is_better_is_accepted(self) -> None:
        for loss in (1e-12, 0.1, 1e9):
            demand(
                self.share(1.0, 1.0 - loss, 0.0) == 0.0 and self.share(1.0, 1.0 + loss, 0.0) == 1.0,
                f"at the temperature 0 a candidate that is worse by {loss:g} is accepted, or one that is better is not",
                "compare the two values where the temperature is 0",
            )

    def test_the_worse_the_seldomer(self) -> None:
        shares = [self.share(0.0, -loss, 1.0) for loss in (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 50.0, 1e4)]
        demand(
            all(after <= before + SPREAD for before, after in pairwise(shares)) and shares[-1] <= SPREAD,
            f"candidates that are worse and worse are accepted with the frequencies {shares}",
            "let acceptance fall with the loss `current - candidate`, to 0 for a very large one",
        )

    def test_the_hotter_the_more_often(self) -> None:
        shares = [self.share(0.0, -1.0, heat) for heat in (0.0, 0.1, 0.5, 1.0, 3.0, 20.0, 1e6)]
        demand(
            all(after >= before - SPREAD for before, after in pairwise(shares)),
            f"at rising temperatures a candidate that is worse by 1 is accepted with the frequencies {shares}",
            "divide the loss by the temperature",
        )

    def test_what_has_no_value_is_never_accepted_and_always_left(self) -> None:
        demand(
            self.share(0.0, -np.inf, 1.0) == 0.0 and self.share(0.0, -np.inf, 1e9) == 0.0,
            "a candidate of -inf, where the function is not defined, is accepted",
            "refuse -inf first of all",
        )
        demand(
            self.share(-np.inf, 0.0, 1.0) == 1.0 and self.share(-np.inf, -1e12, 0.0) == 1.0,
            "a walk that stands at -inf, where the function is not defined, does not leave it at once",
            "accept any number where the current value is -inf",
        )

    def test_odd_numbers_are_survived(self) -> None:
        rule, rng = self.create(), np.random.default_rng(0)
        for current, candidate in ((-np.inf, -np.inf), (1e308, -1e308), (-1e308, 1e308), (0.0, -1e6), (1.0, np.inf)):
            for heat in (0.0, 1e-300, 1.0, 1e300):
                self.accepts(rule, current, candidate, heat, rng)

    def test_the_generator_it_is_given_is_all_the_chance_there_is(self) -> None:
        rule, own = self.create(), random.getstate()
        shared = str(np.random.get_state(legacy=False))  # noqa: NPY002
        cases = [(1.0, 1.0 - 0.1 * k, 0.5) for k in range(12)] * 20

        def walked(by: Selection, order: Sequence[tuple[float, float, float]]) -> list[bool]:
            rng = np.random.default_rng(9)
            return [self.accepts(by, *case, rng) for case in order]

        demand(
            walked(rule, cases) == walked(rule, cases) == walked(self.create(), cases),
            "the same questions with the same seed are answered otherwise the second time",
            "draw from the `rng` of the call only, and keep nothing between calls",
        )
        demand(
            shared == str(np.random.get_state(legacy=False)) and own == random.getstate(),  # noqa: NPY002
            "it draws from, or seeds, the random numbers of the whole process (np.random or random)",
            "use the `rng` of the call",
        )
