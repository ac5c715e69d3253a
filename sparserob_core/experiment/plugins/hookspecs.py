"""Every kind of component on one screen: the hook that yields its records, and the class of what they build.

To add a kind, write its abstract class and three lines here. This module and `registry` are the only ones that know
pluggy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar, final

import pluggy

from sparserob_core.errors import InputError
from sparserob_core.experiment.plugins.records import RECORDS, Plugin

GROUP = "sparserob"


@final
class ProblemPlugin(
    Plugin, hook="sparserob_problems", component="sparserob_core.control.problem.problem:ProblemFactory"
):
    """A `ProblemFactory`: options in, an optimal control problem or a semi-infinite program out."""


@final
class SetPlugin(Plugin, hook="sparserob_sets", component="sparserob_core.control.sets.sets:SetFactory"):
    """A `SetFactory`: options in, a convex set out; its name is the key that a config writes it under."""


@final
class PolicyPlugin(Plugin, hook="sparserob_policies", component="sparserob_core.control.policies.policy:Policy"):
    """A `Policy`: what the control may know while the system runs."""


@final
class MethodPlugin(Plugin, hook="sparserob_methods", component="sparserob_core.sip.method:Method"):
    """A `Method`: semi-infinite program in, result out."""


@final
class DictionaryPlugin(
    Plugin, hook="sparserob_dictionaries", component="sparserob_core.control.problem.dictionary:DictionaryFactory"
):
    """A `DictionaryFactory`: piecewise constant functions."""


@final
class RegulariserPlugin(Plugin, hook="sparserob_regularisers", component="sparserob_core.sip.convexity:Regulariser"):
    """A `Regulariser`: a strictly convex quadratic."""


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
        "origin",  # what messages call it
    ),
):
    """A `Maximiser` over a box."""


@final
class RulePlugin(Plugin, hook="sparserob_rules", component="sparserob_core.sip.rules:Rule"):
    """A `Rule` of the paper's loop: a `Schedule` (``Regu``), an `OuterStop` (``SC1``), an `InnerStop` (``SC2``) or a
    `Selection` (``SlCr``)."""


@final
class ExecutorPlugin(Plugin, hook="sparserob_executors", component="sparserob_core.sip.method:ExecutorFactory"):
    """An `ExecutorFactory`: where independent programs are solved."""


@final
class ObserverPlugin(Plugin, hook="sparserob_observers", component="sparserob_core.experiment.run.events:Observer"):
    """An `Observer`, which receives every event."""


Function = TypeVar("Function", bound=Callable[..., Iterable[Plugin]])
_implementation = pluggy.HookimplMarker(GROUP)


def hookimpl(function: Function) -> Function:
    """Marks a plugin's function as an implementation of the hook whose name it bears: it takes nothing, and yields
    records."""
    return _implementation(function)


def _specification(record: type[Plugin]) -> object:
    def hook() -> Iterable[Plugin]:
        return ()

    hook.__doc__ = record.__doc__
    return pluggy.HookspecMarker(GROUP)(hook)


HOOKS: dict[str, type[Plugin]] = {record.hook: record for record in RECORDS.values()}
FORMER: dict[str, type[Plugin]] = dict.fromkeys(
    ("sparserob_schedules", "sparserob_outer_stops", "sparserob_inner_stops", "sparserob_selections"), RulePlugin
)
"""Hooks that packages of interface 1 may have: each of the four pieces had its own, and a record, before they were one
kind."""

SchedulePlugin = OuterStopPlugin = InnerStopPlugin = SelectionPlugin = RulePlugin

SPECIFICATIONS = type(
    "Specifications", (), {name: _specification(record) for name, record in {**FORMER, **HOOKS}.items()}
)


def record_type(kind: str) -> type[Plugin]:
    """The record class of a kind; raises `InputError` for an unknown kind."""
    if kind not in RECORDS:
        raise InputError(f"kind: expected one of {', '.join(RECORDS)}, got {kind!r}")
    return RECORDS[kind]
