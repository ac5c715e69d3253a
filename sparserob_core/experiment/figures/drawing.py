"""From a solved experiment to its figures: the nominal trajectory, the worst-case tube around it, and what constrains
them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem, PathConstraint
from sparserob_core.control.sets.sets import Equality
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import ControlExperiment, Experiment
from sparserob_core.experiment.directory.sparsity import sparsity
from sparserob_core.experiment.figures.figure_data import FigureData, Wall
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.events import RoundFinished

TIMES = 400
PARAMETERS = 27


def draw_experiment(
    experiment: Experiment,
    theta: Array,
    active_times: Array,
    history: Sequence[RoundFinished],
    directory: Path,
    cost: float | None,
    worst: Mapping[str, Array],
) -> list[Path]:
    """Draw the figures of a decision ``theta (m, N)`` into ``directory/figures``; raises `InputError` when there is
    nothing to draw.

    ``worst``: the arrays of `adversaries`, empty when there is no constraint to be driven against.
    """
    from sparserob_core.experiment.figures.adversary_figure import write_adversary
    from sparserob_core.experiment.figures.run_figures import write_figures

    data = figure_data(experiment, theta, active_times, history, cost)
    files = write_figures(directory / "figures", data)
    if worst:
        files += write_adversary(directory / "figures" / "adversary", worst, data)
    return files


def figure_data(
    experiment: Experiment, theta: Array, active_times: Array, history: Sequence[RoundFinished], cost: float | None
) -> FigureData:
    """What figures of a decision ``theta (m, N)`` show; raises `InputError` when the program is no control problem."""
    if not isinstance(experiment, ControlExperiment):
        raise InputError("figures: they are for control problems; this is a semi-infinite program of another kind")
    return _data(experiment, theta, active_times, history, cost)


def active_times(solution: Mapping[str, Array]) -> Array:
    """The times of the imposed constraints that carry a multiplier, from ``solution.npz``; none where it has none."""
    if not {"times", "multipliers"} <= set(solution):
        return np.empty(0)
    return np.unique(solution["times"][solution["multipliers"] > 0])


def _data(
    experiment: ControlExperiment,
    theta: Array,
    active_times: Array,
    history: Sequence[RoundFinished],
    cost: float | None,
) -> FigureData:
    problem, model = experiment.problem, experiment.transcription
    control, dictionary = model.pieces(theta), model.control
    axes = np.eye(problem.system.controls)
    shown = _shown(model.response.grid.breakpoints.size)
    tolerance = experiment.loaded.config.method.options.get("tolerance")
    state, lower, upper = _tube(model, control, shown)
    return FigureData(
        title=printable(experiment.title),
        breakpoints=dictionary.breakpoints,
        control=control,
        control_lower=-problem.control.support(-axes),
        control_upper=problem.control.support(axes),
        times=model.response.grid.breakpoints[shown],
        state=state,
        tube_lower=lower,
        tube_upper=upper,
        walls=list(_walls(problem)),
        active_times=active_times,
        history=history,
        cost_scale=experiment.program.cost_scale,
        active_fraction=sparsity(control, dictionary.breakpoints).active_fraction,
        cost=cost,
        names=problem.names,
        tolerance=tolerance if isinstance(tolerance, float) else None,
    )


def _shown(count: int) -> np.ndarray[Any, np.dtype[np.intp]]:
    return np.unique(np.linspace(0, count - 1, min(count, TIMES + 1)).round().astype(int))


def _tube(
    model: Transcription, control: Array, shown: np.ndarray[Any, np.dtype[np.intp]]
) -> tuple[Array, Array, Array]:
    """Nominal state and worst case from both sides, ``(d, T)`` each, over a lattice of parameters."""
    lattice, _ = model.parameters.lattice()
    if model.functionals.disturbance is not None and len(lattice) > PARAMETERS:
        lattice = lattice[np.unique(np.linspace(0, len(lattice) - 1, PARAMETERS).round().astype(int))]
    paths = model.response.states(control, lattice)[:, shown]
    count, instants, states = paths.shape
    times = np.tile(model.response.grid.breakpoints[shown], count)
    at = np.repeat(lattice, instants, axis=0)
    lower, upper = np.empty((states, instants)), np.empty((states, instants))
    for state in range(states):
        direction = np.tile(np.eye(states)[state], (times.size, 1))
        above, below = (
            model.functionals.offsets(times, side * direction, at).reshape(count, instants) for side in (1.0, -1.0)
        )
        upper[state] = (paths[:, :, state] + above).max(axis=0)
        lower[state] = (paths[:, :, state] - below).min(axis=0)
    return paths[len(lattice) // 2].T, lower, upper


def _walls(problem: OptimalControlProblem) -> Iterator[Wall]:
    end = problem.horizon
    for entry in problem.path:
        if isinstance(entry, PathConstraint):
            yield from _sides(entry.set, entry.start, end if entry.stop is None else entry.stop)
    for terminal in problem.terminal:
        if isinstance(terminal, Equality):
            yield from (
                Wall(
                    state=int(state),
                    lower=float(terminal.values[state]),
                    upper=float(terminal.values[state]),
                    start=end,
                    end=end,
                )
                for state in terminal.fixed
            )
        else:
            yield from _sides(terminal, end, end)


def _sides(bounds: ConvexSet, start: float, end: float) -> Iterator[Wall]:
    axes = np.eye(bounds.dimension)
    for state, (lower, upper) in enumerate(zip(-bounds.support(-axes), bounds.support(axes), strict=True)):
        if np.isfinite(lower) or np.isfinite(upper):
            yield Wall(state=state, lower=float(lower), upper=float(upper), start=start, end=end)
