"""Guards control/policies and plugins/sparserob_executors: the first components of the two kinds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.experiment.config.writing.source import component_keys
from sparserob_core.experiment.plugins.guards import guarded


@pytest.fixture(scope="module")
def registry():
    plugins = Path(__file__).resolve().parents[2] / "plugins"
    files = [plugins / f"sparserob_{name}" / "__init__.py" for name in ("policies", "executors")]
    return sr.load_registry(files, entry_points=False)


def test_an_open_loop_control_knows_nothing(registry):
    assert registry.build("policy", "open_loop").knows == frozenset()


def test_the_serial_executor_calls_in_order_and_raises_where_the_result_is_asked_for(registry):
    calls = []
    with registry.build("executor", "serial").open() as executor:
        assert list(executor.map(lambda k: calls.append(k) or k * k, range(4))) == [0, 1, 4, 9]
        failed = executor.submit(lambda: 1 / 0)
        assert failed.done()
        with pytest.raises(ZeroDivisionError):
            failed.result()
    assert calls == [0, 1, 2, 3]


def test_an_interrupt_goes_through_the_serial_executor(registry):
    def interrupted():
        raise KeyboardInterrupt

    with registry.build("executor", "serial").open() as executor, pytest.raises(KeyboardInterrupt):
        executor.submit(interrupted)


CONFIG = {
    "problem": {
        "name": "linear", "horizon": 1.0, "system": {"A": [[0.0]], "B": [[1.0]]}, "initial_state": [1.0],
        "control": {"box": 4.0}, "terminal": [{"box": 0.1}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 4}}, "observers": [],
}  # fmt: skip


@pytest.mark.parametrize("policy", ["open_loop", {"name": "open_loop"}])
def test_a_config_may_name_its_policy_and_its_executor(tmp_path, policy):
    outcome = sr.run({**CONFIG, "policy": policy, "executor": "serial"}, out=tmp_path / "run", figures=False)
    assert outcome.result.status == "certified"
    config = outcome.experiment.loaded.config
    assert (config.policy.name, config.executor.name) == ("open_loop", "serial")


def test_an_affine_policy_knows_the_state(registry):
    assert registry.build("policy", "affine", {"cost": "peak"}).knows == {"state"}


def test_a_policy_that_does_not_say_what_it_answers_cannot_be_transcribed(tmp_path):
    (tmp_path / "feedback.py").write_text(
        "import sparserob_core as sr\nclass Feedback(sr.Policy, sr.Options):\n"
        "    @property\n    def knows(self):\n        return frozenset({'state'})\n"
        "@sr.hookimpl\ndef sparserob_policies():\n    yield sr.PolicyPlugin(name='feedback', factory=Feedback)\n"
    )
    with pytest.raises(sr.ConfigError, match=r"policy\.name: expected .*method answers.* knows the state"):
        sr.run({**CONFIG, "policy": "feedback", "plugins": [str(tmp_path / "feedback.py")]}, out=tmp_path / "run")


def test_a_run_hands_its_workers_to_the_method(tmp_path):
    (tmp_path / "pool.py").write_text(
        "from concurrent.futures import ThreadPoolExecutor\nfrom contextlib import contextmanager\n"
        "import sparserob_core as sr\n"
        "class Pool(sr.ExecutorFactory, sr.Options):\n"
        "    @contextmanager\n    def open(self):\n"
        "        with ThreadPoolExecutor(1) as pool:\n            yield pool\n"
        "class Asking(sr.Method, sr.Options):\n    def solve(self, program, tools):\n"
        "        said = tools.executor.submit(sum, [1, 2]).result()\n"
        "        return sr.Result(status='failed', message=f'{type(tools.executor).__name__} {said}')\n"
        "@sr.hookimpl\ndef sparserob_executors():\n    yield sr.ExecutorPlugin(name='pool', factory=Pool)\n"
        "@sr.hookimpl\ndef sparserob_methods():\n    yield sr.MethodPlugin(name='asking', factory=Asking)\n"
    )
    chosen = {"executor": "pool", "method": "asking", "plugins": [str(tmp_path / "pool.py")]}
    outcome = sr.run({**CONFIG, **chosen}, out=tmp_path / "run", figures=False)
    assert outcome.result.message == "ThreadPoolExecutor 3"


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return None", "open raised"),
        ("raise SystemExit(0)", "open raised SystemExit: 0"),
        ("import contextlib; return contextlib.nullcontext(3)", "open returned 3, expected a Executor"),
    ],
)
def test_workers_that_cannot_be_had_are_named(tmp_path, body, words):
    (tmp_path / "odd.py").write_text(
        "import sparserob_core as sr\nclass Odd(sr.ExecutorFactory, sr.Options):\n"
        f"    def open(self):\n        {body}\n"
        "@sr.hookimpl\ndef sparserob_executors():\n    yield sr.ExecutorPlugin(name='odd', factory=Odd)\n"
    )
    chosen = {"executor": "odd", "plugins": [str(tmp_path / "odd.py")]}
    with pytest.raises(sr.PluginError, match=f"executor 'odd' .*{words}"):
        sr.run({**CONFIG, **chosen}, out=tmp_path / "run", figures=False)


ANSWERING = '''
import numpy as np
import sparserob_core as sr
from pydantic import Field


class Recent(sr.Policy, sr.Options):
    """Answers the last few measurements."""

    recent: int = Field(default=1, ge=0)
    cost: str = "nominal"

    @property
    def knows(self):
        return frozenset({"state"})

    def answers(self, breakpoints):
        pieces = np.arange(len(breakpoints) - 1)
        age = pieces[:, None] - pieces
        return (age >= 0) & (age < self.recent)

    @property
    def charge(self):
        return sr.Charge(cost=self.cost, causal_signals=4)


@sr.hookimpl
def sparserob_policies():
    yield sr.PolicyPlugin(name="recent", factory=Recent)
'''
DISTURBED = {
    "problem": {
        "name": "linear", "horizon": 2.0, "system": {"A": [[0, 1], [0, 0]], "B": [[0], [1]]},
        "initial_state": [1.0, 0.0], "control": {"box": 2.0}, "disturbance": {"box": [0.02, 0.05]},
        "path": [{"box": [1.1, None]}], "terminal": [{"box": [0.4, 0.4]}],
    },
    "dictionaries": {"control": {"name": "piecewise_constant", "pieces": 6}}, "observers": [],
}  # fmt: skip


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    file = tmp_path_factory.mktemp("plugin") / "recent.py"
    file.write_text(ANSWERING)
    return str(file)


def ran(place, policy, plugin):
    config = {**DISTURBED, "policy": policy, "plugins": [plugin]}
    return sr.run(config, out=place, quiet=True, figures=False)


@pytest.mark.first(1)
@pytest.mark.parametrize("cost", ["nominal", "peak", "worst"])
def test_a_policy_of_somebody_else_that_answers_the_last_measurement_is_solved_proven_and_checked(
    tmp_path, plugin, cost
):
    """The same as a memory that keeps no more, by value; the check loads no plugin."""
    theirs = ran(tmp_path / "theirs", {"name": "recent", "cost": cost}, plugin)
    ours = ran(tmp_path / "ours", {"name": "affine", "cost": cost, "memory": 0.0, "causal_signals": 4}, plugin)
    assert theirs.result.status == ours.result.status == "certified"
    assert theirs.result.cost == pytest.approx(ours.result.cost, rel=1e-6)
    gains = np.load(theirs.directory / "solution.npz")["gains"]
    assert gains.any() and not gains[~np.eye(6, dtype=bool)].any()
    found = sr.check(theirs.directory)
    assert found.status == "verified"
    assert "not loaded" in next(claim.text for claim in found.claims if claim.name == "policy")
    loaded = sr.check(theirs.directory, plugins=[plugin])
    assert loaded.status == "verified"
    assert "not loaded" not in next(claim.text for claim in loaded.claims if claim.name == "policy")


@pytest.mark.slow
def test_more_measurements_cost_no_more_and_none_cost_what_an_open_loop_does(tmp_path, plugin):
    policies = [{"name": "recent", "recent": count} for count in (0, 1, 2, 6)] + ["open_loop", "affine"]
    chosen = [one if isinstance(one, str) else {**one, "cost": "nominal"} for one in policies]
    runs = [ran(tmp_path / str(number), policy, plugin) for number, policy in enumerate(chosen)]
    none, one, two, all_of_them, open_loop, affine = (run.result.cost for run in runs)
    assert none == open_loop and "gains" not in np.load(runs[0].directory / "solution.npz")
    assert all(run.result.status == "certified" for run in runs)
    assert none > one * 1.001 > two > all_of_them * 0.999999
    assert all_of_them == pytest.approx(affine, rel=1e-6)
    assert sr.check(runs[0].directory).status == "verified"


@pytest.mark.slow
def test_answers_that_are_written_must_be_those_of_the_config_and_of_the_gains(tmp_path, plugin):
    """Fewer answers would prove a higher bound, and more of them allow gains that nobody asked for."""
    theirs = ran(tmp_path / "theirs", {"name": "recent", "recent": 2}, plugin).directory
    ours = ran(tmp_path / "ours", "affine", plugin).directory

    def judged(directory, answers, **given):
        file = directory / "certificate.json"
        said = json.loads(file.read_text())
        file.write_text(json.dumps({**said, "policy": {**said["policy"], **answers}}))
        found = {claim.name: claim.verdict for claim in sr.check(directory, **given).claims}
        file.write_text(json.dumps(said))
        return found

    last = [[[k, k]] for k in range(6)]
    assert judged(theirs, {"answers": last})["control"] == "fails"
    assert judged(theirs, {"answers": last}, plugins=[plugin])["policy"] == "fails"
    assert judged(ours, {"answers": last})["policy"] == "fails"
    assert judged(ours, {"cost": "peak"})["policy"] == "fails"
    assert judged(theirs, {"cost": "peak"})["cost"] == "fails"
    early = [[[0, 1]], *last[1:]]
    wrong = (
        early,
        [*last[:5], [[5, 6]]],
        [*last[:5], [[5.0, 5.0]]],
        [*last[:5], [[True, 5]]],
        last[:5],
        "all",
        [*last[:5], 5],
    )
    for answers in wrong:
        assert judged(theirs, {"answers": answers})["policy"] == "fails"
    assert judged(theirs, {"cost": ["nominal"]})["policy"] == "fails"
    assert sr.check(theirs).status == sr.check(ours).status == "verified"


def test_a_policy_of_somebody_else_is_written_by_its_name_and_options(plugin):
    """What was solved holds it behind the check of its kind."""
    registry = sr.load_registry([plugin])
    chosen = guarded(registry.build("policy", "recent", {"recent": 2}), "policy recent")
    assert component_keys(registry, "policy", chosen) == {"name": "recent", "recent": 2, "cost": "nominal"}


def test_what_a_policy_raises_is_attributed_to_it(tmp_path):
    text = ANSWERING.replace("age = pieces[:, None] - pieces", "raise RuntimeError('no table')")
    (tmp_path / "broken.py").write_text(text)
    with pytest.raises(sr.PluginError, match=r"policy 'recent'.* answers raised RuntimeError: no table"):
        ran(tmp_path / "run", "recent", str(tmp_path / "broken.py"))
