"""The command ``sparserob``. Its exit status: 0 certified or verified, 2 the input is at fault, 3 infeasible, 4 refuted
or undecided, 5 failed, 130 interrupted."""

from __future__ import annotations

import gc
import os
import re
import sys
from collections.abc import Callable, Sequence
from functools import wraps
from typing import Any

import click

from sparserob_core.errors import SparseRobError, named
from sparserob_core.experiment.cli.catalogue.examples import examples
from sparserob_core.experiment.cli.catalogue.plugins import new_plugin, plugins
from sparserob_core.experiment.cli.catalogue.schema import schema
from sparserob_core.experiment.cli.commands.bound import bound
from sparserob_core.experiment.cli.commands.check import check
from sparserob_core.experiment.cli.commands.compare import benchmark, compare
from sparserob_core.experiment.cli.commands.figures import figures
from sparserob_core.experiment.cli.commands.initial_states import initial_states
from sparserob_core.experiment.cli.commands.loop import loop
from sparserob_core.experiment.cli.commands.margin import margin
from sparserob_core.experiment.cli.commands.replay import replay
from sparserob_core.experiment.cli.commands.run import run
from sparserob_core.experiment.cli.commands.simulate import simulate
from sparserob_core.experiment.cli.commands.sweep import sweep
from sparserob_core.experiment.cli.commands.watch import watch
from sparserob_core.experiment.cli.shell.process import (
    INTERRUPTED,
    OutputError,
    drop_output,
    hand_back_output,
    listen,
    open_streams,
    spare_imports,
)
from sparserob_core.experiment.terminal.printing import own_output, printable

DEBUG = "SPARSEROB_DEBUG"
# Allocations between two searches for cycles: at first nearly all are of modules, which stay.
RARELY = (200_000, 20, 20)
QUESTIONS = frozenset({"-h", "--help", "--version"})  # that need no numbers


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command and exit; an error of the input is one message, never a traceback (unless SPARSEROB_DEBUG=1).

    Ctrl-C and SIGTERM end it with what is known by then, and the status 130; a second one ends it at once.
    """
    command_line = sys.argv[1:] if arguments is None else arguments
    gc.set_threshold(*RARELY)
    listen()
    open_streams()
    if command_line and QUESTIONS.isdisjoint(command_line):
        spare_imports()
    try:
        status = _run_command_line(command_line)
    finally:
        hand_back_output()
    sys.exit(status)


def _run_command_line(arguments: Sequence[str]) -> int:
    try:
        status = int(commands.main(args=list(arguments), prog_name="sparserob", standalone_mode=False) or 0)
        sys.stdout.flush()
        return status
    except click.Abort as error:
        cause = error.__cause__ or error
        return _report_error(str(cause) or "interrupted from the keyboard", cause, INTERRUPTED)
    except click.ClickException as error:
        if not arguments:  # the help
            error.show()
            return 2
        return _report_error(_describe_usage_error(error), error, 2)
    except SparseRobError as error:
        if isinstance(error, OutputError):
            drop_output()
        return _report_error(str(error), error, error.exit_status)
    except BrokenPipeError:
        drop_output()
        return 0
    except MemoryError as error:
        return _report_error("out of memory; fewer pieces, cells or trajectories need less", error, 5)
    except Exception as error:  # noqa: BLE001  the last resort: a fault of the program is one line too
        description = named(error)
        return _report_error(f"internal error: {description}; {DEBUG}=1 shows where", error, 5)


def _describe_usage_error(error: click.ClickException) -> str:
    """Describe a fault of the command line in one line, with the command that prints the correct usage."""
    text = " ".join(error.format_message().split()).rstrip(".")
    text = re.sub(r"\\u(dc[89a-f][0-9a-f])", lambda byte: chr(int(byte[1], 16)), text)  # click names things by `repr`
    context = error.ctx if isinstance(error, click.UsageError) else None
    return f"{text[:1].lower()}{text[1:]}" + (
        "" if context is None else f" (`{context.command_path} --help` says more)"
    )


def _report_error(message: str, error: BaseException, status: int) -> int:
    if os.environ.get(DEBUG):
        raise error
    for line in (f"error: {message}", *getattr(error, "__notes__", ())):
        click.echo(printable(line), err=True)
    return status


class Commands(click.Group):
    """The group of all commands. A reader that has stopped reading is met here, before click would end with 1; what
    components print while a command runs goes to the standard error stream."""

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command, whose output is its own."""
        if cmd.callback is not None:
            cmd.callback = _with_own_output(cmd.callback)
        super().add_command(cmd, name)

    def invoke(self, ctx: click.Context) -> Any:
        """The command's exit status."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            drop_output()
            return 0


def _with_own_output(command: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(command)
    def called(*arguments: Any, **options: Any) -> Any:
        with own_output():
            return command(*arguments, **options)

    return called


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sparserob", message="%(prog)s %(version)s")
def commands() -> None:
    """Sparse robust optimal control of uncertain linear systems, with the proof."""


for command in (
    run,
    sweep,
    watch,
    replay,
    check,
    simulate,
    loop,
    margin,
    bound,
    initial_states,
    compare,
    benchmark,
    figures,
    plugins,
    new_plugin,
    examples,
    schema,
):
    commands.add_command(command)
