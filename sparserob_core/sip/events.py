"""What the optimisation wing tells while it works; whoever listens cannot disturb it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias


@dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened in a run."""


Notify: TypeAlias = Callable[[Event], None]


def silence(event: Event) -> None:
    """The listener that hears nothing."""


@dataclass(frozen=True, kw_only=True)
class RoundFinished(Event):
    """One round of a method is over.

    ``lower_bound`` and ``upper_bound`` enclose the value of the unregularised program (``-inf``, ``inf`` while unknown);
    ``violation`` is the worst constraint violation of this round's decision over the continuum, reached in ``worst_family``;
    ``active_indices`` are the rows kept, ``cuts_added`` and ``cuts_dropped`` the change; ``seconds`` since the start.
    """

    round: int
    epsilon: float
    lower_bound: float
    upper_bound: float
    violation: float
    worst_family: str = ""
    active_indices: int = 0
    cuts_added: int = 0
    cuts_dropped: int = 0
    relaxed_programs: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ProofProgress(Event):
    """A proof over the continuum goes on: ``cells`` of ``family`` are still open, ``bound`` is the violation not yet excluded."""

    family: str
    cells: int
    bound: float
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class EvaluationsFinished(Event):
    """A maximiser has evaluated ``count`` more points, ``total`` so far; ``notes`` are its own scalars (temperature, ...)."""

    count: int
    total: int
    best_value: float
    seconds: float = 0.0
    notes: Mapping[str, float] = field(default_factory=dict)
