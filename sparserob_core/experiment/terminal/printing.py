"""How the commands print and end: text without control characters, JSON, exit statuses."""

from __future__ import annotations

from typing import Any

import click

EXIT = {"certified": 0, "verified": 0, "infeasible": 3, "refuted": 4, "undecided": 4, "failed": 5}


def printable(text: str) -> str:
    """The same text with every control character written out, as in ``\\x1b``, but line feeds: what a config says must
    not steer the terminal."""
    return "".join(one if one == "\n" or one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def print_json(data: Any) -> None:
    """Print plain data as JSON."""
    import json

    click.echo(json.dumps(data, indent=2))
