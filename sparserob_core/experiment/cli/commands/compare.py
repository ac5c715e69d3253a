"""``sparserob compare``: runs of one problem side by side."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.terminal.printing import printable


@click.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("compare.png"),
    help="The figure, a file that ends in .png, .pdf or .svg, replaced when it exists; compare.png unless given.",
)
def compare(runs: tuple[Path, ...], out: Path) -> int:
    """Compare runs of one problem: the lower bounds that they prove, against evaluations and against seconds.

    Prints a table, one row per RUN in the order given, named by what differs between the configs, and draws the bounds.
    An evaluation is a value of g, or for a method that does not search a relaxed program. When a run is certified, its
    value is the exact optimum: the table says after how many evaluations each bound was within 10 %, 1 % and 0.1 % of
    it.
    """
    from sparserob_core.experiment.comparison.compare import compare as read_runs
    from sparserob_core.experiment.comparison.compare import comparison_remarks, comparison_table
    from sparserob_core.experiment.comparison.figure import write_comparison
    from sparserob_core.experiment.figures.style import missing_matplotlib, require_writable
    from sparserob_core.experiment.terminal.table import print_table

    require_writable(out)
    comparison = read_runs(runs)
    print_table(comparison.title or "Comparison", *comparison_table(comparison))
    for line in comparison_remarks(comparison):
        click.echo(printable(line))
    missing = missing_matplotlib()
    if not missing:
        write_comparison(out, comparison)
    click.echo(missing or f"written to {out}")
    return 0
