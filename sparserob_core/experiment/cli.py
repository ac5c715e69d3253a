"""The command ``sparserob``. Its exit status: 0 certified or verified, 2 the input is at fault, 3 infeasible, 4 refuted or undecided,
5 failed, 130 interrupted."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

import click

from sparserob_core.errors import SparseRobError

if TYPE_CHECKING:
    from sparserob_core.experiment.components import Registry

EXIT = {"certified": 0, "verified": 0, "infeasible": 3, "refuted": 4, "undecided": 4, "failed": 5}
INTERRUPTED = 130
DEBUG = "SPARSEROB_DEBUG"


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit; an error of the input is one message, never a traceback (unless SPARSEROB_DEBUG=1)."""
    sys.exit(_status(arguments))


def _status(arguments: Sequence[str] | None) -> int:
    try:
        return int(commands.main(args=arguments, prog_name="sparserob", standalone_mode=False) or 0)
    except click.Abort as error:
        return _end("interrupted", error.__cause__ or error, INTERRUPTED)
    except click.ClickException as error:
        error.show()
        return 2
    except SparseRobError as error:
        return _end(str(error), error, error.exit_status)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:  # noqa: BLE001  the last resort: a fault of the program is told in one line too
        return _end(f"internal error: {type(error).__name__}: {error}; {DEBUG}=1 shows where", error, 5)


def _end(message: str, error: BaseException, status: int) -> int:
    if os.environ.get(DEBUG):
        raise error
    for line in (f"error: {message}", *getattr(error, "__notes__", ())):
        click.echo(line, err=True)
    return status


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sparserob", message="%(prog)s %(version)s")
def commands() -> None:
    """Sparse robust optimal control of uncertain linear systems, with the proof."""


@commands.command()
@click.argument("config", type=click.Path(path_type=Path))
@click.argument("overrides", nargs=-1, metavar="[KEY=VALUE]...")
@click.option("--out", type=click.Path(path_type=Path), help="The run's directory, new or empty; runs/NAME/STAMP-HASH unless given.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
@click.option("--json", "as_json", is_flag=True, help="Print result.json instead of the table.")
@click.option("--figures/--no-figures", default=True, help="Whether to draw the figures.", show_default=True)
def run(config: Path, overrides: tuple[str, ...], out: Path | None, quiet: bool, as_json: bool, figures: bool) -> int:
    """Solve the experiment that CONFIG describes, and prove the answer.

    KEY=VALUE changes the config, for example: method.name=nominal problem.disturbance.box=[0.05,0.05]

    Exit status: 0 certified or verified, 2 the input is at fault, 3 infeasible, 4 refuted or undecided, 5 failed, 130 interrupted.
    """
    signal.signal(signal.SIGTERM, _interrupt)
    from sparserob_core.experiment.artefacts import finite
    from sparserob_core.experiment.run import run as run_experiment
    from sparserob_core.experiment.table import print_table, result_rows

    outcome = run_experiment(config, overrides, out, quiet=quiet or as_json, figures=figures)
    if as_json:
        _print_json(finite(outcome.summary))
    elif not quiet:
        print_table(outcome.experiment.title, (), result_rows(finite(outcome.summary)))
        for line in (*outcome.remarks, f"written to {outcome.directory}"):
            click.echo(line)
    return EXIT[outcome.status]


@commands.command()
@click.argument("name", required=False)
def plugins(name: str | None) -> int:
    """List the components that a config can name, or the options of one: NAME, or KIND.NAME."""
    from sparserob_core.experiment.registry import load_registry
    from sparserob_core.experiment.table import print_table

    registry = load_registry()
    if name is not None:
        return _describe(registry, name)
    rows = [(record.kind, record.name, record.plugin, record.summary) for record in registry.records()]
    print_table("Components", ("kind", "name", "plugin", "what it is"), rows)
    for failure in registry.failures:
        click.echo(str(failure), err=True)
    return 0


@commands.command()
def schema() -> int:
    """Print the JSON schema of a config, for the plugins that are installed."""
    from sparserob_core.experiment.registry import load_registry
    from sparserob_core.experiment.schema import config_schema

    _print_json(config_schema(load_registry()))
    return 0


@commands.command()
@click.argument("directory", metavar="RUN", type=click.Path(path_type=Path))
def figures(directory: Path) -> int:
    """Draw the figures of a finished run again, into RUN/figures."""
    from sparserob_core.experiment.drawing import draw_run

    for file in draw_run(directory):
        click.echo(str(file))
    return 0


@commands.command()
@click.argument("runs", metavar="RUN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), default=Path("compare.png"),
              help="The figure, a file that ends in .png, .pdf or .svg, replaced when it exists; compare.png unless given.")
def compare(runs: tuple[Path, ...], out: Path) -> int:
    """Compare runs of one problem: the lower bounds that they prove, against evaluations and against seconds.

    Prints a table, one row per RUN in the order given, named by what differs between the configs, and draws the bounds. An evaluation is a value
    of g, or for a method that does not search a relaxed program. When a run is certified, its value is the exact optimum: the table
    says after how many evaluations each bound was within 10 %, 1 % and 0.1 % of it.
    """
    from sparserob_core.experiment.compare import compare as read_runs
    from sparserob_core.experiment.compare import comparison_remarks, comparison_table
    from sparserob_core.experiment.compare_figure import write_comparison
    from sparserob_core.experiment.table import print_table

    comparison = read_runs(runs)
    print_table(comparison.title or "Comparison", *comparison_table(comparison))
    for line in comparison_remarks(comparison):
        click.echo(line)
    write_comparison(out, comparison)
    click.echo(f"written to {out}")
    return 0


def _describe(registry: Registry, name: str) -> int:
    from sparserob_core.experiment.option_rows import option_rows
    from sparserob_core.experiment.table import print_table

    for record in registry.find(name):
        rows = [(row.name, row.type, row.default, row.range, row.meaning) for row in option_rows(record)]
        title = f"{record.kind} {record.name} (plugin {record.plugin}): {record.summary}"
        print_table(title, ("option", "type", "default", "range", "meaning"), rows or [("none", "", "", "", "it has no options")])
    return 0


def _print_json(data: Any) -> None:
    import json

    click.echo(json.dumps(data, indent=2))


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
