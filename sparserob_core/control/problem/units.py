"""Units of a control problem, and the same problem in other ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.prices import in_units
from sparserob_core.control.problem.problem import (
    IntegralConstraint,
    MixedConstraint,
    OptimalControlProblem,
    PathConstraint,
)
from sparserob_core.control.problem.system import System
from sparserob_core.sip.convex_set import Array, ConvexSet

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
    ``disturbances (mw,)``, ``parameters (nu,)``, ``cost``. Powers of two, so that nothing is rounded."""

    time: float
    states: Array
    controls: Array
    disturbances: Array
    parameters: Array
    cost: float

    def of_dictionary(self, dictionary: Dictionary) -> Dictionary:
        """The same functions of a time in these units."""
        return dictionary.on(dictionary.breakpoints / self.time)

    def of_problem(self, problem: OptimalControlProblem) -> OptimalControlProblem:
        """The same problem with every number in these units."""
        return OptimalControlProblem(
            system=self.of_system(problem.system),
            horizon=problem.horizon / self.time,
            initial_state=np.asarray(problem.initial_state) / self.states,
            initial_set=None if problem.initial_set is None else problem.initial_set.in_units(self.states),
            control=problem.control.in_units(self.controls),
            weights=in_units(problem.weights, self.controls * self.time / self.cost, self.time),
            disturbance=None if problem.disturbance is None else problem.disturbance.in_units(self.disturbances),
            disturbance_class=problem.disturbance_class,
            disturbance_breakpoints=(
                None
                if problem.disturbance_breakpoints is None
                else tuple(None if times is None else times / self.time for times in problem.disturbance_breakpoints)
            ),
            path=[self._window(entry) for entry in problem.path if not isinstance(entry, ConvexSet)],
            terminal=[end.in_units(self.states) for end in problem.terminal],
            integral=[self._integral(entry) for entry in problem.integral],
            title=problem.title,
            cost=problem.cost.in_units(self.states, self.controls, self.time, self.cost),
            initial_control=(
                None if problem.initial_control is None else np.asarray(problem.initial_control) / self.controls
            ),
            control_step=None if problem.control_step is None else problem.control_step.in_units(self.controls),
            names=problem.names,
            measurements=(
                None if problem.measurements is None else problem.measurements.in_units(self.states, self.time)
            ),
            repeat=problem.repeat,
            execution=problem.execution,
        )

    def _window(self, entry: PathConstraint | MixedConstraint) -> PathConstraint | MixedConstraint:
        start, stop = entry.start / self.time, None if entry.stop is None else entry.stop / self.time
        if isinstance(entry, MixedConstraint):
            H, G = np.asarray(entry.H) * self.states, np.asarray(entry.G) * self.controls
            return replace(entry, H=H, G=G, start=start, stop=stop)
        moved = entry.relative_to
        moved = None if moved is None else np.asarray(moved) / np.concatenate([[self.time], self.states])
        return replace(entry, set=entry.set.in_units(self.states), start=start, stop=stop, relative_to=moved)

    def _integral(self, entry: IntegralConstraint) -> IntegralConstraint:
        """What is integrated over these times, in the user's own unit."""
        assert entry.H is not None and entry.G is not None  # those of a problem
        H, G = (np.asarray(rows) * of * self.time for rows, of in ((entry.H, self.states), (entry.G, self.controls)))
        stop = None if entry.stop is None else entry.stop / self.time
        return replace(entry, H=H, G=G, start=entry.start / self.time, stop=stop)

    def of_system(self, system: System) -> System:
        """``x' = A x + B u + E w + c`` with all of it in these units."""
        rate = self.time / self.states[:, None]
        disturbances = self.disturbances[: system.disturbances]
        factors = (rate * self.states, rate * self.controls, rate * disturbances)
        return system.in_units(*factors, self.parameters, rate, self.time)
