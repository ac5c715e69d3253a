"""``sparserob replay``: a finished run in the viewer."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import plugins_option
from sparserob_core.experiment.terminal.printing import say


@click.command()
@click.argument("directory", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "--save",
    type=click.Path(path_type=Path),
    help="Record into this new file instead, for a machine without a display.",
)
@click.option("--serve", is_flag=True, help="Show it in a browser of this machine, until Ctrl-C.")
@click.option("--connect", metavar="ADDRESS", help="Send it to a viewer that listens there, such as 127.0.0.1:9876.")
@plugins_option
def replay(directory: Path, save: Path | None, serve: bool, connect: str | None, plugins: tuple[Path, ...]) -> int:
    """Show the finished run RUN in the viewer of Rerun; nothing is solved again.

    An optional extra: pip install rerun-sdk. The controls of all rounds come from RUN/rounds.npz; the searches
    for violated constraints are only in a recording that was made during the run.
    """
    from sparserob_core.experiment.run.replay import replay as replay_run

    replay_run(directory, save=save, serve=serve, connect=connect, plugins=plugins, remark=say)
    return 0
