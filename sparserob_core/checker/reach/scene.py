"""What is simulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

from sparserob_core.checker.problem.lasting import Lasting
from sparserob_core.control.sets.sets import ConvexSet

if TYPE_CHECKING:
    from flint import arb_mat


@final
@dataclass(frozen=True, eq=False)
class Scene:
    """The ``grid`` (all breakpoints), the control ``(m, 1)`` on each of its pieces, the centre of ``x(0)`` and the set
    of deviations from it, and the disturbance: its set and the breakpoints between which it is constant, of which some
    components may be ``lasting`` longer."""

    grid: list[float]
    control: list[arb_mat]
    initial_state: list[float]
    disturbance: ConvexSet | None
    changes: list[float]
    initial_set: ConvexSet | None = None
    lasting: Lasting | None = None
