"""Runs of one problem side by side: the lower bounds that they prove, against the evaluations and the seconds that
these take."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.comparison.comparison import Comparison
from sparserob_core.experiment.comparison.curve import WITHOUT_CURVE, Curve, read_curve
from sparserob_core.experiment.comparison.figure import draw_comparison
from sparserob_core.experiment.comparison.labels import labels
from sparserob_core.experiment.comparison.profiles import Measure, Profiles
from sparserob_core.experiment.comparison.profiles_figure import draw_profiles
from sparserob_core.experiment.comparison.studies import BOUND_CONTRADICTION, PROFILE_ACCURACY, is_study, read_profiles
from sparserob_core.experiment.config.plain import difference, value_text
from sparserob_core.experiment.figures.style import missing_matplotlib, require_writable, save_figure
from sparserob_core.experiment.run.events import Broadcast, Event, Observer, SweepFinished, SweepStarted
from sparserob_core.experiment.run.given import GivenRun, as_run

SHARES = (0.1, 0.01, 0.001)


def compare(
    runs: Sequence[GivenRun],
    out: str | Path | None = None,
    *,
    accuracy: float = PROFILE_ACCURACY,
    measure: Measure | None = None,
    observers: Iterable[Observer] = (),
) -> Comparison | Profiles:
    """Read runs (`as_run`), or studies, and draw them into the picture ``out`` (.png, .pdf or .svg) when it is given:
    what ``sparserob compare`` does.

    Runs of one problem give a `Comparison`. Studies (what ``sparserob sweep`` leaves) give `Profiles` of their
    contenders over all of their problems: a run has solved its problem within ``accuracy``, relative to the exact
    value, and what it took is measured in evaluations, or in seconds; unless ``measure`` says which, in evaluations
    where all runs search. Where matplotlib is missing there is no picture, and the remarks say so. ``observers`` are
    shown the runs, as the points of a study that is over.

    Raises `InputError` when one of them is no run directory and no study, and when runs are not all of one problem on
    the same dictionaries. So it does when studies are not finished or have one contender only, and when there are
    observers of studies. The last reasons are that there is nothing to draw, and that the picture cannot be written.
    """
    if isinstance(runs, str | Path) or not runs:
        raise InputError(f"runs: expected a list of at least one run directory, got {runs!r}")
    if out is not None:
        require_writable(Path(out))
    directories = [as_run(run)[0] for run in runs]
    studies = [directory for directory in directories if is_study(directory)]
    broadcast = Broadcast([(type(observer).__name__, observer) for observer in observers])
    if studies and broadcast.heard:
        raise InputError(
            f"{studies[0]}: expected runs to be watched side by side, got a study; it is watched as it runs"
        )
    if studies and len(studies) < len(directories):
        run_directory = next(directory for directory in directories if directory not in studies)
        raise InputError(
            f"{run_directory}: expected a study beside {studies[0]}; a study is compared with studies only"
        )
    comparison: Comparison | Profiles
    comparison = read_profiles(studies, accuracy, measure) if studies else _compare_runs(directories)
    if out is not None and (missing := missing_matplotlib()):
        comparison = replace(comparison, undrawn=missing)
    elif out is not None:
        _draw_comparison(Path(out), comparison)
    if broadcast.heard and isinstance(comparison, Comparison):
        for event in events_of(comparison):
            broadcast(event)
    return comparison


def _draw_comparison(file: Path, comparison: Comparison | Profiles) -> None:
    """Draw a comparison into a file; raises `InputError` where there is nothing to draw, or it cannot be written."""
    if isinstance(comparison, Profiles):
        save_figure(file, draw_profiles, comparison)
        return
    if not any(curve.bound.size for curve in comparison.curves):
        raise InputError(f"{file}: nothing to draw; no run has a lower bound to show")
    save_figure(file, draw_comparison, comparison)


def events_of(comparison: Comparison) -> Iterator[Event]:
    """Yield what observers of a study would have heard whose points are the runs of a comparison."""
    seconds = max((curve.all_seconds for curve in comparison.curves if np.isfinite(curve.all_seconds)), default=0.0)
    yield SweepStarted(
        title=comparison.title or "runs of one problem",
        directory=Path(),
        axes=["run"],
        logarithmic=[False],
        points=[(label,) for label in comparison.labels],
        arrangement="runs",
        runs=Path(),
    )
    rows = {index: _make_row(curve) for index, curve in enumerate(comparison.curves)}
    yield SweepFinished(rows=rows, seconds=seconds, answer=next(comparison_remarks(comparison)))


def _make_row(curve: Curve) -> dict[str, Any]:
    """The row of a run, as in the table of a study; what is not known is null."""
    values = {
        "cost": curve.cost,
        "lower_bound": curve.lower_bound,
        "upper_bound": curve.upper_bound,
        "gap": curve.gap,
        "seconds": curve.all_seconds,
    }
    numbers = {name: value if np.isfinite(value) else None for name, value in values.items()}
    return {"run": str(curve.directory.resolve()), "status": curve.status, "message": curve.message, **numbers}


def _compare_runs(places: Sequence[Path]) -> Comparison:
    curves = [read_curve(directory) for directory in places]
    for curve in curves[1:]:
        _require_same_problem(curves[0], curve)
    names = labels([curve.config for curve in curves], [curve.searched for curve in curves])
    certified = min(
        (k for k, curve in enumerate(curves) if curve.status == "certified"),
        key=lambda k: curves[k].gap,
        default=None,
    )
    exact = np.nan if certified is None else (curves[certified].lower_bound + curves[certified].upper_bound) / 2
    return Comparison(curves, names, exact, certified)


def comparison_table(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Column names, and one row per run; what is relative to the exact value only when it is known."""
    is_known = np.isfinite(comparison.exact)
    relative = (
        ["share of exact", *(f"to {share:.4g} %" for share in (100 * share for share in SHARES))] if is_known else []
    )
    unit = f" [{comparison.cost_unit}]" if comparison.cost_unit else ""
    bounds = [f"lower bound{unit}", f"cost{unit}"]
    columns = ["run", "status", *bounds, *relative, "worst violation", "evaluations", "seconds"]
    rows = []
    for curve, label in zip(comparison.curves, comparison.labels, strict=True):
        relative_entries = (
            [
                _format_value(comparison.share(curve.lower_bound), ".4%"),
                *(_format_value(comparison.within(curve, share), ".0f") for share in SHARES),
            ]
            if is_known
            else []
        )
        rows.append(
            [
                label,
                curve.status,
                _format_value(curve.lower_bound, ".9g"),
                _format_value(curve.cost, ".9g"),
                *relative_entries,
                f"{_format_value(curve.violation, '.2e')} {curve.measured}".rstrip(),
                _format_value(curve.all_evaluations, ".0f"),
                _format_value(curve.all_seconds, ".3f"),
            ]
        )
    return columns, rows


def comparison_remarks(comparison: Comparison) -> Iterator[str]:
    """Yield the notes to be printed with the table: the source of the exact value, runs without a curve, and bounds
    that contradict the exact value."""
    unit = f" {comparison.cost_unit}" if comparison.cost_unit else ""
    if comparison.certified is None:
        yield "no run is certified: the exact optimum is not known, and no line is drawn for it"
        above = np.inf
    else:
        best = comparison.curves[comparison.certified]
        yield (
            f"exact optimum {comparison.exact:.9g}{unit}: certified by {comparison.labels[comparison.certified]} "
            f"to a relative gap of {best.gap:.1e}"
        )
        above = best.upper_bound + BOUND_CONTRADICTION * max(1.0, abs(best.upper_bound))
    for curve, label in zip(comparison.curves, comparison.labels, strict=True):
        if not curve.bound.size:
            yield f"no curve of {label}: {_explain_missing_curve(curve)}"
        elif curve.bound[-1] > above:
            yield (
                f"the lower bound of {label} exceeds the certified upper bound {best.upper_bound:.9g}{unit}: one of"
                " the two is wrong"
            )
    if comparison.undrawn:
        yield comparison.undrawn


def comparison_summary(comparison: Comparison) -> dict[str, Any]:
    """The comparison as plain data; what is not known is null."""
    is_known = np.isfinite(comparison.exact)
    runs = [
        {
            "label": label,
            "directory": str(curve.directory),
            "status": curve.status,
            "lower_bound": curve.lower_bound,
            "upper_bound": curve.upper_bound,
            "cost": curve.cost,
            "violation": curve.violation,
            "evaluations": curve.all_evaluations,
            "seconds": curve.all_seconds,
            "evaluations_within": {str(share): comparison.within(curve, share) for share in SHARES} if is_known else {},
        }
        for curve, label in zip(comparison.curves, comparison.labels, strict=True)
    ]
    return {
        "title": comparison.title,
        "exact": comparison.exact,
        "runs": runs,
        "remarks": list(comparison_remarks(comparison)),
    }


def _explain_missing_curve(curve: Curve) -> str:
    return f"{curve.status}: {curve.message}" if curve.status in WITHOUT_CURVE else "no finite lower bound was proven"


def _format_value(value: float, form: str) -> str:
    return format(value, form) if np.isfinite(value) else "-"


def _require_same_problem(first: Curve, other: Curve) -> None:
    if first.counts is not other.counts:
        counting, plain = (first, other) if first.counts else (other, first)
        raise InputError(
            f"{counting.directory}: its cost is the time that the control acts, that of {plain.directory} is J; "
            "expected runs whose costs mean the same"
        )
    for section in ("problem", "dictionaries"):
        mismatch = difference(first.config.get(section), other.config.get(section), section)
        if mismatch is not None:
            path, first_value, other_value = mismatch
            raise InputError(
                f"{other.directory}: expected a run of the same problem as {first.directory}; "
                f"{path} is {value_text(other_value)} here and {value_text(first_value)} there"
            )
