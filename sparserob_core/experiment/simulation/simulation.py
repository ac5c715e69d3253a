"""What a simulation of a finished run found: one record per constraint, and the words that go with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.sip.convex_set import Array

CONFIDENCE = 0.95
PROVEN = frozenset({"certified", "verified"})
ADVERSARY = "adversary"
ANY = "any of them"
LAWS = {
    "iid": "uniform in the set, independent on every piece",
    "vertices": "random extreme points of the set, independent on every piece",
    "slow": "linear between a few random extreme points of the set",
    "neighbours": "worst cases of random times and constraints, a few pieces of them changed",
    ADVERSARY: "the worst case of every constraint, replayed",
}


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ConstraintShare:
    """One constraint: how many of the trajectories violate it by more than ``tolerance``, and the interval
    ``[lower, upper]`` that holds the probability of it under the law with confidence `CONFIDENCE` (Clopper and Pearson
    1934).

    ``largest`` is the largest violation seen (negative: a margin), at ``time``; ``worst`` is the largest that any
    admissible disturbance and parameter was found to cause, at ``worst_time`` and ``worst_parameter (nu,)``: nan where
    nothing is known. ``unit``: of the violations, ``m or m/s`` where rows differ; ``time_unit``: of the times.
    """

    name: str
    violated: int
    trajectories: int
    lower: float
    upper: float
    tolerance: float
    largest: float
    time: float
    worst: float
    worst_time: float
    worst_parameter: Sequence[float]
    unit: str = ""
    time_unit: str = ""

    __repr__ = brief

    @property
    def share(self) -> float:
        """The share of the trajectories that violate it."""
        return self.violated / self.trajectories


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Simulation:
    """Sampled trajectories of a finished run. A sample proves nothing.

    ``constraints`` in the order of the program's families, and ``any_violated`` for all of them together. Every
    trajectory was looked at at ``times`` instants, at least ``inside`` of them inside every piece. ``shown (S,)`` are
    times for drawing, ``fan (n, d, S)`` the first few trajectories there, ``lower``, ``upper (d, S)`` the envelope of
    all. For the law ``adversary`` a trajectory is the worst case of one constraint, and ``largest`` is what the replay
    attains.
    """

    title: str
    directory: Path
    status: str
    law: str
    trajectories: int
    seed: int
    times: int
    inside: int
    constraints: Sequence[ConstraintShare]
    any_violated: ConstraintShare | None
    shown: Array = field(repr=False)
    fan: Array = field(repr=False)
    lower: Array = field(repr=False)
    upper: Array = field(repr=False)
    seconds: float
    undrawn: str = ""

    __repr__ = brief
    """Why there is no figure, where one was asked for."""

    @property
    def contradicts(self) -> bool:
        """Whether a trajectory does what the run claims to have proven impossible, or is worse than the worst case that
        was found."""
        worse = any(one.largest > one.worst + one.tolerance for one in self.constraints if np.isfinite(one.worst))
        return worse or (self.status in PROVEN and any(one.violated for one in self.constraints))

    def summary(self) -> dict[str, Any]:
        """What ``simulation-<law>.json`` holds."""
        rows = [*self.constraints, *([] if self.any_violated is None else [self.any_violated])]
        return {
            "title": self.title,
            "law": self.law,
            "meaning": LAWS[self.law],
            "trajectories": self.trajectories,
            "seed": self.seed,
            "confidence": CONFIDENCE,
            "times": self.times,
            "times_inside_a_piece": self.inside,
            "status": self.status,
            "constraints": [{**vars(one), "share": one.share} for one in rows],
            "contradicts": self.contradicts,
            "remarks": list(self.remarks()),
            "seconds": self.seconds,
        }

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per constraint."""
        if self.law == ADVERSARY:
            names = ["constraint", "time", "parameter", "predicted violation", "attained", "difference"]
            return names, [
                [
                    one.name,
                    _number(one.worst_time, ".6g", one.time_unit),
                    _vector(one.worst_parameter),
                    _number(one.worst, ".6e", one.unit),
                    _number(one.largest, ".6e", one.unit),
                    f"{one.largest - one.worst:.1e}",
                ]
                for one in self.constraints
            ]
        names = [
            "constraint",
            "violated by",
            "share",
            f"{CONFIDENCE:.0%} interval of it",
            "largest violation seen",
            "worst case",
            "at",
        ]
        rows = [*self.constraints, *([] if self.any_violated is None else [self.any_violated])]
        return names, [
            [
                one.name,
                str(one.violated),
                _percent(one.share),
                f"{_percent(one.lower)} to {_percent(one.upper)}",
                _violation(one),
                _number(one.worst, ".3e", one.unit),
                _number(one.worst_time, ".6g", one.time_unit),
            ]
            for one in rows
        ]

    def remarks(self) -> Iterator[str]:
        """What is to be said beside the table: what a sample is worth, and what is proven."""
        if self.law == ADVERSARY:
            yield (
                "each row is one trajectory: the worst disturbance, parameter and initial state of that constraint,"
                " propagated exactly"
            )
        else:
            yield (
                f"this is no proof: what {self.trajectories} random trajectories did not do may still happen, "
                f"and the intervals are about this law only ({LAWS[self.law]})"
            )
            yield (
                f"every trajectory was looked at at {self.times} times, at least {self.inside} of them inside every"
                " piece, not between them"
            )
        worst = max(self.constraints, key=lambda one: one.worst, default=None)
        if self.contradicts:
            yield (
                "a trajectory contradicts the run: it violates what is proven, or it is worse than the worst case"
                " found; one of the two is wrong"
            )
        elif self.status in PROVEN:
            yield (
                f"the run proves what no sample can (status {self.status}): no admissible disturbance, parameter and"
                " initial state violates a constraint"
            )
        else:
            yield (
                f"the run proves nothing of its constraints (status {self.status}): the worst case found is a violation"
                f" of {'nothing' if worst is None else _number(worst.worst, '.3g', worst.unit)}"
            )
        if self.undrawn:
            yield self.undrawn


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """The exact interval of a probability from ``successes`` in ``trials`` independent trials (Clopper and Pearson
    1934): quantiles of beta distributions, each tail at most ``(1 - confidence) / 2``."""
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2
    lower = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, tail))
    upper = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 1.0 - tail))
    return lower, upper


def _percent(share: float) -> str:
    return f"{100 * share:.4g} %"


def _number(value: float, form: str, unit: str) -> str:
    return f"{value:{form}} {unit}".rstrip() if np.isfinite(value) else "-"


def _violation(one: ConstraintShare) -> str:
    seen = f"{one.largest:.3e} {one.unit}".rstrip()
    return f"{seen} at t = {_number(one.time, '.6g', one.time_unit)}" if np.isfinite(one.time) else seen


def _vector(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values) + ")" if len(values) else "-"
