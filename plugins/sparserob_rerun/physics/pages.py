"""Which controls and states are on the first screen, and on which further pages the others are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias, final

import numpy as np

if TYPE_CHECKING:
    import sparserob_core as sr

Kind: TypeAlias = Literal["control", "push", "state"]
CONTROLS, STATES = 2, 4  # on the first screen
PLOTS = 6  # on a further page


@final
@dataclass(frozen=True)
class Page:
    """Plots above one another, each of a control, of what pushes it, or of a state; logged below ``path``."""

    path: str
    plots: tuple[tuple[Kind, int], ...]

    def name(self, names: sr.Names) -> str:
        """What is on it, such as ``u3, x5, x6``."""
        called = {"control": names.control, "state": names.state}
        return ", ".join(called[kind](place) for kind, place in self.plots if kind != "push")


def pages(problem: sr.OptimalControlProblem) -> list[Page]:
    """The first screen with two controls and four states, those with walls first; then whatever is left."""
    controls, walled = problem.system.controls, _walled(problem)
    order = sorted(problem.names.corners.own(problem.system.states), key=lambda state: state not in walled)
    first, rest = sorted(order[:STATES]), sorted(order[STATES:])
    plots = [*_controls(range(min(CONTROLS, controls))), *(("state", state) for state in first)]
    first_page = Page("physics/plots", tuple(plots))
    more = [*_controls(range(CONTROLS, controls)), *(("state", state) for state in rest)]
    parts = [more[start : start + PLOTS] for start in range(0, len(more), PLOTS)]
    return [first_page, *(Page(f"physics/more/{number}", tuple(part)) for number, part in enumerate(parts))]


def heading(problem: sr.OptimalControlProblem, searches: bool = False) -> str:
    """What the first screen shows, of a search that of the best tuple, and where the rest is."""
    more = pages(problem)[1:]
    rest = ", ".join(page.name(problem.names) for page in more)
    what = "The best tuple so far: control and states" if searches else "Control and states"
    return f"{what} against the time of the system" + (f"; {rest} in the tab Further signals" if more else "")


def _controls(which: Sequence[int]) -> list[tuple[Kind, int]]:
    return [(kind, channel) for channel in which for kind in ("control", "push")]


def _walled(problem: sr.OptimalControlProblem) -> set[int]:
    """The states that a path constraint bounds."""
    axes, found = np.eye(problem.system.states), set[int]()
    for entry in problem.path:
        bounds = getattr(entry, "set", None)
        if bounds is not None and bounds.dimension == problem.system.states:
            reach = np.minimum(bounds.support(axes), bounds.support(-axes))
            found |= {int(state) for state in np.flatnonzero(np.isfinite(reach))}
    return found
