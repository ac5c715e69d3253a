"""Guards control/enclosures/flows: exponentials on vectors are those of the matrices, within the rounding that is
claimed of them; and no matrix is made for a duration."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.linalg import expm

from sparserob_core.control.enclosures.decoupling import decoupled, identity
from sparserob_core.control.enclosures.flows import DoublingExponentials, Flows
from sparserob_core.control.enclosures.matrix_exponential import exponential_rounding

RNG = np.random.default_rng(5)
TURNING = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.diag([1.0, 40.0, 900.0]) - 0.3, -0.2 * np.eye(3)]])
DEFECTIVE = np.eye(5, k=1) - 0.5 * np.eye(5)  # one eigenvalue, one vector: a group that is no single block
STILL = np.diag([0.0, -2.0, 0.0, 3.0])
DURATIONS = np.array([0.0, 1e-9, 0.013, 0.5, 1.0, 3.75, 17.3])


@pytest.mark.parametrize("A", [TURNING, DEFECTIVE, STILL, np.zeros((2, 2))])
def test_leaps_are_the_exponential_and_its_integral_on_rows(A: np.ndarray) -> None:
    rows, d = RNG.normal(size=(DURATIONS.size, A.shape[0])), A.shape[0]
    flown, driven = DoublingExponentials(A).rows(rows, DURATIONS)
    size = np.abs(A).sum(axis=0).max() * DURATIONS
    for k, duration in enumerate(DURATIONS):
        both = expm(np.block([[A, np.eye(d)], [np.zeros((d, 2 * d))]]) * duration)
        most = exponential_rounding(2 * d, size[k : k + 1])[0]
        bounds = expm(np.block([[np.abs(A), np.eye(d)], [np.zeros((d, 2 * d))]]) * duration)
        for found, exact, bound in ((flown, both[:d, :d], bounds[:d, :d]), (driven, both[:d, d:], bounds[:d, d:])):
            allowed = 2.0 * most * (np.abs(rows[k]) @ bound) + 1e-13 * np.abs(rows[k] @ exact).max()
            assert (np.abs(found[k] - rows[k] @ exact) <= allowed).all()


@pytest.mark.parametrize("A", [TURNING, DEFECTIVE, np.kron(np.eye(3), TURNING)])
def test_orbits_are_every_row_over_every_duration(A: np.ndarray) -> None:
    rows, exponentials = RNG.normal(size=(2, A.shape[0])), DoublingExponentials(A)
    durations = np.concatenate([DURATIONS[::-1], DURATIONS[:2], [-1e-18]])
    each = exponentials.rows(np.tile(rows, (durations.size, 1)), np.repeat(durations, 2))
    for found, known in zip(exponentials.orbits(rows, durations), each, strict=True):
        assert found.reshape(known.shape) == pytest.approx(known, rel=1e-12, abs=1e-12 * np.abs(known).max())
    assert exponentials.orbits(rows, np.zeros(0))[0].shape == (0, *rows.shape)


@pytest.mark.parametrize("A", [TURNING, DEFECTIVE, STILL])
def test_flows_are_those_of_the_normal_form_on_rows_and_columns(A: np.ndarray) -> None:
    d = A.shape[0]
    for basis in (decoupled(A), identity(d)):
        D = basis.normal_form(basis.matrix(A)[0])
        rows, states = RNG.normal(size=(DURATIONS.size, 2, d)), RNG.normal(size=(2, DURATIONS.size, d))
        flown, driven = Flows(basis, D).rows(rows, DURATIONS)
        moved = Flows(basis, D).columns(*states, DURATIONS)
        for k, duration in enumerate(DURATIONS):
            both = expm(np.block([[D, np.eye(d)], [np.zeros((d, 2 * d))]]) * duration)
            ended = both[:d, :d] @ states[0, k] + both[:d, d:] @ states[1, k]
            known = (rows[k] @ both[:d, :d], rows[k] @ both[:d, d:], ended)
            for found, exact in zip((flown[k], driven[k], moved[k]), known, strict=True):
                assert found == pytest.approx(exact, rel=1e-11, abs=1e-11 * max(1.0, np.abs(both).max()))


def test_nothing_is_as_large_as_a_matrix_for_every_duration() -> None:
    d, k = 60, 2000
    rates = np.linspace(0.1, 3.0, d // 2)
    A = np.block([[np.zeros((d // 2, d // 2)), np.eye(d // 2)], [-np.diag(rates**2), -0.1 * np.eye(d // 2)]])
    basis, durations = decoupled(A), np.linspace(0.0, 5.0, k)
    flows, exponentials, rows = (
        Flows(basis, basis.normal_form(basis.matrix(A)[0])),
        DoublingExponentials(A),
        np.ones((k, 1, d)),
    )
    tracemalloc.start()
    flows.rows(rows, durations)
    exponentials.rows(rows[:, 0], durations)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 12 * rows.nbytes  # and 60 times the rows are 58 MB
