"""A term that no problem of the package knows, whole: its class, its key, and its derivation for the checker.

What a store holds at time 0, and gives to controls, must be enough: ``level - int_0^stop G u dt >= least``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Self, final

import numpy as np
from pydantic import Field

import sparserob_core as sr
from sparserob_core.checker.problem.integrals import DERIVED, Rows
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.terms.integral import IntegralConstraint
from sparserob_core.control.problem.terms.windows import Setting, Window, coefficients
from sparserob_core.control.term import TIME, UNITLESS, each, measured
from sparserob_core.experiment.config.matrices.packed import RowsOfNumbers
from sparserob_core.experiment.config.set_options import TermOptions


@final
@dataclass(frozen=True, eq=False)
class Store(Window):
    """Of a ``level`` at time 0, from which ``G u`` is taken per time, ``G (1, m)``, at least ``least`` is left at
    ``stop``."""

    G: Any = field(metadata=measured(lambda of: 1.0 / (of.controls * of.time)))
    level: float = field(metadata=UNITLESS)
    least: float = field(default=0.0, metadata=UNITLESS)
    stop: float | None = field(default=None, metadata=TIME)
    name: str | None = field(default=None, metadata=UNITLESS)
    start = 0.0

    def checked(self, where: str, setting: Setting) -> Self:
        (G,) = coefficients(where, G=(self.G, setting.controls, "control"))
        return replace(self, G=G, stop=setting.horizon if self.stop is None else float(self.stop))

    @property
    def bounds(self) -> sr.Box:
        return sr.Box([-np.inf], [self.level - self.least])

    def scaled(self, factor: float) -> Self:
        return replace(self, least=self.level - factor * (self.level - self.least))

    def rows(self, called: str) -> Sequence[Window]:
        return [IntegralConstraint(G=self.G, upper=[self.level - self.least], stop=self.stop, name=called)]


def derived(entry: Store, called: str) -> Rows:
    """The same in the checker, which takes nothing of it from the class."""
    most = float(entry.level) - float(entry.least)
    return [IntegralConstraint(None, np.asarray(entry.G), [-np.inf], [most], 0.0, entry.stop, called)]


DERIVED[Store] = derived


@final
class StoreOptions(TermOptions):
    """``level - int_0^stop G u dt >= least``."""

    term = Store

    G: RowsOfNumbers
    """What is taken per time, one number per control."""

    level: float
    """What there is at time 0."""

    least: float = 0.0
    """What must be left."""

    stop: float | None = Field(default=None, alias="to", ge=0.0)
    """When it must be left; at the horizon unless given."""

    name: Annotated[str, Field(min_length=1)] | None = None
    """What messages, tables and figures call it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Stored(OptimalControlProblem):
    """A problem with the field that lists such terms."""

    store: Sequence[Store] = field(default=(), metadata=each(Store))


@final
class StoredProblem(sr.ControlKeys, sr.LinearKeys):
    """The problem ``linear`` with the key of that field."""

    makes = Stored

    store: list[StoreOptions] = Field(default_factory=list)
    """Stores that are enough."""

    def build(self) -> OptimalControlProblem:
        """The problem."""
        return self.problem(self.system.build(self.horizon))


@sr.hookimpl
def sparserob_problems() -> Iterator[sr.ProblemPlugin]:
    """The problem that knows the term."""
    yield sr.ProblemPlugin(name="stored", factory=StoredProblem, summary="Knows what a store holds.")
