"""Portfolio: a few maximisers try, and the one that comes farthest goes on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

import sparserob_core as sr


class Portfolio(sr.Maximiser, sr.Options):
    """Portfolio of maximisers, each with a part of the budget; then the one that has found the best value, with the
    rest.

    Nobody knows beforehand which search suits a function: trees find narrow hills in few coordinates, walks that move
    one coordinate at a time cross a separable landscape, evolution strategies follow ridges. Each member tries on its
    own, from the same start, and sees nothing of the others. The winner is begun anew from the best point of all;
    values that it asks for again are remembered, so that a deterministic one goes on where it was. It proves no upper
    bound.

    Notes ``member``, the number of the one that searches, from 1.
    """

    members: Sequence[str | Mapping[str, Any]] | None = Field(default=None, min_length=1)
    """Names of maximisers, or mappings with their options, those of the config's ``plugins`` too; ``null``:
    ``sequool``, ``simulated_annealing``, and ``cma`` where its package is installed."""

    trial: float = Field(default=0.5, gt=0.0, lt=1.0)
    """Share of the budget that they try with, in equal parts."""

    _resolved: list[sr.Maximiser | sr.UnknownPluginError] = PrivateAttr(default_factory=list)

    @property
    def whole(self) -> bool:  # type: ignore[override]
        """True where every member makes sense of whole numbers."""
        return all(member.whole for member in self._resolved if not isinstance(member, sr.UnknownPluginError))

    def search(self, objective: sr.Objective, rng: np.random.Generator) -> float:
        """Search until the budget is spent and return ``inf``, as no upper bound is proven; see
        `sparserob_core.Maximiser`."""
        members = self._built()
        evaluated = objective.known()
        trial_budget = int(self.trial * objective.remaining / len(members))
        trials = list[sr.SearchPart]()
        for number, member in enumerate(members, 1):
            if trial_budget:
                objective.note(member=float(number))
                trials.append(sr.SearchPart(objective, trial_budget, *evaluated))
                trials[-1].run(member, rng)
        winner = int(np.argmax([trial.best_value for trial in trials])) if trials else 0
        objective.note(member=winner + 1.0)
        evaluated = _joined(evaluated, *(batch for trial in trials for batch in trial.found))
        idle_count = 0  # members that found nothing left to gain, one after the other
        while objective.remaining and idle_count < len(members):
            remainder = sr.SearchPart(objective, objective.remaining, *evaluated)
            remainder.run(members[(winner + idle_count) % len(members)], rng)
            evaluated = _joined(evaluated, *remainder.found)
            idle_count = 0 if remainder.found else idle_count + 1
        return float("inf")

    @model_validator(mode="after")
    def _resolve(self, info: ValidationInfo) -> Portfolio:
        """Build the members from the components among which this one was chosen. One that is unknown there stands for
        its error until it is to search: whoever reads another's directory knows only his own components."""
        registry: Any = (info.context or {}).get("registry") or sr.load_registry()
        self._resolved = [_member(registry, entry) for entry in (_usual() if self.members is None else self.members)]
        return self

    def _built(self) -> list[sr.Maximiser]:
        members = list[sr.Maximiser]()
        for member in self._resolved:
            if isinstance(member, sr.UnknownPluginError):
                raise member
            members.append(member)
        return members


def _usual() -> Sequence[str]:
    return ("sequool", "simulated_annealing", *(["cma"] if find_spec("cma") else []))


def _member(registry: Any, entry: str | Mapping[str, Any]) -> sr.Maximiser | sr.UnknownPluginError:
    name = entry if isinstance(entry, str) else entry.get("name")
    if not isinstance(name, str):
        raise sr.InputError(f"members: expected the name of a maximiser in each mapping, got {entry!r}")
    options = {} if isinstance(entry, str) else {key: value for key, value in entry.items() if key != "name"}
    try:
        member: sr.Maximiser = registry.build("maximiser", name, options)
    except sr.UnknownPluginError as error:
        return error
    return member


def _joined(*batches: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    points, values = zip(*batches, strict=True)
    return np.concatenate(points), np.concatenate(values)


@sr.hookimpl
def sparserob_maximisers() -> Iterator[sr.MaximiserPlugin]:
    """Offer ``portfolio``."""
    yield sr.MaximiserPlugin(
        name="portfolio", factory=Portfolio, summary="a few maximisers try, and the one that comes farthest goes on"
    )
