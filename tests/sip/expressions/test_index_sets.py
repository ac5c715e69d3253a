"""Guards sip/expressions/index_sets and triangulation: polytopes are covered by simplices without a gap, in fractions,
and rows are bounded over all of them."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import sparserob_core as sr
from sparserob_core.errors import InputError
from sparserob_core.sip.expressions.cell_models import CellModels
from sparserob_core.sip.expressions.index_sets import read_index, read_intervals
from sparserob_core.sip.expressions.rows import ExpressionRows
from sparserob_core.sip.expressions.statements import Decisions
from sparserob_core.sip.expressions.taylor import taylor_space
from sparserob_core.sip.expressions.triangulation import affine_dimension, find_vertices, triangulate
from tests.support.polytopes import POLYTOPES, index_of, list_corners, region_of, sample

SOLID = [name for name in POLYTOPES if name not in ("flat", "flat square", "line", "point", "segment")]
UNIT = {"x": (0.0, 1.0)}


@pytest.mark.parametrize("name", SOLID)
def test_simplices_have_the_volume_of_the_polytope(name: str) -> None:
    """Of qhull, from the vertices; the simplices lie in the hull of the same vertices, so that they cover it."""
    H, h = (np.array(table, dtype=float) for table in POLYTOPES[name])
    vertices = find_vertices(H, h)
    assert vertices is not None
    points = np.array(vertices, dtype=float)
    volumes = [
        abs(float(np.linalg.det(np.diff(np.array(simplex, dtype=float), axis=0)))) / math.factorial(H.shape[1])
        for simplex in triangulate(H, h, vertices)
    ]
    assert min(volumes) > 0.0
    assert sum(volumes) == pytest.approx(ConvexHull(points).volume, rel=1e-12)


def test_vertices_are_fractions_and_nothing_else_is_one() -> None:
    H, h = (np.array(table, dtype=float) for table in POLYTOPES["thirds"])
    assert Fraction(3, 10) in {3 * vertex[0] for vertex in find_vertices(H, h) or ()}
    square = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [1.0, 1.0]])
    assert len(find_vertices(square, np.array([1.0, 1.0, 1.0, 1.0, 2.0])) or ()) == 4  # a row that touches a vertex
    assert find_vertices(square, np.array([1.0, -2.0, 1.0, 1.0, 2.0])) == []
    assert find_vertices(np.ones((300, 2)), np.ones(300)) is None


def test_the_dimension_of_points_is_that_of_their_flat() -> None:
    points = [tuple(map(Fraction, point)) for point in ((0, 0, 1), (1, 1, 1), (2, 2, 1), (0, 1, 1))]
    assert [affine_dimension(points[:count]) for count in (1, 2, 3, 4)] == [0, 1, 1, 2]


@pytest.mark.parametrize("name", POLYTOPES)
def test_pieces_are_in_the_polytope_and_reach_all_of_it(name: str) -> None:
    """Every place of a box of coordinates keeps the rows; every point of the polytope is close to a place."""
    H, h = (np.array(table, dtype=float) for table in POLYTOPES[name])
    pieces, rng = region_of(name).pieces, np.random.default_rng(1)
    places = []
    for piece in pieces:
        d = piece.lower.size
        share = np.concatenate([rng.random((2500, d)) ** (1 / np.arange(d, 0, -1)), rng.integers(0, 2, (40, d))])
        columns = (piece.lower + share * (piece.upper - piece.lower)).T[..., None]
        placed = piece.place(list(columns), float)
        assert sorted(placed) == sorted(piece.names)
        places.append(np.hstack([placed[name] for name in piece.names]))
    every = np.concatenate(places)
    assert (every @ H.T - h).max() <= 1e-14
    inside = sample(name, 20)
    distance = np.linalg.norm(inside[:, None] - every, axis=2).min(axis=1)
    assert distance.max() <= 0.2


@pytest.mark.parametrize("name", POLYTOPES)
def test_rows_are_bounded_over_all_of_a_polytope(name: str) -> None:
    index = index_of(name)
    names = index["names"]
    text = f"exp({names[0]})*{'*'.join(f'(1.5 + {one})' for one in names)} + sin(3*{names[-1]}) <= x"
    parts = ExpressionRows.parse_all(read_index(index), text, Decisions({"x": None}), {})
    points = np.vstack([sample(name, 60), list_corners(name)])
    values = np.exp(points[:, 0]) * (1.5 + points).prod(axis=1) + np.sin(3 * points[:, -1])
    bounds = []
    for part in parts:
        corners = np.linspace(part.lower, part.upper, 9)
        grid = np.stack(np.meshgrid(*corners[:-1].T, indexing="ij"), axis=-1).reshape(-1, part.dimension)
        bounds.append(part.enclose(np.zeros(1), grid, grid + (part.upper - part.lower) / 8)[0].max())
    assert values.max() <= max(bounds) + 1e-14
    assert max(bounds) <= values.max() + 0.05 * np.abs(values).max()
    whole = sr.ConstraintFamily.from_expressions("f", index=index, rows=text, decision={"x": None})
    assert len(whole.parts or (whole,)) == len(parts)


def test_vertices_that_are_no_doubles_are_in_the_bounds() -> None:
    """A third is above its double by 2e-17; the bound of the row that says so counts it."""
    index = {"names": ["x", "y"], "polytope": {"H": [[3, 0], [-1, 0], [0, -1], [1, 1]], "h": [1, 0, 0, 5]}}
    (rows, *_) = ExpressionRows.parse_all(read_index(index), f"x - {1 / 3!r} <= d", Decisions({"d": None}), {})
    space, third = taylor_space(2, 4), Fraction(1, 3)
    model = CellModels.of_fraction(space, third)
    assert Fraction(float(model.coefficients[0, 0, 0])) + Fraction(float(model.remainder[0, 0])) >= third
    assert CellModels.of_fraction(space, Fraction(1, 4)).is_number
    bound = rows.enclose(np.zeros(1), rows.lower[None], rows.upper[None])[0]
    assert Fraction(float(bound[0])) >= third - Fraction(1 / 3) > 0


def test_an_index_is_told_in_the_coordinates_of_the_user() -> None:
    H, h = [[-1, 0, 0], [0, 0, -1], [1, 0, 2], [0, 1, 0], [0, -4, 0]], [0, 0, 2, 7, 1]
    index = {"names": ["x", "q", "y"], "polytope": {"H": H, "h": h}}
    (region,) = read_index(index)
    (piece,) = region.pieces
    assert region.coupled == ("x", "y")
    assert (region.lower.tolist(), region.upper.tolist()) == ([-0.25], [7.0])
    assert piece.labels == ("share 1", "share 2", "q")
    assert piece.locate(np.array([1.0, 1.0, 3.0])) == {"q": 3.0, "x": 2.0, "y": 0.0}
    assert piece.describe(np.array([0.5, 0.0, 3.0])) == "q = 3, x = 0, y = 0.5"
    family = sr.ConstraintFamily.from_expressions("f", index=index, rows="x + y <= d + q", decision={"d": None})
    assert family.explanation(np.array([1.0, 1.0, 3.0]), 0).text == "f, x + y <= d + q at q = 3, x = 2, y = 0"


def test_a_set_with_faces_is_a_polytope_and_a_list_is_a_union() -> None:
    decision = {"d": None}
    sets = [sr.Polytope([[-1, 0], [0, -1], [1, 1]], [0, 0, 1]), sr.Box([0.0, 0.0], [1.0, 2.0]), {"H": [[1, 1]], "h": 3}]
    for polytope, least in ((sets[0], 1.0), (sets[1], 3.0)):
        index = {"names": ["x", "y"], "polytope": polytope}
        family = sr.ConstraintFamily.from_expressions("f", index=index, rows="x + y <= d", decision=decision)
        assert sr.solve(sr.SemiInfiniteProgram(n=1, q=[1.0], families=[family])).cost == pytest.approx(least, abs=1e-7)
    union = [{"names": ["x", "y"], "polytope": sets[0]}, {"x": (2.0, 3.0), "y": (-4.0, -2.5)}]
    family = sr.ConstraintFamily.from_expressions("f", index=union, rows="x*x + y <= d", decision=decision)
    program = sr.SemiInfiniteProgram(n=1, q=[1.0], families=[family])
    assert [part.name for part in program.families] == ["f 1", "f 2"]
    result = sr.solve(program)
    assert result.status == "certified"
    assert result.cost == pytest.approx(6.5, abs=1e-7)


def polytope(names: str, H: Any, h: Any) -> dict[str, Any]:
    return {"names": list(names), "polytope": {"H": H, "h": h}}


CROSS = [[1, 0], [-1, 0], [0, 1], [0, -1]]
NORMALS = np.random.default_rng(0).normal(size=(99, 3))
BAD: dict[str, tuple[Any, str]] = {
    "empty": (polytope("xy", CROSS, [0, -1, 1, 1]), "index: expected a polytope with a point"),
    "empty by a row of zeros": (polytope("x", [[0]], [-1]), "index: expected a polytope with a point"),
    "unbounded": (polytope("xy", [[1, 1]], [0]), "index: expected a bounded polytope"),
    "no rows": (polytope("x", [], []), "index: expected rows H of 1 numbers"),
    "too few columns": (polytope("xy", [[1]], [1]), "index: expected rows H of 2 numbers"),
    "too few sides": (polytope("x", [[1], [-1]], [1, 1, 1]), "index: expected rows H of 1"),
    "a normal that is no number": (polytope("x", [["a"]], [1]), "index: expected rows H"),
    "an infinite normal": (polytope("x", [[np.inf]], [1]), "index: expected rows H"),
    "no normals": ({"names": ["x"], "polytope": {"h": [1]}}, "index: expected its normals H"),
    "a curved set": (
        {"names": ["x", "y"], "polytope": sr.NormBall(2.0, 1.0, [0.0, 0.0])},
        "index: expected a set",
    ),
    "names alone": ({"names": ["x"]}, "index: expected names and a polytope"),
    "one name": ({"names": "x", "polytope": {"H": [[1], [-1]], "h": [1, 1]}}, "index.names: expected a list"),
    "a name twice": (polytope("xx", [[1, 1], [-1, 0], [0, -1]], [1, 1, 1]), "index.x: expected a name that"),
    "a part of a list": ([UNIT, {"x": (1.0, 0.0)}], "index.1.x: expected an interval"),
    "an unbounded part": ([UNIT, polytope("x", [[1]], [0])], "index.1: expected a bounded"),
    "a list without a part": ([], "index: expected at least one coordinate"),
    "other coordinates": ([UNIT, {"y": (0.0, 1.0)}], "index.1: expected the coordinates x of the first, got y"),
    "a number in a list": ([UNIT, 3], "index.1: expected coordinates"),
    "many rows": (polytope("xyz", NORMALS, np.ones(99)), "index: expected fewer rows"),
}


@pytest.mark.parametrize("fault", BAD)
def test_an_index_set_that_is_none_is_told_with_its_key(fault: str) -> None:
    index, message = BAD[fault]
    with pytest.raises(InputError) as caught:
        sr.ConstraintFamily.from_expressions("f", index=index, rows="x <= d", decision={"d": None})
    assert str(caught.value).startswith(message)


def test_intervals_are_read_as_they_are() -> None:
    lower, upper = read_intervals({"x": (0, 1), "y": [2, 2]})
    assert (lower.tolist(), upper.tolist()) == ([0.0, 2.0], [1.0, 2.0])
