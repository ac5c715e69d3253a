"""``sparserob sweep``: a config at every point of some axes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

import click

from sparserob_core.errors import InputError
from sparserob_core.experiment.cli.shell.options import out_option, watching_options
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import report

if TYPE_CHECKING:
    from sparserob_core.experiment.sweep.sweep import Outline


@click.command()
@click.argument("config", type=click.Path(path_type=Path), required=False)
@click.argument("axes", nargs=-1, metavar="[KEY=VALUES]...")
@click.option("--zip", "zipped", is_flag=True, help="Take the first values of all axes together, then the second, ...")
@click.option("--random", type=int, metavar="N", help="Draw N points at random; ranges are written start:stop.")
@click.option("--sobol", type=int, metavar="N", help="Draw N points along a scrambled sequence of Sobol.")
@click.option("--dry-run", is_flag=True, help="Print the points and whether they are finished; write nothing.")
@click.option(
    "--point",
    type=int,
    metavar="N",
    help="Run only this point, from 0 as --dry-run counts them, into the study's directory; other processes may run "
    "others there meanwhile. The table follows with --resume.",
)
@click.option(
    "--executor",
    metavar="NAME",
    help="Where the runs are made: a name, or '{name: processes, workers: 2}'; the config's own unless given.",
)
@out_option(
    "A new directory, or that of a study of the same base to go on with; runs/NAME-sweep/STAMP-HASH unless given."
)
@click.option("--resume", type=click.Path(path_type=Path), metavar="DIR", help="Go on with the study in DIR.")
@click.option("--figures/--no-figures", default=False, help="Whether to draw every run too.", show_default=True)
@watching_options("the study")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
@click.option("--json", "as_json", is_flag=True, help="Print the table as JSON instead.")
def sweep(
    config: Path | None,
    axes: tuple[str, ...],
    zipped: bool,
    random: int | None,
    sobol: int | None,
    dry_run: bool,
    point: int | None,
    executor: str | None,
    out: Path | None,
    resume: Path | None,
    figures: bool,
    watch: bool,
    save: Path | None,
    serve: bool,
    connect: str | None,
    quiet: bool,
    as_json: bool,
) -> int:
    """Run CONFIG at every point of some axes, and make one table of it.

    KEY=VALUES is an axis: values (method=exchange,scenario), start:stop:count (seed=0:19:20), or
    log:start:stop:count (continuation.stop=log:1e-6:1:13); commas inside brackets do not split. One value changes the
    config for all points. CONFIG may also be a study's file, with the keys base and axes. What is finished in the
    directory is not run again; a point that fails is a row that says why. With --watch, or --save, --serve or
    --connect, as those of sparserob watch, it is shown as it goes on: an optional extra (pip install rerun-sdk).

    Exit status: 0 every point has an answer, whatever it is; 2 the input is at fault, 5 a point failed, 130
    interrupted.
    """
    from sparserob_core.experiment.cli.shell.live_table import LiveTable
    from sparserob_core.experiment.config.reading.reader import read_value
    from sparserob_core.experiment.run.viewer import recorded, recorder
    from sparserob_core.experiment.sweep.study import remarks_of, shown
    from sparserob_core.experiment.sweep.sweep import outline
    from sparserob_core.experiment.sweep.sweep import sweep as run_study
    from sparserob_core.sip.events import ignore

    if resume is not None and config is not None and "=" in str(config):
        config, axes = None, (str(config), *axes)
    if (config is None) == (resume is None):
        raise InputError("expected either CONFIG or --resume DIR, got " + ("neither" if config is None else "both"))
    if resume is not None and out is not None:
        raise InputError("--out: a study that is resumed stays in its directory; expected --resume DIR alone")
    arrangements = {"zip": zipped or None, "random": random, "sobol": sobol}
    chosen = [name for name, value in arrangements.items() if value is not None]
    if len(chosen) > 1:
        raise InputError(
            "expected one of --zip, --random and --sobol, got " + " and ".join(f"--{name}" for name in chosen)
        )
    watched = watch or serve or save is not None or connect is not None
    if dry_run and (watched or point is not None):
        raise InputError("--dry-run: expected neither --point nor a viewer beside it, for nothing is run")
    observers = [recorder(save, serve, connect)] if watched else []
    live = LiveTable()
    options: dict[str, Any] = {
        "config": config if config is not None else resume,
        "axes": axes,
        "points": chosen[0] if chosen else None,
        "number": random if random is not None else sobol,
        "executor": None if executor is None else read_value(executor),
        "out": out,
        "notify": ignore if quiet else live.receive,
    }
    if dry_run:
        with live:
            planned = outline(**options)
        _print_outline(planned, quiet, as_json)
        return 0
    with live:
        study = run_study(**options, point=point, figures=figures, observers=observers)
    study = replace(
        study, remarks=(*study.remarks, *(line for observer in observers for line in recorded(observer, save)))
    )
    if as_json or not quiet:
        resume_hint = f"; the table of all points: sparserob sweep --resume {quote(str(study.directory))}"
        remarks = (*remarks_of(study), f"written to {study.directory}{'' if point is None else resume_hint}")
        report(as_json, {**study.summary(), "table": study.table}, [(study.title, *shown(study))], remarks)
    status = 5 if study.failed else 0
    # the Ctrl-C that ends a page has cut nothing short
    return status if serve and not study.stopped else status_unless_interrupted(status)


def _print_outline(planned: Outline, quiet: bool, as_json: bool) -> None:
    """Print the points of a study that is not run."""
    data = planned.summary()
    count, ended = len(data["points"]), sum(row["finished"] for row in data["points"])
    remark = f"{count} point{'s' * (count != 1)}, {ended} finished; nothing was run or written"
    if as_json or not quiet:
        report(as_json, data, [(data["title"], *planned.shown())], [remark])
