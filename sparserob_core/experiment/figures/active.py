"""The constraints that carry a multiplier, as figures mark them: when each holds with equality, and of which states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from sparserob_core.control.transcription.record import Transcription
    from sparserob_core.sip.evidence import Cut

NOTHING = 1e-9  # of the largest multiplier: the rounding of a solver


@final
@dataclass(frozen=True, eq=False)
class Active:
    """The ``times (k,)`` of constraints, each once and in order, and which ``states (k, d)`` those of a time bound:
    none where they are about the control, and ``None`` where that is not known."""

    times: Array = field(default_factory=lambda: np.empty(0))
    states: np.ndarray | None = None

    def on(self, component: int) -> Array:
        """When a constraint on a state is active."""
        return self.times if self.states is None else self.times[self.states[:, component]]


def active_of(model: Transcription, cuts: Sequence[Cut]) -> Active:
    """Where imposed constraints that carry a multiplier are active; of a policy those on the state."""
    return marks_of(model, [cut for cut in cuts if cut.multiplier > 0.0 and _told(model, cut.family)])


def stored_active(model: Transcription, solution: Mapping[str, Array]) -> Active:
    """The same from ``solution.npz``; none where it has no multipliers."""
    if not {"times", "multipliers", "families", "rows"} <= set(solution):
        return marks_of(model, ())
    multipliers = solution["multipliers"]
    kept = multipliers > NOTHING * multipliers.max(initial=0.0)
    found = zip(*(solution[name][kept].tolist() for name in ("families", "times", "rows")), strict=True)
    return _marks(model, [one for one in found if _told(model, one[0])])


def marks_of(model: Transcription, cuts: Sequence[Cut]) -> Active:
    """Where constraints are active."""
    return _marks(model, [(cut.family, float(cut.index[0]), cut.row) for cut in cuts])


def _marks(model: Transcription, found: Sequence[tuple[str, float, int]]) -> Active:
    """Those of families, times and rows."""
    times, which = np.unique(np.array([time for _, time, _ in found], dtype=float), return_inverse=True)
    states = np.zeros((times.size, model.problem.system.states), dtype=bool)
    constraints = {one.name: one for one in model.constraints}
    rows = {(family, row) for family, _, row in found if family in constraints}  # far fewer than constraints
    reached = {one: constraints[one[0]].states_of(one[1])[: states.shape[1]] for one in rows}
    for place, (family, _, row) in zip(which.tolist(), found, strict=True):
        if (family, row) in reached:
            states[place] |= reached[family, row]
    return Active(times, states)


def _told(model: Transcription, family: str) -> bool:
    """Whether the first coordinate of a family's indices is a time: under feedback those of states."""
    return model.feedback is None or family in {one.name for one in model.constraints}
