"""Base of every contract: the component under test, and the report of a broken promise."""

from __future__ import annotations

import inspect
import io
from abc import ABC
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from functools import wraps
from importlib import import_module
from typing import Any, ClassVar, Generic, NoReturn, TypeVar

import numpy as np

from sparserob_core.experiment.plugins.hookspecs import record_type
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.options import Options, meanings

Component = TypeVar("Component")


class ContractBroken(AssertionError):
    """A component does not keep its contract. The message says what is wrong, and how to mend it."""


def broken(wrong: str, mend: str) -> NoReturn:
    """Raise `ContractBroken`."""
    raise ContractBroken(f"{wrong}\n  To mend it: {mend}")


def demand(held: object, wrong: str, mend: str) -> None:
    """Raise `ContractBroken` unless ``held``."""
    if not held:
        broken(wrong, mend)


def same(first: Any, second: Any) -> bool:
    """Return whether two arrays, or numbers, are equal to the last bit; NaN equals NaN."""
    return bool(np.array_equal(np.asarray(first), np.asarray(second), equal_nan=True))


def without_output(test: Callable[..., None]) -> Callable[..., None]:
    """Return a test that also fails where the component prints: the standard output belongs to the command that is
    run."""

    @wraps(test)
    def watched(*arguments: Any, **keywords: Any) -> None:
        with redirect_stdout(io.StringIO()) as output:
            test(*arguments, **keywords)
        demand(
            not output.getvalue(),
            f"it prints to the standard output, which belongs to the result: {output.getvalue()[:60]!r}",
            "use the module `logging`, or `print(..., file=sys.stderr)` while you look for a fault",
        )

    return watched


def _waits_for_arguments(given: Callable[..., object]) -> bool:
    """Return whether a callable is a method, a function with arguments or a fixture of pytest, which cannot be called
    as it is.

    A class is not examined: its own error names the arguments that it needs.
    """
    if not inspect.isfunction(given):
        return type(given).__module__.startswith("_pytest.")
    parameters = inspect.signature(given).parameters.values()
    return any(
        parameter.default is parameter.empty and parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        for parameter in parameters
    )


class Contract(ABC, Generic[Component]):
    """Base class of the contracts, each of which states and tests what every component of one kind must keep.

    Subclass the contract of the kind in a test module as ``class TestMine(...)``, and name the component under test
    with the class attribute ``component``: the class, or any function without arguments that makes a new component
    (such as a ``functools.partial`` of the class with its options). For an installed component its entry in a config
    will do: its name, or a mapping with its name and its options. A subclass may override `create` instead.

    pytest then runs every test of the contract. A test that fails says what is wrong, and how to mend it. A component
    that prints fails too, in whichever test it does so.
    """

    component: ClassVar[Any] = None
    kind: ClassVar[str]
    of: ClassVar[type | None] = None

    def __init_subclass__(cls, kind: str | None = None, of: type | None = None) -> None:
        super().__init_subclass__()
        if kind is not None:
            cls.kind, cls.of = kind, of
            for name, test in [*vars(cls).items()]:
                if name.startswith("test_"):
                    setattr(cls, name, without_output(test))

    def create(self) -> Component:
        """A new component, as ``component`` says; raises `TypeError` where it says nothing of use."""
        source = type(self).component
        if isinstance(source, str | Mapping):
            options = {"name": source} if isinstance(source, str) else dict(source)
            name = str(options.pop("name"))
            component: object = load_registry().build(self.kind, name, options)
        elif callable(source) and not _waits_for_arguments(source):
            component = source()
        else:
            raise TypeError(
                f"{type(self).__name__}: expected the attribute `component`: the class of the {self.kind}, a function "
                "without arguments that makes one, or its name in a config (a method is called `create`); "
                f"got {source!r}"
            )
        expected = self.expected()
        if not isinstance(component, expected):
            names = " or ".join(cls.__name__ for cls in expected)
            raise TypeError(f"{type(self).__name__}: `component` gave {component!r}, expected a {names}")
        return component  # type: ignore[return-value]

    def expected(self) -> tuple[type, ...]:
        """The classes of which a component of this kind may be."""
        if self.of is not None:
            return (self.of,)
        module, _, name = record_type(self.kind).component.partition(":")
        return (getattr(import_module(module), name),)

    @without_output
    def test_no_option_bears_a_name_that_the_framework_uses(self) -> None:
        component = self.create()
        if isinstance(component, Options):
            clashes = record_type(self.kind).taken(type(component))
            demand(
                not clashes,
                f"these options of {type(component).__name__} bear names that the framework uses itself: "
                f"{', '.join(clashes)}",
                "rename them: in a config, or as an argument in Python, the framework's own key would be meant",
            )

    @without_output
    def test_every_option_is_documented(self) -> None:
        component = self.create()
        if isinstance(component, Options):
            silent = [name for name, meaning in meanings(type(component)).items() if not meaning]
            demand(
                not silent,
                f"these options of {type(component).__name__} have no documentation: {', '.join(silent)}",
                "write a string under each field of the class; `sparserob plugins NAME` shows it to users",
            )
            demand(
                (type(component).__doc__ or "").strip() != (Options.__doc__ or "").strip() and type(component).__doc__,
                f"{type(component).__name__} has no docstring",
                "say in its first line what the component does, and from where the idea is (author, year)",
            )
