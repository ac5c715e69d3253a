"""The margin of an experiment: a critical factor with proofs from both sides, and the cost at other factors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.studies.causal import Ended
from sparserob_core.errors import InputError, named
from sparserob_core.experiment.assemble import assemble, tools_of, transcribed_by
from sparserob_core.experiment.config.load import Loaded, load_config
from sparserob_core.experiment.config.problems import ProblemKeys
from sparserob_core.experiment.margin.causal import causal_upper
from sparserob_core.experiment.margin.horizon import HORIZON, HorizonSearch, horizon_search
from sparserob_core.experiment.margin.points import MarginPoint, Points
from sparserob_core.experiment.margin.scaling import scaling
from sparserob_core.experiment.margin.search import Margin, MarginSearch
from sparserob_core.experiment.run.events import Broadcast, Observer, SweepFinished, SweepStarted
from sparserob_core.experiment.run.given import GivenConfig, as_config
from sparserob_core.experiment.study.kit import open_study, write_study
from sparserob_core.sip.events import Event, Notify, ignore
from sparserob_core.sip.method import Tools
from sparserob_core.sip.methods.exchange import Exchange
from sparserob_core.sip.relaxed.parametric import ParametricProgram
from sparserob_core.sip.result import Result

__all__ = ["Margin", "MarginPoint", "margin", "margin_rows"]


def margin(
    config: GivenConfig,
    of: str = "disturbance",
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    *,
    tolerance: float = 1e-6,
    curve: int = 0,
    out: str | Path | None = None,
    write: bool = False,
    notify: Notify = ignore,
    observers: Iterable[Observer] = (),
) -> Margin:
    """Find the critical factor of an experiment, as ``sparserob margin CONFIG key=value ... --of OF`` does.

    Parameters
    ----------
    config : str, Path, mapping, OptimalControlProblem or finished run
        The config, a problem, or a run (`as_config`).
    of : str, default "disturbance"
        The part of the problem that is scaled. The largest feasible factor is searched for ``disturbance``,
        ``parameters``, ``initial_state`` and ``execution``; sets are scaled about their centre. The smallest is
        searched for ``path.0``, ``terminal.0``, ``integral.0``, ``control`` and ``control_step``. ``path.0.from`` gives
        the earliest start of a window, in the unit of time. ``horizon`` gives the shortest feasible horizon up to the
        config's, with the same number of pieces. Feasibility is not monotone in it, so that horizons are scanned and
        covered.
    overrides : mapping or iterable of str, optional
        Changes of the config.
    tolerance : float, default 1e-6
        The distance of the two sides that is asked for: relative to the factor, or to 1 if that is larger. For a window
        it is relative to its end, for the horizon to the config's.
    curve : int, default 0
        The number of factors on the feasible side at which the cost is computed, each by a run of its own. For the
        horizon the number of horizons, feasible or not.
    out : str or Path, optional
        The directory for ``margin.json`` and ``margin.png``, new or empty.
    write : bool, default False
        Whether to write ``runs/NAME-margin/STAMP-HASH`` where ``out`` is not given.
    notify : callable, optional
        A function that receives `StudyProgress`.
    observers : iterable of Observer, default ()
        Observers of the search. They receive the events of a study with one axis, from `SweepStarted` to
        `SweepFinished`; its points are added when they are found.

    Returns
    -------
    Margin
        The margin. An interrupt and ``limits.seconds`` of the config end the search; the margin then has what is proven
        so far, with the status ``undecided``.

    Raises
    ------
    InputError
        If an argument or the config is at fault.
    TimeLimitError
        If the limit comes before there is anything to solve.
    """
    if not hasattr(tolerance, "__float__") or not 1e-9 <= tolerance <= 0.1:
        raise InputError(f"tolerance: expected a number from 1e-9 to 0.1, got {tolerance!r}")
    if not hasattr(curve, "__index__") or curve < 0 or curve == 1:
        raise InputError(f"curve: expected a number of points, 0 for none or at least 2, got {curve!r}")
    loaded = load_config(as_config(config), overrides)
    broadcast = Broadcast([(type(observer).__name__, observer) for observer in observers])

    def heard(event: Event) -> None:
        notify(event)
        broadcast(event)

    tools = tools_of(loaded)
    with transcribed_by(tools.deadline):
        search = _build_search(loaded, tools, str(of), float(tolerance), heard if broadcast.heard else notify)
    answer, stopped, deadline = "", "", search.tools.deadline
    try:
        heading = f"The experiment whose margin of {of} was sought."
        with open_study(loaded, out, heading, "-margin", write) as directory:
            broadcast(_make_start_event(search, Path() if directory is None else directory.path))
            result = search.margin(int(curve))
            if directory is not None:
                result = write_study(directory, "margin", result, *_choose_figure(result, search))
        answer, stopped = "; ".join(f"{name}: {value}" for name, value in margin_rows(result)[:3]), deadline.reason
        return result
    except BaseException as error:
        stopped = named(error)
        raise
    finally:
        rows, seconds = dict(search.progress.rows), search.progress.seconds
        with suppress(KeyboardInterrupt):  # an interrupt ends the observers: search and directory are finished
            broadcast(
                SweepFinished(rows=rows, seconds=seconds, stopped=stopped, pressed=deadline.pressed, answer=answer)
            )


def _make_start_event(search: MarginSearch | HorizonSearch, directory: Path) -> SweepStarted:
    """Return the first event for observers of a margin: a study of one axis without points."""
    scaled = None if isinstance(search, HorizonSearch) else search.scaling
    return SweepStarted(
        title=f"{search.title}: margin of {search.progress.of}",
        directory=directory,
        axes=[HORIZON if scaled is None else scaled.label.replace(".", " ")],
        logarithmic=[False],
        points=[],
        arrangement="search",
        sense=scaled.sense if scaled is not None and scaled.nested else "",
    )


def margin_rows(found: Margin) -> list[tuple[str, str]]:
    """Return the results of a margin as rows of a table."""
    rows = [("status", f"{found.status}: {found.message}")]
    unit = f" {found.cost_unit}" if found.cost_unit else ""
    if found.of == HORIZON:
        rows += [
            (f"shortest {found.quantity}", _format_interval(found.lower, found.upper)),
            ("excluded", f"(0, {found.lower:.9g}] on {len(found.covered)} cells" if found.covered else "nothing"),
        ]
        if found.feasible is not None:
            cost = f"{found.feasible.upper_bound:.9g}{unit}"
            rows.append(("proven feasible", f"at {found.upper:.9g}: {found.feasible.status}, cost {cost}"))
        return [*rows, ("seconds", f"{found.seconds:.3f}")]
    rows += [
        (f"{found.sense} factor", _format_interval(found.lower, found.upper)),
        (found.quantity, _format_interval(*found.amounts)),
    ]
    if np.isfinite(found.causal_upper):
        over = " (the time for the search was over)" if found.causal_ended == "seconds" else ""
        rows.append(("no causal policy", f"from the factor {found.causal_upper:.9g} on{over}"))
    for name, point in (("proven feasible", found.feasible), ("proven infeasible", found.infeasible)):
        if point is not None:
            cost = f", cost {point.upper_bound:.9g}{unit}" if np.isfinite(point.upper_bound) else ""
            rows.append((name, f"at {point.factor:.9g}: {point.status}{cost}"))
    return [*rows, ("seconds", f"{found.seconds:.3f}")]


def curve_rows(found: Margin) -> list[tuple[str, str, str, str]]:
    """Return the curve of a margin as rows of a table: factor or horizon, status, and both bounds of the cost."""

    def number(value: float) -> str:
        return f"{value:.9g}" if np.isfinite(value) else "-"

    return [
        (f"{point.amount:.6g}", point.status, number(point.lower_bound), number(point.upper_bound))
        for point in found.curve
    ]


def _format_interval(lower: float, upper: float) -> str:
    if np.isnan(upper):
        return "none" if np.isnan(lower) else f"more than {lower:.9g}"
    if np.isposinf(upper):
        return f"more than {lower:.9g}"
    return f"{lower:.9g} to {upper:.9g}" if lower != upper else f"{lower:.9g}"


def _build_search(
    loaded: Loaded, tools: Tools, of: str, tolerance: float, notify: Notify
) -> MarginSearch | HorizonSearch:
    from sparserob_core.control.transcription.terms.accumulated import integrals_as_states
    from sparserob_core.control.transcription.transcribe import in_own_units, like, prepare, transcribe

    experiment = assemble(loaded, tools.deadline).of_control(
        "config: expected a control problem, whose sets can be scaled"
    )
    problem, control, disturbance = experiment.transcription.stated, experiment.control, experiment.disturbance
    policy = experiment.transcription.policy
    if of == HORIZON:
        if policy is not None:
            raise InputError(path="policy.name", expected="open_loop for the margin of the horizon", got="feedback")
        dictionaries, method = (control, disturbance), _choose_method(loaded)
        return horizon_search(experiment.title, problem, dictionaries, method, tools, tolerance, notify)
    chosen = scaling(problem, of, *_find_positions(loaded, problem))
    programs = ParametricProgram(lambda factor: transcribe(chosen.at(factor), control, disturbance, policy=policy))
    joined: ParametricProgram | None = None
    if chosen.affine and policy is None:  # one program for all factors, in the units of the factor 1
        own, units = in_own_units(prepare(chosen.at(1.0), control, disturbance))
        joined = ParametricProgram(lambda factor: like(own, units.of_problem(integrals_as_states(chosen.at(factor)))))
    width = tolerance * (1.0 if chosen.relative else chosen.highest)
    search = MarginSearch(
        experiment.title, programs, joined, chosen, _choose_method(loaded), tools, width, Points(of, notify)
    )
    if policy is None or of != "disturbance":
        return search

    def beyond(results: dict[float, Result]) -> tuple[float, Ended | None]:
        return causal_upper(
            lambda factor: prepare(chosen.at(factor), control, disturbance, policy=policy),
            chosen,
            results,
            tools,
            notify,
        )

    return replace(search, beyond=beyond)


def _find_positions(loaded: Loaded, problem: OptimalControlProblem) -> tuple[list[list[int]], list[list[int]]]:
    """Return for every entry of ``path`` and of ``terminal`` in the config the positions of its sets in the problem.

    An entry may have become no set, one or several.
    """
    factory = loaded.registry.build("problem", loaded.config.problem.name, loaded.config.problem.options)
    if not isinstance(factory, ProblemKeys):
        return [[i] for i in range(len(problem.path))], [[i] for i in range(len(problem.terminal))]
    states = problem.system.states
    entries = [item.entries(f"path.{i}", states, factory.horizon) for i, item in enumerate(factory.path)]
    members = [[_is_restrictive(constraint.set) for constraint in entry] for entry in entries]
    ends = [
        [_is_restrictive(end) for end in item.ends(f"terminal.{i}", states)] for i, item in enumerate(factory.terminal)
    ]
    return _number_members(members), _number_members(ends)


def _is_restrictive(one: Any) -> bool:
    """Return whether a set or an equality is more than the whole space; a problem drops those that are not."""
    if hasattr(one, "fixed"):
        return bool(one.fixed.size)
    flat = one.halfspaces()
    return flat is None or flat[1].size > 0


def _number_members(kept: Sequence[Sequence[bool]]) -> list[list[int]]:
    numbers = iter(range(sum(map(sum, kept))))
    return [[next(numbers) for keep in entry if keep] for entry in kept]


def _choose_method(loaded: Loaded) -> Exchange:
    """Return the exchange method of the config, or one with default options where the config has another method.

    A margin asks which factors are feasible, not how well another method performs.
    """
    entry = loaded.config.method
    built = loaded.registry.build("method", entry.name, entry.options)
    return built if isinstance(built, Exchange) else Exchange()


def _choose_figure(margin: Margin, search: MarginSearch | HorizonSearch) -> tuple[Any, ...]:
    """Return the function that draws a margin, if there is anything to draw, and its further arguments."""
    from sparserob_core.experiment.margin.figure import draw_horizons, draw_margin

    if len(margin.curve) < 2:
        return (None,)
    return (draw_horizons,) if isinstance(search, HorizonSearch) else (draw_margin, search.scaling)
