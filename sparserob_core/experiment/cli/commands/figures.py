"""``sparserob figures``: draw the figures of a run again."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import plugins_option
from sparserob_core.experiment.terminal.printing import say


@click.command()
@click.argument("directory", metavar="RUN", type=click.Path(path_type=Path))
@plugins_option
def figures(directory: Path, plugins: tuple[Path, ...]) -> int:
    """Draw the figures of a finished run again, into RUN/figures.

    Of a run that searches the landscape of g is evaluated once more, which takes about four seconds.
    """
    from sparserob_core.experiment.cli.shell.live_line import LiveLine
    from sparserob_core.experiment.run.drawing import draw_run

    with LiveLine() as line:
        files = draw_run(directory, plugins, line.receive)
    for file in files:
        say(str(file))
    return 0
