"""Guards vertices and simplices of polytopes in fractions: none is lost where rows are nearly parallel."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest

from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.index_sets import read_index
from sparserob_core.sip.expressions.triangulation import find_vertices, triangulate


def area(H: np.ndarray, h: np.ndarray) -> float:
    vertices = find_vertices(H, h)
    assert vertices is not None
    total = Fraction(0)
    for a, b, c in triangulate(H, h, vertices):
        total += abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / 2
    return float(total)


@pytest.mark.parametrize("tilt", [1e-6, 1e-8, 1e-9, 1e-10, 1e-11, 1e-13])
@pytest.mark.parametrize("turn", [0.0, 0.3, 1.1])
def test_a_side_that_is_nearly_another_costs_no_vertex(tilt: float, turn: float) -> None:
    """A square of five rows, two of which are one side but for a tilt."""
    angles = turn + np.array([0.0, 0.5, 1.0, 1.5]) * np.pi
    H = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tilted = np.array([np.cos(turn + tilt), np.sin(turn + tilt)])
    corner = 0.5 * (H[0] + H[1])
    H, h = np.vstack([H, tilted]), np.append(np.full(4, 0.5), tilted @ corner * (1.0 + 1e-13))
    assert area(H, h) == pytest.approx(1.0, abs=4.0 * tilt + 1e-12)


def test_vertices_are_those_of_all_meetings_in_fractions() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        H = np.vstack([np.eye(2), -np.eye(2), rng.standard_normal((3, 2))])
        H = np.vstack([H, H[-1] + 1e-10 * rng.standard_normal(2)])
        h = np.ones(len(H))
        found = find_vertices(H, h)
        truth = set()
        for i, j in combinations(range(len(H)), 2):
            (a, b), (c, d) = ([Fraction(x) for x in H[k]] for k in (i, j))
            det = a * d - b * c
            if det:
                point = ((d - b) / det, (a - c) / det)
                if all(Fraction(row[0]) * point[0] + Fraction(row[1]) * point[1] <= 1 for row in H):
                    truth.add(point)
        assert found is not None and set(found) == truth


def test_a_polytope_whose_open_side_a_solver_does_not_see_is_refused() -> None:
    """HiGHS drops entries below 1e-9, and with them the direction in which the set has no end."""
    rows = {"H": [[-1, 0], [0, -1], [1, -0.9e-9], [-2e9, 1]], "h": [0, 0, 1, 1]}
    with pytest.raises(InputError, match="bounded"):
        _ = read_index({"names": ["x", "y"], "polytope": rows})[0].pieces
    rows = {"H": [[-1, 0], [0, -1e-9], [1, 1e-9]], "h": [0, 0, 1]}  # a triangle in other units
    assert len(read_index({"names": ["x", "y"], "polytope": rows})[0].pieces) == 1
