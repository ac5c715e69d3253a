"""Derivatives of state constraints in their index ``(t, p)``, and in the direction where the set is curved.

By the envelope theorem (Danskin 1967) the derivative of a maximum is that of what is maximised, with the maximiser held
fixed: here the worst disturbance of the index. For fixed inputs the state is a smooth function of the index between two
breakpoints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sparserob_core.control.constraints.state import StateConstraint
from sparserob_core.control.reach.functional import CHUNK
from sparserob_core.control.response.inner_loop import Weights
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.sensitivity_system import tangent
from sparserob_core.control.response.time_grid import TimeGrid
from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.relaxed.index_gradient import differences

ENTERED = 1e-9  # of a piece: what has passed of one that is just entered, to know the worst disturbance on it


@dataclass(frozen=True, eq=False)
class Functional:
    """``c'x(t)`` of every index and its derivatives in the ``nu`` parameters, as weights on the initial state and on
    what drives every piece. ``start (k, d)``: the initial state of every index.

    ``c = sum_b shares_b directions_b`` with ``directions (k, b, d)`` and ``shares (k, b)``; ``along (k, b, 1 + nu, d)``
    and ``gains (k, b, L, 1 + nu, d)`` are those of every direction. ``moving``: the weights ``(k, d)`` and
    ``(k, L, d)`` of ``c'A x(t)``. ``B (k, 1 + nu, d, J m)``, ``W (k, 1 + nu, d, J mw)`` with their derivatives, those
    of several modes side by side; ``now (k,)``: the piece whose inputs act at the time of the index.
    """

    start: Array
    grid: TimeGrid
    directions: Array
    shares: Array
    along: Array
    gains: Array
    moving: tuple[Array, Array]
    B: Array
    W: Array
    now: np.ndarray

    @cached_property
    def direction(self) -> Array:
        """``c (k, d)``."""
        return self._combine_directions(self.directions)

    @cached_property
    def free(self) -> Array:
        """Weights ``(k, 1 + nu, d)`` on the initial state: ``e^{A't} c`` and its derivatives."""
        return self._combine_directions(self.along)

    @cached_property
    def driven(self) -> Array:
        """Weights ``(k, L, 1 + nu, d)`` on what drives every piece."""
        return self._combine_directions(self.gains)

    def force(self, control: Array, signals: Array | None) -> Array:
        """Return ``B u + E w`` and its derivatives, ``(k, L, 1 + nu, d)``, from inputs on the pieces, ``(m, L)`` and
        ``(k, mw, L)``."""
        force: Array = np.swapaxes(self.grid.driven(self.B, control), 1, 2)
        return force if signals is None else force + np.swapaxes(self.grid.driven(self.W, signals[:, None]), 1, 2)

    @property
    def disturbance_weights(self) -> Array:
        """Weights ``(k, L, mw)`` on the disturbance on every piece."""
        return self.grid.through(self.driven[:, :, 0], self.W[:, 0])

    def in_time(self, force: Array) -> Array:
        """Return ``c'(A x(t) + B u(t) + E w(t))``, as ``(k, 1)``."""
        drift = (self.moving[0] * self.start).sum(axis=1) + (self.moving[1] * force[:, :, 0]).sum(axis=(1, 2))
        input_terms = (self.direction * force[np.arange(self.now.size), self.now, 0]).sum(axis=1)
        return np.asarray(drift + input_terms)[:, None]

    def in_parameters(self, force: Array) -> Array:
        """Return the derivatives ``(k, nu)`` of ``c'x(t)`` in the parameters, the inputs fixed."""
        through_A = np.einsum("klad,kld->ka", self.driven[:, :, 1:], force[:, :, 0])
        return np.asarray(
            np.einsum("kad,kd->ka", self.free[:, 1:], self.start)
            + through_A
            + np.einsum("kld,klad->ka", self.driven[:, :, 0], force[:, :, 1:])
        )

    def states(self, force: Array) -> Array:
        """Return ``directions_b'x(t)``, ``(k, b)``."""
        return np.asarray(
            np.einsum("kbd,kd->kb", self.along[:, :, 0], self.start)
            + np.einsum("kbld,kld->kb", self.gains[:, :, :, 0], force[:, :, 0])
        )

    def _combine_directions(self, parts: Array) -> Array:
        return parts[:, 0] if parts.shape[1] == 1 else np.einsum("kb,kb...->k...", self.shares, parts)


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """The derivatives of ``max_w c'x(t) - h(c)`` in the index, at a decision.

    Time: ``c'(A x + B u + E w - r')``. Inputs jump at breakpoints, so the constraint, and with it the value of a
    relaxed program, has kinks there. The derivative is the one from the left, except at the start of the window, where
    it is the one from the right. Parameters: the functional is propagated together with its derivatives (`tangent`),
    and through the map of a box onto a set that is not one (`ParameterIndex.pulled_back`). Direction ``z``: the state
    less the support point of ``c``, across ``z``; 0 at ``z = 0``. Where the worst disturbance (or the support point) is
    not unique there is a kink too, and the derivative is that of one of them.

    Measurable disturbances: the derivative in time is in closed form, ``h_W(E'e^{A't} c)`` for the support function,
    where the system stays the same; elsewhere, and in parameters and directions, derivatives are differences of the
    support function.
    Coordinates that cannot move, as the time of a terminal constraint, have derivative 0.
    """

    constraint: StateConstraint

    def gradient(self, x: Array, indices: Array, rows: Array) -> Array:
        """Return the derivative ``(k, d)`` of ``row x - rhs`` at ``indices (k, d)``, one row of the family per index,
        ``rows (k,)``."""
        return self.slopes(x, indices, rows)[0]

    def slopes(self, x: Array, indices: Array, rows: Array, signals: Array | None = None) -> tuple[Array, Array]:
        """Return the gradient ``(k, d)``, and the weights ``(k, L, mw)`` of the disturbance on the pieces of the grid.

        ``signals (k, mw, L)``: the disturbance of every index; the worst one if not given.
        """
        indices, rows = np.asarray(indices, dtype=float), np.asarray(rows, dtype=int)
        size = (
            self._response.grid.pieces
            * self._tangent_response.initial_state.size
            * max(1, indices.shape[1] - 1 - self._nu)
        )
        step = max(1, CHUNK // size)
        chunks = [slice(start, start + step) for start in range(0, indices.shape[0], step)]
        if not chunks:
            return indices, np.zeros((0, self._response.grid.pieces, self._response.system.disturbances))
        pairs = [
            self._compute_slopes(x, indices[chunk], rows[chunk], None if signals is None else signals[chunk])
            for chunk in chunks
        ]
        return np.vstack([slope for slope, _ in pairs]) * self._coordinate_factors, np.concatenate(
            [weights for _, weights in pairs]
        )

    def _compute_slopes(self, x: Array, indices: Array, rows: Array, signals: Array | None) -> tuple[Array, Array]:
        times, points, z = np.split(indices, [1, 1 + self._nu], axis=1)
        parameters, model = self.constraint.parameters.clamp(points), self.constraint.functionals.disturbance
        at = self._build_functional(times[:, 0], parameters, z, rows)
        weights = at.disturbance_weights
        by_block, support = None if model is None else model.on_blocks, self.constraint.functionals.measurable
        closed = signals is None and support is not None
        if signals is None and by_block is not None:
            signals = by_block.worst(self._fill_entered_pieces(weights, at))
        force = at.force(self.constraint.functionals.on_grid(x), signals)
        in_time, in_parameters, states = at.in_time(force), at.in_parameters(force), at.states(force)
        if self._response.system.varies:
            in_time = self._differentiate_in_time(times[:, 0], parameters, at, x, signals)
            in_parameters = self._differentiate_in_parameters(times[:, 0], parameters, at, x, signals)
        if closed:
            support_slopes = self._differentiate_support(times[:, 0], parameters, at)
            in_time, in_parameters, states = (
                in_time + support_slopes[0],
                in_parameters + support_slopes[1],
                states + support_slopes[2],
            )
        execution = self.constraint.functionals.execution
        if execution is not None:
            control = self.constraint.functionals.control(x)
            along = execution.extend_directions(at.direction, parameters)
            in_time = in_time + execution.slope(control, times[:, 0], along)[:, None]
            states = states + self._differentiate_in_shares(
                at, lambda c, of: execution.added(control, times[of, 0], execution.extend_directions(c, parameters[of]))
            )
            if self._nu:
                box = self.constraint.parameters.box

                def added(p: Array, of: np.ndarray) -> Array:
                    return execution.added(control, times[of, 0], execution.extend_directions(at.direction[of], p))

                in_parameters = in_parameters + differences(added, parameters, box.lower, box.upper)
        reference = self.constraint.reference
        if reference.moves:
            in_time = (
                in_time - (at.direction * reference.slope(times[:, 0], self.constraint.start)).sum(axis=1)[:, None]
            )
            states = states - np.einsum("kbd,kd->kb", at.directions, reference.at(times[:, 0]))
        in_parameters = self.constraint.parameters.pulled_back(points, in_parameters)
        in_direction = self.constraint.turned(z, at.direction, states)
        return np.hstack([in_time, in_parameters, in_direction]), weights

    def _build_functional(self, times: Array, parameters: Array, z: Array, rows: np.ndarray) -> Functional:
        directions, shares = self.constraint.directions(z, rows)
        (k, b, d), response = directions.shape, self._tangent_response
        blocks = response.initial_state.size // d
        larger = np.concatenate([directions, np.zeros((k, b, (blocks - 1) * d))], axis=2).reshape(k * b, -1)
        free, gains, B, W = response.adjoint(np.repeat(times, b), larger, np.repeat(parameters, b, axis=0))
        along, gains, pieces = (
            free.reshape(k, b, blocks, d),
            gains.reshape(k, b, -1, blocks, d),
            self._locate_pieces(times),
        )
        start, initial = np.broadcast_to(self._response.initial_state, (k, d)), self.constraint.functionals.initial
        if initial is not None:
            start = start + initial.support_point(np.einsum("kb,kbd->kd", shares, along[:, :, 0]))
        return Functional(
            start,
            self._response.grid,
            directions,
            shares,
            along,
            gains,
            self._compute_rate_weights(
                times, parameters, np.einsum("kb,kbd->kd", shares, directions), (along, gains, shares), pieces
            ),
            B[::b].reshape(k, blocks, d, -1),
            W[::b].reshape(k, blocks, d, -1),
            pieces,
        )

    def _compute_rate_weights(
        self, times: Array, parameters: Array, c: Array, known: tuple[Array, Array, Array], pieces: np.ndarray
    ) -> tuple[Array, Array]:
        """Return the weights of ``c'A x(t)``: those of ``c'x(t)`` times ``A``, which commutes with ``e^{As}``; of a
        system that changes those of the direction ``A'c``, with the ``A`` of the time of the index."""
        response, mode_of_piece = self._response, self._response.grid.mode
        if response.grid.varying:  # whose derivative in time is made otherwise
            return np.zeros(known[0][:, 0, 0].shape), np.zeros(known[1][:, 0, :, 0].shape)
        matrices = [mode.matrices(parameters)[0] for mode in response.system.modes]
        if mode_of_piece is None:
            along, gains, shares = known
            free, input_weights = (
                np.einsum("kb,kb...->k...", shares, array) for array in (along[:, :, 0], gains[:, :, :, 0])
            )
            return (free[:, None] @ matrices[0])[:, 0], input_weights @ matrices[0]
        A = np.stack(matrices, axis=1)[np.arange(times.size), mode_of_piece[pieces]]
        return response.adjoint(times, (c[:, None] @ A)[:, 0], parameters)[:2]

    def _differentiate_in_parameters(
        self, times: Array, parameters: Array, at: Functional, x: Array, signals: Array | None
    ) -> Array:
        """Return `Functional.in_parameters` of a system that changes with time, by differences of ``c'x(t)``."""
        control, box = self.constraint.functionals.on_grid(x), self.constraint.parameters

        def value(p: Array, of: np.ndarray) -> Array:
            weights = self._response.weights(times[of], at.direction[of], p)
            return _evaluate_functionals(weights, at.start[of], control, None if signals is None else signals[of])

        if not self._nu:
            return np.zeros((times.size, 0))
        return differences(value, parameters, box.box.lower, box.box.upper)

    def _differentiate_in_time(
        self, times: Array, parameters: Array, at: Functional, x: Array, signals: Array | None
    ) -> Array:
        """Return `Functional.in_time` of a system that changes with time, ``c'(A(t) x(t) + B(t) u + E(t) w)``."""
        A, inputs = self._response.propagator.law.entries(times, parameters)
        along, input_weights = (at.direction[:, None] @ A)[:, 0], (at.direction[:, None] @ inputs)[:, 0]
        weights = self._response.weights(times, along, parameters)
        control = self.constraint.functionals.on_grid(x)
        acting = control[:, at.now].T
        values = _evaluate_functionals(weights, at.start, control, signals)
        if signals is not None:
            acting = np.hstack([acting, signals[np.arange(times.size), :, at.now]])
        return np.asarray(values + (input_weights[:, : acting.shape[1]] * acting).sum(axis=1))[:, None]

    def _locate_pieces(self, times: Array) -> np.ndarray:
        """Return the pieces on which the times are approached: from the left, but from the right at the start of the
        window."""
        grid = self._response.grid
        right_pieces = np.clip(np.searchsorted(grid.breakpoints, times, side="right") - 1, 0, grid.pieces - 1)
        return np.where(times <= self.constraint.start, right_pieces, grid.locate(times))

    def _fill_entered_pieces(self, weights: Array, at: Functional) -> Array:
        """Return the weights on the disturbance, with a trace of a piece that is only just entered and has none yet."""
        fresh = np.flatnonzero(~at.driven[np.arange(at.now.size), at.now, 0].any(axis=1))
        if not fresh.size:
            return weights
        filled_weights = weights.copy()
        grid = self._response.grid
        trace = ENTERED * grid.lengths[at.now[fresh], None] * at.direction[fresh]
        gains = np.zeros((fresh.size, grid.pieces, trace.shape[1]))
        gains[np.arange(fresh.size), at.now[fresh]] = trace
        trace_weights = grid.through(gains, at.W[fresh, 0])
        filled_weights[fresh, at.now[fresh]] = trace_weights[np.arange(fresh.size), at.now[fresh]]
        return filled_weights

    def _differentiate_support(self, times: Array, parameters: Array, at: Functional) -> tuple[Array, Array, Array]:
        """Return the derivatives of the contribution of measurable disturbances in time, in parameters and in the
        shares of directions."""
        support, grid = self.constraint.functionals.measurable, self._response.grid
        assert support is not None
        if grid.mode is None:
            in_time = support.bound.support((at.free[:, :1] @ at.W[:, 0])[:, 0])[:, None]
        else:  # of what earlier systems did there is no closed form
            from sparserob_core.control.reach.execution import STEP

            ends, step = grid.breakpoints[[at.now, at.now + 1]], STEP * float(grid.breakpoints[-1])
            low, high = np.clip([times - step, times + step], *ends)
            change = support(high, at.direction, parameters) - support(low, at.direction, parameters)
            in_time = (change / (high - low))[:, None]
        in_parameters = np.zeros((times.size, self._nu))
        if self._nu:
            box = self.constraint.parameters.box
            in_parameters = differences(
                lambda p, of: support(times[of], at.direction[of], p), parameters, box.lower, box.upper
            )
        return (
            in_time,
            in_parameters,
            self._differentiate_in_shares(at, lambda c, of: support(times[of], c, parameters[of])),
        )

    def _differentiate_in_shares(self, at: Functional, value: Callable[[Array, np.ndarray], Array]) -> Array:
        """Return the derivatives ``(k, b)`` of a function of directions in the shares of the normals that make up a
        direction of a curved set; 0 for flat sides.

        ``value`` takes directions ``(j, d)`` and the numbers ``(j,)`` of their indices.
        """
        if self.constraint.index_set.dimension == 1 + self._nu:
            return np.zeros(at.shares.shape)
        normals, bound = at.directions[0], np.full(at.shares.shape[1], 2.0)
        return differences(lambda shares, of: value(shares @ normals, of), at.shares, -bound, bound)

    @property
    def _response(self) -> Response:
        return self.constraint.functionals.response

    @property
    def _nu(self) -> int:
        return self.constraint.parameters.count

    @cached_property
    def _tangent_response(self) -> Response:
        return tangent(self._response)

    @cached_property
    def _coordinate_factors(self) -> Array:
        """Factors ``(d,)`` of the coordinates of the index: 1 for those that can move, 0 for the others."""
        box = self.constraint.index_set
        return np.asarray(box.upper > box.lower, dtype=float)


def _evaluate_functionals(known: Weights, start: Array, control: Array, signals: Array | None) -> Array:
    """Return the functionals ``(k,)`` with these weights, from states ``start (k, d)``, under inputs on the pieces,
    ``(m, L)`` and ``(k, mw, L)``."""
    values = (known.free * start).sum(axis=1) + np.einsum("klm,ml->k", known.control, control)
    return np.asarray(values if signals is None else values + np.einsum("klw,kwl->k", known.disturbance, signals))
