"""Guards control/studies/adjoint and suprema: bounds on cells against dense samples of the truth, that are not far from
it; witnesses that reach what is claimed."""

from __future__ import annotations

from itertools import pairwise
from math import cos

import numpy as np
import pytest
from scipy.linalg import expm

from sparserob_core.control.sets.sets import Box, Polytope
from sparserob_core.control.studies.adjoint import Adjoint, DisturbanceInputs, WorstRow, tidy

A = np.array([[0.0, 1.0, 0.0], [-9.0, -0.4, 2.0], [0.3, 0.0, -1.5]])
B = np.array([[0.0, 0.2], [1.0, 0.0], [0.0, 1.0]])
C, HORIZON = np.array([1.0, 0.3, -0.5]), 4.0
GRID = np.array([0.0, 0.7, 1.9, 3.1, 4.0])


def worst(kind: str, sign: float = 1.0) -> WorstRow:
    changes = None if kind == "measurable" else GRID
    pushes = None if kind == "none" else DisturbanceInputs(Box([-0.2], [0.5]), slice(1, 2), changes)
    return WorstRow(
        Adjoint.of(A, B if pushes is not None else B[:, :1], sign * C, HORIZON),
        np.array([0.2, -1.0, 0.4]),
        Polytope([[1, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], [0.1, 0.1, 0.1, 0.05, 0.05]),
        GRID,
        np.array([[0.3, -1.0, 0.0, 0.8]]),
        pushes,
    )


def integral(a: float, b: float, weigh: object, column: int) -> float:
    """Simpson's rule on 400 parts."""
    s = np.linspace(a, b, 801)
    values = np.array([weigh((C @ expm(A * r))[None] @ B[:, column : column + 1]) for r in s]).ravel()
    return float((b - a) / 2400.0 * (values[0] + values[-1] + 4.0 * values[1:-1:2].sum() + 2.0 * values[2:-1:2].sum()))


def truth(row: WorstRow, kind: str, t: float) -> float:
    """By transitions and quadrature."""
    line = C @ expm(A * t)
    total = float(line @ row.centre + row.initial_deviations.support(line[None])[0])
    for a, b, u in zip(GRID[:-1], GRID[1:], row.drives[0], strict=True):
        if a < t:
            total += u * integral(t - min(b, t), t - a, np.asarray, 0)
    if kind == "measurable":
        total += integral(0.0, t, lambda g: np.maximum(0.5 * g, -0.2 * g), 1)
    if kind == "constant":
        for a, b in pairwise(GRID):
            if a < t:
                g = integral(t - min(b, t), t - a, np.asarray, 1)
                total += max(0.5 * g, -0.2 * g)
    return total


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", ["none", "constant", "measurable"])
def test_values_are_those_of_transitions_and_quadrature(kind: str) -> None:
    row = worst(kind)
    for t in (0.0, 0.3, 2.2, 4.0):
        low, high = (side[0] for side in row.at(np.array([t])))
        exact = truth(row, kind, t)
        assert low - 5e-6 <= exact <= high + 5e-6
        assert high - low <= 1e-12


@pytest.mark.first(3)
@pytest.mark.parametrize("kind", ["none", "constant", "measurable"])
@pytest.mark.parametrize("parts", [1, 3])
def test_cells_bound_every_value_in_them_closely(kind: str, parts: int) -> None:
    row = worst(kind)
    cuts = row.cuts()
    ends = np.unique(np.concatenate([np.linspace(a, b, parts + 1) for a, b in pairwise(cuts)]))
    bounds = row.enclosed(ends[:-1], ends[1:])
    inside = ends[:-1, None] + np.diff(ends)[:, None] * np.linspace(0.0, 1.0, 21)
    values = row.at(inside.ravel())[1].reshape(inside.shape)
    assert (bounds[:, None] >= values).all()
    spread = bounds - values.max(axis=1)
    longest = np.diff(ends).max()
    assert spread.max() <= 40.0 * longest**2
    # chords are exceeded by a fair share of what is added to them: far less of it would be too little
    chords = np.maximum(values[:, 0], values[:, -1])
    above = values.max(axis=1) - chords
    assert above.max() > 0.08 * (bounds - chords)[above.argmax()]


@pytest.mark.parametrize("kind", ["none", "constant", "measurable"])
def test_a_witness_reaches_the_worst_value(kind: str) -> None:
    row = worst(kind)
    for t in (0.5, 2.5, 3.75):
        deviation, changes, signal = row.witness(t)
        assert row.initial_deviations.contains(deviation)
        assert row.evaluate(t, deviation, changes, signal) == pytest.approx(row.at(np.array([t]))[1][0], abs=1e-10)
        if kind == "constant":
            assert np.isin(changes, GRID).all()


def test_the_other_sign_is_the_same_adjoint_reversed() -> None:
    one, other = worst("none"), worst("none", -1.0)
    assert np.allclose(one.adjoint.reversed().nodes, other.adjoint.nodes, rtol=0, atol=1e-15)


def test_tidy_times_have_exact_differences() -> None:
    times = tidy(np.array([0.1, 1 / 3, 2.0**-60, 0.7]), 0.7)
    assert times[-1] == 0.7
    assert all(
        float(b - a) == b.as_integer_ratio()[0] / b.as_integer_ratio()[1] - a for a, b in pairwise(times[:3].tolist())
    )
    assert np.abs(times - [0.1, 1 / 3, 0.0, 0.7]).max() <= 1e-13


def test_what_a_transition_is_off_by_counts_as_often_as_there_are_steps() -> None:
    """A rotation, whose cosine is known: squaring doubles the error, and adds none that counting squarings would
    see."""
    for horizon in (3e3, 3e4):
        turning = Adjoint.of(np.array([[0.0, 1.0], [-1.0, 0.0]]), np.zeros((2, 1)), np.array([1.0, 0.0]), horizon)
        row = WorstRow(turning, np.array([1.0, 0.0]), None, np.array([0.0, horizon]), np.zeros((1, 1)), None)
        assert abs(float(row.at(np.array([horizon]))[0][0]) - cos(horizon)) < row.error_bound < 1e-10
