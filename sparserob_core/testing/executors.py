"""The contract of an executor: every call once, its answer or its error where it was asked for, and nothing left
running."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, wait
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from sparserob_core.errors import InputError, named
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.method import ExecutorFactory
from sparserob_core.testing.contract import Contract, broken, demand

CALLS = 12  # that are submitted at once
CALL_SECONDS = 0.05  # seconds that a call takes where it has to take some


class ExecutorContract(Contract[ExecutorFactory], kind="executor"):
    """Contract of an executor: subclass it in a test module as ``class TestMine(ExecutorContract)`` and give
    ``component``.

    An executor is a component whose ``open()`` is a context with a `concurrent.futures.Executor`. The contract asks for
    nothing but ``submit``, ``map`` without chunks, futures, and the end of the context.
    """

    isolated = True
    """Whether calls are made in processes of their own; ``False``: in this one, so that none may die, and everything
    can be sent."""

    patience = 60.0
    """Seconds after which an answer is taken for lost."""

    long = 30.0
    """Seconds of a call that is abandoned."""

    @contextmanager
    def opened(self) -> Iterator[Executor]:
        """The workers of a new executor."""
        with self.create().open() as executor:
            demand(
                isinstance(executor, Executor),
                f"the context of open() gave {executor!r}",
                "yield a `concurrent.futures.Executor`: a class that inherits from it needs `submit` and `shutdown`",
            )
            yield executor

    def test_answers_come_in_the_order_of_the_arguments_whatever_is_ready_first(self) -> None:
        mend = "let `submit` return a future of its own for each call, and inherit `map` from `Executor`"
        with self.opened() as executor:
            seconds = [CALL_SECONDS * ((CALLS - k) % 3) for k in range(CALLS)]
            try:
                mapped = list(executor.map(late, range(CALLS), seconds, timeout=self.patience))
            except TimeoutError:
                broken("`map` does not come to its end", mend)
            demand(mapped == list(range(CALLS)), f"`map` gave {mapped} for {list(range(CALLS))}", mend)
            futures = [executor.submit(late, k, seconds[k]) for k in range(CALLS)]
            answers = [self.answer(future) for future in futures]
            demand(answers == list(range(CALLS)), f"futures gave {answers} for {list(range(CALLS))}", mend)

    def test_every_call_is_made_exactly_once(self) -> None:
        with TemporaryDirectory() as folder, self.opened() as executor:
            for future in [executor.submit(mark, folder, f"{k}") for k in range(CALLS)]:
                self.answer(future)
            for future in [executor.submit(mark, folder, "equal") for _ in range(CALLS)]:  # equal calls are calls
                self.answer(future)
            counts, expected = marks(folder), {**{f"{k}": 1 for k in range(CALLS)}, "equal": CALLS}
            demand(
                counts == expected,
                f"calls were made so often: {counts}, not {expected}",
                "make each call that is submitted once, and remember no answers (in dask: pure=False)",
            )

    def test_what_fails_is_not_tried_again(self) -> None:
        with TemporaryDirectory() as folder, self.opened() as executor:
            self.error(executor.submit(marked_failure, folder))
            demand(
                marks(folder) == {"failed": 1},
                f"a call that raises was made {marks(folder).get('failed', 0)} times",
                "make it once: whoever submits decides whether to try again (in dask: retries=0)",
            )

    def test_arguments_and_answers_arrive_as_they_are(self) -> None:
        numbers = np.array([0.1, -0.0, np.nan, -np.inf, 5e-324, 1.0 + 2.0**-52])
        mend = "send arguments, keywords and answers by pickle, which keeps every bit"
        with self.opened() as executor:
            array = self.answer(executor.submit(echo, numbers))
            demand(np.asarray(array).tobytes() == numbers.tobytes(), f"{numbers} came back as {array}", mend)
            answer = self.answer(executor.submit(echo, {"a": (1, "b", None)}, again=[2]))
            demand(answer == ({"a": (1, "b", None)}, [2]), f"what came back was {answer!r}", mend)
            products = np.random.default_rng(0).random((3, 40, 40))
            remote = [self.answer(executor.submit(product, matrix)) for matrix in products]
            demand(
                [matrix.tobytes() for matrix in remote] == [product(matrix).tobytes() for matrix in products],
                "a product of matrices has other digits there than here",
                f"{mend}; give linear algebra one thread, see `test_linear_algebra_has_one_thread`",
            )

    def test_an_error_arrives_with_its_type_its_words_and_where_it_was_raised(self) -> None:
        mend = "pass the exception itself to `Future.set_exception`, from another process with its traceback as cause"
        with self.opened() as executor:
            futures = [executor.submit(fails if k == 1 else echo, f"call {k}") for k in range(4)]
            error = self.error(futures[1])
            text = named(error)
            demand(type(error) is ArithmeticError, f"an ArithmeticError arrived as a {type(error).__name__}", mend)
            demand(text == "ArithmeticError: call 1 has no answer", f"the error arrived as: {text}", mend)
            demand("in fails" in "".join(traceback.format_exception(error)), "the traceback is lost", mend)
            answers = [self.answer(futures[k]) for k in (0, 2, 3)]
            demand(answers == ["call 0", "call 2", "call 3"], "an error has harmed other calls", mend)
            text = named(self.error(executor.submit(refuses)))
            demand(
                text == "InputError: horizon: expected a number, got None", f"an InputError arrived as: {text}", mend
            )

    def test_an_error_that_cannot_be_sent_arrives_in_its_words(self) -> None:
        mend = "try in the worker whether the exception can be pickled; if not, send its text in a RuntimeError"
        with self.opened() as executor:
            text = "".join(traceback.format_exception(self.error(executor.submit(fails_oddly))))
            demand("it is odd" in text, f"an error that cannot be pickled arrived as: {text}", mend)
            demand(self.answer(executor.submit(echo, 1)) == 1, "it has ended the workers", mend)

    def test_what_cannot_be_sent_is_named_and_harms_nothing_else(self) -> None:
        mend = "pickle the call in `submit`, and the answer in the worker, and pass on what that raises"
        with self.opened() as executor:
            for future in (executor.submit(echo, _make_unsendable()), executor.submit(_make_unsendable)):
                error = self.outcome(future)
                if error is None:  # it can be sent after all
                    demand(future.result()(3) == 3, "a function has come back as another one", mend)
                else:
                    demand(not isinstance(error, BrokenExecutor), "what cannot be sent has ended the workers", mend)
                    demand("_make_unsendable" in str(error), f"it is not named: {named(error)}", mend)
            if self.isolated:
                text = named(self.error(executor.submit(echo, threading.Lock())))
                demand("lock" in text, f"a lock cannot be sent, and that is told as: {text}", mend)
            demand(self.answer(executor.submit(echo, 1)) == 1, "what cannot be sent has ended the workers", mend)

    def test_who_waits_is_told_once(self) -> None:
        notified: list[Future[Any]] = []
        mend = "give a future its answer once, by `set_result` or `set_exception` of `concurrent.futures.Future`"
        with self.opened() as executor:
            futures = [executor.submit(echo, k) for k in range(3)] + [executor.submit(fails, "it")]
            for future in futures:
                future.add_done_callback(notified.append)
            demand(not wait(futures, self.patience).not_done, "a future is never done", mend)
        demand(
            sorted(map(id, notified)) == sorted(map(id, futures)),
            f"{len(futures)} futures have told those who wait {len(notified)} times",
            mend,
        )

    def test_what_is_cancelled_is_not_called_and_what_is_not_has_its_answer(self) -> None:
        mend = "call `Future.set_running_or_notify_cancel` when a call begins, and leave it out where that is false"
        with TemporaryDirectory() as folder:
            with self.opened() as executor:
                futures = [executor.submit(mark, folder, f"{k}", CALL_SECONDS) for k in range(CALLS)]
                cancelled = [future.cancel() for future in reversed(futures)][::-1]
                for k, future in enumerate(futures):
                    if cancelled[k]:
                        demand(
                            future.cancelled() and isinstance(self.error(future), CancelledError),
                            "a future that was cancelled has an answer",
                            mend,
                        )
                    else:
                        demand(
                            self.answer(future) == f"{k}", "a future that was not cancelled has another answer", mend
                        )
            called = {name for name in marks(folder) if cancelled[int(name)]}
            demand(not called, f"{len(called)} calls that were cancelled were made all the same", mend)

    def test_the_end_waits_for_what_was_submitted(self) -> None:
        mend = "let `open` end with `shutdown(wait=True)`; drop nothing unless the context ends by an exception"
        with TemporaryDirectory() as folder:
            with self.opened() as executor:
                futures = [executor.submit(mark, folder, f"{k}", CALL_SECONDS) for k in range(CALLS)]
            demand(all(future.done() for future in futures), "the context ended before its calls", mend)
            demand(not any(future.cancelled() for future in futures), "the end has cancelled calls", mend)
            answers = [future.result(0) for future in futures]
            demand(answers == [f"{k}" for k in range(CALLS)], f"calls gave {answers} at the end", mend)
            demand(len(marks(folder)) == CALLS, f"{len(marks(folder))} of {CALLS} calls were made", mend)

    def test_nothing_can_be_submitted_after_the_end(self) -> None:
        with self.opened() as executor:
            pass
        try:
            executor.submit(echo, 1)
        except RuntimeError:
            return
        broken("a call was accepted after the end", "let `submit` raise a RuntimeError after `shutdown`")

    def test_an_error_of_the_caller_passes_and_abandons_what_is_running(self) -> None:
        futures, start, passed = list[Future[Any]](), time.monotonic(), ""
        try:
            with self.opened() as executor:
                self.answer(executor.submit(echo, 1))
                if self.isolated:
                    futures += [executor.submit(late, k, self.long) for k in range(4)]
                start = time.monotonic()
                raise KeyboardInterrupt("the caller's")
        except KeyboardInterrupt as error:
            passed = str(error)
        demand(passed == "the caller's", "the caller's error was swallowed", "raise in `open` what is raised inside it")
        mend = "where `open` ends by an exception, cancel what waits, and end the workers at once"
        seconds = time.monotonic() - start
        demand(seconds < min(self.patience, self.long), f"the end took {seconds:.0f} s: calls nobody waits for", mend)
        demand(all(future.done() for future in futures), "who waits for a call that was abandoned waits for ever", mend)

    def test_it_can_be_opened_again_and_leaves_no_thread(self) -> None:
        factory, before = self.create(), set(threading.enumerate())
        for k in range(2):
            try:
                with factory.open() as executor:
                    demand(self.answer(executor.submit(echo, k)) == k, "an answer is wrong", "see the other tests")
            except RuntimeError as error:
                broken(f"opened {k + 1} times it says: {named(error)}", "make the workers in `open`, anew each time")
        ends = time.monotonic() + min(self.patience, 5.0)
        while (new_threads := set(threading.enumerate()) - before) and time.monotonic() < ends:
            time.sleep(0.01)
        demand(
            not new_threads,
            f"still running after the end: {', '.join(thread.name for thread in new_threads)}",
            "start in `open` whatever runs, and end it there",
        )

    def test_linear_algebra_has_one_thread(self) -> None:
        """Many add up in another order; answers would depend on the executor."""
        with self.opened() as executor:
            pools = self.answer(executor.submit(threads))
        demand(
            pools and set(pools) == {1},
            f"libraries of linear algebra have so many threads: {pools}",
            "start the workers within `sparserob_core.one_thread()`, and leave it when they have ended; elsewhere, set "
            "OMP_NUM_THREADS=1 and OPENBLAS_NUM_THREADS=1 before they import numpy",
        )

    def test_a_worker_that_dies_breaks_the_executor_and_hangs_nobody(self) -> None:
        if not self.isolated:
            return
        mend = "watch the workers; where one ends, give the futures of its calls a `concurrent.futures.BrokenExecutor`"
        with self.opened() as executor:
            error = self.error(executor.submit(dies))
            demand(isinstance(error, BrokenExecutor), f"a worker that dies is told as: {named(error)}", mend)
        with self.opened() as executor:
            demand(self.answer(executor.submit(echo, 1)) == 1, "it cannot be opened again after that", mend)

    def test_workers_leave_an_interrupt_to_the_caller(self) -> None:
        if not self.isolated:
            return
        with self.opened() as executor:
            error = self.outcome(executor.submit(interrupts_itself))
            demand(
                error is None,
                f"Ctrl-C in the terminal reaches a worker, too: {error}",
                "ignore SIGINT in the workers; the caller decides what an interrupt ends",
            )

    def answer(self, future: Future[Any]) -> Any:
        """Return the result of a call, or raise its error."""
        error = self.outcome(future)
        if error is not None:
            raise error
        return future.result()

    def error(self, future: Future[Any]) -> BaseException:
        """Return the exception of a call, or its cancellation; the contract is broken where there is none."""
        error = self.outcome(future)
        if error is None:
            broken("an error was swallowed", "pass what a call raises to `Future.set_exception`")
        return error

    def outcome(self, future: Future[Any]) -> BaseException | None:
        """Return the exception of a call, its cancellation, or ``None``; the contract is broken where the call does not
        end."""
        try:
            return future.exception(self.patience)
        except CancelledError as cancelled:
            return cancelled
        except TimeoutError:
            broken(
                f"a future was not done after {self.patience:g} s",
                "give every future that `submit` returns its answer, its error or its cancellation",
            )


def echo(value: Any, **more: Any) -> Any:
    """Return the argument, or all arguments as a tuple."""
    return (value, *more.values()) if more else value


def late(value: int, seconds: float) -> int:
    """Return the first argument after a delay of ``seconds``."""
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
    """Return how often each name was marked in a folder."""
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


def _make_unsendable() -> Callable[[int], int]:
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
    """Send this process the signal that Ctrl-C in a terminal sends to a worker."""
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(2 * CALL_SECONDS)
    return "still here"
