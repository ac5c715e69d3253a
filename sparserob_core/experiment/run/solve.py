"""Solution of a problem that is written in Python, without a config and without files."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, TypedDict, overload

import numpy as np

from sparserob_core.arguments import share, whole
from sparserob_core.control.policies.policy import Policy
from sparserob_core.control.problem.dictionary import Dictionary, DictionaryFactory
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.plugins.components import Registry
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.experiment.solve import PIECES, Choice, component, dictionary, indicators, wrap_notify
from sparserob_core.sip.convexity import Regulariser
from sparserob_core.sip.events import ignore
from sparserob_core.sip.limits.deadline import Deadline, as_seconds
from sparserob_core.sip.maximiser import Maximiser
from sparserob_core.sip.method import GAP_TOLERANCE, Continuation, Method, Tools, require_suited
from sparserob_core.sip.methods.own_units import solve_in_own_units
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.sip.proof.verdict import add_warning as remarked_program
from sparserob_core.sip.relaxed.relaxed import require_separable
from sparserob_core.sip.result import Result
from sparserob_core.sip.solver import AUTO, Auto, Solver
from sparserob_core.sip.solver import named as named_solver

if TYPE_CHECKING:
    from typing import Unpack

    from sparserob_core.experiment.run.outcome import SolvedProblem
    from sparserob_core.sip.events import Notify

logger = logging.getLogger("sparserob")


class Keywords(TypedDict, total=False):
    """The keywords of `solve` that are no components."""

    tolerance: float | None
    seed: int
    control: Choice | DictionaryFactory | Dictionary | None
    disturbance: Choice | DictionaryFactory | Dictionary | None
    continuation: Continuation | Mapping[str, float] | None
    budget: int
    polish: float
    seconds: float | None
    notify: Notify


@overload
def solve(
    problem: OptimalControlProblem,
    method: Choice | Method = ...,
    solver: Choice | Solver = ...,
    maximiser: Choice | Maximiser = ...,
    regulariser: Choice | Regulariser | None = ...,
    **keywords: Unpack[Keywords],
) -> SolvedProblem: ...


@overload
def solve(
    problem: SemiInfiniteProgram,
    method: Choice | Method = ...,
    solver: Choice | Solver = ...,
    maximiser: Choice | Maximiser = ...,
    regulariser: Choice | Regulariser | None = ...,
    **keywords: Unpack[Keywords],
) -> Result: ...


def solve(
    problem: OptimalControlProblem | SemiInfiniteProgram,
    method: Choice | Method = "exchange",
    solver: Choice | Solver = "auto",
    maximiser: Choice | Maximiser = "direct",
    regulariser: Choice | Regulariser | None = "default",
    *,
    tolerance: float | None = GAP_TOLERANCE,
    seed: int = 0,
    control: Choice | DictionaryFactory | Dictionary | None = None,
    disturbance: Choice | DictionaryFactory | Dictionary | None = None,
    policy: Choice | Policy = "open_loop",
    continuation: Continuation | Mapping[str, float] | None = None,
    budget: int = 2000,
    polish: float | None = None,
    seconds: float | None = None,
    notify: Notify = ignore,
) -> Result:
    """Solve an optimal control problem or a semi-infinite program, as ``sparserob run`` does, but without files.

    A component is given by its name, by a mapping such as ``{"name": "exchange", "tolerance": 1e-9}``, or as an object.

    Parameters
    ----------
    problem : OptimalControlProblem or SemiInfiniteProgram
        The problem. A control problem is solved on its dictionaries.
    method : str, mapping or Method, default "exchange"
        The method for the semi-infinite program.
    solver : str, mapping or Solver, default "auto"
        The solver of the finite programs. ``auto`` takes the quickest one. A solver that is named is asked for every
        finite program; `Result.unanswered` lists those that others had to solve.
    maximiser : str, mapping or Maximiser, default "direct"
        The global search for violated constraints.
    regulariser : str, mapping, Regulariser or None, default "default"
        The strictly convex term. By default it is the ridge for a control problem, so that its optimiser is unique. It
        is none for another program, so that ``value`` is the cost.
    tolerance : float or None
        The relative gap, for a method that has such an option.
    seed : int, default 0
        The seed of random numbers.
    control : str, mapping, DictionaryFactory or Dictionary, optional
        The dictionary of the control, for a control problem only; 100 equal pieces unless given.
    disturbance : str, mapping, DictionaryFactory or Dictionary, optional
        The dictionary of the disturbance, for a control problem only. Unless given it has one indicator function on
        each piece of the control.
    policy : str, mapping or Policy, default "open_loop"
        The policy, such as `AffinePolicy`, for a control problem only. Under feedback the decision begins with the
        nominal control.
    continuation : Continuation or mapping, optional
        The decrease of the regulariser's weight.
    budget : int, default 2000
        The number of evaluations of one search of the maximiser.
    polish : float, optional
        The last share of the budget, which a local method spends. Unless given it is as in a config: the maximiser's
        own share where ``g`` has a gradient or tuples are literal, and nothing elsewhere.
    seconds : float, optional
        The time after which the best known result is returned, as at an interrupt from the keyboard; `Result.stopped`
        then says so. Unless given there is no limit. It is 30 for a problem of which no control can ever be certified.
    notify : callable, optional
        A function that receives the events of the method. It is not called again after it has raised an exception,
        which becomes a warning.

    Returns
    -------
    SolvedProblem or Result
        For a control problem, and for a program that `transcribe` made, a `SolvedProblem`. It knows its control, tube
        and worst cases as functions of time (`ControlResult`), and it can be saved, drawn and used as a run. For any
        other program a `Result`, which nothing could check.

    Raises
    ------
    InputError
        If an argument is at fault.
    """
    deadline, registry = Deadline(as_seconds(seconds)), load_registry()
    given = problem.origin if isinstance(problem, SemiInfiniteProgram) else problem
    if isinstance(given, OptimalControlProblem | Transcription):
        deadline = _warn_unprovable(given if isinstance(given, OptimalControlProblem) else given.problem, deadline)
    model = _prepare_program(registry, problem, control, disturbance, policy)
    program = model if isinstance(model, SemiInfiniteProgram) else model.program
    if regulariser == "default":
        regulariser = None if program.lengths is None else "ridge"
    steps = continuation if isinstance(continuation, Continuation) else _check_continuation(continuation or {})
    tools = Tools(
        solver=_build_solver(registry, solver),
        maximiser=component(registry, "maximiser", maximiser, Maximiser),
        regulariser=None if regulariser is None else component(registry, "regulariser", regulariser, Regulariser),
        continuation=steps,
        budget=whole("budget", budget, 1),
        polish=None if polish is None else share("polish", polish),
        rng=np.random.default_rng(whole("seed", seed, 0)),
        notify=wrap_notify(notify),
        deadline=deadline,
    )
    chosen: Method = component(registry, "method", _add_tolerance(registry, method, tolerance), Method)
    require_suited(chosen, program)
    require_separable(program, tools.solver, tools.regulariser)
    result = solve_in_own_units(chosen, program, tools).accounted(tools.solver)
    if isinstance(model, SemiInfiniteProgram):
        return remarked_program(model, result)
    from sparserob_core.control.transcription.provable import add_assumptions
    from sparserob_core.experiment.run.conclusion.final_states import with_final_states
    from sparserob_core.experiment.run.outcome import SolveArguments, SolvedProblem

    result = with_final_states(model, result, getattr(chosen, "tolerance", None))
    result = add_assumptions(model, result)
    arguments = SolveArguments(
        problem=model.stated,
        choices={
            "method": _add_tolerance(registry, method, tolerance),
            "maximiser": maximiser,
            "solver": solver,
            "regulariser": regulariser,
            "policy": policy if model.policy is None else model.policy,
        },
        dictionaries=(
            {"control": model.control, "disturbance": model.disturbance}
            if isinstance(problem, SemiInfiniteProgram)
            else {
                "control": PIECES if control is None else control,
                **({} if disturbance is None else {"disturbance": disturbance}),
            }
        ),
        rest={
            "search": {"budget": tools.budget, "polish": tools.polish},
            "continuation": steps.model_dump(mode="json"),
            "limits": {"seconds": as_seconds(seconds)},
            "seed": int(seed),
        },
    )
    return SolvedProblem.asked(result, model, arguments)


def _warn_unprovable(problem: OptimalControlProblem, deadline: Deadline) -> Deadline:
    """Log a warning before anything is solved if no control of a problem can ever be certified.

    Returns the deadline, which is then bounded, so that the search for a witness ends.
    """
    from sparserob_core.control.transcription.provable import UNPROVABLE_SECONDS, announce, unprovable

    reason = unprovable(problem)
    if reason is None:
        return deadline
    logger.warning("no control of this problem can be certified: %s", announce(reason, deadline.bounded))
    return deadline if deadline.bounded else Deadline(UNPROVABLE_SECONDS)


def _get_name(choice: object) -> str:
    """Return the name of a component that was chosen: the name in the choice, or its class."""
    named = choice.get("name") if isinstance(choice, Mapping) else choice
    return named if isinstance(named, str) else type(choice).__name__


def _build_solver(registry: Registry, choice: object) -> Solver:
    """Return the chosen solver.

    A solver that is named is asked for every program; `Auto` answers those that it does not solve.
    """
    solver: Solver = component(registry, "solver", choice, Solver)
    return (
        solver if isinstance(solver, Auto) else named_solver(solver, _get_name(choice), registry.build("solver", AUTO))
    )


def _prepare_program(
    registry: Registry, problem: object, control: object, disturbance: object, policy: object
) -> SemiInfiniteProgram | Transcription:
    chosen: Policy = component(registry, "policy", policy, Policy)
    if isinstance(problem, SemiInfiniteProgram):
        if control is not None or disturbance is not None or chosen.knows:
            raise InputError(
                "control, disturbance, policy: these are for an OptimalControlProblem, got a SemiInfiniteProgram"
            )
        return problem.origin if isinstance(problem.origin, Transcription) else problem
    if not isinstance(problem, OptimalControlProblem):
        raise InputError(
            f"problem: expected an OptimalControlProblem or a SemiInfiniteProgram, got {type(problem).__name__}"
        )
    from sparserob_core.control.transcription.transcribe import prepare

    controls = dictionary(registry, PIECES if control is None else control, problem.horizon)
    disturbances = indicators(controls) if disturbance is None else dictionary(registry, disturbance, problem.horizon)
    return prepare(problem, controls, disturbances, policy=chosen)


def _check_continuation(given: Mapping[str, float]) -> Continuation:
    from pydantic import ValidationError

    from sparserob_core.experiment.plugins.messages import complaints

    try:
        return Continuation.model_validate(dict(given))
    except ValidationError as error:
        raise InputError("\n".join(f"continuation.{item}" for item in complaints(error, Continuation, given))) from None


def _add_tolerance(registry: Registry, method: object, tolerance: float | None) -> object:
    if isinstance(method, Method) or tolerance is None:
        return method
    entry = {"name": method} if isinstance(method, str) else method
    if not isinstance(entry, Mapping) or not isinstance(entry.get("name"), str):
        return entry
    takes_it = "tolerance" in registry.get("method", entry["name"]).options_type().model_fields
    return {"tolerance": tolerance, **entry} if takes_it else entry
