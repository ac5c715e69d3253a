"""Curved sets of controls, and of their steps: ``c'u(t) <= h(c)``, with the normal direction as an index."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, final

import numpy as np

from sparserob_core.control.constraints.explanation import Source, TimedExplanation, of_gauge
from sparserob_core.control.constraints.local_maxima import climb
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.problem.units import Units
from sparserob_core.control.sets.directions import across, on_surface, sampled, unit
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import ConstraintFamily, Explanation, Separation

if TYPE_CHECKING:
    from scipy.sparse import csr_array

CLIMBED = 16  # pieces, those furthest outside, whose direction is refined per round


CONTROL, RATE, STEP = "control", "rate", "control_step"


def of_control(problem: OptimalControlProblem) -> str:
    """What the control's own set is called: ``rate`` where a path constraint is called ``control``."""
    return RATE if any(getattr(entry, "name", "") == CONTROL for entry in problem.path) else CONTROL


@final
@dataclass(frozen=True, eq=False)
class Places:
    """What a control does at some places in time: its value on every piece, or its change at every step, which is the
    same linear function of a control that answers nothing, of a nominal one and of every answer.

    ``table (K, q)``: what the values on the pieces are multiplied by at the ``q`` places; ``offset (q, m)`` is added.
    ``starts (q,)``: from when on a time stands for each place, until the next, or the end, ``stop``. ``times (q,)``:
    the time of each place that is told. ``steps``: whether these are changes; ``seam``: whether the last one is that
    from the last piece to the first of the next period.
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
        """``u(t)`` on every piece."""
        from scipy.sparse import csr_array, eye_array

        ends, pieces = breakpoints, breakpoints.size - 1
        table, offset = csr_array(eye_array(pieces)), np.zeros((pieces, controls))
        return Places(table, offset, ends[:-1], float(ends[-1]), (ends[:-1] + ends[1:]) / 2)

    @staticmethod
    def of_steps(breakpoints: Array, controls: int, before: Array | None, seam: bool = False) -> Places:
        """``u_{k+1} - u_k`` at every step, and ``u_0 - before`` at time 0 unless ``before`` is ``None``; with a
        ``seam`` from the last piece to the first at the horizon."""
        first, pieces = int(before is None), breakpoints.size - 1
        times = breakpoints[first : pieces + seam]
        offset = np.zeros((times.size, controls))
        if before is not None:
            offset[0] = -before
        table = differences(pieces, before is not None, seam)
        return Places(table, offset, times, float(breakpoints[-1]), times, steps=True, seam=seam)

    @property
    def spans(self) -> tuple[Array, Array]:
        """From when on times stand for each place, and until when, ``(q,)`` each."""
        return self.starts, np.append(self.starts[1:], self.stop)

    def at(self, times: Array) -> np.ndarray:
        """The place that each time stands for."""
        return np.clip(np.searchsorted(self.starts, times, side="right") - 1, 0, self.starts.size - 1)

    def words(self, time: float) -> str:
        """What the control does at a time that is told."""
        return f"the change of u at {time:.6g}" if self.steps else f"u({time:.6g})"


def held_at(problem: OptimalControlProblem, breakpoints: Array, answering: bool) -> list[tuple[str, ConvexSet, Places]]:
    """The sets that a problem's control must stay in, by name, and where: its own on every piece, and that of its
    steps. A single piece that repeats follows itself; where it is ``answering``, by another value."""
    m, pieces, first, step = problem.system.controls, breakpoints.size - 1, before(problem), problem.control_step
    found = [(of_control(problem), problem.control, Places.of_values(breakpoints, m))]
    seam = bool(problem.repeat) and (pieces > 1 or answering)
    if step is not None and (pieces > 1 or first is not None or seam):
        found.append((STEP, step, Places.of_steps(breakpoints, m, first, seam)))
    return found


def before(problem: OptimalControlProblem) -> Array | None:
    """The control ``(m,)`` before time 0, where it is told."""
    return None if problem.initial_control is None else np.asarray(problem.initial_control, dtype=float)


@dataclass(frozen=True, eq=False)
class ControlConstraint(Source):
    """What the control does at ``places`` in a curved set. The index is ``(t, z)`` with ``z`` in ``[-1, 1]^m`` a
    direction, not normalised.

    ``values (N, q)``: what every function of the dictionary is at the places. ``beside``: how many entries of the
    decision come after the coefficients of the control.
    """

    name: str
    set: ConvexSet
    places: Places
    values: csr_array
    beside: int = 0

    @staticmethod
    def of(name: str, convex: ConvexSet, places: Places, dictionary: Dictionary, beside: int = 0) -> ControlConstraint:
        """That of a control in a dictionary."""
        from scipy.sparse import csr_array

        return ControlConstraint(name, convex, places, csr_array(dictionary.sparse @ places.table), beside)

    def family(self) -> ConstraintFamily:
        """The constraint as a family; it does not depend on any uncertainty."""
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
        """``G (k, 1, n)``, ``rhs (k, 1)`` at indices ``(k, 1 + m)``."""
        directions, places = unit(self.set, indices[:, 1:]), self.places.at(indices[:, 0])
        G = np.einsum("kc,kn->kcn", directions, self.values[:, places].toarray().T).reshape(indices.shape[0], 1, -1)
        G = np.pad(G, ((0, 0), (0, 0), (0, self.beside)))
        return G, (self.set.support(directions) - (directions * self.places.offset[places]).sum(axis=1))[:, None]

    def normals_in(self, units: Units) -> tuple[Array, Array]:
        """That of a gauge."""
        return of_gauge()

    def gradient(self, x: Array, indices: Array, rows: Array) -> Array:
        """The derivative ``(k, 1 + m)`` of ``row x - rhs`` in the index: 0 in time, since the control is constant on
        every piece."""
        z = np.asarray(indices, dtype=float)[:, 1:]
        point = self._points(x)[self.places.at(indices[:, 0])]
        turned = across(self.set, z, (point - self.set.support_point(unit(self.set, z))) @ self.set.frame.T)
        return np.hstack([np.zeros((z.shape[0], 1)), turned])

    def worst(self, x: Array) -> Separation:
        """The places furthest outside, each with its worst direction; the bound is exact, since the places are finitely
        many."""
        points = self._points(x)
        outside = self.set.gauge(points) - 1.0
        places = np.argsort(-outside, kind="stable")[:CLIMBED]
        z = sampled(self.set.dimension)
        c = unit(self.set, z)
        start = z[(points[places] @ c.T - self.set.support(c)).argmax(axis=1)]

        def excess(at: Array, which: np.ndarray) -> Array:
            directions = unit(self.set, at)
            answer: Array = np.einsum("kc,kc->k", directions, points[places[which]]) - self.set.support(directions)
            return answer

        z, found = climb(excess, start, np.full(self.set.dimension, 0.1), lambda at: on_surface(np.clip(at, -1.0, 1.0)))
        order = np.argsort(-found, kind="stable")
        indices = np.hstack([self.places.times[places[order], None], z[order]])
        return Separation(indices, np.zeros(order.size, dtype=int), found[order], float(outside.max()))

    def explain(self, index: Array, row: int) -> Explanation:
        """One constraint for people."""
        time = float(self.places.times[self.places.at(index[:1])[0]])
        text = f"{self.name}: {self.places.words(time)} in the {self.set.kind}"
        return TimedExplanation(text, self.name, text, time, unit(self.set, index[None, 1:])[0])

    def _points(self, x: Array) -> Array:
        """What the control does at every place, ``(q, m)``."""
        coefficients = x[: x.size - self.beside].reshape(self.set.dimension, -1)
        answer: Array = (coefficients @ self.values).T + self.places.offset
        return answer


def differences(pieces: int, at_start: bool, seam: bool = False) -> csr_array:
    """The matrix ``(K, q)`` from values on pieces to their changes from one to the next; ``at_start``: from 0 before
    the first too, ``seam``: from the last to the first too, after the others."""
    from scipy.sparse import csr_array, eye_array, hstack

    every = csr_array(eye_array(pieces) - eye_array(pieces, k=1))
    every = every if at_start else every[:, 1:]
    if not seam:
        return every
    around = csr_array(([1.0, -1.0], ([0, pieces - 1], [0, 0])), shape=(pieces, 1))
    return csr_array(hstack([every, around]))
