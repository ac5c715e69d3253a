"""Interface of constraints on the state, for programs, for proofs, and for studies of single trajectories."""

from __future__ import annotations

from abc import abstractmethod
from functools import cached_property

import numpy as np

from sparserob_core.control.constraints.explanation import NEGLIGIBLE_TERM, ConstraintSource, TimedExplanation
from sparserob_core.control.problem.names import unit_of_row
from sparserob_core.control.problem.units import Units
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.reach.sizes import nominal_sizes
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.reference import STILL, Reference
from sparserob_core.shapes import Float, Int, shaped
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import Enclosure, Separation

# The size of a row that has none, in its unit: bound, width and nominal values are 0, as those of a control that is to
# be 0. A billionth of it is excused, which is above the remainders of series that enclose a 0, and no rounding of any
# number that a row could have. A ten-thousandth of it leaves such rows open.
EMPTY_ROW_UNIT = 2.0**-140


class StateConstraint(ConstraintSource):
    """``c'(x(t) - r(t)) + g'u(t) <= h(c)`` for all ``t`` in ``[start, stop]``, parameters and disturbances, and for the
    normals ``c`` of a convex set, ``r`` its ``reference`` where it moves; ``g = 0`` but for mixed constraints. A
    terminal constraint is the window ``[T, T]``.

    An index is ``(t, p)``, followed by a direction ``z (b,)`` where the set is curved; at each there are ``r`` rows.
    The disturbance is maximised in closed form (`WorstFunctionals`), so the formulation is the reduced one.
    """

    name: str
    functionals: WorstFunctionals
    start: float
    stop: float
    parameters: ParameterIndex
    reference: Reference = STILL
    gains: Array | None = None
    """``G (r, m)`` of a mixed constraint."""

    @property
    @abstractmethod
    def index_set(self) -> Box:
        """The box of all indices."""

    @property
    @abstractmethod
    def sides(self) -> tuple[Float[Array, "r d"], Float[Array, " r"]] | None:
        """``H (r, d)``, ``h (r,)`` of a set with flat sides; ``None`` for a curved set."""

    @property
    def shape(self) -> ConvexSet | None:
        """The set, where it is curved; its `ConvexSet.frame` says what a direction ``z`` is."""
        return None

    @abstractmethod
    def functionals_at(
        self, indices: Float[Array, "k j"]
    ) -> tuple[Float[Array, " n"], Float[Array, "n d"], Float[Array, "n nu"], Float[Array, " n"]]:
        """Return times ``(k r,)``, directions ``(k r, d)``, parameters ``(k r, nu)`` and right-hand sides ``(k r,)`` of
        all rows of every index ``(k, ...)``, index by index."""

    @abstractmethod
    def violations(
        self, x: Float[Array, " n"], indices: Float[Array, "k j"], rows: Int[np.ndarray, " k"]
    ) -> Float[Array, " k"]:
        """Return ``row x - rhs`` for one row per index, ``(k,)``, without building rows."""

    @abstractmethod
    def worst(self, x: Float[Array, " n"]) -> Separation:
        """Return the largest local maxima of the violation over the index set."""

    @property
    @abstractmethod
    def cells(self) -> tuple[Float[Array, "k j"], Float[Array, "k j"]]:
        """The lower and upper corners of cells that fill the index set and on which `enclosure` converges."""

    @abstractmethod
    def enclosure(self, x: Float[Array, " n"], lower: Float[Array, "k j"], upper: Float[Array, "k j"]) -> Enclosure:
        """Return proven upper bounds of the violation on cells of the index set, each within one piece."""

    @abstractmethod
    def explain(self, index: Float[Array, " j"], row: int) -> TimedExplanation:
        """Return the description of one constraint for a reader: the bounded quantity, its time, and the effect of the
        uncertainty."""

    @abstractmethod
    def nominal(self) -> StateConstraint:
        """Return the same constraint without uncertainty: at a middle parameter, and without a disturbance (or with a
        middle one, where no disturbance is not admissible)."""

    @abstractmethod
    def from_state(self, initial_state: Float[Array, " d"]) -> StateConstraint:
        """Return the same constraint from another initial state ``(d,)``, sharing all data that do not depend on the
        initial state."""

    @abstractmethod
    def divided(self, units: Float[Array, " r"]) -> StateConstraint:
        """Return the same constraint with its rows divided by ``units (r,)``; a curved set has one unit."""

    @shaped
    def looked_at_in(self, units: Float[Array, " r"]) -> StateConstraint:
        """Return the `divided` constraint, which shares the samples of this one where it has any."""
        return self.divided(units)

    @abstractmethod
    def directions(
        self, z: Float[Array, "k b"], rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[Array, "k e d"], Float[Array, "k e"]]:
        """Return directions ``(k, b, d)`` and shares ``(k, b)`` whose combinations are the normals ``(k, d)`` at one
        row ``(k,)`` and direction ``z (k, b)`` each; ``b`` is 1 for a set with flat sides."""

    @shaped
    def turned(
        self, z: Float[Array, "k b"], directions: Float[Array, "k d"], states: Float[Array, "k e"]
    ) -> Float[Array, "k b"]:
        """Return the derivative ``(k, b)`` of the violation in the direction ``z``, with the normals
        ``directions (k, d)`` and ``states (k, b)``, the states along the directions of `directions`; nothing,
        ``(k, 0)``, for flat sides."""
        return z

    @abstractmethod
    def compute_added_terms(self, x: Float[Array, " n"], times: Float[Array, " k"]) -> Float[Array, "k j"]:
        """Return the terms that are added at times ``(k,)`` for a decision ``x (n,)``.

        For flat sides ``G u(t) - H r(t)``, ``(k, r)``, is added to the rows. For a curved set ``-r(t)``, ``(k, d)``, is
        added to the state.
        """

    @abstractmethod
    def outwardness(
        self, states: Float[Array, "d n"], added_terms: Float[Array, " j"] | None = None
    ) -> Float[Array, " n"]:
        """Return a cheap measure ``(n,)`` of states ``(d, n)`` at one time, shifted by `compute_added_terms`: positive
        outside the set, not positive inside, growing outwards."""

    @shaped
    def excess(self, states: Float[Array, "d n"], added_terms: Float[Array, " j"] | None = None) -> Float[Array, " n"]:
        """Return the violation ``(n,)`` of the constraint by states ``(d, n)``, negative where there is a margin. With
        flat sides it is the `outwardness` itself."""
        return self.outwardness(states, added_terms)

    @shaped
    def direct(self, times: Float[Array, " k"]) -> Float[Array, "q n"] | None:
        """Return the direct contribution of the control to all rows at times ``(k,)``, as rows ``(k r, n)`` of the
        decision, time by time; ``None`` where there is none."""
        return None

    @shaped
    def normals_at(self, index: Float[Array, " j"]) -> Float[Array, "r q"]:
        """Return the normals of all rows at one index, those of a mixed constraint with their part on the control,
        ``(r, d + m)``."""
        directions, gains = self.functionals_at(index[None])[1], self.gains
        return directions if gains is None else np.hstack([directions, gains])

    @property
    def of_state(self) -> StateConstraint:
        """Constraint on the state without feedback, which is this constraint."""
        return self

    @property
    @abstractmethod
    def sized_rows(self) -> tuple[Float[Array, "q d"], Float[Array, " q"]]:
        """Rows ``(q, d)`` on the state, with the sizes ``(q,)`` that they have whatever the decision; of a curved set
        those in some directions."""

    @shaped
    def sizes(self, x: Float[Array, " n"]) -> Float[Array, " q"]:
        """Return the sizes ``(q,)`` of `sized_rows` at a decision ``x (n,)``: a claim may excuse a billionth of
        them."""
        rows, sizes = self.sized_rows
        return np.maximum(sizes, self._compute_row_sizes(x, rows))

    def scale(self, x: Array) -> float:
        """Return the least of the `sizes` at a decision ``x (n,)``, 1 where none is below that."""
        rows, sizes = self.sized_rows
        small = sizes < 1.0
        if not small.any():
            return 1.0
        key = x.tobytes()
        if key not in self._scales:
            self._scales.clear()
            least = float(np.maximum(sizes, self._compute_row_sizes(x, rows))[small].min(initial=1.0))
            self._scales[key] = max(least, EMPTY_ROW_UNIT)
        return self._scales[key]

    def _compute_row_sizes(self, x: Array, rows: Array) -> Array:
        return nominal_sizes(self.functionals, x, rows, self.gains)

    @cached_property
    def _scales(self) -> dict[bytes, float]:
        return {}

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normals of the rows at one index, ``(r, q)``, and the units of the states, with those of the
        controls for a mixed constraint, ``(q,)``."""
        coordinates = units.states if self.gains is None else np.concatenate([units.states, units.controls])
        return self.normals_at(self.index_set.lower), coordinates

    def index_units(self, units: Units) -> Array:
        """Return the units of time and parameters, the first coordinates of a reduced index."""
        return np.concatenate([[units.time], units.parameters])

    def states_of(self, row: int) -> np.ndarray:
        """Return which states ``(d,)`` a row depends on; for a curved set, which states it bounds; no state where there
        is no such row."""
        if self.shape is not None:
            normals = self.shape.frame
        else:
            assert self.sides is not None
            normals = self.sides[0][row : row + 1]
        size = np.abs(normals)
        return np.asarray((size > NEGLIGIBLE_TERM * size.max(initial=0.0)).any(axis=0))

    @property
    def measured(self) -> tuple[str, ...]:
        """The unit of every row, empty where it has none that is known; of a curved set, whose one row is in multiples
        of its gauge, none."""
        if self.sides is None:
            return ("",)
        H, names = self.sides[0], self.functionals.names
        normals = H if self.gains is None else np.hstack([H, self.gains])
        return tuple(unit_of_row(normal, names, H.shape[1]).strip() for normal in normals)

    @shaped
    def at(self, x: Float[Array, " n"], indices: Float[Array, "k j"]) -> Float[Array, "k r"]:
        """Return `violations` of all rows at indices ``(k, ...)``, ``(k, r)``."""
        times, directions, parameters, rhs = self.functionals_at(indices)
        violations, direct = self.functionals.values(x, times, directions, parameters) - rhs, self.direct(indices[:, 0])
        shape = (indices.shape[0], times.size // max(1, indices.shape[0]))
        return np.asarray(violations if direct is None else violations + direct @ x).reshape(shape)

    @shaped
    def chosen(
        self, indices: Float[Array, "k j"], rows: Int[np.ndarray, " k"]
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """Return ``G (k, n)``, ``rhs (k,)`` of one row of each index ``(k, ...)``, none of the others made."""
        times, directions, parameters, rhs = self.functionals_at(indices)
        positions = np.arange(rows.size) * (times.size // max(1, rows.size)) + rows
        G, offset = self.functionals.rows(times[positions], directions[positions], parameters[positions])
        direct = self.direct(indices[:, 0])
        return (G if direct is None else G + direct[positions]), rhs[positions] - offset

    @shaped
    def rows(self, indices: Float[Array, "k j"]) -> tuple[Float[Array, "k r n"], Float[Array, "k r"]]:
        """Return ``G (k, r, n)``, ``rhs (k, r)`` at indices ``(k, ...)``."""
        times, directions, parameters, rhs = self.functionals_at(indices)
        G, offset = self.functionals.rows(times, directions, parameters)
        direct = self.direct(indices[:, 0])
        G = G if direct is None else G + direct
        shape = (indices.shape[0], times.size // max(1, indices.shape[0]))
        return G.reshape(*shape, G.shape[1]), (rhs - offset).reshape(shape)
