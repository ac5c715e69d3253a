"""The key `problem` of a config for a problem that was written in Python: data, never code.

A part that no config can describe is an error with the key at which it would stand; nothing is left out silently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, cast

import numpy as np

from sparserob_core.control.problem.cost import Cost
from sparserob_core.control.problem.names import Names
from sparserob_core.control.problem.phase import PARTS, Phase
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.control.problem.terms.repeat import widths
from sparserob_core.control.problem.terms.windows import MixedConstraint, UntilHorizon
from sparserob_core.control.problem.tracing import trace_entries
from sparserob_core.control.sets.budget import BudgetedBox
from sparserob_core.control.sets.sets import Box, Equality, Product, SetFactory
from sparserob_core.control.term import Term
from sparserob_core.errors import InputError
from sparserob_core.experiment.config.matrices.packed import pack
from sparserob_core.experiment.plugins.hookspecs import SetPlugin
from sparserob_core.experiment.plugins.registry import load_registry
from sparserob_core.sip.convex_set import Array, ConvexSet
from sparserob_core.sip.expressions.expression import ExpressionMatrix

WRITTEN = {
    "system", "horizon", "initial_state", "control", "initial_set", "weights", "disturbance", "disturbance_class",
    "terminal", "title", "initial_control", "control_step", "names", "cost", "disturbances",
    "measurements", "repeat", "execution", "jitter", "disturbance_breakpoints",
    "commanded",
}  # fmt: skip
"""The fields of a problem that are written in addition to lists of constraints; any other field is an error."""
CALLED = {"start": "from", "stop": "to"}
"""Fields of a term that have another name in a config."""
# Entries above which a matrix is packed: nobody reads more, and ten times more fill a config
MAX_WRITTEN_ENTRIES = 2500
WRITTEN_OF_SYSTEM = {"phases", "parameters", "delay"}


def problem_keys(problem: OptimalControlProblem) -> dict[str, Any]:
    """Return the key ``problem`` of a config, as the problem ``linear`` reads it.

    Raises `InputError` that begins with the key where no config can describe the problem.
    """
    unknown = {field.name for field in fields(problem)} - WRITTEN - set(problem.lists)
    if unknown:
        raise InputError(path=sorted(unknown)[0], expected="a field that a config can say", got="another one")
    given_terms = {name: [entry for entry in entries if entry.stated] for name, entries in problem.lists.items()}
    fixed = bool(problem.repeat) and bool((widths(problem.initial_set, problem.system.states) == 0.0).any())
    ends = problem.terminal[: len(problem.terminal) - fixed]  # the key repeat adds its own end again
    keys: dict[str, Any] = {
        "name": "linear",
        "system": _write_system(problem.system),
        "horizon": problem.horizon,
        "initial_state": _write_initial_state(problem),
        "control": set_keys("control", problem.control),
        "weights": np.asarray(problem.weights).tolist(),
        "disturbance_class": _get_class(problem, 0),
        "terminal": [_write_terminal(f"terminal.{i}", entry) for i, entry in enumerate(ends)],
        **{
            name: [_write_term(f"{name}.{i}", term) for i, term in enumerate(terms)]
            for name, terms in given_terms.items()
        },
        **_write_cost(problem.cost),
        **_write_names(problem.names),
    }
    if problem.disturbance is not None:
        keys["disturbance"] = _write_disturbance(problem, keys["system"])
    if problem.control_step is not None:
        keys["control_step"] = set_keys("control_step", problem.control_step)
    if problem.measurements is not None:
        keys["measurements"] = _write_term("measurements", problem.measurements)
    if problem.initial_control is not None and (problem.control_step is not None or problem.system.delay > 0.0):
        keys["initial_control"] = np.asarray(problem.initial_control).tolist()
    if problem.repeat:
        keys["repeat"] = True
    if problem.execution is not None:
        keys["execution"] = np.asarray(problem.execution).tolist()
    if problem.jitter:
        keys["jitter"] = problem.jitter
    return keys


def _write_disturbance(problem: OptimalControlProblem, system: dict[str, Any]) -> Any:
    """Return the key of the disturbance: its set, or a list where no kind of set is such a product of others.

    A list takes the columns of ``E`` out of the keys of the ``system``.
    """
    bound = problem.disturbance
    if isinstance(bound, BudgetedBox):
        keys = set_keys("disturbance", Box(bound.lower, bound.upper))
        return {**keys, "budget": {"p": bound.p, "size": float(bound.size)}}
    if not isinstance(bound, Product):
        assert bound is not None
        return set_keys("disturbance", bound)
    if "E" not in system:
        raise InputError(
            path="disturbance",
            expected="sets with flat sides and of one class, or one system for all of the horizon",
            got=bound.kind,
        )
    entries, begin, rows = [], 0, system.pop("E")
    for i, factor in enumerate(bound.parts):
        columns = [row[begin : begin + factor.dimension] for row in rows]
        begin += factor.dimension
        keys = {"set": set_keys(f"disturbance.{i}.set", factor), "E": columns, "class": _get_class(problem, i)}
        own = None if problem.disturbance_breakpoints is None else problem.disturbance_breakpoints[i]
        entries.append(keys if own is None else {**keys, "breakpoints": own.tolist()})
    return entries


def _get_class(problem: OptimalControlProblem, part: int) -> str:
    """Return the class of a part of the disturbance."""
    kinds = problem.disturbance_class
    return kinds if isinstance(kinds, str) else kinds[part]


def set_keys(where: str, convex: ConvexSet) -> dict[str, Any]:
    """Return a set as a config writes it: the key of its kind, with the options from which it is built.

    Raises `InputError` where no registered kind has such sets; ``where`` is the key in the message.
    """
    registry = load_registry()
    for kind in registry.names(SetPlugin.kind):
        factory = registry.get(SetPlugin.kind, kind).options_type()
        options = factory.options_of(convex) if issubclass(factory, SetFactory) else None
        if options is not None:
            return {kind: dict(options)}
    kinds = ", ".join(registry.names(SetPlugin.kind))
    raise InputError(path=where, expected=f"a set that a config can name ({kinds})", got=type(convex).__name__)


def _write_system(system: System) -> dict[str, Any]:
    unknown = {field.name for field in fields(system)} - WRITTEN_OF_SYSTEM
    if unknown or system.stated is not system:
        raise InputError(path="system", expected="a system in the units of the user", got="another")
    phases = system.phases
    shared: dict[str, Any] = {**({"delay": system.delay} if system.delay else {}), **_write_definitions(phases)}
    if system.parameters is not None:
        shared["parameters"] = _write_parameters(system.parameters, system.names)
    if len(phases) == 1 and (system.varies or system.horizon == np.inf):
        return {**_write_matrices(phases[0]), **shared}
    return {"pieces": [{"until": phase.until, **_write_matrices(phase)} for phase in phases], **shared}


def _write_matrices(phase: Phase) -> dict[str, Any]:
    keys: dict[str, Any] = {name: _write_rows(phase, name) for name in ("A", "B", "E")}
    if phase.c is not None:
        keys["c"] = [row[0] for row in _write_rows(phase, "c")]
    return keys


def _write_definitions(phases: Sequence[Phase]) -> dict[str, Any]:
    """Return the definitions that the entries of phases use; all phases share them."""
    entries = [getattr(phase, name) for phase in phases for name in PARTS]
    defined = next((entry.defined for entry in entries if isinstance(entry, ExpressionMatrix) and entry.defined), ())
    return {"define": {name: expression.text for name, expression in defined}} if defined else {}


def _write_rows(phase: Phase, name: str) -> Any:
    """Return the rows of numbers and expressions of a matrix; a large matrix is packed into one text."""
    value = getattr(phase, name)
    if isinstance(value, ExpressionMatrix):
        return [[entry.text for entry in row] for row in value.entries]
    if callable(value):
        return trace_entries(name, value, phase.names, phase.probes)
    matrix: Array = np.asarray(value, dtype=float)
    return pack(matrix) if matrix.size > MAX_WRITTEN_ENTRIES else matrix.tolist()


def _write_parameters(parameters: ConvexSet, names: Sequence[str]) -> dict[str, Any]:
    if isinstance(parameters, Box):
        bounds = zip(parameters.lower.tolist(), parameters.upper.tolist(), strict=True)
        return {name: list(interval) for name, interval in zip(names, bounds, strict=True)}
    return {"names": list(names), **set_keys("system.parameters", parameters)}


def _write_initial_state(problem: OptimalControlProblem) -> Any:
    centre = np.asarray(problem.initial_state).tolist()
    if problem.initial_set is None:
        return centre
    deviations = set_keys("initial_state", problem.initial_set)
    if any("centre" in options for options in deviations.values()):
        raise InputError(
            path="initial_state",
            expected="deviations that are centred at 0, since a config has one centre, that of the initial states",
            got="a set with a centre of its own",
        )
    return {"centre": centre, **deviations}


def _write_term(where: str, term: Term) -> dict[str, Any]:
    """Return a key for every field of a term that has a value, and for a set the key of its kind.

    An infinite bound is null, and an end that follows the horizon is not written.
    """
    values = {
        field.name: value for field in fields(cast("Any", term)) if (value := getattr(term, field.name)) is not None
    }
    keys: dict[str, Any] = {}
    if isinstance(term, MixedConstraint):
        kept = np.isfinite(np.asarray(term.h))
        keys["mixed"] = {name: _write_numbers(values.pop(name)[kept]) for name in ("H", "G", "h")}
    for name, value in values.items():
        if isinstance(value, UntilHorizon):
            continue
        if not isinstance(value, ConvexSet):
            keys[CALLED.get(name, name)] = value if isinstance(value, str) else _write_numbers(value)
        elif name == "set":
            keys |= set_keys(where, value)
        else:
            keys[name] = set_keys(f"{where}.{name}", value)
    return keys


def _write_numbers(value: Any) -> Any:
    """Return numbers as nested lists, with null where they are not finite."""
    numbers = np.asarray(value, dtype=float)
    entries = numbers.astype(object)
    entries[~np.isfinite(numbers)] = None
    return entries.tolist()


def _write_terminal(where: str, entry: ConvexSet | Equality) -> dict[str, Any]:
    if isinstance(entry, Equality):
        return {"equals": _write_numbers(entry.values)}
    return set_keys(where, entry)


def _write_cost(cost: Cost) -> dict[str, Any]:
    keys: dict[str, Any] = {} if cost.l1 == 1.0 else {"l1": cost.l1}
    if cost.group:
        keys["group"] = [list(group) for group in cost.group]
    for key, term in zip(("state", "control", "final"), cost.terms, strict=True):
        if term is not None:
            keys[key] = {"R": np.asarray(term.Q).tolist()} if key == "control" else _write_term(key, term)
    return {"cost": keys} if keys else {}


def _write_names(names: Names) -> dict[str, Any]:
    keys: dict[str, Any] = {kind: list(getattr(names, kind)) for kind in ("states", "controls", "disturbances")}
    units = {kind: list(getattr(names, f"{kind[:-1]}_units")) for kind in keys}
    unit_names = {**units, "time": names.time}
    entries = {key: value for key, value in {**keys, "plane": list(names.plane)}.items() if value}
    unit_keys = {key: value for key, value in unit_names.items() if value}
    return {"names": {**entries, **({"units": unit_keys} if unit_keys else {})}} if entries or unit_keys else {}
