"""Guards control/problem/dictionary: dictionaries as records."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

from sparserob_core.control.problem.dictionary import Dictionary
from sparserob_core.errors import InputError


def test_a_dictionary_knows_its_sizes() -> None:
    made = Dictionary([0.0, 1.0, 3.0], [[1.0, -1.0]])
    assert (made.pieces, made.functions, made.horizon, made.is_complete) == (2, 1, 3.0, False)
    np.testing.assert_array_equal(made.lengths, [1.0, 2.0])


def test_merging_keeps_every_function_and_joins_equal_pieces() -> None:
    fine = Dictionary(np.linspace(0, 4, 5), [[1, 1, 0, 0], [0, 0, 0, 2]])
    coarse = fine.merged()
    np.testing.assert_array_equal(coarse.breakpoints, [0, 2, 3, 4])
    np.testing.assert_array_equal(coarse.values, [[1, 0, 0], [0, 0, 2]])
    assert not fine.is_complete


def test_indicators_of_merged_pieces_are_complete() -> None:
    assert Dictionary(np.linspace(0, 4, 5), [[1, 1, 0, 0], [0, 0, 1, 1]]).is_complete


@pytest.mark.parametrize(
    ("breakpoints", "values", "message"),
    [
        ([0, 1, 1], [[1, 1]], "breakpoints must increase from 0"),
        ([1, 2], [[1]], "breakpoints must increase from 0"),
        ([0, 1], [[1, 2]], r"values must have shape \(functions, 1\)"),
        ([0, 1], [[1], [2]], "2 functions on 1 pieces; there can be at most as many functions as pieces"),
        ([0, 1, 2], [[1, 2], [2, 4]], "linearly independent"),
        ([0, 1, 2], [[0, 0]], "linearly independent"),
        ([0, 1], [[np.nan]], "finite"),
        ([0, 1], [["a"]], "array of numbers"),
    ],
)
def test_a_dictionary_at_fault_says_what_was_expected(breakpoints, values, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Dictionary(breakpoints, values)


def kinds() -> dict[str, tuple[Dictionary, np.ndarray]]:
    """Dictionaries of every kind, each with its table of values."""
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, 3.0, 9)
    owner, mixed = np.array([0, 0, 1, 2, 2, 2, 3, 0]), np.zeros((3, 8))
    mixed[0], mixed[1, :4], mixed[2, 4:6], mixed[2, 6:] = 1.0, [1.0, 1.0, -1.0, -1.0], 1.0, -1.0
    dense = rng.normal(size=(4, 8))
    joined = (owner == np.arange(4)[:, None]).astype(float)
    return {
        "indicators": (Dictionary.indicators(times), np.eye(8)),
        "identity": (Dictionary(times, np.eye(8)), np.eye(8)),
        "joined": (Dictionary.indicators(times, owner), joined),
        "joined, as a table": (Dictionary(times, joined), joined),
        "sparse": (Dictionary(times, csr_array(mixed)), mixed),
        "dense": (Dictionary(times, dense), dense),
    }


@pytest.mark.parametrize("kind", kinds())
def test_products_with_a_structured_dictionary_are_those_with_its_table(kind: str) -> None:
    made, values = kinds()[kind]
    rng = np.random.default_rng(1)
    theta, weights = rng.normal(size=(2, len(values))), rng.normal(size=(5, 8, 3))
    np.testing.assert_array_equal(made.values, values)
    np.testing.assert_allclose(made.control(theta.ravel()), theta @ values, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(made.summands(theta), np.abs(theta) @ np.abs(values), rtol=1e-14)
    np.testing.assert_allclose(made.gathered(weights), values @ weights, rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(made.sparse.toarray(), values)
    np.testing.assert_array_equal(made.at(np.array([[3, 0], [7, 7]])), values[:, [[3, 0], [7, 7]]])
    np.testing.assert_array_equal(made.changes, (np.diff(values, axis=1) != 0).any(axis=0))
    keep = np.append(True, made.changes)
    np.testing.assert_array_equal(made.merged().values, values[:, keep])
    assert made.is_complete == (len(values) == keep.sum())
    assert made.is_indicators == np.array_equal(values, np.eye(8))
    moved = made.on(2.0 * made.breakpoints)
    np.testing.assert_array_equal(moved.values, values)
    assert moved.horizon == 6.0


def test_a_table_that_is_too_large_is_not_made() -> None:
    made = Dictionary.indicators(np.linspace(0.0, 1.0, 100_001))
    assert made.functions == 100_000 and made.is_indicators and made.is_complete
    with pytest.raises(InputError, match=r"would take 80\.0 GB"):
        _ = made.values


@pytest.mark.parametrize("owner", [[0, 2], [1, 1], [0], [0.0, 1.0], [-1, 0]])
def test_indicators_need_a_function_on_every_piece_and_a_piece_for_every_function(owner: list[int]) -> None:
    with pytest.raises(InputError, match="owner must be 2 whole numbers"):
        Dictionary.indicators([0.0, 1.0, 2.0], owner)


def test_sparse_functions_that_are_dependent_are_refused() -> None:
    with pytest.raises(InputError, match="linearly independent"):
        Dictionary([0.0, 1.0, 2.0, 3.0], csr_array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0]]))
