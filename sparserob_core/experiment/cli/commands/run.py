"""``sparserob run``: solve an experiment and prove the answer."""

from __future__ import annotations

from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import figures_option, json_option, out_option
from sparserob_core.experiment.cli.shell.process import status_unless_interrupted
from sparserob_core.experiment.cli.shell.report import report
from sparserob_core.experiment.terminal.printing import EXIT


@click.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@out_option("The run's directory, new or empty; runs/NAME/STAMP-HASH unless given.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
@json_option("result.json")
@figures_option
def run(config: Path, overrides: tuple[str, ...], out: Path | None, quiet: bool, as_json: bool, figures: bool) -> int:
    """Solve the experiment that CONFIG describes, and prove the answer.

    KEY=VALUE changes the config, for example: method.name=nominal problem.disturbance.box=[0.05,0.05]

    Exit status: 0 certified or verified, 2 the input is at fault, 3 infeasible, 4 refuted or undecided, 5 failed, 130
    interrupted.
    """
    from sparserob_core.experiment.directory.artefacts import finite
    from sparserob_core.experiment.run.run import run as run_experiment
    from sparserob_core.experiment.terminal.table import result_rows

    outcome = run_experiment(config, overrides, out, quiet=quiet or as_json, figures=figures)
    if as_json or not quiet:
        summary = finite(outcome.summary)
        remarks = (*outcome.remarks, f"written to {outcome.directory}")
        report(as_json, summary, [(outcome.experiment.title, (), result_rows(summary))], remarks)
    return status_unless_interrupted(EXIT[outcome.status])
