"""State constraints for finitely many sampled disturbances and parameters: what the scenario approach imposes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.constraints.flat import KEPT
from sparserob_core.control.constraints.local_maxima import local_maxima, vertices
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.response import SAME_TIME, Response, distinct_times
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import ConstraintFamily, Explanation, Separation

BLOCK = 2_000_000  # sampled violations that are held at once


@dataclass(frozen=True, eq=False)
class ScenarioConstraint:
    """``H x(t) <= h`` for all times of a window and for ``S`` samples only, with what the ``base`` has beside the
    state; the index is ``(t, sample number)``.

    ``H (r, d)``, ``h (r,)`` are the sides of the constraint ``base``; ``disturbances (S, mw, L)`` on the pieces of the
    merged grid or ``None``; ``parameters (S, nu)``; ``deviations (S, d)`` of the initial state or ``None``. Errors of
    execution are the worst ones in every sample.
    """

    base: StateConstraint
    H: Array
    h: Array
    disturbances: Array | None
    parameters: Array
    deviations: Array | None = None

    def family(self) -> ConstraintFamily:
        """The constraint as a family."""
        last = float(self.parameters.shape[0] - 1)
        index_set = Box(np.array([self.base.start, 0.0]), np.array([self.base.stop, last]))
        return ConstraintFamily(
            name=self.base.name,
            index_set=index_set,
            rows=self.rows,
            worst=self.worst,
            formulation="sampled",
            explain=self.explain,
            measured=self.base.measured,
            along=self.base.functionals.names.time,
            source=self.base,
        )

    def explain(self, index: Array, row: int) -> Explanation:
        """One row at a time, for one sample."""
        sample = round(float(index[1]))
        return self.base.explain(np.append(index[0], self.parameters[sample]), row).of_sample(sample)

    def rows(self, indices: Array) -> tuple[Array, Array]:
        """``G (k, r, n)``, ``rhs (k, r)`` at indices ``(k, 2)``."""
        k, r = indices.shape[0], self.h.size
        which = np.repeat(np.rint(indices[:, 1]).astype(int), r)
        times, directions = np.repeat(indices[:, 0], r), np.tile(self.H, (k, 1))
        signals = None if self.disturbances is None else self.disturbances[which]
        begun = np.zeros(directions.shape) if self.deviations is None else self.deviations[which]
        G, offset = self.base.functionals.rows_under(times, directions, self.parameters[which], signals, begun)
        direct, still = self.base.direct(indices[:, 0]), np.zeros(self.base.functionals.variables)
        G = G if direct is None else G + direct
        return G.reshape(k, r, -1), self.h - self.base.beside(still, indices[:, 0]) - offset.reshape(k, r)

    def worst(self, x: Array) -> Separation:
        """Local maxima in time of the worst sample's violation, at the breakpoints and between them."""
        values, sample = self._worst_samples(x)
        positions = local_maxima(values[None], (1,), KEPT)
        times = vertices(values[None], positions, self._times)[0]
        rows = positions[:, 1]
        indices = np.stack([times, sample[rows, positions[:, 2]].astype(float)], axis=1)
        G, h = self.rows(indices)
        found = (G @ x - h)[np.arange(rows.size), rows]
        order = np.argsort(-found, kind="stable")
        return Separation(indices[order], rows[order], found[order])

    def _worst_samples(self, x: Array) -> tuple[Array, np.ndarray]:
        """Largest violation over the samples, ``(r, times)``, and the sample that has it."""
        beside = self.base.beside(x, self._times).T
        if self.parameters.shape[1] == 0:
            margins, sample = self._known
            undisturbed = self._states(x, slice(0, 1), None, None)[0]
            return self.H @ undisturbed.T - margins + beside + self._missed(x, slice(0, 1))[0], sample
        values, sample = self._maximum(
            lambda part: self._states(x, part, self.disturbances, self.deviations), lambda part: self._missed(x, part)
        )
        return values + beside, sample

    def _missed(self, x: Array, part: slice) -> Array:
        """What errors of execution add in some samples, ``(s, r, times)``: their worst is known, and none are drawn."""
        functionals, parameters = self.base.functionals, self.parameters[part]
        samples, r, times = len(parameters), self.h.size, self._times.size
        if functionals.execution is None:
            return np.zeros((samples, r, times))
        rows, at = np.tile(self.H, (samples * times, 1)), np.tile(np.repeat(self._times, r), samples)
        along = functionals.execution.seen(rows, np.repeat(parameters, times * r, axis=0))
        added = functionals.execution.added(functionals.control(x), at, along)
        return np.asarray(added.reshape(samples, times, r).swapaxes(1, 2))

    @cached_property
    def _known(self) -> tuple[Array, np.ndarray]:
        """For a known system: ``h - max_s H d_s(t)``, and the maximising samples; it does not depend on the
        decision."""
        if self.disturbances is None and self.deviations is None:
            return np.repeat(self.h[:, None], self._times.size, axis=1), np.zeros(
                (self.h.size, self._times.size), dtype=int
            )
        still = np.zeros(self.base.functionals.variables)
        rest = self._states(still, slice(0, 1), None, None)
        worst, sample = self._maximum(lambda part: self._states(still, part, self.disturbances, self.deviations) - rest)
        return -worst, sample

    def _maximum(
        self, states: Callable[[slice], Array], more: Callable[[slice], Array] | None = None
    ) -> tuple[Array, np.ndarray]:
        """``max_s H x_s(t) - h`` over the samples, with what is ``more`` of it, block by block, and where it is
        attained."""
        samples, r, times = self.parameters.shape[0], self.h.size, self._times.size
        best, where = np.full((r, times), -np.inf), np.zeros((r, times), dtype=int)
        size = max(1, BLOCK // (r * times))
        for start in range(0, samples, size):
            part = slice(start, start + size)
            values = np.einsum("ri,sti->srt", self.H, states(part)) - self.h[:, None]
            values = values if more is None else values + more(part)
            top = values.argmax(axis=0)
            height = np.take_along_axis(values, top[None], axis=0)[0]
            where = np.where(height > best, start + top, where)
            best = np.maximum(best, height)
        return best, where

    def _states(self, x: Array, part: slice, disturbances: Array | None, deviations: Array | None) -> Array:
        """States ``(s, times, d)`` of some samples."""
        signal, begun = (None if drawn is None else drawn[part] for drawn in (disturbances, deviations))
        path = self._fine.states(self.base.functionals.on_grid(x), self.parameters[part], signal, begun)
        return path[:, self._kept]

    @cached_property
    def _fine(self) -> Response:
        """The response on the grid's breakpoints, the window's ends and the middles between them."""
        response, base = self.base.functionals.response, self.base
        points = distinct_times(
            np.concatenate([response.grid.breakpoints, [base.start, base.stop]]), response.grid.breakpoints[-1]
        )
        points = np.sort(np.concatenate([points, (points[:-1] + points[1:]) / 2]))
        return Response(response.system, response.grid.refined(points), response.initial_state)

    @cached_property
    def _kept(self) -> np.ndarray:
        points = self._fine.grid.breakpoints
        slack = SAME_TIME * points[-1]
        return np.flatnonzero((points >= self.base.start - slack) & (points <= self.base.stop + slack))

    @cached_property
    def _times(self) -> Array:
        answer: Array = np.clip(self._fine.grid.breakpoints[self._kept], self.base.start, self.base.stop)
        return answer


def sample_disturbances(model: DisturbanceModel, count: int, rng: np.random.Generator) -> Array:
    """``count`` disturbances ``(count, mw, L)`` on the grid's pieces: every block uniform in its set, independent of
    the others."""
    blocks = model.block_count
    points = model.set.sample(count * blocks, rng).reshape(count, blocks, -1)
    return model.signals(points)


def sample_parameters(convex_set: ConvexSet | None, count: int, rng: np.random.Generator) -> Array:
    """``count`` parameters ``(count, nu)``, uniform in their set."""
    return np.zeros((count, 0)) if convex_set is None else convex_set.sample(count, rng)
