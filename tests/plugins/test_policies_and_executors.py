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
