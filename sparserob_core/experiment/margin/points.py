"""The runs of a margin, reported as the points of a study that finds its points as it proceeds."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from sparserob_core.experiment.directory.artefacts import finite
from sparserob_core.experiment.run.events import PointProgress, StudyProgress, SweepProgress
from sparserob_core.experiment.sweep.point import Bounds
from sparserob_core.sip.events import Notify
from sparserob_core.sip.result import Status, relative_gap


@final
@dataclass(frozen=True)
class MarginPoint:
    """An ordinary run at one factor: its status, and the bounds of the cost, which are infinite where it is
    infeasible."""

    factor: float
    amount: float
    status: Status
    message: str
    lower_bound: float
    upper_bound: float


@final
class Points:
    """The reports of every run of a search over factors: its beginning, the changes of its bounds, and its answer.

    They are sent to ``notify``. ``rows`` has the answers by the number of the run.
    """

    def __init__(self, of: str, notify: Notify) -> None:
        self.of, self.notify = of, notify
        self.rows: dict[int, Mapping[str, Any]] = {}
        self.start_time, self.count = time.monotonic(), 0

    @property
    def seconds(self) -> float:
        """The seconds since the search began."""
        return time.monotonic() - self.start_time

    def say(self, text: str) -> None:
        """Report what is searched, in words."""
        self.notify(StudyProgress(text=text))

    def begin(self, factor: float) -> Notify:
        """Report the beginning of a run at a factor; returns the function that receives its events."""
        position, self.count = self.count, self.count + 1
        text = f"{self.of} at {factor:.9g} is run"
        self._report_progress(text, found=[(float(factor),)], now=[position], running=1)

        def report_bounds(number: int, lower: float, upper: float) -> None:
            self.notify(
                PointProgress(point=position, round=number, lower_bound=lower, upper_bound=upper, seconds=self.seconds)
            )

        return Bounds(report_bounds).receive

    def end(self, point: MarginPoint) -> None:
        """Report the answer of the run that began last."""
        position, proven = self.count - 1, np.isfinite(point.upper_bound)
        gap = relative_gap(point.lower_bound, point.upper_bound)
        answer = {"status": point.status, "message": point.message, "cost": point.upper_bound if proven else None}
        self.rows[position] = finite(
            {**answer, "lower_bound": point.lower_bound, "upper_bound": point.upper_bound, "gap": gap}
        )
        self._report_progress(
            f"{self.of} at {point.factor:.9g}: {point.status}", row=self.rows[position], places=[position]
        )

    def _report_progress(self, text: str, **more: Any) -> None:
        self.notify(
            SweepProgress(
                text=text, done=len(self.rows), total=self.count, seconds=self.seconds, axes=[self.of], **more
            )
        )
