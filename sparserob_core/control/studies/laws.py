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
from sparserob_core.control.reach.functional import WorstCase
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.studies.simulate import worst_errors
from sparserob_core.control.transcription.terms.in_time import in_time
from sparserob_core.control.transcription.terms.superposed import at_corners
from sparserob_core.sip.convex_set import Array, Box, ConvexSet

LawName: TypeAlias = Literal["iid", "vertices", "slow", "neighbours"]
KNOTS = 6  # a slow disturbance is linear between at most so many extreme points
BASES = 48  # random worst cases that neighbours are made of, beside the adversaries
FLIPPED = 5  # pieces of a worst case that a neighbour changes, at most
MIXED = 0.2  # where a disturbance has too few blocks to flip: how far it is drawn towards an extreme point, at most
NEAR = 0.1  # how far the parameter of a neighbour is drawn towards a random one, at most


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is uncertain in a system: the disturbance (``None``: nothing), the parameters and the initial state, and the
    worst cases found of them.

    ``worst``: times ``(k,)``, directions ``(k, d)`` and parameters ``(k, nu)`` of functionals whose worst disturbances
    are known to matter.
    """

    functionals: WorstCase
    parameters: ParameterIndex
    constraints: Sequence[StateConstraint]
    worst: tuple[Array, Array, Array]

    def bases(self, law: LawName, count: int, rng: np.random.Generator) -> np.ndarray | None:
        """The numbers ``(count,)`` of the worst cases that neighbours are near to; ``None`` for another law."""
        return rng.integers(0, self._bases[2].shape[0], size=count) if law == "neighbours" else None

    def directions(self, bases: np.ndarray) -> Array:
        """Those of these worst cases, ``(k, d)``."""
        return np.asarray(self._bases[1][bases])

    def draw(
        self, law: LawName, count: int, rng: np.random.Generator, bases: np.ndarray | None = None
    ) -> tuple[Array | None, Array, Array | None]:
        """``count`` disturbances ``(count, mw, L)`` on the pieces of the merged grid (or ``None``), parameters
        ``(count, nu)``, and initial states ``(count, d)`` (``None``: there is one only); ``bases``: those of
        neighbours, drawn where none are given."""
        near = self.bases(law, count, rng) if bases is None else bases
        if near is not None:
            return self._neighbours(near, rng)
        disturbances, parameters = self._drawn(law, count, rng)
        bound = self.functionals.initial
        if bound is None:
            return disturbances, parameters, None
        # slow is a law of signals; a state that is there at once is drawn as those of `iid`
        points = _extreme if law == "vertices" else _uniform
        return disturbances, parameters, self.functionals.response.initial_state + points(bound, count, rng)

    def errors(self, law: LawName, count: int, command: Array, rng: np.random.Generator) -> Array | None:
        """``count`` errors ``(L, m, count)`` of what is delivered of a ``command (m + constants, L)``, as shares of it
        on the pieces of the merged grid; ``None`` where it is delivered as it is commanded. Neighbours are the worst
        errors of some functional, of the other sign on a few pieces."""
        execution = self.functionals.execution
        if execution is None or not execution.shares.any():
            return None
        pieces, m = command.shape[1], execution.shares.size
        if law == "neighbours":
            base = rng.integers(0, self._bases[2].shape[0], size=count)
            found = worst_errors(self.functionals.response, execution, command, self._bases)[:, :, base]
            return np.asarray(found * np.where(rng.uniform(size=found.shape) < FLIPPED / pieces, -1.0, 1.0))
        if law == "slow":
            breaks = self.functionals.response.grid.breakpoints
            hats = _hats((breaks[:-1] + breaks[1:]) / (2 * breaks[-1]), KNOTS)
            shares = np.einsum("lk,kmn->lmn", hats, rng.choice([-1.0, 1.0], size=(KNOTS, m, count)))
        elif law == "vertices":
            shares = rng.choice([-1.0, 1.0], size=(pieces, m, count))
        else:
            shares = rng.uniform(-1.0, 1.0, size=(pieces, m, count))
        return np.asarray(execution.shares[:, None] * shares)

    def _drawn(self, law: LawName, count: int, rng: np.random.Generator) -> tuple[Array | None, Array]:
        """Disturbances and parameters of `draw`."""
        points = _extreme if law == "vertices" else _uniform
        parameters = np.zeros((count, 0)) if self.parameters.set is None else points(self.parameters.set, count, rng)
        model = self.functionals.disturbance
        if model is None:
            return None, parameters
        blocks = self._slow(model, count, rng) if law == "slow" else _every_block(model, count, rng, points)
        return model.signals(blocks), parameters

    def _slow(self, model: DisturbanceModel, count: int, rng: np.random.Generator) -> Array:
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
            here = np.flatnonzero(knots == number)
            if not here.size:
                continue
            points = model.bound.sample_extreme(here.size * number, rng).reshape(here.size, number, -1)
            signal[here] = np.einsum("lk,nki->nli", _hats(middles, number), points)
        if model.starts is not None:
            return signal[:, model.starts]
        coefficients = np.einsum("nli,lj->nij", signal, np.linalg.pinv(np.asarray(model.functions)))
        if model.scale is None:
            return _drawn_in(model.set, coefficients.reshape(count, 1, -1))
        return _drawn_in(model.set, coefficients / np.where(model.scale > 0, model.scale, 1.0)[:, None])

    def _neighbours(self, base: np.ndarray, rng: np.random.Generator) -> tuple[Array | None, Array, Array | None]:
        """The worst disturbance of random times and constraints with a few blocks replaced by extreme points, a
        parameter near its own, and the worst initial state, for some drawn towards an extreme one."""
        count = base.size
        disturbances, parameters = self._near(base, rng)
        bound = self.functionals.initial
        if bound is None:
            return disturbances, parameters, None
        worst = self._worst_deviations[base]
        share = rng.uniform(0.0, MIXED, size=(count, 1)) * (rng.integers(0, 2, size=(count, 1)) > 0)
        deviations = worst + share * (bound.sample_extreme(count, rng) - worst)
        return disturbances, parameters, self.functionals.response.initial_state + deviations

    def _near(self, base: np.ndarray, rng: np.random.Generator) -> tuple[Array | None, Array]:
        """Disturbances and parameters of `_neighbours`."""
        bases, count = self._bases, base.size
        parameters = bases[2][base]
        if self.parameters.set is not None:
            near = rng.uniform(0.0, NEAR, size=(count, 1))
            parameters = parameters + near * (self.parameters.set.sample(count, rng) - parameters)
        model = self.functionals.disturbance
        if model is None:
            return None, parameters
        blocks, size = self._worst_blocks[base], model.block_count
        flips = min(FLIPPED, size)
        which = rng.integers(0, size, size=(count, flips))
        drawn = rng.integers(1, flips + 1, size=(count, 1)) > np.arange(flips)
        step = drawn[..., None] * (
            np.ones((count, flips, 1)) if size > FLIPPED else rng.uniform(0.0, MIXED, size=(count, flips, 1))
        )
        extreme = model.set.sample_extreme(count * flips, rng).reshape(count, flips, -1)
        trajectory = np.arange(count)
        for flip in range(flips):
            place = which[:, flip]
            before = blocks[trajectory, place]
            blocks[trajectory, place] = before + step[:, flip] * (extreme[:, flip] - before)
        return model.signals(blocks), parameters

    @cached_property
    def _bases(self) -> tuple[Array, Array, Array]:
        """The known worst cases, and random ones: always the same, whatever is drawn from them."""
        rng = np.random.default_rng(0)
        found = [self.worst]
        for constraint in self.constraints:
            box, number = constraint.index_set, -(-BASES // len(self.constraints))
            times, directions, parameters, _ = constraint.functionals_at(
                rng.uniform(box.lower, box.upper, size=(number, box.dimension))
            )
            pick = np.arange(number) * (times.size // number) + rng.integers(0, times.size // number, size=number)
            found.append((times[pick], directions[pick], parameters[pick]))
        times, directions, parameters = (np.concatenate(parts) for parts in zip(*found, strict=True))
        return times, directions, parameters

    @cached_property
    def _worst_deviations(self) -> Array:
        return self.functionals.worst_deviations(*self._bases)

    @cached_property
    def _worst_blocks(self) -> Array:
        return self.functionals.worst_blocks(*self._bases)


@dataclass(frozen=True, eq=False)
class ParametersInTime:
    """Parameters beside the time, in a ``box``, of a problem whose states hold what each of them adds (`superposed`):
    ``every``: the stated states at each corner of the box, ``(d, size)`` each."""

    box: Box
    depends: Dependence
    every: Sequence[Array]

    @staticmethod
    def of(problem: OptimalControlProblem) -> ParametersInTime | None:
        """Those of a problem as it was stated; ``None`` where it has none."""
        every, system = at_corners(problem), in_time(problem).system
        if every is None or system.dependence is None:
            return None
        return ParametersInTime(system.box, system.dependence, every)

    def draw(self, law: LawName, count: int, directions: Array | None, rng: np.random.Generator) -> Array:
        """``count`` of them as rows on all states, ``(count, d, size)``: those of neighbours are near the corners that
        the ``directions (count, size or more)`` look at, each that of a row."""
        drawn, units = (_extreme if law == "vertices" else _uniform)(self.box, count, rng), self.depends.units
        shares = (drawn - self.depends.centre) / np.where(units > 0.0, units, 1.0)
        found = np.stack([self.depends.rows(one) for one in shares])
        if directions is None:
            return found
        looked = np.stack([self.seen(one) for one in directions])
        return np.asarray(looked + rng.uniform(0.0, NEAR, size=(count, 1, 1)) * (found - looked))

    def seen(self, direction: Array) -> Array:
        """The corner, as rows ``(d, size)``, that a ``direction (size or more,)`` on all states looks at; any of those
        that it does not tell apart."""
        d, size = self.every[0].shape
        missed = [np.abs(direction[:d] @ one - direction[:size]).max() for one in self.every]
        return self.every[int(np.argmin(missed))]

    def at(self, states: Array, rows: Array) -> Array:
        """All ``states (size or more, n)`` at parameters, ``rows (n or 1, d, size)``: nothing is left for these to add,
        so that every corner sees the same states. What is integrated of them stays that of the corners."""
        d, size = self.every[0].shape
        found = states.copy()
        found[:d], found[d:size] = (rows @ states[:size].T[:, :, None])[:, :, 0].T, 0.0
        return found


def admissibility(model: DisturbanceModel, signals: Array) -> Array:
    """By how much disturbances ``(n, mw, L)`` on the merged grid miss being admissible, ``(n,)``; at most rounding when
    they are."""
    if model.starts is not None:
        values = signals.swapaxes(1, 2)
        uneven = np.abs(signals - model.signals(values[:, model.starts])).max(axis=(1, 2))
        return np.asarray(np.maximum(model.bound.violation(values).max(axis=1), uneven))
    functions = np.asarray(model.functions)
    coefficients = signals @ np.linalg.pinv(functions)
    outside = np.abs(coefficients @ functions - signals).max(axis=(1, 2))
    if model.scale is not None:
        used = np.abs(coefficients).sum(axis=2) - model.scale
        return np.asarray(np.maximum(used.max(axis=1), outside))
    return np.asarray(np.maximum(model.set.violation(coefficients.reshape(signals.shape[0], -1)), outside))


def _every_block(
    model: DisturbanceModel,
    count: int,
    rng: np.random.Generator,
    points: Callable[[ConvexSet, int, np.random.Generator], Array],
) -> Array:
    return points(model.set, count * model.block_count, rng).reshape(count, model.block_count, -1)


def _uniform(convex: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    return convex.sample(count, rng)


def _extreme(convex: ConvexSet, count: int, rng: np.random.Generator) -> Array:
    return convex.sample_extreme(count, rng)


def _hats(places: Array, knots: int) -> Array:
    """Weights ``(l, knots)`` of linear interpolation at places in ``[0, 1]`` between equally spaced knots."""
    at = places * (knots - 1)
    return np.clip(1.0 - np.abs(at[:, None] - np.arange(knots)), 0.0, None)


def _drawn_in(convex: ConvexSet, points: Array) -> Array:
    flat = points.reshape(-1, points.shape[-1])
    middle = convex.interior_point()
    return (middle + (flat - middle) / np.maximum(convex.gauge(flat), 1.0)[:, None]).reshape(points.shape)


def noises(bound: ConvexSet | None, law: LawName, count: int, measured: int, rng: np.random.Generator) -> Array | None:
    """``count`` noises ``(measured, p, count)`` of what is measured one time after another, each on its own: extreme
    points of the set where the law is of such, else uniform ones; ``None`` where there is no noise."""
    if bound is None:
        return None
    points = (_extreme if law == "vertices" else _uniform)(bound, count * measured, rng)
    return np.ascontiguousarray(points.reshape(count, measured, -1).transpose(1, 2, 0))
