"""Position of a run on the three timelines of a recording: ``evaluation``, ``round`` and ``time``."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from sparserob_rerun.drawing.palette import Floats


@final
class Timelines:
    """Timelines of a run: evaluations of ``g`` so far (relaxed programs, for a method that does not search), the round,
    and the seconds since the start."""

    def __init__(self, rr: Any, stream: Any) -> None:
        self.rr, self.stream = rr, stream
        self.evaluation, self.round, self.seconds = 0, 0, 0.0

    def move(self, evaluation: int | None = None, number: int | None = None, seconds: float | None = None) -> None:
        """Move the timelines forward, never back; later rows are logged at the new position."""
        self.evaluation = max(self.evaluation, evaluation or 0)
        self.round = max(self.round, number or 0)
        self.seconds = max(self.seconds, seconds or 0.0)
        self.stream.set_time("evaluation", sequence=self.evaluation)
        self.stream.set_time("round", sequence=self.round)
        self.stream.set_time("time", duration=self.seconds)

    def columns(self, evaluations: np.ndarray, seconds: Floats, number: int) -> list[Any]:
        """Return the timelines of rows, one for each of the evaluations ``(k,)`` at these seconds ``(k,)`` of the run,
        all in one round."""
        rr = self.rr
        rounds = np.full(evaluations.size, max(number, self.round))
        return [
            rr.TimeColumn("evaluation", sequence=evaluations),
            rr.TimeColumn("round", sequence=rounds),
            rr.TimeColumn("time", duration=seconds),
        ]
