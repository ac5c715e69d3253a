"""The figures of a run, drawn at its end or again later."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sparserob_core.errors import InputError, SparseRobError
from sparserob_core.experiment.assemble import Experiment, assemble
from sparserob_core.experiment.directory.adversary import adversaries
from sparserob_core.experiment.directory.finished import read_finished, stored_run
from sparserob_core.experiment.figures.active import active_of
from sparserob_core.experiment.figures.figure_data import plain
from sparserob_core.experiment.figures.landscape_figure import LandscapeData
from sparserob_core.experiment.figures.switching import Switching
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.inspection import Inspection, RelaxedValue
from sparserob_core.experiment.run.landscape import (
    Axis,
    Landscape,
    LandscapeAxes,
    Reach,
    deciding_again,
    deciding_pair,
    deciding_slots,
    moving_of,
)
from sparserob_core.experiment.run.replay import stored_result
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.result import Result, SearchTrace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Drawing: TypeAlias = Callable[[], list[Path]]
Picture: TypeAlias = "Callable[[], Figure | None]"
Group: TypeAlias = Callable[[], Mapping[str, Picture]]

logger = logging.getLogger("sparserob")

LANDSCAPE_VALUE_SECONDS = 2.0
"""Seconds for the values of a landscape, after those of its coarsest grid, and for the tuples of the search that are
evaluated once more. With a tenth of it the figure is coarse, and the trajectory of the search begins in its middle. Ten
times as many seconds are more than a user waits for."""
PAGE = 100  # dots per inch in a notebook: with a tenth nothing is legible, with ten times a page has megabytes
GRID = 65  # lines along each coordinate; the coarsest grid has every eighth of them


def draw_run(directory: Path, plugins: Iterable[str | Path] = (), notify: Notify = ignore) -> list[Path]:
    """Draw the figures of a run directory again, and return their files.

    Parameters
    ----------
    directory : Path
        The run directory.
    plugins : iterable of str or Path, default ()
        Files of plugins that the run was made with. The directory itself is data: no plugin that it names is loaded.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Returns
    -------
    list of Path
        The files that were written.

    Raises
    ------
    InputError
        If there is no run in the directory, or nothing to draw.
    """
    run = stored_run(directory)
    worst: Mapping[str, Array] = {}
    if "theta" in run.solution:
        finished = read_finished(directory, plugins)
        experiment: Experiment = finished.experiment
        worst = adversaries(experiment, finished.decision)
    elif run.summary["status"] == "infeasible" or run.evaluations is not None or run.solution["decision"].size:
        experiment = assemble(run.config(plugins))
    else:
        status, message = run.summary["status"], run.summary["message"]
        raise InputError(f"{directory}: there is no control in it; the status is '{status}': {message}")
    files, refusals = list[Path](), list[InputError]()
    for draw in drawings(experiment, stored_result(run), run.directory, worst, notify):
        try:
            files += draw()
        except InputError as error:
            refusals.append(error)
    if refusals and not files:
        raise refusals[0]
    for refusal in refusals:
        logger.warning("%s", refusal)
    if not files:
        raise InputError(f"{directory}: there is nothing to draw; the status is '{run.summary['status']}'")
    return files


def drawings(
    experiment: Experiment, result: Result, directory: Path, worst: Mapping[str, Array], notify: Notify = ignore
) -> Iterator[Drawing]:
    """Yield the figures of a result in groups, each as a function that writes into ``directory/figures``.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    result : Result
        Its result.
    directory : Path
        The run directory.
    worst : mapping
        The arrays of `adversaries`.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Yields
    ------
    callable
        A function without arguments that returns the files; it raises `InputError` where a figure cannot be drawn.
    """
    from sparserob_core.experiment.figures.style import save_figure

    def write(group: Group) -> list[Path]:
        return [file for name, draw in group().items() for file in save_figure(directory / "figures" / name, draw)]

    for group in _list_groups(experiment, result, lambda decision: worst, notify):
        yield partial(write, group)


def _list_groups(
    experiment: Experiment, result: Result, worst: Callable[[Array], Mapping[str, Array]], notify: Notify = ignore
) -> Iterator[Group]:
    """Yield the groups of figures of a result: functions that return figures by name, each as a function.

    They are the figure of the irreducible infeasible subsystem where a control problem is infeasible, those of the
    decision where there is one, and the two of a search. ``worst`` returns the arrays of `adversaries` at a decision.
    """
    from sparserob_core.experiment.figures.clash import clash_figure
    from sparserob_core.experiment.figures.climb_figure import draw_climb
    from sparserob_core.experiment.figures.run_figures import draw_slacks

    model, trace = experiment.model, result.trace
    if model is not None and result.status == "infeasible":
        yield lambda: {"clash": partial(clash_figure, experiment, result)}
    elif model is not None and result.decision is not None:
        yield lambda: _prepare_decision_figures(experiment, result, worst)
    elif experiment.program.families and experiment.problem is None and result.decision is not None:
        yield lambda: {"slacks": partial(draw_slacks, experiment.program, result, plain(experiment.title))}
    if trace is not None and np.isfinite(trace.value).any():
        yield lambda: {
            "climb": lambda: draw_climb(
                trace,
                plain(experiment.title),
                result.upper_bound,
                exact=result.status == "certified",
                unit="" if experiment.problem is None else experiment.problem.cost_unit,
            )
        }
        yield lambda: {"landscape": partial(_draw_landscape, experiment, trace, notify)}


def _prepare_decision_figures(
    experiment: Experiment, result: Result, worst: Callable[[Array], Mapping[str, Array]]
) -> Mapping[str, Picture]:
    """Return the figures of a decision by name.

    That of the worst cases is among them unless there is no constraint against which they could be driven.
    """
    from sparserob_core.experiment.figures.adversary_figure import draw_adversary
    from sparserob_core.experiment.figures.drawing import QUANTILE_DRAWS, choose_states, figure_data
    from sparserob_core.experiment.figures.run_figures import run_pictures

    assert experiment.model is not None
    decision = np.asarray(result.decision, dtype=float).ravel()
    active, states = active_of(experiment.model, result.indices), choose_states(experiment, decision)
    data = figure_data(experiment, decision, active, result.history, result.cost, QUANTILE_DRAWS, result.status, states)
    data = replace(data, switching=switching(experiment, result))
    cases = worst(decision)
    return {**run_pictures(data), **({"adversary": partial(draw_adversary, cases, data)} if cases else {})}


def plot(experiment: Experiment, result: Result, name: str | None) -> Figure:
    """Return a figure of a result, for matplotlib.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    result : Result
        Its result.
    name : str or None
        A name such as ``control``. Where it is ``None``, the figure is that of the states, or of the irreducible
        infeasible subsystem of an infeasible problem.

    Returns
    -------
    matplotlib.figure.Figure
        The figure.

    Raises
    ------
    InputError
        If there is no figure of that name, nothing in it can move, or matplotlib is missing.
    """
    from sparserob_core.experiment.figures.style import require_matplotlib, style

    require_matplotlib()
    groups = _list_groups(experiment, result, partial(adversaries, experiment))
    figures = {name: draw for group in groups for name, draw in group().items()}
    name = name or ("clash" if result.status == "infeasible" else "states")
    if name not in figures:
        available = ", ".join(figures) or f"none: the result is {result.status}, without a control"
        raise InputError(path="name", expected=f"a figure that there is ({available})", got=f"{name!r}")
    with style():
        figure = figures[name]()
    if figure is None:
        raise InputError(f"name: there is no {name} to draw: nothing can move in it")
    figure._repr_png_ = partial(_render_png, figure)  # type: ignore[attr-defined]  # notebooks without pyplot show it as well
    return figure


def _render_png(figure: Figure) -> bytes:
    stream = BytesIO()
    figure.savefig(stream, format="png", dpi=PAGE)
    return stream.getvalue()


def picture(experiment: Experiment, result: Result) -> bytes | None:
    """Return the figure of the control, or of the irreducible infeasible subsystem, as a PNG.

    Returns ``None`` where matplotlib is missing, and where there is neither figure.
    """
    from sparserob_core.experiment.figures.style import missing_matplotlib

    if missing_matplotlib():
        return None
    try:
        return _render_png(plot(experiment, result, "clash" if result.status == "infeasible" else "control"))
    except InputError:
        return None


def switching(experiment: Experiment, result: Result) -> Array | None:
    """Return the switching function ``(m, K)`` of a result: the effect of the constraints on the control.

    The multipliers are those of the lower bound, or else those of the imposed constraints. Returns ``None`` where
    neither are known.
    """
    if result.status not in ("certified", "verified"):
        return None
    view, dual = Inspection(experiment.loaded, experiment), result.dual
    function = Switching(view.program, view.row)
    values = function.evaluate(dual.cuts, dual.mu) if len(dual.cuts) or dual.mu.size else None
    return (
        function.evaluate([cut for cut in result.indices if cut.multiplier > 0.0], None) if values is None else values
    )


def _draw_landscape(experiment: Experiment, trace: SearchTrace, notify: Notify) -> Figure | None:
    """Return the figure of the landscape of g; ``None`` where nothing can move in it."""
    from sparserob_core.experiment.figures.landscape_figure import draw_landscape

    data = landscape_of(Inspection(experiment.loaded, experiment), trace, plain(experiment.title), notify)
    return None if data is None else draw_landscape(data)


def landscape_of(
    inspection: Inspection, trace: SearchTrace, title: str, notify: Notify = ignore
) -> LandscapeData | None:
    """Return the landscape of g through the best tuple of the last epsilon.

    Parameters
    ----------
    inspection : Inspection
        The run.
    trace : SearchTrace
        The evaluations of its search.
    title : str
        The title of the figure.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Returns
    -------
    LandscapeData or None
        The values over the two coordinates of the deciding indices along which g changes most, or along the only
        coordinate that can move. ``None`` where no tuple with a finite value was kept, or nothing can move.

    Raises
    ------
    InputError
        If the tuples do not fit the config.

    Notes
    -----
    The grid is refined until `LANDSCAPE_VALUE_SECONDS` are over; the finest complete grid is returned.
    """
    evaluations = np.flatnonzero(trace.epsilon == trace.epsilon[-1]) if trace.epsilon.size else np.empty(0, dtype=int)
    evaluations = evaluations[np.isfinite(trace.value[evaluations])]
    if not evaluations.size or not trace.points.size:
        return None
    epsilon, top = float(trace.epsilon[-1]), int(evaluations[np.argmax(trace.value[evaluations])])
    slot = inspection.relaxed_value(1, epsilon).slot
    width, remainder = slot.dimension, trace.points.shape[1] % slot.dimension
    if remainder or not np.isfinite(trace.points).all():
        raise InputError(
            f"evaluations: points: expected finite tuples of indices of {width} coordinates each, as the config says, "
            f"got points of {trace.points.shape[1]}" + ("" if remainder else ", not all finite")
        )
    count = trace.points.shape[1] // width
    g, tuples = (
        inspection.relaxed_value(count, epsilon),
        trace.points[evaluations].reshape(evaluations.size, count, width),
    )
    anchor = trace.points[top].reshape(count, width)
    value, reach = g.at(anchor), dict[Axis, Reach]()
    pair = deciding_pair(g, anchor)
    for _ in LandscapeAxes.measure(g, anchor, pair, reach):
        pass
    axes = LandscapeAxes.over(g, count, reach=reach)
    accepted = trace.notes.get("accepted", np.full(trace.value.size, np.nan))[evaluations]
    if axes is None:
        if not moving_of(g):
            return None
        c = moving_of(g)[0]
        across, along = _evaluate_curve(g, anchor, c)
        return LandscapeData(
            title=title,
            epsilon=epsilon,
            axes=[across],
            names=[g.names[c]],
            values=along,
            best=anchor[0, [c]],
            best_value=value,
            own_value=value,
            visited=tuples[:, 0, [c]],
            visited_values=trace.value[evaluations],
            accepted=accepted,
        )
    landscape = Landscape(g, anchor, *axes.places(pair, anchor), GRID, epsilon, axes)
    _fill_landscape(landscape, notify)
    notes = {name: column[evaluations] for name, column in trace.notes.items()}
    coordinates, (across, up, values) = list(g.coordinates), landscape.shown
    widths = (g.slot.upper - g.slot.lower)[coordinates]
    slots = deciding_slots(
        deciding_again(g, trace.points[evaluations], notes, LANDSCAPE_VALUE_SECONDS),
        tuples[:, :, coordinates],
        widths,
        pair,
    )
    places = tuples[:, :, coordinates][np.arange(evaluations.size)[:, np.newaxis], slots]
    visited = axes.of(tuple(coordinates), places)
    assert visited is not None
    return LandscapeData(
        title=title,
        epsilon=epsilon,
        axes=[across, up],
        names=landscape.names("" if inspection.problem is None else plain(inspection.problem.names.time)),
        values=values,
        best=np.array([landscape.axes[k][landscape.at[k]] for k in (0, 1)]),
        best_value=landscape.value,
        own_value=value,
        visited=visited,
        visited_values=trace.value[evaluations],
        accepted=accepted,
    )


def _fill_landscape(landscape: Landscape, notify: Notify) -> None:
    """Evaluate a landscape to its finest grid, or to the one that is complete in time."""
    start = time.monotonic()
    for complete in landscape.evaluate():
        if complete:
            size = " x ".join(str(axis.size) for axis in landscape.shown[:2])
            notify(StudyProgress(text=f"figures: the landscape of g on {size}"))
        if landscape.level and time.monotonic() - start > LANDSCAPE_VALUE_SECONDS:
            return


def _evaluate_curve(g: RelaxedValue, anchor: Array, c: int) -> tuple[Array, Array]:
    """Return the values of g of a tuple with one index along its coordinate ``c``, at `GRID` values and at its own."""
    across = np.union1d(np.linspace(g.slot.lower[c], g.slot.upper[c], GRID), anchor[0, c])
    slots, values = anchor.copy(), list[float]()
    for value in across:
        slots[0, c] = value
        values.append(g.at(slots))
    return across, np.nan_to_num(np.array(values), nan=-np.inf, posinf=np.inf, neginf=-np.inf)


def drawn(
    experiment: Experiment, result: Result, directory: Path, worst: Mapping[str, Array], notify: Notify = ignore
) -> tuple[str, ...]:
    """Draw the figures of a run that is over.

    Figures are an extra: any error in one of them becomes a warning.

    Parameters
    ----------
    experiment : Experiment
        The experiment.
    result : Result
        Its result.
    directory : Path
        The run directory.
    worst : mapping
        The arrays of `adversaries`.
    notify : callable, optional
        A function that receives `StudyProgress`.

    Returns
    -------
    tuple of str
        Warnings about figures that could not be drawn.
    """
    remarks = []
    for draw in drawings(experiment, result, directory, worst, notify) if result.status != "failed" else ():
        try:
            draw()
        except SparseRobError as error:
            remarks.append(str(error))
        except Exception as error:  # noqa: BLE001  a figure may not end a run
            remarks.append(f"the figures could not be drawn: {type(error).__name__}: {error}")
    return tuple(dict.fromkeys(remarks))
