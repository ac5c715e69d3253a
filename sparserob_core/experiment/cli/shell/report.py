"""The end of a command: its result as JSON, or as tables with notes below them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from sparserob_core.experiment.terminal.printing import print_json, printable, say

Table: TypeAlias = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""The title of a table, the names of its columns (none for keys and values), and its rows."""


def report(as_json: bool, summary: Mapping[str, Any], tables: Iterable[Table], remarks: Iterable[str]) -> None:
    """Print the ``summary`` of a result as JSON, with null for numbers that are not finite; or its tables and notes."""
    from sparserob_core.experiment.directory.artefacts import finite
    from sparserob_core.experiment.terminal.table import print_table

    if as_json:
        print_json(finite(summary))
        return
    for table in tables:
        print_table(*table)
    for remark in remarks:
        say(printable(remark))
