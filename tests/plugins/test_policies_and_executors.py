"""Guards control/policies and plugins/sparserob_executors: the first components of the two kinds."""

from __future__ import annotations

from pathlib import Path

import pytest

import sparserob_core as sr


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


def test_a_policy_that_knows_something_else_cannot_be_transcribed(tmp_path):
    (tmp_path / "feedback.py").write_text(
        "import sparserob_core as sr\nclass Feedback(sr.Policy, sr.Options):\n"
        "    @property\n    def knows(self):\n        return frozenset({'state'})\n"
        "@sr.hookimpl\ndef sparserob_policies():\n    yield sr.PolicyPlugin(name='feedback', factory=Feedback)\n"
    )
    with pytest.raises(sr.ConfigError, match=r"policy\.name: expected open_loop or affine.* knows the state"):
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
