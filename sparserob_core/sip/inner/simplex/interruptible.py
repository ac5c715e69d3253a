"""HiGHS, ended by an interrupt: Python hears of signals only where its own code goes on, and HiGHS may take minutes."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array, vstack

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.inner.simplex.silence import silent

if TYPE_CHECKING:
    from scipy.optimize import LinearConstraint

# Seconds that HiGHS has to end after it was asked to, for which it looks once an iteration. Without any it would go on
# beside what is done with the answer; with ten times as many a presolve, which does not look, keeps a terminal waiting.
HIGHS_GRACE_SECONDS = 0.5
# Seconds after which a signal is heard that another thread has caught. With a tenth of them this thread takes a
# noticeable share of the processor; ten times as many are a second.
LOOK = 0.1


def run(highs: Any) -> None:
    """Solve what a `highspy.Highs` holds. In the main thread a `KeyboardInterrupt`, by a key, a signal or an alarm,
    ends it; where it does not look for that in time, only the end of the process waits for it."""
    if threading.current_thread() is not threading.main_thread():
        # In a new thread all the same: that of the caller may have a scheduler with another number of threads.
        thread = threading.Thread(target=highs.run, daemon=True)
        thread.start()
        thread.join()
        return
    stop, finished = threading.Event(), threading.Event()

    def asked(event: Any) -> None:
        if event.data_in is not None:
            event.data_in.user_interrupt = stop.is_set()  # said anew: HiGHS keeps what an earlier solution was told

    def solve() -> None:
        try:
            highs.run()
        finally:
            finished.set()

    highs.cbSimplexInterrupt += asked
    highs.cbIpmInterrupt += asked
    highs.cbMipInterrupt += asked
    try:
        threading.Thread(target=solve, daemon=True).start()
        while not finished.wait(LOOK):  # a signal that another thread catches does not wake this one
            pass
    except KeyboardInterrupt:
        stop.set()
        if not finished.wait(HIGHS_GRACE_SECONDS):
            atexit.register(finished.wait)  # a thread that asks for the interpreter after its end aborts the process
        raise
    finally:
        if finished.is_set():  # else they are what ends it; the next solution must not hear of this interrupt
            highs.cbSimplexInterrupt -= asked
            highs.cbIpmInterrupt -= asked
            highs.cbMipInterrupt -= asked


def solve_with_integers(
    cost: Array,
    couplings: Sequence[LinearConstraint],
    lower: Array,
    upper: Array,
    continuous: int,
    seconds: float,
    gap: float,
) -> Array | None:
    """Return a point ``(n,)`` of least ``cost (n,)`` up to a relative ``gap``, of which all entries but the first so
    many are whole numbers; the best that is known after ``seconds``, ``None`` where none is."""
    import highspy

    table = csr_array(vstack([csr_array(coupling.A) for coupling in couplings]))
    sides = [
        np.concatenate(
            [np.broadcast_to(side, coupling.A.shape[0]) for side, coupling in zip(limits, couplings, strict=True)]
        )
        for limits in ([coupling.lb for coupling in couplings], [coupling.ub for coupling in couplings])
    ]
    none, integers = np.zeros(0, dtype=np.int32), np.arange(continuous, cost.size, dtype=np.int32)
    with silent():
        highs: Any = highspy.Highs()
        for name, value in (("output_flag", False), ("threads", 1), ("time_limit", seconds), ("mip_rel_gap", gap)):
            highs.setOptionValue(name, value)
        highs.addCols(cost.size, cost, lower, upper, 0, np.zeros(cost.size, dtype=np.int32), none, np.zeros(0))
        starts, places = table.indptr[:-1].astype(np.int32), table.indices.astype(np.int32)
        highs.addRows(table.shape[0], *sides, table.nnz, starts, places, table.data)
        highs.changeColsIntegrality(integers.size, integers, np.full(integers.size, highspy.HighsVarType.kInteger))
        run(highs)
    if highs.getInfo().primal_solution_status != int(highspy.SolutionStatus.kSolutionStatusFeasible):
        return None
    return np.array(highs.getSolution().col_value)
