"""Units of a control problem, and the same problem in other ones."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array

OFFSET = 0.26535897932384626  # irrational: numbers that people choose are not at the edge between two powers of two


def power_of_two(sizes: Array) -> Array:
    """The power of two by which each of ``sizes (...,)`` divided is between 0.6 and 1.21; 1 where the size is 0 or
    infinite. A size that is multiplied by a power of two gives exactly that multiple."""
    usable = np.isfinite(sizes) & (sizes > 0.0)
    mantissa, exponent = np.frexp(np.where(usable, sizes, 1.0))  # in [1/2, 1)
    lower = np.log2(mantissa) < OFFSET - 1.0
    return np.where(usable, np.ldexp(1.0, exponent - lower), 1.0)


def ratios(theirs: Array, ours: Array, units: Array) -> Array:
    """The powers of two ``(r,)`` that rows ``theirs (r, d)`` are of ``ours``, in coordinates with ``units (d,)``."""
    largest = np.abs(ours).argmax(axis=1)[:, None]
    shares = np.take_along_axis(theirs * units, largest, axis=1) / np.take_along_axis(ours, largest, axis=1)
    return np.asarray(np.exp2(np.rint(np.log2(shares[:, 0]))))


@final
@dataclass(frozen=True, eq=False)
class Units:
    """What one of each quantity is in the user's: ``time``, ``states (d,)``, ``controls (m,)``,
    ``disturbances (mw,)``, ``parameters (nu,)``, ``cost``, and ``outputs (p,)`` where they are measured. Powers of two,
    so that nothing is rounded."""

    time: float
    states: Array
    controls: Array
    disturbances: Array
    parameters: Array
    cost: float
    outputs: Array = field(default_factory=lambda: np.ones(0))

    def of_dictionary(self, dictionary: Dictionary) -> Dictionary:
        """The same functions of a time in these units."""
        return dictionary.on(dictionary.breakpoints / self.time)

    def of_problem(self, problem: OptimalControlProblem) -> OptimalControlProblem:
        """The same problem with every number in these units."""
        return problem.in_units(self)

    def of_system(self, system: System) -> System:
        """``x' = A x + B u + E w + c`` with all of it in these units."""
        rate = self.time / self.states[:, None]
        disturbances = self.disturbances[: system.disturbances]
        factors = (rate * self.states, rate * self.controls, rate * disturbances)
        return system.in_units(*factors, self.parameters, rate, self.time)
