"""The part of a problem that a margin scales, a set or a window, as a function of one number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias, final

import numpy as np

from sparserob_core.control.problem.names import join_units
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.sets.sets import ConvexSet
from sparserob_core.errors import InputError
from sparserob_core.experiment.plugins.messages import nearest
from sparserob_core.sip.convex_set import Array

Sense: TypeAlias = Literal["largest", "smallest"]
LARGEST_FACTOR = 1e6  # the largest factor that is tried
MAX_UNCERTAIN = 1024.0  # the largest factor on a set of parameters, which changes the matrices
CONTROL = "factor on the control set"
MIN_WINDOW_SHARE = 1e-9  # share of a window that must remain where a control is held over several intervals in it
MIN_CURVED_FACTOR = 1e-6  # the factor that replaces 0 for a curved set, which must have an interior


@final
@dataclass(frozen=True, eq=False)
class Scaling:
    """A problem as a function of one factor.

    Parameters
    ----------
    of : str
        The part of the problem that changes.
    label : str
        The factor in words, for figures.
    sense : {"largest", "smallest"}
        The feasible factor that is searched.
    at : callable
        The problem at a factor. ``at(1)`` is the original problem, except for the start of a window.
    quantity : str
        The quantity that changes.
    amount : callable
        The amount of the quantity at a factor.
    affine : bool, default True
        Whether the right-hand sides and bounds of the program are affine in the factor, and nothing else depends on it.
    highest : float
        The end of the interval ``[0, highest]`` of factors.
    """

    of: str
    label: str
    sense: Sense
    at: Callable[[float], OptimalControlProblem]
    quantity: str
    amount: Callable[[float], float]
    affine: bool = True
    highest: float = LARGEST_FACTOR
    relative: bool = True
    """Whether the factor multiplies a quantity; otherwise it is itself an amount of ``quantity``: a time."""
    nested: bool = True
    """Whether a feasible factor implies that every smaller one (for the largest) or larger one (for the smallest) is
    feasible too."""
    cost_unit: str = ""
    """Unit of the cost, where the problem names one."""
    unit: str = ""
    """Unit of the quantity, where only some of the states, which have different units, determine it."""


def scaling(
    problem: OptimalControlProblem, of: str, members: Sequence[Sequence[int]], ends: Sequence[Sequence[int]]
) -> Scaling:
    """Return the scaling named ``of``.

    Parameters
    ----------
    problem : OptimalControlProblem
        The problem.
    of : str
        The part that changes.
    members, ends : sequence
        For every entry of ``path`` and of ``terminal`` in a config its positions in the problem.

    Returns
    -------
    Scaling
        The problem as a function of the factor.

    Raises
    ------
    InputError
        If the problem has no such part (the message has the most similar name), or the part cannot be scaled.
    """
    choices = dict(_list_choices(problem, members, ends))
    if of in choices:
        return _add_units(choices[of](), problem)
    absent = {
        "disturbance": problem.disturbance,
        "parameters": problem.system.parameters,
        "execution": problem.execution is not None,
        "control_step": problem.control_step,
        "terminal": problem.terminal,
        **problem.lists,
    }
    field = of.split(".", maxsplit=1)[0]
    if field in absent and not absent[field]:
        raise InputError(
            f"of: '{of}' cannot be varied, the problem has no {field}; expected one of {', '.join(sorted(choices))}"
        )
    raise InputError(f"of: expected what is to be varied, got '{of}'{nearest(of, {*choices, 'horizon'})}")


def _add_units(chosen: Scaling, problem: OptimalControlProblem) -> Scaling:
    """Return a scaling with the unit of its quantity, where the problem names a single one for it."""
    names = problem.names
    of_states = join_units(set(names.state_units)) if len(set(names.state_units)) == 1 else ""
    unit = {
        "disturbance": join_units(names.disturbance_units),
        "parameters": "",
        "control": join_units(names.control_units),
        "control_step": join_units(names.control_units),
        "execution": "",
        **dict.fromkeys(problem.sums, ""),
    }.get(chosen.of.split(".")[0], chosen.unit or of_states if chosen.relative else join_units([names.time])).strip()
    label = chosen.label.replace("[unit of time]", f"[{unit}]") if unit else chosen.label
    quantity = f"{chosen.quantity} [{unit}]" if unit else chosen.quantity
    return replace(chosen, label=label, quantity=quantity, cost_unit=problem.cost_unit)


def _list_choices(
    problem: OptimalControlProblem, members: Sequence[Sequence[int]], ends: Sequence[Sequence[int]]
) -> Iterator[tuple[str, Callable[[], Scaling]]]:
    if problem.disturbance is not None:
        label = "factor on the disturbance set"
        yield "disturbance", partial(_scale_set, problem, "disturbance", label, "largest", "largest |w_i|")
    if problem.system.parameters is not None:
        yield "parameters", partial(_scale_parameters, problem)
    yield "initial_state", partial(_scale_initial_state, problem)
    yield "control", partial(_scale_control, problem)
    if problem.control_step is not None:
        label = "factor on the steps of the control"
        yield (
            "control_step",
            partial(_scale_set, problem, "control_step", label, "smallest", "largest step of a control"),
        )
    if problem.execution is not None:
        yield "execution", partial(_scale_execution, problem)
    of_sums = {name: [[i] for i in range(len(entries))] for name, entries in problem.sums.items()}
    for name, places in {"path": members, **of_sums, "terminal": ends}.items():
        for of, positions in ((f"{name}.{i}", positions) for i, positions in enumerate(places) if positions):
            yield of, partial(_scale_constraints, problem, name, of, positions)
            if name == "path":
                yield f"{of}.from", partial(_shift_window, problem, of, positions)


def _scale_set(problem: OptimalControlProblem, of: str, label: str, sense: Sense, quantity: str) -> Scaling:
    """Return the scaling of a set, the field ``of`` of the problem."""
    resized = _make_scaler(of, getattr(problem, of))
    return Scaling(
        of, label, sense, lambda f: replace(problem, **{of: resized(f)}), quantity, lambda f: _compute_reach(resized(f))
    )


def _scale_constraints(problem: OptimalControlProblem, field: str, of: str, positions: Sequence[int]) -> Scaling:
    """Return the scaling of the constraints of a list of the problem that come from one entry of a config."""
    entries = list(getattr(problem, field))
    resized = {i: _make_scaler(of, entries[i]) for i in positions}

    def at(factor: float) -> OptimalControlProblem:
        scaled: Any = [resized[i](factor) if i in resized else entry for i, entry in enumerate(entries)]
        return replace(problem, **{field: scaled})

    width = max(_compute_half_width(_get_bounds(entries[i])) for i in positions)
    kind = "bounds" if field in problem.sums else "set"
    return Scaling(of, f"factor on the {kind} {of}", "smallest", at, "largest half-width", _multiply_by(width))


def _scale_parameters(problem: OptimalControlProblem) -> Scaling:
    bound, system = problem.system.parameters, problem.system
    assert bound is not None
    resized = _make_scaler("parameters", bound)
    return Scaling(
        "parameters",
        "factor on the set of parameters",
        "largest",
        lambda f: replace(problem, system=system.with_parameters(resized(f))),
        "largest half-width of a parameter",
        _multiply_by(_compute_half_width(bound)),
        affine=False,
        highest=MAX_UNCERTAIN,
    )


def _scale_initial_state(problem: OptimalControlProblem) -> Scaling:
    """Return the scaling of the set of deviations about the centre, or of the initial state where there is no set."""
    bound = problem.initial_set
    if problem.repeat:
        raise InputError(
            "of: initial_state is where a plan that repeats ends too, so that no factor is the largest; expected"
            " another thing to vary"
        )
    if bound is not None:
        ones, reach = np.ones(bound.dimension), bound.reach(np.eye(bound.dimension))
        return Scaling(
            "initial_state",
            "factor on the set of initial states",
            "largest",
            # scaled about the centre, which is the deviation 0, not about the middle of the deviations
            lambda f: replace(problem, initial_set=bound.in_units(ones / f) if f > 0.0 else None),
            "largest deviation of x_i(0)",
            _multiply_by(float(reach.max())),
            unit=_find_unit(problem, reach),
        )
    state = np.asarray(problem.initial_state, dtype=float)
    if not state.any():
        raise InputError("of: initial_state is the origin, which no factor moves; expected a state that is not 0")
    return Scaling(
        "initial_state",
        "factor on the initial state",
        "largest",
        lambda f: replace(problem, initial_state=f * state),
        "largest |x_i(0)|",
        _multiply_by(float(np.abs(state).max())),
        nested=False,
        unit=_find_unit(problem, np.abs(state)),
    )


def _find_unit(problem: OptimalControlProblem, sizes: Array) -> str:
    """Return the unit of the states with the largest of the ``sizes (d,)``, where they have the same one."""
    names, states = problem.names.state_units, np.flatnonzero(sizes == sizes.max()).tolist()
    units = {names[state] for state in states if names}
    return units.pop() if len(units) == 1 else ""


def _scale_control(problem: OptimalControlProblem) -> Scaling:
    paths = problem.windows
    named = [i for i, entry in enumerate(paths) if entry.name == "control"]
    if named:  # where the rate is the input, the bounds of the control are constraints of the augmented state
        return replace(_scale_constraints(problem, "path", "control", named), label=CONTROL)
    return _scale_set(problem, "control", CONTROL, "smallest", "largest |u_i|")


def _scale_execution(problem: OptimalControlProblem) -> Scaling:
    shares = np.atleast_1d(np.asarray(problem.execution, dtype=float))
    largest = float(shares.max())
    return Scaling(
        "execution",
        "factor on the errors of execution",
        "largest",
        lambda f: replace(problem, execution=np.minimum(f * shares, 1.0)),
        "largest share of a command",
        _multiply_by(largest),
        affine=False,  # the factor multiplies the sizes of the decision
        highest=1.0 / largest,
    )


def _shift_window(problem: OptimalControlProblem, path: str, positions: Sequence[int]) -> Scaling:
    paths = problem.windows
    latest = min(problem.horizon if paths[i].stop is None else float(paths[i].stop or 0.0) for i in positions)
    if any(paths[i].lasting for i in positions):
        latest *= 1.0 - MIN_WINDOW_SHARE
    for i in positions:
        rows = paths[i].relative_to
        if rows is not None and np.asarray(rows)[0, 0] > 0.0:
            raise InputError(
                f"of: {path}.from is varied from 0 on, relative_to begins at {np.asarray(rows)[0, 0]:g}; expected rows"
                " that say where the set is from time 0 on"
            )
    return Scaling(
        f"{path}.from",
        f"start of the window of {path} [unit of time]",
        "smallest",
        lambda start: replace(
            problem, path=[replace(entry, start=start) if i in positions else entry for i, entry in enumerate(paths)]
        ),
        "start of the window",
        _multiply_by(1.0),
        affine=False,
        relative=False,
        highest=latest,
    )


def _get_bounds(value: Any) -> ConvexSet:
    """Return a set, or the set of a constraint."""
    bounds: ConvexSet = getattr(value, "bounds", value)
    return bounds


def _make_scaler(of: str, value: Any) -> Callable[[float], Any]:
    """Return a function that scales a set, or a constraint, by a factor about its middle.

    A curved set stays curved, however small the factor. Raises `InputError` for a single point, and for a set without a
    middle.
    """
    try:
        bound = _get_bounds(value)
    except InputError as error:
        raise InputError(f"of: {of} {error.sentence}") from None
    try:
        middle = bound.middle()
    except InputError as error:
        raise InputError(
            f"of: {of} has no centre to be enlarged about: it is free on a side, and 0 is outside of it; give it"
            " bounds on both sides"
        ) from error
    reach = bound.support(np.vstack([np.eye(bound.dimension), -np.eye(bound.dimension)]))
    if not (np.isinf(reach) | (reach != np.concatenate([middle, -middle]))).any():
        raise InputError(f"of: {of} is a single point, which no factor enlarges; expected a set with an extent")
    least = 0.0 if bound.halfspaces() is not None else MIN_CURVED_FACTOR
    return lambda factor: value.scaled(max(factor, least))


def _compute_reach(bound: ConvexSet) -> float:
    return float(bound.reach(np.eye(bound.dimension)).max())


def _multiply_by(base: float) -> Callable[[float], float]:
    return lambda factor: factor * base


def _compute_half_width(bound: ConvexSet) -> float:
    """Return half the width of the widest bounded side.

    It is the largest bound where a set is free on one side of every coordinate.
    """
    axes = np.eye(bound.dimension)
    sides = np.stack([bound.support(axes), bound.support(-axes)])
    widths = sides.mean(axis=0)
    return (
        float(widths[np.isfinite(widths)].max(initial=0.0))
        or float(np.abs(sides[np.isfinite(sides)]).max(initial=0.0))
        or 1.0
    )
