"""Guards control/enclosures/decoupling and comparison: coordinates of stiff, defective and badly scaled matrices, their
rounding in exact arithmetic, and norm bounds that sampling never exceeds."""

from __future__ import annotations

from itertools import product

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from sparserob_core.control.enclosures import decoupling as module
from sparserob_core.control.enclosures.comparison import ComparisonSystem, block_norms, block_sizes, comparison_matrix
from sparserob_core.control.enclosures.decoupling import MANY, _cluster_eigenvalues, decoupled, decoupled_transitions

MATRICES = {
    "a number": [[-3.0]],
    "chemistry": [[-1000.0, 990.0, 0.0], [0.0, -50.0, 49.0], [0.0, 0.0, -1.0]],
    "servo": [[0.0, 1.0], [-1e6, -1000.0]],
    "integrators": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]],
    "orbit in seconds": [[0, 0, 1, 0], [0, 0, 0, 1], [3 * 0.00113**2, 0, 0, 0.00226], [0, 0, -0.00226, 0]],
    "a fast mode beside integrators": [[0, 1, 0, 0], [0, 0, 0, 0], [0, 1, -1000, 3], [1, 0, -1e6, -1000]],
    "a defective fast mode": [[-500.0, 500.0, 0.0], [0.0, -500.0, 1.0], [0.0, 0.0, -1.0]],
    "a double oscillator": [[0, 1, 1, 0], [-1, 0, 0, 1], [0, 0, 0, 1], [0, 0, -1, 0]],
    "units of 1e5": [[-1.0, 1e-5], [1e5, -2.0]],
    "nothing": [[0.0, 0.0], [0.0, 0.0]],
}


def made(A):
    """The decoupling of ``A``, its normal form, and a bound of what is left out, entry by entry."""
    basis = decoupled(A)
    moved, rounded = basis.matrix(A)
    D = basis.normal_form(moved)
    return basis, D, rounded + np.abs(moved - D)


def exact(matrix):
    return flint.fmpq_mat(
        [[flint.fmpq(*float(entry).as_integer_ratio()) for entry in row] for row in np.atleast_2d(matrix).tolist()]
    )


def difference(left, right):
    """``|left - right|`` of rational matrices, in floating point."""
    rest = left - right
    return np.array([[abs(float(entry.p) / float(entry.q)) for entry in row] for row in rest.tolist()])


@pytest.mark.parametrize("name", sorted(MATRICES))
def test_what_the_coordinates_leave_out_is_bounded_in_exact_arithmetic(name):
    A = np.array(MATRICES[name], dtype=float)
    basis, D, slack = made(A)
    T = exact(basis.transform)
    assert (difference(T.inv() * exact(A) * T, exact(D)) <= slack).all()
    column = np.arange(1.0, 1 + A.shape[0])[:, None]
    moved, rounded = basis.vector(column)
    assert (difference(T.inv() * exact(column), exact(moved)) <= rounded).all()
    assert slack.max() <= 1e-12 * max(1.0, np.abs(D).max())


@pytest.mark.parametrize("name", sorted(MATRICES))
def test_the_exponential_by_modes_is_that_of_the_matrix(name):
    A = np.array(MATRICES[name], dtype=float)
    basis, D, _ = made(A)
    flow, driven = decoupled_transitions(basis, D, np.array([0.0, 1e-3, 0.4]))
    for r, part, integral in zip([0.0, 1e-3, 0.4], flow, driven, strict=True):
        block = np.zeros((2 * A.shape[0],) * 2)
        block[: A.shape[0], : A.shape[0]], block[: A.shape[0], A.shape[0] :] = A, np.eye(A.shape[0])
        truth = expm(block * r)
        d, T, V = A.shape[0], basis.transform, basis.inverse.astype(float)
        size = np.abs(T) @ np.maximum(np.abs(part), np.ones((d, d))) @ np.abs(V)
        assert (np.abs(T @ part @ V - truth[:d, :d]) <= 1e-9 * size).all()
        assert (np.abs(T @ integral @ V - truth[:d, d:]) <= 1e-9 * r * size).all()


def test_far_modes_do_not_share_a_group():
    assert decoupled(np.array(MATRICES["chemistry"])).groups.tolist() == [0, 1, 2]
    assert decoupled(np.array(MATRICES["a fast mode beside integrators"])).groups.tolist() == [0, 2]


def leaning(states, condition):
    """Lightly damped modes, closer than a hundredth of the fastest, in coordinates of that condition."""
    rng = np.random.default_rng(3)
    left, right = (np.linalg.qr(rng.standard_normal((states, states)))[0] for _ in range(2))
    T, D = left @ np.diag(np.geomspace(1.0, condition, states)) @ right, np.zeros((states, states))
    for mode in range(states // 2):
        at, turn = 2 * mode, 10.0 + 0.05 * mode
        D[at : at + 2, at : at + 2] = [[-0.1, turn], [-turn, -0.1]]
    return T @ D @ np.linalg.inv(T)


def test_modes_of_many_states_come_apart_though_they_lean_towards_each_other():
    A = leaning(MANY, 2e4)
    basis, D, slack = made(A)
    assert basis.groups.size == basis.starts.size == MANY // 2
    with flint.ctx.workprec(200):
        T = flint.arb_mat(basis.transform.tolist())
        rest = T.inv() * flint.arb_mat(A.tolist()) * T - flint.arb_mat(D.tolist())
        assert all(abs(rest[i, j]) <= slack[i, j] for i in range(MANY) for j in range(MANY))
    assert slack.max() <= 1e-9 * np.abs(D).max()
    fewer, more = decoupled(leaning(MANY - 2, 2e4)), decoupled(leaning(MANY, 1e9))
    assert fewer.groups.size == more.groups.size == 1  # of few states, or where rounding would be felt, the Schur form


def test_a_fast_mode_does_not_cost_the_slow_one_its_digits():
    basis, D, _ = made(np.array([[-1e6, 1e6], [0.0, -1.0]]))
    flow, _ = decoupled_transitions(basis, D, np.array([1.0]))
    slow = basis.transform @ flow[0] @ basis.inverse.astype(float)
    assert abs(slow[1, 1] - np.exp(-1.0)) <= 4e-16


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6), d=st.integers(1, 5), stiff=st.booleans())
def test_no_trajectory_is_larger_than_the_comparison_system_allows(seed, d, stiff):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(d, d)) * 2.0 ** rng.integers(-8, 8, d)
    if stiff:
        A = A @ np.diag(-(10.0 ** rng.uniform(0, 3, d)))
    basis, D, _ = made(A)
    comparison = ComparisonSystem(comparison_matrix(D, basis.starts), block_sizes(D, basis.starts))
    z, width = rng.normal(size=d), 10.0 ** rng.uniform(-4, 0)
    if np.abs(np.linalg.eigvals(A).real).max() * width > 200:
        width = 200 / np.abs(np.linalg.eigvals(A).real).max()
    reach, norms = comparison.over(np.array([width])), block_norms(z, basis.starts)
    for r in width * np.linspace(0, 1, 21):
        flow, driven = (part[0] for part in decoupled_transitions(basis, D, np.array([r])))
        for moved, bound in (
            (flow @ z, reach.peak.matrices[0]),
            (driven @ z, reach.integral.matrices[0]),
            (flow @ z - z, reach.departure.matrices[0]),
        ):
            allowed = bound @ norms
            assert (block_norms(moved, basis.starts) <= allowed + 1e-9 * np.abs(allowed).max()).all()
    allowed = reach.flow.matrices[0] @ norms
    assert (block_norms(flow @ z, basis.starts) <= allowed + 1e-9 * np.abs(allowed).max()).all()


def test_a_stable_system_stays_bounded_however_long_it_runs():
    basis, D, _ = made(np.array(MATRICES["a defective fast mode"]))
    comparison = ComparisonSystem(comparison_matrix(D, basis.starts), block_sizes(D, basis.starts))
    assert comparison.over(np.array([1e3])).peak.matrices.max() <= 20.0


@pytest.mark.parametrize("seed", range(3))
def test_a_long_chain_of_masses_comes_apart_in_whatever_units_its_states_are(seed):
    """Sizes along a chain grow and fall without any state that differs much from its neighbours."""
    count = 30
    stiffness = 2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    chain = np.block([[np.zeros((count, count)), np.eye(count)], [-stiffness, -0.1 * stiffness - 0.05 * np.eye(count)]])
    units = 2.0 ** np.random.default_rng(seed).integers(-30, 30, 2 * count)
    assert decoupled(chain * units / units[:, None]).groups.size == count


def test_eigenvalues_that_are_near_each_other_are_one_cluster_in_chains():
    values = np.array([1.0, 5.0, 1.3, -2.0 + 0.1j, -2.0 - 0.1j, 1.6, 5.25])
    found = [np.flatnonzero(one).tolist() for one in _cluster_eigenvalues(values, 0.3000001)]
    assert found == [[0, 2, 5], [1, 6], [3, 4]]
    assert [one.tolist() for one in _cluster_eigenvalues(np.array([1.0, 2.0, 3.0]), 0.5)] == np.eye(
        3, dtype=bool
    ).tolist()
    assert len(_cluster_eigenvalues(np.array([1.0, 2.0, 3.0]), 1.0)) == 1


def test_what_is_wrong_with_an_inverse_is_in_its_bound_to_either_side(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an inverse that is told to be off by a thousandth, in every pattern of signs."""
    T, exact = np.array([[2.0, 1.0], [1.0, 1.0]]), np.array([[1.0, -1.0], [-1.0, 2.0]])
    for signs in product((-1.0, 1.0), repeat=4):
        rough = exact + 1e-3 * np.array(signs).reshape(2, 2)
        with monkeypatch.context() as told:
            told.setattr(np.linalg, "inv", lambda _, rough=rough: rough)
            found = module._verify_inverse(T, np.zeros(1, dtype=int), np.zeros(2, dtype=int))
        assert found is not None
        off = np.abs(exact - np.asarray(found.inverse, dtype=float))
        assert (off <= found.defect @ np.abs(np.asarray(found.inverse, dtype=float))).all() and off.max() > 1e-7
