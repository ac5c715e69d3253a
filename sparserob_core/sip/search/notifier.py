"""Events of one search: an event from time to time, not one for every evaluation."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import SKETCHED, Batch, EvaluationsFinished, Notify, Phase, Sketch, frozen

SECONDS_BETWEEN_EVENTS = 0.05
MIN_EVENTS = 20  # least number of events of one search that evaluates its points one after the other
NUMBERS_BETWEEN_EVENTS = 2**21  # largest number of coordinates that wait for the next event


@final
@dataclass(frozen=True, eq=False)
class Standing:
    """State of a search.

    Parameters
    ----------
    evaluations : int
        Number of evaluations so far.
    budget : int
        Evaluations that the search may spend.
    best_value : float
        Largest value so far.
    best_point : ndarray, shape (d,)
        Point of that value.
    block : int
        Number of coordinates of one index.
    phase : {"search", "polish"}
        Who evaluates.
    """

    evaluations: int
    budget: int
    best_value: float
    best_point: Array
    block: int
    phase: Phase = "search"


@final
class Notifier:
    """Collector of the points for which no event was sent yet, without copies, and of the current point of the
    search."""

    def __init__(self, notify: Notify, domain: Box) -> None:
        self.notify, self.domain = notify, Box(frozen(domain.lower), frozen(domain.upper))
        self.started = self.notified_at = time.monotonic()
        self.notified, self.numbers, self.best = 0, 0, -np.inf
        self.points: list[Array] = []
        self.values: list[Array] = []
        self.moments: list[tuple[int, float]] = []
        self._note_counts: dict[str, int] = {}
        self._sketches: dict[str, Sketch] = {}
        self._origin: tuple[Array | None, float] = (None, np.nan)
        self._last_point: tuple[Array | None, float] = (None, np.nan)
        self._accepted_point: tuple[Array, float] | None = None

    def due(self, evaluations: int, budget: int) -> bool:
        """Return whether an event is due: by the clock, after a share of the budget, or because many numbers wait.

        Parameters
        ----------
        evaluations : int
            Number of evaluations so far.
        budget : int
            Evaluations that the search may spend.

        Returns
        -------
        bool
            True where an event is due.
        """
        return (
            time.monotonic() - self.notified_at > SECONDS_BETWEEN_EVENTS
            or evaluations - self.notified >= max(1, budget // MIN_EVENTS)
            or self.numbers > NUMBERS_BETWEEN_EVENTS
        )

    def add(self, points: Array, values: Array, moment: float) -> None:
        """Collect points ``(k, d)`` and their values ``(k,)``, known ``moment`` seconds after the search began."""
        self.points.append(points)
        self.values.append(values)
        self.moments.append((values.size, moment))
        self.numbers += points.size
        self._last_point = points[-1], float(values[-1])

    def note(self, scalars: Mapping[str, float]) -> None:
        """Make the last point the current point of the search, where the maximiser notes that it has accepted it."""
        if scalars.get("accepted") and self._last_point[0] is not None:
            self._accepted_point = self._last_point[0], self._last_point[1]

    def sketch(self, role: str, lower: Array, upper: Array | None, rounded: bool) -> None:
        """Keep a sketch for the next event; only the last sketch of a role is sent."""
        low = frozen(np.array(lower[:SKETCHED], dtype=float))
        high = low if upper is None else frozen(np.array(upper[:SKETCHED], dtype=float))
        self._sketches[str(role)] = Sketch(low, high, rounded)

    def publish(self, standing: Standing, notes: Mapping[str, Sequence[tuple[float, float]]]) -> None:
        """Send one event for all points that were collected.

        Parameters
        ----------
        standing : Standing
            State of the search.
        notes : mapping of str to sequence of (float, float)
            Notes of the whole search: pairs (evaluations so far, value) for each name.
        """
        fresh = {
            name: rows[self._note_counts.get(name, 0) :]
            for name, rows in notes.items()
            if len(rows) > self._note_counts.get(name, 0)
        }
        batch = Batch(self.points, self.values, self.moments, fresh, self.notified, self.best, *self._origin)
        count, self.notified, self.notified_at = (
            standing.evaluations - self.notified,
            standing.evaluations,
            time.monotonic(),
        )
        event = EvaluationsFinished(
            count=count,
            total=standing.evaluations,
            best_value=standing.best_value,
            seconds=self.notified_at - self.started,
            notes={name: rows[-1][1] for name, rows in notes.items()},
            budget=standing.budget,
            best_point=frozen(standing.best_point),
            domain=self.domain,
            block=standing.block,
            phase=standing.phase,
            batch=batch,
            sketches=self._sketches,
        )
        self._sketches = {}
        self.points, self.values, self.moments, self.numbers, self.best = [], [], [], 0, standing.best_value
        self._note_counts = {name: len(rows) for name, rows in notes.items()}
        self._origin = self._last_point if self._accepted_point is None else self._accepted_point
        self.notify(event)
