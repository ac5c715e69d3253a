"""``sparserob simulate``: random trajectories of a finished run, and the worst cases replayed."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import json_option, out_option, plugins_option, seed_option
from sparserob_core.experiment.cli.shell.report import report


@click.command()
@click.argument("directory", metavar="RUN", type=click.Path(path_type=Path))
@click.option("--trajectories", type=int, help="How many; 10000 unless given. The law adversary takes none.")
@click.option(
    "--law",
    default="iid",
    show_default=True,
    metavar="LAW",
    help=(
        "iid (uniform, independent on every piece), vertices (random extreme points), slow (slowly varying), "
        "neighbours (of the worst cases), or adversary (the worst cases themselves)."
    ),
)
@seed_option
@json_option("simulation-LAW.json")
@out_option("Draw the trajectories into this file, which ends in .png, .pdf or .svg.")
@plugins_option
def simulate(
    directory: Path,
    trajectories: int | None,
    law: str,
    seed: int,
    as_json: bool,
    out: Path | None,
    plugins: tuple[Path, ...],
) -> int:
    """Propagate random trajectories of the finished run RUN exactly, and count how many violate each constraint.

    Writes RUN/simulation-LAW.json. A sample is no proof: the table sets beside it the worst case, which random signals
    hardly ever come near.

    Exit status: 0, 2 the input is at fault, 4 a trajectory contradicts what the run claims to have proven, 130
    interrupted.
    """
    from sparserob_core.experiment.cli.shell.live_line import LiveLine
    from sparserob_core.experiment.simulation.simulate import simulate as propagate

    with LiveLine() as line:
        simulation = propagate(directory, trajectories, law, seed, out=out, plugins=plugins, notify=line.receive)
    remarks = (
        *simulation.remarks(),
        *([] if out is None or simulation.undrawn else [f"drawn into {out}"]),
        f"written to {simulation.directory / f'simulation-{simulation.law}.json'}",
    )
    report(as_json, simulation.summary(), [(f"{simulation.title}: {simulation.law}", *simulation.table())], remarks)
    return 4 if simulation.contradicts else 0
