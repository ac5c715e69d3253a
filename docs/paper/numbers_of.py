"""Every number of the page, taken from finished runs and drawn trajectories: plain JSON, so that the page can be
written again without them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from cloud import Cloud, model_of, sampled
from studies import WEIGHTS

import sparserob_core as sr

SMALLEST_ERROR = 1e-12


def numbers_of(
    outcomes: Mapping[str, sr.Outcome],
    clouds: Mapping[str, Cloud],
    bracket: tuple[float, float],
    answered: Mapping[str, float],
) -> dict[str, Any]:
    """What the page says, and nothing that differs from one run to the next (times, versions)."""
    return {
        "runs": {name: run_numbers(outcome) for name, outcome in outcomes.items()},
        "draws": {
            name: {
                "count": cloud.violation.size,
                "broken": int(cloud.broken.sum()),
                "worst": float(cloud.violation.max()),
            }
            for name, cloud in clouds.items()
        },
        "epsilon": _sweep(outcomes),
        "bracket": list(bracket),
        "answered": dict(answered),
        "deviation": [
            float(value) for value in (clouds["nominal1"].upper[:, -1] - clouds["nominal1"].lower[:, -1]) / 2
        ],
        "spread": [float(value) for value in clouds["nominal1"].states[:, -1].std(axis=0)],
        "disagreement": _disagreement(outcomes["search1"], clouds["search1"]),
        "coefficients": float(np.abs(outcomes["repaired1"].result.decision).sum()),
        "largest": float(np.abs(outcomes["repaired1"].control).max()),
        "indices": _indices(outcomes["search1"]),
        "interior": _interior(outcomes["repaired2"]),
    }


def run_numbers(outcome: sr.Outcome) -> dict[str, Any]:
    """What is kept of one run."""
    summary, result = outcome.summary, outcome.result
    kept = ("status", "message", "cost", "lower_bound", "upper_bound", "gap", "epsilon", "worst", "sparsity")
    bound = None if result.scenario_bound is None else asdict(result.scenario_bound)
    found = {**{name: _plain(summary[name]) for name in kept}, "scenario_bound": bound}
    return {**found, "worst": None} if result.decision is None else found


def _plain(value: Any) -> Any:
    """Without what JSON cannot say: infinite numbers and arrays."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value


def _sweep(outcomes: Mapping[str, sr.Outcome]) -> list[dict[str, float]]:
    """Per weight: the cost, the share of time active, and how far (in L1) the control is from the one of the smallest
    weight."""
    last = outcomes[f"epsilon_{WEIGHTS[-1]:g}"].control
    lengths = np.diff(outcomes["repaired1"].experiment.control.breakpoints)
    return [
        {
            "epsilon": weight,
            "cost": outcome.result.cost,
            "active": outcome.summary["sparsity"]["active_fraction"],
            "distance": float((np.abs(outcome.control - last) * lengths).sum()),
        }
        for weight in WEIGHTS
        for outcome in [outcomes[f"epsilon_{weight:g}"]]
    ]


def _disagreement(outcome: sr.Outcome, cloud: Cloud) -> float:
    """How far ``x(T)`` of all draws differs between the forward march and the adjoint, the larger one of that and
    `SMALLEST_ERROR`."""
    model = model_of(outcome)
    _, noise = sampled(model, cloud.violation.size)
    still, error = np.zeros((cloud.violation.size, 0)), SMALLEST_ERROR
    for state, axis in enumerate(np.eye(cloud.states.shape[2])):
        G, offset = model.functionals.rows_under(
            np.full(still.shape[0], cloud.times[-1]), np.tile(axis, (still.shape[0], 1)), still, noise
        )
        backward = G @ outcome.result.decision + offset
        error = max(error, float(np.abs(backward - cloud.states[:, -1, state]).max()))
    return error


def _indices(outcome: sr.Outcome) -> int:
    """How many numbers a tuple of the search is made of: as many indices as decision variables, each a time and every
    block of the disturbance."""
    disturbance = model_of(outcome).functionals.disturbance
    return int(outcome.program.n * (1 + disturbance.block_count * disturbance.set.dimension))


def _interior(outcome: sr.Outcome) -> bool:
    """Whether the worst parameter is no vertex of its box."""
    box, worst = outcome.problem.system.parameters, np.asarray(outcome.result.worst.parameter)
    return bool((np.minimum(worst - box.lower, box.upper - worst) > 1e-6 * (box.upper - box.lower)).any())
