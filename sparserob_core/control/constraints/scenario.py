"""State constraints for finitely many sampled disturbances and parameters: what the scenario approach imposes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.constraints.flat import SEPARATED_CONSTRAINTS_PER_ROW
from sparserob_core.control.constraints.local_maxima import local_maxima, vertices
from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import SAME_TIME, distinct_times
from sparserob_core.sip.convex_set import Array, Box, ConvexSet
from sparserob_core.sip.program import ConstraintFamily, Explanation, Separation

MAX_VIOLATIONS_PER_BLOCK = 2_000_000  # sampled violations that are held at once


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
        """Return the constraint as a family."""
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
        """Return the description of one row at a time, for one sample."""
        sample = round(float(index[1]))
        return self.base.explain(np.append(index[0], self.parameters[sample]), row).of_sample(sample)

    def rows(self, indices: Array) -> tuple[Array, Array]:
        """Return ``G (k, r, n)``, ``rhs (k, r)`` at indices ``(k, 2)``."""
        k, r = indices.shape[0], self.h.size
        samples = np.repeat(np.rint(indices[:, 1]).astype(int), r)
        times, directions = np.repeat(indices[:, 0], r), np.tile(self.H, (k, 1))
        signals = None if self.disturbances is None else self.disturbances[samples]
        deviations = np.zeros(directions.shape) if self.deviations is None else self.deviations[samples]
        G, offset = self.base.functionals.rows_under(times, directions, self.parameters[samples], signals, deviations)
        direct, zero_decision = self.base.direct(indices[:, 0]), np.zeros(self.base.functionals.variables)
        G = G if direct is None else G + direct
        return G.reshape(k, r, -1), self.h - self.base.compute_added_terms(
            zero_decision, indices[:, 0]
        ) - offset.reshape(k, r)

    def worst(self, x: Array) -> Separation:
        """Return local maxima in time of the worst sample's violation, at the breakpoints and between them."""
        values, sample = self._find_worst_samples(x)
        positions = local_maxima(values[None], (1,), SEPARATED_CONSTRAINTS_PER_ROW)
        times = vertices(values[None], positions, self._times)[0]
        rows = positions[:, 1]
        indices = np.stack([times, sample[rows, positions[:, 2]].astype(float)], axis=1)
        G, h = self.rows(indices)
        violations = (G @ x - h)[np.arange(rows.size), rows]
        order = np.argsort(-violations, kind="stable")
        return Separation(indices[order], rows[order], violations[order])

    def _find_worst_samples(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the largest violation over the samples, ``(r, times)``, and the sample that has it."""
        additions = self.base.compute_added_terms(x, self._times).T
        if self.parameters.shape[1] == 0:
            margins, sample = self._margins
            undisturbed = self._compute_states(x, slice(0, 1), None, None)[0]
            return self.H @ undisturbed.T - margins + additions + self._compute_execution_errors(x, slice(0, 1))[
                0
            ], sample
        values, sample = self._maximise_over_samples(
            lambda chunk: self._compute_states(x, chunk, self.disturbances, self.deviations),
            lambda chunk: self._compute_execution_errors(x, chunk),
        )
        return values + additions, sample

    def _compute_execution_errors(self, x: Array, part: slice) -> Array:
        """Return the contribution of the worst errors of execution in some samples, ``(s, r, times)``; the worst is
        known, so that no errors are drawn."""
        functionals, parameters = self.base.functionals, self.parameters[part]
        samples, r, times = len(parameters), self.h.size, self._times.size
        if functionals.execution is None:
            return np.zeros((samples, r, times))
        rows, at = np.tile(self.H, (samples * times, 1)), np.tile(np.repeat(self._times, r), samples)
        along = functionals.execution.extend_directions(rows, np.repeat(parameters, times * r, axis=0))
        contributions = functionals.execution.added(functionals.control(x), at, along)
        return np.asarray(contributions.reshape(samples, times, r).swapaxes(1, 2))

    @cached_property
    def _margins(self) -> tuple[Array, np.ndarray]:
        """Margins ``h - max_s H d_s(t)`` of a known system, and the maximising samples, ``(r, times)`` each; they do
        not depend on the decision."""
        if self.disturbances is None and self.deviations is None:
            return np.repeat(self.h[:, None], self._times.size, axis=1), np.zeros(
                (self.h.size, self._times.size), dtype=int
            )
        zero_decision = np.zeros(self.base.functionals.variables)
        undisturbed = self._compute_states(zero_decision, slice(0, 1), None, None)
        worst, sample = self._maximise_over_samples(
            lambda chunk: self._compute_states(zero_decision, chunk, self.disturbances, self.deviations) - undisturbed
        )
        return -worst, sample

    def _maximise_over_samples(
        self, states: Callable[[slice], Array], more: Callable[[slice], Array] | None = None
    ) -> tuple[Array, np.ndarray]:
        """Return ``max_s H x_s(t) - h`` over the samples, plus the term ``more``, block by block, and the maximising
        samples."""
        samples, r, times = self.parameters.shape[0], self.h.size, self._times.size
        best, best_sample = np.full((r, times), -np.inf), np.zeros((r, times), dtype=int)
        size = max(1, MAX_VIOLATIONS_PER_BLOCK // (r * times))
        for start in range(0, samples, size):
            chunk = slice(start, start + size)
            values = np.einsum("ri,sti->srt", self.H, states(chunk)) - self.h[:, None]
            values = values if more is None else values + more(chunk)
            highest = values.argmax(axis=0)
            height = np.take_along_axis(values, highest[None], axis=0)[0]
            best_sample = np.where(height > best, start + highest, best_sample)
            best = np.maximum(best, height)
        return best, best_sample

    def _compute_states(self, x: Array, part: slice, disturbances: Array | None, deviations: Array | None) -> Array:
        """Return states ``(s, times, d)`` of some samples."""
        signal, deviation = (None if samples is None else samples[part] for samples in (disturbances, deviations))
        path = self._fine_response.states(self.base.functionals.on_grid(x), self.parameters[part], signal, deviation)
        return path[:, self._window_positions]

    @cached_property
    def _fine_response(self) -> Response:
        """The response on the grid's breakpoints, the window's ends and the middles between them."""
        response, base = self.base.functionals.response, self.base
        points = distinct_times(
            np.concatenate([response.grid.breakpoints, [base.start, base.stop]]), response.grid.breakpoints[-1]
        )
        points = np.sort(np.concatenate([points, (points[:-1] + points[1:]) / 2]))
        return Response(response.system, response.grid.refined(points), response.initial_state)

    @cached_property
    def _window_positions(self) -> np.ndarray:
        points = self._fine_response.grid.breakpoints
        slack = SAME_TIME * points[-1]
        return np.flatnonzero((points >= self.base.start - slack) & (points <= self.base.stop + slack))

    @cached_property
    def _times(self) -> Array:
        answer: Array = np.clip(
            self._fine_response.grid.breakpoints[self._window_positions], self.base.start, self.base.stop
        )
        return answer


def sample_disturbances(model: DisturbanceModel, count: int, rng: np.random.Generator) -> Array:
    """Return ``count`` disturbances ``(count, mw, L)`` on the grid's pieces: every block uniform in its set,
    independent of the others."""
    blocks = model.block_count
    points = model.set.sample(count * blocks, rng).reshape(count, blocks, -1)
    return model.signals(points)


def sample_parameters(convex_set: ConvexSet | None, count: int, rng: np.random.Generator) -> Array:
    """Return ``count`` parameters ``(count, nu)``, uniform in their set."""
    return np.zeros((count, 0)) if convex_set is None else convex_set.sample(count, rng)
