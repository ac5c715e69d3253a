"""``sparserob loop``: a proven control in closed loop, applied or solved anew at every step."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import (
    figures_option,
    json_option,
    out_option,
    plugins_option,
    seed_option,
)
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import report
from sparserob_core.experiment.terminal.printing import EXIT, printable


@click.command()
@click.argument("source", metavar="CONFIG|RUN", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option("--resolve", is_flag=True, help="Solve what is left of the horizon anew at every step.")
@click.option("--seconds", type=float, help="With --resolve: about how long a step may take; no limit unless given.")
@click.option("--trajectories", type=int, help="Loops of every law; 10 unless given, 1 with --resolve.")
@click.option("--periods", type=int, default=1, help="Of a plan that repeats: for how many periods; 1 unless given.")
@seed_option
@json_option("loop.json")
@out_option("For a CONFIG: the run's directory, new or empty; runs/NAME/STAMP-HASH unless given.")
@figures_option
@plugins_option
def loop(
    source: Path,
    overrides: tuple[str, ...],
    resolve: bool,
    seconds: float | None,
    trajectories: int | None,
    periods: int,
    seed: int,
    as_json: bool,
    out: Path | None,
    figures: bool,
    plugins: tuple[Path, ...],
) -> int:
    """Close the loop around the exact system: the measured state goes in at every breakpoint, the control of the next
    piece comes out.

    A CONFIG is run first; a RUN must have a proven control. Writes loop.json and figures/loop.png in the run's
    directory. The disturbances are the worst case of every constraint, and those of the laws of simulate.

    Exit status: 0, 2 the input is at fault, 3 the config is infeasible, 4 no control is proven, or a loop contradicts
    the proof; 130 interrupted.
    """
    from sparserob_core.control.loop.resolving import PROVEN
    from sparserob_core.errors import InputError
    from sparserob_core.experiment.cli.shell.live_line import LiveLine
    from sparserob_core.experiment.loop.loop import loop as close
    from sparserob_core.experiment.run.run import run

    finished: object = source
    if source.is_dir():
        if overrides or out is not None:
            argument = f"{overrides[0]!r}" if overrides else "--out"
            raise InputError(
                f"{source} is a finished run: expected no KEY=VALUE and no --out beside it, got {argument}"
            )
    else:
        outcome = run(source, overrides, out, quiet=as_json, figures=figures)
        if outcome.status not in PROVEN:
            click.echo(printable(f"no loop without a proven control; the status is '{outcome.status}'"), err=True)
            click.echo(printable(f"{outcome.result.message}\nwritten to {outcome.directory}"), err=True)
            return status_unless_interrupted(EXIT[outcome.status])
        finished = outcome
    directory = Path(getattr(finished, "directory", source))
    picture = directory / "figures" / "loop.png" if figures else None
    with LiveLine() as line:
        loops = close(
            finished,  # type: ignore[arg-type]
            resolve,
            trajectories,
            seed,
            seconds=seconds,
            periods=periods,
            out=picture,
            plugins=plugins,
            notify=line.receive,
        )
    remarks = (*loops.remarks(), f"written to {directory / 'loop.json'}")
    report(as_json, loops.summary(), [(f"{loops.title}: closed loop", *loops.table())], remarks)
    return status_unless_interrupted(4 if loops.contradicts else 0)
