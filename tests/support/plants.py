"""Independent computations for the tests of the control wing: simulation by augmented exponentials, reachable sets,
random plants."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.linalg import expm

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.control.problem.system import LinearSystem
from sparserob_core.control.reach.functional import WorstFunctionals
from sparserob_core.control.response.disturbance import disturbance_model
from sparserob_core.control.response.response import Response
from sparserob_core.control.response.time_grid import merge_grids


def indicators(breakpoints):
    breakpoints = np.asarray(breakpoints, dtype=float)
    return Dictionary(breakpoints, np.eye(breakpoints.size - 1))


def uniform(pieces, horizon):
    return indicators(np.linspace(0.0, horizon, pieces + 1))


def walsh(pieces, horizon, functions=None):
    values = np.ones((1, 1))
    while values.shape[0] < pieces:
        values = np.block([[values, values], [values, -values]])
    return Dictionary(np.linspace(0.0, horizon, pieces + 1), values[:functions])


def worst_case(system, control, disturbance=None, bound=None, kind="piecewise_constant", initial_state=None):
    """The functionals of a system; ``disturbance`` defaults to the control's dictionary."""
    disturbance = disturbance or control
    grid = merge_grids(control.breakpoints, disturbance.breakpoints)
    model = None if bound is None else disturbance_model(kind, bound, disturbance, grid)
    start = np.zeros(system.states) if initial_state is None else np.asarray(initial_state, dtype=float)
    return WorstFunctionals(Response(system, grid, start), control, model)


def held(breakpoints, values, time):
    """The value ``(channels,)`` just before ``time`` of a piecewise constant function."""
    piece = int(np.clip(np.searchsorted(breakpoints, time, side="left") - 1, 0, values.shape[1] - 1))
    return values[:, piece]


def simulated(A, drives, start, time, breakpoints):
    """``x(time)`` of ``x' = A x + sum_j M_j f_j``, ``drives`` a list of ``(M, breakpoints, values)``: one augmented
    exponential per piece."""
    cuts = np.unique(
        np.concatenate([[0.0, time], *[b[(b > 0) & (b < time)] for _, b, _ in drives], breakpoints[breakpoints < time]])
    )
    state = np.asarray(start, dtype=float)
    for left, right in itertools.pairwise(cuts):
        force = sum((M @ held(b, v, (left + right) / 2) for M, b, v in drives), np.zeros(state.size))
        block = np.zeros((state.size + 1, state.size + 1))
        block[:-1, :-1], block[:-1, -1] = A, force
        state = (expm(block * (right - left)) @ np.append(state, 1.0))[:-1]
    return state


def weight_on_piece(A, E, direction, time, left, right):
    """``int_left^right c'e^{A(time - s)} E ds`` restricted to ``s <= time``, by simulating one unit input at a time."""
    right = min(right, time)
    if right <= left:
        return np.zeros(E.shape[1])
    columns = []
    for i in range(E.shape[1]):
        block = np.zeros((A.shape[0] + 1, A.shape[0] + 1))
        block[:-1, :-1], block[:-1, -1] = A, E[:, i]
        state = expm(block * (right - left))[:-1, -1]
        columns.append(direction @ expm(A * (time - right)) @ state)
    return np.array(columns)


def random_system(rng, states=2, controls=1, disturbances=2, speed=1.0):
    A = speed * rng.normal(size=(states, states))
    return LinearSystem(A, rng.normal(size=(states, controls)), rng.normal(size=(states, disturbances)))
