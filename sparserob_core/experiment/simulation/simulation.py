"""The result of a simulation: one record per constraint, and the words for it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.sip.convex_set import Array

CONFIDENCE = 0.95  # of the interval of the probability of a violation
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
    """The violations of one constraint among simulated trajectories.

    Parameters
    ----------
    name : str
        The constraint.
    violated, trajectories : int
        The number of trajectories that violate it by more than ``tolerance``, and that of all trajectories.
    lower, upper : float
        The interval that contains the probability of a violation under the law, with confidence `CONFIDENCE` (Clopper
        and Pearson 1934).
    tolerance : float
        The largest violation that counts as none.
    largest, time : float
        The largest violation among the trajectories (negative: a margin), and its time.
    worst, worst_time : float
        The largest violation that any admissible disturbance and parameter was found to cause, and its time; nan where
        nothing is known.
    worst_parameter : sequence (nu,)
        Its parameter.
    unit : str, default ""
        The unit of violations, such as ``m or m/s`` where rows have different ones.
    time_unit : str, default ""
        The unit of times.
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
    """Sampled trajectories of a finished run; a sample proves nothing.

    For the law ``adversary`` each trajectory is the worst case of one constraint, and ``largest`` is the violation that
    the replay attains.

    Parameters
    ----------
    title : str
        The title of the run.
    directory : Path
        Its directory.
    status : str
        Its status.
    law : str
        The law of the uncertainty.
    trajectories, seed : int
        The number of trajectories, and the seed.
    times : int
        The number of times at which every trajectory was checked.
    inside : int
        The least number of these times within each piece, where there are fewer than 10 000 pieces.
    constraints : sequence of ConstraintShare
        The violations of each constraint, in the order of the program's families.
    any_violated : ConstraintShare or None
        The violations of all constraints together.
    shown : array (S,)
        The times of the figure.
    fan : array (n, d, S)
        The first few trajectories at these times.
    lower, upper : array (d, S)
        The envelope of all trajectories.
    seconds : float
        The seconds that the simulation has taken.
    undrawn : str, default ""
        The reason why there is no figure, where one was asked for.
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

    @property
    def contradicts(self) -> bool:
        """True where a trajectory contradicts a proof of the run, or is worse than the worst case that was found."""
        worse = any(
            share.largest > share.worst + share.tolerance for share in self.constraints if np.isfinite(share.worst)
        )
        return worse or (self.status in PROVEN and any(share.violated for share in self.constraints))

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``simulation-<law>.json``."""
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
            "constraints": [{**vars(share), "share": share.share} for share in rows],
            "contradicts": self.contradicts,
            "remarks": list(self.remarks()),
            "seconds": self.seconds,
        }

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return the names of the columns, and one row per constraint."""
        if self.law == ADVERSARY:
            names = ["constraint", "time", "parameter", "predicted violation", "attained", "difference"]
            return names, [
                [
                    share.name,
                    _format_number(share.worst_time, ".6g", share.time_unit),
                    _format_vector(share.worst_parameter),
                    _format_number(share.worst, ".6e", share.unit),
                    _format_number(share.largest, ".6e", share.unit),
                    f"{share.largest - share.worst:.1e}",
                ]
                for share in self.constraints
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
                share.name,
                str(share.violated),
                _format_percent(share.share),
                f"{_format_percent(share.lower)} to {_format_percent(share.upper)}",
                _format_violation(share),
                _format_number(share.worst, ".3e", share.unit),
                _format_number(share.worst_time, ".6g", share.time_unit),
            ]
            for share in rows
        ]

    def remarks(self) -> Iterator[str]:
        """Yield the notes below the table: the value of a sample, and what is proven."""
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
                f"every trajectory was looked at at {self.times} times, at least {self.inside or 'none'} of them inside"
                " every piece, not between them"
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
                f" of {'nothing' if worst is None else _format_number(worst.worst, '.3g', worst.unit)}"
            )
        if self.undrawn:
            yield self.undrawn


def clopper_pearson(successes: int, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Return the exact interval of a probability from independent trials (Clopper and Pearson 1934).

    Parameters
    ----------
    successes, trials : int
        The numbers of successes and of trials.
    confidence : float
        The confidence.

    Returns
    -------
    lower, upper : float
        The ends of the interval: quantiles of beta distributions, such that each tail is at most ``(1 - confidence) /
        2``.
    """
    from scipy.special import betaincinv

    tail = (1.0 - confidence) / 2
    lower = 0.0 if successes == 0 else float(betaincinv(successes, trials - successes + 1, tail))
    upper = 1.0 if successes == trials else float(betaincinv(successes + 1, trials - successes, 1.0 - tail))
    return lower, upper


def _format_percent(share: float) -> str:
    return f"{100 * share:.4g} %"


def _format_number(value: float, form: str, unit: str) -> str:
    return f"{value:{form}} {unit}".rstrip() if np.isfinite(value) else "-"


def _format_violation(one: ConstraintShare) -> str:
    text = f"{one.largest:.3e} {one.unit}".rstrip()
    return f"{text} at t = {_format_number(one.time, '.6g', one.time_unit)}" if np.isfinite(one.time) else text


def _format_vector(values: Sequence[float]) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values) + ")" if len(values) else "-"
