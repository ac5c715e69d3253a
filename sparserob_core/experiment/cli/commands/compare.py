"""``sparserob compare``: runs of one problem side by side, or contenders over the problems of studies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sparserob_core.experiment.terminal.printing import print_json, printable


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
@click.option("--json", "as_json", is_flag=True, help="Print the comparison as JSON instead of the tables.")
def compare(runs: tuple[Path, ...], out: Path, accuracy: float | None, measure: Any, as_json: bool) -> int:
    """Compare runs of one problem: the lower bounds that they prove, against evaluations and against seconds. Or
    compare the maximisers, solvers or methods of studies over all of their problems.

    For runs it prints a table, one row per RUN in the order given, named by what differs between the configs, and draws
    the bounds. An evaluation is a value of g, or for a method that does not search a relaxed program. When a run is
    certified, its value is the exact optimum: the table says after how many evaluations each bound was within 10 %, 1 %
    and 0.1 % of it.

    For studies (each RUN is then a directory that sparserob sweep has left) it prints and draws performance profiles,
    which share of the problems each contender solves within a factor of what the best one needs, and data profiles,
    which share it solves within a budget; medians and quartiles over seeds.
    """
    from sparserob_core.experiment.comparison.compare import compare as side_by_side
    from sparserob_core.experiment.comparison.compare import comparison_remarks, comparison_summary, comparison_table
    from sparserob_core.experiment.comparison.profiles import LISTED, Profiles
    from sparserob_core.experiment.comparison.studies import ACCURACY
    from sparserob_core.experiment.directory.artefacts import finite
    from sparserob_core.experiment.terminal.table import print_table

    found = side_by_side(runs, out, accuracy=ACCURACY if accuracy is None else accuracy, measure=measure)
    if as_json:
        print_json(finite(found.summary() if isinstance(found, Profiles) else comparison_summary(found)))
        return 0
    tables = [found.table(), found.times_table()] if isinstance(found, Profiles) else [comparison_table(found)]
    for number, (columns, rows) in enumerate(tables):
        if number == 0 or len(rows) <= LISTED:
            print_table((found.title or "Comparison") if number == 0 else "", columns, rows)
    for line in found.remarks() if isinstance(found, Profiles) else comparison_remarks(found):
        click.echo(printable(line))
    if not found.undrawn:
        click.echo(f"written to {out}")
    return 0
