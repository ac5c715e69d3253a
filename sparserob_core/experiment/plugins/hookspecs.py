"""Every hook on one screen; this module and `registry` are the only ones that know pluggy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

import pluggy

from sparserob_core.experiment.plugins.records import (
    DictionaryPlugin,
    InnerStopPlugin,
    MaximiserPlugin,
    MethodPlugin,
    ObserverPlugin,
    OuterStopPlugin,
    Plugin,
    ProblemPlugin,
    RegulariserPlugin,
    SchedulePlugin,
    SelectionPlugin,
    SetPlugin,
    SolverPlugin,
)

GROUP = "sparserob"

Hook = TypeVar("Hook", bound=Callable[..., Iterable[Plugin]])
_specification = pluggy.HookspecMarker(GROUP)
_implementation = pluggy.HookimplMarker(GROUP)


def hookimpl(function: Hook) -> Hook:
    """Marks a plugin's function as an implementation of the hook whose name it bears."""
    return _implementation(function)


class Hooks:
    """The hooks; each takes nothing and yields typed records."""

    @_specification
    def sparserob_problems(self) -> Iterable[ProblemPlugin]:
        """Problems: options in, an optimal control problem or a semi-infinite program out."""
        return ()

    @_specification
    def sparserob_sets(self) -> Iterable[SetPlugin]:
        """Convex sets, each under the key that a config writes it with."""
        return ()

    @_specification
    def sparserob_methods(self) -> Iterable[MethodPlugin]:
        """Methods: a program and tools in, a result out."""
        return ()

    @_specification
    def sparserob_dictionaries(self) -> Iterable[DictionaryPlugin]:
        """Dictionaries of piecewise constant functions."""
        return ()

    @_specification
    def sparserob_regularisers(self) -> Iterable[RegulariserPlugin]:
        """Strictly convex regularisers."""
        return ()

    @_specification
    def sparserob_solvers(self) -> Iterable[SolverPlugin]:
        """Solvers of one quadratic program."""
        return ()

    @_specification
    def sparserob_maximisers(self) -> Iterable[MaximiserPlugin]:
        """Global maximisers over a box."""
        return ()

    @_specification
    def sparserob_schedules(self) -> Iterable[SchedulePlugin]:
        """Schedules of the regulariser's weight (``Regu``)."""
        return ()

    @_specification
    def sparserob_outer_stops(self) -> Iterable[OuterStopPlugin]:
        """Stopping rules of the outer iteration (``SC1``)."""
        return ()

    @_specification
    def sparserob_inner_stops(self) -> Iterable[InnerStopPlugin]:
        """Stopping rules of one global maximisation (``SC2``)."""
        return ()

    @_specification
    def sparserob_selections(self) -> Iterable[SelectionPlugin]:
        """Rules by which a walk accepts a candidate (``SlCr``)."""
        return ()

    @_specification
    def sparserob_observers(self) -> Iterable[ObserverPlugin]:
        """Observers of a run."""
        return ()
