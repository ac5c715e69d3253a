"""The proof of one state constraint from the cells of a certificate."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby, pairwise
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.claims.case import Case, Window, number, numbers
from sparserob_core.checker.claims.cells import Interval, Work, prove
from sparserob_core.checker.claims.subdivision import fill
from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.reach.flow import Flow
from sparserob_core.checker.reach.tube import Tube
from sparserob_core.checker.sets.parameters import Corners, Parameters
from sparserob_core.checker.sets.shapes import facets, support
from sparserob_core.checker.sets.sides import Sides
from sparserob_core.control.sets.sets import Box as BoxSet
from sparserob_core.control.sets.sets import Cylinder
from sparserob_core.sip.convex_set import Array

if TYPE_CHECKING:
    from collections.abc import Callable

DEGREES = {0: 0, 1: 8, 2: 6, 3: 4, 4: 3}  # of the expansion in the parameters, by their number; 2 beyond
TUBES_KEPT = 8
MOST_TOLERANCE = 1e-9
WIDER = 1e-12  # by which the boxes of a parameter set that is none are widened, relative to the whole


def bounded(case: Case, window: Window) -> str:
    """Show that a constraint is kept at every time, disturbance and parameter; a sentence with the figures."""
    data = case.certificate.get("proof", {})
    entry = data.get(window.name) if isinstance(data, Mapping) else None
    if not isinstance(entry, Mapping):
        if case.certificate.get("status") == "undecided":
            raise Unchecked("the certificate does not claim it")
        raise Broken("the certificate holds no proof of it")
    tolerance = number(entry, "tolerance")
    most = kept(case, window)
    if not 0 < tolerance <= most * (1.0 + 1e-12):
        raise Broken(f"a violation of {tolerance:g} is to count as none, at most {most:g} may")
    lower, upper = numbers(entry.get("lower"), "lower"), numbers(entry.get("upper"), "upper")
    if lower.shape == (0, 0):
        raise Unchecked("the certificate holds no cells for a constraint that was not proven on cells")
    _covered(case, window, lower, upper)
    found = prove(
        _tubes(case, lower, upper),
        Parameters(case.problem.system.parameters),
        _work(case, window, lower, upper),
        tolerance,
    )
    size = f"{found.cells} cells" + (f" in {found.boxes} boxes" if found.boxes > 1 else "")
    return (
        f"kept, with a margin of at least {-found.bound:.1e} ({size})"
        if found.bound < 0
        else f"kept to {found.bound:.1e} ({size})"
    )


def kept(case: Case, window: Window) -> float:
    """A violation of at most this counts as none: less where the numbers of the constraint are below a thousandth."""
    start = np.asarray(case.problem.initial_state)
    flat = facets(window.shape)
    if flat is not None:
        size = max((max(abs(float(b.mid())), abs(float(c @ start))) for c, b in flat), default=1.0)
    else:
        base = window.shape.base if isinstance(window.shape, Cylinder) else window.shape
        axes = np.eye(base.dimension)
        size = max(
            float(np.abs(base.support(np.vstack([axes, -axes]))).max()), float(np.abs(start[: base.dimension]).max())
        )
    return MOST_TOLERANCE * min(1.0, 1e3 * (size or 1.0))


def _spanned(window: Window) -> int:
    return window.shape.base.dimension if isinstance(window.shape, Cylinder) else window.shape.dimension


def _covered(case: Case, window: Window, lower: Array, upper: Array) -> None:
    """The cells must fill the times and parameters, and for a curved set every face of the cube of directions too."""
    nu = case.problem.system.parameter_count
    b = 0 if facets(window.shape) is not None else _spanned(window)
    if lower.ndim != 2 or lower.shape != upper.shape or lower.shape[1] != 1 + nu + b:
        raise Broken(f"its cells are no pairs of corners with {1 + nu + b} coordinates")
    low, high = _extent(case, window, lower, upper)
    if not b:
        fill(lower, upper, low, high)
        return
    for axis in range(b):
        for sign in (-1.0, 1.0):
            face = 1 + nu + axis
            mine = (lower[:, face] == sign) & (upper[:, face] == sign)
            ends = (np.append(low, -np.ones(b)), np.append(high, np.ones(b)))
            ends[0][face] = ends[1][face] = sign
            fill(lower[mine], upper[mine], *ends)


def _extent(case: Case, window: Window, lower: Array, upper: Array) -> tuple[Array, Array]:
    nu, bound = case.problem.system.parameter_count, case.problem.system.parameters
    if bound is None:
        return np.array([window.start]), np.array([window.stop])
    if isinstance(bound, BoxSet):
        return np.append(window.start, bound.lower), np.append(window.stop, bound.upper)
    low, high = lower[:, 1 : 1 + nu].min(axis=0), upper[:, 1 : 1 + nu].max(axis=0)
    slack = balls(WIDER * (high - low))
    for i, axis in enumerate(np.eye(nu)):
        if not (
            support(bound, balls(axis)) <= balls(high)[i] + slack[i]
            and support(bound, balls(-axis)) <= -balls(low)[i] + slack[i]
        ):
            raise Broken("the cells leave out some of the parameters")
    return np.append(window.start, low), np.append(window.stop, high)


def _work(case: Case, window: Window, lower: Array, upper: Array) -> list[Work]:
    """The cells, those with the same parameters and directions together, their times cut at the breakpoints of the
    grid."""
    nu, flat = case.problem.system.parameter_count, Sides.flat(window.shape)
    keys = [(tuple(a[1:].tolist()), tuple(b[1:].tolist())) for a, b in zip(lower, upper, strict=True)]
    order = sorted(range(len(keys)), key=lambda i: (keys[i], lower[i, 0]))
    work: list[Work] = []
    for (a, b), members in groupby(order, key=lambda i: keys[i]):
        sides = flat or Sides.curved(window.shape, np.array(a[nu:]), np.array(b[nu:]))
        intervals = [part for i in members for part in _cut(case, float(lower[i, 0]), float(upper[i, 0]))]
        work.append(((a[:nu], b[:nu]), sides, intervals))
    return work


def _cut(case: Case, start: float, stop: float) -> list[Interval]:
    grid = np.array(case.grid)
    first = int(np.clip(np.searchsorted(grid, start, side="right") - 1, 0, grid.size - 2))
    if start == stop:
        return [(first if start < grid[-1] else grid.size - 2, start, stop)]
    last = int(np.clip(np.searchsorted(grid, stop, side="left") - 1, 0, grid.size - 2))
    points = [start, *grid[first + 1 : last + 1].tolist(), stop]
    return [(first + i, a, b) for i, (a, b) in enumerate(pairwise(points))]


def _tubes(case: Case, lower: Array, upper: Array) -> Callable[[Corners], Tube]:
    nu = case.problem.system.parameter_count
    widened = nu and not isinstance(case.problem.system.parameters, BoxSet)
    extra = WIDER * (upper[:, 1 : 1 + nu].max(axis=0) - lower[:, 1 : 1 + nu].min(axis=0)) if widened else np.zeros(nu)
    made: dict[Corners, Tube] = {}

    def tube(box: Corners) -> Tube:
        if box not in made:
            low, high = np.array(box[0]), np.array(box[1])
            centre = (low + high) / 2
            radius = np.nextafter(np.maximum(high - centre, centre - low) + extra, np.inf) if nu else np.zeros(0)
            if len(made) >= TUBES_KEPT:
                made.pop(next(iter(made)))
            made[box] = Tube(
                Flow(case.problem.system, tuple(centre.tolist()), tuple(radius.tolist()), DEGREES.get(nu, 2)),
                case.scene,
            )
        return made[box]

    return tube
