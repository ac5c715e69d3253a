"""The generated pages: the public names by who needs them, one page for every component, and the gallery of configs."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path

from ruamel.yaml import YAML

import sparserob_core as sr
from make_site.docstrings import safe
from make_site.gallery import gallery
from sparserob_core.experiment.config.option_rows import OptionRow, option_rows
from sparserob_core.experiment.plugins.records import Plugin

DOCS = Path(__file__).resolve().parents[1]
OUT = DOCS / "generated"
WHEN = DOCS / "make_site" / "when.yaml"
TABLE = Path(sr.__file__).with_suffix(".pyi")
PLURAL = {"policy": "policies", "dictionary": "dictionaries"}


def write() -> None:
    """Write every generated page, where it has changed."""
    kept = set()
    for name, text in pages():
        path = OUT / name
        kept.add(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    for stale in set(OUT.rglob("*.md")) - kept:
        stale.unlink()


def pages() -> Iterator[tuple[str, str]]:
    """Names and texts."""
    yield from names()
    yield from components()
    yield "gallery.md", gallery()


def names() -> Iterator[tuple[str, str]]:
    """A page for every group of public names."""
    found = []
    for title, group in groups():
        slug = re.sub(r"\W+", "-", title.lower()).strip("-")
        found.append(slug)
        lines = [f"# {title}", ""]
        for name in group:
            lines += [f"## {name}", "", "```{eval-rst}", ".. py:currentmodule:: sparserob_core", ""]
            lines += [*_directive(name), "```", ""]
        yield f"api/{slug}.md", "\n".join(lines)
    toctree = ["```{toctree}", ":maxdepth: 2", "", *found, "```"]
    intro = "Everything that a user or an author of components needs is a name of `sparserob_core`."
    yield "api/index.md", "\n".join(["# Python", "", intro, "", *toctree, ""])


def groups() -> list[tuple[str, list[str]]]:
    """The public names in the order of their table, under its headings."""
    found: list[tuple[str, list[str]]] = []
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if line.startswith("# ") and line.endswith("."):
            found.append((line[2:-1], []))
        elif line.startswith("from ") and found:
            found[-1][1].append(line.rsplit(" ", 1)[1])
    return found


def _directive(name: str) -> list[str]:
    thing = getattr(sr, name)
    if inspect.isclass(thing):
        return [f".. autoclass:: sparserob_core.{name}"]
    if inspect.isfunction(thing):
        return [f".. autofunction:: sparserob_core.{name}"]
    if callable(thing) and not hasattr(thing, "__origin__"):
        return [f".. py:data:: {name}", "", f"   A marker or a function: ``{type(thing).__name__}``."]
    return [f".. py:data:: {name}", "", f"   A type: ``{thing}``."]


def components() -> Iterator[tuple[str, str]]:
    """A page for every component, and one for every kind."""
    when = YAML(typ="safe").load(WHEN.read_text(encoding="utf-8"))
    kinds = []
    named = (record for record in sr.load_registry().records() if not record.usage)  # commands have their page
    for kind, group in groupby(named, key=lambda record: record.kind):
        records, listed = list(group), []
        kinds.append(kind)
        for record in records:
            listed.append(record.name)
            yield f"components/{kind}/{record.name}.md", _component(record, told(when, record))
        rows = [f"| [`{record.name}`]({record.name}.md) | {record.summary} |" for record in records]
        title = PLURAL.get(kind, f"{kind}s").replace("_", " ").capitalize()
        table = ["| | |", "|---|---|", *rows, ""]
        toctree = ["```{toctree}", ":hidden:", "", *listed, "```", ""]
        yield f"components/{kind}/index.md", "\n".join([f"# {title}", "", *table, *toctree])
    toctree = ["```{toctree}", ":maxdepth: 2", "", *(f"{kind}/index" for kind in kinds), "```", ""]
    intro = "A config names them; `sparserob plugins NAME` prints the same. [Write your own](../../extending.md)."
    yield "components/index.md", "\n".join(["# Components", "", intro, "", *toctree])


def told(when: dict[str, dict[str, str]], record: Plugin) -> str:
    """When to use a component: its own words, or those for all that its plugin brings."""
    return when[record.kind].get(record.name) or when["plugin"][record.plugin]


def _component(record: Plugin, when: str) -> str:
    lines = [f"# {record.kind.replace('_', ' ')} `{record.name}`", "", record.summary, ""]
    installed = record.needs is None or find_spec(record.needs[0]) is not None
    if installed:
        text = inspect.getdoc(record.resolved()) or record.summary
        lines += ["```{eval-rst}", ".. py:currentmodule:: sparserob_core", "", safe(text), "```", ""]
    lines += ["## When to use it", "", when.strip(), "", "## Options", ""]
    lines += _options(record) if installed else ["It is not installed where this page was made."]
    return "\n".join([*lines, "", "## Where it comes from", "", f"Plugin `{record.plugin}`, hook `{record.hook}`.", ""])


def _options(record: Plugin) -> list[str]:
    """Three columns, so that the meaning has room beside the contents and on a narrow screen."""
    rows = [[f"`{row.name}`", _value(row), row.meaning] for row in option_rows(record)]
    table = ["| option | value | meaning |", "|---|---|---|"]
    return [*table, *("| " + " | ".join(map(_cell, row)) + " |" for row in rows)] if rows else ["None of its own."]


def _value(row: OptionRow) -> str:
    """What may be given, and what holds where nothing is."""
    default = row.default if row.default in {"", "required"} else f"{row.default} unless given"
    return ", ".join(part for part in (row.type, row.range, default) if part)


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ").replace("$", "\\$").replace("<", "\\<")
