"""States that are fixed at the end: no parameter, no disturbance and no choice of initial state may reach them, and the
control must bring them there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.checker.arithmetic.balls import balls
from sparserob_core.checker.arithmetic.jets import Monomials, expanded
from sparserob_core.checker.claims.case import Case
from sparserob_core.checker.claims.units import RowUnits
from sparserob_core.checker.outcome import EQUALITY, Broken, Unchecked
from sparserob_core.checker.reach.flow import flows
from sparserob_core.checker.reach.tube import Tube
from sparserob_core.checker.sets.known import known
from sparserob_core.control.sets.sets import Box

if TYPE_CHECKING:
    from collections.abc import Sequence

    from flint import arb


def equalities(case: Case) -> str:
    """Show that the fixed states are met at every parameter and disturbance; a sentence with the figures."""
    middle = [] if case.problem.system.parameters is None else case.problem.system.parameters.interior_point().tolist()
    scene, d = replace(case.scene, disturbance=None, initial_set=None), case.problem.system.states
    tube = Tube(flows(case.problem.system, middle), scene, np.eye(d))
    horizon, everything = case.problem.horizon, Box(np.full(d, -np.inf), np.full(d, np.inf))
    sums = RowUnits(case.problem, scene, everything, horizon, horizon).sums
    worst = 0.0
    for state, value in case.equalities:
        if _reached(case, state):
            raise Unchecked(f"the uncertainty may reach x{state + 1}, which is to be fixed")
        missed = abs(tube.nodes[-1].parts[0][state, 0] - balls([value])[0])
        most = EQUALITY * max(float(sums[state]), abs(value))
        if not missed <= most:
            raise Broken(f"x{state + 1} is missed by up to {float(missed.upper()):.3g}, rounding is at most {most:.1e}")
        worst = max(worst, float(missed.upper()))
    return f"kept to {worst:.1e}"


def _reached(case: Case, state: int) -> bool:
    """Whether an uncertain entry, a disturbance or the choice of an initial state may reach a state: follow the entries
    of ``A`` that are not 0 at every parameter."""
    system = case.problem.system
    wide = _hull(case)
    every = [expanded(mode, Monomials(len(wide), 1), wide, [1.0] * len(wide)) for mode in system.modes]
    d, reaching = system.states, {state}
    for _ in range(d):
        reaching |= {j for i in reaching for j in range(d) if any(not one["A"][0][i, j].is_zero() for one in every)}
    uncertain = any(
        not part[i, j].is_zero()
        for parts in every
        for name in ("A", "B")
        for part in parts[name][1:]
        for i in reaching
        for j in range(part.ncols())
    )
    bound = case.problem.disturbance
    free = [] if bound is None else [w for w, size in enumerate(known(bound).radius) if size > math.ulp(0.0)]
    pushed = any(not part[i, w].is_zero() for parts in every for part in parts["E"] for i in reaching for w in free)
    begun = case.problem.initial_set
    moved = begun is not None and any(known(begun).radius[j] > math.ulp(0.0) for j in reaching)
    return uncertain or pushed or moved


def _hull(case: Case) -> Sequence[arb]:
    """A ball around every parameter's values."""
    bound = case.problem.system.parameters
    if bound is None:
        return []
    axes = [[float(i == j) for j in range(bound.dimension)] for i in range(bound.dimension)]
    shape = known(bound)
    return [(-shape.support(balls([-a for a in axis]))).union(shape.support(balls(axis))) for axis in axes]
