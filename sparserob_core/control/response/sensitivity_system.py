"""A system together with its derivatives in the parameters, as one larger system.

The rows ``r(s) = c'e^{A s}`` and their derivatives ``r_i = dr/dp_i`` obey ``r' = r A`` and
``r_i' = r_i A + r dA/dp_i``: the rows ``(r, r_1, ..., r_nu)`` are those of one linear system, which is propagated by
matrix exponentials, as any other.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sparserob_core.control.enclosures.cache import remember
from sparserob_core.control.problem.phase import Phase
from sparserob_core.control.problem.system import System
from sparserob_core.control.response.parameters import ParameterIndex
from sparserob_core.control.response.response import Response
from sparserob_core.errors import NotEnclosable
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.expressions.taylor import TaylorSpace
from sparserob_core.sip.relaxed.index_gradient import differences

# of the width of the parameters: the cell of the Taylor models, whose first coefficients do not depend on its size
CELL = 1e-6
POINTS_KEPT = 512  # parameters whose derivatives are remembered


def tangent(response: Response) -> Response:
    """Return the response whose functionals are ``c'x(t)`` and its derivatives in the ``nu`` parameters, for directions
    ``(c, 0, ..., 0)``.

    Its states are ``1 + nu`` blocks of ``d``. Its ``B`` and ``E`` hold those of the system and their derivatives, block
    below block. The response of a known system, or of one that changes with time, is returned as it is.
    """
    system, blocks = response.system, 1 + response.system.parameter_count
    if blocks == 1 or system.varies:
        return response
    larger = System(tuple(_augment_phase(phase) for phase in system.phases), system.parameters)
    return Response(
        larger, response.grid, np.concatenate([response.initial_state, np.zeros((blocks - 1) * system.states)])
    )


def _augment_phase(phase: Phase) -> Phase:
    at = Derivatives(phase)
    return Phase(
        lambda p: _build_row_matrix(at(p)[0]),
        lambda p: np.concatenate(at(p)[1]),
        lambda p: np.concatenate(at(p)[2]),
        phase.domain,
        phase.names,
        None,
        phase.begin,
        phase.until,
    )


@dataclass(frozen=True, eq=False)
class Derivatives:
    """The matrices of a phase and their derivatives in the parameters, at one parameter at a time.

    They are the first coefficients of Taylor models on a tiny cell, which are exact up to rounding. Where a function
    cannot be evaluated on Taylor models, they are second-order differences within the bounding box of the parameters.
    """

    phase: Phase
    _derivative_cache: dict[bytes, tuple[Array, Array, Array]] = field(default_factory=dict, repr=False)

    def __call__(self, parameter: Array) -> tuple[Array, Array, Array]:
        """Return ``A (1 + nu, d, d)``, ``B (1 + nu, d, m)``, ``E (1 + nu, d, mw)`` at ``parameter (nu,)``: values, then
        derivatives."""
        key = np.asarray(parameter, dtype=float).tobytes()
        if key not in self._derivative_cache:
            remember(
                self._derivative_cache, key, self._compute_derivatives(np.asarray(parameter, dtype=float)), POINTS_KEPT
            )
        return self._derivative_cache[key]

    @cached_property
    def _box(self) -> Box:
        return ParameterIndex(self.phase.domain).box

    def _compute_derivatives(self, parameter: Array) -> tuple[Array, Array, Array]:
        values = self.phase.matrices(parameter[None])
        try:
            slopes = self._differentiate_by_taylor(parameter)
        except NotEnclosable:
            slopes = self._differentiate_by_differences(parameter)
        A, B, E = (np.concatenate([value, slope]) for value, slope in zip(values, slopes, strict=True))
        return A, B, E

    def _differentiate_by_taylor(self, parameter: Array) -> tuple[Array, Array, Array]:
        box = self._box
        width = box.upper - box.lower
        radius = CELL * np.where(width > 0, width, 1.0 + np.abs(parameter))
        space = TaylorSpace(parameter.size, 1)
        coefficients = self.phase.taylor(space, parameter, radius)
        linear = [space.index[tuple(exponents)] for exponents in np.eye(parameter.size, dtype=int).tolist()]
        A, B, E = (coefficients[index][linear] / radius[:, None, None] for index in (0, 2, 4))
        return A, B, E

    def _differentiate_by_differences(self, parameter: Array) -> tuple[Array, Array, Array]:
        box = self._box
        shapes = [matrix.shape[1:] for matrix in self.phase.matrices(parameter[None])]

        def entries(points: Array, _: np.ndarray) -> Array:
            return np.hstack([matrix.reshape(points.shape[0], -1) for matrix in self.phase.matrices(points)])

        slopes = differences(entries, parameter[None], box.lower, box.upper)[0]
        blocks = np.split(slopes, np.cumsum([np.prod(shape) for shape in shapes])[:-1], axis=1)
        A, B, E = (block.reshape(-1, *shape) for block, shape in zip(blocks, shapes, strict=True))
        return A, B, E


def _build_row_matrix(A: Array) -> Array:
    """Return the matrix ``((1 + nu) d, (1 + nu) d)`` by which rows ``(r, r_1, ..., r_nu)`` are multiplied, from ``A``
    and its derivatives, ``(1 + nu, d, d)``."""
    blocks, d = A.shape[:2]
    matrix = np.kron(np.eye(blocks), A[0])
    matrix[:d, d:] = A[1:].swapaxes(0, 1).reshape(d, -1)
    return matrix
