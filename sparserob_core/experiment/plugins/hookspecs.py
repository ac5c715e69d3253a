"""Every kind of component on one screen: the hook that yields its records, and the class of the components.

A new kind needs an abstract class and three lines here. This module and `registry` are the only ones that know pluggy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeVar, final

import click
import pluggy

from sparserob_core.errors import InputError
from sparserob_core.experiment.plugins.attribution import asked
from sparserob_core.experiment.plugins.records import RECORDS, Plugin
from sparserob_core.options import Options

GROUP = "sparserob"


@final
@dataclass(frozen=True, kw_only=True)
class ProblemPlugin(
    Plugin, hook="sparserob_problems", component="sparserob_core.control.problem.problem:ProblemFactory"
):
    """A `ProblemFactory`: it makes an optimal control problem or a semi-infinite program from its options.

    ``regularised`` is false where the problem states all of its objective, so that a config without the key
    ``regulariser`` has none.
    """

    regularised: bool = True


@final
class SetPlugin(Plugin, hook="sparserob_sets", component="sparserob_core.control.sets.sets:SetFactory"):
    """A `SetFactory`: it makes a convex set from its options; its name is the key in a config."""


@final
class PolicyPlugin(Plugin, hook="sparserob_policies", component="sparserob_core.control.policies.policy:Policy"):
    """A `Policy`: the measurements that the control may use while the system runs."""


@final
class MethodPlugin(Plugin, hook="sparserob_methods", component="sparserob_core.sip.method:Method"):
    """A `Method`: it solves a semi-infinite program and returns a result."""


@final
class DictionaryPlugin(
    Plugin, hook="sparserob_dictionaries", component="sparserob_core.control.problem.dictionary:DictionaryFactory"
):
    """A `DictionaryFactory`: it makes a dictionary of piecewise constant functions."""


@final
class RegulariserPlugin(Plugin, hook="sparserob_regularisers", component="sparserob_core.sip.convexity:Regulariser"):
    """A `Regulariser`: a strictly convex quadratic term of the cost."""


@final
class SolverPlugin(Plugin, hook="sparserob_solvers", component="sparserob_core.sip.solver:Solver"):
    """A `Solver` of one quadratic program."""


@final
class MaximiserPlugin(
    Plugin,
    hook="sparserob_maximisers",
    component="sparserob_core.sip.maximiser:Maximiser",
    reserved=(
        *("budget", "polish"),  # a config's keys of every maximiser; the arguments of `maximise` and `ask_tell` follow
        *("f", "box", "seed", "gradient", "notify", "start", "seconds", "callback", "target", "patience", "known"),
        *("state", "minimise", "integer", "logarithmic"),
        "origin",  # its name in messages
    ),
):
    """A `Maximiser` of a function over a box."""


@final
class RulePlugin(Plugin, hook="sparserob_rules", component="sparserob_core.sip.rules:Rule"):
    """A `Rule` of the paper's loop: a `Schedule` (``Regu``), an `OuterStop` (``SC1``), an `InnerStop` (``SC2``) or a
    `Selection` (``SlCr``)."""


@final
class ExecutorPlugin(Plugin, hook="sparserob_executors", component="sparserob_core.sip.method:ExecutorFactory"):
    """An `ExecutorFactory`: it opens the executor on which independent programs are solved."""


@final
class ObserverPlugin(Plugin, hook="sparserob_observers", component="sparserob_core.experiment.run.events:Observer"):
    """An `Observer`, which receives every event of a run or of a study."""


@final
class CommandPlugin(Plugin, hook="sparserob_commands", component="click:Command"):
    """A `click.Command` of the program ``sparserob``: the ``factory`` is the command itself, or its place.

    Users type an underscore of the name as a hyphen. The ``summary`` is its line in ``sparserob --help``.
    """

    @property
    def typed(self) -> str:
        """The name as users type it."""
        return self.name.replace("_", "-")

    @property
    def usage(self) -> str:
        """The help of the command."""
        command = self.create(Options())
        return command.get_help(click.Context(command, info_name=f"sparserob {self.typed}"))

    def create(self, options: Options) -> click.Command:
        """Return the command; it has arguments of its own and no ``options``."""
        return asked(self.origin, "loading it", self.resolved, click.Command)


Function = TypeVar("Function", bound=Callable[..., Iterable[Plugin]])
_implementation = pluggy.HookimplMarker(GROUP)


def hookimpl(function: Function) -> Function:
    """Mark a plugin's function as an implementation of the hook with the same name.

    The function takes no argument and yields records.
    """
    return _implementation(function)


def _make_specification(record: type[Plugin]) -> object:
    def hook() -> Iterable[Plugin]:
        return ()

    hook.__doc__ = record.__doc__
    return pluggy.HookspecMarker(GROUP)(hook)


HOOKS: dict[str, type[Plugin]] = {record.hook: record for record in RECORDS.values()}
FORMER: dict[str, type[Plugin]] = dict.fromkeys(
    ("sparserob_schedules", "sparserob_outer_stops", "sparserob_inner_stops", "sparserob_selections"), RulePlugin
)
"""Hooks that packages of interface 1 may implement: each of the four kinds of rules once had a hook and a record of its
own."""

SchedulePlugin = OuterStopPlugin = InnerStopPlugin = SelectionPlugin = RulePlugin

SPECIFICATIONS = type(
    "Specifications", (), {name: _make_specification(record) for name, record in {**FORMER, **HOOKS}.items()}
)


def record_type(kind: str) -> type[Plugin]:
    """Return the record class of a kind; raises `InputError` for an unknown kind."""
    if kind not in RECORDS:
        raise InputError(f"kind: expected one of {', '.join(RECORDS)}, got {kind!r}")
    return RECORDS[kind]
