"""Guards checker/program/cover: simplices are accepted where they are the polytope, and refused where they leave a gap,
overlap its sides, or are one of its faces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import pytest

from sparserob_core.checker.outcome import Broken, Unchecked
from sparserob_core.checker.program.cover import require_cover
from sparserob_core.sip.expressions.index_sets import Region
from sparserob_core.sip.stated.statement import StatedProgram
from tests.support.polytopes import POLYTOPES, region_of
from tests.support.stated import certify, judge, state

Simplices = list[tuple[tuple[Fraction, ...], ...]]


def with_simplices(region: Region, simplices: Sequence[Any]) -> Region:
    """Return a region that claims to be these simplices."""
    copy = replace(region)
    pieces = [replace(region.pieces[0], simplex=simplex) for simplex in simplices]
    vars(copy)["pieces"] = tuple(pieces)
    return copy


def simplices_of(name: str) -> Simplices:
    return [piece.simplex for piece in region_of(name).pieces]


def shift(vertex: tuple[Fraction, ...], by: Fraction) -> tuple[Fraction, ...]:
    return (vertex[0] + by, *vertex[1:])


@pytest.mark.parametrize("name", [name for name in POLYTOPES if name != "box"])
def test_the_pieces_of_a_polytope_cover_it(name: str) -> None:
    region = region_of(name)
    assert require_cover(region) == len(region.pieces)


@pytest.mark.parametrize("name", [name for name in POLYTOPES if len(simplices_of(name)) > 1])
def test_every_simplex_that_is_left_out_is_missed(name: str) -> None:
    simplices = simplices_of(name)
    for k in range(len(simplices)):
        with pytest.raises(Broken, match="a gap"):
            require_cover(with_simplices(region_of(name), [*simplices[:k], *simplices[k + 1 :]]))


@pytest.mark.parametrize("name", [name for name in POLYTOPES if name not in ("point", "box")])
@pytest.mark.parametrize("by", [Fraction(1, 2**60), Fraction(-1, 2**60), Fraction(1, 9), Fraction(-1, 9)])
def test_a_vertex_that_is_moved_by_little_is_seen(name: str, by: Fraction) -> None:
    """Outwards it leaves the polytope, inwards a gap, across it the plane."""
    simplices = simplices_of(name)
    vertex = simplices[0][-1]
    moved = [tuple(shift(v, by) if v == vertex else v for v in simplex) for simplex in simplices]
    with pytest.raises(Broken):
        require_cover(with_simplices(region_of(name), moved))


@pytest.mark.parametrize("name", ["segment", "triangle", "tetrahedron", "flat", "line"])
def test_a_simplex_that_is_counted_twice_does_not_close_its_facets(name: str) -> None:
    """Both copies lie on the same side of every facet; the polytope may go on beyond it."""
    (simplex,) = simplices_of(name)
    with pytest.raises(Broken, match="a gap"):
        require_cover(with_simplices(region_of(name), [simplex, simplex]))


FACES: dict[str, Callable[[], Region]] = {
    "a side of a tetrahedron": lambda: with_simplices(region_of("tetrahedron"), [simplices_of("tetrahedron")[0][1:]]),
    "an edge of a triangle": lambda: with_simplices(region_of("triangle"), [simplices_of("triangle")[0][1:]]),
    "a vertex of a triangle": lambda: with_simplices(region_of("triangle"), [simplices_of("triangle")[0][1:2] * 2]),
    "an edge of a flat triangle": lambda: with_simplices(region_of("flat"), [simplices_of("flat")[0][1:]]),
}


@pytest.mark.parametrize("face", FACES)
def test_a_face_is_not_the_polytope(face: str) -> None:
    """All sides of a face lie in planes of rows, but the face has another dimension."""
    with pytest.raises(Unchecked, match="equality"):
        require_cover(FACES[face]())


def test_simplices_of_different_dimension_or_in_different_planes_are_refused() -> None:
    simplices = simplices_of("pyramid")
    with pytest.raises(Broken, match="flat"):
        require_cover(with_simplices(region_of("pyramid"), [simplices[0], simplices[1][1:]]))
    flat = (simplices[0][0], simplices[0][1], simplices[0][1], simplices[0][2])
    with pytest.raises((Broken, Unchecked)):
        require_cover(with_simplices(region_of("pyramid"), [flat]))
    sides = [simplices_of("tetrahedron")[0][:3], simplices_of("tetrahedron")[0][1:]]
    with pytest.raises(Broken, match="one plane"):
        require_cover(with_simplices(region_of("tetrahedron"), sides))


@pytest.fixture(scope="module")
def program() -> StatedProgram:
    H, h = POLYTOPES["hexagon"]
    index = {"names": ["p", "q"], "polytope": {"H": H, "h": h}}
    return state({"x": None}, "x", "x >= p + q - (p - q)**2", index=index)


def test_a_program_on_a_polytope_is_derived_anew(program: StatedProgram) -> None:
    data = certify(program)
    assert data["status"] == "certified"
    assert data["cost"] == pytest.approx(1.5, abs=1e-6)  # on the slanted side
    found = judge(program, data)
    assert {finding.verdict for finding in found.values()} == {"holds"}
    assert found["polytope of f"].text == "4 simplices cover it"
    assert "index set" not in found


def test_nothing_is_derived_of_a_polytope_with_a_gap(program: StatedProgram) -> None:
    data = certify(program)
    gap = replace(program)
    region = program.regions[0][0]
    vars(gap)["regions"] = ((with_simplices(region, [piece.simplex for piece in region.pieces[1:]]),),)
    found = judge(gap, data)
    assert {name: finding.verdict for name, finding in found.items()} == {"polytope of f": "fails"}


@pytest.mark.slow
@pytest.mark.parametrize("low", [1e-6, -1e-6])
def test_a_row_that_is_violated_on_a_slanted_side_is_seen(program: StatedProgram, low: float) -> None:
    data = certify(program)
    verdicts = judge(program, {**data, "decision": [data["decision"][0] - low]})
    families = {finding.verdict for name, finding in verdicts.items() if name.startswith("f ")}
    assert (families == {"holds"}) == (low < 0.0)


@pytest.mark.slow
def test_an_index_beyond_the_shares_of_a_simplex_is_refused(program: StatedProgram) -> None:
    data = certify(program)
    data["multipliers"]["constraints"][0]["index"] = [1.0 + 1e-12, 0.5]
    assert judge(program, data)["lower bound"].verdict == "fails"
