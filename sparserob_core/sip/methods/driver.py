"""The driver of every method that works in rounds: one step after the other, until one of them has the result.

A method makes what it begins with (`init`), its ``step`` does a round and passes on what it has learned, and ends where
it has come to a result; what is known where the time is over or a key is pressed is its ``stopped``.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

from sparserob_core.sip.limits.deadline import Deadline
from sparserob_core.sip.result import Result


def drive(
    deadline: Deadline, step: Callable[[int], Result | None], stopped: Callable[[KeyboardInterrupt], Result]
) -> Result:
    """The result of the first ``step`` (they are counted from 1) that has one, or what is known when the time is over.

    Between two steps nobody works past the ``deadline``; within one, `Deadline.enforced` ends what takes too long.
    """
    try:
        with deadline.enforced():
            for number in count(1):
                deadline.check()
                if (result := step(number)) is not None:
                    return result
    except KeyboardInterrupt as error:
        return stopped(error)
    raise AssertionError("steps are taken until one has a result")
