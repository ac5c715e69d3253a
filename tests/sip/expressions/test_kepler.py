"""Guards Kepler's equation: its root, its Taylor models against dense samples, and its series in balls."""

from __future__ import annotations

import numpy as np
import pytest

from sparserob_core.errors import InputError, NotEnclosable
from sparserob_core.sip.expressions.elementary import eccentric_anomaly
from sparserob_core.sip.expressions.expression import parse_expression
from sparserob_core.sip.expressions.taylor import TaylorSpace


@pytest.mark.parametrize("e", [0.0, 0.2, 0.9, 0.999])
def test_the_root_satisfies_the_equation(e: float) -> None:
    M = np.linspace(-12.0, 12.0, 4001)
    E = eccentric_anomaly(M, e)
    assert np.abs(E - e * np.sin(E) - M).max() < 5e-15


@pytest.mark.parametrize(
    ("e", "M", "radius"), [(0.9, 0.0, 0.012), (0.9, 0.1, 0.015), (0.9, 3.0, 0.5), (0.2, 1.0, 0.4), (0.0, 2.0, 1.0)]
)
@pytest.mark.parametrize("degree", [1, 3, 7])
def test_a_model_encloses_every_sample(e: float, M: float, radius: float, degree: int) -> None:
    model = TaylorSpace(1, degree).variables(np.array([M]), np.array([radius]))[0].kepler(e)
    at = np.linspace(-1.0, 1.0, 801)[:, None]
    off = np.abs(model.evaluate(at) - eccentric_anomaly(M + radius * at[:, 0], e))
    assert (off <= model.remainder).all()
    narrow = TaylorSpace(1, degree).variables(np.array([M]), np.array([radius / 4]))[0].kepler(e)
    rounding = 1e-13
    assert narrow.remainder <= max(2.5 ** -(degree + 1) * model.remainder, rounding), "it shrinks with the cell"


def test_a_cell_that_reaches_a_singularity_has_no_enclosure() -> None:
    with pytest.raises(NotEnclosable, match="Kepler"):
        TaylorSpace(1, 4).variables(np.array([0.0]), np.array([0.04]))[0].kepler(0.9)  # singular at 0.0312i


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("kepler(t)", "two arguments"),
        ("kepler(t, 1)", r"must be in \[0, 1\), got 1"),
        ("kepler(t, -0.1)", r"must be in \[0, 1\)"),
        ("kepler(t, t)", "must be a number, it depends on t"),
    ],
)
def test_an_eccentricity_is_a_number_below_one(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        parse_expression(text, ["t"])
