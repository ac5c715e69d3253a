"""The worst case of every constraint family of a run, as arrays for figures and replays: ``adversary.npz``."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from sparserob_core.control.response.response import Response
from sparserob_core.control.studies.adversary import Adversary, find_adversaries
from sparserob_core.control.studies.simulate import (
    deliver_control,
    fine_times,
    refine_grid,
    simulate_states,
    worst_errors,
)
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import Experiment
from sparserob_core.experiment.config.matrices.arrays import read_arrays
from sparserob_core.sip.convex_set import Array

FILE = "adversary.npz"
SHAPES = {
    "names": "f",
    "rows": "f",
    "times": "f",
    "directions": "fd",
    "bounds": "f",
    "parameters": "fp",
    "violations": "f",
    "breakpoints": "b",
    "disturbances": "fwl",
    "initial_states": "fd",
}


def adversaries(experiment: Experiment, decision: Array) -> dict[str, Array]:
    """Return the worst parameter, disturbance and initial state of every path and terminal constraint at a decision.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    decision : array (m N,) or (m, N)
        The decision.

    Returns
    -------
    dict of arrays
        The arrays of ``adversary.npz``, with one row per family ``f``: ``names``, ``rows`` (the side; 0 for a curved
        set), ``times``, ``directions (f, d)``, ``bounds`` and ``violations``, where ``direction'x(time) - bound =
        violation`` (negative: a margin). Further ``parameters (f, nu)``, ``initial_states (f, d)``, and ``disturbances
        (f, mw, L)``, constant between the common ``breakpoints (L + 1,)``. Where outputs are measured with a noise
        ``noises (f, K, p)``. The states that they cause are ``states (f, d, T)`` at ``state_times (T,)``. Empty for a
        program that is no control problem, or has no state constraint.
    """
    model, theta = experiment.model, np.asarray(decision, dtype=float).ravel()
    if model is None or not (kept := find_adversaries(model, theta)):
        return {}
    arrays = _stack_adversaries(kept, model)
    times, states = propagated(model, theta, arrays)
    return {**arrays, "state_times": times, "states": states}


def propagated(model: Transcription, theta: Array, arrays: Mapping[str, Array]) -> tuple[Array, Array]:
    """Return the state trajectories that stored adversaries cause at a decision.

    Parameters
    ----------
    model : Transcription
        The problem on its dictionaries.
    theta : array (m N,)
        The decision.
    arrays : mapping
        The arrays of `adversaries`.

    Returns
    -------
    times : array (T,)
        The times, with those of the adversaries among them.
    states : array (f, d, T)
        The trajectories.
    """
    response = model.response
    breakpoints = arrays["breakpoints"]
    grid = response.grid.refined(breakpoints)
    times = fine_times(Response(response.system, grid, response.initial_state), model.parameters, arrays["times"])
    fine_response = Response(response.system, refine_grid(grid, times), response.initial_state)
    disturbances = arrays["disturbances"] if arrays["disturbances"].shape[1] else None
    noises = arrays["noises"].transpose(1, 2, 0) if "noises" in arrays else None
    acting, initial_states = controlled(model, theta, grid.control_piece, noises), arrays["initial_states"]
    if model.functionals.execution is not None and not callable(acting):
        fine_grid = refine_grid(grid, times)  # an error of execution may change its sign within a piece
        command = acting[:, fine_grid.control_piece]
        deviations = model.functionals.bound_execution_errors(model.nominal(theta))
        sizes = deviations[:, grid.control_piece][:, fine_grid.control_piece]
        inner_response = Response(response.system, fine_grid, response.initial_state)
        fine_response = Response(response.system, refine_grid(fine_grid, times), response.initial_state)
        worst_cases = (arrays["times"], arrays["directions"], arrays["parameters"])
        acting = deliver_control(command, worst_errors(inner_response, sizes, worst_cases))
        disturbances = None if disturbances is None else disturbances[:, :, fine_grid.disturbance_piece]
    states = np.stack(list(simulate_states(fine_response, acting, arrays["parameters"], disturbances, initial_states)))
    return times, np.ascontiguousarray(states.transpose(2, 1, 0))


def controlled(
    model: Transcription, decision: Array, which: np.ndarray, noises: Array | None = None
) -> Array | Callable[[int, Array], Array]:
    """Return the control at a decision, in the form in which `simulate_states` takes it.

    Parameters
    ----------
    model : Transcription
        The problem on its dictionaries.
    decision : array
        The decision.
    which : array of int
        For each piece of the simulation the piece of the grid that contains it.
    noises : array (K, p, n), optional
        The noises of the measurements.

    Returns
    -------
    array (m, pieces) or callable
        The inputs, or under feedback a function of the piece and the states.
    """
    if model.feedback is None:
        return model.functionals.on_grid(model.nominal(decision))[:, which]
    from sparserob_core.control.studies.measuring import Measuring

    measuring, latest = Measuring.of(model, decision, noises), (-1, np.zeros(0))

    def acting(piece: int, state: Array) -> Array:
        nonlocal latest
        if int(which[piece]) != latest[0] or piece == 0:
            latest = (int(which[piece]), measuring(int(which[piece]), state))
        return latest[1]

    return acting


def attained(arrays: Mapping[str, Array], times: Array, states: Array) -> Array:
    """Return the violations ``(f,)`` that the replayed ``states (f, d, T)`` reach at the adversaries' times and
    directions."""
    nearest = np.abs(times[None] - arrays["times"][:, None]).argmin(axis=1)
    attained_states = states[np.arange(nearest.size), :, nearest]
    return np.asarray((arrays["directions"] * attained_states).sum(axis=1) - arrays["bounds"])


def read_adversaries(directory: Path, model: Transcription) -> dict[str, Array]:
    """Return the adversaries that a run has stored, or none; raises `InputError` where the file does not fit
    the run."""
    file = directory / FILE
    arrays = read_arrays(file)
    if not arrays:
        return {}
    if "names" in arrays and "initial_states" not in arrays and model.problem.initial_set is None:
        # an earlier version wrote this file, when there was one initial state only
        arrays = {**arrays, "initial_states": np.tile(model.response.initial_state, (arrays["names"].size, 1))}
    _require_shapes(file, arrays, model)
    names = [constraint.name for constraint in model.constraints if constraint.name in arrays["names"]]
    if arrays["names"].tolist() != names:
        raise InputError(f"{file}: names: expected constraints of the run, got {', '.join(map(str, arrays['names']))}")
    breakpoints, times = arrays["breakpoints"], arrays["times"]
    missing = [
        time for time in model.response.grid.breakpoints if np.abs(breakpoints - time).min() > 1e-9 * breakpoints[-1]
    ]
    if (
        breakpoints[0] != 0.0
        or (np.diff(breakpoints) <= 0).any()
        or missing
        or (times < 0).any()
        or (times > breakpoints[-1]).any()
    ):
        raise InputError(
            f"{file}: breakpoints, times: expected those of the run's grid, from 0 to {model.problem.horizon:g}"
        )
    return arrays


def _require_shapes(file: Path, arrays: Mapping[str, Array], model: Transcription) -> None:
    system = model.response.system
    missing = [name for name in SHAPES if name not in arrays]
    if missing:
        raise InputError(f"{file}: expected the arrays {', '.join(SHAPES)}, got none called {', '.join(missing)}")
    sizes = {
        "f": arrays["names"].size,
        "d": system.states,
        "p": system.parameter_count,
        "b": arrays["breakpoints"].size,
        "l": arrays["breakpoints"].size - 1,
        "w": 0 if model.functionals.disturbance is None else system.disturbances,
    }
    for name, letters in SHAPES.items():
        shape = tuple(sizes[letter] for letter in letters)
        numbers = name == "names" or (arrays[name].dtype.kind in "fi" and bool(np.isfinite(arrays[name]).all()))
        if arrays[name].shape != shape or not numbers:
            raise InputError(
                f"{file}: {name}: expected finite numbers of shape {shape}, got shape {arrays[name].shape}"
            )
    if model.noise is not None:
        shape = (sizes["f"], model.control.pieces, model.noise.dimension)
        noises = arrays.get("noises", np.zeros(0))
        if noises.shape != shape or noises.dtype.kind != "f" or not np.isfinite(noises).all():
            raise InputError(f"{file}: noises: expected finite numbers of shape {shape}, got shape {noises.shape}")


def _stack_adversaries(found: Sequence[Adversary], model: Transcription) -> dict[str, Array]:
    """Return the arrays of adversaries, one row each, on the union of their breakpoints."""
    points = np.unique(np.concatenate([adversary.breakpoints for adversary in found]))
    middles = (points[:-1] + points[1:]) / 2
    channels = 0 if model.functionals.disturbance is None else model.response.system.disturbances
    disturbances = np.zeros((len(found), channels, middles.size))
    for position, adversary in enumerate(found):
        if adversary.disturbance is not None:
            disturbances[position] = adversary.disturbance[:, np.searchsorted(adversary.breakpoints, middles) - 1]
    return {
        "names": np.array([adversary.name for adversary in found]),
        "rows": np.array([adversary.row for adversary in found]),
        "times": np.array([adversary.time for adversary in found]),
        "directions": np.array([adversary.direction for adversary in found]),
        "bounds": np.array([adversary.bound for adversary in found]),
        "violations": np.array([adversary.violation for adversary in found]),
        "parameters": np.array([adversary.parameter for adversary in found]),
        "breakpoints": points,
        "disturbances": disturbances,
        "initial_states": np.array([adversary.initial_state for adversary in found]),
        **(
            {"noises": np.array(noises)}
            if (noises := [adversary.noise for adversary in found if adversary.noise is not None])
            else {}
        ),
    }
