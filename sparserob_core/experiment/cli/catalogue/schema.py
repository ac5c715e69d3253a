"""``sparserob schema``: the JSON schema of a config."""

from __future__ import annotations

import click

from sparserob_core.experiment.terminal.printing import print_json


@click.command()
def schema() -> int:
    """Print the JSON schema of a config, for the plugins that are installed."""
    from sparserob_core.experiment.config.schema import config_schema
    from sparserob_core.experiment.plugins.registry import load_registry

    print_json(config_schema(load_registry()))
    return 0
