"""Guards control/enclosures/comparison: bounds that nearly equal durations share hold for each of them, and cost
nothing but rounding; what is summed in blocks is what is summed piece by piece."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sparserob_core.control.enclosures import comparison
from sparserob_core.control.enclosures.comparison import ComparisonSystem, NormBounds, alike, product
from sparserob_core.control.enclosures.matrix_exponential import transitions

METZLER = {
    "stable": [[-1.0, 0.3, 0.0], [0.2, -2.0, 0.1], [0.0, 0.5, -0.7]],
    "stiff": [[-1e6, 1e3, 2.0], [0.0, -300.0, 1.0], [1e-9, 0.0, -0.01]],
    "unstable": [[3.0, 1.0, 0.0], [0.0, 1.5, 4.0], [1.0, 0.0, -2.0]],
    "apart": [[-0.3, 1e-14, 1e-14], [1e-14, -0.2, 1e-14], [1e-14, 1e-14, 0.1]],
    "nothing": [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
}
WIDTHS = {
    "equal": np.diff(np.linspace(0.0, 5.0, 300)),
    "tiny": 1e-9 * np.diff(np.linspace(0.0, 1.0, 40)),
    "unequal": np.array([1e-7, 0.3, 0.3 * (1 + 1e-12), 2.0, 1e-7 * (1 + 1e-11), 0.0, 0.7]),
    "one": np.array([0.25]),
    "none": np.zeros(3),
}


def made(name):
    M = np.array(METZLER[name])
    return ComparisonSystem(M, np.abs(M))


def one_by_one(M, widths):
    """What the bounds are for every duration on its own, without any room for rounding."""
    flow, integral = transitions(M, widths)
    peak = np.eye(M.shape[0]) + comparison.rising(M) @ integral
    return flow, integral, peak, np.minimum(np.abs(M) @ integral, np.eye(M.shape[0]) + peak)


def unshared(bounds):
    return bounds.matrices[bounds.which]


@pytest.mark.parametrize("widths", sorted(WIDTHS))
@pytest.mark.parametrize("name", sorted(METZLER))
def test_a_shared_bound_holds_for_every_duration_and_is_no_larger_than_rounding_asks(name, widths):
    system, lengths = made(name), WIDTHS[widths]
    for shared, alone in zip(system.over(lengths), one_by_one(system.metzler, lengths), strict=True):
        room = 1e-9 * np.abs(alone).max(axis=(1, 2), keepdims=True)  # of an exponential: its rounding is normwise
        assert (unshared(shared) >= (1.0 - 1e-9) * alone - room).all()
        assert (unshared(shared) <= (1.0 + 1e-5) * alone + 1e3 * room).all()


@pytest.mark.parametrize("name", sorted(METZLER))
def test_slips_that_are_shared_hold_for_every_duration(name):
    system, slack = made(name), np.full((3, 3), 1e-6)
    for lengths in WIDTHS.values():
        for shared, alone in zip(system.slips(slack, lengths), slips_of(system, slack, lengths), strict=True):
            room = 1e-9 * np.abs(alone).max()
            assert (unshared(shared) >= (1.0 - 1e-9) * alone - room).all()
            assert (unshared(shared) <= (1.0 + 1e-5) * alone + 1e3 * room).all()


def slips_of(system, slack, lengths):
    both = np.block([[system.metzler, slack], [np.zeros((3, 3)), system.metzler + slack]])
    return [part[:, :3, 3:] for part in transitions(both, lengths)]


@pytest.mark.parametrize("rates", [[-1.0, -0.3, -50.0, 0.0], [0.4, -2.0, 0.4, 0.0], [0.0, 0.0, 0.0, 0.0]])
def test_blocks_that_are_apart_are_bounded_by_numbers_closely(rates):
    coupling = 1e-9 * np.array([[0, 3, 1, 2], [2, 0, 5, 1], [4, 1, 0, 1], [1, 1, 6, 0.0]])
    M, rates, lengths = np.diag(rates) + coupling, np.array(rates), np.array([0.0, 1e-3, 0.1, 1.0, 7.0, 20.0])
    exact = exact_between(M, lengths)
    off = ~np.eye(4, dtype=bool)
    for bound, truth, close in zip(
        comparison.flows_apart(rates, coupling, lengths, lengths), exact, (1e-5, 9.0), strict=True
    ):
        room = 1e-13 * truth.max(axis=(1, 2), keepdims=True)  # what the orders from the second on may add too much
        assert (bound >= truth).all()
        assert (bound <= (1.0 + np.where(off, close, 1e-5)) * truth + room).all()
    between, within = comparison.flows_apart(rates, coupling, lengths[:-1], lengths[1:])
    for share in np.linspace(0.0, 1.0, 11):
        flow, integral = exact_between(M, lengths[:-1] + share * np.diff(lengths))
        assert (between >= (1.0 - 1e-12) * flow - 1e-24).all()
        assert (within >= (1.0 - 1e-12) * integral - 1e-24).all()


def test_what_comes_of_couplings_by_each_other_is_bounded_too(monkeypatch):
    monkeypatch.setattr(comparison, "SAFE", 1.0)
    rng, length = np.random.default_rng(3), np.array([0.8])
    for size in (0.02, 0.1):  # `APART` allows far less: there the other orders hide behind `SAFE`
        rates, equal = np.zeros(5), size * np.ones((5, 5))
        for coupling in (equal, equal * rng.uniform(0.0, 1.0, (5, 5))):
            exact = exact_between(np.diag(rates) + coupling, length)
            for bound, truth in zip(comparison.flows_apart(rates, coupling, length, length), exact, strict=True):
                assert (bound >= truth).all()


def exact_between(M, lengths):
    """The exponential and its integral by a series in long doubles, of short steps."""
    A, found = M.astype(np.longdouble), []
    for length in lengths:
        steps = max(1, int(np.ceil(np.abs(M).sum() * length)))
        term = flow = np.eye(len(M), dtype=np.longdouble)
        driven, width = np.zeros_like(A), np.longdouble(length) / steps
        for order in range(1, 30):
            driven = driven + term * width / order
            term = term @ A * width / order
            flow = flow + term
        whole, added = np.eye(len(M), dtype=np.longdouble), np.zeros_like(A)
        for _ in range(steps):
            whole, added = whole @ flow, added + whole @ driven
        found.append((whole, added))
    return np.array([flow for flow, _ in found]), np.array([driven for _, driven in found])


@pytest.mark.parametrize("name", sorted(METZLER))
def test_very_many_durations_share_bounds_in_steps_that_hold_for_each(name, monkeypatch):
    lengths = np.random.default_rng(0).uniform(1e-3, 1.0, 400)
    monkeypatch.setattr(comparison, "STORAGE_LIMIT", 900)
    system = made(name)
    found = system.over(lengths)
    assert found.flow.matrices.shape[0] < 400
    for shared, alone in zip(found, one_by_one(system.metzler, lengths), strict=True):
        assert (unshared(shared) >= (1.0 - 1e-9) * alone - 1e-9 * np.abs(alone).max(axis=(1, 2), keepdims=True)).all()


@settings(max_examples=100, deadline=None)
@given(
    durations=st.lists(st.floats(0.0, 1e6, allow_subnormal=False), min_size=1, max_size=30),
    most=st.sampled_from([10, 10**7]),
)
def test_no_duration_is_outside_of_its_group(durations, most):
    values = np.array(durations)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "STORAGE_LIMIT", most)
        shortest, longest, which = alike(values, 1)
    assert (shortest >= 0.0).all()
    assert ((shortest[which] <= values) & (values <= longest[which])).all()


def test_pieces_that_differ_by_rounding_share_one_matrix():
    for pieces in (1000, 1024, 99_999, 100_000):
        assert made("stable").over(np.diff(np.linspace(0.0, 5.0, pieces + 1))).flow.matrices.shape[0] == 1


@pytest.mark.parametrize("name", sorted(METZLER))
@pytest.mark.parametrize("count", [1, 255, 256, 300, 1000])
def test_what_is_summed_in_blocks_is_what_is_summed_piece_by_piece(name, count):
    rng = np.random.default_rng(count)
    flow = made(name).over(np.full(count, 5.0 / count)).flow
    start, added = rng.uniform(size=(2, 3)), rng.uniform(size=(2, count, 3))
    found, plain = flow.summed(start, added), np.empty((2, count + 1, 3))
    plain[:, 0] = start
    for piece in range(count):
        plain[:, piece + 1] = plain[:, piece] @ flow.matrices[0].T + added[:, piece]
    np.testing.assert_allclose(found, plain, rtol=1e-11)


@pytest.mark.parametrize("rate", [-1e6, 1e6])
def test_sums_of_bounds_that_overflow_are_infinite_and_never_no_number(rate):
    system = ComparisonSystem(np.diag([rate, -1.0]), np.diag([abs(rate), 1.0]))
    flow = system.over(np.full(1000, 1e-3)).flow
    found = flow.summed(np.ones(2), np.ones((1000, 2)))
    assert not np.isnan(found).any()
    assert np.isfinite(found[:, 1]).all()
    assert np.isinf(found[-1, 0]) == (rate > 0)


def test_nothing_times_infinity_is_nothing():
    left, right = np.array([[0.0, 2.0], [1.0, 0.0]]), np.array([[np.inf, 1.0], [0.0, 3.0]])
    np.testing.assert_array_equal(product(left, right), [[0.0, 6.0], [np.inf, 1.0]])
    np.testing.assert_array_equal(product(np.array([[np.nan, 0.0]]), np.array([[0.0], [1.0]])), [[0.0]])
    np.testing.assert_array_equal(product(np.array([[np.nan, 0.0]]), np.array([[1.0], [1.0]])), [[np.inf]])


def test_bounds_are_applied_alike_by_group_and_by_duration():
    rng = np.random.default_rng(1)
    matrices, which = rng.uniform(size=(3, 2, 4)), rng.integers(0, 3, 50)
    norms = rng.uniform(size=(5, 50, 4))
    expected = np.einsum("kij,rkj->rki", matrices[which], norms)
    np.testing.assert_allclose(NormBounds(matrices, which).on(norms), expected, rtol=1e-13)
    np.testing.assert_allclose(NormBounds(matrices, which[:5]).on(norms[:, :5]), expected[:, :5], rtol=1e-13)
    np.testing.assert_allclose(
        NormBounds(matrices, which).transposed.on(norms[..., :2]),
        np.einsum("kij,rki->rkj", matrices[which], norms[..., :2]),
        rtol=1e-13,
    )


@pytest.mark.parametrize("name", METZLER)
def test_bounds_of_cells_whose_widths_differ_little_hold_for_each(name, monkeypatch):
    """And are those of a width that is a fifth longer, at most."""
    monkeypatch.setattr(comparison, "WORK", 0.0)
    system, widths = made(name), np.concatenate([np.geomspace(1e-5, 0.3, 60), [0.0]])
    groups = alike(widths, 9, rough=True)
    assert np.unique(groups[2]).size < 60 <= np.unique(alike(widths, 9)[2]).size
    assert (groups[1][groups[2]] <= 1.2 * (1 + 1e-8) * np.maximum(widths, 1e-12)).all()
    states = np.random.default_rng(0).uniform(0.0, 1.0, (widths.size, 3))
    for close, rough in zip(one_by_one(system.metzler, widths), system.over(widths, cells=True), strict=True):
        exact = np.einsum("kij,kj->ki", close, states)
        assert (rough.on(states) >= exact * (1 - 1e-12)).all()
