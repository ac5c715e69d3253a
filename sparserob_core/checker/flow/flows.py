"""The flows of an uncertain system: over boxes of parameters, and at single ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from sparserob_core.checker.arithmetic.remembered import remembered
from sparserob_core.checker.arithmetic.series import exactly
from sparserob_core.checker.flow.flow import StateWeights, VerifiedFlow
from sparserob_core.checker.flow.law import Law, ParameterBox, bound_entries
from sparserob_core.checker.flow.plant import Plant
from sparserob_core.checker.flow.segment import SHARP
from sparserob_core.checker.flow.units import pace
from sparserob_core.checker.outcome import Unchecked
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array

DEGREES = {0: 0, 1: 8, 2: 6, 3: 4, 4: 3}  # the degree of an expansion by the number of parameters; 2 for more
WIDE = {1: 16, 2: 8, 3: 5, 4: 3}  # the degree of an expansion that serves many boxes
CLOSE = 1e-11  # the relative remainder that an expansion over a larger box may have in transitions over the horizon
HALVINGS = 10  # the largest number of halvings of the box of all parameters, to find a box whose flow serves others
KEPT = 64  # flows over boxes that are remembered
ASIDE = 0.3819  # distance of `aside` from the middle of the parameters, as a share of half their width


@final
@dataclass(eq=False)
class VerifiedFlows:
    """The flows of a ``plant`` up to the time ``until``, whose parameters are in a ``box``. Guesses of flows at single
    parameters aim at the relative error ``sharp``."""

    plant: Plant
    until: float
    box: ParameterBox = ParameterBox()  # noqa: RUF009  immutable
    sharp: float = SHARP

    @staticmethod
    def of(system: System, until: float, sharp: float = SHARP) -> VerifiedFlows:
        """Return the flows of a system over the bounding box of its parameters."""
        bound = None if system.parameters is None else system.parameters.bounding_box()
        box = ParameterBox() if bound is None else ParameterBox.between(bound.lower.tolist(), bound.upper.tolist())
        return VerifiedFlows(Plant.of(system, until), until, box, sharp)

    def at(self, parameter: Sequence[float]) -> VerifiedFlow:
        """Return the flow at one parameter, of which there may be none."""
        return self._point_flow.at(parameter)

    def weigh(self, c: Array, parameter: Sequence[float], grid: Sequence[float]) -> StateWeights:
        """Return the weights of ``c'x``, ``c (d,)``, at the end of a grid, which begins at 0, at one parameter."""
        row, weights = exactly(c[None]), self.at(parameter).weights(grid)
        control, disturbance = (
            [row * of_piece for of_piece in part] for part in (weights.control, weights.disturbance)
        )
        return StateWeights(row * weights.free, control, disturbance)

    @cached_property
    def _point_flow(self) -> VerifiedFlow:
        return VerifiedFlow(self.plant, self.until, sharp=self.sharp)

    @property
    def degree(self) -> int:
        """The degree of the expansions over boxes."""
        return DEGREES.get(len(self.box.middle), 2)

    @remembered(lambda: KEPT)
    def over(self, box: ParameterBox, degree: int) -> VerifiedFlow:
        """Return the flow over a box, to a degree in the parameters; a degree of 0 is for systems without any."""
        if not degree:
            return self.at(())
        return VerifiedFlow(self.plant, self.until, box, degree, self.timing)

    @cached_property
    def timing(self) -> Law:
        """The law at a single parameter; the flows over all boxes use its stretches."""
        return self._point_flow.at(self.aside).law

    @property
    def aside(self) -> tuple[float, ...]:
        """A parameter off the middle, where a coefficient that changes with time is 0 only by coincidence."""
        return tuple(m + ASIDE * h for m, h in zip(self.box.middle, self.box.halves, strict=True))

    def marks(self, times: Sequence[float]) -> list[float]:
        """Return the increasing times with marks between them, such that the flow over any box is a polynomial from
        each to the next."""
        return self.at(self.aside).marks(times)

    def holding(self, box: ParameterBox) -> VerifiedFlow:
        """Return a flow over a box, or over a larger one that contains it: the box of all parameters, halved until the
        remainder of its expansion is small, or `HALVINGS` times."""
        if self._is_still:
            return self.over(box, self.degree)
        candidate, degree = self.box, WIDE.get(len(box.middle), 2)
        for _ in range(HALVINGS):
            if not candidate.holds(box) or candidate == box or self._has_small_remainder(candidate, degree):
                break
            candidate = next((half for half in candidate.halved(self._choose_axis(candidate)) if half.holds(box)), box)
        return self.over(candidate if candidate.holds(box) else box, degree)

    @cached_property
    def _is_still(self) -> bool:
        """True where nothing changes with time or nothing is uncertain: then flows are cheap."""
        return not self.box.middle or all(stretch.is_still for stretch in self.timing.stretches)

    @remembered()
    def _has_small_remainder(self, box: ParameterBox, degree: int) -> bool:
        """Return True where the expansion over a box, to a degree, has a small remainder."""
        try:
            flow = self.over(box, degree)
            Phi, units = flow.over(0.0, self.until)[0], flow.law.units
        except Unchecked:
            return False
        radii = np.array([[float(x.rad()) for x in row] for row in Phi.parts[0].tolist()])
        size, error = ((values * units / units[:, None]).max() for values in (Phi.size, radii))
        return bool(error <= CLOSE * max(1.0, size))

    def _choose_axis(self, box: ParameterBox) -> int:
        """Return the number of the parameter that changes the system most across a box."""
        try:
            law = Law(self.plant, self.until, box, 1, self.timing)
            sizes = np.zeros(len(box.middle))
            for stretch in law.stretches:
                u = law.units
                for j in range(sizes.size):
                    size = bound_entries(stretch.table[law.monomials.linear(j)])
                    sizes[j] += (stretch.stop - stretch.start) * pace(size[:, : len(u)], u)
            return int(sizes.argmax()) if sizes.any() else int(np.argmax(box.halves))
        except Unchecked:
            return int(np.argmax(box.halves))

    @cached_property
    def links(self) -> tuple[np.ndarray, np.ndarray]:
        """The entries of ``[A B c E]`` that may differ from 0 at some time and parameter, and the entries that may
        depend on the parameters: two Boolean arrays ``(d, d + w)``."""
        law = Law(self.plant, self.until, self.box, min(1, self.degree), self.timing)
        is_dependent = []
        for stretch in law.stretches:
            constant, *higher = stretch.table
            is_dependent.append([[any(table[i][j].length() for table in higher) or _is_wide(constant[i][j])
                                  for j in range(len(constant[0]))] for i in range(len(constant))])  # fmt: skip
        return law.there, np.any(is_dependent, axis=0) & bool(self.box.middle)


def _is_wide(entry: object) -> bool:
    """Return True where a coefficient of a polynomial has a larger radius than rounding makes it."""
    return any(float(c.rad()) > 2.0**-60 * float(abs(c).upper()) for c in entry.coeffs())  # type: ignore[attr-defined]
