"""The command ``sparserob``. Its exit status: 0 certified or verified, 2 the input is at fault, 3 infeasible, 4 refuted
or undecided, 5 failed, 130 interrupted."""

from __future__ import annotations

import gc
import os
import re
import sys
from collections.abc import Sequence
from copy import copy
from functools import wraps
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import click

from sparserob_core.errors import PluginError, SparseRobError, UnknownPluginError, named
from sparserob_core.experiment.cli.shell.process import (
    INTERRUPTED,
    OutputError,
    drop_output,
    hand_back_output,
    listen,
    open_streams,
    spare_imports,
)
from sparserob_core.experiment.plugins.commands import COMMANDS, MAX_STATUS, is_status
from sparserob_core.experiment.terminal.printing import own_output, printable

if TYPE_CHECKING:
    from sparserob_core.experiment.plugins.hookspecs import CommandPlugin

DEBUG = "SPARSEROB_DEBUG"
# Allocations between two searches for cycles: at first nearly all are of modules, which stay.
RARELY = (200_000, 20, 20)
# errors of a command that have a message of their own
PASSING = (SparseRobError, click.ClickException, click.exceptions.Exit, click.Abort, OSError, MemoryError)
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
    """The commands of the core, and those of plugins, which are searched where the core has none of that name.

    A reader that has stopped reading is met here, before click would end with 1. What components print while a command
    of the core runs goes to the standard error stream.
    """

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all commands, as they are typed, sorted."""
        return sorted({*COMMANDS, *_list_foreign()[0]})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the command of a name; ``None`` where there is none."""
        if cmd_name in COMMANDS:
            return _load_own(COMMANDS[cmd_name][0])
        records, notes = _list_foreign()
        if cmd_name in records:
            return _load_foreign(records[cmd_name])
        if notes:
            raise UnknownPluginError(f"no such command '{cmd_name}'{notes}")
        return None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write every command with its summary; none of them is loaded."""
        summaries = {name: summary for name, (_, summary) in COMMANDS.items()}
        summaries |= {name: record.summary for name, record in _list_foreign()[0].items()}
        with formatter.section("Commands"):
            formatter.write_dl(sorted(summaries.items()))

    def invoke(self, ctx: click.Context) -> Any:
        """The command's exit status."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError:
            drop_output()
            return 0


def _list_foreign() -> tuple[dict[str, CommandPlugin], str]:
    """Return the records of the commands of installed plugins, by the names that are typed, and why one may be
    missing."""
    from sparserob_core.experiment.plugins.registry import load_registry

    registry = load_registry()
    records = (cast("CommandPlugin", record) for record in registry.records() if record.kind == "command")
    return {name: r for r in records if (name := r.typed) not in COMMANDS}, registry.notes()


def _load_own(place: str) -> click.Command:
    """Return a command of the core, whose output is its own."""
    module, _, attribute = place.partition(":")
    command = copy(getattr(import_module(module), attribute))
    callback = command.callback

    @wraps(callback)
    def called(*arguments: Any, **options: Any) -> Any:
        with own_output():
            return callback(*arguments, **options)

    command.callback = called
    return command  # type: ignore[no-any-return]


def _load_foreign(record: CommandPlugin) -> click.Command:
    """Return the command of a plugin, whose errors name the plugin, and whose result must be an exit status."""
    from sparserob_core.experiment.plugins.attribution import attributed, short_repr
    from sparserob_core.options import Options

    command = copy(record.create(Options()))
    invoke = command.invoke

    def invoked(ctx: click.Context) -> int:
        with attributed(record.origin, "running it", PASSING):
            status = invoke(ctx)
        if not is_status(status):
            expected = f"expected an exit status, 0 to {MAX_STATUS}, or nothing"
            raise PluginError(f"{record.origin}: running it returned {short_repr(status)}, {expected}")
        return status or 0

    command.invoke = invoked  # type: ignore[method-assign]
    return command


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="sparserob", message="%(prog)s %(version)s")
def commands() -> None:
    """Sparse robust optimal control of uncertain linear systems, with the proof."""
