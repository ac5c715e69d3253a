"""Laws of random disturbances, parameters and initial states for simulation: each draws admissible ones only, and none
of them proves anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.enclosures.dependence import Dependence
from sparserob_core.control.problem.problem import OptimalControlProblem
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.studies.simulate import worst_errors
from sparserob_core.control.transcription.terms.in_time import follow_in_time
from sparserob_core.control.transcription.terms.superposed import at_corners
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

LawName: TypeAlias = Literal["iid", "vertices", "slow", "neighbours"]
KNOTS = 6  # a slow disturbance is linear between at most so many extreme points
BASES = 48  # random worst cases that neighbours are made of, beside the adversaries
FLIPPED = 5  # pieces of a worst case that a neighbour changes, at most
MIXED = 0.2  # where a disturbance has too few blocks to flip: how far it is drawn towards an extreme point, at most
NEIGHBOUR_DISTANCE = 0.1  # how far the parameter of a neighbour is drawn towards a random one, at most


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertain quantities of a system: the disturbance (``None``: no disturbance), the parameters and the initial
    state, with the worst cases that were found.

    Parameters
    ----------
    functionals : WorstFunctionals
        Functionals of the system.
    parameters : ParameterIndex
        Set of the parameters.
    constraints : sequence of StateConstraint
        Constraints whose worst cases are drawn from.
    worst : tuple of ndarray
        Times ``(k,)``, directions ``(k, d)`` and parameters ``(k, nu)`` of functionals whose worst disturbances are
        known to matter.
    """

    functionals: WorstFunctionals
    parameters: ParameterIndex
    constraints: Sequence[StateConstraint]
    worst: tuple[Array, Array, Array]

    def bases(self, law: LawName, count: int, rng: np.random.Generator) -> np.ndarray | None:
        """The numbers ``(count,)`` of the worst cases that neighbours are near to; ``None`` for another law."""
        return rng.integers(0, self._bases[2].shape[0], size=count) if law == "neighbours" else None

    def directions(self, bases: np.ndarray) -> Array:
        """Return the directions ``(k, d)`` of the worst cases with the numbers ``bases (k,)``."""
        return np.asarray(self._bases[1][bases])

    def draw(
        self, law: LawName, count: int, rng: np.random.Generator, bases: np.ndarray | None = None
    ) -> tuple[Array | None, Array, Array | None]:
        """``count`` disturbances ``(count, mw, L)`` on the pieces of the merged grid (or ``None``), parameters
        ``(count, nu)``, and initial states ``(count, d)`` (``None``: there is one only); ``bases``: those of
        neighbours, drawn where none are given."""
        near = self.bases(law, count, rng) if bases is None else bases
        if near is not None:
            return self._draw_neighbours(near, rng)
        disturbances, parameters = self._draw_signals(law, count, rng)
        bound = self.functionals.initial
        if bound is None:
            return disturbances, parameters, None
        # slow is a law of signals; a state that is there at once is drawn as those of `iid`
        points = _sample_extreme if law == "vertices" else _sample_uniform
        return disturbances, parameters, self.functionals.response.initial_state + points(bound, count, rng)

    def errors(self, law: LawName, count: int, theta: Array, rng: np.random.Generator) -> Array | None:
        """``count`` errors ``(L, m, count)`` of what is delivered of the control of a decision, on the pieces of the
        merged grid; ``None`` where it is delivered as it is commanded. Neighbours are the worst
        errors of some functional, of the other sign on a few pieces."""
        execution = self.functionals.execution
        if execution is None or not execution.shares.any():
            return None
        sizes = self.functionals.bound_execution_errors(theta)
        m, pieces = sizes.shape
        if law == "neighbours":
            base = rng.integers(0, self._bases[2].shape[0], size=count)
            worst = worst_errors(self.functionals.response, sizes, self._bases)[:, :, base]
            return np.asarray(worst * np.where(rng.uniform(size=worst.shape) < FLIPPED / pieces, -1.0, 1.0))
        if law == "slow":
            breaks = self.functionals.response.grid.breakpoints
            hats = _evaluate_hats((breaks[:-1] + breaks[1:]) / (2 * breaks[-1]), KNOTS)
            shares = np.einsum("lk,kmn->lmn", hats, rng.choice([-1.0, 1.0], size=(KNOTS, m, count)))
        elif law == "vertices":
            shares = rng.choice([-1.0, 1.0], size=(pieces, m, count))
        else:
            shares = rng.uniform(-1.0, 1.0, size=(pieces, m, count))
        return np.asarray(sizes.T[:, :, None] * shares)

    def _draw_signals(self, law: LawName, count: int, rng: np.random.Generator) -> tuple[Array | None, Array]:
        """Disturbances and parameters of `draw`."""
        points = _sample_extreme if law == "vertices" else _sample_uniform
        parameters = np.zeros((count, 0)) if self.parameters.set is None else points(self.parameters.set, count, rng)
        model = self.functionals.disturbance
        if model is None:
            return None, parameters
        blocks = self._draw_slow_blocks(model, count, rng) if law == "slow" else _draw_blocks(model, count, rng, points)
        return model.signals(blocks), parameters

    def _draw_slow_blocks(self, model: DisturbanceModel, count: int, rng: np.random.Generator) -> Array:
        """Linear between extreme points of the set at equally spaced times, one to `KNOTS` of them: convex
        combinations, so admissible.

        Where a block is more than one piece the signal is projected on the span of the dictionary and drawn to the set
        along a ray.
        """
        breaks = model.grid.breakpoints
        middles = (breaks[:-1] + breaks[1:]) / (2 * breaks[-1])
        signal = np.empty((count, middles.size, model.channels))
        knots = rng.integers(1, KNOTS + 1, size=count)
        for number in range(1, KNOTS + 1):
            indices = np.flatnonzero(knots == number)
            if not indices.size:
                continue
            points = model.bound.sample_extreme(indices.size * number, rng).reshape(indices.size, number, -1)
            signal[indices] = np.einsum("lk,nki->nli", _evaluate_hats(middles, number), points)
        if model.starts is not None:
            return signal[:, model.starts]
        coefficients = np.einsum("nli,lj->nij", signal, np.linalg.pinv(np.asarray(model.functions)))
        if model.scale is None:
            return _pull_into_set(model.set, coefficients.reshape(count, 1, -1))
        return _pull_into_set(model.set, coefficients / np.where(model.scale > 0, model.scale, 1.0)[:, None])

    def _draw_neighbours(self, base: np.ndarray, rng: np.random.Generator) -> tuple[Array | None, Array, Array | None]:
        """The worst disturbance of random times and constraints with a few blocks replaced by extreme points, a
        parameter near its own, and the worst initial state, for some drawn towards an extreme one."""
        count = base.size
        disturbances, parameters = self._draw_neighbour_signals(base, rng)
        bound = self.functionals.initial
        if bound is None:
            return disturbances, parameters, None
        worst = self._worst_deviations[base]
        share = rng.uniform(0.0, MIXED, size=(count, 1)) * (rng.integers(0, 2, size=(count, 1)) > 0)
        deviations = worst + share * (bound.sample_extreme(count, rng) - worst)
        return disturbances, parameters, self.functionals.response.initial_state + deviations

    def _draw_neighbour_signals(self, base: np.ndarray, rng: np.random.Generator) -> tuple[Array | None, Array]:
        """Disturbances and parameters of `_draw_neighbours`."""
        bases, count = self._bases, base.size
        parameters = bases[2][base]
        if self.parameters.set is not None:
            share = rng.uniform(0.0, NEIGHBOUR_DISTANCE, size=(count, 1))
            parameters = parameters + share * (self.parameters.set.sample(count, rng) - parameters)
        model = self.functionals.disturbance
        if model is None:
            return None, parameters
        blocks, size = self._worst_blocks[base], model.block_count
        flips = min(FLIPPED, size)
        flipped = rng.integers(0, size, size=(count, flips))
        drawn = rng.integers(1, flips + 1, size=(count, 1)) > np.arange(flips)
        step = drawn[..., None] * (
            np.ones((count, flips, 1)) if size > FLIPPED else rng.uniform(0.0, MIXED, size=(count, flips, 1))
        )
        extreme = model.set.sample_extreme(count * flips, rng).reshape(count, flips, -1)
        trajectory = np.arange(count)
        for flip in range(flips):
            positions = flipped[:, flip]
            before = blocks[trajectory, positions]
            blocks[trajectory, positions] = before + step[:, flip] * (extreme[:, flip] - before)
        return model.signals(blocks), parameters

    @cached_property
    def _bases(self) -> tuple[Array, Array, Array]:
        """The known worst cases, and random ones: always the same, whatever is drawn from them."""
        rng = np.random.default_rng(0)
        bases = [self.worst]
        for constraint in self.constraints:
            box, number = constraint.index_set, -(-BASES // len(self.constraints))
            times, directions, parameters, _ = constraint.functionals_at(
                rng.uniform(box.lower, box.upper, size=(number, box.dimension))
            )
            chosen = np.arange(number) * (times.size // number) + rng.integers(0, times.size // number, size=number)
            bases.append((times[chosen], directions[chosen], parameters[chosen]))
        times, directions, parameters = (np.concatenate(columns) for columns in zip(*bases, strict=True))
        return times, directions, parameters

    @cached_property
    def _worst_deviations(self) -> Array:
        return self.functionals.worst_deviations(*self._bases)

    @cached_property
    def _worst_blocks(self) -> Array:
        return self.functionals.worst_blocks(*self._bases)


@dataclass(frozen=True, eq=False)
class ParametersInTime:
    """Parameters of a system that depends on the time and on parameters, in a ``box``.

    The state of such a problem also holds further states, by which the parameters act (`superposed`). ``every`` gives
    the states of the user at each corner of the box, as rows ``(d, size)``.
    """

    box: Box
    depends: Dependence
    every: Sequence[Array]

    @staticmethod
    def of(problem: OptimalControlProblem) -> ParametersInTime | None:
        """Return the parameters of a problem as the user gave it; ``None`` unless its system depends on the time and on
        parameters."""
        corners, system = at_corners(problem), follow_in_time(problem).system
        if corners is None or system.dependence is None:
            return None
        return ParametersInTime(system.box, system.dependence, corners)

    def draw(self, law: LawName, count: int, directions: Array | None, rng: np.random.Generator) -> Array:
        """Draw ``count`` parameters as rows on all states, ``(count, d, size)``.

        Neighbours are near the corners that belong to the ``directions (count, size or more)``, one row each.
        """
        drawn, units = (
            (_sample_extreme if law == "vertices" else _sample_uniform)(self.box, count, rng),
            self.depends.units,
        )
        shares = (drawn - self.depends.centre) / np.where(units > 0.0, units, 1.0)
        rows = np.stack([self.depends.rows(share) for share in shares])
        if directions is None:
            return rows
        corner_rows = np.stack([self.find_corner(direction) for direction in directions])
        return np.asarray(corner_rows + rng.uniform(0.0, NEIGHBOUR_DISTANCE, size=(count, 1, 1)) * (rows - corner_rows))

    def find_corner(self, direction: Array) -> Array:
        """Return the corner, as rows ``(d, size)``, that belongs to a ``direction (size or more,)`` on all states; any
        one of the corners that the direction does not distinguish."""
        d, size = self.every[0].shape
        residuals = [np.abs(direction[:d] @ corner - direction[:size]).max() for corner in self.every]
        return self.every[int(np.argmin(residuals))]

    def at(self, states: Array, rows: Array) -> Array:
        """Return all ``states (size or more, n)`` at parameters, given as ``rows (n or 1, d, size)``.

        The further states, by which the parameters act, become 0, so that all corners have the same states. Integrals
        of the states stay those of the corners.
        """
        d, size = self.every[0].shape
        all_states = states.copy()
        all_states[:d], all_states[d:size] = (rows @ states[:size].T[:, :, None])[:, :, 0].T, 0.0
        return all_states


def _draw_blocks(
    model: DisturbanceModel,
    count: int,
    rng: np.random.Generator,
    points: Callable[[ConvexSet, int, np.random.Generator], Array],
) -> Array:
    return points(model.set, count * model.block_count, rng).reshape(count, model.block_count, -1)


def _sample_uniform(convex: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    return convex.sample(count, rng)


def _sample_extreme(convex: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    return convex.sample_extreme(count, rng)


def _evaluate_hats(places: Array, knots: int) -> Array:
    """Weights ``(l, knots)`` of linear interpolation at places in ``[0, 1]`` between equally spaced knots."""
    at = places * (knots - 1)
    return np.clip(1.0 - np.abs(at[:, None] - np.arange(knots)), 0.0, None)


def _pull_into_set(convex: ConvexSet, points: Array) -> Array:
    flat = points.reshape(-1, points.shape[-1])
    middle = convex.interior_point()
    return (middle + (flat - middle) / np.maximum(convex.gauge(flat), 1.0)[:, None]).reshape(points.shape)


def noises(bound: ConvexSet | None, law: LawName, count: int, measured: int, rng: np.random.Generator) -> Array | None:
    """``count`` noises ``(measured, p, count)`` of what is measured one time after another, each on its own: extreme
    points of the set where the law is of such, else uniform ones; ``None`` where there is no noise."""
    if bound is None:
        return None
    points = (_sample_extreme if law == "vertices" else _sample_uniform)(bound, count * measured, rng)
    return np.ascontiguousarray(points.reshape(count, measured, -1).transpose(1, 2, 0))
