"""``sparserob watch``: a run before one's eyes."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import figures_option, out_option
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import report
from sparserob_core.experiment.terminal.printing import EXIT


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option(
    "--save",
    type=click.Path(path_type=Path),
    help="Record into this new file instead, for a machine without a display.",
)
@click.option("--serve", is_flag=True, help="Show it in a browser of this machine, until Ctrl-C.")
@click.option("--connect", metavar="ADDRESS", help="Send it to a viewer that listens there, such as 127.0.0.1:9876.")
@out_option("The run's directory, new or empty; runs/NAME/STAMP-HASH unless given.")
@figures_option
def watch(
    config: Path,
    overrides: tuple[str, ...],
    save: Path | None,
    serve: bool,
    connect: str | None,
    out: Path | None,
    figures: bool,
) -> int:
    """Run the experiment that CONFIG describes, and watch it in the viewer of Rerun while it runs.

    An optional extra: pip install rerun-sdk. The result is that of sparserob run, and so is the exit status.
    """
    from sparserob_core.experiment.directory.artefacts import finite
    from sparserob_core.experiment.run.watch import watch as watch_run
    from sparserob_core.experiment.terminal.table import result_rows

    outcome = watch_run(config, overrides, out, save=save, serve=serve, connect=connect, figures=figures)
    tables = [(outcome.experiment.title, (), result_rows(finite(outcome.summary)))]
    report(False, {}, tables, (f"written to {outcome.directory}", *outcome.remarks))
    return EXIT[outcome.status] if serve else status_unless_interrupted(EXIT[outcome.status])
