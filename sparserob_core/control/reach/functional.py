"""Worst-case functionals of the state: the largest ``c'x(t; theta, w, p)`` over disturbances ``w`` and initial states,
split into what the control does and what it cannot help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.enclosures.taylor import Combination
from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.reach.disturbance_support import DisturbanceSupport
from sparserob_core.control.reach.support import InitialSupport, Support, Supports
from sparserob_core.control.reach.varying_motion import (
    SpreadMotion,
    SpreadSupport,
    VaryingMotion,
    VaryingSupport,
)
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.lifted import LiftedSystem, frozen, lift_legs
from sparserob_core.control.response.response import Response, TimeGrid, Weights
from sparserob_core.errors import NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from sparserob_core.control.reach.execution import Execution
    from sparserob_core.control.reach.measurable import MeasurableSupport
    from sparserob_core.control.reach.varying_measurable import VaryingMeasurable

# said where it is met, and before anything is solved
WITHOUT_PROOF = (
    "measurable disturbances are proven only beside parameters in a box over which the state can be expanded in them,"
    " and where it is no affine function of these only for sets with flat sides"
)
HALVINGS = 8  # of a part of the parameters, after which states that still have no bound on a cell have none
LEGS_KEPT = 256  # cells of parameters whose lifted systems are kept
Leg: TypeAlias = LiftedSystem | VaryingMotion | SpreadMotion
CHUNK = 4_000_000  # entries of a gain array that are built at once (32 MB)
# Numbers of a product over many directions that are made at once (2 MB), so that they stay near the processor. With
# sixteen times as many a curved wall is sampled in up to twice the time; with a fourth part of them in no less.
NEAR = 250_000


@dataclass(frozen=True, eq=False)
class Parts:
    """What the largest ``c'x(t)`` at one index is made of, beside the control: what the centre of the initial states
    gives (``free``), what the worst disturbance and the worst initial state add together (``sigma``, of which ``begun``
    is the initial state's), and these: ``disturbance (mw, L)`` on the pieces of the merged grid, and ``deviation (d,)``
    from the centre; ``None`` where there is none."""

    free: float
    sigma: float
    begun: float
    disturbance: Array | None
    deviation: Array | None


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The functionals ``c'x(t)`` of one system under its worst disturbance, from the worst initial state.

    The initial states are that of the response plus ``initial``, a set of deviations; what the worst of them adds is
    the set's support function of ``e^{A't} c``.

    Indices are given as ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``; the decision is ``theta``
    raveled, ``(m N,)``. ``names``: what the states are called where a functional is explained. ``execution``: the
    errors with which the control is delivered; the decision then goes on with a bound of the absolute value of every
    channel on every piece, ``(m K,)``, in which rows are linear.
    """

    response: Response
    dictionary: Dictionary
    disturbance: DisturbanceModel | None
    shared: MeasurableSupport | VaryingMeasurable | None = field(default=None, repr=False)
    names: Names = UNNAMED
    initial: ConvexSet | None = None
    execution: Execution | None = None

    @shaped
    def from_state(self, initial_state: Float[Array, " d"]) -> WorstCase:
        """The functionals from another initial state ``(d,)``; what does not depend on it is shared."""
        return replace(self, response=self.response.from_state(initial_state), shared=self.measurable)

    @cached_property
    def channels(self) -> int:
        """Number ``m`` of controls; ``B`` may have columns of constants beyond them."""
        return self.response.system.controls - self.response.grid.constants

    @property
    def disturbed(self) -> bool:
        """Whether there is a disturbance, or more than one initial state."""
        return self.disturbance is not None or self.initial is not None

    @cached_property
    def variables(self) -> int:
        """Entries of the decision."""
        return self.coefficients + (0 if self.execution is None else self.execution.size)

    @property
    def coefficients(self) -> int:
        """Entries ``m N`` of the decision that are those of the control."""
        return self.channels * self.dictionary.functions

    @shaped
    def control(self, decision: Float[Array, " n"]) -> Float[Array, "m K"]:
        """The control on the pieces of its dictionary."""
        return self.dictionary.control(decision[: self.coefficients])

    @shaped
    def decided_by(self, theta: Float[Array, "m N"]) -> Float[Array, " n"]:
        """The decision of which a control's coefficients are ``theta``."""
        if self.execution is None:
            return theta.ravel()
        return np.concatenate([theta.ravel(), np.abs(self.dictionary.control(theta.ravel())).ravel()])

    @cached_property
    def known(self) -> Array:
        """What acts through the columns of ``B`` where nothing is decided, ``(m + constants, L)``: a drift, and the
        control before the first one acts; 0 elsewhere."""
        return self.response.grid.inputs(np.zeros((self.channels, self.dictionary.pieces)))

    def central(self) -> WorstCase:
        """The functionals along the nominal trajectory: the disturbance and the initial state at the `nominal_point` of
        their sets; the parameters stay in the index."""
        response, model = self.response, self.disturbance
        if self.initial is not None:
            response = response.from_state(response.initial_state + nominal_point(self.initial))
        held = None if model is None else model.held(nominal_point(model.bound))
        return replace(self, response=response, disturbance=held, shared=None, initial=None, execution=self._exactly)

    def nominal(self) -> WorstCase:
        """The functionals of the system at an interior point of its parameters, from the centre of the initial states,
        under one admissible disturbance: none, where it may be."""
        return self._nominal

    @cached_property
    def _nominal(self) -> WorstCase:
        system, model = self.response.system, self.disturbance
        if model is not None:
            zero = np.zeros(model.channels)
            model = model.held(zero if model.bound.contains(zero) else model.bound.interior_point())
        response, exact = self.response, self._exactly
        if system.parameters is not None:
            response = response.at(system.parameters.interior_point())
        if system.varies:
            return replace(self, response=response, disturbance=model, initial=None, shared=None, execution=exact)
        return WorstCase(response, self.dictionary, model, names=self.names, execution=exact)

    @property
    def _exactly(self) -> Execution | None:
        """The same decisions, of a control that is delivered as it is commanded."""
        return None if self.execution is None else self.execution.none()

    def coarser(self, pieces: int) -> WorstCase:
        """The same functionals where about so many equal pieces are the whole horizon, of a known system on many equal
        ones on each of which every input may act: what they can bring to the state is almost the same. Else these."""
        response, model = self.response, self.disturbance
        grid, share = response.grid, response.grid.pieces // pieces
        bound = grid.before is not None or (model is not None and not model.by_piece)
        if share < 2 or bound or not response.propagator.aged(response.system.parameters is not None):
            return self
        ends = np.linspace(0.0, float(grid.breakpoints[-1]), grid.pieces // share + 1)
        which = np.arange(ends.size - 1)
        coarse = TimeGrid(ends, which, which, constants=grid.constants)
        if model is not None:
            model = replace(model, grid=coarse, starts=which)
        return replace(self, response=Response(response.system, coarse, response.initial_state), disturbance=model)

    @shaped
    def rows(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """``G (k, n)`` and ``offset (k,)`` with ``max_w c'x(t) = G theta + offset``."""
        return self._rows(
            times,
            directions,
            parameters,
            lambda part, known: self._support(known, times[part], directions[part], parameters[part]),
        )

    @shaped
    def rows_under(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        disturbances: Float[Array, "k mw L"] | None,
        deviations: Float[Array, "k d"] | None = None,
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """``G (k, n)`` and ``offset (k,)`` with ``c'x(t) = G theta + offset`` under given disturbances ``(k, mw, L)``
        on the grid's pieces, from given ``deviations (k, d)`` of the initial state; the worst one of every index where
        none are given."""

        def pushed(part: slice, known: Weights) -> Array:
            free = known.free
            begun = self._begun(free) if deviations is None else (free * deviations[part]).sum(axis=1)
            return (
                begun
                if disturbances is None
                else begun + np.einsum("kli,kil->k", known.disturbance, disturbances[part])
            )

        return self._rows(times, directions, parameters, pushed)

    @shaped
    def _rows(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        pushed: Callable[[slice, Weights], Array | float],
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """Rows and offsets; ``pushed(part, weights)`` is what the uncertainty adds to the offsets of a part of the
        indices."""
        G, offset = np.empty((times.size, self.variables)), np.empty(times.size)
        for part in self._chunks(parameters):
            known = self.response.weights(times[part], directions[part], parameters[part])
            G[part, : self.coefficients] = self.on_decision(known.control)
            if self.execution is not None:
                along = self.execution.seen(directions[part], parameters[part])
                G[part, self.coefficients :] = self.execution.lengths(times[part], along)
            offset[part] = known.free @ self.response.initial_state + self.given(known.control) + pushed(part, known)
            if self.execution is not None:
                offset[part] += self.execution.given(times[part], along)
        return G, offset

    @shaped
    def worst_blocks(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, "k nb q"]:
        """The coefficients ``(k, nb, q)`` of a worst disturbance at every index."""
        assert self.disturbance is not None
        weights = self.response.weights(times, directions, parameters).disturbance
        return self.disturbance.set.support_point(self.disturbance.blocks(weights))

    @shaped
    def values(
        self,
        theta: Float[Array, " n"],
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        roughly: bool = False,
    ) -> Float[Array, " k"]:
        """``max_w c'x(t)`` at a decision, ``(k,)``, without building the rows; ``roughly`` where directions are many
        and each is asked for once: with measurable disturbances and errors as in `turning`."""
        control = self.on_grid(theta)
        result = np.empty(times.size)
        for part in self._chunks(parameters):
            known = self.response.weights(times[part], directions[part], parameters[part])
            driven = np.einsum("klm,ml->k", known.control, control)
            support = self._support(known, times[part], directions[part], parameters[part], roughly)
            result[part] = known.free @ self.response.initial_state + driven + support
            if roughly:
                result[part] += np.einsum(
                    "klm,ml->k", np.abs(known.control[..., : self.channels]), self._missed(control)
                )
            elif self.execution is not None:
                along = self.execution.seen(directions[part], parameters[part])
                result[part] += self.execution.added(self.control(theta), times[part], along)
        return result

    def turning(self, theta: Array, times: Array, parameters: Array) -> Callable[[Array, np.ndarray], Array]:
        """``max_w c'x(t)`` at a decision as a function of the direction alone, at ``times (k,)`` and ``parameters (k,
        nu)``: of directions ``(j, d)`` and the places ``(j,)`` that they are at, as many at each, ``(j,)``. Weights are
        linear in the direction, so that those of the axes are computed once. What measurable disturbances and errors of
        execution add is not, and is only about right: of errors it is what those do that are constant on pieces."""
        known, model, control = self._axes(times, parameters), self.disturbance, self.on_grid(theta)
        states = known.free @ self.response.initial_state + np.einsum("kdlm,ml->kd", known.control, control)
        by_block, measurable = None if model is None else model.on_blocks, self.measurable
        blocks = np.zeros((*states.shape, 0, 0)) if by_block is None else by_block.blocks(known.disturbance)
        missed = self._missed(control)
        missing = np.flatnonzero(missed.any(axis=0))
        errors = (known.control[:, :, missing, : self.channels] * missed[:, missing].T).reshape(*states.shape, -1)

        def along(directions: Array, which: np.ndarray) -> Array:
            places = which[np.flatnonzero(np.diff(which, prepend=-1))]
            c = directions.reshape(places.size, -1, directions.shape[1])
            found: Array = (c * states[places, None]).sum(axis=2)
            for part in _parts(places.size, max(1, NEAR // max(1, c[:1, :, 0].size * blocks[:1, 0].size))):
                at, turned = places[part], c[part]
                free = turned @ known.free[at]
                found[part] += self._begun(free.reshape(-1, free.shape[2])).reshape(free.shape[:2])
                if by_block is not None:
                    on_blocks = turned @ blocks[at].reshape(*blocks[at].shape[:2], -1)
                    found[part] += by_block.pushed(on_blocks.reshape(*free.shape[:2], *blocks.shape[2:]))
                if errors.shape[2]:
                    found[part] += np.abs(turned @ errors[at]).sum(axis=2)
            if measurable is not None:
                found += measurable.roughly(times[which], directions, parameters[which]).reshape(found.shape)
            return found.reshape(-1)

        return along

    def _missed(self, control: Array) -> Array:
        """By how much every channel of a control on the pieces of the merged grid may be missed, ``(m, L)``."""
        commanded = np.abs(control[: self.channels])
        return 0.0 * commanded if self.execution is None else self.execution.shares[:, None] * commanded

    @shaped
    def profile(
        self, times: Float[Array, " k"], directions: Float[Array, "r d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "k r"]:
        """``sigma (k, r)`` at one parameter, for all ``times (k,)`` and ``directions (r, d)``; by the age of the pieces
        where the grid allows."""
        model, (k, r) = self.disturbance, (times.size, directions.shape[0])
        changes = self.response.grid.mode is not None
        by_block, measurable = None if model is None else model.on_blocks, self.measurable
        aged = by_block is None or (self.response.uniform and by_block.by_piece)
        if (changes or not aged) and r > directions.shape[1] and measurable is None:
            return self._profile_by_axes(times, directions, parameter)
        if changes or not aged:
            every = np.broadcast_to(parameter, (k * r, parameter.size))
            return self.offsets(np.repeat(times, r), np.tile(directions, (k, 1)), every).reshape(k, r)
        sigma, several = np.zeros((k, r)), max(1, CHUNK // (r * directions.shape[1]))
        if by_block is not None:
            known = self._frozen.get(parameter.tobytes())
            if known is None:
                fixed = (self.response.system.modes[0], self.response.grid, self.response.initial_state, parameter)
                known = remember(self._frozen, parameter.tobytes(), frozen(*fixed), LEGS_KEPT)
            sigma = DisturbanceSupport(known, by_block, directions).at(times, np.zeros((k, r, 0)))[0][:, :, 0]
        if measurable is not None:
            for part in _parts(k, several):
                at = np.repeat(times[part], r), np.tile(directions, (times[part].size, 1))
                sigma[part] += measurable(*at, np.broadcast_to(parameter, (at[0].size, parameter.size))).reshape(-1, r)
        if self.initial is not None:
            for part in _parts(k, several):
                rows = self.response.propagator.backwards(times[part], directions, parameter)
                sigma[part] += self.initial.support(rows)
        return sigma

    def _profile_by_axes(self, times: Array, directions: Array, parameter: Array) -> Array:
        """`profile` of more directions than there are axes: what the axes give to the blocks of the disturbance does
        for all directions, in which it is linear."""
        (r, d), sigma, model = directions.shape, np.zeros((times.size, directions.shape[0])), self.disturbance
        several = max(1, CHUNK // (d * self.response.numbers(parameter.size)))
        for part in _parts(times.size if self.disturbed else 0, several):
            known = self._axes(times[part], np.broadcast_to(parameter, (times[part].size, parameter.size)))
            k = known.free.shape[0]
            sigma[part] = self._begun((directions @ known.free).reshape(k * r, d)).reshape(k, r)
            if model is None:
                continue
            blocks = model.blocks(known.disturbance)
            for near in _parts(k, max(1, NEAR // (r * blocks[0, 0].size))):
                begun = blocks[near][:, :, blocks[near].any(axis=(0, 1, 3))]
                turned = directions @ begun.reshape(begun.shape[0], d, begun[0, 0].size)
                sigma[part][near] += model.pushed(turned.reshape(begun.shape[0], r, *begun.shape[2:]))
        return sigma

    def _axes(self, times: Array, parameters: Array) -> Weights:
        """The weights of the functionals along the axes at times ``(k,)``, with one dimension ``(k, d, ...)`` more."""
        d = self.response.initial_state.size
        axes = np.tile(np.eye(d), (times.size, 1))
        every = [np.repeat(one, d, axis=0) for one in (times, parameters)]
        parts = [self.response.weights(every[0][part], axes[part], every[1][part]) for part in self._chunks(every[1])]
        known = [np.concatenate([getattr(part, name) for part in parts]) for name in ("free", "control", "disturbance")]
        return Weights(*(one.reshape(times.size, d, *one.shape[1:]) for one in known))

    @shaped
    def support_over(self, lifted: Leg, H: Float[Array, "r d"], joined: Combination | None = None) -> Supports | None:
        """What the worst disturbance and the worst initial state add to functionals ``H (r, d)`` over a cell, ``None``
        where there is neither; raises `NotEnclosable` where no bound of it is proven."""
        rows = H @ lifted.transform
        found: list[Support] = []
        model, measurable = self.disturbance, self.measurable
        by_block = None if model is None else model.on_blocks
        if measurable is not None:
            if (joined is not None and isinstance(lifted, SpreadMotion)) or (
                lifted.space.nu and isinstance(lifted, LiftedSystem)
            ):
                raise NotEnclosable(f"{WITHOUT_PROOF}; with disturbance_class piecewise_constant there is one")
            found += measurable.over(H, lifted, joined)
        if isinstance(lifted, SpreadMotion):
            found += [] if by_block is None else [SpreadSupport.of_disturbance(lifted, by_block, rows, joined)]
            found += [] if self.initial is None else [SpreadSupport.of_initial(lifted, self.initial, rows, joined)]
        elif isinstance(lifted, VaryingMotion):
            found += [] if by_block is None else [VaryingSupport.of_disturbance(lifted, by_block, rows, joined)]
            found += [] if self.initial is None else [VaryingSupport.of_initial(lifted, self.initial, rows, joined)]
        else:
            found += [] if by_block is None else [DisturbanceSupport(lifted, by_block, rows, joined)]
            found += [] if self.initial is None else [InitialSupport(lifted, self.initial, rows, joined)]
        return Supports(tuple(found)) if found else None

    def delivered_over(
        self, known: Supports | None, theta: Array, H: Array, leg: Leg, joined: Combination | None = None
    ) -> Supports | None:
        """What is ``known`` of the uncertainty over a cell (`support_over`), with what errors of execution of a
        decision add."""
        if self.execution is None:
            return known
        errors = self.execution.over(self.control(theta), H, leg, joined)
        return Supports((*(() if known is None else known.parts), errors))

    @shaped
    def offsets(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """``sigma (k,)``: how far the worst disturbance and the worst initial state alone push ``c'x(t)``."""
        if not self.disturbed:
            return np.zeros(times.size)
        result = np.empty(times.size)
        for part in self._chunks(parameters):
            known = self.response.weights(times[part], directions[part], parameters[part])
            result[part] = self._support(known, times[part], directions[part], parameters[part])
        return result

    @shaped
    def worst_disturbance(
        self, time: float, direction: Float[Array, " d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "mw L"] | None:
        """A disturbance ``(mw, L)`` on the pieces of the merged grid that attains the worst case at one index."""
        return self.parts(time, direction, parameter).disturbance

    @shaped
    def parts(self, time: float, direction: Float[Array, " d"], parameter: Float[Array, " nu"]) -> Parts:
        """What the largest ``c'x(t)`` is made of at one index, beside the control."""
        at = (np.array([time]), direction[None], parameter[None])
        known = self.response.weights(*at)
        return Parts(
            float(known.free[0] @ self.response.initial_state + self.given(known.control)[0]),
            float(self._support(known, *at)[0]),
            float(self._begun(known.free)[0]),
            None if self.disturbance is None else self.disturbance.worst(known.disturbance)[0],
            None if self.initial is None else self.initial.support_point(known.free)[0],
        )

    @shaped
    def worst_deviations(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, "k d"]:
        """The deviation ``(k, d)`` of a worst initial state at every index; 0 where there is one initial state."""
        if self.initial is None:
            return np.zeros(directions.shape)
        return self.initial.support_point(self.response.weights(times, directions, parameters).free)

    @cached_property
    def measurable(self) -> MeasurableSupport | VaryingMeasurable | None:
        """The support of measurable disturbances, ``None`` where there are none; the ``shared`` one where it is of this
        system and set."""
        bound, given = None if self.disturbance is None else self.disturbance.measurable, self.shared
        if bound is None:
            return None
        if given and given.response.propagator is self.response.propagator and given.bound is bound:
            return given
        from sparserob_core.control.reach.varying_measurable import measurable_support

        return measurable_support(self.response, bound)

    @shaped
    def given(self, weights: Float[Array, "k L mc"]) -> Float[Array, " k"]:
        """What weights ``(k, L, m + constants)`` on the columns of ``B`` make of all that is not decided, ``(k,)``."""
        return np.einsum("klm,ml->k", weights, self.known) if self._gives else np.zeros(weights.shape[0])

    @shaped
    def decided(self, weights: Float[Array, "k L mc"]) -> Float[Array, "k J m"]:
        """Of weights on the columns of ``B``, those on the control, on the grid pieces on which one acts."""
        grid = self.response.grid
        return weights[:, grid.decided, : self.channels] if self._gives or grid.before is not None else weights

    @shaped
    def on_decision(self, weights: Float[Array, "k L mc"]) -> Float[Array, "k n"]:
        """Weights ``(k, L, m + constants)`` on the columns of ``B`` on every grid piece, as rows ``(k, n)`` of the
        decision."""
        acting, starts = self._acting
        on_pieces = self.decided(weights)
        if starts.size < on_pieces.shape[1]:
            on_pieces = np.add.reduceat(on_pieces, starts, axis=1)
        if starts.size < self.dictionary.pieces:  # the last ones act after the horizon
            every = np.zeros((weights.shape[0], self.dictionary.pieces, self.channels))
            every[:, acting] = on_pieces
            on_pieces = every
        return self.dictionary.gathered(on_pieces).swapaxes(1, 2).reshape(-1, self.coefficients)

    @cached_property
    def _acting(self) -> tuple[np.ndarray, np.ndarray]:
        """The pieces of the control that act, and where each begins among the grid pieces on which one acts."""
        acting = self.response.grid.control_piece[self.response.grid.decided]
        starts = np.flatnonzero(np.diff(acting, prepend=-1))
        return acting[starts], starts

    @shaped
    def legs(self, low: Float[Array, " nu"], high: Float[Array, " nu"]) -> tuple[Leg, ...]:
        """The lifted system over a cell of parameters, leg by leg, or the motion of one that changes with time;
        remembered, for all constraints."""
        key, response = low.tobytes() + high.tobytes(), self.response
        if key not in self._legs:
            cell = (low + high) / 2, (high - low) / 2
            legs: tuple[Leg, ...]
            if response.propagator.laws is not None:
                legs = (self._on_cell(low, high),)
            elif response.grid.varying:
                legs = (VaryingMotion(response.propagator, response.initial_state),)
            else:
                legs = lift_legs(response.system, response.grid, response.initial_state, *cell)
            remember(self._legs, key, legs, LEGS_KEPT)
        return self._legs[key]

    def _on_cell(self, low: Array, high: Array) -> SpreadMotion:
        """The motion over a cell of parameters; how far states grow on the smallest cell around it is not asked
        again."""
        propagator, begun = self.response.propagator, self.response.initial_state
        assert propagator.laws is not None
        part = propagator.laws.holding(low, high)  # of which units are
        around = [growth for own, a, b, growth in self._grown if own == part and (a <= low).all() and (high <= b).all()]
        known = min(around, default=None)
        leg = SpreadMotion.of(propagator.on_cell(low, high), begun, known)
        if known is None:
            self._grown.append((part, low, high, leg.truncation.growth))
        return leg

    @cached_property
    def _grown(self) -> list[tuple[int | None, Array, Array, float]]:
        return []

    def _growth(self, low: Array, high: Array, halvings: int) -> float:
        """The norm of the transitions at any parameter of a cell, at most; ``inf`` where smaller cells have none."""
        try:
            return self._on_cell(low, high).truncation.growth
        except NotEnclosable as error:
            if error.along is None or not halvings:
                return np.inf
            ends = low.copy(), high.copy()
            for end in ends:
                end[error.along] = (low[error.along] + high[error.along]) / 2
            return max(self._growth(low, ends[1], halvings - 1), self._growth(ends[0], high, halvings - 1))

    def beyond(self, far: Array) -> Array:
        """What a law leaves out of its series in the parameters, of any state, ``(d,)``, under a control that goes as
        ``far (m,)`` as it may; nothing where entries are polynomials."""
        laws, found = self.response.propagator.laws, np.zeros(self.response.initial_state.size)
        if laws is None or all(how.left is None for how, _ in laws.every):
            return found
        begun, inputs = self._largest(far)
        for part, (how, _) in enumerate(laws.every):
            if how.left is not None:
                growth = self._growth(*laws.ends(part), HALVINGS)
                off = laws.left_out(part, begun, inputs, growth)
                found = np.maximum(found, off)
        return found

    def _largest(self, far: Array) -> tuple[Array, Array]:
        """How large the initial state ``(d,)`` and all inputs ``(m + constants + mw,)`` may be under such a control."""
        begun, model = np.abs(self.response.initial_state), self.disturbance
        if self.initial is not None:
            begun = begun + self.initial.reach(np.eye(begun.size))
        pushed = np.zeros(self.response.system.disturbances)
        if model is not None:
            pushed = model.bound.reach(np.eye(model.channels))
        known = np.abs(self.known).max(axis=1)
        delivered = np.maximum(far, known[: far.size])
        if self.execution is not None:  # of what is missed as much is left out as of what is commanded
            delivered = (1.0 + self.execution.shares) * delivered
        return begun, np.concatenate([delivered, known[far.size :], pushed])

    @cached_property
    def _frozen(self) -> dict[bytes, LiftedSystem]:
        return {}

    @cached_property
    def _legs(self) -> dict[bytes, tuple[Leg, ...]]:
        return {}

    @shaped
    def on_grid(self, theta: Float[Array, " n"]) -> Float[Array, "mc L"]:
        """What acts through the columns of ``B`` on the pieces of the merged grid, ``(m + constants, L)``: the control,
        and all that is not decided."""
        return self.response.grid.inputs(self.control(theta))

    @shaped
    def _support(
        self,
        known: Weights,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        roughly: bool = False,
    ) -> Float[Array, " k"]:
        found, by_block = self._begun(known.free), None if self.disturbance is None else self.disturbance.on_blocks
        if by_block is not None:
            found = found + by_block.support(known.disturbance)
        if self.measurable is None:
            return found
        added = self.measurable.roughly if roughly else self.measurable
        return found + np.asarray(added(times, directions, parameters))

    @shaped
    def _begun(self, free: Float[Array, "k d"]) -> Float[Array, " k"]:
        """What the worst initial state adds to functionals with the weights ``free (k, d)`` on it."""
        return np.zeros(free.shape[0]) if self.initial is None else self.initial.support(free)

    @cached_property
    def _gives(self) -> bool:
        return bool(self.known.any())

    def _chunks(self, parameters: Array) -> list[slice]:
        count, numbers = parameters.shape[0], self.response.numbers(parameters.shape[1])
        size = max(1, CHUNK // numbers)
        if 0 < count <= size:
            return [slice(None)]
        return [slice(start, start + size) for start in range(0, count, size)]


def _parts(count: int, several: int) -> list[slice]:
    """``count`` numbers, ``several`` at a time."""
    return [slice(first, first + several) for first in range(0, count, several)]
