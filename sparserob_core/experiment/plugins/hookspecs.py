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
class RegulariserPlugin(Plugin, hook="sparserob_regularisers", component="sparserob_core.sip.regulariser:Regulariser"):
    """A `Regulariser`: a strictly convex quadratic."""


@final
class SolverPlugin(Plugin, hook="sparserob_solvers", component="sparserob_core.sip.solver:Solver"):
    """A `Solver` of one quadratic program."""


@final
class MaximiserPlugin(Plugin, hook="sparserob_maximisers", component="sparserob_core.sip.maximiser:Maximiser"):
    """A `Maximiser` over a box."""


@final
class SchedulePlugin(Plugin, hook="sparserob_schedules", component="sparserob_core.sip.rules:Schedule"):
    """A `Schedule`: the next weight of the regulariser, the paper's ``Regu``."""


@final
class OuterStopPlugin(Plugin, hook="sparserob_outer_stops", component="sparserob_core.sip.rules:OuterStop"):
    """An `OuterStop`: when outer iterations end, the paper's ``SC1``."""


@final
class InnerStopPlugin(Plugin, hook="sparserob_inner_stops", component="sparserob_core.sip.rules:InnerStop"):
    """An `InnerStop`: when one global maximisation ends, the paper's ``SC2``."""


@final
class SelectionPlugin(Plugin, hook="sparserob_selections", component="sparserob_core.sip.rules:Selection"):
    """A `Selection`: whether a walk accepts a candidate, the paper's ``SlCr``."""


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

    hook.__name__, hook.__doc__ = record.hook, record.__doc__
    return pluggy.HookspecMarker(GROUP)(hook)


HOOKS = {record.hook: record for record in RECORDS.values()}
SPECIFICATIONS = type("Specifications", (), {name: _specification(record) for name, record in HOOKS.items()})


def record_type(kind: str) -> type[Plugin]:
    """The record class of a kind; raises `InputError` for an unknown kind."""
    if kind not in RECORDS:
        raise InputError(f"kind: expected one of {', '.join(RECORDS)}, got {kind!r}")
    return RECORDS[kind]
