"""Output and end of the commands: text without control characters, JSON, exit statuses.

The standard output belongs to the command, whose words go through this module. All other output in the meantime, of a
plugin or a library, goes to the standard error stream, so that a program can read the result.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, TextIO, cast, final

import click

from sparserob_core.encodings import as_utf8

EXIT = {"certified": 0, "verified": 0, "infeasible": 3, "refuted": 4, "undecided": 4, "failed": 5}


def printable(text: str) -> str:
    """Return a text with every control character but line feeds written out, as in ``\\x1b``.

    The text of a config must not steer the terminal. Bytes of a path for which a narrow locale has no letters are read
    as UTF-8.
    """
    return "".join(
        character if character == "\n" or character.isprintable() else character.encode("unicode_escape").decode()
        for character in as_utf8(text)
    )


@final
class _OtherOutput:
    """The standard output of everybody but the command: the standard error stream."""

    def __init__(self, own: TextIO) -> None:
        self.own = own

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)


@contextmanager
def own_output() -> Iterator[None]:
    """Meanwhile the standard output takes what is said by `say`, `print_json` and tables, and nothing else."""
    with redirect_stdout(cast("TextIO", _OtherOutput(output()))):
        yield


def output() -> TextIO:
    """The standard output of the command."""
    return sys.stdout.own if isinstance(sys.stdout, _OtherOutput) else sys.stdout


def say(text: str) -> None:
    """Print a line."""
    click.echo(as_utf8(text), file=output())


def print_json(data: Any) -> None:
    """Print plain data as JSON."""
    import json

    say(json.dumps(data, indent=2))
