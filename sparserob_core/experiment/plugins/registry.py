"""Finds plugins: installed ones by their entry points, and single files."""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import TypeAlias

import pluggy

from sparserob_core.errors import PluginError
from sparserob_core.experiment.plugins.components import DISABLE, Failure, Registry
from sparserob_core.experiment.plugins.hookspecs import GROUP, Hooks, hookimpl
from sparserob_core.experiment.plugins.messages import nearest
from sparserob_core.experiment.plugins.records import RECORDS, Plugin

__all__ = ["Hooks", "Registry", "hookimpl", "load_own_registry", "load_registry"]

HOOKS = {record.hook: record for record in RECORDS.values()}
UNTRUSTED = (
    "only the components that come with SparseRob are loaded here; --plugins FILE loads those of a file of yours"
)

Finder: TypeAlias = Callable[[Sequence[str]], list[metadata.EntryPoint]]


OWN = "sparserob"  # the name of this distribution


def load_own_registry(extra_paths: Iterable[str | Path] = ()) -> Registry:
    """The components of this distribution, and of the files that the user himself names (``--plugins FILE``); nobody
    else's code is imported.

    For whatever judges or reads a directory that someone else may have written (``check``, ``simulate``, ``figures``,
    ``replay``): a run directory is data, so the plugins that its config names are not loaded, and neither are the entry
    points of other distributions. A component that is missing for that reason is an unknown name, and the message
    says how to load it. A file of ``extra_paths`` that fails is a `PluginError`.
    """
    files = tuple(Path(path).resolve() for path in extra_paths)
    return _load(files, _disabled(), _own_entry_points)


def load_registry(extra_paths: Iterable[str | Path] = (), entry_points: bool = True) -> Registry:
    """The core's own components, the installed plugins, and plugins that are single files.

    An installed plugin that fails to import is noted in ``failures`` and stops nobody; a file of ``extra_paths`` was
    asked for by name, so its failure is a `PluginError`. Plugins named in the environment variable
    ``SPARSEROB_DISABLE_PLUGINS`` (entry point or distribution, separated by commas) are not even imported.
    """
    files = tuple(Path(path).resolve() for path in extra_paths)
    if not entry_points:
        return _load(files, _disabled(), lambda disabled: [])
    return _load(files, _disabled(), _entry_points) if files else _installed(_disabled())


def _disabled() -> tuple[str, ...]:
    return tuple(sorted({name.strip() for name in os.environ.get(DISABLE, "").split(",")} - {""}))


@cache
def _installed(disabled: tuple[str, ...]) -> Registry:
    return _load((), disabled, _entry_points)


def _load(files: Sequence[Path], disabled: Sequence[str], installed: Finder) -> Registry:
    from sparserob_core.experiment.plugins import builtin

    plugins: dict[str, ModuleType] = {"core": builtin}
    failures: list[Failure] = []
    for entry in installed(disabled):
        try:
            plugins.setdefault(entry.name, entry.load())
        except Exception as error:  # noqa: BLE001  a stranger's module may raise anything, and must not stop the others
            failures.append(Failure(_identity(entry), f"{type(error).__name__}: {error}"))
    for file in files:
        plugins[file.stem] = _module(file)
    records: list[Plugin] = []
    for name, module in plugins.items():
        try:
            records += _records(name, module)
        except Exception as error:  # noqa: BLE001  likewise
            failures.append(
                Failure(name, str(error) if isinstance(error, PluginError) else f"{type(error).__name__}: {error}")
            )
    asked_for = {file.stem for file in files}
    for failure in failures:
        if failure.plugin in asked_for:
            raise PluginError(str(failure))
    hint = UNTRUSTED if installed is _own_entry_points else ""
    return Registry(records, failures, disabled, hint)


def _entry_points(disabled: Sequence[str]) -> list[metadata.EntryPoint]:
    found = {
        entry.name: entry
        for entry in metadata.entry_points(group=GROUP)
        if not {entry.name, _distribution(entry)} & set(disabled)
    }
    return [found[name] for name in sorted(found)]


def _own_entry_points(disabled: Sequence[str]) -> list[metadata.EntryPoint]:
    own = (one for one in metadata.entry_points(group=GROUP) if _distribution(one) == OWN)
    return sorted((one for one in own if not {one.name, OWN} & set(disabled)), key=lambda entry: entry.name)


def _distribution(entry: metadata.EntryPoint) -> str:
    return entry.dist.name if entry.dist else "?"


def _identity(entry: metadata.EntryPoint) -> str:
    version = f" {entry.dist.version}" if entry.dist else ""
    return f"{entry.name} ({_distribution(entry)}{version}, {entry.value})"


def _module(file: Path) -> ModuleType:
    name = f"sparserob_file_{hashlib.sha256(str(file).encode()).hexdigest()[:8]}_{file.stem}"
    specification = importlib.util.spec_from_file_location(name, file)
    if file.suffix != ".py" or not file.is_file() or specification is None or specification.loader is None:
        raise PluginError(f"{file}: no such plugin; expected a Python file")
    module = importlib.util.module_from_spec(specification)
    sys.modules[name] = module  # pydantic looks the annotations of a class up there
    try:
        specification.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise PluginError(f"{file}: the plugin failed to load: {type(error).__name__}: {error}") from error
    return module


def _records(name: str, module: ModuleType) -> Iterator[Plugin]:
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(Hooks)
    manager.register(module, name=name)
    callers = manager.get_hookcallers(module) or []
    for caller in callers:
        if not caller.has_spec():
            raise PluginError(f"unknown hook '{caller.name}'{nearest(caller.name, HOOKS)}")
    _refuse_unmarked(module, {caller.name for caller in callers})
    for caller in callers:
        expected = HOOKS[caller.name]
        for record in (record for records in caller() for record in records):
            if not isinstance(record, expected):
                raise PluginError(f"{caller.name} yielded {record!r}, expected records of type {expected.__name__}")
            yield replace(record, plugin=name)


def _refuse_unmarked(module: ModuleType, marked: set[str]) -> None:
    for name, _ in inspect.getmembers(module, inspect.isfunction):
        if name.startswith(f"{GROUP}_") and name not in marked:
            raise PluginError(f"'{name}' is not marked with @sparserob_core.hookimpl")
    if not marked:
        raise PluginError(f"it implements no hook; there are {', '.join(HOOKS)}")
