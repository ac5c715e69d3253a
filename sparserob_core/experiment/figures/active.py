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

NEGLIGIBLE_MULTIPLIER = 1e-9  # of the largest multiplier: the rounding of a solver


@final
@dataclass(frozen=True, eq=False)
class Active:
    """The ``times (k,)`` of constraints, each once and in order, and which ``states (k, d)`` those of a time bound:
    none where they are about the control, and ``None`` where that is not known."""

    times: Array = field(default_factory=lambda: np.empty(0))
    states: np.ndarray | None = None

    def on(self, component: int) -> Array:
        """Return the times at which a constraint on a state component is active; all times where the states are not
        known."""
        return self.times if self.states is None else self.times[self.states[:, component]]


def active_of(model: Transcription, cuts: Sequence[Cut]) -> Active:
    """Return the times of the imposed constraints that carry a multiplier; of a policy, only of constraints on the
    state."""
    return marks_of(model, [cut for cut in cuts if cut.multiplier > 0.0 and _has_time(model, cut.family)])


def stored_active(model: Transcription, solution: Mapping[str, Array]) -> Active:
    """Return the times of active constraints from the arrays of ``solution.npz``; none where these hold no multipliers.

    Multipliers that are only rounding do not count.
    """
    if not {"times", "multipliers", "families", "rows"} <= set(solution):
        return marks_of(model, ())
    multipliers = solution["multipliers"]
    kept = multipliers > NEGLIGIBLE_MULTIPLIER * multipliers.max(initial=0.0)
    entries = zip(*(solution[name][kept].tolist() for name in ("families", "times", "rows")), strict=True)
    return _collect_active(model, [entry for entry in entries if _has_time(model, entry[0])])


def marks_of(model: Transcription, cuts: Sequence[Cut]) -> Active:
    """Return the times and states of constraints, whatever their multipliers."""
    return _collect_active(model, [(cut.family, float(cut.index[0]), cut.row) for cut in cuts])


def _collect_active(model: Transcription, found: Sequence[tuple[str, float, int]]) -> Active:
    """Return the times and states of constraints that are given as family, time and row."""
    times, time_indices = np.unique(np.array([time for _, time, _ in found], dtype=float), return_inverse=True)
    states = np.zeros((times.size, model.problem.system.states), dtype=bool)
    constraints = {constraint.name: constraint for constraint in model.constraints}
    keys = {(family, row) for family, _, row in found if family in constraints}  # far fewer than constraints
    states_of_key = {key: constraints[key[0]].states_of(key[1])[: states.shape[1]] for key in keys}
    for index, (family, _, row) in zip(time_indices.tolist(), found, strict=True):
        if (family, row) in states_of_key:
            states[index] |= states_of_key[family, row]
    return Active(times, states)


def _has_time(model: Transcription, family: str) -> bool:
    """Return whether the first coordinate of a family's indices is a time; under feedback only for constraints on the
    state."""
    return model.feedback is None or family in {constraint.name for constraint in model.constraints}
