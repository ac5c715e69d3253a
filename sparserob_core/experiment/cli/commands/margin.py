"""``sparserob margin``: how much uncertainty a problem bears, or how little room it needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from sparserob_core.experiment.cli.shell.options import json_option, study_out_option, watching_options
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import Table, report

EXIT = {"certified": 0, "unbounded": 0, "infeasible": 3, "undecided": 4}


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option(
    "--of",
    default="disturbance",
    show_default=True,
    metavar="WHAT",
    help="disturbance, parameters, initial_state, execution, path.0, terminal.0, control, path.0.from, or horizon;"
    " entries count from 0.",
)
@click.option(
    "--tolerance",
    type=float,
    default=1e-6,
    show_default=True,
    help="How close the two sides are to be, relative to the factor or 1.",
)
@click.option(
    "--curve", type=int, default=20, show_default=True, help="Points of the curve of cost against the factor; 0: none."
)
@json_option("margin.json")
@study_out_option("margin")
@watching_options("the search")
def margin(
    config: Path,
    overrides: tuple[str, ...],
    of: str,
    tolerance: float,
    curve: int,
    as_json: bool,
    out: Path | None,
    watch: bool,
    save: Path | None,
    serve: bool,
    connect: str | None,
) -> int:
    """Find how far something of the experiment that CONFIG describes can be changed before nothing is feasible any
    more.

    The largest factor on the set of disturbances, of parameters, of initial states, or on the initial state; the
    smallest factor on a path, terminal or control set; the earliest start of a path's window. On one side a control is
    proven feasible, on the other nothing is, by a checked certificate. Sets are scaled about their centre. KEY=VALUE
    changes the config.

    Of the horizon: the shortest that is feasible, up to the config's, with the number of pieces as it is. Feasibility
    is not monotone in it, so that every shorter horizon is proven infeasible, and the curve has both kinds.

    With --watch, or --save, --serve or --connect, it is shown as it goes on: an optional extra (pip install rerun-sdk).

    Exit status: 0 both sides are proven, or no end was found as far as was looked; 2 the input is at fault, 3 nothing
    is feasible at any factor, 4 a side could not be proven, 130 interrupted.
    """
    from sparserob_core.experiment.cli.shell.live_line import LiveLine
    from sparserob_core.experiment.margin.margin import curve_rows, margin_rows
    from sparserob_core.experiment.margin.margin import margin as find
    from sparserob_core.experiment.run.viewer import recorded, recorder

    observers = [recorder(save, serve, connect)] if watch or serve or save is not None or connect is not None else []
    options: dict[str, Any] = {
        "tolerance": tolerance,
        "curve": curve,
        "out": out,
        "write": True,
        "observers": observers,
    }
    with LiveLine() as line:
        answer = find(config, of, overrides, notify=line.receive, **options)
    tables: list[Table] = [(answer.title, (), margin_rows(answer))]
    if answer.of == "horizon" and answer.curve:
        columns = ("horizon", "status", "lower bound", "upper bound")
        tables.append(("Cost against the horizon", columns, curve_rows(answer)))
    recordings = (recording for observer in observers for recording in recorded(observer, save))
    remarks = (*answer.remarks, f"written to {answer.directory}", *recordings)
    report(as_json, answer.summary(), tables, remarks)
    if serve and answer.status != "undecided":  # the Ctrl-C that ends a page has cut nothing short
        return EXIT[answer.status]
    return status_unless_interrupted(EXIT[answer.status])
