"""Guards sparserob_core/testing/rules and every registered schedule, stopping rule and rule of acceptance: each keeps
the contract of its kind, and rules that are wrong on purpose fail it."""

from __future__ import annotations

import math
import pickle
import time

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.testing import InnerStopContract, OuterStopContract, ScheduleContract, SelectionContract
from tests.support.faults import fails

REGISTRY = sr.load_registry()


@pytest.mark.parametrize("name", REGISTRY.names("rule", sr.Schedule))
class TestRegisteredSchedule(ScheduleContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("rule", self.name)


@pytest.mark.parametrize("name", REGISTRY.names("rule", sr.OuterStop))
class TestRegisteredOuterStop(OuterStopContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("rule", self.name)


@pytest.mark.parametrize("name", REGISTRY.names("rule", sr.InnerStop))
class TestRegisteredInnerStop(InnerStopContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("rule", self.name)


@pytest.mark.parametrize("name", REGISTRY.names("rule", sr.Selection))
class TestRegisteredSelection(SelectionContract):
    @pytest.fixture(autouse=True)
    def named(self, name):
        self.name = name

    def create(self):
        return REGISTRY.build("rule", self.name)


def rule(kind, name, call, **fields):
    """A class of rules that answers with ``call``, to which it hands itself."""
    return type(name, (kind,), {"__call__": call, **fields})


def counted(self):
    self.count = getattr(self, "count", 0) + 1
    return self.count


DRAWN = np.random.default_rng()
POSITIVE = "test_every_weight_is_positive_and_below_the_one_before"
DOWN = "test_weights_come_down_to_a_millionth_of_the_first_one"
SCHEDULES = {
    "rising": (lambda self, epsilon, j: 2 * epsilon, POSITIVE),
    "constant": (lambda self, epsilon, j: epsilon, POSITIVE),
    "zero at once": (lambda self, epsilon, j: 0.0, POSITIVE),
    "negative": (lambda self, epsilon, j: epsilon - 1e-3, POSITIVE),
    "not a number": (lambda self, epsilon, j: math.nan, POSITIVE),
    "nothing": (lambda self, epsilon, j: None, POSITIVE),
    "a list": (lambda self, epsilon, j: np.array([epsilon / 2]), POSITIVE),
    "true": (lambda self, epsilon, j: True, POSITIVE),
    "blind to epsilon": (lambda self, epsilon, j: 2.0**-j, POSITIVE),
    "dividing by zero": (lambda self, epsilon, j: epsilon / (j - 3), POSITIVE),
    "stuck": (lambda self, epsilon, j: epsilon * (0.5 + 0.5 * math.exp(-5e-6)), DOWN),
    "harmonic": (lambda self, epsilon, j: epsilon * j / (j + 1), DOWN),
    "remembering": (
        lambda self, epsilon, j: epsilon / (1 + counted(self)), "test_the_same_question_has_the_same_answer",
    ),
    "drawn": (lambda self, epsilon, j: epsilon * DRAWN.uniform(0.1, 0.5), "test_the_same_question_has_the_same_answer"),
    "picky": (
        lambda self, epsilon, j: epsilon / (2 if type(epsilon) is float else 3), "test_numbers_of_numpy_do_as_well",
    ),
}  # fmt: skip

STEPS = "test_the_same_steps_have_the_same_answer"
ENDS, GOES_ON = "test_it_stops_where_nothing_changes_any_more", "test_it_goes_on_while_everything_changes"
FINITE, ZEROS = "test_numbers_that_are_not_finite_are_survived", "test_zeros_are_survived"


def settled(steps, tolerance=1e-6):
    """A right rule, for wrong ones to begin with."""
    return len(steps) > 1 and bool(abs(steps[-1].cost - steps[-2].cost) <= tolerance)


def clocked(self, steps):
    self.began = getattr(self, "began", time.perf_counter())
    return time.perf_counter() - self.began > 600.0


OUTER_STOPS = {
    "never": (lambda self, steps: False, ENDS),
    "at once": (lambda self, steps: True, GOES_ON),
    "the second time": (lambda self, steps: len(steps) > 1, GOES_ON),
    "upside down": (lambda self, steps: not settled(steps), GOES_ON),
    "one step expected": (lambda self, steps: steps[-1].cost == steps[-2].cost, GOES_ON),
    "a number": (lambda self, steps: float(settled(steps)), ENDS),
    "nothing": (lambda self, steps: None, ENDS),
    "an array": (lambda self, steps: np.array([settled(steps)]), ENDS),
    "every coordinate": (lambda self, steps: steps[-1].decision == steps[0].decision, ENDS),
    "counting its calls": (lambda self, steps: settled(steps) and counted(self) > 3, STEPS),
    "drawing": (lambda self, steps: settled(steps) and bool(DRAWN.random() < 0.5), STEPS),
    "reading a clock": (clocked, STEPS),
    "emptying": (lambda self, steps: bool(steps.clear() or True), "test_the_steps_are_left_as_they_were"),
    "dividing": (
        lambda self, steps: len(steps) > 1 and bool(abs(steps[-1].cost - steps[-2].cost) / steps[-1].cost < 1e-9),
        ZEROS,
    ),
    "a logarithm": (lambda self, steps: settled(steps) and math.log(steps[-1].value - 1.0) < 1e9, FINITE),
}  # fmt: skip

LATER = "test_what_is_stopped_stays_stopped_while_nothing_rises"
BEGUN, WHATEVER = "test_a_search_that_has_only_begun_goes_on", "test_whatever_a_search_looks_like_it_answers"
ANSWER = "test_the_same_progress_has_the_same_answer"


def stale(progress, window=300):
    """A right rule, for wrong ones to begin with."""
    return bool(progress.gain(window) <= 0.0)


def slow(self, progress):
    time.sleep(2e-3)
    return stale(progress)


def scribbling(self, progress):
    del progress.improvements[:-1]
    return False


INNER_STOPS = {
    "at once": (lambda self, progress: True, BEGUN),
    "upside down": (lambda self, progress: not stale(progress), BEGUN),
    "after five": (lambda self, progress: progress.evaluations >= 5, BEGUN),
    "nothing": (lambda self, progress: None, BEGUN),
    "a number": (lambda self, progress: 0, BEGUN),
    "an array": (lambda self, progress: np.array([stale(progress)]), BEGUN),
    "a temperature expected": (lambda self, progress: progress.notes["temperature"] < 1e-6, BEGUN),
    "improvements expected": (
        lambda self, progress: progress.improvements[-1][0] < progress.evaluations - 500, WHATEVER,
    ),
    "a value expected": (lambda self, progress: int(progress.best_value) > 10**9, WHATEVER),
    "a ratio": (lambda self, progress: progress.best_value / progress.notes.get("temperature", 1.0) < -1e99, WHATEVER),
    "counting its calls": (lambda self, progress: counted(self) > 14, ANSWER),
    "drawing": (lambda self, progress: progress.evaluations > 20 and bool(DRAWN.random() < 0.5), ANSWER),
    "reading a clock": (lambda self, progress: progress.evaluations > 20 and clocked(self, ()), ANSWER),
    "now and then": (lambda self, progress: progress.evaluations > 20 and progress.evaluations % 3 == 0, LATER),
    "scribbling": (scribbling, "test_the_progress_is_left_as_it_was"),
    "slow": (slow, "test_it_takes_no_time"),
}  # fmt: skip

BETTER, COLD = "test_what_is_better_is_accepted_as_a_rule", "test_in_the_cold_only_what_is_better_is_accepted"
WORSE, HOTTER = "test_the_worse_the_seldomer", "test_the_hotter_the_more_often"
UNDEFINED, ODD = "test_what_has_no_value_is_never_accepted_and_always_left", "test_odd_numbers_are_survived"
CHANCE = "test_the_generator_it_is_given_is_all_the_chance_there_is"


def metropolis(current, candidate, temperature, rng):
    """A right rule, for wrong ones to begin with."""
    if candidate >= current:
        return True
    return temperature > 0.0 and bool(rng.random() < math.exp(max(-700.0, (candidate - current) / temperature)))


SELECTIONS = {
    "upside down": (lambda self, now, then, heat, rng: metropolis(-now, -then, heat, rng), BETTER),
    "refusing": (lambda self, now, then, heat, rng: False, BETTER),
    "shy": (lambda self, now, then, heat, rng: metropolis(now, then, heat, rng) and bool(rng.random() < 0.3), BETTER),
    "everything": (lambda self, now, then, heat, rng: True, COLD),
    "warm in the cold": (lambda self, now, then, heat, rng: metropolis(now, then, heat + 0.1, rng), COLD),
    "zero divided": (lambda self, now, then, heat, rng: bool(rng.random() < math.exp((then - now) / heat)), COLD),
    "a frequency": (lambda self, now, then, heat, rng: math.exp(min(0.0, (then - now) / max(heat, 1e-9))), BETTER),
    "nothing": (lambda self, now, then, heat, rng: None, BETTER),
    "the distance": (
        lambda self, now, then, heat, rng: bool(then >= now or rng.random() < (now - then) / 10 * (heat > 0)), WORSE,
    ),
    "whatever the loss": (
        lambda self, now, then, heat, rng: bool(then >= now or (heat > 0 and rng.random() < 0.3)), WORSE,
    ),
    "cooler when hotter": (
        lambda self, now, then, heat, rng: metropolis(now, then, 1 / heat if heat > 0 else 0.0, rng), HOTTER,
    ),
    "undefined is as good": (
        lambda self, now, then, heat, rng: metropolis(now, max(then, now - 1e-3), heat, rng), UNDEFINED,
    ),
    "stuck where undefined": (
        lambda self, now, then, heat, rng: bool(then - now >= 0 and np.isfinite(now)) , UNDEFINED,
    ),
    "overflowing": (
        lambda self, now, then, heat, rng: bool(
            then >= now or (heat > 0 and np.exp((now - then) / heat) < 1 / (1 - rng.random()))
        ),
        ODD,
    ),
    "drawing elsewhere": (
        lambda self, now, then, heat, rng: metropolis(now, then, heat, np.random.default_rng()), CHANCE,
    ),
    "drawing from all": (
        lambda self, now, then, heat, rng: metropolis(now, then, heat, np.random),
        CHANCE,
    ),
    "counting its calls": (
        lambda self, now, then, heat, rng: bool(then >= now) or (heat > 0 and counted(self) % 7 == 0), CHANCE,
    ),
}  # fmt: skip

FAULTS = [
    pytest.param(contract, kind, name, call, test, id=f"{kind.__name__}-{name.replace(' ', '_')}")
    for contract, kind, faults in (
        (ScheduleContract, sr.Schedule, SCHEDULES),
        (OuterStopContract, sr.OuterStop, OUTER_STOPS),
        (InnerStopContract, sr.InnerStop, INNER_STOPS),
        (SelectionContract, sr.Selection, SELECTIONS),
    )
    for name, (call, test) in faults.items()
]


@pytest.mark.first(31)
@pytest.mark.parametrize(("contract", "kind", "name", "call", "test"), FAULTS)
def test_the_contract_catches_a_rule_that_is_wrong_on_purpose(contract, kind, name, call, test):
    fails(contract, rule(kind, name, call), test)


def halved(epsilon, j):
    """Half of it."""
    return epsilon / 2


class TestAPlainFunctionAsASchedule(ScheduleContract):
    component = sr.Schedule.of(halved)


def test_a_plain_function_is_a_rule_under_a_name(tmp_path):
    file = tmp_path / "halving.py"
    file.write_text(
        "import sparserob_core as sr\n\ndef halved(epsilon, j):\n    return epsilon / 2\n\n"
        "@sr.hookimpl\ndef sparserob_rules():\n"
        "    yield sr.RulePlugin(name='halving', factory=sr.Schedule.of(halved))\n"
    )
    regu = sr.load_registry([file]).build("rule", "halving")
    assert isinstance(regu, sr.Schedule)
    assert regu(0.5, 1) == 0.25
    again = pickle.loads(pickle.dumps(sr.Selection.of(metropolis)()))
    assert isinstance(again, sr.Selection)
    assert again(0.0, 1.0, 1.0, None)


def test_a_rule_of_another_piece_is_refused_by_name_and_is_not_offered(tmp_path):
    assert REGISTRY.names("rule", sr.Schedule) == ["accelerating", "geometric"]
    with pytest.raises(sr.UnknownPluginError, match="no rule of the class Selection is named 'geometric'; known: impr"):
        REGISTRY.get("rule", "geometric", sr.Selection)
    file = tmp_path / "made.py"
    file.write_text(
        "import sparserob_core as sr\n\ndef made():\n    return sr.Schedule.of(lambda epsilon, j: epsilon / 2)()\n\n"
        "@sr.hookimpl\ndef sparserob_rules():\n    yield sr.RulePlugin(name='made', factory=made)\n"
    )
    registry = sr.load_registry([file])
    assert isinstance(registry.build("method", "sparserob", {"regu": "made"}).regu, sr.Schedule)
    with pytest.raises(sr.PluginError, match=r"rule 'made' \(plugin 'made'.* expected a Selection"):
        registry.build("method", "sparserob", {"slcr": "made"})


class TestARightSelection(SelectionContract):
    component = rule(sr.Selection, "Right", lambda self, *question: metropolis(*question))


class TestARightOuterStop(OuterStopContract):
    component = rule(sr.OuterStop, "Right", lambda self, steps: settled(steps))


class TestARightInnerStop(InnerStopContract):
    component = rule(sr.InnerStop, "Right", lambda self, progress: stale(progress))
