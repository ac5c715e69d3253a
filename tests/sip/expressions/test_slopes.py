"""Guards sip/expressions/slopes: bounds over cells from stated slopes and curvatures, and what samples contradict."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.slopes import BoundedSlopes

LOW, HIGH = np.zeros(2), np.ones(2)


def waves(indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one row ``sin(3 p) x_0 + cos(2 q) x_1 <= sin(p)``; slopes are at most 3 and 2, curvatures 9 and 4."""
    p, q = indices.T
    return np.stack([np.sin(3 * p), np.cos(2 * q)], axis=1)[:, None], np.sin(p)[:, None]


@pytest.mark.parametrize("kind", ["lipschitz", "curvature"])
def test_no_index_of_a_cell_is_above_its_bound_which_is_met_as_cells_shrink(kind: str) -> None:
    bounds: Any = {"lipschitz": [3.0, 2.0], "curvature": [9.0, 4.0]}[kind]
    stated = {"lipschitz": None, "curvature": None, kind: bounds}
    slopes, rng = BoundedSlopes.of(waves, LOW, HIGH, **stated), np.random.default_rng(0)
    for width in (0.5, 0.1, 0.01):
        lower = rng.random((40, 2)) * (1.0 - width)
        upper = lower + width
        x = rng.normal(size=2)
        bound, axis = slopes.enclose(x, lower, upper)
        shares = np.concatenate([rng.random((60, 1, 2)), np.array([[[0, 0]], [[1, 1]], [[0, 1]], [[1, 0]]])])
        points = (lower + shares * width).reshape(-1, 2)
        G, h = waves(points)
        values = (G @ x - h).max(axis=1).reshape(len(shares), -1)
        assert (values.max(axis=0) <= bound).all()
        order = width if kind == "lipschitz" else width**2
        assert (bound - values.max(axis=0)).max() <= 20.0 * order * (np.abs(x).sum() + 1.0)
        assert set(axis.tolist()) <= {0, 1}


@pytest.mark.parametrize(("kind", "order", "divisor"), [("lipschitz", 1, 2.0), ("curvature", 2, 8.0)])
def test_a_row_that_turns_as_much_as_it_may_meets_its_bound(kind: str, order: int, divisor: float) -> None:
    def rows(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (t if order == 1 else -0.5 * t**2)[:, None], np.zeros((len(t), 1))

    stated = {"lipschitz": None, "curvature": None, kind: 1.0}
    slopes = BoundedSlopes.of(rows, np.array([-1.0]), np.array([1.0]), **stated)
    (bound,), _ = slopes.enclose(np.array([1.0]), np.array([[-0.5]]), np.array([[0.5]]))
    truth = 0.5 if order == 1 else 0.0
    spare = 1.0 / divisor  # of the right-hand side, which turns no more than the entries may
    assert truth + spare - 1e-9 <= bound <= truth + spare + 1e-6


def test_a_cell_without_width_has_the_value_itself() -> None:
    slopes = BoundedSlopes.of(waves, LOW, HIGH, None, 9.0)
    point, x = np.array([[0.3, 0.7]]), np.array([1.0, -2.0])
    G, h = waves(point)
    assert slopes.enclose(x, point, point)[0][0] == pytest.approx((G @ x - h)[0, 0], abs=1e-12)


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"lipschitz": [1.5, 2.0]}, "lipschitz: expected a bound of every slope in coordinate 1 of the index, got 1.5"),
        ({"curvature": [9.0, 2.0]}, "curvature: expected a bound of every curvature in coordinate 2"),
        ({}, "expected one of lipschitz and curvature, got 0 of them"),
        ({"lipschitz": 3.0, "curvature": 9.0}, "got 2 of them"),
        ({"lipschitz": -1.0}, "lipschitz: expected a number that is not negative"),
        ({"lipschitz": np.nan}, "lipschitz: expected a number"),
        ({"lipschitz": {}}, "lipschitz: expected a number"),
        ({"curvature": "9"}, "curvature: expected a number"),
        ({"curvature": True}, "curvature: expected a number"),
        ({"curvature": [1.0, 2.0, 3.0]}, "or 2 of them"),
    ],
)
def test_a_bound_that_is_none_is_refused(stated: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        sr.ConstraintFamily.from_function("f", index_set=sr.Box(LOW, HIGH), rows=waves, **stated)


@pytest.mark.parametrize(
    "rows",
    [
        lambda t: (np.zeros((len(t), 2)), np.zeros(len(t))),
        lambda t: (np.zeros((len(t), 1, 2)), np.zeros((len(t), 2))),
        lambda t: (np.full((len(t), 1, 2), np.nan), np.zeros((len(t), 1))),
        lambda t: None,
        None,
    ],
)
def test_rows_of_other_shapes_are_refused(rows: Any) -> None:
    with pytest.raises(InputError, match="rows"):
        sr.ConstraintFamily.from_function("f", index_set=sr.Box(LOW, HIGH), rows=rows, lipschitz=1.0)


def test_a_result_says_what_it_believes() -> None:
    family = sr.ConstraintFamily.from_function(
        "above", index_set=sr.Box([0.0], [1.0]), rows=lambda t: (-np.ones((len(t), 1, 1)), -np.sin(9 * t)), curvature=81
    )
    result = sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], families=[family]))
    assert result.status == "certified" and result.cost == pytest.approx(1.0, abs=1e-7)
    assert "what above states of its curvature is believed" in result.message


@pytest.mark.parametrize("order", ["lipschitz", "curvature"])
def test_a_bound_counts_the_rounding_of_its_rows(order: str) -> None:
    """Ten negative entries of size 1e10 against a right-hand side: their sum is known to 1e-5, and no better."""
    G = -1e10 * np.linspace(1.0, 1.9, 10)[None, None]

    def rows(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.repeat(G, len(t), axis=0), np.full((len(t), 1), float(G.sum()))

    zero = np.zeros(1)
    slopes = BoundedSlopes.of(rows, zero, zero + 1.0, **{"lipschitz": None, "curvature": None, order: 0.0})
    bound = slopes.enclose(np.ones(10), zero[None], zero[None] + 1.0)[0][0]
    exact = sum(map(Fraction, G.ravel().tolist())) - Fraction(float(G.sum()))
    assert bound >= exact + Fraction(1, 10**5)
    assert bound <= 1e-3
