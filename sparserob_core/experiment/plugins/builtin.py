"""The framework's own components, registered like anybody else's."""

from __future__ import annotations

from collections.abc import Iterator

from sparserob_core.experiment.plugins.hookspecs import (
    InnerStopPlugin,
    MethodPlugin,
    OuterStopPlugin,
    ProblemPlugin,
    SchedulePlugin,
    SelectionPlugin,
    SolverPlugin,
    hookimpl,
)

RULES = "sparserob_core.sip.rules"


@hookimpl
def sparserob_methods() -> Iterator[MethodPlugin]:
    """The exchange method and two baselines."""
    yield MethodPlugin(
        name="exchange",
        factory="sparserob_core.sip.methods.exchange:Exchange",
        summary="Exchanges indices until the lower and the upper bound meet, then proves the answer.",
    )
    yield MethodPlugin(
        name="sparserob",
        factory="sparserob_core.sip.methods.sparserob:SparseRob",
        summary="The paper's algorithm: the value g of the relaxed program, maximised over tuples of indices.",
    )
    yield MethodPlugin(
        name="sparsest",
        factory="sparserob_core.sip.methods.sparsest:SparsestMethod",
        summary="The fewest active pieces exactly, or a control that takes the values of an alphabet only.",
    )
    yield MethodPlugin(
        name="reweighted",
        factory="sparserob_core.sip.methods.reweighted:Reweighted",
        summary="Reweighted L1 or the capped L1 norm, in the hope of fewer active pieces; bounds and proof as ever.",
    )
    yield MethodPlugin(
        name="nominal",
        factory="sparserob_core.sip.methods.baselines:Nominal",
        summary="Baseline: the same problem as if nothing were uncertain.",
    )
    yield MethodPlugin(
        name="scenario",
        factory="sparserob_core.sip.methods.baselines:Scenario",
        summary="Baseline: the constraints for a number of sampled uncertainties only.",
    )


@hookimpl
def sparserob_solvers() -> Iterator[SolverPlugin]:
    """Whoever is quickest, and the method that needs nobody else's code."""
    yield SolverPlugin(
        name="auto",
        factory="sparserob_core.sip.solver:Auto",
        summary="No solver by name: closed forms and the dual Newton method where they serve, another for the rest.",
    )
    yield SolverPlugin(
        name="dual_newton",
        factory="sparserob_core.sip.inner.dual_newton:DualNewton",
        summary="Newton's method on the dual, for separable programs alone: exact, and of few unknowns.",
    )


@hookimpl
def sparserob_schedules() -> Iterator[SchedulePlugin]:
    """``Regu``."""
    yield SchedulePlugin(
        name="geometric",
        factory=f"{RULES}:Geometric",
        summary="A constant factor, 1/2 by default.",
    )
    yield SchedulePlugin(
        name="accelerating",
        factory=f"{RULES}:Accelerating",
        summary="The j-th power of a factor in iteration j.",
    )


@hookimpl
def sparserob_outer_stops() -> Iterator[OuterStopPlugin]:
    """``SC1``."""
    yield OuterStopPlugin(
        name="optimisers_settle",
        factory=f"{RULES}:OptimisersSettle",
        summary="The norm of the difference of successive optimisers is small.",
    )
    yield OuterStopPlugin(
        name="costs_settle",
        factory=f"{RULES}:CostsSettle",
        summary="The difference of successive costs is small.",
    )
    yield OuterStopPlugin(
        name="iterations",
        factory=f"{RULES}:Iterations",
        summary="A number of outer iterations.",
    )


@hookimpl
def sparserob_inner_stops() -> Iterator[InnerStopPlugin]:
    """``SC2``."""
    yield InnerStopPlugin(
        name="evaluations",
        factory=f"{RULES}:Evaluations",
        summary="A number of evaluations.",
    )
    yield InnerStopPlugin(
        name="temperature_floor",
        factory=f"{RULES}:TemperatureFloor",
        summary="The temperature of an annealing maximiser is low.",
    )
    yield InnerStopPlugin(
        name="stalled",
        factory=f"{RULES}:Stalled",
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
