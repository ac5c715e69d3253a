# ruff: noqa: I001  grouped by who needs a name
"""The public names: this one table is read by type checkers, and by `__init__` when a name is first used.

A name that users or authors of components need is added here, as ``Name as Name``, and nowhere else.
"""

# To state a problem.
from sparserob_core.control.problem.cost import Cost as Cost
from sparserob_core.control.problem.dictionary import Dictionary as Dictionary
from sparserob_core.control.problem.dictionary import DictionaryFactory as DictionaryFactory
from sparserob_core.control.problem.names import Names as Names
from sparserob_core.control.problem.system import LinearSystem as LinearSystem
from sparserob_core.control.problem.problem import OptimalControlProblem as OptimalControlProblem
from sparserob_core.control.problem.problem import PathConstraint as PathConstraint
from sparserob_core.control.problem.problem import ProblemFactory as ProblemFactory
from sparserob_core.control.sets.sets import Ellipsoid as Ellipsoid
from sparserob_core.control.sets.sets import Equality as Equality
from sparserob_core.control.sets.sets import NormBall as NormBall
from sparserob_core.control.sets.sets import Polytope as Polytope
from sparserob_core.control.sets.sets import SetFactory as SetFactory
from sparserob_core.control.sets.sets import cylinder as cylinder
from sparserob_core.control.sets.sets import intersection as intersection
from sparserob_core.control.transcription.transcribe import transcribe as transcribe
from sparserob_core.sip.convex_set import Array as Array
from sparserob_core.sip.convex_set import Box as Box
from sparserob_core.sip.convex_set import ConvexSet as ConvexSet
from sparserob_core.sip.program import ConstraintFamily as ConstraintFamily
from sparserob_core.sip.program import Enclosure as Enclosure
from sparserob_core.sip.program import SemiInfiniteProgram as SemiInfiniteProgram
from sparserob_core.sip.program import Separation as Separation

# To solve it, to judge the answer, and what comes back.
from sparserob_core.experiment.solve import ask_tell as ask_tell
from sparserob_core.experiment.solve import maximise as maximise
from sparserob_core.experiment.solve import solve as solve
from sparserob_core.experiment.run.run import Outcome as Outcome
from sparserob_core.experiment.run.run import run as run
from sparserob_core.experiment.check.check import Check as Check
from sparserob_core.experiment.check.check import check as check
from sparserob_core.experiment.simulation.simulation import ConstraintShare as ConstraintShare
from sparserob_core.experiment.simulation.simulation import Simulation as Simulation
from sparserob_core.experiment.simulation.simulate import simulate as simulate
from sparserob_core.experiment.margin.margin import Margin as Margin
from sparserob_core.experiment.margin.margin import margin as margin
from sparserob_core.experiment.initial_states.initial_states import InitialStates as InitialStates
from sparserob_core.experiment.initial_states.initial_states import initial_states as initial_states
from sparserob_core.experiment.sweep.study import Study as Study
from sparserob_core.experiment.sweep.sweep import sweep as sweep
from sparserob_core.experiment.comparison.comparison import Comparison as Comparison
from sparserob_core.experiment.comparison.compare import compare as compare
from sparserob_core.experiment.comparison.profiles import Instance as Instance
from sparserob_core.experiment.comparison.profiles import Profiles as Profiles
from sparserob_core.experiment.benchmark.searches import Benchmark as Benchmark
from sparserob_core.experiment.benchmark.benchmark import benchmark as benchmark
from sparserob_core.sip.result import Result as Result
from sparserob_core.sip.result import SearchTrace as SearchTrace
from sparserob_core.sip.evidence import Cut as Cut
from sparserob_core.control.constraints.explanation import Witness as Witness
from sparserob_core.errors import ConfigError as ConfigError
from sparserob_core.errors import InputError as InputError
from sparserob_core.errors import PluginError as PluginError
from sparserob_core.errors import SolverError as SolverError
from sparserob_core.errors import SparseRobError as SparseRobError
from sparserob_core.errors import UnknownPluginError as UnknownPluginError

# To write a component, and to register it.
from sparserob_core.options import Options as Options
from sparserob_core.experiment.plugins.hookspecs import DictionaryPlugin as DictionaryPlugin
from sparserob_core.experiment.plugins.hookspecs import ExecutorPlugin as ExecutorPlugin
from sparserob_core.experiment.plugins.hookspecs import InnerStopPlugin as InnerStopPlugin
from sparserob_core.experiment.plugins.hookspecs import MaximiserPlugin as MaximiserPlugin
from sparserob_core.experiment.plugins.hookspecs import MethodPlugin as MethodPlugin
from sparserob_core.experiment.plugins.hookspecs import ObserverPlugin as ObserverPlugin
from sparserob_core.experiment.plugins.hookspecs import OuterStopPlugin as OuterStopPlugin
from sparserob_core.experiment.plugins.hookspecs import PolicyPlugin as PolicyPlugin
from sparserob_core.experiment.plugins.hookspecs import ProblemPlugin as ProblemPlugin
from sparserob_core.experiment.plugins.hookspecs import RegulariserPlugin as RegulariserPlugin
from sparserob_core.experiment.plugins.hookspecs import SchedulePlugin as SchedulePlugin
from sparserob_core.experiment.plugins.hookspecs import SelectionPlugin as SelectionPlugin
from sparserob_core.experiment.plugins.hookspecs import SetPlugin as SetPlugin
from sparserob_core.experiment.plugins.hookspecs import SolverPlugin as SolverPlugin
from sparserob_core.experiment.plugins.hookspecs import hookimpl as hookimpl
from sparserob_core.experiment.plugins.registry import load_registry as load_registry
from sparserob_core.sip.method import Continuation as Continuation
from sparserob_core.sip.method import ExecutorFactory as ExecutorFactory
from sparserob_core.sip.method import Method as Method
from sparserob_core.sip.method import Tools as Tools
from sparserob_core.workers import one_thread as one_thread
from sparserob_core.workers import processors as processors
from sparserob_core.workers import without_script as without_script
from sparserob_core.sip.solver import Claim as Claim
from sparserob_core.sip.solver import QuadraticProgram as QuadraticProgram
from sparserob_core.sip.solver import Solver as Solver
from sparserob_core.sip.regulariser import ControlImage as ControlImage
from sparserob_core.sip.regulariser import Regulariser as Regulariser
from sparserob_core.sip.maximiser import EvaluationError as EvaluationError
from sparserob_core.sip.maximiser import Maximiser as Maximiser
from sparserob_core.sip.maximiser import LinearBlocks as LinearBlocks
from sparserob_core.sip.maximiser import Objective as Objective
from sparserob_core.sip.maximiser import Report as Report
from sparserob_core.sip.maximiser import SearchEnded as SearchEnded
from sparserob_core.sip.maximiser import Trace as Trace
from sparserob_core.sip.search.block_ascent import block_ascent as block_ascent
from sparserob_core.sip.search.ask_tell import AskTell as AskTell
from sparserob_core.sip.search.foreign import from_ask_tell as from_ask_tell
from sparserob_core.sip.search.foreign import from_minimiser as from_minimiser
from sparserob_core.sip.search.trust_region import TrustRegion as TrustRegion
from sparserob_core.sip.rules import InnerStop as InnerStop
from sparserob_core.sip.rules import OuterStep as OuterStep
from sparserob_core.sip.rules import OuterStop as OuterStop
from sparserob_core.sip.rules import Progress as Progress
from sparserob_core.sip.rules import Schedule as Schedule
from sparserob_core.sip.rules import Selection as Selection
from sparserob_core.control.policies.policy import Policy as Policy
from sparserob_core.experiment.config.problems import LinearKeys as LinearKeys
from sparserob_core.experiment.config.problems import LinearProblem as LinearProblem
from sparserob_core.experiment.config.set_options import SetOptions as SetOptions

# To watch a run.
from sparserob_core.experiment.run.events import Observer as Observer
from sparserob_core.experiment.run.events import PointProgress as PointProgress
from sparserob_core.experiment.run.events import RunFinished as RunFinished
from sparserob_core.experiment.run.events import RunStarted as RunStarted
from sparserob_core.experiment.run.events import StudyProgress as StudyProgress
from sparserob_core.experiment.run.events import SweepFinished as SweepFinished
from sparserob_core.experiment.run.events import SweepProgress as SweepProgress
from sparserob_core.experiment.run.events import SweepStarted as SweepStarted
from sparserob_core.sip.events import Batch as Batch
from sparserob_core.sip.events import EvaluationsFinished as EvaluationsFinished
from sparserob_core.sip.events import Sketch as Sketch
from sparserob_core.sip.events import Event as Event
from sparserob_core.sip.events import ProofProgress as ProofProgress
from sparserob_core.sip.events import RoundFinished as RoundFinished
from sparserob_core.experiment.run.inspection import Inspection as Inspection
from sparserob_core.experiment.run.inspection import RelaxedValue as RelaxedValue
from sparserob_core.experiment.figures.figure_data import FigureData as FigureData
from sparserob_core.experiment.figures.figure_data import Wall as Wall
from sparserob_core.experiment.figures.clash import Strip as Strip
