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
