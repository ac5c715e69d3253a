"""The keys of a config for the components with which a problem is solved, and the complete config."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path as File
from typing import Any

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.reading.reader import ConfigSource
from sparserob_core.experiment.config.writing.problem import problem_keys
from sparserob_core.experiment.plugins.components import Registry
from sparserob_core.experiment.plugins.guards import unguarded
from sparserob_core.options import Options

NAME = "problem"  # its name in messages and in the folder of its runs, for a title may hold any character


def source_of(problem: OptimalControlProblem, other_keys: Mapping[str, Any] | None = None) -> ConfigSource:
    """Return the config of a problem together with ``other_keys``.

    Raises `InputError` that begins with the key where no config can describe the problem.
    """
    title = {"title": problem.title} if problem.title else {}
    try:
        problem_section = problem_keys(problem)
    except InputError as error:
        raise error.under("problem") from None
    return ConfigSource(NAME, File.cwd(), {**title, "problem": problem_section, **(other_keys or {})})


def component_keys(registry: Registry, kind: str, choice: object) -> dict[str, Any]:
    """Return the entry of a config for a component.

    ``choice`` is its name, a mapping, or an object, whose entry is that of the record with its class. Raises
    `InputError` where no record has that class.
    """
    choice = unguarded(choice)
    if isinstance(choice, str):
        return {"name": choice}
    if isinstance(choice, Mapping):
        return dict(choice)
    if isinstance(choice, Options):
        for name in registry.names(kind):
            record = registry.get(kind, name)
            if not record.missing and record.options_type() is type(choice):
                return {"name": name, **choice.model_dump(mode="json", by_alias=True)}
    raise InputError(path=kind, expected="a component that is registered under a name", got=type(choice).__name__)


def dictionary_keys(registry: Registry, which: str, choice: object) -> dict[str, Any]:
    """Return the entry of a config for a dictionary.

    A dictionary object must consist of indicators, on pieces of any length; raises `InputError` for another one.
    """
    if not isinstance(choice, Dictionary):
        return component_keys(registry, "dictionary", choice)
    pieces = choice.pieces
    owner = np.arange(pieces) * choice.functions // pieces
    plain = Dictionary.indicators(choice.breakpoints, owner)
    if (choice.sparse != plain.sparse).nnz:
        raise InputError(
            path=f"dictionaries.{which}",
            expected="indicators of its pieces, or a dictionary by name, so that a config can say which",
            got=f"{choice.functions} functions on {pieces} pieces",
        )
    is_uniform = np.array_equal(choice.breakpoints, np.linspace(0.0, choice.horizon, pieces + 1))
    grid = {"pieces": pieces} if is_uniform else {"breakpoints": choice.breakpoints.tolist()}
    return {"name": "piecewise_constant", **grid, **({} if choice.is_indicators else {"functions": choice.functions})}
