"""The components of the core, registered like those of any other plugin."""

from __future__ import annotations

from collections.abc import Iterator

from sparserob_core.experiment.plugins.commands import COMMANDS
from sparserob_core.experiment.plugins.hookspecs import (
    CommandPlugin,
    MethodPlugin,
    ProblemPlugin,
    RulePlugin,
    SolverPlugin,
    hookimpl,
)

RULES = "sparserob_core.sip.rules"


@hookimpl
def sparserob_methods() -> Iterator[MethodPlugin]:
    """Yield the methods of the core: exchange, the paper's algorithm, two for fewer active pieces, and two
    baselines."""
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
    """Yield the automatic choice of a solver, and the dual Newton method, which needs no other package."""
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
def sparserob_rules() -> Iterator[RulePlugin]:
    """Yield the rules of the paper's loop, and alternatives to them."""
    yield RulePlugin(name="geometric", factory=f"{RULES}:Geometric", summary="Regu: a constant factor, 1/2 by default.")
    yield RulePlugin(
        name="accelerating", factory=f"{RULES}:Accelerating", summary="Regu: the j-th power of a factor in iteration j."
    )
    yield RulePlugin(
        name="optimisers_settle",
        factory=f"{RULES}:OptimisersSettle",
        summary="SC1: the norm of the difference of successive optimisers is small.",
    )
    yield RulePlugin(
        name="costs_settle",
        factory=f"{RULES}:CostsSettle",
        summary="SC1: the difference of successive costs is small.",
    )
    yield RulePlugin(name="iterations", factory=f"{RULES}:Iterations", summary="SC1: a number of outer iterations.")
    yield RulePlugin(name="evaluations", factory=f"{RULES}:Evaluations", summary="SC2: a number of evaluations.")
    yield RulePlugin(
        name="temperature_floor",
        factory=f"{RULES}:TemperatureFloor",
        summary="SC2: the temperature of an annealing maximiser is low.",
    )
    yield RulePlugin(
        name="stalled", factory=f"{RULES}:Stalled", summary="SC2: the best value has not risen for a while."
    )
    yield RulePlugin(
        name="metropolis",
        factory=f"{RULES}:Metropolis",
        summary="SlCr: what is worse by delta is accepted with probability exp(-delta / temperature).",
    )
    yield RulePlugin(
        name="threshold",
        factory=f"{RULES}:Threshold",
        summary="SlCr: what is worse by no more than the temperature is accepted.",
    )
    yield RulePlugin(
        name="improvement", factory=f"{RULES}:Improvement", summary="SlCr: only what is not worse is accepted."
    )


@hookimpl
def sparserob_problems() -> Iterator[ProblemPlugin]:
    """Yield the general linear problem, and the semi-infinite program that is stated as text."""
    yield ProblemPlugin(
        name="linear",
        factory="sparserob_core.experiment.config.problems:LinearProblem",
        summary="Sparse robust control of x' = A(p) x + B(p) u + E w from an initial state to a terminal set.",
    )
    yield ProblemPlugin(
        name="program",
        factory="sparserob_core.experiment.config.programs:ProgramProblem",
        regularised=False,
        summary="A convex semi-infinite program as text: decisions, an objective, and rows for every index.",
    )


@hookimpl
def sparserob_commands() -> Iterator[CommandPlugin]:
    """Yield the commands of the core."""
    for name, (place, summary) in COMMANDS.items():
        yield CommandPlugin(name=name.replace("-", "_"), factory=place, summary=summary)
