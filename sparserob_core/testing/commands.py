"""The contract of a command: it explains itself, refuses what is wrong, and returns its exit status."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar

import click
import numpy as np
from click.testing import CliRunner, Result

from sparserob_core.errors import SparseRobError
from sparserob_core.experiment.plugins.commands import MAX_STATUS, is_status
from sparserob_core.testing.contract import Contract, demand

HELP = ("-h", "--help")


class CommandContract(Contract[click.Command], kind="command"):
    """Contract of a command: subclass it as ``class TestMine(CommandContract)`` and give ``component``.

    It is called with the ``arguments``, in an empty folder; name some that it accepts.
    ``component`` is the command itself, or its name where it is installed.
    """

    arguments: ClassVar[Sequence[str]] = ()

    def create(self) -> click.Command:
        """The command."""
        source = type(self).component
        return source if isinstance(source, click.Command) else super().create()

    def call(self, arguments: Sequence[str]) -> Result:
        """Call the command in an empty folder, as the program calls it; what it prints is in the result."""
        with TemporaryDirectory() as folder, chdir(folder):
            result = CliRunner().invoke(self.create(), list(arguments), prog_name="sparserob", standalone_mode=False)
            demand(
                Path.cwd() == Path(folder).resolve(), "it changes the current folder", "use paths from the arguments"
            )
        return result

    def test_it_says_what_it_does_and_what_its_options_mean(self) -> None:
        command = self.create()
        demand((command.help or "").strip(), "it has no help", "write a docstring under its function")
        options = [part for part in command.params if isinstance(part, click.Option)]
        silent = [part.opts[0] for part in options if not part.help]
        demand(not silent, f"these options have no help: {', '.join(silent)}", "give each of them `help=`")
        clashes = [name for part in options for name in part.opts if name in HELP]
        demand(not clashes, f"it takes {', '.join(clashes)} for itself", "rename it: this option asks for the help")

    def test_help_is_shown_and_nothing_is_done(self) -> None:
        with TemporaryDirectory() as folder, chdir(folder):
            result = CliRunner().invoke(self.create(), ["--help"], prog_name="sparserob")
            files = [path.name for path in Path(folder).iterdir()]
        demand(result.exit_code == 0, f"--help ends with {result.exception!r}", "let click print the help")
        demand(result.output.startswith("Usage:"), "--help does not print its usage", "let click print the help")
        demand(not files, f"--help makes files: {', '.join(files)}", "do nothing before the command is called")

    def test_an_unknown_option_is_refused(self) -> None:
        result = self.call([*self.arguments, "--no-such-option"])
        demand(
            isinstance(result.exception, click.UsageError),
            "it accepts an option that it does not know",
            "leave out `ignore_unknown_options` and arguments that take everything",
        )

    def test_it_returns_its_exit_status(self) -> None:
        result = self.call(self.arguments)
        error = result.exception
        demand(
            error is None or isinstance(error, SparseRobError | click.ClickException),
            f"with the arguments {list(self.arguments)} it raises {error!r}",
            "return the exit status; raise `sr.InputError` for what a user can mend; name `arguments` that it accepts",
        )
        demand(error is None, f"with the arguments {list(self.arguments)} it ends with: {error}", "name others")
        status = result.return_value
        demand(
            is_status(status),
            f"it returns {status!r}",
            f"return a whole number from 0 to {MAX_STATUS}, or nothing",
        )

    def test_it_prints_the_same_twice(self) -> None:
        first, second = self.call(self.arguments).output, self.call(self.arguments).output
        demand(first == second, "it prints something else the second time", "take a seed as an option")

    def test_the_random_numbers_of_others_are_left_alone(self) -> None:
        before = repr(np.random.get_state())  # noqa: NPY002
        self.call(self.arguments)
        after = repr(np.random.get_state())  # noqa: NPY002
        demand(before == after, "it draws from numpy's global generator", "use `np.random.default_rng`")
