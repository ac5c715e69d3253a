"""Guards the absolute values of expressions over cells: bounds that hold, and are as sharp as the cell is small."""

from __future__ import annotations

import numpy as np
import pytest

import sparserob_core as sr
from sparserob_core.sip.expressions.cell_models import CellModels
from sparserob_core.sip.expressions.taylor import taylor_space

SPACE = taylor_space(1, 4)


@pytest.mark.parametrize(
    ("lower", "upper"), [(-1.0, 0.0), (0.0, 1.0), (-0.3, 0.7), (-0.7, 0.3), (1.0, 2.0), (-2.0, -1.0)]
)
def test_absolute_values_are_within_their_remainder(lower: float, upper: float) -> None:
    (x,) = CellModels.variables(SPACE, np.array([[lower]]), np.array([[upper]]))
    model = np.absolute(x)
    shares = np.linspace(-1.0, 1.0, 401)
    points = (lower + upper) / 2 + (upper - lower) / 2 * shares
    values = np.vander(shares, SPACE.degree + 1, increasing=True) @ model.coefficients[0, 0]
    distance = np.abs(np.abs(points) - values).max()
    assert distance <= model.remainder[0, 0] + 1e-15
    assert model.remainder[0, 0] <= 2.0 * max(0.0, min(upper, -lower)) + 1e-9


def test_a_kink_at_the_end_of_a_box_costs_no_further_cells() -> None:
    rows = ["-d <= a + b*x - abs(x) <= d"]
    family = sr.ConstraintFamily.from_expressions(
        "error", index={"x": (-1, 0)}, rows=rows, decision={"a": None, "b": None, "d": None}
    )
    assert family.enclosure is not None
    bounds = family.enclosure(np.array([0.0, -1.0, 1e-9]), np.array([[-1.0]]), np.array([[0.0]]))
    assert bounds.bounds[0] <= 0.0
