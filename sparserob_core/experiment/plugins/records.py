"""What a plugin registers: one typed record per component."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import ClassVar, final

from sparserob_core.errors import InputError, PluginError
from sparserob_core.options import Options


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """A component under a name.

    ``name``     lower-case letters, digits and underscores, starting with a letter;
    ``factory``  the component's class, or ``"package.module:attribute"``, which is imported only when it is chosen;
    ``options``  the class of its options; not needed when the component's class is itself an `Options`;
    ``summary``  one line for ``sparserob plugins``;
    ``plugin``   who registered it (filled in by the registry).

    ``factory(**options)`` builds the component. Raises `PluginError` when a field is malformed.
    """

    kind: ClassVar[str]
    hook: ClassVar[str]
    component: ClassVar[str]

    name: str
    factory: Callable[..., object] | str
    options: type[Options] | None = None
    summary: str = ""
    plugin: str = ""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_]*", str(self.name)):
            raise PluginError(f"{type(self).__name__}: name must match [a-z][a-z0-9_]*, got {self.name!r}")
        lazy = isinstance(self.factory, str) and re.fullmatch(r"[\w.]+:\w+", self.factory)
        if not (callable(self.factory) or lazy):
            raise PluginError(f"{self}: factory must be a class or 'package.module:attribute', got {self.factory!r}")
        options: object = self.options
        if options is not None and not (isinstance(options, type) and issubclass(options, Options)):
            raise PluginError(f"{self}: options must be a subclass of sparserob_core.Options, got {self.options!r}")

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'"

    def resolved(self) -> Callable[..., object]:
        """The factory itself; a lazy one is imported now."""
        if not isinstance(self.factory, str):
            return self.factory
        module, _, attribute = self.factory.partition(":")
        try:
            factory = getattr(import_module(module), attribute)
        except (ImportError, AttributeError) as error:
            raise PluginError(
                f"{self} (plugin '{self.plugin}') cannot be loaded from '{self.factory}': {error}"
            ) from error
        if not callable(factory):
            raise PluginError(f"{self} (plugin '{self.plugin}'): '{self.factory}' is not callable")
        return factory  # type: ignore[no-any-return]

    def options_type(self) -> type[Options]:
        """The class of the options: as registered, else the component's own class, else no options at all."""
        if self.options is not None:
            return self.options
        factory = self.resolved()
        return factory if isinstance(factory, type) and issubclass(factory, Options) else Options

    def create(self, options: Options) -> object:
        """The component for validated options, checked to be of this kind."""
        factory = self.resolved()
        try:
            component = options if factory is type(options) else factory(**_fields(options))
        except TypeError as error:
            raise PluginError(f"{self} (plugin '{self.plugin}') cannot be built from its options: {error}") from error
        module, _, attribute = self.component.partition(":")
        expected = getattr(import_module(module), attribute)
        if not isinstance(component, expected):
            raise PluginError(
                f"{self} (plugin '{self.plugin}') built a {type(component).__name__}, expected a {attribute}"
            )
        return component


def _fields(options: Options) -> Mapping[str, object]:
    return {name: getattr(options, name) for name in type(options).model_fields}


@final
class DictionaryPlugin(Plugin):
    """A `DictionaryFactory`: piecewise constant functions."""

    kind = "dictionary"
    hook = "sparserob_dictionaries"
    component = "sparserob_core.control.problem.dictionary:DictionaryFactory"


@final
class RegulariserPlugin(Plugin):
    """A `Regulariser`: a strictly convex quadratic."""

    kind = "regulariser"
    hook = "sparserob_regularisers"
    component = "sparserob_core.sip.regulariser:Regulariser"


@final
class SolverPlugin(Plugin):
    """A `Solver` of one quadratic program."""

    kind = "solver"
    hook = "sparserob_solvers"
    component = "sparserob_core.sip.solver:Solver"


@final
class MaximiserPlugin(Plugin):
    """A `Maximiser` over a box."""

    kind = "maximiser"
    hook = "sparserob_maximisers"
    component = "sparserob_core.sip.maximiser:Maximiser"


@final
class MethodPlugin(Plugin):
    """A `Method`: semi-infinite program in, result out."""

    kind = "method"
    hook = "sparserob_methods"
    component = "sparserob_core.sip.method:Method"


@final
class ProblemPlugin(Plugin):
    """A `ProblemFactory`: options in, an optimal control problem or a semi-infinite program out."""

    kind = "problem"
    hook = "sparserob_problems"
    component = "sparserob_core.control.problem.problem:ProblemFactory"


@final
class SetPlugin(Plugin):
    """A `SetFactory`: options in, a convex set out; its name is the key that a config writes it under."""

    kind = "set"
    hook = "sparserob_sets"
    component = "sparserob_core.control.sets.sets:SetFactory"


@final
class SchedulePlugin(Plugin):
    """A `Schedule`: the next weight of the regulariser, the paper's ``Regu``."""

    kind = "schedule"
    hook = "sparserob_schedules"
    component = "sparserob_core.sip.rules:Schedule"


@final
class OuterStopPlugin(Plugin):
    """An `OuterStop`: when outer iterations end, the paper's ``SC1``."""

    kind = "outer_stop"
    hook = "sparserob_outer_stops"
    component = "sparserob_core.sip.rules:OuterStop"


@final
class InnerStopPlugin(Plugin):
    """An `InnerStop`: when one global maximisation ends, the paper's ``SC2``."""

    kind = "inner_stop"
    hook = "sparserob_inner_stops"
    component = "sparserob_core.sip.rules:InnerStop"


@final
class SelectionPlugin(Plugin):
    """A `Selection`: whether a walk accepts a candidate, the paper's ``SlCr``."""

    kind = "selection"
    hook = "sparserob_selections"
    component = "sparserob_core.sip.rules:Selection"


@final
class ObserverPlugin(Plugin):
    """An `Observer`, told of every event."""

    kind = "observer"
    hook = "sparserob_observers"
    component = "sparserob_core.experiment.run.events:Observer"


RECORDS: Mapping[str, type[Plugin]] = {
    record.kind: record
    for record in (
        ProblemPlugin,
        SetPlugin,
        MethodPlugin,
        DictionaryPlugin,
        RegulariserPlugin,
        SolverPlugin,
        MaximiserPlugin,
        SchedulePlugin,
        OuterStopPlugin,
        InnerStopPlugin,
        SelectionPlugin,
        ObserverPlugin,
    )
}


def record_type(kind: str) -> type[Plugin]:
    """The record class of a kind; raises `InputError` for an unknown kind."""
    if kind not in RECORDS:
        raise InputError(f"kind: expected one of {', '.join(RECORDS)}, got {kind!r}")
    return RECORDS[kind]
