"""What the commands end with: their exit status, and JSON."""

from __future__ import annotations

from typing import Any

import click

EXIT = {"certified": 0, "verified": 0, "infeasible": 3, "refuted": 4, "undecided": 4, "failed": 5}


def print_json(data: Any) -> None:
    """Print plain data as JSON."""
    import json

    click.echo(json.dumps(data, indent=2))
