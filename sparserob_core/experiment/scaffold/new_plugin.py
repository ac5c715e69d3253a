"""Writes the package of a plugin to begin with, from the templates beside this file.

A template is one text that holds several files, each below a line ``#### path``. ``package.txt`` has what every package
has, and for each kind of component, of rules for each of the four pieces, one more text has the component, its tests,
and a config that names it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from shutil import rmtree
from string import Template

from sparserob_core.errors import InputError
from sparserob_core.experiment.plugins.hookspecs import record_type
from sparserob_core.experiment.plugins.records import RECORDS
from sparserob_core.experiment.plugins.registry import load_registry

MAX_NAME_LETTERS = 30  # letters of a name: lines of the templates stay within 120 columns
PACKAGE = "package"
RULES = ("schedule", "outer_stop", "inner_stop", "selection")  # what they are called with differs
HEADING = re.compile(r"^#### (\S+)\n", re.MULTILINE)


def new_plugin(kind: str, name: str, out: str | Path = ".") -> Path:
    """Write the package ``sparserob-NAME`` with a component of that kind, or with one of the `RULES`, into the folder
    ``out``; return its folder.

    Nothing is overwritten. Raises `InputError` for an unknown kind, for a name that is no name, or is taken by an
    installed component, plugin or module, and for a folder that exists, or cannot be written: nothing of the package
    is left then.
    """
    spelt = {known_kind.replace("_", "-"): known_kind for known_kind in kinds()}
    if kind.replace("_", "-") not in spelt:
        raise InputError(path="kind", expected=f"one of {', '.join(spelt)}", got=repr(kind))
    chosen = spelt[kind.replace("_", "-")]
    record = record_type("rule" if chosen in RULES else chosen)
    _check_name(record.kind, name)
    package = f"sparserob_{name}"
    folder = Path(out) / package.replace("_", "-")
    if folder.exists():
        raise InputError(path="out", expected="a folder in which the package is not yet", got=f"one with {folder}")
    words = {
        "name": name,
        "typed": name.replace("_", "-"),
        "package": package,
        "distribution": package.replace("_", "-"),
        "kind": chosen.replace("_", " "),
        "article": "An" if chosen[0] in "aeiou" else "A",
        "hook": record.hook,
        "Class": _to_camel_case(name).removesuffix(_to_camel_case(chosen)) + _to_camel_case(chosen),
    }
    texts = {**_fill_template(PACKAGE, words), **_fill_template(chosen, words)}
    try:
        for path, text in texts.items():
            file = folder / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        rmtree(folder, ignore_errors=True)
        got = f"{out}: {error.strerror}"
        raise InputError(path="out", expected="a folder that can be written to", got=got) from error
    return folder


def kinds() -> list[str]:
    """Return the kinds of components of which a package can be made, in the order of the hooks; for rules the
    `RULES`."""
    return [name for kind in RECORDS for name in (RULES if kind == "rule" else (kind,))]


def _check_name(kind: str, name: str) -> None:
    quoted_name = f"{name!r}"
    if not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name) or len(name) > MAX_NAME_LETTERS:
        raise InputError(
            path="name",
            expected="lower-case letters, digits and single underscores, a letter first, "
            f"at most {MAX_NAME_LETTERS} of them",
            got=quoted_name,
        )
    registry = load_registry()
    if name in registry.names(kind):
        existing = registry.get(kind, name)
        raise InputError(
            path="name", expected=f"a name that no {kind} has", got=f"{quoted_name}, which is {existing.origin}"
        )
    plugins = {record.plugin: record.source for record in registry.records()}
    if name in plugins:
        owner = plugins[name] or "the core"
        raise InputError(
            path="name", expected="a name that no plugin has", got=f"{quoted_name}, which is that of {owner}"
        )
    if find_spec(f"sparserob_{name}") is not None:
        raise InputError(
            path="name", expected="a name that is free", got=f"{quoted_name}: there is a module sparserob_{name}"
        )


def _fill_template(template: str, words: Mapping[str, str]) -> dict[str, str]:
    """The files that a template holds, by path, with the words put in."""
    text = (files(__package__) / "templates" / f"{template}.txt").read_text(encoding="utf-8")
    filled = Template(text).substitute(words)
    sections = HEADING.split(filled)[1:]
    bodies = (body.strip("\n") for body in sections[1::2])
    return {path: f"{body}\n" if body else "" for path, body in zip(sections[::2], bodies, strict=True)}


def _to_camel_case(name: str) -> str:
    return "".join(word[:1].upper() + word[1:] for word in name.split("_"))
