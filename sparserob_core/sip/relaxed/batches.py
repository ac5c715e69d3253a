"""``g`` at many tuples, here or on workers, to the same last bit.

A relaxed program starts from the solution of the one before, so a value depends, within the solver's accuracy, on what
was evaluated before it. A long batch is therefore cut into chunks of `CHUNK_TUPLES` tuples, each begun from nothing:
what a chunk gives depends on nothing but its tuples, and not on where, when or beside what it is evaluated.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Dual
from sparserob_core.sip.limits.deadline import Deadline, OutOfTime
from sparserob_core.sip.method import Rebuild
from sparserob_core.sip.relaxed.relaxed import Imposed, RelaxedProgram
from sparserob_core.sip.relaxed.tuples import TupleValue, imposed_program
from sparserob_core.sip.solver import Unanswered

CHUNK_TUPLES = 16
"""Tuples that are evaluated one after the other from nothing."""
MIN_CHUNKED_TUPLES = 2 * CHUNK_TUPLES
"""Tuples of a batch that is cut into chunks; in a shorter one each starts from the one before, which is quicker."""
MIN_SECONDS_FOR_WORKERS = 0.1
"""Seconds of work that a batch must have left to be sent to workers."""
START = 5.0
"""Seconds of work that a search must have left for workers to be started, who build the program anew."""


@dataclass(frozen=True, eq=False)
class Valued:
    """Values of ``g`` at a chunk of tuples, with the bounds and the account of the solver.

    ``values (k,)``: the value at each tuple. ``duals``: the lower bound from the multipliers of each tuple whose value
    was the best so far in its chunk, by the place of the tuple. ``solves``: programs that were solved; ``calls``: calls
    of the solver; ``solved_by``: how many each solver solved; ``unanswered``: what the named solver did not answer.
    ``imposed``: the rows that each value rests on, with their multipliers. ``late``: the reason why the time was over,
    if it was.
    """

    values: Array
    duals: dict[int, Dual]
    solves: int
    calls: int
    solved_by: Mapping[str, int] = field(default_factory=dict)
    unanswered: Sequence[Unanswered] = ()
    late: str = ""
    imposed: Sequence[Imposed] = ()


def evaluate_chunk(g: TupleValue, points: Array, best: float) -> Valued:
    """Evaluate a chunk ``(k, D width)`` from nothing; ``best``: the best value before its batch, below which no bound
    is of use."""
    g.forget()
    relaxed, duals = g.relaxed, dict[int, Dual]()
    solves, calls, earlier = relaxed.solves, relaxed.counted.calls, Counter(relaxed.solved_by)
    failures = tuple(relaxed.counted.failures)
    values, imposed = np.empty(len(points)), list[Imposed]()
    for k, point in enumerate(points):
        values[k] = g.at(point)
        imposed.append(replace(g.imposed, solution=None))
        if np.isfinite(values[k]) and values[k] > best:
            best = float(values[k])
            duals[k] = relaxed.lower_bound(g.rows(), g.solution)
    by = relaxed.solved_by - earlier
    calls, failures = relaxed.counted.calls - calls, relaxed.counted.failures.since(failures)
    return Valued(values, duals, relaxed.solves - solves, calls, dict(by), failures, imposed=imposed)


@dataclass(frozen=True)
class Oracle:
    """Recipe by which a worker makes ``g`` anew.

    ``rebuild`` makes the program and its components; ``g`` is over tuples of ``count`` indices in a ``formulation``.
    Equal oracles give equal values, and a worker keeps the ``g`` that it made last.
    """

    rebuild: Rebuild
    formulation: Literal["reduced", "literal"]
    count: int

    def build(self) -> TupleValue:
        """A new ``g``."""
        program, solver, regulariser = self.rebuild()
        imposed = imposed_program(program, self.formulation)
        relaxed = RelaxedProgram(imposed, solver, regulariser)
        relaxed.counted.failures.without_log()  # whoever sent the work goes on with the account, and tells it
        return TupleValue(imposed, relaxed, self.count)


class _WorkerState(threading.local):
    """The ``g`` that a worker made last, one for each thread, as every evaluation changes it."""

    oracle: Oracle | None = None
    g: TupleValue | None = None


_worker_state = _WorkerState()


def evaluate_on_worker(oracle: Oracle, points: Array, epsilon: float, best: float, seconds: float | None) -> Valued:
    """`evaluate_chunk` in a worker, who has ``seconds`` for it."""
    if _worker_state.oracle != oracle or _worker_state.g is None:
        _worker_state.oracle, _worker_state.g = oracle, oracle.build()
    g = _worker_state.g
    g.epsilon, g.relaxed.deadline = epsilon, Deadline(seconds)
    try:
        return evaluate_chunk(g, points, best)
    except OutOfTime as over:
        return Valued(np.empty(0), {}, 0, 0, late=str(over))


class Batches:
    """The values of ``g`` at batches of tuples: short ones one after the other, long ones in chunks, on the workers of
    ``executor`` where there are some and the work is worth it.

    ``budget``: evaluations that one search may still make, from which the work that is left is guessed. A worker that
    fails costs nothing but its help: its chunks are evaluated here. ``watched``: what each value rests on is kept, to
    be `taken`.
    """

    def __init__(
        self, g: TupleValue, oracle: Oracle | None, executor: Executor | None, budget: int, watched: bool = False
    ) -> None:
        self.g, self.oracle, self.executor, self.budget, self.watched = g, oracle, executor, budget, watched
        self.sent, self.imposed = 0, list[Imposed]()
        self._best, self._has_started = -np.inf, False

    def values(self, points: Array, tell: Callable[[float, Dual | None], None]) -> Array:
        """``g`` at points ``(k, D width)``; ``tell`` is told each value in order, with the lower bound that its
        multipliers prove where it is the best one so far."""
        if len(points) < MIN_CHUNKED_TUPLES:
            return np.concatenate([self._report_values(self._evaluate_next(point), tell) for point in points])
        best = self._best
        chunks = [points[first : first + CHUNK_TUPLES] for first in range(0, len(points), CHUNK_TUPLES)]
        start = time.perf_counter()
        values = [self._report_values(evaluate_chunk(self.g, chunks[0], best), tell)]
        seconds = time.perf_counter() - start
        if self._is_worth_sending(seconds, len(chunks) - 1, len(points)):
            values += [self._report_values(valued, tell) for valued in self._evaluate_on_workers(chunks[1:], best)]
        else:
            values += [self._report_values(evaluate_chunk(self.g, chunk, best), tell) for chunk in chunks[1:]]
        self.g.forget(points[-1])
        return np.concatenate(values)

    def _evaluate_next(self, point: Array) -> Valued:
        """Evaluate ``g`` at one point, from the solution of the point before."""
        value = self.g.at(point)
        better = np.isfinite(value) and value > self._best
        bound = self.g.relaxed.lower_bound(self.g.rows(), self.g.solution) if better else None
        imposed = [replace(self.g.imposed, solution=None)] if self.watched else []
        return Valued(np.array([value]), {} if bound is None else {0: bound}, 0, 0, imposed=imposed)

    def taken(self, count: int) -> list[Imposed]:
        """The rows that the first ``count`` tuples rest on, of those that were not yet taken."""
        first, self.imposed = self.imposed[:count], self.imposed[count:]
        return first

    def _report_values(self, chunk: Valued, tell: Callable[[float, Dual | None], None]) -> Array:
        if self.watched:
            self.imposed += chunk.imposed
        for k, value in enumerate(chunk.values):
            better = np.isfinite(value) and value > self._best
            if better:
                self._best = float(value)
            tell(float(value), chunk.duals[k] if better else None)
        return chunk.values

    def _is_worth_sending(self, seconds: float, chunks: int, points: int) -> bool:
        """Return whether the chunks are to be sent to workers, when one chunk took ``seconds``; charge the ``points``
        to the budget."""
        self.budget -= points
        if self.executor is None or self.oracle is None or seconds * chunks < MIN_SECONDS_FOR_WORKERS:
            return False
        self._has_started = self._has_started or seconds * (chunks + max(self.budget, 0) / CHUNK_TUPLES) >= START
        return self._has_started

    def _evaluate_on_workers(self, chunks: Sequence[Array], best: float) -> Sequence[Valued]:
        g, seconds = self.g, self.g.relaxed.deadline.left
        assert self.executor is not None
        assert self.oracle is not None
        valued_chunks, futures = list[Valued](), list[Future[Valued]]()
        try:
            for chunk in chunks:
                futures.append(self.executor.submit(evaluate_on_worker, self.oracle, chunk, g.epsilon, best, seconds))
            for chunk, future in zip(chunks, futures, strict=True):
                valued = future.result()
                if valued.late:
                    raise OutOfTime(g.relaxed.deadline.reason or valued.late)
                self.sent += len(chunk)
                g.relaxed.solves += valued.solves
                g.relaxed.counted.calls += valued.calls
                g.relaxed.counted.failures.calls += valued.calls
                g.relaxed.solved_by.update(valued.solved_by)
                for failure in valued.unanswered:
                    g.relaxed.counted.failures.add(failure.kind, failure.reason, failure.by, failure.count)
                valued_chunks.append(valued)
        except Exception:  # noqa: BLE001  whatever it was: what is missing is done here, or raised here
            self.executor = None
        finally:
            for future in futures:
                future.cancel()
        return [*valued_chunks, *(evaluate_chunk(g, chunk, best) for chunk in chunks[len(valued_chunks) :])]
