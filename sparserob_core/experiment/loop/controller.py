"""The controller of a config, of a finished run, or of an outcome."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from sparserob_core.control.loop.controller import Controller
from sparserob_core.control.loop.resolving import PROVEN, ProvenPlan, Resolving
from sparserob_core.errors import InputError
from sparserob_core.experiment.assemble import ControlExperiment, assemble, build, counting, tools_of
from sparserob_core.experiment.config.load import load_config
from sparserob_core.experiment.directory.finished import read_finished
from sparserob_core.experiment.run.given import GivenConfig, as_config
from sparserob_core.experiment.run.outcome import Outcome, SolvedProblem
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.evidence import Cut
from sparserob_core.sip.limits.deadline import Deadline, as_seconds
from sparserob_core.sip.method import GAP_TOLERANCE, require_suited
from sparserob_core.sip.methods.own_units import solve_in_own_units

CONTROLLED = "config: expected a control problem, in which there is something to control"


def controller(
    config: GivenConfig,
    resolve: bool = False,
    *,
    seconds: float | None = None,
    plugins: Iterable[str | Path] = (),
) -> Controller:
    """Return a controller that applies the proven control of a config or of a run.

    Parameters
    ----------
    config : str, Path, mapping, OptimalControlProblem or finished run
        A config or a problem, which is solved first, without files; or a run's directory, or the value of ``sr.run``,
        or of ``sr.solve`` for a problem.
    resolve : bool, default False
        Whether the remaining horizon is solved anew at every step. The last proven plan goes on where that gives no
        better one. Under feedback only the nominal control is solved anew, for the same gains, where the time is too
        short for the whole program.
    seconds : float, optional
        The approximate limit of the time of one step; none unless given. It needs ``resolve``.
    plugins : iterable of str or Path, default ()
        Files of plugins that the run was made with.

    Returns
    -------
    Controller
        The controller. With ``resolve`` everything that does not depend on the state is computed here, not in the
        steps; its ``prepared`` has the seconds of that.

    Raises
    ------
    InputError
        If there is no proven control. With ``resolve`` also where nothing can be solved anew: with a delay, or a
        dictionary whose functions are no indicators.
    """
    if not isinstance(resolve, bool | np.bool_):
        raise InputError(path="resolve", expected="true or false", got=f"{resolve!r}")
    limit = as_seconds(seconds)
    if limit is not None and not resolve:
        raise InputError("seconds: is the time of a re-solve; expected resolve=True beside it")
    plan, experiment = _find_plan(config, plugins)
    return Controller(plan, resolving(experiment, limit) if resolve else None)


def resolving(experiment: ControlExperiment, seconds: float | None) -> Resolving:
    """Return the solver of the remaining horizons of an experiment, with its tolerance and the ``seconds`` of a step.

    Raises `InputError` where the config's method minimises something else than the cost of the problem.
    """
    counts, letters = counting(experiment.loaded)
    if counts or letters is not None:
        raise InputError(
            "resolve: a re-solve minimises the cost of the problem; expected a method that does too, got"
            f" {experiment.loaded.config.method.name}"
        )
    tolerance = experiment.gap_tolerance or GAP_TOLERANCE
    return Resolving(experiment.transcription, tools_of(experiment.loaded), tolerance, seconds)


def _find_plan(config: object, plugins: Iterable[str | Path]) -> tuple[ProvenPlan, ControlExperiment]:
    if isinstance(config, Outcome | SolvedProblem):
        result = config.result if isinstance(config, Outcome) else config
        return _make_plan(
            config.experiment.of_control(CONTROLLED), result.status, result.message, result.decision, result.indices
        )
    if isinstance(config, str | Path) and Path(config).is_dir():
        finished = read_finished(Path(config), plugins)
        finished.require_certified()
        status, message = str(finished.summary["status"]), str(finished.summary["message"])
        return _make_plan(finished.experiment, status, message, finished.decision)
    loaded = load_config(as_config(config))
    deadline = Deadline(loaded.config.limits.seconds)
    experiment = assemble(loaded, deadline).of_control(CONTROLLED)
    method = build(loaded, "method", loaded.config.method)
    try:
        require_suited(method, experiment.program, loaded.config.method.name)
    except InputError as error:
        raise loaded.located((), error) from error
    result = solve_in_own_units(method, experiment.program, tools_of(loaded))
    return _make_plan(experiment, result.status, result.message, result.decision, result.indices)


def _make_plan(
    experiment: ControlExperiment, status: str, message: str, decision: Array | None, cuts: Iterable[Cut] = ()
) -> tuple[ProvenPlan, ControlExperiment]:
    if status not in PROVEN or decision is None:
        raise InputError(f"there is no proven control to apply; the status is '{status}': {message}")
    return ProvenPlan(experiment.transcription, np.asarray(decision, dtype=float).ravel(), 0, tuple(cuts)), experiment
