"""The way from a config file to a checked `RunConfig`; all faults are reported at once, each with its place."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any, final

from pydantic import ValidationError

from sparserob_core.encodings import name_of, path_of
from sparserob_core.errors import ConfigError, InputError, Path, PluginError, UnknownPluginError, dotted
from sparserob_core.experiment.config.extending import extended
from sparserob_core.experiment.config.matrices.files import resolve
from sparserob_core.experiment.config.reading.overrides import Override, apply_override, parse_overrides
from sparserob_core.experiment.config.reading.reader import ConfigSource, read_source, read_value
from sparserob_core.experiment.config.run_config import SLOTS, MaximiserEntry, RunConfig
from sparserob_core.experiment.plugins.components import Registry
from sparserob_core.experiment.plugins.hookspecs import ProblemPlugin
from sparserob_core.experiment.plugins.messages import NOT_PLAIN, NOT_TEXT, Complaint, complaints, malformed, models_in
from sparserob_core.experiment.plugins.registry import load_registry

KEPT = {*MaximiserEntry.model_fields} - {"name"}  # keys of a maximiser that belong to the framework


@final
@dataclass(frozen=True)
class Loaded:
    """A checked config, the registry that offers its components, its source and its overrides."""

    config: RunConfig
    registry: Registry
    source: ConfigSource
    overrides: tuple[Override, ...] = ()

    def place(self, path: Path) -> str | None:
        """Return where the value at ``path`` is given: ``file:line:column``, or the override; ``None`` for a
        default."""
        change = _find_override(self.source, self.overrides, Complaint(path, ""))
        if change is not None:
            return f"override {change.text}"
        return None if _get_value(self.source.data, path) is None else self.source.where(path)

    def located(self, slot: Path, error: InputError) -> ConfigError:
        """Return an error of the component at ``slot`` as one that names the place of the key at fault."""
        plain = self.config.plain()
        path, remainder = (*slot, *error.path), list[str | int]()
        while len(path) > len(slot) and _get_value(plain, path) is None:
            remainder.insert(0, path[-1])
            path = path[:-1]
        message = f"{dotted(tuple(remainder))}: {error.sentence}" if remainder else error.sentence
        return ConfigError(_format_line(self.source, self.overrides, Complaint(path, message)))


def load_config(
    config: str | File | Mapping[str, Any] | ConfigSource,
    overrides: Mapping[str, object] | Iterable[str] | None = None,
    known: Registry | None = None,
) -> Loaded:
    """Read a config, apply the overrides, and check every key against the installed plugins.

    Parameters
    ----------
    config : str, Path, mapping or Source
        The config.
    overrides : mapping or iterable of str, optional
        Changes of the config: a mapping of keys to values, or texts ``key=value``.
    known : Registry, optional
        The only components that may be used, for a config that somebody else has left. No plugin that the config names
        is loaded then, nor a config that it extends. A component that is not in the registry is accepted as it stands,
        and refused by its name where it is built.

    Returns
    -------
    Loaded
        The checked config.

    Raises
    ------
    ConfigError
        With one line for each key at fault: ``file:line:column: key.path: what is wrong (got ...)``.
    """
    source = read_source(config)
    source = extended(source) if known is None else source
    if "axes" in source.data and "problem" not in source.data:
        raise ConfigError(f"{source.name}: expected a config, got a study, which has axes; `sparserob sweep` takes it")
    changes = tuple(parse_overrides(overrides, read_value))
    data = copy.deepcopy(source.data)
    faults = list(malformed(data))
    if faults:
        raise _make_error(source, changes, faults)
    _spell_out(data)
    for change in changes:
        apply_override(data, change)
        _spell_out(data)
    faults = list(malformed(data))
    if known is None and not faults:  # a run directory has the numbers themselves: no file is read for it
        faults = list(resolve(data, lambda path: _find_folder(path, source, changes)))
    registry = _build_registry(data, source, changes) if known is None else known
    resolved, key_faults = _check_data(data, registry, strangers=known is not None)
    if faults or key_faults or resolved is None:
        raise _make_error(source, changes, faults or key_faults)
    if not resolved.title:
        resolved = resolved.model_copy(update={"title": File(source.name).stem})
    return Loaded(resolved, registry, source, changes)


def _find_folder(path: Path, source: ConfigSource, changes: tuple[Override, ...]) -> File:
    """Return the folder that a file is relative to: that of the config, or the working directory for an override."""
    changed = _find_override(source, changes, Complaint(path, "")) is not None
    return File.cwd() if changed else source.folder


def _spell_out(data: dict[str, Any]) -> None:
    for path, slot in SLOTS.items():
        holder = _get_value(data, path[:-1])
        if isinstance(holder, dict) and path[-1] in holder:
            holder[path[-1]] = _expand_entry(holder[path[-1]], slot.name)
    if isinstance(data.get("observers"), list):
        data["observers"] = [_expand_entry(entry, None) for entry in data["observers"]]


def _expand_entry(entry: object, default: str | None) -> object:
    if isinstance(entry, str):
        return {"name": entry}
    if isinstance(entry, dict) and default and "name" not in entry:
        return {"name": default, **entry}
    return entry


def _build_registry(data: dict[str, Any], source: ConfigSource, changes: tuple[Override, ...]) -> Registry:
    files = data.get("plugins") or []
    if not isinstance(files, list) or not all(isinstance(file, str) for file in files):
        return load_registry()
    on_command_line = any(change.path[0] == "plugins" for change in changes)
    folder = File.cwd() if on_command_line else source.folder
    data["plugins"] = [name_of((folder / path_of(file)).resolve()) for file in files]
    try:
        return load_registry(data["plugins"])
    except PluginError as error:
        message = _format_line(source, changes, Complaint(("plugins",), str(error)))
        raise (ConfigError if isinstance(error, InputError) else PluginError)(message) from error


def _check_data(data: dict[str, Any], registry: Registry, strangers: bool) -> tuple[RunConfig | None, list[Complaint]]:
    wrong: list[Complaint] = []
    checked: RunConfig | None = None
    data = _state_regulariser(data, registry)
    try:
        checked = RunConfig.model_validate(data)
    except ValidationError as error:
        wrong += complaints(error, RunConfig, data, list(_list_nested_keys(data, registry)))
    plain = checked.plain() if checked else data
    for path, kind, entry in _list_entries(plain):
        options = {
            key: value for key, value in entry.items() if key != "name" and not (kind == "maximiser" and key in KEPT)
        }
        if strangers and entry["name"] not in registry.names(kind):
            continue
        try:
            typed, faults = registry.check(kind, entry["name"], options)
        except UnknownPluginError as error:
            wrong.append(Complaint((*path, "name"), str(error)))
            continue
        wrong += [fault.under(path) for fault in faults]
        if typed is not None:
            entry.update(typed.model_dump(mode="json", by_alias=True))
    return (RunConfig.model_validate(plain) if not wrong else None), wrong


def _state_regulariser(data: dict[str, Any], registry: Registry) -> dict[str, Any]:
    """Return the config with ``regulariser: null`` where it has no such key and its problem states all of its
    objective."""
    name = _get_value(data, ("problem", "name"))
    if "regulariser" in data or name not in registry.names("problem"):
        return data
    record = registry.get("problem", name)
    assert isinstance(record, ProblemPlugin)
    return data if record.regularised else {**data, "regulariser": None}


def _list_nested_keys(data: dict[str, Any], registry: Registry) -> Iterator[str]:
    """Yield the keys of the sections, with the section in front; among them the options of their components."""
    for path, slot in SLOTS.items():
        entry = _get_value(data, path)
        name = entry.get("name") if isinstance(entry, dict) else slot.name
        if name in registry.names(slot.kind):
            fields = registry.get(slot.kind, str(name)).options_type().model_fields
            yield from (dotted((*path, field.alias or key)) for key, field in fields.items())
    for section, inner in RunConfig.model_fields.items():
        for model in models_in(inner.annotation):
            yield from (dotted((section, key)) for key in model.model_fields if key != "name")


def _list_entries(data: dict[str, Any]) -> Iterator[tuple[Path, str, dict[str, Any]]]:
    slots: list[tuple[Path, str]] = [(path, slot.kind) for path, slot in SLOTS.items()]
    observers = data.get("observers")
    slots += [
        (("observers", position), "observer")
        for position in range(len(observers) if isinstance(observers, list) else 0)
    ]
    for path, kind in slots:
        entry = _get_value(data, path)
        if isinstance(entry, dict) and isinstance(entry.get("name"), str):
            yield path, kind, entry


def _get_value(data: Any, path: Path) -> Any:
    for step in path:
        try:
            data = data[step]
        except (KeyError, IndexError, TypeError):
            return None
    return data


def _make_error(source: ConfigSource, changes: tuple[Override, ...], wrong: list[Complaint]) -> ConfigError:
    inside = {complaint: source.position(complaint.path) for complaint in wrong}
    ordered = sorted(
        wrong, key=lambda complaint: (_find_override(source, changes, complaint) is not None, inside[complaint])
    )
    return ConfigError("\n".join(dict.fromkeys(_format_line(source, changes, complaint) for complaint in ordered)))


def _format_line(source: ConfigSource, changes: tuple[Override, ...], complaint: Complaint) -> str:
    change = _find_override(source, changes, complaint)
    if change is None:
        return f"{source.where(complaint.path)}: {complaint}"
    unquoted = any(phrase in complaint.message for phrase in (NOT_TEXT, NOT_PLAIN))
    hint = f"; as text it is written {change.quoted}" if unquoted else ""
    return f"override {change.text}: {complaint}{hint}"


def _find_override(source: ConfigSource, changes: tuple[Override, ...], complaint: Complaint) -> Override | None:
    """Return the override that gave a key: it set the key, or one below a key that was not written before."""
    path = [str(step) for step in complaint.path]
    for change in reversed(changes):
        changed = [str(step) for step in change.path]
        is_created = path and changed[: len(path)] == path and _get_value(source.data, complaint.path) is None
        if is_created or path[: len(changed)] == changed:
            return change
    return None
