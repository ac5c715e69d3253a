"""Worst-case functionals of the state: ``max_w c'x(t; theta, w, p)`` split into what the control does and what it
cannot help."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.combination import Combination
from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.names import UNNAMED, Names
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.response.disturbance import DisturbanceModel
from sparserob_core.control.response.disturbance_support import DisturbanceSupport
from sparserob_core.control.response.lifted import LiftedSystem, frozen
from sparserob_core.control.response.measurable import MeasurableCellSupport, MeasurableSupport
from sparserob_core.control.response.response import Response
from sparserob_core.errors import NotEnclosable
from sparserob_core.shapes import Float, shaped
from sparserob_core.sip.convex_set import Array, Box

# said where it is met, and before anything is solved
WITHOUT_PROOF = "measurable disturbances are proven only for known systems and sets with flat sides"
CHUNK = 4_000_000  # entries of a gain array that are built at once (32 MB)


@dataclass(frozen=True, eq=False)
class WorstCase:
    """The functionals ``c'x(t)`` of one system under its worst disturbance.

    Indices are given as ``times (k,)``, ``directions (k, d)``, ``parameters (k, nu)``; the decision is ``theta``
    raveled, ``(m N,)``. ``names``: what the states are called where a functional is explained.
    """

    response: Response
    dictionary: Dictionary
    disturbance: DisturbanceModel | None
    shared: MeasurableSupport | None = field(default=None, repr=False)
    names: Names = UNNAMED

    @shaped
    def from_state(self, initial_state: Float[Array, " d"]) -> WorstCase:
        """The functionals from another initial state ``(d,)``; what does not depend on it is shared."""
        measurable = self.disturbance is not None and self.disturbance.kind == "measurable"
        support = self.measurable if measurable else None
        return replace(self, response=self.response.from_state(initial_state), shared=support)

    @property
    def channels(self) -> int:
        """Number ``m`` of controls; ``B`` may have columns of constants beyond them."""
        return self.response.system.controls - self.response.grid.constants

    @property
    def variables(self) -> int:
        return self.channels * self.dictionary.functions

    @cached_property
    def known(self) -> Array:
        """What acts through the columns of ``B`` where nothing is decided, ``(m + constants, L)``: a drift, and the
        control before the first one acts; 0 elsewhere."""
        return self.response.grid.inputs(np.zeros((self.channels, self.dictionary.pieces)))

    def nominal(self) -> WorstCase:
        """The functionals of the system at an interior point of its parameters, under one admissible disturbance: none,
        where it may be."""
        system, model = self.response.system, self.disturbance
        middle = np.zeros((1, 0)) if system.parameters is None else system.parameters.interior_point()[None]
        A, B, E = system.matrices(middle)
        known = LinearSystem(A[0], B[0], E[0])
        if model is not None:
            zero = np.zeros(model.channels)
            point = zero if model.bound.contains(zero) else model.bound.interior_point()
            single = Box(point, point)
            fixed = DisturbanceModel(
                "piecewise_constant", single, single, model.grid, starts=np.arange(model.grid.pieces)
            )
            model = fixed if point.any() else None
        response = Response(known, self.response.grid, self.response.initial_state)
        return WorstCase(response, self.dictionary, model, names=self.names)

    @shaped
    def rows(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """``G (k, n)`` and ``offset (k,)`` with ``max_w c'x(t) = G theta + offset``."""
        return self._rows(
            times,
            directions,
            parameters,
            lambda part, gains, W: self._support(gains, W, times[part], directions[part], parameters[part]),
        )

    @shaped
    def rows_under(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        disturbances: Float[Array, "k mw L"] | None,
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """``G (k, n)`` and ``offset (k,)`` with ``c'x(t) = G theta + offset`` under given disturbances ``(k, mw, L)``
        on the grid's pieces."""
        return self._rows(
            times,
            directions,
            parameters,
            lambda part, gains, W: (
                0.0 if disturbances is None else np.einsum("kli,kil->k", gains @ W, disturbances[part])
            ),
        )

    @shaped
    def _rows(
        self,
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
        pushed: Callable[[slice, Array, Array], Array | float],
    ) -> tuple[Float[Array, "k n"], Float[Array, " k"]]:
        """Rows and offsets; ``pushed(part, gains, W)`` is what the disturbance adds to the offsets of a part of the
        indices."""
        G, offset = np.empty((times.size, self.variables)), np.empty(times.size)
        for part in self._chunks(times.size):
            free, gains, B, W = self.response.adjoint(times[part], directions[part], parameters[part])
            weights = gains @ B
            G[part] = self.on_decision(weights)
            offset[part] = free @ self.response.initial_state + self.given(weights) + pushed(part, gains, W)
        return G, offset

    @shaped
    def worst_blocks(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, "k nb q"]:
        """The coefficients ``(k, nb, q)`` of a worst disturbance at every index."""
        assert self.disturbance is not None
        _, gains, _, W = self.response.adjoint(times, directions, parameters)
        return self.disturbance.set.support_point(self.disturbance.blocks(gains @ W))

    @shaped
    def values(
        self,
        theta: Float[Array, " n"],
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
    ) -> Float[Array, " k"]:
        """``max_w c'x(t)`` at a decision, ``(k,)``, without building the rows."""
        control = self.on_grid(theta)
        result = np.empty(times.size)
        for part in self._chunks(times.size):
            free, gains, B, W = self.response.adjoint(times[part], directions[part], parameters[part])
            driven = np.einsum("klm,ml->k", gains @ B, control)
            support = self._support(gains, W, times[part], directions[part], parameters[part])
            result[part] = free @ self.response.initial_state + driven + support
        return result

    @shaped
    def profile(
        self, times: Float[Array, " k"], directions: Float[Array, "r d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "k r"]:
        """``sigma (k, r)`` at one parameter, for all ``times (k,)`` and ``directions (r, d)``; by the age of the pieces
        where the grid allows."""
        model = self.disturbance
        if model is None or model.kind == "measurable" or not (self.response.uniform and model.by_piece):
            k, r = times.size, directions.shape[0]
            every = np.broadcast_to(parameter, (k * r, parameter.size))
            return self.offsets(np.repeat(times, r), np.tile(directions, (k, 1)), every).reshape(k, r)
        known = frozen(self.response.system, self.response.grid, self.response.initial_state, parameter)
        return DisturbanceSupport(known, model, directions).at(times, np.zeros((times.size, directions.shape[0], 0)))[
            0
        ][:, :, 0]

    @shaped
    def disturbance_support(
        self, lifted: LiftedSystem, H: Float[Array, "r d"], joined: Combination | None = None
    ) -> DisturbanceSupport | MeasurableCellSupport | None:
        """The support function of the disturbance on functionals ``H (r, d)`` over a cell; raises `NotEnclosable` where
        no bound of it is proven."""
        model = self.disturbance
        if model is None:
            return None
        if model.kind != "measurable":
            return DisturbanceSupport(lifted, model, H @ lifted.transform, joined)
        if lifted.space.nu or joined is not None:
            raise NotEnclosable(f"{WITHOUT_PROOF}; with disturbance_class piecewise_constant there is one")
        return MeasurableCellSupport(self.measurable, H, lifted)

    @shaped
    def offsets(
        self, times: Float[Array, " k"], directions: Float[Array, "k d"], parameters: Float[Array, "k nu"]
    ) -> Float[Array, " k"]:
        """``sigma (k,)``: how far the worst disturbance alone pushes ``c'x(t)``."""
        if self.disturbance is None:
            return np.zeros(times.size)
        result = np.empty(times.size)
        for part in self._chunks(times.size):
            _, gains, _, W = self.response.adjoint(times[part], directions[part], parameters[part])
            result[part] = self._support(gains, W, times[part], directions[part], parameters[part])
        return result

    @shaped
    def worst_disturbance(
        self, time: float, direction: Float[Array, " d"], parameter: Float[Array, " nu"]
    ) -> Float[Array, "mw L"] | None:
        """A disturbance ``(mw, L)`` on the pieces of the merged grid that attains the worst case at one index."""
        return self.parts(time, direction, parameter)[2]

    @shaped
    def parts(
        self, time: float, direction: Float[Array, " d"], parameter: Float[Array, " nu"]
    ) -> tuple[float, float, Float[Array, "mw L"] | None]:
        """What ``max_w c'x(t)`` is made of at one index, beside the control: what the initial state and all that is not
        decided give, what the worst disturbance adds, and such a disturbance (`worst_disturbance`)."""
        at = (np.array([time]), direction[None], parameter[None])
        free, gains, B, W = self.response.adjoint(*at)
        rest = float(free[0] @ self.response.initial_state + self.given(gains @ B)[0])
        worst: Array | None = None if self.disturbance is None else self.disturbance.worst(gains @ W)[0]
        return rest, float(self._support(gains, W, *at)[0]), worst

    @cached_property
    def measurable(self) -> MeasurableSupport:
        """The support of measurable disturbances; the ``shared`` one where it is of this system and set."""
        assert self.disturbance is not None
        given = self.shared
        if given and given.response.propagator is self.response.propagator and given.bound is self.disturbance.bound:
            return given
        return MeasurableSupport(self.response, self.disturbance.bound)

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
        acting = self.response.grid.control_piece[self.response.grid.decided]
        starts = np.flatnonzero(np.diff(acting, prepend=-1))
        on_pieces = np.add.reduceat(self.decided(weights), starts, axis=1)
        if starts.size < self.dictionary.pieces:  # the last ones act after the horizon
            every = np.zeros((weights.shape[0], self.dictionary.pieces, self.channels))
            every[:, acting[starts]] = on_pieces
            on_pieces = every
        coefficients = on_pieces if self.dictionary.is_indicators else self.dictionary.values @ on_pieces
        return coefficients.swapaxes(1, 2).reshape(-1, self.variables)

    @shaped
    def on_grid(self, theta: Float[Array, " n"]) -> Float[Array, "mc L"]:
        """What acts through the columns of ``B`` on the pieces of the merged grid, ``(m + constants, L)``: the control,
        and all that is not decided."""
        return self.response.grid.inputs(self.dictionary.control(theta))

    @shaped
    def _support(
        self,
        gains: Float[Array, "k L d"],
        W: Float[Array, "k d mw"],
        times: Float[Array, " k"],
        directions: Float[Array, "k d"],
        parameters: Float[Array, "k nu"],
    ) -> Float[Array, " k"]:
        if self.disturbance is None:
            return np.zeros(times.size)
        if self.disturbance.kind == "measurable":
            return self.measurable(times, directions, parameters)
        return self.disturbance.support(gains @ W)

    @cached_property
    def _gives(self) -> bool:
        return bool(self.known.any())

    def _chunks(self, count: int) -> list[slice]:
        size = max(1, CHUNK // (self.response.grid.pieces * self.response.initial_state.size))
        return [slice(start, start + size) for start in range(0, count, size)]
