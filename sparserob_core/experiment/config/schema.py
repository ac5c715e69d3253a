"""The JSON schema of a config for the plugins that are installed; editors complete and check a config with it."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from sparserob_core.experiment.config.extending import EXTENDS, MEANING
from sparserob_core.experiment.config.run_config import SLOTS, MaximiserEntry, RunConfig
from sparserob_core.experiment.config.set_options import shorthand
from sparserob_core.experiment.plugins.components import ComponentOption, Registry
from sparserob_core.experiment.plugins.components import parts as components
from sparserob_core.experiment.plugins.records import Plugin
from sparserob_core.options import meanings


class _LenientGenerator(GenerateJsonSchema):
    """A schema generator that accepts any value of a type that JSON cannot describe, and adds the meaning of every
    field."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        written = super().model_schema(schema)
        model: type[BaseModel] = schema["cls"]
        for name, meaning in meanings(model).items():
            field = written.get("properties", {}).get(model.model_fields[name].alias or name)
            if meaning and field is not None:
                field.setdefault("description", meaning)
        return written

    def handle_invalid_for_json_schema(self, schema: core_schema.CoreSchema, error_info: str) -> dict[str, Any]:
        return {}


def options_schema(record: Plugin, ask: bool = True) -> dict[str, Any]:
    """Return the JSON schema of a component's options, with the references of its parts under ``kind.name.``.

    Parameters
    ----------
    record : Plugin
        The component.
    ask : bool, default True
        Whether the package that an ``open`` component needs is asked for its options. Without that, only those are
        returned that are known in any case, whether or not the package is installed.

    Returns
    -------
    dict
        The schema.
    """
    if record.open and not ask:
        return {} if record.options is None else record.options.model_json_schema(schema_generator=_LenientGenerator)
    template = f"#/$defs/{record.kind}.{record.name}.{{model}}"
    return record.options_type().model_json_schema(ref_template=template, schema_generator=_LenientGenerator)


def config_schema(registry: Registry) -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of the whole config."""
    schema = RunConfig.model_json_schema(schema_generator=_LenientGenerator)
    definitions: dict[str, Any] = schema["$defs"]
    for path, slot in SLOTS.items():
        holder = schema if len(path) == 1 else definitions["Dictionaries"]
        previous = holder["properties"][path[-1]]
        choice = _describe_choice(registry, ComponentOption(slot.kind), slot.name, definitions)
        if any(option.get("type") == "null" for option in previous.get("anyOf", [])):
            choice["anyOf"].append({"type": "null"})
        holder["properties"][path[-1]] = {
            **{key: previous[key] for key in ("default", "description") if key in previous},
            **choice,
        }
    schema["properties"]["observers"]["items"] = _describe_choice(
        registry, ComponentOption("observer"), None, definitions
    )
    for unused in ("Entry", "MaximiserEntry"):
        definitions.pop(unused, None)
    _add_kinds(registry, definitions)
    schema["properties"] = {EXTENDS: {"type": "string", "description": MEANING}, **schema["properties"]}
    schema["anyOf"] = [{"required": schema.pop("required")}, {"required": [EXTENDS]}]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "SparseRob config"}


def _add_kinds(registry: Registry, parts: dict[str, Any]) -> None:
    """Add to the models with one key per component of a kind, such as sets, the keys of all registered components."""
    for holder in [definition for definition in parts.values() if "kinds" in definition]:
        kind = holder.pop("kinds")
        for name in registry.names(kind):
            record, key = registry.get(kind, name), f"{kind}.{name}"
            if key not in parts:
                entry = options_schema(record)
                parts.update({f"{key}.{inner}": value for inner, value in entry.pop("$defs", {}).items()})
                parts[key] = entry
            short = shorthand(record)
            forms = [*_list_alternatives(parts[key]["properties"][short])] if short else []
            holder.setdefault("properties", {})[name] = {
                "anyOf": [*forms, {"$ref": f"#/$defs/{key}"}, {"type": "null"}],
                "default": None,
                "description": record.summary,
            }
        holder["additionalProperties"] = False


def _list_alternatives(field: dict[str, Any]) -> list[dict[str, Any]]:
    return [form for form in field.get("anyOf", [field]) if form.get("type") != "null"]


def _describe_choice(
    registry: Registry, which: ComponentOption, default: str | None, parts: dict[str, Any], but: str | None = None
) -> dict[str, Any]:
    """Return the schema of a component of a kind, by name or with its options.

    ``but`` is a component that is left out: one within its own options.
    """
    kind = which.kind
    names = [name for name in registry.names(kind, which.of) if name != but]
    entries = []
    for name in names:
        record = registry.get(kind, name)
        entry = options_schema(record, ask=False)
        for key, component in ({} if record.open else components(record.options_type())).items():
            described = entry["properties"][key]
            for extra in ("component", "of"):
                described.pop(extra, None)
            inner_choice = _describe_choice(
                registry, component, None, parts, but=name if component.kind == kind else None
            )
            described["anyOf"] = [*inner_choice["anyOf"], {"type": "null"}]
        parts.update({f"{kind}.{name}.{inner}": value for inner, value in entry.pop("$defs", {}).items()})
        entries.append(_add_name(entry, record, needs_name=name != default))
    return {"anyOf": [{"enum": names, "description": f"A {kind} with its default options."}, *entries]}


def _add_name(entry: dict[str, Any], record: Plugin, needs_name: bool) -> dict[str, Any]:
    properties = {"name": {"const": record.name, "description": record.summary}, **entry.get("properties", {})}
    if record.kind == "maximiser":
        own = MaximiserEntry.model_json_schema(schema_generator=_LenientGenerator)["properties"]
        properties |= {key: own[key] for key in own if key != "name"}
    required = (["name"] if needs_name else []) + entry.get("required", [])
    return {
        "type": "object",
        "title": f"{record.kind} {record.name}",
        "description": record.summary,
        "properties": properties,
        "required": required,
        "additionalProperties": record.open,
    }
