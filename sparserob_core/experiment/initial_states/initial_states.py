"""The set of feasible initial states of an experiment, in the plane of two of its states, with the cost from each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sparserob_core.arguments import whole
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units
from sparserob_core.control.response.reference import Reference
from sparserob_core.control.studies.initial_states import InitialPlane, check_states
from sparserob_core.control.transcription.own_units import walls
from sparserob_core.control.transcription.transcribe import from_state, in_own_units
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import assemble, tools_of, transcribed_by
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.initial_states.feasible_set import ON_EDGE, InitialStates
from sparserob_core.experiment.initial_states.search import InitialStatesSearch
from sparserob_core.experiment.initial_states.section import section
from sparserob_core.experiment.run.given import GivenConfig, as_config
from sparserob_core.experiment.study.kit import open_study, write_study
from sparserob_core.quantities import Unit, in_units
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.method import GAP_TOLERANCE

__all__ = ["InitialStates", "initial_states"]
UNBOUNDED = 1e4  # times the numbers in the problem: a coordinate that may be as large as this is called unbounded
THINNEST = 1e-10  # of the first box, and of the walls of the problem: a coordinate without interior


def initial_states(
    config: GivenConfig,
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    states: Sequence[int] = (0, 1),
    *,
    directions: int = 32,
    values: int = 15,
    about: Sequence[float] | None = None,
    within: float | None = None,
    out: str | Path | None = None,
    notify: Notify = ignore,
) -> InitialStates:
    """The initial states from which an experiment is feasible: what ``sparserob initial-states CONFIG key=value ...``
    does.

    ``states``: the two coordinates that are free, counted from 0; the others are those of the config's initial state,
    or of ``about (d,)``. ``directions``: support functions asked for at most, at least 4. ``values``: costs are
    measured on a lattice of so many points each way, 0 for none. ``within``: only coordinates of at most this size are
    looked at; needed where the set is unbounded. ``out``: a new or empty directory for the config,
    ``initial_states.json``, ``.npz`` and ``.png``. With ``policy: affine`` they are those from which an affine policy
    satisfies every constraint. ``notify`` receives `StudyProgress`. An interrupt, and the limit
    ``limits.seconds`` of the config, end the search with what it has proven by then. Raises
    `InputError` when an argument or the config is at fault, and when the set is unbounded.
    """
    from sparserob_core.experiment.initial_states.figure import draw_initial_states

    whole("directions", directions, 4)
    whole("values", values, 0)
    limit = _check_limit(within)
    loaded = load_config(as_config(config), overrides)
    tools = tools_of(loaded)
    experiment = assemble(loaded, tools.deadline).of_control(
        "problem: expected a control problem, which has an initial state"
    )
    model = experiment.transcription
    if model.problem.repeat:
        raise InputError(
            path="problem.repeat",
            expected="false, since a plan that repeats ends among its initial states, and not from elsewhere",
            got="true",
        )
    if about is not None:
        added_states = np.asarray(model.problem.initial_state, dtype=float)[model.stated.system.states :]
        model = from_state(model, np.append(_check_about(about, model.stated), added_states))
    pair = check_states(states, model.stated.system.states)
    with transcribed_by(tools.deadline):
        own, units = in_own_units(model)  # what is looked at and what is told are in other units (docs/decisions/0016)
    x = units.states[list(pair)]
    size = np.full(2, _choose_largest_size(own.problem)) if limit is None else limit / x
    least = THINNEST * size * np.minimum(1.0, walls(own.problem)[list(pair)])
    plane = InitialPlane(own, pair, np.zeros(2), size)
    search = InitialStatesSearch(plane, tools, _get_tolerance(loaded), notify, least, x, limit is not None)

    heading = "The experiment whose feasible initial states were sought."
    with open_study(loaded, out, heading, "", write=False) as directory:
        feasible_set = search.states(experiment.title, directions, values)
        feasible_set = replace(feasible_set, path=_intersect_path_sets(own.problem, feasible_set))
        result = _convert_to_user_units(feasible_set, units, limit)
        if directory is None:
            return result
        draw = draw_initial_states if result.outer.shape[0] else None
        arrays = {"initial_states.npz": result.arrays()}
        return write_study(directory, "initial_states", result, draw, arrays=arrays)


def _convert_to_user_units(own: InitialStates, units: Units, limit: float | None) -> InitialStates:
    """Convert results from the problem's own units to the user's units; ``limit`` is the bound that the user gave."""
    x = units.states[list(own.states)]
    norms = np.linalg.norm(own.directions / x, axis=1)
    measured: dict[str, Unit] = {
        "plane": x,
        "states": units.states,
        "controls": units.controls[:, None],
        "gains": lambda gains: gains * units.controls[:, None] / units.states,
        "normals": lambda normals: normals / x / norms[:, None],
        "bounds": lambda bounds: bounds / norms,
        "cost": units.cost,
    }
    result = in_units(own, measured)
    is_cut = limit is not None and bool((np.abs(result.outer) >= limit * (1.0 - ON_EDGE)).any())
    return replace(result, limit=limit, cut=is_cut)


def _check_limit(within: object) -> float | None:
    if within is None:
        return None
    if (
        isinstance(within, bool)
        or not isinstance(within, int | float | np.integer | np.floating)
        or not 0.0 < within < np.inf
    ):
        raise InputError(f"within: expected a positive number, got {within!r}")
    return float(within)


def _choose_largest_size(problem: OptimalControlProblem) -> float:
    """A size beyond which a coordinate counts as unbounded."""
    halfspaces = [entry.set.halfspaces() for entry in problem.of_states]
    halfspaces += [end.halfspaces() for end in problem.terminal_sets]
    sizes = [
        float((np.abs(h) / np.linalg.norm(H, axis=1)).max())
        for H, h in (sides for sides in halfspaces if sides is not None)
        if h.size
    ]
    references = [entry.relative_to for entry in problem.of_states]
    sizes += [float(np.abs(np.asarray(rows)[:, 1:]).max()) for rows in references if rows is not None]
    sizes += [float(np.abs(end.values[end.fixed]).max()) for end in problem.terminal_equalities]
    return UNBOUNDED * max([1.0, float(np.abs(np.asarray(problem.initial_state)).max()), *sizes])


def _check_about(about: Sequence[float], problem: OptimalControlProblem) -> Array:
    try:
        state = np.asarray(about, dtype=float)
    except (TypeError, ValueError):
        state = np.zeros(0)
    if state.shape != (problem.system.states,) or not np.isfinite(state).all():
        raise InputError(f"about: expected {problem.system.states} finite numbers, one per state, got {about!r}")
    return state


def _get_tolerance(loaded: Loaded) -> float:
    """The relative gap that the config asks for, where its method has one."""
    return float(loaded.config.method.options.get("tolerance") or GAP_TOLERANCE)


def _intersect_path_sets(problem: OptimalControlProblem, found: InitialStates) -> tuple[Array, ...]:
    """The sections of the path sets that hold at time 0."""
    if not found.outer.shape[0]:
        return ()
    middle = (found.inner if found.inner.shape[0] else found.outer).mean(axis=0)
    constraints = [entry for entry in problem.of_states if entry.start == 0.0]
    view, states, polygons = 10.0 * float(np.abs(found.outer - middle).max()), list(found.states), []
    for entry in constraints:
        offset = Reference.of(entry.relative_to).along(np.zeros(1), np.eye(found.origin.size))[0]
        polygon = section(entry.set, found.origin - offset, found.states, middle - offset[states], view)
        polygons.append(polygon + offset[states])
    return tuple(polygons)
