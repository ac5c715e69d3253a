"""``sparserob plugins``: what a config can name."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from sparserob_core.experiment.plugins.components import Registry


@click.command()
@click.argument("name", required=False)
def plugins(name: str | None) -> int:
    """List the components that a config can name, or the options of one: NAME, or KIND.NAME."""
    from sparserob_core.experiment.plugins.registry import load_registry
    from sparserob_core.experiment.terminal.table import print_table

    registry = load_registry()
    if name is not None:
        return _describe(registry, name)
    rows = [(record.kind, record.name, record.plugin, record.summary) for record in registry.records()]
    print_table("Components", ("kind", "name", "plugin", "what it is"), rows)
    for failure in registry.failures:
        click.echo(str(failure), err=True)
    return 0


def _describe(registry: Registry, name: str) -> int:
    from sparserob_core.experiment.config.option_rows import option_rows
    from sparserob_core.experiment.terminal.table import print_table

    for record in registry.find(name):
        rows = [(row.name, row.type, row.default, row.range, row.meaning) for row in option_rows(record)]
        title = f"{record.kind} {record.name} (plugin {record.plugin}): {record.summary}"
        print_table(
            title,
            ("option", "type", "default", "range", "meaning"),
            rows or [("none", "", "", "", "it has no options")],
        )
    return 0
