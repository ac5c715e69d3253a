"""The keys of a config and their defaults; those of a component are in its options."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, final

from pydantic import ConfigDict, Field

from sparserob_core.options import Exact, Options
from sparserob_core.sip.method import Continuation


class Entry(Exact):
    """A component by ``name``; the other keys are its options. A bare name stands for a component with its default
    options."""

    model_config = ConfigDict(extra="allow", frozen=True, defer_build=True)

    name: str
    """Name of the component; ``sparserob plugins`` lists them."""

    @property
    def options(self) -> dict[str, Any]:
        """The component's options as they stand in the config."""
        return dict(self.model_extra or {})


@final
@dataclass(frozen=True)
class Slot:
    """The mark of a key of the config that names one component of a ``kind``.

    ``name`` is the component that is used where only options are given.
    """

    kind: str
    name: str | None = None


@final
class MaximiserEntry(Entry):
    """A maximiser with its budget, which belongs to the framework."""

    budget: int = Field(default=2000, ge=1)
    """Evaluations that one search may spend."""

    polish: float | None = Field(default=None, ge=0.0, lt=1.0)
    """Share of the budget that a local method spends at the end, from the best points; null: the maximiser's own share,
    as a rule a fifth, where ``g`` has a gradient or tuples are literal, and nothing elsewhere."""


PIECES = Slot("dictionary", "piecewise_constant")


@final
class Dictionaries(Options):
    """Functions of time of which control and disturbance are combinations."""

    control: Annotated[Entry, PIECES] = Entry.model_validate({"name": "piecewise_constant", "pieces": 100})
    """Dictionary of the control; 100 equal pieces by default."""

    disturbance: Annotated[Entry | None, PIECES] = None
    """Dictionary of the disturbance; null: one indicator function on each piece of the control's dictionary."""


@final
class Limits(Options):
    """Limits of the time of a run."""

    seconds: float | None = Field(default=None, gt=0.0)
    """Seconds after which a run, a margin or a set of initial states ends with the results so far; null: no limit."""


@final
class RunConfig(Options):
    """A complete experiment; every key but ``problem`` has a default."""

    title: str = ""
    """Title of the figures and tables; the file's name when empty."""

    problem: Annotated[Entry, Slot("problem")]
    """The problem that is solved."""

    policy: Annotated[Entry, Slot("policy", "open_loop")] = Entry(name="open_loop")
    """The policy: the measurements that the control may use while the system runs."""

    dictionaries: Dictionaries = Dictionaries()
    """Functions of time of which control and disturbance are combinations."""

    regulariser: Annotated[Entry | None, Slot("regulariser", "ridge")] = Entry(name="ridge")
    """The strictly convex term that makes the optimiser unique; null for none. A problem that states all of its
    objective, such as ``program``, has none unless it is given here."""

    continuation: Continuation = Continuation()
    """Decrease of the regulariser's weight."""

    method: Annotated[Entry, Slot("method", "exchange")] = Entry(name="exchange")
    """The method that solves the semi-infinite program."""

    maximiser: Annotated[MaximiserEntry, Slot("maximiser", "direct")] = MaximiserEntry(name="direct")
    """The global search, used where a family of constraints has no closed form."""

    solver: Annotated[Entry, Slot("solver", "auto")] = Entry(name="auto")
    """The solver of the finite programs: the quickest for each (auto), or one that is named and asked for all."""

    executor: Annotated[Entry, Slot("executor", "serial")] = Entry(name="serial")
    """Place where independent programs are solved."""

    observers: tuple[Entry, ...] = (Entry(name="progress"),)
    """Observers, which receive the events of the run."""

    limits: Limits = Limits()
    """Limits of the time of a run."""

    seed: int = Field(default=0, ge=0)
    """Seed of every random number."""

    plugins: tuple[str, ...] = ()
    """Python files that are loaded as plugins; relative to the config, or to the working directory when given on the
    command line."""

    def plain(self) -> dict[str, Any]:
        """Return the config as mappings, lists, numbers and text."""
        plain: dict[str, Any] = self.model_dump(mode="json", by_alias=True)
        return plain

    def digest(self) -> str:
        """Return eight hexadecimal digits that change when the config changes."""
        return digest(self.plain())


def digest(plain: object) -> str:
    """Return the digest of a resolved config, from its mappings, lists, numbers and text."""
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:8]


def _list_slots(model: type[Options], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Slot]]:
    for name, field in model.model_fields.items():
        yield from (((*above, name), mark) for mark in field.metadata if isinstance(mark, Slot))
        if field.annotation is Dictionaries:
            yield from _list_slots(Dictionaries, (*above, name))


SLOTS: Mapping[tuple[str, ...], Slot] = dict(_list_slots(RunConfig))
"""The keys at which a config names one component; the key ``observers``, a list, is not among them."""
