"""The units in which a control problem is solved, and the same problem in these units."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array

OFFSET = 0.26535897932384626  # irrational, so that numbers which people choose do not lie between two powers of two


def power_of_two(sizes: Array) -> Array:
    """Return for each size the power of two by which it is divided to be between 0.6 and 1.21.

    A multiplication of a size by a power of two multiplies the result by exactly this power.

    Parameters
    ----------
    sizes : array (...,)
        Numbers that are not negative.

    Returns
    -------
    array (...,)
        The powers of two; 1 where the size is 0 or infinite.
    """
    usable = np.isfinite(sizes) & (sizes > 0.0)
    mantissa, exponent = np.frexp(np.where(usable, sizes, 1.0))  # the mantissa is in [1/2, 1)
    lower = np.log2(mantissa) < OFFSET - 1.0
    return np.where(usable, np.ldexp(1.0, exponent - lower), 1.0)


def ratios(theirs: Array, ours: Array, units: Array) -> Array:
    """Return the powers of two that turn rows in the units of the user into rows of a problem in other units.

    Parameters
    ----------
    theirs, ours : arrays (r, d)
        The rows in the units of the user, and the same rows in the other units.
    units : array (d,)
        One of the other units of each coordinate, in units of the user.

    Returns
    -------
    array (r,)
        The factor between ``theirs * units`` and ``ours``, rounded to a power of two.
    """
    largest = np.abs(ours).argmax(axis=1)[:, None]
    shares = np.take_along_axis(theirs * units, largest, axis=1) / np.take_along_axis(ours, largest, axis=1)
    return np.asarray(np.exp2(np.rint(np.log2(shares[:, 0]))))


@final
@dataclass(frozen=True, eq=False)
class Units:
    """The units of all quantities of a problem, each of which is a number of units of the user.

    All numbers are powers of two, so that a change of units rounds nothing.

    Parameters
    ----------
    time, cost : float
        The units of the time and of the cost.
    states, controls, disturbances, parameters : arrays (d,), (m,), (mw,), (nu,)
        The units of each coordinate.
    outputs : array (p,), optional
        The units of the outputs, where outputs are measured; empty unless given.
    """

    time: float
    states: Array
    controls: Array
    disturbances: Array
    parameters: Array
    cost: float
    outputs: Array = field(default_factory=lambda: np.ones(0))

    def of_dictionary(self, dictionary: Dictionary) -> Dictionary:
        """Return the dictionary with times in these units."""
        return dictionary.on(dictionary.breakpoints / self.time)

    def of_problem(self, problem: OptimalControlProblem) -> OptimalControlProblem:
        """Return the problem with all numbers in these units."""
        return problem.in_units(self)

    def of_system(self, system: System) -> System:
        """Return the system ``x' = A x + B u + E w + c`` with all numbers in these units."""
        rate = self.time / self.states[:, None]
        disturbances = self.disturbances[: system.disturbances]
        factors = (rate * self.states, rate * self.controls, rate * disturbances)
        return system.in_units(*factors, self.parameters, rate, self.time)
