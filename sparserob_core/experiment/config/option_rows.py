"""The options of a component as the rows of a table: name, type, default, range and meaning."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, final

from sparserob_core.experiment.config.schema import options_schema
from sparserob_core.experiment.plugins.records import Plugin

LIMITS = {
    "minimum": ">= {}",
    "exclusiveMinimum": "> {}",
    "maximum": "<= {}",
    "exclusiveMaximum": "< {}",
    "minItems": "at least {} entries",
    "maxItems": "at most {} entries",
    "minLength": "at least {} characters",
    "pattern": "matches {}",
}
TYPES = {"object": "mapping", "string": "text", "boolean": "true or false", "integer": "whole number"}


@dataclass(frozen=True)
class OptionRow:
    """An option as a row of the table; its ``name`` is dotted where it lies within another option."""

    name: str
    type: str
    default: str
    range: str
    meaning: str


def option_rows(record: Plugin, ask: bool = True) -> list[OptionRow]:
    """Return every option of a component as a row, with the keys below it.

    Keys that several options share are listed below the first of these options. ``ask`` is that of `options_schema`.
    """
    schema = options_schema(record, ask)
    prefix = f"#/$defs/{record.kind}.{record.name}."
    return list(
        _SchemaRows({prefix + name: definition for name, definition in schema.get("$defs", {}).items()}).rows(
            schema, ""
        )
    )


@final
class _SchemaRows:
    """The rows of a schema; ``parts`` are its definitions, ``first_keys`` the options at which each of them was
    listed."""

    def __init__(self, parts: Mapping[str, Any]) -> None:
        self.parts = parts
        self.first_keys: dict[str, str] = {}

    def rows(self, schema: Mapping[str, Any], above: str) -> Iterator[OptionRow]:
        for name, field in schema.get("properties", {}).items():
            members = [member for _, member in self._list_members(field)]
            below = list(self._list_references(field, above + name))
            notes = [
                f"keys as in {self.first_keys[reference]}" for reference, _ in below if reference in self.first_keys
            ]
            meaning = " ".join(str(field.get("description", "")).split())
            yield OptionRow(
                name=above + name,
                type=" or ".join(dict.fromkeys(self._describe_type(member) for member in members)) or "anything",
                default=_describe_default(field, name in schema.get("required", [])),
                range=", ".join(dict.fromkeys(_describe_limits(field, members))),
                meaning=" ".join([meaning, *(f"({notes[0]})" for _ in notes[:1])]).strip(),
            )
            for reference, key in below:
                if self.first_keys.setdefault(reference, key) == key:
                    yield from self.rows(self.parts.get(reference, {}), f"{key}.")

    def _list_members(self, field: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """Yield the alternatives of a type, each with the name of its definition."""
        reference = field.get("$ref", "")
        definition = self.parts.get(reference, {}) if reference else field
        alternatives = definition.get("anyOf") or definition.get("oneOf") or definition.get("allOf")
        if alternatives is None:
            yield reference, definition
            return
        for member in alternatives:
            yield from self._list_members(member)

    def _list_references(self, field: Mapping[str, Any], place: str) -> Iterator[tuple[str, str]]:
        for reference, member in self._list_members(field):
            if reference and member.get("properties"):
                yield reference, place
            elif member.get("type") == "array":
                yield from self._list_references(member.get("items", {}), f"{place}.0")

    def _describe_type(self, member: Mapping[str, Any]) -> str:
        if "enum" in member:
            return ", ".join(str(value) for value in member["enum"])
        if "const" in member:
            return str(member["const"])
        if "kinds" in member:
            return f"{member['kinds']}: one key per kind"
        if "component" in member:
            of = str(member.get("of", "")).rpartition(":")[2]
            return f"{member['component']}{f' ({of})' if of else ''} by name, or with its options"
        kind = member.get("type")
        if kind == "array":
            inside = " or ".join(
                dict.fromkeys(self._describe_type(item) for _, item in self._list_members(member.get("items", {})))
            )
            return f"list of ({inside})" if " or " in inside else f"list of {inside}"
        return TYPES.get(str(kind), str(kind or "anything"))


def _describe_default(field: Mapping[str, Any], required: bool) -> str:
    if required:
        return "required"
    return json.dumps(field["default"]) if "default" in field else ""


def _describe_limits(field: Mapping[str, Any], members: list[Mapping[str, Any]]) -> Iterator[str]:
    for definition in (field, *members):
        for key, words in LIMITS.items():
            if key in definition:
                yield words.format(definition[key])
