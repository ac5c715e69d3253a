"""Overrides of a config: ``key.sub=value``, where a number as a key counts the entries of a list from 0."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from sparserob_core.encodings import as_utf8
from sparserob_core.errors import ConfigError, Path, dotted
from sparserob_core.experiment.plugins.messages import shown


@dataclass(frozen=True)
class Override:
    """A change of a config: the ``value`` for the key at ``path``; ``text`` is the override as it was written."""

    path: Path
    value: object
    text: str

    @property
    def quoted(self) -> str:
        """The text of the same override with a value that is read as text."""
        return quoted(self.text)


def quoted(text: str) -> str:
    """Return ``key="value"``, quoted for a shell, so that the value is read as text."""
    key, _, value = text.partition("=")
    return shlex.quote(f"{key}={json.dumps(value.strip(), ensure_ascii=False)}")


def parse_value(text: str, parse: Callable[[str], object]) -> object:
    """Return the value of ``key=value``, read by ``parse``.

    Raises `ConfigError` where YAML cannot read the value, or would drop a part of it as a comment; the error shows how
    to quote it.
    """
    value_text = text.partition("=")[2]
    try:
        value = parse(value_text)
    except ConfigError as error:
        raise ConfigError(f"{error}; as text it is written {quoted(text)}") from error
    if value == "" and value_text.strip() not in ('""', "''"):  # a block of no lines
        raise ConfigError(
            f"override {shown(text)}: {shown(value_text)} reads as an empty text; as text it is written {quoted(text)}"
        )
    for mark in re.finditer(r"(?:^|(?<=\s))#", value_text):
        try:
            comment = parse(value_text[: mark.start()]) == value
        except ConfigError:
            comment = False  # the mark is within quotes
        if comment:
            raise ConfigError(
                f"override {shown(text)}: {shown(value_text[mark.start() :])} would be a comment, which is left out; "
                f"as text the value is written {quoted(text)}"
            )
    return value


def parse_overrides(
    given: Mapping[str, object] | Iterable[str] | None, parse: Callable[[str], object]
) -> list[Override]:
    """Return the overrides of texts ``key=value``, whose values ``parse`` reads, or of a mapping of keys to values.

    Raises `ConfigError` for a text that is no override.
    """
    if given is None:
        return []
    if isinstance(given, Mapping):
        return [Override(_parse_path(key), value, f"{key}={value}") for key, value in given.items()]
    overrides = []
    for text in (as_utf8(argument, "strict") for argument in given):
        key, equals, _ = text.partition("=")
        if not equals:
            raise ConfigError(f"override {shown(text)}: expected key=value, for example method.name=nominal")
        overrides.append(Override(_parse_path(key), parse_value(text, parse), text))
    return overrides


def _parse_path(key: str) -> Path:
    steps = tuple(int(step) if step.isdigit() else step for step in key.strip().split("."))
    if "" in steps:
        raise ConfigError(f"override {shown(key)}: expected a key such as problem.horizon, got {shown(key)}")
    return steps


def apply_override(data: dict[str, Any], override: Override) -> None:
    """Set the value of an override in the ``data`` of a config.

    Keys on its path that are missing or null are added. Raises `ConfigError` where the path leads nowhere.
    """
    node: Any = data
    for position, key in enumerate(override.path):
        last = position == len(override.path) - 1
        step: Any = _convert_step(node, key, override, position)
        if last:
            _put_value(node, step, override.value)
            return
        below = (
            node[step]
            if isinstance(node, list) and step < len(node)
            else node.get(step)
            if isinstance(node, dict)
            else None
        )
        if below is None:
            below = [] if override.path[position + 1] == 0 else {}
            _put_value(node, step, below)
        node = below


def _put_value(node: Any, step: Any, value: object) -> None:
    if isinstance(node, list) and step == len(node):
        node.append(value)
    else:
        node[step] = value


def _convert_step(node: object, step: str | int, override: Override, position: int) -> str | int:
    at = dotted(override.path[:position])
    if isinstance(node, dict):
        return str(step)
    if not isinstance(node, list):
        raise ConfigError(f"override {override.text}: {at} is {shown(node)}, which has no key '{step}'")
    if not isinstance(step, int) or step > len(node):
        entries = f"a list with {len(node)} entries, counted from 0"
        raise ConfigError(
            f"override {override.text}: {at} is {entries}, expected a number of at most {len(node)}, got '{step}'"
        )
    return step
