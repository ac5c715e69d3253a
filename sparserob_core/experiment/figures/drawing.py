"""Data for the figures of a solved experiment: the nominal trajectory, the worst-case tube around it, and the
constraints on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sparserob_core.control.feedback.closed_loop import ClosedLoop
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.integral import Accumulated
from sparserob_core.control.problem.terms.windows import PathConstraint
from sparserob_core.control.response.reference import Reference
from sparserob_core.control.studies.adversary import find_adversaries
from sparserob_core.control.studies.answer import Tube, supports, tube
from sparserob_core.control.transcription.record import Transcription
from sparserob_core.experiment.assemble import ControlExperiment, Experiment, counting
from sparserob_core.experiment.directory.sparsity import sparsity
from sparserob_core.experiment.figures.active import Active, stored_active
from sparserob_core.experiment.figures.figure_data import (
    MAX_STATES,
    FigureData,
    MeasuredOutputs,
    Wall,
    plain,
    telling,
)
from sparserob_core.experiment.figures.plane import Limit, Plane
from sparserob_core.experiment.terminal.printing import printable
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.events import RoundFinished

if TYPE_CHECKING:
    from sparserob_core.experiment.directory.finished import FinishedRun

MAX_DRAWN_TIMES = 400  # drawn at most
MIN_DRAWN_TIMES = 200  # drawn at least, about
# Times at which it is told which states move far: with 2 a state that comes back seems to rest; with 60 the
SAMPLED_TIMES = 6
# figures of 270 states take longer than their control
QUANTILE_DRAWS = 2000  # of which the quantiles of the control are drawn
# Of the polygon around every place, which reaches 0.2 % beyond a disc, and 3 % of its length beside a
POLYGON_CORNERS = 48
# segment: with a tenth a path is twice as wide as it is; ten times takes seconds and looks the same
TIMES_OF_MOVING_SIDE = 33  # times of a window at which a side that moves is drawn
QUANTILES = (0.05, 0.5, 0.95)


def figure_data(
    experiment: Experiment,
    theta: Array,
    active: Active | None,
    history: Sequence[RoundFinished],
    cost: float | None,
    draws: int = 0,
    status: str = "",
    states: Sequence[int] | None = None,
) -> FigureData:
    """Return the data for the figures of a decision.

    Parameters
    ----------
    experiment : Experiment
        A control problem with its program.
    theta : array, (m, N), or the whole decision
        Coefficients of the control.
    active : Active, optional
        Times of the active constraints.
    history : sequence of RoundFinished
        Rounds of the method.
    cost : float, optional
        Cost of the decision.
    draws : int
        Number of random disturbances under which the control is shown, together with the worst one; feedback only.
    status : str
        Status of the result. The title says so where the status claims no proof.
    states : sequence of int, optional
        States to be shown; all by default.

    Returns
    -------
    FigureData
        The data of all figures.

    Raises
    ------
    InputError
        When the program is no control problem.
    """
    data = _collect_data(
        experiment.of_control("figures: expected a control problem"), theta, active, history, cost, draws, states
    )
    unproven = f"{data.title}: {status}, not proven" if status not in ("", "certified", "verified") else data.title
    return replace(data, title=unproven)


def stored_figure_data(finished: FinishedRun) -> FigureData:
    """Return the data for figures of the decision of a finished run."""
    active = stored_active(finished.experiment.transcription, finished.solution)
    status = str(finished.summary["status"])
    return figure_data(finished.experiment, finished.decision, active, (), None, status=status)


def _collect_data(
    experiment: ControlExperiment,
    theta: Array,
    active: Active | None,
    history: Sequence[RoundFinished],
    cost: float | None,
    draws: int,
    states: Sequence[int] | None,
) -> FigureData:
    problem, model, program = experiment.problem, experiment.transcription, experiment.program
    control, dictionary = model.pieces(theta), model.control
    axes = np.eye(problem.system.controls)
    tolerance = experiment.loaded.config.method.options.get("tolerance")
    decision, times = np.ravel(theta), _choose_times(model.response.grid.breakpoints)
    states = problem.names.corners.own(problem.system.states) if states is None else states
    around = _compute_tube(model, decision, times, states)
    answered = {} if model.feedback is None else _collect_feedback_data(model, decision, times, draws, states)
    longest = 0.0 if program.activity is None else float(program.activity.sum())
    counts = counting(experiment.loaded)[0] and longest > 0.0
    return FigureData(
        title=plain(experiment.title),
        breakpoints=dictionary.breakpoints,
        control=control,
        control_lower=-problem.control.support(-axes),
        control_upper=problem.control.support(axes),
        times=around.times,
        state=around.nominal,
        tube_lower=around.lower,
        tube_upper=around.upper,
        walls=list(_list_walls(model)),
        active=active or Active(),
        history=history,
        cost_scale=program.added(decision) if decision.size == program.n and not counts else 0.0,
        counts=counts,
        cost_of="" if counts else problem.cost.words(),
        cost_unit=problem.names.time if counts else problem.cost_unit,
        active_fraction=sparsity(control, dictionary.breakpoints).active_fraction,
        cost=cost,
        names=problem.names,
        plane=_project_onto_plane(model, decision, around.times),
        tolerance=tolerance if isinstance(tolerance, float) else None,
        **answered,
    )


def choose_states(experiment: Experiment, theta: Array) -> Sequence[int] | None:
    """Return the states that figures show, chosen by their ranges at a few times where there are very many;
    ``None`` for all."""
    model = experiment.model
    if model is None or model.problem.system.states <= MAX_STATES:
        return None
    problem, own_states = model.problem, model.problem.names.corners.own(model.problem.system.states)
    if len(own_states) <= MAX_STATES:
        return own_states
    rough_tube = _compute_tube(model, np.ravel(theta), np.linspace(0.0, problem.horizon, SAMPLED_TIMES), own_states)
    reach = rough_tube.upper.max(axis=1) - rough_tube.lower.min(axis=1)
    return sorted({*telling(reach, [*_list_walls(model)])[:MAX_STATES], *(problem.names.in_plane or ())})


def _compute_tube(model: Transcription, decision: Array, times: Array, states: Sequence[int]) -> Tube:
    """The tube of the ``states`` that are named, in rows of all of them; NaN stands in the others."""
    named_tube, rows = (
        tube(model, decision, times, states),
        np.full((3, model.problem.system.states, times.size), np.nan),
    )
    rows[:, states] = named_tube.nominal, named_tube.lower, named_tube.upper
    return Tube(times, *rows)


def _collect_feedback_data(
    model: Transcription, decision: Array, times: Array, draws: int, states: Sequence[int]
) -> dict[str, Any]:
    """Return the additional data of figures under feedback.

    These are the tube of the nominal control or of the inner loop alone, the extremes of the control under the
    disturbance, the gains and the outputs. With ``draws`` there are also the effort under so many random disturbances
    and the terms of the control in the worst case.
    """
    loop, nominal_tube = (
        model.answering.loop,
        _compute_tube(replace(model, feedback=None), model.nominal(decision), times, states),
    )
    nominal, effects = loop.nominal(decision), loop.effects(decision)
    return {
        "alone": model.response.inner.noun,
        "alone_lower": nominal_tube.lower,
        "alone_upper": nominal_tube.upper,
        "control_least": nominal - loop.spread.support(-effects).T,
        "control_most": nominal + loop.spread.support(effects).T,
        "gains": loop.gains(decision),
        "outputs": _compute_outputs(model, decision, times),
        **(_sample_effort(loop, nominal, effects, draws) if draws else {}),
        **(_compute_worst_answers(model, decision) if draws else {}),
    }


def _compute_outputs(model: Transcription, decision: Array, times: Array) -> MeasuredOutputs | None:
    """The outputs that a policy measures with their noise; ``None`` where it measures states."""
    measured, loop, points = model.problem.measurements, model.answering.loop, model.control.breakpoints
    if measured is None:
        return None
    C = np.asarray(measured.C)
    instants = points[:-1][measured.known(points).any(axis=0)]
    lower, upper = -supports(model, decision, times, -C), supports(model, decision, times, C)
    noise = [measured.noises.support(side * np.eye(len(C))) for side in (-1, 1)]
    return MeasuredOutputs(
        C=C,
        nominal=C @ loop.states(decision, times)[:, :, 0].T,
        lower=lower,
        upper=upper,
        instants=instants,
        read_lower=-supports(model, decision, instants, -C) - noise[0][:, None],
        read_upper=supports(model, decision, instants, C) + noise[1][:, None],
        latency=measured.latency,
    )


def _choose_times(points: Array) -> Array:
    """Breakpoints and times between them that show how a state moves; of very many breakpoints some."""
    if points.size > MAX_DRAWN_TIMES + 1:
        return np.asarray(points[np.unique(np.linspace(0, points.size - 1, MAX_DRAWN_TIMES + 1).round().astype(int))])
    per_piece = max(1, MIN_DRAWN_TIMES // (points.size - 1))
    times = points[:-1, None] + np.diff(points)[:, None] * (np.arange(per_piece) / per_piece)
    return np.append(times.ravel(), points[-1])


def _sample_effort(loop: ClosedLoop, nominal: Array, effects: Array, draws: int) -> dict[str, Any]:
    """Quantiles of ``|u|`` over uniform draws from the sets of the deviations; always the same ones."""
    rng = np.random.default_rng(0)
    deviations = [
        convex.sample(draws * count, rng).reshape(draws, -1) - np.tile(middle, count)
        for _, count, convex, middle in loop.spread.parts
    ]
    z = np.concatenate([np.zeros((draws, 0)), *deviations], axis=1)
    quantiles = [np.quantile(np.abs(v + z @ F.T), QUANTILES, axis=0) for v, F in zip(nominal.T, effects, strict=True)]
    return {"effort": np.stack(quantiles, axis=2), "draws": draws}


def _compute_worst_answers(model: Transcription, decision: Array) -> dict[str, Any]:
    """Return the term of every innovation in the control on every piece, in the worst case of the constraint that comes
    nearest to a violation."""
    worst = max(find_adversaries(model, decision), key=lambda one: one.violation, default=None)
    if worst is None or worst.deviation is None:
        return {}
    loop = model.answering.loop
    return {
        "answers": np.einsum("kjid,jd->kji", loop.gains(decision), loop.innovations @ worst.deviation),
        "worst_case": f"the worst case of {plain(worst.name)} at t = {worst.time:.4g}",
    }


def _project_onto_plane(model: Transcription, decision: Array, times: Array) -> Plane | None:
    """Return the places of the system in its plane and the limits on them; ``None`` where the problem names no
    plane."""
    pair, problem = model.problem.names.in_plane, model.problem
    if pair is None:
        return None
    angles = 2.0 * np.pi * np.arange(POLYGON_CORNERS) / POLYGON_CORNERS
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    directions = np.zeros((POLYGON_CORNERS, problem.system.states))
    directions[:, pair] = normals
    heights = supports(model, decision, times, directions)
    next_normals, next_heights = np.roll(normals, -1, axis=0), np.roll(heights, -1, axis=0)
    tangents, next_tangents = (
        np.stack([-vectors[:, 1], vectors[:, 0]], axis=1)[:, None] for vectors in (normals, next_normals)
    )
    # where the lines c'y = h of two neighbouring directions meet
    places = (next_heights[..., None] * tangents - heights[..., None] * next_tangents) / np.sin(
        2.0 * np.pi / POLYGON_CORNERS
    )
    return Plane(states=pair, places=places.transpose(1, 0, 2), limits=tuple(_list_limits(model.stated, pair, normals)))


def _list_limits(problem: OptimalControlProblem, pair: tuple[int, int], around: Array) -> Iterator[Limit]:
    """Yield the limits that path and terminal constraints set to the place alone; of a curved set, its sides
    ``around (q, 2)`` it."""
    end, names = problem.horizon, problem.called("path")
    for name, entry in zip(names, problem.path, strict=True):
        if not isinstance(entry, PathConstraint):
            continue
        normals, bounds = _select_sides(entry.set, pair, around)
        stop, reference = end if entry.stop is None else float(entry.stop), Reference.of(entry.relative_to)
        times = np.unique(
            np.concatenate([np.linspace(entry.start, stop, TIMES_OF_MOVING_SIDE), reference.kinks(entry.start, stop)])
        )
        offsets = reference.along(times, np.eye(entry.set.dimension)[list(pair)])
        limit = Limit(name=printable(name), normals=normals, times=times, bounds=bounds + offsets @ normals.T)
        if len(normals):
            yield replace(limit, is_wall=not limit.moves and entry.start <= 0.0 and stop >= end)
    for terminal in problem.ends:
        normals, bounds = _select_sides(terminal, pair, around)
        if len(normals):
            yield Limit(name="terminal", normals=normals, times=np.array([end]), bounds=bounds[None], is_final=True)


def _select_sides(bounds: ConvexSet, pair: tuple[int, int], around: Array) -> tuple[Array, Array]:
    """The sides of a set that are about two coordinates alone: ``normals (r, 2)``, ``bounds (r,)``."""
    sides = bounds.halfspaces()
    if sides is None:
        directions = np.zeros((len(around), bounds.dimension))
        directions[:, pair] = around
        reach = bounds.support(directions)
        return around[np.isfinite(reach)], reach[np.isfinite(reach)]
    H, h = sides
    is_planar = (np.delete(H, pair, axis=1) == 0.0).all(axis=1) & (H[:, pair] != 0.0).any(axis=1)
    return H[is_planar][:, pair], h[is_planar]


def _list_walls(model: Transcription) -> Iterator[Wall]:
    """Yield the bounds on single states: of the constraints as stated, and of integrals that are states of the solved
    problem."""
    problem, end = model.stated, model.problem.horizon
    for entry in [
        *problem.of_states,
        *(constraint for constraint in model.problem.of_states if isinstance(constraint, Accumulated)),
    ]:
        stop = end if entry.stop is None else entry.stop
        reference = Reference.of(entry.relative_to)
        if not reference.moves:
            yield from (replace(wall, final=stop >= end) for wall in _list_set_walls(entry.set, entry.start, stop))
            continue
        times = np.concatenate([[entry.start], reference.kinks(entry.start, stop), [stop]])
        points = reference.at(times)
        for wall in _list_set_walls(entry.set, entry.start, stop):
            for k in range(times.size - 1):
                begin, last = points[k : k + 2, wall.state].tolist()
                yield Wall(
                    state=wall.state,
                    lower=wall.lower + begin,
                    upper=wall.upper + begin,
                    start=float(times[k]),
                    end=float(times[k + 1]),
                    lower_end=wall.lower + last,
                    upper_end=wall.upper + last,
                )
    for terminal in problem.ends:
        yield from _list_set_walls(terminal, end, end)


def _list_set_walls(bounds: ConvexSet, start: float, end: float) -> Iterator[Wall]:
    axes = np.eye(bounds.dimension)
    for state, (lower, upper) in enumerate(zip(-bounds.support(-axes), bounds.support(axes), strict=True)):
        if np.isfinite(lower) or np.isfinite(upper):
            yield Wall(state=state, lower=float(lower), upper=float(upper), start=start, end=end)
