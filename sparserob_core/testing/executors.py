"""The contract of an executor: every call once, its answer or its error where it was asked for, and nothing left
running."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.method import ExecutorFactory

CALLS = 12
MOMENT = 0.05  # seconds that a call takes where it has to take some


class ExecutorContract(ABC):
    """What every executor must keep: subclass it in a test module as ``class TestMine(ExecutorContract)`` and give
    ``create``.

    An executor is a component whose ``open()`` is a context with a `concurrent.futures.Executor`. The contract asks for
    nothing but ``submit``, ``map`` without chunks, futures, and the end of the context.
    """

    isolated = True
    """Whether calls are made in processes of their own; ``False``: here, so that none may die, and what cannot be
    pickled goes through."""

    patience = 60.0
    """Seconds after which an answer is taken for lost."""

    long = 30.0
    """Seconds of a call that is abandoned."""

    @abstractmethod
    def create(self) -> ExecutorFactory:
        """A new executor with its default options."""

    @contextmanager
    def opened(self) -> Iterator[Executor]:
        """The workers of a new executor."""
        with self.create().open() as executor:
            assert isinstance(executor, Executor)
            yield executor

    def test_answers_come_in_the_order_of_the_arguments_whatever_is_ready_first(self) -> None:
        with self.opened() as executor:
            seconds = [MOMENT * ((CALLS - k) % 3) for k in range(CALLS)]
            assert list(executor.map(late, range(CALLS), seconds, timeout=self.patience)) == list(range(CALLS))
            futures = [executor.submit(late, k, seconds[k]) for k in range(CALLS)]
            assert [self.answer(future) for future in futures] == list(range(CALLS))

    def test_every_call_is_made_exactly_once(self) -> None:
        with TemporaryDirectory() as folder, self.opened() as executor:
            for future in [executor.submit(mark, folder, f"{k}") for k in range(CALLS)]:
                self.answer(future)
            for future in [executor.submit(mark, folder, "equal") for _ in range(CALLS)]:  # equal calls are calls
                self.answer(future)
            assert marks(folder) == {**{f"{k}": 1 for k in range(CALLS)}, "equal": CALLS}

    def test_what_fails_is_not_tried_again(self) -> None:
        with TemporaryDirectory() as folder, self.opened() as executor:
            assert isinstance(self.error(executor.submit(marked_failure, folder)), ArithmeticError)
            assert marks(folder) == {"failed": 1}

    def test_arguments_and_answers_arrive_as_they_are(self) -> None:
        numbers = np.array([0.1, -0.0, np.nan, -np.inf, 5e-324, 1.0 + 2.0**-52])
        with self.opened() as executor:
            array = self.answer(executor.submit(echo, numbers))
            assert array.tobytes() == numbers.tobytes()
            assert self.answer(executor.submit(echo, {"a": (1, "b", None)}, again=[2])) == ({"a": (1, "b", None)}, [2])
            products = np.random.default_rng(0).random((3, 40, 40))
            there = [self.answer(executor.submit(product, matrix)) for matrix in products]
            assert [one.tobytes() for one in there] == [product(matrix).tobytes() for matrix in products]

    def test_an_error_arrives_with_its_type_its_words_and_where_it_was_raised(self) -> None:
        with self.opened() as executor:
            futures = [executor.submit(fails if k == 1 else echo, f"call {k}") for k in range(4)]
            error = self.error(futures[1])
            assert type(error) is ArithmeticError
            assert str(error) == "call 1 has no answer"
            assert "in fails" in "".join(traceback.format_exception(error)), "the traceback is lost"
            assert [self.answer(futures[k]) for k in (0, 2, 3)] == ["call 0", "call 2", "call 3"]
            refused = self.error(executor.submit(refuses))
            assert isinstance(refused, InputError)
            assert str(refused) == "horizon: expected a number, got None"

    def test_an_error_that_cannot_be_sent_arrives_in_its_words(self) -> None:
        with self.opened() as executor:
            assert "it is odd" in "".join(traceback.format_exception(self.error(executor.submit(fails_oddly))))
            assert self.answer(executor.submit(echo, 1)) == 1

    def test_what_cannot_be_sent_is_named_and_harms_nothing_else(self) -> None:
        with self.opened() as executor:
            for future in (executor.submit(echo, _unsendable()), executor.submit(_unsendable)):
                if self.isolated:
                    error = self.error(future)
                    assert not isinstance(error, BrokenExecutor), "what cannot be sent has ended the workers"
                    assert "_unsendable" in str(error), f"it is not named: {error}"
                else:
                    assert self.answer(future)(3) == 3
            assert self.answer(executor.submit(echo, 1)) == 1

    def test_who_waits_is_told_once(self) -> None:
        told: list[Future[Any]] = []
        with self.opened() as executor:
            futures = [executor.submit(echo, k) for k in range(3)] + [executor.submit(fails, "it")]
            for future in futures:
                future.add_done_callback(told.append)
            assert not wait(futures, self.patience).not_done, "a future is never done"
        assert sorted(map(id, told)) == sorted(map(id, futures))

    def test_what_is_cancelled_is_not_called_and_what_is_not_has_its_answer(self) -> None:
        with TemporaryDirectory() as folder:
            with self.opened() as executor:
                futures = [executor.submit(mark, folder, f"{k}", MOMENT) for k in range(CALLS)]
                cancelled = [future.cancel() for future in reversed(futures)][::-1]
                for k, future in enumerate(futures):
                    if cancelled[k]:
                        assert future.cancelled()
                        assert isinstance(self.error(future), CancelledError)
                    else:
                        assert self.answer(future) == f"{k}"
            assert marks(folder) == {f"{k}": 1 for k in range(CALLS) if not cancelled[k]}

    def test_the_end_waits_for_what_was_submitted(self) -> None:
        with TemporaryDirectory() as folder:
            with self.opened() as executor:
                futures = [executor.submit(mark, folder, f"{k}", MOMENT) for k in range(CALLS)]
            assert all(future.done() for future in futures), "the context ended before its calls"
            assert [future.result(0) for future in futures] == [f"{k}" for k in range(CALLS)]
            assert len(marks(folder)) == CALLS

    def test_nothing_can_be_submitted_after_the_end(self) -> None:
        with self.opened() as executor:
            pass
        try:
            executor.submit(echo, 1)
        except RuntimeError:
            return
        raise AssertionError("a call was accepted after the end")

    def test_an_error_of_the_caller_passes_and_abandons_what_is_running(self) -> None:
        futures, began = list[Future[Any]](), time.monotonic()
        try:
            with self.opened() as executor:
                self.answer(executor.submit(echo, 1))
                if self.isolated:
                    futures += [executor.submit(late, k, self.long) for k in range(4)]
                began = time.monotonic()
                raise KeyboardInterrupt("the caller's")
        except KeyboardInterrupt as error:
            assert str(error) == "the caller's"
        else:
            raise AssertionError("the caller's error was swallowed")
        assert time.monotonic() - began < min(self.patience, self.long), "the end waits for calls that nobody waits for"
        assert all(future.done() for future in futures), "who waits for a call that was abandoned waits for ever"

    def test_it_can_be_opened_again_and_leaves_no_thread(self) -> None:
        factory, before = self.create(), set(threading.enumerate())
        for k in range(2):
            with factory.open() as executor:
                assert self.answer(executor.submit(echo, k)) == k
        ends = time.monotonic() + min(self.patience, 5.0)
        while (left := set(threading.enumerate()) - before) and time.monotonic() < ends:
            time.sleep(0.01)
        assert not left, f"still running: {', '.join(thread.name for thread in left)}"

    def test_linear_algebra_has_one_thread(self) -> None:
        """Many add up in another order; answers would depend on the executor."""
        with self.opened() as executor:
            pools = self.answer(executor.submit(threads))
        assert pools
        assert set(pools) == {1}

    def test_a_worker_that_dies_breaks_the_executor_and_hangs_nobody(self) -> None:
        if not self.isolated:
            return
        with self.opened() as executor:
            assert isinstance(self.error(executor.submit(dies)), BrokenExecutor)
        with self.opened() as executor:
            assert self.answer(executor.submit(echo, 1)) == 1

    def test_workers_leave_an_interrupt_to_the_caller(self) -> None:
        if not self.isolated:
            return
        with self.opened() as executor:
            assert self.answer(executor.submit(interrupts_itself)) == "still here"

    def answer(self, future: Future[Any]) -> Any:
        """What a call has returned."""
        return future.result(self.patience)

    def error(self, future: Future[Any]) -> BaseException:
        """What a call has raised, or that it was cancelled."""
        try:
            error = future.exception(self.patience)
        except CancelledError as cancelled:
            return cancelled
        assert error is not None, "an error was swallowed"
        return error


def echo(value: Any, **more: Any) -> Any:
    """Its argument, or all of them."""
    return (value, *more.values()) if more else value


def late(value: int, seconds: float) -> int:
    """Its first argument, after some time."""
    time.sleep(seconds)
    return value


def product(matrix: Array) -> Array:
    """A product and an inverse: linear algebra whose last bits depend on how it is done."""
    return np.asarray(np.linalg.inv(matrix @ matrix.T + np.eye(len(matrix))), dtype=float)


def mark(folder: str, name: str, seconds: float = 0.0) -> str:
    """Leave a line in the file of that name."""
    time.sleep(seconds)
    with (Path(folder) / name).open("a") as file:
        file.write("once\n")
    return name


def marks(folder: str) -> dict[str, int]:
    """How often each name was marked."""
    return {path.name: len(path.read_text().splitlines()) for path in Path(folder).iterdir()}


def marked_failure(folder: str) -> None:
    """Leave a mark, and fail."""
    mark(folder, "failed")
    raise ArithmeticError("it failed")


def fails(what: str) -> None:
    """An error of Python's own."""
    raise ArithmeticError(f"{what} has no answer")


def refuses() -> None:
    """An error of this package, with fields."""
    raise InputError(path="horizon", expected="a number", got="None")


class Odd(Exception):
    """Cannot be made anew from its arguments."""

    def __init__(self, word: str, *, mood: str) -> None:
        super().__init__(f"{word} is {mood}")


def fails_oddly() -> None:
    """Raises what cannot be pickled."""
    raise Odd("it", mood="odd")


def _unsendable() -> Callable[[int], int]:
    return lambda value: value


def threads() -> list[int]:
    """Threads of each library of linear algebra; one that is loaded by this call counts too."""
    import scipy.linalg
    from threadpoolctl import threadpool_info

    scipy.linalg.inv(np.eye(2))
    return [int(library["num_threads"]) for library in threadpool_info()]


def dies() -> None:
    """The process ends at once."""
    os._exit(3)


def interrupts_itself() -> str:
    """What Ctrl-C in a terminal does to a worker."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(2 * MOMENT)
    return "still here"
