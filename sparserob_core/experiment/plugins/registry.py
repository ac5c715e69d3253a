"""The search for plugins: installed ones by their entry points, and single files."""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import TypeAlias

import pluggy

from sparserob_core.encodings import path_of
from sparserob_core.errors import PluginError, UnknownPluginError
from sparserob_core.experiment.plugins import files
from sparserob_core.experiment.plugins.attribution import attributed, short_repr
from sparserob_core.experiment.plugins.components import DISABLE, Failure, Registry
from sparserob_core.experiment.plugins.hookspecs import FORMER, GROUP, HOOKS, SPECIFICATIONS
from sparserob_core.experiment.plugins.messages import nearest
from sparserob_core.experiment.plugins.records import Plugin

UNTRUSTED = (
    "only the components that come with SparseRob are loaded here; --plugins FILE loads those of a file of yours"
)

Finder: TypeAlias = Callable[[Sequence[str], list[Failure]], list[metadata.EntryPoint]]
"""A function that returns the entry points that are not disabled, and adds unreadable distributions to the failures."""


OWN = "sparserob"  # the name of this distribution

_free_managers: list[pluggy.PluginManager] = []
"""Managers that know the hooks and hold no plugin. They are kept, since adding the hooks takes as long as all the rest.
"""


def load_own_registry(extra_paths: Iterable[str | Path] = ()) -> Registry:
    """Return the components of this distribution, and of the plugin files that the user names (``--plugins FILE``).

    It is for commands that read a directory which someone else may have written: ``check``, ``simulate``, ``figures``
    and ``replay``. A run directory is data: neither the plugins that its config names nor the entry points of other
    distributions are loaded. A component that is missing for this reason is an unknown name, and the message says how
    to load it.

    Parameters
    ----------
    extra_paths : iterable of str or Path, default ()
        The plugin files.

    Returns
    -------
    Registry
        The components.

    Raises
    ------
    PluginError
        If a plugin file fails.
    """
    return _add_files(_load_own(_list_disabled()), extra_paths, UNTRUSTED)


def load_registry(extra_paths: Iterable[str | Path] = (), entry_points: bool = True) -> Registry:
    """Return the components of the core, of the installed plugins, and of plugins that are single files.

    Plugins named in the environment variable ``SPARSEROB_DISABLE_PLUGINS`` (entry point or distribution, separated by
    commas) are not imported.

    Parameters
    ----------
    extra_paths : iterable of str or Path, default ()
        The plugin files.
    entry_points : bool, default True
        Whether installed plugins are loaded.

    Returns
    -------
    Registry
        The components. An installed plugin that fails to import is listed in ``failures``, and the others are loaded.

    Raises
    ------
    PluginError
        If a plugin file fails, as the user has named it.
    """
    if not entry_points:
        return _add_files(_load_plugins(_list_disabled(), lambda disabled, failures: []), extra_paths)
    return _add_files(_load_installed(_list_disabled()), extra_paths)


def _add_files(known: Registry, extra_paths: Iterable[str | Path], hint: str = "") -> Registry:
    paths = tuple(path_of(path).resolve() for path in extra_paths)
    return Registry([*known.records(), *_load_files(paths)], known.failures, _list_disabled(), hint) if paths else known


def _list_disabled() -> tuple[str, ...]:
    return tuple(sorted({name.strip() for name in os.environ.get(DISABLE, "").split(",")} - {""}))


@cache
def _load_installed(disabled: tuple[str, ...]) -> Registry:
    return _load_plugins(disabled, _list_entry_points)


@cache
def _load_own(disabled: tuple[str, ...]) -> Registry:
    return _load_plugins(disabled, _list_own_entry_points, UNTRUSTED)


@dataclass(frozen=True)
class _LoadedPlugin:
    """A plugin: its name, its file or distribution, and its module."""

    name: str
    source: str
    module: ModuleType


def _load_plugins(disabled: Sequence[str], installed: Finder, hint: str = "") -> Registry:
    from sparserob_core.experiment.plugins import builtin

    plugins, failures = [_LoadedPlugin("core", "", builtin)], list[Failure]()
    for entry in installed(disabled, failures):
        with _collect_failures(failures, _describe_entry(entry)):
            module = entry.load()
            if module is not builtin:
                plugins.append(_LoadedPlugin(entry.name, _describe_source(entry), module))
    records: list[Plugin] = []
    for plugin in plugins:
        with _collect_failures(failures, plugin.name):
            records += _collect_records(plugin)
    return Registry(records, failures, disabled, hint)


def _load_files(paths: Sequence[Path]) -> Iterator[Plugin]:
    """Yield the records of plugin files, which are executed anew.

    The user has named these files, so that a failure is an error.
    """
    for file in paths:
        yield from _collect_records(_LoadedPlugin(file.stem, str(file), _load_module(file)))


@contextmanager
def _collect_failures(failures: list[Failure], plugin: str) -> Iterator[None]:
    """Add any error of a plugin inside the context to the ``failures``, so that the other plugins are loaded."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001  SystemExit too
        failures.append(Failure(plugin, str(error) if isinstance(error, PluginError) else _describe_error(error)))


def _describe_error(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _list_entry_points(disabled: Sequence[str], failures: list[Failure]) -> list[metadata.EntryPoint]:
    allowed = (
        entry for entry in _find_entry_points(failures) if not {entry.name, _get_distribution(entry)} & set(disabled)
    )
    return sorted(allowed, key=lambda entry: entry.name)


def _list_own_entry_points(disabled: Sequence[str], failures: list[Failure]) -> list[metadata.EntryPoint]:
    return [entry for entry in _list_entry_points(disabled, failures) if _get_distribution(entry) == OWN]


def _find_entry_points(failures: list[Failure]) -> Iterator[metadata.EntryPoint]:
    """Yield the entry points of every distribution that can be read.

    Of distributions with one name it takes the first on the path, which is the one that is imported.

    `importlib.metadata.entry_points` would stop at the first error, which one broken folder can cause. pip writes ``~``
    in front of the name while it replaces a distribution: such a folder is a copy that was left behind.
    """
    names = set[str]()
    for distribution in metadata.distributions():
        folder = getattr(distribution, "_path", None)
        with _collect_failures(failures, f"{folder or 'a distribution'}"):
            if folder is not None and str(folder.name).startswith("~"):
                raise PluginError("it is what an interrupted installation left behind; delete this folder")
            name = _normalise_name(distribution)
            if name not in names:
                names.add(name)
                yield from list(distribution.entry_points.select(group=GROUP))


def _normalise_name(distribution: metadata.Distribution) -> str:
    try:
        name = distribution.name
    except Exception:  # noqa: BLE001  without a file of metadata each Python raises another error
        name = None
    if not isinstance(name, str) or not name:
        raise PluginError("it is no distribution, because it names none; delete it, or install it anew")
    return re.sub(r"[-_.]+", "-", name).lower()


def _get_distribution(entry: metadata.EntryPoint) -> str:
    return _read_name_and_version(entry.dist)[0] if entry.dist else "?"


def _describe_source(entry: metadata.EntryPoint) -> str:
    version = f" {_read_name_and_version(entry.dist)[1]}" if entry.dist else ""
    return f"{_get_distribution(entry)}{version}, {entry.value}"


@cache
def _read_name_and_version(distribution: metadata.Distribution) -> tuple[str, str]:
    """Return name and version of a distribution.

    They are kept, as each request parses the metadata anew and all entry points of a distribution need them.
    """
    return distribution.name, distribution.version


def _describe_entry(entry: metadata.EntryPoint) -> str:
    return f"{entry.name} ({_describe_source(entry)})"


def _load_module(file: Path) -> ModuleType:
    if file.suffix != ".py" or not file.is_file():
        raise UnknownPluginError(f"{file}: no such plugin; expected a Python file")
    with attributed(f"plugin '{file.stem}' ({file})", "loading it", but=()):
        return files.load(file)


def _collect_records(plugin: _LoadedPlugin) -> Sequence[Plugin]:
    """Return the records of a plugin, which is the only one in its manager."""
    who = f"plugin '{plugin.name}'" + (f" ({plugin.source})" if plugin.source else "")
    manager = _free_managers.pop() if _free_managers else _make_manager()
    with attributed(who, "registering it", but=()):
        manager.register(plugin.module, name=plugin.name)
    records = list(_call_hooks(plugin, who, manager.get_hookcallers(plugin.module) or []))
    manager.unregister(plugin.module)
    _free_managers.append(manager)
    return records


def _make_manager() -> pluggy.PluginManager:
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(SPECIFICATIONS)
    return manager


def _call_hooks(plugin: _LoadedPlugin, who: str, callers: Sequence[pluggy.HookCaller]) -> Iterator[Plugin]:
    for caller in callers:
        if not caller.has_spec():
            raise PluginError(f"{who}: unknown hook '{caller.name}'{nearest(caller.name, HOOKS)}")
    _refuse_unmarked(who, plugin.module, {caller.name for caller in callers})
    for caller in callers:
        expected = HOOKS.get(caller.name) or FORMER[caller.name]
        with attributed(who, f"hook {caller.name}", but=()):
            yielded = [record for records in caller() for record in records]
        for record in yielded:
            if not isinstance(record, expected):
                raise PluginError(
                    f"{who}: {caller.name} yielded {short_repr(record)}, expected records of type {expected.__name__}"
                )
            copy = replace(record, plugin=plugin.name, source=plugin.source)
            if not isinstance(copy.factory, str):  # the options of a lazy factory are checked when it is imported
                copy.options_type()
            yield copy


def _refuse_unmarked(who: str, module: ModuleType, marked: set[str]) -> None:
    for name, _ in inspect.getmembers(module, inspect.isfunction):
        if name.startswith(f"{GROUP}_") and name not in marked:
            raise PluginError(f"{who}: '{name}' is not marked with @sparserob_core.hookimpl")
    if not marked:
        raise PluginError(f"{who}: it implements no hook; there are {', '.join(HOOKS)}")
