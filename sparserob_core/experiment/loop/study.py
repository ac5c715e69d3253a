"""The result of a simulation in closed loop, and the words for it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np

from sparserob_core.brief import brief
from sparserob_core.sip.convex_set import Array


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ClosedLoops:
    """Closed loops of a `Controller` and the exact system, under disturbances of every law.

    Parameters
    ----------
    title : str
        The title of the run.
    directory : Path
        Its directory.
    status : str
        Its status.
    resolve : bool
        Whether the remaining horizon was solved anew at every step.
    seed : int
        The seed of random numbers.
    laws : mapping
        The number of loops of every law.
    constraints : mapping
        The largest violation of each constraint (negative: a margin) and its tolerance, over the breakpoints and times
        within every piece. The set of controls is ``control``.
    milliseconds : array (steps,)
        The time that every step has taken.
    resolved : int
        The number of steps that took a control that was solved anew.
    uncovered : int
        The number of steps with a state that the proof does not cover.
    cost : float
        The cost of the run.
    planned : float
        The first term of the cost for the plan's own control, under feedback the nominal one.
    costs : array (loops,)
        The same term for the control that was applied, law after law.
    seconds : float
        The seconds that the study has taken.
    shown : array
        The times of the figure.
    paths, controls : sequence
        The states and the controls of the first loops of every law, for the figure.
    units : mapping
        The units of the violations, as the config names them.
    cost_unit, paid_in : str
        The units of the cost of the run and of that of a control, where they are known.
    undrawn : str
        The reason why there is no figure, where one was asked for.
    periods : int
        The number of periods of every loop.
    """

    title: str
    directory: Path
    status: str
    resolve: bool
    seed: int
    laws: Mapping[str, int]
    constraints: Mapping[str, tuple[float, float]]
    milliseconds: Array = field(repr=False)
    resolved: int
    uncovered: int
    cost: float
    planned: float
    costs: Array = field(repr=False)
    seconds: float
    shown: Array = field(repr=False)
    paths: Sequence[tuple[str, Array]] = field(repr=False)
    controls: Sequence[tuple[str, Array]] = field(repr=False)
    units: Mapping[str, str] = field(default_factory=dict)
    cost_unit: str = ""
    paid_in: str = ""
    undrawn: str = ""
    """Reason why there is no figure, where one was asked for."""
    periods: int = 1
    """Number of periods of every loop; costs are averages over the periods."""

    __repr__ = brief

    @property
    def steps(self) -> int:
        """The number of steps."""
        return int(self.milliseconds.size)

    @property
    def violated(self) -> tuple[str, ...]:
        """The constraints that a loop violates."""
        return tuple(name for name, (largest, tolerance) in self.constraints.items() if largest > tolerance)

    @property
    def contradicts(self) -> bool:
        """True where a loop contradicts the proof."""
        return bool(self.violated) or self.uncovered > 0

    @property
    def paid(self) -> Mapping[str, Array]:
        """The ``costs`` of every law, by its name."""
        ends = np.cumsum(list(self.laws.values()))[:-1]
        return dict(zip(self.laws, np.split(self.costs, ends), strict=True))

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``loop.json``."""
        median, late = np.quantile(self.milliseconds, [0.5, 0.99]).tolist()
        return {
            "title": self.title,
            "status": self.status,
            "resolve": self.resolve,
            "seed": self.seed,
            "periods": self.periods,
            "loops": dict(self.laws),
            "steps": self.steps,
            "resolved": self.resolved,
            "uncovered": self.uncovered,
            "milliseconds": {"median": median, "99%": late, "largest": float(self.milliseconds.max())},
            "cost": {
                "run": self.cost,
                "plan": self.planned,
                "mean": float(self.costs.mean()),
                "least": float(self.costs.min()),
                "largest": float(self.costs.max()),
                "laws": {
                    law: {"mean": float(costs.mean()), "largest": float(costs.max())}
                    for law, costs in self.paid.items()
                },
            },
            "constraints": [
                {"name": name, "largest": largest, "tolerance": tolerance, "violated": largest > tolerance}
                for name, (largest, tolerance) in self.constraints.items()
            ],
            "contradicts": self.contradicts,
            "remarks": list(self.remarks()),
            "seconds": self.seconds,
        }

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, str]]]:
        """Return the columns and rows of a table."""
        summary = self.summary()
        time, cost = summary["milliseconds"], summary["cost"]
        unit, paid_in = (f" {unit_name}" if unit_name else "" for unit_name in (self.cost_unit, self.paid_in))
        rows = [
            ("loops", f"{sum(self.laws.values())} ({', '.join(f'{n} {law}' for law, n in self.laws.items())})"),
            *([("periods of each", f"{self.periods}")] if self.periods > 1 else []),
            ("steps", f"{self.steps}" + (f", {self.resolved} of them solved anew and better" if self.resolve else "")),
            ("a step takes", f"{time['median']:.3g} ms (median), {time['99%']:.3g} ms (99 %)"),
            ("cost of the run", f"{cost['run']:.7g}{unit}"),
            ("cost of its control", f"{cost['plan']:.7g}{paid_in} when nothing happens"),
            (
                "cost of the loops",
                f"{cost['mean']:.7g}{paid_in} on average, {cost['least']:.7g} to {cost['largest']:.7g}{paid_in}",
            ),
            *(
                (f"cost under {law}", f"{costs.mean():.7g}{paid_in} on average, {costs.max():.7g}{paid_in} at most")
                for law, costs in self.paid.items()
            ),
            *(
                (f"largest violation of {name}", f"{largest:.3e} {self.units.get(name, '')}".rstrip())
                for name, (largest, _) in self.constraints.items()
            ),
        ]
        return (), rows

    def remarks(self) -> Iterator[str]:
        """Yield the notes below the table."""
        if self.violated:
            yield f"a loop contradicts the proof: it violates {', '.join(self.violated)}; one of the two is wrong"
        elif self.uncovered:
            yield f"{self.uncovered} states were outside what the proof covers, which no disturbance should reach"
        else:
            yield "no loop violates a constraint; the run proves that none can, which no number of loops does"
        yield "the cost of a loop is that of the control that was applied, without terms of the state or of squares"
        if self.undrawn:
            yield self.undrawn
