"""``sparserob bound``: how bad each row can become, from both sides."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import json_option, study_out_option
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import report
from sparserob_core.experiment.terminal.printing import EXIT


@click.command()
@click.argument("config", metavar="CONFIG|RUN", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option(
    "--tolerance",
    type=float,
    default=1e-6,
    show_default=True,
    help="How close the two sides are to be, relative to the worst case.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="N",
    help="Stop after N seconds: both sides hold as far as they were brought; limits.seconds of CONFIG unless given.",
)
@json_option("bound.json")
@study_out_option("bound")
def bound(
    config: Path, overrides: tuple[str, ...], tolerance: float, seconds: float | None, as_json: bool, out: Path | None
) -> int:
    """Bound the worst case of each row over all disturbances, initial states, parameters and times: without any control
    where CONFIG is a file, with the control of RUN where it is the directory of a run.

    The rows are those of path, mixed and terminal constraints with flat sides; of a problem without any, the outputs
    that it measures, or else its states. One side is reached, by a time, an initial state, a parameter and a
    disturbance that are written down; the other is proven over the continuum. `sparserob check` verifies both from the
    directory. KEY=VALUE changes the config.

    Exit status: 0 both sides are as close as was asked for, 2 the input is at fault, 4 some are farther apart, and hold
    all the same, 130 interrupted.
    """
    from sparserob_core.experiment.bound.bound import bound as find
    from sparserob_core.experiment.bound.record import list_bound_columns, list_bound_rows
    from sparserob_core.experiment.cli.shell.live_line import LiveLine

    with LiveLine() as line:
        bounds = find(config, overrides, tolerance=tolerance, seconds=seconds, out=out, write=True, notify=line.receive)
    tables = [(bounds.title, list_bound_columns(bounds), list_bound_rows(bounds))]
    remarks = (*bounds.remarks, f"{bounds.status} in {bounds.seconds:.2f} s", f"written to {bounds.directory}")
    report(as_json, bounds.summary(), tables, remarks)
    return status_unless_interrupted(EXIT[bounds.status])
