"""What a Python user does without a config and without a problem: maximise a function; and what stands for a
component there."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
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
from sparserob_core.sip.events import ignore
from sparserob_core.sip.limits.deadline import as_seconds
from sparserob_core.sip.maximiser import Maximiser, Report

if TYPE_CHECKING:
    from sparserob_core.sip.events import Notify
    from sparserob_core.sip.search.ask_tell import AskTell

Choice: TypeAlias = str | Mapping[str, Any]
logger = logging.getLogger("sparserob")
PIECES = {"name": "piecewise_constant", "pieces": 100}


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
    **options: object,
) -> Report:
    """Search for the maximum of ``f`` (points ``(k, d)`` to values ``(k,)``) over a box with the maximiser of that
    name.

    The last share ``polish`` of the budget goes to a local method, from the best points: a fifth unless given, nothing
    for ``lipo``, ``random_search`` and ``sobol`` (`Maximiser.polished`). ``gradient`` maps a point
    ``(d,)`` to the gradient ``(d,)`` of ``f``, for maximisers and a polish that use it. ``start (d,)`` or ``(k, d)``:
    points that are evaluated first; maximisers that walk begin at the best of them. ``seconds``: no evaluation begins
    after that time. ``callback(points, values)`` is called after every batch of evaluations, ``notify`` with
    `EvaluationsFinished` at least after every twentieth of the budget; what one of them raises is told in a warning,
    and it is not called again. Further keywords are the maximiser's options.
    Raises `InputError` when an argument is at fault, and `EvaluationError` when ``f`` fails, returns
    complex numbers, or nothing but NaN.
    """
    from sparserob_core.sip.search.search import Rules, Target
    from sparserob_core.sip.search.search import maximise as search

    chosen, share = _chosen(box, name, options, polish)
    limit = as_seconds(seconds)
    report = search(
        Target(f if callback is None else _told(f, careful("callback", callback)), box, gradient),
        chosen,
        whole("budget", budget, 1),
        np.random.default_rng(whole("seed", seed, 0)),
        Rules(polish=share, seconds=np.inf if limit is None else limit),
        notify if notify is ignore else careful("notify", notify),
        _placed(start, box),
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
    **options: object,
) -> AskTell:
    """A search for the maximum of a function that somebody else evaluates: a simulator, a queue, a laboratory.

    The arguments are those of `maximise`, but for the function. ``minimise``: for its minimum. ``integer``: the
    coordinates that are whole numbers; a point that has a value is then not asked for again. ``logarithmic``: those
    that are searched by their logarithms. ``state``: what `AskTell.state` gave, with the same arguments, or with a
    larger budget; what was told is told again, and the search goes on with the points that it would have asked for.
    With a larger budget it is the search that had this budget from its beginning: values that it does not ask for are
    kept beside it. Raises `InputError` when an argument is at fault.
    """
    from sparserob_core.sip.search.ask_tell import AskTell
    from sparserob_core.sip.search.ranges import Ranges
    from sparserob_core.sip.search.search import Rules, Target
    from sparserob_core.sip.search.search import maximise as search

    chosen, share = _chosen(box, name, options, polish)
    first, rules = _placed(start, box), Rules(polish=share)
    number, calls = whole("seed", seed, 0), whole("budget", budget, 1)
    Target(lambda points: points, box)  # a box without bounds is refused here
    if not isinstance(minimise, bool):
        raise InputError(f"minimise: expected true or false, got {minimise!r}")
    ranges = Ranges(box, integer, logarithmic)
    entry: object = {"name": name, **options} if isinstance(name, str) else name
    about = {
        "maximiser": dict(entry) if isinstance(entry, Mapping) else type(entry).__name__,
        "budget": calls,
        "seed": number,
        "polish": rules.polish,
        "lower": box.lower.tolist(),
        "upper": box.upper.tolist(),
        "start": None if first is None else first.tolist(),
        "minimise": minimise,
        "integer": list(ranges.integer),
        "logarithmic": list(ranges.logarithmic),
    }
    begin = None if first is None else ranges.hidden(first)

    def run(function: Callable[[Array], Array]) -> Report:
        return search(
            Target(function, ranges.searched), chosen, calls, np.random.default_rng(number), rules, start=begin
        )

    keywords: dict[str, Any] = dict(options)
    again = partial(
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
        **keywords,
    )
    return AskTell(ranges, run, about, state, again)


def _chosen(
    box: object, name: Choice | Maximiser, options: Mapping[str, object], polish: float | None
) -> tuple[Maximiser, float]:
    """The maximiser, and the share of its budget that goes to a polish."""
    if not isinstance(box, Box):
        raise InputError(f"box: expected a sparserob_core.Box, got {type(box).__name__}")
    if options and not isinstance(name, str):
        raise InputError(f"{', '.join(options)}: options as keywords need the maximiser's name, got {name!r}")
    entry = {"name": name, **options} if isinstance(name, str) else name
    chosen: Maximiser = component(load_registry(), "maximiser", entry, Maximiser)
    return chosen, chosen.polished if polish is None else share("polish", polish)


def _placed(start: object, box: Box) -> Array | None:
    """Points ``(k, d)`` of the box to begin with."""
    if start is None:
        return None
    try:
        points = np.atleast_2d(np.array(start, dtype=float))
    except (TypeError, ValueError):
        raise InputError(f"start: expected points of numbers, got {start!r}") from None
    if points.ndim != 2 or points.shape[1] != box.dimension or not len(points):
        raise InputError(f"start: expected shape ({box.dimension},) or (k, {box.dimension}), got {start!r}")
    if not ((points >= box.lower) & (points <= box.upper)).all():
        raise InputError(
            f"start: expected points of the box, lower {box.lower.tolist()}, upper {box.upper.tolist()}, got "
            f"{points[~((points >= box.lower) & (points <= box.upper)).all(axis=1)][0].tolist()}"
        )
    return points


def _told(f: Callable[[Array], object], callback: Callable[..., None]) -> Callable[[Array], object]:
    def watched(points: Array) -> object:
        values = f(points)
        callback(points.copy(), np.array(values, dtype=float))
        return values

    return watched


def careful(name: str, listener: Callable[..., object]) -> Callable[..., None]:
    """The listener until it raises for the first time, which is told in a warning; a search outlives it."""
    deaf = False

    def heard(*arguments: object) -> None:
        nonlocal deaf
        if deaf:
            return
        try:
            listener(*arguments)
        except Exception as error:  # noqa: BLE001  somebody else's function
            deaf = True
            warnings.warn(f"{name} raised {named(error)}; it is not called again", stacklevel=2)

    return heard


def component(registry: Registry, kind: str, choice: object, expected: type[Any]) -> Any:
    """The component that a name, a mapping with a name, or the component itself stands for, behind the check of its
    kind."""
    if isinstance(choice, expected):
        return guarded(choice, origin_of(kind, choice))
    entry = {"name": choice} if isinstance(choice, str) else choice
    if isinstance(entry, Mapping) and isinstance(name := entry.get("name"), str):
        built = registry.build(kind, name, {key: value for key, value in entry.items() if key != "name"})
        return guarded(built, registry.get(kind, name).origin)
    raise InputError(f"{kind}: expected a name, a mapping with a name, or a {expected.__name__}, got {choice!r}")


def dictionary(registry: Registry, choice: object, horizon: float) -> Dictionary:
    """The dictionary that a choice stands for, on ``[0, horizon]``."""
    if isinstance(choice, Dictionary):
        return choice
    factory: DictionaryFactory = component(registry, "dictionary", choice, DictionaryFactory)
    return factory.build(horizon)


def indicators(on: Dictionary) -> Dictionary:
    """One indicator function on each piece of another dictionary."""
    return Dictionary.indicators(on.breakpoints)
