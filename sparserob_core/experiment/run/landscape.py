"""The slice of g that the figure of a search shows: which coordinates, and how long its values may take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import final

import numpy as np

from sparserob_core.errors import InputError
from sparserob_core.experiment.figures.landscape_figure import LandscapeData
from sparserob_core.experiment.run.events import StudyProgress
from sparserob_core.experiment.run.inspection import Inspection, RelaxedValue
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.events import Notify, ignore
from sparserob_core.sip.result import SearchTrace

SECONDS = 4.0
"""What the values of a slice may take, after those of the coarsest grid."""
GRIDS = (9, 17, 33, 65)
"""Points along each coordinate; each grid holds the one before."""
PROBES, CANDIDATES = 7, 12

NEAR = 0.05
"""Indices that are nearer to one another, in widths of the box, stand for one constraint and move together."""


@final
@dataclass(frozen=True)
class Place:
    """One axis of a slice: the coordinate ``c`` of the indices ``slots``, which move together, the first as the axis
    says."""

    slots: tuple[int, ...]
    c: int

    def at(self, anchor: Array) -> float:
        """Where the tuple ``(D, width)`` has it."""
        return float(anchor[self.slots[0], self.c])

    def moved(self, slots: Array, anchor: Array, g: RelaxedValue, to: float) -> None:
        """Move it in ``slots``, which is changed; the others of its indices keep their distance, within the box."""
        mine = list(self.slots)
        shifted = anchor[mine, self.c] + (to - self.at(anchor))
        slots[mine, self.c] = np.clip(shifted, g.slot.lower[self.c], g.slot.upper[self.c])
        slots[mine[0], self.c] = to

    def name(self, g: RelaxedValue, count: int) -> str:
        """In words: ``t of index 2``, ``t of indices 2, 5``; ``t`` where a tuple has a single index."""
        if count == 1:
            return g.names[self.c]
        numbers = [str(slot + 1) for slot in sorted(self.slots)]
        listed = ", ".join(numbers[:4]) + (", ..." if len(numbers) > 4 else "")
        return f"{g.names[self.c]} of {'index' if len(numbers) == 1 else 'indices'} {listed}"


def landscape_of(
    inspection: Inspection, trace: SearchTrace, title: str, notify: Notify = ignore
) -> LandscapeData | None:
    """The slice through the best tuple of the last epsilon, over the two coordinates that change g most there, or over
    the only one that can move; ``None`` where no tuple with a finite value was kept, or nothing can move.

    It ends with the finest of `GRIDS` that is complete after `SECONDS`; ``notify`` receives `StudyProgress`.
    """
    mine = np.flatnonzero(trace.epsilon == trace.epsilon[-1]) if trace.epsilon.size else np.empty(0, dtype=int)
    mine = mine[np.isfinite(trace.value[mine])]
    if not mine.size or not trace.points.size:
        return None
    epsilon, top = float(trace.epsilon[-1]), int(mine[np.argmax(trace.value[mine])])
    slot = inspection.relaxed_value(1, epsilon).slot
    width, rest = slot.dimension, trace.points.shape[1] % slot.dimension
    if rest or not np.isfinite(trace.points).all():
        raise InputError(
            f"evaluations: points: expected finite tuples of indices of {width} coordinates each, as the config says, "
            f"got points of {trace.points.shape[1]}" + ("" if rest else ", not all finite")
        )
    g = inspection.relaxed_value(trace.points.shape[1] // width, epsilon)
    anchor = trace.points[top].reshape(-1, width)
    value = g.at(anchor)
    places = chosen(g, anchor)
    if not places:
        return None
    axes, values = _filled(g, anchor, places, notify)
    columns = [place.slots[0] * width + place.c for place in places]
    accepted = trace.notes.get("accepted", np.full(trace.value.size, np.nan))[mine]
    return LandscapeData(
        title=title,
        epsilon=epsilon,
        axes=axes,
        names=[place.name(g, len(anchor)) for place in places],
        values=values,
        best=trace.points[top, columns],
        best_value=value,
        visited=trace.points[mine][:, columns],
        visited_values=trace.value[mine],
        accepted=accepted,
    )


def chosen(g: RelaxedValue, anchor: Array) -> list[Place]:
    """The coordinates of a tuple ``(D, width)``, two at most, along which g changes most when each alone goes through
    its range; of the indices with the largest multipliers, those beside one another together, disturbances left out
    where there is anything else; ``[]`` where nothing can move. g must have been evaluated at the tuple."""
    moves = [c for c in range(g.slot.dimension) if g.slot.upper[c] > g.slot.lower[c]]
    plain = [c for c in moves if g.kinds[c] != "disturbance"] or moves
    candidates = [Place(slots, c) for slots in _neighbours(g, anchor, plain) for c in plain][:CANDIDATES]
    spread = {place: _spread(g, anchor, place) for place in candidates}
    return sorted(candidates, key=lambda place: -spread[place])[:2]


def _neighbours(g: RelaxedValue, anchor: Array, plain: list[int]) -> list[tuple[int, ...]]:
    """The indices of a tuple in groups that are near one another, those with the largest multipliers first."""
    weights = g.weights()
    order = [int(slot) for slot in np.argsort(-weights, kind="stable")]
    scaled = anchor[:, plain] / (g.slot.upper - g.slot.lower)[plain]
    groups: list[list[int]] = []
    for slot in order:
        near = next((group for group in groups if np.abs(scaled[group[0]] - scaled[slot]).max() < NEAR), None)
        groups.append([slot]) if near is None else near.append(slot)
    return [tuple(group) for group in sorted(groups, key=lambda group: -weights[group].sum())]


def _spread(g: RelaxedValue, anchor: Array, place: Place) -> float:
    """By how much g changes along a coordinate; infinite where some of it is infeasible."""
    slots, values = anchor.copy(), [g.at(anchor)]
    for one in np.linspace(g.slot.lower[place.c], g.slot.upper[place.c], PROBES):
        place.moved(slots, anchor, g, float(one))
        values.append(g.at(slots))
    known = [value for value in values if not np.isnan(value)]
    return max(known) - min(known) if np.isfinite(min(known, default=np.inf)) else 0.0


def _filled(g: RelaxedValue, anchor: Array, places: list[Place], notify: Notify) -> tuple[list[Array], Array]:
    """The finest grid that was complete in time, with its values; the tuple itself is a point of every grid."""
    finest = [np.linspace(g.slot.lower[place.c], g.slot.upper[place.c], GRIDS[-1]) for place in places]
    key, known = _key(anchor, places), dict[tuple[float, ...], float]()
    slots, began = anchor.copy(), time.monotonic()
    found: tuple[list[Array], Array] | None = None
    for points in GRIDS:
        stride = (GRIDS[-1] - 1) // (points - 1)
        axes = [np.union1d(axis[::stride], place.at(anchor)) for axis, place in zip(finest, places, strict=True)]
        for count, at in enumerate(_along(axes)):
            if found is not None and time.monotonic() - began > SECONDS:
                return found
            if key(at) not in known:
                for place, value in zip(places, at, strict=True):
                    place.moved(slots, anchor, g, value)
                found_here = g.at(slots)
                known[key(at)] = -np.inf if np.isnan(found_here) else found_here
            if count % axes[0].size == 0:
                notify(StudyProgress(text=f"figures: the landscape of g on {' x '.join(str(a.size) for a in axes)}"))
        values = [known[key(at)] for at in product(*axes)]
        found = axes, np.array(values).reshape([axis.size for axis in axes])
    assert found is not None
    return found


def _key(anchor: Array, places: list[Place]) -> Callable[[tuple[float, ...]], tuple[float, ...]]:
    """By what a value is known: g is the same when two indices change places."""
    if len(places) == 2 and places[0].c == places[1].c and all(len(place.slots) == 1 for place in places):
        one, other = (np.delete(anchor[place.slots[0]], place.c) for place in places)
        if np.array_equal(one, other):
            return lambda at: tuple(sorted(at))
    return lambda at: at


def _along(axes: list[Array]) -> Iterator[tuple[float, ...]]:
    """The points of a grid, each a neighbour of the one before, whose optimum is a good start."""
    if len(axes) == 1:
        yield from ((float(one),) for one in axes[0])
        return
    for turn, up in enumerate(axes[1]):
        yield from ((float(across), float(up)) for across in (axes[0] if turn % 2 == 0 else axes[0][::-1]))
