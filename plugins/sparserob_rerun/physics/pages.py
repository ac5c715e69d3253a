"""Choice of the controls and states on the first screen and on further pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias, final

import numpy as np

if TYPE_CHECKING:
    import sparserob_core as sr

Kind: TypeAlias = Literal["control", "switching", "state"]
CONTROLS, STATES = 2, 4  # on the first screen
PLOTS = 6  # on a further page


@final
@dataclass(frozen=True)
class Page:
    """Page of plots above one another, each of a control, of its switching function, or of a state; logged below
    ``path``."""

    path: str
    plots: tuple[tuple[Kind, int], ...]

    def name(self, names: sr.Names) -> str:
        """Return the names of the signals on the page, such as ``u3, x5, x6``."""
        name_of = {"control": names.control, "state": names.state}
        return ", ".join(name_of[kind](index) for kind, index in self.plots if kind != "switching")


def pages(problem: sr.OptimalControlProblem) -> list[Page]:
    """Return the first screen with two controls and four states, those with walls first; then pages of the others."""
    controls, walled = problem.system.controls, _walled(problem)
    order = sorted(problem.names.corners.own(problem.system.states), key=lambda state: state not in walled)
    first_states, further_states = sorted(order[:STATES]), sorted(order[STATES:])
    plots = [*_controls(range(min(CONTROLS, controls))), *(("state", state) for state in first_states)]
    first_page = Page("physics/plots", tuple(plots))
    further_plots = [*_controls(range(CONTROLS, controls)), *(("state", state) for state in further_states)]
    groups = [further_plots[start : start + PLOTS] for start in range(0, len(further_plots), PLOTS)]
    return [first_page, *(Page(f"physics/more/{number}", tuple(group)) for number, group in enumerate(groups))]


def heading(problem: sr.OptimalControlProblem, searches: bool = False) -> str:
    """Say what the first screen shows, in a search the best tuple, and where the other signals are."""
    further_pages = pages(problem)[1:]
    names = ", ".join(page.name(problem.names) for page in further_pages)
    subject = "Best tuple so far: control and states" if searches else "Control and states"
    return f"{subject} over time" + (f"; {names} in the tab Further signals" if further_pages else "")


def _controls(which: Sequence[int]) -> list[tuple[Kind, int]]:
    return [(kind, channel) for channel in which for kind in ("control", "switching")]


def _walled(problem: sr.OptimalControlProblem) -> set[int]:
    """Return the states that a path constraint bounds."""
    axes, walled = np.eye(problem.system.states), set[int]()
    for entry in problem.path:
        bounds = getattr(entry, "set", None)
        if bounds is not None and bounds.dimension == problem.system.states:
            reach = np.minimum(bounds.support(axes), bounds.support(-axes))
            walled |= {int(state) for state in np.flatnonzero(np.isfinite(reach))}
    return walled
