"""Curved sets of controls, and of their steps: ``c'u(t) <= h(c)``, with the normal direction as an index."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.sparse import csr_array, eye_array, hstack

from sparserob_core.control.constraints.explanation import ConstraintSource, TimedExplanation, of_gauge
from sparserob_core.control.constraints.local_maxima import climb
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.directions import across, on_surface, sampled, unit
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import ConstraintFamily, Explanation, Separation

CLIMBED_PIECES = 16  # pieces, those furthest outside, whose direction is refined per round


CONTROL, RATE, STEP = "control", "rate", "control_step"


def of_control(problem: OptimalControlProblem) -> str:
    """Return the name of the control's own set: ``rate`` where a path constraint has the name ``control``, else
    ``control``."""
    return RATE if any(getattr(entry, "name", "") == CONTROL for entry in problem.path) else CONTROL


@final
@dataclass(frozen=True, eq=False)
class Places:
    """Values of a control on every piece, or its changes at every step, with the times that stand for them.

    Values and changes are the same linear function of the pieces for a control without feedback, for a nominal control
    and for its response to a deviation.

    Parameters
    ----------
    table : csr_array, shape (K, q)
        Coefficients of the values on the pieces at each of the ``q`` places.
    offset : ndarray, shape (q, m)
        Constants that are added.
    starts : ndarray, shape (q,)
        Time from which on times stand for each place, until the next start.
    stop : float
        Time until which times stand for the last place.
    times : ndarray, shape (q,)
        Time of each place that is reported.
    steps : bool
        Whether the places are changes.
    seam : bool
        Whether the last place is the change from the last piece to the first piece of the next period.
    """

    table: csr_array
    offset: Array
    starts: Array
    stop: float
    times: Array
    steps: bool = False
    seam: bool = False

    @staticmethod
    def of_values(breakpoints: Array, controls: int) -> Places:
        """Return the values ``u(t)`` on every piece."""
        ends, pieces = breakpoints, breakpoints.size - 1
        table, offset = csr_array(eye_array(pieces)), np.zeros((pieces, controls))
        return Places(table, offset, ends[:-1], float(ends[-1]), (ends[:-1] + ends[1:]) / 2)

    @staticmethod
    def of_steps(breakpoints: Array, controls: int, before: Array | None, seam: bool = False) -> Places:
        """Return the changes ``u_{k+1} - u_k`` at every step, and ``u_0 - before`` at time 0 unless ``before`` is
        ``None``; with a ``seam`` also the change from the last piece to the first at the horizon."""
        first, pieces = int(before is None), breakpoints.size - 1
        times = breakpoints[first : pieces + seam]
        offset = np.zeros((times.size, controls))
        if before is not None:
            offset[0] = -before
        table = differences(pieces, before is not None, seam)
        return Places(table, offset, times, float(breakpoints[-1]), times, steps=True, seam=seam)

    @property
    def spans(self) -> tuple[Array, Array]:
        """Intervals of time that stand for the places: their starts and their ends, ``(q,)`` each."""
        return self.starts, np.append(self.starts[1:], self.stop)

    def at(self, times: Array) -> np.ndarray:
        """Return the place that each time stands for."""
        return np.clip(np.searchsorted(self.starts, times, side="right") - 1, 0, self.starts.size - 1)

    def words(self, time: float) -> str:
        """Return the control, or its change, at the reported ``time`` in words."""
        return f"the change of u at {time:.6g}" if self.steps else f"u({time:.6g})"


def held_at(problem: OptimalControlProblem, breakpoints: Array, answering: bool) -> list[tuple[str, ConvexSet, Places]]:
    """Return the sets that a problem's control must stay in, by name, and where: its own on every piece, and that of
    its steps. A single piece that repeats follows itself; where it is ``answering``, by another value."""
    m, pieces, first, step = problem.system.controls, breakpoints.size - 1, before(problem), problem.control_step
    sets = [(of_control(problem), problem.control, Places.of_values(breakpoints, m))]
    seam = bool(problem.repeat) and (pieces > 1 or answering)
    if step is not None and (pieces > 1 or first is not None or seam):
        sets.append((STEP, step, Places.of_steps(breakpoints, m, first, seam)))
    return sets


def before(problem: OptimalControlProblem) -> Array | None:
    """Return the control ``(m,)`` before time 0; ``None`` where the problem does not give it."""
    return None if problem.initial_control is None else np.asarray(problem.initial_control, dtype=float)


@dataclass(frozen=True, eq=False)
class ControlConstraint(ConstraintSource):
    """Constraint that the control at ``places`` stays in a curved set.

    The index is ``(t, z)`` with ``z`` in ``[-1, 1]^m`` a direction, not normalised.

    Parameters
    ----------
    name : str
        Name of the constraint.
    set : ConvexSet
        The curved set.
    places : Places
        Values of the control, or its changes.
    values : csr_array, shape (N, q)
        Value of every function of the dictionary at the places.
    extra_count : int, default 0
        Number of entries of the decision after the coefficients of the control.
    """

    name: str
    set: ConvexSet
    places: Places
    values: csr_array
    extra_count: int = 0

    @staticmethod
    def of(
        name: str, convex: ConvexSet, places: Places, dictionary: Dictionary, extra_count: int = 0
    ) -> ControlConstraint:
        """Return the constraint for a control in a ``dictionary``, whose coefficients are followed by ``extra_count``
        entries of the decision."""
        return ControlConstraint(name, convex, places, csr_array(dictionary.sparse @ places.table), extra_count)

    def family(self) -> ConstraintFamily:
        """Return the constraint as a family; it does not depend on any uncertainty."""
        m = self.set.dimension
        low, high = self.places.starts[:1], np.array([self.places.stop])
        index_set = Box(np.concatenate([low, -np.ones(m)]), np.concatenate([high, np.ones(m)]))
        family = ConstraintFamily(
            name=self.name,
            index_set=index_set,
            rows=self.rows,
            worst=self.worst,
            gradient=self.gradient,
            explain=self.explain,
            source=self,
        )
        return replace(family, nominal=family, sample=lambda count, rng: family, literal=family)

    def rows(self, indices: Array) -> tuple[Array, Array]:
        """Return ``G (k, 1, n)``, ``rhs (k, 1)`` at indices ``(k, 1 + m)``."""
        directions, places = unit(self.set, indices[:, 1:]), self.places.at(indices[:, 0])
        G = np.einsum("kc,kn->kcn", directions, self.values[:, places].toarray().T).reshape(indices.shape[0], 1, -1)
        G = np.pad(G, ((0, 0), (0, 0), (0, self.extra_count)))
        return G, (self.set.support(directions) - (directions * self.places.offset[places]).sum(axis=1))[:, None]

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """Return the normal ``(1, 1)`` and the unit ``(1,)`` of the one row, which is in multiples of the set's gauge
        in any units."""
        return of_gauge()

    def gradient(self, x: Array, indices: Array, rows: Array) -> Array:
        """Return the derivative ``(k, 1 + m)`` of ``row x - rhs`` in the index: 0 in time, since the control is
        constant on every piece."""
        z = np.asarray(indices, dtype=float)[:, 1:]
        point = self._evaluate_places(x)[self.places.at(indices[:, 0])]
        slopes = across(self.set, z, (point - self.set.support_point(unit(self.set, z))) @ self.set.frame.T)
        return np.hstack([np.zeros((z.shape[0], 1)), slopes])

    def worst(self, x: Array) -> Separation:
        """Return the places furthest outside, each with the worst direction that a climb finds. The bound is the
        largest gauge less 1 over all places, which is exact but for rounding."""
        points = self._evaluate_places(x)
        outside = self.set.gauge(points) - 1.0
        places = np.argsort(-outside, kind="stable")[:CLIMBED_PIECES]
        z = sampled(self.set.dimension)
        c = unit(self.set, z)
        start = z[(points[places] @ c.T - self.set.support(c)).argmax(axis=1)]

        def excess(at: Array, which: np.ndarray) -> Array:
            directions = unit(self.set, at)
            answer: Array = np.einsum("kc,kc->k", directions, points[places[which]]) - self.set.support(directions)
            return answer

        z, violations = climb(
            excess, start, np.full(self.set.dimension, 0.1), lambda at: on_surface(np.clip(at, -1.0, 1.0))
        )
        order = np.argsort(-violations, kind="stable")
        indices = np.hstack([self.places.times[places[order], None], z[order]])
        return Separation(indices, np.zeros(order.size, dtype=int), violations[order], float(outside.max()))

    def explain(self, index: Array, row: int) -> Explanation:
        """Return the description of one constraint for a reader."""
        time = float(self.places.times[self.places.at(index[:1])[0]])
        text = f"{self.name}: {self.places.words(time)} in the {self.set.kind}"
        return TimedExplanation(text, self.name, text, time, unit(self.set, index[None, 1:])[0])

    def _evaluate_places(self, x: Array) -> Array:
        """Return the values of the control, or its changes, at every place, ``(q, m)``."""
        coefficients = x[: x.size - self.extra_count].reshape(self.set.dimension, -1)
        answer: Array = (coefficients @ self.values).T + self.places.offset
        return answer


def differences(pieces: int, at_start: bool, seam: bool = False) -> csr_array:
    """Return the matrix ``(K, q)`` from values on pieces to their changes from one to the next; ``at_start``: from 0
    before the first too, ``seam``: from the last to the first too, after the others."""
    changes = csr_array(eye_array(pieces) - eye_array(pieces, k=1))
    changes = changes if at_start else changes[:, 1:]
    if not seam:
        return changes
    seam_change = csr_array(([1.0, -1.0], ([0, pieces - 1], [0, 0])), shape=(pieces, 1))
    return csr_array(hstack([changes, seam_change]))
