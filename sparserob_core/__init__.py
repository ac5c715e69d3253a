"""SparseRob: sparse robust optimal control of uncertain linear systems, with the proof.

Every public name is an attribute of this module, and is imported when it is first used. To read the package, follow the
data:

1. ``control/``     ``sets``, ``system``, ``problem``: what is to be controlled; ``dictionary``: how controls are
   written; ``response``, ``transcription``: the problem as a convex semi-infinite program.
2. ``sip/``         ``program``: such a program in general; ``finite``, ``solver``: finitely many of its constraints,
   and who solves them; ``method``, ``exchange``: from there to the whole continuum; ``tuples``,
   ``sparserob``: the paper's own way, a search over tuples of indices; ``result``: what was found and what of it was
   proven.
3. ``experiment/``  ``config``: a file that names components; ``registry``: who offers them; ``run``: the whole walk;
  ``cli``: the commands.

``experiment`` imports ``control``, ``control`` imports ``sip``, never the other way; plugins import this module only.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sparserob_core.control.constraints.explanation import Witness
    from sparserob_core.control.problem.dictionary import Dictionary, DictionaryFactory
    from sparserob_core.control.problem.problem import OptimalControlProblem, PathConstraint, ProblemFactory
    from sparserob_core.control.problem.system import LinearSystem
    from sparserob_core.control.sets.sets import (
        Ellipsoid,
        Equality,
        NormBall,
        Polytope,
        SetFactory,
        cylinder,
        intersection,
    )
    from sparserob_core.control.transcription.transcribe import transcribe
    from sparserob_core.errors import ConfigError, InputError, PluginError, SolverError, SparseRobError
    from sparserob_core.experiment.check.check import Check, check
    from sparserob_core.experiment.comparison.compare import compare
    from sparserob_core.experiment.comparison.comparison import Comparison
    from sparserob_core.experiment.config.problems import LinearKeys, LinearProblem
    from sparserob_core.experiment.config.set_options import SetOptions
    from sparserob_core.experiment.figures.figure_data import FigureData, Wall
    from sparserob_core.experiment.initial_states.initial_states import InitialStates, initial_states
    from sparserob_core.experiment.margin.margin import Margin, margin
    from sparserob_core.experiment.plugins.hookspecs import hookimpl
    from sparserob_core.experiment.plugins.records import (
        DictionaryPlugin,
        InnerStopPlugin,
        MaximiserPlugin,
        MethodPlugin,
        ObserverPlugin,
        OuterStopPlugin,
        ProblemPlugin,
        RegulariserPlugin,
        SchedulePlugin,
        SelectionPlugin,
        SetPlugin,
        SolverPlugin,
    )
    from sparserob_core.experiment.plugins.registry import load_registry
    from sparserob_core.experiment.run.events import Observer, RunFinished, RunStarted, StudyProgress
    from sparserob_core.experiment.run.inspection import Inspection, RelaxedValue
    from sparserob_core.experiment.run.run import Outcome, run
    from sparserob_core.experiment.simulation.outcome import ConstraintShare, Simulation
    from sparserob_core.experiment.simulation.simulate import simulate
    from sparserob_core.experiment.solve import maximise, solve
    from sparserob_core.options import Options
    from sparserob_core.sip.convex_set import Array, Box, ConvexSet
    from sparserob_core.sip.events import Batch, EvaluationsFinished, Event, ProofProgress, RoundFinished
    from sparserob_core.sip.evidence import Cut
    from sparserob_core.sip.maximiser import EvaluationError, Maximiser, Objective, Report, SearchEnded, Trace
    from sparserob_core.sip.method import Continuation, Method, Tools
    from sparserob_core.sip.program import ConstraintFamily, Enclosure, SemiInfiniteProgram, Separation
    from sparserob_core.sip.regulariser import ControlImage, Regulariser
    from sparserob_core.sip.result import Result, SearchTrace
    from sparserob_core.sip.rules import InnerStop, OuterStep, OuterStop, Progress, Schedule, Selection
    from sparserob_core.sip.search.trust_region import TrustRegion
    from sparserob_core.sip.solver import Claim, QuadraticProgram, Solver

__all__ = [
    "Array",
    "Batch",
    "Box",
    "Check",
    "Claim",
    "Comparison",
    "ConfigError",
    "ConstraintFamily",
    "ConstraintShare",
    "Continuation",
    "ControlImage",
    "ConvexSet",
    "Cut",
    "Dictionary",
    "DictionaryFactory",
    "DictionaryPlugin",
    "Ellipsoid",
    "Enclosure",
    "Equality",
    "EvaluationError",
    "EvaluationsFinished",
    "Event",
    "FigureData",
    "InitialStates",
    "InnerStop",
    "InnerStopPlugin",
    "InputError",
    "Inspection",
    "LinearKeys",
    "LinearProblem",
    "LinearSystem",
    "Margin",
    "Maximiser",
    "MaximiserPlugin",
    "Method",
    "MethodPlugin",
    "NormBall",
    "Objective",
    "Observer",
    "ObserverPlugin",
    "OptimalControlProblem",
    "Options",
    "Outcome",
    "OuterStep",
    "OuterStop",
    "OuterStopPlugin",
    "PathConstraint",
    "PluginError",
    "Polytope",
    "ProblemFactory",
    "ProblemPlugin",
    "Progress",
    "ProofProgress",
    "QuadraticProgram",
    "Regulariser",
    "RegulariserPlugin",
    "RelaxedValue",
    "Report",
    "Result",
    "RoundFinished",
    "RunFinished",
    "RunStarted",
    "Schedule",
    "SchedulePlugin",
    "SearchEnded",
    "SearchTrace",
    "Selection",
    "SelectionPlugin",
    "SemiInfiniteProgram",
    "Separation",
    "SetFactory",
    "SetOptions",
    "SetPlugin",
    "Simulation",
    "Solver",
    "SolverError",
    "SolverPlugin",
    "SparseRobError",
    "StudyProgress",
    "Tools",
    "Trace",
    "TrustRegion",
    "Wall",
    "Witness",
    "check",
    "compare",
    "cylinder",
    "hookimpl",
    "initial_states",
    "intersection",
    "load_registry",
    "margin",
    "maximise",
    "run",
    "simulate",
    "solve",
    "transcribe",
]

_MODULES = {
    "errors": "ConfigError InputError PluginError SolverError SparseRobError",
    "options": "Options",
    "sip.convex_set": "Array Box ConvexSet",
    "sip.program": "ConstraintFamily Enclosure SemiInfiniteProgram Separation",
    "sip.solver": "Claim QuadraticProgram Solver",
    "sip.regulariser": "ControlImage Regulariser",
    "sip.maximiser": "EvaluationError Maximiser Objective Report SearchEnded Trace",
    "sip.method": "Continuation Method Tools",
    "sip.result": "Result SearchTrace",
    "sip.evidence": "Cut",
    "sip.rules": "InnerStop OuterStep OuterStop Progress Schedule Selection",
    "sip.search.trust_region": "TrustRegion",
    "sip.events": "Batch EvaluationsFinished Event ProofProgress RoundFinished",
    "control.constraints.explanation": "Witness",
    "control.problem.dictionary": "Dictionary DictionaryFactory",
    "control.sets.sets": "Ellipsoid Equality NormBall Polytope SetFactory cylinder intersection",
    "control.problem.system": "LinearSystem",
    "control.problem.problem": "OptimalControlProblem PathConstraint ProblemFactory",
    "control.transcription.transcribe": "transcribe",
    "experiment.check.check": "Check check",
    "experiment.comparison.compare": "compare",
    "experiment.comparison.comparison": "Comparison",
    "experiment.run.events": "StudyProgress Observer RunFinished RunStarted",
    "experiment.figures.figure_data": "FigureData Wall",
    "experiment.initial_states.initial_states": "InitialStates initial_states",
    "experiment.run.inspection": "Inspection RelaxedValue",
    "experiment.margin.margin": "Margin margin",
    "experiment.plugins.records": (
        "DictionaryPlugin InnerStopPlugin MaximiserPlugin MethodPlugin ObserverPlugin OuterStopPlugin ProblemPlugin "
        "RegulariserPlugin SchedulePlugin SelectionPlugin SetPlugin SolverPlugin"
    ),
    "experiment.config.problems": "LinearKeys LinearProblem",
    "experiment.plugins.hookspecs": "hookimpl",
    "experiment.plugins.registry": "load_registry",
    "experiment.run.run": "Outcome run",
    "experiment.config.set_options": "SetOptions",
    "experiment.simulation.simulate": "simulate",
    "experiment.simulation.outcome": "ConstraintShare Simulation",
    "experiment.solve": "maximise solve",
}
_HOME = {name: f"{__name__}.{module}" for module, names in _MODULES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
