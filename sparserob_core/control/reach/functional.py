"""Worst-case functionals of the state: the largest ``c'x(t; theta, w, p)`` over disturbances ``w`` and initial states,
split into the contribution of the control and the rest, which the control cannot change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from sparserob_core.control.problem.cost import nominal_point
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.reach.over_cells import FunctionalsOverCells
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.inner_loop import Weights
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, ConvexSet

if TYPE_CHECKING:
    from sparserob_core.control.reach.execution import Execution
    from sparserob_core.control.reach.measurable import MeasurableSupport
    from sparserob_core.control.reach.varying_measurable import VaryingMeasurable

CHUNK = 4_000_000  # entries of a gain array that are built at once (32 MB)


@dataclass(frozen=True, eq=False)
class Contributions:
    """Contributions to the largest ``c'x(t)`` at one index, without the contribution of the control.

    ``free`` is the contribution of the centre of the initial states and of inputs that are not decided. ``sigma`` is
    the support value of the worst disturbance and the worst initial state together, and ``initial_support`` the part of
    it that comes from the initial state. ``disturbance (mw, L)`` is a worst one of the disturbances that are constant
    on the pieces of the merged grid. ``deviation (d,)`` is a worst deviation from the centre. Each is ``None`` where
    there is none.
    """

    free: float
    sigma: float
    initial_support: float
    disturbance: Array | None
    deviation: Array | None


@dataclass(frozen=True, eq=False)
class WorstFunctionals:
    """The functionals ``c'x(t)`` of one system under its worst disturbance, from the worst initial state.

    The initial states are that of the response plus ``initial``, a set of deviations. The worst of them adds the
    support function of the set, at ``e^{A't} c``.

    Indices are given as ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``; the decision is ``theta``
    raveled, ``(m N,)``. ``names``: the names of the states where a functional is explained. ``execution``: the errors
    with which the control is delivered. The decision then has further entries, a bound of the absolute value of every
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
    def from_state(self, initial_state: Float[Array, " d"]) -> WorstFunctionals:
        """The functionals from another initial state ``(d,)``; what does not depend on it is shared."""
        return replace(self, response=self.response.from_state(initial_state), shared=self.measurable)

    @cached_property
    def channels(self) -> int:
        """Number ``m`` of controls; ``B`` may have columns of constants beyond them."""
        return self.response.system.controls - self.response.grid.constants

    @property
    def disturbed(self) -> bool:
        """True where there is a disturbance, or more than one initial state."""
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
        return np.concatenate([theta.ravel(), self.execution.sizes(self.dictionary.control(theta.ravel())).ravel()])

    @cached_property
    def known(self) -> Array:
        """Inputs through the columns of ``B`` that are not decided, ``(m + constants, L)``: a drift, and the control
        before the first decided one acts; 0 elsewhere."""
        return self.response.grid.inputs(np.zeros((self.channels, self.dictionary.pieces)))

    def central(self) -> WorstFunctionals:
        """The functionals along the nominal trajectory: the disturbance and the initial state at the `nominal_point` of
        their sets; the parameters stay in the index."""
        response, model = self.response, self.disturbance
        if self.initial is not None:
            response = response.from_state(response.initial_state + nominal_point(self.initial))
        disturbance = None if model is None else model.held(nominal_point(model.bound))
        return replace(
            self, response=response, disturbance=disturbance, shared=None, initial=None, execution=self._exact_execution
        )

    def nominal(self) -> WorstFunctionals:
        """Return the functionals of the system at an interior point of its parameters, from the centre of the initial
        states, under one admissible disturbance: 0 where it is admissible."""
        return self._nominal_case

    @cached_property
    def _nominal_case(self) -> WorstFunctionals:
        system, model = self.response.system, self.disturbance
        if model is not None:
            zero = np.zeros(model.channels)
            model = model.held(zero if model.bound.contains(zero) else model.bound.interior_point())
        response, exact = self.response, self._exact_execution
        if system.parameters is not None:
            response = response.at(system.parameters.interior_point())
        if system.varies:
            return replace(self, response=response, disturbance=model, initial=None, shared=None, execution=exact)
        return WorstFunctionals(response, self.dictionary, model, names=self.names, execution=exact)

    @property
    def _exact_execution(self) -> Execution | None:
        """The execution of the same decisions without errors, where the control is delivered as it is commanded;
        ``None`` where there is no execution."""
        return None if self.execution is None else self.execution.none()

    def coarser(self, pieces: int) -> WorstFunctionals:
        """Return the same functionals on about ``pieces`` equal pieces over the whole horizon, or unchanged.

        The grid changes only for a known system on many equal pieces, on each of which every input may act: the effect
        of the inputs on the state then is almost the same.
        """
        response, model = self.response, self.disturbance
        grid, group_size = response.grid, response.grid.pieces // pieces
        is_fixed = grid.before is not None or (model is not None and not model.by_piece)
        if group_size < 2 or is_fixed or not response.propagator.aged(response.system.parameters is not None):
            return self
        ends = np.linspace(0.0, float(grid.breakpoints[-1]), grid.pieces // group_size + 1)
        piece_indices = np.arange(ends.size - 1)
        coarse = TimeGrid(ends, piece_indices, piece_indices, constants=grid.constants)
        if model is not None:
            model = replace(model, grid=coarse, starts=piece_indices)
        return replace(self, response=Response(response.system, coarse, response.initial_state), disturbance=model)

    @shaped
    def rows(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """Return ``G (k, n)`` and ``offset (k,)`` with ``max_w c'x(t) = G theta + offset`` for a decision ``theta``.

        Where there are errors of execution, the worst of them are included.
        """
        return self._build_rows(
            times,
            directions,
            parameters,
            lambda chunk, weights: self._evaluate_support(weights, times[chunk], directions[chunk], parameters[chunk]),
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
        """Return ``G (k, n)`` and ``offset (k,)`` with ``c'x(t) = G theta + offset`` under given disturbances.

        ``disturbances (k, mw, L)`` are given on the grid's pieces; ``None`` stands for no disturbance. ``deviations
        (k, d)`` of the initial state may be given; otherwise those are the worst ones of every index. Errors of
        execution are the worst ones.
        """

        def compute_effect(part: slice, known: Weights) -> Array:
            free = known.free
            initial_effect = self.initial_support(free) if deviations is None else (free * deviations[part]).sum(axis=1)
            return (
                initial_effect
                if disturbances is None
                else initial_effect + np.einsum("kli,kil->k", known.disturbance, disturbances[part])
            )

        return self._build_rows(times, directions, parameters, compute_effect)

    @shaped
    def _build_rows(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        compute_effect: Callable[[slice, Weights], Array | float],
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """Rows and offsets; ``compute_effect(part, weights)`` is what the uncertainty adds to the offsets of a part of
        the indices."""
        G, offset = np.empty((times.size, self.variables)), np.empty(times.size)
        for chunk in self.chunks(parameters):
            weights = self.response.weights(times[chunk], directions[chunk], parameters[chunk])
            G[chunk, : self.coefficients] = self.on_decision(weights.control)
            if self.execution is not None:
                error_directions = self.execution.extend_directions(directions[chunk], parameters[chunk])
                G[chunk, self.coefficients :] = self.execution.lengths(times[chunk], error_directions)
            offset[chunk] = (
                weights.free @ self.response.initial_state
                + self.given(weights.control)
                + compute_effect(chunk, weights)
            )
            if self.execution is not None:
                offset[chunk] += self.execution.given(times[chunk], error_directions)
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
        and each is asked for once: with measurable disturbances and errors as in `ManyDirections.turning`."""
        control = self.on_grid(theta)
        result = np.empty(times.size)
        for chunk in self.chunks(parameters):
            weights = self.response.weights(times[chunk], directions[chunk], parameters[chunk])
            control_effect = np.einsum("klm,ml->k", weights.control, control)
            support = self._evaluate_support(weights, times[chunk], directions[chunk], parameters[chunk], roughly)
            result[chunk] = weights.free @ self.response.initial_state + control_effect + support
            if roughly:
                result[chunk] += np.einsum(
                    "klm,ml->k", np.abs(weights.control[..., : self.channels]), self.bound_execution_errors(theta)
                )
            elif self.execution is not None:
                error_directions = self.execution.extend_directions(directions[chunk], parameters[chunk])
                result[chunk] += self.execution.added(self.control(theta), times[chunk], error_directions)
        return result

    def bound_execution_errors(self, theta: Array) -> Array:
        """Return the largest error of execution of every channel at a decision, on the pieces of the merged grid,
        ``(m, L)``."""
        if self.execution is None:
            return np.zeros((self.channels, self.response.grid.pieces))
        return self.execution.deviations(self.control(theta))

    @shaped
    def offsets(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """Return ``sigma (k,)``, the support value of the worst disturbance and the worst initial state on
        ``c'x(t)``."""
        if not self.disturbed:
            return np.zeros(times.size)
        result = np.empty(times.size)
        for chunk in self.chunks(parameters):
            weights = self.response.weights(times[chunk], directions[chunk], parameters[chunk])
            result[chunk] = self._evaluate_support(weights, times[chunk], directions[chunk], parameters[chunk])
        return result

    @shaped
    def parts(self, time: float, direction: Float[Array, " d"], parameter: Float[Array, " nu"]) -> Contributions:
        """Return the contributions to the largest ``c'x(t)`` at one index, without the contribution of the control."""
        index = (np.array([time]), direction[None], parameter[None])
        weights = self.response.weights(*index)
        return Contributions(
            float(weights.free[0] @ self.response.initial_state + self.given(weights.control)[0]),
            float(self._evaluate_support(weights, *index)[0]),
            float(self.initial_support(weights.free)[0]),
            None if self.disturbance is None else self.disturbance.worst(weights.disturbance)[0],
            None if self.initial is None else self.initial.support_point(weights.free)[0],
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
        bound, shared = None if self.disturbance is None else self.disturbance.measurable, self.shared
        if bound is None:
            return None
        if shared and shared.response.propagator is self.response.propagator and shared.bound is bound:
            return shared
        from sparserob_core.control.reach.varying_measurable import measurable_support

        return measurable_support(self.response, bound)

    @shaped
    def given(self, weights: Float[Array, "k L mc"]) -> Float[Array, " k"]:
        """Return the contribution ``(k,)`` of all inputs that are not decided, from weights ``(k, L, m + constants)``
        on the columns of ``B``."""
        return np.einsum("klm,ml->k", weights, self.known) if self._has_known_inputs else np.zeros(weights.shape[0])

    @shaped
    def decided(self, weights: Float[Array, "k L mc"]) -> Float[Array, "k J m"]:
        """Return the weights ``(k, J, m)`` on the control from weights ``(k, L, m + constants)`` on the columns of
        ``B``.

        The ``J`` grid pieces are those on which a piece of the control acts.
        """
        grid = self.response.grid
        return (
            weights[:, grid.decided, : self.channels] if self._has_known_inputs or grid.before is not None else weights
        )

    @shaped
    def on_decision(self, weights: Float[Array, "k L mc"]) -> Float[Array, "k n"]:
        """Weights ``(k, L, m + constants)`` on the columns of ``B`` on every grid piece, as rows ``(k, n)`` of the
        decision."""
        acting, starts = self._active_pieces
        on_pieces = self.decided(weights)
        if starts.size < on_pieces.shape[1]:
            on_pieces = np.add.reduceat(on_pieces, starts, axis=1)
        if starts.size < self.dictionary.pieces:  # the last ones act after the horizon
            all_weights = np.zeros((weights.shape[0], self.dictionary.pieces, self.channels))
            all_weights[:, acting] = on_pieces
            on_pieces = all_weights
        return self.dictionary.gathered(on_pieces).swapaxes(1, 2).reshape(-1, self.coefficients)

    @cached_property
    def _active_pieces(self) -> tuple[np.ndarray, np.ndarray]:
        """The pieces of the control that act, and where each begins among the grid pieces on which one acts."""
        acting = self.response.grid.control_piece[self.response.grid.decided]
        starts = np.flatnonzero(np.diff(acting, prepend=-1))
        return acting[starts], starts

    @cached_property
    def over_cells(self) -> FunctionalsOverCells:
        """Functionals over cells of parameters, of the same system and uncertainty."""
        return FunctionalsOverCells(
            self.response, self.disturbance, self.initial, self.execution, self.measurable, self.known
        )

    @shaped
    def on_grid(self, theta: Float[Array, " n"]) -> Float[Array, "mc L"]:
        """Return the inputs through the columns of ``B`` on the pieces of the merged grid, ``(m + constants, L)``: the
        control of a decision, and all inputs that are not decided."""
        return self.response.grid.inputs(self.control(theta))

    @shaped
    def _evaluate_support(
        self,
        known: Weights,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        roughly: bool = False,
    ) -> Float[Array, " k"]:
        total, by_block = (
            self.initial_support(known.free),
            None if self.disturbance is None else self.disturbance.on_blocks,
        )
        if by_block is not None:
            total = total + by_block.support(known.disturbance)
        if self.measurable is None:
            return total
        evaluate = self.measurable.roughly if roughly else self.measurable
        return total + np.asarray(evaluate(times, directions, parameters))

    @shaped
    def initial_support(self, free: Float[Array, "k d"]) -> Float[Array, " k"]:
        """Return the support value ``(k,)`` of the deviations of the initial state, for weights ``free (k, d)`` on
        it."""
        return np.zeros(free.shape[0]) if self.initial is None else self.initial.support(free)

    @cached_property
    def _has_known_inputs(self) -> bool:
        return bool(self.known.any())

    def chunks(self, parameters: Array) -> list[slice]:
        """Return slices that divide indices with ``parameters (k, nu)`` into parts whose weights fit into memory."""
        count, numbers = parameters.shape[0], self.response.numbers(parameters.shape[1])
        size = max(1, CHUNK // numbers)
        if 0 < count <= size:
            return [slice(None)]
        return [slice(start, start + size) for start in range(0, count, size)]
