"""The framework's own components, registered like anybody else's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, final

from pydantic import Field

from sparserob_core.experiment.plugins.hookspecs import hookimpl
from sparserob_core.experiment.plugins.records import (
    InnerStopPlugin,
    MethodPlugin,
    OuterStopPlugin,
    ProblemPlugin,
    SchedulePlugin,
    SelectionPlugin,
)
from sparserob_core.options import Options

RULES = "sparserob_core.sip.rules"


class ExchangeOptions(Options):
    """Options of the exchange method; the optimisation wing itself knows nothing of configs."""

    tolerance: float = Field(default=1e-7, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""

    rounds: int = Field(default=200, ge=1)
    """Rounds at most."""


@final
class ScenarioOptions(ExchangeOptions):
    """Options of the scenario approach."""

    scenarios: int = Field(default=1000, ge=1)
    """How many uncertainties are sampled."""


def _part(kind: str) -> Any:
    return Field(default=None, json_schema_extra={"component": kind})


@final
class SparseRobOptions(Options):
    """Options of the paper's algorithm; in Python, each of the four rules may also be a function."""

    formulation: Literal["reduced", "literal"] = "reduced"
    """What an index is: (t, p), the worst disturbance in closed form; or the paper's (t, Beta, p)."""

    indices: int | None = Field(default=None, ge=1, strict=True)
    """How many indices a tuple has; null: as many as there are decision variables (m N), which the theorem asks for."""

    regu: Any = _part("schedule")
    """``Regu``: the next weight of the regulariser; null: the factor of ``continuation``."""

    sc1: Any = _part("outer_stop")
    """``SC1``: when the outer iteration stops, at the last weight of ``continuation`` at the latest; null:
    `optimisers_settle`."""

    sc2: Any = _part("inner_stop")
    """``SC2``: when a search stops, at the maximiser's budget at the latest; null: only then."""

    slcr: Any = _part("selection")
    """``SlCr``: whether a maximiser that walks accepts a candidate; null: `metropolis`."""

    tolerance: float = Field(default=1e-7, gt=0.0, le=1.0)
    """Relative gap at which the bounds have met."""


class FactorOptions(Options):
    """Options of a schedule."""

    factor: float = Field(default=0.5, gt=0.0, lt=1.0)
    """What the weight is multiplied by."""


@final
class OptimisersSettleOptions(Options):
    """Options of the rule about successive optimisers."""

    tolerance: float = Field(default=1e-3, ge=0.0)
    """Norm of the difference of successive optimisers, relative to the last one's norm or 1."""


@final
class CostsSettleOptions(Options):
    """Options of the rule about successive costs."""

    tolerance: float = Field(default=1e-6, ge=0.0)
    """Difference of successive costs, relative to the last one or 1."""


@final
class IterationsOptions(Options):
    """Options of the rule that counts outer iterations."""

    count: int = Field(default=10, ge=1)
    """Outer iterations."""


@final
class EvaluationsOptions(Options):
    """Options of the rule that counts evaluations."""

    count: int | None = Field(default=None, ge=1)
    """Evaluations of one search; null: its budget."""


@final
class TemperatureFloorOptions(Options):
    """Options of the rule about the temperature."""

    floor: float = Field(default=1e-6, ge=0.0)
    """Temperature at which an annealing maximiser stops."""


@final
class StalledOptions(Options):
    """Options of the rule about the best value."""

    window: int = Field(default=200, ge=1)
    """Evaluations that are looked back upon."""

    tolerance: float = Field(default=1e-9, ge=0.0)
    """Rise of the best value within the window that is no rise."""


@hookimpl
def sparserob_methods() -> Iterator[MethodPlugin]:
    """The exchange method and two baselines."""
    yield MethodPlugin(
        name="exchange",
        factory="sparserob_core.sip.methods.exchange:Exchange",
        options=ExchangeOptions,
        summary="Exchanges indices until the lower and the upper bound meet, then proves the answer.",
    )
    yield MethodPlugin(
        name="sparserob",
        factory="sparserob_core.sip.methods.sparserob:SparseRob",
        options=SparseRobOptions,
        summary="The paper's algorithm: the value g of the relaxed program, maximised over tuples of indices.",
    )
    yield MethodPlugin(
        name="nominal",
        factory="sparserob_core.sip.methods.baselines:Nominal",
        options=ExchangeOptions,
        summary="Baseline: the same problem as if nothing were uncertain.",
    )
    yield MethodPlugin(
        name="scenario",
        factory="sparserob_core.sip.methods.baselines:Scenario",
        options=ScenarioOptions,
        summary="Baseline: the constraints for a number of sampled uncertainties only.",
    )


@hookimpl
def sparserob_schedules() -> Iterator[SchedulePlugin]:
    """``Regu``."""
    yield SchedulePlugin(
        name="geometric",
        factory=f"{RULES}:Geometric",
        options=FactorOptions,
        summary="A constant factor, 1/2 unless told otherwise.",
    )
    yield SchedulePlugin(
        name="accelerating",
        factory=f"{RULES}:Accelerating",
        options=FactorOptions,
        summary="The j-th power of a factor in iteration j.",
    )


@hookimpl
def sparserob_outer_stops() -> Iterator[OuterStopPlugin]:
    """``SC1``."""
    yield OuterStopPlugin(
        name="optimisers_settle",
        factory=f"{RULES}:OptimisersSettle",
        options=OptimisersSettleOptions,
        summary="The norm of the difference of successive optimisers is small.",
    )
    yield OuterStopPlugin(
        name="costs_settle",
        factory=f"{RULES}:CostsSettle",
        options=CostsSettleOptions,
        summary="The difference of successive costs is small.",
    )
    yield OuterStopPlugin(
        name="iterations",
        factory=f"{RULES}:Iterations",
        options=IterationsOptions,
        summary="A number of outer iterations.",
    )


@hookimpl
def sparserob_inner_stops() -> Iterator[InnerStopPlugin]:
    """``SC2``."""
    yield InnerStopPlugin(
        name="evaluations",
        factory=f"{RULES}:Evaluations",
        options=EvaluationsOptions,
        summary="A number of evaluations.",
    )
    yield InnerStopPlugin(
        name="temperature_floor",
        factory=f"{RULES}:TemperatureFloor",
        options=TemperatureFloorOptions,
        summary="The temperature of an annealing maximiser is low.",
    )
    yield InnerStopPlugin(
        name="stalled",
        factory=f"{RULES}:Stalled",
        options=StalledOptions,
        summary="The best value has not risen for a while.",
    )


@hookimpl
def sparserob_selections() -> Iterator[SelectionPlugin]:
    """``SlCr``."""
    yield SelectionPlugin(
        name="metropolis",
        factory=f"{RULES}:Metropolis",
        summary="What is worse by delta, with probability exp(-delta / temperature).",
    )
    yield SelectionPlugin(
        name="threshold", factory=f"{RULES}:Threshold", summary="What is worse by no more than the temperature."
    )
    yield SelectionPlugin(name="improvement", factory=f"{RULES}:Improvement", summary="Only what is not worse.")


@hookimpl
def sparserob_problems() -> Iterator[ProblemPlugin]:
    """The general linear problem."""
    yield ProblemPlugin(
        name="linear",
        factory="sparserob_core.experiment.config.problems:LinearProblem",
        summary="Sparse robust control of x' = A(p) x + B(p) u + E w from an initial state to a terminal set.",
    )
