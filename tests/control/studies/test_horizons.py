"""Guards control/studies/horizons: what multipliers prove of all horizons of an interval is never above the truth at
any of them, and close to it on short intervals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

import sparserob_core as sr
from sparserob_core.control.studies.horizons import Horizons, Multiplier, shorten_horizon, stretch_dictionary

PIECES = 6
LONGEST = 4.0


def problem(kind: str, rng: np.random.Generator) -> sr.OptimalControlProblem:
    A, B, E = rng.normal(size=(2, 2)), rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    parameters = sr.Box([-0.2], [0.3]) if kind == "uncertain" else None
    c = rng.normal(size=2) if kind == "drift" else None
    system = sr.LinearSystem((lambda p: A * (1.0 + p[0])) if parameters else A, B, E, parameters=parameters, c=c)
    return sr.OptimalControlProblem(
        system=system,
        horizon=LONGEST,
        initial_state=rng.normal(size=2),
        initial_set=sr.Ellipsoid(np.zeros(2), np.diag([0.01, 0.04])) if kind == "begun" else None,
        control=sr.Ellipsoid(np.zeros(2), np.eye(2)) if kind == "round" else sr.Box([-1.0, -0.5], [1.0, 2.0]),
        disturbance=None if kind == "known" else sr.Box([-0.1, -0.2], [0.1, 0.2]),
        disturbance_class="measurable" if kind == "measurable" else "piecewise_constant",
        path=[sr.PathConstraint(sr.Box([-1.0, -1.0], [1.0, 1.0]), 0.7)],
        terminal=[sr.Box([-0.3, -0.3], [0.3, 0.3])],
    )


def truth(of: sr.OptimalControlProblem, rows: list[Multiplier], T: float, low: float) -> float:
    """The least weighted sum over all controls at one horizon, by matrix exponentials of every piece; the disturbance
    is the worst constant on every piece."""
    edges, total, slopes = np.linspace(0.0, T, PIECES + 1), 0.0, np.zeros((PIECES, 2))
    for one in rows:
        A, B, E = (matrix[0] for matrix in of.system.phases[0].matrices(one.parameter[None]))
        time = T * max(one.share, one.earliest / low)
        drift = np.zeros(2) if of.system.phases[0].c is None else np.asarray(of.system.phases[0].c, dtype=float)[:, 0]
        free = one.direction @ expm(A * time)
        value = free @ of.initial_state - one.limit
        value += 0.0 if of.initial_set is None else float(of.initial_set.support(free[None])[0])
        for k in range(PIECES):
            start, stop = min(edges[k], time), min(edges[k + 1], time)
            big = expm(np.block([[A, np.eye(2)], [np.zeros((2, 4))]]) * (stop - start))[:2, 2:]
            gain = one.direction @ expm(A * (time - stop)) @ big
            slopes[k] += one.weight * gain @ B
            value += gain @ drift
            if of.disturbance is not None:
                value += float(of.disturbance.support((gain @ E)[None])[0])
        total += one.weight * value
    return total - float(of.control.support(-slopes).sum())


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", ["known", "disturbed", "uncertain", "drift", "begun", "round", "measurable"])
def test_what_is_proven_of_an_interval_holds_at_every_horizon_in_it(kind):
    rng = np.random.default_rng(len(kind))
    of, pieces = problem(kind, rng), sr.Dictionary(np.linspace(0, LONGEST, PIECES + 1), np.eye(PIECES))
    cells = Horizons(of, pieces, pieces)
    parameter = np.array([0.1]) if kind == "uncertain" else np.zeros(0)
    for low, width in ((1.0, 1e-6), (1.0, 0.05), (0.8, 0.6), (2.5, 1.0)):
        rows = [
            Multiplier(weight, share, direction, parameter, 0.3, earliest)
            for weight, share, direction, earliest in zip(
                rng.uniform(0.1, 1.0, 3), (1.0, 0.9, 0.7 / low), rng.normal(size=(3, 2)), (0.0, 0.7, 0.7), strict=True
            )
        ]
        proven = cells.amount(rows, low, low + width)
        true = [truth(of, rows, T, low) for T in np.linspace(low, low + width, 25)]
        assert proven <= min(true) + 1e-12
        if width < 1e-5:
            assert proven >= min(true) - 1e-4


def test_the_interval_down_to_zero_is_proven():
    of = problem("disturbed", np.random.default_rng(0))
    pieces = sr.Dictionary(np.linspace(0, LONGEST, PIECES + 1), np.eye(PIECES))
    away = np.sign(of.initial_state[0]) * np.array([1.0, 0.0])
    amount = Horizons(of, pieces, pieces).amount([Multiplier(1.0, 1.0, away, np.zeros(0), 0.0)], 0.0, 1e-3)
    assert 0.0 < amount <= abs(of.initial_state[0])


def test_a_row_whose_window_has_not_begun_counts_for_nothing():
    of = problem("known", np.random.default_rng(1))
    pieces = sr.Dictionary(np.linspace(0, LONGEST, PIECES + 1), np.eye(PIECES))
    row = Multiplier(1.0, 1.0, np.array([1.0, 0.0]), np.zeros(0), -100.0, earliest=0.7)
    cells = Horizons(of, pieces, pieces)
    assert cells.amount([row], 0.71, 0.8) > 0.0
    assert cells.amount([row], 0.6, 0.8) == -np.inf


def test_a_shorter_horizon_keeps_windows_in_absolute_time_and_the_number_of_pieces():
    of = problem("known", np.random.default_rng(2))
    assert shorten_horizon(of, 2.0).path[0].start == 0.7 and shorten_horizon(of, 2.0).path[0].stop == 2.0
    assert shorten_horizon(of, 0.7).path[0].start == shorten_horizon(of, 0.7).path[0].stop == 0.7
    assert not shorten_horizon(of, 0.6).path
    uneven = stretch_dictionary(sr.Dictionary([0.0, 1.0, 4.0], np.eye(2)), 2.0)
    np.testing.assert_array_equal(uneven.breakpoints, [0.0, 0.5, 2.0])
