"""Maximisation of a function without a config or a problem, and the lookup of components by name."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from sparserob_core.arguments import share, whole
from sparserob_core.control.problem.dictionary import Dictionary, DictionaryFactory
from sparserob_core.errors import InputError, named
from sparserob_core.experiment.plugins.components import Registry
from sparserob_core.experiment.plugins.guards import guarded, origin_of
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.events import Event, ignore
from sparserob_core.sip.limits.deadline import as_seconds
from sparserob_core.sip.maximiser import Maximiser, Report

if TYPE_CHECKING:
    from sparserob_core.sip.events import Notify
    from sparserob_core.sip.search.ask_tell import AskTell

Choice: TypeAlias = str | Mapping[str, Any]
logger = logging.getLogger("sparserob")
PIECES = {"name": "piecewise_constant", "pieces": 100}
ASKED = {"integer", "logarithmic", "minimise", "state"}  # arguments that `ask_tell` has and `maximise` has not


def maximise(
    f: Callable[[Array], object],
    box: Box,
    name: Choice | Maximiser = "direct",
    budget: int = 1000,
    seed: int = 0,
    polish: float | None = None,
    gradient: Callable[[Array], Array] | None = None,
    notify: Notify = ignore,
    *,
    start: Array | None = None,
    seconds: float | None = None,
    callback: Callable[[Array, Array], object] | None = None,
    target: float | None = None,
    patience: int | None = None,
    known: tuple[Array, Array] | None = None,
    **options: object,
) -> Report:
    """Search for the maximum of a function over a box.

    The search ends at the ``budget``, at a value of at least ``target``, at the ``patience``, after the ``seconds``, or
    where the ``callback`` returns ``True``. There is no polish where the ``target``, the ``patience`` or the
    ``callback`` ends it.

    Parameters
    ----------
    f : callable
        The function: it maps points ``(k, d)`` to values ``(k,)``.
    box : Box
        The box of dimension ``d`` that is searched.
    name : str, mapping or Maximiser, default "direct"
        The maximiser: its name, a mapping with its name and options, or the component itself.
    budget : int, default 1000
        The number of evaluations.
    seed : int, default 0
        The seed of random numbers.
    polish : float, optional
        The last share of the budget. A local method spends it, from the best points. Unless given it is the maximiser's
        own share (`Maximiser.polished`): a fifth, and nothing for ``lipo`` and ``random_search``.
    gradient : callable, optional
        The gradient ``(d,)`` of ``f`` at a point ``(d,)``, for maximisers and a polish that use it.
    notify : callable, optional
        A function that receives `EvaluationsFinished` at least after every twentieth of the budget.
    start : array, optional
        Points ``(d,)`` or ``(k, d)`` that are evaluated first. A maximiser that moves from point to point begins at the
        best of them.
    seconds : float, optional
        The time after which no evaluation begins.
    callback : callable, optional
        A function ``callback(points, values)`` that is called after every batch of evaluations.
    target : float, optional
        A value that ends the search.
    patience : int, optional
        The number of consecutive evaluations without an improvement that ends the search.
    known : tuple of arrays, optional
        Points ``(k, d)`` and their values ``(k,)`` from before. They are not evaluated again, and the search goes on
        from the best of them.
    **options
        Options of the maximiser, where it is given by its name.

    Returns
    -------
    Report
        The best point, its value, and the reason for which the search ended.

    Raises
    ------
    InputError
        If an argument is at fault.
    EvaluationError
        If ``f`` fails, or returns complex numbers or nothing but NaN.

    Notes
    -----
    An exception in ``callback`` or ``notify`` becomes a warning, and that function is not called again.
    """
    from sparserob_core.sip.search.search import Rules, Target
    from sparserob_core.sip.search.search import maximise as search

    for key in ASKED & options.keys():
        raise InputError(f"{key}: expected an argument of maximise, got one of ask_tell, which takes it")
    if callback is not None and not callable(callback):
        raise InputError(f"callback: expected a function of points and values, got {callback!r}")
    chosen, share = _build_maximiser(box, name, options, polish)
    limit, function = as_seconds(seconds), _ReportedFunction(f, callback)
    rules = Rules(
        polish=share,
        seconds=np.inf if limit is None else limit,
        halt=function.halted,
        **_collect_end_rules(target, patience),
    )
    report = search(
        Target(f if callback is None else function, box, gradient),
        chosen,
        whole("budget", budget, 1),
        np.random.default_rng(whole("seed", seed, 0)),
        rules,
        wrap_notify(notify),
        _check_points(start, box),
        _check_known(known, box),
    )
    if report.missing and report.missing == report.evaluations and not report.interrupted:
        from sparserob_core.sip.maximiser import EvaluationError

        raise EvaluationError(
            f"the function gave NaN at each of the {report.missing} points that were asked for; expected real numbers, "
            "and NaN or -inf only where there is none",
            report,
        )
    return report


def ask_tell(
    box: Box,
    name: Choice | Maximiser = "direct",
    budget: int = 1000,
    seed: int = 0,
    polish: float | None = None,
    *,
    start: Array | None = None,
    state: Mapping[str, Any] | None = None,
    minimise: bool = False,
    integer: Sequence[int] = (),
    logarithmic: Sequence[int] = (),
    target: float | None = None,
    patience: int | None = None,
    known: tuple[Array, Array] | None = None,
    **options: object,
) -> AskTell:
    """Return a search for the maximum of a function that is evaluated elsewhere: by a simulator, a queue, a laboratory.

    Parameters
    ----------
    box : Box
        The box of dimension ``d`` that is searched.
    name, budget, seed, polish, start, patience, known, **options
        As for `maximise`.
    state : mapping, optional
        The answer of `AskTell.state` for the same arguments, or for these with a smaller budget. The values in it are
        replayed, and the search goes on with the points that it would have asked for. A value that was still expected
        may be given to the new search.
    minimise : bool, default False
        Whether to search for the minimum.
    integer : sequence of int, default ()
        The coordinates that are whole numbers. A point that has a value is then not asked for again.
    logarithmic : sequence of int, default ()
        The coordinates that are searched by their logarithms.
    target : float, optional
        The value that ends the search: at least this value, with ``minimise`` at most.

    Returns
    -------
    AskTell
        The search. `AskTell` says how to ask for points and how to give their values.

    Raises
    ------
    InputError
        If an argument is at fault.

    Notes
    -----
    With a larger budget the search is the one that had this budget from its beginning. Values in ``state`` that it does
    not ask for are kept with it.
    """
    from sparserob_core.sip.search.ask_tell import AskTell
    from sparserob_core.sip.search.ranges import Ranges
    from sparserob_core.sip.search.search import Rules, Target
    from sparserob_core.sip.search.search import maximise as search

    chosen, share = _build_maximiser(box, name, options, polish)
    start_points, earlier, ends = (
        _check_points(start, box),
        _check_known(known, box),
        _collect_end_rules(target, patience),
    )
    number, calls = whole("seed", seed, 0), whole("budget", budget, 1)
    Target(lambda points: points, box)  # raises InputError for a box without bounds
    if not isinstance(minimise, bool):
        raise InputError(f"minimise: expected true or false, got {minimise!r}")
    ranges, sign = Ranges(box, integer, logarithmic), -1.0 if minimise else 1.0
    if ranges.integer and not chosen.whole:
        raise InputError(
            path="integer",
            expected="none, or a maximiser that compares values, such as simulated_annealing: this one follows slopes,"
            " which are 0 between whole numbers",
            got=repr(list(integer)),
        )
    rules = Rules(polish=share, **{**ends, **({"target": sign * ends["target"]} if "target" in ends else {})})
    entry: object = {"name": name, **options} if isinstance(name, str) else name
    description = {
        "maximiser": dict(entry) if isinstance(entry, Mapping) else type(entry).__name__,
        "budget": calls,
        "seed": number,
        "polish": rules.polish,
        "lower": box.lower.tolist(),
        "upper": box.upper.tolist(),
        "start": None if start_points is None else start_points.tolist(),
        "minimise": minimise,
        "integer": list(ranges.integer),
        "logarithmic": list(ranges.logarithmic),
        "target": ends.get("target"),
        "patience": ends.get("patience"),
        "known": None if earlier is None else [earlier[0].tolist(), earlier[1].tolist()],
    }
    hidden_start = None if start_points is None else ranges.hidden(start_points)

    def run(function: Callable[[Array], Array]) -> Report:
        report = search(
            Target(function, ranges.searched),
            chosen,
            calls,
            np.random.default_rng(number),
            rules,
            start=hidden_start,
            known=None if earlier is None else (ranges.hidden(earlier[0]), sign * earlier[1]),
        )
        if not minimise or "target" not in ends:
            return report
        mirrored, meant = (f"the target {value:.9g} is" for value in (rules.target, ends["target"]))
        return replace(report, stopped=report.stopped.replace(mirrored, meant))

    keywords: dict[str, Any] = dict(options)
    restart = partial(
        ask_tell,
        box,
        name,
        budget,
        seed,
        polish,
        start=start,
        minimise=minimise,
        integer=integer,
        logarithmic=logarithmic,
        target=target,
        patience=patience,
        known=known,
        **keywords,
    )
    return AskTell(ranges, run, description, state, restart)


def _build_maximiser(
    box: object, name: Choice | Maximiser, options: Mapping[str, object], polish: float | None
) -> tuple[Maximiser, float]:
    """Return the maximiser, and the share of its budget that goes to a polish."""
    if not isinstance(box, Box):
        raise InputError(f"box: expected a sparserob_core.Box, got {type(box).__name__}")
    if options and not isinstance(name, str):
        raise InputError(f"{', '.join(options)}: options as keywords need the maximiser's name, got {name!r}")
    entry = {"name": name, **options} if isinstance(name, str) else name
    chosen: Maximiser = component(load_registry(), "maximiser", entry, Maximiser)
    return chosen, chosen.polished if polish is None else share("polish", polish)


def _check_points(start: object, box: Box, name: str = "start") -> Array | None:
    """Return points ``(k, d)`` of the box to begin with; messages call them ``name``."""
    if start is None:
        return None
    try:
        points = np.atleast_2d(np.array(start, dtype=float))
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected points of numbers, got {start!r}") from None
    if points.ndim != 2 or points.shape[1] != box.dimension or not len(points):
        raise InputError(f"{name}: expected shape ({box.dimension},) or (k, {box.dimension}), got {start!r}")
    if not ((points >= box.lower) & (points <= box.upper)).all():
        raise InputError(
            f"{name}: expected points of the box, lower {box.lower.tolist()}, upper {box.upper.tolist()}, got "
            f"{points[~((points >= box.lower) & (points <= box.upper)).all(axis=1)][0].tolist()}"
        )
    return points


def _check_known(known: Any, box: Box) -> tuple[Array, Array] | None:
    """Return points ``(k, d)`` of the box and their values ``(k,)`` from before."""
    if known is None:
        return None
    try:
        points, values = known
        numbers: Array = np.array(values, dtype=float, ndmin=1)
    except (TypeError, ValueError):
        raise InputError(f"known: expected points and their values, got {known!r}") from None
    if not numbers.size and not np.size(points):
        return None
    placed = _check_points(points, box, "known")
    if placed is None or numbers.shape != (len(placed),):
        raise InputError(f"known: expected a value for each point, got shapes {np.shape(points)} and {numbers.shape}")
    return placed, numbers


def _collect_end_rules(target: object, patience: object) -> dict[str, Any]:
    """Return the rules that end a search before its budget."""
    ends: dict[str, Any] = {}
    if target is not None:
        if isinstance(target, bool | str) or not hasattr(target, "__float__") or np.isnan(float(target)):
            raise InputError(f"target: expected a number, got {target!r}")
        ends["target"] = float(target)
    if patience is not None:
        ends["patience"] = whole("patience", patience, 1)  # type: ignore[arg-type]
    return ends


class _ReportedFunction:
    """A function whose values a callback receives; the callback may ask for the end of the search."""

    def __init__(self, f: Callable[[Array], object], callback: Callable[[Array, Array], object] | None) -> None:
        self.f, self.callback = f, None if callback is None else careful("callback", callback)
        self.asked = False

    def __call__(self, points: Array) -> object:
        """Return the values at some points after the callback has received them."""
        values = self.f(points)
        if self.callback is not None:
            answer = self.callback(points.copy(), np.array(values, dtype=float))
            self.asked |= isinstance(answer, bool | np.bool_) and bool(answer)
        return values

    def halted(self) -> bool:
        """Return whether the callback has asked for the end."""
        return self.asked


def wrap_notify(notify: Notify) -> Callable[[Any], None]:
    """Return a function that passes events on to a user's function until that raises, and ignores all else."""
    if notify is ignore:
        return ignore
    heard = careful("notify", notify)

    def pass_on(event: object) -> None:
        if isinstance(event, Event):
            heard(event)

    return pass_on


def careful(name: str, listener: Callable[..., object]) -> Callable[..., object]:
    """Return a listener that is called until it raises for the first time.

    The exception becomes a warning with the ``name`` of the listener, and the search goes on.
    """
    deaf = False

    def heard(*arguments: object) -> object:
        nonlocal deaf
        if deaf:
            return None
        try:
            return listener(*arguments)
        except Exception as error:  # noqa: BLE001  a user's function may raise anything
            deaf = True
            warnings.warn(f"{name} raised {named(error)}; it is not called again", stacklevel=2)
            return None

    return heard


def component(registry: Registry, kind: str, choice: object, expected: type[Any]) -> Any:
    """Return a component, wrapped in the checks of its kind.

    Parameters
    ----------
    registry : Registry
        The registered components.
    kind : str
        The kind of the component.
    choice : str, mapping or object
        Its name, a mapping with its name and options, or the component itself.
    expected : type
        The class of components of the kind.

    Returns
    -------
    object
        The component.

    Raises
    ------
    InputError
        If ``choice`` is anything else.
    """
    if isinstance(choice, expected):
        return guarded(choice, origin_of(kind, choice))
    entry = {"name": choice} if isinstance(choice, str) else choice
    if isinstance(entry, Mapping) and isinstance(name := entry.get("name"), str):
        built = registry.build(kind, name, {key: value for key, value in entry.items() if key != "name"})
        return guarded(built, registry.get(kind, name).origin)
    raise InputError(f"{kind}: expected a name, a mapping with a name, or a {expected.__name__}, got {choice!r}")


def dictionary(registry: Registry, choice: object, horizon: float) -> Dictionary:
    """Return the dictionary on ``[0, horizon]`` that a choice names, describes or is."""
    if isinstance(choice, Dictionary):
        return choice
    factory: DictionaryFactory = component(registry, "dictionary", choice, DictionaryFactory)
    return factory.build(horizon)


def indicators(on: Dictionary) -> Dictionary:
    """Return the dictionary with one indicator function on each piece of another dictionary."""
    return Dictionary.indicators(on.breakpoints)
