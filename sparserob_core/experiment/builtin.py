"""The framework's own components, registered like anybody else's."""

from __future__ import annotations

from collections.abc import Iterator
from typing import final

from pydantic import Field

from sparserob_core.experiment.plugin import MethodPlugin, ProblemPlugin
from sparserob_core.experiment.registry import hookimpl
from sparserob_core.options import Options


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


@hookimpl
def sparserob_methods() -> Iterator[MethodPlugin]:
    """The exchange method and two baselines."""
    yield MethodPlugin(name="exchange", factory="sparserob_core.sip.exchange:Exchange", options=ExchangeOptions,
                       summary="Exchanges indices until the lower and the upper bound meet, then proves the answer.")
    yield MethodPlugin(name="nominal", factory="sparserob_core.sip.baselines:Nominal", options=ExchangeOptions,
                       summary="Baseline: the same problem as if nothing were uncertain.")
    yield MethodPlugin(name="scenario", factory="sparserob_core.sip.baselines:Scenario", options=ScenarioOptions,
                       summary="Baseline: the constraints for a number of sampled uncertainties only.")


@hookimpl
def sparserob_problems() -> Iterator[ProblemPlugin]:
    """The general linear problem."""
    yield ProblemPlugin(name="linear", factory="sparserob_core.experiment.problems:LinearProblem",
                        summary="Sparse robust control of x' = A(p) x + B(p) u + E w from an initial state to a terminal set.")
