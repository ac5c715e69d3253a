"""Options that several commands have, each written once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

seed_option = click.option("--seed", type=int, default=0, show_default=True, help="Seed of the random numbers.")

figures_option = click.option(
    "--figures/--no-figures", default=True, help="Whether to draw the figures.", show_default=True
)


def watching_options(of: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``--watch``, ``--save``, ``--serve``, ``--connect``: the viewer of a study, or of what ``of`` says."""
    path = click.Path(path_type=Path)
    options = (
        click.option("--watch", is_flag=True, help=f"Show {of} in the viewer of Rerun while it goes on."),
        click.option("--save", type=path, help="Watch: record into this new file, for a machine without a display."),
        click.option("--serve", is_flag=True, help="Watch: show it in a browser of this machine, until Ctrl-C."),
        click.option("--connect", metavar="ADDRESS", help="Watch: send it to a viewer that listens there."),
    )

    def decorated(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            command = option(command)
        return command

    return decorated


plugins_option = click.option(
    "--plugins",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A plugin file that RUN was made with. RUN is data: no plugin that it names is loaded. Repeatable.",
)


def json_option(what: str, table: str = "the table") -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``--json``: print ``what`` instead of the table."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print {what} instead of {table}.")


def out_option(meaning: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``--out``: the path of a file or a directory that is written."""
    return click.option("--out", type=click.Path(path_type=Path), help=meaning)


def study_out_option(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """``--out``: the directory of the study ``name``."""
    files = f"{name}.json and {name}.png"
    return out_option(f"A new or empty directory for the config, {files}; runs/NAME-{name}/STAMP-HASH unless given.")
