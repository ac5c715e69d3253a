"""Ten thousand random trajectories of a control, and the worst case that they never meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import sparserob_core as sr
from sparserob_core.control.constraints.scenario import sample_disturbances, sample_parameters
from sparserob_core.control.transcription.record import Transcription

TRAJECTORIES = 10_000
SEED = 1


@dataclass(frozen=True, eq=False)
class Cloud:
    """The states ``(n, T, d)`` of ``n`` draws at the ends ``times (T,)`` of the pieces, every piece of a disturbance
    and every parameter uniform and independent; ``violation (n,)``: the largest violation of each draw at these times,
    negative when all constraints hold.

    ``lower``, ``upper`` ``(d, T)``: the worst case of every state, over all disturbances; of uncertain parameters only
    a lattice is tried.
    """

    times: sr.Array
    states: sr.Array
    violation: sr.Array
    lower: sr.Array
    upper: sr.Array

    @property
    def broken(self) -> np.ndarray:
        """Which draws break a constraint."""
        return np.asarray(self.violation > 1e-9)


def model_of(outcome: sr.Outcome) -> Transcription:
    """The transcription of a run's problem."""
    return outcome.experiment.transcription


def cloud_of(outcome: sr.Outcome, count: int = TRAJECTORIES) -> Cloud:
    """Draw ``count`` disturbances and parameters and follow them under the control of a run."""
    model = model_of(outcome)
    parameters, drawn = sampled(model, count)
    control = model.pieces(outcome.result.decision)
    states = model.response.states(control, parameters, drawn)
    return Cloud(model.response.grid.breakpoints, states, _violation(model, states), *_tube(model, control))


def sampled(model: Transcription, count: int) -> tuple[sr.Array, sr.Array | None]:
    """Parameters ``(count, nu)`` and disturbances ``(count, mw, L)`` (or ``None``); the seed is always the same."""
    rng, noise = np.random.default_rng(SEED), model.functionals.disturbance
    parameters = sample_parameters(model.parameters.set, count, rng)
    return parameters, None if noise is None else sample_disturbances(noise, count, rng)


def _violation(model: Transcription, states: sr.Array) -> sr.Array:
    times = model.response.grid.breakpoints
    worst = np.full(states.shape[0], -np.inf)
    for window in model.problem.path:
        stop = model.problem.horizon if window.stop is None else window.stop
        inside = (times >= window.start - 1e-9) & (times <= stop + 1e-9)
        worst = np.maximum(worst, window.set.violation(states[:, inside]).max(axis=1))
    for terminal in model.problem.terminal:
        if isinstance(terminal, sr.ConvexSet):
            worst = np.maximum(worst, terminal.violation(states[:, -1]))
    return worst


def _tube(model: Transcription, control: sr.Array) -> tuple[sr.Array, sr.Array]:
    lattice, _ = model.parameters.lattice()
    paths = model.response.states(control, lattice)
    count, instants, size = paths.shape
    times, at = np.tile(model.response.grid.breakpoints, count), np.repeat(lattice, instants, axis=0)
    lower, upper = np.empty((size, instants)), np.empty((size, instants))
    for state in range(size):
        direction = np.tile(np.eye(size)[state], (times.size, 1))
        above, below = (
            model.functionals.offsets(times, side * direction, at).reshape(count, instants) for side in (1.0, -1.0)
        )
        upper[state], lower[state] = (paths[:, :, state] + above).max(axis=0), (paths[:, :, state] - below).min(axis=0)
    return lower, upper


def reachable_end(outcome: sr.Outcome, directions: int = 360) -> sr.Array:
    """Corners ``(k, 2)`` of all ``(x1, x2)`` that a disturbance can lead to at the horizon, from ``k`` support
    directions; for a known system."""
    model = model_of(outcome)
    angles = np.linspace(0.0, 2 * np.pi, directions, endpoint=False)
    normals = np.zeros((directions, model.response.initial_state.size))
    normals[:, 0], normals[:, 1] = np.cos(angles), np.sin(angles)
    still = model.response.states(model.pieces(outcome.result.decision), np.zeros((1, 0)))[0, -1]
    support = normals @ still + model.functionals.offsets(
        np.full(directions, model.problem.horizon), normals, np.zeros((directions, 0))
    )
    return np.array([np.linalg.solve(normals[[i - 1, i], :2], support[[i - 1, i]]) for i in range(directions)])
