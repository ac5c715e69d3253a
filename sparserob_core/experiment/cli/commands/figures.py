"""``sparserob figures``: draw the figures of a run again."""

from __future__ import annotations

from pathlib import Path

import click


@click.command()
@click.argument("directory", metavar="RUN", type=click.Path(path_type=Path))
def figures(directory: Path) -> int:
    """Draw the figures of a finished run again, into RUN/figures."""
    from sparserob_core.experiment.figures.drawing import draw_run

    for file in draw_run(directory):
        click.echo(str(file))
    return 0
