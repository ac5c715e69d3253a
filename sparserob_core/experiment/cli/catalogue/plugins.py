"""``sparserob plugins``: what a config can name; ``sparserob new-plugin``: a package to begin one with."""

from __future__ import annotations

from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import click

from sparserob_core.experiment.terminal.printing import say

if TYPE_CHECKING:
    from sparserob_core.experiment.plugins.components import Registry


@click.command()
@click.argument("name", required=False)
@click.option(
    "--plugins",
    "files",
    type=click.Path(path_type=Path),
    multiple=True,
    help="A Python file whose components are listed too; may be given several times.",
)
def plugins(name: str | None, files: tuple[Path, ...]) -> int:
    """List the components that a config can name, or the options of one: NAME, or KIND.NAME."""
    from sparserob_core.experiment.plugins.registry import load_registry
    from sparserob_core.experiment.terminal.table import print_table

    registry = load_registry(files)
    if name is not None:
        return _describe_component(registry, name)
    records = list(registry.records())
    rows = [
        (record.kind, record.name, record.plugin, record.distribution, record.summary)
        for record in records
        if not record.missing
    ]
    print_table("Components", ("kind", "name", "plugin", "from", "what it is"), rows)
    for record in records:
        if record.missing:
            say(record.missing)
    for failure in registry.failures:
        click.echo(str(failure), err=True)
    return 0


def _describe_component(registry: Registry, name: str) -> int:
    from sparserob_core.experiment.config.option_rows import option_rows
    from sparserob_core.experiment.terminal.table import print_table

    for record in registry.find(name):
        if usage := record.usage:
            say(usage)
            continue
        rows = [(row.name, row.type, row.default, row.range, row.meaning) for row in option_rows(record)]
        title = f"{record.kind} {record.name} (plugin {record.plugin}, {record.distribution}): {record.summary}"
        print_table(
            title,
            ("option", "type", "default", "range", "meaning"),
            rows or [("none", "", "", "", "it has no options")],
        )
    return 0


@click.command("new-plugin")
@click.argument("kind")
@click.argument("name")
@click.option(
    "--out",
    type=click.Path(file_okay=False),
    default=".",
    show_default="the current folder",
    help="Folder in which the package is made.",
)
def new_plugin(kind: str, name: str, out: str) -> int:
    """Write the package sparserob-NAME with a component of that KIND to begin with.

    It is typed, documented and installable, and has the tests that every component of its kind has to pass. Nothing is
    overwritten.

    KIND is one of: problem, set, policy, method, dictionary, regulariser, solver, maximiser, executor, observer,
    command, or of the rules of the paper's loop: schedule, outer-stop, inner-stop, selection.
    """
    from sparserob_core.experiment.scaffold.new_plugin import new_plugin as write

    folder = write(kind, name, out)
    say(f"written to {folder}; next: cd {quote(str(folder))} && pip install -e '.[test]' && pytest")
    return 0
