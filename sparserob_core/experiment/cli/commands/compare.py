"""``sparserob compare`` and ``sparserob benchmark``: runs of one problem, contenders over the problems of studies, and
maximisers where the maximum is known, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from sparserob_core.errors import InputError
from sparserob_core.experiment.cli.shell.options import json_option, out_option, watching_options
from sparserob_core.experiment.cli.shell.report import report


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("compare.png"),
    help="The figure, a file that ends in .png, .pdf or .svg, replaced when it exists; compare.png unless given.",
)
@click.option(
    "--accuracy",
    type=float,
    help="For studies: how near the exact value, relative, a run must come to have solved its problem; 0.01 unless"
    " given.",
)
@click.option(
    "--measure",
    type=click.Choice(["evaluations", "seconds"]),
    help="For studies: what a run spends; evaluations unless given, or seconds where some runs do not search.",
)
@watching_options("the runs")
@json_option("the comparison as JSON", "the tables")
def compare(
    runs: tuple[Path, ...],
    out: Path,
    accuracy: float | None,
    measure: Any,
    watch: bool,
    save: Path | None,
    serve: bool,
    connect: str | None,
    as_json: bool,
) -> int:
    """Compare runs of one problem: the lower bounds that they prove, against evaluations and against seconds. Or
    compare the maximisers, solvers or methods of studies over all of their problems.

    For runs it prints a table, one row per RUN in the order given, named by what differs between the configs, and draws
    the bounds. An evaluation is a value of g, or for a method that does not search a relaxed program. When a run is
    certified, its value is the exact optimum: the table says after how many evaluations each bound was within 10 %, 1 %
    and 0.1 % of it. With --watch, or --save, --serve or --connect, the runs are side by side in the viewer of Rerun
    too, an optional extra (pip install rerun-sdk).

    For studies (each RUN is then a directory that sparserob sweep has left) it prints and draws two kinds of
    profiles. A performance profile is the share of the problems that a contender solves within a factor of what the
    best one needs. A data profile is the share that it solves within a budget. Both have medians and quartiles over
    seeds.
    """
    from sparserob_core.experiment.comparison.compare import compare as side_by_side
    from sparserob_core.experiment.comparison.compare import comparison_summary, comparison_table
    from sparserob_core.experiment.comparison.profiles import LISTED, Profiles
    from sparserob_core.experiment.comparison.studies import PROFILE_ACCURACY
    from sparserob_core.experiment.run.viewer import recorded, recorder

    watched = watch or serve or save is not None or connect is not None
    observers = [recorder(save, serve, connect)] if watched else []
    options: dict[str, Any] = {"accuracy": PROFILE_ACCURACY if accuracy is None else accuracy, "measure": measure}
    comparison = side_by_side(runs, out, **options, observers=observers)
    recordings = [line for observer in observers for line in recorded(observer, save)]
    summary = comparison.summary() if isinstance(comparison, Profiles) else comparison_summary(comparison)
    tables = (
        [comparison.table(), comparison.times_table()]
        if isinstance(comparison, Profiles)
        else [comparison_table(comparison)]
    )
    titles = [comparison.title or "Comparison", *[""] * (len(tables) - 1)]
    shown = [(title, *table) for title, table in zip(titles, tables, strict=True) if title or len(table[1]) <= LISTED]
    notes = [*summary["remarks"], *([] if comparison.undrawn else [f"written to {out}"]), *recordings]
    report(as_json, {**summary, "remarks": [*summary["remarks"], *recordings]}, shown, notes)
    return 0


@click.command()
@click.argument("maximisers", metavar="MAXIMISER...", nargs=-1, required=True)
@click.option(
    "--suite",
    "suites",
    multiple=True,
    type=click.Choice(["standard", "classic", "bbob", "g"]),
    help="What to maximise: six functions, twelve classic ones, the 24 of BBOB, g of configs; standard unless given.",
)
@click.option("--config", "configs", multiple=True, type=click.Path(path_type=Path), help="A config for the suite g.")
@click.option("--budget", type=int, default=1000, show_default=True, help="Evaluations of every search.")
@click.option("--seeds", type=int, default=5, show_default=True, help="Searches of each on each landscape.")
@click.option("--accuracy", type=float, default=1e-3, show_default=True, help="What counts as solved.")
@click.option("--polish", type=float, default=0.0, show_default=True, help="Share of the budget for a local method.")
@out_option("A new or empty directory for profiles.png, benchmark.json and ioh/, which IOHanalyzer reads.")
@json_option("everything as JSON", "the tables")
def benchmark(
    maximisers: tuple[str, ...],
    suites: tuple[str, ...],
    configs: tuple[Path, ...],
    budget: int,
    seeds: int,
    accuracy: float,
    polish: float,
    out: Path | None,
    as_json: bool,
) -> int:
    """Compare maximisers where the maximum is known: data profiles over the landscapes, the expected number of
    evaluations until success, and the time that each takes for itself.

    MAXIMISER is a name, or a mapping with options such as '{name: lipo, constant: 30}'. The landscapes of g are those
    of the paper's algorithm, tuples of eight reduced indices, and their maximum is certified by the exchange.
    """
    from sparserob_core.experiment.benchmark.benchmark import benchmark as side_by_side
    from sparserob_core.experiment.cli.shell.live_line import LiveLine

    choices = [_parse_choice(text) for text in maximisers]
    with LiveLine() as line:
        results = side_by_side(
            choices,
            suites or ("standard",),
            budget=budget,
            seeds=seeds,
            accuracy=accuracy,
            polish=polish,
            configs=configs or None,
            out=out,
            notify=line.receive,
        )
    summary = results.summary()
    tables = [(results.profiles.title, *results.table()), ("", *results.times_table())]
    written = [] if out is None else [f"written to {out}"]
    report(as_json, summary, tables, [*summary["remarks"], *written])
    return 0


def _parse_choice(text: str) -> str | Mapping[str, Any]:
    """A name, or a mapping with a name and options."""
    from sparserob_core.experiment.config.reading.reader import read_value

    value = read_value(text) if text.strip().startswith("{") else text
    if isinstance(value, str | Mapping):
        return value
    raise InputError(f"maximisers: expected a name or a mapping with a name, got {text!r}")
