"""Contenders side by side over many problems: performance profiles (Dolan and Moré 2002) and data profiles (Moré and
Wild 2009) of studies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.sip.convex_set import Array

Measure = Literal["evaluations", "seconds"]
LOWER, MIDDLE, UPPER = 0.25, 0.5, 0.75
LISTED = 40  # rows of one problem and one contender that a terminal shows


@final
@dataclass(frozen=True, eq=False)
class Instance:
    """Problem of a comparison: its ``label``, the value ``exact`` that the bounds approach, and the ``unit`` of its
    data profile.

    ``exact`` is the mean of the two bounds of the certified run with the least gap. Where no run is certified,
    ``certified`` is false, and ``exact`` is the best bound that any run has proven. The unit is the number of
    evaluations for a gradient by differences: 1 more than the search has coordinates.
    """

    label: str
    exact: float
    certified: bool
    unit: float

    __repr__ = brief


@final
@dataclass(frozen=True, eq=False)
class Profiles:
    """Times that contenders (maximisers, solvers, methods, with their options) need on a set of problems.

    A run has solved its problem once its lower bound reaches ``1 - accuracy`` of the exact value. Its time is the
    effort until then, in the ``measure`` evaluations or seconds; the time of a run that never came so far is infinite.
    ``times[p][s]`` are the times of problem ``p`` and contender ``s``, one for each of the ``seeds[p]``. Profiles use
    the median over the seeds, with the quartiles: the least time within which that share of the seeds had solved the
    problem. These exist also where some seeds never solved it.
    """

    title: str
    measure: Measure
    accuracy: float
    contenders: Sequence[str]
    problems: Sequence[Instance]
    seeds: Sequence[Sequence[Any]]
    times: Sequence[Sequence[Array]]
    failed: Sequence[int] = ()
    notes: Sequence[str] = ()
    undrawn: str = ""
    """Why there is no figure, where one was asked for."""

    __repr__ = brief

    def quantile(self, share: float) -> Array:
        """The least times ``(P, S)`` within which that share of the seeds had solved the problem."""
        return np.array([[_compute_quantile(times, share) for times in row] for row in self.times])

    def ratios(self, share: float = MIDDLE) -> Array:
        """Performance ratios ``(P, S)``: the quantile of the times, divided by the best median of the problem; infinite
        where it is not solved."""
        best = self.quantile(MIDDLE).min(axis=1, keepdims=True)
        times = self.quantile(share)
        with np.errstate(invalid="ignore"):
            return np.where(np.isfinite(times) & np.isfinite(best), times / best, np.inf)

    def performance(self, factor: float, share: float = MIDDLE) -> Array:
        """The performance profiles ``(S,)`` at a factor of at least 1: the share of the problems that each contender
        solves in at most that many times what the best one needs."""
        return np.asarray(np.mean((self.ratios(share) <= factor) & np.isfinite(self.ratios(share)), axis=0))

    def costs(self, share: float = MIDDLE) -> Array:
        """Times ``(P, S)`` in the unit of the data profile: gradients by differences, or seconds."""
        units = np.array([problem.unit for problem in self.problems]) if self.measure == "evaluations" else 1.0
        return np.asarray((self.quantile(share).T / units).T)

    def data(self, budget: float, share: float = MIDDLE) -> Array:
        """The data profiles ``(S,)`` at a budget: the share of the problems that each contender solves within as many
        gradients by differences (``n + 1`` evaluations each), or seconds."""
        return np.asarray(np.mean((self.costs(share) <= budget) & np.isfinite(self.costs(share)), axis=0))

    def solved(self) -> Array:
        """The share of its runs ``(S,)`` in which each contender has solved the problem."""
        columns = [np.concatenate([row[s] for row in self.times]) for s in range(len(self.contenders))]
        return np.array([np.isfinite(column).mean() for column in columns])

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per contender."""
        columns = ["contender", "runs", "failed", "runs solved", "fastest", "within 2x", "within 10x", "ever"]
        shares = [self.solved(), *(self.performance(factor) for factor in (1.0, 2.0, 10.0, np.inf))]
        rows = []
        for s, name in enumerate(self.contenders):
            runs = sum(row[s].size for row in self.times)
            rows.append([name, str(runs), str(self.failed[s]), *(f"{column[s]:.0%}" for column in shares)])
        return columns, rows

    def times_table(self) -> tuple[list[str], list[list[str]]]:
        """Column names, and one row per problem and contender: median and quartiles over the seeds."""
        quantiles = [self.quantile(share) for share in (MIDDLE, LOWER, UPPER)]
        columns = ["problem", "contender", "seeds", f"median {self.measure}", "lower quartile", "upper quartile"]
        rows = [
            [
                problem.label,
                name,
                str(self.times[p][s].size),
                *(_format_value(quantile[p, s], self.measure) for quantile in quantiles),
            ]
            for p, problem in enumerate(self.problems)
            for s, name in enumerate(self.contenders)
        ]
        return columns, rows

    def remarks(self) -> Iterator[str]:
        """Yield the notes to be printed with the tables."""
        unit = "gradients by differences (n + 1 evaluations)" if self.measure == "evaluations" else "seconds"
        count = "1 problem" if len(self.problems) == 1 else f"{len(self.problems)} problems"
        yield (
            f"solved: the lower bound is within {self.accuracy:.4g} of the exact value, relative; shares of {count}, by"
            f" the median over seeds; data profile in {unit}"
        )
        guessed = [problem.label or "the problem" for problem in self.problems if not problem.certified]
        if guessed:
            yield (
                f"no certified run of {_abbreviate_labels(guessed)}: the best bound of any run stands for the"
                " exact value, which favours whoever found it; runs of the method exchange beside the others give the"
                " exact one"
            )
        if self.measure == "seconds":
            yield "seconds are those of a clock: the first run of a process includes its imports; seeds even that out"
        if len(self.problems) * len(self.contenders) > LISTED:
            yield "medians and quartiles of every problem: --json"
        yield from self.notes
        if self.undrawn:
            yield self.undrawn

    def summary(self) -> Mapping[str, Any]:
        """Return contenders, problems, times, profiles and notes as plain data; an infinite time becomes null in
        JSON."""
        return {
            "title": self.title,
            "measure": self.measure,
            "accuracy": self.accuracy,
            "contenders": [
                {
                    "label": name,
                    "failed": int(self.failed[s]),
                    "runs_solved": float(self.solved()[s]),
                    "performance_profile": _list_steps(self.ratios()[:, s], len(self.problems)),
                    "data_profile": _list_steps(self.costs()[:, s], len(self.problems)),
                }
                for s, name in enumerate(self.contenders)
            ],
            "problems": [
                {
                    "label": problem.label,
                    "exact": problem.exact,
                    "certified": problem.certified,
                    "unit": problem.unit,
                    "seeds": list(self.seeds[p]),
                    "times": {
                        name: {
                            "median": float(self.quantile(MIDDLE)[p, s]),
                            "lower_quartile": float(self.quantile(LOWER)[p, s]),
                            "upper_quartile": float(self.quantile(UPPER)[p, s]),
                            "all": self.times[p][s].tolist(),
                        }
                        for s, name in enumerate(self.contenders)
                    },
                }
                for p, problem in enumerate(self.problems)
            ],
            "remarks": list(self.remarks()),
        }


def _compute_quantile(times: Array, share: float) -> float:
    """The least time within which that share of the runs had come there (the inverse of the distribution)."""
    ordered = np.sort(times)
    return float(ordered[max(0, int(np.ceil(share * ordered.size - 1e-9)) - 1)])


def _list_steps(values: Array, problems: int) -> dict[str, list[float]]:
    """A profile as its steps: from each place ``at`` on it has the ``share``."""
    positions, counts = np.unique(values[np.isfinite(values)], return_counts=True)
    return {"at": positions.tolist(), "share": (np.cumsum(counts) / problems).tolist()}


def _abbreviate_labels(labels: Sequence[str]) -> str:
    return "; ".join(labels[:3]) + (f"; and {len(labels) - 3} more" if len(labels) > 3 else "")


def _format_value(value: float, measure: Measure) -> str:
    return format(value, ".0f" if measure == "evaluations" else ".3f") if np.isfinite(value) else "never"
