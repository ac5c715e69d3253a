"""The records that a plugin registers, one for each component."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar

from sparserob_core.arguments import is_whole
from sparserob_core.errors import PluginError, SparseRobError, UnknownPluginError, not_installed
from sparserob_core.experiment.plugins.attribution import asked, attributed
from sparserob_core.options import Options

INTERFACE = 1
"""The version of the public interface: the names that a component may import, and the arguments that it receives. It
increases when a component that was correct would no longer be so."""

OLDEST = 1
"""The oldest version whose components run without a change."""

RECORDS: dict[str, type[Plugin]] = {}
"""Every kind of component, by name, in the order of `hookspecs`."""


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """The record of a component.

    ``factory(**options)`` builds the component. A kind of component is a subclass: ``hook`` yields its records,
    ``component`` is the class of the components, and ``kind`` is its name. ``reserved`` are the names that no option
    may have, because the framework's own keys and arguments have them.

    Parameters
    ----------
    name : str
        Its name: lower-case letters, digits and underscores, starting with a letter.
    factory : callable or str
        The component's class, or ``"package.module:attribute"``, which is imported only when it is chosen.
    options : type of Options, optional
        The class of its options; not needed where the component's class is itself an `Options`.
    summary : str, default ""
        One line for ``sparserob plugins``.
    plugin, source : str, default ""
        The plugin that registered it, and its file or distribution; the registry adds both.
    needs : tuple of two str, optional
        A module that may be missing, and the package with it for pip, such as ``("rerun", "rerun-sdk")``, or ``""``
        where pip cannot install it. The module is searched where the component is built, before anything is solved.
    open : bool, default False
        Whether the package that it needs has all or further options of it. The package is imported to ask for them;
        schema and reference leave them open.
    interface : int, default 1
        The version of the public interface that it was written for (`INTERFACE`). The default is the first version that
        records could name.

    Raises
    ------
    PluginError
        If a field is malformed.
    """

    kind: ClassVar[str]
    hook: ClassVar[str]
    component: ClassVar[str]
    reserved: ClassVar[frozenset[str]]

    name: str
    factory: Callable[..., object] | str
    options: type[Options] | None = None
    summary: str = ""
    plugin: str = ""
    source: str = ""
    needs: tuple[str, str] | None = None
    open: bool = False
    interface: int = 1

    def __init_subclass__(cls, hook: str, component: str, reserved: tuple[str, ...] = ()) -> None:
        cls.hook, cls.component = hook, component
        cls.reserved = frozenset({"name", *reserved})
        cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__.removesuffix("Plugin")).lower()
        RECORDS[cls.kind] = cls

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]*", str(self.name)):
            raise PluginError(f"{type(self).__name__}: name must match [a-z][a-z0-9_]*, got {self.name!r}")
        lazy = isinstance(self.factory, str) and re.fullmatch(r"[\w.]+:\w+", self.factory)
        if not (callable(self.factory) or lazy):
            raise PluginError(f"{self}: factory must be a class or 'package.module:attribute', got {self.factory!r}")
        options: object = self.options
        if options is not None and not (isinstance(options, type) and issubclass(options, Options)):
            raise PluginError(f"{self}: options must be a subclass of sparserob_core.Options, got {self.options!r}")

        self._check_interface()

    def _check_interface(self) -> None:
        """Raise `PluginError` for a record of an interface that is not supported, with the line to change."""
        if not is_whole(self.interface, 1):
            raise PluginError(f"{self}: interface must be a whole number of at least 1, got {self.interface!r}")
        line = f"{type(self).__name__}(name={self.name!r}, ...)"
        if self.interface > INTERFACE:
            raise PluginError(
                f"{self}: written for interface {self.interface}, and this SparseRob has {INTERFACE}: install a newer "
                f"one, or, where the component needs nothing newer, change `interface={self.interface}` to "
                f"`interface={INTERFACE}` in {line}"
            )
        if self.interface < OLDEST:
            raise PluginError(
                f"{self}: written for interface {self.interface}, and this SparseRob has {OLDEST} to {INTERFACE}: the "
                f"changelog says what changed; then write `interface={INTERFACE}` in {line}"
            )

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    @property
    def usage(self) -> str:
        """The help of a component that users call beside a config; else empty."""
        return ""

    @property
    def origin(self) -> str:
        """The component with its kind and its source, for messages."""
        source = f", {self.source}" if self.source else ""
        return f"{self} (plugin '{self.plugin}'{source}, hook {self.hook})"

    @property
    def distribution(self) -> str:
        """The distribution of the component with its version, or its file."""
        return self.source.partition(", ")[0] or "sparserob"

    @property
    def missing(self) -> str:
        """The package that is not installed, and how to install it, as one sentence; empty where nothing is missing."""
        if self.needs is None or find_spec(self.needs[0]) is not None:
            return ""
        package, brings = self.needs
        return f"{self}: {not_installed(package, brings)}"

    def _refuse_missing(self) -> None:
        if self.missing:
            raise UnknownPluginError(self.missing)

    def resolved(self) -> Callable[..., object]:
        """Return the factory itself; a lazy one is imported now.

        Raises `UnknownPluginError` where the package that it needs is missing, and `PluginError` where the import
        fails.
        """
        if not isinstance(self.factory, str):
            return self.factory
        self._refuse_missing()
        module, _, attribute = self.factory.partition(":")
        with attributed(self.origin, f"loading {self.factory!r}", but=()):
            factory = getattr(import_module(module), attribute)
        if not callable(factory):
            raise PluginError(f"{self.origin}: {self.factory!r} is not callable")
        return factory  # type: ignore[no-any-return]

    def may_be(self, of: type) -> bool:
        """Return whether the component may be an instance of a class.

        The class of a function's components is known only after a call. A factory that cannot be loaded is an error
        where it is chosen.
        """
        try:
            factory = self.resolved()
        except SparseRobError:
            return True
        return not isinstance(factory, type) or issubclass(factory, of)

    def options_type(self) -> type[Options]:
        """Return the class of the options: the registered one, else the component's own class, else no options at all.

        Raises `PluginError` where an option has a name that is reserved.
        """
        options = self.options
        if options is None:
            factory = self.resolved()
            options = factory if isinstance(factory, type) and issubclass(factory, Options) else Options
        self._refuse_hidden(options, self.factory)
        reserved = self.taken(options)
        if reserved:
            raise PluginError(
                f"{self.origin}: the option {reserved[0]!r} bears a name that the framework uses itself; rename it "
                f"(reserved: {', '.join(sorted(self.reserved))})"
            )
        return options

    @classmethod
    def taken(cls, options: type[Options]) -> list[str]:
        """Return the options, sorted, that have a reserved name."""
        fields = options.model_fields
        return sorted(cls.reserved & {*fields, *(field.alias for field in fields.values() if field.alias)})

    def _refuse_hidden(self, options: type[Options], factory: object) -> None:
        """Raise `PluginError` where an option has the name of a method or a property of the component's class.

        This is so too for anything that the framework's class defines. It is checked where the options have a class of
        their own, and for a lazy factory when it builds.
        """
        if not isinstance(factory, type) or factory is options:
            return
        module, _, attribute = self.component.partition(":")
        kind = getattr(import_module(module), attribute)
        for key in sorted(options.model_fields):
            owner = next((base for base in factory.__mro__ if key in vars(base)), object)
            value = vars(owner).get(key)
            if inspect.isroutine(value) or inspect.isdatadescriptor(value) or (value is not None and owner is kind):
                raise PluginError(f"{self.origin}: the option {key!r} bears a name that its class uses; rename it")

    @property
    def switches(self) -> frozenset[str]:
        """The words, entry point and distribution, each of which disables it; none for a file and for the core."""
        if not self.source or Path(self.source).is_absolute():
            return frozenset()
        return frozenset({self.plugin, self.distribution.partition(" ")[0]}) - {"?", "sparserob"}

    def create(self, options: Options) -> object:
        """Return the component for validated options; raises `PluginError` where it is not of this kind."""
        self._refuse_missing()
        factory = self.resolved()
        self._refuse_hidden(type(options), factory)
        module, _, attribute = self.component.partition(":")
        expected = getattr(import_module(module), attribute)
        if factory is type(options):
            return asked(self.origin, "building it", lambda: options, expected)
        return asked(self.origin, "building it", lambda: factory(**_get_fields(options)), expected)


def _get_fields(options: Options) -> Mapping[str, object]:
    return {name: getattr(options, name) for name in type(options).model_fields}
