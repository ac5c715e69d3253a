"""Guards the shapes in annotations: they are checked in the tests, and cost nothing outside of them."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from sparserob_core.shapes import CHECKED, Float, shaped
from sparserob_core.sip.convex_set import Array, Box
from sparserob_core.sip.finite import scaled_violation
from sparserob_core.sip.inner.duality import minimisers

# numpy would make a matrix of a row and a column, and nobody would notice
COLUMN_FOR_A_ROW = "minimisers(np.ones(2), None, np.ones((2, 1)), -np.ones(2), np.ones(2)).shape"


@shaped
def stacked(rows: Float[Array, "k d"], bounds: Float[Array, " k"]) -> Float[Array, "k d+1"]:
    return np.column_stack([rows, bounds])


def test_a_column_where_a_row_is_asked_for_is_caught() -> None:
    assert CHECKED
    with pytest.raises(TypeError, match="slope"):
        minimisers.checked(np.ones(2), None, np.ones((2, 1)), -np.ones(2), np.ones(2))


def test_a_transposed_matrix_is_caught_before_it_is_used() -> None:
    rows = np.arange(6.0).reshape(2, 3)
    assert scaled_violation(np.zeros(2), rows, np.ones(2), np.ones(3)) == 0.0
    with pytest.raises(TypeError, match="Type-check error"):
        scaled_violation.checked(np.zeros(2), rows.T, np.ones(2), np.ones(3))


def test_a_result_of_the_wrong_shape_is_caught() -> None:
    assert stacked(np.ones((3, 2)), np.ones(3)).shape == (3, 3)

    @shaped
    def transposed(rows: Float[Array, "k d"]) -> Float[Array, "k d"]:
        return rows.T

    with pytest.raises(TypeError, match="return value"):
        transposed(np.ones((3, 2)))


def test_the_first_calls_are_checked_and_later_ones_now_and_then() -> None:
    @shaped
    def kept(rows: Float[Array, "k d"]) -> Float[Array, "k d"]:
        return rows

    for _ in range(250):
        kept(np.ones((3, 2)))
    with pytest.raises(TypeError):
        for _ in range(100):
            kept(np.ones(3))


def test_any_leading_axes_are_kept_down_to_a_single_number() -> None:
    box = Box(-np.ones(3), np.ones(3))
    for leading in ((), (4,), (2, 0, 5)):
        assert np.shape(box.violation(np.zeros((*leading, 3)))) == leading


def test_outside_of_the_tests_nothing_is_imported_and_nothing_is_checked() -> None:
    program = (
        "import sys, numpy as np; from sparserob_core.sip.inner.duality import minimisers; "
        f"print({COLUMN_FOR_A_ROW}, sorted({{'jaxtyping', 'beartype'}} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "(2, 2) []"
