"""The state constraints of a problem, one object per family: for the program, and for whoever follows single
trajectories."""

from __future__ import annotations

from typing import TypeAlias

from sparserob_core.control.constraints.curved import CurvedConstraint
from sparserob_core.control.constraints.flat import FlatConstraint
from sparserob_core.control.problem.problem import PathConstraint
from sparserob_core.control.sets.sets import Equality
from sparserob_core.control.transcription.record import Transcription

StateConstraint: TypeAlias = FlatConstraint | CurvedConstraint


def state_constraints(model: Transcription) -> tuple[StateConstraint, ...]:
    """The path and terminal constraints, named and ordered as the families of the program; equalities are not among
    them."""
    problem, end = model.problem, model.problem.horizon
    path = [entry for entry in problem.path if isinstance(entry, PathConstraint)]
    ends = [terminal for terminal in problem.terminal if not isinstance(terminal, Equality)]
    windows = [(entry.name or _name("path", i, len(path)), entry) for i, entry in enumerate(path)]
    windows += [
        (_name("terminal", i, len(ends)), PathConstraint(terminal, end, end)) for i, terminal in enumerate(ends)
    ]
    found = [_constraint(model, name, entry) for name, entry in windows]
    return tuple(constraint for constraint in found if isinstance(constraint, CurvedConstraint) or constraint.h.size)


def _name(kind: str, position: int, count: int) -> str:
    return f"{kind}[{position}]" if count > 1 else kind


def _constraint(model: Transcription, name: str, entry: PathConstraint) -> StateConstraint:
    stop = model.problem.horizon if entry.stop is None else entry.stop
    flat = entry.set.halfspaces()
    if flat is None:
        return CurvedConstraint(name, model.functionals, entry.set, entry.start, stop, model.parameters)
    return FlatConstraint(name, model.functionals, *flat, entry.start, stop, model.parameters)
