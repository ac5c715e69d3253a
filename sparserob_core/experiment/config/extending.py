"""A config that extends another one: ``extends: base.yaml``."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path as File
from typing import Any

from sparserob_core.encodings import name_of, path_of
from sparserob_core.errors import ConfigError, Path
from sparserob_core.experiment.config.matrices.files import resolve
from sparserob_core.experiment.config.reading.reader import ConfigSource, read_source
from sparserob_core.experiment.config.run_config import SLOTS, RunConfig
from sparserob_core.experiment.plugins.messages import Complaint, models_in, shown

EXTENDS = "extends"
MEANING = (
    "The file of a config, relative to this one, whose keys hold where this one says nothing. Keys of sections and of"
    " components of the same name are taken one by one; any other value stands in the place of the other's."
)
SECTIONS = {(name,) for name, field in RunConfig.model_fields.items() if [*models_in(field.annotation)]}
"""The sections whose keys are taken one by one, as those of components with the same name are."""


def extended(source: ConfigSource) -> ConfigSource:
    """Return a config together with the keys of the config that it extends, and so on along the chain.

    Keys of sections, and of components of the same name, are taken one by one. Any other value, a list, a set or a
    system, replaces the other's. Raises `ConfigError` where there is no such file, or a circle.
    """
    return _extend_source(source, ())


def movable(source: ConfigSource) -> tuple[dict[str, Any], list[Complaint]]:
    """Return the data of a config in a form that holds in any folder, and the faults that were found.

    Files of plugins have their absolute names, and the numbers of matrices replace their files.
    """
    data = copy.deepcopy(source.data)
    faults = list(resolve(data, lambda _: source.folder))
    files = data.get("plugins")
    if isinstance(files, list) and all(isinstance(file, str) for file in files):
        data["plugins"] = [name_of((source.folder / path_of(file)).resolve()) for file in files]
    return data, faults


def _extend_source(source: ConfigSource, above: tuple[File, ...]) -> ConfigSource:
    if EXTENDS not in source.data:
        return source
    file_name = source.data[EXTENDS]
    if not isinstance(file_name, str) or not file_name:
        raise _make_error(source, f"expected the file of a config (got {shown(file_name)})")
    above = (*above, File(source.name).resolve())
    file = source.folder / path_of(file_name)
    if file.resolve() in above:
        circle = " -> ".join(config.name for config in (*above[above.index(file.resolve()) :], file))
        raise _make_error(source, f"the configs extend one another in a circle: {circle}")
    try:
        base = read_source(file)
    except ConfigError as error:
        raise _make_error(source, str(error)) from None
    base = _extend_source(base, above)
    data, faults = movable(base)
    if faults:
        raise ConfigError("\n".join(f"{base.where(fault.path)}: {fault}" for fault in faults))
    own = {key: value for key, value in source.data.items() if key != EXTENDS}
    return replace(source, data=_merge_values(data, own, ()), base=base, own=own)


def _make_error(source: ConfigSource, said: str) -> ConfigError:
    return ConfigError(f"{source.where((EXTENDS,))}: {EXTENDS}: {said}")


def _merge_values(base: object, own: object, path: Path) -> Any:
    """Return the value at ``path`` of a config that extends another one, from the values of both."""
    slot = next((slot for slot_path, slot in SLOTS.items() if slot_path == path), None)
    if slot is not None:
        base, own = ({"name": value} if isinstance(value, str) else value for value in (base, own))
    elif path and path not in SECTIONS:
        return copy.deepcopy(own)
    if not isinstance(base, Mapping) or not isinstance(own, Mapping):
        return copy.deepcopy(own)
    name = None if slot is None else base.get("name", slot.name)
    if slot is not None and own.get("name", name) != name:
        return copy.deepcopy(own)
    component = {} if name is None else {"name": name}
    both = {key: _merge_values(base[key], own[key], (*path, key)) if key in base else own[key] for key in own}
    return {**component, **base, **copy.deepcopy(both)}
